"""The robust fit: Levenberg-Marquardt over the calibration, everything of the pairs eliminated."""

from __future__ import annotations

from dataclasses import dataclass, replace
import itertools

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from rs_relpose_ros.calibrate.coplanarity import (
    accumulate,
    BIAS,
    find_directions,
    FOCAL,
    GLOBAL,
    LOCAL,
    OFFSET,
    READOUT,
    ROTATION,
)
from rs_relpose_ros.calibrate.covariance import jackknife, stretches
from rs_relpose_ros.calibrate.gyro_path import GyroPath

Array = NDArray[np.float64]

# Distance [sigma] at which the Geman-McClure loss levels off.
ROBUST = 3.0
# Change of the camera's velocity while it takes half a frame, over the depth of the scene [1/s]:
# 2 m/s^2 for 15 ms at 3 m. Over the parallax per second it is `bend`, within these limits.
_BEND, _BEND_RANGE, BEND_AT_START = 0.01, (0.03, 0.5), 0.1
# Rotation between two frames that the gyro's samples do not tell even without noise [rad].
_LEAST_TURN = 2e-5
# Scatter of a match as it is before anything is known [px], and at the least.
_NOISE_AT_START, _LEAST_NOISE = 5.0, 0.05
_HYPOTHESES = 60
# Newton's step [sigma] below which the optimum is near.
_NEAR = 2.0
# Levenberg-Marquardt's damping of the pairs' own unknowns stays in this range.
_DAMPING = (1e-6, 1e3)
# Noise of a pair is not let out of this range of the median over all pairs.
_NOISE_RANGE = (0.6, 4.0)


@dataclass(frozen=True, slots=True, eq=False)
class Problem:
    """Data of a fit: what `accumulate` takes of the gyro's samples and of the pairs."""

    gyro_times: Array
    gyro_rates: Array
    begin: NDArray[np.int64]
    middle: NDArray[np.int64]
    first: NDArray[np.int64]
    second: NDArray[np.int64]
    times1: Array
    times2: Array
    covariates1: Array
    covariates2: Array
    points1: Array
    points2: Array
    rows1: Array
    rows2: Array
    by_pixel1: Array
    by_pixel2: Array
    gyro_density: float
    bend_sigma: Array

    @property
    def turn_sigma(self) -> Array:
        """1 sigma (P,) of each component of `turn`, from the white noise of the gyro [rad]."""
        return np.sqrt(self.gyro_density**2 * (self.times2 - self.times1) + _LEAST_TURN**2)

    @property
    def pairs(self) -> int:
        """Number of pairs."""
        return len(self.times1)


@dataclass(frozen=True, slots=True, eq=False)
class State:
    """A calibration, and what belongs to the pairs alone.

    `parameters` (GLOBAL,): read-out, offset of the middle row, slope, three unused, bias, log of
    the focal length's factor. `direction`, `bend`, `turn` (P, 3), `noise` (P,) [px] and `damping`
    (P,): see `accumulate`.
    """

    parameters: Array
    R_imu_cam: Array
    direction: Array
    bend: Array
    turn: Array
    noise: Array
    damping: Array

    @classmethod
    def start(cls, problem: Problem, R_imu_cam: Array, offset: float, readout: float = 0.0,
              bias: Array | None = None, log_focal: float = 0.0,
              noise: float = _NOISE_AT_START) -> State:
        """State with the directions that these parameters make likely."""
        parameters = np.zeros(GLOBAL)
        parameters[READOUT], parameters[OFFSET], parameters[FOCAL] = readout, offset, log_focal
        if bias is not None:
            parameters[BIAS:BIAS + 3] = bias
        direction = np.tile([1.0, 0.0, 0.0], (problem.pairs, 1))
        # A transposed one would have the kernels compiled a second time.
        state = cls(parameters, np.ascontiguousarray(R_imu_cam), direction,
                    np.zeros((problem.pairs, 3)), np.zeros((problem.pairs, 3)),
                    np.full(problem.pairs, noise),
                    np.full(problem.pairs, _DAMPING[0]))
        return redirected(problem, state)

    def restarted(self, problem: Problem, caution: float = 1.0) -> State:
        """The globals of this state for other pairs, with a multiple of its noise."""
        p = self.parameters
        return State.start(problem, self.R_imu_cam, p[OFFSET], p[READOUT], p[BIAS:BIAS + 3],
                           p[FOCAL], caution * float(np.median(self.noise)))

    def moved(self, step: Array, local: Array) -> State:
        """State after a step of the parameters (GLOBAL,) and of the pairs (P, LOCAL)."""
        parameters = self.parameters + step
        parameters[ROTATION:ROTATION + 3] = 0.0
        turn = Rotation.from_rotvec(step[ROTATION:ROTATION + 3]).as_matrix()
        first = _tangents(self.direction)
        # No further than a right angle or so: the step may be along what nothing tells.
        along = np.clip(local[:, :2], -1.0, 1.0)
        direction = self.direction + np.einsum('pk,pki->pi', along, first)
        direction /= np.linalg.norm(direction, axis=1, keepdims=True)
        return replace(self, parameters=parameters, R_imu_cam=turn @ self.R_imu_cam,
                       direction=direction, bend=self.bend + local[:, 2:5],
                       turn=self.turn + local[:, 5:])


def _tangents(directions: Array) -> Array:
    """As `coplanarity.tangents`, (P, 2, 3)."""
    smallest = np.argmin(np.abs(directions), axis=1)
    first = np.eye(3)[smallest]
    first = first - (first * directions).sum(axis=1, keepdims=True) * directions
    first /= np.linalg.norm(first, axis=1, keepdims=True)
    return np.stack([first, np.cross(directions, first)], axis=1)


@dataclass(frozen=True, slots=True, eq=False)
class Evaluation:
    """What a pass over all matches gives; see `accumulate`."""

    losses: Array
    residuals: Array
    score: Array
    reduced: Array
    back: Array

    @property
    def cost(self) -> float:
        """Sum over the pairs."""
        return float(self.losses.sum())


def redirected(problem: Problem, state: State) -> State:
    """State with each pair's direction the best of many that two of its matches fix."""
    path = _path(problem, state)
    direction = state.direction.copy()
    chosen = np.random.default_rng(0).integers(0, 2**30, (_HYPOTHESES, 2))
    find_directions(path.times, path.rates, path.rotations, problem.begin, problem.middle,
                    problem.times1, problem.times2, problem.covariates1, problem.covariates2,
                    problem.points1, problem.points2, problem.rows1, problem.rows2,
                    problem.by_pixel1, problem.by_pixel2, state.parameters, state.R_imu_cam,
                    state.noise, chosen, ROBUST, direction)
    moved = (np.abs((direction * state.direction).sum(axis=1)) < 0.999)[:, None]
    return replace(state, direction=direction, bend=np.where(moved, 0.0, state.bend),
                   turn=np.where(moved, 0.0, state.turn))


def evaluate(problem: Problem, state: State, derivatives: bool = True) -> Evaluation:
    """Residuals, and the normal equations, at `state`."""
    path = _path(problem, state)
    pairs = problem.pairs
    size = pairs if derivatives else 0
    out = Evaluation(np.empty(pairs), np.empty(len(problem.points1)), np.empty((size, GLOBAL)),
                     np.empty((size, GLOBAL, GLOBAL)), np.empty((size, LOCAL, GLOBAL + 1)))
    accumulate(path.times, path.rates, path.rotations, path.turned, problem.begin, problem.middle,
               problem.times1, problem.times2, problem.covariates1, problem.covariates2,
               problem.points1, problem.points2, problem.rows1, problem.rows2, problem.by_pixel1,
               problem.by_pixel2, state.parameters, state.R_imu_cam, state.noise,
               problem.bend_sigma, problem.turn_sigma, state.direction, state.bend, state.turn,
               state.damping, derivatives, ROBUST, out.losses, out.residuals, out.score,
               out.reduced, out.back)
    return out


def with_bends(problem: Problem, state: State) -> Problem:
    """Problem with priors of `bend` that fit how fast points pass by, seen with `state`."""
    path, parameters = _path(problem, state), state.parameters
    pair = np.repeat(np.arange(problem.pairs), np.diff(problem.begin))
    rays = []
    for times, points, rows in ((problem.times1, problem.points1, problem.rows1),
                                (problem.times2, problem.points2, problem.rows2)):
        at = times[pair] + parameters[OFFSET] + parameters[READOUT] * rows
        turns = path.at(at) @ state.R_imu_cam
        seen = np.column_stack([points / np.exp(parameters[FOCAL]), np.ones(len(points))])
        rays.append(np.einsum('nij,nj->ni', turns, seen / np.linalg.norm(seen, axis=1)[:, None]))
    angles = np.linalg.norm(np.cross(rays[0], rays[1]), axis=1)
    medians = np.array([np.median(angles[begin:end]) for begin, end in itertools.pairwise(
        problem.begin)])
    passing = np.maximum(medians / (problem.times2 - problem.times1), 1e-6)
    return replace(problem, bend_sigma=np.clip(_BEND / passing, *_BEND_RANGE))


def _path(problem: Problem, state: State) -> GyroPath:
    return GyroPath.integrated(problem.gyro_times, problem.gyro_rates,
                               state.parameters[BIAS:BIAS + 3])


@dataclass(frozen=True, slots=True, eq=False)
class Fit:
    """Where the fit ended.

    `covariance` (GLOBAL, GLOBAL): zero rows and columns where a parameter was held.
    `information` (GLOBAL, GLOBAL): the Hessian, before any prior.
    """

    state: State
    evaluation: Evaluation
    covariance: Array
    information: Array
    converged: bool


def fit(problem: Problem, state: State, free: NDArray[np.bool_], *, rounds: int = 40,
        bias_sigma: float = 0.03, tolerance: float = 0.1) -> Fit:
    """Minimise the cost over the `free` (GLOBAL,) parameters, and learn the noise on the way.

    Parameters
    ----------
    bias_sigma : float
        What a gyro's bias may be, 1 sigma [rad/s].
    tolerance : float
        Newton steps shorter than this [sigma of the parameters] end the fit.
    """
    prior = np.zeros(GLOBAL)
    prior[BIAS:BIAS + 3] = bias_sigma**-2
    evaluation = evaluate(problem, state)
    converged = False
    damping = 1e-3
    for _ in range(rounds):
        state, evaluation, damping, length = _step(
            problem, state, evaluation, free, prior, damping)
        if length > _NEAR:
            continue
        # Noise is learned near the optimum only: far from it, residuals are no noise.
        noise = learned(problem, state, evaluation)
        change = float(np.median(np.abs(np.log(noise / state.noise))))
        if length < tolerance and change < 0.03:
            converged = True
            break
        state = replace(state, noise=noise)
        if change > 0.1:
            # The cost is not convex in the directions: less noise tells more of them apart.
            state = _better_directions(problem, state)
        evaluation = evaluate(problem, state)
    state = replace(state, damping=np.zeros(problem.pairs))
    evaluation = evaluate(problem, state)
    return Fit(state, evaluation, _covariance(problem, state, evaluation, free, prior),
               evaluation.reduced.sum(axis=0), converged)


def _better_directions(problem: Problem, state: State) -> State:
    """Each pair with the better of its own direction and the one found anew."""
    kept, other = (_settled(problem, start) for start in (state, redirected(problem, state)))
    return _chosen(problem, other, kept)[0]


def _settled(problem: Problem, state: State) -> State:
    """State after two steps of the pairs' own unknowns."""
    for _ in range(2):
        back = evaluate(problem, state).back
        moved = state.moved(np.zeros(GLOBAL), -back[:, :, GLOBAL])
        state = _chosen(problem, moved, state)[0]
    return state


def _chosen(problem: Problem, moved: State, kept: State) -> tuple[State, float]:
    """State `moved`, but pairs that cost less with their own unknowns as in `kept` keep them."""
    stay = replace(moved, direction=kept.direction, bend=kept.bend, turn=kept.turn)
    losses = evaluate(problem, moved, derivatives=False).losses
    others = evaluate(problem, stay, derivatives=False).losses
    better = losses <= others
    pairs = better[:, None]
    state = replace(
        moved, direction=np.where(pairs, moved.direction, kept.direction),
        bend=np.where(pairs, moved.bend, kept.bend), turn=np.where(pairs, moved.turn, kept.turn),
        damping=np.clip(kept.damping * np.where(better, 0.2, 10.0), *_DAMPING))
    return state, float(np.minimum(losses, others).sum())


def _step(problem: Problem, state: State, evaluation: Evaluation, free: NDArray[np.bool_],
          prior: Array, damping: float) -> tuple[State, Evaluation, float, float]:
    """State after a step that lowers the cost, the damping, and Newton's step in sigma."""
    cost = evaluation.cost + _prior_cost(state, prior)
    H = (evaluation.reduced.sum(axis=0) + np.diag(prior))[np.ix_(free, free)]
    gradient = (evaluation.score.sum(axis=0) + prior * state.parameters)[free]
    newton = np.linalg.solve(H + 1e-9 * np.diag(np.diag(H)), gradient)
    length = float(np.sqrt(max(gradient @ newton, 0.0)))
    for _ in range(8):
        step = np.zeros(GLOBAL)
        step[free] = -np.linalg.solve(H + damping * np.diag(np.diag(H)), gradient)
        local = -evaluation.back[:, :, GLOBAL] - evaluation.back[:, :, :GLOBAL] @ step
        tried = state.moved(step, local)
        result = evaluate(problem, tried)
        if result.cost + _prior_cost(tried, prior) > cost:
            tried, tried_cost = _chosen(problem, tried, state)
            if tried_cost + _prior_cost(tried, prior) > cost:
                damping = max(10.0 * damping, 1e-3)
                continue
            result = evaluate(problem, tried)
        return tried, result, max(0.1 * damping, 1e-9), length
    return state, evaluation, damping, length


def _prior_cost(state: State, prior: Array) -> float:
    return 0.5 * float(prior @ state.parameters**2)


def learned(problem: Problem, state: State, evaluation: Evaluation) -> Array:
    """Noise (P,) of each pair that the residuals show [px]; a third of the last at least."""
    counts = np.diff(problem.begin)
    sizes = np.abs(evaluation.residuals)
    medians = np.array([np.median(sizes[begin:end]) for begin, end in itertools.pairwise(
        problem.begin)])
    # Two unknowns and a bit of each pair hide some of it.
    noise = 1.4826 * medians * np.sqrt(counts / np.maximum(counts - 3.0, 1.0))
    middle = max(float(np.median(noise)), _LEAST_NOISE)
    return np.maximum(np.clip(noise, _NOISE_RANGE[0] * middle, _NOISE_RANGE[1] * middle),
                      state.noise / 3.0)


def robust_weights(problem: Problem, state: State, evaluation: Evaluation) -> Array:
    """Weights (N,) of the matches, 1 where the residual is 0."""
    noise = np.repeat(state.noise, np.diff(problem.begin))
    return np.asarray((1.0 + (evaluation.residuals / (ROBUST * noise)) ** 2) ** -2)


def _covariance(problem: Problem, state: State, evaluation: Evaluation, free: NDArray[np.bool_],
                prior: Array) -> Array:
    weights = robust_weights(problem, state, evaluation)
    # Curvature of the loss against the weight that Gauss-Newton takes for it.
    bent = float((weights * (4.0 * np.sqrt(weights) - 3.0)).sum() / weights.sum())
    covariance = np.zeros((GLOBAL, GLOBAL))
    covariance[np.ix_(free, free)] = jackknife(
        evaluation.score[:, free], bent * evaluation.reduced[:, free][:, :, free],
        stretches(0.5 * (problem.times1 + problem.times2)), prior[free])
    return covariance
