"""Run the notebooks from top to bottom, and keep their outputs.

Usage: python scripts/run_notebooks.py [-o FOLDER] [--timeout SECONDS] [NOTEBOOK ...]

Without names, all of `notebooks/`. The outputs go into the notebooks themselves, or with -o into copies in a folder.
With LINEMAP_QUICK=1 in the environment notebooks take fewer runs, for the tests; such outputs are not kept in place.
Ends with status 1 at the first cell that fails or takes too long, and then writes nothing of that notebook. Needs what
the extra `notebooks` installs.
"""

import argparse
import os
import sys
from pathlib import Path

try:
    import nbformat
    from nbclient import NotebookClient
    from nbclient.exceptions import CellExecutionError, CellTimeoutError
except ImportError as error:
    sys.exit(f"run_notebooks.py: {error}; pip install '.[notebooks]' brings what runs notebooks")

NOTEBOOKS = Path(__file__).resolve().parents[1] / "notebooks"
TIMEOUT = 300
"""Of one cell, s: several times what the longest one takes on two idle cores."""


def main() -> int:
    """Run what is asked for."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0] if __doc__ else None)
    parser.add_argument("notebooks", nargs="*", type=Path, metavar="NOTEBOOK", help="default: all of notebooks/")
    parser.add_argument("-o", "--output", type=Path, metavar="FOLDER", help="for the copies with outputs")
    parser.add_argument(
        "--timeout", type=int, default=TIMEOUT, metavar="SECONDS", help="for each cell; default: %(default)s"
    )
    options = parser.parse_args()
    if options.output is None and os.environ.get("LINEMAP_QUICK") == "1":
        parser.error("LINEMAP_QUICK=1 is for the tests: the notebooks keep the outputs of full runs; or give -o FOLDER")
    if options.output is not None:
        options.output.mkdir(parents=True, exist_ok=True)
    for path in options.notebooks or sorted(NOTEBOOKS.glob("*.ipynb")):
        try:
            text = run(path, timeout=options.timeout)
        except CellExecutionError as error:
            print(f"{path}: {error}", file=sys.stderr)
            return 1
        except CellTimeoutError as error:
            print(
                f"{path}: a cell took longer than {options.timeout} s; "
                f"on a slow or busy machine give --timeout SECONDS.\n{error}",
                file=sys.stderr,
            )
            return 1
        (options.output or path.parent).joinpath(path.name).write_text(text, encoding="utf-8")
    return 0


def run(path: Path, *, timeout: int) -> str:
    """A notebook with new outputs, without what differs between two runs of the same code."""
    notebook = nbformat.read(path, as_version=4)
    client = NotebookClient(
        notebook,
        timeout=timeout,
        kernel_name="python3",
        record_timing=False,
        shutdown_kernel="immediate",  # one that is asked to stop within a cell complains
        resources={"metadata": {"path": str(path.parent)}},
        extra_arguments=["--log-level=ERROR"],  # the kernel would warn of how it talks to us
    )
    client.execute()
    notebook.metadata.language_info = {"name": "python"}
    return nbformat.writes(notebook) + "\n"


if __name__ == "__main__":
    sys.exit(main())
