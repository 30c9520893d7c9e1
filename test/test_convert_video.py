"""Videos with telemetry as bags: stamps, axes, read-out time, and what is refused."""

from __future__ import annotations

import json
from pathlib import Path
import sys
from typing import Any

import cv2
from made_videos import add_gopro_tags, brightness, turn_for_display, write_gcsv, write_video
import numpy as np
import pytest

from rs_relpose_ros.bags.reader import open_bag
from rs_relpose_ros.cli import main
from rs_relpose_ros.config.parameter_file import read_parameters
from rs_relpose_ros.convert.telemetry import read_telemetry
from rs_relpose_ros.convert.video import START_NS
from rs_relpose_ros.convert.video_frames import Video
from rs_relpose_ros.messages.incoming import (
    image_from_message,
    imu_sample_from_message,
    intrinsics_from_info,
    stamp_ns,
)

# Instants [1/30000 s] of frames whose rate varies, as phones record.
TICKS = [0, 1000, 2033, 3000, 5000, 6001, 7001]
RATE_HZ = 6 * 30_000 / TICKS[-1]
# Of the telemetry: up along the columns of the image, to the left, backwards.
RATE = (0.1, -0.2, 0.3)
FORCE_G = (1.0, 0.1, -0.2)
GRAVITY = 9.80665


def make_video(folder: Path, name: str = 'clip', **header: object) -> Path:
    write_video(folder / f'{name}.mp4', TICKS)
    write_gcsv(folder / f'{name}.gcsv', [(5 * k, *RATE, *FORCE_G) for k in range(60)], **header)
    return folder / f'{name}.mp4'


def converted(path: Path, bag: Path, *options: str) -> dict[str, list[Any]]:
    """Messages by topic of the bag that the command writes."""
    assert main.main(['convert', 'video', str(path), str(bag), *options]) == 0
    read: dict[str, list[Any]] = {}
    with open_bag(bag) as opened:
        for message in opened.messages(opened.topics):
            read.setdefault(message.topic, []).append(message.message)
    return read


def refused(path: Path, bag: Path, words: str, capsys: pytest.CaptureFixture[str],
            *options: str) -> None:
    assert main.main(['convert', 'video', str(path), str(bag), *options]) == 2
    captured = capsys.readouterr()
    assert captured.err.startswith('rs_relpose: error: ') and captured.err.count('\n') == 1
    assert words in captured.err
    assert not bag.exists() and not bag.with_name(f'{bag.name}.yaml').exists()


# --- what is written


def test_frames_keep_their_varying_instants(tmp_path):
    read = converted(make_video(tmp_path), tmp_path / 'bag')
    images = read['/camera/image_raw/compressed']
    assert [stamp_ns(image.header) - START_NS for image in images] == [
        round(tick * 1e9 / 30_000) for tick in TICKS]
    for number, image in enumerate(images):
        pixels = image_from_message(image).image.decoded()
        assert pixels.shape == (48, 64)
        assert abs(np.median(pixels) - brightness(number)) < 6
    assert '/camera/camera_info' not in read


def test_imu_is_in_the_cameras_axes(tmp_path):
    read = converted(make_video(tmp_path), tmp_path / 'bag')
    samples = [imu_sample_from_message(message) for message in read['/imu/data_raw']]
    assert [sample.stamp_ns - START_NS for sample in samples] == [
        5_000_000 * k for k in range(60)]
    # x right is minus left, y down minus up, z forwards minus backwards.
    np.testing.assert_allclose(samples[7].angular_velocity, (0.2, -0.1, -0.3), rtol=1e-6)
    np.testing.assert_allclose(samples[7].linear_acceleration,
                               (-0.1 * GRAVITY, -GRAVITY, 0.2 * GRAVITY), rtol=1e-6)
    parameters = read_parameters(tmp_path / 'bag.yaml')
    np.testing.assert_array_equal(parameters.sensor.R_cam_imu, np.eye(3))


def test_rotation_for_display_is_not_applied(tmp_path):
    path = make_video(tmp_path)
    turn_for_display(path)
    assert cv2.VideoCapture(str(path)).read()[1].shape[:2] == (64, 48)   # OpenCV turns it
    images = converted(path, tmp_path / 'bag')['/camera/image_raw/compressed']
    assert image_from_message(images[0]).image.decoded().shape == (48, 64)


# --- read-out time


def test_readout_time_that_the_file_tells(tmp_path):
    converted(make_video(tmp_path, frame_readout_time=15.25), tmp_path / 'bag')
    sensor = read_parameters(tmp_path / 'bag.yaml').sensor
    assert sensor.readout_time == pytest.approx(0.01525)
    assert sensor.readout_direction == 'down'
    assert 'Told by the file' in (tmp_path / 'bag.yaml').read_text()


def test_readout_upwards(tmp_path):
    path = make_video(tmp_path, frame_readout_time=15.25, frame_readout_direction='BottomToTop')
    converted(path, tmp_path / 'bag')
    sensor = read_parameters(tmp_path / 'bag.yaml').sensor
    assert (sensor.readout_time, sensor.readout_direction) == (0.01525, 'up')


def test_readout_by_columns(tmp_path, capsys):
    path = make_video(tmp_path, frame_readout_time=15.25, frame_readout_direction='LeftToRight')
    refused(path, tmp_path / 'bag', 'column by column', capsys)


def test_readout_time_that_nobody_tells(tmp_path, capsys):
    converted(make_video(tmp_path), tmp_path / 'bag')
    assert 'read-out time is not known: rs_relpose calibrate' in capsys.readouterr().out
    assert read_parameters(tmp_path / 'bag.yaml').sensor.readout_time is None


PROFILE = {
    'camera_brand': 'ACME', 'camera_model': 'Model-1', 'fps': 30.1, 'frame_readout_time': -12.5,
    'calib_dimension': {'w': 128, 'h': 96}, 'orig_dimension': {'w': 64, 'h': 48},
    'fisheye_params': {
        'camera_matrix': [[100.5, 0.0, 63.5], [0.0, 101.5, 47.5], [0.0, 0.0, 1.0]],
        'distortion_coeffs': [0.1, -0.02, 0.003, -0.0004]}}


def write_profile(path: Path, **changes: object) -> Path:
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_text(json.dumps({**PROFILE, **changes}))
    return path


def check_profile_is_used(read: dict[str, list[Any]]) -> None:
    intrinsics = intrinsics_from_info(read['/camera/camera_info'][0])
    assert (intrinsics.width, intrinsics.height) == (64, 48)
    assert (intrinsics.fx, intrinsics.fy) == (50.25, 50.75)
    # The middle of the image is the middle at every scale.
    assert (intrinsics.cx, intrinsics.cy) == (31.5, 23.5)
    assert intrinsics.distortion_model == 'equidistant'
    assert intrinsics.distortion == (0.1, -0.02, 0.003, -0.0004)


@pytest.mark.parametrize('whole_folder', [False, True])
def test_lens_profile_is_a_guess(tmp_path, whole_folder):
    folder = tmp_path / 'profiles'
    file = write_profile(folder / 'Acme' / 'one.json', fps=RATE_HZ)
    write_profile(folder / 'Acme' / 'rate.json')
    write_profile(folder / 'other.json', camera_model='Model 2', fps=RATE_HZ)
    (folder / 'list.json').write_text('{"version": 1}')
    given = folder if whole_folder else file
    check_profile_is_used(converted(make_video(tmp_path), tmp_path / 'bag',
                                    '--lens-profile', str(given)))
    sensor = read_parameters(tmp_path / 'bag.yaml').sensor
    assert (sensor.readout_time, sensor.readout_direction) == (0.0125, 'up')
    assert 'A GUESS, not told by the file: lens profile one.json' in ' '.join(
        line.strip(' #') for line in (tmp_path / 'bag.yaml').read_text().splitlines())


def test_what_the_file_tells_comes_before_a_guess(tmp_path):
    file = write_profile(tmp_path / 'one.json')
    check_profile_is_used(converted(make_video(tmp_path, frame_readout_time=15.25),
                                    tmp_path / 'bag', '--lens-profile', str(file)))
    assert read_parameters(tmp_path / 'bag.yaml').sensor.readout_time == pytest.approx(0.01525)


@pytest.mark.parametrize('changes, words', [
    ({'calib_dimension': {'w': 128, 'h': 72}}, 'not the shape of the video'),
    ({'distortion_model': 'gopro'}, "distortion model 'gopro' is not supported"),
    ({'input_horizontal_stretch': 1.33}, 'input_horizontal_stretch must be 1'),
    ({'fisheye_params': {}}, 'no lens profile: it needs'),
    ({'calib_dimension': {'w': 'x', 'h': 72}}, 'no lens profile: it needs'),
    ({'frame_readout_time': 10012.5}, 'column by column')])
def test_lens_profile_that_does_not_fit(tmp_path, capsys, changes, words):
    file = write_profile(tmp_path / 'one.json', **changes)
    refused(make_video(tmp_path), tmp_path / 'bag', words, capsys, '--lens-profile', str(file))


def test_lens_profiles_to_choose_from(tmp_path, capsys):
    path, folder = make_video(tmp_path), tmp_path / 'profiles'
    folder.mkdir()
    options = ('--lens-profile', str(folder))
    refused(path, tmp_path / 'bag', 'has no lens profile of Acme Model 1, 64x48', capsys, *options)
    for name in ('a', 'b'):
        write_profile(folder / f'{name}.json', fps=RATE_HZ)
    refused(path, tmp_path / 'bag', 'has 2 lens profiles', capsys, *options)
    refused(path, tmp_path / 'bag', 'there is no lens profile', capsys, '--lens-profile',
            str(tmp_path / 'absent'))
    (folder / 'a.json').write_text('[')
    refused(path, tmp_path / 'bag', 'a.json: no JSON', capsys, *options)


# --- what is refused


@pytest.mark.parametrize('tags', [{'EISE': 'Y'}, {'EISE': 'N', 'EISA': 'HS HLevel'}])
def test_stabilised_video(tmp_path, capsys, tags):
    path = tmp_path / 'clip.mp4'
    write_video(path, TICKS)
    add_gopro_tags(path, **tags)
    refused(path, tmp_path / 'bag', 'is stabilised in the camera', capsys)


def test_tags_of_a_video_that_is_not_stabilised(tmp_path, capsys):
    path = tmp_path / 'clip.mp4'
    write_video(path, TICKS)
    add_gopro_tags(path, EISE='N', EISA='N', MINF='HERO9 Black')
    refused(path, tmp_path / 'bag', '(GoPro HERO9 Black) has no gyro', capsys)


def test_file_that_stops_the_library(tmp_path, capsys):
    path = tmp_path / 'clip.mp4'
    write_video(path, TICKS)
    add_gopro_tags(path, whole=False, EISE='N')   # its reader panics at the end of the file
    refused(path, tmp_path / 'bag', 'telemetry-parser cannot read it', capsys)


@pytest.mark.parametrize('module, package', [('telemetry_parser', 'telemetry-parser'),
                                             ('av', 'av')])
def test_library_that_is_not_installed(tmp_path, capsys, monkeypatch, module, package):
    path = make_video(tmp_path)
    monkeypatch.setitem(sys.modules, module, None)
    refused(path, tmp_path / 'bag', f'need the Python package {package}, which is not installed: '
            'pip install av telemetry-parser', capsys)


def test_video_without_telemetry(tmp_path, capsys):
    path = tmp_path / 'clip.mp4'
    write_video(path, TICKS)
    refused(path, tmp_path / 'bag', 'has no telemetry', capsys)
    refused(tmp_path / 'absent.mp4', tmp_path / 'bag', 'there is no video', capsys)


def test_damaged_video(tmp_path, capsys):
    path = make_video(tmp_path)
    data = path.read_bytes()
    path.write_bytes(data[:len(data) // 2])
    refused(path, tmp_path / 'bag', str(path), capsys)
    # The index is whole, the frames are not.
    start = data.index(b'mdat') + 4
    end = data.index(b'moov') - 4
    path.write_bytes(data[:start] + b'\xff' * (end - start) + data[end:])
    refused(path, tmp_path / 'bag', str(path), capsys)


# --- recordings


@pytest.mark.recordings
def test_gopro(recordings, tmp_path):
    path = recordings / 'gopro_samples' / 'karma.mp4'
    read = converted(path, tmp_path / 'bag')
    images = read['/camera/image_raw/compressed']
    assert len(images) == 362
    assert [stamp_ns(image.header) - START_NS for image in images] == [
        round(k * 1001 / 30000 * 1e9) for k in range(362)]
    assert image_from_message(images[0]).image.decoded().shape == (480, 854)
    gyro = [imu_sample_from_message(message) for message in read['/imu/gyro']]
    accel = [imu_sample_from_message(message) for message in read['/imu/accel']]
    assert len(gyro) == 4795 and len(accel) == 2397
    # The accelerometer has half the gyro's rate, and covers the same time.
    assert np.diff([sample.stamp_ns for sample in accel]).mean() == pytest.approx(
        2 * np.diff([sample.stamp_ns for sample in gyro]).mean(), rel=1e-3)
    assert abs(accel[-1].stamp_ns - gyro[-1].stamp_ns) < 10_000_000
    # A gimbal holds it level: specific force is up, -y of the camera; at first the drone flies
    # faster and faster, forwards.
    forces = np.array([sample.linear_acceleration for sample in accel])
    assert np.abs(forces.mean(axis=0) - (0.2, -9.69, 0.2)).max() < 0.1
    assert forces[:400, 2].mean() > 1.5
    assert read_parameters(tmp_path / 'bag.yaml').sensor.readout_time is None


@pytest.mark.recordings
def test_gopro_turns_as_its_images(recordings):
    """Pan of the images, by far points, against the gyro."""
    path = recordings / 'gopro_samples' / 'karma.mp4'
    gyro = read_telemetry(path, 0).gyro
    times = np.array([sample.stamp_ns for sample in gyro]) * 1e-9
    yaw = np.array([sample.angular_velocity[1] for sample in gyro])
    turned = np.concatenate([[0.0], np.cumsum(yaw[1:] * np.diff(times))])
    video, shifts, before = Video(path), [], None
    for number in range(len(video)):
        data = np.frombuffer(video.jpeg(number), dtype=np.uint8)
        gray = cv2.imdecode(data, cv2.IMREAD_GRAYSCALE)[:235]   # above the horizon
        if before is not None:
            points = cv2.goodFeaturesToTrack(before, 200, 0.005, 8)
            moved, found, _ = cv2.calcOpticalFlowPyrLK(before, gray, points, None)
            shifts.append(np.median((moved - points)[found.ravel() == 1][:, 0, 0]))
        before = gray
    instants = np.arange(len(shifts) + 1) * 1001 / 30000 - 0.03
    rates = np.diff(np.interp(instants, times, turned))
    # To the right (about y, down) by the gyro: points move to the left.
    assert np.corrcoef(rates, shifts)[0, 1] < -0.97


@pytest.mark.recordings
def test_gopro_that_levelled_its_horizon(recordings, tmp_path, capsys):
    path = recordings / 'gopro_samples' / 'max-heromode.mp4'
    refused(path, tmp_path / 'bag', "stabilised in the camera (GoPro's EISE is Y)", capsys)
