"""Maps of line segments and circles from 2D range scans, with covariances that can be believed.

The names below stand in the order of the pipeline. Files and pictures are in `linemap_jax.io`, experiments in
`linemap_jax.lab`; importing this module loads neither.
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

__version__ = "0.1.0.dev0"

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
