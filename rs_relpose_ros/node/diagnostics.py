"""What relpose_node tells of its pairs, besides what every node tells of its frames."""

from __future__ import annotations

from collections.abc import Callable
import time

from rs_relpose_ros.front_end.pair import PAIR_FIGURES, PairResult
from rs_relpose_ros.health.findings import HealthState, NOT_JUDGED
from rs_relpose_ros.node.frame_statistics import FrameStatistics, OK, WARN


class Statistics(FrameStatistics):
    """Figures of relpose_node; thread-safe. Tests give a `clock` of their own, monotonic [ns]."""

    idle = 'not estimating'

    def __init__(self, clock: Callable[[], int] = time.monotonic_ns) -> None:
        super().__init__(clock)
        self._pairs = self._poses = 0
        self._last_pair: PairResult | None = None
        self._last_pose: PairResult | None = None

    def add_pair(self, result: PairResult, ready_ns: int) -> None:
        """Count a pair right after its publication; all for it had come by `ready_ns`."""
        with self._lock:
            self._pairs += 1
            self._last_pair = result
            if result.pose:
                self._poses += 1
                self._last_pose = result
                self._published(ready_ns)
            else:
                self._last_failure = f'{result.pose.status.value}: {result.pose.reason}'

    def _told_wrong(self) -> str:
        last = self._last_pair
        faults = () if last is None else last.health.faults
        return faults[0].text if faults and faults[0].state is HealthState.WRONG else ''

    def _judge_results(self) -> tuple[int, str]:
        last = self._last_pair
        if last is None:
            return OK, 'no keyframe pair yet'
        if last.health.faults:
            return WARN, last.health.faults[0].text
        if not last.pose:
            return WARN, f'no pose of the last pair: {self._last_failure}'
        return OK, f'estimating: {self._poses} poses of {self._pairs} pairs'

    def _values(self) -> tuple[tuple[str, str], ...]:
        last, pose = self._last_pair, self._last_pose
        return (('pairs', str(self._pairs)),
                ('poses', str(self._poses)),
                *((figure.name, figure.text(last)) for figure in PAIR_FIGURES),
                ('model', pose.pose.model if pose else ''),
                *_tracked_values(last),
                *_health_values(last))

    def _last_values(self) -> tuple[tuple[str, str], ...]:
        return (('last_reason_no_pose', self._last_failure),)


def _tracked_values(last: PairResult | None) -> tuple[tuple[str, str], ...]:
    """Bias, time offset and read-out as tracked; to be compared with the parameters."""
    names = ('tracked_gyro_bias_rad_s', 'tracked_gyro_bias_sigma_rad_s', 'tracked_time_offset_ms',
             'tracked_time_offset_sigma_ms', 'applied_time_offset_ms', 'tracked_readout_time_ms',
             'tracked_readout_time_sigma_ms', 'applied_readout_time_ms')
    if last is None or last.tracked is None or not last.tracked.pairs:
        return tuple((name, '') for name in names)
    seen = last.tracked
    texts = (' '.join(f'{value:.5f}' for value in seen.gyro_bias),
             ' '.join(f'{value:.5f}' for value in seen.gyro_bias_sigma),
             *(f'{1e3 * seconds:.2f}' for seconds in (
                 seen.time_offset, seen.time_offset_sigma, last.applied.time_offset,
                 seen.readout_time, seen.readout_time_sigma, last.applied.readout_time)))
    return tuple(zip(names, texts, strict=True))


def _health_values(last: PairResult | None) -> tuple[tuple[str, str], ...]:
    """State of what was told, and a sentence for each figure."""
    health = NOT_JUDGED if last is None else last.health
    return ('health', health.state.value), ('health_findings', health.text)
