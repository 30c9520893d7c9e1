"""Hand-held RealSense colour camera (DM-VIO dataset of Zoltan3057): gyro and accelerometer.

Files: ``camera.txt`` (fx fy cx cy and a distortion of 0, then width and height), ``frames.csv``,
``images/``, and ``imu.txt`` with ``stamp[ns] wx wy wz [rad/s] ax ay az [m/s^2]``, the
accelerometer's as specific force. ``config/realsense_rgb_rs.yaml`` holds read-out, clock and axes.
"""

from __future__ import annotations

from pathlib import Path

from rs_relpose_ros.camera import RollingShutterCamera
from rs_relpose_ros.datasets.recording import (
    check_folder,
    floats,
    nanoseconds,
    read_rows,
    Recording,
)
from rs_relpose_ros.errors import InputError, MissingInputError

# Estimated from images and gyro; not documented by the maker.
READOUT_TIME = 0.028


def read_realsense_rgb_rs(folder: Path) -> Recording:
    """Read the recording in `folder`."""
    check_folder(folder, 'realsense_rgb_rs')
    frames_file, imu_file = folder / 'frames.csv', folder / 'imu.txt'
    frames = read_rows(frames_file, 5, ',', header=True)
    imu = read_rows(imu_file, 7)
    values = floats(imu_file, [row[1:] for row in imu])
    return Recording(
        camera=_camera(folder / 'camera.txt'), image_format='mono8; jpeg compressed ',
        stamps_ns=[nanoseconds(frames_file, row[2]) for row in frames],
        images=[_inside(folder, row[4], frames_file) for row in frames],
        imu_stamps_ns=[nanoseconds(imu_file, row[0]) for row in imu],
        angular_velocities=values[:, :3], linear_accelerations=values[:, 3:])


def _camera(path: Path) -> RollingShutterCamera:
    if not path.is_file():
        raise MissingInputError(f'{path} is missing: give the folder of the recording')
    lines = path.read_text(encoding='utf-8', errors='replace').splitlines()
    if len(lines) < 2 or len(lines[0].split()) != 5 or len(lines[1].split()) != 2:
        raise InputError(f'{path}: expected "fx fy cx cy 0" and "width height"')
    (fx, fy, cx, cy, distortion), = floats(path, [lines[0].split()])
    (width, height), = floats(path, [lines[1].split()])
    if distortion != 0.0:
        raise InputError(f'{path}: distortion {distortion} is not that of this recording, 0')
    return RollingShutterCamera(width=int(width), height=int(height), fx=float(fx), fy=float(fy),
                                cx=float(cx), cy=float(cy), readout_time=READOUT_TIME)


def _inside(folder: Path, name: str, table: Path) -> Path:
    path = Path(name)
    if path.is_absolute() or '..' in path.parts:
        raise InputError(f'{table}: image {name!r} lies outside of the folder')
    return folder / path
