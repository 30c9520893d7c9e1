"""What an accelerometer says of how the velocity changed from one frame to the next."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import ArrayLike, NDArray

from rs_relpose_ros.errors import InputError
from rs_relpose_ros.geometry.vectors import checked_vector

Array = NDArray[np.float64]

# Far beyond any motion [m], [m/s], [m/s^2]: larger numbers are no metres, or no preintegration.
_LARGEST = 1e4
# No camera is further from its IMU [m]: centimetres told as metres.
LARGEST_LEVER_ARM = 5.0


@dataclass(frozen=True, slots=True, eq=False)
class InertialMotion:
    """Preintegrated acceleration of the IMU between the reference rows of two frames.

    All vectors are in the axes of camera 1 at its reference row. With the IMU's velocity v_1 at
    that instant and gravity taken out of the specific force::

        p_2 - p_1 = v_1 T + alpha        v_2 = v_1 + beta

    Parameters
    ----------
    alpha : (3,) array_like
        Acceleration, integrated twice [m].
    beta : (3,) array_like
        Acceleration, integrated once [m/s].
    duration : float
        T, from the one reference row to the other [s].
    covariance : (6, 6) array_like
        Of the errors of (alpha, beta): noise, bias, gravity and lever arm.
    lever_arm : (3,) array_like
        Position of the IMU in the camera frame [m].
    acceleration1, acceleration2 : (3,) array_like, optional
        The IMU's acceleration during the read-out of each frame [m/s^2]; its mean where it is not
        given.

    Raises
    ------
    InputError
        (a ValueError) A value of the wrong shape, not finite, or out of all bounds.
    """

    alpha: Array
    beta: Array
    duration: float
    covariance: Array
    lever_arm: ArrayLike = (0.0, 0.0, 0.0)
    acceleration1: Array | None = None
    acceleration2: Array | None = None

    def __post_init__(self) -> None:
        if not 1e-6 <= self.duration <= 1e6:
            raise InputError('duration must be a positive number of seconds in [1e-6, 1e6], got '
                             f'{self.duration}')
        for name, unit, largest in (
                ('alpha', 'm', _LARGEST), ('beta', 'm/s', _LARGEST),
                ('lever_arm', 'm', LARGEST_LEVER_ARM), ('acceleration1', 'm/s^2', _LARGEST),
                ('acceleration2', 'm/s^2', _LARGEST)):
            value = getattr(self, name)
            vector = (self.beta / self.duration if value is None
                      else checked_vector(name, value))
            if not np.abs(vector).max() <= largest:
                raise InputError(f'{name} must be within {largest:g} {unit}, '
                                 f'got {vector.tolist()}')
            object.__setattr__(self, name, vector)
        covariance = np.array(self.covariance, dtype=np.float64)
        if covariance.shape != (6, 6) or not np.abs(covariance).max() < _LARGEST**2 \
                or np.abs(covariance - covariance.T).max() > 1e-9 \
                or np.linalg.eigvalsh(covariance)[0] < -1e-9:
            raise InputError('covariance must be a (6, 6) covariance matrix of alpha [m] and beta '
                             f'[m/s], got {covariance.tolist()}')
        object.__setattr__(self, 'covariance', covariance)

    def shifted(self, delay: float, turn: Array) -> InertialMotion:
        """The same motion between rows that lie `delay` [s] later.

        Parameters
        ----------
        turn : (3, 3) ndarray
            How camera 1 turns meanwhile: ``E_1``.

        Notes
        -----
        With constant accelerations a_i during the read-outs, ``v_i' = v_i + D a_i`` and
        ``p_i' = p_i + D v_i + D^2 a_i / 2``.
        """
        a1, a2 = np.asarray(self.acceleration1), np.asarray(self.acceleration2)
        change = a2 - a1
        alpha = (self.alpha + delay * self.beta + 0.5 * delay**2 * change
                 - delay * self.duration * a1)
        beta = self.beta + delay * change
        # An error of beta moves alpha with it.
        jacobian = np.zeros((6, 6))
        jacobian[:3, :3] = jacobian[3:, 3:] = turn.T
        jacobian[:3, 3:] = delay * turn.T
        covariance = jacobian @ self.covariance @ jacobian.T
        return replace(self, alpha=turn.T @ alpha, beta=turn.T @ beta,
                       covariance=0.5 * (covariance + covariance.T),
                       acceleration1=turn.T @ a1, acceleration2=turn.T @ a2)
