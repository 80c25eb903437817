"""The compiled algebra of small matrices against numpy's."""

import numpy as np
import pytest
from msckf_helpers import random_covariance

from vioframe.geometry.kernels import inverse_cholesky, set_matrix, set_vector, whiten


@pytest.mark.parametrize(("n", "m"), [(1, 1), (3, 1), (17, 4)])
def test_what_is_whitened_has_the_factor_taken_off(n, m):
    rng = np.random.default_rng(n)
    A, B = random_covariance(rng, n), rng.normal(size=(n, m))
    expected = np.linalg.solve(np.linalg.cholesky(A), B)
    whiten(A.copy(), B)
    np.testing.assert_allclose(B, expected, rtol=1e-9)


def test_the_inverse_of_a_factor():
    A = random_covariance(np.random.default_rng(0), 3)
    np.testing.assert_allclose(inverse_cholesky(A), np.linalg.inv(np.linalg.cholesky(A)), rtol=1e-9)


@pytest.mark.parametrize("last", [0.0, -1.0])
def test_of_what_is_not_positive_nothing_finite_is_made(last):
    A = np.diag([1.0, 2.0, last])
    B = np.ones((3, 1))
    whiten(A.copy(), B)
    assert not np.isfinite(B[2, 0])
    assert not np.isfinite(inverse_cholesky(A)[2, 2])


def test_parts_of_arrays_are_set():
    out = np.zeros((4, 5))
    set_matrix(out[1:3, ::2], np.arange(6.0).reshape(2, 3))
    set_vector(out[:, 1], np.arange(4.0))
    np.testing.assert_array_equal(out, [[0, 0, 0, 0, 0], [0, 1, 1, 0, 2], [3, 2, 4, 0, 5], [0, 3, 0, 0, 0]])
