"""The README keeps its word: its Python runs, and its tables are complete."""

import dataclasses
import re
import subprocess
import sys
from importlib import resources
from pathlib import Path

import numpy as np
import pytest

from linemap_jax import Rules
from linemap_jax.cli.build import Build, Demo
from linemap_jax.cli.compare import Compare
from linemap_jax.cli.evaluate import Evaluate
from linemap_jax.cli.export import Export
from linemap_jax.cli.extract import Extract
from linemap_jax.cli.options import LogInput
from linemap_jax.cli.simulate import Simulate
from linemap_jax.io.exports import FORMATS
from linemap_jax.io.table import ResultsTable

README = (Path(__file__).resolve().parents[1] / "README.md").read_text(encoding="utf-8")


def table_below(heading: str, text: str = README) -> dict[str, list[str]]:
    """The rows of the first table after a heading: first cell, without its ticks, to the other cells."""
    below = text.split(f"\n## {heading}\n")[1]
    rows = re.search(r"(?:^\|.*\n)+", below, re.MULTILINE)
    assert rows is not None
    cells = [re.split(r"(?<!\\)\|", row)[1:-1] for row in rows[0].splitlines()[2:]]
    return {first.replace("`", "").strip(): [cell.strip() for cell in others] for first, *others in cells}


def test_the_python_runs_as_a_user_would_run_it(tmp_path):
    code = "\n".join(re.findall(r"^```python\n(.*?)^```", README, re.MULTILINE | re.DOTALL))
    assert "build_chunks" in code
    code += (
        "\nimport doctest, linemap_jax\nassert doctest.testmod(linemap_jax) == (0, 7)"  # help(linemap_jax), likewise
    )
    demo = resources.files("linemap_jax.io").joinpath("data", "demo.log.gz")
    (tmp_path / "my.log.gz").write_bytes(demo.read_bytes())
    ResultsTable(tmp_path / "results", {}).append(0, {"nees": np.array([8.0, 6.0]), "lines_on_walls": np.array([4, 3])})
    # Of the cache see [tool.pytest.ini_options] in pyproject.toml.
    warnings = "-W", "error", "-W", "ignore:Error reading persistent compilation cache entry:UserWarning"
    done = subprocess.run(
        [sys.executable, *warnings, "-c", code], cwd=tmp_path, capture_output=True, text=True, check=False
    )
    assert done.returncode == 0, done.stderr
    said = re.match(r"\[(\S+)\] \[(\S+)\]\n1 \[\[", done.stdout)
    assert "\nseen 10 times, at x = 4.0 m\n" in done.stdout
    mean = re.search(r"mean NEES (\S+), between (\S+) and (\S+) if the covariance holds\n9[45]\.", done.stdout)
    assert mean is not None, done.stdout
    assert float(mean[2]) <= float(mean[1]) <= float(mean[3])
    assert done.stdout.endswith("\n2.0\n")
    assert said is not None, done.stdout
    assert [float(number) for number in said.groups()] == pytest.approx([4, 0], abs=0.01)
    assert (tmp_path / "map.json").stat().st_size > 10_000


TABLES = {
    "From a log to a map": (Build, Extract, Demo),
    "Simulated drives, and how good a map is": (Simulate, Evaluate),
}


@pytest.mark.parametrize("heading", TABLES)
def test_the_tables_of_options_are_complete(heading):
    told = {re.findall(r"--([a-z-]+)", option)[0].replace("-", "_") for option in table_below(heading)}
    fields = {field.name for kind in TABLES[heading] for field in dataclasses.fields(kind)}
    of_input = {field.name for field in dataclasses.fields(LogInput)}  # told once
    assert told == fields - ({"log"} if Build in TABLES[heading] else {"map"} | of_input)


@pytest.mark.parametrize(
    ("heading", "option"),
    [
        *(("From a log to a map", x) for x in ("pose_sigma", "every", "preset", "jacobians", "dtype")),
        *(("Simulated drives, and how good a map is", x) for x in ("kind", "scans", "scanner", "pose_sigma")),
        *(("Simulated drives, and how good a map is", x) for x in ("pose_correlation", "turns", "seed", "distance")),
    ],
)
def test_the_defaults_of_the_options_are_those_of_the_command(heading, option):
    rows = table_below(heading).items()
    told = next(cells[0] for name, cells in rows if f"--{option.replace('_', '-')} " in name)
    fields = {field.name: field.default for kind in reversed(TABLES[heading]) for field in dataclasses.fields(kind)}
    default = fields[option]
    words = default if isinstance(default, tuple) else (default,)
    assert told.strip("`") == " ".join(f"{word:g}" if isinstance(word, float) else str(word) for word in words)


@pytest.mark.parametrize(("command", "command_of"), [(Export, "export"), (Compare, "compare")])
def test_the_options_of_the_commands_on_maps_are_complete(command, command_of):
    rows = README.split(f"| option of `{command_of}` |")[1].split("\n\n")[0].splitlines()[2:]
    told = {re.findall(r"--([a-z-]+)", row)[0].replace("-", "_") for row in rows}
    of_input = {field.name for field in dataclasses.fields(LogInput)}  # told once
    assert told == {field.name for field in dataclasses.fields(command)} - {"map", "a", "b"} - of_input


def test_the_table_of_formats_is_complete():
    rows = table_below("To other programs, and back")
    assert list(rows) == list(FORMATS)
    for name, (endings, _) in rows.items():
        assert f"`{FORMATS[name].ending}`" in endings


def test_the_table_of_departures_is_complete():
    assert list(table_below("The two presets")) == [field.name for field in dataclasses.fields(Rules)]


def section(anchor: str) -> str:
    """What stands below the heading that a link leads to."""
    for text in README.split("\n## ")[1:]:
        heading = text.split("\n", 1)[0]
        if re.sub(r"[^a-z0-9 -]", "", heading.lower()).replace(" ", "-") == anchor:
            return text
    raise AssertionError(f"no section #{anchor}")


def test_every_link_leads_to_a_section():
    for anchor in re.findall(r"\]\(#([^)]*)\)", README):
        assert section(anchor)


def test_every_figure_at_the_top_stands_in_a_table_that_was_measured():
    for claim, (figures, link) in table_below("What it gives that nothing else does").items():
        measured = "".join(re.findall(r"<!-- [a-z-]+:begin -->(.*?)<!--", section(link[8:-1]), re.DOTALL))
        for figure in re.findall(r"\d+\.\d+", figures):
            assert figure in measured, f"{claim}: {figure}"
