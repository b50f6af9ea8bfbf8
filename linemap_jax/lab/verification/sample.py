"""Walls seen in one scan, through the pipeline: what the equations are checked on beside their derivatives."""

import dataclasses
from functools import partial
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from linemap_jax.core import lines as lines_
from linemap_jax.core.runs import Runs
from linemap_jax.core.sensor import Points, cov_point, points_from_scan
from linemap_jax.core.settings import Covariance, Jacobians, Mount, SensorNoise
from linemap_jax.core.state import Lines, Pose, Scan, pytree

WALLS, SIZE = 48, 30
"""Number of walls, and of points on each."""
POSE = np.array([5.0, -3.0, 0.7])
COV_POSE = np.array([[25e-4, 5e-4, 2e-4], [5e-4, 16e-4, -1e-4], [2e-4, -1e-4, 3e-4]])
"""5 cm, 4 cm and 1 degree, correlated."""
MOUNT = np.array([0.2, -0.1, 0.3])
COV_MEASUREMENT = np.diag([0.02, 0.002]) ** 2
"""2 cm and 0.1 degree."""


@pytree
class Sample:
    """What the pipeline makes of the walls; `N` points of `K` walls, one wall after the other."""

    measurements: Float[Array, "N 2"]  # range and bearing, m and rad
    points: Points
    cov_point: Float[Array, "N 2 2"]  # C_p
    sums: Float[Array, "K 6"]  # Eq. (5), from the first point: n, R_x, R_y, R_xx, R_yy, R_xy
    fit: lines_.Regression
    exact: Lines
    begin: Float[Array, "K 2"]  # of `exact`, m
    end: Float[Array, "K 2"]
    cov: Float[Array, "K 2 2"]  # of `exact`
    jac_line_pose: Float[Array, "2 K 2 3"]  # P, with jacobians="analytic" and "autodiff"
    cov_measurement: Float[Array, "2 K 2 2"]  # M, likewise
    cov_printed: Float[Array, "K 2 2"]  # with covariance="printed"
    rho: Float[Array, " K"]
    theta: Float[Array, " K"]
    cov_rho_theta: Float[Array, "K 2 2"]
    jac_rho_theta: Float[Array, "K 2 2"]  # d(rho, theta) / d(offset, angle), by autodiff


def draw(random: np.random.Generator) -> Sample:
    """Walls in all directions, 1 to 8 m away, 1.4 m long, with 1 cm of noise in the ranges. All in NumPy's arrays.

    Each is swept counter-clockwise, the order in which the pipeline holds points.
    """
    reach, towards = random.uniform(1, 8, WALLS), random.uniform(-np.pi, np.pi, WALLS)
    direction = np.linspace(0, 2 * np.pi, WALLS, endpoint=False)
    middle = reach[:, None] * np.stack([np.cos(towards), np.sin(towards)], -1)
    direction += np.where(np.sin(direction - towards) < 0, np.pi, 0)
    along = np.linspace(-0.7, 0.7, SIZE)[None, :, None]
    points = middle[:, None] + along * np.stack([np.cos(direction), np.sin(direction)], -1)[:, None]
    x, y = np.moveaxis(points.reshape(-1, 2), -1, 0)
    ranges = np.hypot(x, y) + random.normal(0, 0.01, x.shape)
    return jax.tree.map(np.asarray, _through_pipeline(np.stack([ranges, np.arctan2(y, x) - POSE[2] - MOUNT[2]], -1)))


@partial(jax.jit, compiler_options={"xla_cpu_use_fusion_emitters": False})  # compiles sooner
def _through_pipeline(measurements: Float[Array, "N 2"]) -> Sample:
    n = measurements.shape[0]
    scan = Scan(
        ranges=measurements[:, 0],
        bearings=measurements[:, 1],
        valid=jnp.ones(n, bool),
        spacing=jnp.array(0.01),
        first=jnp.array(0),
    )
    pose = Pose(mean=jnp.asarray(POSE), cov=jnp.asarray(COV_POSE))
    sigma = np.sqrt(np.diag(COV_MEASUREMENT))
    noise = SensorNoise(range_sigma=sigma[0], bearing_sigma=sigma[1])
    first = jnp.arange(0, n, SIZE)
    runs = Runs(first=first, last=first + SIZE - 1, valid=jnp.ones(WALLS, bool), of_point=jnp.arange(n) // SIZE)

    def measure(covariance: Covariance, jacobians: Jacobians) -> tuple[Points, Lines, Array, Array]:
        points = points_from_scan(scan, pose, Mount(*MOUNT), jacobians=jacobians)
        options: Any = {
            "covariance": covariance,
            "jacobians": jacobians,
            "maximum_likelihood": False,
        }  # the paper's line
        return points, *lines_.measure_lines(points, pose, runs, noise, **options)

    points, exact, *by_hand = measure("exact", "analytic")
    _, _, *by_autodiff = measure("exact", "autodiff")
    _, printed, _, _ = measure("printed", "analytic")
    jac_line_pose, cov_measurement = (jnp.stack(both) for both in zip(by_hand, by_autodiff, strict=True))
    rho, theta, cov_rho_theta = lines_.rho_theta(exact)
    x, y = jnp.moveaxis(points.position - runs.spread(points.position[first]), -1, 0)

    def view(state: Array) -> Array:
        moved = dataclasses.replace(exact, offset=exact.offset + state[0], angle=exact.angle + state[1])
        return jnp.stack(lines_.rho_theta(moved)[:2], -1)

    return Sample(
        measurements=measurements,
        points=points,
        cov_point=cov_point(points.jac_pose, points.jac_measurement, pose.cov, noise),
        sums=runs.sum(jnp.stack([jnp.ones_like(x), x, y, x * x, y * y, x * y], -1)),
        fit=lines_.regress(points.position, runs),
        exact=exact,
        begin=exact.begin,
        end=exact.end,
        cov=exact.cov,
        jac_line_pose=jac_line_pose,
        cov_measurement=cov_measurement,
        cov_printed=printed.cov,
        rho=rho,
        theta=theta,
        cov_rho_theta=cov_rho_theta,
        jac_rho_theta=jax.jacfwd(view)(jnp.zeros(2)),
    )
