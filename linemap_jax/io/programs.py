"""Programs that are traced once and kept on the disk.

jax's own cache keeps compiled code, but to find it there jax traces and lowers the program anew in each process: for a
step of the map, two to three seconds. Here the lowered program is kept too (`jax.export`), under a name that tells of
everything it depends on: the source of the package, the version of jax, shapes and static options.
"""

import hashlib
from collections.abc import Callable, Sequence
from functools import cache
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
from jax import export

from linemap_jax.io.atomic import OutputError, atomic_write

MOST_KEPT = 32
"""Programs in a folder; beyond that those not written for longest make room."""

_DIGEST = hashlib.sha256
_DIGEST_SIZE = _DIGEST().digest_size


def kept_program(
    function: Callable[..., Any],
    folder: Path,
    *,
    static_argnames: Sequence[str],
    compiler_options: dict[str, Any] | None = None,
) -> Callable[..., Any]:
    """A jitted function whose lowered programs are kept in a folder, for later processes.

    A file that is missing or damaged is made anew, and a folder that cannot be written to is done without.

    Args:
      function: a pure function of pytrees. What it calls must lie in this package, or else be of one version of jax.
      folder: for the files; made if it is not there.
      static_argnames: keyword arguments that decide which program it is; their `repr` must tell them apart.
      compiler_options: as those of `jax.jit`.

    Returns:
      The function, jitted. Static arguments must be given by keyword.
    """
    jitted = jax.jit(function, static_argnames=tuple(static_argnames))
    programs: dict[str, Callable[..., Any]] = {}

    def call(*args: Any, **kwargs: Any) -> Any:
        static = {name: value for name, value in kwargs.items() if name in static_argnames}
        traced = {name: value for name, value in kwargs.items() if name not in static_argnames}
        name = _name(function, args, traced, static)
        if name not in programs:
            file = folder / name
            program = _read(file)
            if program is not None:
                if b"lapack" in program.mlir_module_serialized:
                    _load_lapack()
            else:
                program = export.export(jitted)(*args, **kwargs)
                _write(file, program)
            programs[name] = jax.jit(program.call, compiler_options=compiler_options)
        return programs[name](*args, **traced)

    return call


def _name(function: Callable[..., Any], args: Any, traced: dict[str, Any], static: dict[str, Any]) -> str:
    leaves, structure = jax.tree.flatten((args, traced))
    kinds = [repr(jax.typeof(leaf)) for leaf in leaves]
    where = (jax.__version__, jax.default_backend(), jax.config.jax_enable_x64, jax.config.jax_default_matmul_precision)  # pyright: ignore[reportAttributeAccessIssue]
    told = repr((_source(), where, structure, kinds, sorted(static.items())))
    return f"{function.__name__}-{_DIGEST(told.encode()).hexdigest()[:32]}.program"


@cache
def _load_lapack() -> None:
    """Have jax load LAPACK, as it does when it lowers a call of it: a program lowered elsewhere would crash (0.8.3)."""
    jax.jit(jnp.linalg.inv).lower(jnp.eye(2))


@cache
def _source() -> str:
    """A digest of the package's source: a program of other source is another program."""
    root = Path(__file__).parents[1]
    digest = _DIGEST()
    for file in sorted(root.rglob("*.py")):
        digest.update(str(file.relative_to(root)).encode() + b"\0" + file.read_bytes() + b"\0")
    return digest.hexdigest()


def _read(file: Path) -> export.Exported | None:
    try:
        content = file.read_bytes()
    except OSError:
        return None
    digest, program = content[:_DIGEST_SIZE], content[_DIGEST_SIZE:]
    if _DIGEST(program).digest() != digest:
        return None
    return export.deserialize(bytearray(program))


def _write(file: Path, program: export.Exported) -> None:
    content = program.serialize()
    try:
        file.parent.mkdir(parents=True, exist_ok=True)
        with atomic_write(file, overwrite=True) as temporary:
            temporary.write_bytes(_DIGEST(content).digest() + content)
        for old in sorted(file.parent.glob("*.program"), key=lambda f: f.stat().st_mtime)[:-MOST_KEPT]:
            old.unlink()
    except (OSError, OutputError):
        return  # the next process traces it again
