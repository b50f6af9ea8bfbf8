"""`linemap export`: a map in the formats of other programs."""

import dataclasses
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Literal

import tyro

from linemap_jax.cli.compilations import keep_compilations
from linemap_jax.cli.fit import Fit, at_poses_of_map
from linemap_jax.cli.logs import mount_of, opened, progress, warn
from linemap_jax.cli.options import LogInput, UsageError, check_input, own_options_first
from linemap_jax.cli.output import check_output, make_folder, say

if TYPE_CHECKING:
    from linemap_jax.io.reading import Log

FormatName = Literal["json", "geojson", "svg", "dxf", "nav2", "mcap", "tum", "png", "html"]
"""What `--to` offers: the names of `linemap_jax.io.exports.FORMATS`, which is not loaded to print a help text."""


@own_options_first
@dataclasses.dataclass(frozen=True, kw_only=True)
class Export(LogInput):
    """Write a map in another format: for GIS, CAD, ROS 2, nav2, a browser."""

    map: tyro.conf.Positional[Path]
    """map.json of `build`, or its GeoJSON."""
    output: Annotated[Path, tyro.conf.arg(aliases=["-o"], metavar="FILE")]
    """File to write. `nav2` writes the picture, .pgm, beside its .yaml."""
    to: Annotated[FormatName | None, tyro.conf.arg(metavar="FORMAT")] = None
    """json, geojson, svg, dxf, nav2 (.yaml), mcap, tum, png or html. That of the file's ending unless given."""
    log: Annotated[Path | None, tyro.conf.arg(metavar="LOG")] = None
    """CARMEN log or ROS bag, in the frame of the map: `nav2` makes its grid of the scans, `tum` writes the poses,
    pictures show the path."""
    at_least: Annotated[int, tyro.conf.arg(metavar="N")] = 1
    """Leave out lines and circles that fewer than N scans have detected: what was seen once or twice may be none."""
    resolution: Annotated[float, tyro.conf.arg(metavar="M")] = 0.05
    """Side of a cell of `nav2`, m."""
    overwrite: bool = False
    """Replace output that is there already."""
    quiet: bool = False
    """No progress, no warnings."""

    def run(self) -> int:
        """Write it, and give the exit status."""
        from linemap_jax.io.exports import FORMATS, LOG_NEEDED, Content, files_of, format_of

        name = self.to or format_of(self.output)
        if name is None:
            endings = ", ".join(format.ending for format in FORMATS.values())
            raise UsageError(f"{self.output}: its ending tells no format; give --to, or one of {endings}")
        if self.log is None and name in LOG_NEEDED:
            raise UsageError(f"{name} is made from the scans of a log; give --log")
        if not 0 < self.resolution < float("inf"):
            raise UsageError(f"--resolution must be positive, not {self.resolution}")
        if self.at_least < 1:
            raise UsageError(f"--at-least must be 1 or more, not {self.at_least}")
        check_input(self)
        check_output(self.output.parent, *files_of(name, self.output), overwrite=self.overwrite)
        import jax

        jax.config.update("jax_enable_x64", True)
        keep_compilations()
        from linemap_jax.core.slots import detected_often
        from linemap_jax.io.map_file import read_map

        line_map, settings = read_map(self.map)
        if self.at_least > 1:
            line_map, settings = detected_often(line_map, self.at_least), {**settings, "at_least": self.at_least}
        added: dict[str, Any] = {}
        if self.log is not None and name not in ("json", "geojson"):
            command = at_poses_of_map(self, self.log, self.map, settings, quiet=self.quiet)
            log = opened(command, self.log)
            fit = Fit(line_map, mount_of(command, log, quiet=self.quiet))
            with progress(log, quiet=self.quiet):
                added = _read(command, log, name, fit)
            warn(log, quiet=self.quiet)
            fit.warn(log, self.map, quiet=self.quiet)
        title = str(settings.get("log", self.map.name))
        content = Content(line_map=line_map, settings=settings, title=title, **added)
        make_folder(self.output.parent)
        FORMATS[name].write(self.output, content, self.overwrite)
        say(f"{self.map} -> {self.output} ({name})", quiet=self.quiet)
        return 0


def _read(command: Export, log: "Log", name: str, fit: Fit) -> dict[str, Any]:
    """What a format wants of a log, by the fields of `Content`."""
    import numpy as np

    from linemap_jax.build import CHUNK
    from linemap_jax.cli.logs import plain_chunks
    from linemap_jax.io.html import MOST_POINTS
    from linemap_jax.io.scans import chunks_of_readings
    from linemap_jax.io.thinned import Thinned
    from linemap_jax.lab.occupancy import occupancy, returns_in_world

    pose_frame = next(iter(log)).pose_frame
    if name == "nav2":
        try:
            return {"grid": occupancy(lambda: fit.through(plain_chunks(log)), fit.mount, resolution=command.resolution)}
        except ValueError as error:
            raise UsageError(f"{log.path}: {error}") from error
    timestamps, poses, points = [], [], Thinned(2 * MOST_POINTS)
    for chunk in chunks_of_readings(log, CHUNK, cov_pose=np.zeros((3, 3)), dtype="float64"):
        fit.look_at(chunk.scans, chunk.poses)
        timestamps.append(chunk.timestamps)
        poses.append(np.asarray(chunk.poses.mean))
        if name == "html":
            _, places, valid = returns_in_world(chunk.scans, chunk.poses, fit.mount)
            points.extend(places[valid])
    found: dict[str, Any] = {"timestamps": np.concatenate(timestamps), "poses": np.concatenate(poses)}
    found["pose_frame"] = pose_frame
    return found | ({"points": np.array(points.kept).reshape(-1, 2)} if name == "html" else {})
