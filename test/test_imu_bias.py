"""Gyro bias from standstill: found, carried on, and not taken from slow turns."""

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from rs_relpose_ros.config.imu import ImuConfig
from rs_relpose_ros.imu.bias import BIAS_MEMORY, BiasTracker
from rs_relpose_ros.imu.buffer import ImuBuffer
from rs_relpose_ros.imu.frame_imu import frame_imu
from rs_relpose_ros.imu.samples import ImuSample

PERIOD = 5_000_000
START = 1_700_000_000_000_000_000
SECOND = 1_000_000_000
BIAS = np.array([0.004, -0.006, 0.008])
# As a MEMS of this class at 200 Hz (EuRoC's ADIS16448): 0.0024 rad/s and 0.03 m/s^2.
RATE_NOISE, FORCE_NOISE = 0.0024, 0.03


def rest(seconds, rng, rate=(0.0, 0.0, 0.0), force_noise=FORCE_NOISE):
    count = round(200 * seconds)
    rates = BIAS + rate + RATE_NOISE * rng.normal(size=(count, 3))
    return rates, np.array([0.0, 0.0, 9.81]) + force_noise * rng.normal(size=(count, 3))


def hand(seconds, rng):
    """A hand that moves on: 0.3 rad/s and 1 m/s^2."""
    count = round(200 * seconds)
    phase = 0.005 * np.arange(count)[:, None] * [3.0, 4.0, 5.0]
    rates, forces = rest(seconds, rng)
    return rates + 0.3 * np.sin(phase), forces + np.cos(phase)


def joined(*parts):
    rates, forces = (np.concatenate(values) for values in zip(*parts, strict=True))
    return START + PERIOD * np.arange(len(rates)), rates, forces


def tracked(config, stamps, rates, forces):
    tracker = BiasTracker(config)
    tracker.run(stamps, rates, forces)
    return tracker.estimate(int(stamps[-1]))


def test_the_bias_is_found_at_rest_and_its_sigma_is_honest():
    normalised = []
    for seed in range(40):
        rng = np.random.default_rng(seed)
        found = tracked(ImuConfig(), *joined(hand(1.0, rng), rest(4.0, rng), hand(1.0, rng)))
        assert np.abs(found.value - BIAS).max() < 1.5e-3
        assert found.sigma < 1e-3
        normalised.append((found.value - BIAS) / found.sigma)
    # Cautious, as rest may hold what is left of motion; but not by an order of magnitude.
    assert 0.2 < np.sqrt(np.mean(np.square(normalised))) < 1.2


def test_without_rest_the_bias_is_what_was_told():
    config = ImuConfig(gyro_bias=(0.001, 0.002, 0.003), gyro_bias_sigma=0.004)
    found = tracked(config, *joined(hand(10.0, np.random.default_rng(0))))
    np.testing.assert_array_equal(found.value, [0.001, 0.002, 0.003])
    assert found.sigma == 0.004


@pytest.mark.parametrize('what', ['slow turn', 'no accelerometer', 'vibration', 'short', 'off'])
def test_what_may_be_a_motion_is_no_rest(what):
    rng = np.random.default_rng(1)
    config = ImuConfig(track_gyro_bias=what != 'off')
    seconds = 0.9 if what == 'short' else 5.0
    # 2 deg/s is no bias of 3e-3 rad/s.
    rate = (0.0, 0.035, 0.0) if what == 'slow turn' else (0.0, 0.0, 0.0)
    still = rest(seconds, rng, rate, 0.3 if what == 'vibration' else FORCE_NOISE)
    stamps, rates, forces = joined(hand(1.0, rng), still, hand(1.0, rng))
    if what == 'no accelerometer':
        forces[:] = np.nan
    assert tracked(config, stamps, rates, forces).sigma == config.gyro_bias_sigma


def test_the_begin_of_a_motion_is_left_out():
    """A camera that starts to turn slowly: the window that holds the start is not taken."""
    rng = np.random.default_rng(2)
    # From 2.4 s on, the last tenth of a window, at the tenth of a radian per second.
    rates, forces = rest(3.0, rng)
    moving = rates.copy()
    moving[480:] += np.linspace(0.0, 0.1, len(rates) - 480)[:, None]
    found = tracked(ImuConfig(), *joined((moving, forces)))
    still = tracked(ImuConfig(), *joined((rates[:501], forces[:501])))
    np.testing.assert_array_equal(found.value, still.value)
    assert still.sigma < 1e-3


def test_sigma_grows_while_the_bias_is_carried_on():
    rng = np.random.default_rng(3)
    config = ImuConfig()
    tracker = BiasTracker(config)
    stamps, rates, forces = joined(rest(5.0, rng), hand(1.0, rng))
    tracker.run(stamps, rates, forces)
    sigmas = [tracker.estimate(int(stamps[-1]) + s * SECOND).sigma for s in (0, 60, 3600)]
    assert sigmas[0] < sigmas[1] < sigmas[2]
    assert sigmas[1] == pytest.approx(config.gyro_bias_sigma * np.sqrt(60 / BIAS_MEMORY), rel=0.1)
    # Never worse than what was told in the first place.
    assert sigmas[2] == config.gyro_bias_sigma


def test_a_second_rest_follows_a_bias_that_drifted():
    rng = np.random.default_rng(4)
    drift = np.array([0.001, 0.001, -0.001])
    first, moving, second = rest(5.0, rng), hand(120.0, rng), rest(10.0, rng)
    found = tracked(ImuConfig(), *joined(first, moving, (second[0] + drift, second[1]),
                                         hand(1.0, rng)))
    assert np.abs(found.value - BIAS - drift).max() < 1e-3


def test_the_answer_does_not_depend_on_the_portions():
    rng = np.random.default_rng(5)
    stamps, rates, forces = joined(rest(4.0, rng), hand(1.0, rng), rest(3.0, rng))
    whole = tracked(ImuConfig(), stamps, rates, forces)
    tracker = BiasTracker(ImuConfig())
    for part in np.split(np.arange(len(stamps)), np.sort(rng.integers(1, len(stamps), 200))):
        tracker.run(stamps[part], rates[part], forces[part])
    portions = tracker.estimate(int(stamps[-1]))
    assert np.array_equal(whole.value, portions.value) and whole.sigma == portions.sigma


def test_a_gap_is_no_rest():
    rng = np.random.default_rng(6)
    stamps, rates, forces = joined(rest(4.0, rng))
    # A hole of 0.1 s in every half second.
    keep = np.arange(len(stamps)) % 100 < 80
    assert tracked(ImuConfig(), stamps[keep], rates[keep], forces[keep]).sigma == 3e-3


@pytest.mark.parametrize('gravity_filter', ['complementary', 'mean'])
def test_buffer_and_frame_use_it(gravity_filter):
    rng = np.random.default_rng(7)
    stamps, rates, forces = joined(rest(5.0, rng), hand(2.0, rng))
    buffer, told = (ImuBuffer(ImuConfig(gravity_filter=gravity_filter, track_gyro_bias=tracked))
                    for tracked in (True, False))
    for stamp, rate, force in zip(stamps.tolist(), rates.tolist(), forces.tolist(), strict=True):
        for either in (buffer, told):
            either.add(ImuSample(stamp, tuple(rate), tuple(force)))
    R_cam_imu = Rotation.from_euler('xyz', [90, 0, 30], degrees=True).as_matrix()
    at = START + 6 * SECOND
    answer = frame_imu(buffer, (at, at + 30_000_000), at, R_cam_imu, at - 500_000_000)
    segment = answer.since_previous
    assert np.abs(segment.bias - R_cam_imu @ BIAS).max() < 1.5e-3
    assert segment.bias_sigma < 1e-3
    # Removed from the rates, and covered by the smaller covariance.
    _, removed = buffer.angular_velocity(at - 500_000_000, at)
    np.testing.assert_allclose(segment.angular_velocities, removed @ R_cam_imu.T, atol=1e-12)
    _, known = buffer.rotation(at - 500_000_000, at)
    _, unknown = told.rotation(at - 500_000_000, at)
    assert np.trace(known) < 0.2 * np.trace(unknown)
    joint = segment.joined(segment.__class__(
        segment.stamps_ns + 500_000_000, segment.angular_velocities, segment.bias + 0.001, 0.5))
    np.testing.assert_allclose(joint.bias, segment.bias + 0.0005)
    assert joint.bias_sigma == 0.5 and joint.duration == pytest.approx(1.0)
