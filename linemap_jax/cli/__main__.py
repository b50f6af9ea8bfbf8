"""`python -m linemap_jax.cli` is `linemap`."""

import sys

from linemap_jax.cli.main import main

if __name__ == "__main__":
    sys.exit(main())
