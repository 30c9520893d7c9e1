"""What the images alone say of a pair: whatever the IMU said of it."""

from __future__ import annotations

import numpy as np
from scipy.spatial.transform import Rotation
from test_estimate import estimate, make_camera, TOLD
from two_view_scene import make_scene

SIGMA = 3e-4   # [rad] of the gyro's rotation, as told


def with_gyro(scene, error):
    rotation = Rotation.from_rotvec(error).as_matrix() @ scene.R
    return estimate(scene, TOLD, relative_rotation=rotation,
                    relative_rotation_covariance=SIGMA**2 * np.eye(3))


def by_images(pose):
    """Rotation of the least cost of the images, and its covariance."""
    images = pose.images.of_rotation()
    step = -np.linalg.solve(images.information, images.gradient)
    return (Rotation.from_rotvec(step).as_matrix() @ images.R,
            np.linalg.inv(images.information))


def sigmas(R1, R2, covariance):
    """Distance of two rotations in sigmas."""
    turn = Rotation.from_matrix(R1 @ R2.T).as_rotvec()
    return float(np.sqrt(turn @ np.linalg.solve(covariance, turn)))


def test_the_gyro_between_the_frames_has_no_part_in_it():
    """A gyro that is off by 4 sigmas pulls the pose, and not what the images say."""
    moved, moved_images = [], []
    for seed in range(1, 9):
        scene = make_scene(seed, constant_velocity=True)
        poses = [with_gyro(scene, error)
                 for error in (np.zeros(3), np.array([0.0, 3.0 * SIGMA, 3.0 * SIGMA]))]
        (R1, covariance), (R2, _) = map(by_images, poses)
        moved.append(sigmas(poses[0].images.R, poses[1].images.R, covariance))
        moved_images.append(sigmas(R1, R2, covariance))
    assert np.median(moved) > 0.7
    assert np.median(moved_images) < 0.2


def test_the_images_know_less_than_images_and_gyro():
    pose = with_gyro(make_scene(4, constant_velocity=True), np.zeros(3))
    _, covariance = by_images(pose)
    assert np.trace(covariance) > 1.2 * np.trace(pose.covariance[3:, 3:])
    information = pose.images.information
    assert information.shape == (11, 11)
    np.testing.assert_array_equal(information, information.T)
    assert np.linalg.eigvalsh(information)[0] > -1e-6 * np.linalg.eigvalsh(information)[-1]


def test_a_global_shutter_tells_no_velocities():
    images = estimate(make_scene(5, constant_velocity=True),
                      camera=make_camera(readout_time=0.0)).images
    assert not images.information[5:].any()
    assert not images.gradient[5:].any()


def test_a_rotation_alone_has_no_direction():
    images = with_gyro(make_scene(6, constant_velocity=True), np.zeros(3)).images.of_rotation()
    assert images.information.shape == (3, 3)
    assert np.isnan(images.t).all()
    assert images.of_rotation() is images
