"""`linemap info`: what a log holds, and what `build` would take from it."""

import dataclasses
import json
import math
import shlex
from pathlib import Path
from typing import Any

import tyro

from linemap_jax.cli.logs import opened, progress
from linemap_jax.cli.options import LogInput, check_input, own_options_first

SHARES = {
    "returns": "returns",
    "plus_inf": "no return (inf)",
    "too_far": "no return (beyond the maximum range)",
    "too_near": "zero, or below the minimum range",
    "minus_inf": "too close (-inf)",
    "nan": "invalid (NaN)",
}


WHY = {
    True: " (the poses are odometry's, which drifts)",
    False: "",
    None: " (or `slam`, if nobody has corrected the poses)",
}
"""Of the command to go on with, by whether the poses drift."""


@own_options_first
@dataclasses.dataclass(frozen=True, kw_only=True)
class Info(LogInput):
    """Tell what a log holds: scans, ranges, topics, frames, where poses come from."""

    log: tyro.conf.Positional[Path]
    """CARMEN log, plain or .gz; ROS 1 .bag; ROS 2 bag: its folder, .mcap or .db3."""
    quiet: bool = False
    """No progress."""
    json: bool = False
    """Print it as JSON."""

    def run(self) -> int:
        """Tell, and give the exit status."""
        check_input(self)
        told = _told(self, self.scan_topic)
        topics = told.pop("scan_topics")
        if self.scan_topic is None and len(topics) > 1:
            told["scanners"] = {topic: _of_scanner(_told(self, topic)) for topic in topics}
        from linemap_jax.io.reading import printable

        words = json.dumps(told, indent=2, allow_nan=False) if self.json else "\n".join(map(printable, _in_words(told)))
        print(words)
        return 0


def _told(command: Info, scan_topic: str | None) -> dict[str, Any]:
    """What the log holds; and, whether or not that is of a scan topic, what `build` would make of its poses."""
    from linemap_jax.io.reading import LogError
    from linemap_jax.io.survey import describe

    chosen = dataclasses.replace(command, scan_topic=scan_topic)
    log = opened(chosen, command.log, need_poses=False)
    with progress(log, quiet=command.quiet):
        told = describe(log)
    told["scan_topics"] = log.notes.scan_topics
    if "refused" not in told and told["scans_with_pose"] == 0:
        try:
            next(iter(opened(chosen, command.log)))
        except LogError as error:
            told["refused"] = error.cause
    if "refused" not in told:
        told["next"] = _next(chosen, drift=told["drift"])
    return told


def _next(command: Info, *, drift: bool | None) -> str:
    """The command that makes a map of the log."""
    words = ["linemap", "slam" if drift else "build", str(command.log), "-o", "my-map"]
    for option in ("scan_topic", "odom_topic", "poses"):
        if (value := getattr(command, option)) is not None:
            words += [f"--{option.replace('_', '-')}", str(value)]
    return shlex.join([*words, *(["--standstill"] if command.standstill else [])])


def _of_scanner(told: dict[str, Any]) -> dict[str, Any]:
    """Without what is the same of all scanners of a log."""
    return {name: value for name, value in told.items() if name not in ("log", "format", "messages", "scan_topics")}


def _in_words(told: dict[str, Any]) -> list[str]:
    said = [f"{told['log']}: {told['format']}"]
    for message in told["messages"]:
        kind = f" ({message['type']})" if message["type"] else ""
        said.append(f"  {message['count']:>8} {message['name']}{kind}")
    said += [*_scanner_in_words(told)]
    for topic, of_scanner in told.get("scanners", {}).items():
        said += [f"with --scan-topic {topic}:", *(f"  {line}" for line in _scanner_in_words(of_scanner))]
    return said


def _scanner_in_words(told: dict[str, Any]) -> list[str]:
    said = [f"frames:   {', '.join(told['frames'])}"] if told["frames"] else []
    if "scans" in told:
        rate = "" if told["rate_hz"] is None else f", {told['rate_hz']:.1f} a second"
        beams = told["beams"] if isinstance(told["beams"], int) else "{} to {}".format(*told["beams"])
        first, step, last = (math.degrees(angle) for angle in told["bearings_rad"])
        far = "unlimited" if told["range_max_m"] is None else f"{told['range_max_m']:g} m"
        said += [
            f"scans:    {told['scans']} in {told['duration_s']:.1f} s{rate}",
            f"beams:    {beams}, from {first:.2f} to {last:.2f} degrees in steps of {step:.4f}",
            f"ranges:   from {told['range_min_m']:g} m to {far}"
            + (f"; seen {told['nearest_m']:.2f} m to {told['farthest_m']:.2f} m" if told["nearest_m"] else ""),
        ]
        said += [f"  {told['shares'][name]:8.2%} {what}" for name, what in SHARES.items() if told["shares"][name]]
        known, noise = told["scans_with_pose"], told["scans_with_covariance"]
        coverage = f", for {known} scans; covariance stated for {noise}" if known else ""
        said.append(f"poses:    {told['poses']}{coverage}")
        if told["mounting"]:
            where = ""
            if told["mount_m_rad"] is not None:
                x, y, theta = told["mount_m_rad"]
                where = f"; x {x:.3f} m, y {y:.3f} m, yaw {math.degrees(theta):.1f} degrees"
            said.append(f"laser on the robot: {told['mounting']}{where}")
        if told["scans_in_motion"]:
            said.append(f"motion during the sweep is corrected for {told['scans_in_motion']} scans")
        said += [f"warning:  {warning}" for warning in told["warnings"]]
    if "refused" in told:
        said.append(f"`linemap build` would refuse it: it {told['refused']}")
    elif "next" in told:
        said.append("noise:    of the scanner: `linemap calibrate` tells it from the log, if you do not know it")
        said.append(f"next:     {told['next']}{WHY[told['drift']]}")
    return said
