"""Evidence of a report: residuals of matches over the image, images against gyro over time."""

from collections.abc import Sequence
from dataclasses import dataclass
import math
from typing import NamedTuple, Self

import numpy as np
from numpy.typing import NDArray

from rs_relpose_ros.calibration.residual_maps import signed_residuals
from rs_relpose_ros.geometry import Array
from rs_relpose_ros.geometry.timing import NANOSECONDS
from rs_relpose_ros.imu.integration import integral, interpolated
from rs_relpose_ros.pipeline.pair import PairResult

# Fewest matches of a cell of a map: fewer have a mean that is noise. [chosen: 5 to 30 would do]
_FEWEST = 8
# Largest offset of the clocks that is scanned [s]. A larger one is found by `calibrate`.
# [chosen: 0.05 to 0.2 s would do]
_LARGEST_OFFSET = 0.1
# Step of the scan [s]. A finer one only takes time, as the best is between two of them by a
# parabola. [chosen: 0.5 to 4 ms would do]
_OFFSET_STEP = 2e-3
# Length of the parts whose offset is shown over time [s]. Shorter ones hold too little rotation,
# longer ones hide a drift. [chosen: 5 to 20 s would do]
_PART = 8.0
# Fewest rotations of a part that determine an offset. Fewer correlate by chance.
# [chosen: 5 to 20 would do]
_FEWEST_ROTATIONS = 10
# Least rms rate of the images [rad/s] that does. Less is noise of the matches.
# [chosen: 0.05 to 0.2 rad/s would do]
_LEAST_RATE = 0.1


@dataclass(frozen=True, slots=True, eq=False)
class MatchResiduals:
    """Residuals of the N inliers of a pair."""

    stamp_ns: int  # of the current image
    points: Array  # (N, 2) pixels in the current image
    residuals: Array  # (N,) [px]
    rate: float  # of the camera at the current image [rad/s]

    @classmethod
    def of(cls, pair: PairResult, focal_length: float) -> Self:
        """The residuals of a pair with a pose; `focal_length` [px]."""
        inliers = pair.pose.inliers
        return cls(
            pair.stamp_ns,
            pair.matches.points2[inliers],
            epipolar_residuals(pair, focal_length)[inliers],
            float(np.linalg.norm(pair.pose.angular_velocity2)),
        )


def epipolar_residuals(pair: PairResult, focal_length: float) -> Array:
    """Distances (N,) [px] of the matches from the epipolar constraint of their rows.

    First order (Sampson), in pixels at the image centre.
    """
    return focal_length * np.abs(signed_residuals(pair.pose, pair.matches).values)


class Cells(NamedTuple):
    """A map of residuals: their rms [px] in cells, NaN where there are few."""

    x: Array  # (W + 1,) borders of the columns
    y: Array  # (H + 1,) borders of the rows
    rms: Array  # (H, W)


def map_of(x: Array, y: Array, residuals: Array, borders: tuple[Array, Array]) -> Cells:
    """The rms of residuals (N,) in cells of two coordinates (N,)."""
    bins = list(borders)
    counts, *_ = np.histogram2d(x, y, bins)
    squares, *_ = np.histogram2d(x, y, bins, weights=residuals**2)
    mean_squares = squares / np.maximum(counts, 1.0)
    rms = np.where(counts < _FEWEST, np.nan, np.sqrt(mean_squares))
    return Cells(*borders, rms.T)


class OffsetScan(NamedTuple):
    """Correlation of the rates of images and gyro over an offset of their clocks."""

    offsets: Array  # (M,) [s] beyond the configured one
    correlation: Array  # (M,) in [-1, 1]

    @property
    def best(self) -> float:
        """Offset of the largest correlation [s], by a parabola through the best three."""
        k = int(np.argmax(self.correlation))
        offset = self.offsets[k]
        if not 0 < k < len(self.offsets) - 1:
            return float(offset)
        before, at, after = self.correlation[k - 1 : k + 2]
        bend = before - 2.0 * at + after
        shift = 0.5 * (before - after) / bend if bend < 0.0 else 0.0
        step = self.offsets[1] - self.offsets[0]
        return float(offset + shift * step)


@dataclass(frozen=True, slots=True, eq=False)
class Rates:
    """Rates of the camera by images over N intervals, and the angle of the gyro to compare."""

    begins: Array  # (N,) [s]
    ends: Array  # (N,) [s]
    by_images: Array  # (N, 3) [rad/s], camera frame
    times: Array  # (K,) of the gyro [s]
    angles: Array  # (K, 3) integral of the gyro's rate, camera frame [rad]

    def by_gyro(self, offset: float = 0.0) -> Array:
        """Mean rates (N, 3) of the gyro over the intervals, moved by an offset [s]."""
        at_begins = interpolated(self.begins + offset, self.times, self.angles)
        at_ends = interpolated(self.ends + offset, self.times, self.angles)
        lengths = self.ends - self.begins
        return (at_ends - at_begins) / lengths[:, None]

    def part(self, begin: float, end: float) -> Self:
        """The intervals that end in a span [s]."""
        use = (self.ends >= begin) & (self.ends < end)
        return type(self)(
            self.begins[use], self.ends[use], self.by_images[use], self.times, self.angles
        )

    @property
    def determines_offset(self) -> bool:
        """Whether the camera turns enough to compare."""
        if len(self.ends) < _FEWEST_ROTATIONS:
            return False
        squares = (self.by_images**2).sum(axis=1)
        return math.sqrt(float(squares.mean())) > _LEAST_RATE

    def scan(self) -> OffsetScan:
        """Correlation over the offset of the changes from one rate to the next, all axes together.

        Images take a translation for a rotation. It changes slowly, and hardly enters the changes.
        """
        offsets = np.arange(-_LARGEST_OFFSET, _LARGEST_OFFSET + 1e-9, _OFFSET_STEP)
        images = np.diff(self.by_images, axis=0)
        values = np.zeros(len(offsets))
        for k, offset in enumerate(offsets):
            gyro = np.diff(self.by_gyro(offset), axis=0)
            power = float((images**2).sum() * (gyro**2).sum())
            if power > 0.0:
                values[k] = float((images * gyro).sum()) / math.sqrt(power)
        return OffsetScan(offsets, values)

    def drift(self) -> tuple[Array, Array]:
        """Middles of parts of the recording (P,) [s], and their best offsets (P,) [s]."""
        if not len(self.ends):
            return np.empty(0), np.empty(0)
        first = float(self.ends[0])
        last = float(self.ends[-1])
        last_begin = max(last - 0.5 * _PART, first)
        middles = []
        offsets = []
        for begin in np.arange(first, last_begin + 1e-9, _PART):
            part = self.part(begin, begin + _PART)
            if part.determines_offset:
                middles.append(min(begin + 0.5 * _PART, last))
                offsets.append(part.scan().best)
        return np.array(middles), np.array(offsets)


def rates_compared(
    stamps_ns: Sequence[int],
    intervals: Sequence[float],
    by_images: Array,
    gyro_ns: NDArray[np.int64],
    rates: Array,
) -> Rates:
    """Rates of rotations (N, 3) [rad] that end at the stamps of frames, on the gyro's clock.

    `rates` (K, 3) [rad/s] are those of the gyro in the frame of the camera. Times of the result
    begin with the first sample of the gyro.
    """
    origin_ns = int(gyro_ns[0]) if len(gyro_ns) else 0
    ends = (np.array(stamps_ns, dtype=np.int64) - origin_ns) / NANOSECONDS
    lengths = np.array(intervals, dtype=float)
    times = (np.asarray(gyro_ns, dtype=np.int64) - origin_ns) / NANOSECONDS
    angles = integral(times, rates)
    return Rates(ends - lengths, ends, by_images / lengths[:, None], times, angles)
