"""Polylines through a sweep of ranges: the best one by dynamic programming, then vertices off the beams.

Seen from the scanner a line is linear in the inverse range, 1/r = u cos(phi) + t sin(phi), so that the residual of a
range is, to first order, r - r^2 (u cos(phi) + t sin(phi)): the most likely line of a run is a linear least-squares
fit. A polyline is continuous in 1/r, with vertices on the beams. What it costs is the sum of its squared residuals, a
price for each vertex (or none, where their number is given), and a price for each point that no line covers; a corner
that two lines share is one vertex.

`best_polyline` visits the beams in order. For a polyline that has a vertex at a beam, what its past says of the inverse
range there is one quadratic; that of the cheapest past is kept, for each number of vertices, and the next line starts
from it. Of lines that share no corner this finds the best ones (optimal partitioning, Jackson et al. 2005). A shared
corner couples lines, and a past that is not the cheapest may win in the end; Fearnhead, Maidstone and Letchford (2019)
keep all that can. To keep one is what makes the search quick, and what it costs is tested.

`refine` moves the vertices off their beams and takes the residuals as they are: Levenberg-Marquardt.

In float32 the sums of r^4 lose the residuals. So each start of a line keeps a recursive least-squares fit, whose
residual sum grows by squares, and whose determinant by terms that are not negative.
"""

import dataclasses
from typing import NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int

from linemap_jax.core.state import pytree

MOST_ANGLE = 3.0
"""Largest angle that one line spans, rad: below half a turn."""
LEAST_STEP = 0.15
"""Vertices stay so many beam spacings apart."""
ITERATIONS = 25
"""Of Levenberg-Marquardt, at most."""

LEFT, INSIDE, BEGIN, CORNER, END = range(5)
"""What a point is to a polyline: not covered, between vertices, or a vertex of one of three kinds."""


@pytree
class Sweep:
    """What the search has to know of the points, in the order of the sweep."""

    angle: Float[Array, " N"]  # rad, from the first beam, growing
    range: Float[Array, " N"]  # m
    weight: Float[Array, " N"]  # of a residual, 1/m
    price: Float[Array, " N"]  # of leaving the point out
    follows: Bool[Array, " N"]  # a line may hold the point and the one before
    counts: Float[Array, " N"]  # 1, or 0 for what is a point only by name
    valid: Bool[Array, " N"]


class _Fit(NamedTuple):
    """For each start, the recursive fit of the points behind it: 1/r = u cos + t sin of the angle from the start."""

    u: Array
    t: Array
    huu: Array  # information
    hut: Array
    htt: Array
    det: Array  # of the information
    rss: Array
    size: Array  # points
    alive: Array  # 1 while nothing has broken the line


def best_polyline(
    sweep: Sweep,
    tangent_weight: Float[Array, ""],
    vertex_price: Float[Array, ""],
    *,
    max_vertices: int | None,
    min_points: int,
    within: Int[Array, ""] | int | None = None,
) -> tuple[Int[Array, " N"], Float[Array, " N"], Float[Array, ""]]:
    """The cheapest polyline of a scan.

    Args:
      sweep: `N` points; those that are not valid stand last.
      tangent_weight: bearing sigma / range sigma; a residual's variance grows by the square of this times the range
        times the tangent of the incidence.
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
    width = max_vertices + 1 if budget else 1
    penalty = jnp.zeros((), dtype) if budget else jnp.asarray(vertex_price, dtype)
    infinite = jnp.asarray(jnp.inf, dtype)
    index = jnp.arange(n, dtype=jnp.int32)
    inverse = 1 / jnp.where(sweep.valid, sweep.range, 1)
    own = (sweep.weight * sweep.range**2) ** 2

    def later(rows: Array, by: int) -> Array:
        """Costs by the number of vertices, `by` vertices later."""
        if not budget:
            return rows + by * penalty
        return jnp.concatenate([jnp.full_like(rows[..., :by], jnp.inf), rows[..., :-by]], -1)

    def body(carry: tuple, x: tuple) -> tuple[tuple, tuple]:
        fit: _Fit = carry[0]
        prior_a: Array
        prior_u: Array
        prior_a, prior_u, prior_c, open_c = carry[1:]
        j, angle, range_, inverse_j, weight, price, follows, counts, valid = x
        # The lines that hold this point
        span = angle - sweep.angle
        before = index < j
        alive = jnp.where(before & follows & (span < MOST_ANGLE), fit.alive, 0)
        fit = fit._replace(alive=jnp.where(index == j, 1, alive).astype(dtype))
        fit = _observe(fit, jnp.cos(span), jnp.sin(span), range_, inverse_j, weight, tangent_weight, counts, before)
        # The information on u that the points give, whatever 1/r is here
        s = fit.det / jnp.where(fit.htt > 0, fit.htt, 1)
        usable = before & (alive > 0)

        def joined(a: Array, u: Array, least: int) -> Array:
            """What lines from starts with some quadratic a (1/r - u)^2 cost. Shape `[N, W]`."""
            s_, u_ = s[:, None], fit.u[:, None]
            ok = (usable & (fit.size >= least))[:, None] & (a * u + s_ * u_ > 0)
            total: Array = a + s_
            cost: Array = fit.rss[:, None] + a * s_ / jnp.where(total > 0, total, 1) * (u - u_) ** 2
            return jnp.where(ok, cost, infinite)

        corner = prior_c + joined(prior_a, prior_u, min_points)
        fresh = open_c[:n] + joined(own[:, None], inverse[:, None], min_points - 1)
        corner_least, fresh_least = later(jnp.min(corner, 0), 1), later(jnp.min(fresh, 0), 2)

        def where_least(cost: Array) -> Array:
            return jnp.min(jnp.where(cost == jnp.min(cost, 0)[None], index[:, None], n - 1), 0)

        def moved(which: Array, by: int) -> Array:
            return which if not budget else jnp.concatenate([jnp.zeros_like(which[:by]), which[:-by]])

        is_corner = corner_least < fresh_least
        start = jnp.where(is_corner, moved(where_least(corner), 1), moved(where_least(fresh), 2))
        cost = jnp.minimum(corner_least, fresh_least)
        # The quadratic that the cheapest past leaves
        lane = jnp.maximum(jnp.arange(width) - 1, 0)
        a0: Array = jnp.where(is_corner, prior_a[start, lane], own[start])
        u0: Array = jnp.where(is_corner, prior_u[start, lane], inverse[start])
        f = _Fit(*(z[start] for z in fit))
        c, z = jnp.cos(span[start]), jnp.sin(span[start])
        s0 = s[start]
        u = (a0 * u0 + s0 * f.u) / jnp.where(a0 + s0 > 0, a0 + s0, 1)
        t = f.t - f.hut / jnp.where(f.htt > 0, f.htt, 1) * (u - f.u)
        spread = jnp.maximum(f.htt * c * c - 2 * f.hut * c * z + f.huu * z * z, 0) + a0 * z * z
        a = (f.det + a0 * f.htt) / jnp.where(spread > 0, spread, 1)
        here = u * c + t * z
        cost = jnp.where((here > 0) & (spread > 0) & valid, cost, infinite)
        # Nothing is known of a line that cannot be.
        here, a = (jnp.where(jnp.isfinite(cost), y, 1) for y in (here, a))

        prior_a, prior_u, prior_c = (
            jax.lax.dynamic_update_index_in_dim(old, new, j, 0)
            for old, new in ((prior_a, a), (prior_u, here), (prior_c, cost))
        )
        left = open_c[j] + jnp.where(valid, price, 0)
        is_end = cost < left
        open_c = jax.lax.dynamic_update_index_in_dim(open_c, jnp.minimum(cost, left), j + 1, 0)
        return (fit, prior_a, prior_u, prior_c, open_c), (start, is_corner, is_end, here)

    zero = jnp.zeros(n, dtype)
    nothing = jnp.zeros((n, width), dtype)
    open_c = jnp.full((n + 1, width), infinite).at[0, 0].set(0)
    carry = (_Fit(*[zero] * 9), nothing, nothing, nothing + infinite, open_c)
    s = sweep
    xs = (index, s.angle, s.range, inverse, s.weight, s.price, s.follows, s.counts, s.valid)
    (_, _, _, _, open_c), choices = jax.lax.scan(body, carry, xs)

    # With a budget, the cheapest number of vertices within it
    allowed = jnp.arange(width) <= (width if within is None else within)
    best = jnp.argmin(jnp.where(allowed, open_c[n], jnp.inf)).astype(jnp.int32)

    def back(carry: tuple, x: tuple) -> tuple[tuple, tuple]:
        vertices, in_chain, goal, goal_joined = carry
        j, start, is_corner, is_end, value = x
        ends = ~in_chain & is_end[vertices]
        at_goal = in_chain & (j == goal)
        at_corner, at_begin = at_goal & goal_joined, at_goal & ~goal_joined
        kind = jnp.where(in_chain, INSIDE, LEFT)
        kind = jnp.where(ends, END, jnp.where(at_corner, CORNER, jnp.where(at_begin, BEGIN, kind)))
        one = 1 if budget else 0
        vertices = vertices - one * at_corner
        renew = ends | at_corner
        goal = jnp.where(renew, start[vertices], goal)
        goal_joined = jnp.where(renew, is_corner[vertices], goal_joined)
        worth = value[vertices]
        vertices = vertices - 2 * one * at_begin
        return (vertices, (in_chain | ends) & ~at_begin, goal, goal_joined), (kind, worth)

    carry = (best, jnp.zeros((), bool), jnp.zeros((), jnp.int32), jnp.zeros((), bool))
    kind: Array
    worth: Array
    _, (kind, worth) = jax.lax.scan(back, carry, (index, *choices), reverse=True)
    kind = jnp.where(sweep.valid, kind, LEFT).astype(jnp.int32)
    return kind, jnp.where(kind == BEGIN, inverse, worth), open_c[n, best]


def _observe(
    fit: _Fit,
    c: Array,
    s: Array,
    range_: Array,
    inverse: Array,
    weight: Array,
    tangent_weight: Array,
    counts: Array,
    which: Array,
) -> _Fit:
    """One more point for the fits of some starts."""
    predicted, turned = fit.u * c + fit.t * s, fit.t * c - fit.u * s
    # A line through one point has no direction yet.
    tangent = jnp.where(fit.size > 1, turned / jnp.where(predicted > 0, predicted, 1), 0)
    variance = 1 + jnp.where(predicted > 0, (tangent_weight * range_ * tangent) ** 2, 0)
    w2 = (weight * range_ * range_) ** 2 / variance
    q = jnp.maximum(fit.htt * c * c - 2 * fit.hut * c * s + fit.huu * s * s, 0)
    det = fit.det + w2 * q
    first = fit.huu + fit.htt == 0
    safe = jnp.where(det > 0, det, 1)
    innovation = inverse - predicted
    step = w2 * innovation / safe
    new = _Fit(
        u=jnp.where(first, inverse / jnp.where(c > 0, c, 1), fit.u + step * (fit.htt * c - fit.hut * s)),
        t=jnp.where(first, 0, fit.t + step * (fit.huu * s - fit.hut * c)),
        huu=fit.huu + w2 * c * c,
        hut=fit.hut + w2 * c * s,
        htt=fit.htt + w2 * s * s,
        det=det,
        rss=fit.rss + jnp.where(first, 0, w2 * innovation**2 * fit.det / safe),
        size=fit.size + counts,
        alive=fit.alive,
    )
    return _Fit(*(jnp.where(which, a, b) for a, b in zip(new, fit, strict=True)))


@pytree
class Polyline:
    """Vertices of a polyline in `V` slots, in the order of the sweep; chains of them are lines."""

    angle: Float[Array, " V"]  # rad, from the first point
    inverse: Float[Array, " V"]  # 1/m
    valid: Bool[Array, " V"]
    is_begin: Bool[Array, " V"]  # no line before
    is_end: Bool[Array, " V"]  # no line behind


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
