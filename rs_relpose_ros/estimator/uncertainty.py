"""Covariance of a state: from the errors that a fit shows to the quantities of a pose.

A Hessian H believes that residuals are independent, and priors as good as told. The sandwich
``H^-1 S H^-1`` does not: S is the covariance of the gradient at the optimum (docs/estimator.md,
"Covariance"), its matches' part taken from the gradients of image regions, its gyro part from how
well gyro and images agree.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from rs_relpose_ros.compiled import kernel, linked_kernel
from rs_relpose_ros.estimator import sampson
from rs_relpose_ros.estimator.information import inverse
from rs_relpose_ros.estimator.map_fit import FitMatches, linearised, normal_equations
from rs_relpose_ros.estimator.noise import FITTED
from rs_relpose_ros.estimator.priors import Priors
from rs_relpose_ros.estimator.problem import PairState, TwoViewProblem
from rs_relpose_ros.estimator.state import DW1, PARAMETERS, SCALE, THETA, TwoViewState
from rs_relpose_ros.geometry.so3 import log_so3, skew
from rs_relpose_ros.geometry.vectors import copy_matrix, tangent_basis
from rs_relpose_ros.solvers.linear_algebra import cholesky, newton_step

Array = NDArray[np.float64]

# Regions of the field that the matches cover: columns and rows.
REGIONS = (4, 3)
# The Hessian's covariance of the gradient counts as so many regions beside those of the image: few
# regions alone would make a noisy one.
HESSIAN_REGIONS = 8
# The told sigmas of the gyro count as one degree of freedom beside those of its disagreement.
TOLD_FREEDOM = 1.0
# Where the gyro alone decides, it cannot disagree: this share of its variance keeps 0 / 0 defined.
LEAST_DISAGREEMENT = 1e-3


class ScoreCovariance(NamedTuple):
    """Covariance of the gradient of a fit at its optimum, in parts.

    `matches` (17, 17): of the matches. `excess` (17, 17): of the gyro's priors beyond their
    Hessian, which is what a fit believes of them.
    """

    matches: Array
    excess: Array


@linked_kernel
def score_covariance(matches: FitMatches, state: TwoViewState, data_hessian: Array,
                     hessian: Array, priors: Priors, gyro_error: Array) -> ScoreCovariance:
    """Covariance of the gradient about an optimum `state` with `hessian` (17, 17).

    `data_hessian` (17, 17): the matches' part of it.
    `gyro_error` (3, 3): covariance of errors of the gyro's rotation that its prior does not know.
    """
    surprise = gyro_surprise(state, priors, inverse(hessian))
    excess = np.zeros(hessian.shape)
    information = priors.rotation_information
    rotation = (surprise - 1.0) * information + information @ gyro_error @ information
    for i in range(3):
        for j in range(3):
            excess[THETA + i, THETA + j] = rotation[i, j]
    for i in range(DW1, PARAMETERS):
        excess[i, i] = (surprise - 1.0) * priors.rate_weight
    # Where gyro and images disagree, either may be wrong.
    of_matches = score_of_matches(matches, state, data_hessian, hessian)
    return ScoreCovariance(max(surprise, 1.0) * of_matches, excess)


@kernel
def sandwich(hessian: Array, data_hessian: Array, covariance: Array,
             scores: ScoreCovariance) -> Array:
    """``H^-1 S H^-1`` (17, 17), `covariance` being ``H^-1``; priors stay as in their Hessian."""
    priors = hessian - data_hessian
    return covariance @ (scores.matches + priors + scores.excess) @ covariance


@kernel
def as_much_wider(covariance: Array, believed: Array, shown: Array) -> Array:
    """``T C T^T`` with ``T believed T^T = shown``: C as much wider as `shown` is than `believed`.

    T is lower triangular. C is returned as it is where one of the two others is singular.
    """
    n = len(covariance)
    of_believed, of_shown, T = np.zeros((n, n)), np.zeros((n, n)), np.zeros((n, n))
    if not (cholesky(believed, of_believed) and cholesky(shown, of_shown)):
        return covariance
    for i in range(n):
        for j in range(i, -1, -1):   # T L_believed = L_shown
            value = of_shown[i, j]
            for k in range(j + 1, i + 1):
                value -= T[i, k] * of_believed[k, j]
            T[i, j] = value / of_believed[j, j]
    return T @ covariance @ T.T


@kernel
def score_of_matches(matches: FitMatches, state: TwoViewState, data_hessian: Array,
                hessian: Array) -> Array:
    """Covariance of the matches' gradient, by image regions g and by the Hessian.

    By regions, from their gradients s_g and Hessians H_g::

        sum_g u_g u_g^T,   u_g = (s_g + (I - H_g H^-1)^-1 s_g) / 2

    The fit has adapted to each region: a fit without it would leave ``(I - H_g H^-1)^-1 s_g``
    there, which is too much, as s_g is too little. For independent residuals the mean of the two
    is right to first order in H_g (as CR2: Bell and McCaffrey, Survey Methodology 28, 2002).
    """
    regions = _regions(matches)
    weight = 1.0 / (matches.sigma * matches.sigma)
    n = len(hessian)
    total, rest, factor = np.zeros((n, n)), np.empty((n, n)), np.zeros((n, n))
    score = np.zeros(n)
    filled, cost = 0, 0.0
    for g in range(REGIONS[0] * REGIONS[1]):
        use = regions == g
        if not use.any():
            continue
        filled += 1
        own, gradient, squares = sampson.normal_equations(
            matches.observations, use * matches.weights, state)
        cost += weight * squares
        copy_matrix(hessian, rest)
        for i in range(PARAMETERS):
            score[i] = weight * gradient[i]
            for j in range(PARAMETERS):
                rest[i, j] -= weight * own[i, j]
        adjusted = score
        if cholesky(rest, factor):
            # (I - H_g H^-1)^-1 s = H (H - H_g)^-1 s
            adjusted = 0.5 * (score - hessian @ newton_step(factor, score))
        for i in range(n):
            for j in range(n):
                total[i, j] += adjusted[i] * adjusted[j]
    # Noise as the residuals have it, without what was told: (units of sigma)^2.
    variance = (1.0 + cost) / (1.0 + max(matches.weights.sum() - FITTED, 0.0))
    share = filled / (filled + HESSIAN_REGIONS)
    return share * total + (1.0 - share) * variance * data_hessian


@kernel
def _regions(matches: FitMatches) -> NDArray[np.int64]:
    """Number of each match's region (N,), by its first ray; -1 for those that are not used."""
    n = len(matches.weights)
    low, high = np.full(2, np.inf), np.full(2, -np.inf)
    for i in range(n):
        if matches.weights[i] > 0.0:
            for k in range(2):
                low[k] = min(low[k], matches.observations[i, k])
                high[k] = max(high[k], matches.observations[i, k])
    regions = np.full(n, -1)
    for i in range(n):
        if matches.weights[i] > 0.0:
            number = 0
            for k in range(2):
                share = (matches.observations[i, k] - low[k]) / max(high[k] - low[k], 1e-12)
                number = REGIONS[k] * number + min(int(REGIONS[k] * share), REGIONS[k] - 1)
            regions[i] = number
    return regions


@kernel
def gyro_surprise(state: TwoViewState, priors: Priors, covariance: Array) -> float:
    """How many times the variance of the gyro seems to be the told one, from one pair.

    ``(1 + chi2) / (1 + freedom)`` at an optimum of covariance C (17, 17), with::

        chi2 = theta^T (Lambda^-1 - C_theta)^-1 theta + (|dw_1|^2 + |dw_2|^2) / s_w^2

    theta is the turn from the gyro's rotation; ``Lambda^-1 - C_theta`` is its covariance, and the
    rates have ``6 - tr(C_w) / s_w^2`` degrees of freedom, where gyro and images are both right.
    """
    chi2, freedom = 0.0, 0.0
    if priors.rotation_information[0, 0] > 0.0:
        theta = log_so3(state.R @ priors.rotation.T)
        away = inverse(priors.rotation_information)
        for i in range(3):
            for j in range(3):
                away[i, j] *= 1.0 + LEAST_DISAGREEMENT
                away[i, j] -= covariance[THETA + i, THETA + j]
        chi2 += (theta * (inverse(away) @ theta)).sum()
        freedom += 3.0
    chi2 += priors.rate_weight * ((state.dw1**2).sum() + (state.dw2**2).sum())
    freedom += 6.0
    for i in range(DW1, PARAMETERS):
        freedom -= priors.rate_weight * covariance[i, i]
    return (TOLD_FREEDOM + chi2) / (TOLD_FREEDOM + max(freedom, 0.0))



def local_covariance(matches: FitMatches, state: TwoViewState, priors: Priors) -> Array:
    """Covariance (17, 17) of the local parameters from the regularised Hessian."""
    hessian, gradient, _ = normal_equations(linearised(matches, state), state, priors)
    local = inverse(hessian)
    # A state that is not the optimum is off by about this step.
    step = local @ gradient
    return np.asarray(local + np.outer(step, step))


def pair_state(problem: TwoViewProblem, state: TwoViewState, log_scale: float,
               local: Array) -> PairState:
    """The state in each camera's own frame, with its covariance.

    Parameters
    ----------
    log_scale : float
        Of the velocities: the logarithm of the baseline where that is a figure in metres.
    local : (n, n) ndarray
        Covariance of the state's local parameters ``(theta, tangent, d_1, d_2, dw_1, dw_2)``,
        which are in frame 1, and of `log_scale` where it is unknown.
    """
    jacobian = np.zeros((19, len(local)))
    jacobian[0:3, 3:5] = tangent_basis(state.t)
    jacobian[3:6, 0:3] = np.eye(3)
    jacobian[6:9, 5:8] = np.eye(3)
    # v_2 = R^T d_2, w_2 = w + R^T dw_2: the error of R turns them with it.
    jacobian[9:12, 8:11] = state.R.T
    jacobian[9:12, 0:3] = state.R.T @ skew(state.d2)
    jacobian[12:15, 11:14] = np.eye(3)
    jacobian[15:18, 14:17] = state.R.T
    if len(local) > SCALE:
        jacobian[18, SCALE] = 1.0
    w1 = problem.motion1.angular_velocity + state.dw1
    w2 = problem.motion2.angular_velocity + state.R.T @ state.dw2
    return PairState(state.R, state.t, state.d1, state.R.T @ state.d2, w1, w2, log_scale,
                     jacobian @ local @ jacobian.T)
