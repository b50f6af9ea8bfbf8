"""Bags for tests: messages are collected, then written in any of the formats by the library's own writers."""

import dataclasses
from pathlib import Path
from typing import Any

import numpy as np
from rosbags.rosbag1 import Writer as Writer1
from rosbags.rosbag2 import CompressionFormat, CompressionMode, StoragePlugin
from rosbags.rosbag2 import Writer as Writer2
from rosbags.typesys import Stores, get_types_from_msg, get_typestore

SCAN = "sensor_msgs/msg/LaserScan"
ODOMETRY = "nav_msgs/msg/Odometry"
TF = "tf2_msgs/msg/TFMessage"
UPSIDE_DOWN = (1.0, 0.0, 0.0, 0.0)  # a quaternion: half a turn about x


def heading(angle: float) -> tuple[float, float, float, float]:
    """The quaternion of a turn about z."""
    return 0.0, 0.0, float(np.sin(angle / 2)), float(np.cos(angle / 2))


@dataclasses.dataclass
class Recording:
    """Messages, each with its topic, its type and the time of recording in seconds."""

    messages: list[tuple[str, str, float, dict[str, Any]]] = dataclasses.field(default_factory=list)

    def scan(self, stamp: float, ranges: Any, *, topic: str = "/scan", recorded: float | None = None, **fields: Any):
        ranges = np.asarray(ranges, np.float32)
        message = {
            "frame": "laser",
            "angle_min": -1.0,
            "angle_max": 1.0,
            "angle_increment": 2.0 / max(ranges.size - 1, 1),
            "time_increment": 0.0,
            "scan_time": 0.0,
            "range_min": 0.1,
            "range_max": 30.0,
            "ranges": ranges,
        }
        self.messages.append((topic, SCAN, _or(recorded, stamp), message | fields | {"stamp": stamp}))

    def odometry(
        self,
        stamp: float,
        pose: tuple[float, float, float],
        *,
        cov: Any = None,
        topic: str = "/odom",
        frame: str = "odom",
        child: str = "base_link",
        recorded: float | None = None,
    ):
        message = {"stamp": stamp, "frame": frame, "child": child, "pose": pose, "cov": cov}
        self.messages.append((topic, ODOMETRY, _or(recorded, stamp), message))

    def tf(
        self,
        stamp: float,
        parent: str,
        child: str,
        translation: tuple[float, float, float] = (0, 0, 0),
        rotation: tuple[float, float, float, float] = (0, 0, 0, 1),
        *,
        static: bool = False,
        recorded: float | None = None,
    ):
        message = {"stamp": stamp, "frame": parent, "child": child, "at": translation, "turn": rotation}
        self.messages.append(("/tf_static" if static else "/tf", TF, _or(recorded, stamp), message))

    def write(self, folder: Path, kind: str = "bag", name: str = "log", *, tf_type: str = TF) -> Path:
        """Write the bag: "bag", "bag-lz4", "bag-bz2"; or a folder, "db3", "db3-zstd", "mcap", "mcap-zstd"."""
        storage, _, packed = kind.partition("-")
        path = folder / (f"{name}.bag" if storage == "bag" else name)
        store = get_typestore(Stores.ROS1_NOETIC if storage == "bag" else Stores.ROS2_HUMBLE)
        if tf_type not in store.types:
            store.register(get_types_from_msg("geometry_msgs/TransformStamped[] transforms", tf_type))
        if storage == "bag":
            writer = Writer1(path)
            if packed:
                writer.set_compression(Writer1.CompressionFormat[packed.upper()])
        else:
            plugin = StoragePlugin.MCAP if storage == "mcap" else StoragePlugin.SQLITE3
            writer = Writer2(path, version=9, storage_plugin=plugin)
            if packed:
                mode = CompressionMode.STORAGE if storage == "mcap" else CompressionMode.MESSAGE
                writer.set_compression(mode, CompressionFormat.ZSTD)
        serialize = store.serialize_ros1 if storage == "bag" else store.serialize_cdr
        with writer:
            connections = {}
            for topic, type_, recorded, fields in sorted(self.messages, key=lambda message: message[2]):
                name_of_type = tf_type if type_ == TF else type_
                if topic not in connections:
                    connections[topic] = writer.add_connection(topic, name_of_type, typestore=store)
                data = serialize(_message(store, name_of_type, fields), name_of_type)
                writer.write(connections[topic], round(1e9 * recorded), data)
        return path


def single_file(folder: Path) -> Path:
    """The one file of a ROS 2 bag that holds the messages."""
    (path,) = [*folder.glob("*.db3"), *folder.glob("*.mcap")]
    return path


def _or(value: float | None, other: float) -> float:
    return other if value is None else value


def _message(store: Any, type_: str, fields: dict[str, Any]) -> Any:
    types = store.types
    fields = dict(fields)
    stamp = round(1e9 * fields.pop("stamp"))
    time = types["builtin_interfaces/msg/Time"](sec=stamp // 10**9, nanosec=stamp % 10**9)
    has_seq = "seq" in types["std_msgs/msg/Header"].__dataclass_fields__
    header = types["std_msgs/msg/Header"](stamp=time, frame_id=fields.pop("frame"), **({"seq": 0} if has_seq else {}))
    vector, quaternion = types["geometry_msgs/msg/Vector3"], types["geometry_msgs/msg/Quaternion"]
    if type_ == SCAN:
        return types[type_](header=header, intensities=np.zeros(0, np.float32), **fields)
    if "at" in fields:
        transform = types["geometry_msgs/msg/Transform"](
            translation=vector(*map(float, fields["at"])), rotation=quaternion(*map(float, fields["turn"]))
        )
        stamped = types["geometry_msgs/msg/TransformStamped"](
            header=header, child_frame_id=fields["child"], transform=transform
        )
        return types[type_](transforms=[stamped])
    x, y, theta = fields["pose"]
    cov = np.zeros(36) if fields["cov"] is None else np.asarray(fields["cov"], float).reshape(36)
    pose = types["geometry_msgs/msg/Pose"](
        position=types["geometry_msgs/msg/Point"](float(x), float(y), 0.0), orientation=quaternion(*heading(theta))
    )
    zero = types["geometry_msgs/msg/Twist"](linear=vector(0.0, 0.0, 0.0), angular=vector(0.0, 0.0, 0.0))
    return types[type_](
        header=header,
        child_frame_id=fields["child"],
        pose=types["geometry_msgs/msg/PoseWithCovariance"](pose=pose, covariance=cov),
        twist=types["geometry_msgs/msg/TwistWithCovariance"](twist=zero, covariance=np.zeros(36)),
    )
