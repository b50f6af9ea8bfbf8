"""Maps of line segments and circles from 2D range scans, with covariances that can be believed.

The method of J. Vandorpe, H. Van Brussel and H. Xu, *Exact Dynamic Map Building for a Mobile Robot using Geometrical
Primitives Produced by a 2D Range Finder*, ICRA 1996, pp. 901-908. In the order in which data flows:

  Scan.from_ranges       one range scan, masked
  Pose                   where the robot was, and how surely
  Thresholds, SensorNoise, Mount, Rules, Capacity, preset
                         the choices: `default`, or the paper to the letter
  extract                scan and pose -> Extraction: the lines and circles of this scan
  rho_theta              the paper's view of lines, for display and export
  empty_map, update      one scan into a LineMap, with a Report of what it did
  build, build_chunks    a whole log

All of it is pure functions of arrays in metres and radians, counter-clockwise, for `jit`, `vmap` and `grad`.

>>> import numpy as np
>>> from linemap_jax import Pose, Scan, empty_map, update
>>> bearings = np.radians(np.arange(-90.0, 90.5, 0.5))
>>> scan = Scan.from_ranges(2 / np.maximum(np.cos(bearings), 0.5), bearings, range_max=4.0)  # a wall 2 m ahead
>>> pose = Pose(mean=[0.0, 0.0, 0.0], cov=np.diag([0.05, 0.05, 0.01]) ** 2)
>>> line_map, report = update(empty_map(), scan, pose)
>>> print(f"{report.added} line, {line_map.lines.length[0]:.1f} m long")
1 line, 6.8 m long

`help` of each tells its shapes and units. What they are made of is in `linemap_jax.core`, SLAM in `linemap_jax.slam`,
experiments in `linemap_jax.lab`, files and pictures in `linemap_jax.io`; importing this module loads none of the last
three. `linemap verify` checks the paper equation by equation; `linemap --help` lists all commands.
"""

import os

# Read by jaxlib when it is loaded, which is below. Without it jaxlib prints long lines, at level "error", about
# features of the CPU whenever compiled code comes from the cache on the disk. Real faults still come as exceptions.
os.environ.setdefault("TF_CPP_MIN_LOG_LEVEL", "3")

from linemap_jax.build import build, build_chunks, grow
from linemap_jax.core.extract import extract
from linemap_jax.core.lines import rho_theta
from linemap_jax.core.mapping import empty_map, update
from linemap_jax.core.settings import (
    PAPER_RULES,
    PAPER_THRESHOLDS,
    SCAN_CAPACITY,
    Capacity,
    Mount,
    Persistence,
    Rules,
    SensorNoise,
    Thresholds,
    preset,
)
from linemap_jax.core.state import (
    LEFT_OUT,
    NEW,
    Circles,
    Extraction,
    LineMap,
    Lines,
    Pose,
    Rejected,
    Report,
    Scan,
    Status,
)

__version__ = "0.1.0"

__all__ = [
    "Scan",
    "Pose",
    "Thresholds",
    "SensorNoise",
    "Mount",
    "Persistence",
    "Capacity",
    "Rules",
    "preset",
    "extract",
    "Extraction",
    "Lines",
    "Circles",
    "Rejected",
    "rho_theta",
    "empty_map",
    "LineMap",
    "update",
    "Report",
    "Status",
    "NEW",
    "LEFT_OUT",
    "build",
    "build_chunks",
    "grow",
    "PAPER_RULES",
    "PAPER_THRESHOLDS",
    "SCAN_CAPACITY",
]
