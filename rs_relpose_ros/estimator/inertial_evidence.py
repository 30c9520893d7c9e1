"""Whether the accelerometer agrees with what a pair's images say of the velocities.

The images alone say ``exp(-(e^T H e + 2 g^T e) / 2)`` of pose and velocities (`ImageInformation`).
With the rotation by the gyro eliminated, ``y = (s, v_1 - d_1, v_2 - d_2)`` is left, in which
``u = b (d - c t) + a`` (`priors`) is linear: ``u = u_0 + b J y``. So for a baseline b [m] an
acceleration, of which a and W are, has the evidence::

    Z_b = b^6 |W|^1/2 |A|^-1/2 exp(q^T A^-1 q / 2 - u_0^T W u_0 / 2)
    A   = H + b^2 J^T W J,      q = g + b J^T W u_0

averaged over the speeds of a carrier. Z of the acceleration that was measured, by Z of one that is
only as large as that of a carrier, is a Bayes factor (Kass and Raftery, JASA 1995): above 1 where
the images show what was measured, 1 where they show nothing, below where they show another one.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from rs_relpose_ros.compiled import kernel
from rs_relpose_ros.estimator.image_information import ImageInformation, ROTATION
from rs_relpose_ros.estimator.information import inverse, log_determinant
from rs_relpose_ros.estimator.priors import VelocityPrior
from rs_relpose_ros.estimator.problem import TwoViewProblem
from rs_relpose_ros.estimator.velocities_expected import span_of_scales, velocities_expected
from rs_relpose_ros.geometry.so3 import log_so3
from rs_relpose_ros.geometry.vectors import tangent_basis

Array = NDArray[np.float64]

# Baselines over which the evidence is averaged.
_BASELINES = 14


class InertialEvidence(NamedTuple):
    """Logarithms of the Bayes factors of one pair, by its images.

    `told`: of the acceleration that was measured; `opposite`: of the opposite one, as of an
    accelerometer with the other sign.
    """

    told: float
    opposite: float


def inertial_evidence(problem: TwoViewProblem, images: ImageInformation, motion: str,
                      interval: float, measured: VelocityPrior) -> InertialEvidence | None:
    """What the images of a pair say of its acceleration; None where they say nothing.

    Parameters
    ----------
    problem : TwoViewProblem
        With the gyro's rotation; its matches take no part.
    images : ImageInformation
        Of the pose, which may rest on that acceleration or not.
    motion : str
        Of `MOTIONS`.
    interval : float
        Between the frames [s].
    measured : VelocityPrior
        By the acceleration (`velocities_expected`). The opposite one has the lever arm's part
        reversed, too, which is small.
    """
    if len(images.gradient) == ROTATION or problem.rotation is None \
            or problem.rotation_information is None:
        return None
    H, g = _without_rotation(images, problem.rotation, problem.rotation_information)
    unknown, _ = velocities_expected(problem, motion, interval, None)
    log_b = np.linspace(*span_of_scales(motion, interval), _BASELINES)
    told, opposite, nothing = (
        _log_evidence(H, g, images.t, images.velocities, prior, log_b)
        for prior in (measured, measured._replace(offset=-measured.offset), unknown))
    if not math.isfinite(told + opposite - nothing):
        return None
    return InertialEvidence(told - nothing, opposite - nothing)


def _without_rotation(images: ImageInformation, rotation: Array,
                      information: Array) -> tuple[Array, Array]:
    """Information (8, 8) and gradient (8,) of s and the velocities, the rotation by the gyro."""
    k, H, g = ROTATION, images.information.copy(), images.gradient.copy()
    turn = log_so3(np.ascontiguousarray(rotation @ images.R.T))
    H[:k, :k] += information
    g[:k] -= information @ turn
    gain = H[k:, :k] @ inverse(np.ascontiguousarray(H[:k, :k]))
    reduced = H[k:, k:] - gain @ H[:k, k:]
    return 0.5 * (reduced + reduced.T), g[k:] - gain @ g[:k]


@kernel
def _log_evidence(H: Array, g: Array, t: Array, velocities: Array, prior: VelocityPrior,
                  log_b: Array) -> float:
    """Log of Z for the acceleration of `prior`, averaged over ``log b`` (K,)."""
    basis, W = tangent_basis(t), prior.information
    J, away = np.zeros((6, 8)), np.empty(6)
    for i in range(6):
        J[i, 0], J[i, 1] = -prior.rate * basis[i % 3, 0], -prior.rate * basis[i % 3, 1]
        J[i, 2 + i] = 1.0
        away[i] = velocities[i] - prior.rate * t[i % 3]
    WJ = W @ J
    JWJ, of_prior = J.T @ WJ, 0.5 * log_determinant(W)
    values = np.empty(len(log_b))
    for k in range(len(log_b)):
        b = math.exp(log_b[k])
        u = b * away + prior.offset
        A, q = H + b * b * JWJ, g + b * (WJ.T @ u)
        values[k] = (6.0 * log_b[k] + of_prior - 0.5 * log_determinant(A)
                     + 0.5 * (q * (inverse(A) @ q)).sum() - 0.5 * (u * (W @ u)).sum())
    largest = values.max()
    return largest + math.log(np.exp(values - largest).mean())
