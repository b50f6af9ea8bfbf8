"""How well a scan fits a map from some pose, looked up instead of computed: for searches over very many poses.

The field holds for each cell of a grid the distance to the nearest line segment or circle of the map (Thrun, Burgard
and Fox, *Probabilistic Robotics*, 2005, section 6.4). Searches tell where to begin; what is estimated is estimated from
lines, circles and points themselves.
"""

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float

from linemap_jax.core.frames import dot, rotate, wrap_angle
from linemap_jax.core.settings import Number
from linemap_jax.core.slots import directed
from linemap_jax.core.state import LineMap, pytree

FARTHEST = 1.0
"""m. Distances in the field end here: what is farther is nowhere near."""
CELL = 0.1
"""m. Side of a cell, unless the map is too large for it."""
MOST_CELLS = 1024
"""Of a side of the field: 4 MB in float32, and a second to fill."""
BEAMS = 64
"""A search looks at so many beams of a scan, evenly spread: neighbours say the same."""
WORST = 9.0
"""Largest squared distance of a point, in sigmas: what the map does not hold may be anywhere."""
DISCOUNT = 0.1
"""What a beam counts for in a search, beside the prior: what neighbouring beams get wrong, they get wrong alike."""

REACH = 3.0
"""How far to search, in sigmas of the prior."""

Counts = tuple[tuple[int, int], ...]
"""For each level of a search the nodes along either axis of the position, and along that of the heading."""


@pytree
class LikelihoodField:
    """Distances to the nearest primitive of a map, at the centres of square cells."""

    distance: Float[Array, "G G"]
    """Distance to the nearest surface of the map, at most `FARTHEST`, m; by column (x) and row (y)."""
    origin: Float[Array, "2"]
    """Lower left corner, m."""
    cell: Float[Array, ""]
    """Side of a cell, m."""


def field_size(line_map: LineMap) -> int:
    """How many cells a side of the field of a map should have: a power of two, so that few programs are compiled.

    On the host.

    Args:
      line_map: the map, on the host.

    Returns:
      Cells of a side.
    """
    low, high = (np.asarray(x) for x in _bounds(line_map))
    wanted = float(np.max(high - low)) / CELL
    return int(min(MOST_CELLS, max(64, 2 ** np.ceil(np.log2(max(wanted, 1.0))))))


def field_of_map(line_map: LineMap, size: int) -> LikelihoodField:
    """The field of a map.

    Args:
      line_map: the map; an empty one gives a field in which everything is far from anything.
      size: G, cells of a side.

    Returns:
      Distances to the map at the middles of `G` by `G` cells.
    """
    lines, circles = directed(line_map.lines), line_map.circles
    low, high = _bounds(line_map)
    cell = jnp.max(high - low) / size
    along = (jnp.arange(size, dtype=cell.dtype) + 0.5) * cell
    normal, tangent = lines.normal, lines.tangent

    def of_column(x: Float[Array, ""]) -> Float[Array, " G"]:
        place = jnp.stack([jnp.full_like(along, x), along], -1) + low[None]
        ray = place[:, None] - lines.anchor[None]
        across = dot(normal[None], ray) - lines.offset[None]
        s = dot(tangent[None], ray)
        beside = jnp.maximum(jnp.maximum(lines.extent[None, :, 0] - s, s - lines.extent[None, :, 1]), 0)
        squares = jnp.where(lines.valid[None], across**2 + beside**2, FARTHEST**2)
        ray = place[:, None] - circles.center[None]
        rim = jnp.abs(jnp.sqrt(dot(ray, ray)) - circles.radius[None])
        rim = jnp.min(jnp.where(circles.valid[None], rim, FARTHEST), -1, initial=FARTHEST)
        return jnp.minimum(jnp.sqrt(jnp.min(squares, -1, initial=FARTHEST**2)), rim)

    return LikelihoodField(distance=jax.lax.map(of_column, along), origin=low, cell=cell)


def _bounds(line_map: LineMap) -> tuple[Float[Array, "2"], Float[Array, "2"]]:
    """Corners of what holds the map, with room around it."""
    lines, circles = line_map.lines, line_map.circles
    points = jnp.concatenate([lines.begin, lines.end, circles.center])
    valid = jnp.concatenate([lines.valid, lines.valid, circles.valid])[:, None]
    any_ = jnp.any(valid)
    low = jnp.where(any_, jnp.min(jnp.where(valid, points, jnp.inf), 0), -1)
    high = jnp.where(any_, jnp.max(jnp.where(valid, points, -jnp.inf), 0), 1)
    return low - FARTHEST, high + FARTHEST


def distances(field: LikelihoodField, points: Float[Array, "N 2"]) -> Float[Array, " N"]:
    """Distances of `points` (world, m) to the nearest primitive of the map of a `field`, m; `FARTHEST` outside."""
    index = jnp.floor((points - field.origin[None]) / field.cell).astype(jnp.int32)
    size = field.distance.shape[0]
    inside = jnp.all((index >= 0) & (index < size), -1)
    index = jnp.clip(index, 0, size - 1)
    return jnp.where(inside, field.distance[index[:, 0], index[:, 1]], FARTHEST)


def log_likelihood(
    field: LikelihoodField,
    points: Float[Array, "N 2"],
    valid: Bool[Array, " N"],
    pose: Float[Array, "3"],
    sigma: Number,
) -> Float[Array, ""]:
    """How well points seen from a pose fit the map, discounted; zero is best.

    Args:
      field: of the map.
      points: in the frame of the robot, m. Shape `[N, 2]`.
      valid: those that count. Shape `[N]`.
      pose: of the robot.
      sigma: of the distances, m: of the size of the steps of the search.

    Returns:
      The logarithm of a likelihood, but for a constant; never positive.
    """
    turned = rotate(pose[2], points)
    squares = (distances(field, turned + pose[None, :2]) / sigma) ** 2
    return -0.5 * DISCOUNT * jnp.sum(jnp.where(valid, jnp.minimum(squares, WORST), 0))


def thinned(points: Float[Array, "N d"], valid: Bool[Array, " N"]) -> tuple[Float[Array, "B d"], Bool[Array, " B"]]:
    """At most `BEAMS` of the `points` and of what is `valid` of them, evenly spread."""
    n = points.shape[0]
    index = np.linspace(0, n - 1, min(BEAMS, n)).round().astype(int)
    return points[index], valid[index]


def search(
    field: LikelihoodField,
    points: Float[Array, "N 2"],
    valid: Bool[Array, " N"],
    mean: Float[Array, "3"],
    root: Float[Array, "3 3"],
    *,
    counts: Counts,
) -> Float[Array, "3"]:
    """The pose that explains a scan best, of many around a prior: level by level on finer grids.

    A grid is one of the prior's own: its axes are the columns of the root of its covariance, so that it is as wide as
    the prior is uncertain, `REACH` sigmas to either side.

    Args:
      field: of the map.
      points: of the scan, `thinned`, in the frame of the robot, m.
      valid: those that count.
      mean: of the prior.
      root: a square root of the prior's covariance.
      counts: nodes of the grids.

    Returns:
      The pose of the best node of the finest grid. m, m, rad. Shape `[3]`.
    """
    at = jnp.zeros(3, mean.dtype)  # in sigmas
    span = jnp.full(3, REACH, mean.dtype)
    for of_position, of_heading in counts:
        axes = [np.linspace(-1, 1, n) for n in (of_position, of_position, of_heading)]
        nodes = jnp.asarray(np.stack(np.meshgrid(*axes, indexing="ij"), -1).reshape(-1, 3), mean.dtype)
        z = at[None] + span[None] * nodes
        step = 2 * span / jnp.asarray([of_position - 1, of_position - 1, of_heading - 1], mean.dtype)
        # A step in heading moves points at some metres.
        moved = jnp.sqrt(jnp.sum((root * step[None]) ** 2, -1))
        sigma = jnp.clip(0.5 * jnp.max(moved[:2]), field.cell, FARTHEST / 3)

        def score(z: Float[Array, "3"], sigma: Float[Array, ""] = sigma) -> Float[Array, ""]:
            pose = mean + jnp.sum(root * z[None], -1)
            return log_likelihood(field, points, valid, pose, sigma) - 0.5 * jnp.sum(z * z)

        scores = jax.vmap(score)(z)
        at = z[jnp.argmax(scores)]
        span = step / 2 * 1.5
    pose = mean + jnp.sum(root * at[None], -1)
    return pose.at[2].set(wrap_angle(pose[2]))
