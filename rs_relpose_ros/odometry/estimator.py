"""Metric odometry from pairs and IMU samples, keyframe by keyframe; free of ROS.

The same live and offline: the result depends on pairs and samples, not on the order of their
arrival within `_LATE_NS`.
"""

from collections import Counter, deque
from collections.abc import Iterable
from dataclasses import dataclass, field, replace
import math
from typing import NamedTuple

import numpy as np

from rs_relpose_ros.config.settings import Parameters
from rs_relpose_ros.errors import InputError
from rs_relpose_ros.geometry import Array
from rs_relpose_ros.geometry.so3 import exp_so3, heading, skew, STANDARD_GRAVITY
from rs_relpose_ros.geometry.timing import NANOSECONDS, seconds_between, to_nanoseconds
from rs_relpose_ros.imu.buffer import Coverage, ImuInterval, ImuSample, ImuSamples
from rs_relpose_ros.messages.incoming import StuckGyro
from rs_relpose_ros.odometry.graph import (
    ARM,
    GraphError,
    GYRO_BIAS,
    KeyframeGraph,
    KeyframeState,
    Loop,
    POSE,
    VELOCITY,
)
from rs_relpose_ros.odometry.pair import KeyframePair
from rs_relpose_ros.odometry.states import (
    Base,
    Notice,
    Odometry,
    OdometryState,
    StartReport,
    StateInterval,
)
from rs_relpose_ros.pipeline import findings_text
from rs_relpose_ros.pipeline.findings import Code

# Largest delay of a message.
_LATE_NS = 100_000_000
# Consecutive samples later than that of a clock that was set back.
_SET_BACK = 5
# Number of waiting pairs beyond which all but the newest are left out: the IMU bridges them at the
# cost of one, so that a slow machine keeps up.
_MOST_WAITING = 10
# Age of a usable pair [s] from which one is missing where no frame arrives, or where pairs have no
# information; without knowledge of the frames, in intervals of recent pairs. Delay of a pair that
# is due [s]; period of the test [ns].
_OVERDUE, _OVERDUE_INTERVALS, _PAIR_DELAY, _WATCH_NS = 0.25, 1.5, 0.1, 50_000_000
# Frame intervals without a frame after which the camera is silent.
_SILENT_FRAMES = 3
# Time in which the deviations of pairs are averaged [ns].
_RECENT_NS = 1_000_000_000
# Times within this belong to one keyframe: a tracked readout time moves the middle row.
_SAME_NS = 1_000_000
# Samples that determine gravity at a start [s].
_GRAVITY_WINDOW = 1.0
# 1 sigma of that direction for a moving body [rad].
_MOVING_TILT = 0.1
# Least 1 sigma of the accelerometer's bias [m/s^2]: factory calibration leaves 0.2 to 0.4.
_ACCEL_BIAS = 0.3
# 1 sigma of the velocity at a start at rest and in motion [m/s], per axis; of its free heading and
# position [rad, m].
_REST_VELOCITY, _ANY_VELOCITY, _GAUGE_SIGMA = 0.01, 3.0, 1e-4
# Largest 1 sigma of the logarithm of a baseline that starts a graph, and the initial speed without
# one [m/s]: pairs of a global shutter have no baseline.
_START_LOG_SIGMA, _GUESSED_SPEED = 0.7, 1.0
# Variance of pairs by that of each alone: consecutive ones share tracks, whose errors persist, and
# loops share images (docs/lab/odometry.md).
_SHARED = 2.5
# Innovation of a contradicting pair, in units of recent ones, and chi squared per degree of
# freedom of a wrong start; of one of its pairs, in units of that.
_CONTRADICTING, _WRONG_START, _GROSS = 4.0, 3.0, 5.0
# Number of wrong starts in motion, or of contradicting pairs after a start, after which rest is no
# start; of pairs that agree after it, in motion, after which axes of the IMU are not in doubt.
_WRONG_STARTS, _PROVEN = 3, 20
_CONTRADICTION = (
    'pairs and IMU contradict each other: are relpose_node/pairs and imu of one '
    'camera, and quat_cam_imu_xyzw and imu_position those of this IMU?'
)
# Longest propagation of a lost path by the IMU, and delay of pairs or samples behind others [s].
_LONGEST_PROPAGATED, _LONGEST_DELAY = 10.0, 10.0
# Longest start [s]; then a new one begins.
_LONGEST_START = 8.0
_GAP = 'the IMU has a gap, or its clock jumped: see its driver'
# 1 sigma of an unknown acceleration [m/s^2] and rate [rad/s], of a body whose IMU had a gap.
_UNKNOWN_ACCELERATION, _UNKNOWN_RATE = 3.0, 1.0
# Time for which a body has moved until the next start, if the clock was set back [s].
_UNKNOWN_TIME = 1.0
# 1 sigma of the position of the IMU if none is configured, and the least one [m].
_UNKNOWN_ARM, _LEAST_ARM_SIGMA = 0.15, 1e-4
# Noise of a single sample of the gyro in units of its density [sqrt(Hz)].
_RATE_NOISE = 10.0
# Fewest pairs that determine the scale of a start in motion.
_LEAST_PAIRS = 4


class _PathEnd(NamedTuple):
    """End of a path: rotation of the body (None: any heading), position [m], sigmas."""

    R: Array | None
    position: Array
    heading_sigma: float
    position_sigma: float


@dataclass(slots=True, eq=False)
class _Run:
    """A graph since its start."""

    graph: KeyframeGraph
    path_end: _PathEnd  # of the path before
    at_rest: bool
    first_ns: int
    observed_ns: int  # of the newest pair that was used
    # Times of the newest keyframe, or with `keep` of all: camera clock, IMU clock.
    stamps: deque[tuple[int, int]]
    frame_id: str
    # Variances of position and heading at the newest pair that was used.
    variances: tuple[float, float] = (0.0, 0.0)
    # Of recent pairs: times, innovations (chi squared by degrees of freedom) and intervals [s].
    recent: deque[tuple[int, float, float]] = field(default_factory=lambda: deque(maxlen=20))
    pairs: int = 0  # used
    largest: float = 0.0  # innovation before the start
    contradicting: int = 0  # not used
    confirmed: int = 0  # since the start, by so many pairs in motion
    published: bool = False
    path: int = 0  # number of earlier starts

    @property
    def newest_ns(self) -> int:
        """Time of the newest keyframe on the IMU clock."""
        return self.stamps[-1][1]


class OdometryEstimator:
    """Turns samples and pairs into keyframes, which `take` returns.

    `keep`: whether all of them are kept for `smoothed`.
    """

    def __init__(self, parameters: Parameters, *, keep: bool = False) -> None:
        self._config, self._imu = parameters.odometry, parameters.imu
        lever, sigma = np.array(parameters.imu.imu_position), parameters.imu.imu_position_sigma
        self._R_cam_body = parameters.sensor.R_cam_imu
        # Position of the camera on the body with its covariance, as known at the next start.
        self._arm = -self._R_cam_body.T @ lever
        self._arm_covariance = max(
            sigma, _LEAST_ARM_SIGMA if lever.any() else _UNKNOWN_ARM
        ) ** 2 * np.eye(3)
        self._first_R: Array | None = None  # of the body at the first start: the origin
        # None until it is known.
        self.base = (
            Base()
            if not self._config.base_frame
            else None
            if self._config.base_to_camera is None
            else Base.of(self._config.base_frame, self._config.base_to_camera)
        )
        self._samples = ImuSamples(parameters.imu.max_imu_gap)
        self._gyro = StuckGyro(parameters.imu.stuck_gyro_time)
        self._keep = keep
        self._camera = ''  # frame_id of the pairs
        self._waiting: dict[int, KeyframePair] = {}
        self._run: _Run | None = None
        self._last_run: _Run | None = None  # its end is the start of the next path
        self._runs: list[_Run] = []
        self._last_ns: int | None = None
        self._wrong_starts = 0  # since the last right one in motion
        self._behind = 0  # consecutive samples that came too late
        self._row_ns = 0  # from the stamped to the middle row
        self._offset_ns = self._watched_ns = 0  # of the camera's clock from that of the IMU
        # Of the newest frame: its stamp, arrival in IMU time and interval; of the newest pair that
        # could not be used: its time.
        self._frame_ns = self._arrived_ns = self._frame_interval_ns = self._unusable_ns = 0
        self._longest_interval = parameters.keyframes.max_keyframe_interval
        self.state, self.reason = OdometryState.STARTING, 'no pair with a pose yet'
        self.intervals: list[StateInterval] = []  # with `keep`
        self._corrections = 0  # number of changes to the newest keyframe
        self.starts: list[StartReport] = []
        # Numbers of pairs and runs by outcome.
        self.counts: Counter[str] = Counter()
        self._warnings: list[Notice] = []
        if not lever.any():
            text = (
                f'imu_position is zero: it is estimated, from {_UNKNOWN_ARM} m of uncertainty; '
                'a measured one is better'
            )
            self._warnings.append(Notice(text))

    @property
    def waiting(self) -> bool:
        """Whether a pair waits for samples."""
        return bool(self._waiting)

    @property
    def newest_ns(self) -> int:
        """Time up to which both sensors of the IMU are known, on its clock; 0 without samples."""
        return self._samples.both_until_ns or 0

    @property
    def blocking_reason(self) -> str:
        """Unknown base, or fault or contradiction that prevents a start; empty for none."""
        if self.base is None:
            return (
                f'the camera is not known in base_frame {self._config.base_frame}: publish '
                'their static transform on /tf_static (tf2_ros reads it), or set '
                'base_to_camera'
            )
        if self.state is not OdometryState.STARTING:
            return ''
        return self._samples.fault or (
            _CONTRADICTION if self._wrong_starts >= _WRONG_STARTS else ''
        )

    def add_imu(self, sample: ImuSample) -> None:
        """Add a sample; InputError for a stuck gyro."""
        newest = self._samples.both_until_ns
        self._behind = (
            self._behind + 1 if newest is not None and sample.stamp_ns < newest - _LATE_NS else 0
        )
        if newest is not None and self._behind == _SET_BACK:
            self._end('the clock of the IMU was set back', newest)
            self._behind = self._watched_ns = 0
            self._samples.clear()
            self._waiting, self._last_ns = {}, None
        elif self._behind:
            return  # too late for any pair
        if not self._gyro.repeats(sample):
            self._samples.add(sample)
        if sample.stamp_ns >= self._watched_ns + _WATCH_NS:
            self._watched_ns = sample.stamp_ns
            self._samples.prune(
                sample.stamp_ns
                - to_nanoseconds(max(_LONGEST_PROPAGATED, self._config.max_coast) + _LONGEST_DELAY)
            )
            try:
                self._watch(sample.stamp_ns)
            except GraphError as error:
                self._end(str(error), sample.stamp_ns)

    def imu_is_silent(self, seconds: float) -> None:
        """Tell that no sample has come for some time; the next ones decide whether it is a gap."""
        run = self._run
        if run is not None and run.published:
            self._change(
                OdometryState.LOST, f'no message of the IMU for {seconds:.2f} s', self._watched_ns
            )

    def add_frame(self, stamp_ns: int) -> None:
        """Tell that a frame has arrived: pairs are due then, or missing if none arrives."""
        self._frame_ns, self._frame_interval_ns = stamp_ns, max(stamp_ns - self._frame_ns, 0)
        self._arrived_ns = self._samples.newest_ns or 0

    def add_pair(self, pair: KeyframePair) -> None:
        """Add a pair; one without information is only counted.

        InputError for another camera, and for another clock than that of the samples.
        """
        self._camera = self._camera or pair.frame_id
        if pair.frame_id != self._camera:
            raise InputError(
                f'a pair of {pair.frame_id} is not used, as the first was of '
                f'{self._camera}: remap relpose_node/pairs to those of one camera; '
                '~/reset accepts another one'
            )
        self.counts['pairs'] += 1
        newest_ns = self._samples.both_until_ns
        if newest_ns is not None:
            late = seconds_between(pair.current_ns, newest_ns)
            if abs(late) > _LONGEST_DELAY:
                self.counts['late'] += 1
                raise InputError(
                    'a pair is not used, as its times differ by '
                    f'{abs(late):.0f} s from those of the newest samples: camera and '
                    'IMU must have one clock; was one of them set?'
                )
        if pair.images is None and not pair.contradiction:
            self.counts['without images'] += 1
            self._unusable_ns = pair.current_ns
            return
        if pair.images is not None:
            self._row_ns = pair.row_ns
        # Keyframes are at the middle rows, also for pairs without information.
        pair = pair.later(self._row_ns).without_far_velocities()
        if self._last_ns is not None and pair.current_ns <= self._last_ns:
            self.counts['late'] += 1
            return
        self._waiting[pair.current_ns] = pair
        if len(self._waiting) > _MOST_WAITING:
            self.counts['dropped'] += _MOST_WAITING
            newest = max(self._waiting)
            self._waiting = {newest: self._waiting[newest]}

    def reset(self) -> None:
        """Forget the path: the next start is at the origin."""
        self._run = self._last_run = self._first_R = None
        self._waiting, self._camera = {}, ''
        self._change(OdometryState.STARTING, 'reset', self._watched_ns)

    def warnings(self) -> list[Notice]:
        """Messages for the log since the last call."""
        warnings, self._warnings = self._warnings, []
        return warnings

    def take(self, *, end: bool = False, most: int | None = None) -> list[Odometry]:
        """Finished keyframes, of at most `most` pairs; with `end`, no more input follows."""
        out: list[Odometry] = []
        for _ in range(len(self._waiting) if most is None else min(most, len(self._waiting))):
            pair = self._waiting[min(self._waiting)]
            if not (end or self._ready(pair)):
                break
            del self._waiting[pair.current_ns]
            self._last_ns = pair.current_ns
            try:
                found = self._process(pair)
            except GraphError as error:
                found = None
                self._end(str(error), pair.current_ns)
            if found is not None:
                out.append(found)
        return out

    def propagated(self, imu_ns: int) -> Odometry | None:
        """The newest keyframe propagated by the IMU to a time; None without one."""
        run = self._run
        if run is None or not run.published or self.state is OdometryState.LOST:
            return None
        interval = self._samples.between(run.newest_ns, imu_ns)
        if interval is None:
            return None
        stamp_ns = run.stamps[-1][0] + imu_ns - run.newest_ns
        return self._odometry(
            run, run.graph.propagated(interval), interval.rates[-1], stamp_ns, imu_ns
        )

    def smoothed(self) -> list[Odometry]:
        """All keyframes, given all measurements; needs `keep`."""
        return [keyframe for path in self.smoothed_paths() for _, keyframe in path]

    def smoothed_paths(self) -> list[list[tuple[KeyframeState, Odometry]]]:
        """The same with the states of the body, a list for each start.

        A run with an unsolvable graph is left out, with a warning.
        """
        out = []
        for run in self._runs:
            try:
                states = run.graph.smoothed()
            except GraphError as error:
                self._warnings.append(
                    Notice(f'not smoothed: {len(run.stamps)} keyframes: {error}')
                )
                continue
            out.append(
                [
                    (state, self._odometry(run, state, np.full(3, math.nan), *stamps))
                    for state, stamps in zip(states, run.stamps, strict=True)
                ]
            )
        return out

    def close_loops(self, pairs: Iterable[KeyframePair]) -> list[KeyframePair]:
        """Add pairs of keyframes far apart in time to what is smoothed; needs `keep`.

        Returns those that agree with the path and count, at their middle rows. Pairs of two runs
        do not.
        """
        loops = [loop for pair in pairs if (loop := pair.as_loop(_SHARED)) is not None]
        taken: list[KeyframePair] = []
        for run in self._runs:
            numbers = {imu_ns: k for k, (_, imu_ns) in enumerate(run.stamps)}
            try:
                taken += [
                    loop.pair
                    for loop in run.graph.add_loops(
                        [
                            Loop(numbers[pair.reference_ns], numbers[pair.current_ns], pair)
                            for pair in loops
                            if {pair.reference_ns, pair.current_ns} <= numbers.keys()
                        ]
                    )
                ]
            except GraphError as error:
                text = f'loops of {len(run.stamps)} keyframes not added: {error}'
                self._warnings.append(Notice(text))
        return taken

    # -- pairs -------------------------------------------------------------------------------

    def _ready(self, pair: KeyframePair) -> bool:
        """Whether no late sample can change the outcome of a pair."""
        newest = self._samples.both_until_ns
        if newest is None or newest < pair.current_ns:
            return False
        if newest >= pair.current_ns + _LATE_NS:
            return True
        return (
            self._run is not None
            and abs(pair.reference_ns - self._run.newest_ns) < _SAME_NS
            and self._samples.complete(pair.reference_ns, pair.current_ns)
        )

    def _process(self, pair: KeyframePair) -> Odometry | None:
        self._offset_ns = pair.stamp_ns - pair.current_ns
        # Pairs that are wrong together, as of a moving object, do not disprove axes.
        proven = self._run is not None and self._run.confirmed >= _PROVEN
        contradiction = pair.contradiction
        if contradiction and not (proven and contradiction.code is Code.ACCEL_AXES):
            reason = findings_text.item(contradiction)
            self._end(reason, pair.current_ns)
            self._change(OdometryState.LOST, reason, pair.current_ns)
            self.counts['calibration contradicted'] += 1
            return None
        if pair.images is None:
            self._unusable_ns = pair.current_ns
            return None
        if self._run is not None and pair.reference_ns < self._run.newest_ns - _SAME_NS:
            self.counts['late'] += 1  # the IMU bridges it
            return None
        run = self._continued(pair)
        if run is None:
            run = self._run = self._new_run(pair)
        if run is None:
            return None
        interval = self._samples.between(run.newest_ns, pair.current_ns)
        if interval is None:
            self._end(_GAP, pair.current_ns)
            return None
        at_rest = pair.is_pure_rotation and interval.at_rest
        # Pairs that deviate together are wrong together: their covariance is too small by that.
        recent = [
            innovation
            for at_ns, innovation, _ in run.recent
            if at_ns > pair.current_ns - _RECENT_NS
        ]
        inflation = max(1.0, float(np.mean(recent or [1.0])))
        # The gyro predicts a rotation before the scale is known.
        gate = inflation * _CONTRADICTING if run.published or pair.is_pure_rotation else math.inf
        innovation = run.graph.add(
            interval, pair, at_rest, inflation=_SHARED * inflation, gate=gate
        )
        run.stamps.append((pair.stamp_ns, pair.current_ns))
        run.recent.append((pair.current_ns, min(innovation, _CONTRADICTING), interval.duration))
        if innovation > gate:
            self._corrections += 1
            self._reject(run, pair)
            if self._run is None:
                return None
        else:
            run.observed_ns, run.pairs = pair.current_ns, run.pairs + 1
            run.largest = max(run.largest, innovation)
            run.confirmed += run.published and pair.has_direction
            run.variances = _variances(run.graph.newest)
            if run.published:
                self._change(OdometryState.TRACKING, '', pair.current_ns)
        if not run.published and not self._known(run):
            return None
        self._corrections += 1
        return self._odometry(
            run, run.graph.newest, interval.rates[-1], pair.stamp_ns, pair.current_ns
        )

    def _reject(self, run: _Run, pair: KeyframePair) -> None:
        """Count a pair that contradicts the path, which ends if too many do."""
        self.counts['contradicting'] += 1
        self._unusable_ns = pair.current_ns
        run.contradicting += 1
        if not run.published:
            self._count_wrong_start()
        elif not run.confirmed and run.contradicting == _WRONG_STARTS:
            self._wrong_starts = _WRONG_STARTS
            self._end(_CONTRADICTION, pair.current_ns)
        elif seconds_between(run.observed_ns, pair.current_ns) > self._config.max_coast:
            self._end(f'no usable pair for {self._config.max_coast:g} s', pair.current_ns)

    def _continued(self, pair: KeyframePair) -> _Run | None:
        """The run with a keyframe at the pair's reference; None if it has ended."""
        run = self._run
        if run is None or abs(run.newest_ns - pair.reference_ns) < _SAME_NS:
            return run
        if seconds_between(run.observed_ns, pair.reference_ns) > self._config.max_coast:
            self._end(f'no usable pair for {self._config.max_coast:g} s', pair.reference_ns)
            return None
        interval = self._samples.between(run.newest_ns, pair.reference_ns)
        if interval is None:
            self._end(_GAP, pair.reference_ns)
            return None
        # A pair is missing: the IMU bridges it.
        run.graph.add(interval, None, at_rest=False)
        offset = pair.current_ns - pair.stamp_ns
        run.stamps.append((pair.reference_ns - offset, pair.reference_ns))
        return run

    def _watch(self, imu_ns: int) -> None:
        """Change the state where pairs are overdue, sigmas have grown or samples are missing."""
        run = self._run
        if run is None or not run.published:
            return
        until_ns = imu_ns - _LATE_NS
        if until_ns > run.newest_ns and any(
            series.coverage(run.newest_ns, until_ns) is Coverage.NEVER
            for series in (self._samples.gyro, self._samples.force)
        ):
            self._end(_GAP, imu_ns)
            return
        age = seconds_between(run.observed_ns, imu_ns)
        if age <= self._due(run, imu_ns):
            return
        self._change(OdometryState.UNCERTAIN, f'no usable pair for {age:.2f} s', imu_ns)
        interval = self._samples.between(run.newest_ns, until_ns)
        if interval is None or any(due_ns <= imu_ns for due_ns in self._waiting):
            return
        if age > self._config.max_coast:
            self._end(f'no usable pair for {self._config.max_coast:g} s', imu_ns)
            return
        now = _variances(run.graph.propagated(interval))
        position, heading = (
            math.sqrt(max(new - old, 0.0)) for new, old in zip(now, run.variances, strict=True)
        )
        if position > self._config.max_position_sigma:
            self._end(f'the position is known to {position:.2f} m', imu_ns)
        elif heading > self._config.max_heading_sigma:
            self._end(f'the heading is known to {heading:.2f} rad', imu_ns)

    def _due(self, run: _Run, imu_ns: int) -> float:
        """Age of the newest usable pair [s] up to which the next one is not missing."""
        silent_ns = imu_ns - self._arrived_ns
        if self._unusable_ns > run.observed_ns:
            return _OVERDUE
        if 0 < self._frame_interval_ns < NANOSECONDS:  # of a topic with each frame
            silent = silent_ns > _SILENT_FRAMES * self._frame_interval_ns
            return _OVERDUE if silent else self._longest_interval + _PAIR_DELAY
        usual = max((seconds for *_, seconds in run.recent), default=0.0)
        return max(_OVERDUE, _OVERDUE_INTERVALS * usual)

    # -- start and end -----------------------------------------------------------------------

    def _new_run(self, pair: KeyframePair) -> _Run | None:
        """A run that starts at the pair's reference; None if the pair cannot start one."""
        interval = self._samples.between(pair.reference_ns, pair.current_ns)
        before = self._samples.up_to(pair.reference_ns, _GRAVITY_WINDOW)
        if pair.images is None or interval is None or self.base is None:
            return None
        at_rest = pair.is_pure_rotation and interval.at_rest
        if self._wrong_starts >= _WRONG_STARTS if at_rest else not pair.has_direction:
            return None
        moving = (
            pair.baseline * pair.images.velocities[:3]
            if pair.baseline_log_sigma < _START_LOG_SIGMA
            else _GUESSED_SPEED * pair.images.t
        )
        bias = np.where(np.isfinite(pair.gyro_bias), pair.gyro_bias, self._imu.gyro_bias)
        rate = interval.rates[0] - bias
        if at_rest or before is None or before.duration < interval.duration:
            # Rotated back by the gyro over the interval.
            back = ImuInterval(interval.seconds, -interval.rates[::-1], interval.forces[::-1])
            force = back.mean_force(-bias)
        else:
            force = before.mean_force(bias)
        path_end = self._path_end_at(pair.reference_ns)
        C = self._R_cam_body
        R = _levelled(force, path_end, self.base.R @ C if self.base.frame_id else np.eye(3))
        velocity = np.zeros(3) if at_rest else R @ (C.T @ moving - np.cross(rate, self._arm))
        of_bias = max(self._imu.accel_bias_sigma, _ACCEL_BIAS)
        tilt = of_bias / STANDARD_GRAVITY if at_rest else _MOVING_TILT
        covariance = np.diag(
            np.square(
                [_GAUGE_SIGMA] * 6
                + [_REST_VELOCITY if at_rest else _ANY_VELOCITY] * 3
                + [of_bias] * 3
                + [self._imu.gyro_bias_sigma] * 3
                + [0.0] * 3
            )
        )
        covariance[:3, :3] = R.T @ np.diag(np.square([tilt, tilt, _GAUGE_SIGMA])) @ R
        covariance[ARM, ARM] = self._arm_covariance
        start = KeyframeState(
            R, path_end.position, velocity, bias, np.zeros(3), self._arm, covariance
        )
        graph = KeyframeGraph(start, C, self._imu, self._config, keep=self._keep)
        self._first_R = R if self._first_R is None else self._first_R
        offset = pair.current_ns - pair.stamp_ns
        stamps = deque(
            [(pair.reference_ns - offset, pair.reference_ns)], maxlen=None if self._keep else 1
        )
        return _Run(
            graph,
            path_end,
            at_rest,
            pair.reference_ns,
            pair.reference_ns,
            stamps,
            self.base.frame_id or pair.frame_id,
        )

    def _path_end_at(self, imu_ns: int) -> _PathEnd:
        """End of the last path, propagated by the IMU to a time."""
        run = self._last_run
        if run is None:
            return _PathEnd(None, np.zeros(3), 0.0, 0.0)
        seconds, state = seconds_between(run.newest_ns, imu_ns), run.graph.newest
        interval = self._samples.between(run.newest_ns, imu_ns)
        # Uncertainty of earlier losses remains.
        earlier = run.path_end
        variance = (
            earlier.position_sigma**2
            + earlier.heading_sigma**2
            * float(((state.position - earlier.position)[:2] ** 2).sum())
            / 3.0
        )
        turned = moved = 0.0
        if interval is not None and seconds <= _LONGEST_PROPAGATED:
            state = run.graph.propagated(interval)
        elif abs(seconds) > _SAME_NS / NANOSECONDS:  # else the keyframe itself: no gap
            # On at the same velocity; for an unknown time if the clock was set back.
            way = max(seconds, 0.0) * state.velocity
            unknown = (
                0.0 if seconds > 0.0 else _UNKNOWN_TIME * float(np.linalg.norm(state.velocity))
            )
            seconds = seconds if seconds > 0.0 else _UNKNOWN_TIME
            turned = _UNKNOWN_RATE * seconds
            moved = 0.5 * _UNKNOWN_ACCELERATION * seconds**2 + unknown
            state = replace(state, position=state.position + way)
            variance += seconds**2 * float(np.trace(state.covariance[VELOCITY, VELOCITY])) / 3.0
        of_position, of_heading = _variances(state)
        return _PathEnd(
            state.R,
            state.position,
            min(math.hypot(earlier.heading_sigma, math.sqrt(of_heading), turned), math.pi),
            math.sqrt(variance + of_position / 3.0 + moved**2),
        )

    def _known(self, run: _Run) -> bool:
        """Whether the scale of a starting run is known."""
        seconds = seconds_between(run.first_ns, run.newest_ns)
        sigma = run.graph.scale_sigma()
        if self.state is OdometryState.STARTING and self._wrong_starts < _WRONG_STARTS:
            self.reason = (
                f'the speed is known to {100.0 * sigma:.0f} % of '
                f'{100.0 * self._config.max_scale_sigma:.0f} %: it needs motion that '
                'changes its speed, or standstill'
            )
        if run.at_rest or run.pairs >= _LEAST_PAIRS:
            if max(run.graph.misfit(), run.largest / _GROSS) > _WRONG_START:
                self._run = None
                self._count_wrong_start()
                return False
            if sigma < self._config.max_scale_sigma:
                run.published = True
                if not run.at_rest:
                    self._wrong_starts = 0
                self.starts.append(StartReport(run.at_rest, run.newest_ns, seconds, sigma))
                run.path = len(self.starts) - 1
                if self._keep:
                    self._runs.append(run)
                self._change(
                    OdometryState.TRACKING,
                    f'started {"at rest" if run.at_rest else "in motion"} after {seconds:.1f} s, '
                    f'the scale is known to {100.0 * sigma:.1f} %',
                    run.newest_ns,
                )
                return True
        if seconds > _LONGEST_START:
            self._run = None
        return False

    def _count_wrong_start(self) -> None:
        self._wrong_starts += 1
        if self._wrong_starts == _WRONG_STARTS:
            self.reason = _CONTRADICTION

    def _end(self, reason: str, imu_ns: int) -> None:
        """End the run; the next one continues from its end."""
        run, self._run = self._run, None
        if run is not None and run.published:
            self.counts['lost'] += 1
            self._last_run = run
            newest = run.graph.newest
            self._arm, self._arm_covariance = newest.arm, newest.covariance[ARM, ARM]
            self._change(OdometryState.LOST, reason, imu_ns)

    def _change(self, state: OdometryState, reason: str, imu_ns: int) -> None:
        """Enter a state; a message and an interval where it is another one."""
        self.reason = reason
        if state is self.state:
            return
        self.state = state
        text = f'{state.value}: {reason}' if reason else state.value
        self._warnings.append(Notice(text, state))
        at_ns = imu_ns + self._offset_ns
        if self._keep:
            if self.intervals:
                # Of a pair that is older than the samples by which the state before was entered.
                at_ns = max(at_ns, self.intervals[-1].begin_ns)
                self.intervals[-1] = self.intervals[-1]._replace(end_ns=at_ns)
            self.intervals.append(StateInterval(state, reason, at_ns, None))

    # -- results -----------------------------------------------------------------------------

    @property
    def imu_position(self) -> tuple[Array, Array]:
        """Position of the IMU in the camera frame with 1 sigma per axis [m], as estimated."""
        C, arm, covariance = self._R_cam_body, self._arm, self._arm_covariance
        if self._run is not None:
            newest = self._run.graph.newest
            arm, covariance = newest.arm, newest.covariance[ARM, ARM]
        return -C @ arm, np.sqrt(np.diag(C @ covariance @ C.T))

    def _odometry(
        self, run: _Run, state: KeyframeState, rate: Array, stamp_ns: int, imu_ns: int
    ) -> Odometry:
        base, first_R = self.base, self._first_R
        assert base is not None and first_R is not None
        # The base on the body, as the camera: its rotation and position.
        C = base.R @ self._R_cam_body
        c = state.arm - C.T @ base.position
        rate = rate - state.gyro_bias
        # It is at the origin at first: p + (R - R_first) c, in the world.
        to_world, to_twist = np.zeros((6, 18)), np.zeros((6, 18))
        to_world[:3, :3], to_world[:3, 3:6] = -state.R @ skew(c), state.R
        to_world[3:, :3], to_world[:3, ARM] = state.R, state.R - first_R
        R = state.R @ C.T
        to_twist[:3, :3], to_twist[:3, VELOCITY] = C @ skew(state.R.T @ state.velocity), R.T
        to_twist[:3, ARM] = C @ skew(rate)
        to_twist[:3, GYRO_BIAS], to_twist[3:, GYRO_BIAS] = C @ skew(c), -C
        by_rate = to_twist[:, GYRO_BIAS] * self._imu.gyro_noise_density * _RATE_NOISE
        velocity = to_twist @ state.covariance @ to_twist.T + by_rate @ by_rate.T
        # A later start has position and heading from the end of the path before.
        position, up = state.position + (state.R - first_R) @ c, np.array([0.0, 0.0, 1.0])
        by_heading = run.path_end.heading_sigma * np.concatenate(
            [skew(up) @ (state.position + state.R @ c - run.path_end.position), up]
        )
        covariance = to_world @ state.covariance @ to_world.T + np.outer(by_heading, by_heading)
        covariance[:3, :3] += run.path_end.position_sigma**2 * np.eye(3)
        return Odometry(
            stamp_ns,
            imu_ns,
            run.frame_id,
            run.path,
            self._corrections,
            R,
            position,
            covariance,
            R.T @ (state.velocity + state.R @ skew(rate) @ c),
            C @ rate,
            velocity,
        )


def _variances(state: KeyframeState) -> tuple[float, float]:
    """Variances of the position (its length) and of the heading."""
    up, covariance = state.R[2], state.covariance[POSE, POSE]
    return float(np.trace(covariance[3:, 3:])), float(up @ covariance[:3, :3] @ up)


def _levelled(force: Array, path_end: _PathEnd, axes: Array) -> Array:
    """Rotation (3, 3) from the body to the world, by the specific force at rest.

    `axes` (3, 3): from the body to the axes that keep their heading.
    """
    up = axes @ force / np.linalg.norm(force)
    # The smallest rotation that takes it upwards, then one about z to the last heading.
    turn = skew(np.cross(up, [0.0, 0.0, 1.0]))
    R = (
        np.eye(3) + turn + turn @ turn / (1.0 + up[2])
        if up[2] > -0.999
        else np.diag([1.0, -1.0, -1.0])
    )
    R = R @ axes
    if path_end.R is not None:
        R = exp_so3(heading(path_end.R @ R.T)) @ R
    return np.asarray(R)
