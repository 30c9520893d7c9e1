"""The refinement of the paper (its section 'Refinement'), as a selectable mode.

Alternates between the rotation and ``(t, d_1, d_2)``, minimising the squared Sampson errors plus
``l_t (|t| - 1)^2 + l_d (|d_1|^2 + |d_2|^2)``.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray
from scipy.optimize import least_squares
from scipy.spatial.transform import Rotation

from rs_relpose_ros.estimator import sampson
from rs_relpose_ros.estimator.state import TwoViewState
from rs_relpose_ros.geometry.so3 import left_jacobian_so3
from rs_relpose_ros.geometry.vectors import tangent_basis

Array = NDArray[np.float64]

# The paper names no values; residuals here are in units of the pixel noise.
TRANSLATION_WEIGHT = 1e3
VELOCITY_WEIGHT = 1e-2
ROUNDS = 10


def refine_alternating(observations: Array, inliers: NDArray[np.bool_], start: TwoViewState,
                       pixel_sigma: float, velocities: bool = True) -> TwoViewState:
    """Refine a state on its inliers by alternation; gyro corrections are left as they are.

    Parameters
    ----------
    observations : (N, 20) ndarray
        Rows of `sampson`.
    inliers : (N,) ndarray of bool
    pixel_sigma : float
        Noise of a match [px].
    velocities : bool
        False keeps ``d_1 = d_2 = 0`` (angular and global models).
    """
    used = np.ascontiguousarray(observations[inliers])
    state, cost = start, np.inf
    for _ in range(ROUNDS):
        turned = least_squares(
            _rotation_residuals, np.zeros(3), jac=_rotation_jacobian, method='lm',
            args=(used, state, pixel_sigma))
        state = state._replace(R=_turned(state.R, turned.x))
        moved = least_squares(
            _translation_residuals, np.concatenate([state.t, state.d1, state.d2]),
            jac=_translation_jacobian, method='lm', args=(used, state, pixel_sigma, velocities))
        state = _with_translation(state, moved.x, velocities)
        previous, cost = cost, float(moved.cost)
        if previous - cost < 1e-6 * cost:
            break
    scale = float(np.linalg.norm(state.t))
    return state._replace(t=state.t / scale, d1=state.d1 / scale, d2=state.d2 / scale)


def _turned(R: Array, theta: Array) -> Array:
    return np.ascontiguousarray(Rotation.from_rotvec(theta).as_matrix() @ R)


def _with_translation(state: TwoViewState, x: Array, velocities: bool) -> TwoViewState:
    zero = np.zeros(3)
    return state._replace(t=x[:3].copy(), d1=x[3:6].copy() if velocities else zero,
                          d2=x[6:9].copy() if velocities else zero)


def _rotation_residuals(theta: Array, used: Array, state: TwoViewState, sigma: float) -> Array:
    return sampson.residuals(used, state._replace(R=_turned(state.R, theta))) / sigma


def _rotation_jacobian(theta: Array, used: Array, state: TwoViewState, sigma: float) -> Array:
    # At Exp(theta) R the local derivative is by a further turn on the left, J(theta) dtheta.
    from_left = sampson.jacobian(used, state._replace(R=_turned(state.R, theta)))[:, :3]
    return np.asarray(from_left @ left_jacobian_so3(theta) / sigma)


def _translation_residuals(x: Array, used: Array, state: TwoViewState, sigma: float,
                           velocities: bool) -> Array:
    moved = _with_translation(state, x, velocities)
    return np.concatenate([
        sampson.residuals(used, moved) / sigma,
        [np.sqrt(TRANSLATION_WEIGHT) * (np.linalg.norm(x[:3]) - 1.0)],
        np.sqrt(VELOCITY_WEIGHT) * x[3:]])


def _translation_jacobian(x: Array, used: Array, state: TwoViewState, sigma: float,
                          velocities: bool) -> Array:
    moved = _with_translation(state, x, velocities)
    length = float(np.linalg.norm(x[:3]))
    unit = x[:3] / length
    full = sampson.jacobian(used, moved._replace(t=unit, d1=moved.d1 / length,
                                                 d2=moved.d2 / length)) / length
    by_d1, by_d2 = full[:, 5:8], full[:, 8:11]
    # The error does not change with a common scale of (t, d_1, d_2): Euler's relation gives the
    # radial derivative from the others.
    radial = -(by_d1 @ moved.d1 + by_d2 @ moved.d2) / length
    by_t = full[:, 3:5] @ tangent_basis(unit).T + radial[:, None] * unit
    by_d = np.hstack([by_d1, by_d2]) if velocities else np.zeros((len(full), 6))
    jacobian = np.zeros((len(full) + 7, 9))
    jacobian[:-7] = np.hstack([by_t, by_d]) / sigma
    jacobian[-7, :3] = np.sqrt(TRANSLATION_WEIGHT) * unit
    jacobian[-6:, 3:] = np.sqrt(VELOCITY_WEIGHT) * np.eye(6)
    return jacobian
