"""The rolling-shutter camera: pixel <-> unit ray, derivatives by the lens, and the time of a row.

In the camera frame x points right, y down, z forward. The row time is the time of the **raw,
distorted** row: the point is undistorted, its row is not. A row is a row of the sensor: where the
images are turned by 90 degrees, the rows of the sensor are the columns of the image.
"""

from dataclasses import dataclass, field, replace
from functools import lru_cache
import math

import numpy as np
from numpy.typing import ArrayLike

from rs_relpose_ros.errors import InputError
from rs_relpose_ros.geometry import Array, validate
from rs_relpose_ros.geometry.lens import (
    ByLens,
    CompiledLens,
    DISTORTION_MODELS,
    DistortionModel,
    first_order_by_lens,
    points_by_lens,
    project_points,
    project_rotating,
    rays_by_lens,
    rays_with_jacobian,
    undistort_points,
)

# Names of the row from which row times count. [derived: definition of the parameter stamp_row]
REFERENCE_ROWS = ('first', 'middle', 'last')
# Names of the direction in which rows are read. The first two are for rows of the image, the last
# two for columns of the image. [derived: definition of the parameter]
READOUT_DIRECTIONS = ('down', 'up', 'right', 'left')
# Directions in which row 0 is read first and last, by the pixel coordinate (u, v) that is the row.
# [derived: row 0 is the left column or the top row]
_ALONG = (('right', 'left'), ('down', 'up'))

# Largest width and height of an image [px]: squares of pixels cannot overflow. [chosen: any value
# beyond the largest sensors, 1e5 px, would do]
_LARGEST_IMAGE = 1_000_000
# Largest focal length and distance of the principal point [px]: squares of rays cannot overflow.
# [chosen: any value in 1e7..1e100 would do]
_FARTHEST_PIXEL = 1e9


# Number of lenses that are kept in the form that kernels take. Fewer would make some again that a
# calibration tries in turn, more would take memory. [chosen: 10 to 1000 would do]
_LENSES_KEPT = 64


@lru_cache(maxsize=_LENSES_KEPT)
def _compiled_lens(model: str, coefficients: tuple[float, ...]) -> CompiledLens:
    """The lens of a model; a frame asks for it several times, and nobody may change its arrays."""
    return DISTORTION_MODELS[model].lens(coefficients)


def readout_direction(axis: int, seconds: float) -> str:
    """Direction of a readout along a pixel coordinate, 0 or 1, that lasts `seconds`, signed."""
    forward, backward = _ALONG[axis]
    return forward if seconds >= 0.0 else backward


@dataclass(frozen=True, slots=True, kw_only=True)
class RollingShutterCamera:
    """A calibrated camera whose rows are read one after the other.

    Parameters
    ----------
    width, height : int
        Size of the image [px].
    fx, fy, cx, cy : float
        Pinhole intrinsics [px]; pixel centres at integer coordinates, as in OpenCV.
    distortion_model : {'plumb_bob', 'rational_polynomial', 'equidistant'}
        A name of `geometry.lens.DISTORTION_MODELS`, as in sensor_msgs/CameraInfo (REP-104);
        ``'equidistant'`` is OpenCV's fisheye model.
    distortion : sequence of float
        Coefficients in OpenCV's order; empty for no distortion.
    readout_time : float
        `row_count` times the line delay [s]; 0 is a global shutter. It has no default.
    readout_direction : {'down', 'up', 'right', 'left'}
        Whether row 0 is read first ('down') or last ('up'). 'right' and 'left' are for images that
        are turned by 90 degrees: the columns of the image are the rows of the sensor, and the left
        column, which is row 0, is read first ('right') or last ('left').
    reference_row : {'first', 'middle', 'last'}
        The row from which row times count (row 0, (n-1)/2 or n-1 of n rows). Motion refers to it,
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
            validate.number(name, getattr(self, name), 1, _LARGEST_IMAGE, 'px', whole=True)
        for name, least in (
            ('fx', 1.0 / _FARTHEST_PIXEL),
            ('fy', 1.0 / _FARTHEST_PIXEL),
            ('cx', -_FARTHEST_PIXEL),
            ('cy', -_FARTHEST_PIXEL),
        ):
            validate.number(name, getattr(self, name), least, _FARTHEST_PIXEL, 'px')
        if not 0.0 <= self.readout_time < 1.0:
            raise InputError(
                'readout_time must be in [0, 1) s (number of rows times line delay; 0 for a '
                f'global shutter), got {self.readout_time!r}'
            )
        validate.choice('readout_direction', self.readout_direction, READOUT_DIRECTIONS)
        validate.choice('reference_row', self.reference_row, REFERENCE_ROWS)
        validate.choice('distortion_model', self.distortion_model, DISTORTION_MODELS)
        coefficients = tuple(validate.array('distortion', self.distortion, ('N',)).tolist())
        legal = self._lens.coefficient_counts
        if coefficients and len(coefficients) not in legal:
            raise InputError(
                f'distortion of model {self.distortion_model!r} must have one of {legal} '
                f'coefficients, got {len(coefficients)}'
            )
        object.__setattr__(self, 'distortion', coefficients)

    @property
    def readout_axis(self) -> int:
        """Pixel coordinate that is the row of the sensor: 1 (v), or 0 (u) if images are turned."""
        return 1 if self.readout_direction in _ALONG[1] else 0

    @property
    def reads_forward(self) -> bool:
        """Whether row 0 is read first."""
        return self.readout_direction in ('down', 'right')

    @property
    def row_count(self) -> int:
        """Number of rows that are read one after the other: height, or width if turned."""
        return self.height if self.readout_axis == 1 else self.width

    @property
    def line_delay(self) -> float:
        """Signed time from one row to the next one [s]; negative where row 0 is read last."""
        delay = self.readout_time / self.row_count
        return delay if self.reads_forward else -delay

    @property
    def signed_readout_time(self) -> float:
        """Readout time [s]; negative where row 0 is read last."""
        return self.line_delay * self.row_count

    def with_signed_readout_time(self, seconds: float) -> 'RollingShutterCamera':
        """The camera with another readout time, along the same axis of the image."""
        direction = readout_direction(self.readout_axis, seconds)
        return replace(self, readout_time=abs(seconds), readout_direction=direction)

    @property
    def middle_row(self) -> float:
        """Middle of the rows: (n - 1) / 2 of n rows."""
        return (self.row_count - 1) / 2

    @property
    def reference_row_index(self) -> float:
        """Row from which row times count: 0, (n - 1) / 2 or n - 1 of n rows."""
        last = self.row_count - 1.0
        return {'first': 0.0, 'middle': self.middle_row, 'last': last}[self.reference_row]

    def rows_of(self, pixels: Array) -> Array:
        """Rows (...) of the sensor that have pixels (..., 2)."""
        return np.asarray(pixels[..., self.readout_axis])

    def row_times(self, rows: ArrayLike) -> Array:
        """Row times ``tau = (row - reference row) * line_delay`` [s] of raw, distorted rows."""
        rows = np.asarray(rows, dtype=np.float64)
        return (rows - self.reference_row_index) * self.line_delay

    def pixel_times(self, pixels: Array) -> Array:
        """Row times (...) [s] of raw, distorted pixels (..., 2)."""
        return self.row_times(self.rows_of(pixels))

    def readout_shares(self, pixels: Array) -> Array:
        """Rows (...) of pixels (..., 2) after the middle row, as shares of all rows."""
        return (self.rows_of(pixels) - self.middle_row) / self.row_count

    @property
    def row_time_span(self) -> tuple[float, float]:
        """Smallest and largest row time of the image [s]."""
        ends = self.row_times([0.0, self.row_count - 1.0])
        return float(ends.min()), float(ends.max())

    @property
    def camera_matrix(self) -> Array:
        """The 3x3 intrinsic matrix."""
        return np.array([[self.fx, 0.0, self.cx], [0.0, self.fy, self.cy], [0.0, 0.0, 1.0]])

    @property
    def is_undistorted(self) -> bool:
        """Whether the model is a plain pinhole (``'equidistant'`` never is)."""
        return self._lens.is_pinhole_at_zero and not any(self.distortion)

    def project(self, points: ArrayLike) -> Array:
        """Raw pixels (N, 2) of points (N, 3) in the camera frame; NaN behind the camera.

        All points are projected at one time: the motion during the readout is not modelled.
        """
        points = np.ascontiguousarray(points, dtype=np.float64).reshape(-1, 3)
        normalized = project_points(points, self._compiled)
        return normalized * (self.fx, self.fy) + (self.cx, self.cy)

    def project_rotating(self, rays: Array, rows: Array, rotations: Array) -> Array:
        """Raw pixels (N, 2) of rays (N, 3) while the camera rotates; NaN where there is none.

        `rows` (N,) are first guesses. `rotations` (K, 3, 3) rotate the rays into the frame of the
        camera at K rows, which are spread evenly from the first to the last row.
        """
        return project_rotating(
            rays,
            rows,
            rotations,
            self.readout_axis,
            self.row_count,
            (self.fx, self.fy, self.cx, self.cy),
            self._compiled,
        )

    def unproject(self, points: ArrayLike) -> Array:
        """Unit rays (N, 3) in the camera frame of raw pixels (N, 2).

        A pixel outside the region where the distortion can be inverted gives a row of NaN.
        """
        return self.unproject_with_jacobian(points)[0]

    def unproject_with_jacobian(self, points: ArrayLike) -> tuple[Array, Array]:
        """Unit rays (N, 3) and their derivatives (N, 3, 2) by the raw pixel coordinates u, v."""
        normalized, by_distorted = self._undistorted(self._distorted(points))
        return rays_with_jacobian(normalized, by_distorted / (self.fx, self.fy))

    def unproject_by_lens(self, points: ArrayLike) -> tuple[Array, Array, Array]:
        """Unit rays (N, 3), with their derivatives by the pixel and by the lens.

        These are (N, 3, 2), and (N, 3, 9) in the order of `geometry.lens.LENS_ENTRIES`.
        """
        distorted = self._distorted(points)
        normalized, by_distorted = self._undistorted(distorted)
        focal = (self.fx, self.fy)
        of_points = first_order_by_lens(distorted, normalized, by_distorted, focal, self._compiled)
        rays, by_pixel = rays_with_jacobian(normalized, of_points[0])
        return rays, by_pixel, rays_with_jacobian(normalized, of_points[1])[1]

    def points_by_lens(self, points: ArrayLike) -> ByLens:
        """Normalised points ``(x, y)`` at z = 1 of raw pixels (N, 2), with all derivatives.

        Derivatives by the pixel, by the lens (`geometry.lens.LENS_ENTRIES`), and by both. A pixel
        outside the region where the distortion can be inverted gives NaN.
        """
        distorted = self._distorted(points)
        undistorted = self._undistorted(distorted)
        return points_by_lens(distorted, *undistorted, (self.fx, self.fy), self._compiled)

    def rays_by_lens(self, points: ArrayLike) -> ByLens:
        """Unit rays of raw pixels (N, 2), with the derivatives of `points_by_lens`."""
        return rays_by_lens(self.points_by_lens(points))

    def moved_lens(self, deviation: Array) -> 'RollingShutterCamera':
        """Camera whose lens deviates by `deviation` (9,), in the order of `LENS_ENTRIES`."""
        focal_log, aspect = deviation[:2].tolist()
        cx, cy = deviation[-2:].tolist()
        return replace(
            self,
            fx=self.fx * math.exp(focal_log),
            fy=self.fy * math.exp(focal_log + aspect),
            cx=self.cx + cx,
            cy=self.cy + cy,
            distortion=self._lens.moved(self.distortion, deviation[2:-2]),
        )

    @property
    def radial_coefficients(self) -> Array:
        """Coefficients (3,) k1, k2, k3 of the distortion."""
        return self._compiled.radial[:3].copy()

    @property
    def tangential_coefficients(self) -> Array:
        """Coefficients (2,) p1, p2 of the distortion."""
        return self._compiled.sideways[:2].copy()

    def _distorted(self, points: ArrayLike) -> Array:
        """Normalised points (N, 2) of raw pixels (N, 2), before the distortion is removed."""
        pixels = np.ascontiguousarray(points, dtype=np.float64).reshape(-1, 2)
        return (pixels - (self.cx, self.cy)) / (self.fx, self.fy)

    def _undistorted(self, distorted: Array) -> tuple[Array, Array]:
        """Undistorted points (N, 2), and their derivatives (N, 2, 2) by the distorted points."""
        if self.is_undistorted:
            unchanged = np.empty((len(distorted), 2, 2))
            unchanged[:] = np.eye(2)
            return distorted, unchanged
        return undistort_points(distorted, self._lens.first_guess(distorted), self._compiled)

    @property
    def _lens(self) -> DistortionModel:
        return DISTORTION_MODELS[self.distortion_model]

    @property
    def _compiled(self) -> CompiledLens:
        return _compiled_lens(self.distortion_model, self.distortion)


@dataclass(frozen=True, slots=True, kw_only=True)
class Intrinsics:
    """Intrinsics of the full sensor, and which part of it is published at which binning.

    A published pixel ``u`` covers `binning_x` sensor columns, and pixel centres lie at integer
    coordinates, so ``u_sensor = x_offset + binning_x (u + 1/2) - 1/2``; the same holds for ``v``.
    The readout time is not included, because no message has it.

    Parameters
    ----------
    width, height, fx, fy, cx, cy, distortion_model, distortion
        Size and lens of the full sensor, as in `RollingShutterCamera`.
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
        self.global_shutter_camera()  # checks intrinsics and distortion
        for name in ('image_width', 'image_height', 'binning_x', 'binning_y'):
            validate.number(name, getattr(self, name), 1)
        for axis, offset, binning, size, sensor in (
            ('x', self.x_offset, self.binning_x, self.image_width, self.width),
            ('y', self.y_offset, self.binning_y, self.image_height, self.height),
        ):
            if offset < 0 or offset + binning * size > sensor:
                raise InputError(
                    f'region of interest leaves the sensor in {axis}: offset {offset} and {size} '
                    f'pixels of {binning} must lie within {sensor}'
                )

    def global_shutter_camera(self) -> RollingShutterCamera:
        """Camera model of the full sensor with a readout time of 0."""
        return RollingShutterCamera(
            width=self.width,
            height=self.height,
            fx=self.fx,
            fy=self.fy,
            cx=self.cx,
            cy=self.cy,
            distortion_model=self.distortion_model,
            distortion=self.distortion,
            readout_time=0.0,
        )

    def to_sensor(self, points: ArrayLike) -> Array:
        """Sensor pixels (N, 2) of pixels (N, 2) of the published image."""
        corner = (self.x_offset, self.y_offset)
        binning = (self.binning_x, self.binning_y)
        return (np.asarray(points, dtype=np.float64) + 0.5) * binning + corner - 0.5

    def to_image(self, points: ArrayLike) -> Array:
        """Pixels (N, 2) of the published image of sensor pixels (N, 2)."""
        corner = (self.x_offset, self.y_offset)
        binning = (self.binning_x, self.binning_y)
        return (np.asarray(points, dtype=np.float64) + 0.5 - corner) / binning - 0.5
