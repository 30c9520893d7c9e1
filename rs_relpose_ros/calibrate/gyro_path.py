"""Orientation by the gyro at any instant, with what the calibration's derivatives need."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from numpy.typing import ArrayLike, NDArray

from rs_relpose_ros.compiled import inlined_kernel, kernel
from rs_relpose_ros.errors import InputError
from rs_relpose_ros.geometry.so3 import rodrigues
from rs_relpose_ros.geometry.vectors import cross, dot

Array = NDArray[np.float64]

# Exposure whose effect stands for that of others, by its square [s].
_EXPOSURE = 0.03


@dataclass(frozen=True, slots=True, eq=False)
class GyroSeries:
    """Samples of a gyro; taken as array_likes."""

    stamps_ns: NDArray[np.int64]    # (K,) IMU clock, strictly increasing
    rates: Array                    # (K, 3) as measured, IMU frame [rad/s]

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


def noise_density(times: Array, rates: Array) -> float:
    """White noise [rad/s/sqrt(Hz)] of rates (K, 3) at times (K,), from third differences.

    A movement that is smooth from sample to sample drops out of them; vibration counts as noise.
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


def blur(times: Array, rates: Array) -> tuple[Array, Array]:
    """What an exposure does to rates (K, 3) at times (K,), over its square, and its integral.

    An image that is exposed for h shows the mean over h of the rotation, ``w + h^2 / 24 w''`` of
    the rate w to second order: returned are ``(mean of w over _EXPOSURE - w) / _EXPOSURE^2``
    [rad/s^3], which is ``w'' / 24`` without its noise, and the integral over time [rad/s^2].
    """
    steps = np.diff(times)[:, None]
    turned = np.concatenate([np.zeros((1, 3)),
                             np.cumsum(0.5 * steps * (rates[1:] + rates[:-1]), axis=0)])
    begin, end = (np.clip(times + shift, times[0], times[-1])
                  for shift in (-0.5 * _EXPOSURE, 0.5 * _EXPOSURE))
    means = np.stack([np.interp(end, times, turned[:, i]) - np.interp(begin, times, turned[:, i])
                      for i in range(3)], axis=1) / (end - begin)[:, None]
    changes = (means - rates) / _EXPOSURE**2
    turns = np.concatenate([np.zeros((1, 3)),
                            np.cumsum(0.5 * steps * (changes[1:] + changes[:-1]), axis=0)])
    return changes, turns


class GyroPath(NamedTuple):
    """Integrated gyro with K knots: rates are linear between neighbouring knots."""

    times: Array        # (K,) [s]
    rates: Array        # (K, 3) without the bias [rad/s]
    rotations: Array    # (K, 3, 3) R_start^T R_k, IMU frame
    # (K, 3, 3) integral of the rotations over time [s]: a rate error db turns the rotation at knot
    # k by ``turned_k db``, in the frame of the start.
    turned: Array

    @classmethod
    def integrated(cls, times: ArrayLike, measured: ArrayLike, bias: ArrayLike) -> GyroPath:
        """Integrate rates (K, 3) at times (K,) after subtracting a bias (3,)."""
        times = np.ascontiguousarray(times, dtype=np.float64)
        rates = np.ascontiguousarray(np.asarray(measured) - np.asarray(bias), dtype=np.float64)
        return cls(times, rates, *_integrated(times, rates))

    def at(self, times: ArrayLike) -> Array:
        """Rotations (N, 3, 3) at instants (N,); those outside of the knots extrapolate."""
        return _evaluated(self, np.ascontiguousarray(times, dtype=np.float64))


@kernel
def _integrated(times: Array, rates: Array) -> tuple[Array, Array]:
    """``R <- R Exp((w_0 + w_1) dt / 2)``, and the integral of R by the trapezoidal rule."""
    count = len(times)
    rotations, turned = np.empty((count, 3, 3)), np.zeros((count, 3, 3))
    rotations[0] = np.eye(3)
    for k in range(count - 1):
        dt = times[k + 1] - times[k]
        _turn(rotations[k], rates[k], rates[k + 1], dt, rotations[k + 1])
        for i in range(3):
            for j in range(3):
                turned[k + 1, i, j] = turned[k, i, j] + 0.5 * dt * (
                    rotations[k, i, j] + rotations[k + 1, i, j])
    return rotations, turned


@inlined_kernel
def _turn(rotation: Array, rate1: Array, rate2: Array, dt: float, out: Array) -> None:
    """Write ``R Exp(phi)`` with ``phi = (w_1 + w_2) dt / 2``: Rodrigues' formula for each row."""
    phi = (0.5 * dt * (rate1[0] + rate2[0]), 0.5 * dt * (rate1[1] + rate2[1]),
           0.5 * dt * (rate1[2] + rate2[2]))
    a, b = rodrigues(dot(phi, phi))
    for i in range(3):
        side = cross(rotation[i], phi)
        back = cross(side, phi)
        for j in range(3):
            out[i, j] = rotation[i, j] + a * side[j] + b * back[j]


@inlined_kernel
def rotation_at(path: GyroPath, instant: float, k: int, rotation: Array, rate: Array) -> None:
    """Fill the rotation (3, 3) and the rate (3,) at an instant from knot `k` on."""
    dt = instant - path.times[k]
    share = dt / (path.times[k + 1] - path.times[k])
    for i in range(3):
        rate[i] = path.rates[k, i] + share * (path.rates[k + 1, i] - path.rates[k, i])
    _turn(path.rotations[k], path.rates[k], rate, dt, rotation)


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
def _evaluated(path: GyroPath, instants: Array) -> Array:
    out, rate = np.empty((len(instants), 3, 3)), np.empty(3)
    k = 0
    for n in range(len(instants)):
        k = knot_before(path.times, instants[n], k)
        rotation_at(path, instants[n], k, out[n], rate)
    return out
