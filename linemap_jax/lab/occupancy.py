"""An occupancy grid from the scans of a log: what of the plane is free, occupied, or unknown.

Counting, as Haehnel's reflection maps and GMapping do it: a return counts for the cell that it lies in, and against
each cell that its beam has passed before. Beams without a return say nothing: scanners report "nothing seen" also of
black and of glass. NumPy, since a scatter into a large grid is no work for XLA on a CPU.
"""

from collections.abc import Callable, Iterable
from typing import NamedTuple

import numpy as np
from jaxtyping import Bool, Float, Int8, Shaped

from linemap_jax.core.fields import documented
from linemap_jax.core.settings import Mount
from linemap_jax.core.state import Pose, Scan

UNKNOWN, FREE, OCCUPIED = -1, 0, 100
"""Values of a cell, as `nav_msgs/OccupancyGrid` has them."""

OCCUPIED_SHARE = 0.25
"""A cell is occupied if so many of the beams that reached it ended there: as in GMapping. Beams that graze a wall pass
through cells of it, so one half would be too much."""
MOST_CELLS = 64_000_000
"""Of a grid: 400 m by 400 m at 5 cm, half a gigabyte while it is counted."""

_FRACTION = 32  # bits after the point, of positions along a beam
_HALF = 1 << (_FRACTION - 1)

Chunks = Iterable[tuple[Scan, Pose]]


@documented
class Grid(NamedTuple):
    """An occupancy grid."""

    cells: Int8[np.ndarray, "H W"]
    """Row 0 is the lowest y, column 0 the lowest x."""
    origin: Float[np.ndarray, "2"]
    """The lower left corner of cell (0, 0), m."""
    resolution: float
    """The side of a cell, m."""


def returns_in_world(
    scans: Scan, poses: Pose, mount: Mount | None = None
) -> tuple[Float[np.ndarray, "T 2"], Float[np.ndarray, "T N 2"], Bool[np.ndarray, "T N"]]:
    """Where the beams of stacked scans start and end: Eq. (3), in float64 and without a covariance.

    Args:
      scans: `T` scans of `N` beams, stacked.
      poses: of the robot, stacked.
      mount: of the scanner on the robot.

    Returns:
      The scanner's positions, m; the points, m; which of them are returns, at a pose that is finite.
    """
    placed = mount or Mount()
    mean = np.asarray(poses.mean, float)
    finite = np.asarray(np.isfinite(mean).all(-1))
    x, y, theta = np.where(finite[:, None], mean, 0).T
    cos, sin = np.cos(theta), np.sin(theta)
    mx, my = float(placed.x), float(placed.y)
    origin = np.stack([x + cos * mx - sin * my, y + sin * mx + cos * my], -1)
    direction = theta[:, None] + float(placed.theta) + np.asarray(scans.bearings, float)
    ranges = np.asarray(scans.ranges, float)[..., None]
    points = origin[:, None] + ranges * np.stack([np.cos(direction), np.sin(direction)], -1)
    return origin, points, np.asarray(scans.valid) & finite[:, None]


def occupancy(chunks: Callable[[], Chunks], mount: Mount | None = None, *, resolution: float = 0.05) -> Grid:
    """The grid of a log. The log is read twice, chunk by chunk: for its extent, and for its content.

    Args:
      chunks: begins a new pass over stacked scans and poses.
      mount: of the scanner on the robot.
      resolution: side of a cell, m.

    Returns:
      A grid that holds all returns and all positions of the scanner, with a margin of one cell.

    Raises:
      ValueError: if the resolution is not positive, if there is no return, or if the grid would have more than
        `MOST_CELLS`.
    """
    if not 0 < resolution < float("inf"):
        raise ValueError(f"the resolution must be positive, not {resolution}")
    low, high = np.full(2, np.inf), np.full(2, -np.inf)
    for scans, poses in chunks():
        origin, points, valid = returns_in_world(scans, poses, mount)
        seen = np.concatenate([points[valid], origin[valid.any(-1)]])
        low, high = np.minimum(low, seen.min(0, initial=np.inf)), np.maximum(high, seen.max(0, initial=-np.inf))
    if not (low <= high).all():
        raise ValueError("there is no return to make a grid of")
    low = (np.floor(low / resolution) - 1) * resolution
    width, height = (np.floor((high - low) / resolution) + 2).tolist()
    if width * height > MOST_CELLS:
        raise ValueError(
            f"the scans reach over {width * resolution:.0f} m by {height * resolution:.0f} m, which takes more than "
            f"{MOST_CELLS // 10**6} million cells of {resolution:g} m"
        )
    width, height = int(width), int(height)
    ended, passed = (np.zeros(width * height, np.uint32) for _ in range(2))
    for scans, poses in chunks():
        origin, points, valid = returns_in_world(scans, poses, mount)
        starts = np.broadcast_to(origin[:, None], points.shape)[valid]
        first, last = (np.floor((x - low) / resolution).astype(np.int64) for x in (starts, points[valid]))
        np.add.at(ended, last[:, 1] * width + last[:, 0], np.uint32(1))
        _pass(passed, first, last, width)
    known, total = ended + passed > 0, np.maximum(ended + passed, 1)
    cells = np.where(ended >= OCCUPIED_SHARE * total, OCCUPIED, FREE)
    cells = np.where(known, cells, UNKNOWN).astype(np.int8)
    return Grid(cells.reshape(height, width), low, float(resolution))


def _pass(
    passed: Shaped[np.ndarray, " cells"],
    first: Shaped[np.ndarray, "B 2"],
    last: Shaped[np.ndarray, "B 2"],
    width: int,
) -> None:
    """Count the cells between the first and the last one of each beam, the last one left out: Bresenham's lines.

    All beams take a step at once, the longest ones first in the arrays, so that those which have ended are cut off.
    """
    step = last - first
    length = np.abs(step).max(-1, initial=0)
    order = np.argsort(-length, kind="stable")
    length, first, step = length[order], first[order], step[order]
    # In fixed point. What the steps lack, less than a unit each, stands in the start, so that halves are rounded up.
    place = (first << _FRACTION) + _HALF + length[:, None]
    step = (step << _FRACTION) // np.maximum(length, 1)[:, None]
    x, y = np.ascontiguousarray(place[:, 0]), np.ascontiguousarray(place[:, 1])
    by_x, by_y = np.ascontiguousarray(step[:, 0]), np.ascontiguousarray(step[:, 1])
    going = np.searchsorted(-length, -np.arange(length.max(initial=0)), side="left")
    for count in going.tolist():
        np.add.at(passed, (y[:count] >> _FRACTION) * width + (x[:count] >> _FRACTION), np.uint32(1))
        x[:count] += by_x[:count]
        y[:count] += by_y[:count]
