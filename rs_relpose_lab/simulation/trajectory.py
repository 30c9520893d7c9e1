"""A camera's motion as splines: poses and their exact derivatives at any time.

World: z up. Position and the angles (yaw, pitch, roll) are quintic B-splines, so acceleration and
angular acceleration are continuous; where the control points are equal the camera is at rest,
where they advance evenly it moves at constant velocity.

    R_world_cam = Rz(yaw) Ry(pitch) Rx(roll) R_BODY_CAM

The body axes are x forward, y left, z up; the camera looks along x.
"""

from dataclasses import dataclass, field
import math

import numpy as np
from numpy.typing import ArrayLike
from scipy.interpolate import BSpline
from scipy.spatial.transform import Rotation

from rs_relpose_lab.simulation.rows import Motion
from rs_relpose_ros.errors import InputError
from rs_relpose_ros.geometry import Array

# Degree of the spline: accelerations have two continuous derivatives. With a smaller one the IMU
# and the rows of an image would see corners of the motion. [chosen: 4 to 7 would do]
DEGREE = 5

# Columns: camera x (right), y (down), z (forward) in the body's axes.
R_BODY_CAM = np.array([[0.0, 0.0, 1.0], [-1.0, 0.0, 0.0], [0.0, -1.0, 0.0]])


@dataclass(frozen=True, slots=True)
class Segment:
    """A stretch of one kind of motion, in seconds of the trajectory."""

    kind: str  # 'walk', 'constant' velocities, 'still' or 'rotate' about the camera centre
    start: float
    end: float


@dataclass(frozen=True, slots=True, eq=False)
class CameraStates:
    """Poses of the camera optical frame in the world at N times, and their derivatives."""

    position: Array  # (N, 3) world frame [m], [m/s], [m/s^2]
    R_world_cam: Array
    velocity: Array
    acceleration: Array
    angular_velocity: Array  # (N, 3) camera frame [rad/s], [rad/s^2]
    angular_acceleration: Array


@dataclass(frozen=True, slots=True, eq=False)
class Trajectory:
    """Motion of the camera over an interval; angles are yaw, pitch and roll."""

    positions: Array  # (K, 3) [m] of control points
    angles: Array  # (K, 3) [rad] likewise
    first_control: float  # [s]
    spacing: float  # [s]
    # Labels of the stretches; between them one kind passes into the next.
    segments: tuple[Segment, ...] = ()
    _spline: BSpline = field(init=False, repr=False)

    def __post_init__(self) -> None:
        count = len(self.positions)
        places = np.arange(count + DEGREE + 1) - (DEGREE + 1) / 2
        knots = self.first_control + self.spacing * places
        controls = np.hstack([self.positions, self.angles])
        object.__setattr__(self, '_spline', BSpline(knots, controls, DEGREE, extrapolate=False))

    @property
    def span(self) -> tuple[float, float]:
        """First and last time at which the motion is defined [s]."""
        knots = self._spline.t
        return float(knots[DEGREE]), float(knots[len(self.positions)])

    def poses(self, times: ArrayLike) -> tuple[Array, Array]:
        """Positions (N, 3) [m] and orientations ``R_world_cam`` (N, 3, 3) at `times` (N,) [s]."""
        values = self._evaluate(times, 0)
        return values[:, :3], _orientation(values[:, 3:])

    def states(self, times: ArrayLike) -> CameraStates:
        """Poses and derivatives at `times` (N,) [s]."""
        value, first, second = (self._evaluate(times, order) for order in range(3))
        rate, rate_change = _body_rates(value[:, 3:], first[:, 3:], second[:, 3:])
        return CameraStates(
            position=value[:, :3],
            R_world_cam=_orientation(value[:, 3:]),
            velocity=first[:, :3],
            acceleration=second[:, :3],
            angular_velocity=rate @ R_BODY_CAM,
            angular_acceleration=rate_change @ R_BODY_CAM,
        )

    def _evaluate(self, times: ArrayLike, order: int) -> Array:
        times = np.atleast_1d(np.asarray(times, dtype=np.float64))
        values: Array = self._spline(times, order)
        if np.isnan(values).any():
            first, last = self.span
            raise InputError(
                f'the trajectory is defined from {first:.3f} to {last:.3f} s, '
                f'requested from {times.min():.3f} to {times.max():.3f} s'
            )
        return values


def _orientation(angles: Array) -> Array:
    """``R_world_cam`` (N, 3, 3) of yaw, pitch, roll (N, 3)."""
    matrices: Array = Rotation.from_euler('ZYX', angles).as_matrix() @ R_BODY_CAM
    return matrices


def _body_rates(angles: Array, first: Array, second: Array) -> tuple[Array, Array]:
    """Angular velocity and acceleration (N, 3) in body axes from the angles' derivatives.

    ``w = (r' - y' sin p, p' cos r + y' sin r cos p, -p' sin r + y' cos r cos p)`` with yaw y,
    pitch p, roll r; the second result is its derivative.
    """
    _, pitch, roll = angles.T
    dy, dp, dr = first.T
    ddy, ddp, ddr = second.T
    sp = np.sin(pitch)
    cp = np.cos(pitch)
    sr = np.sin(roll)
    cr = np.cos(roll)
    rate_x = dr - dy * sp
    rate_y = dp * cr + dy * sr * cp
    rate_z = -dp * sr + dy * cr * cp
    # Derivatives of sin r cos p and, negated, of cos r cos p.
    sr_cp = cr * cp * dr - sr * sp * dp
    cr_cp = sr * cp * dr + cr * sp * dp
    change_x = ddr - ddy * sp - dy * cp * dp
    change_y = ddp * cr - dp * sr * dr + ddy * sr * cp + dy * sr_cp
    change_z = -ddp * sr - dp * cr * dr + ddy * cr * cp - dy * cr_cp
    rate = np.stack([rate_x, rate_y, rate_z], axis=1)
    change = np.stack([change_x, change_y, change_z], axis=1)
    return rate, change


# -- a trajectory on a fine grid: poses at many times, in a fraction of the spline's time ------


class FinePath:
    """Poses of a trajectory from `begin` to `end` [s], linear between steps of a millisecond."""

    step = 1e-3

    def __init__(self, trajectory: Trajectory, begin: float, end: float) -> None:
        self.begin = begin
        times = begin + self.step * np.arange(math.ceil((end - begin) / self.step) + 1)
        self.positions, self.rotations = trajectory.poses(times)
        turns = np.einsum('nji,njk->nik', self.rotations[:-1], self.rotations[1:])
        self.steps = Rotation.from_matrix(turns).as_rotvec()

    def motion_from(self, reference: float) -> Motion:
        """Motion of a frame, whose times count from the time of its reference row [s]."""

        def to_camera(points: Array, times: Array) -> Array:
            at = (reference + times - self.begin) / self.step
            last = len(self.steps) - 1
            k = np.clip(at.astype(int), 0, last)
            share = (at - k)[:, None]
            step = self.positions[k + 1] - self.positions[k]
            position = self.positions[k] + share * step
            rotated = np.einsum('nji,nj->ni', self.rotations[k], points - position)
            # Of 1e-3 rad: exact to 1e-6.
            return np.asarray(rotated - share * np.cross(self.steps[k], rotated))

        return to_camera
