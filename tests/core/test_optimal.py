"""The best polyline against all there are, and what `extract` makes of it."""

import dataclasses
import itertools

import jax
import jax.numpy as jnp
import numpy as np
import pytest
import scipy.optimize
import scipy.stats

from linemap_jax import Capacity, Extraction, Mount, Pose, Scan, SensorNoise, Thresholds, extract
from linemap_jax.core.segmentation.optimal import priced
from linemap_jax.core.segmentation.polyline import (
    BEGIN,
    CORNER,
    END,
    INSIDE,
    LEFT,
    Polyline,
    Sweep,
    best_polyline,
    refine,
)
from linemap_jax.core.sensor import points_from_scan

N = 9
SPACING = np.radians(6.0)
PRICE = 0.4
VERTEX_PRICE = 0.15
BUDGETS = (2, 3, 4, 5, 6)
RUNS = 300
HERE = Pose(mean=jnp.zeros(3), cov=jnp.zeros((3, 3)))
BEARINGS = np.radians(np.arange(-180.0, 180.0, 4.0))
NOISE = SensorNoise(range_sigma=0.01, bearing_sigma=0.0)


def room(bearings: np.ndarray, half: tuple[float, float] = (3.0, 2.0)) -> np.ndarray:
    """Ranges from the middle of a room."""
    with np.errstate(divide="ignore"):
        return np.minimum(half[0] / np.abs(np.cos(bearings)), half[1] / np.abs(np.sin(bearings)))


# --- All polylines there are


def structures(n: int, least: int):
    """What each of `n` points may be to a polyline whose lines have at least so many points of their own."""
    if n == 0:
        yield ()
        return
    for rest in structures(n - 1, least):
        yield (LEFT, *rest)
    for length in range(least, n + 1):
        # The chain holds the first `length` points; its lines divide them.
        for corners in itertools.chain.from_iterable(itertools.combinations(range(1, length - 1), k) for k in range(4)):
            marks = (0, *corners, length - 1)
            own = [marks[1] + 1, *np.diff(marks[1:])]
            if min(own) < least:
                continue
            chain = [INSIDE] * length
            for corner in corners:
                chain[corner] = CORNER
            chain[0], chain[-1] = BEGIN, END
            for rest in structures(n - length, least):
                yield (*chain, *rest)


def cost_of(kind: tuple[int, ...], angle: np.ndarray, ranges: np.ndarray) -> float:
    """The least sum of squares of a polyline, its vertices on the beams, and the price of what it leaves out.

    Linear in the inverse ranges of the vertices; a plain least-squares problem for each chain.
    """
    total, vertices = PRICE * sum(k == LEFT for k in kind), []
    for i, k in enumerate(kind):
        if k == BEGIN:
            vertices = [i]
        elif k in (CORNER, END):
            vertices.append(i)
        if k == END:
            rows = np.zeros((i - vertices[0] + 1, len(vertices)))
            for row, p in enumerate(range(vertices[0], i + 1)):
                k1 = min(int(np.searchsorted(vertices, p, side="right")) - 1, len(vertices) - 2)
                a, b = angle[vertices[k1]], angle[vertices[k1 + 1]]
                rows[row, k1 : k1 + 2] = np.sin(b - angle[p]) / np.sin(b - a), np.sin(angle[p] - a) / np.sin(b - a)
            r = ranges[vertices[0] : i + 1]
            residual = r - r**2 * (rows @ np.linalg.lstsq(r[:, None] ** 2 * rows, r, rcond=None)[0])
            total += float(residual @ residual)
    return total


@pytest.fixture(scope="module")
def short_scans() -> np.ndarray:
    """Ranges of few beams on two walls, with noise that is not small: many polylines are nearly as good."""
    random = np.random.default_rng(3)
    scans = []
    for _ in range(24):
        corner, slope, jump = random.integers(2, N - 2), random.normal(0, 0.6, 2), random.choice([0.0, 1.5])
        bend = np.where(np.arange(N) <= corner, slope[0], slope[1]) * (np.arange(N) - corner) / N
        scans.append(2 + bend + jump * (np.arange(N) > corner) + random.normal(0, 0.15, N))
    return np.stack(scans)


def sweep_of(ranges: jax.Array, spacing: float, sigma: float, price: float) -> Sweep:
    """All beams returned, and a line may hold any of them."""
    n, ones = ranges.shape[0], jnp.ones_like(ranges)
    return Sweep(
        angle=jnp.asarray(spacing * np.arange(n), ranges.dtype),
        range=ranges,
        weight=ones / sigma,
        price=price * ones,
        follows=jnp.arange(n) > 0,
        again=ones < 0,
        valid=ones > 0,
    )


@pytest.fixture(scope="module")
def all_costs(short_scans: np.ndarray) -> tuple[list[tuple[int, ...]], np.ndarray]:
    """All polylines, and what each costs for each scan."""
    kinds = [kind for kind in structures(N, 2) if sum(k in (BEGIN, CORNER, END) for k in kind) <= max(BUDGETS)]
    angle = SPACING * np.arange(N)
    return kinds, np.array([[cost_of(kind, angle, ranges) for kind in kinds] for ranges in short_scans])


def cost_of_free_lines(angle: np.ndarray, ranges: np.ndarray) -> float:
    """The least cost of all divisions into lines, each the best one of its points, by recursion over all of them.

    A line has two vertices, and shares one with the line before if they cross between their neighbouring points.
    """
    n = len(ranges)

    def inverse(run: tuple[int, int], k: int) -> float:
        return float(np.array([np.cos(angle[k]), np.sin(angle[k])]) @ fits[run][1])

    fits = {}
    for run in ((i, j) for i in range(n) for j in range(i + 1, n)):
        r, a = (x[run[0] : run[1] + 1] for x in (ranges, angle))
        design = r[:, None] ** 2 * np.stack([np.cos(a), np.sin(a)], -1)
        line = np.linalg.lstsq(design, r, rcond=None)[0]
        fits[run] = float(np.sum((r - design @ line) ** 2)), line

    def cheapest(k: int, before: tuple[int, int] | None) -> float:
        """From some point on, by the line that ends before it."""
        if k == n:
            return 0.0
        costs = [PRICE + cheapest(k + 1, None)]
        for run in ((k, j) for j in range(k + 1, n)):
            if inverse(run, k) > 0 and inverse(run, run[1]) > 0:
                apart = [] if before is None else [inverse(before, p) - inverse(run, p) for p in (k - 1, k)]
                vertices = 1 if apart and apart[0] * apart[1] <= 0 else 2
                costs.append(fits[run][0] + vertices * VERTEX_PRICE + cheapest(run[1] + 1, run))
        return min(costs)

    return cheapest(0, None)


def vertices_of(kinds: list[tuple[int, ...]]) -> np.ndarray:
    return np.array([sum(k in (BEGIN, CORNER, END) for k in kind) for kind in kinds])


def searched(scans: np.ndarray, budget: int | None) -> tuple[np.ndarray, np.ndarray]:
    """What the search takes for the best polylines, and their costs."""
    most = None if budget is None else max(BUDGETS)
    vertex_price = jnp.asarray(VERTEX_PRICE if budget is None else 0.0)

    def search(ranges: jax.Array, within: jax.Array) -> tuple:
        sweep = sweep_of(ranges, SPACING, 1.0, PRICE)
        return best_polyline(sweep, vertex_price, max_vertices=most, min_points=2, within=within)

    within = jnp.full(len(scans), 10 if budget is None else budget)
    kind, _, cost = jax.jit(jax.vmap(search))(jnp.asarray(scans), within)
    return np.asarray(kind), np.asarray(cost)


@pytest.mark.parametrize("budget", BUDGETS)
def test_it_is_the_best_of_all(budget, short_scans, all_costs):
    kinds, costs = all_costs
    costs = np.where(vertices_of(kinds) <= budget, costs, np.inf)
    best = costs.min(1)
    found, cost = searched(short_scans, budget)
    np.testing.assert_array_less(best - 1e-9, cost)
    # What it says that its polyline costs is what that costs.
    said = [costs[i, kinds.index(tuple(kind.tolist()))] for i, kind in enumerate(found)]
    np.testing.assert_allclose(cost, said, atol=1e-8)
    # Exact where the best lines share no corner; elsewhere a past that was not the cheapest may win, by little.
    shares = np.array([CORNER in kinds[k] for k in costs.argmin(1)])
    np.testing.assert_allclose(cost[~shares], best[~shares], atol=1e-8)
    assert np.mean(cost < best + 1e-8) >= 0.9
    assert np.all(cost <= 1.1 * best)


def test_free_lines_are_the_best_of_all(short_scans):
    _, cost = searched(short_scans, None)
    best = [cost_of_free_lines(SPACING * np.arange(N), ranges) for ranges in short_scans]
    np.testing.assert_allclose(cost, best, atol=1e-8)


def test_float32_finds_the_same_far_away():
    random = np.random.default_rng(5)
    ranges = 50 / np.cos(np.radians(0.5 * np.arange(-60, 61))) + random.normal(0, 0.02, 121)
    found = {}
    for dtype in (jnp.float32, jnp.float64):
        sweep = sweep_of(jnp.asarray(ranges, dtype), np.radians(0.5), 0.02, 25.0)
        price = jnp.asarray(10, dtype)
        kind, _, cost = best_polyline(sweep, price, max_vertices=None, min_points=3)
        found[dtype] = np.asarray(kind), float(cost)
    np.testing.assert_array_equal(found[jnp.float32][0], found[jnp.float64][0])
    assert np.flatnonzero(found[jnp.float64][0] != INSIDE).tolist() == [0, 120]
    # Rounding of the ranges to 4 um is 2e-4 sigma.
    assert found[jnp.float32][1] == pytest.approx(found[jnp.float64][1], rel=1e-2)


def test_vertices_move_to_where_the_squares_are_least():
    """Two walls and their corner, from a start that is off, against scipy with lines through points of the plane."""
    random = np.random.default_rng(6)
    spacing, count = np.radians(2.0), 50
    angle = spacing * np.arange(count)
    vertices = np.array([[3.0, 0.0], [2.5, 2.2], [-0.6, 1.9]])  # seen at 41.3 degrees, between two beams
    beams = np.stack([np.cos(angle), np.sin(angle)], -1)

    def ranges_to(polar: np.ndarray) -> np.ndarray:
        """By angles and inverse ranges of the vertices."""
        at = np.stack([np.cos(polar[:3]), np.sin(polar[:3])], -1) / polar[3:, None]
        first, second = (np.where((angle <= polar[1])[:, None], at[i], at[i + 1]) for i in (0, 1))
        normal = np.stack([second[:, 1] - first[:, 1], first[:, 0] - second[:, 0]], -1)
        return np.sum(normal * first, 1) / np.sum(normal * beams, 1)

    def free(x: np.ndarray) -> np.ndarray:
        """The ends stay on their beams."""
        return np.concatenate([[0, x[0], angle[-1]], x[1:]])

    polar = np.concatenate([np.arctan2(vertices[:, 1], vertices[:, 0]), 1 / np.hypot(*vertices.T)])
    ranges = ranges_to(polar) + random.normal(0, 0.02, count)
    start = np.array([angle[18], 1 / ranges[0], 1 / ranges[18], 1 / ranges[-1]])
    best = scipy.optimize.least_squares(lambda x: ranges_to(free(x)) - ranges, start)
    line = Polyline(
        angle=jnp.asarray([*free(start)[:3], 1e3]),
        inverse=jnp.asarray([*start[1:], 1.0]),
        valid=jnp.asarray([True, True, True, False]),
        is_begin=jnp.arange(4) == 0,
        is_end=jnp.arange(4) == 2,
    )
    everywhere, no = jnp.ones(count, bool), jnp.zeros((), bool)
    found, cost = jax.jit(refine)(line, jnp.asarray(angle), jnp.asarray(ranges), everywhere, jnp.asarray(spacing), no)
    assert cost == pytest.approx(2 * best.cost, rel=1e-4)
    # In sigmas of the estimate
    off = best.jac @ (np.array([found.angle[1], *found.inverse[:3]]) - best.x) / 0.02
    assert np.linalg.norm(off) < 0.01


def test_what_a_search_reckons_with():
    """The price of a vertex; and how ranges err.

    dr / d(bearing) = r tan(incidence): at both ends of a wall too, and beside a corner by the steeper wall.
    """
    angle = np.radians(0.5 * np.arange(40, 121))
    wall = Scan.from_ranges(3 / np.cos(angle), angle)
    points = points_from_scan(wall, HERE, Mount(), jacobians="analytic")
    noise = SensorNoise(range_sigma=0.01, bearing_sigma=0.005)
    follows = jnp.arange(len(angle)) > 0
    sweep, price = priced(points, follows, Thresholds(), noise)
    # What noise gains by two more numbers at one of the points is chi-square: more than the price in a tenth of scans.
    assert len(angle) * float(scipy.stats.chi2.sf(price, 2)) == pytest.approx(0.1)
    expected = np.hypot(0.01, 0.005 * 3 / np.cos(angle) * np.tan(angle))
    np.testing.assert_allclose(1 / sweep.weight, expected, rtol=0.08)
    # Where a surface ends, what stands behind it says nothing of its slant.
    broken = dataclasses.replace(points, range=points.range.at[40:].add(2.0))
    parted, _ = priced(broken, follows & (jnp.arange(len(angle)) != 40), Thresholds(), noise)
    np.testing.assert_allclose(parted.weight[:40], sweep.weight[:40], rtol=0.08)


# --- Extractions


def extractor(max_vertices: int | None):
    """`extract` of a batch of scans."""

    def one(ranges: jax.Array) -> Extraction:
        scan = Scan.from_ranges(ranges, BEARINGS, range_max=20.0)
        return extract(
            scan,
            HERE,
            noise=NOISE,
            capacity=Capacity(8, 8),
            segmentation="optimal",
            max_vertices=max_vertices,
            jacobians="analytic",
        )

    return jax.jit(jax.vmap(one))


@pytest.fixture(scope="module")
def scans() -> np.ndarray:
    """A room; the room with a doorway; nothing."""
    random = np.random.default_rng(1)
    ideal = room(BEARINGS)
    noisy = ideal + random.normal(0, 0.01, ideal.size)
    doorway = np.where(np.abs(BEARINGS) < np.radians(9), 30.0, noisy)
    return np.stack([noisy, doorway, np.full(ideal.size, np.nan)])


@pytest.fixture(scope="module")
def with_budget(scans: np.ndarray) -> Extraction:
    return extractor(4)(scans)


@pytest.fixture(scope="module")
def by_criterion(scans: np.ndarray) -> Extraction:
    """These scans, and `RUNS` of the room with other noise."""
    noise = np.random.default_rng(7).normal(0, 0.01, (RUNS, BEARINGS.size))
    return extractor(None)(np.concatenate([scans, room(BEARINGS)[None] + noise]))


def segments(found: Extraction, scan: int) -> np.ndarray:
    """The end points of its lines, `[L, 2, 2]`."""
    lines = found.lines
    return np.stack([np.asarray(lines.begin), np.asarray(lines.end)], 2)[scan][np.asarray(lines.valid)[scan]]


def test_a_room_is_four_lines_that_meet(by_criterion):
    lines = segments(by_criterion, 0)
    # The sweep is begun near the fourth corner, and three are left to be shared.
    corners = np.array([[3.0, -2.0], [3.0, 2.0], [-3.0, 2.0]])
    assert len(lines) == 4
    for line, other, corner in zip(lines[:-1], lines[1:], corners, strict=True):
        np.testing.assert_allclose(line[1], other[0], atol=1e-9)
        np.testing.assert_allclose(line[1], corner, atol=0.03)


def test_a_closed_room_is_one_polygon(with_budget):
    lines = segments(with_budget, 0)
    np.testing.assert_allclose(lines[:, 1], np.roll(lines[:, 0], -1, 0), atol=1e-9)
    vertices = np.unique(np.round(lines.reshape(-1, 2), 6), axis=0)
    assert len(vertices) == len(lines) == 4
    for corner in np.array([[-3.0, -2.0], [3.0, -2.0], [3.0, 2.0], [-3.0, 2.0]]):
        assert np.min(np.linalg.norm(vertices - corner, axis=1)) < 0.03
    beams = np.asarray(with_budget.line_of_beam)[0]
    assert np.all(beams >= 0)


def test_no_line_passes_a_beam_without_a_return(with_budget, by_criterion):
    for found in (with_budget, by_criterion):
        assert np.all(np.asarray(found.line_of_beam)[1][np.abs(BEARINGS) < np.radians(9)] == -1)
        lines = segments(found, 1)
        begin, end = (np.degrees(np.arctan2(lines[:, k, 1], lines[:, k, 0])) for k in (0, 1))
        ahead = (np.abs(begin) < 90) & (np.abs(end) < 90)
        assert not np.any(ahead & (begin < -1) & (end > 1))
        assert len(np.unique(np.round(lines.reshape(-1, 2), 6), axis=0)) <= (4 if found is with_budget else 99)


def test_nothing_gives_nothing(with_budget, by_criterion):
    for found in (with_budget, by_criterion):
        assert not np.asarray(found.lines.valid)[2].any()
        assert all(np.all(np.isfinite(np.asarray(x)[2])) for x in jax.tree.leaves(found))


def test_the_lines_are_as_good_as_their_covariances_say(by_criterion):
    lines = jax.tree.map(lambda x: np.asarray(x)[-RUNS:], by_criterion.lines)
    # The front wall, x = 3: the line whose normal is nearest to its own
    which = np.argmax(np.where(lines.valid, np.abs(np.cos(lines.angle)) * (lines.anchor[..., 0] > 0), -1), 1)
    offset, angle, anchor, cov = (
        x[np.arange(RUNS), which] for x in (lines.offset, lines.angle, lines.anchor, np.asarray(lines.cov))
    )
    sign = np.sign(np.cos(angle))
    error = np.stack([offset - sign * (3 - anchor[:, 0]), np.arcsin(np.sin(angle) * sign)], -1)
    nees = np.einsum("ni,nij,nj->n", error, np.linalg.inv(cov), error)
    # Chi-square with two degrees of freedom has a standard deviation of 2.
    assert abs(nees.mean() - 2) < 5 * 2 / np.sqrt(RUNS)


def test_noise_makes_few_corners(by_criterion):
    """In less than a tenth of the scans, as the price of a vertex has it."""
    count = np.asarray(by_criterion.lines.valid)[-RUNS:].sum(1)
    assert np.mean(count > 4) < 0.1


@pytest.mark.parametrize("budget", [1, 0, -3, True])
def test_a_budget_that_is_none_is_refused(budget):
    scan = Scan.from_ranges(room(BEARINGS), BEARINGS)
    with pytest.raises(ValueError, match="max_vertices must be a whole number of 2 or more"):
        extract(scan, HERE, segmentation="optimal", max_vertices=budget)


def test_a_budget_needs_the_optimal_segmentation():
    scan = Scan.from_ranges(room(BEARINGS), BEARINGS)
    with pytest.raises(ValueError, match="max_vertices is for segmentation='optimal'"):
        extract(scan, HERE, max_vertices=10)
