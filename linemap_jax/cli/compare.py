"""`linemap compare`: what has moved, vanished or appeared from one map to another."""

import dataclasses
import json
import math
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Literal

import tyro

from linemap_jax.cli.fit import Fit, at_poses_of_map
from linemap_jax.cli.logs import mount_of, opened, plain_chunks, progress, warn
from linemap_jax.cli.merge import AT_LEAST, in_one_frame, read_two_maps, warn_of_frames
from linemap_jax.cli.options import LogInput, UsageError, check_input, own_options_first

if TYPE_CHECKING:
    from linemap_jax.lab.comparison import Agreement, Change, Comparison, What

ASK: "dict[What, str]" = {
    "vanished": "--log-b tells what is gone from what the second drive did not look at",
    "appeared": "--log-a tells what is new from what the first drive did not look at",
}
"""What to do about changes that no log bears out."""
WENT_THROUGH = {"line": 1, "circle": 9}
"""So many times as many beams as ended there: past the corner of a wall, beams go through a circle that is there."""
MOST_TOLD = 15
"""Changes of a kind that are told in words, but none of maps that will not be in one frame; --json tells all."""


@own_options_first
@dataclasses.dataclass(frozen=True, kw_only=True)
class Compare(LogInput):
    """Compare two maps that are in one frame: what has moved, vanished or appeared, and how sure that is."""

    a: tyro.conf.Positional[Path]
    """The map before: map.json of `build`, or its GeoJSON."""
    b: tyro.conf.Positional[Path]
    """The map after, of another drive."""
    log_a: Annotated[Path | None, tyro.conf.arg(metavar="LOG")] = None
    """Log of the map before: whether its beams went through where something has appeared, and whether they met what has
    vanished."""
    log_b: Annotated[Path | None, tyro.conf.arg(metavar="LOG")] = None
    """Log of the map after: whether its beams went through where something has vanished, or did not look there, and
    whether they met what has appeared."""
    poses_a: Annotated[Path | None, tyro.conf.arg(metavar="FILE.tum")] = None
    """Poses for the log of the map before, in place of those that it states; of the robot, or, if a comment in the file
    says so, of the laser."""
    poses_b: Annotated[Path | None, tyro.conf.arg(metavar="FILE.tum")] = None
    """The same for the log of the map after."""
    poses: tyro.conf.Suppress[Path | None] = None
    within: Annotated[float, tyro.conf.arg(metavar="M")] = 0.5
    """How far a thing may have moved, m; farther away it is another one."""
    alpha: Annotated[float, tyro.conf.arg(metavar="P")] = 0.01
    """Probability of telling of any movement where there is none, given which thing is held against which."""
    shortest: Annotated[float, tyro.conf.arg(metavar="M")] = 0.5
    """Shortest piece of a line that is told to have vanished or appeared, m."""
    at_least: Annotated[int, tyro.conf.arg(metavar="N")] = AT_LEAST
    """Of lines and circles that were detected more seldom no change is told."""
    quiet: bool = False
    """No progress, no warnings."""
    json: bool = False
    """Print the changes as JSON."""

    def run(self) -> int:
        """Compare them, and give the exit status."""
        for name in ("within", "shortest"):
            if not 0 < getattr(self, name) < math.inf:
                raise UsageError(f"--{name} must be positive, not {getattr(self, name)}")
        if not 0 < self.alpha < 1:
            raise UsageError(f"--alpha must be between 0 and 1, not {self.alpha}")
        if self.at_least < 1:
            raise UsageError(f"--at-least must be 1 or more, not {self.at_least}")
        for which, log, poses in (("a", self.log_a, self.poses_a), ("b", self.log_b, self.poses_b)):
            if poses is not None and log is None:
                raise UsageError(f"--poses-{which} is for --log-{which}, which is not given")
        check_input(self)
        a, b, settings = read_two_maps(self.a, self.b)
        from linemap_jax.build import CHUNK
        from linemap_jax.lab.comparison import agreement, compare_maps, looked_through

        options = {"within": self.within, "alpha": self.alpha, "shortest": self.shortest, "at_least": self.at_least}
        alike = agreement(a, b)
        warn_of_frames(self.a, self.b, alike, quiet=self.quiet)
        found = compare_maps(a, b, **options)
        logs: list[tuple[Literal["before", "after"], Path | None, Path | None]] = [
            ("before", self.log_a, self.poses_a),
            ("after", self.log_b, self.poses_b),
        ]
        maps = zip((self.a, self.b), (a, b), settings, strict=True)
        for (drive, path, poses), (map_file, line_map, of_map) in zip(logs, maps, strict=True):
            if path is not None:
                command = dataclasses.replace(self, poses=poses)
                command = at_poses_of_map(command, path, map_file, of_map, quiet=self.quiet)
                log = opened(command, path)
                mount = mount_of(command, log, quiet=self.quiet)
                fit = Fit(line_map, mount)
                with progress(log, quiet=self.quiet):
                    changes = looked_through(found.changes, fit.through(plain_chunks(log)), drive, mount, chunk=CHUNK)
                found = found._replace(changes=changes)
                warn(log, quiet=self.quiet)
                fit.warn(log, map_file, quiet=self.quiet)
        most = MOST_TOLD if in_one_frame(alike) else 0
        print(json.dumps(_summary(self, found, alike), indent=2) if self.json else _in_words(found, most))
        return 0


def _summary(command: Compare, found: "Comparison", alike: "Agreement") -> dict[str, Any]:
    said: dict[str, Any] = {
        "a": str(command.a),
        "b": str(command.b),
        "alpha": command.alpha,
        "pairs": found.pairs,
        "overlap_m": alike.overlap,
        "agreeing_m": alike.agreeing,
        "same_lines": found.same_lines,
        "same_circles": found.same_circles,
    }
    for what in ("moved", "vanished", "appeared"):
        said[what] = [_entry(change) for change in found.changes if change.what == what]
    return said


def _entry(change: "Change") -> dict[str, Any]:
    """What there is to say of a change, units in the names."""
    named = {"sigma": "sigma_m", "turn": "turn_rad", "shift": "shift_m", "p": "p_holm", "radius": "radius_m"}
    fields = {name: value for name, value in dataclasses.asdict(change).items() if name != "what" and value is not None}
    return {named.get(name, name): value for name, value in fields.items()}


def _in_words(found: "Comparison", most: int = MOST_TOLD) -> str:
    said = [f"{found.same_lines} lines and {found.same_circles} circles are where they were"]
    for what in ("moved", "vanished", "appeared"):
        changes = [change for change in found.changes if change.what == what]
        sure = [change for change in changes if _borne_out(change)]
        lines = sum(change.kind == "line" for change in sure)
        said.append(f"{what}: {lines} lines or pieces of lines, {len(sure) - lines} circles")
        said += [f"  {_told(change)}" for change in sure[:most]]
        if 0 < most < len(sure):
            said.append(f"  ... and {len(sure) - most} more")
        if most and what in ASK and any(change.passed is None for change in changes):
            said.append(f"  {ASK[what]}")
        if len(changes) > len(sure):
            why = "but the other drive did not see through, or its own did"
            said.append(f"  {len(changes) - len(sure)} more are in one map only, {why}; --json tells where")
    return "\n".join(said)


def _borne_out(change: "Change") -> bool:
    """Where the logs were asked, the beams of the other drive went through it, and most of its own did not."""
    through = change.passed is None or change.met is None or change.passed > WENT_THROUGH[change.kind] * change.met
    seen = change.passed_own is None or change.met_own is None or change.met_own >= change.passed_own
    return through and seen


def _told(change: "Change") -> str:
    (x, y), (u, v) = change.begin, change.end
    if change.kind == "line":
        what = f"line of {math.dist(change.begin, change.end):.2f} m from ({x:.2f}, {y:.2f}) to ({u:.2f}, {v:.2f})"
    else:
        what = f"circle of {change.radius:.2f} m at ({x:.2f}, {y:.2f})"
    if change.shift is not None and change.sigma is not None:
        turn = "" if change.turn is None else f", turned {math.degrees(change.turn):.1f} degrees"
        sure = f"p = {change.p:.1g}" if change.p else "p < 1e-300"
        return f"{what}: by {math.hypot(*change.shift):.3f} ± {change.sigma:.3f} m{turn} ({sure})"
    what += f", detected {change.times_detected} times"
    if change.passed is None or change.met is None:
        return what
    return f"{what}; {change.passed} of {change.passed + change.met} beams of the other drive went through"
