"""Sigmas of the calibration: regions of the image, both halves, lens and gyro, exposure."""

import csv
import dataclasses
from functools import lru_cache
import math

import numpy as np
import pytest
from scipy.spatial.transform import Rotation
from scipy.stats import norm, t
from test_calibration import camera_of, simulated

from rs_relpose_lab.experiments import calibration as benchmark
from rs_relpose_lab.experiments.calibration_tracks import Recorded
from rs_relpose_ros.calibrate import fit as fitting
from rs_relpose_ros.calibrate import observations
from rs_relpose_ros.calibrate.coplanarity import (
    BIAS,
    CENTER,
    EXPOSURE,
    GLOBAL,
    LENS,
    OFFSET,
    READOUT,
    ROTATION,
    SLOPE,
)
from rs_relpose_ros.calibrate.fit import Fit, ModelErrors, widened
from rs_relpose_ros.calibrate.procedure import calibrate, CalibrationInput, evaluated
from rs_relpose_ros.calibrate.result import CalibrationResult, CostCurve, parameter_file
from rs_relpose_ros.calibrate.start import GyroSeries, noise_density
from rs_relpose_ros.config.files import read_parameters
from rs_relpose_ros.config.settings import CalibrationConfig, TRACKED_IN_IMAGES
from rs_relpose_ros.errors import InputError


@lru_cache(maxsize=1)
def recorded() -> Recorded:
    return simulated(31, frames=100, fps=30.0, gyro_rate=200.0)


def free_of(*held: int) -> np.ndarray:
    free = np.ones(GLOBAL, dtype=bool)
    free[[SLOPE, *range(GLOBAL)[LENS], *held]] = False
    return free


def fitted(free: np.ndarray, **changes: object) -> tuple[Fit, observations.Observations]:
    """Fit from the truth of the recording, with changed tracks or gyro."""
    source = dataclasses.replace(recorded(), **changes)
    truth = source.truth
    data = observations.Observations.of(source.tracks, source.gyro, camera_of(truth))
    offset = truth.time_offset + 0.5 * truth.readout_time
    pairs = data.pairs(observations.PairSelection((0.033, 0.1), 60, 20, 999),
                       np.random.default_rng(0))
    problem = data.problem(pairs, offset)
    begin = fitting.initial(problem, truth.R_cam_imu.T, offset, truth.readout_time,
                            np.array(truth.gyro_bias), noise=1.0)
    return fitting.fit(fitting.with_bends(problem, begin), begin, free, rounds=15), data


@lru_cache(maxsize=1)
def undisturbed() -> tuple[Fit, observations.Observations]:
    return fitted(free_of(EXPOSURE))


def wider(final: Fit, errors: ModelErrors | None = None) -> np.ndarray:
    """Sigmas after `widened` over those before."""
    before, after = (np.diag(some.covariance)[final.free]
                     for some in (final, widened(final, errors)))
    return np.sqrt(after / before)


def test_a_recording_of_the_model_is_hardly_widened():
    factors = wider(undisturbed()[0])
    assert factors.min() >= 1.0
    assert np.median(factors) < 1.3


def test_a_fit_that_does_not_converge_has_wider_sigmas():
    final, _ = undisturbed()
    parameters = final.unknowns.parameters.copy()
    parameters[[READOUT, BIAS]] += 0.004, 0.02
    begin = final.unknowns._replace(parameters=parameters)
    short = fitting.fit(final.problem, begin, final.free, rounds=2)
    assert final.converged and not short.converged
    error = short.unknowns.parameters - final.unknowns.parameters
    for k in (READOUT, BIAS):
        assert abs(error[k]) < 3.0 * math.sqrt(short.covariance[k, k])
    # Most of it remains after two steps.
    assert short.covariance[READOUT, READOUT] > 4.0 * final.covariance[READOUT, READOUT]


def test_a_part_of_the_image_that_is_wrong_widens_the_sigmas():
    tracks = recorded().tracks
    points, left = tracks.points.copy(), tracks.points[:, 0] < 400.0
    # Sheared all the time, so that stretches of time agree: 3 % of the distance to column 160.
    points[left, 1] += 0.03 * (points[left, 0] - 160.0)
    final, _ = fitted(free_of(EXPOSURE), tracks=dataclasses.replace(tracks, points=points))
    assert wider(final).max() > 2.0 * wider(undisturbed()[0]).max()


def test_halves_that_disagree_widen_the_sigmas():
    gyro = recorded().gyro
    rates = gyro.rates.copy()
    rates[gyro.stamps_ns > recorded().tracks.stamps_ns[50]] += [0.03, 0.0, 0.0]
    final, _ = fitted(free_of(EXPOSURE), gyro=GyroSeries(gyro.stamps_ns, rates))
    covariance = widened(final, None).covariance
    # The bias is 0.015 rad/s from the mean in each half.
    assert np.sqrt(covariance[BIAS, BIAS]) > 5e-3


def test_errors_of_lens_and_gyro_are_added():
    errors = ModelErrors()
    final, _ = undisturbed()
    plain, added = (widened(final, some) for some in (None, errors))
    difference = added.covariance - plain.covariance
    assert np.linalg.eigvalsh(difference).min() > -1e-12 * np.trace(difference)
    # A gyro whose rates are 0.5 % larger has a bias that is 0.5 % larger, at least.
    bias = np.abs(recorded().truth.gyro_bias)
    assert (np.sqrt(np.diag(difference)[BIAS:BIAS + 3]) > 0.3 * errors.gyro_scale * bias).all()
    none = widened(final, ModelErrors(*[0.0] * len(errors)))
    np.testing.assert_allclose(none.covariance, plain.covariance, rtol=1e-9)


def test_effect_of_an_exposure_on_a_quadratic_rate():
    """Its mean over an exposure h exceeds it by ``h^2 / 24 w''``, whatever h is assumed."""
    stamps = np.arange(0, 2_000_000_000, 2_000_000)
    rates = np.repeat((1e-9 * stamps[:, None])**2, 3, axis=1)
    for exposure in (0.0, 0.04):
        mean, by_square = observations.exposed_rates(GyroSeries(stamps, rates),
                                                     np.full(len(stamps), exposure))
        np.testing.assert_allclose((mean - rates)[30:-30], exposure**2 / 12.0, atol=1e-6)
        np.testing.assert_allclose(by_square[30:-30], 2.0 / 24.0, rtol=0.03)


def sharper(square: float) -> GyroSeries:
    """The recording's gyro, sharper than its images as these would be by an exposure."""
    gyro = recorded().gyro
    _, by_square = observations.exposed_rates(gyro, np.zeros(len(gyro)))
    return GyroSeries(gyro.stamps_ns, gyro.rates - square * by_square)


def test_exposure_is_found():
    final, _ = fitted(free_of(), gyro=sharper(0.04**2))
    found, sigma = final.unknowns.parameters, np.sqrt(np.diag(final.covariance))
    assert sigma[EXPOSURE] < 0.15 * 0.04**2
    assert abs(found[EXPOSURE] - 0.04**2) < 4.0 * sigma[EXPOSURE]
    assert abs(found[READOUT] - recorded().truth.readout_time) < 4.0 * sigma[READOUT]


@pytest.mark.parametrize('given', [{}, {'exposure_time': 0.03}], ids=['unknown', 'given'])
def test_exposure_is_taken_in_by_the_readout_and_written(given, tmp_path):
    source = recorded()
    result = calibrate(source.tracks, sharper(0.03**2), camera_of(source.truth),
                       config=dataclasses.replace(TRACKED_IN_IMAGES, **given))
    readout, exposure = result.readout_time, result.exposure
    assert abs(readout.value - source.truth.readout_time) < 3.0 * readout.sigma < 3e-3
    assert abs(exposure.value - 0.03) <= 3.0 * exposure.sigma
    assert (exposure.sigma == 0.0) == bool(given)
    path = tmp_path / 'calibration.yaml'
    path.write_text(parameter_file(result, 'A test.', camera=camera_of(source.truth),
                                   compressed=False))
    sensor = read_parameters(path).sensor
    assert sensor.exposure_time == pytest.approx(exposure.value, abs=1e-5)
    assert sensor.readout_time_sigma == pytest.approx(readout.sigma, abs=1e-6)


def test_automatic_exposure_is_the_interval_less_a_margin():
    intervals = np.repeat([0.0332, 0.045], 40)
    times = np.cumsum(intervals) - intervals[0]
    stamps = observations.frame_times(np.rint(times * 1e9).astype(np.int64))
    exposure = observations.Exposure.of(times, stamps, TRACKED_IN_IMAGES)
    np.testing.assert_allclose(exposure.assumed[1:], intervals[1:] - exposure.margin, atol=1e-8)
    assert 0.005 < exposure.margin < 0.012 and exposure.square_sigma > 0.0
    known = observations.Exposure.of(times, stamps, dataclasses.replace(
        TRACKED_IN_IMAGES, exposure_margin=0.01))
    np.testing.assert_allclose(known.assumed[1:], intervals[1:] - 0.01, atol=1e-8)
    assert known.square_sigma == 0.0


def evaluated_at(readout: float, sigma: float) -> tuple[CalibrationResult, Fit]:
    """Result where the fit has this readout time, its offset by -0.5 correlated with it."""
    final, data = undisturbed()
    parameters, covariance = final.unknowns.parameters.copy(), final.covariance.copy()
    parameters[READOUT] = readout
    covariance[READOUT], covariance[:, READOUT] = 0.0, 0.0
    covariance[READOUT, READOUT] = sigma**2
    covariance[READOUT, OFFSET] = covariance[OFFSET, READOUT] = -0.5 * sigma**2
    covariance[READOUT, ROTATION] = covariance[ROTATION, READOUT] = 0.1 * sigma**2
    covariance[OFFSET, OFFSET] += 0.25 * sigma**2
    covariance[ROTATION, ROTATION] += 0.01 * sigma**2
    final = dataclasses.replace(final, unknowns=final.unknowns._replace(parameters=parameters),
                                covariance=covariance, converged=True)
    curve = CostCurve(np.linspace(-0.03, 0.03, 3), np.zeros(3))
    return evaluated(data, final, curve, CalibrationConfig()), final


def test_a_readout_that_the_images_do_not_determine_is_that_of_the_interval():
    result, _ = evaluated_at(-0.004, 0.05)
    interval = undisturbed()[1].interval
    readout = result.readout_time
    assert readout.determined and not readout.observable and result.complete
    # Joined with T / 2 +- T / sqrt(12).
    known = interval / math.sqrt(12.0)
    weight = 0.05**-2 + known**-2
    assert readout.value == pytest.approx(
        (-0.004 * 0.05**-2 + 0.5 * interval * known**-2) / weight, rel=1e-6)
    assert readout.sigma == pytest.approx(weight**-0.5, rel=1e-6)
    # What is correlated with it follows, with a sigma of its own part only.
    assert result.time_offset.sigma > 0.4 * known
    assert any('hardly determine' in text for text in result.warnings)


def test_sigmas_of_the_lens_do_not_exceed_those_of_its_priors():
    final, data = fitted(free_of(EXPOSURE) | np.isin(np.arange(GLOBAL), np.arange(GLOBAL)[LENS]))
    covariance, sigma = final.covariance.copy(), 0.015 * data.camera.width
    covariance[CENTER, CENTER] += (10.0 * sigma)**2
    wide = dataclasses.replace(final, covariance=covariance)
    curve = CostCurve(np.linspace(-0.03, 0.03, 3), np.zeros(3))
    result = evaluated(data, wide, curve, CalibrationConfig())
    *_, column, row = result.lens
    assert 0.9 * sigma < column.sigma < sigma
    assert row.sigma == pytest.approx(math.sqrt(covariance[CENTER + 1, CENTER + 1]), rel=0.1)
    # Moved to the middle by all but a hundredth.
    moved = final.unknowns.parameters[CENTER]
    assert column.value - data.camera.cx == pytest.approx(0.01 * moved, abs=0.02 * abs(moved))


@pytest.mark.parametrize('sign', [1.0, -1.0])
def test_the_interval_between_frames_bounds_the_readout(sign):
    """Against draws from the normal distribution of which those beyond the bound are left out."""
    interval, sigma = undisturbed()[1].interval, 1e-3
    result, final = evaluated_at(sign * (interval + 5e-4), sigma)
    drawn_at = final.unknowns.parameters[READOUT] + sigma * np.random.default_rng(
        5).standard_normal(1_000_000)
    mean = float(drawn_at[np.abs(drawn_at) <= interval].mean())
    readout, moved = result.readout_time, mean - final.unknowns.parameters[READOUT]
    assert readout.observable and abs(readout.value) < interval
    assert readout.value == pytest.approx(mean, abs=5e-6)
    assert readout.sigma == pytest.approx(sigma, rel=1e-6)
    # What is correlated with it follows: the middle row, and so the first one; the axes.
    middle = final.unknowns.parameters[OFFSET] - 0.5 * moved
    first = 0.5 * (recorded().truth.height - 1) / recorded().truth.height
    assert result.time_offset.value == pytest.approx(middle - first * mean, abs=1e-5)
    turn = Rotation.from_matrix(result.R_cam_imu.T @ final.unknowns.R_imu_cam.T).as_rotvec()
    np.testing.assert_allclose(turn, [0.1 * moved, 0.0, 0.0], atol=1e-6)
    assert any(f'{1e3 * interval:.1f} ms between frames' in text for text in result.warnings)
    text = parameter_file(result, 'A test.', camera=camera_of(recorded().truth), compressed=False)
    assert f'readout_time: {abs(readout.value):.6f}'.rstrip('0') in text


def test_the_interval_does_not_touch_a_readout_far_below():
    result, final = evaluated_at(0.02, 1e-3)
    assert result.readout_time.value == pytest.approx(0.02, abs=1e-12)
    np.testing.assert_allclose(result.R_cam_imu, final.unknowns.R_imu_cam.T, atol=1e-12)
    assert result.warnings == ()


def test_a_readout_for_certain_beyond_the_interval_is_refused():
    with pytest.raises(InputError, match='which no camera can do'):
        evaluated_at(0.037, 1e-3)


# -- parts of a recording ----------------------------------------------------------------------

def test_stretches_of_a_simulated_camera_agree(tmp_path):
    source = recorded()
    recording = CalibrationInput(source.tracks, source.gyro, camera_of(source.truth), True, {})
    refused: list[str] = []
    parts = list(benchmark.calibrated_parts('bag', recording, 1.6, refused.append))
    assert len(parts) == 2 and not refused
    text = benchmark.write_parts_report(tmp_path, benchmark.quantities_of(parts))
    assert 'gyro bias, z [mrad/s]' in text
    with (tmp_path / 'calibration_stretches.csv').open(newline='') as file:
        found = [row for row in csv.DictReader(file) if row['name'].startswith('read')]
    assert len(found) == 2
    for row in found:
        assert abs(float(row['value']) - 20.0) < 4.5 * float(row['sigma'])
    assert list(benchmark.calibrated_parts('bag', recording, 0.5, refused.append)) == []
    assert len(refused) == 6 and 'too short' in refused[0]


def mean_of(samples: np.ndarray, groups: np.ndarray) -> tuple[float, float]:
    """Mean and its sigma: the score of sample x is mean - x, its curvature 1."""
    mean = float(samples.mean())
    covariance = fitting.jackknife(
        (mean - samples)[:, None], np.ones((len(samples), 1, 1)), groups, np.zeros(1))
    return mean, math.sqrt(covariance[0, 0])


def test_jackknife_of_single_samples_is_the_variance_of_the_mean():
    samples = np.random.default_rng(0).standard_normal(12)
    _, sigma = mean_of(samples, np.arange(12))
    student = t.ppf(norm.cdf(1.0), 11)
    assert sigma == pytest.approx(student * samples.std(ddof=1) / math.sqrt(12), rel=1e-9)


def test_jackknife_covers_errors_that_a_group_has_in_common():
    rng = np.random.default_rng(1)
    groups = np.repeat(np.arange(10), 20)
    inside = 0
    for _ in range(400):
        samples = np.repeat(rng.standard_normal(10), 20) + 0.3 * rng.standard_normal(200)
        mean, sigma = mean_of(samples, groups)
        inside += abs(mean) < sigma
    # 68.3 % with a standard error of 2.3 %.
    assert 0.61 < inside / 400 < 0.75


def test_prior_counts_as_known():
    covariance = fitting.jackknife(np.zeros((10, 1)), np.zeros((10, 1, 1)), np.arange(10),
                                   np.array([4.0]))
    assert covariance[0, 0] == pytest.approx(0.25)


def test_stretches_last_a_second_but_are_ten_at_least():
    assert len(np.unique(fitting.stretches(np.linspace(0.0, 3.0, 100)))) == 10
    groups = fitting.stretches(np.linspace(5.0, 25.0, 1001))
    assert len(np.unique(groups)) == 20
    assert (np.diff(groups) >= 0).all() and abs(np.bincount(groups) - 50).max() <= 1


def test_noise_density_of_a_moving_gyro():
    rng = np.random.default_rng(2)
    times = np.arange(2000) / 200.0
    swing = np.sin(2.0 * np.pi * np.outer(times, [1.0, 0.7, 1.3]))
    rates = swing + 3e-4 * math.sqrt(200.0) * rng.standard_normal((2000, 3))
    assert noise_density(times, rates) == pytest.approx(3e-4, rel=0.1)
