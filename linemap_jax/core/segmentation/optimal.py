"""The runs that explain a scan best, by dynamic programming. Not in the paper.

Without a budget the result is that of `incremental.segment`: runs of points, whose lines are then measured as ever.
With a budget of vertices the lines are those of a polyline, chains of which share their corners.
"""

import dataclasses

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int

from linemap_jax.core.frames import dot, perp, unit
from linemap_jax.core.runs import Runs
from linemap_jax.core.segmentation.incremental import Run, follow, gap_gate
from linemap_jax.core.segmentation.polyline import BEGIN, CORNER, END, LEFT, Polyline, Sweep, best_polyline, refine
from linemap_jax.core.sensor import Points
from linemap_jax.core.settings import SensorNoise, Thresholds
from linemap_jax.core.slots import all_true, choose, earliest_true, latest_true
from linemap_jax.core.state import Lines, Pose, pytree

FALSE_CORNERS = 0.1
"""That noise makes in a scan of one wall, at most. With 1 the price would be that of the Bayesian information
criterion, which divides walls of a dozen points in one scan of twenty."""
LEAST_POINTS = 3
"""Of a line without a budget, which the paper asks for too."""
SLANT_BEAMS = 4
"""To either side, from which it is told how steep a wall stands to a beam."""
LEFT_WEIGHT = 2 / 3
"""With a budget, what is least is the root mean square of the residuals plus this times the share of the points that no
line covers, m. A point then costs 2 `LEFT_WEIGHT` times that root mean square, as a first search gives it, m^2."""
FIRST_PRICE = 0.1
"""Of such a point in the first search, m^2."""
BUDGET_GAP_DISTANCE = 1.0
"""With a budget, points of a line are no farther apart than this, m, or than `BUDGET_GAP_SPACINGS` arcs between two
beams: where lines are scarce, one may have to span what `Thresholds.gap_distance` would divide."""
BUDGET_GAP_SPACINGS = 12.0
BUDGET_GAP_BEAMS = 1.5
"""With a budget no line passes a beam without a return."""
WHOLE = 1e3
"""Price of a point of a closed ring, m^2: it is one surface all round, and nothing stands before it."""
PINNED = 1e2
"""Weight of the vertex where a ring is cut open, 1/m."""
LEAST_RING = 8
"""Points of a closed ring, at least."""


@pytree
class Segmented:
    """The runs of a scan, and with a budget the lines of its polyline."""

    points: Points
    """Points of the scan; of a closed ring, in the order from where it was cut open."""
    ends: Bool[Array, " N"]
    """The last points of runs."""
    run: Run
    """At the last point of a run, its sums."""
    on_line: Bool[Array, " N"]
    """False for points that are left to the circles."""
    goes_on: Bool[Array, " N"]
    """The last points of runs behind which the next one begins, without a gap."""
    breaks: Int[Array, "3"]
    """How many points broke a run by criteria 1, 2 and 3."""
    begin: Float[Array, "V 2"]
    """Begin points of the lines of the polyline, in the coordinates of the points, m."""
    end: Float[Array, "V 2"]
    """Their other end points, m."""


def segment(points: Points, thresholds: Thresholds, noise: SensorNoise, *, max_vertices: int | None) -> Segmented:
    """Divide the points of a scan into the runs that explain them best.

    Without a budget residuals count in sigmas. A vertex has two coordinates, and costs 2 log(number of points /
    `FALSE_CORNERS`), which is what noise gains by them at one of the points with a probability of `FALSE_CORNERS`, at
    most. A point that is left to the circles costs `line_sigmas`^2.

    Args:
      points: the points of the scan.
      thresholds: criteria 1 and 3, and `line_sigmas`; not used with a budget, save that there is one.
      noise: of the sensor.
      max_vertices: the largest number of vertices; None lets the criterion decide.

    Returns:
      The points, and which of them end runs.

    Raises:
      ValueError: at trace time, if the budget is not a whole number of two or more.
    """
    if max_vertices is None:
        return _by_criterion(points, thresholds, noise)
    if isinstance(max_vertices, bool) or not isinstance(max_vertices, int) or max_vertices < 2:
        raise ValueError(f"max_vertices must be a whole number of 2 or more, not {max_vertices!r}")
    return _by_budget(points, noise, max_vertices)


def _by_criterion(points: Points, thresholds: Thresholds, noise: SensorNoise) -> Segmented:
    near, adjacent = follow(points, lambda arc: gap_gate(arc, thresholds, noise), thresholds.gap_beams)
    sweep, price = priced(points, near & adjacent, thresholds, noise)
    kind, _, _ = best_polyline(sweep, price, max_vertices=None, min_points=LEAST_POINTS)
    nowhere = jnp.zeros((0, 2), points.range.dtype)
    return _segmented(points, kind, near, adjacent, nowhere, nowhere)


def priced(
    points: Points, follows: Bool[Array, " N"], thresholds: Thresholds, noise: SensorNoise
) -> tuple[Sweep, Float[Array, ""]]:
    """What is searched without a budget, and the price of a vertex.

    Args:
      points: the points of the scan.
      follows: whether a line may hold a point and the one before.
      thresholds: `line_sigmas`.
      noise: of the sensor.

    Returns:
      The sweep, whose residuals count in sigmas; the price of a vertex, on the same scale.
    """
    angle, one = _angle(points), jnp.ones_like(points.range)
    sweep = Sweep(
        angle=angle,
        range=jnp.where(points.valid, points.range, 1),
        weight=1 / _spread(points.range, angle, follows, noise),
        price=one * thresholds.line_sigmas**2,
        follows=follows,
        again=jnp.zeros_like(follows),
        valid=points.valid,
    )
    count = jnp.maximum(jnp.sum(points.valid), 2).astype(one.dtype)
    return sweep, 2 * jnp.log(count / FALSE_CORNERS)


def _spread(
    range_: Float[Array, " N"], angle: Float[Array, " N"], follows: Bool[Array, " N"], noise: SensorNoise
) -> Float[Array, " N"]:
    """Standard deviation of ranges along their beams, m: an error of the bearing tells where a wall stands at a slant.

    The slant is that of the points a few beams on either side, as far as each follows the one before.
    """
    index = jnp.arange(range_.shape[0], dtype=jnp.int32)
    first = latest_true(~follows | (index == 0))
    last = jnp.concatenate([earliest_true(~follows)[1:] - 1, index[-1:]])

    def slope_to(other: Int[Array, " N"]) -> Float[Array, " N"]:
        turn = angle[other] - angle
        return jnp.where(turn == 0, 0, jnp.abs((range_[other] - range_) / jnp.where(turn == 0, 1, turn)))

    behind, ahead = jnp.maximum(index - SLANT_BEAMS, first), jnp.minimum(index + SLANT_BEAMS, last)
    slope = jnp.maximum(slope_to(behind), slope_to(ahead))
    return jnp.sqrt(noise.range_sigma**2 + (noise.bearing_sigma * slope) ** 2)


def _by_budget(points: Points, noise: SensorNoise, max_vertices: int) -> Segmented:
    dtype = points.range.dtype
    n = points.valid.shape[0]
    count = jnp.sum(points.valid, dtype=jnp.int32)
    # A scan of all round ends a beam before its first one, or sees that twice.
    missing = 2 * jnp.pi - jnp.sum(jnp.where(points.valid, points.turn, 0))
    ring_count = jnp.where(jnp.abs(missing) < points.spacing / 2, count - 1, count)

    near, adjacent = follow(points, budget_gap, BUDGET_GAP_BEAMS)
    follows = near & adjacent
    last = jnp.maximum(ring_count - 1, 0)
    across = points.position[0] - points.position[last]
    closed = dot(across, across) < budget_gap(jnp.minimum(points.range[0], points.range[last]) * points.spacing) ** 2
    closed &= (jnp.abs(missing) < BUDGET_GAP_BEAMS * points.spacing) & (count > LEAST_RING)
    closed &= jnp.all(follows | ~points.valid | (jnp.arange(n) == 0))

    angle = _angle(points)
    place = jnp.arange(n + 1, dtype=jnp.int32)
    straight = jnp.minimum(place, n - 1)

    def order_from(cut: Array, opened: Array) -> Int[Array, " M"]:
        """The point at each place, of a ring from some point on, and that one once more at its end."""
        return jnp.where(opened, jnp.mod(cut + place, jnp.maximum(ring_count, 1)), straight)

    def sweep_from(cut: Array, inverse: Array, opened: Array, price: Array) -> Sweep:
        of = order_from(cut, opened)
        valid = jnp.where(opened, place <= ring_count, place < count)
        again = opened & (place == ring_count)
        pinned = again | (opened & (place == 0))
        around = jnp.where(again, 2 * jnp.pi, jnp.mod(angle[of] - angle[cut], 2 * jnp.pi))
        return Sweep(
            angle=jnp.where(opened, around, angle[straight]).astype(dtype),
            range=jnp.where(valid, jnp.where(pinned, 1 / inverse, points.range[of]), 1),
            weight=jnp.where(pinned, PINNED, 1).astype(dtype),
            price=jnp.broadcast_to(price, place.shape),
            follows=jnp.where(opened, place > 0, follows[straight]),
            again=again,
            valid=valid,
        )

    def search(state: tuple) -> tuple:
        cut, inverse, opened, price, _, _ = state
        sweep = sweep_from(cut, inverse, opened, price)
        zero = jnp.zeros((), dtype)
        # The vertex where a ring is cut open stands at both ends.
        within = max_vertices + opened.astype(jnp.int32)
        kind, value, cost = best_polyline(sweep, zero, max_vertices=max_vertices + 1, min_points=2, within=within)
        # A ring is cut open at the corner farthest from its two ends, if there is one.
        off = jnp.where(kind == CORNER, jnp.abs(2 * place - count), 4 * n)
        corner = jnp.min(jnp.where(off == jnp.min(off), place, n - 1))
        opens = closed & ~opened & jnp.any(kind == CORNER)
        cut, inverse = jnp.where(opens, corner, cut), jnp.where(opens, value[corner], inverse)
        left = jnp.sum(sweep.valid & (kind == LEFT))
        mean_square = jnp.maximum(cost - left * price, 0) / jnp.maximum(count - left, 1)
        rms = jnp.maximum(jnp.sqrt(mean_square), noise.range_sigma)
        price = jnp.where(closed, WHOLE, 2 * LEFT_WEIGHT * rms).astype(dtype)
        return cut, inverse, opened | opens, price, kind, value

    nothing = jnp.zeros(n + 1, jnp.int32), jnp.zeros(n + 1, dtype)
    price = jnp.where(closed, WHOLE, FIRST_PRICE).astype(dtype)
    zero = jnp.zeros((), jnp.int32)
    state = (zero, jnp.ones((), dtype), jnp.zeros((), bool), price, *nothing)
    # Twice: once to learn the price, or where to cut.
    cut, inverse, opened, price, kind, value = jax.lax.fori_loop(0, 2, lambda _, state: search(state), state)

    sweep = sweep_from(cut, inverse, opened, price)
    ring = opened & (kind[0] == BEGIN) & (kind[ring_count] == END)
    of = order_from(cut, opened)
    range_ = jnp.where(sweep.valid, points.range[of], 1)
    covered = sweep.valid & (kind != LEFT) & ~(opened & (place == ring_count))
    line, _ = refine(
        _vertices(sweep, kind, value, max_vertices + 1), sweep.angle, range_, covered, points.spacing, ring
    )

    first, second = points.beam[of[0]], points.beam[of[1]]
    sense = jnp.where(dot(perp(first), second) < 0, -1, 1)
    direction = jnp.cos(line.angle)[:, None] * first[None] + (sense * jnp.sin(line.angle))[:, None] * perp(first)[None]
    corner = points.laser[None] + direction / line.inverse[:, None]
    begins = all_true(line.valid & ~line.is_end, max_vertices)
    begins = jnp.minimum(begins, max_vertices - 1)

    rolled = jnp.where(place[:n] < ring_count, of[:n], place[:n])
    turn = jnp.where(opened & (place[:n] > 0), points.spacing, points.turn)
    moved = dataclasses.replace(
        points,
        position=points.position[rolled],
        beam=points.beam[rolled],
        range=points.range[rolled],
        turn=turn,
        index=points.index[rolled],
        jac_pose=points.jac_pose[rolled],
        jac_measurement=points.jac_measurement[rolled],
    )
    return _segmented(moved, kind[:n], near | opened, adjacent | opened, corner[begins], corner[begins + 1])


def budget_gap(arc: Float[Array, "*s"]) -> Float[Array, "*s"]:
    """With a budget, the largest distance between successive points, m, by the `arc` between their beams, m."""
    return jnp.maximum(BUDGET_GAP_DISTANCE, BUDGET_GAP_SPACINGS * arc)


def _vertices(sweep: Sweep, kind: Int[Array, " N"], inverse: Float[Array, " N"], size: int) -> Polyline:
    """The vertices among the points."""
    at = all_true((kind == BEGIN) | (kind == CORNER) | (kind == END), size)
    valid = at < kind.shape[0]
    at = jnp.where(valid, at, 0)
    return Polyline(
        # Free slots stand behind all others.
        angle=jnp.where(valid, sweep.angle[at], 1e3),
        inverse=jnp.where(valid, inverse[at], 1),
        valid=valid,
        is_begin=valid & (kind[at] == BEGIN),
        is_end=valid & (kind[at] == END),
    )


def _segmented(
    points: Points,
    kind: Int[Array, " N"],
    near: Bool[Array, " N"],
    adjacent: Bool[Array, " N"],
    begin: Float[Array, "V 2"],
    end: Float[Array, "V 2"],
) -> Segmented:
    """The runs that a polyline makes of the points; a corner belongs to the run before it."""
    last = jnp.concatenate([points.valid[1:] != points.valid[:-1], points.valid[-1:]])
    ends = points.valid & ((kind == END) | (kind == CORNER) | (kind == LEFT) | last)
    starts = jnp.concatenate([jnp.ones(1, bool), ends[:-1]])
    breaks = starts & points.valid & (jnp.arange(points.valid.shape[0]) > 0)
    counts = [breaks & ~near, breaks & near & adjacent, breaks & near & ~adjacent]
    return Segmented(
        points=points,
        ends=ends,
        run=_sums(points.position, starts),
        on_line=kind != LEFT,
        goes_on=jnp.concatenate([(near & adjacent)[1:], jnp.zeros(1, bool)]),
        breaks=jnp.stack([jnp.sum(count, dtype=jnp.int32) for count in counts]),
        begin=begin,
        end=end,
    )


def _sums(position: Float[Array, "N 2"], starts: Bool[Array, " N"]) -> Run:
    """The running sums of each run, from its first point."""

    def add(run: Array, each: tuple[Array, Array]) -> tuple[Array, Array]:
        point, starts = each
        old = Run(*run)
        x0, y0 = jnp.where(starts, point[0], old.x0), jnp.where(starts, point[1], old.y0)
        x, y = point[0] - x0, point[1] - y0
        old = Run(*jnp.where(starts, 0, run))
        run = jnp.stack(
            Run(
                n=old.n + 1,
                x0=x0,
                y0=y0,
                rx=old.rx + x,
                ry=old.ry + y,
                rxx=old.rxx + x * x,
                ryy=old.ryy + y * y,
                rxy=old.rxy + x * y,
            )
        )
        return run, run

    _, running = jax.lax.scan(add, jnp.zeros(len(Run._fields), position.dtype), (position, starts))
    return Run(*jnp.moveaxis(running, -1, 0))


def lines_of_polyline(lines: Lines, segmented: Segmented, pose: Pose) -> Lines:
    """The lines of the runs, laid through the vertices of the polyline.

    Their covariances remain those of the most likely lines of the same points.

    Args:
      lines: of the runs, from `measure_lines`.
      segmented: by `segment` with a budget.
      pose: of the robot.

    Returns:
      The lines with other offsets, angles and end points.
    """
    slot = jnp.minimum(jnp.arange(lines.valid.shape[0]), segmented.begin.shape[0] - 1)
    begin, end = segmented.begin[slot], segmented.end[slot]
    along = end - begin
    length = jnp.sqrt(dot(along, along))
    tangent = along / jnp.where(length > 0, length, 1)[:, None]
    angle = jnp.arctan2(-tangent[:, 0], tangent[:, 1])
    normal = unit(angle)  # as `Lines` will have it
    from_anchor = begin - (lines.anchor - pose.mean[None, :2])
    start = dot(perp(normal), from_anchor)
    laid = dataclasses.replace(
        lines,
        offset=dot(normal, from_anchor),
        angle=angle,
        first_angle=angle,
        extent=jnp.stack([start, start + length], -1),
    )
    return choose(lines.valid, laid, lines)


def join_corners(lines: Lines, runs: Runs, segmented: Segmented, pose: Pose) -> Lines:
    """Let neighbouring lines end where they cross, if that is between the last beam of one and the other's first.

    Args:
      lines: of the runs, in the order of the sweep.
      runs: their points.
      segmented: by `segment`.
      pose: of the robot.

    Returns:
      The lines with other end points.
    """
    points = segmented.points
    count = lines.valid.shape[0]
    behind = jnp.minimum(jnp.arange(count) + 1, count - 1)
    pair = lines.valid & lines.valid[behind] & segmented.goes_on[runs.last] & (jnp.arange(count) + 1 < count)
    pair &= runs.first[behind] == runs.last + 1
    normal, tangent = lines.normal, lines.tangent
    # Where the next line meets this one, along this one and along the next
    between = dot(normal[behind], tangent)
    crosses = jnp.abs(between) > 1e-3
    step = lines.anchor[behind] - lines.anchor + (lines.offset[behind, None] * normal[behind])
    foot = lines.offset[:, None] * normal
    along = dot(normal[behind], step - foot) / jnp.where(crosses, between, 1)
    corner = foot + along[:, None] * tangent  # from the anchor
    along_behind = dot(tangent[behind], corner - (lines.anchor[behind] - lines.anchor))
    from_laser = corner + (lines.anchor - pose.mean[None, :2]) - points.laser[None]
    before_beam, after_beam = points.beam[runs.last], points.beam[runs.first[behind]]
    sense = jnp.sign(dot(perp(before_beam), after_beam))
    inside = (sense * dot(perp(before_beam), from_laser) >= 0) & (sense * dot(perp(from_laser), after_beam) >= 0)
    inside &= dot(from_laser, before_beam) > 0
    pair &= crosses & inside & (along > lines.extent[:, 0]) & (along_behind < lines.extent[behind, 1])
    ends = jnp.where(pair, along, lines.extent[:, 1])
    ahead = jnp.maximum(jnp.arange(count) - 1, 0)
    is_behind = pair[ahead] & (jnp.arange(count) > 0)
    begins = jnp.where(is_behind, along_behind[ahead], lines.extent[:, 0])
    return dataclasses.replace(lines, extent=jnp.stack([begins, ends], -1))


def _angle(points: Points) -> Float[Array, " N"]:
    """The angle of each beam from the first one, growing."""

    def add(total: Array, turn: Array) -> tuple[Array, Array]:
        return total + turn, total + turn

    turn = jnp.where(points.valid & (jnp.arange(points.valid.shape[0]) > 0), points.turn, 0)
    return jax.lax.scan(add, jnp.zeros((), turn.dtype), turn)[1]
