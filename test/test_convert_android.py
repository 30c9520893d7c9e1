"""Folders of phone loggers as bags: made ones, one of the bundled bag, and a recorded one."""

from __future__ import annotations

from collections.abc import Callable
import json
import logging
from pathlib import Path
from typing import Any

import cv2
from damaged_files import removed, replaced
from made_videos import brightness, write_video
import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from rs_relpose_ros.bags.reader import open_bag
from rs_relpose_ros.cli import main
from rs_relpose_ros.config.parameter_file import read_parameters
from rs_relpose_ros.messages.incoming import (
    image_from_message,
    imu_sample_from_message,
    intrinsics_from_info,
    stamp_ns,
)

START = 296_906_159_688_983
MILLISECOND = 10**6
STAMPS = [START + 33 * MILLISECOND * k for k in range(5)]
IMU_STAMPS = [START - 20 * MILLISECOND + 5 * MILLISECOND * k for k in range(50)]
# Of a back camera with SENSOR_ORIENTATION 90: x is minus the phone's y, and so on.
PHONE_AXES = Rotation.from_matrix([[0, -1, 0], [-1, 0, 0], [0, 0, -1]])


def picture(number: int, width: int = 64, height: int = 48) -> bytes:
    pixels = np.full((height, width, 3), brightness(number), dtype=np.uint8)
    return cv2.imencode('.jpg', pixels)[1].tobytes()


def write_table(path: Path, header: str, rows: list[list[object]]) -> None:
    path.write_text('\n'.join([header, *(','.join(map(str, row)) for row in rows)]) + '\n')


def converted(folder: Path, bag: Path) -> dict[str, list[Any]]:
    """Messages by topic of the bag that the command writes."""
    assert main.main(['convert', 'android', str(folder), str(bag)]) == 0
    read: dict[str, list[Any]] = {}
    with open_bag(bag) as opened:
        for message in opened.messages(opened.topics):
            read.setdefault(message.topic, []).append(message.message)
    return read


def sensor_axes(bag: Path) -> Rotation:
    parameters = read_parameters(bag.with_name(f'{bag.name}.yaml'))
    return Rotation.from_matrix(parameters.sensor.R_cam_imu)


def samples_of(read: dict[str, list[Any]], topic: str) -> list[Any]:
    return [imu_sample_from_message(message) for message in read[topic]]


# --- PoseCam


def make_posecam(folder: Path) -> Path:
    (folder / 'frames').mkdir(parents=True)
    rows: list[list[object]] = []
    for number, stamp in enumerate(STAMPS):
        saved = number != 2
        pose = [''] * 7 if number == 1 else [0.1 * number, 0.2, 0.3, 0, 0, 0, 1]
        rows.append([number, stamp, *pose,
                     'PAUSED:INSUFFICIENT_FEATURES' if number == 1 else 'TRACKING',
                     'saved' if saved else 'dropped:queue_full'])
        if saved:
            (folder / 'frames' / f'{number:06d}_{stamp}.jpg').write_bytes(picture(number))
    write_table(folder / 'poses.csv',
                'frame_index,timestamp_ns,tx,ty,tz,qx,qy,qz,qw,tracking_state,image', rows)
    write_table(folder / 'frame_metadata.csv',
                'frame_index,timestamp_ns,exposure_time_ns,frame_duration_ns,'
                'rolling_shutter_skew_ns,sensitivity_iso,focus_distance_diopters,focal_length_mm,'
                'ois_mode',
                [[number, stamp, 4_000_000 + number, 33_000_000, '' if number == 0 else 21_500_000,
                  100, 0.5, 4.3, 0] for number, stamp in enumerate(STAMPS)])
    imu: list[list[object]] = []
    for stamp in IMU_STAMPS:
        imu += [[stamp, 'accel', 0.05, 9.8, 0.5, '', '', ''],
                [stamp + 1_000_000, 'gyro_uncal', '-5.5E-4', 0.25, 0.5, 0.01, 0.02, -0.03]]
    write_table(folder / 'imu.csv', 'timestamp_ns,sensor,x,y,z,bias_x,bias_y,bias_z', imu)
    (folder / 'intrinsics.json').write_text(json.dumps(
        {'width': 64, 'height': 48, 'fx': 50.5, 'fy': 51.5, 'cx': 32.5, 'cy': 23.5}))
    (folder / 'device.json').write_text(json.dumps({'camera': {'sensor_orientation_deg': 90}}))
    (folder / 'manifest.json').write_text(json.dumps({'pose_jumps': {'count': 0, 'jumps': []}}))
    return folder


def test_posecam(tmp_path):
    read = converted(make_posecam(tmp_path / 'in'), tmp_path / 'bag')
    images = read['/camera/image_raw/compressed']
    assert [stamp_ns(image.header) for image in images] == [
        stamp for number, stamp in enumerate(STAMPS) if number != 2]
    assert images[2].data.tobytes() == picture(3)
    gyro, accel = samples_of(read, '/imu/gyro'), samples_of(read, '/imu/accel')
    assert [sample.stamp_ns for sample in accel] == IMU_STAMPS
    assert gyro[0].stamp_ns == IMU_STAMPS[0] + MILLISECOND
    assert gyro[0].angular_velocity == (-5.5e-4, 0.25, 0.5) and gyro[0].linear_acceleration is None
    assert accel[0].linear_acceleration == (0.05, 9.8, 0.5) and accel[0].angular_velocity is None
    assert '/camera/camera_info' not in read
    parameters = read_parameters(tmp_path / 'bag.yaml')
    sensor = parameters.sensor
    assert (sensor.readout_time, sensor.readout_direction) == (0.0215, 'down')
    assert (sensor.stamp_row, sensor.stamp_exposure) == ('first', 'start')
    assert sensor.exposure_time == pytest.approx(0.004, abs=1e-6)
    np.testing.assert_allclose(parameters.imu.gyro_bias, (0.01, 0.02, -0.03))
    assert parameters.intrinsics.camera_matrix == (50.5, 0, 32.5, 0, 51.5, 23.5, 0, 0, 1)
    assert (sensor_axes(tmp_path / 'bag') * PHONE_AXES.inv()).magnitude() < 1e-7


def test_poses_of_arcore_are_those_of_the_optical_frame(tmp_path):
    """An upright camera of ARCore looks along -z of the world, in which y is up."""
    read = converted(make_posecam(tmp_path / 'in'), tmp_path / 'bag')
    poses = read['/ground_truth/pose']
    assert [stamp_ns(pose.header) for pose in poses] == [STAMPS[k] for k in (0, 2, 3, 4)]
    position, q = poses[1].pose.position, poses[1].pose.orientation
    assert (position.x, position.y, position.z) == (0.2, 0.2, 0.3)
    optical = Rotation.from_quat([q.x, q.y, q.z, q.w])
    np.testing.assert_allclose(optical.apply([0, 0, 1]), [0, 0, -1], atol=1e-12)   # forwards
    np.testing.assert_allclose(optical.apply([0, 1, 0]), [0, -1, 0], atol=1e-12)   # down
    np.testing.assert_allclose(optical.apply([1, 0, 0]), [1, 0, 0], atol=1e-12)    # right


def test_jump_of_the_poses_ends_the_truth(tmp_path, caplog):
    folder = make_posecam(tmp_path / 'in')
    (folder / 'manifest.json').write_text(json.dumps(
        {'pose_jumps': {'count': 1, 'jumps': [{'frame_index': 2, 'timestamp_ns': STAMPS[2]}]}}))
    with caplog.at_level(logging.WARNING):
        read = converted(folder, tmp_path / 'bag')
    assert [stamp_ns(pose.header) for pose in read['/ground_truth/pose']] == STAMPS[2:]
    assert 'relocalised 1 times' in caplog.text and '3 of 4 poses' in caplog.text


def test_posecam_without_its_descriptions(tmp_path, caplog):
    folder = make_posecam(tmp_path / 'in')
    for name in ('frame_metadata.csv', 'intrinsics.json', 'device.json', 'manifest.json'):
        (folder / name).unlink()
    converted(folder, tmp_path / 'bag')
    parameters = read_parameters(tmp_path / 'bag.yaml')
    assert parameters.sensor.readout_time is None and not parameters.intrinsics.given
    assert 'ASSUMED: back camera' in (tmp_path / 'bag.yaml').read_text()


def test_optical_stabilisation_is_told(tmp_path, caplog):
    folder = make_posecam(tmp_path / 'in')
    text = (folder / 'frame_metadata.csv').read_text()
    (folder / 'frame_metadata.csv').write_text(text.replace(',4.3,0\n', ',4.3,1\n', 1))
    converted(folder, tmp_path / 'bag')
    assert 'optical stabilisation was on' in caplog.text


@pytest.mark.parametrize('degrees', [0, 90, 180, 270])
def test_axes_by_sensor_orientation(tmp_path, degrees):
    """Turned clockwise by the angle, the image is upright: the phone's y is up in it."""
    folder = make_posecam(tmp_path / 'in')
    (folder / 'device.json').write_text(
        json.dumps({'camera': {'sensor_orientation_deg': degrees}}))
    converted(folder, tmp_path / 'bag')
    # About z, which looks away from the screen, x turns to y: clockwise as the image is seen.
    upright = Rotation.from_euler('z', degrees, degrees=True) * sensor_axes(tmp_path / 'bag')
    np.testing.assert_allclose(upright.apply([0, 1, 0]), [0, -1, 0], atol=1e-7)
    np.testing.assert_allclose(upright.apply([1, 0, 0]), [1, 0, 0], atol=1e-7)


def make_posecam_of_bag(bag: Path, folder: Path, duration: float) -> None:
    """A PoseCam folder with what PoseCam would have written, had it recorded a bag."""
    parameters = read_parameters(bag.with_name(f'{bag.name}.yaml'))
    sensor, gyro_bias = parameters.sensor, parameters.imu.gyro_bias
    phone_of_imu = PHONE_AXES.as_matrix().T @ sensor.R_cam_imu
    (folder / 'frames').mkdir(parents=True)
    imu: list[list[object]] = []
    poses: dict[int, list[object]] = {}
    stamps: list[int] = []
    with open_bag(bag) as opened:
        for message in opened.messages(opened.topics):
            data = message.message
            stamp = stamp_ns(data.header)
            if message.topic == '/imu/data_raw':
                sample = imu_sample_from_message(data)
                imu += [[stamp, 'accel', *phone_of_imu @ sample.linear_acceleration, '', '', ''],
                        [stamp, 'gyro_uncal', *phone_of_imu @ sample.angular_velocity,
                         *phone_of_imu @ gyro_bias]]
            elif message.topic == '/ground_truth/pose':
                q, p = data.pose.orientation, data.pose.position
                turn = Rotation.from_quat([q.x, q.y, q.z, q.w]) * Rotation.from_euler(
                    'x', 180, degrees=True)
                poses[stamp] = [p.x, p.y, p.z, *turn.as_quat()]
            elif message.topic.endswith('compressed'):
                (folder / 'frames' / f'{len(stamps):06d}_{stamp}.jpg').write_bytes(
                    data.data.tobytes())
                stamps.append(stamp)
            if stamps and stamp > stamps[0] + duration * 1e9:
                break
    known = np.array(sorted(poses))
    rows = []
    for number, stamp in enumerate(stamps):
        near = int(known[np.abs(known - stamp).argmin()])
        exact = near == stamp
        rows.append([number, stamp, *(poses[near] if exact else [''] * 7),
                     'TRACKING' if exact else 'PAUSED:NONE', 'saved'])
    write_table(folder / 'poses.csv',
                'frame_index,timestamp_ns,tx,ty,tz,qx,qy,qz,qw,tracking_state,image', rows)
    write_table(folder / 'imu.csv', 'timestamp_ns,sensor,x,y,z,bias_x,bias_y,bias_z', imu)
    write_table(folder / 'frame_metadata.csv', 'frame_index,timestamp_ns,rolling_shutter_skew_ns',
                [[number, stamp, round(sensor.readout_time * 1e9)]
                 for number, stamp in enumerate(stamps)])
    (folder / 'intrinsics.json').write_text(json.dumps(
        {'width': 640, 'height': 480, 'fx': 450.0, 'fy': 450.0, 'cx': 325.9, 'cy': 234.7}))


def test_recording_with_poses_is_a_test_with_truth(tmp_path, bundled_bag):
    """A bag as a phone would have logged it: converted and replayed, its errors are told."""
    make_posecam_of_bag(bundled_bag, tmp_path / 'in', duration=2.5)
    converted(tmp_path / 'in', tmp_path / 'bag')
    code = main.main(['replay', str(tmp_path / 'bag'), '--params', str(tmp_path / 'bag.yaml'),
                      '--set', 'distortion_coefficients=[-0.12, 0.05, 0.0008, -0.0005, 0]',
                      '--out', str(tmp_path / 'out'), '--no-pictures'])
    assert code == 0
    errors = json.loads((tmp_path / 'out' / 'summary.json').read_text())['errors_against_truth']
    assert errors['pairs'] >= 6
    assert errors['rotation_median_deg'] < 0.05
    assert errors['translation_median_deg'] < 2.0


# --- MARS Logger

MARS_TICKS = [1000 * k for k in range(len(STAMPS))]


def make_mars(folder: Path, clock: str = 'REALTIME', difference: int = 0) -> Path:
    folder.mkdir(parents=True)
    write_video(folder / 'movie.mp4', MARS_TICKS)
    camera = [stamp - difference for stamp in STAMPS]
    write_table(folder / 'frame_timestamps.txt', 'Frame timestamp[nanosec],Unix time[nanosec]',
                [[stamp, 1_600_000_000_000_000_000] for stamp in camera])
    write_table(folder / 'gyro_accel.csv',
                'Timestamp[nanosec],gx[rad/s],gy[rad/s],gz[rad/s],ax[m/s^2],ay[m/s^2],az[m/s^2],'
                'Unix time[nanosec]',
                [[stamp, 0.1, -0.2, 0.3, 0.5, 9.8, 0.1, 1] for stamp in IMU_STAMPS])
    write_table(folder / 'movie_metadata.csv',
                'Timestamp[nanosec],fx[px],fy[px],Frame No.,Exposure time[nanosec],'
                'Sensor frame duration[nanosec],Frame readout time[nanosec],ISO,Focal length,'
                'Focus distance,AF mode,Unix time[nanosec]',
                [[stamp, 60.5, 61.5, number, 10_000_000, 33_000_000, 18_000_000, 100, 4.3,
                  'null', 1, 1] for number, stamp in enumerate(camera)])
    (folder / 'edge_epochs.txt').write_text(
        '#Camera frame timestamp source according to CameraCharacteristics.SENSOR_INFO_TIMESTAMP_'
        f'SOURCE is SENSOR_INFO_TIMESTAMP_SOURCE_{clock}.\n#and more\n'
        f'{START}\t{START - difference}\t{difference}\n'
        f'{START + 5}\t{START - difference + 5}\t{difference}\n')
    return folder


@pytest.mark.parametrize('clock, difference', [('REALTIME', 0), ('UNKNOWN', 123_456_789)])
def test_mars(tmp_path, clock, difference):
    read = converted(make_mars(tmp_path / 'in', clock, difference), tmp_path / 'bag')
    images = read['/camera/image_raw/compressed']
    assert [stamp_ns(image.header) for image in images] == STAMPS   # on the IMU's clock
    for number, image in enumerate(images):
        pixels = image_from_message(image).image.decoded()
        assert abs(np.median(pixels) - brightness(number)) < 6
    samples = samples_of(read, '/imu/data_raw')
    assert [sample.stamp_ns for sample in samples] == IMU_STAMPS
    assert samples[0].angular_velocity == (0.1, -0.2, 0.3)
    assert samples[0].linear_acceleration == (0.5, 9.8, 0.1)
    parameters = read_parameters(tmp_path / 'bag.yaml')
    assert parameters.sensor.readout_time == pytest.approx(0.018)
    assert parameters.sensor.exposure_time == pytest.approx(0.010)
    assert parameters.intrinsics.camera_matrix == (60.5, 0, 31.5, 0, 61.5, 23.5, 0, 0, 1)
    assert 'A GUESS' in (tmp_path / 'bag.yaml').read_text()
    assert (sensor_axes(tmp_path / 'bag') * PHONE_AXES.inv()).magnitude() < 1e-7


# --- data.jsonl

CALIBRATION = {'cameras': [{
    'focalLengthX': 55.0, 'focalLengthY': 56.0, 'principalPointX': 31.0, 'principalPointY': 24.0,
    'model': 'kannala-brandt4', 'distortionCoefficients': [0.1, 0.02, -0.003, 0.0004],
    'imageWidth': 64, 'imageHeight': 48,
    'imuToCamera': [[0, -1, 0, 0], [-1, 0, 0, 0], [0, 0, -1, 0], [0, 0, 0, 1]]}]}


def make_jsonl(folder: Path, calibration: object = CALIBRATION) -> Path:
    folder.mkdir(parents=True)
    write_video(folder / 'data.mp4', MARS_TICKS)
    lines = []
    for k in range(40):
        lines += [{'sensor': {'type': 'gyroscope', 'values': [0.1, -0.2, 0.3]}, 'time': k * 0.005},
                  {'sensor': {'type': 'accelerometer', 'values': [0, 9.8, 0.1]},
                   'time': k * 0.005 + 0.001},
                  {'sensor': {'type': 'magnetometer', 'values': [1, 2, 3]}, 'time': k * 0.005}]
    lines += [{'frames': [{'cameraInd': 0}], 'number': k, 'time': f'@0.0{k}3000001@'}
              for k in range(len(STAMPS))]
    text = '\n'.join(map(json.dumps, lines)).replace('"@', '').replace('@"', '')
    (folder / 'data.jsonl').write_text(text + '\n\n')
    if calibration is not None:
        (folder / 'calibration.json').write_text(json.dumps(calibration))
    return folder


def test_jsonl(tmp_path):
    read = converted(make_jsonl(tmp_path / 'in'), tmp_path / 'bag')
    images = read['/camera/image_raw/compressed']
    assert [stamp_ns(image.header) - 10**12 for image in images] == [
        (10 * k + 3) * MILLISECOND + 1 for k in range(len(STAMPS))]
    intrinsics = intrinsics_from_info(read['/camera/camera_info'][0])
    assert (intrinsics.fx, intrinsics.fy, intrinsics.cx, intrinsics.cy) == (55, 56, 31, 24)
    assert intrinsics.distortion_model == 'equidistant'
    assert intrinsics.distortion == (0.1, 0.02, -0.003, 0.0004)
    assert samples_of(read, '/imu/gyro')[1].angular_velocity == (0.1, -0.2, 0.3)
    assert samples_of(read, '/imu/accel')[0].linear_acceleration == (0, 9.8, 0.1)
    assert (sensor_axes(tmp_path / 'bag') * PHONE_AXES.inv()).magnitude() < 1e-7


def test_jsonl_without_calibration(tmp_path):
    assert '/camera/camera_info' not in converted(make_jsonl(tmp_path / 'in', None),
                                                  tmp_path / 'bag')


# --- tables


def make_tables(folder: Path, *, as_video: bool = False) -> Path:
    folder.mkdir(parents=True)
    if as_video:
        write_video(folder / 'a.MP4', MARS_TICKS)
        write_table(folder / 'frames.csv', 'timestamp_ns', [[stamp] for stamp in STAMPS])
    else:
        for number in range(len(STAMPS)):
            (folder / f'{number}.jpg').write_bytes(picture(number))
        write_table(folder / 'frames.csv', 'frame,stamp_ns,file',
                    [[number, stamp, f'{number}.jpg'] for number, stamp in enumerate(STAMPS)])
    write_table(folder / 'gyro.csv', 'stamp_ns,x,y,z',
                [[stamp, 0.1, -0.2, 0.3] for stamp in reversed(IMU_STAMPS)])
    write_table(folder / 'accel.csv', 'stamp_ns,x,y,z',
                [[stamp + 7, 0.1, 9.8, 0.3] for stamp in IMU_STAMPS])
    return folder


@pytest.mark.parametrize('as_video', [False, True])
def test_tables(tmp_path, as_video):
    read = converted(make_tables(tmp_path / 'in', as_video=as_video), tmp_path / 'bag')
    images = read['/camera/image_raw/compressed']
    assert [stamp_ns(image.header) for image in images] == STAMPS
    assert [sample.stamp_ns for sample in samples_of(read, '/imu/gyro')] == IMU_STAMPS
    assert samples_of(read, '/imu/accel')[2].stamp_ns == IMU_STAMPS[2] + 7


def test_tables_without_accelerometer(tmp_path):
    folder = make_tables(tmp_path / 'in')
    (folder / 'accel.csv').unlink()
    read = converted(folder, tmp_path / 'bag')
    assert samples_of(read, '/imu/data_raw')[0].linear_acceleration is None


@pytest.mark.recordings
def test_phone_recording(recordings, tmp_path):
    folder = recordings / 'android_phone_rs'
    read = converted(folder, tmp_path / 'bag')
    images = read['/camera/image_raw/compressed']
    files = sorted((folder / 'images').iterdir())
    assert len(images) == len(files) == 330
    assert all(image.data.tobytes() == file.read_bytes()
               for image, file in zip(images, files, strict=True))
    assert len(read['/imu/gyro']) == 2389 and len(read['/imu/accel']) == 2393
    # What its README found of the axes.
    assert (sensor_axes(tmp_path / 'bag') * PHONE_AXES.inv()).magnitude() < 1e-7


# --- what cannot be used


def portrait(name: str) -> Callable[[Path], None]:
    return lambda folder: write_video(folder / name, MARS_TICKS, width=48, height=64)


DAMAGE = [
    (make_posecam, removed('imu.csv'), 'is of no known logger'),
    (make_posecam, removed(f'frames/000003_{STAMPS[3]}.jpg'), 'there is no image'),
    (make_posecam, replaced('poses.csv', ',image', ',picture'), 'has no column image'),
    (make_posecam, replaced('poses.csv', '0.2,0.3,0,0,0,1', '0.2,0.3,0,0,0,2'),
     'quaternion must have length 1'),
    (make_posecam, replaced('poses.csv', str(STAMPS[0]), '1.5e9'), 'must be a stamp'),
    (make_posecam, replaced('imu.csv', 'gyro_uncal', 'magnet'), "got 'magnet'"),
    (make_posecam, replaced('imu.csv', '0.25', 'nan'), 'must be a finite number'),
    (make_posecam, replaced('intrinsics.json', '50.5', 'null'), 'must have the numbers fx'),
    (make_posecam, replaced('intrinsics.json', '"width": 64', '"width": 24'), 'were rotated'),
    (make_posecam, replaced('device.json', '{', '['), 'no JSON'),
    (make_mars, removed('gyro_accel.csv'), 'is of no known logger'),
    (make_mars, replaced('frame_timestamps.txt', f'{STAMPS[2]},', '#'), 'has 4 stamps, but'),
    (make_mars, replaced('gyro_accel.csv', 'gx[rad/s]', 'gx'), 'has no column gx[rad/s]'),
    (make_mars, portrait('movie.mp4'), 'were rotated'),
    (make_mars, replaced('frame_timestamps.txt', str(STAMPS[1]), str(STAMPS[0])), 'not after'),
    (lambda folder: make_mars(folder, 'UNKNOWN', 5_000_000),
     replaced('edge_epochs.txt', '\t5000000\n', '\t9000000\n'), 'the phone slept'),
    (make_jsonl, removed('data.mp4'), 'has no video'),
    (make_jsonl, portrait('data.mp4'), 'were rotated'),
    (make_jsonl, replaced('data.jsonl', '"number": 2', '"number": null'), 'number must be'),
    (make_jsonl, replaced('data.jsonl', '[0.1, -0.2, 0.3]', '[0.1, -0.2]'), 'three numbers'),
    (make_jsonl, replaced('data.jsonl', '"time": 0.0}', '"time": "soon"}'), 'time must be'),
    (make_jsonl, replaced('data.jsonl', '"time": 0.0}', '"time": -2000.0}'), 'must not be below'),
    (make_jsonl, replaced('data.jsonl', '{', ''), 'line 1: no JSON'),
    (make_jsonl, replaced('calibration.json', 'kannala-brandt4', 'fov'), "'fov'"),
    (make_jsonl, replaced('calibration.json', '"imageWidth": 64', '"imageWidth": 640'),
     'the calibration is for 640x48'),
    (make_tables, removed('gyro.csv'), 'is of no known logger'),
    (make_tables, replaced('frames.csv', '3.jpg', '../3.jpg'), 'lies outside'),
    (make_tables, replaced('frames.csv', ',file', ',name'), 'has 0 videos'),
    (make_tables, lambda folder: (folder / '3.jpg').write_bytes(picture(3, 32, 48)),
     'has 32x48 pixels, but the first image has 64x48'),
    (make_tables, replaced('accel.csv', '9.8', ''), 'must be a finite number'),
    (make_tables, lambda folder: (folder / 'gyro.csv').write_text('stamp_ns,x,y,z\n'),
     'has no rows'),
]


@pytest.mark.parametrize('make, damage, words', DAMAGE)
def test_damaged_folder(tmp_path, capsys, make, damage, words):
    folder = make(tmp_path / 'in')
    damage(folder)
    assert main.main(['convert', 'android', str(folder), str(tmp_path / 'bag')]) == 2
    captured = capsys.readouterr()
    assert captured.err.startswith('rs_relpose: error: ') and captured.err.count('\n') == 1
    assert words in captured.err
    assert not (tmp_path / 'bag').exists() and not (tmp_path / 'bag.yaml').exists()
