"""IMU: buffer and coverage, gyro integration, bias, gravity, orientation, preintegration."""

from dataclasses import replace
from functools import reduce
from itertools import pairwise
import math

from hypothesis import given, settings
from hypothesis import strategies as st
from message_builders import imu as imu_message
from message_builders import rosbags_types
import numpy as np
import pytest
from scipy.signal import lfilter
from scipy.spatial.transform import Rotation
from two_view_scene import direction_error

from rs_relpose_lab.simulation.motions import hand_held, Plan
from rs_relpose_lab.simulation.simulation import GRAVITY, ImuModel
from rs_relpose_ros import FrameMotion, InertialMotion, InputError, RollingShutterCamera
from rs_relpose_ros.config.settings import ImuConfig
from rs_relpose_ros.estimator.problem import build_problem
from rs_relpose_ros.estimator.velocity import expected_velocities
from rs_relpose_ros.geometry.timing import to_nanoseconds
from rs_relpose_ros.imu import integration
from rs_relpose_ros.imu.buffer import Coverage, frame_imu, ImuBuffer, ImuSample, Series
from rs_relpose_ros.imu.filters import BIAS_MEMORY, BiasTracker
from rs_relpose_ros.imu.integration import ImuSlice
from rs_relpose_ros.imu.noise import density_of, shown_density, third_differences
from rs_relpose_ros.messages.incoming import imu_sample_from_message

PERIOD = 5_000_000
START = 1_650_458_790_000_000_000
SECOND = 1_000_000_000
UP = np.array([0.0, 0.0, 9.80665])
R_CAM_IMU = Rotation.from_euler('xyz', [90, 0, 30], degrees=True).as_matrix()
FILTERS = pytest.mark.parametrize('gravity_filter', ['complementary', 'mean'])


def samples(stamps, rates, forces=UP):
    """Messages with both sensors; `rates` and `forces` (3,) or (K, 3)."""
    count = len(stamps)
    return [
        ImuSample(int(stamp), tuple(rate), tuple(force))
        for stamp, rate, force in zip(
            stamps,
            np.broadcast_to(rates, (count, 3)).tolist(),
            np.broadcast_to(forces, (count, 3)).tolist(),
            strict=True,
        )
    ]


def filled(items, **config):
    buffer = ImuBuffer(ImuConfig(**config))
    for item in items:
        buffer.add(item)
    return buffer


def at_200_hz(count=100):
    return START + PERIOD * np.arange(count)


def wobble(count=100):
    t = 0.005 * np.arange(count)
    return np.column_stack([0.6 * np.sin(3.0 * t), -0.8 * np.cos(2.0 * t), 0.5 + 0.3 * t])


def wobbling(count=100):
    return samples(at_200_hz(count), wobble(count))


# -- Buffer and gyro integration ----------------------------------------------------------------


def test_constant_rate_is_the_exponential_of_rate_times_time_without_its_bias():
    rate = np.array([0.2, -1.1, 0.7])
    bias = (0.01, -0.02, 0.03)
    buffer = filled(samples(at_200_hz(), rate + bias), gyro_bias=bias)
    rotation, _ = buffer.rotation(START + 1_234_567, START + 301_234_567)
    np.testing.assert_allclose(rotation, Rotation.from_rotvec(0.3 * rate).as_matrix(), atol=1e-12)
    assert all(map(np.array_equal, buffer.rotation(START, START), (np.eye(3), np.zeros((3, 3)))))


@settings(max_examples=20)
@given(st.permutations(range(60)), st.sets(st.integers(0, 59)), st.data())
def test_any_order_of_arrival_gives_the_same_bits(order, divided, data):
    """Samples permuted, some of them as a message for each sensor; queries in between."""
    items = wobbling(60)
    arriving = []
    for k in order:
        one = items[k]
        arriving += (
            [replace(one, linear_acceleration=None), replace(one, angular_velocity=None)]
            if k in divided
            else [one]
        )
    a = filled(items)
    b = ImuBuffer(ImuConfig())
    query = data.draw(st.integers(0, len(arriving) - 1))
    for k, item in enumerate(arriving):
        b.add(item)
        if k == query:
            b.gyro.coverage(START, START + SECOND)
            b.between(START, START + 10 * PERIOD)
    end = START + 59 * PERIOD - 1
    assert np.array_equal(a.rotation(START, end)[0], b.rotation(START, end)[0])
    assert np.array_equal(a.gravity(end).direction, b.gravity(end).direction)
    for first, second in zip(a.between(START + 1, end), b.between(START + 1, end), strict=True):
        assert np.array_equal(first, second)


def coverage_by_all_steps(stamps, start_ns, end_ns, gap_ns):
    """Coverage of [start_ns, end_ns] by sorted stamps, by the definition."""
    if not stamps:
        return Coverage.NOT_YET
    if start_ns < stamps[0]:
        return Coverage.NEVER
    steps = pairwise(stamps)
    inside = [after - before for before, after in steps if after > start_ns and before < end_ns]
    if any(step > gap_ns for step in inside):
        return Coverage.NEVER
    return Coverage.AVAILABLE if stamps[-1] >= end_ns else Coverage.NOT_YET


@given(
    st.lists(st.integers(0, 60), max_size=40),
    st.lists(st.tuples(st.integers(0, 60), st.integers(0, 20)), min_size=1, max_size=10),
    st.integers(-5, 50),
)
def test_coverage_and_values_of_a_series_in_any_order(stamps, asked, pruned):
    gap_ns = 6
    series = Series(gap_ns, width=1)
    for stamp_ns in stamps:
        series.insert(stamp_ns, (float(stamp_ns**2),))
    series.prune(pruned)
    known = sorted(set(stamps))
    older = [stamp_ns for stamp_ns in known if stamp_ns <= pruned]
    known = known[max(len(older) - 1, 0) :]
    assert series.stamps.tolist() == known
    assert series.newest_ns == (known[-1] if known else None)
    for start_ns, seconds in asked:
        end_ns = start_ns + seconds
        expected = coverage_by_all_steps(known, start_ns, end_ns, gap_ns)
        assert series.coverage(start_ns, end_ns) is expected
        found = series.between(start_ns, end_ns)
        assert (found is not None) == (expected is Coverage.AVAILABLE)
        if found is None:
            continue
        at = sorted({start_ns, end_ns, *(one for one in known if start_ns < one < end_ns)})
        assert found[0].tolist() == at
        np.testing.assert_allclose(found[1][:, 0], np.interp(at, known, np.square(known)))


def test_the_buffer_knows_which_times_it_covers():
    buffer = ImuBuffer(ImuConfig(max_imu_gap=0.02))
    end = START + 9 * PERIOD
    assert buffer.gyro.coverage(START, START + 1) is Coverage.NOT_YET
    for item in wobbling(10):
        buffer.add(item)
    assert buffer.complete(START, end) and not buffer.complete(START, end + 1)
    for start_ns, end_ns, expected in (
        (START, end, Coverage.AVAILABLE),
        (START - 1, end, Coverage.NEVER),
        (START, end + 1, Coverage.NOT_YET),
    ):
        assert buffer.gyro.coverage(start_ns, end_ns) is expected
        assert (buffer.between(start_ns, end_ns) is None) == (expected is not Coverage.AVAILABLE)
    buffer.add(ImuSample(end + 21_000_000, (0.0, 0.0, 0.0), tuple(UP)))
    assert buffer.gyro.coverage(START, end + 1) is Coverage.NEVER
    assert buffer.gyro.coverage(START, end) is Coverage.AVAILABLE
    assert not buffer.complete(START, end + 1)
    with pytest.raises(InputError, match='does not cover'):
        buffer.angular_velocity(START, end + 1)
    with pytest.raises(InputError, match='must not end'):
        buffer.angular_velocity(START + 2 * PERIOD, START + PERIOD)


def test_duplicates_are_reported_and_all_samples_can_be_removed():
    buffer = ImuBuffer(ImuConfig())
    first, second, third = wobbling(3)
    assert [buffer.add(sample) for sample in (first, third, second, second)] == [
        True,
        True,
        True,
        False,
    ]
    buffer.clear()
    assert buffer.newest_ns is None and buffer.gravity(START + PERIOD) is None
    assert buffer.gyro.coverage(START, START + PERIOD) is Coverage.NOT_YET
    assert buffer.add(replace(first, stamp_ns=0))


@given(
    st.sampled_from(['angular_velocity', 'linear_acceleration']),
    st.integers(0, 2),
    st.sampled_from([np.nan, np.inf, -np.inf]),
)
def test_nothing_of_a_broken_sample_is_kept(name, axis, value):
    buffer = ImuBuffer(ImuConfig())
    broken = np.zeros(3)
    broken[axis] = value
    with pytest.raises(InputError, match='must be finite'):
        buffer.add(replace(wobbling(1)[0], **{name: tuple(broken)}))
    assert buffer.newest_ns is None


def test_buffer_is_bounded():
    buffer = filled(wobbling(3000), imu_buffer_seconds=2.0)
    newest = START + 2999 * PERIOD
    assert buffer.gyro.coverage(newest - 1_900_000_000, newest) is Coverage.AVAILABLE
    assert buffer.gyro.coverage(newest - 2_300_000_000, newest) is Coverage.NEVER


@given(st.integers(0, 9 * PERIOD), st.integers(0, 9 * PERIOD))
def test_borders_are_interpolated_between_the_neighbouring_samples(first, last):
    """A border on a sample is that sample, once."""
    start = START + min(first, last)
    end = START + max(first, last)
    stamps, rates = filled(wobbling(10)).angular_velocity(start, end)
    inside = [stamp for stamp in at_200_hz(10).tolist() if start < stamp < end]
    assert stamps.tolist() == sorted({start, end, *inside})
    for axis, samples_of_axis in zip(rates.T, wobble(10).T, strict=True):
        expected = np.interp(stamps - START, at_200_hz(10) - START, samples_of_axis)
        np.testing.assert_allclose(axis, expected, atol=1e-12)


def test_covariance_equals_the_spread_of_noisy_integrations():
    rng = np.random.default_rng(2)
    stamps = at_200_hz(81)
    rates = 3.0 * wobble(81)
    integrate = integration.integrate_rotation
    expected, covariance = integrate(stamps, rates, 2e-3, 5e-3)
    errors = []
    for _ in range(3000):
        # White noise of density n sampled at f has n sqrt(f) per sample.
        noise = rng.normal(size=rates.shape) * 2e-3 * np.sqrt(200.0)
        noisy, _ = integrate(stamps, rates + noise + rng.normal(size=3) * 5e-3, 2e-3, 5e-3)
        errors.append(Rotation.from_matrix(expected @ noisy.T).as_rotvec())
    sigma = np.sqrt(np.diag(covariance))
    np.testing.assert_allclose(
        np.cov(np.array(errors).T) / np.outer(sigma, sigma),
        covariance / np.outer(sigma, sigma),
        atol=0.1,
    )


def test_integration_agrees_with_a_dense_one_by_scipy_and_with_that_of_the_rows():
    """Rate linear between samples, integrated in 2000 steps each."""
    rng = np.random.default_rng(3)
    stamps = START + np.cumsum(rng.integers(2_000_000, 8_000_000, 12))
    rates = rng.normal(size=(12, 3)).cumsum(axis=0)
    motion = FrameMotion.from_gyro((stamps - stamps[0]) * 1e-9, rates)
    expected = Rotation.identity()
    angles = 0.0
    for k in range(11):
        dt = (stamps[k + 1] - stamps[k]) * 1e-9
        fractions = (np.arange(2000) + 0.5) / 2000
        for step in Rotation.from_rotvec(
            (rates[k] + fractions[:, None] * (rates[k + 1] - rates[k])) * dt / 2000
        ):
            expected = expected * step
        angles += np.linalg.norm(rates[k]) * dt
        rotation, _ = integration.integrate_rotation(stamps[: k + 2], rates[: k + 2], 0.0, 0.0)
        np.testing.assert_allclose(motion.path.rotations[k + 1], rotation, atol=1e-12)
    # Fourth order; without the term w_0 x w_1 it is 4e-4.
    assert (Rotation.from_matrix(rotation).inv() * expected).magnitude() < 1e-6 * angles


@pytest.mark.parametrize('exposure', [0.01, 0.03])
def test_a_frame_turns_with_the_mean_rate_of_its_exposure(exposure):
    """Of a rate ``A sin(2 pi f t)``: its mean over h is smaller by ``sinc(f h)``."""

    def rate(stamps):
        return np.outer(np.sin(8e-9 * np.pi * (stamps - START)), [0.3, -0.5, 0.8])

    stamps = at_200_hz(600)
    smaller = np.sinc(4.0 * exposure)
    buffer = filled(samples(stamps, rate(stamps)))
    reference = START + 1_512_345_678
    half = to_nanoseconds(0.5 * exposure)
    rows = 30_000_000
    blurred = frame_imu(
        buffer,
        (reference - half, reference + rows + half),
        reference,
        np.eye(3),
        reference - 66_000_000,
        exposure,
    )
    before = blurred.since_previous
    # Rates that are linear between samples 5 ms apart; between frames the camera turns as it does.
    np.testing.assert_allclose(before.angular_velocities, rate(before.stamps_ns), atol=3e-3)
    sharp = frame_imu(buffer, (reference, reference + rows), reference, np.eye(3))
    first, last = blurred.motion.rotations([0.0, 0.03])
    angles = [
        Rotation.from_matrix(turn).magnitude()
        for turn in (first.T @ last, sharp.motion.rotations([0.03])[0])
    ]
    assert angles[0] / angles[1] == pytest.approx(smaller, abs=3e-3)
    # The stamped row shows the mean orientation of its exposure, about a fixed axis.
    exposed = reference + np.linspace(-half, half, 2001).astype(np.int64)
    phases = 8e-9 * np.pi * (exposed - START)
    of_middle = np.cos(8e-9 * np.pi * (reference - START))
    mean = (of_middle - np.cos(phases)).mean() / (8.0 * np.pi) * np.array([0.3, -0.5, 0.8])
    shown = Rotation.from_matrix(first).as_rotvec()
    np.testing.assert_allclose(shown, mean, atol=0.03 * np.linalg.norm(mean) + 2e-6)


def test_frame_imu_is_in_the_camera_frame_at_the_stamped_row():
    rate = np.array([0.0, 0.0, 0.8])
    buffer = filled(samples(at_200_hz(400), rate))
    reference = START + 1_500_000_123
    answer = frame_imu(
        buffer, (reference, reference + 30_000_000), reference, R_CAM_IMU, reference - 66_000_000
    )
    np.testing.assert_allclose(answer.motion.angular_velocity, R_CAM_IMU @ rate, atol=1e-12)
    np.testing.assert_allclose(
        answer.motion.rotations([0.03])[0],
        Rotation.from_rotvec(0.03 * (R_CAM_IMU @ rate)).as_matrix(),
        atol=1e-12,
    )
    np.testing.assert_allclose(answer.motion.gravity, R_CAM_IMU @ [0.0, 0.0, -1.0], atol=1e-9)
    assert answer.since_previous.stamps_ns[[0, -1]].tolist() == [reference - 66_000_000, reference]
    # Of a global shutter.
    answer = frame_imu(buffer, (reference, reference), reference, np.eye(3))
    np.testing.assert_allclose(answer.motion.angular_velocity, rate, atol=1e-12)
    assert answer.since_previous is None


# -- Gyro bias by standstill ----------------------------------------------------------------------

BIAS = np.array([0.004, -0.006, 0.008])
# As a MEMS of this class at 200 Hz (EuRoC's ADIS16448): 0.0024 rad/s and 0.03 m/s^2.
RATE_NOISE = 0.0024
FORCE_NOISE = 0.03


def rest(seconds, rng, rate=(0.0, 0.0, 0.0), force_noise=FORCE_NOISE):
    count = round(200 * seconds)
    rates = BIAS + rate + RATE_NOISE * rng.normal(size=(count, 3))
    return rates, np.array([0.0, 0.0, 9.81]) + force_noise * rng.normal(size=(count, 3))


def hand(seconds, rng):
    """Hand-held motion: 0.3 rad/s and 1 m/s^2."""
    phase = 0.005 * np.arange(round(200 * seconds))[:, None] * [3.0, 4.0, 5.0]
    rates, forces = rest(seconds, rng)
    return rates + 0.3 * np.sin(phase), forces + np.cos(phase)


def joined(*parts):
    rates, forces = (np.concatenate(values) for values in zip(*parts, strict=True))
    return at_200_hz(len(rates)), rates, forces


def tracked(config, stamps, rates, forces):
    tracker = BiasTracker(config)
    tracker.run(stamps, rates, forces)
    return tracker.estimate(int(stamps[-1]))


def test_the_bias_is_found_at_rest_with_its_sigma():
    normalised = []
    for seed in range(40):
        rng = np.random.default_rng(seed)
        found = tracked(ImuConfig(), *joined(hand(1.0, rng), rest(4.0, rng), hand(1.0, rng)))
        assert np.abs(found.value - BIAS).max() < 1.5e-3
        assert found.sigma < 1e-3
        normalised.append((found.value - BIAS) / found.sigma)
    # Cautious, as rest may contain slow motion; but not by an order of magnitude.
    assert 0.2 < np.sqrt(np.mean(np.square(normalised))) < 1.2


@pytest.mark.parametrize(
    'case', ['hand', 'slow rotation', 'no accelerometer', 'vibration', 'short', 'gaps', 'off']
)
def test_what_may_be_a_motion_is_no_rest(case):
    """The configured bias and its sigma then stay."""
    rng = np.random.default_rng(1)
    config = ImuConfig(
        track_gyro_bias=case != 'off', gyro_bias=(0.001, 0.002, 0.003), gyro_bias_sigma=0.003
    )
    # 2 deg/s is no bias of 3e-3 rad/s.
    rate = (0.0, 0.035, 0.0) if case == 'slow rotation' else (0.0, 0.0, 0.0)
    still = rest(
        0.9 if case == 'short' else 5.0, rng, rate, 0.3 if case == 'vibration' else FORCE_NOISE
    )
    moving = hand(1.0, rng)
    stamps, rates, forces = joined(moving, *([] if case == 'hand' else [still]), moving)
    if case == 'no accelerometer':
        forces[:] = np.nan
    # Gaps: 0.1 s in every half second.
    keep = (np.arange(len(stamps)) % 100 < 80) | (case != 'gaps')
    found = tracked(config, stamps[keep], rates[keep], forces[keep])
    assert tuple(found.value) == config.gyro_bias and found.sigma == config.gyro_bias_sigma


def test_the_begin_of_a_motion_is_left_out():
    """A camera that starts to rotate slowly: the window with the start is not used."""
    rng = np.random.default_rng(2)
    # From 2.4 s on, the last tenth of a window, at the tenth of a radian per second.
    rates, forces = rest(3.0, rng)
    moving = rates.copy()
    moving[480:] += np.linspace(0.0, 0.1, len(rates) - 480)[:, None]
    found = tracked(ImuConfig(), *joined((moving, forces)))
    still = tracked(ImuConfig(), *joined((rates[:501], forces[:501])))
    np.testing.assert_array_equal(found.value, still.value)
    assert still.sigma < 1e-3


def test_sigma_grows_after_rest_and_a_second_rest_follows_a_drift():
    rng = np.random.default_rng(3)
    config = ImuConfig()
    tracker = BiasTracker(config)
    stamps, rates, forces = joined(rest(5.0, rng), hand(1.0, rng))
    tracker.run(stamps, rates, forces)
    sigmas = [tracker.estimate(int(stamps[-1]) + s * SECOND).sigma for s in (0, 60, 3600)]
    assert sigmas[0] < sigmas[1] < sigmas[2]
    assert sigmas[1] == pytest.approx(config.gyro_bias_sigma * np.sqrt(60 / BIAS_MEMORY), rel=0.1)
    # At most the configured one.
    assert sigmas[2] == config.gyro_bias_sigma
    drift = np.array([0.001, 0.001, -0.001])
    second = rest(10.0, rng)
    found = tracked(
        config,
        *joined(rest(5.0, rng), hand(120.0, rng), (second[0] + drift, second[1]), hand(1.0, rng)),
    )
    assert np.abs(found.value - BIAS - drift).max() < 1e-3


@settings(max_examples=20, deadline=None)
@given(st.lists(st.integers(1, 1599), max_size=60).map(sorted))
def test_the_bias_does_not_depend_on_the_portions(borders):
    rng = np.random.default_rng(5)
    stamps, rates, forces = joined(rest(4.0, rng), hand(1.0, rng), rest(3.0, rng))
    whole = tracked(ImuConfig(), stamps, rates, forces)
    tracker = BiasTracker(ImuConfig())
    for part in np.split(np.arange(len(stamps)), borders):
        tracker.run(stamps[part], rates[part], forces[part])
    portions = tracker.estimate(int(stamps[-1]))
    assert np.array_equal(whole.value, portions.value) and whole.sigma == portions.sigma


@FILTERS
def test_buffer_and_frame_use_the_bias(gravity_filter):
    rng = np.random.default_rng(7)
    items = samples(*joined(rest(5.0, rng), hand(2.0, rng)))
    buffer, configured = (
        filled(items, gravity_filter=gravity_filter, track_gyro_bias=tracking)
        for tracking in (True, False)
    )
    at = START + 6 * SECOND
    segment = frame_imu(
        buffer, (at, at + 30_000_000), at, R_CAM_IMU, at - 500_000_000
    ).since_previous
    assert np.abs(segment.bias - R_CAM_IMU @ BIAS).max() < 1.5e-3
    assert segment.bias_sigma < 1e-3
    # Removed from the rates, and within the smaller covariance.
    _, removed = buffer.angular_velocity(at - 500_000_000, at)
    np.testing.assert_allclose(segment.angular_velocities, removed @ R_CAM_IMU.T, atol=1e-12)
    known, unknown = (each.rotation(at - 500_000_000, at)[1] for each in (buffer, configured))
    assert np.trace(known) < 0.2 * np.trace(unknown)
    joint = segment.joined(
        replace(
            segment,
            stamps_ns=segment.stamps_ns + 500_000_000,
            bias=segment.bias + 0.001,
            bias_sigma=0.5,
        )
    )
    np.testing.assert_allclose(joint.bias, segment.bias + 0.0005)
    assert joint.bias_sigma == 0.5 and joint.duration == pytest.approx(1.0)


# -- Gravity --------------------------------------------------------------------------------------


def upright(times):
    return np.broadcast_to(np.eye(3), (len(times), 3, 3))


def run(
    orientation=upright,
    acceleration=lambda times: 0.0,
    seconds=10.0,
    seed=0,
    bias=0.0,
    noise=0.02,
    **config,
):
    """A buffer with samples of a moving IMU at 200 Hz, and the last stamp.

    orientation(times) is world from IMU (N, 3, 3), world z up; acceleration(times) (N, 3) is in
    the world.
    """
    times = 0.005 * np.arange(int(seconds * 200))
    R = orientation(times)
    later = orientation(times + 1e-4)
    rates = Rotation.from_matrix(np.swapaxes(R, 1, 2) @ later).as_rotvec() / 1e-4 + bias
    force = np.einsum('nji,nj->ni', R, acceleration(times) + np.tile(UP, (len(times), 1)))
    force += noise * np.random.default_rng(seed).normal(size=force.shape)
    stamps = np.round(times * 1e9).astype(int)
    return filled(samples(stamps, rates, force), **config), int(stamps[-1])


def swinging(times):
    times = np.atleast_1d(times)
    return Rotation.from_euler(
        'zyx',
        np.stack([0.8 * np.sin(2.0 * times), 0.5 * np.cos(1.3 * times), 0.7 * times], axis=1),
    ).as_matrix()


def down(at_ns):
    """Gravity in the frame of the swinging IMU."""
    return -swinging(at_ns * 1e-9)[0, 2]


def test_hand_held_acceleration_affects_the_mean_and_not_the_filter():
    def shaking(t):
        return np.stack(
            [1.5 * np.sin(7.0 * t), 1.2 * np.cos(9.0 * t), 0.8 * np.sin(11.0 * t)], axis=1
        )

    errors = {}
    for mode in ('complementary', 'mean'):
        found = []
        for seed in range(6):
            buffer, end = run(swinging, shaking, 6.0 + 0.13 * seed, seed, gravity_filter=mode)
            estimate = buffer.gravity(end)
            found.append(direction_error(estimate.direction, down(end)))
            assert found[-1] < 4.0 * np.degrees(estimate.sigma)
        errors[mode] = np.median(found)
    assert errors['complementary'] < 1.0
    assert errors['mean'] > 3.0 * errors['complementary']


def test_sigma_of_gravity_at_rest_under_acceleration_and_after_braking():
    def sigma(**arguments):
        buffer, end = run(**arguments)
        return buffer.gravity(end)

    early = sigma(seconds=0.2)
    late = sigma(seconds=20.0)
    thrown = sigma(acceleration=lambda t: np.tile([0.0, 0.0, 8.0], (len(t), 1)), seconds=20.0)
    assert late.sigma < 0.5 * early.sigma
    assert thrown.sigma > 1.5 * late.sigma
    # A car that brakes by 3 m/s^2 for 2 s: the direction is biased, within its sigma.
    dragged = sigma(acceleration=lambda t: np.outer(t > 8.0, [3.0, 0.0, 0.0]))
    assert 1.0 < direction_error(dragged.direction, -UP) < 3.0 * np.degrees(dragged.sigma)
    assert dragged.sigma > 2.0 * sigma().sigma


@pytest.mark.parametrize('constant', [2.0, 10.0])
def test_gravity_follows_with_its_time_constant(constant):
    """The measured direction jumps by 1 deg: 1 - 1/e of it is left behind after the constant."""
    aside = 9.80665 * np.tan(np.radians(1.0))
    buffer, end = run(
        acceleration=lambda t: np.outer(t > 4.0 * constant, [aside, 0.0, 0.0]),
        seconds=5.0 * constant,
        noise=0.0,
        gyro_bias_sigma=0.0,
        gravity_time_constant=constant,
    )
    assert direction_error(buffer.gravity(end).direction, -UP) == pytest.approx(
        1.0 - np.exp(-1.0), abs=0.01
    )


def test_a_gap_ends_the_propagation_by_the_gyro():
    """The IMU rotates by 90 degrees during a gap: the direction before it is worthless."""
    buffer, end = run()
    settled = buffer.gravity(end).sigma
    R = Rotation.from_euler('x', 90, degrees=True).as_matrix()
    later = end + 900_000_000 + PERIOD * np.arange(1, 40)
    for item in samples(later, np.zeros(3), R.T @ UP):
        buffer.add(item)
    after = buffer.gravity(int(later[-1]))
    assert direction_error(after.direction, -R[2]) < 0.5
    assert after.sigma > 2.0 * settled
    assert buffer.gravity(end + 450_000_000) is None


def test_the_filter_estimates_a_bias_that_is_not_configured():
    errors = {}
    for sigma in (0.0, 0.02):
        buffer, end = run(swinging, seconds=30.0, bias=(0.03, -0.02, 0.025), gyro_bias_sigma=sigma)
        estimate = buffer.gravity(end)
        errors[sigma] = direction_error(estimate.direction, down(end))
    assert errors[0.02] < 0.6
    assert errors[0.0] > 5.0 * errors[0.02]
    assert errors[0.02] < 3.0 * np.degrees(estimate.sigma)


def test_sigma_holds_under_random_acceleration():
    """Many runs of correlated acceleration: no more than a few errors beyond three sigmas."""
    rng = np.random.default_rng(6)
    normalised = []
    for _ in range(40):
        # First-order Gauss-Markov of 0.2 s and 1 m/s^2, as the filter assumes.
        keep = np.exp(-0.005 / 0.2)
        drive = np.sqrt(1.0 - keep**2) * rng.normal(size=(1600, 3))
        acceleration = lfilter([1.0], [1.0, -keep], drive, axis=0)
        buffer, end = run(
            acceleration=lambda times, found=acceleration: found,
            seconds=8.0,
            bias=3e-3 * rng.normal(size=3),
            noise=0.0,
        )
        estimate = buffer.gravity(end)
        normalised.append(np.radians(direction_error(estimate.direction, -UP)) / estimate.sigma)
    normalised = np.array(normalised)
    # Rayleigh: median 1.18 sigma; with the process noise that sets the gain it was 0.90.
    assert np.mean(normalised < 3.0) >= 0.95
    assert 1.0 < np.median(normalised) < 1.8


@FILTERS
def test_gravity_is_causal_and_independent_of_pruning(gravity_filter):
    rng = np.random.default_rng(8)
    items = samples(
        PERIOD * np.arange(1500), rng.normal(size=(1500, 3)), rng.normal(size=(1500, 3)) + UP
    )
    kept, early = (
        filled(items[:count], gravity_filter=gravity_filter, imu_buffer_seconds=60.0)
        for count in (1500, 1301)
    )
    pruned = ImuBuffer(ImuConfig(gravity_filter=gravity_filter))
    for k, item in enumerate(items):
        pruned.add(item)
        if k % 300 == 299:
            pruned.prune(item.stamp_ns - 100_000_000)
    for other, at_ns in ((early, 1299 * PERIOD + 2_000_000), (pruned, 1499 * PERIOD)):
        one = other.gravity(at_ns)
        same = kept.gravity(at_ns)
        assert np.array_equal(one.direction, same.direction) and one.sigma == same.sigma


# -- Orientation computed by the IMU itself -------------------------------------------------------

# World (z up) from IMU.
WORLD_IMU = Rotation.from_euler('zyx', [40.0, 25.0, -70.0], degrees=True)
DOWN = WORLD_IMU.inv().apply([0.0, 0.0, -1.0])
QUAT = tuple(WORLD_IMU.as_quat())


def orientation_of(first, fifth=None, quat=QUAT):
    msg = imu_message(rosbags_types, 0)
    msg.orientation.x, msg.orientation.y, msg.orientation.z, msg.orientation.w = map(float, quat)
    msg.orientation_covariance[0] = first
    msg.orientation_covariance[4] = first if fifth is None else fifth
    msg.orientation_covariance[8] = 1e6  # the heading is not used
    return imu_sample_from_message(msg).orientation


def test_orientation_of_a_message_requires_a_covariance():
    """Down is that of the world, and sigma that of roll and pitch."""
    own = orientation_of(1e-4, 4e-4)
    np.testing.assert_allclose(own[:3], DOWN, atol=1e-12)
    assert own[3] == pytest.approx(0.02)
    for first in (-1.0, 0.0, float('nan'), 1e6):
        assert orientation_of(first) is None
    for quat in ((0.0, 0.0, 0.0, 0.0), (np.nan, 0.0, 0.0, 1.0)):
        assert orientation_of(1e-4, quat=quat) is None


def with_orientation(own, force=-9.81 * DOWN, rate=(0.0, 0.0, 0.0), **config):
    """A buffer of 4 s of an IMU at WORLD_IMU, with orientations `own(k)`, and its last time."""
    buffer = filled(
        [
            ImuSample(k * PERIOD, tuple(rate), None if force is None else tuple(force), own(k))
            for k in range(800)
        ],
        **config,
    )
    return buffer, 798 * PERIOD + 2_000_000


def off(degrees):
    """Down with an error."""
    axis = np.cross(DOWN, [1.0, 0.0, 0.0])
    return tuple(
        Rotation.from_rotvec(np.radians(degrees) * axis / np.linalg.norm(axis)).apply(DOWN)
    )


@FILTERS
@pytest.mark.parametrize(
    ('own', 'used', 'expected'),
    [
        (off(1.0), True, off(1.0)),
        (off(1.0), False, DOWN),
        # North-east-down, another start, the identity: each of another world.
        (off(180.0), True, DOWN),
        (off(60.0), True, DOWN),
        ((0.0, 0.0, -1.0), True, DOWN),
    ],
)
def test_an_orientation_that_agrees_is_used(gravity_filter, own, used, expected):
    buffer, at = with_orientation(
        lambda k: (*own, 0.02), gravity_filter=gravity_filter, use_imu_orientation=used
    )
    estimate = buffer.gravity(at)
    np.testing.assert_allclose(estimate.direction, expected, atol=1e-9)
    assert (estimate.sigma == 0.02) == (expected is not DOWN)


def test_without_an_accelerometer_the_orientation_is_used():
    buffer, at = with_orientation(lambda k: (*DOWN, 1e-6), None)
    np.testing.assert_allclose(buffer.gravity(at).direction, DOWN, atol=1e-9)
    assert buffer.gravity(at).sigma == 0.01  # the least of an orientation


@FILTERS
def test_orientation_is_propagated_by_the_gyro_and_dropped_when_old(gravity_filter):
    rate = np.array([0.0, 1.0, 0.0])
    found = []
    for only in (790, 780):  # 780 is older than a gap (0.05 s)
        buffer, at = with_orientation(
            lambda k, only=only: (*DOWN, 0.02) if k == only else None,
            force=None,
            rate=rate,
            gravity_filter=gravity_filter,
        )
        found.append(buffer.gravity(at))
    expected = Rotation.from_rotvec(-(at - 790 * PERIOD) * 1e-9 * rate).apply(DOWN)
    np.testing.assert_allclose(found[0].direction, expected, atol=1e-9)
    assert found[1] is None


# -- Preintegrated acceleration -------------------------------------------------------------------

ARM = np.array([0.12, -0.05, 0.08])
EXACT = ImuConfig(
    accel_noise_density=1e-6,
    accel_bias_sigma=0.0,
    imu_position_sigma=0.0,
    gyro_noise_density=1e-7,
    gyro_bias_sigma=0.0,
)


@pytest.fixture(scope='module')
def walk():
    return hand_held(
        np.random.default_rng(3), -0.5, 4.0, Plan.parse('walk:3.0'), speed=1.5, rotation_rate=0.8
    )


def samples_of(walk, first, last, rate):
    """Times, rates and forces of an IMU at ARM in the camera's axes, both ends included."""
    times = np.linspace(first, last, round((last - first) * rate) + 1)
    gyro, force = ImuModel(np.eye(3), ARM).measure(walk.states(times), np.random.default_rng(0))
    return times, gyro, force


def imu_states(walk, times):
    """Positions and velocities of the IMU in the world, and the camera's rotations."""
    states = walk.states(times)
    swing = np.cross(states.angular_velocity, ARM)
    position = states.position + np.einsum('kij,j->ki', states.R_world_cam, ARM)
    velocity = states.velocity + np.einsum('kij,kj->ki', states.R_world_cam, swing)
    return position, velocity, states.R_world_cam


def true_motion(walk, begin, duration):
    """(alpha, beta) of the IMU, in the axes of the camera at `begin`."""
    position, velocity, R = imu_states(walk, [begin, begin + duration])
    return np.concatenate(
        [
            R[0].T @ (position[1] - position[0] - duration * velocity[0]),
            R[0].T @ (velocity[1] - velocity[0]),
        ]
    )


def integrals(motion):
    return np.concatenate([motion.alpha, motion.beta])


def preintegrated(walk, begin, duration, rate):
    """From exact samples, with gravity as it is."""
    R1 = walk.states([begin]).R_world_cam[0]
    return integration.preintegrate(
        integration.ForcePath.integrated(*samples_of(walk, begin, begin + duration, rate)),
        R1.T @ GRAVITY,
        np.zeros((3, 3)),
        ARM,
        EXACT,
        0.0,
    )


@pytest.mark.parametrize(
    ('duration', 'rate', 'tolerance'),
    [(0.15, 4000.0, 1e-6), (0.5, 4000.0, 1e-6), (0.15, 200.0, 1e-3), (0.5, 200.0, 2e-3)],
)
def test_positions_and_velocities_of_a_walk(walk, duration, rate, tolerance):
    for begin in (0.2, 0.9, 1.7, 2.4):
        motion = preintegrated(walk, begin, duration, rate)
        assert motion.duration == pytest.approx(duration)
        np.testing.assert_allclose(
            integrals(motion), true_motion(walk, begin, duration), atol=tolerance
        )
        assert np.linalg.norm(motion.beta) > 0.05  # it does accelerate


def test_the_velocities_of_the_camera_follow_from_the_baseline(walk):
    """At the truth b (d - c t) + a vanishes: lever arm, rows and units are right."""
    camera = RollingShutterCamera(
        width=640,
        height=480,
        fx=450.0,
        fy=450.0,
        cx=319.5,
        cy=239.5,
        readout_time=0.03,
        reference_row='first',
    )
    begin = 1.1
    duration = 0.2
    half = 0.5 * 0.03 * 479 / 480
    states = walk.states([begin, begin + duration, begin + half, begin + duration + half])
    R1, R2 = states.R_world_cam[:2]
    # The acceleration within the frames is that of the IMU, not of the camera.
    change = imu_states(walk, begin + np.array([0.0, half, duration, duration + half]))[1]
    motion = replace(
        preintegrated(walk, begin, duration, 4000.0),
        acceleration1=R1.T @ (change[1] - change[0]) / half,
        acceleration2=R1.T @ (change[3] - change[2]) / half,
    )
    rows = np.linspace(-1e-3, 0.031, 65)
    # With the rate at the middle row, as the truth.
    frames = [
        replace(
            FrameMotion.from_gyro(rows, walk.states(rows + at).angular_velocity),
            angular_velocity=w,
        )
        for at, w in zip((begin, begin + duration), states.angular_velocity[2:], strict=True)
    ]
    points = np.array([[100.0, 100.0], [300.0, 200.0]])
    problem = build_problem(points, points, camera, *frames, R1.T @ R2, 1e-8 * np.eye(3))
    prior, _ = expected_velocities(problem, 'hand_held', duration, motion)
    M1 = states.R_world_cam[2]
    translation = M1.T @ (states.position[3] - states.position[2])
    b = np.linalg.norm(translation)
    d = np.concatenate([M1.T @ states.velocity[2], M1.T @ states.velocity[3]]) / b
    u = b * (d - prior.rate * np.tile(translation / b, 2)) + prior.offset
    # The IMU's acceleration changes within 15 ms, by some percent of it.
    np.testing.assert_allclose(u, 0.0, atol=4e-3)
    assert np.abs(prior.offset).max() > 0.1


def test_covariance_holds_for_drawn_errors(walk):
    """Noise, biases, gravity and lever arm drawn as configured: NEES of (alpha, beta) is 6."""
    rng = np.random.default_rng(5)
    begin = 0.8
    duration = 0.3
    rate = 400.0
    config = ImuConfig(
        accel_noise_density=0.02,
        accel_bias_sigma=0.05,
        imu_position_sigma=0.02,
        gyro_noise_density=2e-3,
    )
    bias_sigma = 0.01
    tilt = 0.02
    length = 0.1
    times, gyro, force = samples_of(walk, begin, begin + duration, rate)
    R1, R2 = walk.states([begin, begin + duration]).R_world_cam
    gravity = R1.T @ GRAVITY
    down = gravity / np.linalg.norm(gravity)
    spread = (9.80665 * tilt) ** 2 * (np.eye(3) - np.outer(down, down)) + length**2 * np.outer(
        down, down
    )

    def arm_term(arm):  # of the relation to the camera, in (alpha', beta')
        w1 = np.cross(gyro[0], arm)
        w2 = np.cross(gyro[-1], arm)
        return np.concatenate([duration * w1 + arm - R1.T @ R2 @ arm, w1 - R1.T @ R2 @ w2])

    path = integration.ForcePath.integrated(times, gyro, force)
    exact = integration.preintegrate(path, gravity, spread, ARM, config, bias_sigma)
    errors = []
    for _ in range(600):
        noisy_gyro = (
            gyro
            + bias_sigma * rng.normal(size=3)
            + config.gyro_noise_density * np.sqrt(rate) * rng.normal(size=gyro.shape)
        )
        noisy_force = (
            force
            + config.accel_bias_sigma * rng.normal(size=3)
            + config.accel_noise_density * np.sqrt(rate) * rng.normal(size=force.shape)
        )
        drawn = integration.preintegrate(
            integration.ForcePath.integrated(times, noisy_gyro, noisy_force),
            rng.multivariate_normal(gravity, spread),
            np.zeros((3, 3)),
            ARM,
            config,
            bias_sigma,
        )
        errors.append(
            integrals(drawn)
            - integrals(exact)
            + arm_term(config.imu_position_sigma * rng.normal(size=3))
        )
    errors = np.array(errors)
    sampled = np.cov(errors.T)
    sigma = np.sqrt(np.diag(exact.covariance))
    np.testing.assert_allclose(
        sampled / np.outer(sigma, sigma), exact.covariance / np.outer(sigma, sigma), atol=0.15
    )
    nees = np.einsum('ki,ij,kj->k', errors, np.linalg.inv(exact.covariance), errors)
    assert np.mean(nees) == pytest.approx(6.0, abs=0.6)


def test_a_motion_shifted_to_later_rows_is_the_integrated_one(walk):
    """Between rows 12 ms later: as integrated there."""
    begin = 0.7
    duration = 0.2
    delay = 0.012
    _, velocity, (R1, M1, *_) = imu_states(
        walk, [begin, begin + delay, begin + duration, begin + duration + delay]
    )
    start = true_motion(walk, begin, duration)
    motion = InertialMotion(
        start[:3],
        start[3:],
        duration,
        1e-6 * np.eye(6),
        ARM,
        acceleration1=R1.T @ (velocity[1] - velocity[0]) / delay,
        acceleration2=R1.T @ (velocity[3] - velocity[2]) / delay,
    )
    later = motion.shifted(delay, R1.T @ M1)
    expected = true_motion(walk, begin + delay, duration)
    np.testing.assert_allclose(later.beta, expected[3:], atol=1e-9)
    np.testing.assert_allclose(later.alpha, expected[:3], atol=2e-5)
    np.testing.assert_allclose(np.sqrt(np.diag(later.covariance)[3:]), 1e-3, rtol=1e-9)


# -- From samples and frames ----------------------------------------------------------------------

FRAMES = (1.2, 1.2333, 1.3, 1.35)
READOUT_NS = 20_000_000


def motion_of_frames(walk, change=lambda time, force: force, own_topic=False):
    """From the first of FRAMES to the last; `own_topic`: the accelerometer in other messages."""
    config = ImuConfig(imu_position=tuple(ARM), track_gyro_bias=False)
    buffer = ImuBuffer(config)
    times = np.arange(-0.3, 1.45, 1.0 / 200.0)
    late_ns = 1_700_000
    model = ImuModel(R_CAM_IMU, ARM)
    rng = np.random.default_rng(0)
    gyro, _ = model.measure(walk.states(times), rng)
    _, force = model.measure(walk.states(times + own_topic * late_ns * 1e-9), rng)
    for k, time in enumerate(times):
        stamp_ns = START + round(time * 1e9)
        specific = change(time, force[k])
        specific = None if specific is None else tuple(specific)
        if own_topic:
            buffer.add(ImuSample(stamp_ns + late_ns, None, specific))
        buffer.add(ImuSample(stamp_ns, tuple(gyro[k]), None if own_topic else specific))
    stamps = [START + round(at * 1e9) for at in FRAMES]
    frames = [
        frame_imu(buffer, (stamp, stamp + READOUT_NS), stamp, R_CAM_IMU, previous)
        for stamp, previous in zip(stamps, [None, *stamps], strict=False)
    ]
    since = reduce(ImuSlice.joined, [frame.since_previous for frame in frames[1:]])
    found = integration.inertial_motions(since, frames, config)
    return found if isinstance(found, str) else found[-1]


@pytest.mark.parametrize('own_topic', [False, True])
def test_motion_from_the_frames_of_a_pair(walk, own_topic):
    motion = motion_of_frames(walk, own_topic=own_topic)
    duration = FRAMES[-1] - FRAMES[0]
    assert motion.duration == pytest.approx(duration, abs=2e-9)
    error = integrals(motion) - true_motion(walk, FRAMES[0], duration)
    # The error is that of gravity, known to some degrees by the filter during a walk.
    assert error @ np.linalg.solve(motion.covariance, error) < 16.0
    assert np.abs(error[3:]).max() < 0.25


@pytest.mark.parametrize(
    ('change', 'reason'),
    [
        (lambda time, force: None, 'there is no accelerometer'),
        (lambda time, force: force / 9.80665, 'must be specific force in m/s'),
        (lambda time, force: force * 100.0, 'must be specific force in m/s'),
        (lambda time, force: np.clip(force + 30.0 * (1.25 < time < 1.28), -19.6, 19.6), 'clipped'),
        (lambda time, force: None if 1.24 < time < 1.31 else force, 'gap'),
    ],
)
def test_an_unusable_accelerometer(walk, change, reason):
    found = motion_of_frames(walk, change)
    assert isinstance(found, str)
    assert reason in found


def test_scale_of_the_accelerometer_drops_out_of_gravity(walk):
    """A sensor with 3 % too much: gravity is used as measured."""
    right, scaled = (
        motion_of_frames(walk, lambda time, force, scale=scale: scale * force)
        for scale in (1.0, 1.03)
    )
    difference = np.linalg.norm(scaled.beta - right.beta) / right.duration
    assert difference < 0.16  # 0.29 m/s^2 of gravity alone otherwise


# -- Noise that the samples show ------------------------------------------------------------------


def noisy(added, count=400):
    t = 0.005 * np.arange(count)
    rates = wobble(count) + added(t)
    buffer = filled(samples(at_200_hz(count), rates))
    return buffer.gyro_noise_density(int(at_200_hz(count)[-1]))


@pytest.mark.parametrize('ratio', [0.5, 1.0, 1.5])
def test_a_noise_up_to_the_configured_one_leaves_that(ratio):
    sigma = ratio * ImuConfig().gyro_noise_density * np.sqrt(200.0)
    rng = np.random.default_rng(8)
    assert noisy(lambda t: rng.normal(0.0, sigma, (len(t), 3))) == ImuConfig().gyro_noise_density


@pytest.mark.parametrize('count', [12, 101, 200])
def test_the_density_of_noise_is_by_medians(count):
    rng = np.random.default_rng(count)
    values = rng.normal(size=(count, 3)) * (1.0, 3.0, 2.0)
    seconds = np.cumsum(rng.uniform(0.004, 0.006, count))
    sizes = np.abs(np.diff(values, n=3, axis=0))
    np.testing.assert_array_equal(third_differences(values), sizes)
    # Of white noise of unit variance the median of the sizes is 0.6745 sqrt(20).
    per_median = math.sqrt(float(np.median(np.diff(seconds)))) / (0.6745 * math.sqrt(20.0))
    assert density_of(sizes, seconds) == pytest.approx(per_median * np.median(sizes), rel=1e-4)
    medians = np.median(sizes, axis=0)
    largest = per_median * medians.max()
    noisiest = sizes[:, np.argmax(medians)]
    assert density_of(noisiest, seconds) == pytest.approx(largest, rel=1e-4)
    assert shown_density(values, seconds, 1e-6) <= 1.0001 * largest


@pytest.mark.parametrize('axis', [0, 2, slice(None)])
@pytest.mark.parametrize('ratio', [5.0, 25.0])
def test_a_larger_noise_of_any_axis_is_the_density_of_a_slice(ratio, axis):
    density = ratio * ImuConfig().gyro_noise_density
    rng = np.random.default_rng(9)
    added = np.zeros((400, 3))
    added[:, axis] = rng.normal(0.0, density * np.sqrt(200.0), added[:, axis].shape)
    assert noisy(lambda t: added) == pytest.approx(density, rel=0.25)
    items = samples(at_200_hz(400), wobble(400) + added)
    start, end = (int(at_200_hz(400)[k]) for k in (380, 398))
    frame = frame_imu(filled(items), (end, end), end, np.eye(3), start)
    assert frame.since_previous.noise_density == pytest.approx(density, rel=0.25)


def test_a_tone_counts_by_what_it_leaves_of_the_integral():
    """A tone of 83 Hz and 0.25 rad/s: its integral is half a milliradian."""
    density = noisy(lambda t: 0.25 * np.sin(2.0 * np.pi * 83.0 * t)[:, None] * [1.0, 0.6, 0.3])
    over_a_readout = density * np.sqrt(0.03)
    assert 2e-4 < over_a_readout < 1e-3
