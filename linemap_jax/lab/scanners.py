"""Models of scanners: from a world and a pose to a scan as a real instrument would report it."""

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Int

from linemap_jax.core.frames import rotate, unit
from linemap_jax.core.settings import Mount, Number, SensorNoise
from linemap_jax.core.state import Scan, pytree
from linemap_jax.lab.raycast import NOTHING, cast
from linemap_jax.lab.world import Time, World


@pytree
class Scanner:
    """An instrument. All numbers but the layout of the beams may be traced; without noise it is exact.

    A reading is the range along the true direction of the beam, plus noise, rounded to a multiple of `step`. The scan
    states the nominal bearing, from which the true direction differs by the noise of the bearing.
    """

    bearings: Float[Array, " N"]
    """Nominal direction of each beam in the frame of the scanner, in the order of the sweep, rad; see `sweep`."""
    range_sigma: Number = 0.0
    """Noise of a range, m."""
    relative_sigma: Number = 0.0
    """Noise of a range that grows with it, per unit; independent of the other."""
    bearing_sigma: Number = 0.0
    """Noise of the direction of a beam, rad."""
    step: Number = 0.0
    """Readings are multiples of this, m; 0 for no rounding."""
    dropout: Number = 0.0
    """Probability that a beam returns nothing."""
    range_min: Number = 0.0
    """Smallest range that is reported, m (inclusive)."""
    range_max: Number = float("inf")
    """Ranges from here on are not reported, m."""
    beam_width: Number | None = None
    """Angle that a beam covers, rad. A beam whose two sides meet different things reads something between them. None:
    beams have no width, which takes a third of the time."""


@pytree
class Truth:
    """What the beams of a scan really did."""

    bearings: Float[Array, " N"]
    """The true direction of each beam, in the frame of the scanner, rad."""
    ranges: Float[Array, " N"]
    """Ranges without noise; infinity where the beam meets nothing. m."""
    thing: Int[Array, " N"]
    """What it meets, as in `Hits`; `NOTHING` for a mixed reading."""
    mixed: Bool[Array, " N"]
    """Whether the reading lies between two things."""


def sweep(first: float, last: float, count: int) -> Float[Array, " N"]:
    """Bearings at equal distances, both ends included.

    Args:
      first: rad.
      last: rad; larger than `first` for a sweep to the left.
      count: of the beams.

    Returns:
      rad. Shape `[N]`.
    """
    return jnp.linspace(first, last, count)


def simulate_scan(
    key: Array,
    world: World,
    pose: Float[Array, "3"],
    scanner: Scanner,
    mount: Mount | None = None,
    *,
    scan_index: Time = 0,
) -> tuple[Scan, Truth]:
    """One scan of a world.

    Args:
      key: of the noise.
      world: what is around.
      pose: the true one, of the robot: x, y, theta. m, m, rad. Its dtype is that of the scan.
      scanner: `N` beams.
      mount: of the scanner on the robot.
      scan_index: when; tells which things are there.

    Returns:
      The scan, as the core takes it, and what the beams really did.
    """
    dtype, count = pose.dtype, scanner.bearings.shape[0]
    scanner = jax.tree.map(lambda x: jnp.asarray(x, dtype), scanner)
    placed = jax.tree.map(lambda x: jnp.asarray(x, dtype), mount or Mount())
    origin = pose[:2] + rotate(pose[2], jnp.stack([placed.x, placed.y]))
    heading = pose[2] + placed.theta
    of_noise, of_chance = jax.random.split(key)
    noise = jax.random.normal(of_noise, (2, count), dtype)
    chance = jax.random.uniform(of_chance, (2, count), dtype)

    bearings = scanner.bearings + scanner.bearing_sigma * noise[0]
    hits = cast(world, origin, unit(heading + bearings), scan_index=scan_index)
    ranges, thing, mixed = hits.ranges, hits.thing, jnp.zeros(count, bool)
    if scanner.beam_width is not None:
        sides = [
            cast(world, origin, unit(heading + bearings + side * scanner.beam_width), scan_index=scan_index)
            for side in (-0.5, 0.5)
        ]
        near, far = jnp.minimum(sides[0].ranges, sides[1].ranges), jnp.maximum(sides[0].ranges, sides[1].ranges)
        # Where one side meets nothing, nothing comes back from it, and the reading is that of the other.
        far = jnp.where(jnp.isfinite(far), far, near)
        mixed = (sides[0].thing != sides[1].thing) & (near < far)
        between = near + chance[0] * jnp.where(mixed, far - near, 0)
        ranges, thing = jnp.where(mixed, between, ranges), jnp.where(mixed, NOTHING, thing)

    seen = jnp.isfinite(ranges)
    sigma = jnp.hypot(scanner.range_sigma, scanner.relative_sigma * jnp.where(seen, ranges, 0))
    readings = ranges + sigma * noise[1]
    step = jnp.where(scanner.step > 0, scanner.step, 1)
    readings = jnp.where((scanner.step > 0) & seen, step * jnp.round(readings / step), readings)
    lost = chance[1] < scanner.dropout
    scan = Scan.from_ranges(
        jnp.where(lost, jnp.inf, readings),
        scanner.bearings,
        range_min=scanner.range_min,
        range_max=scanner.range_max,
    )
    return scan, Truth(bearings=bearings, ranges=ranges, thing=thing, mixed=mixed)


def simulate_scans(
    key: Array, world: World, poses: Float[Array, "T 3"], scanner: Scanner, mount: Mount | None = None
) -> tuple[Scan, Truth]:
    """A scan at each pose, the first one at scan index 0; as `simulate_scan`, stacked.

    Args:
      key: of all noise.
      world: what is around.
      poses: of the robot, the true ones. m, m, rad. Shape `[T, 3]`.
      scanner: the instrument.
      mount: of the scanner on the robot.

    Returns:
      The scans and what their beams met, `T` of them stacked.
    """
    count = poses.shape[0]

    def one(key: Array, pose: Float[Array, "3"], index: Int[Array, ""]) -> tuple[Scan, Truth]:
        return simulate_scan(key, world, pose, scanner, mount, scan_index=index)

    return jax.vmap(one)(jax.random.split(key, count), poses, jnp.arange(count))


def noise_of(scanner: Scanner, *, at: Number = 5.0) -> SensorNoise:
    """What a map builder should believe of a scanner; rounding counts as noise of its variance, step^2 / 12.

    Args:
      scanner: the instrument.
      at: the range at which noise that grows with the range is taken, m.

    Returns:
      Standard deviations of a range, m, and of a bearing, rad.
    """
    variance = jnp.square(scanner.range_sigma) + jnp.square(scanner.relative_sigma * at) + jnp.square(scanner.step) / 12
    return SensorNoise(range_sigma=jnp.sqrt(variance), bearing_sigma=jnp.asarray(scanner.bearing_sigma))


def pls() -> Scanner:
    """SICK PLS, the scanner of the paper (section 2): 180 degrees, every 0.5 degree, up to 50 m.

    The paper states an accuracy of less than 5 cm, and no more. We read it as the largest error that is met, three
    sigma: 1.67 cm; with 5 cm for a sigma, one beam in three would be outside. Ours too: readings in cm, the beam width
    of the LMS 200, which shares the optics, the noise of the bearing, and the share of beams that get lost.
    """
    return _sick(range_sigma=0.05 / 3, range_max=50.0)


def lms200() -> Scanner:
    """SICK LMS 200, indoors, in its cm mode: 180 degrees, every 0.5 degree, up to 80 m.

    Source: LMS200/211/221/291 Laser Measurement Systems, Technical Description (SICK 8008970): statistical error 5 mm
    (one sigma, up to 8 m), resolution 10 mm, beam divergence 0.25 degree. Its systematic error, up to 4 cm in this
    mode, is left out; the noise of the bearing and the share of beams that get lost are ours.
    """
    return _sick(range_sigma=0.005, range_max=80.0)


def utm30lx() -> Scanner:
    """Hokuyo UTM-30LX: 270 degrees, every 0.25 degree, 0.1 m to 30 m.

    Source: Scanning Laser Range Finder UTM-30LX/LN Specification (Hokuyo C-42-3615): repeated accuracy 10 mm up to 10 m
    and 30 mm up to 30 m (one sigma; here 10 mm and 28 mm), resolution 1 mm. Beam width, noise of the bearing and lost
    beams are ours.
    """
    return Scanner(
        bearings=sweep(-0.75 * np.pi, 0.75 * np.pi, 1081),
        range_sigma=0.005,
        relative_sigma=0.0009,
        bearing_sigma=0.0005,
        step=0.001,
        dropout=0.002,
        range_min=0.1,
        range_max=30.0,
        beam_width=0.002,
    )


def rplidar_a1() -> Scanner:
    """Slamtec RPLIDAR A1M8: all around, every degree, 0.15 m to 12 m.

    Source: RPLIDAR A1 Introduction and Datasheet, model A1M8 (Slamtec, 2016): distance resolution below 1 % of the
    distance, 360 readings a turn at 5.5 Hz; its protocol reports quarters of a millimetre. The 1 % are read as two
    sigma; the constant 2 mm, beam width, noise of the bearing and lost beams are ours.
    """
    return Scanner(
        bearings=sweep(-np.pi, np.pi * 179 / 180, 360),
        range_sigma=0.002,
        relative_sigma=0.005,
        bearing_sigma=0.003,
        step=0.00025,
        dropout=0.02,
        range_min=0.15,
        range_max=12.0,
        beam_width=0.005,
    )


PRESETS = {"pls": pls, "lms200": lms200, "utm30lx": utm30lx, "rplidar_a1": rplidar_a1}
"""The instruments, by name."""


def _sick(*, range_sigma: float, range_max: float) -> Scanner:
    return Scanner(
        bearings=sweep(-np.pi / 2, np.pi / 2, 361),
        range_sigma=range_sigma,
        bearing_sigma=0.001,
        step=0.01,
        dropout=0.002,
        range_max=range_max,
        beam_width=float(np.radians(0.25)),
    )
