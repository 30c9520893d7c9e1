"""Orientation by the integrated gyro at any time.

The rate is linear between samples. With R_0 = I,

    R_{k+1} = R_k Exp(phi_k)
    phi_k   = (w_k + w_{k+1}) dt / 2 + (w_k x w_{k+1}) dt^2 / 12

by the Magnus expansion to fourth order (Blanes, Casas, Oteo and Ros, Physics Reports 470, 2009).
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from rs_relpose_ros.geometry import Array, so3
from rs_relpose_ros.geometry.so3 import cross, dot
from rs_relpose_ros.jit import inlined_kernel, kernel

# Square of the angle of a step [rad^2] below which a series replaces sine and cosine. It is exact
# to 1e-14 there, and twice as fast. [derived: the first term left out is 1e-8 / 5040 of theta^8]
_SMALL_TURN = 0.01


class GyroPath(NamedTuple):
    """The integrated gyro at K knots, relative to the orientation at one time."""

    times: Array  # (K,) [s], increasing
    rates: Array  # (K, 3) in the moving axes [rad/s]
    rotations: Array  # (K, 3, 3) from the axes at each knot to the axes at the time of reference

    @classmethod
    def integrated(cls, times: Array, rates: Array) -> GyroPath:
        """Integrate rates (K, 3) without their bias; the first knot is the reference."""
        return cls(times, rates, integrated_rotations(times, rates))

    @classmethod
    def constant(cls, rate: Array, begin: float, end: float) -> GyroPath:
        """Rotation at a constant rate (3,) from `begin` to `end` [s], relative to time 0."""
        times = np.array([begin, end])
        rotations = np.stack([so3.exp_so3(time * rate) for time in times])
        return cls(times, np.stack([rate, rate]), rotations)

    def at(self, times: Array) -> Array:
        """Rotations (N, 3, 3) at times (N,); extrapolated outside of the knots."""
        return path_states(self, times)[0]

    def about(self, time: float) -> GyroPath:
        """The path relative to the orientation at `time`, which becomes time 0."""
        reference = self.at(np.array([time]))[0]
        return GyroPath(self.times - time, self.rates, reference.T @ self.rotations)


@inlined_kernel
def write_turned(rotation: Array, rate1: Array, rate2: Array, dt: float, out: Array) -> None:
    """Write ``R Exp(phi)`` after a step `dt` [s] between two rates: Rodrigues for each row."""
    across = cross(rate1, rate2)
    mean = 0.5 * dt
    square_of_time = dt * dt / 12.0
    phi = (
        mean * (rate1[0] + rate2[0]) + square_of_time * across[0],
        mean * (rate1[1] + rate2[1]) + square_of_time * across[1],
        mean * (rate1[2] + rate2[2]) + square_of_time * across[2],
    )
    square = dot(phi, phi)
    if square < _SMALL_TURN:
        a = 1.0 - square / 6.0 * (1.0 - square / 20.0 * (1.0 - square / 42.0))
        b = 0.5 - square / 24.0 * (1.0 - square / 30.0 * (1.0 - square / 56.0))
    else:
        a, b = so3.rodrigues(square)
    for i in range(3):
        side = cross(rotation[i], phi)
        back = cross(side, phi)
        for j in range(3):
            out[i, j] = rotation[i, j] + a * side[j] + b * back[j]


@kernel
def integrated_rotations(times: Array, rates: Array) -> Array:
    """``R_k`` (K, 3, 3) from the axes at knot k to those at the first knot."""
    rotations = np.empty((len(times), 3, 3))
    rotations[0] = 0.0
    rotations[0, 0, 0] = rotations[0, 1, 1] = rotations[0, 2, 2] = 1.0
    for k in range(len(times) - 1):
        dt = times[k + 1] - times[k]
        write_turned(rotations[k], rates[k], rates[k + 1], dt, rotations[k + 1])
    return rotations


@kernel
def knot_before(times: Array, time: float, near: int) -> int:
    """Index of the last knot not after `time`, within [0, K - 2], searched from `near` on."""
    k = min(max(near, 0), len(times) - 2)
    while k > 0 and times[k] > time:
        k -= 1
    while k < len(times) - 2 and times[k + 1] <= time:
        k += 1
    return k


@inlined_kernel
def write_state(path: GyroPath, time: float, k: int, rotation: Array, rate: Array) -> None:
    """Write the rotation (3, 3) and the rate (3,) at a time after knot `k`."""
    dt = time - path.times[k]
    share = dt / (path.times[k + 1] - path.times[k])
    for i in range(3):
        rate[i] = path.rates[k, i] + share * (path.rates[k + 1, i] - path.rates[k, i])
    write_turned(path.rotations[k], path.rates[k], rate, dt, rotation)


@kernel
def path_states(path: GyroPath, times: Array) -> tuple[Array, Array, NDArray[np.int64]]:
    """Rotations (N, 3, 3), rates (N, 3) and knots (N,) before times (N,)."""
    count = len(times)
    rotations = np.empty((count, 3, 3))
    rates = np.empty((count, 3))
    knots = np.empty(count, dtype=np.int64)
    k = 0
    for n in range(count):
        k = knot_before(path.times, times[n], k)
        knots[n] = k
        write_state(path, times[n], k, rotations[n], rates[n])
    return rotations, rates, knots
