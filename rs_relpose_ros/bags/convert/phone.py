"""Recordings of phones: what all loggers share, the table of loggers, and tables of any logger.

The IMU keeps the axes of the phone: x to the right and y up on its screen, z out of the screen.
"""

from collections.abc import Callable, Mapping, Sequence
import math
from pathlib import Path

import numpy as np

from rs_relpose_ros.bags import convert
from rs_relpose_ros.bags.convert import recording
from rs_relpose_ros.bags.convert.recording import (
    image_file,
    readout_values,
    RecordedImage,
    Recording,
    turned_back,
)
from rs_relpose_ros.bags.convert.text_files import (
    file_inside,
    optional_table,
    read_table,
    Row,
)
from rs_relpose_ros.bags.convert.video import Video
from rs_relpose_ros.config.files import SourcedValue
from rs_relpose_ros.errors import InputError, MissingInputError
from rs_relpose_ros.geometry.timing import NANOSECONDS
from rs_relpose_ros.imu.buffer import ImuSample

Reader = Callable[[Path], Recording]

_MILLISECOND = 1e-6  # ns in ms

# Row that Android stamps. [derived: documentation of SENSOR_TIMESTAMP]
STAMP_ROW_OF_ANDROID = SourcedValue(
    'stamp_row', 'first', "Android's SENSOR_TIMESTAMP is that of the first row."
)
# Parameters that a logger does not determine.
_DEFAULTS = (
    SourcedValue('stamp_row', 'first', 'Convention of time_offset here.'),
    SourcedValue(
        'time_offset',
        0.0,
        'NOT KNOWN: as the logger stamps. On some phones camera and IMU differ by '
        'tens of milliseconds; `rs_relpose calibrate` measures it.',
    ),
)


def read_phone(folder: Path, readers: Mapping[str, Reader]) -> Recording:
    """Read a recording of a known logger; MissingInputError if it is of none of them."""
    place = convert.found(folder)
    if place is not None:
        inner, found = place
        if found.name in readers:
            return readers[found.name](inner)
        if found.source != 'phone':
            raise MissingInputError(
                f'{folder} is a recording of {found}: '
                f'rs_relpose convert {found.source} {inner} OUT_BAG'
            )
    known = '; '.join(str(one) for one in convert.FORMATS if one.name in readers)
    raise MissingInputError(f'{folder} is of no known logger, by its files: {known}')


def phone_recording(
    folder: Path,
    details: str,
    images: Sequence[RecordedImage],
    imu: Sequence[ImuSample],
    accel: Sequence[ImuSample],
    values: Sequence[SourcedValue],
    axes: SourcedValue | None,
    *,
    orientation: int | None = None,
) -> Recording:
    """Make a recording of a phone, which is not calibrated.

    `details` are for the title, `values` the parameters that the logger knows, `axes` those of
    its camera where it is not the usual one. `orientation`: that of its sensor [deg], if logged.
    Images that are higher than wide were rotated upright, and are turned back.
    """
    known = {value.name for value in values}
    defaults = [value for value in _DEFAULTS if value.name not in known]
    axes = axes or camera_axes()
    turns = 1 if orientation is None else turns_back(orientation)
    return Recording(
        None,
        tuple(turned_back(image, turns) for image in images),
        imu,
        f'Parameters of relpose_node for {folder.name} (`rs_relpose convert phone`){details}.',
        (recording.COMPRESSED, *values, *defaults, axes),
        accel,
    )


# -- Axes of the camera ---------------------------------------------------------------------------

# SENSOR_ORIENTATION of the back camera of most phones [deg].
_USUAL_ORIENTATION = 90
# Source of the axes, in words.
_ORIENTATION = '{}: back camera with SENSOR_ORIENTATION {} deg, {}.'
# The same of images that were rotated upright.
_TURNED = (
    'ASSUMED: back camera with SENSOR_ORIENTATION {} deg, as most phones have it. The images were '
    'upright: they are turned back, so that their rows are those of the sensor.'
)
# The display orientation tells that of the sensor if the phone is held within this angle of one
# of its four sides [deg]. [chosen: 45 is ambiguous; any value from 20 to 40 would do]
_MOST_TILTED = 30.0


def camera_axes(sensor_orientation: object = None) -> SourcedValue:
    """Return the rotation from the axes of the phone to its back camera.

    `sensor_orientation`: the angle [deg] by which the image has to be rotated clockwise to be
    upright as the phone is held, Android's SENSOR_ORIENTATION; else that of most phones.
    """
    if type(sensor_orientation) is int and abs(sensor_orientation) <= 360:
        source = f"The camera's SENSOR_ORIENTATION, {sensor_orientation} deg, as logged."
        return _axes_of(sensor_orientation, source)
    how = 'as most phones have it'
    return _axes_of(_USUAL_ORIENTATION, _ORIENTATION.format('ASSUMED', _USUAL_ORIENTATION, how))


def _axes_of(degrees: int, source: str) -> SourcedValue:
    half = math.radians(degrees) / 2.0
    quaternion = (round(math.cos(half), 8), round(-math.sin(half), 8), 0.0, 0.0)
    return SourcedValue('quat_cam_imu_xyzw', quaternion, source)


def displayed_axes(video: Video, accel: Sequence[ImuSample]) -> SourcedValue:
    """Return the rotation from the axes of the phone to the camera of a video.

    A video that is to be displayed rotated has been encoded as the sensor reads its rows. Its
    display rotation is SENSOR_ORIENTATION plus the angle by which the phone was rotated, which
    gravity shows: both together give SENSOR_ORIENTATION.
    """
    forces = [sample.linear_acceleration for sample in accel if sample.linear_acceleration]
    if video.turns:
        return _axes_of(_USUAL_ORIENTATION, _TURNED.format(_USUAL_ORIENTATION))
    if not video.display_rotation or not forces:
        return camera_axes()
    up = np.median(forces, axis=0)
    # 0: upright; 90: the left side of the screen is at the top.
    held = math.degrees(math.atan2(-up[0], up[1]))
    nearest = 90 * round(held / 90.0)
    in_screen = math.hypot(up[0], up[1])
    leaned = math.degrees(math.atan2(up[2], in_screen))
    tilted = math.hypot(held - nearest, leaned)
    orientation = (video.display_rotation - nearest) % 360
    if tilted > _MOST_TILTED or orientation not in (90, 270):
        return camera_axes()
    how = f'by the display rotation of the video, {video.display_rotation} deg, and gravity'
    return _axes_of(orientation, _ORIENTATION.format('Of this recording', orientation, how))


def turns_back(sensor_orientation: int) -> int:
    """Return the quarter turns, counterclockwise, from an upright image to the sensor's rows.

    `sensor_orientation`: the angle [deg] by which the logger has rotated the image clockwise.
    """
    return -1 if sensor_orientation % 360 == 270 else 1


def sensor_video(path: Path) -> Video:
    """Open a video whose frames are as the sensor reads its rows.

    Frames that are higher than wide were rotated upright, and are turned back.
    """
    video = Video(path)
    if video.height > video.width:
        video.turn(turns_back(_USUAL_ORIENTATION))
    return video


def sensor_matrix(
    matrix: Sequence[float], size: tuple[int, int], turns: int
) -> tuple[float, float, float, float]:
    """Return fx, fy, cx, cy [px] for the rows of the sensor.

    `size` (width, height) is that of the images as the sensor reads them, which were turned by
    `turns`. The principal point shows whether the matrix is of the images before.
    """
    fx, fy, cx, cy = matrix
    if not turns or cx > cy:
        return fx, fy, cx, cy
    width, height = size
    if turns == 1:
        return fy, fx, cy, height - 1.0 - cx
    return fy, fx, width - 1.0 - cy, cx


# -- What Android's camera reports ----------------------------------------------------------------


def skew_values(skews_ns: Sequence[float], column: str) -> list[SourcedValue]:
    """Return the median SENSOR_ROLLING_SHUTTER_SKEW [ns] as parameters; none if not logged."""
    median_ns = float(np.median(skews_ns)) if skews_ns else 0.0
    source = (
        f'Reported by the phone: median of {column}, which is that of the whole sensor: less if '
        'the image is cropped at its top and bottom.'
    )
    return readout_values(median_ns * _MILLISECOND, column, source)


def exposure_values(exposures_ns: Sequence[float]) -> list[SourcedValue]:
    """Return what SENSOR_TIMESTAMP marks, with the median exposure; none if not logged."""
    median = float(np.median(exposures_ns)) / NANOSECONDS if exposures_ns else 0.0
    if not 0.0 < median < 1.0:
        return []
    shortest = min(exposures_ns) * _MILLISECOND
    longest = max(exposures_ns) * _MILLISECOND
    return [
        SourcedValue(
            'stamp_exposure', 'start', "Android's SENSOR_TIMESTAMP is the start of the exposure."
        ),
        SourcedValue(
            'exposure_time',
            round(median, 9),
            f'Median of the logged exposures: {shortest:.2f} to {longest:.2f} ms.',
        ),
    ]


# -- Tables of any logger -------------------------------------------------------------------------


def read_tables(folder: Path) -> Recording:
    """Read frames.csv, gyro.csv and accel.csv, each with a header line (docs/recordings.md)."""
    gyro = [
        ImuSample(_stamp(row), row.vector(*'xyz'), None) for row in read_table(folder / 'gyro.csv')
    ]
    accel = [
        ImuSample(_stamp(row), None, row.vector(*'xyz'))
        for row in optional_table(folder / 'accel.csv')
    ]
    frames = read_table(folder / 'frames.csv')
    stamps_ns = [_stamp(row) for row in frames]
    axes = None
    if 'file' in frames[0].words:
        paths = [file_inside(folder, row, 'file') for row in frames]
        images = tuple(map(image_file, stamps_ns, paths))
    else:
        video = sensor_video(_only_video(folder, frames[0].path))
        images = video.frames(stamps_ns, frames[0].path)
        axes = displayed_axes(video, accel)
    details = '. `rs_relpose calibrate` estimates readout time and focal length'
    return phone_recording(folder, details, images, gyro, accel, (STAMP_ROW_OF_ANDROID,), axes)


def _only_video(folder: Path, table: Path) -> Path:
    videos = [path for path in sorted(folder.iterdir()) if path.suffix.lower() in ('.mp4', '.mov')]
    if len(videos) != 1:
        raise InputError(
            f'{table} has no column file, and {folder} has '
            f'{len(videos)} videos (.mp4, .mov): there must be one'
        )
    return videos[0]


def _stamp(row: Row) -> int:
    return row.nanoseconds('timestamp_ns' if 'timestamp_ns' in row.words else 'stamp_ns')
