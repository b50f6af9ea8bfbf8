"""The map as a recording of ROS 2 in one MCAP file, for RViz and Foxglove; written by `rosbags`, without ROS.

On `/linemap/markers` one `visualization_msgs/MarkerArray`: a marker for each kind of thing, which is its namespace, so
that each can be hidden. With poses, on `/linemap/path` one `nav_msgs/Path`. Both are latched (transient local).
"""

import math
import os
import tempfile
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray
from rosbags.interfaces import Qos, QosDurability, QosHistory, QosLiveliness, QosReliability, QosTime
from rosbags.rosbag2 import StoragePlugin, Writer
from rosbags.typesys import Stores, get_typestore

from linemap_jax.core.state import LineMap
from linemap_jax.io.atomic import atomic_write
from linemap_jax.io.shapes import LEVEL, Floats, outlines, shapes_of_map

MARKERS, PATH = "/linemap/markers", "/linemap/path"
FRAME = "map"

_VERSION = 8
"""Of the format; the latest one that ROS 2 Humble reads."""
_BAND_STEPS, _CIRCLE_STEPS = 9, 24
_WIDTH = 0.05  # m, of drawn lines
_NEVER = QosTime(2147483647, 4294967295)
_LATCHED = Qos(
    QosHistory.KEEP_LAST,
    1,
    QosReliability.RELIABLE,
    QosDurability.TRANSIENT_LOCAL,
    _NEVER,
    _NEVER,
    QosLiveliness.AUTOMATIC,
    _NEVER,
    avoid_ros_namespace_conventions=False,
)


def write_mcap(
    path: str | os.PathLike[str],
    line_map: LineMap,
    timestamps: ArrayLike | None = None,
    poses: ArrayLike | None = None,
    *,
    level: float = LEVEL,
    overwrite: bool = False,
) -> None:
    """Write a map, and the path of the robot, as messages of ROS 2.

    Args:
      path: of the file.
      line_map: the map.
      timestamps: of the poses, s. Shape `[T]`, or None. The messages bear the last one, or 0.
      poses: of the robot, x, y, theta: m, m, rad. Shape `[T, 3]`, or None.
      level: probability of the confidence bands and ellipses, in (0, 1).
      overwrite: whether an older file may be replaced.

    Raises:
      OutputError: if the file exists and `overwrite` is false, or cannot be written.
    """
    store = get_typestore(Stores.ROS2_HUMBLE)
    stamps = np.zeros(0) if timestamps is None else np.asarray(timestamps, float)
    now = _nanoseconds(stamps[-1]) if len(stamps) else 0
    messages = {
        MARKERS: store.types["visualization_msgs/msg/MarkerArray"](markers=_markers(store, line_map, now, level))
    }
    if poses is not None:
        messages[PATH] = _path(store, stamps, np.asarray(poses, float), now)
    with atomic_write(path, overwrite=overwrite) as temporary:
        # The library writes a folder; of it only the recording itself is wanted.
        with tempfile.TemporaryDirectory(dir=temporary.parent, prefix=".linemap-") as folder:
            bag = Path(folder) / "bag"
            with Writer(bag, version=_VERSION, storage_plugin=StoragePlugin.MCAP) as writer:
                for topic, message in messages.items():
                    kind = message.__msgtype__
                    connection = writer.add_connection(topic, kind, typestore=store, offered_qos_profiles=[_LATCHED])
                    writer.write(connection, now, store.serialize_cdr(message, kind))
            os.replace(bag / "bag.mcap", temporary)


def _markers(store: Any, line_map: LineMap, now: int, level: float) -> list[Any]:
    """One marker for each kind of thing, also where there is none of it: then it deletes what was drawn before."""
    types = store.types
    shapes = shapes_of_map(line_map, level, band_steps=_BAND_STEPS, circle_steps=_CIRCLE_STEPS)
    blue, orange = (0.03, 0.19, 0.42), (0.90, 0.62, 0.0)
    drawn = [
        ("lines", "LINE_LIST", shapes.segments.reshape(-1, 2), (*blue, 1.0), 0.0),
        ("bands", "TRIANGLE_LIST", _triangles(shapes.bands), (*orange, 0.5), -0.01),
        (
            "circles",
            "LINE_LIST",
            _edges(outlines(shapes.center, shapes.radius, _CIRCLE_STEPS)),
            (0.13, 0.44, 0.71, 1),
            0.0,
        ),
        ("ellipses", "LINE_LIST", _edges(shapes.ellipses), (*orange, 1.0), 0.01),
    ]
    marker, vector = types["visualization_msgs/msg/Marker"], types["geometry_msgs/msg/Vector3"]
    point, colour = types["geometry_msgs/msg/Point"], types["std_msgs/msg/ColorRGBA"]
    nothing = types["sensor_msgs/msg/CompressedImage"](header=_header(store, 0), format="", data=np.zeros(0, np.uint8))
    found = []
    for name, kind, points, (r, g, b, a), z in drawn:
        is_list = kind == "LINE_LIST"
        found.append(
            marker(
                header=_header(store, now),
                ns=name,
                id=0,
                type=getattr(marker, kind),
                action=marker.ADD if len(points) else marker.DELETE,
                pose=_pose(store, 0.0, 0.0, 0.0),
                scale=vector(x=_WIDTH, y=0.0, z=0.0) if is_list else vector(x=1.0, y=1.0, z=1.0),
                color=colour(r=r, g=g, b=b, a=a),
                lifetime=types["builtin_interfaces/msg/Duration"](sec=0, nanosec=0),
                frame_locked=False,
                points=[point(x=x, y=y, z=z) for x, y in points.tolist()],
                colors=[],
                texture_resource="",
                texture=nothing,
                uv_coordinates=[],
                text="",
                mesh_resource="",
                mesh_file=types["visualization_msgs/msg/MeshFile"](filename="", data=np.zeros(0, np.uint8)),
                mesh_use_embedded_materials=False,
            )
        )
    return found


def _path(store: Any, stamps: NDArray[np.float64], poses: Floats, now: int) -> Any:
    stamped = store.types["geometry_msgs/msg/PoseStamped"]
    return store.types["nav_msgs/msg/Path"](
        header=_header(store, now),
        poses=[
            stamped(header=_header(store, _nanoseconds(stamp)), pose=_pose(store, *pose))
            for stamp, pose in zip(stamps.tolist(), poses.tolist(), strict=True)
        ],
    )


def _header(store: Any, nanoseconds: int) -> Any:
    seconds, rest = divmod(nanoseconds, 10**9)
    stamp = store.types["builtin_interfaces/msg/Time"](sec=seconds, nanosec=rest)
    return store.types["std_msgs/msg/Header"](stamp=stamp, frame_id=FRAME)


def _pose(store: Any, x: float, y: float, theta: float) -> Any:
    types = store.types
    return types["geometry_msgs/msg/Pose"](
        position=types["geometry_msgs/msg/Point"](x=x, y=y, z=0.0),
        orientation=types["geometry_msgs/msg/Quaternion"](x=0.0, y=0.0, z=math.sin(theta / 2), w=math.cos(theta / 2)),
    )


def _nanoseconds(seconds: float) -> int:
    """A time stamp as ROS has it; times before 1970 and beyond 2038, which it cannot say, become the nearest it can."""
    return min(max(round(float(seconds) * 1e9), 0), (2**31 - 1) * 10**9)


def _edges(polygons: Floats) -> Floats:
    """The sides of polygons `[P, S, 2]` as pairs of points. Shape `[2 P S, 2]`."""
    return np.stack([polygons, np.roll(polygons, -1, 1)], 2).reshape(-1, 2)


def _triangles(bands: Floats) -> Floats:
    """Bands `[K, 2 S, 2]`, up one side and down the other, as triples of points. Shape `[6 K (S - 1), 2]`."""
    steps = bands.shape[1] // 2
    one, other = bands[:, :steps], bands[:, steps:][:, ::-1]
    corners = [one[:, :-1], one[:, 1:], other[:, :-1], other[:, :-1], one[:, 1:], other[:, 1:]]
    return np.stack(corners, 2).reshape(-1, 2)
