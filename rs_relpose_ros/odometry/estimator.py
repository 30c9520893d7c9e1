"""Metric odometry from pairs and IMU samples, keyframe by keyframe; free of ROS.

The same live and offline: the result depends on pairs and samples, not on the order of their
arrival within `LATE_NS`.
"""

from collections import Counter, deque
from collections.abc import Iterable
from dataclasses import dataclass, field
import math

import numpy as np

from rs_relpose_ros.calibration import findings_text
from rs_relpose_ros.calibration.findings import Code, Finding
from rs_relpose_ros.config.settings import Parameters
from rs_relpose_ros.errors import InputError
from rs_relpose_ros.geometry import Array
from rs_relpose_ros.geometry.timing import NANOSECONDS, seconds_between, to_nanoseconds
from rs_relpose_ros.imu.buffer import Coverage, ImuInterval, ImuSample, ImuSamples
from rs_relpose_ros.messages.burst_times import SampleTimes
from rs_relpose_ros.messages.incoming import StuckGyro
from rs_relpose_ros.messages.published_pair import PublishedPair
from rs_relpose_ros.messages.streams import SensorRate
from rs_relpose_ros.odometry.doubts import Doubts, UNKNOWN_ARM
from rs_relpose_ros.odometry.graph import (
    DOUBTS,
    GraphError,
    KeyframeGraph,
    KeyframeState,
    Loop,
)
from rs_relpose_ros.odometry.interruptions import (
    acceleration,
    after_unknown_time,
    first_gap,
    Interruption,
    LATE_NS,
    LONGEST_UNKNOWN,
    SampleOrder,
)
from rs_relpose_ros.odometry.noise import knock_finding, knock_peak
from rs_relpose_ros.odometry.pair import (
    as_loop,
    contradiction,
    later,
    row_ns,
    without_far_velocities,
)
from rs_relpose_ros.odometry.publication import (
    at_unknown_time,
    Publication,
    Stamp,
    untested_scale,
)
from rs_relpose_ros.odometry.starts import (
    continued,
    end_of,
    end_without_samples,
    LONGEST_PROPAGATED,
    PathEnd,
    place_variances,
    start_state,
    Surroundings,
)
from rs_relpose_ros.odometry.states import (
    Base,
    Notice,
    Odometry,
    OdometryState,
    StartReport,
    StateInterval,
)

# Number of waiting pairs beyond which all but the newest are left out: the IMU bridges them at the
# cost of one, so that a slow machine keeps up. [chosen: 5 to 30 would do: 10 are a second or two]
_MOST_WAITING = 10
# Age of a usable pair from which one is missing [s], where no frame arrives or where pairs have no
# information. A larger one reports a stopped camera late.
# [measured: uncertain after 0.28 to 0.37 s, docs/lab/odometry.md, "Disturbances"]
_OVERDUE = 0.25
# The same in intervals of recent pairs, without knowledge of the frames: an interval may be half
# longer than the one before. [chosen: 1.3 to 2 would do]
_OVERDUE_INTERVALS = 1.5
# Delay of a pair that is due [s]: its processing by relpose_node, and the way here. A shorter one
# reports pairs of a busy machine as missing. [chosen: 0.05 to 0.2 s: two or three frames]
_PAIR_DELAY = 0.1
# Period in which overdue pairs are looked for [ns]: each costs a propagation.
# [chosen: a fifth of `_OVERDUE`]
_WATCH_NS = 50_000_000
# Frame intervals without a frame after which the camera is silent. [chosen: 2 to 5: single frames
# are dropped by any driver]
_SILENT_FRAMES = 3
# Most pairs whose intervals are remembered: an interval may be longer than the one before. Fewer
# would report missing pairs in slow motion. [chosen: 5 to 50, one to some seconds of pairs]
_MOST_RECENT = 20
# Times within this belong to one keyframe [ns]: a tracked readout time moves the middle row.
# [chosen: 0.3 to 5 ms: between a correction and half a frame interval]
_SAME_NS = 1_000_000
# Samples that determine gravity at a start [s]. Longer ones average over the acceleration of a
# hand, and the gyro integrates for longer. [chosen: 0.5 to 2 s: about a step of a walk]
_GRAVITY_WINDOW = 1.0
# Variance of pairs by that of each alone: consecutive ones share tracks, whose errors persist, and
# loops share images. With less, some states are beyond their covariances, with more all are too
# uncertain. [measured: docs/lab/odometry.md, "Thirty walks"]
_SHARED = 2.5
# Innovation of a contradicting pair (chi squared per degree of freedom). A larger gate uses pairs
# of moving objects, a smaller one rejects right ones: above 4 is one in 800 by chance with 5
# degrees of freedom, fewer with 11. [derived: chi squared]
_CONTRADICTING = 4.0
# Chi squared of a window per degree of freedom of a wrong start. It must be above that of a right
# one, which is 1 to 2 where noises are configured too small. [chosen: 2.5 to 4 would do]
_WRONG_START = 3.0
# The same of a single pair before the start, in units of that. [measured: there, gross pairs]
_GROSS = 5.0
# Number of wrong starts in motion, or of contradicting pairs after a start, after which rest is no
# start, and pairs and IMU are reported as not of one rig. One may be a moving object.
# [chosen: 2 to 5 would do]
_WRONG_STARTS = 3
# Number of pairs that agree after a start, in motion, after which axes of the IMU are not in
# doubt: pairs that are wrong together, as of a moving object, look like wrong axes. Until then
# images without translation hold the camera in its place even if the velocity contradicts them.
# [measured: docs/lab/odometry.md, "Disturbances": with 20 the object loses no path]
_PROVEN = 20
# Reason of a start that fails by its own data, for the status of the node.
_CONTRADICTION = (
    'pairs and IMU contradict each other: are relpose_node/pairs and imu of one '
    'camera, and quat_cam_imu_xyzw and imu_position those of this IMU?'
)
# Longest delay of pairs or samples behind others [s]: more are two clocks. [chosen: 5 to 60 s]
_LONGEST_DELAY = 10.0
# Longest start [s]; then a new one begins, without the pairs that were wrong. [chosen: 5 to 15 s]
_LONGEST_START = 8.0
# What to do about a graph that cannot be solved.
_UNSOLVED_FIX = (
    'check the sigmas and noise densities of the parameter file, and report it with the recording'
)
# 1 sigma of the step of a clock that may be the reason why images and gyro contradict each other
# [s]: the stamp of a state is unknown by it until a pair with the new offset is used. A smaller
# one would not cover steps of half a second, a larger one would say nothing of a state.
# [chosen: 0.1 to 0.2 s: three sigmas are the longest step that relpose_node looks for]
_UNKNOWN_STEP = 0.15
# Reason of a path that ends where samples of the IMU are missing.
_GAP = 'the IMU has a gap, or its clock jumped: see its driver'
# Fewest pairs that determine the scale of a start in motion. [derived: velocity, tilt and bias are
# nine unknowns, a pair has five equations; four pairs have some left to contradict]
_LEAST_PAIRS = 4


@dataclass(slots=True, eq=False)
class _Run:
    """A graph since its start."""

    graph: KeyframeGraph
    path_end: PathEnd  # of the path before
    continued: bool  # whether it starts at the propagated end of the path before
    at_rest: bool
    first_ns: int
    observed_ns: int  # of the newest pair that was used
    # Times of the newest keyframe, or with `keep` of all: camera clock, IMU clock.
    stamps: deque[tuple[int, int]]
    frame_id: str
    # Variances of position and heading at the newest pair that was used.
    variances: tuple[float, float] = (0.0, 0.0)
    # Intervals of recent pairs [s].
    intervals: deque[float] = field(default_factory=lambda: deque(maxlen=_MOST_RECENT))
    pairs: int = 0  # used
    # Pairs that have tested rig and noises against each other, also on the path it continues.
    tested: int = 0
    largest: float = 0.0  # innovation before the start
    contradicting: int = 0  # not used
    confirmed: int = 0  # since the start, by so many pairs in motion
    published: bool = False
    path: int = 0  # number of earlier starts
    # Of an ended one: from when on the samples continue its newest keyframe, if a short
    # interruption lies between; whether none do, as the clock was set.
    resumed_ns: int | None = None
    is_broken: bool = False

    @property
    def newest_ns(self) -> int:
        """Time of the newest keyframe on the IMU clock."""
        return self.stamps[-1][1]


class OdometryEstimator:
    """Turns samples and pairs into keyframes, which `take` returns.

    `keep`: whether all of them are kept for `smoothed`.
    """

    def __init__(
        self,
        parameters: Parameters,
        *,
        keep: bool = False,
    ) -> None:
        self._parameters, self._keep = parameters, keep
        self._configured = parameters
        # Times of the gyro's samples at 1, and of those of an accelerometer alone at 0.
        self._times = SampleTimes(), SampleTimes()
        self._offset_sigma = 0.0  # of the times [s], beyond the configured one
        self._config, self._imu = parameters.odometry, parameters.imu
        self._R_cam_body = parameters.sensor.R_cam_imu
        self._use_doubts(Doubts(parameters))
        self._first_R: Array | None = None  # of the body at the first start: the origin
        self.base: Base | None = Base()  # None until it is known
        if self._config.base_frame:
            place = self._config.base_to_camera
            self.base = None if place is None else Base.of(self._config.base_frame, place)
        self._samples = ImuSamples(parameters.imu.max_imu_gap)
        self._gyro = StuckGyro(parameters.imu.stuck_gyro_time)
        self._sensor_rate = SensorRate()
        self._camera = ''  # frame_id of the pairs
        self._waiting: dict[int, PublishedPair] = {}
        self._run: _Run | None = None
        self._last_run: _Run | None = None  # its end is the start of the next path
        self._end_is_known = False  # whether that end holds, propagated by the IMU
        self._runs: list[_Run] = []
        self._last_ns: int | None = None
        self._wrong_starts = 0  # since the last right one in motion
        # Of a sensor alone at 0, of samples with a gyro at 1.
        self._orders = SampleOrder(), SampleOrder()
        self._row_ns = 0  # from the stamped to the middle row
        self._offset_ns = 0  # of the camera's clock from that of the IMU
        self._watched_ns = 0  # time of the newest sample at which overdue pairs were looked for
        # Of the newest frame: its stamp, arrival in IMU time and interval.
        self._frame_ns = 0
        self._arrived_ns = 0
        self._frame_interval_ns = 0
        self._doubts_clocks = False  # whether a clock may have been set since the newest keyframe
        self._unusable_ns = 0  # time of the newest pair that could not be used
        self._longest_interval = parameters.keyframes.max_keyframe_interval
        self.state, self.reason = OdometryState.STARTING, 'no pair with a pose yet'
        self.intervals: list[StateInterval] = []  # with `keep`
        self._corrections = 0  # number of changes to the newest keyframe
        self.starts: list[StartReport] = []
        # Numbers of pairs and runs by outcome.
        self.counts: Counter[str] = Counter()
        self._findings: dict[Code, Finding] = {}
        self._unsolved = ''  # why the last start could not be solved
        self._warnings: list[Notice] = []
        if not self._doubts.arm_is_known:
            text = (
                f'imu_position is zero: it is estimated, from {UNKNOWN_ARM} m of uncertainty; '
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
        if self._unsolved:
            return f'{self._unsolved}; {_UNSOLVED_FIX}'
        return self._samples.fault or (
            _CONTRADICTION if self._wrong_starts >= _WRONG_STARTS else ''
        )

    @property
    def findings(self) -> tuple[Finding, ...]:
        """What pairs and samples show of the IMU: noises above the configured ones, knocks."""
        return tuple(self._findings.values())

    def add_imu(self, sample: ImuSample) -> None:
        """Add a sample; InputError for a stuck gyro."""
        has_gyro = sample.angular_velocity is not None
        times = self._times[has_gyro]
        timed = times.add(sample)
        if timed and times.corrects:
            times.corrects = False
            self._start_again('the samples of the IMU so far had the times of bursts')
        if timed and has_gyro and not times.doubt.common <= self._offset_sigma:
            self._doubt_offset(times.doubt.common)
        for one in timed:
            self._add_timed(one)

    def _start_again(self, reason: str) -> None:
        """End the path, and forget the samples so far."""
        newest = self._samples.both_until_ns
        if newest is not None:
            self._end(reason, newest)
        self._forget_samples()

    def _forget_samples(self) -> None:
        """Begin with other samples, on another clock."""
        self._watched_ns = 0
        for order in self._orders:
            order.clear()
        self._samples.clear()
        self._waiting, self._last_ns = {}, None

    def _doubt_offset(self, sigma: float) -> None:
        """Take the time offset as known to `sigma` [s] at best, for the paths that follow."""
        if self._run is not None:
            return  # its graph has the doubt of its start
        self._offset_sigma = sigma
        configured = self._configured.sensor.time_offset_sigma
        doubted = {'time_offset_sigma': math.hypot(configured, sigma)}
        self._parameters = self._configured.updated(doubted)
        self._use_doubts(Doubts(self._parameters))

    def _use_doubts(self, doubts: Doubts) -> None:
        """What is not known exactly about camera and IMU, as known at the next start."""
        self._doubts = doubts
        self._doubted = doubts.prior
        self._doubts_covariance = np.diag(np.square(doubts.prior_sigmas))

    def _add_timed(self, sample: ImuSample) -> None:
        """Add a sample that has its time."""
        order = self._orders[sample.angular_velocity is not None]
        samples, set_back = order.add(sample, self._samples)
        if set_back:
            self._set_back(samples[0].stamp_ns)
        for one in samples:
            self._add_in_order(one)

    def _set_back(self, next_ns: int) -> None:
        """Go on after the clock of the IMU was set back to a time."""
        reason = 'the clock of the IMU was set back'
        last_ns = self._samples.both_until_ns
        if last_ns is not None:
            run, gap = self._run, Interruption(last_ns, next_ns)
            try:
                # No samples are missing: hardly any time has passed.
                self._interrupt(gap, reason, last_ns, passed=0.0)
            except GraphError as error:
                self._fail(error, last_ns)
            if run is not None and run.resumed_ns is None:
                run.is_broken = True
        self._forget_samples()

    def _interrupt(
        self, gap: Interruption, reason: str, imu_ns: int, *, passed: float = 0.5
    ) -> None:
        """End the path; the next one continues after a short interruption.

        `passed`: expected share of its seconds.
        """
        run = self._run
        if run is None or not run.published or gap.seconds > LONGEST_UNKNOWN:
            self._end(reason, imu_ns)
            return
        interval = self._samples.between(run.newest_ns, gap.last_ns)
        if interval is not None:
            # The IMU leads to the last sample before it.
            run.graph.add(interval, None, at_rest=False)
            offset = run.stamps[-1][1] - run.stamps[-1][0]
            run.stamps.append((gap.last_ns - offset, gap.last_ns))
        before = run.graph.newest
        rate = self._samples.gyro.values[-1] - before.gyro_bias
        run.graph.restate(after_unknown_time(before, gap.seconds, rate, passed=passed))
        run.resumed_ns = gap.next_ns
        self._end(reason, imu_ns, known=True)

    def _add_in_order(self, sample: ImuSample) -> None:
        """Add a sample whose place is free."""
        newest = self._samples.both_until_ns
        if newest is not None and sample.stamp_ns < newest - LATE_NS:
            return  # for any pair
        self._watch_rate(sample)
        if not self._gyro.repeats(sample):
            self._samples.add(sample)
        if sample.stamp_ns < self._watched_ns + _WATCH_NS:
            return
        self._watched_ns = sample.stamp_ns
        kept = max(LONGEST_PROPAGATED, self._config.max_coast) + _LONGEST_DELAY
        self._samples.prune(sample.stamp_ns - to_nanoseconds(kept))
        try:
            self._watch(sample.stamp_ns)
        except GraphError as error:
            self._fail(error, sample.stamp_ns)

    def _watch_rate(self, sample: ImuSample) -> None:
        """Find out whether the driver multiplies samples, whose noise is then larger."""
        rates, known = sample.angular_velocity, self._sensor_rate
        if rates is not None and known.add(sample.stamp_ns, rates) and self._run is not None:
            self._run.graph.use_sensor_rate(known.factor, known.between)

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

    def add_pair(self, pair: PublishedPair) -> None:
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
            late = seconds_between(pair.current_imu_ns, newest_ns)
            if abs(late) > _LONGEST_DELAY:
                self.counts['late'] += 1
                raise InputError(
                    'a pair is not used, as its times differ by '
                    f'{abs(late):.0f} s from those of the newest samples: camera and '
                    'IMU must have one clock; was one of them set?'
                )
        if pair.images is None and contradiction(pair) is None:
            self.counts['without images'] += 1
            self._unusable_ns = pair.current_imu_ns
            self._doubts_clocks |= pair.contradicts_gyro
            return
        if pair.images is not None:
            self._row_ns = row_ns(pair)
        # Keyframes are at the middle rows, also for pairs without information.
        pair = without_far_velocities(later(pair, self._row_ns))
        if self._last_ns is not None and pair.current_imu_ns <= self._last_ns:
            self.counts['late'] += 1
            return
        self._waiting[pair.current_imu_ns] = pair
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

    def take(
        self,
        *,
        end: bool = False,
        most: int | None = None,
    ) -> list[Odometry]:
        """Finished keyframes, of at most `most` pairs; with `end`, no more input follows."""
        out: list[Odometry] = []
        while self._waiting and most != 0:
            pair = self._waiting[min(self._waiting)]
            if not (end or self._ready(pair)):
                break
            del self._waiting[pair.current_imu_ns]
            self._last_ns = pair.current_imu_ns
            try:
                found = self._process(pair)
            except GraphError as error:
                found = None
                self._fail(error, pair.current_imu_ns)
            if found is not None:
                out.append(found)
            most = None if most is None else most - 1
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
        state = run.graph.propagated(interval)
        found = self._publication(run).state(
            state, interval.rates[-1], self._stamp(run, stamp_ns, imu_ns)
        )
        if self._doubts_clocks:
            accelerated = acceleration(state.R, interval.forces[-1] - state.accel_bias)
            found = at_unknown_time(found, accelerated, interval.rates, _UNKNOWN_STEP)
        return found

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
                self.counts['not smoothed'] += 1
                text = f'not smoothed: {len(run.stamps)} keyframes: {error}; {_UNSOLVED_FIX}'
                self._warnings.append(Notice(text))
                continue
            publication = self._publication(run)
            unknown_rate = np.full(3, math.nan)
            path = []
            for state, stamps in zip(states, run.stamps, strict=True):
                stamp = self._stamp(run, *stamps)
                path.append((state, publication.state(state, unknown_rate, stamp)))
            out.append(path)
        return out

    def close_loops(self, pairs: Iterable[PublishedPair]) -> list[PublishedPair]:
        """Add pairs of keyframes far apart in time to what is smoothed; needs `keep`.

        Returns those that agree with the path and count, at their middle rows. Pairs of two runs
        do not.
        """
        loops = [as_loop(pair, _SHARED) for pair in pairs]
        taken: list[PublishedPair] = []
        for run in self._runs:
            numbers = {imu_ns: k for k, (_, imu_ns) in enumerate(run.stamps)}
            of_run = [
                Loop(numbers[pair.reference_imu_ns], numbers[pair.current_imu_ns], pair)
                for pair in loops
                if pair is not None
                and {pair.reference_imu_ns, pair.current_imu_ns} <= numbers.keys()
            ]
            try:
                taken += [loop.pair for loop in run.graph.add_loops(of_run)]
            except GraphError as error:
                text = f'loops of {len(run.stamps)} keyframes not added: {error}'
                self._warnings.append(Notice(text))
        return taken

    # -- pairs -------------------------------------------------------------------------------

    def _ready(self, pair: PublishedPair) -> bool:
        """Whether no late sample can change the outcome of a pair."""
        newest = self._samples.both_until_ns
        if newest is None or newest < pair.current_imu_ns:
            return False
        if newest >= pair.current_imu_ns + LATE_NS:
            return True
        return (
            self._run is not None
            and abs(pair.reference_imu_ns - self._run.newest_ns) < _SAME_NS
            and self._samples.complete(pair.reference_imu_ns, pair.current_imu_ns)
        )

    def _process(self, pair: PublishedPair) -> Odometry | None:
        self._offset_ns = pair.stamp_ns - pair.current_imu_ns
        if self._is_contradicted(pair):
            return None
        if pair.images is None:
            self._unusable_ns = pair.current_imu_ns
            return None
        if self._run is not None and pair.reference_imu_ns < self._run.newest_ns - _SAME_NS:
            self.counts['late'] += 1  # the IMU bridges it
            return None
        run = self._continued(pair)
        if run is None:
            run = self._run = self._new_run(pair)
        if run is None:
            return None
        interval = self._samples.between(run.newest_ns, pair.current_imu_ns)
        if interval is None:
            self._end_at_gap(run, pair.current_imu_ns)
            return None
        self._add(run, pair, interval)
        if self._run is None or not (run.published or self._known(run)):
            return None
        self._corrections += 1
        stamp = self._stamp(run, pair.stamp_ns, pair.current_imu_ns)
        return self._publication(run).state(run.graph.newest, interval.rates[-1], stamp)

    def _is_contradicted(self, pair: PublishedPair) -> bool:
        """Whether a finding on the calibration ends the path."""
        finding = contradiction(pair)
        if finding is None:
            return False
        # Pairs that are wrong together, as of a moving object, do not disprove axes.
        proven = self._run is not None and self._run.confirmed >= _PROVEN
        if proven and finding.code is Code.ACCEL_AXES:
            return False
        reason = findings_text.item(finding)
        self._end(reason, pair.current_imu_ns)
        self._change(OdometryState.LOST, reason, pair.current_imu_ns)
        self.counts['calibration contradicted'] += 1
        return True

    def _add(
        self,
        run: _Run,
        pair: PublishedPair,
        interval: ImuInterval,
    ) -> None:
        """Add a keyframe at the pair's current image, and the pair if it agrees with the path."""
        at_ns = pair.current_imu_ns
        # The gyro predicts a rotation before the scale is known.
        gated = run.published or run.continued or pair.is_pure_rotation
        gate = _CONTRADICTING if gated else math.inf
        at_rest = pair.is_pure_rotation and interval.at_rest
        innovation = run.graph.add(
            interval,
            pair,
            at_rest,
            inflation=_SHARED,
            gate=gate,
            proven=run.confirmed >= _PROVEN,
        )
        self._find(run, interval, at_ns)
        run.stamps.append((pair.stamp_ns, at_ns))
        run.intervals.append(interval.duration)
        if innovation > gate:
            self._corrections += 1
            self._reject(run, pair)
            return
        self._doubts_clocks = False
        run.observed_ns, run.pairs = at_ns, run.pairs + 1
        run.tested += 1
        run.largest = max(run.largest, innovation)
        run.confirmed += run.published and pair.has_direction
        run.variances = place_variances(run.graph.newest)
        if run.published:
            self._change(OdometryState.TRACKING, '', at_ns)

    def _reject(
        self,
        run: _Run,
        pair: PublishedPair,
    ) -> None:
        """Count a pair that contradicts the path, which ends if too many do."""
        self.counts['contradicting'] += 1
        self._unusable_ns = pair.current_imu_ns
        run.contradicting += 1
        if run.continued and not run.published:
            if run.contradicting == _WRONG_STARTS:
                self._forget_end()
        elif not run.published:
            self._count_wrong_start()
        elif not run.confirmed and run.contradicting == _WRONG_STARTS:
            self._wrong_starts = _WRONG_STARTS
            self._end(_CONTRADICTION, pair.current_imu_ns)
        elif seconds_between(run.observed_ns, pair.current_imu_ns) > self._config.max_coast:
            self._end(self._coasted, pair.current_imu_ns)

    def _continued(self, pair: PublishedPair) -> _Run | None:
        """The run with a keyframe at the pair's reference; None if it has ended."""
        run = self._run
        if run is None or abs(run.newest_ns - pair.reference_imu_ns) < _SAME_NS:
            return run
        if seconds_between(run.observed_ns, pair.reference_imu_ns) > self._config.max_coast:
            self._end(self._coasted, pair.reference_imu_ns, known=True)
            return None
        interval = self._samples.between(run.newest_ns, pair.reference_imu_ns)
        if interval is None:
            self._end_at_gap(run, pair.reference_imu_ns)
            return None
        # A pair is missing: the IMU bridges it.
        run.graph.add(interval, None, at_rest=False)
        offset = pair.current_imu_ns - pair.stamp_ns
        run.stamps.append((pair.reference_imu_ns - offset, pair.reference_imu_ns))
        return run

    def _watch(self, imu_ns: int) -> None:
        """Change the state where pairs are overdue, sigmas have grown or samples are missing."""
        run = self._run
        if run is None or not run.published:
            return
        until_ns = imu_ns - LATE_NS
        if until_ns > run.newest_ns and any(
            series.coverage(run.newest_ns, until_ns) is Coverage.NEVER
            for series in (self._samples.gyro, self._samples.force)
        ):
            self._end_at_gap(run, imu_ns)
            return
        age = seconds_between(run.observed_ns, imu_ns)
        if age <= self._due(run, imu_ns):
            return
        self._change(OdometryState.UNCERTAIN, f'no usable pair for {age:.2f} s', imu_ns)
        interval = self._samples.between(run.newest_ns, until_ns)
        if interval is None or any(due_ns <= imu_ns for due_ns in self._waiting):
            return
        if age > self._config.max_coast:
            self._end(self._coasted, imu_ns, known=True)
            return
        now = place_variances(run.graph.propagated(interval))
        position, heading = (
            math.sqrt(max(new - old, 0.0)) for new, old in zip(now, run.variances, strict=True)
        )
        if position > self._config.max_position_sigma:
            self._end(f'the position is known to {position:.2f} m', imu_ns, known=True)
        elif heading > self._config.max_heading_sigma:
            self._end(f'the heading is known to {heading:.2f} rad', imu_ns, known=True)

    def _due(
        self,
        run: _Run,
        imu_ns: int,
    ) -> float:
        """Age of the newest usable pair [s] up to which the next one is not missing."""
        silent_ns = imu_ns - self._arrived_ns
        if self._unusable_ns > run.observed_ns:
            return _OVERDUE
        if 0 < self._frame_interval_ns < NANOSECONDS:  # of a topic with each frame
            silent = silent_ns > _SILENT_FRAMES * self._frame_interval_ns
            return _OVERDUE if silent else self._longest_interval + _PAIR_DELAY
        usual = max(run.intervals, default=0.0)
        return max(_OVERDUE, _OVERDUE_INTERVALS * usual)

    # -- start and end -----------------------------------------------------------------------

    def _new_run(self, pair: PublishedPair) -> _Run | None:
        """A run that starts at the pair's reference; None if the pair cannot start one."""
        interval = self._samples.between(pair.reference_imu_ns, pair.current_imu_ns)
        if pair.images is None or interval is None or self.base is None:
            return None
        at_rest = pair.is_pure_rotation and interval.at_rest
        # Axes of the IMU do not show at rest.
        possible = self._wrong_starts < _WRONG_STARTS if at_rest else pair.has_direction
        if not possible:
            return None
        path_end, end = self._path_end_at(pair.reference_imu_ns)
        start = end if end is not None else self._start(pair, interval, path_end, at_rest)
        graph = KeyframeGraph(
            start,
            self._doubts,
            self._parameters,
            continued=end is not None,
            keep=self._keep,
        )
        graph.use_sensor_rate(self._sensor_rate.factor, self._sensor_rate.between)
        self._first_R = start.R if self._first_R is None else self._first_R
        offset = pair.current_imu_ns - pair.stamp_ns
        first = pair.reference_imu_ns - offset, pair.reference_imu_ns
        return _Run(
            graph=graph,
            path_end=path_end,
            continued=end is not None,
            at_rest=at_rest,
            first_ns=pair.reference_imu_ns,
            observed_ns=pair.reference_imu_ns,
            stamps=deque([first], maxlen=None if self._keep else 1),
            frame_id=self.base.frame_id or pair.frame_id,
            tested=self._last_run.tested if end is not None and self._last_run else 0,
        )

    def _start(
        self,
        pair: PublishedPair,
        interval: ImuInterval,
        path_end: PathEnd,
        at_rest: bool,
    ) -> KeyframeState:
        """The body at the pair's reference, with the covariance of a start."""
        assert self.base is not None
        before = self._samples.up_to(pair.reference_imu_ns, _GRAVITY_WINDOW)
        return start_state(
            pair,
            Surroundings(interval, before, path_end, at_rest),
            self._doubts.R_cam_body(self._doubted),
            (self._doubted, self._doubts_covariance),
            self.base,
            self._imu,
        )

    def _path_end_at(self, imu_ns: int) -> tuple[PathEnd, KeyframeState | None]:
        """End of the last path at a time, and the state there if the next path continues from it.

        A path that continues has the uncertainty of that state in its graph, and inherits the path
        end of the path before.
        """
        run = self._last_run
        if run is None:
            return PathEnd.origin(), None
        since_ns = run.newest_ns if run.resumed_ns is None else run.resumed_ns
        seconds = seconds_between(since_ns, imu_ns)
        interval = None if run.is_broken else self._samples.between(since_ns, imu_ns)
        if interval is not None and seconds <= LONGEST_PROPAGATED:
            state = run.graph.propagated(interval)
            if self._end_is_known:
                return run.path_end, continued(state)
            return end_of(state, run.path_end), None
        state = run.graph.newest
        end = end_of(state, run.path_end)
        if abs(seconds) > _SAME_NS / NANOSECONDS:  # else the keyframe itself: no gap
            end = end_without_samples(end, state, seconds)
        return end, None

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
                if run.continued:
                    self._forget_end()
                else:
                    self._run = None
                    self._count_wrong_start()
                return False
            if sigma < self._config.max_scale_sigma:
                self._publish(run, StartReport(run.at_rest, run.newest_ns, seconds, sigma))
                return True
        if seconds > _LONGEST_START:
            self._run = None
        return False

    def _publish(
        self,
        run: _Run,
        start: StartReport,
    ) -> None:
        """Start to publish a run."""
        run.published = True
        if not run.at_rest:
            self._wrong_starts = 0
        self.starts.append(start)
        run.path = len(self.starts) - 1
        if self._keep:
            self._runs.append(run)
        how = 'at rest' if run.at_rest else 'in motion'
        self._change(
            OdometryState.TRACKING,
            f'started {how} after {start.seconds:.1f} s, the scale is known to '
            f'{100.0 * start.scale_sigma:.1f} %',
            run.newest_ns,
        )

    def _forget_end(self) -> None:
        """The pairs contradict the propagated end of a path: the next start is a new one."""
        self._run = None
        self._end_is_known = False

    def _count_wrong_start(self) -> None:
        self._wrong_starts += 1
        if self._wrong_starts == _WRONG_STARTS:
            self.reason = _CONTRADICTION

    def _fail(self, error: GraphError, imu_ns: int) -> None:
        """End a run whose graph cannot be solved."""
        self.counts['unsolved'] += 1
        self._unsolved = str(error)
        self._end(str(error), imu_ns)

    @property
    def _coasted(self) -> str:
        """The reason of a path that ends without pairs."""
        return f'no usable pair for {self._config.max_coast:g} s'

    def _end(
        self,
        reason: str,
        imu_ns: int,
        *,
        known: bool = False,
    ) -> None:
        """End the run; the next one continues from its end.

        `known`: whether the IMU still propagates the end within its covariance.
        """
        run, self._run = self._run, None
        if run is not None and run.published:
            self.counts['lost'] += 1
            self._last_run = run
            self._end_is_known = known
            newest = run.graph.newest
            self._doubted = newest.doubts
            self._doubts_covariance = newest.covariance[DOUBTS, DOUBTS]
            self._change(OdometryState.LOST, reason, imu_ns)

    def _end_at_gap(self, run: _Run, imu_ns: int) -> None:
        """End a run at the first gap of the IMU after its newest keyframe."""
        longest_ns = to_nanoseconds(self._imu.max_imu_gap)
        gap = first_gap(self._samples, run.newest_ns, longest_ns)
        if gap is None:
            self._end(_GAP, imu_ns)
        else:
            self._interrupt(gap, _GAP, imu_ns)

    def _change(
        self,
        state: OdometryState,
        reason: str,
        imu_ns: int,
    ) -> None:
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
        C = self._R_cam_body
        d, covariance = self._known_doubts()
        return -C @ d[:3], np.sqrt(np.diag(C @ covariance[:3, :3] @ C.T))

    @property
    def deviations(self) -> dict[str, tuple[list[float], list[float]]]:
        """Values and sigmas of the deviations of the configuration that are unknown, by name."""
        return self._doubts.named(*self._known_doubts())

    def _known_doubts(self) -> tuple[Array, Array]:
        """The vector of `doubts` with its covariance."""
        if self._run is None:
            return self._doubted, self._doubts_covariance
        newest = self._run.graph.newest
        return newest.doubts, newest.covariance[DOUBTS, DOUBTS]

    def _publication(self, run: _Run) -> Publication:
        """What the states of a run have in common."""
        assert self.base is not None and self._first_R is not None
        return Publication(
            self.base,
            run.frame_id,
            self._first_R,
            run.path_end,
            self._doubts,
            self._imu.gyro_noise_density,
            untested_scale(run.tested),
        )

    def _stamp(self, run: _Run, stamp_ns: int, imu_ns: int) -> Stamp:
        """When a state of a run is."""
        return Stamp(stamp_ns, imu_ns, run.path, self._corrections)

    # -- findings ----------------------------------------------------------------------------

    def _find(self, run: _Run, interval: ImuInterval, imu_ns: int) -> None:
        """Name what the newest keyframe shows of the IMU, once each."""
        found = run.graph.findings
        peak = knock_peak(interval)
        if peak and run.published:
            self.counts['knocks'] += 1
            found = (*found, knock_finding(peak, self.counts['knocks'], imu_ns))
        for finding in found:
            if finding.code not in self._findings:
                self._warnings.append(Notice(findings_text.line(finding)))
            self._findings[finding.code] = finding
