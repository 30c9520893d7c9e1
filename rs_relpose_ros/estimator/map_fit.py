"""Joint maximum-a-posteriori fit of the uniform model: Sampson errors and IMU priors.

Minimises ``sum r_i^2 / s^2`` plus the terms of `priors` over the state of `state`, by
Levenberg-Marquardt with the exact Jacobian (the Sampson denominator included: treating it as
constant converges to another point).
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from rs_relpose_ros.compiled import kernel, linked_kernel
from rs_relpose_ros.estimator import sampson
from rs_relpose_ros.estimator.priors import add_priors, Priors, unknowns, with_log_scale
from rs_relpose_ros.estimator.state import moved, PARAMETERS, SCALE, TwoViewState
from rs_relpose_ros.geometry.vectors import copy_matrix, copy_vector
from rs_relpose_ros.solvers.linear_algebra import cholesky, newton_step

Array = NDArray[np.float64]

# Damping of the first step, as a share of the diagonal of the Hessian.
FIRST_DAMPING = 1e-4
# A fit ends where a step gains less than this share of a cost (chi-square) of one.
LEAST_GAIN = 1e-7


class FitMatches(NamedTuple):
    """The matches that a fit uses: `weights` (N,), 0 to 1, of the rows `observations` (N, 20).

    `sigma`: noise [px] of a match of weight 1.
    """

    observations: Array
    weights: Array
    sigma: float


class DataTerm(NamedTuple):
    """The matches' part of the objective about one state, in units of their noise.

    No prior is in it, so that fits with different priors share it.
    """

    hessian: Array
    gradient: Array
    cost: float


@kernel
def linearised(matches: FitMatches, state: TwoViewState) -> DataTerm:
    """Hessian (17, 17), half gradient (17,) and cost of the matches about `state`."""
    hessian, gradient, squares = sampson.normal_equations(
        matches.observations, matches.weights, state)
    weight = 1.0 / (matches.sigma * matches.sigma)
    for i in range(PARAMETERS):
        gradient[i] *= weight
        for j in range(PARAMETERS):
            hessian[i, j] *= weight
    return DataTerm(hessian, gradient, squares * weight)


@kernel
def normal_equations(data: DataTerm, state: TwoViewState,
                     priors: Priors) -> tuple[Array, Array, float]:
    """Hessian (n, n), half gradient (n,) and cost of the whole objective at `state`."""
    n = unknowns(priors)
    hessian, gradient = np.zeros((n, n)), np.zeros(n)
    copy_vector(data.gradient, gradient)
    copy_matrix(data.hessian, hessian)
    cost = data.cost + add_priors(state, priors, hessian, gradient)
    return hessian, gradient, cost


@linked_kernel
def fit(matches: FitMatches, start: TwoViewState, data: DataTerm, priors: Priors,
        iterations: int) -> tuple[TwoViewState, float, DataTerm, float, Array]:
    """Levenberg-Marquardt from `start` and the scale of `priors`.

    Parameters
    ----------
    data : DataTerm
        About `start`.

    Returns
    -------
    state : TwoViewState
    log_scale : float
        Of the velocities.
    data : DataTerm
        About that state.
    cost : float
        Of the whole objective.
    hessian : (n, n) ndarray
        Of the whole objective.
    """
    state, n = start, unknowns(priors)
    damping = FIRST_DAMPING
    hessian, gradient, cost = normal_equations(data, state, priors)
    damped = np.empty((n, n))
    factor = np.zeros((n, n))
    for _ in range(iterations):
        copy_matrix(hessian, damped)
        for i in range(n):
            damped[i, i] += damping * hessian[i, i] + 1e-12
        if not cholesky(damped, factor):
            damping = max(damping * 10.0, 1e-6)
            if damping > 1e8:
                break
            continue
        step = newton_step(factor, gradient)
        # What the step promises to gain (Newton's decrement): too little to look at it.
        gain = 0.0
        for i in range(n):
            gain -= gradient[i] * step[i]
        if gain < LEAST_GAIN * (1.0 + abs(cost)):
            break
        candidate, candidate_priors = moved(state, step), priors
        if n > SCALE:
            candidate_priors = with_log_scale(priors, priors.velocity.log_scale + step[SCALE])
        # Most steps are taken: their derivatives cost little more than the residuals alone.
        next_data = linearised(matches, candidate)
        next_hessian, next_gradient, next_cost = normal_equations(next_data, candidate,
                                                                  candidate_priors)
        if next_cost <= cost:
            state, data, priors = candidate, next_data, candidate_priors
            hessian, gradient, cost = next_hessian, next_gradient, next_cost
            damping = max(damping * 0.1, 1e-9)
        else:
            damping *= 10.0
            if not damping < 1e8:
                break
    return state, priors.velocity.log_scale, data, cost, hessian


@linked_kernel
def stepped(matches: FitMatches, start: TwoViewState, priors: Priors,
            steps: int) -> TwoViewState:
    """The state after some Gauss-Newton steps from `start`, better or not."""
    state = start
    factor = np.zeros((PARAMETERS, PARAMETERS))
    for _ in range(steps):
        hessian, gradient, _ = normal_equations(linearised(matches, state), state, priors)
        for i in range(PARAMETERS):
            hessian[i, i] += FIRST_DAMPING * hessian[i, i] + 1e-12
        if not cholesky(hessian, factor):
            break
        state = moved(state, newton_step(factor, gradient))
    return state
