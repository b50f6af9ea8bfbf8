"""A log beside a map: the poses that the map was built at, and whether the returns then lie on it."""

import dataclasses
from collections.abc import Iterable, Iterator, Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Any, TypeVar

from linemap_jax.cli.options import LogInput, UsageError
from linemap_jax.cli.output import say

if TYPE_CHECKING:
    from linemap_jax.core.settings import Mount
    from linemap_jax.core.state import LineMap, Pose, Scan
    from linemap_jax.io.reading import Log

FEW = 0.5
"""Share of the returns under 20 m that lie within 10 cm of a map. Of the drive that made it two thirds and more do; in
another frame, as many as chance has it."""

CommandT = TypeVar("CommandT", bound=LogInput)


def at_poses_of_map(
    command: CommandT, log: Path, map_file: Path, settings: Mapping[str, Any], *, quiet: bool
) -> CommandT:
    """The command, with poses for the log of which `slam` built the map: the trajectory that it wrote beside it.

    Args:
      command: that reads the log; if it says where poses come from, they do.
      log: whatever it may be; it is that of the map if it has its name.
      map_file: the map, or its folder.
      settings: of the map.
      quiet: whether to tell nothing of it.

    Raises:
      UsageError: if that trajectory is not there.
      LogError: if it is none.
    """
    from linemap_jax.io.map_file import map_in
    from linemap_jax.io.tum import read_tum

    of_slam = settings.get("slam")
    if not isinstance(of_slam, Mapping) or settings.get("log") != log.name:
        return command
    if command.poses is not None or command.standstill:
        return command
    trajectory = map_in(map_file).with_name("trajectory.tum")
    if not trajectory.exists():
        raise UsageError(
            f"{map_file} was built by `linemap slam`, so not at the poses of {log}: give its trajectory by --poses "
            "(of `compare`: --poses-a, --poses-b)"
        )
    say(f"{map_file} was built by `linemap slam`: the poses are those of {trajectory}", quiet=quiet)
    offset = command.laser_offset
    if offset is None and read_tum(trajectory).pose_frame == "robot":
        stated = of_slam.get("laser_offset")
        if isinstance(stated, list) and len(stated) == 3 and all(isinstance(x, int | float) for x in stated):
            offset = (stated[0], stated[1], stated[2])
    return dataclasses.replace(command, poses=trajectory, laser_offset=offset)


class Fit:
    """How many of the returns of a log lie on a map: of a scan a chunk, which costs little on the way through."""

    def __init__(self, line_map: "LineMap", mount: "Mount") -> None:
        """Nothing is known yet; the mount is that of the scanner on the robot."""
        self.mount = mount
        self._line_map = line_map
        self._hits = self._total = 0

    def through(self, chunks: "Iterable[tuple[Scan, Pose]]") -> "Iterator[tuple[Scan, Pose]]":
        """Pass stacked scans and poses on, and look at the first of each chunk."""
        for scans, poses in chunks:
            self.look_at(scans, poses)
            yield scans, poses

    def look_at(self, scans: "Scan", poses: "Pose") -> None:
        """Count the returns of the first of some scans."""
        import jax

        from linemap_jax.lab.evaluation import explained

        hits, total = explained(self._line_map, *jax.tree.map(lambda x: x[:1], (scans, poses)), self.mount)
        self._hits, self._total = self._hits + int(hits), self._total + int(total)

    def warn(self, log: "Log", map_file: Path, *, quiet: bool) -> None:
        """Say so, if they are few."""
        if self._total:
            warn_of_fit(self._hits / self._total, log.path, map_file, quiet=quiet)


def warn_of_fit(share: float, log: Path, map_file: Path, *, quiet: bool) -> None:
    """Say so, if few of the returns of a log lie on a map."""
    if share < FEW:
        say(
            f"warning: only {share:.0%} of the returns of {log} lie within 10 cm of {map_file}: are its poses in the "
            "frame of the map (--poses gives others), and is it of this place?",
            quiet=quiet,
        )
