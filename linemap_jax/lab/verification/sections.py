"""What the paper says in words, section by section: held against NumPy, or shown where it does not hold."""

import dataclasses
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from linemap_jax.core import fusion, lines, matching, wiping
from linemap_jax.core.sensor import Points
from linemap_jax.core.settings import PAPER_RULES, PAPER_THRESHOLDS, Rules, Thresholds
from linemap_jax.core.state import Circles, Lines, Pose
from linemap_jax.lab.verification.rows import Check, Row, most, turn
from linemap_jax.lab.verification.sample import COV_POSE, POSE, SIZE, WALLS, Sample


def rows(sample: Sample) -> tuple[Row, ...]:
    """A row for each section that says something in words, from the walls of a `sample`."""
    return (
        _distance(sample),
        _end_points(sample),
        _gates(sample),
        _new_end_points(sample),
        _gate_of_circles(),
        _triangle(sample),
        _stretches(sample),
    )


def _distance(sample: Sample) -> Row:
    position = _positions(sample)
    rho, theta = np.asarray(sample.rho)[:, None], np.asarray(sample.theta)[:, None]
    by_1 = np.abs(position[..., 0] * np.cos(theta) + position[..., 1] * np.sin(theta) - rho)
    along = np.asarray(sample.end - sample.begin)
    from_begin = position - np.asarray(sample.begin)[:, None]
    across = along[:, None, 0] * from_begin[..., 1] - along[:, None, 1] * from_begin[..., 0]
    steep = np.asarray(sample.fit.steep)
    return Row(
        equation="s4.2.3",
        title="distance of a point from the line",
        where=(lines.rho_theta,),
        verdict="erratum",
        sentence='Sends to "the second condition of section 4.2.2", which is N_1 < N_2. Criterion 2 is meant, in the '
        "section 4.3.1 on lines; 4.3 and 4.3.1 stand twice, the second time for circles.",
        checks=(
            Check("by (1) against the end points, m", most(by_1 - np.abs(across) / np.hypot(*along.T)[:, None])),
            Check("lines without a point, to the letter, as a share", float(np.mean(~steep)), 0.1, differs=True),
        ),
    )


def _end_points(sample: Sample) -> Row:
    ends = _positions(sample)[:, [0, -1]]
    normal = np.stack([np.cos(sample.theta), np.sin(sample.theta)], -1)[:, None]
    distance = np.sum(normal * ends, -1) - np.asarray(sample.rho)[:, None]
    by_numpy = ends - distance[..., None] * normal
    return Row(
        equation="s4.2.4",
        title="begin and end point of a line",
        where=(lines.line_extent,),
        verdict="exact",
        sentence="The first and the last point, projected. Held as places along the line, so that they lie on it; and "
        "with a variance, which the paper does not give.",
        checks=(Check("against NumPy, m", most(np.stack([sample.begin, sample.end], 1) - by_numpy)),),
    )


def _gates(sample: Sample) -> Row:
    new, random = sample.exact, np.random.default_rng(3)
    shift = random.uniform(-2, 2, WALLS)
    model = dataclasses.replace(
        new,
        angle=new.angle + random.normal(0, 0.1, WALLS),
        offset=new.offset + random.normal(0, 0.1, WALLS),
        extent=new.extent + shift[:, None],
    )
    compare = jax.jit(jax.vmap(lambda a, b: matching.compare_lines(a, b, PAPER_THRESHOLDS, "independent")))
    pair = jax.tree.map(np.asarray, compare(new, model))

    normal, tangent = (np.stack([np.cos(a), np.sin(a)], -1)[:, None] for a in (model.angle, model.angle + np.pi / 2))
    from_anchor = np.stack([sample.begin, sample.end], 1) - np.asarray(model.anchor)[:, None]
    across = np.sum(normal * from_anchor, -1) - np.asarray(model.offset)[:, None]
    along = np.sum(tangent * from_anchor, -1)
    gap = np.maximum(np.min(along, 1) - model.extent[:, 1], model.extent[:, 0] - np.max(along, 1))
    by_angle = np.abs(turn(new.angle, model.angle)) < PAPER_THRESHOLDS.match_angle
    near = by_angle & np.all(np.abs(across) < PAPER_THRESHOLDS.match_distance, 1)
    return Row(
        equation="s5.1.1",
        title="gates on angle, end points and gap",
        where=(matching.compare_lines,),
        verdict="exact",
        sentence="Here: the angle wrapped, both end points of the new line against the boundless line of the map, and "
        "the gap between the two along it, negative where they overlap. By default the first two widen with the "
        "predicted spread.",
        checks=(
            Check("gap against NumPy, m", most(pair.gap - gap)),
            Check("pairs otherwise judged by angle and end points", int(np.sum(pair.collinear != near)), 0),
            Check(
                "pairs otherwise judged by all three",
                int(np.sum(pair.geometric != (near & (gap < PAPER_THRESHOLDS.match_gap)))),
                0,
            ),
        ),
    )


def _new_end_points(sample: Sample) -> Row:
    count, random = 8, np.random.default_rng(4)
    new: Lines = jax.tree.map(lambda x: x[:count], sample.exact)
    model = dataclasses.replace(
        new,
        offset=new.offset + random.normal(0, 0.01, count),
        angle=new.angle + random.normal(0, 0.01, count),
        extent=new.extent + random.uniform(-0.3, 0.3, (count, 2)),
    )

    @jax.jit
    def fuse(model: Lines, new: Lines) -> tuple[Lines, Any]:
        alone = jnp.eye(count, dtype=bool)
        every = jnp.ones(count, bool)
        fused = fusion.fuse_lines(model, every, new, alone, PAPER_THRESHOLDS, PAPER_RULES, "independent")
        return fused, fused.tangent

    fused, tangent = jax.tree.map(np.asarray, fuse(model, new))
    ends = np.stack([sample.begin, sample.end], 1)[:count]
    along = np.sum(tangent[:, None] * (ends - fused.anchor[:, None]), -1)
    longest = np.stack([np.minimum(model.extent[:, 0], along.min(1)), np.maximum(model.extent[:, 1], along.max(1))], -1)
    growth = np.mean(np.max(random.normal(size=(2000, 50)), 1))
    return Row(
        equation="s5.1.2",
        title="end points after a match",
        where=(fusion.fuse_lines,),
        verdict="assumption",
        sentence="Takes end points for free of noise: they are replaced whenever that makes the line longer, and in 50 "
        "scans move by more than two sigmas of one view. By default they are estimated.",
        checks=(
            Check("the rule of `paper` against NumPy, m", most(fused.extent - longest)),
            Check("how far an end has moved after 50 scans, in sigmas of one", float(growth), 0.1, differs=True),
        ),
    )


def _gate_of_circles() -> Row:
    random = np.random.default_rng(5)
    new, model = (_poles(random.uniform(0, 2, (12, 2))) for _ in range(2))
    pair, beside = _poles(np.zeros((1, 2))), _poles(np.array([[0.25, 0.0]]))

    def match(new: Circles, model: Circles, thresholds: Thresholds, rules: Rules) -> matching.CircleMatches:
        program = jax.jit(lambda a, b: matching.match_circles(a, b, thresholds, rules, "independent"))
        return jax.tree.map(np.asarray, program(new, model))

    found = match(new, model, PAPER_THRESHOLDS, PAPER_RULES)
    distance = np.linalg.norm(new.center[:, None] - np.asarray(model.center)[None], axis=-1)
    nearest = np.argmin(distance, 1)
    slot = np.where(distance.min(1) < PAPER_THRESHOLDS.circle_match_distance, nearest, -1)
    as_paper = match(pair, beside, PAPER_THRESHOLDS, PAPER_RULES).slot
    by_default = match(pair, beside, Thresholds(), Rules()).slot
    return Row(
        equation="s5.2.1",
        title="gate on the centres of circles",
        where=(matching.match_circles,),
        verdict="assumption",
        sentence="Takes what is nearer than d_critcc for one thing: two poles 25 cm apart become one. By default "
        "fitted circles must agree within their covariances too.",
        checks=(
            Check("distance against NumPy, m", most(found.distance - np.where(slot < 0, 0, distance.min(1)))),
            Check("circles otherwise matched", int(np.sum(found.slot != slot)), 0),
            Check("poles 25 cm apart that are one by default", int(np.sum(by_default >= 0)), 0),
            Check("distance of two poles that are one, m", 0.25 * float(as_paper[0] >= 0), 0.1, differs=True),
        ),
    )


def _poles(center: np.ndarray) -> Circles:
    """Poles of 10 cm, known to 1 cm."""
    count = len(center)
    return Circles(
        center=jnp.asarray(center),
        radius=jnp.full(count, 0.1),
        cov_independent=jnp.asarray(np.tile(np.eye(3) * 1e-4, (count, 1, 1))),
        sqrt_persistent=jnp.zeros((count, 3, 3)),
        fitted=jnp.ones(count, bool),
        times_detected=jnp.ones(count, jnp.int32),
        times_contradicted=jnp.zeros(count, jnp.int32),
        valid=jnp.ones(count, bool),
    )


def _triangle(sample: Sample) -> Row:
    # The map holds lines three times as long as what the scan has seen of them.
    model = dataclasses.replace(sample.exact, extent=3 * sample.exact.extent)
    pose = Pose(mean=jnp.asarray(POSE), cov=jnp.asarray(COV_POSE))

    @jax.jit
    def span(points: Points, model: Lines) -> tuple[wiping.Triangles, Any, Any]:
        slots = jnp.arange(WALLS, dtype=jnp.int32)
        return wiping.triangles_of_scan(points, pose, model, slots, PAPER_THRESHOLDS), model.begin, model.end

    found, begin, end = jax.tree.map(np.asarray, span(sample.points, model))
    apex = POSE[:2] + found.apex
    rays = np.stack([begin, end], 1) - apex
    base = rays[:, 1] - rays[:, 0]
    area = rays[:, 0, 0] * rays[:, 1, 1] - rays[:, 0, 1] * rays[:, 1, 0]
    across = np.abs(area) / np.hypot(*base.T)
    behind = rays * (1 + PAPER_THRESHOLDS.wipe_extension / across)[:, None, None]
    corners = np.where((area > 0)[:, None, None], behind, behind[:, ::-1])
    seen = np.linalg.norm(sample.end - sample.begin, axis=-1) / np.hypot(*base.T)
    return Row(
        equation="s6.2",
        title="the wipe-triangle",
        where=(wiping.triangles_of_scan,),
        verdict="assumption",
        sentence="Takes the whole line of the map for seen, though this scan may have seen a piece. Its base lies "
        "`wipe_extension` behind the line. By default beams wipe, each as far as it went.",
        checks=(
            Check("corners against NumPy, m", most(np.stack([found.first, found.second], 1) - corners)),
            Check("share of the base that was not seen", 1 - float(np.max(seen)), 0.1, differs=True),
        ),
    )


def _stretches(sample: Sample) -> Row:
    count, random = 24, np.random.default_rng(6)
    some: Lines = jax.tree.map(lambda x: x[:count], sample.exact)
    line = dataclasses.replace(
        some,
        anchor=POSE[:2] + random.uniform(-3, 3, (count, 2)),
        extent=some.extent * random.uniform(0.5, 4, (count, 1)),
    )
    towards, reach = random.uniform(-np.pi, np.pi, count), random.uniform(1, 5, (count, 2, 1))
    sides = np.stack([towards, towards + random.uniform(0.1, 2, count)], -1)
    corners = reach * np.stack([np.cos(sides), np.sin(sides)], -1)
    triangles = wiping.Triangles(
        first=jnp.asarray(corners[:, 0]),
        second=jnp.asarray(corners[:, 1]),
        own=jnp.full(count, -1, jnp.int32),
        valid=jnp.ones(count, bool),
        apex=jnp.array([0.2, -0.1]),
        robot=jnp.asarray(POSE[:2]),
    )

    @jax.jit
    def cut(lines: Lines) -> tuple[Any, Any, Any]:
        slots = jnp.arange(count, dtype=jnp.int32)
        found = jax.vmap(lambda line, slot: wiping.inside_triangles(line, slot, triangles))(lines, slots)
        return found, lines.anchor + lines.offset[:, None] * lines.normal, lines.tangent

    (low, high, there), foot, tangent = jax.tree.map(np.asarray, cut(line))
    apex = POSE[:2] + np.asarray(triangles.apex)
    by_numpy = np.array(
        [
            [_inside(foot[i], tangent[i], line.extent[i], np.stack([apex, *(apex + corners[j])])) for j in range(count)]
            for i in range(count)
        ]
    )
    both = there & ~np.isnan(by_numpy[..., 0])
    return Row(
        equation="s6.3",
        title="what of a line lies in a triangle",
        where=(wiping.inside_triangles, wiping.wipe_lines),
        verdict="exact",
        sentence="The four cases are one: the stretch inside goes, and what is left of the line is none, one or two "
        "pieces, of which the short ones go too.",
        checks=(
            Check("begin and end against NumPy, m", most(np.stack([low, high], -1)[both] - by_numpy[both])),
            Check("lines otherwise judged", int(np.sum(there == np.isnan(by_numpy[..., 0]))), 0),
        ),
    )


def _inside(foot: np.ndarray, tangent: np.ndarray, extent: Any, corners: np.ndarray) -> tuple[float, float]:
    """Begin and end of what of a segment lies in a triangle, by the points where it crosses the sides; or NaN."""
    begin, end = (float(x) for x in extent)
    sides = [(corners[i], corners[(i + 1) % 3] - corners[i]) for i in range(3)]
    places = []
    for corner, side in sides:
        along, on_side = np.linalg.solve(np.stack([tangent, -side], -1), corner - foot)
        if 0 <= on_side <= 1 and begin <= along <= end:
            places.append(along)
    for along in (begin, end):
        point = foot + along * tangent
        turns = [side[0] * (point - corner)[1] - side[1] * (point - corner)[0] for corner, side in sides]
        if min(turns) >= 0 or max(turns) <= 0:
            places.append(along)
    return (min(places), max(places)) if len(places) > 1 else (np.nan, np.nan)


def _positions(sample: Sample) -> np.ndarray:
    """The points of each wall in the world, m. Shape `[K, N, 2]`."""
    return np.asarray(sample.points.position).reshape(WALLS, SIZE, 2) + POSE[:2]
