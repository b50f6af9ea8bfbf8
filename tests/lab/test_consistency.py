"""Covariances hold: a smaller run of what scripts/measure_consistency.py does in full.

Bands are six sigma wide, and seeds fixed: what is right never fails by chance.
"""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy import stats

from linemap_jax.core.frames import unit
from linemap_jax.core.settings import Persistence, Rules
from linemap_jax.core.state import empty_lines
from linemap_jax.lab import consistency
from linemap_jax.lab.consistency import CHI2_95, CHI2_MEDIAN, Bands, Cell, Fit, Model, Sample, Walls, bands, judge

RUNS = 400
SIX_SIGMA = 2 * stats.norm.sf(6)
CELLS = consistency.cells()
CHOSEN = [
    "wall of 8 m at 2 m, 0 degrees; 0.03 m, 0.1 degree; pose 1 cm, 0.2 degree",
    "wall of 2 m at 10 m, 60 degrees; 0.01 m, 0.1 degree; pose 1 cm, 0.2 degree",
    "wall of 8 m at 5 m, 30 degrees; 0.03 m, 0.0 degree; exact pose",
    # Its far end is seen at a grazing angle, where noise decides how far apart points are.
    "wall of 8 m at 2 m, 60 degrees; 0.01 m, 0.1 degree; exact pose",
    "room turned by 20 degrees, from aside; 0.01 m, 0.0 degree; exact pose",
    "room turned by 0 degrees, from middle; 0.03 m, 0.1 degree; pose 5 cm, 1 degree",
]


@jax.jit
def one_scan(keys: jax.Array, cell: Cell) -> tuple[dict[str, Sample], Sample, Sample]:
    def run(key: jax.Array) -> tuple[dict[str, Sample], Sample, Sample]:
        where = (cell.world, cell.path[0], cell.scanner, cell.cov_pose)
        known = consistency.known_points(key, *where)
        return known, *consistency.pipeline(key, *where, jacobians="analytic")

    return jax.lax.map(run, keys, batch_size=100)


def assert_holds(verdict: consistency.Verdict, band: Bands) -> None:
    assert consistency.holds(verdict, band), (verdict, band)


@pytest.mark.parametrize("name", CHOSEN)
def test_one_scan_holds_and_the_print_does_not(name):
    known, longest, every = one_scan(jax.random.split(jax.random.key(1), RUNS), CELLS[name])
    band = bands(RUNS, error=SIX_SIGMA)
    assert_holds(judge(known[Fit.DEFAULT.value]), band)
    assert_holds(judge(known[Fit.REGRESSION.value]), band)
    assert_holds(judge(longest), band)
    all_lines = judge(every)
    assert all_lines.runs >= RUNS
    assert all_lines.inside > 0.93 - 6 * np.sqrt(0.07 * 0.93 / RUNS)
    # The median's standard deviation is 1 / (2 f sqrt(n)), with the density f = exp(-x / 2) / 2 = 1 / 4 there.
    assert abs(all_lines.median - CHI2_MEDIAN) < 0.1 * CHI2_MEDIAN + 6 * 2 / np.sqrt(RUNS)
    printed = judge(known[Fit.PRINTED.value])
    if name.endswith("exact pose"):
        assert printed[:5] == pytest.approx(judge(known[Fit.REGRESSION.value])[:5])  # there is nothing to share
    else:
        assert printed.mean > 2 * band.mean[1]
        assert printed.inside < 0.8


def test_a_line_is_as_accurate_as_other_fits_of_its_points():
    """Of all of them: what is near the ends, which the default leaves out, tells of an angle most of all."""
    method = {"jacobians": "analytic", "rules": Rules(leave_out_ends=False)}
    cell = CELLS["wall of 8 m at 5 m, 30 degrees; 0.03 m, 0.0 degree; exact pose"]
    where = (cell.world, cell.path[0], cell.scanner)

    @jax.jit
    def many(keys: jax.Array) -> tuple[jax.Array, jax.Array]:
        return jax.lax.map(lambda key: consistency.rho_errors(key, *where, **method), keys, batch_size=100)

    errors, counts = jax.tree.map(np.asarray, many(jax.random.split(jax.random.key(3), RUNS)))
    assert np.all(counts)
    spread = errors.std(0)
    assert np.all(np.abs(errors.mean(0)) < 6 * spread / np.sqrt(RUNS) + 1e-3)
    # 150 points of 3 cm, and three fits that weigh them differently
    assert np.all(spread < 3 * 0.03 / np.sqrt(150))
    assert spread[0] < 1.02 * spread[2] < 1.04 * spread[1]
    assert len(np.unique(spread)) == 3


@pytest.mark.parametrize("correlation", [0.0, 0.9, 1.0])
def test_fifty_scans_hold_if_the_model_of_the_pose_error_does(correlation):
    cell = CELLS["wall of 2 m at 10 m, 60 degrees; 0.01 m, 0.1 degree; pose 1 cm, 0.2 degree"]
    runs = 200
    models = (
        Model("independent"),
        Model("persistent", Persistence(share=1.0, correlation=correlation)),
        Model("unknown"),
    )

    @jax.jit
    def many(keys: jax.Array) -> tuple[Sample, jax.Array]:
        def run(key: jax.Array) -> tuple[Sample, jax.Array]:
            args = (cell.world, cell.path, cell.scanner, cell.cov_pose, correlation, models)
            return consistency.fused(key, *args)

        return jax.lax.map(run, keys, batch_size=100)

    samples, nis = jax.tree.map(np.asarray, many(jax.random.split(jax.random.key(2), runs)))
    last = [judge(jax.tree.map(lambda x, i=i: x[:, i, -1], samples)) for i in range(3)]
    band = bands(runs, error=SIX_SIGMA)
    assert_holds(last[1], band)
    spread = 6 * 2 / np.sqrt(runs)
    assert last[2].mean < 2.3 + spread
    assert last[2].inside > 0.93 - 6 * np.sqrt(0.07 * 0.93 / runs)
    # The NIS of one run are correlated if the pose error is; their mean over runs is not.
    assert abs(nis[:, 1, 1:].mean() - 2) < 6 * nis[:, 1, 1:].mean(1).std() / np.sqrt(runs)
    if correlation == 0:
        assert_holds(last[0], band)
        assert last[2].mean < 2  # a bound, and not a tight one here
    else:
        assert last[0].mean > 2 * band.mean[1]


def test_a_wall_out_of_sight_is_not_fused_and_gives_no_nis():
    cell = CELLS["wall of 2 m at 2 m, 0 degrees; 0.01 m, 0.0 degree; exact pose"]
    path = cell.path.at[1:, 2].set(np.pi)  # turned away
    samples, nis = jax.jit(
        lambda key: consistency.fused(key, cell.world, path, cell.scanner, cell.cov_pose, 0.0, (Model("independent"),))
    )(jax.random.key(0))
    assert nis[0].tolist() == [0.0] * path.shape[0]
    np.testing.assert_allclose(samples.nees[0], samples.nees[0, 0])


@pytest.mark.parametrize("turned", [False, True])
def test_the_error_of_a_line_that_is_known(turned):
    wall = Walls(point=jnp.array([[3.0, 1.0]]), angle=jnp.array([0.4]))
    line = empty_lines(1)
    angle = 0.4 + 0.01 + (np.pi if turned else 0.0)
    offset = 0.5 + 0.02 if turned else -0.5 - 0.02
    line = line.replace(
        anchor=wall.point + 0.5 * unit(wall.angle), angle=jnp.array([angle]), offset=jnp.array([offset])
    )
    error = consistency.line_error(line, wall)[0]
    np.testing.assert_allclose(error, [0.02 if turned else -0.02, 0.01], atol=1e-12)
    cov = jnp.array([[4e-4, 1e-4], [1e-4, 1e-4]])
    np.testing.assert_allclose(consistency.nees(error, cov), error @ np.linalg.inv(cov) @ error, rtol=1e-9)


def test_bands_are_those_of_chi_square_and_of_the_binomial():
    runs, cells = 10_000, 264
    band = bands(runs, cells)
    tail = 0.001 / cells / 2
    np.testing.assert_allclose(band.mean, stats.chi2.ppf([tail, 1 - tail], 2 * runs) / runs, rtol=1e-4)
    np.testing.assert_allclose(band.inside, stats.binom.ppf([tail, 1 - tail], runs, 0.95) / runs, atol=1e-3)
    assert {dof: pytest.approx(stats.chi2.ppf(0.95, dof), rel=1e-12) for dof in (2, 3)} == CHI2_95
    assert stats.chi2.ppf(0.5, 2) == pytest.approx(CHI2_MEDIAN)


def test_the_table_has_its_264_cells():
    assert len(CELLS) == 264
    assert all(name in CELLS for name in CHOSEN)


def test_no_run_no_verdict():
    with pytest.raises(ValueError, match="hardly a run"):
        judge(Sample(np.ones(3), np.ones((3, 2)), np.zeros(3, bool)))
