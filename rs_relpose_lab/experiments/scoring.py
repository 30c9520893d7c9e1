"""Errors of a pose against the truth, in degrees and in the estimate's own sigmas."""

from collections.abc import Iterable
from dataclasses import dataclass
import math
from typing import NamedTuple, Self

import numpy as np
from scipy.spatial.transform import Rotation

from rs_relpose_ros.geometry import Array

# Of a relative pose: three of the rotation, two of the direction of translation.
POSE_FREEDOM = 5


@dataclass(frozen=True, slots=True)
class PoseError:
    """Of one estimate: angles [deg], infinite where there is no pose."""

    rotation: float
    translation: float
    # Over rotation (3) and direction of translation (2); NaN without covariance.
    nees: float = math.nan


# Errors where there is no pose.
NO_POSE = PoseError(math.inf, math.inf)


def pose_error(
    R: Array,
    t: Array,
    true_R: Array,
    true_t: Array,
    covariance: Array | None = None,
) -> PoseError:
    """Error of a pose ``X1 = R X2 + t``.

    `t` is a unit vector, `true_t` of any length but zero.
    `covariance` (6, 6): of ``(dt, dtheta)`` with ``t_true = t + dt`` (dt perpendicular to t) and
        ``R_true = Exp(dtheta) R``, both in camera 1.
    """
    rotation_error, shift = _rotation_and_shift(R, t, true_R, true_t)
    rotation = float(np.degrees(np.linalg.norm(rotation_error)))
    translation = float(np.degrees(np.linalg.norm(shift)))
    if covariance is None:
        return PoseError(rotation, translation)
    basis = np.zeros((6, POSE_FREEDOM))
    basis[:3, :2] = _tangent(t)
    basis[3:, 2:] = np.eye(3)
    error = basis.T @ np.concatenate([shift, rotation_error])
    nees = error @ np.linalg.solve(basis.T @ covariance @ basis, error)
    return PoseError(rotation, translation, float(nees))


class ChiSquares(NamedTuple):
    """Squared errors in sigmas: of the direction of translation (2), of the rotation (3)."""

    translation: float
    rotation: float


def chi_squares(R: Array, t: Array, true_R: Array, true_t: Array, covariance: Array) -> ChiSquares:
    """Each error of a pose by its own part of the covariance; arguments as in `pose_error`."""
    rotation_error, shift = _rotation_and_shift(R, t, true_R, true_t)
    tangent = _tangent(t)
    across = tangent.T @ shift
    return ChiSquares(
        float(across @ np.linalg.solve(tangent.T @ covariance[:3, :3] @ tangent, across)),
        float(rotation_error @ np.linalg.solve(covariance[3:, 3:], rotation_error)),
    )


def _rotation_and_shift(R: Array, t: Array, true_R: Array, true_t: Array) -> tuple[Array, Array]:
    """Errors dtheta (3,) and dt (3,) of a pose [rad], dt along the great circle to the truth.

    For large errors the directions of t are no vector space.
    """
    true_t = true_t / np.linalg.norm(true_t)
    away = true_t - (true_t @ t) * t
    sine = float(np.linalg.norm(away))
    angle = float(np.arctan2(sine, true_t @ t))
    direction = away / sine if sine > 0.0 else _tangent(t)[:, 0]
    return Rotation.from_matrix(true_R @ R.T).as_rotvec(), angle * direction


def _tangent(t: Array) -> Array:
    """Two directions (3, 2) across t."""
    return np.asarray(np.linalg.svd(t[None])[2][1:].T)


@dataclass(frozen=True, slots=True)
class Quantiles:
    """Median and 90th percentile; of errors, infinite where too many poses are lost."""

    median: float
    p90: float

    @classmethod
    def of(cls, values: Iterable[float]) -> Self:
        """Quantiles of values, infinite ones among them."""
        # Not interpolated: not defined between a number and infinity.
        median, p90 = np.quantile(list(values), [0.5, 0.9], method='higher')
        return cls(float(median), float(p90))

    def text(self, digits: int) -> str:
        """Such as ``0.023 / 0.041``."""
        return f'{self.median:.{digits}f} / {self.p90:.{digits}f}'
