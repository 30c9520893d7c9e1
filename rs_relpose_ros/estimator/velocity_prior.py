"""The joint fit with the velocity prior chosen by the data: evidence over a grid of sigmas.

How fast the camera moves is not known in advance. A wide prior lets the velocities soak up noise
where they are zero (the normal case: they are then not even observable), a narrow one biases the
pose where they are large. The Laplace evidence ``-cost/2 - logdet(H)/2 - 6 log s_d`` weighs them.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from rs_relpose_ros.compiled import kernel, linked_kernel
from rs_relpose_ros.estimator.information import inverse, log_determinant
from rs_relpose_ros.estimator.inliers import count_behind, Flags, Matches, within
from rs_relpose_ros.estimator.map_fit import DataTerm, fit, FitMatches, linearised
from rs_relpose_ros.estimator.priors import Priors, with_velocity_sigma
from rs_relpose_ros.estimator.sampson import residuals
from rs_relpose_ros.estimator.state import moved, PARAMETERS, step_between, TwoViewState
from rs_relpose_ros.estimator.uncertainty import as_much_wider, sandwich, score_covariance
from rs_relpose_ros.geometry.vectors import copy_matrix, copy_vector

Array = NDArray[np.float64]

# Units of |t| per second.
GRID = np.array([0.003, 0.03, 0.1, 0.3, 1.0, 3.0, 10.0])
# With a known interval the prior is about constant velocity; hand-held cameras and robots change
# their velocity by at least this share of it per second, however little one pair shows of that.
LEAST_VELOCITY_CHANGE = 0.3
# Exponent of the prior of the sigma, as its inverse: where the data cannot tell (sideways motion,
# cameras at rest), a wide prior would turn noise into velocity and degrees of translation.
SMALL_IS_LIKELIER = 0.5
ROUNDS = 3
ITERATIONS = 6
# On the inliers of the last round, from each prior's own optimum on nearly the same ones.
LAST_ITERATIONS = 2
# The inlier threshold reaches so many sigmas of the noise that is found, if it has to, but at most
# so many times as far as told.
REACH = 4.0
WIDEST = 2.0
# A prior whose evidence is below the best by more than this (logarithm) takes no part.
LEAST_EVIDENCE = 6.0


class Noise(NamedTuple):
    """What is told of the noise: `sigma` and inlier `threshold` [px] of a match."""

    sigma: float
    threshold: float


class Refined(NamedTuple):
    """A refined state, and what it rests on.

    `inliers` (N,): the matches that the last fits used. `velocity_sigma`: the prior sigma of the
    most evidence [baselines per second]. `sigma`: noise of a match that the fits used [px].
    `covariance` (17, 17): of the local parameters, within the fits and between them.
    """

    state: TwoViewState
    inliers: Flags
    velocity_sigma: float
    sigma: float
    covariance: Array


@kernel
def noise_sigma(observations_cost: float, count: int, told: float) -> float:
    """Noise of a match [px] from the residuals, with the told sigma as ten matches' worth."""
    told_weight = 10.0
    return math.sqrt((told_weight * told * told + observations_cost)
                     / (told_weight + max(count - 11, 0)))


@kernel
def fit_with_evidence(matches: Matches, start: TwoViewState, priors: Priors, noise: Noise,
                      grid: Array, gyro_error: Array) -> Refined:
    """Select inliers and fit repeatedly; average over the velocity priors at the end.

    `grid` (K,) holds the prior sigmas of the velocities; the state is the mean over them, weighted
    by their evidence. `gyro_error` (3, 3) is that of `score_covariance`.
    """
    size = grid.shape[0]
    state = start
    used = _selected(matches, state, noise.threshold, noise.sigma)
    # Optimum of each prior as a step from `start`, and its evidence in its last round.
    steps = np.zeros((size, PARAMETERS))
    lacking = np.zeros(size)
    evidences = np.full(size, -math.inf)
    # The prior that `start` comes from, or the one next to it.
    best = int(np.argmin(np.abs(np.log(grid * math.sqrt(priors.velocity_weight)))))
    for turn in range(ROUNDS):
        low, high = 0, size
        if turn > 0:   # the choice moves little once the inliers stand
            low, high = max(best - 1, 0), min(best + 2, size)
        # From the best prior down and from it up, each fit from its neighbour's optimum.
        data = linearised(used, state)
        upwards, upwards_data = state, data
        for turned in range(high - low):
            k = best - turned if turned <= best - low else low + turned
            if k == best + 1:
                state, data = upwards, upwards_data
            state, data, _, evidences[k] = _candidate(
                matches, used, state, data, priors, grid[k], noise.threshold, ITERATIONS)
            if k == best:
                upwards, upwards_data = state, data
            copy_vector(step_between(start, state), steps[k])
        best = low + int(np.argmax(evidences[low:high]))
        for k in range(low, high):
            lacking[k] = evidences[best] - evidences[k]
        state = moved(start, steps[best])
        chosen_from = used.use
        used = _selected(matches, state, _reach(noise.threshold, used.sigma), noise.sigma)
        if (used.use == chosen_from).all():
            break
    state, covariance, best = _average(matches, used, start, steps, lacking < LEAST_EVIDENCE,
                                       priors, grid, noise.threshold, gyro_error)
    return Refined(state, used.use, grid[best], used.sigma, covariance)


@kernel
def _reach(threshold: float, sigma: float) -> float:
    """Inlier threshold [px] for matches of a noise that turned out to be `sigma`."""
    return min(max(threshold, REACH * sigma), WIDEST * threshold)


@linked_kernel
def _selected(matches: Matches, state: TwoViewState, threshold: float,
              told_sigma: float) -> FitMatches:
    """Inliers of a state, with their noise."""
    r = residuals(matches.observations, state)
    inliers = within(r, matches, state, threshold)
    squares = 0.0
    for i in range(len(r)):
        if inliers[i]:
            squares += r[i] * r[i]
    return FitMatches(matches.observations, inliers,
                      noise_sigma(squares, inliers.sum(), told_sigma))


@linked_kernel
def _candidate(matches: Matches, used: FitMatches, start: TwoViewState, data: DataTerm,
               priors: Priors, velocity_sigma: float, threshold: float,
               iterations: int) -> tuple[TwoViewState, DataTerm, Array, float]:
    """Fit with one velocity prior: state, its data term and Hessian, and its log-evidence."""
    state, data, cost, hessian = fit(
        used, start, data, with_velocity_sigma(priors, velocity_sigma), iterations)
    # Velocities that carry the camera past its own baseline within a frame explain any residual,
    # with points behind the cameras: those count as outliers.
    cost += count_behind(matches, used.use, state) * (threshold / used.sigma) ** 2
    evidence = (-0.5 * cost - 0.5 * log_determinant(hessian)
                - (6.0 + SMALL_IS_LIKELIER) * math.log(velocity_sigma))
    return state, data, hessian, evidence


@linked_kernel
def _average(matches: Matches, used: FitMatches, start: TwoViewState, steps: Array, likely: Flags,
             priors: Priors, grid: Array, threshold: float,
             gyro_error: Array) -> tuple[TwoViewState, Array, int]:
    """Mean state, its covariance (17, 17), and the number of the prior of the most evidence.

    Where the data cannot tell which prior is right, one of them alone would be overconfident. The
    fits go on from `steps` (K, 17) from `start`, for the `likely` (K,) priors.
    """
    size = grid.shape[0]
    evidences = np.full(size, -math.inf)
    hessians = np.zeros((size, PARAMETERS, PARAMETERS))
    of_data = np.zeros((size, PARAMETERS, PARAMETERS))
    for k in range(size):
        if likely[k]:
            own = moved(start, steps[k])
            state, data, hessian, evidences[k] = _candidate(
                matches, used, own, linearised(used, own), priors, grid[k], threshold,
                LAST_ITERATIONS)
            copy_vector(step_between(start, state), steps[k])
            copy_matrix(hessian, hessians[k])
            copy_matrix(data.hessian, of_data[k])
    best = int(np.argmax(evidences))
    # Around the best one, where the local parameters of all of them are small.
    origin = moved(start, steps[best])
    scores = score_covariance(used, origin, of_data[best], hessians[best], priors, gyro_error)
    weights = np.exp(evidences - evidences[best])
    weights /= weights.sum()
    mean = np.zeros(PARAMETERS)
    away = np.zeros((size, PARAMETERS))
    for k in range(size):
        if likely[k]:
            copy_vector(step_between(origin, moved(start, steps[k])), away[k])
            mean += weights[k] * away[k]
    believed = np.zeros((PARAMETERS, PARAMETERS))
    spread = np.zeros((PARAMETERS, PARAMETERS))
    for k in range(size):
        if likely[k]:
            rest, fitted = away[k] - mean, inverse(hessians[k])
            for i in range(PARAMETERS):
                for j in range(PARAMETERS):
                    believed[i, j] += weights[k] * fitted[i, j]
                    spread[i, j] += weights[k] * rest[i] * rest[j]
    # The errors are those that the best one shows: another's misfit is no noise to it.
    fitted = inverse(hessians[best])
    shown = sandwich(hessians[best], of_data[best], fitted, scores)
    return moved(origin, mean), as_much_wider(believed, fitted, shown) + spread, best
