"""Pieces of a log into a map, for the commands that build one: by a program kept on the disk, and interruptible."""

import time
from collections.abc import Callable, Iterator
from typing import TYPE_CHECKING, Any, NamedTuple

from linemap_jax.cli.compilations import cache_folder
from linemap_jax.cli.resume import START_CAPACITY

if TYPE_CHECKING:
    from linemap_jax.core.state import LineMap, Pose, Report, Scan


class Mapped(NamedTuple):
    """A map, and how it came to be."""

    line_map: "LineMap"
    report: "Report"  # of all scans
    seconds: list[tuple[float, int]]  # and scans of each piece, reading included
    interrupted: bool  # then the map is the one so far


def map_of_pieces(
    pieces: Iterator[tuple["Scan", "Pose"]],
    options: dict[str, Any],
    before: "LineMap | None" = None,
    look: "Callable[[LineMap], None] | None" = None,
) -> Mapped:
    """Build a map.

    Args:
      pieces: scans and poses, at most `build.CHUNK` of them each time.
      options: of `update`.
      before: a map to go on from.
      look: is shown the map after each piece.
    """
    from linemap_jax.build import CHUNK, COMPILER_OPTIONS, STATIC, build_chunks, join_reports, update_chunk
    from linemap_jax.core.settings import Capacity
    from linemap_jax.io.programs import kept_program

    run = kept_program(update_chunk, cache_folder(), static_argnames=STATIC, compiler_options=COMPILER_OPTIONS)
    start = Capacity(*START_CAPACITY)
    reports, seconds = [], []
    line_map, interrupted = None, False
    started = time.perf_counter()
    try:
        for grown, report in build_chunks(pieces, line_map=before, map_capacity=start, chunk=CHUNK, run=run, **options):
            line_map = grown
            reports.append(report)
            if look is not None:
                look(grown)
            seconds.append((time.perf_counter() - started, report.status.shape[0]))
            started = time.perf_counter()
    except KeyboardInterrupt:
        if line_map is None:
            raise
        interrupted = True
    assert line_map is not None  # a log without a scan has been refused by its reader
    return Mapped(line_map, join_reports(reports), seconds, interrupted)
