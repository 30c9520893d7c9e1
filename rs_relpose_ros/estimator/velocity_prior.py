"""The joint fit with the velocity prior chosen by the data: evidence over a grid of sigmas.

How fast the camera moves is not known in advance. A wide prior lets the velocities soak up noise
where they are zero (the normal case: they are then not even observable), a narrow one biases the
pose where they are large. The Laplace evidence ``-cost/2 - logdet(H)/2 - 6 log s_d`` decides.
"""

from __future__ import annotations

import math

import numba
import numpy as np
from numpy.typing import NDArray

from rs_relpose_ros.estimator.local_optimisation import select_inliers
from rs_relpose_ros.estimator.map_fit import fit, log_determinant, Priors, State
from rs_relpose_ros.estimator.sampson import residuals

Array = NDArray[np.float64]

# Units of |t| per second.
GRID = np.array([0.003, 0.03, 0.1, 0.3, 1.0, 3.0, 10.0])
# With a known interval the prior is about constant velocity; hand-held cameras and robots change
# their velocity by at least this share of it per second, however little one pair shows of that.
LEAST_VELOCITY_CHANGE = 0.3
ROUNDS = 3
ITERATIONS = 6

_jit = numba.njit(cache=True, nogil=True, error_model='numpy')


@_jit
def with_velocity_sigma(priors: Priors, sigma: float) -> Priors:
    """The priors with another sigma of the linear velocities [baselines per second]."""
    return Priors(priors.gravity1, priors.gravity2, priors.gravity_weight, priors.rate_weight,
                  1.0 / (sigma * sigma), priors.velocity_rate, priors.rotation,
                  priors.rotation_information)


@_jit
def noise_sigma(observations_cost: float, count: int, told: float) -> float:
    """Noise of a match [px] from the residuals, with the told sigma as ten matches' worth."""
    told_weight = 10.0
    return math.sqrt((told_weight * told * told + observations_cost)
                     / (told_weight + max(count - 11, 0)))


@_jit
def fit_with_evidence(observations: Array, valid: NDArray[np.bool_], start: State, priors: Priors,
                      told_sigma: float, threshold: float, angle_sigma: float, grid: Array,
                      ) -> tuple[State, NDArray[np.bool_], float, float]:
    """Select inliers, choose the velocity prior and fit, repeatedly.

    Returns
    -------
    state : State
    inliers : (N,) ndarray of bool
        The matches that the last fit used.
    velocity_sigma : float
        The prior sigma that was chosen [baselines per second].
    sigma : float
        Noise of a match that the fit used [px].
    """
    state = start
    best = 0
    inliers = select_inliers(observations, valid, state, threshold, angle_sigma)
    sigma = _noise(observations, inliers, state, told_sigma)
    for turn in range(ROUNDS):
        low, high = 0, grid.shape[0]
        if turn > 0:   # the choice moves little once the inliers stand
            low, high = max(best - 1, 0), min(best + 2, grid.shape[0])
        best_evidence = -math.inf
        best_state = state
        for k in range(low, high):
            chosen = with_velocity_sigma(priors, grid[k])
            candidate, cost, hessian = fit(
                observations, inliers, state, chosen, sigma, ITERATIONS)
            evidence = (-0.5 * cost - 0.5 * log_determinant(hessian) - 6.0 * math.log(grid[k]))
            if evidence > best_evidence:
                best_evidence, best_state, best = evidence, candidate, k
        state = best_state
        chosen_from = inliers
        inliers = select_inliers(observations, valid, state, threshold, angle_sigma)
        sigma = _noise(observations, inliers, state, told_sigma)
        if (inliers == chosen_from).all():
            break
    chosen = with_velocity_sigma(priors, grid[best])
    state, _, _ = fit(observations, inliers, state, chosen, sigma, ITERATIONS)
    return state, inliers, grid[best], sigma


@_jit
def _noise(observations: Array, inliers: NDArray[np.bool_], state: State,
           told_sigma: float) -> float:
    """Noise of a match [px] from the residuals of a state."""
    r = residuals(observations, state.R, state.t, state.d1, state.d2, state.dw1, state.dw2)
    squares = 0.0
    for i in range(len(r)):
        if inliers[i]:
            squares += r[i] * r[i]
    return noise_sigma(squares, inliers.sum(), told_sigma)
