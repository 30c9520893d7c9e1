"""The figures of a pair that are kept and written, without its matches and images."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from rs_relpose_ros.estimator.result import Status
from rs_relpose_ros.front_end.pair import PairResult
from rs_relpose_ros.replay.truth import PairErrors, rotation_angle, TrueTrajectory

Array = NDArray[np.float64]


@dataclass(frozen=True, slots=True, eq=False)
class PairRecord:
    """What is kept of a pair; as in `PairResult` and `RelativePose`.

    Attributes
    ----------
    reference_ns1, reference_ns2 : int
        Instants of the two stamped rows on the IMU clock.
    gyro_difference : float
        Angle between the estimated rotation and the integrated gyro [deg]; NaN without either.
    errors : PairErrors or None
        Against the truth; None without it.
    """

    reference_stamp_ns: int
    stamp_ns: int
    reference_ns1: int
    reference_ns2: int
    interval: float
    status: Status
    reason: str
    model: str
    R: Array
    t: Array
    covariance: Array
    gyro_rotation: Array | None
    gyro_difference: float
    matches: int
    inliers: int
    parallax: float
    residual_rms: float
    iterations: int
    duration: float
    errors: PairErrors | None


def pair_record(result: PairResult, truth: TrueTrajectory | None = None) -> PairRecord:
    """Figures of a pair, and its errors where there is a truth."""
    pose = result.pose
    difference = float('nan')
    if result.gyro_rotation is not None:
        difference = rotation_angle(pose.R.T @ result.gyro_rotation)
    errors = None
    if truth is not None:
        errors = truth.errors(pose.R, pose.t, result.reference_ns1, result.reference_ns2)
    return PairRecord(
        reference_stamp_ns=result.reference_stamp_ns, stamp_ns=result.stamp_ns,
        reference_ns1=result.reference_ns1, reference_ns2=result.reference_ns2,
        interval=result.interval,
        status=pose.status, reason=pose.reason, model=pose.model, R=pose.R, t=pose.t,
        covariance=pose.covariance, gyro_rotation=result.gyro_rotation,
        gyro_difference=difference, matches=len(result.matches.points1),
        inliers=int(np.count_nonzero(pose.inliers)), parallax=result.parallax,
        residual_rms=pose.residual_rms, iterations=pose.iterations, duration=pose.duration,
        errors=errors)


def translation_sigmas(covariance: Array) -> tuple[float, float]:
    """1 sigma of the translation direction [rad], larger and smaller axis.

    The covariance (6, 6) of (dt, dtheta) has no variance along t, so two of three axes remain.
    """
    variances = np.linalg.eigvalsh(covariance[:3, :3])
    larger, smaller = np.sqrt(np.maximum(variances[[2, 1]], 0.0))
    return float(larger), float(smaller)


def rotation_sigmas(covariance: Array) -> tuple[float, float, float]:
    """1 sigma of the rotation about the axes x, y, z of camera 1 [rad]."""
    x, y, z = np.sqrt(np.maximum(np.diag(covariance)[3:], 0.0))
    return float(x), float(y), float(z)
