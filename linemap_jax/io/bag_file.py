"""A ROS bag, open: its topics and its messages.

The only place that calls the `rosbags` library, which raises whatever its parsing of damaged bytes runs into: what
leaves this module is a `LogError`, or a `Fault` of one message.
"""

from collections.abc import Iterator
from pathlib import Path
from typing import Any

from rosbags.interfaces import Connection
from rosbags.rosbag1 import Reader as Reader1
from rosbags.rosbag2 import Reader as Reader2
from rosbags.typesys import Stores, get_types_from_msg, get_typestore

from linemap_jax.io.reading import LogError

SCAN = "sensor_msgs/msg/LaserScan"
ODOMETRY = "nav_msgs/msg/Odometry"
TF = ("tf2_msgs/msg/TFMessage", "tf/msg/tfMessage")


class Fault(Exception):
    """What is wrong with one message."""


class BagFile:
    """A bag, open.

    Attributes:
      path: the file or folder.
      format: what it is, in words.
      connections: what was recorded, by topic and publisher.
      counts: messages by topic.
      types: type of the messages by topic.
      size: of the files, bytes.
    """

    def __init__(self, path: Path) -> None:
        """Open a bag.

        Raises:
          LogError: if it cannot be opened.
        """
        self.path = path
        try:
            ros1 = _begins(path, b"#ROSBAG")
            self._reader = Reader1(path) if ros1 else Reader2(path)
            self._reader.open()
        except Exception as error:
            raise LogError(path, _cannot_open(path, error)) from error
        store = get_typestore(Stores.ROS1_NOETIC if ros1 else Stores.LATEST)
        if TF[0] not in store.types:
            store.register(get_types_from_msg("geometry_msgs/TransformStamped[] transforms", TF[0]))
        self._deserialize = store.deserialize_ros1 if ros1 else store.deserialize_cdr
        kind = "ROS 1 bag" if ros1 else "ROS 2 bag"
        self.format = kind if ros1 else f"{kind}, {_storage(path)}"
        self.connections: list[Connection] = list(self._reader.connections)
        self.counts: dict[str, int] = {}
        self.types: dict[str, str] = {}
        for connection in sorted(self.connections, key=lambda c: c.topic):
            self.counts[connection.topic] = self.counts.get(connection.topic, 0) + connection.msgcount
            self.types[connection.topic] = connection.msgtype
        self._digests: dict[str, str] = {}
        if ros1:
            self._digests = {name: store.generate_msgdef(name)[1] for name in (SCAN, ODOMETRY)}
        files = [path] if path.is_file() else [file for file in path.iterdir() if file.is_file()]
        self.size = sum(file.stat().st_size for file in files)

    def close(self) -> None:
        """Close the files."""
        self._reader.close()

    @property
    def span(self) -> tuple[int, int]:
        """Times of the first and of the last message, ns."""
        return self._reader.start_time, self._reader.end_time

    def progress(self, recorded: float) -> tuple[int, int]:
        """Bytes read by a time of recording, and bytes in all."""
        begin, end = self.span
        share = (1e9 * recorded - begin) / max(end - begin, 1)
        return int(self.size * min(max(share, 0.0), 1.0)), self.size

    def of_topic(self, topic: str) -> list[Connection]:
        """What was recorded of a topic, by whomever it was published."""
        connections = [connection for connection in self.connections if connection.topic == topic]
        for connection in connections:
            known = self._digests.get(connection.msgtype)
            if known is not None and connection.digest not in (known, "", "*"):
                cause = f"holds another definition of {plain(connection.msgtype)} than the one of ROS"
                raise LogError(self.path, f"{cause}, and cannot be read", topic)
        return connections

    def of_types(self, *types: str) -> list[Connection]:
        """What was recorded of messages of some types; only topics that hold any."""
        return [c for c in self.connections if c.msgtype in types and self.counts[c.topic] > 0]

    def messages(
        self, connections: list[Connection], *, start: int | None = None
    ) -> Iterator[tuple[Connection, float, bytes]]:
        """Stream messages in the order of recording: what they are of, when they were recorded (s), and their bytes."""
        if not connections:
            return
        source, read = self._reader.messages(connections, start=start), 0
        while True:
            try:
                connection, time, raw = next(source)
            except StopIteration:
                return
            except Exception as error:
                where = f"after {read} messages" if read else "before the first message that is needed"
                raise LogError(self.path, f"is damaged {where}: {_told(error)}") from error
            read += 1
            yield connection, 1e-9 * time, raw

    def message(self, connection: Connection, raw: bytes) -> Any:
        """A message taken apart; raises `Fault` where that fails."""
        name = TF[0] if connection.msgtype in TF else connection.msgtype
        try:
            return self._deserialize(raw, name)
        except Exception as error:
            raise Fault(f"the {name.rsplit('/', 1)[1]} message is damaged: {_told(error)}") from error


def plain(type_: str) -> str:
    """A type of messages as people write it."""
    return type_.replace("/msg/", "/")


def _begins(path: Path, magic: bytes) -> bool:
    if not path.is_file():
        return False
    with path.open("rb") as file:
        return file.read(len(magic)) == magic


def _storage(path: Path) -> str:
    files = [path] if path.is_file() else list(path.iterdir())
    return "MCAP" if any(file.name.endswith((".mcap", ".mcap.zstd")) for file in files) else "SQLite"


def _cannot_open(path: Path, error: Exception) -> str:
    """What to tell of a bag that the library does not open."""
    told = _told(error)
    if isinstance(error, OSError):
        return f"cannot be read: {error.strerror or error}"
    if "not indexed" in told:
        return "was not closed when it was recorded, or is cut off: it has no index (`rosbag reindex` makes one)"
    if "index looks damaged" in told:
        return "is cut off or damaged: its index cannot be read (`rosbag reindex` makes a new one)"
    if "end magic" in told:
        return "is cut off, or was not closed when it was recorded: its end is missing (`mcap recover` saves the rest)"
    if "Unrecognized storage format" in told:
        return "is a file of a ROS 2 bag, but its name ends neither in .mcap nor in .db3"
    return f"cannot be read as a ROS bag: {told}"


def _told(error: Exception) -> str:
    """What an exception of the library says, in one line."""
    said = " ".join(str(error).split()).rstrip(".")
    return said[:300] if said else type(error).__name__
