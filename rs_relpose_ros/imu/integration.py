"""Rotation by the gyro between two instants, with its covariance."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray

from rs_relpose_ros.compiled import kernel
from rs_relpose_ros.config.imu import ImuConfig
from rs_relpose_ros.errors import InputError
from rs_relpose_ros.geometry.gyro import integrated_rotations, step_turn
from rs_relpose_ros.geometry.so3 import left_jacobian_so3, log_so3, multiply
from rs_relpose_ros.geometry.vectors import dot

Array = NDArray[np.float64]


@kernel
def _integrate(seconds: Array, rates: Array) -> tuple[Array, Array, Array]:
    """Rotation ``R_start^T R_end``, its derivative by a constant rate error, and noise growth.

    An error dw of the rate of step k turns the result by ``L_k dw dt`` on the left (in the start
    frame), where ``L_k = R_k J_l(phi_k)``:

        derivative = sum L_k dt        noise = sum L_k L_k^T dt
    """
    rotations = integrated_rotations(seconds, rates)
    derivative, noise, L = np.zeros((3, 3)), np.zeros((3, 3)), np.empty((3, 3))
    for k in range(len(seconds) - 1):
        dt = seconds[k + 1] - seconds[k]
        turn = step_turn(rates[k], rates[k + 1], dt)
        multiply(rotations[k], left_jacobian_so3(turn), L)
        for i in range(3):
            for j in range(3):
                derivative[i, j] += L[i, j] * dt
                noise[i, j] += dot(L[i], L[j]) * dt
    return rotations[-1], derivative, noise


def integrate_rotation(stamps_ns: NDArray[np.int64], rates: ArrayLike, config: ImuConfig,
                       bias_sigma: float | None = None) -> tuple[Array, Array]:
    """Rotation ``R_start^T R_end`` (3, 3) between the first and the last sample, its covariance.

    The covariance (3, 3) [rad^2] is that of dtheta in the start frame, ``R_true = Exp(dtheta) R``.
    The stamps (K,) strictly increase; the rates (K, 3) [rad/s], their bias removed, are linear
    between samples. `bias_sigma` [rad/s] per axis is told where it is not that of `config`.
    """
    rates = np.ascontiguousarray(rates, dtype=np.float64)
    if len(stamps_ns) < 1 or rates.shape != (len(stamps_ns), 3):
        raise InputError(f'rates must have shape ({len(stamps_ns)}, 3), got {rates.shape}')
    seconds = (stamps_ns - stamps_ns[0]) * 1e-9
    if not (np.diff(seconds) > 0.0).all():
        raise InputError('stamps_ns must be strictly increasing')
    rotation, derivative, noise = _integrate(seconds, rates)
    if bias_sigma is None:
        bias_sigma = config.gyro_bias_sigma
    covariance = config.gyro_noise_density**2 * noise + bias_sigma**2 * derivative @ derivative.T
    return rotation, covariance


@dataclass(frozen=True, slots=True, eq=False)
class TurnSensitivity:
    """What moves a rotation integrated from the gyro, as turns on its left."""

    noise: Array   # (3, 3) covariance of its white noise alone [rad^2]
    by_rate: Array   # (3, 3) by a constant error of the rates [s]
    by_scale: Array   # (3,) by a relative change of all rates [rad]


def turn_sensitivity(stamps_ns: NDArray[np.int64], rates: Array,
                     config: ImuConfig) -> TurnSensitivity:
    """Of ``R_start^T R_end``; arguments as in `integrate_rotation`."""
    seconds, step = (stamps_ns - stamps_ns[0]) * 1e-9, 1e-4
    rotation, by_rate, noise = _integrate(seconds, np.ascontiguousarray(rates))
    scaled, _, _ = _integrate(seconds, (1.0 + step) * rates)
    return TurnSensitivity(config.gyro_noise_density**2 * noise, by_rate,
                           log_so3(scaled @ rotation.T) / step)


def bias_jacobian(stamps_ns: NDArray[np.int64], rates: Array) -> Array:
    """J (3, 3): ``Exp(J dw) R`` is the rotation integrated from ``rates + dw``, for small dw."""
    return _integrate((stamps_ns - stamps_ns[0]) * 1e-9, np.ascontiguousarray(rates))[1]
