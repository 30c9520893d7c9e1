"""Gravity: its sign, its tracking through rotation, and its honesty on a real recording."""

import numpy as np
import pytest
from scipy.spatial.transform import Rotation
import yaml

from rs_relpose_ros.imu.buffer import ImuBuffer
from rs_relpose_ros.imu.config import ImuConfig
from rs_relpose_ros.imu.samples import ImuSample

PERIOD = 5_000_000


def run(config, orientation, acceleration, seconds, rng, noise=0.02):
    """Feed a moving IMU; orientation(t) is world from IMU, world z up. Last stamp and buffer."""
    buffer = ImuBuffer(config)
    for k in range(int(seconds * 200)):
        t = k * 0.005
        now, later = orientation(t), orientation(t + 1e-4)
        rate = Rotation.from_matrix(now.T @ later).as_rotvec() / 1e-4
        force = now.T @ (acceleration(t) + np.array([0.0, 0.0, 9.80665]))
        force += rng.normal(size=3) * noise
        buffer.add(ImuSample(k * PERIOD, tuple(rate), tuple(force)))
    return buffer, (int(seconds * 200) - 1) * PERIOD


def angle(a, b):
    return np.degrees(np.arctan2(np.linalg.norm(np.cross(a, b)), a @ b))


def swinging(t):
    return Rotation.from_euler('zyx', [0.8 * np.sin(2.0 * t), 0.5 * np.cos(1.3 * t), 0.7 * t]
                               ).as_matrix()


@pytest.mark.parametrize('mode', ['complementary', 'mean'])
def test_gravity_points_down_when_the_specific_force_points_up(mode):
    buffer, end = run(ImuConfig(gravity_filter=mode), lambda t: np.eye(3), lambda t: np.zeros(3),
                      2.0, np.random.default_rng(0))
    assert angle(buffer.gravity(end).direction, np.array([0.0, 0.0, -1.0])) < 0.2


def test_gravity_follows_a_turning_imu():
    buffer, end = run(ImuConfig(), swinging, lambda t: np.zeros(3), 8.0, np.random.default_rng(1))
    estimate = buffer.gravity(end)
    assert angle(estimate.direction, -swinging(end * 1e-9)[2]) < 0.3


def test_hand_held_acceleration_hurts_the_mean_and_not_the_filter():
    def shaking(t):
        return np.array([1.5 * np.sin(7.0 * t), 1.2 * np.cos(9.0 * t), 0.8 * np.sin(11.0 * t)])
    errors = {}
    for mode in ('complementary', 'mean'):
        found = []
        for seed in range(6):
            buffer, end = run(ImuConfig(gravity_filter=mode), swinging, shaking, 6.0 + 0.13 * seed,
                              np.random.default_rng(seed))
            estimate = buffer.gravity(end)
            error = angle(estimate.direction, -swinging(end * 1e-9)[2])
            assert error < 4.0 * np.degrees(estimate.sigma)
            found.append(error)
        errors[mode] = np.median(found)
    assert errors['complementary'] < 1.0
    assert errors['mean'] > 3.0 * errors['complementary']


def test_sigma_shrinks_at_rest_and_grows_when_shaken():
    still, end = run(ImuConfig(), lambda t: np.eye(3), lambda t: np.zeros(3), 0.2,
                     np.random.default_rng(2))
    early = still.gravity(end).sigma
    still, end = run(ImuConfig(), lambda t: np.eye(3), lambda t: np.zeros(3), 20.0,
                     np.random.default_rng(2))
    late = still.gravity(end).sigma
    thrown, end = run(ImuConfig(), lambda t: np.eye(3), lambda t: np.array([0.0, 0.0, 8.0]), 20.0,
                      np.random.default_rng(2))
    assert late < 0.5 * early
    assert thrown.gravity(end).sigma > 1.5 * late


def test_without_accelerometer_there_is_no_gravity():
    for mode in ('complementary', 'mean'):
        buffer = ImuBuffer(ImuConfig(gravity_filter=mode))
        for k in range(10):
            buffer.add(ImuSample(k * PERIOD, (0.0, 0.0, 0.1), None))
        assert buffer.gravity(9 * PERIOD) is None


@pytest.mark.recordings
def test_gravity_on_a_real_hand_held_imu(recordings):
    """EuRoC calibration recording: truth is the mean specific force in the target's frame."""
    folder = recordings / 'euroc_imu_april_corners'
    imu = np.loadtxt(folder / 'imu0.csv', delimiter=',', usecols=range(1, 7))
    imu_stamps = np.loadtxt(folder / 'imu0.csv', delimiter=',', usecols=0, dtype=np.int64)
    poses = np.loadtxt(folder / 'gt_pnp_cam0.csv', delimiter=',', skiprows=1, usecols=range(3, 7))
    stamps = np.loadtxt(folder / 'gt_pnp_cam0.csv', delimiter=',', skiprows=1, usecols=0,
                        dtype=np.int64)
    R_cam_target = Rotation.from_quat(poses[:, [1, 2, 3, 0]]).as_matrix()
    sensor = (recordings / 'euroc_v101_10frames' / 'cam0_sensor.yaml').read_text()
    extrinsics = yaml.safe_load(sensor.split('\n', 1)[1])   # the first line is OpenCV's %YAML
    R_imu_cam = np.array(extrinsics['T_BS']['data']).reshape(4, 4)[:3, :3]

    # Truth: specific force, rotated into the target frame, averages to "up" over the recording.
    inside = (imu_stamps > stamps[0]) & (imu_stamps < stamps[-1])
    nearest = np.searchsorted(stamps, imu_stamps[inside])
    in_target = np.einsum('nji,nj->ni', R_cam_target[nearest], imu[inside, 3:6] @ R_imu_cam)
    up = in_target.mean(axis=0)
    up /= np.linalg.norm(up)

    buffer = ImuBuffer(ImuConfig(gyro_bias=(-0.0016, 0.0250, 0.0777)))
    k, errors, sigmas = 0, [], []
    for stamp_ns, rotation in zip(stamps, R_cam_target, strict=True):
        while k < len(imu) and imu_stamps[k] <= stamp_ns + 10_000_000:
            buffer.add(ImuSample(int(imu_stamps[k]), tuple(imu[k, :3]), tuple(imu[k, 3:])))
            k += 1
        if stamp_ns - stamps[0] < 10_000_000_000 or stamp_ns > imu_stamps[-1]:
            continue
        estimate = buffer.gravity(int(stamp_ns))
        errors.append(angle(R_imu_cam.T @ estimate.direction, -rotation @ up))
        sigmas.append(np.degrees(estimate.sigma))
    assert np.median(errors) <= 1.0
    # Two axes: 95 % of a Rayleigh distribution lie within 2.45 sigma.
    assert np.mean(np.array(errors) < 2.45 * np.array(sigmas)) >= 0.85
