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

from rs_relpose_ros.compiled import linked_kernel
from rs_relpose_ros.estimator.information import inverse
from rs_relpose_ros.estimator.map_fit import FitMatches, linearised, normal_equations
from rs_relpose_ros.estimator.priors import Priors
from rs_relpose_ros.estimator.state import DW1, DW2, PARAMETERS, TwoViewState
from rs_relpose_ros.estimator.uncertainty import score_of_matches

Array = NDArray[np.float64]

# Deviations of a pose with velocities, and of a rotation alone.
POSE, ROTATION = DW1, 3
# Share of the largest eigenvalue below which a direction counts as not observed.
_RANK = 1e-12


@dataclass(frozen=True, slots=True, eq=False)
class ImageInformation:
    """Cost ``e^T H e + 2 g^T e`` of deviations e from a pose, by the images alone.

    ``e = (theta, s, v_1 - d_1, v_2 - d_2)``, in the axes of camera 1: ``R_true = Exp(theta) R``,
    ``t_true`` along ``t + B s`` with ``B = tangent_basis(t)``, and the velocities of the two
    cameras [baselines per second]; or ``e = theta``. All of it between the **middle** rows, where
    the direction hardly depends on the velocities.

    Attributes
    ----------
    row_time : float
        Of the middle row, after the stamped one [s].
    R : (3, 3) ndarray
        ``R_1^T R_2``.
    t : (3,) ndarray
        Unit direction; NaN of a rotation alone.
    velocities : (6,) ndarray
        ``d_1, d_2``, in camera 1; NaN likewise.
    information : (11, 11) or (3, 3) ndarray
        H.
    gradient : (11,) or (3,) ndarray
        g.
    """

    row_time: float
    R: Array
    t: Array
    velocities: Array
    information: Array
    gradient: Array

    def of_rotation(self) -> ImageInformation:
        """The same of the rotation alone, whatever the rest is."""
        if len(self.gradient) == ROTATION:
            return self
        H, g = _of_rotation(self.information, self.gradient)
        return ImageInformation(self.row_time, self.R, np.full(3, np.nan), np.full(6, np.nan),
                                H, g)


def image_information(matches: FitMatches, state: TwoViewState, priors: Priors,
                      row_time: float) -> ImageInformation:
    """Of the matches that a fit used; of its `priors`, only the rates' are kept."""
    H, g = _of_pose(matches, state, priors)
    return ImageInformation(row_time, state.R, state.t, np.concatenate([state.d1, state.d2]),
                            H, g)


@linked_kernel
def _of_pose(matches: FitMatches, state: TwoViewState, priors: Priors) -> tuple[Array, Array]:
    """Information (11, 11) and gradient (11,) of the pose, the rates being what they are."""
    data = linearised(matches, state)
    H, g = data.hessian, data.gradient
    # As the errors are, by image regions, not as a Hessian believes them to be: H S^-1 H.
    S = score_of_matches(matches, state, H, normal_equations(data, state, priors)[0])
    floor = _RANK * (np.trace(S) + 6.0 * priors.rate_weight)
    for i in range(3):
        g[DW1 + i] += priors.rate_weight * state.dw1[i]
        g[DW2 + i] += priors.rate_weight * state.dw2[i]
    for i in range(DW1, PARAMETERS):
        H[i, i] += priors.rate_weight
        S[i, i] += priors.rate_weight
    for i in range(PARAMETERS):
        S[i, i] += floor
    weighted = H @ inverse(S)
    H, g = weighted @ H, weighted @ g
    gain = H[:POSE, POSE:].copy() @ inverse(H[POSE:, POSE:].copy())
    reduced = H[:POSE, :POSE] - gain @ H[POSE:, :POSE].copy()
    return 0.5 * (reduced + reduced.T), g[:POSE] - gain @ g[POSE:]


def rotation_information(R: Array, information: Array, prior: Array, turn_from_gyro: Array,
                         row_time: float) -> ImageInformation:
    """Of a fit of a rotation alone, whose `prior` (3, 3) pulled it by ``-prior turn``."""
    return ImageInformation(row_time, R, np.full(3, np.nan), np.full(6, np.nan),
                            information - prior, -(prior @ turn_from_gyro))


def _of_rotation(H: Array, g: Array) -> tuple[Array, Array]:
    """Canonical form of a pose's rotation, the others being whatever they are."""
    # Scaled, so that what counts as not observed does not depend on units.
    k = ROTATION
    scale = 1.0 / np.sqrt(np.maximum(np.diag(H)[k:], np.finfo(float).tiny))
    rest = np.linalg.pinv(H[k:, k:] * np.outer(scale, scale), rcond=_RANK, hermitian=True)
    gain = H[:k, k:] @ (rest * np.outer(scale, scale))
    reduced = H[:k, :k] - gain @ H[k:, :k]
    return 0.5 * (reduced + reduced.T), g[:k] - gain @ g[k:]
