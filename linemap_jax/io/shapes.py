"""What a map looks like: points in the plane, from which pictures and files of several formats are made.

NumPy in float64, in metres. Free slots and whatever is not finite are left out first, with `used`.
"""

import dataclasses
import math
from statistics import NormalDist
from typing import NamedTuple

import jax
import numpy as np
from numpy.typing import ArrayLike, NDArray

from linemap_jax.core.state import LineMap, Lines, SlotsT

Floats = NDArray[np.float64]

LEVEL = 0.95
"""Probability of confidence bands and ellipses, unless another one is asked for."""
BAND_STEPS = 33
"""Positions at which the band of a line is evaluated; its edges are hyperbolas."""
CIRCLE_STEPS = 48
"""Corners of a drawn circle or ellipse."""


class Shapes(NamedTuple):
    """The shapes of `K` lines and `C` circles, `F` of which are fitted, m."""

    segments: Floats  # [K, 2, 2], begin and end
    bands: Floats  # [K, B, 2], corners of the confidence band of each line
    center: Floats  # [C, 2]
    radius: Floats  # [C]
    ellipses: Floats  # [F, E, 2], corners of the confidence ellipse of each fitted circle's centre
    line_times: NDArray[np.int32]  # [K], times detected
    circle_times: NDArray[np.int32]  # [C]


def finite_path(trajectory: ArrayLike | None) -> Floats:
    """The positions of a trajectory that are known, `[T, 2]` in metres; none of None.

    Raises:
      ValueError: if the trajectory is not of shape `[T, 2]`.
    """
    path = np.zeros((0, 2)) if trajectory is None else np.asarray(trajectory, float)
    if path.ndim != 2 or path.shape[1] != 2:
        raise ValueError(f"trajectory must be of shape [T, 2], not {path.shape}")
    return path[np.isfinite(path).all(1)]


def shapes_of_map(
    line_map: LineMap, level: float = LEVEL, *, band_steps: int = BAND_STEPS, circle_steps: int = CIRCLE_STEPS
) -> Shapes:
    """All that is drawn of a map.

    Args:
      line_map: the map.
      level: probability of bands and ellipses, in (0, 1).
      band_steps: positions along each line.
      circle_steps: corners of an ellipse.
    """
    lines, circles = used(line_map.lines), used(line_map.circles)
    fitted = circles.fitted
    return Shapes(
        segments=segments(lines),
        bands=line_bands(lines, level, band_steps),
        center=np.asarray(circles.center, float),
        radius=np.asarray(circles.radius, float),
        ellipses=ellipses(circles.center[fitted], np.asarray(circles.cov)[fitted, :2, :2], level, circle_steps),
        line_times=np.asarray(lines.times_detected),
        circle_times=np.asarray(circles.times_detected),
    )


def used(slots: SlotsT) -> SlotsT:
    """The lines or circles without free slots and without any that hold NaN or infinity; leaves are NumPy arrays."""
    keep = np.asarray(sound(slots).valid)
    return jax.tree.map(lambda leaf: np.asarray(leaf)[keep], slots)


def sound(slots: SlotsT) -> SlotsT:
    """The same slots, free where something is NaN or infinite."""
    keep = np.array(slots.valid)
    for leaf in jax.tree.leaves(slots):
        keep &= np.isfinite(np.asarray(leaf)).reshape(keep.size, -1).all(1)
    return dataclasses.replace(slots, valid=keep)


def segments(lines: Lines) -> Floats:
    """Begin and end of each line. Shape `[K, 2, 2]`."""
    return _points(lines, lines.extent, np.zeros((1, 1)))


def line_bands(lines: Lines, level: float, steps: int = BAND_STEPS) -> Floats:
    """The confidence band of each line, as a polygon.

    At the position s along the tangent a small error moves the line by (d offset - s d angle) along its normal, which
    has the variance C00 - 2 s C01 + s^2 C11. At each position the band holds the true line with probability `level`;
    over the whole length at once the probability is smaller.

    Args:
      lines: `K` lines.
      level: the probability, in (0, 1).
      steps: positions along each line.

    Returns:
      Corners in metres, shape `[K, 2 * steps, 2]`: along the line on the side of its normal, and back on the other.
    """
    extent, cov = np.asarray(lines.extent, float), np.asarray(lines.cov, float)[..., None]
    s = np.linspace(extent[:, 0], extent[:, 1], steps, axis=-1)
    variance = cov[:, 0, 0] - 2 * s * cov[:, 0, 1] + s**2 * cov[:, 1, 1]
    half = NormalDist().inv_cdf((1 + level) / 2) * np.sqrt(np.maximum(variance, 0))
    return np.concatenate([_points(lines, s, half), _points(lines, s, -half)[:, ::-1]], 1)


def ellipses(center: ArrayLike, cov: ArrayLike, level: float, steps: int = CIRCLE_STEPS) -> Floats:
    """Confidence ellipses of points in the plane, as polygons.

    Args:
      center: shape `[K, 2]`, m.
      cov: shape `[K, 2, 2]`, m^2.
      level: probability with which the ellipse holds the true point, in (0, 1).
      steps: corners.

    Returns:
      Corners in metres, shape `[K, steps, 2]`.
    """
    axes = half_axes(cov, level)
    return np.asarray(center, float)[:, None] + np.einsum("kij,sj->ksi", axes, _unit_circle(steps))


def half_axes(cov: ArrayLike, level: float) -> Floats:
    """The half axes of confidence ellipses, the shorter one first.

    Args:
      cov: shape `[K, 2, 2]`, m^2.
      level: probability with which the ellipse holds the true point, in (0, 1).

    Returns:
      The axes as columns, m. Shape `[K, 2, 2]`.
    """
    variance, axis = np.linalg.eigh(np.asarray(cov, float))
    # chi-square with 2 degrees of freedom: P(d^2 < x) = 1 - exp(-x / 2)
    return axis * np.sqrt(-2 * math.log1p(-level) * np.maximum(variance, 0))[:, None]


def outlines(center: ArrayLike, radius: ArrayLike, steps: int = CIRCLE_STEPS) -> Floats:
    """Circles as polygons.

    Args:
      center: shape `[K, 2]`, m.
      radius: shape `[K]`, m.
      steps: corners.

    Returns:
      Corners in metres, shape `[K, steps, 2]`.
    """
    return np.asarray(center, float)[:, None] + np.asarray(radius, float)[:, None, None] * _unit_circle(steps)


def _points(lines: Lines, along: ArrayLike, aside: ArrayLike) -> Floats:
    """Points at positions along the tangent and aside along the normal, both `[K, S]`. Shape `[K, S, 2]`."""
    angle = np.asarray(lines.angle, float)[:, None]
    c, s = np.cos(angle), np.sin(angle)
    along = np.asarray(along, float)
    aside = np.asarray(aside, float) + np.asarray(lines.offset, float)[:, None]
    return np.asarray(lines.anchor, float)[:, None] + np.stack([aside * c - along * s, aside * s + along * c], -1)


def _unit_circle(steps: int) -> Floats:
    turn = np.linspace(0, 2 * np.pi, steps, endpoint=False)
    return np.stack([np.cos(turn), np.sin(turn)], -1)
