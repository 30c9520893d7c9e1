"""The rolling-shutter camera: pixel <-> unit ray, distortion models, and the time of a row.

Camera frame: x right, y down, z forward. The row time is that of the **raw, distorted** row: the
point is undistorted, its row is not.
"""

from collections.abc import Callable
from dataclasses import dataclass, field
import math

import numba
import numpy as np
from numpy.typing import ArrayLike

from rs_relpose_ros.errors import InputError
from rs_relpose_ros.geometry import Array, validate
from rs_relpose_ros.geometry.so3 import dot
from rs_relpose_ros.jit import kernel, KernelInterface

REFERENCE_ROWS = ('first', 'middle', 'last')
READOUT_DIRECTIONS = ('down', 'up')

# [px], far beyond any camera; squares of pixels and rays cannot overflow.
_LARGEST_IMAGE = 1_000_000
_FARTHEST_PIXEL = 1e9


# -- Distortion models by name --------------------------------------------------------------------
#
# To add one: write its kernel and its row of `DISTORTION_MODELS`; camera, calibration and checks
# use these only.


@kernel
def distort_equidistant(x: float, y: float, k: Array, out: Array) -> None:
    """OpenCV's fisheye model: the angle off the axis becomes the radius; `k` (4,)."""
    r2 = x * x + y * y
    r = math.sqrt(r2)
    theta = math.atan(r)
    t2 = theta * theta
    angle = theta * (1.0 + t2 * (k[0] + t2 * (k[1] + t2 * (k[2] + t2 * k[3]))))
    if r < 1e-8:
        scale, slope = 1.0, 0.0
    else:
        scale = angle / r
        by_theta = 1.0 + t2 * (
            3.0 * k[0] + t2 * (5.0 * k[1] + t2 * (7.0 * k[2] + t2 * 9.0 * k[3]))
        )
        # (d scale / d r) / r
        slope = (by_theta / (1.0 + r2) - scale) / r2
    out[0], out[1] = scale * x, scale * y
    out[2], out[3] = scale + slope * x * x, slope * x * y
    out[4], out[5] = slope * x * y, scale + slope * y * y


def ideal_fisheye(points: Array) -> Array:
    """Undistorted points of the ideal fisheye: from the distorted ones, Newton overshoots."""
    angles = np.maximum(np.linalg.norm(points, axis=1, keepdims=True), 1e-8)
    return np.asarray(points * np.tan(np.minimum(angles, 1.5)) / angles)


@kernel
def distort_rational(x: float, y: float, k: Array, out: Array) -> None:
    """OpenCV's rational model with thin-prism terms; plumb_bob is a part of it.

    `k` (12,): k1 k2 p1 p2 k3 k4 k5 k6 s1 s2 s3 s4.
    """
    r2 = x * x + y * y
    above = 1.0 + r2 * (k[0] + r2 * (k[1] + r2 * k[4]))
    below = 1.0 + r2 * (k[5] + r2 * (k[6] + r2 * k[7]))
    radial = above / below
    # d radial / d(r^2)
    slope = (
        (k[0] + r2 * (2.0 * k[1] + r2 * 3.0 * k[4]))
        - radial * (k[5] + r2 * (2.0 * k[6] + r2 * 3.0 * k[7]))
    ) / below
    p1, p2 = k[2], k[3]
    out[0] = x * radial + 2.0 * p1 * x * y + p2 * (r2 + 2.0 * x * x) + r2 * (k[8] + r2 * k[9])
    out[1] = y * radial + p1 * (r2 + 2.0 * y * y) + 2.0 * p2 * x * y + r2 * (k[10] + r2 * k[11])
    prism_x, prism_y = k[8] + 2.0 * r2 * k[9], k[10] + 2.0 * r2 * k[11]
    cross = 2.0 * slope * x * y + 2.0 * p1 * x + 2.0 * p2 * y
    out[2] = radial + 2.0 * slope * x * x + 2.0 * p1 * y + 6.0 * p2 * x + 2.0 * x * prism_x
    out[3] = cross + 2.0 * y * prism_x
    out[4] = cross + 2.0 * x * prism_y
    out[5] = radial + 2.0 * slope * y * y + 6.0 * p1 * y + 2.0 * p2 * x + 2.0 * y * prism_y


# In compiled code: distort_at(address, x, y, k, out).
_DISTORT = KernelInterface(numba.void, 0.0, 0.0, np.empty(1), np.empty(1))
distort_at = _DISTORT.call


@dataclass(frozen=True, slots=True)
class DistortionModel:
    """Map of a lens on points of the plane z = 1."""

    name: str  # as in sensor_msgs/CameraInfo (REP-104)
    coefficient_counts: tuple[int, ...]  # legal ones, in the order of CameraInfo and OpenCV
    size: int  # number of coefficients of `distort`; those not given are zero
    # Kernel distort(x, y, k, out): `out` (6,) = x', y', and d(x', y')/d(x, y) row by row.
    distort: Callable[[float, float, Array, Array], None]
    # Of the undistorted points (N, 2), from the distorted ones.
    first_guess: Callable[[Array], Array] = np.copy
    is_pinhole_at_zero: bool = True  # whether coefficients of zero distort nothing

    def compiled(self, coefficients: tuple[float, ...]) -> tuple[int, Array]:
        """Address of the compiled kernel `distort`, and its coefficients (size,)."""
        k = np.zeros(self.size)
        k[: len(coefficients)] = coefficients
        return _DISTORT.address(self.distort), k


DISTORTION_MODELS = {
    model.name: model
    for model in (
        DistortionModel('plumb_bob', (0, 4, 5, 8), 12, distort_rational),
        DistortionModel('rational_polynomial', (8, 12), 12, distort_rational),
        DistortionModel(
            'equidistant', (4,), 4, distort_equidistant, ideal_fisheye, is_pinhole_at_zero=False
        ),
    )
}


# ``cv2.undistortPoints`` stops after five fixed-point steps, with pixels of error on strong
# distortion, and the calls that iterate longer differ between OpenCV 4 and 5.


@kernel
def project_points(points: Array, distort: int, k: Array) -> Array:
    """Distorted normalised points (N, 2) of points (N, 3); NaN behind the camera.

    `distort` is the address of the model's kernel, `k` its coefficients.
    """
    nearest = 1e-9  # least depth in front of the camera
    out = np.empty((points.shape[0], 2))
    values = np.empty(6)
    for i in range(points.shape[0]):
        x, y, z = points[i, 0], points[i, 1], points[i, 2]
        if z > nearest:
            distort_at(distort, x / z, y / z, k, values)
            out[i, 0], out[i, 1] = values[0], values[1]
        else:
            out[i, 0], out[i, 1] = math.nan, math.nan
    return out


@kernel
def undistort_points(
    points: Array, first_guesses: Array, distort: int, k: Array
) -> tuple[Array, Array]:
    """Undistorted normalised points (N, 2) and their derivatives (N, 2, 2) by the distorted ones.

    NaN if there is no inverse. A root beyond the turning point of the polynomial is a mirror image
    and not an inverse. `distort` and `k` as in `project_points`.
    """
    n = points.shape[0]
    out, inverse = np.empty((n, 2)), np.empty((n, 2, 2))
    v = np.empty(6)
    for i in range(n):
        x, y, converged = first_guesses[i, 0], first_guesses[i, 1], False
        for _ in range(50):
            distort_at(distort, x, y, k, v)
            e0, e1 = points[i, 0] - v[0], points[i, 1] - v[1]
            determinant = v[2] * v[5] - v[3] * v[4]
            dx = (v[5] * e0 - v[3] * e1) / determinant
            dy = (v[2] * e1 - v[4] * e0) / determinant
            length = math.sqrt(dx * dx + dy * dy)
            # A step may not leave the region in which the model is monotonic.
            limit = 0.5 * (1.0 + math.sqrt(x * x + y * y))
            if length > limit:
                dx, dy = dx * limit / length, dy * limit / length
            x, y = x + dx, y + dy
            # The error after a step is about its square: 1e-9 px at any focal length.
            if length < 1e-8 * (1.0 + limit):
                converged = True
                break
        distort_at(distort, x, y, k, v)
        determinant = v[2] * v[5] - v[3] * v[4]
        if not (converged and determinant > 0.0):
            x, y, determinant = math.nan, math.nan, math.nan
        out[i, 0], out[i, 1] = x, y
        inverse[i, 0, 0], inverse[i, 0, 1] = v[5] / determinant, -v[3] / determinant
        inverse[i, 1, 0], inverse[i, 1, 1] = -v[4] / determinant, v[2] / determinant
    return out, inverse


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
        A name of `DISTORTION_MODELS`, as in sensor_msgs/CameraInfo (REP-104); ``'equidistant'`` is
        OpenCV's fisheye model.
    distortion : sequence of float
        Coefficients in OpenCV's order; empty for none.
    readout_time : float
        `height` times the line delay [s]; 0 is a global shutter. It has no default.
    readout_direction : {'down', 'up'}
        Whether row 0 is read first ('down') or last ('up').
    reference_row : {'first', 'middle', 'last'}
        The row from which row times count (rows 0, (height-1)/2, height-1): motion refers to it,
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

        At one time: the motion during the readout is not modelled.
        """
        points = np.ascontiguousarray(points, dtype=np.float64).reshape(-1, 3)
        normalized = project_points(points, *self._lens.compiled(self.distortion))
        return normalized * (self.fx, self.fy) + (self.cx, self.cy)

    def project_rotating(self, rays: Array, rows: Array, rotations: Array) -> Array:
        """Raw pixels (N, 2) of rays (N, 3) while the camera rotates; NaN where there is none.

        `rows` (N,): first guesses. `rotations` (K, 3, 3): from the frame of the rays to that of
        the camera, at K rows spread evenly from the first to the last one.
        """
        return project_rotating(
            rays,
            rows,
            rotations,
            self.height,
            (self.fx, self.fy, self.cx, self.cy),
            *self._lens.compiled(self.distortion),
        )

    def unproject(self, points: ArrayLike) -> Array:
        """Unit rays (N, 3) in the camera frame of raw pixels (N, 2).

        A pixel outside the region where the distortion can be inverted gives a row of NaN.
        """
        return self.unproject_with_jacobian(points)[0]

    def unproject_with_jacobian(self, points: ArrayLike) -> tuple[Array, Array]:
        """Unit rays (N, 3) and their derivatives (N, 3, 2) by the raw pixel coordinates u, v."""
        points = np.ascontiguousarray(points, dtype=np.float64).reshape(-1, 2)
        normalized = (points - (self.cx, self.cy)) / (self.fx, self.fy)
        by_pixel = np.empty((len(points), 2, 2))
        if self.is_undistorted:
            by_pixel[:] = np.diag([1.0 / self.fx, 1.0 / self.fy])
        else:
            normalized, inverse = undistort_points(
                normalized,
                self._lens.first_guess(normalized),
                *self._lens.compiled(self.distortion),
            )
            np.divide(inverse, (self.fx, self.fy), out=by_pixel)
        return rays_with_jacobian(normalized, by_pixel)

    @property
    def _lens(self) -> DistortionModel:
        return DISTORTION_MODELS[self.distortion_model]


@dataclass(frozen=True, slots=True, kw_only=True)
class Intrinsics:
    """Intrinsics of the full sensor, and which part of it is published at which binning.

    A published pixel ``u`` covers `binning_x` sensor columns, and pixel centres lie at integer
    coordinates, so ``u_sensor = x_offset + binning_x (u + 1/2) - 1/2``; the same for ``v``.
    No message has the readout time, so it is not included.

    Parameters
    ----------
    width, height, fx, fy, cx, cy, distortion_model, distortion
        Of the full sensor, as in `RollingShutterCamera`.
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
        points = np.asarray(points, dtype=np.float64)
        return (
            (points + 0.5) * (self.binning_x, self.binning_y)
            + (self.x_offset, self.y_offset)
            - 0.5
        )

    def to_image(self, points: ArrayLike) -> Array:
        """Pixels (N, 2) of the published image of sensor pixels (N, 2)."""
        points = np.asarray(points, dtype=np.float64)
        return (points + 0.5 - (self.x_offset, self.y_offset)) / (
            self.binning_x,
            self.binning_y,
        ) - 0.5


@kernel
def rays_with_jacobian(normalized: Array, by_pixel: Array) -> tuple[Array, Array]:
    """Unit rays (N, 3) through points (N, 2) at z = 1, and their derivatives (N, 3, 2).

    `by_pixel` (N, 2, 2): derivatives of the points by the two variables of the result's last axis.
    """
    n = normalized.shape[0]
    rays, jacobian = np.empty((n, 3)), np.empty((n, 3, 2))
    for i in range(n):
        x, y = normalized[i, 0], normalized[i, 1]
        scale = 1.0 / math.sqrt(1.0 + x * x + y * y)
        rays[i, 0], rays[i, 1], rays[i, 2] = x * scale, y * scale, scale
        for k in range(2):
            # m = n / |n| with n = (x, y, 1): dm = (dn - m (m . dn)) / |n|.
            dx, dy = by_pixel[i, 0, k], by_pixel[i, 1, k]
            along = rays[i, 0] * dx + rays[i, 1] * dy
            jacobian[i, 0, k] = (dx - rays[i, 0] * along) * scale
            jacobian[i, 1, k] = (dy - rays[i, 1] * along) * scale
            jacobian[i, 2, k] = -rays[i, 2] * along * scale
    return rays, jacobian


@kernel
def project_rotating(
    rays: Array,
    rows: Array,
    rotations: Array,
    height: int,
    intrinsics: tuple[float, float, float, float],
    distort: int,
    k: Array,
) -> Array:
    """`RollingShutterCamera.project_rotating` with `intrinsics` fx, fy, cx, cy.

    Row v images a ray if the orientation at the time of row v projects the ray into row v: a root
    of ``projected_row(v) - v``, found by the secant method. Rotations are linear between their
    rows, and beyond. `distort` is the address of the distortion's kernel, `k` its coefficients.
    """
    settled = 0.01  # largest distance of the assumed row from the projected one [px]
    most_rounds = 12
    nearest = 1e-9  # least depth in front of the camera
    fx, fy, cx, cy = intrinsics
    out, rotated, values = np.empty((len(rays), 2)), np.empty(3), np.empty(6)
    per_row = (len(rotations) - 1) / max(height - 1.0, 1.0)
    for n in range(len(rays)):
        row, before, ahead, slope = rows[n], rows[n], 0.0, 0.0
        u = v = math.nan
        for step in range(most_rounds):
            place = row * per_row
            i = int(min(max(place, 0.0), len(rotations) - 2.0))
            share = place - i
            for j in range(3):
                first, second = dot(rotations[i, j], rays[n]), dot(rotations[i + 1, j], rays[n])
                rotated[j] = first + share * (second - first)
            if not rotated[2] > nearest:
                u = v = math.nan
                break
            x, y = rotated[0] / rotated[2], rotated[1] / rotated[2]
            distort_at(distort, x, y, k, values)
            u, v = cx + fx * values[0], cy + fy * values[1]
            if abs(v - row) < settled:
                break
            if step == most_rounds - 1:
                u = v = math.nan
            # Derivative of the projected row by the assumed row.
            if step > 0 and row != before:
                slope = (v - ahead) / (row - before)
            if not abs(slope) < 0.9:
                slope = 0.0
            before, ahead = row, v
            row += (v - row) / (1.0 - slope)
        out[n, 0], out[n, 1] = u, v
    return out
