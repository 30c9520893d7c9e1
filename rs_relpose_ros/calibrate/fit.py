"""The robust fit: Levenberg-Marquardt over the calibration, everything of the pairs eliminated."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
import itertools
import math
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from rs_relpose_ros.calibrate.coplanarity import (
    accumulate,
    ALL,
    BIAS,
    EXPOSURE,
    find_directions,
    FOCAL,
    GLOBAL,
    OFFSET,
    Problem,
    READOUT,
    ROBUST,
    ROTATION,
    Sums,
    Unknowns,
)
from rs_relpose_ros.calibrate.covariance import jackknife, stretches
from rs_relpose_ros.calibrate.gyro_path import GyroPath
from rs_relpose_ros.calibrate.result import CostCurve

Array = NDArray[np.float64]

# Change of the camera's velocity while it takes half a frame, over the depth of the scene [1/s]:
# 2 m/s^2 for 15 ms at 3 m. Over the parallax per second it is `bend`, within these limits.
_BEND, _BEND_RANGE = 0.01, (0.03, 0.5)
# Scatter of a match as it is before anything is known [px], and at the least.
_NOISE_AT_START, _LEAST_NOISE = 5.0, 0.05
_HYPOTHESES = 60
# Newton's step [sigma] below which the optimum is near.
_NEAR = 2.0
# Levenberg-Marquardt's damping of the pairs' own unknowns stays in this range.
_DAMPING = (1e-6, 1e3)
LOCAL = ALL - GLOBAL
# Noise of a pair is not let out of this range of the median over all pairs.
_NOISE_RANGE = (0.6, 4.0)


def initial(problem: Problem, R_imu_cam: Array, offset: float, readout: float = 0.0,
            bias: Array | None = None, log_focal: float = 0.0,
            noise: float = _NOISE_AT_START) -> Unknowns:
    """A calibration, and the directions of the pairs that it makes likely."""
    parameters, pairs = np.zeros(GLOBAL), problem.pairs
    parameters[READOUT], parameters[OFFSET], parameters[FOCAL] = readout, offset, log_focal
    if bias is not None:
        parameters[BIAS:BIAS + 3] = bias
    # R_imu_cam is contiguous: a transposed one would have the kernels compiled a second time.
    return redirected(problem, Unknowns(
        parameters, np.ascontiguousarray(R_imu_cam), np.tile([1.0, 0.0, 0.0], (pairs, 1)),
        np.zeros((pairs, 3)), np.zeros((pairs, 3)), np.full(pairs, noise),
        np.full(pairs, _DAMPING[0])))


def restarted(problem: Problem, unknowns: Unknowns, caution: float = 1.0) -> Unknowns:
    """The calibration of `unknowns` for other pairs, with a multiple of its median noise."""
    p = unknowns.parameters
    return initial(problem, unknowns.R_imu_cam, p[OFFSET], p[READOUT], p[BIAS:BIAS + 3], p[FOCAL],
                   caution * float(np.median(unknowns.noise)))


def stepped(unknowns: Unknowns, step: Array, local: Array) -> Unknowns:
    """Unknowns after a step of the parameters (GLOBAL,) and of each pair (P, LOCAL)."""
    parameters = unknowns.parameters + step
    parameters[ROTATION:ROTATION + 3] = 0.0
    rotation = Rotation.from_rotvec(step[ROTATION:ROTATION + 3]).as_matrix()
    # At most a right angle or so: nothing limits a step that the matches do not determine.
    along = np.clip(local[:, :2], -1.0, 1.0)
    direction = unknowns.direction + np.einsum('pk,pki->pi', along, _tangents(unknowns.direction))
    direction /= np.linalg.norm(direction, axis=1, keepdims=True)
    return unknowns._replace(
        parameters=parameters, R_imu_cam=rotation @ unknowns.R_imu_cam, direction=direction,
        bend=unknowns.bend + local[:, 2:5], turn=unknowns.turn + local[:, 5:])


def _tangents(directions: Array) -> Array:
    """Two unit vectors (P, 2, 3) at right angles to each unit vector (P, 3) and to each other."""
    first = np.eye(3)[np.argmin(np.abs(directions), axis=1)]
    first = first - (first * directions).sum(axis=1, keepdims=True) * directions
    first /= np.linalg.norm(first, axis=1, keepdims=True)
    return np.stack([first, np.cross(directions, first)], axis=1)


@dataclass(frozen=True, slots=True, eq=False)
class Evaluation:
    """Cost of all pairs, and their normal equations without the pairs' own unknowns.

    The last three are empty where derivatives were not asked for.
    """

    losses: Array       # (P,) robust losses of the matches and the prior of the pair
    residuals: Array    # (N,) [px]
    score: Array        # (P, GLOBAL) gradient by the parameters
    reduced: Array      # (P, GLOBAL, GLOBAL) Hessian by the parameters
    back: Array         # (P, LOCAL, GLOBAL + 1) H_ll^-1 [H_lg, g_l]

    @property
    def cost(self) -> float:
        """Sum over the pairs."""
        return float(self.losses.sum())

    def local_step(self, step: Array) -> Array:
        """Step (P, LOCAL) of the pairs' own unknowns that goes with one of the parameters."""
        return np.asarray(-self.back[:, :, GLOBAL] - self.back[:, :, :GLOBAL] @ step)


def redirected(problem: Problem, unknowns: Unknowns) -> Unknowns:
    """Unknowns with the best direction of each pair among many that two of its matches fix."""
    direction = unknowns.direction.copy()
    chosen = np.random.default_rng(0).integers(0, 2**30, (_HYPOTHESES, 2))
    find_directions(problem, _path(problem, unknowns), unknowns, chosen, direction)
    changed = (np.abs((direction * unknowns.direction).sum(axis=1)) < 0.999)[:, None]
    return unknowns._replace(
        direction=direction, bend=np.where(changed, 0.0, unknowns.bend),
        turn=np.where(changed, 0.0, unknowns.turn))


def evaluate(problem: Problem, unknowns: Unknowns, derivatives: bool = True) -> Evaluation:
    """Residuals and, with `derivatives`, the normal equations at `unknowns`."""
    pairs = problem.pairs
    size = pairs if derivatives else 0
    sums = Sums(np.empty(pairs), np.empty(len(problem.view1.points)), np.zeros((size, ALL)),
                np.zeros((size, ALL, ALL)))
    accumulate(problem, _path(problem, unknowns), unknowns, _tangents(unknowns.direction),
               derivatives, sums)
    # Priors of the pairs' own unknowns; the 1 keeps a direction that no match determines.
    own = np.hstack([np.zeros((pairs, 2)), unknowns.bend, unknowns.turn])
    weights = np.repeat([np.ones(pairs), problem.bend_sigma**-2, problem.turn_sigma**-2],
                        [2, 3, 3], axis=0).T
    losses = sums.losses + 0.5 * (weights * own**2).sum(axis=1)
    if not derivatives:
        return Evaluation(losses, sums.residuals, *3 * (np.empty(0),))
    H = sums.hessian + np.tril(sums.hessian, -1).swapaxes(1, 2)
    g_g, H_gg = sums.gradient[:, :GLOBAL], H[:, :GLOBAL, :GLOBAL]
    g_l, H_lg = sums.gradient[:, GLOBAL:] + weights * own, H[:, GLOBAL:, :GLOBAL]
    H_ll = H[:, GLOBAL:, GLOBAL:] + weights[:, :, None] * np.eye(LOCAL)
    H_ll *= 1.0 + unknowns.damping[:, None, None] * np.eye(LOCAL)
    # Schur complement: score = g_g - H_gl H_ll^-1 g_l, reduced = H_gg - H_gl H_ll^-1 H_lg.
    back = np.linalg.solve(H_ll, np.concatenate([H_lg, g_l[:, :, None]], axis=2))
    eliminated = H_lg.swapaxes(1, 2) @ back
    return Evaluation(losses, sums.residuals, g_g - eliminated[:, :, GLOBAL],
                      H_gg - eliminated[:, :, :GLOBAL], back)


def with_bends(problem: Problem, unknowns: Unknowns) -> Problem:
    """Problem with priors of `bend` from the parallax per second that the matches show."""
    path, parameters = _path(problem, unknowns), unknowns.parameters
    pair = np.repeat(np.arange(problem.pairs), np.diff(problem.begin))
    rays = []
    for view in (problem.view1, problem.view2):
        at = view.times[pair] + parameters[OFFSET] + parameters[READOUT] * view.rows
        turns = path.at(at) @ unknowns.R_imu_cam
        seen = np.column_stack([view.points / np.exp(parameters[FOCAL]),
                                np.ones(len(view.points))])
        rays.append(np.einsum('nij,nj->ni', turns, seen / np.linalg.norm(seen, axis=1)[:, None]))
    angles = _medians(problem, np.linalg.norm(np.cross(rays[0], rays[1]), axis=1))
    passing = np.maximum(angles / (problem.view2.times - problem.view1.times), 1e-6)
    return problem._replace(bend_sigma=np.clip(_BEND / passing, *_BEND_RANGE))


def _medians(problem: Problem, values: Array) -> Array:
    """Median (P,) over the matches of each pair of values (N,)."""
    return np.array([np.median(values[begin:end])
                     for begin, end in itertools.pairwise(problem.begin)])


def _path(problem: Problem, unknowns: Unknowns) -> GyroPath:
    parameters = unknowns.parameters
    seen = problem.gyro_rates + parameters[EXPOSURE] * problem.blur_rates
    return GyroPath.integrated(problem.gyro_times, seen, parameters[BIAS:BIAS + 3])


@dataclass(frozen=True, slots=True, eq=False)
class Fit:
    """Result of a fit to the data of `problem`."""

    problem: Problem
    unknowns: Unknowns
    weights: Array        # (N,) of the matches, 1 where the residual is 0
    covariance: Array     # (GLOBAL, GLOBAL), zero rows and columns where a parameter was held
    information: Array    # (GLOBAL, GLOBAL) the Hessian, before any prior
    converged: bool


def fit(problem: Problem, unknowns: Unknowns, free: NDArray[np.bool_], *, rounds: int = 40,
        tolerance: float = 0.1) -> Fit:
    """Minimise the cost over the `free` (GLOBAL,) parameters, and learn the noise on the way.

    Newton steps shorter than `tolerance` [sigma of the parameters] end the fit.
    """
    prior = problem.prior
    at = _Iterate(unknowns, evaluate(problem, unknowns))
    converged = False
    for _ in range(rounds):
        at = _step(problem, at, free, prior)
        if at.length > _NEAR:
            continue
        # Noise is learned near the optimum only: far from it, residuals are no noise.
        noise = _learned_noise(problem, at)
        change = float(np.median(np.abs(np.log(noise / at.unknowns.noise))))
        converged = at.length < tolerance and change < 0.03
        if converged:
            break
        unknowns = at.unknowns._replace(noise=noise)
        if change > 0.1:
            # The cost is not convex in the directions: less noise tells more of them apart.
            unknowns = _better_directions(problem, unknowns)
        at = at._replace(unknowns=unknowns, evaluation=evaluate(problem, unknowns))
    unknowns = at.unknowns._replace(damping=np.zeros(problem.pairs))
    evaluation = evaluate(problem, unknowns)
    noise = np.repeat(unknowns.noise, np.diff(problem.begin))
    weights = np.asarray((1.0 + (evaluation.residuals / (ROBUST * noise)) ** 2) ** -2)
    return Fit(problem, unknowns, weights, _covariance(problem, evaluation, weights, free, prior),
               evaluation.reduced.sum(axis=0), converged)


def refit(problem: Problem, coarse: Unknowns, free: NDArray[np.bool_], *, rounds: int = 40,
          tolerance: float = 0.1) -> Fit:
    """Fit from the calibration of a coarser one, with priors of `bend` by what it shows."""
    begin = restarted(problem, coarse, 2.0)
    return fit(with_bends(problem, begin), begin, free, rounds=rounds, tolerance=tolerance)


def cost_curve(problem: Problem, final: Fit, free: NDArray[np.bool_], interval: float,
               progress: Callable[[float], object]) -> CostCurve:
    """Cost of `problem` with the read-out time held, from an interval upwards to one downwards."""
    best = float(final.unknowns.parameters[READOUT])
    held = free.copy()
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
    # One match of a frame serves in many pairs: scaled so that the curvature at the minimum is
    # 1 / sigma^2.
    information = (final.information * (problem.begin[-1] / final.problem.begin[-1])
                   + np.diag(problem.prior))[np.ix_(free, free)]
    naive = float(np.linalg.inv(information)[0, 0])
    return CostCurve(values, (costs - costs.min()) * naive / final.covariance[READOUT, READOUT])


def _refitted(problem: Problem, unknowns: Unknowns, free: NDArray[np.bool_],
              rounds: int) -> Unknowns:
    """Unknowns after plain Gauss-Newton steps."""
    for _ in range(rounds):
        evaluation = evaluate(problem, unknowns)
        H = (evaluation.reduced.sum(axis=0) + np.diag(problem.prior))[np.ix_(free, free)]
        score = evaluation.score.sum(axis=0) + problem.prior * unknowns.parameters
        step = np.zeros(GLOBAL)
        step[free] = -np.linalg.solve(H + 1e-6 * np.diag(np.diag(H)), score[free])
        unknowns = stepped(unknowns, step, evaluation.local_step(step))
    return unknowns


def _better_directions(problem: Problem, unknowns: Unknowns) -> Unknowns:
    """Each pair with the better of its own direction and the one found anew."""
    kept = _settled(problem, unknowns)
    return _chosen(problem, _settled(problem, redirected(problem, unknowns)), kept)[0]


def _settled(problem: Problem, unknowns: Unknowns) -> Unknowns:
    """Unknowns after two steps of the pairs' own unknowns."""
    for _ in range(2):
        still = np.zeros(GLOBAL)
        moved = stepped(unknowns, still, evaluate(problem, unknowns).local_step(still))
        unknowns = _chosen(problem, moved, unknowns)[0]
    return unknowns


def _chosen(problem: Problem, moved: Unknowns, kept: Unknowns) -> tuple[Unknowns, float]:
    """The calibration of `moved`, each pair with the better of its unknowns in both; the cost."""
    stay = moved._replace(direction=kept.direction, bend=kept.bend, turn=kept.turn)
    losses = evaluate(problem, moved, derivatives=False).losses
    others = evaluate(problem, stay, derivatives=False).losses
    better = losses <= others
    pairs = better[:, None]
    unknowns = moved._replace(
        direction=np.where(pairs, moved.direction, kept.direction),
        bend=np.where(pairs, moved.bend, kept.bend), turn=np.where(pairs, moved.turn, kept.turn),
        damping=np.clip(kept.damping * np.where(better, 0.2, 10.0), *_DAMPING))
    return unknowns, float(np.minimum(losses, others).sum())


class _Iterate(NamedTuple):
    """Where the fit is."""

    unknowns: Unknowns
    evaluation: Evaluation
    damping: float = 1e-3       # Levenberg-Marquardt's, of the calibration's parameters
    length: float = math.inf    # of Newton's step to here [sigma]


def _step(problem: Problem, at: _Iterate, free: NDArray[np.bool_], prior: Array) -> _Iterate:
    """Where a step leads that lowers the cost; the same place where none does."""
    cost = at.evaluation.cost + _prior_cost(at.unknowns, prior)
    H = (at.evaluation.reduced.sum(axis=0) + np.diag(prior))[np.ix_(free, free)]
    gradient = (at.evaluation.score.sum(axis=0) + prior * at.unknowns.parameters)[free]
    newton = np.linalg.solve(H + 1e-9 * np.diag(np.diag(H)), gradient)
    length, damping = float(np.sqrt(max(gradient @ newton, 0.0))), at.damping
    for _ in range(8):
        step = np.zeros(GLOBAL)
        step[free] = -np.linalg.solve(H + damping * np.diag(np.diag(H)), gradient)
        tried = stepped(at.unknowns, step, at.evaluation.local_step(step))
        result = evaluate(problem, tried)
        if result.cost + _prior_cost(tried, prior) > cost:
            tried, tried_cost = _chosen(problem, tried, at.unknowns)
            if tried_cost + _prior_cost(tried, prior) > cost:
                damping = max(10.0 * damping, 1e-3)
                continue
            result = evaluate(problem, tried)
        return _Iterate(tried, result, max(0.1 * damping, 1e-9), length)
    return at._replace(damping=damping, length=length)


def _prior_cost(unknowns: Unknowns, prior: Array) -> float:
    return 0.5 * float(prior @ unknowns.parameters**2)


def _learned_noise(problem: Problem, at: _Iterate) -> Array:
    """Noise (P,) of each pair that the residuals show [px]; a third of the last at least."""
    counts = np.diff(problem.begin)
    # Two unknowns and a bit of each pair hide some of it.
    noise = 1.4826 * _medians(problem, np.abs(at.evaluation.residuals)) * np.sqrt(
        counts / np.maximum(counts - 3.0, 1.0))
    middle = max(float(np.median(noise)), _LEAST_NOISE)
    return np.maximum(np.clip(noise, _NOISE_RANGE[0] * middle, _NOISE_RANGE[1] * middle),
                      at.unknowns.noise / 3.0)


def _covariance(problem: Problem, evaluation: Evaluation, weights: Array,
                free: NDArray[np.bool_], prior: Array) -> Array:
    covariance = np.zeros((GLOBAL, GLOBAL))
    covariance[np.ix_(free, free)] = jackknife(
        evaluation.score[:, free], bent(weights) * evaluation.reduced[:, free][:, :, free],
        stretches(problem.middles), prior[free])
    return covariance


def bent(weights: Array) -> float:
    """Curvature of the loss, all (N,) matches, over the weight that Gauss-Newton takes."""
    return float((weights * (4.0 * np.sqrt(weights) - 3.0)).sum() / weights.sum())
