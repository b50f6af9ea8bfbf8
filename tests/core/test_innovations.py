"""Matching: innovations, their covariances and the gates, in matrices."""

import dataclasses
from typing import Any, get_args

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from maps import lines_between, poles_at

from linemap_jax.core.matching import compare_lines, match_circles
from linemap_jax.core.settings import PoseError, Rules, Thresholds
from linemap_jax.core.state import Circles, Lines

MODELS = get_args(PoseError)


def with_errors(primitives: Any, random: np.random.Generator, scale: list[float]) -> Any:
    """The same, with correlated errors of both kinds."""
    root = random.standard_normal((len(primitives.valid), len(scale), len(scale))) * np.array(scale)[:, None]
    persistent = random.standard_normal((len(primitives.valid), len(scale), 3)) * np.array(scale)[:, None]
    return dataclasses.replace(
        primitives,
        cov_independent=jnp.asarray(root @ root.transpose(0, 2, 1)),
        sqrt_persistent=jnp.asarray(persistent),
    )


def pair_of_lines(seed: int) -> tuple[Lines, Lines]:
    """A line of the map, and a piece of it that is a little off; its anchor is elsewhere, and it may be reversed."""
    random = np.random.default_rng(seed)
    both = np.array([[[1.0, 2.0], [5.0, 4.0]], [[3.5, 3.26], [6.0, 4.52]]])
    if seed % 2:
        both[1] = both[1, ::-1]
    lines = with_errors(lines_between(both, room=2), random, [0.02, 0.01])
    new, model = (jax.tree.map(lambda x, i=i: x[i], lines) for i in (1, 0))
    return dataclasses.replace(new, offset=jnp.asarray(0.004)), dataclasses.replace(model, offset=jnp.asarray(-0.003))


@pytest.mark.parametrize("pose_error", MODELS)
@pytest.mark.parametrize("seed", range(4))
def test_lines_are_compared_by_the_covariance_of_their_difference(seed: int, pose_error: PoseError) -> None:
    """Eq. (21) at the anchor of the new line; and the angle and both its ends within so many sigmas of the map's."""
    new, model = pair_of_lines(seed)
    sign = -1 if seed % 2 else 1
    normal, tangent = np.asarray(model.normal), np.asarray(model.tangent)
    step = np.asarray(model.anchor) - np.asarray(new.anchor)
    flip, shift = np.diag([sign, 1]), np.array([[1, tangent @ step], [0, 1]])
    turn = float(new.angle - model.angle) + (np.pi if seed % 2 else 0)
    turn = np.arctan2(np.sin(turn), np.cos(turn))
    y = np.array([sign * float(new.offset) - float(model.offset) - normal @ step, turn])
    a, b = flip @ np.asarray(new.sqrt_persistent), shift @ np.asarray(model.sqrt_persistent)
    cov = flip @ np.asarray(new.cov_independent) @ flip + shift @ np.asarray(model.cov_independent) @ shift.T
    cov = cov + ((a - b) @ (a - b).T if pose_error == "persistent" else a @ a.T + b @ b.T)

    # Across the map's line a point that is s from the new anchor is off by offset - s angle.
    sigmas = [abs(turn) / np.sqrt(cov[1, 1])]
    for end in (np.asarray(new.begin), np.asarray(new.end)):
        row = np.array([1, -tangent @ (end - np.asarray(new.anchor))])
        across = normal @ (end - np.asarray(model.anchor)) - float(model.offset)
        sigmas.append(abs(across) / np.sqrt(row @ cov @ row))
    for share, near in ((1.001, True), (0.999, False)):
        gates = Thresholds(match_angle=0.0, match_distance=0.0, match_sigmas=share * max(sigmas))
        pair = compare_lines(new, model, gates, pose_error)
        assert bool(pair.collinear) == near
        np.testing.assert_allclose([pair.offset, pair.angle], y, atol=1e-12)
        np.testing.assert_allclose(pair.nis, y @ np.linalg.solve(cov, y), rtol=1e-9)


@pytest.mark.parametrize("pose_error", MODELS)
def test_fitted_circles_are_compared_by_the_covariance_of_their_difference(pose_error: PoseError) -> None:
    random = np.random.default_rng(3)
    both = with_errors(poles_at([[2.0, 1.0, 0.1], [2.02, 1.03, 0.09]], room=2), random, [0.02, 0.02, 0.01])

    def at(i: int) -> Circles:
        return jax.tree.map(lambda x: x[i : i + 1], both)

    cov = np.asarray(both.cov_independent).sum(0)
    a, b = np.asarray(both.sqrt_persistent)
    cov = cov + ((a - b) @ (a - b).T if pose_error == "persistent" else a @ a.T + b @ b.T)
    y = np.array([0.02, 0.03, -0.01])
    nis = y @ np.linalg.solve(cov, y)
    for share, matched in ((1.001, True), (0.999, False)):
        gates = Thresholds(circle_match_nis=share * nis)
        found = match_circles(at(1), at(0), gates, Rules(), pose_error)
        np.testing.assert_allclose(found.nis, [nis], rtol=1e-9)
        assert (int(found.slot[0]) == 0) == matched
        assert found.suspect[0] == (-1 if matched else 0)
