"""How well scans are divided into lines, against six published extractors: the table in README, measured.

Usage: python scripts/measure_segmentation.py [--write] [--every N]

The scans are those of the benchmark of PLE (Schaefer et al., IROS 2018): 130 real and 130 simulated ones, with the
results of six methods at five budgets of vertices. `extract(..., segmentation="optimal", max_vertices=N)` with default
noise is scored as those were, by what the beams would meet: the root mean square of the range error, the share of
returns that meet a line, the share of beams without a return that meet none, and of simulated scans the area between
the true polygon and that of the vertices, relative to the true one. Circles are not scored. Means over scans.

The scans are looked for in $LINEMAP_DATA (default ../shared/data), the scores in $LINEMAP_TOOLS (../shared/tools);
where either is absent there is nothing to measure.
"""

import argparse
import importlib.util
import json
import os
import sys
import time
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from linemap_jax import Pose, Scan, extract

ROOT = Path(__file__).resolve().parents[1]
README = ROOT / "README.md"
FOUND = ROOT / "notebooks/segmentation.json"
"""The same figures, for the notebook."""
SCANS = Path(os.environ.get("LINEMAP_DATA", ROOT / "../shared/data")) / "ple/scans.npz"
TOOL = Path(os.environ.get("LINEMAP_TOOLS", ROOT / "../shared/tools")) / "score.py"
BEGIN, END = "<!-- segmentation:begin -->", "<!-- segmentation:end -->"
METRICS = {"real": ("rmse", "f", "fnr"), "sim": ("rmse", "a", "f")}
LONG = {
    "rmse": "rmse, m",
    "f": "share of returns on lines",
    "fnr": "share of no-returns off lines",
    "a": "area error",
}
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
            found = extract(scan, here, segmentation="optimal", max_vertices=budget, jacobians="analytic")
            return found.lines.begin, found.lines.end, found.lines.valid

        return jax.lax.map(lines_of, scans)

    begin, end, valid = (np.asarray(x) for x in run(scans))
    started = time.perf_counter()
    jax.block_until_ready(run(scans))
    each = (time.perf_counter() - started) / len(valid)
    rows: dict[str, list[float]] = {name: [] for name in ("rmse", "f", "fnr", "a", "vertices")}
    for k, i in enumerate(range(0, len(data[f"{kind}_count"]), every)):
        n = data[f"{kind}_count"][i]
        segments = np.concatenate([begin[k], end[k]], -1)[valid[k]]
        score = scores.score(
            data[f"{kind}_range"][i, :n], data[f"{kind}_azimuth"][i, :n], data[f"{kind}_rlim"][i], segments
        )
        vertices = np.unique(np.round(segments.reshape(-1, 2), 6), axis=0)
        area = scores.polygon_score(data["sim_polygon"][i], vertices)[0] if kind == "sim" else np.nan
        for name, value in (*((x, score[x]) for x in ("rmse", "f", "fnr")), ("a", area), ("vertices", len(vertices))):
            rows[name].append(value)
    return {name: np.array(values) for name, values in rows.items()} | {"seconds": np.array(each)}


ALGORITHMS = ("VVL", "IEF", "SAM", "VB", "PLE", "PLE+")
Means = dict[str, dict[str, dict[str, list[float]]]]


def means(scores: Any, data: Any, every: int) -> Means:
    """All methods at all budgets, by kind of scan and metric: means over scans."""
    budgets, names = data["published_vertex_budgets"].tolist(), data["published_algorithms"].tolist()
    result: Means = {}
    for kind, metrics in METRICS.items():
        measured = [measure(scores, data, kind, budget, every) for budget in budgets]
        over = sum(int(np.sum(m["vertices"] > b)) for m, b in zip(measured, budgets, strict=True))
        print(f"{kind}: {over} scans above their budget", file=sys.stderr)
        for metric in metrics:
            published = data[f"published_{kind}_{metric}"][::every]
            rows = {name: np.nanmean(published[:, names.index(name)], 0) for name in ALGORITHMS}
            rows["optimal"] = np.array([np.nanmean(m[metric]) for m in measured])
            result.setdefault(kind, {})[metric] = {name: row.tolist() for name, row in rows.items()}
    return result


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
        found = means(load_scores(), dict(data), options.every)
    text = table(found, budgets)
    print(text)
    if options.write:
        FOUND.write_text(json.dumps({"budgets": budgets, **found}, indent=1).replace("NaN", "null") + "\n")
        before, rest = README.read_text().split(BEGIN)
        README.write_text(f"{before}{BEGIN}\n{text}\n{END}{rest.split(END)[1]}")
    return 0


if __name__ == "__main__":
    sys.exit(main())
