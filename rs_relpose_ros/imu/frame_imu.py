"""What the IMU says for one frame: motion during its read-out, and since the last one."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from rs_relpose_ros.geometry.motion import FrameMotion
from rs_relpose_ros.geometry.timing import seconds_between
from rs_relpose_ros.imu.buffer import Coverage, ImuBuffer
from rs_relpose_ros.imu.forces import force_fault, ForceSegment, FrameForce

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
    force: FrameForce | str = 'there is no accelerometer'   # or why there is none


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
    return FrameImu(motion, gravity_sigma, reference_ns, since_previous,
                    force=_frame_force(buffer, span_ns, reference_ns, R_cam_imu, motion,
                                       previous_reference_ns))


def _frame_force(buffer: ImuBuffer, span_ns: tuple[int, int], reference_ns: int, R_cam_imu: Array,
                 motion: FrameMotion, previous_reference_ns: int | None) -> FrameForce | str:
    """The accelerometer's share of a frame, or why it has none."""
    first_ns = span_ns[0] if previous_reference_ns is None else previous_reference_ns
    fault = force_fault(buffer.recent_forces(span_ns[1]))
    if fault:
        return fault
    within = buffer.specific_force(*span_ns)
    before = buffer.specific_force(min(first_ns, reference_ns), reference_ns)
    gravity = buffer.gravity(span_ns[1])
    if within is None or before is None or gravity is None:
        return 'the accelerometer has a gap'
    stamps_ns, forces = within
    seconds = (stamps_ns - reference_ns) * 1e-9
    turned = np.einsum('kij,kj->ki', motion.rotations(seconds), forces @ R_cam_imu.T)
    steps = np.diff(seconds, append=seconds[-1]) + np.diff(seconds, prepend=seconds[0])
    mean = turned[0] if len(turned) == 1 else steps @ turned / steps.sum()
    return FrameForce(mean, gravity.length, gravity.length_sigma,
                      ForceSegment(before[0], before[1] @ R_cam_imu.T))
