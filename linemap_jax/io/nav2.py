"""An occupancy grid as `map_server` of nav2 reads it: a picture in grey, and a YAML file beside it."""

import json
import os
from pathlib import Path

import numpy as np
from numpy.typing import ArrayLike

from linemap_jax.io.atomic import atomic_write

GREYS = {100: 0, 0: 254, -1: 205}
"""Of occupied, free and unknown cells, as `map_saver` writes them."""
OCCUPIED_THRESH, FREE_THRESH = 0.65, 0.196
"""Of (255 - grey) / 255. The grey of unknown cells has 0.1961, so that 0.25, as some files have it, makes them free."""


def files_of_nav2(path: str | os.PathLike[str]) -> tuple[Path, Path]:
    """The YAML file and the picture that `write_nav2` writes for a path."""
    path = Path(path) if Path(path).suffix in (".yaml", ".yml") else Path(path).with_suffix(".yaml")
    return path, path.with_suffix(".pgm")


def write_nav2(
    path: str | os.PathLike[str], cells: ArrayLike, origin: ArrayLike, resolution: float, *, overwrite: bool = False
) -> None:
    """Write `NAME.yaml`, and the picture `NAME.pgm` beside it.

    Args:
      path: of the YAML file; another ending than .yaml or .yml gives way to .yaml.
      cells: 100 where occupied, 0 where free, -1 where unknown; row 0 is the lowest y. Shape `[H, W]`.
      origin: the lower left corner of cell (0, 0), m. Shape `[2]`.
      resolution: side of a cell, m.
      overwrite: whether older files may be replaced.

    Raises:
      OutputError: if one of them exists and `overwrite` is false, or cannot be written.
    """
    values = np.asarray(cells)
    height, width = values.shape
    grey = np.full(values.shape, GREYS[-1], np.uint8)
    for value in (0, 100):
        grey[values == value] = GREYS[value]
    path, picture = files_of_nav2(path)
    x, y = np.asarray(origin, float).tolist()
    description = (
        f"image: {json.dumps(picture.name)}\n"  # a string of JSON is one of YAML
        "mode: trinary\n"
        f"resolution: {resolution:.10g}\n"
        f"origin: [{x:.10g}, {y:.10g}, 0.0]\n"
        "negate: 0\n"
        f"occupied_thresh: {OCCUPIED_THRESH}\n"
        f"free_thresh: {FREE_THRESH}\n"
    )
    with atomic_write(path, overwrite=overwrite) as text, atomic_write(picture, overwrite=overwrite) as image:
        text.write_text(description, encoding="utf-8", newline="\n")
        # A picture begins at its top, which is the highest y.
        image.write_bytes(b"P5\n%d %d\n255\n" % (width, height) + grey[::-1].tobytes())
