"""Recordings of PoseCam, an Android app with ARCore: its format posecam-4 and later.

As its IMPLEMENTATION_README describes it::

    poses.csv            frame_index,timestamp_ns,tx,ty,tz,qx,qy,qz,qw,tracking_state,image
    frames/              INDEX_STAMP.jpg, as the sensor reads them, where `image` is saved
    frame_metadata.csv   exposure_time_ns, rolling_shutter_skew_ns, ois_mode, ... of each row
    imu.csv              timestamp_ns,sensor,x,y,z,bias_x,bias_y,bias_z: accel, gyro_uncal or gyro
    intrinsics.json      fx, fy, cx, cy [px] by ARCore
    device.json          camera: sensor_orientation_deg, timestamp_source, ...
    manifest.json        pose_jumps, ...

Poses are ARCore's Camera.getPose: x right, y up, z backwards, in the world, at a frame's stamp.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping
import logging
import math
from pathlib import Path
from typing import Any

import numpy as np
from scipy.spatial.transform import Rotation

from rs_relpose_ros.config.parameter_file import SourcedValue
from rs_relpose_ros.convert import phone
from rs_relpose_ros.convert.json_files import read_object
from rs_relpose_ros.convert.recording import by_stamp, Conversion, ImageFile, Recording
from rs_relpose_ros.convert.tables import read_table, Row, Table
from rs_relpose_ros.errors import InputError, MissingInputError
from rs_relpose_ros.imu.samples import ImuSample, Vector
from rs_relpose_ros.messages.incoming import TruePose

FILES = ('poses.csv', 'imu.csv', 'frames')

# From ARCore's camera (x right, y up, z backwards) to the optical frame (x right, y down).
_GL_FROM_OPTICAL = Rotation.from_quat([1.0, 0.0, 0.0, 0.0])
_IMAGE_FORMAT = 'bgr8; jpeg compressed bgr8'

_logger = logging.getLogger(__name__)


def read_conversion(folder: Path) -> Conversion:
    """Frames, IMU and ARCore's poses as truth."""
    poses = read_table(folder / 'poses.csv')
    gyro, accel, bias = _imu(read_table(folder / 'imu.csv'))
    recording = Recording(
        camera=None, images=tuple(_images(folder / 'frames', poses)), image_format=_IMAGE_FORMAT,
        imu=gyro, accel=accel, truth=_truth(poses, _jumps(folder)))
    return Conversion(
        recording, f'Parameters of relpose_node for {folder.name} (`rs_relpose convert android`): '
        'recorded with PoseCam.',
        (phone.COMPRESSED, *_of_frames(folder), phone.STAMP_ROW, phone.TIME_OFFSET_NOT_KNOWN,
         phone.axes(_sensor_orientation(folder)), *_intrinsics(folder), *bias))


def _images(folder: Path, poses: Table) -> Iterator[ImageFile]:
    index, stamp, image = (poses.column(name) for name in ('frame_index', 'timestamp_ns', 'image'))
    for row in poses.rows:
        if row.words[image] == 'saved':
            yield ImageFile(row.nanoseconds(stamp), folder / (
                f'{row.nanoseconds(index):06d}_{row.nanoseconds(stamp)}.jpg'))


def _imu(table: Table) -> tuple[tuple[ImuSample, ...], tuple[ImuSample, ...], list[SourcedValue]]:
    """Gyro, accelerometer, and the bias that the phone tells of a gyro that it did not correct."""
    stamp, sensor, x = (table.column(name) for name in ('timestamp_ns', 'sensor', 'x'))
    gyro: list[ImuSample] = []
    accel: list[ImuSample] = []
    biases: list[Vector] = []
    for row in table.rows:
        kind, value = row.words[sensor], _vector(row, x)
        if kind == 'accel':
            accel.append(ImuSample(row.nanoseconds(stamp), None, value))
        elif kind in ('gyro', 'gyro_uncal'):
            gyro.append(ImuSample(row.nanoseconds(stamp), value, None))
            if kind == 'gyro_uncal':
                biases.append(_vector(row, table.column('bias_x')))
        else:
            raise row.error(f'the sensor must be accel, gyro or gyro_uncal, got {kind[:40]!r}')
    if not gyro:
        raise MissingInputError(f'{table.path} has no samples of a gyro')
    bias = []
    if biases:
        x0, y0, z0 = np.median(biases, axis=0)
        bias = [SourcedValue('gyro_bias', (float(x0), float(y0), float(z0)),
                             'Median of the bias that the phone tells; the bag has raw rates.')]
    return by_stamp(gyro), by_stamp(accel), bias


def _truth(poses: Table, jumps: list[int]) -> tuple[TruePose, ...]:
    """The longest stretch of tracked poses without a jump: beyond one the world is another."""
    state, stamp, tx, qx = (poses.column(name)
                            for name in ('tracking_state', 'timestamp_ns', 'tx', 'qx'))
    tracked = [row for row in poses.rows if row.words[state] == 'TRACKING']
    ends = np.searchsorted([row.nanoseconds(stamp) for row in tracked], sorted(jumps))
    stretches = np.split(np.arange(len(tracked)), ends)
    longest = max(stretches, key=len)
    if jumps:
        _logger.warning('ARCore relocalised %d times: only the longest stretch between, of %d of '
                        '%d poses, is taken as truth', len(jumps), len(longest), len(tracked))
    return tuple(_pose(tracked[number], stamp, tx, qx) for number in longest)


def _pose(row: Row, stamp: int, tx: int, qx: int) -> TruePose:
    quaternion = row.reals(qx, 4)
    if abs(math.hypot(*quaternion) - 1.0) > 1e-2:
        raise row.error(f'the quaternion must have length 1, got {math.hypot(*quaternion):.3g}')
    x, y, z, w = (Rotation.from_quat(quaternion) * _GL_FROM_OPTICAL).as_quat()
    return TruePose(row.nanoseconds(stamp), _vector(row, tx),
                    (float(x), float(y), float(z), float(w)))


def _jumps(folder: Path) -> list[int]:
    """Stamps [ns] of the first frames after a jump of the poses."""
    if not (folder / 'manifest.json').is_file():
        return []
    found = read_object(folder / 'manifest.json').get('pose_jumps')
    # Beside the list, whose name is not documented, are counts and thresholds.
    jumps = [jump for values in (found.values() if isinstance(found, Mapping) else [found])
             if isinstance(values, list) for jump in values if isinstance(jump, Mapping)]
    stamps = [jump.get('timestamp_ns') for jump in jumps]
    return [stamp for stamp in stamps if isinstance(stamp, int)]


def _of_frames(folder: Path) -> list[SourcedValue]:
    """Read-out time and exposure, as far as the phone reports them."""
    if not (folder / 'frame_metadata.csv').is_file():
        return []
    table = read_table(folder / 'frame_metadata.csv')
    if any(word == '1' for word in _words(table, 'ois_mode')):
        _logger.warning('%s: optical stabilisation was on: the focal point moves against the '
                        'sensor, and the poses get worse; switch it off where the phone can',
                        table.path)
    return [*phone.readout(_reals(table, 'rolling_shutter_skew_ns'), 'rolling_shutter_skew_ns'),
            *phone.exposure(_reals(table, 'exposure_time_ns'))]


def _reals(table: Table, name: str) -> list[float]:
    """Numbers of a column in which empty words mean that the phone does not report it."""
    if not table.has(name):
        return []
    column = table.column(name)
    return [row.real(column) for row in table.rows if row.words[column]]


def _words(table: Table, name: str) -> list[str]:
    return [row.words[table.column(name)] for row in table.rows] if table.has(name) else []


def _sensor_orientation(folder: Path) -> float | None:
    if not (folder / 'device.json').is_file():
        return None
    camera = read_object(folder / 'device.json').get('camera')
    angle = camera.get('sensor_orientation_deg') if isinstance(camera, Mapping) else None
    return float(angle) if isinstance(angle, int) and not isinstance(angle, bool) else None


def _intrinsics(folder: Path) -> list[SourcedValue]:
    if not (folder / 'intrinsics.json').is_file():
        return []
    path = folder / 'intrinsics.json'
    found: Mapping[str, Any] = read_object(path)
    values = [found.get(name) for name in ('fx', 'fy', 'cx', 'cy')]
    if not all(isinstance(value, int | float) and math.isfinite(value) for value in values):
        raise InputError(f'{path} must have the numbers fx, fy, cx and cy')
    width, height = found.get('width'), found.get('height')
    if isinstance(width, int) and isinstance(height, int):
        phone.refuse_portrait(folder / 'frames', width, height)
    fx, fy, cx, cy = map(float, values)   # type: ignore[arg-type]
    return [phone.camera_matrix(fx, fy, cx, cy, "ARCore's intrinsics, without distortion.")]


def _vector(row: Row, column: int) -> Vector:
    return row.real(column), row.real(column + 1), row.real(column + 2)
