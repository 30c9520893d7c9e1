"""A step of the offset between the clocks of camera and IMU.

A clock that is set in the middle of a run moves all later stamps of one sensor. The pairs before
are right, so that the mean of all pairs says little; each pair after the step has images that
rotate otherwise than the gyro. From the first of them on, pairs are collected, and their matches
are compared with the gyro at all offsets of a wide range: with the right rotations of all rows,
the epipolar planes of a pair share one axis, the direction of translation.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Sequence
from dataclasses import replace
import math
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from rs_relpose_ros.calibration.posterior import PairData
from rs_relpose_ros.core.losses import cauchy_weight, robust_scale
from rs_relpose_ros.estimator.result import RelativePose
from rs_relpose_ros.geometry import Array
from rs_relpose_ros.geometry.gyro import GyroPath
from rs_relpose_ros.geometry.timing import seconds_between, to_nanoseconds
from rs_relpose_ros.imu.integration import ImuSlice

# Largest step that is looked for [s]. A longer range finds larger steps, needs more time, and
# waits longer for the gyro that follows a pair. [chosen: the steps of user reports are below
# 0.5 s]
LARGEST_STEP = 0.6
# Interval of the offsets that are tried [s]. A longer one may miss a narrow optimum, a shorter one
# costs time. [measured: the optimum of a pair of a walk is 10 to 30 ms wide]
_INTERVAL = 4e-3
# Number of these offsets; the middle one is no step. [derived: both ends of the range]
_TRIED = 2 * round(LARGEST_STEP / _INTERVAL) + 1
# Intervals by which an optimum is refined [s], on either side of it. [derived: `_INTERVAL`]
_FINE: Array = np.linspace(-5e-3, 5e-3, 11)
# Distance from the best offset [s] at which another one is another explanation. Less would take
# the slope of the optimum for one, more would not see a neighbouring one.
# [chosen: half of a period of the vibrations of a step is 50 ms; 15 to 30 ms would do]
_APART = 0.02
# Matches of a pair that are compared. Fewer would be noise, more cost time. [chosen: 40 to 100]
_MATCHES = 50
# Scale of the robust cost, in sigmas of the distances from the epipolar planes of pairs before.
# [chosen: 1.5 to 4 would do]
_SCALE = 2.0
# The same before the first pair [rad]. [chosen: a pixel of a usual lens]
_FIRST_SIGMA = 2e-3
# Least sigma of these distances [rad]. A smaller one would take the change of the velocity within
# a long pair for another offset, a larger one would not see small steps.
# [chosen: a quarter of a pixel of a usual lens]
_LEAST_SIGMA = 4e-4
# Rounds of weights for the direction of translation. [chosen: 2 to 6 would do]
_ROUNDS = 3
# Smallest squared sine by which a residual is divided; it keeps those of points that do not move
# finite. [derived: a ten thousandth of a radian]
_LEAST_SINE = 1e-8
# Chi-square (3 degrees of freedom) of the rotation by images against the gyro from which a pair
# contradicts the gyro. A smaller limit would doubt correct pairs, a larger one would publish more
# pairs after a step. [measured: at most 1.3 on simulated walks; once in 1000 by definition]
CONTRADICTS_GYRO = 16.0
# Pairs by whose median the chi-square is scaled: covariances of a recording may be too small.
# [measured: the median is 0.1 on simulated walks, 1 to 4 on recordings of a RealSense and a phone]
_USUAL_PAIRS = 40
# Consistent pairs that must come before a step, and make the medians. Fewer would take a camera
# that has never agreed with its gyro for one whose clock steps; more would miss a step in the
# first seconds. [chosen: 1 to 3 s of keyframes]
_FEWEST_BEFORE = 10
# Consistent pairs in a row that end a doubt. [chosen: 2 would follow a quiet moment; 3 to 6]
_ENDS = 3
# Last pairs of which more than one contradicts the gyro while a doubt lasts. Fewer would publish
# quiet pairs after a step, more would withhold correct ones after a disturbance.
# [chosen: 3 to 6 would do]
_RECENT = 4
# Pairs of a doubt that are compared, the last ones. After so many without a step, other causes
# are assessed as well. [chosen: 2 to 4 s of keyframes]
_MOST_DOUBTFUL = 30
# Least gain of a step in log-likelihood over no step. [chosen: prior odds of a step in a given
# second of 1e-5, times 300 offsets, are 9 below zero; beyond that 6 for errors of neighbours]
_LEAST_GAIN = 15.0
# Least lead in log-likelihood over another offset. [chosen: twice the 5 of other hypotheses, as
# errors of neighbouring matches are alike]
_LEAST_LEAD = 10.0
# Pairs that must be compared at the offset. [chosen: one may follow an object; 2 to 4 would do]
_FEWEST_AFTER = 3
# Share of the cost without a step that a step leaves at most, in most pairs. More would take any
# change of the scene for a step, less would miss a step into worse light. [measured: 0.01 to 0.21
# after steps of 8 to 300 ms; from 0.45 on with objects, stamps that jitter, and vibration]
_LEFT = 0.3
# The share of pairs in which it is so. All pairs would include one that an object spoils, half of
# them would accept a scene that fits by chance. [chosen: 0.6 to 0.9 would do]
_IN_PAIRS = 0.75
# Median chi-square of consistent pairs up to which images and gyro agree at all, so that a step
# can show. [measured: at most 7 with stamps that jitter, from 16 on with objects, vibration and
# stabilisation]
_AGREED = 10.0
# Pairs after a step that decide whether it was one: they agree with the gyro at the new offset.
# [chosen: about a second of keyframes]
_TRIAL_PAIRS = 4
# Time [ns] for which the gyro is kept: the pairs of a doubt and the range of steps.
# [derived: `_MOST_DOUBTFUL` pairs of a quarter of a second each]
_KEPT_NS = to_nanoseconds(8.0)


class ClockStep(NamedTuple):
    """A step of the time offset that explains the pairs."""

    seconds: float  # change of the time offset
    sigma: float
    before_ns: int  # stamp of the last image before the step
    after_ns: int  # stamp of an image after it
    gain: float  # in log-likelihood over no step
    pairs: tuple[DoubtfulPair, ...]  # after the step, at the offset before it


class DoubtfulPair(NamedTuple):
    """A pair of the doubt."""

    first_ns: int  # stamps of its images
    stamp_ns: int
    data: PairData
    rows: _Rows
    contradicts: bool


class ClockSteps:
    """Follows the pairs in the order of time, and finds steps of the time offset."""

    def __init__(self) -> None:
        self._gyro: deque[ImuSlice] = deque()  # without a gap, the last seconds
        self._chi_squares: deque[float] = deque(maxlen=_USUAL_PAIRS)  # of consistent pairs
        self._sigmas: deque[float] = deque(maxlen=_USUAL_PAIRS)  # [rad] of their distances
        self._latest: PairData | None = None  # the last consistent pair, until its gyro is known
        self._unmeasured: PairData | None = None  # the one before, whose gyro is known
        self._doubtful: list[DoubtfulPair] = []  # since the first that contradicts the gyro
        self._is_unsettled = False  # whether they have been in doubt, and none has settled it
        self._curves: dict[int, Array] = {}  # cost (M,) of a pair at all offsets, by its stamp
        self._last: ClockStep | None = None
        self._since_last = 0  # pairs since then

    @property
    def joined(self) -> ImuSlice | None:
        """The gyro of the last seconds; None without any."""
        if not self._gyro:
            return None
        last = self._gyro[-1]
        # The first sample of each is the last one of the slice before.
        later = list(self._gyro)[1:]
        stamps = [one.stamps_ns[1:] for one in later]
        rates = [one.angular_velocities[1:] for one in later]
        return replace(
            last,
            stamps_ns=np.concatenate([self._gyro[0].stamps_ns, *stamps]),
            angular_velocities=np.concatenate([self._gyro[0].angular_velocities, *rates]),
            no_force='not needed',
            force_stamps_ns=np.empty(0, dtype=np.int64),
            forces=np.empty((0, 3)),
        )

    @property
    def in_doubt(self) -> bool:
        """Whether more than one of the last pairs contradicts the gyro."""
        return sum(pair.contradicts for pair in self._doubtful[-_RECENT:]) > 1

    @property
    def may_be_step(self) -> bool:
        """Whether a step can explain the doubt, which is young then."""
        agreed = bool(self._sigmas) and float(np.median(self._chi_squares)) < _AGREED
        return agreed and self.in_doubt and len(self._doubtful) < _MOST_DOUBTFUL

    @property
    def on_trial(self) -> bool:
        """Whether the last step was found so shortly before that it may be none."""
        return self._last is not None and self._since_last <= _TRIAL_PAIRS

    def contradicts(self, pose: RelativePose) -> bool:
        """Whether the images of a pair contradict the gyro, other than in the pairs before."""
        if len(self._chi_squares) < _FEWEST_BEFORE:
            return False
        if pose.diagnostics.rejected is not None:
            return True
        usual = max(float(np.median(self._chi_squares)), 1.0)
        return bool(pose.diagnostics.gyro_square > CONTRADICTS_GYRO * usual)

    def add(
        self,
        stamps_ns: tuple[int, int],
        since: ImuSlice,
        data: PairData | None,
        pose: RelativePose,
    ) -> bool:
        """Add a pair with the stamps of its images; whether its pose is in doubt.

        Its images contradict the gyro, or those of pairs before did. A pair that ends a doubt is
        still part of it: the camera may have been at rest meanwhile.
        """
        self._keep(since)
        self._since_last += 1
        contradicts = data is not None and self.contradicts(pose)
        if data is None:
            return False
        if not (contradicts or self._doubtful):
            self._add_consistent(data, pose)
            return False
        self._latest = None
        was_in_doubt = self._is_unsettled
        self._doubtful.append(DoubtfulPair(*stamps_ns, data, _Rows.of(data), contradicts))
        del self._doubtful[:-_MOST_DOUBTFUL]
        last = self._doubtful[-_ENDS:]
        if len(last) == _ENDS and not any(pair.contradicts for pair in last):
            self.end_doubt()
        self._is_unsettled |= self.in_doubt
        return contradicts or was_in_doubt or self._is_unsettled

    def end_doubt(self) -> None:
        """Forget the pairs that contradict the gyro."""
        self._doubtful.clear()
        self._curves.clear()
        self._is_unsettled = False

    def found(self, least: float = 0.0) -> ClockStep | None:
        """The step of the time offset that explains the pairs of the doubt, if there is one.

        A smaller one than `least` [s] is none: stamps jitter by as much.
        """
        # The first of them may contain the step.
        pairs = self._doubtful[1:]
        whole = self.joined
        if not self.may_be_step or len(pairs) < _FEWEST_AFTER or whole is None:
            return None
        offsets: Array = np.linspace(-LARGEST_STEP, LARGEST_STEP, _TRIED)
        stream = _Stream(whole.path, int(whole.stamps_ns[0]))
        costs = np.array([self._curve(pair, stream, offsets) for pair in pairs])
        gains = costs[:, len(offsets) // 2, None] - costs
        known = np.isfinite(gains)
        total = np.where(known, gains, 0.0).sum(axis=0)
        best = int(np.argmax(total))
        apart = np.abs(offsets - offsets[best]) > _APART
        is_certain = (
            known[:, best].sum() >= _FEWEST_AFTER
            and total[best] > _LEAST_GAIN
            and total[best] - total[apart].max() > _LEAST_LEAD
        )
        if not is_certain:
            return None
        seconds, sigma = self._refined(pairs, stream, float(offsets[best]))
        if abs(seconds) < least or not self._fits(pairs, stream, seconds):
            return None
        first = self._doubtful[0]
        self._since_last = 0
        self._last = ClockStep(
            seconds, sigma, first.first_ns, first.stamp_ns, float(total[best]), tuple(pairs)
        )
        return self._last

    def refuted(self) -> ClockStep | None:
        """The last step, if the pairs after it contradict the gyro as well: it was none."""
        if not (self.in_doubt and self.on_trial):
            return None
        last = self._last
        self._last = None
        return last

    def _fits(self, pairs: Sequence[DoubtfulPair], stream: _Stream, offset: float) -> bool:
        """Whether most pairs fit at an offset, by what it leaves of their costs."""
        at = np.array([offset, 0.0])
        costs = np.array([_costs(pair.rows, stream, at, self._usual_sigma) for pair in pairs])
        known = costs[np.isfinite(costs).all(axis=1)]
        if len(known) < _FEWEST_AFTER:
            return False
        return bool(np.quantile(known[:, 0] / known[:, 1], _IN_PAIRS) < _LEFT)

    def _keep(self, since: ImuSlice) -> None:
        """Keep the gyro of a pair; after a gap that before is of no use."""
        gyro = self._gyro
        if gyro and gyro[-1].stamps_ns[-1] != since.stamps_ns[0]:
            gyro.clear()
        gyro.append(since)
        while gyro[0].stamps_ns[-1] < since.stamps_ns[-1] - _KEPT_NS:
            gyro.popleft()

    def _add_consistent(self, data: PairData, pose: RelativePose) -> None:
        """Note how well a consistent pair agrees with the gyro; `measure` follows."""
        if not math.isfinite(pose.diagnostics.gyro_square):
            return
        self._unmeasured = self._latest
        self._latest = data
        self._chi_squares.append(pose.diagnostics.gyro_square)

    def measure(self) -> None:
        """Note how well the consistent pair before the last one fits.

        Its last rows need the gyro of the last pair. No pose depends on it before the next pair.
        """
        before = self._unmeasured
        self._unmeasured = None
        if before is None or len(self._gyro) < 2:
            return
        both = self._gyro[-2].joined(self._gyro[-1])
        stream = _Stream(both.path, int(both.stamps_ns[0]))
        rows = _Rows.of(before)
        now = np.zeros(1)
        if not rows.covered(stream, now).all():
            return
        sigma = self._sigmas[-1] if self._sigmas else _FIRST_SIGMA
        distances = _distances(rows, stream, now, sigma)[0]
        self._sigmas.append(robust_scale(distances, _LEAST_SIGMA, 0.0))

    @property
    def _usual_sigma(self) -> float:
        return float(np.median(self._sigmas))

    def _curve(self, pair: DoubtfulPair, stream: _Stream, offsets: Array) -> Array:
        """Costs (M,) of a pair at all offsets, those that the gyro covers by now."""
        curve = self._curves.setdefault(pair.stamp_ns, np.full(len(offsets), np.nan))
        unknown = np.isnan(curve)
        if unknown.any():
            curve[unknown] = _costs(pair.rows, stream, offsets[unknown], self._usual_sigma)
        return curve

    def _refined(
        self, pairs: Sequence[DoubtfulPair], stream: _Stream, near: float
    ) -> tuple[float, float]:
        """Offset and its sigma [s], by the parabola through the costs near an optimum."""
        sigma = self._usual_sigma
        costs = np.array([_costs(pair.rows, stream, near + _FINE, sigma) for pair in pairs])
        total = costs[np.isfinite(costs).all(axis=1)].sum(axis=0)
        if not total.any():
            return near, _INTERVAL
        curvature, slope, _ = np.polyfit(_FINE, total, 2)
        if curvature <= 0.0:
            return near, _INTERVAL
        step = float(np.clip(-0.5 * slope / curvature, _FINE[0], _FINE[-1]))
        return near + step, 1.0 / math.sqrt(2.0 * curvature)


class _Stream(NamedTuple):
    """The integrated gyro of the last seconds."""

    path: GyroPath
    begin_ns: int  # of its times


class _Rows(NamedTuple):
    """Rays of the matches of two images as measured, and the times of their rows."""

    rays: tuple[Array, Array]  # (N, 3) each
    stamped_ns: tuple[int, int]  # times of the stamped rows on the clock of the IMU, as configured
    times: tuple[Array, Array]  # (N,) [s] each, after the stamped row

    @classmethod
    def of(cls, data: PairData) -> _Rows:
        """The rows of at most `_MATCHES` matches."""
        step = math.ceil(len(data.points1) / _MATCHES) or 1
        first = data.points1[::step]
        second = data.points2[::step]
        rays = data.camera.unproject(first), data.camera.unproject(second)
        usable = np.isfinite(rays[0] + rays[1]).all(axis=1)
        stamps_ns = data.segment.stamps_ns
        return cls(
            (rays[0][usable], rays[1][usable]),
            (int(stamps_ns[0]), int(stamps_ns[-1])),
            (
                data.camera.pixel_times(first[usable]),
                data.camera.pixel_times(second[usable]),
            ),
        )

    def at(self, stream: _Stream) -> tuple[Array, Array]:
        """Times (N,) [s] of the rows on the time of a stream."""
        first, second = (
            seconds_between(stream.begin_ns, stamped_ns) + times
            for stamped_ns, times in zip(self.stamped_ns, self.times, strict=True)
        )
        return first, second

    def covered(self, stream: _Stream, offsets: Array) -> NDArray[np.bool_]:
        """Which offsets (M,) move no row out of the stream."""
        times = np.concatenate(self.at(stream))
        if not len(times):
            return np.zeros(len(offsets), dtype=bool)
        known = stream.path.times
        begins = offsets + times.min() >= known[0]
        ends = offsets + times.max() <= known[-1]
        return np.asarray(begins & ends)


def _costs(rows: _Rows, stream: _Stream, offsets: Array, sigma: float) -> Array:
    """Robust costs (M,) of a pair if its rows are later by each of the offsets (M,) [s].

    NaN where the stream does not cover the rows. `sigma` [rad]: of the distances of right pairs.
    """
    costs = np.full(len(offsets), np.nan)
    covered = rows.covered(stream, offsets)
    if covered.any():
        costs[covered] = _cost(_distances(rows, stream, offsets[covered], sigma), sigma)
    return costs


def _cost(distances: Array, sigma: float) -> Array:
    """Sum of Cauchy's costs of distances (..., N) [rad]: each is minus the log of its weight."""
    return np.asarray(-np.log(_weights(distances, sigma)).sum(axis=-1))


def _weights(distances: Array, sigma: float) -> Array:
    """Cauchy's weights of distances of any shape [rad]."""
    squares = (distances / (_SCALE * sigma)) ** 2
    # In one dimension, for which the kernel has been compiled.
    return np.asarray(cauchy_weight(squares.ravel())).reshape(squares.shape)


def _distances(rows: _Rows, stream: _Stream, offsets: Array, sigma: float) -> Array:
    """Distances (M, N) [rad] of the matches from epipolar planes with one axis, at each offset."""
    first, second = (
        _turned(rays, times, stream.path, offsets)
        for rays, times in zip(rows.rays, rows.at(stream), strict=True)
    )
    normals = np.cross(first, second)
    weights = 1.0 / np.maximum((normals**2).sum(axis=2), _LEAST_SINE)
    for _ in range(_ROUNDS):
        moments = np.einsum('mn,mni,mnj->mij', weights, normals, normals)
        axes = np.linalg.eigh(moments)[1][:, :, 0]
        off = np.einsum('mni,mi->mn', normals, axes)
        squares = [(np.cross(axes[:, None], view) ** 2).sum(axis=2) for view in (first, second)]
        variance = np.maximum(squares[0] + squares[1], _LEAST_SINE)
        distances = off / np.sqrt(variance)
        weights = _weights(distances, sigma) / variance
    return np.asarray(distances)


def _turned(rays: Array, times: Array, path: GyroPath, offsets: Array) -> Array:
    """Rays (M, N, 3) in the axes of the path's begin, at each of the offsets (M,)."""
    at = (offsets[:, None] + times).ravel()
    rotations = path.at(at).reshape(len(offsets), len(times), 3, 3)
    return np.asarray(np.einsum('mnij,nj->mni', rotations, rays))
