"""Covariance of a state: from the Hessian of the fit to the quantities of a pose."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from rs_relpose_ros.estimator.information import inverse
from rs_relpose_ros.estimator.map_fit import FitMatches, linearised, normal_equations
from rs_relpose_ros.estimator.priors import Priors
from rs_relpose_ros.estimator.problem import PairState, TwoViewProblem
from rs_relpose_ros.estimator.state import TwoViewState
from rs_relpose_ros.geometry.so3 import skew
from rs_relpose_ros.geometry.vectors import tangent_basis

Array = NDArray[np.float64]


def local_covariance(matches: FitMatches, state: TwoViewState, priors: Priors) -> Array:
    """Covariance (17, 17) of the local parameters from the regularised Hessian."""
    hessian, gradient, _ = normal_equations(linearised(matches, state), state, priors)
    local = inverse(hessian)
    # A state that is not the optimum is off by about this step.
    step = local @ gradient
    return np.asarray(local + np.outer(step, step))


def pair_state(problem: TwoViewProblem, state: TwoViewState, local: Array) -> PairState:
    """The state in each camera's own frame, with its covariance.

    Parameters
    ----------
    local : (17, 17) ndarray
        Covariance of the state's local parameters ``(theta, tangent, d_1, d_2, dw_1, dw_2)``,
        which are in frame 1.
    """
    jacobian = np.zeros((18, 17))
    jacobian[0:3, 3:5] = tangent_basis(state.t)
    jacobian[3:6, 0:3] = np.eye(3)
    jacobian[6:9, 5:8] = np.eye(3)
    # v_2 = R^T d_2, w_2 = w + R^T dw_2: the error of R turns them with it.
    jacobian[9:12, 8:11] = state.R.T
    jacobian[9:12, 0:3] = state.R.T @ skew(state.d2)
    jacobian[12:15, 11:14] = np.eye(3)
    jacobian[15:18, 14:17] = state.R.T
    w1 = problem.motion1.angular_velocity + state.dw1
    w2 = problem.motion2.angular_velocity + state.R.T @ state.dw2
    return PairState(state.R, state.t, state.d1, state.R.T @ state.d2, w1, w2,
                     jacobian @ local @ jacobian.T)
