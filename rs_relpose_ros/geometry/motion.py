"""Motion by the IMU: rotation and gravity of one frame, acceleration between two frames."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike

from rs_relpose_ros.errors import InputError
from rs_relpose_ros.geometry import Array, validate
from rs_relpose_ros.geometry.gyro import GyroPath
from rs_relpose_ros.geometry.so3 import copy_matrix, exp_so3
from rs_relpose_ros.jit import kernel

# Largest rate of an argument [rad/s]: products of larger numbers may overflow.
# [chosen: far beyond any sensor]
_LARGEST_RATE = 1e4
# Longest time of an argument [s]. [chosen: ten days, a mistaken unit]
_LONGEST = 1e6
# Largest displacement, velocity and acceleration of an argument [m], [m/s], [m/s^2].
# [chosen: far beyond any carrier]
_LARGEST = 1e4
# Largest lever arm [m]; more is a value in centimetres. [chosen: no camera is so far from its IMU]
_LARGEST_LEVER_ARM = 5.0
# Row times may lie outside of the gyro samples by this [s]. [derived: rounding of nanoseconds]
_TOLERANCE = 1e-6
# Time about the reference [s] for which a constant rate is a path: that of a global shutter, whose
# rows have one time. [chosen: beyond any readout; 0.1 to 10 s would do]
_AROUND = 1.0


@dataclass(frozen=True, slots=True, eq=False)
class FrameMotion:
    """Rotation during the readout of one frame, and the direction of gravity.

    Orientation of the camera at row time tau relative to the reference row: ``Exp(w tau)``
    (constant rate), or the exact integral of the gyro (`from_gyro`).

    Parameters
    ----------
    angular_velocity : (3,) array_like
        Rate [rad/s] in the camera's own frame.
    gravity : (3,) array_like, optional
        Direction of free fall (**down**), any length, in the camera frame at the reference row.
    path : GyroPath, optional
        The integrated gyro over the row times, relative to the reference row; None for a constant
        rate.
    """

    angular_velocity: Array
    gravity: Array | None = None
    path: GyroPath | None = None

    def __post_init__(self) -> None:
        object.__setattr__(
            self,
            'angular_velocity',
            validate.array(
                'angular_velocity',
                self.angular_velocity,
                (3,),
                largest=_LARGEST_RATE,
                unit='rad/s',
            ),
        )
        if self.gravity is not None:
            gravity = validate.array(
                'gravity',
                self.gravity,
                (3,),
                largest=1e6,
            )
            if not np.abs(gravity).max() > 1e-6:
                raise InputError(
                    'gravity must have a length > 1e-6 (None if it is not known), '
                    f'got {gravity.tolist()}'
                )
            object.__setattr__(self, 'gravity', gravity)

    @classmethod
    def from_gyro(
        cls, times: ArrayLike, angular_velocities: ArrayLike, gravity: ArrayLike | None = None
    ) -> FrameMotion:
        """Exact integral of gyro samples over the rows.

        Parameters
        ----------
        times : (K,) array_like
            Times [s] of the samples from the time of the reference row, strictly increasing; the
            first and the last enclose 0 and every row time that is used.
        angular_velocities : (K, 3) array_like
            Rates [rad/s] in the camera frame, bias removed.
        gravity : (3,) array_like, optional
            As in the class.
        """
        times = validate.array(
            'times',
            times,
            ('K',),
            largest=_LONGEST,
            unit='s',
        )
        rates = validate.array('angular_velocities', angular_velocities, (len(times), 3))
        validate.number('number of times', len(times), 2)
        validate.increasing('times', times)
        if not times[0] <= 0.0 <= times[-1]:
            raise InputError(
                'times must enclose 0, the time of the reference row, '
                f'got [{times[0]:.6f}, {times[-1]:.6f}] s'
            )
        # The mean over the rows: one sample has several times its noise.
        mean_rate = (
            0.5 * (times[1:] - times[:-1]) @ (rates[1:] + rates[:-1]) / (times[-1] - times[0])
        )
        path = GyroPath.integrated(times, rates).about(0.0)
        return cls(mean_rate, None if gravity is None else np.asarray(gravity), path)

    def rotations(self, row_times: ArrayLike) -> Array:
        """Orientation (N, 3, 3) at row times (N,) [s], in the frame of the reference row.

        Raises
        ------
        InputError
            A row time lies outside of the gyro samples: there is no extrapolation.
        """
        tau = np.ascontiguousarray(row_times, dtype=np.float64)
        if self.path is None:
            return rotations_at_rate(self.angular_velocity, tau)
        first, last = self.path.times[[0, -1]]
        # Written so that NaN is not covered.
        if not np.all((tau >= first - _TOLERANCE) & (tau <= last + _TOLERANCE)):
            raise InputError(
                f'row times [{tau.min():.6f}, {tau.max():.6f}] s are not covered by the gyro '
                f'samples, [{first:.6f}, {last:.6f}] s'
            )
        return self.path.at(tau)

    def derotate(self, rays: ArrayLike, row_times: ArrayLike) -> Array:
        """Rays (N, 3) of row times (N,) [s], rotated into the frame of the reference row."""
        rays = np.asarray(rays, dtype=np.float64)
        return np.einsum('nij,nj->ni', self.rotations(row_times), rays)

    def turned(self, turn: Array) -> FrameMotion:
        """The same motion of rows whose axes are rotated by `turn` (3,) [rad] at the reference.

        It is the rotation of what the rows show against the camera at the time of the reference.
        """
        if not turn.any():
            return self
        path = self.path
        if path is None:
            path = GyroPath.constant(self.angular_velocity, -_AROUND, _AROUND)
        rotations = np.ascontiguousarray(exp_so3(turn) @ path.rotations)
        return validate.replaced(self, path=path._replace(rotations=rotations))

    def shifted(self, delay: float) -> FrameMotion:
        """The same motion with the reference row `delay` seconds later."""
        rotation = self.rotations([delay])[0]
        moved = self.gravity if self.gravity is None else rotation.T @ self.gravity
        path = self.path if self.path is None else self.path.about(delay)
        return validate.replaced(self, gravity=moved, path=path)


@kernel
def rotations_at_rate(rate: Array, times: Array) -> Array:
    """``Exp(w t)`` (N, 3, 3) at the times (N,) [s]."""
    out = np.empty((len(times), 3, 3))
    for i in range(len(times)):
        copy_matrix(exp_so3(times[i] * rate), out[i])
    return out


@dataclass(frozen=True, slots=True, eq=False)
class InertialMotion:
    """Preintegrated acceleration of the IMU between the reference rows of two frames.

    All vectors are in the axes of camera 1 at its reference row. With the IMU's velocity v_1 at
    that time and gravity subtracted from the specific force::

        p_2 - p_1 = v_1 T + alpha        v_2 = v_1 + beta

    Parameters
    ----------
    alpha : (3,) array_like
        Acceleration, integrated twice [m].
    beta : (3,) array_like
        Acceleration, integrated once [m/s].
    duration : float
        T, from the first reference row to the second [s].
    covariance : (6, 6) array_like
        Of the errors of (alpha, beta): noise, bias, gravity and lever arm.
    lever_arm : (3,) array_like
        Position of the IMU in the camera frame [m].
    acceleration1, acceleration2 : (3,) array_like, optional
        The IMU's acceleration during the readout of each frame [m/s^2]; the mean ``beta / T`` by
        default.

    Raises
    ------
    InputError
        A value of the wrong shape, not finite, or out of bounds.
    """

    alpha: Array
    beta: Array
    duration: float
    covariance: Array
    lever_arm: ArrayLike = (0.0, 0.0, 0.0)
    acceleration1: Array | None = None
    acceleration2: Array | None = None

    def __post_init__(self) -> None:
        validate.number(
            'duration',
            self.duration,
            1e-6,
            1e6,
            's',
        )
        for name, unit, largest in (
            ('alpha', 'm', _LARGEST),
            ('beta', 'm/s', _LARGEST),
            ('lever_arm', 'm', _LARGEST_LEVER_ARM),
            ('acceleration1', 'm/s^2', _LARGEST),
            ('acceleration2', 'm/s^2', _LARGEST),
        ):
            value = getattr(self, name)
            if value is None:
                value = self.beta / self.duration
            object.__setattr__(
                self,
                name,
                validate.array(
                    name,
                    value,
                    (3,),
                    largest=largest,
                    unit=unit,
                ),
            )
        object.__setattr__(
            self,
            'covariance',
            validate.covariance(
                'covariance',
                self.covariance,
                6,
                largest=_LARGEST**2,
            ),
        )

    def shifted(self, delay: float, turn: Array) -> InertialMotion:
        """The same motion between rows `delay` [s] later; camera 1 rotates by `turn` meanwhile.

        With constant accelerations a_i during the readouts, ``v_i' = v_i + D a_i`` and
        ``p_i' = p_i + D v_i + D^2 a_i / 2``.
        """
        a1 = np.asarray(self.acceleration1)
        a2 = np.asarray(self.acceleration2)
        change = a2 - a1
        alpha = (
            self.alpha + delay * self.beta + 0.5 * delay**2 * change - delay * self.duration * a1
        )
        beta = self.beta + delay * change
        # An error of beta changes alpha, too.
        jacobian = np.zeros((6, 6))
        jacobian[:3, :3] = jacobian[3:, 3:] = turn.T
        jacobian[:3, 3:] = delay * turn.T
        covariance = jacobian @ self.covariance @ jacobian.T
        return validate.replaced(
            self,
            alpha=turn.T @ alpha,
            beta=turn.T @ beta,
            covariance=0.5 * (covariance + covariance.T),
            acceleration1=turn.T @ a1,
            acceleration2=turn.T @ a2,
        )
