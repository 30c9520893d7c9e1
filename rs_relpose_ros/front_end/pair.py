"""A keyframe pair, what came of it, and the table of figures that are published of it."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
import math
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from rs_relpose_ros.estimator.result import RelativePose
from rs_relpose_ros.front_end.drift import Drift
from rs_relpose_ros.geometry.so3 import log_so3
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
        Kept where the front end was asked to.
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

    @property
    def inlier_ratio(self) -> float:
        """Share of the matches that are inliers; 0 without matches."""
        inliers = np.count_nonzero(self.pose.inliers)
        return inliers / len(self.matches) if len(self.matches) else 0.0

    @property
    def gyro_difference(self) -> float:
        """Angle between the rotation by gyro and the estimated one [deg]; NaN without either."""
        if self.gyro_rotation is None or not np.isfinite(self.pose.R).all():
            return math.nan
        turn = log_so3(np.ascontiguousarray(self.pose.R.T @ self.gyro_rotation))
        return math.degrees(float(np.linalg.norm(turn)))


class PairFigure(NamedTuple):
    """A figure that is published of every pair.

    `name` ends with the unit: the key on /diagnostics, where it has `digits` after the point, and
    among the medians of summary.json. NaN is told as nothing.
    """

    name: str
    of: Callable[[PairResult], float]
    digits: int

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
