"""Trials: what is counted is what happened, alone and in batches."""

import dataclasses
from functools import partial

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from linemap_jax import Capacity, Thresholds, empty_map, extract, update
from linemap_jax.core.settings import preset
from linemap_jax.core.state import NEW, Pose
from linemap_jax.lab import generators
from linemap_jax.lab.batch import run_batch
from linemap_jax.lab.scanners import Scanner, pls, simulate_scan, sweep
from linemap_jax.lab.scoring import judge_matches
from linemap_jax.lab.trials import FACTORS, Conditions, Outcome, Trial, columns_of, mistakes, recommend, summary, trial
from linemap_jax.lab.world import World

SCANS = 16
RUNS = 4
COV_POSE = jnp.diag(jnp.array([0.01, 0.01, 0.002]) ** 2)
COARSE = dataclasses.replace(pls(), bearings=sweep(-np.pi / 2, np.pi / 2, 181))


@jax.jit
def worlds(keys: jax.Array) -> World:
    return jax.vmap(partial(generators.changing_room, scans=SCANS))(keys)


CONDITIONS = Conditions(scanner=COARSE, cov_pose=COV_POSE)


def experiment(run: Trial, conditions: Conditions) -> object:
    return trial(run, conditions, scans=SCANS, **OPTIONS)


OPTIONS = {name: value for name, value in preset("default").items() if name != "thresholds"}


@pytest.fixture(scope="module")
def runs() -> Trial:
    # The last one takes a new line for a known one only if it lies on the very same spot.
    of_runs = [Thresholds()] * (RUNS - 1) + [Thresholds(match_nis=1e-6)]
    thresholds = jax.tree.map(lambda *x: jnp.stack(x), *jax.tree.map(jnp.asarray, of_runs))
    keys = jax.random.split(jax.random.key(3), RUNS)
    return Trial(key=keys, world=worlds(keys), thresholds=thresholds)


@pytest.fixture(scope="module")
def outcomes(runs: Trial) -> dict[str, np.ndarray]:
    return columns_of(run_batch(experiment, runs, CONDITIONS, batch=2))


def test_a_trial_does_not_depend_on_those_beside_it(runs, outcomes):
    alone = run_batch(experiment, jax.tree.map(lambda x: x[1:2], runs), CONDITIONS, batch=2)
    for name, values in columns_of(alone).items():
        np.testing.assert_allclose(values[0], outcomes[name][1], rtol=1e-4, err_msg=name)


def test_good_maps_score_well(outcomes):
    score = summary({name: values[:-1] for name, values in outcomes.items()})
    assert score["runs"] == RUNS - 1
    assert score["precision"] > 0.9
    assert score["recall"] > 0.9
    assert score["duplicates"] < 0.1
    assert score["false_matches"] < 0.05
    assert score["offset_rms_m"] < 0.02
    assert not score["full"]
    assert score["appeared"] >= score["noticed"] > 0
    assert outcomes["walls"].min() >= 4


def test_thresholds_make_a_difference(outcomes):
    missed = outcomes["missed_matches"] / np.maximum(outcomes["true_matches"] + outcomes["missed_matches"], 1)
    assert missed[-1] > 0.5 > 2 * missed[:-1].max()


def test_shares_of_nothing_are_none(outcomes):
    score = summary({name: np.zeros_like(values) for name, values in outcomes.items()})
    assert {score[name] for name in ("precision", "recall", "mean_nees", "gone", "false_matches", "offset_rms_m")} == {
        None
    }


def test_matches_are_judged_by_the_walls():
    world = generators.room(8.0, 6.0)
    pose = jnp.array([1.0, 0.5, 0.3])
    scanner = Scanner(bearings=sweep(-np.pi, np.pi * 0.99, 360), range_sigma=0.005)
    scan, truth = simulate_scan(jax.random.key(0), world, pose, scanner)
    estimate = Pose(mean=pose, cov=COV_POSE)
    capacity = Capacity(8, 8)
    look = jax.jit(partial(update, capacity=capacity))
    line_map, _ = look(empty_map(capacity), scan, estimate)
    found = jax.jit(partial(extract, capacity=capacity))(scan, estimate)
    assert int(found.lines.valid.sum()) == 5  # the wall behind is cut where the sweep begins

    def judged(slots: jax.Array) -> tuple[int, ...]:
        return tuple(int(x) for x in judge_matches(line_map.lines, found, slots, world, truth))

    matched = look(line_map, scan, estimate)[1].line_slot
    assert judged(matched) == (5, 0, 0)
    assert judged(jnp.full_like(matched, NEW)) == (0, 0, 5)
    wrong = jnp.where(matched >= 0, jnp.roll(matched, 2), matched)
    true, false, missed = judged(jnp.where(found.lines.valid, jnp.maximum(wrong, 0), NEW))
    assert false > 0
    assert true + false == 5
    assert missed == 0


def drives(rng: np.random.Generator, count: int, held: float) -> dict[str, np.ndarray]:
    """Results of made-up drives that have seen 20 m of wall each, and hold about a share of that."""
    columns = {field.name: np.zeros(count) for field in dataclasses.fields(Outcome)}
    return columns | {"wall_seen": np.full(count, 20.0), "wall_held": 20 * rng.normal(held, 0.02, count)}


def test_mistakes_are_shares_of_what_there_was():
    columns = drives(np.random.default_rng(0), 3, 0.9) | {"walls": np.full(3, 4.0), "duplicates": np.array([0, 1, 2.0])}
    wrong, whole = mistakes(columns)
    assert wrong.shape == whole.shape == (3, 7)
    np.testing.assert_array_equal(wrong[:, 2] / whole[:, 2], [0, 0.25, 0.5])
    np.testing.assert_allclose(wrong[:, 1], 20 - columns["wall_held"])
    assert not whole[:, [0, 3, 4, 5, 6]].any()


def test_the_error_of_the_mean_nees_is_that_over_drives():
    """As the scatter of the mean itself says, where the lines of one drive err alike."""
    rng = np.random.default_rng(2)
    lines = rng.integers(5, 15, (4000, 100)).astype(float)
    nees = lines * rng.exponential(2.0, lines.shape)
    made = drives(rng, 100, 0.9) | {"square_error": np.zeros((100, 2))}
    scores = [summary(made | {"nees": n, "lines_on_walls": k}) for n, k in zip(nees, lines, strict=True)]
    means, errors = (np.array([score[name] for score in scores]) for name in ("mean_nees", "mean_nees_error"))
    assert errors.mean() == pytest.approx(means.std(), rel=0.1)


def test_a_value_is_recommended_where_it_is_surely_better():
    rng = np.random.default_rng(1)
    present = FACTORS.index(1.0)
    variants = [(name, 2.0 * factor) for name in ("match_gap", "match_nis") for factor in FACTORS]
    much, little = np.full(len(FACTORS), 0.9), np.full(len(FACTORS), 0.9)
    much[present + 1], much[present + 2], little[present + 1] = 0.95, 0.98, 0.903
    columns = [drives(rng, 40, held) for held in (*much, *little)]
    first, second = recommend(variants, columns)
    assert (first.threshold, first.value) == ("match_gap", 2 * FACTORS[present + 2])
    assert (second.threshold, second.value) == ("match_nis", 2.0)
    np.testing.assert_allclose(first.costs, 1 - much, atol=0.02)
    # The standard error of a difference of two means, each of 40 drives
    others = np.arange(len(FACTORS)) != present
    np.testing.assert_allclose(first.errors[others], 0.02 * np.sqrt(2 / 40), rtol=0.3)
    assert first.differences[present] == first.errors[present] == 0
