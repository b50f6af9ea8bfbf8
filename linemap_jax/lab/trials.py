"""A trial: one simulated drive, mapped scan by scan and scored; made to be run by the thousand.

`trial` is an experiment of `batch`: a pure function of what one run differs by, whose outcome is one row of a table.
"""

import dataclasses
from collections.abc import Mapping, Sequence
from functools import partial
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Int

from linemap_jax.core.extract import as_dtype, observe, with_defaults
from linemap_jax.core.fields import documented
from linemap_jax.core.mapping import empty_map, integrate
from linemap_jax.core.settings import (
    Capacity,
    Covariance,
    Jacobians,
    Number,
    Persistence,
    PoseError,
    Rules,
    Segmentation,
    SensorNoise,
    Thresholds,
    persistence_of,
)
from linemap_jax.core.state import LineMap, Pose, Status, pytree
from linemap_jax.lab import scoring
from linemap_jax.lab.consistency import CHI2_95
from linemap_jax.lab.robot import drive, estimate_poses
from linemap_jax.lab.scanners import Scanner, noise_of, simulate_scan
from linemap_jax.lab.scoring import GONE, MIN_RETURNS, THERE, Seen
from linemap_jax.lab.world import NEVER, World

SCANS_TO_NOTICE = 3
"""A change has been noticed in time if the map shows it after so many scans that could tell."""


@pytree
class Trial:
    """What one trial may differ by from another."""

    key: Any
    """PRNG key of all noise."""
    world: World
    """With a path of one way point at least."""
    thresholds: Thresholds = Thresholds()
    """Of the map builder."""
    noise: SensorNoise | None = None
    """What the map builder believes; that of the scanner unless given."""


@pytree
class Conditions:
    """What the trials have in common."""

    scanner: Scanner
    """The instrument."""
    cov_pose: Float[Array, "3 3"]
    """Covariance of each believed pose, in the axes of the world: m^2, m rad, rad^2."""
    correlation: Number = 0.0
    """Of the pose error, from one scan to the next; see `robot.pose_errors`."""


@pytree
class Outcome:
    """What a trial comes to. Lengths and errors are those of `scoring.evaluate` after the last scan."""

    line_length: Float[Array, ""]
    """Length of all lines, m."""
    line_length_on_walls: Float[Array, ""]
    """Length of theirs that is on walls, m."""
    wall_seen: Float[Array, ""]
    """How much wall has been seen, m."""
    wall_held: Float[Array, ""]
    """How much of that has a line on it, m."""
    lines: Int[Array, ""]
    """Lines of the map."""
    phantom_lines: Int[Array, ""]
    """Lines of which less than half is on walls."""
    walls: Int[Array, ""]
    """Walls that have been seen."""
    duplicates: Int[Array, ""]
    """Walls that are held twice."""
    fragments: Int[Array, ""]
    """Pieces in which walls are held, beyond one each."""
    lines_on_walls: Int[Array, ""]
    """Lines that run along a wall."""
    square_error: Float[Array, "2"]
    """Sums of the squared errors of offset and angle over the lines on walls. m^2, rad^2."""
    nees: Float[Array, ""]
    """Sum of their NEES."""
    covered: Int[Array, ""]
    """How many of them have the truth inside their 95 % ellipse."""
    poles: Int[Array, ""]
    """Poles that are there and have been seen."""
    missed_poles: Int[Array, ""]
    """Poles on which there is no circle, of these."""
    circles: Int[Array, ""]
    """Circles of the map."""
    phantom_circles: Int[Array, ""]
    """Circles on no pole and near no wall."""
    true_matches: Int[Array, ""]
    """True matches of lines, over all scans; see `scoring.Matches`."""
    false_matches: Int[Array, ""]
    """False ones."""
    missed_matches: Int[Array, ""]
    """Missed ones."""
    vanished: Int[Array, ""]
    """Objects that the map held, and that beams then passed through in `SCANS_TO_NOTICE` scans."""
    gone: Int[Array, ""]
    """Of these, gone from the map after so many."""
    appeared: Int[Array, ""]
    """Objects that came, and of which `SCANS_TO_NOTICE` scans had returns."""
    noticed: Int[Array, ""]
    """Of these, in the map after so many."""
    full: Bool[Array, ""]
    """Whether the map or a scan had no slot left."""


def trial(
    run: Trial,
    conditions: Conditions,
    *,
    scans: int,
    map_capacity: Capacity = Capacity(96, 48),
    capacity: Capacity = Capacity(24, 32),
    pose_error: PoseError = "unknown",
    persistence: Persistence | None = None,
    rules: Rules = Rules(),
    segmentation: Segmentation = "incremental",
    covariance: Covariance = "exact",
    jacobians: Jacobians = "analytic",
) -> Outcome:
    """Drive along the path of a world, map what is seen, and hold the map against the truth.

    Args:
      run: what this trial differs by.
      conditions: what all have in common.
      scans: number of scans along the path.
      map_capacity: slots of the map.
      capacity: slots for what one scan holds.
      pose_error: as for `update`, and so are the others; thresholds and noise are those of the run.
      persistence: for "persistent".
      rules: which reading of the method.
      segmentation: how points are divided into lines.
      covariance: "exact" or "printed".
      jacobians: "autodiff" or "analytic".

    Returns:
      Counts and sums, from which `summary` makes shares.
    """
    world, scanner = run.world, conditions.scanner
    dtype = world.dtype
    of_scans, of_poses = jax.random.split(run.key)
    path = drive(world.path, count=scans)
    believed = estimate_poses(
        of_poses, path, jnp.asarray(conditions.cov_pose, dtype), correlation=conditions.correlation
    )
    noise = noise_of(scanner) if run.noise is None else run.noise
    thresholds, noise, mount = with_defaults(run.thresholds, noise, None, dtype)
    lasting = as_dtype(persistence_of(pose_error, persistence), dtype)
    look = partial(
        observe,
        capacity=capacity,
        rules=rules,
        segmentation=segmentation,
        covariance=covariance,
        jacobians=jacobians,
    )

    def step(carry: tuple[LineMap, Seen], x: tuple[Array, Array, Pose, Array]) -> tuple[tuple[LineMap, Seen], Any]:
        before, seen = carry
        key, pose, estimate, index = x
        scan, truth = simulate_scan(key, world, pose, scanner, scan_index=index)
        points, estimate, found = look(scan, estimate, thresholds, noise, mount)
        line_map, report = integrate(
            before, points, estimate, found, thresholds, noise, lasting, pose_error=pose_error, rules=rules
        )
        matches = scoring.judge_matches(before.lines, found, report.line_slot, world, truth, scan_index=index)
        seen = scoring.look(seen, world, scan, truth, pose)
        beams = scoring.beams_on_objects(world, scan, truth, pose, scan_index=index)
        held = scoring.held(line_map, world, seen, scan_index=index)
        return (line_map, seen), (matches, held, *beams, report.status)

    start = (empty_map(map_capacity, dtype), scoring.seen_nothing(world))
    index = jnp.arange(scans, dtype=jnp.int32)
    (line_map, seen), (matches, held, on, through, status) = jax.lax.scan(
        step, start, (jax.random.split(of_scans, scans), path, believed, index)
    )
    matches = jax.tree.map(jnp.sum, matches)
    last = scans - 1
    score = scoring.evaluate(line_map, world, seen, scan_index=last)
    on_wall = score.wall_of_line >= 0
    vanished, gone, appeared, noticed = _changes(world, held, on, through)
    full = Status.SCAN_LINES_FULL | Status.SCAN_CIRCLES_FULL | Status.MAP_LINES_FULL | Status.MAP_CIRCLES_FULL
    return Outcome(
        line_length=score.line_length,
        line_length_on_walls=score.line_length_on_walls,
        wall_seen=jnp.sum(score.wall_seen),
        wall_held=jnp.sum(score.wall_held),
        lines=_count(line_map.lines.valid),
        phantom_lines=_count(score.phantom_line),
        walls=_count(score.wall_seen > 0),
        duplicates=score.duplicates,
        fragments=score.fragments,
        lines_on_walls=_count(on_wall),
        square_error=jnp.sum(jnp.square(score.line_error), 0),
        nees=jnp.sum(score.line_nees),
        covered=_count(on_wall & (score.line_nees < CHI2_95[2])),
        poles=_count(score.missed_pole | (score.circles_of_pole > 0)),
        missed_poles=_count(score.missed_pole),
        circles=_count(line_map.circles.valid),
        phantom_circles=_count(score.phantom_circle),
        true_matches=matches.true,
        false_matches=matches.false,
        missed_matches=matches.missed,
        vanished=_count(vanished),
        gone=_count(gone),
        appeared=_count(appeared),
        noticed=_count(noticed),
        full=jnp.any(status & int(full) != 0),
    )


def _changes(
    world: World, held: Float[Array, "T O"], on: Int[Array, "T O"], through: Int[Array, "T O"]
) -> tuple[Bool[Array, " O"], Bool[Array, " O"], Bool[Array, " O"], Bool[Array, " O"]]:
    """Which objects the map has held that then vanished, and which of them are gone in time; and as much of new ones.

    A change that is done before three scans could tell of it counts as well; one that had fewer and is not, does not.
    """
    appears, vanishes, exists = scoring.times_of_objects(world)
    scans = held.shape[0]
    before = held[jnp.clip(vanishes - 1, 0, scans - 1), jnp.arange(held.shape[1])]
    until_gone, is_gone = scoring.scans_until(held < GONE, through >= MIN_RETURNS, vanishes)
    until_there, is_there = scoring.scans_until(held >= THERE, on >= MIN_RETURNS, appears)

    def judged(counts: Array, until: Array, is_done: Array) -> tuple[Array, Array]:
        counts = counts & (until > 0) & (is_done | (until >= SCANS_TO_NOTICE))
        return counts, counts & is_done & (until <= SCANS_TO_NOTICE)

    vanished = exists & (vanishes < NEVER) & (vanishes > appears) & (before >= THERE)
    return *judged(vanished, until_gone, is_gone), *judged(exists & (appears > 0), until_there, is_there)


def _count(which: Bool[Array, " A"]) -> Int[Array, ""]:
    return jnp.sum(which, dtype=jnp.int32)


FACTORS = (0.25, 0.5, 0.7, 1.0, 1.4, 2.0, 4.0)
"""By which a threshold is multiplied in a sweep."""


def sweep(thresholds: Thresholds, names: Sequence[str]) -> tuple[list[tuple[str, float]], Thresholds]:
    """Thresholds of which one at a time is varied, by `FACTORS`.

    Args:
      thresholds: from which is started.
      names: of the fields that are varied.

    Returns:
      Name and value of what is varied; and the thresholds, stacked alike. Without names, the thresholds as they are,
      under an empty name.
    """
    varied = [(name, factor * float(getattr(thresholds, name))) for name in names for factor in FACTORS]
    variants = [dataclasses.replace(thresholds, **{name: value}) for name, value in varied]
    if not varied:
        varied, variants = [("", 0.0)], [thresholds]
    return varied, jax.tree.map(lambda *x: jnp.asarray(x), *variants)


def columns_of(outcomes: Outcome) -> dict[str, np.ndarray]:
    """Stacked `outcomes` as the columns of a table, by the names of the fields."""
    return {field.name: np.asarray(getattr(outcomes, field.name)) for field in dataclasses.fields(Outcome)}


def summary(columns: Mapping[str, np.ndarray]) -> dict[str, Any]:
    """What many trials come to together: totals, and shares of these; None for a share of nothing.

    Args:
      columns: as of `columns_of`, `[R]` rows each.

    Returns:
      Numbers by their names, for JSON.
    """
    total = {field.name: np.sum(columns[field.name], 0) for field in dataclasses.fields(Outcome)}

    def share(part: str, whole: str) -> float | None:
        return float(total[part] / total[whole]) if total[whole] > 0 else None

    on_walls = int(total["lines_on_walls"])
    # Lines of one drive err alike; so the error of the ratio is taken over drives.
    nees_error = None
    if on_walls:
        off = columns["nees"] - total["nees"] / on_walls * columns["lines_on_walls"]
        nees_error = float(np.sqrt(np.sum(np.square(off))) / on_walls)
    offset, angle = np.sqrt(total["square_error"] / on_walls).tolist() if on_walls else (None, None)
    matches = int(total["true_matches"] + total["false_matches"] + total["missed_matches"])
    return {
        "runs": len(columns["lines"]),
        "precision": share("line_length_on_walls", "line_length"),
        "recall": share("wall_held", "wall_seen"),
        "lines": int(total["lines"]),
        "phantom_lines": share("phantom_lines", "lines"),
        "walls": int(total["walls"]),
        "duplicates": share("duplicates", "walls"),
        "fragments": int(total["fragments"]),
        "offset_rms_m": offset,
        "angle_rms_rad": angle,
        "mean_nees": share("nees", "lines_on_walls"),
        "mean_nees_error": nees_error,
        "covered": share("covered", "lines_on_walls"),
        "poles": int(total["poles"]),
        "missed_poles": share("missed_poles", "poles"),
        "circles": int(total["circles"]),
        "phantom_circles": share("phantom_circles", "circles"),
        "matches": matches,
        "false_matches": float(total["false_matches"] / matches) if matches else None,
        "missed_matches": float(total["missed_matches"] / matches) if matches else None,
        "vanished": int(total["vanished"]),
        "gone": share("gone", "vanished"),
        "appeared": int(total["appeared"]),
        "noticed": share("noticed", "appeared"),
        "full": int(total["full"]),
    }


SURE_SIGMAS = 3.0
"""A value of a threshold is recommended in place of the present one if it is better by so many standard errors."""


def mistakes(columns: Mapping[str, np.ndarray]) -> tuple[np.ndarray, np.ndarray]:
    """What went wrong in each drive, by kind, and out of how much.

    The kinds are line on no wall, wall without a line, wall that is held twice, match that is false, match that was
    missed, object that has vanished and is still in the map after `SCANS_TO_NOTICE` scans, and one that has come and is
    not. Both shapes `[R, 7]`.

    Args:
      columns: as of `columns_of`, `[R]` rows each.

    Returns:
      How much went wrong, and out of how much. Shapes `[R, 7]`.
    """
    c = {field.name: np.asarray(columns[field.name], float) for field in dataclasses.fields(Outcome)}
    matches = c["true_matches"] + c["false_matches"] + c["missed_matches"]
    kinds = [
        (c["line_length"] - c["line_length_on_walls"], c["line_length"]),
        (c["wall_seen"] - c["wall_held"], c["wall_seen"]),
        (c["duplicates"], c["walls"]),
        (c["false_matches"], matches),
        (c["missed_matches"], matches),
        (c["vanished"] - c["gone"], c["vanished"]),
        (c["appeared"] - c["noticed"], c["appeared"]),
    ]
    wrong, whole = (np.stack(part, -1) for part in zip(*kinds, strict=True))
    return wrong, whole


@documented
class Recommendation(NamedTuple):
    """What a sweep says of one threshold."""

    threshold: str
    """Name of the threshold."""
    values: np.ndarray
    """The present one times `FACTORS`, shape `[F]`."""
    costs: np.ndarray
    """Sum of the shares of all kinds of mistakes; from 0 to 7, shape `[F]`."""
    differences: np.ndarray
    """Difference of the cost from that of the present value, shape `[F]`."""
    errors: np.ndarray
    """Standard errors of these, shape `[F]`."""
    value: float
    """The value that is recommended."""


def recommend(
    variants: Sequence[tuple[str, float]], columns: Sequence[Mapping[str, np.ndarray]]
) -> list[Recommendation]:
    """For each threshold of a sweep the value that costs least, where that is sure; else the present one.

    Args:
      variants: name and value of what was varied, as `sweep` gives them.
      columns: for each of them the results of the same drives.

    Returns:
      For each threshold what the sweep says. Standard errors are those of the jackknife over the drives, which all
      variants have in common.
    """
    counts = [mistakes(of_variant) for of_variant in columns]
    found = []
    present = FACTORS.index(1.0)
    for first in range(0, len(variants), len(FACTORS)):
        here = slice(first, first + len(FACTORS))
        wrong, whole = (np.stack([pair[i] for pair in counts[here]]) for i in (0, 1))
        costs = _cost(wrong.sum(1), whole.sum(1))
        without = _cost(wrong.sum(1, keepdims=True) - wrong, whole.sum(1, keepdims=True) - whole)
        without = without - without[present]
        drives = without.shape[1]
        errors = np.sqrt((drives - 1) * np.var(without, 1))
        differences = costs - costs[present]
        better = differences < -SURE_SIGMAS * errors
        best = int(np.argmin(np.where(better, costs, np.inf))) if better.any() else present
        values = np.array([value for _, value in variants[here]])
        found.append(Recommendation(variants[first][0], values, costs, differences, errors, float(values[best])))
    return found


def _cost(wrong: np.ndarray, whole: np.ndarray) -> np.ndarray:
    """The sum of the shares; that of nothing is zero."""
    return np.sum(np.divide(wrong, whole, out=np.zeros_like(wrong), where=whole > 0), -1)
