"""Steps of a clock in the middle of a recording: found, named, and followed."""

from dataclasses import replace

import numpy as np
import pytest
from test_monitor import CONFIGURED

from rs_relpose_ros.bags.reader import open_bag
from rs_relpose_ros.calibration import assessment
from rs_relpose_ros.calibration.assessment import Effect, unexplained
from rs_relpose_ros.calibration.changes import change_of, drift_doubts, Kind
from rs_relpose_ros.calibration.findings import Code, FindingState, NOT_EVALUATED, worst_of
from rs_relpose_ros.calibration.findings_text import line
from rs_relpose_ros.calibration.posterior import Calibration
from rs_relpose_ros.config.files import read_parameters
from rs_relpose_ros.core.deviations import LIVE
from rs_relpose_ros.messages.incoming import Role
from rs_relpose_ros.offline.replay import Replay

SECOND = 1_000_000_000


def stepping(replay, sensor, seconds, after):
    """The messages of a replay; a clock is set by `seconds` once, `after` seconds of the bag."""
    begin = None
    for role, message in type(replay).messages_as_recorded(replay):
        stamp = message.message.header.stamp
        stamp_ns = stamp.sec * SECOND + stamp.nanosec
        begin = begin or stamp_ns
        if (role is Role.IMU) == (sensor == 'imu') and stamp_ns >= begin + after * SECOND:
            stamp.sec, stamp.nanosec = divmod(stamp_ns + round(seconds * SECOND), SECOND)
        yield role, message


@pytest.mark.parametrize(
    ('sensor', 'seconds', 'after'), [('camera', 0.026, 1.8), ('imu', 0.07, 2.2)]
)
def test_a_clock_that_steps_is_named_and_followed(
    bundled_bag, monkeypatch, sensor, seconds, after
):
    parameters = read_parameters(bundled_bag.with_name(bundled_bag.name + '.yaml'))
    monkeypatch.setattr(Replay, 'messages_as_recorded', Replay._messages, raising=False)
    monkeypatch.setattr(
        Replay, '_messages', lambda replay: stepping(replay, sensor, seconds, after)
    )
    with open_bag(bundled_bag) as bag:
        replay = Replay(bag, bag.find_topics(needs_camera_info=True), parameters)
        pairs = list(replay.pairs())
        health = NOT_EVALUATED
        for pair in pairs:
            health = worst_of(health, pair.health)
        health = worst_of(health, replay.health)
    step = -seconds if sensor == 'camera' else seconds
    (found,) = health.faults
    assert found.code is Code.OFFSET_STEP
    assert found.estimate == pytest.approx(step, abs=4.0 * found.sigma)
    assert 'stepped by' in line(found)
    # Between the images that it names.
    begin = pairs[0].reference_stamp_ns
    measured = found.evidence.measured
    assert measured['before_ns'] < begin + (after + 0.2) * SECOND
    assert measured['after_ns'] > begin + (after - 0.2) * SECOND
    # No pose of a pair in between, and poses again with the new offset, which is refined.
    applied = [pair for pair in pairs if pair.applied.stepped]
    assert applied
    for pair in pairs:
        if measured['before_ns'] < pair.stamp_ns <= applied[0].stamp_ns:
            assert not pair.pose
    assert sum(bool(pair.pose) for pair in applied[1:]) >= 4
    assert applied[-1].applied.offset == pytest.approx(step, abs=1e-3)


PAIRS = 80
STAMPS_NS = np.arange(PAIRS, dtype=np.int64) * 170_000_000
SECONDS = STAMPS_NS * 1e-9


def calibration_of(offsets, seed=3, noise=0.002, entry='time_offset'):
    """Pairs whose `entry`, a time [s], deviates by `offsets` (N,), each with a `noise`."""
    rng = np.random.default_rng(seed)
    k = LIVE.index(entry)
    rows = rng.standard_normal((PAIRS, 20, LIVE.size)) / LIVE.sigmas
    rows[:, :, k] = rng.standard_normal((PAIRS, 20)) / (noise * np.sqrt(20.0))
    S = rows.transpose(0, 2, 1) @ rows
    residuals = rows[:, :, k] * offsets[:, None] + rng.standard_normal((PAIRS, 20))
    b = np.einsum('nij,ni->nj', rows, residuals)
    nothing = np.zeros(LIVE.size)
    # The covariance of all is not needed: hypotheses are solved from S and b.
    return Calibration(
        nothing, np.eye(LIVE.size), S, b, np.ones((PAIRS, LIVE.size)), nothing, 1.0, 1.0, 1.0
    )


def change_by(pairs, stamp_sigma=0.0):
    ranked = assessment.hypotheses(pairs, CONFIGURED)
    return change_of(ranked, STAMPS_NS, CONFIGURED, stamp_sigma=stamp_sigma)


@pytest.mark.parametrize(('step', 'first'), [(0.0031, 50), (-0.0044, 21)])
def test_a_small_step_is_located(step, first):
    found = change_by(calibration_of(np.where(np.arange(PAIRS) < first, 0.0, step)))
    assert found.entry == 'time_offset'
    assert found.kind is Kind.STEP
    assert found.value == pytest.approx(step, abs=4.0 * found.sigma)
    assert found.sigma < 7e-4
    before_ns, after_ns = found.between_ns
    assert before_ns - 4e8 < STAMPS_NS[first] < after_ns + 4e8


def test_a_step_within_the_jitter_of_stamps_is_none():
    pairs = calibration_of(np.where(np.arange(PAIRS) < 40, 0.0, 0.0052))
    assert change_by(pairs, stamp_sigma=0.0011).kind is Kind.STEP
    assert change_by(pairs, stamp_sigma=0.0025) is None


@pytest.mark.parametrize('rate', [310e-6, -450e-6])
def test_a_drift_is_measured(rate):
    pairs = calibration_of(rate * (SECONDS - 2.0), noise=7e-4)
    found = change_by(pairs)
    assert found.is_drift_of('time_offset')
    assert found.value == pytest.approx(rate, abs=4.0 * found.sigma)
    assert found.now == pytest.approx(rate * (SECONDS[-1] - 2.0), abs=1.5e-3)


@pytest.mark.parametrize('rate', [0.0021, -0.0013])
def test_a_zoom_is_measured(rate):
    deviations = rate * (SECONDS - 9.0)
    pairs = calibration_of(deviations, noise=0.006, entry='focal_log')
    found = change_by(pairs)
    assert found.is_drift_of('focal_log')
    assert found.value == pytest.approx(rate, abs=4.0 * found.sigma)
    assert found.now == pytest.approx(deviations[-1], abs=4.0 * found.now_sigma)
    effect = Effect(np.full((5, LIVE.size), 400.0), np.full((6, LIVE.size), 200.0))
    off = assessment.off_now(Code.FOCAL_LENGTH, found.now, found.now_sigma, [effect])
    (wrong,) = assessment.assess(pairs, [off], (), CONFIGURED).faults
    assert wrong.code is Code.FOCAL_LENGTH
    fx = CONFIGURED.camera.fx
    assert wrong.estimate == pytest.approx(fx * np.exp(deviations[-1]), abs=0.015 * fx)
    # Even while the focal length is right in the mean, that of now is in doubt.
    ranked = assessment.hypotheses(pairs, CONFIGURED)
    doubt = assessment.undetermined(pairs, CONFIGURED, drift_doubts(ranked, STAMPS_NS, CONFIGURED))
    k = LIVE.index('focal_log')
    assert np.sqrt(doubt[k, k]) > 0.7 * abs(deviations[-1])


@pytest.mark.parametrize('value', [0.0, 0.02])
@pytest.mark.parametrize('seed', range(5))
def test_a_constant_focal_length_is_no_change(value, seed):
    pairs = calibration_of(np.full(PAIRS, value), seed, 0.01, 'focal_log')
    assert change_by(pairs) is None
    ranked = assessment.hypotheses(pairs, CONFIGURED)
    doubt = assessment.undetermined(pairs, CONFIGURED, drift_doubts(ranked, STAMPS_NS, CONFIGURED))
    alone = assessment.undetermined(pairs, CONFIGURED)
    k = LIVE.index('focal_log')
    assert doubt[k, k] < 1.1 * alone[k, k]


@pytest.mark.parametrize('offset', [0.0, 0.005])
@pytest.mark.parametrize('seed', range(5))
def test_a_constant_offset_is_no_change(offset, seed):
    pairs = calibration_of(np.full(PAIRS, offset), seed)
    assert change_by(pairs) is None


@pytest.mark.parametrize(('noise', 'named'), [(1.0, False), (1.2, False), (2.0, True)])
def test_pairs_that_contradict_each_other_are_named_without_a_cause(noise, named):
    pairs = calibration_of(np.full(PAIRS, 0.001))
    scattered = replace(pairs, b=noise * pairs.b)
    found = unexplained(scattered)
    assert (found is not None) == named
    if found is not None:
        assert found.state is FindingState.WRONG
        assert 'candidates' in line(found)
    few = replace(pairs, S=pairs.S[:19], b=2.0 * pairs.b[:19])
    assert unexplained(few) is None
