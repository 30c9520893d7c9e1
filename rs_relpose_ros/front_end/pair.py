"""Keyframe pairs: which frames close one, what came of it, and the figures that are published."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
import math
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from rs_relpose_ros.config.keyframes import KeyframeConfig
from rs_relpose_ros.estimator.landmarks import Landmarks
from rs_relpose_ros.estimator.result import RelativePose
from rs_relpose_ros.health.findings import Health, NOT_JUDGED
from rs_relpose_ros.health.tracked import Applied, NOTHING_APPLIED, Tracked
from rs_relpose_ros.tracking.matches import Matches

Array = NDArray[np.float64]


class SinceKeyframe(NamedTuple):
    """What has happened since the reference keyframe."""

    parallax: float   # [px] median of the matches after derotation
    interval: float   # [s]
    frames: int   # 1 for the first frame after the keyframe
    tracked_fraction: float   # share of the keyframe's features that are still tracked


def closes_pair(since: SinceKeyframe, config: KeyframeConfig) -> bool:
    """Whether the current frame closes a pair: the camera moved far enough, or it is high time."""
    return (since.parallax >= config.min_keyframe_parallax
            or since.tracked_fraction < config.min_tracked_fraction
            or since.interval >= config.max_keyframe_interval
            or since.frames >= config.max_keyframe_frames)


@dataclass(frozen=True, slots=True, eq=False)
class PairResult:
    """Estimate of one keyframe pair with the matches that it was made from."""

    # Of the reference keyframe's and the current image's pose rows, on the camera's clock: their
    # header stamps, or those of their middle rows (`pose_row`).
    reference_stamp_ns: int
    stamp_ns: int
    reference_ns1: int   # the same instants on the IMU clock
    reference_ns2: int
    frame_id: str   # of the current image
    interval: float   # [s] between the two reference instants
    pose: RelativePose   # its inliers are a mask over `matches`
    matches: Matches   # pixels of the published images
    row_times1: Array   # (N,) [s] from the stamped row
    row_times2: Array
    rays1: Array   # (N, 3) unit, turned by the gyro to the stamped row
    rays2: Array
    parallax: float   # [px] median after derotation
    landmarks: Landmarks | None = None   # of the matches; None without a pose
    gyro_rotation: Array | None = None   # (3, 3) R_1^T R_2 integrated from the gyro
    # (3,) [rad] rotation by the images alone against the gyro's; None without either
    images_against_gyro: Array | None = None
    health: Health = NOT_JUDGED   # of what was told, all three as after this pair
    tracked: Tracked | None = None
    applied: Applied = NOTHING_APPLIED
    gyro_bias: Array | None = None   # (3,) [rad/s] that was removed for it, IMU frame
    image1: NDArray[np.uint8] | None = None   # both only where the front end keeps images
    image2: NDArray[np.uint8] | None = None

    @property
    def inlier_ratio(self) -> float:
        """Share of the matches that are inliers; 0 without matches."""
        inliers = np.count_nonzero(self.pose.inliers)
        return inliers / len(self.matches) if len(self.matches) else 0.0

    @property
    def gyro_difference(self) -> float:
        """Angle between the rotations by gyro and by images alone [deg]; NaN without either."""
        if self.images_against_gyro is None:
            return math.nan
        return math.degrees(float(np.linalg.norm(self.images_against_gyro)))


class PairFigure(NamedTuple):
    """A figure that is published of every pair; NaN is shown as an empty text."""

    name: str   # with the unit; the key on /diagnostics and among the medians of summary.json
    of: Callable[[PairResult], float]
    digits: int   # after the point, on /diagnostics

    def text(self, pair: PairResult | None) -> str:
        """As /diagnostics shows it."""
        value = math.nan if pair is None else self.of(pair)
        return '' if math.isnan(value) else f'{value:.{self.digits}f}'


# Whatever publishes or writes figures of pairs takes them from here.
PAIR_FIGURES = (
    PairFigure('matches', lambda pair: len(pair.matches), 0),
    PairFigure('inliers', lambda pair: int(np.count_nonzero(pair.pose.inliers)), 0),
    PairFigure('inlier_ratio', lambda pair: pair.inlier_ratio, 3),
    PairFigure('parallax_px', lambda pair: pair.parallax, 1),
    PairFigure('residual_rms_px', lambda pair: pair.pose.residual_rms, 2),
    PairFigure('interval_s', lambda pair: pair.interval, 3),
    PairFigure('rotation_difference_to_gyro_deg', lambda pair: pair.gyro_difference, 3),
)
