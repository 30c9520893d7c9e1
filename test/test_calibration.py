"""Calibration on simulated tracks: figures, sigmas, verdicts and refusals."""

from __future__ import annotations

import dataclasses
from functools import lru_cache
import math

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from rs_relpose_lab.experiments.calibration_tracks import (
    about_one_axis,
    drawn,
    record,
    Recorded,
    Truth,
)
from rs_relpose_ros.calibrate.alignment import find_starts, Start
from rs_relpose_ros.calibrate.axis_maps import axis_maps, nearest_axis_map
from rs_relpose_ros.calibrate.coplanarity import EXPOSURE, GLOBAL, Problem, Unknowns, View
from rs_relpose_ros.calibrate.fit import evaluate, initial, LOCAL, redirected, stepped
from rs_relpose_ros.calibrate.gyro_path import GyroPath, GyroSeries
from rs_relpose_ros.calibrate.observations import Observations
from rs_relpose_ros.calibrate.procedure import calibrate
from rs_relpose_ros.calibrate.report import parameter_file
from rs_relpose_ros.calibrate.result import CalibrationResult
from rs_relpose_ros.calibrate.tracks import make_pairs, Tracks
from rs_relpose_ros.config.parameter_file import read_parameters
from rs_relpose_ros.errors import InputError
from rs_relpose_ros.geometry.camera import RollingShutterCamera
from rs_relpose_ros.geometry.distortion.models import DISTORTION_MODELS

SHORT = {'frames': 120}
# Coefficients of each camera model that bend a picture visibly.
MODELS = {'plumb_bob': (-0.2, 0.05, 0.001, -0.001, 0.0),
          'rational_polynomial': (0.3, 0.1, 0.001, -0.001, 0.0, 0.4, 0.15, 0.01),
          'equidistant': (0.02, -0.01, 0.003, 0.0)}


def camera_of(truth: Truth, focal: float | None = None) -> RollingShutterCamera:
    f = truth.focal if focal is None else focal
    return RollingShutterCamera(
        width=truth.width, height=truth.height, fx=f, fy=f, cx=0.5 * (truth.width - 1),
        cy=0.5 * (truth.height - 1), readout_time=0.0)


@lru_cache(maxsize=1)
def usual() -> tuple[Recorded, CalibrationResult]:
    rng = np.random.default_rng(11)
    recorded = record(drawn(rng, readout_time=0.022, **SHORT), rng)
    return recorded, calibrate(recorded.tracks, recorded.gyro, camera_of(recorded.truth))


def rotation_error(result: CalibrationResult, truth: Truth) -> float:
    return math.degrees(Rotation.from_matrix(result.R_cam_imu @ truth.R_cam_imu.T).magnitude())


def assert_right(result: CalibrationResult, truth: Truth) -> None:
    """Within the issue's limits for 300 frames, twice as wide for the shorter ones here."""
    assert abs(result.readout_time.value - truth.readout_time) < 1e-3
    assert abs(result.time_offset.value - truth.time_offset) < 2e-3
    assert rotation_error(result, truth) < 0.6
    biases = [bias.value for bias in result.gyro_bias]
    np.testing.assert_allclose(biases, truth.gyro_bias, atol=5e-3)


def test_usual_recording_is_calibrated_from_nothing():
    recorded, result = usual()
    assert_right(result, recorded.truth)
    assert result.observable
    assert result.shutter == 'rolling'
    np.testing.assert_array_equal(result.axis_map, np.rint(recorded.truth.R_cam_imu))
    assert result.focal_factor is None and result.offset_by_interval is None


def test_sigmas_are_of_the_size_of_the_errors():
    recorded, result = usual()
    truth = recorded.truth
    z = [(result.readout_time.value - truth.readout_time) / result.readout_time.sigma,
         (result.time_offset.value - truth.time_offset) / result.time_offset.sigma,
         *((bias.value - true) / bias.sigma
           for bias, true in zip(result.gyro_bias, truth.gyro_bias, strict=True))]
    assert np.abs(z).max() < 4.5
    assert np.abs(z).max() > 0.1     # neither claimed ten times too large


def test_cost_curve_has_its_minimum_at_the_read_out_time():
    recorded, result = usual()
    curve = result.curve
    best = curve.readout_times[np.argmin(curve.costs)]
    assert best == pytest.approx(recorded.truth.readout_time, abs=4e-3)
    assert curve.costs[np.argmin(np.abs(curve.readout_times))] > 20.0


def test_parameter_file_is_the_nodes(tmp_path):
    recorded, result = usual()
    path = tmp_path / 'calibration.yaml'
    camera = camera_of(recorded.truth)
    path.write_text(parameter_file(result, 'A test.', camera=camera, compressed=True))
    # The CameraInfo has the focal length.
    assert not read_parameters(path).intrinsics.given
    sensor = read_parameters(path).sensor
    assert sensor.readout_time == pytest.approx(result.readout_time.value, abs=1e-6)
    assert sensor.time_offset == pytest.approx(result.time_offset.value, abs=1e-6)
    assert sensor.readout_direction == 'down'
    assert sensor.stamp_row == 'first'
    np.testing.assert_allclose(sensor.R_cam_imu, result.R_cam_imu, atol=1e-6)


def test_camera_read_upwards_with_unknown_focal_length(tmp_path):
    rng = np.random.default_rng(12)
    truth = drawn(rng, readout_time=0.02, focal=900.0, **SHORT)
    truth = dataclasses.replace(truth, readout_time=-0.02)
    recorded = record(truth, rng)
    guess = 0.8 * truth.width
    camera = camera_of(truth, guess)
    result = calibrate(recorded.tracks, recorded.gyro, camera, focal_known=False)
    assert_right(result, truth)
    assert result.focal_factor.value * guess == pytest.approx(900.0, rel=0.02)
    path = tmp_path / 'calibration.yaml'
    path.write_text(parameter_file(result, 'A test.', camera=camera, compressed=False))
    told = read_parameters(path)
    assert told.sensor.readout_direction == 'up'
    # What the node and replay take where no CameraInfo tells it.
    intrinsics = told.intrinsics.of_image(camera.width, camera.height)
    assert intrinsics.fx == intrinsics.fy == pytest.approx(
        result.focal_factor.value * guess, abs=0.01)
    assert (intrinsics.cx, intrinsics.cy) == (camera.cx, camera.cy)
    # Left out, and named, where the recording does not tell it.
    unknown = dataclasses.replace(result, focal_factor=dataclasses.replace(
        result.focal_factor, observable=False, remark='too slow'))
    text = parameter_file(unknown, 'A test.', camera=camera, compressed=False)
    assert 'camera_matrix (too slow)' in text and 'camera_matrix:' not in text


@pytest.mark.long
def test_slow_camera_is_not_confidently_wrong():
    rng = np.random.default_rng(17)
    truth = drawn(rng, readout_time=0.02, speed=0.2, rotation_rate=math.radians(6.0),
                  pixel_noise=0.4, gyro_bias=(0.004, -0.003, 0.002), **SHORT)
    recorded = record(truth, rng)
    result = calibrate(recorded.tracks, recorded.gyro, camera_of(truth))
    readout = result.readout_time
    assert abs(readout.value - truth.readout_time) < 4.0 * readout.sigma
    # A fifth of the rotation tells a fifth as much.
    assert readout.sigma > 3.0 * usual()[1].readout_time.sigma


@pytest.mark.long
def test_noise_does_not_make_the_read_out_time_longer():
    """Freedom that grows with the read-out time would."""
    rng = np.random.default_rng(18)
    truth = drawn(rng, readout_time=0.02, pixel_noise=1.0, outliers=0.25, **SHORT)
    recorded = record(truth, rng)
    result = calibrate(recorded.tracks, recorded.gyro, camera_of(truth))
    assert result.readout_time.value == pytest.approx(0.02, abs=1.5e-3)


def test_global_shutter_is_told_through_a_fisheye():
    """All rows of a global shutter are of one instant: its pixels may be bent afterwards."""
    rng = np.random.default_rng(13)
    recorded = record(drawn(rng, readout_time=0.0, fps=30.0, **SHORT), rng)
    pinhole = camera_of(recorded.truth)
    fisheye = dataclasses.replace(pinhole, distortion_model='equidistant',
                                  distortion=MODELS['equidistant'])
    bent = dataclasses.replace(recorded.tracks, points=fisheye.project(
        pinhole.unproject(recorded.tracks.points)))
    result = calibrate(bent, recorded.gyro, fisheye)
    assert_right(result, recorded.truth)
    assert result.shutter == 'global'
    assert 'readout_time: 0.0' in parameter_file(result, 'A test.', camera=fisheye,
                                                 compressed=False)


def test_offset_that_follows_the_exposure_is_reported():
    rng = np.random.default_rng(14)
    truth = drawn(rng, readout_time=0.02, fps=30.0, exposure_slope=-0.5, long_interval=1.2,
                  frames=160)
    recorded = record(truth, rng)
    result = calibrate(recorded.tracks, recorded.gyro, camera_of(truth))
    slope = result.offset_by_interval
    assert slope is not None
    assert slope.value == pytest.approx(-0.5, abs=max(4.5 * slope.sigma, 0.05))
    assert slope.sigma < 0.15


def test_rotation_about_one_axis_is_not_observable():
    rng = np.random.default_rng(15)
    recorded = record(drawn(rng, readout_time=0.02, **SHORT), rng, about_one_axis(0, 6.0))
    camera = camera_of(recorded.truth)
    result = calibrate(recorded.tracks, recorded.gyro, camera)
    assert not result.rotation.observable and not result.observable
    assert 'one axis only, nearly y (yaw)' in result.rotation.remark
    assert 'x (pitch)' in result.rotation.remark.partition('turn about')[2]
    assert 'left out: quat_cam_imu_xyzw' in ' '.join(
        parameter_file(result, 'A test.', camera=camera, compressed=False).replace(
            '\n# ', ' ').split())


def few_frames(recorded: Recorded, count: int) -> Tracks:
    tracks = recorded.tracks
    kept = tracks.frames < count
    return Tracks(tracks.stamps_ns[:count], tracks.frames[kept], tracks.ids[kept],
                  tracks.points[kept])


def with_tracks(recorded: Recorded, kept: np.ndarray | slice, ids: np.ndarray) -> Tracks:
    tracks = recorded.tracks
    return Tracks(tracks.stamps_ns, tracks.frames[kept], ids[kept], tracks.points[kept])


UNUSABLE = {
    r'too short: 10 frames.*Record 10 s or more': lambda r: (few_frames(r, 10), r.gyro),
    r'hardly turns.*all three axes': lambda r: (r.tracks, GyroSeries(
        r.gyro.stamps_ns, 0.05 + 1e-3 * np.random.default_rng(0).standard_normal(
            r.gyro.rates.shape))),
    r'too little to follow.*texture': lambda r: (
        with_tracks(r, r.tracks.ids % 30 == 0, r.tracks.ids), r.gyro),
    r'blurred.*short exposure': lambda r: (
        with_tracks(r, slice(None), np.arange(len(r.tracks.ids))), r.gyro),
    r'the gyro covers 0.0 s': lambda r: (r.tracks, GyroSeries(
        r.gyro.stamps_ns + 3_600_000_000_000, r.gyro.rates)),
}


@pytest.mark.parametrize('message', UNUSABLE)
def test_unusable_recordings_are_refused_with_what_to_record(message):
    recorded, _ = usual()
    with pytest.raises(InputError, match=message):
        calibrate(*UNUSABLE[message](recorded), camera_of(recorded.truth))


def test_readout_longer_than_the_interval_is_refused():
    rng = np.random.default_rng(16)
    # No camera can do this: the simulation can.
    truth = dataclasses.replace(drawn(rng, readout_time=0.03, fps=30.0, frames=70),
                                readout_time=0.045)
    recorded = record(truth, rng)
    with pytest.raises(InputError, match='longer than the interval'):
        calibrate(recorded.tracks, recorded.gyro, camera_of(truth))


# -- parts ------------------------------------------------------------------------------------


def test_every_axis_map_is_recognised():
    maps = axis_maps()
    assert len({m.tobytes() for m in maps}) == 24
    np.testing.assert_allclose(np.linalg.det(maps), 1.0)
    tilt = Rotation.from_rotvec([0.1, -0.2, 0.15]).as_matrix()
    for matrix in maps:
        np.testing.assert_array_equal(nearest_axis_map(tilt @ matrix), matrix)


def coarse_start(R: np.ndarray, axes: np.ndarray, unit: float) -> Start:
    """Of a gyro 50 ms ahead that tells its rates in `unit` rad/s, turning about `axes` (3,)."""
    rng = np.random.default_rng(3)
    times = np.arange(0.0, 6.0, 0.005)
    rates = axes * np.sin(2.0 * times[:, None] * [1.0, 1.7, 2.3]) * 0.4
    begins = np.linspace(0.5, 5.0, 120)
    ends = begins + 0.033
    seen = np.stack([np.interp(0.5 * (begins + ends) + 0.05, times, rates[:, i])
                     for i in range(3)], axis=1) @ R.T + 0.01 * rng.standard_normal((120, 3))
    start, = find_starts(seen, begins, ends, times, rates / unit, max_offset=0.2, step=5e-3,
                         focal_factors=np.ones(1), count=1, scale_known=False)
    return start


@pytest.mark.parametrize('unit', [1.0, math.radians(1.0)])
def test_search_tells_the_unit_of_the_gyro(unit):
    R = Rotation.from_rotvec([0.5, -1.2, 2.0]).as_matrix()
    start = coarse_start(R, np.ones(3), unit)
    assert start.offset == pytest.approx(0.05, abs=5e-3)
    assert start.scale == pytest.approx(unit, rel=0.02)
    assert start.explained > 0.97
    assert Rotation.from_matrix(start.R_cam_imu @ R.T).magnitude() < 0.03


def test_search_from_one_axis_takes_the_rotation_next_to_an_axis_map():
    tilt = Rotation.from_rotvec([math.radians(30.0), 0.0, 0.0]).as_matrix()
    start = coarse_start(tilt, np.array([0.0, 1.0, 0.0]), 1.0)
    assert start.explained > 0.97
    np.testing.assert_allclose(start.R_cam_imu, tilt, atol=0.03)


def test_gyro_path_is_the_rotation_of_an_even_turn():
    times = np.linspace(0.0, 2.0, 41)
    path = GyroPath.integrated(times, np.tile([0.3, -0.4, 0.5], (41, 1)), [0.1, 0.0, 0.0])
    at = np.array([0.0, 0.333, 1.7])
    expected = Rotation.from_rotvec(at[:, None] * [0.2, -0.4, 0.5]).as_matrix()
    np.testing.assert_allclose(path.at(at), expected, atol=1e-9)


@lru_cache(maxsize=1)
def few_pairs() -> tuple[Problem, Unknowns, Truth]:
    """Pairs, and a calibration a little off the truth."""
    rng = np.random.default_rng(1)
    recorded = record(drawn(rng, frames=10, outliers=0.0), rng)
    truth, tracks = recorded.truth, recorded.tracks
    pairs = make_pairs(tracks, (2,), max_matches=60, min_matches=20, max_interval=0.1, rng=rng)
    problem = Observations.of(tracks, recorded.gyro, camera_of(truth)).problem(pairs, 0.05)
    # As of intervals that vary.
    covariates = 0.01 * np.arange(len(pairs))
    problem = problem._replace(view1=problem.view1._replace(covariates=covariates),
                               view2=problem.view2._replace(covariates=2.0 * covariates))
    middle_row = 0.5 * (truth.height - 1) / truth.height
    unknowns = initial(
        problem, truth.R_cam_imu.T, truth.time_offset + middle_row * truth.readout_time + 1e-3,
        truth.readout_time + 2e-3, np.array(truth.gyro_bias), 0.01, noise=1.0)
    return problem, unknowns, truth


def test_gradient_is_that_of_finite_differences():
    problem, unknowns, _ = few_pairs()
    # At the optimum of the pairs' own unknowns the total derivative is the partial one.
    still = np.zeros(GLOBAL)
    for _ in range(40):
        unknowns = stepped(unknowns, still, 0.5 * evaluate(problem, unknowns).local_step(still))
    analytic = evaluate(problem, unknowns).score.sum(axis=0)

    def cost(step: np.ndarray) -> float:
        moved = stepped(unknowns, step, np.zeros((problem.pairs, LOCAL)))
        return evaluate(problem, moved, derivatives=False).cost

    h = 1e-6
    numeric = np.array([(cost(h * unit) - cost(-h * unit)) / (2 * h) for unit in np.eye(GLOBAL)])
    exact = np.arange(GLOBAL) != EXPOSURE
    np.testing.assert_allclose(analytic[exact], numeric[exact], rtol=2e-3,
                               atol=1e-4 * np.abs(numeric).max())
    # The rotation that an exposure makes is of first order in the turn within it.
    assert analytic[EXPOSURE] == pytest.approx(numeric[EXPOSURE], rel=0.03)


def test_residual_is_the_distance_in_pixels_to_the_nearest_pair_that_fits():
    problem, unknowns, truth = few_pairs()
    residuals = evaluate(problem, unknowns, derivatives=False).residuals
    # Moved against its gradient by the residual, a match of two ends fits: first order in 0.3 px.
    h, n = 1e-4, 17
    gradient = np.zeros(4)
    for k in range(4):
        name = f'view{1 + k // 2}'
        view = getattr(problem, name)
        points = view.points.copy()
        points[n, k % 2] += h / truth.focal
        moved = problem._replace(**{name: view._replace(points=points)})
        change = evaluate(moved, unknowns, derivatives=False).residuals[n] - residuals[n]
        gradient[k] = change / h
    assert np.linalg.norm(gradient) == pytest.approx(1.0, abs=0.01)


def test_direction_is_that_of_the_walk():
    problem, unknowns, _ = few_pairs()
    # From directions at right angles to the best ones, the search comes back to them.
    lost = unknowns._replace(direction=np.tile([0.0, 0.0, 1.0], (problem.pairs, 1)))
    found = redirected(problem, lost)
    assert np.abs((found.direction * unknowns.direction).sum(axis=1)).min() > 0.99
    assert evaluate(problem, found).cost < evaluate(problem, lost).cost


@pytest.mark.parametrize('model', DISTORTION_MODELS)
def test_fit_sees_the_same_rays_through_every_camera_model(model):
    """Normalised points of the pixels of a distorted camera, and their derivative by them."""
    recorded, _ = usual()
    pinhole = camera_of(recorded.truth)
    tracks = few_frames(recorded, 3)
    camera = dataclasses.replace(pinhole, distortion_model=model, distortion=MODELS[model])

    def view(points: np.ndarray, camera: RollingShutterCamera) -> View:
        seen = dataclasses.replace(tracks, points=points)
        data = Observations.of(seen, recorded.gyro, camera)
        pairs = make_pairs(data.tracks, (1,), max_matches=500, min_matches=1, max_interval=1.0,
                           rng=np.random.default_rng(0))
        return data.problem(pairs, 0.0).view1

    straight = view(tracks.points, pinhole).points
    pixels = camera.project(pinhole.unproject(tracks.points))
    np.testing.assert_allclose(view(pixels, camera).points, straight, atol=1e-9)
    h, by_pixel = 1e-3, view(pixels, camera).by_pixel
    for k in range(2):
        step = h * np.eye(2)[k]
        change = view(pixels + step, camera).points - view(pixels - step, camera).points
        np.testing.assert_allclose(by_pixel[:, :, k], change / (2.0 * h), atol=1e-9)


def test_pairs_have_the_tracks_points_in_common():
    tracks = Tracks([0, 10, 20, 30], [0, 0, 1, 1, 1, 3, 3], [5, 6, 6, 5, 7, 7, 6],
                    np.arange(14.0).reshape(7, 2))
    pairs = make_pairs(tracks, (1, 2), max_matches=9, min_matches=1, max_interval=1.0,
                       rng=np.random.default_rng(0))
    assert list(zip(pairs.first, pairs.second, strict=True)) == [(0, 1), (1, 3)]
    np.testing.assert_array_equal(pairs.begin, [0, 2, 4])
    np.testing.assert_array_equal(pairs.points1, tracks.points[[0, 1, 2, 4]])
    np.testing.assert_array_equal(pairs.points2, tracks.points[[3, 2, 6, 5]])
