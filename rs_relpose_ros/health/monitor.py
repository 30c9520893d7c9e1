"""The health of what was told, followed over frames and pairs; live and replay alike."""

from __future__ import annotations

from collections import deque
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray
from scipy.linalg import solve_triangular

from rs_relpose_ros.estimator.inertial_evidence import InertialEvidence
from rs_relpose_ros.estimator.result import RelativePose, Status
from rs_relpose_ros.health.acceleration import AccelerationSums
from rs_relpose_ros.health.deviation import DEVIATIONS
from rs_relpose_ros.health.findings import Health, HealthState, NOT_JUDGED
from rs_relpose_ros.health.judge import Cause, causes, Effect, judged, Told, undetermined
from rs_relpose_ros.health.pair_information import PairEvidence, PairInformation
from rs_relpose_ros.health.recursion import NOTHING_SEEN, Recursion
from rs_relpose_ros.health.turning import TurnSums

Array = NDArray[np.float64]

# Latest pairs over which the effect of a deviation is taken.
_EFFECTS = 30
# Deviations about which a pair is linearised at most: lens and read-out must stay possible.
_LARGEST = np.array([0.5] * 3 + [0.06, 0.1] + [0.2] * 3 + [0.3, 0.45, 0.6])


class HealthMonitor:
    """Takes frames and pairs in the order of time; the same bits live and in replay."""

    def __init__(self) -> None:
        self._turns = TurnSums()
        self._recursion = Recursion()
        self._acceleration = AccelerationSums()
        self._on_poses: deque[Effect] = deque(maxlen=_EFFECTS)
        self._on_rotations: deque[Effect] = deque(maxlen=_EFFECTS)
        self.health: Health = NOT_JUDGED
        self.calibration = NOTHING_SEEN
        self._causes: list[Cause] = []
        self._told_wrong = False   # by the last pair
        self.latest: PairInformation | None = None   # of the last pair

    def clear(self) -> None:
        """Start anew: another camera."""
        self._turns.clear()
        self._recursion.clear()
        self._acceleration.clear()
        self._on_poses.clear()
        self._on_rotations.clear()
        self._causes, self._told_wrong = [], False
        self.health, self.calibration = NOT_JUDGED, NOTHING_SEEN

    def add_turn(self, stamp_ns: int, interval: float, by_images: Array, by_gyro: Array) -> None:
        """Take in the turns (3,) over some frames, `interval` [s], by images alone and by gyro."""
        self._turns.add(stamp_ns, interval, by_images, by_gyro)

    def believes(self, acceleration: InertialEvidence | None) -> bool:
        """Whether a pair of such evidence is to use the accelerometer; None: not known yet."""
        return self._acceleration.believes(acceleration)

    def add_acceleration(self, stamp_ns: int, evidence: InertialEvidence) -> None:
        """Take in what a pair says of the accelerometer, before the pair itself."""
        # Velocities of a pair that is told wrong say nothing of it.
        if not self._told_wrong:
            self._acceleration.add(stamp_ns, evidence)

    def add_pair(self, stamp_ns: int, evidence: PairEvidence | None, pose: RelativePose,
                 told: Told) -> RelativePose:
        """Take in a pair and judge all figures; the pose with a covariance that holds.

        `evidence` is None where the pair has no rotation or no gyro.
        """
        self.latest = None
        if evidence is not None:
            try:
                pose = self._take_in(stamp_ns, evidence, pose, told)
            except np.linalg.LinAlgError:
                # A pair without rank says nothing of the calibration; its pose stays as it is.
                self._causes = []
        self.health = judged(self.calibration, self._causes, self._turns.compared(), told)
        self._told_wrong = bool(self.health.faults)
        if self._told_wrong:
            self._acceleration.clear()
        if (finding := self._acceleration.finding()) is not None:
            self.health = Health((*self.health.findings, finding))
        return pose

    def _take_in(self, stamp_ns: int, evidence: PairEvidence, pose: RelativePose,
                 told: Told) -> RelativePose:
        information = self._recursion.add(
            stamp_ns, evidence, told.in_force, self._linearised_at(told))
        if information is None:
            return pose
        self.latest = information
        self.calibration = self._recursion.solved()
        if pose:
            self._on_poses.append(_on_pose(information, pose))
        else:
            self._on_rotations.append(_on_rotation(information, pose))
        # A figure may be so far off that no pair has a pose.
        self._causes = causes(self.calibration, self._on_poses or self._on_rotations,
                              told.in_force)
        by_deviation = information.pose_by_deviation
        shift = by_deviation @ self._deviation()
        # What is off, and what the pairs so far have not yet shown to be as told.
        doubt = np.outer(shift, shift) + (
            by_deviation @ undetermined(self.calibration, told.in_force) @ by_deviation.T)
        pose = replace(pose, covariance=pose.covariance + doubt)
        # What a figure that is off does to the baseline is not known.
        return pose.without_baseline('baseline not known: a figure that was told is suspect '
                                     '(see health)') if shift.any() and pose else pose

    def _deviation(self) -> Array:
        """(11,) from what is in force, of all causes."""
        return np.sum([cause.deviation for cause in self._causes], axis=0) \
            if self._causes else np.zeros(DEVIATIONS)

    def _linearised_at(self, told: Told) -> Array:
        """What is in force, or, once a figure is found off, what is seen.

        Whether it matters is told there: where poses are off already, a little more or less may
        move them hardly at all.
        """
        if not self._causes:
            return told.in_force
        return np.asarray(told.in_force + np.clip(self._deviation(), -_LARGEST, _LARGEST))


def withheld(pose: RelativePose, health: Health) -> RelativePose:
    """The pose without its figures, and why, where these are outside of their covariance."""
    if health.state is not HealthState.WRONG or not np.isfinite(pose.R).all():
        return pose
    return RelativePose(
        status=Status.WITHHELD, reason=health.faults[0].text,
        inliers=pose.inliers, model=pose.model, iterations=pose.iterations,
        residual_rms=pose.residual_rms, duration=pose.duration)


def _on_pose(information: PairInformation, pose: RelativePose) -> Effect:
    # t is a direction: along itself it has no variance, and nothing moves it there.
    along = np.concatenate([pose.t, np.zeros(3)])
    claimed = np.linalg.cholesky(pose.covariance + np.outer(along, along))
    return Effect(information.shift_by_deviation, solve_triangular(
        claimed, information.pose_by_deviation, lower=True))


def _on_rotation(information: PairInformation, pose: RelativePose) -> Effect:
    claimed = np.linalg.cholesky(pose.covariance[3:, 3:])
    return Effect(information.shift_by_deviation[:3], solve_triangular(
        claimed, information.pose_by_deviation[3:], lower=True))
