"""Colour camera and IMU of a RealSense, as cut from the DM-VIO dataset of Zoltan3057.

https://github.com/Zoltan3057/DM-VIO-dataset, commit 7f0fcff8a45b7bbcb70f509e8c926454a9971a2b::

    camera.txt    fx fy cx cy 0 [px], then width and height
    frames.csv    segment,index_in_original,stamp_ns,dt_to_next_ms,file
    imu.txt       stamp [ns], angular velocity [rad/s], specific force [m/s^2]; 200 Hz, and a
                  sample interpolated to the stamp of every image
    images/       JPEG, gray
"""

from __future__ import annotations

from pathlib import Path

from rs_relpose_ros.config.parameter_file import SourcedValue
from rs_relpose_ros.convert.recording import ImageFile, ordered_samples, Recording
from rs_relpose_ros.convert.tables import file_inside, read_rows, Row
from rs_relpose_ros.errors import InputError, MissingInputError
from rs_relpose_ros.geometry.camera import RollingShutterCamera
from rs_relpose_ros.imu.samples import ImuSample

READOUT_TIME = 0.028

TITLE = ('Parameters of relpose_node for the recording realsense_rgb_rs (`rs_relpose convert '
         'realsense_rgb_rs`): rolling-shutter colour camera of a RealSense, 1280x720.')

PARAMETERS = (
    SourcedValue('image_transport', 'compressed', 'The bag holds the recorded JPEG images.'),
    SourcedValue(
        'readout_time', READOUT_TIME,
        'Not documented by the maker. Estimated from the images and the gyro themselves: '
        'minimum of the robust epipolar cost (29.0 at 28 ms, 38.8 at 0).'),
    SourcedValue('readout_direction', 'down', 'As that estimate.'),
    SourcedValue('stamp_row', 'first', 'Convention of readout_time and time_offset here.'),
    SourcedValue(
        'time_offset', -0.057,
        'Estimated with readout_time: -56 ms for frames of 33 ms, -58 ms for those of 40 ms '
        '(auto exposure). Negative: the rows were exposed before the stamp.'),
    SourcedValue('quat_cam_imu_xyzw', (-0.01218755, -0.0025826, -0.00469531, 0.99991137),
        'Rotation of T_cam_imu in camchain.yaml of the dataset (p_cam = T p_imu).'),
    SourcedValue('imu_position', (0.0121, -0.0023, -0.0023), 'Its translation.'),
    SourcedValue('gyro_bias', (-0.0015, 0.0002, 0.0019), 'Mean of the gyro at rest, about.'),
)


def read_recording(folder: Path) -> Recording:
    """Read what the module's docstring describes; images are read when the bag is written."""
    return Recording(
        camera=_read_camera(folder / 'camera.txt'),
        images=_read_frames(folder),
        image_format='mono8; jpeg compressed mono8',
        imu=ordered_samples(
            ImuSample(row.nanoseconds(0), (row.real(1), row.real(2), row.real(3)),
                      (row.real(4), row.real(5), row.real(6)))
            for row in read_rows(folder / 'imu.txt', columns=7)))


def _read_camera(path: Path) -> RollingShutterCamera:
    if not path.is_file():
        raise MissingInputError(f'{path.name} is missing: there is no file {path}')
    # Only the first two lines are calibration: then DM-VIO's own crop follows.
    lines = path.read_text(encoding='utf-8', errors='replace').splitlines()[:2]
    rows = [Row(path, number, tuple(line.split())) for number, line in enumerate(lines, start=1)]
    if [len(row.words) for row in rows] != [5, 2]:
        raise InputError(f'{path} must begin with "fx fy cx cy distortion" and "width height"')
    fx, fy, cx, cy, distortion = rows[0].reals(0, 5)
    if distortion != 0.0:
        raise rows[0].error(f'the FOV distortion {distortion:g} of this format is not supported: '
                            'it must be 0')
    width, height = (_pixels(rows[1], column) for column in (0, 1))
    return RollingShutterCamera(width=width, height=height, fx=fx, fy=fy, cx=cx, cy=cy,
                                readout_time=READOUT_TIME)


def _pixels(row: Row, column: int) -> int:
    """A number of pixels."""
    text = row.words[column]
    if not (text.isascii() and text.isdigit()) or not 0 < len(text) < 6:
        raise row.error(f'column {column + 1} must be a number of pixels, got {text[:40]!r}')
    return int(text)


def _read_frames(folder: Path) -> tuple[ImageFile, ...]:
    rows = list(read_rows(folder / 'frames.csv', columns=5, separator=','))
    if not rows or 'stamp_ns' not in rows[0].words or 'file' not in rows[0].words:
        raise InputError(f'{folder / "frames.csv"} must begin with a header that names stamp_ns '
                         'and file')
    stamp, file = rows[0].words.index('stamp_ns'), rows[0].words.index('file')
    if len(rows) == 1:
        raise MissingInputError(f'{folder / "frames.csv"} lists no image')
    return tuple(ImageFile(row.nanoseconds(stamp), file_inside(folder, row, file))
                 for row in rows[1:])
