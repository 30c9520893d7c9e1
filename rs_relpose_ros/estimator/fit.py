"""Joint maximum-a-posteriori fit of the uniform model: Sampson errors and IMU priors.

Minimises ``sum r_i^2 / s^2`` plus the terms of `priors` over a `TwoViewState`, by
Levenberg-Marquardt with the exact Jacobian (the Sampson denominator included: treating it as
constant converges to another point). Besides: the paper's alternating refinement, and the fit of a
rotation alone.
"""

import math
from typing import NamedTuple

import numpy as np

from rs_relpose_ros.core.least_squares import damped_step
from rs_relpose_ros.core.losses import cauchy_weight
from rs_relpose_ros.estimator import priors, sampson
from rs_relpose_ros.estimator.priors import PARAMETERS, Priors, SCALE, TwoViewState
from rs_relpose_ros.estimator.sampson import FitMatches, VIEW_2
from rs_relpose_ros.geometry import Array, Flags, so3
from rs_relpose_ros.jit import kernel, small_kernel

# Damping of the first step, as a share of the diagonal of the Hessian. Less lets a first step from
# a bad start go too far, more costs steps. [chosen: any value in 1e-5..1e-2 would do, because the
# damping adapts itself]
FIRST_DAMPING = 1e-4
# A fit ends if a step gains less than this share of 1 + cost (chi-square). A larger share stops
# before the optimum, a smaller one takes steps of rounding. [chosen: far below the change of 1
# that a sigma makes; any value in 1e-9..1e-5 would do]
LEAST_GAIN = 1e-7


class NormalEquations(NamedTuple):
    """An objective about one state: of the matches alone, or with priors."""

    hessian: Array  # (n, n)
    gradient: Array  # (n,) half of it
    cost: float


@kernel
def linearised(matches: FitMatches, state: TwoViewState) -> NormalEquations:
    """The objective of the matches alone about `state`, without any prior; n is 17."""
    hessian, gradient, squares = sampson.normal_equations(
        matches.observations, matches.weights, state
    )
    weight = 1.0 / (matches.sigma * matches.sigma)
    return NormalEquations(hessian * weight, gradient * weight, squares * weight)


@kernel
def with_priors(data: NormalEquations, state: TwoViewState, prior: Priors) -> NormalEquations:
    """The whole objective at `state`, from the objective of the matches."""
    n = priors.unknowns(prior)
    hessian = np.zeros((n, n))
    gradient = np.zeros(n)
    so3.copy_vector(data.gradient, gradient)
    so3.copy_matrix(data.hessian, hessian)
    of_priors = priors.add_priors(state, prior, hessian, gradient)
    return NormalEquations(hessian, gradient, data.cost + of_priors)


@small_kernel
def fit(
    matches: FitMatches,
    start: TwoViewState,
    data: NormalEquations,
    prior: Priors,
    iterations: int,
) -> tuple[TwoViewState, float, NormalEquations, NormalEquations]:
    """Minimise by Levenberg-Marquardt from `start`, about which `data` is.

    The scale of the velocities starts at the scale of `prior`. Returns the state, the logarithm of
    the scale, and the objectives of the matches and of everything about that state.
    """
    state = start
    n = priors.unknowns(prior)
    damping = FIRST_DAMPING
    whole = with_priors(data, state, prior)
    for _ in range(iterations):
        step, expected_gain = damped_step(whole.hessian, whole.gradient, damping)
        if expected_gain < 0.0:  # singular
            damping = max(damping * 10.0, 1e-6)
            continue
        if expected_gain < LEAST_GAIN * (1.0 + abs(whole.cost)):
            break
        candidate = priors.moved(state, step)
        candidate_prior = prior
        if n > SCALE:
            velocity = prior.velocity
            log_scale = velocity.log_scale + step[SCALE]
            candidate_prior = priors.at_scale(prior, log_scale, velocity.centre, velocity.freedom)
        # Most steps are accepted, and derivatives cost little more than the residuals alone.
        candidate_data = linearised(matches, candidate)
        candidate_whole = with_priors(candidate_data, candidate, candidate_prior)
        if candidate_whole.cost <= whole.cost:
            state = candidate
            data = candidate_data
            prior = candidate_prior
            whole = candidate_whole
            damping = max(damping * 0.1, 1e-9)
        else:
            damping *= 10.0
            if not damping < 1e8:
                break
    return state, prior.velocity.log_scale, data, whole


@kernel
def gauss_newton(
    matches: FitMatches, start: TwoViewState, prior: Priors, steps: int
) -> TwoViewState:
    """The state after some Gauss-Newton steps from `start`, without a test of the cost."""
    state = start
    for _ in range(steps):
        whole = with_priors(linearised(matches, state), state, prior)
        step, expected_gain = damped_step(whole.hessian, whole.gradient, FIRST_DAMPING)
        if expected_gain < 0.0:  # singular
            break
        state = priors.moved(state, step)
    return state


# -- Refinement of the paper (its section 'Refinement'), as a selectable mode ---------------------
#
# The refinement alternates between the rotation and ``(t, d_1, d_2)``. It minimises the squared
# Sampson errors plus ``l_t (|t| - 1)^2 + l_d (|d_1|^2 + |d_2|^2)``. Errors do not depend on the
# common scale of ``(t, d_1, d_2)``, so that ``|t| = 1`` here, the limit of a large l_t.

# The weight l_d, with residuals in units of the pixel noise. A larger one pulls the velocities to
# zero, a smaller one lets them follow the noise. [chosen: the paper gives no value; a velocity of
# ten baselines per second then costs as much as one residual of one sigma]
VELOCITY_WEIGHT = 1e-2
# Most alternations: the loop ends earlier if they gain nothing. [chosen: any value in 5..20]
ALTERNATIONS = 10


@kernel
def refine_alternating(matches: FitMatches, start: TwoViewState, velocities: bool) -> TwoViewState:
    """Refine a state by alternation; gyro corrections, and d without `velocities`, are kept."""
    state = start
    cost = math.inf
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
    hessian = np.zeros((PARAMETERS, PARAMETERS))
    gradient = np.zeros(PARAMETERS)
    step = np.zeros(PARAMETERS)
    candidate = state
    cost = math.inf
    damping = FIRST_DAMPING
    for _ in range(60):
        data = linearised(matches, candidate)
        d = np.concatenate((candidate.d1, candidate.d2))
        total = data.cost + VELOCITY_WEIGHT * (d * d).sum()
        damping *= 0.1 if total <= cost else 10.0
        if total <= cost:
            gain = cost - total
            state = candidate
            cost = total
            if gain <= 1e-8 * cost:
                break
            hessian = data.hessian
            gradient = data.gradient
            gradient[priors.D1 : priors.DW1] += VELOCITY_WEIGHT * d
            for i in range(priors.D1, priors.DW1):
                hessian[i, i] += VELOCITY_WEIGHT
        own = hessian[first:end, first:end].copy()
        part, expected_gain = damped_step(own, gradient[first:end], damping)
        if expected_gain < 0.0:  # singular
            break
        step[first:end] = part
        candidate = priors.moved(state, step)
    return state, cost


# -- Rotation alone: a robust fit with the prior of the gyro --------------------------------------

# Most iterations: the weights change from one to the next, so that a dozen converge.
# [chosen: the loop ends earlier if the step is small; any value in 8..30 would do]
ROTATION_ITERATIONS = 12


@kernel
def transfer_errors(observations: Array, use: Flags, R: Array, focal: float) -> Array:
    """``|f_1 - R f_2|`` [px] of the matches in `use`: their residual motion after a rotation."""
    out = np.empty(use.sum())
    count = 0
    for i in range(len(use)):
        if use[i]:
            f1 = observations[i]
            f2 = observations[i, VIEW_2:]
            total = 0.0
            for j in range(3):
                value = f1[j]
                for k in range(3):
                    value -= R[j, k] * f2[k]
                total += value * value
            out[count] = focal * math.sqrt(total)
            count += 1
    return out


@kernel
def fit_rotation(
    observations: Array,
    use: Flags,
    start: Array,
    prior: Priors,
    focal: float,
    sigma: float,
) -> tuple[Array, Array]:
    """Fit a rotation (3, 3); also the information (3, 3) of its error in frame 1.

    The matches in `use` are weighted iteratively (Cauchy, scale 2 sigma). Of the `prior`, only the
    rotation of the gyro is used.
    """
    R = start.copy()
    information = np.zeros((3, 3))
    # Noise of two coordinates in each of two images.
    weight = focal * focal / (2.0 * sigma * sigma)
    scale2 = 4.0
    for _ in range(ROTATION_ITERATIONS):
        hessian = prior.rotation_information.copy()
        gradient = prior.rotation_information @ so3.log_so3(R @ prior.rotation.T)
        for i in range(len(use)):
            if not use[i]:
                continue
            h = so3.rotated(R, observations[i, VIEW_2:])
            d = so3.subtract(observations[i], h)
            q = weight * so3.dot(d, d)
            w = weight * cauchy_weight(q / scale2)
            # d(f_1 - h) = -theta x h: gradient -(h x (f_1 - h)), Hessian |h|^2 I - h h^T
            turn = so3.cross(h, d)
            for j in range(3):
                next_1 = h[(j + 1) % 3]
                next_2 = h[(j + 2) % 3]
                gradient[j] -= w * turn[j]
                hessian[j, j] += w * (next_1 * next_1 + next_2 * next_2)
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
