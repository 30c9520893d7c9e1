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
from rs_relpose_ros.estimator.priors import (
    add_priors,
    add_velocities,
    Priors,
    unknowns,
    VelocityPrior,
    with_velocity,
)
from rs_relpose_ros.estimator.sampson import residuals
from rs_relpose_ros.estimator.state import moved, PARAMETERS, SCALE, step_between, TwoViewState
from rs_relpose_ros.estimator.uncertainty import as_much_wider, sandwich, score_covariance
from rs_relpose_ros.geometry.vectors import copy_matrix, copy_vector

Array = NDArray[np.float64]

# Prior sigmas where nothing is known of the time between the frames [baselines per second].
GRID = np.array([0.003, 0.03, 0.1, 0.3, 1.0, 3.0, 10.0])
# Exponent of the prior of the sigma, as its inverse: where the data cannot tell (sideways motion,
# cameras at rest), a wide prior would turn noise into velocity and degrees of translation.
SMALL_IS_LIKELIER = 0.5
# Matches of more noise than the rest: how many times as much, and their share to begin with.
WORSE = 3.0
FIRST_SHARE = 0.1
# What is told of the noise counts as so many matches; that all are good, as so many.
TOLD_MATCHES = 10.0
LIKELY_GOOD = 20.0
MIXTURE_ROUNDS = 6
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


class Scales(NamedTuple):
    """Grid of scales of the velocities (`priors`): ``log b`` of each, or the mean of its prior.

    `log_weights`: logarithms of their prior probabilities, up to a constant.
    """

    centres: Array
    log_weights: Array


class Noise(NamedTuple):
    """What is told of the noise: `sigma` and inlier `threshold` [px] of a match."""

    sigma: float
    threshold: float


class Refined(NamedTuple):
    """A refined state, and what it rests on.

    `inliers` (N,): the matches that the last fits used. `log_scale`: log b of the velocities, of
    the most evidence, or the mean where it is unknown. `sigma`: noise of a match that the fits
    used [px]. `covariance` (n, n): of the local parameters, within the fits and between them.
    """

    state: TwoViewState
    inliers: Flags
    log_scale: float
    sigma: float
    covariance: Array


@kernel
def noise_mixture(r: Array, use: Flags, told: float) -> tuple[Array, float]:
    """Weights (N,) of the matches in `use` and the noise [px] of good ones, by their residuals.

    Some tracks are worse than others: a share h has `WORSE` times the noise of the rest. Both are
    found by expectation maximisation; a match weighs as much as the mean of its inverse variance.
    The told sigma counts as ten matches.
    """
    weights = np.zeros(len(r))
    count, squares = 0, 0.0
    for i in range(len(r)):
        if use[i]:
            count += 1
            squares += r[i] * r[i]
            weights[i] = 1.0
    freedom = TOLD_MATCHES + max(count - 11, 0)
    variance = (TOLD_MATCHES * told * told + squares) / freedom
    share = FIRST_SHARE
    for _ in range(MIXTURE_ROUNDS):
        squares, worse = 0.0, 0.0
        for i in range(len(r)):
            if use[i]:
                r2 = r[i] * r[i] / variance
                if not r2 < 700.0:
                    r2 = 700.0
                ratio = (share / (1.0 - share) / WORSE
                         * math.exp(0.5 * r2 * (1.0 - 1.0 / (WORSE * WORSE))))
                p = ratio / (1.0 + ratio)
                worse += p
                weights[i] = 1.0 - p * (1.0 - 1.0 / (WORSE * WORSE))
                squares += weights[i] * r[i] * r[i]
        variance = (TOLD_MATCHES * told * told + squares) / freedom
        share = (worse + 1.0) / (count + LIKELY_GOOD)
    return weights, math.sqrt(variance)


@kernel
def fit_with_evidence(matches: Matches, start: TwoViewState, priors: Priors, noise: Noise,
                      scales: Scales, gyro_error: Array) -> Refined:
    """Select inliers and fit repeatedly; average over the scales of the velocities at the end.

    The state is the mean over the scales, weighted by their evidence. `gyro_error` (3, 3) is that
    of `score_covariance`.
    """
    size, n = len(scales.centres), unknowns(priors)
    state = start
    used = _selected(matches, state, noise.threshold, noise.sigma)
    # Optimum of each scale as a step from `start` and a log b, and its evidence in its last round.
    steps = np.zeros((size, n))
    lacking = np.zeros(size)
    evidences = np.full(size, -math.inf)
    # The scale that `start` comes from, or the one next to it.
    best = int(np.argmin(np.abs(scales.centres - priors.velocity.log_scale)))
    for turn in range(ROUNDS):
        low, high = 0, size
        if turn > 0:   # the choice moves little once the inliers stand
            low, high = max(best - 1, 0), min(best + 2, size)
        # From the best scale down and from it up, each fit from its neighbour's optimum.
        data = linearised(used, state)
        upwards, upwards_data = state, data
        for turned in range(high - low):
            k = best - turned if turned <= best - low else low + turned
            if k == best + 1:
                state, data = upwards, upwards_data
            state, log_scale, data, _, evidences[k] = _candidate(
                matches, used, state, data, priors, scales, k, scales.centres[k],
                noise.threshold, ITERATIONS)
            if k == best:
                upwards, upwards_data = state, data
            copy_vector(step_between(start, state), steps[k])
            if n > SCALE:
                steps[k, SCALE] = log_scale
        best = low + int(np.argmax(evidences[low:high]))
        for k in range(low, high):
            lacking[k] = evidences[best] - evidences[k]
        state = moved(start, steps[best])
        chosen_from = used.weights > 0.0
        used = _selected(matches, state, _reach(noise.threshold, used.sigma), noise.sigma)
        if ((used.weights > 0.0) == chosen_from).all():
            break
    return _average(matches, used, start, steps, lacking < LEAST_EVIDENCE, priors, scales,
                    noise.threshold, gyro_error)


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
    weights, sigma = noise_mixture(r, inliers, told_sigma)
    return FitMatches(matches.observations, weights, sigma)


@kernel
def _known_velocities(data: DataTerm, state: TwoViewState, priors: Priors) -> float:
    """How many of the six velocities the matches know, of those that their prior knows, too.

    ``g = 6 - tr(C V)``, V being the prior's part of the Hessian whose inverse is C (MacKay,
    Neural Computation 4, 1992): ``log b`` gains ``6 - tr(C V)`` in the logarithm of the evidence.
    """
    hessian, gradient = np.zeros((PARAMETERS, PARAMETERS)), np.zeros(PARAMETERS)
    of_prior, ignored = np.zeros((PARAMETERS, PARAMETERS)), np.zeros(PARAMETERS)
    add_priors(state, priors, hessian, gradient)
    add_velocities(state, priors.velocity, of_prior, ignored)
    for i in range(PARAMETERS):
        for j in range(PARAMETERS):
            hessian[i, j] += data.hessian[i, j]
    return min(max(6.0 - (inverse(hessian) * of_prior).sum(), 0.0), 6.0)


@linked_kernel
def _candidate(matches: Matches, used: FitMatches, start: TwoViewState, data: DataTerm,
               priors: Priors, scales: Scales, k: int, log_scale: float, threshold: float,
               iterations: int) -> tuple[TwoViewState, float, DataTerm, Array, float]:
    """Fit about scale k, from `log_scale`: state, log b, data term, Hessian and log-evidence."""
    told = priors.velocity
    velocity = VelocityPrior(told.rate, told.offset, told.information, log_scale,
                             scales.centres[k], told.weight, 0.0)
    priors = with_velocity(priors, velocity)
    if told.weight > 0.0:
        priors = with_velocity(priors, VelocityPrior(
            told.rate, told.offset, told.information, log_scale, scales.centres[k], told.weight,
            _known_velocities(data, start, priors)))
    state, log_scale, data, cost, hessian = fit(used, start, data, priors, iterations)
    cost += 2.0 * priors.velocity.freedom * log_scale
    # Velocities that carry the camera past its own baseline within a frame explain any residual,
    # with points behind the cameras: those count as outliers.
    cost += count_behind(matches, used.weights > 0.0, state) * (threshold / used.sigma) ** 2
    evidence = (-0.5 * cost - 0.5 * log_determinant(hessian) + 6.0 * log_scale
                + scales.log_weights[k])
    return state, log_scale, data, hessian, evidence


@linked_kernel
def _average(matches: Matches, used: FitMatches, start: TwoViewState, steps: Array, likely: Flags,
             priors: Priors, scales: Scales, threshold: float, gyro_error: Array) -> Refined:
    """Mean state over the scales, its covariance, and the scale of the most evidence.

    Where the data cannot tell which scale is right, one of them alone would be overconfident. The
    fits go on from `steps` (K, n) from `start`, for the `likely` (K,) scales.
    """
    size, n = steps.shape
    evidences = np.full(size, -math.inf)
    hessians = np.zeros((size, n, n))
    of_data = np.zeros((size, n, n))
    for k in range(size):
        if likely[k]:
            own = moved(start, steps[k])
            log_scale = steps[k, SCALE] if n > SCALE else scales.centres[k]
            state, log_scale, data, hessian, evidences[k] = _candidate(
                matches, used, own, linearised(used, own), priors, scales, k, log_scale,
                threshold, LAST_ITERATIONS)
            copy_vector(step_between(start, state), steps[k])
            if n > SCALE:
                steps[k, SCALE] = log_scale
            copy_matrix(hessian, hessians[k])
            copy_matrix(data.hessian, of_data[k])
    best = int(np.argmax(evidences))
    # Around the best one, where the local parameters of all of them are small.
    origin = moved(start, steps[best])
    scores = score_covariance(used, origin, of_data[best], hessians[best], priors, gyro_error)
    weights = np.exp(evidences - evidences[best])
    weights /= weights.sum()
    mean = np.zeros(n)
    away = np.zeros((size, n))
    for k in range(size):
        if likely[k]:
            copy_vector(step_between(origin, moved(start, steps[k])), away[k])
            if n > SCALE:
                away[k, SCALE] = steps[k, SCALE] - steps[best, SCALE]
            mean += weights[k] * away[k]
    believed = np.zeros((n, n))
    spread = np.zeros((n, n))
    for k in range(size):
        if likely[k]:
            rest, fitted = away[k] - mean, inverse(hessians[k])
            for i in range(n):
                for j in range(n):
                    believed[i, j] += weights[k] * fitted[i, j]
                    spread[i, j] += weights[k] * rest[i] * rest[j]
    # The errors are those that the best one shows: another's misfit is no noise to it.
    fitted = inverse(hessians[best])
    shown = sandwich(hessians[best], of_data[best], fitted, scores)
    log_scale = scales.centres[best]
    if n > SCALE:
        log_scale = steps[best, SCALE] + mean[SCALE]
    return Refined(moved(origin, mean), used.weights > 0.0, log_scale, used.sigma,
                   as_much_wider(believed, fitted, shown) + spread)
