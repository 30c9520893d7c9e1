"""Limits of the camera-IMU calibration."""

from __future__ import annotations

from dataclasses import dataclass
import math

from rs_relpose_ros.config.declarations import check_settings, setting


@dataclass(frozen=True, slots=True)
class CalibrationConfig:
    """Needs of a recording, limits of an observable figure, and errors of the tracker."""

    max_time_offset: float = setting(
        0.25, 'largest clock offset that is searched for', 's', low=0.01, high=5.0)
    min_frames: int = setting(40, 'frames that a recording must have', low=10, high=100_000)
    min_rotation_rate: float = setting(
        math.radians(2.0), 'rms of the rotation below which a camera stands still', 'rad/s',
        low=0.0, high=10.0)
    max_gyro_gap: float = setting(
        0.03, 'longest step between gyro samples that is interpolated', 's', low=1e-3, high=1.0)
    max_readout_sigma: float = setting(
        1.5e-3, 'sigma of an observable read-out time', 's', low=1e-5, high=1.0)
    max_offset_sigma: float = setting(
        3e-3, 'sigma of an observable offset', 's', low=1e-5, high=1.0)
    max_rotation_sigma: float = setting(
        math.radians(0.7), 'sigma of an observable rotation, each axis', 'rad', low=1e-5,
        high=1.0)
    max_bias_sigma: float = setting(
        0.01, 'sigma of an observable gyro bias', 'rad/s', low=1e-5, high=1.0)
    max_focal_sigma: float = setting(
        0.03, 'sigma of an observable focal length, relative', low=1e-4, high=1.0)

    exposed: bool = setting(
        False, 'whether the points come from images, each of which is exposed for a while')
    exposure_slope_sigma: float = setting(
        0.0, 'error of the offset by the interval: the exposure changes within a step of the '
        'interval, too', 's/s', low=0.0, high=10.0)
    tracking_time_sigma: float = setting(
        0.0, 'error of read-out and offset by the tracker, beyond scatter', 's', low=0.0, high=0.1)
    tracking_rotation_sigma: float = setting(
        0.0, 'error of the rotation by the tracker, beyond scatter', 'rad', low=0.0, high=1.0)
    tracking_bias_sigma: float = setting(
        0.0, 'error of the gyro bias by the tracker, beyond scatter', 'rad/s', low=0.0, high=1.0)

    def __post_init__(self) -> None:
        check_settings(self)


# Errors that a tracker makes alike over all of a recording, which its scatter does not show: found
# on rendered bags with KLT.
TRACKED_IN_IMAGES = CalibrationConfig(
    exposed=True, exposure_slope_sigma=0.08, tracking_time_sigma=5e-5,
    tracking_rotation_sigma=1e-3, tracking_bias_sigma=2.5e-4)
