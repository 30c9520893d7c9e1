"""Converters of public recordings: small made folders, and the recordings themselves."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
import re

import cv2
from damaged_files import removed, replaced
import numpy as np
import pytest
from scipy.spatial.transform import Rotation
import yaml

from rs_relpose_ros.bags.reader import open_bag
from rs_relpose_ros.cli import convert, main
from rs_relpose_ros.config.parameter_file import (
    parameter_text,
    read_parameters,
    write_parameters,
)
from rs_relpose_ros.convert import xiaomi
from rs_relpose_ros.convert.sources import DATASETS
from rs_relpose_ros.errors import InputError, MissingInputError, RsRelposeError
from rs_relpose_ros.messages.incoming import (
    image_from_message,
    imu_sample_from_message,
    intrinsics_from_info,
    stamp_ns,
)

ROOT = Path(__file__).resolve().parent.parent
SECOND = 10**9
MILLISECOND = 10**6


def picture(width: int, height: int, seed: int, colour: bool) -> bytes:
    shape = (height // 8, width // 8, 3) if colour else (height // 8, width // 8)
    small = np.random.default_rng(seed).integers(0, 256, shape, dtype=np.uint8)
    return cv2.imencode('.jpg', cv2.resize(small, (width, height)))[1].tobytes()


# --- made folders

REALSENSE_START = 1_650_458_790_000_000_001
REALSENSE_STAMPS = [REALSENSE_START + (1002 + 35 * k) * MILLISECOND for k in range(3)]


def make_realsense(folder: Path) -> Path:
    folder.mkdir()
    (folder / 'camera.txt').write_text('60.5 61.5 32.25 24.75 0\n64 48\ncrop\n512 512\n')
    (folder / 'images').mkdir()
    lines = ['segment,index_in_original,stamp_ns,dt_to_next_ms,file']
    for number, stamp in enumerate(REALSENSE_STAMPS):
        (folder / 'images' / f'{stamp}.jpg').write_bytes(picture(64, 48, number, colour=False))
        lines.append(f'A,{number},{stamp},35.000,images/{stamp}.jpg')
    (folder / 'frames.csv').write_text('\n'.join(lines) + '\n')
    stamps = sorted([REALSENSE_START + k * 5 * MILLISECOND for k in range(1000)]
                    + REALSENSE_STAMPS)
    rows = [f'{stamp} {k * 1e-4:.6f} -0.2 0.3 0.5 -9.8 -0.1' for k, stamp in enumerate(stamps)]
    # One line twice, and two in the wrong order.
    rows = [*rows[:11], rows[10], rows[12], rows[11], *rows[13:]]
    (folder / 'imu.txt').write_text('\n'.join(['# timestamp[ns] w a', *rows]) + '\n')
    return folder


def make_xiaomi(folder: Path) -> Path:
    folder.mkdir()
    (folder / 'images').mkdir()
    # As the authors' script wrote them, with digits that are not theirs.
    starts = ['4.328040426246000454e+06', '4.328040459559000097e+06', '4.328040492871999741e+06']
    (folder / 'framestamp.txt').write_text('\n'.join(starts) + '\n')
    for number in (2, 3):
        (folder / 'images' / f'RE_frame-{number}.jpg').write_bytes(
            picture(800, 600, number, colour=True))
    (folder / 'images' / 'Thumbs.db').write_bytes(b'x')
    rows = [f'{k * 1e-3:.6e},-0.2,3e-1,{4328040.0 + k * 0.25:.6f}' for k in range(40)]
    (folder / 'gyro.txt').write_text('\n'.join(rows) + '\n')
    return folder


def converted(dataset: str, folder: Path, bag: Path) -> dict[str, list[object]]:
    """Messages by topic of the bag that the command writes."""
    assert main.main(['convert', dataset, str(folder), str(bag)]) == 0
    read: dict[str, list[object]] = {}
    with open_bag(bag) as opened:
        found = opened.find_topics()
        assert (found.image.name, found.camera_info.name, found.imu.name) == (
            '/camera/image_raw/compressed', '/camera/camera_info', '/imu/data_raw')
        times = []
        for message in opened.messages(opened.topics):
            read.setdefault(message.topic, []).append(message)
            times.append(message.bag_time_ns)
    assert times == sorted(times)
    return read


def check_delays(read: dict[str, list[object]], readout_ns: int) -> None:
    for topic, messages in read.items():
        delay_ns = 2 * MILLISECOND if 'imu' in topic else readout_ns + 5 * MILLISECOND
        for message in messages:
            assert message.bag_time_ns == stamp_ns(message.message.header) + delay_ns


def check_images(read: dict[str, list[object]], files: list[Path], stamps: list[int]) -> None:
    images = [message.message for message in read['/camera/image_raw/compressed']]
    infos = [message.message for message in read['/camera/camera_info']]
    assert [stamp_ns(image.header) for image in images] == stamps
    assert [stamp_ns(info.header) for info in infos] == stamps
    for image, info, file in zip(images, infos, files, strict=True):
        assert image.data.tobytes() == file.read_bytes()
        assert image.header.frame_id == info.header.frame_id == 'camera_optical_frame'


def test_realsense_folder(tmp_path):
    folder = make_realsense(tmp_path / 'in')
    read = converted('realsense_rgb_rs', folder, tmp_path / 'bag')
    check_delays(read, 28 * MILLISECOND)
    check_images(read, [folder / 'images' / f'{stamp}.jpg' for stamp in REALSENSE_STAMPS],
                 REALSENSE_STAMPS)
    calibration = intrinsics_from_info(read['/camera/camera_info'][0].message)
    assert (calibration.width, calibration.height) == (64, 48)
    assert (calibration.fx, calibration.fy, calibration.cx, calibration.cy) == (
        60.5, 61.5, 32.25, 24.75)
    image = read['/camera/image_raw/compressed'][0].message
    assert image.format.startswith('mono8; jpeg')
    assert image_from_message(image).image.decoded().shape == (48, 64)
    samples = [imu_sample_from_message(message.message) for message in read['/imu/data_raw']]
    stamps = [sample.stamp_ns for sample in samples]
    assert stamps == sorted(set(stamps))
    # All that came before, the interpolated ones as well, and 3 s after the last image.
    assert stamps[0] == REALSENSE_START and set(REALSENSE_STAMPS) < set(stamps)
    assert stamps[-1] == REALSENSE_STAMPS[-1] + 3 * SECOND - 2 * MILLISECOND
    assert samples[12].angular_velocity == (12e-4, -0.2, 0.3)
    assert samples[12].linear_acceleration == (0.5, -9.8, -0.1)
    message = read['/imu/data_raw'][0].message
    assert message.orientation_covariance[0] == -1.0
    assert message.linear_acceleration_covariance[0] != -1.0


def test_xiaomi_folder(tmp_path):
    folder = make_xiaomi(tmp_path / 'in')
    read = converted('xiaomi_cc9_rs', folder, tmp_path / 'bag')
    check_delays(read, 31_100_000)
    check_images(read, [folder / 'images' / f'RE_frame-{number}.jpg' for number in (2, 3)],
                 [4_328_040_459_559_000, 4_328_040_492_872_000])
    calibration = intrinsics_from_info(read['/camera/camera_info'][0].message)
    assert (calibration.width, calibration.height, calibration.fx, calibration.cy) == (
        800, 600, 573.8534, 309.0112)
    samples = [imu_sample_from_message(message.message) for message in read['/imu/data_raw']]
    assert [sample.stamp_ns for sample in samples] == [
        4_328_040 * SECOND + k * SECOND // 4 for k in range(14)]
    assert all(sample.linear_acceleration is None for sample in samples)
    assert samples[3].angular_velocity == (3e-3, -0.2, 0.3)
    message = read['/imu/data_raw'][0].message
    assert message.linear_acceleration_covariance[0] == message.orientation_covariance[0] == -1.0


def test_decimal_stamps_keep_every_nanosecond(tmp_path):
    folder = make_xiaomi(tmp_path / 'in')
    # 1700000000.123456789 is no float64: its neighbours are 240 ns apart.
    (folder / 'framestamp.txt').write_text(
        '1\n1700000000.123456789\n1.700000000156789012e9\n')
    (folder / 'gyro.txt').write_text('0,0,0,1700000000.123456788\n0,0,0,1700000000.123456790\n')
    recording = xiaomi.read_recording(folder)
    assert [image.stamp_ns for image in recording.images] == [
        1_700_000_000_123_456_789, 1_700_000_000_156_789_012]
    assert [sample.stamp_ns % 1000 for sample in recording.imu] == [788, 790]


# --- what cannot be used


def written(name: str, data: bytes) -> Callable[[Path], None]:
    def damage(folder: Path) -> None:
        assert (folder / name).is_file()
        (folder / name).write_bytes(data)
    return damage


FIRST = f'images/{REALSENSE_STAMPS[0]}.jpg'
REALSENSE_DAMAGE = [
    (removed('camera.txt'), MissingInputError, 'camera.txt is missing'),
    (removed('frames.csv'), MissingInputError, 'frames.csv is missing'),
    (removed('imu.txt'), MissingInputError, 'imu.txt is missing'),
    (removed(FIRST), MissingInputError, 'there is no image'),
    (written('camera.txt', b'60 60 32 24\n64 48\n'), InputError, 'must begin with'),
    (replaced('camera.txt', ' 0\n', ' 0.9\n'), InputError, 'distortion 0.9'),
    (replaced('camera.txt', '64 48', '64 -48'), InputError, "number of pixels, got '-48'"),
    (replaced('camera.txt', '60.5', 'nan'), InputError, 'line 1: column 1 must be a finite'),
    (replaced('camera.txt', '64 48', '640 480'), InputError, '64x48 pixels, but'),
    (replaced('imu.txt', ' 0.3 ', ' 0.3 7 '), InputError, 'line 2: there must be 7 columns'),
    (replaced('imu.txt', '-0.2', 'x'), InputError, 'line 2: column 3 must be a finite number'),
    (replaced('imu.txt', '-9.8', 'inf'), InputError, 'line 2: column 6 must be a finite number'),
    (replaced('imu.txt', str(REALSENSE_START), '1.65e18'), InputError, 'must be a stamp in nano'),
    (written('imu.txt', b'# nothing\n'), MissingInputError, 'at least one image and one IMU'),
    (written('imu.txt', b'5 0 0 0 0 0 9.8\n'), InputError, 'have no time in common'),
    (written('imu.txt', b'5 0 0 0 0 0 9.8\n5 1 0 0 0 0 9.8\n'), InputError, 'differ'),
    (written('imu.txt', b'\xff\xfe\x00' * 50), InputError, 'line 1: there must be 7 columns'),
    (replaced('frames.csv', 'stamp_ns', 'time'), InputError, 'names stamp_ns and file'),
    (written('frames.csv', b''), InputError, 'names stamp_ns and file'),
    (written('frames.csv', b'a,b,stamp_ns,c,file\n'), MissingInputError, 'lists no image'),
    (replaced('frames.csv', str(REALSENSE_STAMPS[1]), str(REALSENSE_STAMPS[0])), InputError,
     'is stamped'),
    (replaced('frames.csv', FIRST, '../secret.jpg'), InputError, 'lies outside'),
    (replaced('frames.csv', FIRST, '/secret.jpg'), InputError, 'lies outside'),
    (written(FIRST, b''), InputError, 'neither JPEG nor PNG'),
    (written(FIRST, picture(64, 48, 0, colour=False)[:-200]), InputError, 'truncated'),
    (written(FIRST, picture(32, 48, 0, colour=False)), InputError, '32x48 pixels, but'),
]
XIAOMI_DAMAGE = [
    (removed('framestamp.txt'), MissingInputError, 'framestamp.txt is missing'),
    (removed('gyro.txt'), MissingInputError, 'gyro.txt is missing'),
    (lambda folder: (folder / 'images').rename(folder / 'pictures'), MissingInputError,
     'folder of images is missing'),
    (lambda folder: [path.unlink() for path in folder.glob('images/*.jpg')], MissingInputError,
     'no images RE_frame-N.jpg'),
    (written('framestamp.txt', b'1.0\n2.0\n'), InputError, 'framestamp.txt has lines 1 to 2'),
    (replaced('framestamp.txt', '4.328040459559000097e+06', 'soon'), InputError,
     "line 2: column 1 must be a stamp in seconds, got 'soon'"),
    (replaced('framestamp.txt', 'e+06', 'e+60'), InputError, 'line 1: column 1 must be a stamp'),
    (replaced('framestamp.txt', '4.3', '-4.3'), InputError, 'line 1: column 1 must be a stamp'),
    (replaced('gyro.txt', ',-0.2', ''), InputError, 'line 1: there must be 4 columns, got 3'),
    (replaced('gyro.txt', '-0.2', ''), InputError, 'line 1: column 2'),
    (replaced('gyro.txt', '4328040.0', 'NaN'), InputError, 'must be a stamp in seconds'),
]


def check_refusal(dataset: str, folder: Path, bag: Path, kind: type[RsRelposeError],
                  words: str, capsys: pytest.CaptureFixture[str]) -> None:
    arguments = ['convert', dataset, str(folder), str(bag)]
    parsed = main.make_parser('convert').parse_args(arguments)
    with pytest.raises(RsRelposeError) as caught:
        convert.run(parsed)
    assert type(caught.value) is kind
    assert words in str(caught.value)
    assert not bag.exists() and not bag.with_name(f'{bag.name}.yaml').exists()
    assert main.main(arguments) == 2
    captured = capsys.readouterr()
    assert captured.out == ''
    assert captured.err.startswith('rs_relpose: error: ') and captured.err.count('\n') == 1


@pytest.mark.parametrize('make, dataset, damage, kind, words', [
    *((make_realsense, 'realsense_rgb_rs', *row) for row in REALSENSE_DAMAGE),
    *((make_xiaomi, 'xiaomi_cc9_rs', *row) for row in XIAOMI_DAMAGE)])
def test_damaged_folder(tmp_path, capsys, make, dataset, damage, kind, words):
    folder = make(tmp_path / 'in')
    damage(folder)
    check_refusal(dataset, folder, tmp_path / 'bag', kind, words, capsys)


def test_paths_that_cannot_be_used(tmp_path, capsys):
    folder = make_xiaomi(tmp_path / 'in')
    check_refusal('xiaomi_cc9_rs', tmp_path / 'absent', tmp_path / 'bag', MissingInputError,
                  'there is no folder', capsys)
    for occupied in ('bag', 'bag.yaml'):
        (tmp_path / occupied).write_text('mine')
        assert main.main(['convert', 'xiaomi_cc9_rs', str(folder), str(tmp_path / 'bag')]) == 2
        assert f'{tmp_path / occupied} exists already' in capsys.readouterr().err
        assert (tmp_path / occupied).read_text() == 'mine'
        (tmp_path / occupied).unlink()


# --- parameter files


@pytest.mark.parametrize('dataset', DATASETS)
def test_parameter_file_is_what_the_command_writes(tmp_path, dataset):
    source = DATASETS[dataset]
    file = ROOT / 'config' / f'{dataset}.yaml'
    assert file.read_text() == parameter_text(source.TITLE, source.PARAMETERS)
    parameters = read_parameters(file)
    assert parameters.sensor.missing() == []
    mapping = parameters.to_mapping()
    for item in source.PARAMETERS:
        assert mapping[item.name] == item.value
        assert len(item.source) > 10
    write_parameters(tmp_path / 'a.yaml', source.TITLE, source.PARAMETERS)
    with pytest.raises(InputError, match='exists already'):
        write_parameters(tmp_path / 'a.yaml', source.TITLE, source.PARAMETERS)
    with pytest.raises(InputError, match='cannot write'):
        write_parameters(tmp_path / 'no' / 'a.yaml', source.TITLE, source.PARAMETERS)


def test_axes_of_the_parameter_files():
    axis_map = Rotation.from_matrix([[0, -1, 0], [-1, 0, 0], [0, 0, -1]])
    turn = cam_imu_rotation(ROOT / 'config' / 'xiaomi_cc9_rs.yaml') * axis_map.inv()
    assert np.degrees(turn.magnitude()) == pytest.approx(1.57, abs=0.01)
    turn = cam_imu_rotation(ROOT / 'config' / 'realsense_rgb_rs.yaml')
    assert np.degrees(turn.magnitude()) < 2.0


def cam_imu_rotation(file: Path) -> Rotation:
    return Rotation.from_matrix(read_parameters(file).sensor.R_cam_imu)


# --- the recordings


@pytest.mark.recordings
def test_realsense_recording(recordings, tmp_path):
    folder = recordings / 'realsense_rgb_rs'
    read = converted('realsense_rgb_rs', folder, tmp_path / 'bag')
    check_delays(read, 28 * MILLISECOND)
    files = sorted((folder / 'images').iterdir())
    assert len(files) == 120
    check_images(read, files, [int(file.stem) for file in files])
    samples = [imu_sample_from_message(message.message) for message in read['/imu/data_raw']]
    assert len(samples) == 2185
    assert {int(file.stem) for file in files} <= {sample.stamp_ns for sample in samples}
    # The camera was held upright: specific force is up, which is -y of the camera.
    forces = np.array([sample.linear_acceleration for sample in samples])
    up = cam_imu_rotation(tmp_path / 'bag.yaml').apply(forces.mean(axis=0))
    assert up[1] < -8.0 and 9.0 < np.linalg.norm(forces, axis=1).mean() < 10.5
    # The camera of the folder is that of the parameter file.
    chain = yaml.safe_load((folder / 'camchain.yaml').read_text().expandtabs())
    matrix = np.array(chain['cam0']['T_cam_imu'])[:3, :3]
    difference = cam_imu_rotation(tmp_path / 'bag.yaml') * Rotation.from_matrix(matrix).inv()
    assert difference.magnitude() < 1e-5


@pytest.mark.recordings
def test_xiaomi_recording(recordings, tmp_path):
    folder = recordings / 'xiaomi_cc9_rs'
    read = converted('xiaomi_cc9_rs', folder, tmp_path / 'bag')
    check_delays(read, 31_100_000)
    stamps = [image.stamp_ns for image in xiaomi.read_recording(folder).images]
    check_images(read, [folder / 'images' / f'RE_frame-{number}.jpg' for number in range(99, 202)],
                 stamps)
    # Its clock counts microseconds.
    assert all(stamp % 1000 == 0 for stamp in stamps)
    assert set(np.diff(stamps)) <= {33_312_000, 33_313_000, 33_314_000}
    imu = [stamp_ns(message.message.header) for message in read['/imu/data_raw']]
    assert imu[0] < stamps[0] - 3 * SECOND
    assert stamps[-1] + 2.99 * SECOND < imu[-1] <= stamps[-1] + 3 * SECOND
    assert max(np.diff(imu)) < 3 * MILLISECOND


@pytest.mark.recordings
def test_xiaomi_stamps_are_those_of_the_phones_own_log(recordings):
    folder = recordings / 'xiaomi_cc9_rs'
    log = (folder / 'gyro_dump.txt').read_text()
    starts = {int(number): 1000 * int(microseconds) for microseconds, number in
              re.findall(r'^SOF +(\d+), +frameNum :(\d+)', log, flags=re.MULTILINE)}
    images = xiaomi.read_recording(folder).images
    assert len(images) == 103
    for image in images:
        assert image.stamp_ns == starts[int(image.path.stem.removeprefix('RE_frame-'))]
