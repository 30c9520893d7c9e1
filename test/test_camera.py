"""The camera model against OpenCV and finite differences, and its row times."""

import cv2
import numpy as np
import pytest

from rs_relpose_ros.compiled import kernel
from rs_relpose_ros.errors import InputError
from rs_relpose_ros.geometry.camera import RollingShutterCamera
from rs_relpose_ros.geometry.distortion.models import DISTORTION_MODELS, DistortionModel

# EuRoC's factory calibration, a wide rational model, a fisheye lens.
MODELS = [
    ('plumb_bob', ()),
    ('plumb_bob', (-0.28340811, 0.07395907, 0.00019359, 1.76187114e-05)),
    ('plumb_bob', (-0.3, 0.12, 1e-3, -5e-4, -0.02)),
    ('rational_polynomial', (0.5, 0.1, 1e-4, -1e-4, 0.01, 0.6, 0.2, 0.02)),
    ('rational_polynomial',
     (0.5, 0.1, 1e-4, -1e-4, 0.01, 0.6, 0.2, 0.02, 1e-3, -2e-4, 5e-4, 1e-4)),
    ('equidistant', (-0.01, 0.005, -0.001, 0.0001)),
]


def make_camera(model='plumb_bob', distortion=(), **changes):
    values = {'width': 752, 'height': 480, 'fx': 458.654, 'fy': 457.296, 'cx': 367.215,
              'cy': 248.375, 'readout_time': 0.024, **changes}
    return RollingShutterCamera(distortion_model=model, distortion=distortion, **values)


@pytest.fixture
def pixels():
    return np.random.default_rng(0).uniform([0, 0], [751, 479], (200, 2))


@pytest.mark.parametrize(('model', 'distortion'), MODELS)
def test_opencv_projects_the_ray_back_to_its_pixel(model, distortion, pixels):
    camera = make_camera(model, distortion)
    rays = camera.unproject(pixels)
    np.testing.assert_allclose(np.linalg.norm(rays, axis=1), 1.0, atol=1e-12)
    project = cv2.fisheye.projectPoints if model == 'equidistant' else cv2.projectPoints
    back, _ = project((7.0 * rays)[:, None, :], np.zeros(3), np.zeros(3), camera.camera_matrix,
                      np.array(distortion or (0.0,) * 4))
    np.testing.assert_allclose(back.reshape(-1, 2), pixels, atol=1e-8)
    np.testing.assert_allclose(camera.project(7.0 * rays), pixels, atol=1e-8)


@pytest.mark.parametrize(('model', 'distortion'), MODELS)
def test_ray_derivative_equals_finite_differences(model, distortion, pixels):
    camera = make_camera(model, distortion)
    _, jacobian = camera.unproject_with_jacobian(pixels)
    for k in range(2):
        step = np.zeros(2)
        step[k] = 1e-4
        numeric = (camera.unproject(pixels + step) - camera.unproject(pixels - step)) / 2e-4
        np.testing.assert_allclose(jacobian[:, :, k], numeric, atol=1e-9)


@kernel
def distort_by_division(x, y, k, out):
    """A model that the package does not have: x' = x / (1 + k r^2)."""
    scale = 1.0 / (1.0 + k[0] * (x * x + y * y))
    slope = -2.0 * k[0] * scale * scale
    out[0], out[1] = scale * x, scale * y
    out[2], out[3] = scale + slope * x * x, slope * x * y
    out[4], out[5] = slope * x * y, scale + slope * y * y


@kernel
def start_at_the_point(u, v, out):
    out[0], out[1] = u, v


def test_a_model_of_the_registry_is_a_model_of_the_camera(pixels, monkeypatch):
    monkeypatch.setitem(DISTORTION_MODELS, 'division', DistortionModel(
        'division', (1,), 1, distort_by_division, start_at_the_point))
    camera = make_camera('division', (0.3,))
    rays = camera.unproject(pixels)
    undistorted = rays[:, :2] / rays[:, 2:]
    distorted = undistorted / (1.0 + 0.3 * (undistorted**2).sum(axis=1, keepdims=True))
    np.testing.assert_allclose(
        distorted * (camera.fx, camera.fy) + (camera.cx, camera.cy), pixels, atol=1e-8)
    np.testing.assert_allclose(camera.project(3.0 * rays), pixels, atol=1e-8)
    assert make_camera('division', (0.0,)).is_undistorted


def test_a_pixel_outside_the_invertible_region_is_nan_not_a_mirror_image():
    camera = make_camera('plumb_bob', (0.21253, -0.46023, 0.0, 0.0), fx=300.0, fy=300.0)
    rays = camera.unproject([[376.0, 240.0], [0.0, 0.0]])
    assert np.isfinite(rays[0]).all()
    assert np.isnan(rays[1]).all()


def test_points_behind_the_camera_do_not_project():
    assert np.isnan(make_camera().project([[0.1, 0.2, -1.0]])).all()


@pytest.mark.parametrize(('reference', 'direction', 'first', 'last'), [
    ('first', 'down', 0.0, 0.024 * 479 / 480),
    ('last', 'down', -0.024 * 479 / 480, 0.0),
    ('middle', 'down', -0.012 * 479 / 480, 0.012 * 479 / 480),
    ('first', 'up', 0.0, -0.024 * 479 / 480),
    ('last', 'up', 0.024 * 479 / 480, 0.0),
])
def test_row_times(reference, direction, first, last):
    camera = make_camera(reference_row=reference, readout_direction=direction)
    np.testing.assert_allclose(camera.row_times([0.0, 479.0]), [first, last], atol=1e-15)
    assert camera.row_time_span == (pytest.approx(min(first, last)),
                                    pytest.approx(max(first, last)))


@pytest.mark.parametrize(('changes', 'name'), [
    ({'width': 0}, 'width'), ({'height': 480.5}, 'height'), ({'fx': 0.0}, 'fx'),
    ({'cy': float('nan')}, 'cy'), ({'readout_time': -0.01}, 'readout_time'),
    ({'readout_time': float('nan')}, 'readout_time'), ({'reference_row': 'top'}, 'reference_row'),
    ({'readout_direction': 'left'}, 'readout_direction'),
    ({'model': 'brown'}, 'distortion_model'), ({'distortion': (0.1, 0.2, 0.3)}, 'distortion'),
    ({'distortion': (0.1, float('inf'), 0.0, 0.0)}, 'distortion'),
])
def test_illegal_values_are_refused_by_name(changes, name):
    with pytest.raises(InputError, match=f'^{name} '):
        make_camera(**changes)


def test_the_readout_time_has_no_default():
    with pytest.raises(TypeError, match='readout_time'):
        RollingShutterCamera(width=1, height=1, fx=1.0, fy=1.0, cx=0.0, cy=0.0)
