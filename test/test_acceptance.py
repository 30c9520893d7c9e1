"""Recordings that the model of a calibration does not describe have no values for use."""

from dataclasses import replace
from types import SimpleNamespace

from drawn_recordings import camera_of, recorded
import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from rs_relpose_lab.experiments.calibration_tracks import Recorded
from rs_relpose_ros.calibrate import acceptance, evaluation
from rs_relpose_ros.calibrate.procedure import calibrate
from rs_relpose_ros.calibrate.result import CalibrationResult, parameter_file, report
from rs_relpose_ros.calibration import model
from rs_relpose_ros.calibration.image_motion import gains, repeated_axis
from rs_relpose_ros.config.settings import TRACKED_IN_IMAGES
from rs_relpose_ros.errors import InputError
from rs_relpose_ros.geometry.camera import RollingShutterCamera

# The first one of them compiles the kernels of a calibration where no cache has them.
pytestmark = pytest.mark.timeout(400)


def calibrated(one: Recorded, camera: RollingShutterCamera) -> CalibrationResult:
    return calibrate(one.tracks, one.gyro, camera, config=TRACKED_IN_IMAGES)


def beside(one: Recorded, disparity: float = 10.0) -> Recorded:
    """Two views in one image: each point again, a width to the right."""
    tracks = one.tracks
    width = one.truth.width
    points = np.concatenate([tracks.points, tracks.points + np.array([width - disparity, 0.0])])
    kept = np.ones(len(points), dtype=bool)
    kept[len(tracks.points) :] = tracks.points[:, 0] >= disparity
    frames = np.tile(tracks.frames, 2)[kept]
    ids = np.concatenate([tracks.ids, tracks.ids + tracks.ids.max() + 1])[kept]
    order = np.argsort(frames, kind='stable')
    both = replace(tracks, frames=frames[order], ids=ids[order], points=points[kept][order])
    return replace(one, tracks=both)


def test_two_views_in_one_image_are_refused():
    one = recorded(41, frames=90)
    camera = camera_of(one)
    wide = replace(camera, width=2 * camera.width, cx=float(camera.width))
    with pytest.raises(InputError, match='two views in one image, beside each other'):
        calibrated(beside(one), wide)


def flow(rng: np.random.Generator, motion: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Points (N, 2) of an image of 400x300 pixels, moved by a linear function of the place."""
    points = rng.random((120, 2)) * [400.0, 300.0]
    return points, points + (points - [200.0, 150.0]) @ motion + rng.normal(0, 0.1, (120, 2))


def test_one_view_that_turns_and_approaches_is_one_view():
    rng = np.random.default_rng(0)
    turning = np.array([[0.01, 0.03], [-0.03, 0.01]])
    assert repeated_axis([flow(rng, turning) for _ in range(12)], (400, 300)) is None
    # A view that only pans has the same motion everywhere, and is one view nonetheless.
    assert repeated_axis([flow(rng, 0.0 * turning) for _ in range(12)], (400, 300)) is None


def test_a_squeezed_image_does_not_bend_what_a_node_needs():
    one = recorded(42, frames=240)
    camera = camera_of(one)
    points = one.tracks.points * [0.8, 1.0]
    squeezed = replace(one, tracks=replace(one.tracks, points=points))
    result = calibrated(squeezed, replace(camera, width=1024, cx=0.8 * camera.cx))
    assert not result.failure
    for value, true in (
        (result.readout_time, one.truth.readout_time),
        (result.time_offset, one.truth.time_offset),
    ):
        assert abs(value.value - true) < 4.0 * value.sigma
    turn = Rotation.from_matrix(result.R_cam_imu @ one.truth.R_cam_imu.T).as_rotvec()
    assert (np.abs(turn) < 4.0 * result.rotation_sigma).all()
    note = ' '.join(result.warnings)
    assert 'contradict the CameraInfo' in note and 'focal lengths fx' in note


def test_a_vibrating_gyro_determines_neither_readout_nor_offset():
    one = recorded(43, frames=240)
    camera = camera_of(one)
    shaken = one.gyro.rates + np.random.default_rng(1).normal(0.0, 0.25, one.gyro.rates.shape)
    result = calibrated(replace(one, gyro=replace(one.gyro, rates=shaken)), camera)
    assert not (result.readout_time.determined or result.time_offset.determined)
    assert abs(result.readout_time.value - one.truth.readout_time) < result.readout_time.sigma
    assert not result.complete
    assert 'vibration' in '\n'.join(report(result, camera))
    text = parameter_file(result, 'A test.', camera=camera)
    assert '    readout_time:' not in text and '    quat_cam_imu_xyzw:' in text


def rates(seed: int = 0) -> tuple[np.ndarray, np.ndarray]:
    """Slow and fast rates (300, 3) of a hand [rad/s], 30 per second."""
    times = np.arange(300) / 30.0
    rng = np.random.default_rng(seed)
    phases = rng.uniform(0.0, 6.28, (2, 3, 1))
    slow = 0.4 * np.sin(2.0 * np.pi * 0.3 * times + phases[0])
    fast = 0.2 * np.sin(2.0 * np.pi * np.array([[2.5], [3.1], [4.0]]) * times + phases[1])
    return slow.T, fast.T


@pytest.mark.parametrize(('share', 'is_stabilised'), [(1.0, False), (0.9, False), (0.3, True)])
def test_a_stabilised_image_follows_slow_rotations_only(share, is_stabilised):
    slow, fast = rates()
    noise = np.random.default_rng(2).normal(0.0, 0.02, slow.shape)
    found = gains(slow + share * fast + noise, slow + fast, 1.0 / 30.0)
    assert found.are_stabilised == is_stabilised
    assert found.fast == pytest.approx(share, abs=0.1)


def test_a_wrong_focal_length_is_no_stabilisation():
    slow, fast = rates()
    assert not gains(0.5 * (slow + fast), slow + fast, 1.0 / 30.0).are_stabilised


def test_halves_that_contradict_each_other_give_no_value(monkeypatch, tmp_path):
    one = recorded(44, frames=120)
    camera = camera_of(one)
    right = calibrated(one, camera)
    assert right.complete and not right.failure
    monkeypatch.setattr(acceptance, '_HALVES_APART', -1.0)
    result = calibrated(one, camera)
    assert 'both halves' in result.failure
    assert not any(part.determined for part in result.needed)
    assert f'NOT USABLE: {result.failure}' in report(result, camera)


def test_claims_of_lens_and_gyro_that_are_both_refuted_are_a_failure(monkeypatch):
    final = SimpleNamespace(
        unknowns=SimpleNamespace(parameters=np.zeros(1)),
        covariance=np.zeros((1, 1)),
        free=np.zeros(40, dtype=bool),
        halves_apart=0.0,
    )
    data = SimpleNamespace(exposure=SimpleNamespace(assumed=np.zeros(1)))
    for lens, gyro, fails in ((9.0, 9.0, True), (9.0, 1.0, False), (1.0, 9.0, False)):
        monkeypatch.setattr(acceptance, 'contradiction', lambda *_, value=lens: value)
        monkeypatch.setattr(acceptance, '_gyro_distance', lambda *_, value=gyro: value)
        assert bool(acceptance._failure(data, final)) == fails


def test_a_zoom_is_named():
    one = recorded(45, frames=180)
    camera = camera_of(one)
    middle = np.array([camera.cx, camera.cy])
    share = one.tracks.frames / one.tracks.frames.max() - 0.5
    zoomed = middle + (one.tracks.points - middle) * (1.0 + 0.05 * share)[:, None]
    result = calibrated(replace(one, tracks=replace(one.tracks, points=zoomed)), camera)
    (note,) = (text for text in result.warnings if 'focal_drift' in text)
    assert 4.0 < float(note.split('changes by ')[1].split(' %')[0]) < 6.0


@pytest.mark.parametrize(('principal_point', 'is_named'), [(639.5, True), (500.0, False)])
def test_a_camera_matrix_of_another_resolution_is_named(principal_point, is_named):
    one = recorded(46, frames=2)
    camera = replace(camera_of(one), cx=639.5, cy=359.5)
    off = np.zeros(model.GLOBAL)
    off[model.FOCAL] = np.log(0.5)
    off[model.CENTER] = np.array([principal_point, 359.5]) - [1279.5, 719.5]
    camera = replace(camera, cx=principal_point)
    found = evaluation._of_another_resolution(camera, off)
    assert ('another resolution, 2.00 times as large' in found) == is_named


def test_a_gyro_in_another_unit_and_a_view_that_does_not_turn_are_refused():
    one = recorded(47, frames=120)
    camera = camera_of(one)
    in_degrees = replace(one, gyro=replace(one.gyro, rates=np.degrees(one.gyro.rates)))
    with pytest.raises(InputError, match='it is in deg/s'):
        calibrated(in_degrees, camera)
    other = recorded(48, frames=120)
    turned = 20.0 * np.linalg.norm(one.gyro.rates) / np.linalg.norm(other.gyro.rates)
    fast = replace(other.gyro, rates=turned * other.gyro.rates)
    with pytest.raises(InputError, match='does not turn against the camera'):
        calibrated(replace(one, gyro=fast), camera)


def test_regions_that_contradict_each_other_are_named():
    factors = np.ones(model.GLOBAL)
    assert acceptance.regions_in_words(SimpleNamespace(regions=factors)) == ''
    factors[model.OFFSET] = 12.0
    assert 'static_region' in acceptance.regions_in_words(SimpleNamespace(regions=factors))
