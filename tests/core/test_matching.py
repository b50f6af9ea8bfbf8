"""The gates of sections 5.1.1 and 5.2.1, each just passed and just failed."""

import dataclasses
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from maps import lines_between, poles_at

from linemap_jax.core.matching import best_line, compare_lines, compare_pieces, group_lines, match_circles, match_lines
from linemap_jax.core.settings import Rules, Thresholds
from linemap_jax.core.state import Lines

FIXED = Thresholds(match_sigmas=0.0)
WALL = [[0.0, 0.0], [4.0, 0.0]]
ROOM = 3

BEST = jax.jit(best_line, static_argnames=("pose_error", "overlapping", "same_side"))
MATCH = jax.jit(match_lines, static_argnames=("rules", "pose_error"))
MATCH_CIRCLES = jax.jit(match_circles, static_argnames=("rules", "pose_error"))


def walls(*ends: Any, sigma: tuple[float, float] = (0.01, 0.003)) -> Lines:
    return lines_between(ends, sigma=sigma, room=ROOM)


def compared(
    ends: Any, sigma: tuple[float, float] = (1e-4, 1e-4), thresholds: Thresholds = FIXED, **changes: Any
) -> Any:
    """A line held against `WALL`, both of that sigma."""
    new, model = (jax.tree.map(lambda x: x[0], walls(line, sigma=sigma)) for line in (ends, WALL))
    return compare_lines(dataclasses.replace(new, **changes), model, thresholds, "independent")


def turned(angle: float) -> list[list[float]]:
    """A metre of the wall, turned about its middle."""
    x, y = 0.5 * np.cos(angle), 0.5 * np.sin(angle)
    return [[2 - x, -y], [2 + x, y]]


@pytest.mark.parametrize(
    ("ends", "collinear", "geometric"),
    [
        (WALL, True, True),
        (WALL[::-1], True, True),
        # the angle: 0.05 rad
        (turned(0.0499), True, True),
        (turned(0.0501), False, False),
        (turned(-0.0499), True, True),
        (turned(-0.0501), False, False),
        (turned(np.pi + 0.0499), True, True),
        (turned(np.pi + 0.0501), False, False),
        # the end points: 0.05 m, each of them
        ([[1, 0.0499], [2, 0.0499]], True, True),
        ([[1, 0.0501], [2, 0.0501]], False, False),
        ([[0, 0], [4, 0.0499]], True, True),
        ([[0, 0], [4, 0.0501]], False, False),
        ([[0, -0.0501], [4, 0]], False, False),
        # the gap along the line: 0.5 m, behind it and before it
        ([[4.499, 0], [6, 0]], True, True),
        ([[4.501, 0], [6, 0]], True, False),
        ([[6, 0], [4.501, 0]], True, False),
        ([[-2, 0], [-0.499, 0]], True, True),
        ([[-2, 0], [-0.501, 0]], True, False),
        # against the boundless line: an end far away counts as much as a near one
        ([[4.4, 0.0], [8.4, 0.0501]], False, False),
    ],
)
def test_gates_on_angle_end_points_and_gap(ends: Any, collinear: bool, geometric: bool) -> None:
    pair = compared(ends)
    assert (bool(pair.collinear), bool(pair.geometric)) == (collinear, geometric)
    assert pair.sign == (-1 if ends[0][0] > ends[1][0] else 1)


def test_the_gap_is_that_between_the_segments() -> None:
    for ends, gap in (([[4.3, 0], [6, 0]], 0.3), ([[-1, 0], [-0.2, 0]], 0.2), ([[3, 0], [6, 0]], -1), (WALL, -4)):
        assert compared(ends).gap == pytest.approx(gap)


@pytest.mark.parametrize("sigmas", [0.0, 3.0])
def test_the_first_two_gates_widen_with_the_predicted_spread(sigmas: float) -> None:
    thresholds = Thresholds(match_sigmas=sigmas)
    # Of two lines, each of 0.02 rad: 3 * 0.02 * sqrt(2) = 0.0849; each of 0.02 m, likewise
    for ends, sigma, wide in (
        (turned(0.084), (1e-4, 0.02), True),
        (turned(0.086), (1e-4, 0.02), False),
        ([[1, 0.084], [3, 0.084]], (0.02, 1e-4), True),
        ([[1, 0.086], [3, 0.086]], (0.02, 1e-4), False),
    ):
        assert compared(ends, sigma, thresholds).collinear == (wide and sigmas > 0)


def test_what_is_seen_from_the_other_side_is_another_face() -> None:
    """The nearer line of the map is the back of a partition: without sides it is the match."""
    model, new = walls([[4.0, 0.0], [0.0, 0.0]], [[0.0, 0.03], [4.0, 0.03]]), walls([[1.0, 0.01], [3.0, 0.01]])
    for same_side, slot in ((True, 1), (False, 0)):
        assert int(BEST(new, model, FIXED, "independent", same_side=same_side)[0][0]) == slot
    own = jnp.eye(ROOM, dtype=bool)
    for rules, slot in ((Rules(), 1), (Rules(tell_sides=False), 0)):
        assert int(MATCH(new, model, own, Thresholds(), rules, "independent").slot[0]) == slot
    only_back = walls([[4.0, 0.0], [0.0, 0.0]])
    match = MATCH(new, only_back, own, Thresholds(), Rules(), "independent")
    assert (int(match.slot[0]), int(match.suspect[0])) == (-1, -1)


def test_a_free_slot_matches_nothing() -> None:
    pair = compared(WALL, valid=jnp.asarray(False))
    assert not pair.collinear
    assert not pair.geometric


def test_the_normalised_distance_is_that_of_equation_21() -> None:
    # Two independent lines of 1 cm and 3 mrad: (offset / 0.01)^2 / 2 + (angle / 0.003)^2 / 2, at the new line's anchor
    for offset, angle in ((0.03, 0.0), (0.0, 0.01), (-0.02, 0.006)):
        x, y = 2 * np.cos(angle), 2 * np.sin(angle)
        pair = compared([[2 - x, offset - y], [2 + x, offset + y]], sigma=(0.01, 0.003))
        assert pair.nis == pytest.approx((offset / 0.01) ** 2 / 2 + (angle / 0.003) ** 2 / 2)
        assert (abs(pair.offset), pair.angle) == pytest.approx((abs(offset), angle))


def test_an_error_that_both_share_cancels_where_it_persists() -> None:
    root = np.zeros((ROOM, 2, 3))
    root[:, 0, 1] = 0.1
    near, model = (
        dataclasses.replace(lines, sqrt_persistent=jnp.asarray(root))
        for lines in (walls([[0, 0.03], [4, 0.03]]), walls(WALL))
    )
    for pose_error, variance in (("independent", 2e-4 + 2e-2), ("persistent", 2e-4)):
        _, nis = BEST(near, model, Thresholds(), pose_error=pose_error)
        assert nis[0] == pytest.approx(0.03**2 / variance)


GATE = 9.21


@pytest.mark.parametrize("ambiguous_out", [True, False])
@pytest.mark.parametrize("nis", [0.0, 9.2, 9.22])
def test_gate_of_equation_22(nis: float, ambiguous_out: bool) -> None:
    y = np.sqrt(nis * 2e-4)
    rules = Rules(leave_out_ambiguous=ambiguous_out)
    found = MATCH(
        walls([[0, y], [4, y]]),
        walls(WALL),
        jnp.eye(ROOM, dtype=bool),
        Thresholds(),
        rules=rules,
        pose_error="independent",
    )
    passes = nis < GATE
    assert found.nis[0] == pytest.approx(nis)
    assert found.slot.tolist() == [0 if passes else -1, -1, -1]
    assert found.suspect.tolist() == [0 if not passes and ambiguous_out else -1, -1, -1]
    assert found.compared.tolist() == [True, False, False]


def test_of_several_matches_the_nearest_is_taken_and_of_equal_ones_that_which_overlaps_most() -> None:
    model = walls(WALL, [[0, 0.02], [4, 0.02]])
    new = walls([[0, 0.004], [4, 0.004]], [[0, 0.016], [4, 0.016]])
    slot, nis = BEST(new, model, Thresholds(), pose_error="independent")
    assert slot.tolist()[:2] == [0, 1]
    assert nis[:2] == pytest.approx(0.004**2 / 2e-4)
    assert np.isinf(nis[2])

    fragments = walls([[0, 0], [1, 0]], [[1.2, 0], [4, 0]])
    slot, _ = BEST(walls(WALL), fragments, Thresholds(), pose_error="independent")
    assert slot[0] == 1


def test_pairs_may_be_left_out_and_segments_be_asked_to_overlap() -> None:
    model, options = walls(WALL, [[0, 0.02], [4, 0.02]]), {"pose_error": "independent"}
    among = jnp.ones((ROOM, ROOM), bool).at[0, 0].set(False)
    slot, nis = BEST(walls(WALL), model, Thresholds(), among=among, **options)
    assert (slot[0], nis[0]) == (1, pytest.approx(0.02**2 / 2e-4))
    for begin, overlaps in ((3.9, True), (4.1, False)):
        _, nis = BEST(walls([[begin, 0], [6, 0]]), model, Thresholds(), overlapping=True, **options)
        assert np.isfinite(nis[0]) == overlaps


def test_a_line_that_the_scan_has_seen_beside_another_is_not_the_same() -> None:
    new = walls([[0, 0.001], [4, 0.001]], [[0, 0.02], [4, 0.02]])
    for collinear, expected in ((jnp.ones((ROOM, ROOM), bool), [0, 0]), (jnp.eye(ROOM, dtype=bool), [0, -1])):
        found = MATCH(new, walls(WALL), collinear, Thresholds(), rules=Rules(), pose_error="independent")
        assert found.slot.tolist()[:2] == expected
        assert found.compared.tolist()[:2] == [True, expected[1] == 0]


def test_pieces_of_one_wall_are_led_by_the_first() -> None:
    @jax.jit
    def grouped(new: Lines) -> jax.Array:
        return group_lines(compare_pieces(new, Thresholds()), new.valid, Thresholds())

    assert grouped(walls([[0, 0], [1, 0]], [[1.4, 0], [2.4, 0]], [[0, 1], [1, 1]])).tolist() == [0, 0, 2]
    # Beyond the gap, and a free slot
    assert grouped(walls([[0, 0], [1, 0]], [[1.6, 0], [2.6, 0]])).tolist() == [0, 1, -1]


@pytest.mark.parametrize(
    ("x", "fitted", "options", "slot", "ambiguous"),
    [
        # The centres: 0.3 m
        (0.299, False, {}, 0, False),
        (0.301, False, {}, -1, False),
        (0.299, True, {"weigh_circles": False}, 0, False),
        (0.301, True, {"weigh_circles": False}, -1, False),
        # Fitted ones: 11.34, of two poles of 1 cm each
        (np.sqrt(11.33 * 2e-4), True, {}, 0, False),
        (np.sqrt(11.35 * 2e-4), True, {}, -1, True),
        (np.sqrt(11.35 * 2e-4), True, {"leave_out_ambiguous": False}, -1, False),
    ],
)
def test_gates_of_circles(x: float, fitted: bool, options: dict[str, bool], slot: int, ambiguous: bool) -> None:
    new, model = poles_at([x, 0, 0.1], fitted=fitted), poles_at([[5, 5, 0.1], [0, 0, 0.1]], fitted=fitted)
    found = MATCH_CIRCLES(new, model, Thresholds(), rules=Rules(**options), pose_error="independent")
    assert found.slot.tolist() == [1 if slot == 0 else -1, -1, -1, -1]
    assert found.suspect.tolist() == [1 if ambiguous else -1, -1, -1, -1]
    assert found.distance[0] == pytest.approx(x if slot == 0 else 0)
    near = fitted and x < 0.3
    assert found.dof[0] == (3 if near else 0)
    assert found.nis[0] == pytest.approx(x**2 / 2e-4 if near else 0)


def test_the_radius_of_fitted_circles_counts() -> None:
    for radius, slot in ((0.1 + np.sqrt(11.33 * 2e-4), 0), (0.1 + np.sqrt(11.35 * 2e-4), -1)):
        new, model = poles_at([0, 0, radius]), poles_at([0, 0, 0.1])
        assert MATCH_CIRCLES(new, model, Thresholds(), rules=Rules(), pose_error="independent").slot[0] == slot
