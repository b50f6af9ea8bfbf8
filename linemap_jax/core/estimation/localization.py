"""Section 8: where the robot is in a map that is given, from its odometry and what each scan sees of the map.

Data flows through it as `predict`, `observe`, `search`, `sight_...`, `update`, once for each scan:

A scan is worth its lines and fitted circles, held against those of the map, and its points in no line, held against the
map's segments. What they are held against is found from a pose that a search around the prediction has found, since
odometry may be far off; it says only where to look. The estimate is a Kalman filter's.

The map is not changed, and its errors persist: the same wall is seen scan after scan, and its error does not average
away. Taken for new in every scan, it would make the filter surer of its pose than the map can make it. So the filter
carries along how the errors of the map have moved the pose (a Schmidt-Kalman or "consider" filter). With e the errors
of the map, each in units of its sigma, the error of the pose is to first order

    error = own + by_map e,    C_pose = C_own + by_map by_map^T,

own being what is independent of the map. What a scan sees of a primitive of the map, seen minus expected, is

    y = H error + A e + v.

Seen again, a line tells how the pose has moved since, and hardly more of where it is; which is what it knows. Errors of
different primitives are taken for independent. An error that all have in common moves the whole map, and the robot's
place in it not at all.

What the rest of a scan contradicts is left out of it (`update_with_consistent`): things move, and a map stays as it is.
A scan that the map does not explain is not used; several of them, and the filter says that it is lost.
"""

import dataclasses
from typing import Any, Unpack

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Int

from linemap_jax.core.estimation.likelihood_field import Counts, LikelihoodField, distances, search, thinned
from linemap_jax.core.estimation.odometry import OdometryNoise, cov_step
from linemap_jax.core.extract import extract, usable
from linemap_jax.core.frames import (
    compose,
    dot,
    jac_compose_pose,
    jac_compose_step,
    perp,
    rotate,
    shift_matrix,
    unit,
    wrap_angle,
)
from linemap_jax.core.matching import compare_lines, compare_pieces, match_lines
from linemap_jax.core.propagation import inverse, product, propagate, quadratic, square_root, symmetric
from linemap_jax.core.sensor import point_from_measurement
from linemap_jax.core.settings import SCAN_CAPACITY, Capacity, Method, Mount, Number, Rules, SensorNoise, Thresholds
from linemap_jax.core.slots import all_true, choose, directed, least, take
from linemap_jax.core.state import Circles, LineMap, Lines, Pose, Scan, Status, pytree, squared

ITERATIONS = 3
"""Times that a scan is matched and the update linearised anew. Points come in from the second on."""
SIGHTINGS = 48
"""Most primitives of the map that one scan is held against: five times what real scans see."""
GROUPS = 24
"""Most segments of the map against which points in no line are held."""
GRAZING = 0.17
"""A beam that meets a line at less than so much (cosine to the normal: 10 degrees) says little of where it is."""
STRAIGHT = 4.0
"""Mean square of residuals, in sigmas, up to which points lie along a segment."""
OFTEN = 3
"""Lines that were seen so often stand where they are: a beam through one contradicts the pose."""
NEARBY: Counts = ((13, 25), (7, 9), (7, 9))
"""Nodes of the search in every scan."""
FARTHER: Counts = ((33, 49), (9, 9), (7, 9))
"""Nodes of the search for a robot that has been moved."""
CLEARLY = 0.2
"""Share of returns by which a pose far away must explain more than one nearby; what lacks so much to explain a scan
has it searched for."""


@pytree
class LocalizationSettings:
    """Where the filter draws its lines. Traced numbers, in metres and radians."""

    match_nis: Number = 9.21
    """Largest normalised innovation squared of what is used: 99 % of chi-square with 2 degrees of freedom."""
    consistent_nis: Number = 16.95
    """Largest that a sighting may have, given all others: chi-square with 2 degrees of freedom again, at 1 % for all
    `SIGHTINGS` together. Walls are not straight, and what is asked of the worst has to be asked more mildly."""
    point_distance: Number = 0.1
    """Farthest a point in no line may lie from a segment of the map to count as seen of it, m."""
    offset_floor: Number = 0.01
    """Walls are not straight and ranges not unbiased: least standard deviation of what is seen of an offset, m."""
    angle_floor: Number = 0.003
    """The same of a direction, rad."""
    search_position: Number = 0.04
    """What a search leaves open of the position, m: the spread by which matches are first judged. Also, where the
    prediction is surer than this and its heading than `search_heading`, matching starts from the prediction."""
    search_heading: Number = 0.015
    """The same of the heading, rad."""
    slip_position: Number = 0.15
    """Wheels may slip, and clocks differ: the search of every scan reaches three times this farther than the
    prediction's own spread, m."""
    slip_step: Number = 0.25
    """And by what the wheels say that the robot has gone, up to this, m."""
    slip_heading: Number = 0.12
    """The same of the heading, rad."""
    astray_position: Number = 0.7
    """The same where the map does not explain the scan: the robot may have been moved, m."""
    astray_heading: Number = 0.4
    """The same of the heading, rad."""
    surprise: Number = 11.34
    """If the search ends farther from the prediction than this (chi-square with 3 degrees of freedom, 99 %), the
    odometry was wrong, and the prediction's covariance is enlarged until it is as far as is to be expected."""
    explained_distance: Number = 0.15
    """A return no farther than this from a segment or circle of the map is explained by it, m."""
    through_distance: Number = 0.3
    """A return farther than this behind a segment of the map contradicts it, m."""
    least_fit: Number = 0.4
    """Share of the returns that the map explains, less the share that contradicts it: with less, a scan is not used,
    and where it is less on the average, the robot is lost."""
    found_fit: Number = 0.7
    """A robot that is lost is so until the fit is more than this on the average: rooms are alike, and one that fits by
    half is soon found."""
    sudden: Number = 0.6
    """Nor is a scan used of which the map explains less than this share of what it has explained of late."""
    memory: Number = 0.7
    """What the average of the fit keeps from scan to scan: 0.7 forgets in about three."""
    lost_position: Number = 0.5
    """By so much more is the position unsure after each scan that a lost robot cannot use, m, up to the size of the
    map. Before it is known to be lost, it is by `slip_position`."""
    lost_heading: Number = 0.2
    """The same of the heading, rad, up to half a turn."""


@pytree
class Belief:
    """What the filter knows of the pose. Primitives of the map are counted lines first, then circles."""

    mean: Float[Array, "3"]
    """x, y, theta. m, m, rad."""
    cov_own: Float[Array, "3 3"]
    """Covariance of the part that is independent of the map's errors: m^2, m rad, rad^2."""
    by_map: Float[Array, "3 M 2"]
    """How the map's errors have moved the pose, each in units of its sigma."""
    fit: Float[Array, ""]
    """Average of the fit over the latest scans, see `LocalizationSettings.least_fit`."""
    lost: Bool[Array, ""]
    """Whether the latest scans did not fit the map."""

    @property
    def cov(self) -> Float[Array, "3 3"]:
        """Covariance of the pose. Shape `[3, 3]`."""
        return self.cov_own + squared(self.by_map.reshape(*self.by_map.shape[:-2], -1))

    @property
    def pose(self) -> Pose:
        """The pose with its covariance."""
        return Pose(mean=self.mean, cov=self.cov)


@pytree
class Located:
    """What the filter says after one scan."""

    pose: Pose
    """Pose of the robot in the map."""
    nis: Float[Array, ""]
    """Normalised innovation squared of all sightings together."""
    dof: Int[Array, ""]
    """Its degrees of freedom; 0 where nothing was used."""
    lines: Int[Array, ""]
    """How many lines, or groups of points, were used."""
    circles: Int[Array, ""]
    """How many circles were used."""
    fit: Float[Array, ""]
    """Share of the returns explained, less share that contradict the map."""
    status: Int[Array, ""]
    """Bits of `Status`."""


@pytree
class Seen:
    """What a scan holds, in the frame of the robot."""

    lines: Lines
    """Lines in the frame of the robot, with covariances of the measurement alone."""
    circles: Circles
    """Circles, likewise."""
    collinear: Bool[Array, "L L"]
    """Which lines may be pieces of one."""
    points: Float[Array, "N 2"]
    """Points in the frame of the robot, m."""
    beams: Float[Array, "N 2"]
    """Unit vectors along the beams."""
    ranges: Float[Array, " N"]
    """Measured ranges, m."""
    returned: Bool[Array, " N"]
    """Which beams came back."""
    alone: Bool[Array, " N"]
    """Returned, and in no line nor fitted circle."""
    laser: Float[Array, "2"]
    """The scanner, m."""


@pytree
class Sightings:
    """y = H error + A e + v for some primitives of the map. Free slots hold zeros, and a covariance of ones."""

    slot: Int[Array, " S"]
    """Slot in the map; lines first, then circles."""
    innovation: Float[Array, "S 2"]
    """y, seen minus expected: of (offset, angle) of a line, of the centre of a circle."""
    jac_pose: Float[Array, "S 2 3"]
    """H, derivative of the expectation by the pose."""
    by_map: Float[Array, "S 2 2"]
    """A, how the errors of the map's primitive enter, each in units of its sigma."""
    cov: Float[Array, "S 2 2"]
    """Covariance of v, the noise of the sighting."""
    valid: Bool[Array, " S"]
    """Which slots are in use."""


def believe(pose: Pose, line_map: LineMap) -> Belief:
    """The belief to begin with: a pose that owes nothing to the map, and no opinion of how well the map fits.

    Args:
      pose: of the robot, in the map.
      line_map: the map, whose capacity decides the shape.

    Returns:
      The belief before the first scan.
    """
    primitives = line_map.lines.valid.shape[0] + line_map.circles.valid.shape[0]
    dtype = pose.mean.dtype
    return Belief(
        mean=pose.mean,
        cov_own=pose.cov,
        by_map=jnp.zeros((3, primitives, 2), dtype),
        fit=jnp.asarray(0.5, dtype),
        lost=jnp.asarray(False),
    )


def localize(
    belief: Belief,
    scans: Scan,
    steps: Float[Array, "T 3"],
    extra: Float[Array, "T 3"],
    active: Bool[Array, " T"],
    line_map: LineMap,
    field: LikelihoodField,
    *,
    odometry: OdometryNoise | None = None,
    thresholds: Thresholds | None = None,
    noise: SensorNoise | None = None,
    mount: Mount | None = None,
    settings: LocalizationSettings | None = None,
    capacity: Capacity = SCAN_CAPACITY,
    **method: Unpack[Method],
) -> tuple[Belief, Located]:
    """The poses of a stack of scans, one after the other.

    Args:
      belief: before the first step.
      scans: `T` scans, stacked.
      steps: how the robot moved to each scan from the one before, by its odometry: x ahead, y left, turn. m, m, rad.
        One that is not finite is taken for none, and `Status.POSE_NOT_FINITE` tells.
      extra: variances added to those of the steps, of x, y, turn in the axes of the robot. m^2, m^2, rad^2.
      active: False for scans that only fill up the stack.
      line_map: the map.
      field: of the map, by `field_of_map`.
      odometry: how well the wheels count.
      thresholds: of extraction and matching.
      noise: of the sensor.
      mount: of the scanner on the robot.
      settings: thresholds of the filter.
      capacity: slots for what one scan holds.
      **method: as for `extract`. With `Rules.tell_sides` a wall is known by the side on which the robot is: for a map
        that somebody has drawn, and which does not tell, it must be off.

    Returns:
      The belief after the last scan, and what the filter says after each, stacked `[T]`.
    """
    odometry, thresholds, noise = odometry or OdometryNoise(), thresholds or Thresholds(), noise or SensorNoise()
    mount, settings = mount or Mount(), settings or LocalizationSettings()
    rules = method.get("rules", Rules())
    lines = directed(line_map.lines)

    def after_scan(belief: Belief, scan: Scan, move: Array, more: Array) -> tuple[Belief, Located]:
        finite = jnp.all(jnp.isfinite(move))
        expected = predict(belief, jnp.where(finite, move, 0), more, odometry)
        seen = observe(scan, mount, thresholds=thresholds, noise=noise, capacity=capacity, **method)
        moved = jnp.where(finite, jnp.sqrt(dot(move[:2], move[:2])), 0)
        after, located = locate(
            expected,
            seen,
            moved,
            line_map,
            lines,
            field,
            thresholds=thresholds,
            rules=rules,
            noise=noise,
            settings=settings,
        )
        status = located.status | jnp.where(finite, 0, int(Status.POSE_NOT_FINITE))
        return after, dataclasses.replace(located, status=status)

    def after_none(belief: Belief, *_: Any) -> tuple[Belief, Located]:
        zero, none = jnp.zeros_like(belief.fit), jnp.zeros((), jnp.int32)
        nothing = Located(pose=belief.pose, nis=zero, dof=none, lines=none, circles=none, fit=zero, status=none)
        return belief, nothing

    def step(belief: Belief, x: tuple[Scan, Array, Array, Array]) -> tuple[Belief, Located]:
        *given, is_active = x
        return jax.lax.cond(is_active, after_scan, after_none, belief, *given)

    return jax.lax.scan(step, belief, (scans, steps, extra, active))


def predict(belief: Belief, step: Float[Array, "3"], extra: Float[Array, "3"], odometry: OdometryNoise) -> Belief:
    """The belief after a step by the robot's odometry: what the map has done to the pose moves along.

    Args:
      belief: before the step.
      step: seen from the pose before, as the wheels count it. m, m, rad. Shape `[3]`.
      extra: variances that come on top of those of the step. m^2, m^2, rad^2. Shape `[3]`.
      odometry: noise of the wheels.

    Returns:
      The belief after the step.
    """
    by_pose, by_step = jac_compose_pose(belief.mean, step), jac_compose_step(belief.mean, step)
    return dataclasses.replace(
        belief,
        mean=compose(belief.mean, step),
        cov_own=propagate(by_pose, belief.cov_own) + propagate(by_step, cov_step(step, odometry) + jnp.diag(extra)),
        by_map=jnp.einsum("ij,jmk->imk", by_pose, belief.by_map),
    )


def observe(
    scan: Scan,
    mount: Mount,
    *,
    thresholds: Thresholds,
    noise: SensorNoise,
    capacity: Capacity = SCAN_CAPACITY,
    **method: Unpack[Method],
) -> Seen:
    """Lines, circles and points of a scan in the frame of the robot, whatever its pose.

    Args:
      scan: `N` beams.
      mount: of the scanner on the robot.
      thresholds: criteria of the extraction.
      noise: of the sensor.
      capacity: slots for lines and circles.
      **method: as for `extract`.

    Returns:
      What the scan holds; covariances are those of the measurement alone.
    """
    dtype = scan.ranges.dtype
    scan, here, _ = usable(scan, Pose(mean=jnp.zeros(3, dtype), cov=jnp.zeros((3, 3), dtype)))
    found = extract(scan, here, thresholds=thresholds, noise=noise, mount=mount, capacity=capacity, **method)
    at = jnp.stack([jnp.asarray(mount.x), jnp.asarray(mount.y), jnp.asarray(mount.theta)]).astype(dtype)
    measured = jnp.stack([scan.ranges, scan.bearings], -1)
    in_circle = (found.circle_of_beam >= 0) & found.circles.fitted[jnp.maximum(found.circle_of_beam, 0)]
    return Seen(
        lines=found.lines,
        circles=found.circles,
        collinear=compare_pieces(found.lines, thresholds).collinear,
        points=jax.vmap(lambda s: point_from_measurement(here.mean, s, at))(measured),
        beams=unit(at[2] + scan.bearings),
        ranges=scan.ranges,
        returned=scan.valid,
        alone=scan.valid & (found.line_of_beam < 0) & ~in_circle,
        laser=at[:2],
    )


def locate(
    belief: Belief,
    seen: Seen,
    moved: Float[Array, ""],
    line_map: LineMap,
    lines: Lines,
    field: LikelihoodField,
    *,
    thresholds: Thresholds,
    rules: Rules,
    noise: SensorNoise,
    settings: LocalizationSettings,
) -> tuple[Belief, Located]:
    """The belief after a scan.

    Args:
      belief: predicted.
      seen: what the scan holds.
      moved: how far the wheels say that the robot has gone, m.
      line_map: the map.
      lines: those of the map, directed.
      field: of the map.
      thresholds: `match_...`.
      rules: which reading of the method.
      noise: of the sensor.
      settings: thresholds of the filter.

    Returns:
      The belief, with the pose improved and the map's part in it carried along; and what was used.
    """
    dtype = belief.mean.dtype
    cov = belief.cov
    found = _found(belief, seen, moved, field, settings)
    resolution = _diagonal(settings.search_position, settings.search_heading, dtype)
    off = _minus(found, belief.mean)
    surprise = quadratic(off, inverse(cov + resolution))
    wrong = jnp.where(surprise > settings.surprise, surprise / 3 - 1, 0)
    prior = dataclasses.replace(belief, cov_own=belief.cov_own + wrong * (cov + resolution))
    vague = jnp.any(jnp.diag(prior.cov) > jnp.diag(resolution))
    # What is matched is judged by what the search leaves open, or by the prediction where that is surer.
    start = jnp.where(vague, found, belief.mean)
    judged_by = dataclasses.replace(
        prior,
        mean=start,
        cov_own=jnp.where(vague, resolution, prior.cov_own),
        by_map=jnp.where(vague, 0, prior.by_map),
    )

    def look(i: Array, carry: tuple[Array, Belief, Sightings, Array]) -> tuple[Array, Belief, Sightings, Array]:
        at, judged_by, *_ = carry
        spread = judged_by.cov
        by_lines = sight_lines(seen, at, spread, lines, thresholds, rules, settings)
        by_circles = sight_circles(seen, at, spread, line_map.circles, lines.valid.shape[0], settings)
        by_points = jax.lax.cond(i > 0, points_from, lambda _: no_points, at)
        sightings = gated(judged_by, at, _packed([by_lines, by_circles, by_points]), settings.match_nis)
        # Nor may a thing pull the pose away from where it can be: a pole that was moved fits, once it has.
        sightings = gated(prior, at, sightings, settings.match_nis)
        after, sightings, nis = update_with_consistent(prior, at, sightings, settings.consistent_nis)
        return after.mean, after, sightings, nis

    def points_from(at: Float[Array, "3"]) -> Sightings:
        return sight_points(seen, at, seen.alone, lines, noise, rules, settings)

    no_points = _no_sightings(min(GROUPS, lines.valid.shape[0]), dtype)
    carry = (start, judged_by, _no_sightings(SIGHTINGS, dtype), jnp.zeros((), dtype))
    _, after, sightings, nis = jax.lax.fori_loop(0, ITERATIONS, look, carry)

    fit = fit_of_scan(seen, after.mean, lines, field, settings)
    used = (fit >= settings.least_fit) & (fit >= settings.sudden * belief.fit)
    average = settings.memory * belief.fit + (1 - settings.memory) * fit
    lost = average < jnp.where(belief.lost, settings.found_fit, settings.least_fit)
    after = jax.tree.map(lambda a, b: jnp.where(used, a, b), after, belief)
    after = dataclasses.replace(_less_sure(after, used, lost, field, settings), fit=average, lost=lost)
    count = lines.valid.shape[0]

    def used_of(which: Bool[Array, " S"]) -> Int[Array, ""]:
        return jnp.sum(used & sightings.valid & which).astype(jnp.int32)

    located = Located(
        pose=after.pose,
        nis=jnp.where(used, jnp.asarray(nis), 0),
        dof=2 * used_of(sightings.valid),
        lines=used_of(sightings.slot < count),
        circles=used_of(sightings.slot >= count),
        fit=fit,
        status=jnp.where(lost, int(Status.LOST), 0).astype(jnp.int32),
    )
    return after, located


def _found(
    belief: Belief, seen: Seen, moved: Float[Array, ""], field: LikelihoodField, settings: LocalizationSettings
) -> Float[Array, "3"]:
    """Where to look: the pose near the prediction that explains the scan best; farther away if none near does."""
    dtype = belief.mean.dtype
    points, valid = thinned(seen.points, seen.returned)

    def around(position: Number, heading: Number, counts: Counts) -> Float[Array, "3"]:
        root = _root(belief.cov + _diagonal(position, heading, dtype))
        return search(field, points, valid, belief.mean, root, counts=counts)

    def explained(pose: Float[Array, "3"]) -> Float[Array, ""]:
        turned = rotate(pose[2], points) + pose[None, :2]
        near = valid & (distances(field, turned) < settings.explained_distance)
        return jnp.sum(near) / jnp.maximum(jnp.sum(valid), 1)

    # Wheels may slip altogether, or run backwards and be counted forwards.
    slip = jnp.sqrt(settings.slip_position**2 + jnp.minimum(moved, settings.slip_step) ** 2)
    near = around(slip, settings.slip_heading, NEARBY)
    of_near = explained(near)
    enough = settings.least_fit + CLEARLY
    astray = (of_near < enough) & (settings.memory * belief.fit + (1 - settings.memory) * of_near < enough)

    def farther() -> Float[Array, "3"]:
        far = around(settings.astray_position, settings.astray_heading, FARTHER)
        return jnp.where(explained(far) > of_near + CLEARLY, far, near)

    return jax.lax.cond(astray, farther, lambda: near)


def sight_lines(
    seen: Seen,
    pose: Float[Array, "3"],
    cov: Float[Array, "3 3"],
    model: Lines,
    thresholds: Thresholds,
    rules: Rules,
    settings: LocalizationSettings,
) -> Sightings:
    """The lines of a scan, each held against the line of the map that it is: the gates of the map builder.

    Args:
      seen: what the scan holds.
      pose: from which it is taken to be seen.
      cov: of that pose.
      model: the lines of the map.
      thresholds: `match_...`.
      rules: which reading of the method.
      settings: the floors.

    Returns:
      A sighting for each line of the scan; not valid for those that match no line of the map.
    """
    new, jac = place(seen.lines, pose, cov)
    matches = match_lines(new, model, seen.collinear, thresholds, rules, "independent")
    mine = take(model, jnp.maximum(matches.slot, 0))
    pair: Any = jax.vmap(lambda a, b: compare_lines(a, b, thresholds, "independent"))(new, mine)
    sign = jnp.stack([pair.sign, jnp.ones_like(pair.sign)], -1)
    floor = jnp.stack([jnp.asarray(settings.offset_floor), jnp.asarray(settings.angle_floor)]) ** 2
    return _where(
        matches.slot >= 0,
        slot=matches.slot,
        innovation=jnp.stack([pair.offset, pair.angle], -1),
        jac_pose=sign[:, :, None] * jac,
        by_map=-product(shift_matrix(pair.lever), square_root(mine.cov)),
        cov=sign[:, :, None] * sign[:, None, :] * seen.lines.cov_independent + jnp.diag(floor).astype(sign.dtype)[None],
    )


def place(lines: Lines, pose: Float[Array, "3"], cov: Float[Array, "3 3"]) -> tuple[Lines, Float[Array, "K 2 3"]]:
    """Lines seen from a robot, in the world; and how its pose moves them.

    Args:
      lines: in the frame of the robot, with covariances of the measurement alone.
      pose: of the robot.
      cov: of the pose.

    Returns:
      The lines, with the pose error in `sqrt_persistent`; d(offset, angle) / d(x, y, theta), shape `[K, 2, 3]`.
    """
    lever = rotate(pose[2], lines.anchor)
    angle = wrap_angle(lines.angle + pose[2])
    placed = dataclasses.replace(lines, anchor=pose[None, :2] + lever, angle=angle, first_angle=angle)
    jac = jac_line_pose(placed, lever)
    root = jnp.broadcast_to(square_root(cov), (*angle.shape, 3, 3))
    return dataclasses.replace(placed, sqrt_persistent=product(jac, root)), jac


def jac_line_pose(lines: Lines, lever: Float[Array, "K 2"]) -> Float[Array, "K 2 3"]:
    """The derivative of (offset, angle) by the pose, of lines that are fixed to the robot; derived by hand.

    The anchor stays where it is. A move shifts the line along its normal; a turn about the robot moves the foot of the
    anchor along it by minus the tangent's share of the lever.

    Args:
      lines: in the world.
      lever: from the robot to their anchors, in the axes of the world, m.

    Returns:
      d(offset, angle) / d(x, y, theta). Shape `[K, 2, 3]`.
    """
    zero, one = jnp.zeros_like(lines.offset), jnp.ones_like(lines.offset)
    normal = lines.normal
    by_turn = -dot(lines.tangent, lever)
    return jnp.stack([jnp.stack([normal[:, 0], normal[:, 1], by_turn], -1), jnp.stack([zero, zero, one], -1)], -2)


def sight_circles(
    seen: Seen,
    pose: Float[Array, "3"],
    cov: Float[Array, "3 3"],
    model: Circles,
    first: int,
    settings: LocalizationSettings,
) -> Sightings:
    """The fitted circles of a scan as points, each held against the nearest fitted one of the map, in sigmas.

    Circles that are not fitted describe what is visible of a cluster, which moves with the viewpoint by more than what
    there is to gain: they take part in the search alone.

    Args:
      seen: what the scan holds.
      pose: from which it is taken to be seen. m, m, rad.
      cov: of that pose. m^2, m rad, rad^2.
      model: the circles of the map.
      first: slot of the first circle among the sightings: the number of lines of the map.
      settings: `match_nis` and `offset_floor`.

    Returns:
      A sighting for each circle of the scan; not valid for those that match none of the map.
    """
    circles = seen.circles
    lever = rotate(pose[2], circles.center)
    eye = jnp.broadcast_to(jnp.eye(2, dtype=lever.dtype), (lever.shape[0], 2, 2))
    jac = jnp.concatenate([eye, perp(lever)[:, :, None]], -1)
    ahead = unit(pose[2])
    turn = jnp.broadcast_to(jnp.stack([ahead, perp(ahead)], -1), eye.shape)
    mine = propagate(turn, circles.cov[:, :2, :2]) + settings.offset_floor**2 * eye
    change = (pose[None, :2] + lever)[:, None] - model.center[None]
    total = (mine + propagate(jac, cov))[:, None] + model.cov[None, :, :2, :2]
    alike = (circles.valid & circles.fitted)[:, None] & (model.valid & model.fitted)[None]
    total = jnp.where(alike[..., None, None], total, jnp.eye(2, dtype=lever.dtype))
    slot, best = least(jnp.where(alike, quadratic(change, inverse(total)), jnp.inf))
    return _where(
        best < settings.match_nis,
        slot=first + slot,
        innovation=jnp.take_along_axis(change, slot[:, None, None], 1)[:, 0],
        jac_pose=jac,
        by_map=-square_root(model.cov[slot, :2, :2]),
        cov=mine,
    )


def sight_points(
    seen: Seen,
    pose: Float[Array, "3"],
    which: Bool[Array, " N"],
    model: Lines,
    noise: SensorNoise,
    rules: Rules,
    settings: LocalizationSettings,
) -> Sightings:
    """Points in no line, each held against the nearest segment of the map; those at one segment make one sighting.

    So pieces too short to be a line of the scan count as well. Where three points at least lie along a segment as their
    noise allows, their weighted mean distance from it and their slope are what is seen of its offset and angle.

    Args:
      seen: what the scan holds.
      pose: from which it is taken to be seen.
      which: the points that take part. Shape `[N]`.
      model: the lines of the map.
      noise: of the sensor.
      rules: `tell_sides`.
      settings: `point_distance` and the floors.

    Returns:
      Sightings of lines of the map, by groups of points; not valid where there is no such group.
    """
    towards = rotate(pose[2], seen.beams)
    points = pose[None, :2] + rotate(pose[2], seen.points)
    across, along, beside = _beside(points, model)
    faces = dot(towards[:, None], model.normal[None]) > 0
    seen_from = model.valid[None] & (faces | (not rules.tell_sides))
    slot, _ = least(jnp.where(seen_from, across**2 + beside**2, jnp.inf))
    across, along, beside = (jnp.take_along_axis(x, slot[:, None], 1)[:, 0] for x in (across, along, beside))
    cosine = dot(model.normal[slot], towards)
    variance = (noise.range_sigma * cosine) ** 2 + (noise.bearing_sigma * seen.ranges) ** 2 * (1 - cosine**2)
    variance = variance + settings.offset_floor**2
    used = which & (jnp.abs(across) < settings.point_distance) & (beside < settings.offset_floor)
    used = used & (jnp.abs(cosine) > GRAZING)
    weight = jnp.where(used, 1 / variance, 0)

    k = model.valid.shape[0]

    def total(x: Float[Array, " N"]) -> Float[Array, " K"]:
        return jax.ops.segment_sum(x, slot, k)

    information, count = total(weight), total(used.astype(weight.dtype))
    safe = jnp.where(information > 0, information, 1)
    middle, mean = total(weight * along) / safe, total(weight * across) / safe
    u = along - middle[slot]
    # One more, as if it were known that the angle is right within a radian: a spread of zero shall divide nothing.
    spread = total(weight * u * u) + 1
    turn = -total(weight * u * across) / spread
    misfit = total(weight * (across - mean[slot] + u * turn[slot]) ** 2)
    straight = (count >= 3) & (misfit < STRAIGHT * count)
    information, index = jax.lax.top_k(jnp.where(straight, information, 0), min(GROUPS, k))
    mine = take(model, index)
    lever = mine.point_at(middle[index]) - pose[None, :2]
    zero = jnp.zeros_like(information)
    var_offset = 1 / safe[index] + settings.offset_floor**2
    var_angle = 1 / spread[index] + settings.angle_floor**2
    return _where(
        information > 0,
        slot=index,
        innovation=jnp.stack([mean[index], turn[index]], -1),
        jac_pose=jac_line_pose(mine, lever),
        by_map=-product(shift_matrix(-middle[index]), square_root(mine.cov)),
        cov=jnp.stack([jnp.stack([var_offset, zero], -1), jnp.stack([zero, var_angle], -1)], -2),
    )


def _beside(
    points: Float[Array, "N 2"], lines: Lines
) -> tuple[Float[Array, "N K"], Float[Array, "N K"], Float[Array, "N K"]]:
    """Where points lie by segments: along the normal; along the tangent, from the anchor; beyond the nearer end. m."""
    ray = points[:, None] - lines.anchor[None]
    across = dot(lines.normal[None], ray) - lines.offset[None]
    along = dot(lines.tangent[None], ray)
    beyond = jnp.maximum(lines.extent[None, :, 0] - along, along - lines.extent[None, :, 1])
    return across, along, jnp.maximum(beyond, 0)


def innovation_cov(belief: Belief, sightings: Sightings) -> Float[Array, "S 2 2"]:
    """Covariance of each innovation by itself, H C H' + A A' + V and what pose and map have in common.

    Args:
      belief: predicted.
      sightings: `S` of them.

    Returns:
      Of (offset, angle) of lines: m^2, m rad, rad^2; of the centres of circles: m^2. Shape `[S, 2, 2]`.
    """
    moved = jnp.moveaxis(belief.by_map[:, sightings.slot], 0, 1)
    common = product(product(sightings.jac_pose, moved), jnp.swapaxes(sightings.by_map, -1, -2))
    of_pose = propagate(sightings.jac_pose, belief.cov)
    return of_pose + common + jnp.swapaxes(common, -1, -2) + squared(sightings.by_map) + sightings.cov


def gated(belief: Belief, at: Float[Array, "3"], sightings: Sightings, most: Number) -> Sightings:
    """The sightings whose normalised innovation squared, by a belief, is less than `most`.

    Args:
      belief: that judges.
      at: the pose at which the sightings are linearised.
      sightings: `S` of them.
      most: the gate, a quantile of chi-square with 2 degrees of freedom.

    Returns:
      The sightings; those beyond the gate are not valid.
    """
    innovation = sightings.innovation - jnp.sum(sightings.jac_pose * _minus(at, belief.mean)[None, None], -1)
    nis = quadratic(innovation, inverse(innovation_cov(belief, sightings)))
    return _only(sightings, nis < most)


def update_with_consistent(
    belief: Belief, at: Float[Array, "3"], sightings: Sightings, most: Number
) -> tuple[Belief, Sightings, Float[Array, ""]]:
    """The belief after those sightings that agree with each other: Baarda's data snooping.

    What has moved may lie where a prediction has it that knows little of the heading, and pull the pose until it fits
    and nothing else does. The rest of the scan tells: as long as there is a sighting that the belief and all others
    together say to be impossible, the most impossible one is left out.

    Args:
      belief: before.
      at: the pose at which the sightings are linearised.
      sightings: `S` of them.
      most: the gate, a quantile of chi-square with 2 degrees of freedom.

    Returns:
      The belief, as of `update`; the sightings, those left out not valid; and the NIS of those that are left.
    """

    def left_out(carry: tuple[Sightings, Belief, Array, Array]) -> tuple[Sightings, Belief, Array, Array]:
        sightings = carry[0]
        after, nis, nis_of_each = update(belief, at, sightings)
        worst = jnp.max(nis_of_each)
        bad = worst >= most
        return _only(sightings, ~bad | (nis_of_each < worst)), after, nis, bad

    carry = (sightings, belief, jnp.zeros((), belief.mean.dtype), jnp.asarray(True))
    sightings, after, nis, _ = jax.lax.while_loop(lambda carry: carry[3], left_out, carry)
    return after, sightings, nis


def update(
    belief: Belief, at: Float[Array, "3"], sightings: Sightings
) -> tuple[Belief, Float[Array, ""], Float[Array, " S"]]:
    """The belief after all sightings of a scan together, and their normalised innovation squared.

    With T = cov(y - H own), the gain of the own part is that of a Kalman filter, C+ H' T^-1 with
    C+ = (1 + C_own H' T^-1 H)^-1 C_own; what the map's errors have in common with y gives the rest. T is built from the
    map's errors and the noise alone, so that float32 stands a pose of which nothing is known yet.

    Args:
      belief: before.
      at: the pose at which the sightings are linearised.
      sightings: what the scan has seen from there.

    Returns:
      The belief, with a covariance that is a sum of squares; the NIS, of 2 degrees of freedom for each sighting; and
      for each sighting alone the NIS of what it is found to be, by the belief and all the others. Shape `[S]`.
    """
    n, dtype = sightings.valid.shape[0], belief.mean.dtype
    by_map, cov = sightings.by_map, sightings.cov
    h = sightings.jac_pose.reshape(2 * n, 3)
    y = sightings.innovation.reshape(-1) - h @ _minus(at, belief.mean)
    root = belief.by_map.reshape(3, -1)
    of_map = root @ root.T
    moved = jnp.moveaxis(belief.by_map[:, sightings.slot], 0, 1)
    common = jnp.moveaxis(product(moved, jnp.swapaxes(by_map, -1, -2)), 1, 0).reshape(3, 2 * n)
    same = (sightings.slot[:, None] == sightings.slot[None]).astype(dtype)
    of_walls = jnp.einsum("iab,jcb,ij->iajc", by_map, by_map, same).reshape(2 * n, 2 * n)
    of_noise = jnp.einsum("iab,ij->iajb", cov, jnp.eye(n, dtype=dtype)).reshape(2 * n, 2 * n)
    mixed = h @ common
    total = h @ of_map @ h.T + mixed + mixed.T + of_walls + of_noise
    white = _inverse_root(total)
    h_white, y_white, common_white = white @ h, white @ y, white @ (of_map @ h.T + common).T
    # (1 + C_own J)^-1 C_own = R (1 + R' J R)^-1 R', J = H' T^-1 H: of a symmetric matrix, and no inverse of C_own.
    root = square_root(belief.cov_own)
    j_root = h_white @ root
    own = root @ inverse(jnp.eye(3, dtype=dtype) + j_root.T @ j_root) @ root.T
    gain = own @ h_white.T
    gain = (gain + common_white.T - common_white.T @ h_white @ gain) @ white
    nis = jnp.sum(y_white**2) - quadratic(h_white.T @ y_white, own)
    # S^-1 = W' (1 - H_w C+ H_w') W, by blocks. What the others leave open of one is the inverse of its own block of it.
    residual = y_white - h_white @ (own @ (h_white.T @ y_white))
    unlikely = (white.T @ residual).reshape(n, 2)
    blocks, through = white.reshape(2 * n, n, 2), (h_white.T @ white).reshape(3, n, 2)
    information = jnp.einsum("kia,kib->iab", blocks, blocks) - jnp.einsum("cia,cd,dib->iab", through, own, through)
    nis_of_each = quadratic(unlikely, inverse(information))

    left = jnp.eye(3, dtype=dtype) - gain @ h
    of_each = gain.reshape(3, n, 2)
    added = jnp.einsum("cna,nab->cnb", of_each, by_map)
    carried = jnp.einsum("ij,jmk->imk", left, belief.by_map)
    after = dataclasses.replace(
        belief,
        mean=_minus(belief.mean, gain @ y),
        cov_own=propagate(left, belief.cov_own) + symmetric(jnp.einsum("cna,nab,dnb->cd", of_each, cov, of_each)),
        by_map=carried.at[:, sightings.slot].add(-added),
    )
    return after, nis, nis_of_each


def _inverse_root(matrix: Float[Array, "n n"]) -> Float[Array, "n n"]:
    """W with W A W^T = 1, lower triangular: the inverse of Cholesky's root, by elimination.

    Written out: it is as fast as LAPACK here, and runs on every device.
    """
    n = matrix.shape[0]
    rows = jnp.arange(n)

    def step(k: Array, both: Float[Array, "n m"]) -> Float[Array, "n m"]:
        column = both[:, k]
        pivot = 1 / jnp.sqrt(column[k])
        row = both[k] * pivot
        below = jnp.where(rows > k, column * pivot, 0)
        return (both - below[:, None] * row[None]).at[k].set(row)

    both = jnp.concatenate([matrix, jnp.eye(n, dtype=matrix.dtype)], 1)
    return jax.lax.fori_loop(0, n, step, both)[:, n:]


def fit_of_scan(
    seen: Seen, pose: Float[Array, "3"], lines: Lines, field: LikelihoodField, settings: LocalizationSettings
) -> Float[Array, ""]:
    """How well the map explains a scan: the share of returns near something of it, less that of returns behind a wall.

    What the map lacks makes returns nearer than it would have them, and speaks neither for nor against a pose. A return
    from behind a line that was seen often speaks against it.

    Args:
      seen: what the scan holds.
      pose: of the robot, from which it is judged. m, m, rad.
      lines: those of the map, directed.
      field: of the map.
      settings: `explained_distance` and `through_distance`.

    Returns:
      From -1, all of it contradicts, to 1, all of it is explained; 0 without a return.
    """
    points, valid = thinned(seen.points, seen.returned)
    ranges, _ = thinned(seen.ranges[:, None], seen.returned)
    beams, _ = thinned(seen.beams, seen.returned)
    points = pose[None, :2] + rotate(pose[2], points)
    beams = rotate(pose[2], beams)
    explained = valid & (distances(field, points) < settings.explained_distance)

    back = (pose[:2] + rotate(pose[2], seen.laser))[None] - lines.anchor
    height = lines.offset - dot(lines.normal, back)
    slope = dot(lines.normal[None], beams[:, None])
    meets = jnp.abs(slope) > GRAZING
    reach = height[None] / jnp.where(meets, slope, 1)
    along = dot(lines.tangent, back)[None] + reach * dot(lines.tangent[None], beams[:, None])
    margin = settings.explained_distance
    inside = (along > lines.extent[None, :, 0] + margin) & (along < lines.extent[None, :, 1] - margin)
    behind = meets & (reach > 0) & (reach < ranges - settings.through_distance)
    often = lines.valid & (lines.times_detected >= OFTEN)
    through = valid & ~explained & jnp.any(inside & behind & often[None], -1)
    count = jnp.maximum(jnp.sum(valid), 1).astype(pose.dtype)
    # Without a return there is nothing to judge by.
    return jnp.where(jnp.any(valid), (jnp.sum(explained) - jnp.sum(through)) / count, 0).astype(pose.dtype)


def _less_sure(
    belief: Belief, used: Bool[Array, ""], lost: Bool[Array, ""], field: LikelihoodField, settings: LocalizationSettings
) -> Belief:
    """The belief after a scan that the map does not explain: the wheels may have slipped unseen.

    Of a robot that is lost: it may have gone anywhere, but is not likely to have left the map.
    """
    dtype = belief.mean.dtype
    slipped = _diagonal(settings.slip_position, settings.slip_heading, dtype)
    more = jnp.where(lost, _diagonal(settings.lost_position, settings.lost_heading, dtype), slipped)
    most = jnp.stack([field.cell * field.distance.shape[0] / 2] * 2 + [jnp.asarray(np.pi, dtype)]) ** 2
    room = jnp.diag(belief.cov) < most
    return dataclasses.replace(belief, cov_own=belief.cov_own + jnp.where(used, 0, more * room[None]))


def _minus(a: Float[Array, "3"], b: Float[Array, "3"]) -> Float[Array, "3"]:
    """Difference of two poses, or a pose less an error: the heading wrapped."""
    change = a - b
    return change.at[2].set(wrap_angle(change[2]))


def _diagonal(position: Number, heading: Number, dtype: Any) -> Float[Array, "3 3"]:
    sigma = jnp.stack([jnp.asarray(position), jnp.asarray(position), jnp.asarray(heading)]).astype(dtype)
    return jnp.diag(sigma**2)


def _root(cov: Float[Array, "3 3"]) -> Float[Array, "3 3"]:
    """A square root, upper triangular: a step of heading takes the position along, as the errors of a drive do."""
    return square_root(cov[::-1, ::-1])[::-1, ::-1]


def _where(
    valid: Bool[Array, " S"],
    *,
    slot: Int[Array, " S"],
    innovation: Float[Array, "S 2"],
    jac_pose: Float[Array, "S 2 3"],
    by_map: Float[Array, "S 2 2"],
    cov: Float[Array, "S 2 2"],
) -> Sightings:
    """Sightings, neutral where they are not valid."""
    nothing = Sightings(
        slot=jnp.zeros_like(slot),
        innovation=jnp.zeros_like(innovation),
        jac_pose=jnp.zeros_like(jac_pose),
        by_map=jnp.zeros_like(by_map),
        cov=jnp.broadcast_to(jnp.eye(2, dtype=cov.dtype), cov.shape),
        valid=valid,
    )
    these = Sightings(slot=slot, innovation=innovation, jac_pose=jac_pose, by_map=by_map, cov=cov, valid=valid)
    chosen = choose(valid, these, nothing)
    return dataclasses.replace(chosen, slot=chosen.slot.astype(jnp.int32))


def _only(sightings: Sightings, which: Bool[Array, " S"]) -> Sightings:
    """These sightings, the others not valid."""
    fields = {field.name: getattr(sightings, field.name) for field in dataclasses.fields(sightings)}
    return _where(fields.pop("valid") & which, **fields)


def _no_sightings(count: int, dtype: Any) -> Sightings:
    return _where(
        jnp.zeros(count, bool),
        slot=jnp.zeros(count, jnp.int32),
        innovation=jnp.zeros((count, 2), dtype),
        jac_pose=jnp.zeros((count, 2, 3), dtype),
        by_map=jnp.zeros((count, 2, 2), dtype),
        cov=jnp.zeros((count, 2, 2), dtype),
    )


def _packed(parts: list[Sightings]) -> Sightings:
    """The first `SIGHTINGS` valid ones of all."""
    joined = jax.tree.map(lambda *x: jnp.concatenate(x), *parts)
    n = joined.valid.shape[0]
    index = all_true(joined.valid, SIGHTINGS)
    rows = jax.tree.map(lambda x: x[jnp.minimum(index, n - 1)], joined)
    return _where(
        index < n,
        slot=rows.slot,
        innovation=rows.innovation,
        jac_pose=rows.jac_pose,
        by_map=rows.by_map,
        cov=rows.cov,
    )
