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
from rs_relpose_ros.core.losses import cauchy_cost, cauchy_weight, robust_scale, truncated_cost
from rs_relpose_ros.estimator import priors, sampson
from rs_relpose_ros.estimator.fit import fit_rotation, FitMatches, gauss_newton, transfer_errors
from rs_relpose_ros.estimator.priors import Priors, TwoViewState
from rs_relpose_ros.estimator.problem import TwoViewProblem
from rs_relpose_ros.estimator.sampson import RayMatches
from rs_relpose_ros.geometry import Array, so3
from rs_relpose_ros.jit import kernel, small_kernel
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

# Multiples of the inlier threshold. The widest still rejects 19 of 20 random matches.
SCALES = np.array([1.0, 4.0, 12.0])
# Matches that are scored between two comparisons with the limit.
BLOCK = 64


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
    # Essential matrices of t, -d_1 and d_2: that of a match is E_0 + tau_1 E_1 + tau_2 E_2.
    E = np.empty((3, 3, 3))
    for k in range(3):
        sign = -1.0 if k == 1 else 1.0
        bx, by, bz = sign * x[3 * k], sign * x[3 * k + 1], sign * x[3 * k + 2]
        for j in range(3):
            E[k, 0, j] = by * R[2, j] - bz * R[1, j]
            E[k, 1, j] = bz * R[0, j] - bx * R[2, j]
            E[k, 2, j] = bx * R[1, j] - by * R[0, j]
    narrow, middle, wide = 1.0 / threshold2[0], 1.0 / threshold2[1], 1.0 / threshold2[2]
    n = points.shape[1]
    cost, inliers = 0.0, 0
    for first in range(0, n, BLOCK):
        for i in range(first, min(first + BLOCK, n)):
            x1, y1, x2, y2 = points[0, i], points[1, i], points[2, i], points[3, i]
            tau1, tau2 = points[4, i], points[5, i]
            e00 = E[0, 0, 0] + tau1 * E[1, 0, 0] + tau2 * E[2, 0, 0]
            e01 = E[0, 0, 1] + tau1 * E[1, 0, 1] + tau2 * E[2, 0, 1]
            e02 = E[0, 0, 2] + tau1 * E[1, 0, 2] + tau2 * E[2, 0, 2]
            e10 = E[0, 1, 0] + tau1 * E[1, 1, 0] + tau2 * E[2, 1, 0]
            e11 = E[0, 1, 1] + tau1 * E[1, 1, 1] + tau2 * E[2, 1, 1]
            e12 = E[0, 1, 2] + tau1 * E[1, 1, 2] + tau2 * E[2, 1, 2]
            e20 = E[0, 2, 0] + tau1 * E[1, 2, 0] + tau2 * E[2, 2, 0]
            e21 = E[0, 2, 1] + tau1 * E[1, 2, 1] + tau2 * E[2, 2, 1]
            e22 = E[0, 2, 2] + tau1 * E[1, 2, 2] + tau2 * E[2, 2, 2]
            # f_1^T [b]x R f_2: the constraint up to sign
            gx = e00 * x2 + e01 * y2 + e02
            gy = e10 * x2 + e11 * y2 + e12
            gz = e20 * x2 + e21 * y2 + e22
            kx = e00 * x1 + e10 * y1 + e20
            ky = e01 * x1 + e11 * y1 + e21
            value = x1 * gx + y1 * gy + gz
            r2 = value * value / (gx * gx + gy * gy + kx * kx + ky * ky + 1e-30)
            # False for NaN, which counts as an outlier.
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
    order: NDArray[np.int64]  # (M,) usable matches, best first
    threshold2: Array  # (3,)
    confidence: float  # probability of a sample without outliers
    max_samples: int


class Pool(NamedTuple):
    """The best distinct hypotheses so far: R (K, 3, 3), x (K, 9), cost (K,), infinite if none."""

    R: Array
    x: Array
    cost: Array


@small_kernel
def _random(state: NDArray[np.uint64]) -> np.uint64:
    """Next number of splitmix64 (Steele et al., OOPSLA 2014): the state is one word."""
    state[0] += np.uint64(0x9E3779B97F4A7C15)
    z = state[0]
    z = (z ^ (z >> np.uint64(30))) * np.uint64(0xBF58476D1CE4E5B9)
    z = (z ^ (z >> np.uint64(27))) * np.uint64(0x94D049BB133111EB)
    return z ^ (z >> np.uint64(31))


@kernel
def draw(
    order: NDArray[np.int64], head: int, sample: NDArray[np.int64], state: NDArray[np.uint64]
) -> None:
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


@small_kernel
def _write_ray(x: float, y: float, ray: Array) -> None:
    """Write the unit ray of a point (x, y) at z = 1."""
    inverse_length = 1.0 / math.sqrt(1.0 + x * x + y * y)
    ray[0], ray[1], ray[2] = x * inverse_length, y * inverse_length, inverse_length


@small_kernel
def _write_sample(points: Array, chosen: NDArray[np.int64], sample: Sample) -> bool:
    """Write unit rays and row times of the chosen matches; False if one is not usable."""
    for k in range(chosen.shape[0]):
        i = chosen[k]
        x1, y1, x2, y2 = points[0, i], points[1, i], points[2, i], points[3, i]
        if math.isnan(x1):
            return False
        _write_ray(x1, y1, sample.f1[k])
        _write_ray(x2, y2, sample.f2[k])
        sample.tau1[k], sample.tau2[k] = points[4, i], points[5, i]
    return True


@small_kernel
def _same(Ra: Array, xa: Array, Rb: Array, xb: Array) -> bool:
    """Whether two hypotheses are equal: R within 0.01 rad, the direction of t within 0.1 rad."""
    trace = 0.0
    for i in range(3):
        for j in range(3):
            trace += Ra[i, j] * Rb[i, j]
    if trace < 3.0 - 0.01 * 0.01:
        return False
    return abs(so3.dot(xa, xb)) > 1.0 - 0.5 * 0.1 * 0.1


@small_kernel
def _offer(R: Array, x: Array, cost: float, pool: Pool) -> None:
    """Replace an equal hypothesis of the pool, or the worst one, by this one if it is better."""
    place = -1
    for k in range(pool.cost.shape[0]):
        if pool.cost[k] < math.inf and _same(R, x, pool.R[k], pool.x[k]):
            place = k
            break
    if place < 0:
        place = int(np.argmax(pool.cost))
    if cost < pool.cost[place]:
        so3.copy_matrix(R, pool.R[place])
        so3.copy_vector(x, pool.x[place])
        pool.cost[place] = cost


@kernel
def sample_hypotheses(
    solver: int,
    size: int,
    sampling: Sampling,
    known: Knowledge,
    drawn: int,
    block: int,
    best_inliers: int,
    out: Solutions,
    pool: Pool,
    seed: NDArray[np.uint64],
) -> tuple[int, int]:
    """Draw samples for one solver and fill the pool, in place.

    `solver`, `size`: address of its kernel, and matches of a sample. `drawn`, `block`: samples
    drawn by earlier calls, and most samples of this one. `best_inliers`: of the best hypothesis of
    the pool. `out`: room for the solutions of one sample. Returns the samples drawn so far, and
    the inliers (middle scale) of the best hypothesis.
    """
    usable = sampling.order.shape[0]
    if usable < size:
        return drawn, best_inliers
    chosen = np.empty(size, dtype=np.int64)
    sample = Sample(np.empty((size, 3)), np.empty((size, 3)), np.empty(size), np.empty(size))
    needed = float(sampling.max_samples)
    last = min(drawn + block, sampling.max_samples)
    # Minimal sets are noisy: an outlier-free one is not yet an accurate one.
    least = min(40, sampling.max_samples)
    best = pool.cost.min()
    if best < math.inf:
        needed = samples_needed(best_inliers / usable, size, sampling)
    while drawn < last and (drawn < least or drawn < needed):
        # The set grows to all matches over 100 samples.
        head = min(usable, max(2 * size, (usable * (drawn + 1)) // 100))
        draw(sampling.order, head, chosen, seed)
        drawn += 1
        if not _write_sample(sampling.points, chosen, sample):
            continue
        out.x[:] = 0.0
        count = common.solve_at(solver, sample, known, out)
        for k in range(count):
            limit = pool.cost.max()
            cost, inliers = multi_scale_cost(
                sampling.points, out.R[k], out.x[k], sampling.threshold2, limit
            )
            if cost < limit:
                _offer(out.R[k], out.x[k], cost, pool)
                if cost < best:
                    best = cost
                    best_inliers = inliers
                    needed = samples_needed(inliers / usable, size, sampling)
    return drawn, best_inliers


@small_kernel
def samples_needed(ratio: float, size: int, sampling: Sampling) -> float:
    """Samples after which one is free of outliers with probability `sampling.confidence`."""
    good = ratio**size
    if good >= 1.0 - 1e-12:
        return 1.0
    if good <= 1e-12:
        return float(sampling.max_samples)
    needed = math.log(1.0 - sampling.confidence) / math.log(1.0 - good)
    return min(needed, float(sampling.max_samples))


# -- Solvers of a mode, and the sampling of a frame pair ------------------------------------------

# Hypotheses that are optimised further.
POOL_SIZE = 6
# Most samples (20 us each) of a further solver where the gyro's rotation is known: a pair without
# consensus ends within half an interval of 30 Hz, and repeatably.
_MOST_WITHOUT_GYRO = 250
# With a time limit: samples between two readings of the clock (about 0.2 ms).
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

    @property
    def fitted_points(self) -> int:
        """Matches that any hypothesis fits after its refinement, by its number of unknowns.

        Those of its sample: 9 or 11 points, and some more by the fit of 11 unknowns.
        """
        return 14 if max(solver.sample_size for solver in self.solvers) >= 9 else 6


MODES = {
    'auto': SolverMode(UNIFORM, (GYRO_2PT, SOLVERS['angular_3pt'], SOLVERS['angular_5pt'])),
    **{name: SolverMode(solver.model, (solver,)) for name, solver in SOLVERS.items()},
}


def _knowledge(problem: TwoViewProblem) -> tuple[Knowledge, bool]:
    """What the IMU knows of a pair for its solvers, and whether that includes gravity."""
    known = common.no_knowledge()
    if problem.rotation is not None:
        known = known._replace(rotation=np.ascontiguousarray(problem.rotation), predicted=True)
    gravity1, gravity2 = problem.motion1.gravity, problem.motion2.gravity
    if gravity1 is None or gravity2 is None:
        return known, False
    align1 = common.gravity_alignment(gravity1)
    align2 = common.gravity_alignment(gravity2)
    return known._replace(align1=align1, align2=align2), True


def _sampling(
    problem: TwoViewProblem, config: EstimatorConfig, order: NDArray[np.int64]
) -> Sampling:
    """What is sampled of a pair, as configured."""
    return Sampling(
        problem.points,
        order,
        (config.threshold * SCALES / problem.focal) ** 2,
        config.confidence,
        config.max_iterations,
    )


def draw_hypotheses(
    problem: TwoViewProblem,
    mode: SolverMode,
    config: EstimatorConfig,
    order: NDArray[np.int64],
    seed: NDArray[np.uint64],
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
    sampling = _sampling(problem, config, order)
    # All addresses first, so that the first pair compiles the solvers of later pairs, too.
    able = [
        (solver, solver.address)
        for solver in mode.solvers
        if (known.predicted or not solver.needs_rotation)
        and (has_gravity or not solver.needs_gravity)
    ]
    pool = Pool(np.zeros((POOL_SIZE, 3, 3)), np.zeros((POOL_SIZE, 9)), np.full(POOL_SIZE, np.inf))
    block = config.max_iterations if math.isinf(deadline) else _TIMED_BLOCK
    samples = inliers = 0
    solvers_skipped = False
    for solver, address in able:
        solvers_skipped = inliers > enough * len(order) or (
            samples > 0 and time.perf_counter() >= deadline
        )
        if solvers_skipped:
            break
        out = common.empty_solutions(solver.most_solutions)
        if samples > 0 and known.predicted:
            sampling = sampling._replace(
                max_samples=min(config.max_iterations, _MOST_WITHOUT_GYRO)
            )
        drawn, new = 0, block
        while new == block:
            before = drawn
            drawn, inliers = sample_hypotheses(
                address,
                solver.sample_size,
                sampling,
                known,
                drawn,
                block,
                inliers,
                out,
                pool,
                seed,
            )
            new = drawn - before if time.perf_counter() < deadline else 0
        samples += drawn
    found = np.argsort(pool.cost)[: np.isfinite(pool.cost).sum()]
    return Solutions(pool.R[found], pool.x[found]), samples, solvers_skipped


# -- Local optimisation: inlier selection and fits of the uniform model, shrinking threshold ------

# Multiples of the inlier threshold: the angular model leaves up to 20 px at true inliers.
SHRINKING = np.array([6.0, 3.0, 1.5, 1.0])
# Gauss-Newton steps of a hypothesis at each of them.
STEPS = 2


@kernel
def _truncated_cost(r: Array, valid: NDArray[np.bool_], threshold: float, sigma: float) -> float:
    """MSAC cost of residuals (N,) in units of sigma."""
    cost = 0.0
    for i in range(r.shape[0]):
        if valid[i]:
            cost += truncated_cost(r[i] * r[i], threshold * threshold)
    return cost / (sigma * sigma)


@kernel
def optimise(
    matches: RayMatches, hypotheses: Solutions, prior: Priors, sigma: float, threshold: float
) -> tuple[TwoViewState, bool]:
    """Fit the uniform model to each hypothesis; the one of the least MSAC cost, priors included.

    The threshold shrinks from round to round, and each round keeps the better half. `sigma`,
    `threshold`: noise of a match and inlier threshold [px]. Returns the state, and whether a
    hypothesis has enough inliers.
    """
    # No test of depths before the sign is known: no parallax is above this noise.
    unsure = RayMatches(matches.observations, matches.valid, 1e9)
    states, r = [], []  # that remain, and their residuals
    for k in range(len(hypotheses.R)):
        state = priors.hypothesis_state(hypotheses.R[k], hypotheses.x[k])
        r.append(sampson.residuals(matches.observations, state))
        # The sign with its matches in front of the cameras; residuals change theirs with it.
        near = sampson.within(r[k], unsure, state, SHRINKING[0] * threshold)
        sign = sampson.cheirality_sign(matches.observations, near, state)
        states.append(priors.signed(state, sign))
    for scale in SHRINKING:
        costs = np.full(len(states), math.inf)
        # Wide selections hold outliers: their residuals are not pixel noise.
        noise, bound = scale * sigma, scale * threshold
        for k in range(len(states)):
            use = sampson.within(r[k], matches, states[k], bound)
            if use.sum() < 6:
                continue
            costs[k] = _truncated_cost(r[k], matches.valid, bound, noise) + priors.prior_cost(
                states[k], prior
            )
            state = gauss_newton(
                FitMatches(matches.observations, use.astype(np.float64), noise),
                states[k],
                prior,
                int(STEPS),
            )
            errors = sampson.residuals(matches.observations, state)
            cost = _truncated_cost(errors, matches.valid, bound, noise) + priors.prior_cost(
                state, prior
            )
            if cost < costs[k]:
                states[k], r[k], costs[k] = state, errors, cost
        good = (costs < math.inf).sum()
        if good == 0:
            return states[0], False
        better = [0 for _ in range((good + 1) // 2)]
        for k in range(len(better)):
            better[k] = int(np.argmin(costs))
            costs[better[k]] = math.inf
        states, r = [states[k] for k in better], [r[k] for k in better]
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
    matches: RayMatches,
    state: TwoViewState,
    prior: Priors,
    focal: float,
) -> tuple[float, Array]:
    """Log-likelihood that all matches gain by a free rotation, and that rotation (3, 3).

    Negative if the pose `state`, whose `prior` is the gyro's rotation, is the likelier one.
    """
    observations = np.ascontiguousarray(matches.observations[matches.valid])
    use = np.ones(len(observations), dtype=bool)
    free = prior._replace(rotation_information=np.zeros((3, 3)))
    known = _unlikelihood(sampson.residuals(observations, state))
    start = so3.aligning_rotation(correlation(observations, use, 0, 9))
    spread = so3.median(transfer_errors(observations, use, start, focal))
    R, _ = fit_rotation(observations, use, start, free, focal, 0.5 * spread)
    t = translation_direction(observations, R)
    velocity = prior.velocity.rate * t
    state = TwoViewState(R, t, velocity, velocity.copy(), np.zeros(3), np.zeros(3))
    state = priors.signed(state, sampson.cheirality_sign(observations, use, state))
    for k in range(_FREE_ROUNDS + 1):
        r = sampson.residuals(observations, state)
        gain = known - _unlikelihood(r)
        if k == _FREE_ROUNDS or (k == _PROMISING and gain < 0.0):
            break
        sigma = robust_scale(r, _LEAST_SCALE, 0.0)
        weights = cauchy_weight((r / (_FREE_SIGMAS * sigma)) ** 2)
        state = gauss_newton(FitMatches(observations, weights, sigma), state, free, _FREE_STEPS)
    return gain, state.R


def translation_direction(observations: Array, R: Array) -> Array:
    """Unit vector (3,) nearest to the epipolar planes of observations (N, 20) for a rotation."""
    turned = (R @ observations[:, 9:12].T).T
    normals = np.cross(observations[:, :3], turned).T
    normals /= np.maximum(np.sqrt((normals**2).sum(axis=0)), 1e-3)
    return np.ascontiguousarray(np.linalg.eigh(normals @ normals.T)[1][:, 0])


# -- Distribution of the inliers' rays: do they determine a pose? ---------------------------------


@kernel
def correlation(observations: Array, use: NDArray[np.bool_], first: int, second: int) -> Array:
    """``sum a b^T`` (3, 3) over the matches in `use` of two of their vectors, by column."""
    out = np.zeros((3, 3))
    for i in range(observations.shape[0]):
        if use[i]:
            for j in range(3):
                for k in range(3):
                    out[j, k] += observations[i, first + j] * observations[i, second + k]
    return out


def distinct_directions(
    observations: Array, use: NDArray[np.bool_], first: int, cell: float
) -> int:
    """Number of distinct rays, to `cell` [rad]: copies of one add no information."""
    cells = np.round(observations[use, first : first + 2] / cell)
    return len(set((cells @ [1.0, 1e6]).tolist()))


def distance_from_a_plane(observations: Array, use: NDArray[np.bool_], first: int) -> float:
    """Root mean square distance [rad] of the rays from the best plane through the centre.

    Small if the points lie in one place or, in the image, on one line.
    """
    scatter = correlation(observations, use, first, first) / use.sum()
    return float(np.sqrt(max(np.linalg.eigvalsh(scatter)[0], 0.0)))
