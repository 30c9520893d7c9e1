"""Robust fit of the calibration: Levenberg-Marquardt, the unknowns of the pairs eliminated.

Step 2 of docs/calibration.md, "Method". What the sigmas contain beyond the noise of the matches is
in `calibration.errors`.
"""

from collections.abc import Callable
from dataclasses import dataclass, field
import itertools
import math
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from rs_relpose_ros.calibration import model
from rs_relpose_ros.calibration.model import GLOBAL, LOCAL, Problem, READOUT, ROTATION, Unknowns
from rs_relpose_ros.core.least_squares import (
    damped_step,
    factor_groups,
    solve_lower_groups,
    solve_upper_groups,
)
from rs_relpose_ros.core.losses import geman_mcclure_weight, robust_scale
from rs_relpose_ros.core.rows import gyro_matrix, turned_path, TurnedPath
from rs_relpose_ros.geometry import Array
from rs_relpose_ros.geometry.gyro import GyroPath

# Which of the parameters or pairs.
Flags = NDArray[np.bool_]


def block_of(free: Flags) -> tuple[NDArray[np.int64], ...]:
    """Index of some of the parameters in a matrix of all."""
    places = np.flatnonzero(free)
    return np.ix_(places, places)


# -- Unknowns -------------------------------------------------------------------------------------

# Scatter of a match before the fit [px]. A smaller one takes the matches of a coarse start for
# outliers. [chosen: a start is off by a few pixels; the fit estimates the noise itself]
_NOISE_AT_START = 5.0
# Candidates of the direction of a pair. Fewer miss the best one in pairs with outliers, more cost
# time in each search. [chosen: one in two of the matches right, all candidates are wrong with a
# probability of 3e-8]
_HYPOTHESES = 60
# Least damping of the pairs' own unknowns. A larger one slows down the last steps.
# [chosen: any value in 1e-9..1e-4 would do]
_LEAST_DAMPING = 1e-6
# Largest damping of the pairs' own unknowns. Beyond it, steps are too short to matter.
# [chosen: any value in 1e2..1e6 would do]
_MOST_DAMPING = 1e3
# Cosine of the angle by which a direction must change before bend and turn of its pair start from
# zero. [chosen: 2.6 deg, more than the noise of a direction]
_SAME_DIRECTION = 0.999
# Longest step of a direction along a tangent, about a right angle: matches may not determine a
# step, and a longer one would return near its start. [derived: the tangent of 45 deg]
_LONGEST_TURN = 1.0
# Step of the unknowns of the pairs that changes nothing.
_STAY = np.zeros((1, LOCAL))


def initial(
    problem: Problem,
    R_cam_imu: Array,
    offset: float,
    readout: float = 0.0,
    bias: Array | float = 0.0,
    noise: float = _NOISE_AT_START,
) -> Unknowns:
    """A calibration with the assumed lens, and the most likely directions of the pairs."""
    parameters = np.zeros(GLOBAL)
    pairs = problem.pairs
    parameters[READOUT] = readout
    parameters[model.OFFSET] = offset
    parameters[model.BIAS] = bias
    begin = Unknowns(
        parameters,
        # A transposed matrix would have the kernels compiled a second time.
        np.ascontiguousarray(R_cam_imu),
        np.tile(np.eye(9)[0], (pairs, 1)),
        np.full(pairs, noise),
        np.full(pairs, _LEAST_DAMPING),
    )
    return redirected(problem, begin)


def restarted(problem: Problem, unknowns: Unknowns, caution: float = 1.0) -> Unknowns:
    """The calibration for other pairs, about its own lens, with a multiple of its median noise."""
    p = unknowns.parameters
    noise = caution * float(np.median(unknowns.noise))
    return initial(problem, unknowns.R_cam_imu, p[model.OFFSET], p[READOUT], p[model.BIAS], noise)


def stepped(unknowns: Unknowns, step: Array, local: Array = _STAY) -> Unknowns:
    """Unknowns after a step of the parameters (GLOBAL,) and of each pair (P, LOCAL)."""
    parameters = unknowns.parameters + step
    parameters[ROTATION] = 0.0
    turn = Rotation.from_rotvec(step[ROTATION]).as_matrix()
    along = np.clip(local[:, :2], -_LONGEST_TURN, _LONGEST_TURN)
    direction = unknowns.own[:, :3] + np.einsum('pk,pki->pi', along, _tangents(unknowns))
    direction /= np.linalg.norm(direction, axis=1, keepdims=True)
    return unknowns._replace(
        parameters=parameters,
        R_cam_imu=turn @ unknowns.R_cam_imu,
        own=np.hstack([direction, unknowns.own[:, 3:] + local[:, 2:]]),
    )


def _tangents(unknowns: Unknowns) -> Array:
    """Two unit vectors (P, 2, 3) at right angles to each direction and to each other."""
    directions = unknowns.own[:, :3]
    first = np.eye(3)[np.argmin(np.abs(directions), axis=1)]
    first = first - (first * directions).sum(axis=1, keepdims=True) * directions
    first /= np.linalg.norm(first, axis=1, keepdims=True)
    return np.stack([first, np.cross(directions, first)], axis=1)


def redirected(problem: Problem, unknowns: Unknowns) -> Unknowns:
    """Unknowns with the best direction of each pair among many that two of its matches fix."""
    moved = unknowns._replace(own=unknowns.own.copy())
    chosen = np.random.default_rng(0).integers(0, 2**30, (_HYPOTHESES, 2))
    model.find_directions(_through_lens(problem, moved), _path(problem, moved), moved, chosen)
    cosines = (moved.own[:, :3] * unknowns.own[:, :3]).sum(axis=1)
    moved.own[np.abs(cosines) < _SAME_DIRECTION, 3:] = 0.0
    return moved


def _through_lens(problem: Problem, unknowns: Unknowns) -> Problem:
    """Problem with the points and their derivatives by the pixel through the estimated lens."""
    lens = unknowns.parameters[model.LENS]
    if not lens.any():
        return problem
    return problem._replace(
        points=problem.points + problem.by_lens @ lens,
        by_pixel=problem.by_pixel + problem.by_pixel_by_lens @ lens,
    )


def _path(problem: Problem, unknowns: Unknowns) -> GyroPath:
    """The integrated gyro in the axes of the camera."""
    parameters = unknowns.parameters
    exposed = problem.gyro_rates + parameters[model.EXPOSURE] * problem.blur_rates
    true = (exposed - parameters[model.BIAS]) @ (np.eye(3) + gyro_matrix(parameters))
    rates = true @ unknowns.R_cam_imu.T
    return GyroPath.integrated(problem.gyro_times, np.ascontiguousarray(rates))


# -- Prior of the bend of a pair ------------------------------------------------------------------

# Change of the camera's velocity during half a frame, over the depth of the scene [1/s]. Over the
# parallax per second it is the sigma of `bend`. [chosen: 2 m/s^2 for 15 ms at 3 m]
_BEND = 0.01
# Range of that sigma. Below it, a fast passage would hold the velocity constant; above it, a pair
# nearly without parallax would have any. [chosen: from a tenth of a walk's to half of the motion]
_BEND_RANGE = (0.03, 0.5)
# Least parallax per second [rad/s] that the change is divided by. [chosen: below any that reaches
# the upper end of the range, so that any value below 0.02 would do]
_LEAST_PARALLAX = 1e-6


def with_bends(problem: Problem, unknowns: Unknowns) -> Problem:
    """Problem with priors of `bend` from the parallax per second of the matches."""
    path = _path(problem, unknowns)
    parameters = unknowns.parameters
    through = _through_lens(problem, unknowns)
    rays = []
    offset = parameters[model.OFFSET]
    readout = parameters[READOUT]
    for times, rows, points in zip(problem.times, problem.rows, through.points, strict=True):
        row_times = times[problem.pair] + offset + readout * rows
        directions = np.column_stack([points, np.ones(len(points))])
        lengths = np.linalg.norm(directions, axis=1, keepdims=True)
        turned = path.at(row_times) @ (directions / lengths)[:, :, None]
        rays.append(turned[:, :, 0])
    first, second = rays
    sines = np.linalg.norm(np.cross(first, second), axis=1)
    parts = itertools.pairwise(problem.begin)
    angles = np.array([np.median(sines[begin:end]) for begin, end in parts])
    intervals = problem.times[1] - problem.times[0]
    passing = angles / intervals
    bend = _BEND / np.maximum(passing, _LEAST_PARALLAX)
    return problem._replace(bend_sigma=np.clip(bend, *_BEND_RANGE))


# -- Cost and its derivatives ---------------------------------------------------------------------


@dataclass(frozen=True, slots=True, eq=False)
class Evaluation:
    """Cost of all pairs, and their normal equations for k parameters without their own unknowns.

    Without derivatives, k is zero and all but the first two are empty.
    """

    losses: Array  # (P,) robust losses of the matches and the prior of the pair
    residuals: Array  # (N,) [px]
    score: Array  # (P, k) gradient by the parameters
    reduced: Array  # (P, k, k) Hessian by the parameters
    back: Array  # (k + 1, LOCAL, P) H_ll^-1 [H_lg, g_l]
    own: Array  # (LOCAL, LOCAL, P) H_ll, lower triangles

    @property
    def cost(self) -> float:
        """Sum over the pairs."""
        return float(self.losses.sum())

    def local_step(self, step: Array) -> Array:
        """Step (P, LOCAL) of the pairs' own unknowns for a step (k,) of the parameters."""
        by_parameters = np.einsum('k,klp->pl', step, self.back[:-1])
        return np.asarray(-self.back[-1].T - by_parameters)


# Turns of a path whose derivatives are not used.
_NO_TURNS = np.zeros((0, 3, 1))


def evaluate(problem: Problem, unknowns: Unknowns, free: Flags | None = None) -> Evaluation:
    """Residuals at `unknowns`, and the normal equations of the `free` parameters (GLOBAL,)."""
    return evaluation(problem, unknowns, sums_of(problem, unknowns, free))


def sums_of(problem: Problem, unknowns: Unknowns, free: Flags | None) -> model.Sums:
    """Sums over the matches of each pair, with derivatives by the `free` parameters (GLOBAL,)."""
    columns = np.zeros(0, dtype=np.int64)
    pairs = 0
    if free is not None:
        columns = np.concatenate([np.flatnonzero(free), np.arange(GLOBAL, model.ALL)])
        pairs = problem.pairs
    sums = model.Sums(
        np.empty(problem.pairs),
        np.empty(len(problem.rows[0])),
        np.zeros((pairs, len(columns))),
        np.zeros((pairs, len(columns), len(columns))),
    )
    path = _path(problem, unknowns)
    if free is None:
        turned = TurnedPath(path, _NO_TURNS, _NO_TURNS)
    else:
        turned = turned_path(path, unknowns.R_cam_imu, problem.blur_rates)
    through = _through_lens(problem, unknowns)
    model.accumulate(through, turned, unknowns, _tangents(unknowns), columns, sums)
    return sums


def evaluation(problem: Problem, unknowns: Unknowns, sums: model.Sums) -> Evaluation:
    """Add the priors of the pairs' own unknowns, and eliminate these.

    With ``H_ll = L L^T``, diagonal times ``1 + damping``, and ``Y = L^-1 [H_lg, g_l]``:
    ``score = g_g - Y_g^T y_l``, ``reduced = H_gg - Y_g^T Y_g``, ``back = L^-T Y``. Losses, scores
    and Hessians are times the weights of the pairs, which do not change the pairs' own unknowns.
    """
    weights = _local_priors(problem)
    own = np.hstack([np.zeros((problem.pairs, 2)), unknowns.own[:, 3:]])
    losses = problem.weight * (sums.losses + 0.5 * (weights * own**2).sum(axis=1))
    if not sums.gradient.size:
        none = np.zeros((1, LOCAL, problem.pairs))
        return Evaluation(losses, sums.residuals, none[:, 0], none, none, none)
    k = sums.gradient.shape[1] - LOCAL
    hessian = sums.hessian
    of_own = np.ascontiguousarray(hessian[:, k:, k:].transpose(1, 2, 0))
    diagonal = np.arange(LOCAL)
    of_own[diagonal, diagonal] += weights.T
    damped = of_own.copy()
    damped[diagonal, diagonal] *= 1.0 + unknowns.damping
    mixed = np.empty((k + 1, LOCAL, problem.pairs))
    mixed[:k] = hessian[:, k:, :k].transpose(2, 1, 0)
    mixed[k] = (sums.gradient[:, k:] + weights * own).T
    factors = np.zeros_like(damped)
    solved = np.empty_like(mixed)
    factor_groups(damped, factors)
    for right, out in zip(mixed, solved, strict=True):
        solve_lower_groups(factors, right, out)
    by_pair = solved.transpose(2, 0, 1)
    products = by_pair @ by_pair.transpose(0, 2, 1)
    lower = hessian[:, :k, :k]
    symmetric = lower + np.tril(lower, -1).transpose(0, 2, 1)
    for values in solved:
        solve_upper_groups(factors, values)
    score = sums.gradient[:, :k] - products[:, :k, k]
    reduced = symmetric - products[:, :k, :k]
    return Evaluation(
        losses,
        sums.residuals,
        problem.weight[:, None] * score,
        problem.weight[:, None, None] * reduced,
        solved,
        of_own,
    )


def _local_priors(problem: Problem) -> Array:
    """Inverse variances (P, LOCAL); the 1 keeps a direction that no match determines."""
    of_kinds = np.stack(
        [np.ones(problem.pairs), problem.bend_sigma**-2, problem.turn_sigma**-2], axis=1
    )
    return np.repeat(of_kinds, [2, 3, 3], axis=1)


# -- Steps ----------------------------------------------------------------------------------------

# Damping of the parameters at the start, relative to the diagonal.
# [chosen: small against 1, so that the first step is nearly Newton's]
_FIRST_DAMPING = 1e-3
# Least damping of the parameters. [chosen: above the rounding of the sums]
_LEAST_OF_PARAMETERS = 1e-9
# Factor of the damping after a step that lowers the cost. A smaller one needs more trials after a
# good step. [chosen: Levenberg-Marquardt with the usual decade; any value in 0.03..0.3 would do]
_LESS_DAMPING = 0.1
# Factor of the damping after a step that does not lower the cost. A larger one shortens the next
# step more than it needs. [chosen: the inverse; any value in 3..30 would do]
_MORE_DAMPING = 10.0
# Factor of the damping of a pair's own unknowns after a step that lowers its loss.
# [chosen: slower than that of the parameters, as pairs alternate between two directions]
_LESS_OF_PAIR = 0.2
# Trials of a step, each with more damping, before the fit stays where it is.
# [chosen: the last has a millionth of Newton's step]
_TRIALS = 8
# Newton's steps are extended at most by this factor: a larger one leaves the region where the
# loss is convex. [chosen: weights of a robust loss make steps too short by up to four]
_MOST_GAIN = 8.0
# Least share of Newton's step that a step may be expected to leave. It limits the quotient that
# extends steps. [chosen: any value below 1 / _MOST_GAIN would do]
_LEAST_LEFT = 1e-3
# Least square of a step [sigma^2] that a share is computed of: shorter ones are rounding.
# [chosen: far below the tolerance of the fit]
_LEAST_SQUARE = 1e-12


class _Iterate(NamedTuple):
    """State of the fit."""

    unknowns: Unknowns
    evaluation: Evaluation
    newton: Array  # (k,) minus Newton's step to here
    damping: float = _FIRST_DAMPING  # of the parameters
    length: float = math.inf  # of `newton` [sigma]
    gain: float = 1.0  # step taken, over `newton`


def _begin(problem: Problem, unknowns: Unknowns, free: Flags) -> _Iterate:
    """State before the first step."""
    return _Iterate(unknowns, evaluate(problem, unknowns, free), np.zeros(int(free.sum())))


def _prior_cost(problem: Problem, unknowns: Unknowns) -> float:
    """Cost of the parameters by their prior."""
    off = unknowns.parameters - problem.center
    return 0.5 * float(off @ problem.prior @ off)


def normal_equations(
    problem: Problem, at: Evaluation, unknowns: Unknowns, free: Flags
) -> tuple[Array, Array]:
    """Hessian and gradient of the cost with its prior by the free parameters."""
    H = at.reduced.sum(axis=0) + problem.prior[block_of(free)]
    of_prior = problem.prior @ (unknowns.parameters - problem.center)
    return H, at.score.sum(axis=0) + of_prior[free]


def _chosen(problem: Problem, moved: Unknowns, kept: Unknowns) -> tuple[Unknowns, float]:
    """The calibration of `moved`, each pair with the better of its unknowns in both; the cost."""
    stay = moved._replace(own=kept.own)
    losses = evaluate(problem, moved).losses
    others = evaluate(problem, stay).losses
    better = losses <= others
    damping = kept.damping * np.where(better, _LESS_OF_PAIR, _MORE_DAMPING)
    unknowns = moved._replace(
        own=np.where(better[:, None], moved.own, kept.own),
        damping=np.clip(damping, _LEAST_DAMPING, _MOST_DAMPING),
    )
    return unknowns, float(np.minimum(losses, others).sum())


def _step(problem: Problem, at: _Iterate, free: Flags) -> _Iterate:
    """State after a step that lowers the cost; the same if none does."""
    cost = at.evaluation.cost + _prior_cost(problem, at.unknowns)
    H, gradient = normal_equations(problem, at.evaluation, at.unknowns, free)
    newton = -damped_step(H, gradient, _LEAST_OF_PARAMETERS)[0]
    length = math.sqrt(max(float(gradient @ newton), 0.0))
    damping = at.damping
    # The weights of a robust loss make Gauss-Newton steps too short, by the share that the last
    # step left of itself: J. Barzilai, J. M. Borwein, Two-point step size gradient methods, 1988.
    square = max(float(at.newton @ H @ at.newton), _LEAST_SQUARE)
    left = float(newton @ H @ at.newton) / square
    gain = min(max(at.gain / max(1.0 - left, _LEAST_LEFT), 1.0), _MOST_GAIN)
    for _ in range(_TRIALS):
        of_free = gain * damped_step(H, gradient, damping)[0]
        step = np.zeros(GLOBAL)
        step[free] = of_free
        tried = stepped(at.unknowns, step, at.evaluation.local_step(of_free))
        result = evaluate(problem, tried, free)
        if result.cost + _prior_cost(problem, tried) > cost:
            tried, tried_cost = _chosen(problem, tried, at.unknowns)
            if tried_cost + _prior_cost(problem, tried) > cost:
                gain = 1.0
                damping = max(_MORE_DAMPING * damping, _FIRST_DAMPING)
                continue
            result = evaluate(problem, tried, free)
        damping = max(_LESS_DAMPING * damping, _LEAST_OF_PARAMETERS)
        return _Iterate(tried, result, newton, damping, length, gain)
    return at._replace(damping=damping, length=length)


# -- The fit --------------------------------------------------------------------------------------

# Newton's step [sigma] below which the optimum is near and residuals are noise.
# [chosen: any value in 1..5 would do]
_NEAR = 2.0
# Change of the logarithm of the median noise below which it is known.
# [chosen: 3 % of a sigma]
_NOISE_KNOWN = 0.03
# Change beyond which directions are searched again. [chosen: below it, directions are the same]
_NOISE_CHANGED = 0.1
# Least noise of a match [px]. It limits the weight of images without noise, as in simulations.
# [chosen: below the noise of any tracker]
_LEAST_NOISE = 0.05
# Range of the noise of a pair, relative to the median over all pairs. A wider one lets a pair of
# few matches dominate, a narrower one ignores blurred images.
# [chosen: scatter of the estimate of 20 matches, and images twice as blurred]
_NOISE_RANGE = (0.6, 4.0)
# Unknowns of a pair that make its residuals smaller. [derived: two of the direction, and about one
# of bend and turn, which their priors hold]
_FITTED = 3.0
# The noise becomes less by this factor at most in a round, since directions have to follow.
# [chosen: any value in 2..5 would do]
_MOST_LESS = 3.0
# Steps of the pairs alone after a search of their directions. [chosen: a third changes nothing]
_SETTLING_STEPS = 2


@dataclass(frozen=True, slots=True, eq=False)
class Fit:
    """Result of a fit to the data of `problem`."""

    problem: Problem
    unknowns: Unknowns
    free: Flags  # (GLOBAL,) parameters that were fitted, k of them
    weights: Array  # (N,) of the matches, 1 where the residual is 0
    covariance: Array  # (GLOBAL, GLOBAL), zero rows and columns where a parameter was held
    evaluation: Evaluation  # at the optimum
    converged: bool
    # (k,) minus Newton's step that was left, if it has not converged.
    left: Array
    # (GLOBAL, m) moves by one sigma of each doubt that the covariance contains.
    by_doubt: Array
    # Mean squared difference, in sigmas, of the parameters of two halves; 0 before it is known.
    halves_apart: float = 0.0
    # (GLOBAL,) variances by regions of the image over the others; empty before they are known.
    regions: Array = field(default_factory=lambda: np.zeros(0))

    @property
    def information(self) -> Array:
        """The Hessian (k, k) of the free parameters, without any prior."""
        return np.asarray(self.evaluation.reduced.sum(axis=0))

    @property
    def block(self) -> tuple[NDArray[np.int64], ...]:
        """Index of the free parameters in a matrix (GLOBAL, GLOBAL)."""
        return block_of(self.free)


# Largest number of rounds of a fit. Fewer may end it before its optimum; more only bound the time
# of a fit that does not converge later. [chosen: other values were not tried]
MOST_ROUNDS = 60
# Newton step, in sigmas of the parameters, that ends a fit. A larger one would leave an error that
# its sigmas do not contain. [chosen: far below one sigma; other values were not tried]
TOLERANCE = 0.05


def minimised(
    problem: Problem,
    unknowns: Unknowns,
    free: Flags,
    *,
    rounds: int = MOST_ROUNDS,
    tolerance: float = TOLERANCE,
) -> Fit:
    """Minimise the cost over the `free` (GLOBAL,) parameters, and estimate the noise meanwhile.

    Newton steps shorter than `tolerance` [sigma of the parameters] end the fit, or the number of
    `rounds`. The covariance is zero yet: `errors.fit`.
    """
    at = _begin(problem, unknowns, free)
    noise_known = converged = False
    for _ in range(rounds):
        at = _step(problem, at, free)
        converged = noise_known and at.length < tolerance
        if converged:
            break
        # Noise is estimated near the optimum only: far from it, residuals are no noise.
        if noise_known or at.length > _NEAR:
            continue
        noise = _estimated_noise(problem, at)
        change = float(np.median(np.abs(np.log(noise / at.unknowns.noise))))
        noise_known = change < _NOISE_KNOWN
        unknowns = at.unknowns._replace(noise=noise)
        if change > _NOISE_CHANGED:
            # The cost is not convex in the directions: less noise distinguishes more of them.
            searched = _settled(problem, redirected(problem, unknowns))
            unknowns = _chosen(problem, searched, _settled(problem, unknowns))[0]
        at = _begin(problem, unknowns, free)._replace(damping=at.damping)
    unknowns = at.unknowns._replace(damping=np.zeros(problem.pairs))
    final = evaluate(problem, unknowns, free)
    limits = model.ROBUST * unknowns.noise[problem.pair]
    weights = np.asarray(geman_mcclure_weight((final.residuals / limits) ** 2))
    left = np.zeros_like(at.newton) if converged else at.newton
    nothing = np.zeros((GLOBAL, GLOBAL))
    none = np.zeros((GLOBAL, 0))
    return Fit(problem, unknowns, free, weights, nothing, final, converged, left, none)


def _descended(problem: Problem, unknowns: Unknowns, free: Flags, rounds: int) -> _Iterate:
    """State after some steps with the noise as it is."""
    at = _begin(problem, unknowns, free)
    for _ in range(rounds):
        at = _step(problem, at, free)
    return at


def _settled(problem: Problem, unknowns: Unknowns) -> Unknowns:
    """Unknowns after steps of the pairs' own unknowns."""
    held = np.zeros(GLOBAL, dtype=bool)
    return _descended(problem, unknowns, held, _SETTLING_STEPS).unknowns


def _estimated_noise(problem: Problem, at: _Iterate) -> Array:
    """Noise (P,) of each pair by its residuals [px]."""
    residuals = at.evaluation.residuals
    of_pairs = [
        robust_scale(residuals[begin:end], 0.0, _FITTED)
        for begin, end in itertools.pairwise(problem.begin)
    ]
    middle = max(float(np.median(of_pairs)), _LEAST_NOISE)
    noise = np.clip(of_pairs, _NOISE_RANGE[0] * middle, _NOISE_RANGE[1] * middle)
    return np.maximum(noise, at.unknowns.noise / _MOST_LESS)


# -- Cost over the readout time -------------------------------------------------------------------

# Readout times of the curve besides the best one, from an interval upwards to one downwards.
# [chosen: enough to draw a parabola or two minima; each costs two steps]
_CURVE_POINTS = 13
# Steps of the fit at the best readout time. Fewer leave the fewer pairs of the curve unsettled.
# [chosen: the fit has converged with all pairs before]
_STEPS_AT_BEST = 5
# Steps at each of the other readout times, from the neighbour. More change the picture by less
# than a line's width. [chosen: the curve is drawn, not evaluated]
_STEPS_ALONG = 2


def cost_curve(
    problem: Problem, final: Fit, interval: float, progress: Callable[[float], object]
) -> Array:
    """Readout times from an interval upwards to one downwards, and the costs with each (2, K)."""
    best = float(final.unknowns.parameters[READOUT])
    held = final.free.copy()
    held[READOUT] = False
    even = np.linspace(-interval, interval, _CURVE_POINTS)
    values = np.unique(np.append(even, best))
    costs = np.full(len(values), np.nan)
    order = np.argsort(np.abs(values - best))
    restart = restarted(problem, final.unknowns)
    begin = _descended(problem, restart, held, _STEPS_AT_BEST).unknowns
    for side in (order[values[order] <= best], order[values[order] > best]):
        unknowns = begin
        for k in side:
            parameters = unknowns.parameters.copy()
            parameters[READOUT] = values[k]
            moved = unknowns._replace(parameters=parameters)
            at = _descended(problem, moved, held, _STEPS_ALONG)
            unknowns = at.unknowns
            costs[k] = at.evaluation.cost
            progress(float(np.isfinite(costs).mean()))
    # A match of a frame is in many pairs: scaled to the curvature 1 / sigma^2 at the minimum.
    fewer = problem.begin[-1] / final.problem.begin[-1]
    information = final.information * fewer + problem.prior[final.block]
    place = int(np.count_nonzero(final.free[:READOUT]))
    naive = float(np.linalg.inv(information)[place, place])
    return np.array([values, (costs - costs.min()) * naive / final.covariance[READOUT, READOUT]])
