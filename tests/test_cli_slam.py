"""`linemap slam` on a simulated drive around a block, from what the wheels have counted."""

import dataclasses
import json
import math
from collections.abc import Callable
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from bags import Recording, heading

from linemap_jax.cli import main
from linemap_jax.cli.evaluate import Evaluate
from linemap_jax.cli.fit import at_poses_of_map
from linemap_jax.cli.options import UsageError
from linemap_jax.core.frames import compose
from linemap_jax.io.carmen_writer import write_carmen
from linemap_jax.io.map_file import read_map
from linemap_jax.io.tum import read_tum, write_tum
from linemap_jax.lab.generators import ring
from linemap_jax.lab.scanners import pls
from linemap_jax.lab.simulate import simulate

SCANS = 400

pytestmark = pytest.mark.usefixtures("jax_as_it_was")


class Drive:
    """A log, and the truth of it."""

    def __init__(self, folder: Path) -> None:
        key = jax.random.key(3)
        made = jax.jit(
            lambda key: simulate(
                key, ring(key, dtype=jnp.float32), pls(), count=SCANS, cov_pose=jnp.zeros((3, 3), "float32")
            )
        )(key)
        self.truth = np.asarray(made.true_poses, float)

        def step(pose: jax.Array, increment: jax.Array) -> tuple[jax.Array, jax.Array]:
            pose = compose(pose, increment)
            return pose, pose

        later = jax.lax.scan(step, made.true_poses[0], made.odometry)[1]
        self.odometry = np.concatenate([self.truth[:1], np.asarray(later, float)])
        self.ranges = np.where(made.scans.valid, made.scans.ranges, 81.0)[:, ::2]  # so many beams as in test_cli.py
        self.bearings = np.asarray(made.scans.bearings[0], float)[::2]
        self.log = folder / "drive.log"
        self.write(self.log)

    def write(self, path: Path, scans: slice = slice(None), stamps: np.ndarray | None = None) -> None:
        """As raw logs are: both poses are odometry's."""
        odometry = self.odometry[scans]
        write_carmen(
            path,
            ranges=self.ranges[scans],
            bearings=self.bearings,
            range_max=50.0,
            poses=odometry,
            odometry=odometry,
            timestamps=0.25 * np.arange(len(odometry)) if stamps is None else stamps,
        )


@pytest.fixture(scope="module")
def drive(tmp_path_factory: pytest.TempPathFactory) -> Drive:
    return Drive(tmp_path_factory.mktemp("drive"))


@pytest.fixture
def run(capsys: pytest.CaptureFixture[str]) -> Callable[..., Any]:
    """Runs the command line in this process; gives the exit status, and what stands on stdout and stderr."""

    def run(*args: Any) -> tuple[int, str, str]:
        capsys.readouterr()
        return main([str(arg) for arg in args]), *capsys.readouterr()

    return run


def test_a_drive_around_a_block(drive: Drive, run: Callable[..., Any], tmp_path: Path) -> None:
    """Odometry ends half a metre off or more, the trajectory within centimetres; every scan has its pose."""
    status, out, _ = run("slam", drive.log, "-o", tmp_path / "out", "--json")
    assert status == 0
    told = json.loads(out)
    found = read_tum(tmp_path / "out" / "trajectory.tum")
    np.testing.assert_allclose(found.stamps, 0.25 * np.arange(SCANS), atol=1e-6)
    assert np.hypot(*(drive.odometry - drive.truth)[-1, :2]) > 0.5
    off = found.poses - drive.truth
    assert np.hypot(off[:, 0], off[:, 1]).max() < 0.1
    assert np.abs(np.angle(np.exp(1j * off[:, 2]))).max() < 0.02
    assert told["loops"] > 20
    assert told["explained"] > 0.9
    assert 0.3 < told["unit_variance"] < 3
    assert told["times_real_time"] == pytest.approx(0.25e6 * (SCANS - 1) / SCANS / told["us_per_scan"])
    assert told["us_per_scan"] > 0
    assert found.pose_frame == "laser"
    table = np.genfromtxt(tmp_path / "out" / "trajectory.csv", delimiter=",", names=True)
    assert table["lost"][0] == 0  # before it there is nothing to agree with
    assert table["keyframe"][0] == 1
    assert table["keyframe"].sum() == told["keyframes"]

    line_map, settings = read_map(tmp_path / "out" / "map.json", dtype="float32")
    lines = jax.tree.map(np.asarray, line_map.lines)
    assert settings["slam"]["keyframes"] == told["keyframes"]
    outer = lines.valid & (np.abs(np.abs(np.sin(lines.angle)) - 1) < 1e-3) & (lines.anchor[:, 1] < -6.5)
    longest = np.flatnonzero(outer)[np.argmax(np.asarray(line_map.lines.length)[outer])]
    y = np.asarray(line_map.lines.begin)[longest, 1]
    assert abs(y + 7.0) < 4 * math.sqrt(np.asarray(line_map.lines.cov)[longest, 0, 0]) + 0.01


def seen_from(x: float, y: float, theta: float) -> float:
    """How far it is along one beam to the wall of a room of 9 m by 6 m with a corner built in."""
    corners = np.array([[-4.0, -3.0], [5.0, -3.0], [5.0, 1.0], [3.0, 1.0], [3.0, 3.0], [-4.0, 3.0]])
    along, off = np.roll(corners, -1, 0) - corners, corners - [x, y]
    ahead = np.array([math.cos(theta), math.sin(theta)])
    det = ahead[0] * along[:, 1] - ahead[1] * along[:, 0]
    reach = (off[:, 0] * along[:, 1] - off[:, 1] * along[:, 0]) / det
    share = (off[:, 0] * ahead[1] - off[:, 1] * ahead[0]) / det
    return reach[(reach > 0) & (share >= 0) & (share <= 1)].min()


def test_a_scanner_that_sweeps_on_wheels_that_count_wrong(run: Callable[..., Any], tmp_path: Path) -> None:
    """They count a tenth too much, so that by them each sweep is bent; the trajectory knows better."""
    random, recording = np.random.default_rng(2), Recording()
    scans, seconds, mount = 90, 0.25, np.array([0.2, 0.1, 0.3])

    def driven(time: float, scale: float = 1.0) -> np.ndarray:
        """A turn to the left and one to the right, from rest; x, y are those of an arc of 0.8 m."""
        turned = scale * 2.5 * (1 - math.cos(2 * math.pi * max(time, 0.0) / (scans * seconds)))
        return np.array([0.8 * math.sin(turned), 0.8 * (1 - math.cos(turned)), turned])

    recording.tf(99.0, "base_link", "laser", (*mount[:2], 0), heading(mount[2]), static=True)
    for i in range(20 * scans):
        recording.odometry(99.5 + seconds * i / 20, tuple(driven(seconds * i / 20 - 0.5, 1.1)))
    bearings = np.deg2rad(np.arange(181) - 90.0)
    truth = []
    for i in range(scans - 3):
        at = [laser_at(driven(seconds * i + 0.1 * beam / 181), mount) for beam in range(181)]
        ranges = [
            seen_from(x, y, theta + bearing) + random.normal(0, 0.01)
            for (x, y, theta), bearing in zip(at, bearings, strict=True)
        ]
        truth.append(at[0])
        recording.scan(
            100.0 + seconds * i,
            ranges,
            angle_min=bearings[0],
            angle_max=bearings[-1],
            angle_increment=bearings[1] - bearings[0],
            time_increment=0.1 / 181,
        )
    log = recording.write(tmp_path)
    status, _, _ = run("slam", log, "-o", tmp_path / "out", "--range-sigma", 0.01, "--bearing-sigma", 1e-5)
    assert status == 0
    table = np.loadtxt(tmp_path / "out" / "trajectory.csv", delimiter=",", skiprows=1)
    off = table[:, 1:4] - np.array(truth)
    off[:, 2] = np.angle(np.exp(1j * off[:, 2]))
    rate = np.gradient(np.array(truth)[:, 2], seconds)
    turning = (np.abs(rate) > 0.6) & (table[:, 4] < 0.01**2)  # keyframes; between them scans have 1 cm of their own
    assert turning.sum() > 10
    # Uncorrected, the mean beam of a sweep would turn a scan by 0.1 x 0.6 rad/s x 0.05 s, 3 mrad.
    assert abs(np.mean((off[:, 2] * np.sign(rate))[turning])) < 0.0015
    cov = np.zeros((len(table), 3, 3))
    cov[:, *np.triu_indices(3)] = table[:, 4:10]
    cov += np.swapaxes(np.triu(cov, 1), 1, 2)
    values = np.einsum("ti,tij,tj->t", off[turning], np.linalg.inv(cov[turning]), off[turning])
    assert values.mean() < 8


def laser_at(robot: np.ndarray, mount: np.ndarray) -> np.ndarray:
    x, y, theta = robot
    c, s = math.cos(theta), math.sin(theta)
    return np.array([x + c * mount[0] - s * mount[1], y + s * mount[0] + c * mount[1], theta + mount[2]])


def test_the_log_of_a_map_is_read_at_the_poses_that_slam_found(tmp_path: Path, capsys: Any) -> None:
    settings = {"log": "drive.log", "slam": {"laser_offset": [0.2, 0.0, 0.1]}}
    trajectory, log = tmp_path / "trajectory.tum", tmp_path / "elsewhere" / "drive.log"
    command = Evaluate(map=tmp_path, log=log)

    def at(command: Evaluate, log: Path = log, settings: Any = settings) -> Evaluate:
        return at_poses_of_map(command, log, command.map, settings, quiet=False)

    with pytest.raises(UsageError, match=r"built by `linemap slam`, so not at the poses of .*: give its trajectory by"):
        at(command)
    write_tum(trajectory, [0.0], np.zeros((1, 3)))
    assert at(command) == dataclasses.replace(command, poses=trajectory, laser_offset=(0.2, 0.0, 0.1))
    assert capsys.readouterr().err == (
        f"linemap: {tmp_path} was built by `linemap slam`: the poses are those of {trajectory}\n"
    )
    assert at(dataclasses.replace(command, map=tmp_path / "map.json")).poses == trajectory
    write_tum(trajectory, [0.0], np.zeros((1, 3)), pose_frame="laser", overwrite=True)
    assert at(command).laser_offset is None
    for other in (dataclasses.replace(command, poses=log), dataclasses.replace(command, standstill=True)):
        assert at(other) is other  # who says where poses come from is obeyed
    assert at(command, log=Path("other.log")) is command
    assert at(command, settings={"log": "drive.log"}) is command
    assert at(command, settings=settings | {"slam": {"laser_offset": ["x"]}}).poses == trajectory


@pytest.mark.parametrize("name", ["map.json", "map.png", "trajectory.tum"])
def test_nothing_is_overwritten(name: str, drive: Drive, run: Callable[..., Any], tmp_path: Path) -> None:
    (tmp_path / name).write_text("mine")
    status, out, err = run("slam", drive.log, "-o", tmp_path)
    assert (status, out) == (2, "")
    assert f"{name} exists already" in err
    assert (tmp_path / name).read_text() == "mine"


def test_a_robot_that_is_carried_away(drive: Drive, run: Callable[..., Any], tmp_path: Path) -> None:
    """What it sees then agrees with nothing: it is told, and no number is lost. The base starts where odometry does."""
    kept = np.r_[0:40, 250:290]
    stamps = np.r_[0.25 * np.arange(40), 100 + 0.25 * np.arange(40)]
    odometry = drive.odometry.copy()
    drive.odometry = drive.odometry - (drive.odometry[250] - drive.odometry[40]) * (np.arange(SCANS) >= 250)[:, None]
    drive.write(tmp_path / "carried.log", kept, stamps)  # pyright: ignore[reportArgumentType]
    drive.odometry = odometry
    options = "--trajectory-frame", "base", "--laser-offset", 0.2, 0, 0
    status, _, err = run("slam", tmp_path / "carried.log", "-o", tmp_path / "out", *options)
    assert status == 0
    assert (tmp_path / "out" / "trajectory.tum").read_text().startswith("# poses of the robot: ")
    assert "1 scan came more than 60 s after" in err
    assert "few points agree with what was seen before" in err
    poses = read_tum(tmp_path / "out" / "trajectory.tum").poses
    assert np.isfinite(poses).all()
    np.testing.assert_allclose(poses[0], drive.odometry[0], atol=1e-4)
    columns = np.loadtxt(tmp_path / "out" / "trajectory.csv", delimiter=",", skiprows=1)
    assert columns.shape == (80, 12)
    assert np.isfinite(columns).all()
    assert columns[40, -1] == 1
