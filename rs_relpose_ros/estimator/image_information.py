"""What the images alone say of a pair, in canonical form: the priors of the IMU taken out.

A fit minimises ``D(x) + P(x)``, D being the matches' cost and P that of the inertial priors. Who
joins pairs with the IMU's samples in a graph must not count P again, and takes D alone. About the
fit, for a small deviation e of the pose::

    2 D = e^T H e + 2 g^T e + constant        g = -(half gradient of P) at an optimum

H need not have an inverse: of velocities, a global shutter tells nothing. The gyro's rate during
the read-outs stays in it: without, rays have no common row.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from rs_relpose_ros.estimator.information import inverse
from rs_relpose_ros.estimator.map_fit import FitMatches, linearised, normal_equations
from rs_relpose_ros.estimator.priors import Priors
from rs_relpose_ros.estimator.state import D1, D2, DW1, DW2, PARAMETERS, TANGENT, THETA, TwoViewState
from rs_relpose_ros.estimator.uncertainty import score_of_matches
from rs_relpose_ros.geometry.so3 import skew
from rs_relpose_ros.geometry.vectors import tangent_basis

Array = NDArray[np.float64]

# Deviations of a pose with velocities, and of a rotation alone.
POSE, ROTATION = DW1, 3
# Share of the largest eigenvalue below which a direction counts as not observed.
_RANK = 1e-12


@dataclass(frozen=True, slots=True, eq=False)
class ImageInformation:
    """Cost ``e^T H e + 2 g^T e`` of deviations e from a pose, by the images alone.

    ``e = (theta, s, d_1 - v_1, d_2 - v_2)``, in the axes of camera 1: ``R_true = Exp(theta) R``,
    ``t_true`` along ``t + B s`` with ``B = tangent_basis(t)``, and the velocities of the two
    cameras at their reference rows [baselines per second]; or ``e = theta``.

    Attributes
    ----------
    information : (11, 11) or (3, 3) ndarray
        H.
    gradient : (11,) or (3,) ndarray
        g.
    velocities : (6,) ndarray
        ``v_1, v_2``, in camera 1; NaN of a rotation alone.
    """

    information: Array
    gradient: Array
    velocities: Array

    def of_rotation(self) -> ImageInformation:
        """The same of the rotation alone, whatever the rest is."""
        if len(self.gradient) == ROTATION:
            return self
        H, g = _without(self.information, self.gradient, ROTATION)
        return ImageInformation(H, g, np.full(6, np.nan))


def image_information(matches: FitMatches, state: TwoViewState, priors: Priors, delay: float,
                      turn1: Array) -> ImageInformation:
    """Of the matches that a fit used, between rows that lie `delay` [s] after the middle ones.

    Parameters
    ----------
    priors : Priors
        Of the fit; of them only the gyro's rate during the read-outs is kept.
    turn1 : (3, 3) ndarray
        How camera 1 turns during `delay`.
    """
    data = linearised(matches, state)
    H, g = data.hessian.copy(), data.gradient.copy()
    rates = np.arange(DW1, PARAMETERS)
    # As the errors are, by image regions, not as a Hessian believes them to be: H S^-1 H.
    S = score_of_matches(matches, state, data.hessian, normal_equations(data, state, priors)[0])
    rate_weight = priors.rate_weight
    H[rates, rates] += rate_weight
    S[rates, rates] += rate_weight
    g[DW1:DW2] += rate_weight * state.dw1
    g[DW2:] += rate_weight * state.dw2
    S[np.diag_indices(PARAMETERS)] += _RANK * np.trace(S)
    weighted = H @ inverse(S)
    back = np.linalg.inv(_to_row(state, delay, turn1))
    H, g = back.T @ (weighted @ H) @ back, back.T @ (weighted @ g)
    H, g = _without(H, g, POSE)
    scale = float(np.linalg.norm(state.t + delay * (state.d2 - state.d1)))
    return ImageInformation(H, g, np.concatenate([turn1.T @ state.d1, turn1.T @ state.d2]) / scale)


def rotation_information(information: Array, prior: Array, turn_from_gyro: Array,
                         turn1: Array) -> ImageInformation:
    """Of a fit of a rotation alone, whose `prior` (3, 3) pulled it by ``-prior turn``."""
    return ImageInformation(turn1.T @ (information - prior) @ turn1,
                            -turn1.T @ (prior @ turn_from_gyro), np.full(6, np.nan))


def _without(H: Array, g: Array, keep: int) -> tuple[Array, Array]:
    """Canonical form of the first `keep` unknowns, the others being whatever they are."""
    # Scaled, so that what counts as not observed does not depend on units.
    scale = 1.0 / np.sqrt(np.maximum(np.diag(H)[keep:], np.finfo(float).tiny))
    rest = np.linalg.pinv(H[keep:, keep:] * np.outer(scale, scale), rcond=_RANK, hermitian=True)
    gain = H[:keep, keep:] @ (rest * np.outer(scale, scale))
    reduced = H[:keep, :keep] - gain @ H[keep:, :keep]
    return 0.5 * (reduced + reduced.T), g[:keep] - gain @ g[keep:]


def _to_row(state: TwoViewState, delay: float, turn1: Array) -> Array:
    """Derivatives (17, 17) of the local parameters at a later row by those at the middle one.

    As `to_reference_row`: ``t' = E_1^T (t - D d_1 + D d_2)`` of length 1, ``d_k' = E_1^T d_k``;
    all of it turns with errors of the rates, ``E_1 -> Exp(D dw_1) E_1``.
    """
    baseline = state.t + delay * (state.d2 - state.d1)
    scale, back, eye = float(np.linalg.norm(baseline)), turn1.T, np.eye(3)
    t = back @ baseline / scale
    by = np.zeros((3, PARAMETERS))
    by[:, TANGENT:D1] = tangent_basis(state.t)
    by[:, D1:D2], by[:, D2:DW1] = -delay * eye, delay * eye
    by[:, DW1:DW2] = delay * skew(baseline)
    by = back @ by / scale
    out = np.eye(PARAMETERS)
    out[THETA:TANGENT] = 0.0
    out[THETA:TANGENT, THETA:TANGENT] = back
    out[THETA:TANGENT, DW1:DW2], out[THETA:TANGENT, DW2:] = -delay * back, delay * back
    out[TANGENT:D1] = tangent_basis(t).T @ by
    for block, d in ((D1, state.d1), (D2, state.d2)):
        rows = slice(block, block + 3)
        out[rows] = -np.outer(back @ d / scale, t @ by)
        out[rows, rows] += back / scale
        out[rows, DW1:DW2] += delay * back @ skew(d) / scale
    return out
