"""Folders of Android loggers, each recognised by its files (`LOGGERS`).

Formats: docs/recordings.md, "Files of the loggers".
"""

from collections.abc import Callable, Mapping, Sequence
import logging
import math
from pathlib import Path
from typing import Any

import numpy as np
from scipy.spatial.transform import Rotation

from rs_relpose_ros.bags import convert
from rs_relpose_ros.bags.convert import read_object, read_table, Recording, Row
from rs_relpose_ros.bags.video import readout_values, Video
from rs_relpose_ros.config.files import SourcedValue
from rs_relpose_ros.errors import InputError, MissingInputError
from rs_relpose_ros.geometry.timing import NANOSECONDS
from rs_relpose_ros.imu.buffer import ImuSample, Vector
from rs_relpose_ros.messages.incoming import TruePose

_MILLISECOND = 1e-6   # ns in ms

_STAMP_ROW = SourcedValue('stamp_row', 'first', "Android's SENSOR_TIMESTAMP is that of the first "
                          'row.')
_TIME_OFFSET = SourcedValue(
    'time_offset', 0.0, 'NOT KNOWN: as the logger stamps. On some phones camera and IMU differ by '
    'tens of milliseconds; `rs_relpose calibrate` measures it.')

_logger = logging.getLogger(__name__)


def read_android(folder: Path) -> Recording:
    """A recording of any of `LOGGERS`; MissingInputError if it is of none of them."""
    for files, read in LOGGERS.values():
        if all((folder / name).exists() for name in files):
            return read(folder)
    raise MissingInputError(f'{folder} is of no known logger, by its files: {known_loggers()}')


# -- Parameters that loggers have in common -------------------------------------------------------

def _title(folder: Path, details: str) -> str:
    return (f'Parameters of relpose_node for {folder.name} (`rs_relpose convert android`)'
            f'{details}.')


def _axes(sensor_orientation: object = None) -> SourcedValue:
    """Rotation from the phone's sensor axes to a back camera, from its SENSOR_ORIENTATION [deg].

    The angle by which the image is rotated clockwise to be upright as the phone is held.
    """
    angle = 90
    source = 'ASSUMED: back camera with SENSOR_ORIENTATION {} deg, as most phones have it.'
    if type(sensor_orientation) is int and abs(sensor_orientation) <= 360:
        angle, source = sensor_orientation, "The camera's SENSOR_ORIENTATION, {} deg, as logged."
    half = math.radians(angle) / 2.0
    quaternion = (round(math.cos(half), 8), round(-math.sin(half), 8), 0.0, 0.0)
    return SourcedValue('quat_cam_imu_xyzw', quaternion, source.format(angle))


def _readout(skews_ns: Sequence[float], column: str) -> list[SourcedValue]:
    """Median of the logged SENSOR_ROLLING_SHUTTER_SKEW [ns]; nothing if none is logged."""
    return readout_values(
        float(np.median(skews_ns or 0.0)) * _MILLISECOND, column, 'Reported by the phone: median '
        f'of {column}, which is that of the whole sensor: less if the image is cropped at its top '
        'and bottom.')


def _exposure(exposures_ns: Sequence[float]) -> list[SourcedValue]:
    """What SENSOR_TIMESTAMP marks, with the median exposure [ns]; nothing if none is logged."""
    median = float(np.median(exposures_ns)) / NANOSECONDS if exposures_ns else 0.0
    if not 0.0 < median < 1.0:
        return []
    return [SourcedValue('stamp_exposure', 'start', "Android's SENSOR_TIMESTAMP is the start of "
                         'the exposure.'),
            SourcedValue('exposure_time', round(median, 9), 'Median of the logged exposures: '
                         f'{min(exposures_ns) * _MILLISECOND:.2f} to '
                         f'{max(exposures_ns) * _MILLISECOND:.2f} ms.')]


def _camera_matrix(fx: float, fy: float, cx: float, cy: float, source: str) -> SourcedValue:
    """Intrinsics that are no calibration: a parameter, and no CameraInfo."""
    return SourcedValue('camera_matrix', (fx, 0.0, cx, 0.0, fy, cy, 0.0, 0.0, 1.0), source)


def _refuse_portrait(path: Path, width: int, height: int) -> None:
    if height > width:   # as no phone's sensor is
        raise InputError(
            f'{path} has images of {width}x{height}: they were rotated, and their rows are the '
            "sensor's columns; record in the sensor's own orientation (landscape)")


def _landscape_video(path: Path) -> Video:
    video = Video(path)
    _refuse_portrait(path, video.width, video.height)
    return video


def _optional_table(path: Path) -> list[Row]:
    return read_table(path) if path.is_file() else []


def _optional_object(path: Path) -> Mapping[str, Any]:
    return read_object(path) if path.is_file() else {}


def _reals(rows: list[Row], column: str) -> list[float]:
    """Numbers of a column, without the rows in which it is absent, empty or 'null'."""
    return [row.real(column) for row in rows if row.words.get(column, '') not in ('', 'null')]


_STAMPS = ('stamp_ns', 'timestamp_ns')


def read_tables(folder: Path) -> Recording:
    """Recordings of any logger as tables with a header line."""
    gyro = [ImuSample(_stamp(row), row.vector(*'xyz'), None)
            for row in read_table(folder / 'gyro.csv')]
    accel = [ImuSample(_stamp(row), None, row.vector(*'xyz'))
             for row in _optional_table(folder / 'accel.csv')]
    frames = read_table(folder / 'frames.csv')
    stamps_ns = [_stamp(row) for row in frames]
    if 'file' in frames[0].words:
        images = tuple(convert.image_file(stamp_ns, convert.file_inside(folder, row, 'file'))
                       for stamp_ns, row in zip(stamps_ns, frames, strict=True))
    else:
        videos = [path for path in sorted(folder.iterdir())
                  if path.suffix.lower() in ('.mp4', '.mov')]
        if len(videos) != 1:
            raise InputError(f'{frames[0].path} has no column file, and {folder} has '
                             f'{len(videos)} videos (.mp4, .mov): there must be one')
        images = _landscape_video(videos[0]).frames(stamps_ns, frames[0].path)
    return Recording(
        None, images, gyro, _title(
            folder, '. `rs_relpose calibrate` estimates readout time and focal length'),
        (convert.COMPRESSED, _STAMP_ROW, _TIME_OFFSET, _axes()), accel=accel)


def _stamp(row: Row) -> int:
    return row.nanoseconds(next((name for name in _STAMPS if name in row.words), _STAMPS[0]))


# How far the two clocks may drift apart during a recording [ns]; beyond it the phone slept.
_MAX_DRIFT_NS = 1_000_000


def read_mars(folder: Path) -> Recording:
    """Frames of the movie with the logged stamps, and the IMU, of the MARS Logger."""
    video = _landscape_video(folder / 'movie.mp4')
    stamps = folder / 'frame_timestamps.txt'
    shift_ns, clock = _clock(folder / 'edge_epochs.txt')
    stamps_ns = [row.nanoseconds('Frame timestamp[nanosec]') + shift_ns
                 for row in read_table(stamps)]
    imu = [ImuSample(row.nanoseconds('Timestamp[nanosec]'),
                     row.vector(*(f'g{axis}[rad/s]' for axis in 'xyz')),
                     row.vector(*(f'a{axis}[m/s^2]' for axis in 'xyz')))
           for row in read_table(folder / 'gyro_accel.csv')]
    metadata = _optional_table(folder / 'movie_metadata.csv')
    readout = 'Frame readout time[nanosec]'
    fx, fy = (float(np.median(_reals(metadata, name) or [0.0])) for name in ('fx[px]', 'fy[px]'))
    lens = [] if min(fx, fy) <= 0.0 else [_camera_matrix(
        fx, fy, (video.width - 1) / 2.0, (video.height - 1) / 2.0, "A GUESS: the lens's nominal "
        'focal length as logged, principal point in the middle, no distortion.')]
    return Recording(
        None, video.frames(stamps_ns, stamps), imu,
        _title(folder, ': recorded with the MARS Logger'),
        (convert.COMPRESSED, *_readout(_reals(metadata, readout), readout),
         *_exposure(_reals(metadata, 'Exposure time[nanosec]')),
         *lens, _STAMP_ROW,
         SourcedValue('time_offset', 0.0, f'NOT KNOWN: {clock}. `rs_relpose calibrate` measures '
                      'it.'), _axes()))


def _clock(path: Path) -> tuple[int, str]:
    """Difference from the camera's stamps to the IMU's clock [ns], and its description."""
    unknown = 0, 'the clock of the camera is not logged'
    if not path.is_file():
        return unknown
    with path.open(encoding='utf-8', errors='replace') as file:
        if 'is SENSOR_INFO_TIMESTAMP_SOURCE_REALTIME' in file.readline(10_000):
            return 0, 'camera and IMU have one clock, but its delays are not logged'
    differences = [row.integer(2) for row in convert.read_rows(path, range(3), separator=None)]
    if not differences:
        return unknown
    drift = max(differences) - min(differences)
    if drift > _MAX_DRIFT_NS:
        raise InputError(f'{path}: the clocks of camera and IMU drifted apart by '
                         f'{drift * 1e-6:.1f} ms during the recording: the phone slept; record '
                         'again')
    return differences[0], ("the camera's clock is not the IMU's; its stamps were shifted by the "
                            f'logged difference, {differences[0] * 1e-6:.3f} ms')


# From ARCore's camera (x right, y up, z backwards) to the optical frame (x right, y down).
_GL_FROM_OPTICAL = Rotation.from_quat([1.0, 0.0, 0.0, 0.0])


def read_posecam(folder: Path) -> Recording:
    """Frames, IMU and, as ground truth, ARCore's poses of PoseCam."""
    poses = read_table(folder / 'poses.csv')
    images = tuple(
        convert.image_file(row.nanoseconds('timestamp_ns'), folder / 'frames' / (
            f'{row.nanoseconds("frame_index"):06d}_{row.nanoseconds("timestamp_ns")}.jpg'))
        for row in poses if row.word('image') == 'saved')
    gyro, accel, bias = _posecam_imu(folder / 'imu.csv')
    metadata = _optional_table(folder / 'frame_metadata.csv')
    if any(row.words.get('ois_mode') == '1' for row in metadata):
        _logger.warning('%s: optical stabilisation was on: the focal point moves against the '
                        'sensor, and the poses get worse; switch it off if the phone can',
                        metadata[0].path)
    skew = 'rolling_shutter_skew_ns'
    camera = _optional_object(folder / 'device.json').get('camera')
    return Recording(
        None, images, gyro, _title(folder, ': recorded with PoseCam'),
        (convert.COMPRESSED, *_readout(_reals(metadata, skew), skew),
         *_exposure(_reals(metadata, 'exposure_time_ns')), _STAMP_ROW, _TIME_OFFSET,
         _axes(camera.get('sensor_orientation_deg') if isinstance(camera, Mapping) else None),
         *_intrinsics(folder / 'intrinsics.json'), *bias),
        accel=accel, truth=_truth(poses, folder / 'manifest.json'))


def _posecam_imu(path: Path) -> tuple[list[ImuSample], list[ImuSample], list[SourcedValue]]:
    """Gyro, accelerometer, and the bias that the phone reports of an uncorrected gyro."""
    gyro: list[ImuSample] = []
    accel: list[ImuSample] = []
    biases: list[Vector] = []
    for row in read_table(path):
        stamp_ns, kind = row.nanoseconds('timestamp_ns'), row.word('sensor')
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
    bias = [] if not biases else [
        SourcedValue('gyro_bias', tuple(np.median(biases, axis=0).tolist()),
                     'Median of the bias that the phone reports; the bag has raw rates.')]
    return gyro, accel, bias


def _truth(poses: list[Row], manifest: Path) -> tuple[TruePose, ...]:
    """The longest sequence of tracked poses without a jump, after which the world is another."""
    found = _optional_object(manifest).get('pose_jumps')
    # Next to the list, whose name is not documented, are counts and thresholds.
    stamps = [jump.get('timestamp_ns')
              for values in (found.values() if isinstance(found, Mapping) else [found])
              if isinstance(values, list) for jump in values if isinstance(jump, Mapping)]
    jumps = [stamp for stamp in stamps if isinstance(stamp, int) and abs(stamp) < 2**63]
    tracked = [row for row in poses if row.word('tracking_state') == 'TRACKING']
    ends = np.searchsorted([row.nanoseconds('timestamp_ns') for row in tracked], sorted(jumps))
    longest = max(np.split(np.arange(len(tracked)), ends), key=len)
    if jumps:
        _logger.warning('ARCore relocalised %d times: only the longest part between, of %d of '
                        '%d poses, is used as ground truth', len(jumps), len(longest),
                        len(tracked))
    return tuple(_pose(tracked[number]) for number in longest)


def _pose(row: Row) -> TruePose:
    quaternion = [row.real(column) for column in ('qx', 'qy', 'qz', 'qw')]
    length = math.hypot(*quaternion)
    if abs(length - 1.0) > 1e-2:
        raise row.error(f'the quaternion must have length 1, got {length:.3g}')
    x, y, z, w = (Rotation.from_quat(quaternion) * _GL_FROM_OPTICAL).as_quat().tolist()
    return TruePose(row.nanoseconds('timestamp_ns'), row.vector('tx', 'ty', 'tz'), (x, y, z, w))


def _intrinsics(path: Path) -> list[SourcedValue]:
    if not path.is_file():
        return []
    found = read_object(path)
    values = convert.finite_numbers([found.get(name) for name in ('fx', 'fy', 'cx', 'cy')], (4,))
    if values is None:
        raise InputError(f'{path} must have the numbers fx, fy, cx and cy')
    width, height = found.get('width'), found.get('height')
    if isinstance(width, int) and isinstance(height, int):
        _refuse_portrait(path.with_name('frames'), width, height)
    fx, fy, cx, cy = values.tolist()
    return [_camera_matrix(fx, fy, cx, cy, "ARCore's intrinsics, without distortion.")]


# Logger -> the files by which its folders are recognised, and its reader.
LOGGERS: Mapping[str, tuple[tuple[str, ...], Callable[[Path], Recording]]] = {
    'PoseCam': (('poses.csv', 'imu.csv', 'frames'), read_posecam),
    'MARS Logger': (('movie.mp4', 'frame_timestamps.txt', 'gyro_accel.csv'), read_mars),
    'tables': (('frames.csv', 'gyro.csv'), read_tables),
}


def known_loggers() -> str:
    """All loggers and their files, in words."""
    return '; '.join(f'{name} ({", ".join(files)})' for name, (files, _) in LOGGERS.items())
