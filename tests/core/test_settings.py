"""What is refused, and with which sentence: options that do not exist, shapes and types that do not go together."""

from collections.abc import Callable, Iterator
from typing import Any

import jax.numpy as jnp
import jaxtyping
import pytest

from linemap_jax import Capacity, Pose, Scan, empty_map, extract, preset, update
from linemap_jax.core.circles import jac_arc_points
from linemap_jax.core.likelihood import jac_step_points
from linemap_jax.core.lines import jac_line_points
from linemap_jax.core.propagation import jacobian
from linemap_jax.core.settings import PAPER_THRESHOLDS, Thresholds, persistence_of

SCAN = Scan.from_ranges(jnp.full(5, 2.0), jnp.arange(5) * 0.1)
POSE = Pose(mean=jnp.zeros(3), cov=jnp.zeros((3, 3)))


@pytest.fixture
def as_users_run_it() -> Iterator[None]:
    """Without the checks of annotations, which are the tests' alone."""
    jaxtyping.config.update("jaxtyping_disable", True)
    yield
    jaxtyping.config.update("jaxtyping_disable", False)


@pytest.mark.parametrize(
    ("call", "sentence"),
    [
        (lambda: jacobian(abs, abs, "numeric"), "jacobians must be 'autodiff' or 'analytic', not 'numeric'"),
        (lambda: jac_line_points(None, None, None, jacobians="numeric"), "jacobians must be .* not 'numeric'"),
        (lambda: jac_arc_points(None, None, jacobians="numeric"), "jacobians must be .* not 'numeric'"),
        (lambda: jac_step_points(None, None, None, None, jacobians="numeric"), "jacobians must be .* not 'numeric'"),
        (lambda: extract(SCAN, POSE, covariance="none"), "covariance must be 'exact' or 'printed', not 'none'"),
        (lambda: extract(SCAN, POSE, segmentation="none"), "must be 'incremental' or 'optimal', not 'none'"),
        (lambda: persistence_of("never", None), "must be 'independent', 'persistent' or 'unknown', not 'never'"),
        (lambda: preset("papers"), "no preset 'papers': choose default or paper"),
        (lambda: update(empty_map(Capacity(2, 2), "float32"), SCAN, POSE), "the map is float32 and the scan float64"),
        (lambda: Scan.from_ranges(jnp.ones(3), jnp.ones(4)), r"ranges \(3,\) and bearings \(4,\) must be"),
    ],
)
def test_what_does_not_exist_or_go_together_is_refused(
    call: Callable[[], Any], sentence: str, as_users_run_it: None
) -> None:
    with pytest.raises(ValueError, match=sentence):
        call()


def test_a_pose_without_its_covariance_is_refused(as_users_run_it: None) -> None:
    no_pose: Any = POSE.mean
    with pytest.raises(TypeError, match="pose must be a Pose, with mean and covariance, not an array alone"):
        extract(SCAN, no_pose)


def test_the_presets_are_those_of_their_names() -> None:
    assert preset("default")["thresholds"] == Thresholds()
    assert preset("paper")["thresholds"] == PAPER_THRESHOLDS
    assert (preset("default")["covariance"], preset("paper")["covariance"]) == ("exact", "printed")
