"""Random sampling: draw, generate, score, keep the best few; the loop knows no geometry.

Matches come ordered by quality and the sampled set grows from the best ones to all of them, as in
PROSAC (Chum and Matas, CVPR 2005). The stopping rule is the usual one on the inlier ratio.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from rs_relpose_ros.compiled import kernel
from rs_relpose_ros.estimator.consensus import multi_scale_cost
from rs_relpose_ros.geometry.vectors import copy_matrix, dot
from rs_relpose_ros.solvers.solver import Knowledge, Sample, Solutions, solve_at

Array = NDArray[np.float64]


class Matches(NamedTuple):
    """What is sampled, and how hypotheses are ranked.

    `points` (6, N), `threshold2` (3,): as in `consensus.multi_scale_cost`. `order` (M,): usable
    matches, best first.
    """

    points: Array
    order: NDArray[np.int64]
    threshold2: Array


class Stop(NamedTuple):
    """Probability of an outlier-free sample, or number of samples, at which sampling stops."""

    confidence: float
    max_samples: int


class Pool(NamedTuple):
    """The best distinct hypotheses so far: R (K, 3, 3), x (K, 9), cost (K,), infinite if none."""

    R: Array
    x: Array
    cost: Array


def empty_pool(size: int) -> Pool:
    """Room for the `size` best hypotheses."""
    return Pool(np.zeros((size, 3, 3)), np.zeros((size, 9)), np.full(size, np.inf))


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
def _gather(points: Array, chosen: NDArray[np.int64], sample: Sample) -> bool:
    """Write unit rays and row times of the chosen matches; False where one cannot be drawn."""
    for k in range(chosen.shape[0]):
        i = chosen[k]
        x1, y1, x2, y2 = points[0, i], points[1, i], points[2, i], points[3, i]
        if math.isnan(x1):
            return False
        s1 = 1.0 / math.sqrt(1.0 + x1 * x1 + y1 * y1)
        s2 = 1.0 / math.sqrt(1.0 + x2 * x2 + y2 * y2)
        sample.f1[k, 0], sample.f1[k, 1], sample.f1[k, 2] = x1 * s1, y1 * s1, s1
        sample.f2[k, 0], sample.f2[k, 1], sample.f2[k, 2] = x2 * s2, y2 * s2, s2
        sample.tau1[k], sample.tau2[k] = points[4, i], points[5, i]
    return True


@kernel
def _same(Ra: Array, xa: Array, Rb: Array, xb: Array) -> bool:
    """Whether two hypotheses are one: R within 0.01 rad, the direction of t within 0.1 rad."""
    trace = 0.0
    for i in range(3):
        for j in range(3):
            trace += Ra[i, j] * Rb[i, j]
    if trace < 3.0 - 0.01 * 0.01:
        return False
    return abs(dot(xa, xb)) > 1.0 - 0.5 * 0.1 * 0.1


@kernel
def _worst(pool: Pool) -> int:
    """Place of the most expensive hypothesis, or the first that is free."""
    worst = 0
    for k in range(1, len(pool.cost)):
        if pool.cost[k] > pool.cost[worst]:
            worst = k
    return worst


@kernel
def _offer(R: Array, x: Array, cost: float, pool: Pool) -> None:
    """Put a hypothesis into the pool in place of its like or of the worst, if it is better."""
    place = -1
    for k in range(pool.cost.shape[0]):
        if pool.cost[k] < math.inf and _same(R, x, pool.R[k], pool.x[k]):
            place = k
            break
    if place < 0:
        place = _worst(pool)
    if cost < pool.cost[place]:
        copy_matrix(R, pool.R[place])
        for i in range(9):
            pool.x[place, i] = x[i]
        pool.cost[place] = cost


@kernel
def sample_hypotheses(solver: int, size: int, matches: Matches, known: Knowledge, stop: Stop,
                      drawn: int, block: int, best_inliers: int, out: Solutions, pool: Pool,
                      seed: NDArray[np.uint64]) -> tuple[int, int]:
    """Draw samples for one solver and fill the pool.

    Parameters
    ----------
    solver, size : int
        Address of its kernel, and matches of a sample.
    drawn, block : int
        Samples drawn by an earlier call, and most samples of this one.
    best_inliers : int
        Inliers of the best hypothesis of the pool: the stopping rule starts from there.
    out : Solutions
        Room for the solutions of one sample.
    pool : Pool
        Updated in place.

    Returns
    -------
    samples, inliers : int
        Samples drawn so far, and the inliers (middle scale) of the best hypothesis.
    """
    usable = matches.order.shape[0]
    if usable < size:
        return drawn, best_inliers
    chosen = np.empty(size, dtype=np.int64)
    sample = Sample(np.empty((size, 3)), np.empty((size, 3)), np.empty(size), np.empty(size))
    needed = float(stop.max_samples)
    last = min(drawn + block, stop.max_samples)
    # Minimal sets are noisy: an outlier-free one is not yet an accurate one.
    least = min(40, stop.max_samples)
    best = math.inf
    for cost in pool.cost:
        best = min(best, cost)
    if best < math.inf:
        needed = samples_needed(best_inliers / usable, size, stop)
    while drawn < last and (drawn < least or drawn < needed):
        # The set grows to all matches over 100 samples.
        head = min(usable, max(2 * size, (usable * (drawn + 1)) // 100))
        draw(matches.order, head, chosen, seed)
        drawn += 1
        if not _gather(matches.points, chosen, sample):
            continue
        out.x[:] = 0.0
        count = solve_at(solver, sample, known, out)
        for k in range(count):
            limit = pool.cost[_worst(pool)]
            cost, inliers = multi_scale_cost(matches.points, out.R[k], out.x[k],
                                             matches.threshold2, limit)
            if cost < limit:
                _offer(out.R[k], out.x[k], cost, pool)
                if cost < best:
                    best = cost
                    best_inliers = inliers
                    needed = samples_needed(inliers / usable, size, stop)
    return drawn, best_inliers


@kernel
def samples_needed(ratio: float, size: int, stop: Stop) -> float:
    """Samples after which one is free of outliers with the probability that is asked for."""
    good = ratio**size
    if good >= 1.0 - 1e-12:
        return 1.0
    if good <= 1e-12:
        return float(stop.max_samples)
    return min(math.log(1.0 - stop.confidence) / math.log(1.0 - good), float(stop.max_samples))
