"""The rolling-shutter camera: pixel <-> unit ray, and the time of a row.

Camera frame: x right, y down, z forward. The **raw, distorted** row decides the row time; the
point is undistorted, the row never is.
"""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np
from numpy.typing import ArrayLike, NDArray

from rs_relpose_ros.errors import InputError
from rs_relpose_ros.geometry.distortion.inverse import project_points, undistort_points
from rs_relpose_ros.geometry.distortion.models import DISTORTION_MODELS, DistortionModel
from rs_relpose_ros.geometry.rays import rays_with_jacobian
from rs_relpose_ros.geometry.turning import project_turning

REFERENCE_ROWS = ('first', 'middle', 'last')
READOUT_DIRECTIONS = ('down', 'up')

# Far beyond any camera, and near enough that no square of a pixel or a ray overflows.
_LARGEST_IMAGE = 1_000_000
_FARTHEST_PIXEL = 1e9


@dataclass(frozen=True, slots=True, kw_only=True)
class RollingShutterCamera:
    """A calibrated camera that reads its rows one after the other.

    Parameters
    ----------
    width, height : int
        Size of the image [px].
    fx, fy, cx, cy : float
        Pinhole intrinsics [px]; pixel centres at integer coordinates, as in OpenCV.
    distortion_model : {'plumb_bob', 'rational_polynomial', 'equidistant'}
        A name of `DISTORTION_MODELS`, as in sensor_msgs/CameraInfo (REP-104); ``'equidistant'`` is
        OpenCV's fisheye model.
    distortion : sequence of float
        Coefficients in OpenCV's order; empty for none.
    readout_time : float
        `height` times the line delay [s]; 0 is a global shutter. It has no default.
    readout_direction : {'down', 'up'}
        Whether row 0 is read first ('down') or last ('up').
    reference_row : {'first', 'middle', 'last'}
        The row from which row times count (rows 0, (height-1)/2, height-1): motion holds there,
        and a relative pose relates the reference rows of its two frames.
    """

    width: int
    height: int
    fx: float
    fy: float
    cx: float
    cy: float
    distortion_model: str = 'plumb_bob'
    distortion: tuple[float, ...] = field(default=())
    readout_time: float
    readout_direction: str = 'down'
    reference_row: str = 'first'

    def __post_init__(self) -> None:
        for name in ('width', 'height'):
            value = getattr(self, name)
            if not (1 <= value <= _LARGEST_IMAGE and int(value) == value):
                raise InputError(f'{name} must be a positive number of pixels, at most '
                                 f'{_LARGEST_IMAGE}, got {value!r}')
        for name in ('fx', 'fy'):
            value = getattr(self, name)
            if not 1.0 / _FARTHEST_PIXEL <= value <= _FARTHEST_PIXEL:
                raise InputError(f'{name} must be finite and > 0 px (within '
                                 f'[{1.0 / _FARTHEST_PIXEL:g}, {_FARTHEST_PIXEL:g}]), '
                                 f'got {value!r}')
        for name in ('cx', 'cy'):
            value = getattr(self, name)
            if not abs(value) <= _FARTHEST_PIXEL:
                raise InputError(f'{name} must be finite and within {_FARTHEST_PIXEL:g} px, '
                                 f'got {value!r}')
        if not (np.isfinite(self.readout_time) and 0.0 <= self.readout_time < 1.0):
            raise InputError(
                'readout_time must lie in [0, 1) s (it is height times line delay; '
                f'0 for a global shutter), got {self.readout_time!r}')
        if self.readout_direction not in READOUT_DIRECTIONS:
            raise InputError(f'readout_direction must be one of {READOUT_DIRECTIONS}, '
                             f'got {self.readout_direction!r}')
        if self.reference_row not in REFERENCE_ROWS:
            raise InputError(
                f'reference_row must be one of {REFERENCE_ROWS}, got {self.reference_row!r}')
        if self.distortion_model not in DISTORTION_MODELS:
            raise InputError(
                f'distortion_model must be one of {tuple(DISTORTION_MODELS)}, '
                f'got {self.distortion_model!r}')
        coefficients = tuple(float(c) for c in self.distortion)
        if not all(np.isfinite(coefficients)):
            raise InputError(f'distortion must be finite, got {coefficients}')
        legal = self._lens.coefficient_counts
        if coefficients and len(coefficients) not in legal:
            raise InputError(
                f'distortion of model {self.distortion_model!r} must have one of {legal} '
                f'coefficients, got {len(coefficients)}')
        object.__setattr__(self, 'distortion', coefficients)

    # -- rows and time -----------------------------------------------------------------------

    @property
    def line_delay(self) -> float:
        """Signed time from one row to the row below it [s]; negative when read upwards."""
        delay = self.readout_time / self.height
        return delay if self.readout_direction == 'down' else -delay

    @property
    def reference_row_index(self) -> float:
        """Row from which row times count: 0, (height - 1) / 2 or height - 1."""
        return {'first': 0.0, 'middle': (self.height - 1) / 2, 'last': self.height - 1.0}[
            self.reference_row]

    def row_times(self, rows: ArrayLike) -> NDArray[np.float64]:
        """Row times ``tau = (row - reference row) * line_delay`` [s] of raw, distorted rows."""
        rows = np.asarray(rows, dtype=np.float64)
        return (rows - self.reference_row_index) * self.line_delay

    @property
    def row_time_span(self) -> tuple[float, float]:
        """Smallest and largest row time of the image [s]."""
        ends = self.row_times([0.0, self.height - 1.0])
        return float(ends.min()), float(ends.max())

    # -- pixels and rays ---------------------------------------------------------------------

    @property
    def camera_matrix(self) -> NDArray[np.float64]:
        """The 3x3 intrinsic matrix."""
        return np.array([[self.fx, 0.0, self.cx], [0.0, self.fy, self.cy], [0.0, 0.0, 1.0]])

    @property
    def is_undistorted(self) -> bool:
        """Whether the model is a plain pinhole (``'equidistant'`` never is)."""
        return self._lens.is_pinhole_at_zero and not any(self.distortion)

    def project(self, points: ArrayLike) -> NDArray[np.float64]:
        """Raw pixels (N, 2) of points (N, 3) in the camera frame; NaN behind the camera.

        A single exposure instant: a moving camera's rows are the caller's business.
        """
        points = np.ascontiguousarray(points, dtype=np.float64).reshape(-1, 3)
        distort, _ = self._lens.addresses
        normalized = project_points(points, distort, self._lens.padded(self.distortion))
        return normalized * (self.fx, self.fy) + (self.cx, self.cy)

    def project_turning(self, rays: NDArray[np.float64], rows: NDArray[np.float64],
                        rotations: NDArray[np.float64]) -> NDArray[np.float64]:
        """Raw pixels (N, 2) of rays (N, 3) seen while the camera turns; NaN where nowhere.

        `rotations` (K, 3, 3) take from the frame of the rays to the camera's at K rows spread
        evenly from the first to the last one; `rows` (N,) are first guesses. Each ray is seen by
        the row that it is projected to.
        """
        distort, _ = self._lens.addresses
        return project_turning(rays, rows, rotations, self.height,
                               (self.fx, self.fy, self.cx, self.cy), distort,
                               self._lens.padded(self.distortion))

    def unproject(self, points: ArrayLike) -> NDArray[np.float64]:
        """Unit rays (N, 3) in the camera frame of raw pixels (N, 2).

        A pixel outside the region where the distortion can be inverted gives a row of NaN.
        """
        return self.unproject_with_jacobian(points)[0]

    def unproject_with_jacobian(
            self, points: ArrayLike) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        """Unit rays (N, 3) and their derivatives (N, 3, 2) by the raw pixel coordinates u, v."""
        points = np.ascontiguousarray(points, dtype=np.float64).reshape(-1, 2)
        return rays_with_jacobian(*self._normalized(points))

    def _normalized(self, points: NDArray[np.float64]) -> tuple[NDArray[np.float64], ...]:
        """Undistorted points (N, 2) at z = 1, and their derivatives (N, 2, 2) by the pixel."""
        normalized = (points - (self.cx, self.cy)) / (self.fx, self.fy)
        by_pixel = np.empty((len(points), 2, 2))
        if self.is_undistorted:
            by_pixel[:] = np.diag([1.0 / self.fx, 1.0 / self.fy])
        else:
            normalized, inverse = undistort_points(normalized, *self._lens.addresses,
                                                   self._lens.padded(self.distortion))
            np.divide(inverse, (self.fx, self.fy), out=by_pixel)
        return normalized, by_pixel

    @property
    def _lens(self) -> DistortionModel:
        return DISTORTION_MODELS[self.distortion_model]
