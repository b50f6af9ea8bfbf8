"""Fusion of lines: Eq. (23), pieces that share a pose, ten thousand fusions in float32, and end points."""

import dataclasses
from functools import partial
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from linemap_jax.core.fusion import Pieces, fuse_circles, fuse_lines
from linemap_jax.core.matching import CircleMatches
from linemap_jax.core.settings import PAPER_RULES, Rules, Thresholds
from linemap_jax.core.state import Circles, Lines, empty_circles, empty_lines

NO_POSE = np.zeros((3, 3))


def line(anchor: Any, offset: float, angle: float, cov: Any, extent: Any = (-1.0, 1.0), var: float = 1e-4) -> Lines:
    """One line in one slot."""
    return dataclasses.replace(
        empty_lines(1),
        anchor=jnp.asarray([anchor], float),
        offset=jnp.asarray([offset], float),
        angle=jnp.asarray([angle], float),
        cov=jnp.asarray([cov], float),
        extent=jnp.asarray([extent], float),
        var_extent=jnp.full((1, 2), var),
        times_detected=jnp.ones(1, jnp.int32),
        valid=jnp.ones(1, bool),
    )


def stack(*items: Any) -> Any:
    return jax.tree.map(lambda *x: jnp.concatenate(x), *items)


def reversed_(piece: Lines, jac: np.ndarray) -> tuple[Lines, np.ndarray]:
    """The same line seen from behind: offset and normal turn round, and so do the ends."""
    flip = jnp.asarray([[1.0, -1.0], [-1.0, 1.0]])
    turned = dataclasses.replace(
        piece,
        offset=-piece.offset,
        angle=piece.angle + jnp.pi,
        cov=piece.cov * flip[None],
        extent=-piece.extent[:, ::-1],
        var_extent=piece.var_extent[:, ::-1],
    )
    return turned, jac * np.array([[-1.0], [1.0]])


@partial(jax.jit, static_argnames="rules")
def fuse(
    model: Lines,
    pieces: Lines,
    jac: jax.Array,
    cov_pose: jax.Array,
    has_prior: jax.Array,
    cov: jax.Array | None = None,
    rules: Rules = Rules(),
) -> Lines:
    """All pieces belong to one line, which stands once for each of them in `model`."""
    n = pieces.valid.shape[0]
    observed = Pieces(lines=pieces, cov_measurement=pieces.cov if cov is None else cov, jac_line_pose=jac)
    return fuse_lines(model, has_prior, observed, jnp.ones((n, n), bool), cov_pose, Thresholds(), rules)


YES, NO = jnp.ones(1, bool), jnp.zeros(1, bool)
C_L = np.array([[4e-4, 1e-4], [1e-4, 9e-4]])
C_M = np.array([[2e-4, -5e-5], [-5e-5, 3e-4]])


@pytest.mark.parametrize("behind", [False, True])
@pytest.mark.parametrize("angle", [0.3, 3.13, -3.13])
def test_one_piece_is_equation_23(angle: float, behind: bool) -> None:
    model = line([5, 6], 0.01, angle, C_L)
    piece = line([5, 6], 0.03, angle + 0.02, C_M)
    # K = C_l (C_l + C_m)^-1, as printed
    gain = C_L @ np.linalg.inv(C_L + C_M)
    offset, turn = gain @ [0.02, 0.02]
    cov = C_L - gain @ C_L
    if behind:
        piece, _ = reversed_(piece, np.zeros((2, 3)))
    fused = fuse(model, piece, jnp.zeros((1, 2, 3)), jnp.asarray(NO_POSE), YES)
    np.testing.assert_allclose(fused.offset[0], 0.01 + offset, rtol=1e-12)
    difference = float(fused.angle[0]) - angle - turn
    np.testing.assert_allclose(np.remainder(difference + 1, 2 * np.pi) - 1, 0, atol=1e-12)
    assert -np.pi < fused.angle[0] <= np.pi
    np.testing.assert_allclose(fused.cov[0], cov, rtol=1e-10, atol=1e-16)
    np.testing.assert_array_equal(fused.anchor, model.anchor)
    assert fused.times_detected[0] == 2


def least_squares(
    model: Lines, pieces: list[Lines], jacs: np.ndarray, covs: np.ndarray, cov_pose: np.ndarray, prior: bool
) -> tuple[np.ndarray, np.ndarray]:
    """Generalised least squares for a small change of the model, all pieces and the prior in one system."""
    angle = float(model.angle[0])
    normal, tangent = np.array([np.cos(angle), np.sin(angle)]), np.array([-np.sin(angle), np.cos(angle)])
    rows, seen = [], []
    for piece in pieces:
        step = np.asarray(model.anchor[0] - piece.anchor[0])
        rows.append([[1, tangent @ step], [0, 1]])
        seen += [float(piece.offset[0] - model.offset[0]) - normal @ step, float(piece.angle[0]) - angle]
    n = len(pieces)
    cov = np.zeros((2 * n, 2 * n))
    for i in range(n):
        cov[2 * i : 2 * i + 2, 2 * i : 2 * i + 2] = covs[i]
    shared = jacs.reshape(2 * n, 3)
    weight = np.linalg.inv(cov + shared @ cov_pose @ shared.T)
    a = np.concatenate(rows)
    information = a.T @ weight @ a + (np.linalg.inv(model.cov[0]) if prior else 0)
    return np.linalg.solve(information, a.T @ weight @ np.array(seen)), np.linalg.inv(information)


@pytest.mark.parametrize("behind", [False, True])
@pytest.mark.parametrize("prior", [True, False])
def test_pieces_that_share_a_pose_are_generalised_least_squares(prior: bool, behind: bool) -> None:
    random = np.random.default_rng(2)
    angle = 0.8
    tangent = np.array([-np.sin(angle), np.cos(angle)])
    model = line([3, 1], 0.0, angle, C_L)
    half = random.standard_normal((3, 2, 2))
    covs = 1e-4 * half @ half.transpose(0, 2, 1) + 2e-5 * np.eye(2)
    # A pose error moves one and the same line, which each piece sees at its own anchor.
    along = (-2.0, 0.5, 4.0)
    at_model = np.array([[*random.standard_normal(3)], [0, 0, 1]])
    jacs = np.stack([np.array([[1, -s], [0, 1]]) @ at_model for s in along])
    cov_pose = np.array([[9e-4, 1e-4, 1e-5], [1e-4, 4e-4, -2e-5], [1e-5, -2e-5, 1e-4]])
    pieces = [
        line(
            np.array([3, 1]) + s * tangent, 0.01 * random.standard_normal(), angle + 0.01 * random.standard_normal(), c
        )
        for s, c in zip(along, covs, strict=True)
    ]
    change, cov = least_squares(model, pieces, jacs, covs, cov_pose, prior)
    if behind:
        pieces[1], jacs[1] = reversed_(pieces[1], jacs[1])
    observed = stack(*pieces)
    fused = fuse(stack(model, model, model), observed, jnp.asarray(jacs), jnp.asarray(cov_pose), jnp.full(3, prior))
    for i in range(3):
        np.testing.assert_allclose([fused.offset[i], fused.angle[i] - angle], change, rtol=1e-8, atol=1e-13)
        np.testing.assert_allclose(fused.cov[i], cov, rtol=1e-8, atol=1e-15)
    assert fused.times_detected.tolist() == [2 if prior else 1] * 3
    # One after the other as if independent would believe too much.
    alone = np.linalg.inv(sum(np.linalg.inv(c + j @ cov_pose @ j.T) for c, j in zip(covs, jacs, strict=True)))
    if not prior:
        assert np.linalg.det(alone) < np.linalg.det(cov)


def test_pieces_of_other_lines_do_not_matter() -> None:
    model, piece = line([5, 6], 0.01, 0.3, C_L), line([5, 6], 0.03, 0.32, C_M)
    other = line([-50, 6], 3.0, 1.3, C_M)
    pieces = Pieces(
        lines=stack(piece, other), cov_measurement=stack(piece.cov, other.cov), jac_line_pose=jnp.zeros((2, 2, 3))
    )
    together = fuse_lines(
        stack(model, other), stack(YES, NO), pieces, jnp.eye(2, dtype=bool), jnp.asarray(NO_POSE), Thresholds(), Rules()
    )
    alone = fuse(model, piece, jnp.zeros((1, 2, 3)), jnp.asarray(NO_POSE), YES)
    jax.tree.map(lambda a, b: np.testing.assert_allclose(a[:1], b, rtol=1e-12), together, alone)
    # A new line is its piece.
    for name in ("offset", "angle", "cov", "extent", "var_extent", "times_detected"):
        np.testing.assert_allclose(getattr(together, name)[1], getattr(other, name)[0], rtol=1e-9)


@pytest.mark.parametrize("lever", [0.0, 5.0, 50.0])
def test_ten_thousand_fusions_in_float32_stay_positive_definite(lever: float) -> None:
    lower = partial(jax.tree.map, lambda x: x.astype(jnp.float32) if x.dtype == jnp.float64 else x)
    cov = np.diag([0.01, 0.005]) ** 2
    start = lower(line([0, 0], 0.0, 0.4, cov))
    tangent = np.array([-np.sin(0.4), np.cos(0.4)])
    piece = lower(line(lever * tangent, 0.0, 0.4, cov))
    # The same piece seen with its noise
    noise = np.random.default_rng(3).standard_normal((10_000, 2)) * [0.01, 0.005]

    def step(model: Lines, change: jax.Array) -> tuple[Lines, jax.Array]:
        seen = dataclasses.replace(piece, offset=piece.offset + change[0], angle=piece.angle + change[1])
        model = fuse(model, seen, jnp.zeros((1, 2, 3), jnp.float32), jnp.zeros((3, 3), jnp.float32), YES)
        return model, model.cov[0]

    model, covs = jax.jit(partial(jax.lax.scan, step))(start, jnp.asarray(noise, jnp.float32))
    covs = np.asarray(covs)
    assert covs.dtype == np.float32
    np.testing.assert_array_equal(covs, covs.transpose(0, 2, 1))
    eigenvalues = np.linalg.eigvalsh(covs.astype(float))
    assert np.all(eigenvalues > 0)
    # Against one least-squares problem in float64
    shift = np.array([[1, -lever], [0, 1]])
    information = np.linalg.inv(cov) + 10_000 * shift.T @ np.linalg.inv(cov) @ shift
    expected = np.linalg.inv(information)
    np.testing.assert_allclose(covs[-1], expected, rtol=0.05, atol=0.05 * np.abs(expected).max())
    assert model.times_detected[0] == 10_001


def ends_after(rules: Rules, begins: np.ndarray, ends: np.ndarray, sigma: float) -> tuple[np.ndarray, np.ndarray]:
    """The extents of a line along y after each of the scans, and their variances; it starts as the first of them."""
    piece = line([0, 0], 0.0, 0.0, np.eye(2) * 1e-6, (0, 0), sigma**2)

    def at(extent: jax.Array) -> Lines:
        return dataclasses.replace(piece, extent=extent[None])

    def step(model: Lines, extent: jax.Array) -> tuple[Lines, Any]:
        model = fuse(model, at(extent), jnp.zeros((1, 2, 3)), jnp.asarray(NO_POSE), YES, rules=rules)
        return model, (model.extent[0], model.var_extent[0])

    extents = jnp.asarray(np.stack([begins, ends], -1))
    run = jax.vmap(lambda x: jax.lax.scan(step, at(x[0]), x[1:])[1])
    extent, var = jax.jit(run)(extents)
    return np.asarray(extent), np.asarray(var)


def test_the_papers_ends_only_lengthen() -> None:
    begins, ends = np.array([[-1, -0.9, -1.1, -1.05]]), np.array([[1.0, 1.2, 0.5, 1.1]])
    extent, _ = ends_after(PAPER_RULES, begins, ends, 0.01)
    np.testing.assert_allclose(extent[0], [[-1, 1.2], [-1.1, 1.2], [-1.1, 1.2]])


def test_ends_that_agree_are_averaged_others_lengthen_or_are_hidden() -> None:
    # Variances 1e-4: ends agree within 3 sqrt(2e-4) = 4.2 cm at first.
    begins, ends = np.array([[-1.0, -1.02, -0.5, -1.3]]), np.array([[2.0, 2.04, 2.9, 2.87]])
    extent, var = ends_after(Rules(), begins, ends, 0.01)
    np.testing.assert_allclose(extent[0, 0], [-1.01, 2.02], atol=1e-12)
    np.testing.assert_allclose(var[0, 0], [5e-5, 5e-5], rtol=1e-12)
    # Short of the old begin by half a metre: hidden. Beyond the old end: longer.
    np.testing.assert_allclose(extent[0, 1], [-1.01, 2.9], atol=1e-12)
    np.testing.assert_allclose(var[0, 1], [5e-5, 1e-4], rtol=1e-12)
    np.testing.assert_allclose(extent[0, 2], [-1.3, 2.885], atol=1e-12)


def test_ends_do_not_ratchet() -> None:
    random = np.random.default_rng(4)
    sigma = 0.05
    begins = -1 + sigma * random.standard_normal((100, 50))
    ends = 1 + sigma * random.standard_normal((100, 50))
    growth = {}
    for name, rules in (("default", Rules()), ("paper", PAPER_RULES)):
        extent, _ = ends_after(rules, begins, ends, sigma)
        growth[name] = np.mean(extent[:, -1, 1] - extent[:, -1, 0]) - 2
    assert abs(growth["default"]) < 0.01
    # The largest of 50 normal deviates is 2.25 sigma on the average, at each end.
    np.testing.assert_allclose(growth["paper"], 2 * 2.25 * sigma, rtol=0.1)


def circle(x: float, radius: float, var: float, fitted: bool, times: int = 1) -> Circles:
    return dataclasses.replace(
        empty_circles(1),
        center=jnp.array([[x, 2.0]]),
        radius=jnp.array([radius]),
        cov=jnp.eye(3)[None] * var * fitted,
        fitted=jnp.array([fitted]),
        times_detected=jnp.array([times], jnp.int32),
        valid=jnp.ones(1, bool),
    )


def fused_circle(model: Circles, new: Circles, rules: Rules) -> Circles:
    k = new.valid.shape[0]
    matches = CircleMatches(
        slot=jnp.zeros(k, jnp.int32),
        distance=jnp.abs(new.center[:, 0] - model.center[0, 0]),
        nis=jnp.zeros(k),
        dof=jnp.zeros(k, jnp.int32),
        ambiguous=jnp.zeros(k, bool),
    )
    return fuse_circles(model, new, matches, rules)


def test_equations_24_and_25_are_the_mean_of_old_and_new() -> None:
    fused = fused_circle(circle(1.0, 0.1, 0, False, times=9), circle(1.2, 0.2, 0, False), PAPER_RULES)
    np.testing.assert_allclose(fused.center, [[1.1, 2.0]])
    np.testing.assert_allclose(fused.radius, [0.15])
    assert fused.times_detected[0] == 10


@pytest.mark.parametrize(
    ("old", "new", "x", "radius", "var", "fitted"),
    [
        ((1.0, 0.1, 3e-4, True), (1.2, 0.2, 1e-4, True), 1.15, 0.175, 0.75e-4, True),
        ((1.0, 0.1, 3e-4, True), (1.2, 0.2, 0.0, False), 1.0, 0.1, 3e-4, True),
        ((1.0, 0.1, 0.0, False), (1.2, 0.2, 1e-4, True), 1.2, 0.2, 1e-4, True),
        ((1.0, 0.1, 0.0, False), (1.2, 0.2, 0.0, False), 1.05, 0.125, 0.0, False),
    ],
)
def test_circles_are_weighed(old: Any, new: Any, x: float, radius: float, var: float, fitted: bool) -> None:
    fused = fused_circle(circle(*old, times=3), circle(*new), Rules())
    np.testing.assert_allclose(fused.center, [[x, 2.0]], rtol=1e-12)
    np.testing.assert_allclose(fused.radius, [radius], rtol=1e-12)
    np.testing.assert_allclose(fused.cov[0], var * np.eye(3), atol=1e-15)
    assert (bool(fused.fitted[0]), int(fused.times_detected[0])) == (fitted, 4)
