"""How well scans are divided into lines, against six published extractors: the table in README, measured.

Usage: python scripts/measure_segmentation.py [--write] [--every N]

The scans are those of the benchmark of PLE (Schaefer et al., IROS 2018): 130 real and 130 simulated ones, with the
results of six methods at five budgets of vertices. `extract(..., segmentation="optimal", max_vertices=N)` with default
noise is scored as those were, by what the beams would meet: the root mean square of the range error, the share of
returns that meet a line, the share of beams without a return that meet none, and of simulated scans the area between
the true polygon and that of the vertices, relative to the true one. Circles are not scored. Means over scans.

Two more tables: how much time of a core a scan takes, in float32, alone and with others side by side; and by how much
what was found is dearer than a lower bound, the best independent lines with one vertex each, as if every two neighbours
shared one: more than any search can gain.

The scans are looked for in $LINEMAP_DATA (default ../shared/data), the scores in $LINEMAP_TOOLS (../shared/tools);
where either is absent there is nothing to measure.
"""

import argparse
import importlib.util
import json
import math
import os
import sys
import time
from functools import partial
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from readme import write_part

from linemap_jax import Extraction, Mount, Pose, Scan, SensorNoise, Thresholds, extract
from linemap_jax.core.frames import dot, unit
from linemap_jax.core.segmentation import optimal
from linemap_jax.core.segmentation.incremental import follow, gap_gate
from linemap_jax.core.segmentation.polyline import best_polyline
from linemap_jax.core.sensor import points_from_scan

ROOT = Path(__file__).resolve().parents[1]
FOUND = ROOT / "notebooks/segmentation.json"
"""The same figures, for the notebook."""
SCANS = Path(os.environ.get("LINEMAP_DATA", ROOT / "../shared/data")) / "ple/scans.npz"
TOOL = Path(os.environ.get("LINEMAP_TOOLS", ROOT / "../shared/tools")) / "score.py"
METRICS = {"real": ("rmse", "f", "fnr"), "sim": ("rmse", "a", "f")}
LONG = {
    "rmse": "rmse, m",
    "f": "share of returns on lines",
    "fnr": "share of no-returns off lines",
    "a": "area error",
}
WIDE = 360
"""Beams of the scans whose time is told."""
BATCH = 64
"""Scans side by side."""
ROUNDS = 15
RANGE_SIGMA = SensorNoise().range_sigma
TITLES = {"real": "real scans", "sim": "simulated scans"}
DIGITS = {"rmse": 4, "f": 3, "fnr": 2, "a": 4}


def load_scores() -> Any:
    """The module that holds the benchmark's scores."""
    spec = importlib.util.spec_from_file_location("score", TOOL)
    assert spec is not None
    assert spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


def stacked_scans(data: Any, kind: str) -> Scan:
    """All scans of a kind."""
    limits = data[f"{kind}_rlim"]
    scans = [
        Scan.from_ranges(ranges, bearings, range_min=low, range_max=high)
        for ranges, bearings, (low, high) in zip(data[f"{kind}_range"], data[f"{kind}_azimuth"], limits, strict=True)
    ]
    return jax.tree.map(lambda *x: np.stack(x), *scans)


def measure(scores: Any, data: Any, kind: str, budget: int, every: int) -> dict[str, np.ndarray]:
    """The scores of every scan, at one budget."""
    scans = jax.tree.map(lambda x: x[::every], stacked_scans(data, kind))
    here = Pose(mean=jnp.zeros(3), cov=jnp.zeros((3, 3)))

    @jax.jit
    def run(scans: Scan) -> Any:
        def lines_of(scan: Scan) -> Any:
            found = extract(scan, here, segmentation="optimal", max_vertices=budget)
            return found.lines.begin, found.lines.end, found.lines.valid, *costs_of(scan, found)

        return jax.lax.map(lines_of, scans)

    def costs_of(scan: Scan, found: Extraction) -> tuple[Any, ...]:
        """Sum of the squared residuals, m^2; how many points are left out; the points, and which follow which."""
        covered, lines = found.line_of_beam >= 0, found.lines
        normal = lines.normal[found.line_of_beam]
        rho = dot(lines.normal, lines.anchor) + lines.offset
        along = rho[found.line_of_beam] / dot(normal, unit(scan.bearings))
        squares = jnp.sum(jnp.where(covered, jnp.square(scan.ranges - along), 0))
        points = points_from_scan(scan, here, Mount(), jacobians="analytic")
        near, adjacent = follow(points, optimal.budget_gap, optimal.BUDGET_GAP_BEAMS)
        return squares, jnp.sum(scan.valid & ~covered), points.range, points.turn, points.valid, near & adjacent

    begin, end, valid, squares, left, *points = (np.asarray(x) for x in run(scans))
    rows: dict[str, list[float]] = {name: [] for name in ("rmse", "f", "fnr", "a", "vertices", "gap")}
    for k, i in enumerate(range(0, len(data[f"{kind}_count"]), every)):
        n = data[f"{kind}_count"][i]
        segments = np.concatenate([begin[k], end[k]], -1)[valid[k]]
        score = scores.score(
            data[f"{kind}_range"][i, :n], data[f"{kind}_azimuth"][i, :n], data[f"{kind}_rlim"][i], segments
        )
        vertices = np.unique(np.round(segments.reshape(-1, 2), 6), axis=0)
        area = scores.polygon_score(data["sim_polygon"][i], vertices)[0] if kind == "sim" else np.nan
        range_, turn, there, follows = (x[k] for x in points)
        price = 2 * optimal.LEFT_WEIGHT * max(math.sqrt(squares[k] / max(there.sum() - left[k], 1)), RANGE_SIGMA)
        bound = lower_bound(
            np.cumsum(turn)[there],
            range_[there],
            np.ones(there.sum()),
            np.full(there.sum(), price),
            follows[there],
            # A line that runs across the end of the sweep is two here.
            runs=budget + 1,
            min_points=1,
        )
        gap = (squares[k] + price * left[k]) / max(bound, 1e-12) - 1
        found = {**score, "a": area, "vertices": len(vertices), "gap": gap}
        for name, values in rows.items():
            values.append(found[name])
    return {name: np.array(values) for name, values in rows.items()}


def lower_bound(
    angle: np.ndarray,
    range_: np.ndarray,
    weight: np.ndarray,
    price: np.ndarray,
    follows: np.ndarray,
    *,
    vertex_price: float = 0.0,
    runs: int | None = None,
    min_points: int,
) -> float:
    """What the best independent lines cost, with one vertex each.

    Args:
      angle: of the points, rad. Shape `[N]`, and so are the others.
      range_: m.
      weight: of a residual, 1/m.
      price: of a point that no line covers.
      follows: whether a line may hold the point and the one before.
      vertex_price: of a line.
      runs: how many lines there may be; any number unless given.
      min_points: of a line.
    """
    n = len(range_)
    design = (weight * range_**2)[:, None] * np.stack([np.cos(angle), np.sin(angle)], -1)
    response = weight * range_
    terms = [design[:, 0] ** 2, design[:, 0] * design[:, 1], design[:, 1] ** 2]
    terms += [design[:, 0] * response, design[:, 1] * response, response**2]
    sums = np.concatenate([np.zeros((6, 1)), np.cumsum(terms, 1)], 1)
    # By the number of lines; without a limit the only row stands for any.
    cost = np.zeros((1 if runs is None else runs + 1, n + 1))
    start = 0
    for j in range(n):
        start = start if j and follows[j] else j
        xx, xy, yy, xr, yr, rr = sums[:, j + 1, None] - sums[:, start : max(j + 2 - min_points, start)]
        det = xx * yy - xy**2
        good = det > 1e-9 * xx * yy
        explained = (yy * xr**2 - 2 * xy * xr * yr + xx * yr**2) / np.where(good, det, 1)
        alone = np.maximum(np.where(good, rr - explained, 0), 0)
        cost[:, j + 1] = cost[:, j] + price[j]
        if len(alone):
            lines = np.min(cost[:, start : start + len(alone)] + alone + vertex_price, 1)
            later = slice(None) if runs is None else slice(1, None)
            cost[later, j + 1] = np.minimum(cost[later, j + 1], lines if runs is None else lines[:-1])
    return float(cost[-1, n])


def gap_of_priced(data: Any, kind: str, every: int) -> np.ndarray:
    """By how much what is found without a budget is dearer than the lower bound, of every scan."""
    scans = jax.tree.map(lambda x: x[::every], stacked_scans(data, kind))
    here = Pose(mean=jnp.zeros(3), cov=jnp.zeros((3, 3)))
    thresholds, noise = Thresholds(), SensorNoise()

    @jax.jit
    def run(scans: Scan) -> Any:
        def search(scan: Scan) -> Any:
            points = points_from_scan(scan, here, Mount(), jacobians="analytic")
            near, adjacent = follow(points, lambda arc: gap_gate(arc, thresholds, noise), thresholds.gap_beams)
            sweep, price = optimal.priced(points, near & adjacent, thresholds, noise)
            return sweep, price, best_polyline(sweep, price, max_vertices=None, min_points=optimal.LEAST_POINTS)[2]

        return jax.lax.map(search, scans)

    sweeps, prices, costs = jax.tree.map(np.asarray, run(scans))
    gaps = []
    for k, (price, cost) in enumerate(zip(prices, costs, strict=True)):
        s = jax.tree.map(lambda x, k=k: x[k][sweeps.valid[k]], sweeps)
        options = {"vertex_price": price, "min_points": optimal.LEAST_POINTS}
        gaps.append(cost / lower_bound(s.angle, s.range, s.weight, s.price, s.follows, **options) - 1)
    return np.array(gaps)


def seconds(data: Any, kind: str, budget: int | None, side_by_side: int | None) -> list[float]:
    """What scans of 360 or 361 beams take of a core, in float32: quartiles of the mean over scans, of several rounds.

    Args:
      data: the benchmark.
      kind: "real" or "sim".
      budget: of vertices, or none.
      side_by_side: so many scans at once; each alone, unless given.
    """
    wide = data[f"{kind}_count"] >= WIDE
    scans = jax.tree.map(lambda x: x[wide], stacked_scans(data, kind))
    scans = jax.tree.map(lambda x: jnp.asarray(x, jnp.float32 if x.dtype == np.float64 else x.dtype), scans)
    here = Pose(mean=jnp.zeros(3, jnp.float32), cov=jnp.zeros((3, 3), jnp.float32))
    one = partial(extract, segmentation="optimal", max_vertices=budget)
    if side_by_side is None:
        run, given = (
            jax.jit(lambda scan: one(scan, here)),
            [jax.tree.map(lambda x, k=k: x[k], scans) for k in range(20)],
        )
    else:
        run = jax.jit(lambda scans: jax.lax.map(lambda scan: one(scan, here), scans, batch_size=side_by_side))
        given = [scans]
    count = len(given) if side_by_side is None else int(wide.sum())
    rounds = []
    for _ in range(ROUNDS + 1):
        started = time.process_time()
        for x in given:
            jax.block_until_ready(run(x))
        rounds.append((time.process_time() - started) / count)
    return np.quantile(rounds[1:], (0.25, 0.5, 0.75)).tolist()


ALGORITHMS = ("VVL", "IEF", "SAM", "VB", "PLE", "PLE+")
Means = dict[str, dict[str, dict[str, list[float]]]]


def means(scores: Any, data: Any, every: int) -> tuple[Means, dict[str, list[float]]]:
    """All methods at all budgets, by kind of scan and metric: means over scans. And the gaps: medians."""
    budgets, names = data["published_vertex_budgets"].tolist(), data["published_algorithms"].tolist()
    result: Means = {}
    gaps: dict[str, list[float]] = {}
    for kind, metrics in METRICS.items():
        measured = [measure(scores, data, kind, budget, every) for budget in budgets]
        over = sum(int(np.sum(m["vertices"] > b)) for m, b in zip(measured, budgets, strict=True))
        print(f"{kind}: {over} scans above their budget", file=sys.stderr)
        gaps[kind] = [float(np.median(m["gap"])) for m in measured]
        for metric in metrics:
            published = data[f"published_{kind}_{metric}"][::every]
            rows = {name: np.nanmean(published[:, names.index(name)], 0) for name in ALGORITHMS}
            rows["optimal"] = np.array([np.nanmean(m[metric]) for m in measured])
            result.setdefault(kind, {})[metric] = {name: row.tolist() for name, row in rows.items()}
    return result, gaps


def table(found: Means, budgets: list[int]) -> str:
    """For people; the best of each column in bold."""
    parts = []
    for kind, metrics in found.items():
        for metric, rows in metrics.items():
            best = min if metric in ("rmse", "a") else max
            shown = {
                name: [f"{x:.{DIGITS[metric]}f}" if np.isfinite(x) else "" for x in row] for name, row in rows.items()
            }
            leading = [best(row[j] for row in shown.values() if row[j]) for j in range(len(budgets))]
            parts += [f"| {TITLES[kind]}: {LONG[metric]} | {' | '.join(map(str, budgets))} |"]
            parts += ["| --- " + "| ---: " * len(budgets) + "|"]
            for name, row in shown.items():
                cells = [f"**{x}**" if x == y else x for x, y in zip(row, leading, strict=True)]
                parts.append(f"| {name} | {' | '.join(cells)} |")
            parts.append("")
    return "\n".join(parts).rstrip()


def table_of_gaps(gaps: dict[str, list[float]], budgets: list[int]) -> str:
    """For people; without a budget first."""
    rows = [f"| {TITLES[kind]} | {' | '.join(f'{100 * x:.1f} %' for x in row)} |" for kind, row in gaps.items()]
    header = f"| dearer than the lower bound, median | no budget | {' | '.join(map(str, budgets))} |"
    return "\n".join([header, "| --- " + "| ---: " * (len(budgets) + 1) + "|", *rows])


def table_of_times(data: Any, budgets: list[int]) -> str:
    """For people; the median round, and the range of the middle half."""
    ways: dict[str, tuple[int | None, int | None]] = {"alone": (None, None), f"{BATCH} at once": (None, BATCH)}
    ways |= {f"alone, {budget} vertices": (budget, None) for budget in (budgets[0], budgets[-1])}
    rows = []
    for kind, title in TITLES.items():
        quartiles = [[1e3 * x for x in seconds(data, kind, *way)] for way in ways.values()]
        rows.append(f"| {title} | {' | '.join(f'{q[1]:.2f} ({q[0]:.2f} to {q[2]:.2f})' for q in quartiles)} |")
    return "\n".join([f"| ms a scan | {' | '.join(ways)} |", "| --- " + "| ---: " * len(ways) + "|", *rows])


def main() -> int:
    """Print the table, and write it where that is asked for."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0] if __doc__ else None)
    parser.add_argument("--write", action="store_true", help="put the table into README")
    parser.add_argument("--every", type=int, default=1, metavar="N", help="take every N-th scan")
    options = parser.parse_args()
    jax.config.update("jax_enable_x64", True)  # so that a shared vertex is one to a micrometre
    for path in (SCANS, TOOL):
        if not path.exists():
            print(f"{path} is not there: nothing to measure", file=sys.stderr)
            return 0
    with np.load(SCANS) as data:
        budgets = data["published_vertex_budgets"].tolist()
        scans = dict(data)
    times = table_of_times(scans, budgets)
    found, gaps = means(load_scores(), scans, options.every)
    gaps = {kind: [float(np.median(gap_of_priced(scans, kind, options.every))), *row] for kind, row in gaps.items()}
    text = "\n\n".join([table(found, budgets), table_of_gaps(gaps, budgets), times])
    print(text)
    if options.write:
        FOUND.write_text(json.dumps({"budgets": budgets, **found}, indent=1).replace("NaN", "null") + "\n")
        write_part("segmentation", text)
    return 0


if __name__ == "__main__":
    sys.exit(main())
