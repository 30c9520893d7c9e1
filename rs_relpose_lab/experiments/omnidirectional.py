"""The camera model of the OCamCalib toolbox (Scaramuzza), in which PennCOSYVIO is calibrated.

With (c, d, e) and the polynomial f(rho) = a0 + a2 rho^2 + a3 rho^3 + ... (negative, its z axis
points backwards), and m = (x, y) right and down from the centre on an ideal sensor:

    u - cx = x + e y          v - cy = d x + c y          ray ~ (x, y, -f(|m|))
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray

from rs_relpose_ros.errors import InputError
from rs_relpose_ros.geometry.camera import RollingShutterCamera

Array = NDArray[np.float64]

_MAX_STEPS = 50
_SETTLED = 1e-10


@dataclass(frozen=True, slots=True, kw_only=True)
class OmnidirectionalCamera(RollingShutterCamera):
    """A wide-angle rolling-shutter camera that sees less than 180 degrees.

    `polynomial`: a0, a1, a2, ... as OCamCalib prints ``ss``; a1 is 0, as its model demands.
    `affine` (c, d, e): as OCamCalib names them.

    Notes
    -----
    `fx` and `fy` are -a0, the pixels per radian at the centre; `cx` and `cy` its column and row,
    the first pixel being 0 (OCamCalib, in Matlab, counts from 1, and says row, column).
    """

    polynomial: tuple[float, ...]
    affine: tuple[float, float, float] = (1.0, 0.0, 0.0)

    def __post_init__(self) -> None:
        # Without super(): a dataclass with slots is another class than that of the text.
        RollingShutterCamera.__post_init__(self)
        for name in ('polynomial', 'affine'):
            values = tuple(float(value) for value in getattr(self, name))
            if not np.isfinite(values).all():
                raise InputError(f'{name} must be finite, got {values}')
            object.__setattr__(self, name, values)
        if len(self.polynomial) < 2 or not self.polynomial[0] < 0.0 or self.polynomial[1] != 0.0:
            raise InputError('polynomial must begin with a negative number and 0, '
                             f'got {self.polynomial}')
        if not abs(np.linalg.det(self._stretch)) > 1e-3:
            raise InputError(f'affine must be c, d, e of an invertible map, got {self.affine}')

    @property
    def is_undistorted(self) -> bool:
        """Never a plain pinhole."""
        return False

    def project(self, points: ArrayLike) -> Array:
        """Raw pixels (N, 2) of points (N, 3) in the camera frame; NaN where it cannot see."""
        points = np.ascontiguousarray(points, dtype=np.float64).reshape(-1, 3)
        across = np.hypot(points[:, 0], points[:, 1])
        # rho of the ray: rho * depth = -f(rho) * across, by Newton's method.
        with np.errstate(all='ignore'):
            angle = np.arctan2(across, points[:, 2])
            rho = -self.polynomial[0] * angle
            for _ in range(_MAX_STEPS):
                depth, by_rho = self._depth(rho)
                step = ((rho * points[:, 2] - across * depth)
                        / (points[:, 2] - across * rho * by_rho))
                rho = rho - step
                if not (np.abs(step) > _SETTLED * np.abs(rho)).any():
                    break
            seen = ((np.abs(step) <= 1e-6) & (rho >= 0.0) & (self._depth(rho)[0] > 0.0)
                    & (points[:, 2] > 1e-9))
            scale = np.where(across > 0.0, rho / np.where(across > 0.0, across, 1.0), 0.0)
        pixels = (points[:, :2] * scale[:, None]) @ self._stretch.T + (self.cx, self.cy)
        pixels[~seen] = np.nan
        return pixels

    def _normalized(self, points: Array) -> tuple[Array, ...]:
        inverse = np.linalg.inv(self._stretch)
        plane = (points - (self.cx, self.cy)) @ inverse.T
        depth, by_rho = self._depth(np.hypot(plane[:, 0], plane[:, 1]))
        depth = np.where(depth > 0.0, depth, np.nan)
        normalized = plane / depth[:, None]
        # d(m / depth)/dm = (I - n (d depth/dm)) / depth, with d depth/dm = by_rho m.
        by_plane = (np.eye(2) - normalized[:, :, None] * (by_rho[:, None] * plane)[:, None, :])
        by_pixel = by_plane / depth[:, None, None] @ inverse
        return normalized, np.ascontiguousarray(by_pixel)

    @property
    def _stretch(self) -> Array:
        c, d, e = self.affine
        return np.array([[1.0, e], [d, c]])

    def _depth(self, rho: Array) -> tuple[Array, Array]:
        """``-f(rho)`` and its derivative over rho (finite at 0, as a1 is 0)."""
        a = np.array(self.polynomial)
        slopes = np.arange(2, len(a)) * a[2:]
        return (-np.polynomial.polynomial.polyval(rho, a),
                -np.polynomial.polynomial.polyval(rho, slopes if len(slopes) else [0.0]))
