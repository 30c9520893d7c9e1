"""Gyro and accelerometer between two times: rotation, preintegrated motion, their covariances."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from rs_relpose_ros.config.settings import ImuConfig
from rs_relpose_ros.geometry import Array, so3, validate
from rs_relpose_ros.geometry.motion import FrameMotion, InertialMotion
from rs_relpose_ros.geometry.so3 import integrated_rotations, skew
from rs_relpose_ros.geometry.timing import seconds_between
from rs_relpose_ros.jit import kernel


@dataclass(frozen=True, slots=True, eq=False)
class ForceSegment:
    """Specific force between two times, borders interpolated, camera frame."""

    stamps_ns: NDArray[np.int64]  # (K,) the first and the last are the two times
    forces: Array  # (K, 3) [m/s^2]

    def joined(self, later: ForceSegment) -> ForceSegment:
        """This segment and the one that starts where it ends."""
        return ForceSegment(
            np.concatenate([self.stamps_ns, later.stamps_ns[1:]]),
            np.concatenate([self.forces, later.forces[1:]]),
        )


@dataclass(frozen=True, slots=True, eq=False)
class FrameForce:
    """Specific force about a frame, in the axes of its stamped row."""

    within: Array  # (3,) mean over the readout [m/s^2]
    at_rest: float  # length of the specific force at rest, as measured by this sensor [m/s^2]
    at_rest_sigma: float
    since_previous: ForceSegment  # since the previous frame's stamped row, if there is one


@dataclass(frozen=True, slots=True, eq=False)
class GyroSegment:
    """Gyro samples between two times, borders interpolated, bias removed, camera frame."""

    stamps_ns: NDArray[np.int64]  # (K,) the first and the last are the two times
    angular_velocities: Array  # (K, 3) [rad/s]
    bias: Array  # (3,) [rad/s] that was removed; the mean if it changed meanwhile
    bias_sigma: float  # [rad/s] per axis

    @property
    def duration(self) -> float:
        """Seconds from the first to the last sample."""
        return seconds_between(int(self.stamps_ns[0]), int(self.stamps_ns[-1]))

    def joined(self, later: GyroSegment) -> GyroSegment:
        """This segment and the one that starts where it ends."""
        share = later.duration / (self.duration + later.duration)
        return GyroSegment(
            np.concatenate([self.stamps_ns, later.stamps_ns[1:]]),
            np.concatenate([self.angular_velocities, later.angular_velocities[1:]]),
            self.bias + share * (later.bias - self.bias),
            max(self.bias_sigma, later.bias_sigma),
        )


@dataclass(frozen=True, slots=True, eq=False)
class FrameImu:
    """The IMU's share of a frame, all in the camera frame."""

    motion: FrameMotion  # relative to the stamped row
    gravity_sigma: float | None  # [rad] per axis of the direction; None without one
    reference_ns: int  # time of the stamped row on the IMU clock
    # Since the previous frame's stamped row; None for the first frame or after a gap.
    since_previous: GyroSegment | None
    applied_offset_ns: int = 0  # tracked time offset in these times, beyond the parameter's
    exposure: float = 0.0  # of a row [s], over which the gyro is averaged
    ahead: float = 0.0  # [s] newest stamp of the gyro when the image came, less `reference_ns`
    force: FrameForce | str = 'there is no accelerometer'  # or the reason why there is none


def mean_rates(
    stamps_ns: NDArray[np.int64], rates: Array, at_ns: NDArray[np.int64], width: float | Array
) -> Array:
    """Exact means (N, 3) of rates (K, 3), linear between samples, over `width` [s] about `at_ns`.

    Beyond the samples, the mean is that of the part which they cover.
    """
    seconds = (stamps_ns - stamps_ns[0]) * 1e-9
    steps = np.diff(seconds)
    integral = np.vstack(
        [np.zeros(3), np.cumsum(0.5 * (rates[1:] + rates[:-1]) * steps[:, None], axis=0)]
    )
    slopes = np.diff(rates, axis=0) / steps[:, None]

    def integral_at(times: Array) -> Array:
        k = np.clip(np.searchsorted(seconds, times, side='right') - 1, 0, len(steps) - 1)
        since = (times - seconds[k])[:, None]
        return np.asarray(integral[k] + since * (rates[k] + 0.5 * since * slopes[k]))

    middle = (at_ns - stamps_ns[0]) * 1e-9
    begin, end = (np.clip(middle + side, 0.0, seconds[-1]) for side in (-0.5 * width, 0.5 * width))
    return np.asarray((integral_at(end) - integral_at(begin)) / (end - begin)[:, None])


@kernel
def _integrate(seconds: Array, rates: Array) -> tuple[Array, Array, Array]:
    """Rotation ``R_start^T R_end``, its derivative by a constant rate error, and noise growth.

    An error dw of the rate of step k rotates the result by ``L_k dw dt`` on the left (in the start
    frame), where ``L_k = R_k J_l(phi_k)``:

        derivative = sum L_k dt        noise = sum L_k L_k^T dt
    """
    rotations = integrated_rotations(seconds, rates)
    derivative, noise, L = np.zeros((3, 3)), np.zeros((3, 3)), np.empty((3, 3))
    for k in range(len(seconds) - 1):
        dt = seconds[k + 1] - seconds[k]
        turn = so3.step_rotation(rates[k], rates[k + 1], dt)
        so3.multiply(rotations[k], so3.left_jacobian_so3(turn), L)
        for i in range(3):
            for j in range(3):
                derivative[i, j] += L[i, j] * dt
                noise[i, j] += so3.dot(L[i], L[j]) * dt
    return rotations[-1], derivative, noise


def integrate_rotation(
    stamps_ns: NDArray[np.int64], rates: Array, config: ImuConfig, bias_sigma: float
) -> tuple[Array, Array]:
    """Rotation ``R_start^T R_end`` (3, 3) between the first and the last sample, its covariance.

    The covariance (3, 3) [rad^2] is that of dtheta in the start frame, ``R_true = Exp(dtheta) R``.
    The stamps (K,) strictly increase; the rates (K, 3) [rad/s], their bias removed up to
    `bias_sigma` per axis, are linear between samples.
    """
    rotation, derivative, noise = _integrate(
        (stamps_ns - stamps_ns[0]) * 1e-9, np.ascontiguousarray(rates)
    )
    covariance = config.gyro_noise_density**2 * noise + bias_sigma**2 * derivative @ derivative.T
    return rotation, covariance


@dataclass(frozen=True, slots=True, eq=False)
class RotationSensitivity:
    """Effects on a rotation integrated from the gyro, as rotations on its left."""

    noise: Array  # (3, 3) covariance of its white noise alone [rad^2]
    by_rate: Array  # (3, 3) derivative by a constant error of the rates [s]
    by_scale: Array  # (3,) derivative by a relative change of all rates [rad]


def rotation_sensitivity(
    stamps_ns: NDArray[np.int64], rates: Array, config: ImuConfig
) -> RotationSensitivity:
    """Of ``R_start^T R_end``; arguments as in `integrate_rotation`."""
    seconds, step = (stamps_ns - stamps_ns[0]) * 1e-9, 1e-4
    rotation, by_rate, noise = _integrate(seconds, np.ascontiguousarray(rates))
    scaled, _, _ = _integrate(seconds, (1.0 + step) * rates)
    return RotationSensitivity(
        config.gyro_noise_density**2 * noise, by_rate, so3.log_so3(scaled @ rotation.T) / step
    )


# -- Preintegrated acceleration of the IMU, with its covariance -----------------------------------
#
# C. Forster, L. Carlone, F. Dellaert and D. Scaramuzza, *On-Manifold Preintegration for Real-Time
# Visual-Inertial Odometry*, IEEE Transactions on Robotics 33(1), 2017: specific force f, rotated
# by the integrated gyro into the axes of the start, is integrated once and twice; first-order
# errors of gyro, accelerometer and gravity. Here gravity g is known and part of both::
#
#     a(s) = R(s) f(s) + g        beta = integral a        alpha = integral (T - s) a(s) ds


def at_common_times(
    times1: Array, values1: Array, times2: Array, values2: Array
) -> tuple[Array, Array, Array]:
    """Times (K,) of two series, and the values (K, 3) of both, linearly interpolated."""
    if np.array_equal(times1, times2):  # one topic
        return times1, values1, values2
    times = np.union1d(times1, times2)
    resampled1, resampled2 = (
        np.column_stack([np.interp(times, of_series, axis) for axis in values.T])
        for of_series, values in ((times1, values1), (times2, values2))
    )
    return times, resampled1, resampled2


def preintegrate(
    seconds: Array,
    rates: Array,
    forces: Array,
    gravity: Array,
    gravity_covariance: Array,
    lever_arm: Array,
    config: ImuConfig,
    bias_sigma: float,
) -> InertialMotion:
    """Motion from the first to the last sample, in the axes of the first.

    `seconds` (K,): increasing times, rates and rotated forces being linear in between. `rates`
    (K, 3) [rad/s]: bias removed. `forces` (K, 3) [m/s^2]: specific force. `gravity` (3,) [m/s^2]:
    of free fall, in the axes of the first sample. `lever_arm` (3,) [m]: position of the IMU in the
    frame of these vectors. `bias_sigma` [rad/s]: of the gyro's bias, per axis.
    """
    steps, duration = np.diff(seconds), float(seconds[-1] - seconds[0])
    rotations = integrated_rotations(seconds, rates)
    once, twice = force_integrals(steps, np.einsum('kij,kj->ki', rotations, forces))
    beta = once[-1] + duration * gravity
    alpha = twice[-1] + 0.5 * duration**2 * gravity

    by_constant = np.vstack([0.5 * duration**2 * np.eye(3), duration * np.eye(3)])
    by_bias, by_rates = _error_derivatives(seconds, rates, rotations, once, twice)
    by_gyro = by_rates.sum(axis=0)
    # White noise of the accelerometer: the integrals of (T - s)^2, T - s and 1.
    of_noise = so3.by_axes(
        np.array([[duration**3 / 3.0, duration**2 / 2.0], [duration**2 / 2.0, duration]])
    )
    # b t = (v_1 + w_1 x p) T + alpha + p - R p,   R (v_2 + w_2 x p) = v_1 + w_1 x p + beta
    R = rotations[-1]
    by_arm = np.vstack(
        [duration * skew(rates[0]) + np.eye(3) - R, skew(rates[0]) - R @ skew(rates[-1])]
    )
    covariance = (
        config.accel_noise_density**2 * of_noise
        + config.accel_bias_sigma**2 * by_bias @ by_bias.T
        + by_constant @ gravity_covariance @ by_constant.T
        + config.gyro_noise_density**2
        * np.einsum('k,kij,klj->il', 1.0 / steps, by_rates, by_rates)
        + bias_sigma**2 * by_gyro @ by_gyro.T
        + config.imu_position_sigma**2 * by_arm @ by_arm.T
    )
    return InertialMotion(alpha, beta, duration, covariance, lever_arm)


def force_integrals(steps: Array, forces: Array) -> tuple[Array, Array]:
    """Integrals (K, 3) up to each sample, of forces (K, 3) that are linear in between."""
    mean = 0.5 * (forces[1:] + forces[:-1]) * steps[:, None]
    once = np.vstack([np.zeros(3), np.cumsum(mean, axis=0)])
    moved = (
        once[:-1] * steps[:, None] + (2.0 * forces[:-1] + forces[1:]) * (steps**2 / 6.0)[:, None]
    )
    return once, np.vstack([np.zeros(3), np.cumsum(moved, axis=0)])


# Cross-product matrix of each axis, in a row: ``skew(v) = (v @ _SKEW).reshape(3, 3)``.
_SKEW = np.array([skew(axis).ravel() for axis in np.eye(3)])


def _error_derivatives(
    seconds: Array, rates: Array, rotations: Array, once: Array, twice: Array
) -> tuple[Array, Array]:
    """Derivatives of (alpha, beta) by a bias of the force (6, 3), and by the rate of each step."""
    steps = np.diff(seconds)
    middle = seconds[:-1] + 0.5 * steps
    left = seconds[-1] - middle
    halfway = (
        rotations[:-1]
        @ Rotation.from_rotvec(0.25 * steps[:, None] * (rates[1:] + rates[:-1])).as_matrix()
    )
    # A bias rotates with the IMU.
    by_bias = np.vstack(
        [np.einsum('k,kij->ij', left * steps, halfway), np.einsum('k,kij->ij', steps, halfway)]
    )
    # A rotation theta in step k rotates all later forces: by -[F]x theta, F being their integral.
    later = once[-1] - 0.5 * (once[1:] + once[:-1])
    later_way = (
        twice[-1] - 0.5 * (twice[1:] + twice[:-1]) - 0.5 * (once[1:] + once[:-1]) * left[:, None]
    )
    by_rotation = -np.hstack([(force @ _SKEW).reshape(-1, 3, 3) for force in (later_way, later)])
    return by_bias, by_rotation @ halfway * steps[:, None, None]


def inertial_motion(
    gyro: GyroSegment, forces: ForceSegment, frame1: FrameImu, frame2: FrameImu, config: ImuConfig
) -> InertialMotion | str:
    """Motion of the IMU between the stamped rows of two frames, or the reason for none."""
    first, second, sigma = frame1.force, frame2.force, frame2.gravity_sigma
    if isinstance(first, str):
        return first
    if isinstance(second, str):
        return second
    if frame2.motion.gravity is None or sigma is None:
        return 'the direction of gravity is not known'
    seconds, rates, specific = _resampled(gyro, forces)
    R = integrated_rotations(seconds, rates)[-1]
    # As measured by the accelerometer: its scale and bias along gravity cancel. Of the second
    # frame, with more samples before it.
    down = R @ frame2.motion.gravity
    down /= np.linalg.norm(down)
    along = np.outer(down, down)
    gravity = second.at_rest * down
    covariance = (second.at_rest * sigma) ** 2 * (
        np.eye(3) - along
    ) + second.at_rest_sigma**2 * along
    motion = preintegrate(
        seconds,
        rates,
        specific,
        gravity,
        covariance,
        np.array(config.imu_position),
        config,
        gyro.bias_sigma,
    )
    return validate.replaced(
        motion, acceleration1=first.within + gravity, acceleration2=R @ second.within + gravity
    )


def _resampled(gyro: GyroSegment, forces: ForceSegment) -> tuple[Array, Array, Array]:
    """Times [s], rates and forces of two segments with the same begin and end."""
    start_ns = min(gyro.stamps_ns[0], forces.stamps_ns[0])
    return at_common_times(
        (gyro.stamps_ns - start_ns) * 1e-9,
        gyro.angular_velocities,
        (forces.stamps_ns - start_ns) * 1e-9,
        forces.forces,
    )


def motions_on_the_way(
    whole: InertialMotion, first: FrameImu, since: FrameImu, frames: Sequence[FrameImu]
) -> list[InertialMotion | None]:
    """Parts of the motion `whole` up to frames before the last one; None without accelerometer.

    `since`: IMU data of the last frame since the first. The covariances are zero.
    """
    gyro, force = since.since_previous, since.force
    if gyro is None or isinstance(force, str) or isinstance(first.force, str):
        return [None] * len(frames)
    seconds, rates, specific = _resampled(gyro, force.since_previous)
    rotations = integrated_rotations(seconds, rates)
    once, twice = force_integrals(np.diff(seconds), np.einsum('kij,kj->ki', rotations, specific))
    gravity = np.asarray(whole.acceleration1) - first.force.within
    motions: list[InertialMotion | None] = []
    for frame in frames:
        if isinstance(frame.force, str):
            motions.append(None)
            continue
        duration = seconds_between(first.reference_ns, frame.reference_ns)
        # The stamped rows of all frames are samples of the segments.
        k = int(np.argmin(np.abs(seconds - seconds[0] - duration)))
        motions.append(
            validate.replaced(
                whole,
                alpha=twice[k] + 0.5 * duration**2 * gravity,
                beta=once[k] + duration * gravity,
                duration=duration,
                covariance=np.zeros((6, 6)),
                acceleration2=rotations[k] @ frame.force.within + gravity,
            )
        )
    return motions
