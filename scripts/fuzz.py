"""Fuzzing at length: one line a target, with its cases, its failures and the time they took.

    python scripts/fuzz.py --cases 10000

What the cases are, and what must hold of each, stands in tests/fuzzing*.py. Exit status 1 if a case failed; the
smallest such case of each kind is printed.
"""

import argparse
import importlib
import math
import os
import sys
import tempfile
import traceback
from pathlib import Path

import jax

ROOT = Path(__file__).resolve().parents[1]
MOST_FRAMES = 6


def _told(failure: BaseException) -> str:
    """Where it went wrong, and the smallest case, no line of it longer than a few of a screen."""
    frames = traceback.format_list(traceback.extract_tb(failure.__traceback__)[-MOST_FRAMES:])
    lines = "".join([*frames, *traceback.format_exception_only(failure)]).splitlines()
    return "\n".join(line if len(line) < 400 else f"{line[:400]} ..." for line in lines) + "\n"


def main() -> int:
    """Fuzz, and give the exit status."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--cases", type=int, default=10_000, metavar="N", help="in all; 10000 unless given")
    parser.add_argument("--seed", type=int, default=0, metavar="N", help="decides which cases; 0 unless given")
    parser.add_argument("--only", default="", metavar="TEXT", help="targets whose name holds the text")
    options = parser.parse_args()

    # Commands keep what they have compiled; not where the user does.
    os.environ["XDG_CACHE_HOME"] = tempfile.mkdtemp(prefix="linemap-fuzz-cache-")
    jax.config.update("jax_enable_x64", True)
    sys.path.insert(0, str(ROOT / "tests"))
    fuzzing, fuzzing_files, fuzzing_scans = map(importlib.import_module, ("fuzzing", "fuzzing_files", "fuzzing_scans"))
    targets = [*fuzzing_files.TARGETS, *fuzzing_scans.TARGETS]
    targets = [target for target in targets if options.only in target.name]
    weights = sum(target.weight for target in targets)
    failed, cases, seconds = 0, 0, 0.0
    print(f"{'target':34s} {'cases':>7s} {'failures':>9s} {'seconds':>9s}")
    for target in targets:
        share = math.ceil(options.cases * target.weight / weights)
        outcome = fuzzing.run(target, share, seed=options.seed)
        print(f"{target.name:34s} {outcome.cases:7d} {len(outcome.failures):9d} {outcome.seconds:9.1f}", flush=True)
        for failure in outcome.failures:
            print(_told(failure), file=sys.stderr, flush=True)
        failed, cases, seconds = failed + len(outcome.failures), cases + outcome.cases, seconds + outcome.seconds
    print(f"{'in all':34s} {cases:7d} {failed:9d} {seconds:9.1f}")
    return 1 if failed else 0


if __name__ == "__main__":
    sys.exit(main())
