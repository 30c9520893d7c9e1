"""What the IMU and the scale of motion say of a state, as terms of a least-squares objective.

Over the state of `state` (docs/estimator.md, step 5)::

    |g x k|^2 / (2 s_g^2)  +  (|dw_1|^2 + |dw_2|^2) / s_w^2  +  theta^T Lambda theta
        +  u^T W u,    u = b (d - c t) + a,   d = (d_1, d_2)

with ``theta = Log(R R_gyro^T)``, and ``g = Exp(T dw_1) g_1``, ``k = Exp(T dw_2) R g_2``: gravity
was measured T after the middle row, and the error of the rate is in what turned it from there.

u are the velocities against what is expected of them, in the units in which their scale b is the
length of the baseline. Where the time between the frames is known, ``c`` is its inverse, b is in
metres, and a (6,) is what the preintegrated acceleration says of the velocities (`velocity_prior`;
0 without accelerometer), W the inverse of its covariance. Where it is not, ``c = 0, a = 0, W = I``
and 1 / b is the prior sigma of the velocities [baselines per second].

Each function adds its term to the normal equations, Hessian (n, n) and half gradient (n,), and to
the cost. n is 17, or 18 where ``log b`` is unknown, too: ``-2 g log b + (log b - m)^2 / s^2`` then
is part of the cost, g being the number of velocities that the matches know (`velocity_prior`).
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from rs_relpose_ros.compiled import kernel, linked_kernel
from rs_relpose_ros.estimator.state import (
    DW1,
    DW2,
    PARAMETERS,
    SCALE,
    TANGENT,
    THETA,
    TwoViewState,
)
from rs_relpose_ros.geometry.so3 import exp_so3, log_so3
from rs_relpose_ros.geometry.vectors import cross, dot, tangent_basis

Array = NDArray[np.float64]

# A weight that holds its unknowns at their start: how the angular, linear and global models are
# fitted as cases of the uniform one.
PINNED = 1e14


class VelocityPrior(NamedTuple):
    """What is known of the linear velocities: c, a (6,) and W (6, 6) of ``u = b (d - c t) + a``.

    `log_scale` is ``log b``, as it is now. Where it is unknown: mean `centre` and inverse variance
    `weight` of its prior (0 where it is known), `freedom`: g, as above.
    """

    rate: float
    offset: Array
    information: Array
    log_scale: float
    centre: float
    weight: float
    freedom: float


class Priors(NamedTuple):
    """Weights are inverse variances; 0 where nothing is known. All at the middle row.

    Gravity was measured `gravity_row_time` [s] after that and turned there by the gyro.
    """

    gravity1: Array
    gravity2: Array
    gravity_weight: float
    gravity_row_time: float
    rate_weight: float
    rotation: Array
    rotation_information: Array
    velocity: VelocityPrior


@kernel
def with_velocity(priors: Priors, velocity: VelocityPrior) -> Priors:
    """The priors with another one of the linear velocities."""
    return Priors(priors.gravity1, priors.gravity2, priors.gravity_weight,
                  priors.gravity_row_time, priors.rate_weight, priors.rotation,
                  priors.rotation_information, velocity)


@kernel
def with_log_scale(priors: Priors, log_scale: float) -> Priors:
    """The priors about another ``log b``."""
    prior = priors.velocity
    return with_velocity(priors, VelocityPrior(
        prior.rate, prior.offset, prior.information, log_scale, prior.centre, prior.weight,
        prior.freedom))


def isotropic(sigma: float, rate: float) -> VelocityPrior:
    """Velocities (d_1, d_2) each of `rate` t, with `sigma` per axis [baselines per second]."""
    log_scale = -math.log(sigma)
    return VelocityPrior(rate, np.zeros(6), np.eye(6), log_scale, log_scale, 0.0, 0.0)


@kernel
def unknowns(priors: Priors) -> int:
    """Number of unknowns: those of a state, and the velocities' scale where it is one."""
    return PARAMETERS + 1 if priors.velocity.weight > 0.0 else PARAMETERS


@linked_kernel
def _add_gravity(state: TwoViewState, priors: Priors, hessian: Array, gradient: Array) -> float:
    """``r = g x k`` of the two directions in frame 1; each is off by as much as one frame's."""
    # Gravity is known at a row from which the gyro, errors included, leads to the middle row.
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
    return w * dot(r, r)


@kernel
def _add_rotation(state: TwoViewState, priors: Priors, hessian: Array, gradient: Array,
                  cost: float) -> float:
    """``theta^T Lambda theta``, added to `cost`; Log's Jacobian is taken for the identity."""
    theta = log_so3(state.R @ priors.rotation.T)
    information = priors.rotation_information
    for i in range(3):
        product = dot(information[i], theta)
        cost += theta[i] * product
        gradient[THETA + i] += product
        for j in range(3):
            hessian[THETA + i, THETA + j] += information[i, j]
    return cost


@linked_kernel
def add_velocities(state: TwoViewState, prior: VelocityPrior, hessian: Array,
                   gradient: Array) -> float:
    """``u^T W u`` of both velocities; t moves in its tangent plane."""
    b, c = math.exp(prior.log_scale), prior.rate
    basis = tangent_basis(state.t)
    # du by the tangent, by d_1 and d_2, and by log b
    jac, u = np.zeros((6, 9)), np.empty(6)
    for i in range(6):
        axis = i % 3
        d = state.d1[axis] if i < 3 else state.d2[axis]
        jac[i, 0], jac[i, 1] = -b * c * basis[axis, 0], -b * c * basis[axis, 1]
        jac[i, 2 + i] = b
        jac[i, 8] = b * (d - c * state.t[axis])
        u[i] = jac[i, 8] + prior.offset[i]
    n, cost = 9 if len(gradient) > SCALE else 8, 0.0
    weighted = np.zeros((6, 9))
    for i in range(6):
        product = 0.0
        for k in range(6):
            w = prior.information[i, k]
            product += w * u[k]
            for a in range(n):
                weighted[i, a] += w * jac[k, a]
        cost += u[i] * product
    for a in range(n):
        row = TANGENT + a if a < 8 else SCALE
        for i in range(6):
            gradient[row] += weighted[i, a] * u[i]
        for e in range(n):
            column = TANGENT + e if e < 8 else SCALE
            for i in range(6):
                hessian[row, column] += jac[i, a] * weighted[i, e]
    return cost


@kernel
def _add_scale(prior: VelocityPrior, hessian: Array, gradient: Array, cost: float) -> float:
    """``-2 g log b + (log b - m)^2 / s^2``, added to `cost`."""
    away = prior.log_scale - prior.centre
    # Of the velocities that the matches know, half the log-evidence curves by as much again.
    hessian[SCALE, SCALE] += prior.weight + prior.freedom
    gradient[SCALE] += prior.weight * away - prior.freedom
    return cost + prior.weight * away * away - 2.0 * prior.freedom * prior.log_scale


@kernel
def _add_rates(state: TwoViewState, priors: Priors, hessian: Array, gradient: Array,
               cost: float) -> float:
    """``w |dw_k|^2`` of both corrections of the gyro, added to `cost`."""
    for i in range(3):
        hessian[DW1 + i, DW1 + i] += priors.rate_weight
        hessian[DW2 + i, DW2 + i] += priors.rate_weight
        gradient[DW1 + i] += priors.rate_weight * state.dw1[i]
        gradient[DW2 + i] += priors.rate_weight * state.dw2[i]
        cost += priors.rate_weight * (state.dw1[i] ** 2 + state.dw2[i] ** 2)
    return cost


@linked_kernel
def add_priors(state: TwoViewState, priors: Priors, hessian: Array, gradient: Array) -> float:
    """Add all priors to the normal equations; their part of the cost."""
    cost = 0.0
    if priors.gravity_weight > 0.0:
        cost += _add_gravity(state, priors, hessian, gradient)
    cost = _add_rotation(state, priors, hessian, gradient, cost)
    cost += add_velocities(state, priors.velocity, hessian, gradient)
    if len(gradient) > SCALE:
        cost = _add_scale(priors.velocity, hessian, gradient, cost)
    return _add_rates(state, priors, hessian, gradient, cost)


@kernel
def prior_cost(state: TwoViewState, priors: Priors) -> float:
    """The priors' part of the cost."""
    n = unknowns(priors)
    return add_priors(state, priors, np.zeros((n, n)), np.zeros(n))
