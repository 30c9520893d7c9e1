"""Bias and time offset followed online: found where they can be seen, equal live and in replay."""

from __future__ import annotations

import threading
import time

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from rs_relpose_ros.bags.reader import open_bag
from rs_relpose_ros.config.imu import ImuConfig
from rs_relpose_ros.config.parameter_file import read_parameters
from rs_relpose_ros.config.parameters import Parameters
from rs_relpose_ros.front_end.drift import DriftTracker, OFFSET_SIGMA, PairRotation
from rs_relpose_ros.front_end.frame import Frame
from rs_relpose_ros.front_end.front_end import FrameFailed, FrameProcessed, FrontEnd
from rs_relpose_ros.front_end.sequencer import Refusal, Sequencer
from rs_relpose_ros.geometry.intrinsics import Intrinsics
from rs_relpose_ros.imu.frame_imu import GyroSegment
from rs_relpose_ros.imu.integration import bias_jacobian, integrate_rotation
from rs_relpose_ros.imu.samples import ImuSample
from rs_relpose_ros.messages.intake import Intake
from rs_relpose_ros.messages.sensor_feed import Role
from rs_relpose_ros.node.worker import WarmedUp, Worker
from rs_relpose_ros.replay.run import Replay

MS = 1_000_000
PERIOD = 5 * MS
SIGMA = 3e-4   # rotation by images [rad]
BIAS, OFFSET_NS = np.array([0.004, -0.003, 0.005]), 8 * MS
R_CAM_IMU = Rotation.from_euler('xyz', [90, 0, 30], degrees=True)


def hand(stamps_ns):
    """Rate of a hand-held camera (N, 3), IMU frame."""
    t = np.asarray(stamps_ns)[:, None] * 1e-9
    return np.array([0.5, 0.6, 0.4]) * np.sin(t * [3.1, 2.3, 4.7] + [0.3, 1.1, 2.0])


def steady(stamps_ns):
    return np.tile([0.1, 0.3, -0.2], (len(stamps_ns), 1))


def pair_of(rate, start_ns, end_ns, rng, applied_ns=(0, 0), *, prior=True, removed=(0.0, 0.0, 0.0),
            wrong=None):
    """A pair whose gyro reads BIAS too much and whose images were seen OFFSET_NS later."""
    config = ImuConfig()
    stamps = np.arange(start_ns + applied_ns[0], end_ns + applied_ns[1] + 1, PERIOD)
    rates = R_CAM_IMU.apply(rate(stamps) + BIAS - removed)
    gyro, covariance = integrate_rotation(stamps, rates, config)
    fine = np.linspace(start_ns + OFFSET_NS, end_ns + OFFSET_NS, 1000).astype(np.int64)
    true, _ = integrate_rotation(fine, R_CAM_IMU.apply(rate(fine)), config)
    seen = Rotation.from_rotvec(SIGMA * rng.normal(size=3)) * Rotation.from_matrix(true)
    if wrong is not None:
        seen = Rotation.from_rotvec(wrong) * seen
    R, spread = seen, SIGMA**2 * np.eye(3)
    if prior:   # fused as the estimator does it
        spread = np.linalg.inv(np.eye(3) / SIGMA**2 + np.linalg.inv(covariance))
        by_images = (seen * Rotation.from_matrix(gyro).inv()).as_rotvec()
        R = Rotation.from_rotvec(spread @ by_images / SIGMA**2) * Rotation.from_matrix(gyro)
    segment = GyroSegment(stamps, rates, R_CAM_IMU.apply(removed), 3e-3)
    return PairRotation(int(stamps[-1]), R.as_matrix(), spread, gyro,
                        covariance if prior else None, segment,
                        applied_ns[0] * 1e-9, applied_ns[1] * 1e-9)


def parameters(**values):
    return Parameters.from_mapping({'readout_time': 0.03, 'time_offset': 0.002,
                                    'quat_cam_imu_xyzw': tuple(R_CAM_IMU.as_quat()), **values})


def followed(rate, seed=0, pairs=40, **options):
    tracker, rng = DriftTracker(parameters()), np.random.default_rng(seed)
    for k in range(pairs):
        tracker.add(pair_of(rate, 200 * MS * k, 200 * MS * (k + 1), rng, **options))
    return tracker.estimate()


def test_jacobian_of_the_bias_by_finite_differences():
    stamps = np.arange(0, 500 * MS, PERIOD)
    rates = 3.0 * hand(stamps)
    jacobian = bias_jacobian(stamps, rates)
    for axis in range(3):
        step = 1e-5 * np.eye(3)[axis]
        more, _ = integrate_rotation(stamps, rates + step, ImuConfig())
        less, _ = integrate_rotation(stamps, rates - step, ImuConfig())
        np.testing.assert_allclose(
            Rotation.from_matrix(more @ less.T).as_rotvec() / 2e-5, jacobian[:, axis], atol=1e-5)
    assert not np.allclose(jacobian, 0.5 * np.eye(3), atol=0.01)


@pytest.mark.parametrize('options', [{}, {'prior': False}, {'applied_ns': (5 * MS, 5 * MS)},
                                     {'applied_ns': (10 * MS, 5 * MS)},
                                     {'removed': (0.01, 0.0, -0.01)}], ids=str)
def test_both_are_found_whatever_was_taken_off_before(options):
    found = followed(hand, **options)
    assert found.pairs == 40
    assert np.abs(found.gyro_bias - BIAS).max() < 1e-3
    assert np.abs(found.gyro_bias - BIAS).max() < 4.0 * found.gyro_bias_sigma.max()
    # 2 ms were told, 8 ms are left.
    assert abs(found.time_offset - 0.010) < 5e-4
    assert found.time_offset_sigma < 5e-4


def test_sigmas_are_honest():
    found = [followed(hand, seed, pairs=15) for seed in range(40)]
    offsets = np.array([(f.time_offset - 0.010) / f.time_offset_sigma for f in found])
    biases = np.array([(f.gyro_bias - BIAS) / f.gyro_bias_sigma for f in found])
    # Cautious by its floor for systematic errors, a factor 1.4.
    for normalised in (offsets, biases):
        assert 0.4 < np.sqrt(np.mean(normalised**2)) < 1.2


def test_a_steady_turn_shows_no_offset():
    """R w_2 = w_1: shifted in time, the same rotation."""
    found = followed(steady)
    assert found.time_offset_sigma > 0.9 * OFFSET_SIGMA
    assert abs(found.time_offset - 0.002) < OFFSET_SIGMA
    assert np.abs(found.gyro_bias - BIAS).max() < 1e-3


def test_a_pair_gone_wrong_moves_little():
    tracker, rng = DriftTracker(parameters()), np.random.default_rng(1)
    for k in range(21):
        before = tracker.estimate()
        tracker.add(pair_of(hand, 200 * MS * k, 200 * MS * (k + 1), rng,
                            wrong=[0.05, -0.04, 0.05] if k == 20 else None))
    after = tracker.estimate()
    assert np.abs(after.gyro_bias - before.gyro_bias).max() < 1e-3
    assert abs(after.time_offset - before.time_offset) < 1e-3


def test_what_the_images_did_not_see_changes_nothing():
    tracker = DriftTracker(parameters())
    good = pair_of(hand, 0, 200 * MS, np.random.default_rng(2))
    nothing = np.full((3, 3), np.nan)
    for R, covariance in ((nothing, good.covariance), (good.R, nothing),
                          (good.gyro_rotation, good.gyro_covariance)):
        tracker.add(PairRotation(good.stamp_ns, R, covariance, good.gyro_rotation,
                                 good.gyro_covariance, good.gyro, 0.0, 0.0))
    found = tracker.estimate()
    assert found.pairs == 0
    np.testing.assert_array_equal(found.gyro_bias, [0.0, 0.0, 0.0])
    assert found.time_offset == 0.002


def test_the_offset_is_applied_in_small_steps_and_taken_back():
    tracker, rng = DriftTracker(parameters()), np.random.default_rng(3)
    applied = []
    for k in range(30):
        tracker.add(pair_of(hand, 200 * MS * k, 200 * MS * (k + 1), rng))
        tracker.apply(wanted=k >= 5)
        applied.append(tracker.applied_ns)
    assert applied[4] == 0
    assert max(np.abs(np.diff(applied))) <= MS
    assert applied[-1] == pytest.approx(OFFSET_NS, abs=0.5 * MS)
    for _ in range(10):
        tracker.apply(wanted=False)
    assert tracker.applied_ns == 0


def test_sigma_grows_with_time_and_not_beyond_the_first():
    tracker, rng = DriftTracker(parameters()), np.random.default_rng(4)
    for k in range(20):
        tracker.add(pair_of(hand, 200 * MS * k, 200 * MS * (k + 1), rng))
    before = tracker.estimate()
    nothing = pair_of(hand, 100_000_000 * MS, 100_000_200 * MS, rng)
    tracker.add(PairRotation(nothing.stamp_ns, np.full((3, 3), np.nan), nothing.covariance,
                             nothing.gyro_rotation, None, nothing.gyro, 0.0, 0.0))
    after = tracker.estimate()
    assert after.time_offset_sigma > 2.0 * before.time_offset_sigma
    assert after.time_offset_sigma <= OFFSET_SIGMA * (1.0 + 1e-9)
    np.testing.assert_allclose(after.gyro_bias_sigma, 3e-3, rtol=1e-6)


@pytest.mark.parametrize('offline', [False, True])
def test_a_shifted_frame_waits_for_its_shifted_rows(offline):
    sequencer = Sequencer(Parameters.from_mapping(
        {'readout_time': 0.02, 'quat_cam_imu_xyzw': (0.0, 0.0, 0.0, 1.0)}), offline=offline,
        clock=lambda: 0)
    calibration = Intrinsics(width=32, height=20, fx=30.0, fy=30.0, cx=16.0, cy=10.0,
                              image_width=32, image_height=20)

    def turn_until(ms):
        while turn_until.now <= ms:
            sequencer.add_imu(ImuSample(turn_until.now * MS, (0.0, 0.5, 0.0), (0.0, -9.8, 0.0)))
            turn_until.now += 5
    turn_until.now = 0
    for ms in (50, 100):
        sequencer.add_frame(Frame(ms * MS, np.zeros((20, 32), np.uint8), 'camera', calibration))
    # Both are ready at 119 ms; then the second one is moved by 20 ms.
    turn_until(120)
    first = sequencer.take()
    assert (first.imu.reference_ns, first.imu.applied_offset_ns) == (50 * MS, 0)
    sequencer.apply_time_offset(20 * MS)
    assert sequencer.take() is None
    turn_until(135)
    assert sequencer.take() is None
    turn_until(140)
    second = sequencer.take()
    assert (second.imu.reference_ns, second.imu.applied_offset_ns) == (120 * MS, 20 * MS)
    segment = second.imu.since_previous
    assert (segment.stamps_ns[0], segment.stamps_ns[-1]) == (50 * MS, 120 * MS)
    # Backwards by more than the gyro knows: a gap, as for any frame.
    sequencer.apply_time_offset(-200 * MS)
    sequencer.add_frame(Frame(150 * MS, np.zeros((20, 32), np.uint8), 'camera', calibration))
    assert sequencer.take().cause is Refusal.IMU_GAP


# -- the bundled bag -------------------------------------------------------------------------


def sensor(bundled_bag, *assignments):
    return read_parameters(bundled_bag.with_name('hand_held.yaml'), assignments)


def replayed(bundled_bag, settings, stamps=None):
    with open_bag(bundled_bag) as bag:
        run = Replay(bag, bag.find_topics(), settings, stamps=stamps)
        return [pair.result for pair in run.pairs()]


def test_the_bag_shows_its_bias_and_a_wrong_time_offset(bundled_bag):
    """Written with a true bias of (0.011, -0.007, 0.005) rad/s and an offset of 0."""
    results = replayed(bundled_bag, sensor(
        bundled_bag, 'time_offset=0.01', 'gyro_bias=[0.0, 0.0, 0.0]', 'gyro_bias_sigma=0.01',
        'track_time_offset=true'))
    drift = results[-1].drift
    assert np.abs(drift.gyro_bias - [0.011, -0.007, 0.005]).max() < 1e-3
    assert abs(drift.time_offset) < 1e-3
    assert drift.applied == pytest.approx(-0.01, abs=1e-3)


def test_live_and_replay_agree_while_the_offset_is_applied(bundled_bag):
    """Frames are lost at random, as live; the replay of the processed ones has equal bits."""
    settings = sensor(bundled_bag, 'time_offset=0.01', 'track_time_offset=true')
    front_end = FrontEnd(settings)
    sequencer = front_end.sequencer
    events = []
    worker = Worker(front_end, events.append)

    def processed():
        return [event for event in events if isinstance(event, FrameProcessed)]

    worker.start()
    while not events:
        assert worker.is_alive()
        time.sleep(0.01)
    assert isinstance(events[0], WarmedUp)
    intake, rng = Intake(sequencer), np.random.default_rng(5)
    images = 0
    with open_bag(bundled_bag) as bag:
        for role, message in intake.feed.messages(bag, bag.find_topics()):
            if role is not Role.IMAGE:
                intake.receive(role, message.message)
            elif rng.random() > 0.1:
                images += 1
                intake.receive(role, message.message)
                # Sometimes behind, sometimes ahead of the worker.
                while len(processed()) < images - rng.integers(1, 4):
                    time.sleep(0.002)
                    if sequencer.counts().refused:
                        break
            if images == 90:
                break
    threading.Event().wait(0.5)
    while worker.is_alive() and len(processed()) < images - sum(
            sequencer.counts().refused.values()) - 1:
        time.sleep(0.05)
    assert worker.stop(30.0)
    assert not any(isinstance(event, FrameFailed) for event in events)
    live = [frame.pair for frame in processed() if frame.pair is not None]
    assert live[-1].drift.applied < -0.005
    again = replayed(bundled_bag, settings, frozenset(
        frame.stamp_ns for frame in processed()))[:len(live)]
    assert len(again) == len(live)
    for a, b in zip(live, again, strict=True):
        assert (a.reference_stamp_ns, a.stamp_ns) == (b.reference_stamp_ns, b.stamp_ns)
        assert np.array_equal(a.pose.R, b.pose.R) and np.array_equal(
            a.pose.t, b.pose.t, equal_nan=True)
        assert np.array_equal(a.pose.covariance, b.pose.covariance, equal_nan=True)
        assert a.drift.applied == b.drift.applied
