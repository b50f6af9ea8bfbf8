"""The most likely line, against scipy: from ranges and beams alone, without points, anchors or regressions."""

from functools import partial

import jax
import jax.numpy as jnp
import numpy as np
import scipy.optimize

from linemap_jax.core.lines import measure_lines
from linemap_jax.core.runs import select_runs
from linemap_jax.core.sensor import points_from_scan
from linemap_jax.core.settings import Mount, SensorNoise
from linemap_jax.core.state import Pose, Scan

RANGE, BEARING = 0.01, 0.015
POSE, MOUNT = np.array([5.0, -3.0, 0.4]), Mount(x=0.2, y=-0.1, theta=0.3)
NORMAL, DISTANCE = 0.9, 1.5
"""Of the wall, from the scanner: seen at incidences from 12 to 70 degrees."""
N = 60


def test_the_line_is_the_most_likely_one_and_its_covariance_the_inverse_information() -> None:
    """Noise of both kinds weighs alike here: what a beam says of the wall depends on its incidence."""
    random = np.random.default_rng(2)
    bearings = np.linspace(NORMAL - np.radians(70), NORMAL - np.radians(12), N) - POSE[2] - MOUNT.theta
    c, s = np.cos(POSE[2]), np.sin(POSE[2])
    laser = POSE[:2] + np.array([[c, -s], [s, c]]) @ [MOUNT.x, MOUNT.y]
    towards = POSE[2] + MOUNT.theta + bearings

    def met(line: np.ndarray, turn: np.ndarray | float = 0.0) -> np.ndarray:
        """Ranges to a line, by (angle of the normal, distance from the scanner), of beams that sway by some angles."""
        return line[1] / np.cos(towards + turn - line[0])

    wall = np.array([NORMAL, DISTANCE])
    ranges = met(wall, BEARING * random.standard_normal(N)) + RANGE * random.standard_normal(N)
    # A bearing errs, and so the range by what the wall's slant makes of it.
    sigma = np.hypot(RANGE, BEARING * (met(wall, 1e-6) - met(wall, -1e-6)) / 2e-6)
    best = scipy.optimize.least_squares(lambda line: (ranges - met(line)) / sigma, wall, xtol=1e-14)
    cov = np.linalg.inv(best.jac.T @ best.jac)

    @partial(jax.jit, static_argnames="jacobians")
    def measured(ranges: jax.Array, jacobians: str) -> tuple:
        pose = Pose(mean=jnp.asarray(POSE), cov=jnp.zeros((3, 3)))
        points = points_from_scan(Scan.from_ranges(ranges, bearings), pose, MOUNT, jacobians="analytic")
        runs, _ = select_runs(jnp.full(N, float(N)), jnp.arange(N) == N - 1, 2)
        noise = SensorNoise(range_sigma=RANGE, bearing_sigma=BEARING)
        return measure_lines(
            points, pose, runs, noise, maximum_likelihood=True, covariance="exact", jacobians=jacobians
        )

    for jacobians in ("analytic", "autodiff"):
        lines, _, cov_found = jax.tree.map(lambda x: np.asarray(x)[0], measured(jnp.asarray(ranges), jacobians))
        # The same line seen from the scanner: the normal may point the other way.
        normal = np.array([np.cos(lines.angle), np.sin(lines.angle)])
        tangent = np.array([-normal[1], normal[0]])
        distance = lines.offset + normal @ (lines.anchor - laser)
        sign = np.sign(distance)
        angle = lines.angle if sign > 0 else lines.angle + np.pi
        shift = np.array([[0.0, 1.0], [sign, sign * (tangent @ (lines.anchor - laser))]])
        error = np.array([np.remainder(angle - best.x[0] + 1, 2 * np.pi) - 1, sign * distance - best.x[1]])
        assert error @ np.linalg.solve(cov, error) < 0.1**2
        scale = np.sqrt(np.outer(np.diag(cov), np.diag(cov)))
        np.testing.assert_allclose(shift @ cov_found @ shift.T / scale, cov / scale, atol=0.03)
