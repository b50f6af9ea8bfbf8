"""The maximum-likelihood line, one Gauss-Newton step from the regression. Not in the paper.

The regression of Eqs. (6)-(8) takes the noise to be across the regressor. It lies along the beams: where a wall is seen
at a slant, the noise has a part along the regressor too, and the slope comes out too small, by up to 0.2 sigma. That
does not show in one scan; after fifty it is most of the error.

With the line n . (x - a) = h, a beam b and its range r the likelihood is that of r - rho with rho the range at which
the beam meets the line. Times c = n . b this is u = n . (p - a) - h, with variance c^2 sigma_r^2 + rho^2 (1 - c^2)
sigma_alpha^2, and du = -dh + s d(angle), where s is how far from the anchor the beam meets the line. Weights and s
belong to the beam, not to the noisy point, which is what keeps the estimate unbiased.
"""

from typing import NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from linemap_jax.core.fields import documented
from linemap_jax.core.frames import dot, perp, unit, wrap_angle
from linemap_jax.core.propagation import apply, inverse
from linemap_jax.core.runs import Runs
from linemap_jax.core.sensor import Points
from linemap_jax.core.settings import Jacobians, SensorNoise

SHALLOW = 0.02
"""Cosine of the incidence (89 degrees) beyond which a beam does not say where it meets a line."""


@documented
class Linearised(NamedTuple):
    """The likelihood around some lines. Constants of the step, whatever they were computed from."""

    normal: Float[Array, "K 2"]
    """Unit normals of the lines at which u was linearised."""
    anchor: Float[Array, "K 2"]
    """Anchors of the lines, in the coordinates of the points, m."""
    rows: Float[Array, "N 2"]
    """d(offset, angle) / d(u) of each point's line, weighted: C (1, -s) / variance."""


def linearise(
    points: Points, runs: Runs, anchor: Float[Array, "K 2"], line: Float[Array, "2 K"], noise: SensorNoise
) -> Linearised:
    """The normal equations of one step, solved: how each residual moves its line.

    Args:
      points: the points of the scan.
      runs: the lines that they belong to.
      anchor: of each line, in the coordinates of the points.
      line: offset and angle of each, to start from.
      noise: of the sensor.

    Returns:
      What `step` needs.
    """
    normal = unit(line[1])
    mine = runs.spread(jnp.concatenate([normal, anchor, line[0][:, None]], -1))
    n, a, offset = mine[:, :2], mine[:, 2:4], mine[:, 4]
    cosine = dot(n, points.beam)
    steep = jnp.abs(cosine) > SHALLOW
    to_line = offset + dot(n, a - points.laser[None])
    rho = jnp.where(steep, to_line / jnp.where(steep, cosine, 1), points.range)
    along = dot(perp(n), points.laser[None] + rho[:, None] * points.beam - a)
    cosine2 = jnp.maximum(cosine**2, SHALLOW**2)
    variance = noise.range_sigma**2 * cosine2 + (rho * noise.bearing_sigma) ** 2 * (1 - cosine2)
    weight = 1 / jnp.where(variance > 0, variance, 1)
    row = jnp.stack([jnp.ones_like(along), -along], -1)
    information = runs.sum(row[:, :, None] * row[:, None, :] * weight[:, None, None])
    rows = apply(runs.spread(inverse(information)), row * weight[:, None])
    in_run = (runs.of_point >= 0)[:, None]
    return Linearised(normal=normal, anchor=anchor, rows=jnp.where(in_run, rows, 0))


def step(position: Float[Array, "N 2"], runs: Runs, line: Float[Array, "2 K"], at: Linearised) -> Float[Array, "2 K"]:
    """One Gauss-Newton step: offset and angle of each line, improved.

    Args:
      position: the points, in metres. Shape `[N, 2]`.
      runs: the lines that they belong to.
      line: offset and angle of each, where it was linearised.
      at: what `linearise` gives for it.

    Returns:
      Offsets in metres and angles in radians, in (-pi, pi]. Shape `[2, K]`.
    """
    mine = runs.spread(jnp.concatenate([at.normal, at.anchor, line[0][:, None]], -1))
    residual = dot(mine[:, :2], position - mine[:, 2:4]) - mine[:, 4]
    change = runs.sum(at.rows * residual[:, None])
    return jnp.stack([line[0] + change[:, 0], wrap_angle(line[1] + change[:, 1])])


def jac_step_points(
    position: Float[Array, "N 2"], runs: Runs, line: Float[Array, "2 K"], at: Linearised, *, jacobians: Jacobians
) -> Float[Array, "N 2 2"]:
    """d(offset, angle) of each point's line / d(x, y) of the point; zero for points of no line.

    To first order the start does not matter to the maximum of the likelihood, and is held fixed.

    Args:
      position: the points, in metres. Shape `[N, 2]`.
      runs: the lines that they belong to.
      line: offset and angle of each, where it was linearised.
      at: what `linearise` gives for it.
      jacobians: "autodiff": two reverse passes through the step; "analytic": derived by hand.

    Returns:
      Without unit, and rad/m. Shape `[N, 2, 2]`.

    Raises:
      ValueError: at trace time, if `jacobians` is neither.
    """
    if jacobians == "autodiff":
        _, pull_back = jax.vjp(lambda x: step(x, runs, line, at), position)
        seeds = jnp.eye(2, dtype=position.dtype)[:, :, None] * jnp.ones_like(line[:1])[None]
        offset, angle = (pull_back(seed)[0] for seed in seeds)
        return jnp.stack([offset, angle], 1)
    if jacobians == "analytic":
        return at.rows[:, :, None] * runs.spread(at.normal)[:, None, :]
    raise ValueError(f"jacobians must be 'autodiff' or 'analytic', not {jacobians!r}")
