"""The grid: against a walk along each beam, cell by cell."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from linemap_jax.core.settings import Mount
from linemap_jax.core.state import Pose, Scan
from linemap_jax.lab import occupancy as module
from linemap_jax.lab.occupancy import FREE, OCCUPIED, OCCUPIED_SHARE, UNKNOWN, occupancy, returns_in_world

ROOM = np.array([[-3.0, -2.0], [5.0, 2.5]])  # m, the lower left and the upper right corner
POSES = np.array([[0.0, 0.0, 0.3], [1.0, 0.5, -2.0], [-1.5, -1.0, 1.2]])
BEARINGS = np.deg2rad(np.arange(-90.0, 91.0, 3.0))
MOUNT = Mount(0.2, -0.1, 0.5)


def drive(noise: float = 0.02) -> tuple[Scan, Pose]:
    """Three scans of an empty room, some beams of which see nothing."""
    rng = np.random.default_rng(4)
    ranges = []
    for x, y, theta in POSES:
        start = np.array([x, y]) + [[np.cos(theta), -np.sin(theta)], [np.sin(theta), np.cos(theta)]] @ np.array(
            [MOUNT.x, MOUNT.y]
        )
        heading = theta + MOUNT.theta + BEARINGS
        way = np.stack([np.cos(heading), np.sin(heading)], -1)
        ranges.append(np.where(way > 0, (ROOM[1] - start) / way, (ROOM[0] - start) / way).min(-1))
    ranges = np.array(ranges) + rng.normal(0, noise, (3, BEARINGS.size))
    valid = rng.random(ranges.shape) > 0.1
    scans = Scan(
        ranges=jnp.asarray(np.where(valid, ranges, 0)),
        bearings=jnp.asarray(np.tile(BEARINGS, (3, 1))),
        valid=jnp.asarray(valid),
        spacing=jnp.full(3, BEARINGS[1] - BEARINGS[0]),
        first=jnp.zeros(3, jnp.int32),
    )
    return scans, Pose(mean=jnp.asarray(POSES), cov=jnp.zeros((3, 3, 3)))


def test_the_room_is_what_it_is() -> None:
    scans, poses = drive()
    grid = occupancy(lambda: [(scans, poses)], MOUNT, resolution=0.1)

    def at(x: float, y: float) -> int:
        column, row = ((np.array([x, y]) - grid.origin) / grid.resolution).astype(int)
        return int(grid.cells[row, column])

    assert at(0.0, 0.0) == at(2.0, 1.0) == FREE
    assert grid.cells[0, 0] == grid.cells[-1, -1] == UNKNOWN
    _, points, valid = returns_in_world(scans, poses, MOUNT)
    hits = [at(x, y) for x, y in points[valid]]
    assert np.mean(np.array(hits) == OCCUPIED) > 0.9
    rows, columns = np.nonzero(grid.cells == OCCUPIED)
    centers = grid.origin + (np.stack([columns, rows], -1) + 0.5) * grid.resolution
    to_wall = np.minimum(np.abs(centers - ROOM[0]), np.abs(centers - ROOM[1])).min(-1)
    assert to_wall.max() < 0.2


def test_counts_are_those_of_a_walk_along_each_beam() -> None:
    """Bresenham's line from cell to cell, one beam after the other, in whole numbers."""
    scans, poses = drive()
    resolution = 0.1
    grid = occupancy(lambda: [(scans, poses)], MOUNT, resolution=resolution)
    origin, points, valid = returns_in_world(scans, poses, MOUNT)
    ended, passed = np.zeros(grid.cells.shape), np.zeros(grid.cells.shape)
    for scan in range(3):
        first = np.floor((origin[scan] - grid.origin) / resolution).astype(int)
        for beam in np.flatnonzero(valid[scan]):
            last = np.floor((points[scan, beam] - grid.origin) / resolution).astype(int)
            steps = int(np.abs(last - first).max())
            for k in range(steps):
                # halves are rounded up
                x, y = (
                    (2 * k * int(d) + steps) // (2 * steps) + int(a) for d, a in zip(last - first, first, strict=True)
                )
                passed[y, x] += 1
            ended[last[1], last[0]] += 1
    cells = np.where(ended >= OCCUPIED_SHARE * (ended + passed), OCCUPIED, FREE)
    cells = np.where(ended + passed > 0, cells, UNKNOWN)
    np.testing.assert_array_equal(grid.cells, cells)
    assert set(np.unique(cells)) == {UNKNOWN, FREE, OCCUPIED}


def test_chunks_do_not_matter() -> None:
    scans, poses = drive()
    whole = occupancy(lambda: [(scans, poses)], MOUNT)
    parts = occupancy(lambda: (jax.tree.map(lambda x: x[i : i + 1], (scans, poses)) for i in range(3)), MOUNT)  # noqa: B023
    np.testing.assert_array_equal(whole.cells, parts.cells)
    np.testing.assert_array_equal(whole.origin, parts.origin)


def test_what_it_refuses(monkeypatch: pytest.MonkeyPatch) -> None:
    scans, poses = drive()
    with pytest.raises(ValueError, match="resolution must be positive"):
        occupancy(lambda: [(scans, poses)], resolution=0.0)
    lost = Pose(mean=poses.mean.at[:].set(jnp.nan), cov=poses.cov)
    with pytest.raises(ValueError, match="no return"):
        occupancy(lambda: [(scans, lost)])
    monkeypatch.setattr(module, "MOST_CELLS", 1000)
    with pytest.raises(ValueError, match=r"the scans reach over \d+ m by \d+ m, which takes more than"):
        occupancy(lambda: [(scans, poses)])
