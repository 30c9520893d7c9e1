"""The graph of keyframes in gtsam, and the window of it that is optimised as keyframes arrive.

States of a keyframe: pose and velocity of the body (the IMU) in a world with z up, and the biases;
of all keyframes: the vector of `doubts`. Factors (`factors`): the preintegrated IMU between
consecutive keyframes, and for a pair the information of its images alone (`estimator.covariance`),
so that no IMU sample counts twice.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, replace
import math
from typing import Any, NamedTuple

import gtsam
from gtsam.symbol_shorthand import B, L, V, X
import numpy as np

from rs_relpose_ros.calibration.findings import Finding
from rs_relpose_ros.config.settings import Parameters
from rs_relpose_ros.core.deviations import slices
from rs_relpose_ros.errors import RsRelposeError
from rs_relpose_ros.geometry import Array
from rs_relpose_ros.geometry.so3 import skew
from rs_relpose_ros.imu.buffer import ImuInterval
from rs_relpose_ros.messages.published_pair import PublishedPair
from rs_relpose_ros.odometry import doubts, factors
from rs_relpose_ros.odometry.doubts import by_gyro_matrix, Doubts
from rs_relpose_ros.odometry.marginals import CommonCovariances, joint_covariance
from rs_relpose_ros.odometry.noise import (
    Innovation,
    integrals_of_noise,
    knocks,
    NoisePosterior,
    spread,
)

# 1 sigma of the velocity of a body at rest [m/s], per axis. A smaller one holds a body that
# creeps; a larger one lets the path drift at rest. [chosen: 2 to 10 mm/s: a hand that holds still]
_REST_VELOCITY_SIGMA = 0.005
# Largest 1 sigma of the speed between two keyframes [m/s], as the IMU knows it, with which images
# without translation are a camera that stays in place. With a larger one the IMU could not tell a
# walk from rest, if an object fills the view; with a smaller one a rotation just after the start
# would not hold the path. [chosen: 0.3 to 0.7 would do: a walk has 1 to 1.8 m/s]
_STILL_SPEED = 0.5
# Largest chi squared per degree of freedom of that motion: above, the images show something that
# moves with the camera. [derived: one in 130 by chance with 3 degrees of freedom]
_STILL_GATE = 4.0
# Speed [m/s] below which the uncertainty of a velocity is taken relative to this speed: relative
# to 2 cm/s each sigma is large, and no slow camera would start; without it wrong starts happened
# in slow motion. [measured: docs/lab/odometry.md, "Starts", slow motion]
_LEAST_SPEED = 0.1
# Least variance of a pair by that of its images, after the start. A smaller one makes paths worse
# and some states too certain, as errors of consecutive pairs persist; a larger one makes all
# states too uncertain.
# [measured: docs/lab/odometry.md, "Thirty walks"]
_LEAST_VARIANCE = 0.5
# The same before so many innovations, and how many: the prior decides until then.
# [measured: there: the start of the bundled bag, of 27 pairs, is worse by a quarter with less]
_FIRST_LEAST_VARIANCE = 1.0
# Innovations that show a small variance. Fewer would make starts too certain, more would delay
# what they show. [chosen: 20 to 60 would do, some seconds of pairs]
_SHOWN = 30
# Longest bridge of the IMU, as a share of the window, after which the states before it stay in the
# window. After a longer one the first pairs move its end by decimetres: the smoother, which
# linearises its oldest states where they were at first, would take that for a turn of their ways.
# A smaller share would forget the window of short gaps.
# [measured: docs/lab/odometry.md, "Long bridges": 17 % of the states are beyond after 8 s]
_LONGEST_BRIDGE = 0.25
# Most steps of the optimisation with a keyframe. With fewer, a start would remain far off where
# the way of the camera is not known at first; one step does for most keyframes.
# [measured: with 10 another one changes no path by 0.2 mm, docs/lab/odometry.md]
_MOST_STEPS = 10
# Change of a camera's way between keyframes, as a share of it, from which another step follows:
# directions are linearised at the way before. A larger one would take a direction along a short
# way that is hardly known for one along a known way, a smaller one would take steps for nothing.
# [measured: docs/lab/odometry.md, "Short ways": 0.3 leaves a velocity too certain, 0.1 does not]
_MOVED = 0.1
# Length of a way below which its change is taken relative to this length [m]: the way of a camera
# that stays changes by any share. [chosen: 1 to 5 cm, below the way of any direction in use]
_LEAST_WAY = 0.02
# Newest keyframes whose ways are compared: a later one shows what an earlier way was.
# [chosen: 3 to 6 would do, about half a second]
_COMPARED = 3
# Iterations of the optimiser for the smoothed path. Fewer would leave a path of loops unfinished.
# [measured: as the tolerance: more change no path by 0.1 mm, docs/lab/odometry.md, "As a process"]
_SMOOTHING_ITERATIONS = 10
# Tolerance of its relative error. A larger one would stop early.
# [measured: others change no path by 0.1 mm, docs/lab/odometry.md, "As a process"]
_ERROR_TOLERANCE = 1e-4

# Against a division by zero, in a rotation by no angle.
_TINY = 1e-300
# Covariance of three values of unit variance.
_EYE = np.eye(3)

# Columns of the derivatives of an IMU factor by the unknowns of its first keyframe.
_OF_FIRST = np.r_[factors.IMU['X1'], factors.IMU['V1'], factors.IMU['B1']]
# The same of its second keyframe.
_OF_SECOND = np.r_[factors.IMU['X2'], factors.IMU['V2'], factors.IMU['B2']]
# Columns of the covariance of a keyframe; the vector of `doubts` follows.
_KEYFRAME = slices({'pose': 6, 'velocity': 3, 'accel_bias': 3, 'gyro_bias': 3, 'arm': 3})
POSE = _KEYFRAME['pose']  # both, rotation first
# Rotation and translation of the pose.
ROTATION = slice(0, 3)
TRANSLATION = slice(3, 6)  # in the axes of the camera
VELOCITY = _KEYFRAME['velocity']  # in the world
GYRO_BIAS = _KEYFRAME['gyro_bias']  # in the axes of the IMU
ARM = _KEYFRAME['arm']  # lever arm from the IMU to the camera, the first of `doubts`
BIAS = slice(_KEYFRAME['accel_bias'].start, GYRO_BIAS.stop)  # of both sensors
DOUBTS = slice(ARM.start, None)  # lever arm and deviations
# Unknowns of a keyframe without `doubts`.
_OWN = slice(0, ARM.start)


class GraphError(RsRelposeError):
    """The graph cannot be solved."""


@dataclass(frozen=True, slots=True, eq=False)
class KeyframeState:
    """The body at a keyframe, and what is unknown about its camera."""

    R: Array
    position: Array
    velocity: Array
    gyro_bias: Array
    accel_bias: Array
    doubts: Array  # (3 + k + 7,) of `doubts.Doubts`
    # (18 + k + 7, 18 + k + 7) of rotation and translation in the axes of the body, velocity in the
    # world, biases of accelerometer and gyro, doubts.
    covariance: Array

    @property
    def arm(self) -> Array:
        """Position (3,) of the camera in the body [m]."""
        return self.doubts[doubts.ARM]


class Loop(NamedTuple):
    """A pair of two keyframes of a graph, far apart in time."""

    first: int  # their numbers since the start
    second: int
    pair: PublishedPair


class _Step(NamedTuple):
    """Samples since the newest keyframe."""

    interval: ImuInterval
    pim: Any  # their integral, of gtsam
    residuals: factors.ImuResiduals


def _optimizer(iterations: int) -> Any:
    """Parameters of gtsam's Levenberg-Marquardt optimiser."""
    params = gtsam.LevenbergMarquardtParams()
    params.setMaxIterations(iterations)
    params.setRelativeErrorTol(_ERROR_TOLERANCE)
    # Sigmas range from 1e-5 (bias walks) to metres: too ill-conditioned for Cholesky.
    params.setLinearSolverType('MULTIFRONTAL_QR')
    return params


def _optimized(graph: Any, values: Any) -> Any:
    """The values that fit all factors."""
    params = _optimizer(_SMOOTHING_ITERATIONS)
    return gtsam.LevenbergMarquardtOptimizer(graph, values, params).optimize()


class KeyframeGraph:
    """Keyframes since a start; each new one optimises the newest window.

    `newest`: with its covariance in the window. `continued`: whether the start is a propagated
    state, whose unknowns have common errors. `keep`: whether all is recorded for `smoothed`.
    """

    def __init__(
        self,
        start: KeyframeState,
        unknown: Doubts,
        parameters: Parameters,
        *,
        continued: bool = False,
        keep: bool = False,
    ) -> None:
        self._doubts, self._imu, self._config = unknown, parameters.imu, parameters.odometry
        self._preintegration = factors.preintegration(self._config)
        self._noise = NoisePosterior()
        # Squared density of the gyro's noise before innovations show more.
        self._gyro_variance = self._imu.gyro_noise_density**2
        self._step: _Step | None = None
        self._smoother = self._new_smoother()
        # All factors and states since the start, for the final smoothing.
        self._record = (gtsam.NonlinearFactorGraph(), gtsam.Values()) if keep else None
        graph, values = gtsam.NonlinearFactorGraph(), gtsam.Values()
        pose = gtsam.Pose3(gtsam.Rot3(start.R), start.position)
        bias = gtsam.imuBias.ConstantBias(start.accel_bias, start.gyro_bias)
        values.insert(X(0), pose)
        values.insert(V(0), start.velocity)
        values.insert(B(0), bias)
        values.insert(L(0), start.doubts)

        def of(part: slice) -> Any:
            return factors.gaussian(start.covariance[part, part])

        if continued:
            graph.add(factors.joint_prior(0, values, start.covariance))
        else:
            graph.addPriorPose3(X(0), pose, of(POSE))
            graph.addPriorVector(V(0), start.velocity, of(VELOCITY))
            graph.addPriorConstantBias(B(0), bias, of(BIAS))
            graph.addPriorVector(L(0), start.doubts, of(DOUBTS))
        self._ahead = values
        self._update(graph, values, 0, 0.0)
        self._keep(graph)

    @property
    def findings(self) -> tuple[Finding, ...]:
        """Noises of the IMU that are far above the configured ones."""
        return self._noise.findings(self._imu)

    def use_sensor_rate(self, factor: float, between: float) -> None:
        """Count the noise of a gyro of whose samples each makes `factor` messages.

        The messages of one sample have one error, so that a turn has the noise of fewer samples.
        `between` [rad^2/s]: density of the errors of interpolation.
        """
        self._gyro_variance = factor * self._imu.gyro_noise_density**2 + between

    def propagated(self, interval: ImuInterval) -> KeyframeState:
        """The body after samples since the newest keyframe, without a new keyframe."""
        by, noise = self._linearised(self._predicted(interval))
        pose = self._ahead.atPose3(X(self._count))
        return replace(
            self.newest,
            R=pose.rotation().matrix(),
            position=pose.translation(),
            velocity=self._ahead.atVector(V(self._count)),
            covariance=by @ self.newest.covariance @ by.T + noise,
        )

    def restate(self, state: KeyframeState) -> None:
        """Let what is propagated begin at another state of the newest keyframe.

        For a graph that has ended: its factors do not know that state.
        """
        self.newest = state
        pose = gtsam.Pose3(gtsam.Rot3(state.R), state.position)
        self._nav_state = gtsam.NavState(pose, state.velocity)
        self._step = None

    def add(
        self,
        interval: ImuInterval,
        pair: PublishedPair | None,
        at_rest: bool,
        *,
        inflation: float = 1.0,
        gate: float = math.inf,
        proven: bool = False,
    ) -> float:
        """Add a keyframe after `interval`, and the pair with the previous one, if any.

        `at_rest`: whether images and IMU both are. `proven`: whether enough pairs agree with the
        path, so that its velocity may contradict images without translation. `inflation`: of the
        pair's covariance. Returns the innovation of the pair: its chi squared per degree of
        freedom before it is used, without `inflation`; 0 without information. A pair above `gate`
        is not used; with a gate, its covariance is larger by an innovation above 1, too.
        """
        i, j = self._count - 1, self._count
        self._noise.expect(interval, self._imu)
        step = self._predicted(interval)
        graph, values = gtsam.NonlinearFactorGraph(), gtsam.Values()
        values.insert(X(j), self._ahead.atPose3(X(j)))
        values.insert(V(j), self._ahead.atVector(V(j)))
        values.insert(B(j), self._bias)
        graph.add(step.residuals.factor())
        innovation = 0.0
        if pair is not None and pair.images is not None:
            motions = self._motions(interval)
            of_images = factors.pair_factor(i, j, pair, self._doubts, motions)
            found = self._innovation(step, of_images)
            innovation = found.chi_squared
            self._noise.observe(found, interval.duration)
            if innovation <= gate:
                sigma = math.sqrt(inflation * self._variance(innovation, gate))
                graph.add(factors.pair_factor(i, j, pair, self._doubts, motions, sigma))
                if pair.is_pure_rotation:
                    self._hold_still(graph, step, at_rest or not proven)
        if at_rest and innovation <= gate:
            at_zero = factors.diagonal([_REST_VELOCITY_SIGMA] * 3)
            for key in (V(i), V(j)):
                graph.addPriorVector(key, np.zeros(3), at_zero)
        seconds = self._seconds + interval.duration
        if pair is None and interval.duration > _LONGEST_BRIDGE * self._config.smoothing_lag:
            self._bridge(interval, values, j, seconds)
        else:
            self._update(graph, values, j, seconds)
        self._keep(graph)
        return innovation

    def _new_smoother(self) -> Any:
        """An empty window; each update is one step, which the next keyframe continues."""
        return gtsam.BatchFixedLagSmoother(self._config.smoothing_lag, _optimizer(1))

    def _bridge(self, interval: ImuInterval, values: Any, newest: int, seconds: float) -> None:
        """Begin another window at the newest keyframe, with all that the IMU leaves of the last.

        `values`: of that keyframe.
        """
        state = self.propagated(interval)
        values.insert(L(0), state.doubts)
        graph = gtsam.NonlinearFactorGraph()
        graph.add(factors.joint_prior(newest, values, state.covariance))
        self._smoother, self._ahead = self._new_smoother(), values
        self._update(graph, values, newest, seconds)

    def _keep(self, graph: Any) -> None:
        """Record factors for the final smoothing."""
        if self._record is not None:
            self._record[0].push_back(graph)

    def _hold_still(self, graph: Any, step: _Step, certain: bool) -> None:
        """Hold the camera in its place if this is `certain`, or if the IMU knows that it stays.

        Images without translation alone do not show it: an object that moves with the camera may
        fill the view. Just after a start they are better than the velocity of the path.
        """
        i, j = self._count - 1, self._count
        sigma = self._config.pure_rotation_motion
        still = factors.still_factor(i, j, sigma, self._doubts)
        motion = self._innovation(step, still)
        largest_variance = np.linalg.norm(motion.covariance, 2)
        speed_sigma = sigma * math.sqrt(largest_variance) / step.interval.duration
        agrees = motion.chi_squared <= _STILL_GATE
        if certain or (agrees and speed_sigma < _STILL_SPEED):
            graph.add(still)

    def _variance(
        self,
        innovation: float,
        gate: float,
    ) -> float:
        """Variance of a pair by that of its images.

        Without a gate, at a start, the misfit shows what is wrong. Later the variance is bounded
        below, as innovations hide errors that persist. Nor is it smaller than the innovation
        allows: a pair of a moving object has one of 4 to 16, and the path would follow it.
        [measured: docs/lab/odometry.md, "Disturbances"]
        """
        variance = self._noise.pair_variance
        if gate < math.inf:
            is_shown = self._noise.observed >= _SHOWN
            least = _LEAST_VARIANCE if is_shown else _FIRST_LEAST_VARIANCE
            variance = max(variance, least) * max(innovation, 1.0)
        return variance

    def scale_sigma(self) -> float:
        """1 sigma of the newest velocity, along its least certain direction, by its length.

        Given the heading, which a path that continues knows less well, and which is no scale.
        """
        covariance = self.newest.covariance
        with_heading = covariance[VELOCITY, ROTATION] @ self.newest.R[2]
        heading = self.newest.R[2] @ covariance[ROTATION, ROTATION] @ self.newest.R[2]
        by_heading = np.outer(with_heading, with_heading) / heading
        variance = np.linalg.norm(covariance[VELOCITY, VELOCITY] - by_heading, 2)
        speed = float(np.linalg.norm(self.newest.velocity))
        return math.sqrt(variance) / max(speed, _LEAST_SPEED)

    def misfit(self) -> float:
        """Chi squared of the window per degree of freedom."""
        graph: Any = self._smoother.getFactors()
        equations = 0
        for number in range(graph.size()):
            factor = graph.at(number)
            if factor is not None:
                equations += factor.dim()
        unknowns = self._values.dim()
        freedom = max(equations - unknowns, 1)
        return 2.0 * graph.error(self._values) / freedom

    def smoothed(self) -> list[KeyframeState]:
        """All keyframes since the start, given all measurements; needs `keep`."""
        with _solving():
            graph, values = self._smoothed()
            # An IMU factor has all unknowns of a keyframe.
            covariances = CommonCovariances(graph, values)
            return [_state(values, k, covariances.of(_keys(k))) for k in range(self._count)]

    def add_loops(self, loops: Sequence[Loop]) -> list[Loop]:
        """Add pairs of keyframes far apart to what is smoothed, and return those that count.

        They agree with the path without any of them, given its covariance, and then with that by
        all of them; needs `keep`.
        """
        with _solving():
            graph, values = self._smoothed()
            marginals = gtsam.Marginals(graph, values)
            misfits = [self._misfit(loop, values, marginals) for loop in loops]
            bound = 1.0
            while True:
                judgements = zip(loops, misfits, strict=True)
                loops = [loop for loop, misfit in judgements if misfit <= bound]
                graph, values = self._closed(loops, values)
                misfits = [self._misfit(loop, values) for loop in loops]
                worst = max(misfits, default=0.0)
                if worst <= 1.0:
                    break
                # The worst ones first: others may disagree because of them.
                bound = max(1.0, 0.5 * worst)
        self._record = graph, values
        return list(loops)

    # -- inside ------------------------------------------------------------------------------

    def _closed(
        self,
        loops: Sequence[Loop],
        values: Any,
    ) -> tuple[Any, Any]:
        """The record with loops, optimised."""
        assert self._record is not None
        graph = gtsam.NonlinearFactorGraph(self._record[0])
        for loop in loops:
            graph.add(factors.pair_factor(*loop, self._doubts, robust=True))
        return graph, _optimized(graph, values)

    def _misfit(
        self,
        loop: Loop,
        values: Any,
        marginals: Any = None,
    ) -> float:
        """Chi squared of a loop by its bound; `marginals`: of a path without it."""
        factor = factors.pair_factor(*loop, self._doubts)
        _, e = factor.linearize(values).jacobian()
        S = np.eye(len(e))
        if marginals is not None:
            # About the predicted pose: the tangents of other directions have steeper derivatives.
            at_path = self._predicted_loop(loop, values)
            predicted = factors.pair_factor(*at_path, self._doubts)
            A, _ = predicted.linearize(values).jacobian()
            of_path = _joint(marginals, list(factor.keys()))
            S += A @ of_path @ A.T
        chi_squared = float(e @ np.linalg.solve(S, e))
        return chi_squared / factors.loop_bound(len(e)) ** 2

    def _predicted_loop(
        self,
        loop: Loop,
        values: Any,
    ) -> Loop:
        """The same of the poses of a path."""
        images = loop.pair.images
        assert images is not None
        d = values.atVector(L(0))
        C, arm = self._doubts.R_cam_body(d), d[doubts.ARM]
        first, second = values.atPose3(X(loop.first)), values.atPose3(X(loop.second))
        way = first.between(second)
        moved = C @ (way.transformFrom(arm) - arm)
        direction = images.t
        if loop.pair.has_direction:
            direction = moved / np.linalg.norm(moved)
        R = C @ way.rotation().matrix() @ C.T
        predicted = replace(images, R=R, t=direction)
        return loop._replace(pair=replace(loop.pair, images=predicted))

    def _smoothed(self) -> tuple[Any, Any]:
        """The whole record with the values that fit it."""
        assert self._record is not None
        graph, values = self._record
        return graph, _optimized(graph, values)

    def _predicted(self, interval: ImuInterval) -> _Step:
        """Predict the next keyframe in `_ahead`.

        By the mean of two samples each; those of the prediction before are not repeated.
        """
        known = self._step
        first = 0
        if known is not None and _continues(interval, known.interval):
            pim = known.pim
            first = len(known.interval.seconds) - 1
        else:
            pim = gtsam.PreintegratedCombinedMeasurements(self._preintegration, self._bias)
        new = ImuInterval(
            interval.seconds[first:],
            interval.rates[first:],
            interval.forces[first:],
        )
        self._integrate(pim, new)
        rate = _mean_rate(interval) - self._bias.gyroscope()
        *matrix, lag = self.newest.doubts[self._doubts.sensors]
        change = -by_gyro_matrix(rate) @ matrix
        bias = factors.changed_bias(self._bias, change)
        state = pim.predict(self._nav_state, bias)
        R = state.pose().rotation()
        by_lag = _by_lag(interval, gtsam.Rot3.Logmap(pim.deltaRij())) @ self.newest.R.T
        velocity, position = lag * by_lag
        pose = gtsam.Pose3(R, state.position() + position)
        self._ahead.update(X(self._count), pose)
        self._ahead.update(V(self._count), state.velocity() + velocity)
        motion = factors.Motion(rate, by_lag, R.matrix())
        residuals = factors.ImuResiduals(self._count - 1, pim, motion, self._doubts)
        self._step = _Step(interval, pim, residuals)
        return self._step

    def _integrate(self, pim: Any, interval: ImuInterval) -> None:
        """Add samples to an integral, with their noise; knocks have more."""
        errors, params = self._noise, self._preintegration
        of_gyro = factors.gyro_variance(self._gyro_variance) + errors.gyro_errors**2
        of_accel = factors.accel_variance(self._imu) + errors.accel_errors**2
        params.setGyroscopeCovariance(of_gyro * _EYE)
        params.setAccelerometerCovariance(of_accel * _EYE)
        steps = np.diff(interval.seconds)
        forces = 0.5 * (interval.forces[1:] + interval.forces[:-1])
        rates = 0.5 * (interval.rates[1:] + interval.rates[:-1])
        by_knocks = knocks(interval) ** 2 * steps
        for force, rate, seconds, more in zip(forces, rates, steps, by_knocks, strict=True):
            if more:
                params.setAccelerometerCovariance((of_accel + more) * _EYE)
            pim.integrateMeasurement(force, rate, seconds)
            if more:
                params.setAccelerometerCovariance(of_accel * _EYE)

    def _linearised(self, step: _Step) -> tuple[Array, Array]:
        """How errors of the newest keyframe propagate, and the covariance of the samples.

        Both are of the size of the covariance of a keyframe.
        """
        # A_i d_i + A_j d_j + A_d d is white noise.
        A, of_doubts = step.residuals.derivatives(self._ahead)
        first = A[:, _OF_FIRST]
        second = A[:, _OF_SECOND]
        back = np.linalg.inv(second)
        size = len(self.newest.covariance)
        by = np.eye(size)
        by[_OWN, _OWN] = -back @ first
        by[_OWN, DOUBTS] = -back @ of_doubts
        noise = np.zeros((size, size))
        noise[_OWN, _OWN] = back @ back.T
        return by, noise

    def _innovation(
        self,
        step: _Step,
        factor: Any,
    ) -> Innovation:
        """The errors of a factor of the next keyframe with their covariance, given all before.

        Its keys are pose and velocity of both keyframes, or the poses alone, and `doubts`.
        """
        by, noise = self._linearised(step)
        H, e = factor.linearize(self._ahead).jacobian()
        own = (H.shape[1] - self._doubts.size) // 2
        of_first = H[:, :own]
        of_second = H[:, own : 2 * own]
        of_doubts = H[:, 2 * own :]
        second = np.zeros((len(e), len(by)))
        second[:, :own] = of_second
        whole = second @ by
        whole[:, :own] += of_first
        whole[:, DOUBTS] += of_doubts
        of_state = whole @ self.newest.covariance @ whole.T
        of_samples = second @ noise @ second.T
        by_accel, by_gyro = self._by_white_noise(step, second)
        return Innovation(e, of_state + of_samples, by_accel, by_gyro)

    def _by_white_noise(self, step: _Step, second: Array) -> tuple[Array, Array]:
        """Covariances (n, n) of errors by white noise of acceleration and rate of unit density.

        `second`: derivatives (n, m) by the second body, whose rotation, velocity and position the
        noise changes. A rotation turns the mean specific force.
        """
        pose = self._ahead.atPose3(X(self._count))
        R = pose.rotation().matrix()
        of_rotation = second[:, ROTATION]
        of_velocity = second[:, VELOCITY] @ R
        of_place = second[:, TRANSLATION]
        mean_force = step.interval.forces.mean(axis=0)
        turned = -skew(mean_force)
        integrals = integrals_of_noise(step.interval.duration)
        by_accel = spread([of_velocity, of_place], integrals[:2, :2])
        by_gyro = spread([of_rotation, of_velocity @ turned, of_place @ turned], integrals)
        return by_accel, by_gyro

    def _motions(self, interval: ImuInterval) -> tuple[Array, Array]:
        """Rates (2, 3) and specific forces (2, 3) of the body at the ends of an interval."""
        ends = [0, -1]
        rates = interval.rates[ends] - self._bias.gyroscope()
        return rates, interval.forces[ends] - self._bias.accelerometer()

    def _update(
        self,
        graph: Any,
        values: Any,
        newest: int,
        seconds: float,
    ) -> None:
        """Add the newest keyframe, at `seconds` in the window; after a failure none is added.

        A step is repeated where it has changed the ways of the camera, at which directions are
        linearised.
        """
        with _solving():
            # What all keyframes share stays in the window.
            times = dict.fromkeys([*values.keys(), L(0)], seconds)
            ways = _ways(self._ahead, newest)
            self._smoother.update(graph, values, times)
            for _ in range(1, _MOST_STEPS):
                before, ways = ways, _ways(self._smoother.calculateEstimate(), newest)
                if _longest_share(ways - before, ways) < _MOVED:
                    break
                self._smoother.update(gtsam.NonlinearFactorGraph(), gtsam.Values(), {})
            self._read(newest)
        self._count, self._seconds = newest + 1, seconds  # keyframes; time of the newest

    def _read(self, newest: int) -> None:
        """Read the estimates of the smoother."""
        values = self._smoother.calculateEstimate()
        covariance = joint_covariance(self._smoother.getFactors(), values, _keys(newest))
        self._values = values
        self.newest = _state(values, newest, covariance)
        pose = values.atPose3(X(newest))
        velocity = values.atVector(V(newest))
        self._bias = values.atConstantBias(B(newest))
        self._nav_state = gtsam.NavState(pose, velocity)
        # The window, with a place for the prediction of the next keyframe.
        ahead = gtsam.Values(values)
        ahead.insert(X(newest + 1), pose)
        ahead.insert(V(newest + 1), velocity)
        ahead.insert(B(newest + 1), self._bias)
        self._ahead = ahead
        self._step = None
        if self._record is not None:
            self._record[1].insert_or_assign(values)


def _by_lag(interval: ImuInterval, turn: Array) -> Array:
    """Change (2, 3) of the integrals of the force by a lag of the accelerometer, per second.

    Of velocity and position, in the axes at the begin; `turn` (3,): rotation vector over the
    interval. The true force is later in the samples: its derivative is integrated.
    """
    seconds = interval.seconds - interval.seconds[0]
    duration = seconds[-1]
    middle = 0.5 * (seconds[1:] + seconds[:-1])
    changes = interval.forces[1:] - interval.forces[:-1]
    # A change counts for the velocity, and for the position as long as it lasts.
    weights = np.array([np.ones(len(middle)), duration - middle])
    # Each change turns about one axis, in proportion to time (Rodrigues' formula).
    angle = math.sqrt(turn @ turn)
    axis = turn / max(angle, _TINY)
    angles = middle * (angle / duration)
    cosines = np.cos(angles)
    along = (weights * (1.0 - cosines)) @ (changes @ axis)
    across = (weights * np.sin(angles)) @ changes
    return np.asarray((weights * cosines) @ changes - across @ skew(axis) + np.outer(along, axis))


def _ways(values: Any, newest: int) -> Array:
    """Ways (K, 3) of the camera between the newest keyframes [m]."""
    arm = values.atVector(L(0))[doubts.ARM]
    numbers = range(max(newest - _COMPARED, 0), newest + 1)
    places = [values.atPose3(X(k)).transformFrom(arm) for k in numbers if values.exists(X(k))]
    return np.diff(np.reshape(places, (-1, 3)), axis=0)


def _longest_share(changes: Array, ways: Array) -> float:
    """Largest change of a way as a share of its length."""
    lengths = np.linalg.norm(ways, axis=1)
    sizes = np.linalg.norm(changes, axis=1)
    return float((sizes / np.maximum(lengths, _LEAST_WAY)).max(initial=0.0))


def _mean_rate(interval: ImuInterval) -> Array:
    """Mean (3,) of the rates over the time of an interval."""
    seconds = interval.seconds
    steps = seconds[1:] - seconds[:-1]
    sums = interval.rates[1:] + interval.rates[:-1]
    return np.asarray(0.5 * steps @ sums / steps.sum())


def _continues(interval: ImuInterval, known: ImuInterval) -> bool:
    """Whether an interval begins with all samples of another one."""
    pairs = zip(known, interval, strict=True)
    return all(old.tobytes() == new[: len(old)].tobytes() for old, new in pairs)


@contextmanager
def _solving() -> Iterator[None]:
    """Raise a failure of gtsam as GraphError."""
    try:
        yield
    except RuntimeError as error:  # of several lines
        first_line = str(error).strip().partition('\n')[0]
        raise GraphError(f'the graph cannot be solved: {first_line}') from error


def _state(values: Any, k: int, covariance: Array) -> KeyframeState:
    """A keyframe with its covariance, that of `_keys`."""
    pose, bias = values.atPose3(X(k)), values.atConstantBias(B(k))
    return KeyframeState(
        R=pose.rotation().matrix(),
        position=pose.translation(),
        velocity=values.atVector(V(k)),
        gyro_bias=bias.gyroscope(),
        accel_bias=bias.accelerometer(),
        doubts=values.atVector(L(0)),
        covariance=covariance,
    )


def _keys(k: int) -> list[int]:
    """The unknowns of a keyframe in the order of its covariance."""
    return [X(k), V(k), B(k), L(0)]


def _joint(marginals: Any, keys: list[int]) -> Array:
    """Covariance of several unknowns, in their order."""
    joint = marginals.jointMarginalCovariance(keys)
    return np.block([[joint.at(a, b) for b in keys] for a in keys])
