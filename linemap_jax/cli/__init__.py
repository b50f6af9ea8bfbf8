"""The command line: reads the options, and hands on between files, the build and the pictures.

One module for each command, its options with it; what commands share stands in modules of its own. The readers, the
experiments and the pictures are imported where they are used, so that help, and what is wrong with the options, come
without the wait for them.
"""

from linemap_jax.cli.main import main

__all__ = ["main"]
