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
    lost = np.loadtxt(tmp_path / "out" / "trajectory.csv", delimiter=",", skiprows=1)[:, -1]
    assert lost[0] == 0  # before it there is nothing to agree with

    line_map, settings = read_map(tmp_path / "out" / "map.json", dtype="float32")
    lines = jax.tree.map(np.asarray, line_map.lines)
    assert settings["slam"]["keyframes"] == told["keyframes"]
    outer = lines.valid & (np.abs(np.abs(np.sin(lines.angle)) - 1) < 1e-3) & (lines.anchor[:, 1] < -6.5)
    longest = np.flatnonzero(outer)[np.argmax(np.asarray(line_map.lines.length)[outer])]
    y = np.asarray(line_map.lines.begin)[longest, 1]
    assert abs(y + 7.0) < 4 * math.sqrt(np.asarray(line_map.lines.cov)[longest, 0, 0]) + 0.01


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
    assert columns.shape == (80, 11)
    assert np.isfinite(columns).all()
    assert columns[40, -1] == 1
