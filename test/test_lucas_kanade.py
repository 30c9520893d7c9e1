"""Lucas-Kanade on patches against OpenCV's on whole images; patches against OpenCV's warp."""

import cv2
import numpy as np
import pytest
from tracking_images import WarpedScene

from rs_relpose_ros.tracking import lucas_kanade
from rs_relpose_ros.tracking.alignment import window_jacobians
from rs_relpose_ros.tracking.lucas_kanade import follow, whole_images
from rs_relpose_ros.tracking.patches import cut, cut_warped

CRITERIA = (cv2.TERM_CRITERIA_COUNT | cv2.TERM_CRITERIA_EPS, 15, 0.02)
# How points move [px].
SHIFT = np.array([1.7, -1.1])


@pytest.fixture(scope='module')
def images():
    scene = WarpedScene()
    return scene.view(np.eye(3)), scene.view(scene.similarity(0.0, 1.0, tuple(-SHIFT)))


@pytest.fixture(scope='module')
def points():
    return np.random.default_rng(0).uniform([30.0, 30.0], [609.0, 449.0], (60, 2))


def window_at(image, centres, radius):
    """Windows (N, 2 radius + 1, 2 radius + 1) around pixels (N, 2)."""
    return np.array([image[y - radius:y + radius + 1, x - radius:x + radius + 1].astype(int)
                     for x, y in centres])


# With a level more a point may be twice as far from its guess.
@pytest.mark.parametrize(('levels', 'off'), [(1, 1.5), (2, 5.0)])
def test_patches_and_whole_images_agree(images, points, levels, off, monkeypatch):
    guess = points + SHIFT + off * np.random.default_rng(1).uniform(-1.0, 1.0, points.shape)
    whole = whole_images(*images, points, guess, 15, levels, CRITERIA)
    called = []
    monkeypatch.setattr(lucas_kanade, 'cut', lambda *a: called.append(1) or cut(*a))
    on_patches = follow(*images, points, guess, 15, levels, CRITERIA)
    assert len(called) == 2 * levels
    right = np.linalg.norm(whole.points - points - SHIFT, axis=1) < 0.3
    assert np.mean(right) > 0.85
    assert np.mean(on_patches.found[right]) > 0.97
    both = right & on_patches.found
    np.testing.assert_allclose(on_patches.points[both], whole.points[both], atol=0.03)
    np.testing.assert_allclose(on_patches.strength[both], whole.strength[both], rtol=1e-3)


def test_what_lies_beyond_a_patch_is_lost(images, points):
    far = follow(*images, points, points + SHIFT + 9.0, 15, 1, CRITERIA)
    moved = np.linalg.norm(far.points - points - SHIFT - 9.0, axis=1)
    assert (moved[far.found] < 6.0).all()
    assert np.mean(far.found) < 0.9


def test_many_points_are_followed_in_the_image_itself(images, monkeypatch):
    """Patches of all of them would be larger than the image."""
    monkeypatch.setattr(lucas_kanade, 'cut', None)
    points = np.random.default_rng(2).uniform([30.0, 30.0], [609.0, 449.0], (400, 2))
    flow = follow(*images, points, points + SHIFT, 15, 1, CRITERIA)
    assert np.mean(np.linalg.norm(flow.points - points - SHIFT, axis=1) < 0.3) > 0.95


def test_no_point_and_points_outside(images):
    assert len(follow(*images, np.empty((0, 2)), np.empty((0, 2)), 15, 1, CRITERIA).points) == 0
    outside = np.array([[-40.0, 100.0], [1e9, 1e9], [630.0, 5000.0]])
    assert not follow(*images, np.full((3, 2), 200.0), outside, 15, 2, CRITERIA).found.any()


def test_patches_repeat_the_border_as_opencv_does(images):
    image, radius = images[0], 9
    points = np.array([[0.0, 0.0], [639.0, 479.0], [3.4, 250.6], [320.0, 240.0], [-30.0, 700.0]])
    padded = cv2.copyMakeBorder(image, 300, 300, 300, 300, cv2.BORDER_REPLICATE)
    patches = cut(image, points, radius)
    centres = np.rint(points).astype(int)
    np.testing.assert_array_equal(
        window_at(patches.image, centres + patches.shifts.astype(int), radius),
        window_at(padded, centres + 300, radius))


def test_warped_patches_are_those_of_the_warped_image(images, points):
    H = np.array([[1.02, 0.05, -3.0], [-0.04, 0.98, 6.0], [2e-5, -1e-5, 1.0]])
    image, radius = images[0], 11
    height, width = image.shape
    warped = cv2.warpPerspective(image, H, (width, height),
                                 flags=cv2.INTER_LINEAR | cv2.WARP_INVERSE_MAP,
                                 borderMode=cv2.BORDER_REPLICATE)
    origins = cv2.perspectiveTransform(points[:, None], H)[:, 0]
    jacobians = window_jacobians(points, origins)
    step = 1e-4
    for axis in range(2):
        moved = points + step * np.eye(2)[axis]
        np.testing.assert_allclose(
            jacobians[:, :, axis],
            (cv2.perspectiveTransform(moved[:, None], H)[:, 0] - origins) / step, atol=1e-5)
    patches = cut_warped(image, origins, jacobians, radius, points)
    expected = cut(warped, points, radius)
    np.testing.assert_array_equal(patches.shifts, expected.shifts)
    centres = np.rint(points + patches.shifts).astype(int)
    difference = window_at(patches.image, centres, radius) - window_at(
        expected.image, centres, radius)
    assert np.percentile(np.abs(difference), 99) <= 3 and np.median(np.abs(difference)) <= 1
