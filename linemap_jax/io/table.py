"""A table of results that grows while an experiment runs, as Parquet.

The table is a folder: `_about.json` says what was run, and each chunk of rows is a file of its own, written in full or
not at all. Any reader of Parquet takes the folder for one table. A run that was killed goes on after the last chunk.
"""

import json
import os
import re
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
from numpy.typing import NDArray

from linemap_jax.io.atomic import atomic_write
from linemap_jax.io.reading import printable

Columns = Mapping[str, NDArray[Any]]
"""Name -> values; the first axis counts the rows."""

ABOUT = "_about.json"  # readers of Parquet folders pass over a name with an underscore
_PART = re.compile(r"rows-(\d{9})-(\d{9})\.parquet")


class TableError(Exception):
    """What is wrong with a table: one sentence that names it and the cause."""


class ResultsTable:
    """A table in a folder, to which rows are appended."""

    def __init__(self, folder: str | os.PathLike[str], about: Mapping[str, Any]) -> None:
        """Make the table, or go on with one of the same experiment.

        Args:
          folder: of the table; made if it is not there.
          about: everything that the rows depend on, as JSON can hold it.

        Raises:
          TableError: if the folder holds the table of another experiment, other files, or rows that do not follow one
            another.
        """
        self.folder = Path(folder)
        text = json.dumps(dict(about), indent=1, sort_keys=True)
        try:
            self.folder.mkdir(parents=True, exist_ok=True)
            here = sorted(path.name for path in self.folder.iterdir() if not path.name.startswith("."))
            if ABOUT in here:
                there = (self.folder / ABOUT).read_bytes()
                if there != text.encode():
                    raise TableError(f"{self.folder} holds the results of another experiment, {_other(there, text)}")
            elif here:
                raise TableError(f"{self.folder} is not empty and holds no table of results")
            else:
                with atomic_write(self.folder / ABOUT, overwrite=False) as path:
                    path.write_text(text, encoding="utf-8")
        except OSError as error:
            raise TableError(f"cannot make a table in {self.folder}: {error.strerror or error}") from error
        self.rows = sum(self._parts().values())
        """How many rows there are: where to go on."""

    def _parts(self) -> dict[int, int]:
        """First row and number of rows of each file."""
        matches = (_PART.fullmatch(path.name) for path in self.folder.iterdir())
        parts = dict(sorted((int(m[1]), int(m[2])) for m in matches if m))
        after = 0
        for first, count in parts.items():
            if first != after:
                raise TableError(f"{self.folder} lacks the rows from {after} to {first}")
            after = first + count
        return parts

    def append(self, first: int, columns: Columns) -> None:
        """Add rows behind those that are there.

        Args:
          first: index of the first of them.
          columns: arrays of numbers or truth values, `[R]`, or `[R, ...]` for lists.

        Raises:
          ValueError: if the rows do not follow those that are there, or columns differ in length.
          OutputError: if they cannot be written; the table is then as it was.
        """
        counts = {len(values) for values in columns.values()}
        if first != self.rows or len(counts) != 1:
            raise ValueError(f"{sorted(counts)} rows from {first} on do not follow {self.rows} rows")
        (count,) = counts
        table = pa.table({name: pa.array(np.asarray(values).tolist()) for name, values in columns.items()})
        with atomic_write(self.folder / f"rows-{first:09d}-{count:09d}.parquet", overwrite=False) as path:
            pq.write_table(table, path, write_page_checksum=True)
        self.rows += count

    def read(self) -> dict[str, NDArray[Any]]:
        """All rows.

        Raises:
          TableError: if a file is damaged.
        """
        parts = []
        for first, count in self._parts().items():
            name = f"rows-{first:09d}-{count:09d}.parquet"
            where = f"the table in {self.folder}, {name}"
            try:
                part = pq.read_table(self.folder / name, page_checksum_verification=True)
                part.schema.names  # noqa: B018  raises where a name is no text
            except (OSError, UnicodeDecodeError, pa.ArrowException) as error:
                raise TableError(f"cannot read {where}: {_told(error)}") from error
            if part.num_rows != count or (parts and part.schema != parts[0].schema):
                raise TableError(f"cannot read {where}: it holds other rows or columns than it should")
            parts.append(part)
        if not parts:
            return {}
        whole = pa.concat_tables(parts)
        return {name: np.asarray(whole.column(name).to_pylist()) for name in whole.column_names}


def _other(there: bytes, here: str) -> str:
    """In what two descriptions of experiments differ."""
    try:
        before, now = json.loads(there), json.loads(here)
        differing = [name for name in sorted({*before, *now}) if before.get(name) != now.get(name)]
        told = ((name, *(json.dumps(x.get(name)) for x in (before, now))) for name in differing)
        said = "; ".join(f"{name} {old} there and {new} here" for name, old, new in told)
    except (ValueError, TypeError, AttributeError, RecursionError):  # no JSON, or no table of names
        said = ""
    return printable(said) or f"see {ABOUT} in it"


def _told(error: Exception) -> str:
    """What an exception of the library says, in one line."""
    return printable(" ".join(str(error).split()).rstrip("."))
