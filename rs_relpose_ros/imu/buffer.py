"""IMU samples of the last seconds: added in any order, queried by intervals and frames.

`ImuSamples` stores them, `ImuBuffer` adds the causal filters of gyro bias and gravity, and
`frame_imu` collects the share of one frame.
"""

from dataclasses import dataclass, replace
from enum import Enum
from itertools import pairwise
import math
from typing import NamedTuple

import numpy as np

from rs_relpose_ros.config.settings import ImuConfig
from rs_relpose_ros.errors import InputError
from rs_relpose_ros.geometry import Array, validate
from rs_relpose_ros.geometry.gyro import integrated_rotations
from rs_relpose_ros.geometry.motion import FrameMotion
from rs_relpose_ros.geometry.so3 import STANDARD_GRAVITY, Vector
from rs_relpose_ros.geometry.timing import NANOSECONDS, Stamps, to_nanoseconds
from rs_relpose_ros.imu import filters, integration
from rs_relpose_ros.imu.filters import GravityEstimate, GyroBias
from rs_relpose_ros.imu.integration import FrameImu, ImuSlice
from rs_relpose_ros.imu.noise import shown_density

# A step between samples of more than this many times the usual one: a sample may still arrive.
# [derived: halfway between one step and two]
_LATE_STEP = 1.5
# Duration of the samples [ns] by which the accelerometer is tested. Within a shorter one the mean
# force contains the acceleration of a step. [derived: a walk has two steps a second]
_TESTED_NS = 1_000_000_000
# Duration of the samples [ns] by which the noise of the gyro is measured. A shorter one scatters
# more, a longer one follows a motor that starts later. [chosen: 0.5 to 2 s would do]
_NOISE_NS = 1_000_000_000
# Samples for which a series has room at first, and by which it grows. [chosen: a second]
_ROOM = 256
# Old samples are removed when the oldest has this part of the buffer's length more than it: a
# search for each sample would cost more than the memory. [chosen: a tenth of the memory]
_EXCESS = 10


# Time before all stamps [ns]. [derived: the smallest integer of 64 bits]
_NEVER_NS = int(np.iinfo(np.int64).min)


class Coverage(Enum):
    """Whether the samples cover an interval."""

    AVAILABLE = 'available'
    NOT_YET = 'not yet'
    NEVER = 'never'


class Series:
    """Stamped vectors (K, width) in order, in growing arrays; steps above `gap_ns` are gaps."""

    def __init__(self, gap_ns: int, width: int = 3) -> None:
        self._gap_ns = gap_ns
        self._stamps = np.empty(_ROOM, dtype=np.int64)
        self._values = np.empty((_ROOM, width))
        self._start = 0
        self._end = 0
        self.newest_ns: int | None = None  # the last stamp; None without any
        # Stamps before and after each gap, in order: `coverage` is asked for several times with
        # each sample and each frame.
        self._gaps: list[tuple[int, int]] = []

    @property
    def stamps(self) -> Stamps:
        """Stamps (K,) [ns], strictly increasing; a view until the next insertion."""
        return self._stamps[self._start : self._end]

    @property
    def values(self) -> Array:
        """Values (K, width); likewise a view."""
        return self._values[self._start : self._end]

    def insert(self, stamp_ns: int, value: tuple[float, ...] | None) -> bool:
        """Insert in order; False for no value, and for a stamp that exists already."""
        if value is None:
            return False
        newest_ns = self.newest_ns
        if newest_ns is not None and stamp_ns <= newest_ns:
            return self._insert_late(stamp_ns, value)
        self._make_room()
        self._stamps[self._end] = stamp_ns
        self._values[self._end] = value
        self._end += 1
        self.newest_ns = int(stamp_ns)
        if newest_ns is not None and stamp_ns - newest_ns > self._gap_ns:
            self._gaps.append((newest_ns, self.newest_ns))
        return True

    def _insert_late(self, stamp_ns: int, value: tuple[float, ...]) -> bool:
        """Insert a sample that is not the newest; False for a stamp that exists already."""
        position = int(self.stamps.searchsorted(stamp_ns))
        after_ns = int(self.stamps[position])
        if after_ns == stamp_ns:
            return False
        self._make_room()
        at = self._start + position
        later = slice(at, self._end)
        moved = slice(at + 1, self._end + 1)
        for column in (self._stamps, self._values):
            column[moved] = column[later]
        self._stamps[at] = stamp_ns
        self._values[at] = value
        self._end += 1
        # The sample divides a step: what was a gap may be two, one or none now.
        around = [after_ns] if position == 0 else [int(self._stamps[at - 1]), after_ns]
        divided = [gap for gap in self._gaps if gap != tuple(around)]
        steps = pairwise(sorted([*around, int(stamp_ns)]))
        gaps = [step for step in steps if step[1] - step[0] > self._gap_ns]
        self._gaps = sorted([*divided, *gaps])
        return True

    def _make_room(self) -> None:
        """Let the arrays grow where they are full."""
        if self._end < len(self._stamps):
            return
        stamps = self.stamps
        more = max(_ROOM, len(stamps))
        self._values = np.concatenate([self.values, np.empty((more, self._values.shape[1]))])
        self._stamps = np.concatenate([stamps, np.empty(more, dtype=np.int64)])
        self._start = 0
        self._end = len(stamps)

    def prune(self, before_ns: int) -> None:
        """Remove samples before `before_ns`, except the last of them, for interpolation."""
        keep = self.number_until(before_ns) - 1
        if keep > 0:
            self._start += keep
            first_ns = int(self._stamps[self._start])
            self._gaps = [gap for gap in self._gaps if gap[0] >= first_ns]

    def between(self, start_ns: int, end_ns: int) -> tuple[Stamps, Array] | None:
        """Stamps (K,), values (K, width), borders interpolated; None if not covered."""
        if self.coverage(start_ns, end_ns) is not Coverage.AVAILABLE:
            return None
        first = self.number_until(start_ns)
        begin = self._interpolated(start_ns, first)
        if start_ns == end_ns:
            return np.array([start_ns]), begin[None]
        last = int(self.stamps.searchsorted(end_ns))
        stamps = np.empty(last - first + 2, dtype=np.int64)
        stamps[0] = start_ns
        stamps[1:-1] = self.stamps[first:last]
        stamps[-1] = end_ns
        values = np.empty((len(stamps), self._values.shape[1]))
        values[0] = begin
        values[1:-1] = self.values[first:last]
        values[-1] = self._interpolated(end_ns, last)
        return stamps, values

    def _interpolated(self, at_ns: int, after: int) -> Array:
        """Value (width,) at a time; `after`: number of a sample then, or of the first later one.

        Of the last sample, the number of all samples will do.
        """
        stamps, values = self.stamps, self.values
        before = after - 1
        if after < len(stamps) and stamps[after] == at_ns:
            return values[after]
        before_ns = stamps[before]
        if before_ns == at_ns:
            return values[before]
        fraction = (at_ns - before_ns) / (stamps[after] - before_ns)
        return np.asarray(values[before] + fraction * (values[after] - values[before]))

    def enclosing(self, start_ns: int, end_ns: int) -> Stamps:
        """Stamps within an interval, and one on either side of it."""
        first = max(self.number_until(start_ns) - 1, 0)
        last = int(self.stamps.searchsorted(end_ns))
        return self.stamps[first : last + 1]

    def number_until(self, at_ns: int) -> int:
        """Number of samples up to a time, that time included."""
        return int(self.stamps.searchsorted(at_ns, 'right'))

    def coverage(self, start_ns: int, end_ns: int) -> Coverage:
        """Whether the samples cover [start_ns, end_ns] without a gap."""
        if self._end == self._start:
            return Coverage.NOT_YET
        if start_ns < self._stamps[self._start]:
            return Coverage.NEVER
        if any(before < end_ns and after > start_ns for before, after in self._gaps):
            return Coverage.NEVER
        is_known = end_ns <= self._stamps[self._end - 1]
        return Coverage.AVAILABLE if is_known else Coverage.NOT_YET


class StampDoubt(NamedTuple):
    """Errors of stamps that were not given by the sensor, as 1 sigma [s]."""

    common: float  # of an offset that all stamps have in common
    varying: float  # of what changes from image to image


# The doubt of stamps as drivers give them. [derived: the parameters contain all that is known]
EXACT = StampDoubt(0.0, 0.0)


@dataclass(frozen=True, slots=True)
class ImuSample:
    """Content of one message, in the IMU frame; None for a sensor that it does not contain."""

    stamp_ns: int  # on the IMU clock
    angular_velocity: Vector | None  # [rad/s]
    linear_acceleration: Vector | None  # [m/s^2] specific force: 9.81 upwards at rest (REP-145)
    # Of an orientation that the IMU computes, with a covariance in the message: unit direction of
    # free fall (minus the world's z, REP-103), and its sigma per axis [rad].
    orientation: tuple[float, float, float, float] | None = None
    doubt: StampDoubt = EXACT


# Bounds of the mean length of the specific force over some seconds, in standard gravities: no
# carrier accelerates for so long. Within closer ones a running person would be refused; in units
# of g the length is 1 m/s^2, in mg or feet too large. [chosen: a scale error of 30 %]
_LIKELY_LENGTHS = (0.7, 1.4)
# Three consecutive samples that are bit-equal on one axis, close to the largest value there, are
# the end of the sensor's range, which is at least this many gravities: at rest, samples of a
# coarse sensor are equal, too. [chosen: the smallest range of a sensor is 2 g]
_LEAST_RANGE = 1.5
# Share of the largest value on an axis from which a sample may be the end of the range.
# [chosen: calibrated sensors have the end of their range on each axis within rounding]
_AT_THE_END = 0.999


class ForceFault(str):
    """Reason why an accelerometer gives no specific force, with the mean length of its samples."""

    fix = 'it must be specific force in m/s^2 (REP-145)'

    def __new__(cls, length: float) -> 'ForceFault':
        """`length`: mean length of the samples [m/s^2]."""
        hint = ''
        if abs(length - 1.0) < 0.15:
            hint = ', these are g'
        elif length < 0.5 * STANDARD_GRAVITY:
            hint = ', gravity is removed'
        message = (
            f'the accelerometer reads {length:.3g} m/s^2 in the mean, not {STANDARD_GRAVITY}{hint}'
        )
        fault = super().__new__(cls, f'{message}: {cls.fix}')
        fault.length = length
        fault.message = message
        return fault

    length: float
    message: str


def length_fault(length: float) -> ForceFault | None:
    """The fault of forces of this mean length [m/s^2]; None if it may be the one of gravity."""
    low, high = (bound * STANDARD_GRAVITY for bound in _LIKELY_LENGTHS)
    return None if low <= length <= high else ForceFault(length)


def force_fault(forces: Array) -> str:
    """Reason why the samples (K, 3) of the last seconds are unusable; empty if they are usable."""
    if not len(forces):
        return 'there is no accelerometer'
    if fault := length_fault(float(np.linalg.norm(forces, axis=1).mean())):
        return fault
    size = np.abs(forces)
    if size.max() < _LEAST_RANGE * STANDARD_GRAVITY:
        return ''
    largest = size.max(axis=0)
    end = np.maximum(_AT_THE_END * largest, _LEAST_RANGE * STANDARD_GRAVITY)
    equal = (forces[1:] == forces[:-1]) & (size[1:] >= end)
    if not (equal[1:] & equal[:-1]).any():
        return ''
    return f'the accelerometer is clipped at {largest.max():.3g} m/s^2'


class ImuInterval(NamedTuple):
    """Samples between two times at the stamps of both sensors: (K,), (K, 3), in the IMU frame."""

    seconds: Array
    rates: Array
    forces: Array

    @property
    def duration(self) -> float:
        """From the first to the last sample [s]."""
        return float(self.seconds[-1] - self.seconds[0])

    @property
    def at_rest(self) -> bool:
        """Whether gyro and accelerometer hardly vary."""
        return filters.is_at_rest(self.rates, self.forces)

    def mean_force(self, gyro_bias: Array) -> Array:
        """Mean specific force (3,) in the axes of the last sample."""
        rotations = integrated_rotations(
            self.seconds, np.ascontiguousarray(self.rates - gyro_bias)
        )
        mean = np.einsum('kij,kj->i', rotations, self.forces) / len(self.forces)
        return np.asarray(rotations[-1].T @ mean)


def _is_finite(vector: Vector | None) -> bool:
    """Whether a vector, if there is one, has finite elements."""
    if vector is None:
        return True
    x, y, z = vector
    return math.isfinite(x) and math.isfinite(y) and math.isfinite(z)


def _not_finite(sample: ImuSample) -> str:
    """Text about a sample with a vector that is not finite."""
    name = 'linear_acceleration' if _is_finite(sample.angular_velocity) else 'angular_velocity'
    value = getattr(sample, name)
    return f'IMU sample at {sample.stamp_ns} ns: {name} must be finite, got {list(value)}'


class ImuSamples:
    """Samples of both sensors and orientations, in any order; `max_gap` [s] covers an interval."""

    def __init__(self, max_gap: float) -> None:
        self._gap_ns = to_nanoseconds(max_gap)
        self.clear()

    def clear(self) -> None:
        """Remove all samples."""
        # Rates, specific forces, and directions of gravity with their sigma.
        self.gyro, self.force = Series(self._gap_ns), Series(self._gap_ns)
        self._down = Series(self._gap_ns, 4)

    @property
    def newest_ns(self) -> int | None:
        """Newest stamp of any kind."""
        newest = [series.newest_ns for series in (self.gyro, self.force, self._down)]
        return max([stamp_ns for stamp_ns in newest if stamp_ns is not None], default=None)

    @property
    def both_until_ns(self) -> int | None:
        """Time up to which both sensors are known."""
        gyro = self.gyro.newest_ns
        force = self.force.newest_ns
        return None if gyro is None or force is None else min(gyro, force)

    @property
    def fault(self) -> str:
        """Fault of the accelerometer (`force_fault`); empty without one, or if not yet known."""
        stamps = self.gyro.stamps
        known = len(stamps) and stamps[-1] - stamps[0] >= _TESTED_NS
        return force_fault(self.force.values) if known else ''

    def add(self, sample: ImuSample) -> bool:
        """Store a sample, or False for a duplicate; InputError if a value is not finite."""
        if not (_is_finite(sample.angular_velocity) and _is_finite(sample.linear_acceleration)):
            raise InputError(_not_finite(sample))
        added = self.gyro.insert(sample.stamp_ns, sample.angular_velocity)
        added |= self.force.insert(sample.stamp_ns, sample.linear_acceleration)
        return self._down.insert(sample.stamp_ns, sample.orientation) or added

    def prune(self, before_ns: int) -> None:
        """Remove what is older than `before_ns`."""
        for series in (self.gyro, self.force, self._down):
            series.prune(before_ns)

    def complete(self, start_ns: int, end_ns: int) -> bool:
        """Whether all samples between two times seem to have arrived."""
        until_ns = self.both_until_ns
        if until_ns is None or until_ns < end_ns:
            return False
        for series in (self.gyro, self.force):
            steps = np.diff(series.enclosing(start_ns, end_ns))
            usual = np.median(np.diff(series.stamps))
            if not len(steps) or steps.max() > _LATE_STEP * usual:
                return False
        return True

    def between(self, start_ns: int, end_ns: int) -> ImuInterval | None:
        """Samples of both sensors from one time to a later one; None if one has a gap."""
        if end_ns <= start_ns:
            return None
        gyro = self.gyro.between(start_ns, end_ns)
        force = self.force.between(start_ns, end_ns)
        if gyro is None or force is None:
            return None
        rate_times = (gyro[0] - start_ns) / NANOSECONDS
        force_times = (force[0] - start_ns) / NANOSECONDS
        common = integration.at_common_times(rate_times, gyro[1], force_times, force[1])
        return ImuInterval(*common)

    def up_to(self, end_ns: int, seconds: float) -> ImuInterval | None:
        """Samples of both sensors of at most the last `seconds` before a time, if any."""
        if self.both_until_ns is None:
            return None
        first = max(int(self.gyro.stamps[0]), int(self.force.stamps[0]))
        return self.between(max(first, end_ns - to_nanoseconds(seconds)), end_ns)


class ImuBuffer(ImuSamples):
    """Samples of the last seconds, with causal filters of gravity and gyro bias.

    The filters run sample by sample over the sorted gyro, up to the requested time.
    """

    def __init__(self, config: ImuConfig) -> None:
        self.config = config
        self._configured_bias = np.array(config.gyro_bias)
        self._keep_ns = to_nanoseconds(config.imu_buffer_seconds)
        # Half of the buffer is there, whenever it is asked for.
        self._noise_ns = min(_NOISE_NS, self._keep_ns // 2)
        super().__init__(config.max_imu_gap)

    def clear(self) -> None:
        """Remove all samples and reset the filters."""
        super().clear()
        self._filter = filters.GravityFilter(self.config)
        self._bias = filters.BiasTracker(self.config)
        self._filtered_ns = _NEVER_NS
        self._pruned_ns = _NEVER_NS

    def add(self, sample: ImuSample) -> bool:
        """Store a sample, or False for a duplicate; InputError if a value is not finite."""
        added = super().add(sample)
        excess = sample.stamp_ns - self._pruned_ns - self._keep_ns
        if excess > self._keep_ns // _EXCESS:
            self._pruned_ns = sample.stamp_ns - self._keep_ns
            self.prune(self._pruned_ns)
        return added

    def prune(self, before_ns: int) -> None:
        """Remove what is older than `before_ns`."""
        self._run_filters(before_ns)
        super().prune(before_ns)

    def angular_velocity(
        self, start_ns: int, end_ns: int, exposure: float = 0.0
    ) -> tuple[Stamps, Array]:
        """Stamps (K,), rates (K, 3) [rad/s] of an interval, borders interpolated, IMU frame.

        The `bias` of `end_ns` is subtracted; each rate is the mean over `exposure` [s]
        about its stamp.
        """
        if end_ns < start_ns:
            raise InputError(f'the interval must not end ({end_ns}) before it starts ({start_ns})')
        half = to_nanoseconds(0.5 * exposure)
        rows = self.gyro.between(start_ns, end_ns)
        exposed = self.gyro.between(start_ns - half, end_ns + half) if half else rows
        if exposed is None or rows is None:
            raise InputError(
                f'the gyro does not cover [{start_ns - half}, {end_ns + half}] ns: '
                f'{self.gyro.coverage(start_ns - half, end_ns + half).value}'
            )
        stamps_ns, rates = rows
        if half:
            rates = integration.mean_rates(*exposed, stamps_ns, exposure)
        return stamps_ns, rates - self.bias(end_ns).value

    def turn_of_exposure(self, middle_ns: int, exposure: float) -> Array:
        """Rotation vector (3,) [rad] of an image against the orientation at its middle, IMU axes.

        An image shows the mean orientation over its exposure h. With an angular acceleration a, it
        is ``a h^2 / 24`` ahead of the orientation at the middle.
        """
        half = to_nanoseconds(0.5 * exposure)
        exposed = self.gyro.between(middle_ns - half, middle_ns + half) if half else None
        if exposed is None:
            return np.zeros(3)
        rates = exposed[1]
        return np.asarray(exposure / 24.0 * (rates[-1] - rates[0]))

    def covers(self, start_ns: int, end_ns: int, exposure: float) -> bool:
        """Whether the gyro covers the exposures [s] of all rows between two times."""
        half = to_nanoseconds(0.5 * exposure)
        return self.gyro.coverage(start_ns - half, end_ns + half) is Coverage.AVAILABLE

    def recent_forces(self, until_ns: int, duration_ns: int | None = None) -> Array:
        """Specific forces (K, 3) [m/s^2] up to a time, IMU frame."""
        if duration_ns is None:
            # Half of the buffer is there, whenever it is asked for.
            duration_ns = self._keep_ns // 2
        first = int(self.force.stamps.searchsorted(until_ns - duration_ns))
        return self.force.values[first : self.force.number_until(until_ns)]

    def gyro_noise_density(self, until_ns: int) -> float:
        """Density of the gyro's noise by the samples up to a time, at least as configured."""
        first = int(self.gyro.stamps.searchsorted(until_ns - self._noise_ns))
        last = self.gyro.number_until(until_ns)
        seconds = (self.gyro.stamps[first:last] - until_ns) / NANOSECONDS
        rates = self.gyro.values[first:last]
        return shown_density(rates, seconds, self.config.gyro_noise_density)

    def bias(self, at_ns: int) -> GyroBias:
        """Bias of the gyro at a time, from samples up to it; to be called in the order of time."""
        self._run_filters(at_ns)
        return self._bias.estimate(at_ns)

    def rotation(self, start_ns: int, end_ns: int) -> tuple[Array, Array]:
        """``R_start^T R_end`` (3, 3) in the IMU frame, covariance: see `integrate_rotation`."""
        stamps_ns, rates = self.angular_velocity(start_ns, end_ns)
        return integration.integrate_rotation(
            stamps_ns, rates, self.config.gyro_noise_density, self.bias(end_ns).sigma
        )

    def gravity(self, at_ns: int) -> GravityEstimate | None:
        """Direction of gravity at a time that the gyro covers, from samples up to it, if any.

        To be called in the order of time: for a time before an earlier call, the estimate of that
        call is rotated back.
        """
        if self.config.gravity_filter == 'mean':
            estimate = filters.mean_gravity(self.recent_forces(at_ns, filters.MEAN_WINDOW_NS))
        else:
            self._run_filters(at_ns)
            estimate = self._filter.estimate()
            stamp_ns = self._filter.stamp_ns
            if estimate is not None and stamp_ns is not None:
                estimate = self._propagated(estimate, stamp_ns, at_ns)
        own = self._own_gravity(at_ns) if self.config.use_imu_orientation else None
        return estimate if own is None else filters.agreed_gravity(own, estimate)

    def _own_gravity(self, at_ns: int) -> GravityEstimate | None:
        """Gravity by the last orientation that the IMU has computed, unless it is too old."""
        last = self._down.number_until(at_ns) - 1
        if last < 0:
            return None
        own_ns = int(self._down.stamps[last])
        *down, sigma = self._down.values[last].tolist()
        if at_ns - own_ns > self._gap_ns:
            return None
        return self._propagated(GravityEstimate(np.array(down), sigma), own_ns, at_ns)

    def _propagated(
        self, estimate: GravityEstimate, from_ns: int, to_ns: int
    ) -> GravityEstimate | None:
        """An estimate propagated to another time by the gyro; None if that has a gap."""
        start_ns, end_ns = sorted((from_ns, to_ns))
        if self.gyro.coverage(start_ns, end_ns) is not Coverage.AVAILABLE:
            return None
        R, _ = self.rotation(start_ns, end_ns)
        return replace(estimate, direction=(R.T if from_ns < to_ns else R) @ estimate.direction)

    def _run_filters(self, until_ns: int) -> None:
        """Filter the samples up to a time that were not filtered yet."""
        if until_ns <= self._filtered_ns:
            return
        first = self.gyro.number_until(self._filtered_ns)
        last = self.gyro.number_until(until_ns)
        if first < last:
            stamps = self.gyro.stamps[first:last]
            rates = self.gyro.values[first:last]
            forces = self._forces_at(stamps)
            self._bias.run(stamps, rates, forces)
            # With the configured bias only: the gravity filter estimates the rest.
            if self.config.gravity_filter == 'complementary':
                self._filter.run(stamps, rates - self._configured_bias, forces)
            self._filtered_ns = int(stamps[-1])

    def _forces_at(self, stamps: Stamps) -> Array:
        """The latest specific forces (K, 3) not after these stamps; NaN if older than a gap."""
        forces = np.full((len(stamps), 3), np.nan)
        known = self.force.stamps
        if len(known):
            k = np.searchsorted(known, stamps, side='right') - 1
            fresh = (k >= 0) & (stamps - known[k] <= self._gap_ns)
            forces[fresh] = self.force.values[k[fresh]]
        return forces


def frame_imu(
    buffer: ImuBuffer,
    span_ns: tuple[int, int],
    reference_ns: int,
    R_cam_imu: Array,
    previous_reference_ns: int | None = None,
    exposure: float = 0.0,
    *,
    gyro_only: bool = False,
) -> FrameImu:
    """The IMU's share of a frame; all times are on the IMU clock, ``v_cam = R_cam_imu v_imu``.

    `span_ns`: from the begin of the first row's exposure to the end of the last one's.
    `reference_ns`, `previous_reference_ns`: times of the stamped rows of this frame and of the
    one before. `exposure`: of a row [s]. `gyro_only`: without gravity and specific force.
    """
    half = to_nanoseconds(0.5 * exposure)
    span_ns = span_ns[0] + half, span_ns[1] - half  # of the middle of the rows' exposures
    motion = _rows_motion(buffer, span_ns, reference_ns, R_cam_imu, exposure)
    # The filter runs up to the last row; its direction is rotated back to the stamped row.
    gravity = None if gyro_only else buffer.gravity(span_ns[1])
    if gravity is not None:
        back = motion.rotations([(span_ns[1] - reference_ns) * 1e-9])[0]
        motion = validate.replaced(motion, gravity=back @ (R_cam_imu @ gravity.direction))
    motion = motion.turned(R_cam_imu @ buffer.turn_of_exposure(reference_ns, exposure))
    start_ns = reference_ns if previous_reference_ns is None else previous_reference_ns
    before = buffer.force.between(min(start_ns, reference_ns), reference_ns)
    readout = buffer.force.between(*span_ns)
    no_force = 'not needed' if gyro_only else force_fault(buffer.recent_forces(span_ns[1]))
    if not no_force and (before is None or readout is None or gravity is None):
        no_force = 'the accelerometer has a gap'
    since_previous = None
    if start_ns < reference_ns and buffer.covers(start_ns, reference_ns, exposure):
        since_previous = _slice(buffer, (start_ns, reference_ns), R_cam_imu, no_force)
        if not no_force and before is not None:
            since_previous = replace(
                since_previous, force_stamps_ns=before[0], forces=before[1] @ R_cam_imu.T
            )
    sigma = None if gravity is None else gravity.sigma
    imu = FrameImu(motion, sigma, reference_ns, since_previous, no_force)
    if no_force or readout is None or gravity is None:
        return imu
    force = _mean_force(motion, readout[0] - reference_ns, readout[1] @ R_cam_imu.T)
    return replace(imu, force=force, at_rest=gravity.length, at_rest_sigma=gravity.length_sigma)


def _rows_motion(
    buffer: ImuBuffer,
    span_ns: tuple[int, int],
    reference_ns: int,
    R_cam_imu: Array,
    exposure: float,
) -> FrameMotion:
    """Rotation of the camera during the readout of a frame."""
    stamps_ns, rates = buffer.angular_velocity(*span_ns, exposure)
    rates = rates @ R_cam_imu.T
    if span_ns[0] == span_ns[1]:  # a global shutter
        return FrameMotion(rates[0])
    return FrameMotion.from_gyro((stamps_ns - reference_ns) * 1e-9, rates)


def _slice(
    buffer: ImuBuffer,
    between_ns: tuple[int, int],
    R_cam_imu: Array,
    no_force: str,
) -> ImuSlice:
    """The gyro between the middles of the exposures of two stamped rows."""
    stamps_ns, rates = buffer.angular_velocity(*between_ns)
    bias = buffer.bias(between_ns[1])
    return ImuSlice(
        stamps_ns,
        rates @ R_cam_imu.T,
        R_cam_imu @ bias.value,
        bias.sigma,
        buffer.gyro_noise_density(between_ns[1]),
        no_force,
    )


def _mean_force(motion: FrameMotion, times_ns: Stamps, forces: Array) -> Array:
    """Mean (3,) of specific forces (K, 3), in the axes of the stamped row.

    `times_ns` (K,): of the forces, from the stamped row on. Forces are linear between samples:
    each one counts for half of the steps beside it.
    """
    row_times = times_ns * 1e-9
    forces = np.einsum('kij,kj->ki', motion.rotations(row_times), forces)
    if len(forces) == 1:
        return np.asarray(forces[0])
    steps = row_times[1:] - row_times[:-1]
    weights = np.zeros(len(row_times))
    weights[:-1] = steps
    weights[1:] += steps
    return np.asarray(weights @ forces / weights.sum())
