"""Integration of a gyro on SO(3), its rate linear from sample to sample.

    R_0 = I        R_{k+1} = R_k Exp(phi_k)
    phi_k = (w_k + w_{k+1}) dt / 2 + (w_k x w_{k+1}) dt^2 / 12

Magnus expansion to fourth order (Blanes, Casas, Oteo and Ros, Physics Reports 470, 2009).
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from rs_relpose_ros.compiled import kernel
from rs_relpose_ros.geometry.so3 import exp_so3, multiply
from rs_relpose_ros.geometry.vectors import cross

Array = NDArray[np.float64]


@kernel
def step_turn(rate1: Array, rate2: Array, dt: float) -> Array:
    """Rotation vector ``phi`` (3,) of a step of `dt` [s] between two rates (3,) [rad/s]."""
    turn = np.empty(3)
    bent = cross(rate1, rate2)
    for i in range(3):
        turn[i] = 0.5 * (rate1[i] + rate2[i]) * dt + bent[i] * dt * dt / 12.0
    return turn


@kernel
def integrated_rotations(seconds: Array, rates: Array) -> Array:
    """``R_k`` (K, 3, 3), which takes from the frame of sample k to that of the first one.

    Parameters
    ----------
    seconds : (K,) ndarray
        Increasing instants.
    rates : (K, 3) ndarray
        Angular velocity in the turning frame [rad/s].
    """
    rotations = np.empty((len(seconds), 3, 3))
    rotations[0] = 0.0
    rotations[0, 0, 0] = rotations[0, 1, 1] = rotations[0, 2, 2] = 1.0
    for k in range(len(seconds) - 1):
        turn = step_turn(rates[k], rates[k + 1], seconds[k + 1] - seconds[k])
        multiply(rotations[k], exp_so3(turn), rotations[k + 1])
    return rotations
