"""The map on the way, for a slider over time: some moments of a build, and some of the raw points."""

from collections.abc import Iterator
from typing import TYPE_CHECKING

from linemap_jax.io.thinned import Thinned

if TYPE_CHECKING:
    from numpy.typing import NDArray

    from linemap_jax.core.settings import Mount
    from linemap_jax.core.state import LineMap, Pose, Scan

MOST_KEPT = 32
"""Moments that are kept; there are more than half as many, once the log is long enough."""
FIRST_STEP = 8
"""Scans between moments of a short log."""


class History:
    """Maps at evenly spaced scans of a log of unknown length, and raw points of all of it: both bounded in number.

    Attributes:
      kept: maps, each with the number of scans that it was built from.
    """

    def __init__(self, mount: "Mount") -> None:
        """Nothing yet; `mount` is that of the scanner on the robot."""
        from linemap_jax.io.html import MOST_POINTS

        self.kept: list[tuple[LineMap, int]] = []
        self._mount = mount
        self._step, self._scans = FIRST_STEP, 0
        self._points: Thinned[NDArray] = Thinned(2 * MOST_POINTS)

    @property
    def points(self) -> "NDArray":
        """Raw points in the world, m. Shape `[P, 2]`."""
        import numpy as np

        return np.array(self._points.kept).reshape(-1, 2)

    def pieces(self, scans: "Scan", poses: "Pose") -> Iterator[tuple["Scan", "Pose"]]:
        """A chunk of stacked scans, cut where a moment is to be kept; after each piece `add` has to be called."""
        import jax
        import numpy as np

        from linemap_jax.lab.occupancy import returns_in_world

        _, places, valid = returns_in_world(scans, poses, self._mount)
        self._points.extend(places[valid])
        begin, count = 0, scans.ranges.shape[0]
        while begin < count:
            end = min(count, begin + self._step - self._scans % self._step)
            piece = slice(begin, end)
            self._scans += end - begin
            yield jax.tree.map(lambda x: x if count == end - begin else np.asarray(x)[piece], (scans, poses))  # noqa: B023
            begin = end

    def add(self, line_map: "LineMap") -> None:
        """The map after the latest piece."""
        if self._scans % self._step == 0:
            self.kept.append((line_map, self._scans))
        if len(self.kept) > MOST_KEPT:
            self._step *= 2
            self.kept = [moment for moment in self.kept if moment[1] % self._step == 0]
