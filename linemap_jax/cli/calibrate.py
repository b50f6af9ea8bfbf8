"""`linemap calibrate`: the noise of the scanner and of the poses, from a log."""

import dataclasses
import json
from collections.abc import Mapping
from pathlib import Path
from typing import Annotated, Any

import tyro

from linemap_jax.cli.compilations import keep_compilations
from linemap_jax.cli.logs import mount_of, opened, warn
from linemap_jax.cli.options import MOST_SCANS, LogInput, UsageError, check_input, own_options_first
from linemap_jax.cli.output import check_output, make_folder, say

WIDEST = 100.0
"""An interval that ends at so many times its begin tells nothing."""


@own_options_first
@dataclasses.dataclass(frozen=True, kw_only=True)
class Calibrate(LogInput):
    """Tell the noise of the scanner and of the poses from a log."""

    log: tyro.conf.Positional[Path]
    """CARMEN log, plain or .gz; ROS 1 .bag; ROS 2 bag: its folder, .mcap or .db3."""
    output: Annotated[Path | None, tyro.conf.arg(aliases=["-o"], metavar="FILE.toml")] = None
    """Settings file for --config of the other commands, with the noise of the scanner."""
    scans: Annotated[int, tyro.conf.arg(metavar="N")] = 1000
    """Number of scans that are used at most, from the first on."""
    lag: Annotated[int, tyro.conf.arg(metavar="N")] = 1
    """Poses are compared with those N scans later: errors that last longer are not seen."""
    overwrite: bool = False
    """Replace output that is there already."""
    quiet: bool = False
    """No progress, no warnings."""
    json: bool = False
    """Print the result as JSON."""

    def run(self) -> int:
        """Tell the noise, and give the exit status."""
        if not 2 <= self.scans <= MOST_SCANS:
            raise UsageError(f"--scans must be from 2 to {MOST_SCANS}, not {self.scans}")
        if not 1 <= self.lag < self.scans:
            raise UsageError(f"--lag must be from 1 to less than the number of scans, not {self.lag}")
        check_input(self)
        if self.output:
            check_output(self.output.parent, self.output, overwrite=self.overwrite)
        import jax

        jax.config.update("jax_enable_x64", True)
        keep_compilations()
        import numpy as np

        from linemap_jax.core.settings import SensorNoise
        from linemap_jax.io.atomic import atomic_write
        from linemap_jax.io.scans import chunks_of_readings
        from linemap_jax.lab.calibration import pose_noise, sensor_noise

        log = opened(self, self.log)
        mount = mount_of(self, log, quiet=self.quiet)
        chunk = next(chunks_of_readings(log, self.scans, cov_pose=np.zeros((3, 3)), dtype="float64"))
        warn(log, quiet=self.quiet)
        say(f"{len(chunk.timestamps)} scans read; estimating, which takes a minute", quiet=self.quiet)
        try:
            sensor = sensor_noise(chunk.scans)
            noise = SensorNoise(range_sigma=float(sensor.sigma[0]), bearing_sigma=float(sensor.sigma[1]))
            poses = pose_noise(chunk.scans, chunk.poses.mean, noise, mount, lag=self.lag)
        except ValueError as error:
            raise UsageError(f"{self.log}: {error}") from error
        rows = {
            name: {"sigma": sigma, "from": low, "to": high}
            for estimate, names in (
                (sensor, ("range_m", "bearing_rad")),
                (poses, ("x_m", "y_m", "theta_rad", "walls_m", "walls_rad")),
            )
            for name, sigma, (low, high) in zip(names, estimate.sigma.tolist(), estimate.interval.tolist(), strict=True)
        }
        if self.output:
            text = f"[noise]\nrange_sigma = {noise.range_sigma:.4g}\nbearing_sigma = {noise.bearing_sigma:.4g}\n"
            make_folder(self.output.parent)
            with atomic_write(self.output, overwrite=self.overwrite) as path:
                path.write_text(text, encoding="utf-8")
        summary = rows | {"beams": sensor.used, "lines": poses.used, "scans": len(chunk.timestamps)}
        print(json.dumps(summary, indent=2) if self.json else _in_words(rows, summary))
        return 0


def _in_words(rows: Mapping[str, Mapping[str, float]], summary: Mapping[str, Any]) -> str:
    said = [
        f"from {summary['beams']} beams and {summary['lines']} pairs of lines in {summary['scans']} scans, "
        "95 % intervals:"
    ]
    told = [name for name, row in rows.items() if row["to"] < WIDEST * row["from"]]
    sigmas = {name: f"{row['sigma']:.3g}" for name, row in rows.items()}
    for name, row in rows.items():
        what, unit = name.split("_")
        interval = f"{row['from']:.3g} to {row['to']:.3g}" if name in told else "not told by this log"
        said.append(f"  {what:8s} {sigmas[name]} {unit} ({interval})")
    options = f"--range-sigma {sigmas['range_m']} --bearing-sigma {sigmas['bearing_rad']}"
    of_pose = "x_m", "y_m", "theta_rad"
    if all(name in told for name in of_pose):
        options += f" --pose-sigma {' '.join(sigmas[name] for name in of_pose)}"
    return "\n".join([*said, options])
