"""Least squares on arrays: factors of matrices, damped steps, elimination, covariance by groups.

Loops of Newton, Gauss-Newton and Levenberg-Marquardt stay beside their problems, since a kernel
that takes another kernel as an argument is compiled in each process. What they repeat is here.

`hessian` is the matrix ``H = J^T W J`` of the normal equations plus the information of the priors,
`gradient` is half the gradient of the cost, ``J^T W r``.
"""

import itertools
import math

import numpy as np

from rs_relpose_ros.geometry import Array
from rs_relpose_ros.jit import kernel


def first_indices(**sizes: int) -> dict[str, int]:
    """Index of the first entry of each named part of a vector, and of its `end`.

    >>> first_indices(position=3, angle=1)
    {'position': 0, 'angle': 3, 'end': 4}
    """
    first = dict.fromkeys((*sizes, 'end'), 0)
    for before, name in itertools.pairwise(list(first)):
        first[name] = first[before] + sizes[before]
    return first


def slices(**sizes: int) -> dict[str, slice]:
    """Places of each named part of a vector.

    >>> slices(position=3, angle=1)
    {'position': slice(0, 3, None), 'angle': slice(3, 4, None)}
    """
    first = first_indices(**sizes)
    return {name: slice(first[name], first[name] + size) for name, size in sizes.items()}


# -- One matrix -----------------------------------------------------------------------------------


@kernel
def cholesky(matrix: Array, factor: Array) -> bool:
    """Write the lower Cholesky factor of a symmetric matrix; False unless positive definite."""
    n = matrix.shape[0]
    for i in range(n):
        for j in range(i + 1):
            value = matrix[i, j]
            for k in range(j):
                value -= factor[i, k] * factor[j, k]
            if i == j:
                if not value > 0.0:
                    return False
                factor[i, i] = math.sqrt(value)
            else:
                factor[i, j] = value / factor[j, j]
    return True


@kernel
def newton_step(factor: Array, gradient: Array) -> Array:
    """Solve ``L L^T x = -gradient`` with the Cholesky factor L."""
    n = gradient.shape[0]
    x = np.empty(n)
    for i in range(n):
        x[i] = -gradient[i]
    for i in range(n):
        for k in range(i):
            x[i] -= factor[i, k] * x[k]
        x[i] /= factor[i, i]
    for i in range(n - 1, -1, -1):
        for k in range(i + 1, n):
            x[i] -= factor[k, i] * x[k]
        x[i] /= factor[i, i]
    return x


# Constant on the diagonal of a damped matrix: an unknown without any information stays where it
# is. [chosen: far below the information of any unknown, any value in 1e-20..1e-8 would do]
LEAST_INFORMATION = 1e-12


@kernel
def damped_step(hessian: Array, gradient: Array, damping: float) -> tuple[Array, float]:
    """Step (n,) of Levenberg-Marquardt, and the gain in cost that it expects.

    `damping` is a share of the diagonal, which makes the step independent of units. Without it
    the expected gain is Newton's decrement. The gain is negative, and the step is zero, if the
    damped matrix is not positive definite.
    """
    n = len(gradient)
    damped = hessian.copy()
    factor = np.zeros((n, n))
    for i in range(n):
        damped[i, i] += damping * hessian[i, i] + LEAST_INFORMATION
    if not cholesky(damped, factor):
        return np.zeros(n), -1.0
    step = newton_step(factor, gradient)
    return step, -(gradient * step).sum()


# Information matrices (inverse covariances) are badly scaled, but never indefinite.

# Constant on the diagonal of a matrix that is scaled to a diagonal of 1. It keeps a singular
# matrix positive definite; a larger one would shrink real variances of badly conditioned matrices.
# [chosen: a thousand times the rounding of a product; any value in 1e-15..1e-12 would do]
ROUNDING = 1e-13


@kernel
def _scaled_factor(information: Array) -> tuple[Array, Array]:
    """Scales (n,) that make the diagonal 1, and the Cholesky factor of the matrix so scaled."""
    n = information.shape[0]
    scale = np.empty(n)
    for i in range(n):
        scale[i] = 1.0 / math.sqrt(max(information[i, i], 1e-30))
    scaled = np.empty((n, n))
    factor = np.zeros((n, n))
    for i in range(n):
        for j in range(n):
            scaled[i, j] = information[i, j] * scale[j] * scale[i]
        scaled[i, i] += ROUNDING
    if not cholesky(scaled, factor):
        factor[:] = np.nan
    return scale, factor


@kernel
def inverse(information: Array) -> Array:
    """Covariance (n, n) of an information matrix, or vice versa.

    The result is bit-equal on any number of threads, unlike NumPy's from n = 6 on.
    """
    scale, factor = _scaled_factor(information)
    n = len(scale)
    rows = np.zeros((n, n))
    for j in range(n):  # the inverse of the factor, column by column
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


@kernel
def eliminate(hessian: Array, gradient: Array, kept: int) -> tuple[Array, Array]:
    """Normal equations of the first `kept` unknowns, the other ones eliminated.

    Directions of the eliminated unknowns without information take none away.
    """
    mixed = hessian[:kept, kept:].copy()
    gain = mixed @ inverse(hessian[kept:, kept:].copy())
    reduced = hessian[:kept, :kept] - gain @ mixed.T
    symmetric = 0.5 * (reduced + reduced.T)
    return symmetric, gradient[:kept] - gain @ gradient[kept:]


# -- Groups of residuals with unknowns of their own -----------------------------------------------
#
# The unknowns of one group, such as a track or a pair, appear in the residuals of this group
# alone. Arrays have the groups last, so that the innermost loop runs over them and the compiler
# vectorises it.


@kernel
def factor_groups(own: Array, factors: Array) -> None:
    """Write Cholesky factors L (m, m, G) of the groups' matrices `own` (m, m, G).

    Only lower triangles are read and written. The diagonals receive the inverses of those of L.
    """
    m = own.shape[0]
    groups = own.shape[2]
    for i in range(m):
        for j in range(i + 1):
            value = factors[i, j]
            for g in range(groups):
                value[g] = own[i, j, g]
            for k in range(j):
                left = factors[i, k]
                right = factors[j, k]
                for g in range(groups):
                    value[g] -= left[g] * right[g]
            if i == j:
                for g in range(groups):
                    value[g] = 1.0 / math.sqrt(value[g])
            else:
                inverse_diagonal = factors[j, j]
                for g in range(groups):
                    value[g] *= inverse_diagonal[g]


@kernel
def solve_lower_groups(factors: Array, right: Array, out: Array) -> None:
    """Write ``L^-1 right`` of every group into `out`; both are (m, G)."""
    m, groups = right.shape
    for i in range(m):
        value = out[i]
        for g in range(groups):
            value[g] = right[i, g]
        for k in range(i):
            left = factors[i, k]
            known = out[k]
            for g in range(groups):
                value[g] -= left[g] * known[g]
        inverse_diagonal = factors[i, i]
        for g in range(groups):
            value[g] *= inverse_diagonal[g]


@kernel
def solve_upper_groups(factors: Array, values: Array) -> None:
    """Replace `values` (m, G) of every group by ``L^-T values``."""
    m, groups = values.shape
    for i in range(m - 1, -1, -1):
        value = values[i]
        for k in range(i + 1, m):
            left = factors[k, i]
            known = values[k]
            for g in range(groups):
                value[g] -= left[g] * known[g]
        inverse_diagonal = factors[i, i]
        for g in range(groups):
            value[g] *= inverse_diagonal[g]


# -- Covariance by groups of residuals ------------------------------------------------------------


# Shares `deleted` of `adjusted_scores`.
# Half of the influence of a group is taken out: unbiased if the model is right.
CR2 = 0.5
JACKKNIFE = 1.0  # the group is left out whole: never too small


@kernel
def adjusted_scores(scores: Array, curvatures: Array, hessian: Array, deleted: float) -> Array:
    """Gradients (G, n) of groups as they would be without the fit's adaptation to each group.

    From the gradient s_g (`scores` (G, n)) and the Hessian H_g (`curvatures` (G, n, n)) of each
    group, and the Hessian H of all groups and priors, with the share w = `deleted`::

        u_g = (1 - w) s_g + w (I - H_g H^-1)^-1 s_g

    The fit has adapted to each group, so that s_g is too small. The second term is the gradient
    there of a fit without the group, which is too large. For independent residuals w = `CR2` is
    right to first order in H_g (Bell and McCaffrey, Survey Methodology 28, 2002). With w =
    `JACKKNIFE` the optimum moves as far as without the group (CR3). A group without which the
    unknowns are not determined keeps s_g.
    """
    n = hessian.shape[0]
    adjusted = scores.copy()
    rest = np.empty((n, n))
    factor = np.zeros((n, n))
    for g in range(len(scores)):
        for i in range(n):
            for j in range(n):
                rest[i, j] = hessian[i, j] - curvatures[g, i, j]
        if cholesky(rest, factor):
            # (I - H_g H^-1)^-1 s = H (H - H_g)^-1 s
            without = hessian @ newton_step(factor, scores[g])
            for i in range(n):
                own = (1.0 - deleted) * scores[g, i]
                adjusted[g, i] = own - deleted * without[i]
    return adjusted
