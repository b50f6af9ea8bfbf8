"""`linemap merge`: two maps made one."""

import dataclasses
import json
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Literal

import tyro

from linemap_jax.cli.compilations import keep_compilations
from linemap_jax.cli.output import check_output, make_folder, say

if TYPE_CHECKING:
    from linemap_jax.core.state import LineMap
    from linemap_jax.lab.comparison import Agreement

AT_LEAST = 3
"""Scans that have detected what is told to have moved."""

LEAST_AGREEING = 0.2
"""Of the length of lines where two maps overlap, the share that lies along one of the other: of two drives of one place
more than half, in different frames a twentieth."""


@dataclasses.dataclass(frozen=True, kw_only=True)
class Merge:
    """Make one map of two that are in one frame: what is the same line or circle in both is fused."""

    a: tyro.conf.Positional[Path]
    """map.json of `build`, or its GeoJSON."""
    b: tyro.conf.Positional[Path]
    """The other one, of other scans."""
    output: Annotated[Path, tyro.conf.arg(aliases=["-o"], metavar="DIR")]
    """Folder for the map; made if it is not there."""
    pose_error: Literal["independent", "unknown"] = "unknown"
    """How the errors of the two maps hang together. With `unknown` covariances are bounds that hold in any case."""
    later: bool = False
    """The second map is of a later drive: it is believed where the two contradict each other. What has vanished stays,
    since a map does not tell what its drive has seen through."""
    overwrite: bool = False
    """Replace output that is there already."""
    quiet: bool = False
    """No warnings."""
    json: bool = False
    """Print the summary as JSON."""

    def run(self) -> int:
        """Merge them, and give the exit status."""
        map_file, picture = self.output / "map.json", self.output / "map.png"
        check_output(self.output, map_file, picture, overwrite=self.overwrite)
        a, b, settings = read_two_maps(self.a, self.b)
        from linemap_jax.core.merging import merge_maps
        from linemap_jax.io.map_file import write_map
        from linemap_jax.io.plot import plot_map
        from linemap_jax.lab.comparison import agreement, compare_maps, without_moved

        changes = compare_maps(a, b, at_least=AT_LEAST).changes
        merged, report = merge_maps(without_moved(a, b, changes) if self.later else a, b, pose_error=self.pose_error)
        joined = {name: int(getattr(report, name)) for name in ("lines_joined", "circles_joined", "circles_left_out")}
        alike = agreement(a, b)
        warn_of_frames(self.a, self.b, alike, quiet=self.quiet)
        moved = [change.kind for change in changes if change.what == "moved"]
        if moved and not self.later and in_one_frame(alike):
            say(
                f"warning: {moved.count('line')} lines and {moved.count('circle')} circles have moved from {self.a} to "
                f"{self.b}, and the map mixes both places (--later takes them from the second one; `linemap compare` "
                "tells which)",
                quiet=self.quiet,
            )
        make_folder(self.output)
        names = [str(each.get("log", path.name)) for each, path in zip(settings, (self.a, self.b), strict=True)]
        title = " + ".join(names)
        told = {"log": title, "pose_error": self.pose_error, "merged": settings}
        write_map(map_file, merged, told, overwrite=self.overwrite)
        plot_map(picture, merged, title=title, overwrite=self.overwrite)
        summary = {
            "a": {"map": str(self.a), **_counts(a)},
            "b": {"map": str(self.b), **_counts(b)},
            **_counts(merged),
            **joined,
            "lines_moved": moved.count("line"),
            "circles_moved": moved.count("circle"),
            "map": str(map_file),
            "picture": str(picture),
        }
        print(json.dumps(summary, indent=2) if self.json else _in_words(summary))
        return 0


def read_two_maps(a: Path, b: Path) -> tuple["LineMap", "LineMap", list[dict[str, Any]]]:
    """Two maps, and the settings of both; in float64 if one of them is."""
    import jax

    jax.config.update("jax_enable_x64", True)
    keep_compilations()
    from linemap_jax.io.map_file import read_map

    one, other = read_map(a), read_map(b)
    if one[0].lines.offset.dtype != other[0].lines.offset.dtype:
        one, other = read_map(a, dtype="float64"), read_map(b, dtype="float64")
    return one[0], other[0], [one[1], other[1]]


def in_one_frame(found: "Agreement") -> bool:
    """Whether two maps agree enough where they overlap, so that they will be in one frame."""
    return found.agreeing > LEAST_AGREEING * found.overlap


def warn_of_frames(a: Path, b: Path, found: "Agreement", *, quiet: bool) -> None:
    """Say so, if two maps will not be."""
    if not in_one_frame(found):
        say(
            f"warning: of {found.overlap:.1f} m of lines where {a} and {b} overlap only {found.agreeing:.1f} m agree: "
            "are both in one frame (`linemap localize` finds a drive in the map of another)?",
            quiet=quiet,
        )


def _counts(line_map: "LineMap") -> dict[str, int]:
    return {"lines": int(line_map.lines.valid.sum()), "circles": int(line_map.circles.valid.sum())}


def _in_words(summary: dict[str, Any]) -> str:
    a, b = summary["a"], summary["b"]
    return (
        f"{a['lines']} and {b['lines']} lines -> {summary['lines']}; "
        f"{a['circles']} and {b['circles']} circles -> {summary['circles']}\n"
        f"{summary['lines_joined']} lines and {summary['circles_joined']} circles were fused into others, "
        f"{summary['circles_left_out']} circles that contradict the other map left out\n"
        f"map:     {summary['map']}\n"
        f"picture: {summary['picture']}"
    )
