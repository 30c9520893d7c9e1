"""Metric odometry from pairs and IMU samples, keyframe by keyframe; no ROS in it.

Live and offline alike: what comes out depends on pairs and samples, and not on the order in which
they come within `_LATE_NS`.
"""

from __future__ import annotations

from collections import Counter, deque
from dataclasses import dataclass
from enum import Enum
from itertools import pairwise
import math
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from rs_relpose_ros.config.parameters import Parameters
from rs_relpose_ros.geometry.so3 import exp_so3, skew
from rs_relpose_ros.geometry.timing import seconds_between, to_nanoseconds
from rs_relpose_ros.imu.samples import ImuSample
from rs_relpose_ros.messages.hanging import HangingGyro
from rs_relpose_ros.odometry.graph import (
    GraphError,
    KeyframeGraph,
    KeyframeState,
    STANDARD_GRAVITY,
    Start,
    Step,
)
from rs_relpose_ros.odometry.imu_history import ImuHistory
from rs_relpose_ros.odometry.interval import ImuInterval
from rs_relpose_ros.odometry.measurement import PairMeasurement
from rs_relpose_ros.odometry.pair_geometry import Mounting

Array = NDArray[np.float64]

# Time that a message may be late by.
_LATE_NS = 100_000_000
# Time after `max_coast` until which a last pair may still come, and how many wait for the IMU.
_LAST_PAIR_NS, _MOST_WAITING = 1_000_000_000, 100
# Samples that are older by more than this come from a clock that was set back.
_JUMP_NS = 1_000_000_000
# Instants that are nearer than this are those of one keyframe: a read-out time that is tracked
# moves the middle row.
_SAME_NS = 1_000_000
# Samples of which gravity is taken at a start [s].
_GRAVITY_WINDOW = 1.0
# 1 sigma of that direction where the body moves [rad].
_MOVING_TILT = 0.1
# 1 sigma of the velocity at a start in motion [m/s], per axis: nothing is known of it.
_ANY_VELOCITY = 3.0
# Largest 1 sigma of the logarithm of a baseline that starts a graph, and the speed that is tried
# where none is known [m/s]: pairs of a global shutter have no baseline.
_START_LOG_SIGMA, _GUESSED_SPEED = 0.7, 1.0
# Chi squared per degree of freedom of a pair that contradicts, and of a start that went wrong.
_CONTRADICTING, _WRONG_START = 4.0, 3.0
# Longest time over which the IMU carries a path that was lost [s], and by which a pair comes later
# than its samples.
_LONGEST_CARRIED, _LONGEST_DELAY = 10.0, 10.0
# A start that takes longer is begun anew [s].
_LONGEST_START = 4.0
# Pairs that tell the scale of a start in motion, at least.
_LEAST_PAIRS = 4


class State(str, Enum):
    """What odometry is doing."""

    STARTING = 'starting'   # nothing is published
    TRACKING = 'tracking'
    TOLD_WRONG = 'told wrong'   # the front end has found a figure of camera or IMU to be wrong


@dataclass(frozen=True, slots=True, eq=False)
class Odometry:
    """The camera in a metric world whose z is up, at an instant."""

    stamp_ns: int   # on the camera's clock, as image stamps
    imu_ns: int   # the same instant on the IMU's
    frame_id: str   # of the camera
    path: int   # number of starts before; the world stays the same
    R: Array   # (3, 3) from the camera
    position: Array   # (3,) [m]
    pose_covariance: Array   # (6, 6) of (position, turn), in the axes of the world
    velocity: Array   # (3,) of the camera, in its axes [m/s]
    angular_velocity: Array   # (3,) likewise [rad/s]
    velocity_covariance: Array   # (6, 6) of the two


@dataclass(frozen=True, slots=True)
class Started:
    """How odometry started."""

    at_rest: bool
    imu_ns: int
    seconds: float   # since its first pair
    scale_sigma: float   # relative


class _Left(NamedTuple):
    """Where a path goes on: rotation of the body (None: of any heading), position [m], sigmas."""

    R: Array | None
    position: Array
    heading_sigma: float
    position_sigma: float


@dataclass(slots=True, eq=False)
class _Run:
    """A graph since its start."""

    graph: KeyframeGraph
    left: _Left   # where the path before it ended
    at_rest: bool
    first_ns: int
    newest_ns: int   # of the newest keyframe
    seen_ns: int   # of the newest pair that was used
    # Of the keyframes, camera clock and IMU clock: of the newest, or of all where they are kept.
    stamps: deque[tuple[int, int]]
    frame_id: str
    pairs: int = 0
    published: bool = False
    path: int = 0   # number of starts before

    def moved_on(self, stamp_ns: int, imu_ns: int) -> None:
        """Take the instant of a new keyframe."""
        self.stamps.append((stamp_ns, imu_ns))
        self.newest_ns = imu_ns


class OdometryEstimator:
    """Takes samples and pairs; `take` gives the keyframes that came of them.

    `keep`: whether all is kept for `smoothed`.
    """

    def __init__(self, parameters: Parameters, *, keep: bool = False) -> None:
        self._config, self._imu = parameters.odometry, parameters.imu
        R, lever = parameters.sensor.R_cam_imu, np.array(parameters.imu.imu_position)
        self._mounting = Mounting(R, -R.T @ lever)
        self._samples = ImuHistory(parameters.imu.max_imu_gap)
        self._gyro = HangingGyro(parameters.imu.stuck_gyro_time)
        self._keep = keep
        self._waiting: dict[int, PairMeasurement] = {}
        self._run: _Run | None = None
        self._left: _Run | None = None   # a run that ended: where the path goes on
        self._runs: list[_Run] = []
        self._last_ns: int | None = None
        self._row_ns = 0   # from the stamped to the middle row
        self.state = State.STARTING
        self.starts: list[Started] = []
        # Of pairs and runs, by what became of them.
        self.counts: Counter[str] = Counter()
        self._sentences: list[str] = []
        if not lever.any():
            self._sentences.append('imu_position is zero: the IMU is taken to be exactly in the '
                                   "camera's place")

    @property
    def waiting(self) -> bool:
        """Whether a pair waits for samples."""
        return bool(self._waiting)

    @property
    def obstacle(self) -> str:
        """What of the accelerometer keeps it from starting; empty where it is none of it."""
        return self._samples.fault if self.state is State.STARTING else ''

    def add_imu(self, sample: ImuSample) -> None:
        """Take in a sample; InputError where a gyro hangs."""
        newest = self._samples.newest_ns
        if newest is not None and sample.stamp_ns < newest - _JUMP_NS:
            self._end('the clock of the IMU was set back')
            self._samples = ImuHistory(self._imu.max_imu_gap)
            self._waiting, self._last_ns = {}, None
        if not self._gyro.repeats(sample):
            self._samples.add(sample)
            self._samples.prune(sample.stamp_ns - to_nanoseconds(
                max(_LONGEST_CARRIED, self._config.max_coast) + _LONGEST_DELAY))
        run = self._run
        if run is not None and run.published and not self._waiting and (
                sample.stamp_ns - run.seen_ns
                > to_nanoseconds(self._config.max_coast) + _LAST_PAIR_NS):
            self._end(f'no pair for {self._config.max_coast:g} s')

    def add_pair(self, pair: PairMeasurement) -> None:
        """Take in a pair."""
        self.counts['pairs'] += 1
        if pair.images is not None:
            self._row_ns = to_nanoseconds(pair.images.row_time)
        # Keyframes are at the middle rows, also where a pair says nothing.
        pair = pair.later(self._row_ns)
        if self._last_ns is not None and pair.current_ns <= self._last_ns:
            self.counts['late'] += 1
            return
        self._waiting[pair.current_ns] = pair
        if len(self._waiting) > _MOST_WAITING:
            del self._waiting[min(self._waiting)]
            self.counts['without IMU'] += 1

    def reset(self) -> None:
        """Forget the path: the next start is at the origin, as the first one was."""
        self._run = self._left = None
        self._waiting, self.state = {}, State.STARTING

    def sentences(self) -> list[str]:
        """What happened since the last call, for the log."""
        told, self._sentences = self._sentences, []
        return told

    def take(self, *, end: bool = False) -> list[Odometry]:
        """Keyframes that can be told by now; with `end`, nothing more will come."""
        out = []
        while self._waiting:
            pair = self._waiting[min(self._waiting)]
            if not (end or self._ready(pair)):
                break
            del self._waiting[pair.current_ns]
            self._last_ns = pair.current_ns
            try:
                found = self._process(pair)
            except GraphError as error:
                found = None
                self._end(str(error))
            if found is not None:
                out.append(found)
        return out

    def carried(self, imu_ns: int) -> Odometry | None:
        """The newest keyframe carried on by the IMU to an instant; None where there is none."""
        run = self._run
        if run is None or not run.published or self.state is not State.TRACKING:
            return None
        if imu_ns - run.seen_ns > to_nanoseconds(self._config.max_coast):
            return None
        interval = self._samples.between(run.newest_ns, imu_ns)
        if interval is None:
            return None
        stamp_ns, at_ns = run.stamps[-1]
        return self._told(run, run.graph.carried(interval), interval.rates[-1],
                          stamp_ns + imu_ns - at_ns, imu_ns)

    def smoothed(self) -> list[Odometry]:
        """All keyframes, each with all that came before and after it; needs `keep`.

        A run whose graph cannot be solved as a whole is left out, which is told.
        """
        out = []
        for run in self._runs:
            try:
                states = run.graph.smoothed()
            except GraphError as error:
                self._sentences.append(f'not smoothed: {len(run.stamps)} keyframes: {error}')
                continue
            out += [self._told(run, state, np.full(3, math.nan), *stamps)
                    for state, stamps in zip(states, run.stamps, strict=True)]
        return out

    def smoothed_steps(self) -> list[tuple[int, int, Step]]:
        """Steps between consecutive ones of these, with both instants on the IMU's clock."""
        return [(start, end, step) for run in self._runs
                for ((_, start), (_, end)), step in zip(
                    pairwise(run.stamps), run.graph.smoothed_steps(), strict=True)]

    # -- pairs -------------------------------------------------------------------------------

    def _ready(self, pair: PairMeasurement) -> bool:
        """Whether nothing that comes late may change what becomes of a pair."""
        newest = self._samples.newest_ns
        if newest is None or newest < pair.current_ns:
            return False
        if newest >= pair.current_ns + _LATE_NS:
            return True
        return (self._run is not None and abs(pair.reference_ns - self._run.newest_ns) < _SAME_NS
                and self._samples.complete(pair.reference_ns, pair.current_ns))

    def _process(self, pair: PairMeasurement) -> Odometry | None:
        if pair.told_wrong:
            if self.state is not State.TOLD_WRONG:
                self._end('', State.TOLD_WRONG)
            self.counts['told wrong'] += 1
            return None
        if self.state is State.TOLD_WRONG:
            self.state = State.STARTING
        run = self._continued(pair)
        if run is None:
            run = self._run = self._begun(pair)
        if run is None:
            return None
        interval = self._samples.between(run.newest_ns, pair.current_ns)
        if interval is None:
            self._end('the IMU has a gap')
            return None
        standing = pair.turned_only and interval.at_rest
        chi2 = run.graph.add(interval, pair, standing)
        run.moved_on(pair.stamp_ns, pair.current_ns)
        if chi2 > _CONTRADICTING and run.published:
            run.graph.without_pair()
            self.counts['contradicting'] += 1
        elif pair.images is not None:
            run.seen_ns, run.pairs = pair.current_ns, run.pairs + 1
        if seconds_between(run.seen_ns, pair.current_ns) > self._config.max_coast:
            self._end(f'no pair that can be used for {self._config.max_coast:g} s')
            return None
        if not run.published and not self._known(run):
            return None
        return self._told(run, run.graph.newest, interval.rates[-1], pair.stamp_ns,
                          pair.current_ns)

    def _continued(self, pair: PairMeasurement) -> _Run | None:
        """The run with a keyframe at the pair's reference; None where there is none."""
        run = self._run
        if run is None or abs(run.newest_ns - pair.reference_ns) < _SAME_NS:
            return run
        if pair.reference_ns < run.newest_ns:
            self._end('pairs overlap')
            return None
        if seconds_between(run.seen_ns, pair.reference_ns) > self._config.max_coast:
            self._end(f'no pair for {self._config.max_coast:g} s')
            return None
        interval = self._samples.between(run.newest_ns, pair.reference_ns)
        if interval is None:
            self._end('the IMU has a gap')
            return None
        # A pair is missing: the IMU bridges it.
        run.graph.add(interval, None, standing=False)
        offset = pair.current_ns - pair.stamp_ns
        run.moved_on(pair.reference_ns - offset, pair.reference_ns)
        return run

    # -- start and end -----------------------------------------------------------------------

    def _begun(self, pair: PairMeasurement) -> _Run | None:
        """A run whose first keyframe is the pair's reference; None where it cannot start one."""
        interval = self._samples.between(pair.reference_ns, pair.current_ns)
        before = self._samples.up_to(pair.reference_ns, _GRAVITY_WINDOW)
        if pair.images is None or interval is None:
            return None
        at_rest = pair.turned_only and interval.at_rest
        if not at_rest and not pair.has_direction:
            return None
        moving = (pair.baseline * pair.images.velocities[:3]
                  if pair.baseline_log_sigma < _START_LOG_SIGMA
                  else _GUESSED_SPEED * pair.images.t)
        bias = np.where(np.isfinite(pair.gyro_bias), pair.gyro_bias, self._imu.gyro_bias)
        rate = interval.rates[0] - bias
        if at_rest or before is None or before.duration < interval.duration:
            # Turned back by what the gyro says of the interval.
            force = _mean_force_at_start(interval, bias)
        else:
            force = before.mean_force(bias)
        left = self._left_at(pair.reference_ns)
        R = _levelled(force, left)
        C, c = self._mounting
        velocity = np.zeros(3) if at_rest else R @ (C.T @ moving - np.cross(rate, c))
        tilt = self._imu.accel_bias_sigma / STANDARD_GRAVITY if at_rest else _MOVING_TILT
        start = Start(R, left.position, velocity, bias, tilt,
                      0.01 if at_rest else _ANY_VELOCITY, self._imu.gyro_bias_sigma)
        graph = KeyframeGraph(start, interval.rates[0], self._mounting, self._imu, self._config,
                              keep=self._keep)
        offset = pair.current_ns - pair.stamp_ns
        stamps = deque([(pair.reference_ns - offset, pair.reference_ns)],
                       maxlen=None if self._keep else 1)
        return _Run(graph, left, at_rest, pair.reference_ns, pair.reference_ns, pair.reference_ns,
                    stamps, pair.frame_id)

    def _left_at(self, imu_ns: int) -> _Left:
        """Where the path goes on at an instant: where it ended, carried on by the IMU."""
        run = self._left
        if run is None:
            return _Left(None, np.zeros(3), 0.0, 0.0)
        seconds, newest = seconds_between(run.newest_ns, imu_ns), run.graph.newest
        interval = self._samples.between(run.newest_ns, imu_ns)
        # What was lost before is not known any better now.
        earlier = run.left
        variance = earlier.position_sigma**2 + earlier.heading_sigma**2 * float(
            ((newest.position - earlier.position)[:2]**2).sum()) / 3.0
        if interval is None or not seconds <= _LONGEST_CARRIED:
            speed = float(np.linalg.norm(newest.velocity))
            return _Left(newest.R, newest.position, math.pi,
                         math.hypot(1.0 + speed * abs(seconds), math.sqrt(variance)))
        state = run.graph.carried(interval)
        up, covariance = state.R[2], state.pose_covariance
        drift = 0.5 * self._imu.accel_bias_sigma * seconds**2
        variance += drift**2 + float(np.trace(covariance[3:, 3:])) / 3.0
        heading = math.hypot(earlier.heading_sigma,
                             math.sqrt(float(up @ covariance[:3, :3] @ up)))
        return _Left(state.R, state.position, min(heading, math.pi), math.sqrt(variance))

    def _known(self, run: _Run) -> bool:
        """Whether the scale of a run that starts is known by now."""
        seconds = seconds_between(run.first_ns, run.newest_ns)
        sigma = run.graph.scale_sigma()
        if run.at_rest or run.pairs >= _LEAST_PAIRS:
            if run.graph.misfit() > _WRONG_START:
                self.counts['wrong starts'] += 1
                self._run = None
                return False
            if sigma < self._config.max_scale_sigma:
                run.published = True
                self.state = State.TRACKING
                self.starts.append(Started(run.at_rest, run.newest_ns, seconds, sigma))
                run.path = len(self.starts) - 1
                if self._keep:
                    self._runs.append(run)
                self._sentences.append(
                    f'started {"at rest" if run.at_rest else "in motion"} after {seconds:.1f} s: '
                    f'the scale is known to {100.0 * sigma:.1f} %')
                return True
        if seconds > _LONGEST_START:
            self._run = None
        return False

    def _end(self, reason: str, state: State = State.STARTING) -> None:
        """End the run; the next one goes on from its end."""
        if self._run is not None and self._run.published:
            self.counts['lost'] += 1
            self._left = self._run
            if reason:
                self._sentences.append(f'lost: {reason}; starting anew where it ended')
        if state is State.TOLD_WRONG:
            self._sentences.append('stopped: what was told of camera or IMU is wrong: see the '
                                   'health of the pairs')
        self._run, self.state = None, state

    # -- results -----------------------------------------------------------------------------

    def _told(self, run: _Run, state: KeyframeState, rate: Array, stamp_ns: int,
              imu_ns: int) -> Odometry:
        C, c = self._mounting
        rate = rate - state.gyro_bias
        # The camera's place turns with the body: dp = R (step - c x turn), in the world.
        to_world = np.zeros((6, 6))
        to_world[:3, :3], to_world[:3, 3:] = -state.R @ skew(c), state.R
        to_world[3:, :3] = state.R
        R = state.R @ C.T
        velocity = np.zeros((6, 6))
        velocity[:3, :3] = R.T @ state.velocity_covariance @ R
        velocity[3:, 3:] = self._imu.gyro_noise_density**2 * 100.0 * np.eye(3)
        # A start that goes on from an earlier path has its place and heading from there.
        position, up = state.position + state.R @ c, np.array([0.0, 0.0, 1.0])
        by_heading = run.left.heading_sigma * np.concatenate([
            np.cross(up, position - run.left.position), up])
        covariance = to_world @ state.pose_covariance @ to_world.T + np.outer(
            by_heading, by_heading)
        covariance[:3, :3] += run.left.position_sigma**2 * np.eye(3)
        return Odometry(
            stamp_ns, imu_ns, run.frame_id, run.path, R, position, covariance,
            R.T @ (state.velocity + state.R @ np.cross(rate, c)), C @ rate, velocity)


def _levelled(force: Array, left: _Left) -> Array:
    """Rotation (3, 3) from the body to the world, by the force of standing still."""
    up = force / np.linalg.norm(force)
    # The least turn that takes it upwards, then one about z to the heading that was left.
    turn = skew(np.cross(up, [0.0, 0.0, 1.0]))
    R = (np.eye(3) + turn + turn @ turn / (1.0 + up[2]) if up[2] > -0.999
         else np.diag([1.0, -1.0, -1.0]))
    if left.R is not None:
        M = left.R @ R.T
        R = exp_so3(np.array([0.0, 0.0, math.atan2(M[1, 0] - M[0, 1], M[0, 0] + M[1, 1])])) @ R
    return np.asarray(R)


def _mean_force_at_start(interval: ImuInterval, bias: Array) -> Array:
    """Mean specific force (3,) in the axes of the first instant."""
    back = ImuInterval(interval.seconds, -interval.rates[::-1], interval.forces[::-1])
    return back.mean_force(-bias)
