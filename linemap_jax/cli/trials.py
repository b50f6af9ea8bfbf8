"""`linemap trials`: many simulated drives, mapped and scored."""

import contextlib
import dataclasses
import json
import math
import os
import socket
import sys
import time
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Literal

import tyro

from linemap_jax.cli.options import ScannerName, UsageError, check_drive, options_of_method
from linemap_jax.cli.output import say
from linemap_jax.cli.worlds import WorldKind, made_world

if TYPE_CHECKING:
    from jax.sharding import Mesh

    from linemap_jax.io.table import ResultsTable

MOST_RUNS = 10**8
"""Of trials."""

BATCH_RUNS = 32
"""Drives that one device simulates side by side."""

CHUNK_RUNS = 256
"""Drives after which the results are written, of all devices together."""

MOST_OF_CPU = 256
"""Devices that the processors of one machine are taken for at most, where more are asked for than it has."""

PACE = 30.0
"""Seconds from one word about the progress to the next, where it goes into a file."""

LONGEST_WAIT = 60.0
"""Seconds that host 0 has to appear."""

NO_MATTER = ("output", "runs", "devices", "hosts", "host", "coordinator", "quiet", "json")
"""Options on which no row of the results depends."""


@dataclasses.dataclass(frozen=True, kw_only=True)
class Trials:
    """Simulate, map and score many drives, each in a world of its own.

    A run that was stopped goes on; one that is done goes on to more drives.
    """

    output: Annotated[Path, tyro.conf.arg(aliases=["-o"], metavar="DIR")]
    """Folder for the results, a Parquet table with one row a drive. Goes on with one of the same trials."""
    kind: WorldKind = "changing_room"
    """Worlds to drive through."""
    runs: Annotated[int, tyro.conf.arg(metavar="N")] = 1000
    """Number of drives."""
    scans: Annotated[int, tyro.conf.arg(metavar="N")] = 50
    """Number of scans of each."""
    scanner: ScannerName = "pls"
    """The instrument; the map builder knows its noise."""
    preset: Literal["default", "paper"] = "default"
    """The method."""
    config: Path | None = None
    """TOML file with tables [thresholds], [noise], [rules], [persistence]; goes over the preset."""
    pose_sigma: Annotated[tuple[float, float, float], tyro.conf.arg(metavar="X Y THETA")] = (0.01, 0.01, 0.002)
    """Standard deviations of every pose, m m rad."""
    pose_correlation: Annotated[float, tyro.conf.arg(metavar="A")] = 0.0
    """Of the pose errors, from one scan to the next: 0 for independent ones, 1 for one error that stays."""
    pose_error: Literal["independent", "persistent", "unknown"] = "unknown"
    """What the map builder believes of that; `persistent`: the truth, unless --config says else."""
    sweep: Annotated[tuple[str, ...], tyro.conf.arg(metavar="[NAME ...]")] = ()
    """Thresholds to vary, one at a time, in the same drives: each from a quarter to four times its value."""
    seed: Annotated[int, tyro.conf.arg(metavar="N")] = 0
    """Decides everything that is left to chance."""
    devices: Annotated[int | None, tyro.conf.arg(metavar="N")] = None
    """Processors, or accelerators, that share the work. All of them, of all hosts, unless given."""
    hosts: Annotated[int, tyro.conf.arg(metavar="N")] = 1
    """Machines that share the work: give the same command on each of them, but for --host."""
    host: Annotated[int, tyro.conf.arg(metavar="I")] = 0
    """Which of them this is, from 0; 0 writes the results."""
    coordinator: Annotated[str | None, tyro.conf.arg(metavar="ADDRESS:PORT")] = None
    """A free port of host 0, where the others find it."""
    quiet: bool = False
    """No progress."""
    json: bool = False
    """Print the summary as JSON."""

    def run(self) -> int:
        """Run what is still to do of the trials, and give the exit status."""
        check_drive(
            scans=self.scans, pose_sigma=self.pose_sigma, pose_correlation=self.pose_correlation, seed=self.seed
        )
        if not 1 <= self.runs <= MOST_RUNS:
            raise UsageError(f"--runs must be from 1 to {MOST_RUNS}, not {self.runs}")
        self._check_hosts()
        from linemap_jax.core.settings import Persistence

        of_errors = Persistence(share=1.0, correlation=self.pose_correlation)
        options = options_of_method(self.preset, self.config, persistence=of_errors)
        mesh = self._mesh()
        import jax
        import jax.numpy as jnp
        import numpy as np

        from linemap_jax.io.table import ResultsTable
        from linemap_jax.lab.batch import run_chunks, told_by_the_first
        from linemap_jax.lab.scanners import PRESETS
        from linemap_jax.lab.trials import Conditions, Trial, columns_of, recommend, summary, sweep, trial

        thresholds, noise = options.pop("thresholds"), options.pop("noise")
        conditions = Conditions(
            scanner=PRESETS[self.scanner](),
            cov_pose=jnp.diag(jnp.square(jnp.asarray(self.pose_sigma))),
            correlation=self.pose_correlation,
        )

        known = [field.name for field in dataclasses.fields(thresholds)]
        for name in self.sweep:
            if name not in known:
                raise UsageError(f"--sweep: there is no threshold {name!r}: choose from {', '.join(known)}")
        varied, variants = sweep(thresholds, self.sweep)

        def experiment(run: Any, *common: Any) -> Any:
            noise, conditions = common
            of_world, of_drive = jax.random.split(run["key"])
            of_run = Trial(
                key=of_drive,
                world=made_world(self.kind, of_world, scans=self.scans),
                thresholds=run["thresholds"],
                noise=noise,
            )
            return trial(of_run, conditions, scans=self.scans, pose_error=self.pose_error, **options)

        told = {name: value for name, value in dataclasses.asdict(self).items() if name not in NO_MATTER}
        told |= {"config": self.config and self.config.read_text(encoding="utf-8")}
        table = ResultsTable(self.output, told) if self.host == 0 else None
        total, done = self.runs * len(varied), told_by_the_first(table.rows if table else 0)
        batches = max(1, min(CHUNK_RUNS, total - done) // (BATCH_RUNS * mesh.size))
        quiet = self.quiet or self.host > 0
        if done:
            say(f"{min(done, total)} of {total} drives are in {self.output} already", quiet=quiet)
        if done < total:
            devices = f"{mesh.size} {'device' if mesh.size == 1 else 'devices'} ({mesh.devices.flat[0].platform})"
            say(f"compiles for {devices}, and writes every {BATCH_RUNS * batches * mesh.size} drives", quiet=quiet)
        # All variants of one drive stand side by side.
        drive, variant = np.divmod(np.arange(total), len(varied))
        runs = {
            "key": jax.random.split(jax.random.key(self.seed), self.runs)[drive[done:]],
            "thresholds": jax.tree.map(lambda x: x[variant[done:]], variants),
        }
        started = time.perf_counter()
        with _interruptible(table, total), _progress(total, done, quiet=self.quiet or table is None) as tell:
            chunks = run_chunks(experiment, runs, noise, conditions, mesh=mesh, batch=BATCH_RUNS, batches=batches)
            for begin, rows in _until_lost(chunks, self.output) if done < total else ():
                if table is None:
                    continue
                first = done + begin
                here = slice(first, first + len(rows.lines))
                which = [varied[i] for i in variant[here]]
                columns: dict[str, Any] = {"drive": drive[here]}
                if self.sweep:
                    columns |= {"threshold": [name for name, _ in which], "value": [value for _, value in which]}
                table.append(first, columns | columns_of(rows))
                tell(len(rows.lines))
        seconds = time.perf_counter() - started
        if table is None:
            return 0
        results = {name: column[:total] for name, column in table.read().items()}
        speed = {"seconds": seconds, "drives_per_second": max(total - done, 0) / seconds}
        if self.sweep:
            of_variants = [
                {name: column[i :: len(varied)] for name, column in results.items()} for i in range(len(varied))
            ]
            advice = recommend(varied, of_variants)
            costs, differences, errors = (
                np.concatenate([getattr(one, name) for one in advice]).tolist()
                for name in ("costs", "differences", "errors")
            )
            scores = [
                {"threshold": name, "value": value, "cost": costs[i], "difference": differences[i], "error": errors[i]}
                | summary(of_variants[i])
                for i, (name, value) in enumerate(varied)
            ]
            recommended = {one.threshold: one.value for one in advice}
            document = {"variants": scores, "recommended": recommended, **speed}
            print(json.dumps(document, indent=2) if self.json else _sweep_in_words(scores, recommended))
        else:
            score = summary(results) | speed
            print(json.dumps(score, indent=2) if self.json else _trials_in_words(score))
        if not self.json:
            print(f"{total} drives -> {self.output}")
        return 0

    def _check_hosts(self) -> None:
        if not 1 <= self.hosts or not 0 <= self.host < self.hosts:
            raise UsageError(f"--host must be from 0 to --hosts less one, not {self.host} of {self.hosts}")
        if (self.hosts > 1) != (self.coordinator is not None):
            raise UsageError("several --hosts need a --coordinator, and one host needs none")

    def _mesh(self) -> "Mesh":
        """The devices in a row; of processors, as many as the machine has, or as are asked for."""
        processors = len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1
        import jax

        # Without effect where jax has counted its devices already, or where they are accelerators.
        asked = -(-(self.devices or 0) // self.hosts)
        with contextlib.suppress(RuntimeError):
            jax.config.update("jax_num_cpu_devices", asked if processors < asked <= MOST_OF_CPU else processors)
        if self.hosts > 1:
            self._connect()
        from linemap_jax.lab.batch import mesh_of_devices

        try:
            return mesh_of_devices(self.devices)
        except ValueError as error:
            most = f"; processors stand for at most {MOST_OF_CPU} on each host" if asked > MOST_OF_CPU else ""
            raise UsageError(f"--devices: {error}{most}") from error

    def _connect(self) -> None:
        """Join the other hosts."""
        import jax

        assert self.coordinator is not None
        address, _, port = self.coordinator.rpartition(":")
        if not address or not port.isdigit():
            raise UsageError(f"--coordinator must be ADDRESS:PORT, not {self.coordinator}")
        # Of a coordinator that is not there, jax would tell by ending the process.
        latest = time.monotonic() + LONGEST_WAIT
        while self.host > 0:
            try:
                socket.create_connection((address, int(port)), timeout=LONGEST_WAIT).close()
                break
            except OSError as error:
                if time.monotonic() > latest:
                    raise UsageError(f"--coordinator: there is no host 0 at {self.coordinator} ({error})") from error
                time.sleep(0.2)
        # gloo talks on the standard output, which is for results.
        sys.stdout = os.fdopen(os.dup(1), "w")
        os.dup2(2, 1)
        jax.config.update("jax_cpu_collectives_implementation", "gloo")
        jax.distributed.initialize(self.coordinator, self.hosts, self.host)


@contextlib.contextmanager
def _progress(total: int, done: int, *, quiet: bool) -> Iterator[Callable[[int], object]]:
    """To be told of drives that are done: a bar where somebody watches, else a line now and then."""
    if quiet or sys.stderr.isatty():
        from tqdm import tqdm

        with tqdm(total=total, initial=min(done, total), unit="drive", disable=quiet, file=sys.stderr) as bar:
            yield bar.update
        return
    told = time.monotonic()

    def tell(count: int) -> None:
        nonlocal done, told
        done += count
        if time.monotonic() - told >= PACE:
            told = time.monotonic()
            say(f"{done} of {total} drives", quiet=False)

    yield tell


@contextlib.contextmanager
def _interruptible(table: "ResultsTable | None", total: int) -> Iterator[None]:
    """Whoever interrupts is told what is kept."""
    try:
        yield
    except KeyboardInterrupt:
        if table is not None:
            kept = f"{table.rows} of {total} drives are in {table.folder}; the same command goes on from there"
            raise KeyboardInterrupt(kept) from None
        raise


def _until_lost(chunks: Iterator[Any], output: Path) -> Iterator[Any]:
    """The chunks, while all hosts are there."""
    from linemap_jax.lab.batch import LostProcess

    try:
        yield from chunks
    except LostProcess as error:
        print(f"linemap: {error}; what was done stands in {output}, to go on with", file=sys.stderr, flush=True)
        os._exit(2)  # the usual way out would wait for the host that is gone


def _sweep_in_words(scores: list[dict[str, Any]], recommended: dict[str, float]) -> str:
    names = ("cost", "precision", "recall", "duplicates", "false_matches", "missed_matches", "gone", "noticed")
    lines = [f"{'threshold':22s} {'value':>8s} " + " ".join(f"{name:>14s}" for name in names)]
    for score in scores:
        cells = ["-" if score[name] is None else f"{score[name]:.2%}" for name in names]
        mark = " <-" if score["value"] == recommended[score["threshold"]] else ""
        cells = " ".join(f"{cell:>14s}" for cell in cells)
        lines.append(f"{score['threshold']:22s} {score['value']:8.4g} {cells}{mark}")
    lines.append("cost: the sum of the shares of all mistakes; <- recommended: the least cost if that is sure")
    return "\n".join(lines)


def _trials_in_words(score: dict[str, Any]) -> str:
    def share(name: str) -> str:
        return "-" if score[name] is None else f"{score[name]:.2%}"

    def number(name: str, scale: float = 1.0) -> str:
        return "-" if score[name] is None else f"{scale * score[name]:.2f}"

    return "\n".join(
        [
            f"length within 5 cm: precision {share('precision')}, recall {share('recall')}",
            f"{share('duplicates')} of {score['walls']} walls are held twice, {score['fragments']} pieces are too "
            f"many; {share('phantom_lines')} of {score['lines']} lines are phantoms",
            f"error {number('offset_rms_m', 100)} cm, {number('angle_rms_rad', 180 / math.pi)} degrees (rms); "
            f"mean NEES {number('mean_nees')} +- {number('mean_nees_error')}, where 2 is exact and less is cautious; "
            f"{share('covered')} inside the 95 % ellipse",
            f"{share('missed_poles')} of {score['poles']} poles are missed, {share('phantom_circles')} of "
            f"{score['circles']} circles are phantoms",
            f"matches: {share('false_matches')} false, {share('missed_matches')} missed of {score['matches']}",
            f"{share('gone')} of {score['vanished']} vanished things are gone after three scans that could tell, "
            f"{share('noticed')} of {score['appeared']} new ones are there",
        ]
    )
