"""What a map is worth, held against the truth of a simulated world.

`evaluate` holds one map against the truth; `look` keeps what the beams have seen of it, since only that can be missed.
What happens over time is told scan by scan: `held` and `beams_on_objects` after each, `scans_until` of all of them.
"""

import dataclasses
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int

from linemap_jax.core.fields import documented
from linemap_jax.core.frames import dot, perp, rotate, unit
from linemap_jax.core.settings import Mount, Number
from linemap_jax.core.state import Circles, Extraction, LineMap, Lines, Scan, pytree
from linemap_jax.lab.consistency import line_error, nees, walls_of
from linemap_jax.lab.raycast import NOTHING, cast
from linemap_jax.lab.scanners import Truth
from linemap_jax.lab.world import NEVER, Kind, Time, World, there

CELLS = 128
"""Cells of a straight piece, unless told otherwise: 10 cm each up to 12.8 m."""
MIN_RETURNS = 3
"""A scan has seen a pole if so many beams came back from it: fewer points make no circle."""
GONE = 0.1
"""An object of which the map holds less than this is gone from it."""
THERE = 0.5
"""An object of which the map holds this much is in it."""


@pytree
class Gates:
    """What counts as the same, when a map is held against the truth."""

    distance: Number = 0.05
    """How far a line may lie from a wall, and the centre of a circle outside of a pole, m."""
    angle: Number = 0.087
    """Largest difference of direction of a line and a wall, rad (5 degrees)."""
    overlap: Number = 0.3
    """A wall is held twice if this much of it is, m, or half of it where that is less. What is free on both sides (a
    chain, `Kind.WALL`) has two faces, and may have a line on each."""
    cell: Number = 0.1
    """Walls and lines are divided into equal cells no longer than this, m, as long as the number of cells suffices.
    Lengths are sums of cells, each judged by its middle."""
    scans: Number = 1
    """A cell or a pole was seen if it was in so many scans."""


@pytree
class Seen:
    """In how many scans beams came back from the things of a world."""

    cells: Int[Array, "S P"]
    """Returns from each cell of each segment, as `Gates.cell` and `P` divide it."""
    poles: Int[Array, " C"]
    """Returns from each pole, `MIN_RETURNS` or more."""


def seen_nothing(world: World, *, cells: int = CELLS) -> Seen:
    """Before the first scan. More cells than are needed cost time only.

    Args:
      world: of `S` segments and `C` poles.
      cells: into how many cells a segment is divided at most; more than are needed cost time only.

    Returns:
      Zeros.
    """
    segments, poles = world.segments.valid.shape[0], world.poles.valid.shape[0]
    return Seen(cells=jnp.zeros((segments, cells), jnp.int32), poles=jnp.zeros(poles, jnp.int32))


def seen_everything(world: World, *, cells: int = CELLS) -> Seen:
    """As if each cell and pole had been seen in more scans than anyone asks for.

    Args:
      world: of `S` segments and `C` poles.
      cells: as of `seen_nothing`.

    Returns:
      Large numbers.
    """
    return jax.tree.map(lambda x: jnp.full_like(x, NEVER), seen_nothing(world, cells=cells))


def look(
    seen: Seen,
    world: World,
    scan: Scan,
    truth: Truth,
    pose: Float[Array, "3"],
    mount: Mount | None = None,
    *,
    gates: Gates | None = None,
) -> Seen:
    """What has been seen after one more scan.

    Args:
      seen: after the scans before.
      world: of `S` segments and `C` poles.
      scan: tells which beams came back.
      truth: what they met: of `simulate_scan`, or of `expected`.
      pose: the true one, of the robot.
      mount: of the scanner on the robot.
      gates: `cell`; the same for all scans.

    Returns:
      The numbers of scans, with this one.
    """
    gates = gates or Gates()
    segments, poles = world.segments.valid.shape[0], world.poles.valid.shape[0]
    of_wall = jnp.where(scan.valid & (truth.thing < segments), truth.thing, NOTHING)
    of_pole = jnp.where(scan.valid & (truth.thing >= segments), truth.thing - segments, poles)
    cells = seen.cells
    if segments:
        origin, heading = _placed(pose, mount)
        walls = _walls(world)
        divided = _divide(walls, gates.cell, cells.shape[1])
        position = origin[None] + jnp.where(of_wall < 0, 0, truth.ranges)[:, None] * unit(heading + truth.bearings)
        along = dot(position - walls.begin[of_wall], walls.tangent[of_wall])
        cell = jnp.floor(along / divided.size[of_wall]).astype(jnp.int32)
        cell = jnp.clip(cell, 0, divided.number[of_wall] - 1)
        hit = jnp.zeros(cells.shape, bool).at[jnp.where(of_wall < 0, segments, of_wall), cell].set(True, mode="drop")
        cells = cells + hit
    returns = jnp.zeros(poles, jnp.int32).at[of_pole].add(1, mode="drop")
    return Seen(cells=cells, poles=seen.poles + (returns >= MIN_RETURNS))


def expected(
    world: World, scan: Scan, pose: Float[Array, "3"], mount: Mount | None = None, *, scan_index: Time = 0
) -> Truth:
    """What the beams of a scan would meet without any noise: the truth where it is not known, as of a real log.

    Args:
      world: what is around.
      scan: of which only the bearings count.
      pose: of the robot.
      mount: of the scanner on the robot.
      scan_index: when.

    Returns:
      What each beam meets, and how far away.
    """
    origin, heading = _placed(pose, mount)
    hits = cast(world, origin, unit(heading + scan.bearings), scan_index=scan_index)
    return Truth(
        bearings=scan.bearings, ranges=hits.ranges, thing=hits.thing, mixed=jnp.zeros(scan.bearings.shape, bool)
    )


@jax.jit
def survey(
    seen: Seen,
    world: World,
    scans: Scan,
    poses: Float[Array, "T 3"],
    mount: Mount | None = None,
    *,
    first: Time = 0,
    gates: Gates | None = None,
) -> Seen:
    """What has been seen after some scans of a log, if its poses are believed and each return is one of the truth.

    Args:
      seen: after the scans before.
      world: the truth.
      scans: stacked scans, `[T, N]`.
      poses: of the robot. Shape `[T, 3]`.
      mount: of the scanner on the robot.
      first: scan index of the first one.
      gates: `cell`.

    Returns:
      The numbers of scans, with these.
    """

    def step(seen: Seen, x: tuple[Scan, Array, Array]) -> tuple[Seen, None]:
        scan, pose, index = x
        met = expected(world, scan, pose, mount, scan_index=index)
        return look(seen, world, scan, met, pose, mount, gates=gates), None

    return jax.lax.scan(step, seen, (scans, poses, first + jnp.arange(poses.shape[0])))[0]


def beams_on_objects(
    world: World,
    scan: Scan,
    truth: Truth,
    pose: Float[Array, "3"],
    mount: Mount | None = None,
    *,
    scan_index: Time = 0,
) -> tuple[Int[Array, " O"], Int[Array, " O"]]:
    """How many returns of a scan tell of each object: that it is there, or that it is gone.

    Objects are the bodies, by their number, then the poles: `O = S + C`, of which not all stand for one.

    Args:
      world: of `S` segments and `C` poles.
      scan: tells which beams came back.
      truth: what they met.
      pose: the true one, of the robot.
      mount: of the scanner on the robot.
      scan_index: when.

    Returns:
      The returns from each object; and those of beams that passed through the place of one that has vanished, where
      the nearest such counts.
    """
    origin, heading = _placed(pose, mount)
    ghosts = dataclasses.replace(
        world,
        segments=dataclasses.replace(world.segments, vanishes=jnp.full_like(world.segments.vanishes, NEVER)),
        poles=dataclasses.replace(world.poles, vanishes=jnp.full_like(world.poles.vanishes, NEVER)),
    )
    through = cast(ghosts, origin, unit(heading + truth.bearings), scan_index=scan_index).thing
    is_there = jnp.concatenate([there(world.segments, scan_index), there(world.poles, scan_index)])

    def count(thing: Int[Array, " N"]) -> Int[Array, " K"]:
        index = jnp.where(scan.valid & (thing >= 0), thing, is_there.shape[0])
        return jnp.zeros(is_there.shape, jnp.int32).at[index].add(1, mode="drop")

    return _by_object(world, count(truth.thing)), _by_object(world, jnp.where(is_there, 0, count(through)))


# --- Against the truth -----------------------------------------------------------------------------------------------


@pytree
class Score:
    """A map against the truth at one scan index: `S` segments (walls), `C` poles, `K` lines, `M` circles.

    A wall counts if it is there at that scan. A line is *on* a wall where it lies within `Gates.distance` of it and is
    parallel within `Gates.angle`; parallel walls that are nearer to one another than that distance are not told apart.
    A circle is on a pole if its centre lies inside the pole or within that distance of it.
    """

    line_length: Float[Array, ""]
    """Length of all lines, m."""
    line_length_on_walls: Float[Array, ""]
    """Length of theirs that is on walls, m."""
    wall_seen: Float[Array, " S"]
    """How much of each wall has been seen, m."""
    wall_held: Float[Array, " S"]
    """How much of that has a line on it, m."""
    wall_twice: Float[Array, " S"]
    """How much of each wall has two lines or more beside it, of one face, m."""
    wall_pieces: Int[Array, " S"]
    """Pieces in which it is held: one more for each gap that was seen right across."""
    held_twice: Bool[Array, " S"]
    """`wall_twice` is at least `Gates.overlap`, or half of the wall."""

    line_share: Float[Array, " K"]
    """Share of its length that is on walls."""
    wall_of_line: Int[Array, " K"]
    """The wall that it runs along for longest, the nearest of equal ones; -1 for none."""
    line_error: Float[Array, "K 2"]
    """Offset and angle at the anchor, from that wall; 0 for none. m, rad."""
    line_nees: Float[Array, " K"]
    """NEES of that error; 0 for none."""
    phantom_line: Bool[Array, " K"]
    """Whether less than half of it is on walls."""

    circles_of_pole: Int[Array, " C"]
    """Circles on each pole that is there."""
    missed_pole: Bool[Array, " C"]
    """Whether it is there and has been seen, and no circle is on it."""
    pole_of_circle: Int[Array, " M"]
    """The nearest pole that it is on, -1 for none."""
    circle_error: Float[Array, "M 3"]
    """Errors of x, y, radius; 0 for none. m."""
    circle_nees: Float[Array, " M"]
    """NEES of that error, of fitted circles; 0 for others."""
    phantom_circle: Bool[Array, " M"]
    """Whether it is on no pole, and no wall is within `Gates.distance` of its disc."""

    object_held: Float[Array, " O"]
    """How much of each object is held, as `held` counts."""

    @property
    def precision(self) -> Float[Array, "*b"]:
        """Share of the length of the lines that is on walls; NaN without a line."""
        return _share(self.line_length_on_walls, self.line_length)

    @property
    def recall(self) -> Float[Array, "*b"]:
        """Share of the length of wall that has been seen on which a line is; NaN if nothing has been seen."""
        return _share(jnp.sum(self.wall_held, -1), jnp.sum(self.wall_seen, -1))

    @property
    def error(self) -> Float[Array, "*b 2"]:
        """Root mean square of `line_error`: m, rad; NaN if no line is on a wall."""
        count = jnp.sum(self.wall_of_line >= 0, -1)[..., None]
        return jnp.sqrt(_share(jnp.sum(jnp.square(self.line_error), -2), count))

    @property
    def nees(self) -> Float[Array, "*b"]:
        """Mean of `line_nees`, 2 if the covariances are right; NaN if no line is on a wall."""
        return _share(jnp.sum(self.line_nees, -1), jnp.sum(self.wall_of_line >= 0, -1))

    @property
    def duplicates(self) -> Int[Array, "*b"]:
        """Number of walls that are held twice."""
        return jnp.sum(self.held_twice, -1)

    @property
    def fragments(self) -> Int[Array, "*b"]:
        """Number of pieces too many, of all walls together."""
        return jnp.sum(jnp.maximum(self.wall_pieces - 1, 0), -1)


@jax.jit
def evaluate(
    line_map: LineMap, world: World, seen: Seen | None = None, *, scan_index: Time = 0, gates: Gates | None = None
) -> Score:
    """Hold a map against the truth.

    Args:
      line_map: `K` lines and `M` circles.
      world: `S` segments and `C` poles.
      seen: of that world; only what has been seen can be missed. All of it unless given.
      scan_index: what is there at this scan is the truth.
      gates: what counts as the same.

    Returns:
      Lengths, counts and errors, of each line, circle, wall and pole.
    """
    gates = gates or Gates()
    seen = seen_everything(world) if seen is None else seen
    lines, circles = line_map.lines, line_map.circles
    walls = _walls(world)
    is_there = there(world.segments, scan_index)
    by_lines = _against_walls(lines, world, seen, gates)

    pieces = _lines(lines)
    along_walls = _stretches(pieces, walls._replace(valid=is_there), gates)
    divided = _divide(pieces, gates.cell, seen.cells.shape[1])
    on_walls = _length(divided, _cover(divided, along_walls).near)
    line_share = jnp.where(lines.valid, on_walls / jnp.where(pieces.length > 0, pieces.length, 1), 0)
    phantom = lines.valid & (line_share < 0.5)
    wall_of_line = jnp.where(phantom, -1, _wall_of_line(along_walls))
    of_line = jax.tree.map(lambda x: _pick(wall_of_line, x), walls_of(world))
    assigned = wall_of_line >= 0
    error = jnp.where(assigned[:, None], line_error(lines, of_line), 0)

    near = _circles_on_poles(circles, world, gates)
    poles_there = there(world.poles, scan_index)
    off = circles.center[:, None] - world.poles.center[None]
    pole_of_circle = _least(jnp.sqrt(dot(off, off)), near & poles_there[None])
    circles_of_pole = jnp.sum(near & poles_there[None], 0, dtype=jnp.int32)
    center = _pick(pole_of_circle, world.poles.center)
    radius = _pick(pole_of_circle, world.poles.radius)
    circle_error = jnp.concatenate([circles.center - center, (circles.radius - radius)[:, None]], -1)
    circle_error = jnp.where((pole_of_circle >= 0)[:, None], circle_error, 0)
    fitted = (pole_of_circle >= 0) & circles.fitted
    cov = jnp.where(fitted[:, None, None], circles.cov, jnp.eye(3, dtype=circles.radius.dtype)[None])

    twice = _length(by_lines.cells, jnp.any(by_lines.number >= 2, 0)) * is_there
    looked = by_lines.cells.valid & (seen.cells >= gates.scans) & is_there[:, None]
    return Score(
        line_length=jnp.sum(pieces.length * lines.valid),
        line_length_on_walls=jnp.sum(on_walls),
        wall_seen=_length(by_lines.cells, looked),
        wall_held=_length(by_lines.cells, looked & by_lines.near),
        wall_twice=twice,
        wall_pieces=_pieces(by_lines, looked) * is_there,
        held_twice=(twice > 0) & (twice >= jnp.minimum(gates.overlap, walls.length / 2)),
        line_share=line_share,
        wall_of_line=wall_of_line,
        line_error=error,
        line_nees=jnp.where(assigned, nees(error, lines.cov), 0),
        phantom_line=phantom,
        circles_of_pole=circles_of_pole,
        missed_pole=poles_there & (seen.poles >= gates.scans) & (circles_of_pole == 0),
        pole_of_circle=pole_of_circle,
        circle_error=circle_error,
        circle_nees=jnp.where(fitted, nees(circle_error, cov), 0),
        phantom_circle=circles.valid & (pole_of_circle < 0) & ~_touches(circles, walls, is_there, gates),
        object_held=_held(by_lines, near, world, seen, scan_index, gates),
    )


@jax.jit
def held(line_map: LineMap, world: World, seen: Seen, *, scan_index: Time = 0, gates: Gates | None = None) -> Array:
    """How much of each object the map holds, of what has been seen of it while it was there.

    Of a body it is the share of the length beside which a line lies; of a pole it is 1 if a circle is on it. For an
    object that is not there at this scan only that counts which nothing that is there accounts for: a line is no trace
    of a closed door where the open one stands, nor a circle on another pole.

    Args:
      line_map: the map after the scan.
      world: `S` segments and `C` poles.
      seen: up to this scan.
      scan_index: of the scan.
      gates: what counts as the same.

    Returns:
      In [0, 1]; 0 for what has never been seen. Bodies by their number, then poles. Shape `[S + C]`.
    """
    gates = gates or Gates()
    by_lines = _against_walls(line_map.lines, world, seen, gates)
    near = _circles_on_poles(line_map.circles, world, gates)
    return _held(by_lines, near, world, seen, scan_index, gates)


@documented
class Matches(NamedTuple):
    """What became of the lines of one scan that walls have given."""

    true: Int[Array, ""]
    """Lines matched with a line of the map that runs along the same wall."""
    false: Int[Array, ""]
    """Lines matched with one that does not."""
    missed: Int[Array, ""]
    """Lines not matched, although the map holds their stretch of that face of the wall."""


@jax.jit
def judge_matches(
    lines: Lines,
    found: Extraction,
    line_slot: Int[Array, " L"],
    world: World,
    truth: Truth,
    *,
    scan_index: Time = 0,
    gates: Gates | None = None,
) -> Matches:
    """Whether the lines of a scan have been matched with the right ones of the map.

    A line of a scan belongs to the wall that most of its beams have met.

    Args:
      lines: of the map before that scan, `K`.
      found: in the scan, `L` lines.
      line_slot: with which line of the map each was matched, or a negative number; of the `Report` of `update`.
      world: `S` segments.
      truth: what the beams met.
      scan_index: of the scan.
      gates: what counts as the same.

    Returns:
      How many lines of the scan were matched rightly, wrongly, or not though they should have been.
    """
    gates = gates or Gates()
    walls = _walls(world)
    walls = walls._replace(valid=there(world.segments, scan_index))
    size, count = found.lines.valid.shape[0], walls.valid.shape[0]
    own = (found.line_of_beam[:, None] == jnp.arange(size)[None]).astype(jnp.float32)
    met = (truth.thing[:, None] == jnp.arange(count)[None]).astype(jnp.float32)
    beams = jnp.sum(own[:, :, None] * met[:, None], 0)
    wall = jnp.where(found.lines.valid & (jnp.max(beams, -1) > 0), jnp.argmax(beams, -1), -1)
    wall_of_slot = _wall_of_line(_stretches(_lines(lines), walls, gates))

    matched = (line_slot >= 0) & (wall >= 0)
    right = matched & (wall_of_slot[jnp.maximum(line_slot, 0)] == wall)

    # Stretches of the wall of each line: of itself, and of all lines of the map
    mine = _stretches(walls, _lines(found.lines), gates).near[jnp.arange(size), wall]
    held = jnp.moveaxis(_stretches(walls, _lines(lines), gates).near, 1, 0)[wall]
    common = jnp.minimum(mine[:, None, 1], held[..., 1]) - jnp.maximum(mine[:, None, 0], held[..., 0])
    enough = jnp.minimum(jnp.asarray(gates.overlap, common.dtype), (mine[:, 1] - mine[:, 0]) / 2)
    one_face = (dot(found.lines.tangent[:, None], lines.tangent[None]) > 0) | ~_has_two_faces(world)[wall][:, None]
    there_before = jnp.any((common >= enough[:, None]) & (wall_of_slot[None] == wall[:, None]) & one_face, -1)
    missed = (wall >= 0) & (line_slot < 0) & there_before & (mine[:, 1] > mine[:, 0])
    return Matches(*(jnp.sum(x, dtype=jnp.int32) for x in (right, matched & ~right, missed)))


def scans_until(
    done: Bool[Array, "T O"], counts: Bool[Array, "T O"], since: Int[Array, " O"]
) -> tuple[Int[Array, " O"], Bool[Array, " O"]]:
    """How many scans it took, for each object: until a vanished one is gone, or until a new one is there.

    A vanished one: `done = held(...) < GONE`, `since` its `vanishes`, and those scans count in which beams passed
    through its place. A new one: `done = held(...) >= THERE`, `since` its `appears`, and those count that had returns
    from it. Both counts of beams are those of `beams_on_objects`.

    Args:
      done: after each scan.
      counts: scans that could have brought it about.
      since: scan index from which on it is waited for.

    Returns:
      The number of scans that count, from `since` up to and with the first after which it is done (0 if it is so
      before any has counted), or all of them if it never is; and whether it ever is. Shape `[O]` both.
    """
    index = jnp.arange(done.shape[0])[:, None]
    waits = index >= since[None]
    first = jnp.min(jnp.where(done & waits, index, done.shape[0]), 0)
    number = jnp.sum(counts & waits & (index <= first[None]), 0, dtype=jnp.int32)
    return number, first < done.shape[0]


def times_of_objects(world: World) -> tuple[Int[Array, " O"], Int[Array, " O"], Bool[Array, " O"]]:
    """When each object appears and vanishes, and which of them there are. Bodies by their number, then poles.

    Args:
      world: of `S` segments and `C` poles; `O = S + C`.

    Returns:
      First scan with it, first scan without it, and whether there is such an object. Shapes `[O]`.
    """
    segments, poles = world.segments, world.poles
    count = segments.valid.shape[0]
    into = jnp.where(segments.valid, segments.body, count)

    def join(name: str) -> Int[Array, " O"]:
        bodies = jnp.zeros(count, jnp.int32).at[into].set(getattr(segments, name), mode="drop")
        return jnp.concatenate([bodies, getattr(poles, name)])

    exists = jnp.zeros(count, bool).at[into].set(True, mode="drop")
    return join("appears"), join("vanishes"), jnp.concatenate([exists, poles.valid])


# --- Straight pieces beside one another ------------------------------------------------------------------------------


class _Straight(NamedTuple):
    """Straight pieces: the walls of a world, or the lines of a map."""

    begin: Array  # [A, 2] m
    tangent: Array  # [A, 2]
    length: Array  # [A] m
    valid: Array  # [A]


class _Cells(NamedTuple):
    """Straight pieces, each divided into equal cells."""

    middle: Array  # [A, P] m, from the begin
    size: Array  # [A] m
    number: Array  # [A]
    valid: Array  # [A, P]


class _Stretches(NamedTuple):
    """Where pieces `A` run along pieces `B`, measured from the begin of the former; end before begin for nowhere."""

    near: Array  # [B, A, 2] m: within the distance
    beside: Array  # [B, A, 2] m: the same, and not beyond the ends of the latter
    aside: Array  # [B, A] m: how far from the latter the middle of `near` lies


class _Cover(NamedTuple):
    """What lies along cells."""

    near: Array  # [A, P] whether some piece is near
    number: Array  # [2, A, P] of pieces that lie beside it, on the first and on the second face
    linked: Array  # [A, P] whether one of them lies beside the next cell too
    cells: _Cells


def _walls(world: World) -> _Straight:
    ends = world.segments.ends
    step = ends[:, 1] - ends[:, 0]
    length = jnp.sqrt(dot(step, step))
    return _Straight(
        begin=ends[:, 0],
        tangent=step / jnp.where(length > 0, length, 1)[:, None],
        length=length,
        valid=world.segments.valid,
    )


def _lines(lines: Lines) -> _Straight:
    return _Straight(begin=lines.begin, tangent=lines.tangent, length=lines.length, valid=lines.valid)


def _divide(pieces: _Straight, size: Number, count: int) -> _Cells:
    """Cells no longer than `size`, or `count` of them where they would be more."""
    number = jnp.clip(jnp.ceil(pieces.length / size).astype(jnp.int32), 1, count)
    size = pieces.length / number
    index = jnp.arange(count, dtype=jnp.int32)[None]
    return _Cells(
        middle=(index + 0.5).astype(size.dtype) * size[:, None],
        size=size,
        number=number,
        valid=(index < number[:, None]) & pieces.valid[:, None],
    )


def _length(cells: _Cells, which: Bool[Array, "A P"]) -> Float[Array, " A"]:
    """Of some cells of each piece, m."""
    return jnp.sum(which & cells.valid, -1) * cells.size


def _stretches(pieces: _Straight, along: _Straight, gates: Gates) -> _Stretches:
    """Where pieces `A` run along pieces `B`.

    What lies within a distance of a straight piece is convex, so that another one is in it over one stretch: that of
    the strip beside it, and of the discs around its ends.
    """
    limit = jnp.asarray(gates.distance, pieces.begin.dtype)

    def one(piece: _Straight, other: _Straight) -> _Stretches:
        # The piece in the frame of the other one: (x, y) + t (cos, sin).
        off = piece.begin - other.begin
        x, y = dot(other.tangent, off), dot(perp(other.tangent), off)
        cos, sin = dot(other.tangent, piece.tangent), dot(perp(other.tangent), piece.tangent)

        def between(at: Array, slope: Array, low: Array, high: Array) -> Array:
            a, b = ((end - at) / jnp.where(slope == 0, 1, slope) for end in (low, high))
            always = jnp.where((low <= at) & (at <= high), 1, -1) * jnp.asarray([-jnp.inf, jnp.inf], at.dtype)
            return jnp.where(slope == 0, always, jnp.stack([jnp.minimum(a, b), jnp.maximum(a, b)]))

        def around(x: Array) -> Array:
            foot, square = -(x * cos + y * sin), limit**2 - (x * sin - y * cos) ** 2
            half = jnp.sqrt(jnp.maximum(square, 0))
            return jnp.where(
                square < 0, jnp.asarray([jnp.inf, -jnp.inf], x.dtype), jnp.stack([foot - half, foot + half])
            )

        strip = _both(between(y, sin, -limit, limit), between(x, cos, jnp.zeros_like(x), other.length))
        strip = jnp.where(strip[0] <= strip[1], strip, jnp.asarray([jnp.inf, -jnp.inf], x.dtype))
        parts = jnp.stack([strip, around(x), around(x - other.length)])
        near = jnp.stack([jnp.min(parts[:, 0]), jnp.max(parts[:, 1])])
        parallel = (jnp.abs(sin) <= jnp.sin(gates.angle)) & piece.valid & other.valid
        nowhere = jnp.asarray([0, -1], x.dtype)
        extent = jnp.stack([jnp.zeros_like(x), piece.length])
        near, beside = (
            jnp.where(parallel & (s[0] <= s[1]), s, nowhere) for s in (_both(near, extent), _both(strip, extent))
        )
        return _Stretches(near, beside, jnp.abs(y + jnp.sum(near) / 2 * sin))

    return jax.vmap(jax.vmap(one, (0, None)), (None, 0))(pieces, along)


def _wall_of_line(along_walls: _Stretches) -> Int[Array, " K"]:
    """The wall that each line runs along for longest, -1 for none.

    A metre aside counts as a metre less beside: of walls that a line runs along for its whole length, the nearest.
    """
    beside = along_walls.near[..., 1] - along_walls.near[..., 0]
    return _least((along_walls.aside - beside).T, (beside > 0).T)


def _both(a: Float[Array, "2"], b: Float[Array, "2"]) -> Float[Array, "2"]:
    """What two stretches share."""
    return jnp.stack([jnp.maximum(a[0], b[0]), jnp.minimum(a[1], b[1])])


_Carry = tuple[Array, Array, Array]


def _cover(cells: _Cells, stretches: _Stretches, on_second: Bool[Array, "B A"] | None = None) -> _Cover:
    """What lies along each cell, and on which face.

    One piece after the other, as rays are cast, so that the memory is that of the cells.
    """
    here = cells.middle
    following = jnp.concatenate([here[:, 1:], jnp.full_like(here[:, :1], jnp.inf)], 1)

    def step(carry: _Carry, stretch: tuple[Array, Array, Array]) -> tuple[_Carry, None]:
        near, number, linked = carry
        (near_from, near_to), (beside_from, beside_to) = (jnp.moveaxis(s, -1, 0)[..., None] for s in stretch[:2])
        second = stretch[2][:, None]
        beside = (beside_from <= here) & (here <= beside_to)
        near |= (near_from <= here) & (here <= near_to)
        number += jnp.stack([beside & ~second, beside & second])
        return (near, number, linked | (beside & (following <= beside_to))), None

    nothing = jnp.zeros(here.shape, bool)
    start = (nothing, jnp.zeros((2, *here.shape), jnp.int32), nothing)
    on_second = jnp.zeros(stretches.aside.shape, bool) if on_second is None else on_second
    (near, number, linked), _ = jax.lax.scan(step, start, (stretches.near, stretches.beside, on_second))
    return _Cover(near=near, number=number, linked=linked, cells=cells)


def _against_walls(lines: Lines, world: World, seen: Seen, gates: Gates) -> _Cover:
    """What of a map lies along the walls, there or not."""
    walls = _walls(world)
    on_second = (dot(lines.tangent[:, None], walls.tangent[None]) < 0) & _has_two_faces(world)[None]
    return _cover(_divide(walls, gates.cell, seen.cells.shape[1]), _stretches(walls, _lines(lines), gates), on_second)


def _has_two_faces(world: World) -> Bool[Array, " S"]:
    """Whether a segment may be seen from both sides."""
    return world.segments.kind == Kind.WALL


def _pieces(cover: _Cover, looked: Bool[Array, "S P"]) -> Int[Array, " S"]:
    """In how many pieces each wall is held, if what was not seen is passed over.

    A piece begins at a cell with a line that is not linked with the cell before, if all cells between it and the last
    one with a line have been seen; the first one begins in any case.
    """
    some = jnp.any(cover.number > 0, 0) & cover.cells.valid
    unseen = jnp.cumsum(~looked, -1, dtype=jnp.int32)
    before = jax.lax.cummax(jnp.where(some, unseen, -1), axis=1)  # of the last cell with a line

    def shifted(x: Array, fill: Any) -> Array:
        return jnp.concatenate([jnp.full_like(x[:, :1], fill), x[:, :-1]], 1)

    before = shifted(before, -1)
    begins = some & ~shifted(cover.linked, False) & ((before < 0) | (before == shifted(unseen, 0)))
    return jnp.sum(begins, -1, dtype=jnp.int32)


def _held(
    by_lines: _Cover, near: Bool[Array, "M C"], world: World, seen: Seen, scan_index: Time, gates: Gates
) -> Float[Array, " O"]:
    """As `held` says."""
    walls, cells = _walls(world), by_lines.cells
    is_there = there(world.segments, scan_index)
    others = _stretches(walls, walls._replace(valid=is_there), gates)
    open_to = cells.valid & (is_there[:, None] | ~_cover(cells, others).near)
    looked = open_to & (seen.cells >= gates.scans)
    lengths = (_length(cells, which) for which in (looked & jnp.any(by_lines.number > 0, 0), looked))

    poles_there = there(world.poles, scan_index)
    taken = jnp.any(near & poles_there[None], 1)
    on_pole = jnp.any(near & (poles_there[None] | ~taken[:, None]), 0)
    looked_at = seen.poles >= gates.scans
    poles = (x.astype(cells.size.dtype) for x in (on_pole & looked_at, looked_at))
    is_held, was_seen = (_by_object(world, jnp.concatenate(x)) for x in zip(lengths, poles, strict=True))
    return jnp.where(was_seen > 0, is_held / jnp.where(was_seen > 0, was_seen, 1), 0)


def _by_object(world: World, of_things: Array) -> Array:
    """Sums over the segments of each body, by its number; then the poles as they are."""
    count = world.segments.valid.shape[0]
    into = jnp.where(world.segments.valid, world.segments.body, count)
    bodies = jnp.zeros(count, of_things.dtype).at[into].add(of_things[:count], mode="drop")
    return jnp.concatenate([bodies, of_things[count:]])


def _circles_on_poles(circles: Circles, world: World, gates: Gates) -> Bool[Array, "M C"]:
    """Which circles are on which poles, there or not."""
    off = circles.center[:, None] - world.poles.center[None]
    near = jnp.sqrt(dot(off, off)) <= world.poles.radius[None] + gates.distance
    return near & circles.valid[:, None] & world.poles.valid[None]


def _touches(circles: Circles, walls: _Straight, is_there: Bool[Array, " S"], gates: Gates) -> Bool[Array, " M"]:
    """Whether a wall comes within the distance of the disc of each circle."""
    off = circles.center[:, None] - walls.begin[None]
    along, across = dot(off, walls.tangent[None]), dot(off, perp(walls.tangent)[None])
    beyond = along - jnp.clip(along, 0, walls.length[None])
    near = jnp.sqrt(across**2 + beyond**2) <= circles.radius[:, None] + gates.distance
    return jnp.any(near & is_there[None], 1)


def _least(score: Float[Array, "A B"], may: Bool[Array, "A B"]) -> Int[Array, " A"]:
    """Where in each row the least number stands, of those that may; -1 for nowhere. `B` may be zero."""
    count = score.shape[1]
    best = jnp.min(jnp.where(may, score, jnp.inf), 1, initial=jnp.inf)
    index = jnp.arange(count, dtype=jnp.int32)[None]
    first = jnp.min(jnp.where(may & (score == best[:, None]), index, count), 1, initial=count)
    return jnp.where(first < count, first, -1).astype(jnp.int32)


def _pick(index: Int[Array, " A"], rows: Float[Array, "B *s"]) -> Float[Array, "A *s"]:
    """Some rows; zeros for -1. `B` may be zero."""
    mine = index[:, None] == jnp.arange(rows.shape[0])[None]
    return jnp.sum(jnp.where(mine.reshape(mine.shape + (1,) * (rows.ndim - 1)), rows[None], 0), 1)


def _placed(pose: Float[Array, "3"], mount: Mount | None) -> tuple[Float[Array, "2"], Float[Array, ""]]:
    """Place and heading of the scanner."""
    at = jax.tree.map(lambda x: jnp.asarray(x, pose.dtype), mount or Mount())
    return pose[:2] + rotate(pose[2], jnp.stack([at.x, at.y])), pose[2] + at.theta


def _share(part: Array, whole: Array) -> Array:
    """NaN where there is no whole."""
    return jnp.where(whole > 0, part / jnp.where(whole > 0, whole, 1), jnp.nan)
