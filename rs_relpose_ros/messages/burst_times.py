"""Times of samples that come in bursts: even ones in place of the times of arrival.

Some links deliver the samples of an IMU many at once, and the driver stamps them as they arrive.
The order of the samples and the rate of the sensor are right then. Sample k was measured at

    t_k = t_0 + k T,

a line that is fitted to the arrivals of the last bursts: a burst arrives when its last sample has
been measured, or later. Which sample of a burst its stamp belongs to is not known, so all times of
a stream have an error in common. Its sigma goes with each sample (`StampDoubt`).

The rules use the samples so far only. A node and a replay give a sample the same time.
"""

from collections import deque
from collections.abc import Sequence
from dataclasses import replace
import math
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from rs_relpose_ros.geometry.timing import NANOSECONDS, Stamps
from rs_relpose_ros.imu.buffer import EXACT, ImuSample, StampDoubt

# -- Bursts by their stamps -----------------------------------------------------------------------

# A step shorter than this share of the mean one is within a burst. [chosen: jitter of a
# millisecond at 200 Hz makes steps of 0.6; samples read at once are stamped within a tenth]
_WITHIN_BURST = 0.25
# Share of such steps that makes bursts: (n - 1) / n of bursts of n samples. [chosen: 0.7 are
# bursts of 3.4 samples; pairs of gyro and accelerometer on one topic make 0.5]
_IN_BURSTS = 0.7
# Smallest size of bursts. Smaller ones are a rate that has changed, or messages that overtake each
# other. [derived: bursts of 3 samples have two short steps of three, near the share above]
_SMALLEST_BURST = 3
# Fewer steps are no evidence. [chosen: any value from 20 to 100 would do]
_FEWEST_STEPS = 40
# Longer steps are gaps and steps of a clock, not the time between bursts [ns]. [chosen: above the
# duration of 100 samples at 100 Hz; any value from 1.5 s to 5 s would do]
_GAP_NS = 2 * NANOSECONDS


class Bursts(NamedTuple):
    """Samples that are stamped as they arrive, many at once."""

    size: int
    rate: float  # of the sensor [Hz]

    @property
    def period(self) -> float:
        """Time from one burst to the next [s]."""
        return self.size / self.rate


def find_bursts(stamps: Stamps) -> Bursts | None:
    """Return the bursts of stamps (N,) [ns] in the order of their coming; None without bursts."""
    steps = np.diff(stamps)
    steps = steps[(steps >= 0) & (steps < _GAP_NS)]
    if len(steps) < _FEWEST_STEPS or not steps.any():
        return None
    mean_ns = float(steps.mean())
    within = steps < _WITHIN_BURST * mean_ns
    starts = np.flatnonzero(~within)  # the last samples of bursts
    if within.mean() < _IN_BURSTS or len(starts) < 3:
        return None
    size = float(np.median(np.diff(starts)))
    if size < _SMALLEST_BURST:
        return None
    ends_ns = np.cumsum(steps)[starts]
    duration_ns = float(ends_ns[-1] - ends_ns[0])
    samples = int(starts[-1] - starts[0])
    return Bursts(round(size), samples * NANOSECONDS / duration_ns)


# -- The line of their arrivals -------------------------------------------------------------------

# Number of bursts from which the line is used. Fewer leave the rate of the sensor uncertain, more
# delay the first pose. [chosen: 3 to 8 would do]
_FEWEST_BURSTS = 4
# The line is used once its bursts have this duration [ns], too. Over a shorter one the jitter of
# the arrivals makes the rate of the sensor uncertain. [chosen: 0.5 to 2 s would do]
_SHORTEST_LINE_NS = NANOSECONDS
# Number of bursts from which a line that does not fit shows that they are not even. [chosen: twice
# the number above; 6 to 20 would do]
_UNEVEN_BURSTS = 8
# Number of bursts that the line is fitted to. Fewer make the times follow the jitter of the
# arrivals; more make them follow a drift of the sensor's clock late. [chosen: 50 to 500 would do]
_MOST_BURSTS = 256
# Scatter of the arrivals about the line, as a share of the time between bursts, up to which they
# are even. With more the number of samples between two bursts is in doubt. [chosen: 0.1 to 0.3
# would do; a lost burst among the first four makes 0.4]
_LARGEST_SCATTER = 0.25
# Difference of an arrival from the line, as a share of the time between bursts, beyond which the
# line starts again: a burst was lost, or a clock was set. [derived: a lost burst makes 1, scatter
# at the limit above reaches this at three sigma]
_OFF_THE_LINE = 0.75
# Share of the bursts with which the line may start again. With more the arrivals have no line, and
# four of them look even by chance. [chosen: 0.05 to 0.2 would do; a link loses fewer]
_MOST_LINES = 0.1
# Largest correlation of successive arrivals that is used: with more, the times are as uncertain as
# one arrival. [chosen: 0.9 to 0.99 would do: 256 bursts are 13 independent ones then]
_LARGEST_CORRELATION = 0.9
# Two sigmas of the common error of all times are the duration of a burst. [derived: a driver that
# stamps a burst with the time of its first sample, and not of its last, makes this error]
_SIGMAS_OF_BURST = 2.0


class _EvenLine:
    """Line through the arrivals of the last bursts over the numbers of their last samples."""

    def __init__(self, bursts: Bursts) -> None:
        self._bursts = bursts
        self._numbers: deque[int] = deque(maxlen=_MOST_BURSTS)
        self._arrivals_ns: deque[int] = deque(maxlen=_MOST_BURSTS)
        self._period_ns = bursts.period * NANOSECONDS
        self._step_ns = NANOSECONDS / bursts.rate
        self._mean_number = 0.0
        self._mean_ns = 0
        self._scatter_ns = 0.0
        self._correlation = 0.0  # of the deviations of successive arrivals from the line

    @property
    def is_known(self) -> bool:
        """Whether there are enough bursts."""
        if len(self._numbers) < _FEWEST_BURSTS:
            return False
        return self._arrivals_ns[-1] - self._arrivals_ns[0] >= _SHORTEST_LINE_NS

    @property
    def is_even(self) -> bool:
        """Whether the arrivals, as far as they are known, agree with a constant rate."""
        return self.is_known and self._scatter_ns <= _LARGEST_SCATTER * self._period_ns

    @property
    def is_certain(self) -> bool:
        """Whether there are enough bursts to say that they are not even."""
        return self.is_known and len(self._numbers) >= _UNEVEN_BURSTS

    @property
    def doubt(self) -> StampDoubt:
        """What the times of the next samples are worth."""
        of_burst = (self._bursts.size - 1) * self._step_ns / _SIGMAS_OF_BURST
        common = math.hypot(of_burst, self._scatter_ns)
        # Sigma of a line at its end: twice the one of its middle. Of N residuals with a
        # correlation r from one to the next, N (1 - r) / (1 + r) are independent.
        correlation = self._correlation
        independent = len(self._numbers) * (1.0 - correlation) / (1.0 + correlation)
        varying = 2.0 * self._scatter_ns / math.sqrt(independent)
        return StampDoubt(common / NANOSECONDS, varying / NANOSECONDS)

    @property
    def delay_sigma(self) -> float:
        """1 sigma [s] of the time from the last sample of a burst to the earliest arrivals."""
        return math.hypot(self._step_ns / math.sqrt(12.0), self._scatter_ns) / NANOSECONDS

    def add(self, number: int, arrival_ns: int) -> None:
        """Add a burst by the number of its last sample."""
        self._numbers.append(number)
        self._arrivals_ns.append(arrival_ns)
        if len(self._numbers) < _FEWEST_BURSTS:
            return
        first_ns = self._arrivals_ns[0]
        arrivals = np.array(self._arrivals_ns) - first_ns
        mean_arrival = float(arrivals.mean())
        numbers = np.array(self._numbers)
        self._mean_number = float(numbers.mean())
        from_mean = numbers - self._mean_number
        deviations = arrivals - mean_arrival
        self._step_ns = float(from_mean @ deviations) / float(from_mean @ from_mean)
        residuals = deviations - self._step_ns * from_mean
        freedom = len(residuals) - 2
        self._scatter_ns = math.sqrt(float(residuals @ residuals) / freedom)
        self._correlation = _correlation(residuals)
        # A delay only makes an arrival later. The mean of exponential delays is their scatter.
        self._mean_ns = first_ns + round(mean_arrival - self._scatter_ns)

    def time_ns(self, number: int) -> int:
        """Time at which a sample was measured [ns]."""
        return self._mean_ns + round((number - self._mean_number) * self._step_ns)

    def continues(self, number: int, arrival_ns: int) -> bool:
        """Whether a burst that begins with the sample of a number arrives near the line."""
        if not self.is_known:
            return True
        expected_ns = self.time_ns(number - 1 + self._bursts.size)
        return abs(arrival_ns - expected_ns) <= _OFF_THE_LINE * self._period_ns


def _correlation(residuals: NDArray[np.float64]) -> float:
    """Correlation of successive residuals (N,), within what can be an estimate."""
    total = float(residuals @ residuals)
    if not total:
        return 0.0
    of_neighbours = residuals[:-1] @ residuals[1:] / total
    return float(np.clip(of_neighbours, 0.0, _LARGEST_CORRELATION))


# -- Sample by sample -----------------------------------------------------------------------------

# Stamps of so many samples are looked at. [chosen: bursts of 100 need 300; any value from 300 to
# 2000 would do]
_WINDOW = 512
# They are looked at again after so many samples. [chosen: it costs 0.1 ms; 16 to 256 would do]
_EVERY = 64
# Likewise while the first samples wait because they may be those of a burst. [chosen: below
# `_EVERY`, since no pose is possible meanwhile]
_EVERY_AT_START = 16
# Most samples that wait for the line. More only take memory: their images are lost by then.
# [chosen: eight bursts of 100 would do]
_MOST_WAITING = 2000
# Steps with a mean below this one [ns] are those within a burst: no gyro has this rate.
# [chosen: 100 to 250 us would do, as gyros have up to 4 kHz]
_FASTEST_NS = 200_000
# The first samples wait for so many. With fewer, the rest of a burst, with which a stream may
# begin, would look like a usual step. [chosen: 5 to 10 would do: 30 ms at 200 Hz]
_FIRST_SAMPLES = 6
# Share of short steps from which the first samples may be those of bursts. [chosen: two of three
# steps, as bursts of three have; 0.4 to 0.65 would do]
_MAYBE_IN_BURSTS = 0.6


class SampleTimes:
    """Gives the samples of one sensor their times, as they come.

    Samples pass as they are unless their stamps are those of bursts. The first ones wait until
    that is known: six samples of a usual stream, some bursts of the others.
    """

    def __init__(self) -> None:
        # What the stamps show; None as long as samples pass as they are.
        self.bursts: Bursts | None = None
        # Whether the bursts come too unevenly: the samples have no times then, and do not pass.
        self.is_uneven = False
        # Whether samples that have passed had wrong times: the bursts were found after them.
        self.corrects = False
        self.doubt = EXACT  # of the times, as of the last sample
        self._count = 0
        self._passed = False
        self._stamps: deque[int] = deque(maxlen=_WINDOW)
        self._waiting: list[ImuSample] = []  # for times
        self._line: _EvenLine | None = None
        self._lines_so_far = self._bursts_so_far = 0
        self._number = 0  # of the next sample on the line
        self._burst_ns = 0  # arrival of the burst that comes
        self._last_ns = 0  # stamp of the last sample
        self._given_ns = 0  # the last even time

    def add(self, sample: ImuSample) -> Sequence[ImuSample]:
        """Add the next sample; the samples whose times are known by it, in their order."""
        if self.bursts is not None:
            return self._evenly(sample, self.bursts)
        self._count += 1
        self._stamps.append(sample.stamp_ns)
        every = _EVERY if self._passed else _EVERY_AT_START
        if self._count % every == 0:
            self.bursts = find_bursts(np.fromiter(self._stamps, np.int64))
        if self.bursts is not None:
            self.corrects = self._passed
            waiting = [*self._waiting, sample]
            self._waiting = []
            return [timed for one in waiting for timed in self._evenly(one, self.bursts)]
        if self._passed:
            return (sample,)
        self._waiting.append(sample)
        return () if self._may_be_a_burst() else self.rest()

    @property
    def delay_sigma(self) -> float:
        """1 sigma [s] of a delay of all times, where images have shown their offset.

        A driver reads a burst at any time until the next sample: uniform over a step.
        """
        return 0.0 if self._line is None else self._line.delay_sigma

    def rest(self) -> Sequence[ImuSample]:
        """Samples that still wait; of a usual stream at the end of a short input."""
        waiting = self._waiting
        self._waiting = []
        self._passed = True
        return waiting if self.bursts is None else ()

    def _may_be_a_burst(self) -> bool:
        """Whether all samples so far, which wait, may be those of bursts."""
        if self._count < _FIRST_SAMPLES:
            return True
        if self._count == _WINDOW:
            return False
        steps = np.diff(self._stamps)
        mean_ns = float(steps.mean())
        short = float(np.mean(steps < _WITHIN_BURST * mean_ns))
        return 0 <= mean_ns < _FASTEST_NS or short >= _MAYBE_IN_BURSTS

    def _evenly(self, sample: ImuSample, bursts: Bursts) -> Sequence[ImuSample]:
        """The samples whose even times are known by now."""
        arrival_ns = sample.stamp_ns
        step_ns = arrival_ns - self._last_ns
        self._last_ns = arrival_ns
        begins = step_ns >= _WITHIN_BURST * NANOSECONDS / bursts.rate
        line = self._line
        if line is not None and begins:
            line.add(self._number - 1, self._burst_ns)
        is_set_back = step_ns < 0
        is_off = line is not None and begins and not line.continues(self._number, arrival_ns)
        self._bursts_so_far += begins
        if line is None or is_set_back or is_off:
            self._lines_so_far += 1
            # Samples that wait belong to bursts before it, whose times stay unknown.
            self._line = line = _EvenLine(bursts)
            self._waiting.clear()
            self._number = 0
        if begins or self._number == 0:
            self._burst_ns = arrival_ns
        self._waiting.append(sample)
        self._number += 1
        often_off = self._lines_so_far > 1 + _MOST_LINES * self._bursts_so_far
        if often_off or not line.is_even:
            # Of few arrivals even a usual jitter looks large: their samples wait for more of them.
            self.is_uneven = often_off or line.is_certain
            del self._waiting[:-_MOST_WAITING]
            return ()
        self.is_uneven = False
        waiting = self._waiting
        self._waiting = []
        return self._timed(waiting, line)

    def _timed(self, samples: list[ImuSample], line: _EvenLine) -> list[ImuSample]:
        """The last samples with their times on the line."""
        self.doubt = line.doubt
        out = []
        for number, sample in enumerate(samples, self._number - len(samples)):
            # A line that was moved back by the last burst must not reverse the order.
            at_ns = line.time_ns(number)
            if number:
                at_ns = max(at_ns, self._given_ns + 1)
            self._given_ns = at_ns
            out.append(replace(sample, stamp_ns=at_ns, doubt=self.doubt))
        return out
