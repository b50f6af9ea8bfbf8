"""`linemap extract`: the lines and circles of each scan."""

import dataclasses
from pathlib import Path
from typing import Annotated

import tyro

from linemap_jax.cli.logs import chunks_of_log, opened, progress, warn
from linemap_jax.cli.options import LogOptions, options_of_update, own_options_first
from linemap_jax.cli.output import say
from linemap_jax.cli.rejections import Rejections


@own_options_first
@dataclasses.dataclass(frozen=True, kw_only=True)
class Extract(LogOptions):
    """Extract lines and circles scan by scan: one JSON line a scan, in the frame of the sensor."""

    log: tyro.conf.Positional[Path]
    """CARMEN log, plain or .gz; ROS 1 .bag; ROS 2 bag: its folder, .mcap or .db3."""
    output: Annotated[Path, tyro.conf.arg(aliases=["-o"], metavar="FILE.jsonl")]
    """File to write."""

    def run(self) -> int:
        """Write them, and give the exit status."""
        options = options_of_update(self)
        from linemap_jax.build import CHUNK, extract_chunk
        from linemap_jax.core.settings import SCAN_CAPACITY
        from linemap_jax.io.atomic import atomic_write
        from linemap_jax.io.jsonl import lines_of_extraction

        del options["persistence"]  # the result stands in the frame of the sensor
        log = opened(self, self.log, need_poses=False)
        capacity, written, rejections = SCAN_CAPACITY, 0, Rejections()
        with atomic_write(self.output, overwrite=self.overwrite) as path, path.open("w", encoding="utf-8") as file:
            with progress(log, quiet=self.quiet):
                for chunk in chunks_of_log(self, log, CHUNK):
                    found, capacity = extract_chunk(chunk.scans, capacity=capacity, **options)
                    rejections.add(found)
                    for line in lines_of_extraction(chunk.timestamps, chunk.poses, found):
                        file.write(line + "\n")
                        written += 1
        warn(log, quiet=self.quiet)
        if not rejections.found:
            say(f"warning: {self.log}: {rejections}", quiet=self.quiet)
        say(f"{written} scans -> {self.output}", quiet=self.quiet)
        return 0
