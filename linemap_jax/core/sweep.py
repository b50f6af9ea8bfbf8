"""Sweeps that close on themselves: where the first beam of a scanner that sees all around has to be.

Points are joined into lines in the order of the beams, so that the first and the last beam of a scan lie in different
lines. That is right for a scanner that sees 180 degrees. One that sees all around has a seam where the driver happened
to begin, and a wall across it would become two lines. So the sweep is begun where the surface breaks in any case.

The functions take arrays of NumPy or of jax, and give back such ones.
"""

from typing import Any

import numpy as np
from jaxtyping import Bool, Float, Int

BREAK_DISTANCE = 0.15
"""m. Neighbouring points farther apart than this and `BREAK_SPACINGS` arcs between their beams lie on two surfaces."""

BREAK_SPACINGS = 6.0
"""As `Thresholds.gap_spacings`: a wall seen at ten degrees still holds together."""

CONTEXT = np.radians(5.0)
"""rad. A corner is told by the beams so far to either side: neighbouring ones differ by their noise alone."""


def close_sweep(
    ranges: Float[Any, "*s N"], bearings: Float[Any, "*s N"], valid: Bool[Any, "*s N"], spacing: Float[Any, "*s"]
) -> tuple[Bool[Any, "*s N"], Int[Any, "*s"]]:
    """Begin a sweep that closes on itself where the surface breaks; no other is changed.

    It closes if one more step from its last beam would lead to its first, or beyond. What was measured once more after
    a full turn is dropped.

    Args:
      ranges: m; only those of valid beams are looked at.
      bearings: in the order of the sweep, without a jump by a full turn, rad; finite.
      valid: beams that returned.
      spacing: between neighbouring beams, rad.

    Returns:
      `valid`, without what was dropped; and the beam at which the sweep begins, 0 unless it closes on itself.
    """
    xp = valid.__array_namespace__()
    count, turn = bearings.shape[-1], 2 * np.pi
    if count == 0:
        return valid, xp.zeros(spacing.shape, int)
    swept = xp.abs(bearings - bearings[..., :1])
    once = swept < (turn - spacing / 2)[..., None]
    beams = xp.sum(once, -1)
    last = xp.take_along_axis(swept, (beams - 1)[..., None], -1)[..., 0]
    closes = (turn - last < 1.5 * spacing) & (beams > 2)
    if isinstance(closes, np.ndarray) and not closes.any():  # most logs; a traced array cannot be asked
        return valid, np.zeros(closes.shape, int)
    valid = valid & (once | ~closes[..., None])

    # A corner is looked for among beams that lie so far to either side.
    reach = max(1, round(count * float(CONTEXT) / turn))
    index = xp.arange(count)

    def beside(values: Any, step: int) -> Any:
        return xp.take_along_axis(values, (index + step) % beams[..., None], -1)

    r = xp.where(valid, ranges, 1)
    r_before = beside(r, -1)
    neighbours = valid & beside(valid, -1)
    chord = r**2 + r_before**2 - 2 * r * r_before * xp.cos(bearings - beside(bearings, -1))
    gate = BREAK_DISTANCE + BREAK_SPACINGS * xp.minimum(r, r_before) * spacing[..., None]
    jump = xp.where(neighbours, xp.sqrt(xp.maximum(chord, 0)) / gate, 0)

    # On a line 1/r = a cos(phi) + b sin(phi), so that the second difference vanishes.
    bend = r / beside(r, -reach) + r / beside(r, reach) - 2 * xp.cos(reach * spacing)[..., None]
    bend = xp.where(valid & beside(valid, -reach) & beside(valid, reach), xp.abs(bend), 0)
    corner = bend / (1 + bend)

    nothing_before = valid & ~beside(valid, -1) & ~beside(valid, -2)
    score = xp.where(nothing_before, xp.inf, xp.where(jump > 1, jump, corner))
    return valid, xp.where(closes, xp.argmax(xp.where(once, score, -1), -1), 0)
