"""A keyframe pair and what came of it."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from rs_relpose_ros.estimator.result import RelativePose
from rs_relpose_ros.front_end.drift import Drift
from rs_relpose_ros.tracking.matches import Matches

Array = NDArray[np.float64]


@dataclass(frozen=True, slots=True, eq=False)
class PairResult:
    """Estimate of one keyframe pair with the matches that it was made from.

    Attributes
    ----------
    reference_stamp_ns, stamp_ns : int
        Header stamps of the reference keyframe and of the current image.
    reference_ns1, reference_ns2 : int
        Instants of the two stamped rows on the IMU clock.
    frame_id : str
        Of the current image.
    interval : float
        Seconds between the two reference instants.
    pose : RelativePose
        ``pose.inliers`` is a mask over `matches`.
    matches : Matches
        Pixels of the published images.
    row_times1, row_times2 : (N,) ndarray
        Row times [s] of the matches against the stamped row.
    rays1, rays2 : (N, 3) ndarray
        Unit rays, turned by the gyro to the stamped row.
    parallax : float
        Median parallax after derotation [px].
    gyro_rotation : (3, 3) ndarray or None
        ``R_1^T R_2`` integrated from the gyro.
    drift : Drift or None
        Gyro bias and time offset as tracked up to this pair.
    image1, image2 : (H, W) ndarray of uint8 or None
        Kept where the pipeline was asked to.
    """

    reference_stamp_ns: int
    stamp_ns: int
    reference_ns1: int
    reference_ns2: int
    frame_id: str
    interval: float
    pose: RelativePose
    matches: Matches
    row_times1: Array
    row_times2: Array
    rays1: Array
    rays2: Array
    parallax: float
    gyro_rotation: Array | None = None
    drift: Drift | None = None
    image1: NDArray[np.uint8] | None = None
    image2: NDArray[np.uint8] | None = None
