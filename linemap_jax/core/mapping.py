"""Sections 5 and 6 as a whole: one scan into the map.

The lines of a scan are taken all at once: matched with the map as it stood, fused, added; then the map is wiped. The
paper takes them one after the other, which gives nearly the same map and no parallelism.
"""

import dataclasses
from collections.abc import Callable
from functools import partial
from typing import NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int

from linemap_jax.core import fusion, matching, wiping
from linemap_jax.core.circles import near_lines
from linemap_jax.core.extract import as_dtype, observe, with_defaults
from linemap_jax.core.frames import dot
from linemap_jax.core.sensor import Points
from linemap_jax.core.settings import (
    SCAN_CAPACITY,
    Capacity,
    Covariance,
    Jacobians,
    Mount,
    Number,
    Persistence,
    PoseError,
    Rules,
    Segmentation,
    SensorNoise,
    Thresholds,
    persistence_of,
)
from linemap_jax.core.slots import choose, directed, first_of_group, free_slots, neutral_where_free, put, take
from linemap_jax.core.state import (
    LEFT_OUT,
    NEW,
    Circles,
    Extraction,
    LineMap,
    Lines,
    Pose,
    Report,
    Scan,
    SlotsT,
    Status,
    empty_circles,
    empty_lines,
)


def empty_map(capacity: Capacity = Capacity(), dtype: jnp.dtype | type | None = None) -> LineMap:
    """A map with free slots only. The dtype is jax's default unless given; it should be that of the scans.

    Args:
      capacity: slots for lines and circles. What finds no free slot is left out, and the status of `update` tells;
        `build` makes room by itself.
      dtype: of all numbers, that of the scans to come; jax's default unless given.

    Returns:
      The map, with free slots only.
    """
    return LineMap(lines=empty_lines(capacity.lines, dtype), circles=empty_circles(capacity.circles, dtype))


@partial(
    jax.jit,
    static_argnames=("pose_error", "capacity", "rules", "segmentation", "max_vertices", "covariance", "jacobians"),
)
def update(
    line_map: LineMap,
    scan: Scan,
    pose: Pose,
    *,
    thresholds: Thresholds | None = None,
    noise: SensorNoise | None = None,
    mount: Mount | None = None,
    pose_error: PoseError = "unknown",
    persistence: Persistence | None = None,
    capacity: Capacity = SCAN_CAPACITY,
    rules: Rules = Rules(),
    segmentation: Segmentation = "incremental",
    max_vertices: int | None = None,
    covariance: Covariance = "exact",
    jacobians: Jacobians = "analytic",
) -> tuple[LineMap, Report]:
    """Bring one scan into the map: extract, match, fuse or add, merge, wipe.

    A scan without returns, or with a pose that is not finite, changes nothing. To differentiate, go forward (`jax.jvp`,
    `jax.jacfwd`): wiping loops for as long as there are lines to cut, and jax takes no such loop backwards.

    Args:
      line_map: the map so far.
      scan: `N` beams, of the dtype of the map.
      pose: of the robot.
      thresholds: `Thresholds()` unless given.
      noise: of the sensor; `SensorNoise()` unless given.
      mount: of the scanner on the robot; at its centre, looking ahead, unless given.
      pose_error: how the errors of the poses of several scans hang together. "independent", as Eq. (23) takes them;
        "persistent", by the model that `persistence` gives; "unknown": the covariances of the map are bounds that hold
        for every possible correlation.
      persistence: for "persistent"; `Persistence()` unless given.
      capacity: slots for the lines and circles of the scan (those of the map are its own).
      rules: which reading of the method.
      segmentation: as for `extract`.
      max_vertices: as for `extract`.
      covariance: as for `extract`.
      jacobians: as for `extract`.

    Returns:
      The map, and what the scan did to it. When a capacity is full, what fits is kept and the status tells.

    Raises:
      ValueError: at trace time, for an option that does not exist or a map of another dtype than the scan.
    """
    dtype = scan.ranges.dtype
    if line_map.lines.offset.dtype != dtype:
        raise ValueError(f"the map is {line_map.lines.offset.dtype} and the scan {dtype}; make both the same")
    thresholds, noise, mount = with_defaults(thresholds, noise, mount, dtype)
    points, pose, found = observe(
        scan,
        pose,
        thresholds,
        noise,
        mount,
        capacity=capacity,
        rules=rules,
        segmentation=segmentation,
        max_vertices=max_vertices,
        covariance=covariance,
        jacobians=jacobians,
    )
    lasting = as_dtype(persistence_of(pose_error, persistence), dtype)
    return integrate(line_map, points, pose, found, thresholds, noise, lasting, pose_error=pose_error, rules=rules)


def integrate(
    line_map: LineMap,
    points: Points,
    pose: Pose,
    found: Extraction,
    thresholds: Thresholds,
    noise: SensorNoise,
    lasting: Persistence,
    *,
    pose_error: PoseError,
    rules: Rules,
) -> tuple[LineMap, Report]:
    """`update`, from the lines and circles of the scan on: match, fuse or add, merge, wipe.

    Args:
      line_map: the map so far.
      points: the points of the scan, whose beams wipe.
      pose: of the robot, finite.
      found: what the points hold; see `observe`.
      thresholds: gates, and how far wiping reaches.
      noise: of the sensor.
      lasting: what of the pose error persists, by `persistence_of`.
      pose_error: as for `update`.
      rules: which reading of the method.

    Returns:
      The map, and what the scan did to it.
    """
    if pose_error == "persistent":
        # A scan without returns is none, so that a chunk may be filled up with such.
        kept = jnp.where(jnp.any(points.valid), jnp.square(lasting.correlation), 1)
        line_map = dataclasses.replace(
            line_map,
            lines=fusion.forget(line_map.lines, kept),
            circles=fusion.forget(line_map.circles, kept),
        )
    lines = _update_lines(line_map.lines, found, pose, thresholds, rules, pose_error, lasting.share)
    swept = _sweep(line_map.circles, lines, found, points, pose, thresholds, noise, rules)
    circles = _update_circles(
        line_map.circles,
        found,
        swept.lines,
        lines,
        swept.gone,
        thresholds,
        rules,
        pose_error,
        lasting.share,
    )

    status = found.status | jnp.where(lines.overflow | swept.wiped.overflow, int(Status.MAP_LINES_FULL), 0)
    status |= jnp.where(circles.overflow, int(Status.MAP_CIRCLES_FULL), 0)
    report = Report(
        line_slot=lines.slot,
        line_nis=lines.nis,
        line_dof=lines.dof,
        circle_slot=circles.slot,
        circle_nis=circles.nis,
        circle_dof=circles.dof,
        added=lines.added + circles.added,
        fused=lines.fused + circles.fused,
        merged=lines.merged,
        trimmed=swept.wiped.trimmed,
        split=swept.wiped.split,
        deleted=lines.gave_way + swept.wiped.deleted + circles.deleted,
        status=status,
    )
    return LineMap(lines=swept.lines, circles=circles.model), report


class _LineUpdate(NamedTuple):
    """What became of the lines of a scan, before wiping."""

    model: Lines
    targets: Array  # [L] slot of the map's line that each new line is now part of, -1 for none
    own: Array  # [L] the same, or the line of the map that made it ambiguous
    slot: Array  # [L] for the report
    nis: Array  # [L]
    dof: Array  # [L]
    added: Array
    fused: Array
    merged: Array
    gave_way: Array
    balance: Array  # m times scans, of the lines that the scan bears out less those that it denies
    overflow: Array


def _update_lines(
    model: Lines,
    found: Extraction,
    pose: Pose,
    thresholds: Thresholds,
    rules: Rules,
    pose_error: PoseError,
    share: Number,
) -> _LineUpdate:
    """Section 5.1: match, then fuse or add, then merge."""
    new = found.lines
    if not rules.share_pose:
        new = fusion.forget(new, jnp.zeros_like(share))

    pair = matching.compare_pieces(new, thresholds)
    apart = fusion.forget(new, share)
    match = matching.match_lines(apart, model, pair.collinear, thresholds, rules, pose_error)
    suspect = match.suspect
    gave_way, balance = jnp.zeros((), jnp.int32), jnp.zeros((), new.offset.dtype)
    if rules.give_way:
        denied = matching.contradicted(apart, model, thresholds, rules, pose_error)
        balance = _balance(model, model.length, match.slot, denied | _marked(suspect, denied.shape[0]))
        model, gave_way = _give_way(model, denied & (balance > 0), match.slot, thresholds)
        suspect = jnp.where(model.valid[suspect], suspect, -1)  # what takes its place is new
    unmatched = new.valid & (match.slot < 0) & (suspect < 0)
    leader = matching.group_lines(pair, unmatched, thresholds)

    has_prior = match.slot >= 0
    leads = leader == jnp.arange(leader.shape[0])
    slot_of_leader, overflow = free_slots(leads, model.valid)
    targets = jnp.where(has_prior, match.slot, jnp.where(leader >= 0, slot_of_leader[leader], -1))
    mine = choose(has_prior, take(model, match.slot), take(new, leader))
    if pose_error == "persistent":
        new = fusion.at_first_angle(new, mine, pose)
    together = (targets[:, None] == targets[None]) & (targets >= 0)[None]
    fused = fusion.fuse_lines(mine, has_prior, new, together, thresholds, rules, pose_error, share)
    # All pieces of a line have the same result; the first one writes it.
    first = first_of_group(together)
    model = put(model, jnp.where(first, targets, -1), fused)

    slot = jnp.where(leader >= 0, NEW, match.slot)
    slot = jnp.where(targets < 0, LEFT_OUT, slot)
    merged = jnp.zeros((), jnp.int32)
    if rules.merge:
        seen_apart = _at_slots(~pair.collinear, targets, model.valid.shape[0])
        touched = jnp.where(first, targets, -1)
        model, moved, merged = merge_lines(model, fused, touched, seen_apart, thresholds, rules, pose_error)
        targets = jnp.where(targets >= 0, moved[targets], targets)
        slot, suspect = (jnp.where(x >= 0, moved[x], x) for x in (slot, suspect))
    return _LineUpdate(
        model=model,
        targets=targets,
        own=jnp.where(targets >= 0, targets, suspect),
        slot=slot,
        nis=match.nis,
        dof=jnp.where(match.compared, 2, 0).astype(jnp.int32),
        added=jnp.sum(slot_of_leader >= 0, dtype=jnp.int32),
        fused=jnp.sum(first & has_prior, dtype=jnp.int32),
        merged=merged,
        gave_way=gave_way,
        balance=balance,
        overflow=overflow,
    )


def _give_way(
    model: SlotsT, denied: Bool[Array, " K"], bearing_out: Int[Array, " L"], thresholds: Thresholds
) -> tuple[SlotsT, Int[Array, ""]]:
    """Let go of what scans contradict: Page's test, of those that deny it against those that bear it out.

    Args:
      model: lines or circles of the map.
      denied: which of them the scan denies.
      bearing_out: for each primitive of the scan the slot of the one that it matches, -1 for none.
      thresholds: `contradictions`.

    Returns:
      The lines or circles, and how many are gone.
    """
    borne_out = _marked(bearing_out, denied.shape[0])
    times = jnp.maximum(model.times_contradicted + jnp.where(borne_out, -1, denied.astype(jnp.int32)), 0)
    enough = times >= jnp.minimum(model.times_detected + 1, thresholds.contradictions)
    gone = model.valid & denied & ~borne_out & enough
    model = dataclasses.replace(model, times_contradicted=times, valid=model.valid & ~gone)
    return model, jnp.sum(gone, dtype=jnp.int32)


def _balance(
    model: SlotsT, size: Float[Array, " K"], bearing_out: Int[Array, " L"], denied: Bool[Array, " K"]
) -> Float[Array, ""]:
    """What a scan bears out of the map less what it denies, by size and by how often it was seen.

    Where a scan denies more than it bears out, its pose is to blame, and not the map.
    """
    sign = jnp.where(_marked(bearing_out, denied.shape[0]), 1, jnp.where(denied, -1, 0))
    return jnp.sum(sign * size * model.times_detected.astype(size.dtype))


def _marked(slots: Int[Array, " L"], capacity: int) -> Bool[Array, " K"]:
    """Which slots are named, -1 for none."""
    return jnp.zeros(capacity, bool).at[jnp.where(slots < 0, capacity, slots)].set(True, mode="drop")


def _at_slots(which: Bool[Array, "L L"], slots: Int[Array, " L"], capacity: int) -> Bool[Array, "L K"]:
    """The columns brought to the slots of the map that they stand for, -1 for none."""
    into = jnp.where(slots < 0, capacity, slots)
    return jnp.zeros((which.shape[0], capacity), bool).at[:, into].max(which, mode="drop")


def merge_lines(
    model: Lines,
    touched: Lines,
    slots: Int[Array, " L"],
    seen_apart: Bool[Array, "L K"],
    thresholds: Thresholds,
    rules: Rules,
    pose_error: PoseError,
    times: Callable[[Array, Array], Array] = jnp.maximum,
) -> tuple[Lines, Int[Array, " K"], Int[Array, ""]]:
    """Join lines of the map that overlap and agree, where this scan touched one of them.

    A line is joined with one other at most; of rival pairs the one with the least NIS is taken. The lower slot stays.

    Args:
      model: the lines of the map.
      touched: the lines that this scan touched, as they now are.
      slots: where they stand, -1 for those that are not meant.
      seen_apart: the lines of the map that this scan has seen beside them.
      thresholds: `match_...`.
      rules: which reading of the method.
      pose_error: its model.
      times: how often a line was detected, from the numbers of its two parts. By default their maximum, since the same
        scans have seen both.

    Returns:
      The lines; for each slot where its line now stands; how many were joined.
    """
    k = model.valid.shape[0]
    everywhere = jnp.arange(k, dtype=jnp.int32)
    others = (slots >= 0)[:, None] & (everywhere[None] != slots[:, None]) & ~seen_apart
    partner, nis = matching.best_line(
        touched, model, thresholds, pose_error, among=others, overlapping=True, same_side=rules.tell_sides
    )
    some = nis < thresholds.match_nis

    pair = jnp.stack([slots, partner], -1)
    shared = jnp.any(pair[:, None, :, None] == pair[None, :, None, :], (-1, -2))
    index = jnp.arange(slots.shape[0])
    better = (nis[None] < nis[:, None]) | ((nis[None] == nis[:, None]) & (index[None] < index[:, None]))
    accepted = some & ~jnp.any(shared & better & some[None], -1)

    other = take(model, partner)
    swap = partner < slots
    stays, goes = choose(swap, other, touched), choose(swap, touched, other)
    # Both are estimates of the whole wall: the one that reaches farther knows the end.
    longest = dataclasses.replace(rules, estimate_ends=False)
    joined = fusion.fuse_lines(stays, accepted, goes, jnp.diag(accepted), thresholds, longest, pose_error)
    joined = dataclasses.replace(joined, times_detected=times(stays.times_detected, goes.times_detected))
    low, high = jnp.min(pair, -1), jnp.max(pair, -1)
    model = put(model, jnp.where(accepted, low, -1), joined)
    gone = jnp.where(accepted, high, k)
    model = dataclasses.replace(model, valid=model.valid.at[gone].set(False, mode="drop"))
    return model, everywhere.at[gone].set(low, mode="drop"), jnp.sum(accepted, dtype=jnp.int32)


class _Sweep(NamedTuple):
    """What wiping did."""

    lines: Lines
    wiped: wiping.Wiped
    gone: Array  # [C] circles of the map that are no longer there


def _sweep(
    circles: Circles,
    lines: _LineUpdate,
    found: Extraction,
    points: Points,
    pose: Pose,
    thresholds: Thresholds,
    noise: SensorNoise,
    rules: Rules,
) -> _Sweep:
    """Section 6: by beams or by triangles."""
    slots = jnp.arange(lines.model.valid.shape[0], dtype=jnp.int32)

    def var_cut(line: Lines, along: Array) -> Array:
        return wiping.var_of_cut(line, along, points, pose, noise)

    if rules.wipe_by_beams:
        line_of_point = jnp.where(points.valid, found.line_of_beam[points.index], -1)
        times = jnp.where(lines.targets >= 0, lines.model.times_detected[lines.targets], 0)
        swath = wiping.swath_of_scan(points, pose, line_of_point, found.lines, lines.own, times, thresholds)
        affected = jax.vmap(lambda line, slot: wiping.may_have_passed(line, slot, swath, thresholds, rules))(
            directed(lines.model), slots
        )
        model, wiped = wiping.wipe_lines(
            lines.model,
            affected,
            lambda line, slot: wiping.passed_through(line, slot, swath, pose.cov, thresholds, noise, rules),
            var_cut,
            thresholds,
            share_information=rules.merge,
        )
        gone = wiping.passed_circles(circles, swath, pose.cov, thresholds, noise)
    else:
        triangles = wiping.triangles_of_scan(points, pose, lines.model, lines.targets, thresholds)

        def inside(line: Lines, slot: Array) -> wiping.Stretches:
            return wiping.inside_triangles(line, slot, triangles)

        affected = jax.vmap(lambda line, slot: jnp.any(inside(line, slot)[2]))(lines.model, slots)
        model, wiped = wiping.wipe_lines(
            lines.model, affected, inside, var_cut, thresholds, share_information=rules.merge
        )
        gone = wiping.circles_inside_triangles(circles, triangles)
    return _Sweep(neutral_where_free(model), wiped, gone)


class _CircleUpdate(NamedTuple):
    """What became of the circles of a scan."""

    model: Circles
    slot: Array  # [C] for the report
    nis: Array  # [C]
    dof: Array  # [C]
    added: Array
    fused: Array
    deleted: Array
    overflow: Array


def _update_circles(
    model: Circles,
    found: Extraction,
    lines: Lines,
    seen: _LineUpdate,
    gone: Bool[Array, " K"],
    thresholds: Thresholds,
    rules: Rules,
    pose_error: PoseError,
    share: Number,
) -> _CircleUpdate:
    """Section 5.2: match, then fuse or add; and none too close to a line."""
    new = fusion.forget(found.circles, share)
    match = matching.match_circles(new, model, thresholds, rules, pose_error)
    k = model.valid.shape[0]
    matched = _marked(match.slot, k)
    gone = gone & ~matched
    suspect, gave_way = match.suspect, jnp.zeros((), jnp.int32)
    if rules.give_way:
        other = take(model, suspect)
        step = new.center - other.center
        overlap = dot(step, step) < jnp.square(new.radius + other.radius)
        balance = seen.balance + _balance(model, 2 * model.radius, match.slot, _marked(suspect, k))
        denied = _marked(jnp.where(overlap, suspect, -1), k) & (balance > 0) & ~gone
        model, gave_way = _give_way(model, denied, match.slot, thresholds)
        suspect = jnp.where(model.valid[suspect], suspect, -1)
    model = fusion.fuse_circles(model, new, match, rules, pose_error)
    model = dataclasses.replace(model, valid=model.valid & ~gone)

    fresh = new.valid & (match.slot < 0) & (suspect < 0) & ~near_lines(new, lines, thresholds, rules)
    slot, overflow = free_slots(fresh, model.valid)
    # A circle that is not fitted is the visible arc and moves with the viewpoint: its covariance is this scan's alone.
    names = ("cov_independent", "sqrt_persistent")
    lasting = {name: jnp.where(new.fitted[:, None, None], getattr(new, name), 0) for name in names}
    model = put(model, slot, dataclasses.replace(new, **lasting))

    # Only lines that this scan touched can have come near a circle.
    touched = take(lines, seen.targets)
    touched = dataclasses.replace(touched, valid=touched.valid & (seen.targets >= 0))
    near = near_lines(model, touched, thresholds, rules)
    model = dataclasses.replace(model, valid=model.valid & ~near)
    report = jnp.where(match.slot >= 0, match.slot, jnp.where(slot >= 0, NEW, LEFT_OUT))
    return _CircleUpdate(
        model=neutral_where_free(model),
        slot=report,
        nis=match.nis,
        dof=match.dof,
        added=jnp.sum(slot >= 0, dtype=jnp.int32),
        fused=jnp.sum(matched, dtype=jnp.int32),
        deleted=jnp.sum(gone, dtype=jnp.int32) + jnp.sum(near, dtype=jnp.int32) + gave_way,
        overflow=overflow,
    )
