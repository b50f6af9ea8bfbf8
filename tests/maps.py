"""Maps made up by hand, for the tests of what is read, written and drawn."""

from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from linemap_jax.core.state import Circles, LineMap, Lines


def random_cov(rng: np.random.Generator, count: int, sigma: list[float]) -> np.ndarray:
    root = rng.normal(size=(count, len(sigma), len(sigma))) * np.array(sigma)[:, None]
    return root @ np.swapaxes(root, -1, -2) + np.diag(np.square(sigma) / 10)


def random_map(dtype: str, lines: int = 5, circles: int = 4, free: int = 2) -> LineMap:
    """A map with free slots in between and, in each, values that must not reach a file."""
    rng = np.random.default_rng(1)
    k, c = lines + free, circles + free
    slot_l, slot_c = rng.permutation(k) < lines, rng.permutation(c) < circles
    fitted = (np.arange(c) % 2 == 0) & slot_c

    def number(x: np.ndarray) -> jax.Array:
        return jnp.asarray(x, dtype)

    cov_l, cov_c = random_cov(rng, k, [0.02, 0.005]), random_cov(rng, c, [0.01, 0.01, 0.004])
    cov_l[~slot_l] = np.nan
    return LineMap(
        lines=Lines(
            anchor=number(rng.uniform(-50, 50, (k, 2))),
            offset=number(rng.normal(size=k) * 1e-6),
            angle=number(rng.uniform(-np.pi, np.pi, k)),
            cov_independent=number(cov_l),
            sqrt_persistent=number(rng.normal(size=(k, 2, 3)) * [[0.02], [0.005]]),
            first_angle=number(rng.uniform(-np.pi, np.pi, k)),
            extent=number(np.sort(rng.uniform(-4, 4, (k, 2)))),
            var_extent=number(rng.uniform(0, 1e-3, (k, 2))),
            times_detected=jnp.asarray(rng.integers(1, 40, k), jnp.int32),
            times_contradicted=jnp.asarray(rng.integers(0, 9, k), jnp.int32),
            valid=jnp.asarray(slot_l),
        ),
        circles=Circles(
            center=number(rng.uniform(-50, 50, (c, 2))),
            radius=number(rng.uniform(0.02, 0.2, c)),
            cov_independent=number(cov_c * fitted[:, None, None]),
            sqrt_persistent=number(rng.normal(size=(c, 3, 3)) * [[0.02], [0.02], [0.0]] * fitted[:, None, None]),
            fitted=jnp.asarray(fitted),
            times_detected=jnp.asarray(rng.integers(1, 40, c), jnp.int32),
            times_contradicted=jnp.asarray(rng.integers(0, 9, c), jnp.int32),
            valid=jnp.asarray(slot_c),
        ),
    )


def lines_between(
    ends: Any, *, sigma: tuple[float, float] = (0.01, 0.003), times: int = 10, room: int = 8, dtype: str = "float64"
) -> Lines:
    """Lines from begin to end, each `[2, 2]`, whose anchors are their middles; the slots behind them are free."""
    ends = np.asarray(ends, float).reshape(-1, 2, 2)
    count = len(ends)
    step = ends[:, 1] - ends[:, 0]
    half = np.hypot(*step.T) / 2
    tangent = step / (2 * half[:, None])

    def padded(x: np.ndarray, fill: Any = 0.0) -> jax.Array:
        full = np.full((room, *x.shape[1:]), fill, x.dtype)
        full[:count] = x
        return jnp.asarray(full, dtype if x.dtype.kind == "f" else None)

    cov = np.tile(np.diag(np.square(sigma)), (room, 1, 1))
    return Lines(
        anchor=padded(ends.mean(1)),
        offset=padded(np.zeros(count)),
        angle=padded(np.arctan2(-tangent[:, 0], tangent[:, 1])),
        cov_independent=jnp.asarray(cov, dtype),
        sqrt_persistent=jnp.zeros((room, 2, 3), dtype),
        first_angle=padded(np.arctan2(-tangent[:, 0], tangent[:, 1])),
        extent=padded(np.stack([-half, half], -1)),
        var_extent=jnp.full((room, 2), 1e-4, dtype),
        times_detected=padded(np.full(count, times, np.int32), 0),
        times_contradicted=jnp.zeros(room, jnp.int32),
        valid=padded(np.ones(count, bool), False),
    )


def poles_at(
    places: Any, *, sigma: float = 0.01, times: int = 10, fitted: bool = True, room: int = 4, dtype: str = "float64"
) -> Circles:
    """Poles at (x, y, radius) each; the slots behind them are free."""
    places = np.asarray(places, float).reshape(-1, 3)
    full = np.zeros((room, 3))
    full[: len(places)] = places
    valid = np.arange(room) < len(places)
    return Circles(
        center=jnp.asarray(full[:, :2], dtype),
        radius=jnp.asarray(full[:, 2], dtype),
        cov_independent=jnp.asarray(np.tile(np.eye(3) * sigma**2 * fitted, (room, 1, 1)), dtype),
        sqrt_persistent=jnp.zeros((room, 3, 3), dtype),
        fitted=jnp.asarray(valid & fitted),
        times_detected=jnp.asarray(np.where(valid, times, 0), jnp.int32),
        times_contradicted=jnp.zeros(room, jnp.int32),
        valid=jnp.asarray(valid),
    )
