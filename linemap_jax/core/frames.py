"""Angles, directions, and a line seen from another anchor."""

import dataclasses

import jax.numpy as jnp
from jaxtyping import Array, Float

from linemap_jax.core.state import Lines


def wrap_angle(angle: Float[Array, "*s"]) -> Float[Array, "*s"]:
    """The same `angle` in (-pi, pi]. In and out in radians."""
    return angle - 2 * jnp.pi * jnp.ceil((angle - jnp.pi) / (2 * jnp.pi))


def unit(angle: Float[Array, "*s"]) -> Float[Array, "*s 2"]:
    """Unit vector in the direction of `angle`, in radians."""
    return jnp.stack([jnp.cos(angle), jnp.sin(angle)], -1)


def perp(vector: Float[Array, "*s 2"]) -> Float[Array, "*s 2"]:
    """The `vector` turned by +90 degrees: the derivative of a rotated vector with respect to the angle."""
    return jnp.stack([-vector[..., 1], vector[..., 0]], -1)


def rotate(angle: Float[Array, ""], vector: Float[Array, "*s 2"]) -> Float[Array, "*s 2"]:
    """The `vector`, or each of many, turned by `angle`, in radians."""
    ahead = jnp.expand_dims(unit(angle), tuple(range(vector.ndim - 1)))
    return vector[..., :1] * ahead + vector[..., 1:] * perp(ahead)


def compose(pose: Float[Array, "3"], step: Float[Array, "3"]) -> Float[Array, "3"]:
    """The pose that is reached from `pose` by `step`, seen from there; all x, y, theta. m, m, rad in (-pi, pi]."""
    return jnp.concatenate([pose[:2] + rotate(pose[2], step[:2]), wrap_angle(pose[2:] + step[2:])])


def between(before: Float[Array, "3"], after: Float[Array, "3"]) -> Float[Array, "3"]:
    """The step from a pose `before` to `after`, seen from the first: `compose(before, step)` is `after`. m, m, rad."""
    return jnp.concatenate([rotate(-before[2], after[:2] - before[:2]), wrap_angle(after[2:] - before[2:])])


def jac_compose_pose(pose: Float[Array, "3"], step: Float[Array, "3"]) -> Float[Array, "3 3"]:
    """The derivative of `compose(pose, step)` by `pose`, at that pose and `step`, derived by hand."""
    return jnp.eye(3, dtype=pose.dtype).at[:2, 2].set(perp(rotate(pose[2], step[:2])))


def jac_compose_step(pose: Float[Array, "3"], step: Float[Array, "3"]) -> Float[Array, "3 3"]:
    """The derivative of `compose(pose, step)` by `step`, derived by hand; it depends on the heading of `pose` alone."""
    ahead = unit(pose[2])
    turned = jnp.stack([ahead, perp(ahead)], -1)
    return jnp.eye(3, dtype=pose.dtype).at[:2, :2].set(turned)


def dot(a: Float[Array, "*#s 2"], b: Float[Array, "*#s 2"]) -> Float[Array, "..."]:
    """Scalar product of the plane vectors `a` and `b`."""
    return a[..., 0] * b[..., 0] + a[..., 1] * b[..., 1]


def shift_matrix(lever: Float[Array, "*s"]) -> Float[Array, "*s 2 2"]:
    """S of (offset', angle)' = S (offset, angle): the same small change of a line, seen from another anchor.

    `lever` is `tangent . (old anchor - new anchor)` in metres. Source: offset' = offset + n(angle) . (old - new), whose
    derivative with respect to the angle is the lever.

    Args:
      lever: m.

    Returns:
      S, with the lever in its corner. Shape `[*s, 2, 2]`.
    """
    one, zero = jnp.ones_like(lever), jnp.zeros_like(lever)
    return jnp.stack([jnp.stack([one, lever], -1), jnp.stack([zero, one], -1)], -2)


def reanchor(lines: Lines, anchor: Float[Array, "*s 2"]) -> Lines:
    """The same line relative to another anchor; the mean exactly, the covariance to first order. For one line or many.

    The end points do not move. `anchor` should lie on the segment: far from it the first order fails.

    Args:
      lines: one line or many.
      anchor: the other anchor, m. Shape `[2]`, or that of the anchors of the lines.

    Returns:
      The lines, with the same end points.
    """
    step = lines.anchor - anchor
    along = dot(lines.tangent, step)
    shift = shift_matrix(along)
    return dataclasses.replace(
        lines,
        anchor=anchor,
        offset=lines.offset + dot(lines.normal, step),
        cov_independent=shift @ lines.cov_independent @ jnp.swapaxes(shift, -1, -2),
        sqrt_persistent=shift @ lines.sqrt_persistent,
        extent=lines.extent + along[..., None],
    )
