"""Folders of Android loggers: PoseCam, MARS Logger, OpenCamera Sensors; and VideoIMUCapture."""

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import replace
from itertools import chain
import logging
import math
from pathlib import Path
from typing import Any

import numpy as np
from scipy.spatial.transform import Rotation

from rs_relpose_ros.bags.convert.phone import (
    camera_axes,
    displayed_axes,
    exposure_values,
    phone_recording,
    sensor_matrix,
    sensor_video,
    skew_values,
    STAMP_ROW_OF_ANDROID,
    turns_back,
)
from rs_relpose_ros.bags.convert.recording import camera_matrix, image_file, Recording
from rs_relpose_ros.bags.convert.text_files import (
    optional_object,
    optional_table,
    read_object,
    read_rows,
    read_table,
    reals,
    Row,
)
from rs_relpose_ros.config.files import SourcedValue
from rs_relpose_ros.errors import InputError, MissingInputError
from rs_relpose_ros.geometry.so3 import Vector
from rs_relpose_ros.imu.buffer import ImuSample
from rs_relpose_ros.messages.incoming import TruePose

_logger = logging.getLogger(__name__)

# -- PoseCam --------------------------------------------------------------------------------------

# From the camera of ARCore (x right, y up, z backwards) to the optical frame (x right, y down).
_GL_FROM_OPTICAL = Rotation.from_quat([1.0, 0.0, 0.0, 0.0])


def read_posecam(folder: Path) -> Recording:
    """Read frames, IMU and, as ground truth, ARCore's poses of PoseCam."""
    poses = read_table(folder / 'poses.csv')
    images = []
    for row in poses:
        if row.word('image') == 'saved':
            number = row.nanoseconds('frame_index')
            stamp_ns = row.nanoseconds('timestamp_ns')
            path = folder / 'frames' / f'{number:06d}_{stamp_ns}.jpg'
            images.append(image_file(stamp_ns, path))
    gyro, accel, bias = _posecam_imu(folder / 'imu.csv')
    metadata = optional_table(folder / 'frame_metadata.csv')
    if any(row.words.get('ois_mode') == '1' for row in metadata):
        _logger.warning(
            '%s: optical stabilisation was on: the focal point moves against the '
            'sensor, and the poses get worse; switch it off if the phone can',
            metadata[0].path,
        )
    skew = 'rolling_shutter_skew_ns'
    camera = optional_object(folder / 'device.json').get('camera')
    known = camera if isinstance(camera, Mapping) else {}
    logged = known.get('sensor_orientation_deg')
    orientation = logged if type(logged) is int else None
    recorded = phone_recording(
        folder,
        ': recorded with PoseCam',
        images,
        gyro,
        accel,
        [
            *skew_values(reals(metadata, skew), skew),
            *exposure_values(reals(metadata, 'exposure_time_ns')),
            *_intrinsics(folder / 'intrinsics.json', orientation),
            *bias,
            STAMP_ROW_OF_ANDROID,
        ],
        camera_axes(logged),
        orientation=orientation,
    )
    return replace(recorded, truth=_truth(poses, folder / 'manifest.json'))


def _posecam_imu(path: Path) -> tuple[list[ImuSample], list[ImuSample], list[SourcedValue]]:
    """Read gyro, accelerometer, and the bias that the phone reports of an uncorrected gyro."""
    gyro: list[ImuSample] = []
    accel: list[ImuSample] = []
    biases: list[Vector] = []
    for row in read_table(path):
        stamp_ns = row.nanoseconds('timestamp_ns')
        kind = row.word('sensor')
        value = row.vector(*'xyz')
        if kind == 'accel':
            accel.append(ImuSample(stamp_ns, None, value))
        elif kind in ('gyro', 'gyro_uncal'):
            gyro.append(ImuSample(stamp_ns, value, None))
            if kind == 'gyro_uncal':
                biases.append(row.vector('bias_x', 'bias_y', 'bias_z'))
        else:
            raise row.error(f'the sensor must be accel, gyro or gyro_uncal, got {kind[:40]!r}')
    if not gyro:
        raise MissingInputError(f'{path} has no samples of a gyro')
    if not biases:
        return gyro, accel, []
    median = tuple(np.median(biases, axis=0).tolist())
    source = 'Median of the bias that the phone reports; the bag has raw rates.'
    return gyro, accel, [SourcedValue('gyro_bias', median, source)]


def _truth(poses: list[Row], manifest: Path) -> tuple[TruePose, ...]:
    """Return the longest sequence of tracked poses without a jump, which changes the world."""
    jumps = sorted(_jumps(manifest))
    tracked = [row for row in poses if row.word('tracking_state') == 'TRACKING']
    stamps_ns = [row.nanoseconds('timestamp_ns') for row in tracked]
    ends = np.searchsorted(stamps_ns, jumps)
    parts = np.split(np.arange(len(tracked)), ends)
    longest = max(parts, key=len)
    if jumps:
        _logger.warning(
            'ARCore relocalised %d times: only the longest part between, of %d of '
            '%d poses, is used as ground truth',
            len(jumps),
            len(longest),
            len(tracked),
        )
    return tuple(_pose(tracked[number]) for number in longest)


def _jumps(manifest: Path) -> Iterator[int]:
    """Return the times [ns] at which ARCore has relocalised."""
    found = optional_object(manifest).get('pose_jumps')
    # Next to the list, whose name is not documented, are counts and thresholds.
    values = found.values() if isinstance(found, Mapping) else [found]
    lists = (value for value in values if isinstance(value, list))
    for jump in chain.from_iterable(lists):
        stamp = jump.get('timestamp_ns') if isinstance(jump, Mapping) else None
        if isinstance(stamp, int) and abs(stamp) < 2**63:
            yield stamp


def _pose(row: Row) -> TruePose:
    R_world_gl = Rotation.from_quat(row.quaternion('qx', 'qy', 'qz', 'qw'))
    R_world_cam = R_world_gl * _GL_FROM_OPTICAL
    x, y, z, w = R_world_cam.as_quat().tolist()
    position = row.vector('tx', 'ty', 'tz')
    return TruePose(row.nanoseconds('timestamp_ns'), position, (x, y, z, w))


def _intrinsics(path: Path, orientation: int | None) -> list[SourcedValue]:
    if not path.is_file():
        return []
    found = read_object(path)
    values: list[Any] = [found.get(name) for name in ('fx', 'fy', 'cx', 'cy')]
    are_numbers = all(isinstance(value, int | float) for value in values)
    if not are_numbers or not all(map(math.isfinite, values)):
        raise InputError(f'{path} must have the numbers fx, fy, cx and cy')
    fx, fy, cx, cy = map(float, values)
    matrix = fx, fy, cx, cy
    width = found.get('width')
    height = found.get('height')
    if isinstance(width, int) and isinstance(height, int) and height > width:
        turns = 1 if orientation is None else turns_back(orientation)
        matrix = sensor_matrix(matrix, (height, width), turns)
    return [camera_matrix(*matrix, "ARCore's intrinsics, without distortion.")]


# -- MARS Logger ----------------------------------------------------------------------------------

# The two clocks may drift apart by so much during a recording [ns]; beyond it the phone slept.
# [chosen: 1 ms is 20 ppm of 50 s, and a hundredth of what a sleep costs]
_MAX_DRIFT_NS = 1_000_000


def read_mars(folder: Path) -> Recording:
    """Read frames of the movie with the logged stamps, and the IMU, of the MARS Logger."""
    video = sensor_video(folder / 'movie.mp4')
    stamps = folder / 'frame_timestamps.txt'
    shift_ns, clock = _clock(folder / 'edge_epochs.txt')
    own_ns = [row.nanoseconds('Frame timestamp[nanosec]') for row in read_table(stamps)]
    stamps_ns = [stamp + shift_ns for stamp in own_ns]
    rates = [f'g{axis}[rad/s]' for axis in 'xyz']
    forces = [f'a{axis}[m/s^2]' for axis in 'xyz']
    imu = [
        ImuSample(row.nanoseconds('Timestamp[nanosec]'), row.vector(*rates), row.vector(*forces))
        for row in read_table(folder / 'gyro_accel.csv')
    ]
    metadata = optional_table(folder / 'movie_metadata.csv')
    readout = 'Frame readout time[nanosec]'
    lens = _nominal_lens(metadata, video.width, video.height)
    offset = f'NOT KNOWN: {clock}. `rs_relpose calibrate` measures it.'
    values = [
        *skew_values(reals(metadata, readout), readout),
        *exposure_values(reals(metadata, 'Exposure time[nanosec]')),
        *lens,
        STAMP_ROW_OF_ANDROID,
        SourcedValue('time_offset', 0.0, offset),
    ]
    details = ': recorded with the MARS Logger'
    images = video.frames(stamps_ns, stamps)
    axes = displayed_axes(video, imu)
    return phone_recording(folder, details, images, imu, (), values, axes)


def _nominal_lens(metadata: list[Row], width: int, height: int) -> list[SourcedValue]:
    """Return the focal length that the phone reports as a parameter; nothing without one."""
    fx = float(np.median(reals(metadata, 'fx[px]') or [0.0]))
    fy = float(np.median(reals(metadata, 'fy[px]') or [0.0]))
    if min(fx, fy) <= 0.0:
        return []
    cx = (width - 1) / 2.0
    cy = (height - 1) / 2.0
    source = (
        "A GUESS: the lens's nominal focal length as logged, principal point in the middle, no "
        'distortion.'
    )
    return [camera_matrix(fx, fy, cx, cy, source)]


def _clock(path: Path) -> tuple[int, str]:
    """Return the difference from the camera's stamps to the IMU's clock [ns], and its source."""
    unknown = 0, 'the clock of the camera is not logged'
    if not path.is_file():
        return unknown
    with path.open(encoding='utf-8', errors='replace') as file:
        if 'is SENSOR_INFO_TIMESTAMP_SOURCE_REALTIME' in file.readline(10_000):
            return 0, 'camera and IMU have one clock, but its delays are not logged'
    differences_ns = [row.integer(2) for row in read_rows(path, range(3), separator=None)]
    if not differences_ns:
        return unknown
    drift_ns = max(differences_ns) - min(differences_ns)
    if drift_ns > _MAX_DRIFT_NS:
        raise InputError(
            f'{path}: the clocks of camera and IMU drifted apart by '
            f'{drift_ns * 1e-6:.1f} ms during the recording: the phone slept; record '
            'again'
        )
    shift_ns = differences_ns[0]
    return shift_ns, (
        "the camera's clock is not the IMU's; its stamps were shifted by the "
        f'logged difference, {shift_ns * 1e-6:.3f} ms'
    )


# -- OpenCamera Sensors ---------------------------------------------------------------------------


def read_opencamera_sensors(folder: Path) -> Recording:
    """Read VID_NAME.mp4 with VID_NAME_timestamps.csv, _gyro.csv and _accel.csv in a folder.

    The tables have no header line; samples are x, y, z and the stamp [ns].
    """
    videos = sorted(folder.glob('VID_*.mp4'))
    if len(videos) != 1:
        raise InputError(f'{folder} has {len(videos)} videos VID_*.mp4: there must be one')
    name = videos[0].stem
    gyro_path = next(folder.glob(f'*/{name}_gyro.csv'), None)
    if gyro_path is None:
        raise MissingInputError(f'{name}_gyro.csv is missing in the folders of {folder}')
    stamps = gyro_path.with_name(f'{name}_timestamps.csv')
    video = sensor_video(videos[0])
    stamps_ns = [row.nanoseconds(0) for row in read_rows(stamps, range(1))]
    gyro = [ImuSample(stamp, value, None) for stamp, value in _samples(gyro_path)]
    accel_path = gyro_path.with_name(f'{name}_accel.csv')
    forces = _samples(accel_path) if accel_path.is_file() else []
    accel = [ImuSample(stamp, None, value) for stamp, value in forces]
    details = ': recorded with OpenCamera Sensors'
    images = video.frames(stamps_ns, stamps)
    axes = displayed_axes(video, accel)
    return phone_recording(folder, details, images, gyro, accel, (STAMP_ROW_OF_ANDROID,), axes)


def _samples(path: Path) -> Sequence[tuple[int, Vector]]:
    """Read rows of x, y, z and the stamp [ns]."""
    return [(row.nanoseconds(3), row.vector(0, 1, 2)) for row in read_rows(path, range(4))]


# -- VideoIMUCapture ------------------------------------------------------------------------------


def read_video_imu_capture(folder: Path) -> Recording:
    """Refuse a recording of VideoIMUCapture, whose metadata are a protobuf stream."""
    raise InputError(
        f'{folder} is of VideoIMUCapture (video_recording.mp4, video_meta.pb3), which is not '
        'read: write video_meta.pb3 as frames.csv (stamp_ns), gyro.csv and accel.csv '
        '(stamp_ns,x,y,z) with the scripts of that app, next to the video, and convert these'
    )
