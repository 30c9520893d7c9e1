"""Scoring of hypotheses: truncated Sampson errors at several scales, on normalised points.

Hypotheses are ranked with the Sampson error in the derotated normalised plane (one focal length
for all pixels, no derivative of the distortion): a tenth of the cost of the exact error of
`sampson`, which every later step uses. Points behind that plane count as outliers here.

With 10 m/s during the read-out the angular model leaves 20 px at true inliers, so a single
narrow threshold would throw good rotations away: the cost is the mean of MSAC costs at growing
thresholds.
"""

from __future__ import annotations

import math

import numba
import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]

# Multiples of the inlier threshold. The widest still rejects 19 of 20 random matches.
SCALES = np.array([1.0, 4.0, 12.0])

_jit = numba.njit(cache=True, nogil=True, error_model='numpy')


@_jit
def multi_scale_cost(points: Array, R: Array, x: Array, threshold2: Array,
                     limit: float) -> tuple[float, int]:
    """Sum over matches and scales of ``min(r^2 / T^2, 1)``, and the inliers of the middle scale.

    Parameters
    ----------
    points : (N, 6) ndarray
        ``x_1, y_1, x_2, y_2`` of the derotated rays at z = 1, ``tau_1, tau_2`` [s]; a match that
        cannot be drawn there holds NaN.
    R : (3, 3) ndarray
    x : (9,) ndarray
        ``t, d_1, d_2`` in frame 1.
    threshold2 : (S,) ndarray
        Squared thresholds, ascending, in units of the z = 1 plane.
    limit : float
        The sum is given up, as infinite, once it exceeds this.
    """
    still = True
    for k in range(3, 9):
        if x[k] != 0.0:
            still = False
    scales = threshold2.shape[0]
    middle = threshold2[scales // 2]
    widest = threshold2[scales - 1]
    cost = 0.0
    inliers = 0
    bx, by, bz = x[0], x[1], x[2]
    e00 = by * R[2, 0] - bz * R[1, 0]
    e01 = by * R[2, 1] - bz * R[1, 1]
    e02 = by * R[2, 2] - bz * R[1, 2]
    e10 = bz * R[0, 0] - bx * R[2, 0]
    e11 = bz * R[0, 1] - bx * R[2, 1]
    e12 = bz * R[0, 2] - bx * R[2, 2]
    e20 = bx * R[1, 0] - by * R[0, 0]
    e21 = bx * R[1, 1] - by * R[0, 1]
    e22 = bx * R[1, 2] - by * R[0, 2]
    for i in range(points.shape[0]):
        x1, y1, x2, y2 = points[i, 0], points[i, 1], points[i, 2], points[i, 3]
        if not still:
            tau1, tau2 = points[i, 4], points[i, 5]
            bx = x[0] - tau1 * x[3] + tau2 * x[6]
            by = x[1] - tau1 * x[4] + tau2 * x[7]
            bz = x[2] - tau1 * x[5] + tau2 * x[8]
            e00 = by * R[2, 0] - bz * R[1, 0]
            e01 = by * R[2, 1] - bz * R[1, 1]
            e02 = by * R[2, 2] - bz * R[1, 2]
            e10 = bz * R[0, 0] - bx * R[2, 0]
            e11 = bz * R[0, 1] - bx * R[2, 1]
            e12 = bz * R[0, 2] - bx * R[2, 2]
            e20 = bx * R[1, 0] - by * R[0, 0]
            e21 = bx * R[1, 1] - by * R[0, 1]
            e22 = bx * R[1, 2] - by * R[0, 2]
        # f_1^T [b]x R f_2: the constraint up to sign
        gx = e00 * x2 + e01 * y2 + e02
        gy = e10 * x2 + e11 * y2 + e12
        gz = e20 * x2 + e21 * y2 + e22
        kx = e00 * x1 + e10 * y1 + e20
        ky = e01 * x1 + e11 * y1 + e21
        value = x1 * gx + y1 * gy + gz
        r2 = value * value / (gx * gx + gy * gy + kx * kx + ky * ky + 1e-30)
        if r2 < widest:
            for s in range(scales):
                cost += min(r2 / threshold2[s], 1.0)
            if r2 < middle:
                inliers += 1
        else:   # NaN lands here
            cost += scales
        if cost > limit:
            return math.inf, 0
    return cost, inliers
