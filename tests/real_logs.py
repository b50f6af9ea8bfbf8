"""Real logs for the tests: stacked scans and poses in float64, or a skip where the data is not there."""

import functools
import os
from pathlib import Path
from typing import Any

import jax
import numpy as np
import pytest

from linemap_jax.core.state import Pose, Scan
from linemap_jax.io.log import open_log
from linemap_jax.io.scans import chunks_of_readings

DATA = Path(os.environ.get("LINEMAP_DATA", Path(__file__).parents[2] / "shared" / "data"))
LOGS = ("intel", "aces", "fhw", "freiburg-079")
COV_POSE = np.diag([0.05, 0.05, 0.01]) ** 2


def path_of(name: str) -> Path:
    """The corrected CARMEN log of that name; skips the test where it is not there."""
    path = DATA / "carmen" / f"{name}-corrected.log.gz"
    if not path.exists():
        pytest.skip(f"real logs are not there: set LINEMAP_DATA (looked for {path})")
    return path


@functools.cache
def _chunk(name: str, dtype: str) -> Any:
    (chunk,) = chunks_of_readings(open_log(path_of(name)), 10_000, cov_pose=COV_POSE, dtype=dtype)
    return chunk


def scans_of(name: str, which: slice = slice(None), dtype: str = "float64") -> tuple[Scan, Pose]:
    """Scans and poses of a log, stacked."""
    chunk = _chunk(name, dtype)
    return jax.tree.map(lambda x: x[which], (chunk.scans, chunk.poses))


def one(stacked: Any, t: int) -> Any:
    """The item at `t` of a stack, as NumPy."""
    return jax.tree.map(lambda x: np.asarray(x[t]), stacked)
