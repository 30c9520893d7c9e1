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

# First local parameter of each unknown. [derived: the fields of `TwoViewState`]
_UNKNOWNS = first_indices(theta=3, tangent=2, d1=3, d2=3, dw1=3, dw2=3, scale=1)
# Rotation vector on the left of R. [derived: the order of the unknowns, as all of these]
THETA = _UNKNOWNS['theta']
# Two steps of t in its tangent plane. [derived: the same]
TANGENT = _UNKNOWNS['tangent']
# Velocity of camera 1. [derived: the same]
D1 = _UNKNOWNS['d1']
# Velocity of camera 2. [derived: the same]
D2 = _UNKNOWNS['d2']
# Correction of the rate of camera 1. [derived: the same]
DW1 = _UNKNOWNS['dw1']
# Correction of the rate of camera 2. [derived: the same]
DW2 = _UNKNOWNS['dw2']
# Logarithm of the scale of the velocities, if that is unknown, too. [derived: the same]
SCALE = _UNKNOWNS['scale']
# Number of the unknowns of a state, without the scale. [derived: the same]
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
    t = x[0:3].copy()
    d1 = x[3:6].copy()
    d2 = x[6:9].copy()
    return TwoViewState(R.copy(), t, d1, d2, np.zeros(3), np.zeros(3))


@kernel
def signed(state: TwoViewState, sign: float) -> TwoViewState:
    """The state with its translation and velocities multiplied by `sign`."""
    t = sign * state.t
    d1 = sign * state.d1
    d2 = sign * state.d2
    return TwoViewState(state.R, t, d1, d2, state.dw1, state.dw2)


@kernel
def moved(state: TwoViewState, step: Array) -> TwoViewState:
    """The state after a step (17,) of its local parameters."""
    R = exp_so3(step[THETA:TANGENT]) @ state.R
    t = state.t + tangent_basis(state.t) @ step[TANGENT:D1]
    return TwoViewState(
        R,
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
    d1 = other.d1 - state.d1
    d2 = other.d2 - state.d2
    dw1 = other.dw1 - state.dw1
    dw2 = other.dw2 - state.dw2
    return np.concatenate((turn, tangent, d1, d2, dw1, dw2))


# A weight that fixes its unknowns, so that the angular, linear and global models are cases of the
# uniform one. A smaller weight would leave the unknowns some freedom, a larger one would lose the
# digits of the others. [chosen: 1e-7 of a unit; any value in 1e12..1e16 would do]
PINNED = 1e14


class VelocityPrior(NamedTuple):
    """Prior of the linear velocities: ``u = b (d - c t) + a`` of information W."""

    rate: float  # c
    offset: Array  # a (6,)
    information: Array  # W (6, 6)
    log_scale: float  # current ``log b``
    centre: float  # mean of the prior of ``log b``
    weight: float  # inverse variance of the same; 0 if b is known
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
def at_scale(priors: Priors, log_scale: float, centre: float, freedom: float) -> Priors:
    """The priors with another ``log b``, its prior mean, and g."""
    before = priors.velocity
    return Priors(
        priors.gravity1,
        priors.gravity2,
        priors.gravity_weight,
        priors.gravity_row_time,
        priors.rate_weight,
        priors.rotation,
        priors.rotation_information,
        VelocityPrior(
            before.rate,
            before.offset,
            before.information,
            log_scale,
            centre,
            before.weight,
            freedom,
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


# Unknowns by which the directions of gravity change. [derived: `_add_gravity`]
_OF_GRAVITY = np.array([*range(THETA, TANGENT), *range(DW1, PARAMETERS)])
# Unknowns besides d_1 and d_2 by which the difference u of the velocities changes.
# [derived: `add_velocities`]
_OF_VELOCITIES = np.array([*range(TANGENT, D1), SCALE])


@small_kernel
def _add_gravity(state: TwoViewState, priors: Priors, hessian: Array, gradient: Array) -> float:
    """``r = g x k`` of the two directions in frame 1."""
    # From the row of the measurement to the middle row, with the errors of the gyro.
    tau = priors.gravity_row_time
    g = exp_so3(tau * state.dw1) @ priors.gravity1
    k = exp_so3(tau * state.dw2) @ (state.R @ priors.gravity2)
    aligned = dot(g, k)
    # dr = ((g.k) I - k g^T) (dtheta + tau ddw_2) + tau (g k^T - (g.k) I) ddw_1
    jac = np.zeros((9, 3))
    for i in range(3):
        for j in range(3):
            same = aligned if i == j else 0.0
            by_theta = same - k[i] * g[j]
            jac[j, i] = by_theta
            jac[3 + j, i] = tau * (g[i] * k[j] - same)
            jac[6 + j, i] = tau * by_theta
    r = cross(g, k)
    # Both directions have errors: twice the variance of one.
    w = 0.5 * priors.gravity_weight
    for a in range(9):
        by_a = jac[a]
        row = _OF_GRAVITY[a]
        for i in range(3):
            gradient[row] += w * by_a[i] * r[i]
        for b in range(9):
            by_b = jac[b]
            column = _OF_GRAVITY[b]
            for i in range(3):
                hessian[row, column] += w * by_a[i] * by_b[i]
    return w * dot(r, r)


@kernel
def add_velocities(
    state: TwoViewState, prior: VelocityPrior, hessian: Array, gradient: Array
) -> float:
    """``u^T W u`` of both velocities; t moves in its tangent plane."""
    b = math.exp(prior.log_scale)
    c = prior.rate
    W = prior.information
    basis = tangent_basis(state.t)
    d = np.concatenate((state.d1, state.d2))
    # du by the tangent's two steps and by log b; by (d_1, d_2) it is b.
    jac = np.empty((6, 3))
    u = np.empty(6)
    for i in range(6):
        axis = i % 3
        by_scale = b * (d[i] - c * state.t[axis])
        jac[i, 0] = -b * c * basis[axis, 0]
        jac[i, 1] = -b * c * basis[axis, 1]
        jac[i, 2] = by_scale
        u[i] = by_scale + prior.offset[i]
    columns = 3 if len(gradient) > SCALE else 2
    cost = 0.0
    for i in range(6):
        velocity = D1 + i
        of_velocity = hessian[velocity]
        product = 0.0
        weighted = np.zeros(3)
        for k in range(6):
            weight = W[i, k]
            product += weight * u[k]
            of_velocity[D1 + k] += b * b * weight
            for a in range(columns):
                weighted[a] += weight * jac[k, a]
        cost += u[i] * product
        gradient[velocity] += b * product
        for a in range(columns):
            row = _OF_VELOCITIES[a]
            by_row = jac[i, a]
            gradient[row] += by_row * product
            hessian[row, velocity] += b * weighted[a]
            of_velocity[row] += b * weighted[a]
            for e in range(columns):
                hessian[row, _OF_VELOCITIES[e]] += by_row * weighted[e]
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
        information = priors.rotation_information[i]
        product = dot(information, theta)
        cost += theta[i] * product
        gradient[THETA + i] += product
        for j in range(3):
            hessian[THETA + i, THETA + j] += information[j]
    prior = priors.velocity
    cost += add_velocities(state, prior, hessian, gradient)
    if len(gradient) > SCALE:
        # -2 g log b + (log b - m)^2 / s^2. Half the log-evidence curves by as much again for the
        # velocities that the matches determine.
        away = prior.log_scale - prior.centre
        hessian[SCALE, SCALE] += prior.weight + prior.freedom
        gradient[SCALE] += prior.weight * away - prior.freedom
        cost = cost + prior.weight * away * away - 2.0 * prior.freedom * prior.log_scale
    weight = priors.rate_weight
    for i in range(3):
        dw1 = state.dw1[i]
        dw2 = state.dw2[i]
        hessian[DW1 + i, DW1 + i] += weight
        hessian[DW2 + i, DW2 + i] += weight
        gradient[DW1 + i] += weight * dw1
        gradient[DW2 + i] += weight * dw2
        cost += weight * (dw1**2 + dw2**2)
    return cost


@kernel
def prior_cost(state: TwoViewState, priors: Priors) -> float:
    """The priors' part of the cost."""
    n = unknowns(priors)
    return add_priors(state, priors, np.zeros((n, n)), np.zeros(n))
