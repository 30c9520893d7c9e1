"""The joint fit with the scale b of the velocity prior chosen by its evidence over a grid.

The speed of the camera is not known in advance. With a wide prior (small b) the velocities absorb
noise if they are zero (usual, and then not even observable), a narrow one biases the pose if they
are large. The weights are the Laplace evidence ``-cost/2 - logdet(H)/2 + 6 log b``. If the time
between the frames is known, b is the baseline: an unknown of each fit, with a mixture over the
grid as prior.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np

from rs_relpose_ros.config.settings import CarrierMotion, MOTIONS
from rs_relpose_ros.core.least_squares import eliminate, inverse, log_determinant
from rs_relpose_ros.core.losses import noise_mixture
from rs_relpose_ros.errors import InputError
from rs_relpose_ros.estimator import priors, sampson
from rs_relpose_ros.estimator.covariance import ImageInformation, ROTATION, sandwich, scaled_like
from rs_relpose_ros.estimator.fit import fit, linearised, NormalEquations
from rs_relpose_ros.estimator.priors import PARAMETERS, Priors, SCALE, TwoViewState, VelocityPrior
from rs_relpose_ros.estimator.problem import TwoViewProblem
from rs_relpose_ros.estimator.sampson import FitMatches
from rs_relpose_ros.geometry import Array, Flags, so3
from rs_relpose_ros.geometry.motion import InertialMotion
from rs_relpose_ros.jit import kernel, small_kernel

# Rounds of inlier selection and fits. [chosen: most pairs keep their inliers after the second]
ROUNDS = 3
# Most steps of a fit from the optimum of a neighbouring scale.
# [chosen: most fits end after three, by their gain]
ITERATIONS = 6
# Most steps of a fit on the inliers of the last round, which are nearly those of the round before.
# [chosen: the second step changes the cost by less than 1e-3]
LAST_ITERATIONS = 2
# Least inlier threshold, in units of the estimated noise. A smaller one would cut the tail of good
# matches. [derived: one good match in 16 000 is farther]
REACH = 4.0
# Largest inlier threshold, in units of the configured one: noise that is estimated among outliers
# grows with the threshold. [chosen: any value in 1.5..3 would do]
WIDEST = 2.0
# A scale is left out of the average if its log-evidence is lower than the best one by more than
# this. [derived: its weight would be below e^-6 = 0.25 %]
LEAST_EVIDENCE = 6.0


class Scales(NamedTuple):
    """Grid of scales of the velocities (`priors`)."""

    centres: Array  # ``log b`` of each, or the mean of its prior
    log_weights: Array  # logarithms of their prior probabilities, up to a constant

    def nearest(self, log_scale: float) -> Scales:
        """The scale nearest to `log_scale` alone."""
        nearest = int(np.argmin(np.abs(self.centres - log_scale)))
        only = slice(nearest, nearest + 1)
        return Scales(self.centres[only], self.log_weights[only])


class Refined(NamedTuple):
    """A refined state, its matches and its covariance."""

    state: TwoViewState
    inliers: Flags  # (N,) the matches of the last fits
    log_scale: float  # log b of the largest evidence, or the mean if it is unknown
    velocity_sigma: float  # of the velocities' prior [baselines per second]
    sigma: float  # noise of a match in the fits [px]
    covariance: Array  # (n, n) of the local parameters, within the fits and between them


class _Search(NamedTuple):
    """What all fits of a pair share."""

    matches: FitMatches  # all of them, with the configured noise
    start: TwoViewState
    prior: Priors
    threshold: float  # inlier threshold [px]
    scales: Scales
    gyro_error: Array  # (3, 3) of `sandwich`


class _Optima(NamedTuple):
    """Optima of the K scales; arrays are filled scale by scale."""

    steps: Array  # (K, n) from the start of the search, with the logarithm of b if it is unknown
    evidences: Array  # (K,) log-evidence
    hessians: Array  # (K, n, n) of the whole objective
    of_data: Array  # (K, n, n) part of the matches, zero for an unknown b


@kernel
def fit_with_evidence(
    matches: FitMatches,
    start: TwoViewState,
    prior: Priors,
    threshold: float,
    scales: Scales,
    gyro_error: Array,
) -> Refined:
    """Select inliers and fit repeatedly; average over the scales of the velocities at the end.

    The state is the mean over the scales, weighted by their evidence. `matches` have the
    configured noise, `threshold` [px] is the inlier threshold, and `sandwich` describes
    `gyro_error` (3, 3).
    """
    search = _Search(matches, start, prior, threshold, scales, gyro_error)
    size = len(scales.centres)
    n = priors.unknowns(prior)
    optima = _Optima(
        np.zeros((size, n)),
        np.full(size, -math.inf),
        np.zeros((size, n, n)),
        np.zeros((size, n, n)),
    )
    state = start
    used = _selected(search, state, threshold)
    # By how much each scale lacks evidence in its last round.
    lacking = np.zeros(size)
    # The scale of `start`, or the next one.
    best = int(np.argmin(np.abs(scales.centres - prior.velocity.log_scale)))
    for attempt in range(ROUNDS):
        low = 0
        high = size
        if attempt > 0:  # the best scale changes little with the inliers of the first round
            low = max(best - 1, 0)
            high = min(best + 2, size)
        _fit_scales(search, used, state, optima, (low, best, high))
        evidences = optima.evidences
        best = low + int(np.argmax(evidences[low:high]))
        for k in range(low, high):
            lacking[k] = evidences[best] - evidences[k]
        state = priors.moved(start, optima.steps[best])
        inliers = used.weights > 0.0
        reach = min(max(threshold, REACH * used.sigma), WIDEST * threshold)
        used = _selected(search, state, reach)
        if ((used.weights > 0.0) == inliers).all():
            break
    likely = lacking < LEAST_EVIDENCE
    _fit_again(search, used, optima, likely)
    return _average(search, used, optima, likely)


@small_kernel
def _fit_scales(
    search: _Search,
    used: FitMatches,
    state: TwoViewState,
    optima: _Optima,
    scales: tuple[int, int, int],
) -> None:
    """Fit about the scales from `low` to before `high`, each from its neighbour's optimum.

    `scales`: low, best, high. The fits go from the best scale down, and from it up. `state`: the
    optimum of the best scale so far.
    """
    low, best, high = scales
    data = linearised(used, state)
    upwards = state
    upwards_data = data
    for number in range(high - low):
        k = best - number if number <= best - low else low + number
        if k == best + 1:
            state = upwards
            data = upwards_data
        centre = search.scales.centres[k]
        state, data = _fit_scale(search, used, state, data, optima, k, centre, int(ITERATIONS))
        if k == best:
            upwards = state
            upwards_data = data


@small_kernel
def _fit_again(search: _Search, used: FitMatches, optima: _Optima, likely: Flags) -> None:
    """Continue the fits of the `likely` (K,) scales on the last inliers.

    The other scales get no weight.
    """
    for k in range(len(likely)):
        optima.evidences[k] = -math.inf
        if likely[k]:
            step = optima.steps[k]
            state = priors.moved(search.start, step)
            log_scale = search.scales.centres[k]
            if len(step) > SCALE:
                log_scale = step[SCALE]
            data = linearised(used, state)
            _fit_scale(search, used, state, data, optima, k, log_scale, int(LAST_ITERATIONS))


@small_kernel
def _selected(search: _Search, state: TwoViewState, threshold: float) -> FitMatches:
    """Inliers of a state within `threshold` [px], with their noise."""
    matches = search.matches
    r = sampson.residuals(matches.observations, state)
    inliers = sampson.within(r, matches, state, threshold)
    weights, sigma = noise_mixture(r, inliers, matches.sigma)
    return FitMatches(matches.observations, weights, sigma, matches.focal)


@small_kernel
def _known_velocities(data: NormalEquations, state: TwoViewState, prior: Priors) -> float:
    """How many of the six velocities the matches determine rather than their prior.

    ``g = 6 - tr(C V)``, where V is the part of the prior in the Hessian whose inverse is C
    (MacKay, Neural Computation 4, 1992): the derivative of the log-evidence by ``log b``.
    """
    hessian = np.zeros((PARAMETERS, PARAMETERS))
    of_prior = np.zeros((PARAMETERS, PARAMETERS))
    gradient = np.zeros(PARAMETERS)  # is not used
    priors.add_priors(state, prior, hessian, gradient)
    priors.add_velocities(state, prior.velocity, of_prior, gradient)
    known = 6.0 - (inverse(hessian + data.hessian) * of_prior).sum()
    return min(max(known, 0.0), 6.0)


@kernel
def _fit_scale(
    search: _Search,
    used: FitMatches,
    state: TwoViewState,
    data: NormalEquations,
    optima: _Optima,
    k: int,
    log_scale: float,
    iterations: int,
) -> tuple[TwoViewState, NormalEquations]:
    """Fit about scale k, from `state`, about which `data` is, and `log_scale`; write its optimum.

    Returns the state at the optimum and the equations of the matches about it.
    """
    centre = search.scales.centres[k]
    prior = priors.at_scale(search.prior, log_scale, centre, 0.0)
    if prior.velocity.weight > 0.0:
        known = _known_velocities(data, state, prior)
        prior = priors.at_scale(prior, log_scale, centre, known)
    state, log_scale, data, whole = fit(used, state, data, prior, iterations)
    cost = whole.cost + 2.0 * prior.velocity.freedom * log_scale
    # Velocities that move the camera by more than the baseline within a frame fit any residual,
    # with points behind the cameras: those count as outliers.
    behind = sampson.count_behind(search.matches, used.weights > 0.0, state)
    cost += behind * (search.threshold / used.sigma) ** 2
    of_width = 6.0 * log_scale - 0.5 * log_determinant(whole.hessian)
    optima.evidences[k] = -0.5 * cost + of_width + search.scales.log_weights[k]
    so3.copy_vector(priors.step_between(search.start, state), optima.steps[k])
    if len(whole.gradient) > SCALE:
        optima.steps[k, SCALE] = log_scale
    so3.copy_matrix(whole.hessian, optima.hessians[k])
    so3.copy_matrix(data.hessian, optima.of_data[k])
    return state, data


@small_kernel
def _average(search: _Search, used: FitMatches, optima: _Optima, likely: Flags) -> Refined:
    """Mean state over the scales, its covariance, and the scale of the largest evidence.

    If the data do not determine the scale, one of them alone is overconfident.
    """
    size, n = optima.steps.shape
    best = int(np.argmax(optima.evidences))
    best_step = optima.steps[best]
    # About the best one, from which the local parameters of all of them are small.
    origin = priors.moved(search.start, best_step)
    weights = np.exp(optima.evidences - optima.evidences[best])
    weights /= weights.sum()
    mean = np.zeros(n)
    away = np.zeros((size, n))
    for k in range(size):
        if likely[k]:
            step = optima.steps[k]
            state = priors.moved(search.start, step)
            so3.copy_vector(priors.step_between(origin, state), away[k])
            if n > SCALE:
                away[k, SCALE] = step[SCALE] - best_step[SCALE]
            mean += weights[k] * away[k]
    within_fits = np.zeros((n, n))
    between_fits = np.zeros((n, n))
    for k in range(size):
        if likely[k]:
            rest = away[k] - mean
            within_fits += weights[k] * inverse(optima.hessians[k])
            for i in range(n):
                for j in range(n):
                    between_fits[i, j] += weights[k] * (rest[i] * rest[j])
    # Errors are those of the best fit: the misfit of another one is no noise. Its sandwich scales
    # the mean of the fits. [measured: 117 pairs of recordings, two views: with the sandwich of the
    # best fit in place of the scaled mean, NEES of t 2.1 for 1.7 and 7 % beyond 3 sigma for 3 %;
    # with the mean of one sandwich per fit, 5 of 240 simulated poses become too uncertain]
    fitted = inverse(optima.hessians[best])
    robust = sandwich(
        used,
        origin,
        optima.of_data[best],
        optima.hessians[best],
        fitted,
        search.prior,
        search.gyro_error,
    )
    log_scale = search.scales.centres[best]
    if n > SCALE:
        log_scale = best_step[SCALE] + mean[SCALE]
    # Root mean square over the six velocities.
    of_velocities = inverse(search.prior.velocity.information)
    sigma = math.sqrt(np.trace(of_velocities) / 6.0)
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

# Correlation time of the acceleration of a carrier [s]. A longer one lets an acceleration move the
# carrier further, a shorter one less. [chosen: steps, gusts and gears; any value in 0.1..0.5 would
# do]
CORRELATION_TIME = 0.2
# Error of the assumption of a constant velocity during the readout [m/s]. A smaller one would make
# the velocities at both ends of a short interval equal. [chosen: 1 m/s^2 over a third of a readout
# of 15 ms]
ROW_VELOCITY_SIGMA = 0.005
# Number of scales of the baseline over the speeds of a carrier. More of them cost a fit each, and
# fewer leave gaps between the optima of neighbours. [chosen: neighbours differ by a factor of 2 to
# 3]
SCALE_COUNT = 4
# Sigma of the prior of each scale, as a share of the distance to the next one. With less, scales
# between two of them are unlikely; with more, all fits have the same prior. [chosen: a long row of
# such Gaussians is flat to 1e-4, at 0.4 it has ripples of 8 %]
WIDTH = 0.7

# Prior sigmas of the velocities without a time between the frames [baselines per second]. If the
# velocities are not observable (sideways motion, cameras at rest), a wide prior alone would
# convert noise to velocity and degrees of translation. [chosen: from rest to a baseline in a tenth
# of a second]
GRID = np.array([0.003, 0.03, 0.1, 0.3, 1.0, 3.0, 10.0])
# Exponent of the power law of the prior of these sigmas. A larger one favours cameras at rest.
# [chosen: the prior is flat at 0, and at 1 it decides against any velocity]
SMALL_IS_LIKELIER = 0.5
# Scales without a time between the frames. [derived: the grid and the power law]
TIMELESS = Scales(np.asarray(-np.log(GRID)), np.asarray(-SMALL_IS_LIKELIER * np.log(GRID)))
# Velocities that are fixed at zero. [derived: the weight of a pinned unknown]
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
        expected = np.zeros(6)
        covariance = _of_carrier(carrier, interval)
    else:
        expected, covariance = _of_imu(problem, inertial)
    # (alpha', beta') to u = b (d - c t) + a: a = (alpha' / T, alpha' / T - beta')
    to_velocities = so3.by_axes(np.array([[1.0 / interval, 0.0], [1.0 / interval, -1.0]]))
    covariance = to_velocities @ covariance @ to_velocities.T
    covariance += ROW_VELOCITY_SIGMA**2 * np.eye(6)
    lowest, highest = span_of_scales(motion, interval)
    step = (highest - lowest) / SCALE_COUNT
    centres = np.asarray(lowest + step * (0.5 + np.arange(SCALE_COUNT)), dtype=np.float64)
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
    shifted = inertial.shifted(delay, turn)
    p = np.asarray(inertial.lever_arm)
    alpha = shifted.alpha
    beta = shifted.beta
    if p.any():
        if problem.rotation is None:
            raise InputError('inertial with a lever_arm requires relative_rotation, too')
        R = problem.rotation
        arm1 = so3.skew(problem.motion1.angular_velocity) @ p
        arm2 = so3.skew(problem.motion2.angular_velocity) @ p
        alpha = alpha + inertial.duration * arm1 + p - R @ p
        beta = beta + arm1 - R @ arm2
    return np.concatenate([alpha, beta]), shifted.covariance


def _of_carrier(carrier: CarrierMotion, interval: float) -> Array:
    """Covariance (6, 6) of (alpha, beta) of a random acceleration, correlated exponentially."""
    parts = 16
    times = (np.arange(parts) + 0.5) * interval / parts
    to_both = np.vstack([interval - times, np.ones(parts)]) * interval / parts
    apart = np.abs(times[:, None] - times)
    correlation = np.exp(-apart / CORRELATION_TIME)
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

# Number of baselines over which the evidence is averaged. Fewer leave gaps, more cost time.
# [chosen: they differ by a factor of 1.3 for the range of a hand-held camera]
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
    reversed_measured = measured._replace(offset=-measured.offset)
    log_b = np.linspace(*span_of_scales(motion, interval), _BASELINES)
    configured, opposite, nothing = (
        _log_evidence(H, g, images.t, images.velocities, prior, log_b)
        for prior in (measured, reversed_measured, unknown)
    )
    if not math.isfinite(configured + opposite - nothing):
        return None
    return InertialEvidence(configured - nothing, opposite - nothing)


def _without_rotation(
    images: ImageInformation, rotation: Array, information: Array
) -> tuple[Array, Array]:
    """Information (8, 8) and gradient (8,) of s and the velocities, the rotation by the gyro."""
    H = images.information.copy()
    g = images.gradient.copy()
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
    basis = so3.tangent_basis(t)
    W = prior.information
    J = np.zeros((6, 8))
    away = np.empty(6)
    for i in range(6):
        axis = i % 3
        J[i, 0] = -prior.rate * basis[axis, 0]
        J[i, 1] = -prior.rate * basis[axis, 1]
        J[i, 2 + i] = 1.0
        away[i] = velocities[i] - prior.rate * t[axis]
    WJ = W @ J
    JWJ = J.T @ WJ
    of_prior = 0.5 * log_determinant(W)
    values = np.empty(len(log_b))
    for k in range(len(log_b)):
        b = math.exp(log_b[k])
        u = b * away + prior.offset
        A = H + b * b * JWJ
        q = g + b * (WJ.T @ u)
        value = 6.0 * log_b[k] + of_prior
        value -= 0.5 * log_determinant(A)
        value += 0.5 * (q * (inverse(A) @ q)).sum()
        value -= 0.5 * (u * (W @ u)).sum()
        values[k] = value
    largest = values.max()
    return largest + math.log(np.exp(values - largest).mean())
