"""The choices: thresholds and noise (traced numbers, so that a sweep is a `vmap`), capacities and rules (static).

Two presets run through everything. `paper` is the literal reading of Vandorpe, Van Brussel and Xu (1996); `default`
is the method with its known faults mended, each mend one option that can be switched alone. The paper prints only two
of its thresholds (30 cm, and 5 in Eq. (22)); the other values of `paper` are ours, in metres as in the paper.
"""

import dataclasses
from typing import Literal, NamedTuple, TypedDict

from jaxtyping import Array, Float

from linemap_jax.core.fields import documented
from linemap_jax.core.state import positional_pytree, pytree

Number = float | Float[Array, ""]
Segmentation = Literal["incremental", "optimal"]
Covariance = Literal["exact", "printed"]
Jacobians = Literal["autodiff", "analytic"]
PoseError = Literal["independent", "persistent", "unknown"]


LEAST_SIGMA = 1e-6
"""m, of a range. Its square, and the determinant of a line's covariance, are still normal numbers in float32."""


@pytree
class Thresholds:
    """Where the method draws its lines. A gate is the larger of a distance and a multiple of the predicted spread.

    The paper's name stands in brackets.
    """

    gap_distance: Number = 0.15
    """[d_critt] Criterion 1: largest distance between successive points of a line, m. `paper`: 0.5."""
    gap_spacings: Number = 6.0
    """Criterion 1 widens to this multiple of the arc between the two beams; 6 holds walls down to a grazing angle of
    10 degrees together. `paper`: 0 (a fixed distance)."""
    gap_sigmas: Number = 5.0
    """Criterion 1 widens to this multiple of what noise of the range adds to that distance. `paper`: 0."""
    gap_beams: Number = 2.5
    """[alpha_crit] Criterion 3: largest angle between successive points, in beam spacings. `paper`: 1.5."""
    line_distance: Number = 0.03
    """[d_critl] Criterion 2: largest distance of a new point from the line, m. `paper`: 0.05."""
    line_sigmas: Number = 5.0
    """Criterion 2 widens to this multiple of the predicted spread of that distance. `paper`: 0."""
    min_length: Number = 0.3
    """Shortest line that is modelled, and shortest fragment that wiping leaves, m (s4.3.1, s6.3)."""
    cluster_distance: Number = 0.3
    """[d_critc] Largest distance of a new point from the centre of its cluster, m; also the largest radius of a fitted
    circle, which may seem larger by 3 sigma."""
    circle_line_distance: Number = 0.1
    """Circles whose centre is closer than this to a line are not modelled, m (s4.3.1, circles): five sigma of a range
    of 2 cm, since it is the noise of the line that is meant. `paper`: 0.15."""
    match_angle: Number = 0.05
    """[delta theta_crit] Largest difference of direction of matching lines, rad. `paper`: 0.175 (10 degrees)."""
    match_distance: Number = 0.05
    """[d_crid] Largest distance of the new line's end points from the line in the map, m. `paper`: 0.2. Wiping by beams
    takes a return that is no farther from a line than this for a return from it."""
    match_sigmas: Number = 3.0
    """Both gates above widen to this multiple of the predicted spread. `paper`: 0."""
    match_nis: Number = 9.21
    """Largest normalised distance of matching lines, Eq. (22): 99 % of chi-square with 2 degrees of freedom. `paper`:
    5, which is 91.8 %, not the 90 % of the text."""
    match_gap: Number = 0.5
    """[d_critll] Largest gap between matching lines, measured along the line, m (s5.1.1)."""
    circle_match_distance: Number = 0.3
    """[d_critcc] Largest distance between the centres of matching circles, m (s5.2.1)."""
    circle_match_nis: Number = 11.34
    """Largest normalised distance of matching fitted circles: 99 % of chi-square with 3 degrees of freedom. Not in the
    paper, whose circles have no covariance."""
    contradictions: Number = 10
    """A line or circle of the map leaves it when so many more scans have contradicted it than have since borne it out,
    or more than have ever seen it; needs `Rules.give_way`. As Page's test (1954): a scan in a hundred contradicts what
    stands still, and never ten in excess."""
    end_sigmas: Number = 3.0
    """End points that agree within this multiple of their spread are averaged; needs `Rules.estimate_ends`."""
    wipe_extension: Number = 0.05
    """How far wiping reaches behind a line that was seen, m (s6.2); by beams, only to what was seen no more often.
    `paper`: 0.1."""
    wipe_sigmas: Number = 3.0
    """A beam has passed through a line or circle if it ends beyond it by this multiple of the predicted spread; needs
    `Rules.wipe_by_beams`."""


@pytree
class SensorNoise:
    """Standard deviations of one measurement, the square roots of C_s in Eq. (4)."""

    range_sigma: Number = 0.02
    """Of a range, m. Less than a micrometre counts as one: without noise covariances would be singular."""
    bearing_sigma: Number = 0.001
    """Of a bearing, rad."""


@positional_pytree
class Mount:
    """Where the scanner sits on the robot: its pose in the robot's frame, Eq. (2)."""

    x: Number = 0.0
    """Forward of the robot's centre, m."""
    y: Number = 0.0
    """To its left, m."""
    theta: Number = 0.0
    """Turn of the scanner, counter-clockwise, rad. Not in the paper, where the scanner looks ahead."""


@pytree
class Persistence:
    """How the pose error goes on from scan to scan, for `pose_error="persistent"`.

    The pose error is the sum of a part that is new in every scan and a part that persists and drifts: in units of its
    sigma, u[k+1] = correlation u[k] + sqrt(1 - correlation^2) w.

    What persists is the same (dx, dy, dtheta), in the axes of the world, added to one pose after the other. A map that
    is turned as a whole, as by a wrong pose at the start, and the drift of odometry move the positions too, and more so
    the farther the robot drives: they are no such error, and the covariances come out far too small. "unknown" holds
    for them.
    """

    share: Number = 1.0
    """The part of the pose's covariance that persists, from 0 to 1. Its root is kept: at 0 it has no derivative."""
    correlation: Number = 0.99
    """Of what persists, from one scan to the next, from 0 to 1. The error persists over 1 / (1 - correlation) scans."""


def persistence_of(pose_error: PoseError, persistence: Persistence | None) -> Persistence:
    """What of a pose error persists under a model of it; where nothing is known, all of it may.

    Args:
      pose_error: "independent", "persistent" or "unknown".
      persistence: the model of "persistent"; `Persistence()` unless given.

    Returns:
      What persists, and how long.

    Raises:
      ValueError: if there is no such model.
    """
    if pose_error == "persistent":
        return persistence or Persistence()
    if pose_error in ("independent", "unknown"):
        return Persistence(share=0.0 if pose_error == "independent" else 1.0, correlation=1.0)
    raise ValueError(f"pose_error must be 'independent', 'persistent' or 'unknown', not {pose_error!r}")


@documented
class Capacity(NamedTuple):
    """Number of slots: of a map, or of what one scan may hold. Static: it is part of the compiled shape."""

    lines: int = 256
    """Slots for lines."""
    circles: int = 256
    """Slots for circles."""


SCAN_CAPACITY = Capacity(lines=32, circles=64)
"""Slots for what a single scan holds."""


@documented
@dataclasses.dataclass(frozen=True)
class Rules:
    """Which reading of the method is meant. Static; every field is one departure from the paper, on by default."""

    give_back_point: bool = True
    """A run that criterion 2 ends gives its last point to the next run: just past a corner, points of the next wall
    still pass the gate, and they spoil the fit."""
    maximum_likelihood: bool = True
    """The line of a run is the most likely one, for noise along the beams. Regression takes the noise to lie across,
    and is biased where a wall is seen at a slant."""
    leave_out_arcs: bool = True
    """A run that bends as a pole does is no line; its points are left to the circles."""
    leave_out_corners: bool = True
    """Points at the end of a run that may belong to the line beside it take no part in the fit."""
    leave_out_sparse: bool = True
    """Points so far apart that noise decides whether criterion 1 holds take no part in the fit: where a wall is seen at
    a grazing angle, only those that noise has moved together would make up a line."""
    check_ends: bool = True
    """The first and last point of a run take no part in the fit where criterion 2 does not hold between them and the
    line of the others: the first three points of a run make its line, whatever they are."""
    leave_out_ends: bool = True
    """The first and the last point of a run take no part in the fit, nor do others as near to them as criterion 2
    reaches, while enough are left: of what stands across, as the end face of a partition does, points pass the gate.
    A line has five points then, at least."""
    fit_circles: bool = True
    """Fit a circle to a cluster where there are points enough. Eqs. (18)-(20) describe the visible arc: a centre that
    lies before the pole's and moves with the viewpoint."""
    share_pose: bool = True
    """Pieces of one line in one scan share its pose error: it is counted once, and it does not make one of two lines
    that the scan has seen side by side."""
    tell_sides: bool = True
    """A line matches only what was seen from the same side, and a wall does not wipe its own back. A partition is
    thinner than many a pose is known, and nothing else tells its two faces apart."""
    leave_out_ambiguous: bool = True
    """A new line that passes the geometric gates but fails the statistical one is neither fused nor added. To add
    it, as the paper does, holds the same wall twice: the gate turns true matches away too."""
    give_way: bool = True
    """What scans contradict again and again leaves the map. Neither fused nor added, what has moved by centimetres
    would stay where it was: no beam passes through its place."""
    merge: bool = True
    """Lines of the map that overlap and agree become one. Pieces into which a line was cut share its information, so
    that a door that opens and closes does not make its wall better known."""
    estimate_ends: bool = True
    """End points are estimated. The rule of s5.1.2 only ever lengthens a line, so noise makes it grow."""
    weigh_circles: bool = True
    """Circles are fused by their covariance, or by the number of times that they were seen; and no line takes the place
    of a circle that was seen more often. Eqs. (24)-(25) weigh the newest by one half, however often the other was
    seen."""
    wipe_by_beams: bool = True
    """Wipe what this scan's beams passed through. The paper's triangle spans the whole fused line, also where this
    scan did not look, and needs a line behind what vanished."""


PAPER_THRESHOLDS = Thresholds(
    gap_distance=0.5,
    gap_spacings=0.0,
    gap_sigmas=0.0,
    gap_beams=1.5,
    line_distance=0.05,
    line_sigmas=0.0,
    circle_line_distance=0.15,
    match_angle=0.175,
    match_distance=0.2,
    match_sigmas=0.0,
    match_nis=5.0,
    wipe_extension=0.1,
)

PAPER_RULES = Rules(**{field.name: False for field in dataclasses.fields(Rules)})


class Method(TypedDict, total=False):
    """The keyword arguments of `extract` that say how it reads a scan. Static: each decides which program it is."""

    rules: Rules
    """Which reading of the method."""
    segmentation: Segmentation
    """How points are divided into lines."""
    max_vertices: int | None
    """Of "optimal": the budget of end points."""
    covariance: Covariance
    """Exact, or as printed."""
    jacobians: Jacobians
    """By hand, or by autodiff."""


class ExtractOptions(Method, total=False):
    """The keyword arguments of `extract`, but for the capacity."""

    thresholds: Thresholds | None
    """Where the method draws its lines."""
    noise: SensorNoise | None
    """Of the sensor."""
    mount: Mount | None
    """Of the scanner on the robot."""


class UpdateOptions(ExtractOptions, total=False):
    """The keyword arguments of `update`, but for the capacity."""

    pose_error: PoseError
    """How the errors of the poses of several scans hang together."""
    persistence: Persistence | None
    """For "persistent"."""


class Preset(TypedDict):
    """The keyword arguments of `extract` and `update` that make up a preset."""

    thresholds: Thresholds
    """Where the method draws its lines."""
    rules: Rules
    """Which reading of it."""
    covariance: Covariance
    """Exact, or as printed."""


def preset(name: Literal["default", "paper"]) -> Preset:
    """The keyword arguments of `extract`, `update` and `build` that make up a preset.

    Args:
      name: "default" or "paper".

    Returns:
      A dictionary of `thresholds`, `rules` and `covariance`.

    Raises:
      ValueError: if there is no preset of that name.
    """
    if name == "default":
        return {"thresholds": Thresholds(), "rules": Rules(), "covariance": "exact"}
    if name == "paper":
        return {"thresholds": PAPER_THRESHOLDS, "rules": PAPER_RULES, "covariance": "printed"}
    raise ValueError(f"no preset {name!r}: choose default or paper")
