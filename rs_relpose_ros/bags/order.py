"""The order in which the messages of a bag are read offline: by their header stamps.

Receive times say when a message reached the recorder: some seconds late over a wireless link, or,
in a converted bag, hours after its measurement and topic after topic. Sensors are compared by the
times of their measurements, which the stamps are.

A clock that is set back is the exception. Sorted by stamp, what was measured after would lie among
what was measured before. There the order of the file counts.
"""

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from rs_relpose_ros.geometry.timing import Stamps

# Messages that count as a clock that was set back. Fewer may have been late, or one of them may
# have a wrong stamp. [chosen: the clock of a camera of 30 Hz is then recognised from 0.1 s on]
_FEWEST_AFTER_RESET = 3
# Number of messages in the time that both sides of a backward step cover, in relation to the
# number at the rate of the sensor: 1 if late messages fill a gap, 2 if a clock covers this time
# again. [derived: the mean of both]
_COVERED_TWICE = 1.5
# Time [ns] between the end of one run of a clock and the begin of the next one, in the order of
# reading. It keeps the runs apart. [chosen: any positive value would do]
_BETWEEN_RUNS_NS = 1_000_000_000


def clock_runs(stamps: Stamps) -> NDArray[np.int64]:
    """Number of the run of each message (N,): how often its clock was set back before.

    `stamps` (N,) [ns] in the order of the file.
    """
    runs = np.zeros(len(stamps), dtype=np.int64)
    if len(stamps) < 2 * _FEWEST_AFTER_RESET:
        return runs
    steps = np.diff(np.sort(stamps))
    period = max(float(np.median(steps)), 1.0)
    begin = 0  # of the run
    largest = np.maximum.accumulate(stamps)
    backward = np.flatnonzero(np.diff(stamps) < 0) + 1
    for step in backward:
        top = largest[step - 1]
        if _is_reset(stamps[begin:step], stamps[step:], top, period):
            begin = int(step)
            runs[begin:] += 1
            largest[begin:] = np.maximum.accumulate(stamps[begin:])
    return runs


def _is_reset(before: Stamps, after: Stamps, top: int, period: float) -> bool:
    """Whether a clock was set back, and messages were not merely late.

    `before` and `after` the step (N,) and (M,) [ns]; `top` is the largest stamp before it.
    """
    first = after[:_FEWEST_AFTER_RESET]
    if len(first) < _FEWEST_AFTER_RESET or np.any(first > top):
        return False
    start = int(after[0])
    passing = np.flatnonzero(after > top)
    never_passes = not len(passing)
    catching_up = after if never_passes else after[: passing[0]]
    above = int(np.count_nonzero(before >= start))
    if above < _FEWEST_AFTER_RESET:
        return False
    found = above + int(np.count_nonzero(catching_up >= start))
    expected = (top - start) / period + 1.0
    # Late messages fill a gap; after a jump over all that was recorded most of the time is empty.
    is_empty = never_passes and found < expected / _COVERED_TWICE
    is_covered_twice = found > _COVERED_TWICE * expected
    return is_empty or is_covered_twice


def reading_times(stamps: Stamps, topics: NDArray[np.int64], sensors: Sequence[int]) -> Stamps:
    """Times (N,) [ns] in whose order messages are read: their stamps, unless a clock was set back.

    `stamps` (N,) [ns] and `topics` (N,), the number of the topic of each, are in the order of the
    file. `sensors` are the numbers of the topics whose clocks decide.
    """
    times = stamps.copy()
    runs = np.zeros(len(stamps), dtype=np.int64)
    by_topic = {int(topic): np.flatnonzero(topics == topic) for topic in np.unique(topics)}
    for rows in by_topic.values():
        runs[rows] = clock_runs(stamps[rows])
    last_rows = [by_topic[topic][-1] for topic in sensors if topic in by_topic]
    resets = {int(run) for run in runs[last_rows]}
    if len(resets) == 1:
        # All clocks were set back equally often, mostly never: one run is read after the other.
        of_sensors = np.isin(topics, list(sensors))
        for run in range(1, resets.pop() + 1):
            before = runs == run - 1
            here = runs == run
            end = times[of_sensors & before].max()
            begin = times[of_sensors & here].min()
            times[here] += end + _BETWEEN_RUNS_NS - begin
    else:
        # A sensor alone was set back: its messages keep the order of the file.
        for rows in by_topic.values():
            was_set_back = runs[rows[-1]] > 0
            if was_set_back:
                times[rows] = np.maximum.accumulate(times[rows])
    return times
