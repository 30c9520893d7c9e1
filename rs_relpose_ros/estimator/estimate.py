"""One frame pair, end to end: derotate, sample, optimise, refine, covariance."""

from dataclasses import replace
import math
import time

import numpy as np

from rs_relpose_ros.config.settings import EstimatorConfig
from rs_relpose_ros.core.least_squares import inverse
from rs_relpose_ros.core.losses import noise_mixture
from rs_relpose_ros.errors import InputError
from rs_relpose_ros.estimator import (
    covariance,
    fit,
    frames_between,
    priors,
    sampling,
    sampson,
    velocity,
)
from rs_relpose_ros.estimator.pair_problem import PairProblem
from rs_relpose_ros.estimator.priors import Priors, TwoViewState, VelocityPrior
from rs_relpose_ros.estimator.problem import PARTS, to_reference_row
from rs_relpose_ros.estimator.result import (
    Diagnostics,
    GYRO_CONTRADICTION,
    landmarks,
    RelativePose,
    Status,
)
from rs_relpose_ros.estimator.sampling import SolverMode
from rs_relpose_ros.estimator.sampson import FitMatches, VIEW_1, VIEW_2
from rs_relpose_ros.estimator.velocity import Refined
from rs_relpose_ros.geometry import Array, so3
from rs_relpose_ros.geometry.matches import Matches
from rs_relpose_ros.solvers.common import Solutions

# Prior sigma of the velocities while hypotheses are compared [baselines per second]. With less,
# the hypothesis of a fast camera loses against a slow one; with more, velocities absorb outliers.
# [chosen: a baseline in a third of a second; the refinement chooses its own sigma]
SAMPLING_VELOCITY_SIGMA = 3.0
# Share of inliers at which the remaining solvers, with less prior knowledge, are skipped. With
# less, a wrong gyro could decide; with more, pairs with many outliers cost all solvers.
# [chosen: no other hypothesis can have as many inliers]
ENOUGH = 0.5
# Share of inliers at which the gyro's rotation with one direction of translation needs no other
# hypothesis. [chosen: between ENOUGH and the share of a clean pair]
CERTAIN = 0.75
# A rotation alone explains matches that it leaves within this many sigmas in the median: pairs
# below have no direction of translation. [derived: the noise of |f_1 - R f_2| is 1.67 sigma in the
# median (Rayleigh, two images), and a parallax of as much again is in doubt]
ROTATION_ONLY_SIGMAS = 2.5
# Least chi-square of the acceleration with which a baseline is given: pure noise has less in 99 %
# of pairs. [derived: quantile of 6 degrees of freedom]
LEAST_ACCELERATION = 16.8
# Largest 1 sigma of the logarithm of a baseline that is given. [chosen: a factor of e; users get
# the sigma, too]
MOST_LOG_SIGMA = 1.0
# Of matches within the threshold, half have implausible depths by chance: inliers must exceed the
# others by this many sigmas of a fair coin. [derived: one of 700 pairs of chance passes]
SIGN_SIGMAS = 3.0
# Log-likelihood that all matches may gain by a free rotation. Three unknowns gain above 13 in one
# of 100 000 pairs if residuals are independent; residuals of neighbours are similar (blur,
# stamps), as if a fifth of the matches were independent. [derived: docs/estimator.md]
CONTRADICTION = 65.0
# Points lie on a line if their root mean square distance from it is below this many thresholds:
# one threshold may be noise. [chosen: any value in 1.5..4 would do]
DEGENERATE_THRESHOLDS = 2.0
# Share of random matches that agree with the best of many fits, in thresholds by the focal length,
# and its bound: free velocities bend the epipolar bands, so that the best fit has more matches
# than a single one. [measured: fits to random matches]
CHANCE_SHARE = 10.0
# [chosen: half of the matches, for thresholds of a tenth of the focal length]
MOST_BY_CHANCE = 0.5
# Sigmas of that number beyond which agreement is no chance. [derived: one of a million pairs]
CHANCE_SIGMAS = 5.0
# Fewest inliers for the alternating refinement. [derived: 11 unknowns and one more]
LEAST_ALTERNATING = 12


def estimate(problem: PairProblem) -> RelativePose:
    """The pose of a pair, from two views and then from all frames.

    Raises InputError for a solver that needs gravity, without it.
    """
    started = time.perf_counter()
    has_frames = len(problem.motions) > 2 and problem.knows_rotation
    pose = frames_between.refined(Estimation(problem, is_start=has_frames).run(), problem)
    if has_frames and (reason := pose.diagnostics.frames_reason):
        pose = Estimation(problem).run().diagnosed(frames_reason=reason)
    pose = _certain(pose, problem.config)
    if problem.no_inertial:
        pose = pose.without_baseline(f'baseline not known: {problem.no_inertial}')
    return pose.diagnosed(duration=time.perf_counter() - started)


def evidence_for_inertial(
    pose: RelativePose, problem: PairProblem
) -> velocity.InertialEvidence | None:
    """Consistency of a pose's images with an acceleration that it was not estimated with."""
    interval = problem.interval
    if pose.images is None or interval is None:
        return None
    motion = problem.config.motion
    views = replace(problem, matches=Matches.none()).two_views()
    expected, _ = velocity.expected_velocities(views, motion, interval, problem.inertial[-1])
    return velocity.inertial_evidence(views, pose.images, motion, interval, expected)


def with_global_shutter_pixels(pose: RelativePose, problem: PairProblem) -> RelativePose:
    """The pose with the global-shutter pixels of its inliers."""
    camera = problem.camera
    rays = []
    row_times = []
    for image in (0, -1):
        points = problem.matches.points[image]
        tau = camera.pixel_times(points)
        rays.append(problem.motions[image].derotate(camera.unproject(points), tau))
        row_times.append(tau)
    found = landmarks(pose, np.stack(rays), np.stack(row_times), camera)
    return replace(pose, pixels1_gs=found.pixels1, pixels2_gs=found.pixels2)


def _certain(pose: RelativePose, config: EstimatorConfig) -> RelativePose:
    """The pose, or its rotation alone if the direction of t is too uncertain."""
    limit = config.max_translation_sigma
    # Of both degrees of freedom of a direction, together.
    variance = max(float(np.trace(pose.covariance[:3, :3])), 0.0)
    sigma = math.degrees(math.sqrt(variance))
    if not pose or sigma <= limit:
        return pose
    return pose.without_translation(
        Status.LOW_PARALLAX,
        f'the direction of translation is uncertain by {sigma:.3g} deg '
        f'(1 sigma), more than max_translation_sigma = {limit:g} deg',
    )


class Estimation:
    """The steps of one estimate, in the order of `run` (docs/estimator.md).

    Hypotheses from derotated rays (gyro rotation and 2 points, angular 3- and 5-point),
    multi-scale MSAC, local optimisation of the uniform model with a shrinking threshold, joint MAP
    fit with the scale of the velocities chosen by its evidence (with `inertial`: the baseline),
    sandwich covariance over image regions.
    """

    def __init__(self, pair: PairProblem, is_start: bool = False) -> None:
        """Prepare a pair; `is_start`: all frames will refine the pose and its covariance.

        Then one scale of the velocities is enough. [measured: 291 simulated pairs, the same
        errors of the poses from all frames as with the mean over four scales]
        """
        self.config = config = pair.config
        self._is_start = is_start
        self.mode = _mode(pair)
        self.problem = problem = pair.two_views(self.mode.model.derotated)
        # Usable matches, the best ones first: the sampling order.
        order = np.argsort(-pair.matches.quality, kind='stable')
        self.order = order[problem.valid[order]]
        self.seed = np.array([pair.seed], dtype=np.uint64)
        self.matches = FitMatches(
            problem.observations, problem.valid.astype(float), config.pixel_sigma, problem.focal
        )
        self.interval = pair.interval
        self.inertial = pair.inertial[-1]
        self.has_frames_between = len(pair.motions) > 2
        self.priors = self._sampling_priors()
        # Prior of the velocities by the measured acceleration, and the chi-square (6 degrees of
        # freedom) of that acceleration against zero.
        self.measured: VelocityPrior | None = None
        self.inertial_chi2 = 0.0
        self.iterations = 0
        limit = config.time_limit
        self.deadline = time.perf_counter() + limit if limit > 0.0 else math.inf
        # Whether solvers were skipped, since one before them had enough inliers.
        self.solvers_skipped = False
        # The state on its inliers, and the residuals (N,) of all matches at this state [px], after
        # step 3.
        self.refined: Refined
        self.residuals: Array

    def run(self) -> RelativePose:
        """The pose of two views, or the reason why there is none.

        With frames between, samples are drawn only if the gyro's rotation fails: all frames will
        refine the pose.
        """
        usable = len(self.order)
        least = self.config.min_inliers
        if usable < least:
            return self._failure(
                Status.TOO_FEW_MATCHES,
                f'{usable} usable matches, fewer than min_inliers = {least}',
            )
        if self.has_frames_between and (state := self._by_gyro()) is not None:
            return self._completed(state)
        # 1. Hypotheses from minimal samples, ranked by multi-scale MSAC.
        return self.refine(self.sample())

    def refine(self, hypotheses: Solutions) -> RelativePose:
        """All steps after the first."""
        # 2. Local optimisation of each; the best in the cost of the full model.
        state = self._best(hypotheses)
        if self.solvers_skipped and (state is None or self._share(state) <= ENOUGH):
            # Inliers of an angular hypothesis by chance are outliers of the uniform model.
            state = self._best(self.sample(enough=1.0))
        if state is None:
            return self._failure(
                Status.NO_CONSENSUS, 'no hypothesis is consistent with the matches'
            )
        return self._completed(state)

    def _share(self, state: TwoViewState) -> float:
        """Share of the matches that are inliers of a state."""
        inliers = sampson.select_inliers(self.matches, state, self.config.threshold)
        return float(inliers.sum()) / len(self.order)

    def _by_gyro(self) -> TwoViewState | None:
        """The state from the gyro's rotation, if it explains the matches."""
        R = self.problem.rotation
        if R is None or self.config.solver != 'auto' or self.config.refinement != 'map':
            return None
        valid = self.problem.observations[self.problem.valid]
        t = sampling.translation_direction(valid, R)
        expected = self.priors.velocity.rate * t
        x = np.concatenate([t, expected, expected])
        only = Solutions(np.ascontiguousarray(R)[None], x[None])
        state = self._best(only)
        return state if state is not None and self._share(state) > CERTAIN else None

    def _completed(self, state: TwoViewState) -> RelativePose:
        """Steps 3 to 5, from the best state."""
        # 3. Refinement on its inliers.
        self.refined = self._refined(state)
        self.residuals = sampson.residuals(self.matches.observations, self.refined.state)
        if reason := self._no_consensus():
            return self._failure(Status.NO_CONSENSUS, reason)
        if reason := self._contradiction():
            return self._failure(Status.NO_CONSENSUS, reason, rejected=self._result())
        # 4. Is the translation observable?
        rotation_only = self._rotation_only()
        if rotation_only is not None:
            return rotation_only
        # 5. Covariance at the optimum, then from the middle to the reference row.
        pose = self._result()
        if reason := self._sign_by_chance():
            return pose.without_translation(Status.LOW_PARALLAX, reason)
        return pose

    def _sign_by_chance(self) -> str:
        """Reason why the matches do not determine the sign of t; empty if they do."""
        if self.config.refinement != 'map':
            return ''
        inliers = self.refined.inliers
        count = np.count_nonzero(inliers)
        others = np.count_nonzero(np.abs(self.residuals[~inliers]) < self.config.threshold)
        if count - others >= SIGN_SIGMAS * math.sqrt(count + others):
            return ''
        return (
            f'{others} of {count + others} matches on their epipolar lines lie behind the '
            'cameras or far from the others, nearly as many as by chance'
        )

    def sample(self, enough: float = ENOUGH) -> Solutions:
        """The best hypotheses, by one solver after another until the inlier share is `enough`."""
        hypotheses, samples, self.solvers_skipped = sampling.draw_hypotheses(
            self.problem, self.mode, self.config, self.order, self.seed, enough, self.deadline
        )
        self.iterations += samples
        return hypotheses

    def _best(self, hypotheses: Solutions) -> TwoViewState | None:
        config = self.config
        if not len(hypotheses.R):
            return None
        if config.refinement != 'map':
            # As in the paper: the best hypothesis, unchanged.
            return self._in_front(priors.hypothesis_state(hypotheses.R[0], hypotheses.x[0]))
        state, found = sampling.optimise(self.matches, hypotheses, self.priors, config.threshold)
        return state if found else None

    def _in_front(self, state: TwoViewState) -> TwoViewState:
        """The state or its mirror image, whichever has more matches in front of the cameras."""
        observations = self.matches.observations
        residuals = np.abs(sampson.residuals(observations, state))
        inliers = (residuals < self.config.threshold * sampling.SCALES[1]) & self.problem.valid
        return priors.signed(state, sampson.cheirality_sign(observations, inliers, state))

    def _refined(self, state: TwoViewState) -> Refined:
        """The state on its inliers, by the refinement of the parameters."""
        config = self.config
        matches = self.matches
        model = self.mode.model
        if config.refinement == 'map':
            prior, scales = self._velocities(model.velocities or model.derotated)
            return velocity.fit_with_evidence(
                matches, state, prior, config.threshold, scales, self._gyro_error()
            )
        inliers = sampson.select_inliers(matches, state, config.threshold)
        if config.refinement == 'alternating' and inliers.sum() >= LEAST_ALTERNATING:
            used = matches._replace(weights=inliers.astype(float))
            state = self._in_front(fit.refine_alternating(used, state, model.velocities))
            inliers = sampson.select_inliers(matches, state, config.threshold)
        used = matches._replace(weights=inliers.astype(float))
        log_scale = self.priors.velocity.log_scale
        return Refined(
            state,
            inliers,
            log_scale,
            math.exp(-log_scale),
            config.pixel_sigma,
            covariance.local_covariance(used, state, self.priors),
        )

    def _velocities(self, free: bool) -> tuple[Priors, velocity.Scales]:
        """Priors with the velocities that time, carrier and accelerometer let expect."""
        if not free:
            return self.priors, velocity.AT_ZERO
        if self.interval is None:
            return self.priors, velocity.TIMELESS
        expected, scales = velocity.expected_velocities(
            self.problem, self.config.motion, self.interval, self.inertial
        )
        if self._is_start:
            scales = scales.nearest(self.priors.velocity.log_scale)
        if self.inertial is not None:
            self.measured = expected
        offset = expected.offset
        self.inertial_chi2 = float(offset @ expected.information @ offset)
        return self.priors._replace(velocity=expected), scales

    def _gyro_error(self) -> Array:
        """Covariance (3, 3) of the gyro's rotation by errors s of the stamps, in frame 1.

        The integration limits are in error: ``s^2 (w_1 w_1^T + w_2 w_2^T)``, w_2 rotated into
        frame 1. It is no part of the prior: with the lower weight, the poses of a recording with
        such stamps were not more accurate (docs/estimator.md).
        """
        problem = self.problem
        sigma = self.config.stamp_sigma
        if problem.rotation is None or sigma == 0.0:
            return np.zeros((3, 3))
        rate1 = problem.motion1.angular_velocity
        rate2 = problem.rotation @ problem.motion2.angular_velocity
        rates = np.column_stack([rate1, rate2])
        return np.asarray(sigma**2 * rates @ rates.T)

    def _no_consensus(self) -> str:
        """Reason why the inliers determine no pose; empty if they may."""
        config = self.config
        observations = self.matches.observations
        inliers = self.refined.inliers
        total = len(self.order)
        cell = config.threshold / self.matches.focal  # [rad]
        rays = (VIEW_1, VIEW_2)
        count = min(sampling.distinct_directions(observations, inliers, ray, cell) for ray in rays)
        expected = total * min(CHANCE_SHARE * cell, MOST_BY_CHANCE)
        most = int(expected + CHANCE_SIGMAS * np.sqrt(expected))
        chance = most + self.mode.fitted_points
        if count < max(config.min_inliers, chance):
            return (
                f'{count} distinct of {total} matches agree, fewer than '
                f'max(min_inliers = {config.min_inliers}, {chance} expected by chance)'
            )
        spread = min(sampling.distance_from_a_plane(observations, inliers, ray) for ray in rays)
        if spread < DEGENERATE_THRESHOLDS * cell:
            return f'the {count} matches that agree lie on one line: the pose is not observable'
        return ''

    def _contradiction(self) -> str:
        """Reason why images and gyro cannot both be right; empty if they may."""
        problem = self.problem
        if self.config.refinement != 'map' or problem.rotation is None:
            return ''
        state = self.refined.state
        gain, R = sampling.gain_without_gyro(self.matches, state, self.priors)
        if gain < CONTRADICTION:
            return ''
        apart = np.degrees(np.linalg.norm(so3.log_so3(R @ state.R.T)))
        return (
            f'{GYRO_CONTRADICTION}: a rotation {apart:.1f} deg from the '
            f"gyro's fits the matches better (log-likelihood +{gain:.0f})"
        )

    def _rotation_only(self) -> RelativePose | None:
        """The result without a translation if none is observable, otherwise None.

        In front of a far plane a rotation alone may absorb nearly all of the motion, so it must
        fit the matches to within their noise, not to within some pixels.
        """
        focal = self.matches.focal
        observations = self.matches.observations
        inliers = self.refined.inliers
        sigma = self.refined.sigma
        R = np.ascontiguousarray(self.refined.state.R)
        parallax = so3.median(fit.transfer_errors(observations, inliers, R, focal))
        # Not from the rotation of the pose, which is arbitrary for points on a line.
        of_rays = sampling.correlation(observations, inliers, VIEW_1, VIEW_2)
        start = so3.aligning_rotation(of_rays)
        R, information = fit.fit_rotation(observations, inliers, start, self.priors, focal, sigma)
        residuals = fit.transfer_errors(observations, inliers, R, focal)
        median = so3.median(residuals.copy())
        least = self.config.min_parallax
        if median < ROTATION_ONLY_SIGMAS * sigma:
            status = Status.PURE_ROTATION
            reason = (
                f'a rotation alone leaves {median:.2f} px in the median, the noise of '
                'the matches: the translation is not observable'
            )
        elif parallax < least:
            status = Status.LOW_PARALLAX
            reason = f'median parallax of {parallax:.2f} px is below min_parallax = {least:g} px'
        else:
            return None
        pose = self._rotation(R, information)
        rms = float(np.sqrt(np.mean(residuals**2)))
        return replace(pose, status=status, reason=reason).diagnosed(residual_rms=rms)

    def _rotation(self, R: Array, information: Array) -> RelativePose:
        """The result of a rotation (3, 3) between the middle rows, with its information (3, 3)."""
        problem = self.problem
        # Back to the reference row, without the translation.
        turn1, turn2 = self._rotations_to_reference_row(
            self.refined.state._replace(R=R, dw1=np.zeros(3), dw2=np.zeros(3))
        )
        # No rotation has a sigma above half a turn: points in one place determine two angles only.
        fitted = inverse(information + np.eye(3) / np.pi**2)
        by_gyro = fitted @ self.priors.rotation_information
        spread = fitted + by_gyro @ self._gyro_error() @ by_gyro.T
        of_pose = np.full((6, 6), np.nan)
        of_pose[3:, 3:] = turn1.T @ spread @ turn1
        # The rates and their covariance are the gyro's.
        of_velocity = np.full((6, 6), np.nan)
        of_velocity[3:, 3:] = self.config.gyro_sigma**2 * np.eye(3)
        images = covariance.rotation_information(
            R,
            information,
            self.priors.rotation_information,
            so3.log_so3(R @ self.priors.rotation.T),
            -problem.reference_row_time,
        )
        return RelativePose(
            Status.PURE_ROTATION,
            R=turn1.T @ R @ turn2,
            covariance=of_pose,
            inliers=self.refined.inliers,
            images=images,
            angular_velocity1=problem.motion1.angular_velocity,
            angular_velocity2=problem.motion2.angular_velocity,
            velocity_covariance=of_velocity,
            diagnostics=Diagnostics(model='angular', iterations=self.iterations),
        )

    def _rotations_to_reference_row(self, state: TwoViewState) -> tuple[Array, Array]:
        """Rotation of each camera from the middle row to the reference row, as corrected."""
        if not self.mode.model.derotated:
            return np.eye(3), np.eye(3)
        problem = self.problem
        delay = problem.reference_row_time
        turn1 = problem.motion1.rotations([delay])[0]
        turn2 = problem.motion2.rotations([delay])[0]
        dw2 = state.R.T @ state.dw2
        return so3.exp_so3(delay * state.dw1) @ turn1, so3.exp_so3(delay * dw2) @ turn2

    def _result(self) -> RelativePose:
        """The refined state as a pose between the reference rows."""
        problem = self.problem
        refined = self.refined
        at_middle = covariance.pair_state(
            problem, refined.state, refined.log_scale, refined.covariance
        )
        turns = self._rotations_to_reference_row(refined.state)
        pose = to_reference_row(at_middle, problem.reference_row_time, *turns)
        rms = np.sqrt(np.mean(self.residuals[refined.inliers] ** 2))
        images = self._images()
        sigma = math.sqrt(max(pose.covariance[-1, -1], 0.0))
        no_baseline = self._no_baseline(sigma)
        of_second = np.r_[PARTS['v2'], PARTS['w2']]
        return RelativePose(
            status=Status.OK,
            R=pose.R,
            t=pose.t,
            covariance=pose.covariance[:6, :6],
            linear_velocity1=pose.v1,
            linear_velocity2=pose.v2,
            angular_velocity1=pose.w1,
            angular_velocity2=pose.w2,
            velocity_covariance=pose.covariance[np.ix_(of_second, of_second)],
            baseline=math.nan if no_baseline else math.exp(pose.log_baseline),
            baseline_log_sigma=math.nan if no_baseline else sigma,
            inliers=refined.inliers,
            images=images,
            diagnostics=Diagnostics(
                model=self.mode.model.name,
                iterations=self.iterations,
                residual_rms=float(rms),
                pixel_sigma=refined.sigma,
                velocity_sigma=refined.velocity_sigma,
                baseline_reason=no_baseline,
                inertial_evidence=self._evidence(images),
            ),
        )

    def _images(self) -> covariance.ImageInformation | None:
        """Information of the images alone; None for models without all unknowns."""
        if not self.mode.model.derotated:
            return None
        weights, sigma = noise_mixture(
            self.residuals, self.refined.inliers, self.config.pixel_sigma
        )
        matches = self.matches._replace(weights=weights, sigma=sigma)
        row_time = -self.problem.reference_row_time
        return covariance.image_information(matches, self.refined.state, self.priors, row_time)

    def _evidence(
        self, images: covariance.ImageInformation | None
    ) -> velocity.InertialEvidence | None:
        """Whether the images are consistent with the measured acceleration."""
        if images is None or self.measured is None or self.interval is None:
            return None
        return velocity.inertial_evidence(
            self.problem, images, self.config.motion, self.interval, self.measured
        )

    def _no_baseline(self, sigma: float) -> str:
        """Why the baseline is not known, empty if it is; `sigma`: of its logarithm."""
        if self.inertial is None:
            return 'baseline not known: no acceleration between the frames is given (inertial)'
        if self.inertial_chi2 < LEAST_ACCELERATION:
            return (
                'baseline not known: the acceleration between the frames is within its own errors'
            )
        if not (self.mode.model.derotated and sigma <= MOST_LOG_SIGMA):
            return (
                'baseline not known: not observable from the velocities '
                'in the images and the acceleration'
            )
        return ''

    def _failure(
        self, status: Status, reason: str, rejected: RelativePose | None = None
    ) -> RelativePose:
        return RelativePose(
            status=status,
            reason=reason,
            inliers=np.zeros(len(self.problem.valid), dtype=bool),
            diagnostics=Diagnostics(
                model=self.mode.model.name, iterations=self.iterations, rejected=rejected
            ),
        )

    def _sampling_priors(self) -> Priors:
        """Priors of the IMU; velocities with the wide prior of the comparison of hypotheses."""
        problem = self.problem
        config = self.config
        model = self.mode.model
        directions = []
        for gravity in (problem.motion1.gravity, problem.motion2.gravity):
            if gravity is not None:
                directions.append(gravity / np.linalg.norm(gravity))
        known = len(directions) == 2
        gravity1, gravity2 = directions if known else np.zeros((2, 3))
        rotation = np.eye(3) if problem.rotation is None else problem.rotation
        information = problem.rotation_information
        if information is None:
            information = np.zeros((3, 3))
        free = model.velocities or model.derotated
        rate = 1.0 / self.interval if free and self.interval is not None else 0.0
        sigma = SAMPLING_VELOCITY_SIGMA if free else priors.PINNED**-0.5
        return Priors(
            gravity1,
            gravity2,
            config.gravity_sigma**-2 if known else 0.0,
            problem.reference_row_time,
            config.gyro_sigma**-2 if model.derotated else priors.PINNED,
            np.ascontiguousarray(rotation),
            np.ascontiguousarray(information),
            priors.isotropic(sigma, rate),
        )


def _mode(pair: PairProblem) -> SolverMode:
    """Mode of the solver; it may need gravity."""
    name = pair.config.solver
    mode = sampling.MODES[name]
    first = pair.motions[0]
    last = pair.motions[-1]
    if mode.needs_gravity and (first.gravity is None or last.gravity is None):
        raise InputError(
            f'solver {name!r} requires gravity in both frames; without it, '
            'use auto, uniform_11pt or angular_5pt'
        )
    return mode
