"""What the IMU and the scale of motion say of a state, as terms of a least-squares objective.

Over the state of `state` (docs/estimator.md, step 5)::

    |g x k|^2 / (2 s_g^2)  +  (|dw_1|^2 + |dw_2|^2) / s_w^2
        +  (|d_1 - c t|^2 + |d_2 - c t|^2) / s_d^2  +  theta^T Lambda theta

with ``theta = Log(R R_gyro^T)``, and ``g = Exp(T dw_1) g_1``, ``k = Exp(T dw_2) R g_2``: gravity
was measured T after the middle row, and the error of the rate is in what turned it from there.
``c`` is 1 / interval where the time between the frames is known (constant velocity), else 0.

Each function adds its term to the normal equations, Hessian (17, 17) and half gradient (17,), and
to the cost.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from rs_relpose_ros.compiled import kernel, linked_kernel
from rs_relpose_ros.estimator.state import (
    D1,
    D2,
    DW1,
    DW2,
    PARAMETERS,
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


@kernel
def with_velocity_sigma(priors: Priors, sigma: float) -> Priors:
    """The priors with another sigma of the linear velocities [baselines per second]."""
    return Priors(priors.gravity1, priors.gravity2, priors.gravity_weight,
                  priors.gravity_row_time, priors.rate_weight, 1.0 / (sigma * sigma),
                  priors.velocity_rate, priors.rotation, priors.rotation_information)


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


@kernel
def _add_velocities(state: TwoViewState, priors: Priors, hessian: Array, gradient: Array,
                    cost: float) -> float:
    """``w |d_k - c t|^2`` of both velocities, added to `cost`; t moves in its tangent plane."""
    w, c = priors.velocity_weight, priors.velocity_rate
    basis = tangent_basis(state.t)
    for i in range(3):
        e1, e2 = state.d1[i] - c * state.t[i], state.d2[i] - c * state.t[i]
        cost += w * (e1 * e1 + e2 * e2)
        gradient[D1 + i] += w * e1
        gradient[D2 + i] += w * e2
        for first in (D1, D2):
            hessian[first + i, first + i] += w
        for j in range(2):
            mixed = -c * w * basis[i, j]
            gradient[TANGENT + j] += mixed * (e1 + e2)
            for first in (D1, D2):
                hessian[TANGENT + j, first + i] += mixed
                hessian[first + i, TANGENT + j] += mixed
    for j in range(2):
        hessian[TANGENT + j, TANGENT + j] += 2.0 * c * c * w
    return cost


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
    cost = _add_velocities(state, priors, hessian, gradient, cost)
    return _add_rates(state, priors, hessian, gradient, cost)


@kernel
def prior_cost(state: TwoViewState, priors: Priors) -> float:
    """The priors' part of the cost."""
    return add_priors(state, priors, np.zeros((PARAMETERS, PARAMETERS)), np.zeros(PARAMETERS))
