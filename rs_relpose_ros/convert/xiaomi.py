"""Phone camera and gyro, as cut from gyro-video-stabilization of lhaippp.

https://github.com/lhaippp/gyro-video-stabilization (MIT), folder 20200109_145447, commit
480a1eadbdba43d33db6de740434c98a77c890ea::

    framestamp.txt   start of frame [s], line N for image N
    gyro.txt         angular velocity [rad/s] and stamp [s], separated by commas; 412 Hz
    images/          RE_frame-N.jpg, in colour

There is no accelerometer, and no file holds the calibration: it stands in the code of that
repository, for its images of 800x600.
"""

from __future__ import annotations

from pathlib import Path
import re

from rs_relpose_ros.config.parameter_file import SourcedValue
from rs_relpose_ros.convert.recording import ImageFile, ordered_samples, Recording
from rs_relpose_ros.convert.tables import read_rows
from rs_relpose_ros.errors import InputError, MissingInputError
from rs_relpose_ros.geometry.camera import RollingShutterCamera
from rs_relpose_ros.imu.samples import ImuSample

READOUT_TIME = 0.0311

# Its skew of -0.7 px per unit of y/z has no place in CameraInfo; left out, it moves no point by
# more than 0.4 px.
CAMERA = RollingShutterCamera(width=800, height=600, fx=573.8534, fy=575.0448, cx=406.0101,
                              cy=309.0112, readout_time=READOUT_TIME)

TITLE = ('Parameters of relpose_node for the recording xiaomi_cc9_rs (`rs_relpose convert '
         'xiaomi_cc9_rs`): phone of the Xiaomi CC9 class in a driving car, 800x600, gyro only.')

PARAMETERS = (
    SourcedValue('image_transport', 'compressed', 'The bag holds the recorded JPEG images.'),
    SourcedValue(
        'readout_time', READOUT_TIME,
        'Estimated from the images and the gyro themselves: minimum of the robust epipolar '
        'cost over 101 pairs (13.72 at 31.1 ms, 30.3 at 0). The repository itself takes the '
        'whole frame interval, 33.3 ms.'),
    SourcedValue('readout_direction', 'down', 'As that estimate.'),
    SourcedValue('stamp_row', 'first', 'Stamps are the start of the frame.'),
    SourcedValue(
        'time_offset', -0.0024,
        'Estimated with readout_time; about minus half the exposure of 5.2 ms.'),
    SourcedValue('quat_cam_imu_xyzw', (0.71311442, -0.70096593, -0.00143244, 0.01060837),
        'Rotation vector (2.22531, -2.18740, -0.00447) rad, refined with readout_time; 1.6 deg '
        'from the axis map cam_x = -imu_y, cam_y = -imu_x, cam_z = -imu_z of the repository.'),
    SourcedValue('gyro_bias', (0.0, 0.0, 0.0),
        'Not known: the phone is never at rest, and its mean rate is that of the car.'),
    SourcedValue('feature_rows', (0.0, 420.0),
        'Below row 420 the image shows the dashboard, which moves with the camera.'),
)

_IMAGE_NAME = re.compile(r'RE_frame-([0-9]{1,6})\.jpg')


def read_recording(folder: Path) -> Recording:
    """Read what the module's docstring describes; images are read when the bag is written."""
    return Recording(
        camera=CAMERA,
        images=_find_images(folder),
        image_format='bgr8; jpeg compressed bgr8',
        imu=ordered_samples(
            ImuSample(row.seconds_as_nanoseconds(3), (row.real(0), row.real(1), row.real(2)),
                      None)
            for row in read_rows(folder / 'gyro.txt', columns=4, separator=',')))


def _find_images(folder: Path) -> tuple[ImageFile, ...]:
    stamps = [row.seconds_as_nanoseconds(0)
              for row in read_rows(folder / 'framestamp.txt', columns=1)]
    if not (folder / 'images').is_dir():
        raise MissingInputError(f'the folder of images is missing: there is no {folder}/images')
    found = {int(match[1]): path for path in (folder / 'images').iterdir()
             if (match := _IMAGE_NAME.fullmatch(path.name))}
    if not found:
        raise MissingInputError(f'{folder}/images has no images RE_frame-N.jpg')
    for number, path in found.items():
        if not 1 <= number <= len(stamps):
            raise InputError(f'{path} has no stamp: framestamp.txt has lines 1 to {len(stamps)}')
    return tuple(ImageFile(stamps[number - 1], found[number]) for number in sorted(found))
