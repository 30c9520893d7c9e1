"""Time: integer nanoseconds everywhere, and the time of a row on the IMU's clock.

    t_imu(row v) = stamp + time_offset + k (T - T_ref) + exposure_shift + (v - v_stamp) line_delay

as in docs/time_and_frames.md, "Rows and the IMU's clock". T is the interval between frames
(`FrameIntervals`), and k is the parameter ``time_offset_per_interval``.
"""

from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from rs_relpose_ros.geometry import Array, validate
from rs_relpose_ros.geometry.camera import Intrinsics, RollingShutterCamera
from rs_relpose_ros.geometry.motion import FrameMotion

Stamps = NDArray[np.int64]  # [ns]

# Nanoseconds in a second. [derived: definition]
NANOSECONDS = 1_000_000_000
# Stamps of ROS end here [ns]: their seconds are an int32. [derived: builtin_interfaces/Time]
END_OF_STAMPS_NS = 2**31 * NANOSECONDS

# Share of the exposure of the stamped row from the time that the stamp marks to the middle of this
# exposure. [derived: definition of the parameter stamp_exposure]
_TO_MIDDLE = {'start': 0.5, 'middle': 0.0, 'end': -0.5}
# Names of what a stamp may mark. [derived: definition of the parameter stamp_exposure]
STAMP_EXPOSURES = tuple(_TO_MIDDLE)

# Difference of stamps [s] that no delay of a message explains: below it, two clocks count as one.
# A smaller value would report slow transport as another clock, a larger value would wait for data
# of a clock that is seconds off. [chosen: any value in 0.5..5 would do]
_APART = 1.0

# A step between images has an image missing if it is longer than so many median steps. Near 1,
# jitter would count as a loss; from 2 on, one lost image would not. [chosen: any value in 1.5..1.9
# would do]
MISSING = 1.8


def seconds_between(start_ns: int, end_ns: int) -> float:
    """Float seconds from `start_ns` to `end_ns`; the integers are subtracted before conversion."""
    return (end_ns - start_ns) / NANOSECONDS


def to_nanoseconds(seconds: float) -> int:
    """Nearest integer nanoseconds of a duration in seconds."""
    return round(seconds * NANOSECONDS)


def clocks_apart(ahead: float) -> str:
    """Message on stamps of the IMU that are `ahead` [s] of the images'; '' for one clock."""
    if abs(ahead) < _APART:
        return ''
    side = 'ahead of' if ahead > 0.0 else 'behind'
    return f"the clock of the IMU is {abs(ahead):.1f} s {side} the images'"


def correlation_of_steps(steps: Array) -> float:
    """Correlation of successive steps between images that have no image missing between them.

    `steps` (N,) are shares of their median. The correlation is about 1 if the exposure changes. It
    is -0.5 if stamps jitter, because a late stamp makes one step longer and the next one shorter.
    """
    whole = (steps > 0.0) & (steps < MISSING)
    if not whole.any():
        return 0.0
    # The few odd steps after the start of a camera must not decide.
    low, high = np.quantile(steps[whole], (0.05, 0.95))
    clipped = np.clip(steps, low, high)
    deviations = clipped - clipped[whole].mean()
    both = whole[1:] & whole[:-1]
    first = deviations[:-1][both]
    second = deviations[1:][both]
    squares = float(first @ first + second @ second)
    variance = max(0.5 * squares, 1e-24)
    return float(first @ second) / variance


def exposure_shift(stamp_exposure: str, exposure_time: float) -> float:
    """Time from the stamp to the middle of the stamped row's exposure [s]."""
    return _TO_MIDDLE[stamp_exposure] * exposure_time


@dataclass(frozen=True, slots=True)
class ImageClock:
    """Times of an image's rows on the IMU clock."""

    camera: RollingShutterCamera  # its reference row is the row that the driver stamps
    time_offset: float = 0.0  # IMU clock minus camera clock [s]
    stamp_exposure: str = 'middle'  # the time of the row's exposure that the stamp marks
    exposure_time: float = 0.0  # exposure of one row [s]
    offset_per_interval: float = 0.0  # k [s/s]
    reference_interval: float = 0.0  # T_ref [s]
    exposure_margin: float = 0.0  # if not 0, the exposure is T less this [s]

    def __post_init__(self) -> None:
        validate.choice('stamp_exposure', self.stamp_exposure, STAMP_EXPOSURES)
        validate.number('exposure_time', self.exposure_time, 0.0, unit='s')

    def reference_ns(self, stamp_ns: int, interval_ns: int | None = None) -> int:
        """Time of the reference row's mid-exposure [ns].

        `interval_ns` is T of the frame, and None if it is not known: T_ref is used then.
        """
        exposure = self.exposure(interval_ns)
        offset = self.time_offset + exposure_shift(self.stamp_exposure, exposure)
        if interval_ns is not None:
            longer = interval_ns / NANOSECONDS - self.reference_interval
            offset += self.offset_per_interval * longer
        return stamp_ns + to_nanoseconds(offset)

    def exposure(self, interval_ns: int | None = None) -> float:
        """Exposure of a row [s] of a frame with the interval T, or T_ref if T is not known."""
        if not self.exposure_margin:
            return self.exposure_time
        interval = self.reference_interval if interval_ns is None else interval_ns / NANOSECONDS
        return max(interval - self.exposure_margin, 0.0)

    def exposed_span_ns(self, stamp_ns: int, interval_ns: int | None = None) -> tuple[int, int]:
        """Times [ns]: begin of the first row's exposure, and end of the last row's exposure."""
        reference = self.reference_ns(stamp_ns, interval_ns)
        earliest, latest = self.camera.row_time_span
        half = to_nanoseconds(0.5 * self.exposure(interval_ns))
        begin = reference + to_nanoseconds(earliest) - half
        return begin, reference + to_nanoseconds(latest) + half


class Sensor(NamedTuple):
    """Camera model of the full sensor, place of the published image on it, and its clock.

    `config.settings.sensor_model` builds it for a parameter set.
    """

    camera: RollingShutterCamera  # its reference row is the row that poses relate
    intrinsics: Intrinsics
    clock: ImageClock
    pose_row_delay: float = 0.0  # time from the stamped row to the row of the poses [s]

    def derotated(self, points: Array, motion: FrameMotion) -> tuple[Array, Array]:
        """Rays (N, 3) of pixels (N, 2) of a published image, and their row times (N,) [s]."""
        pixels = self.intrinsics.to_sensor(points)
        row_times = self.camera.pixel_times(pixels)
        return motion.derotate(self.camera.unproject(pixels), row_times), row_times

    def project(self, rays: Array, row_times: Array, motion: FrameMotion) -> Array:
        """Pixels (N, 2) of a published image where rays (N, 3) are observed; NaN outside of it.

        This is the inverse of `derotated`. The row of a ray depends on its pixel, so `row_times`
        (N,) are a first guess that is improved twice.
        """
        camera = self.camera
        first, last = camera.row_time_span
        for _ in range(2):
            rotations = motion.rotations(np.clip(row_times, first, last))
            pixels = camera.project(np.einsum('nji,nj->ni', rotations, rays))
            improved = camera.pixel_times(pixels)
            row_times = np.where(np.isfinite(improved), improved, row_times)
        return self.intrinsics.to_image(pixels)


class FrameIntervals:
    """Interval T of each frame to the frame before it; stamps that do not increase are ignored.

    If frames are missing in between, so that the difference of the stamps exceeds 1.5 T, T stays.
    Two such differences in a row that agree to a tenth are a new frame rate.
    """

    def __init__(self) -> None:
        self._stamp_ns: int | None = None
        self._difference_ns = 0
        self._interval_ns: int | None = None

    def add(self, stamp_ns: int) -> int | None:
        """Interval T of the frame with this stamp [ns]; None for the first frame."""
        if self._stamp_ns is None:
            self._stamp_ns = stamp_ns
            return None
        difference = stamp_ns - self._stamp_ns
        if difference > 0:
            # d > 1.5 T and |d - d_before| > d / 10, in integers.
            is_long = self._interval_ns is not None and 2 * difference > 3 * self._interval_ns
            if not is_long or 10 * abs(difference - self._difference_ns) <= difference:
                self._interval_ns = difference
            self._difference_ns = difference
            self._stamp_ns = stamp_ns
        return self._interval_ns
