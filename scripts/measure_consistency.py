"""Whether the covariances hold: the tables in README, measured by simulation.

Usage: python scripts/measure_consistency.py [--runs N] [--fused-runs N] [--devices N] [--only TABLE] [--write]

Of one scan, of fifty whose association is known, of poles, and of whole maps as `linemap trials` makes them.

The cells are those of `linemap_jax.lab.consistency.cells`: walls and rooms, two noises of the range, two of the
bearing, three errors of the pose; 361 beams. Poles stand at 2 and 5 m. Whatever leaves its band is printed cell by
cell. With --write each table goes into README, between its markers.
"""

import argparse
import itertools
import math
import sys
import time
import zlib
from collections.abc import Callable, Iterable
from functools import partial
from typing import Any, Literal

import jax
import jax.numpy as jnp
import numpy as np
from readme import write_part
from tqdm import tqdm

from linemap_jax import preset
from linemap_jax.core.settings import Persistence, PoseError, Segmentation
from linemap_jax.lab import consistency, consistency_of_circles
from linemap_jax.lab.batch import mesh_of_devices, run_batch
from linemap_jax.lab.consistency import Cell, Fit, Model, Sample, Verdict, judge
from linemap_jax.lab.generators import changing_room
from linemap_jax.lab.scanners import Scanner, sweep
from linemap_jax.lab.trials import Conditions, Outcome, Trial, columns_of, summary, trial

BATCH = 250
"""Runs that are simulated side by side; their arrays stay in the cache of a core."""
FUSED_NOISE = "; 0.01 m, 0.1 degree; "
"""Part of the name of the cells in which fifty scans are simulated: the least noise, where a bias shows most."""
EVERY = 5
"""With the optimal segmentation every fifth cell is looked at: no divisor of the number of noises and poses, so that
all of them occur."""
SEGMENTATIONS: tuple[Segmentation, ...] = ("incremental", "optimal")
OF_MAPS: tuple[tuple[float, PoseError, int], ...] = (
    (0.0, "unknown", 1),
    (0.0, "independent", 50),
    (0.9, "persistent", 50),
    (0.0, "unknown", 50),
    (0.9, "unknown", 50),
    (1.0, "unknown", 50),
)
"""Correlation of the pose errors, what the map builder knows of it, and the number of scans."""
AFTER = (1, 5, 20, 50)
CORRELATIONS = (0.0, 0.5, 0.9, 0.99, 1.0)


def main() -> int:
    """Measure, print, and write where that is asked for."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0] if __doc__ else None)
    parser.add_argument(
        "--runs", type=int, default=10_000, help="runs in each cell, of one scan; a fifth with `optimal`"
    )
    parser.add_argument(
        "--fused-runs", type=int, default=1_000, help="runs in each cell, of fifty scans; half with maps"
    )
    parser.add_argument("--devices", type=int, default=2, help="processors to use")
    tables = ("single", "optimal", "fused", "maps", "poles")
    parser.add_argument("--only", choices=tables, help="measure one of the tables")
    parser.add_argument("--write", action="store_true", help="put the tables into README")
    options = parser.parse_args()
    jax.config.update("jax_enable_x64", True)
    jax.config.update("jax_num_cpu_devices", options.devices)
    tables = {
        "single": (single_scans, options.runs),
        "optimal": (optimal_scans, options.runs // 5),
        "fused": (fused_scans, options.fused_runs),
        "maps": (maps, options.fused_runs // 2),
        "poles": (poles, options.fused_runs),
    }
    for name, (measure, runs) in tables.items():
        if options.only in (None, name):
            begin = time.perf_counter()
            table = measure(runs)
            minutes = (time.perf_counter() - begin) / 60
            print(f"{table}\n\nin {minutes:.0f} minutes on {options.devices} cores\n", flush=True)
            if options.write:
                write_part(f"consistency-{name}", table)
    return 0


def single_scans(runs: int) -> str:
    """One scan: the fit of known points, and what the pipeline finds."""
    titles = {
        Fit.DEFAULT.value: "known points, `default`",
        Fit.REGRESSION.value: "known points, regression of the paper, `exact`",
        Fit.PRINTED.value: "known points, regression, as `printed` (12)",
        "longest": "`default`, longest line of a wall",
        "all": "`default`, all lines",
        "paper longest": "`paper`, longest line of a wall",
        "paper all": "`paper`, all lines",
    }
    return table_of_scans(one_scan, titles, runs)


def optimal_scans(runs: int) -> str:
    """One scan: what the pipeline finds with the optimal segmentation."""
    titles = {"longest": "`optimal`, longest line of a wall", "all": "`optimal`, all lines"}
    return table_of_scans(one_optimal_scan, titles, runs, every=EVERY) + "\n\n" + accuracy(runs // 4)


def accuracy(runs: int) -> str:
    """Lines of the optimal segmentation beside other fits of their points."""
    cells = {name: cell for name, cell in consistency.cells().items() if "exact pose" in name}
    ratios = []
    for name, cell in tqdm(cells.items(), desc="accuracy", mininterval=5):
        errors, counts = run(errors_of_fits, name, cell, runs)
        rms = np.sqrt(np.mean(np.square(errors[counts]), 0))
        ratios.append(rms / rms[1])
    ours, _, weighted = np.array(ratios).T
    return (
        f"Root mean square error of rho, the distance from the scanner, over that of orthogonal regression of the same "
        f"points; the {len(cells)} cells with an exact pose, {runs} runs each. The lines of `optimal`: "
        f"{np.median(ours):.2f} in the median, {_range(ours)}. Regression with weights, as in laser_line_extraction: "
        f"{np.median(weighted):.2f} in the median, {_range(weighted)}."
    )


def table_of_scans(
    experiment: Callable[..., dict[str, Sample]], titles: dict[str, str], runs: int, *, every: int = 1
) -> str:
    """A table of samples, by what they are called; what should hold and does not is told on stderr."""
    cells = dict(itertools.islice(consistency.cells().items(), 0, None, every))
    verdicts: dict[str, list[Verdict]] = {}
    for name_of_cell, cell in tqdm(cells.items(), desc="single scans", mininterval=5):
        for name, sample in run(experiment, name_of_cell, cell, runs).items():
            verdicts.setdefault(name, []).append(judge(sample))
    band = consistency.bands(runs, len(cells))
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
        longest, every = consistency.pipeline(key, *where, **preset(choice))
        samples |= {f"{name}longest": longest, f"{name}all": every}
    return samples


def one_optimal_scan(key: jax.Array, cell: Cell) -> dict[str, Sample]:
    """What the optimal segmentation finds in one scan."""
    where = (cell.world, cell.path[0], cell.scanner, cell.cov_pose)
    longest, every = consistency.pipeline(key, *where, segmentation="optimal")
    return {"longest": longest, "all": every}


def errors_of_fits(key: jax.Array, cell: Cell) -> Any:
    """How far lines of the optimal segmentation are off, and other fits."""
    where = (cell.world, cell.path[0], cell.scanner)
    return consistency.rho_errors(key, *where, segmentation="optimal")


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
        results = [run(experiment, *c, runs) for c in tqdm(cells.items(), desc=f"a = {correlation}", mininterval=5)]
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
            f"{FUSED_NOISE.strip('; ')}. Known points, and known which line is which: mean NEES of the fused line "
            "after so many scans, least to largest cell; "
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


def maps(runs: int) -> str:
    """Whole maps: nobody says which line is which, and things come and go."""
    scanner = Scanner(bearings=sweep(-math.pi / 2, math.pi / 2, 361), range_sigma=0.02, bearing_sigma=0.0)
    cov_pose = jnp.diag(jnp.array([0.01, 0.01, math.radians(0.1)])) ** 2
    rows = []
    for segmentation, (correlation, pose_error, scans) in itertools.product(SEGMENTATIONS, OF_MAPS):
        persistence = Persistence(share=1.0, correlation=correlation)
        experiment = partial(
            one_map, scans=scans, pose_error=pose_error, persistence=persistence, segmentation=segmentation
        )
        name = f"{segmentation}, {pose_error}, a = {correlation}, {scans} scans"
        print(name, file=sys.stderr)
        conditions = Conditions(scanner=scanner, cov_pose=cov_pose, correlation=correlation)
        score = summary(columns_of(run(experiment, "maps", conditions, runs)))
        known = "-" if scans == 1 else pose_error
        cells = (
            segmentation,
            str(scans),
            str(correlation),
            known,
            f"{score['mean_nees']:.2f}",
            f"{score['covered']:.3f}",
        )
        rows.append(f"| {' | '.join(cells)} | {score['lines']} |")
    return "\n".join(
        [
            f"{runs} drives through rooms in which things come and go (`changing_room`), each of its own; 361 beams, "
            "2 cm, no error of the bearing; poses 1 cm, 0.1 degree. The model of the pose error is the true one.",
            "",
            "| segmentation | scans | a | `pose_error` | mean NEES | inside 95 % | lines |",
            "| --- | ---: | ---: | --- | ---: | ---: | ---: |",
            *rows,
        ]
    )


def one_map(key: jax.Array, conditions: Conditions, *, scans: int, **options: Any) -> Outcome:
    """A drive through a world of its own."""
    of_drive, of_world = jax.random.split(key)
    return trial(Trial(key=of_drive, world=changing_room(of_world, scans=scans)), conditions, scans=scans, **options)


def poles(runs: int) -> str:
    """Circles: known returns, what the pipeline finds, and twenty scans."""
    cells = poles_of_table()
    pipeline = partial(consistency_of_circles.pipeline, **preset("default"))
    experiments = {
        name: partial(on_pole, experiment=experiment)
        for name, experiment in (("known", consistency_of_circles.known_points), ("pipeline", pipeline))
    }
    verdicts: dict[str, list[Verdict]] = {"fit": [], "arc": [], "pipeline": []}
    for name, cell in tqdm(cells.items(), desc="poles", mininterval=5):
        for what, experiment in experiments.items():
            found = run(experiment, name, cell, runs)
            for kind, sample in found.items() if what == "known" else [("pipeline", found)]:
                if np.mean(sample.counts) < 0.5:  # few are believed, and those are not a fair sample
                    continue
                verdict = judge(sample)
                verdicts[kind].append(verdict)
                band = consistency.bands(verdict.runs, len(cells), dof=3)
                if not consistency.holds(verdict, band):
                    print(f"out of band: {kind}: {name}: {_short(verdict)}", file=sys.stderr)
    titles = {
        "fit": "known returns, the most likely circle",
        "arc": "known returns, Eqs. (18)-(20)",
        "pipeline": "`default`, the circle nearest to the pole",
    }
    lines = [
        f"{len(cells)} poles of 5, 10 and 20 cm radius at 2 and 5 m, {runs} runs each; the NEES of (x, y, radius), "
        "whose mean is 3 where a covariance holds. Counted are cells in which at least half of the runs give a circle.",
        "",
        "| one pole | cells | mean NEES, least to largest | inside 95 % | bias of the radius, sigmas | cells in band |",
        "| --- | ---: | --- | --- | --- | ---: |",
    ]
    for kind, title in titles.items():
        of_cells = verdicts[kind]
        inside = [consistency.holds(v, consistency.bands(v.runs, len(cells), dof=3)) for v in of_cells]
        lines.append(
            f"| {title} | {len(of_cells)} | {_range(v.mean for v in of_cells)} | "
            f"{_range((v.inside for v in of_cells), 3)} | {_range(v.bias[2] for v in of_cells)} | "
            f"{sum(inside)} of {len(of_cells)} |"
        )
    return "\n".join(lines)


def on_pole(key: jax.Array, cell: Any, *, experiment: Callable[..., Any]) -> Any:
    """One run with a pole."""
    return experiment(key, *cell)


def poles_of_table() -> dict[str, Any]:
    """Poles by name: centre, radius, pose, scanner, covariance of the pose."""
    cells = {}
    for distance, radius, sigma, degrees, uncertain in itertools.product(
        (2, 5), (0.05, 0.1, 0.2), (0.01, 0.03), (0.0, 0.1), (False, True)
    ):
        name = (
            f"pole of {radius} m at {distance} m; {sigma} m, {degrees} degree; {'5 cm, 1 degree' if uncertain else '-'}"
        )
        scanner = Scanner(
            bearings=sweep(-math.pi / 2, math.pi / 2, 361),
            range_sigma=jnp.asarray(sigma),
            bearing_sigma=jnp.asarray(math.radians(degrees)),
        )
        cov_pose = uncertain * jnp.diag(jnp.array([0.05, 0.05, math.radians(1)])) ** 2
        cells[name] = (jnp.array([distance, 0.4]), jnp.asarray(radius), jnp.zeros(3), scanner, cov_pose)
    return cells


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
