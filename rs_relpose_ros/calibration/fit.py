"""The robust fit: Levenberg-Marquardt over the calibration, everything of the pairs eliminated."""

from __future__ import annotations

import dataclasses
from dataclasses import dataclass, field, replace

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from rs_relpose_ros.calibration.gyro_path import GyroPath
from rs_relpose_ros.calibration.normal_equations import (
    accumulate,
    BIAS,
    FOCAL,
    GLOBAL,
    LOCAL,
    OFFSET,
    READOUT,
    ROTATION,
)

Array = NDArray[np.float64]

# Distance [sigma] at which the Geman-McClure loss levels off.
ROBUST = 2.5
# Frames over which errors of pairs are taken to be correlated.
LAGS = 20
# What the scatter may be learned to be; units as in `Scatter`.
DEPTH, VELOCITY, ACCELERATION, TURN = (1.5, 1.5), (0.02, 3.0), (3.0, 3.0), (2e-5, 1e-3)


@dataclass(frozen=True, slots=True, eq=False)
class Problem:
    """Data of a fit: what `accumulate` takes of the gyro's samples and of the pairs."""

    gyro_times: Array
    gyro_rates: Array
    begin: NDArray[np.int64]
    first: NDArray[np.int64]
    times1: Array
    times2: Array
    covariates1: Array
    covariates2: Array
    points1: Array
    points2: Array
    rows1: Array
    rows2: Array
    scales: Array

    @property
    def pairs(self) -> int:
        """Number of pairs."""
        return len(self.times1)


@dataclass(frozen=True, slots=True)
class Scatter:
    """1 sigma of what the fit does not solve for globally; learned from the data.

    `pixel`: a match [px]; `depth`: inverse depth of a point relative to its pair; `velocity`: of
    the camera [depths/s]; `acceleration` [depths/s^2]; `turn`: error of the gyro's rotation
    [rad/sqrt(s)].
    """

    pixel: float = 5.0
    depth: float = 1.5
    velocity: float = 0.5
    acceleration: float = 3.0
    turn: float = 1e-3

    def as_array(self) -> Array:
        """As `accumulate` takes it."""
        return np.array(dataclasses.astuple(self))


@dataclass(frozen=True, slots=True, eq=False)
class State:
    """A calibration: values of the parameters, and the rotation from camera to IMU.

    `parameters` (GLOBAL,): read-out, offset of the middle row, slope, three unused, bias, log of
    the focal length's factor.
    """

    parameters: Array
    R_imu_cam: Array
    local: Array
    rho: Array
    scatter: Scatter = field(default_factory=Scatter)

    @classmethod
    def start(cls, problem: Problem, R_imu_cam: Array, offset: float, readout: float = 0.0,
              bias: Array | None = None, log_focal: float = 0.0) -> State:
        """State in which all pairs stand still."""
        parameters = np.zeros(GLOBAL)
        parameters[READOUT], parameters[OFFSET], parameters[FOCAL] = readout, offset, log_focal
        if bias is not None:
            parameters[BIAS:BIAS + 3] = bias
        return cls(parameters, R_imu_cam, np.zeros((problem.pairs, LOCAL)),
                   np.ones(len(problem.points1)))

    def moved(self, step: Array, local: Array) -> State:
        """State after a step of the parameters (GLOBAL,), with other unknowns of the pairs."""
        parameters = self.parameters + step
        parameters[ROTATION:ROTATION + 3] = 0.0
        turn = Rotation.from_rotvec(step[ROTATION:ROTATION + 3]).as_matrix()
        return replace(self, parameters=parameters, R_imu_cam=turn @ self.R_imu_cam, local=local)


@dataclass(frozen=True, slots=True, eq=False)
class Evaluation:
    """What a pass over all matches gives; see `accumulate`."""

    losses: Array
    weights: Array
    across: Array
    sharpness: Array
    rho: Array
    score: Array
    reduced: Array
    back: Array
    spread: Array

    @property
    def cost(self) -> float:
        """Sum over the pairs."""
        return float(self.losses.sum())


def evaluate(problem: Problem, state: State, derivatives: bool = True) -> Evaluation:
    """Residuals at `state`; the inverse depths are improved on the way."""
    path = GyroPath.integrated(problem.gyro_times, problem.gyro_rates,
                               state.parameters[BIAS:BIAS + 3])
    pairs, matches = problem.pairs, len(problem.points1)
    size = pairs if derivatives else 0
    out = Evaluation(np.empty(pairs), np.empty(matches), np.empty(matches), np.empty(matches),
                     state.rho.copy(), np.empty((size, GLOBAL)), np.empty((size, GLOBAL, GLOBAL)),
                     np.empty((size, LOCAL, GLOBAL + 1)), np.empty((size, LOCAL)))
    accumulate(path.times, path.rates, path.rotations, path.turned, problem.begin, problem.times1,
               problem.times2, problem.covariates1, problem.covariates2, problem.points1,
               problem.points2, problem.rows1, problem.rows2, problem.scales, state.parameters,
               state.R_imu_cam, state.scatter.as_array(), state.local, out.rho, derivatives,
               ROBUST, out.losses, out.weights, out.across, out.sharpness, out.score, out.reduced,
               out.back, out.spread)
    return out


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


def fit(problem: Problem, state: State, free: NDArray[np.bool_], *, rounds: int = 25,
        bias_sigma: float = 0.1, tolerance: float = 0.1) -> Fit:
    """Minimise the cost over the `free` (GLOBAL,) parameters, and learn the scatter on the way.

    Parameters
    ----------
    bias_sigma : float
        What a gyro's bias may be, 1 sigma [rad/s].
    tolerance : float
        Steps shorter than this [sigma of the parameters] end the fit.
    """
    prior = np.zeros(GLOBAL)
    prior[BIAS:BIAS + 3] = bias_sigma**-2
    evaluation = evaluate(problem, state)
    converged = False
    damping = 1e-3
    near = False
    for _ in range(rounds):
        state, evaluation, damping, moved = _step(problem, state, evaluation, free, prior, damping)
        scatter = learned(problem, state, evaluation)
        if not near:
            # Far from the solution the pairs' own unknowns would take over what is wrong with it.
            scatter = replace(state.scatter, pixel=scatter.pixel)
        change = np.abs(np.log(scatter.as_array() / state.scatter.as_array()))
        settled = bool((change < 0.05).all())
        if moved < tolerance and settled and near:
            converged = True
            break
        near = near or (moved < 1.0 and settled)
        state = replace(state, scatter=scatter, rho=evaluation.rho)
        evaluation = evaluate(problem, state)
    state = replace(state, rho=evaluation.rho)
    return Fit(state, evaluation, _covariance(problem, evaluation, free, prior),
               evaluation.reduced.sum(axis=0), converged)


def _step(problem: Problem, state: State, evaluation: Evaluation, free: NDArray[np.bool_],
          prior: Array, damping: float) -> tuple[State, Evaluation, float, float]:
    """One accepted step, or none; last its length in sigma."""
    cost = _total(state, evaluation, prior)
    H = (evaluation.reduced.sum(axis=0) + np.diag(prior))[np.ix_(free, free)]
    gradient = (evaluation.score.sum(axis=0) + prior * state.parameters)[free]
    for _ in range(6):
        step = np.zeros(GLOBAL)
        step[free] = -np.linalg.solve(H + damping * np.diag(np.diag(H)) + 1e-12 * np.eye(len(H)),
                                      gradient)
        local = state.local - evaluation.back[:, :, GLOBAL] - evaluation.back[:, :, :GLOBAL] @ step
        tried = replace(state.moved(step, local), rho=evaluation.rho)
        result = evaluate(problem, tried)
        if _total(tried, result, prior) <= cost:
            moved = float(np.sqrt(step[free] @ H @ step[free]))
            return tried, result, max(0.2 * damping, 1e-9), moved
        damping = max(10.0 * damping, 1e-3)
    return state, evaluation, damping, 0.0


def _total(state: State, evaluation: Evaluation, prior: Array) -> float:
    return evaluation.cost + 0.5 * float(prior @ state.parameters**2)


def learned(problem: Problem, state: State, evaluation: Evaluation) -> Scatter:
    """Scatter that the residuals and the pairs' own unknowns show (empirical Bayes)."""
    old = state.scatter
    gaps = problem.times2 - problem.times1
    # Across the epipolar line: nine unknowns of the pair hide part of the noise.
    counts = np.diff(problem.begin)
    seen = np.sqrt(max(1.0 - LOCAL * len(counts) / counts.sum(), 0.3))
    pixel = 1.4826 * float(np.median(np.abs(evaluation.across))) * old.pixel / seen
    weights = evaluation.weights
    depth = np.sqrt(float(weights @ ((evaluation.rho - 1.0) ** 2 + evaluation.sharpness))
                    / max(float(weights.sum()), 1.0))

    def spread(part: slice, power: float) -> float:
        squares = (state.local[:, part] ** 2 + evaluation.spread[:, part]).mean(axis=1)
        return float(np.sqrt(np.mean(squares / gaps**power)))

    return Scatter(
        pixel=max(pixel, 0.02), depth=float(np.clip(depth, *DEPTH)),
        velocity=float(np.clip(spread(slice(0, 3), 2.0), *VELOCITY)),
        acceleration=float(np.clip(spread(slice(3, 6), 2.0), *ACCELERATION)),
        turn=float(np.clip(spread(slice(6, 9), 1.0), *TURN)))


def _covariance(problem: Problem, evaluation: Evaluation, free: NDArray[np.bool_],
                prior: Array) -> Array:
    """Sandwich estimate: pairs that share frames, or nearly, have common errors."""
    H = (evaluation.reduced.sum(axis=0) + np.diag(prior))[np.ix_(free, free)]
    frames = int(problem.first.max()) + 1
    scores = np.zeros((frames, int(free.sum())))
    np.add.at(scores, problem.first, evaluation.score[:, free])
    meat = scores.T @ scores
    for lag in range(1, min(LAGS, frames - 1) + 1):
        product = scores[lag:].T @ scores[:-lag]
        meat += (1.0 - lag / (LAGS + 1.0)) * (product + product.T)
    inverse = np.linalg.pinv(H, hermitian=True)
    covariance = np.zeros((GLOBAL, GLOBAL))
    covariance[np.ix_(free, free)] = inverse @ meat @ inverse
    return covariance
