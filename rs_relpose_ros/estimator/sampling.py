"""Random sampling: draw, generate, score, keep the best few; the loop knows no geometry.

Matches come ordered by quality and the sampled set grows from the best ones to all of them, as in
PROSAC (Chum and Matas, CVPR 2005). The stopping rule is the usual one on the inlier ratio.
"""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from rs_relpose_ros.compiled import kernel
from rs_relpose_ros.estimator.consensus import multi_scale_cost
from rs_relpose_ros.estimator.hypotheses import generate, Knowledge, MAX_SOLUTIONS, SAMPLE_SIZES

Array = NDArray[np.float64]

POOL = 6
# Samples over which the set grows to all matches.
GROWTH = 100
# Samples of noisy minimal sets: an outlier-free one is not yet an accurate one.
MIN_SAMPLES = 40
# Hypotheses closer than this are one: R [rad], direction of t [rad].
SAME_ROTATION = 0.01
SAME_DIRECTION = 0.1


@kernel
def _random(state: NDArray[np.uint64]) -> np.uint64:
    """Next number of splitmix64 (Steele et al., OOPSLA 2014): the state is one word."""
    state[0] += np.uint64(0x9E3779B97F4A7C15)
    z = state[0]
    z = (z ^ (z >> np.uint64(30))) * np.uint64(0xBF58476D1CE4E5B9)
    z = (z ^ (z >> np.uint64(27))) * np.uint64(0x94D049BB133111EB)
    return z ^ (z >> np.uint64(31))


@kernel
def draw(order: NDArray[np.int64], head: int, sample: NDArray[np.int64],
         state: NDArray[np.uint64]) -> None:
    """Fill `sample` with distinct entries of ``order[:head]``."""
    for k in range(sample.shape[0]):
        while True:
            candidate = order[np.int64(_random(state) % np.uint64(head))]
            repeated = False
            for j in range(k):
                if sample[j] == candidate:
                    repeated = True
            if not repeated:
                break
        sample[k] = candidate


@kernel
def _same(Ra: Array, xa: Array, Rb: Array, xb: Array) -> bool:
    trace = 0.0
    for i in range(3):
        for j in range(3):
            trace += Ra[i, j] * Rb[i, j]
    if trace < 3.0 - SAME_ROTATION * SAME_ROTATION:
        return False
    dot = xa[0] * xb[0] + xa[1] * xb[1] + xa[2] * xb[2]
    return abs(dot) > 1.0 - 0.5 * SAME_DIRECTION * SAME_DIRECTION


@kernel
def _offer(R: Array, x: Array, cost: float, pool_R: Array, pool_x: Array,
           pool_cost: Array) -> None:
    """Put a hypothesis into the pool in place of its like or of the worst, if it is better."""
    place = -1
    for k in range(pool_cost.shape[0]):
        if pool_cost[k] < math.inf and _same(R, x, pool_R[k], pool_x[k]):
            place = k
            break
    if place < 0:
        place = int(np.argmax(pool_cost))
    if cost < pool_cost[place]:
        pool_R[place] = R
        pool_x[place] = x
        pool_cost[place] = cost


@kernel
def sample_hypotheses(generator: int, points: Array, knowledge: Knowledge,
                      order: NDArray[np.int64], seed: NDArray[np.uint64], threshold2: Array,
                      confidence: float, max_samples: int, best_inliers: int, pool_R: Array,
                      pool_x: Array, pool_cost: Array) -> tuple[int, int]:
    """Draw samples for one generator and fill the pool.

    Parameters
    ----------
    order : (M,) ndarray of int64
        Usable matches, best first.
    best_inliers : int
        Inliers that an earlier generator reached: the stopping rule starts from there.
    pool_R, pool_x, pool_cost : (K, 3, 3), (K, 9), (K,) ndarray
        Best distinct hypotheses so far, updated in place.

    Returns
    -------
    samples, inliers : int
        Samples drawn, and the inliers (middle scale) of the best hypothesis.
    """
    size = SAMPLE_SIZES[generator]
    usable = order.shape[0]
    if usable < size:
        return 0, best_inliers
    sample = np.empty(size, dtype=np.int64)
    R_out = np.empty((MAX_SOLUTIONS, 3, 3))
    x_out = np.empty((MAX_SOLUTIONS, 9))
    needed = float(max_samples)
    drawn = 0
    least = min(MIN_SAMPLES, max_samples)
    best = pool_cost.min()
    if best < math.inf:
        needed = samples_needed(best_inliers / usable, size, confidence, max_samples)
    while drawn < max_samples and (drawn < least or drawn < needed):
        head = min(usable, max(2 * size, (usable * (drawn + 1)) // GROWTH))
        draw(order, head, sample, seed)
        drawn += 1
        count = generate(generator, points, sample, knowledge, R_out, x_out)
        for k in range(count):
            limit = pool_cost.max()
            cost, inliers = multi_scale_cost(points, R_out[k], x_out[k], threshold2, limit)
            if cost < limit:
                _offer(R_out[k], x_out[k], cost, pool_R, pool_x, pool_cost)
                if cost < best:
                    best = cost
                    best_inliers = inliers
                    needed = samples_needed(inliers / usable, size, confidence, max_samples)
    return drawn, best_inliers


@kernel
def samples_needed(ratio: float, size: int, confidence: float, max_samples: int) -> float:
    """Samples after which one is free of outliers with probability `confidence`."""
    good = ratio**size
    if good >= 1.0 - 1e-12:
        return 1.0
    if good <= 1e-12:
        return float(max_samples)
    return min(math.log(1.0 - confidence) / math.log(1.0 - good), float(max_samples))
