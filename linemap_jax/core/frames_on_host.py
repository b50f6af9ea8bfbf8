"""Poses in the plane on the host, in float64 whatever jax is set to, for one pose or many: as in `frames`."""

import numpy as np
from jaxtyping import Float
from numpy.typing import ArrayLike, NDArray

Floats = NDArray[np.float64]


def compose(pose: ArrayLike, step: ArrayLike) -> Float[np.ndarray, "*s 3"]:
    """The pose that is reached from a pose by a step seen from there, both x, y, theta. m, m, rad in (-pi, pi]."""
    pose, step = np.asarray(pose, float), np.asarray(step, float)
    place = pose[..., :2] + _turned(pose[..., 2], step)
    return np.concatenate([place, _wrapped(pose[..., 2:] + step[..., 2:])], -1)


def between(before: ArrayLike, after: ArrayLike) -> Float[np.ndarray, "*s 3"]:
    """The step from one pose to another, seen from the first: `compose(before, step)` is `after`. m, m, rad."""
    before = np.asarray(before, float)
    move = np.asarray(after, float) - before
    return np.concatenate([_turned(-before[..., 2], move), _wrapped(move[..., 2:])], -1)


def _turned(angle: ArrayLike, step: Floats) -> Floats:
    c, s = np.cos(angle), np.sin(angle)
    return np.stack([c * step[..., 0] - s * step[..., 1], s * step[..., 0] + c * step[..., 1]], -1)


def _wrapped(angle: Floats) -> Floats:
    return angle - 2 * np.pi * np.ceil((angle - np.pi) / (2 * np.pi))
