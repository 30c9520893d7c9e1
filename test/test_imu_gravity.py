"""Gravity: its sign, its tracking through rotation, and its honesty on a real recording."""

import numpy as np
import pytest
from scipy.signal import lfilter
from scipy.spatial.transform import Rotation
import yaml

from rs_relpose_ros.config.imu import ImuConfig
from rs_relpose_ros.imu.buffer import ImuBuffer
from rs_relpose_ros.imu.samples import ImuSample

PERIOD = 5_000_000
UP = np.array([0.0, 0.0, 9.80665])


def fed(config, times, orientation, force, bias=(0.0, 0.0, 0.0)):
    """A buffer that got samples at `times` (N,) of a moving IMU.

    orientation(times) is world from IMU (N, 3, 3), world z up; force (N, 3) in the IMU frame.
    """
    rates = Rotation.from_matrix(np.swapaxes(orientation(times), 1, 2) @ orientation(times + 1e-4)
                                 ).as_rotvec() / 1e-4 + bias
    buffer = ImuBuffer(config)
    stamps = np.round(times * 1e9).astype(int)
    for stamp_ns, rate, value in zip(stamps.tolist(), rates.tolist(), force.tolist(), strict=True):
        buffer.add(ImuSample(stamp_ns, tuple(rate), tuple(value)))
    return buffer, int(stamps[-1])


def run(config, orientation, acceleration, seconds, rng, noise=0.02, bias=(0.0, 0.0, 0.0)):
    """The same at 200 Hz with acceleration(times) (N, 3) in the world; the last stamp too."""
    times = 0.005 * np.arange(int(seconds * 200))
    force = np.einsum('nji,nj->ni', orientation(times), acceleration(times) + UP)
    return fed(config, times, orientation, force + noise * rng.normal(size=force.shape), bias)


def angle(a, b):
    return np.degrees(np.arctan2(np.linalg.norm(np.cross(a, b)), a @ b))


def swinging(times):
    times = np.atleast_1d(times)
    return Rotation.from_euler('zyx', np.stack([
        0.8 * np.sin(2.0 * times), 0.5 * np.cos(1.3 * times), 0.7 * times], axis=1)).as_matrix()


def upright(times):
    return np.broadcast_to(np.eye(3), (len(times), 3, 3))


def at_rest(times):
    return np.zeros((len(times), 3))


def down(at_ns):
    """Gravity in the frame of the swinging IMU."""
    return -swinging(at_ns * 1e-9)[0, 2]


@pytest.mark.parametrize('mode', ['complementary', 'mean'])
def test_gravity_points_down_when_the_specific_force_points_up(mode):
    buffer, end = run(ImuConfig(gravity_filter=mode), upright, at_rest,
                      2.0, np.random.default_rng(0))
    assert angle(buffer.gravity(end).direction, np.array([0.0, 0.0, -1.0])) < 0.2


def test_hand_held_acceleration_hurts_the_mean_and_not_the_filter():
    def shaking(t):
        return np.stack([1.5 * np.sin(7.0 * t), 1.2 * np.cos(9.0 * t), 0.8 * np.sin(11.0 * t)],
                        axis=1)
    errors = {}
    for mode in ('complementary', 'mean'):
        found = []
        for seed in range(6):
            buffer, end = run(ImuConfig(gravity_filter=mode), swinging, shaking, 6.0 + 0.13 * seed,
                              np.random.default_rng(seed))
            estimate = buffer.gravity(end)
            error = angle(estimate.direction, down(end))
            assert error < 4.0 * np.degrees(estimate.sigma)
            found.append(error)
        errors[mode] = np.median(found)
    assert errors['complementary'] < 1.0
    assert errors['mean'] > 3.0 * errors['complementary']


def test_sigma_shrinks_at_rest_and_grows_when_shaken():
    still, end = run(ImuConfig(), upright, at_rest, 0.2,
                     np.random.default_rng(2))
    early = still.gravity(end).sigma
    still, end = run(ImuConfig(), upright, at_rest, 20.0,
                     np.random.default_rng(2))
    late = still.gravity(end).sigma
    thrown, end = run(ImuConfig(), upright, lambda t: np.tile([0.0, 0.0, 8.0], (len(t), 1)), 20.0,
                      np.random.default_rng(2))
    assert late < 0.5 * early
    assert thrown.gravity(end).sigma > 1.5 * late


def test_without_accelerometer_there_is_no_gravity():
    for mode in ('complementary', 'mean'):
        buffer = ImuBuffer(ImuConfig(gravity_filter=mode))
        for k in range(10):
            buffer.add(ImuSample(k * PERIOD, (0.0, 0.0, 0.1), None))
        assert buffer.gravity(9 * PERIOD) is None


def test_a_gap_ends_what_the_gyro_knew():
    """The IMU turns by 90 degrees while nothing comes: the direction from before is worthless."""
    buffer, end = run(ImuConfig(), upright, at_rest, 10.0,
                      np.random.default_rng(3))
    settled = buffer.gravity(end).sigma
    turned = Rotation.from_euler('x', 90, degrees=True).as_matrix()
    for k in range(1, 40):
        buffer.add(ImuSample(end + 900_000_000 + k * PERIOD, (0.0, 0.0, 0.0),
                             tuple(turned.T @ [0.0, 0.0, 9.81])))
    after = buffer.gravity(end + 900_000_000 + 39 * PERIOD)
    assert angle(after.direction, -turned[2]) < 0.5
    assert after.sigma > 2.0 * settled
    # Nothing is carried over the gap.
    assert buffer.gravity(end + 450_000_000) is None


def test_the_filter_learns_the_bias_that_nobody_removed():
    errors = {}
    for sigma in (0.0, 0.02):
        buffer, end = run(ImuConfig(gyro_bias_sigma=sigma), swinging, at_rest, 30.0,
                          np.random.default_rng(4), bias=(0.03, -0.02, 0.025))
        estimate = buffer.gravity(end)
        errors[sigma] = angle(estimate.direction, down(end))
    assert errors[0.02] < 0.6
    assert errors[0.0] > 5.0 * errors[0.02]
    assert errors[0.02] < 3.0 * np.degrees(estimate.sigma)


def test_sigma_is_honest_under_acceleration_that_lasts():
    """A car that brakes by 3 m/s^2 for 2 s: the direction is dragged along, and sigma says so."""
    rng = np.random.default_rng(5)

    def braking(t):
        return np.outer(t > 8.0, [3.0, 0.0, 0.0])

    even, end = run(ImuConfig(), upright, at_rest, 10.0, rng)
    dragged, end = run(ImuConfig(), upright, braking, 10.0, rng)
    error = angle(dragged.gravity(end).direction, -UP)
    assert error > 1.0
    assert error < 3.0 * np.degrees(dragged.gravity(end).sigma)
    assert dragged.gravity(end).sigma > 2.0 * even.gravity(end).sigma


def test_sigma_is_honest_under_random_acceleration():
    """Many runs of correlated acceleration: no more than a few errors beyond three sigmas."""
    rng = np.random.default_rng(6)
    normalised = []
    for _ in range(40):
        # First-order Gauss-Markov of 0.2 s and 1 m/s^2: what the filter assumes.
        keep = np.exp(-0.005 / 0.2)
        drive = np.sqrt(1.0 - keep**2) * rng.normal(size=(1600, 3))
        acceleration = lfilter([1.0], [1.0, -keep], drive, axis=0)
        buffer, end = fed(ImuConfig(), 0.005 * np.arange(1600), upright, acceleration + UP,
                          3e-3 * rng.normal(size=3))
        estimate = buffer.gravity(end)
        normalised.append(np.radians(angle(estimate.direction, -UP)) / estimate.sigma)
    normalised = np.array(normalised)
    # Rayleigh: median 1.18 sigma; with the process noise that sets the gain it was 0.90.
    assert np.mean(normalised < 3.0) >= 0.95
    assert 1.0 < np.median(normalised) < 1.8


def test_gravity_is_causal():
    """What comes later does not change the answer."""
    forces = np.random.default_rng(9).normal(size=(400, 3)) + UP
    items = [ImuSample(k * PERIOD, (0.1, 0.2, -0.3), tuple(f)) for k, f in enumerate(forces)]
    for mode in ('complementary', 'mean'):
        answers = []
        for last in (301, 400):
            buffer = ImuBuffer(ImuConfig(gravity_filter=mode))
            for item in items[:last]:
                buffer.add(item)
            answers.append(buffer.gravity(299 * PERIOD + 2_000_000))
        assert np.array_equal(answers[0].direction, answers[1].direction)
        assert answers[0].sigma == answers[1].sigma


def test_gravity_between_samples_and_before_the_last_question_is_turned_by_the_gyro():
    buffer, end = run(ImuConfig(), swinging, at_rest, 4.0, np.random.default_rng(7))
    for at_ns in (end, end - 3_000_000, end - 500_000_000):
        error = angle(buffer.gravity(at_ns).direction, down(at_ns))
        assert error < 0.3
    assert buffer.gravity(end + 1) is None


def test_fast_gyro_and_slow_accelerometer_in_separate_messages():
    buffer = ImuBuffer(ImuConfig())
    events = [(k * 2_500_000, True) for k in range(2400)]
    events += [(k * 15_873_016 + 1_111_111, False) for k in range(370)]
    for stamp_ns, gyro in sorted(events):
        now, later = swinging(stamp_ns * 1e-9)[0], swinging(stamp_ns * 1e-9 + 1e-4)[0]
        rate = tuple(Rotation.from_matrix(now.T @ later).as_rotvec() / 1e-4)
        force = tuple(now.T @ UP)
        buffer.add(ImuSample(stamp_ns, rate, None) if gyro else ImuSample(stamp_ns, None, force))
    at_ns = 2300 * 2_500_000
    assert angle(buffer.gravity(at_ns).direction, down(at_ns)) < 1.0


def test_pruning_does_not_change_gravity():
    rng = np.random.default_rng(8)
    items = [ImuSample(k * PERIOD, tuple(rng.normal(size=3)),
                       tuple(rng.normal(size=3) + UP)) for k in range(1500)]
    kept, pruned = ImuBuffer(ImuConfig(imu_buffer_seconds=60.0)), ImuBuffer(ImuConfig())
    for k, item in enumerate(items):
        kept.add(item)
        pruned.add(item)
        if k % 300 == 299:
            pruned.prune(item.stamp_ns - 100_000_000)
    at_ns = items[-1].stamp_ns
    assert np.array_equal(kept.gravity(at_ns).direction, pruned.gravity(at_ns).direction)


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
    print(f'\ngravity: median {np.median(errors):.2f} deg, 90 % {np.percentile(errors, 90):.2f} '
          f'deg, sigma {np.median(sigmas):.2f} deg in the median')
    assert np.median(errors) <= 1.0
    # Two axes: 95 % of a Rayleigh distribution lie within 2.45 sigma. And no sigma for show.
    assert np.mean(np.array(errors) < 2.45 * np.array(sigmas)) >= 0.95
    assert np.median(sigmas) < 2.5
    # The process noise that shortens the filter's memory is no error: with it this is 0.18.
    assert np.mean(np.square(errors) / np.square(sigmas)) / 2.0 > 0.3
