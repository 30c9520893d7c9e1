"""Time: integer nanoseconds everywhere, and the one equation that gives a row its instant.

    t_imu(row v) = stamp + time_offset + k (T - T_ref) + exposure_shift
                   + (v - v_stamp) * line_delay

``v_stamp`` is row 0, (height - 1) / 2 or height - 1 for a driver that stamps the first, middle or
last row; ``exposure_shift`` is +exposure/2, 0 or -exposure/2 for a driver that stamps the start,
middle or end of the exposure. k is ``time_offset_per_interval``: with automatic exposure, the
middle of the exposure moves against the stamp as the interval T between frames changes
(`FrameIntervals`).
"""

from __future__ import annotations

from dataclasses import dataclass

from rs_relpose_ros.errors import InputError
from rs_relpose_ros.geometry.camera import RollingShutterCamera

NANOSECONDS = 1_000_000_000

STAMP_EXPOSURES = ('start', 'middle', 'end')


def seconds_between(start_ns: int, end_ns: int) -> float:
    """Float seconds from `start_ns` to `end_ns`: subtracted as integers, then converted."""
    return (end_ns - start_ns) / NANOSECONDS


def to_nanoseconds(seconds: float) -> int:
    """Nearest integer nanoseconds of a duration in seconds."""
    return round(seconds * NANOSECONDS)


def exposure_shift(stamp_exposure: str, exposure_time: float) -> float:
    """From the stamp to the middle of the stamped row's exposure [s]; of `STAMP_EXPOSURES`."""
    return {'start': 0.5, 'middle': 0.0, 'end': -0.5}[stamp_exposure] * exposure_time


@dataclass(frozen=True, slots=True)
class ImageClock:
    """Where an image's rows lie on the IMU clock.

    Parameters
    ----------
    camera : RollingShutterCamera
        Its ``reference_row`` is the row that the driver stamps.
    time_offset : float
        IMU clock minus camera clock [s]: ``t_imu = stamp + time_offset``.
    stamp_exposure : {'start', 'middle', 'end'}
        The instant of that row's exposure which the stamp marks.
    exposure_time : float
        Exposure of one row [s]; needed unless `stamp_exposure` is 'middle'.
    offset_per_interval, reference_interval : float
        k [s/s] and T_ref [s]: the offset of a frame is longer by ``k (T - T_ref)``.
    """

    camera: RollingShutterCamera
    time_offset: float = 0.0
    stamp_exposure: str = 'middle'
    exposure_time: float = 0.0
    offset_per_interval: float = 0.0
    reference_interval: float = 0.0

    def __post_init__(self) -> None:
        if self.stamp_exposure not in STAMP_EXPOSURES:
            raise InputError(
                f'stamp_exposure must be one of {STAMP_EXPOSURES}, got {self.stamp_exposure!r}')
        if not self.exposure_time >= 0.0:
            raise InputError(f'exposure_time must be >= 0 s, got {self.exposure_time}')

    def reference_ns(self, stamp_ns: int, interval_ns: int | None = None) -> int:
        """Instant of the reference row's mid-exposure on the IMU clock [ns].

        `interval_ns`: T of the frame; None where it is not known, T_ref then.
        """
        offset = self.time_offset + exposure_shift(self.stamp_exposure, self.exposure_time)
        if interval_ns is not None:
            offset += self.offset_per_interval * (
                interval_ns / NANOSECONDS - self.reference_interval)
        return stamp_ns + to_nanoseconds(offset)

    def row_span_ns(self, stamp_ns: int, interval_ns: int | None = None) -> tuple[int, int]:
        """Instants of the earliest and the latest row of the frame on the IMU clock [ns]."""
        reference = self.reference_ns(stamp_ns, interval_ns)
        earliest, latest = self.camera.row_time_span
        return reference + to_nanoseconds(earliest), reference + to_nanoseconds(latest)


class FrameIntervals:
    """Interval T of each frame to the one before; stamps that do not increase tell nothing.

    Where frames are missing in between, the last T is kept: a difference more than 1.5 times as
    long as T is one, unless that before was as long, to a tenth of it: then the frame rate has
    changed.
    """

    def __init__(self) -> None:
        self._stamp_ns: int | None = None
        self._difference_ns = 0
        self._interval_ns: int | None = None

    def add(self, stamp_ns: int) -> int | None:
        """T of the frame of this stamp [ns]; None of the first one."""
        if self._stamp_ns is not None and stamp_ns <= self._stamp_ns:
            return self._interval_ns
        if self._stamp_ns is not None:
            difference, kept = stamp_ns - self._stamp_ns, self._interval_ns
            # 2 d > 3 T and |d - d_before| > d / 10, in integers.
            missing = (kept is not None and 2 * difference > 3 * kept
                       and 10 * abs(difference - self._difference_ns) > difference)
            if not missing:
                self._interval_ns = difference
            self._difference_ns = difference
        self._stamp_ns = stamp_ns
        return self._interval_ns
