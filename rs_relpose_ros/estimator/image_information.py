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
from rs_relpose_ros.estimator.state import DW1, PARAMETERS, TwoViewState
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
        H, g = _without(self.information, self.gradient, ROTATION)
        return ImageInformation(self.row_time, self.R, np.full(3, np.nan), np.full(6, np.nan),
                                H, g)


def image_information(matches: FitMatches, state: TwoViewState, priors: Priors,
                      row_time: float) -> ImageInformation:
    """Of the matches that a fit used; of its `priors`, only the rates' are kept."""
    data = linearised(matches, state)
    H, g = data.hessian.copy(), data.gradient.copy()
    rates = np.arange(DW1, PARAMETERS)
    # As the errors are, by image regions, not as a Hessian believes them to be: H S^-1 H.
    S = score_of_matches(matches, state, data.hessian, normal_equations(data, state, priors)[0])
    H[rates, rates] += priors.rate_weight
    S[rates, rates] += priors.rate_weight
    g[rates] += priors.rate_weight * np.concatenate([state.dw1, state.dw2])
    S[np.diag_indices(PARAMETERS)] += _RANK * np.trace(S)
    weighted = H @ inverse(S)
    H, g = _without(weighted @ H, weighted @ g, POSE)
    return ImageInformation(row_time, state.R, state.t, np.concatenate([state.d1, state.d2]),
                            H, g)


def rotation_information(R: Array, information: Array, prior: Array, turn_from_gyro: Array,
                         row_time: float) -> ImageInformation:
    """Of a fit of a rotation alone, whose `prior` (3, 3) pulled it by ``-prior turn``."""
    return ImageInformation(row_time, R, np.full(3, np.nan), np.full(6, np.nan),
                            information - prior, -(prior @ turn_from_gyro))


def _without(H: Array, g: Array, keep: int) -> tuple[Array, Array]:
    """Canonical form of the first `keep` unknowns, the others being whatever they are."""
    # Scaled, so that what counts as not observed does not depend on units.
    scale = 1.0 / np.sqrt(np.maximum(np.diag(H)[keep:], np.finfo(float).tiny))
    rest = np.linalg.pinv(H[keep:, keep:] * np.outer(scale, scale), rcond=_RANK, hermitian=True)
    gain = H[:keep, keep:] @ (rest * np.outer(scale, scale))
    reduced = H[:keep, :keep] - gain @ H[keep:, :keep]
    return 0.5 * (reduced + reduced.T), g[:keep] - gain @ g[keep:]
