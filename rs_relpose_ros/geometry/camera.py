"""The rolling-shutter camera: pixel <-> unit ray, derivatives by the lens, and the time of a row.

In the camera frame x points right, y down, z forward. The row time is the time of the **raw,
distorted** row: the point is undistorted, its row is not.
"""

from dataclasses import dataclass, field, replace
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
    points_by_lens,
    project_points,
    project_rotating,
    rays_by_lens,
    rays_with_jacobian,
    undistort_points,
)

# Names of the row from which row times count. [derived: definition of the parameter stamp_row]
REFERENCE_ROWS = ('first', 'middle', 'last')
# Names of the direction in which rows are read. [derived: definition of the parameter]
READOUT_DIRECTIONS = ('down', 'up')

# Largest width and height of an image [px]: squares of pixels cannot overflow. [chosen: any value
# beyond the largest sensors, 1e5 px, would do]
_LARGEST_IMAGE = 1_000_000
# Largest focal length and distance of the principal point [px]: squares of rays cannot overflow.
# [chosen: any value in 1e7..1e100 would do]
_FARTHEST_PIXEL = 1e9


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
        `height` times the line delay [s]; 0 is a global shutter. It has no default.
    readout_direction : {'down', 'up'}
        Whether row 0 is read first ('down') or last ('up').
    reference_row : {'first', 'middle', 'last'}
        The row from which row times count (row 0, (height-1)/2 or height-1). Motion refers to it,
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
                'readout_time must be in [0, 1) s (height times line delay; 0 for a global '
                f'shutter), got {self.readout_time!r}'
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
    def line_delay(self) -> float:
        """Signed time from one row to the row below it [s]; negative when read upwards."""
        delay = self.readout_time / self.height
        return delay if self.readout_direction == 'down' else -delay

    @property
    def reference_row_index(self) -> float:
        """Row from which row times count: 0, (height - 1) / 2 or height - 1."""
        return {'first': 0.0, 'middle': (self.height - 1) / 2, 'last': self.height - 1.0}[
            self.reference_row
        ]

    def row_times(self, rows: ArrayLike) -> Array:
        """Row times ``tau = (row - reference row) * line_delay`` [s] of raw, distorted rows."""
        rows = np.asarray(rows, dtype=np.float64)
        return (rows - self.reference_row_index) * self.line_delay

    @property
    def row_time_span(self) -> tuple[float, float]:
        """Smallest and largest row time of the image [s]."""
        ends = self.row_times([0.0, self.height - 1.0])
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
            self.height,
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
        """Camera whose lens deviates by `deviation` (7,), in the order of `LENS_ENTRIES`."""
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

    def _distorted(self, points: ArrayLike) -> Array:
        """Normalised points (N, 2) of raw pixels (N, 2), before the distortion is removed."""
        pixels = np.ascontiguousarray(points, dtype=np.float64).reshape(-1, 2)
        return (pixels - (self.cx, self.cy)) / (self.fx, self.fy)

    def _undistorted(self, distorted: Array) -> tuple[Array, Array]:
        """Undistorted points (N, 2), and their derivatives (N, 2, 2) by the distorted points."""
        if self.is_undistorted:
            return distorted, np.tile(np.eye(2), (len(distorted), 1, 1))
        return undistort_points(distorted, self._lens.first_guess(distorted), self._compiled)

    @property
    def _lens(self) -> DistortionModel:
        return DISTORTION_MODELS[self.distortion_model]

    @property
    def _compiled(self) -> CompiledLens:
        return self._lens.lens(self.distortion)


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
