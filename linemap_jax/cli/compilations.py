"""What has been compiled once is kept for the next run of the command line."""

import os
from pathlib import Path


def keep_compilations() -> None:
    """Let jax keep all that it compiles: to compile even a single addition takes longer than to read it."""
    import jax

    if "JAX_COMPILATION_CACHE_DIR" not in os.environ:  # else the user has said where
        jax.config.update("jax_compilation_cache_dir", str(cache_folder()))
        jax.config.update("jax_persistent_cache_min_compile_time_secs", 0.0)


def cache_folder() -> Path:
    """Where compiled and lowered programs lie."""
    if said := os.environ.get("JAX_COMPILATION_CACHE_DIR"):
        return Path(said)
    base = os.environ.get("XDG_CACHE_HOME") or Path.home() / ".cache"
    return Path(base) / "linemap_jax"
