"""The joint fit with the scale b of the velocity prior chosen by its evidence over a grid.

The speed of the camera is not known in advance. With a wide prior (small b) the velocities absorb
noise if they are zero (usual, and then not even observable), a narrow one biases the pose if they
are large. The weights are the Laplace evidence ``-cost/2 - logdet(H)/2 + 6 log b``. If the time
between the frames is known, b is the baseline: an unknown of each fit, with a mixture over the
grid as prior.
"""

import math
from typing import NamedTuple

import numpy as np

from rs_relpose_ros.config.settings import CarrierMotion, MOTIONS
from rs_relpose_ros.core.least_squares import eliminate, inverse, log_determinant
from rs_relpose_ros.core.losses import Flags, noise_mixture
from rs_relpose_ros.errors import InputError
from rs_relpose_ros.estimator import priors, sampson
from rs_relpose_ros.estimator.covariance import ImageInformation, ROTATION, sandwich, scaled_like
from rs_relpose_ros.estimator.fit import DataTerm, fit, FitMatches, linearised
from rs_relpose_ros.estimator.priors import PARAMETERS, Priors, SCALE, TwoViewState, VelocityPrior
from rs_relpose_ros.estimator.problem import TwoViewProblem
from rs_relpose_ros.estimator.sampson import RayMatches
from rs_relpose_ros.geometry import Array, so3
from rs_relpose_ros.geometry.motion import InertialMotion
from rs_relpose_ros.jit import kernel, small_kernel

ROUNDS = 3
ITERATIONS = 6
# On the inliers of the last round, from each prior's own optimum on nearly the same ones.
LAST_ITERATIONS = 2
# The inlier threshold is at least this many sigmas of the estimated noise, and at most this many
# times the configured one.
REACH = 4.0
WIDEST = 2.0
# A prior whose evidence is below the best by more than this (logarithm) is left out.
LEAST_EVIDENCE = 6.0


class Scales(NamedTuple):
    """Grid of scales of the velocities (`priors`)."""

    centres: Array  # ``log b`` of each, or the mean of its prior
    log_weights: Array  # logarithms of their prior probabilities, up to a constant


class Refined(NamedTuple):
    """A refined state, its matches and its covariance."""

    state: TwoViewState
    inliers: Flags  # (N,) the matches of the last fits
    log_scale: float  # log b of the largest evidence, or the mean if it is unknown
    velocity_sigma: float  # of the velocities' prior [baselines per second]
    sigma: float  # noise of a match in the fits [px]
    covariance: Array  # (n, n) of the local parameters, within the fits and between them


@kernel
def fit_with_evidence(
    matches: RayMatches,
    start: TwoViewState,
    prior: Priors,
    sigma: float,
    threshold: float,
    scales: Scales,
    gyro_error: Array,
) -> Refined:
    """Select inliers and fit repeatedly; average over the scales of the velocities at the end.

    The state is the mean over the scales, weighted by their evidence. `sigma`, `threshold`:
    configured noise and inlier threshold [px]; `gyro_error` (3, 3) is that of `sandwich`.
    """
    size, n = len(scales.centres), priors.unknowns(prior)
    state = start
    used = _selected(matches, state, threshold, sigma)
    # Optimum of each scale as a step from `start` and a log b, and its evidence in its last round.
    steps = np.zeros((size, n))
    lacking = np.zeros(size)
    evidences = np.full(size, -math.inf)
    # The scale of `start`, or the next one.
    best = int(np.argmin(np.abs(scales.centres - prior.velocity.log_scale)))
    for attempt in range(ROUNDS):
        low, high = 0, size
        if attempt > 0:  # the best scale changes little with the inliers of the first round
            low, high = max(best - 1, 0), min(best + 2, size)
        # From the best scale down and from it up, each fit from its neighbour's optimum.
        data = linearised(used, state)
        upwards, upwards_data = state, data
        for number in range(high - low):
            k = best - number if number <= best - low else low + number
            if k == best + 1:
                state, data = upwards, upwards_data
            state, log_scale, data, _, evidences[k] = _candidate(
                matches,
                used,
                state,
                data,
                prior,
                scales,
                k,
                scales.centres[k],
                threshold,
                int(ITERATIONS),
            )
            if k == best:
                upwards, upwards_data = state, data
            so3.copy_vector(priors.step_between(start, state), steps[k])
            if n > SCALE:
                steps[k, SCALE] = log_scale
        best = low + int(np.argmax(evidences[low:high]))
        for k in range(low, high):
            lacking[k] = evidences[best] - evidences[k]
        state = priors.moved(start, steps[best])
        chosen_from = used.weights > 0.0
        reach = min(max(threshold, REACH * used.sigma), WIDEST * threshold)
        used = _selected(matches, state, reach, sigma)
        if ((used.weights > 0.0) == chosen_from).all():
            break
    return _average(
        matches, used, start, steps, lacking < LEAST_EVIDENCE, prior, scales, threshold, gyro_error
    )


@small_kernel
def _selected(
    matches: RayMatches, state: TwoViewState, threshold: float, prior_sigma: float
) -> FitMatches:
    """Inliers of a state, with their noise."""
    r = sampson.residuals(matches.observations, state)
    inliers = sampson.within(r, matches, state, threshold)
    weights, sigma = noise_mixture(r, inliers, prior_sigma)
    return FitMatches(matches.observations, weights, sigma)


@small_kernel
def _known_velocities(data: DataTerm, state: TwoViewState, prior: Priors) -> float:
    """How many of the six velocities the matches determine rather than their prior.

    ``g = 6 - tr(C V)``, V being the prior's part of the Hessian whose inverse is C (MacKay,
    Neural Computation 4, 1992): the derivative of the log-evidence by ``log b``.
    """
    hessian, gradient = np.zeros((PARAMETERS, PARAMETERS)), np.zeros(PARAMETERS)
    of_prior, ignored = np.zeros((PARAMETERS, PARAMETERS)), np.zeros(PARAMETERS)
    priors.add_priors(state, prior, hessian, gradient)
    priors.add_velocities(state, prior.velocity, of_prior, ignored)
    for i in range(PARAMETERS):
        for j in range(PARAMETERS):
            hessian[i, j] += data.hessian[i, j]
    return min(max(6.0 - (inverse(hessian) * of_prior).sum(), 0.0), 6.0)


@kernel
def _candidate(
    matches: RayMatches,
    used: FitMatches,
    start: TwoViewState,
    data: DataTerm,
    prior: Priors,
    scales: Scales,
    k: int,
    log_scale: float,
    threshold: float,
    iterations: int,
) -> tuple[TwoViewState, float, DataTerm, Array, float]:
    """Fit about scale k, from `log_scale`: state, log b, data term, Hessian and log-evidence."""
    prior = priors.at_scale(prior, log_scale, scales.centres[k], 0.0)
    if prior.velocity.weight > 0.0:
        prior = priors.at_scale(
            prior, log_scale, scales.centres[k], _known_velocities(data, start, prior)
        )
    state, log_scale, data, cost, hessian = fit(used, start, data, prior, iterations)
    cost += 2.0 * prior.velocity.freedom * log_scale
    # Velocities that move the camera by more than the baseline within a frame fit any residual,
    # with points behind the cameras: those count as outliers.
    behind = sampson.count_behind(matches, used.weights > 0.0, state)
    cost += behind * (threshold / used.sigma) ** 2
    evidence = (
        -0.5 * cost - 0.5 * log_determinant(hessian) + 6.0 * log_scale + scales.log_weights[k]
    )
    return state, log_scale, data, hessian, evidence


@small_kernel
def _average(
    matches: RayMatches,
    used: FitMatches,
    start: TwoViewState,
    steps: Array,
    likely: Flags,
    prior: Priors,
    scales: Scales,
    threshold: float,
    gyro_error: Array,
) -> Refined:
    """Mean state over the scales, its covariance, and the scale of the largest evidence.

    If the data do not determine the scale, one of them alone is overconfident. The fits of the
    `likely` (K,) scales continue from `steps` (K, n) from `start`.
    """
    size, n = steps.shape
    evidences = np.full(size, -math.inf)
    hessians = np.zeros((size, n, n))
    of_data = np.zeros((size, n, n))
    for k in range(size):
        if likely[k]:
            own = priors.moved(start, steps[k])
            log_scale = steps[k, SCALE] if n > SCALE else scales.centres[k]
            state, log_scale, data, hessian, evidences[k] = _candidate(
                matches,
                used,
                own,
                linearised(used, own),
                prior,
                scales,
                k,
                log_scale,
                threshold,
                int(LAST_ITERATIONS),
            )
            so3.copy_vector(priors.step_between(start, state), steps[k])
            if n > SCALE:
                steps[k, SCALE] = log_scale
            so3.copy_matrix(hessian, hessians[k])
            so3.copy_matrix(data.hessian, of_data[k])
    best = int(np.argmax(evidences))
    # About the best one, from which the local parameters of all of them are small.
    origin = priors.moved(start, steps[best])
    weights = np.exp(evidences - evidences[best])
    weights /= weights.sum()
    mean = np.zeros(n)
    away = np.zeros((size, n))
    for k in range(size):
        if likely[k]:
            so3.copy_vector(priors.step_between(origin, priors.moved(start, steps[k])), away[k])
            if n > SCALE:
                away[k, SCALE] = steps[k, SCALE] - steps[best, SCALE]
            mean += weights[k] * away[k]
    within_fits = np.zeros((n, n))
    between_fits = np.zeros((n, n))
    for k in range(size):
        if likely[k]:
            rest, fitted = away[k] - mean, inverse(hessians[k])
            for i in range(n):
                for j in range(n):
                    within_fits[i, j] += weights[k] * fitted[i, j]
                    between_fits[i, j] += weights[k] * rest[i] * rest[j]
    # With the errors of the best one: the misfit of another is no noise.
    fitted = inverse(hessians[best])
    robust = sandwich(used, origin, of_data[best], hessians[best], fitted, prior, gyro_error)
    log_scale = scales.centres[best]
    if n > SCALE:
        log_scale = steps[best, SCALE] + mean[SCALE]
    # Root mean square over the six velocities.
    sigma = math.sqrt(np.trace(inverse(prior.velocity.information)) / 6.0)
    return Refined(
        priors.moved(origin, mean),
        used.weights > 0.0,
        log_scale,
        sigma * math.exp(-log_scale),
        used.sigma,
        scaled_like(within_fits, fitted, robust) + between_fits,
    )


# -- Prior of the linear velocities by time, accelerometer and carrier ----------------------------
#
# With the baseline b [m], the interval T, and the acceleration preintegrated to alpha and beta, in
# the axes of camera 1 and moved from the IMU to the camera (R and w_i by the gyro, p: lever arm)::
#
#     alpha' = alpha + T w_1 x p + p - R p        beta' = beta + w_1 x p - R (w_2 x p)
#     b d_1 = (b t - alpha') / T                  b d_2 = b d_1 + beta'
#
# so that one unknown, b, replaces six. Without accelerometer alpha' and beta' are those of a
# random acceleration of zero mean and some correlation time.

# Correlation time of a carrier's acceleration [s]: steps, gusts, gears.
CORRELATION_TIME = 0.2
# Error of the assumption of a constant velocity during the readout [m/s].
ROW_VELOCITY_SIGMA = 0.005
# Scales of the baseline over the speeds of a carrier.
SCALE_COUNT = 4
# Of the prior of each, as a share of the distance to the next one.
WIDTH = 0.7

# Without a time between the frames: prior sigmas [baselines per second], and the exponent of the
# power law of their prior. If the velocities are not observable (sideways motion, cameras at
# rest), a wide prior would convert noise to velocity and degrees of translation.
GRID = np.array([0.003, 0.03, 0.1, 0.3, 1.0, 3.0, 10.0])
SMALL_IS_LIKELIER = 0.5
TIMELESS = Scales(np.asarray(-np.log(GRID)), np.asarray(-SMALL_IS_LIKELIER * np.log(GRID)))
# Velocities fixed at zero.
AT_ZERO = Scales(np.array([0.5 * math.log(priors.PINNED)]), np.zeros(1))


def expected_velocities(
    problem: TwoViewProblem, motion: str, interval: float, inertial: InertialMotion | None
) -> tuple[VelocityPrior, Scales]:
    """Prior of the velocities at the middle rows, and the grid of their scales.

    `motion`: carrier of the camera, of `MOTIONS`; `interval`: between the frames [s]; `inertial`:
    between their reference rows.
    """
    carrier = MOTIONS[motion]
    if inertial is None:
        expected, covariance = np.zeros(6), _of_carrier(carrier, interval)
    else:
        expected, covariance = _of_imu(problem, inertial)
    # (alpha', beta') to u = b (d - c t) + a: a = (alpha' / T, alpha' / T - beta')
    to_velocities = so3.by_axes(np.array([[1.0 / interval, 0.0], [1.0 / interval, -1.0]]))
    covariance = to_velocities @ covariance @ to_velocities.T + ROW_VELOCITY_SIGMA**2 * np.eye(6)
    lowest, highest = span_of_scales(motion, interval)
    step = (highest - lowest) / SCALE_COUNT
    centres = np.array([lowest + step * (0.5 + k) for k in range(SCALE_COUNT)])
    prior = VelocityPrior(
        1.0 / interval,
        to_velocities @ expected,
        inverse(covariance),
        float(centres[SCALE_COUNT // 2]),
        0.0,
        (WIDTH * step) ** -2,
        0.0,
    )
    return prior, Scales(centres, np.zeros(SCALE_COUNT))


def span_of_scales(motion: str, interval: float) -> tuple[float, float]:
    """Range of ``log b`` by the speeds of a carrier."""
    carrier = MOTIONS[motion]
    lowest = math.log(interval * carrier.slow)
    return lowest, lowest + math.log(carrier.fast / carrier.slow)


def _of_imu(problem: TwoViewProblem, inertial: InertialMotion) -> tuple[Array, Array]:
    """(alpha', beta') of the camera between the middle rows, and their covariance (6, 6)."""
    delay = -problem.reference_row_time
    # From the reference to the middle row.
    turn = problem.motion1.rotations([-delay])[0].T
    shifted, p = inertial.shifted(delay, turn), np.asarray(inertial.lever_arm)
    alpha, beta = shifted.alpha, shifted.beta
    if p.any():
        if problem.rotation is None:
            raise InputError('inertial with a lever_arm requires relative_rotation, too')
        R, arm1 = problem.rotation, so3.skew(problem.motion1.angular_velocity) @ p
        arm2 = so3.skew(problem.motion2.angular_velocity) @ p
        alpha = alpha + inertial.duration * arm1 + p - R @ p
        beta = beta + arm1 - R @ arm2
    return np.concatenate([alpha, beta]), shifted.covariance


def _of_carrier(carrier: CarrierMotion, interval: float) -> Array:
    """Covariance (6, 6) of (alpha, beta) of a random acceleration, correlated exponentially."""
    parts = 16
    times = (np.arange(parts) + 0.5) * interval / parts
    to_both = np.vstack([interval - times, np.ones(parts)]) * interval / parts
    correlation = np.exp(-np.abs(times[:, None] - times) / CORRELATION_TIME)
    covariance: Array = carrier.acceleration**2 * to_both @ correlation @ to_both.T
    return so3.by_axes(covariance)


# -- Agreement of the measured acceleration with the velocities in the images ---------------------
#
# Pose and velocities have the likelihood ``exp(-(e^T H e + 2 g^T e) / 2)`` by the images alone
# (`ImageInformation`). After elimination of the rotation (by the gyro), ``u = b (d - c t) + a``
# (`priors`) is linear in the rest, ``y = (s, v_1 - d_1, v_2 - d_2)``: ``u = u_0 + b J y``. For a
# baseline b [m], an acceleration with its a and W has the evidence::
#
#     Z_b = b^6 |W|^1/2 |A|^-1/2 exp(q^T A^-1 q / 2 - u_0^T W u_0 / 2)
#     A   = H + b^2 J^T W J,      q = g + b J^T W u_0
#
# averaged over the speeds of a carrier. Z of the measured acceleration by Z of the random one of a
# carrier is a Bayes factor (Kass and Raftery, JASA 1995): above 1 if the images are consistent
# with the measured one, 1 if they contain no information, below 1 if they contradict it.

# Baselines over which the evidence is averaged.
_BASELINES = 14


class InertialEvidence(NamedTuple):
    """Logarithms of the Bayes factors of one pair, by its images."""

    configured: float  # of the measured acceleration
    opposite: float  # of the opposite one, as of an accelerometer with the other sign


def inertial_evidence(
    problem: TwoViewProblem,
    images: ImageInformation,
    motion: str,
    interval: float,
    measured: VelocityPrior,
) -> InertialEvidence | None:
    """Evidence of a pair's images for its acceleration; None if they contain none.

    `problem`: with the gyro's rotation; its matches are not used. `images`: of the pose, estimated
    with or without that acceleration. `measured`: prior by the acceleration
    (`expected_velocities`); the opposite one has the (small) part of the lever arm reversed, too.
    """
    if (
        len(images.gradient) == ROTATION
        or problem.rotation is None
        or problem.rotation_information is None
    ):
        return None
    H, g = _without_rotation(images, problem.rotation, problem.rotation_information)
    unknown, _ = expected_velocities(problem, motion, interval, None)
    log_b = np.linspace(*span_of_scales(motion, interval), _BASELINES)
    configured, opposite, nothing = (
        _log_evidence(H, g, images.t, images.velocities, prior, log_b)
        for prior in (measured, measured._replace(offset=-measured.offset), unknown)
    )
    if not math.isfinite(configured + opposite - nothing):
        return None
    return InertialEvidence(configured - nothing, opposite - nothing)


def _without_rotation(
    images: ImageInformation, rotation: Array, information: Array
) -> tuple[Array, Array]:
    """Information (8, 8) and gradient (8,) of s and the velocities, the rotation by the gyro."""
    H, g = images.information.copy(), images.gradient.copy()
    theta = so3.log_so3(np.ascontiguousarray(rotation @ images.R.T))
    H[:ROTATION, :ROTATION] += information
    g[:ROTATION] -= information @ theta
    # The rotation last.
    order = np.roll(np.arange(len(g)), -ROTATION)
    return eliminate(H[np.ix_(order, order)], g[order], len(g) - ROTATION)


@kernel
def _log_evidence(
    H: Array, g: Array, t: Array, velocities: Array, prior: VelocityPrior, log_b: Array
) -> float:
    """Log of Z for the acceleration of `prior`, averaged over ``log b`` (K,)."""
    basis, W = so3.tangent_basis(t), prior.information
    J, away = np.zeros((6, 8)), np.empty(6)
    for i in range(6):
        J[i, 0], J[i, 1] = -prior.rate * basis[i % 3, 0], -prior.rate * basis[i % 3, 1]
        J[i, 2 + i] = 1.0
        away[i] = velocities[i] - prior.rate * t[i % 3]
    WJ = W @ J
    JWJ, of_prior = J.T @ WJ, 0.5 * log_determinant(W)
    values = np.empty(len(log_b))
    for k in range(len(log_b)):
        b = math.exp(log_b[k])
        u = b * away + prior.offset
        A, q = H + b * b * JWJ, g + b * (WJ.T @ u)
        values[k] = (
            6.0 * log_b[k]
            + of_prior
            - 0.5 * log_determinant(A)
            + 0.5 * (q * (inverse(A) @ q)).sum()
            - 0.5 * (u * (W @ u)).sum()
        )
    largest = values.max()
    return largest + math.log(np.exp(values - largest).mean())
