"""Small vectors against NumPy."""

import numpy as np
import pytest

from rs_relpose_ros.geometry import vectors

A, B = np.random.default_rng(0).normal(size=(2, 3))
M = np.random.default_rng(1).normal(size=(3, 3))


@pytest.mark.parametrize('kind', [np.asarray, lambda v: tuple(v.tolist())], ids=['array', 'tuple'])
def test_products_are_those_of_numpy(kind):
    a, b = kind(A), kind(B)
    assert vectors.dot(a, b) == pytest.approx(A @ B, rel=1e-14)
    assert vectors.norm(a) == pytest.approx(np.linalg.norm(A), rel=1e-14)
    np.testing.assert_allclose(vectors.cross(a, b), np.cross(A, B), rtol=1e-13)
    np.testing.assert_allclose(vectors.rotated(M, a), M @ A, rtol=1e-13)
    np.testing.assert_allclose(vectors.rotated_back(M, a), M.T @ A, rtol=1e-13)
