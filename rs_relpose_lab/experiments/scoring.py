"""Errors of a pose against the truth, in degrees and in the estimate's own sigmas."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass
import math

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

Array = NDArray[np.float64]

# Of a relative pose: three of the rotation, two of the direction of translation.
POSE_FREEDOM = 5


@dataclass(frozen=True, slots=True)
class PoseError:
    """Of one estimate: angles [deg], infinite where there is no pose.

    `nees`: normalised estimation error squared over rotation (3) and direction of translation (2);
        NaN where there is no covariance.
    """

    rotation: float
    translation: float
    nees: float = math.nan


NO_POSE = PoseError(math.inf, math.inf)


def pose_error(R: Array, t: Array, true_R: Array, true_t: Array, covariance: Array | None = None,
               ) -> PoseError:
    """Error of a pose ``X1 = R X2 + t``.

    `t` is a unit vector, `true_t` of any length but zero.
    `covariance` (6, 6): of ``(dt, dtheta)`` with ``t_true = t + dt`` (dt perpendicular to t) and
        ``R_true = Exp(dtheta) R``, both in camera 1.
    """
    error, basis = pose_difference(R, t, true_R, true_t)
    rotation = float(np.degrees(np.linalg.norm(error[2:])))
    translation = float(np.degrees(np.linalg.norm(error[:2])))
    if covariance is None:
        return PoseError(rotation, translation)
    return PoseError(rotation, translation,
                     normalised_square(error, basis.T @ covariance @ basis))


def pose_difference(R: Array, t: Array, true_R: Array, true_t: Array) -> tuple[Array, Array]:
    """Error (5,) [rad] of a pose, two of the direction of t and three of R, and its basis (6, 5).

    The basis leads from it to ``(dt, dtheta)``; arguments as of `pose_error`.
    """
    true_t = true_t / np.linalg.norm(true_t)
    turn = Rotation.from_matrix(true_R @ R.T).as_rotvec()
    away = true_t - (true_t @ t) * t
    sine = float(np.linalg.norm(away))
    angle = float(np.arctan2(sine, true_t @ t))
    # Along the great circle: the direction of t is no vector space once the error is large.
    shift = away * (angle / sine) if sine > 0.0 else away
    basis = np.zeros((6, POSE_FREEDOM))
    basis[:3, :2] = np.linalg.svd(t[None])[2][1:].T
    basis[3:, 2:] = np.eye(3)
    return basis.T @ np.concatenate([shift, turn]), basis


def normalised_square(error: Array, covariance: Array) -> float:
    """``e^T C^-1 e``: chi-square of as many degrees of freedom where the covariance is right."""
    return float(error @ np.linalg.solve(covariance, error))


@dataclass(frozen=True, slots=True)
class Quantiles:
    """Median and 90th percentile; of errors, infinite where too many poses are lost."""

    median: float
    p90: float

    @classmethod
    def of(cls, values: Iterable[float]) -> Quantiles:
        """Quantiles of values, infinite ones among them."""
        # Not interpolated: between a number and infinity there is nothing.
        median, p90 = np.quantile(list(values), [0.5, 0.9], method='higher')
        return cls(float(median), float(p90))

    def text(self, digits: int) -> str:
        """Such as ``0.023 / 0.041``."""
        return f'{self.median:.{digits}f} / {self.p90:.{digits}f}'
