"""One frame pair, end to end: derotate, sample, optimise, refine, covariance."""

from __future__ import annotations

from dataclasses import replace
import math
import time

import numpy as np
from numpy.typing import ArrayLike, NDArray

from rs_relpose_ros.config.estimator import EstimatorConfig
from rs_relpose_ros.errors import InputError
from rs_relpose_ros.estimator.alternating import refine_alternating
from rs_relpose_ros.estimator.arguments import (
    checked_interval,
    checked_matches,
    checked_rotation,
)
from rs_relpose_ros.estimator.consensus import SCALES
from rs_relpose_ros.estimator.hypotheses import draw_hypotheses, MODES, SolverMode
from rs_relpose_ros.estimator.image_information import (
    image_information,
    ImageInformation,
    rotation_information,
)
from rs_relpose_ros.estimator.inertial_evidence import inertial_evidence, InertialEvidence
from rs_relpose_ros.estimator.information import inverse
from rs_relpose_ros.estimator.inliers import cheirality_sign, Flags, Matches, select_inliers
from rs_relpose_ros.estimator.landmarks import landmarks
from rs_relpose_ros.estimator.local_optimisation import optimise
from rs_relpose_ros.estimator.map_fit import FitMatches
from rs_relpose_ros.estimator.noise import noise_mixture
from rs_relpose_ros.estimator.priors import (
    isotropic,
    PINNED,
    Priors,
    VelocityPrior,
    with_velocity,
)
from rs_relpose_ros.estimator.problem import (
    build_problem,
    PairState,
    to_reference_row,
    TwoViewProblem,
)
from rs_relpose_ros.estimator.result import RelativePose, Status
from rs_relpose_ros.estimator.rotation_only import fit_rotation, transfer_errors
from rs_relpose_ros.estimator.sampson import residuals
from rs_relpose_ros.estimator.spread import (
    correlation,
    distance_from_a_plane,
    distinct_directions,
)
from rs_relpose_ros.estimator.state import hypothesis_state, signed, TwoViewState
from rs_relpose_ros.estimator.uncertainty import local_covariance, pair_state
from rs_relpose_ros.estimator.velocities_expected import (
    AT_ZERO,
    TIMELESS,
    velocities_expected,
)
from rs_relpose_ros.estimator.velocity_prior import fit_with_evidence, Noise, Refined
from rs_relpose_ros.geometry.camera import RollingShutterCamera
from rs_relpose_ros.geometry.inertial import InertialMotion
from rs_relpose_ros.geometry.motion import FrameMotion
from rs_relpose_ros.geometry.so3 import aligning_rotation, exp_so3, log_so3
from rs_relpose_ros.solvers.solver import Solutions

Array = NDArray[np.float64]


# Prior sigma of the velocities while hypotheses are compared [baselines per second].
SAMPLING_VELOCITY_SIGMA = 3.0
# Share of the matches that a solver must explain to spare those that know less.
EXPLAINED = 0.5
# Columns of an observation at which its rays f_1 and f_2 begin.
RAYS = (0, 9)
# Noise of |f_1 - R f_2| is 1.67 sigma in the median (Rayleigh, two images).
ROTATION_ONLY_SIGMAS = 2.5
# Least chi-square of the acceleration (6 degrees of freedom; 99 % of pure noise lie below) and
# largest 1 sigma of the logarithm of a baseline: beyond it, the baseline is not told.
LEAST_ACCELERATION = 16.8
MOST_LOG_SIGMA = 1.0
# Points whose root mean square distance from a line is below so many thresholds lie on it.
DEGENERATE_THRESHOLDS = 2.0


def estimate_relative_pose(
        points1: ArrayLike, points2: ArrayLike, camera: RollingShutterCamera, motion1: FrameMotion,
        motion2: FrameMotion, relative_rotation: ArrayLike | None = None,
        relative_rotation_covariance: ArrayLike | None = None, interval: float | None = None,
        config: EstimatorConfig | None = None, rng: int | np.random.Generator = 0, *,
        quality: ArrayLike | None = None, inertial: InertialMotion | None = None,
        global_shutter_pixels: bool = False) -> RelativePose:
    """Relative pose of two rolling-shutter frames from matches, gyro and gravity.

    Parameters
    ----------
    points1, points2 : (N, 2) array_like
        Matches in raw (distorted) pixels.
    camera : RollingShutterCamera
        The pose relates its reference rows.
    motion1, motion2 : FrameMotion
        Angular velocity and gravity of each frame at its reference row; gravity may be None.
    relative_rotation : (3, 3) array_like, optional
        ``R_1^T R_2`` between the reference rows as predicted from the gyro.
    relative_rotation_covariance : (3, 3) array_like, optional
        Of its error dtheta in camera 1 [rad^2]: ``R_true = Exp(dtheta) relative_rotation``. Both
        or neither.
    interval : float, optional
        Seconds between the two reference instants: velocities are then about those of a carrier
        (`EstimatorConfig.motion`).
    config : EstimatorConfig, optional
    rng : int or numpy.random.Generator
        Equal input and state give an equal result, bit by bit.
    quality : (N,) array_like, optional
        Higher is better: the order in which matches are sampled.
    inertial : InertialMotion, optional
        Preintegrated acceleration between the two reference instants: velocities and baseline in
        metres follow from it. `interval` must be its duration, or None.
    global_shutter_pixels : bool
        Whether the result has `pixels1_gs` and `pixels2_gs`.

    Returns
    -------
    RelativePose
        Falsy, with `status` and `reason`, where the data hold no pose.

    Raises
    ------
    InputError
        (a ValueError) An argument of the wrong shape, not finite, or contradictory.

    Notes
    -----
    Design: hypotheses from derotated rays (gyro rotation and 2 points, angular 3- and 5-point),
    multi-scale MSAC, local optimisation of the uniform model on a shrinking threshold, joint MAP
    fit with the scale of the velocities chosen by its evidence (with `inertial`: the baseline),
    sandwich covariance over image regions; see `docs/estimator.md`.

    Examples
    --------
    >>> camera = RollingShutterCamera(width=640, height=480, fx=450.0, fy=450.0, cx=319.5,
    ...                               cy=239.5, readout_time=0.03)
    >>> still = FrameMotion(angular_velocity=[0.0, 0.0, 0.0])
    >>> pose = estimate_relative_pose([[1.0, 2.0]], [[1.5, 2.0]], camera, still, still)
    >>> bool(pose), pose.status.value
    (False, 'TOO_FEW_MATCHES')
    """
    started = time.perf_counter()
    config = EstimatorConfig() if config is None else config
    points1, points2, order = checked_matches(points1, points2, quality)
    rotation, rotation_covariance = checked_rotation(
        relative_rotation, relative_rotation_covariance)
    interval = checked_interval(interval, inertial)
    mode = MODES[config.solver]
    if mode.needs_gravity and (motion1.gravity is None or motion2.gravity is None):
        raise InputError(f'solver {config.solver!r} needs gravity in both frames; use auto, '
                         'uniform_11pt or angular_5pt without it')
    problem = build_problem(points1, points2, camera, motion1, motion2, rotation,
                            rotation_covariance, mode.model.derotated)
    seed = np.array([np.random.default_rng(rng).integers(2**63)], dtype=np.uint64)
    pose = Estimation(problem, mode, config, order, seed, interval, inertial).run()
    if global_shutter_pixels and pose:
        times1, times2 = camera.row_times(points1[:, 1]), camera.row_times(points2[:, 1])
        seen = landmarks(pose, motion1.derotate(camera.unproject(points1), times1),
                         motion2.derotate(camera.unproject(points2), times2), times1, times2,
                         camera)
        pose = replace(pose, pixels1_gs=seen.pixels1, pixels2_gs=seen.pixels2)
    object.__setattr__(pose, 'duration', time.perf_counter() - started)
    return pose


class Estimation:
    """The steps of one estimate, in the order of `run` (docs/estimator.md).

    Parameters
    ----------
    order : (N,) ndarray of int64
        The order in which matches are sampled.
    seed : (1,) ndarray of uint64
        State of the random numbers.
    interval : float or None
        Seconds between the frames.
    """

    def __init__(self, problem: TwoViewProblem, mode: SolverMode, config: EstimatorConfig,
                 order: NDArray[np.int64], seed: NDArray[np.uint64],
                 interval: float | None, inertial: InertialMotion | None = None) -> None:
        self.problem, self.mode, self.config = problem, mode, config
        self.order = order[problem.valid[order]]
        self.seed = seed
        self.matches = Matches(problem.observations, problem.valid,
                               config.pixel_sigma / problem.focal)
        self.priors = _priors(problem, mode, config, interval)
        self.interval, self.inertial = interval, inertial
        # What the measured acceleration says of the velocities, and how far it is from none:
        # chi-square of six degrees of freedom.
        self.measured: VelocityPrior | None = None
        self.inertial_chi2 = 0.0
        self.iterations = 0
        self.deadline = (time.perf_counter() + config.time_limit if config.time_limit > 0.0
                         else math.inf)
        # Whether solvers were spared, since one before them explained enough.
        self.some_unasked = False

    def run(self) -> RelativePose:
        """The pose, or the reason why there is none."""
        if len(self.order) < self.config.min_inliers:
            return self._failure(Status.TOO_FEW_MATCHES,
                                 f'{len(self.order)} usable matches, fewer than min_inliers = '
                                 f'{self.config.min_inliers}')
        # 1. Hypotheses from minimal samples, ranked by multi-scale MSAC.
        return self.refine(self.sample())

    def refine(self, hypotheses: Solutions) -> RelativePose:
        """All steps after the first."""
        # 2. Local optimisation of each; the best in the cost of the full model.
        state = self._best(hypotheses)
        if self.some_unasked and (state is None or self._explained(state) <= EXPLAINED):
            # Angular hypotheses may explain matches by chance that the uniform model then loses.
            state = self._best(self.sample(enough=1.0))
        if state is None:
            return self._failure(Status.NO_CONSENSUS, 'no hypothesis explains the matches')
        # 3. Refinement on its inliers.
        refined = self._refined(state)
        reason = self._no_consensus(refined.inliers)
        if reason:
            return self._failure(Status.NO_CONSENSUS, reason)
        # 4. Is there a translation at all?
        turned = self._rotation_only(refined)
        if turned is not None:
            return turned
        # 5. Covariance at the optimum, then from the middle to the reference row.
        at_middle = pair_state(self.problem, refined.state, refined.log_scale,
                               refined.covariance)
        pose = to_reference_row(at_middle, self.problem.reference_row_time,
                                *self._turns_to_reference_row(refined.state))
        return self._result(pose, refined)

    def sample(self, enough: float = EXPLAINED) -> Solutions:
        """The best hypotheses, of solvers asked until one explains `enough` of the matches."""
        drawn = draw_hypotheses(self.problem, self.mode, self.config, self.order, self.seed,
                                enough, self.deadline)
        self.iterations += drawn.samples
        self.some_unasked = drawn.some_unasked
        return drawn.hypotheses

    def _best(self, hypotheses: Solutions) -> TwoViewState | None:
        config = self.config
        if not len(hypotheses.R):
            return None
        if config.refinement != 'map':
            # The paper's way: the best hypothesis as it is.
            return self._in_front(hypothesis_state(hypotheses.R[0], hypotheses.x[0]))
        state, found = optimise(self.matches, hypotheses, self.priors, config.pixel_sigma,
                                config.threshold)
        return state if found else None

    def _explained(self, state: TwoViewState) -> float:
        """Share of the matches that are inliers of the uniform model."""
        inliers = select_inliers(self.matches, state, self.config.threshold)
        return float(inliers.sum()) / len(self.order)

    def _in_front(self, state: TwoViewState) -> TwoViewState:
        """The state or its mirror image, whichever has more matches in front of the cameras."""
        errors = np.abs(residuals(self.matches.observations, state))
        near = (errors < self.config.threshold * SCALES[1]) & self.matches.valid
        return signed(state, cheirality_sign(self.matches.observations, near, state))

    def _refined(self, state: TwoViewState) -> Refined:
        config, matches = self.config, self.matches
        model = self.mode.model
        free = model.velocities or (model.derotated and config.refinement == 'map')
        if config.refinement == 'map':
            priors, scales = self.priors, TIMELESS if free else AT_ZERO
            if free and self.interval is not None:
                velocity, scales = velocities_expected(self.problem, config.motion, self.interval,
                                                       self.inertial)
                priors = with_velocity(priors, velocity)
                self.measured = None if self.inertial is None else velocity
                self.inertial_chi2 = float(
                    velocity.offset @ velocity.information @ velocity.offset)
            return fit_with_evidence(matches, state, priors,
                                     Noise(config.pixel_sigma, config.threshold), scales,
                                     self._gyro_error())
        inliers = select_inliers(matches, state, config.threshold)
        if config.refinement == 'alternating' and inliers.sum() >= 12:
            state = self._in_front(refine_alternating(
                matches.observations, inliers, state, config.pixel_sigma, free))
            inliers = select_inliers(matches, state, config.threshold)
        covariance = local_covariance(
            FitMatches(matches.observations, inliers.astype(float), config.pixel_sigma), state,
            self.priors)
        prior = self.priors.velocity
        return Refined(state, inliers, prior.log_scale, math.exp(-prior.log_scale),
                       config.pixel_sigma, covariance)

    def _gyro_error(self) -> Array:
        """Covariance (3, 3) of the gyro's rotation by errors s of the stamps, in frame 1.

        The gyro is integrated between instants that are off: ``s^2 (w_1 w_1^T + w_2 w_2^T)``, w_2
        turned into frame 1. Not in the prior, whose weight it would lower to the images' gain:
        on a recording with such stamps the poses did not get better (docs/estimator.md).
        """
        problem, sigma = self.problem, self.config.stamp_sigma
        if problem.rotation is None or sigma == 0.0:
            return np.zeros((3, 3))
        turned = np.column_stack([problem.motion1.angular_velocity,
                                  problem.rotation @ problem.motion2.angular_velocity])
        return np.asarray(sigma**2 * turned @ turned.T)

    def _no_consensus(self, inliers: Flags) -> str:
        """Why the matches that agree tell no pose; empty where they may."""
        config, observations = self.config, self.problem.observations
        cell = config.threshold / self.problem.focal   # [rad]
        count = min(distinct_directions(observations, inliers, f, cell) for f in RAYS)
        chance = self._inliers_by_chance()
        if count < max(config.min_inliers, chance):
            return (f'{count} distinct of {len(self.order)} matches agree, fewer than '
                    f'max(min_inliers = {config.min_inliers}, {chance} expected by chance)')
        if min(distance_from_a_plane(observations, inliers, f)
               for f in RAYS) < DEGENERATE_THRESHOLDS * cell:
            return f'the {count} matches that agree lie on one line: many poses explain them'
        return ''

    def _inliers_by_chance(self) -> int:
        """Inliers that the best of many fits reaches on random matches (about 5 sigma).

        Their share: ten thresholds by the focal length, as measured with matches drawn at random;
        velocities bend the bands, so that the best fit finds more in them than any one has.
        """
        expected = len(self.order) * min(
            10.0 * self.config.threshold / self.problem.focal, 0.5)
        return int(expected + 5.0 * np.sqrt(expected)) + self.mode.fitted_points

    def _rotation_only(self, refined: Refined) -> RelativePose | None:
        """The result without a translation, where none can be seen; None where one can.

        A rotation alone may absorb nearly all of the motion in front of a far plane, so it must
        explain the matches to within their noise, not to within some pixels.
        """
        problem, config = self.problem, self.config
        state, inliers, sigma = refined.state, refined.inliers, refined.sigma
        parallax = float(np.median(transfer_errors(
            problem.observations, inliers, np.ascontiguousarray(state.R), problem.focal)))
        # Not from the pose's own rotation: on a line of points that may be any.
        start = aligning_rotation(correlation(problem.observations, inliers, *RAYS))
        R, information = fit_rotation(
            problem.observations, inliers, start, self.priors, problem.focal, sigma)
        left = transfer_errors(problem.observations, inliers, R, problem.focal)
        median = float(np.median(left))
        turned_only = median < ROTATION_ONLY_SIGMAS * sigma
        if not turned_only and parallax >= config.min_parallax:
            return None
        reason = (f'a rotation alone leaves {median:.2f} px in the median, the noise of '
                  'the matches: no translation can be seen') if turned_only else (
                  f'median parallax of {parallax:.2f} px is below min_parallax = '
                  f'{config.min_parallax:g} px')
        # Turned back to the reference row; the translation takes no part.
        turn1, turn2 = self._turns_to_reference_row(
            state._replace(R=R, dw1=np.zeros(3), dw2=np.zeros(3)))
        covariance = np.full((6, 6), np.nan)
        # No rotation is less certain than half a turn: points in one place show only two angles.
        fitted = inverse(information + np.eye(3) / np.pi**2)
        of_gyro = fitted @ self.priors.rotation_information
        covariance[3:, 3:] = turn1.T @ (fitted + of_gyro @ self._gyro_error() @ of_gyro.T) @ turn1
        # The rates are the gyro's, and so is what is known of them.
        velocity_covariance = np.full((6, 6), np.nan)
        velocity_covariance[3:, 3:] = config.gyro_sigma**2 * np.eye(3)
        return RelativePose(
            status=Status.PURE_ROTATION if turned_only else Status.LOW_PARALLAX, reason=reason,
            R=turn1.T @ R @ turn2, covariance=covariance, inliers=inliers,
            images=rotation_information(
                R, information, self.priors.rotation_information,
                log_so3(R @ self.priors.rotation.T), -problem.reference_row_time),
            angular_velocity1=problem.motion1.angular_velocity,
            angular_velocity2=problem.motion2.angular_velocity,
            velocity_covariance=velocity_covariance, model='angular',
            iterations=self.iterations, residual_rms=float(np.sqrt(np.mean(left**2))))

    def _turns_to_reference_row(self, state: TwoViewState) -> tuple[Array, Array]:
        """How each camera turns from the middle row to the reference row, as corrected."""
        if not self.mode.model.derotated:
            return np.eye(3), np.eye(3)
        problem, delay = self.problem, self.problem.reference_row_time
        turn1 = problem.motion1.rotations([delay])[0]
        turn2 = problem.motion2.rotations([delay])[0]
        return (exp_so3(delay * state.dw1) @ turn1,
                exp_so3(delay * (state.R.T @ state.dw2)) @ turn2)

    def _result(self, pose: PairState, refined: Refined) -> RelativePose:
        # Of the two degrees of freedom of a direction, together.
        sigma = np.degrees(np.sqrt(max(np.trace(pose.covariance[:3, :3]), 0.0)))
        r = residuals(self.problem.observations, refined.state)[refined.inliers]
        v2w2 = np.r_[9:12, 15:18]
        baseline, baseline_sigma, reason = self._baseline(pose)
        images = self._images(refined)
        result = RelativePose(
            status=Status.OK, R=pose.R, t=pose.t, linear_velocity1=pose.v1,
            linear_velocity2=pose.v2, angular_velocity1=pose.w1, angular_velocity2=pose.w2,
            inliers=refined.inliers, covariance=pose.covariance[:6, :6],
            velocity_covariance=pose.covariance[np.ix_(v2w2, v2w2)], model=self.mode.model.name,
            velocity_sigma=refined.velocity_sigma,
            baseline=baseline, baseline_log_sigma=baseline_sigma, baseline_reason=reason,
            images=images, inertial_evidence=self._evidence(images),
            iterations=self.iterations, residual_rms=float(np.sqrt(np.mean(r**2))))
        limit = self.config.max_translation_sigma
        if sigma <= limit:
            return result
        return result.without_translation(
            Status.LOW_PARALLAX, f'the direction of translation is uncertain by {sigma:.3g} deg '
            f'(1 sigma), more than max_translation_sigma = {limit:g} deg')

    def _images(self, refined: Refined) -> ImageInformation | None:
        """What the images alone say; None of models that are not fitted to all unknowns."""
        if not self.mode.model.derotated:
            return None
        state, problem = refined.state, self.problem
        weights, sigma = noise_mixture(residuals(problem.observations, state), refined.inliers,
                                       self.config.pixel_sigma)
        return image_information(
            FitMatches(problem.observations, weights, sigma), state, self.priors,
            -problem.reference_row_time)

    def _evidence(self, images: ImageInformation | None) -> InertialEvidence | None:
        """Whether the images show the acceleration that was measured."""
        if images is None or self.measured is None or self.interval is None:
            return None
        return inertial_evidence(self.problem, images, self.config.motion, self.interval,
                                 self.measured)

    def _baseline(self, pose: PairState) -> tuple[float, float, str]:
        """Baseline [m] and 1 sigma of its logarithm; or NaN twice, and why."""
        if self.inertial is None:
            return math.nan, math.nan, ('baseline not known: no acceleration between the frames '
                                        'is given (inertial)')
        sigma = math.sqrt(max(pose.covariance[18, 18], 0.0))
        if self.inertial_chi2 < LEAST_ACCELERATION:
            return math.nan, math.nan, ('baseline not known: the acceleration between the frames '
                                        'is within its own errors')
        if not (self.mode.model.derotated and sigma <= MOST_LOG_SIGMA):
            return math.nan, math.nan, ('baseline not known: velocities that the images show '
                                        'and the acceleration leave it open')
        return math.exp(pose.log_baseline), sigma, ''

    def _failure(self, status: Status, reason: str) -> RelativePose:
        return RelativePose(status=status, reason=reason, model=self.mode.model.name,
                            iterations=self.iterations,
                            inliers=np.zeros(len(self.problem.valid), dtype=bool))


def _priors(problem: TwoViewProblem, mode: SolverMode, config: EstimatorConfig,
            interval: float | None) -> Priors:
    """What the IMU says of this pair; velocities as loose as hypotheses are compared with."""
    g1, g2 = problem.motion1.gravity, problem.motion2.gravity
    known = g1 is not None and g2 is not None
    free = mode.model.velocities or mode.model.derotated
    unit1 = g1 / np.linalg.norm(g1) if g1 is not None else np.zeros(3)
    unit2 = g2 / np.linalg.norm(g2) if g2 is not None else np.zeros(3)
    rotation = problem.rotation if problem.rotation is not None else np.eye(3)
    information = problem.rotation_information
    return Priors(
        unit1, unit2, config.gravity_sigma**-2 if known else 0.0,
        problem.reference_row_time, config.gyro_sigma**-2 if mode.model.derotated else PINNED,
        np.ascontiguousarray(rotation),
        np.ascontiguousarray(information) if information is not None else np.zeros((3, 3)),
        isotropic(SAMPLING_VELOCITY_SIGMA if free else PINNED**-0.5,
                  1.0 / interval if free and interval is not None else 0.0))
