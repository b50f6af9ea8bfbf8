"""A whole log into a map: the host loop around `update`.

Scans go through a jitted `lax.scan` in chunks of one size, so that one compilation serves a log of any length. When a
capacity runs full the chunk is done again with twice the room: no primitive is lost without a word.
"""

import dataclasses
from collections.abc import Callable, Iterable, Iterator
from functools import partial
from typing import Any, Unpack

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool

from linemap_jax.core.extract import extract
from linemap_jax.core.mapping import empty_map, update
from linemap_jax.core.settings import SCAN_CAPACITY, Capacity, ExtractOptions, UpdateOptions
from linemap_jax.core.slots import resize
from linemap_jax.core.state import LEFT_OUT, Extraction, LineMap, Pose, Report, Scan, Status, pad_stack

STATIC = ("pose_error", "capacity", "rules", "segmentation", "max_vertices", "covariance", "jacobians")
"""Options of `update` that decide which program it is."""

COMPILER_OPTIONS = {
    "xla_cpu_use_fusion_emitters": False,
    "xla_disable_hlo_passes": "tree_reduction_rewriter",
    "xla_cpu_prefer_vector_width": 512,
}
"""What a map step is compiled with on a CPU (jax 0.8.3); other devices do not look at these options.

XLA's older loop emitters compile its many small kernels in half the time, and they run nearly twice as fast. A
reduction over more than 32 numbers would be cut into pieces of 32 for the sake of rounding, each a kernel that cannot
be fused with what it reduces: here beams and slots are counted and the least of many is sought, which does not round,
and a step would take half as long again. Where the processor has vectors of 512 bits they save another seventh.
"""

_jit = partial(jax.jit, static_argnames=STATIC, compiler_options=COMPILER_OPTIONS)

CHUNK = 64
"""Scans in one jitted call. A compromise: the map is looked at once a chunk, and a chunk may have to be repeated."""


def build(
    scans: Scan,
    poses: Pose,
    *,
    line_map: LineMap | None = None,
    map_capacity: Capacity = Capacity(),
    capacity: Capacity = SCAN_CAPACITY,
    chunk: int = CHUNK,
    **options: Unpack[UpdateOptions],
) -> tuple[LineMap, Report]:
    """Build a map from a whole log.

    Args:
      scans: `T` scans, stacked: each field has a leading axis `[T]`.
      poses: `T` poses of the robot, stacked likewise.
      line_map: a map to go on from; an empty one unless given.
      map_capacity: slots to begin with; it grows as needed.
      capacity: slots for what one scan holds; it grows as needed.
      chunk: scans in one jitted call.
      **options: the remaining keyword arguments of `update`.

    Returns:
      The map, and the reports of all scans, stacked `[T]`.

    Raises:
      ValueError: if there is no scan, if scans and poses differ in number, or for what `update` refuses.
    """
    if scans.ranges.ndim != 2 or poses.mean.ndim != 2:
        shapes = f"ranges {scans.ranges.shape} and poses {poses.mean.shape}"
        raise ValueError(f"scans and poses must be stacked, with ranges [T, N] and poses [T, 3], not {shapes}")
    count = scans.ranges.shape[0]
    if poses.mean.shape[0] != count:
        raise ValueError(f"{count} scans and {poses.mean.shape[0]} poses: there must be one pose for each scan")
    pieces = ((_slice(scans, i, i + chunk), _slice(poses, i, i + chunk)) for i in range(0, count, chunk))
    reports = []
    built = line_map or empty_map(map_capacity, scans.ranges.dtype)
    for after, report in build_chunks(pieces, line_map=built, capacity=capacity, chunk=chunk, **options):
        built = after
        reports.append(report)
    return built, join_reports(reports)


def build_chunks(
    chunks: Iterable[tuple[Scan, Pose]],
    *,
    line_map: LineMap | None = None,
    map_capacity: Capacity = Capacity(),
    capacity: Capacity = SCAN_CAPACITY,
    chunk: int = CHUNK,
    run: Callable[..., tuple[LineMap, Report]] | None = None,
    **options: Unpack[UpdateOptions],
) -> Iterator[tuple[LineMap, Report]]:
    """Build a map from a log that comes piece by piece: memory does not grow with its length.

    Args:
      chunks: stacked scans and poses, at most `chunk` of them each time, all of one number of beams.
      line_map: as for `build`.
      map_capacity: as for `build`.
      capacity: as for `build`.
      chunk: as for `build`.
      run: `update_chunk`, made ready to run; jitted unless given.
      **options: the remaining keyword arguments of `update`.

    Yields:
      After each piece the map so far, and the reports of the piece. Capacities are grown by then: the statuses tell of
      poses that were not finite, never of a primitive lost.

    Raises:
      ValueError: if a piece holds more than `chunk` scans.
    """
    for scans, poses in chunks:
        count = scans.ranges.shape[0]
        if count > chunk:
            raise ValueError(f"a piece of {count} scans is longer than the chunk of {chunk}")
        if line_map is None:
            line_map = empty_map(map_capacity, scans.ranges.dtype)
        # Fill up with scans that hold nothing, which change nothing.
        active = jnp.asarray(np.arange(chunk) < count)
        scans, poses = pad_stack(scans, chunk), pad_stack(poses, chunk)
        while True:
            after, report = (run or _run)(line_map, scans, poses, active, capacity=capacity, **options)
            full = Status(int(np.bitwise_or.reduce(np.asarray(report.status))))
            if not full & ~Status.POSE_NOT_FINITE:
                break
            if full & Status.MAP_FULL:
                line_map = grow(line_map)
            capacity = _grow_scan(capacity, full)
        line_map = after
        yield after, _slice(report, 0, count)


def extract_chunk(
    scans: Scan, *, capacity: Capacity = SCAN_CAPACITY, chunk: int = CHUNK, **options: Unpack[ExtractOptions]
) -> tuple[Extraction, Capacity]:
    """Extract a chunk of scans, each in the frame of its sensor, with measurement noise alone.

    Args:
      scans: at most `chunk` of them, stacked.
      capacity: slots for what one scan holds; grows as needed.
      chunk: scans in one jitted call.
      **options: the remaining keyword arguments of `extract`.

    Returns:
      The extractions, stacked; and the capacity by then, to go on with.
    """
    count = scans.ranges.shape[0]
    scans = pad_stack(scans, chunk)
    while True:
        found = _extract(scans, capacity=capacity, **options)
        full = Status(int(np.bitwise_or.reduce(np.asarray(found.status)[:count])))
        if not full:
            return _slice(found, 0, count), capacity
        capacity = _grow_scan(capacity, full)


@_jit
def _extract(scans: Scan, *, capacity: Capacity, **options: Unpack[ExtractOptions]) -> Extraction:
    dtype = scans.ranges.dtype
    here = Pose(mean=jnp.zeros(3, dtype), cov=jnp.zeros((3, 3), dtype))
    return jax.lax.map(lambda scan: extract(scan, here, capacity=capacity, **options), scans)


def update_chunk(
    line_map: LineMap,
    scans: Scan,
    poses: Pose,
    active: Bool[Array, " T"],
    *,
    capacity: Capacity = SCAN_CAPACITY,
    **options: Unpack[UpdateOptions],
) -> tuple[LineMap, Report]:
    """Update a map by a chunk of scans, one after the other: what `build` runs over and over.

    Args:
      line_map: the map.
      scans: `T` scans, stacked.
      poses: `T` poses of the robot, stacked.
      active: False for scans that only fill up the chunk. Shape `[T]`.
      capacity: slots for what one scan holds.
      **options: the remaining arguments of `update`.

    Returns:
      The map, and the reports of all scans, stacked `[T]`.
    """

    def step(line_map: LineMap, x: tuple[Scan, Pose, Array]) -> tuple[LineMap, Report]:
        scan, pose, is_active = x
        look = partial(update, capacity=capacity, **options)
        _, nothing = jax.eval_shape(look, line_map, scan, pose)
        blank = jax.tree.map(lambda x: jnp.zeros(x.shape, x.dtype), nothing)
        return jax.lax.cond(is_active, look, lambda line_map, *_: (line_map, blank), line_map, scan, pose)

    return jax.lax.scan(step, line_map, (scans, poses, active))


_run = _jit(update_chunk)


def grow(line_map: LineMap) -> LineMap:
    """A map with twice the slots for lines and circles: where either run out, the other soon would.

    On the host; `update` is compiled once more for it.

    Args:
      line_map: the map.

    Returns:
      The same map, each primitive in its slot.
    """
    lines, circles = line_map.lines, line_map.circles
    return LineMap(lines=resize(lines, 2 * lines.valid.shape[0]), circles=resize(circles, 2 * circles.valid.shape[0]))


def _grow_scan(capacity: Capacity, full: Status) -> Capacity:
    """Twice the room where it ran out."""
    lines = 2 * capacity.lines if full & Status.SCAN_LINES_FULL else capacity.lines
    circles = 2 * capacity.circles if full & Status.SCAN_CIRCLES_FULL else capacity.circles
    return Capacity(lines, circles)


def join_reports(reports: list[Report]) -> Report:
    """The reports of several pieces as one. Pieces may differ in how many primitives a scan may hold.

    Args:
      reports: of successive pieces of a log, each with one scan or more in front.

    Returns:
      One report, with the scans of all pieces in their order.

    Raises:
      ValueError: if there is none.
    """
    if not reports:
        raise ValueError("no scan, no report")
    fill = {"line_slot": LEFT_OUT, "circle_slot": LEFT_OUT}

    def join(name: str) -> Array:
        arrays = [np.asarray(getattr(report, name)) for report in reports]
        if arrays[0].ndim > 1:
            width = max(a.shape[1] for a in arrays)
            value = fill.get(name, 0)
            arrays = [np.pad(a, ((0, 0), (0, width - a.shape[1])), constant_values=value) for a in arrays]
        return jnp.asarray(np.concatenate(arrays))

    return Report(**{field.name: join(field.name) for field in dataclasses.fields(Report)})


def _slice(tree: Any, begin: int, end: int) -> Any:
    """Items of a stack. On the host, where nothing has to be compiled."""
    if all(begin == 0 and end == x.shape[0] for x in jax.tree.leaves(tree)):
        return tree
    return jax.tree.map(lambda x: jnp.asarray(np.asarray(x)[begin:end]), tree)
