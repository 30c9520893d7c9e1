"""Derotated rays are kept for the tracks that go on; their median parallax against NumPy."""

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from rs_relpose_ros import FrameMotion, RollingShutterCamera
from rs_relpose_ros.front_end.derotated_rays import DerotatedRays, median_parallax, Sensor
from rs_relpose_ros.geometry.intrinsics import Intrinsics

INTRINSICS = Intrinsics(width=640, height=480, fx=450.0, fy=450.0, cx=320.0, cy=240.0,
                        distortion_model='plumb_bob', distortion=(-0.2, 0.05, 0.0, 0.0),
                        image_width=640, image_height=480)
CAMERA = RollingShutterCamera(width=640, height=480, fx=450.0, fy=450.0, cx=320.0, cy=240.0,
                              distortion=(-0.2, 0.05, 0.0, 0.0), readout_time=0.03)
SENSOR = Sensor(CAMERA, INTRINSICS)
MOTION = FrameMotion([0.4, -0.8, 0.3])


def rays_of(ids):
    """Of a set of points that depend on their ids alone."""
    ids = np.asarray(ids, dtype=np.uint32)
    points = np.random.default_rng(0).uniform([20.0, 20.0], [620.0, 460.0], (5000, 2))[ids % 5000]
    return DerotatedRays.from_points(ids, points, SENSOR, MOTION)


# Ids wrap around: what is newer may be smaller.
@pytest.mark.parametrize('ids', [range(40), [2**32 - 2, 2**32 - 1, 0, 1, 2, 3, 700, 30]])
def test_those_that_go_on_are_the_same_as_computed_anew(ids):
    every = rays_of(list(ids))
    some = every.track_ids[[0, 2, 3, 6]]
    kept, anew = every.of(some), rays_of(some)
    for name in ('track_ids', 'points', 'rays', 'row_times'):
        np.testing.assert_array_equal(getattr(kept, name), getattr(anew, name))


def test_all_are_the_same_and_none_is_legal():
    every = rays_of(range(9))
    assert every.of(every.track_ids) is every
    assert len(every.of(every.track_ids[:0]).rays) == 0


@pytest.mark.parametrize('wanted', [[3, 99], [99], [5, 3]])
def test_a_track_that_is_missing_or_out_of_order_is_no_subset(wanted):
    assert rays_of(range(9)).of(np.array(wanted, dtype=np.uint32)) is None


def test_a_derotated_ray_is_seen_where_it_came_from():
    points = np.random.default_rng(1).uniform([60.0, 60.0], [580.0, 420.0], (50, 2))
    rays, row_times = SENSOR.derotated(points, MOTION)
    # A first guess of the row times that is off by 1 ms moves a point by 0.42 px, at 424 px/s;
    # each improvement leaves the share 424 px/s * 62.5 us per row of that.
    seen = SENSOR.seen(rays, row_times + 1e-3, MOTION)
    np.testing.assert_allclose(seen, points, atol=1.2 * 0.42 * 424 * 62.5e-6)


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
