"""The nine columns of the uniform and linear models, well conditioned.

A row of the paper's ``A x = 0`` is ``[n, -tau_1 n, tau_2 n]`` with ``n = f_1 x R f_2`` and
``x = (t, d_1, d_2)`` (docs/conventions.md, equation 4). Matched points lie in similar rows, and
row times are 1e-2 s: as they stand, the three blocks are nearly parallel and badly scaled. The
kernels therefore use

    t - tau_1 d_1 + tau_2 d_2 = y_1 + p y_2 + q y_3
    p = (tau_1 - m) / s_p,    q = (tau_2 - tau_1) / s_q

with the mean row time m and p, q of size 1; the two sets of columns span the same space for every
rotation, so that determinants differ by a constant factor and solutions by the linear map below.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from rs_relpose_ros.compiled import kernel
from rs_relpose_ros.solvers.solver import Sample

Array = NDArray[np.float64]


class RowTimeFactors(NamedTuple):
    """p, q (n,), the mean row time m [s] and the scales s_p, s_q [s].

    `observable` is False where the row times do not differ: velocities are then not seen.
    """

    p: Array
    q: Array
    m: float
    s_p: float
    s_q: float
    observable: bool


@kernel
def row_time_factors(sample: Sample) -> RowTimeFactors:
    """Factors of a sample; p and q are not scaled where velocities are not observable."""
    tau1, tau2 = sample.tau1, sample.tau2
    n = tau1.shape[0]
    m = 0.0
    for k in range(n):
        m += tau1[k] / n
    p, q = np.empty(n), np.empty(n)
    s_p, s_q = 0.0, 0.0
    for k in range(n):
        p[k] = tau1[k] - m
        q[k] = tau2[k] - tau1[k]
        s_p = max(s_p, abs(p[k]))
        s_q = max(s_q, abs(q[k]))
    # Row times closer than this [s] cannot tell a velocity from a translation.
    least = 1e-12
    observable = least < s_p < math.inf and least < s_q < math.inf
    if observable:
        for k in range(n):
            p[k] /= s_p
            q[k] /= s_q
    return RowTimeFactors(p, q, m, s_p, s_q, observable)


@kernel
def translation_and_velocities(y: Array, factors: RowTimeFactors, x: Array) -> bool:
    """``x = (t, d_1, d_2)`` with ``|t| = 1`` from `y` (9,); False where t vanishes."""
    norm2 = 0.0
    for i in range(3):
        difference = y[3 + i] / factors.s_p  # d_2 - d_1
        x[6 + i] = y[6 + i] / factors.s_q
        x[3 + i] = x[6 + i] - difference
        x[i] = y[i] - factors.m * difference
        norm2 += x[i] * x[i]
    # |y| = 1: a translation of this size is rounding.
    if not norm2 > 1e-20:
        return False
    scale = 1.0 / math.sqrt(norm2)
    for i in range(9):
        x[i] *= scale
    return True
