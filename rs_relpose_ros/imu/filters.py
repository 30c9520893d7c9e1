"""Causal filters of the gyro bias (at rest) and of the direction of gravity.

Gravity is propagated with the gyro and corrected by the accelerometer: a Kalman filter of the
direction ``u`` (up, IMU frame) and of the remaining gyro bias ``b``, with the errors
``u_true = Exp(d) u`` and ``b_true = b + e``:

    u <- Exp(-(w - b) dt) u            d <- Exp(-(w - b) dt) d + e dt
    f / |f| = u_true + noise           f / |f| - u = -[u]x d + noise

The noise is the camera's own acceleration over 9.81 m/s^2. A specific force of another length
contains acceleration and gets less weight.

That noise is not white. An additional process noise keeps the memory short: with it the covariance
P sets the gain K. The covariance E of the errors contains the noise of sensors and carrier alone
(as of any suboptimal filter: A. Gelb, ed., *Applied Optimal Estimation*, MIT Press 1974,
chapter 7)::

    E <- F E F^T + Q_gyro dt           E <- (I - K H) E (I - K H)^T + K noise K^T
"""

from dataclasses import dataclass, replace
import math
from typing import NamedTuple

import numpy as np

from rs_relpose_ros.config.settings import ImuConfig
from rs_relpose_ros.geometry import Array
from rs_relpose_ros.geometry.so3 import cross, dot, exp_so3, norm, rotated, STANDARD_GRAVITY
from rs_relpose_ros.geometry.timing import Stamps, to_nanoseconds
from rs_relpose_ros.jit import kernel, small_kernel

# -- Bias of the gyro, measured at rest -----------------------------------------------------------
#
# Samples are tested in windows of half a second. A window is at rest if gyro and accelerometer
# hardly vary and the mean rate is within the bias' uncertainty. Its mean measures the bias:
#
#     P <- min(P + q dt, P_0)        K = P / (P + s^2)        b <- b + K (mean - b)
#
# `P_0` is the square of ``gyro_bias_sigma``. Of two consecutive windows at rest only the older one
# is used: the newer one may contain the beginning of a motion.

# Time in which the variance of a measured bias grows back to `gyro_bias_sigma` squared [s]. With
# less, a rest is soon forgotten; with more, the temperature moves the bias away from the estimate.
# [chosen: a MEMS gyro warms up in some ten minutes]
BIAS_MEMORY = 600.0

# Length of a window [ns]. A shorter one mistakes the turning point of a motion for rest, a longer
# one misses short rests. [chosen: a hand does not keep still for half a second]
_WINDOW_NS = 500_000_000
# Fewest samples of a window, for its standard deviation. [chosen: IMUs have 50 in it at 100 Hz]
_LEAST_SAMPLES = 10
# Largest standard deviations at rest, per axis [rad/s], [m/s^2]. Above them the mean of a window
# is a motion, and would be learnt as bias. [measured: three times the noise of a MEMS IMU on a
# table, a third of a hand that tries to be still]
_REST_RATE = 0.01
# [measured: the same]
_REST_FORCE = 0.1
# Correlation time of the remaining motion at rest [s]: samples within it count as one.
# [chosen: tables and vehicles sway at some hertz]
_SWAY_TIME = 0.1
# Largest distance of the mean rate from the bias, in sigmas; beyond it is a slow rotation.
# [derived: one of 16 000 windows of pure noise is left out]
_GATE = 4.0


def is_at_rest(
    rates: Array,
    forces: Array,
) -> bool:
    """Whether gyro and accelerometer (K, 3) hardly vary; not if too few, or one is NaN."""
    return bool(
        len(rates) >= _LEAST_SAMPLES
        and rates.std(axis=0).max() < _REST_RATE
        and forces.std(axis=0).max() < _REST_FORCE
    )


class GyroBias(NamedTuple):
    """Bias (3,) [rad/s] in the IMU frame and its `sigma` per axis."""

    value: Array
    sigma: float


class _Rest(NamedTuple):
    """A window at rest: its end, its mean rate and the variance of the mean."""

    end_ns: int
    mean: Array
    variance: float


class BiasTracker:
    """Causal estimate of the gyro's bias, whose state depends on the samples alone."""

    def __init__(self, config: ImuConfig) -> None:
        self._gap_ns = to_nanoseconds(config.max_imu_gap)
        self._follow = config.track_gyro_bias
        self._prior = config.gyro_bias_sigma**2
        self._growth = self._prior / BIAS_MEMORY
        self._bias = np.array(config.gyro_bias)
        self._variance = self._prior
        self._measured_ns = 0
        self._rest: _Rest | None = None
        self._pending: tuple[Stamps, Array, Array] = (
            np.empty(0, dtype=np.int64),
            np.empty((0, 3)),
            np.empty((0, 3)),
        )

    def run(
        self,
        stamps_ns: Stamps,
        rates: Array,
        forces: Array,
    ) -> None:
        """Process later samples: stamps (K,), rates [rad/s], forces [m/s^2], or NaN."""
        if not self._follow:
            return
        old = self._pending
        stamps_ns = np.concatenate([old[0], stamps_ns])
        rates = np.concatenate([old[1], rates])
        forces = np.concatenate([old[2], forces])
        start = 0
        # A window is complete with the first sample after its end.
        while start < len(stamps_ns) and stamps_ns[-1] >= stamps_ns[start] + _WINDOW_NS:
            end = int(np.searchsorted(stamps_ns, stamps_ns[start] + _WINDOW_NS))
            self._evaluate(stamps_ns[start : end + 1], rates[start:end], forces[start:end])
            start = end
        self._pending = stamps_ns[start:], rates[start:], forces[start:]

    def estimate(self, at_ns: int) -> GyroBias:
        """The bias at a time, from the windows up to now."""
        return GyroBias(self._bias, math.sqrt(self._variance_at(at_ns)))

    def _evaluate(
        self,
        stamps_ns: Stamps,
        rates: Array,
        forces: Array,
    ) -> None:
        """Test one window; `stamps_ns` has one more, that of the sample after it."""
        before = self._rest
        self._rest = None
        # Without accelerometer a slow constant rate resembles rest.
        if int(np.diff(stamps_ns).max()) > self._gap_ns or not is_at_rest(rates, forces):
            return
        spread = float(rates.std(axis=0).max())
        seconds = _WINDOW_NS * 1e-9
        rest = _Rest(int(stamps_ns[-1]), rates.mean(axis=0), spread**2 * _SWAY_TIME / seconds)
        variance = self._variance_at(rest.end_ns) + rest.variance
        if float(np.abs(rest.mean - self._bias).max()) > _GATE * math.sqrt(variance):
            return
        self._rest = rest
        if before is not None:
            variance = self._variance_at(before.end_ns)
            gain = variance / (variance + before.variance) if variance > 0.0 else 0.0
            self._bias = self._bias + gain * (before.mean - self._bias)
            self._variance = (1.0 - gain) * variance
            self._measured_ns = before.end_ns

    def _variance_at(self, at_ns: int) -> float:
        passed = max(at_ns - self._measured_ns, 0) * 1e-9
        return min(self._variance + self._growth * passed, self._prior)


# Error of gravity's length as an accelerometer measures it, scale and bias [m/s^2].
# [derived: 3 %, as data sheets of MEMS accelerometers have it]
LENGTH_SIGMA = 0.3
# Mean acceleration along gravity over the correlation time [m/s^2]. It is smaller than the
# momentary one, since the velocity is bounded. [chosen: 0.06 m/s over the correlation time]
_LENGTH_NOISE = 0.3
# Growth of the variance of the length [m^2/s^5]: temperature. [chosen: 0.1 m/s^2 in ten minutes]
_LENGTH_GROWTH = 2e-5
# Window of the mean specific force of the paper's estimate of gravity [ns]. [derived: the paper]
MEAN_WINDOW_NS = 100_000_000
# Correlation time of hand-held acceleration [s]: samples within it count as one measurement. With
# less, the filter trusts a swing of the arm. [derived: a walk has two steps a second]
_CORRELATION_TIME = 0.2
# Averaging time of the residual [s]: acceleration that lasts longer biases the direction.
# [derived: five correlation times, so that their mean is significant]
_LASTING = 1.0
# Least sigma of an orientation that the IMU computes, in motion [rad]: drivers publish the noise
# of an IMU at rest. [chosen: 0.6 deg]
_LEAST_OWN_SIGMA = 0.01
# Largest distance of such a direction from the accelerometer's, in sigmas: beyond it the IMU means
# another world frame. [derived: one of 3000 right ones is left out]
_OWN_GATE = 4.0


@dataclass(frozen=True, slots=True, eq=False)
class GravityEstimate:
    """Direction of gravity, and length of the specific force at rest as measured."""

    direction: Array  # (3,) of free fall, unit, IMU frame
    sigma: float  # [rad] per axis
    length: float = STANDARD_GRAVITY  # [m/s^2], scale and bias along gravity included
    length_sigma: float = LENGTH_SIGMA  # 1 sigma


class _Noise(NamedTuple):
    """Noise of the filter, per axis."""

    acceleration: float  # [m^2/s^4] variance of the camera's own acceleration
    turning: float  # [rad^2/s] growth of the variance of the direction that sets the gain
    gyro: float  # [rad^2/s] that of the gyro's white noise alone
    bias: float  # [rad^2/s^3] growth of the variance of the gyro bias


class _State(NamedTuple):
    """State of the filter, which the kernels update in place; all in the IMU frame."""

    up: Array  # (3,) u
    bias: Array  # (3,) b [rad/s]
    covariance: Array  # (6, 6) P, of (d, e), which sets the gain
    errors: Array  # (6, 6) E, of (d, e) as they are
    residual: Array  # (3,) mean of f / |f| - u over about the last second
    length: Array  # (2,) of the specific force at rest [m/s^2], and its variance


class GravityFilter:
    """Causal filter of the direction of gravity, whose state depends on the samples alone."""

    def __init__(self, config: ImuConfig) -> None:
        self._config = config
        self._gap_ns = to_nanoseconds(config.max_imu_gap)
        across = (config.gravity_acceleration_sigma / STANDARD_GRAVITY) ** 2
        # Growth of the direction's variance for a stationary gain of dt / time constant.
        turning = (
            across * _CORRELATION_TIME / config.gravity_time_constant**2
            + config.gyro_noise_density**2
        )
        self._noise = _Noise(
            config.gravity_acceleration_sigma**2,
            turning,
            config.gyro_noise_density**2,
            config.gyro_bias_sigma**2 / BIAS_MEMORY,
        )
        self._state = _State(
            np.zeros(3),
            np.zeros(3),
            np.zeros((6, 6)),
            np.zeros((6, 6)),
            np.zeros(3),
            np.array([STANDARD_GRAVITY, LENGTH_SIGMA**2]),
        )
        for covariance in (self._state.covariance, self._state.errors):
            covariance[3:, 3:] = config.gyro_bias_sigma**2 * np.eye(3)
        # Of the last sample processed: None while the direction is unknown.
        self.stamp_ns: int | None = None
        self._rate = np.zeros(3)

    def run(
        self,
        stamps_ns: Stamps,
        rates: Array,
        forces: Array,
    ) -> None:
        """Process samples as `BiasTracker.run`, but with the configured bias removed."""
        k = 0
        while k < len(stamps_ns):
            if self.stamp_ns is None:
                k = self._begin(
                    k,
                    stamps_ns,
                    rates,
                    forces,
                )
                continue
            done = _advance(
                self._state,
                self._noise,
                self.stamp_ns,
                self._rate,
                stamps_ns[k:],
                rates[k:],
                forces[k:],
                self._gap_ns,
            )
            if done:
                k += done
                self.stamp_ns = int(stamps_ns[k - 1])
                self._rate = rates[k - 1].copy()
            if k < len(stamps_ns):
                # The rotation during a gap is unknown: the direction is lost.
                self.stamp_ns = None

    def estimate(self) -> GravityEstimate | None:
        """Gravity at the stamp of the last sample; None without accelerometer."""
        if self.stamp_ns is None:
            return None
        up = self._state.up
        # A rotation about the direction itself is no error.
        spread = self._state.errors[:3, :3]
        total = spread[0, 0] + spread[1, 1] + spread[2, 2]
        variance = 0.5 * float(total - up @ spread @ up)
        # The part of the mean residual above the noise is lasting and biases the direction.
        residual = self._state.residual - up * (up @ self._state.residual)
        of_noise = 2.0 * self._noise.acceleration / STANDARD_GRAVITY**2
        expected = of_noise * _CORRELATION_TIME / _LASTING
        unexplained = max(float(residual @ residual) - expected, 0.0)
        remembered = min(_LASTING / self._config.gravity_time_constant, 1.0)
        variance += unexplained * remembered**2
        length, length_variance = self._state.length
        return GravityEstimate(
            -up,
            math.sqrt(variance),
            float(length),
            math.sqrt(length_variance),
        )

    def _begin(
        self,
        k: int,
        stamps_ns: Stamps,
        rates: Array,
        forces: Array,
    ) -> int:
        """Start from the first specific force at or after sample `k`; the index after it."""
        usable = np.flatnonzero(np.linalg.norm(forces[k:], axis=1) > 0.0)
        if len(usable) == 0:
            return len(stamps_ns)
        first = k + int(usable[0])
        length = float(np.linalg.norm(forces[first]))
        state = self._state
        state.up[:] = forces[first] / length
        state.residual[:] = 0.0
        variance = _direction_variance(length, self._noise.acceleration)
        for covariance in (state.covariance, state.errors):
            covariance[:3, 3:] = 0.0
            covariance[3:, :3] = 0.0
            covariance[:3, :3] = variance * np.eye(3)
        self.stamp_ns = int(stamps_ns[first])
        self._rate = rates[first].copy()
        return first + 1


@kernel
def _advance(
    state: _State,
    noise: _Noise,
    stamp_ns: int,
    rate: Array,
    stamps_ns: Stamps,
    rates: Array,
    forces: Array,
    gap_ns: int,
) -> int:
    """Filter samples after one of `stamp_ns` and `rate` (3,) up to the first gap; their number."""
    turn = np.empty(3)
    for k in range(len(stamps_ns)):
        if stamps_ns[k] - stamp_ns > gap_ns:
            return k
        dt = (stamps_ns[k] - stamp_ns) * 1e-9
        for i in range(3):
            turn[i] = -(0.5 * (rate[i] + rates[k, i]) - state.bias[i]) * dt
        _predict(
            state,
            noise,
            turn,
            dt,
        )
        stamp_ns = stamps_ns[k]
        rate = rates[k]
        if norm(forces[k]) > 0.0:
            _correct(
                state,
                noise,
                forces[k],
                dt,
            )
    return len(stamps_ns)


@kernel
def _direction_variance(
    length: float,
    acceleration: float,
) -> float:
    """Variance per axis of the direction of a force; excess of its length is as much across."""
    excess = length - STANDARD_GRAVITY
    return (acceleration + 4.0 * excess * excess) / (STANDARD_GRAVITY * STANDARD_GRAVITY)


@small_kernel
def _predict(
    state: _State,
    noise: _Noise,
    turn: Array,
    dt: float,
) -> None:
    """Rotate by ``E = Exp(turn)`` of ``turn = -(w - b) dt`` (3,).

    A direction that is fixed in the world rotates backwards in the IMU frame.

    u <- E u        F = | E  dt I |        P <- F P F^T + Q dt
                        | 0     I |
    """
    E = exp_so3(turn)
    _rotate(E, state.up)
    _rotate(E, state.residual)
    F = np.zeros((6, 6))
    for i in range(3):
        F[i, 3 + i] = dt
        F[3 + i, 3 + i] = 1.0
        for j in range(3):
            F[i, j] = E[i, j]
    for P, growth in ((state.covariance, noise.turning), (state.errors, noise.gyro)):
        FP = np.zeros((6, 6))
        _add_product(F, P, FP)
        _write_product_transposed(FP, F, P)
        for i in range(3):
            P[i, i] += growth * dt
            P[3 + i, 3 + i] += noise.bias * dt


@small_kernel
def _correct(
    state: _State,
    noise: _Noise,
    force: Array,
    dt: float,
) -> None:
    """Kalman update by a specific force (3,), its direction with some variance per axis.

    H = | -[u]x  0 |        S = H P H^T + variance I        K = P H^T S^-1
    (d, e) = K (f / |f| - u)        P <- P - K H P
    E <- (I - K H) E (I - K H)^T + K noise K^T
    u <- Exp(d) u        b <- b + e
    """
    up, bias, P, E, residual, at_rest = state
    length = norm(force)
    # Samples within the correlation time share the weight of one measurement.
    sharing = max(_CORRELATION_TIME / dt, 1.0)
    at_rest[1] += _LENGTH_GROWTH * dt
    gain = at_rest[1] / (at_rest[1] + _LENGTH_NOISE**2 * sharing)
    at_rest[0] += gain * (dot(up, force) - at_rest[0])
    at_rest[1] *= 1.0 - gain
    variance = sharing * _direction_variance(length, noise.acceleration)
    usual = sharing * noise.acceleration / (STANDARD_GRAVITY * STANDARD_GRAVITY)
    H = np.zeros((3, 6))
    PHt = np.empty((6, 3))
    H[0, 1] = up[2]
    H[1, 0] = -up[2]
    H[0, 2] = -up[1]
    H[2, 0] = up[1]
    H[1, 2] = up[0]
    H[2, 1] = -up[0]
    _write_product_transposed(P, H, PHt)
    K = _gain(H, PHt, variance)
    turn = np.zeros(3)
    for j in range(3):
        innovation = force[j] / length - up[j]
        residual[j] += min(dt / _LASTING, 1.0) * (innovation - residual[j])
        for i in range(3):
            turn[i] += K[i, j] * innovation
            bias[i] += K[3 + i, j] * innovation
    KHP = np.empty((6, 6))
    _write_product_transposed(K, PHt, KHP)
    P -= KHP
    _mirror(P)
    rest = np.eye(6)
    half = np.zeros((6, 6))
    _add_product(-K, H, rest)  # I - K H
    _add_product(rest, E, half)
    _write_product_transposed(half, rest, E)
    for i in range(6):
        for j in range(6):
            E[i, j] += usual * dot(K[i], K[j])
    _mirror(E)
    _rotate(exp_so3(turn), up)
    length = norm(up)
    for i in range(3):
        up[i] /= length


@small_kernel
def _gain(
    H: Array,
    PHt: Array,
    variance: float,
) -> Array:
    """``K = P H^T S^-1`` (6, 3) with ``S = H P H^T + variance I``."""
    S = np.zeros((3, 3))
    adjugate = np.empty((3, 3))
    for i in range(3):
        S[i, i] = variance
    _add_product(H, PHt, S)
    _mirror(S)
    for i in range(3):  # S^-1 = adj S / det S
        row = cross(S[(i + 1) % 3], S[(i + 2) % 3])
        for j in range(3):
            adjugate[i, j] = row[j]
    determinant = dot(S[0], adjugate[0])
    K = np.zeros((6, 3))
    _add_product(PHt, adjugate, K)
    for i in range(6):
        for j in range(3):
            K[i, j] /= determinant
    return K


@small_kernel
def _rotate(
    R: Array,
    v: Array,
) -> None:
    """``v <- R v`` of a vector (3,)."""
    product = rotated(R, v)
    for i in range(3):
        v[i] = product[i]


@kernel
def _add_product(
    A: Array,
    B: Array,
    out: Array,
) -> None:
    """``out <- out + A B``, term by term in this order; BLAS costs more for small matrices."""
    rows, columns = out.shape
    for i in range(rows):
        row = A[i]
        for j in range(columns):
            total = out[i, j]
            for k in range(len(row)):
                total += row[k] * B[k, j]
            out[i, j] = total


@kernel
def _write_product_transposed(
    A: Array,
    B: Array,
    out: Array,
) -> None:
    """``out <- A B^T``; `out` is another array than A and B."""
    rows, columns = out.shape
    for i in range(rows):
        row = A[i]
        for j in range(columns):
            other = B[j]
            total = 0.0
            for k in range(len(row)):
                total += row[k] * other[k]
            out[i, j] = total


@small_kernel
def _mirror(S: Array) -> None:
    """Copy the upper triangle of a matrix into the lower one, against rounding."""
    for i in range(1, len(S)):
        for j in range(i):
            S[i, j] = S[j, i]


def mean_gravity(forces: Array) -> GravityEstimate | None:
    """The paper's estimate: minus the mean specific force (K, 3) of a short window."""
    if len(forces) == 0:
        return None
    length = float(np.linalg.norm(mean := forces.mean(axis=0)))
    if not length > 0.0:
        return None
    # Acceleration of the whole window; only its part along gravity shows in the length.
    excess = abs(length - STANDARD_GRAVITY) / STANDARD_GRAVITY
    return GravityEstimate(-mean / length, math.hypot(0.1, excess))


def agreed_gravity(
    own: GravityEstimate,
    measured: GravityEstimate | None,
) -> GravityEstimate:
    """The IMU's own estimate unless the accelerometer's contradicts (another world frame)."""
    own = replace(own, sigma=max(own.sigma, _LEAST_OWN_SIGMA))
    if measured is None:
        return own
    own = replace(own, length=measured.length, length_sigma=measured.length_sigma)
    across = np.linalg.norm(np.cross(own.direction, measured.direction))
    apart = math.atan2(across, own.direction @ measured.direction)
    limit = _OWN_GATE * math.hypot(own.sigma, measured.sigma)
    return own if apart <= limit else measured
