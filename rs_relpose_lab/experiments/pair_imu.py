"""What an IMU says of a pair of frames: the paper's means, and the gyro that runs on."""

from __future__ import annotations

from bisect import bisect_left, bisect_right
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from rs_relpose_lab.experiments.methods import ContinuousGyro
from rs_relpose_ros.config.estimator import EstimatorConfig
from rs_relpose_ros.config.imu import ImuConfig
from rs_relpose_ros.errors import MissingInputError
from rs_relpose_ros.geometry.motion import FrameMotion
from rs_relpose_ros.geometry.timing import ImageClock, seconds_between, to_nanoseconds
from rs_relpose_ros.imu.buffer import Coverage, ImuBuffer
from rs_relpose_ros.imu.frame_imu import frame_imu
from rs_relpose_ros.imu.gravity import mean_gravity
from rs_relpose_ros.imu.samples import ImuSample

Array = NDArray[np.float64]


@dataclass(frozen=True, slots=True, eq=False)
class MeanMotion:
    """Motion of a frame by the paper's means, at its reference row; sigmas [rad], [rad/s]."""

    motion: FrameMotion
    gravity_sigma: float
    rate_sigma: float


class PairImu:
    """Samples of an IMU, asked about frames of a camera.

    `samples`: by stamp, IMU frame; `R_cam_imu`: ``v_cam = R_cam_imu v_imu``.
    `clock`: of the camera; `config`: holds the bias that is subtracted.
    """

    def __init__(self, samples: Sequence[ImuSample], R_cam_imu: Array, clock: ImageClock,
                 config: ImuConfig) -> None:
        self._samples = samples
        self._stamps = [sample.stamp_ns for sample in samples]
        self._R_cam_imu = R_cam_imu
        self._clock = clock
        self._config = config

    def mean(self, stamp_ns: int) -> MeanMotion:
        """The paper's motion of a frame."""
        start_ns, end_ns = self._clock.row_span_ns(stamp_ns)
        # The paper: 'an average of the inertial measurements within 0.1 s near the image frame'.
        # Here it is centred on the middle row.
        middle_ns, half_ns = (start_ns + end_ns) // 2, to_nanoseconds(0.05)
        window = self._samples[bisect_left(self._stamps, middle_ns - half_ns):
                               bisect_right(self._stamps, middle_ns + half_ns)]
        rates = [s.angular_velocity for s in window if s.angular_velocity is not None]
        forces = [s.linear_acceleration for s in window if s.linear_acceleration is not None]
        gravity = mean_gravity(np.array(forces))
        if not rates or gravity is None:
            raise self._uncovered(stamp_ns)
        rate = np.mean(rates, axis=0) - self._config.gyro_bias
        motion = FrameMotion(self._R_cam_imu @ rate, self._R_cam_imu @ gravity.direction)
        delay = seconds_between(middle_ns, self._clock.reference_ns(stamp_ns))
        # How far from their mean the rates of the window are, a row's rate is from it, too.
        spread = float(np.sqrt(np.var(rates, axis=0).mean()))
        return MeanMotion(motion.shifted(delay), gravity.sigma, spread)

    def continuous(self, stamp1_ns: int, stamp2_ns: int) -> ContinuousGyro:
        """All that the gyro says of two frames, as the node would ask for it."""
        buffer = ImuBuffer(self._config)
        # Noise may carry a match a few rows out of the image.
        edge_ns = to_nanoseconds(1e-3)
        spans = [(start_ns - edge_ns, end_ns + edge_ns) for start_ns, end_ns in
                 (self._clock.row_span_ns(stamp) for stamp in (stamp1_ns, stamp2_ns))]
        references = [self._clock.reference_ns(stamp) for stamp in (stamp1_ns, stamp2_ns)]
        # Gravity is filtered from 5 s before the first frame on.
        fed = bisect_left(self._stamps, spans[0][0] - to_nanoseconds(5.0))
        found = []
        for stamp_ns, span, reference_ns in zip((stamp1_ns, stamp2_ns), spans, references,
                                                strict=True):
            # Interpolation needs a sample after the last row.
            until = bisect_right(self._stamps, span[1] + to_nanoseconds(0.1))
            for sample in self._samples[fed:until]:
                buffer.add(sample)
            fed = until
            if buffer.coverage(*span) is not Coverage.AVAILABLE:
                raise self._uncovered(stamp_ns)
            found.append(frame_imu(buffer, span, reference_ns, self._R_cam_imu))
        if buffer.coverage(*references) is not Coverage.AVAILABLE:
            raise self._uncovered(stamp2_ns)
        rotation, covariance = buffer.rotation(*references)
        first, second = found
        sigmas = [frame.gravity_sigma for frame in found if frame.gravity_sigma is not None]
        return ContinuousGyro(
            first.motion, second.motion, self._R_cam_imu @ rotation @ self._R_cam_imu.T,
            self._R_cam_imu @ covariance @ self._R_cam_imu.T, seconds_between(*references),
            EstimatorConfig().gyro_sigma, max(sigmas, default=None))

    def _uncovered(self, stamp_ns: int) -> MissingInputError:
        return MissingInputError(
            f'the IMU does not cover the frame that is stamped {stamp_ns} ns: its samples reach '
            f'from {self._stamps[0]} to {self._stamps[-1]} ns' if self._stamps
            else 'there is no IMU sample')
