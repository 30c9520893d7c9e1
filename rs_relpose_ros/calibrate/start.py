"""Initial clock offset, axes and focal length: rotation of the images against the gyro."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cache
import itertools
from typing import NamedTuple

import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy.integrate import cumulative_trapezoid
from scipy.spatial.transform import Rotation

from rs_relpose_ros.geometry import Array, so3
from rs_relpose_ros.jit import inlined_kernel, kernel


@cache
def axis_maps() -> Array:
    """All 24 rotations (24, 3, 3) that map axes to axes."""
    maps = np.array([np.diag(signs) @ np.eye(3)[list(columns)] + 0.0    # no zero is negative
                     for columns in itertools.permutations(range(3))
                     for signs in itertools.product((1.0, -1.0), repeat=3)])
    maps = maps[np.linalg.det(maps) > 0.0]
    maps.setflags(write=False)      # shared
    return maps


def nearest_axis_map(R: Array) -> Array:
    """The axis map (3, 3) nearest to a rotation."""
    maps = axis_maps()
    return np.array(maps[int(np.argmax(np.einsum('kij,ij->k', maps, R)))])


def axes_text(axis_map: Array) -> str:
    """An axis map (3, 3) as text: ``cam x = -imu y, ...``."""
    parts = []
    for row, axis in zip(axis_map, 'xyz', strict=True):
        k = int(np.argmax(np.abs(row)))
        parts.append(f"cam {axis} = {'-' if row[k] < 0 else '+'}imu {'xyz'[k]}")
    return ', '.join(parts)


# If the second axis of the common rotation is weaker than this share of the first, an axis map
# determines it.
_ONE_AXIS = 0.05


class Start(NamedTuple):
    """A coarse calibration."""

    offset: float          # of the middle row [s]: t_imu = stamp + offset
    R_cam_imu: Array       # (3, 3)
    focal_factor: float
    misfit: float          # share of the variance of the rotation that is not common


def find_starts(rates: Array, begins: Array, ends: Array, gyro_times: Array, gyro_rates: Array, *,
                max_offset: float, step: float, focal_factors: Array, count: int,
                R_prior: Array | None = None) -> list[Start]:
    """Offsets at which the rotated gyro agrees best with the images; best first.

    `rates` (P, 3) of the camera hold between `begins` and `ends` (P,) [s] on its clock. Offsets to
    +- `max_offset` [s] are searched in steps of `step`, with each of the `focal_factors` of the
    assumed focal length; at most `count` starts of different offsets are returned. Where the
    rotation about one axis is not determined, it is that of `R_prior`, or of an axis map.
    """
    turned = cumulative_trapezoid(gyro_rates, gyro_times, axis=0, initial=0.0)

    def aligned(offset: float, factors: ArrayLike) -> Start | None:
        inside = ((begins + offset >= gyro_times[0]) & (ends + offset <= gyro_times[-1]))
        # An offset at which the gyro misses most frames cannot be evaluated.
        if inside.sum() < max(10, 0.5 * len(rates)):
            return None
        begin, end = begins[inside] + offset, ends[inside] + offset
        measured = np.stack([
            (np.interp(end, gyro_times, of_axis) - np.interp(begin, gyro_times, of_axis))
            / (end - begin) for of_axis in turned.T], axis=1)
        return min((_aligned(rates[inside] * [1.0 / factor, 1.0 / factor, 1.0], measured,
                             offset, float(factor), R_prior) for factor in np.atleast_1d(factors)),
                   key=lambda start: start.misfit)

    # The best offsets hardly depend on the focal length.
    offsets = np.arange(-max_offset, max_offset + 0.5 * step, step)
    starts = [start for offset in offsets
              if (start := aligned(float(offset), np.median(focal_factors)))]
    chosen: list[Start] = []
    for start in sorted(starts, key=lambda start: start.misfit):
        if all(abs(start.offset - other.offset) >= 4.0 * step for other in chosen):
            chosen.append(start)
    return sorted(filter(None, (aligned(start.offset, focal_factors) for start in chosen[:count])),
                  key=lambda start: start.misfit)


def _aligned(estimated: Array, measured: Array, offset: float, focal_factor: float,
             R_prior: Array | None) -> Start:
    """Start with the rotation between two series of rates (P, 3) without their outliers."""
    kept = np.ones(len(estimated), dtype=bool)
    start = Start(offset, np.eye(3), focal_factor, 1.0)
    for _ in range(3):
        # A bias and a constant translation drop out with the means.
        a, b = (rates - rates[kept].mean(axis=0) for rates in (estimated, measured))
        R = _rotation_onto(a[kept], b[kept], R_prior)
        squares = ((a - b @ R.T)**2).sum(axis=1)
        both = float((a[kept]**2).sum()) + float((b[kept]**2).sum())
        start = start._replace(
            R_cam_imu=R, misfit=float(squares[kept].sum()) / max(both, 1e-12))
        kept = squares <= 9.0 * max(float(np.median(squares)), 1e-10)
    return start


def _rotation_onto(estimated: Array, measured: Array, R_prior: Array | None) -> Array:
    """Rotation R with ``estimated = R measured``; of one axis, the one nearest to a known one."""
    C = estimated.T @ measured
    u, s, vt = np.linalg.svd(C)
    if s[1] < _ONE_AXIS * s[0]:
        nearest = nearest_axis_map(C) if R_prior is None else R_prior
        tilt, _ = Rotation.align_vectors(u[:, :1].T, vt[:1] @ nearest.T)
        return np.asarray(tilt.as_matrix() @ nearest)
    return so3.aligning_rotation(C)


# -- Orientation by the gyro at any time, with derivatives --------------------------------------

@dataclass(frozen=True, slots=True, eq=False)
class GyroSeries:
    """Samples of a gyro."""

    stamps_ns: NDArray[np.int64]    # (K,) IMU clock, strictly increasing
    rates: Array                    # (K, 3) as measured, IMU frame [rad/s]

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
        """Rotations (N, 3, 3) at times (N,); extrapolated outside of the knots."""
        return _evaluated(self, np.ascontiguousarray(times, dtype=np.float64))


@kernel
def _integrated(times: Array, rates: Array) -> tuple[Array, Array]:
    """``R <- R Exp((w_0 + w_1) dt / 2)``, and the integral of R by the trapezoidal rule."""
    count = len(times)
    rotations, turned = np.empty((count, 3, 3)), np.zeros((count, 3, 3))
    rotations[0] = np.eye(3)
    for k in range(count - 1):
        dt = times[k + 1] - times[k]
        _path_rotation(rotations[k], rates[k], rates[k + 1], dt, rotations[k + 1])
        for i in range(3):
            for j in range(3):
                turned[k + 1, i, j] = turned[k, i, j] + 0.5 * dt * (
                    rotations[k, i, j] + rotations[k + 1, i, j])
    return rotations, turned


@inlined_kernel
def _path_rotation(rotation: Array, rate1: Array, rate2: Array, dt: float, out: Array) -> None:
    """Write ``R Exp(phi)`` with ``phi = (w_1 + w_2) dt / 2``: Rodrigues' formula for each row."""
    phi = (0.5 * dt * (rate1[0] + rate2[0]), 0.5 * dt * (rate1[1] + rate2[1]),
           0.5 * dt * (rate1[2] + rate2[2]))
    square = so3.dot(phi, phi)
    if square < 0.01:   # to 1e-14; without sine and cosine twice as fast
        a = 1.0 - square / 6.0 * (1.0 - square / 20.0 * (1.0 - square / 42.0))
        b = 0.5 - square / 24.0 * (1.0 - square / 30.0 * (1.0 - square / 56.0))
    else:
        a, b = so3.rodrigues(square)
    for i in range(3):
        side = so3.cross(rotation[i], phi)
        back = so3.cross(side, phi)
        for j in range(3):
            out[i, j] = rotation[i, j] + a * side[j] + b * back[j]


@inlined_kernel
def rotation_at(path: GyroPath, time: float, k: int, rotation: Array, rate: Array) -> None:
    """Fill the rotation (3, 3) and the rate (3,) at a time from knot `k` on."""
    dt = time - path.times[k]
    share = dt / (path.times[k + 1] - path.times[k])
    for i in range(3):
        rate[i] = path.rates[k, i] + share * (path.rates[k + 1, i] - path.rates[k, i])
    _path_rotation(path.rotations[k], path.rates[k], rate, dt, rotation)


@kernel
def knot_before(times: Array, time: float, near: int) -> int:
    """Index of the last knot not after `time`, within [0, K - 2], searched from `near` on."""
    k = min(max(near, 0), len(times) - 2)
    while k > 0 and times[k] > time:
        k -= 1
    while k < len(times) - 2 and times[k + 1] <= time:
        k += 1
    return k


@kernel
def _evaluated(path: GyroPath, at: Array) -> Array:
    out, rate = np.empty((len(at), 3, 3)), np.empty(3)
    k = 0
    for n in range(len(at)):
        k = knot_before(path.times, at[n], k)
        rotation_at(path, at[n], k, out[n], rate)
    return out
