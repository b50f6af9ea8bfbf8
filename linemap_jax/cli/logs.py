"""Reading a log for a command: chunk by chunk, with a progress bar, and warnings about what was skipped."""

import contextlib
import sys
from collections.abc import Iterator
from typing import TYPE_CHECKING

from linemap_jax.cli.options import LogOptions
from linemap_jax.cli.output import say

if TYPE_CHECKING:
    from linemap_jax.core.state import Pose, Scan
    from linemap_jax.io.log import Log
    from linemap_jax.io.scans import Chunk

SCANS_EXPLAINED = 250
"""What a log says of a map is taken over so many of its scans at most."""


def chunks_of_log(command: LogOptions, log: "Log", size: int) -> Iterator["Chunk"]:
    """Scans and poses as the options want them."""
    import numpy as np

    from linemap_jax.io.scans import chunks_of_readings

    cov_pose = np.diag(np.square(command.pose_sigma))
    return chunks_of_readings(
        log, size, cov_pose=cov_pose, range_min=command.range_min, every=command.every, dtype=command.dtype
    )


def plain_chunks(log: "Log", every: int = 1) -> Iterator[tuple["Scan", "Pose"]]:
    """Scans and poses of a log as they are."""
    import numpy as np

    from linemap_jax.build import CHUNK
    from linemap_jax.io.scans import chunks_of_readings

    for chunk in chunks_of_readings(log, CHUNK, cov_pose=np.zeros((3, 3)), every=every, dtype="float64"):
        yield chunk.scans, chunk.poses


@contextlib.contextmanager
def progress(log: "Log", *, quiet: bool) -> Iterator[None]:
    """A progress bar over the bytes of the log, where somebody watches."""
    if quiet or not sys.stderr.isatty():
        yield
        return
    from tqdm import tqdm

    with tqdm(unit="B", unit_scale=True, leave=False) as bar:

        def show(read: int, total: int) -> None:
            bar.total = total
            bar.update(read - bar.n)

        log.progress = show
        yield
        log.progress = None


def warn(log: "Log", *, quiet: bool) -> None:
    """Say what the reader of the log has noticed so far."""
    for warning in log.notes.warnings():
        say(f"warning: {log.path}: {warning}", quiet=quiet)
