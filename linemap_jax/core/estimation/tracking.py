"""The front end of SLAM: where each scan was taken, against the surface that the last keyframes have seen.

A scan that has gone on far enough from the last keyframe becomes one itself, and its surface takes the place of the
oldest. The path drifts, since nothing here knows of places seen before that: closing loops is left to the pose graph.
"""

import dataclasses
from typing import NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int

from linemap_jax.core.estimation.odometry import OdometryNoise, cov_step
from linemap_jax.core.estimation.registration import Registration, RegistrationSettings, register
from linemap_jax.core.estimation.surface import Surface, seen_from, surface_of_scan
from linemap_jax.core.fields import documented
from linemap_jax.core.frames import between, compose, unit
from linemap_jax.core.propagation import inverse, propagate
from linemap_jax.core.settings import Number
from linemap_jax.core.state import Scan, pytree

KEYFRAMES = 8
"""Keyframes whose surfaces a scan is laid onto."""


@pytree
class TrackingSettings:
    """How far the front end trusts what."""

    keyframe_distance: Number = 0.5
    """A scan that has moved this far from the last keyframe is the next one, m."""
    keyframe_turn: Number = 0.35
    """The same for its turn, rad."""
    odometry_widening: Number = 5.0
    """Odometry's sigmas are taken so many times as large: it tells where to begin, and holds in the directions that the
    surface leaves open; wheels slip, and clocks of wheels and scanner differ."""
    least_distance_sigma: Number = 0.1
    """Odometry is never trusted to less than this, m: some robots' wheels have forgotten which way they turned."""
    least_turn_sigma: Number = 0.04
    """The same for the turn, rad."""
    doubtful_share: Number = 0.8
    """Where fewer of its points than this agree, other steps than odometry's are tried: back, none, and the last one
    again."""
    margin: Number = 0.1
    """By which more points must agree for one of these to be believed."""


@pytree
class Track:
    """What the front end carries from scan to scan."""

    odometry: Float[Array, "3"]
    """Odometry of the last scan, as the log has it. m, m, rad."""
    pose: Float[Array, "3"]
    """Pose of the scanner at the last scan, in the frame in which odometry began. m, m, rad."""
    step: Float[Array, "3"]
    """Step to there, from the scan before. m, m, rad."""
    keyframe: Float[Array, "3"]
    """Pose of the last keyframe. m, m, rad."""
    surface: Surface
    """What the last keyframes have seen, `KEYFRAMES * M` points about the last one's position, in the world's axes."""
    count: Int[Array, ""]
    """Number of keyframes so far."""


@documented
class Tracked(NamedTuple):
    """What the front end says of a scan."""

    pose: Float[Array, "3"]
    """Pose of the scanner, in the frame in which odometry began. m, m, rad."""
    is_keyframe: Bool[Array, ""]
    """Whether the scan is one."""
    step: Float[Array, "3"]
    """Step from the last keyframe before it, seen from there. m, m, rad."""
    information: Float[Array, "3 3"]
    """Information on the step, as if the points' errors were independent."""
    odometry: Float[Array, "3"]
    """The step that odometry has counted from the last scan to this. m, m, rad."""
    share: Float[Array, ""]
    """Share of the points that agree with what was seen before."""
    surface: Surface
    """What the scan has seen, `M` points in the frame of the scanner."""


def begin_track(odometry: Float[Array, "3"], scan: Scan) -> Track:
    """A track before its first scan. Shapes and dtype are those of the scan.

    Args:
      odometry: pose of the scanner by the robot's odometry at the first scan. m, m, rad. Shape `[3]`.
      scan: the first scan, of which shape and dtype count.

    Returns:
      The state for `track`.
    """
    blank = jax.eval_shape(surface_of_scan, scan)
    surface = jax.tree.map(lambda x: jnp.zeros((KEYFRAMES * x.shape[0], *x.shape[1:]), x.dtype), blank)
    zero = jnp.zeros(3, scan.ranges.dtype)
    odometry = odometry.astype(scan.ranges.dtype)
    return Track(
        odometry=odometry, pose=odometry, step=zero, keyframe=odometry, surface=surface, count=jnp.zeros((), jnp.int32)
    )


def track(
    state: Track,
    scan: Scan,
    odometry: Float[Array, "3"],
    *,
    noise: OdometryNoise = OdometryNoise(),
    settings: TrackingSettings = TrackingSettings(),
    registration: RegistrationSettings = RegistrationSettings(),
) -> tuple[Track, Tracked]:
    """One scan more.

    Args:
      state: after the scan before.
      scan: the scan.
      odometry: pose of the scanner by the robot's odometry. m, m, rad.
      noise: of the odometry.
      settings: keyframes, and trust in odometry.
      registration: of the scan.

    Returns:
      The state after the scan, and what there is to say of it.
    """
    counted = between(state.odometry, odometry)
    surface = surface_of_scan(scan)
    # About the last keyframe, so that float32 resolves the points wherever the robot is.
    origin = state.keyframe.at[2].set(0)
    last = between(origin, state.pose)
    prior = inverse(_cov_guess(counted, last, noise, settings))

    def from_guess(step: Float[Array, "3"], prior: Float[Array, "3 3"]) -> Registration:
        return register(surface, state.surface, compose(last, step), prior, registration)

    def try_others(first: Registration) -> Registration:
        sign = jnp.asarray([[-1.0, -1.0, 1.0], [0.0, 0.0, 1.0]], counted.dtype)
        others: Array = jnp.concatenate([sign * counted[None], state.step.at[2].set(counted[2])[None]])
        found = jax.vmap(from_guess, (0, None))(others, prior / 4)
        found = jax.tree.map(lambda x, y: jnp.concatenate([x[None], y]), first, found)
        best = jnp.argmax(found.share.at[1:].add(-settings.margin))
        return jax.tree.map(lambda x: x[best], found)

    first = from_guess(counted, prior)
    doubtful = (state.count > 0) & (first.share < settings.doubtful_share)
    found: Registration = jax.lax.cond(doubtful, try_others, lambda first: first, first)

    here: Array = jnp.where(state.count > 0, found.pose, compose(last, counted))
    pose = compose(origin, here)
    step = between(state.keyframe, pose)
    turned = jnp.abs(step[2]) > settings.keyframe_turn
    is_keyframe = (state.count == 0) | turned | (step[0] ** 2 + step[1] ** 2 > settings.keyframe_distance**2)

    after = Track(
        odometry=odometry,
        pose=pose,
        step=between(state.pose, pose),
        keyframe=jnp.where(is_keyframe, pose, state.keyframe),
        surface=_with_keyframe(state, surface, here, is_keyframe),
        count=state.count + is_keyframe,
    )
    said = Tracked(
        pose=pose,
        is_keyframe=is_keyframe,
        step=step,
        information=propagate(_turned(state.keyframe[2]).T, found.information),
        odometry=counted,
        share=found.share,
        surface=surface,
    )
    return after, said


def _cov_guess(
    counted: Float[Array, "3"], last: Float[Array, "3"], noise: OdometryNoise, settings: TrackingSettings
) -> Float[Array, "3 3"]:
    """Covariance of where odometry says that the scanner is, in the world's axes."""
    least = jnp.stack([jnp.asarray(settings.least_distance_sigma)] * 2 + [jnp.asarray(settings.least_turn_sigma)])
    cov = settings.odometry_widening**2 * cov_step(counted, noise) + jnp.diag(least**2).astype(counted.dtype)
    return propagate(_turned(last[2]), cov)


def _turned(angle: Float[Array, ""]) -> Float[Array, "3 3"]:
    """The rotation of (x, y, theta) by an angle about the third."""
    c, s = unit(angle)
    return jnp.eye(3, dtype=angle.dtype).at[:2, :2].set(jnp.stack([jnp.stack([c, -s]), jnp.stack([s, c])]))


def _with_keyframe(state: Track, surface: Surface, here: Float[Array, "3"], is_keyframe: Bool[Array, ""]) -> Surface:
    """The surfaces of the last keyframes, about the newest."""
    size = surface.valid.shape[0]
    begin = state.count % KEYFRAMES * size

    def put(old: Array, new: Array) -> Array:
        return jax.lax.dynamic_update_slice_in_dim(old, new, begin, 0)

    grown = jax.tree.map(put, state.surface, seen_from(surface, here))
    grown = dataclasses.replace(grown, position=grown.position - here[None, :2])
    return jax.tree.map(lambda new, old: jnp.where(is_keyframe, new, old), grown, state.surface)


def track_chunk(
    state: Track,
    scans: Scan,
    odometry: Float[Array, "T 3"],
    active: Bool[Array, " T"],
    *,
    noise: OdometryNoise = OdometryNoise(),
    settings: TrackingSettings = TrackingSettings(),
    registration: RegistrationSettings = RegistrationSettings(),
) -> tuple[Track, Tracked]:
    """Scans one after the other; where `active` is False a scan only fills up the chunk, and changes nothing.

    Args:
      state: before them.
      scans: `T` scans, stacked.
      odometry: poses of the scanner by odometry.
      active: which of them count.
      noise: of the odometry.
      settings: keyframes, and trust in odometry.
      registration: of a scan.

    Returns:
      The state after them, and what is said of each, stacked `[T]`.
    """

    def step(state: Track, x: tuple[Scan, Array, Array]) -> tuple[Track, Tracked]:
        scan, pose, is_active = x
        after, said = track(state, scan, pose, noise=noise, settings=settings, registration=registration)
        return jax.tree.map(lambda new, old: jnp.where(is_active, new, old), after, state), said

    return jax.lax.scan(step, state, (scans, odometry, active))
