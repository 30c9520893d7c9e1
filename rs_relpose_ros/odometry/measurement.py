"""A keyframe pair as the graph takes it, from the front end or from the topics."""

from __future__ import annotations

from dataclasses import dataclass
import math

import numpy as np
from numpy.typing import NDArray

from rs_relpose_ros.estimator.image_information import ImageInformation
from rs_relpose_ros.estimator.result import Status
from rs_relpose_ros.front_end.pair import PairResult
from rs_relpose_ros.health.findings import HealthState
from rs_relpose_ros.messages.published_pair import PublishedPair

Array = NDArray[np.float64]


@dataclass(frozen=True, slots=True, eq=False)
class PairMeasurement:
    """What a pair says of two cameras; all instants are those of the stamped rows."""

    stamp_ns: int   # header stamp of the current image
    reference_ns: int   # on the IMU's clock, both
    current_ns: int
    frame_id: str
    status: str
    R: Array   # (3, 3) NaN where it is not known
    t: Array   # (3,) unit; NaN likewise
    images: ImageInformation | None   # of the images alone, about R, t
    metric_velocity: Array   # (3,) of the reference camera in its axes [m/s]; NaN likewise
    baseline_log_sigma: float   # of that scale
    gyro_bias: Array   # (3,) [rad/s] in force, IMU frame; NaN likewise
    told_wrong: bool   # what was told of camera or IMU

    @classmethod
    def of_result(cls, pair: PairResult) -> PairMeasurement:
        """Of a pair of the front end."""
        bias = np.full(3, math.nan) if pair.gyro_bias is None else pair.gyro_bias
        return cls(pair.stamp_ns, pair.reference_ns1, pair.reference_ns2, pair.frame_id,
                   pair.pose.status.value, pair.pose.R, pair.pose.t, pair.pose.images,
                   _metric(pair.pose.images, pair.pose.baseline), pair.pose.baseline_log_sigma,
                   bias, pair.health.state is HealthState.WRONG)

    @classmethod
    def of_published(cls, pair: PublishedPair) -> PairMeasurement:
        """Of a pair as the topics tell it."""
        return cls(pair.stamp_ns, pair.reference_imu_ns, pair.current_imu_ns, pair.frame_id,
                   pair.status, pair.R, pair.t, pair.images,
                   _metric(pair.images, pair.baseline), pair.baseline_log_sigma, pair.gyro_bias,
                   pair.health == HealthState.WRONG.value)

    @property
    def turned_only(self) -> bool:
        """Whether the images show no translation."""
        return self.status == Status.PURE_ROTATION.value


def _metric(images: ImageInformation | None, baseline: float) -> Array:
    return np.full(3, math.nan) if images is None else baseline * images.velocities[:3]
