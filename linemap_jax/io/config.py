"""Settings from a TOML file, and into one."""

import dataclasses
import difflib
import os
import textwrap
import tomllib
from collections.abc import Iterable, Mapping
from pathlib import Path
from typing import Any

from linemap_jax.core.fields import meanings_of
from linemap_jax.core.settings import Persistence, Rules, SensorNoise, Thresholds

SECTIONS: dict[str, type] = {"thresholds": Thresholds, "noise": SensorNoise, "rules": Rules, "persistence": Persistence}
"""The tables of a settings file, and what their keys are the fields of."""

POSITIVE = {"range_sigma"}
"""Keys that may not be zero: without noise in the ranges every covariance would be singular."""


LARGEST = 1e15
"""Of what has a unit: its square is still finite in float32."""

_MOST_TOLD = 80  # characters


class ConfigError(Exception):
    """What is wrong with a settings file: one sentence that names the file and the cause."""


def read_config(path: str | os.PathLike[str]) -> dict[str, dict[str, Any]]:
    """Read a settings file: tables `[thresholds]`, `[noise]`, `[rules]`, `[persistence]`, each with some fields.

    Args:
      path: of the TOML file.

    Returns:
      For each table in the file, the fields that it sets.

    Raises:
      ConfigError: if the file cannot be read, is no TOML, has a table or key that does not exist (the message names the
        nearest one that does), or a value of the wrong kind.
    """
    try:
        tables = tomllib.loads(Path(path).read_text(encoding="utf-8"))
    except OSError as error:
        raise ConfigError(f"cannot read {os.fspath(path)}: {error.strerror or error}") from error
    except (ValueError, RecursionError) as error:  # no TOML, no text, or a number of thousands of digits
        raise ConfigError(f"{os.fspath(path)} is not a TOML file: {error}") from error
    for section, table in tables.items():
        if section not in SECTIONS:
            raise ConfigError(f"{os.fspath(path)}: no table [{_told(section)[1:-1]}]{_nearest(section, SECTIONS)}")
        if not isinstance(table, dict):
            raise ConfigError(f"{os.fspath(path)}: {section} must be a table, [{section}]")
        fields = {field.name for field in dataclasses.fields(SECTIONS[section])}
        for key, value in table.items():
            if key not in fields:
                raise ConfigError(f"{os.fspath(path)}: no key {_told(key)} in [{section}]{_nearest(key, fields)}")
            wanted = _wanted(section, key, value)
            if wanted is not None:
                raise ConfigError(f"{os.fspath(path)}: {key} in [{section}] must be {wanted}, not {_told(value)}")
    return tables


def config_text(settings: Mapping[str, Any]) -> str:
    """Settings as TOML that `read_config` reads, each key under a comment that tells its meaning and unit.

    Args:
      settings: for each table, an instance of its class in `SECTIONS`, of plain numbers.
    """
    blocks = []
    for section, instance in settings.items():
        lines = [f"[{section}]"]
        for name, (_, meaning) in meanings_of(SECTIONS[section]).items():
            value = getattr(instance, name)
            told = str(value).lower() if isinstance(value, bool) else repr(value)
            lines += [*textwrap.wrap(meaning, 96, initial_indent="# ", subsequent_indent="# "), f"{name} = {told}"]
        blocks.append("\n".join(lines))
    return "\n\n".join(blocks) + "\n"


def _wanted(section: str, key: str, value: Any) -> str | None:
    """What a value should be and is not; None if it may stand there."""
    if section == "rules":
        return None if isinstance(value, bool) else "true or false"
    if isinstance(value, bool) or not isinstance(value, int | float):
        return "a number"
    if not (0 <= value < float("inf") and (value > 0 or key not in POSITIVE)):
        return "positive" if key in POSITIVE else "zero or positive"
    largest = 1 if section == "persistence" else LARGEST
    return f"at most {largest:g}" if value > largest else None


def _told(value: Any) -> str:
    """A value or name of the file, as it may stand in a message."""
    try:
        said = ascii(value)
    except ValueError:  # Python does not print an integer of thousands of digits
        return "what it is"
    return said if len(said) <= _MOST_TOLD else f"{said[:_MOST_TOLD]}..."


def _nearest(name: str, known: Iterable[str]) -> str:
    near = difflib.get_close_matches(name, list(known), 1, 0.0)
    return f"; did you mean {near[0]!r}?" if near else ""
