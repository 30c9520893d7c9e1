"""Noise of the IMU and of the pairs, as the innovations of the pairs show it."""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np

from rs_relpose_ros.calibration.findings import Code, Evidence, Finding, FindingState, Why
from rs_relpose_ros.config.settings import ImuConfig
from rs_relpose_ros.geometry import Array
from rs_relpose_ros.imu.buffer import ImuInterval
from rs_relpose_ros.imu.noise import FEWEST_SAMPLES, noise_of_samples

# Densities [m/s^2/sqrt(Hz)] of errors of an accelerometer that its noise does not have (scale,
# axes, vibration, clock), from which innovations choose. A shorter list could not follow a bad
# accelerometer.
# [measured: docs/lab/odometry.md, "Noise by innovations": 0 to 27e-3 on seven recordings]
_ACCEL_ERRORS = np.array([0.0, 1e-3, 2e-3, 4e-3, 8e-3, 16e-3, 32e-3, 64e-3])
# 1 sigma of that density before any innovation. A smaller one starts too certain on recordings, a
# larger one delays starts. [measured: there, starts of recordings]
_ACCEL_ERROR_SIGMA = 8e-3
# The same for the gyro [rad/s/sqrt(Hz)]: vibration, held samples, scale. White noise of 0.2 rad/s
# at 200 Hz has 1.4e-2: with a list that ends below, states of such an IMU were beyond 3 sigma.
# [measured: docs/lab/odometry.md, "Defects of the IMU": 0 to 1.4e-2 on simulated defects]
_GYRO_ERRORS = np.array([0.0, 3e-4, 1e-3, 3e-3, 1e-2, 3e-2])
# Density at which the prior of the gyro's errors has fallen to a half. The prior falls by a power
# of the density only: vibration is rare, but it is not excluded by some hundred pairs.
# [chosen: a fifth to twice of 5e-4, the error of one real gyro in docs/lab/odometry.md]
_GYRO_ERROR_HALF = 3e-4
# Variances of pairs by those of their images, from which innovations choose. A shorter list would
# take pairs of a bad lens as too certain. [measured: there: 0.5 to 3.9]
_PAIR_VARIANCES = np.array([0.5, 0.7, 1.0, 1.5, 2.0, 3.0, 4.0])
# 1 sigma of the logarithm of that variance before any innovation. A smaller one would ignore
# innovations for longer. [measured: there]
_PAIR_LOG_SIGMA = 0.7
# Time in which innovations are forgotten [s]. A shorter one follows a change of the motion, with
# fewer innovations to choose by. [chosen: 10 to 60 s would do: about 100 pairs]
_FORGOTTEN = 20.0
# Largest share of one pair in that choice, as a difference of log likelihoods: a single wrong pair
# must not decide. [chosen: 3 to 10 would do: the prior of the extreme values is 2 to 8]
_ONE_PAIR = 6.0
# Ratio of an estimated density to the configured one from which it is a finding. A smaller one
# would report sensors whose data sheet is a little optimistic. [derived: the specification]
_NAMED_RATIO = 2.0
# Largest probability that the density is below that ratio. A larger one would report some right
# sensors in an hour. [chosen: 1e-4 to 1e-2 would do, as densities are estimated for 20 s]
_NAMED_CHANCE = 1e-2
# Innovations before which no noise is named: the prior decides until then.
# [chosen: 10 to 50 would do: some seconds]
_LEAST_NAMED = 20
# Change of the specific force between two samples [m/s^2] from which its mean is not known: a
# knock, whose peak lies between the samples. Steps of a walk change it by less at 50 Hz or more; a
# smaller bound would take them for knocks, a larger one would trust a knock.
# [chosen: 15 to 40 would do: hand-held walks reach 5, knocks 50 to 200]
_KNOCK = 20.0
# Least share of a vector's length in the largest of its three components. A larger one would miss
# knocks. [derived: all three are equal]
_LEAST_COMPONENT = 0.57
# Samples before and after a knock that are as uncertain: it lasts for 5 to 15 ms.
# [chosen: 1 to 3 would do at 200 Hz]
_AROUND_KNOCK = 2


class Innovation(NamedTuple):
    """A pair against all before it and the samples."""

    errors: Array  # (n,) in units of the pair's sigmas
    covariance: Array  # (n, n) without the pair's own
    by_accelerometer: Array  # (n, n) change of that by the variance of the accelerometer's noise
    by_gyro: Array  # (n, n) likewise of the gyro's

    @property
    def chi_squared(self) -> float:
        """Per degree of freedom."""
        n = len(self.errors)
        whitened = np.linalg.solve(np.eye(n) + self.covariance, self.errors)
        return float(self.errors @ whitened) / n


def integrals_of_noise(seconds: float) -> Array:
    """Covariance (3, 3) of a random walk of unit density after a time, and of its two integrals.

    The n-th and the m-th integral of white noise have the covariance
    ``T^(n + m + 1) / (n! m! (n + m + 1))``.
    """
    order = np.arange(3)
    powers = order[:, None] + order + 1
    factorials = np.array([1.0, 1.0, 2.0])
    return np.asarray(seconds**powers / (np.outer(factorials, factorials) * powers))


def spread(columns: list[Array], covariance: Array) -> Array:
    """Sum of ``covariance[a, b] columns[a] columns[b]^T`` over a and b, (n, n)."""
    weighted = np.tensordot(covariance, np.stack(columns), axes=1)
    return np.asarray(sum(one @ other.T for one, other in zip(columns, weighted, strict=True)))


def _prior(accel_sigma: float, gyro_half: float) -> Array:
    """Logarithm (A, G, P) of the prior, without a constant."""
    accel = -0.5 * (_ACCEL_ERRORS / accel_sigma) ** 2
    gyro = -np.log1p((_GYRO_ERRORS / gyro_half) ** 2)
    pair = -0.5 * (np.log(_PAIR_VARIANCES) / _PAIR_LOG_SIGMA) ** 2
    return np.asarray(accel[:, None, None] + gyro[:, None] + pair)


class NoisePosterior:
    """Noise of accelerometer, gyro and pairs, by a posterior over a grid.

    `observed` is the number of innovations, `accel_errors` and `gyro_errors` are densities beyond
    the configured ones, `pair_variance` is that of pairs by the variance of their images.
    """

    def __init__(self) -> None:
        self._prior = _prior(_ACCEL_ERROR_SIGMA, _GYRO_ERROR_HALF)
        self._log = self._prior
        self.observed = 0
        self._gyro_shown = 0.0  # largest density that the samples of an interval have shown
        self._read()

    def expect(self, interval: ImuInterval, imu: ImuConfig) -> None:
        """Widen the prior by the noise that samples show; innovations decide what counts.

        Without it, states of the first seconds with a vibrating IMU would be too certain.
        """
        seconds = interval.seconds
        if len(seconds) < FEWEST_SAMPLES:
            return
        accel = _beyond(noise_of_samples(interval.forces, seconds), imu.accel_noise_density)
        of_gyro = noise_of_samples(interval.rates, seconds)
        self._gyro_shown = max(self._gyro_shown, of_gyro)
        gyro = _beyond(of_gyro, imu.gyro_noise_density)
        prior = _prior(max(accel, _ACCEL_ERROR_SIGMA), max(gyro, _GYRO_ERROR_HALF))
        self._log = self._log + (prior - self._prior)
        self._prior = prior
        self._read()

    def observe(self, innovation: Innovation, seconds: float) -> None:
        """Use an innovation; `seconds`: since the one before."""
        more_accel = _ACCEL_ERRORS**2 - self.accel_errors**2
        more_gyro = _GYRO_ERRORS**2 - self.gyro_errors**2
        by_accel = more_accel[:, None, None] * innovation.by_accelerometer
        by_gyro = more_gyro[:, None, None] * innovation.by_gyro
        covariances = innovation.covariance + by_accel[:, None] + by_gyro
        log = _log_likelihoods(innovation.errors, covariances)
        kept = math.exp(-seconds / _FORGOTTEN)
        remembered = kept * self._log + (1.0 - kept) * self._prior
        worse = log - log.max()
        self._log = remembered + np.maximum(worse, -_ONE_PAIR)
        self.observed += 1
        self._read()

    def _read(self) -> None:
        """Read the means from the posterior."""
        likelihoods = np.exp(self._log - self._log.max())
        weights = likelihoods / likelihoods.sum()
        self._of_accel = weights.sum(axis=(1, 2))
        self._of_gyro = weights.sum(axis=(0, 2))
        of_pair = weights.sum(axis=(0, 1))
        accel_variance = self._of_accel @ _ACCEL_ERRORS**2
        gyro_variance = self._of_gyro @ _GYRO_ERRORS**2
        pair_log = of_pair @ np.log(_PAIR_VARIANCES)
        self.accel_errors = math.sqrt(accel_variance)
        self.gyro_errors = math.sqrt(gyro_variance)
        self.pair_variance = math.exp(pair_log)

    def findings(self, imu: ImuConfig) -> tuple[Finding, ...]:
        """Sensors whose noise is more than twice the configured one for certain.

        Innovations are as large if images turn otherwise, as with a zoom: the gyro is named where
        its own samples have that noise, too.
        """
        if self.observed < _LEAST_NAMED:
            return ()
        shows_noise = self._gyro_shown > _NAMED_RATIO * imu.gyro_noise_density
        gyro = None
        if shows_noise:
            gyro = _noise_finding(
                Code.GYRO_NOISE,
                imu.gyro_noise_density,
                _GYRO_ERRORS,
                self._of_gyro,
            )
        accel = _noise_finding(
            Code.ACCEL_NOISE,
            imu.accel_noise_density,
            _ACCEL_ERRORS,
            self._of_accel,
        )
        return tuple(finding for finding in (gyro, accel) if finding is not None)


def _beyond(density: float, configured: float) -> float:
    """Density of what is added to a noise of the configured density; 0 if it is smaller."""
    return math.sqrt(max(density**2 - configured**2, 0.0))


def _log_likelihoods(errors: Array, covariances: Array) -> Array:
    """Log likelihoods (A, G, P) of errors (n,) by covariances (A, G, n, n) and pair variances."""
    known, vectors = np.linalg.eigh(covariances)
    squares = (errors @ vectors) ** 2
    of_state = np.maximum(known, 0.0)
    variances = of_state[..., None] + _PAIR_VARIANCES
    misfits = squares[..., None] / variances
    terms = misfits + np.log(variances)
    return np.asarray(-0.5 * terms.sum(axis=2))


# Parameter and unit of the density of each noise.
_DENSITIES = {
    Code.GYRO_NOISE: ('gyro_noise_density', 'rad/s/sqrt(Hz)'),
    Code.ACCEL_NOISE: ('accel_noise_density', 'm/s^2/sqrt(Hz)'),
}


def _noise_finding(
    code: Code,
    configured: float,
    errors: Array,
    weights: Array,
) -> Finding | None:
    """The finding of a density, of `errors` beyond the configured one with their weights."""
    densities = np.hypot(configured, errors)
    chance = float(weights[densities <= _NAMED_RATIO * configured].sum())
    if chance > _NAMED_CHANCE:
        return None
    mean = float(weights @ densities)
    sigma = math.sqrt(float(weights @ (densities - mean) ** 2))
    parameter, unit = _DENSITIES[code]
    return Finding(
        code,
        FindingState.SUSPECT,
        Why.OFF,
        configured=(configured,),
        estimated=(mean,),
        sigma=sigma,
        unit=unit,
        evidence=Evidence(measured={'ratio': mean / configured}),
        settings={parameter: float(f'{mean:.2g}')},
    )


# -- knocks -----------------------------------------------------------------------------------


def knocks(interval: ImuInterval) -> Array:
    """1 sigma (K - 1,) of the mean force of each step [m/s^2] by knocks; 0 without one.

    The peak of a knock is between the samples, or beyond the range of the accelerometer.
    """
    changes = interval.forces[1:] - interval.forces[:-1]
    sigmas = np.zeros(len(changes))
    if np.abs(changes).max(initial=0.0) <= _LEAST_COMPONENT * _KNOCK:
        return sigmas
    jumps = np.linalg.norm(changes, axis=1)
    numbers = np.flatnonzero(jumps > _KNOCK)
    sizes = np.linalg.norm(interval.forces, axis=1)
    for k in numbers:
        first = max(k - _AROUND_KNOCK, 0)
        around = slice(first, k + _AROUND_KNOCK + 1)
        peak = max(jumps[k], sizes[k], sizes[k + 1])
        sigmas[around] = np.maximum(sigmas[around], peak)
    return sigmas


def knock_peak(interval: ImuInterval) -> float:
    """Largest specific force around a knock [m/s^2]; 0 without one."""
    return float(knocks(interval).max(initial=0.0))


def knock_finding(peak: float, number: int, imu_ns: int) -> Finding:
    """The finding of the newest knock; `number`: of all knocks."""
    return Finding(
        Code.KNOCK,
        FindingState.SUSPECT,
        Why.OFF,
        estimated=(peak,),
        sigma=peak,
        unit='m/s^2',
        evidence=Evidence(measured={'knocks': number, 'imu_ns': imu_ns}),
    )
