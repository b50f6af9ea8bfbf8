"""How the tests run: on the CPU, in float64 unless a test says otherwise, every annotated shape checked at run time."""

import gc
import os
from collections.abc import Callable, Iterator
from pathlib import Path

# Before jax is loaded. The log level hides what jaxlib prints, at level "error", whenever it reads its cache.
os.environ["JAX_PLATFORMS"] = "cpu"
os.environ.setdefault("TF_CPP_MIN_LOG_LEVEL", "3")

import jax
import pytest
from jaxtyping import install_import_hook

ROOT = Path(__file__).resolve().parents[1]


UNCHECKED = (
    "linemap_jax.core.state",  # its classes say the shape of one item, and a stack of items has more
    "linemap_jax.lab.verification.literals",  # NumPy, called a hundred thousand times, and its numbers are compared
)


def modules_to_check() -> list[str]:
    """What computes."""
    package = ROOT / "linemap_jax"
    files = [package / "build.py", *package.glob("core/**/*.py"), *package.glob("lab/**/*.py")]
    names = [".".join(file.relative_to(ROOT).with_suffix("").parts) for file in files if file.name != "__init__.py"]
    return [name for name in names if name not in UNCHECKED]


# The whole tower of PEP 484: where a float is asked for, an int will do, as for every static checker.
install_import_hook(modules_to_check(), "beartype.beartype(conf=beartype.BeartypeConf(is_pep484_tower=True))")

jax.config.update("jax_enable_x64", True)
jax.config.update("jax_numpy_rank_promotion", "raise")


# To trace a program makes very many objects, and hardly any cycles among them. As often as Python looks for those by
# default, that takes a tenth of all time, and more the more programs are kept.
gc.set_threshold(100_000, 20, 100)


def pytest_collection_finish() -> None:
    """What is loaded by now stays: nobody need look through it again."""
    gc.collect()
    gc.freeze()


FIRST = (
    "test_programs",  # empties the caches of its process
    "test_notebooks",
    "test_oracle",
    "test_cli",
    "test_gradients",
    "test_cli_lab",
    "test_consistency",
    "test_verification",
    "test_batch",
    "test_cli_slam",
    "test_trials",
    "test_readme",
)
"""Files that begin first: the longest, since the tests of one stay in one process. None shall be waited for at last."""


def pytest_collection_modifyitems(items: list[pytest.Item]) -> None:
    """Those files first; else as they were."""
    items.sort(key=lambda item: FIRST.index(item.path.stem) if item.path.stem in FIRST else len(FIRST))


@pytest.fixture
def jax_as_it_was(monkeypatch: pytest.MonkeyPatch, tmp_path_factory: pytest.TempPathFactory) -> Iterator[None]:
    """The command line sets up jax for its process; and its cache of compilations is not the user's."""
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path_factory.getbasetemp() / "cache"))
    names = "jax_enable_x64", "jax_compilation_cache_dir", "jax_persistent_cache_min_compile_time_secs"
    before = {name: getattr(jax.config, name) for name in names}
    yield
    for name, value in before.items():
        jax.config.update(name, value)


@pytest.fixture(scope="session")
def data() -> Callable[[str], Path]:
    """Gives the path of a real log in $LINEMAP_DATA, and skips the test where it is not there."""
    folder = Path(os.environ.get("LINEMAP_DATA", ROOT / "../shared/data"))

    def find(name: str) -> Path:
        path = folder / name
        if not path.exists():
            pytest.skip(f"no {name} in {folder} ($LINEMAP_DATA): the test on this real data is left out")
        return path

    return find
