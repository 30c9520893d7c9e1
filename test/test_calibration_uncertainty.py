"""Sigmas of the calibration: regions of the image, both halves, lens and gyro, exposure."""

from __future__ import annotations

import csv
from functools import lru_cache

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from rs_relpose_lab.experiments.calibration_stretches import (
    calibrated_parts,
    figures_of,
    parts_of,
    write_report,
)
from rs_relpose_lab.experiments.calibration_tracks import drawn, record, Recorded
from rs_relpose_ros.calibrate.bag_streams import CalibrationInput
from rs_relpose_ros.calibrate.coplanarity import (
    BIAS,
    EXPOSURE,
    FOCAL,
    GLOBAL,
    OFFSET,
    READOUT,
    ROTATION,
    SLOPE,
)
from rs_relpose_ros.calibrate.fit import Fit, fit, initial, with_bends
from rs_relpose_ros.calibrate.gyro_path import blur, GyroSeries
from rs_relpose_ros.calibrate.judgement import judged
from rs_relpose_ros.calibrate.observations import Observations
from rs_relpose_ros.calibrate.report import parameter_file
from rs_relpose_ros.calibrate.result import CalibrationResult, CostCurve
from rs_relpose_ros.calibrate.tracks import Tracks
from rs_relpose_ros.calibrate.uncertainty import ModelErrors, widened
from rs_relpose_ros.config.calibration import CalibrationConfig
from rs_relpose_ros.errors import InputError
from rs_relpose_ros.geometry.camera import RollingShutterCamera


@lru_cache(maxsize=1)
def recorded() -> Recorded:
    rng = np.random.default_rng(31)
    return record(drawn(rng, frames=100, readout_time=0.02, fps=30.0, gyro_rate=200.0), rng)


def camera_of(source: Recorded) -> RollingShutterCamera:
    truth = source.truth
    return RollingShutterCamera(
        width=truth.width, height=truth.height, fx=truth.focal, fy=truth.focal,
        cx=0.5 * (truth.width - 1), cy=0.5 * (truth.height - 1), readout_time=0.0)


def free_of(*held: int) -> np.ndarray:
    free = np.ones(GLOBAL, dtype=bool)
    free[[SLOPE, FOCAL, *held]] = False
    return free


def fitted(tracks: Tracks, gyro: GyroSeries, free: np.ndarray) -> tuple[Fit, Observations]:
    """Fit from the truth of the recording."""
    truth = recorded().truth
    data = Observations.of(tracks, gyro, camera_of(recorded()))
    offset = truth.time_offset + 0.5 * truth.readout_time
    pairs = data.pairs((1, 3), max_matches=60, min_matches=20, rng=np.random.default_rng(0))
    problem = data.problem(pairs, offset)
    begin = initial(problem, truth.R_cam_imu.T, offset, truth.readout_time,
                    np.array(truth.gyro_bias), noise=1.0)
    return fit(with_bends(problem, begin), begin, free, rounds=15), data


@lru_cache(maxsize=1)
def undisturbed() -> Fit:
    return fitted(recorded().tracks, recorded().gyro, free_of(EXPOSURE))[0]


def wider(final: Fit, errors: ModelErrors | None = None) -> np.ndarray:
    """Sigmas after `widened` over those before."""
    free = free_of(EXPOSURE)
    before, after = (np.diag(some.covariance)[free]
                     for some in (final, widened(final, free, errors)))
    return np.sqrt(after / before)


def test_a_recording_as_the_model_has_it_is_hardly_widened():
    factors = wider(undisturbed())
    assert factors.min() >= 1.0
    assert np.median(factors) < 1.3


def test_a_part_of_the_image_that_is_wrong_widens_the_sigmas():
    tracks = recorded().tracks
    points, left = tracks.points.copy(), tracks.points[:, 0] < 400.0
    # Sheared all the time, so that stretches of time agree: 3 % of the distance to column 160.
    points[left, 1] += 0.03 * (points[left, 0] - 160.0)
    moved = Tracks(tracks.stamps_ns, tracks.frames, tracks.ids, points)
    final, _ = fitted(moved, recorded().gyro, free_of(EXPOSURE))
    assert wider(final).max() > 2.0 * wider(undisturbed()).max()


def test_halves_that_disagree_widen_the_sigmas():
    gyro = recorded().gyro
    rates = gyro.rates.copy()
    rates[gyro.stamps_ns > recorded().tracks.stamps_ns[50]] += [0.03, 0.0, 0.0]
    final, _ = fitted(recorded().tracks, GyroSeries(gyro.stamps_ns, rates), free_of(EXPOSURE))
    covariance = widened(final, free_of(EXPOSURE), None).covariance
    # The bias is 0.015 rad/s from the mean in each half.
    assert np.sqrt(covariance[BIAS, BIAS]) > 5e-3


def test_errors_of_lens_and_gyro_are_added():
    errors = ModelErrors()
    free = free_of(EXPOSURE)
    plain, added = (widened(undisturbed(), free, some) for some in (None, errors))
    difference = added.covariance - plain.covariance
    assert np.linalg.eigvalsh(difference).min() > -1e-12 * np.trace(difference)
    # A gyro whose rates are 0.5 % larger has a bias that is 0.5 % larger, at least.
    bias = np.abs(recorded().truth.gyro_bias)
    assert (np.sqrt(np.diag(difference)[BIAS:BIAS + 3]) > 0.3 * errors.gyro_scale * bias).all()
    none = widened(undisturbed(), free, ModelErrors(*[0.0] * len(errors)))
    np.testing.assert_allclose(none.covariance, plain.covariance, rtol=1e-9)


def test_exposure_is_found():
    """A gyro that is as much sharper than the images as 40 ms of exposure blur."""
    gyro, square = recorded().gyro, 0.04**2
    times = (gyro.stamps_ns - gyro.stamps_ns[0]) * 1e-9
    sharper = GyroSeries(gyro.stamps_ns, gyro.rates - square * blur(times, gyro.rates)[0])
    final, _ = fitted(recorded().tracks, sharper, free_of())
    found, sigma = final.unknowns.parameters, np.sqrt(np.diag(final.covariance))
    assert sigma[EXPOSURE] < 0.15 * square
    assert abs(found[EXPOSURE] - square) < 4.0 * sigma[EXPOSURE]
    assert abs(found[READOUT] - recorded().truth.readout_time) < 4.0 * sigma[READOUT]


def judged_at(readout: float, sigma: float) -> tuple[CalibrationResult, Fit, Observations]:
    """Result where the fit has this read-out time, its offset by -0.5 correlated with it."""
    final, data = fitted(recorded().tracks, recorded().gyro, free_of(EXPOSURE))
    parameters, covariance = final.unknowns.parameters.copy(), final.covariance.copy()
    parameters[READOUT] = readout
    covariance[READOUT], covariance[:, READOUT] = 0.0, 0.0
    covariance[READOUT, READOUT] = sigma**2
    covariance[READOUT, OFFSET] = covariance[OFFSET, READOUT] = -0.5 * sigma**2
    covariance[READOUT, ROTATION] = covariance[ROTATION, READOUT] = 0.1 * sigma**2
    final = Fit(final.problem, final.unknowns._replace(parameters=parameters), final.weights,
                covariance, final.information, True)
    curve = CostCurve(np.linspace(-0.03, 0.03, 3), np.zeros(3))
    return judged(data, final, free_of(EXPOSURE), curve, CalibrationConfig()), final, data


@pytest.mark.parametrize('sign', [1.0, -1.0])
def test_the_interval_between_frames_bounds_the_read_out(sign):
    """Against draws from the normal distribution of which those beyond the bound are left out."""
    interval, sigma = Observations.of(
        recorded().tracks, recorded().gyro, camera_of(recorded())).interval, 1e-3
    result, final, _ = judged_at(sign * (interval + 5e-4), sigma)
    drawn_at = final.unknowns.parameters[READOUT] + sigma * np.random.default_rng(
        5).standard_normal(1_000_000)
    mean = float(drawn_at[np.abs(drawn_at) <= interval].mean())
    readout, moved = result.readout_time, mean - final.unknowns.parameters[READOUT]
    assert readout.observable and abs(readout.value) < interval
    assert readout.value == pytest.approx(mean, abs=5e-6)
    assert readout.sigma == pytest.approx(sigma, rel=1e-6)
    # What goes with it follows: the middle row, and so the first one; the axes.
    middle = final.unknowns.parameters[OFFSET] - 0.5 * moved
    first = 0.5 * (recorded().truth.height - 1) / recorded().truth.height
    assert result.time_offset.value == pytest.approx(middle - first * mean, abs=1e-5)
    turn = Rotation.from_matrix(result.R_cam_imu.T @ final.unknowns.R_imu_cam.T).as_rotvec()
    np.testing.assert_allclose(turn, [0.1 * moved, 0.0, 0.0], atol=1e-6)
    assert any(f'{1e3 * interval:.1f} ms between frames' in text for text in result.warnings)
    text = parameter_file(result, 'A test.', camera=camera_of(recorded()), compressed=False)
    assert f'readout_time: {abs(readout.value):.6f}'.rstrip('0') in text


def test_the_interval_does_not_touch_a_read_out_far_below():
    result, final, _ = judged_at(0.02, 1e-3)
    assert result.readout_time.value == pytest.approx(0.02, abs=1e-12)
    np.testing.assert_allclose(result.R_cam_imu, final.unknowns.R_imu_cam.T, atol=1e-12)
    assert result.warnings == ()


def test_a_read_out_for_certain_beyond_the_interval_is_refused():
    with pytest.raises(InputError, match='which no camera can do'):
        judged_at(0.037, 1e-3)


# -- parts of a recording ----------------------------------------------------------------------


def test_parts_are_whole_and_keep_their_points():
    tracks = recorded().tracks
    parts = list(parts_of(tracks, 1.5))
    assert [begin for begin, _ in parts] == [0.0, 1.5]
    for begin, part in parts:
        assert len(part) == 45
        first = round(begin * 30.0)
        np.testing.assert_array_equal(part.stamps_ns, tracks.stamps_ns[first:first + 45])
        assert len(part.points) == ((tracks.frames >= first) & (tracks.frames < first + 45)).sum()
    assert len(list(parts_of(tracks, 60.0))) == 1


def test_stretches_of_a_simulated_camera_agree(tmp_path):
    source = recorded()
    recording = CalibrationInput(source.tracks, source.gyro, camera_of(source), True, {})
    refused: list[str] = []
    parts = list(calibrated_parts('bag', recording, 1.6, refused.append))
    assert len(parts) == 2 and not refused
    text = write_report(tmp_path, figures_of(parts))
    assert 'read-out time [ms]' in text and 'gyro bias, z [mrad/s]' in text
    with (tmp_path / 'calibration_stretches.csv').open(newline='') as file:
        found = [row for row in csv.DictReader(file) if row['name'] == 'read-out time [ms]']
    assert len(found) == 2
    for row in found:
        assert abs(float(row['value']) - 20.0) < 4.5 * float(row['sigma'])
    assert list(calibrated_parts('bag', recording, 0.5, refused.append)) == []
    assert len(refused) == 6 and 'too short' in refused[0]
