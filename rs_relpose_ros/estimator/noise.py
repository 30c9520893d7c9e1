"""Noise of the matches, from their residuals: most are good, some are worse."""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from rs_relpose_ros.compiled import kernel

Array = NDArray[np.float64]
Flags = NDArray[np.bool_]

# Matches of more noise than the rest: how many times as much, and their share to begin with.
WORSE = 3.0
FIRST_SHARE = 0.1
# What is told of the noise counts as so many matches; that all are good, as so many.
TOLD_MATCHES = 10.0
LIKELY_GOOD = 20.0
# Of expectation maximisation.
ROUNDS = 6
# Unknowns that residuals lose to the fit, as a rule: pose, and what is observable beyond it.
FITTED = 11
# Of a squared residual in variances: beyond it the exponential would overflow.
LARGEST = 700.0


@kernel
def noise_mixture(r: Array, use: Flags, told: float) -> tuple[Array, float]:
    """Weights (N,) of the matches in `use` and the noise [px] of good ones, by their residuals.

    Some tracks are worse than others: a share h has `WORSE` times the noise of the rest. Both are
    found by expectation maximisation; a match weighs as much as the mean of its inverse variance.
    The told sigma counts as ten matches.
    """
    weights = np.zeros(len(r))
    count, squares = 0, 0.0
    for i in range(len(r)):
        if use[i]:
            count += 1
            squares += r[i] * r[i]
            weights[i] = 1.0
    freedom = TOLD_MATCHES + max(count - FITTED, 0)
    variance = (TOLD_MATCHES * told * told + squares) / freedom
    share = FIRST_SHARE
    for _ in range(ROUNDS):
        squares, worse = 0.0, 0.0
        for i in range(len(r)):
            if use[i]:
                r2 = r[i] * r[i] / variance
                if not r2 < LARGEST:
                    r2 = LARGEST
                ratio = (share / (1.0 - share) / WORSE
                         * math.exp(0.5 * r2 * (1.0 - 1.0 / (WORSE * WORSE))))
                p = ratio / (1.0 + ratio)
                worse += p
                weights[i] = 1.0 - p * (1.0 - 1.0 / (WORSE * WORSE))
                squares += weights[i] * r[i] * r[i]
        variance = (TOLD_MATCHES * told * told + squares) / freedom
        share = (worse + 1.0) / (count + LIKELY_GOOD)
    return weights, math.sqrt(variance)
