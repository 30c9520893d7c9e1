"""IMU samples of the last seconds, for intervals between keyframes."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from rs_relpose_ros.geometry.timing import NANOSECONDS, to_nanoseconds
from rs_relpose_ros.imu.forces import force_fault
from rs_relpose_ros.imu.samples import ImuSample
from rs_relpose_ros.imu.series import Series
from rs_relpose_ros.odometry.interval import ImuInterval

Stamps = NDArray[np.int64]

# A step between samples of more than so many times the usual one: a sample may still come.
_STEP = 1.5
# Of samples over so long the accelerometer is judged: a step of a walk is shorter.
_JUDGED_NS = 1_000_000_000


class ImuHistory:
    """Takes samples in any order; gyro and accelerometer may come apart."""

    def __init__(self, max_gap: float) -> None:
        self._gap_ns = to_nanoseconds(max_gap)
        self._gyro, self._force = Series(), Series()

    @property
    def newest_ns(self) -> int | None:
        """Up to where both sensors are known."""
        gyro, force = self._gyro.newest_ns, self._force.newest_ns
        return None if gyro is None or force is None else min(gyro, force)

    @property
    def fault(self) -> str:
        """What is wrong with the accelerometer; empty where nothing is, or it is not known yet."""
        stamps = self._gyro.stamps
        known = len(stamps) and stamps[-1] - stamps[0] >= _JUDGED_NS
        return force_fault(self._force.values) if known else ''

    def add(self, sample: ImuSample) -> None:
        """Store a sample."""
        self._gyro.insert(sample.stamp_ns, sample.angular_velocity)
        self._force.insert(sample.stamp_ns, sample.linear_acceleration)

    def prune(self, before_ns: int) -> None:
        """Forget what is older."""
        self._gyro.prune(before_ns)
        self._force.prune(before_ns)

    def complete(self, start_ns: int, end_ns: int) -> bool:
        """Whether no sample between two instants seems to be on its way still."""
        newest = self.newest_ns
        if newest is None or newest < end_ns:
            return False
        for series in (self._gyro, self._force):
            steps = np.diff(_within(series.stamps, start_ns, end_ns))
            if not len(steps) or steps.max() > _STEP * np.median(np.diff(series.stamps)):
                return False
        return True

    def between(self, start_ns: int, end_ns: int) -> ImuInterval | None:
        """Samples from one instant to a later one; None where there is a gap."""
        newest = self.newest_ns
        if newest is None or newest < end_ns or end_ns <= start_ns:
            return None
        parts = []
        for series in (self._gyro, self._force):
            stamps = series.stamps
            if stamps[0] > start_ns \
                    or np.diff(_within(stamps, start_ns, end_ns)).max() > self._gap_ns:
                return None
            parts.append(series.between(start_ns, end_ns))
        union = np.union1d(parts[0][0], parts[1][0])
        seconds = (union - start_ns) / NANOSECONDS
        rates, forces = (np.column_stack([
            np.interp(seconds, (stamps - start_ns) / NANOSECONDS, axis) for axis in values.T])
            for stamps, values in parts)
        return ImuInterval(seconds, rates, forces)

    def up_to(self, end_ns: int, seconds: float) -> ImuInterval | None:
        """Samples of at most the last `seconds` before an instant, as far as there are any."""
        if self.newest_ns is None:
            return None
        first = max(int(self._gyro.stamps[0]), int(self._force.stamps[0]))
        return self.between(max(first, end_ns - to_nanoseconds(seconds)), end_ns)


def _within(stamps: Stamps, start_ns: int, end_ns: int) -> Stamps:
    """Stamps that an interval needs: one on either side of it, and those inside."""
    first = max(int(np.searchsorted(stamps, start_ns, side='right')) - 1, 0)
    return stamps[first:int(np.searchsorted(stamps, end_ns)) + 1]
