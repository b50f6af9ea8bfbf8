"""What the derivatives are checked on: random inputs, and those on which formulas for lines break."""

import dataclasses
from collections.abc import Iterator

import numpy as np
from jaxtyping import Float

FEW, MANY = 30, 1000
"""Points of a run. Shorter runs are padded to the lower number, as in the pipeline."""

DIRECTIONS = {
    "horizontal": (1, 0),
    "vertical": (0, 1),
    "45 degrees": (1, 1),
    "-45 degrees": (1, -1),
    "flat": (0.94, 0.34),
    "steep": (-0.27, 0.96),
    "just flat": (0.75, -0.66),
    "just steep": (0.66, 0.75),
}
"""Of a line, not normalised: so the first four are exact in binary, and N_1 = N_2 for two of them."""

PLACES = {"near": (3.0, -2.0), "through the origin": (0.0, 0.0), "10 km away": (10_000.0, -7_000.0)}
"""Of a line's middle, m."""


@dataclasses.dataclass(frozen=True, kw_only=True)
class Case:
    """One input of a function of `x` and of what else it is given."""

    name: str
    x: np.ndarray  # differentiated with respect to
    given: tuple[np.ndarray, ...]
    regular: bool = True
    """False where the estimate has no derivative worth the name; then its gradients only have to be finite."""


@dataclasses.dataclass(frozen=True, kw_only=True)
class Run:
    """Points in a row."""

    name: str
    points: Float[np.ndarray, "n 2"]  # m
    regular: bool = True

    @property
    def padded(self) -> Float[np.ndarray, "N 2"]:
        """The points, and after them other ones that belong to no run. Shape `[FEW, 2]` or `[MANY, 2]`."""
        size = FEW if len(self.points) <= FEW else MANY
        rest = np.stack([np.arange(size - len(self.points)), np.ones(size - len(self.points))], -1)
        return np.concatenate([self.points, rest])

    def counter_clockwise(self, center: Float[np.ndarray, "2"]) -> "Run":
        """The points in the order in which the pipeline holds them: most steps turn left, seen from a centre."""
        ray = self.points - center
        turns = ray[:-1, 0] * ray[1:, 1] - ray[:-1, 1] * ray[1:, 0]
        falling = np.sum(np.sign(turns)) < 0
        return dataclasses.replace(self, points=self.points[::-1]) if falling else self

    @property
    def count(self) -> np.ndarray:
        """Number of points. Shape `[]`."""
        return np.array(len(self.points))


def runs(random: np.random.Generator, places: dict[str, tuple[float, float]] = PLACES) -> Iterator[Run]:
    """Points along lines, in order: each direction at each place, exact and with noise, 3, 30 and 1000 of them."""
    sizes = [(3, 0.01), (FEW, 0.01), (FEW, 0.0)]
    for i, (direction, step) in enumerate(DIRECTIONS.items()):
        for j, (place, middle) in enumerate(places.items()):
            for n, noise in [*sizes, (MANY, 0.01)] if (i + j) % 3 == 0 else sizes:
                # Steps of a sixteenth, or an eighth, of a metre have no rounding.
                along = (np.arange(n) - n // 2) / (8 if n == 3 else 16)
                points = np.array(middle) + along[:, None] * np.array(step)
                points += noise * random.standard_normal((n, 2))
                backward = random.random() < 0.5
                how = [place, f"{n} points", *(["exact"] if noise == 0 else []), *(["reversed"] if backward else [])]
                yield Run(name=", ".join([direction, *how]), points=points[::-1] if backward else points)
    yield Run(name="all points equal", points=np.full((5, 2), 2.0), regular=False)


def arcs(random: np.random.Generator) -> Iterator[Run]:
    """Points of poles, as a scanner sees them, and of other clusters: near, around the origin, 10 km away."""
    for place, middle in PLACES.items():
        for n in (2, 3, FEW, *([MANY] if place == "near" else [])):
            towards, radius = random.uniform(-np.pi, np.pi), random.uniform(0.03, 0.15)
            angle = towards + np.linspace(-1.3, 1.3, n)
            points = np.array(middle) + radius * np.stack([np.cos(angle), np.sin(angle)], -1)
            points += 0.005 * random.standard_normal((n, 2))
            yield Run(name=f"pole, {place}, {n} points", points=points)
    for direction, step in DIRECTIONS.items():
        points = np.array(PLACES["near"]) + np.arange(5)[:, None] / 64 * np.array(step)
        yield Run(name=f"{direction}, 5 points", points=points)
    yield Run(name="all points equal", points=np.full((5, 2), 2.0), regular=False)


def beams(random: np.random.Generator) -> Iterator[tuple[Run, np.ndarray, np.ndarray, np.ndarray]]:
    """Walls as a scanner sees them: the run in the robot's place, the pose, the measurements, and the mount.

    The robot stands near the origin of the world, on it, so that the wall passes through it, and 10 km away.
    """
    somewhere = {"wall ahead": (2.0, 1.5), "wall on the left": (-0.5, 3.0)}
    for run in runs(random, somewhere):
        towards = np.mean(run.points, 0)
        for place, position in {
            "near": (4.0, -1.0),
            "wall through the origin": (-towards[0], -towards[1]),
            "10 km away": PLACES["10 km away"],
        }.items():
            if place != "near" and (len(run.points) == MANY or not run.regular):
                continue
            mount = np.array([0.2, -0.1, 0.5]) if random.random() < 0.5 else np.zeros(3)
            pose = np.array([*position, random.uniform(-np.pi, np.pi)])
            c, s = np.cos(pose[2]), np.sin(pose[2])
            laser = np.array([c * mount[0] - s * mount[1], s * mount[0] + c * mount[1]])
            swept = run.counter_clockwise(laser)
            ray = swept.padded - laser
            bearing = np.arctan2(ray[:, 1], ray[:, 0]) - pose[2] - mount[2]
            measurements = np.stack([np.hypot(ray[:, 0], ray[:, 1]), bearing], -1)
            named = dataclasses.replace(swept, name=f"{run.name}, robot {place}")
            yield named, pose, measurements, mount


def slopes(random: np.random.Generator) -> Iterator[tuple[str, np.ndarray]]:
    """Slopes and intercepts: a slope is at most 1, by the choice between (m, q) and (s, t)."""
    for slope in (0.0, 1.0, -1.0, *random.uniform(-1, 1, 3)):
        for intercept in (0.0, 1e-9, -1e-9, *random.uniform(-10, 10, 2), 1e4, -1e4):
            yield f"slope {slope:.3g}, intercept {intercept:.3g}", np.array([slope, intercept])


def covariances(random: np.random.Generator) -> Iterator[tuple[str, np.ndarray, np.ndarray]]:
    """Pairs of covariances of a line: alike, far apart, strongly correlated."""
    sigma = np.array([0.01, 0.002])
    for name, ratio, correlation in (
        ("equal", 1.0, 0.0),
        ("alike", 2.0, 0.3),
        ("the new one far better", 1e-4, -0.5),
        ("the old one far better", 1e4, 0.5),
        ("strongly correlated", 1.0, 0.99),
        ("strongly anticorrelated", 3.0, -0.99),
    ):
        old = np.outer(sigma, sigma) * np.array([[1, correlation], [correlation, 1]])
        if name == "equal":
            yield name, old, old.copy()
            continue
        half = sigma[:, None] * random.standard_normal((2, 2))
        yield name, old, ratio * (half @ half.T + 0.1 * np.diag(sigma**2))
