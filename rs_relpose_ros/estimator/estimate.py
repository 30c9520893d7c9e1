"""One frame pair, end to end: derotate, sample, optimise, refine, covariance."""

from dataclasses import replace
import math
import time

import numpy as np

from rs_relpose_ros.config.settings import EstimatorConfig
from rs_relpose_ros.core.least_squares import inverse
from rs_relpose_ros.core.losses import Flags, noise_mixture
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
from rs_relpose_ros.estimator.problem import to_reference_row, TwoViewProblem
from rs_relpose_ros.estimator.result import Diagnostics, landmarks, RelativePose, Status
from rs_relpose_ros.estimator.sampling import SolverMode
from rs_relpose_ros.estimator.sampson import RayMatches
from rs_relpose_ros.estimator.velocity import Refined
from rs_relpose_ros.geometry import Array, so3
from rs_relpose_ros.solvers.common import Solutions

# Prior sigma of the velocities while hypotheses are compared [baselines per second].
SAMPLING_VELOCITY_SIGMA = 3.0
# Share of inliers at which the remaining solvers, with less prior knowledge, are skipped.
ENOUGH = 0.5
# And at which the gyro's rotation with one direction of translation needs no other hypothesis.
CERTAIN = 0.75
# First columns of the rays f_1 and f_2 in an observation.
RAYS = (0, 9)
# Noise of |f_1 - R f_2| is 1.67 sigma in the median (Rayleigh, two images).
ROTATION_ONLY_SIGMAS = 2.5
# Least chi-square of the acceleration (6 degrees of freedom; 99 % of pure noise lie below) and
# largest 1 sigma of the logarithm of the baseline with which a baseline is given.
LEAST_ACCELERATION = 16.8
MOST_LOG_SIGMA = 1.0
# Of matches within the threshold, half have implausible depths by chance: inliers must exceed the
# others by this many sigmas of that.
SIGN_SIGMAS = 3.0
# Log-likelihood that all matches may gain by a free rotation. Three unknowns gain above 13 in one
# of 100 000 pairs if residuals are independent; those of neighbours are similar (blur, stamps), as
# if a fifth of the matches were (docs/estimator.md).
CONTRADICTION = 65.0
# Points lie on a line if their root mean square distance from it is below this many thresholds.
DEGENERATE_THRESHOLDS = 2.0


def estimate(problem: PairProblem) -> RelativePose:
    """The pose of a pair, from two views and then from all frames.

    Raises InputError for a solver that needs gravity, without it.
    """
    started = time.perf_counter()
    pose = frames_between.refined(Estimation(problem).run(), problem)
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
    views = problem.without_matches().two_views()
    expected, _ = velocity.expected_velocities(
        views,
        motion,
        interval,
        problem.inertial[-1],
    )
    return velocity.inertial_evidence(
        views,
        pose.images,
        motion,
        interval,
        expected,
    )


def with_global_shutter_pixels(pose: RelativePose, problem: PairProblem) -> RelativePose:
    """The pose with the global-shutter pixels of its inliers."""
    camera = problem.camera
    matches = problem.matches
    rays = []
    times = []
    for points, motion in (
        (matches.points1, problem.motions[0]),
        (matches.points2, problem.motions[-1]),
    ):
        times.append(camera.row_times(points[:, 1]))
        rays.append(motion.derotate(camera.unproject(points), times[-1]))
    found = landmarks(
        pose,
        np.stack(rays),
        np.stack(times),
        camera,
    )
    return replace(pose, pixels1_gs=found.pixels1, pixels2_gs=found.pixels2)


def _certain(pose: RelativePose, config: EstimatorConfig) -> RelativePose:
    """The pose, or its rotation alone if the direction of t is too uncertain."""
    limit = config.max_translation_sigma
    # Of both degrees of freedom of a direction, together.
    variance = max(np.trace(pose.covariance[:3, :3]), 0.0)
    sigma = np.degrees(np.sqrt(variance))
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

    def __init__(self, pair: PairProblem) -> None:
        self.config = config = pair.config
        self.mode = _mode(pair)
        self.problem = problem = pair.two_views(self.mode.model.derotated)
        # Usable matches, the best ones first: the sampling order.
        order = np.argsort(-pair.matches.quality, kind='stable')
        self.order = order[problem.valid[order]]
        self.seed = np.array([pair.seed], dtype=np.uint64)
        self.matches = RayMatches(
            problem.observations, problem.valid, config.pixel_sigma / problem.focal
        )
        self.interval = pair.interval
        self.inertial = pair.inertial[-1]
        self.has_frames_between = len(pair.motions) > 2
        self.priors = _priors(
            problem,
            self.mode,
            config,
            self.interval,
        )
        # Prior of the velocities by the measured acceleration, and the chi-square (6 degrees of
        # freedom) of that acceleration against zero.
        self.measured: VelocityPrior | None = None
        self.inertial_chi2 = 0.0
        self.iterations = 0
        limit = config.time_limit
        self.deadline = time.perf_counter() + limit if limit > 0.0 else math.inf
        # Whether solvers were skipped, since one before them had enough inliers.
        self.solvers_skipped = False

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
        return float(
            sampson.select_inliers(self.matches, state, self.config.threshold).sum()
        ) / len(self.order)

    def _by_gyro(self) -> TwoViewState | None:
        """The state from the gyro's rotation, if it explains the matches."""
        R = self.problem.rotation
        if R is None or self.config.solver != 'auto' or self.config.refinement != 'map':
            return None
        t = sampling.translation_direction(self.problem.observations[self.problem.valid], R)
        velocity = self.priors.velocity.rate * t
        state = self._best(
            Solutions(np.ascontiguousarray(R)[None], np.concatenate([t, velocity, velocity])[None])
        )
        return state if state is not None and self._share(state) > CERTAIN else None

    def _completed(self, state: TwoViewState) -> RelativePose:
        """Steps 3 to 5, from the best state."""
        # 3. Refinement on its inliers.
        refined = self._refined(state)
        if reason := self._no_consensus(refined.inliers):
            return self._failure(Status.NO_CONSENSUS, reason)
        if reason := self._contradiction(refined.state):
            return self._failure(Status.NO_CONSENSUS, reason, rejected=self._result(refined))
        # 4. Is the translation observable?
        rotation_only = self._rotation_only(refined)
        if rotation_only is not None:
            return rotation_only
        # 5. Covariance at the optimum, then from the middle to the reference row.
        pose = self._result(refined)
        near = np.abs(sampson.residuals(self.problem.observations, refined.state))
        implausible = (near < self.config.threshold) & ~refined.inliers
        count = np.count_nonzero(refined.inliers)
        others = np.count_nonzero(implausible)
        if self.config.refinement == 'map' and (
            count - others < SIGN_SIGMAS * math.sqrt(count + others)
        ):
            return pose.without_translation(
                Status.LOW_PARALLAX,
                (
                    f'{others} of {count + others} matches on their epipolar lines lie behind the '
                    'cameras or far from the others, nearly as many as by chance'
                ),
            )
        return pose

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
        state, found = sampling.optimise(
            self.matches, hypotheses, self.priors, config.pixel_sigma, config.threshold
        )
        return state if found else None

    def _in_front(self, state: TwoViewState) -> TwoViewState:
        """The state or its mirror image, whichever has more matches in front of the cameras."""
        errors = np.abs(sampson.residuals(self.matches.observations, state))
        near = (errors < self.config.threshold * sampling.SCALES[1]) & self.matches.valid
        sign = sampson.cheirality_sign(self.matches.observations, near, state)
        return priors.signed(state, sign)

    def _refined(self, state: TwoViewState) -> Refined:
        config = self.config
        matches = self.matches
        model = self.mode.model
        free = model.velocities or (model.derotated and config.refinement == 'map')
        if config.refinement == 'map':
            prior = self.priors
            scales = velocity.TIMELESS if free else velocity.AT_ZERO
            if free and self.interval is not None:
                expected, scales = velocity.expected_velocities(
                    self.problem, config.motion, self.interval, self.inertial
                )
                prior = priors.with_velocity(prior, expected)
                self.measured = None if self.inertial is None else expected
                self.inertial_chi2 = float(
                    expected.offset @ expected.information @ expected.offset
                )
            return velocity.fit_with_evidence(
                matches,
                state,
                prior,
                config.pixel_sigma,
                config.threshold,
                scales,
                self._gyro_error(),
            )
        inliers = sampson.select_inliers(matches, state, config.threshold)
        if config.refinement == 'alternating' and inliers.sum() >= 12:
            used = fit.FitMatches(matches.observations, inliers.astype(float), config.pixel_sigma)
            state = self._in_front(fit.refine_alternating(used, state, free))
            inliers = sampson.select_inliers(matches, state, config.threshold)
        used = fit.FitMatches(matches.observations, inliers.astype(float), config.pixel_sigma)
        log_scale = self.priors.velocity.log_scale
        return Refined(
            state,
            inliers,
            log_scale,
            math.exp(-log_scale),
            config.pixel_sigma,
            covariance.local_covariance(used, state, self.priors),
        )

    def _gyro_error(self) -> Array:
        """Covariance (3, 3) of the gyro's rotation by errors s of the stamps, in frame 1.

        The integration limits are in error: ``s^2 (w_1 w_1^T + w_2 w_2^T)``, w_2 rotated into
        frame 1. Not part of the prior: with the lower weight, the poses of a recording with such
        stamps were not more accurate (docs/estimator.md).
        """
        problem = self.problem
        sigma = self.config.stamp_sigma
        if problem.rotation is None or sigma == 0.0:
            return np.zeros((3, 3))
        rates = np.column_stack(
            [problem.motion1.angular_velocity, problem.rotation @ problem.motion2.angular_velocity]
        )
        return np.asarray(sigma**2 * rates @ rates.T)

    def _no_consensus(self, inliers: Flags) -> str:
        """Reason why the inliers determine no pose; empty if they may."""
        config = self.config
        observations = self.problem.observations
        cell = config.threshold / self.problem.focal  # [rad]
        count = min(
            sampling.distinct_directions(
                observations,
                inliers,
                f,
                cell,
            )
            for f in RAYS
        )
        # Inliers of the best of many fits to random matches (about 5 sigma). Their share, ten
        # thresholds by the focal length, was measured: free velocities bend the epipolar bands, so
        # that the best fit has more than a single one.
        expected = len(self.order) * min(10.0 * config.threshold / self.problem.focal, 0.5)
        chance = int(expected + 5.0 * np.sqrt(expected)) + self.mode.fitted_points
        if count < max(config.min_inliers, chance):
            return (
                f'{count} distinct of {len(self.order)} matches agree, fewer than '
                f'max(min_inliers = {config.min_inliers}, {chance} expected by chance)'
            )
        if (
            min(sampling.distance_from_a_plane(observations, inliers, f) for f in RAYS)
            < DEGENERATE_THRESHOLDS * cell
        ):
            return f'the {count} matches that agree lie on one line: the pose is not observable'
        return ''

    def _contradiction(self, state: TwoViewState) -> str:
        """Reason why images and gyro cannot both be right; empty if they may."""
        if self.config.refinement != 'map' or self.problem.rotation is None:
            return ''
        gain, R = sampling.gain_without_gyro(
            self.matches,
            state,
            self.priors,
            self.problem.focal,
        )
        if gain < CONTRADICTION:
            return ''
        apart = np.degrees(np.linalg.norm(so3.log_so3(R @ state.R.T)))
        return (
            f'images and gyro contradict each other: a rotation {apart:.1f} deg from the '
            f"gyro's fits the matches better (log-likelihood +{gain:.0f})"
        )

    def _rotation_only(self, refined: Refined) -> RelativePose | None:
        """The result without a translation if none is observable, otherwise None.

        In front of a far plane a rotation alone may absorb nearly all of the motion, so it must
        fit the matches to within their noise, not to within some pixels.
        """
        problem = self.problem
        config = self.config
        state = refined.state
        inliers = refined.inliers
        sigma = refined.sigma
        parallax = so3.median(
            fit.transfer_errors(
                problem.observations, inliers, np.ascontiguousarray(state.R), problem.focal
            )
        )
        # Not from the rotation of the pose, which is arbitrary for points on a line.
        start = so3.aligning_rotation(sampling.correlation(problem.observations, inliers, *RAYS))
        R, information = fit.fit_rotation(
            problem.observations, inliers, start, self.priors, problem.focal, sigma
        )
        left = fit.transfer_errors(
            problem.observations,
            inliers,
            R,
            problem.focal,
        )
        median = so3.median(left.copy())
        pure_rotation = median < ROTATION_ONLY_SIGMAS * sigma
        if not pure_rotation and parallax >= config.min_parallax:
            return None
        reason = (
            (
                f'a rotation alone leaves {median:.2f} px in the median, the noise of '
                'the matches: the translation is not observable'
            )
            if pure_rotation
            else (
                f'median parallax of {parallax:.2f} px is below min_parallax = '
                f'{config.min_parallax:g} px'
            )
        )
        # Back to the reference row, without the translation.
        turn1, turn2 = self._rotations_to_reference_row(
            state._replace(R=R, dw1=np.zeros(3), dw2=np.zeros(3))
        )
        of_pose = np.full((6, 6), np.nan)
        # No rotation has a sigma above half a turn: points in one place determine two angles only.
        fitted = inverse(information + np.eye(3) / np.pi**2)
        of_gyro = fitted @ self.priors.rotation_information
        of_pose[3:, 3:] = turn1.T @ (fitted + of_gyro @ self._gyro_error() @ of_gyro.T) @ turn1
        # The rates and their covariance are the gyro's.
        velocity_covariance = np.full((6, 6), np.nan)
        velocity_covariance[3:, 3:] = config.gyro_sigma**2 * np.eye(3)
        return RelativePose(
            status=Status.PURE_ROTATION if pure_rotation else Status.LOW_PARALLAX,
            reason=reason,
            R=turn1.T @ R @ turn2,
            covariance=of_pose,
            inliers=inliers,
            images=covariance.rotation_information(
                R,
                information,
                self.priors.rotation_information,
                so3.log_so3(R @ self.priors.rotation.T),
                -problem.reference_row_time,
            ),
            angular_velocity1=problem.motion1.angular_velocity,
            angular_velocity2=problem.motion2.angular_velocity,
            velocity_covariance=velocity_covariance,
            diagnostics=Diagnostics(
                model='angular',
                iterations=self.iterations,
                residual_rms=float(np.sqrt(np.mean(left**2))),
            ),
        )

    def _rotations_to_reference_row(self, state: TwoViewState) -> tuple[Array, Array]:
        """Rotation of each camera from the middle row to the reference row, as corrected."""
        if not self.mode.model.derotated:
            return np.eye(3), np.eye(3)
        problem = self.problem
        delay = self.problem.reference_row_time
        turn1 = problem.motion1.rotations([delay])[0]
        turn2 = problem.motion2.rotations([delay])[0]
        return (
            so3.exp_so3(delay * state.dw1) @ turn1,
            so3.exp_so3(delay * (state.R.T @ state.dw2)) @ turn2,
        )

    def _result(self, refined: Refined) -> RelativePose:
        at_middle = covariance.pair_state(
            self.problem, refined.state, refined.log_scale, refined.covariance
        )
        pose = to_reference_row(
            at_middle,
            self.problem.reference_row_time,
            *self._rotations_to_reference_row(refined.state),
        )
        r = sampson.residuals(self.problem.observations, refined.state)[refined.inliers]
        v2w2 = np.r_[9:12, 15:18]
        baseline, baseline_sigma, reason = self._baseline(
            pose.log_baseline, pose.covariance[18, 18]
        )
        images = self._images(refined)
        return RelativePose(
            status=Status.OK,
            R=pose.R,
            t=pose.t,
            linear_velocity1=pose.v1,
            linear_velocity2=pose.v2,
            angular_velocity1=pose.w1,
            angular_velocity2=pose.w2,
            inliers=refined.inliers,
            covariance=pose.covariance[:6, :6],
            velocity_covariance=pose.covariance[np.ix_(v2w2, v2w2)],
            baseline=baseline,
            baseline_log_sigma=baseline_sigma,
            images=images,
            diagnostics=Diagnostics(
                model=self.mode.model.name,
                iterations=self.iterations,
                residual_rms=float(np.sqrt(np.mean(r**2))),
                pixel_sigma=refined.sigma,
                velocity_sigma=refined.velocity_sigma,
                baseline_reason=reason,
                inertial_evidence=self._evidence(images),
            ),
        )

    def _images(self, refined: Refined) -> covariance.ImageInformation | None:
        """Information of the images alone; None for models without all unknowns."""
        if not self.mode.model.derotated:
            return None
        state = refined.state
        observations = self.problem.observations
        weights, sigma = noise_mixture(
            sampson.residuals(observations, state), refined.inliers, self.config.pixel_sigma
        )
        return covariance.image_information(
            fit.FitMatches(observations, weights, sigma),
            state,
            self.priors,
            -self.problem.reference_row_time,
        )

    def _evidence(
        self,
        images: covariance.ImageInformation | None,
    ) -> velocity.InertialEvidence | None:
        """Whether the images are consistent with the measured acceleration."""
        if images is None or self.measured is None or self.interval is None:
            return None
        return velocity.inertial_evidence(
            self.problem, images, self.config.motion, self.interval, self.measured
        )

    def _baseline(self, log_baseline: float, variance: float) -> tuple[float, float, str]:
        """Baseline [m] and 1 sigma of its logarithm; or NaN twice and the reason."""
        if self.inertial is None:
            return (
                math.nan,
                math.nan,
                ('baseline not known: no acceleration between the frames is given (inertial)'),
            )
        sigma = math.sqrt(max(variance, 0.0))
        if self.inertial_chi2 < LEAST_ACCELERATION:
            return (
                math.nan,
                math.nan,
                (
                    'baseline not known: the acceleration between the frames '
                    'is within its own errors'
                ),
            )
        if not (self.mode.model.derotated and sigma <= MOST_LOG_SIGMA):
            return (
                math.nan,
                math.nan,
                (
                    'baseline not known: not observable from the velocities '
                    'in the images and the acceleration'
                ),
            )
        return math.exp(log_baseline), sigma, ''

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


def _mode(pair: PairProblem) -> SolverMode:
    """Mode of the solver; it may need gravity."""
    name = pair.config.solver
    mode = sampling.MODES[name]
    if mode.needs_gravity and (
        pair.motions[0].gravity is None or pair.motions[-1].gravity is None
    ):
        raise InputError(
            f'solver {name!r} requires gravity in both frames; without it, '
            'use auto, uniform_11pt or angular_5pt'
        )
    return mode


def _priors(
    problem: TwoViewProblem, mode: SolverMode, config: EstimatorConfig, interval: float | None
) -> Priors:
    """Priors of the IMU; velocities with the wide prior of the comparison of hypotheses."""
    g1 = problem.motion1.gravity
    g2 = problem.motion2.gravity
    known = g1 is not None and g2 is not None
    free = mode.model.velocities or mode.model.derotated
    unit1, unit2 = (np.zeros(3) if g is None else g / np.linalg.norm(g) for g in (g1, g2))
    rotation = problem.rotation
    information = problem.rotation_information
    return Priors(
        unit1,
        unit2,
        config.gravity_sigma**-2 if known else 0.0,
        problem.reference_row_time,
        config.gyro_sigma**-2 if mode.model.derotated else priors.PINNED,
        np.eye(3) if rotation is None else np.ascontiguousarray(rotation),
        np.zeros((3, 3)) if information is None else np.ascontiguousarray(information),
        priors.isotropic(
            SAMPLING_VELOCITY_SIGMA if free else priors.PINNED**-0.5,
            1.0 / interval if free and interval is not None else 0.0,
        ),
    )
