"""Orientation by the gyro at any instant, with what the calibration's derivatives need."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray

from rs_relpose_ros.compiled import kernel
from rs_relpose_ros.errors import InputError
from rs_relpose_ros.geometry.so3 import exp_so3, rodrigues

Array = NDArray[np.float64]


@dataclass(frozen=True, slots=True, eq=False)
class GyroSeries:
    """Samples of a gyro, IMU frame.

    Parameters
    ----------
    stamps_ns : (K,) array_like of int
        On the IMU clock, strictly increasing.
    rates : (K, 3) array_like
        Angular velocity as measured [rad/s].
    """

    stamps_ns: NDArray[np.int64]
    rates: Array

    def __post_init__(self) -> None:
        stamps = np.ascontiguousarray(self.stamps_ns, dtype=np.int64)
        rates = np.ascontiguousarray(self.rates, dtype=np.float64)
        if stamps.ndim != 1 or rates.shape != (len(stamps), 3):
            raise InputError('stamps_ns and rates must have shapes (K,) and (K, 3), got '
                             f'{stamps.shape} and {rates.shape}')
        if not (np.diff(stamps) > 0).all():
            raise InputError('stamps_ns of the gyro must be strictly increasing')
        if not np.isfinite(rates).all():
            raise InputError('rates of the gyro must be finite')
        object.__setattr__(self, 'stamps_ns', stamps)
        object.__setattr__(self, 'rates', rates)

    @classmethod
    def by_stamp(cls, rates: Mapping[int, ArrayLike]) -> GyroSeries:
        """Series of rates (3,) [rad/s] by their stamps [ns], in whatever order."""
        stamps = sorted(rates)
        return cls(np.array(stamps, dtype=np.int64),
                   np.array([rates[stamp] for stamp in stamps]).reshape(-1, 3))

    def __len__(self) -> int:
        return len(self.stamps_ns)

    def seconds(self, origin_ns: int) -> Array:
        """Instants (K,) [s] since `origin_ns`."""
        return np.asarray((self.stamps_ns - origin_ns) * 1e-9, dtype=np.float64)


def noise_density(times: Array, rates: Array) -> float:
    """White noise of a gyro [rad/s/sqrt(Hz)], from third differences of its samples.

    A movement that is smooth from sample to sample drops out of them; vibration counts as noise.

    Parameters
    ----------
    times, rates : (K,), (K, 3) ndarray
        [s], [rad/s].
    """
    steps = np.diff(times)
    step = float(np.median(steps))
    even = np.abs(steps - step) < 0.2 * step
    even = even[2:] & even[1:-1] & even[:-2]
    third = np.abs(np.diff(rates, n=3, axis=0))[even]
    if len(third) == 0:
        return 0.0
    # 1, -3, 3, -1 of independent samples; the median of a normal deviate's size is 0.6745.
    return float(np.median(third) / 0.6745 / np.sqrt(20.0) * np.sqrt(step))


@dataclass(frozen=True, slots=True, eq=False)
class GyroPath:
    """Integrated gyro: everything is linear or constant between neighbouring knots.

    Attributes
    ----------
    times : (K,) ndarray
        [s].
    rates : (K, 3) ndarray
        Bias removed [rad/s].
    rotations : (K, 3, 3) ndarray
        ``R_start^T R_k`` in the IMU frame.
    turned : (K, 3, 3) ndarray
        Integral of the rotations over time [s]: a rate error db turns what comes out at knot k by
        ``turned_k db``, in the frame of the start.
    """

    times: Array
    rates: Array
    rotations: Array
    turned: Array

    @classmethod
    def integrated(cls, times: ArrayLike, measured: ArrayLike, bias: ArrayLike) -> GyroPath:
        """Integrate rates (K, 3) at times (K,) after subtracting a bias (3,)."""
        times = np.ascontiguousarray(times, dtype=np.float64)
        rates = np.ascontiguousarray(np.asarray(measured) - np.asarray(bias), dtype=np.float64)
        return cls(times, rates, *_integrated(times, rates))

    def at(self, times: ArrayLike) -> Array:
        """Rotations (N, 3, 3) at instants (N,); those outside of the knots extrapolate."""
        return _evaluated(self.times, self.rates, self.rotations,
                          np.ascontiguousarray(times, dtype=np.float64))


@kernel
def _integrated(times: Array, rates: Array) -> tuple[Array, Array]:
    count = len(times)
    rotations, turned = np.empty((count, 3, 3)), np.zeros((count, 3, 3))
    rotations[0] = np.eye(3)
    for k in range(count - 1):
        dt = times[k + 1] - times[k]
        step = exp_so3(0.5 * dt * (rates[k] + rates[k + 1]))
        for i in range(3):
            for j in range(3):
                rotations[k + 1, i, j] = (
                    rotations[k, i, 0] * step[0, j] + rotations[k, i, 1] * step[1, j]
                    + rotations[k, i, 2] * step[2, j])
        for i in range(3):
            for j in range(3):
                turned[k + 1, i, j] = turned[k, i, j] + 0.5 * dt * (
                    rotations[k, i, j] + rotations[k + 1, i, j])
    return rotations, turned


@kernel
def rotation_at(times: Array, rates: Array, rotations: Array, instant: float, k: int,
                rotation: Array, rate: Array) -> None:
    """Rotation (3, 3) and rate (3,) at an instant at or after knot `k`, written in place."""
    dt = instant - times[k]
    share = dt / (times[k + 1] - times[k])
    for i in range(3):
        rate[i] = rates[k, i] + share * (rates[k + 1, i] - rates[k, i])
    x = 0.5 * dt * (rates[k, 0] + rate[0])
    y = 0.5 * dt * (rates[k, 1] + rate[1])
    z = 0.5 * dt * (rates[k, 2] + rate[2])
    a, b = rodrigues(x * x + y * y + z * z)
    e00, e11 = 1.0 - b * (y * y + z * z), 1.0 - b * (x * x + z * z)
    e22 = 1.0 - b * (x * x + y * y)
    e01, e10 = b * x * y - a * z, b * x * y + a * z
    e02, e20 = b * x * z + a * y, b * x * z - a * y
    e12, e21 = b * y * z - a * x, b * y * z + a * x
    for i in range(3):
        q0, q1, q2 = rotations[k, i, 0], rotations[k, i, 1], rotations[k, i, 2]
        rotation[i, 0] = q0 * e00 + q1 * e10 + q2 * e20
        rotation[i, 1] = q0 * e01 + q1 * e11 + q2 * e21
        rotation[i, 2] = q0 * e02 + q1 * e12 + q2 * e22


@kernel
def knot_before(times: Array, instant: float, near: int) -> int:
    """Index of the last knot not after `instant`, within [0, K - 2], searched from `near` on."""
    k = min(max(near, 0), len(times) - 2)
    while k > 0 and times[k] > instant:
        k -= 1
    while k < len(times) - 2 and times[k + 1] <= instant:
        k += 1
    return k


@kernel
def _evaluated(times: Array, rates: Array, rotations: Array, instants: Array) -> Array:
    out, rate = np.empty((len(instants), 3, 3)), np.empty(3)
    k = 0
    for n in range(len(instants)):
        k = knot_before(times, instants[n], k)
        rotation_at(times, rates, rotations, instants[n], k, out[n], rate)
    return out
