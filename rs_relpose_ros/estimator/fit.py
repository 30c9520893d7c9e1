"""Joint maximum-a-posteriori fit of the uniform model: Sampson errors and IMU priors.

Minimises ``sum r_i^2 / s^2`` plus the terms of `priors` over a `TwoViewState`, by
Levenberg-Marquardt with the exact Jacobian (the Sampson denominator included: treating it as
constant converges to another point). Besides: the paper's alternating refinement, and the fit of a
rotation alone.
"""

import math
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from rs_relpose_ros.core.least_squares import damped_step
from rs_relpose_ros.core.losses import cauchy_weight
from rs_relpose_ros.estimator import priors, sampson
from rs_relpose_ros.estimator.priors import PARAMETERS, Priors, SCALE, TwoViewState
from rs_relpose_ros.geometry import Array, so3
from rs_relpose_ros.jit import kernel

# Damping of the first step, as a share of the diagonal of the Hessian.
FIRST_DAMPING = 1e-4
# A fit ends if a step gains less than this share of 1 + cost (chi-square).
LEAST_GAIN = 1e-7


class FitMatches(NamedTuple):
    """The matches of a fit."""

    observations: Array  # (N, 20)
    weights: Array  # (N,) 0 to 1
    sigma: float  # noise [px] of a match of weight 1


class DataTerm(NamedTuple):
    """The objective about one state without priors, so that fits with other priors share it."""

    hessian: Array
    gradient: Array
    cost: float


@kernel
def linearised(matches: FitMatches, state: TwoViewState) -> DataTerm:
    """Hessian (17, 17), half gradient (17,) and cost of the matches about `state`."""
    hessian, gradient, squares = sampson.normal_equations(
        matches.observations, matches.weights, state
    )
    weight = 1.0 / (matches.sigma * matches.sigma)
    return DataTerm(hessian * weight, gradient * weight, squares * weight)


@kernel
def with_priors(data: DataTerm, state: TwoViewState, prior: Priors) -> tuple[Array, Array, float]:
    """Hessian (n, n), half gradient (n,) and cost of the whole objective at `state`."""
    n = priors.unknowns(prior)
    hessian, gradient = np.zeros((n, n)), np.zeros(n)
    so3.copy_vector(data.gradient, gradient)
    so3.copy_matrix(data.hessian, hessian)
    cost = data.cost + priors.add_priors(state, prior, hessian, gradient)
    return hessian, gradient, cost


@kernel
def fit(
    matches: FitMatches, start: TwoViewState, data: DataTerm, prior: Priors, iterations: int
) -> tuple[TwoViewState, float, DataTerm, float, Array]:
    """Levenberg-Marquardt from `start`, about which `data` is, and the scale of `prior`.

    Returns the state, the logarithm of the velocities' scale, the data term about that state, and
    the cost and Hessian (n, n) of the whole objective.
    """
    state, n = start, priors.unknowns(prior)
    damping = FIRST_DAMPING
    hessian, gradient, cost = with_priors(data, state, prior)
    for _ in range(iterations):
        step, expected_gain = damped_step(hessian, gradient, damping)
        if expected_gain < 0.0:  # singular
            damping = max(damping * 10.0, 1e-6)
            continue
        if expected_gain < LEAST_GAIN * (1.0 + abs(cost)):
            break
        candidate, candidate_prior = priors.moved(state, step), prior
        if n > SCALE:
            velocity = prior.velocity
            candidate_prior = priors.at_scale(
                prior, velocity.log_scale + step[SCALE], velocity.centre, velocity.freedom
            )
        # Most steps are accepted: their derivatives cost little more than the residuals alone.
        next_data = linearised(matches, candidate)
        next_hessian, next_gradient, next_cost = with_priors(next_data, candidate, candidate_prior)
        if next_cost <= cost:
            state, data, prior = candidate, next_data, candidate_prior
            hessian, gradient, cost = next_hessian, next_gradient, next_cost
            damping = max(damping * 0.1, 1e-9)
        else:
            damping *= 10.0
            if not damping < 1e8:
                break
    return state, prior.velocity.log_scale, data, cost, hessian


@kernel
def gauss_newton(
    matches: FitMatches, start: TwoViewState, prior: Priors, steps: int
) -> TwoViewState:
    """The state after some Gauss-Newton steps from `start`, without a test of the cost."""
    state = start
    for _ in range(steps):
        hessian, gradient, _ = with_priors(linearised(matches, state), state, prior)
        step, expected_gain = damped_step(hessian, gradient, FIRST_DAMPING)
        if expected_gain < 0.0:  # singular
            break
        state = priors.moved(state, step)
    return state


# -- Refinement of the paper (its section 'Refinement'), as a selectable mode ---------------------
#
# Alternates between the rotation and ``(t, d_1, d_2)``: minimises the squared Sampson errors plus
# ``l_t (|t| - 1)^2 + l_d (|d_1|^2 + |d_2|^2)``. Errors do not depend on the common scale of
# ``(t, d_1, d_2)``: here ``|t| = 1``, the limit of a large l_t.

# l_d, with residuals in units of the pixel noise; the paper gives no value.
VELOCITY_WEIGHT = 1e-2
ALTERNATIONS = 10


@kernel
def refine_alternating(matches: FitMatches, start: TwoViewState, velocities: bool) -> TwoViewState:
    """Refine a state by alternation; gyro corrections, and d without `velocities`, are kept."""
    state, cost = start, math.inf
    for _ in range(ALTERNATIONS):
        previous = cost
        state, _ = _refine_part(matches, state, 0, priors.TANGENT)
        end = priors.DW1 if velocities else priors.D1
        state, cost = _refine_part(matches, state, priors.TANGENT, end)
        if previous - cost < 1e-6 * cost:
            break
    return state


@kernel
def _refine_part(
    matches: FitMatches, state: TwoViewState, first: int, end: int
) -> tuple[TwoViewState, float]:
    """Levenberg-Marquardt over the unknowns from `first` to before `end`; also the cost."""
    hessian, gradient = np.zeros((PARAMETERS, PARAMETERS)), np.zeros(PARAMETERS)
    step = np.zeros(PARAMETERS)
    candidate, cost, damping = state, math.inf, FIRST_DAMPING
    for _ in range(60):
        data = linearised(matches, candidate)
        d = np.concatenate((candidate.d1, candidate.d2))
        total = data.cost + VELOCITY_WEIGHT * (d * d).sum()
        damping *= 0.1 if total <= cost else 10.0
        if total <= cost:
            gain, state, cost = cost - total, candidate, total
            if gain <= 1e-8 * cost:
                break
            hessian, gradient = data.hessian, data.gradient
            gradient[priors.D1 : priors.DW1] += VELOCITY_WEIGHT * d
            for i in range(priors.D1, priors.DW1):
                hessian[i, i] += VELOCITY_WEIGHT
        part, expected_gain = damped_step(
            hessian[first:end, first:end].copy(), gradient[first:end], damping
        )
        if expected_gain < 0.0:  # singular
            break
        step[first:end] = part
        candidate = priors.moved(state, step)
    return state, cost


# -- Rotation alone: a robust fit with the gyro's prior -------------------------------------------

ROTATION_ITERATIONS = 12


@kernel
def transfer_errors(observations: Array, use: NDArray[np.bool_], R: Array, focal: float) -> Array:
    """``|f_1 - R f_2|`` [px] of the matches in `use`: their residual motion after a rotation."""
    out = np.empty(use.sum())
    count = 0
    for i in range(observations.shape[0]):
        if use[i]:
            total = 0.0
            for j in range(3):
                value = observations[i, j]
                for k in range(3):
                    value -= R[j, k] * observations[i, 9 + k]
                total += value * value
            out[count] = focal * math.sqrt(total)
            count += 1
    return out


@kernel
def fit_rotation(
    observations: Array,
    valid: NDArray[np.bool_],
    start: Array,
    prior: Priors,
    focal: float,
    sigma: float,
) -> tuple[Array, Array]:
    """Rotation (3, 3) and the information (3, 3) of its error in frame 1.

    Iteratively reweighted (Cauchy, scale 2 sigma); the prior on the rotation is the gyro's.
    """
    R = start.copy()
    information = np.zeros((3, 3))
    # Noise of two coordinates in each of two images.
    weight = focal * focal / (2.0 * sigma * sigma)
    scale2 = 4.0
    for _ in range(ROTATION_ITERATIONS):
        hessian = prior.rotation_information.copy()
        gradient = prior.rotation_information @ so3.log_so3(R @ prior.rotation.T)
        for i in range(observations.shape[0]):
            if not valid[i]:
                continue
            o = observations[i]
            h = so3.rotated(R, o[9:12])
            d = (o[0] - h[0], o[1] - h[1], o[2] - h[2])
            w = weight * cauchy_weight(weight * so3.dot(d, d) / scale2)
            # d(f_1 - h) = -theta x h: gradient -(h x (f_1 - h)), Hessian |h|^2 I - h h^T
            turn = so3.cross(h, d)
            for j in range(3):
                k, m = (j + 1) % 3, (j + 2) % 3
                gradient[j] -= w * turn[j]
                hessian[j, j] += w * (h[k] * h[k] + h[m] * h[m])
                for k in range(j):
                    hessian[k, j] -= w * h[k] * h[j]
                    hessian[j, k] = hessian[k, j]
        # The rotation about rays that all coincide is not observable: a floor above rounding.
        floor = 1e-9 * (1.0 + hessian[0, 0] + hessian[1, 1] + hessian[2, 2])
        for i in range(3):
            hessian[i, i] += floor
        information = hessian
        step, _ = damped_step(hessian, gradient, 0.0)  # zero if the matrix is singular
        R = so3.exp_so3(step) @ R
        if np.abs(step).max() < 1e-7:
            break
    return R, information
