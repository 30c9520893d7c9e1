"""Recordings of the Mobile AR Sensor (MARS) Logger for Android.

github.com/OSUPCVLab/mobile-ar-sensor-logger; as the app writes them::

    movie.mp4              the frames
    frame_timestamps.txt   Frame timestamp[nanosec], and more: a line for each frame of the movie
    gyro_accel.csv         Timestamp[nanosec],gx[rad/s],gy[rad/s],gz[rad/s],ax[m/s^2],...
    movie_metadata.csv     Timestamp[nanosec],fx[px],fy[px],...,Exposure time[nanosec],...,
                           Frame readout time[nanosec],...
    edge_epochs.txt        which clock the camera's stamps have, and both clocks at start and end
"""

from __future__ import annotations

from pathlib import Path

import numpy as np

from rs_relpose_ros.config.parameter_file import SourcedValue
from rs_relpose_ros.convert import phone
from rs_relpose_ros.convert.recording import by_stamp, Conversion, Recording
from rs_relpose_ros.convert.tables import read_rows, read_table, Table
from rs_relpose_ros.convert.video_frames import IMAGE_FORMAT, Video
from rs_relpose_ros.errors import InputError
from rs_relpose_ros.imu.samples import ImuSample

FILES = ('movie.mp4', 'frame_timestamps.txt', 'gyro_accel.csv')

_STAMP = 'Timestamp[nanosec]'
# How far the two clocks may run apart during a recording [ns]; beyond it the phone slept.
_MAX_DRIFT_NS = 1_000_000


def read_conversion(folder: Path) -> Conversion:
    """Frames of the movie with the logged stamps, and the IMU."""
    video = Video(folder / 'movie.mp4')
    phone.refuse_portrait(video.path, video.width, video.height)
    stamps = read_table(folder / 'frame_timestamps.txt')
    if len(stamps.rows) != len(video):
        raise InputError(f'{stamps.path} has {len(stamps.rows)} stamps, but {video.path} has '
                         f'{len(video)} frames: which of them belong together cannot be told')
    column = stamps.column('Frame timestamp[nanosec]')
    shift_ns, clock = _clock(folder / 'edge_epochs.txt')
    recording = Recording(
        camera=None, images=video.frames([row.nanoseconds(column) + shift_ns
                                          for row in stamps.rows]),
        image_format=IMAGE_FORMAT, imu=_imu(read_table(folder / 'gyro_accel.csv')))
    return Conversion(
        recording, f'Parameters of relpose_node for {folder.name} (`rs_relpose convert android`): '
        'recorded with the MARS Logger.',
        (phone.COMPRESSED, *_of_frames(folder / 'movie_metadata.csv', video), phone.STAMP_ROW,
         SourcedValue('time_offset', 0.0, f'NOT KNOWN: {clock}. `rs_relpose calibrate` measures '
                      'it.'),
         phone.axes(None)))


def _imu(table: Table) -> tuple[ImuSample, ...]:
    stamp, gx, ax = (table.column(name) for name in (_STAMP, 'gx[rad/s]', 'ax[m/s^2]'))
    return by_stamp(ImuSample(row.nanoseconds(stamp),
                              (row.real(gx), row.real(gx + 1), row.real(gx + 2)),
                              (row.real(ax), row.real(ax + 1), row.real(ax + 2)))
                    for row in table.rows)


def _of_frames(path: Path, video: Video) -> list[SourcedValue]:
    """Read-out time, exposure and nominal focal length, as far as the phone reports them."""
    if not path.is_file():
        return []
    table = read_table(path)
    numbers = {name: [row.real(table.column(name)) for row in table.rows
                      if row.words[table.column(name)] not in ('', 'null')]
               for name in ('fx[px]', 'fy[px]', 'Exposure time[nanosec]',
                            'Frame readout time[nanosec]') if table.has(name)}
    values = [*phone.readout(numbers.get('Frame readout time[nanosec]', []),
                             'Frame readout time[nanosec]'),
              *phone.exposure(numbers.get('Exposure time[nanosec]', []))]
    focal = [float(np.median(numbers[name])) for name in ('fx[px]', 'fy[px]') if numbers.get(name)]
    if len(focal) == 2 and min(focal) > 0.0:
        values.append(phone.camera_matrix(
            focal[0], focal[1], (video.width - 1) / 2.0, (video.height - 1) / 2.0,
            "A GUESS: the lens's nominal focal length as logged, principal point in the middle, "
            'no distortion.'))
    return values


def _clock(path: Path) -> tuple[int, str]:
    """What is to be added to the camera's stamps [ns] to come to the IMU's clock, in words too."""
    if not path.is_file():
        return 0, 'which clock the camera has is not logged'
    text = path.read_text(encoding='utf-8', errors='replace')[:10_000]
    first = text.partition('\n')[0]
    if 'is SENSOR_INFO_TIMESTAMP_SOURCE_REALTIME' in first:
        return 0, 'camera and IMU have one clock, but its delays are not logged'
    differences = [row.integer(2) for row in read_rows(path, columns=3)]
    if not differences:
        return 0, 'which clock the camera has is not logged'
    if max(differences) - min(differences) > _MAX_DRIFT_NS:
        raise InputError(f'{path}: the clocks of camera and IMU ran apart by '
                         f'{(max(differences) - min(differences)) * 1e-6:.1f} ms during the '
                         'recording: the phone slept; record again')
    return differences[0], ("the camera's clock is not the IMU's; its stamps were moved by the "
                            f'logged difference, {differences[0] * 1e-6:.3f} ms')
