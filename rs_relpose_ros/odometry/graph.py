"""The graph of keyframes in gtsam, and the window of it that is optimised as keyframes arrive.

Of each keyframe: pose and velocity of the body (the IMU) in a world whose z is up, and the biases.
Between consecutive ones, the preintegrated IMU; of a pair, what its images alone say
(`estimator.image_information`), so that no sample of the IMU counts twice.
"""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field
import math
from typing import Any, NamedTuple

import gtsam
from gtsam.symbol_shorthand import B, V, X
import numpy as np
from numpy.typing import NDArray

from rs_relpose_ros.config.imu import ImuConfig
from rs_relpose_ros.config.odometry import OdometryConfig
from rs_relpose_ros.errors import RsRelposeError
from rs_relpose_ros.geometry.so3 import skew
from rs_relpose_ros.odometry.interval import ImuInterval
from rs_relpose_ros.odometry.measurement import PairMeasurement
from rs_relpose_ros.odometry.pair_geometry import (
    BodyState,
    deviations,
    Mounting,
    square_root,
)

Array = NDArray[np.float64]

STANDARD_GRAVITY = 9.80665   # [m/s^2]
# 1 sigma of the velocity of a body that stands [m/s], per axis.
_STANDING = 0.005
# 1 sigma of heading and place of a start, which are chosen [rad, m].
_CHOSEN = 1e-4
# Integration error of the samples, as a noise density of the position [m/sqrt(s)].
_INTEGRATION = 1e-4


# Columns of a pair's derivatives: pose and velocity of the first body, of the second one.
_BLOCKS = (slice(0, 6), slice(6, 9), slice(9, 15), slice(15, 18))


class GraphError(RsRelposeError):
    """The graph cannot be solved."""


@dataclass(frozen=True, slots=True, eq=False)
class Start:
    """State of the first keyframe, with 1 sigma of what is not chosen: place and heading are."""

    R: Array
    position: Array
    velocity: Array
    gyro_bias: Array
    tilt_sigma: float   # [rad] per axis
    velocity_sigma: float
    gyro_bias_sigma: float


@dataclass(frozen=True, slots=True, eq=False)
class KeyframeState:
    """The body at a keyframe, with covariances."""

    R: Array
    position: Array
    velocity: Array
    gyro_bias: Array
    accel_bias: Array
    pose_covariance: Array   # (6, 6) of (turn, step), both in the axes of the body
    velocity_covariance: Array   # (3, 3) in the world


class Step(NamedTuple):
    """From one keyframe's camera to the next one's, in the axes of the former."""

    translation: Array   # (3,) [m]
    covariance: Array   # (3, 3)


@dataclass(slots=True, eq=False)
class Record:
    """All factors and states since the start, for smoothing at the end."""

    factors: Any = field(default_factory=gtsam.NonlinearFactorGraph)
    values: Any = field(default_factory=gtsam.Values)


def _preintegration(imu: ImuConfig, config: OdometryConfig) -> Any:
    """Noises of the samples, as gtsam has them."""
    params = gtsam.PreintegrationCombinedParams.MakeSharedU(STANDARD_GRAVITY)
    eye = np.eye(3)
    params.setGyroscopeCovariance(imu.gyro_noise_density**2 * eye)
    params.setAccelerometerCovariance(imu.accel_noise_density**2 * eye)
    params.setIntegrationCovariance(_INTEGRATION**2 * eye)
    params.setBiasOmegaCovariance(config.gyro_bias_walk**2 * eye)
    params.setBiasAccCovariance(config.accel_bias_walk**2 * eye)
    return params


class KeyframeGraph:
    """Keyframes from a start on; the newest window of them is optimised with each.

    `mounting`: the camera on the body. `keep`: whether all is recorded for `smoothed`.
    """

    def __init__(self, start: Start, rate: Array, mounting: Mounting, imu: ImuConfig,
                 config: OdometryConfig, *, keep: bool = False) -> None:
        self._mounting, self._config = mounting, config
        self._preintegration = _preintegration(imu, config)
        params = gtsam.LevenbergMarquardtParams()
        params.setMaxIterations(10)
        params.setRelativeErrorTol(1e-4)
        # Bias walks are known to 1e-5, a velocity or a place to metres: too much for Cholesky.
        params.setLinearSolverType('MULTIFRONTAL_QR')
        self._params = params
        self._smoother = gtsam.BatchFixedLagSmoother(config.smoothing_lag, params)
        self._record = Record() if keep else None
        self._rate = rate   # of the body at the newest keyframe, as measured
        factors, values = gtsam.NonlinearFactorGraph(), gtsam.Values()
        pose = gtsam.Pose3(gtsam.Rot3(start.R), start.position)
        bias = gtsam.imuBias.ConstantBias(np.zeros(3), start.gyro_bias)
        values.insert(X(0), pose)
        values.insert(V(0), start.velocity)
        values.insert(B(0), bias)
        # Turns and steps are in the axes of the body.
        covariance = _CHOSEN**2 * np.eye(6)
        covariance[:3, :3] = start.R.T @ np.diag(
            np.square([start.tilt_sigma] * 2 + [_CHOSEN])) @ start.R
        factors.addPriorPose3(X(0), pose, gtsam.noiseModel.Gaussian.Covariance(covariance))
        factors.addPriorVector(V(0), start.velocity, _diagonal([start.velocity_sigma] * 3))
        factors.addPriorConstantBias(B(0), bias, _diagonal(
            [imu.accel_bias_sigma] * 3 + [start.gyro_bias_sigma] * 3))
        self._update(factors, values, 0, 0.0)

    @property
    def newest(self) -> KeyframeState:
        """The newest keyframe, with its covariance as of the window."""
        return self._newest

    def carried(self, interval: ImuInterval) -> KeyframeState:
        """The body after samples since the newest keyframe, without a keyframe there.

        Covariances: of the keyframe, carried on by its velocity's, and of the samples; that a turn
        of the keyframe tilts gravity is left to the latter.
        """
        newest, dt = self._newest, interval.duration
        pim = self._preintegrated(interval)
        state = self._predicted(pim)
        R = state.attitude().matrix()
        back, noise = R.T @ newest.R, pim.preintMeasCov()
        turn = np.kron(np.eye(2), back)
        pose = turn @ newest.pose_covariance @ turn.T
        pose[3:, 3:] += dt**2 * R.T @ newest.velocity_covariance @ R
        # In the axes of the keyframe: of turn, position and velocity.
        pose += turn @ noise[:6, :6] @ turn.T
        velocity = newest.velocity_covariance + newest.R @ noise[6:9, 6:9] @ newest.R.T
        return KeyframeState(R, state.position(), state.velocity(), newest.gyro_bias,
                             newest.accel_bias, pose, velocity)

    def add(self, interval: ImuInterval, pair: PairMeasurement | None, standing: bool) -> float:
        """Add a keyframe after `interval`, and what a pair with the one before says, if any.

        Returns what a pair adds to chi squared per degree of freedom, 0 without.
        """
        i, j = self._count - 1, self._count
        pim = self._preintegrated(interval)
        state = self._predicted(pim)
        rates, self._rate = (self._rate, interval.rates[-1]), interval.rates[-1]
        factors, values = gtsam.NonlinearFactorGraph(), gtsam.Values()
        values.insert(X(j), state.pose())
        values.insert(V(j), state.velocity())
        values.insert(B(j), self._bias)
        factors.add(gtsam.CombinedImuFactor(X(i), V(i), X(j), V(j), B(i), B(j), pim))
        of_pair = None
        if pair is not None:
            of_pair = self._pair_factor(i, j, pair, rates)
            if of_pair is not None:
                factors.add(of_pair)
            if pair.turned_only:
                factors.add(self._still_factor(i, j))
        if standing:
            for key in (V(i), V(j)):
                factors.addPriorVector(key, np.zeros(3), _diagonal([_STANDING] * 3))
        self._update(factors, values, j, self._seconds + interval.duration)
        if of_pair is None:
            return 0.0
        return 2.0 * of_pair.error(self._values) / of_pair.dim()

    def without_pair(self) -> None:
        """Take the newest pair out again."""
        i, j = self._count - 2, self._count - 1
        with _solving():
            self._smoother.update(gtsam.NonlinearFactorGraph(), gtsam.Values(), {},
                                  _pair_slots(self._smoother.getFactors(), i, j))
            if self._record is not None:
                for slot in _pair_slots(self._record.factors, i, j):
                    self._record.factors.remove(slot)
            self._read(j)

    def scale_sigma(self) -> float:
        """Relative 1 sigma of the newest speed; of the velocity where it is below 0.1 m/s."""
        state = self._newest
        speed = float(np.linalg.norm(state.velocity))
        if speed < 0.1:
            return math.sqrt(float(np.trace(state.velocity_covariance)))
        along = state.velocity / speed
        return math.sqrt(float(along @ state.velocity_covariance @ along)) / speed

    def misfit(self) -> float:
        """Chi squared of the window per degree of freedom."""
        graph = _compact(self._smoother.getFactors())
        equations = sum(graph.at(k).dim() for k in range(graph.size()))
        return 2.0 * graph.error(self._values) / max(equations - self._values.dim(), 1)

    def smoothed(self) -> list[KeyframeState]:
        """All keyframes since the start, each with what came after it; needs `keep`."""
        with _solving():
            values, marginals = self._smoothed()
            return [_state(values, marginals, k) for k in range(self._count)]

    def smoothed_steps(self) -> list[Step]:
        """Of the same keyframes, each against the one before: for evaluations."""
        C, c = self._mounting
        steps, arm = [], skew(c)
        with _solving():
            values, marginals = self._smoothed()
        for i in range(self._count - 1):
            first, second = (values.atPose3(X(k)) for k in (i, i + 1))
            R1, R2 = first.rotation().matrix(), second.rotation().matrix()
            way = R1.T @ (second.translation() - first.translation() + R2 @ c) - c
            back = R1.T @ R2
            # Of turns and steps of both bodies, each in its axes.
            by = np.hstack([skew(way) + arm, -np.eye(3), -back @ arm, back])
            with _solving():
                both = marginals.jointMarginalCovariance([X(i), X(i + 1)])
            covariance = np.block([[both.at(X(a), X(b)) for b in (i, i + 1)]
                                   for a in (i, i + 1)])
            steps.append(Step(C @ way, C @ by @ covariance @ by.T @ C.T))
        return steps

    # -- inside ------------------------------------------------------------------------------

    def _smoothed(self) -> tuple[Any, Any]:
        """Values and marginals of all that was recorded."""
        assert self._record is not None
        factors = _compact(self._record.factors)
        values = gtsam.LevenbergMarquardtOptimizer(
            factors, self._record.values, self._params).optimize()
        return values, gtsam.Marginals(factors, values)

    def _preintegrated(self, interval: ImuInterval) -> Any:
        """``gtsam.PreintegratedCombinedMeasurements``, at the mean of two samples each."""
        out = gtsam.PreintegratedCombinedMeasurements(self._preintegration, self._bias)
        rates = 0.5 * (interval.rates[1:] + interval.rates[:-1])
        forces = 0.5 * (interval.forces[1:] + interval.forces[:-1])
        for force, rate, step in zip(forces, rates, np.diff(interval.seconds), strict=True):
            out.integrateMeasurement(force, rate, step)
        return out

    def _predicted(self, pim: Any) -> Any:
        state = gtsam.NavState(self._values.atPose3(X(self._count - 1)),
                               self._values.atVector(V(self._count - 1)))
        return pim.predict(state, self._bias)

    def _pair_factor(self, i: int, j: int, pair: PairMeasurement,
                     measured: tuple[Array, Array]) -> Any:
        images = pair.images
        if images is None:
            return None
        mounting = self._mounting
        root, offset = square_root(images.information, images.gradient)
        n, R = root.shape[1], images.R
        # Of a rotation alone, the rest of the deviations is not asked for.
        t, velocities = (images.t, images.velocities) if pair.has_direction else (
            np.array([0.0, 0.0, 1.0]), np.zeros(6))
        bias = self._bias.gyroscope()
        rates = measured[0] - bias, measured[1] - bias

        def error(factor: Any, values: Any, jacobians: Any) -> Array:
            x1, v1, x2, v2 = factor.keys()
            e, by = deviations(_body(values, x1, v1, rates[0]), _body(values, x2, v2, rates[1]),
                               mounting, R, t, velocities)
            if jacobians is not None:
                whole = (by[:n].T @ root.T).T   # in Fortran's order, as gtsam wants its blocks
                for block, columns in enumerate(_BLOCKS):
                    jacobians[block] = whole[:, columns]
            return np.asarray(root @ e[:n] + offset)

        return gtsam.CustomFactor(gtsam.noiseModel.Unit.Create(len(offset)),
                                  [X(i), V(i), X(j), V(j)], error)

    def _still_factor(self, i: int, j: int) -> Any:
        """The camera stays where it is, however the body turns."""
        sigma = self._config.pure_rotation_motion
        arm = self._mounting.position
        skew_arm = skew(arm)

        def error(factor: Any, values: Any, jacobians: Any) -> Array:
            keys = factor.keys()
            pose1, pose2 = values.atPose3(keys[0]), values.atPose3(keys[1])
            R1, R2 = pose1.rotation().matrix(), pose2.rotation().matrix()
            if jacobians is not None:
                jacobians[0] = np.asfortranarray(np.hstack([R1 @ skew_arm, -R1]))
                jacobians[1] = np.asfortranarray(np.hstack([-R2 @ skew_arm, R2]))
            return np.asarray(pose2.translation() + R2 @ arm - pose1.translation() - R1 @ arm)

        return gtsam.CustomFactor(_diagonal([sigma] * 3), [X(i), X(j)], error)

    def _update(self, factors: Any, values: Any, newest: int, seconds: float) -> None:
        """Take in the newest keyframe, at `seconds` since the first; where it fails, none."""
        with _solving():
            self._smoother.update(factors, values, dict.fromkeys(list(values.keys()), seconds))
            self._read(newest)
        self._count, self._seconds = newest + 1, seconds   # keyframes, and time of the newest
        if self._record is not None:
            self._record.factors.push_back(factors)

    def _read(self, newest: int) -> None:
        """Take over what the smoother has found."""
        self._values = self._smoother.calculateEstimate()
        self._bias = self._values.atConstantBias(B(newest))
        self._newest = _state(self._values, gtsam.Marginals(
            _compact(self._smoother.getFactors()), self._values), newest)
        if self._record is not None:
            self._record.values.insert_or_assign(self._values)


@contextmanager
def _solving() -> Iterator[None]:
    """What gtsam cannot solve is a GraphError."""
    try:
        yield
    except RuntimeError as error:   # of several lines
        first_line = str(error).strip().partition('\n')[0]
        raise GraphError(f'the graph cannot be solved: {first_line}') from error


def _body(values: Any, pose_key: int, velocity_key: int, rate: Array) -> BodyState:
    pose = values.atPose3(pose_key).matrix()
    return BodyState(pose[:3, :3].copy(), pose[:3, 3], values.atVector(velocity_key), rate)


def _pair_slots(graph: Any, i: int, j: int) -> list[int]:
    """Where a graph has the factors of the pair of two keyframes."""
    return [slot for slot in range(graph.size())
            if isinstance(graph.at(slot), gtsam.CustomFactor)
            and {X(i), X(j)} <= set(graph.at(slot).keys())]


def _compact(graph: Any) -> Any:
    """The graph without its holes."""
    out = gtsam.NonlinearFactorGraph()
    for k in range(graph.size()):
        if graph.at(k) is not None:
            out.add(graph.at(k))
    return out


def _state(values: Any, marginals: Any, k: int) -> KeyframeState:
    pose, bias = values.atPose3(X(k)), values.atConstantBias(B(k))
    return KeyframeState(
        pose.rotation().matrix(), pose.translation(), values.atVector(V(k)), bias.gyroscope(),
        bias.accelerometer(), marginals.marginalCovariance(X(k)),
        marginals.marginalCovariance(V(k)))


def _diagonal(sigmas: Any) -> Any:
    return gtsam.noiseModel.Diagonal.Sigmas(np.asarray(sigmas, dtype=np.float64))
