"""Clock offset, axes and focal length from nothing: rotation that is seen against the gyro's."""

from __future__ import annotations

from dataclasses import dataclass
import itertools

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from rs_relpose_ros.calibrate.axis_maps import nearest_axis_map
from rs_relpose_ros.geometry.so3 import aligning_rotation

Array = NDArray[np.float64]

_ROUNDS = 12
# Residual [rad] below which a ray always counts in full.
_LEAST_SCALE = 2e-4
# Weaker second axis of the common rotation than this share of the first: an axis map fills it in.
_ONE_AXIS = 0.05


@dataclass(frozen=True, slots=True, eq=False)
class Start:
    """A coarse calibration."""

    offset: float          # of the middle row [s]: t_imu = stamp + offset
    R_cam_imu: Array       # (3, 3)
    bias: Array            # (3,) IMU frame [rad/s]
    focal_factor: float
    misfit: float          # share of the rotation's variance that the two do not have in common
    scale: float           # seen over measured by the gyro; 1 where that is taken to be known
    explained: float       # share of what was seen that the gyro explains at any scale, 0 to 1


def seen_rates(begin: NDArray[np.int64], rays1: Array, rays2: Array, intervals: Array) -> Array:
    """Angular velocity (P, 3) [rad/s], camera frame, that turns the rays of each pair.

    Of unit rays (N, 3), those of pair p from ``begin[p]`` on, and intervals (P,) [s]. Translation
    is left out: a robust fit follows the far points, and what remains averages out.
    """
    turns = [_turn(rays1[first:last], rays2[first:last])
             for first, last in itertools.pairwise(begin)]
    return np.array(turns).reshape(-1, 3) / intervals[:, None]


def _turn(rays1: Array, rays2: Array) -> Array:
    """Rotation vector a with ``m_1 = m_2 + a x m_2``, by reweighted least squares (Cauchy)."""
    difference = rays1 - rays2
    # a x m = -[m]x a; normal equations (m^T m - m m^T) a = m x d.
    moments = np.eye(3) - rays2[:, :, None] * rays2[:, None, :]
    sides = np.cross(rays2, difference)
    weights = np.ones(len(rays1))
    turn = np.zeros(3)
    for _ in range(_ROUNDS):
        turn = np.linalg.solve(np.einsum('n,nij->ij', weights, moments) + 1e-12 * np.eye(3),
                               weights @ sides)
        lengths = np.linalg.norm(difference - np.cross(turn, rays2), axis=1)
        scale = max(1.5 * float(np.median(lengths)), _LEAST_SCALE)
        weights = 1.0 / (1.0 + (lengths / scale) ** 2)
    return turn


def find_starts(rates: Array, begins: Array, ends: Array, gyro_times: Array, gyro_rates: Array, *,
                max_offset: float, step: float, focal_factors: Array, count: int,
                scale_known: bool = True) -> list[Start]:
    """Offsets at which the gyro, turned, agrees best with what was seen; best first.

    `rates` (P, 3) were seen between `begins` and `ends` (P,) [s] on the camera clock. Offsets to
    +- `max_offset` [s] are searched in steps of `step`, with each of the `focal_factors` of the
    assumed focal length; at most `count` starts of different offsets are returned. Where the
    gyro's scale is not known to be right, neither is the unit of `bias`.
    """
    steps = np.diff(gyro_times)[:, None]
    turned = np.concatenate([
        np.zeros((1, 3)), np.cumsum(0.5 * steps * (gyro_rates[1:] + gyro_rates[:-1]), axis=0)])
    starts: list[Start] = []
    for offset in np.arange(-max_offset, max_offset + 0.5 * step, step):
        inside = ((begins + offset >= gyro_times[0]) & (ends + offset <= gyro_times[-1]))
        # An offset at which the gyro misses most frames cannot be judged.
        if inside.sum() < max(10, 0.5 * len(rates)):
            continue
        measured = np.stack([
            np.interp(ends[inside] + offset, gyro_times, turned[:, i])
            - np.interp(begins[inside] + offset, gyro_times, turned[:, i]) for i in range(3)],
            axis=1) / (ends - begins)[inside, None]
        starts.append(min((_aligned(rates[inside] * [1.0 / factor, 1.0 / factor, 1.0], measured,
                                    float(offset), float(factor), scale_known)
                           for factor in focal_factors),
                          key=lambda start: start.misfit))
    return _best_apart(starts, count, 4.0 * step)


def _aligned(seen: Array, measured: Array, offset: float, focal_factor: float,
             scale_known: bool) -> Start:
    kept = np.ones(len(seen), dtype=bool)
    start = Start(offset, np.eye(3), np.zeros(3), focal_factor, 1.0, 1.0, 0.0)
    for _ in range(3):
        mean_a, mean_b = seen[kept].mean(axis=0), measured[kept].mean(axis=0)
        a, b = seen - mean_a, measured - mean_b
        R = _rotation_onto(a[kept], b[kept])
        turned = b @ R.T
        in_a, in_b, shared = (float((x[kept] * y[kept]).sum())
                              for x, y in ((a, a), (b, b), (a, turned)))
        scale = 1.0 if scale_known else max(shared, 0.0) / max(in_b, 1e-12)
        squares = ((a - scale * turned)**2).sum(axis=1)
        start = Start(
            # A translation to one side looks like a bias; none of a gyro is large.
            offset, R, np.clip(mean_b - R.T @ mean_a / max(scale, 1e-12), -0.1, 0.1), focal_factor,
            float(squares[kept].sum()) / max(in_a + scale**2 * in_b, 1e-12), scale,
            max(shared, 0.0)**2 / max(in_a * in_b, 1e-24))
        kept = squares <= 9.0 * max(float(np.median(squares)), 1e-10)
    return start


def _rotation_onto(seen: Array, measured: Array) -> Array:
    """Rotation R with ``seen = R measured``; from one axis, the one nearest to an axis map."""
    C = seen.T @ measured
    u, s, vt = np.linalg.svd(C)
    if s[1] < _ONE_AXIS * s[0]:
        nearest = nearest_axis_map(C)
        tilt, _ = Rotation.align_vectors(u[:, :1].T, vt[:1] @ nearest.T)
        return np.asarray(tilt.as_matrix() @ nearest)
    return aligning_rotation(C)


def _best_apart(starts: list[Start], count: int, apart: float) -> list[Start]:
    chosen: list[Start] = []
    for start in sorted(starts, key=lambda start: start.misfit):
        if all(abs(start.offset - other.offset) >= apart for other in chosen):
            chosen.append(start)
        if len(chosen) == count:
            break
    return chosen
