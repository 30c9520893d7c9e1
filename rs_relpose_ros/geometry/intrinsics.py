"""Calibration of a camera as a message gives it, and the published image's place on the sensor."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray

from rs_relpose_ros.errors import InputError
from rs_relpose_ros.geometry.camera import RollingShutterCamera


@dataclass(frozen=True, slots=True, kw_only=True)
class Intrinsics:
    """Intrinsics of the full sensor, and which part of it is published at which binning.

    A published pixel ``u`` covers `binning_x` sensor columns, and pixel centres lie at integer
    coordinates, so ``u_sensor = x_offset + binning_x (u + 1/2) - 1/2``; the same for ``v``.
    The read-out time is no part of it: no message carries it.

    Parameters
    ----------
    width, height : int
        Size of the sensor [px], which the intrinsics belong to.
    fx, fy, cx, cy : float
        Pinhole intrinsics [px].
    distortion_model : {'plumb_bob', 'rational_polynomial', 'equidistant'}
    distortion : tuple of float
        Coefficients in OpenCV's order.
    x_offset, y_offset : int
        Sensor pixel of the published image's corner.
    binning_x, binning_y : int
        Sensor columns and rows per published pixel.
    image_width, image_height : int
        Size of the published image [px].
    """

    width: int
    height: int
    fx: float
    fy: float
    cx: float
    cy: float
    distortion_model: str = 'plumb_bob'
    distortion: tuple[float, ...] = ()
    x_offset: int = 0
    y_offset: int = 0
    binning_x: int = 1
    binning_y: int = 1
    image_width: int
    image_height: int

    def __post_init__(self) -> None:
        # The camera model checks intrinsics and distortion; one place of those rules is enough.
        self.global_shutter_camera()
        for name in ('image_width', 'image_height', 'binning_x', 'binning_y'):
            if getattr(self, name) < 1:
                raise InputError(f'{name} must be >= 1, got {getattr(self, name)}')
        for axis, offset, binning, size, sensor in (
                ('x', self.x_offset, self.binning_x, self.image_width, self.width),
                ('y', self.y_offset, self.binning_y, self.image_height, self.height)):
            if offset < 0 or offset + binning * size > sensor:
                raise InputError(
                    f'region of interest leaves the sensor in {axis}: offset {offset} and {size} '
                    f'pixels of {binning} must lie within {sensor}')

    def global_shutter_camera(self) -> RollingShutterCamera:
        """Camera model of the full sensor, its read-out time 0."""
        return RollingShutterCamera(
            width=self.width, height=self.height, fx=self.fx, fy=self.fy, cx=self.cx, cy=self.cy,
            distortion_model=self.distortion_model, distortion=self.distortion, readout_time=0.0)

    def to_sensor(self, points: ArrayLike) -> NDArray[np.float64]:
        """Sensor pixels (N, 2) of pixels (N, 2) of the published image."""
        points = np.asarray(points, dtype=np.float64)
        return self._offset + self._binning * (points + 0.5) - 0.5

    def to_image(self, points: ArrayLike) -> NDArray[np.float64]:
        """Pixels (N, 2) of the published image of sensor pixels (N, 2)."""
        points = np.asarray(points, dtype=np.float64)
        return (points + 0.5 - self._offset) / self._binning - 0.5

    @property
    def _offset(self) -> NDArray[np.float64]:
        return np.array([self.x_offset, self.y_offset], dtype=np.float64)

    @property
    def _binning(self) -> NDArray[np.float64]:
        return np.array([self.binning_x, self.binning_y], dtype=np.float64)
