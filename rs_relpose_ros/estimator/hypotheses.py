"""Hypothesis generators: minimal samples to (R, t, d_1, d_2), by number, for compiled loops."""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from rs_relpose_ros.compiled import kernel
from rs_relpose_ros.solvers.eleven_point import uniform_11pt_kernel
from rs_relpose_ros.solvers.five_point import five_point_kernel
from rs_relpose_ros.solvers.nine_point import uniform_9pt_kernel
from rs_relpose_ros.solvers.three_point import angular_3pt_kernel

Array = NDArray[np.float64]

GYRO_2PT, ANGULAR_3PT, ANGULAR_5PT, UNIFORM_9PT, UNIFORM_11PT = range(5)
SAMPLE_SIZES = np.array([2, 3, 5, 9, 11])
MAX_SOLUTIONS = 12


class Hypotheses(NamedTuple):
    """Rotations R (K, 3, 3), and x (K, 9): ``t`` (unit), ``d_1, d_2`` up to a common sign."""

    R: Array
    x: Array


class Knowledge(NamedTuple):
    """What the IMU gives to the generators: gravity-aligning rotations, predicted rotation.

    `predicted`: whether `rotation` comes from the gyro; else the 11-point starts from 5 points.
    """

    align1: Array
    align2: Array
    rotation: Array
    predicted: bool


@kernel
def _gyro_2pt(f1: Array, f2: Array, rotation: Array, R_out: Array, x_out: Array) -> int:
    """The gyro's rotation, and t perpendicular to both normals ``n = f_1 x R f_2``."""
    n = np.empty((2, 3))
    for i in range(2):
        hx = rotation[0, 0] * f2[i, 0] + rotation[0, 1] * f2[i, 1] + rotation[0, 2] * f2[i, 2]
        hy = rotation[1, 0] * f2[i, 0] + rotation[1, 1] * f2[i, 1] + rotation[1, 2] * f2[i, 2]
        hz = rotation[2, 0] * f2[i, 0] + rotation[2, 1] * f2[i, 1] + rotation[2, 2] * f2[i, 2]
        n[i, 0] = f1[i, 1] * hz - f1[i, 2] * hy
        n[i, 1] = f1[i, 2] * hx - f1[i, 0] * hz
        n[i, 2] = f1[i, 0] * hy - f1[i, 1] * hx
    tx = n[0, 1] * n[1, 2] - n[0, 2] * n[1, 1]
    ty = n[0, 2] * n[1, 0] - n[0, 0] * n[1, 2]
    tz = n[0, 0] * n[1, 1] - n[0, 1] * n[1, 0]
    norm = math.sqrt(tx * tx + ty * ty + tz * tz)
    if not norm > 1e-14:
        return 0
    R_out[0] = rotation
    x_out[0] = 0.0
    x_out[0, 0], x_out[0, 1], x_out[0, 2] = tx / norm, ty / norm, tz / norm
    return 1


@kernel
def _uniform_11pt(f1: Array, f2: Array, tau1: Array, tau2: Array, knowledge: Knowledge,
                  R_out: Array, x_out: Array) -> int:
    """The 11-point's solutions from the gyro's rotation, or from those of its first 5 points."""
    starts = 1
    R_start = np.empty((MAX_SOLUTIONS, 3, 3))
    R_start[0] = knowledge.rotation
    if not knowledge.predicted:
        starts = five_point_kernel(f1[:5], f2[:5], R_start, x_out[:, :3].copy())
    count = 0
    for k in range(starts):
        if uniform_11pt_kernel(f1, f2, tau1, tau2, R_start[k], R_out[count], x_out[count]):
            count += 1
    return count


@kernel
def generate(generator: int, points: Array, sample: NDArray[np.int64], knowledge: Knowledge,
             R_out: Array, x_out: Array) -> int:
    """Hypotheses of one minimal sample; their number.

    Parameters
    ----------
    points : (6, N) ndarray
        As in `consensus.multi_scale_cost`.
    R_out, x_out : (MAX_SOLUTIONS, 3, 3), (MAX_SOLUTIONS, 9) ndarray
        Receive R and ``(t, d_1, d_2)``, t of unit length, all in frame 1.
    """
    m = sample.shape[0]
    f1, f2 = np.empty((m, 3)), np.empty((m, 3))
    tau1, tau2 = np.empty(m), np.empty(m)
    for k in range(m):
        i = sample[k]
        x1, y1, x2, y2 = points[0, i], points[1, i], points[2, i], points[3, i]
        if math.isnan(x1):
            return 0
        s1 = 1.0 / math.sqrt(1.0 + x1 * x1 + y1 * y1)
        s2 = 1.0 / math.sqrt(1.0 + x2 * x2 + y2 * y2)
        f1[k, 0], f1[k, 1], f1[k, 2] = x1 * s1, y1 * s1, s1
        f2[k, 0], f2[k, 1], f2[k, 2] = x2 * s2, y2 * s2, s2
        tau1[k], tau2[k] = points[4, i], points[5, i]
    if generator == GYRO_2PT:
        return _gyro_2pt(f1, f2, knowledge.rotation, R_out, x_out)
    x_out[:] = 0.0
    if generator == ANGULAR_3PT:
        return angular_3pt_kernel(f1, f2, knowledge.align1, knowledge.align2, R_out, x_out)
    if generator == ANGULAR_5PT:
        return five_point_kernel(f1, f2, R_out, x_out)
    if generator == UNIFORM_9PT:
        return uniform_9pt_kernel(f1, f2, tau1, tau2, knowledge.align1, knowledge.align2, R_out,
                                  x_out)
    return _uniform_11pt(f1, f2, tau1, tau2, knowledge, R_out, x_out)
