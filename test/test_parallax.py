"""The median parallax against NumPy."""

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from rs_relpose_ros.tracking.parallax import median_parallax


def test_median_parallax_of_rays_some_of_which_are_not_known():
    rng = np.random.default_rng(0)
    rays1, rays2 = rng.normal(size=(2, 41, 3))
    rays1 /= np.linalg.norm(rays1, axis=1, keepdims=True)
    rays2 /= np.linalg.norm(rays2, axis=1, keepdims=True)
    rays1[3] = rays2[7] = np.nan
    rotation = Rotation.from_rotvec([0.1, -0.2, 0.3]).as_matrix()
    every = np.linalg.norm(np.cross(rays1, rays2 @ rotation.T), axis=1)
    assert median_parallax(rays1, rays2, rotation) == pytest.approx(np.nanmedian(every), rel=1e-12)


@pytest.mark.parametrize('rays', [np.zeros((0, 3)), np.full((4, 3), np.nan)])
def test_no_known_ray_has_no_parallax(rays):
    assert median_parallax(rays, rays, np.eye(3)) == 0.0
