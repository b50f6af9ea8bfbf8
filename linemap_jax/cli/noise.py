"""The noise of the scanner, where a command goes on from a map: that of the map, unless the command states another."""

import dataclasses
import math
from collections.abc import Mapping
from typing import TYPE_CHECKING, Any

from linemap_jax.cli.options import LogOptions

if TYPE_CHECKING:
    from linemap_jax.core.settings import SensorNoise


def states_noise(command: LogOptions) -> bool:
    """Whether the command says what the noise is."""
    from linemap_jax.io.config import read_config

    given = (command.scanner, command.range_sigma, command.bearing_sigma)
    return any(x is not None for x in given) or bool(command.config and "noise" in read_config(command.config))


def noise_of_map(settings: Mapping[str, Any]) -> "SensorNoise | None":
    """The noise that a map was built with; None if it does not tell, or was merged of maps that differ."""
    from linemap_jax.core.settings import SensorNoise

    merged, noise = settings.get("merged"), settings.get("noise")
    if isinstance(merged, list) and merged:
        first, *others = (noise_of_map(each) if isinstance(each, Mapping) else None for each in merged)
        return first if all(each == first for each in others) else None
    names = [field.name for field in dataclasses.fields(SensorNoise)]
    if not (isinstance(noise, Mapping) and all(_is_sigma(noise.get(name)) for name in names)):
        return None
    return SensorNoise(**{name: float(noise[name]) for name in names})


def tell_noise(noise: "SensorNoise", *, stated: bool) -> str:
    """The noise that a command has taken, in words; and where to learn another, if nobody has stated it."""
    whose = "" if stated else "; nobody has stated it: `linemap calibrate` tells that of the log"
    return f"{noise.range_sigma:.3g} m of ranges, {noise.bearing_sigma:.2g} rad of bearings{whose}"


def _is_sigma(value: Any) -> bool:
    return isinstance(value, int | float) and 0 <= value < math.inf
