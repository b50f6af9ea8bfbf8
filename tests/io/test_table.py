"""Tables of results: whole or not there, resumed, never mixed up."""

import contextlib
import json

import numpy as np
import pyarrow.parquet as pq
import pytest

from linemap_jax.io.atomic import OutputError
from linemap_jax.io.table import ABOUT, ResultsTable, TableError

ABOUT_IT = {"runs": 7, "seed": 3, "scanner": "pls"}


def rows(first: int, count: int) -> dict[str, np.ndarray]:
    index = np.arange(first, first + count)
    return {"run": index, "nees": index / 8, "found": index % 2 == 0, "by_line": np.stack([index, -index], -1)}


def test_rows_come_back_and_any_reader_of_parquet_sees_one_table(tmp_path):
    table = ResultsTable(tmp_path / "results", ABOUT_IT)
    assert table.rows == 0
    assert table.read() == {}
    table.append(0, rows(0, 4))
    table.append(4, rows(4, 3))
    for name, values in rows(0, 7).items():
        np.testing.assert_array_equal(table.read()[name], values)
    whole = pq.read_table(tmp_path / "results")
    assert sorted(whole.column("run").to_pylist()) == list(range(7))


def test_a_killed_run_goes_on_where_it_stopped(tmp_path):
    ResultsTable(tmp_path, ABOUT_IT).append(0, rows(0, 4))
    (tmp_path / ".linemap-0123456789ab.parquet").write_bytes(b"half a chunk")  # what a kill leaves behind
    again = ResultsTable(tmp_path, ABOUT_IT)
    assert again.rows == 4
    again.append(4, rows(4, 3))
    np.testing.assert_array_equal(again.read()["nees"], np.arange(7) / 8)


def test_a_full_disk_leaves_the_table_as_it_was(tmp_path, monkeypatch):
    table = ResultsTable(tmp_path, ABOUT_IT)
    table.append(0, rows(0, 2))

    def full(*_, **__):
        raise OSError(28, "No space left on device")

    monkeypatch.setattr(pq, "write_table", full)
    with pytest.raises(OutputError, match="No space left on device"):
        table.append(2, rows(2, 2))
    assert table.rows == ResultsTable(tmp_path, ABOUT_IT).rows == 2
    assert sorted(path.name for path in tmp_path.iterdir()) == [ABOUT, "rows-000000000-000000002.parquet"]


def test_another_experiment_is_not_mixed_in(tmp_path):
    ResultsTable(tmp_path, ABOUT_IT)
    assert json.loads((tmp_path / ABOUT).read_text()) == ABOUT_IT
    with pytest.raises(TableError, match="holds the results of another experiment, seed 3 there and 4 here$"):
        ResultsTable(tmp_path, ABOUT_IT | {"seed": 4})


def test_other_peoples_files_are_left_alone(tmp_path):
    (tmp_path / "thesis.tex").write_text("do not lose me")
    with pytest.raises(TableError, match="is not empty"):
        ResultsTable(tmp_path, ABOUT_IT)
    assert [path.name for path in tmp_path.iterdir()] == ["thesis.tex"]


def test_a_missing_chunk_is_noticed(tmp_path):
    table = ResultsTable(tmp_path, ABOUT_IT)
    table.append(0, rows(0, 2))
    table.append(2, rows(2, 2))
    (tmp_path / "rows-000000000-000000002.parquet").unlink()
    with pytest.raises(TableError, match="lacks the rows from 0 to 2"):
        ResultsTable(tmp_path, ABOUT_IT)


def test_a_damaged_chunk_is_named(tmp_path):
    table = ResultsTable(tmp_path, ABOUT_IT)
    table.append(0, rows(0, 2))
    (tmp_path / "rows-000000000-000000002.parquet").write_bytes(b"PAR1 nonsense")
    with pytest.raises(TableError, match="cannot read the table"):
        table.read()


def test_a_number_that_has_changed_on_the_disk_is_noticed(tmp_path):
    table = ResultsTable(tmp_path, ABOUT_IT)
    table.append(0, rows(0, 2))
    path = tmp_path / "rows-000000000-000000002.parquet"
    content = path.read_bytes()
    for at in range(4, len(content) - 8, 7):
        path.write_bytes(content[:at] + bytes([content[at] ^ 255]) + content[at + 1 :])
        with contextlib.suppress(TableError):
            np.testing.assert_array_equal(table.read()["nees"], np.arange(2) / 8)


def test_a_chunk_of_other_rows_than_its_name_says_is_noticed(tmp_path):
    table = ResultsTable(tmp_path, ABOUT_IT)
    table.append(0, rows(0, 2))
    (tmp_path / "rows-000000000-000000002.parquet").rename(tmp_path / "rows-000000000-000000003.parquet")
    with pytest.raises(TableError, match="holds other rows or columns than it should"):
        table.read()


@pytest.mark.parametrize("content", [b"\xff\xfe", b"[" * 100_000, b"7", json.dumps(ABOUT_IT).encode()])
def test_a_description_that_is_another_text_is_that_of_another_experiment(tmp_path, content):
    ResultsTable(tmp_path, ABOUT_IT)
    (tmp_path / ABOUT).write_bytes(content)
    with pytest.raises(TableError, match=f"another experiment, see {ABOUT} in it$"):
        ResultsTable(tmp_path, ABOUT_IT)


@pytest.mark.parametrize("first", [0, 3])
def test_rows_must_follow(tmp_path, first):
    table = ResultsTable(tmp_path, ABOUT_IT)
    table.append(0, rows(0, 2))
    with pytest.raises(ValueError, match="do not follow"):
        table.append(first, rows(first, 2))


def test_a_folder_that_cannot_be_made(tmp_path):
    (tmp_path / "file").write_text("")
    with pytest.raises(TableError, match="cannot make a table"):
        ResultsTable(tmp_path / "file" / "results", ABOUT_IT)
