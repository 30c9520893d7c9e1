"""Covariance of the calibration by leaving out one stretch of the recording after the other."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray
from scipy.stats import norm
from scipy.stats import t as student_t

Array = NDArray[np.float64]

# Stretches of a second, within which errors may be correlated as they like, and limits of their
# number.
_STRETCH = 1.0
_LEAST_STRETCHES, _MOST_STRETCHES = 10, 30


def stretches(times: Array) -> NDArray[np.int64]:
    """Stretch (P,) of the recording that each instant (P,) [s] belongs to."""
    begin, duration = times.min(), max(float(np.ptp(times)), 1e-9)
    count = int(np.clip(duration / _STRETCH, _LEAST_STRETCHES, _MOST_STRETCHES))
    return np.minimum(((times - begin) / duration * count).astype(np.int64), count - 1)


def jackknife(scores: Array, curvatures: Array, groups: NDArray[np.int64],
              prior: Array) -> Array:
    """Delete-a-group jackknife, each refit by one Newton step from the optimum.

    It counts whatever differs between the groups: noise of the points, that of tracks that live
    long, of the gyro, and movements that the model leaves out. Other than the sandwich estimate
    (the sum of the groups' squared scores), it does not take for agreement that the few groups
    have, together, been fitted by the parameters.

    `scores` (P, G) are the gradients of the cost at the optimum by pair, `curvatures` (P, G, G)
    their derivatives, `prior` (G,) inverse variances that count as known; returns (G, G). See
    B. Efron and R. Tibshirani, An Introduction to the Bootstrap, 1993, chapter 11.
    """
    total = curvatures.sum(axis=0) + np.diag(prior)
    names = np.unique(groups)
    moves = np.stack([
        np.linalg.pinv(total - curvatures[groups == name].sum(axis=0), hermitian=True)
        @ scores[groups == name].sum(axis=0) for name in names])
    inverse = np.linalg.pinv(total, hermitian=True)
    return np.asarray(jackknife_of(moves) + inverse @ np.diag(prior) @ inverse)


def jackknife_of(moves: Array) -> Array:
    """Covariance (G, G) from the moves (K, G) of the optimum without each of K groups."""
    count = len(moves)
    moves = moves - moves.mean(axis=0)
    # Few groups tell their own scatter roughly only, so that errors by sigma follow Student's t:
    # widened, one sigma covers what it does for a normal deviate.
    wider = student_t.ppf(norm.cdf(1.0), count - 1) ** 2
    return np.asarray(wider * (count - 1) / count * moves.T @ moves)
