"""Two maps made one: the matching and the fusion of sections 5.1 and 5.2, with a map in the place of a scan.

Not in the paper. Both maps are in one frame, and of different scans. Nothing is wiped: a map does not tell what it has
seen through.
"""

import dataclasses
from functools import partial

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Int

from linemap_jax.core import fusion, matching
from linemap_jax.core.circles import near_lines
from linemap_jax.core.extract import as_dtype
from linemap_jax.core.mapping import merge_lines
from linemap_jax.core.settings import PoseError, Rules, Thresholds
from linemap_jax.core.slots import neutral_where_free
from linemap_jax.core.state import LineMap, Lines, SlotsT, pytree


@pytree
class MergeReport:
    """What became of the lines and circles of the other map, and how many were joined."""

    lines_joined: Int[Array, ""]
    """Lines that are gone, since they are part of another one now."""
    circles_joined: Int[Array, ""]
    """Circles of the other map that were fused into one of the map."""
    circles_left_out: Int[Array, ""]
    """Circles of either map that contradict the other: too near to a circle or line."""


@partial(jax.jit, static_argnames=("rules", "pose_error"))
def merge_maps(
    line_map: LineMap,
    other: LineMap,
    *,
    thresholds: Thresholds | None = None,
    rules: Rules = Rules(),
    pose_error: PoseError = "unknown",
) -> tuple[LineMap, MergeReport]:
    """Bring one map into another.

    Lines that overlap and agree become one, again and again until none does: a long line of one map may bridge several
    of the other. Lines that overlapped in their own map already and were not joined there stay apart. A line that
    overlaps one of the other map and does not agree with it stays beside it: `linemap_jax.lab.comparison` tells.

    Args:
      line_map: a map of `K` lines and `C` circles.
      other: a map of `L` lines and `D` circles, in the same frame and of the same dtype.
      thresholds: `match_...` and `circle_...`; `Thresholds()` unless given.
      rules: which reading of the method.
      pose_error: "unknown": the errors of the two maps may hang together in any way, and covariances are bounds that
        hold in every case. "independent": two drives of which neither shares its error with the other.

    Returns:
      A map with room for `K + L` lines and `C + D` circles, those of `line_map` in their own slots; and a report.

    Raises:
      ValueError: at trace time, if the maps differ in dtype; or for "persistent", since an error that persists over one
        drive does not persist into another.
    """
    dtype = line_map.lines.offset.dtype
    if other.lines.offset.dtype != dtype:
        raise ValueError(f"one map is {dtype} and the other {other.lines.offset.dtype}; make both the same")
    if pose_error not in ("independent", "unknown"):
        raise ValueError(f"pose_error must be 'independent' or 'unknown' for two maps, not {pose_error!r}")
    gates = as_dtype(thresholds or Thresholds(), dtype)
    if pose_error == "independent":
        line_map, other = _of_one_drive(line_map), _of_one_drive(other)

    lines, involved, joined = _merge_lines(line_map.lines, other.lines, gates, rules, pose_error)

    new = other.circles
    match = matching.match_circles(new, line_map.circles, gates, rules, pose_error)
    circles = fusion.fuse_circles(line_map.circles, new, match, rules, pose_error)
    kept = circles.valid & ~near_lines(circles, _only(lines, involved), gates, rules)
    fresh = new.valid & (match.slot < 0) & (match.suspect < 0) & ~near_lines(new, lines, gates, rules)
    both = _concatenate(_only(circles, kept), _only(new, fresh))
    fused = jnp.sum(new.valid & (match.slot >= 0), dtype=jnp.int32)
    before = jnp.sum(line_map.circles.valid, dtype=jnp.int32) + jnp.sum(new.valid, dtype=jnp.int32)
    report = MergeReport(
        lines_joined=joined,
        circles_joined=fused,
        circles_left_out=before - fused - jnp.sum(both.valid, dtype=jnp.int32),
    )
    return LineMap(lines=neutral_where_free(lines), circles=neutral_where_free(both)), report


def _merge_lines(
    model: Lines, other: Lines, thresholds: Thresholds, rules: Rules, pose_error: PoseError
) -> tuple[Lines, Bool[Array, " K"], Int[Array, ""]]:
    """The lines of both maps; which of them came from the other one, or were joined with such; how many were joined."""
    lines = _concatenate(model, other)
    k = lines.valid.shape[0]
    slots = jnp.arange(k, dtype=jnp.int32)
    theirs = slots >= model.valid.shape[0]

    def overlap(a: Lines, b: Lines) -> Array:
        pair: matching.LineComparison = matching.compare_lines(a, b, thresholds, pose_error)
        return pair.geometric & (pair.gap < 0)

    apart = jax.vmap(jax.vmap(overlap, (None, 0)), (0, None))(lines, lines) & (theirs[:, None] == theirs[None])

    def step(state: tuple[Lines, Array, Array, Array, Array]) -> tuple[Lines, Array, Array, Array, Array]:
        lines, apart, involved, joined, _ = state
        rows = jnp.where(involved & lines.valid, slots, -1)
        # Unlike what one scan adds, these are of different scans: how often they were detected adds up.
        lines, moved, count = merge_lines(lines, lines, rows, apart, thresholds, rules, pose_error, times=jnp.add)
        apart = jnp.zeros_like(apart).at[moved[:, None], moved[None]].max(apart)
        involved = jnp.zeros_like(involved).at[moved].max(involved)
        return lines, apart, involved, joined + count, count

    none = jnp.zeros((), jnp.int32)
    state = (lines, apart, theirs & lines.valid, none, none + 1)
    lines, _, involved, joined, _ = jax.lax.while_loop(lambda state: state[4] > 0, step, state)
    return lines, involved & lines.valid, joined


def _of_one_drive(line_map: LineMap) -> LineMap:
    """A map of which no other shares any error."""
    zero = jnp.zeros((), line_map.lines.offset.dtype)
    return LineMap(lines=fusion.forget(line_map.lines, zero), circles=fusion.forget(line_map.circles, zero))


def _only(slots: SlotsT, meant: Bool[Array, " K"]) -> SlotsT:
    return dataclasses.replace(slots, valid=slots.valid & meant)


def _concatenate(first: SlotsT, second: SlotsT) -> SlotsT:
    return jax.tree.map(lambda a, b: jnp.concatenate([a, b]), first, second)
