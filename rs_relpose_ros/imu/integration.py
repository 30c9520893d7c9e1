"""Gyro and accelerometer between two times: rotation, preintegrated motion, their covariances."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field
from functools import cached_property
from typing import NamedTuple

import numpy as np

from rs_relpose_ros.config.settings import ImuConfig
from rs_relpose_ros.geometry import Array, so3, validate
from rs_relpose_ros.geometry.gyro import GyroPath, integrated_rotations
from rs_relpose_ros.geometry.motion import FrameMotion, InertialMotion
from rs_relpose_ros.geometry.so3 import skew
from rs_relpose_ros.geometry.timing import seconds_between, Stamps
from rs_relpose_ros.imu.noise import shown_density
from rs_relpose_ros.jit import kernel


@dataclass(frozen=True, eq=False)
class ImuSlice:
    """Samples of the IMU between the stamped rows of two frames, in the camera frame.

    The first and the last sample of each sensor are interpolated at the two rows. Without
    specific force `forces` is empty, and `no_force` is the reason.
    """

    stamps_ns: Stamps  # (K,) of the gyro
    angular_velocities: Array  # (K, 3) [rad/s], bias removed
    bias: Array  # (3,) [rad/s] that was removed; the mean if it changed meanwhile
    bias_sigma: float  # [rad/s] per axis
    noise_density: float  # [rad/s/sqrt(Hz)] of the gyro
    no_force: str = 'there is no accelerometer'
    force_stamps_ns: Stamps = field(default_factory=lambda: np.empty(0, dtype=np.int64))  # (M,)
    forces: Array = field(default_factory=lambda: np.empty((0, 3)))  # (M, 3) [m/s^2]

    @property
    def duration(self) -> float:
        """Seconds from the first to the last sample."""
        return seconds_between(int(self.stamps_ns[0]), int(self.stamps_ns[-1]))

    @property
    def path(self) -> GyroPath:
        """The integrated gyro, relative to the first sample, whose time is 0."""
        times = (self.stamps_ns - self.stamps_ns[0]) * 1e-9
        return GyroPath.integrated(times, np.ascontiguousarray(self.angular_velocities))

    @property
    def rotation(self) -> Array:
        """``R_start^T R_end`` (3, 3) as integrated from the gyro."""
        return self._integrated[0]

    @property
    def angle(self) -> Array:
        """Integral (3,) of the angular velocity [rad], each in the axes of its own time.

        It does not wrap, whatever the unit of the gyro, and is proportional to its scale.
        """
        steps = np.diff((self.stamps_ns - self.stamps_ns[0]) * 1e-9)
        means = 0.5 * (self.angular_velocities[1:] + self.angular_velocities[:-1])
        return np.asarray(steps @ means)

    @property
    def covariance(self) -> Array:
        """Covariance (3, 3) [rad^2] of the error of `rotation`; see `integrate_rotation`."""
        return self._integrated[1]

    @property
    def noise_covariance(self) -> Array:
        """Covariance (3, 3) [rad^2] of the error of `rotation` by the gyro's white noise alone."""
        seconds = (self.stamps_ns - self.stamps_ns[0]) * 1e-9
        rates = np.ascontiguousarray(self.angular_velocities)
        _, _, noise = _integrate(seconds, rates)
        return self.noise_density**2 * noise

    @cached_property
    def _integrated(self) -> tuple[Array, Array]:
        return integrate_rotation(
            self.stamps_ns, self.angular_velocities, self.noise_density, self.bias_sigma
        )

    def joined(self, later: ImuSlice) -> ImuSlice:
        """This slice and the one that starts where it ends."""
        share = later.duration / (self.duration + later.duration)
        return ImuSlice(
            np.concatenate([self.stamps_ns, later.stamps_ns[1:]]),
            np.concatenate([self.angular_velocities, later.angular_velocities[1:]]),
            self.bias + share * (later.bias - self.bias),
            max(self.bias_sigma, later.bias_sigma),
            later.noise_density,
            later.no_force or self.no_force,
            np.concatenate([self.force_stamps_ns, later.force_stamps_ns[1:]]),
            np.concatenate([self.forces, later.forces[1:]]),
        )

    def at_common_times(self) -> tuple[Array, Array, Array]:
        """Times (K,) [s], rates (K, 3) and forces (K, 3) at the stamps of both sensors."""
        start_ns = min(self.stamps_ns[0], self.force_stamps_ns[0])
        return at_common_times(
            (self.stamps_ns - start_ns) * 1e-9,
            self.angular_velocities,
            (self.force_stamps_ns - start_ns) * 1e-9,
            self.forces,
        )


@dataclass(frozen=True, slots=True, eq=False)
class FrameImu:
    """The IMU's share of a frame, all in the camera frame.

    Without specific force `force`, `at_rest` and its sigma are NaN, and `no_force` is the reason.
    """

    motion: FrameMotion  # relative to the stamped row
    gravity_sigma: float | None  # [rad] per axis of the direction; None without one
    reference_ns: int  # time of the stamped row on the IMU clock
    # Since the previous frame's stamped row; None for the first frame or after a gap.
    since_previous: ImuSlice | None
    no_force: str = 'there is no accelerometer'
    force: Array = field(default_factory=lambda: np.full(3, np.nan))  # mean of the readout [m/s^2]
    at_rest: float = np.nan  # [m/s^2] length of the specific force at rest, as this sensor reads
    at_rest_sigma: float = np.nan


def mean_rates(stamps_ns: Stamps, rates: Array, at_ns: Stamps, width: float | Array) -> Array:
    """Exact means (N, 3) of rates (K, 3), linear between samples, over `width` [s] about `at_ns`.

    Beyond the samples, the mean is taken over the part of the interval which they cover.
    """
    seconds = (stamps_ns - stamps_ns[0]) * 1e-9
    steps = np.diff(seconds)[:, None]
    turned = integral(seconds, rates)
    slopes = np.diff(rates, axis=0) / steps
    last = len(steps) - 1

    def integral_at(times: Array) -> Array:
        after = np.searchsorted(seconds, times, side='right')
        k = np.clip(after - 1, 0, last)
        since = (times - seconds[k])[:, None]
        mean_rate = rates[k] + 0.5 * since * slopes[k]
        return np.asarray(turned[k] + since * mean_rate)

    middle = (at_ns - stamps_ns[0]) * 1e-9
    half = 0.5 * width
    begin = np.clip(middle - half, 0.0, seconds[-1])
    end = np.clip(middle + half, 0.0, seconds[-1])
    change = integral_at(end) - integral_at(begin)
    return np.asarray(change / (end - begin)[:, None])


def integral(times: Array, values: Array) -> Array:
    """Integral (K, 3) up to each of the `times` (K,) [s] of values (K, 3) that are linear between.

    SciPy has it, in a package whose import would delay the start of a node.
    """
    means = 0.5 * (values[1:] + values[:-1])
    return _summed(means * np.diff(times)[:, None])


def _summed(parts: Array) -> Array:
    """Sums (K, 3) of the parts (K - 1, 3) before each sample."""
    return np.vstack([np.zeros(3), np.cumsum(parts, axis=0)])


@kernel
def _integrate(seconds: Array, rates: Array) -> tuple[Array, Array, Array]:
    """Rotation ``R_start^T R_end``, its derivative by a constant rate error, and noise growth.

    An error dw of the rate of step k rotates the result by ``L_k dw dt`` on the left (in the start
    frame), where ``L_k = R_k J_l(phi_k)``:

        derivative = sum L_k dt        noise = sum L_k L_k^T dt
    """
    rotations = integrated_rotations(seconds, rates)
    derivative = np.zeros((3, 3))
    noise = np.zeros((3, 3))
    L = np.empty((3, 3))
    for k in range(len(seconds) - 1):
        dt = seconds[k + 1] - seconds[k]
        turn = so3.step_rotation(rates[k], rates[k + 1], dt)
        so3.multiply(rotations[k], so3.left_jacobian_so3(turn), L)
        for i in range(3):
            row = L[i]
            for j in range(3):
                derivative[i, j] += row[j] * dt
                noise[i, j] += so3.dot(row, L[j]) * dt
    return rotations[-1], derivative, noise


def integrate_rotation(
    stamps_ns: Stamps, rates: Array, noise_density: float, bias_sigma: float
) -> tuple[Array, Array]:
    """Rotation ``R_start^T R_end`` (3, 3) between the first and the last sample, its covariance.

    The covariance (3, 3) [rad^2] is that of dtheta in the start frame, ``R_true = Exp(dtheta) R``.
    The stamps (K,) strictly increase; the rates (K, 3) [rad/s], with white noise of
    `noise_density` and their bias removed up to `bias_sigma` per axis, are linear between samples.
    """
    seconds = (stamps_ns - stamps_ns[0]) * 1e-9
    rotation, derivative, noise = _integrate(seconds, np.ascontiguousarray(rates))
    covariance = noise_density**2 * noise + bias_sigma**2 * derivative @ derivative.T
    return rotation, covariance


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
    if np.array_equal(times1, times2):  # both sensors are in the same messages
        return times1, values1, values2
    times = np.union1d(times1, times2)
    resampled1 = interpolated(times, times1, values1)
    resampled2 = interpolated(times, times2, values2)
    return times, resampled1, resampled2


def interpolated(times: Array, knots: Array, values: Array) -> Array:
    """Values (N, 3) at `times` (N,), linear between the `values` (K, 3) at `knots` (K,)."""
    return np.column_stack([np.interp(times, knots, column) for column in values.T])


class ForcePath(NamedTuple):
    """Specific force integrated from the first sample on, in the axes of that sample."""

    gyro: GyroPath  # at the times (K,) of the samples
    once: Array  # (K, 3) [m/s]
    twice: Array  # (K, 3) [m]

    @classmethod
    def integrated(cls, seconds: Array, rates: Array, forces: Array) -> ForcePath:
        """Integrate samples at increasing times; rates and rotated forces are linear in between.

        `seconds` (K,); `rates` (K, 3) [rad/s], bias removed; `forces` (K, 3) [m/s^2].
        """
        gyro = GyroPath.integrated(seconds, rates)
        turned_forces = np.einsum('kij,kj->ki', gyro.rotations, forces)
        return cls(gyro, *force_integrals(seconds, turned_forces))


def preintegrate(
    path: ForcePath,
    gravity: Array,
    gravity_covariance: Array,
    lever_arm: Array,
    config: ImuConfig,
    bias_sigma: float,
) -> InertialMotion:
    """Motion from the first to the last sample, in the axes of the first.

    `gravity` (3,) [m/s^2]: of free fall, in the axes of the first sample. `lever_arm` (3,) [m]:
    position of the IMU in the frame of these vectors. `bias_sigma` [rad/s]: of the gyro's bias,
    per axis.
    """
    seconds, rates, rotations = path.gyro
    steps = np.diff(seconds)
    duration = float(seconds[-1] - seconds[0])
    beta = path.once[-1] + duration * gravity
    alpha = path.twice[-1] + 0.5 * duration**2 * gravity

    half_square = duration**2 / 2.0
    by_gravity = so3.by_axes(np.array([[half_square], [duration]]))
    by_bias, by_rates = _error_derivatives(path)
    by_gyro = by_rates.sum(axis=0)
    # White noise of the accelerometer: the integrals of (T - s)^2, T - s and 1.
    integrals = np.array([[duration**3 / 3.0, half_square], [half_square, duration]])
    of_noise = so3.by_axes(integrals)
    by_arm = _by_lever_arm(duration, rotations[-1], rates)
    squared_steps = np.einsum('k,kij,klj->il', 1.0 / steps, by_rates, by_rates)
    covariance = config.accel_noise_density**2 * of_noise
    covariance += config.accel_bias_sigma**2 * by_bias @ by_bias.T
    covariance += by_gravity @ gravity_covariance @ by_gravity.T
    covariance += config.gyro_noise_density**2 * squared_steps
    covariance += bias_sigma**2 * by_gyro @ by_gyro.T
    covariance += config.imu_position_sigma**2 * by_arm @ by_arm.T
    return InertialMotion(alpha, beta, duration, covariance, lever_arm)


def _by_lever_arm(duration: float, R: Array, rates: Array) -> Array:
    """Derivatives (6, 3) of the camera's (alpha, beta) by the lever arm p.

    With the pose (R, b t) of the second frame in the first one::

        b t = (v_1 + w_1 x p) T + alpha + p - R p
        R (v_2 + w_2 x p) = v_1 + w_1 x p + beta
    """
    swing1 = skew(rates[0])
    swing2 = R @ skew(rates[-1])
    return np.vstack([duration * swing1 + np.eye(3) - R, swing1 - swing2])


def force_integrals(times: Array, forces: Array) -> tuple[Array, Array]:
    """Integrals (K, 3), once and twice, of forces (K, 3) that are linear between `times` (K,)."""
    once = integral(times, forces)
    steps = np.diff(times)[:, None]
    weighted = 2.0 * forces[:-1] + forces[1:]
    curved = weighted * (steps**2 / 6.0)
    return once, _summed(once[:-1] * steps + curved)


# Cross-product matrix of each axis, in a row: ``skew(v) = (v @ _SKEW).reshape(3, 3)``.
# [derived: the definition of the cross product]
_SKEW = np.array([skew(axis).ravel() for axis in np.eye(3)])


def _error_derivatives(path: ForcePath) -> tuple[Array, Array]:
    """Derivatives of (alpha, beta) by a bias of the force (6, 3), and by the rate of each step."""
    seconds = path.gyro.times
    once = path.once
    twice = path.twice
    steps = np.diff(seconds)
    middle = seconds[:-1] + 0.5 * steps
    left = seconds[-1] - middle
    halfway = path.gyro.at(middle)
    # A bias rotates with the IMU.
    alpha_by_bias = np.einsum('k,kij->ij', left * steps, halfway)
    beta_by_bias = np.einsum('k,kij->ij', steps, halfway)
    by_bias = np.vstack([alpha_by_bias, beta_by_bias])
    # A rotation theta in step k rotates all later forces: by -[F]x theta with their integral F.
    halfway_once = 0.5 * (once[1:] + once[:-1])
    halfway_twice = 0.5 * (twice[1:] + twice[:-1])
    later = once[-1] - halfway_once
    later_way = twice[-1] - halfway_twice - halfway_once * left[:, None]
    crosses = np.hstack([later_way @ _SKEW, later @ _SKEW])
    by_rotation = -crosses.reshape(-1, 6, 3)
    by_rate = by_rotation @ halfway
    return by_bias, by_rate * steps[:, None, None]


def inertial_motions(
    since: ImuSlice, frames: Sequence[FrameImu], config: ImuConfig
) -> list[InertialMotion | None] | str:
    """Motion of the IMU from the first of `frames` to each one, or the reason for none.

    `since`: the samples from the first frame's stamped row to the last one's. The motion up to the
    first frame is None, as is that up to a frame without specific force. Only the covariance of
    the last motion is known; that of the others is zero.
    """
    first = frames[0]
    last = frames[-1]
    if reason := since.no_force or first.no_force or last.no_force:
        return reason
    path = ForcePath.integrated(*since.at_common_times())
    R = path.gyro.rotations[-1]
    known = _gravity_at_first(last, R)
    if known is None:
        return 'the direction of gravity is not known'
    gravity, spread = known
    whole = validate.replaced(
        preintegrate(
            path,
            gravity,
            spread,
            np.array(config.imu_position),
            _with_noise_of(since, config),
            since.bias_sigma,
        ),
        acceleration1=first.force + gravity,
        acceleration2=R @ last.force + gravity,
    )
    on_the_way = [_part_of(whole, path, first, frame, gravity) for frame in frames[1:-1]]
    return [None, *on_the_way, whole]


def _gravity_at_first(last: FrameImu, R: Array) -> tuple[Array, Array] | None:
    """Gravity (3,) [m/s^2] in the axes of the first frame, and its covariance (3, 3).

    None if its direction is not known.

    As the accelerometer measures it: its scale and its bias along gravity cancel. The filter has
    had more samples at the last frame, whose rotation from the first one is R (3, 3).
    """
    sigma = last.gravity_sigma
    if last.motion.gravity is None or sigma is None:
        return None
    down = R @ last.motion.gravity
    down /= np.linalg.norm(down)
    along = np.outer(down, down)
    across_variance = (last.at_rest * sigma) ** 2
    spread = across_variance * (np.eye(3) - along) + last.at_rest_sigma**2 * along
    return last.at_rest * down, spread


def _part_of(
    whole: InertialMotion, path: ForcePath, first: FrameImu, frame: FrameImu, gravity: Array
) -> InertialMotion | None:
    """The part of a motion up to a frame on the way."""
    if frame.no_force:
        return None
    duration = seconds_between(first.reference_ns, frame.reference_ns)
    # The stamped rows of all frames are samples of the slice.
    times = path.gyro.times
    k = int(np.argmin(np.abs(times - times[0] - duration)))
    return validate.replaced(
        whole,
        alpha=path.twice[k] + 0.5 * duration**2 * gravity,
        beta=path.once[k] + duration * gravity,
        duration=duration,
        covariance=np.zeros((6, 6)),
        acceleration2=path.gyro.rotations[k] @ frame.force + gravity,
    )


def _with_noise_of(since: ImuSlice, config: ImuConfig) -> ImuConfig:
    """The configuration with the noise that the samples show."""
    seconds = np.asarray(since.force_stamps_ns * 1e-9, dtype=np.float64)
    densities = {
        'gyro_noise_density': since.noise_density,
        'accel_noise_density': shown_density(since.forces, seconds, config.accel_noise_density),
    }
    if all(getattr(config, name) == density for name, density in densities.items()):
        return config
    return validate.replaced(config, **densities)
