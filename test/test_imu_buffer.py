"""IMU buffer and gyro integration: against SciPy, in any order, with gaps."""

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from rs_relpose_ros.config.imu import ImuConfig
from rs_relpose_ros.errors import InputError
from rs_relpose_ros.geometry.motion import FrameMotion
from rs_relpose_ros.imu.buffer import AddResult, Coverage, ImuBuffer
from rs_relpose_ros.imu.frame_imu import frame_imu
from rs_relpose_ros.imu.integration import integrate_rotation
from rs_relpose_ros.imu.samples import ImuSample

PERIOD = 5_000_000
START = 1_650_458_790_000_000_000
UP = (0.0, 0.0, 9.81)


def samples(rate, count=100, force=UP):
    return [ImuSample(START + k * PERIOD, tuple(rate(k * 0.005)), force) for k in range(count)]


def filled(items, **config):
    buffer = ImuBuffer(ImuConfig(**config))
    for item in items:
        buffer.add(item)
    return buffer


def wobble(t):
    return np.array([0.6 * np.sin(3.0 * t), -0.8 * np.cos(2.0 * t), 0.5 + 0.3 * t])


def test_constant_rate_is_the_exponential_of_rate_times_time():
    buffer = filled(samples(lambda t: np.array([0.2, -1.1, 0.7])))
    rotation, _ = buffer.rotation(START + 1_234_567, START + 301_234_567)
    expected = Rotation.from_rotvec(0.3 * np.array([0.2, -1.1, 0.7])).as_matrix()
    np.testing.assert_allclose(rotation, expected, atol=1e-12)


def test_rotation_composes_over_adjoining_intervals():
    buffer = filled(samples(wobble))
    a, b, c = START + 3_000_000, START + 111_111_111, START + 400_000_001
    whole, _ = buffer.rotation(a, c)
    parts = buffer.rotation(a, b)[0] @ buffer.rotation(b, c)[0]
    np.testing.assert_allclose(parts, whole, atol=2e-6)


def test_bias_is_subtracted():
    bias = (0.01, -0.02, 0.03)
    buffer = filled(samples(lambda t: np.array(bias)), gyro_bias=bias)
    np.testing.assert_allclose(buffer.rotation(START, START + 400_000_000)[0], np.eye(3),
                               atol=1e-12)


def test_any_order_of_arrival_gives_the_same_bits():
    items = samples(wobble)
    shuffled = [items[k] for k in np.random.default_rng(0).permutation(len(items))]
    a, b = filled(items), filled(shuffled)
    assert np.array_equal(a.rotation(START, START + 450_000_001)[0],
                          b.rotation(START, START + 450_000_001)[0])


def test_coverage():
    buffer = ImuBuffer(ImuConfig(max_imu_gap=0.02))
    assert buffer.coverage(START, START + 1) is Coverage.NOT_YET
    for item in samples(wobble, 10):
        buffer.add(item)
    end = START + 9 * PERIOD
    assert buffer.coverage(START, end) is Coverage.AVAILABLE
    assert buffer.coverage(START - 1, end) is Coverage.NEVER
    assert buffer.coverage(START, end + 1) is Coverage.NOT_YET
    buffer.add(ImuSample(end + 21_000_000, (0.0, 0.0, 0.0), UP))
    assert buffer.coverage(START, end + 1) is Coverage.NEVER
    assert buffer.coverage(START, end) is Coverage.AVAILABLE
    with pytest.raises(InputError, match='does not cover'):
        buffer.angular_velocity(START, end + 1)


def test_duplicates_and_late_samples_are_told():
    buffer = ImuBuffer(ImuConfig())
    first, second, third = samples(wobble, 3)
    assert buffer.add(first) is AddResult.ADDED
    assert buffer.add(third) is AddResult.ADDED
    assert buffer.add(second) is AddResult.LATE
    assert buffer.add(second) is AddResult.DUPLICATE


@pytest.mark.parametrize('broken', [
    ImuSample(START, (float('nan'), 0.0, 0.0), UP),
    ImuSample(START, (0.0, 0.0, 0.0), (0.0, 0.0, float('inf'))),
])
def test_a_broken_sample_is_refused_and_nothing_of_it_is_kept(broken):
    buffer = ImuBuffer(ImuConfig())
    with pytest.raises(InputError, match='must be finite'):
        buffer.add(broken)
    assert buffer.newest_ns is None


def test_history_is_bounded():
    buffer = filled(samples(wobble, 3000), imu_buffer_seconds=2.0)
    newest = START + 2999 * PERIOD
    assert buffer.coverage(newest - 1_900_000_000, newest) is Coverage.AVAILABLE
    assert buffer.coverage(newest - 2_300_000_000, newest) is Coverage.NEVER


def test_covariance_equals_the_spread_of_noisy_integrations():
    rng = np.random.default_rng(2)
    config = ImuConfig(gyro_noise_density=2e-3, gyro_bias_sigma=5e-3)
    stamps = START + PERIOD * np.arange(81)
    rates = np.array([3.0 * wobble(k * 0.005) for k in range(81)])
    expected, covariance = integrate_rotation(stamps, rates, config)
    errors = []
    for _ in range(3000):
        # White noise of density n sampled at f has n sqrt(f) per sample.
        noise = rng.normal(size=rates.shape) * 2e-3 * np.sqrt(200.0)
        bias = rng.normal(size=3) * 5e-3
        noisy, _ = integrate_rotation(stamps, rates + noise + bias, config)
        errors.append(Rotation.from_matrix(expected @ noisy.T).as_rotvec())
    sigma = np.sqrt(np.diag(covariance))
    np.testing.assert_allclose(np.cov(np.array(errors).T) / np.outer(sigma, sigma),
                               covariance / np.outer(sigma, sigma), atol=0.1)


def test_frame_imu_is_in_the_camera_frame_at_the_stamped_row():
    rate = np.array([0.0, 0.0, 0.8])
    R_cam_imu = Rotation.from_euler('xyz', [90, 0, 30], degrees=True).as_matrix()
    buffer = filled(samples(lambda t: rate, 400))
    reference = START + 1_500_000_123
    answer = frame_imu(buffer, (reference, reference + 30_000_000), reference, R_cam_imu,
                       reference - 66_000_000)
    np.testing.assert_allclose(answer.motion.angular_velocity, R_cam_imu @ rate, atol=1e-12)
    np.testing.assert_allclose(
        answer.motion.rotations([0.03])[0],
        Rotation.from_rotvec(0.03 * (R_cam_imu @ rate)).as_matrix(), atol=1e-12)
    np.testing.assert_allclose(answer.motion.gravity, R_cam_imu @ [0.0, 0.0, -1.0], atol=1e-9)
    assert answer.since_previous.stamps_ns[0] == reference - 66_000_000
    assert answer.since_previous.stamps_ns[-1] == reference


def test_frame_imu_of_a_global_shutter():
    buffer = filled(samples(lambda t: np.array([0.1, 0.2, 0.3])))
    answer = frame_imu(buffer, (START + 7, START + 7), START + 7, np.eye(3))
    np.testing.assert_allclose(answer.motion.angular_velocity, [0.1, 0.2, 0.3], atol=1e-12)
    assert answer.since_previous is None


def test_integration_agrees_with_a_dense_one_by_scipy():
    """Rate linear between samples, integrated in 2000 steps each."""
    rng = np.random.default_rng(3)
    stamps = START + np.cumsum(rng.integers(2_000_000, 8_000_000, 12))
    rates = 3.0 * rng.normal(size=(12, 3)).cumsum(axis=0) / 3.0
    rotation, _ = integrate_rotation(stamps, rates, ImuConfig())
    expected = Rotation.identity()
    for k in range(11):
        dt = (stamps[k + 1] - stamps[k]) * 1e-9
        fractions = (np.arange(2000) + 0.5) / 2000
        steps = (rates[k] + fractions[:, None] * (rates[k + 1] - rates[k])) * dt / 2000
        for step in Rotation.from_rotvec(steps):
            expected = expected * step
    error = (Rotation.from_matrix(rotation).inv() * expected).magnitude()
    turned = sum(np.linalg.norm(rates[k]) * (stamps[k + 1] - stamps[k]) for k in range(11)) * 1e-9
    # Fourth order; without the term w_0 x w_1 it is 4e-4.
    assert error < 1e-6 * turned


def test_borders_are_interpolated_between_the_neighbouring_samples():
    buffer = filled([ImuSample(START + k * PERIOD, (float(k), -2.0 * k, 0.5), UP)
                     for k in range(10)])
    stamps, rates = buffer.angular_velocity(START + 1_250_000, START + 3 * PERIOD + 4_000_000)
    assert stamps.tolist() == [START + 1_250_000, START + PERIOD, START + 2 * PERIOD,
                               START + 3 * PERIOD, START + 3 * PERIOD + 4_000_000]
    np.testing.assert_allclose(rates[:, 0], [0.25, 1.0, 2.0, 3.0, 3.8], atol=1e-12)
    np.testing.assert_allclose(rates[:, 1], -2.0 * rates[:, 0], atol=1e-12)
    # A border on a sample is that sample, once.
    stamps, _ = buffer.angular_velocity(START + PERIOD, START + 2 * PERIOD)
    assert stamps.tolist() == [START + PERIOD, START + 2 * PERIOD]


def test_an_interval_that_ends_before_it_starts_is_refused():
    buffer = filled(samples(wobble))
    with pytest.raises(InputError, match='must not end'):
        buffer.angular_velocity(START + 2 * PERIOD, START + PERIOD)


@pytest.mark.parametrize('stamps, rates, message', [
    ([0, 5, 5], np.zeros((3, 3)), 'increasing'), ([0, 5], np.zeros((3, 3)), 'shape'),
    ([], np.zeros((0, 3)), 'shape'),
])
def test_integration_refuses_what_is_no_series(stamps, rates, message):
    with pytest.raises(InputError, match=message):
        integrate_rotation(np.array(stamps, dtype=np.int64), rates, ImuConfig())


def test_a_single_instant_is_no_rotation():
    rotation, covariance = integrate_rotation(np.array([START]), np.ones((1, 3)), ImuConfig())
    np.testing.assert_array_equal(rotation, np.eye(3))
    np.testing.assert_array_equal(covariance, np.zeros((3, 3)))


def test_clear_forgets_everything():
    buffer = filled(samples(wobble, 400))
    buffer.clear()
    assert buffer.newest_ns is None and buffer.gravity(START + PERIOD) is None
    assert buffer.coverage(START, START + PERIOD) is Coverage.NOT_YET
    assert buffer.add(ImuSample(0, (0.0, 0.0, 0.0), UP)) is AddResult.ADDED


def test_rows_and_frames_are_integrated_alike():
    """`FrameMotion.from_gyro` and `integrate_rotation`: one rule for a rate that changes."""
    rng = np.random.default_rng(0)
    stamps = np.cumsum(rng.integers(2_000_000, 8_000_000, 9))
    rates = 3.0 * rng.normal(size=(9, 3))
    motion = FrameMotion.from_gyro((stamps - stamps[0]) * 1e-9, rates)
    for k in range(1, 9):
        rotation, _ = integrate_rotation(stamps[:k + 1], rates[:k + 1], ImuConfig())
        np.testing.assert_allclose(motion.knot_rotations[k], rotation, atol=1e-12)
