"""Make the log that ships with the package: a simulated drive through a cluttered laboratory and its corridor.

The world is the kind that the paper's section 7 maps: walls, door openings, cupboards, desks, and thin legs and columns
that only circles can hold. Halfway a box is carried away and a door is opened, so that the map has something to
forget. The scanner is that of section 2: 180 degrees, a reading each 0.5 degree, up to 50 m.

The log is the same at every run, but for the last byte of rounding between machines.
"""

import argparse
import gzip
import io
import sys
from pathlib import Path
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

Floats = NDArray[np.float64]

LOG = Path(__file__).resolve().parents[1] / "linemap_jax" / "io" / "data" / "demo.log.gz"

# --- The world: metres, x to the east, y to the north; (0, 0) is the south-west corner of the laboratory. ------------

WALLS = (  # x y of one end, x y of the other
    (0.0, 0.0, 0.0, 12.0),  # laboratory: west
    (18.0, 0.0, 18.0, 12.0),  # east
    (0.0, 12.0, 8.94, 12.0),  # north, with a partition that juts out
    (8.94, 12.0, 8.94, 8.4),
    (8.94, 8.4, 9.06, 8.4),
    (9.06, 8.4, 9.06, 12.0),
    (9.06, 12.0, 18.0, 12.0),
    (0.0, 0.0, 2.5, 0.0),  # south, with two door openings
    (2.5, 0.0, 2.5, -0.12),
    (3.6, -0.12, 3.6, 0.0),
    (3.6, 0.0, 14.0, 0.0),
    (14.0, 0.0, 14.0, -0.12),
    (15.1, -0.12, 15.1, 0.0),
    (15.1, 0.0, 18.0, 0.0),
    (-3.0, -0.12, 2.5, -0.12),  # corridor: north face; its east end is a glass door, which no beam sees
    (3.6, -0.12, 14.0, -0.12),
    (15.1, -0.12, 21.0, -0.12),
    (-3.0, -0.12, -3.0, -2.52),  # west end
    (-3.0, -2.52, 5.4, -2.52),  # south face, with a niche
    (5.4, -2.52, 5.4, -2.97),
    (5.4, -2.97, 6.9, -2.97),
    (6.9, -2.97, 6.9, -2.52),
    (6.9, -2.52, 21.0, -2.52),
    (15.1, 0.0, 15.12, 1.04),  # the leaf of the east door, which stands open
)

BOXES = (  # x y of the centre, width, depth, degrees
    (0.3, 4.2, 0.6, 2.2, 0.0),  # cupboard at the west wall
    (6.4, 11.75, 2.0, 0.5, 0.0),  # shelves at the north wall
    (4.0, 11.8, 0.5, 0.4, 0.0),  # pillar
    (13.6, 11.8, 0.5, 0.4, 0.0),  # pillar
    (17.6, 6.0, 0.8, 3.6, 0.0),  # bench at the east wall
    (5.3, 4.6, 1.7, 0.8, 12.0),  # desk
    (15.2, 9.4, 1.4, 0.6, 32.0),  # cabinet
    (10.5, -2.3, 1.4, 0.44, 0.0),  # locker in the corridor
)

POLYGONS = (  # closed
    ((11.6, 4.0), (13.4, 3.9), (14.0, 5.2), (12.9, 6.3), (11.5, 5.6)),  # machine
    ((2.9, 7.6), (4.7, 8.0), (4.6, 8.6), (3.4, 8.35), (3.15, 9.4), (2.55, 9.3)),  # desk with a return
)

TABLES = (  # x y of the centre, width, depth between the legs, degrees; the scanner sees four legs of radius 3 cm
    (6.6, 6.8, 1.5, 0.8, -8.0),
    (12.0, 9.2, 1.6, 0.9, 0.0),
    (16.4, 2.4, 0.9, 1.6, 4.0),
    (7.6, 1.2, 1.5, 0.8, 3.0),
)
LEG = 0.03

POLES = (  # x, y, radius
    (6.0, 9.2, 0.10),  # columns
    (11.2, 7.9, 0.10),
    (9.6, 1.0, 0.10),
    (2.0, 6.2, 0.05),  # stools, stands, a hat stand in the corridor
    (4.2, 2.9, 0.05),
    (10.6, 8.8, 0.04),
    (14.9, 6.6, 0.06),
    (0.6, -0.5, 0.06),
)

BOX_UNTIL = (9.3, 4.3, 0.9, 0.6, -20.0)
"""Stands in the way during the first half of the drive, and is then carried away."""
DOOR_HINGE, DOOR_WIDTH, DOOR_DEGREES = (2.5, -0.06), 1.1, (0.0, 100.0)
"""The west door: closed in the first half, later open, into the laboratory."""

# --- The drive ------------------------------------------------------------------------------------------------------

WAYPOINTS = (
    (1.4, 1.2),
    (1.5, 3.0),
    (1.3, 6.4),
    (1.4, 10.4),
    (4.6, 10.4),
    (7.6, 10.2),
    (8.2, 7.4),
    (10.0, 7.4),
    (10.2, 10.6),
    (13.6, 10.5),
    (16.8, 10.9),
    (16.5, 8.4),
    (15.4, 7.6),
    (13.2, 7.6),
    (10.4, 6.2),
    (7.9, 5.2),
    (8.2, 2.6),
    (11.0, 2.4),
    (14.6, 2.6),
    (14.5, -1.3),
    (17.4, -0.75),
    (18.5, -1.32),
    (17.4, -1.9),
    (14.0, -1.5),
    (9.5, -1.1),
    (6.0, -1.6),
    (3.0, -1.4),
    (3.1, 1.8),
    (6.4, 2.6),
    (9.8, 4.4),
    (10.2, 6.6),
    (8.8, 7.5),
    (8.1, 5.8),
    (6.2, 5.8),
    (2.4, 5.6),
)
SCANS = 300
SCAN_SECONDS = 0.6  # the paper's scanner needs about 600 ms for a scan
SEED = 1996

# --- The scanner and the poses --------------------------------------------------------------------------------------

BEARINGS = np.deg2rad(np.linspace(-90.0, 90.0, 361))
RANGE_SIGMA = 0.015  # m
RANGE_MAX = 50.0  # m
NO_RETURN = 81.91  # m, what such scanners report
DROPOUTS = 0.003  # share of beams that get lost
POSE_SIGMA = np.array([0.01, 0.01, np.deg2rad(0.1)])  # m, m, rad; independent from scan to scan
ODOMETRY_SCALE = np.array([1.008, 1.012])  # systematic error of the distance and of the turn
ODOMETRY_SIGMA = np.array([0.01, 0.02])  # random error per metre and per radian


class World(NamedTuple):
    """What the beams meet."""

    segments: Floats  # [S, 2, 2], end points, m
    circles: Floats  # [C, 3], x, y, radius, m


def polygon_sides(corners: Floats) -> Floats:
    """The sides of a closed polygon. Corners `[N, 2]`, result `[N, 2, 2]`."""
    return np.stack([corners, np.roll(corners, -1, 0)], 1)


def box_corners(x: float, y: float, width: float, depth: float, degrees: float) -> Floats:
    """The corners of a turned rectangle. Shape `[4, 2]`."""
    c, s = np.cos(np.deg2rad(degrees)), np.sin(np.deg2rad(degrees))
    corners = np.array([[-1, -1], [1, -1], [1, 1], [-1, 1]]) * [width / 2, depth / 2]
    return corners @ np.array([[c, s], [-s, c]]) + [x, y]


def world(second_half: bool) -> World:
    """The world before or after the box has gone and the door has opened."""
    angle = np.deg2rad(DOOR_DEGREES[second_half])
    hinge = np.array(DOOR_HINGE)
    door = np.stack([hinge, hinge + DOOR_WIDTH * np.array([np.cos(angle), np.sin(angle)])])
    boxes = BOXES if second_half else (*BOXES, BOX_UNTIL)
    corners = [*(box_corners(*box) for box in boxes), *map(np.array, POLYGONS)]
    segments = [np.array(WALLS).reshape(-1, 2, 2), door[None], *map(polygon_sides, corners)]
    legs = [np.column_stack([box_corners(*table), np.full(4, LEG)]) for table in TABLES]
    return World(np.concatenate(segments), np.concatenate([*legs, np.array(POLES)]))


def cast_rays(world: World, pose: Floats, bearings: Floats) -> Floats:
    """The exact range along each beam, infinity where it meets nothing. Pose `[3]`, bearings `[N]`, result `[N]`."""
    u = np.stack([np.cos(pose[2] + bearings), np.sin(pose[2] + bearings)], -1)[:, None]  # [N, 1, 2]
    to_begin = world.segments[:, 0] - pose[:2]
    along = world.segments[:, 1] - world.segments[:, 0]
    with np.errstate(divide="ignore", invalid="ignore"):  # beams that run parallel to a segment
        den = cross(u, along)
        r = cross(to_begin, along) / den
        s = cross(to_begin, u) / den
    of_segments = np.where((r > 0) & (s >= 0) & (s <= 1), r, np.inf)

    to_center = world.circles[:, :2] - pose[:2]
    half_chord_sq = world.circles[:, 2] ** 2 - cross(u, to_center) ** 2
    r = np.sum(u * to_center, -1) - np.sqrt(np.maximum(half_chord_sq, 0))
    of_circles = np.where((half_chord_sq > 0) & (r > 0), r, np.inf)
    return np.concatenate([of_segments, of_circles], 1).min(1)


def cross(a: Floats, b: Floats) -> Floats:
    """The z component of the cross product, over the last axis."""
    return a[..., 0] * b[..., 1] - a[..., 1] * b[..., 0]


def drive(waypoints: Floats, count: int) -> Floats:
    """`count` poses at equal distances along the way points, their corners rounded off. Shape `[count, 3]`."""
    path = waypoints
    for _ in range(4):  # Chaikin's corner cutting
        quarters = np.stack([0.75 * path[:-1] + 0.25 * path[1:], 0.25 * path[:-1] + 0.75 * path[1:]], 1)
        path = np.concatenate([path[:1], quarters.reshape(-1, 2), path[-1:]])
    length = np.concatenate([[0.0], np.cumsum(np.hypot(*np.diff(path, axis=0).T))])

    def at(s: Floats) -> Floats:
        return np.stack([np.interp(s, length, path[:, 0]), np.interp(s, length, path[:, 1])], -1)

    s = np.linspace(0.0, length[-1], count)
    ahead = at(np.minimum(s + 0.15, length[-1])) - at(np.maximum(s - 0.15, 0.0))
    return np.column_stack([at(s), np.arctan2(ahead[:, 1], ahead[:, 0])])


def drifting_odometry(poses: Floats, rng: np.random.Generator) -> Floats:
    """The poses as wheels would count them. Shape `[T, 3]`."""
    distance = np.hypot(*np.diff(poses[:, :2], axis=0).T)
    turn = wrap(np.diff(poses[:, 2]))
    noise = 1 + ODOMETRY_SIGMA * rng.standard_normal((len(turn), 2))
    distance, turn = (np.stack([distance, turn], -1) * ODOMETRY_SCALE * noise).T
    theta = poses[0, 2] + np.concatenate([[0.0], np.cumsum(turn)])
    middle = theta[:-1] + turn / 2
    steps = distance[:, None] * np.stack([np.cos(middle), np.sin(middle)], -1)
    return np.column_stack([poses[0, :2] + np.concatenate([np.zeros((1, 2)), np.cumsum(steps, 0)]), wrap(theta)])


def wrap(angle: Floats) -> Floats:
    """The angle in [-pi, pi)."""
    return (angle + np.pi) % (2 * np.pi) - np.pi


def measure(poses: Floats, rng: np.random.Generator) -> Floats:
    """What the scanner reports at each pose. Shape `[T, N]`, m."""
    worlds = world(False), world(True)
    exact = np.stack([cast_rays(worlds[2 * i >= len(poses)], pose, BEARINGS) for i, pose in enumerate(poses)])
    ranges = exact + RANGE_SIGMA * rng.standard_normal(exact.shape)
    lost = (exact > RANGE_MAX) | (rng.random(exact.shape) < DROPOUTS)
    return np.where(lost, NO_RETURN, ranges)


def carmen_log(ranges: Floats, poses: Floats, odometry: Floats) -> str:
    """The scans as the text of a CARMEN log."""
    lines = [
        "# message formats defined: PARAM FLASER",
        "# PARAM param_name param_value",
        "# FLASER num_readings [range_readings] x y theta odom_x odom_y odom_theta",
        "# simulated: a laboratory of 18 m x 12 m with a corridor; poses of the laser, sigma 1 cm and 0.1 degrees",
        "PARAM robot_use_laser on nohost 0",
        "PARAM robot_frontlaser_offset 0.0 nohost 0",
        "PARAM robot_rearlaser_offset 0.0 nohost 0",
        "PARAM laser_front_laser_resolution 0.5 nohost 0",
    ]
    for i, (scan, pose, odom) in enumerate(zip(ranges, poses, odometry, strict=True)):
        readings = " ".join(f"{r:.2f}" for r in scan)
        stamp = f"{i * SCAN_SECONDS:.3f}"
        place = " ".join(f"{x:.4f} {y:.4f} {theta:.5f}" for x, y, theta in (pose, odom))
        lines.append(f"FLASER {len(scan)} {readings} {place} {stamp} nohost {stamp}")
    return "\n".join(lines) + "\n"


def packed(text: str) -> bytes:
    """The text under gzip, without a time or a name in the header, so that the bytes depend on the text alone."""
    out = io.BytesIO()
    with gzip.GzipFile(filename="", mode="wb", compresslevel=9, fileobj=out, mtime=0) as file:
        file.write(text.encode("ascii"))
    return out.getvalue()


def main() -> None:
    """Write the demo log and say what it holds."""
    parser = argparse.ArgumentParser(description="Make the demo log that ships with the package.")
    parser.add_argument("-o", "--output", type=Path, default=LOG, help="default: the package's own data")
    path: Path = parser.parse_args().output

    rng = np.random.default_rng(SEED)
    truth = drive(np.array(WAYPOINTS), SCANS)
    ranges = measure(truth, rng)
    poses = truth + POSE_SIGMA * rng.standard_normal(truth.shape)
    poses[:, 2] = wrap(poses[:, 2])
    data = packed(carmen_log(ranges, poses, drifting_odometry(truth, rng)))
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_bytes(data)

    end = world(True)
    metres = np.hypot(*np.diff(truth[:, :2], axis=0).T).sum()
    sys.stdout.write(
        f"{path}: {len(ranges)} scans of {len(BEARINGS)} beams along {metres:.0f} m, {len(data) / 1000:.0f} kB; "
        f"the world at the end has {len(end.segments)} segments and {len(end.circles)} circles\n"
    )


if __name__ == "__main__":
    main()
