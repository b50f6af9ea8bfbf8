"""Fusion: Eq. (23), errors that persist, pieces that share a pose, ten thousand fusions in float32, and end points."""

import dataclasses
from functools import partial
from typing import Any, get_args

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from compiling import as_built

from linemap_jax.core.fusion import Errors, at_first_angle, combine, forget, fuse_circles, fuse_lines
from linemap_jax.core.matching import CircleMatches
from linemap_jax.core.settings import PAPER_RULES, PoseError, Rules, Thresholds
from linemap_jax.core.state import Circles, Lines, Pose, empty_circles, empty_lines

MODELS = get_args(PoseError)
NOTHING = np.zeros((2, 3))


def line(
    anchor: Any,
    offset: float,
    angle: float,
    cov: Any,
    root: Any = NOTHING,
    extent: Any = (-1.0, 1.0),
    var: float = 1e-4,
) -> Lines:
    """One line in one slot; `cov` and `root` are the two parts of its error."""
    return dataclasses.replace(
        empty_lines(1),
        anchor=jnp.asarray([anchor], float),
        offset=jnp.asarray([offset], float),
        angle=jnp.asarray([angle], float),
        cov_independent=jnp.asarray([cov], float),
        sqrt_persistent=jnp.asarray([root], float),
        first_angle=jnp.asarray([angle], float),
        extent=jnp.asarray([extent], float),
        var_extent=jnp.full((1, 2), var),
        times_detected=jnp.ones(1, jnp.int32),
        valid=jnp.ones(1, bool),
    )


def stack(*items: Any) -> Any:
    return jax.tree.map(lambda *x: jnp.concatenate(x), *items)


def in_float32(tree: Any) -> Any:
    return jax.tree.map(lambda x: x.astype(jnp.float32) if x.dtype == jnp.float64 else x, tree)


def reversed_(piece: Lines) -> Lines:
    """The same line seen from behind: offset and normal turn round, and so do the ends."""
    flip = jnp.array([-1.0, 1.0])
    return dataclasses.replace(
        piece,
        offset=-piece.offset,
        angle=piece.angle + jnp.pi,
        cov_independent=piece.cov_independent * (flip[:, None] * flip[None])[None],
        sqrt_persistent=piece.sqrt_persistent * flip[None, :, None],
        extent=-piece.extent[:, ::-1],
        var_extent=piece.var_extent[:, ::-1],
    )


@partial(jax.jit, static_argnames=("rules", "pose_error"))
def fuse(
    model: Lines,
    pieces: Lines,
    has_prior: jax.Array,
    share: float | jax.Array = 1.0,
    *,
    rules: Rules = Rules(),
    pose_error: PoseError = "unknown",
) -> Lines:
    """All pieces belong to one line, which stands once for each of them in `model`."""
    n = pieces.valid.shape[0]
    share = jnp.asarray(share, pieces.offset.dtype)
    return fuse_lines(model, has_prior, pieces, jnp.ones((n, n), bool), Thresholds(), rules, pose_error, share)


YES, NO = jnp.ones(1, bool), jnp.zeros(1, bool)
C_L = np.array([[4e-4, 1e-4], [1e-4, 9e-4]])
C_M = np.array([[2e-4, -5e-5], [-5e-5, 3e-4]])


@pytest.mark.parametrize("pose_error", MODELS)
@pytest.mark.parametrize("behind", [False, True])
@pytest.mark.parametrize("angle", [0.3, 3.13, -3.13])
def test_one_piece_is_equation_23(angle: float, behind: bool, pose_error: PoseError) -> None:
    """Where no error persists, whatever the model says of it."""
    model = line([5, 6], 0.01, angle, C_L)
    piece = line([5, 6], 0.03, angle + 0.02, C_M)
    # K = C_l (C_l + C_m)^-1, as printed
    gain = C_L @ np.linalg.inv(C_L + C_M)
    offset, turn = gain @ [0.02, 0.02]
    cov = C_L - gain @ C_L
    fused = fuse(model, reversed_(piece) if behind else piece, YES, pose_error=pose_error)
    np.testing.assert_allclose(fused.offset[0], 0.01 + offset, rtol=1e-12)
    difference = float(fused.angle[0]) - angle - turn
    np.testing.assert_allclose(np.remainder(difference + 1, 2 * np.pi) - 1, 0, atol=1e-12)
    assert -np.pi < fused.angle[0] <= np.pi
    np.testing.assert_allclose(fused.cov[0], cov, rtol=1e-10, atol=1e-16)
    assert not fused.sqrt_persistent.any()
    np.testing.assert_array_equal(fused.anchor, model.anchor)
    assert fused.times_detected[0] == 2


def test_a_pose_error_that_does_not_persist_is_noise_of_equation_23() -> None:
    root = np.array([[0.02, 0.01, 0.0], [0.0, 0.005, -0.01]])
    model, piece = line([5, 6], 0.01, 0.3, C_L), line([5, 6], 0.03, 0.32, C_M, root)
    fused = fuse(model, piece, YES, 0.0, pose_error="independent")
    noisy = fuse(model, line([5, 6], 0.03, 0.32, C_M + root @ root.T), YES, pose_error="independent")
    jax.tree.map(lambda a, b: np.testing.assert_allclose(a, b, rtol=1e-12, atol=1e-16), fused, noisy)


def least_squares(model: Lines, pieces: list[Lines], prior: bool) -> tuple[np.ndarray, np.ndarray]:
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
    for i, piece in enumerate(pieces):
        cov[2 * i : 2 * i + 2, 2 * i : 2 * i + 2] = piece.cov_independent[0]
    shared = np.concatenate([np.asarray(piece.sqrt_persistent[0]) for piece in pieces])
    weight = np.linalg.inv(cov + shared @ shared.T)
    a = np.concatenate(rows)
    information = a.T @ weight @ a + (np.linalg.inv(model.cov[0]) if prior else 0)
    return np.linalg.solve(information, a.T @ weight @ np.array(seen)), np.linalg.inv(information)


def pieces_of_one_scan(random: np.random.Generator, angle: float) -> list[Lines]:
    """Three pieces of one line; a pose error moves the line, which each piece sees at its own anchor."""
    tangent = np.array([-np.sin(angle), np.cos(angle)])
    half = random.standard_normal((3, 2, 2))
    covs = 1e-4 * half @ half.transpose(0, 2, 1) + 2e-5 * np.eye(2)
    at_model = np.array([[*random.standard_normal(3)], [0, 0, 1]])
    cov_pose = np.array([[9e-4, 1e-4, 1e-5], [1e-4, 4e-4, -2e-5], [1e-5, -2e-5, 1e-4]])
    return [
        line(
            np.array([3, 1]) + s * tangent,
            0.01 * random.standard_normal(),
            angle + 0.01 * random.standard_normal(),
            cov,
            np.array([[1, -s], [0, 1]]) @ at_model @ np.linalg.cholesky(cov_pose),
        )
        for s, cov in zip((-2.0, 0.5, 4.0), covs, strict=True)
    ]


@pytest.mark.parametrize("behind", [False, True])
@pytest.mark.parametrize("prior", [True, False])
def test_pieces_that_share_a_pose_are_generalised_least_squares(prior: bool, behind: bool) -> None:
    angle = 0.8
    model = line([3, 1], 0.0, angle, C_L)
    pieces = pieces_of_one_scan(np.random.default_rng(2), angle)
    change, cov = least_squares(model, pieces, prior)
    # One after the other, as if independent, would believe too much.
    alone = np.linalg.inv(sum(np.linalg.inv(np.asarray(piece.cov[0])) for piece in pieces))
    if not prior:
        assert np.linalg.det(alone) < np.linalg.det(cov)
    if behind:
        pieces[1] = reversed_(pieces[1])
    fused = fuse(stack(model, model, model), stack(*pieces), jnp.full(3, prior), 0.0, pose_error="independent")
    for i in range(3):
        np.testing.assert_allclose([fused.offset[i], fused.angle[i] - angle], change, rtol=1e-8, atol=1e-13)
        np.testing.assert_allclose(fused.cov[i], cov, rtol=1e-8, atol=1e-15)
    assert fused.times_detected.tolist() == [2 if prior else 1] * 3


@pytest.mark.parametrize("share", [0.0, 0.3, 1.0])
@pytest.mark.parametrize("pose_error", ["persistent", "unknown"])
def test_what_persists_of_a_new_line_is_its_share_of_the_pose(share: float, pose_error: PoseError) -> None:
    pieces = pieces_of_one_scan(np.random.default_rng(2), 0.8)
    model = line([3, 1], 0.0, 0.8, C_L)
    change, cov = least_squares(model, pieces, prior=False)
    fused = fuse(stack(model, model, model), stack(*pieces), jnp.zeros(3, bool), share, pose_error=pose_error)
    np.testing.assert_allclose([fused.offset[0], fused.angle[0] - 0.8], change, rtol=1e-8)
    np.testing.assert_allclose(fused.cov[0], cov, rtol=1e-8, atol=1e-15)
    # The pose moves the pieces as it moves the one line that they are; the first one lies at -2 m.
    root = np.array([[1, -2], [0, 1]]) @ np.asarray(pieces[0].sqrt_persistent[0])
    np.testing.assert_allclose(fused.sqrt_persistent[0], np.sqrt(share) * root, rtol=1e-8, atol=1e-12)


def test_pieces_of_other_lines_do_not_matter() -> None:
    model, piece = line([5, 6], 0.01, 0.3, C_L), line([5, 6], 0.03, 0.32, C_M)
    other = line([-50, 6], 3.0, 1.3, C_M, np.full((2, 3), 0.01))
    together = fuse_lines(
        stack(model, other),
        stack(YES, NO),
        stack(piece, other),
        jnp.eye(2, dtype=bool),
        Thresholds(),
        Rules(),
        "unknown",
        jnp.asarray(1.0),
    )
    alone = fuse(model, piece, YES)
    jax.tree.map(lambda a, b: np.testing.assert_allclose(a[:1], b, rtol=1e-12), together, alone)
    # A new line is its piece.
    for field in dataclasses.fields(other):
        before, after = (np.asarray(getattr(x, field.name), float)[-1] for x in (other, together))
        np.testing.assert_allclose(after, before, rtol=1e-9)


PERSISTING = np.array([[0.03, 0.02, -0.01], [0.0, 0.004, 0.009]])


@pytest.mark.parametrize(
    ("pose_error", "root", "lever", "sigmas"),
    [(*model, lever, 1e-3) for model in (("independent", NOTHING), ("unknown", PERSISTING)) for lever in (0, 5, 50)]
    # Away from the anchor what should cancel, A_new - A_old, is rounding, and that is the same in all scans.
    + [("persistent", PERSISTING, lever, sigmas) for lever, sigmas in ((0, 1e-3), (5, 3e-3), (50, 0.03))],
)
def test_ten_thousand_fusions_in_float32(pose_error: PoseError, root: np.ndarray, lever: float, sigmas: float) -> None:
    """They stay positive definite, and are those in float64."""
    cov = np.diag([0.01, 0.005]) ** 2
    start = line([0, 0], 0.0, 0.4, cov, root)
    shift = np.array([[1, -lever], [0, 1]])
    piece = line(lever * np.array([-np.sin(0.4), np.cos(0.4)]), 0.0, 0.4, cov, shift @ root)
    # The same piece seen with its noise, in numbers that float32 holds
    noise = np.random.default_rng(3).standard_normal((10_000, 2)) * [0.01, 0.005]
    noise = jnp.asarray(noise, jnp.float32)

    def run(start: Lines, piece: Lines) -> tuple[Lines, np.ndarray, np.ndarray]:
        def step(model: Lines, change: jax.Array) -> Any:
            change = change.astype(piece.offset.dtype)
            seen = dataclasses.replace(piece, offset=piece.offset + change[0], angle=piece.angle + change[1])
            model = fuse(model, seen, YES, pose_error=pose_error)
            return model, (model.cov[0], jnp.stack([model.offset[0], model.angle[0]]))

        model, (covs, means) = as_built(partial(jax.lax.scan, step))(start, noise)
        return model, np.asarray(covs), np.asarray(means)

    model, covs, means = run(*in_float32((start, piece)))
    _, exact, exact_means = run(start, piece)
    assert covs.dtype == means.dtype == np.float32
    assert exact.dtype == np.float64
    np.testing.assert_array_equal(covs, covs.transpose(0, 2, 1))
    assert np.all(np.linalg.eigvalsh(covs.astype(float)) > 0)
    difference = np.linalg.norm(covs - exact, axis=(1, 2)) / np.linalg.norm(exact, axis=(1, 2))
    np.testing.assert_array_less(difference, 1e-3)
    # The angle itself is rounded 10 000 times, by at most half a unit in the last place.
    sigma = np.sqrt(np.diagonal(exact, axis1=1, axis2=2))
    rounding = np.sqrt(len(covs)) * np.spacing(np.abs(exact_means).astype(np.float32)) / 2
    np.testing.assert_array_less(np.abs(means - exact_means), sigmas * sigma + rounding)
    assert model.times_detected[0] == 10_001
    if pose_error == "independent":
        # Against one least-squares problem
        expected = np.linalg.inv(np.linalg.inv(cov) + 10_000 * shift.T @ np.linalg.inv(cov) @ shift)
        np.testing.assert_allclose(exact[-1], expected, rtol=1e-6)


def errors_of(primitives: Any) -> Errors:
    names = [field.name for field in dataclasses.fields(Errors)]
    return Errors(**{name: getattr(primitives, name) for name in names})


def random_errors(random: np.random.Generator, count: int, n: int) -> Errors:
    """Errors of `count` estimates, either part of which may be the larger one by a factor of 100."""
    half = random.standard_normal((count, n, n)) * 10 ** random.uniform(-1, 1, (count, 1, 1))
    root = random.standard_normal((count, n, 3)) * 10 ** random.uniform(-1, 1, (count, 1, 1))
    return Errors(
        cov_independent=jnp.asarray(half @ half.transpose(0, 2, 1) + 1e-3 * np.eye(n)),
        sqrt_persistent=jnp.asarray(root),
        times_detected=jnp.asarray(random.integers(1, 30, count), jnp.int32),
    )


def test_persistent_is_a_kalman_filter_that_considers_the_pose_error() -> None:
    """A filter in NumPy on (line, u), that ages u by its model and updates the line alone (Schmidt-Kalman)."""
    random = np.random.default_rng(7)
    correlation = 0.8
    scans = random_errors(random, 30, 2)
    seen = random.standard_normal((30, 2))
    take = lambda i: jax.tree.map(lambda x: x[i : i + 1], scans)  # noqa: E731

    mine, estimate = take(0), seen[0]
    c, a = np.asarray(scans.cov_independent[0]), np.asarray(scans.sqrt_persistent[0])
    # The first scan says x = seen - a u - noise, and u is estimated by zero.
    state, p = np.concatenate([seen[0], np.zeros(3)]), np.block([[c + a @ a.T, -a], [-a.T, np.eye(3)]])
    for i in range(1, 30):
        mine = forget(mine, correlation**2)
        gain, mine = jax.jit(combine, static_argnames="pose_error")(mine, take(i), "persistent")
        estimate = estimate + np.asarray(gain[0]) @ (seen[i] - estimate)

        f = np.diag([1, 1, *[correlation] * 3])
        p = f @ p @ f.T + np.diag([0, 0, *[1 - correlation**2] * 3])
        a = np.asarray(scans.sqrt_persistent[i])
        h = np.concatenate([np.eye(2), a], 1)
        # What a scan says of u is known to one part in two hundred.
        r = np.asarray(scans.cov_independent[i]) + 0.005**2 * a @ a.T
        k = p @ h.T @ np.linalg.inv(h @ p @ h.T + r)
        k[2:] = 0
        state = state + k @ (seen[i] - h @ state)
        p = (np.eye(5) - k @ h) @ p @ (np.eye(5) - k @ h).T + k @ r @ k.T

        np.testing.assert_allclose(estimate, state[:2], rtol=1e-8)
        root = np.asarray(mine.sqrt_persistent[0])
        np.testing.assert_allclose(root, -p[:2, 2:], rtol=1e-7, atol=1e-9)
        np.testing.assert_allclose(mine.cov_independent[0] + root @ root.T, p[:2, :2], rtol=1e-7, atol=1e-10)


def test_a_large_gain_leaves_a_covariance_in_float32() -> None:
    """Views that differ in what persists by far more than by noise, one of them much surer of one direction."""
    random = np.random.default_rng(0)
    n = 2000

    def errors(lever: np.ndarray, cov: np.ndarray) -> Errors:
        root = np.zeros((n, 2, 3))
        root[:, 0, 0], root[:, 1, 0] = lever, 1.0
        times = jnp.ones(n, int)
        return in_float32(
            Errors(cov_independent=jnp.asarray(cov), sqrt_persistent=jnp.asarray(root), times_detected=times)
        )

    unsure = np.stack([np.cos(angle := random.uniform(0, np.pi, n)), np.sin(angle)], -1)
    cov = 1e-12 * (unsure[:, :, None] * unsure[:, None] + 1e-5 * np.eye(2))
    lever = random.normal(size=n)
    new = errors(lever + 0.1 * random.normal(size=n), np.tile(1e-12 * np.eye(2), (n, 1, 1)))
    _, joint = combine(errors(lever, cov), new, "persistent")
    fused = np.asarray(joint.cov_independent, float)
    sigma = np.sqrt(np.diagonal(fused, axis1=-2, axis2=-1))
    assert np.linalg.eigvalsh(fused / (sigma[:, :, None] * sigma[:, None])).min() > -1e-5


def test_pieces_move_with_the_pose_as_their_line_did_at_first() -> None:
    """Against the motion of a line by a displaced robot, by central differences; from both sides."""
    pose = Pose(mean=jnp.array([1.0, -2.0, 0.3]), cov=jnp.array([[4e-4, 1e-4, 0], [1e-4, 9e-4, 2e-5], [0, 2e-5, 1e-4]]))
    first = line([3, 1], 0.0, 0.4, C_L, PERSISTING)
    piece = line([3.1, 0.8], 0.01, 0.43, C_M, PERSISTING)

    def moved(step: np.ndarray, angle: float) -> np.ndarray:
        turn = np.array([[np.cos(step[2]), -np.sin(step[2])], [np.sin(step[2]), np.cos(step[2])]])
        robot, anchor = np.asarray(pose.mean[:2]), np.asarray(piece.anchor[0])
        normal = np.array([np.cos(angle + step[2]), np.sin(angle + step[2])])
        return np.array([normal @ (robot + step[:2] + turn @ (anchor - robot) - anchor), angle + step[2]])

    for seen, angle in ((piece, 0.4), (reversed_(piece), 0.4 + np.pi)):
        jac = [(moved(1e-6 * e, angle) - moved(-1e-6 * e, angle)) / 2e-6 for e in np.eye(3)]
        found = at_first_angle(seen, first, pose)
        expected = np.transpose(jac) @ np.linalg.cholesky(np.asarray(pose.cov))
        np.testing.assert_allclose(found.sqrt_persistent[0], expected, atol=1e-9)
        np.testing.assert_array_equal(found.angle, seen.angle)
    nothing = line([3.1, 0.8], 0.01, 0.43, C_M)
    assert not at_first_angle(nothing, first, pose).sqrt_persistent.any()


def test_noise_in_the_direction_of_a_line_tells_nothing_of_the_pose() -> None:
    """Views from one place share the whole error of the pose, and however many there are, all of it stays."""
    pose = Pose(mean=jnp.zeros(3), cov=jnp.diag(jnp.array([0.05, 0.05, 0.02]) ** 2))
    of_noise = np.random.default_rng(4).multivariate_normal(np.zeros(2), C_M, 50)
    views = [line([3, 1], offset, 0.4 + turn, C_M, PERSISTING) for offset, turn in of_noise]
    model = at_first_angle(views[0], views[0], pose)
    before = np.asarray(model.sqrt_persistent[0])
    for view in views[1:]:
        model = fuse(model, at_first_angle(view, model, pose), YES, pose_error="persistent")
    np.testing.assert_allclose(model.sqrt_persistent[0], before, atol=1e-3 * np.linalg.norm(before))
    np.testing.assert_array_equal(model.first_angle, views[0].angle)
    np.testing.assert_allclose(model.cov_independent[0], C_M / 50, rtol=0.02, atol=1e-2 * C_M.max() / 50)


@pytest.mark.parametrize("n", [2, 3])
def test_unknown_is_a_bound_for_every_correlation(n: int) -> None:
    random = np.random.default_rng(8)
    count = 2000
    old, new = random_errors(random, count, n), random_errors(random, count, n)
    gain, fused = jax.jit(combine, static_argnames="pose_error")(old, new, "unknown")
    k = np.asarray(gain)
    keep = np.eye(n) - k
    root = np.asarray(fused.sqrt_persistent)
    stated = np.asarray(fused.cov_independent) + root @ root.transpose(0, 2, 1)
    # The correlation of u_old and u_new is any contraction: singular values of at most one.
    u, _, v = np.linalg.svd(random.standard_normal((count, 3, 3)))
    singular = np.where(random.uniform(size=(count, 3)) < 0.5, 1, random.uniform(size=(count, 3)))
    correlation = u * singular[:, None] @ v
    across = keep @ np.asarray(old.sqrt_persistent) @ correlation
    across = across @ (k @ np.asarray(new.sqrt_persistent)).transpose(0, 2, 1)
    parts = [
        part @ np.asarray(errors.cov_independent) @ part.transpose(0, 2, 1)
        + (part @ np.asarray(errors.sqrt_persistent)) @ (part @ np.asarray(errors.sqrt_persistent)).transpose(0, 2, 1)
        for part, errors in ((keep, old), (k, new))
    ]
    true = parts[0] + parts[1] + across + across.transpose(0, 2, 1)
    scale = np.linalg.norm(stated, axis=(1, 2))
    assert np.all(np.linalg.eigvalsh(stated - true)[:, 0] > -1e-12 * scale)
    # To leave the correlation out is no bound.
    ignorant = np.linalg.eigvalsh(parts[0] + parts[1] - true)[:, 0] < -1e-3 * scale
    assert ignorant.mean() > 0.5


def test_equal_views_are_averaged_and_what_they_may_share_stays() -> None:
    """Of n equal views each counts 1/n; the bound is met, since all of them may have one and the same pose error."""
    one = line([0, 0], 0.0, 0.4, C_L, PERSISTING)
    offsets = 0.01 * np.random.default_rng(9).standard_normal(20)
    model = dataclasses.replace(one, offset=jnp.asarray(offsets[:1]))
    for n, offset in enumerate(offsets[1:], 2):
        model = fuse(model, dataclasses.replace(one, offset=jnp.asarray([offset])), YES)
        np.testing.assert_allclose(model.offset[0], offsets[:n].mean(), atol=1e-14)
        np.testing.assert_allclose(model.cov_independent[0], C_L / n, rtol=1e-9)
        root = np.asarray(model.sqrt_persistent[0])
        np.testing.assert_allclose(root @ root.T, PERSISTING @ PERSISTING.T, rtol=1e-9)
    assert model.times_detected[0] == 20


def test_forgetting_leaves_the_covariance_as_it_is() -> None:
    before = line([0, 0], 0.0, 0.4, C_L, PERSISTING)
    for share in (0.0, 0.25, 1.0):
        after = forget(before, share)
        np.testing.assert_allclose(after.cov, before.cov, rtol=1e-12)
        np.testing.assert_allclose(after.sqrt_persistent[0], np.sqrt(share) * PERSISTING, rtol=1e-12)


@pytest.mark.parametrize("pose_error", MODELS)
@pytest.mark.parametrize(("old", "new"), [(0.0, 0.0), (1.0, 0.0), (0.0, 1.0), (1.0, 1.0)])
def test_gradients_are_finite_where_nothing_persists(old: float, new: float, pose_error: PoseError) -> None:
    model = line([0, 0], 0.0, 0.4, C_L, old * PERSISTING)
    piece = line([0.1, 0], 0.01, 0.42, C_M, new * PERSISTING)

    def total(model: Lines, piece: Lines) -> jax.Array:
        fused = fuse(model, piece, YES, pose_error=pose_error)
        return sum(
            jnp.sum(getattr(fused, name))
            for name in ("offset", "angle", "cov_independent", "sqrt_persistent", "extent", "var_extent")
        )

    gradients = jax.grad(total, (0, 1), allow_int=True)(model, piece)
    for gradient in gradients:
        for name in ("offset", "angle", "cov_independent", "sqrt_persistent"):
            assert np.isfinite(getattr(gradient, name)).all(), name
        assert np.any(gradient.cov_independent != 0)


def ends_after(rules: Rules, begins: np.ndarray, ends: np.ndarray, sigma: float) -> tuple[np.ndarray, np.ndarray]:
    """The extents of a line along y after each of the scans, and their variances; it starts as the first of them."""
    piece = line([0, 0], 0.0, 0.0, np.eye(2) * 1e-6, extent=(0, 0), var=sigma**2)

    def at(extent: jax.Array) -> Lines:
        return dataclasses.replace(piece, extent=extent[None])

    def step(model: Lines, extent: jax.Array) -> tuple[Lines, Any]:
        model = fuse(model, at(extent), YES, rules=rules)
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
        cov_independent=jnp.eye(3)[None] * var * fitted,
        fitted=jnp.array([fitted]),
        times_detected=jnp.array([times], jnp.int32),
        valid=jnp.ones(1, bool),
    )


def fused_circle(model: Circles, new: Circles, rules: Rules, pose_error: PoseError = "independent") -> Circles:
    k = new.valid.shape[0]
    matches = CircleMatches(
        slot=jnp.zeros(k, jnp.int32),
        distance=jnp.abs(new.center[:, 0] - model.center[0, 0]),
        nis=jnp.zeros(k),
        dof=jnp.zeros(k, jnp.int32),
        suspect=jnp.full(k, -1, jnp.int32),
    )
    return fuse_circles(model, new, matches, rules, pose_error)


def test_equations_24_and_25_are_the_mean_of_old_and_new() -> None:
    fused = fused_circle(circle(1.0, 0.1, 0, False, times=9), circle(1.2, 0.2, 0, False), PAPER_RULES)
    np.testing.assert_allclose(fused.center, [[1.1, 2.0]])
    np.testing.assert_allclose(fused.radius, [0.15])
    assert fused.times_detected[0] == 10


@pytest.mark.parametrize(
    ("old", "new", "x", "radius", "var", "fitted"),
    [
        ((1.0, 0.1, 3e-4, True), (1.2, 0.1, 1e-4, True), 1.15, 0.1, 0.75e-4, True),
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


@pytest.mark.parametrize("pose_error", MODELS)
def test_fitted_circles_are_combined_as_lines_are(pose_error: PoseError) -> None:
    old, new = circle(1.0, 0.1, 3e-4, True, times=3), circle(1.2, 0.1, 1e-4, True)
    root = jnp.array([[[0.03, 0.0, 0.01], [0.0, 0.02, -0.01], [0.0, 0.0, 0.0]]])
    old, new = (dataclasses.replace(x, sqrt_persistent=factor * root) for x, factor in ((old, 1.0), (new, 0.5)))
    fused = fused_circle(old, new, Rules(), pose_error)
    gain, errors = combine(errors_of(old), errors_of(new), pose_error)
    np.testing.assert_allclose(fused.center[0], np.array([1, 2]) + 0.2 * gain[0, :2, 0], rtol=1e-12)
    np.testing.assert_allclose(fused.cov_independent, errors.cov_independent, rtol=1e-12)
    np.testing.assert_allclose(fused.sqrt_persistent, errors.sqrt_persistent, rtol=1e-12, atol=1e-15)
    assert fused.sqrt_persistent.any()


def test_fitted_circles_are_weighed_at_one_radius() -> None:
    cov = np.array([[4.0, 0.3, 2.0], [0.3, 1.0, 0.1], [2.0, 0.1, 3.0]]) * 1e-4
    old, new = (
        dataclasses.replace(circle(1.0, r, 1.0, True), cov_independent=jnp.asarray(cov)[None]) for r in (0.2, 0.22)
    )

    def at(cov: np.ndarray, ratio: float) -> np.ndarray:
        along = cov[:, 2] / cov[2, 2]  # how much the circle changes with its radius
        return cov + (ratio**4 - 1) * cov[2, 2] * np.outer(along, along)

    seen = at(cov, 0.2 / 0.22)
    gain = cov @ np.linalg.inv(cov + seen)
    expected = np.array([1.0, 2.0, 0.2]) + gain @ [0, 0, 0.02]
    joint = at(np.linalg.inv(np.linalg.inv(cov) + np.linalg.inv(seen)), expected[2] / 0.2)
    fused = fused_circle(old, new, Rules())
    np.testing.assert_allclose([*fused.center[0], fused.radius[0]], expected, rtol=1e-12)
    np.testing.assert_allclose(fused.cov[0], joint, rtol=1e-9)


def test_noise_in_the_curvature_does_not_shrink_a_pole() -> None:
    radius, scans, runs, share = 0.1, 30, 2000, 0.07
    random = np.random.default_rng(9)
    seen = 1 / ((1 + share * random.standard_normal((scans, runs))) / radius)

    def of(radius: jax.Array) -> Circles:
        cov = jnp.diag(jnp.stack([jnp.ones_like(radius), jnp.ones_like(radius), (share * radius**2 / 0.1) ** 2]))
        return dataclasses.replace(circle(0.0, 0.0, 1.0, True), radius=radius[None], cov_independent=cov[None])

    def run(seen: jax.Array) -> Circles:
        step = lambda model, one: (fused_circle(model, of(one), Rules()), None)  # noqa: E731
        return jax.lax.scan(step, of(seen[0]), seen[1:])[0]

    fused = jax.jit(jax.vmap(run, 1))(jnp.asarray(seen))
    z = (fused.radius[:, 0] - radius) / np.sqrt(fused.cov[:, 0, 2, 2])
    # The inverse of a mean of 1 / R: no bias but that of second order.
    assert abs(np.mean(z)) < 0.5
    np.testing.assert_allclose(np.std(z), 1, atol=0.1)
