"""A vertex that two lines share is one in the file."""

import numpy as np
import pytest

from linemap_jax.io.jsonl import ROUNDING, one_vertex


@pytest.mark.parametrize("dtype", [np.float32, np.float64])
def test_a_shared_vertex_is_the_end_of_the_other_line_to_the_last_digit(dtype):
    corner, eps = np.array([8.123456789, -3.3], dtype), np.finfo(dtype).eps
    end = np.array([[corner, [1.0, 2.0]]], dtype)
    near, far = corner * (1 + 4 * eps), corner * (1 + 4 * ROUNDING * eps)
    begin = np.array([[[5.0, 5.0], near]], dtype)
    assert np.any(begin[0, 1] != corner)
    snapped = one_vertex(begin, end)
    assert snapped.dtype == dtype
    np.testing.assert_array_equal(snapped[0], [[5.0, 5.0], corner])
    apart = np.array([[[5.0, 5.0], far]], dtype)
    np.testing.assert_array_equal(one_vertex(apart, end), apart)


def test_vertices_of_other_scans_are_other_vertices():
    begin, end = np.ones((2, 1, 2)), np.zeros((2, 1, 2))
    begin[0], end[1] = 1 + 1e-15, 1 + 2e-15
    snapped = one_vertex(begin, end)
    np.testing.assert_array_equal(snapped[0], begin[0])
    np.testing.assert_array_equal(snapped[1], end[1])
