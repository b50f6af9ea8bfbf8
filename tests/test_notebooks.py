"""The notebooks run, and what stands in them is the outcome of a full run from top to bottom."""

import json
import os
import subprocess
import sys
from pathlib import Path

import nbformat
import pytest

ROOT = Path(__file__).resolve().parents[1]
NOTEBOOKS = sorted((ROOT / "notebooks").glob("*.ipynb"))
LARGEST = 700_000
"""Bytes of a notebook with its pictures: whoever clones the project pays for them."""

each_notebook = pytest.mark.parametrize("path", NOTEBOOKS, ids=lambda path: path.stem)


def run_notebooks(*arguments: str | Path) -> subprocess.CompletedProcess[str]:
    """The script that runs notebooks, in quick mode; in a process of its own, which warnings may not end."""
    more = {
        "LINEMAP_QUICK": "1",
        "PYTHONPATH": os.pathsep.join(filter(None, [str(ROOT), os.environ.get("PYTHONPATH")])),
    }
    return subprocess.run(
        [sys.executable, ROOT / "scripts/run_notebooks.py", *arguments],
        env=os.environ | more,
        capture_output=True,
        text=True,
        check=False,
    )


def code_cells(path: Path) -> list[dict]:
    """Those that hold code; there is at least one."""
    cells = [cell for cell in json.loads(path.read_text(encoding="utf-8"))["cells"] if cell["cell_type"] == "code"]
    assert cells
    return cells


def kinds_of_output(cell: dict) -> set[str]:
    """Such as "display_data"; that of a stream is its name."""
    return {output.get("name", output["output_type"]) for output in cell["outputs"]}


@each_notebook
def test_it_runs(path, tmp_path):
    before = path.read_bytes()
    done = run_notebooks("-o", tmp_path, path)
    assert done.returncode == 0, done.stderr
    assert path.read_bytes() == before
    quick, kept = code_cells(tmp_path / path.name), code_cells(path)
    assert [cell["source"] for cell in quick] == [cell["source"] for cell in kept]
    for cell, other in zip(quick, kept, strict=True):
        # A first run of matplotlib tells on stderr that it makes its cache of fonts.
        assert kinds_of_output(cell) - {"stderr"} == kinds_of_output(other)


@each_notebook
def test_its_outputs_are_kept(path):
    cells = code_cells(path)
    assert [cell["execution_count"] for cell in cells] == list(range(1, len(cells) + 1))
    for cell in cells:
        kinds = kinds_of_output(cell)
        assert kinds, cell["source"]
        assert not kinds & {"error", "stderr"}, cell["outputs"]
    assert "(quick)" not in json.dumps([cell["outputs"] for cell in cells])
    assert path.stat().st_size < LARGEST


def test_a_cell_that_takes_too_long_is_told(tmp_path):
    path = tmp_path / "slow.ipynb"
    cells = [nbformat.v4.new_code_cell("import time\ntime.sleep(60)")]
    nbformat.write(nbformat.v4.new_notebook(cells=cells), path)
    before = path.read_bytes()
    done = run_notebooks("--timeout", "1", "-o", tmp_path, path)
    assert done.returncode == 1
    assert f"{path}: a cell took longer than 1 s; on a slow or busy machine give --timeout SECONDS" in done.stderr
    assert "time.sleep(60)" in done.stderr
    assert "Traceback" not in done.stderr
    assert path.read_bytes() == before
