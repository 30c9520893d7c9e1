"""Errors of relative poses against the ground truth of a camera."""

from collections.abc import Sequence
from dataclasses import dataclass
import math

import numpy as np
from numpy.typing import ArrayLike
from scipy.interpolate import CubicSpline
from scipy.spatial.transform import Rotation, Slerp

from rs_relpose_ros.errors import InputError
from rs_relpose_ros.geometry import Array
from rs_relpose_ros.geometry.timing import NANOSECONDS, to_nanoseconds

# Largest interval of two poses for an interpolation [ns]. Over a longer one the motion between the
# poses is unknown; a shorter one would leave pairs without errors. [chosen: poses of 10 Hz, one of
# which is lost]
_MAX_GAP_NS = to_nanoseconds(0.2)
# Fewest poses of a ground truth: fewer are no trajectory to compare with. [chosen: any value in
# 2..10 would do]
_MIN_POSES = 4
# Farthest position [m]: powers of larger ones overflow in the spline. [chosen: beyond the moon;
# any value from 1e8 to 1e50 would do]
_FARTHEST = 1e9


@dataclass(frozen=True, slots=True)
class PairErrors:
    """True motion of a pair and the errors of its estimate; unknown values are NaN."""

    baseline: float  # true distance of the two positions [m]
    rotation: float  # true angle [deg]
    rotation_error: float  # angle of R_estimated^T R_true [deg]
    translation_error: float  # angle between the directions of translation [deg], 0 to 180


class TrueTrajectory:
    """Camera poses in the world, interpolated: SLERP and a cubic spline of the position.

    Stamps (K,) on the IMU clock, positions (K, 3) [m], and rotations of the camera's optical
    frame in the world as quaternions (K, 4).
    """

    def __init__(self, stamps_ns: ArrayLike, positions: ArrayLike, quats_xyzw: ArrayLike) -> None:
        given_stamps = np.asarray(stamps_ns, dtype=np.int64)
        # Of poses with the same stamp the first one holds.
        stamps, order = np.unique(given_stamps, return_index=True)
        positions = np.asarray(positions, dtype=np.float64).reshape(-1, 3)[order]
        quats = np.asarray(quats_xyzw, dtype=np.float64).reshape(-1, 4)[order]
        if len(order) < _MIN_POSES:
            raise InputError(
                f'the ground truth has {len(order)} poses of distinct stamps; at '
                f'least {_MIN_POSES} are needed'
            )
        norms = np.linalg.norm(quats.clip(-2.0, 2.0), axis=1)  # squares of damaged ones overflow
        is_near = np.abs(positions) <= _FARTHEST  # False for NaN, as is_unit
        is_unit = np.abs(norms - 1.0) < 1e-2
        if not (is_near.all() and is_unit.all()):
            raise InputError(
                'the ground truth has a pose that is not finite or beyond the moon, or whose '
                'quaternion has not the length 1'
            )
        self._stamps = stamps
        seconds = self._seconds(self._stamps)
        self._position = CubicSpline(seconds, positions)
        self._rotation = Slerp(seconds, Rotation.from_quat(quats))

    def _seconds(self, at_ns: ArrayLike) -> Array:
        """Seconds since the first pose: absolute stamps do not fit into a float."""
        since_first_ns = np.asarray(at_ns, dtype=np.int64) - self._stamps[0]
        return np.asarray(since_first_ns / NANOSECONDS)

    def covers(self, at_ns: int) -> bool:
        """Whether there are poses close enough before and after a time."""
        stamps = self._stamps
        after = int(np.searchsorted(stamps, at_ns))
        if after == len(stamps):
            return False
        if stamps[after] == at_ns:
            return True
        return bool(after > 0 and stamps[after] - stamps[after - 1] <= _MAX_GAP_NS)

    def position(self, at_ns: int) -> Array:
        """Position (3,) [m] at a time that the poses cover."""
        return self.positions([at_ns])[0]

    def positions(self, at_ns: Sequence[int]) -> Array:
        """Positions (N, 3) [m] at times that the poses cover."""
        return np.asarray(self._position(self._seconds(at_ns)))

    def velocity(self, at_ns: int) -> Array:
        """Velocity (3,) [m/s] in the world at a time that the poses cover."""
        return self.velocities([at_ns])[0]

    def velocities(self, at_ns: Sequence[int]) -> Array:
        """Velocities (N, 3) [m/s] in the world at times that the poses cover."""
        return np.asarray(self._position(self._seconds(at_ns), 1))

    def rotation(self, at_ns: int) -> Array:
        """R (3, 3) from the camera to the world at a time that the poses cover."""
        return self.rotations([at_ns])[0]

    def rotations(self, at_ns: Sequence[int]) -> Array:
        """R (N, 3, 3) from the camera to the world at times that the poses cover."""
        return np.asarray(self._rotation(self._seconds(at_ns)).as_matrix())

    def relative_pose(self, ns1: int, ns2: int) -> tuple[Array, Array] | None:
        """R (3, 3) and t (3,) [m] with ``X1 = R X2 + t``; None outside of the ground truth."""
        if not (self.covers(ns1) and self.covers(ns2)):
            return None
        seconds = self._seconds([ns1, ns2])
        R1, R2 = self._rotation(seconds).as_matrix()
        p1, p2 = self._position(seconds)
        return R1.T @ R2, R1.T @ (p2 - p1)

    def errors(self, R: Array, t: Array, ns1: int, ns2: int) -> PairErrors | None:
        """Errors of an estimate, which may have NaN; None outside of the ground truth."""
        truth = self.relative_pose(ns1, ns2)
        if truth is None:
            return None
        R_true, t_true = truth
        between_directions = math.nan
        if t_true.any():
            # The arc cosine loses digits at small angles.
            sine = np.linalg.norm(np.cross(t, t_true))
            between_directions = math.degrees(np.arctan2(sine, t @ t_true))
        return PairErrors(
            baseline=float(np.linalg.norm(t_true)),
            rotation=rotation_angle(R_true),
            rotation_error=rotation_angle(R.T @ R_true),
            translation_error=between_directions,
        )


def rotation_angle(R: Array) -> float:
    """Angle of a rotation matrix [deg]; NaN for NaN."""
    if not np.isfinite(R).all():
        return math.nan
    return float(np.degrees(Rotation.from_matrix(R).magnitude()))


def median_and_p90(values: Sequence[float]) -> tuple[float, float]:
    """Median and 90th percentile of the finite values; NaN without any."""
    finite = np.asarray(values, dtype=np.float64)
    finite = finite[np.isfinite(finite)]
    if not len(finite):
        return math.nan, math.nan
    return float(np.median(finite)), float(np.percentile(finite, 90))
