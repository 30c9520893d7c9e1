"""Time: integer nanoseconds everywhere, and the time of a row on the IMU's clock.

    t_imu(row v) = stamp + time_offset + k (T - T_ref) + exposure_shift + (v - v_stamp) line_delay

as in docs/time_and_frames.md, "Rows and the IMU's clock"; T is the interval between frames
(`FrameIntervals`), k ``time_offset_per_interval``.
"""

from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from rs_relpose_ros.geometry import Array, validate
from rs_relpose_ros.geometry.camera import Intrinsics, RollingShutterCamera
from rs_relpose_ros.geometry.motion import FrameMotion

NANOSECONDS = 1_000_000_000

STAMP_EXPOSURES = ('start', 'middle', 'end')


def seconds_between(start_ns: int, end_ns: int) -> float:
    """Float seconds from `start_ns` to `end_ns`: subtracted as integers, then converted."""
    return (end_ns - start_ns) / NANOSECONDS


def to_nanoseconds(seconds: float) -> int:
    """Nearest integer nanoseconds of a duration in seconds."""
    return round(seconds * NANOSECONDS)


# Difference of stamps [s] that no delay of a message explains.
_APART = 1.0


def clocks_apart(ahead: float) -> str:
    """Message on stamps of the IMU that are `ahead` [s] of the images'; empty if by little."""
    return (
        ''
        if abs(ahead) < _APART
        else (
            f'the clock of the IMU is {abs(ahead):.1f} s '
            f'{"ahead of" if ahead > 0.0 else "behind"} '
            "the images'"
        )
    )


# Steps of so many medians have an image missing.
MISSING = 1.8


def correlation_of_steps(steps: Array) -> float:
    """Correlation of successive steps between images, with none missing between.

    `steps` (N,): as shares of their median. About 1 of an exposure that changes, -0.5 of stamps
    that jitter: a late one makes one step longer and the next one shorter.
    """
    whole = (steps > 0.0) & (steps < MISSING)
    if not whole.any():
        return 0.0
    # A few frames, as those after the start of a camera, must not decide.
    low, high = np.quantile(steps[whole], (0.05, 0.95))
    deviations = np.clip(steps, low, high)
    deviations -= deviations[whole].mean()
    both = whole[1:] & whole[:-1]
    first = deviations[:-1][both]
    second = deviations[1:][both]
    return float(first @ second) / max(0.5 * float(first @ first + second @ second), 1e-24)


def exposure_shift(stamp_exposure: str, exposure_time: float) -> float:
    """From the stamp to the middle of the stamped row's exposure [s]; of `STAMP_EXPOSURES`."""
    return {'start': 0.5, 'middle': 0.0, 'end': -0.5}[stamp_exposure] * exposure_time


@dataclass(frozen=True, slots=True)
class ImageClock:
    """Times of an image's rows on the IMU clock."""

    camera: RollingShutterCamera  # its reference row is the one that the driver stamps
    time_offset: float = 0.0  # [s] IMU clock minus camera clock
    stamp_exposure: str = 'middle'  # time of that row's exposure which the stamp marks
    exposure_time: float = 0.0  # [s] of one row
    offset_per_interval: float = 0.0  # k [s/s]
    reference_interval: float = 0.0  # T_ref [s]
    exposure_margin: float = 0.0  # [s]; if not 0, the exposure is T less this

    def __post_init__(self) -> None:
        validate.choice('stamp_exposure', self.stamp_exposure, STAMP_EXPOSURES)
        validate.number('exposure_time', self.exposure_time, 0.0, unit='s')

    def reference_ns(self, stamp_ns: int, interval_ns: int | None = None) -> int:
        """Time [ns] of the reference row's mid-exposure; T of the frame is T_ref if not known."""
        offset = self.time_offset + exposure_shift(self.stamp_exposure, self.exposure(interval_ns))
        if interval_ns is not None:
            offset += self.offset_per_interval * (
                interval_ns / NANOSECONDS - self.reference_interval
            )
        return stamp_ns + to_nanoseconds(offset)

    def exposure(self, interval_ns: int | None = None) -> float:
        """Exposure of a row [s] of a frame of interval T, or T_ref if that is not known."""
        if not self.exposure_margin:
            return self.exposure_time
        interval = self.reference_interval if interval_ns is None else interval_ns / NANOSECONDS
        return max(interval - self.exposure_margin, 0.0)

    def exposed_span_ns(self, stamp_ns: int, interval_ns: int | None = None) -> tuple[int, int]:
        """Times at which the first row's exposure begins and the last one's ends [ns]."""
        reference = self.reference_ns(stamp_ns, interval_ns)
        earliest, latest = self.camera.row_time_span
        half = to_nanoseconds(0.5 * self.exposure(interval_ns))
        return (
            reference + to_nanoseconds(earliest) - half,
            reference + to_nanoseconds(latest) + half,
        )


class Sensor(NamedTuple):
    """Camera model of the full sensor, place of the published image on it, and its clock.

    `config.settings.sensor_model` builds it for a parameter set.
    """

    camera: RollingShutterCamera  # its reference row is the one that poses relate
    intrinsics: Intrinsics
    clock: ImageClock  # of that row
    pose_row_delay: float = 0.0  # [s] from the stamped row to it

    def derotated(self, points: Array, motion: FrameMotion) -> tuple[Array, Array]:
        """Rays (N, 3) of pixels (N, 2) of a published image, and their row times (N,) [s]."""
        pixels = self.intrinsics.to_sensor(points)
        row_times = self.camera.row_times(pixels[:, 1])
        return motion.derotate(self.camera.unproject(pixels), row_times), row_times

    def project(self, rays: Array, row_times: Array, motion: FrameMotion) -> Array:
        """Pixels (N, 2) of a published image where rays (N, 3) are observed; NaN outside of it.

        The inverse of `derotated`. The row of a ray depends on its pixel, so `row_times` (N,) are
        a first guess that is improved twice.
        """
        camera = self.camera
        first, last = camera.row_time_span
        for _ in range(2):
            rotations = motion.rotations(np.clip(row_times, first, last))
            pixels = camera.project(np.einsum('nji,nj->ni', rotations, rays))
            row_times = np.where(
                np.isfinite(pixels[:, 1]), camera.row_times(pixels[:, 1]), row_times
            )
        return self.intrinsics.to_image(pixels)


class FrameIntervals:
    """Interval T of each frame to the previous one; stamps that do not increase are ignored.

    T is kept if frames are missing in between: the difference of the stamps exceeds 1.5 T. Two
    such differences in a row that agree to a tenth are a new frame rate.
    """

    def __init__(self) -> None:
        self._stamp_ns: int | None = None
        self._difference_ns = 0
        self._interval_ns: int | None = None

    def add(self, stamp_ns: int) -> int | None:
        """T of the frame of this stamp [ns]; None of the first one."""
        if self._stamp_ns is not None:
            difference = stamp_ns - self._stamp_ns
            kept = self._interval_ns
            if difference <= 0:
                return kept
            # 2 d > 3 T and |d - d_before| > d / 10, in integers.
            missing = (
                kept is not None
                and 2 * difference > 3 * kept
                and 10 * abs(difference - self._difference_ns) > difference
            )
            if not missing:
                self._interval_ns = difference
            self._difference_ns = difference
        self._stamp_ns = stamp_ns
        return self._interval_ns
