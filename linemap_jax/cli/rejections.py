"""When nothing was found: which criterion turned away how many points."""

import dataclasses
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from linemap_jax.core.state import Extraction

WHY = {
    "invalid": "gave no return",
    "gap": "broke a run by their distance from the point before (criterion 1)",
    "distance": "broke one by their distance from the line (criterion 2)",
    "bearing": "broke one by their angle to the point before (criterion 3)",
    "too_few": "lie in runs of fewer than three points that can be used",
    "too_short": "lie in runs shorter than the shortest line",
    "lone": "lie in no line and in no cluster",
    "near_line": "lie in clusters too close to a line",
}
"""What each field of `Rejected` counts."""


@dataclasses.dataclass
class Rejections:
    """Sums over the scans of a log; `str()` is a sentence."""

    found: int = 0  # lines and circles
    beams: int = 0
    counts: dict[str, int] = dataclasses.field(default_factory=lambda: dict.fromkeys(WHY, 0))

    def add(self, extraction: "Extraction") -> None:
        """Add those of a stack of scans."""
        self.found += int(extraction.lines.valid.sum()) + int(extraction.circles.valid.sum())
        self.beams += extraction.line_of_beam.size
        for name in self.counts:
            self.counts[name] += int(getattr(extraction.rejected, name).sum())

    def __str__(self) -> str:
        """What was turned away, and why."""
        told = "; ".join(f"{count} {WHY[name]}" for name, count in self.counts.items() if count)
        return f"nothing was found in {self.beams} beams: {told}"
