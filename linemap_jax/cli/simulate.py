"""`linemap simulate`: a drive through a world, as a log and its truth."""

import dataclasses
from pathlib import Path
from typing import Annotated, Literal

import tyro

from linemap_jax.cli.compilations import keep_compilations
from linemap_jax.cli.options import ScannerName, UsageError, check_drive
from linemap_jax.cli.output import check_output, make_folder
from linemap_jax.cli.worlds import WorldKind, made_world, world_from_file

SCAN_SECONDS = 0.2
"""Between two simulated scans."""


@dataclasses.dataclass(frozen=True, kw_only=True)
class Simulate:
    """Simulate a drive: writes a CARMEN log, scans.log.gz, and the truth, world.geojson and poses.tum."""

    output: Annotated[Path, tyro.conf.arg(aliases=["-o"], metavar="DIR")]
    """Folder for the log and the truth; made if it is not there."""
    world: Annotated[Path | None, tyro.conf.arg(metavar="FILE.geojson")] = None
    """World to drive through, with a path; in place of --kind."""
    kind: WorldKind = "laboratory"
    """World to make."""
    scans: Annotated[int, tyro.conf.arg(metavar="N")] = 300
    """Number of scans along the path."""
    scanner: ScannerName = "pls"
    """The instrument."""
    pose_sigma: Annotated[tuple[float, float, float], tyro.conf.arg(metavar="X Y THETA")] = (0.01, 0.01, 0.002)
    """Standard deviations of every pose of the log, m m rad."""
    pose_correlation: Annotated[float, tyro.conf.arg(metavar="A")] = 0.0
    """Of the pose errors, from one scan to the next: 0 for independent ones, 1 for one error that stays."""
    turns: Literal["smooth", "spot"] = "smooth"
    """How the robot takes the corners of its path: cut by arcs, or turning on the spot."""
    seed: Annotated[int, tyro.conf.arg(metavar="N")] = 0
    """Decides everything that is left to chance."""
    overwrite: bool = False
    """Replace output that is there already."""
    quiet: bool = False
    """No summary."""

    def run(self) -> int:
        """Simulate the drive, and give the exit status."""
        check_drive(
            scans=self.scans, pose_sigma=self.pose_sigma, pose_correlation=self.pose_correlation, seed=self.seed
        )
        import jax

        jax.config.update("jax_enable_x64", True)
        keep_compilations()
        import jax.numpy as jnp
        import numpy as np

        from linemap_jax.io.carmen_writer import write_carmen
        from linemap_jax.io.tum import write_tum
        from linemap_jax.io.worlds import write_world
        from linemap_jax.lab.check import WorldError, check
        from linemap_jax.lab.robot import dead_reckoning
        from linemap_jax.lab.scanners import PRESETS, noise_of
        from linemap_jax.lab.simulate import simulate
        from linemap_jax.lab.world import arrays_from_world

        files = log_file, world_file, poses_file = [
            self.output / name for name in ("scans.log.gz", "world.geojson", "poses.tum")
        ]
        check_output(self.output, *files, overwrite=self.overwrite)
        of_world, of_drive = jax.random.split(jax.random.key(self.seed))
        name, scanner = str(self.world or self.kind), PRESETS[self.scanner]()
        world = world_from_file(self.world) if self.world else made_world(self.kind, of_world, scans=self.scans)
        if not world.path.shape[0]:
            raise UsageError(f"{name} has no path for the robot")
        try:
            check(world)
            run = jax.jit(simulate, static_argnames=("count", "turns"))
            log = run(
                of_drive,
                world,
                scanner,
                count=self.scans,
                cov_pose=jnp.diag(jnp.square(jnp.asarray(self.pose_sigma))),
                correlation=self.pose_correlation,
                turns=self.turns,
            )
            check(world, log.true_poses)
        except WorldError as error:
            raise UsageError(f"{name}: {error}") from error

        stamps = SCAN_SECONDS * np.arange(self.scans)
        given = f"{self.scanner}, pose sigma {self.pose_sigma}, correlation {self.pose_correlation}"
        make_folder(self.output)
        write_carmen(
            log_file,
            ranges=np.where(log.scans.valid, log.scans.ranges, 0),
            bearings=scanner.bearings,
            range_max=float(scanner.range_max),
            poses=log.poses.mean,
            odometry=dead_reckoning(log.true_poses[0], log.odometry),
            timestamps=stamps,
            comments=[f"simulated by linemap: {ascii(name)}, {given}, seed {self.seed}"],
            overwrite=self.overwrite,
        )
        write_world(world_file, arrays_from_world(world), overwrite=self.overwrite)
        write_tum(poses_file, stamps, log.true_poses, overwrite=self.overwrite)
        if not self.quiet:
            metres = np.hypot(*np.diff(np.asarray(log.true_poses)[:, :2], axis=0).T).sum()
            noise = noise_of(scanner)
            sigmas = " ".join(f"{sigma:g}" for sigma in self.pose_sigma)
            print(
                f"{self.scans} scans of {len(scanner.bearings)} beams along {metres:.1f} m -> {log_file}\n"
                f"truth: {world_file}, {poses_file}\n"
                f"noise: --range-sigma {float(noise.range_sigma):.4g} --bearing-sigma {float(noise.bearing_sigma):g} "
                f"--pose-sigma {sigmas}"
            )
        return 0
