"""Cases of all that computes with a scan: any ranges, bearings, poses, covariances, noise and thresholds.

Whatever comes in, the map stays finite, and its covariances stay covariances: symmetric and without a negative
direction. Where the noise of a range is one that ranges of this size can have, they are positive definite, so that the
map can be written. Without noise they may be singular: nothing is uncertain then.
"""

import dataclasses
import functools
import math
from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from fuzzing import Target
from hypothesis import strategies as st
from hypothesis.strategies import SearchStrategy

from linemap_jax.build import COMPILER_OPTIONS, update_chunk
from linemap_jax.core.extract import ONE_AND_ROUNDING
from linemap_jax.core.mapping import empty_map
from linemap_jax.core.merging import merge_maps
from linemap_jax.core.settings import Capacity, Mount, PoseError, SensorNoise, Thresholds, preset
from linemap_jax.core.slots import LARGEST
from linemap_jax.core.state import LineMap, Pose, Report, Scan, Status

BEAMS, SCANS = 24, 3
CAPACITY, MAP_CAPACITY = Capacity(lines=4, circles=3), Capacity(lines=5, circles=3)

EXTREME = [0.0, -0.0, 1e-37, 1e-20, 1e-6, 1e-3, 0.5, 2.0, 1e3, 1e6, 1e12, 1e19, 1e30, 3e38]
NOT_FINITE = [math.nan, math.inf, -math.inf]
ANY = [*EXTREME, *(-x for x in EXTREME), *NOT_FINITE]

# Scans


def _rectangle(bearings: np.ndarray, at: np.ndarray, half: tuple[float, float]) -> np.ndarray:
    """Ranges from inside of a room whose walls are so far from its middle."""
    angle = bearings + at[2]
    c, s = np.cos(angle), np.sin(angle)
    with np.errstate(all="ignore"):
        x = np.where(c > 0, (half[0] - at[0]) / c, (-half[0] - at[0]) / c)
        y = np.where(s > 0, (half[1] - at[1]) / s, (-half[1] - at[1]) / s)
    return np.fmin(np.abs(x), np.abs(y))


@dataclasses.dataclass(frozen=True)
class Case:
    """Some scans, one after the other, and all that they are looked at with."""

    seed: int  # of the noise
    room: tuple[float, float]  # m
    field: float  # rad
    noisy: float  # of the ranges, m
    at: tuple[float, float]  # of the room in the world, m
    step: tuple[float, float, float]
    ranges: tuple[tuple[int, int, float], ...]  # scan, beam, and what stands there instead
    bearings: tuple[tuple[int, int, float], ...]
    invalid: tuple[tuple[int, int, float], ...]
    poses: tuple[tuple[int, int, float], ...]
    cov: tuple[float, float, float, float]  # sigmas of the pose, and how its parts hang together
    covs: tuple[tuple[int, int, float], ...]
    noise: tuple[float, float]
    mount: tuple[float, float, float]
    thresholds: tuple[tuple[str, float], ...]
    range_max: float


@st.composite
def cases(draw: Any) -> Case:
    rare = st.integers(0, 3)

    def changes(values: list[float], many: int, most: int = 4) -> tuple[Any, ...]:
        if draw(rare):
            return ()
        where = st.tuples(st.integers(0, SCANS - 1), st.integers(0, many - 1), st.sampled_from(values))
        return tuple(draw(st.lists(where, max_size=most)))

    def number(usual: float, others: list[float]) -> float:
        return draw(st.sampled_from(others)) if draw(rare) == 0 else usual

    names = [field.name for field in dataclasses.fields(Thresholds)]
    extreme = st.lists(st.tuples(st.sampled_from(names), st.sampled_from([*EXTREME, math.inf])), max_size=4)
    return Case(
        seed=draw(st.integers(0, 2**32 - 1)),
        room=tuple(draw(st.floats(0.05, 8)) for _ in range(2)),
        field=draw(st.sampled_from([math.pi / 2, math.pi, 2 * math.pi, 0.2])),
        noisy=draw(st.sampled_from([0.0, 0.001, 0.02, 0.3])),
        at=tuple(number(0.0, [1.0, -1e3, 1e6, -1e6, 1e9, 1e20, 1e30, 3e38]) for _ in range(2)),
        step=tuple(number(0.1, [0.0, 5.0, -1e-3, 3.0]) for _ in range(3)),
        ranges=changes(ANY, BEAMS, 8),
        bearings=changes(ANY, BEAMS),
        invalid=changes([0.0], BEAMS, 12),
        poses=changes(ANY, 3, 2),
        cov=(
            *(number(s, [0.0, 1e-9, 1e-12, 1.0, 1e3, 1e9, 1e15, 1e19]) for s in (0.05, 0.05, 0.01)),
            number(0.0, [1.0, -1.0, 0.999999, 0.5]),
        ),
        covs=changes([x for x in ANY if not 0 < abs(x) < 1e-6], 9, 2),
        noise=(
            number(0.02, [0.0, 1e-30, 1e-12, 1e-6, 1e-3, 1.0, 1e3, 1e12, 1e30]),
            number(0.001, [0.0, 1e-30, 1e-9, 0.05, 1.0, 10.0, 1e12, 1e30]),
        ),
        mount=tuple(number(0.0, [0.2, -1.0, 1e3]) for _ in range(3)),
        thresholds=tuple(draw(extreme)) if draw(rare) == 0 else (),
        range_max=number(math.inf, [10.0, 1e3, 0.0]),
    )


def scans_of(case: Case, dtype: str) -> tuple[list[Scan], list[Pose]]:
    """The scans and poses of a case."""
    rng = np.random.default_rng(case.seed)
    scans, poses = [], []
    for t in range(SCANS):
        at = t * np.array(case.step)
        bearings = np.linspace(-case.field / 2, case.field / 2, BEAMS, endpoint=case.field < 6)
        ranges = _rectangle(bearings, at, case.room) + case.noisy * rng.normal(size=BEAMS)
        mean = at + [*case.at, 0.0]
        sigma, tie = np.array(case.cov[:3]), case.cov[3]
        cov = np.diag(sigma**2) * (1 - abs(tie)) + tie * np.sign(tie) * np.outer(sigma, sigma)
        for array, replaced in ((ranges, case.ranges), (bearings, case.bearings), (mean, case.poses)):
            for scan, i, value in replaced:
                if scan == t:
                    array[i] = value
        for scan, i, value in case.covs:
            if scan == t:
                cov[i // 3, i % 3] = cov[i % 3, i // 3] = value
        for scan, i, _ in case.invalid:
            if scan == t:
                ranges[i] = math.nan
        with np.errstate(over="ignore"):
            ranges, bearings, mean, cov = (np.asarray(x).astype(dtype) for x in (ranges, bearings, mean, cov))
        scans.append(Scan.from_ranges(ranges, bearings, range_max=np.asarray(case.range_max, dtype)))
        poses.append(Pose(mean=jnp.asarray(mean), cov=jnp.asarray(cov)))
    return scans, poses


def settings_of(case: Case, dtype: str) -> dict[str, Any]:
    """Thresholds, noise and mount, as arrays: one program serves all cases."""
    settings = {
        "thresholds": dataclasses.replace(Thresholds(), **dict(case.thresholds)),
        "noise": SensorNoise(range_sigma=case.noise[0], bearing_sigma=case.noise[1]),
        "mount": Mount(*case.mount),
    }
    return jax.tree.map(lambda x: jnp.asarray(x, dtype), settings)


# What must hold


def is_sound_map(line_map: LineMap, *, definite: bool) -> None:
    """Whether a map is one."""
    for name, part in (("lines", line_map.lines), ("circles", line_map.circles)):
        for field in dataclasses.fields(part):
            x = np.asarray(getattr(part, field.name))
            assert np.isfinite(x).all(), f"{name}.{field.name} is not finite: {x}"
    lines, circles = (jax.tree.map(np.asarray, part) for part in (line_map.lines, line_map.circles))
    has_line, has_circle = lines.valid, circles.valid
    assert (lines.extent[has_line, 0] <= lines.extent[has_line, 1]).all(), "a line runs backwards"
    assert (lines.var_extent[has_line] >= 0).all(), "the variance of an end is negative"
    assert (circles.radius[has_circle] >= 0).all(), "a radius is negative"
    assert (lines.times_detected[has_line] > 0).all()
    assert (circles.times_detected[has_circle] > 0).all()
    is_cov("line", lines.cov_independent[has_line], definite=definite)
    is_cov("circle", circles.cov_independent[has_circle & circles.fitted], definite=definite)


def is_cov(what: str, cov: np.ndarray, *, definite: bool) -> None:
    """Whether matrices are covariances, judged by their correlations, as units differ within one."""
    slack = 0.0 if definite else 1e-4
    cov = cov.astype(np.float64)
    variance = np.diagonal(cov, axis1=-2, axis2=-1)
    told = f"the covariance of a {what} is not positive {'definite' if definite else 'semidefinite'}: {cov.tolist()}"
    assert (variance > 0).all() if definite else (variance >= 0).all(), told
    sigma = np.sqrt(np.where(variance > 0, variance, np.inf))
    correlation = cov / sigma[:, :, None] / sigma[:, None, :]
    assert np.abs(correlation - np.swapaxes(correlation, -1, -2)).max(initial=0) < 1e-4, f"{what}: not symmetric {cov}"
    least = np.linalg.eigvalsh(correlation).min(initial=1)
    assert least > 0 if definite else least >= -slack, told


def is_honest(case: Case, poses: list[Pose], before: LineMap, after: LineMap, report: Report) -> None:
    """Whether the reports of the scans of a case say what has happened."""
    statuses = np.asarray(report.status)
    for t, pose in enumerate(poses):
        mean, cov = np.asarray(pose.mean, float), np.asarray(pose.cov, float)
        finite = bool((np.abs(mean) <= LARGEST).all() and is_pose_cov(cov))
        assert bool(statuses[t] & Status.POSE_NOT_FINITE) == (not finite), "the status of the pose is not honest"
        if not finite:
            counts = [int(getattr(report, name)[t]) for name in ("added", "fused", "merged", "split", "deleted")]
            assert not any(counts), "a scan without a pose has changed the map"
    for slots, nis, dof, size in (
        (report.line_slot, report.line_nis, report.line_dof, MAP_CAPACITY.lines),
        (report.circle_slot, report.circle_nis, report.circle_dof, MAP_CAPACITY.circles),
    ):
        assert ((np.asarray(slots) >= -2) & (np.asarray(slots) < size)).all()
        assert not np.isnan(nis).any(), f"a NIS is NaN: {nis}"
        assert (np.asarray(nis) >= 0).all(), f"a NIS is negative: {nis}"
        assert ((np.asarray(dof) >= 0) & (np.asarray(dof) <= 3)).all()
    full = bool((statuses & (Status.MAP_LINES_FULL | Status.MAP_CIRCLES_FULL)).any())
    if not full and not np.asarray(report.split).any():
        count = [int(m.lines.valid.sum() + m.circles.valid.sum()) for m in (before, after)]
        change = int(report.added.sum() - report.merged.sum() - report.deleted.sum())
        assert count[1] - count[0] == change, f"{count[0]} things and {change} more are not {count[1]}"


def is_pose_cov(cov: np.ndarray) -> bool:
    """Whether something is taken for the covariance of a pose."""
    variance = np.diag(cov)
    with np.errstate(all="ignore"):
        tied = cov**2 <= ONE_AND_ROUNDING * variance[:, None] * variance
    return bool(((variance >= 0) & (variance <= LARGEST)).all() and tied.all())


def usual_noise(case: Case) -> bool:
    """Whether noise, ranges and pose are of a size that covariances can hold beside each other."""
    return 1e-6 <= case.noise[0] <= 1 and case.noise[1] <= 1


# Targets


@dataclasses.dataclass(frozen=True)
class Variant:
    """A program to run cases with."""

    dtype: str
    pose_error: PoseError
    preset: Any = "default"
    segmentation: Any = "incremental"

    @functools.cached_property
    def run(self) -> Callable[..., tuple[LineMap, Report]]:
        options = preset(self.preset)
        fixed = {"rules": options["rules"], "covariance": options["covariance"], "capacity": CAPACITY}
        fixed |= {"segmentation": self.segmentation, "jacobians": "analytic"}
        update = functools.partial(update_chunk, pose_error=self.pose_error, **fixed)
        return jax.jit(update, compiler_options=COMPILER_OPTIONS)

    def mapped(self, case: Case) -> tuple[list[Pose], LineMap, LineMap, Report]:
        """Poses; the map before and after the scans of a case; and the reports."""
        scans, poses = scans_of(case, self.dtype)
        stacked = [jax.tree.map(lambda *x: jnp.asarray(np.stack(x)), *each) for each in (scans, poses)]
        before = empty_map(MAP_CAPACITY, np.dtype(self.dtype))
        active = jnp.ones(SCANS, bool)
        after, report = self.run(before, *stacked, active, **settings_of(case, self.dtype))
        return poses, before, after, report

    def check(self, case: Case) -> None:
        poses, before, after, report = self.mapped(case)
        is_sound_map(after, definite=usual_noise(case))
        is_honest(case, poses, before, after, report)

    def prepare(self) -> None:
        self.mapped(USUAL)

    def target(self, weight: float) -> Target:
        told = (self.dtype, *(x for x in (self.pose_error, self.preset, self.segmentation) if x not in USUAL_CHOICES))
        name = ", ".join(("update", *told))
        return Target(name, cases, self.check, weight, self.prepare)


USUAL_CHOICES = ("unknown", "default", "incremental")

USUAL = Case(
    seed=0,
    room=(2.0, 1.5),
    field=math.pi,
    noisy=0.01,
    at=(0.0, 0.0),
    step=(0.1, 0.1, 0.1),
    ranges=(),
    bearings=(),
    invalid=(),
    poses=(),
    cov=(0.05, 0.05, 0.01, 0.0),
    covs=(),
    noise=(0.02, 0.001),
    mount=(0.0, 0.0, 0.0),
    thresholds=(),
    range_max=math.inf,
)

USERS = Variant("float32", "unknown")


def check_merged(case: tuple[Case, Case]) -> None:
    """Merge the maps of two cases."""
    maps = [USERS.mapped(each)[2] for each in case]
    merged, _ = merge_maps(*maps)
    is_sound_map(merged, definite=all(map(usual_noise, case)))


def pairs() -> SearchStrategy[Any]:
    return st.tuples(cases(), cases())


TARGETS: list[Target] = [
    USERS.target(3.0),
    Variant("float64", "unknown").target(1.5),
    Variant("float32", "persistent").target(1.0),
    Variant("float32", "independent", "paper").target(1.0),
    Variant("float32", "unknown", segmentation="optimal").target(0.5),
    Target("merge", pairs, check_merged, 0.5, lambda: check_merged((USUAL, USUAL))),
]
