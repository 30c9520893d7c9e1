"""Unknowns of the uniform model, and the priors on them by IMU and scale of motion.

Terms of the least-squares objective over a `TwoViewState` (docs/estimator.md, step 5)::

    |g x k|^2 / (2 s_g^2)  +  (|dw_1|^2 + |dw_2|^2) / s_w^2  +  theta^T Lambda theta
        +  u^T W u,    u = b (d - c t) + a,   d = (d_1, d_2)

with ``theta = Log(R R_gyro^T)``, and ``g = Exp(T dw_1) g_1``, ``k = Exp(T dw_2) R g_2``: gravity
was measured T after the middle row and rotated to it with the gyro's rate, errors included.

u is the difference of the velocities from their expected values, in units in which the baseline
has the length b. If the time between the frames is known, ``c`` is its inverse, b is in metres,
a (6,) follows from the preintegrated acceleration (`velocity`; 0 without accelerometer), and W is
the inverse of its covariance. Otherwise ``c = 0, a = 0, W = I``, and 1 / b is the prior sigma of
the velocities [baselines per second].

Each function adds its term to the normal equations, Hessian (n, n) and half gradient (n,), and to
the cost. n is 17, or 18 if ``log b`` is unknown, too: the cost then contains
``-2 g log b + (log b - m)^2 / s^2``, g being the number of velocities that the matches determine.
"""

import math
from typing import NamedTuple

import numpy as np

from rs_relpose_ros.core.least_squares import first_indices
from rs_relpose_ros.geometry import Array
from rs_relpose_ros.geometry.so3 import cross, dot, exp_so3, log_so3, norm, tangent_basis
from rs_relpose_ros.jit import kernel, small_kernel

# First local parameter of each unknown: a rotation on the left of R, two steps of t in its tangent
# plane, and four vectors. The logarithm of the velocities' scale follows after them if it is
# unknown, too.
_UNKNOWNS = first_indices(theta=3, tangent=2, d1=3, d2=3, dw1=3, dw2=3, scale=1)
THETA = _UNKNOWNS['theta']
TANGENT = _UNKNOWNS['tangent']
D1 = _UNKNOWNS['d1']
D2 = _UNKNOWNS['d2']
DW1 = _UNKNOWNS['dw1']
DW2 = _UNKNOWNS['dw2']
SCALE = _UNKNOWNS['scale']
PARAMETERS = SCALE


class TwoViewState(NamedTuple):
    """Pose, velocities and corrections of the gyro's rates, all in frame 1.

    ``R, t`` (unit), ``d_1 = v_1, d_2 = R v_2`` [baselines per second], ``dw_1, dw_2`` [rad/s].
    """

    R: Array
    t: Array
    d1: Array
    d2: Array
    dw1: Array
    dw2: Array


@kernel
def hypothesis_state(R: Array, x: Array) -> TwoViewState:
    """The state of a hypothesis: R (3, 3) and ``x = (t, d_1, d_2)``, gyro as measured."""
    return TwoViewState(
        R.copy(), x[0:3].copy(), x[3:6].copy(), x[6:9].copy(), np.zeros(3), np.zeros(3)
    )


@kernel
def signed(state: TwoViewState, sign: float) -> TwoViewState:
    """The state with its translation and velocities multiplied by `sign`."""
    return TwoViewState(
        state.R, sign * state.t, sign * state.d1, sign * state.d2, state.dw1, state.dw2
    )


@kernel
def moved(state: TwoViewState, step: Array) -> TwoViewState:
    """The state after a step (17,) of its local parameters."""
    t = state.t + tangent_basis(state.t) @ step[TANGENT:D1]
    return TwoViewState(
        exp_so3(step[THETA:TANGENT]) @ state.R,
        t / norm(t),
        state.d1 + step[D1:D2],
        state.d2 + step[D2:DW1],
        state.dw1 + step[DW1:DW2],
        state.dw2 + step[DW2:PARAMETERS],
    )


@kernel
def step_between(state: TwoViewState, other: TwoViewState) -> Array:
    """The step (17,) of local parameters from `state` to `other`: the inverse of `moved`."""
    turn = log_so3(other.R @ state.R.T)
    tangent = other.t @ tangent_basis(state.t) / dot(state.t, other.t)
    return np.concatenate(
        (
            turn,
            tangent,
            other.d1 - state.d1,
            other.d2 - state.d2,
            other.dw1 - state.dw1,
            other.dw2 - state.dw2,
        )
    )


# A weight that fixes its unknowns: the angular, linear and global models as cases of the uniform
# one.
PINNED = 1e14


class VelocityPrior(NamedTuple):
    """Prior of the linear velocities: ``u = b (d - c t) + a`` of information W."""

    rate: float  # c
    offset: Array  # a (6,)
    information: Array  # W (6, 6)
    log_scale: float  # current ``log b``
    centre: float  # mean of its prior, and its inverse variance: 0 if it is known
    weight: float
    freedom: float  # g, as above


class Priors(NamedTuple):
    """Weights are inverse variances; 0 without a prior. All at the middle row."""

    gravity1: Array
    gravity2: Array
    gravity_weight: float
    gravity_row_time: float  # [s] of its measurement; rotated from there by the gyro
    rate_weight: float
    rotation: Array
    rotation_information: Array
    velocity: VelocityPrior


@kernel
def with_velocity(priors: Priors, velocity: VelocityPrior) -> Priors:
    """The priors with another one of the linear velocities."""
    return Priors(
        priors.gravity1,
        priors.gravity2,
        priors.gravity_weight,
        priors.gravity_row_time,
        priors.rate_weight,
        priors.rotation,
        priors.rotation_information,
        velocity,
    )


@small_kernel
def at_scale(priors: Priors, log_scale: float, centre: float, freedom: float) -> Priors:
    """The priors with another ``log b``, its prior mean, and g."""
    prior = priors.velocity
    return with_velocity(
        priors,
        VelocityPrior(
            prior.rate, prior.offset, prior.information, log_scale, centre, prior.weight, freedom
        ),
    )


def isotropic(sigma: float, rate: float) -> VelocityPrior:
    """Velocities (d_1, d_2) each of `rate` t, with `sigma` per axis [baselines per second]."""
    log_scale = -math.log(sigma)
    return VelocityPrior(rate, np.zeros(6), np.eye(6), log_scale, log_scale, 0.0, 0.0)


@small_kernel
def unknowns(priors: Priors) -> int:
    """Number of unknowns: those of a state, and the velocities' scale if it is unknown."""
    return PARAMETERS + 1 if priors.velocity.weight > 0.0 else PARAMETERS


@small_kernel
def _add_gravity(state: TwoViewState, priors: Priors, hessian: Array, gradient: Array) -> float:
    """``r = g x k`` of the two directions in frame 1."""
    # From the row of the measurement to the middle row, with the errors of the gyro.
    tau = priors.gravity_row_time
    g = exp_so3(tau * state.dw1) @ priors.gravity1
    k = exp_so3(tau * state.dw2) @ (state.R @ priors.gravity2)
    aligned = dot(g, k)
    # dr = ((g.k) I - k g^T) (dtheta + tau ddw_2) + tau (g k^T - (g.k) I) ddw_1
    blocks = (THETA, DW1, DW2)
    jac = np.zeros((3, 9))
    for i in range(3):
        for j in range(3):
            same = aligned if i == j else 0.0
            jac[i, j] = same - k[i] * g[j]
            jac[i, 3 + j] = tau * (g[i] * k[j] - same)
            jac[i, 6 + j] = tau * jac[i, j]
    r = cross(g, k)
    # Both directions have errors: twice the variance of one.
    w = 0.5 * priors.gravity_weight
    for a in range(9):
        row = blocks[a // 3] + a % 3
        for i in range(3):
            gradient[row] += w * jac[i, a] * r[i]
        for b in range(9):
            column = blocks[b // 3] + b % 3
            for i in range(3):
                hessian[row, column] += w * jac[i, a] * jac[i, b]
    return w * dot(r, r)


@kernel
def add_velocities(
    state: TwoViewState, prior: VelocityPrior, hessian: Array, gradient: Array
) -> float:
    """``u^T W u`` of both velocities; t moves in its tangent plane."""
    b, c, W = math.exp(prior.log_scale), prior.rate, prior.information
    basis = tangent_basis(state.t)
    # du by the tangent's two steps and by log b; by (d_1, d_2) it is b.
    jac, u = np.empty((6, 3)), np.empty(6)
    for i in range(6):
        axis = i % 3
        d = state.d1[axis] if i < 3 else state.d2[axis]
        jac[i, 0], jac[i, 1] = -b * c * basis[axis, 0], -b * c * basis[axis, 1]
        jac[i, 2] = b * (d - c * state.t[axis])
        u[i] = jac[i, 2] + prior.offset[i]
    columns, cost = 3 if len(gradient) > SCALE else 2, 0.0
    for i in range(6):
        product, weighted = 0.0, np.zeros(3)
        for k in range(6):
            product += W[i, k] * u[k]
            hessian[D1 + i, D1 + k] += b * b * W[i, k]
            for a in range(columns):
                weighted[a] += W[i, k] * jac[k, a]
        cost += u[i] * product
        gradient[D1 + i] += b * product
        for a in range(columns):
            row = TANGENT + a if a < 2 else SCALE
            gradient[row] += jac[i, a] * product
            hessian[row, D1 + i] += b * weighted[a]
            hessian[D1 + i, row] += b * weighted[a]
            for e in range(columns):
                hessian[row, TANGENT + e if e < 2 else SCALE] += jac[i, a] * weighted[e]
    return cost


@kernel
def add_priors(state: TwoViewState, priors: Priors, hessian: Array, gradient: Array) -> float:
    """Add all priors to the normal equations; their part of the cost."""
    cost = 0.0
    if priors.gravity_weight > 0.0:
        cost += _add_gravity(state, priors, hessian, gradient)
    # theta^T Lambda theta: the Jacobian of Log is approximated by I.
    theta = log_so3(state.R @ priors.rotation.T)
    for i in range(3):
        product = dot(priors.rotation_information[i], theta)
        cost += theta[i] * product
        gradient[THETA + i] += product
        for j in range(3):
            hessian[THETA + i, THETA + j] += priors.rotation_information[i, j]
    prior = priors.velocity
    cost += add_velocities(state, prior, hessian, gradient)
    if len(gradient) > SCALE:
        # -2 g log b + (log b - m)^2 / s^2. Half the log-evidence curves by as much again for the
        # velocities that the matches determine.
        away = prior.log_scale - prior.centre
        hessian[SCALE, SCALE] += prior.weight + prior.freedom
        gradient[SCALE] += prior.weight * away - prior.freedom
        cost = cost + prior.weight * away * away - 2.0 * prior.freedom * prior.log_scale
    for i in range(3):
        hessian[DW1 + i, DW1 + i] += priors.rate_weight
        hessian[DW2 + i, DW2 + i] += priors.rate_weight
        gradient[DW1 + i] += priors.rate_weight * state.dw1[i]
        gradient[DW2 + i] += priors.rate_weight * state.dw2[i]
        cost += priors.rate_weight * (state.dw1[i] ** 2 + state.dw2[i] ** 2)
    return cost


@kernel
def prior_cost(state: TwoViewState, priors: Priors) -> float:
    """The priors' part of the cost."""
    n = unknowns(priors)
    return add_priors(state, priors, np.zeros((n, n)), np.zeros(n))
