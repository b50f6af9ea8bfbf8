"""Transforms in space, what is known of frames over time, and trajectories."""

import math

import numpy as np
import pytest

from linemap_jax.io.frames import (
    IDENTITY,
    KEPT,
    Chain,
    FrameTree,
    Track,
    between,
    compose,
    inverse,
    planar,
    poses_of_sweep,
    transform_of,
    upright,
)
from linemap_jax.io.reading import LogError
from linemap_jax.io.tum import read_tum, write_covariances, write_tum


def some(seed: int):
    random = np.random.default_rng(seed)
    transform = transform_of(random.normal(size=3), random.normal(size=4))
    assert transform is not None
    return transform


def matrix(transform) -> np.ndarray:
    """The homogeneous matrix, as textbooks have it."""
    x, y, z, a, b, c, d = transform
    rotation = [
        [1 - 2 * (b * b + c * c), 2 * (a * b - c * d), 2 * (a * c + b * d)],
        [2 * (a * b + c * d), 1 - 2 * (a * a + c * c), 2 * (b * c - a * d)],
        [2 * (a * c - b * d), 2 * (b * c + a * d), 1 - 2 * (a * a + b * b)],
    ]
    return np.block([[np.array(rotation), np.array([[x], [y], [z]])], [np.zeros((1, 3)), np.ones((1, 1))]])


@pytest.mark.parametrize("seed", range(5))
def test_transforms_are_their_matrices(seed):
    a, b = some(seed), some(seed + 100)
    np.testing.assert_allclose(matrix(compose(a, b)), matrix(a) @ matrix(b), atol=1e-12)
    np.testing.assert_allclose(matrix(inverse(a)), np.linalg.inv(matrix(a)), atol=1e-12)
    ahead = matrix(a)[:2, 0]
    np.testing.assert_allclose(planar(a), [*a[:2], np.arctan2(ahead[1], ahead[0])], atol=1e-12)
    assert upright(a) == pytest.approx(matrix(a)[2, 2])


@pytest.mark.parametrize("seed", range(5))
def test_half_of_the_way_is_the_square_root(seed):
    a, b = some(seed), some(seed + 100)
    for first, second in ((a, b), (a, (*b[:3], *(-q for q in b[3:])))):
        turn = compose(inverse((0.0, 0.0, 0.0, *first[3:])), (0.0, 0.0, 0.0, *between(first, second, 0.5)[3:]))
        whole = matrix(inverse((0.0, 0.0, 0.0, *first[3:]))) @ matrix((0.0, 0.0, 0.0, *second[3:]))
        np.testing.assert_allclose(matrix(turn) @ matrix(turn), whole, atol=1e-9)
    np.testing.assert_allclose(matrix(between(a, b, 0.0)), matrix(a), atol=1e-12)
    np.testing.assert_allclose(matrix(between(a, b, 1.0)), matrix(b), atol=1e-12)


def test_in_the_plane_the_angle_is_linear_on_the_circle():
    first, second = (transform_of((x, 0, 0), (0, 0, math.sin(t / 2), math.cos(t / 2))) for x, t in ((1, 3.0), (2, 3.6)))
    for share in (0.1, 0.25, 0.9):
        x, y, theta = planar(between(first, second, share))
        assert (x, y) == pytest.approx((1 + share, 0))
        assert math.remainder(theta - 3.0 - 0.6 * share, 2 * math.pi) == pytest.approx(0, abs=1e-12)


@pytest.mark.parametrize("rotation", [(0, 0, 0, 0), (math.nan, 0, 0, 1), (math.inf, 0, 0, 1)])
def test_what_is_no_rotation_is_no_transform(rotation):
    assert transform_of((0, 0, 0), rotation) is None
    assert transform_of((0, math.inf, 0), (0, 0, 0, 1)) is None


def at_x(x: float):
    return (x, *IDENTITY[1:])


def test_a_track_knows_what_lies_between_its_stamps():
    track = Track("odom", moves=True)
    for stamp in (1.0, 3.0, 2.0, 3.0):  # out of order, and one twice
        track.add(stamp, at_x(10 * stamp))
    assert [track.covers(*span) for span in ((1, 3), (0.9, 2), (2, 3.1))] == [True, False, False]
    assert track.at(2.5)[0] == 25
    assert track.stamps_inside(1.0, 3.0) == [2.0]


def test_a_track_forgets_and_begins_anew_where_a_clock_is_set_back():
    track = Track("odom", moves=True)
    for i in range(1000):
        track.add(0.1 * i, at_x(i))
    assert not track.covers(50.0, 51.0)
    assert track.covers(99.9 - KEPT, 99.9)
    assert len(track.stamps_inside(0.0, 100.0)) < 4 * KEPT / 0.1
    track.add(5.0, at_x(-1))
    assert not track.covers(5.0, 99.0)
    assert track.at(5.0)[0] == -1


def test_what_never_moved_holds_at_any_time_until_it_does():
    track = Track("base_link")
    track.add(1.0, at_x(5))
    track.add(2.0, at_x(5))
    assert track.covers(-10.0, 100.0)
    assert track.at(50.0)[0] == 5
    track.add(3.0, at_x(6))
    assert track.moves
    assert not track.covers(0.0, 4.0)
    assert track.at(2.5)[0] == 5.5


def test_a_chain_goes_up_and_down_the_tree():
    tree = FrameTree()
    left, right, top = some(1), some(2), some(3)
    tree.add("a", "base", 0.0, left, static=True)
    tree.add("b", "base", 0.0, right, static=False)
    tree.add("base", "map", 0.0, top, static=True)
    tree.add("loop", "pool", 0.0, top, static=True)
    tree.add("pool", "loop", 0.0, top, static=True)
    chain = tree.chain("a", "b")
    assert chain is not None
    np.testing.assert_allclose(matrix(chain.transform_at(7.0)), np.linalg.inv(matrix(right)) @ matrix(left), atol=1e-12)
    down = tree.chain("map", "b")
    assert down is not None
    np.testing.assert_allclose(matrix(down.transform_at(7.0)), np.linalg.inv(matrix(top) @ matrix(right)), atol=1e-12)
    assert tree.chain("a", "elsewhere") is None
    assert tree.ancestors("loop") == ["loop", "pool"]


def test_poses_of_a_sweep_bend_where_poses_are_stated():
    track = Track("odom", moves=True)
    for stamp, x in ((0.0, 0.0), (1.0, 1.0), (2.0, 5.0)):
        track.add(stamp, at_x(x))
    found = poses_of_sweep(Chain([track], []), 0.5, 0.25, 5)
    assert found is not None
    pose, sweep = found
    assert sweep is not None
    np.testing.assert_allclose(sweep[:, 0], [0.5, 0.75, 1.0, 2.0, 3.0])
    np.testing.assert_array_equal(pose, sweep[0])
    assert poses_of_sweep(Chain([track], []), 0.5, 0.5, 5) is None  # ends after what is known
    backwards = poses_of_sweep(Chain([track], []), 1.5, -0.25, 5)  # the last beam came first
    assert backwards is not None
    assert backwards[1] is not None
    np.testing.assert_allclose(backwards[1][:, 0], [3.0, 2.0, 1.0, 0.75, 0.5])


def test_a_trajectory_is_written_and_read(tmp_path):
    random = np.random.default_rng(0)
    stamps, poses = np.arange(20.0), np.cumsum(random.normal(size=(20, 3)), 0)
    write_tum(tmp_path / "poses.tum", stamps, poses)
    found = read_tum(tmp_path / "poses.tum")
    assert found.covers(0, 19)
    assert (found.pose_frame, found.description) == ("robot", "of a given trajectory")
    difference = found.at(stamps) - poses
    np.testing.assert_allclose(difference[:, :2], 0, atol=1e-8)
    np.testing.assert_allclose(np.sin(difference[:, 2] / 2), 0, atol=1e-8)
    np.testing.assert_allclose(found.at(np.array([3.5]))[0, :2], poses[3:5, :2].mean(0), atol=1e-8)


@pytest.mark.parametrize(
    ("text", "cause"),
    [
        ("# a comment\n1 2 3\n", ", line 2: is no pose"),
        ("1 0 0 0 0 0 0 0\n", ", line 1: is no pose"),
        ("1 0 0 x 0 0 0 1\n", ", line 1: is no pose"),
        ("nan 0 0 0 0 0 0 1\n", ", line 1: is no pose"),
        ("# nothing\n\n", ": holds no pose"),
        ("\udcff", ": is no text"),
    ],
)
def test_a_file_that_is_no_trajectory(tmp_path, text, cause):
    path = tmp_path / "poses.tum"
    path.write_bytes(text.encode(errors="surrogateescape"))
    with pytest.raises(LogError) as caught:
        read_tum(path)
    assert str(caught.value).startswith(f"{path}{cause}")
    with pytest.raises(LogError, match="No such file"):
        read_tum(tmp_path / "none.tum")


def test_a_trajectory_comes_with_the_covariances_beside_it(tmp_path):
    path, table = tmp_path / "poses.tum", tmp_path / "poses.csv"
    random = np.random.default_rng(0)
    stamps, poses = 1e9 + 0.1 * np.arange(20), np.cumsum(random.normal(size=(20, 3)), 0)
    roots = 0.1 * random.normal(size=(20, 3, 3))
    covs = roots @ np.swapaxes(roots, 1, 2)
    write_tum(path, stamps, poses)
    assert read_tum(path).cov_at(stamps[0]) is None
    write_covariances(table, stamps, poses, covs, np.zeros(20))
    found = read_tum(path)
    for i in (0, 7, 19):
        np.testing.assert_allclose(found.cov_at(stamps[i]), covs[i], rtol=1e-4, atol=1e-7)
    np.testing.assert_allclose(found.cov_at(stamps[7] + 0.025), (3 * covs[7] + covs[8]) / 4, rtol=1e-4, atol=1e-7)
    np.testing.assert_allclose(found.cov_at(stamps[-1] + 0.05), covs[-1], rtol=1e-6)

    # What the errors of two poses have in common, nothing or all, the pose between is no less known than that.
    for common in (-1.0, 0.0, 1.0):
        shared = common * roots[7] @ roots[8].T
        between = (covs[7] + covs[8] + shared + shared.T) / 4
        bound = found.cov_at((stamps[7] + stamps[8]) / 2)
        assert np.linalg.eigvalsh(bound - between).min() > -1e-6


def test_a_table_beside_a_trajectory_that_is_not_of_its_poses(tmp_path):
    path, table = tmp_path / "poses.tum", tmp_path / "poses.csv"
    stamps, poses, covs = np.arange(3.0), np.zeros((3, 3)), np.tile(np.eye(3), (3, 1, 1))
    write_tum(path, stamps, poses)
    for text in ("", "a,b\n1,2\n", "\udcff"):  # somebody else's file
        table.write_bytes(text.encode(errors="surrogateescape"))
        assert read_tum(path).cov_at(0.0) is None
    for what, told in (
        ((stamps[:2], poses[:2], covs[:2]), "other poses than those beside it"),
        ((stamps + 0.1, poses, covs), "other poses than those beside it"),
        ((stamps, poses + [0, 0, 0.1], covs), "other poses than those beside it"),
        ((stamps, poses, covs + [[0, 2, 0], [2, 0, 0], [0, 0, 0]]), "holds a covariance that is none"),
        ((stamps, poses, -covs), "holds a covariance that is none"),
        ((stamps, poses, covs * np.nan), "holds a covariance that is none"),
    ):
        write_covariances(table, *what, np.zeros(len(what[0])), overwrite=True)
        with pytest.raises(LogError, match=told) as caught:
            read_tum(path)
        assert str(caught.value).startswith(str(table))
    write_covariances(table, stamps, poses, covs, np.zeros(3), overwrite=True)
    whole = table.read_text()
    for text in (whole[:-40], whole.replace("1,0,0", "1,x,0", 1), whole.splitlines(keepends=True)[0]):
        table.write_text(text)
        with pytest.raises(LogError, match="no table of covariances|other poses"):
            read_tum(path)
    # A full turn is no other pose.
    write_covariances(table, stamps, poses + [0, 0, 2 * np.pi], covs, np.zeros(3), overwrite=True)
    assert read_tum(path).cov_at(1.0) is not None


def test_a_trajectory_says_whose_poses_it_holds(tmp_path):
    path = tmp_path / "poses.tum"
    write_tum(path, [0.0, 1.0], np.zeros((2, 3)), pose_frame="laser")
    assert path.read_text().startswith("# poses of the laser: timestamp tx ty tz qx qy qz qw\n")
    found = read_tum(path)
    assert (found.pose_frame, found.description) == ("laser", "of a given trajectory of the laser")
    path.write_text("# another comment, on poses of the laser\n0 0 0 0 0 0 0 1\n")
    assert read_tum(path).pose_frame == "robot"
