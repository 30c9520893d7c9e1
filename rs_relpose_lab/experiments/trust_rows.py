"""Wrong configurations: the rows of `rs_relpose benchmark trust`, and the information about them.

A row changes the configuration (parameters, CameraInfo) or the messages (IMU, images), and names
the parameter that the consistency monitor must report.
"""

from collections.abc import Callable, Mapping
from dataclasses import dataclass, field, replace
from itertools import accumulate
import math
from typing import Any, NamedTuple, Self

import cv2
import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from rs_relpose_ros.geometry import Array
from rs_relpose_ros.geometry.camera import Intrinsics, RollingShutterCamera
from rs_relpose_ros.geometry.so3 import Vector
from rs_relpose_ros.imu.buffer import ImuSample

Gray = NDArray[np.uint8]

# Informative seconds of motion within which a gross error must be flagged. [chosen: a user waits]
GROSS = 5
# The same of an error that moves poses by little. [chosen: three times as long]
SMALL = 15
# Quantities of the laboratory's information, and their number of unknowns.
QUANTITIES: Mapping[str, int] = {
    'axes': 3,
    'time_offset': 1,
    'readout_time': 1,
    'gyro_bias': 3,
    'gyro_scale': 1,
    'focal_length': 1,
    'distortion': 1,
}


class Geometry(NamedTuple):
    """Map from the sensor's image to the published one: of pixels (N, 2), and of the image."""

    points: Callable[[Array, RollingShutterCamera], Array]
    image: Callable[[Gray, RollingShutterCamera], Gray]


# The image as the sensor has it.
AS_IT_IS = Geometry(lambda points, camera: points, lambda image, camera: image)


@dataclass(frozen=True, slots=True, eq=False)
class Configured:
    """Configuration and messages of a run."""

    values: Mapping[str, Any]  # parameters by name
    intrinsics: Intrinsics
    # An IMU sample as received.
    sample: Callable[[ImuSample], ImuSample] = field(default=lambda sample: sample)
    geometry: Geometry = AS_IT_IS  # of the images

    @property
    def R_cam_imu(self) -> Rotation:
        """The configured rotation."""
        return Rotation.from_quat(self.values['quat_cam_imu_xyzw'])

    def with_values(self, **changed: Any) -> Self:
        """With other parameters."""
        return replace(self, values={**self.values, **changed})


class Injected(NamedTuple):
    """An error of a quantity of `QUANTITIES`, as the laboratory's information uses it.

    `error` (its unknowns): rotation vector [rad] in the camera frame, [s], signed [s], [rad/s] in
    the camera frame, share, share, first coefficient.
    """

    quantity: str
    error: Array


# Both get the right configuration and may draw.
Change = Callable[[Configured, np.random.Generator], Configured]
Error = Callable[[Configured, np.random.Generator], Injected | None]


@dataclass(frozen=True, slots=True)
class Row:
    """A row of the matrix."""

    named: tuple[str, ...]  # the right parameters, any of them
    within: int  # informative seconds of motion
    wrong: Change  # the wrong configuration in place of the right one
    # Its error; None where rotation about two axes is the information.
    injected: Error = lambda right, rng: None


# -- errors of the configuration --------------------------------------------------------------


def _error(quantity: str, value: float) -> Error:
    return lambda right, rng: Injected(quantity, np.array([value]))


def _axes_rotated(rotation: Callable[[np.random.Generator], Rotation]) -> Change:
    """The IMU's own axes are rotated: ``R_wrong = R_cam_imu T``."""

    def wrong(right: Configured, rng: np.random.Generator) -> Configured:
        turned = right.R_cam_imu * rotation(rng)
        return right.with_values(quat_cam_imu_xyzw=tuple(turned.as_quat().tolist()))

    return wrong


def _random_vector(rng: np.random.Generator, length: float) -> Array:
    axis = rng.standard_normal(3)
    return np.asarray(length * axis / np.linalg.norm(axis))


def _three_degrees(rng: np.random.Generator) -> Rotation:
    return Rotation.from_rotvec(_random_vector(rng, math.radians(3.0)))


def _focal_length(factor: float) -> Change:

    def wrong(right: Configured, rng: np.random.Generator) -> Configured:
        known = right.intrinsics
        scaled = replace(known, fx=factor * known.fx, fy=factor * known.fy)
        return replace(right, intrinsics=scaled)

    return wrong


def _squeezed(factor: float) -> Change:
    """The columns of the images are `factor` times as many as those of the CameraInfo."""
    return lambda right, rng: replace(
        right, intrinsics=replace(right.intrinsics, fx=right.intrinsics.fx / factor)
    )


def _center(right: float, down: float) -> Change:
    """The configured principal point is off, as of images that were cropped."""

    def wrong(configured: Configured, rng: np.random.Generator) -> Configured:
        known = configured.intrinsics
        moved = replace(known, cx=known.cx + right, cy=known.cy + down)
        return replace(configured, intrinsics=moved)

    return wrong


def _readout(factor: float) -> tuple[Change, Error]:

    def wrong(right: Configured, rng: np.random.Generator) -> Configured:
        return right.with_values(readout_time=factor * right.values['readout_time'])

    def error(right: Configured, rng: np.random.Generator) -> Injected:
        off = (factor - 1.0) * right.values['readout_time']
        return Injected('readout_time', np.array([off]))

    return wrong, error


def _reversed(right: Configured, rng: np.random.Generator) -> Configured:
    other = {'down': 'up', 'up': 'down'}[right.values.get('readout_direction', 'down')]
    return right.with_values(readout_direction=other)


def _biased(right: Configured, rng: np.random.Generator) -> Configured:
    bias = np.array(right.values.get('gyro_bias', (0.0, 0.0, 0.0))) + _random_vector(rng, 0.05)
    return right.with_values(gyro_bias=tuple(float(v) for v in bias))


def _without_distortion(right: Configured, rng: np.random.Generator) -> Configured:
    return replace(
        right,
        intrinsics=replace(right.intrinsics, distortion=(0.0,) * len(right.intrinsics.distortion)),
    )


def _distortion_error(right: Configured, rng: np.random.Generator) -> Injected:
    # 0 for a pinhole.
    return Injected('distortion', np.array([*right.intrinsics.distortion[:1], 0.0][:1]))


# -- errors of the messages -------------------------------------------------------------------


def _received(sample: Callable[[ImuSample], ImuSample]) -> Change:
    return lambda right, rng: replace(right, sample=sample)


def _gyro_times(factor: float) -> Change:
    def scaled(rate: Vector | None) -> Vector | None:
        return None if rate is None else (factor * rate[0], factor * rate[1], factor * rate[2])

    return _received(
        lambda sample: replace(sample, angular_velocity=scaled(sample.angular_velocity))
    )


def _gyro_through(matrix: Array) -> Change:
    """The gyro gives `matrix` (3, 3) times the rates: scales of its axes, and angles between."""

    def changed(sample: ImuSample) -> ImuSample:
        if sample.angular_velocity is None:
            return sample
        x, y, z = matrix @ np.array(sample.angular_velocity)
        return replace(sample, angular_velocity=(float(x), float(y), float(z)))

    return _received(changed)


def _late_from(seconds: float, step: float, drift: float) -> Change:
    """From `seconds` after the first sample on, stamps are late by `step` [s], and by `drift`."""

    def wrong(right: Configured, rng: np.random.Generator) -> Configured:
        first_ns: list[int] = []

        def changed(sample: ImuSample) -> ImuSample:
            first_ns[:] = first_ns or [sample.stamp_ns]
            since = (sample.stamp_ns - first_ns[0]) * 1e-9 - seconds
            late = step + drift * since if since > 0.0 else 0.0
            return replace(sample, stamp_ns=sample.stamp_ns + round(1e9 * late))

        return replace(right, sample=changed)

    return wrong


def _coefficient(place: int, change: float) -> Change:
    """One coefficient of the configured distortion is off."""

    def wrong(right: Configured, rng: np.random.Generator) -> Configured:
        known = right.intrinsics.distortion
        changed = [*known, *(0.0,) * (place + 1 - len(known))]
        changed[place] += change
        return replace(right, intrinsics=replace(right.intrinsics, distortion=tuple(changed)))

    return wrong


def _accel(rotation: Rotation, sign: float) -> Change:
    """Accelerometer with rotated axes, or that measures the acceleration of free fall."""

    def changed(sample: ImuSample) -> ImuSample:
        if sample.linear_acceleration is None:
            return sample
        x, y, z = sign * rotation.apply(sample.linear_acceleration)
        return replace(sample, linear_acceleration=(float(x), float(y), float(z)))

    return _received(changed)


def _shown(geometry: Geometry) -> Change:
    return lambda right, rng: replace(right, geometry=geometry)


def _rectified(points: Array, camera: RollingShutterCamera) -> Array:
    rays = camera.unproject(points)
    normalized = rays[:, :2] / rays[:, 2:]
    return np.asarray(normalized * (camera.fx, camera.fy) + (camera.cx, camera.cy))


def _rectified_image(image: Gray, camera: RollingShutterCamera) -> Gray:
    u, v = np.meshgrid(np.arange(camera.width), np.arange(camera.height))
    x = (u.ravel() - camera.cx) / camera.fx
    y = (v.ravel() - camera.cy) / camera.fy
    rays = np.column_stack([x, y, np.ones(u.size)])
    sources = camera.project(rays).astype(np.float32)
    columns, rows = sources.T.reshape(2, camera.height, camera.width)
    rectified = cv2.remap(image, columns, rows, cv2.INTER_LINEAR)
    return np.asarray(rectified, dtype=np.uint8)


def _reversed_order(columns: bool, rows: bool) -> Geometry:
    """Columns and rows of the image in reverse order."""

    def points(pixels: Array, camera: RollingShutterCamera) -> Array:
        last = np.array([camera.width - 1.0, camera.height - 1.0])
        return np.where([columns, rows], last - pixels, pixels)

    return Geometry(
        points,
        lambda image, camera: np.ascontiguousarray(
            image[:: -1 if rows else 1, :: -1 if columns else 1]
        ),
    )


# The image without distortion, although the CameraInfo has one.
RECTIFIED = Geometry(_rectified, _rectified_image)
# The image of a camera that is mounted upside down, turned by the driver.
UPSIDE_DOWN = _reversed_order(columns=True, rows=True)
# Rows in reverse order.
FLIPPED = _reversed_order(columns=False, rows=True)
# Columns in reverse order.
MIRRORED = _reversed_order(columns=True, rows=False)

# Scales and angles of the axes of a cheap gyro.
_GYRO_MATRIX = np.array([[1.015, 0.004, 0.0], [0.004, 0.985, -0.004], [0.0, -0.004, 1.01]])
# IMU whose x and y axes are negated.
_HALF_ROTATION = Rotation.from_rotvec([0.0, 0.0, math.pi])
# IMU whose axes are exchanged: x, y, z are y, z, x.
_CYCLE = Rotation.from_matrix([[0.0, 0.0, 1.0], [1.0, 0.0, 0.0], [0.0, 1.0, 0.0]])

# Name of the row without an error. [derived: the report]
RIGHT = 'right'
ROWS: Mapping[str, Row] = {
    RIGHT: Row((), SMALL, lambda right, rng: right),
    'imu-xy-negated': Row(('axes',), GROSS, _axes_rotated(lambda rng: _HALF_ROTATION)),
    'imu-cycled': Row(('axes',), GROSS, _axes_rotated(lambda rng: _CYCLE)),
    'gyro-degrees': Row(('gyro_unit',), GROSS, _gyro_times(math.degrees(1.0))),
    'gyro-57th': Row(('gyro_unit',), GROSS, _gyro_times(1.0 / math.degrees(1.0))),
    'K-1.3': Row(('focal_length',), GROSS, _focal_length(1.3), _error('focal_length', 0.3)),
    'K-1.05': Row(('focal_length',), GROSS, _focal_length(1.05), _error('focal_length', 0.05)),
    'no-distortion': Row(('distortion',), GROSS, _without_distortion, _distortion_error),
    'rectified': Row(
        ('distortion', 'image_geometry'), GROSS, _shown(RECTIFIED), _distortion_error
    ),
    'upside-down': Row(('image_geometry',), GROSS, _shown(UPSIDE_DOWN)),
    'flipped': Row(('image_geometry',), GROSS, _shown(FLIPPED)),
    'imu-late-30ms': Row(
        ('time_offset',),
        GROSS,
        _received(lambda sample: replace(sample, stamp_ns=sample.stamp_ns + 30_000_000)),
        _error('time_offset', 0.03),
    ),
    'readout-2': Row(('readout_time',), GROSS, *_readout(2.0)),
    'readout-0.5': Row(('readout_time',), GROSS, *_readout(0.5)),
    'readout-0': Row(('readout_time',), GROSS, *_readout(0.0)),
    'accel-cycled': Row(('accel_axes',), SMALL, _accel(_CYCLE, 1.0)),
    'accel-opposite': Row(('accel_axes',), SMALL, _accel(Rotation.identity(), -1.0)),
    'axes-3deg': Row(
        ('axes',),
        SMALL,
        _axes_rotated(_three_degrees),
        lambda right, rng: Injected(
            'axes', right.R_cam_imu.apply(_three_degrees(rng).as_rotvec())
        ),
    ),
    'offset-10ms': Row(
        ('time_offset',),
        SMALL,
        lambda right, rng: right.with_values(time_offset=right.values['time_offset'] + 0.01),
        _error('time_offset', 0.01),
    ),
    'readout-1.2': Row(('readout_time',), SMALL, *_readout(1.2)),
    'readout-0.8': Row(('readout_time',), SMALL, *_readout(0.8)),
    'bias-0.05': Row(
        ('gyro_bias',),
        SMALL,
        _biased,
        lambda right, rng: Injected('gyro_bias', right.R_cam_imu.apply(_random_vector(rng, 0.05))),
    ),
    'gyro-0.95': Row(('gyro_scale',), SMALL, _gyro_times(0.95), _error('gyro_scale', 0.05)),
    'K-0.97': Row(('focal_length',), SMALL, _focal_length(0.97), _error('focal_length', 0.03)),
    'gyro-matrix': Row(('gyro_scale', 'gyro_skew', 'axes'), SMALL, _gyro_through(_GYRO_MATRIX)),
    'k1+0.05': Row(('distortion',), SMALL, _coefficient(0, 0.05)),
    'k2+0.15': Row(('distortion',), SMALL, _coefficient(1, 0.15)),
    'k3+0.3': Row(('distortion',), SMALL, _coefficient(4, 0.3)),
    'offset-step-40ms': Row(('offset_step', 'time_offset'), SMALL, _late_from(4.0, 0.04, 0.0)),
    'offset-drift-0.2%': Row(
        ('offset_drift', 'offset_step', 'time_offset'), SMALL, _late_from(0.0, 0.0, 2e-3)
    ),
    'accel-0.8': Row(('accel_scale',), SMALL, _accel(Rotation.identity(), 0.8)),
    'squeezed-0.9': Row(('aspect',), SMALL, _squeezed(0.9)),
    'center-36-left': Row(('principal_point',), SMALL, _center(36.0, 0.0)),
    'center-20-top': Row(('principal_point',), SMALL, _center(0.0, 20.0)),
    'mirrored': Row(('image_geometry',), SMALL, _shown(MIRRORED)),
    'direction-sideways': Row(
        ('readout_direction',),
        SMALL,
        lambda right, rng: right.with_values(readout_direction='right'),
    ),
    # Reading up instead of down is an error of twice the readout time.
    'direction-reversed': Row(
        ('readout_direction',),
        SMALL,
        _reversed,
        lambda right, rng: Injected(
            'readout_time', np.array([2.0 * right.values['readout_time']])
        ),
    ),
}


# -- information of a motion about the errors -------------------------------------------------
#
# For each pair of a run with the right configuration: unknowns x (rotation, direction of
# translation, both velocities), calibration c (`QUANTITIES`, the offset at the middle row),
# residuals of the matches and priors of velocity and of the rotation by the gyro. At the truth, by
# finite differences:
#
#     S = J_c^T W J_c - J_c^T W J_x (J_x^T W J_x)^-1 J_x^T W J_c        summed over a second
#
# Nothing of `rs_relpose_ros.estimator` or `rs_relpose_ros.health` is used.

# End of each quantity in the vector of all unknowns. [derived: their sizes]
_ENDS = dict(zip(QUANTITIES, accumulate(QUANTITIES.values()), strict=True))
# Places of each quantity in it. [derived: the ends]
PLACES: Mapping[str, slice] = {
    name: slice(end - QUANTITIES[name], end) for name, end in _ENDS.items()
}
_UNKNOWNS = 11  # x: rotation, direction of translation, velocities
# Number of all these unknowns. [derived: their sizes]
_FREE = sum(QUANTITIES.values())
# Of the finite differences, in the units of `Injected` and of x.
_STEP = 1e-5
# Prior of each quantity before any motion, 1 sigma.
_BEFORE = np.repeat([0.5, 0.1, 0.05, 0.1, 0.2, 0.3, 0.3], list(QUANTITIES.values()))
# Velocities differ from t / interval by so many baselines per second, 1 sigma.
_VELOCITY_SIGMA = 1.0
# Least noise of a match [px]: no model of a camera is better. [chosen: 0.02 to 0.1 would do]
_LEAST_PIXEL = 0.05
# Least noise of a rotation by the gyro [rad], as of a match. [chosen: 1e-4 to 1e-3 would do]
_LEAST_ROTATION = 3e-4
# An injected error must be so many times its sigma.
INFORMATIVE = 5.0
# Share of that information that an informative second must have itself.
_LEAST_PART = 0.01
# Matches of a pair that are used, at most.
_MOST_MATCHES = 150


class TruePair(NamedTuple):
    """A pair with its true pose: ``X1 = R X2 + t`` of the middle rows, |t| = 1."""

    pixels1: Array  # (N, 2) of the inliers, on the sensor
    pixels2: Array
    R: Array
    t: Array
    interval: float
    rates1: Array  # (N, 3) mean true rate [rad/s] from the middle row to each match's row
    rates2: Array
    rate1: Array  # (3,) at the middle row; all rates are in the camera frame
    rate2: Array
    sigma: float  # of a match [px]
    gyro_noise_density: float


def pair_information(pair: TruePair, camera: RollingShutterCamera) -> tuple[Array, Array]:
    """Information (11, 11) of a pair about the quantities; outer product (3, 3) of its rotation.

    The latter in sigmas.
    """
    unknowns = _UNKNOWNS + _FREE
    at_truth_and_steps = _STEP * np.eye(unknowns + 1, unknowns, -1)
    residuals = _Residuals(pair, camera)(at_truth_and_steps)
    jacobian = (residuals[1:] - residuals[0]).T / _STEP
    by_x = jacobian[:, :_UNKNOWNS]
    by_c = jacobian[:, _UNKNOWNS:]
    H = by_x.T @ by_x
    mixed = by_x.T @ by_c
    # By the images alone, without the last three residuals, which are the gyro's.
    by_images = by_x[:-3].T @ by_x[:-3]
    covariance = np.linalg.inv(by_images)
    information = np.linalg.inv(covariance[:3, :3])
    rotation = Rotation.from_matrix(pair.R).as_rotvec()
    angle = max(float(np.linalg.norm(rotation)), 1e-9)
    length = math.sqrt(float(rotation @ information @ rotation)) / angle
    reduced = by_c.T @ by_c - mixed.T @ np.linalg.solve(H, mixed)
    return reduced, length**2 * np.outer(rotation, rotation)


class _Residuals:
    """Residuals, each by its sigma, of matches, velocities and gyro around the truth.

    They are evaluated at K sets of unknowns at once: arrays of matches are (K, N, ...).
    """

    def __init__(self, pair: TruePair, camera: RollingShutterCamera) -> None:
        chosen = slice(None, None, -(-len(pair.pixels1) // _MOST_MATCHES))
        self._pair = pair._replace(
            pixels1=pair.pixels1[chosen],
            pixels2=pair.pixels2[chosen],
            rates1=pair.rates1[chosen],
            rates2=pair.rates2[chosen],
        )
        # Each match represents those that were left out.
        self._sigma = max(pair.sigma, _LEAST_PIXEL) * math.sqrt(
            len(self._pair.pixels1) / len(pair.pixels1)
        )
        self._camera = camera
        self._tangent = np.linalg.svd(pair.t[None])[2][1:]
        self._rotation_sigma = math.hypot(
            _LEAST_ROTATION, pair.gyro_noise_density * math.sqrt(pair.interval)
        )
        self._slopes = self._gradient_lengths()

    def __call__(self, unknowns: Array) -> Array:
        """Residuals (K, M) of unknowns (K, 22)."""
        x = unknowns[:, :_UNKNOWNS]
        c = unknowns[:, _UNKNOWNS:]
        pair = self._pair
        count = len(unknowns)
        t = pair.t + x[:, 3:5] @ self._tangent
        d = x[:, 5:].reshape(count, 2, 3)
        R = Rotation.from_rotvec(x[:, :3]).as_matrix() @ pair.R
        matches = self._matches(R, t, d + pair.t / pair.interval, c)
        # Prior of the velocities: that of the baseline, which goes with t.
        slower = d - (t - pair.t)[:, None] / pair.interval
        # Prior of the rotation: Log(R R_gyro(c)^T), whose change by c is linear.
        theta = x[:, :3] - self._gyro_change(c)
        return np.hstack(
            [
                matches / (self._sigma * self._slopes),
                slower.reshape(count, 6) / _VELOCITY_SIGMA,
                theta / self._rotation_sigma,
            ]
        )

    def _gyro_change(self, c: Array) -> Array:
        """Change (K, 3) of the gyro's rotation by c (K, 11): axes, offset, bias, scale.

        ``Exp(a) R Exp(-a) = Exp(a - R a) R``; later by o: ``Exp(R w_2 o - w_1 o) R``.
        """
        pair = self._pair
        axes = c[:, PLACES['axes']]
        mean = 0.5 * pair.interval * (np.eye(3) + pair.R)
        return np.asarray(
            axes
            - axes @ pair.R.T
            + c[:, PLACES['time_offset']] * (pair.R @ pair.rate2 - pair.rate1)
            - c[:, PLACES['gyro_bias']] @ mean.T
            + c[:, PLACES['gyro_scale']] * Rotation.from_matrix(pair.R).as_rotvec()
        )

    def _matches(self, R: Array, t: Array, velocities: Array, c: Array) -> Array:
        """``(p_2 - p_1) . (g_1 x g_2)`` (K, N) of rays and positions at their rows."""
        pair = self._pair
        place1, ray1 = self._row(pair.pixels1, pair.rates1, velocities[:, 0], c)
        place2, ray2 = self._row(pair.pixels2, pair.rates2, velocities[:, 1], c)
        ray2_in_1 = ray2 @ np.swapaxes(R, 1, 2)
        normal = np.cross(ray1, ray2_in_1)
        baseline = t[:, None] + place2 - place1
        return np.asarray((baseline * normal).sum(axis=2))

    def _row(self, pixels: Array, rates: Array, velocity: Array, c: Array) -> tuple[Array, Array]:
        """Displacement since the middle row (K, N, 3), and rays (K, N, 3) derotated to it."""
        camera = self._camera
        away = pixels[:, 1] - 0.5 * (camera.height - 1)
        readout = camera.line_delay * camera.height + c[:, PLACES['readout_time']]
        times = (readout * away / camera.height)[..., None]
        # The gyro's rate with c; its change within the offset is in the rotation between the
        # frames.
        axes = c[:, None, PLACES['axes']]
        bias = c[:, None, PLACES['gyro_bias']]
        scale = c[:, None, PLACES['gyro_scale']]
        turned_rates = rates + np.cross(axes, rates)
        angles = times * ((1.0 + scale) * turned_rates - bias)
        rays = self._rays(pixels, c)
        once = np.cross(angles, rays)
        return times * velocity[:, None], rays + once + 0.5 * np.cross(angles, once)

    def _rays(self, pixels: Array, c: Array) -> Array:
        """Rays (K, N, 3) at z = 1 with another focal length and first coefficient.

        ``x_d = x (1 + k1 r^2)``: a change dk1 moves the undistorted point by ``-dk1 r^2 x``.
        """
        rays = self._camera.unproject(pixels)
        points = rays[:, :2] / rays[:, 2:]
        squares = (points**2).sum(axis=1, keepdims=True)
        focal, distortion = (c[:, None, PLACES[name]] for name in ('focal_length', 'distortion'))
        points = points * (1.0 - focal - distortion * squares)
        return np.concatenate([points, np.ones((*points.shape[:2], 1))], axis=2)

    def _gradient_lengths(self) -> Array:
        """Length (N,) of each residual's gradient by its four pixel coordinates."""
        pair = self._pair
        squares = np.zeros(len(pair.pixels1))
        middle = self._at_truth()
        for name in ('pixels1', 'pixels2'):
            for shift in 0.01 * np.eye(2):
                self._pair = pair._replace(**{name: getattr(pair, name) + shift})
                squares += ((self._at_truth() - middle) / 0.01) ** 2
        self._pair = pair
        return np.sqrt(squares)

    def _at_truth(self) -> Array:
        pair = self._pair
        velocities = np.stack([pair.t, pair.t]) / pair.interval
        right = np.zeros((1, _FREE))
        residuals = self._matches(pair.R[None], pair.t[None], velocities[None], right)
        return np.asarray(residuals[0])


@dataclass(frozen=True, slots=True, eq=False)
class InformativeMotion:
    """Information of each second of a recording: sums (F, 11, 11), (F, 3, 3) of its pairs."""

    quantities: Array
    rotations: Array

    def seconds(self, injected: Injected | None) -> NDArray[np.bool_]:
        """Which seconds (F,) are informative for an error; None: for permuted axes.

        The information up to a second's end is sufficient for the error, and the second adds to
        it: a resting camera has none, with any history.
        """
        if injected is None:
            # A quarter turn, squared in sigmas, by rotation about one axis and about a second.
            quarter = (math.pi / 2) ** 2
            each = quarter * np.linalg.eigvalsh(self.rotations)[:, 2]
            so_far = quarter * np.linalg.eigvalsh(np.cumsum(self.rotations, axis=0))[:, 1]
        else:
            total = np.cumsum(self.quantities, axis=0)
            each = np.array([_squared_error(injected, one) for one in self.quantities])
            so_far = np.array([_squared_error(injected, one) for one in total])
        return np.asarray((so_far >= INFORMATIVE**2) & (each >= _LEAST_PART * INFORMATIVE**2))


def _squared_error(injected: Injected, quantities: Array) -> float:
    """An error squared in sigmas by the information, the other quantities eliminated."""
    place = np.arange(_FREE)[PLACES[injected.quantity]]
    rest = np.setdiff1d(np.arange(_FREE), place)
    # The quantity itself has no prior.
    others = quantities[np.ix_(rest, rest)] + np.diag(1.0 / _BEFORE[rest] ** 2)
    mixed = quantities[np.ix_(rest, place)]
    alone = quantities[np.ix_(place, place)] - mixed.T @ np.linalg.solve(others, mixed)
    return float(injected.error @ alone @ injected.error)
