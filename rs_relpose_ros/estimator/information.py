"""Information matrices, inverses of covariances: badly scaled, but never indefinite."""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from rs_relpose_ros.compiled import kernel, linked_kernel
from rs_relpose_ros.solvers.linear_algebra import cholesky

Array = NDArray[np.float64]


@linked_kernel
def _scaled_factor(information: Array) -> tuple[Array, Array]:
    """Scales (n,) that make the diagonal 1, and the Cholesky factor of the matrix so scaled.

    A floor of rounding on the diagonal keeps it positive definite, however badly conditioned.
    """
    n = information.shape[0]
    scale = np.empty(n)
    for i in range(n):
        scale[i] = 1.0 / math.sqrt(max(information[i, i], 1e-30))
    scaled, factor = np.empty((n, n)), np.zeros((n, n))
    for i in range(n):
        for j in range(n):
            scaled[i, j] = information[i, j] * scale[j] * scale[i]
        scaled[i, i] += 1e-13
    if not cholesky(scaled, factor):
        factor[:] = np.nan
    return scale, factor


@linked_kernel
def inverse(information: Array) -> Array:
    """Covariance (n, n) of an information matrix, or the other way round.

    Bit-equal on any number of threads, which those of NumPy are not from n = 6 on.
    """
    scale, factor = _scaled_factor(information)
    n = len(scale)
    rows = np.zeros((n, n))
    for j in range(n):   # the inverse of the factor, column by column
        rows[j, j] = 1.0 / factor[j, j]
        for i in range(j + 1, n):
            value = 0.0
            for k in range(j, i):
                value -= factor[i, k] * rows[k, j]
            rows[i, j] = value / factor[i, i]
    for i in range(n):
        for j in range(n):
            rows[i, j] *= scale[j]
    return rows.T @ rows


@kernel
def log_determinant(information: Array) -> float:
    """Log-determinant of a positive definite matrix."""
    scale, factor = _scaled_factor(information)
    value = 0.0
    for i in range(len(scale)):
        value += 2.0 * math.log(factor[i, i] / scale[i])
    return value
