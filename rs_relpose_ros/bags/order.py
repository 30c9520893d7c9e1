"""The order in which the messages of a bag are read offline: that of their header stamps.

Receive times say when a message reached the recorder: some seconds late over a wireless link, or,
in a converted bag, hours after its measurement and topic after topic. Sensors are compared by the
times of their measurements, which the stamps are.

A clock that is set back is the exception. Sorted by stamp, what was measured after would lie among
what was measured before. There the order of the file counts.
"""

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

Times = NDArray[np.int64]

# Messages that count as a clock that was set back. Fewer may have been late, or one of them may
# have a wrong stamp. [chosen: the clock of a camera of 30 Hz is then recognised from 0.1 s on]
_FEWEST_AFTER_RESET = 3
# Number of messages in the time that both sides of a backward step cover, in relation to the
# number at the rate of the sensor: 1 if late messages fill a gap, 2 if a clock covers this time
# again. [derived: the mean of both]
_COVERED_TWICE = 1.5
# Time [ns] between the end of one run of a clock and the begin of the next one, in the order of
# reading. Any positive value keeps them apart.
_BETWEEN_RUNS_NS = 1_000_000_000


def clock_runs(stamps: Times) -> NDArray[np.int64]:
    """Number of the run of each message (N,): how often its clock was set back before.

    `stamps` (N,) [ns] in the order of the file.
    """
    runs = np.zeros(len(stamps), dtype=np.int64)
    if len(stamps) < 2 * _FEWEST_AFTER_RESET:
        return runs
    period = max(float(np.median(np.diff(np.sort(stamps)))), 1.0)
    begin = 0  # of the run
    largest = np.maximum.accumulate(stamps)
    for step in np.flatnonzero(np.diff(stamps) < 0) + 1:
        top = largest[step - 1]
        if _is_reset(stamps[begin:step], stamps[step:], top, period):
            begin = int(step)
            runs[begin:] += 1
            largest[begin:] = np.maximum.accumulate(stamps[begin:])
    return runs


def _is_reset(before: Times, after: Times, top: int, period: float) -> bool:
    """Whether a clock was set back, and messages were not merely late.

    `before` and `after` the step (N,) and (M,) [ns]; `top` is the largest stamp before it.
    """
    if len(after) < _FEWEST_AFTER_RESET or np.any(after[:_FEWEST_AFTER_RESET] > top):
        return False
    passing = np.flatnonzero(after > top)
    until = int(passing[0]) if len(passing) else len(after)
    covering = int(np.count_nonzero(after[:until] >= after[0]))
    above = int(np.count_nonzero(before >= after[0]))
    if above < _FEWEST_AFTER_RESET:
        return False
    expected = (top - int(after[0])) / period + 1.0
    covered_twice = above + covering > _COVERED_TWICE * expected
    # Late messages fill a gap; after a jump over all that was recorded most of the time is empty.
    never_passes = not len(passing) and above + covering < expected / _COVERED_TWICE
    return covered_twice or never_passes


def reading_times(stamps: Times, topics: NDArray[np.int64], sensors: Sequence[int]) -> Times:
    """Times (N,) [ns] in whose order messages are read: their stamps, unless a clock was set back.

    `stamps` (N,) [ns] and `topics` (N,), the number of the topic of each, are in the order of the
    file. `sensors` are the numbers of the topics whose clocks decide.
    """
    by_topic = {int(topic): np.flatnonzero(topics == topic) for topic in np.unique(topics)}
    runs = {topic: clock_runs(stamps[rows]) for topic, rows in by_topic.items()}
    times = stamps.copy()
    last = {int(runs[topic][-1]) for topic in sensors if topic in runs}
    if len(last) == 1:
        # All clocks were set back equally often, mostly never: one run is read after the other.
        whole = np.zeros(len(stamps), dtype=np.int64)
        for topic, rows in by_topic.items():
            whole[rows] = runs[topic]
        of_sensors = np.isin(topics, list(sensors))
        for run in range(1, last.pop() + 1):
            earlier = times[of_sensors & (whole == run - 1)].max()
            here = whole == run
            shift = earlier + _BETWEEN_RUNS_NS - times[of_sensors & here].min()
            times[here] += shift
    else:
        # A sensor alone was set back: its messages keep the order of the file.
        for topic, rows in by_topic.items():
            if runs[topic][-1]:
                times[rows] = np.maximum.accumulate(times[rows])
    return times
