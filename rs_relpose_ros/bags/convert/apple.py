"""Folders of loggers on iPhones and iPads: ios_logger, Stray Scanner; and Sensor Logger of both.

Apple's accelerometer has the other sign than a specific force: at rest it points downwards. Its
values are in multiples of the standard gravity.
"""

from collections.abc import Sequence
from dataclasses import replace
import math
from pathlib import Path

import numpy as np

from rs_relpose_ros.bags.convert.phone import (
    displayed_axes,
    phone_recording,
    sensor_matrix,
    sensor_video,
)
from rs_relpose_ros.bags.convert.recording import (
    camera_matrix,
    image_file,
    RecordedImage,
    Recording,
)
from rs_relpose_ros.bags.convert.text_files import (
    headless_rows,
    optional_table,
    read_rows,
    read_table,
    Row,
)
from rs_relpose_ros.bags.convert.video import Video
from rs_relpose_ros.config.files import SourcedValue
from rs_relpose_ros.errors import InputError, MissingInputError
from rs_relpose_ros.geometry import Array
from rs_relpose_ros.geometry.so3 import STANDARD_GRAVITY, Vector
from rs_relpose_ros.geometry.timing import Stamps
from rs_relpose_ros.imu.buffer import ImuSample
from rs_relpose_ros.imu.integration import interpolated
from rs_relpose_ros.messages.incoming import TruePose

# A median length of the acceleration in this range is in multiples of the standard gravity, one in
# the other range in m/s^2. [chosen: a moving hand changes the median by some percent; any range
# from (0.9, 1.1) to (0.3, 3) would do]
_IN_GRAVITIES = (0.6, 1.5)
# [derived: the same range in m/s^2]
_IN_METRES = (0.6 * STANDARD_GRAVITY, 1.5 * STANDARD_GRAVITY)


# Row to which the offsets here refer.
_STAMP_ROW = SourcedValue('stamp_row', 'first', 'Convention of time_offset here.')


def _specific_forces(path: Path, accelerations: Sequence[Vector], sign: float) -> list[Vector]:
    """Return specific forces [m/s^2] of accelerations in gravities or m/s^2, by their length."""
    lengths = np.linalg.norm(accelerations, axis=1)
    median = float(np.median(lengths)) if len(lengths) else math.nan
    if _IN_GRAVITIES[0] < median < _IN_GRAVITIES[1]:
        scale = sign * STANDARD_GRAVITY
    elif _IN_METRES[0] < median < _IN_METRES[1]:
        scale = sign
    else:
        raise InputError(
            f'{path}: the acceleration has a median length of {median:.3g}, which is gravity '
            'neither in g nor in m/s^2'
        )
    return [(scale * x, scale * y, scale * z) for x, y, z in accelerations]


# -- ios_logger -----------------------------------------------------------------------------------


def read_ios_logger(folder: Path) -> Recording:
    """Read Frames.m4v, Frames.txt, Gyro.txt and Accel.txt of ios_logger, without header lines.

    Frames.txt has the stamp [s], the number of the frame and, with ARKit, fx, fy, cx, cy [px].
    """
    stamps = folder / 'Frames.txt'
    rows = headless_rows(stamps, 2)
    if not rows:
        raise MissingInputError(f'{stamps} has no lines')
    video = sensor_video(folder / 'Frames.m4v')
    images = video.frames([row.seconds_as_nanoseconds(0) for row in rows], stamps)
    gyro = [
        ImuSample(row.seconds_as_nanoseconds(0), row.vector(1, 2, 3), None)
        for row in headless_rows(folder / 'Gyro.txt', 4)
    ]
    accel = _ios_logger_forces(folder / 'Accel.txt')
    lens = []
    if 5 in rows[0].words:
        of_frames = [[row.real(column) for column in range(2, 6)] for row in rows]
        median = np.median(of_frames, axis=0).tolist()
        matrix = sensor_matrix(median, (video.width, video.height), video.turns)
        lens = [camera_matrix(*matrix, "Median of ARKit's intrinsics, no distortion.")]
    details = ': recorded with ios_logger'
    axes = displayed_axes(video, accel)
    return phone_recording(folder, details, images, gyro, accel, (*lens, _STAMP_ROW), axes)


def _ios_logger_forces(path: Path) -> list[ImuSample]:
    """Read specific forces; none without the file."""
    if not path.is_file():
        return []
    rows = headless_rows(path, 4)
    vectors = [row.vector(1, 2, 3) for row in rows]
    forces = _specific_forces(path, vectors, -1.0)
    return [
        ImuSample(row.seconds_as_nanoseconds(0), None, force)
        for row, force in zip(rows, forces, strict=True)
    ]


# -- Stray Scanner --------------------------------------------------------------------------------


def read_stray_scanner(folder: Path) -> Recording:
    """Read rgb.mp4, odometry.csv, imu.csv and camera_matrix.csv of Stray Scanner.

    odometry.csv has a row for each frame: its stamp [s], and ARKit's pose of the optical frame.
    """
    video = sensor_video(folder / 'rgb.mp4')
    poses = read_table(folder / 'odometry.csv')
    stamps_ns = [row.seconds_as_nanoseconds('timestamp') for row in poses]
    samples = read_table(folder / 'imu.csv')
    accelerations = [row.vector('a_x', 'a_y', 'a_z') for row in samples]
    forces = _specific_forces(folder / 'imu.csv', accelerations, -1.0)
    imu = [
        ImuSample(
            row.seconds_as_nanoseconds('timestamp'),
            row.vector('alpha_x', 'alpha_y', 'alpha_z'),
            force,
        )
        for row, force in zip(samples, forces, strict=True)
    ]
    recorded = phone_recording(
        folder,
        ': recorded with Stray Scanner',
        video.frames(stamps_ns, folder / 'odometry.csv'),
        imu,
        (),
        (*_stray_lens(folder / 'camera_matrix.csv', video), _STAMP_ROW),
        displayed_axes(video, imu),
    )
    return replace(recorded, truth=tuple(map(_stray_pose, stamps_ns, poses)))


def _stray_lens(path: Path, video: Video) -> list[SourcedValue]:
    if not path.is_file():
        return []
    rows = list(read_rows(path, range(3)))
    if len(rows) != 3:
        raise InputError(f'{path} must have three rows, got {len(rows)}')
    of_x, of_y, _ = rows
    pinhole = of_x.real(0), of_y.real(1), of_x.real(2), of_y.real(2)
    matrix = sensor_matrix(pinhole, (video.width, video.height), video.turns)
    return [camera_matrix(*matrix, "ARKit's intrinsics, without distortion.")]


def _stray_pose(stamp_ns: int, row: Row) -> TruePose:
    quaternion = row.quaternion('qx', 'qy', 'qz', 'qw')
    return TruePose(stamp_ns, row.vector(*'xyz'), quaternion)


# -- Sensor Logger, of iPhones and of Android -----------------------------------------------------


def read_sensor_logger(folder: Path) -> Recording:
    """Read the CSV export of Sensor Logger, with a video or images in its folder Camera.

    Columns are named; time is in ns since 1970. Android's TotalAcceleration has gravity,
    Accelerometer has not: without the former it is the sum of Accelerometer and Gravity.
    """
    video, images = _sensor_logger_images(folder / 'Camera')
    gyro = [
        ImuSample(row.nanoseconds('time'), row.vector(*'xyz'), None)
        for row in read_table(folder / 'Gyroscope.csv')
    ]
    accel = _sensor_logger_forces(folder)
    offset = (
        'NOT KNOWN: the start of the video is known to a millisecond at best; '
        '`rs_relpose calibrate` measures it.'
    )
    values = (_STAMP_ROW, SourcedValue('time_offset', 0.0, offset))
    axes = None if video is None else displayed_axes(video, accel)
    return phone_recording(
        folder, ': recorded with Sensor Logger', images, gyro, accel, values, axes
    )


def _sensor_logger_images(folder: Path) -> tuple[Video | None, tuple[RecordedImage, ...]]:
    """Read the only video, or the images; names are times in ms since 1970."""
    named = [path for path in sorted(folder.iterdir()) if path.stem.isdecimal()]
    times_ns = {path: int(path.stem) * 1_000_000 for path in named}
    videos = [path for path in times_ns if path.suffix.lower() in ('.mp4', '.mov')]
    if len(videos) > 1:
        raise InputError(f'{folder} has {len(videos)} videos: there must be one')
    if videos:
        (path,) = videos
        video = sensor_video(path)
        stamps_ns = [times_ns[path] + since_ns for since_ns in video.times_ns()]
        return video, video.frames(stamps_ns, path)
    images = [path for path in times_ns if path.suffix.lower() in ('.jpg', '.jpeg', '.png')]
    if not images:
        raise MissingInputError(f'{folder} has no video or image that is named by its time in ms')
    return None, tuple(image_file(times_ns[path], path) for path in images)


def _sensor_logger_forces(folder: Path) -> list[ImuSample]:
    """Read specific forces; none if no accelerometer is exported."""
    total = folder / 'TotalAcceleration.csv'
    without_gravity = folder / 'Accelerometer.csv'
    gravity = folder / 'Gravity.csv'
    metadata = optional_table(folder / 'Metadata.csv')
    known = metadata[0].words if metadata else {}
    standardised = str(known.get('standardisation', '')).lower() == 'true'
    is_apple = str(known.get('platform', '')).lower() == 'ios'
    sign = -1.0 if is_apple and not standardised else 1.0
    if total.is_file():
        rows = read_table(total)
        vectors = [row.vector(*'xyz') for row in rows]
        source = total
    elif without_gravity.is_file() and gravity.is_file():
        if not metadata:
            raise MissingInputError(
                f'{folder / "Metadata.csv"} is missing: it has the platform, on which the sign '
                'of the accelerometer depends'
            )
        rows = read_table(without_gravity)
        vectors = _sums(rows, read_table(gravity))
        source = without_gravity
    else:
        return []
    forces = _specific_forces(source, vectors, sign)
    stamps_ns = [row.nanoseconds('time') for row in rows]
    return [ImuSample(stamp, None, force) for stamp, force in zip(stamps_ns, forces, strict=True)]


def _series(rows: Sequence[Row]) -> tuple[Stamps, Array]:
    """Stamps (N,) [ns] and vectors (N, 3) of a table."""
    stamps_ns = [row.nanoseconds('time') for row in rows]
    vectors = [row.vector(*'xyz') for row in rows]
    return np.array(stamps_ns), np.array(vectors)


def _sums(rows: Sequence[Row], gravities: Sequence[Row]) -> list[Vector]:
    """Add gravity, which changes slowly and is interpolated, to accelerations without it."""
    stamps_ns, vectors = _series(rows)
    gravity_ns, gravity = _series(gravities)
    times = (stamps_ns - gravity_ns[0]) * 1e-9
    gravity_times = (gravity_ns - gravity_ns[0]) * 1e-9
    sums = vectors + interpolated(times, gravity_times, gravity)
    return [(x, y, z) for x, y, z in sums.tolist()]
