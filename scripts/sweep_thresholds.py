"""Which thresholds are best, for each scanner: the table in README, measured.

Usage: python scripts/sweep_thresholds.py [--drives N] [--write]

For each scanner of `linemap_jax.lab.scanners.PRESETS` it varies one threshold after the other in the same simulated
drives (`linemap trials --sweep`). With --write the table goes into README, between its markers, and the curves into
notebooks/thresholds.json, for the notebook that shows them.
"""

import argparse
import json
import subprocess
import sys
import tempfile
from pathlib import Path
from typing import Any

from readme import write_part

from linemap_jax import Thresholds
from linemap_jax.lab.scanners import PRESETS

ROOT = Path(__file__).resolve().parents[1]
KEPT = ("threshold", "value", "cost", "difference", "error")
NAMES = (
    *("gap_distance", "gap_spacings", "gap_sigmas", "gap_beams", "line_distance", "line_sigmas"),
    *("circle_line_distance", "match_angle", "match_distance", "match_sigmas", "match_nis", "match_gap"),
    *("circle_match_distance", "circle_match_nis", "end_sigmas", "wipe_extension", "wipe_sigmas"),
)


def main() -> int:
    """Sweep, print the table, and write it where that is asked for."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0] if __doc__ else None)
    parser.add_argument("--drives", type=int, default=32, help="of each scanner")
    parser.add_argument(
        "--write", action="store_true", help="put the table into README and the curves beside the notebooks"
    )
    options = parser.parse_args()
    sweeps = {name: sweep(name, options.drives) for name in PRESETS}
    text = table(sweeps, options.drives)
    print(text)
    if options.write:
        write_part("thresholds", text)
        curves = {
            name: [{key: row[key] for key in KEPT} for row in found["variants"]] for name, found in sweeps.items()
        }
        document = {"drives": options.drives, "curves": curves}
        (ROOT / "notebooks" / "thresholds.json").write_text(json.dumps(document) + "\n")
    return 0


def sweep(scanner: str, drives: int) -> dict[str, Any]:
    """What `linemap trials` says, for one scanner."""
    with tempfile.TemporaryDirectory() as folder:
        command = [sys.executable, "-m", "linemap_jax.cli", "trials", "--scanner", scanner, "--runs", str(drives)]
        command += ["-o", f"{folder}/results", "--json", "--sweep", *NAMES]
        done = subprocess.run(command, stdout=subprocess.PIPE, text=True, check=True)
    return json.loads(done.stdout)


def table(sweeps: dict[str, dict[str, Any]], drives: int) -> str:
    """Present and recommended values; in brackets by how much the cost falls, with its standard error."""
    present = Thresholds()
    rows = []
    for name in NAMES:
        cells = []
        for found in sweeps.values():
            value = found["recommended"][name]
            row = next(row for row in found["variants"] if row["threshold"] == name and row["value"] == value)
            sure = row["difference"] != 0
            cells.append(f"{value:.3g} ({row['difference']:+.3f} ± {row['error']:.3f})" if sure else "")
        rows.append(f"| `{name}` | {getattr(present, name):g} | {' | '.join(cells)} |")
    costs = [next(row["cost"] for row in found["variants"] if row["difference"] == 0) for found in sweeps.values()]
    rows.append(f"| cost as it is | | {' | '.join(f'{cost:.3f}' for cost in costs)} |")
    return "\n".join(
        [
            f"{drives} drives for each scanner, the same ones for all values.",
            "",
            f"| threshold | default | {' | '.join(sweeps)} |",
            f"| --- | ---: |{' --- |' * len(sweeps)}",
            *rows,
        ]
    )


if __name__ == "__main__":
    sys.exit(main())
