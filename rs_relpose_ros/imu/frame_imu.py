"""What the IMU says for one frame: motion during its read-out, and the turn since the last one."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from rs_relpose_ros.geometry.motion import FrameMotion
from rs_relpose_ros.geometry.timing import seconds_between
from rs_relpose_ros.imu.buffer import Coverage, ImuBuffer

Array = NDArray[np.float64]


@dataclass(frozen=True, slots=True, eq=False)
class GyroSegment:
    """Gyro samples between two instants, borders interpolated, bias removed, camera frame."""

    stamps_ns: NDArray[np.int64]   # (K,) the first and the last are the two instants
    angular_velocities: Array   # (K, 3) [rad/s]
    bias: Array   # (3,) [rad/s] that was removed; the mean where it changed meanwhile
    bias_sigma: float   # [rad/s] per axis

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
    """The IMU's share of a frame, all in the camera frame."""

    motion: FrameMotion   # relative to the stamped row
    gravity_sigma: float | None   # [rad] per axis of the direction; None where there is none
    reference_ns: int   # instant of the stamped row on the IMU clock
    # Since the previous frame's reference instant; None for the first frame or after a gap.
    since_previous: GyroSegment | None
    applied_offset_ns: int = 0   # tracked time offset in these instants, beyond the parameter's


def frame_imu(buffer: ImuBuffer, span_ns: tuple[int, int], reference_ns: int, R_cam_imu: Array,
              previous_reference_ns: int | None = None) -> FrameImu:
    """Collect from `buffer` what a frame needs; all instants are on the IMU clock.

    `span_ns` are those of the frame's earliest and latest row, which the buffer must cover,
    `reference_ns` and `previous_reference_ns` those of the stamped rows of this frame and of the
    one processed before. ``v_cam = R_cam_imu v_imu``.
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
        motion = replace(motion, gravity=turn @ (R_cam_imu @ estimate.direction))
        gravity_sigma = estimate.sigma
    since_previous = None
    if (previous_reference_ns is not None and previous_reference_ns < reference_ns
            and buffer.coverage(previous_reference_ns, reference_ns) is Coverage.AVAILABLE):
        stamps_ns, rates = buffer.angular_velocity(previous_reference_ns, reference_ns)
        bias = buffer.bias(reference_ns)
        since_previous = GyroSegment(stamps_ns, rates @ R_cam_imu.T, R_cam_imu @ bias.value,
                                     bias.sigma)
    return FrameImu(motion, gravity_sigma, reference_ns, since_previous)
