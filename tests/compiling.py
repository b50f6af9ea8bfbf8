"""How programs are compiled where a test cares; else scripts/test sets what compiles soonest."""

from functools import partial
from typing import Any

import jax

from linemap_jax.build import COMPILER_OPTIONS

AS_USERS: Any = {"xla_backend_optimization_level": 3, "xla_cpu_use_fusion_emitters": True}
"""As jax does it unless told otherwise."""
AS_BUILD: Any = AS_USERS | COMPILER_OPTIONS
"""As `linemap_jax.build` does it."""

A_LITTLE: Any = AS_BUILD | {"xla_backend_optimization_level": 1}
"""As little as does not change results, see tests/core/test_gradients.py."""

as_built = partial(jax.jit, compiler_options=AS_BUILD)
