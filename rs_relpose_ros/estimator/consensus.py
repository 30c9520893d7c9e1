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

import numpy as np
from numpy.typing import NDArray

from rs_relpose_ros.compiled import kernel

Array = NDArray[np.float64]

# Multiples of the inlier threshold. The widest still rejects 19 of 20 random matches.
SCALES = np.array([1.0, 4.0, 12.0])
# Matches that are scored before the next look at the limit.
BLOCK = 64


@kernel
def multi_scale_cost(points: Array, R: Array, x: Array, threshold2: Array,
                     limit: float) -> tuple[float, int]:
    """Sum over matches and scales of ``min(r^2 / T^2, 1)``, and the inliers of the middle scale.

    Parameters
    ----------
    points : (6, N) ndarray
        ``x_1, y_1, x_2, y_2`` of the derotated rays at z = 1, ``tau_1, tau_2`` [s]; a match that
        cannot be drawn there holds NaN.
    R : (3, 3) ndarray
    x : (9,) ndarray
        ``t, d_1, d_2`` in frame 1.
    threshold2 : (3,) ndarray
        Squared thresholds, ascending, in units of the z = 1 plane.
    limit : float
        The sum is given up, as infinite, once it exceeds this.
    """
    # Essential matrices of t, -d_1 and d_2: that of a match is E_0 + tau_1 E_1 + tau_2 E_2.
    E = np.empty((3, 3, 3))
    for k in range(3):
        sign = -1.0 if k == 1 else 1.0
        bx, by, bz = sign * x[3 * k], sign * x[3 * k + 1], sign * x[3 * k + 2]
        for j in range(3):
            E[k, 0, j] = by * R[2, j] - bz * R[1, j]
            E[k, 1, j] = bz * R[0, j] - bx * R[2, j]
            E[k, 2, j] = bx * R[1, j] - by * R[0, j]
    narrow, middle, wide = 1.0 / threshold2[0], 1.0 / threshold2[1], 1.0 / threshold2[2]
    n = points.shape[1]
    cost, inliers = 0.0, 0
    for first in range(0, n, BLOCK):
        for i in range(first, min(first + BLOCK, n)):
            x1, y1, x2, y2 = points[0, i], points[1, i], points[2, i], points[3, i]
            tau1, tau2 = points[4, i], points[5, i]
            e00 = E[0, 0, 0] + tau1 * E[1, 0, 0] + tau2 * E[2, 0, 0]
            e01 = E[0, 0, 1] + tau1 * E[1, 0, 1] + tau2 * E[2, 0, 1]
            e02 = E[0, 0, 2] + tau1 * E[1, 0, 2] + tau2 * E[2, 0, 2]
            e10 = E[0, 1, 0] + tau1 * E[1, 1, 0] + tau2 * E[2, 1, 0]
            e11 = E[0, 1, 1] + tau1 * E[1, 1, 1] + tau2 * E[2, 1, 1]
            e12 = E[0, 1, 2] + tau1 * E[1, 1, 2] + tau2 * E[2, 1, 2]
            e20 = E[0, 2, 0] + tau1 * E[1, 2, 0] + tau2 * E[2, 2, 0]
            e21 = E[0, 2, 1] + tau1 * E[1, 2, 1] + tau2 * E[2, 2, 1]
            e22 = E[0, 2, 2] + tau1 * E[1, 2, 2] + tau2 * E[2, 2, 2]
            # f_1^T [b]x R f_2: the constraint up to sign
            gx = e00 * x2 + e01 * y2 + e02
            gy = e10 * x2 + e11 * y2 + e12
            gz = e20 * x2 + e21 * y2 + e22
            kx = e00 * x1 + e10 * y1 + e20
            ky = e01 * x1 + e11 * y1 + e21
            value = x1 * gx + y1 * gy + gz
            r2 = value * value / (gx * gx + gy * gy + kx * kx + ky * ky + 1e-30)
            # Comparisons that NaN fails: it counts as an outlier.
            cost += r2 * narrow if r2 * narrow < 1.0 else 1.0
            cost += r2 * middle if r2 * middle < 1.0 else 1.0
            cost += r2 * wide if r2 * wide < 1.0 else 1.0
            inliers += 1 if r2 * middle < 1.0 else 0
        if cost > limit:
            return math.inf, 0
    return cost, inliers
