"""What is measured of a pair of frames: the input of `rs_relpose_ros.estimator.estimate`."""

from __future__ import annotations

from dataclasses import dataclass, replace
import math

import numpy as np

from rs_relpose_ros.config.settings import EstimatorConfig
from rs_relpose_ros.estimator.problem import build_problem, TwoViewProblem
from rs_relpose_ros.geometry import Array
from rs_relpose_ros.geometry.camera import RollingShutterCamera
from rs_relpose_ros.geometry.gyro import GyroPath
from rs_relpose_ros.geometry.matches import Matches
from rs_relpose_ros.geometry.motion import FrameMotion, InertialMotion


@dataclass(frozen=True, slots=True, eq=False)
class PairProblem:
    """Matches, motion and noise of V frames: a pair, and frames between the two.

    The frames are in the order of time: the first and the last one are the pair, V is 2 without
    frames between. Times, rotations and accelerations are from the first frame to each of them,
    from reference row to reference row, in camera 1. Nothing is checked here: users go through
    `rs_relpose_ros.estimator.arguments.estimate_relative_pose`.
    """

    matches: Matches  # N, in pixels of the sensor
    camera: RollingShutterCamera
    motions: tuple[FrameMotion, ...]  # V
    seconds: Array  # (V,); the last is NaN if it does not constrain the velocities
    rotations: Array  # (V, 3, 3) ``R_1^T R`` by the gyro; NaN where it is not known
    covariances: Array  # (V, 3, 3) of its error [rad^2], ``R_true = Exp(dtheta) R``
    inertial: tuple[InertialMotion | None, ...]  # V, by the accelerometer
    config: EstimatorConfig
    seed: int  # of the random samples
    no_inertial: str = ''  # why the accelerometer is not used; empty if nobody has asked for it
    # For the change of the pose by deviations of the configuration; None if it is not needed. The
    # gyro from the first frame to the last one, relative to the first reference row at time 0.
    gyro: GyroPath | None = None
    R_cam_imu: Array | None = None
    # [rad/s] 1 sigma per axis of each frame's own error of its rate, beyond that of `config`: a
    # gyro that is noisier than configured.
    rate_doubt: float = 0.0

    @property
    def interval(self) -> float | None:
        """Seconds between the two frames of the pair; None if not known."""
        last = float(self.seconds[-1])
        return None if math.isnan(last) else last

    @property
    def knows_rotation(self) -> bool:
        """Whether the gyro gives the rotation of the pair."""
        return bool(np.isfinite(self.rotations[-1]).all())

    def without_inertial(self, reason: str) -> PairProblem:
        """The same problem without the accelerometer, and why."""
        return replace(self, inertial=(None,) * len(self.motions), no_inertial=reason)

    def two_views(self, derotated: bool = True) -> TwoViewProblem:
        """The pair alone, at its middle rows; `derotated`: see `build_problem`."""
        known = self.knows_rotation
        return build_problem(
            self.matches.points1,
            self.matches.points2,
            self.camera,
            self.motions[0],
            self.motions[-1],
            self.rotations[-1] if known else None,
            self.covariances[-1] if known else None,
            derotated,
        )
