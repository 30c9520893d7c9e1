"""Robust losses of residuals, each with one definition, and the noise that residuals show.

A loss depends on the square q of a residual over the square of its scale. Its cost is close to q
for small q, and its weight is the derivative of the cost by q. Kernels use the functions of one
number; the same functions accept arrays outside of kernels.
"""

import math

import numpy as np
from numpy.typing import NDArray

from rs_relpose_ros.geometry import Array, so3
from rs_relpose_ros.jit import kernel, small_kernel

Flags = NDArray[np.bool_]


@small_kernel
def cauchy_weight(q: float | Array) -> float | Array:
    """Weight ``1 / (1 + q)``: one half at the scale."""
    return 1.0 / (1.0 + q)


@small_kernel
def cauchy_cost(q: float | Array) -> float | Array:
    """Cost ``log(1 + q)``: it grows without bound, but slowly."""
    return np.log(1.0 + q)


@small_kernel
def geman_mcclure_weight(q: float | Array) -> float | Array:
    """Weight ``1 / (1 + q)^2``: a quarter at the scale."""
    level = 1.0 / (1.0 + q)
    return level * level


@small_kernel
def geman_mcclure_cost(q: float | Array) -> float | Array:
    """Cost ``q / (1 + q)``: at most 1, however large the residual is."""
    return q / (1.0 + q)


@small_kernel
def truncated_cost(square: float, limit: float) -> float:
    """Cost ``min(r^2, limit)`` of MSAC (Torr and Zisserman, CVIU 78, 2000); `limit` for NaN."""
    return square if square < limit else limit


# Standard deviation of normal deviates over the median of their absolute values.
# [derived: 1 / 0.6745, the quantile of the normal distribution at three quarters]
SIGMA_PER_MEDIAN = 1.4826


@kernel
def robust_scale(residuals: Array, floor: float, freedom: float) -> float:
    """Standard deviation of residuals (N,), free of NaN, by the median of their absolute values.

    `freedom` is the number of unknowns that were fitted to the residuals and made them smaller.
    The result is at least `floor`.
    """
    count = len(residuals)
    scale = SIGMA_PER_MEDIAN * so3.median(np.abs(residuals))
    left = max(count - freedom, 1.0)
    return max(scale * math.sqrt(count / left), floor)


# -- Mixture of two variances ---------------------------------------------------------------------

# Noise of the worse matches over the noise of the good ones.
# [chosen: the tail of a tracker's errors; a value near 1 separates nothing, a value above 5 leaves
# matches of twice the noise among the good ones]
WORSE = 3.0
# Share of worse matches before the first iteration. Six iterations forget it.
# [chosen: any value in 0.02..0.3 would do]
FIRST_SHARE = 0.1
# The configured noise counts as much as so many matches. More of them would hide noise that
# differs from the configured noise; fewer would make the noise of a dozen matches arbitrary.
# [chosen: few against the hundred matches of a pair]
PRIOR_MATCHES = 10.0
# So many good matches are added to the observed matches when the share of worse matches is
# estimated. They keep the share small where a pair has few matches.
# [chosen: few against the hundred matches of a pair]
LIKELY_GOOD = 20.0
# Iterations of expectation maximisation: one pass over the matches each.
# [chosen: enough to forget the first share; the next fit starts from the noise again]
EM_ROUNDS = 6
# Degrees of freedom that the residuals of a pair lose to its fit. [derived: five of the pose and
# six of the velocities]
FITTED = 11
# Largest squared residual, in variances, whose exponential is evaluated; beyond it, the
# exponential would overflow. [derived: log of the largest double is 709]
LARGEST = 700.0


@kernel
def noise_mixture(residuals: Array, use: Flags, configured: float) -> tuple[Array, float]:
    """Weights (N,) of the matches in `use`, and the noise [px] of the good ones.

    Some tracks are worse than others: a share of them has `WORSE` times the noise of the rest.
    Share and noise are found by expectation maximisation. The weight of a match is the mean of
    its inverse variance over the two cases. The `configured` noise [px] counts as ten matches.
    """
    weights = np.zeros(len(residuals))
    count = 0
    squares = 0.0
    for i in range(len(residuals)):
        if use[i]:
            count += 1
            squares += residuals[i] * residuals[i]
            weights[i] = 1.0
    freedom = PRIOR_MATCHES + max(count - FITTED, 0)
    variance = (PRIOR_MATCHES * configured * configured + squares) / freedom
    share = FIRST_SHARE
    less_weight = 1.0 - 1.0 / (WORSE * WORSE)
    for _ in range(EM_ROUNDS):
        squares = 0.0
        worse = 0.0
        for i in range(len(residuals)):
            if not use[i]:
                continue
            square = residuals[i] * residuals[i]
            q = square / variance
            if not q < LARGEST:  # NaN counts as large
                q = LARGEST
            likelihood_ratio = math.exp(0.5 * q * less_weight)
            ratio = share / (1.0 - share) / WORSE * likelihood_ratio
            probability = ratio / (1.0 + ratio)
            worse += probability
            weights[i] = 1.0 - probability * less_weight
            squares += weights[i] * residuals[i] * residuals[i]
        variance = (PRIOR_MATCHES * configured * configured + squares) / freedom
        share = (worse + 1.0) / (count + LIKELY_GOOD)
    return weights, math.sqrt(variance)
