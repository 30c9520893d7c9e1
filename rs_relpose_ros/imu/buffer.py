"""IMU history: takes samples in any order, answers for intervals, says when it cannot."""

from __future__ import annotations

from dataclasses import replace
from enum import Enum
import math

import numpy as np
from numpy.typing import NDArray

from rs_relpose_ros.config.imu import ImuConfig
from rs_relpose_ros.errors import InputError
from rs_relpose_ros.geometry.timing import to_nanoseconds
from rs_relpose_ros.imu.bias import BiasTracker, GyroBias
from rs_relpose_ros.imu.gravity import (
    agreed_gravity,
    GravityEstimate,
    GravityFilter,
    mean_gravity,
    MEAN_WINDOW_NS,
)
from rs_relpose_ros.imu.integration import integrate_rotation
from rs_relpose_ros.imu.samples import ImuSample
from rs_relpose_ros.imu.series import Series

Array = NDArray[np.float64]


class Coverage(Enum):
    """Whether the buffer can answer for an interval."""

    AVAILABLE = 'available'
    NOT_YET = 'not yet'
    NEVER = 'never'


class AddResult(Enum):
    """What became of a sample."""

    ADDED = 'added'
    DUPLICATE = 'duplicate'
    LATE = 'late'


class ImuBuffer:
    """Gyro and accelerometer of the last seconds, with causal filters of gravity and gyro bias.

    Gyro and accelerometer may come in one message or in two (RealSense). Equal samples in equal
    order give bit-equal answers, however the queries interleave: the filters run sample by sample
    over the sorted gyro, up to the instant that is asked for.
    """

    def __init__(self, config: ImuConfig) -> None:
        self._config = config
        self._told_bias = np.array(config.gyro_bias)
        self._gap_ns = to_nanoseconds(config.max_imu_gap)
        self._keep_ns = to_nanoseconds(config.imu_buffer_seconds)
        self.clear()

    def clear(self) -> None:
        """Forget everything."""
        self._gyro, self._force, self._down = Series(), Series(), Series(4)
        self._filter = GravityFilter(self._config)
        self._bias = BiasTracker(self._config)
        self._filtered_ns = self._pruned_ns = int(np.iinfo(np.int64).min)

    @property
    def newest_gyro_ns(self) -> int | None:
        """Stamp of the newest gyro sample."""
        return self._gyro.newest_ns

    @property
    def newest_force_ns(self) -> int | None:
        """Stamp of the newest accelerometer sample."""
        return self._force.newest_ns

    @property
    def newest_ns(self) -> int | None:
        """Newest stamp of any kind."""
        return max((series.newest_ns for series in (self._gyro, self._force, self._down)
                    if series.newest_ns is not None), default=None)

    def add(self, sample: ImuSample) -> AddResult:
        """Store a sample; InputError where a value is not finite, and nothing is stored."""
        for name, value in (('angular_velocity', sample.angular_velocity),
                            ('linear_acceleration', sample.linear_acceleration)):
            if value is not None and not all(map(math.isfinite, value)):
                raise InputError(f'IMU sample at {sample.stamp_ns} ns: {name} must be finite, '
                                 f'got {list(value)}')
        newest_ns, own = self.newest_ns, sample.orientation
        newest = sample.stamp_ns if newest_ns is None else newest_ns
        added = self._gyro.insert(sample.stamp_ns, sample.angular_velocity)
        added |= self._force.insert(sample.stamp_ns, sample.linear_acceleration)
        if own is not None:
            added |= self._down.insert(sample.stamp_ns, (*own.down, own.sigma))
        if not added:
            return AddResult.DUPLICATE
        # Pruned when a tenth is too old: a search per sample would cost more than the memory.
        if newest - self._pruned_ns > self._keep_ns * 11 // 10:
            self._pruned_ns = newest - self._keep_ns
            self.prune(self._pruned_ns)
        return AddResult.LATE if sample.stamp_ns < newest else AddResult.ADDED

    def prune(self, before_ns: int) -> None:
        """Forget what is older than `before_ns`."""
        # The filters must have seen a sample before it is forgotten.
        self._run_filters(before_ns)
        for series in (self._gyro, self._force, self._down):
            series.prune(before_ns)

    def coverage(self, start_ns: int, end_ns: int) -> Coverage:
        """Whether the gyro covers [start_ns, end_ns] without a gap."""
        return self._covered(self._gyro, start_ns, end_ns)

    def _covered(self, series: Series, start_ns: int, end_ns: int) -> Coverage:
        stamps = series.stamps
        if len(stamps) == 0:
            return Coverage.NOT_YET
        if start_ns < stamps[0]:
            return Coverage.NEVER
        first = int(np.searchsorted(stamps, start_ns, side='right')) - 1
        last = int(np.searchsorted(stamps, end_ns, side='left'))
        within = stamps[first:last + 1]
        if len(within) > 1 and int(np.diff(within).max()) > self._gap_ns:
            return Coverage.NEVER
        if last == len(stamps):
            return Coverage.NOT_YET
        return Coverage.AVAILABLE

    def angular_velocity(self, start_ns: int, end_ns: int) -> tuple[NDArray[np.int64], Array]:
        """Gyro over an interval, its borders interpolated; one entry where they are equal.

        Stamps (K,) and rates (K, 3) [rad/s] in the IMU frame, `bias` of `end_ns` subtracted.
        """
        if end_ns < start_ns:
            raise InputError(f'the interval must not end ({end_ns}) before it starts ({start_ns})')
        if self.coverage(start_ns, end_ns) is not Coverage.AVAILABLE:
            raise InputError(f'the gyro does not cover [{start_ns}, {end_ns}] ns: '
                             f'{self.coverage(start_ns, end_ns).value}')
        stamps_ns, rates = self._gyro.between(start_ns, end_ns)
        return stamps_ns, rates - self.bias(end_ns).value

    def specific_force(self, start_ns: int,
                       end_ns: int) -> tuple[NDArray[np.int64], Array] | None:
        """Accelerometer over an interval, its borders interpolated; None where it has a gap there.

        Stamps (K,) and specific forces (K, 3) [m/s^2] in the IMU frame.
        """
        if self._covered(self._force, start_ns, end_ns) is not Coverage.AVAILABLE:
            return None
        return self._force.between(start_ns, end_ns)

    def recent_forces(self, until_ns: int) -> Array:
        """Specific forces (K, 3) [m/s^2] of the last seconds up to an instant, IMU frame."""
        stamps = self._force.stamps
        # Half of the history: how much more is left depends on when it is asked for.
        window = slice(int(np.searchsorted(stamps, until_ns - self._keep_ns // 2)),
                       int(np.searchsorted(stamps, until_ns, side='right')))
        return self._force.values[window]

    def bias(self, at_ns: int) -> GyroBias:
        """Bias of the gyro at an instant, from samples up to it; ask in the order of time."""
        self._run_filters(at_ns)
        return self._bias.estimate(at_ns)

    def rotation(self, start_ns: int, end_ns: int) -> tuple[Array, Array]:
        """``R_start^T R_end`` (3, 3) in the IMU frame and the covariance of its error.

        See `integrate_rotation`.
        """
        stamps_ns, rates = self.angular_velocity(start_ns, end_ns)
        return integrate_rotation(stamps_ns, rates, self._config, self.bias(end_ns).sigma)

    def gravity(self, at_ns: int) -> GravityEstimate | None:
        """Direction of gravity at an instant that the gyro covers, from samples up to it.

        None where neither accelerometer nor orientation came, or where the gyro does not cover the
        instant. Ask in the order of time: an instant before one that was asked for gets that one's
        estimate, turned back by the gyro.
        """
        estimate = (self._mean_gravity(at_ns) if self._config.gravity_filter == 'mean'
                    else self._filtered_gravity(at_ns))
        if not self._config.use_imu_orientation:
            return estimate
        return agreed_gravity(self._own_gravity(at_ns), estimate)

    # -- inside ------------------------------------------------------------------------------

    def _mean_gravity(self, at_ns: int) -> GravityEstimate | None:
        stamps = self._force.stamps
        window = slice(int(np.searchsorted(stamps, at_ns - MEAN_WINDOW_NS)),
                       int(np.searchsorted(stamps, at_ns, side='right')))
        return mean_gravity(self._force.values[window])

    def _filtered_gravity(self, at_ns: int) -> GravityEstimate | None:
        self._run_filters(at_ns)
        estimate, stamp_ns = self._filter.estimate(), self._filter.stamp_ns
        if estimate is None or stamp_ns is None:
            return None
        return self._turned(estimate, stamp_ns, at_ns)

    def _own_gravity(self, at_ns: int) -> GravityEstimate | None:
        """Gravity from the last orientation message up to an instant; None where it is old."""
        stamps = self._down.stamps
        last = int(np.searchsorted(stamps, at_ns, side='right')) - 1
        if last < 0 or at_ns - int(stamps[last]) > self._gap_ns:
            return None
        value = self._down.values[last]
        return self._turned(GravityEstimate(value[:3], float(value[3])), int(stamps[last]), at_ns)

    def _turned(self, estimate: GravityEstimate, from_ns: int,
                to_ns: int) -> GravityEstimate | None:
        """An estimate carried to another instant by the gyro; None where it has a gap."""
        start_ns, end_ns = sorted((from_ns, to_ns))
        if self.coverage(start_ns, end_ns) is not Coverage.AVAILABLE:
            return None
        turn, _ = self.rotation(start_ns, end_ns)
        return replace(estimate, direction=(turn.T if from_ns < to_ns else turn)
                       @ estimate.direction)

    def _run_filters(self, until_ns: int) -> None:
        """Filter the samples up to an instant that were not filtered yet."""
        stamps = self._gyro.stamps
        first = int(np.searchsorted(stamps, self._filtered_ns, side='right'))
        last = int(np.searchsorted(stamps, until_ns, side='right'))
        if first < last:
            rates, forces = self._gyro.values[first:last], self._forces_at(stamps[first:last])
            self._bias.run(stamps[first:last], rates, forces)
            # With the configured bias only: the gravity filter estimates the rest by itself.
            if self._config.gravity_filter == 'complementary':
                self._filter.run(stamps[first:last], rates - self._told_bias, forces)
            self._filtered_ns = int(stamps[last - 1])

    def _forces_at(self, stamps_ns: NDArray[np.int64]) -> Array:
        """Latest specific forces (K, 3) not after these stamps; NaN where older than a gap."""
        stamps = self._force.stamps
        forces = np.full((len(stamps_ns), 3), np.nan)
        k = np.searchsorted(stamps, stamps_ns, side='right') - 1
        fresh = k >= 0
        fresh[fresh] = stamps_ns[fresh] - stamps[k[fresh]] <= self._gap_ns
        forces[fresh] = self._force.values[k[fresh]]
        return forces
