"""Clock, axes and bias refined on the flow itself, where translation is allowed for.

Rays of a pair that the gyro turned into one frame lie, with the translation t, in planes:
``n . t = 0``, ``n = m_1 x R m_2``. The smallest eigenvalue of ``sum n n^T`` is what the best t
leaves; clock offset, rotation IMU to camera and bias make it least over all pairs.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
import itertools
import math

import numpy as np
from numpy.typing import NDArray
from scipy.optimize import least_squares
from scipy.spatial.transform import Rotation

from rs_relpose_ros.motion import rotations_between

Array = NDArray[np.float64]

# Error of a flow vector that counts half [rad]; about one pixel at a focal length of 700.
_HALF_WEIGHT = 1.5e-3
_ROUNDS = 2
# What rows, blur and moving things leave open at least [s].
_LEAST_SIGMA = 7e-4
# Prior of the gyro's bias against what the means say [rad/s].
_BIAS_SIGMA = 0.02


@dataclass(frozen=True, slots=True, eq=False)
class Flow:
    """Rays (N, 3) of one pair, with their row times [s] against the middle row."""

    start: float
    end: float
    rays1: Array
    rays2: Array
    row_times1: Array
    row_times2: Array


@dataclass(frozen=True, slots=True, eq=False)
class Refined:
    """As in `Alignment`, with the standard deviation of the offset [s]."""

    R_cam_imu: Array
    offset: float
    offset_sigma: float
    bias: Array


def refine(flows: list[Flow], seconds: Array, rates: Array, R_cam_imu: Array, offset: float,
           bias: Array) -> Refined:
    """Refine from a first guess.

    Parameters
    ----------
    flows : list of Flow
        Instants on the stamps' clock, from the same zero as `seconds`.
    seconds : (K,) ndarray
    rates : (K, 3) ndarray
        Gyro [rad/s], IMU frame.
    R_cam_imu, offset, bias
        The guess.
    """
    turns = Rotation.from_rotvec(
        0.5 * (rates[1:] + rates[:-1]) * np.diff(seconds)[:, None]).as_matrix()
    orientations = np.empty((len(seconds), 3, 3))
    orientations[0] = np.eye(3)
    for k, turn in enumerate(turns):
        orientations[k + 1] = orientations[k] @ turn
    starts = np.array([flow.start for flow in flows])
    ends = np.array([flow.end for flow in flows])
    most = max(len(flow.rays1) for flow in flows)

    def padded(values: list[Array]) -> Array:
        out = np.zeros((len(values), most, *values[0].shape[1:]))
        for k, value in enumerate(values):
            out[k, :len(value)] = value
        return out

    used = padded([np.ones(len(flow.rays1)) for flow in flows])
    tau1 = padded([flow.row_times1 for flow in flows])
    tau2 = padded([flow.row_times2 for flow in flows])
    measured1 = padded([flow.rays1 for flow in flows])
    measured2 = padded([flow.rays2 for flow in flows])
    sigma = 0.0
    for _ in range(_ROUNDS):
        turning = [np.column_stack([np.interp(at + offset, seconds, rates[:, axis])
                                    for axis in range(3)]) - bias for at in (starts, ends)]
        # Rows turned to the middle one, to first order: some milliradians.
        rays1, rays2 = (
            rays + tau[..., None] * np.cross((w @ R_cam_imu.T)[:, None, :], rays)
            for rays, tau, w in ((measured1, tau1, turning[0]), (measured2, tau2, turning[1])))

        def normals(x: Array, rays1: Array = rays1, rays2: Array = rays2,
                    guess: Array = R_cam_imu) -> Array:
            at = [rotations_between(seconds, orientations, times + x[3], np.inf)[0]
                  for times in (starts, ends)]
            lost = Rotation.from_rotvec(-(ends - starts)[:, None] * x[4:7]).as_matrix()
            by_gyro = np.swapaxes(at[0], 1, 2) @ at[1] @ lost
            R = Rotation.from_rotvec(x[:3]).as_matrix() @ guess
            return np.asarray(np.cross(rays1, rays2 @ np.swapaxes(R @ by_gyro @ R.T, 1, 2)))

        first = np.array([0.0, 0.0, 0.0, offset, *bias])
        n = normals(first)
        weights = used.copy()
        for _ in range(3):
            _, axes = np.linalg.eigh(np.einsum('pn,pni,pnj->pij', weights, n, n))
            errors = np.einsum('pni,pi->pn', n, axes[:, :, 0])
            weights = used / (1.0 + (errors / _HALF_WEIGHT)**2)

        def left(x: Array, weights: Array = weights, bias: Array = bias) -> Array:
            n = normals(x)
            least = np.linalg.eigvalsh(np.einsum('pn,pni,pnj->pij', weights, n, n))[:, 0]
            errors = np.sqrt(np.maximum(least, 0.0)) / _HALF_WEIGHT
            return np.concatenate([errors, (x[4:7] - bias) / _BIAS_SIGMA])

        def cost(x: Array, weights: Array = weights, bias: Array = bias) -> float:
            return 0.5 * float(np.sum(left(x, weights, bias)**2))

        fit = least_squares(left, first, x_scale=[0.01, 0.01, 0.01, 1e-3, 1e-3, 1e-3, 1e-3],
                            diff_step=1e-4, loss='soft_l1', max_nfev=15)
        # Each point leaves its noise; a pair's translation takes two.
        noise = 2.0 * cost(fit.x) / max(float(used.sum()) - 2.0 * len(flows), 1.0)
        spread = np.linalg.pinv(_curvature(cost, np.asarray(fit.x))) * noise
        # Errors of neighbouring pairs are alike: three times as cautious as independent ones.
        sigma = math.hypot(_LEAST_SIGMA, 3.0 * math.sqrt(max(float(spread[3, 3]), 0.0)))
        R_cam_imu = Rotation.from_rotvec(fit.x[:3]).as_matrix() @ R_cam_imu
        offset, bias = float(fit.x[3]), fit.x[4:7]
    return Refined(R_cam_imu, offset, sigma, bias)


def _curvature(cost: Callable[[Array], float], at: Array) -> Array:
    """Second derivatives (7, 7) by differences."""
    steps = np.diag([2e-3, 2e-3, 2e-3, 1e-3, 2e-3, 2e-3, 2e-3])
    middle = cost(at)
    there = np.array([cost(at + step) for step in steps])
    back = np.array([cost(at - step) for step in steps])
    curvature = np.diag(there + back - 2.0 * middle)
    for i, j in itertools.combinations(range(len(at)), 2):
        both = (cost(at + steps[i] + steps[j]) - there[i] - there[j] + middle)
        curvature[i, j] = curvature[j, i] = both
    scale = np.diag(steps)
    return np.asarray(curvature / np.outer(scale, scale))
