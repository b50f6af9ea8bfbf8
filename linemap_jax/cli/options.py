"""Options that several commands share: what is refused of them, and what they are to `update`."""

import dataclasses
import math
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Literal, TypeVar

import tyro

from linemap_jax.cli.compilations import keep_compilations

if TYPE_CHECKING:
    from linemap_jax.core.settings import Persistence, SensorNoise

MOST_VERTICES = 1000
"""Of a budget: no scanner has more to say, and memory grows with it."""
MOST_SCANS = 20_000
"""Of a simulated drive, which is held in memory as a whole."""


ScannerName = Literal["pls", "lms200", "utm30lx", "rplidar_a1"]
"""Instruments of `lab.scanners`."""


class UsageError(Exception):
    """What is wrong with the command, in one sentence."""


POSE_SIGMA = (0.05, 0.05, 0.01)
"""Of poses for which nothing is stated, m m rad."""


CommandT = TypeVar("CommandT")


def own_options_first(command: type[CommandT]) -> type[CommandT]:
    """The command, a dataclass, with its options in the order of its help: its own before those that it inherits."""
    fields = command.__dataclass_fields__  # pyright: ignore[reportAttributeAccessIssue]
    order = [name for kind in command.__mro__ for name in vars(kind).get("__annotations__", {}) if name in fields]
    moved = {name: fields[name] for name in order}
    fields.clear()
    fields.update(moved)
    return command


@dataclasses.dataclass(frozen=True, kw_only=True)
class LogInput:
    """Options of all commands that read a log: what to take from it."""

    range_min: Annotated[float | None, tyro.conf.arg(metavar="M")] = None
    """Smallest range that counts as a return, m. What the log states, or 0, unless given."""
    range_max: Annotated[float | None, tyro.conf.arg(metavar="M")] = None
    """Ranges from here on are no-returns, m. What the log states, or 50, unless given."""
    bearings: Annotated[tuple[float, float] | None, tyro.conf.arg(metavar="FIRST STEP")] = None
    """Bearing of the first beam and step to the next, rad. What the log states unless given."""
    laser_offset: Annotated[tuple[float, float, float] | None, tyro.conf.arg(metavar="X Y THETA")] = None
    """Pose of the laser on the robot, m m rad. Used only with poses that are the robot's; what the log states, or 0,
    unless given."""
    scan_topic: Annotated[str | None, tyro.conf.arg(metavar="TOPIC")] = None
    """Topic of the scans, for a bag with several scanners."""
    odom_topic: Annotated[str | None, tyro.conf.arg(metavar="TOPIC")] = None
    """Topic of the odometry to take poses from, for a bag with several, or in place of tf."""
    poses: Annotated[Path | None, tyro.conf.arg(metavar="FILE.tum")] = None
    """Poses of the robot (timestamp tx ty tz qx qy qz qw), in place of those of the log; of the laser, if a comment in
    the file says so, as `linemap slam` writes it. Their covariances are those of the table FILE.csv that `slam` and
    `localize` write beside it, if it is there."""
    standstill: bool = False
    """The robot did not move: for a log without poses."""
    strict: bool = False
    """Refuse a log with malformed lines or messages, instead of skipping and counting them."""


@dataclasses.dataclass(frozen=True, kw_only=True)
class LogOptions(LogInput):
    """Options of the commands that run the method on a log."""

    preset: Literal["default", "paper"] = "default"
    """The method: `paper` is the literal reading of 1996, `default` the same with its known faults mended."""
    config: Path | None = None
    """TOML file with tables [thresholds], [noise], [rules], [persistence], as `linemap config` writes it; goes over the
    preset. Options given here go over both."""
    scanner: ScannerName | None = None
    """The instrument: stands for the noise that its data sheet states, unless the settings file states it."""
    range_sigma: Annotated[float | None, tyro.conf.arg(metavar="M")] = None
    """Standard deviation of a range, m. That of the scanner, or 0.02, unless given."""
    bearing_sigma: Annotated[float | None, tyro.conf.arg(metavar="RAD")] = None
    """Standard deviation of a bearing, rad. That of the scanner, or 0.001, unless given."""
    pose_sigma: Annotated[tuple[float, float, float], tyro.conf.arg(metavar="X Y THETA")] = POSE_SIGMA
    """Standard deviations of every pose for which neither the log nor a table beside --poses states a covariance,
    m m rad."""
    covariance: Literal["exact", "printed"] | None = None
    """`exact` to first order, or eq. 12 as `printed`. That of the preset unless given."""
    jacobians: Literal["autodiff", "analytic"] = "analytic"
    """Derivatives by autodiff through the estimate, or the hand-derived ones; the maps are the same."""
    segmentation: Literal["incremental", "optimal"] = "incremental"
    """How points are divided into lines: by the paper's criteria, or so that the lines explain them best."""
    max_vertices: Annotated[int | None, tyro.conf.arg(metavar="N")] = None
    """With `optimal`: lines of at most so many end points a scan; a corner that two lines share counts once."""
    every: Annotated[int, tyro.conf.arg(metavar="N")] = 1
    """Take every N-th scan."""
    dtype: Literal["float32", "float64"] = "float32"
    """Precision of all numbers."""
    overwrite: bool = False
    """Replace output that is there already."""
    quiet: bool = False
    """No progress, no warnings."""


def options_of_update(command: LogOptions) -> dict[str, Any]:
    """The keyword arguments of `update`: preset, then the settings file, then the options of the command line.

    The mount, which the log may state, is left to `linemap_jax.cli.logs`.
    """
    _check(command)
    import jax

    jax.config.update("jax_enable_x64", command.dtype == "float64")
    options = options_of_method(command.preset, command.config, noise_of_scanner(command.scanner))
    sigmas = {"range_sigma": command.range_sigma, "bearing_sigma": command.bearing_sigma}
    given = {name: sigma for name, sigma in sigmas.items() if sigma is not None}
    options["noise"] = dataclasses.replace(options["noise"], **given)
    if command.covariance is not None:
        options["covariance"] = command.covariance
    return options | {
        "jacobians": command.jacobians,
        "segmentation": command.segmentation,
        "max_vertices": command.max_vertices,
    }


def options_of_method(
    name: Literal["default", "paper"],
    config: Path | None,
    noise: "SensorNoise | None" = None,
    persistence: "Persistence | None" = None,
) -> dict[str, Any]:
    """The preset with some noise and persistence, and the settings file over it; no noise where neither states it."""
    keep_compilations()
    from linemap_jax.core.settings import Persistence, SensorNoise, preset
    from linemap_jax.io.config import read_config

    options: dict[str, Any] = {**preset(name), "noise": noise, "persistence": persistence or Persistence()}
    for section, fields in (read_config(config) if config else {}).items():
        options[section] = dataclasses.replace(options[section] or SensorNoise(), **fields)
    return options


def noise_of_scanner(name: ScannerName | None) -> "SensorNoise":
    """The noise of an instrument; the default's where none is named."""
    from linemap_jax.core.settings import SensorNoise

    if name is None:
        return SensorNoise()
    from linemap_jax.lab.scanners import PRESETS, noise_of

    noise = noise_of(PRESETS[name]())
    # Data sheets do not state more digits.
    return SensorNoise(range_sigma=float(f"{noise.range_sigma:.3g}"), bearing_sigma=float(f"{noise.bearing_sigma:.3g}"))


def _check(command: LogOptions) -> None:
    """Refuse numbers that make no sense."""
    inf = float("inf")
    if not 1 <= command.every <= 10**9:
        raise UsageError(f"--every must be from 1 to 10^9, not {command.every}")
    check_input(command)
    if command.range_sigma is not None and not 0 < command.range_sigma < inf:
        raise UsageError(f"--range-sigma must be positive, not {command.range_sigma}")
    if command.bearing_sigma is not None and not 0 <= command.bearing_sigma < inf:
        raise UsageError(f"--bearing-sigma must be zero or positive, not {command.bearing_sigma}")
    if not all(0 <= x < inf for x in command.pose_sigma):
        raise UsageError(f"--pose-sigma must be zero or positive, not {command.pose_sigma}")
    if command.max_vertices is not None:
        if command.segmentation != "optimal":
            raise UsageError("--max-vertices needs --segmentation optimal")
        if not 2 <= command.max_vertices <= MOST_VERTICES:
            raise UsageError(f"--max-vertices must be from 2 to {MOST_VERTICES}, not {command.max_vertices}")


def check_input(command: LogInput) -> None:
    """Refuse what no log can be read by."""
    if command.range_min is not None and not 0 <= command.range_min < math.inf:
        raise UsageError(f"--range-min must be zero or positive, not {command.range_min}")
    if command.range_max is not None and not (command.range_min or 0) < command.range_max:
        raise UsageError(f"--range-max must be positive and more than --range-min, not {command.range_max}")
    if command.bearings is not None:
        first, step = command.bearings
        if not (abs(first) <= 2 * math.pi and 0 < abs(step) <= 2 * math.pi):
            raise UsageError(f"--bearings must be a first bearing and a step in radians, not {command.bearings}")
    if command.laser_offset is not None and not all(map(math.isfinite, command.laser_offset)):
        raise UsageError(f"--laser-offset must be finite, not {command.laser_offset}")
    if command.standstill and command.poses is not None:
        raise UsageError("--standstill and --poses exclude one another")


def check_drive(*, scans: int, pose_sigma: tuple[float, float, float], pose_correlation: float, seed: int) -> None:
    """Refuse numbers that make no sense for a simulated drive."""
    if not 1 <= scans <= MOST_SCANS:
        raise UsageError(f"--scans must be from 1 to {MOST_SCANS}, not {scans}")
    if not all(0 <= x < float("inf") for x in pose_sigma):
        raise UsageError(f"--pose-sigma must be zero or positive, not {pose_sigma}")
    if not 0 <= pose_correlation <= 1:
        raise UsageError(f"--pose-correlation must be from 0 to 1, not {pose_correlation}")
    if not 0 <= seed < 2**63:
        raise UsageError(f"--seed must be from 0 to 2^63 - 1, not {seed}")
