"""What is wrong with the stamps and the publishers of a stream, for check, replay and the nodes.

Offline the stamps of the whole stream are known before its messages (`check_timelines`); a node
knows the last ones (`Stream`). Both use the same rules:

| fault | rule |
|---|---|
| bursts | most steps are far shorter than the mean one: stamps are times of arrival |
| two publishers | the frame_id changes to and fro |
| nanosec above 999999999 | most stamps have it: a cast from 64 to 32 bits |
| time since boot | one clock starts before 2001, the other one after |
| clock of the accelerometer | its delay to the recorder differs from that of the gyro |
| 32-bit counter | a step back of 2^32 units |
"""

from collections import deque
from collections.abc import Callable, Mapping
from enum import Enum
from itertools import chain
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from rs_relpose_ros.errors import InputError
from rs_relpose_ros.geometry import Array
from rs_relpose_ros.geometry.timing import NANOSECONDS, Stamps
from rs_relpose_ros.imu.buffer import ImuSample
from rs_relpose_ros.messages.burst_times import Bursts, find_bursts, SampleTimes

# Stamps before this time are since the start of a device, those after it since 1970 [ns].
# [derived: 10^9 s are 2001, and 31 years of running]
_SINCE_1970_NS = 10**9 * NANOSECONDS
# Two sensors of one driver that reach the recorder with delays that differ by more have clocks of
# their own [s]. [chosen: batches of an IMU are late by 0.1 s; any value from 0.3 to 1 would do]
_OWN_CLOCK = 0.5
# A step back is that of a 32-bit counter if it differs by less from 2^32 units, in steps of the
# stream. [chosen: some messages may be lost there; any value from 5 to 100 would do]
_LOST_AT_WRAP = 20.0
# Units of counters of 32 bits, by the seconds of one unit.
_UNITS = {'nanoseconds': 1e-9, 'microseconds': 1e-6, 'milliseconds': 1e-3}
# The publisher of a topic has changed to and fro so often if there are two. [chosen: a restarted
# driver or two joined recordings change it once]
_RETURNS = 2
# Most of so many stamps must be impossible: a single one is a damaged message. [chosen: any value
# from 3 to 20 would do]
_FEWEST_STAMPS = 5
# Share of the samples of bursts that must get even times. With fewer most images would have no
# pose, and the user is better served by the cause. [chosen: any value from 0.3 to 0.8 would do]
_MOST_TIMED = 0.5


class FaultKind(str, Enum):
    """Kind of a fault of a stream."""

    BURSTS = 'bursts'
    SINCE_BOOT = 'since_boot'
    ACCEL_CLOCK = 'accel_clock'


class StreamFault(NamedTuple):
    """A fault of a stream, with a text and what to do."""

    kind: FaultKind
    message: str
    fix: str
    measured: Mapping[str, Any]
    withholds: bool = True  # whether no pose can be right

    def __str__(self) -> str:
        return f'{self.message}; {self.fix}'


class Timeline(NamedTuple):
    """Stamps and times of reception [ns] of the messages of a topic."""

    topic: str
    stamps: Stamps
    received: Stamps

    @property
    def delay(self) -> float:
        """Median time from the stamp to the reception [s]."""
        return float(np.median(self.received - self.stamps)) / NANOSECONDS


def burst_fault(topic: str, bursts: Bursts, sigma: float) -> StreamFault:
    """Make the fault of a gyro in bursts; `sigma` [s]: of even times, 0 where there are none."""
    message = (
        f'the samples of {topic} come in bursts of {bursts.size} that are stamped on arrival, '
        f'their true rate is {bursts.rate:.0f} Hz'
    )
    fix = 'have the driver stamp each sample with the time of the sensor'
    if sigma:
        message += f': they get even times, whose offset is known to {1e3 * sigma:.0f} ms'
    else:
        message += ', and they come too unevenly for even times'
    measured = {'burst': bursts.size, 'rate_hz': bursts.rate, 'offset_sigma_s': sigma or None}
    return StreamFault(FaultKind.BURSTS, message, fix, measured, withholds=not sigma)


def burst_warning(topic: str, times: SampleTimes) -> str:
    """Return the text on a gyro that comes in bursts; empty for a usual one."""
    if times.bursts is None:
        return ''
    return str(burst_fault(topic, times.bursts, 0.0 if times.is_uneven else times.doubt.common))


def _bursts_of(imu: Timeline) -> StreamFault | None:
    """Return the fault of a gyro whose samples come in bursts, with what its times are worth."""
    found = find_bursts(imu.stamps)
    if found is None:
        return None
    times = SampleTimes()
    timed = sum(len(times.add(ImuSample(int(stamp), None, None))) for stamp in imu.stamps)
    is_even = times.bursts is not None and timed > _MOST_TIMED * len(imu.stamps)
    return burst_fault(imu.topic, found, times.doubt.common if is_even else 0.0)


def counter_unit(step: float, interval: float) -> str:
    """Return the unit of a 32-bit counter that overflowed at a step back [s]; '' if it is none."""
    for unit, seconds in _UNITS.items():
        if abs(abs(step) - 2**32 * seconds) <= _LOST_AT_WRAP * interval:
            return unit
    return ''


def check_timelines(
    timeline: Callable[[Any], Timeline], topics: Any
) -> dict[FaultKind, StreamFault]:
    """Return the faults of the streams of a bag by their kind, from the stamps of all messages.

    `timeline` of the bag; `topics` by role, None for one that it lacks.
    """
    image, imu, accel = (
        None if topic is None else timeline(topic)
        for topic in (topics.image, topics.imu, topics.accel)
    )
    if imu is None:
        return {}
    faults = []
    if (bursts := _bursts_of(imu)) is not None:
        faults.append(bursts)
    if image is not None and len(image.stamps) and len(imu.stamps):
        faults += _since_boot(image, imu)
    if accel is not None and len(imu.stamps) and len(accel.stamps):
        ahead = imu.delay - accel.delay
        if abs(ahead) > _OWN_CLOCK:
            faults.append(_accel_clock(accel.topic, ahead))
    return {fault.kind: fault for fault in faults}


def _since_boot(image: Timeline, imu: Timeline) -> list[StreamFault]:
    image_ns = int(np.median(image.stamps))
    imu_ns = int(np.median(imu.stamps))
    if (image_ns < _SINCE_1970_NS) == (imu_ns < _SINCE_1970_NS):
        return []
    boot, epoch = ('images are', 'IMU') if image_ns < imu_ns else ('IMU is', 'images')
    since = min(image_ns, imu_ns) / NANOSECONDS
    message = (
        f'the {boot} stamped with the time since boot ({since:.1f} s), '
        f'the {epoch} with the time since 1970'
    )
    fix = 'have both drivers stamp with one clock (ROS time)'
    measured = {'apart_s': (image_ns - imu_ns) * 1e-9}
    return [StreamFault(FaultKind.SINCE_BOOT, message, fix, measured)]


def _accel_clock(topic: str, ahead: float) -> StreamFault:
    side = 'ahead of' if ahead > 0.0 else 'behind'
    return StreamFault(
        FaultKind.ACCEL_CLOCK,
        f'the clock of the accelerometer ({topic}) is {abs(ahead):.1f} s {side} that of the gyro',
        'have its driver stamp both sensors with one clock; until then poses are from the gyro '
        'alone',
        {'ahead_s': ahead},
        withholds=False,
    )


# -- Repeated and interpolated samples ------------------------------------------------------------

# Fewer values are no evidence. [chosen: any value from 20 to 100 would do]
_FEWEST_VALUES = 40
# A value that lies on the line between its neighbours within this share of the noise has been
# interpolated. [chosen: of float32 and five digits; any value from 0.01 to 0.1 would do]
_ON_LINE = 0.03
# Largest factor between the rate of the messages and that of the sensor that is looked for.
# [chosen: drivers that publish at 1 kHz read sensors of 100 Hz and more]
_LARGEST_FACTOR = 8
# Share of the values that must repeat, or lie on lines. [chosen: any value from 0.6 to 0.95]
_MOST = 0.9


def find_multiplied(values: Array) -> tuple[float, str]:
    """How a driver has multiplied the samples of a sensor, by the values (N, 3) of its messages.

    Messages for each sample, and 'repeated' or 'interpolated'; 1 and '' for a sample in each.
    """
    if len(values) < _FEWEST_VALUES or not np.ptp(values, axis=0).any():
        return 1.0, ''
    steps = np.diff(values, axis=0)
    repeated: NDArray[np.bool_] = np.all(steps == 0.0, axis=1)
    second_differences = np.diff(steps, axis=0)
    bends = np.abs(second_differences).max(axis=1)
    typical = float(np.quantile(bends, _MOST))
    on_line: NDArray[np.bool_] = np.asarray(bends < _ON_LINE * typical)
    for how, multiplied in (('repeated', repeated), ('interpolated', on_line)):
        count = len(multiplied)
        new = count - int(multiplied.sum())
        factor = count / max(new, 1)
        is_likely = 1.5 <= factor <= _LARGEST_FACTOR
        if is_likely and _is_regular(multiplied, round(factor)):
            return factor, how
    return 1.0, ''


# Error of the mean of an interval that is interpolated between its ends, in units of the second
# difference of the samples there. [derived: the trapezoidal rule]
_TRAPEZOID = 1.0 / 12.0


# The rate of a sensor is found from so many samples. [chosen: 200 to 2000 would do]
_WINDOW = 512
# It is found again after so many. [chosen: it costs 0.1 ms; 16 to 256 would do]
_EVERY = 64


class SensorRate:
    """How many messages the samples of a gyro make, message by message."""

    def __init__(self) -> None:
        self._stamps: deque[int] = deque(maxlen=_WINDOW)
        self._rates: deque[tuple[float, float, float]] = deque(maxlen=_WINDOW)
        self._count = 0
        # Messages for each sample of the sensor; 1 until it is known.
        self.factor = 1.0
        # Density [rad^2/s] of the errors between samples that were multiplied.
        self.between = 0.0

    def add(self, stamp_ns: int, rates: tuple[float, float, float]) -> bool:
        """Add the values of a message; whether the factor has changed."""
        self._stamps.append(stamp_ns)
        self._rates.append(rates)
        self._count += 1
        if self._count % _EVERY:
            return False
        values = np.fromiter(chain.from_iterable(self._rates), np.float64).reshape(-1, 3)
        found, _ = find_multiplied(values)
        factor = round(found)
        changed = factor != self.factor
        self.factor = float(factor)
        self.between = 0.0
        if factor > 1:
            step = float(np.median(np.diff(self._stamps))) / NANOSECONDS
            bends = np.diff(values[::factor], n=2, axis=0)
            variance = _TRAPEZOID**2 * float(np.mean(bends**2))
            self.between = factor * step * variance
        return changed


def _is_regular(multiplied: NDArray[np.bool_], factor: int) -> bool:
    """Tell whether one of `factor` values is new, in a regular order."""
    places = np.flatnonzero(~multiplied)
    if len(places) <= 2:
        return False
    is_step = np.diff(places) == factor
    return float(np.mean(is_step)) > _MOST


# -- Publishers and stamps, message by message ----------------------------------------------------


class Stream:
    """The messages of one topic as they come: publishers and stamps."""

    def __init__(self, topic: str) -> None:
        self.topic = topic
        self._frame_id: str | None = None
        self._others: list[str] = []  # frame_ids in the order of their first coming
        self._returns = self._count = self._impossible = 0

    def add(self, header: Any) -> None:
        """Add the next message by its header.

        InputError if the stream has two publishers or no stamps. Messages of the accelerometer of
        a driver that publishes both sensors on one topic are not added.
        """
        self._count_publishers(str(header.frame_id))
        self._count_stamps(header.stamp)

    def _count_publishers(self, frame_id: str) -> None:
        if frame_id == self._frame_id:
            return
        if frame_id in self._others:
            self._returns += 1
        else:
            self._others.append(frame_id)
        self._frame_id = frame_id
        if self._returns >= _RETURNS:
            names = ' and '.join(repr(one[:60]) for one in self._others[:4])
            raise InputError(
                f'{self.topic} has several publishers: its messages come with the frame_id '
                f'{names} in turn; give each driver a topic of its own (remap)'
            )

    def _count_stamps(self, stamp: Any) -> None:
        self._count += 1
        self._impossible += int(stamp.nanosec) >= NANOSECONDS
        if self._impossible >= _FEWEST_STAMPS and 2 * self._impossible > self._count:
            raise InputError(
                f'{self.topic}: nanosec of the stamps is above 999999999 ({int(stamp.nanosec)}): '
                'the driver cast a time of 64 bits to 32; correct its stamps'
            )
