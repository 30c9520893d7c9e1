"""`convert`: videos, folders of phone loggers and public data sets as bags."""

from dataclasses import dataclass
import importlib.util
import json
import logging
from pathlib import Path
import re
import sys
from typing import Any

from conftest import ROOT, run_command
import cv2
import numpy as np
import pytest
import recorded_files as made
from recorded_files import removed, replaced, written
from scipy.spatial.transform import Rotation

from rs_relpose_lab import datasets
from rs_relpose_ros.bags.convert.text_files import read_rows, Row
from rs_relpose_ros.bags.convert.video import START_NS
from rs_relpose_ros.bags.reader import BagMessage, open_bag
from rs_relpose_ros.cli import main
from rs_relpose_ros.config.files import parameter_text, read_parameters
from rs_relpose_ros.config.settings import Parameters
from rs_relpose_ros.errors import InputError, MissingInputError, RsRelposeError
from rs_relpose_ros.geometry.camera import Intrinsics
from rs_relpose_ros.imu.buffer import ImuSample
from rs_relpose_ros.messages import incoming
from rs_relpose_ros.messages.camera_info import intrinsics_from_info
from rs_relpose_ros.messages.incoming import stamp_ns

IMAGES = '/camera/image_raw/compressed'
INFO = '/camera/camera_info'
TRUTH = '/ground_truth/pose'
# Of a back camera with SENSOR_ORIENTATION 90: x is minus the phone's y, and so on.
PHONE_AXES = Rotation.from_matrix([[0, -1, 0], [-1, 0, 0], [0, 0, -1]])


@dataclass
class Converted:
    """A bag that the command wrote: its messages by topic, and its parameter file."""

    messages: dict[str, list[BagMessage]]
    text: str
    parameters: Parameters

    def of(self, topic: str) -> list[Any]:
        return [message.message for message in self.messages[topic]]

    def stamps(self, topic: str = IMAGES) -> list[int]:
        return [stamp_ns(message.header) for message in self.of(topic)]

    def samples(self, topic: str) -> list[ImuSample]:
        return [incoming.imu_sample_from_message(message) for message in self.of(topic)]

    def pixels(self, number: int) -> np.ndarray:
        return incoming.image_from_message(self.of(IMAGES)[number]).decoded()

    @property
    def intrinsics(self) -> Intrinsics:
        return intrinsics_from_info(self.of(INFO)[0])

    @property
    def axes(self) -> Rotation:
        return Rotation.from_matrix(self.parameters.sensor.R_cam_imu)

    @property
    def readout(self) -> tuple[float | None, str]:
        return self.parameters.sensor.readout_time, self.parameters.sensor.readout_direction


def converted(source: str, path: Path, bag: Path, *options: str) -> Converted:
    run_command('convert', source, path, bag, *options)
    messages: dict[str, list[BagMessage]] = {}
    with open_bag(bag) as opened:
        found = opened.find_topics(needs_camera_info=False)
        assert found.image.name == IMAGES
        assert found.imu.name == ('/imu/gyro' if found.accel else '/imu/data_raw')
        times = []
        for message in opened.messages(opened.topics):
            messages.setdefault(message.topic, []).append(message)
            times.append(message.bag_time_ns)
    assert times == sorted(times)
    file = bag.with_name(f'{bag.name}.yaml')
    text = ' '.join(line.strip(' #') for line in file.read_text().splitlines())
    return Converted(messages, text, read_parameters(file))


def refused(
    source: str,
    path: Path,
    bag: Path,
    words: str,
    *options: str,
    kind: type[RsRelposeError] = RsRelposeError,
) -> None:
    """One line, and no file."""
    arguments = ['convert', source, str(path), str(bag), *options]
    with pytest.raises(kind) as caught:
        main.load_command('convert').run(main.make_parser('convert').parse_args(arguments))
    assert words in str(caught.value)
    assert '\n' not in str(caught.value)
    assert not bag.exists() and not bag.with_name(f'{bag.name}.yaml').exists()


# --- videos


def test_frames_keep_their_varying_times(tmp_path):
    read = converted('video', made.make_video(tmp_path), tmp_path / 'bag')
    assert [stamp - START_NS for stamp in read.stamps()] == [
        round(tick * 1e9 / made.TICKS_PER_SECOND) for tick in made.TICKS
    ]
    for number in range(len(made.TICKS)):
        assert read.pixels(number).shape == (48, 64)
        assert abs(np.median(read.pixels(number)) - made.brightness(number)) < 6
    assert INFO not in read.messages
    samples = read.samples('/imu/data_raw')
    assert [sample.stamp_ns - START_NS for sample in samples] == [5_000_000 * k for k in range(60)]
    # x right is minus left, y down minus up, z forwards minus backwards.
    np.testing.assert_allclose(samples[7].angular_velocity, (0.2, -0.1, -0.3), rtol=1e-6)
    np.testing.assert_allclose(
        samples[7].linear_acceleration, 9.80665 * np.array([-0.1, -1.0, 0.2]), rtol=1e-6
    )
    np.testing.assert_array_equal(read.axes.as_matrix(), np.eye(3))


def test_rotation_for_display_is_not_applied(tmp_path):
    path = made.make_video(tmp_path)
    made.rotate_for_display(path)
    assert cv2.VideoCapture(str(path)).read()[1].shape[:2] == (64, 48)  # OpenCV rotates it
    assert converted('video', path, tmp_path / 'bag').pixels(0).shape == (48, 64)


@pytest.mark.parametrize(
    'header, expected, source',
    [
        ({}, (None, 'down'), ''),
        ({'frame_readout_time': 15.25}, (0.01525, 'down'), 'Reported by the file'),
        (
            {'frame_readout_time': 15.25, 'frame_readout_direction': 'BottomToTop'},
            (0.01525, 'up'),
            'Reported by the file',
        ),
        (
            {'frame_readout_time': 15.25, 'frame_readout_direction': 'LeftToRight'},
            (0.01525, 'right'),
            'Reported by the file',
        ),
        (
            {'frame_readout_time': 15.25, 'frame_readout_direction': 'RightToLeft'},
            (0.01525, 'left'),
            'Reported by the file',
        ),
    ],
)
def test_readout_time_of_a_video(tmp_path, capsys, header, expected, source):
    read = converted('video', made.make_video(tmp_path, **header), tmp_path / 'bag')
    assert read.readout == expected
    assert source in read.text
    assert ('rs_relpose calibrate' in capsys.readouterr().out) == (not header)


PROFILE = {
    'camera_brand': 'ACME',
    'camera_model': 'Model-1',
    'fps': 30.1,
    'frame_readout_time': -12.5,
    'calib_dimension': {'w': 128, 'h': 96},
    'orig_dimension': {'w': 64, 'h': 48},
    'fisheye_params': {
        'camera_matrix': [[100.5, 0.0, 63.5], [0.0, 101.5, 47.5], [0.0, 0.0, 1.0]],
        'distortion_coeffs': [0.1, -0.02, 0.003, -0.0004],
    },
}
OF_THE_VIDEO = {'fps': 6 * made.TICKS_PER_SECOND / made.TICKS[-1]}


def write_profile(path: Path, **changes: object) -> Path:
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_text(json.dumps({**PROFILE, **changes}))
    return path


@pytest.mark.parametrize(
    'place, header, readout',
    [
        ('Acme/one.json', {}, (0.0125, 'up')),
        ('', {}, (0.0125, 'up')),
        # A value that the file reports is preferred to a guess.
        ('Acme/one.json', {'frame_readout_time': 15.25}, (0.01525, 'down')),
    ],
)
def test_the_lens_profile_of_the_video_gives_its_lens_and_readout(
    tmp_path, place, header, readout
):
    folder = tmp_path / 'profiles'
    write_profile(folder / 'Acme' / 'one.json', **OF_THE_VIDEO)
    write_profile(folder / 'Acme' / 'rate.json')
    write_profile(folder / 'other.json', camera_model='Model 2', **OF_THE_VIDEO)
    (folder / 'list.json').write_text('{"version": 1}')
    read = converted(
        'video',
        made.make_video(tmp_path, **header),
        tmp_path / 'bag',
        '--lens-profile',
        str(folder / place),
    )
    assert (read.intrinsics.width, read.intrinsics.height) == (64, 48)
    assert (read.intrinsics.fx, read.intrinsics.fy) == (50.25, 50.75)
    # The middle of the image is the middle at every scale.
    assert (read.intrinsics.cx, read.intrinsics.cy) == (31.5, 23.5)
    assert read.intrinsics.distortion_model == 'equidistant'
    assert read.intrinsics.distortion == (0.1, -0.02, 0.003, -0.0004)
    assert read.readout == readout
    assert ('A GUESS' in read.text and 'lens profile one.json' in read.text) == (not header)


@pytest.mark.parametrize(
    'changes, words',
    [
        ({'calib_dimension': {'w': 128, 'h': 72}}, 'another aspect ratio'),
        ({'distortion_model': 'gopro'}, "distortion model 'gopro' is not supported"),
        ({'input_horizontal_stretch': 1.33}, 'input_horizontal_stretch must be 1'),
        ({'fisheye_params': {}}, 'no lens profile: it needs'),
        (
            {
                'fisheye_params': {
                    **PROFILE['fisheye_params'],
                    'distortion_coeffs': [0.1, 'x', 0, 0],
                }
            },
            'no lens profile: it needs',
        ),
        ({'calib_dimension': {'w': 'x', 'h': 72}}, 'no lens profile: it needs'),
        ({'frame_readout_time': 10012.5}, 'column by column'),
    ],
)
def test_lens_profile_that_does_not_fit(tmp_path, changes, words):
    refused(
        'video',
        made.make_video(tmp_path),
        tmp_path / 'bag',
        words,
        '--lens-profile',
        str(write_profile(tmp_path / 'one.json', **changes)),
    )


def test_lens_profiles_to_choose_from(tmp_path):
    path = made.make_video(tmp_path)
    folder = tmp_path / 'profiles'
    folder.mkdir()

    def check(words: str, place: Path = folder) -> None:
        refused('video', path, tmp_path / 'bag', words, '--lens-profile', str(place))

    check('has no lens profile of Acme Model 1, 64x48')
    for name in ('a', 'b'):
        write_profile(folder / f'{name}.json', **OF_THE_VIDEO)
    check('has 2 lens profiles')
    check('absent is missing', tmp_path / 'absent')
    (folder / 'a.json').write_text('[')
    check('a.json: no JSON')


@pytest.mark.parametrize(
    'module, package', [('telemetry_parser', 'telemetry-parser'), ('av', 'av')]
)
def test_library_that_is_not_installed(tmp_path, monkeypatch, module, package):
    path = made.make_video(tmp_path)
    monkeypatch.setitem(sys.modules, module, None)
    refused(
        'video',
        path,
        tmp_path / 'bag',
        f'need the Python package {package}, which is not '
        'installed: pip install av telemetry-parser',
        kind=MissingInputError,
    )


def cut_in_half(folder: Path) -> Path:
    path = made.make_video(folder)
    path.write_bytes(path.read_bytes()[: path.stat().st_size // 2])
    return path


def frames_overwritten(folder: Path) -> Path:
    """The index is complete, the frames are not."""
    path = made.make_video(folder)
    data = path.read_bytes()
    start = data.index(b'mdat') + 4
    end = data.index(b'moov') - 4
    path.write_bytes(data[:start] + b'\xff' * (end - start) + data[end:])
    return path


@pytest.mark.parametrize(
    'make, words',
    [
        (lambda folder: folder / 'absent.mp4', 'absent.mp4 is missing'),
        (made.make_clip, 'has no telemetry'),
        (lambda folder: made.make_clip(folder, {'EISE': 'Y'}), 'is stabilised in the camera'),
        (
            lambda folder: made.make_clip(folder, {'EISE': 'N', 'EISA': 'HS HLevel'}),
            'is stabilised in the camera',
        ),
        (
            lambda folder: made.make_clip(
                folder, {'EISE': 'N', 'EISA': 'N', 'MINF': 'HERO9 Black'}
            ),
            '(GoPro HERO9 Black) has no gyro',
        ),
        # Its reader panics at the end of the file.
        (
            lambda folder: made.make_clip(folder, {'EISE': 'N'}, whole=False),
            'telemetry-parser cannot read it',
        ),
        (cut_in_half, 'clip.mp4'),
        (frames_overwritten, 'clip.mp4'),
    ],
)
def test_video_that_is_refused(tmp_path, make, words):
    pytest.importorskip('telemetry_parser', reason='needs the extra video')
    refused('video', make(tmp_path / 'in'), tmp_path / 'bag', words)


# --- phones


def test_a_posecam_folder_becomes_a_bag(tmp_path):
    read = converted('android', made.make_posecam(tmp_path / 'in'), tmp_path / 'bag')
    assert read.stamps() == [stamp for number, stamp in enumerate(made.STAMPS) if number != 2]
    assert read.of(IMAGES)[2].data.tobytes() == made.picture(3)
    gyro = read.samples('/imu/gyro')
    accel = read.samples('/imu/accel')
    assert [sample.stamp_ns for sample in accel] == made.IMU_STAMPS
    assert gyro[0].stamp_ns == made.IMU_STAMPS[0] + made.MILLISECOND
    assert gyro[0].angular_velocity == (-5.5e-4, 0.25, 0.5) and gyro[0].linear_acceleration is None
    assert accel[0].linear_acceleration == (0.05, 9.8, 0.5) and accel[0].angular_velocity is None
    assert INFO not in read.messages
    sensor = read.parameters.sensor
    assert read.readout == (0.0215, 'down')
    assert (sensor.stamp_row, sensor.stamp_exposure) == ('first', 'start')
    assert sensor.exposure_time == pytest.approx(0.004, abs=1e-6)
    np.testing.assert_allclose(read.parameters.imu.gyro_bias, (0.01, 0.02, -0.03))
    assert read.parameters.intrinsics.camera_matrix == (50.5, 0, 32.5, 0, 51.5, 23.5, 0, 0, 1)
    assert (read.axes * PHONE_AXES.inv()).magnitude() < 1e-7
    # An upright camera of ARCore looks along -z of the world, in which y is up.
    assert read.stamps(TRUTH) == [made.STAMPS[k] for k in (0, 2, 3, 4)]
    pose = read.of(TRUTH)[1].pose
    assert (pose.position.x, pose.position.y, pose.position.z) == (0.2, 0.2, 0.3)
    q = pose.orientation
    np.testing.assert_allclose(
        Rotation.from_quat([q.x, q.y, q.z, q.w]).as_matrix(), np.diag([1, -1, -1]), atol=1e-12
    )  # right, down, forwards


def test_jump_of_the_poses_ends_the_ground_truth(tmp_path, caplog):
    folder = made.make_posecam(tmp_path / 'in')
    jumps = [{'frame_index': 2, 'timestamp_ns': made.STAMPS[2]}]
    (folder / 'manifest.json').write_text(json.dumps({'pose_jumps': {'count': 1, 'jumps': jumps}}))
    with caplog.at_level(logging.WARNING):
        read = converted('android', folder, tmp_path / 'bag')
    assert read.stamps(TRUTH) == made.STAMPS[2:]
    [record] = caplog.records
    assert record.args == (1, 3, 4)  # jumps, poses used, poses tracked


def test_posecam_without_its_descriptions(tmp_path):
    folder = made.make_posecam(tmp_path / 'in')
    for name in ('frame_metadata.csv', 'intrinsics.json', 'device.json', 'manifest.json'):
        (folder / name).unlink()
    read = converted('android', folder, tmp_path / 'bag')
    assert read.readout[0] is None and not read.parameters.intrinsics.given
    assert 'ASSUMED: back camera' in read.text


def test_optical_stabilisation_is_reported(tmp_path, caplog):
    folder = made.make_posecam(tmp_path / 'in')
    replaced('frame_metadata.csv', ',0\n', ',1\n')(folder)
    converted('android', folder, tmp_path / 'bag')
    assert [record.levelname for record in caplog.records] == ['WARNING']
    assert 'optical stabilisation' in caplog.text


@pytest.mark.parametrize('degrees', [0, 90, 180, 270])
def test_axes_by_sensor_orientation(tmp_path, degrees):
    """Rotated clockwise by the angle, the image is upright: the phone's y is up in it."""
    folder = made.make_posecam(tmp_path / 'in')
    replaced('device.json', '90', str(degrees))(folder)
    # About z, which looks away from the screen, x turns to y: clockwise in the image.
    upright = (
        Rotation.from_euler('z', degrees, degrees=True)
        * converted('android', folder, tmp_path / 'bag').axes
    )
    np.testing.assert_allclose(upright.as_matrix(), np.diag([1, -1, -1]), atol=1e-7)


@pytest.mark.parametrize('clock, difference', [('REALTIME', 0), ('UNKNOWN', 123_456_789)])
def test_a_mars_logger_folder_becomes_a_bag_on_the_clock_of_the_imu(tmp_path, clock, difference):
    folder = made.make_mars(tmp_path / 'in', clock, difference)
    read = converted('android', folder, tmp_path / 'bag')
    assert read.stamps() == made.STAMPS  # on the IMU's clock
    for number in range(len(made.STAMPS)):
        assert abs(np.median(read.pixels(number)) - made.brightness(number)) < 6
    samples = read.samples('/imu/data_raw')
    assert [sample.stamp_ns for sample in samples] == made.IMU_STAMPS
    assert samples[0].angular_velocity == (0.1, -0.2, 0.3)
    assert samples[0].linear_acceleration == (0.5, 9.8, 0.1)
    assert read.readout == (pytest.approx(0.018), 'down')
    assert read.parameters.sensor.exposure_time == pytest.approx(0.010)
    assert read.parameters.intrinsics.camera_matrix == (60.5, 0, 31.5, 0, 61.5, 23.5, 0, 0, 1)
    assert 'A GUESS' in read.text
    assert (read.axes * PHONE_AXES.inv()).magnitude() < 1e-7


@pytest.mark.parametrize('as_video', [False, True])
def test_a_folder_of_tables_becomes_a_bag_with_or_without_accelerometer(tmp_path, as_video):
    folder = made.make_tables(tmp_path / 'in', as_video=as_video)
    read = converted('android', folder, tmp_path / 'bag')
    assert read.stamps() == made.STAMPS
    assert read.stamps('/imu/gyro') == made.IMU_STAMPS
    assert read.stamps('/imu/accel')[2] == made.IMU_STAMPS[2] + 7
    (folder / 'accel.csv').unlink()
    read = converted('android', folder, tmp_path / 'gyro_only')
    assert read.samples('/imu/data_raw')[0].linear_acceleration is None


# --- public data sets


def check_delays(read: Converted, readout_ns: int) -> None:
    for topic, messages in read.messages.items():
        delay_ns = 2 * made.MILLISECOND if 'imu' in topic else readout_ns + 5 * made.MILLISECOND
        for message in messages:
            assert message.bag_time_ns == stamp_ns(message.message.header) + delay_ns


def check_images(read: Converted, files: list[Path], stamps: list[int]) -> None:
    assert read.stamps() == stamps
    assert read.stamps(INFO) == stamps
    for image, info, file in zip(read.of(IMAGES), read.of(INFO), files, strict=True):
        assert image.data.tobytes() == file.read_bytes()
        assert image.header.frame_id == info.header.frame_id == 'camera_optical_frame'


def test_realsense_folder(tmp_path):
    folder = made.make_realsense(tmp_path / 'in')
    read = converted('realsense_rgb_rs', folder, tmp_path / 'bag')
    check_delays(read, 31_500_000)
    check_images(
        read,
        [folder / 'images' / f'{stamp}.jpg' for stamp in made.REALSENSE_STAMPS],
        made.REALSENSE_STAMPS,
    )
    lens = read.intrinsics
    assert (lens.width, lens.height) == (64, 48)
    assert (lens.fx, lens.fy, lens.cx, lens.cy) == (60.5, 61.5, 32.25, 24.75)
    assert read.of(IMAGES)[0].format.startswith('mono8; jpeg')
    assert read.pixels(0).shape == (48, 64)
    samples = read.samples('/imu/data_raw')
    stamps = [sample.stamp_ns for sample in samples]
    assert stamps == sorted(set(stamps))
    # All that came before, the interpolated ones as well, and 3 s after the last image.
    assert stamps[0] == made.REALSENSE_START and set(made.REALSENSE_STAMPS) < set(stamps)
    assert stamps[-1] == made.REALSENSE_STAMPS[-1] + 3 * made.SECOND - 2 * made.MILLISECOND
    assert samples[12].angular_velocity == (12e-4, -0.2, 0.3)
    assert samples[12].linear_acceleration == (0.5, -9.8, -0.1)
    message = read.of('/imu/data_raw')[0]
    assert message.orientation_covariance[0] == -1.0
    assert message.linear_acceleration_covariance[0] != -1.0


def test_a_xiaomi_folder_becomes_a_bag_with_its_lens(tmp_path):
    folder = made.make_xiaomi(tmp_path / 'in')
    read = converted('xiaomi_cc9_rs', folder, tmp_path / 'bag')
    check_delays(read, 31_100_000)
    check_images(
        read,
        [folder / 'images' / f'RE_frame-{number}.jpg' for number in (2, 3)],
        [4_328_040_459_559_000, 4_328_040_492_872_000],
    )
    lens = read.intrinsics
    assert (lens.width, lens.height, lens.fx, lens.cy) == (800, 600, 573.8534, 309.0112)
    samples = read.samples('/imu/data_raw')
    assert [sample.stamp_ns for sample in samples] == [
        4_328_040 * made.SECOND + k * made.SECOND // 4 for k in range(14)
    ]
    assert all(sample.linear_acceleration is None for sample in samples)
    assert samples[3].angular_velocity == (3e-3, -0.2, 0.3)
    message = read.of('/imu/data_raw')[0]
    assert message.linear_acceleration_covariance[0] == message.orientation_covariance[0] == -1.0


def test_data_sets_need_the_laboratory(tmp_path, monkeypatch):
    found = importlib.util.find_spec
    monkeypatch.setattr(
        'importlib.util.find_spec', lambda name: None if name == 'rs_relpose_lab' else found(name)
    )
    refused(
        'xiaomi_cc9_rs',
        made.make_xiaomi(tmp_path / 'in'),
        tmp_path / 'bag',
        'need the package rs_relpose_lab',
        kind=MissingInputError,
    )


def test_decimal_stamps_keep_every_nanosecond(tmp_path):
    # 1700000000.123456789 is no float64: its neighbours are 240 ns apart.
    (tmp_path / 'a.txt').write_text('# s\n\n1700000000.123456789\n 1.700000000156789012e9\n')
    rows = list(read_rows(tmp_path / 'a.txt', range(1)))
    assert [row.seconds_as_nanoseconds(0) for row in rows] == [
        1_700_000_000_123_456_789,
        1_700_000_000_156_789_012,
    ]
    assert [row.line for row in rows] == [3, 4]


# --- what cannot be used


def no_images(folder: Path) -> None:
    for path in folder.glob('images/*.jpg'):
        path.unlink()


FIRST = f'images/{made.REALSENSE_STAMPS[0]}.jpg'
MAKE = {'sleeping': lambda folder: made.make_mars(folder, 'UNKNOWN', 5_000_000)}
MISSING = [
    ('posecam', removed('imu.csv'), 'is of no known logger'),
    ('posecam', removed(f'frames/000003_{made.STAMPS[3]}.jpg'), 'is missing'),
    (
        'posecam',
        written('imu.csv', b'timestamp_ns,sensor,x,y,z\n1,accel,0,0,0\n'),
        'no samples of a gyro',
    ),
    ('tables', written('gyro.csv', b'stamp_ns,x,y,z\n'), 'has no rows'),
    ('realsense', removed('camera.txt'), 'camera.txt is missing'),
    ('realsense', removed(FIRST), '.jpg is missing'),
    ('realsense', written('imu.txt', b'# nothing\n'), 'at least one image and one IMU'),
    ('xiaomi', removed('framestamp.txt'), 'framestamp.txt is missing'),
    (
        'xiaomi',
        lambda folder: (folder / 'images').rename(folder / 'pictures'),
        'folder of images is missing',
    ),
    ('xiaomi', no_images, 'no images RE_frame-N.jpg'),
]
INVALID = [
    ('posecam', replaced('poses.csv', ',image', ',picture'), 'has no column image'),
    (
        'posecam',
        replaced('poses.csv', '0.2,0.3,0,0,0,1', '0.2,0.3,0,0,0,2'),
        'quaternion must have length 1',
    ),
    ('posecam', replaced('imu.csv', 'gyro_uncal', 'magnet'), "got 'magnet'"),
    ('posecam', replaced('imu.csv', '0.25', 'nan'), 'line 3: column y must be a finite number'),
    ('posecam', replaced('intrinsics.json', '50.5', 'null'), 'must have the numbers fx'),
    ('mars', replaced('frame_timestamps.txt', f'{made.STAMPS[2]},', '#'), 'has 4 stamps, but'),
    (
        'mars',
        replaced('frame_timestamps.txt', str(made.STAMPS[1]), str(made.STAMPS[0])),
        'not after',
    ),
    ('sleeping', replaced('edge_epochs.txt', '\t5000000\n', '\t9000000\n'), 'the phone slept'),
    ('sleeping', replaced('edge_epochs.txt', '\t5000000\n', '\t5e6\n'), 'must be an integer'),
    ('tables', replaced('frames.csv', '3.jpg', '../3.jpg'), 'lies outside'),
    ('tables', replaced('frames.csv', ',file', ',name'), 'has 0 videos'),
    (
        'tables',
        written('3.jpg', made.picture(3, 32, 48)),
        'has 48x32 pixels, but the first image has 64x48',
    ),
    ('realsense', written('camera.txt', b'60 60 32 24\n64 48\n'), 'must begin with'),
    ('realsense', replaced('camera.txt', ' 0\n', ' 0.9\n'), 'distortion 0.9'),
    ('realsense', replaced('camera.txt', '64 48', '640 480'), '64x48 pixels, but'),
    ('realsense', replaced('imu.txt', ' 0.3 ', ' 0.3 7 '), 'line 2: there must be 7 columns'),
    ('realsense', written('imu.txt', b'5 0 0 0 0 0 9.8\n'), 'have no time in common'),
    ('realsense', written('imu.txt', b'5 0 0 0 0 0 9.8\n5 1 0 0 0 0 9.8\n'), 'differ'),
    ('realsense', written(FIRST, b''), 'neither JPEG nor PNG'),
    ('realsense', written(FIRST, made.picture(0)[:-10]), 'truncated'),
    ('xiaomi', written('framestamp.txt', b'1.0\n2.0\n'), 'framestamp.txt has lines 1 to 2'),
]


@pytest.mark.parametrize(
    'name, damage, words, kind',
    [*((*row, MissingInputError) for row in MISSING), *((*row, InputError) for row in INVALID)],
)
def test_a_damaged_folder_is_refused_with_its_reason(tmp_path, name, damage, words, kind):
    folder = (MAKE.get(name) or getattr(made, f'make_{name}'))(tmp_path / 'in')
    damage(folder)
    source = {'realsense': 'realsense_rgb_rs', 'xiaomi': 'xiaomi_cc9_rs'}.get(name, 'android')
    refused(source, folder, tmp_path / 'bag', words, kind=kind)


@pytest.mark.parametrize(
    'read, texts',
    [
        (Row.real, ('nan', 'inf', 'x', '', None, 7)),
        (Row.integer, ('5e6', '1.0', '')),
        (Row.nanoseconds, ('1.65e18', '-1', '9' * 19, '9' * 30)),
        (Row.seconds_as_nanoseconds, ('soon', 'nan', '-4.3', '1e60', '1e999999999')),
    ],
)
def test_values_that_are_refused(read, texts):
    for text in texts:
        with pytest.raises(InputError, match=r'^a\.csv, line 7: column c must be a'):
            read(Row(Path('a.csv'), 7, {'c': text}), 'c')


def test_paths_that_cannot_be_used(tmp_path, refused):
    folder = made.make_xiaomi(tmp_path / 'in')
    refused('there is no folder', 'convert', 'xiaomi_cc9_rs', tmp_path / 'no', tmp_path / 'bag')
    for occupied in ('bag', 'bag.yaml'):
        (tmp_path / occupied).write_text('mine')
        refused(
            f'{tmp_path / occupied} exists already',
            'convert',
            'xiaomi_cc9_rs',
            folder,
            tmp_path / 'bag',
        )
        assert (tmp_path / occupied).read_text() == 'mine'
        (tmp_path / occupied).unlink()


# --- parameter files of the data sets


@pytest.mark.parametrize(
    ('dataset', 'axes', 'degrees'),
    [
        ('realsense_rgb_rs', Rotation.identity(), pytest.approx(1.0, abs=1.0)),
        ('xiaomi_cc9_rs', PHONE_AXES, pytest.approx(1.57, abs=0.01)),
    ],
)
def test_parameter_file_is_that_of_the_command(tmp_path, dataset, axes, degrees):
    """With axes within some degrees of those of its device."""
    file = ROOT / 'config' / f'{dataset}.yaml'
    (title, values) = datasets.packaged(dataset)
    for path in (file, ROOT / 'rs_relpose_lab' / 'recordings' / f'{dataset}.yaml'):
        assert path.read_text() == parameter_text(title, values)
    parameters = read_parameters(file)
    assert parameters.sensor.missing() == []
    mapping = parameters.to_mapping()
    for item in values:
        assert mapping[item.name] == item.value
        assert len(item.source) > 10
    off_axes = Rotation.from_matrix(parameters.sensor.R_cam_imu) * axes.inv()
    assert np.degrees(off_axes.magnitude()) == degrees


# --- recordings


@pytest.mark.recordings
def test_xiaomi_recording(recordings, tmp_path):
    folder = recordings / 'xiaomi_cc9_rs'
    read = converted('xiaomi_cc9_rs', folder, tmp_path / 'bag')
    # Stamps as in the phone's own log, whose clock counts microseconds.
    starts = {
        int(number): 1000 * int(microseconds)
        for microseconds, number in re.findall(
            r'^SOF +(\d+), +frameNum :(\d+)', (folder / 'gyro_dump.txt').read_text(), re.MULTILINE
        )
    }
    check_images(
        read,
        [folder / 'images' / f'RE_frame-{k}.jpg' for k in range(99, 202)],
        [starts[k] for k in range(99, 202)],
    )
    assert max(np.diff(read.stamps('/imu/data_raw'))) < 3 * made.MILLISECOND


def rotates_as_its_images(read: Converted) -> None:
    """Pan of the images, by far points, against the gyro."""
    gyro = read.samples('/imu/gyro')
    shifts = []
    before = None
    times = np.array([sample.stamp_ns - START_NS for sample in gyro]) * 1e-9
    yaw = np.array([sample.angular_velocity[1] for sample in gyro])
    rotation = np.concatenate([[0.0], np.cumsum(yaw[1:] * np.diff(times))])
    for number in range(len(read.of(IMAGES))):
        pixels = read.pixels(number)
        assert pixels.shape == (480, 854)
        far = pixels[:235].astype(float)  # above the horizon
        if before is not None:
            shifts.append(cv2.phaseCorrelate(before, far)[0][0])
        before = far
    frame_times = np.arange(len(shifts) + 1) * 1001 / 30000 - 0.03
    rates = np.diff(np.interp(frame_times, times, rotation))
    # To the right (about y, down) by the gyro: points move to the left.
    assert np.corrcoef(rates, shifts)[0, 1] < -0.97


@pytest.mark.recordings
def test_a_gopro_video_becomes_a_bag_with_its_telemetry(recordings, tmp_path):
    read = converted('video', recordings / 'gopro_samples' / 'karma.mp4', tmp_path / 'bag')
    assert [stamp - START_NS for stamp in read.stamps()] == [
        round(k * 1001 / 30000 * 1e9) for k in range(362)
    ]
    rotates_as_its_images(read)
    gyro = read.stamps('/imu/gyro')
    accel = read.stamps('/imu/accel')
    assert len(gyro) == 4795 and len(accel) == 2397
    # The accelerometer has half the gyro's rate, and covers the same time.
    assert np.diff(accel).mean() == pytest.approx(2 * np.diff(gyro).mean(), rel=1e-3)
    assert abs(accel[-1] - gyro[-1]) < 10_000_000
    # A gimbal holds it level: specific force is up, -y of the camera; at first the drone
    # accelerates forwards.
    forces = np.array([sample.linear_acceleration for sample in read.samples('/imu/accel')])
    assert np.abs(forces.mean(axis=0) - (0.2, -9.69, 0.2)).max() < 0.1
    assert forces[:400, 2].mean() > 1.5
    assert read.readout[0] is None


@pytest.mark.recordings
def test_gopro_that_levelled_its_horizon(recordings, tmp_path):
    refused(
        'video',
        recordings / 'gopro_samples' / 'max-heromode.mp4',
        tmp_path / 'bag',
        "stabilised in the camera (GoPro's EISE is Y)",
    )
