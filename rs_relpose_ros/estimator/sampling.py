"""Hypotheses of a pair: random sampling, scoring, and local optimisation of the best few.

The sampled set grows from the matches of the highest quality to all of them, as in PROSAC (Chum
and Matas, CVPR 2005). The stopping rule is the usual one on the inlier ratio.
"""

from dataclasses import dataclass
import math
import time
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from rs_relpose_ros.config.settings import EstimatorConfig
from rs_relpose_ros.core.losses import (
    cauchy_cost,
    cauchy_weight,
    robust_scale,
    truncated_cost,
)
from rs_relpose_ros.estimator import priors, sampson
from rs_relpose_ros.estimator.fit import fit_rotation, gauss_newton, transfer_errors
from rs_relpose_ros.estimator.priors import Priors, TwoViewState
from rs_relpose_ros.estimator.problem import TwoViewProblem
from rs_relpose_ros.estimator.sampson import FitMatches, VIEW_1, VIEW_2
from rs_relpose_ros.geometry import Array, Flags, Indices, so3
from rs_relpose_ros.jit import inlined_kernel, kernel, small_kernel
from rs_relpose_ros.solvers import common
from rs_relpose_ros.solvers.api import GYRO_2PT, SOLVERS, UNIFORM
from rs_relpose_ros.solvers.common import Knowledge, Model, Sample, Solutions, Solver

# -- Scoring of hypotheses: truncated Sampson errors at several scales, on normalised points ------
#
# Hypotheses are ranked with the Sampson error in the derotated normalised plane (one focal length
# for all pixels, no derivative of the distortion): a tenth of the cost of the exact error of
# `sampson`, which every later step uses. Points behind that plane count as outliers here.
#
# At 10 m/s during the readout the angular model leaves 20 px at true inliers, so a single narrow
# threshold would discard good rotations: the cost is the mean of MSAC costs at growing thresholds.

# Multiples of the inlier threshold. The widest still rejects 19 of 20 random matches; without it,
# hypotheses of a fast camera would have no inliers. [chosen: above 20 px, which the angular model
# leaves, at a threshold of 2 px]
SCALES = np.array([1.0, 4.0, 12.0])
# Matches that are scored between two comparisons with the limit. More of them score bad hypotheses
# for longer, fewer compare too often. [chosen: any value in 32..128 would do]
BLOCK = 64

Seed = NDArray[np.uint64]


@inlined_kernel
def _essential_columns(b, R):  # type: ignore[no-untyped-def]
    """Columns of ``[b]x R``."""
    column_1 = so3.cross(b, so3.column(R, 0, 0))
    column_2 = so3.cross(b, so3.column(R, 0, 1))
    column_3 = so3.cross(b, so3.column(R, 0, 2))
    return column_1, column_2, column_3


@inlined_kernel
def _at_times(of_t, of_d1, of_d2, tau1, tau2):  # type: ignore[no-untyped-def]
    """Column of ``[t - tau_1 d_1 + tau_2 d_2]x R`` from the same column of t, -d_1 and d_2."""
    return so3.add(so3.add(of_t, so3.scale(tau1, of_d1)), so3.scale(tau2, of_d2))


@small_kernel
def multi_scale_cost(
    points: Array, R: Array, x: Array, threshold2: Array, limit: float
) -> tuple[float, int]:
    """Sum over matches and scales of ``min(r^2 / T^2, 1)``, and the inliers of the middle scale.

    `points` (6, N): ``x_1, y_1, x_2, y_2`` of the derotated rays at z = 1, ``tau_1, tau_2`` [s];
    NaN for a match behind that plane. `x` (9,): ``t, d_1, d_2`` in frame 1. `threshold2` (3,):
    squared thresholds, ascending, in units of the z = 1 plane. A sum above `limit` counts as
    infinite, and the rest of the matches is not scored.
    """
    t1, t2, t3 = _essential_columns((x[0], x[1], x[2]), R)
    u1, u2, u3 = _essential_columns((-x[3], -x[4], -x[5]), R)
    v1, v2, v3 = _essential_columns((x[6], x[7], x[8]), R)
    narrow = 1.0 / threshold2[0]
    middle = 1.0 / threshold2[1]
    wide = 1.0 / threshold2[2]
    n = points.shape[1]
    cost = 0.0
    inliers = 0
    for first in range(0, n, BLOCK):
        for i in range(first, min(first + BLOCK, n)):
            f1 = (points[0, i], points[1, i], 1.0)
            x2 = points[2, i]
            y2 = points[3, i]
            tau1 = points[4, i]
            tau2 = points[5, i]
            e1 = _at_times(t1, u1, v1, tau1, tau2)
            e2 = _at_times(t2, u2, v2, tau1, tau2)
            e3 = _at_times(t3, u3, v3, tau1, tau2)
            # The constraint ``f_1^T E f_2`` up to sign, and its derivatives by both points.
            line = so3.add(so3.add(so3.scale(x2, e1), so3.scale(y2, e2)), e3)
            value = so3.dot(f1, line)
            by_x2 = so3.dot(e1, f1)
            by_y2 = so3.dot(e2, f1)
            slope2 = line[0] * line[0] + line[1] * line[1] + by_x2 * by_x2 + by_y2 * by_y2
            r2 = value * value / (slope2 + 1e-30)
            # Each comparison is false for NaN, which counts as an outlier.
            cost += truncated_cost(r2 * narrow, 1.0)
            cost += truncated_cost(r2 * middle, 1.0)
            cost += truncated_cost(r2 * wide, 1.0)
            inliers += 1 if r2 * middle < 1.0 else 0
        if cost > limit:
            return math.inf, 0
    return cost, inliers


class Sampling(NamedTuple):
    """What is sampled, how hypotheses are ranked (`multi_scale_cost`), and when sampling stops."""

    points: Array  # (6, N)
    order: Indices  # (M,) usable matches, best first
    threshold2: Array  # (3,)
    confidence: float  # probability of a sample without outliers
    max_samples: int
    seed: Seed  # (1,) state of the random number generator, updated in place


class Pool(NamedTuple):
    """The best distinct hypotheses so far, in any order."""

    R: Array  # (K, 3, 3)
    x: Array  # (K, 9)
    cost: Array  # (K,) infinite for a free place
    inliers: Indices  # (K,) of the middle scale


@small_kernel
def _random(state: Seed) -> np.uint64:
    """Next number of splitmix64 (Steele et al., OOPSLA 2014): the state is one word."""
    state[0] += np.uint64(0x9E3779B97F4A7C15)
    z = state[0]
    z = (z ^ (z >> np.uint64(30))) * np.uint64(0xBF58476D1CE4E5B9)
    z = (z ^ (z >> np.uint64(27))) * np.uint64(0x94D049BB133111EB)
    return z ^ (z >> np.uint64(31))


@kernel
def draw(order: Indices, head: int, sample: Indices, seed: Seed) -> None:
    """Fill `sample` with distinct entries of ``order[:head]``."""
    for k in range(len(sample)):
        while True:
            candidate = order[np.int64(_random(seed) % np.uint64(head))]
            repeated = False
            for j in range(k):
                if sample[j] == candidate:
                    repeated = True
            if not repeated:
                break
        sample[k] = candidate


@small_kernel
def _write_ray(x: float, y: float, ray: Array) -> None:
    """Write the unit ray of a point (x, y) at z = 1."""
    inverse_length = 1.0 / math.sqrt(1.0 + x * x + y * y)
    ray[0] = x * inverse_length
    ray[1] = y * inverse_length
    ray[2] = inverse_length


@small_kernel
def _write_sample(points: Array, chosen: Indices, sample: Sample) -> bool:
    """Write unit rays and row times of the chosen matches; False if one is not usable."""
    for k in range(len(chosen)):
        point = points[:, chosen[k]]
        if math.isnan(point[0]):
            return False
        _write_ray(point[0], point[1], sample.f1[k])
        _write_ray(point[2], point[3], sample.f2[k])
        sample.tau1[k] = point[4]
        sample.tau2[k] = point[5]
    return True


@small_kernel
def _same(Ra: Array, xa: Array, Rb: Array, xb: Array) -> bool:
    """Whether two hypotheses are equal: R within 0.01 rad, the direction of t within 0.1 rad."""
    trace = 0.0
    for i in range(3):
        for j in range(3):
            trace += Ra[i, j] * Rb[i, j]
    if trace < 3.0 - 0.01 * 0.01:  # 1 + 2 cos of the angle between them
        return False
    return abs(so3.dot(xa, xb)) > 1.0 - 0.5 * 0.1 * 0.1


@small_kernel
def _offer(R: Array, x: Array, sampling: Sampling, pool: Pool) -> bool:
    """Score a hypothesis, and let it replace an equal one of the pool, or the worst, if better.

    Returns whether the pool has changed.
    """
    limit = pool.cost.max()
    cost, inliers = multi_scale_cost(sampling.points, R, x, sampling.threshold2, limit)
    if not cost < limit:
        return False
    place = int(np.argmax(pool.cost))
    for k in range(len(pool.cost)):
        if pool.cost[k] < math.inf and _same(R, x, pool.R[k], pool.x[k]):
            place = k
            break
    if not cost < pool.cost[place]:
        return False
    so3.copy_matrix(R, pool.R[place])
    so3.copy_vector(x, pool.x[place])
    pool.cost[place] = cost
    pool.inliers[place] = inliers
    return True


@kernel
def sample_hypotheses(
    solver: int,
    size: int,
    sampling: Sampling,
    known: Knowledge,
    drawn: int,
    block: int,
    out: Solutions,
    pool: Pool,
) -> int:
    """Draw samples for one solver and fill the pool, in place.

    `solver`, `size`: address of its kernel, and matches of a sample. `drawn`, `block`: samples
    drawn by earlier calls, and most samples of this one. `out`: room for the solutions of one
    sample. Returns the samples drawn so far.
    """
    usable = len(sampling.order)
    if usable < size:
        return drawn
    chosen = np.empty(size, dtype=np.int64)
    sample = Sample(np.empty((size, 3)), np.empty((size, 3)), np.empty(size), np.empty(size))
    last = min(drawn + block, sampling.max_samples)
    # Minimal sets are noisy: an outlier-free one is not yet an accurate one.
    least = min(40, sampling.max_samples)
    needed = samples_needed(pool, size, sampling)
    while drawn < last and (drawn < least or drawn < needed):
        # The set grows to all matches over 100 samples.
        head = min(usable, max(2 * size, (usable * (drawn + 1)) // 100))
        draw(sampling.order, head, chosen, sampling.seed)
        drawn += 1
        if not _write_sample(sampling.points, chosen, sample):
            continue
        out.x[:] = 0.0
        for k in range(common.solve_at(solver, sample, known, out)):
            if _offer(out.R[k], out.x[k], sampling, pool):
                needed = samples_needed(pool, size, sampling)
    return drawn


@kernel
def samples_needed(pool: Pool, size: int, sampling: Sampling) -> float:
    """Samples after which one is free of outliers with probability `sampling.confidence`.

    The share of inliers is that of the best hypothesis so far.
    """
    best = int(np.argmin(pool.cost))
    if not pool.cost[best] < math.inf:
        return float(sampling.max_samples)
    ratio = pool.inliers[best] / len(sampling.order)
    good = ratio**size
    if good >= 1.0 - 1e-12:
        return 1.0
    if good <= 1e-12:
        return float(sampling.max_samples)
    needed = math.log(1.0 - sampling.confidence) / math.log(1.0 - good)
    return min(needed, float(sampling.max_samples))


# -- Solvers of a mode, and the sampling of a frame pair ------------------------------------------

# Hypotheses that are optimised further. More of them cost time, fewer lose the right one among
# hypotheses of nearly the same cost. [chosen: the pool is halved from round to round, so that any
# value in 4..8 costs three or four rounds]
POOL_SIZE = 6
# Most samples (20 us each) of a further solver where the rotation by the gyro is known. A pair
# without consensus ends within half an interval of 30 Hz, and repeatably. [derived: the times
# above]
_MOST_WITHOUT_GYRO = 250
# Samples between two readings of the clock, if there is a time limit. More of them overshoot the
# limit. [derived: about 0.2 ms]
_TIMED_BLOCK = 20


@dataclass(frozen=True, slots=True)
class SolverMode:
    """Model that is estimated and its solvers, by decreasing prior knowledge."""

    model: Model
    solvers: tuple[Solver, ...]

    @property
    def needs_gravity(self) -> bool:
        """Whether every solver requires gravity."""
        return all(solver.needs_gravity for solver in self.solvers)

    def able(self, knows_rotation: bool, knows_gravity: bool) -> list[Solver]:
        """The solvers that need no more than what is known."""
        return [
            solver
            for solver in self.solvers
            if (knows_rotation or not solver.needs_rotation)
            and (knows_gravity or not solver.needs_gravity)
        ]

    @property
    def fitted_points(self) -> int:
        """Matches that any hypothesis fits after its refinement, by its number of unknowns.

        Those of its sample: 9 or 11 points, and some more by the fit of 11 unknowns.
        """
        return 14 if max(solver.sample_size for solver in self.solvers) >= 9 else 6


# Modes by the value of the parameter solver. The mode auto tries one solver after the other.
# [derived: the table of solvers]
MODES = {
    'auto': SolverMode(UNIFORM, (GYRO_2PT, SOLVERS['angular_3pt'], SOLVERS['angular_5pt'])),
    **{name: SolverMode(solver.model, (solver,)) for name, solver in SOLVERS.items()},
}


def _knowledge(problem: TwoViewProblem) -> tuple[Knowledge, bool]:
    """What the IMU knows of a pair for its solvers, and whether that includes gravity."""
    known = common.no_knowledge()
    if problem.rotation is not None:
        rotation = np.ascontiguousarray(problem.rotation)
        known = known._replace(rotation=rotation, predicted=True)
    gravity1 = problem.motion1.gravity
    gravity2 = problem.motion2.gravity
    if gravity1 is None or gravity2 is None:
        return known, False
    align1 = common.gravity_alignment(gravity1)
    align2 = common.gravity_alignment(gravity2)
    return known._replace(align1=align1, align2=align2), True


def draw_hypotheses(
    problem: TwoViewProblem,
    mode: SolverMode,
    config: EstimatorConfig,
    order: Indices,
    seed: Seed,
    enough: float,
    deadline: float,
) -> tuple[Solutions, int, bool]:
    """Sample the solvers of a mode until a share `enough` of the matches are inliers of one.

    `order` (M,): usable matches, best first. `seed` (1,): state of the random number generator,
    updated in place. Sampling ends at the `deadline`, in the time of `time.perf_counter` [s].
    Returns the best distinct hypotheses, best first, the number of samples, and whether solvers
    were skipped, since one before them had enough inliers.
    """
    known, has_gravity = _knowledge(problem)
    # All addresses first, so that the first pair compiles the solvers of later pairs, too.
    able = [(solver, solver.address) for solver in mode.able(known.predicted, has_gravity)]
    sampling = Sampling(
        problem.points,
        order,
        (config.threshold * SCALES / problem.focal) ** 2,
        config.confidence,
        config.max_iterations,
        seed,
    )
    pool = Pool(
        np.zeros((POOL_SIZE, 3, 3)),
        np.zeros((POOL_SIZE, 9)),
        np.full(POOL_SIZE, np.inf),
        np.zeros(POOL_SIZE, dtype=np.int64),
    )
    block = config.max_iterations if math.isinf(deadline) else _TIMED_BLOCK
    samples = 0
    solvers_skipped = False
    for solver, address in able:
        inliers = pool.inliers[np.argmin(pool.cost)]
        too_late = samples > 0 and time.perf_counter() >= deadline
        solvers_skipped = bool(too_late or inliers > enough * len(order))
        if solvers_skipped:
            break
        out = common.empty_solutions(solver.most_solutions)
        if samples > 0 and known.predicted:
            most = min(config.max_iterations, _MOST_WITHOUT_GYRO)
            sampling = sampling._replace(max_samples=most)
        drawn = 0
        new = block
        while new == block:
            before = drawn
            drawn = sample_hypotheses(
                address, solver.sample_size, sampling, known, drawn, block, out, pool
            )
            new = drawn - before if time.perf_counter() < deadline else 0
        samples += drawn
    found = np.argsort(pool.cost)[: np.isfinite(pool.cost).sum()]
    return Solutions(pool.R[found], pool.x[found]), samples, solvers_skipped


# -- Local optimisation: inlier selection and fits of the uniform model, shrinking threshold ------

# Multiples of the inlier threshold, one a round. Without the first, a hypothesis of the angular
# model has no inliers at high speed; with fewer steps between, outliers of one round spoil the
# next. [chosen: the angular model leaves up to 20 px at true inliers]
SHRINKING = np.array([6.0, 3.0, 1.5, 1.0])
# Gauss-Newton steps of a hypothesis in each round. [chosen: the second step makes the error of the
# first one small, and the inliers change more than the state]
STEPS = 2
# Fewest inliers of a hypothesis that is fitted. [derived: one more than the unknowns of a pose]
_FEWEST_FITTED = 6


@kernel
def _truncated_costs(r: Array, weights: Array, bound: float, noise: float) -> float:
    """MSAC cost of residuals (N,) [px] in units of `noise` [px], truncated at `bound` [px]."""
    cost = 0.0
    for i in range(len(r)):
        if weights[i] > 0.0:
            cost += truncated_cost(r[i] * r[i], bound * bound)
    return cost / (noise * noise)


@small_kernel
def _fit_all(
    matches: FitMatches,
    prior: Priors,
    bound: float,
    noise: float,
    states: list[TwoViewState],
    r: list[Array],
) -> Array:
    """Fit each state to its inliers within `bound` [px]; states and residuals r change in place.

    `noise` [px] is that of all inliers. Returns the cost of each state, infinite without enough
    inliers.
    """
    costs = np.full(len(states), math.inf)
    for k in range(len(states)):
        use = sampson.within(r[k], matches, states[k], bound)
        if use.sum() < _FEWEST_FITTED:
            continue
        of_matches = _truncated_costs(r[k], matches.weights, bound, noise)
        costs[k] = of_matches + priors.prior_cost(states[k], prior)
        used = FitMatches(matches.observations, use.astype(np.float64), noise, matches.focal)
        state = gauss_newton(used, states[k], prior, int(STEPS))
        errors = sampson.residuals(matches.observations, state)
        of_matches = _truncated_costs(errors, matches.weights, bound, noise)
        cost = of_matches + priors.prior_cost(state, prior)
        if cost < costs[k]:
            states[k] = state
            r[k] = errors
            costs[k] = cost
    return costs


@kernel
def optimise(
    matches: FitMatches, hypotheses: Solutions, prior: Priors, threshold: float
) -> tuple[TwoViewState, bool]:
    """Fit the uniform model to each hypothesis; the one of the least MSAC cost, priors included.

    The inlier threshold shrinks from round to round to `threshold` [px], and each round keeps the
    better half. Returns the state, and whether a hypothesis has enough inliers.
    """
    # Depths are not tested before the sign of the translation is known.
    untested = FitMatches(matches.observations, matches.weights, matches.sigma, math.nan)
    states = []  # of the hypotheses that remain
    r = []  # their residuals
    for k in range(len(hypotheses.R)):
        state = priors.hypothesis_state(hypotheses.R[k], hypotheses.x[k])
        r.append(sampson.residuals(matches.observations, state))
        # The sign with its matches in front of the cameras; residuals change theirs with it.
        near = sampson.within(r[k], untested, state, SHRINKING[0] * threshold)
        sign = sampson.cheirality_sign(matches.observations, near, state)
        states.append(priors.signed(state, sign))
    for scale in SHRINKING:
        # Wide selections hold outliers: their residuals are not pixel noise.
        noise = scale * matches.sigma
        costs = _fit_all(matches, prior, scale * threshold, noise, states, r)
        good = (costs < math.inf).sum()
        if good == 0:
            return states[0], False
        better = [0 for _ in range((good + 1) // 2)]
        for k in range(len(better)):
            better[k] = int(np.argmin(costs))
            costs[better[k]] = math.inf
        states = [states[k] for k in better]
        r = [r[k] for k in better]
    return states[0], True


# -- The alternative to a pose whose rotation follows the gyro: any rotation ----------------------

# Rounds of its fit. More rounds gain little: the weights hardly change any more.
# [chosen: each costs as much as two steps of a fit, any value in 4..10 would do]
_FREE_ROUNDS = 6
# Gauss-Newton steps of each round. [chosen: the weights change more than the state]
_FREE_STEPS = 2
# Scale of the Cauchy weights [sigma of the residuals].
# [derived: 95 % efficiency for Gaussian residuals (2.385)]
_FREE_SIGMAS = 2.4
# Round by which the free rotation must be the likelier one. It rarely is if the pose is right, so
# that this bounds the cost of a good pair. [chosen: any value in 1..3 would do]
_PROMISING = 2
# Least scale of the residuals [px]: those of exact matches vanish.
# [chosen: half of the noise of the best tracks]
_LEAST_SCALE = 0.05


@kernel
def _unlikelihood(r: Array) -> float:
    """Negative log-likelihood of residuals (N,), Cauchy about zero with their median as scale."""
    scale = max(so3.median(np.abs(r)), _LEAST_SCALE)
    return len(r) * math.log(scale) + cauchy_cost((r / scale) ** 2).sum()


def gain_without_gyro(
    matches: FitMatches, state: TwoViewState, prior: Priors
) -> tuple[float, Array]:
    """Log-likelihood that all matches gain by a free rotation, and that rotation (3, 3).

    Negative if the pose `state`, whose `prior` has the rotation by the gyro, is the likelier one.
    """
    focal = matches.focal
    observations = np.ascontiguousarray(matches.observations[matches.weights > 0.0])
    inliers = np.ones(len(observations), dtype=bool)
    free = prior._replace(rotation_information=np.zeros((3, 3)))
    known = _unlikelihood(sampson.residuals(observations, state))
    start = so3.aligning_rotation(correlation(observations, inliers, VIEW_1, VIEW_2))
    spread = so3.median(transfer_errors(observations, inliers, start, focal))
    R, _ = fit_rotation(observations, inliers, start, free, focal, 0.5 * spread)
    t = translation_direction(observations, R)
    velocity = prior.velocity.rate * t
    state = priors.hypothesis_state(R, np.concatenate([t, velocity, velocity]))
    state = priors.signed(state, sampson.cheirality_sign(observations, inliers, state))
    for k in range(_FREE_ROUNDS + 1):
        residuals = sampson.residuals(observations, state)
        gain = known - _unlikelihood(residuals)
        if k == _FREE_ROUNDS or (k == _PROMISING and gain < 0.0):
            break
        sigma = robust_scale(residuals, _LEAST_SCALE, 0.0)
        weights = cauchy_weight((residuals / (_FREE_SIGMAS * sigma)) ** 2)
        state = gauss_newton(FitMatches(observations, weights, sigma), state, free, _FREE_STEPS)
    return gain, state.R


def translation_direction(observations: Array, R: Array) -> Array:
    """Unit vector (3,) nearest to the epipolar planes of observations (N, 20) for a rotation."""
    _, axes = np.linalg.eigh(_scatter_of_normals(observations, R))
    return np.ascontiguousarray(axes[:, 0])


# Least length of the normal of an epipolar plane, as the sine of the parallax. A smaller one lets
# points at infinity decide by their noise. [chosen: half a pixel at 500 px of focal length]
_LEAST_PARALLAX = 1e-3


@kernel
def _scatter_of_normals(observations: Array, R: Array) -> Array:
    """``sum n n^T`` (3, 3) of the unit normals of the epipolar planes for a rotation R."""
    out = np.zeros((3, 3))
    for i in range(len(observations)):
        ray2 = so3.rotated(R, observations[i, VIEW_2 : VIEW_2 + 3])
        normal = so3.cross(observations[i, VIEW_1 : VIEW_1 + 3], ray2)
        unit = so3.scale(1.0 / max(so3.norm(normal), _LEAST_PARALLAX), normal)
        for j in range(3):
            for k in range(3):
                out[j, k] += unit[j] * unit[k]
    return out


# -- Distribution of the inliers' rays: do they determine a pose? ---------------------------------


@kernel
def correlation(observations: Array, use: Flags, first: int, second: int) -> Array:
    """``sum a b^T`` (3, 3) over the matches in `use` of two of their vectors, by column."""
    out = np.zeros((3, 3))
    for i in range(len(use)):
        if use[i]:
            a = observations[i, first:]
            b = observations[i, second:]
            for j in range(3):
                for k in range(3):
                    out[j, k] += a[j] * b[k]
    return out


def distinct_directions(observations: Array, inliers: Flags, first: int, cell: float) -> int:
    """Number of distinct rays, to `cell` [rad]: copies of one add no information."""
    cells = np.round(observations[inliers, first : first + 2] / cell)
    numbers = np.sort(cells @ [1.0, 1e6])
    return min(len(numbers), 1) + int(np.count_nonzero(numbers[1:] != numbers[:-1]))


def distance_from_a_plane(observations: Array, inliers: Flags, first: int) -> float:
    """Root mean square distance [rad] of the rays from the best plane through the centre.

    Small if the points lie in one place or, in the image, on one line.
    """
    scatter = correlation(observations, inliers, first, first) / inliers.sum()
    least = np.linalg.eigvalsh(scatter)[0]
    return float(np.sqrt(max(least, 0.0)))
