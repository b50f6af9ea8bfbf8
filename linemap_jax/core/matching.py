"""Sections 5.1.1 and 5.2.1: which new primitive is which primitive of the map, Eqs. (21)-(22).

Lines are compared at the anchor of the new line: the mean of the other line is moved there exactly, its covariance to
first order. (rho, theta) and (-rho, theta + pi) are one line, and differences of angles are wrapped.
"""

from functools import partial
from typing import Any

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int

from linemap_jax.core.frames import dot, wrap_angle
from linemap_jax.core.propagation import inverse, quadratic
from linemap_jax.core.settings import PoseError, Rules, Thresholds
from linemap_jax.core.slots import all_true, computed_once, directed, least, take
from linemap_jax.core.state import Circles, Lines, pytree, squared

OVERLAP_WEIGHT = 1e-3
"""1/m: a metre more of overlap counts like this much less of the normalised distance. It decides between equals."""


@pytree
class LineComparison:
    """A new line held against one of the map. No batch axis."""

    offset: Float[Array, ""]
    """Innovation of the offset, new minus map, at the anchor of the new line, m."""
    angle: Float[Array, ""]
    """Innovation of the angle, rad."""
    lever: Float[Array, ""]
    """Lever of the shift S that moves a small change of the map's line to that anchor, m."""
    sign: Float[Array, ""]
    """-1 where the new line has to be taken reversed."""
    nis: Float[Array, ""]
    """Normalised distance, Eq. (21)."""
    gap: Float[Array, ""]
    """Gap along the line, m; negative where the segments overlap."""
    collinear: Bool[Array, ""]
    """Whether it passes the angle gate and the end-point gate."""
    geometric: Bool[Array, ""]
    """Whether it is collinear, and passes the gap gate."""
    in_place: Bool[Array, ""]
    """Whether it lies where the line of the map is: it passes the end-point gate, and covers half of that line."""


@partial(jax.jit, static_argnames="pose_error")  # so that it is traced once, not once for each of its seven uses
def compare_lines(new: Lines, model: Lines, thresholds: Thresholds, pose_error: PoseError) -> LineComparison:
    """Hold one new line against one line of the map: section 5.1.1.

    The gates on angle and end points widen with the predicted spread of what they gate; the paper's are fixed. Without
    any noise there is no statistical distance: it counts as zero, and those gates decide alone.

    Args:
      new: the new line, no batch axis.
      model: the line of the map, no batch axis.
      thresholds: `match_...`.
      pose_error: its model. "persistent": what persists is one error in both lines, and cancels as far as it moves
        both alike. Else the two are taken for independent, as Eq. (21) does.

    Returns:
      Innovation, normalised distance, gap, and which gates the pair passes. No batch axis.
    """
    turn = wrap_angle(new.angle - model.angle)
    reverse = jnp.abs(turn) > jnp.pi / 2
    sign = jnp.where(reverse, -1, 1).astype(turn.dtype)
    turn = jnp.where(reverse, turn - jnp.sign(turn) * jnp.pi, turn)

    # In components, not matrices: this runs for every pair of lines, and must become one kernel.
    step = model.anchor - new.anchor
    normal, tangent = model.normal, model.tangent
    lever = dot(tangent, step)
    offset = sign * new.offset - (model.offset + dot(normal, step))
    # The innovation's covariance: that of (sign offset, angle) of the new line plus S C S^T of the map's.
    c_new, c_model = new.cov_independent, model.cov_independent
    var_angle = c_new[1, 1] + c_model[1, 1]
    covariance = sign * c_new[0, 1] + c_model[0, 1] + lever * c_model[1, 1]
    var_offset = c_new[0, 0] + c_model[0, 0] + lever * (2 * c_model[0, 1] + lever * c_model[1, 1])
    a_new, a_model = new.sqrt_persistent, model.sqrt_persistent
    a_new, a_model = (sign * a_new[0], a_new[1]), (a_model[0] + lever * a_model[1], a_model[1])
    roots = [(a_new[0] - a_model[0], a_new[1] - a_model[1])] if pose_error == "persistent" else [a_new, a_model]
    for by_offset, by_angle in roots:
        var_angle = var_angle + jnp.sum(by_angle**2)
        covariance = covariance + jnp.sum(by_offset * by_angle)
        var_offset = var_offset + jnp.sum(by_offset**2)
    det = var_offset * var_angle - covariance**2
    weighted = var_angle * offset**2 - 2 * covariance * offset * turn + var_offset * turn**2
    # Negative by rounding alone
    nis = jnp.where(det > 0, jnp.maximum(weighted, 0) / jnp.where(det > 0, det, 1), 0)

    # Gates are compared as squares; that saves the square roots.
    parallel = turn**2 < jnp.maximum(thresholds.match_angle**2, thresholds.match_sigmas**2 * var_angle)
    near, along = new.valid & model.valid, []
    middle = new.offset * new.normal - step
    for end in (new.extent[0], new.extent[1]):
        from_anchor = middle + end * new.tangent
        s = dot(tangent, from_anchor)
        across = dot(normal, from_anchor) - model.offset
        from_new = s + lever
        variance = var_offset - 2 * from_new * covariance + from_new**2 * var_angle
        near = near & (across**2 < jnp.maximum(thresholds.match_distance**2, thresholds.match_sigmas**2 * variance))
        along.append(s)
    low, high = jnp.minimum(*along), jnp.maximum(*along)
    gap = jnp.maximum(low - model.extent[1], model.extent[0] - high)
    covered = jnp.minimum(high, model.extent[1]) - jnp.maximum(low, model.extent[0])
    return LineComparison(
        offset=offset,
        angle=turn,
        lever=lever,
        sign=sign,
        nis=nis,
        gap=gap,
        collinear=parallel & near,
        geometric=parallel & near & (gap < thresholds.match_gap),
        in_place=near & (2 * covered > model.length),
    )


def best_line(
    new: Lines,
    model: Lines,
    thresholds: Thresholds,
    pose_error: PoseError,
    *,
    among: Bool[Array, "L K"] | None = None,
    overlapping: bool = False,
    same_side: bool = False,
) -> tuple[Int[Array, " L"], Float[Array, " L"]]:
    """For each new line its best geometric match.

    The paper does not say which of several to take. Here it is the one with the least normalised distance; among equal
    ones, such as the fragments of a wall that was cut in two, the one that overlaps most.

    Args:
      new: `L` new lines.
      model: `K` lines of the map.
      thresholds: `match_...`.
      pose_error: its model.
      among: the pairs that are considered; all unless given.
      overlapping: whether the segments must overlap.
      same_side: whether they must have been seen from the same side.

    Returns:
      The slot in the map, and the normalised distance of Eq. (21), before the gate of Eq. (22); infinity where there is
      no match.
    """

    def score(a: Lines, b: Lines) -> Float[Array, ""]:
        pair: LineComparison = compare_lines(a, b, thresholds, pose_error)
        counts = pair.geometric & (pair.gap < 0) if overlapping else pair.geometric
        counts = counts & (pair.sign > 0) if same_side else counts
        return jnp.where(counts, pair.nis + OVERLAP_WEIGHT * pair.gap, jnp.inf)

    by_model = jax.vmap(score, (None, 0))
    scores = jax.vmap(by_model, (0, None))(new, directed(model))
    slot, best = least(scores if among is None else jnp.where(among, scores, jnp.inf))

    def nis(rows: tuple[Lines, Lines]) -> Float[Array, " l"]:
        return jax.vmap(lambda a, b: compare_lines(a, b, thresholds, pose_error).nis)(*rows)

    chosen: Array = computed_once(nis, (new, take(model, slot)))
    return slot, jnp.where(jnp.isfinite(best), chosen, jnp.inf)


def normal_variance(cov: Float[Array, "2 2"], along: Float[Array, "*s"]) -> Float[Array, "*s"]:
    """Variance of a line along its normal, m^2, at `along` metres from the anchor, from its covariance `cov`."""
    return cov[0, 0] - 2 * along * cov[0, 1] + along**2 * cov[1, 1]


def with_sign(cov: Float[Array, "*s 2 2"], sign: Float[Array, "*s"]) -> Float[Array, "*s 2 2"]:
    """Covariance of (sign offset, angle), from `cov`, that of (offset, angle), and a `sign` of 1 or -1."""
    one = jnp.ones_like(sign)
    return cov * jnp.stack([jnp.stack([one, sign], -1), jnp.stack([sign, one], -1)], -2)


def contradicted(
    new: Lines, model: Lines, thresholds: Thresholds, rules: Rules, pose_error: PoseError
) -> Bool[Array, " K"]:
    """Which lines of the map a scan denies: where they are, it has seen others.

    Args:
      new: the `L` lines of the scan.
      model: the `K` lines of the map.
      thresholds: `match_...`.
      rules: `tell_sides`.
      pose_error: its model.

    Returns:
      For each line of the map whether the new one that passes its middle nearest lies in its place, and fails the gate
      of Eq. (22).
    """
    # Of all pairs a cheap question, since what covers half of a line passes its middle; of the nearest the rest.
    model, lines = directed(model), directed(new)
    middle = model.point_at((model.extent[:, 0] + model.extent[:, 1]) / 2)
    ray = middle[None] - lines.anchor[:, None]
    along, across = dot(lines.tangent[:, None], ray), dot(lines.normal[:, None], ray) - lines.offset[:, None]
    passes = lines.valid[:, None] & (along > lines.extent[:, 0, None]) & (along < lines.extent[:, 1, None])
    if rules.tell_sides:
        passes = passes & (dot(lines.normal[:, None], model.normal[None]) > 0)
    nearest, distance = least(jnp.where(passes, jnp.abs(across), jnp.inf), 0)
    pair: Any = jax.vmap(lambda a, b: compare_lines(a, b, thresholds, pose_error))(take(lines, nearest), model)
    return jnp.isfinite(distance) & pair.in_place & (pair.nis >= thresholds.match_nis)


@pytree
class LineMatches:
    """What matching says of each new line."""

    slot: Int[Array, " L"]
    """Slot in the map, -1 for none."""
    suspect: Int[Array, " L"]
    """The line of the map that made a new line ambiguous, -1 for none."""
    nis: Float[Array, " L"]
    """Normalised distance of the best geometric candidate, before the statistical gate; 0 for none."""
    compared: Bool[Array, " L"]
    """Whether there was a geometric candidate that was not another line's."""


def compare_pieces(new: Lines, thresholds: Thresholds) -> LineComparison:
    """Hold the lines of a scan against each other, each with each: `[L, L]`.

    They share the pose: what its error adds to both is the same, and the sensor's noise alone tells them apart.

    Args:
      new: the `L` lines of a scan.
      thresholds: `match_...`.

    Returns:
      All comparisons, stacked `[L, L]`.
    """

    def compare(a: Lines, b: Lines) -> LineComparison:
        return compare_lines(a, b, thresholds, "persistent")

    lines = directed(new)
    return jax.vmap(jax.vmap(compare, (None, 0)), (0, None))(lines, lines)


def match_lines(
    new: Lines,
    model: Lines,
    collinear: Bool[Array, "L L"],
    thresholds: Thresholds,
    rules: Rules,
    pose_error: PoseError,
) -> LineMatches:
    """Find for each new line the line of the map that it is: section 5.1.1, with the gate of Eq. (22).

    A scan that sees two parallel lines knows that they are two, however uncertain its pose is. Not in the paper: of
    several new lines that are next to the same line of the map, only those match it that are collinear with the best;
    the others are new.

    Args:
      new: the lines of a scan.
      model: the lines of the map.
      collinear: which lines of the scan may be pieces of one line.
      thresholds: `match_...`.
      rules: `share_pose`, `tell_sides`, `leave_out_ambiguous`.
      pose_error: its model.

    Returns:
      For each new line its line of the map, or which one stands in its way.
    """
    slot, nis = best_line(new, model, thresholds, pose_error, same_side=rules.tell_sides)
    compared = jnp.isfinite(nis)
    matched = nis < thresholds.match_nis
    if rules.share_pose:
        same = (slot[:, None] == slot[None]) & matched[None]
        best, _ = least(jnp.where(same, nis[None], jnp.inf))
        another = jnp.any(same, -1) & ~collinear[jnp.arange(best.shape[0]), best]
        matched, compared = matched & ~another, compared & ~another
    ambiguous = compared & ~matched & rules.leave_out_ambiguous
    return LineMatches(
        slot=jnp.where(matched, slot, -1),
        suspect=jnp.where(ambiguous, slot, -1),
        nis=jnp.where(compared, nis, 0),
        compared=compared,
    )


def group_lines(pair: LineComparison, unmatched: Bool[Array, " L"], thresholds: Thresholds) -> Int[Array, " L"]:
    """Pieces of one wall that the map does not hold yet: for each unmatched line the one that leads its group.

    The paper takes the lines of a scan one after the other, so that a second piece finds the first one in the map. Here
    all are taken at once, and this stands in for it.

    Args:
      pair: the lines of the scan held against each other.
      unmatched: the lines that are to be grouped.
      thresholds: `match_...`.

    Returns:
      The slot of the leader, its own for a leader, -1 for lines that are not unmatched. Shape `[L]`.
    """
    agree = pair.geometric & (pair.nis < thresholds.match_nis)
    score = jnp.where(agree, pair.nis + OVERLAP_WEIGHT * pair.gap, jnp.inf)
    index = jnp.arange(unmatched.shape[0], dtype=jnp.int32)
    lines = all_true(unmatched, index.shape[0])

    def step(k: Array, leader: Array) -> Array:
        i = lines[k]
        candidates = jnp.where(leader == index, score[i], jnp.inf)  # only lines before i lead yet
        best, value = least(candidates[None])
        return leader.at[i].set(jnp.where(jnp.isfinite(value[0]), best[0], i).astype(leader.dtype))

    return jax.lax.fori_loop(0, jnp.sum(unmatched, dtype=jnp.int32), step, jnp.full(index.shape, -1, index.dtype))


@pytree
class CircleMatches:
    """What matching says of each new circle."""

    slot: Int[Array, " C"]
    """Slot in the map, -1 for none."""
    distance: Float[Array, " C"]
    """Distance to the centre of that circle, m."""
    nis: Float[Array, " C"]
    """Normalised distance of the nearest within the distance gate, before the statistical one; 0 for none."""
    dof: Int[Array, " C"]
    """Degrees of freedom of that: 3, or 0 where nothing was compared."""
    suspect: Int[Array, " C"]
    """The circle of the map that it is near, but is not; -1 for none."""


def match_circles(
    new: Circles, model: Circles, thresholds: Thresholds, rules: Rules, pose_error: PoseError
) -> CircleMatches:
    """Find for each new circle the circle of the map that it is: section 5.2.1.

    The nearest is taken. The paper's one criterion is the distance of the centres; fitted circles have a covariance,
    and by default must pass a chi-square gate on centre and radius too.

    Args:
      new: the `C` circles of a scan.
      model: the `K` circles of the map.
      thresholds: `circle_match_distance`, `circle_match_nis`.
      rules: `weigh_circles`, `leave_out_ambiguous`.
      pose_error: its model, as of `compare_lines`.

    Returns:
      For each new circle its circle of the map.
    """
    step = new.center[:, None] - model.center[None]
    near = new.valid[:, None] & model.valid[None]
    distance = jnp.where(near, jnp.sqrt(dot(step, step)), jnp.inf)
    slot, distance = least(distance)
    near = distance < thresholds.circle_match_distance

    mine = take(model, slot)
    both = near & new.fitted & mine.fitted
    change = jnp.concatenate([new.center - mine.center, (new.radius - mine.radius)[:, None]], -1)
    cov = new.cov_independent + mine.cov_independent
    if pose_error == "persistent":
        cov = cov + squared(new.sqrt_persistent - mine.sqrt_persistent)
    else:
        cov = cov + squared(new.sqrt_persistent) + squared(mine.sqrt_persistent)
    cov = jnp.where(both[:, None, None], cov, jnp.eye(3, dtype=change.dtype)[None])
    nis = jnp.where(both, quadratic(change, inverse(cov)), 0)
    matched = near & (~both | (nis < thresholds.circle_match_nis)) if rules.weigh_circles else near
    return CircleMatches(
        slot=jnp.where(matched, slot, -1),
        distance=jnp.where(matched, distance, 0),
        nis=nis,
        dof=jnp.where(both, 3, 0).astype(jnp.int32),
        suspect=jnp.where(near & ~matched & rules.leave_out_ambiguous, slot, -1),
    )
