"""Joint maximum-a-posteriori fit of the uniform model: Sampson errors and IMU priors.

Minimises, over ``R, t`` (unit), ``d_1, d_2, dw_1, dw_2`` (design section 4)::

    sum r_i^2 / s^2  +  |g x k|^2 / (2 s_g^2)  +  (|dw_1|^2 + |dw_2|^2) / s_w^2
        +  (|d_1 - c t|^2 + |d_2 - c t|^2) / s_d^2  +  theta^T Lambda theta

with ``theta = Log(R R_gyro^T)``, and ``g = Exp(T dw_1) g_1``, ``k = Exp(T dw_2) R g_2``: gravity
was measured T after the middle row, and the error of the rate is in what turned it from there.

``c`` is 1 / interval where the time between the frames is known (constant velocity), else 0. By
Levenberg-Marquardt with the exact Jacobian (the Sampson denominator included: treating it as
constant converges to another point). A weight of `PINNED` holds a block at its start, which is how
the angular, linear and global models are fitted by the same code.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from rs_relpose_ros.compiled import kernel, linked_kernel
from rs_relpose_ros.estimator import sampson
from rs_relpose_ros.estimator.sampson import D1, D2, DW1, DW2, PARAMETERS, TANGENT, THETA
from rs_relpose_ros.geometry.so3 import exp_so3, log_so3

Array = NDArray[np.float64]

PINNED = 1e14
# Of the diagonal of the Hessian.
FIRST_DAMPING = 1e-4
# A fit ends where a step gains less than this share of a cost (chi-square) of one.
LEAST_GAIN = 1e-7


class Priors(NamedTuple):
    """Weights are inverse variances; 0 where nothing is known. All at the middle row.

    Gravity was measured `gravity_row_time` [s] after that and turned there by the gyro.
    """

    gravity1: Array
    gravity2: Array
    gravity_weight: float
    gravity_row_time: float
    rate_weight: float
    velocity_weight: float
    velocity_rate: float
    rotation: Array
    rotation_information: Array


class State(NamedTuple):
    """The unknowns of the uniform model, all in frame 1."""

    R: Array
    t: Array
    d1: Array
    d2: Array
    dw1: Array
    dw2: Array


@linked_kernel
def _add_gravity_prior(state: State, priors: Priors, hessian: Array, gradient: Array) -> float:
    """``r = g x k`` of the two directions in frame 1; each is off by as much as one frame's."""
    # Gravity is known at a row from which the gyro, errors included, leads to the middle row.
    tau = priors.gravity_row_time
    g = exp_so3(tau * state.dw1) @ priors.gravity1
    k = exp_so3(tau * state.dw2) @ (state.R @ priors.gravity2)
    dot = g[0] * k[0] + g[1] * k[1] + g[2] * k[2]
    # dr = ((g.k) I - k g^T) (dtheta + tau ddw_2) + tau (g k^T - (g.k) I) ddw_1
    blocks = (THETA, DW1, DW2)
    jac = np.zeros((3, 9))
    for i in range(3):
        for j in range(3):
            same = dot if i == j else 0.0
            jac[i, j] = same - k[i] * g[j]
            jac[i, 3 + j] = tau * (g[i] * k[j] - same)
            jac[i, 6 + j] = tau * jac[i, j]
    r = np.empty(3)
    r[0] = g[1] * k[2] - g[2] * k[1]
    r[1] = g[2] * k[0] - g[0] * k[2]
    r[2] = g[0] * k[1] - g[1] * k[0]
    # Each of the two directions carries the error: twice the variance of one.
    w = 0.5 * priors.gravity_weight
    for a in range(9):
        row = blocks[a // 3] + a % 3
        for i in range(3):
            gradient[row] += w * jac[i, a] * r[i]
        for b in range(9):
            column = blocks[b // 3] + b % 3
            for i in range(3):
                hessian[row, column] += w * jac[i, a] * jac[i, b]
    return w * (r[0] * r[0] + r[1] * r[1] + r[2] * r[2])


@linked_kernel
def _add_priors(state: State, priors: Priors, hessian: Array, gradient: Array) -> float:
    """Add the priors to the normal equations; their part of the cost."""
    cost = 0.0
    if priors.gravity_weight > 0.0:
        cost += _add_gravity_prior(state, priors, hessian, gradient)
    theta = log_so3(state.R @ priors.rotation.T)
    info = priors.rotation_information
    for i in range(3):
        product = info[i, 0] * theta[0] + info[i, 1] * theta[1] + info[i, 2] * theta[2]
        cost += theta[i] * product
        gradient[i] += product
        for j in range(3):
            hessian[i, j] += info[i, j]
    w, c = priors.velocity_weight, priors.velocity_rate
    basis = sampson.tangent_basis(state.t)
    for i in range(3):
        e1, e2 = state.d1[i] - c * state.t[i], state.d2[i] - c * state.t[i]
        cost += w * (e1 * e1 + e2 * e2)
        hessian[D1 + i, D1 + i] += w
        hessian[D2 + i, D2 + i] += w
        gradient[D1 + i] += w * e1
        gradient[D2 + i] += w * e2
        for j in range(2):
            cross = -c * w * basis[i, j]
            gradient[TANGENT + j] += cross * (e1 + e2)
            hessian[TANGENT + j, D1 + i] += cross
            hessian[D1 + i, TANGENT + j] += cross
            hessian[TANGENT + j, D2 + i] += cross
            hessian[D2 + i, TANGENT + j] += cross
    for j in range(2):
        hessian[TANGENT + j, TANGENT + j] += 2.0 * c * c * w
    for i in range(3):
        hessian[DW1 + i, DW1 + i] += priors.rate_weight
        hessian[DW2 + i, DW2 + i] += priors.rate_weight
        gradient[DW1 + i] += priors.rate_weight * state.dw1[i]
        gradient[DW2 + i] += priors.rate_weight * state.dw2[i]
        cost += priors.rate_weight * (state.dw1[i] ** 2 + state.dw2[i] ** 2)
    return cost


@kernel
def prior_cost(state: State, priors: Priors) -> float:
    """The priors' part of the cost."""
    return _add_priors(state, priors, np.zeros((PARAMETERS, PARAMETERS)), np.zeros(PARAMETERS))


class DataTerm(NamedTuple):
    """The matches' part of the objective about one state, in units of their noise.

    No prior is in it, so that fits with different priors share it.
    """

    hessian: Array
    gradient: Array
    cost: float


@kernel
def linearised(observations: Array, use: NDArray[np.bool_], state: State,
               sigma: float) -> DataTerm:
    """Hessian (17, 17), half gradient (17,) and cost of the matches in `use` about `state`."""
    hessian, gradient, squares = sampson.normal_equations(
        observations, use, state.R, state.t, state.d1, state.d2, state.dw1, state.dw2)
    weight = 1.0 / (sigma * sigma)
    hessian *= weight
    gradient *= weight
    return DataTerm(hessian, gradient, squares * weight)


@kernel
def normal_equations(data: DataTerm, state: State, priors: Priors) -> tuple[Array, Array, float]:
    """Hessian (17, 17), half gradient (17,) and cost of the whole objective at `state`."""
    hessian, gradient = data.hessian.copy(), data.gradient.copy()
    cost = data.cost + _add_priors(state, priors, hessian, gradient)
    return hessian, gradient, cost


@linked_kernel
def moved(state: State, step: Array) -> State:
    """The state after a step (17,) of its local parameters."""
    basis = sampson.tangent_basis(state.t)
    t = state.t + basis[:, 0] * step[3] + basis[:, 1] * step[4]
    return State(exp_so3(step[:3]) @ state.R, t / math.sqrt((t * t).sum()),
                 state.d1 + step[D1:D1 + 3], state.d2 + step[D2:D2 + 3],
                 state.dw1 + step[DW1:DW1 + 3], state.dw2 + step[DW2:DW2 + 3])


@linked_kernel
def step_between(state: State, other: State) -> Array:
    """The step (17,) of local parameters from `state` to `other`: the inverse of `moved`."""
    step = np.empty(PARAMETERS)
    step[:3] = log_so3(other.R @ state.R.T)
    basis = sampson.tangent_basis(state.t)
    along = (state.t * other.t).sum()
    for k in range(2):
        step[TANGENT + k] = (basis[:, k] * other.t).sum() / along
    step[D1:D1 + 3] = other.d1 - state.d1
    step[D2:D2 + 3] = other.d2 - state.d2
    step[DW1:DW1 + 3] = other.dw1 - state.dw1
    step[DW2:DW2 + 3] = other.dw2 - state.dw2
    return step


@linked_kernel
def cholesky(matrix: Array, factor: Array) -> bool:
    """Lower Cholesky factor of a symmetric matrix; False unless it is positive definite."""
    n = matrix.shape[0]
    for i in range(n):
        for j in range(i + 1):
            value = matrix[i, j]
            for k in range(j):
                value -= factor[i, k] * factor[j, k]
            if i == j:
                if not value > 0.0:
                    return False
                factor[i, i] = math.sqrt(value)
            else:
                factor[i, j] = value / factor[j, j]
    return True


@kernel
def cholesky_solve(factor: Array, right: Array) -> Array:
    """Solution of ``L L^T x = right``."""
    n = right.shape[0]
    x = right.copy()
    for i in range(n):
        for k in range(i):
            x[i] -= factor[i, k] * x[k]
        x[i] /= factor[i, i]
    for i in range(n - 1, -1, -1):
        for k in range(i + 1, n):
            x[i] -= factor[k, i] * x[k]
        x[i] /= factor[i, i]
    return x


@linked_kernel
def fit(observations: Array, use: NDArray[np.bool_], start: State, data: DataTerm,
        priors: Priors, sigma: float,
        iterations: int) -> tuple[State, DataTerm, float, Array]:
    """Levenberg-Marquardt from `start` over the matches in `use`.

    Parameters
    ----------
    data : DataTerm
        About `start`.

    Returns
    -------
    state : State
    data : DataTerm
        About that state.
    cost : float
        Of the whole objective.
    hessian : (17, 17) ndarray
        Of the whole objective.
    """
    state = start
    damping = FIRST_DAMPING
    hessian, gradient, cost = normal_equations(data, state, priors)
    damped = np.empty((PARAMETERS, PARAMETERS))
    factor = np.zeros((PARAMETERS, PARAMETERS))
    for _ in range(iterations):
        damped[:] = hessian
        for i in range(PARAMETERS):
            damped[i, i] += damping * hessian[i, i] + 1e-12
        if not cholesky(damped, factor):
            damping = max(damping * 10.0, 1e-6)
            if damping > 1e8:
                break
            continue
        step = cholesky_solve(factor, -gradient)
        # What the step promises to gain (Newton's decrement): too little to look at it.
        if -(gradient * step).sum() < LEAST_GAIN * (1.0 + cost):
            break
        candidate = moved(state, step)
        # Most steps are taken: their derivatives cost little more than the residuals alone.
        next_data = linearised(observations, use, candidate, sigma)
        next_hessian, next_gradient, next_cost = normal_equations(next_data, candidate, priors)
        if next_cost <= cost:
            state, data = candidate, next_data
            hessian, gradient, cost = next_hessian, next_gradient, next_cost
            damping = max(damping * 0.1, 1e-9)
        else:
            damping *= 10.0
            if not damping < 1e8:
                break
    return state, data, cost, hessian


@linked_kernel
def stepped(observations: Array, use: NDArray[np.bool_], start: State, priors: Priors,
            sigma: float, steps: int) -> State:
    """The state after some Gauss-Newton steps from `start`, better or not."""
    state = start
    factor = np.zeros((PARAMETERS, PARAMETERS))
    for _ in range(steps):
        hessian, gradient, _ = normal_equations(
            linearised(observations, use, state, sigma), state, priors)
        for i in range(PARAMETERS):
            hessian[i, i] += FIRST_DAMPING * hessian[i, i] + 1e-12
        if not cholesky(hessian, factor):
            break
        state = moved(state, cholesky_solve(factor, -gradient))
    return state


@linked_kernel
def _scaled_factor(information: Array) -> tuple[Array, Array]:
    """Scales (n,) that make the diagonal 1, and the Cholesky factor of the matrix so scaled.

    A floor of rounding on the diagonal keeps it positive definite, however badly conditioned.
    """
    n = information.shape[0]
    scale = np.empty(n)
    for i in range(n):
        scale[i] = 1.0 / math.sqrt(max(information[i, i], 1e-30))
    scaled = information * scale * scale.reshape(n, 1)
    for i in range(n):
        scaled[i, i] += 1e-13
    factor = np.zeros((n, n))
    if not cholesky(scaled, factor):
        factor[:] = np.nan
    return scale, factor


@linked_kernel
def inverse(information: Array) -> Array:
    """Covariance (n, n) of an information matrix: never indefinite."""
    scale, factor = _scaled_factor(information)
    n = len(scale)
    rows = np.zeros((n, n))
    for j in range(n):   # the inverse of the factor, column by column
        rows[j, j] = 1.0 / factor[j, j]
        for i in range(j + 1, n):
            value = 0.0
            for k in range(j, i):
                value -= factor[i, k] * rows[k, j]
            rows[i, j] = value / factor[i, i]
    rows *= scale
    return rows.T @ rows


@kernel
def log_determinant(hessian: Array) -> float:
    """Log-determinant of a positive definite matrix."""
    scale, factor = _scaled_factor(hessian)
    value = 0.0
    for i in range(len(scale)):
        value += 2.0 * math.log(factor[i, i] / scale[i])
    return value
