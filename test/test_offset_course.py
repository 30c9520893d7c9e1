"""Calibration of recordings in which a clock is set or drifts."""

from dataclasses import replace
import json

from drawn_recordings import camera_of, recorded
import numpy as np
import pytest

from rs_relpose_lab.experiments.calibration_tracks import Recorded
from rs_relpose_ros.calibrate.procedure import calibrate, calibrate_together
from rs_relpose_ros.calibrate.recording import CalibrationInput
from rs_relpose_ros.calibrate.result import as_mapping, CalibrationResult, parameter_file, report
from rs_relpose_ros.calibration.offset_course import OffsetCourse, OffsetStep
from rs_relpose_ros.config.settings import CalibrationConfig
from rs_relpose_ros.errors import InputError
from rs_relpose_ros.output_files import json_text


def shifted(one: Recorded, seconds: np.ndarray) -> Recorded:
    """The recording with images stamped later by seconds (F,)."""
    stamps = one.tracks.stamps_ns + np.rint(1e9 * seconds).astype(np.int64)
    return replace(one, tracks=replace(one.tracks, stamps_ns=stamps))


def times_of(one: Recorded) -> np.ndarray:
    return (one.tracks.stamps_ns - one.tracks.stamps_ns[0]) * 1e-9


def calibrated(one: Recorded, **config: object) -> CalibrationResult:
    return calibrate(one.tracks, one.gyro, camera_of(one), config=CalibrationConfig(**config))


def test_a_recording_with_one_offset_has_no_changes():
    assert calibrated(recorded(31, frames=300)).offset_changes is None


@pytest.mark.parametrize('step', [0.06, 0.31])
def test_a_step_of_the_camera_is_located_and_both_sides_have_their_offset(step):
    one = recorded(32, frames=300)
    after = times_of(one) >= 4.0
    result = calibrated(shifted(one, step * after))
    offset = result.time_offset
    assert abs(offset.value - one.truth.time_offset) < 4.0 * offset.sigma
    assert offset.observable
    (found,) = result.offset_changes.steps
    assert found.begin - 0.1 < 4.0 < found.end + 0.1 and found.end - found.begin < 1.0
    assert abs(found.change.value + step) < 4.0 * found.change.sigma + 1e-4
    first, second = result.offset_changes.offsets
    assert (first, second - first) == pytest.approx((offset.value, found.change.value))
    text = '\n'.join(report(result, camera_of(one)))
    assert 'offset_step' in text and 'clock was set' in text
    written = parameter_file(result, 'A test.', camera=camera_of(one))
    assert 'time_offset holds until' in ' '.join(written.replace('#', '').split())
    mapping = json.loads(json_text(as_mapping(result, camera_of(one))))
    assert mapping['offset_changes']['offset_step'][0]['change_s']['value'] == found.change.value


def test_a_node_that_goes_on_needs_the_offset_after_the_step():
    one = recorded(32, frames=300)
    after = times_of(one) >= 4.0
    result = calibrated(shifted(one, 0.06 * after), offset_at_end=True)
    offset = result.time_offset
    assert abs(offset.value - one.truth.time_offset + 0.06) < 4.0 * offset.sigma


def test_a_step_of_the_imu_leaves_out_what_overlaps():
    one = recorded(33, frames=300)
    gyro = one.gyro
    seconds = (gyro.stamps_ns - one.tracks.stamps_ns[0]) * 1e-9
    stamps = gyro.stamps_ns - np.where(seconds >= 5.0, 100_000_000, 0)
    # The samples of both sides are in the order of their stamps, as a bag is read.
    order = np.argsort(stamps, kind='stable')
    kept = order[np.diff(stamps[order], prepend=stamps[order][0] - 1) > 0]
    moved = replace(one, gyro=replace(gyro, stamps_ns=stamps[kept], rates=gyro.rates[kept]))
    result = calibrated(moved)
    (found,) = result.offset_changes.steps
    assert found.change.value == pytest.approx(-0.1, abs=1e-3)
    offset = result.time_offset
    assert abs(offset.value - one.truth.time_offset) < 4.0 * offset.sigma


def test_a_drift_is_named_and_its_sigma_holds_all_over_the_recording():
    one = recorded(34, frames=420)
    result = calibrated(shifted(one, -4e-4 * times_of(one)))
    drift = result.offset_changes.drift
    assert abs(drift.value - 4e-4) < 4.0 * drift.sigma
    at_middle = one.truth.time_offset + 4e-4 * result.offset_changes.at
    offset = result.time_offset
    assert abs(offset.value - at_middle) < 5e-4
    for time in (0.0, times_of(one)[-1]):
        true = one.truth.time_offset + 4e-4 * time
        assert abs(offset.value - true) < 4.0 * offset.sigma
    assert 'ppm' in '\n'.join(report(result, camera_of(one)))


def test_recordings_whose_clocks_change_are_not_joined():
    one = recorded(32, frames=300)
    other = recorded(32, frames=300)
    stepped = shifted(other, 0.06 * (times_of(other) >= 4.0))
    inputs = [CalibrationInput(r.tracks, r.gyro, camera_of(r), True, {}) for r in (one, stepped)]
    with pytest.raises(InputError, match='within recording 2'):
        calibrate_together(inputs, CalibrationConfig())


def test_offsets_of_a_course_are_about_its_origin():
    steps = (OffsetStep(2.0, 2.1, 0.05), OffsetStep(6.0, 6.1, -0.02))
    times = np.array([0.0, 4.0, 8.0])
    begin = OffsetCourse(steps)
    np.testing.assert_allclose(begin.at(times), [0.0, 0.05, 0.03])
    np.testing.assert_array_equal(begin.covariates(times), [0.0, 1.0, 1.0])
    end = begin.about(9.0)
    np.testing.assert_allclose(end.at(times), [-0.03, 0.02, 0.0], atol=1e-12)
    np.testing.assert_array_equal(end.covariates(times), [-1.0, -1.0, 0.0])
    assert begin.changed(0.01).steps[0].seconds == pytest.approx(0.06)
    clear = begin.clear_of_steps(np.array([1.0, 1.99, 4.0]), np.array([1.5, 2.05, 4.1]))
    np.testing.assert_array_equal(clear, [True, False, True])
