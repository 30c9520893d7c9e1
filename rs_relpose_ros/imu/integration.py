"""Integration of the gyro on SO(3), with covariance."""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike, NDArray

from rs_relpose_ros.compiled import kernel
from rs_relpose_ros.config.imu import ImuConfig
from rs_relpose_ros.errors import InputError
from rs_relpose_ros.geometry.so3 import exp_so3, left_jacobian_so3

Array = NDArray[np.float64]


@kernel
def _product(a: Array, b: Array, out: Array) -> None:
    # By hand: a call of BLAS costs more than nine sums of three products.
    for i in range(3):
        for j in range(3):
            out[i, j] = a[i, 0] * b[0, j] + a[i, 1] * b[1, j] + a[i, 2] * b[2, j]


@kernel
def _integrate(seconds: Array, rates: Array) -> tuple[Array, Array, Array]:
    """Rotation ``R_start^T R_end``, its derivative by a constant rate error, and noise growth.

    ``R <- R Exp(turn)`` with the rate linear within a step (Magnus expansion, fourth order;
    Blanes, Casas, Oteo and Ros, Physics Reports 470, 2009):

        turn = (w_0 + w_1) dt / 2 + (w_0 x w_1) dt^2 / 12

    An error dw of a step's rate turns the result by ``R J_l(turn) dw dt`` on the left (in the
    start frame).
    """
    rotation, by_bias, noise = np.eye(3), np.zeros((3, 3)), np.zeros((3, 3))
    turn, left, turned = np.empty(3), np.empty((3, 3)), np.empty((3, 3))
    for k in range(seconds.shape[0] - 1):
        dt = seconds[k + 1] - seconds[k]
        for i in range(3):
            a, b = (i + 1) % 3, (i + 2) % 3
            turn[i] = (0.5 * (rates[k, i] + rates[k + 1, i]) * dt
                       + (rates[k, a] * rates[k + 1, b] - rates[k, b] * rates[k + 1, a])
                       * dt * dt / 12.0)
        _product(rotation, left_jacobian_so3(turn), left)
        for i in range(3):
            for j in range(3):
                by_bias[i, j] += left[i, j] * dt
                noise[i, j] += (left[i, 0] * left[j, 0] + left[i, 1] * left[j, 1]
                                + left[i, 2] * left[j, 2]) * dt
        _product(rotation, exp_so3(turn), turned)
        rotation, turned = turned, rotation
    return rotation, by_bias, noise


def integrate_rotation(stamps_ns: NDArray[np.int64], rates: ArrayLike, config: ImuConfig,
                       bias_sigma: float | None = None) -> tuple[Array, Array]:
    """Rotation between the first and the last sample.

    Parameters
    ----------
    stamps_ns : (K,) ndarray of int64
        Strictly increasing.
    rates : (K, 3) array_like
        Angular velocity [rad/s], bias removed, linear between samples.
    config : ImuConfig
        Noise density and bias uncertainty.
    bias_sigma : float, optional
        1 sigma per axis of the bias that was removed [rad/s], where it is known better than
        `config` says.

    Returns
    -------
    rotation : (3, 3) ndarray
        ``R_start^T R_end``.
    covariance : (3, 3) ndarray
        Of dtheta in the start frame, ``R_true = Exp(dtheta) rotation`` [rad^2].
    """
    rates = np.ascontiguousarray(rates, dtype=np.float64)
    if len(stamps_ns) < 1 or rates.shape != (len(stamps_ns), 3):
        raise InputError(f'rates must have shape ({len(stamps_ns)}, 3), got {rates.shape}')
    seconds = (stamps_ns - stamps_ns[0]) * 1e-9
    if not (np.diff(seconds) > 0.0).all():
        raise InputError('stamps_ns must be strictly increasing')
    rotation, by_bias, noise = _integrate(seconds, rates)
    if bias_sigma is None:
        bias_sigma = config.gyro_bias_sigma
    covariance = config.gyro_noise_density**2 * noise + bias_sigma**2 * by_bias @ by_bias.T
    return rotation, covariance


def bias_jacobian(stamps_ns: NDArray[np.int64], rates: Array) -> Array:
    """Derivative (3, 3) of the integrated rotation by a constant added to all rates.

    ``Exp(J dw) R`` is the rotation integrated from ``rates + dw``, to first order in dw; arguments
    as in `integrate_rotation`.
    """
    return _integrate((stamps_ns - stamps_ns[0]) * 1e-9, np.ascontiguousarray(rates))[1]
