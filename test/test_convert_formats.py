"""`convert phone`, `euroc` and `calibration`: axes, signs and units against a simulated walk."""

import csv
import json

from conftest import run_command
import logged_walks as made
import numpy as np
import pytest
from scipy.spatial.transform import Rotation
from test_convert import Converted, converted
from test_convert import refused as not_converted

from rs_relpose_lab.simulation.config import SimulationConfig
from rs_relpose_lab.simulation.simulation import simulate
from rs_relpose_ros.bags.convert import FORMATS
from rs_relpose_ros.cli import recordings
from rs_relpose_ros.config.files import read_parameters
from rs_relpose_ros.errors import InputError, MissingInputError

LOGGERS = {
    'sensor_logger_android': lambda folder, walk: made.sensor_logger(folder, walk, apple=False),
    'sensor_logger_ios': lambda folder, walk: made.sensor_logger(folder, walk, apple=True),
    'ios_logger': made.ios_logger,
    'stray_scanner': made.stray_scanner,
    'opencamera_sensors': made.opencamera_sensors,
    'tables': made.tables,
    'spreadsheet': lambda folder, walk: made.tables(folder, walk, spreadsheet=True),
}


@pytest.fixture(scope='module')
def walk():
    return made.phone_walk()


def imu_of(read: Converted) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Stamps, rates and specific forces."""
    both = '/imu/data_raw' in read.messages
    gyro = read.samples('/imu/data_raw' if both else '/imu/gyro')
    accel = gyro if both else read.samples('/imu/accel')
    stamps = np.array([sample.stamp_ns for sample in gyro])
    assert [sample.stamp_ns for sample in accel] == stamps.tolist()
    rates = np.array([sample.angular_velocity for sample in gyro])
    return stamps, rates, np.array([sample.linear_acceleration for sample in accel])


def poses_are_right(walk, folder, bag, *settings):
    """Rotations and directions of a replay are those of the simulation."""
    out = folder / 'replay'
    arguments = ['replay', str(bag), '--params', f'{bag}.yaml', '--no-pictures', '--out', str(out)]
    for setting in settings:
        arguments += ['--set', setting]
    run_command(*arguments)
    with (out / 'relative_poses.csv').open() as file:
        rows = [row for row in csv.DictReader(file) if row['tx'] not in ('', 'nan')]
    assert len(rows) >= 2
    shift = made.stamps(walk)[0] - min(int(row['reference_stamp_ns']) for row in rows)
    rotations = []
    translations = []
    for row in rows:
        times = [int(row[name]) + shift for name in ('reference_stamp_ns', 'stamp_ns')]
        states = walk.states(times)
        R1, R2 = states.R_world_cam
        t = R1.T @ (states.position[1] - states.position[0])
        estimate = Rotation.from_quat([float(row[name]) for name in ('qx', 'qy', 'qz', 'qw')])
        rotations.append((estimate.inv() * Rotation.from_matrix(R1.T @ R2)).magnitude())
        cosine = np.dot([float(row[name]) for name in ('tx', 'ty', 'tz')], t) / np.linalg.norm(t)
        translations.append(np.arccos(np.clip(cosine, -1.0, 1.0)))
    assert np.degrees(np.median(rotations)) < 0.3
    assert np.degrees(np.median(translations)) < 3.0


def of_lens(walk):
    fx, fy, cx, cy = made.lens_of(walk)
    return (
        f'readout_time={walk.config.readout_time}',
        f'camera_matrix=[{fx}, 0, {cx}, 0, {fy}, {cy}, 0, 0, 1]',
        f'distortion_coefficients={list(walk.camera.distortion)}',
    )


@pytest.mark.parametrize('name', LOGGERS)
def test_logger_against_the_walk(name, walk, tmp_path):
    folder = LOGGERS[name](tmp_path / 'in', walk)
    read = converted('phone', folder, tmp_path / 'bag')
    boot_ns = made.START_NS - 77 * 10**9 if name == 'stray_scanner' else 0
    assert [stamp + boot_ns for stamp in read.stamps()] == made.stamps(walk)
    stamps, rates, forces = imu_of(read)
    assert (stamps + boot_ns).tolist() == walk.imu.stamps_ns.tolist()
    np.testing.assert_allclose(rates, walk.imu.angular_velocities, atol=1e-9)
    np.testing.assert_allclose(forces, walk.imu.linear_accelerations, atol=1e-6)
    assert (read.axes * made.PHONE_AXES.inv()).magnitude() < 1e-7
    for number in (0, 7):
        assert np.abs(read.pixels(number).astype(float) - walk.image(number)).mean() < 6
    poses_are_right(walk, tmp_path, tmp_path / 'bag', *of_lens(walk))


@pytest.mark.parametrize('name', ['tables', 'ios_logger', 'stray_scanner', 'opencamera_sensors'])
def test_upright_recordings_are_turned_back_to_the_rows_of_the_sensor(name, walk, tmp_path):
    upright = made.Upright(walk)
    read = converted('phone', LOGGERS[name](tmp_path / 'in', upright), tmp_path / 'bag')
    assert (read.axes * made.PHONE_AXES.inv()).magnitude() < 1e-7
    for number in (0, 7):
        assert np.abs(read.pixels(number).astype(float) - walk.image(number)).mean() < 6
    if name in ('ios_logger', 'stray_scanner'):
        found = read.parameters.intrinsics.camera_matrix
        np.testing.assert_allclose(np.take(found, (0, 4, 2, 5)), made.lens_of(walk))
    poses_are_right(walk, tmp_path, tmp_path / 'bag', *of_lens(walk))


def test_intrinsics_of_a_logger_are_a_parameter(walk, tmp_path):
    fx, fy, cx, cy = made.lens_of(walk)
    for name in ('ios_logger', 'stray_scanner'):
        read = converted('phone', LOGGERS[name](tmp_path / name, walk), tmp_path / f'{name}_bag')
        found = read.parameters.intrinsics.camera_matrix
        np.testing.assert_allclose(found, (fx, 0, cx, 0, fy, cy, 0, 0, 1))
        assert '/camera/camera_info' not in read.messages


def test_poses_of_stray_scanner_are_the_truth(walk, tmp_path):
    read = converted('phone', made.stray_scanner(tmp_path / 'in', walk), tmp_path / 'bag')
    states = walk.states(made.stamps(walk))
    for message, R, p in zip(
        read.of('/ground_truth/pose'), states.R_world_cam, states.position, strict=True
    ):
        q = message.pose.orientation
        position = message.pose.position
        np.testing.assert_allclose(
            Rotation.from_quat([q.x, q.y, q.z, q.w]).as_matrix(), R, atol=1e-9
        )
        np.testing.assert_allclose((position.x, position.y, position.z), p)


def test_euroc_against_the_walk(tmp_path):
    walk = simulate(SimulationConfig(**made.OF_WALK, lever_arm=(0.05, -0.02, 0.03)))
    read = converted('euroc', made.euroc(tmp_path / 'in', walk), tmp_path / 'bag')
    assert read.stamps() == made.stamps(walk)
    np.testing.assert_array_equal(read.pixels(3), walk.image(3))
    stamps, rates, forces = imu_of(read)
    assert stamps.tolist() == walk.imu.stamps_ns.tolist()
    np.testing.assert_allclose(rates, walk.imu.angular_velocities)
    np.testing.assert_allclose(forces, walk.imu.linear_accelerations)
    axes = Rotation.from_matrix(walk.config.R_cam_imu)
    assert (read.axes * axes.inv()).magnitude() < 1e-7
    np.testing.assert_allclose(read.parameters.imu.imu_position, (0.05, -0.02, 0.03), atol=1e-8)
    assert (read.intrinsics.fx, read.intrinsics.cy) == (walk.camera.fx, walk.camera.cy)
    assert read.readout[0] is None
    states = walk.states(walk.imu.stamps_ns)
    message = read.of('/ground_truth/pose')[17]
    q = message.pose.orientation
    position = message.pose.position
    turned = Rotation.from_quat([q.x, q.y, q.z, q.w]).as_matrix()
    np.testing.assert_allclose(turned, states.R_world_cam[17], atol=1e-7)
    np.testing.assert_allclose(
        (position.x, position.y, position.z), states.position[17], atol=1e-6
    )
    poses_are_right(walk, tmp_path, tmp_path / 'bag', f'readout_time={walk.config.readout_time}')


def test_android_is_an_alias(walk, tmp_path):
    folder = made.tables(tmp_path / 'in', walk)
    assert converted('android', folder, tmp_path / 'a').stamps() == made.stamps(walk)


def test_the_only_recording_in_a_folder_is_found(walk, tmp_path):
    made.ios_logger(tmp_path / 'in' / '2024-01-02T03-04-05', walk)
    assert converted('phone', tmp_path / 'in', tmp_path / 'a').stamps() == made.stamps(walk)


def test_every_logger_has_a_reader():
    assert {one.name for one in FORMATS if one.source == 'phone'} == set(recordings.PHONES)


def test_formats_that_are_named_and_not_read(tmp_path):
    folder = tmp_path / 'in'
    folder.mkdir()
    for name in ('video_recording.mp4', 'video_meta.pb3'):
        (folder / name).write_bytes(b'x')
    not_converted('phone', folder, tmp_path / 'bag', 'is of VideoIMUCapture', kind=InputError)


def test_euroc_given_to_phone_is_named(tmp_path):
    walk = simulate(SimulationConfig(**{**made.OF_WALK, 'duration': 0.5}))
    folder = made.euroc(tmp_path / 'in', walk)
    not_converted(
        'phone', folder, tmp_path / 'bag', 'rs_relpose convert euroc', kind=MissingInputError
    )


@pytest.mark.parametrize(
    'make, words', [(made.euroc, 'convert euroc'), (made.tables, 'convert phone')]
)
def test_a_folder_that_is_no_bag_is_named(make, words, tmp_path, refused):
    walk = simulate(SimulationConfig(**{**made.OF_WALK, 'duration': 0.5}))
    folder = make(tmp_path / 'in', walk)
    for command in ('check', 'replay', 'calibrate'):
        refused(f'rs_relpose {words} {folder} OUT_BAG', command, folder)


def test_stamps_that_are_not_of_all_frames(walk, tmp_path):
    folder = made.opencamera_sensors(tmp_path / 'in', walk)
    path = next(folder.glob('*/*_timestamps.csv'))
    path.write_text('\n'.join(path.read_text().splitlines()[:-1]) + '\n')
    not_converted('phone', folder, tmp_path / 'bag', 'has 13 stamps, but', kind=InputError)


def test_acceleration_of_an_unknown_unit(walk, tmp_path):
    folder = made.ios_logger(tmp_path / 'in', walk)
    rows = [line.split(',') for line in (folder / 'Accel.txt').read_text().splitlines()]
    made.lines(
        folder / 'Accel.txt', [[row[0], *(100 * float(v) for v in row[1:])] for row in rows]
    )
    not_converted('phone', folder, tmp_path / 'bag', 'neither in g nor in m/s^2', kind=InputError)


# --- calibrations

T_CAM_IMU = np.eye(4)
T_CAM_IMU[:3, :3] = Rotation.from_euler('zyx', [80.0, -70.0, 5.0], degrees=True).as_matrix()
T_CAM_IMU[:3, 3] = (0.04, -0.11, 0.02)
LENS = (401.5, 399.25, 331.0, 236.5)
DISTORTION = [-0.21, 0.06, 0.0007, -0.0003]
IMU_TEXT = (
    'gyroscope_noise_density: 0.0013\ngyroscope_random_walk: 2.1e-05\n'
    'accelerometer_noise_density: 0.019\naccelerometer_random_walk: 0.0017\n'
)
NOISE = (0.0013, 0.019, 2.1e-5, 0.0017)


def chain(name: str, transform: np.ndarray, head: str = '') -> str:
    return (
        f'{head}cam0:\n  {name}:\n'
        + ''.join(f'  - {row}\n' for row in transform.tolist())
        + f'  camera_model: pinhole\n  intrinsics: {list(LENS)}\n  distortion_model: radtan\n'
        f'  distortion_coeffs: {DISTORTION}\n  resolution: [640, 480]\n'
        '  timeshift_cam_imu: -0.0125\n'
    )


def matrix_text(transform: np.ndarray) -> str:
    return f'\n   rows: 4\n   cols: 4\n   dt: f\n   data: {transform.ravel().tolist()}\n'


INVERSE = np.linalg.inv(T_CAM_IMU)
SENSOR_YAML = (
    f'sensor_type: camera\nT_BS:{matrix_text(INVERSE)}resolution: [640, 480]\n'
    f'camera_model: pinhole\nintrinsics: {list(LENS)}\n'
    f'distortion_model: radial-tangential\ndistortion_coefficients: {DISTORTION}\n'
)
CALIBRATIONS = {
    'kalibr': (chain('T_cam_imu', T_CAM_IMU), -0.0125),
    'openvins': (chain('T_imu_cam', INVERSE, '%YAML:1.0\n\n'), -0.0125),
    'orbslam': (
        '%YAML:1.0\n\nFile.version: "1.0"\nCamera.type: "PinHole"\n'
        + ''.join(
            f'Camera1.{n}: {v}\n' for n, v in zip(('fx', 'fy', 'cx', 'cy'), LENS, strict=True)
        )
        + ''.join(
            f'Camera1.{n}: {v}\n'
            for n, v in zip(('k1', 'k2', 'p1', 'p2'), DISTORTION, strict=True)
        )
        + f'IMU.T_b_c1: !!opencv-matrix{matrix_text(INVERSE)}',
        0.0,
    ),
    'euroc': (SENSOR_YAML, 0.0),
}


@pytest.mark.parametrize('name', CALIBRATIONS)
def test_calibration_of_another_tool(name, tmp_path, caplog, capsys):
    text, offset = CALIBRATIONS[name]
    path = tmp_path / f'{name}.yaml'
    out = tmp_path / 'mine.yaml'
    path.write_text('\ufeff' + text if name == 'kalibr' else text)
    given = read_parameters(path)
    assert 'is a calibration file' in caplog.text and 'quat_cam_imu_xyzw' in caplog.text
    run_command('convert', 'calibration', path, '--out', out)
    assert 'readout time is not in this file' in capsys.readouterr().out
    for parameters in (given, read_parameters(out)):
        np.testing.assert_allclose(parameters.sensor.R_cam_imu, T_CAM_IMU[:3, :3], atol=1e-8)
        np.testing.assert_allclose(parameters.imu.imu_position, T_CAM_IMU[:3, 3], atol=1e-8)
        fx, fy, cx, cy = LENS
        assert parameters.intrinsics.camera_matrix == (fx, 0, cx, 0, fy, cy, 0, 0, 1)
        assert list(parameters.intrinsics.distortion_coefficients) == DISTORTION
        assert parameters.sensor.time_offset == offset


@pytest.mark.parametrize(
    'text', [IMU_TEXT, '%YAML:1.0\nimu0: {' + IMU_TEXT.replace('\n', ', ') + '}']
)
def test_noise_of_an_imu_file(tmp_path, text):
    (tmp_path / 'imu.yaml').write_text(text)
    imu = read_parameters(tmp_path / 'imu.yaml').to_mapping()
    names = ('gyro_noise_density', 'accel_noise_density', 'gyro_bias_walk', 'accel_bias_walk')
    assert tuple(imu[name] for name in names) == NOISE


def test_calibration_of_ros(tmp_path, capsys):
    (tmp_path / 'ost.yaml').write_text(
        'image_width: 640\nimage_height: 480\ncamera_name: c\n'
        'camera_matrix: {rows: 3, cols: 3, data: [401.5, 0, 331, 0, 399.25, 236.5, 0, 0, 1]}\n'
        'distortion_model: equidistant\n'
        'distortion_coefficients: {rows: 1, cols: 4, data: [0.1, 0.02, 0.003, 0.0004]}\n'
    )
    run_command('convert', 'calibration', tmp_path / 'ost.yaml')
    (tmp_path / 'mine.yaml').write_text(capsys.readouterr().out)
    intrinsics = read_parameters(tmp_path / 'mine.yaml').intrinsics
    assert intrinsics.camera_matrix == (401.5, 0, 331, 0, 399.25, 236.5, 0, 0, 1)
    assert intrinsics.distortion_model == 'equidistant'


@pytest.mark.parametrize(
    'old, new, words',
    [
        ('radtan', 'fov', 'distortion model fov is not supported'),
        ('model: pinhole', 'model: omni', 'camera model omni is not supported'),
        ('intrinsics: [', 'intrinsics: [3.0, ', 'is incomplete or damaged'),
        ('  - [', '  - [7', 'not orthonormal'),
    ],
)
def test_calibration_that_cannot_be_used(tmp_path, old, new, words):
    path = tmp_path / 'camchain.yaml'
    path.write_text(CALIBRATIONS['kalibr'][0].replace(old, new))
    with pytest.raises(InputError, match=words) as caught:
        read_parameters(path)
    assert '\n' not in str(caught.value)


def test_file_of_no_known_tool(tmp_path, refused):
    path = tmp_path / 'a.yaml'
    path.write_text(json.dumps({'a': 1}))
    refused('is no calibration of Kalibr', 'convert', 'calibration', path)
