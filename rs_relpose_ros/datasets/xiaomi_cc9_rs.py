"""Phone behind a windscreen (gyro-video-stabilization of lhaippp): gyro, no accelerometer.

Files: ``images/RE_frame-N.jpg``, ``framestamp.txt`` whose line N is the start of frame N [s], and
``gyro.txt`` with ``wx,wy,wz [rad/s], t [s]``. ``config/xiaomi_cc9_rs.yaml`` holds read-out, clock,
axes, and the rows that show the street. The skew of -0.70 px in the published intrinsics is not
modelled: it moves a point at most by 0.4 px, in its column only.
"""

from __future__ import annotations

from pathlib import Path
import re

from rs_relpose_ros.camera import RollingShutterCamera
from rs_relpose_ros.datasets.recording import (
    check_folder,
    floats,
    read_rows,
    Recording,
    seconds_text_to_ns,
)
from rs_relpose_ros.errors import InputError, MissingInputError
from rs_relpose_ros.timing import NANOSECONDS

# In the authors' source code; pixels of the 800x600 images.
CAMERA = RollingShutterCamera(width=800, height=600, fx=573.8534, fy=575.0448, cx=406.0101,
                              cy=309.0112, readout_time=0.0311)

# The gyro log is twenty times longer than the frames kept of the video.
_GYRO_MARGIN_NS = NANOSECONDS


def read_xiaomi_cc9_rs(folder: Path) -> Recording:
    """Read the recording in `folder`; of the gyro, what lies within a second of the frames."""
    check_folder(folder, 'xiaomi_cc9_rs')
    stamps_file, gyro_file = folder / 'framestamp.txt', folder / 'gyro.txt'
    numbered = _numbered_images(folder / 'images')
    frame_starts = read_rows(stamps_file, 1)
    if numbered[-1][0] > len(frame_starts) or numbered[0][0] < 1:
        raise InputError(f'{stamps_file} has {len(frame_starts)} frames, but there is an image '
                         f'of number {numbered[-1][0]}')
    stamps_ns = [seconds_text_to_ns(stamps_file, frame_starts[number - 1][0])
                 for number, _ in numbered]
    gyro = [(seconds_text_to_ns(gyro_file, row[3]), row[:3])
            for row in read_rows(gyro_file, 4, ',')]
    near = [(stamp, row) for stamp, row in gyro
            if stamps_ns[0] - _GYRO_MARGIN_NS <= stamp <= stamps_ns[-1] + _GYRO_MARGIN_NS]
    if not near:
        raise InputError(f'{gyro_file} has no samples at the time of the frames')
    return Recording(
        camera=CAMERA, image_format='bgr8; jpeg compressed bgr8', stamps_ns=stamps_ns,
        images=[path for _, path in numbered], imu_stamps_ns=[stamp for stamp, _ in near],
        angular_velocities=floats(gyro_file, [row for _, row in near]),
        linear_accelerations=None)


def _numbered_images(folder: Path) -> list[tuple[int, Path]]:
    found = []
    for path in folder.glob('RE_frame-*.jpg'):
        match = re.fullmatch(r'RE_frame-(\d+)\.jpg', path.name)
        if match:
            found.append((int(match.group(1)), path))
    if not found:
        raise MissingInputError(f'{folder} has no images RE_frame-N.jpg')
    return sorted(found)
