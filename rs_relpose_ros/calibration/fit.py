"""Robust fit of the calibration (Levenberg-Marquardt, pairs eliminated), and its sigmas.

Steps 2 to 4 of docs/calibration.md, "Method": noise of matches by a jackknife over stretches of
time; errors that regions of the image share (two-way clustering: A. C. Cameron, J. B. Gelbach,
D. L. Miller, J. Bus. Econ. Stat. 29, 2011); errors that both halves of the recording do not share
(R. T. Birge, Phys. Rev. 40, 1932); errors of the models of lens and gyro (`ModelErrors`).
"""

from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace
import itertools
import math
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy import special  # scipy.stats takes seconds to import, at the start of a node
from scipy.integrate import cumulative_trapezoid
from scipy.spatial.transform import Rotation

from rs_relpose_ros.calibration import model
from rs_relpose_ros.calibration.model import (
    GLOBAL,
    LOCAL,
    Problem,
    READOUT,
    ROTATION,
    Unknowns,
)
from rs_relpose_ros.core.losses import geman_mcclure_weight, robust_scale
from rs_relpose_ros.geometry import Array
from rs_relpose_ros.geometry.gyro import GyroPath
from rs_relpose_ros.geometry.so3 import log_so3

# Stretches of a second, within which errors may be correlated, and limits of their number.
_STRETCH = 1.0
_LEAST_STRETCHES, _MOST_STRETCHES = 10, 30


def stretches(times: Array) -> NDArray[np.int64]:
    """Stretch (P,) of the recording that each time (P,) [s] belongs to."""
    begin, duration = times.min(), max(float(np.ptp(times)), 1e-9)
    count = int(np.clip(duration / _STRETCH, _LEAST_STRETCHES, _MOST_STRETCHES))
    return np.minimum(((times - begin) / duration * count).astype(np.int64), count - 1)


def jackknife(scores: Array, curvatures: Array, groups: NDArray[np.int64], prior: Array) -> Array:
    """Covariance (G, G) by deleting a group each: one Newton step from the optimum.

    Unlike the sandwich estimate, it is not biased by the parameters having been fitted to the few
    groups (B. Efron, R. Tibshirani, An Introduction to the Bootstrap, 1993, chapter 11). `scores`
    (P, G): gradients of the cost by pair; `curvatures` (P, G, G): their derivatives; `prior` (G,):
    inverse variances that count as known.
    """
    total = curvatures.sum(axis=0) + np.diag(prior)
    moves = np.stack(
        [
            np.linalg.pinv(total - curvatures[groups == name].sum(axis=0), hermitian=True)
            @ scores[groups == name].sum(axis=0)
            for name in np.unique(groups)
        ]
    )
    inverse = np.linalg.pinv(total, hermitian=True)
    return jackknife_of(moves) + inverse @ np.diag(prior) @ inverse


def jackknife_of(moves: Array) -> Array:
    """Covariance (G, G) from the moves (K, G) of the optimum without each of K groups."""
    count = len(moves)
    moves = moves - moves.mean(axis=0)
    # The scatter of few groups is uncertain, so that errors in sigmas follow Student's t: widened,
    # one sigma has the coverage of a normal deviate.
    wider = special.stdtrit(count - 1, special.ndtr(1.0)) ** 2
    return np.asarray(wider * (count - 1) / count * moves.T @ moves)


# Change of the camera's velocity during half a frame, over the depth of the scene [1/s]:
# 2 m/s^2 for 15 ms at 3 m. Over the parallax per second it is `bend`, within these limits.
_BEND, _BEND_RANGE = 0.01, (0.03, 0.5)
# Scatter of a match before the fit [px], and at the least.
_NOISE_AT_START, _LEAST_NOISE = 5.0, 0.05
_HYPOTHESES = 60
# Newton's step [sigma] below which the optimum is near; its largest multiple that is taken.
_NEAR, _MOST_GAIN = 2.0, 8.0
# Levenberg-Marquardt's damping of the pairs' own unknowns stays in this range.
_DAMPING = (1e-6, 1e3)
# Range of the noise of a pair, relative to the median over all pairs.
_NOISE_RANGE = (0.6, 4.0)


def initial(
    problem: Problem,
    R_imu_cam: Array,
    offset: float,
    readout: float = 0.0,
    bias: Array | float = 0.0,
    noise: float = _NOISE_AT_START,
) -> Unknowns:
    """A calibration with the assumed lens, and the most likely directions of the pairs."""
    parameters, pairs = np.zeros(GLOBAL), problem.pairs
    parameters[[READOUT, model.OFFSET]] = readout, offset
    parameters[model.BIAS] = bias
    # R_imu_cam is contiguous: a transposed one would have the kernels compiled a second time.
    return redirected(
        problem,
        Unknowns(
            parameters,
            np.ascontiguousarray(R_imu_cam),
            np.tile(np.eye(9)[0], (pairs, 1)),
            np.full(pairs, noise),
            np.full(pairs, _DAMPING[0]),
        ),
    )


def restarted(problem: Problem, unknowns: Unknowns, caution: float = 1.0) -> Unknowns:
    """The calibration for other pairs, about its own lens, with a multiple of its median noise."""
    p = unknowns.parameters
    return initial(
        problem,
        unknowns.R_imu_cam,
        p[model.OFFSET],
        p[READOUT],
        p[model.BIAS],
        caution * float(np.median(unknowns.noise)),
    )


_STAY = np.zeros((1, LOCAL))


def stepped(unknowns: Unknowns, step: Array, local: Array = _STAY) -> Unknowns:
    """Unknowns after a step of the parameters (GLOBAL,) and of each pair (P, LOCAL)."""
    parameters = unknowns.parameters + step
    parameters[ROTATION] = 0.0
    back = Rotation.from_rotvec(-step[ROTATION]).as_matrix()
    # At most about a right angle: matches may not determine a step.
    along = np.clip(local[:, :2], -1.0, 1.0)
    direction = unknowns.own[:, :3] + np.einsum('pk,pki->pi', along, _tangents(unknowns))
    direction /= np.linalg.norm(direction, axis=1, keepdims=True)
    return unknowns._replace(
        parameters=parameters,
        R_imu_cam=unknowns.R_imu_cam @ back,
        own=np.hstack([direction, unknowns.own[:, 3:] + local[:, 2:]]),
    )


def _tangents(unknowns: Unknowns) -> Array:
    """Two unit vectors (P, 2, 3) at right angles to each direction and to each other."""
    directions = unknowns.own[:, :3]
    first = np.eye(3)[np.argmin(np.abs(directions), axis=1)]
    first = first - (first * directions).sum(axis=1, keepdims=True) * directions
    first /= np.linalg.norm(first, axis=1, keepdims=True)
    return np.stack([first, np.cross(directions, first)], axis=1)


@dataclass(frozen=True, slots=True, eq=False)
class Evaluation:
    """Cost of all pairs, and, if requested, their normal equations without their own unknowns."""

    losses: Array  # (P,) robust losses of the matches and the prior of the pair
    residuals: Array  # (N,) [px]
    score: Array  # (P, GLOBAL) gradient by the parameters
    reduced: Array  # (P, GLOBAL, GLOBAL) Hessian by the parameters
    back: Array  # (P, LOCAL, GLOBAL + 1) H_ll^-1 [H_lg, g_l]

    @property
    def cost(self) -> float:
        """Sum over the pairs."""
        return float(self.losses.sum())

    def local_step(self, step: Array) -> Array:
        """Step (P, LOCAL) of the pairs' own unknowns for a step of the parameters."""
        return np.asarray(-self.back[:, :, GLOBAL] - self.back[:, :, :GLOBAL] @ step)


def redirected(problem: Problem, unknowns: Unknowns) -> Unknowns:
    """Unknowns with the best direction of each pair among many that two of its matches fix."""
    moved = unknowns._replace(own=unknowns.own.copy())
    chosen = np.random.default_rng(0).integers(0, 2**30, (_HYPOTHESES, 2))
    model.find_directions(_through_lens(problem, moved), _path(problem, moved), moved, chosen)
    cosines = (moved.own[:, :3] * unknowns.own[:, :3]).sum(axis=1)
    moved.own[np.abs(cosines) < 0.999, 3:] = 0.0
    return moved


def evaluate(problem: Problem, unknowns: Unknowns, derivatives: bool = True) -> Evaluation:
    """Residuals and, with `derivatives`, the normal equations at `unknowns`."""
    return _evaluation(problem, unknowns, _sums(problem, unknowns, derivatives))


def _sums(problem: Problem, unknowns: Unknowns, derivatives: bool) -> model.Sums:
    size = problem.pairs if derivatives else 0
    sums = model.Sums(
        np.empty(problem.pairs),
        np.empty(len(problem.rows[0])),
        np.zeros((size, model.ALL)),
        np.zeros((size, model.ALL, model.ALL)),
    )
    path = _path(problem, unknowns)
    turned = cumulative_trapezoid(path.rotations, path.times, axis=0, initial=0.0)
    model.accumulate(
        _through_lens(problem, unknowns),
        path,
        turned,
        unknowns,
        _tangents(unknowns),
        derivatives,
        sums,
    )
    return sums


def _evaluation(problem: Problem, unknowns: Unknowns, sums: model.Sums) -> Evaluation:
    """Add the priors of the pairs' own unknowns, and eliminate these."""
    size, weights = len(sums.gradient), _local_priors(problem)
    own = np.hstack([np.zeros((problem.pairs, 2)), unknowns.own[:, 3:]])
    result = Evaluation(
        sums.losses + 0.5 * (weights * own**2).sum(axis=1),
        sums.residuals,
        np.empty((size, GLOBAL)),
        np.empty((size, GLOBAL, GLOBAL)),
        np.empty((size, LOCAL, GLOBAL + 1)),
    )
    if size:
        gradient = sums.gradient.copy()
        gradient[:, GLOBAL:] += weights * own
        model.eliminate(
            sums._replace(gradient=gradient),
            weights,
            unknowns.damping,
            result.score,
            result.reduced,
            result.back,
        )
    return result


def _local_priors(problem: Problem) -> Array:
    """Inverse variances (P, LOCAL); the 1 keeps a direction that no match determines."""
    return np.ascontiguousarray(
        np.repeat(
            [np.ones(problem.pairs), problem.bend_sigma**-2, problem.turn_sigma**-2],
            [2, 3, 3],
            axis=0,
        ).T
    )


def with_bends(problem: Problem, unknowns: Unknowns) -> Problem:
    """Problem with priors of `bend` from the parallax per second of the matches."""
    path, parameters = _path(problem, unknowns), unknowns.parameters
    rays = []
    for times, rows, points in zip(
        problem.times, problem.rows, _through_lens(problem, unknowns).points, strict=True
    ):
        at = times[problem.pair] + parameters[model.OFFSET] + parameters[READOUT] * rows
        directions = np.column_stack([points, np.ones(len(points))])
        rays.append(
            np.einsum(
                'nij,nj->ni',
                path.at(at) @ unknowns.R_imu_cam,
                directions / np.linalg.norm(directions, axis=1)[:, None],
            )
        )
    angles = _medians(problem, np.linalg.norm(np.cross(rays[0], rays[1]), axis=1))
    passing = np.maximum(angles / (problem.times[1] - problem.times[0]), 1e-6)
    return problem._replace(bend_sigma=np.clip(_BEND / passing, *_BEND_RANGE))


def _through_lens(problem: Problem, unknowns: Unknowns) -> Problem:
    """Problem with the points and their derivatives by the pixel through the estimated lens."""
    lens = unknowns.parameters[model.LENS]
    if not lens.any():
        return problem
    return problem._replace(
        points=problem.points + problem.by_lens @ lens,
        by_pixel=problem.by_pixel + problem.by_pixel_by_lens @ lens,
    )


def _medians(problem: Problem, values: Array) -> Array:
    """Median (P,) over the matches of each pair of values (N,)."""
    return np.array(
        [np.median(values[begin:end]) for begin, end in itertools.pairwise(problem.begin)]
    )


def _path(problem: Problem, unknowns: Unknowns) -> GyroPath:
    parameters = unknowns.parameters
    estimated = problem.gyro_rates + parameters[model.EXPOSURE] * problem.blur_rates
    return GyroPath.integrated(problem.gyro_times, estimated - parameters[model.BIAS])


@dataclass(frozen=True, slots=True, eq=False)
class Fit:
    """Result of a fit to the data of `problem`."""

    problem: Problem
    unknowns: Unknowns
    free: NDArray[np.bool_]  # (GLOBAL,) parameters that were fitted
    weights: Array  # (N,) of the matches, 1 where the residual is 0
    covariance: Array  # (GLOBAL, GLOBAL), zero rows and columns where a parameter was held
    information: Array  # (GLOBAL, GLOBAL) the Hessian, before any prior
    converged: bool


def fit(
    problem: Problem,
    unknowns: Unknowns,
    free: NDArray[np.bool_],
    *,
    rounds: int = 60,
    tolerance: float = 0.05,
) -> Fit:
    """Minimise the cost over the `free` (GLOBAL,) parameters, and estimate the noise meanwhile.

    Newton steps shorter than `tolerance` [sigma of the parameters] end the fit. After `rounds`
    the sigmas contain what may be left to the optimum.
    """
    at = _Iterate(unknowns, evaluate(problem, unknowns), np.zeros(int(free.sum())))
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
        noise_known = change < 0.03
        unknowns = at.unknowns._replace(noise=noise)
        if change > 0.1:
            # The cost is not convex in the directions: less noise distinguishes more of them.
            unknowns = _chosen(
                problem,
                _settled(problem, redirected(problem, unknowns)),
                _settled(problem, unknowns),
            )[0]
        at = _Iterate(unknowns, evaluate(problem, unknowns), np.zeros_like(at.newton), at.damping)
    unknowns = at.unknowns._replace(damping=np.zeros(problem.pairs))
    evaluation = evaluate(problem, unknowns)
    limits = model.ROBUST * unknowns.noise[problem.pair]
    weights = np.asarray(geman_mcclure_weight((evaluation.residuals / limits) ** 2))
    covariance = np.zeros((GLOBAL, GLOBAL))
    covariance[np.ix_(free, free)] = jackknife(
        evaluation.score[:, free],
        bent(weights) * evaluation.reduced[:, free][:, :, free],
        stretches(problem.middles),
        problem.prior[free],
    )
    if not converged:
        covariance[np.ix_(free, free)] += _MOST_GAIN**2 * np.outer(at.newton, at.newton)
    return Fit(
        problem, unknowns, free, weights, covariance, evaluation.reduced.sum(axis=0), converged
    )


def cost_curve(
    problem: Problem, final: Fit, interval: float, progress: Callable[[float], object]
) -> Array:
    """Readout times from an interval upwards to one downwards, and the costs with each (2, K)."""
    best = float(final.unknowns.parameters[READOUT])
    held = final.free.copy()
    held[READOUT] = False
    values = np.unique(np.concatenate([np.linspace(-interval, interval, 13), [best]]))
    costs = np.empty(len(values))
    order = np.argsort(np.abs(values - best))
    begin = _refitted(problem, restarted(problem, final.unknowns), held, 5)
    for side in (order[values[order] <= best], order[values[order] > best]):
        unknowns = begin
        for k in side:
            parameters = unknowns.parameters.copy()
            parameters[READOUT] = values[k]
            unknowns = _refitted(problem, unknowns._replace(parameters=parameters), held, 2)
            costs[k] = evaluate(problem, unknowns, derivatives=False).cost
            progress(float(np.isfinite(costs).mean()))
    # A match of a frame is in many pairs: scaled to the curvature 1 / sigma^2 at the minimum.
    information = (
        final.information * (problem.begin[-1] / final.problem.begin[-1]) + np.diag(problem.prior)
    )[np.ix_(final.free, final.free)]
    place = int(np.count_nonzero(final.free[:READOUT]))
    naive = float(np.linalg.inv(information)[place, place])
    return np.array([values, (costs - costs.min()) * naive / final.covariance[READOUT, READOUT]])


def _refitted(
    problem: Problem, unknowns: Unknowns, free: NDArray[np.bool_], rounds: int
) -> Unknowns:
    """Unknowns after plain Gauss-Newton steps."""
    for _ in range(rounds):
        evaluation = evaluate(problem, unknowns)
        H, gradient = _normal_equations(problem, evaluation, unknowns, free)
        step = np.zeros(GLOBAL)
        step[free] = -np.linalg.solve(H + 1e-6 * np.diag(np.diag(H)), gradient)
        unknowns = stepped(unknowns, step, evaluation.local_step(step))
    return unknowns


def _normal_equations(
    problem: Problem, evaluation: Evaluation, unknowns: Unknowns, free: NDArray[np.bool_]
) -> tuple[Array, Array]:
    """Hessian and gradient of the cost with its prior by the free parameters."""
    H = evaluation.reduced.sum(axis=0) + np.diag(problem.prior)
    gradient = evaluation.score.sum(axis=0) + problem.prior * (
        unknowns.parameters - problem.center
    )
    return H[np.ix_(free, free)], gradient[free]


def _settled(problem: Problem, unknowns: Unknowns) -> Unknowns:
    """Unknowns after two steps of the pairs' own unknowns."""
    for _ in range(2):
        still = np.zeros(GLOBAL)
        moved = stepped(unknowns, still, evaluate(problem, unknowns).local_step(still))
        unknowns = _chosen(problem, moved, unknowns)[0]
    return unknowns


def _chosen(problem: Problem, moved: Unknowns, kept: Unknowns) -> tuple[Unknowns, float]:
    """The calibration of `moved`, each pair with the better of its unknowns in both; the cost."""
    stay = moved._replace(own=kept.own)
    losses = evaluate(problem, moved, derivatives=False).losses
    others = evaluate(problem, stay, derivatives=False).losses
    better = losses <= others
    unknowns = moved._replace(
        own=np.where(better[:, None], moved.own, kept.own),
        damping=np.clip(kept.damping * np.where(better, 0.2, 10.0), *_DAMPING),
    )
    return unknowns, float(np.minimum(losses, others).sum())


class _Iterate(NamedTuple):
    """State of the fit."""

    unknowns: Unknowns
    evaluation: Evaluation
    newton: Array  # Newton's step to here, of the free parameters
    damping: float = 1e-3  # Levenberg-Marquardt's, of the calibration's parameters
    length: float = math.inf  # of `newton` [sigma]
    gain: float = 1.0  # step taken, over `newton`


def _step(problem: Problem, at: _Iterate, free: NDArray[np.bool_]) -> _Iterate:
    """State after a step that lowers the cost; the same if none does."""

    def prior_cost(unknowns: Unknowns) -> float:
        return 0.5 * float(problem.prior @ (unknowns.parameters - problem.center) ** 2)

    cost = at.evaluation.cost + prior_cost(at.unknowns)
    H, gradient = _normal_equations(problem, at.evaluation, at.unknowns, free)
    newton = np.linalg.solve(H + 1e-9 * np.diag(np.diag(H)), gradient).astype(np.float64)
    length, damping = math.sqrt(max(float(gradient @ newton), 0.0)), at.damping
    # The weights of a robust loss make Gauss-Newton steps too short, by the share that the last
    # step left of itself: J. Barzilai, J. M. Borwein, Two-point step size gradient methods, 1988.
    left = float(newton @ H @ at.newton) / max(float(at.newton @ H @ at.newton), 1e-12)
    gain = min(max(at.gain / max(1.0 - left, 1e-3), 1.0), _MOST_GAIN)
    for _ in range(8):
        step = np.zeros(GLOBAL)
        step[free] = -gain * np.linalg.solve(H + damping * np.diag(np.diag(H)), gradient)
        tried = stepped(at.unknowns, step, at.evaluation.local_step(step))
        result = evaluate(problem, tried)
        if result.cost + prior_cost(tried) > cost:
            tried, tried_cost = _chosen(problem, tried, at.unknowns)
            if tried_cost + prior_cost(tried) > cost:
                gain, damping = 1.0, max(10.0 * damping, 1e-3)
                continue
            result = evaluate(problem, tried)
        return _Iterate(tried, result, newton, max(0.1 * damping, 1e-9), length, gain)
    return at._replace(damping=damping, length=length)


def _estimated_noise(problem: Problem, at: _Iterate) -> Array:
    """Noise (P,) of each pair by its residuals [px]; a third of the last at least."""
    # Some three unknowns of each pair hide a part of it.
    noise = np.array(
        [
            robust_scale(at.evaluation.residuals[begin:end], 0.0, 3.0)
            for begin, end in itertools.pairwise(problem.begin)
        ]
    )
    middle = max(float(np.median(noise)), _LEAST_NOISE)
    return np.maximum(
        np.clip(noise, _NOISE_RANGE[0] * middle, _NOISE_RANGE[1] * middle), at.unknowns.noise / 3.0
    )


def bent(weights: Array) -> float:
    """Curvature of the loss, all (N,) matches, over the weight of Gauss-Newton."""
    return float((weights * (4.0 * np.sqrt(weights) - 3.0)).sum() / weights.sum())


# -- Errors beyond the noise of the matches ----------------------------------------------------

# Regions of the image: columns and rows of equally many points.
_COLUMNS, _ROWS = 4, 3
# Squared difference, in sigmas, of the parameters of two halves by chance, at most: in the mean,
# and of each.
_CHANCE, _GROSS = 1.75, 9.0


class ModelErrors(NamedTuple):
    """Deviations of lens and gyro from their model, 1 sigma each."""

    focal: float = 0.005  # focal length, relative
    aspect: float = 0.002  # ratio of the two focal lengths
    center: float = 0.005  # principal point, share of the image's width
    radial: float = 0.02  # first coefficient of the distortion
    second: float = 0.0  # second coefficient, r^4
    gyro_scale: float = 0.005  # of each axis, relative
    gyro_skew: float = 0.005  # between each two axes [rad]


# Beyond an estimated lens: of the focal length, the first coefficient and the principal point.
ESTIMATED_LENS = ModelErrors(focal=0.0, center=0.0, radial=0.0, second=0.02)


def widened(final: Fit, errors: ModelErrors | None) -> Fit:
    """The fit with a covariance of all errors, not only the noise of the matches."""
    wider = np.sqrt(_between_regions(final) * _disagreement(final))
    scatter = final.covariance * np.outer(wider, wider)
    if errors is not None:
        # One Newton step from the optimum with each error.
        here = evaluate(final.problem, final.unknowns)
        H, _ = _normal_equations(final.problem, here, final.unknowns, final.free)
        gradients = [
            (evaluate(*there).score - here.score).sum(axis=0)[final.free]
            for there in _perturbed(final, errors)
        ]
        moves = np.linalg.solve(H, np.transpose(gradients))
        scatter[np.ix_(final.free, final.free)] += moves @ moves.T
    return replace(final, covariance=scatter)


def _between_regions(final: Fit) -> Array:
    """Factors (G,) of the variances by the scatter of regions of the image beyond that of cells.

    Cells are regions times stretches of time: if the regions scatter no more than these, the
    scatter of the stretches is complete.
    """
    problem, free, curve = final.problem, final.free, bent(final.weights)
    index = np.ix_(free, free)
    region, stretch = _regions(problem.points[0]), stretches(problem.middles)
    sums = _sums(problem, final.unknowns, derivatives=True)
    whole = _evaluation(problem, final.unknowns, sums)
    prior = np.diag(problem.prior)
    inverse = np.linalg.inv((curve * whole.reduced.sum(axis=0) + prior)[index])
    moves, cells = [], np.zeros_like(inverse)
    for name in np.unique(region):
        of_region = _sums(problem.matches(region == name), final.unknowns, derivatives=True)
        rest = _evaluation(
            problem,
            final.unknowns,
            sums._replace(
                gradient=sums.gradient - of_region.gradient,
                hessian=sums.hessian - of_region.hessian,
            ),
        )
        own = (whole.score - rest.score)[:, free]
        rest_curvature = (curve * rest.reduced.sum(axis=0) + prior)[index]
        moves.append(np.linalg.pinv(rest_curvature, hermitian=True) @ own.sum(axis=0))
        of_cells = np.stack([own[stretch == k].sum(axis=0) for k in np.unique(stretch)]) @ inverse
        cells += of_cells.T @ of_cells
    beyond = np.diag(jackknife_of(np.array(moves)) - cells)
    factors = np.ones(GLOBAL)
    factors[free] += np.maximum(beyond, 0.0) / np.diag(final.covariance)[free]
    return factors


def _regions(points: Array) -> NDArray[np.int64]:
    """Region (N,) of the image of each point (N, 2): columns and rows of equally many points."""

    def band(values: Array, count: int) -> NDArray[np.int64]:
        borders = np.quantile(values, np.arange(1, count) / count)
        return np.searchsorted(borders, values)

    return band(points[:, 0], _COLUMNS) + _COLUMNS * band(points[:, 1], _ROWS)


def _disagreement(final: Fit) -> Array:
    """Factors (G,) of the variances by the difference of both halves; 1 if it is by chance."""
    middles, free = final.problem.middles, final.free
    first = middles < np.median(middles)
    one, other = (
        fit(final.problem.pairs_of(part), final.unknowns.pairs_of(part), free, rounds=15)
        for part in (first, ~first)
    )
    difference = one.unknowns.parameters - other.unknowns.parameters
    difference[ROTATION] = log_so3(one.unknowns.R_imu_cam.T @ other.unknowns.R_imu_cam)
    # The whole lets expect four times its own; less than half of that is chance, of few stretches.
    variances = np.maximum(
        np.diag(one.covariance + other.covariance), 2.0 * np.diag(final.covariance)
    )
    squares = difference[free] ** 2 / variances[free]
    mean = float(np.minimum(squares, _GROSS).mean())
    factors = np.ones(GLOBAL)
    factors[free] = np.maximum(
        mean if mean > _CHANCE else 1.0, np.where(squares > _GROSS, squares, 1.0)
    )
    return factors


def _perturbed(final: Fit, errors: ModelErrors) -> Iterator[tuple[Problem, Unknowns]]:
    """Data and unknowns with one sigma of each error of the model."""
    problem, unknowns = final.problem, final.unknowns
    center = errors.center * float(
        np.ptp(problem.points[0, :, 0]) / np.mean(problem.by_pixel[0, :, 0, 0])
    )
    for k, error in enumerate((errors.focal, errors.radial, center, center)):
        if error:
            parameters = unknowns.parameters.copy()
            parameters[model.FOCAL + k] += error
            yield problem, unknowns._replace(parameters=parameters)
    squares = (problem.points**2).sum(axis=2, keepdims=True)
    for points in (
        problem.points / [1.0, 1.0 + errors.aspect],
        problem.points * (1.0 - errors.second * squares**2),
    ):
        yield problem._replace(points=points), unknowns
    for i in range(3):
        for j in range(i + 1):
            mixing = np.zeros((3, 3))
            mixing[i, j] = mixing[j, i] = errors.gyro_scale if i == j else errors.gyro_skew
            yield problem._replace(gyro_rates=problem.gyro_rates @ (np.eye(3) + mixing)), unknowns


# Sigma of the direction of motion of a pair by the noise of its matches [rad], at the most.
_KNOWN_DIRECTION = 0.1


def move_of_poses(final: Fit, covariance: Array) -> float:
    """Move of the direction of the median pair by the doubt of the parameters, over its sigma."""
    problem, sums = final.problem, _sums(final.problem, final.unknowns, derivatives=True)
    H = sums.hessian[:, GLOBAL:, GLOBAL:]
    H = H + np.tril(H, -1).swapaxes(1, 2) + _local_priors(problem)[:, :, None] * np.eye(LOCAL)
    back = _evaluation(problem, final.unknowns, sums).back[:, :2, :GLOBAL]
    move, own = (
        float(np.sqrt(np.median(np.trace(of_pairs, axis1=1, axis2=2))))
        for of_pairs in (back @ covariance @ back.swapaxes(1, 2), np.linalg.inv(H)[:, :2, :2])
    )
    return move / min(own, _KNOWN_DIRECTION)
