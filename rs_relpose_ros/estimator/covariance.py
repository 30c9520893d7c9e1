"""Covariance of a state and of a pose; information of the images alone.

A Hessian H assumes independent residuals and priors with their configured sigmas. The sandwich
``H^-1 S H^-1`` does not: S is the covariance of the gradient at the optimum (docs/estimator.md,
"Covariance"). Its part of the matches is estimated from the gradients of image regions, its gyro
part from the agreement of gyro and images.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from rs_relpose_ros.core import losses
from rs_relpose_ros.core.deviations import FIRST, Selection
from rs_relpose_ros.core.least_squares import adjusted_scores, cholesky, CR2, eliminate, inverse
from rs_relpose_ros.estimator.fit import linearised, with_priors
from rs_relpose_ros.estimator.priors import (
    D1,
    D2,
    DW1,
    DW2,
    PARAMETERS,
    Priors,
    SCALE,
    TANGENT,
    THETA,
    TwoViewState,
)
from rs_relpose_ros.estimator.problem import PairState, PARTS, TwoViewProblem
from rs_relpose_ros.estimator.sampson import FitMatches
from rs_relpose_ros.geometry import Array, Indices, so3
from rs_relpose_ros.jit import kernel, small_kernel

# Regions of the field that the matches cover: columns and rows. The errors of neighbours (blur,
# lens, tracker) are correlated within a region. Fewer regions make the scatter of their gradients
# noisy, more of them divide what is correlated. [chosen: about ten matches each]
REGIONS = (4, 3)
# Number of additional regions as which the Hessian's covariance of the gradient counts. The
# scatter of twelve regions has not the rank of 17 unknowns, which the information of the images
# needs. [measured: 238 simulated pairs, two views: without them NEES of R 1.12 for 0.89 and 0.4 %
# beyond 3 sigma for 0; 116 pairs of recordings 1.32 for 1.35]
HESSIAN_REGIONS = 8
# Degrees of freedom as which the gyro's configured sigmas count, added to the disagreement's. Less
# makes the noise of a pair as uncertain as its three angles, more hides a gyro that is worse.
# [chosen: one of the nine of a pair]
PRIOR_FREEDOM = 1.0
# If the gyro alone decides, it cannot disagree: this share of its variance keeps 0 / 0 defined.
# [chosen: any value in 1e-6..1e-2 would do]
LEAST_DISAGREEMENT = 1e-3


@small_kernel
def sandwich(
    matches: FitMatches,
    state: TwoViewState,
    data_hessian: Array,
    hessian: Array,
    covariance: Array,
    prior: Priors,
    gyro_error: Array,
) -> Array:
    """``H^-1 S H^-1`` (n, n) at an optimum `state` with the Hessian H, `covariance` being H^-1.

    `data_hessian` (n, n) is the part of the matches in H. S is the sum of their covariance, of the
    part of the priors in H, and of the excess of the priors by the gyro beyond their configured
    sigmas. `gyro_error` (3, 3) is the covariance of those errors of the rotation by the gyro that
    are not in its prior.
    """
    ratio = gyro_variance_ratio(state, prior, covariance)
    excess = np.zeros(hessian.shape)
    information = prior.rotation_information
    rotation = (ratio - 1.0) * information + information @ gyro_error @ information
    so3.copy_matrix(rotation, excess[THETA:, THETA:])
    for i in range(DW1, PARAMETERS):
        excess[i, i] = (ratio - 1.0) * prior.rate_weight
    # If gyro and images disagree, either may be in error: the noise of both is larger. [measured:
    # 117 pairs of recordings, two views: without it NEES of t 1.9 for 1.7 and 5.1 % beyond 3 sigma
    # for 3.4 %; without the ratio at all, NEES of R 1.7 for 1.35]
    of_matches = max(ratio, 1.0) * score_of_matches(matches, state, data_hessian, hessian)
    scores = of_matches + (hessian - data_hessian) + excess
    return covariance @ scores @ covariance


@small_kernel
def scaled_like(covariance: Array, before: Array, after: Array) -> Array:
    """``T C T^T`` with ``T before T^T = after``: C scaled as `before` is to `after`.

    T is lower triangular. C is returned unchanged if one of the two others is singular.
    """
    n = len(covariance)
    L_before = np.zeros((n, n))
    L_after = np.zeros((n, n))
    T = np.zeros((n, n))
    if not (cholesky(before, L_before) and cholesky(after, L_after)):
        return covariance
    for i in range(n):
        for j in range(i, -1, -1):  # T L_before = L_after
            value = L_after[i, j]
            for k in range(j + 1, i + 1):
                value -= T[i, k] * L_before[k, j]
            T[i, j] = value / L_before[j, j]
    return T @ covariance @ T.T


@kernel
def score_of_matches(
    matches: FitMatches, state: TwoViewState, data_hessian: Array, hessian: Array
) -> Array:
    """Covariance (n, n) of the matches' gradient, by image regions and by the Hessian.

    The errors of matches in one region of the image may be correlated.
    """
    regions = image_regions(matches)
    count = REGIONS[0] * REGIONS[1]
    n = len(hessian)
    scores = np.zeros((count, n))
    curvatures = np.zeros((count, n, n))
    filled = 0
    cost = 0.0
    for region in range(count):
        weights = (regions == region) * matches.weights
        if not weights.any():
            continue
        used = FitMatches(matches.observations, weights, matches.sigma, matches.focal)
        own = linearised(used, state)
        so3.copy_vector(own.gradient, scores[region])
        so3.copy_matrix(own.hessian, curvatures[region])
        filled += 1
        cost += own.cost
    adjusted = adjusted_scores(scores, curvatures, hessian, CR2)
    # Noise by the residuals alone, without the configured sigma: (units of sigma)^2.
    freedom = max(matches.weights.sum() - losses.FITTED, 0.0)
    variance = (1.0 + cost) / (1.0 + freedom)
    share = filled / (filled + HESSIAN_REGIONS)
    return share * adjusted.T @ adjusted + (1.0 - share) * variance * data_hessian


@kernel
def image_regions(matches: FitMatches) -> Indices:
    """Region number of each match (N,), by its first ray; -1 for those that are not used."""
    rays = matches.observations
    n = len(rays)
    low = np.full(2, np.inf)
    high = np.full(2, -np.inf)
    for i in range(n):
        if matches.weights[i] > 0.0:
            for k in range(2):
                low[k] = min(low[k], rays[i, k])
                high[k] = max(high[k], rays[i, k])
    regions = np.full(n, -1)
    for i in range(n):
        if matches.weights[i] > 0.0:
            number = 0
            for k in range(2):
                share = (rays[i, k] - low[k]) / max(high[k] - low[k], 1e-12)
                place = min(int(REGIONS[k] * share), REGIONS[k] - 1)
                number = REGIONS[k] * number + place
            regions[i] = number
    return regions


@small_kernel
def gyro_variance_ratio(state: TwoViewState, prior: Priors, covariance: Array) -> float:
    """Variance of the gyro, as estimated from one pair, by the configured one.

    ``(1 + chi2) / (1 + freedom)`` at an optimum of covariance C (17, 17), with::

        chi2 = theta^T (Lambda^-1 - C_theta)^-1 theta + (|dw_1|^2 + |dw_2|^2) / s_w^2

    theta is the rotation from the gyro's; ``Lambda^-1 - C_theta`` is its covariance, and the rates
    have ``6 - tr(C_w) / s_w^2`` degrees of freedom, if gyro and images are both right.
    """
    chi2 = 0.0
    freedom = 0.0
    if prior.rotation_information[0, 0] > 0.0:
        theta = so3.log_so3(state.R @ prior.rotation.T)
        by_gyro = (1.0 + LEAST_DISAGREEMENT) * inverse(prior.rotation_information)
        away = by_gyro - covariance[:3, :3]
        chi2 += (theta * (inverse(away) @ theta)).sum()
        freedom += 3.0
    chi2 += prior.rate_weight * ((state.dw1**2).sum() + (state.dw2**2).sum())
    freedom += 6.0
    for i in range(DW1, PARAMETERS):
        freedom -= prior.rate_weight * covariance[i, i]
    return (PRIOR_FREEDOM + chi2) / (PRIOR_FREEDOM + max(freedom, 0.0))


def local_covariance(matches: FitMatches, state: TwoViewState, prior: Priors) -> Array:
    """Covariance (17, 17) of the local parameters from the regularised Hessian."""
    whole = with_priors(linearised(matches, state), state, prior)
    local = inverse(whole.hessian)
    # The error of a state that is not the optimum is about this step.
    step = local @ whole.gradient
    return np.asarray(local + np.outer(step, step))


def pair_state(
    problem: TwoViewProblem, state: TwoViewState, log_scale: float, local: Array
) -> PairState:
    """The state in each camera's own frame, with its covariance.

    `log_scale`: of the velocities, the logarithm of the baseline if that is in metres. `local`
    (n, n): covariance of the local parameters ``(theta, tangent, d_1, d_2, dw_1, dw_2)``, in frame
    1, and of `log_scale` if it is unknown.
    """
    eye = np.eye(3)
    R_back = state.R.T
    t, theta, v1, v2, w1, w2, log_baseline = PARTS.values()
    jacobian = np.zeros((log_baseline.stop, len(local)))
    jacobian[t, TANGENT:D1] = so3.tangent_basis(state.t)
    jacobian[theta, THETA:TANGENT] = eye
    jacobian[v1, D1:D2] = eye
    # v_2 = R^T d_2 and w_2 = w + R^T dw_2 rotate with the error of R.
    jacobian[v2, D2:DW1] = R_back
    jacobian[v2, THETA:TANGENT] = R_back @ so3.skew(state.d2)
    jacobian[w1, DW1:DW2] = eye
    jacobian[w2, DW2:PARAMETERS] = R_back
    jacobian[log_baseline, SCALE:] = 1.0
    return PairState(
        state.R,
        state.t,
        state.d1,
        R_back @ state.d2,
        problem.motion1.angular_velocity + state.dw1,
        problem.motion2.angular_velocity + R_back @ state.dw2,
        log_scale,
        jacobian @ local @ jacobian.T,
    )


# -- Information of the images alone, in canonical form: without the priors of the IMU ------------
#
# A fit minimises ``D(x) + P(x)``, D being the matches' cost and P that of the inertial priors. A
# graph that combines pairs with the IMU's samples must not count P twice and needs D alone. About
# the fit, for a small deviation e of the pose::
#
#     2 D = e^T H e + 2 g^T e + constant        g = -(half gradient of P) at an optimum
#
# H may be singular: a global shutter does not observe velocities. The prior of the gyro's rate
# during the readout stays in it: without, rays have no common row.

# Number of deviations of a rotation alone. [derived: the order of the unknowns]
ROTATION = TANGENT
# Number of deviations of a pose without velocities. [derived: the order of the unknowns]
DIRECTION = D1
# Number of deviations of a pose with velocities. [derived: the order of the unknowns]
POSE = DW1
# Deviations that move the estimate of the images alone. Their time offset is of the stamped row,
# as the parameter; the deviations of the gyro are unknowns of whoever integrates it.
# [derived: the deviations that enter by the rows and the lens]
IMAGES = Selection.of(
    'axes', 'time_offset', 'readout_time', 'focal_log', 'principal_point', distortion=FIRST
)
# Share of the trace that is added to the diagonal of the scatter, so that it has an inverse.
# [chosen: above rounding, far below the information of any unknown; 1e-14..1e-9 would do]
_RANK = 1e-12


@dataclass(frozen=True, slots=True, eq=False)
class ImageInformation:
    """Cost ``e^T H e + 2 g^T e`` of deviations e from a pose, by the images alone.

    ``e = (theta, s, v_1 - d_1, v_2 - d_2)``, in the axes of camera 1: ``R_true = Exp(theta) R``,
    ``t_true`` along ``t + B s`` with ``B = tangent_basis(t)``, and the velocities of the two
    cameras [baselines per second]; or its first 5 or 3. All of it between the **middle** rows,
    with which the direction hardly depends on the velocities.
    """

    row_time: float  # [s] of the middle row, after the stamped one
    R: Array  # (3, 3) R_1^T R_2
    t: Array  # (3,) unit direction; NaN of a rotation alone
    velocities: Array  # (6,) d_1, d_2, in camera 1; NaN likewise
    information: Array  # (11, 11), (5, 5) or (3, 3) H
    gradient: Array  # (11,), (5,) or (3,) g
    # (11, 9), (5, 9) or (3, 9): change of the estimate with the deviations of IMAGES,
    # exact as float32; None if it is not known.
    by_deviation: Array | None = None

    def of_rotation(self) -> ImageInformation:
        """The same of the rotation alone, the rest eliminated."""
        if len(self.gradient) == ROTATION:
            return self
        unknown = np.full(9, np.nan)
        return replace(self._reduced(ROTATION), t=unknown[:3], velocities=unknown[3:])

    def without_velocities(self) -> ImageInformation:
        """The same of rotation and direction (5,), the velocities eliminated."""
        return self._reduced(DIRECTION)

    def enlarged(self, factor: float) -> ImageInformation:
        """The same with its covariance times a factor."""
        information = self.information / factor
        return replace(self, information=information, gradient=self.gradient / factor)

    def _reduced(self, kept: int) -> ImageInformation:
        """Keep the first deviations."""
        information, gradient = eliminate(self.information, self.gradient, kept)
        by_deviation = None if self.by_deviation is None else self.by_deviation[:kept]
        return replace(self, information=information, gradient=gradient, by_deviation=by_deviation)

    def moved_by(self, by_deviation: Array) -> ImageInformation:
        """The same with the effect (11, 9) of deviations, as far as it has these unknowns."""
        rows = by_deviation[: len(self.gradient)].astype(np.float32)
        return replace(self, by_deviation=rows.astype(np.float64))


def image_information(
    matches: FitMatches, state: TwoViewState, prior: Priors, row_time: float
) -> ImageInformation:
    """Of the matches of a fit, with the rates' part of its `prior` only."""
    H, g = _of_pose(matches, state, prior)
    velocities = np.concatenate([state.d1, state.d2])
    return ImageInformation(row_time, state.R, state.t, velocities, H, g)


@kernel
def _of_pose(matches: FitMatches, state: TwoViewState, prior: Priors) -> tuple[Array, Array]:
    """Information (11, 11) and gradient (11,) of the pose, the rates eliminated."""
    data = linearised(matches, state)
    H = data.hessian
    g = data.gradient
    # With the errors by image regions instead of those of the Hessian: H S^-1 H.
    whole = with_priors(data, state, prior)
    S = score_of_matches(matches, state, H, whole.hessian)
    floor = _RANK * (np.trace(S) + 6.0 * prior.rate_weight)
    for i in range(3):
        g[DW1 + i] += prior.rate_weight * state.dw1[i]
        g[DW2 + i] += prior.rate_weight * state.dw2[i]
    for i in range(DW1, PARAMETERS):
        H[i, i] += prior.rate_weight
        S[i, i] += prior.rate_weight
    for i in range(PARAMETERS):
        S[i, i] += floor
    weighted = H @ inverse(S)
    return eliminate(weighted @ H, weighted @ g, int(POSE))


def rotation_information(
    R: Array, information: Array, prior: Array, theta: Array, row_time: float
) -> ImageInformation:
    """Of a fit of a rotation alone with a `prior` (3, 3) at the distance `theta` (3,)."""
    unknown = np.full(9, np.nan)
    gradient = -(prior @ theta)
    return ImageInformation(row_time, R, unknown[:3], unknown[3:], information - prior, gradient)
