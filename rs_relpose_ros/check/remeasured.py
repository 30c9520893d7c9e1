"""Figures that are too far off for a trial, by the calibration of a part from nothing."""

from __future__ import annotations

from collections.abc import Iterator
import math

import numpy as np
from scipy.spatial.transform import Rotation

from rs_relpose_ros.calibrate.result import CalibrationResult
from rs_relpose_ros.config.parameters import SensorConfig
from rs_relpose_ros.front_end.frame import image_clock
from rs_relpose_ros.geometry.camera import RollingShutterCamera
from rs_relpose_ros.geometry.timing import NANOSECONDS, to_nanoseconds
from rs_relpose_ros.health.findings import Finding, HealthState

# Sigmas from which on a figure is off, and by how much it must be: a trial sees less by itself.
_CERTAIN = 4.0
_LEAST_TURN, _LEAST_TIME = math.radians(5.0), 8e-3


def contradicted(found: CalibrationResult, sensor: SensorConfig,
                 camera: RollingShutterCamera) -> tuple[Finding, ...]:
    """Figures that were told far from what the calibration found; `camera` as told.

    None where it does not know the offset: images and gyro that have nothing in common.
    """
    if not found.time_offset.observable:
        return ()
    return (*_axes(found, sensor), *_offset(found, sensor, camera), *_readout(found, camera))


def _axes(found: CalibrationResult, sensor: SensorConfig) -> Iterator[Finding]:
    turn = Rotation.from_matrix(found.R_cam_imu @ sensor.R_cam_imu.T).magnitude()
    sigma = float(found.rotation_sigma.max())
    if turn > max(_CERTAIN * sigma, _LEAST_TURN):
        angle, spread = math.degrees(turn), math.degrees(sigma)
        xyzw = [round(value, 5) for value in found.quat_cam_imu_xyzw]
        yield Finding('axes', 0.0, angle, spread, 'deg', True, HealthState.WRONG,
                      f'calibrated anew, the IMU is turned by {angle:.1f} +- {spread:.1f} deg '
                      f'against quat_cam_imu_xyzw: set quat_cam_imu_xyzw: {xyzw} (a static '
                      'transform with parent imu holds the inverse)')


def _offset(found: CalibrationResult, sensor: SensorConfig,
            camera: RollingShutterCamera) -> Iterator[Finding]:
    # Of the stamped row; what is found is that of row 0, at the median interval.
    share = camera.reference_row_index / camera.height
    seen = found.time_offset.value + share * found.readout_time.value
    off = seen - image_clock(camera, sensor).reference_ns(
        0, to_nanoseconds(found.frame_interval)) / NANOSECONDS
    sigma = math.hypot(found.time_offset.sigma, share * found.readout_time.sigma)
    if abs(off) > max(_CERTAIN * sigma, _LEAST_TIME):
        told, right = sensor.time_offset, sensor.time_offset + off
        yield Finding('time_offset', told, right, sigma, 's', True, HealthState.WRONG,
                      f'calibrated anew, it is {1e3 * right:.1f} +- {1e3 * sigma:.1f} ms, '
                      f'{1e3 * told:.1f} ms in force: set time_offset: {right:.4f}')


def _readout(found: CalibrationResult, camera: RollingShutterCamera) -> Iterator[Finding]:
    readout = found.readout_time
    told = camera.line_delay * camera.height
    if abs(readout.value - told) <= max(_CERTAIN * readout.sigma, _LEAST_TIME):
        return
    text = f'calibrated anew, it is {1e3 * abs(readout.value):.1f} +- {1e3 * readout.sigma:.1f} ms'
    if np.sign(readout.value) * np.sign(told) < 0.0:
        right = 'up' if readout.value < 0.0 else 'down'
        yield Finding('readout_direction', abs(told), -abs(readout.value), readout.sigma, 's',
                      True, HealthState.WRONG, f'{text}, the other way: set readout_direction: '
                      f'{right}')
    else:
        yield Finding('readout_time', abs(told), abs(readout.value), readout.sigma, 's', True,
                      HealthState.WRONG, f'{text}, {1e3 * abs(told):.1f} ms in force: set '
                      f'readout_time: {abs(readout.value):.4f}')
