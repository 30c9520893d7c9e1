"""The hypothesis that the camera only turned: a robust rotation fit with the IMU's priors."""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from rs_relpose_ros.compiled import kernel
from rs_relpose_ros.estimator.priors import Priors
from rs_relpose_ros.geometry.so3 import exp_so3, log_so3
from rs_relpose_ros.solvers.linear_algebra import cholesky, newton_step

Array = NDArray[np.float64]

ITERATIONS = 12


@kernel
def transfer_errors(observations: Array, use: NDArray[np.bool_], R: Array,
                    focal: float) -> Array:
    """``|f_1 - R f_2|`` [px] of the matches in `use`: what a rotation leaves of their motion."""
    out = np.empty(use.sum())
    count = 0
    for i in range(observations.shape[0]):
        if use[i]:
            total = 0.0
            for j in range(3):
                value = observations[i, j]
                for k in range(3):
                    value -= R[j, k] * observations[i, 9 + k]
                total += value * value
            out[count] = focal * math.sqrt(total)
            count += 1
    return out


@kernel
def fit_rotation(observations: Array, valid: NDArray[np.bool_], start: Array, priors: Priors,
                 focal: float, sigma: float) -> tuple[Array, Array]:
    """Rotation (3, 3) and the information (3, 3) of its error in frame 1.

    Iteratively reweighted (Cauchy, scale 2 sigma); the prior on the rotation is the gyro's.
    """
    R = start.copy()
    information = np.zeros((3, 3))
    factor = np.zeros((3, 3))
    # Two coordinates in each of two images carry the noise.
    weight = focal * focal / (2.0 * sigma * sigma)
    scale2 = 4.0
    for _ in range(ITERATIONS):
        hessian = priors.rotation_information.copy()
        gradient = priors.rotation_information @ log_so3(R @ priors.rotation.T)
        for i in range(observations.shape[0]):
            if not valid[i]:
                continue
            o = observations[i]
            hx = R[0, 0] * o[9] + R[0, 1] * o[10] + R[0, 2] * o[11]
            hy = R[1, 0] * o[9] + R[1, 1] * o[10] + R[1, 2] * o[11]
            hz = R[2, 0] * o[9] + R[2, 1] * o[10] + R[2, 2] * o[11]
            dx, dy, dz = o[0] - hx, o[1] - hy, o[2] - hz
            w = weight / (1.0 + weight * (dx * dx + dy * dy + dz * dz) / scale2)
            # d(f_1 - h) = -theta x h: gradient -(h x (f_1 - h)), Hessian |h|^2 I - h h^T
            gradient[0] -= w * (hy * dz - hz * dy)
            gradient[1] -= w * (hz * dx - hx * dz)
            gradient[2] -= w * (hx * dy - hy * dx)
            hessian[0, 0] += w * (hy * hy + hz * hz)
            hessian[1, 1] += w * (hx * hx + hz * hz)
            hessian[2, 2] += w * (hx * hx + hy * hy)
            hessian[0, 1] -= w * hx * hy
            hessian[0, 2] -= w * hx * hz
            hessian[1, 2] -= w * hy * hz
        hessian[1, 0], hessian[2, 0], hessian[2, 1] = hessian[0, 1], hessian[0, 2], hessian[1, 2]
        # Rays that all coincide say nothing of the turn about them: a floor above the rounding.
        floor = 1e-9 * (1.0 + hessian[0, 0] + hessian[1, 1] + hessian[2, 2])
        for i in range(3):
            hessian[i, i] += floor
        information = hessian
        if not cholesky(hessian, factor):
            break
        step = newton_step(factor, gradient)
        R = exp_so3(step) @ R
        if np.abs(step).max() < 1e-7:
            break
    return R, information
