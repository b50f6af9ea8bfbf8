"""Polylines through a sweep of ranges: the best one by dynamic programming, then vertices off the beams.

Seen from the scanner a line is linear in the inverse range, 1/r = u cos(phi) + t sin(phi), so that the residual of a
range is, to first order, r - r^2 (u cos(phi) + t sin(phi)): the most likely line of a run is a linear least-squares
fit. What a polyline costs is the sum of its squared residuals, a price for each vertex (or none, where their number is
given), and a price for each point that no line covers; a corner that two lines share is one vertex.

`best_polyline` visits the beams in order and finds the best lines (optimal partitioning, Jackson et al. 2005). Two
surrogates of a corner keep it quick:

- Where vertices have a price, lines are free, each the most likely one of its run, and two neighbours share a corner if
  they cross between the last beam of one and the first of the other.
- Where their number is given, a polyline is continuous in 1/r, with corners on beams. What its past says of the inverse
  range at a beam is then one quadratic, and the next line starts from it.

A corner couples lines, and a past that is not the cheapest may win in the end; Fearnhead, Maidstone and Letchford
(2019) keep all that can. Here the cheapest is kept, for each number of vertices, and what that costs is tested.

`refine` moves the vertices off their beams and takes the residuals as they are: Levenberg-Marquardt.

In float32 the sums of r^4 lose the residuals. So each start of a line keeps a recursive least-squares fit, whose
residual sum grows by squares, and whose determinant by terms that are not negative.
"""

import dataclasses
import functools
import math
from typing import NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int

from linemap_jax.core.segmentation.incremental import one_before
from linemap_jax.core.state import pytree

MOST_ANGLE = 3.0
"""Largest angle that one line spans, rad: below half a turn."""
LEAST_SINE = math.sin(MOST_ANGLE)
STARTS = 96
"""Points where a line may start that are looked at side by side. The one that promises least gives way to the next; a
scan of no more points is searched whole, and of others hardly one comes out differently. A multiple of `FOLD`."""
FOLD = 32
"""XLA makes two loops of a minimum over more than so many numbers."""
LEAST_STEP = 0.15
"""Vertices stay so many beam spacings apart."""
ITERATIONS = 25
"""Of Levenberg-Marquardt, at most."""

LEFT, INSIDE, BEGIN, CORNER, END = range(5)
"""What a point is to a polyline: not covered, between vertices, or a vertex of one of three kinds."""


@pytree
class Sweep:
    """What the search has to know of the points, in the order of the sweep."""

    angle: Float[Array, " N"]
    """Angle from the first beam, growing, rad."""
    range: Float[Array, " N"]
    """Ranges, m."""
    weight: Float[Array, " N"]
    """Weight of a residual, 1/m."""
    price: Float[Array, " N"]
    """Price of leaving the point out."""
    follows: Bool[Array, " N"]
    """Whether a line may hold the point and the one before."""
    again: Bool[Array, " N"]
    """The last point of a ring, which is the first one once more, and counts as none."""
    valid: Bool[Array, " N"]
    """Which slots are in use."""


class _Start(NamedTuple):
    """A point where a line may start: at a vertex, on its beam."""

    place: Array  # in the sweep
    cos: Array  # of its angle
    sin: Array
    turn: Array  # tangent of the angle to the next point
    inverse: Array  # 1/r
    variance: Array  # of that, if the line begins there: of one point


class _Past(NamedTuple):
    """What stands before a start, by the number of vertices up to the end of the line that begins there."""

    begin: Array  # cost, if the line begins a polyline
    corner: Array  # cost, if it goes on from the line that ends at the start
    value: Array  # 1/r of that line there
    second: Array  # with a budget the variance of `value`; without one the derivative of 1/r by the angle


class _Fit(NamedTuple):
    """The recursive fit of the points behind a start: 1/r = u cos + t sin of the angle from the start."""

    u: Array
    t: Array
    huu: Array  # information
    hut: Array
    htt: Array
    det: Array  # of the information
    rss: Array  # sum of the squared residuals; infinite for a slot that holds no start, or a line that may not go on


def best_polyline(
    sweep: Sweep,
    vertex_price: Float[Array, ""],
    *,
    max_vertices: int | None,
    min_points: int,
    within: Int[Array, ""] | int | None = None,
) -> tuple[Int[Array, " N"], Float[Array, " N"], Float[Array, ""]]:
    """The cheapest polyline of a scan.

    Args:
      sweep: `N` points; those that are not valid stand last.
      vertex_price: of each vertex, where there is no budget.
      max_vertices: the budget; None prices the vertices instead.
      min_points: of each line, not counting the corner that it shares with the line before.
      within: a budget below `max_vertices`, for one program that serves several.

    Returns:
      What each point is: `LEFT`, `INSIDE`, `BEGIN`, `CORNER` or `END`; the inverse range of the vertices, 1/m; and the
      cost.
    """
    n, dtype = sweep.range.shape[0], sweep.range.dtype
    budget = max_vertices is not None
    width = max_vertices + 1 if budget else 1  # costs of at most so many vertices
    penalty = jnp.zeros((), dtype) if budget else jnp.asarray(vertex_price, dtype)
    infinite = jnp.asarray(jnp.inf, dtype)
    slot = jnp.arange(STARTS, dtype=jnp.int32)
    index = jnp.arange(n, dtype=jnp.int32)

    def later(rows: Array, by: int) -> Array:
        """Costs by the number of vertices, `by` vertices later."""
        return jnp.concatenate([jnp.full(by, jnp.inf, dtype), rows[:-by]]) if budget else rows + by * penalty

    def moved(rows: Array) -> Array:
        """What belongs to such costs, one vertex later."""
        return jnp.concatenate([rows[:1], rows[:-1]])

    inverse = 1 / jnp.where(sweep.valid, sweep.range, 1)
    weight = (sweep.weight * sweep.range**2) ** 2
    after = jnp.concatenate([sweep.angle[1:], sweep.angle[-1:]])
    points = _Start(
        place=index,
        cos=jnp.cos(sweep.angle),
        sin=jnp.sin(sweep.angle),
        turn=jnp.tan(after - sweep.angle),
        inverse=inverse,
        variance=1 / weight,
    )
    ordinal = index - sweep.again

    def step(carry: tuple, x: tuple) -> tuple[tuple, tuple]:
        start: _Start
        past: _Past
        fit: _Fit
        latest: _Past
        start, past, fit, latest, so_far, free = carry
        point: _Start
        point, ordinal, before, first, weight, follows, price, valid = x

        # The point before is one more start; the others see one more point.
        newest = slot == free
        c, s = _turn(start, point)
        fit = _observe(fit, c, s, point.inverse, weight)
        fit = fit._replace(rss=jnp.where(follows & ((c > 0) | (s > LEAST_SINE)), fit.rss, infinite))
        start, fit = (
            jax.tree.map(lambda new, old: jnp.where(newest, new, old), *pair)
            for pair in ((before, start), (first, fit))
        )
        past = jax.tree.map(lambda new, old: jnp.where(newest[None], new[:, None], old), latest, past)

        # What a line from each start to this point costs
        size = ordinal - start.place
        line, turn = _Fit(*(x[None] for x in fit)), start.turn[None]

        def coupled(value: Array, variance: Array) -> tuple[Array, Array]:
            """What the vertex adds, and whether it is in front of the scanner. Shape `[W, K]` or `[1, K]`."""
            total = variance * line.det + line.htt
            in_front = value * line.htt + line.u * variance * line.det > 0
            return (value - line.u) ** 2 * line.det / total, in_front

        def crossing(value: Array, slope: Array) -> tuple[Array, Array]:
            """The same of a corner where lines cross."""
            apart = value - line.u
            crosses = apart * (apart + (slope - line.t) * turn) <= 0
            return jnp.zeros_like(line.u), crosses & (line.u + line.t * turn > 0)

        def cost_of(past: Array, vertex: tuple[Array, Array], least: int) -> Array:
            return past + line.rss + jnp.where((size >= least)[None] & vertex[1], vertex[0], infinite)

        at_corner = (coupled if budget else crossing)(past.value, past.second)
        corner = cost_of(past.corner, at_corner, min_points)
        begin = cost_of(past.begin, coupled(start.inverse[None], start.variance[None]), min_points - 1)
        each = jnp.minimum(corner, begin)
        which, cost = _least(each)

        # The line of the cheapest past
        rows = jnp.arange(width)
        at, f = _Start(*(x[which] for x in start)), _Fit(*(x[which] for x in fit))
        is_corner = corner[rows, which] < begin[rows, which]
        value = jnp.where(is_corner, past.value[rows, which] if budget else f.u, at.inverse)
        variance = jnp.where(is_corner, past.second[rows, which], at.variance) if budget else at.variance
        c, s = _turn(at, point)
        total = variance * f.det + f.htt
        total = jnp.where(total > 0, total, 1)
        u = (value * f.htt + f.u * variance * f.det) / total
        t = f.t - f.hut / jnp.where(f.htt > 0, f.htt, 1) * (u - f.u)
        here = u * c + t * s
        if budget:
            spread = jnp.maximum(f.htt * c * c - 2 * f.hut * c * s + f.huu * s * s, 0)
            second = (spread * variance + s * s) / total
        else:
            second = t * c - u * s
        can_be = (cost < infinite) & (here > 0) & valid
        # Nothing is known of a line that cannot be.
        here, second = (jnp.where(can_be, y, 1) for y in (here, second))
        end = jnp.where(can_be, cost, infinite)
        latest = _Past(begin=later(so_far, 2), corner=later(end, 1), value=moved(here), second=moved(second))

        left = so_far + jnp.where(valid, price, 0)
        is_end = end < left
        so_far = jnp.minimum(end, left)

        # The next start takes the place of the one that promises least: its lines are dearer than the best ones, and
        # the longer that is so, the less is there a corner.
        excess = jnp.min(jnp.where(cost[:, None] < infinite, each - cost[:, None], infinite), 0)
        excess = jnp.where(size < min_points, 0, excess) + penalty / 3 * jnp.log(size.astype(dtype))
        promise = _in_order(jnp.where(fit.rss < infinite, excess, infinite))
        free = _minimum(jnp.where(promise == -_minimum(-promise), slot, STARTS))
        return (start, past, fit, latest, so_far, free), (4 * at.place + 2 * is_corner + is_end, here)

    zero = jnp.zeros(STARTS, dtype)
    one = jnp.ones((width, STARTS), dtype)
    fits = _first_fit(points, weight)
    fits = fits._replace(rss=jnp.where(sweep.follows & (index > 0), fits.rss, infinite))
    carry = (
        _Start(*[zero] * 6)._replace(place=jnp.zeros(STARTS, jnp.int32)),
        _Past(*[one] * 4),
        _Fit(*[zero] * 7)._replace(rss=zero + infinite),
        _Past(*[one[:, 0]] * 4),
        jnp.zeros(width, dtype),
        jnp.zeros((), jnp.int32),
    )
    before = jax.tree.map(one_before, points)
    xs = (points, ordinal, before, fits, weight, sweep.follows, sweep.price, sweep.valid)
    values: Array
    (*_, so_far, _), (choices, values) = jax.lax.scan(step, carry, xs)
    vertices = jnp.asarray((max_vertices if within is None else within) if budget else 0, jnp.int32)
    kind, which = _walked_back(choices, vertices, budget=budget)
    kind = jnp.where(sweep.valid, kind, LEFT)
    return kind, jnp.where(kind == BEGIN, inverse, values[index, which]), so_far[vertices]


def _walked_back(
    choices: Int[Array, "N W"], vertices: Int[Array, ""], *, budget: bool
) -> tuple[Int[Array, " N"], Int[Array, " N"]]:
    """What each point is to the cheapest polyline, and how many vertices there are up to it.

    Args:
      choices: by the number of vertices, four times where the cheapest line to the point starts; 2 more if that is a
        corner; 1 more if the cheapest polyline up to the point ends with that line.
      vertices: how many there may be.
      budget: whether they are counted.
    """

    def step(carry: tuple, x: tuple) -> tuple[tuple, tuple]:
        vertices, in_chain, goal, goal_joined = carry
        index, choice = x
        ends = ~in_chain & (choice[vertices] % 2 > 0)
        at_goal = in_chain & (index == goal)
        at_corner, at_begin = at_goal & goal_joined, at_goal & ~goal_joined
        kind = jnp.where(in_chain, INSIDE, LEFT)
        kind = jnp.where(ends, END, jnp.where(at_corner, CORNER, jnp.where(at_begin, BEGIN, kind)))
        here = vertices - (at_corner if budget else 0)
        line, renew = choice[here], ends | at_corner
        goal = jnp.where(renew, line // 4, goal)
        goal_joined = jnp.where(renew, line // 2 % 2 > 0, goal_joined)
        before = here - (2 * at_begin if budget else 0)
        return (before, (in_chain | ends) & ~at_begin, goal, goal_joined), (kind.astype(jnp.int32), here)

    carry = (vertices, jnp.zeros((), bool), jnp.zeros((), jnp.int32), jnp.zeros((), bool))
    index = jnp.arange(choices.shape[0], dtype=jnp.int32)
    return jax.lax.scan(step, carry, (index, choices), reverse=True)[1]


def _turn(start: _Start, point: _Start) -> tuple[Array, Array]:
    """Cosine and sine of the angle from one to the other."""
    return start.cos * point.cos + start.sin * point.sin, start.cos * point.sin - start.sin * point.cos


def _least(cost: Float[Array, "W K"]) -> tuple[Int[Array, " W"], Float[Array, " W"]]:
    """Where in each row the least cost stands, and that cost."""
    bits = _in_order(cost)
    least = _minimum(bits)
    which = jnp.where(bits == least[:, None], jnp.arange(STARTS, dtype=jnp.int32)[None], STARTS)
    return _minimum(which), jax.lax.bitcast_convert_type(least, cost.dtype)


def _minimum(numbers: Int[Array, "*s K"]) -> Int[Array, "*s"]:
    """The least of each row."""
    return jnp.min(functools.reduce(jnp.minimum, jnp.split(numbers, STARTS // FOLD, -1)), -1)


def _in_order(cost: Float[Array, "*s"]) -> Int[Array, "*s"]:
    """Whole numbers in the order of costs, which are not negative: XLA finds the least of them ten times sooner."""
    return jax.lax.bitcast_convert_type(cost, jnp.int32 if cost.dtype == jnp.float32 else jnp.int64)


def _first_fit(points: _Start, weight: Float[Array, " N"]) -> _Fit:
    """For each point the fit of it alone, as the point before sees it: a line across its beam."""
    c, s = _turn(jax.tree.map(one_before, points), points)
    u, t = points.inverse * c, points.inverse * s
    zero = jnp.zeros_like(weight)
    return _Fit(u=u, t=t, huu=weight * c * c, hut=weight * c * s, htt=weight * s * s, det=zero, rss=zero)


def _observe(fit: _Fit, c: Array, s: Array, inverse: Array, weight: Array) -> _Fit:
    """One more point for the fits of all starts."""
    to_u, to_t = fit.htt * c - fit.hut * s, fit.huu * s - fit.hut * c
    det = fit.det + weight * jnp.maximum(to_u * c + to_t * s, 0)
    innovation = inverse - (fit.u * c + fit.t * s)
    gain = weight * innovation / jnp.where(det > 0, det, 1)
    return _Fit(
        u=fit.u + gain * to_u,
        t=fit.t + gain * to_t,
        huu=fit.huu + weight * c * c,
        hut=fit.hut + weight * c * s,
        htt=fit.htt + weight * s * s,
        det=det,
        rss=fit.rss + gain * innovation * fit.det,
    )


@pytree
class Polyline:
    """Vertices of a polyline in `V` slots, in the order of the sweep; chains of them are lines."""

    angle: Float[Array, " V"]
    """Angle from the first point, rad."""
    inverse: Float[Array, " V"]
    """1/r there, 1/m."""
    valid: Bool[Array, " V"]
    """Which slots are in use."""
    is_begin: Bool[Array, " V"]
    """Whether no line is before."""
    is_end: Bool[Array, " V"]
    """Whether no line is behind."""


def refine(
    line: Polyline,
    angle: Float[Array, " N"],
    range_: Float[Array, " N"],
    covered: Bool[Array, " N"],
    spacing: Float[Array, ""],
    ring: Bool[Array, ""],
) -> tuple[Polyline, Float[Array, ""]]:
    """Move the vertices to where the sum of the squared residuals r - r_line is least: Levenberg-Marquardt.

    Ends stay on their beams; corners move along and across theirs.

    Args:
      line: the polyline to start from.
      angle: of the points, rad.
      range_: of the points, m.
      covered: the points that a line covers.
      spacing: between neighbouring beams, rad.
      ring: whether the last vertex is the first one again, a turn later.

    Returns:
      The polyline, and the sum of its squared residuals, m^2.
    """
    v = line.valid.shape[0]
    dtype = range_.dtype
    slots = jnp.arange(v, dtype=jnp.int32)
    last = jnp.sum(line.valid) - 1
    turn = jnp.asarray(2 * jnp.pi, dtype)
    has_line = line.valid & ~line.is_end
    tied = ring & (slots == last)
    free_value = line.valid & ~tied
    free_angle = line.valid & ~tied & (~(line.is_begin | line.is_end) | (ring & (slots == 0)))
    free = jnp.concatenate([free_value, free_angle])

    def residuals(b: Array, u: Array) -> tuple[Array, Array, Array]:
        """Residuals, the Jacobian of the ranges of the lines by (inverse, angle) of all vertices, and if it is one."""
        phi = jnp.where(ring, b[0] + jnp.mod(angle - b[0], turn), angle)
        before = jnp.sum((b[None] <= phi[:, None]) & line.valid[None], 1) - 1
        before = jnp.clip(before, 0, v - 2)
        before = jnp.where(line.is_end[before], jnp.maximum(before - 1, 0), before)
        first, second = before[:, None] == slots[None], before[:, None] + 1 == slots[None]
        b1, b2, u1, u2 = b[before], b[before + 1], u[before], u[before + 1]
        between = jnp.sin(b2 - b1)
        between = jnp.where(covered & (between > 0), between, 1)
        s1, s2 = jnp.sin(b2 - phi), jnp.sin(phi - b1)
        top = u1 * s1 + u2 * s2
        rho = top / between
        ahead = covered & (rho > 0)
        far = jnp.where(ahead, 1 / jnp.where(ahead, rho, 1), 0)
        scale = jnp.where(covered, -far * far / between, 0)
        by_u1, by_u2 = scale * s1, scale * s2
        by_b1 = scale * (rho * jnp.cos(b2 - b1) - u2 * jnp.cos(phi - b1))
        by_b2 = scale * (u1 * jnp.cos(b2 - phi) - rho * jnp.cos(b2 - b1))

        def columns(one: Array, two: Array) -> Array:
            jac = first * one[:, None] + second * two[:, None]
            # The last vertex of a ring is the first one.
            jac = jac.at[:, 0].add(jnp.where(ring, jac[:, last], 0))
            return jac

        jac = jnp.concatenate([columns(by_u1, by_u2), columns(by_b1, by_b2)], 1)
        step = jnp.concatenate([b[1:], b[-1:]]) - b
        good = jnp.all(jnp.where(has_line, (step > LEAST_STEP * spacing) & (step < MOST_ANGLE), True))
        good &= jnp.all(jnp.where(covered, rho > 0, True)) & jnp.all(jnp.where(line.valid, u > 0, True))
        return jnp.where(covered, range_ - far, 0), jnp.where(free[None], jac, 0), good

    class State(NamedTuple):
        b: Array
        u: Array
        cost: Array
        damping: Array
        rounds: Array

    def close(x: Array, by: Array | float) -> Array:
        return jnp.where(tied, x[0] + by, x)

    def go_on(state: State) -> Array:
        return state.rounds < ITERATIONS

    def improve(state: State) -> State:
        residual, jac, _ = residuals(state.b, state.u)
        size = jnp.sqrt(jnp.sum(jac * jac, 0))
        size = jnp.where(size > 0, size, 1)
        jac = jac / size[None]
        normal = jac.T @ jac + state.damping * jnp.eye(2 * v, dtype=dtype)
        # What is held fast has columns of zeros, and does not move.
        change = jnp.linalg.solve(normal, jac.T @ residual) / size
        u, b = close(state.u + change[:v], 0), close(state.b + change[v:], turn)
        after, _, good = residuals(b, u)
        cost = jnp.sum(after**2)
        better = good & (cost < state.cost)
        gained = jnp.where(better, state.cost - cost, jnp.inf)
        done = gained < 1e-4 * state.cost
        return State(
            b=jnp.where(better, b, state.b),
            u=jnp.where(better, u, state.u),
            cost=jnp.where(better, cost, state.cost),
            damping=jnp.clip(jnp.where(better, state.damping / 10, state.damping * 8), 1e-6, 1e6),
            rounds=jnp.where(done, ITERATIONS, state.rounds + 1),
        )

    b, u = close(line.angle, turn), close(line.inverse, 0)
    start, _, good = residuals(b, u)
    cost = jnp.where(good, jnp.sum(start**2), jnp.inf)
    state = State(b=b, u=u, cost=cost, damping=jnp.asarray(1e-3, dtype), rounds=jnp.zeros((), jnp.int32))
    state = jax.lax.while_loop(go_on, improve, state)
    return dataclasses.replace(line, angle=state.b, inverse=state.u), state.cost
