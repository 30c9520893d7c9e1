"""A camera whose images are turned by 90 degrees, against the same camera with upright rows."""

from dataclasses import dataclass, replace
from functools import cache

import numpy as np
import pytest
from scipy.linalg import block_diag
from scipy.spatial.transform import Rotation
import test_frames_between
from test_frames_between import CAMERA, Scene, TIMES
import test_monitor
from test_monitor import NONE

from rs_relpose_lab.experiments.calibration_tracks import record, Truth
from rs_relpose_lab.simulation import simulate, SimulationConfig
from rs_relpose_lab.simulation.bag import intrinsics_of
from rs_relpose_lab.simulation.render import Renderer
from rs_relpose_lab.simulation.turned import turned_axes, turned_camera, turned_pixels
from rs_relpose_ros import FrameMotion, InertialMotion, RollingShutterCamera
from rs_relpose_ros.calibrate.procedure import calibrate
from rs_relpose_ros.calibrate.result import parameter_file
from rs_relpose_ros.calibration.findings import Code, FindingState
from rs_relpose_ros.calibration.findings_text import line
from rs_relpose_ros.calibration.readout_direction import ReadoutDirections, turned_cameras
from rs_relpose_ros.config.files import read_parameters
from rs_relpose_ros.estimator.problem import build_problem
from rs_relpose_ros.geometry.timing import ImageClock, Sensor
from rs_relpose_ros.pipeline.global_shutter import MiddleRow

# Quarter turns to the left, and the direction of the readout afterwards.
TURNS = {'right': 1, 'left': 3}


@pytest.fixture(params=TURNS)
def direction(request):
    return request.param


@pytest.fixture
def turns(direction):
    return TURNS[direction]


def random_pixels(camera, count=50, border=0.0):
    rng = np.random.default_rng(1)
    return rng.uniform(border, [camera.width - 1 - border, camera.height - 1 - border], (count, 2))


# -- the camera -----------------------------------------------------------------------------------


@pytest.mark.parametrize('reference_row', ['first', 'middle', 'last'])
@pytest.mark.parametrize('read', ['down', 'up'])
def test_times_and_rays_of_a_turned_pixel_stay(turns, read, reference_row):
    camera = replace(CAMERA, readout_direction=read, reference_row=reference_row)
    turned = turned_camera(camera, turns)
    pixels = random_pixels(camera)
    moved = turned_pixels(pixels, camera, turns)
    assert (turned.width, turned.height) == (480, 640)
    assert (turned.readout_axis, turned.row_count) == (0, 480)
    np.testing.assert_allclose(turned.pixel_times(moved), camera.pixel_times(pixels), atol=1e-15)
    np.testing.assert_allclose(turned.row_time_span, camera.row_time_span, atol=1e-15)
    np.testing.assert_allclose(
        turned.unproject(moved) @ turned_axes(turns).T, camera.unproject(pixels), atol=1e-12
    )
    # Shares of the readout count from the row of the smallest number.
    same_order = camera.reads_forward == turned.reads_forward
    np.testing.assert_allclose(
        turned.readout_shares(moved),
        camera.readout_shares(pixels) * (1.0 if same_order else -1.0),
        atol=1e-12,
    )


def test_a_turned_camera_reads_to_the_right_or_left(direction, turns):
    turned = turned_camera(CAMERA, turns)
    assert turned.readout_direction == direction
    assert turned.reads_forward is (direction == 'right')
    assert turned.signed_readout_time == pytest.approx(0.03 if direction == 'right' else -0.03)
    opposite = turned.with_signed_readout_time(-turned.signed_readout_time)
    assert opposite.readout_direction == {'right': 'left', 'left': 'right'}[direction]
    assert opposite.readout_time == pytest.approx(0.03)
    assert turned_camera(turned, 4 - turns) == CAMERA


def test_rotating_camera_shows_the_turned_pixel(turns):
    camera = CAMERA
    turned = turned_camera(camera, turns)
    R = turned_axes(turns)
    rotations = Rotation.from_rotvec(
        np.linspace(-1.0, 1.0, 9)[:, None] * np.array([0.02, -0.03, 0.05])
    ).as_matrix()
    pixels = random_pixels(camera, border=60.0)
    rays = camera.unproject(pixels)
    expected = camera.project_rotating(rays, camera.rows_of(pixels), rotations)
    moved = turned_pixels(pixels, camera, turns)
    # The rotations are those of the rows in the order of their numbers.
    ordered = rotations if turned.reads_forward else rotations[::-1]
    found = turned.project_rotating(
        rays @ R, np.ascontiguousarray(turned.rows_of(moved)), R.T @ ordered @ R
    )
    assert np.isfinite(expected).all()
    np.testing.assert_allclose(found, turned_pixels(expected, camera, turns), atol=1e-6)


def test_derivatives_by_pixels_have_the_rotation_between_rows(turns):
    """Against finite differences of derotated rays, whose row times follow the pixel."""
    camera = turned_camera(CAMERA, turns)
    motion = FrameMotion(np.array([0.4, -0.7, 0.9]))
    pixels = random_pixels(camera, border=30.0)
    problem = build_problem(pixels, pixels, camera, motion, motion, None, None)
    delay = camera.row_times(camera.middle_row)

    def derotated(moved):
        return motion.shifted(delay).derotate(
            camera.unproject(moved), camera.pixel_times(moved) - delay
        )

    step = 1e-3
    for axis, columns in ((0, slice(3, 6)), (1, slice(6, 9))):
        by = step * np.eye(2)[axis]
        numeric = (derotated(pixels + by) - derotated(pixels - by)) / (2.0 * step)
        np.testing.assert_allclose(problem.observations[:, columns], numeric, atol=1e-8)


# -- poses ----------------------------------------------------------------------------------------


@dataclass
class Twin:
    """A scene and its arguments as measured by the turned camera."""

    scene: Scene
    turns: int

    @property
    def R(self):
        return turned_axes(self.turns)

    def pixels(self, pixels):
        return turned_pixels(pixels, CAMERA, self.turns)

    def motion(self, s):
        samples = np.linspace(-0.01, 0.04, 51)
        return FrameMotion.from_gyro(samples, self.scene.motion.gyro(s + samples) @ self.R)

    def inertial(self, motion):
        both = block_diag(self.R, self.R)
        vectors = (motion.alpha, motion.beta, motion.lever_arm)
        alpha, beta, arm = (np.asarray(vector) @ self.R for vector in vectors)
        return InertialMotion(
            alpha,
            beta,
            motion.duration,
            both.T @ motion.covariance @ both,
            arm,
            motion.acceleration1 @ self.R,
            motion.acceleration2 @ self.R,
        )

    def arguments(self):
        old = self.scene.arguments
        return {
            **old,
            'points1': self.pixels(old['points1']),
            'points2': self.pixels(old['points2']),
            'camera': turned_camera(CAMERA, self.turns),
            'motion1': self.motion(0.0),
            'motion2': self.motion(TIMES[-1]),
            'relative_rotation': self.R.T @ old['relative_rotation'] @ self.R,
            'inertial': self.inertial(old['inertial']),
        }

    def between(self):
        return [
            replace(
                frame,
                points=self.pixels(frame.points),
                motion=self.motion(frame.interval),
                relative_rotation=self.R.T @ frame.relative_rotation @ self.R,
                inertial=self.inertial(frame.inertial),
            )
            for frame in self.scene.between
        ]


@pytest.mark.parametrize('frames', ['two', 'all'])
def test_pose_is_that_of_the_twin(turns, frames):
    """Also its covariance and velocities: the same numbers in other axes, up to rounding."""
    scene = Scene(3)
    twin = Twin(scene, turns)
    expected = scene.pose(**{} if frames == 'all' else {'between': ()})
    found = scene.pose(**twin.arguments(), between=twin.between() if frames == 'all' else ())
    assert (
        expected.diagnostics.frames
        == found.diagnostics.frames
        == (len(TIMES) if frames == 'all' else 2)
    )
    R = twin.R
    sigmas = np.sqrt(np.diag(expected.covariance))
    turned = R @ found.R @ R.T
    across = R @ found.t - expected.t
    assert np.abs(across / np.maximum(sigmas[:3], 1e-4)).max() < 0.02
    off = Rotation.from_matrix(turned @ expected.R.T).as_rotvec()
    assert np.abs(off / sigmas[3:]).max() < 0.02
    # The covariance of two views groups matches by 4 x 3 regions of the image, which do not turn.
    both = block_diag(R, R)
    spread = np.sqrt(np.diag(both @ found.covariance @ both.T)) / sigmas
    assert (np.abs(spread - 1.0) < 0.25).all()
    np.testing.assert_allclose(R @ found.linear_velocity1, expected.linear_velocity1, atol=5e-3)
    assert found.baseline == pytest.approx(expected.baseline, rel=2e-3)


def test_rows_in_place_of_columns_are_wrong(turns):
    """The test above can fail: with rows the rotation of the turned camera is off by sigmas."""
    scene = Scene(3)
    twin = Twin(scene, turns)
    arguments = twin.arguments()
    arguments['camera'] = replace(
        arguments['camera'], readout_direction='down', reference_row='first'
    )
    found = scene.pose(**arguments, between=())
    turned = twin.R @ found.R @ twin.R.T
    off = Rotation.from_matrix(turned @ scene.R.T).as_rotvec()
    sigmas = np.sqrt(np.diag(scene.pose(between=()).covariance))[3:]
    assert not found or np.abs(off / sigmas).max() > 3.0


# -- calibration ----------------------------------------------------------------------------------


# Camera of the simulated tracks, as assumed by a calibration.
CAMERA_OF_TRACKS = RollingShutterCamera(
    width=1280, height=720, fx=640.0, fy=640.0, cx=639.5, cy=359.5, readout_time=0.0
)


@cache
def walk():
    """Tracks of a walk, and their calibration."""
    recorded = record(Truth(frames=90, focal=640.0), np.random.default_rng(11))
    return recorded, calibrate(recorded.tracks, recorded.gyro, CAMERA_OF_TRACKS)


def test_calibration_finds_columns(turns, direction, tmp_path):
    """Without a hint, and as exactly as from the upright images.

    The sigmas of 3 s are by few stretches, so that they scatter themselves.
    """
    recorded, expected = walk()
    camera = CAMERA_OF_TRACKS
    points = turned_pixels(recorded.tracks.points, camera, turns)
    tracks = replace(recorded.tracks, points=points)
    turned = turned_camera(camera, turns)
    found = calibrate(tracks, recorded.gyro, replace(turned, readout_direction='down'))
    assert expected.readout_direction == 'down'
    assert found.readout_direction == direction and found.observable
    sign = 1.0 if direction == 'right' else -1.0
    truth = recorded.truth
    assert abs(sign * found.readout_time.value - truth.readout_time) < (
        3.0 * found.readout_time.sigma
    )
    # The offset is that of column 0, which is read last if the readout goes to the left.
    last_row = truth.readout_time * 719.0 / 720.0
    of_column_0 = truth.time_offset + (0.0 if direction == 'right' else last_row)
    assert abs(found.time_offset.value - of_column_0) < 3.0 * found.time_offset.sigma
    R = turned_axes(turns).T @ truth.R_cam_imu
    off = Rotation.from_matrix(found.R_cam_imu @ R.T).as_rotvec()
    assert (np.abs(off) < 3.5 * found.rotation_sigma).all()
    for name in ('readout_time', 'time_offset', 'rotation'):
        assert getattr(found, name).sigma < 1.5 * getattr(expected, name).sigma
    path = tmp_path / 'calibration.yaml'
    path.write_text(parameter_file(found, 'Turned.', camera=turned), encoding='utf-8')
    sensor = read_parameters(path).sensor
    assert sensor.readout_direction == direction and sensor.stamp_row == 'first'


# -- the monitor ----------------------------------------------------------------------------------


def compared(true, monkeypatch, deviation=None):
    """Findings on pairs that `true` exposed, with the configuration of the monitor's tests."""
    monkeypatch.setattr(test_monitor, 'deviating', lambda camera, c: true)
    rng = np.random.default_rng(4)
    directions = ReadoutDirections()
    for k in range(9):
        pair = test_monitor.pair_data(0.4 * k, 0.4 * k + 0.3, NONE)
        noise = rng.normal(0.0, 0.2, (2, *pair.points1.shape))
        pair = replace(pair, points1=pair.points1 + noise[0], points2=pair.points2 + noise[1])
        directions.add(k, pair, NONE if deviation is None else deviation)
    return directions.findings(test_monitor.CAMERA)


@pytest.mark.parametrize('side', [0, 1], ids=list(TURNS))
def test_columns_are_named_with_what_to_set(side, monkeypatch):
    true = turned_cameras(test_monitor.CAMERA)[side]
    (finding,) = compared(true, monkeypatch)
    expected = [('right', 'first'), ('left', 'last')][side]
    assert finding.code is Code.READOUT_DIRECTION and finding.state is FindingState.WRONG
    assert tuple(finding.settings.values()) == expected
    assert finding.evidence.log_likelihood > 5.0
    assert f'set readout_direction: {expected[0]} and stamp_row: {expected[1]}' in line(finding)


def test_rows_are_not_taken_for_columns(monkeypatch):
    """Neither with the right readout, nor with one that a deviation explains."""
    camera = test_monitor.CAMERA
    assert compared(camera, monkeypatch) == ()
    shorter = replace(camera, readout_time=0.01)
    by_readout = test_monitor.deviation(readout_time=-0.02)
    assert compared(shorter, monkeypatch, by_readout) == ()
    upwards = camera.with_signed_readout_time(-0.03)
    assert compared(upwards, monkeypatch, test_monitor.deviation(readout_time=-0.06)) == ()


# -- simulation -----------------------------------------------------------------------------------


@dataclass
class TurnedTrajectory:
    """The trajectory of the turned camera."""

    trajectory: object
    R: np.ndarray

    def poses(self, times):
        positions, rotations = self.trajectory.poses(times)
        return positions, rotations @ self.R


def test_rendered_image_is_the_turned_one(turns):
    config = SimulationConfig(duration=0.2, width=160, height=120, fx=110.0, rotation_rate=2.0)
    simulation = simulate(config)
    camera = simulation.camera
    upright = simulation.renderer
    turned = Renderer(
        upright.scene,
        turned_camera(camera, turns),
        TurnedTrajectory(upright.trajectory, turned_axes(turns)),
    )
    expected = np.rot90(upright.render(0.1), turns)
    # Pixels at the outline of a surface may have another surface by rounding.
    differences = np.abs(turned.render(0.1) - expected)
    assert (differences > 0.5).mean() < 0.01
    pixels = random_pixels(camera)
    world, _ = upright.locate(0.1, pixels)
    moved = turned_pixels(pixels, camera, turns)
    np.testing.assert_allclose(turned.locate(0.1, moved)[0], world, atol=1e-6)
    known = np.isfinite(world).all(axis=1)
    np.testing.assert_allclose(turned.project(0.1, world[known]), moved[known], atol=1e-5)


def test_derotated_image_is_the_turned_one(turns):
    """The map of `global_shutter_node`: the same sources, turned."""
    motion = test_frames_between.Motion(np.random.default_rng(2))
    camera = replace(CAMERA, reference_row='middle')
    samples = np.linspace(-0.02, 0.02, 41)
    maps = []
    for k in (0, turns):
        one = turned_camera(camera, k)
        intrinsics = intrinsics_of(one)
        sensor = Sensor(one, intrinsics, ImageClock(one))
        rates = 3.0 * motion.gyro(samples) @ turned_axes(k)
        middle = MiddleRow(sensor)
        assert abs(middle.delay) < 1e-9
        maps.append(middle.map(FrameMotion.from_gyro(samples, rates)))
    upright, turned = (np.concatenate([band for _, band in one.bands()]) for one in maps)
    assert upright.shape == (480, 640, 2) and turned.shape == (640, 480, 2)
    expected = turned_pixels(np.rot90(upright, turns), camera, turns)
    # The camera turns by pixels; grids of nodes 8 px apart differ by hundredths.
    assert maps[0].shift > 3.0
    known = np.isfinite(expected).all(axis=-1) & np.isfinite(turned).all(axis=-1)
    assert known.mean() > 0.9
    assert np.abs(turned - expected)[known].max() < 0.05
