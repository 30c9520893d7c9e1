"""The graph of keyframes in gtsam, and the window of it that is optimised as keyframes arrive.

States of a keyframe: pose and velocity of the body (the IMU) in a world with z up, and the biases;
of all keyframes: the vector of `doubts`. Factors: the preintegrated IMU between consecutive
keyframes, and for a pair the information of its images alone (`estimator.covariance`), so that no
IMU sample counts twice.
"""

from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, replace
import math
from typing import Any, NamedTuple

import gtsam
from gtsam.symbol_shorthand import B, L, V, X
import numpy as np
from scipy.special import gammaincinv

from rs_relpose_ros.config.settings import ImuConfig, OdometryConfig, Parameters
from rs_relpose_ros.core.deviations import slices
from rs_relpose_ros.errors import RsRelposeError
from rs_relpose_ros.geometry import Array
from rs_relpose_ros.geometry.so3 import skew, STANDARD_GRAVITY
from rs_relpose_ros.imu.buffer import ImuInterval
from rs_relpose_ros.messages.published_pair import PublishedPair
from rs_relpose_ros.odometry import doubts
from rs_relpose_ros.odometry.doubts import Doubts
from rs_relpose_ros.odometry.pair import (
    Body,
    COLUMNS,
    deviations,
    Measured,
    Mount,
    square_root,
)

# 1 sigma of the velocity of a body at rest [m/s], per axis. A smaller one holds a body that
# creeps; a larger one lets the path drift at rest. [chosen: 2 to 10 mm/s: a hand that holds still]
_REST_VELOCITY_SIGMA = 0.005
# Speed [m/s] below which the uncertainty of a velocity is taken relative to this speed: relative
# to 2 cm/s each sigma is large, and no slow camera would start; without it wrong starts happened
# in slow motion. [measured: docs/lab/odometry.md, "Starts", slow motion]
_LEAST_SPEED = 0.1
# Largest share of the window that one interval takes. A longer bridge would push the states before
# it out of the window, and the first pairs after it could not correct them. [chosen: 0.1 to 0.5]
_LONGEST_STEP = 0.25
# Steps of the optimisation with a keyframe until the start, where the linearisation is far off.
# [measured: with 10 another one changes no path by 0.2 mm, docs/lab/odometry.md]
_START_STEPS = 10
# Densities [m/s^2/sqrt(Hz)] of errors of an accelerometer that its noise has not (scale, axes,
# vibration, clock), from which innovations choose.
# [measured: docs/lab/odometry.md, "Noise by innovations": 0 to 27e-3 on seven recordings]
_ACCEL_ERRORS = np.array([0.0, 2e-3, 4e-3, 8e-3, 16e-3, 32e-3])[:, None]
# 1 sigma of that density before any innovation. [measured: there, starts of recordings]
_ACCEL_ERROR_SIGMA = 8e-3
# Variances of pairs by those of their images, from which innovations choose. [measured: there:
# 0.5 to 3.9]
_PAIR_VARIANCES = np.array([0.5, 0.7, 1.0, 1.5, 2.0, 3.0, 4.0])
# 1 sigma of the logarithm of that variance before any innovation. [measured: there]
_PAIR_LOG_SIGMA = 0.7
_LIKELY = -0.5 * (
    (_ACCEL_ERRORS / _ACCEL_ERROR_SIGMA) ** 2 + (np.log(_PAIR_VARIANCES) / _PAIR_LOG_SIGMA) ** 2
)
# Time in which innovations are forgotten [s]. A shorter one follows a change of the motion, with
# fewer innovations to choose by. [chosen: 10 to 60 s would do]
_FORGOTTEN = 20.0
# Largest share of one pair in that choice, as a difference of log likelihoods: a single wrong pair
# must not decide. [chosen: 3 to 10 would do: the prior of the extreme values is 2 to 8]
_ONE_PAIR = 6.0
# Integration error of the samples, as a noise density of the position [m/sqrt(s)]: the mean of two
# samples is not the mean of the acceleration between them. [chosen: 0.1 mm after a second, below
# the noise of any accelerometer]
_INTEGRATION = 1e-4
# Share of right loops within the bound of chi squared: 1 % of them are lost.
# [chosen: 0.95 to 0.999 would do; measured with 0.99 in docs/lab/odometry.md, "Loop closures"]
_LOOP_QUANTILE = 0.99
# Iterations of the optimiser for the smoothed path, and its tolerance of the relative error.
# [measured: tolerances change no path by 0.1 mm, docs/lab/odometry.md, "As a process"]
_SMOOTHING_ITERATIONS = 10
_ERROR_TOLERANCE = 1e-4

# Columns of the derivatives of a pair, by the keys of the two bodies.
_OF_BODIES = tuple(COLUMNS[key] for key in ('X1', 'V1', 'X2', 'V2'))
# Columns of the derivatives of an IMU factor, by its keys.
_IMU = slices({'X1': 6, 'V1': 3, 'X2': 6, 'V2': 3, 'B1': 6, 'B2': 6})
_OF_FIRST = np.r_[_IMU['X1'], _IMU['V1'], _IMU['B1']]
_OF_SECOND = np.r_[_IMU['X2'], _IMU['V2'], _IMU['B2']]
# Columns of the covariance of a keyframe; the vector of `doubts` follows.
_KEYFRAME = slices({'pose': 6, 'velocity': 3, 'accel_bias': 3, 'gyro_bias': 3, 'arm': 3})
POSE = _KEYFRAME['pose']
VELOCITY = _KEYFRAME['velocity']
GYRO_BIAS = _KEYFRAME['gyro_bias']
ARM = _KEYFRAME['arm']
BIAS = slice(_KEYFRAME['accel_bias'].start, GYRO_BIAS.stop)
DOUBTS = slice(ARM.start, None)
# Unknowns of a keyframe without `doubts`.
_OWN = ARM.start


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
    doubts: Array  # (3 + k,) of `doubts.Doubts`
    # (18 + k, 18 + k) of rotation and translation in the axes of the body, velocity in the world,
    # biases of accelerometer and gyro, doubts.
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


def _preintegration(imu: ImuConfig, config: OdometryConfig) -> Any:
    """Noise densities of the samples for gtsam."""
    params = gtsam.PreintegrationCombinedParams.MakeSharedU(STANDARD_GRAVITY)
    eye = np.eye(3)
    params.setGyroscopeCovariance(imu.gyro_noise_density**2 * eye)
    params.setIntegrationCovariance(_INTEGRATION**2 * eye)
    params.setBiasOmegaCovariance(config.gyro_bias_walk**2 * eye)
    params.setBiasAccCovariance(config.accel_bias_walk**2 * eye)
    return params


def _optimizer(iterations: int) -> Any:
    """Parameters of gtsam's Levenberg-Marquardt optimiser."""
    params = gtsam.LevenbergMarquardtParams()
    params.setMaxIterations(iterations)
    params.setRelativeErrorTol(_ERROR_TOLERANCE)
    # Sigmas range from 1e-5 (bias walks) to metres: too ill-conditioned for Cholesky.
    params.setLinearSolverType('MULTIFRONTAL_QR')
    return params


def _optimized(factors: Any, values: Any) -> Any:
    """The values that fit all factors."""
    params = _optimizer(_SMOOTHING_ITERATIONS)
    return gtsam.LevenbergMarquardtOptimizer(factors, values, params).optimize()


class _Innovation(NamedTuple):
    """A pair against all before it and the samples."""

    errors: Array  # (n,) in units of the pair's sigmas
    covariance: Array  # (n, n) without the pair's own
    by_accelerometer: Array  # (n, n) change of that by the variance of the accelerometer's noise

    @property
    def chi_squared(self) -> float:
        """Per degree of freedom."""
        n = len(self.errors)
        whitened = np.linalg.solve(np.eye(n) + self.covariance, self.errors)
        return float(self.errors @ whitened) / n


class _Noise:
    """Noise of accelerometer and pairs as innovations show it, by a posterior over a grid."""

    def __init__(self) -> None:
        self._log = _LIKELY
        self._read()

    def observe(
        self,
        innovation: _Innovation,
        seconds: float,
    ) -> None:
        """Use an innovation; `seconds`: since the one before."""
        more = (_ACCEL_ERRORS**2 - self.accel_errors**2)[..., None]
        covariances = innovation.covariance + more * innovation.by_accelerometer
        known, vectors = np.linalg.eigh(covariances)
        squares = (innovation.errors @ vectors)[:, None] ** 2
        variances = np.maximum(known, 0.0)[:, None] + _PAIR_VARIANCES[:, None]
        log = -0.5 * (squares / variances + np.log(variances)).sum(axis=2)
        kept = math.exp(-seconds / _FORGOTTEN)
        remembered = kept * self._log + (1.0 - kept) * _LIKELY
        self._log = remembered + np.maximum(log - log.max(), -_ONE_PAIR)
        self._read()

    def _read(self) -> None:
        weights = np.exp(self._log - self._log.max())
        weights /= weights.sum()
        self.accel_errors = math.sqrt((weights * _ACCEL_ERRORS**2).sum())
        self.pair_variance = math.exp((weights * np.log(_PAIR_VARIANCES)).sum())


class KeyframeGraph:
    """Keyframes since a start; each new one optimises the newest window.

    `newest`: with its covariance in the window. `keep`: whether all is recorded for `smoothed`.
    """

    def __init__(
        self,
        start: KeyframeState,
        unknown: Doubts,
        parameters: Parameters,
        *,
        keep: bool = False,
    ) -> None:
        self._doubts, self._imu, self._config = unknown, parameters.imu, parameters.odometry
        self._R_cam_body = parameters.sensor.R_cam_imu
        self._preintegration = _preintegration(self._imu, self._config)
        self._noise = _Noise()
        # Samples since the newest keyframe, and their integral.
        self._integrated: tuple[ImuInterval | None, Any] = None, None
        # Each update is one step of the optimisation, which the next keyframe continues.
        lag = self._config.smoothing_lag
        self._smoother = gtsam.BatchFixedLagSmoother(lag, _optimizer(1))
        # All factors and states since the start, for the final smoothing.
        self._record = (gtsam.NonlinearFactorGraph(), gtsam.Values()) if keep else None
        factors, values = gtsam.NonlinearFactorGraph(), gtsam.Values()
        pose = gtsam.Pose3(gtsam.Rot3(start.R), start.position)
        bias = gtsam.imuBias.ConstantBias(start.accel_bias, start.gyro_bias)
        values.insert(X(0), pose)
        values.insert(V(0), start.velocity)
        values.insert(B(0), bias)
        values.insert(L(0), start.doubts)

        def of(part: slice) -> Any:
            return _gaussian(start.covariance[part, part])

        factors.addPriorPose3(X(0), pose, of(POSE))
        factors.addPriorVector(V(0), start.velocity, of(VELOCITY))
        factors.addPriorConstantBias(B(0), bias, of(BIAS))
        factors.addPriorVector(L(0), start.doubts, of(DOUBTS))
        self._update(factors, values, 0, 0.0)

    def use_sensor_rate(self, factor: float, between: float) -> None:
        """Count the noise of a gyro of whose samples each makes `factor` messages.

        The messages of one sample have one error, so that a turn has the noise of fewer samples.
        `between` [rad^2/s]: density of the errors of interpolation.
        """
        density = factor * self._imu.gyro_noise_density**2 + between
        self._preintegration.setGyroscopeCovariance(density * np.eye(3))

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

    def add(
        self,
        interval: ImuInterval,
        pair: PublishedPair | None,
        at_rest: bool,
        *,
        inflation: float = 1.0,
        gate: float = math.inf,
    ) -> float:
        """Add a keyframe after `interval`, and the pair with the previous one, if any.

        `inflation`: of the pair's covariance. Returns the innovation of the pair: its chi squared
        per degree of freedom before it is used, without `inflation`; 0 without information. A
        pair above `gate` is not used; with a gate, its covariance is larger by an innovation
        above 1, too.
        """
        i, j = self._count - 1, self._count
        pim = self._predicted(interval)
        factors, values = gtsam.NonlinearFactorGraph(), gtsam.Values()
        values.insert(X(j), self._ahead.atPose3(X(j)))
        values.insert(V(j), self._ahead.atVector(V(j)))
        values.insert(B(j), self._bias)
        factors.add(_imu_factor(i, j, pim))
        innovation = 0.0
        if pair is not None and pair.images is not None:
            motions = self._motions(interval)
            found = self._innovation(pim, self._pair_factor(i, j, pair, motions))
            innovation = found.chi_squared
            if innovation <= gate:
                variance = inflation * self._variance(innovation, gate)
                factors.add(self._pair_factor(i, j, pair, motions, math.sqrt(variance)))
                self._noise.observe(found, interval.duration)
                if pair.is_pure_rotation:
                    factors.add(self._still_factor(i, j))
        if at_rest and innovation <= gate:
            at_zero = _diagonal([_REST_VELOCITY_SIGMA] * 3)
            for key in (V(i), V(j)):
                factors.addPriorVector(key, np.zeros(3), at_zero)
        # States before a long bridge stay: the first pairs after it correct them, too.
        step = min(interval.duration, _LONGEST_STEP * self._config.smoothing_lag)
        steps = _START_STEPS if pair is not None and gate == math.inf else 1
        self._update(factors, values, j, self._seconds + step, steps)
        return innovation

    def _variance(
        self,
        innovation: float,
        gate: float,
    ) -> float:
        """Variance of a pair by that of its images.

        Without a gate, at a start, the misfit shows what is wrong. Later the variance is no
        smaller than that of the images, as innovations hide errors that persist: without this
        bound 6 % of the rotations are beyond the 99.7 % quantile, with it 0.1 %. Nor is it smaller
        than the innovation allows: a pair of a moving object has one of 4 to 16, and the path
        would follow it. [measured: docs/lab/odometry.md, "Noise by innovations", "Disturbances"]
        """
        variance = self._noise.pair_variance
        if gate < math.inf:
            variance = max(variance, 1.0) * max(innovation, 1.0)
        return variance

    def scale_sigma(self) -> float:
        """1 sigma of the newest velocity, along its least certain direction, by its length."""
        variance = np.linalg.norm(self.newest.covariance[VELOCITY, VELOCITY], 2)
        speed = float(np.linalg.norm(self.newest.velocity))
        return math.sqrt(variance) / max(speed, _LEAST_SPEED)

    def misfit(self) -> float:
        """Chi squared of the window per degree of freedom."""
        graph: Any = self._smoother.getFactors()
        factors = [graph.at(k) for k in range(graph.size())]
        equations = sum(factor.dim() for factor in factors if factor is not None)
        freedom = max(equations - self._values.dim(), 1)
        return 2.0 * graph.error(self._values) / freedom

    def smoothed(self) -> list[KeyframeState]:
        """All keyframes since the start, given all measurements; needs `keep`."""
        with _solving():
            values, marginals = self._smoothed()
            return [_state(values, marginals, k) for k in range(self._count)]

    def add_loops(self, loops: Sequence[Loop]) -> list[Loop]:
        """Add pairs of keyframes far apart to what is smoothed, and return those that count.

        They agree with the path without any of them, given its covariance, and then with that by
        all of them; needs `keep`.
        """
        with _solving():
            values, marginals = self._smoothed()
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
            graph.add(self._pair_factor(*loop, robust=True))
        return graph, _optimized(graph, values)

    def _misfit(
        self,
        loop: Loop,
        values: Any,
        marginals: Any = None,
    ) -> float:
        """Chi squared of a loop by its bound; `marginals`: of a path without it."""
        factor = self._pair_factor(*loop)
        _, e = factor.linearize(values).jacobian()
        S = np.eye(len(e))
        if marginals is not None:
            # About the predicted pose: the tangents of other directions have steeper derivatives.
            predicted = self._pair_factor(*self._predicted_loop(loop, values))
            A, _ = predicted.linearize(values).jacobian()
            S += A @ _joint(marginals, list(factor.keys())) @ A.T
        return float(e @ np.linalg.solve(S, e)) / _loop_bound(len(e)) ** 2

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
        way = values.atPose3(X(loop.first)).between(values.atPose3(X(loop.second)))
        moved = C @ (way.transformFrom(arm) - arm)
        direction = moved / np.linalg.norm(moved) if loop.pair.has_direction else images.t
        predicted = replace(images, R=C @ way.rotation().matrix() @ C.T, t=direction)
        return loop._replace(pair=replace(loop.pair, images=predicted))

    def _smoothed(self) -> tuple[Any, Any]:
        """Values and marginals of the whole record."""
        assert self._record is not None
        factors, values = self._record
        values = _optimized(factors, values)
        return values, gtsam.Marginals(factors, values)

    def _predicted(self, interval: ImuInterval) -> Any:
        """Predict the next keyframe in `_ahead`; ``gtsam.PreintegratedCombinedMeasurements``.

        By the mean of two samples each; those of the prediction before are not repeated.
        """
        (known, pim), first = self._integrated, 0
        if known and _continues(interval, known):
            first = len(known.seconds) - 1
        else:
            variance = self._imu.accel_noise_density**2 + self._noise.accel_errors**2
            self._preintegration.setAccelerometerCovariance(variance * np.eye(3))
            pim = gtsam.PreintegratedCombinedMeasurements(self._preintegration, self._bias)
        forces, rates = interval.forces[first:], interval.rates[first:]
        steps = np.diff(interval.seconds[first:])
        mean_forces = 0.5 * (forces[1:] + forces[:-1])
        mean_rates = 0.5 * (rates[1:] + rates[:-1])
        for force, rate, step in zip(mean_forces, mean_rates, steps, strict=True):
            pim.integrateMeasurement(force, rate, step)
        self._integrated = interval, pim
        state = pim.predict(self._nav_state, self._bias)
        self._ahead.update(X(self._count), state.pose())
        self._ahead.update(V(self._count), state.velocity())
        return pim

    def _linearised(self, pim: Any) -> tuple[Array, Array]:
        """How errors of the newest keyframe propagate, and the covariance of the samples.

        Both are of the size of the covariance of a keyframe.
        """
        factor = _imu_factor(self._count - 1, self._count, pim)
        # A_i d_i + A_j d_j is white noise.
        A, _ = factor.linearize(self._ahead).jacobian()
        back = np.linalg.inv(A[:, _OF_SECOND])
        size = len(self.newest.covariance)
        by, noise = np.eye(size), np.zeros((size, size))
        by[:_OWN, :_OWN] = -back @ A[:, _OF_FIRST]
        noise[:_OWN, :_OWN] = back @ back.T
        return by, noise

    def _innovation(
        self,
        pim: Any,
        of_pair: Any,
    ) -> _Innovation:
        """The errors of a pair factor with their covariance, given all before it."""
        by, noise = self._linearised(pim)
        H, e = of_pair.linearize(self._ahead).jacobian()
        poses = POSE.stop + 3  # pose and velocity
        second = np.zeros((len(e), len(by)))
        second[:, :poses] = H[:, poses : 2 * poses]
        whole = second @ by
        whole[:, :poses] += H[:, :poses]
        whole[:, DOUBTS] += H[:, 2 * poses :]
        # White noise of the acceleration in position and velocity of the second body.
        seconds = pim.deltaTij()
        R = self._ahead.atPose3(X(self._count)).rotation().matrix()
        of_velocity = second[:, VELOCITY] @ R
        of_both = second[:, 3:6] + (1.5 / seconds) * of_velocity
        by_position = seconds**3 / 3.0 * of_both @ of_both.T
        by_velocity = seconds / 4.0 * of_velocity @ of_velocity.T
        predicted = whole @ self.newest.covariance @ whole.T + second @ noise @ second.T
        return _Innovation(e, predicted, by_position + by_velocity)

    def _motions(self, interval: ImuInterval) -> tuple[Array, Array]:
        """Rates (2, 3) and specific forces (2, 3) of the body at the ends of an interval."""
        ends = [0, -1]
        rates = interval.rates[ends] - self._bias.gyroscope()
        return rates, interval.forces[ends] - self._bias.accelerometer()

    def _pair_factor(
        self,
        i: int,
        j: int,
        pair: PublishedPair,
        motions: tuple[Array, Array] = (np.zeros((2, 3)), np.zeros((2, 3))),
        sigma: float = 1.0,
        *,
        robust: bool = False,
    ) -> Any:
        """The images of a pair against two bodies; `motions`: their rates and specific forces.

        A loop has no motions: it has no velocities, the only ones that depend on the rates.
        """
        images, unknown = pair.images, self._doubts
        assert images is not None
        root, offset = square_root(images.information, images.gradient)
        n = root.shape[1]
        measured = Measured.of(pair)
        R_cam_body = self._R_cam_body
        rates, forces = motions
        noise = _diagonal([sigma] * len(offset))
        if robust:
            huber = gtsam.noiseModel.mEstimator.Huber.Create(_loop_bound(len(offset)))
            noise = gtsam.noiseModel.Robust.Create(huber, noise)
        # The estimate of the images moves with the deviations, too.
        by_images = np.zeros((n, len(unknown.active)))
        if images.by_deviation is not None:
            by_images = images.by_deviation[:, unknown.active]
        keys = x1, v1, x2, v2, common = [X(i), V(i), X(j), V(j), L(0)]

        def error(
            _: Any,
            values: Any,
            jacobians: Any,
        ) -> Array:
            d = values.atVector(common)
            axes, delay = unknown.mount(d)
            mount = Mount(R_cam_body, d[doubts.ARM].copy(), axes, delay)
            first = Body.of(values.atPose3(x1), values.atVector(v1), rates[0], forces[0])
            second = Body.of(values.atPose3(x2), values.atVector(v2), rates[1], forces[1])
            e, by = deviations(first, second, mount, measured)
            e, by = e[:n] - by_images @ d[3:], by[:n]
            if jacobians is not None:
                whole = (by.T @ root.T).T  # column-major, as gtsam requires
                for block, columns in enumerate(_OF_BODIES):
                    jacobians[block] = whole[:, columns]
                by_others = by[:, COLUMNS['mount']] @ unknown.by_mount - by_images
                by_all = np.hstack([whole[:, COLUMNS['arm']], root @ by_others])
                jacobians[len(_OF_BODIES)] = np.asfortranarray(by_all)
            return np.asarray(root @ e + offset)

        return gtsam.CustomFactor(noise, keys, error)

    def _still_factor(
        self,
        i: int,
        j: int,
    ) -> Any:
        """The camera keeps its position under any rotation of the body."""
        unknown = len(self._doubts.active)

        def error(
            factor: Any,
            values: Any,
            jacobians: Any,
        ) -> Array:
            first, second, common = factor.keys()
            pose1, pose2 = values.atPose3(first), values.atPose3(second)
            R1, R2 = pose1.rotation().matrix(), pose2.rotation().matrix()
            arm = values.atVector(common)[doubts.ARM]
            if jacobians is not None:
                across = skew(arm)
                jacobians[0] = np.asfortranarray(np.hstack([R1 @ across, -R1]))
                jacobians[1] = np.asfortranarray(np.hstack([-R2 @ across, R2]))
                by_others = np.zeros((3, unknown))
                jacobians[2] = np.asfortranarray(np.hstack([R2 - R1, by_others]))
            moved = pose2.translation() + R2 @ arm - pose1.translation() - R1 @ arm
            return np.asarray(moved)

        noise = _diagonal([self._config.pure_rotation_motion] * 3)
        return gtsam.CustomFactor(noise, [X(i), X(j), L(0)], error)

    def _update(
        self,
        factors: Any,
        values: Any,
        newest: int,
        seconds: float,
        steps: int = 1,
    ) -> None:
        """Add the newest keyframe, at `seconds` in the window; after a failure none is added."""
        with _solving():
            # What all keyframes share stays in the window.
            times = dict.fromkeys([*values.keys(), L(0)], seconds)
            self._smoother.update(factors, values, times)
            for _ in range(steps - 1):
                self._smoother.update(gtsam.NonlinearFactorGraph(), gtsam.Values(), {})
            self._read(newest)
        self._count, self._seconds = newest + 1, seconds  # keyframes; time of the newest
        if self._record is not None:
            self._record[0].push_back(factors)

    def _read(self, newest: int) -> None:
        """Read the estimates of the smoother."""
        values = self._values = self._smoother.calculateEstimate()
        marginals = gtsam.Marginals(self._smoother.getFactors(), values)
        self._bias = values.atConstantBias(B(newest))
        self.newest = _state(values, marginals, newest)
        velocity = values.atVector(V(newest))
        self._nav_state = gtsam.NavState(values.atPose3(X(newest)), velocity)
        # The window, with a place for the prediction of the next keyframe.
        self._ahead = gtsam.Values(values)
        self._ahead.insert(X(newest + 1), self._nav_state.pose())
        self._ahead.insert(V(newest + 1), self._nav_state.velocity())
        self._ahead.insert(B(newest + 1), self._bias)
        self._integrated = None, None
        if self._record is not None:
            self._record[1].insert_or_assign(values)


def _continues(interval: ImuInterval, known: ImuInterval) -> bool:
    """Whether an interval begins with all samples of another one."""
    pairs = zip(known, interval, strict=True)
    return all(np.array_equal(old, new[: len(old)]) for old, new in pairs)


def _loop_bound(dimension: int) -> float:
    """Largest normalised residual of a loop."""
    # The quantile of chi squared; scipy.stats takes a second to import.
    return math.sqrt(2.0 * gammaincinv(0.5 * dimension, _LOOP_QUANTILE))


@contextmanager
def _solving() -> Iterator[None]:
    """Raise a failure of gtsam as GraphError."""
    try:
        yield
    except RuntimeError as error:  # of several lines
        first_line = str(error).strip().partition('\n')[0]
        raise GraphError(f'the graph cannot be solved: {first_line}') from error


def _state(
    values: Any,
    marginals: Any,
    k: int,
) -> KeyframeState:
    """A keyframe with its covariance."""
    pose, bias = values.atPose3(X(k)), values.atConstantBias(B(k))
    return KeyframeState(
        R=pose.rotation().matrix(),
        position=pose.translation(),
        velocity=values.atVector(V(k)),
        gyro_bias=bias.gyroscope(),
        accel_bias=bias.accelerometer(),
        doubts=values.atVector(L(0)),
        covariance=_joint(marginals, [X(k), V(k), B(k), L(0)]),
    )


def _joint(marginals: Any, keys: list[int]) -> Array:
    """Covariance of several unknowns, in their order."""
    joint = marginals.jointMarginalCovariance(keys)
    return np.block([[joint.at(a, b) for b in keys] for a in keys])


def _imu_factor(
    i: int,
    j: int,
    pim: Any,
) -> Any:
    return gtsam.CombinedImuFactor(X(i), V(i), X(j), V(j), B(i), B(j), pim)


def _gaussian(covariance: Array) -> Any:
    return gtsam.noiseModel.Gaussian.Covariance(np.ascontiguousarray(covariance))


def _diagonal(sigmas: Any) -> Any:
    return gtsam.noiseModel.Diagonal.Sigmas(np.asarray(sigmas, dtype=np.float64))
