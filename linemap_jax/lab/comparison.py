"""Two maps of one place, in one frame: what has moved, vanished or appeared, and how sure that is.

A line of one map and a line of the other one are held against each other as matching does it (Eq. (21), with both
covariances, in a frame of their own, angles wrapped, either direction), but over a wider neighbourhood. Under the
hypothesis that both are one line which has not moved, the normalised distance is chi-square with 2 degrees of freedom,
if the errors of the two maps are independent: maps of two drives. There are many pairs, of which some are far apart by
chance; so p-values are those of Holm (1979), and the probability that any change at all is told where there is none is
at most `alpha`.

Nothing on the other map is no proof that nothing is there: the robot may not have looked. That takes the log of the
other map, see `looked_through`. Nor is something on a map proof that a thing was there: points that no line took are
clusters too. Beams of its own drive tell.
"""

import dataclasses
import math
from collections.abc import Iterable, Iterator, Sequence
from typing import Literal, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Int

from linemap_jax.core.fields import documented
from linemap_jax.core.frames import dot, unit
from linemap_jax.core.matching import LineComparison, compare_lines, contradicted, match_circles, normal_variance
from linemap_jax.core.settings import Mount, Rules, Thresholds
from linemap_jax.core.slots import detected_often, neutral_where_free
from linemap_jax.core.state import LineMap, Lines, Pose, Scan, SlotsT, pad_stack
from linemap_jax.lab.raycast import cast
from linemap_jax.lab.world import NEVER, Kind, Poles, Segments, World

OVERLAP = 0.5
"""Lines may be the same one if that share of the shorter, at least, lies beside the other."""
FARTHEST_TURN = 0.6
"""rad, 34 degrees. A line that has turned more has vanished, and another one has appeared."""
ALONG = 0.2
"""rad, 11 degrees. A line that is turned more lies on no other one."""
END_SIGMAS = 3.0
"""An end of a line is known to so many sigmas; less than that is no missing piece."""
END_SLACK = 0.1
"""m. How far the ends of one wall may lie apart in two maps beside that: a corner is rounded by some beams."""

APART = 0.1
"""m. Circles without a covariance are the same thing if their discs are no farther apart: the centre of what is visible
moves with the viewpoint, by as much as the thing is thick."""
BESIDE = 0.1
"""m. A line that is no farther from a longer one, all along, is a piece of it."""
REACH = 1.0
"""m. Where one map has a line and the other one none that near, they do not overlap."""
STEP = 0.1
"""m. Lengths are summed up in pieces of at most that."""

What = Literal["moved", "vanished", "appeared"]


@documented
@dataclasses.dataclass(frozen=True, kw_only=True)
class Change:
    """One line or circle, or a piece of a line, that is not in both maps at the same place."""

    what: What
    """What has happened to it."""
    kind: Literal["line", "circle"]
    """What it is."""
    slot_a: int | None
    """Slot in the first map; None for what has appeared."""
    slot_b: int | None
    """Slot in the second map; None for what has vanished."""
    begin: tuple[float, float]
    """Begin of a line, centre of a circle; of what has moved, where it was. m."""
    end: tuple[float, float]
    """End of a line, centre of a circle, m."""
    radius: float | None
    """Radius of a circle, m."""
    times_detected: int
    """How many scans have seen it, in the map that holds it; of what has moved, in the one that has seen it less."""
    shift: tuple[float, float] | None = None
    """How far and where to it has moved, m."""
    sigma: float | None = None
    """Standard deviation of the length of the shift, m."""
    turn: float | None = None
    """By how much a line has turned, rad."""
    p: float | None = None
    """The p-value of Holm, of what has moved."""
    passed: int | None = None
    """Beams of the other map's log that went through where it was or is; None without a log."""
    met: int | None = None
    """Beams of the other map's log that ended there."""
    passed_own: int | None = None
    """Beams of the log of the map that holds it that went through it; None without a log."""
    met_own: int | None = None
    """Beams of that log that ended there."""


@documented
class Comparison(NamedTuple):
    """What `compare_maps` has found."""

    changes: list[Change]
    """What has changed."""
    same_lines: int
    """Lines of the first map that the second one holds too."""
    same_circles: int
    """Circles of the first map that the second one holds too."""
    pairs: int
    """Pairs that were held against each other."""


def compare_maps(
    a: LineMap, b: LineMap, *, within: float = 0.5, alpha: float = 0.01, shortest: float = 0.5, at_least: int = 1
) -> Comparison:
    """What has changed from one map to another.

    A line has moved if all lines of the other map near it differ from it significantly; the most likely one, that with
    the least normalised distance, is taken for it, and the p-value holds given that it is. It has vanished if there is
    none. Of a line that is there still, pieces that the other map does not hold have vanished too (a door was opened);
    and it has moved along itself if both ends have, by the same distance. A map may hold a piece of a wall once more:
    what lies on a longer line is there still if that one is.

    Args:
      a: the map before.
      b: the map after, in the same frame.
      within: how far a thing may have moved, m; farther away it is another one.
      alpha: probability of telling of a movement where there is none.
      shortest: shortest piece of a line that is told to have vanished or appeared, m.
      at_least: of lines and circles that were detected more seldom no change is told; they only count for what is
        where it was.

    Returns:
      The changes: what has moved, most surely first; what has vanished and what has appeared, the longest first.
    """
    lines_a, lines_b = (_Walls(*map(np.asarray, _walls(m.lines))) for m in (a, b))
    pairs = _line_pairs(a.lines, b.lines, lines_a, lines_b, within)
    circle_pairs = _circle_pairs(a, b, within)
    # One family of tests. Circles without a covariance that are near each other are the same.
    fitted = circle_pairs.near & ~np.isnan(circle_pairs.p)
    raw = np.concatenate([pairs.p[pairs.near], circle_pairs.p[fitted]])
    p_line, p_circle = np.ones(pairs.near.shape), np.ones(fitted.shape)
    p_line[pairs.near], p_circle[fitted] = np.split(holm(raw), [int(pairs.near.sum())])

    same = pairs.near & (p_line >= alpha)
    on_a, on_b = (_lie_on(walls).astype(np.float32) for walls in (lines_a, lines_b))  # products of bool are slow
    held = on_a @ same.astype(np.float32) @ on_b.T > 0
    # What was seen seldom may bear out that a thing is where it was; it is not where another thing has gone.
    free_a, free_b = (
        np.flatnonzero(walls.valid & (walls.times >= at_least) & ~held.any(axis))
        for walls, axis in ((lines_a, 1), (lines_b, 0))
    )
    moved = list(_nearest_first(np.where(pairs.near, pairs.nis, np.inf), free_a, free_b))
    slide, p_slide = _slides(lines_a, lines_b, same)
    slid = [(int(i), int(j)) for i, j in np.argwhere(p_slide < alpha)]
    changes = [
        *(
            _moved_line(lines_a, lines_b, pairs, at, pairs.offset[at] * lines_a.normal[at[0]], p_line[at])
            for at in moved
        ),
        *(_moved_line(lines_a, lines_b, pairs, at, slide[at] * lines_a.tangent[at[0]], p_slide[at]) for at in slid),
    ]
    moved_a, moved_b = ({at[side] for at in moved + slid} for side in (0, 1))
    changes += _missing_lines("vanished", lines_a, lines_b, held, moved_a, shortest)
    changes += _missing_lines("appeared", lines_b, lines_a, held.T, moved_b, shortest)
    found, same_circles = _circle_changes(a, b, circle_pairs, p_circle, alpha, at_least)
    changes = [change for change in changes + found if change.times_detected >= at_least]
    order = {"moved": 0, "vanished": 1, "appeared": 2}

    def rank(change: Change) -> tuple[int, float, float]:
        length = math.dist(change.begin, change.end) if change.kind == "line" else 2 * (change.radius or 0)
        far = math.hypot(*change.shift) / (change.sigma or 1) if change.shift else 0.0
        return order[change.what], -far, -length

    return Comparison(sorted(changes, key=rank), int(held.any(1).sum()) - len(slid), same_circles, raw.size)


def without_moved(a: LineMap, b: LineMap, changes: Sequence[Change]) -> LineMap:
    """The first map without what is elsewhere in the second one.

    That is what has surely moved; and what another line or circle stands in the place of, by the gate of Eq. (22),
    though it may be by chance: one in a hundred of those that are where they were.

    Args:
      a: the map before.
      b: the map after, in the same frame.
      changes: by `compare_maps` of the two.

    Returns:
      The map, in the same slots.
    """
    dtype = a.lines.offset.dtype
    gates = jax.tree.map(lambda x: jnp.asarray(x, dtype), Thresholds())
    denied_lines, suspects = jax.tree.map(np.asarray, _denied(a, b, gates))
    denied = {"line": np.flatnonzero(denied_lines).tolist(), "circle": suspects[suspects >= 0].tolist()}

    def stay(slots: SlotsT, kind: Literal["line", "circle"]) -> SlotsT:
        moved = (change.slot_a for change in changes if change.what == "moved" and change.kind == kind)
        left = [*denied[kind], *(slot for slot in moved if slot is not None)]
        gone = np.isin(np.arange(slots.valid.shape[0]), left)
        return neutral_where_free(dataclasses.replace(slots, valid=slots.valid & ~gone))

    return LineMap(lines=stay(a.lines, "line"), circles=stay(a.circles, "circle"))


@jax.jit
def _denied(a: LineMap, b: LineMap, gates: Thresholds) -> tuple[Bool[Array, " K"], Int[Array, " D"]]:
    """Which lines of `a` lie where `b` has others; and of which circle of `a` each one of `b` takes the place."""
    lines = contradicted(b.lines, a.lines, gates, Rules(), "unknown")
    return lines, match_circles(b.circles, a.circles, gates, Rules(), "unknown").suspect


class Agreement(NamedTuple):
    """How far two maps are of one place in one frame."""

    overlap: float
    """Length of lines within `REACH` of a line of the other map, m; the mean of both maps."""
    agreeing: float
    """Length of lines that lie along one of the other map, within `BESIDE` and `ALONG`, m; the mean of both."""


def agreement(a: LineMap, b: LineMap) -> Agreement:
    """What length of the lines of two maps lies where the other one has lines, and what of it lies along one.

    Of maps of one place most of the one does; of maps in different frames a few per cent, by chance.

    Args:
      a: a map.
      b: another one.

    Returns:
      The two lengths, each the mean of both maps; both zero where no line is near one of the other map.
    """
    walls = [_Walls(*map(np.asarray, _walls(m.lines))) for m in (a, b)]
    one, other = _lengths_beside(*walls), _lengths_beside(*walls[::-1])
    return Agreement((one[0] + other[0]) / 2, (one[1] + other[1]) / 2)


def holm(p: Float[np.ndarray, " M"]) -> Float[np.ndarray, " M"]:
    """The p-values of Holm's step-down procedure, from `p`, those of the single tests.

    To reject those below alpha errs at all with probability alpha.
    """
    order = np.argsort(p)
    scaled = np.maximum.accumulate((p.size - np.arange(p.size)) * p[order])
    adjusted = np.empty_like(p)
    adjusted[order] = np.minimum(scaled, 1)
    return adjusted


def looked_through(
    changes: list[Change],
    chunks: Iterable[tuple[Scan, Pose]],
    drive: Literal["before", "after"],
    mount: Mount | None = None,
    *,
    chunk: int,
    slack: float = 0.15,
) -> list[Change]:
    """The changes, with what the beams of a log say of what has vanished and of what has appeared.

    A beam that ends `slack` behind the place of a thing has passed through it; one that ends there has met something.
    Of one that ends before it, nothing follows.

    Args:
      changes: of `compare_maps`.
      chunks: stacked scans and poses, at most `chunk` of them each time.
      drive: of which map the log is. That after tells whether what has vanished is gone, and whether what has appeared
        is a thing at all; that before the other way round.
      mount: of the scanner on the robot.
      chunk: size to which pieces are filled up.
      slack: m.

    Returns:
      The same changes: those that are in the other map alone with `passed` and `met`, those that are in the map of this
      drive alone with `passed_own` and `met_own`.
    """
    other, own = ("vanished", "appeared") if drive == "after" else ("appeared", "vanished")
    asked = [_Asked.of(changes, what) for what in (other, own)]
    for scans, poses in chunks:
        active = np.arange(chunk) < scans.ranges.shape[0]
        scans, poses = pad_stack(scans, chunk), pad_stack(poses, chunk)
        scans = dataclasses.replace(scans, valid=jnp.asarray(np.asarray(scans.valid) & active[:, None]))
        for things in asked:
            things.count(*_beams_at(things.world, scans, poses, mount or Mount(), slack))
    told = list(changes)
    for things, names in zip(asked, (("passed", "met"), ("passed_own", "met_own")), strict=True):
        for where, i in things.index:
            counts = {name: int(beams[where]) for name, beams in zip(names, things.beams, strict=True)}
            told[i] = dataclasses.replace(changes[i], **counts)
    return told


@dataclasses.dataclass
class _Asked:
    """Changes of one kind as a world, and how many beams passed through each of them or ended there."""

    world: World
    index: list[tuple[int, int]]  # of each change: its place in the world, its place among the changes
    beams: tuple[Int[np.ndarray, " M"], Int[np.ndarray, " M"]]

    @classmethod
    def of(cls, changes: list[Change], what: What) -> "_Asked":
        meant = [i for i, change in enumerate(changes) if change.what == what]
        lines = [i for i in meant if changes[i].kind == "line"]
        circles = [i for i in meant if changes[i].kind == "circle"]
        world = _world([changes[i] for i in lines], [changes[i] for i in circles])
        room = world.segments.valid.shape[0]
        index = [*enumerate(lines), *((room + k, i) for k, i in enumerate(circles))]
        size = room + world.poles.valid.shape[0]
        return cls(world, index, (np.zeros(size, int), np.zeros(size, int)))

    def count(self, passed: Array, met: Array) -> None:
        self.beams = self.beams[0] + np.asarray(passed), self.beams[1] + np.asarray(met)


class _Walls(NamedTuple):
    """Lines as arrays of NumPy."""

    anchor: Float[np.ndarray, "K 2"]  # m
    foot: Float[np.ndarray, "K 2"]  # m, on the line, where the extent counts from
    normal: Float[np.ndarray, "K 2"]
    tangent: Float[np.ndarray, "K 2"]
    begin: Float[np.ndarray, "K 2"]  # m
    end: Float[np.ndarray, "K 2"]  # m
    extent: Float[np.ndarray, "K 2"]  # m
    var_extent: Float[np.ndarray, "K 2"]  # m^2
    var_offset: Float[np.ndarray, " K"]  # m^2
    times: Int[np.ndarray, " K"]
    valid: Bool[np.ndarray, " K"]


@jax.jit
def _walls(lines: Lines) -> tuple[Array, ...]:
    """The fields of `_Walls`."""
    return (
        lines.anchor,
        lines.point_at(jnp.zeros_like(lines.offset)),
        lines.normal,
        lines.tangent,
        lines.begin,
        lines.end,
        lines.extent,
        lines.var_extent,
        lines.cov[:, 0, 0],
        lines.times_detected,
        lines.valid,
    )


class _Pairs(NamedTuple):
    """Each line of one map against each of the other, `[K, L]`."""

    near: Bool[np.ndarray, "K L"]  # may be the same line, moved or not
    offset: Float[np.ndarray, "K L"]  # m, second less first, along the normal of the first
    turn: Float[np.ndarray, "K L"]  # rad
    sigma: Float[np.ndarray, "K L"]  # m, of the offset
    nis: Float[np.ndarray, "K L"]  # normalised distance
    p: Float[np.ndarray, "K L"]


@jax.jit
def _hold_against(a: Lines, b: Lines) -> tuple[LineComparison, Array]:
    """Each line of `b` against each of `a`, `[K, L]`; and the standard deviation of the offset."""

    def one(old: Lines, new: Lines) -> tuple[LineComparison, Array]:
        pair: LineComparison = compare_lines(new, old, Thresholds(), "independent")
        along = dot(old.tangent, new.anchor - old.anchor)
        return pair, jnp.sqrt(new.cov[0, 0] + normal_variance(old.cov, along))

    return jax.vmap(jax.vmap(one, (None, 0)), (0, None))(a, b)


def _line_pairs(a: Lines, b: Lines, walls_a: _Walls, walls_b: _Walls, within: float) -> _Pairs:
    pair, sigma = _hold_against(a, b)
    offset, turn, nis, gap, sigma = (np.asarray(x, float) for x in (pair.offset, pair.angle, pair.nis, pair.gap, sigma))
    length_a, length_b = (walls.extent[:, 1] - walls.extent[:, 0] for walls in (walls_a, walls_b))
    near = walls_a.valid[:, None] & walls_b.valid[None] & (np.abs(turn) <= FARTHEST_TURN) & (np.abs(offset) <= within)
    near = near & (-gap >= OVERLAP * np.minimum(length_a[:, None], length_b[None]))
    # chi-square with 2 degrees of freedom: P(d^2 > x) = exp(-x / 2)
    return _Pairs(near, offset, turn, sigma, nis, np.exp(-nis / 2))


def _lie_on(walls: _Walls) -> Bool[np.ndarray, "K K"]:
    """Whether a line, of which there is one for each row, is a longer one of the same map or a piece of it."""
    length = walls.extent[:, 1] - walls.extent[:, 0]
    ends = np.stack([walls.begin, walls.end], 1)[:, None] - walls.foot[None, :, None]  # of each, from each other one
    across, along = (np.einsum("klei,li->kle", ends, axis) for axis in (walls.normal, walls.tangent))
    low, high = (walls.extent[:, side] + slack for side, slack in ((0, -END_SLACK), (1, END_SLACK)))
    turned = np.abs(walls.tangent @ walls.normal.T) > math.sin(ALONG)
    beside = (np.abs(across) <= BESIDE).all(-1) & (low[:, None] <= along).all(-1) & (along <= high[:, None]).all(-1)
    piece = beside & ~turned & (length[:, None] < length) & walls.valid[:, None] & walls.valid
    return piece | np.eye(len(length), dtype=bool)


def _lengths_beside(lines: _Walls, others: _Walls) -> tuple[float, float]:
    """The length of lines near others, and along others."""
    other = np.flatnonzero(others.valid)
    begin, normal, tangent = others.foot[other], others.normal[other], others.tangent[other]
    low, high = others.extent[other].T
    near = along = 0.0
    for i in np.flatnonzero(lines.valid) if other.size else ():
        first, last = lines.extent[i]
        count = max(1, math.ceil((last - first) / STEP))
        places = first + (np.arange(count) + 0.5) * (last - first) / count
        way = lines.foot[i] + places[:, None] * lines.tangent[i] - begin[:, None]  # [others, places, 2]
        across, ahead = (np.einsum("lpi,li->lp", way, axis) for axis in (normal, tangent))
        far = np.hypot(across, ahead - np.clip(ahead, low[:, None], high[:, None]))
        parallel = np.abs(normal @ lines.tangent[i]) <= math.sin(ALONG)
        near += (far <= REACH).any(0).mean() * (last - first)
        along += (far[parallel] <= BESIDE).any(0).mean() * (last - first)
    return float(near), float(along)


def _slides(
    a: _Walls, b: _Walls, same: Bool[np.ndarray, "K L"]
) -> tuple[Float[np.ndarray, "K L"], Float[np.ndarray, "K L"]]:
    """How far a line has moved along itself, m, with p-values; 1 for pairs of which that cannot be said.

    Both ends have to be seen, and to have moved alike: a line that has become longer was seen farther. Of the position
    along a line the map tells no covariance but that of its ends; so that of the offset is added, which holds what the
    pose contributes. The p-values are those of Bonferroni, among all pairs that are the same line.
    """
    slide, p = np.zeros(same.shape), np.ones(same.shape)
    for i, j in np.argwhere(same & (same.sum(1) == 1)[:, None] & (same.sum(0) == 1)[None]).tolist():
        step = _along(a, i, b, j) - a.extent[i]
        reverse = a.tangent[i] @ b.tangent[j] < 0
        var = a.var_extent[i] + b.var_extent[j][:: -1 if reverse else 1]
        longer = abs(step[1] - step[0]) > END_SIGMAS * math.sqrt(var.sum()) + END_SLACK / 2
        slide[i, j] = step.mean()
        if longer or abs(slide[i, j]) <= END_SLACK:
            continue
        variance = var.sum() / 4 + a.var_offset[i] + b.var_offset[j]
        p[i, j] = min(1.0, same.sum() * math.erfc(abs(slide[i, j]) / math.sqrt(2 * variance)))
    return slide, p


def _along(a: _Walls, i: int, b: _Walls, j: int) -> Float[np.ndarray, "2"]:
    """The ends of line `j` of `b` in coordinates along line `i` of `a`, the lower one first, m."""
    return np.sort((np.stack([b.begin[j], b.end[j]]) - a.anchor[i]) @ a.tangent[i])


def _moved_line(
    a: _Walls, b: _Walls, pairs: _Pairs, at: tuple[int, int], shift: Float[np.ndarray, "2"], p: float
) -> Change:
    i, j = at
    return Change(
        what="moved",
        kind="line",
        slot_a=i,
        slot_b=j,
        begin=_pair(a.begin[i]),
        end=_pair(a.end[i]),
        radius=None,
        times_detected=min(int(a.times[i]), int(b.times[j])),
        shift=_pair(shift),
        sigma=float(pairs.sigma[at]),
        turn=float(pairs.turn[at]),
        p=float(p),
    )


def _nearest_first(
    distance: Float[np.ndarray, "K L"], rows: Int[np.ndarray, " k"], columns: Int[np.ndarray, " l"]
) -> Iterator[tuple[int, int]]:
    """Pairs of rows and columns, each used once, the least distance first; none that is infinite."""
    block = distance[np.ix_(rows, columns)]
    used_rows, used_columns = set(), set()
    for flat in np.argsort(block, axis=None, kind="stable").tolist():
        r, c = divmod(flat, block.shape[1])
        if not np.isfinite(block[r, c]):
            return
        if r not in used_rows and c not in used_columns:
            used_rows.add(r)
            used_columns.add(c)
            yield int(rows[r]), int(columns[c])


def _missing_lines(
    what: Literal["vanished", "appeared"],
    lines: _Walls,
    others: _Walls,
    same: Bool[np.ndarray, "K L"],
    moved: set[int],
    shortest: float,
) -> Iterator[Change]:
    """The pieces of lines that no line of the other map covers."""
    reach = END_SIGMAS * np.sqrt(lines.var_extent.max(-1)) + END_SLACK
    for i in np.flatnonzero(lines.valid).tolist():
        if i in moved:
            continue
        held = sorted(_along(lines, i, others, j).tolist() for j in np.flatnonzero(same[i]).tolist())
        gaps, at = [], lines.extent[i, 0]
        for low, high in held:
            gaps.append((at, low))
            at = max(at, high)
        gaps.append((at, lines.extent[i, 1]))
        least = shortest + reach[i] if held else 0.0
        for low, high in gaps:
            high = min(high, lines.extent[i, 1])
            if high - low > least:
                yield Change(
                    what=what,
                    kind="line",
                    slot_a=i if what == "vanished" else None,
                    slot_b=i if what == "appeared" else None,
                    begin=_pair(lines.foot[i] + low * lines.tangent[i]),
                    end=_pair(lines.foot[i] + high * lines.tangent[i]),
                    radius=None,
                    times_detected=int(lines.times[i]),
                )


class _CirclePairs(NamedTuple):
    """Each circle of one map against each of the other, `[C, D]`."""

    near: Bool[np.ndarray, "C D"]
    shift: Float[np.ndarray, "C D 2"]  # m
    sigma: Float[np.ndarray, "C D"]  # m, of the length of the shift
    p: Float[np.ndarray, "C D"]  # NaN where one of the two is not fitted


def _circle_pairs(a: LineMap, b: LineMap, within: float) -> _CirclePairs:
    one, other = a.circles, b.circles
    shift = np.asarray(other.center, float)[None] - np.asarray(one.center, float)[:, None]
    distance = np.linalg.norm(shift, axis=-1)
    fitted = np.asarray(one.fitted)[:, None] & np.asarray(other.fitted)[None]
    near = np.asarray(one.valid)[:, None] & np.asarray(other.valid)[None]
    radii = np.asarray(one.radius, float)[:, None] + np.asarray(other.radius, float)[None]
    alike = np.minimum(radii + APART, Thresholds().circle_match_distance)
    near = near & (distance <= np.where(fitted, within, alike))
    cov = np.asarray(one.cov, float)[:, None, :2, :2] + np.asarray(other.cov, float)[None, :, :2, :2]
    cov = np.where((near & fitted)[..., None, None], cov, np.eye(2))
    nis = np.einsum("cdi,cdi->cd", shift, np.linalg.solve(cov, shift[..., None])[..., 0])
    direction = shift / np.maximum(distance, 1e-9)[..., None]
    sigma = np.sqrt(np.einsum("cdi,cdij,cdj->cd", direction, cov, direction))
    return _CirclePairs(near, shift, sigma, np.where(fitted, np.exp(-nis / 2), np.nan))


def _circle_changes(
    a: LineMap, b: LineMap, pairs: _CirclePairs, p: Float[np.ndarray, "C D"], alpha: float, at_least: int
) -> tuple[list[Change], int]:
    """What has become of the circles; and how many of the first map the second holds too."""
    same = pairs.near & (p >= alpha)
    free = [
        np.flatnonzero(np.asarray(detected_often(m, at_least).circles.valid) & ~same.any(axis))
        for m, axis in ((a, 1), (b, 0))
    ]
    moved = list(_nearest_first(np.where(pairs.near, np.linalg.norm(pairs.shift, axis=-1), np.inf), *free))
    changes = []
    parts: list[tuple[What, LineMap, list[int]]] = [
        ("moved", a, [i for i, _ in moved]),
        ("vanished", a, [int(i) for i in free[0] if i not in {i for i, _ in moved}]),
        ("appeared", b, [int(j) for j in free[1] if j not in {j for _, j in moved}]),
    ]
    for what, line_map, slots in parts:
        center, radius = np.asarray(line_map.circles.center, float), np.asarray(line_map.circles.radius, float)
        for k in slots:
            j = dict(moved).get(k) if what == "moved" else None
            changes.append(
                Change(
                    what=what,
                    kind="circle",
                    slot_a=None if what == "appeared" else k,
                    slot_b=k if what == "appeared" else j,
                    begin=_pair(center[k]),
                    end=_pair(center[k]),
                    radius=float(radius[k]),
                    times_detected=int(line_map.circles.times_detected[k]),
                    shift=None if j is None else _pair(pairs.shift[k, j]),
                    sigma=None if j is None else float(pairs.sigma[k, j]),
                    p=None if j is None else float(p[k, j]),
                )
            )
    return changes, int(same.any(1).sum())


def _pair(point: Float[np.ndarray, "2"]) -> tuple[float, float]:
    return float(point[0]), float(point[1])


def _world(lines: list[Change], circles: list[Change]) -> World:
    """The places of changes as a world, with room for a power of two of each kind."""
    room = [1 << max(len(x) - 1, 0).bit_length() for x in (lines, circles)]
    ends, center, radius = np.zeros((room[0], 2, 2)), np.zeros((room[1], 2)), np.ones(room[1])
    for k, change in enumerate(lines):
        ends[k] = change.begin, change.end
    for k, change in enumerate(circles):
        center[k], radius[k] = change.begin, change.radius
    times = [{"appears": jnp.zeros(n, jnp.int32), "vanishes": jnp.full(n, NEVER, jnp.int32)} for n in room]
    return World(
        segments=Segments(
            ends=jnp.asarray(ends),
            body=jnp.arange(room[0], dtype=jnp.int32),
            kind=jnp.full(room[0], int(Kind.WALL), jnp.int32),
            valid=jnp.arange(room[0]) < len(lines),
            **times[0],
        ),
        poles=Poles(
            center=jnp.asarray(center),
            radius=jnp.asarray(radius),
            valid=jnp.arange(room[1]) < len(circles),
            **times[1],
        ),
        path=jnp.zeros((0, 2)),
    )


@jax.jit
def _beams_at(
    world: World, scans: Scan, poses: Pose, mount: Mount, slack: float | Array
) -> tuple[Int[Array, " M"], Int[Array, " M"]]:
    """How many beams passed through each thing, and how many ended at it."""
    things = world.segments.valid.shape[0] + world.poles.valid.shape[0]
    none = jnp.zeros(things, jnp.int32)

    def one(counts: tuple[Array, Array], x: tuple[Scan, Array]) -> tuple[tuple[Array, Array], None]:
        scan, pose = x
        heading = unit(pose[2])
        place = jnp.asarray(mount.x) * heading + jnp.asarray(mount.y) * jnp.stack([-heading[1], heading[0]])
        hits = cast(world, pose[:2] + place, unit(pose[2] + mount.theta + scan.bearings))
        counts_at = scan.valid & jnp.isfinite(hits.ranges) & jnp.isfinite(pose).all()
        more = scan.ranges - jnp.where(counts_at, hits.ranges, 0)
        index = jnp.where(counts_at, hits.thing, things)
        passed, met = (
            old.at[index].add((counts_at & which).astype(jnp.int32), mode="drop")
            for old, which in zip(counts, (more > slack, jnp.abs(more) <= slack), strict=True)
        )
        return (passed, met), None

    return jax.lax.scan(one, (none, none), (scans, poses.mean))[0]
