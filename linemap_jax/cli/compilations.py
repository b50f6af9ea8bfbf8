"""What jax compiles for one run of the command line, kept for the next."""

import os
from pathlib import Path


def keep_compilations() -> None:
    """Set jax up so that its compiled code is kept, in the cache folder of the user."""
    import jax

    if "JAX_COMPILATION_CACHE_DIR" not in os.environ:  # else the user has said where
        jax.config.update("jax_compilation_cache_dir", str(_cache_folder()))
        jax.config.update("jax_persistent_cache_min_compile_time_secs", 0.2)


def _cache_folder() -> Path:
    base = os.environ.get("XDG_CACHE_HOME") or Path.home() / ".cache"
    return Path(base) / "linemap_jax"
