"""The graph of keyframes in gtsam, and the window of it that is optimised as keyframes arrive.

States of a keyframe: pose and velocity of the body (the IMU) in a world with z up, and the biases;
of all keyframes: the position of the camera on the body. Factors: the preintegrated IMU between
consecutive keyframes, and for a pair the information of its images alone (`estimator.covariance`),
so that no IMU sample counts twice.
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

from rs_relpose_ros.config.settings import ImuConfig, OdometryConfig
from rs_relpose_ros.errors import RsRelposeError
from rs_relpose_ros.geometry import Array
from rs_relpose_ros.geometry.so3 import skew, STANDARD_GRAVITY
from rs_relpose_ros.imu.buffer import ImuInterval
from rs_relpose_ros.odometry.pair import deviations, KeyframePair, square_root

# 1 sigma of the velocity of a body at rest [m/s], per axis.
_REST_VELOCITY_SIGMA = 0.005
# Speed [m/s] below which the uncertainty of a velocity is relative to it.
_LEAST_SPEED = 0.1
# Largest share of the window that one interval takes.
_LONGEST_STEP = 0.25
# Steps of the optimisation with a keyframe until the start; then one changes no path by 0.2 mm.
_START_STEPS = 10
# Errors of an accelerometer that its noise density has not (scale, axes, vibration, clock), as
# another density [m/s^2/sqrt(Hz)], and variances of pairs by those of their images: values that
# innovations choose from, with 1 sigma of the former and of the logarithm of the latter before
# them; time in which they are forgotten [s] (docs/lab/odometry.md, "Noise by innovations").
_ACCEL_ERRORS = np.array([0.0, 2e-3, 4e-3, 8e-3, 16e-3, 32e-3])[:, None]
_PAIR_VARIANCES = np.array([0.5, 0.7, 1.0, 1.5, 2.0, 3.0, 4.0])
_LIKELY = -0.5 * ((_ACCEL_ERRORS / 8e-3) ** 2 + (np.log(_PAIR_VARIANCES) / 0.7) ** 2)
_FORGOTTEN = 20.0
# Largest share of one pair in that choice, as a difference of log likelihoods.
_ONE_PAIR = 6.0
# Integration error of the samples, as a noise density of the position [m/sqrt(s)].
_INTEGRATION = 1e-4
# Share of right loops within the bound of chi squared.
_LOOP_QUANTILE = 0.99

# Columns of a pair's derivatives: pose and velocity of the first body, of the second one, camera.
_BLOCKS = (slice(0, 6), slice(6, 9), slice(9, 15), slice(15, 18), slice(18, 21))
# Columns of the derivatives of an IMU factor by its first body with biases, and by its second one.
_OF_FIRST, _OF_SECOND = np.r_[0:9, 18:24], np.r_[9:18, 24:30]
# Columns of the covariance of a keyframe.
POSE, VELOCITY, BIAS, GYRO_BIAS, ARM = (
    slice(0, 6),
    slice(6, 9),
    slice(9, 15),
    slice(12, 15),
    slice(15, 18),
)


class GraphError(RsRelposeError):
    """The graph cannot be solved."""


@dataclass(frozen=True, slots=True, eq=False)
class KeyframeState:
    """The body at a keyframe, and the camera on it."""

    R: Array
    position: Array
    velocity: Array
    gyro_bias: Array
    accel_bias: Array
    arm: Array  # (3,) position of the camera in the body [m]
    # (18, 18) of rotation and translation in the axes of the body, velocity in the world, biases
    # of accelerometer and gyro, arm.
    covariance: Array


class Loop(NamedTuple):
    """A pair of two keyframes of a graph, far apart in time."""

    first: int  # their numbers since the start
    second: int
    pair: KeyframePair


def _preintegration(imu: ImuConfig, config: OdometryConfig) -> Any:
    """Noise densities of the samples for gtsam."""
    params = gtsam.PreintegrationCombinedParams.MakeSharedU(STANDARD_GRAVITY)
    eye = np.eye(3)
    params.setGyroscopeCovariance(imu.gyro_noise_density**2 * eye)
    params.setIntegrationCovariance(_INTEGRATION**2 * eye)
    params.setBiasOmegaCovariance(config.gyro_bias_walk**2 * eye)
    params.setBiasAccCovariance(config.accel_bias_walk**2 * eye)
    return params


def _optimizer(iterations: int = 10) -> Any:
    """Parameters of gtsam's Levenberg-Marquardt optimiser."""
    params = gtsam.LevenbergMarquardtParams()
    params.setMaxIterations(iterations)
    params.setRelativeErrorTol(1e-4)
    # Sigmas range from 1e-5 (bias walks) to metres: too ill-conditioned for Cholesky.
    params.setLinearSolverType('MULTIFRONTAL_QR')
    return params


class _Innovation(NamedTuple):
    """A pair against all before it and the samples."""

    errors: Array  # (n,) in units of the pair's sigmas
    covariance: Array  # (n, n) without the pair's own
    by_accelerometer: Array  # (n, n) change of that by the variance of the accelerometer's noise

    @property
    def chi_squared(self) -> float:
        """Per degree of freedom."""
        n = len(self.errors)
        return float(self.errors @ np.linalg.solve(np.eye(n) + self.covariance, self.errors)) / n


class _Noise:
    """Noise of accelerometer and pairs as innovations show it, by a posterior over a grid."""

    def __init__(self) -> None:
        self._log = _LIKELY
        self._read()

    def observe(self, innovation: _Innovation, seconds: float) -> None:
        """Use an innovation; `seconds`: since the one before."""
        known, vectors = np.linalg.eigh(
            innovation.covariance
            + (_ACCEL_ERRORS**2 - self.accel_errors**2)[..., None] * innovation.by_accelerometer
        )
        squared = (innovation.errors @ vectors)[:, None] ** 2
        variances = np.maximum(known, 0.0)[:, None] + _PAIR_VARIANCES[:, None]
        log = -0.5 * (squared / variances + np.log(variances)).sum(axis=2)
        kept = math.exp(-seconds / _FORGOTTEN)
        self._log = (
            kept * self._log + (1.0 - kept) * _LIKELY + np.maximum(log - log.max(), -_ONE_PAIR)
        )
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
        R_cam_body: Array,
        imu: ImuConfig,
        config: OdometryConfig,
        *,
        keep: bool = False,
    ) -> None:
        self._R_cam_body, self._config = R_cam_body, config
        self._preintegration, self._imu = _preintegration(imu, config), imu
        self._noise = _Noise()
        # Samples since the newest keyframe, and their integral.
        self._integrated: tuple[ImuInterval | None, Any] = None, None
        # Each update is one step of the optimisation, which the next keyframe continues.
        self._smoother = gtsam.BatchFixedLagSmoother(config.smoothing_lag, _optimizer(1))
        # All factors and states since the start, for the final smoothing.
        self._record = (gtsam.NonlinearFactorGraph(), gtsam.Values()) if keep else None
        factors, values = gtsam.NonlinearFactorGraph(), gtsam.Values()
        pose = gtsam.Pose3(gtsam.Rot3(start.R), start.position)
        bias = gtsam.imuBias.ConstantBias(start.accel_bias, start.gyro_bias)
        values.insert(X(0), pose)
        values.insert(V(0), start.velocity)
        values.insert(B(0), bias)
        values.insert(L(0), start.arm)
        factors.addPriorPose3(X(0), pose, _gaussian(start.covariance[POSE, POSE]))
        factors.addPriorVector(
            V(0), start.velocity, _gaussian(start.covariance[VELOCITY, VELOCITY])
        )
        factors.addPriorConstantBias(B(0), bias, _gaussian(start.covariance[BIAS, BIAS]))
        factors.addPriorVector(L(0), start.arm, _gaussian(start.covariance[ARM, ARM]))
        self._update(factors, values, 0, 0.0)

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
        pair: KeyframePair | None,
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
        rates = interval.rates[[0, -1]] - self._bias.gyroscope()
        factors, values = gtsam.NonlinearFactorGraph(), gtsam.Values()
        values.insert(X(j), self._ahead.atPose3(X(j)))
        values.insert(V(j), self._ahead.atVector(V(j)))
        values.insert(B(j), self._bias)
        factors.add(_imu_factor(i, j, pim))
        innovation = 0.0
        if pair is not None and pair.images is not None:
            found = self._innovation(pim, self._pair_factor(i, j, pair, rates))
            innovation = found.chi_squared
            if innovation <= gate:
                variance = self._noise.pair_variance
                # Without a gate, at a start, the misfit shows what is wrong. Later the variance
                # is no smaller than that of the images: innovations hide errors that persist.
                if gate < math.inf:
                    variance = max(variance, 1.0) * max(innovation, 1.0)
                factors.add(self._pair_factor(i, j, pair, rates, math.sqrt(inflation * variance)))
                self._noise.observe(found, interval.duration)
                if pair.is_pure_rotation:
                    factors.add(self._still_factor(i, j))
        if at_rest and innovation <= gate:
            for key in (V(i), V(j)):
                factors.addPriorVector(key, np.zeros(3), _diagonal([_REST_VELOCITY_SIGMA] * 3))
        # States before a long bridge stay: the first pairs after it correct them, too.
        self._update(
            factors,
            values,
            j,
            self._seconds + min(interval.duration, _LONGEST_STEP * self._config.smoothing_lag),
            _START_STEPS if pair is not None and gate == math.inf else 1,
        )
        return innovation

    def scale_sigma(self) -> float:
        """1 sigma of the newest velocity, along its least certain direction, by its length."""
        sigma = math.sqrt(np.linalg.norm(self.newest.covariance[VELOCITY, VELOCITY], 2))
        return sigma / max(float(np.linalg.norm(self.newest.velocity)), _LEAST_SPEED)

    def misfit(self) -> float:
        """Chi squared of the window per degree of freedom."""
        graph: Any = self._smoother.getFactors()  # removed ones are None
        equations = sum(
            factor.dim() for k in range(graph.size()) if (factor := graph.at(k)) is not None
        )
        return 2.0 * graph.error(self._values) / max(equations - self._values.dim(), 1)

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
                loops = [
                    loop for loop, misfit in zip(loops, misfits, strict=True) if misfit <= bound
                ]
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

    def _closed(self, loops: Sequence[Loop], values: Any) -> tuple[Any, Any]:
        """The record with loops, optimised."""
        assert self._record is not None
        graph = gtsam.NonlinearFactorGraph(self._record[0])
        for loop in loops:
            graph.add(self._pair_factor(*loop, robust=True))
        return graph, gtsam.LevenbergMarquardtOptimizer(graph, values, _optimizer()).optimize()

    def _misfit(self, loop: Loop, values: Any, marginals: Any = None) -> float:
        """Chi squared of a loop by its bound; `marginals`: of a path without it."""
        factor = self._pair_factor(*loop)
        _, e = factor.linearize(values).jacobian()
        S = np.eye(len(e))
        if marginals is not None:
            # About the predicted pose: the tangents of other directions have steeper derivatives.
            A, _ = (
                self._pair_factor(*self._predicted_loop(loop, values)).linearize(values).jacobian()
            )
            S += A @ _joint(marginals, list(factor.keys())) @ A.T
        return float(e @ np.linalg.solve(S, e)) / _loop_bound(len(e)) ** 2

    def _predicted_loop(self, loop: Loop, values: Any) -> Loop:
        """The same of the poses of a path."""
        images, C, c = loop.pair.images, self._R_cam_body, values.atVector(L(0))
        assert images is not None
        way = values.atPose3(X(loop.first)).between(values.atPose3(X(loop.second)))
        R, q = way.rotation().matrix(), way.transformFrom(c) - c
        return loop._replace(
            pair=replace(
                loop.pair,
                images=replace(
                    images,
                    R=C @ R @ C.T,
                    t=C @ q / np.linalg.norm(q) if loop.pair.has_direction else images.t,
                ),
            )
        )

    def _smoothed(self) -> tuple[Any, Any]:
        """Values and marginals of the whole record."""
        assert self._record is not None
        factors, values = self._record
        values = gtsam.LevenbergMarquardtOptimizer(factors, values, _optimizer()).optimize()
        return values, gtsam.Marginals(factors, values)

    def _predicted(self, interval: ImuInterval) -> Any:
        """Predict the next keyframe in `_ahead`; ``gtsam.PreintegratedCombinedMeasurements``.

        By the mean of two samples each; those of the prediction before are not repeated.
        """
        (known, pim), n = self._integrated, 1
        if known and all(
            np.array_equal(old, new[: len(old)]) for old, new in zip(known, interval, strict=True)
        ):
            n = len(known.seconds)
        else:
            self._preintegration.setAccelerometerCovariance(
                (self._imu.accel_noise_density**2 + self._noise.accel_errors**2) * np.eye(3)
            )
            pim = gtsam.PreintegratedCombinedMeasurements(self._preintegration, self._bias)
        seconds, rates, forces = (samples[n - 1 :] for samples in interval)
        for force, rate, step in zip(
            0.5 * (forces[1:] + forces[:-1]),
            0.5 * (rates[1:] + rates[:-1]),
            np.diff(seconds),
            strict=True,
        ):
            pim.integrateMeasurement(force, rate, step)
        self._integrated = interval, pim
        state = pim.predict(self._nav_state, self._bias)
        self._ahead.update(X(self._count), state.pose())
        self._ahead.update(V(self._count), state.velocity())
        return pim

    def _linearised(self, pim: Any) -> tuple[Array, Array]:
        """How errors of the newest keyframe propagate, and the covariance of the samples.

        Both (18, 18), as the covariance of a keyframe.
        """
        factor = _imu_factor(self._count - 1, self._count, pim)
        # A_i d_i + A_j d_j is white noise, the keys being X_i, V_i, X_j, V_j, B_i, B_j.
        A, _ = factor.linearize(self._ahead).jacobian()
        back = np.linalg.inv(A[:, _OF_SECOND])
        by, noise = np.eye(18), np.zeros((18, 18))
        by[:15, :15] = -back @ A[:, _OF_FIRST]
        noise[:15, :15] = back @ back.T
        return by, noise

    def _innovation(self, pim: Any, of_pair: Any) -> _Innovation:
        by, noise = self._linearised(pim)
        H, e = of_pair.linearize(self._ahead).jacobian()
        second = np.zeros((len(e), 18))
        second[:, :9] = H[:, 9:18]
        whole = second @ by
        whole[:, :9] += H[:, :9]
        whole[:, ARM] += H[:, 18:]
        # White noise of the acceleration in position and velocity of the second body.
        seconds, R = pim.deltaTij(), self._ahead.atPose3(X(self._count)).rotation().matrix()
        of_velocity = second[:, VELOCITY] @ R
        of_both = second[:, 3:6] + (1.5 / seconds) * of_velocity
        by_accelerometer = (
            seconds**3 / 3.0 * of_both @ of_both.T + seconds / 4.0 * of_velocity @ of_velocity.T
        )
        return _Innovation(
            e,
            whole @ self.newest.covariance @ whole.T + second @ noise @ second.T,
            by_accelerometer,
        )

    def _pair_factor(
        self,
        i: int,
        j: int,
        pair: KeyframePair,
        rates: Array | None = None,
        sigma: float = 1.0,
        *,
        robust: bool = False,
    ) -> Any:
        images = pair.images
        assert images is not None
        C = self._R_cam_body
        root, offset = square_root(images.information, images.gradient)
        n, R = root.shape[1], images.R
        # A pure rotation has no other deviations.
        t, velocities = (
            (images.t, images.velocities)
            if pair.has_direction
            else (np.array([0.0, 0.0, 1.0]), np.zeros(6))
        )
        # Only velocities depend on the rates.
        w1, w2 = np.zeros((2, 3)) if rates is None else rates
        noise = _diagonal([sigma] * len(offset))
        if robust:
            noise = gtsam.noiseModel.Robust.Create(
                gtsam.noiseModel.mEstimator.Huber.Create(_loop_bound(len(offset))), noise
            )

        keys = x1, v1, x2, v2, arm = [X(i), V(i), X(j), V(j), L(0)]

        def error(_: Any, values: Any, jacobians: Any) -> Array:
            P1, P2 = values.atPose3(x1).matrix(), values.atPose3(x2).matrix()
            e, by = deviations(
                P1[:3, :3].copy(),
                P1[:3, 3],
                values.atVector(v1),
                w1,
                P2[:3, :3].copy(),
                P2[:3, 3],
                values.atVector(v2),
                w2,
                C,
                values.atVector(arm),
                R,
                t,
                velocities,
            )
            if jacobians is not None:
                whole = (by[:n].T @ root.T).T  # column-major, as gtsam requires
                for block, columns in enumerate(_BLOCKS):
                    jacobians[block] = whole[:, columns]
            return np.asarray(root @ e[:n] + offset)

        return gtsam.CustomFactor(noise, keys, error)

    def _still_factor(self, i: int, j: int) -> Any:
        """The camera keeps its position under any rotation of the body."""
        sigma = self._config.pure_rotation_motion

        def error(factor: Any, values: Any, jacobians: Any) -> Array:
            keys = factor.keys()
            pose1, pose2 = values.atPose3(keys[0]), values.atPose3(keys[1])
            R1, R2 = pose1.rotation().matrix(), pose2.rotation().matrix()
            arm = values.atVector(keys[2])
            if jacobians is not None:
                jacobians[0] = np.asfortranarray(np.hstack([R1 @ skew(arm), -R1]))
                jacobians[1] = np.asfortranarray(np.hstack([-R2 @ skew(arm), R2]))
                jacobians[2] = np.asfortranarray(R2 - R1)
            return np.asarray(pose2.translation() + R2 @ arm - pose1.translation() - R1 @ arm)

        return gtsam.CustomFactor(_diagonal([sigma] * 3), [X(i), X(j), L(0)], error)

    def _update(
        self, factors: Any, values: Any, newest: int, seconds: float, steps: int = 1
    ) -> None:
        """Add the newest keyframe, at `seconds` in the window; after a failure none is added."""
        with _solving():
            # The camera on the body stays in the window.
            self._smoother.update(factors, values, dict.fromkeys([*values.keys(), L(0)], seconds))
            for _ in range(steps - 1):
                self._smoother.update(gtsam.NonlinearFactorGraph(), gtsam.Values(), {})
            self._read(newest)
        self._count, self._seconds = newest + 1, seconds  # keyframes; time of the newest
        if self._record is not None:
            self._record[0].push_back(factors)

    def _read(self, newest: int) -> None:
        """Read the estimates of the smoother."""
        self._values = self._smoother.calculateEstimate()
        self._bias = self._values.atConstantBias(B(newest))
        self.newest = _state(
            self._values, gtsam.Marginals(self._smoother.getFactors(), self._values), newest
        )
        self._nav_state = gtsam.NavState(
            self._values.atPose3(X(newest)), self._values.atVector(V(newest))
        )
        # The window, with a place for the prediction of the next keyframe.
        self._ahead = gtsam.Values(self._values)
        self._ahead.insert(X(newest + 1), self._nav_state.pose())
        self._ahead.insert(V(newest + 1), self._nav_state.velocity())
        self._ahead.insert(B(newest + 1), self._bias)
        self._integrated = None, None
        if self._record is not None:
            self._record[1].insert_or_assign(self._values)


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


def _state(values: Any, marginals: Any, k: int) -> KeyframeState:
    pose, bias = values.atPose3(X(k)), values.atConstantBias(B(k))
    return KeyframeState(
        pose.rotation().matrix(),
        pose.translation(),
        values.atVector(V(k)),
        bias.gyroscope(),
        bias.accelerometer(),
        values.atVector(L(0)),
        _joint(marginals, [X(k), V(k), B(k), L(0)]),
    )


def _joint(marginals: Any, keys: list[int]) -> Array:
    """Covariance of several unknowns, in their order."""
    joint = marginals.jointMarginalCovariance(keys)
    return np.block([[joint.at(a, b) for b in keys] for a in keys])


def _imu_factor(i: int, j: int, pim: Any) -> Any:
    return gtsam.CombinedImuFactor(X(i), V(i), X(j), V(j), B(i), B(j), pim)


def _gaussian(covariance: Array) -> Any:
    return gtsam.noiseModel.Gaussian.Covariance(np.ascontiguousarray(covariance))


def _diagonal(sigmas: Any) -> Any:
    return gtsam.noiseModel.Diagonal.Sigmas(np.asarray(sigmas, dtype=np.float64))
