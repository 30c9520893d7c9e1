"""Time: integer nanoseconds everywhere, and the one equation that gives a row its instant.

    t_imu(row v) = stamp + time_offset + exposure_shift + (v - v_stamp) * line_delay

``v_stamp`` is row 0, (height - 1) / 2 or height - 1 for a driver that stamps the first, middle or
last row; ``exposure_shift`` is +exposure/2, 0 or -exposure/2 for a driver that stamps the start,
middle or end of the exposure.
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
    """

    camera: RollingShutterCamera
    time_offset: float = 0.0
    stamp_exposure: str = 'middle'
    exposure_time: float = 0.0

    def __post_init__(self) -> None:
        if self.stamp_exposure not in STAMP_EXPOSURES:
            raise InputError(
                f'stamp_exposure must be one of {STAMP_EXPOSURES}, got {self.stamp_exposure!r}')
        if not self.exposure_time >= 0.0:
            raise InputError(f'exposure_time must be >= 0 s, got {self.exposure_time}')

    def reference_ns(self, stamp_ns: int) -> int:
        """Instant of the reference row's mid-exposure on the IMU clock [ns]."""
        shift = {'start': 0.5, 'middle': 0.0, 'end': -0.5}[self.stamp_exposure]
        return stamp_ns + to_nanoseconds(self.time_offset + shift * self.exposure_time)

    def row_span_ns(self, stamp_ns: int) -> tuple[int, int]:
        """Instants of the earliest and the latest row of the frame on the IMU clock [ns]."""
        reference = self.reference_ns(stamp_ns)
        earliest, latest = self.camera.row_time_span
        return reference + to_nanoseconds(earliest), reference + to_nanoseconds(latest)
