"""Stamps of frames: automatic exposure against jitter, calibrated and in the node."""

from __future__ import annotations

import math

import numpy as np
import pytest

from rs_relpose_lab.experiments.calibration_tracks import drawn, record
from rs_relpose_ros.calibrate.procedure import calibrate
from rs_relpose_ros.calibrate.report import parameter_file, report
from rs_relpose_ros.calibrate.stamps import frame_times, Varying
from rs_relpose_ros.config.parameter_file import read_parameters
from rs_relpose_ros.geometry.camera import RollingShutterCamera
from rs_relpose_ros.geometry.timing import FrameIntervals, ImageClock, NANOSECONDS

MS = 1_000_000
START = 1_700_000_000 * NANOSECONDS


def stamps_of(intervals_ms: list[float]) -> np.ndarray:
    return START + np.rint(np.concatenate([[0.0], np.cumsum(intervals_ms)]) * MS).astype(np.int64)


def camera_of(recorded) -> RollingShutterCamera:
    truth = recorded.truth
    return RollingShutterCamera(
        width=truth.width, height=truth.height, fx=truth.focal, fy=truth.focal,
        cx=0.5 * (truth.width - 1), cy=0.5 * (truth.height - 1), readout_time=0.0)


# -- why intervals vary ------------------------------------------------------------------------


def test_exposure_keeps_its_intervals_and_jitter_does_not():
    rng = np.random.default_rng(1)
    even = np.full(100, 33.3)
    plateaus = np.repeat([33.2, 40.1, 50.0, 40.1], 25)
    late = rng.normal(0.0, 2.4, 101)
    assert frame_times(stamps_of(even)).varying is Varying.NOT
    exposed = frame_times(stamps_of(plateaus))
    assert exposed.varying is Varying.EXPOSURE
    np.testing.assert_allclose(exposed.covariates[1:], 1e-3 * (plateaus - 40.1), atol=1e-9)
    jittered = frame_times(stamps_of(even + np.diff(late)))
    assert jittered.varying is Varying.JITTER
    assert jittered.jitter == pytest.approx(2.4e-3, rel=0.2)
    # What it takes off is the lateness of each stamp.
    assert np.corrcoef(jittered.covariates, -late)[0, 1] > 0.97
    drawn_anew = frame_times(stamps_of(rng.choice([33.0, 40.0], 400)))
    assert drawn_anew.varying is Varying.UNCLEAR and not drawn_anew.covariates.any()


def test_a_lost_frame_is_no_exposure():
    intervals = np.full(100, 33.3)
    intervals[[20, 40, 41, 60]] = 66.6
    assert frame_times(stamps_of(intervals)).varying is Varying.NOT
    # Nor does it hide one: what lies behind the gap has the exposure of before.
    intervals[70:] = 40.0
    times = frame_times(stamps_of(intervals))
    assert times.varying is Varying.EXPOSURE
    assert times.covariates[21] == pytest.approx(0.0, abs=1e-9)
    assert times.covariates[90] == pytest.approx(6.7e-3, abs=1e-9)


@pytest.mark.recordings
@pytest.mark.parametrize(('name', 'column', 'varying'), [
    ('realsense_rgb_rs', 2, Varying.EXPOSURE), ('realsense_rgb_rs_b', 2, Varying.EXPOSURE),
    ('android_phone_rs', 1, Varying.JITTER)])
def test_real_stamps_are_told_apart(recordings, name, column, varying):
    stamps = np.loadtxt(recordings / name / 'frames.csv', delimiter=',', skiprows=1,
                        usecols=column, dtype=np.int64)
    assert frame_times(stamps).varying is varying


def test_exposure_becomes_two_parameters_of_the_node(tmp_path):
    rng = np.random.default_rng(14)
    recorded = record(drawn(rng, readout_time=0.02, fps=30.0, exposure_slope=-0.5,
                            long_interval=1.2, frames=160), rng)
    result = calibrate(recorded.tracks, recorded.gyro, camera_of(recorded))
    assert result.follows_exposure and result.offset_by_jitter is None
    path = tmp_path / 'calibration.yaml'
    path.write_text(parameter_file(result, 'A test.', camera=camera_of(recorded),
                                   compressed=False))
    sensor = read_parameters(path).sensor
    assert sensor.time_offset_per_interval == pytest.approx(-0.5, abs=0.1)
    assert sensor.time_offset_reference_interval == pytest.approx(result.frame_interval, abs=1e-6)
    # Told at the intervals of both halves, the offset is the true one.
    for interval in (1.0 / 30.0, 1.2 / 30.0):
        intervals = np.concatenate([np.full(80, 1.0 / 30.0), np.full(79, 1.2 / 30.0)])
        true = recorded.truth.time_offset - 0.5 * (interval - np.median(intervals))
        assert sensor.offset_at(interval) == pytest.approx(true, abs=1.5e-3)


def test_jitter_of_stamps_is_not_taken_for_exposure():
    rng = np.random.default_rng(19)
    recorded = record(drawn(rng, readout_time=0.02, fps=30.0, stamp_jitter=2.4e-3, frames=120),
                      rng)
    truth = recorded.truth
    result = calibrate(recorded.tracks, recorded.gyro, camera_of(recorded))
    assert result.offset_by_interval is None and not result.follows_exposure
    jitter = result.offset_by_jitter
    assert jitter.value == pytest.approx(1.0, abs=max(4.5 * jitter.sigma, 0.05))
    assert result.stamp_jitter == pytest.approx(2.4e-3, rel=0.25)
    # The mean of all the stamps' own errors remains.
    assert abs(result.time_offset.value - truth.time_offset) < 2e-3
    assert abs(result.readout_time.value - truth.readout_time) < 1e-3
    text = parameter_file(result, 'A test.', camera=camera_of(recorded), compressed=False)
    assert 'per_interval' not in text
    assert any('not taken for exposure' in line for line in report(result, camera_of(recorded)))


# -- the interval of a frame, and its instants ---------------------------------------------------


def test_interval_is_kept_where_frames_are_missing():
    tracker = FrameIntervals()
    found = [tracker.add(int(stamp)) for stamp in stamps_of(
        [30, 30, 90, 30, 45, 60, 100, 100, 30, 120, 30])]
    assert found[0] is None
    # 90, 100 and 120 are frames lost; twice 100 is another rate.
    assert [value / MS for value in found[1:]] == [30, 30, 30, 30, 45, 60, 60, 100, 30, 30, 30]
    assert tracker.add(START) == 30 * MS        # a stamp that goes back tells nothing


def test_offset_follows_the_interval():
    camera = RollingShutterCamera(width=64, height=48, fx=50.0, fy=50.0, cx=31.5, cy=23.5,
                                  readout_time=0.02)
    clock = ImageClock(camera, 0.01, offset_per_interval=-0.5, reference_interval=0.04)
    assert clock.reference_ns(START) == START + 10 * MS
    assert clock.reference_ns(START, 40 * MS) == START + 10 * MS
    assert clock.reference_ns(START, 50 * MS) == START + 5 * MS
    spans = [np.array(clock.row_span_ns(START, interval)) for interval in (40 * MS, 50 * MS)]
    np.testing.assert_array_equal(spans[0] - spans[1], 5 * MS)
    still = ImageClock(camera, 0.01)
    assert still.reference_ns(START, 50 * MS) == still.reference_ns(START)
    assert math.isclose(still.time_offset, 0.01)
