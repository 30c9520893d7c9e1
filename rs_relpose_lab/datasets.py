"""Public recordings for `rs_relpose convert`: how they are read, and the node's parameters."""

from collections.abc import Iterable
from pathlib import Path
import re

from rs_relpose_ros.bags import convert
from rs_relpose_ros.config.files import SourcedValue
from rs_relpose_ros.errors import InputError, MissingInputError
from rs_relpose_ros.geometry.camera import RollingShutterCamera
from rs_relpose_ros.imu.buffer import ImuSample

_READOUT_DOWN = SourcedValue('readout_direction', 'down', 'As that estimate.')

REALSENSE_TITLE = (
    'Parameters of relpose_node for the recordings realsense_rgb_rs, realsense_rgb_rs_b and '
    'realsense_rgb_rs_c (`rs_relpose convert realsense_rgb_rs`): one rolling-shutter colour '
    'camera of a RealSense, 1280x720.')
_REALSENSE_READOUT = 0.0315
_ASSUMED = 'ASSUMED: about that of these adjustments.'
_OF_TARGET = 'ASSUMED: that of a target calibration.'
REALSENSE_PARAMETERS = (
    convert.COMPRESSED,
    SourcedValue(
        'readout_time', _REALSENSE_READOUT,
        'Not documented by the maker. Estimated from the images and the gyro, averaged over the '
        'exposure, in adjustments of 11 to 15 frames: 31.2 to 31.7 ms in every recording.'),
    SourcedValue('readout_time_sigma', 0.0003, 'Of these adjustments.'),
    _READOUT_DOWN,
    SourcedValue('stamp_row', 'first', 'Convention of readout_time and time_offset here.'),
    SourcedValue(
        'time_offset', -0.0653,
        'Estimated with readout_time, for frames of 50 ms. Negative: the rows were exposed before '
        'the stamp.'),
    SourcedValue('time_offset_sigma', 0.0005, _ASSUMED),
    SourcedValue('time_offset_per_interval', -0.54,
                 'Auto exposure moves it: -56.3 ms for frames of 33.4 ms.'),
    SourcedValue('time_offset_per_interval_sigma', 0.05, _ASSUMED),
    SourcedValue('time_offset_reference_interval', 0.05, 'Of time_offset.'),
    SourcedValue('exposure_margin', 0.008,
                 'In little light it exposes nearly as long as its frame interval.'),
    SourcedValue('quat_cam_imu_xyzw', (-0.0018, -0.0021, 0.0016, 1.0),
                 'By the same adjustment: the camchain.yaml of the dataset is 1.2 deg off about x '
                 'and 0.7 deg about z.'),
    SourcedValue('axes_sigma', 0.004, _ASSUMED),
    SourcedValue('focal_length_sigma', 0.003, _OF_TARGET),
    SourcedValue('distortion_sigma', 0.01, _OF_TARGET),
    SourcedValue('principal_point_sigma', 3.0, _OF_TARGET),
    SourcedValue('imu_position', (0.0121, -0.0023, -0.0023),
                 'Translation of T_cam_imu in that camchain.yaml (p_cam = T p_imu).'),
    SourcedValue('gyro_bias', (-0.0015, 0.0002, 0.0019), 'Mean of the gyro at rest, about.'),
)

XIAOMI_TITLE = (
    'Parameters of relpose_node for the recording xiaomi_cc9_rs (`rs_relpose convert '
    'xiaomi_cc9_rs`): phone of the Xiaomi CC9 class in a driving car, 800x600, gyro only.')
_XIAOMI_READOUT = 0.0311
XIAOMI_PARAMETERS = (
    convert.COMPRESSED,
    SourcedValue(
        'readout_time', _XIAOMI_READOUT,
        'Estimated from the images and the gyro themselves: minimum of the robust epipolar '
        'cost over 101 pairs (13.72 at 31.1 ms, 30.3 at 0). The repository itself uses the '
        'whole frame interval, 33.3 ms.'),
    _READOUT_DOWN,
    SourcedValue('stamp_row', 'first', 'Stamps are the start of the frame.'),
    SourcedValue(
        'time_offset', -0.0024,
        'Estimated with readout_time; about minus half the exposure of 5.2 ms.'),
    SourcedValue('quat_cam_imu_xyzw', (0.71311442, -0.70096593, -0.00143244, 0.01060837),
                 'Rotation vector (2.22531, -2.18740, -0.00447) rad, refined with readout_time; '
                 '1.6 deg from the axis map cam_x = -imu_y, cam_y = -imu_x, cam_z = -imu_z of the '
                 'repository.'),
    SourcedValue('gyro_bias', (0.0, 0.0, 0.0),
                 'Not known: the phone is never at rest, and its mean rate is that of the car.'),
    SourcedValue('feature_rows', (0.0, 420.0),
                 'Below row 420 the image shows the dashboard, which moves with the camera.'),
)
# Calibrated by the repository, for its images of 800x600. Its skew of -0.7 px per unit of y/z has
# no field in CameraInfo; without it, no point moves by more than 0.4 px.
_XIAOMI_CAMERA = RollingShutterCamera(width=800, height=600, fx=573.8534, fy=575.0448, cx=406.0101,
                                      cy=309.0112, readout_time=_XIAOMI_READOUT)
_XIAOMI_IMAGE = re.compile(r'RE_frame-([0-9]{1,6})\.jpg')


def ordered_samples(samples: Iterable[ImuSample]) -> tuple[ImuSample, ...]:
    """Samples by stamp, exact duplicates once."""
    by_stamp: dict[int, ImuSample] = {}
    for sample in samples:
        if by_stamp.setdefault(sample.stamp_ns, sample) != sample:
            raise InputError(f'two IMU samples of the stamp {sample.stamp_ns} ns differ')
    return tuple(by_stamp[stamp_ns] for stamp_ns in sorted(by_stamp))


def read_realsense(folder: Path) -> convert.Recording:
    """Colour camera and IMU of a RealSense, as cut from the DM-VIO dataset of Zoltan3057.

    https://github.com/Zoltan3057/DM-VIO-dataset, commit 7f0fcff8a45b7bbcb70f509e8c926454a9971a2b::

        camera.txt    fx fy cx cy 0 [px], then width and height
        frames.csv    segment,index_in_original,stamp_ns,dt_to_next_ms,file
        imu.txt       stamp [ns], angular velocity [rad/s], specific force [m/s^2]; 200 Hz, and a
                      sample interpolated to the stamp of every image
        images/       JPEG, gray
    """
    return convert.Recording(
        _realsense_camera(folder / 'camera.txt'),
        tuple(convert.image_file(row.nanoseconds('stamp_ns'),
                                 convert.file_inside(folder, row, 'file'))
              for row in convert.read_table(folder / 'frames.csv')),
        ordered_samples(
            ImuSample(row.nanoseconds(0), row.vector(1, 2, 3), row.vector(4, 5, 6))
            for row in convert.read_rows(folder / 'imu.txt', range(7), separator=None)),
        REALSENSE_TITLE, REALSENSE_PARAMETERS, image_format='mono8; jpeg compressed mono8')


def _realsense_camera(path: Path) -> RollingShutterCamera:
    if not path.is_file():
        raise MissingInputError(f'{path.name} is missing: there is no file {path}')
    # Only the first two lines are calibration: then DM-VIO's own crop follows.
    lines = path.read_text(encoding='utf-8', errors='replace').splitlines()[:2]
    rows = [convert.Row(path, number, dict(enumerate(line.split())))
            for number, line in enumerate(lines, start=1)]
    if [len(row.words) for row in rows] != [5, 2]:
        raise InputError(f'{path} must begin with "fx fy cx cy distortion" and "width height"')
    fx, fy, cx, cy, distortion = map(rows[0].real, range(5))
    if distortion != 0.0:
        raise rows[0].error(f'the FOV distortion {distortion:g} of this format is not supported: '
                            'it must be 0')
    width, height = map(rows[1].integer, range(2))
    if not (0 < width < 100_000 and 0 < height < 100_000):
        raise rows[1].error(f'there must be a number of pixels, got {width}x{height}')
    return RollingShutterCamera(width=width, height=height, fx=fx, fy=fy, cx=cx, cy=cy,
                                readout_time=_REALSENSE_READOUT)


def read_xiaomi(folder: Path) -> convert.Recording:
    """Phone camera and gyro, as cut from gyro-video-stabilization of lhaippp.

    https://github.com/lhaippp/gyro-video-stabilization (MIT), folder 20200109_145447, commit
    480a1eadbdba43d33db6de740434c98a77c890ea::

        framestamp.txt   start of frame [s], line N for image N
        gyro.txt         angular velocity [rad/s] and stamp [s], separated by commas; 412 Hz
        images/          RE_frame-N.jpg, in colour

    There is no accelerometer.
    """
    stamps = [row.seconds_as_nanoseconds(0)
              for row in convert.read_rows(folder / 'framestamp.txt', range(1))]
    if not (folder / 'images').is_dir():
        raise MissingInputError(f'the folder of images is missing: there is no {folder}/images')
    found = {int(match[1]): path for path in (folder / 'images').iterdir()
             if (match := _XIAOMI_IMAGE.fullmatch(path.name))}
    if not found:
        raise MissingInputError(f'{folder}/images has no images RE_frame-N.jpg')
    for number, path in found.items():
        if not 1 <= number <= len(stamps):
            raise InputError(f'{path} has no stamp: framestamp.txt has lines 1 to {len(stamps)}')
    return convert.Recording(
        _XIAOMI_CAMERA,
        tuple(convert.image_file(stamps[number - 1], found[number]) for number in sorted(found)),
        ordered_samples(
            ImuSample(row.seconds_as_nanoseconds(3), row.vector(0, 1, 2), None)
            for row in convert.read_rows(folder / 'gyro.txt', range(4))),
        XIAOMI_TITLE, XIAOMI_PARAMETERS)
