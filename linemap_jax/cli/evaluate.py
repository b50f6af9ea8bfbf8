"""`linemap evaluate`: what a map is worth, against a true world and against a log."""

import dataclasses
import json
import math
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import tyro

from linemap_jax.cli.compilations import keep_compilations
from linemap_jax.cli.fit import at_poses_of_map, warn_of_fit
from linemap_jax.cli.logs import SCANS_EXPLAINED, mount_of, opened, plain_chunks, progress, warn
from linemap_jax.cli.options import LogInput, UsageError, check_input, own_options_first
from linemap_jax.cli.worlds import world_from_file

if TYPE_CHECKING:
    from linemap_jax.core.state import LineMap


@own_options_first
@dataclasses.dataclass(frozen=True, kw_only=True)
class Evaluate(LogInput):
    """Score a map: against a true world, or against a log, or both."""

    map: tyro.conf.Positional[Path]
    """map.json of `build`."""
    world: Annotated[Path | None, tyro.conf.arg(metavar="FILE.geojson")] = None
    """The truth. With a log, only what its beams met can be missed; without, all of it."""
    log: Annotated[Path | None, tyro.conf.arg(metavar="LOG")] = None
    """CARMEN log or ROS bag, as for `build`: how much of it the map explains."""
    at: Annotated[int | None, tyro.conf.arg(metavar="N")] = None
    """The truth is what is there at scan N. The last one of the log, or else after all changes, unless given."""
    distance: Annotated[float, tyro.conf.arg(metavar="M")] = 0.05
    """How far a line may lie from a wall, and the centre of a circle outside of a pole, m."""
    quiet: bool = False
    """No progress, no warnings."""
    json: bool = False
    """Print the scores as JSON."""

    def run(self) -> int:
        """Score the map, and give the exit status."""
        if self.world is None and self.log is None:
            raise UsageError("evaluate needs --world, --log, or both")
        if not 0 < self.distance < float("inf"):
            raise UsageError(f"--distance must be positive, not {self.distance}")
        if self.at is not None and not 0 <= self.at < 2**31 - 1:
            raise UsageError(f"--at must be from 0 to 2^31 - 2, not {self.at}")
        check_input(self)
        import jax

        jax.config.update("jax_enable_x64", True)
        keep_compilations()
        from linemap_jax.io.map_file import read_map

        line_map, settings = read_map(self.map, dtype="float64")
        command = self if self.log is None else at_poses_of_map(self, self.log, self.map, settings, quiet=self.quiet)
        scores: dict[str, Any] = {"map": str(self.map)}
        if self.world is not None:
            scores["truth"] = _against_world(command, self.world, line_map)
        if self.log is not None:
            scores["log"] = _against_log(command, self.log, line_map)
        print(json.dumps(scores, indent=2, allow_nan=False) if self.json else _scores_in_words(scores))
        return 0


def _against_world(command: Evaluate, path: Path, line_map: "LineMap") -> dict[str, Any]:
    """The score of a map against the truth, in numbers; None where there is nothing to tell of."""
    import numpy as np

    from linemap_jax.build import CHUNK
    from linemap_jax.lab.check import WorldError, check
    from linemap_jax.lab.evaluation import seen_in_log
    from linemap_jax.lab.scoring import GONE, Gates, evaluate, times_of_objects
    from linemap_jax.lab.world import NEVER

    world = world_from_file(path)
    try:
        check(world, world.path[:0])  # where the robot was is no matter
    except WorldError as error:
        raise UsageError(f"{path}: {error}") from error
    seen, at = None, NEVER - 1
    if command.log is not None:
        log = opened(command, command.log)
        mount = mount_of(command, log, quiet=command.quiet)
        with progress(log, quiet=command.quiet):
            seen, scans = seen_in_log(world, plain_chunks(log), mount, chunk=CHUNK)
        at = scans - 1
    at = at if command.at is None else command.at
    score = evaluate(line_map, world, seen, scan_index=at, gates=Gates(distance=command.distance))
    _, vanishes, exists = (np.asarray(x) for x in times_of_objects(world))
    gone = exists & (vanishes <= at)
    offset, angle = (_or_none(x) for x in np.asarray(score.error))
    return {
        "world": str(path),
        "at": None if at == NEVER - 1 else at,
        "distance_m": command.distance,
        "precision": _or_none(score.precision),
        "recall": _or_none(score.recall),
        "line_length_m": float(score.line_length),
        "seen_length_m": float(score.wall_seen.sum()),
        "lines": int(line_map.lines.valid.sum()),
        "phantom_lines": int(score.phantom_line.sum()),
        "walls": int((score.wall_seen > 0).sum()),
        "walls_held_twice": int(score.duplicates),
        "fragments": int(score.fragments),
        "offset_rms_m": offset,
        "angle_rms_rad": angle,
        "mean_nees": _or_none(score.nees),
        "circles": int(line_map.circles.valid.sum()),
        "phantom_circles": int(score.phantom_circle.sum()),
        "poles": int(((score.circles_of_pole > 0) | score.missed_pole).sum()),
        "missed_poles": int(score.missed_pole.sum()),
        "poles_held_twice": int((score.circles_of_pole > 1).sum()),
        "gone": int(gone.sum()),
        "gone_but_held": int((gone & (np.asarray(score.object_held) >= GONE)).sum()),
    }


def _against_log(command: Evaluate, path: Path, line_map: "LineMap") -> dict[str, Any]:
    """What a log says of a map, in numbers; None where there is nothing to tell of."""
    from linemap_jax.build import CHUNK
    from linemap_jax.lab.evaluation import evaluate_log

    log = opened(command, path)
    mount = mount_of(command, log, quiet=command.quiet)
    scans = sum(1 for _ in log)
    warn(log, quiet=command.quiet)
    with progress(log, quiet=command.quiet):
        score = evaluate_log(line_map, plain_chunks(log, every=-(-scans // SCANS_EXPLAINED)), mount, chunk=CHUNK)
    warn_of_fit(score.explained, path, command.map, quiet=command.quiet)
    return {
        "log": str(path),
        "scans": scans,
        "returns": score.returns,
        "explained": _or_none(score.explained),
        "met": _or_none(score.met),
        "residual_median_m": _or_none(score.residual_median),
        "residual_90_m": _or_none(score.residual_90),
    }


def _or_none(number: Any) -> float | None:
    return float(number) if math.isfinite(number) else None


def _scores_in_words(scores: dict[str, Any]) -> str:
    def told(value: float | None, form: str, scale: float = 1.0) -> str:
        return "-" if value is None else format(scale * value, form)

    said = []
    if (score := scores.get("truth")) is not None:
        near = f"{100 * score['distance_m']:g} cm"
        offset, angle = told(score["offset_rms_m"], ".1f", 100), told(score["angle_rms_rad"], ".2f", 180 / math.pi)
        said += [
            f"precision {told(score['precision'], '.1%')} of {score['line_length_m']:.1f} m of lines, within {near}; "
            f"{score['phantom_lines']} of {score['lines']} lines are phantoms",
            f"recall {told(score['recall'], '.1%')} of {score['seen_length_m']:.1f} m of walls that could be seen; "
            f"{score['walls_held_twice']} of {score['walls']} walls are held twice, "
            f"{score['fragments']} pieces are too many",
            f"error {offset} cm, {angle} degrees (rms); mean NEES {told(score['mean_nees'], '.2f')} "
            "(2 if the covariances are right)",
            f"{score['missed_poles']} of {score['poles']} poles are missed, {score['poles_held_twice']} held twice; "
            f"{score['phantom_circles']} of {score['circles']} circles are phantoms",
            f"{score['gone_but_held']} of {score['gone']} things that are gone are still held",
        ]
    if (score := scores.get("log")) is not None:
        median, most = (told(score[f"residual_{name}_m"], ".1f", 100) for name in ("median", "90"))
        said += [
            f"{told(score['explained'], '.1%')} of the returns under 20 m lie within 10 cm of the map; "
            f"along the beam they are off by {median} cm (median), {most} cm (90 %)"
        ]
    return "\n".join(said)
