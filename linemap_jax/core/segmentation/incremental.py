"""Section 4.3.1: the paper's three criteria, one pass over the beams.

A point joins the current run while (1) it is near the previous point, (2) it is near the run's line and (3) its bearing
is near the previous one. The running sums of Eq. (5) start anew at each run's first point: in coordinates of the world
they lose everything in float32.
"""

from typing import NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int

from linemap_jax.core.sensor import Points
from linemap_jax.core.settings import Rules, SensorNoise, Thresholds
from linemap_jax.core.state import Scan

ACCEPTED, GAP, BEARING, DISTANCE = 0, 1, 2, 3


class _Run(NamedTuple):
    """The run under extraction; packed into one array, see `segment`."""

    n: Array  # number of points
    x0: Array  # first point
    y0: Array
    x: Array  # last point, from the first
    y: Array
    bearing: Array  # of the last point
    range: Array
    rx: Array  # Eq. (5), from the first point
    ry: Array
    rxx: Array
    ryy: Array
    rxy: Array


def segment(
    points: Points, scan: Scan, thresholds: Thresholds, noise: SensorNoise, rules: Rules
) -> tuple[Int[Array, " N"], Int[Array, "3"]]:
    """Divide the beams of a scan into runs that may be lines.

    Args:
      points: the points of the scan.
      scan: the scan itself; its masked beams belong to no run and break none.
      thresholds: criteria 1 to 3.
      noise: what criterion 2 is scaled by.
      rules: `give_back_point`.

    Returns:
      The run of each beam, counted from 0 in beam order, -1 for masked beams, shape `[N]`; and how many points broke a
      run by criteria 1, 2 and 3.
    """

    def step(carry: Array, beam: tuple[Array, ...]) -> tuple[Array, Array]:
        run = _Run(*carry)
        valid, *measured = beam
        joined, verdict = _judge(run, *measured, scan.spacing, thresholds, noise, rules)
        # One packed array for a carry: XLA compiles the loop into one kernel only while the body stays small.
        return jnp.where(valid, jnp.stack(joined), carry), jnp.where(valid, verdict, -1)

    start = jnp.zeros(len(_Run._fields), points.position.dtype)
    columns = (points.position[:, 0], points.position[:, 1], points.beam[:, 0], points.beam[:, 1])
    _, verdict = jax.lax.scan(step, start, (scan.valid, *columns, scan.ranges, scan.bearings))

    # The first point of all breaks nothing.
    first = jnp.cumsum(scan.valid) == 1
    breaks = (verdict > ACCEPTED) & ~first
    run = jnp.cumsum(breaks)
    if rules.give_back_point:
        run = run + _before_distance_break(verdict, scan.valid & ~first)
    counts = [jnp.sum(breaks & (verdict == which), dtype=jnp.int32) for which in (GAP, DISTANCE, BEARING)]
    return jnp.where(scan.valid, run, -1).astype(jnp.int32), jnp.stack(counts)


def _before_distance_break(verdict: Int[Array, " N"], follows: Bool[Array, " N"]) -> Int[Array, " N"]:
    """One for each beam whose next valid beam was refused by criterion 2: it goes along with that beam."""
    n = verdict.shape[0]
    index = jnp.where(verdict >= 0, jnp.arange(n), n)
    next_valid = jnp.concatenate([jax.lax.cummin(index, reverse=True)[1:], jnp.full(1, n)])
    refused = jnp.concatenate([(verdict == DISTANCE) & follows, jnp.zeros(1, bool)])
    return refused[next_valid].astype(jnp.int32)


def _judge(
    run: _Run,
    px: Float[Array, ""],
    py: Float[Array, ""],
    ux: Float[Array, ""],
    uy: Float[Array, ""],
    r: Float[Array, ""],
    bearing: Float[Array, ""],
    spacing: Float[Array, ""],
    thresholds: Thresholds,
    noise: SensorNoise,
    rules: Rules,
) -> tuple[_Run, Int[Array, ""]]:
    """The run after one more point, and which criterion the point failed, if any."""
    x, y = px - run.x0, py - run.y0
    dx, dy = x - run.x, y - run.y
    turn = jnp.abs(bearing - run.bearing)
    gap = jnp.maximum(thresholds.gap_distance, thresholds.gap_spacings * jnp.minimum(r, run.range) * turn)
    near = dx * dx + dy * dy < gap * gap
    adjacent = turn < thresholds.gap_beams * spacing
    on_line = (run.n < 3) | _near_line(run, x, y, ux, uy, r, thresholds, noise)

    empty = run.n == 0
    verdict = jnp.where(near, jnp.where(adjacent, jnp.where(on_line, ACCEPTED, DISTANCE), BEARING), GAP)
    verdict = jnp.where(empty, GAP, verdict)
    accept = verdict == ACCEPTED
    give_back = (verdict == DISTANCE) & rules.give_back_point

    # A new run starts at this point, or at the last one if that is given back. All sums are from the run's first point,
    # whose own terms are zero.
    x0 = jnp.where(accept, run.x0, jnp.where(give_back, run.x0 + run.x, px))
    y0 = jnp.where(accept, run.y0, jnp.where(give_back, run.y0 + run.y, py))
    x = jnp.where(accept, x, jnp.where(give_back, px - x0, 0))
    y = jnp.where(accept, y, jnp.where(give_back, py - y0, 0))
    keep = jnp.where(accept, 1, 0).astype(x.dtype)
    joined = _Run(
        n=run.n * keep + jnp.where(give_back, 2, 1),
        x0=x0,
        y0=y0,
        x=x,
        y=y,
        bearing=bearing,
        range=r,
        rx=run.rx * keep + x,
        ry=run.ry * keep + y,
        rxx=run.rxx * keep + x * x,
        ryy=run.ryy * keep + y * y,
        rxy=run.rxy * keep + x * y,
    )
    return joined, verdict


def _near_line(
    run: _Run,
    x: Float[Array, ""],
    y: Float[Array, ""],
    ux: Float[Array, ""],
    uy: Float[Array, ""],
    r: Float[Array, ""],
    thresholds: Thresholds,
    noise: SensorNoise,
) -> Bool[Array, ""]:
    """Criterion 2: is the point within the gate around the run's line?

    With N_1, N_2 and T of Eqs. (6)-(8) the line has the normal (-T, N_1), or (N_2, -T), and no angle is needed. The
    gate widens with the predicted spread of the distance: the noise of one point, seen at its incidence, plus what the
    line of n points itself is uncertain by there. A fixed gate of 5 cm cuts walls to pieces when the scanner's noise is
    3 cm, and spoils the covariance of what is left.
    """
    n = run.n
    n1 = run.rxx * n - run.rx * run.rx
    n2 = run.ryy * n - run.ry * run.ry
    t = run.rxy * n - run.rx * run.ry
    p1, p2 = n * x - run.rx, n * y - run.ry
    steep = n1 < n2
    width = jnp.where(steep, n2, n1)
    p, w = jnp.where(steep, p2, p1), jnp.where(steep, p1, p2)
    nx, ny = jnp.where(steep, width, -t), jnp.where(steep, -t, width)

    norm = width * width + t * t
    distance = (w * width - p * t) ** 2  # times n^2 norm
    cos2 = (ux * nx + uy * ny) ** 2  # times norm
    range_part = noise.range_sigma**2 * cos2
    bearing_part = (r * noise.bearing_sigma) ** 2 * jnp.maximum(norm - cos2, 0)
    # n^2 + n + n p^2 / width is n^2 (1 + 1/n + leverage); the width is zero only where all points are equal.
    spread = (range_part + bearing_part) * (n * n + n + n * p * p / jnp.where(width > 0, width, 1))
    gate = jnp.maximum(thresholds.line_distance**2 * n * n * norm, thresholds.line_sigmas**2 * spread)
    return distance < gate
