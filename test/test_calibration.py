"""Calibration on simulated tracks: values, observability, refusals, and stamps of the frames."""

import dataclasses
from functools import lru_cache
import math
from pathlib import Path

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from rs_relpose_lab.experiments import calibration_tracks
from rs_relpose_lab.experiments.calibration_tracks import drawn, record, Recorded, Truth
from rs_relpose_ros.calibrate import coplanarity, start
from rs_relpose_ros.calibrate.coplanarity import EXPOSURE, GLOBAL
from rs_relpose_ros.calibrate.fit import evaluate, initial, LOCAL, redirected, stepped
from rs_relpose_ros.calibrate.observations import (
    frame_times,
    make_pairs,
    Observations,
    PairSelection,
    Tracks,
    Varying,
)
from rs_relpose_ros.calibrate.procedure import calibrate
from rs_relpose_ros.calibrate.result import CalibrationResult, Estimate, parameter_file, report
from rs_relpose_ros.config.files import read_parameters
from rs_relpose_ros.config.settings import Parameters
from rs_relpose_ros.errors import InputError
from rs_relpose_ros.geometry.camera import DISTORTION_MODELS, RollingShutterCamera
from rs_relpose_ros.geometry.timing import NANOSECONDS

# Coefficients of each camera model that bend a picture visibly.
MODELS = {'plumb_bob': (-0.2, 0.05, 0.001, -0.001, 0.0),
          'rational_polynomial': (0.3, 0.1, 0.001, -0.001, 0.0, 0.4, 0.15, 0.01),
          'equidistant': (0.02, -0.01, 0.003, 0.0)}


def camera_of(truth: Truth, focal: float | None = None) -> RollingShutterCamera:
    f = truth.focal if focal is None else focal
    return RollingShutterCamera(
        width=truth.width, height=truth.height, fx=f, fy=f, cx=0.5 * (truth.width - 1),
        cy=0.5 * (truth.height - 1), readout_time=0.0)


def simulated(seed: int, movement: object = None, **values: object) -> Recorded:
    rng = np.random.default_rng(seed)
    truth = drawn(rng, **({'readout_time': 0.02, 'frames': 90} | values))
    return record(truth, rng) if movement is None else record(truth, rng, movement)


def calibrated(recorded: Recorded, **options: object) -> CalibrationResult:
    return calibrate(recorded.tracks, recorded.gyro, camera_of(recorded.truth), **options)


@lru_cache(maxsize=1)
def usual() -> tuple[Recorded, CalibrationResult]:
    recorded = simulated(11, readout_time=0.022)
    return recorded, calibrated(recorded)


@lru_cache(maxsize=1)
def one_axis() -> Recorded:
    return simulated(15, calibration_tracks.about_one_axis(0, 6.0), frames=70)


def assert_right(result: CalibrationResult, truth: Truth) -> None:
    """Within the accuracy of 300 frames, doubled for the shorter recordings here."""
    assert abs(result.readout_time.value - truth.readout_time) < 1e-3
    assert abs(result.time_offset.value - truth.time_offset) < 2e-3
    turn = Rotation.from_matrix(result.R_cam_imu @ truth.R_cam_imu.T).magnitude()
    assert math.degrees(turn) < 0.6
    biases = [bias.value for bias in result.gyro_bias]
    np.testing.assert_allclose(biases, truth.gyro_bias, atol=5e-3)


def written(result: CalibrationResult, camera: RollingShutterCamera,
            folder: Path) -> tuple[str, Parameters]:
    """Text of the parameter file, and what the node reads from it."""
    path = folder / 'calibration.yaml'
    path.write_text(parameter_file(result, 'A test.', camera=camera, compressed=False))
    return path.read_text(), read_parameters(path)


def test_usual_recording_is_calibrated_from_nothing(tmp_path):
    recorded, result = usual()
    assert_right(result, recorded.truth)
    assert result.observable
    assert result.shutter == 'rolling'
    np.testing.assert_array_equal(result.axis_map, np.rint(recorded.truth.R_cam_imu))
    assert result.lens is None and result.offset_by_interval is None
    curve = result.curve
    best = curve.readout_times[np.argmin(curve.costs)]
    assert best == pytest.approx(recorded.truth.readout_time, abs=4e-3)
    assert curve.costs[np.argmin(np.abs(curve.readout_times))] > 20.0
    # The CameraInfo has the focal length.
    _, configured = written(result, camera_of(recorded.truth), tmp_path)
    sensor = configured.sensor
    assert not configured.intrinsics.given
    assert sensor.readout_time == pytest.approx(result.readout_time.value, abs=1e-6)
    assert sensor.time_offset == pytest.approx(result.time_offset.value, abs=1e-6)
    assert (sensor.readout_direction, sensor.stamp_row) == ('down', 'first')
    np.testing.assert_allclose(sensor.R_cam_imu, result.R_cam_imu, atol=1e-6)


def test_sigmas_are_of_the_size_of_the_errors():
    recorded, result = usual()
    truth = recorded.truth
    z = [(result.readout_time.value - truth.readout_time) / result.readout_time.sigma,
         (result.time_offset.value - truth.time_offset) / result.time_offset.sigma,
         *((bias.value - true) / bias.sigma
           for bias, true in zip(result.gyro_bias, truth.gyro_bias, strict=True))]
    assert np.abs(z).max() < 4.5
    assert np.abs(z).max() > 0.1     # neither claimed ten times too large


def test_camera_read_upwards_with_unknown_focal_length(tmp_path):
    rng = np.random.default_rng(12)
    truth = dataclasses.replace(drawn(rng, readout_time=0.02, focal=900.0, frames=120),
                                readout_time=-0.02)
    recorded = record(truth, rng)
    guess = 0.8 * truth.width
    camera = camera_of(truth, guess)
    result = calibrate(recorded.tracks, recorded.gyro, camera, focal_known=False)
    assert_right(result, truth)
    assert result.lens.focal_factor.value * guess == pytest.approx(900.0, rel=0.02)
    _, configured = written(result, camera, tmp_path)
    assert configured.sensor.readout_direction == 'up'
    # As in the node and replay without a CameraInfo.
    intrinsics = configured.intrinsics.of_image(camera.width, camera.height)
    assert intrinsics.fx == intrinsics.fy == pytest.approx(
        result.lens.focal_factor.value * guess, abs=0.01)
    for found, estimate, true in ((intrinsics.distortion[0], result.lens.radial, 0.0),
                                  (intrinsics.cx, result.lens.column, camera.cx),
                                  (intrinsics.cy, result.lens.row, camera.cy)):
        assert found == pytest.approx(estimate.value, abs=0.01)
        assert abs(found - true) < 4.0 * estimate.sigma
    # Left out, and named, if it is not determined.
    unknown = dataclasses.replace(result, lens=result.lens._replace(focal_factor=Estimate(
        1.0, 1.0, observable=False, determined=False, remark='too slow')))
    text, _ = written(unknown, camera, tmp_path)
    assert 'camera_matrix (too slow)' in text and 'camera_matrix:' not in text


@pytest.mark.parametrize(('model', 'coefficients'), [
    ('plumb_bob', (-0.15, 0.0, 0.0, 0.0, 0.0)), ('equidistant', (0.03, 0.0, 0.0, 0.0))])
def test_lens_is_estimated(model, coefficients, tmp_path):
    """All rows of a global shutter have one time: its pixels may be distorted afterwards.

    All of the lens is 10 px off.
    """
    recorded = simulated(21, readout_time=0.0, fps=30.0)
    pinhole = camera_of(recorded.truth)
    lens = dataclasses.replace(pinhole, distortion_model=model, distortion=coefficients,
                               cx=pinhole.cx + 10.0, cy=pinhole.cy - 10.0)
    bent = dataclasses.replace(recorded.tracks, points=lens.project(
        pinhole.unproject(recorded.tracks.points)))
    guess = dataclasses.replace(camera_of(recorded.truth, 0.8 * recorded.truth.width),
                                distortion_model=model, distortion=(0.0,) * len(coefficients))
    result = calibrate(bent, recorded.gyro, guess, focal_known=False)
    assert_right(result, recorded.truth)
    assert result.shutter == 'global'
    _, configured = written(result, guess, tmp_path)
    assert configured.sensor.readout_time == 0.0
    sigmas = configured.intrinsics
    found = sigmas.of_image(guess.width, guess.height)
    assert found.distortion_model == model
    assert found.fx == pytest.approx(lens.fx, rel=0.01)
    assert 0.0 < sigmas.distortion_sigma < 0.02
    assert abs(found.distortion[0] - coefficients[0]) < 4.5 * sigmas.distortion_sigma
    assert 0.0 < sigmas.principal_point_sigma < 5.0
    assert abs(found.cx - lens.cx) < 4.5 * sigmas.principal_point_sigma
    assert abs(found.cy - lens.cy) < 4.5 * sigmas.principal_point_sigma


def test_rotation_about_one_axis_is_not_observable(tmp_path):
    recorded = one_axis()
    result = calibrated(recorded)
    assert not result.rotation.observable and not result.observable
    assert 'nearly y (yaw)' in result.rotation.remark
    assert 'x (pitch)' in result.rotation.remark.partition('rotate about')[2]
    text, _ = written(result, camera_of(recorded.truth), tmp_path)
    assert 'quat_cam_imu_xyzw' in text and 'quat_cam_imu_xyzw:' not in text


def test_a_transform_gives_the_rotation_that_the_motion_does_not():
    """Of a robot on wheels; one that contradicts the images is not used."""
    recorded = one_axis()
    true = Rotation.from_matrix(recorded.truth.R_cam_imu)
    result = calibrated(recorded, quat_prior=(
        Rotation.from_rotvec([0.03, -0.04, 0.02]) * true).as_quat())
    assert result.complete and result.rotation.determined
    apart = (Rotation.from_matrix(result.R_cam_imu) * true.inv()).as_rotvec()
    assert (np.abs(apart) < 3.0 * result.rotation_sigma).all()
    assert 0.04 < result.rotation_sigma.max() < 0.09
    other = calibrated(recorded, quat_prior=(
        Rotation.from_rotvec([0.0, 0.0, 1.5]) * true).as_quat())
    assert not other.rotation.determined
    recorded, usual_result = usual()
    same = calibrated(recorded, quat_prior=(
        Rotation.from_rotvec([0.0, 0.5, 0.0]) * Rotation.from_matrix(
            recorded.truth.R_cam_imu)).as_quat())
    np.testing.assert_array_equal(same.R_cam_imu, usual_result.R_cam_imu)


def few_frames(tracks: Tracks, count: int) -> Tracks:
    kept = tracks.frames < count
    return Tracks(tracks.stamps_ns[:count], tracks.frames[kept], tracks.ids[kept],
                  tracks.points[kept])


def few_points(tracks: Tracks) -> Tracks:
    kept = tracks.ids % 30 == 0
    return Tracks(tracks.stamps_ns, tracks.frames[kept], tracks.ids[kept], tracks.points[kept])


UNUSABLE = {
    'too short: 10 frames': lambda tracks, gyro: (few_frames(tracks, 10), gyro),
    'hardly rotates': lambda tracks, gyro: (tracks, start.GyroSeries(
        gyro.stamps_ns, 0.05 + 1e-3 * np.random.default_rng(0).standard_normal(
            gyro.rates.shape))),
    'too few points': lambda tracks, gyro: (few_points(tracks), gyro),
    'short exposure': lambda tracks, gyro: (
        dataclasses.replace(tracks, ids=np.arange(len(tracks.ids))), gyro),
    'the gyro covers 0.0 s': lambda tracks, gyro: (tracks, start.GyroSeries(
        gyro.stamps_ns + 3600 * NANOSECONDS, gyro.rates)),
}


@pytest.mark.parametrize('message', UNUSABLE)
def test_unusable_recordings_are_refused(message):
    recorded, _ = usual()
    with pytest.raises(InputError, match=message):
        calibrate(*UNUSABLE[message](recorded.tracks, recorded.gyro), camera_of(recorded.truth))


def test_readout_longer_than_the_interval_is_refused():
    rng = np.random.default_rng(16)
    # No camera can do this: the simulation can.
    truth = dataclasses.replace(drawn(rng, readout_time=0.03, fps=30.0, frames=70),
                                readout_time=0.045)
    with pytest.raises(InputError, match='longer than the interval'):
        calibrated(record(truth, rng))


# -- parts ------------------------------------------------------------------------------------

def test_every_axis_map_is_recognised():
    maps = start.axis_maps()
    assert len({m.tobytes() for m in maps}) == 24
    np.testing.assert_allclose(np.linalg.det(maps), 1.0)
    tilt = Rotation.from_rotvec([0.1, -0.2, 0.15]).as_matrix()
    for matrix in maps:
        np.testing.assert_array_equal(start.nearest_axis_map(tilt @ matrix), matrix)


@pytest.mark.parametrize('rotation, axes', [
    ([0.5, -1.2, 2.0], np.ones(3)),
    ([math.radians(30.0), 0.0, 0.0], np.array([0.0, 1.0, 0.0]))],
    ids=['three axes', 'of one axis the rotation nearest to an axis map'])
def test_search_finds_offset_and_rotation(rotation, axes):
    """Of a gyro 50 ms ahead."""
    R, rng = Rotation.from_rotvec(rotation).as_matrix(), np.random.default_rng(3)
    times = np.arange(0.0, 6.0, 0.005)
    rates = axes * np.sin(2.0 * times[:, None] * [1.0, 1.7, 2.3]) * 0.4
    begins = np.linspace(0.5, 5.0, 120)
    ends = begins + 0.033
    estimated = np.stack([np.interp(0.5 * (begins + ends) + 0.05, times, rates[:, i])
                          for i in range(3)], axis=1) @ R.T + 0.01 * rng.standard_normal((120, 3))
    found, = start.find_starts(estimated, begins, ends, times, rates, max_offset=0.2, step=5e-3,
                               focal_factors=np.ones(1), count=1)
    assert found.offset == pytest.approx(0.05, abs=5e-3)
    assert found.misfit < 0.02
    np.testing.assert_allclose(found.R_cam_imu, R, atol=0.03)


@lru_cache(maxsize=1)
def few_pairs() -> tuple[coplanarity.Problem, coplanarity.Unknowns, Truth]:
    """Pairs, and a calibration a little off the truth."""
    rng = np.random.default_rng(1)
    recorded = record(drawn(rng, frames=10, outliers=0.0), rng)
    truth, tracks = recorded.truth, recorded.tracks
    pairs = make_pairs(tracks, (2,), PairSelection((), 60, 20, 99), 0.1, rng)
    problem = Observations.of(tracks, recorded.gyro, camera_of(truth)).problem(pairs, 0.05)
    # As of intervals that vary.
    covariates = 0.01 * np.arange(len(pairs))
    problem = problem._replace(view1=problem.view1._replace(covariates=covariates),
                               view2=problem.view2._replace(covariates=2.0 * covariates))
    middle_row = 0.5 * (truth.height - 1) / truth.height
    unknowns = initial(
        problem, truth.R_cam_imu.T, truth.time_offset + middle_row * truth.readout_time + 1e-3,
        truth.readout_time + 2e-3, np.array(truth.gyro_bias), noise=1.0)
    unknowns.parameters[coplanarity.LENS] = 0.01, 0.02, 1.0, -2.0
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
    unknowns = unknowns._replace(parameters=unknowns.parameters.copy())
    unknowns.parameters[coplanarity.LENS] = 0.0     # the points are moved in front of it
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


def test_search_finds_the_direction_again():
    problem, unknowns, _ = few_pairs()
    lost = unknowns._replace(direction=np.tile([0.0, 0.0, 1.0], (problem.pairs, 1)))
    found = redirected(problem, lost)
    assert np.abs((found.direction * unknowns.direction).sum(axis=1)).min() > 0.99
    assert evaluate(problem, found).cost < evaluate(problem, lost).cost


@pytest.mark.parametrize('model', DISTORTION_MODELS)
def test_rays_are_the_same_through_every_camera_model(model):
    """Normalised points of the pixels of a distorted camera, and their derivative by them."""
    recorded, _ = usual()
    pinhole = camera_of(recorded.truth)
    tracks = few_frames(recorded.tracks, 3)
    camera = dataclasses.replace(pinhole, distortion_model=model, distortion=MODELS[model])

    def view(points: np.ndarray, camera: RollingShutterCamera) -> coplanarity.View:
        estimated = dataclasses.replace(tracks, points=points)
        data = Observations.of(estimated, recorded.gyro, camera)
        pairs = make_pairs(data.tracks, (1,), PairSelection((), 500, 1, 99), 1.0,
                           np.random.default_rng(0))
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
    tracks = Tracks(*map(np.array, ([0, 10, 20, 30], [0, 0, 1, 1, 1, 3, 3],
                                    [5, 6, 6, 5, 7, 7, 6])),
                    np.arange(14.0).reshape(7, 2))
    pairs = make_pairs(tracks, (1, 2), PairSelection((), 9, 1, 99), 1.0,
                       np.random.default_rng(0))
    assert list(zip(pairs.first, pairs.second, strict=True)) == [(0, 1), (1, 3)]
    np.testing.assert_array_equal(pairs.begin, [0, 2, 4])
    np.testing.assert_array_equal(pairs.points1, tracks.points[[0, 1, 2, 4]])
    np.testing.assert_array_equal(pairs.points2, tracks.points[[3, 2, 6, 5]])


MS = 1_000_000
START = 1_700_000_000 * NANOSECONDS


def stamps_of(intervals_ms: list[float]) -> np.ndarray:
    return START + np.rint(np.concatenate([[0.0], np.cumsum(intervals_ms)]) * MS).astype(np.int64)


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
    # The covariate is the lateness of each stamp.
    assert np.corrcoef(jittered.covariates, -late)[0, 1] > 0.97
    redrawn = frame_times(stamps_of(rng.choice([33.0, 40.0], 400)))
    assert redrawn.varying is Varying.UNCLEAR and not redrawn.covariates.any()


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
def test_jitter_and_exposure_of_real_stamps(recordings, name, column, varying):
    stamps = np.loadtxt(recordings / name / 'frames.csv', delimiter=',', skiprows=1,
                        usecols=column, dtype=np.int64)
    assert frame_times(stamps).varying is varying


def test_exposure_becomes_two_parameters_of_the_node(tmp_path):
    recorded = simulated(14, fps=30.0, exposure_slope=-0.5, long_interval=1.2, frames=160)
    result = calibrated(recorded)
    slope = result.offset_by_interval
    assert slope.value == pytest.approx(-0.5, abs=max(4.5 * slope.sigma, 0.05))
    assert slope.sigma < 0.15
    assert result.offset_by_jitter is None
    sensor = written(result, camera_of(recorded.truth), tmp_path)[1].sensor
    assert sensor.time_offset_per_interval == pytest.approx(-0.5, abs=0.1)
    assert sensor.time_offset_reference_interval == pytest.approx(result.frame_interval, abs=1e-6)
    # At the intervals of both halves, the offset is the true one.
    for interval in (1.0 / 30.0, 1.2 / 30.0):
        intervals = np.concatenate([np.full(80, 1.0 / 30.0), np.full(79, 1.2 / 30.0)])
        true = recorded.truth.time_offset - 0.5 * (interval - np.median(intervals))
        offset = sensor.time_offset + sensor.time_offset_per_interval * (
            interval - sensor.time_offset_reference_interval)
        assert offset == pytest.approx(true, abs=1.5e-3)


def test_jitter_of_stamps_is_not_taken_for_exposure(tmp_path):
    recorded = simulated(19, fps=30.0, stamp_jitter=2.4e-3)
    truth, result = recorded.truth, calibrated(recorded)
    assert result.offset_by_interval is None
    jitter = result.offset_by_jitter
    assert jitter.value == pytest.approx(1.0, abs=max(4.5 * jitter.sigma, 0.05))
    assert result.stamp_jitter == pytest.approx(2.4e-3, rel=0.25)
    # The mean of all the stamps' own errors remains.
    assert abs(result.time_offset.value - truth.time_offset) < 2e-3
    assert abs(result.readout_time.value - truth.readout_time) < 1e-3
    assert 'per_interval' not in written(result, camera_of(truth), tmp_path)[0]
    assert any('not automatic exposure' in line for line in report(result, camera_of(truth)))
