"""Data: what becomes an array, of which type, and stacks that are filled up."""

import jax.numpy as jnp
import numpy as np

from linemap_jax import Pose
from linemap_jax.core.state import pad_stack


def test_lists_of_a_pose_become_arrays_and_types_are_kept() -> None:
    pose = Pose(mean=[1, 2, 0], cov=[[1, 0, 0], [0, 1, 0], [0, 0, 1]])
    assert (pose.mean.dtype, pose.cov.shape) == (jnp.float64, (3, 3))
    single = jnp.zeros(3, jnp.float32)
    assert Pose(mean=single, cov=jnp.eye(3)).mean is single


def test_a_stack_is_filled_up_by_its_last_item() -> None:
    stacked = {"a": jnp.arange(3), "b": jnp.arange(6.0).reshape(3, 2)}
    filled = pad_stack(stacked, 5)
    np.testing.assert_array_equal(filled["a"], [0, 1, 2, 2, 2])
    np.testing.assert_array_equal(filled["b"][2:], [[4.0, 5.0]] * 3)
    assert pad_stack(stacked, 3)["a"] is stacked["a"]
