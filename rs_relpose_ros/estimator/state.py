"""The unknowns of the uniform model and their local parameters."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from rs_relpose_ros.compiled import kernel, linked_kernel
from rs_relpose_ros.geometry.so3 import exp_so3, log_so3
from rs_relpose_ros.geometry.vectors import dot, norm, tangent_basis

Array = NDArray[np.float64]

# Where each unknown's local parameters begin: a turn on the left of R, two steps of t in its
# tangent plane, and four vectors.
PARAMETERS = 17
# Beyond those, where it is unknown: the logarithm of the velocities' scale (`priors`).
SCALE = 17
THETA, TANGENT, D1, D2, DW1, DW2 = 0, 3, 5, 8, 11, 14


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
    return TwoViewState(R.copy(), x[0:3].copy(), x[3:6].copy(), x[6:9].copy(), np.zeros(3),
                        np.zeros(3))


@kernel
def signed(state: TwoViewState, sign: float) -> TwoViewState:
    """The state with its translation and velocities multiplied by `sign`."""
    return TwoViewState(state.R, sign * state.t, sign * state.d1, sign * state.d2, state.dw1,
                        state.dw2)


@linked_kernel
def moved(state: TwoViewState, step: Array) -> TwoViewState:
    """The state after a step (17,) of its local parameters."""
    basis = tangent_basis(state.t)
    t, d1, d2, dw1, dw2 = np.empty(3), np.empty(3), np.empty(3), np.empty(3), np.empty(3)
    for i in range(3):
        t[i] = state.t[i] + basis[i, 0] * step[TANGENT] + basis[i, 1] * step[TANGENT + 1]
        d1[i], d2[i] = state.d1[i] + step[D1 + i], state.d2[i] + step[D2 + i]
        dw1[i], dw2[i] = state.dw1[i] + step[DW1 + i], state.dw2[i] + step[DW2 + i]
    length = norm(t)
    for i in range(3):
        t[i] /= length
    return TwoViewState(exp_so3(step[:3]) @ state.R, t, d1, d2, dw1, dw2)


@linked_kernel
def step_between(state: TwoViewState, other: TwoViewState) -> Array:
    """The step (17,) of local parameters from `state` to `other`: the inverse of `moved`."""
    step = np.empty(PARAMETERS)
    turn = log_so3(other.R @ state.R.T)
    basis = tangent_basis(state.t)
    along = dot(state.t, other.t)
    for k in range(2):
        step[TANGENT + k] = dot(basis[:, k], other.t) / along
    for k in range(3):
        step[THETA + k] = turn[k]
        step[D1 + k] = other.d1[k] - state.d1[k]
        step[D2 + k] = other.d2[k] - state.d2[k]
        step[DW1 + k] = other.dw1[k] - state.dw1[k]
        step[DW2 + k] = other.dw2[k] - state.dw2[k]
    return step
