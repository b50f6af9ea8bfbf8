"""A map to go on from: with slots to grow into, and how its settings differ from those of now."""

from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal, NamedTuple

if TYPE_CHECKING:
    from linemap_jax.core.settings import PoseError
    from linemap_jax.core.state import LineMap

START_CAPACITY = (1024, 512)
"""Slots for lines and circles to begin with. To grow costs a compilation, and most buildings fit into these."""

COMPARED = ("preset", "pose_error", "covariance", "pose_sigma", "thresholds", "noise", "rules", "persistence", "mount")
COMPARED += ("segmentation", "max_vertices")
"""What of the settings decides what a map is."""
MOST_TOLD = 4
"""Differences that are told one by one."""


class Before(NamedTuple):
    """A map that has been read."""

    line_map: "LineMap"
    settings: dict[str, Any]


def map_to_resume(path: Path, dtype: Literal["float32", "float64"], pose_error: "PoseError") -> Before:
    """The map of a file, in the precision of now.

    What persists is the same error in map and log only if both are of one drive by "persistent". Any other map is taken
    by that model as one that shares no error with the log.

    Raises:
      MapFileError: as `read_map`.
    """
    from linemap_jax.core.fusion import forget
    from linemap_jax.core.slots import resize
    from linemap_jax.core.state import LineMap
    from linemap_jax.io.map_file import read_map

    line_map, settings = read_map(path, dtype=dtype)
    lines, circles = line_map.lines, line_map.circles
    if pose_error == "persistent" != settings.get("pose_error"):
        lines, circles = forget(lines, 0.0), forget(circles, 0.0)
    line_map = LineMap(
        lines=resize(lines, max(START_CAPACITY[0], lines.valid.shape[0])),
        circles=resize(circles, max(START_CAPACITY[1], circles.valid.shape[0])),
    )
    return Before(line_map, settings)


def differences(before: Mapping[str, Any], now: Mapping[str, Any]) -> str:
    """What settings differ, in words: `preset paper (now default), ...`; empty if none does.

    The map goes on with those of now: another drive may well have another noise. A setting that one of the two does not
    have tells nothing; nor does the mount of a map of `slam`, whose poses are the laser's.
    """
    from linemap_jax.io.map_file import plain_settings

    compared = [name for name in COMPARED if name != "mount" or "slam" not in before]
    old, new = (dict(_flat(plain_settings({k: x[k] for k in compared if k in x}))) for x in (before, now))
    told = [f"{name} {old[name]} (now {new[name]})" for name in new if name in old and not _alike(old[name], new[name])]
    more = len(told) - MOST_TOLD
    return ", ".join(told[:MOST_TOLD]) + (f" and {more} more" if more > 0 else "")


def _flat(settings: Mapping[str, Any]) -> Iterator[tuple[str, Any]]:
    for name, value in settings.items():
        if isinstance(value, Mapping):
            yield from ((f"{name}.{key}", item) for key, item in _flat(value))
        else:
            yield name, value


def _alike(a: Any, b: Any) -> bool:
    """Equal, or equal numbers: 1 is 1.0, but not True."""
    return a == b and isinstance(a, bool) == isinstance(b, bool)
