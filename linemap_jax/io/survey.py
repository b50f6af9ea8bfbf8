"""What a log holds: what `linemap info` tells."""

import math
from collections import Counter
from collections.abc import Iterable
from typing import Any

import numpy as np

from linemap_jax.io.reading import Log, LogError, Reading

SHARES = ("returns", "plus_inf", "too_far", "too_near", "minus_inf", "nan")
"""What a beam may have brought back: a return; no return, as infinity or as a range from the maximum on; a range of
zero or below the minimum; too close, as minus infinity; no measurement."""


def describe(log: Log) -> dict[str, Any]:
    """Read a log to its end, and tell what is in it. Memory does not grow with the log.

    Args:
      log: opened so that poses are not needed; what is told of poses is then what there is.

    Returns:
      Numbers and words for JSON: `format`, `messages` with their types, `frames`; of the scans `scans`, `duration_s`,
      `rate_hz`, `beams`, `bearings_rad` (first, step, last), `range_min_m`, `range_max_m`, the shares of what beams
      brought back, the number of scans with a pose, and where the laser sits on the robot, `mount_m_rad`; whether the
      poses are odometry's, `drift`, None where the log does not say; `warnings`. If no scan can be read, `refused` says
      why, and what is told of scans is missing.

    Raises:
      LogError: if the log cannot be read, and holds no message that tells anything.
    """
    seen = _Seen()
    refused = None
    try:
        seen.look_at(log)
    except LogError as error:
        if not log.notes.messages:
            raise
        refused = error.cause if error.where is None else f"{error.where}: {error.cause}"
    notes = log.notes
    messages = [{"name": name, "type": notes.types.get(name), "count": count} for name, count in notes.messages.items()]
    told = {"log": str(log.path), "format": log.format, "messages": messages, "frames": notes.frames}
    if refused is not None:
        return told | {"refused": refused}
    of_poses = {"poses": notes.poses, "drift": notes.drift, "mounting": notes.mounting or None}
    return told | seen.told() | of_poses | {"warnings": notes.warnings()}


class _Seen:
    """Sums over the scans of a log."""

    def __init__(self) -> None:
        self.scans = self.with_pose = self.with_cov = self.swept = self.beams = 0
        self.fewest, self.most = math.inf, 0
        self.counts = Counter[str]()
        self.first: Reading | None = None
        self.stamps = [math.inf, -math.inf]
        self.nearest, self.farthest = math.inf, 0.0

    def look_at(self, readings: Iterable[Reading]) -> None:
        for reading in readings:
            self.first = self.first or reading
            self.scans += 1
            self.with_pose += reading.pose is not None
            self.with_cov += reading.cov_pose is not None
            self.swept += reading.sweep_poses is not None
            self.stamps = [min(self.stamps[0], reading.timestamp), max(self.stamps[1], reading.timestamp)]
            ranges = reading.ranges
            self.beams += ranges.size
            self.fewest, self.most = min(self.fewest, ranges.size), max(self.most, ranges.size)
            finite = np.isfinite(ranges)
            near = finite & ((ranges <= 0) | (ranges < reading.range_min))
            far = finite & (ranges >= reading.range_max) & ~near
            returns = ranges[finite & ~near & ~far]
            for name, which in (
                ("nan", np.isnan(ranges)),
                ("plus_inf", np.isposinf(ranges)),
                ("minus_inf", np.isneginf(ranges)),
                ("too_near", near),
                ("too_far", far),
            ):
                self.counts[name] += int(np.count_nonzero(which))
            self.counts["returns"] += returns.size
            if returns.size:
                self.nearest = min(self.nearest, float(returns.min()))
                self.farthest = max(self.farthest, float(returns.max()))

    def told(self) -> dict[str, Any]:
        first = self.first
        assert first is not None  # a log without a scan has been refused by its reader
        duration = self.stamps[1] - self.stamps[0]
        bearings = first.bearings
        step = float(bearings[1] - bearings[0]) if bearings.size > 1 else 0.0
        returns = self.counts["returns"]
        return {
            "scans": self.scans,
            "duration_s": duration,
            "rate_hz": (self.scans - 1) / duration if duration > 0 else None,
            "beams": self.fewest if self.fewest == self.most else [self.fewest, self.most],
            "bearings_rad": [float(bearings[0]), step, float(bearings[-1])],
            "range_min_m": first.range_min,
            "range_max_m": first.range_max if math.isfinite(first.range_max) else None,
            "nearest_m": self.nearest if returns else None,
            "farthest_m": self.farthest if returns else None,
            "shares": {name: self.counts[name] / self.beams for name in SHARES},
            "scans_with_pose": self.with_pose,
            "scans_with_covariance": self.with_cov,
            "scans_in_motion": self.swept,
            "mount_m_rad": None if first.mount is None else list(first.mount),
        }
