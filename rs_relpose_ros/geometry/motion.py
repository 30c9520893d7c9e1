"""What the IMU says of one frame: how the camera turned while its rows were read, and gravity."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy.spatial.transform import Rotation

from rs_relpose_ros.compiled import kernel
from rs_relpose_ros.errors import InputError
from rs_relpose_ros.geometry.so3 import exp_so3, log_so3, multiply
from rs_relpose_ros.geometry.vectors import checked_vector, copy_matrix, copy_vector

Array = NDArray[np.float64]


# Far beyond any gyro [rad/s]; a larger number is no rate, and its products may overflow.
_LARGEST_RATE = 1e4
# Far beyond any frame [s]; products of longer times may overflow.
_LONGEST = 1e6
# Of row times against the gyro samples that must enclose them [s].
_TOLERANCE = 1e-6


@dataclass(frozen=True, slots=True, eq=False)
class FrameMotion:
    """Rotation during the read-out of one frame, and the direction of gravity.

    The camera at row time tau is turned by ``Exp(w tau)`` against the reference row (constant
    rate), or by the exact integral of the gyro when made by `from_gyro`.

    Parameters
    ----------
    angular_velocity : (3,) array_like
        Rate [rad/s] in the camera's own frame.
    gravity : (3,) array_like, optional
        Direction of free fall (**down**), any length, in the camera frame at the reference row.
    knot_times : (K,) array_like
        Row times [s] of the integrated gyro, increasing; empty for a constant rate.
    knot_rotations : (K, 3, 3) array_like
        Orientation at each knot, in the camera frame of the reference row.
    """

    angular_velocity: Array
    gravity: Array | None = None
    knot_times: Array | None = None
    knot_rotations: Array | None = None

    def __post_init__(self) -> None:
        for name in ('knot_times', 'knot_rotations'):
            if getattr(self, name) is not None:
                object.__setattr__(self, name, np.ascontiguousarray(getattr(self, name)))
        object.__setattr__(self, 'angular_velocity',
                           checked_vector('angular_velocity', self.angular_velocity))
        if not np.abs(self.angular_velocity).max() <= _LARGEST_RATE:
            raise InputError(f'angular_velocity must be within {_LARGEST_RATE:g} rad/s, '
                             f'got {self.angular_velocity.tolist()}')
        if self.gravity is not None:
            gravity = checked_vector('gravity', self.gravity)
            if not 1e-6 < np.abs(gravity).max() < 1e6:
                raise InputError(
                    'gravity must have a direction (or be None where it is not known) and a '
                    f'length between 1e-6 and 1e6, got {gravity.tolist()}')
            object.__setattr__(self, 'gravity', gravity)

    @classmethod
    def from_gyro(cls, times: ArrayLike, angular_velocities: ArrayLike,
                  gravity: ArrayLike | None = None) -> FrameMotion:
        """Exact integral of gyro samples over the rows.

        Parameters
        ----------
        times : (K,) array_like
            Instants [s] of the samples relative to the reference row's, strictly increasing; the
            first and the last enclose 0 and every row time that will be asked for.
        angular_velocities : (K, 3) array_like
            Rates [rad/s] in the camera frame, bias removed.
        gravity : (3,) array_like, optional
            As in the class.
        """
        times = np.ascontiguousarray(times, dtype=np.float64)
        rates = np.ascontiguousarray(angular_velocities, dtype=np.float64)
        if times.ndim != 1 or rates.shape != (len(times), 3) or len(times) < 2:
            raise InputError('times and angular_velocities must have shapes (K,) and (K, 3) with '
                             f'K >= 2, got {times.shape} and {rates.shape}')
        if not (np.isfinite(times).all() and np.isfinite(rates).all()):
            raise InputError('times and angular_velocities must be finite')
        if np.abs(times).max() > _LONGEST:
            raise InputError(f'times must be within {_LONGEST:g} s of the reference row, got up '
                             f'to {np.abs(times).max():g} s')
        steps = np.diff(times)
        if not (steps > 0.0).all():
            raise InputError('times must be strictly increasing')
        if not times[0] <= 0.0 <= times[-1]:
            raise InputError('times must enclose 0, the reference row, '
                             f'got [{times[0]:.6f}, {times[-1]:.6f}] s')
        # Rate linear between samples, to fourth order as in `imu.integration`.
        mean_turns = 0.5 * (rates[1:] + rates[:-1]) * steps[:, None]
        turns = Rotation.from_rotvec(
            mean_turns + np.cross(rates[:-1], rates[1:]) * (steps**2 / 12.0)[:, None]).as_matrix()
        rotations = np.empty((len(times), 3, 3))
        rotations[0] = np.eye(3)
        for k, turn in enumerate(turns):
            rotations[k + 1] = rotations[k] @ turn
        span = times[-1] - times[0]
        # As a mean over the rows: of one sample, the noise would be several times larger.
        mean_rate = mean_turns.sum(axis=0) / span
        unaligned = cls(mean_rate, None, times, rotations)
        at_reference = unaligned.rotations([0.0])[0]
        return cls(mean_rate, None if gravity is None else np.asarray(gravity, dtype=np.float64),
                   times, at_reference.T @ rotations)

    def rotations(self, row_times: ArrayLike) -> Array:
        """Orientation (N, 3, 3) at row times (N,) [s], in the frame of the reference row.

        Raises
        ------
        InputError
            A row time lies outside the gyro samples: nothing is extrapolated.
        """
        tau = np.ascontiguousarray(row_times, dtype=np.float64)
        if self.knot_times is None or self.knot_rotations is None:
            return rotations_at_rate(self.angular_velocity, tau)
        times = self.knot_times
        rotations, covered = rotations_between(
            times, self.knot_rotations, tau, np.searchsorted(times, tau, side='right'))
        if not covered:
            raise InputError(
                f'row times [{tau.min():.6f}, {tau.max():.6f}] s are not covered by the gyro '
                f'samples, [{times[0]:.6f}, {times[-1]:.6f}] s')
        return rotations

    def derotate(self, rays: ArrayLike, row_times: ArrayLike) -> Array:
        """Rays (N, 3) measured at `row_times` (N,) [s], turned into the reference row's frame."""
        rays = np.asarray(rays, dtype=np.float64)
        return np.einsum('nij,nj->ni', self.rotations(row_times), rays)

    def shifted(self, delay: float) -> FrameMotion:
        """The same motion with the reference row `delay` seconds later."""
        turn = self.rotations([delay])[0]
        moved = self.gravity if self.gravity is None else turn.T @ self.gravity
        if self.knot_times is None or self.knot_rotations is None:
            return replace(self, gravity=moved)
        return replace(self, gravity=moved, knot_times=self.knot_times - delay,
                       knot_rotations=turn.T @ self.knot_rotations)


@kernel
def rotations_at_rate(rate: Array, times: Array) -> Array:
    """``Exp(w t)`` (N, 3, 3) at the times (N,) [s]."""
    out = np.empty((len(times), 3, 3))
    for i in range(len(times)):
        copy_matrix(exp_so3(times[i] * rate), out[i])
    return out


@kernel
def rotations_between(knot_times: Array, knot_rotations: Array, times: Array,
                      after: NDArray[np.int64]) -> tuple[Array, bool]:
    """Orientations (N, 3, 3) at times (N,) within the knots, at a constant rate between two.

    `after` (N,) tells the first knot after each time. Also whether the knots enclose all
    times; beyond them nothing turns on.
    """
    out = np.empty((len(times), 3, 3))
    steps = np.empty((len(knot_times) - 1, 3))
    for k in range(len(steps)):
        copy_vector(log_so3(knot_rotations[k].T @ knot_rotations[k + 1]), steps[k])
    covered = True
    for i in range(len(times)):
        # Written so that NaN is not covered.
        covered &= (times[i] >= knot_times[0] - _TOLERANCE
                    and times[i] <= knot_times[-1] + _TOLERANCE)
        time = min(max(times[i], knot_times[0]), knot_times[-1])
        k = min(max(after[i] - 1, 0), len(steps) - 1)
        fraction = (time - knot_times[k]) / (knot_times[k + 1] - knot_times[k])
        turn = exp_so3(fraction * steps[k])
        multiply(knot_rotations[k], turn, out[i])
    return out, covered
