"""What the loggers of Android phones have in common."""

from __future__ import annotations

from collections.abc import Sequence
import math
from pathlib import Path

import numpy as np

from rs_relpose_ros.config.parameter_file import SourcedValue
from rs_relpose_ros.convert.told_readout import readout_of_milliseconds
from rs_relpose_ros.convert.video import readout_values
from rs_relpose_ros.errors import InputError
from rs_relpose_ros.geometry.timing import NANOSECONDS

_MILLISECOND = 1e-6   # ns in ms

COMPRESSED = SourcedValue('image_transport', 'compressed', 'The bag holds JPEG images.')
STAMP_ROW = SourcedValue('stamp_row', 'first', "Android's SENSOR_TIMESTAMP is that of the first "
                         'row.')
TIME_OFFSET_NOT_KNOWN = SourcedValue(
    'time_offset', 0.0, 'NOT KNOWN: as the logger stamps. On some phones camera and IMU differ by '
    'tens of milliseconds; `rs_relpose calibrate` measures it.')


def axes(sensor_orientation: float | None) -> SourcedValue:
    """Rotation from the phone's sensor axes to a back camera, from its SENSOR_ORIENTATION [deg].

    The angle by which the image is turned clockwise to be upright in the natural orientation of
    the phone: x right, y up, z out of the screen. Most phones have 90.
    """
    source = "The camera's SENSOR_ORIENTATION, {:g} deg, as the logger tells it."
    if sensor_orientation is None:
        sensor_orientation, source = 90.0, ('ASSUMED: back camera with SENSOR_ORIENTATION {:g} '
                                            'deg, as most phones have it.')
    half = math.radians(sensor_orientation) / 2.0
    quaternion = (round(math.cos(half), 8), round(-math.sin(half), 8), 0.0, 0.0)
    return SourcedValue('quat_cam_imu_xyzw', quaternion, source.format(sensor_orientation))


def readout(skews_ns: Sequence[float], source: str) -> list[SourcedValue]:
    """Median of the logged SENSOR_ROLLING_SHUTTER_SKEW [ns]; nothing where none is logged."""
    told = None
    if skews_ns:
        told = readout_of_milliseconds(float(np.median(skews_ns)) * _MILLISECOND, source)
    if told is None:
        return []
    return readout_values(told, f'Told by the phone: median of {source}, which is that of the '
                          'whole sensor: less where the image is cropped at its top and bottom.')


def exposure(exposures_ns: Sequence[float]) -> list[SourcedValue]:
    """What SENSOR_TIMESTAMP marks, with the median exposure [ns]; nothing where none is logged."""
    if not exposures_ns:
        return []
    median = float(np.median(exposures_ns)) / NANOSECONDS
    if not 0.0 < median < 1.0:
        return []
    return [SourcedValue('stamp_exposure', 'start', "Android's SENSOR_TIMESTAMP is the start of "
                         'the exposure.'),
            SourcedValue('exposure_time', round(median, 9), 'Median of the logged exposures: '
                         f'{min(exposures_ns) * _MILLISECOND:.2f} to '
                         f'{max(exposures_ns) * _MILLISECOND:.2f} ms.')]


def camera_matrix(fx: float, fy: float, cx: float, cy: float, source: str) -> SourcedValue:
    """Intrinsics that are no calibration: a parameter, and no CameraInfo."""
    return SourcedValue('camera_matrix', (float(fx), 0.0, float(cx), 0.0, float(fy), float(cy),
                                          0.0, 0.0, 1.0), source)


def refuse_portrait(path: Path, width: int, height: int) -> None:
    """Raise an InputError where images are higher than wide: rotated, as no phone's sensor is."""
    if height > width:
        raise InputError(
            f'{path} has images of {width}x{height}: they were rotated, and their rows are the '
            "sensor's columns; record in the sensor's own orientation (landscape)")
