"""Section 4.3.1 (lines): the paper's three criteria, one pass over the points.

A point joins the current run while (1) it is near the previous point, (2) it is near the run's line and (3) its bearing
is near the previous one. The running sums of Eq. (5) start anew at each run's first point: in coordinates of the world
they lose everything in float32.
"""

import math
from collections.abc import Callable
from typing import NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int, Shaped

from linemap_jax.core.fields import documented
from linemap_jax.core.frames import dot
from linemap_jax.core.sensor import Points
from linemap_jax.core.settings import Number, Rules, SensorNoise, Thresholds


@documented
class Run(NamedTuple):
    """The run under extraction, as it stands at some point; the running sums of Eq. (5) are from its first point."""

    n: Array
    """Number of points."""
    x0: Array
    """First point, x, m."""
    y0: Array
    """First point, y, m."""
    rx: Array
    """R_x of Eq. (5), from the first point, m."""
    ry: Array
    """R_y, m."""
    rxx: Array
    """R_xx, m^2."""
    ryy: Array
    """R_yy, m^2."""
    rxy: Array
    """R_xy, m^2."""


class _Step(NamedTuple):
    """What the loop has to know of a point and the one before it."""

    x: Array
    y: Array
    x_before: Array
    y_before: Array
    ux: Array  # the beam
    uy: Array
    var_along: Array  # variance of the point along its beam, m^2
    var_across: Array
    follows: Array  # 1 if criteria 1 and 3 hold, else 0


def segment(
    points: Points, thresholds: Thresholds, noise: SensorNoise, rules: Rules
) -> tuple[Bool[Array, " N"], Run, Int[Array, "3"]]:
    """Divide the points of a scan into runs that may be lines.

    Args:
      points: the points of the scan.
      thresholds: criteria 1 to 3.
      noise: what criteria 1 and 2 are scaled by.
      rules: `give_back_point`.

    Returns:
      Which points are the last of their run, shape `[N]`; the run as it stood at each point, so that at its last point
      the sums are those of the whole run, each field of shape `[N]`; and how many points broke a run by criteria 1, 2
      and 3.
    """
    before = one_before(points.position)
    near, adjacent = follow(points, lambda arc: gap_gate(arc, thresholds, noise), thresholds.gap_beams)
    follows = near & adjacent
    other = jnp.arange(points.valid.shape[0]) > 0

    steps = _Step(
        x=points.position[:, 0],
        y=points.position[:, 1],
        x_before=before[:, 0],
        y_before=before[:, 1],
        ux=points.beam[:, 0],
        uy=points.beam[:, 1],
        var_along=jnp.broadcast_to(noise.range_sigma**2, points.range.shape),
        var_across=(points.range * noise.bearing_sigma) ** 2,
        follows=follows.astype(points.range.dtype),
    )

    def body(carry: Array, row: Array) -> tuple[Array, Array]:
        carry = _join(Run(*carry), _Step(*row), thresholds, rules)
        return carry, carry

    # XLA compiles this loop into one kernel, but only while its body is small and its carry is one array: just past
    # the limit it takes thirty times as long. So whatever can be known beforehand is computed outside.
    _, running = jax.lax.scan(body, jnp.zeros(len(Run._fields), points.range.dtype), jnp.stack(steps, -1))
    run = Run(*jnp.moveaxis(running, -1, 0))

    # A point that joined is one more than before; the first point of all breaks nothing.
    joined = run.n == jnp.concatenate([run.n[:1], run.n[:-1]]) + 1
    breaks = other & points.valid & ~joined
    by_distance = breaks & follows
    end_of_all = jnp.concatenate([points.valid[1:] != points.valid[:-1], points.valid[-1:]])
    if rules.give_back_point:
        # The run ends one point earlier, and the point before the break begins the next.
        ends = _before(breaks & ~by_distance) | _before(_before(by_distance)) | end_of_all
    else:
        ends = _before(breaks) | end_of_all
    counts = [breaks & ~near, by_distance, breaks & near & ~adjacent]
    counts = jnp.stack([jnp.sum(count, dtype=jnp.int32) for count in counts])
    return ends, run, counts


def follow(
    points: Points, gap: Callable[[Float[Array, " N"]], Float[Array, " N"]], beams: Number
) -> tuple[Bool[Array, " N"], Bool[Array, " N"]]:
    """Criteria 1 and 3: whether each point is near the one before, and whether its bearing is. The first has none.

    Args:
      points: the points of the scan.
      gap: the largest distance between them, m, by the arc between their beams, m.
      beams: the largest angle between them, in beam spacings.

    Returns:
      Whether criterion 1 holds, and whether criterion 3 does. Shapes `[N]`.
    """
    step = points.position - one_before(points.position)
    arc = jnp.minimum(points.range, one_before(points.range)) * points.turn
    other = points.valid & (jnp.arange(points.valid.shape[0]) > 0)
    return other & (dot(step, step) < gap(arc) ** 2), other & (points.turn < beams * points.spacing)


def one_before(x: Shaped[Array, "N *s"]) -> Shaped[Array, "N *s"]:
    """What stands before each of `x`; the first for the first."""
    return jnp.concatenate([x[:1], x[:-1]])


def gap_gate(arc: Float[Array, "*s"], thresholds: Thresholds, noise: SensorNoise) -> Float[Array, "*s"]:
    """Criterion 1: the largest distance between successive points, in metres, by the arc between their beams.

    Args:
      arc: between the beams of the two points, at the nearer one: range times angle, m.
      thresholds: `gap_distance`, `gap_spacings`, `gap_sigmas`.
      noise: of the range.

    Returns:
      The gate, m; of the shape of the arcs.
    """
    noisy = thresholds.gap_sigmas * math.sqrt(2) * noise.range_sigma
    return jnp.maximum(jnp.maximum(thresholds.gap_distance, thresholds.gap_spacings * arc), noisy)


def _before(which: Bool[Array, " N"]) -> Bool[Array, " N"]:
    """The points before those."""
    return jnp.concatenate([which[1:], jnp.zeros(1, bool)])


def _join(run: Run, point: _Step, thresholds: Thresholds, rules: Rules) -> Float[Array, "8"]:
    """The run after one more point, packed: the old one if the point joins it, else a new one.

    A new run begins at this point, or at the one before if that is given back.
    """
    follows = point.follows > 0
    joins = follows & ((run.n < 3) | _near_line(run, point, thresholds))
    from_before = follows & ~joins & rules.give_back_point
    x0 = jnp.where(joins, run.x0, jnp.where(from_before, point.x_before, point.x))
    y0 = jnp.where(joins, run.y0, jnp.where(from_before, point.y_before, point.y))
    x, y = point.x - x0, point.y - y0
    old = jnp.where(joins, 1, 0).astype(x.dtype)
    return jnp.stack(
        Run(
            n=run.n * old + jnp.where(from_before, 2, 1).astype(x.dtype),
            x0=x0,
            y0=y0,
            rx=run.rx * old + x,
            ry=run.ry * old + y,
            rxx=run.rxx * old + x * x,
            ryy=run.ryy * old + y * y,
            rxy=run.rxy * old + x * y,
        )
    )


def _near_line(run: Run, point: _Step, thresholds: Thresholds) -> Bool[Array, ""]:
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
    p1, p2 = n * (point.x - run.x0) - run.rx, n * (point.y - run.y0) - run.ry
    # Regressor and response, (x, y) or (y, x)
    steep = n1 < n2
    width = jnp.where(steep, n2, n1)
    p, w = jnp.where(steep, p2, p1), jnp.where(steep, p1, p2)
    up, uw = jnp.where(steep, point.uy, point.ux), jnp.where(steep, point.ux, point.uy)

    norm = width * width + t * t
    distance = w * width - p * t  # times n sqrt(norm)
    cosine = uw * width - up * t  # of the incidence, times sqrt(norm)
    variance = point.var_across * norm + (point.var_along - point.var_across) * (cosine * cosine)
    # n^2 + n + n p^2 / width is n^2 (1 + 1/n + leverage); the width is zero only where all points are equal.
    spread = variance * (n * n + n + n * p * p / jnp.where(width > 0, width, 1))
    gate = jnp.maximum(thresholds.line_distance**2 * (n * n) * norm, thresholds.line_sigmas**2 * spread)
    return distance * distance < gate
