"""Recordings of cameras, phones and data sets to bags.

`FORMATS` has a row for each format that is a folder: its name, the source of `rs_relpose convert`
that reads it, and the files by which it is recognised. A phone's logger also has a row in
`cli.recordings.PHONES`.
"""

from pathlib import Path
from typing import NamedTuple


class FolderFormat(NamedTuple):
    """A format of recordings in folders; each file is a glob below the folder."""

    name: str
    source: str  # of `rs_relpose convert`
    files: tuple[str, ...]

    def __str__(self) -> str:
        return f'{self.name} ({", ".join(self.files)})'


# Folders that `convert` reads, each with the files that tell it from the others.
FORMATS = (
    FolderFormat('PoseCam', 'phone', ('poses.csv', 'imu.csv', 'frames')),
    FolderFormat('MARS Logger', 'phone', ('movie.mp4', 'frame_timestamps.txt', 'gyro_accel.csv')),
    FolderFormat('Stray Scanner', 'phone', ('rgb.mp4', 'odometry.csv', 'imu.csv')),
    FolderFormat('ios_logger', 'phone', ('Frames.m4v', 'Frames.txt', 'Gyro.txt')),
    FolderFormat('OpenCamera Sensors', 'phone', ('VID_*.mp4', '*/VID_*_gyro.csv')),
    FolderFormat('VideoIMUCapture', 'phone', ('video_recording.mp4', 'video_meta.pb3')),
    FolderFormat('Sensor Logger', 'phone', ('Gyroscope.csv', 'Camera')),
    FolderFormat('tables', 'phone', ('frames.csv', 'gyro.csv')),
    FolderFormat('EuRoC / ASL', 'euroc', ('mav0/cam0/data.csv', 'mav0/imu0/data.csv')),
)


def recognised(folder: Path) -> FolderFormat | None:
    """Return the format of a folder by its files; None if it has none of them."""
    for one in FORMATS:
        if all(any(folder.glob(file)) for file in one.files):
            return one
    return None


def found(folder: Path) -> tuple[Path, FolderFormat] | None:
    """Return the folder of a recording and its format: the folder, or the only one in it."""
    if own := recognised(folder):
        return folder, own
    inside = [
        (child, one)
        for child in sorted(folder.iterdir())
        if child.is_dir() and (one := recognised(child)) is not None
    ]
    return inside[0] if len(inside) == 1 else None


# Videos by the end of their name; other files are no recordings.
_VIDEOS = ('.mp4', '.mov', '.m4v')


def how_to_convert(path: Path) -> str:
    """Return the end of an error on a path that is no bag: its format and the command, or ''."""
    if path.is_file():
        video = path.suffix.lower() in _VIDEOS
        return f'; "rs_relpose convert video {path} OUT_BAG" reads a camera video' * video
    place = found(path)
    if place is None:
        return ''
    folder, one = place
    return f'; it is of {one}: rs_relpose convert {one.source} {folder} OUT_BAG'
