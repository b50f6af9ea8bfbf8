"""Whether the covariances hold: the tables in README, measured by simulation.

Usage: python scripts/measure_consistency.py [--runs N] [--fused-runs N] [--devices N] [--write]

The cells are those of `linemap_jax.lab.consistency.cells`: walls and rooms, two noises of the range, two of the
bearing, three errors of the pose; 361 beams. Poles stand at 2 and 5 m. Whatever leaves its band is printed cell by
cell. With --write the tables go into README, between the markers.
"""

import argparse
import sys
import time
import zlib
from collections.abc import Callable, Iterable
from functools import partial
from pathlib import Path
from typing import Any, Literal

import jax
import numpy as np
from tqdm import tqdm

from linemap_jax import preset
from linemap_jax.core.settings import Persistence
from linemap_jax.lab import consistency
from linemap_jax.lab.batch import mesh_of_devices, run_batch
from linemap_jax.lab.consistency import Cell, Fit, Model, Sample, Verdict, judge

README = Path(__file__).resolve().parents[1] / "README.md"
BEGIN, END = "<!-- consistency:begin -->", "<!-- consistency:end -->"
BATCH = 250
"""Runs that are simulated side by side; their arrays stay in the cache of a core."""
FUSED_NOISE = "; 0.01 m, 0.1 degree; "
"""Part of the name of the cells in which fifty scans are simulated: the least noise, where a bias shows most."""
AFTER = (1, 5, 20, 50)
CORRELATIONS = (0.0, 0.5, 0.9, 0.99, 1.0)


def main() -> int:
    """Measure, print, and write where that is asked for."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0] if __doc__ else None)
    parser.add_argument("--runs", type=int, default=10_000, help="runs in each cell, of one scan")
    parser.add_argument("--fused-runs", type=int, default=1_000, help="runs in each cell, of fifty scans")
    parser.add_argument("--devices", type=int, default=2, help="processors to use")
    parser.add_argument("--write", action="store_true", help="put the tables into README")
    options = parser.parse_args()
    jax.config.update("jax_enable_x64", True)
    jax.config.update("jax_num_cpu_devices", options.devices)
    begin = time.perf_counter()
    tables = []
    for measure, runs in (
        (single_scans, options.runs),
        (fused_scans, options.fused_runs),
    ):
        tables.append(measure(runs))
        print(tables[-1], flush=True)
    minutes = (time.perf_counter() - begin) / 60
    text = "\n\n".join([*tables, f"Measured in {minutes:.0f} minutes on {options.devices} cores."])
    if options.write:
        before, rest = README.read_text().split(BEGIN)
        README.write_text(f"{before}{BEGIN}\n{text}\n{END}{rest.split(END)[1]}")
    return 0


def single_scans(runs: int) -> str:
    """One scan: the fit of known points, and what the pipeline finds."""
    cells = consistency.cells()
    verdicts: dict[str, list[Verdict]] = {}
    for name_of_cell, cell in tqdm(cells.items(), desc="single scans", disable=None):
        for name, sample in run(one_scan, name_of_cell, cell, runs).items():
            verdicts.setdefault(name, []).append(judge(sample))
    band = consistency.bands(runs, len(cells))
    titles = {
        Fit.DEFAULT.value: "known points, `default`",
        Fit.REGRESSION.value: "known points, regression of the paper, `exact`",
        Fit.PRINTED.value: "known points, regression, as `printed` (12)",
        "longest": "`default`, longest line of a wall",
        "all": "`default`, all lines",
        "paper longest": "`paper`, longest line of a wall",
        "paper all": "`paper`, all lines",
    }
    header = "| one scan | mean NEES, least to largest | median | inside 95 %, least to largest | cells in band |"
    lines = [
        f"{len(cells)} cells of {runs} runs, one line a run. If a covariance holds, all means lie in "
        f"[{band.mean[0]:.3f}, {band.mean[1]:.3f}] and all coverages in [{band.inside[0]:.3f}, {band.inside[1]:.3f}] "
        "with a probability of 0.999. All lines of a scan hold if 93 % are inside and the median is within 10 % of "
        "1.386.",
        "",
        header,
        "| --- | --- | --- | --- | ---: |",
    ]
    for name, title in titles.items():
        of_cells = verdicts[name]
        inside = [holds_for_all(v) if name.endswith("all") else consistency.holds(v, band) for v in of_cells]
        lines.append(
            f"| {title} | {_range(v.mean for v in of_cells)} | {_range(v.median for v in of_cells)} | "
            f"{_range((v.inside for v in of_cells), 3)} | {sum(inside)} of {len(cells)} |"
        )
        if name in (Fit.DEFAULT.value, "longest", "all"):
            for cell, verdict, good in zip(cells, of_cells, inside, strict=True):
                if not good:
                    print(f"out of band: {title}: {cell}: {_short(verdict)}", file=sys.stderr)
    return "\n".join(lines)


def holds_for_all(verdict: Verdict) -> bool:
    """What is asked of all lines: some of them are made of few points, chosen by noise."""
    return verdict.inside >= 0.93 and abs(verdict.median / consistency.CHI2_MEDIAN - 1) <= 0.1


def one_scan(key: jax.Array, cell: Cell) -> dict[str, Sample]:
    """Everything that is measured on one scan."""
    where = (cell.world, cell.path[0], cell.scanner, cell.cov_pose)
    samples = consistency.known_points(key, *where)
    choices: tuple[tuple[str, Literal["default", "paper"]], ...] = (("", "default"), ("paper ", "paper"))
    for name, choice in choices:
        longest, every = consistency.pipeline(key, *where, jacobians="analytic", **preset(choice))
        samples |= {f"{name}longest": longest, f"{name}all": every}
    return samples


def fused_scans(runs: int) -> str:
    """Fifty scans, association known."""
    cells = {
        name: cell
        for name, cell in consistency.cells().items()
        if FUSED_NOISE in name and np.any(np.asarray(cell.cov_pose))
    }
    band = consistency.bands(runs, len(cells) * len(AFTER))
    rows = []
    for correlation in CORRELATIONS:
        models = {
            "independent, Eq. (23)": Model("independent"),
            "persistent, model given": Model("persistent", Persistence(share=1.0, correlation=correlation)),
            "unknown": Model("unknown"),
        }

        experiment = partial(many_scans, correlation=correlation, models=tuple(models.values()))
        results = [run(experiment, *c, runs) for c in tqdm(cells.items(), desc=f"a = {correlation}", disable=None)]
        for i, name in enumerate(models):
            verdicts = [[judge(_of(samples, i, k - 1)) for k in AFTER] for samples, _ in results]
            nis = [x[:, i][x[:, i] > 0] for _, x in results]
            good = sum(consistency.holds(v, band) for of_cell in verdicts for v in of_cell)
            columns = [_range(of_cell[j].mean for of_cell in verdicts) for j in range(len(AFTER))]
            inside = _range((v.inside for of_cell in verdicts for v in of_cell), 3)
            mean_nis = _range(float(np.mean(x)) for x in nis)
            columns += [inside, mean_nis, f"{good} of {len(cells) * len(AFTER)}"]
            rows.append(f"| {correlation} | {name} | {' | '.join(columns)} |")
    after = " | ".join(f"{k} scan{'s' if k > 1 else ''}" for k in AFTER)
    return "\n".join(
        [
            f"{len(cells)} cells with a pose error, e[k+1] = a e[k] + sqrt(1 - a^2) w, {runs} runs each; noise "
            f"{FUSED_NOISE.strip('; ')}. Mean NEES of a line of the map after so many scans, least to largest cell; "
            f"the band is [{band.mean[0]:.3f}, {band.mean[1]:.3f}], [{band.inside[0]:.3f}, {band.inside[1]:.3f}].",
            "",
            f"| a | `pose_error` | {after} | inside 95 % | mean NIS | in band |",
            "| ---: | --- | --- | --- | --- | --- | --- | --- | ---: |",
            *rows,
        ]
    )


def many_scans(key: jax.Array, cell: Cell, *, correlation: float, models: tuple[Model, ...]) -> Any:
    """NEES and NIS of fifty scans."""
    return consistency.fused(key, cell.world, cell.path, cell.scanner, cell.cov_pose, correlation, models)


def run(experiment: Callable[..., Any], name: str, cell: Any, runs: int) -> Any:
    """An experiment, many times, on all devices; the seed follows from the name of the cell."""
    keys = jax.random.split(jax.random.key(zlib.crc32(name.encode())), runs)
    mesh = mesh_of_devices()
    return run_batch(experiment, keys, cell, mesh=mesh, batch=BATCH, batches=-(-runs // (BATCH * mesh.size)))


def _of(samples: Sample, model: int, scan: int) -> Sample:
    return jax.tree.map(lambda x: x[:, model, scan], samples)


def _short(verdict: Verdict) -> str:
    return f"mean {verdict.mean:.3f}, inside {verdict.inside:.4f} of {verdict.runs}"


def _range(values: Iterable[float], digits: int = 2) -> str:
    values = list(values)
    return f"{min(values):.{digits}f} to {max(values):.{digits}f}"


if __name__ == "__main__":
    sys.exit(main())
