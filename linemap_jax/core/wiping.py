"""Section 6: what is no longer there leaves the map.

Two readings. The paper's wipe-triangle spans a whole line of the map, as fused, from the scanner, and reaches a little
behind it. The default goes by what this scan's beams passed through: between two neighbouring beams that both end well
beyond a line, the line is gone. That wipes no more than the scan saw, needs nothing behind what vanished, opens doors,
and is narrowed by a beam and by the uncertainty of pose, line and range.

Both answer the same question, which stretches of a line are gone, and share what follows from it.
"""

import dataclasses
from collections.abc import Callable

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int

from linemap_jax.core.frames import dot, perp, reanchor
from linemap_jax.core.matching import normal_variance
from linemap_jax.core.propagation import quadratic
from linemap_jax.core.sensor import Points
from linemap_jax.core.settings import Number, Rules, SensorNoise, Thresholds
from linemap_jax.core.slots import all_true, computed_once, first_true, put, rank_of_true, take
from linemap_jax.core.state import Circles, Lines, Pose, pytree

NEAR_PARALLEL = 1e-6
"""Cosine below which a beam and a line do not meet."""
NEAREST_BASE = 1e-3
"""m. A line this close to the scanner's own position spans no triangle; no distance counts for less."""


@pytree
class Swath:
    """What the returns of a scan prove to be free."""

    points: Points
    """Points of the scan."""
    reach: Float[Array, " N"]
    """Range up to which the beam wipes, with the extension behind the line that it met; 0 if it met none. m."""
    own: Int[Array, " N"]
    """Slot of the map's line that the beam measures, -1 for none."""
    times: Int[Array, " N"]
    """How often that line was detected, 0 for none."""
    behind: Float[Array, "N 2"]
    """Normal of the new line that the beam ended on, away from the scanner; zero where it is none of the map."""
    joined: Bool[Array, " N"]
    """Whether the beam is a neighbour of the next one."""
    robot: Float[Array, "2"]
    """Position of the robot in the world, m."""


@pytree
class Triangles:
    """Wipe-triangles, section 6.2: the scanner and the pushed-back ends of a line, from the scanner."""

    first: Float[Array, "L 2"]
    """Corner behind the begin of the line that the scan saw, from the laser, m."""
    second: Float[Array, "L 2"]
    """Corner behind its end, from the laser, m."""
    own: Int[Array, " L"]
    """Slot of the line that spans it."""
    valid: Bool[Array, " L"]
    """Which slots are in use."""
    apex: Float[Array, "2"]
    """The laser, from the robot, m."""
    robot: Float[Array, "2"]
    """Position of the robot in the world, m."""


@pytree
class Wiped:
    """Counts of what wiping did to lines."""

    trimmed: Int[Array, ""]
    """Lines shortened."""
    split: Int[Array, ""]
    """Lines cut into several."""
    deleted: Int[Array, ""]
    """Lines gone."""
    overflow: Bool[Array, ""]
    """Whether a fragment found no free slot."""


Stretches = tuple[Float[Array, " M"], Float[Array, " M"], Bool[Array, " M"]]
"""Begin and end of stretches along a line, metres from its anchor, and which of them count."""


def swath_of_scan(
    points: Points,
    pose: Pose,
    line_of_point: Int[Array, " N"],
    found: Lines,
    own: Int[Array, " L"],
    times: Int[Array, " L"],
    thresholds: Thresholds,
) -> Swath:
    """What the beams of a scan passed through.

    Args:
      points: the points of the scan.
      pose: of the robot.
      line_of_point: the new line of each point, -1 for none.
      found: the new lines.
      own: for each new line the line of the map that it is, or may be; -1 for none.
      times: how often that line was detected; 0 if the new line is no part of it.
      thresholds: `wipe_extension`, `gap_beams`.

    Returns:
      What `passed_through` needs, of `N` beams.
    """
    to_line = found.anchor - (pose.mean[:2] + points.laser)[None]
    ahead = found.offset + dot(found.normal, to_line)  # each line from the scanner
    across = jnp.abs(ahead)
    pushed = jnp.where(across > NEAREST_BASE, 1 + thresholds.wipe_extension / jnp.maximum(across, NEAREST_BASE), 0)
    followed = (points.turn < thresholds.gap_beams * points.spacing) & points.valid
    in_line = line_of_point >= 0
    behind = jnp.where((own >= 0)[:, None], jnp.sign(ahead)[:, None] * found.normal, 0)
    return Swath(
        points=points,
        reach=jnp.where(in_line, points.range * pushed[line_of_point], 0),
        own=jnp.where(in_line, own[line_of_point], -1),
        times=jnp.where(in_line, times[line_of_point], 0),
        behind=jnp.where(in_line[:, None], behind[line_of_point], 0),
        joined=jnp.concatenate([followed[1:], jnp.zeros(1, bool)]),
        robot=pose.mean[:2],
    )


def passed_through(
    line: Lines,
    slot: Int[Array, ""],
    swath: Swath,
    cov_pose: Float[Array, "3 3"],
    thresholds: Thresholds,
    noise: SensorNoise,
    rules: Rules,
) -> Stretches:
    """The stretches of a line of the map between neighbouring beams that both passed through it.

    A beam passed through if it ended beyond the line by `wipe_sigmas` of the predicted spread of that distance, which
    holds the range, the line, the pose and the bearing; and in any case by `match_distance`. A beam that met another
    line reaches `wipe_extension` behind that, to wipe noise; but not what was detected more often than the line that it
    met, nor from one line to the next: of a wall that is seen edge-on two beams may meet no more than the walls at its
    corners. A beam never wipes the line that it is a measurement of.

    Args:
      line: one line, no batch axis.
      slot: where it stands in the map.
      swath: the beams.
      cov_pose: covariance of the pose.
      thresholds: `wipe_...`, `match_distance`.
      noise: of the sensor.
      rules: `tell_sides`.

    Returns:
      Begin and end of each stretch, m from the anchor, and whether it is gone. Shapes `[N - 1]`.
    """
    points = swath.points
    normal, tangent = line.normal, line.tangent
    start = swath.robot - line.anchor + points.laser
    incidence = dot(points.beam, normal[None])
    sideways = dot(points.beam, tangent[None])
    meets = jnp.abs(incidence) > NEAR_PARALLEL
    distance = (line.offset - dot(normal, start)) / jnp.where(meets, incidence, 1)
    along = dot(tangent, start) + distance * sideways

    # n^T F C_pose F^T n with F = [I, perp(hit)]
    lever = dot(perp(points.laser[None] + distance[:, None] * points.beam), normal[None])
    by_pose = quadratic(normal, cov_pose[:2, :2]) + 2 * lever * dot(normal, cov_pose[:2, 2]) + lever**2 * cov_pose[2, 2]
    by_bearing = (distance * noise.bearing_sigma * sideways) ** 2
    # How far beyond the line the beam ended, along the line's normal, against the spread of that.
    beyond = (points.range - distance) * jnp.abs(incidence)
    spread = (noise.range_sigma * incidence) ** 2 + normal_variance(line.cov, along) + by_pose + by_bearing
    margin = jnp.maximum(thresholds.wipe_sigmas**2 * spread, thresholds.match_distance**2)
    passed = (beyond > 0) & (beyond**2 > margin)
    behind = (distance < swath.reach) & (swath.times >= line.times_detected)
    behind = behind & (incidence > 0) if rules.tell_sides else behind

    on_line = (along > line.extent[0]) & (along < line.extent[1])
    meets = meets & (distance > 0) & on_line & points.valid & line.valid
    meets = meets & (swath.own != slot)
    through, reached = meets & passed, meets & (passed | behind)
    of_one = through[:-1] | through[1:] | (swath.own[:-1] == swath.own[1:])
    gone = swath.joined[:-1] & reached[:-1] & reached[1:] & of_one
    return jnp.minimum(along[:-1], along[1:]), jnp.maximum(along[:-1], along[1:]), gone


def may_have_passed(
    line: Lines, slot: Int[Array, ""], swath: Swath, thresholds: Thresholds, rules: Rules
) -> Bool[Array, ""]:
    """Whether `passed_through` can find anything: false for nearly all lines of a map, and cheap to tell.

    Two beams must pass a line by `match_distance`, or reach behind it; no spread is computed, and nothing divided.

    Args:
      line: one line, no batch axis, directed.
      slot: where it stands in the map.
      swath: the beams.
      thresholds: `match_distance`.
      rules: `tell_sides`.

    Returns:
      Whether it is worth while to look.
    """
    points = swath.points
    normal, tangent = line.normal, line.tangent
    start = swath.robot - line.anchor + points.laser
    incidence = dot(points.beam, normal[None])
    # Everything below is multiplied by the absolute value of the incidence.
    to_line = jnp.sign(incidence) * (line.offset - dot(normal, start))
    from_its_side = incidence > 0
    incidence = jnp.abs(incidence)
    along = dot(tangent, start) * incidence + to_line * dot(points.beam, tangent[None])
    on_line = (along > line.extent[0] * incidence) & (along < line.extent[1] * incidence)
    passed = to_line + thresholds.match_distance < points.range * incidence
    behind = (to_line < swath.reach * incidence) & (swath.times >= line.times_detected)
    behind = behind & from_its_side if rules.tell_sides else behind
    passes = (to_line > 0) & on_line & (passed | behind) & (swath.own != slot) & points.valid
    return line.valid & (jnp.sum(passes) >= 2)


def triangles_of_scan(
    points: Points, pose: Pose, model: Lines, targets: Int[Array, " L"], thresholds: Thresholds
) -> Triangles:
    """Section 6.2: a triangle for each line of the map that this scan added or improved.

    Args:
      points: the points of the scan.
      pose: of the robot.
      model: the lines of the map.
      targets: the slots of those lines, -1 for none.
      thresholds: `wipe_extension`.

    Returns:
      `L` triangles; not valid for slots of -1, and where the laser lies on the line.
    """
    base = take(model, targets)
    apex = (pose.mean[:2] + points.laser)[None]
    step = base.anchor - apex
    across = jnp.abs(base.offset + dot(base.normal, step))
    push = 1 + thresholds.wipe_extension / jnp.maximum(across, NEAREST_BASE)
    foot = step + base.offset[:, None] * base.normal
    ends = [push[:, None] * (foot + base.extent[:, i, None] * base.tangent) for i in (0, 1)]
    turns_left = _cross(ends[0], ends[1]) > 0
    return Triangles(
        first=jnp.where(turns_left[:, None], ends[0], ends[1]),
        second=jnp.where(turns_left[:, None], ends[1], ends[0]),
        own=targets,
        valid=(targets >= 0) & base.valid & (across > NEAREST_BASE),
        apex=points.laser,
        robot=pose.mean[:2],
    )


def inside_triangles(line: Lines, slot: Int[Array, ""], triangles: Triangles) -> Stretches:
    """Section 6.3: the stretches of a line inside the triangles of other lines.

    Args:
      line: one line, no batch axis.
      slot: where it stands in the map.
      triangles: of this scan.

    Returns:
      Begin and end of each stretch, m from the anchor, and whether there is one. Shapes `[L]`.
    """
    start = line.anchor - triangles.robot - triangles.apex + line.offset * line.normal
    tangent = line.tangent

    def clip(first: Array, second: Array) -> tuple[Array, Array]:
        low, high = line.extent[0], line.extent[1]
        for constant, rate in _sides(start, tangent, first, second):
            # constant + rate s > 0 inside
            bound = -constant / jnp.where(rate == 0, 1, rate)
            low = jnp.where(rate > 0, jnp.maximum(low, bound), low)
            high = jnp.where(rate < 0, jnp.minimum(high, bound), high)
            high = jnp.where((rate == 0) & (constant <= 0), low, high)
        return low, high

    low, high = jax.vmap(clip)(triangles.first, triangles.second)
    return low, high, line.valid & triangles.valid & (triangles.own != slot) & (high > low)


def var_of_cut(
    line: Lines, along: Float[Array, ""], points: Points, pose: Pose, noise: SensorNoise
) -> Float[Array, ""]:
    """Variance along a line of where beams cut it, m^2.

    That of where a beam crosses the line, and that of a uniform distribution over one beam: what is left may have ended
    anywhere up to the first beam that passed it.

    Args:
      line: one line, no batch axis.
      along: the place, m from its anchor.
      points: of the scan.
      pose: of the robot.
      noise: of the sensor.

    Returns:
      The variance, m^2.
    """
    from_robot = line.anchor - pose.mean[:2] + line.offset * line.normal + along * line.tangent
    from_laser = from_robot - points.laser
    distance2 = dot(from_laser, from_laser)
    cosine2 = dot(from_laser, line.normal) ** 2 / jnp.maximum(distance2, NEAREST_BASE**2)
    # As for the ends of new lines, 6 degrees are as grazing as matters.
    by_bearing = (noise.bearing_sigma**2 + points.spacing**2 / 12) * distance2 / jnp.maximum(cosine2, 0.01)
    by_pose = jnp.concatenate([line.tangent, dot(perp(from_robot), line.tangent)[None]])
    return quadratic(by_pose, pose.cov) + by_bearing


def wipe_lines(
    model: Lines,
    affected: Bool[Array, " K"],
    stretches: Callable[[Lines, Int[Array, ""]], Stretches],
    var_cut: Callable[[Lines, Float[Array, ""]], Float[Array, ""]],
    thresholds: Thresholds,
    *,
    share_information: bool,
) -> tuple[Lines, Wiped]:
    """Take the stretches that are gone out of the lines of the map: delete, trim, split (section 6.3).

    Fragments shorter than `min_length` go too. A line may be cut in several places.

    All fragments of a line are one and the same estimate. Where lines of the map may be merged, what was measured once
    would then count once for each of them; so they share its information, by their lengths. Covariances P / w_i with
    weights that sum to one bound the fragments as if they were independent, and make P again of all of them (the bound
    of covariance intersection). The paper, which merges nothing, leaves the covariance as it is.

    Args:
      model: the lines of the map.
      affected: the lines that may have to be cut; the others are not looked at.
      stretches: which stretches of a line are gone, given the line (no batch axis) and its slot.
      var_cut: variance of an end that was cut, m^2, given the line and where the end is, m from the anchor.
      thresholds: `min_length`.
      share_information: whether the fragments of a line do.

    Returns:
      The lines of the map, with fragments in free slots; and how many were trimmed, split and deleted.
    """
    k = model.valid.shape[0]

    def unfinished(carry: tuple[Lines, Array, Array]) -> Array:
        return jnp.any(carry[1])

    def step(carry: tuple[Lines, Array, Array]) -> tuple[Lines, Array, Array]:
        lines, todo, counts = carry
        slot = first_true(todo)
        # Lines are cut as they stood before wiping: what a split has put into a free slot is done with.
        line = take(lines, slot)
        gone = stretches(line, slot)
        begin, end, keep = remaining(line.extent, gone, thresholds.min_length)
        rank = rank_of_true(keep)
        pieces = jnp.sum(keep)
        free = all_true(~lines.valid, begin.shape[0])
        into = jnp.where(rank == 0, slot, free[rank - 1])
        length = jnp.where(keep, jnp.maximum(end - begin, NEAREST_BASE), 0)
        share = jnp.where(keep, length / jnp.maximum(jnp.sum(length), NEAREST_BASE), 1)
        share = share if share_information else jnp.ones_like(share)
        ends = jnp.stack([begin, end], -1)
        var_ends = jax.vmap(jax.vmap(var_cut, (None, 0)), (None, 0))(line, ends)
        var_ends = jnp.where(ends == line.extent[None], line.var_extent[None], var_ends)
        fragments = jax.vmap(_fragment, (None, 0, 0, 0))(line, ends, var_ends, share)
        cut = jnp.any(gone[2])
        lines = dataclasses.replace(lines, valid=lines.valid.at[slot].set(~cut))
        lines = put(lines, jnp.where(keep & cut & (into < k), into, -1), fragments)
        lost = jnp.any(keep & (into == k))
        outcome = jnp.stack([pieces == 1, pieces > 1, pieces == 0, lost]) & cut
        return lines, todo.at[slot].set(False), counts + outcome.astype(counts.dtype)

    model, _, counts = jax.lax.while_loop(unfinished, step, (model, affected, jnp.zeros(4, jnp.int32)))
    return model, Wiped(trimmed=counts[0], split=counts[1], deleted=counts[2], overflow=counts[3] > 0)


def remaining(
    extent: Float[Array, "2"], gone: Stretches, min_length: Number
) -> tuple[Float[Array, " P"], Float[Array, " P"], Bool[Array, " P"]]:
    """What is left of a segment, in order along it.

    Args:
      extent: its begin and end, m.
      gone: `M` stretches in any order; they may overlap.
      min_length: of a fragment that is kept, m.

    Returns:
      Begins and ends of `P = M + 1` candidates, and which of them are fragments to keep.
    """
    low, high, counts = gone
    low, high = jax.lax.sort([jnp.where(counts, low, jnp.inf), jnp.where(counts, high, -jnp.inf)], num_keys=1)
    covered = jnp.maximum(jax.lax.cummax(high), extent[0])
    begin = jnp.concatenate([extent[:1], covered])
    end = jnp.minimum(jnp.concatenate([low, extent[1:]]), extent[1])
    # The sentinels of stretches that do not count end at the segment's end; only the last such piece is one.
    last = jnp.concatenate([jnp.isfinite(low), jnp.ones(1, bool)])
    keep = last & (end - begin >= min_length)
    return begin, jnp.where(keep, end, begin), keep


def _fragment(line: Lines, extent: Float[Array, "2"], var_extent: Float[Array, "2"], share: Float[Array, ""]) -> Lines:
    """A part of a line with a share of its information, anchored at its own middle."""
    middle = line.anchor + line.offset * line.normal + (extent[0] + extent[1]) / 2 * line.tangent
    part = dataclasses.replace(
        line,
        cov_independent=line.cov_independent / share,
        extent=extent,
        var_extent=var_extent,
        valid=jnp.ones_like(line.valid),
    )
    return reanchor(part, middle)


def passed_circles(
    circles: Circles, swath: Swath, cov_pose: Float[Array, "3 3"], thresholds: Thresholds, noise: SensorNoise
) -> Bool[Array, " C"]:
    """Which circles of the map the beams of a scan prove to be gone.

    A circle is gone if every beam through the window in which it may stand, at least two of them, ends beyond it; and
    if no two of them, nor the last of them and the edge of that window, are so far apart that it may stand between: a
    pole at the rim of what the scanner sees, or among beams without a return, stays. A beam that meets it by less than
    beams err by may have gone past, so that a thin pole far away stays too. Where something stood by a wall, beams that
    measure this line of the map end beyond it if its centre lies in front of the line.

    Args:
      circles: the `C` circles of the map.
      swath: the beams.
      cov_pose: covariance of the pose: m^2, m rad, rad^2. Shape `[3, 3]`.
      thresholds: `wipe_sigmas`.
      noise: of the sensor.

    Returns:
      Which of them are gone. Shape `[C]`.
    """
    # Points run counter-clockwise, from the right to the left of what stands before them; the first follows the last.
    n = jnp.sum(swath.points.valid, dtype=jnp.int32)
    index = jnp.arange(swath.points.valid.shape[0], dtype=jnp.int32)
    following = jnp.where(index + 1 < n, index + 1, 0)
    beams, next_beams = swath.points.beam, swath.points.beam[following]
    follows = swath.points.valid[following]

    def window(center: Array) -> tuple[Array, Array, Array, Array]:
        """Where a circle is seen, and what its place errs by aside and in depth, and beams aside."""
        from_robot = center - swath.robot
        to_center = from_robot - swath.points.laser
        distance = jnp.sqrt(dot(to_center, to_center))
        ahead = to_center / jnp.where(distance > 0, distance, 1)

        def spread(direction: Array) -> Array:
            jac = jnp.concatenate([direction, dot(direction, perp(from_robot))[None]])
            return quadratic(jac, cov_pose)

        slack = distance * noise.bearing_sigma
        lateral = jnp.sqrt(spread(perp(ahead)) + slack**2)
        depth = jnp.sqrt(spread(ahead) + noise.range_sigma**2)
        unsure, deep, slack = (thresholds.wipe_sigmas * sigma for sigma in (lateral, depth, slack))
        return to_center, unsure, deep, slack

    def in_window(beams: Array, to_center: Array, half: Array) -> tuple[Array, Array, Array]:
        """How far along the beams and aside of them the centre lies, and which of them go through the window."""
        along, aside = dot(beams, to_center[None]), _cross(beams, to_center[None])
        return along, aside, (jnp.abs(aside) < half) & (along > 0)

    def unhindered(to_center: Array, unsure: Array, deep: Array, slack: Array, radius: Array) -> Array:
        """Whether all beams through the window end beyond it, and there are two of them."""
        along, _, inside = in_window(beams, to_center, radius + unsure)
        witness = swath.points.valid & inside
        to_line = dot(swath.behind, swath.points.position - (swath.points.laser + to_center)[None])
        beyond = (swath.points.range > along + radius + deep) | (to_line > deep)
        # Two counts in one sum: each costs a walk over all beams of all circles.
        witnesses, stopped = _two_sums(witness, witness & ~beyond)
        return (witnesses >= 2) & (stopped == 0)

    def covered(to_center: Array, unsure: Array, deep: Array, slack: Array, radius: Array) -> Array:
        """Whether no two neighbours of these beams leave room for the circle between them, nor the last and the rim."""
        _, aside, inside = in_window(beams, to_center, radius + unsure)
        _, next_aside, next_inside = in_window(next_beams, to_center, radius + unsure)
        witness, next_too = swath.points.valid & inside, follows & next_inside
        met = radius - slack  # a beam that passes the centre by less has met the circle, if it is there
        wide = witness & next_too & (aside - next_aside > 2 * met)
        to_left, to_right = witness & (aside <= met - unsure), witness & (aside >= unsure - met)
        return jnp.any(to_left) & jnp.any(to_right) & ~jnp.any(wide)

    to_center, unsure, deep, slack = computed_once(jax.vmap(window), circles.center)
    windows = to_center, unsure, deep, slack, circles.radius
    passed = circles.valid & jax.vmap(unhindered)(*windows)
    # Rarely is there any: of a scan that meets the circles that it can see, no second look at all beams is taken.
    return passed & jax.lax.cond(jnp.any(passed), lambda: jax.vmap(covered)(*windows), lambda: jnp.zeros_like(passed))


def _two_sums(a: Bool[Array, " N"], b: Bool[Array, " N"]) -> tuple[Int[Array, ""], Int[Array, ""]]:
    """How often each holds."""
    if a.shape[0] >= 1 << 15:  # no scanner has so many beams
        return jnp.sum(a, dtype=jnp.int32), jnp.sum(b, dtype=jnp.int32)
    both = jnp.sum(a.astype(jnp.int32) + (b.astype(jnp.int32) << 16), dtype=jnp.int32)
    return both & 0xFFFF, both >> 16


def circles_inside_triangles(circles: Circles, triangles: Triangles) -> Bool[Array, " C"]:
    """Section 6.3: circles are deleted if they lie inside a wipe-triangle. Taken by their centres.

    Args:
      circles: the `C` circles of the map.
      triangles: of this scan.

    Returns:
      Which of them are gone. Shape `[C]`.
    """

    def inside(center: Array, first: Array, second: Array) -> Array:
        start = center - triangles.robot - triangles.apex
        sides = _sides(start, jnp.zeros_like(start), first, second)
        return jnp.all(jnp.stack([constant > 0 for constant, _ in sides]))

    every = jax.vmap(jax.vmap(inside, (None, 0, 0)), (0, None, None))
    hits = every(circles.center, triangles.first, triangles.second)
    return circles.valid & jnp.any(hits & triangles.valid[None], -1)


def _sides(start: Array, tangent: Array, first: Array, second: Array) -> list[tuple[Array, Array]]:
    """For each side of the triangle (0, first, second): constant and rate of a function of s, positive inside."""
    base = second - first
    return [
        (_cross(first, start), _cross(first, tangent)),
        (_cross(start, second), _cross(tangent, second)),
        (_cross(base, start - first), _cross(base, tangent)),
    ]


def _cross(a: Array, b: Array) -> Array:
    return a[..., 0] * b[..., 1] - a[..., 1] * b[..., 0]
