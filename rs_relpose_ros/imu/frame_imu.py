"""What the IMU says for one frame: motion during its read-out, and the turn since the last one."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from rs_relpose_ros.geometry.motion import FrameMotion
from rs_relpose_ros.geometry.timing import seconds_between
from rs_relpose_ros.imu.buffer import Coverage, ImuBuffer

Array = NDArray[np.float64]


@dataclass(frozen=True, slots=True, eq=False)
class GyroSegment:
    """Gyro samples between two instants, borders interpolated, bias removed, camera frame.

    Attributes
    ----------
    stamps_ns : (K,) ndarray of int64
        The first and the last are the two instants themselves.
    angular_velocities : (K, 3) ndarray
        Rates [rad/s] in the camera frame.
    bias : (3,) ndarray
        What was removed [rad/s], in the camera frame; the mean where it changed meanwhile.
    bias_sigma : float
        Its uncertainty per axis [rad/s].
    """

    stamps_ns: NDArray[np.int64]
    angular_velocities: Array
    bias: Array
    bias_sigma: float

    @property
    def duration(self) -> float:
        """Seconds from the first to the last instant."""
        return seconds_between(int(self.stamps_ns[0]), int(self.stamps_ns[-1]))

    def joined(self, later: GyroSegment) -> GyroSegment:
        """This segment and the one that starts where it ends."""
        share = later.duration / (self.duration + later.duration)
        return GyroSegment(
            np.concatenate([self.stamps_ns, later.stamps_ns[1:]]),
            np.concatenate([self.angular_velocities, later.angular_velocities[1:]]),
            self.bias + share * (later.bias - self.bias), max(self.bias_sigma, later.bias_sigma))


@dataclass(frozen=True, slots=True, eq=False)
class FrameImu:
    """The IMU's share of a frame, all in the camera frame.

    Attributes
    ----------
    motion : FrameMotion
        Reference: the stamped row.
    gravity_sigma : float or None
        1 sigma per axis of the gravity direction [rad]; None where there is no gravity.
    reference_ns : int
        Instant of the stamped row on the IMU clock.
    since_previous : GyroSegment or None
        From the previous frame's reference instant to this one's; None for the first frame or
        where the gyro has a gap.
    applied_offset_ns : int
        Tracked time offset that these instants hold beyond the parameter's.
    """

    motion: FrameMotion
    gravity_sigma: float | None
    reference_ns: int
    since_previous: GyroSegment | None
    applied_offset_ns: int = 0


def frame_imu(buffer: ImuBuffer, span_ns: tuple[int, int], reference_ns: int, R_cam_imu: Array,
              previous_reference_ns: int | None = None) -> FrameImu:
    """Collect from `buffer` what a frame needs.

    Parameters
    ----------
    buffer : ImuBuffer
        Must answer AVAILABLE for `span_ns`.
    span_ns : (int, int)
        Instants of the frame's earliest and latest row on the IMU clock.
    reference_ns : int
        Instant of its stamped row, within `span_ns`.
    R_cam_imu : (3, 3) ndarray
        ``v_cam = R_cam_imu v_imu``.
    previous_reference_ns : int, optional
        Reference instant of the frame processed before.
    """
    start_ns, end_ns = span_ns
    stamps_ns, rates = buffer.angular_velocity(start_ns, end_ns)
    rates = rates @ R_cam_imu.T
    if end_ns > start_ns:
        motion = FrameMotion.from_gyro((stamps_ns - reference_ns) * 1e-9, rates)
    else:
        motion = FrameMotion(rates[0])
    gravity_sigma = None
    # Causal up to the last row, then carried back to the stamped row.
    estimate = buffer.gravity(end_ns)
    if estimate is not None:
        turn = motion.rotations([(end_ns - reference_ns) * 1e-9])[0]
        gravity = turn @ (R_cam_imu @ estimate.direction)
        motion = FrameMotion(motion.angular_velocity, gravity, motion.knot_times,
                             motion.knot_rotations)
        gravity_sigma = estimate.sigma
    since_previous = None
    if (previous_reference_ns is not None and previous_reference_ns < reference_ns
            and buffer.coverage(previous_reference_ns, reference_ns) is Coverage.AVAILABLE):
        stamps_ns, rates = buffer.angular_velocity(previous_reference_ns, reference_ns)
        bias = buffer.bias(reference_ns)
        since_previous = GyroSegment(stamps_ns, rates @ R_cam_imu.T, R_cam_imu @ bias.value,
                                     bias.sigma)
    return FrameImu(motion, gravity_sigma, reference_ns, since_previous)
