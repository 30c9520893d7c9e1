"""Factors of the graph: the samples of the IMU, the images of a pair, a still camera, priors.

Keyframe k has the pose ``X(k)`` and velocity ``V(k)`` of the body and the biases ``B(k)``; all
keyframes share the vector ``L(0)`` of `doubts`.
"""

from __future__ import annotations

import math
from typing import Any, NamedTuple

import gtsam
from gtsam.symbol_shorthand import B, L, V, X
import numpy as np
from scipy.special import gammaincinv

from rs_relpose_ros.config.settings import ImuConfig, OdometryConfig
from rs_relpose_ros.core.deviations import slices
from rs_relpose_ros.geometry import Array
from rs_relpose_ros.geometry.so3 import skew, STANDARD_GRAVITY
from rs_relpose_ros.messages.published_pair import PublishedPair
from rs_relpose_ros.odometry import doubts
from rs_relpose_ros.odometry.doubts import by_gyro_matrix, Doubts
from rs_relpose_ros.odometry.pair import (
    Body,
    COLUMNS,
    deviations,
    Measured,
    Mount,
    square_root,
)

# Least random walks and densities of the graph. Below them the sigmas of one graph range over so
# many decades that its equations are singular to double precision.
# [measured: docs/lab/odometry.md, "Noise parameters": a graph fails with accel_bias_walk of 4e-5,
# gyro_bias_walk of 1e-6 or gyro_noise_density of 1e-7]
#
# Least walk of the accelerometer's bias [m/s^3/sqrt(Hz)]: 3 mm/s^2 in 100 s, which nobody knows
# of a bias. A smaller one fails, a larger one would let the bias wander.
_LEAST_ACCEL_WALK = 3e-4
# Least walk of the gyro's bias [rad/s^2/sqrt(Hz)]: 1e-4 rad/s in 100 s. A smaller one fails, a
# larger one would forget a bias that was measured at rest.
_LEAST_GYRO_WALK = 1e-5
# Least density of the gyro's noise [rad/s/sqrt(Hz)]: 0.01 mrad in a second, far below the noise of
# any image. A smaller one fails, a larger one would exceed the noise of the best gyros.
_LEAST_GYRO_NOISE = 1e-5
# Least density of the accelerometer's noise [m/s^2/sqrt(Hz)]. A smaller one fails, a larger one
# would exceed the noise of the best accelerometers.
_LEAST_ACCEL_NOISE = 1e-4
# Integration error of the samples, as a noise density of the position [m/sqrt(s)]: the mean of two
# samples is not the mean of the acceleration between them. [chosen: 0.1 mm after a second, below
# the noise of any accelerometer]
_INTEGRATION = 1e-4
# Share of right loops within the bound of chi squared: 1 % of them are lost.
# [chosen: 0.95 to 0.999 would do; measured with 0.99 in docs/lab/odometry.md, "Loop closures"]
_LOOP_QUANTILE = 0.99
# Number of the unknowns of `deviations`. [derived: the columns of its derivatives]
_WIDTH = COLUMNS['mount'].stop
# Columns of the derivatives of a pair, by the keys of the two bodies.
_OF_BODIES = tuple(COLUMNS[key] for key in ('X1', 'V1', 'X2', 'V2'))
# Columns of the derivatives of an IMU factor, by its keys; those of `doubts` follow.
IMU = slices({'X1': 6, 'V1': 3, 'X2': 6, 'V2': 3, 'B1': 6, 'B2': 6})
# Columns of all of these. [derived: two bodies]
_IMU_COLUMNS = IMU['B2'].stop
# The same by key.
_OF_KEYFRAMES = tuple(IMU.values())
# Number of equations of an IMU factor. [derived: pose, velocity and biases of one body]
_IMU_ROWS = 15
# Columns of the biases of the gyro, which follow those of the accelerometer.
_OF_GYRO_1 = slice(IMU['B1'].start + 3, IMU['B1'].stop)
# The same of the second keyframe.
_OF_GYRO_2 = slice(IMU['B2'].start + 3, IMU['B2'].stop)
# Columns of the velocity of the second keyframe.
_OF_VELOCITY_2 = IMU['V2']
# Columns of its position, in the axes of its body.
_OF_PLACE_2 = slice(IMU['X2'].start + 3, IMU['X2'].stop)


# -- the IMU ----------------------------------------------------------------------------------


def preintegration(config: OdometryConfig) -> Any:
    """Walks of the biases for gtsam; the densities of the samples follow."""
    params = gtsam.PreintegrationCombinedParams.MakeSharedU(STANDARD_GRAVITY)
    eye = np.eye(3)
    gyro_walk = max(config.gyro_bias_walk, _LEAST_GYRO_WALK)
    accel_walk = max(config.accel_bias_walk, _LEAST_ACCEL_WALK)
    params.setIntegrationCovariance(_INTEGRATION**2 * eye)
    params.setBiasOmegaCovariance(gyro_walk**2 * eye)
    params.setBiasAccCovariance(accel_walk**2 * eye)
    return params


def gyro_variance(configured: float) -> float:
    """Squared density of the gyro's noise with which a graph can be solved."""
    return max(configured, _LEAST_GYRO_NOISE**2)


def accel_variance(imu: ImuConfig) -> float:
    """The same of the accelerometer."""
    return max(imu.accel_noise_density, _LEAST_ACCEL_NOISE) ** 2


class Motion(NamedTuple):
    """What the samples of an interval say of the doubts about the IMU."""

    rate: Array  # (3,) mean rate of the gyro without its bias [rad/s]
    # (2, 3) change of velocity [m/s] and position [m] in the world by a lag of the accelerometer,
    # per second of it.
    by_lag: Array
    R: Array  # (3, 3) of the body at the end


class ImuResiduals:
    """Residuals of the samples between the keyframes k and k + 1, and their derivatives.

    The gyro matrix changes the rate by ``M rate``, as a change of the bias by ``-M rate`` does:
    the residual is linear in it to 1e-6 rad. A lag changes the integrals of the specific force.
    The optimiser asks several times at the same values: the last answer is remembered.
    """

    def __init__(
        self,
        k: int,
        pim: Any,
        motion: Motion,
        unknown: Doubts,
    ) -> None:
        """`pim`: ``gtsam.PreintegratedCombinedMeasurements``, of which a copy is kept."""
        first = X(k), V(k)
        second = X(k + 1), V(k + 1)
        biases = B(k), B(k + 1)
        self._keys = [*first, *second, *biases, L(0)]
        self._inner = gtsam.CombinedImuFactor(*first, *second, *biases, pim)
        self._unknown = unknown
        # Change (30, 7) of the unknowns of the keyframes that has the effect of `sensors`.
        by_matrix = -by_gyro_matrix(motion.rate)
        velocity_by_lag, position_by_lag = motion.by_lag
        by_sensors = np.zeros((_IMU_COLUMNS, by_matrix.shape[1] + 1))
        by_sensors[_OF_GYRO_1, :-1] = by_sensors[_OF_GYRO_2, :-1] = by_matrix
        by_sensors[_OF_VELOCITY_2, -1] = -velocity_by_lag
        by_sensors[_OF_PLACE_2, -1] = -motion.R.T @ position_by_lag
        self._by_sensors = by_sensors
        self._at = b''
        self._residual = np.zeros(0)
        self._by_keyframes = np.zeros((0, 0))
        self._by_doubts = np.zeros((0, 0))

    def factor(self) -> Any:
        """The residuals as a factor of a graph."""
        noise = gtsam.noiseModel.Unit.Create(_IMU_ROWS)
        return gtsam.CustomFactor(noise, self._keys, self._error)

    def derivatives(self, values: Any) -> tuple[Array, Array]:
        """Derivatives (15, 30) by the unknowns of both keyframes, as `IMU`, and by `doubts`."""
        self._evaluate(values)
        return self._by_keyframes, self._by_doubts

    def _error(
        self,
        _: Any,
        values: Any,
        jacobians: Any,
    ) -> Array:
        """The residual in its sigmas, as gtsam asks for it."""
        self._evaluate(values)
        if jacobians is not None:
            for number, columns in enumerate(_OF_KEYFRAMES):
                jacobians[number] = self._by_keyframes[:, columns]
            jacobians[len(_OF_KEYFRAMES)] = self._by_doubts
        return self._residual

    def _evaluate(self, values: Any) -> None:
        """Remember residual and derivatives at the values of a graph."""
        x1, v1, x2, v2, b1, b2, common = self._keys
        d = values.atVector(common)
        at = _remembered(
            values.atPose3(x1).matrix(),
            values.atPose3(x2).matrix(),
            values.atVector(v1),
            values.atVector(v2),
            values.atConstantBias(b1).vector(),
            values.atConstantBias(b2).vector(),
            d,
        )
        if at == self._at:
            return
        # Column-major, as gtsam requires of derivatives.
        A, negative = self._inner.linearize(values).jacobian()
        of_sensors = A @ self._by_sensors
        sensors = self._unknown.sensors
        by_doubts = np.zeros((_IMU_ROWS, self._unknown.size), order='F')
        by_doubts[:, sensors] = of_sensors
        self._residual = of_sensors @ d[sensors] - negative
        self._by_keyframes = A
        self._by_doubts = by_doubts
        self._at = at


def _remembered(*values: Array) -> bytes:
    """The values as something that is compared at once."""
    return b''.join([value.tobytes() for value in values])


def changed_bias(bias: Any, change: Array) -> Any:
    """A bias whose gyro's part is changed by (3,)."""
    return gtsam.imuBias.ConstantBias(bias.accelerometer(), bias.gyroscope() + change)


# -- images -----------------------------------------------------------------------------------


def pair_factor(
    i: int,
    j: int,
    pair: PublishedPair,
    unknown: Doubts,
    motions: tuple[Array, Array] = (np.zeros((2, 3)), np.zeros((2, 3))),
    sigma: float = 1.0,
    *,
    robust: bool = False,
) -> Any:
    """The images of a pair against two bodies; `motions`: their rates and specific forces.

    A loop has no motions: it has no velocities, the only ones that depend on the rates.
    """
    keys = [X(i), V(i), X(j), V(j), L(0)]
    residuals = _PairResiduals(keys, pair, unknown, motions)
    noise = diagonal([sigma] * residuals.rows)
    if robust:
        huber = gtsam.noiseModel.mEstimator.Huber.Create(loop_bound(residuals.rows))
        noise = gtsam.noiseModel.Robust.Create(huber, noise)
    return gtsam.CustomFactor(noise, keys, residuals.error)


class _PairResiduals:
    """Residuals of a pair at the values of a graph, and their derivatives by each key.

    The optimiser asks several times at the same values: the last answer is remembered.
    """

    def __init__(
        self,
        keys: list[int],
        pair: PublishedPair,
        unknown: Doubts,
        motions: tuple[Array, Array],
    ) -> None:
        images = pair.images
        assert images is not None
        self._keys, self._unknown, self._motions = keys, unknown, motions
        self._root, self._offset = square_root(images.information, images.gradient)
        self._measured = Measured.of(pair)
        self.rows, self._size = self._root.shape
        # Derivative (25, n) of the unknowns of `deviations` by those of the keys.
        first = _OF_BODIES[-1].stop
        by_keys = np.eye(_WIDTH, first + unknown.size)
        by_keys[first:] = 0.0
        of_doubts = by_keys[:, first:]
        of_doubts[COLUMNS['arm'], doubts.ARM] = np.eye(3)
        of_doubts[COLUMNS['mount'], unknown.images] = unknown.by_mount
        self._by_keys = by_keys
        self._columns = (*_OF_BODIES, slice(first, None))
        # The estimate of the images moves with the deviations, too.
        self._by_images = np.zeros((self._size, by_keys.shape[1]))
        if images.by_deviation is not None:
            of_images = self._by_images[:, first:][:, unknown.images]
            of_images[:] = images.by_deviation[:, unknown.active]
        self._at = b''
        self._residual = np.zeros(0)
        self._derivatives: list[Array] = []

    def error(
        self,
        _: Any,
        values: Any,
        jacobians: Any,
    ) -> Array:
        """The residual in its sigmas, as gtsam asks for it."""
        x1, v1, x2, v2, common = self._keys
        pose1, pose2 = values.atPose3(x1).matrix(), values.atPose3(x2).matrix()
        velocity1, velocity2 = values.atVector(v1), values.atVector(v2)
        d = values.atVector(common)
        at = _remembered(pose1, pose2, velocity1, velocity2, d)
        if at != self._at:
            rates, forces = self._motions
            first = Body.of(pose1, velocity1, rates[0], forces[0])
            second = Body.of(pose2, velocity2, rates[1], forces[1])
            self._evaluate(first, second, d)
            self._at = at
        if jacobians is not None:
            for block, derivative in enumerate(self._derivatives):
                jacobians[block] = derivative
        return self._residual

    def _evaluate(self, first: Body, second: Body, d: Array) -> None:
        """Remember residual and derivatives at two bodies and the vector of `doubts`."""
        unknown, n = self._unknown, self._size
        axes, delay = unknown.mount(d)
        arm = d[doubts.ARM].copy()
        mount = Mount(unknown.R_cam_body_configured, arm, axes, delay)
        errors, by = deviations(first, second, mount, self._measured)
        moved = errors[:n] - self._by_images[:, self._columns[-1]] @ d
        by_unknowns = by[:n] @ self._by_keys - self._by_images
        whole = (by_unknowns.T @ self._root.T).T  # column-major, as gtsam requires
        self._derivatives = [whole[:, columns] for columns in self._columns]
        self._residual = self._root @ moved + self._offset


def still_factor(
    i: int,
    j: int,
    sigma: float,
    unknown: Doubts,
) -> Any:
    """The camera keeps its position under any rotation of the body; 1 sigma per axis [m]."""
    first, second, common = X(i), X(j), L(0)

    def error(
        _: Any,
        values: Any,
        jacobians: Any,
    ) -> Array:
        pose1, pose2 = values.atPose3(first), values.atPose3(second)
        R1 = pose1.rotation().matrix()
        R2 = pose2.rotation().matrix()
        arm = values.atVector(common)[doubts.ARM]
        if jacobians is not None:
            across = skew(arm)
            by_pose1 = np.hstack([R1 @ across, -R1])
            by_pose2 = np.hstack([-R2 @ across, R2])
            by_doubts = np.zeros((3, unknown.size), order='F')
            by_doubts[:, doubts.ARM] = R2 - R1
            jacobians[0] = np.asfortranarray(by_pose1)
            jacobians[1] = np.asfortranarray(by_pose2)
            jacobians[2] = by_doubts
        before = pose1.translation() + R1 @ arm
        after = pose2.translation() + R2 @ arm
        return np.asarray(after - before)

    noise = diagonal([sigma] * 3)
    return gtsam.CustomFactor(noise, [first, second, common], error)


def loop_bound(dimension: int) -> float:
    """Largest normalised residual of a loop."""
    # The quantile of chi squared; scipy.stats takes a second to import.
    return math.sqrt(2.0 * gammaincinv(0.5 * dimension, _LOOP_QUANTILE))


# -- priors -----------------------------------------------------------------------------------


def joint_prior(k: int, start: Any, covariance: Array) -> Any:
    """All unknowns of keyframe k and `doubts`, given together; `start`: ``gtsam.Values``."""
    pose, bias = start.atPose3(X(k)), start.atConstantBias(B(k))
    velocity, d = start.atVector(V(k)), start.atVector(L(0))
    identity = np.eye(len(covariance))
    ends = np.cumsum([6, 3, 6, len(d)])
    blocks = [np.asfortranarray(one) for one in np.split(identity, ends[:-1], axis=1)]

    def error(
        _: Any,
        values: Any,
        jacobians: Any,
    ) -> Array:
        if jacobians is not None:
            for number, block in enumerate(blocks):
                jacobians[number] = block
        now = values.atConstantBias(B(k))
        return np.concatenate(
            [
                pose.localCoordinates(values.atPose3(X(k))),
                values.atVector(V(k)) - velocity,
                now.vector() - bias.vector(),
                values.atVector(L(0)) - d,
            ]
        )

    return gtsam.CustomFactor(gaussian(covariance), [X(k), V(k), B(k), L(0)], error)


def gaussian(covariance: Array) -> Any:
    """Noise of a covariance."""
    return gtsam.noiseModel.Gaussian.Covariance(np.ascontiguousarray(covariance))


def diagonal(sigmas: Any) -> Any:
    """Noise of independent sigmas."""
    return gtsam.noiseModel.Diagonal.Sigmas(np.asarray(sigmas, dtype=np.float64))
