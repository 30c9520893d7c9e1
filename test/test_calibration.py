"""Calibration on simulated tracks: values, observability, refusals, stamps, sigmas."""

import contextlib
import csv
import dataclasses
from functools import lru_cache
import math
from pathlib import Path
import re

import numpy as np
import pytest
from scipy.spatial.transform import Rotation
from scipy.stats import norm, t

from rs_relpose_lab.experiments import calibration as benchmark
from rs_relpose_lab.experiments import calibration_tracks
from rs_relpose_lab.experiments.calibration_tracks import drawn, record, Recorded, Truth
from rs_relpose_ros.calibrate import evaluation
from rs_relpose_ros.calibrate.evaluation import evaluated, within_priors
from rs_relpose_ros.calibrate.procedure import calibrate, calibrate_together
from rs_relpose_ros.calibrate.recording import CalibrationInput
from rs_relpose_ros.calibrate.result import CalibrationResult, Estimate, parameter_file, report
from rs_relpose_ros.calibration import fit as fitting
from rs_relpose_ros.calibration import knowledge, model, observations
from rs_relpose_ros.calibration.errors import (
    fit,
    Groups,
    of_few_groups,
    stretches,
    weights_of_stretches,
    widened,
)
from rs_relpose_ros.calibration.fit import (
    evaluate,
    Fit,
    initial,
    LOCAL,
    redirected,
    stepped,
)
from rs_relpose_ros.calibration.model import (
    EXPOSURE,
    GLOBAL,
    OFFSET,
    READOUT,
)
from rs_relpose_ros.calibration.observations import (
    frame_times,
    GyroSeries,
    make_pairs,
    noise_density,
    Observations,
    PairSelection,
    TrackedPoints,
    Varying,
)
from rs_relpose_ros.calibration.repeated import combined
from rs_relpose_ros.config.files import read_parameters
from rs_relpose_ros.config.settings import CalibrationConfig, Parameters, TRACKED_IN_IMAGES
from rs_relpose_ros.core import radial
from rs_relpose_ros.core.deviations import OFFLINE
from rs_relpose_ros.errors import InputError
from rs_relpose_ros.geometry.camera import RollingShutterCamera
from rs_relpose_ros.geometry.lens import DISTORTION_MODELS
from rs_relpose_ros.geometry.timing import NANOSECONDS

# Coefficients of each camera model that bend a picture visibly.
# First places of entries with more than one value.
BIAS = model.BIAS.start
CENTER = model.CENTER.start
ROTATION = model.ROTATION.start
# Of an unknown lens, as `calibrate --lens`.
FREE_LENS = OFFLINE.mask('focal_log', 'distortion', 'principal_point')
MODELS = {
    'plumb_bob': (-0.2, 0.05, 0.001, -0.001, 0.0),
    'rational_polynomial': (0.3, 0.1, 0.001, -0.001, 0.0, 0.4, 0.15, 0.01),
    'equidistant': (0.02, -0.01, 0.003, 0.0),
}


def camera_of(truth: Truth, focal: float | None = None) -> RollingShutterCamera:
    f = truth.focal if focal is None else focal
    return RollingShutterCamera(
        width=truth.width,
        height=truth.height,
        fx=f,
        fy=f,
        cx=0.5 * (truth.width - 1),
        cy=0.5 * (truth.height - 1),
        readout_time=0.0,
    )


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


def written(
    result: CalibrationResult, camera: RollingShutterCamera, folder: Path
) -> tuple[str, Parameters]:
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
    readouts, costs = result.curve
    best = readouts[np.argmin(costs)]
    assert best == pytest.approx(recorded.truth.readout_time, abs=4e-3)
    assert costs[np.argmin(np.abs(readouts))] > 20.0
    # The CameraInfo has the focal length.
    _, configured = written(result, camera_of(recorded.truth), tmp_path)
    sensor = configured.sensor
    assert not configured.intrinsics.given
    assert sensor.readout_time == pytest.approx(result.readout_time.value, abs=1e-6)
    assert sensor.time_offset == pytest.approx(result.time_offset.value, abs=1e-6)
    assert (sensor.readout_direction, sensor.stamp_row) == ('down', 'first')
    np.testing.assert_allclose(sensor.R_cam_imu, result.R_cam_imu, atol=1e-6)


@pytest.mark.parametrize('share', [0.01, 0.05])
def test_matches_beyond_the_fold_of_a_lens_are_dropped(share):
    """A wide lens has pixels that no ray reaches; trackers follow points there all the same."""
    recorded, _ = usual()
    lens = dataclasses.replace(camera_of(recorded.truth), distortion=(-0.25, 0.0, 0.0, 0.0, 0.0))
    tracks = recorded.tracks
    rays = camera_of(recorded.truth).unproject(tracks.points)
    seen = np.hypot(rays[:, 0], rays[:, 1]) < rays[:, 2]  # before the fold at 1.15
    number = round(share * seen.sum() / len(tracks))
    frames = np.repeat(np.arange(len(tracks)), number)
    ids = np.tile(np.arange(number, dtype=tracks.ids.dtype), len(tracks)) + tracks.ids.max() + 1
    beyond = np.stack([6.0 + 0.05 * frames, 4.0 + 3.0 * np.tile(np.arange(number), len(tracks))])
    assert number >= 1 and np.isnan(lens.unproject(beyond.T)).all()
    order = np.argsort(np.concatenate([tracks.frames[seen], frames]), kind='stable')
    both = TrackedPoints(
        tracks.stamps_ns,
        np.concatenate([tracks.frames[seen], frames])[order],
        np.concatenate([tracks.ids[seen], ids])[order],
        np.concatenate([lens.project(rays[seen]), beyond.T])[order],
    )
    inside = TrackedPoints(
        tracks.stamps_ns, tracks.frames[seen], tracks.ids[seen], lens.project(rays[seen])
    )
    found, usual_one = (calibrate(one, recorded.gyro, lens) for one in (both, inside))
    for name in ('readout_time', 'time_offset'):
        estimate = getattr(found, name)
        expected = getattr(usual_one, name)
        assert estimate.observable
        assert abs(estimate.value - expected.value) < expected.sigma
    turn = Rotation.from_matrix(found.R_cam_imu @ usual_one.R_cam_imu.T).magnitude()
    assert turn < usual_one.rotation_sigma.max()


def test_sigmas_are_of_the_size_of_the_errors():
    recorded, result = usual()
    truth = recorded.truth
    z = [
        (result.readout_time.value - truth.readout_time) / result.readout_time.sigma,
        (result.time_offset.value - truth.time_offset) / result.time_offset.sigma,
        *(
            (bias.value - true) / bias.sigma
            for bias, true in zip(result.gyro_bias, truth.gyro_bias, strict=True)
        ),
    ]
    assert np.abs(z).max() < 4.5
    assert np.abs(z).max() > 0.1  # neither claimed ten times too large


def test_camera_read_upwards_with_unknown_focal_length(tmp_path):
    rng = np.random.default_rng(12)
    truth = dataclasses.replace(
        drawn(rng, readout_time=0.02, focal=900.0, frames=120), readout_time=-0.02
    )
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
    assert (
        intrinsics.fx
        == intrinsics.fy
        == pytest.approx(result.lens.focal_factor.value * guess, abs=0.01)
    )
    for found, estimate, true in (
        (intrinsics.distortion[0], result.lens.radial[0], 0.0),
        (intrinsics.cx, result.lens.column, camera.cx),
        (intrinsics.cy, result.lens.row, camera.cy),
    ):
        assert found == pytest.approx(estimate.value, abs=0.01)
        assert abs(found - true) < 4.0 * estimate.sigma
    # Left out, and named, if it is not determined.
    unknown = dataclasses.replace(
        result,
        lens=result.lens._replace(
            focal_factor=Estimate(1.0, 1.0, observable=False, determined=False, remark='too slow')
        ),
    )
    text, _ = written(unknown, camera, tmp_path)
    assert 'camera_matrix (too slow)' in text and 'camera_matrix:' not in text


@pytest.mark.parametrize(
    ('model', 'coefficients'),
    [
        ('plumb_bob', (-0.15, 0.0, 0.0, 0.0, 0.0)),
        ('equidistant', (0.03, 0.0, 0.0, 0.0)),
        # Of a RealSense: k1 and k2 cancel each other towards the edge.
        ('plumb_bob', (0.163, -0.520, 0.0, 0.0, 0.474)),
    ],
)
def test_lens_is_estimated(model, coefficients, tmp_path):
    """All rows of a global shutter have one time: its pixels may be distorted afterwards.

    All of the lens is 10 px off.
    """
    recorded = simulated(21, readout_time=0.0, fps=30.0)
    pinhole = camera_of(recorded.truth)
    lens = dataclasses.replace(
        pinhole,
        distortion_model=model,
        distortion=coefficients,
        cx=pinhole.cx + 10.0,
        cy=pinhole.cy - 10.0,
    )
    bent = dataclasses.replace(
        recorded.tracks, points=lens.project(pinhole.unproject(recorded.tracks.points))
    )
    guess = dataclasses.replace(
        camera_of(recorded.truth, 0.8 * recorded.truth.width),
        distortion_model=model,
        distortion=(0.0,) * len(coefficients),
    )
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
    assert found.distortion[0] == pytest.approx(result.lens.radial[0].value, abs=1e-5)
    for estimate, true in zip(result.lens.radial, lens.radial_coefficients, strict=True):
        assert abs(estimate.value - true) < 3.0 * estimate.sigma
    # What it does to the image is known better than by the prior.
    corner = radial.displacements([radial.corner_radius(lens)])[0]
    displacement = result.lens.displacement
    assert displacement.sigma < 0.01
    assert abs(displacement.value - corner @ lens.radial_coefficients) < 3.0 * displacement.sigma
    assert 0.0 < sigmas.principal_point_sigma < 5.0
    assert abs(found.cx - lens.cx) < 4.5 * sigmas.principal_point_sigma
    assert abs(found.cy - lens.cy) < 4.5 * sigmas.principal_point_sigma


@pytest.mark.parametrize('given', [True, False])
def test_prior_of_a_lens_is_on_what_it_does_to_the_image(given):
    """2 % of the radius at the corner and 1 % at half of it; a guess may have a k1 of 0.3."""
    camera = camera_of(recorded().truth)
    covariance = knowledge.distortion_prior(camera, given=given)
    radius = radial.corner_radius(camera)
    assert radius == pytest.approx(
        np.linalg.norm([0.5 * camera.width, 0.5 * camera.height]) / camera.fx
    )
    for share, sigma in ((1.0, 0.02), (0.5, 0.01)):
        r = share * radius
        by_coefficients = np.array([r**2, r**4, r**6])
        variance = by_coefficients @ covariance @ by_coefficients
        expected = sigma**2 + (0.0 if given else (0.3 * r**2) ** 2)
        assert variance == pytest.approx(expected, rel=1e-6)


def test_a_given_distortion_is_where_the_estimate_starts():
    camera = dataclasses.replace(
        camera_of(recorded().truth), distortion=(-0.2, 0.05, 1e-3, -1e-3, 0.0)
    )
    recording = CalibrationInput(recorded().tracks, recorded().gyro, camera, True, {})
    unknown = recording.with_unknown_lens('equidistant')
    assert unknown.camera == camera and unknown.lens_given and not unknown.focal_known
    plain = dataclasses.replace(recording, camera=camera_of(recorded().truth))
    lens = plain.with_unknown_lens('plumb_bob')
    assert lens.camera.distortion == (0.0,) * 5 and lens.lens_given
    guessed = dataclasses.replace(plain, focal_known=False).with_unknown_lens('plumb_bob')
    assert not guessed.lens_given


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
    result = calibrated(
        recorded, quat_prior=(Rotation.from_rotvec([0.03, -0.04, 0.02]) * true).as_quat()
    )
    assert result.complete and result.rotation.determined
    apart = (Rotation.from_matrix(result.R_cam_imu) * true.inv()).as_rotvec()
    assert (np.abs(apart) < 3.0 * result.rotation_sigma).all()
    assert 0.04 < result.rotation_sigma.max() < 0.09
    other = calibrated(
        recorded, quat_prior=(Rotation.from_rotvec([0.0, 0.0, 1.5]) * true).as_quat()
    )
    assert not other.rotation.determined
    recorded, usual_result = usual()
    same = calibrated(
        recorded,
        quat_prior=(
            Rotation.from_rotvec([0.0, 0.5, 0.0]) * Rotation.from_matrix(recorded.truth.R_cam_imu)
        ).as_quat(),
    )
    np.testing.assert_array_equal(same.R_cam_imu, usual_result.R_cam_imu)


def few_frames(tracks: TrackedPoints, count: int) -> TrackedPoints:
    kept = tracks.frames < count
    return TrackedPoints(
        tracks.stamps_ns[:count], tracks.frames[kept], tracks.ids[kept], tracks.points[kept]
    )


def few_points(tracks: TrackedPoints) -> TrackedPoints:
    kept = tracks.ids % 30 == 0
    return TrackedPoints(
        tracks.stamps_ns, tracks.frames[kept], tracks.ids[kept], tracks.points[kept]
    )


UNUSABLE = {
    'too short: 10 frames': lambda tracks, gyro: (few_frames(tracks, 10), gyro),
    'hardly rotates': lambda tracks, gyro: (
        tracks,
        GyroSeries(
            gyro.stamps_ns,
            0.05 + 1e-3 * np.random.default_rng(0).standard_normal(gyro.rates.shape),
        ),
    ),
    'too few points': lambda tracks, gyro: (few_points(tracks), gyro),
    'short exposure': lambda tracks, gyro: (
        dataclasses.replace(tracks, ids=np.arange(len(tracks.ids))),
        gyro,
    ),
    'the gyro covers 0.0 s': lambda tracks, gyro: (
        tracks,
        GyroSeries(gyro.stamps_ns + 3600 * NANOSECONDS, gyro.rates),
    ),
}


@pytest.mark.parametrize('message', UNUSABLE)
def test_unusable_recordings_are_refused(message):
    recorded, _ = usual()
    with pytest.raises(InputError, match=message):
        calibrate(*UNUSABLE[message](recorded.tracks, recorded.gyro), camera_of(recorded.truth))


def test_readout_longer_than_the_interval_is_refused():
    rng = np.random.default_rng(16)
    # No camera can do this: the simulation can.
    truth = dataclasses.replace(
        drawn(rng, readout_time=0.03, fps=30.0, frames=70), readout_time=0.045
    )
    with pytest.raises(InputError, match='longer than the interval'):
        calibrated(record(truth, rng))


# -- parts ------------------------------------------------------------------------------------


def test_every_axis_map_is_recognised():
    maps = observations.axis_maps()
    assert len({m.tobytes() for m in maps}) == 24
    np.testing.assert_allclose(np.linalg.det(maps), 1.0)
    tilt = Rotation.from_rotvec([0.1, -0.2, 0.15]).as_matrix()
    for matrix in maps:
        np.testing.assert_array_equal(observations.nearest_axis_map(tilt @ matrix), matrix)


@pytest.mark.parametrize(
    'rotation, axes',
    [([0.5, -1.2, 2.0], np.ones(3)), ([math.radians(30.0), 0.0, 0.0], np.array([0.0, 1.0, 0.0]))],
    ids=['three axes', 'of one axis the rotation nearest to an axis map'],
)
def test_search_finds_offset_and_rotation(rotation, axes):
    """Of a gyro 50 ms ahead."""
    R = Rotation.from_rotvec(rotation).as_matrix()
    rng = np.random.default_rng(3)
    times = np.arange(0.0, 6.0, 0.005)
    rates = axes * np.sin(2.0 * times[:, None] * [1.0, 1.7, 2.3]) * 0.4
    begins = np.linspace(0.5, 5.0, 120)
    ends = begins + 0.033
    estimated = np.stack(
        [np.interp(0.5 * (begins + ends) + 0.05, times, rates[:, i]) for i in range(3)], axis=1
    ) @ R.T + 0.01 * rng.standard_normal((120, 3))
    found, *_ = observations.find_starts(
        observations.MeasuredRates(estimated, begins, ends, times, rates),
        max_offset=0.2,
        focal_factors=np.ones(1),
    )
    assert found.offset == pytest.approx(0.05, abs=5e-3)
    assert found.misfit < 0.02
    np.testing.assert_allclose(found.R_cam_imu, R, atol=0.03)


@lru_cache(maxsize=1)
def few_pairs() -> tuple[model.Problem, model.Unknowns, Truth]:
    """Pairs, and a calibration a little off the truth."""
    rng = np.random.default_rng(1)
    recorded = record(drawn(rng, frames=10, outliers=0.0), rng)
    truth = recorded.truth
    tracks = recorded.tracks
    pairs = make_pairs(tracks, (2,), PairSelection((), 60, 20, 99), 0.1, rng)
    problem = Observations.of(tracks, recorded.gyro, camera_of(truth)).problem(pairs, 0.05)
    # As of intervals that vary.
    problem = problem._replace(covariates=0.01 * np.outer([1.0, 2.0], np.arange(len(pairs))))
    middle_row = 0.5 * (truth.height - 1) / truth.height
    unknowns = initial(
        problem,
        truth.R_cam_imu,
        truth.time_offset + middle_row * truth.readout_time + 1e-3,
        truth.readout_time + 2e-3,
        np.array(truth.gyro_bias),
        noise=1.0,
    )
    unknowns.parameters[model.LENS] = 0.01, 0.003, 0.02, -0.01, 0.005, 0.001, -0.002, 1.0, -2.0
    return problem, unknowns, truth


def test_a_step_of_the_axes_turns_the_camera_and_that_of_the_lens_is_true_minus_assumed():
    """R_true = Exp(c) R_cam_imu in the axes of the camera, and f_true = f exp(c)."""
    _, unknowns, truth = few_pairs()
    step = np.zeros(GLOBAL)
    step[model.ROTATION] = 0.02, -0.01, 0.03
    turned = Rotation.from_rotvec([0.02, -0.01, 0.03]).as_matrix() @ unknowns.R_cam_imu
    np.testing.assert_allclose(stepped(unknowns, step).R_cam_imu, turned, atol=1e-12)
    camera = camera_of(truth)
    moved = camera.moved_lens(np.array([0.1, 0.0, 0.02, 0.0, 0.0, 0.001, -0.002, 3.0, -4.0]))
    assert moved.fx == pytest.approx(camera.fx * math.exp(0.1))
    assert (moved.cx - camera.cx, moved.cy - camera.cy) == pytest.approx((3.0, -4.0))
    assert moved.distortion[:4] == pytest.approx((0.02, 0.0, 0.001, -0.002))


def test_gradient_is_that_of_finite_differences():
    problem, unknowns, _ = few_pairs()
    # At the optimum of the pairs' own unknowns the total derivative is the partial one.
    every = np.ones(GLOBAL, dtype=bool)
    held = np.zeros(GLOBAL, dtype=bool)
    for _ in range(40):
        local = evaluate(problem, unknowns, held).local_step(np.zeros(0))
        unknowns = stepped(unknowns, np.zeros(GLOBAL), 0.5 * local)
    analytic = evaluate(problem, unknowns, every).score.sum(axis=0)

    def cost(step: np.ndarray) -> float:
        moved = stepped(unknowns, step, np.zeros((problem.pairs, LOCAL)))
        return evaluate(problem, moved).cost

    h = 1e-6
    numeric = np.array([(cost(h * unit) - cost(-h * unit)) / (2 * h) for unit in np.eye(GLOBAL)])
    np.testing.assert_allclose(analytic, numeric, rtol=1e-5, atol=1e-7 * np.abs(numeric).max())


def test_residual_is_the_distance_in_pixels_to_the_nearest_pair_that_fits():
    problem, unknowns, truth = few_pairs()
    unknowns = unknowns._replace(parameters=unknowns.parameters.copy())
    unknowns.parameters[model.LENS] = 0.0  # the points are moved in front of it
    residuals = evaluate(problem, unknowns).residuals
    # Moved against its gradient by the residual, a match of two ends fits: first order in 0.3 px.
    h = 1e-4
    n = 17
    gradient = np.zeros(4)
    for k in range(4):
        points = problem.points.copy()
        points[k // 2, n, k % 2] += h / truth.focal
        moved = problem._replace(points=points)
        change = evaluate(moved, unknowns).residuals[n] - residuals[n]
        gradient[k] = change / h
    assert np.linalg.norm(gradient) == pytest.approx(1.0, abs=0.01)


def test_search_finds_the_direction_again():
    problem, unknowns, _ = few_pairs()
    lost = unknowns._replace(own=np.tile(np.eye(9)[2], (problem.pairs, 1)))
    found = redirected(problem, lost)
    assert np.abs((found.own * unknowns.own)[:, :3].sum(axis=1)).min() > 0.99
    assert evaluate(problem, found).cost < evaluate(problem, lost).cost


@pytest.mark.parametrize('name', DISTORTION_MODELS)
def test_rays_are_the_same_through_every_camera_model(name):
    """Normalised points of the pixels of a distorted camera, and their derivative by them."""
    recorded, _ = usual()
    pinhole = camera_of(recorded.truth)
    tracks = few_frames(recorded.tracks, 3)
    camera = dataclasses.replace(pinhole, distortion_model=name, distortion=MODELS[name])

    def problem(points: np.ndarray, camera: RollingShutterCamera) -> model.Problem:
        estimated = dataclasses.replace(tracks, points=points)
        data = Observations.of(estimated, recorded.gyro, camera)
        pairs = make_pairs(
            data.tracks, (1,), PairSelection((), 500, 1, 99), 1.0, np.random.default_rng(0)
        )
        return data.problem(pairs, 0.0)

    straight = problem(tracks.points, pinhole).points
    pixels = camera.project(pinhole.unproject(tracks.points))
    np.testing.assert_allclose(problem(pixels, camera).points, straight, atol=1e-9)
    h = 1e-3
    by_pixel = problem(pixels, camera).by_pixel
    for k in range(2):
        step = h * np.eye(2)[k]
        change = problem(pixels + step, camera).points - problem(pixels - step, camera).points
        np.testing.assert_allclose(by_pixel[..., k], change / (2.0 * h), atol=1e-9)


def test_pairs_have_the_tracks_points_in_common():
    tracks = TrackedPoints(
        *map(np.array, ([0, 10, 20, 30], [0, 0, 1, 1, 1, 3, 3], [5, 6, 6, 5, 7, 7, 6])),
        np.arange(14.0).reshape(7, 2),
    )
    pairs = make_pairs(tracks, (1, 2), PairSelection((), 9, 1, 99), 1.0, np.random.default_rng(0))
    assert [pair[:2] for pair in pairs] == [(0, 1), (1, 3)]
    np.testing.assert_array_equal(pairs[0].rows, [[0, 1], [3, 2]])
    np.testing.assert_array_equal(pairs[1].rows, [[2, 4], [6, 5]])


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
    assert jittered.covariates.std() == pytest.approx(2.4e-3, rel=0.2)
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
@pytest.mark.parametrize(
    ('name', 'column', 'varying'),
    [
        ('realsense_rgb_rs', 2, Varying.EXPOSURE),
        ('realsense_rgb_rs_b', 2, Varying.EXPOSURE),
        ('android_phone_rs', 1, Varying.JITTER),
    ],
)
def test_jitter_and_exposure_of_real_stamps(recordings, name, column, varying):
    stamps = np.loadtxt(
        recordings / name / 'frames.csv', delimiter=',', skiprows=1, usecols=column, dtype=np.int64
    )
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
            interval - sensor.time_offset_reference_interval
        )
        assert offset == pytest.approx(true, abs=1.5e-3)


def test_jitter_of_stamps_is_not_taken_for_exposure(tmp_path):
    recorded = simulated(19, fps=30.0, stamp_jitter=2.4e-3)
    truth = recorded.truth
    result = calibrated(recorded)
    assert result.offset_by_interval is None
    jitter = result.offset_by_jitter
    assert jitter.value == pytest.approx(1.0, abs=max(4.5 * jitter.sigma, 0.05))
    assert result.stamp_jitter == pytest.approx(2.4e-3, rel=0.25)
    # The mean of all the stamps' own errors remains.
    assert abs(result.time_offset.value - truth.time_offset) < 2e-3
    assert abs(result.readout_time.value - truth.readout_time) < 1e-3
    assert 'per_interval' not in written(result, camera_of(truth), tmp_path)[0]
    assert any('not automatic exposure' in line for line in report(result, camera_of(truth)))


# -- sigmas: regions of the image, both halves, lens and gyro, exposure -----------------------


@lru_cache(maxsize=1)
def recorded() -> Recorded:
    return simulated(31, frames=100, fps=30.0, gyro_rate=200.0)


def free_of(*held: int) -> np.ndarray:
    free = OFFLINE.mask('axes', 'time_offset', 'readout_time', 'gyro_bias', 'exposure_square')
    free[[*held]] = False
    return free


def fitted(
    free: np.ndarray,
    lens: knowledge.LensKnowledge = knowledge.LensKnowledge.CLAIMED,
    **changes: object,
) -> tuple[Fit, observations.Observations]:
    """Fit from the truth of the recording, with changed tracks or gyro."""
    source = dataclasses.replace(recorded(), **changes)
    truth = source.truth
    data = observations.Observations.of(
        source.tracks, source.gyro, camera_of(truth), knowledge=lens
    )
    offset = truth.time_offset + 0.5 * truth.readout_time
    pairs = data.pairs(
        observations.PairSelection((0.033, 0.1), 60, 20, 999), np.random.default_rng(0)
    )
    problem = data.problem(pairs, offset)
    begin = fitting.initial(
        problem,
        truth.R_cam_imu,
        offset,
        truth.readout_time,
        np.array(truth.gyro_bias),
        noise=1.0,
    )
    return fit(fitting.with_bends(problem, begin), begin, free, rounds=15), data


@lru_cache(maxsize=1)
def undisturbed() -> tuple[Fit, observations.Observations]:
    return fitted(free_of(EXPOSURE))


def wider(final: Fit) -> np.ndarray:
    """Sigmas after `widened` over those before."""
    before, after = (np.diag(some.covariance)[final.free] for some in (final, widened(final)))
    return np.sqrt(after / before)


def test_a_recording_of_the_model_is_hardly_widened():
    factors = wider(undisturbed()[0])
    assert factors.min() >= 1.0
    assert np.median(factors) < 1.3


def test_stretches_that_agree_have_one_weight():
    """It is at most 1: without more scatter than noise, nothing has less than its information."""
    weights = weights_of_stretches(undisturbed()[0])
    assert weights.max() <= 1.0 and weights.min() > 0.5 * weights.max()


def test_a_stretch_that_contradicts_the_others_has_less_weight():
    """Its images roll though the gyro does not, as with a lens that is stabilised."""
    source = recorded()
    tracks = source.tracks
    angles = 0.004 * np.clip(tracks.frames - 40, 0, 12)  # frames 40 to 52 of 100
    center = np.array([camera_of(source.truth).cx, camera_of(source.truth).cy])
    turns = np.stack([np.cos(angles), -np.sin(angles), np.sin(angles), np.cos(angles)], axis=1)
    points = center + np.einsum('nij,nj->ni', turns.reshape(-1, 2, 2), tracks.points - center)
    final, _ = fitted(free_of(EXPOSURE), tracks=dataclasses.replace(tracks, points=points))
    again = final
    weights = np.ones(0)
    for _ in range(2):
        weights = weights_of_stretches(again)
        weighted = final.problem._replace(weight=weights)
        again = fit(weighted, again.unknowns, final.free)
    times = final.problem.middles
    within = (times > 40 / 30 + 0.1) & (times < 52 / 30 - 0.1)
    beyond = (times < 40 / 30 - 0.35) | (times > 52 / 30 + 0.35)
    assert weights[within].max() < 0.5 * np.median(weights[beyond])
    right = undisturbed()[0].unknowns.parameters[model.BIAS]

    def off(one):
        return np.linalg.norm(one.unknowns.parameters[model.BIAS] - right)

    assert off(again) < 0.85 * off(final)


def test_a_fit_that_does_not_converge_has_wider_sigmas():
    final, _ = undisturbed()
    parameters = final.unknowns.parameters.copy()
    parameters[[READOUT, BIAS]] += 0.004, 0.02
    begin = final.unknowns._replace(parameters=parameters)
    short = fit(final.problem, begin, final.free, rounds=2)
    assert final.converged and not short.converged
    error = short.unknowns.parameters - final.unknowns.parameters
    for k in (READOUT, BIAS):
        assert abs(error[k]) < 3.0 * math.sqrt(short.covariance[k, k])
    # Most of it remains after two steps.
    assert short.covariance[READOUT, READOUT] > 4.0 * final.covariance[READOUT, READOUT]


def test_a_part_of_the_image_that_is_wrong_widens_the_sigmas():
    tracks = recorded().tracks
    points = tracks.points.copy()
    left = tracks.points[:, 0] < 400.0
    # Sheared all the time, so that stretches of time agree: 3 % of the distance to column 160.
    points[left, 1] += 0.03 * (points[left, 0] - 160.0)
    final, _ = fitted(free_of(EXPOSURE), tracks=dataclasses.replace(tracks, points=points))
    assert wider(final).max() > 2.0 * wider(undisturbed()[0]).max()


def test_a_change_within_the_recording_widens_the_sigmas():
    gyro = recorded().gyro
    rates = gyro.rates.copy()
    rates[gyro.stamps_ns > recorded().tracks.stamps_ns[50]] += [0.03, 0.0, 0.0]
    final, _ = fitted(free_of(EXPOSURE), gyro=GyroSeries(gyro.stamps_ns, rates))
    found = widened(final)
    right = widened(undisturbed()[0])
    # Blocks that are 0.015 rad/s from the mean have it within 0.005, with equal weights.
    sigma, undisturbed_sigma = (np.sqrt(one.covariance[BIAS, BIAS]) for one in (found, right))
    assert sigma > max(2e-3, 2.0 * undisturbed_sigma)
    assert found.halves_apart > 2.0 * right.halves_apart


def test_a_wrong_claim_of_the_camera_info_is_named_and_not_put_on_the_axes():
    """An image that was cropped by 30 columns; its CameraInfo was not adapted."""
    source = recorded()
    camera = camera_of(source.truth)
    cropped = dataclasses.replace(camera, cx=camera.cx + 30.0)
    right, wrong = (
        calibrate(source.tracks, source.gyro, one, config=TRACKED_IN_IMAGES)
        for one in (camera, cropped)
    )
    assert not any('CameraInfo' in text for text in right.warnings)
    (text,) = (text for text in wrong.warnings if 'CameraInfo' in text)
    column, row = re.search(r'principal point of ([\d.]+), ([\d.]+) px', text).groups()
    assert float(column) == pytest.approx(camera.cx, abs=4.0)
    assert float(row) == pytest.approx(camera.cy, abs=4.0)
    for result in (right, wrong):
        apart = Rotation.from_matrix(source.truth.R_cam_imu @ result.R_cam_imu.T).as_rotvec()
        assert (np.abs(apart) < 4.0 * result.rotation_sigma).all()


@pytest.mark.parametrize('offset', [0.62, -1.2])
def test_an_offset_beyond_the_search_range_is_found_over_the_overlap(offset):
    source = recorded()
    shifted = dataclasses.replace(
        source.gyro, stamps_ns=source.gyro.stamps_ns + round(offset * NANOSECONDS)
    )
    camera = camera_of(source.truth)
    result = calibrate(source.tracks, shifted, camera)
    expected = source.truth.time_offset + offset
    assert result.time_offset.value == pytest.approx(expected, abs=1e-3)
    bounded = CalibrationConfig(search_overlap=False)
    with contextlib.suppress(InputError):
        other = calibrate(source.tracks, shifted, camera, config=bounded)
        assert abs(other.time_offset.value) < bounded.max_time_offset + 0.05


def test_what_the_data_determine_of_a_claim_is_no_doubt():
    """The doubt of lens and gyro widens the other sigmas by what the data leave of it."""
    held, _ = undisturbed()
    claimed = free_of(EXPOSURE) | knowledge.CLAIMED
    final, _ = fitted(claimed)
    sigmas = np.sqrt(np.diag(final.covariance))
    prior = final.problem.prior
    for name in (model.FOCAL, model.SCALE.start, model.CENTER.start):
        assert sigmas[name] < 0.9 * prior[name, name] ** -0.5
    axes = np.arange(GLOBAL)[model.ROTATION]
    # Claims and axes trade: skew and principal point, before anything else.
    assert (sigmas[axes] > 1.2 * np.sqrt(np.diag(held.covariance))[axes]).all()
    # The errors of the priors are a part of the covariance, whatever scatters.
    wide = widened(final)
    left = wide.covariance - wide.by_doubt @ wide.by_doubt.T
    assert np.linalg.eigvalsh(left[final.block]).min() > -1e-12
    more = widened(final, in_images=True)
    difference = more.covariance - wide.covariance
    assert np.linalg.eigvalsh(difference).min() > -1e-12 * np.trace(difference)
    assert difference[model.ROTATION, model.ROTATION].trace() > 0.0


def test_widened_sigmas_stay_within_the_priors():
    """A recording that contradicts itself says less of a claim than the claim, but not nothing."""
    final, data = fitted(free_of(EXPOSURE) | knowledge.CLAIMED)
    parameters = final.unknowns.parameters.copy()
    parameters[model.FOCAL] += 0.02
    wild = dataclasses.replace(
        final,
        unknowns=final.unknowns._replace(parameters=parameters),
        covariance=1e6 * final.covariance,
    )
    result = evaluated(data, wild, np.zeros((2, 2)), TRACKED_IN_IMAGES)
    assert result.lens is None
    unknowns, covariance = within_priors(wild, wild.covariance)
    k = model.FOCAL
    prior = wild.problem.prior[k, k] ** -0.5
    assert math.sqrt(covariance[k, k]) == pytest.approx(prior, rel=0.01)
    # Nothing is left of the value but the claim.
    assert abs(unknowns.parameters[k]) < 0.1 * prior
    known = 0.25 * final.covariance
    same, unchanged = within_priors(final, known)
    np.testing.assert_allclose(unchanged, known, rtol=1e-6, atol=1e-18)
    np.testing.assert_allclose(same.parameters, final.unknowns.parameters, atol=1e-9)


def test_effect_of_an_exposure_on_a_quadratic_rate():
    """Its mean over an exposure h exceeds it by ``h^2 / 24 w''``, whatever h is assumed."""
    stamps = np.arange(0, 2_000_000_000, 2_000_000)
    rates = np.repeat((1e-9 * stamps[:, None]) ** 2, 3, axis=1)
    for exposure in (0.0, 0.04):
        mean, by_square = observations.exposed_rates(
            GyroSeries(stamps, rates), np.full(len(stamps), exposure)
        )
        np.testing.assert_allclose((mean - rates)[30:-30], exposure**2 / 12.0, atol=1e-6)
        np.testing.assert_allclose(by_square[30:-30], 2.0 / 24.0, rtol=0.03)


def sharper(square: float) -> GyroSeries:
    """The recording's gyro, sharper than its images as these would be by an exposure."""
    gyro = recorded().gyro
    _, by_square = observations.exposed_rates(gyro, np.zeros(len(gyro)))
    return GyroSeries(gyro.stamps_ns, gyro.rates - square * by_square)


def test_exposure_is_found():
    final, _ = fitted(free_of(), gyro=sharper(0.04**2))
    found = final.unknowns.parameters
    sigma = np.sqrt(np.diag(final.covariance))
    assert sigma[EXPOSURE] < 0.15 * 0.04**2
    assert abs(found[EXPOSURE] - 0.04**2) < 4.0 * sigma[EXPOSURE]
    assert abs(found[READOUT] - recorded().truth.readout_time) < 4.0 * sigma[READOUT]


def test_exposure_is_not_given_where_it_would_average_the_noise():
    """White noise of the gyro of 0.06 rad/s at 200 Hz; the images have no exposure."""
    source = recorded()
    rng = np.random.default_rng(4)
    rates = source.gyro.rates + 0.06 * rng.normal(size=source.gyro.rates.shape)
    gyro = GyroSeries(source.gyro.stamps_ns, rates)
    data = observations.Observations.of(source.tracks, gyro, camera_of(source.truth))
    final, _ = fitted(free_of(), gyro=gyro)
    exposure = evaluation._exposure(data, final, 1e-5)
    assert not exposure.observable and 'noise' in exposure.remark
    assert exposure.value <= exposure.sigma == data.interval


@pytest.mark.parametrize('given', [{}, {'exposure_time': 0.03}], ids=['unknown', 'given'])
def test_exposure_is_taken_in_by_the_readout_and_written(given, tmp_path):
    source = recorded()
    result = calibrate(
        source.tracks,
        sharper(0.03**2),
        camera_of(source.truth),
        config=dataclasses.replace(TRACKED_IN_IMAGES, **given),
    )
    readout = result.readout_time
    exposure = result.exposure
    assert abs(readout.value - source.truth.readout_time) < 3.0 * readout.sigma < 3e-3
    assert abs(exposure.value - 0.03) <= 3.0 * exposure.sigma
    assert (exposure.sigma == 0.0) == bool(given)
    path = tmp_path / 'calibration.yaml'
    path.write_text(
        parameter_file(result, 'A test.', camera=camera_of(source.truth), compressed=False)
    )
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
    known = observations.Exposure.of(
        times, stamps, dataclasses.replace(TRACKED_IN_IMAGES, exposure_margin=0.01)
    )
    np.testing.assert_allclose(known.assumed[1:], intervals[1:] - 0.01, atol=1e-8)
    assert known.square_sigma == 0.0


def evaluated_at(readout: float, sigma: float) -> tuple[CalibrationResult, Fit]:
    """Result where the fit has this readout time, its offset by -0.5 correlated with it."""
    final, data = undisturbed()
    parameters = final.unknowns.parameters.copy()
    covariance = final.covariance.copy()
    parameters[READOUT] = readout
    covariance[READOUT], covariance[:, READOUT] = 0.0, 0.0
    covariance[READOUT, READOUT] = sigma**2
    covariance[READOUT, OFFSET] = covariance[OFFSET, READOUT] = -0.5 * sigma**2
    covariance[READOUT, ROTATION] = covariance[ROTATION, READOUT] = 0.1 * sigma**2
    covariance[OFFSET, OFFSET] += 0.25 * sigma**2
    covariance[ROTATION, ROTATION] += 0.01 * sigma**2
    final = dataclasses.replace(
        final,
        unknowns=final.unknowns._replace(parameters=parameters),
        covariance=covariance,
        converged=True,
    )
    curve = np.array([np.linspace(-0.03, 0.03, 3), np.zeros(3)])
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
        (-0.004 * 0.05**-2 + 0.5 * interval * known**-2) / weight, rel=1e-6
    )
    assert readout.sigma == pytest.approx(weight**-0.5, rel=1e-6)
    # What is correlated with it follows, with a sigma of its own part only.
    assert result.time_offset.sigma > 0.4 * known
    assert any('hardly determine' in text for text in result.warnings)


def test_sigmas_of_the_lens_do_not_exceed_those_of_its_priors():
    final, data = fitted(free_of(EXPOSURE) | FREE_LENS, knowledge.LensKnowledge.GIVEN)
    covariance = final.covariance.copy()
    sigma = 0.015 * data.camera.width
    covariance[CENTER, CENTER] += (10.0 * sigma) ** 2
    wide = dataclasses.replace(final, covariance=covariance)
    curve = np.array([np.linspace(-0.03, 0.03, 3), np.zeros(3)])
    result = evaluated(data, wide, curve, CalibrationConfig())
    column = result.lens.column
    row = result.lens.row
    assert 0.9 * sigma < column.sigma < 1.001 * sigma
    assert row.sigma == pytest.approx(math.sqrt(covariance[CENTER + 1, CENTER + 1]), rel=0.1)
    # Moved to the middle by all but a hundredth.
    moved = final.unknowns.parameters[CENTER]
    assert column.value - data.camera.cx == pytest.approx(0.01 * moved, abs=0.02 * abs(moved))


@pytest.mark.parametrize('sign', [1.0, -1.0])
def test_the_interval_between_frames_bounds_the_readout(sign):
    """Against draws from the normal distribution of which those beyond the bound are left out."""
    interval = undisturbed()[1].interval
    sigma = 1e-3
    result, final = evaluated_at(sign * (interval + 5e-4), sigma)
    drawn_at = final.unknowns.parameters[READOUT] + sigma * np.random.default_rng(
        5
    ).standard_normal(1_000_000)
    mean = float(drawn_at[np.abs(drawn_at) <= interval].mean())
    readout = result.readout_time
    moved = mean - final.unknowns.parameters[READOUT]
    assert readout.observable and abs(readout.value) < interval
    assert readout.value == pytest.approx(mean, abs=5e-6)
    assert readout.sigma == pytest.approx(sigma, rel=1e-6)
    # What is correlated with it follows: the middle row, and so the first one; the axes.
    middle = final.unknowns.parameters[OFFSET] - 0.5 * moved
    first = 0.5 * (recorded().truth.height - 1) / recorded().truth.height
    assert result.time_offset.value == pytest.approx(middle - first * mean, abs=1e-5)
    # The deviation of the axes is a rotation on the left of R_cam_imu.
    turn = Rotation.from_matrix(result.R_cam_imu @ final.unknowns.R_cam_imu.T).as_rotvec()
    np.testing.assert_allclose(turn, [0.1 * moved, 0.0, 0.0], atol=1e-6)
    assert any(f'{1e3 * interval:.1f} ms between frames' in text for text in result.warnings)
    text = parameter_file(result, 'A test.', camera=camera_of(recorded().truth), compressed=False)
    assert f'readout_time: {abs(readout.value):.6f}'.rstrip('0') in text


def test_the_interval_does_not_touch_a_readout_far_below():
    result, final = evaluated_at(0.02, 1e-3)
    assert result.readout_time.value == pytest.approx(0.02, abs=1e-12)
    np.testing.assert_allclose(result.R_cam_imu, final.unknowns.R_cam_imu, atol=1e-12)
    assert result.warnings == ()


def test_a_readout_for_certain_beyond_the_interval_is_refused():
    with pytest.raises(InputError, match='which no camera can do'):
        evaluated_at(0.037, 1e-3)


# -- several recordings of one camera -----------------------------------------------------------


def repeated_fits(offsets: list[float]) -> list[Fit]:
    """The undisturbed fit with other offsets [s], each with a doubt that they share."""
    final, _ = undisturbed()
    by_doubt = np.zeros((GLOBAL, 1))
    by_doubt[OFFSET] = 1e-4
    fits = []
    for offset in offsets:
        parameters = final.unknowns.parameters.copy()
        parameters[OFFSET] = offset
        fits.append(
            dataclasses.replace(
                final,
                unknowns=final.unknowns._replace(parameters=parameters),
                covariance=final.covariance + by_doubt @ by_doubt.T,
                by_doubt=by_doubt,
            )
        )
    return fits


def test_recordings_that_agree_share_their_doubts_and_average_their_noise():
    fits = repeated_fits([0.05] * 4)
    found = combined(fits, np.zeros((4, 9)), 0)
    alone = fits[0].covariance
    together = found.fit.covariance
    assert not found.between.any()
    assert found.fit.unknowns.parameters[OFFSET] == pytest.approx(0.05)
    assert together[READOUT, READOUT] == pytest.approx(alone[READOUT, READOUT] / 4.0, rel=1e-6)
    noise = alone[OFFSET, OFFSET] - 1e-8
    assert together[OFFSET, OFFSET] == pytest.approx(noise / 4.0 + 1e-8, rel=1e-6)


def test_sigma_of_a_value_that_differs_between_recordings_covers_another_one():
    rng = np.random.default_rng(3)
    inside = 0
    for _ in range(200):
        offsets = 0.05 + 1.5e-3 * rng.standard_normal(5)
        found = combined(repeated_fits(list(offsets[:4])), np.zeros((4, 9)), 1)
        sigma = math.sqrt(found.fit.covariance[OFFSET, OFFSET])
        inside += abs(offsets[4] - found.fit.unknowns.parameters[OFFSET]) < sigma
    # 68.3 % with a standard error of 3.3 %.
    assert 0.58 < inside / 200 < 0.80


def test_axes_of_recordings_are_averaged_as_rotations():
    first, second = repeated_fits([0.05, 0.05])
    turn = Rotation.from_rotvec([0.002, 0.0, -0.004]).as_matrix()
    R = first.unknowns.R_cam_imu
    second = dataclasses.replace(second, unknowns=second.unknowns._replace(R_cam_imu=turn @ R))
    found = combined([first, second], np.zeros((2, 9)), 0)
    half = Rotation.from_matrix(found.fit.unknowns.R_cam_imu @ R.T).as_rotvec()
    np.testing.assert_allclose(half, [0.001, 0.0, -0.002], atol=2e-5)


def test_several_recordings_give_one_calibration():
    """Offsets that differ by some milliseconds, as after restarts of a driver."""
    recordings = []
    for seed, offset in ((41, 0.048), (42, 0.051), (43, 0.054)):
        rng = np.random.default_rng(seed)
        truth = dataclasses.replace(recorded().truth, time_offset=offset)
        source = record(truth, rng)
        recordings.append(CalibrationInput(source.tracks, source.gyro, camera_of(truth), True, {}))
    common = calibrate_together(recordings, CalibrationConfig())
    result = common.result
    alone = common.of_recordings
    assert result.frames == sum(one.frames for one in alone)
    readout = result.readout_time
    assert abs(readout.value - recorded().truth.readout_time) < 3.0 * readout.sigma < 2e-3
    assert readout.sigma < np.mean([one.readout_time.sigma for one in alone])
    assert abs(result.time_offset.value - 0.051) < 2e-3
    assert 2e-3 < result.time_offset.sigma < 8e-3
    assert common.between['time_offset'][0] > 2e-3
    other = dataclasses.replace(recordings[1], camera=camera_of(truth, 300.0))
    with pytest.raises(InputError, match='different CameraInfo'):
        calibrate_together([recordings[0], other], CalibrationConfig())


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
    names = np.unique(groups)
    scores = np.array([(mean - samples[groups == name]).sum() for name in names])[:, None]
    curvatures = np.array([np.count_nonzero(groups == name) for name in names], dtype=float)
    whole = np.array([[float(len(samples))]])
    variances = Groups(scores, curvatures[:, None, None], whole).jackknife()
    return mean, math.sqrt(variances[0])


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


def test_jackknife_leaves_one_group_out_each():
    """Exact for a linear fit: the optimum without a group is that of the fit to the others."""
    rng = np.random.default_rng(7)
    groups = np.repeat(np.arange(6), 8)
    A = rng.normal(size=(48, 3))
    y = rng.normal(size=48)
    whole = np.linalg.lstsq(A, y, rcond=None)[0]
    parts = [np.flatnonzero(groups == g) for g in range(6)]
    moves = [
        np.linalg.lstsq(np.delete(A, part, axis=0), np.delete(y, part), rcond=None)[0] - whole
        for part in parts
    ]
    scores = np.array([A[part].T @ (A[part] @ whole - y[part]) for part in parts])
    curvatures = np.array([A[part].T @ A[part] for part in parts])
    found = Groups(scores, curvatures, A.T @ A).jackknife()
    np.testing.assert_allclose(found, of_few_groups(6) * (np.array(moves) ** 2).sum(axis=0))


@pytest.mark.parametrize(('shift', 'least', 'most'), [(0.0, 0.5, 1.2), (1.5, 7.0, 9.0)])
def test_halves_are_apart_if_what_is_measured_changes(shift, least, most):
    """Sixty times a mean of ten groups, whose second half has moved."""
    rng = np.random.default_rng(8)
    found = []
    for _ in range(60):
        values = rng.normal(size=10) + shift * np.repeat([-1.0, 1.0], 5)
        scores = (values.mean() - values)[:, None]
        curvatures = np.ones((10, 1, 1))
        groups = Groups(scores, curvatures, np.array([[10.0]]))
        found.append(groups.halves_apart(1.0))
    assert least < np.mean(found) < most


def test_halves_are_not_apart_for_what_only_a_prior_determines_in_each():
    """A slope over an abscissa that is constant within each half; its prior is off by a sigma."""
    rng = np.random.default_rng(9)
    at = np.repeat([-1.0, 1.0], 5)
    A = np.stack([np.ones(10), at], axis=1)
    values = 1.0 * at + 0.01 * rng.normal(size=10)
    information = 1e4 * A[:, :, None] * A[:, None, :]
    hessian = information.sum(axis=0) + np.diag([0.0, 1.0])
    whole = np.linalg.solve(hessian, 1e4 * A.T @ values)
    scores = 1e4 * (A @ whole - values)[:, None] * A
    assert Groups(scores, information, hessian).halves_apart(1.0) < 2.0


def test_stretches_last_a_second_but_are_ten_at_least():
    assert len(np.unique(stretches(np.linspace(0.0, 3.0, 100)))) == 10
    groups = stretches(np.linspace(5.0, 25.0, 1001))
    assert len(np.unique(groups)) == 20
    assert (np.diff(groups) >= 0).all() and abs(np.bincount(groups) - 50).max() <= 1


def test_noise_density_of_a_moving_gyro():
    rng = np.random.default_rng(2)
    times = np.arange(2000) / 200.0
    swing = np.sin(2.0 * np.pi * np.outer(times, [1.0, 0.7, 1.3]))
    rates = swing + 3e-4 * math.sqrt(200.0) * rng.standard_normal((2000, 3))
    assert noise_density(times, rates) == pytest.approx(3e-4, rel=0.1)
