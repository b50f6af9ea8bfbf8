"""The data that flows through the package: fixed-size padded arrays with a `valid` mask.

A slot whose `valid` is False holds finite neutral values, and nothing that stands in it changes any result.
Capacities come from shapes, never from a field. Units are metres and radians, angles counter-clockwise.
"""

import enum
import json
from typing import Any, TypeVar, dataclass_transform

import chex
import jax
import jax.numpy as jnp
import numpy as np
from jax import export
from jaxtyping import Array, ArrayLike, Bool, Float, Int

from linemap_jax.core.fields import documented
from linemap_jax.core.sweep import close_sweep

T = TypeVar("T")


@dataclass_transform(frozen_default=True, kw_only_default=True)
def pytree(cls: type[T]) -> type[T]:
    """Register a class as a frozen, keyword-only dataclass that is a pytree of its fields.

    Args:
      cls: a class with annotated fields, each with a string below it that says what it means, and its unit.

    Returns:
      The dataclass; `help` shows its fields.
    """
    return documented(_exportable(chex.dataclass(frozen=True, kw_only=True, mappable_dataclass=False)(cls)))


@dataclass_transform(frozen_default=True)
def positional_pytree(cls: type[T]) -> type[T]:
    """The same, and its fields may be given by position.

    Args:
      cls: as of `pytree`.

    Returns:
      The dataclass.
    """
    return documented(_exportable(chex.dataclass(frozen=True, mappable_dataclass=False)(cls)))


def _exportable(cls: type[T]) -> type[T]:
    """Let `jax.export` write down programs over the class; beside the fields, chex keeps their names."""
    export.register_pytree_node_serialization(
        cls,
        serialized_name=f"{cls.__module__}.{cls.__qualname__}",
        serialize_auxdata=lambda aux_data: json.dumps(aux_data).encode(),
        deserialize_auxdata=lambda serialized_aux_data: tuple(json.loads(serialized_aux_data)),
    )
    return cls


class Status(enum.IntFlag):
    """What a pipeline function has to say about its result; the bits are joined by `|`."""

    OK = 0
    SCAN_LINES_FULL = 1
    """A scan held more lines than the scan capacity; the last ones are missing."""
    SCAN_CIRCLES_FULL = 2
    """A scan held more circles than the scan capacity; the last ones are missing."""
    MAP_LINES_FULL = 4
    """The map had no free slot for a line."""
    MAP_CIRCLES_FULL = 8
    """The map had no free slot for a circle."""
    MAP_FULL = MAP_LINES_FULL | MAP_CIRCLES_FULL
    """Either; `grow` makes room."""
    POSE_NOT_FINITE = 16
    """The pose or its covariance held NaN, infinity or numbers beyond 1e9, or the covariance was none; the scan was
    left out. Of odometry: the step was."""
    LOST = 32
    """The map has not explained the latest scans: the robot is not where it is said to be, or not in this map."""


@jax.jit  # step by step, some thirty operations would be compiled one by one
def _judged(
    r: Float[Array, " N"], b: Float[Array, " N"], range_min: ArrayLike, range_max: ArrayLike
) -> dict[str, Array]:
    """The fields of `Scan.from_ranges`."""
    finite = jnp.isfinite(b)
    valid = jnp.isfinite(r) & (r > 0) & (r >= range_min) & (r < range_max) & finite
    step = jnp.abs(jnp.diff(b)) if r.size > 1 else jnp.zeros(1, r.dtype)
    spacing = jnp.nan_to_num(jnp.nanmedian(jnp.where(jnp.isfinite(step), step, jnp.nan))).astype(r.dtype)
    r, b = jnp.where(valid, r, 0), jnp.where(finite, b, 0)
    valid, first = close_sweep(r, b, valid, spacing)
    return {"ranges": jnp.where(valid, r, 0), "bearings": b, "valid": valid, "spacing": spacing, "first": first}


@pytree
class Scan:
    """One range scan in the frame of the sensor.

    Make one with `Scan.from_ranges`, which masks what is not a return.
    """

    ranges: Float[Array, " N"]
    """Ranges of the beams in the order of the sweep, m; 0 where there is no return."""
    bearings: Float[Array, " N"]
    """Angles of the beams in the frame of the sensor, counter-clockwise, rad."""
    valid: Bool[Array, " N"]
    """Which beams came back."""
    spacing: Float[Array, ""]
    """Angle between neighbouring beams, rad."""
    first: Int[Array, ""]
    """Beam at which the sweep begins: 0, unless it closes on itself."""

    @classmethod
    def from_ranges(
        cls, ranges: ArrayLike, bearings: ArrayLike, *, range_min: ArrayLike = 0.0, range_max: ArrayLike = jnp.inf
    ) -> "Scan":
        """Build a scan from measured ranges; masks NaN, infinity, zero, negative and out-of-range readings.

        A reading of exactly `range_max` is a no-return: scanners report "nothing seen" that way. A sweep that closes on
        itself has no seam: it begins where the surface breaks, and a beam measured twice counts once.

        Args:
          ranges: measured ranges in metres, in the order of the sweep. Shape `[N]`; its dtype is kept.
          bearings: angle of each beam in radians, counter-clockwise; may fall from beam to beam. Shape `[N]`.
          range_min: smallest range that counts as a return, in metres (inclusive).
          range_max: ranges from here on are no-returns, in metres.

        Returns:
          The scan; masked beams hold zeros.

        Raises:
          ValueError: if the two arrays are not one-dimensional or differ in length.
        """
        r = _as_float(ranges)
        b = jnp.asarray(bearings, r.dtype)
        if r.ndim != 1 or r.shape != b.shape:
            raise ValueError(f"ranges {r.shape} and bearings {b.shape} must be one-dimensional and of one length")
        return cls(**_judged(r, b, range_min, range_max))


@pytree
class Pose:
    """The pose of the robot in the world, and its covariance."""

    mean: Float[Array, "3"]
    """x, y in m, and theta, the direction in which the robot looks, counter-clockwise, in rad."""
    cov: Float[Array, "3 3"]
    """Covariance of (x, y, theta) in the axes of the world, not of the robot: m^2, m rad, rad^2. Symmetric and positive
    semidefinite; zeros are an exact pose."""

    def __post_init__(self) -> None:
        """Lists of numbers become arrays."""
        # Lists are a convenience of the notebook; a list inside a pytree would be a subtree, not an array.
        for name in ("mean", "cov"):
            value = getattr(self, name)
            if isinstance(value, list | tuple):
                object.__setattr__(self, name, _as_float(value))


@pytree
class Lines:
    """Line segments, each held relative to an anchor on its own segment.

    The line is the set of points `x` with `normal . (x - anchor) = offset`, where `normal` has the direction `angle`.
    Its end points are given along the tangent (the normal turned by +90 degrees), measured from the anchor, so that
    they lie on the line by construction. (rho, theta) of Eq. (1) is a view, `rho_theta`: as a state it fails near the
    origin of the world and far from it.

    The covariance has two parts. Errors that are new in every scan average away; those of a pose error that persists do
    not, and are kept apart: to first order the error of (offset, angle) is `sqrt_persistent @ u` plus an independent
    one, where u is the persisting part of the pose error in units of its own sigma. How a pose error moves the line is
    reckoned at one angle for good, `first_angle`, that of its first estimate: at the angles of several estimates the
    same error would look as if it told the line's direction (Huang, Mourikis and Roumeliotis 2008).
    """

    anchor: Float[Array, "K 2"]
    """A point of the world near the middle of the segment, m."""
    offset: Float[Array, " K"]
    """How far the line lies from its anchor along the normal, m."""
    angle: Float[Array, " K"]
    """Direction of the normal, rad."""
    cov_independent: Float[Array, "K 2 2"]
    """Covariance of (offset, angle), of what no other scan shares: m^2, m rad, rad^2."""
    sqrt_persistent: Float[Array, "K 2 3"]
    """Square root of the covariance of (offset, angle), of what other scans may share: m, rad."""
    first_angle: Float[Array, " K"]
    """Direction of the normal when the line was first seen, rad."""
    extent: Float[Array, "K 2"]
    """Begin and end along the tangent, from the anchor, m; begin <= end."""
    var_extent: Float[Array, "K 2"]
    """Variances of the end points along the tangent, m^2."""
    times_detected: Int[Array, " K"]
    """How many scans have seen the line."""
    times_contradicted: Int[Array, " K"]
    """How many more scans have seen another line in its place than have since seen it, or 0."""
    valid: Bool[Array, " K"]
    """Which slots are in use."""

    @property
    def cov(self) -> Float[Array, "K 2 2"]:
        """Covariance of (offset, angle): m^2, m rad, rad^2. Shape `[K, 2, 2]`."""
        return self.cov_independent + squared(self.sqrt_persistent)

    @property
    def normal(self) -> Float[Array, "K 2"]:
        """Unit normals. Shape `[K, 2]`."""
        return jnp.stack([jnp.cos(self.angle), jnp.sin(self.angle)], -1)

    @property
    def tangent(self) -> Float[Array, "K 2"]:
        """Unit tangents, from begin to end. Shape `[K, 2]`."""
        normal = self.normal
        return jnp.stack([-normal[..., 1], normal[..., 0]], -1)

    @property
    def begin(self) -> Float[Array, "K 2"]:
        """Begin points in the world, in metres. Shape `[K, 2]`."""
        return self.point_at(self.extent[..., 0])

    @property
    def end(self) -> Float[Array, "K 2"]:
        """End points in the world, in metres. Shape `[K, 2]`."""
        return self.point_at(self.extent[..., 1])

    @property
    def length(self) -> Float[Array, " K"]:
        """Lengths in metres. Shape `[K]`."""
        return self.extent[..., 1] - self.extent[..., 0]

    def point_at(self, along: Float[Array, " K"]) -> Float[Array, "K 2"]:
        """The points that lie `along` metres from the foot of the anchor. Shape `[K, 2]`."""
        return self.anchor + self.offset[..., None] * self.normal + along[..., None] * self.tangent


@pytree
class DirectedLines(Lines):
    """Lines whose normals stand ready, for whoever holds many against many; see `slots.directed`."""

    unit_normal: Float[Array, "K 2"]
    """Unit normals."""

    @property
    def normal(self) -> Float[Array, "K 2"]:
        """Unit normals. Shape `[K, 2]`."""
        return self.unit_normal


@pytree
class Circles:
    """Circles: clusters of points after Eqs. (18)-(20), or fitted poles.

    `fitted` tells which: a fitted circle is the pole itself; the others describe the visible points. In what one scan
    holds both have a covariance, in two parts as that of a line: of the first the truth is the pole, of the second
    what the same beams would give without noise. In a map the others have none (zeros): what is visible of a pole moves
    with the viewpoint.
    """

    center: Float[Array, "K 2"]
    """Centres in the world, m."""
    radius: Float[Array, " K"]
    """Radii, m."""
    cov_independent: Float[Array, "K 3 3"]
    """Covariance of (x, y, radius), of what no other scan shares, m^2."""
    sqrt_persistent: Float[Array, "K 3 3"]
    """Square root of the covariance of (x, y, radius), of what other scans may share, m."""
    fitted: Bool[Array, " K"]
    """Whether the circle is a fitted pole; else it describes the points that were visible."""
    times_detected: Int[Array, " K"]
    """How many scans have seen the circle."""
    times_contradicted: Int[Array, " K"]
    """How many more scans have seen another circle in its place than have since seen it, or 0."""
    valid: Bool[Array, " K"]
    """Which slots are in use."""

    @property
    def cov(self) -> Float[Array, "K 3 3"]:
        """Covariance of (x, y, radius) in m^2. Shape `[K, 3, 3]`."""
        return self.cov_independent + squared(self.sqrt_persistent)


@pytree
class LineMap:
    """A map of line segments and circles."""

    lines: Lines
    """The line segments; `lines.valid` tells which slots are in use."""
    circles: Circles
    """The circles, likewise."""


@pytree
class Rejected:
    """Points that were turned away, by criterion."""

    invalid: Int[Array, ""]
    """Beams without a return."""
    gap: Int[Array, ""]
    """Points that broke a run by criterion 1, distance to the previous point."""
    distance: Int[Array, ""]
    """Points that broke a run by criterion 2, distance to the line."""
    bearing: Int[Array, ""]
    """Points that broke a run by criterion 3, angle to the previous point."""
    too_few: Int[Array, ""]
    """Points in runs of fewer than three points that can be used."""
    too_short: Int[Array, ""]
    """Points in runs shorter than the shortest line."""
    lone: Int[Array, ""]
    """Points in no line and in no cluster."""
    near_line: Int[Array, ""]
    """Points in clusters too close to a line to be modelled."""


@pytree
class Extraction:
    """What one scan holds, in the frame of the world.

    `lines.cov = cov_measurement + jac_line_pose @ cov_pose @ jac_line_pose^T`: the lines of one scan share the error
    of its pose, and whoever combines several of them needs the two parts apart.
    """

    lines: Lines
    """Line segments in the world, with the error of the pose in their covariances."""
    circles: Circles
    """Circles in the world, likewise."""
    jac_line_pose: Float[Array, "K 2 3"]
    """P, d(offset, angle) / d(x, y, theta) of the pose."""
    cov_measurement: Float[Array, "K 2 2"]
    """M, covariance of (offset, angle) from the sensor's noise alone: m^2, m rad, rad^2."""
    line_of_beam: Int[Array, " N"]
    """For each beam the slot of its line in `lines`, -1 for none."""
    circle_of_beam: Int[Array, " N"]
    """For each beam the slot of its circle in `circles`, -1 for none."""
    rejected: Rejected
    """How many points were turned away, by criterion."""
    status: Int[Array, ""]
    """Bits of `Status`."""


@pytree
class Report:
    """What one scan did to the map.

    `line_slot` and `circle_slot` tell for each new primitive the slot of the map that it was fused into, `NEW` if it
    was added, `LEFT_OUT` if it was neither (or its slot is empty). The NIS is that of the best geometric match,
    before the statistical gate, with `dof` degrees of freedom; where nothing was compared both are zero.
    """

    line_slot: Int[Array, " L"]
    """Slot in the map of each line of the scan, or `NEW`, or `LEFT_OUT`."""
    line_nis: Float[Array, " L"]
    """Normalised innovation squared of its best geometric match."""
    line_dof: Int[Array, " L"]
    """Degrees of freedom of that: 2, or 0 where nothing was compared."""
    circle_slot: Int[Array, " C"]
    """Slot in the map of each circle of the scan, or `NEW`, or `LEFT_OUT`."""
    circle_nis: Float[Array, " C"]
    """Normalised innovation squared of the nearest circle."""
    circle_dof: Int[Array, " C"]
    """Degrees of freedom of that: 3, or 0 where nothing was compared."""
    added: Int[Array, ""]
    """Lines and circles new in the map."""
    fused: Int[Array, ""]
    """Lines and circles of the map improved by this scan."""
    merged: Int[Array, ""]
    """Lines of the map joined with another one."""
    trimmed: Int[Array, ""]
    """Lines shortened by wiping."""
    split: Int[Array, ""]
    """Lines cut into several by wiping."""
    deleted: Int[Array, ""]
    """Lines and circles gone."""
    status: Int[Array, ""]
    """Bits of `Status`."""


SlotsT = TypeVar("SlotsT", Lines, Circles)


def squared(root: Float[Array, "*s n m"]) -> Float[Array, "*s n n"]:
    """A A^T, the matrix of which A = `root` is a square root."""
    return jnp.sum(root[..., :, None, :] * root[..., None, :, :], -1)


NEW = -1
"""In a `Report`: the primitive was added to the map."""
LEFT_OUT = -2
"""In a `Report`: the primitive was neither fused nor added."""


def empty_lines(capacity: int, dtype: Any = None) -> Lines:
    """`capacity` free slots for lines. The `dtype` is jax's default unless given."""
    dtype = jnp.asarray(0.0).dtype if dtype is None else jax.dtypes.canonicalize_dtype(dtype)
    return Lines(
        anchor=_filled((capacity, 2), 0, dtype),
        offset=_filled((capacity,), 0, dtype),
        angle=_filled((capacity,), 0, dtype),
        cov_independent=jnp.asarray(np.tile(np.eye(2, dtype=dtype), (capacity, 1, 1))),
        sqrt_persistent=_filled((capacity, 2, 3), 0, dtype),
        first_angle=_filled((capacity,), 0, dtype),
        extent=_filled((capacity, 2), 0, dtype),
        var_extent=_filled((capacity, 2), 1, dtype),
        times_detected=_filled((capacity,), 0, np.int32),
        times_contradicted=_filled((capacity,), 0, np.int32),
        valid=_filled((capacity,), False, bool),
    )


def empty_circles(capacity: int, dtype: Any = None) -> Circles:
    """`capacity` free slots for circles. The `dtype` is jax's default unless given."""
    dtype = jnp.asarray(0.0).dtype if dtype is None else jax.dtypes.canonicalize_dtype(dtype)
    return Circles(
        center=_filled((capacity, 2), 0, dtype),
        radius=_filled((capacity,), 0, dtype),
        cov_independent=_filled((capacity, 3, 3), 0, dtype),
        sqrt_persistent=_filled((capacity, 3, 3), 0, dtype),
        fitted=_filled((capacity,), False, bool),
        times_detected=_filled((capacity,), 0, np.int32),
        times_contradicted=_filled((capacity,), 0, np.int32),
        valid=_filled((capacity,), False, bool),
    )


def _filled(shape: tuple[int, ...], value: float, dtype: Any) -> Array:
    """By way of NumPy: outside of a jitted function, jax would compile a program for each shape."""
    return jnp.asarray(np.full(shape, value, dtype))


def pad_stack(stacked: Any, size: int) -> Any:
    """The items of the pytree `stacked`, filled up to `size` by repeating the last one.

    Whoever uses them knows how many count. On the host, where nothing has to be compiled.
    """

    def fill(x: Array) -> Array:
        missing = size - x.shape[0]
        return jnp.asarray(np.concatenate([np.asarray(x), np.repeat(np.asarray(x)[-1:], missing, 0)])) if missing else x

    return jax.tree.map(fill, stacked)


def _as_float(x: ArrayLike | list | tuple) -> Array:
    """As an array of the dtype that came in; integers and plain numbers become jax's default float."""
    dtype = getattr(x, "dtype", None)
    if dtype is not None and jnp.issubdtype(dtype, jnp.floating):
        return jnp.asarray(x)
    return jnp.asarray(np.asarray(x, float) if not isinstance(x, jax.Array) else x, jnp.zeros(0).dtype)
