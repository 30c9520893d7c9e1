"""A keyframe pair as the graph takes it, from the front end or from ``~/pairs``."""

from __future__ import annotations

from dataclasses import dataclass, replace
import math
from typing import Any

import numpy as np
from numpy.typing import NDArray

from rs_relpose_ros.estimator.image_information import ImageInformation
from rs_relpose_ros.estimator.result import Status
from rs_relpose_ros.front_end.pair import PairResult
from rs_relpose_ros.health.findings import HealthState
from rs_relpose_ros.messages.incoming import stamp_ns
from rs_relpose_ros.messages.published_pair import pair_status

Array = NDArray[np.float64]


@dataclass(frozen=True, slots=True, eq=False)
class PairMeasurement:
    """What a pair says of two cameras, and when: of a front end, of the stamped rows."""

    stamp_ns: int   # of the current image, on the clock of the camera
    reference_ns: int   # of both images, on the IMU's clock
    current_ns: int
    frame_id: str
    status: str
    images: ImageInformation | None   # of the images alone; None where they say nothing
    baseline: float   # [m]; NaN where it is not known
    baseline_log_sigma: float
    gyro_bias: Array   # (3,) [rad/s] in force, IMU frame; NaN where it is not known
    told_wrong: bool   # what was told of camera or IMU, or the accelerometer

    @classmethod
    def of_result(cls, pair: PairResult) -> PairMeasurement:
        """Of a pair of the front end."""
        pose = pair.pose
        bias = np.full(3, math.nan) if pair.gyro_bias is None else pair.gyro_bias
        return cls(pair.stamp_ns, pair.reference_ns1,
                   pair.reference_ns2, pair.frame_id, pose.status.value, pose.images,
                   pose.baseline, pose.baseline_log_sigma, bias,
                   _stops(pair.health.state.value, pair.health.text))

    @classmethod
    def of_message(cls, pairs: Any) -> PairMeasurement:
        """Of a message on ``~/pairs``; InputError where it cannot be used."""
        status = pair_status(pairs)
        return cls(stamp_ns(pairs.header),
                   status.nanoseconds('reference_imu_ns'),
                   status.nanoseconds('current_imu_ns'),
                   str(pairs.status[0].hardware_id), status.text('status'), status.images(),
                   status.real('baseline_m'), status.real('baseline_log_sigma'),
                   status.vector('gyro_bias_rad_s'),
                   _stops(status.text('health'), status.text('health_findings')))

    def later(self, delay_ns: int) -> PairMeasurement:
        """The same, of rows that were read so much later."""
        return replace(self, stamp_ns=self.stamp_ns + delay_ns,
                       reference_ns=self.reference_ns + delay_ns,
                       current_ns=self.current_ns + delay_ns)

    @property
    def turned_only(self) -> bool:
        """Whether the images show no translation."""
        return self.status == Status.PURE_ROTATION.value

    @property
    def has_direction(self) -> bool:
        """Whether the images tell where the camera moved."""
        return self.images is not None and bool(np.isfinite(self.images.t).all())


def _stops(state: str, findings: str) -> bool:
    """Whether a path must not go on: a figure is wrong, or images contradict the accelerometer.

    Pairs go on without the accelerometer then; a path has nothing else to tell metres from.
    """
    return (state == HealthState.WRONG.value
            or f'accel_axes {HealthState.SUSPECT.value}:' in findings)
