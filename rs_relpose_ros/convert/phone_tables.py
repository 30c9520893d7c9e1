"""Recordings of any logger as tables with a header line.

The files::

    frames.csv   stamp_ns, file (a JPEG image; without this column, the frames of the only video)
    gyro.csv     stamp_ns,x,y,z   [rad/s]
    accel.csv    stamp_ns,x,y,z   [m/s^2] specific force; may be absent

All stamps on one clock, the IMU in the phone's sensor axes; further columns are ignored.
"""

from __future__ import annotations

from pathlib import Path

from rs_relpose_ros.convert import phone
from rs_relpose_ros.convert.recording import (
    by_stamp,
    Conversion,
    ImageFile,
    RecordedImage,
    Recording,
)
from rs_relpose_ros.convert.tables import file_inside, read_table, Table
from rs_relpose_ros.convert.video_frames import IMAGE_FORMAT, Video
from rs_relpose_ros.errors import InputError
from rs_relpose_ros.imu.samples import ImuSample

FILES = ('frames.csv', 'gyro.csv')

_STAMP = ('stamp_ns', 'timestamp_ns')


def read_conversion(folder: Path) -> Conversion:
    """What the module's docstring describes."""
    accel: tuple[ImuSample, ...] = ()
    if (folder / 'accel.csv').is_file():
        accel = by_stamp(ImuSample(stamp_ns, None, value)
                         for stamp_ns, value in _samples(read_table(folder / 'accel.csv')))
    gyro = by_stamp(ImuSample(stamp_ns, value, None)
                    for stamp_ns, value in _samples(read_table(folder / 'gyro.csv')))
    return Conversion(
        Recording(camera=None, images=_images(folder, read_table(folder / 'frames.csv')),
                  image_format=IMAGE_FORMAT, imu=gyro, accel=accel),
        f'Parameters of relpose_node for {folder.name} (`rs_relpose convert android`). The '
        'read-out time and the focal length, `rs_relpose calibrate` finds.',
        (phone.COMPRESSED, phone.STAMP_ROW, phone.TIME_OFFSET_NOT_KNOWN, phone.axes(None)))


def _samples(table: Table) -> list[tuple[int, tuple[float, float, float]]]:
    stamp, x, y, z = table.column(*_STAMP), *(table.column(name) for name in 'xyz')
    return [(row.nanoseconds(stamp), (row.real(x), row.real(y), row.real(z)))
            for row in table.rows]


def _images(folder: Path, frames: Table) -> tuple[RecordedImage, ...]:
    stamp = frames.column(*_STAMP)
    if frames.has('file'):
        file = frames.column('file')
        return tuple(ImageFile(row.nanoseconds(stamp), file_inside(folder, row, file))
                     for row in frames.rows)
    videos = [path for path in sorted(folder.iterdir()) if path.suffix.lower() in ('.mp4', '.mov')]
    if len(videos) != 1:
        raise InputError(f'{frames.path} has no column file, and {folder} has {len(videos)} '
                         'videos (.mp4, .mov): there must be one')
    video = Video(videos[0])
    phone.refuse_portrait(video.path, video.width, video.height)
    if len(video) != len(frames.rows):
        raise InputError(f'{frames.path} has {len(frames.rows)} stamps, but {video.path} has '
                         f'{len(video)} frames: which of them belong together cannot be told')
    return video.frames([row.nanoseconds(stamp) for row in frames.rows])
