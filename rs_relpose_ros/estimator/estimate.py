"""One frame pair, end to end: derotate, sample, optimise, refine, covariance."""

from __future__ import annotations

import time

import numpy as np
from numpy.typing import ArrayLike, NDArray

from rs_relpose_ros.config.estimator import EstimatorConfig
from rs_relpose_ros.errors import InputError
from rs_relpose_ros.estimator import sampson
from rs_relpose_ros.estimator.alternating import refine_alternating
from rs_relpose_ros.estimator.consensus import SCALES
from rs_relpose_ros.estimator.hypotheses import draw_hypotheses, MODES, SolverMode
from rs_relpose_ros.estimator.local_optimisation import (
    cheirality_sign,
    optimise,
    select_inliers,
    signed,
)
from rs_relpose_ros.estimator.map_fit import (
    inverse,
    linearised,
    normal_equations,
    PINNED,
    Priors,
    State,
)
from rs_relpose_ros.estimator.problem import (
    build_problem,
    middle_row_delay,
    PairState,
    to_reference_row,
    TwoViewProblem,
)
from rs_relpose_ros.estimator.result import RelativePose, Status
from rs_relpose_ros.estimator.rotation_only import fit_rotation, transfer_errors
from rs_relpose_ros.estimator.spread import (
    correlation,
    distance_from_a_plane,
    distinct_directions,
)
from rs_relpose_ros.estimator.velocity_prior import (
    fit_with_evidence,
    GRID,
    LEAST_VELOCITY_CHANGE,
    with_velocity_sigma,
)
from rs_relpose_ros.geometry.camera import RollingShutterCamera
from rs_relpose_ros.geometry.motion import FrameMotion
from rs_relpose_ros.geometry.so3 import aligning_rotation, exp_so3, skew
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
# Points whose root mean square distance from a line is below so many thresholds lie on it.
DEGENERATE_THRESHOLDS = 2.0
# Of a predicted rotation [rad^2]: far beyond "anything is possible", which is 10.
_LARGEST_COVARIANCE = 1e12
# A translation direction less certain than this says nothing.
MAX_TRANSLATION_SIGMA = 0.5


def estimate_relative_pose(
        points1: ArrayLike, points2: ArrayLike, camera: RollingShutterCamera, motion1: FrameMotion,
        motion2: FrameMotion, relative_rotation: ArrayLike | None = None,
        relative_rotation_covariance: ArrayLike | None = None, interval: float | None = None,
        config: EstimatorConfig | None = None, rng: int | np.random.Generator = 0, *,
        quality: ArrayLike | None = None) -> RelativePose:
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
        Seconds between the two reference instants.
    config : EstimatorConfig, optional
    rng : int or numpy.random.Generator
        Equal input and state give an equal result, bit by bit.
    quality : (N,) array_like, optional
        Higher is better: the order in which matches are sampled.

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
    fit with the velocity prior chosen by its evidence, covariance from the Hessian; see
    `docs/estimator.md`.

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
    points1, points2, order = _checked_matches(points1, points2, quality)
    rotation, rotation_covariance = _checked_rotation(
        relative_rotation, relative_rotation_covariance)
    if interval is not None and not 1e-6 <= interval <= 1e6:
        raise InputError('interval must be a positive number of seconds in [1e-6, 1e6] or None, '
                         f'got {interval}')
    mode = MODES[config.solver]
    if mode.needs_gravity and (motion1.gravity is None or motion2.gravity is None):
        raise InputError(f'solver {config.solver!r} needs gravity in both frames; use auto, '
                         'uniform_11pt or angular_5pt without it')
    problem = build_problem(points1, points2, camera, motion1, motion2, rotation,
                            rotation_covariance, mode.model.derotated)
    seed = np.array([np.random.default_rng(rng).integers(2**63)], dtype=np.uint64)
    pose = _Estimation(problem, mode, config, order, seed, interval).run(middle_row_delay(camera))
    object.__setattr__(pose, 'duration', time.perf_counter() - started)
    return pose


class _Estimation:
    """The steps of one estimate, in the order of `run`."""

    def __init__(self, problem: TwoViewProblem, mode: SolverMode, config: EstimatorConfig,
                 order: NDArray[np.int64], seed: NDArray[np.uint64],
                 interval: float | None) -> None:
        self.problem, self.mode, self.config = problem, mode, config
        self.order = order[problem.valid[order]]
        self.seed = seed
        self.angle_sigma = config.pixel_sigma / problem.focal
        self.priors = _priors(problem, mode, config, interval)
        self.interval = interval
        self.iterations = 0
        self.unasked = False

    def run(self, delay: float) -> RelativePose:
        config = self.config
        if len(self.order) < config.min_inliers:
            return self._failure(Status.TOO_FEW_MATCHES,
                                 f'{len(self.order)} usable matches, fewer than min_inliers = '
                                 f'{config.min_inliers}')
        # 1. Solutions from minimal samples, ranked by multi-scale MSAC.
        return self.refine(self.sample(), delay)

    def refine(self, hypotheses: Solutions, delay: float) -> RelativePose:
        """All steps after the first."""
        config = self.config
        # 2. Local optimisation of each; the best in the cost of the full model.
        state = self._best(hypotheses)
        if self.unasked and (state is None or self._explained(state) <= EXPLAINED):
            # Angular hypotheses may explain matches by chance that the uniform model then loses.
            state = self._best(self.sample(enough=1.0))
        if state is None:
            return self._failure(Status.NO_CONSENSUS, 'no hypothesis explains the matches')
        # 3. Refinement on its inliers.
        state, inliers, velocity_sigma, sigma, local = self._refine(state)
        observations, cell = self.problem.observations, config.threshold / self.problem.focal
        count = min(distinct_directions(observations, inliers, f, cell) for f in RAYS)
        chance = self._inliers_by_chance()
        if count < max(config.min_inliers, chance):
            return self._failure(
                Status.NO_CONSENSUS, f'{count} distinct of {len(self.order)} matches agree, fewer '
                f'than max(min_inliers = {config.min_inliers}, {chance} expected by chance)')
        if min(distance_from_a_plane(observations, inliers, f)
               for f in RAYS) < DEGENERATE_THRESHOLDS * cell:
            return self._failure(
                Status.NO_CONSENSUS, f'the {count} matches that agree lie on one line: many poses '
                'explain them')
        # 4. Is there a translation at all?
        turned = self._rotation_only(state, inliers, sigma, delay)
        if turned is not None:
            return turned
        # 5. Covariance at the optimum, then from the middle to the reference row.
        if local is None:
            local = self._local_covariance(state, inliers, velocity_sigma, sigma)
        final = self._with_covariance(state, local)
        pose = to_reference_row(final, -delay, *self._turns(state, -delay))
        return self._result(pose, state, inliers, velocity_sigma)

    # -- steps -------------------------------------------------------------------------------

    def sample(self, enough: float = EXPLAINED) -> Solutions:
        """The best hypotheses, of solvers asked until one explains `enough` of the matches."""
        drawn = draw_hypotheses(self.problem, self.mode, self.config, self.order, self.seed,
                                enough)
        self.iterations += drawn.samples
        self.unasked = drawn.some_unasked
        return drawn.hypotheses

    def _best(self, hypotheses: Solutions) -> State | None:
        config, problem = self.config, self.problem
        if not len(hypotheses.R):
            return None
        if config.refinement != 'map':
            # The paper's way: the best hypothesis as it is.
            R, x, zero = hypotheses.R[0], hypotheses.x[0], np.zeros(3)
            return self._in_front(State(R, x[:3], x[3:6], x[6:], zero, zero))
        priors = with_velocity_sigma(self.priors, SAMPLING_VELOCITY_SIGMA) \
            if self.mode.model.velocities or self.mode.model.derotated else self.priors
        state, found = optimise(problem.observations, problem.valid, hypotheses.R, hypotheses.x,
                                priors, config.pixel_sigma, config.threshold, self.angle_sigma)
        return state if found else None

    def _explained(self, state: State) -> float:
        """Share of the matches that are inliers of the uniform model."""
        inliers = select_inliers(self.problem.observations, self.problem.valid, state,
                                 self.config.threshold, self.angle_sigma)
        return float(inliers.sum()) / len(self.order)

    def _in_front(self, state: State) -> State:
        near = np.abs(sampson.residuals(self.problem.observations, *state)) \
            < self.config.threshold * SCALES[1]
        return signed(state, cheirality_sign(
            self.problem.observations, near & self.problem.valid, state))

    def _refine(self, state: State,
                ) -> tuple[State, NDArray[np.bool_], float, float, Array | None]:
        """State, inliers, sigma of velocities and of matches [px], and covariance if known."""
        config, problem = self.config, self.problem
        model = self.mode.model
        free = model.velocities or (model.derotated and config.refinement == 'map')
        if config.refinement == 'map':
            grid = GRID if free else np.array([1.0 / np.sqrt(PINNED)])
            if free and self.interval is not None:
                grid = GRID[GRID >= LEAST_VELOCITY_CHANGE]
            return fit_with_evidence(
                problem.observations, problem.valid, state, self.priors, config.pixel_sigma,
                config.threshold, self.angle_sigma, grid)
        inliers = select_inliers(problem.observations, problem.valid, state, config.threshold,
                                 self.angle_sigma)
        if config.refinement == 'alternating' and inliers.sum() >= 12:
            state = self._in_front(refine_alternating(
                problem.observations, inliers, state, config.pixel_sigma, free))
            inliers = select_inliers(problem.observations, problem.valid, state, config.threshold,
                                     self.angle_sigma)
        sigma = SAMPLING_VELOCITY_SIGMA if free else 1.0 / np.sqrt(PINNED)
        return state, inliers, sigma, config.pixel_sigma, None

    def _inliers_by_chance(self) -> int:
        """Inliers that the best of many fits reaches on random matches (about 5 sigma)."""
        size = self.problem.focal
        expected = len(self.order) * min(4.0 * self.config.threshold / size, 0.5)
        return int(expected + 5.0 * np.sqrt(expected)) + self.mode.fitted_points

    def _rotation_only(self, state: State, inliers: NDArray[np.bool_], sigma: float,
                       delay: float) -> RelativePose | None:
        """The result without a translation, where none can be seen; None where one can.

        A rotation alone may absorb nearly all of the motion in front of a far plane, so it must
        explain the matches to within their noise, not to within some pixels.
        """
        problem, config = self.problem, self.config
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
        turn1, turn2 = self._turns(state._replace(R=R, dw1=np.zeros(3), dw2=np.zeros(3)), -delay)
        covariance = np.full((6, 6), np.nan)
        # No rotation is less certain than half a turn: points in one place show only two angles.
        covariance[3:, 3:] = turn1.T @ inverse(information + np.eye(3) / np.pi**2) @ turn1
        return RelativePose(
            status=Status.PURE_ROTATION if turned_only else Status.LOW_PARALLAX, reason=reason,
            R=turn1.T @ R @ turn2, covariance=covariance, inliers=inliers,
            angular_velocity1=problem.motion1.angular_velocity,
            angular_velocity2=problem.motion2.angular_velocity, model='angular',
            iterations=self.iterations, residual_rms=float(np.sqrt(np.mean(left**2))))

    def _local_covariance(self, state: State, inliers: NDArray[np.bool_], velocity_sigma: float,
                          sigma: float) -> Array:
        """Covariance (17, 17) of the local parameters from the regularised Hessian."""
        priors = with_velocity_sigma(self.priors, velocity_sigma)
        hessian, gradient, _ = normal_equations(
            linearised(self.problem.observations, inliers, state, sigma), state, priors)
        local = inverse(hessian)
        # A state that is not the optimum is off by about this step.
        step = local @ gradient
        return local + np.outer(step, step)

    def _with_covariance(self, state: State, local: Array) -> PairState:
        """The state with the covariance of (dt, dtheta, dv_1, dv_2, dw_1, dw_2)."""
        # Local parameters (theta, tangent, d1, d2, dw1, dw2 in frame 1) to the state's.
        jacobian = np.zeros((18, 17))
        jacobian[0:3, 3:5] = sampson.tangent_basis(state.t)
        jacobian[3:6, 0:3] = np.eye(3)
        jacobian[6:9, 5:8] = np.eye(3)
        # v_2 = R^T d_2, w_2 = w + R^T dw_2: the error of R turns them with it.
        jacobian[9:12, 8:11] = state.R.T
        jacobian[9:12, 0:3] = state.R.T @ skew(state.d2)
        jacobian[12:15, 11:14] = np.eye(3)
        jacobian[15:18, 14:17] = state.R.T
        w1 = self.problem.motion1.angular_velocity + state.dw1
        w2 = self.problem.motion2.angular_velocity + state.R.T @ state.dw2
        return PairState(state.R, state.t, state.d1, state.R.T @ state.d2, w1, w2,
                         jacobian @ local @ jacobian.T)

    def _turns(self, state: State, delay: float) -> tuple[Array, Array]:
        """How each camera turns from the middle row to the one `delay` later, as corrected."""
        problem = self.problem
        turn1 = problem.motion1.rotations([delay])[0]
        turn2 = problem.motion2.rotations([delay])[0]
        if not self.mode.model.derotated:
            return np.eye(3), np.eye(3)
        return (exp_so3(delay * state.dw1) @ turn1,
                exp_so3(delay * (state.R.T @ state.dw2)) @ turn2)

    def _result(self, pose: PairState, state: State, inliers: NDArray[np.bool_],
                velocity_sigma: float) -> RelativePose:
        translation_sigma = np.sqrt(max(np.trace(pose.covariance[:3, :3]), 0.0))
        r = sampson.residuals(self.problem.observations, *state)[inliers]
        carries_pose = translation_sigma <= MAX_TRANSLATION_SIGMA
        v2w2 = np.r_[9:12, 15:18]
        return RelativePose(
            status=Status.OK if carries_pose else Status.LOW_PARALLAX,
            reason='' if carries_pose else 'the direction of translation is uncertain by '
            f'{np.degrees(translation_sigma):.0f} deg: too little parallax',
            R=pose.R, t=pose.t if carries_pose else np.full(3, np.nan),
            linear_velocity1=pose.v1, linear_velocity2=pose.v2, angular_velocity1=pose.w1,
            angular_velocity2=pose.w2, inliers=inliers, covariance=pose.covariance[:6, :6],
            velocity_covariance=pose.covariance[np.ix_(v2w2, v2w2)], model=self.mode.model.name,
            velocity_sigma=velocity_sigma, iterations=self.iterations,
            residual_rms=float(np.sqrt(np.mean(r**2))))

    def _failure(self, status: Status, reason: str) -> RelativePose:
        return RelativePose(status=status, reason=reason, model=self.mode.model.name,
                            iterations=self.iterations,
                            inliers=np.zeros(len(self.problem.valid), dtype=bool))


def warm_up() -> None:
    """Compile (or load from the cache) every kernel, so that the first estimate is not slow."""
    points1, points2, camera, motion = _sideways()
    for solver in MODES:
        estimate_relative_pose(points1, points2, camera, motion, motion, np.eye(3),
                               1e-4 * np.eye(3), config=EstimatorConfig(solver=solver))


def warm_up_sampling() -> None:
    """Compile the kernels of the first step alone."""
    _warm_estimation().sample()


def warm_up_refinement() -> None:
    """Compile the kernels of all steps but the first."""
    _warm_estimation().refine(Solutions(np.eye(3)[None], np.eye(1, 9)), 0.0)


def _warm_estimation() -> _Estimation:
    points1, points2, camera, motion = _sideways()
    problem = build_problem(points1, points2, camera, motion, motion, np.eye(3),
                            1e-4 * np.eye(3))
    return _Estimation(problem, MODES['auto'], EstimatorConfig(), np.arange(len(points1)),
                       np.zeros(1, dtype=np.uint64), None)


def _sideways() -> tuple[Array, Array, RollingShutterCamera, FrameMotion]:
    """Matches of a camera that moves to its right, for the warm-up."""
    rng = np.random.default_rng(0)
    camera = RollingShutterCamera(width=640, height=480, fx=450.0, fy=450.0, cx=319.5, cy=239.5,
                                  readout_time=0.03)
    motion = FrameMotion(np.array([0.0, 0.1, 0.0]), gravity=np.array([0.0, 1.0, 0.0]))
    world = rng.uniform([-4.0, -3.0, 4.0], [4.0, 3.0, 12.0], (100, 3))
    return camera.project(world), camera.project(world - [0.5, 0.0, 0.0]), camera, motion


def _priors(problem: TwoViewProblem, mode: SolverMode, config: EstimatorConfig,
            interval: float | None) -> Priors:
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
        SAMPLING_VELOCITY_SIGMA**-2 if free else PINNED,
        1.0 / interval if free and interval is not None else 0.0,
        np.ascontiguousarray(rotation),
        np.ascontiguousarray(information) if information is not None else np.zeros((3, 3)))


def _checked_matches(points1: ArrayLike, points2: ArrayLike, quality: ArrayLike | None,
                     ) -> tuple[Array, Array, NDArray[np.int64]]:
    checked = []
    for name, value in (('points1', points1), ('points2', points2)):
        points = np.ascontiguousarray(value, dtype=np.float64)
        if points.size == 0:
            points = points.reshape(0, 2)
        if points.ndim != 2 or points.shape[1] != 2:
            raise InputError(f'{name} must have shape (N, 2), got {points.shape}')
        if not np.isfinite(points).all():
            raise InputError(f'{name} must be finite pixels, got NaN or inf in row '
                             f'{int(np.flatnonzero(~np.isfinite(points).all(axis=1))[0])}')
        if points.size and np.abs(points).max() > 1e6:
            raise InputError(f'{name} must be pixels within 1e6, got {np.abs(points).max():g}')
        checked.append(points)
    if len(checked[0]) != len(checked[1]):
        raise InputError('points1 and points2 must have the same length, '
                         f'got {len(checked[0])} and {len(checked[1])}')
    order = np.arange(len(checked[0]))
    if quality is not None:
        values = np.asarray(quality, dtype=np.float64)
        if values.shape != order.shape or not np.isfinite(values).all():
            raise InputError(f'quality must be {len(order)} finite numbers, '
                             f'got shape {values.shape}')
        order = np.argsort(-values, kind='stable')
    return checked[0], checked[1], order


def _checked_rotation(rotation: ArrayLike | None, covariance: ArrayLike | None,
                      ) -> tuple[Array | None, Array | None]:
    if rotation is None and covariance is None:
        return None, None
    if rotation is None or covariance is None:
        raise InputError('relative_rotation and relative_rotation_covariance go together: give '
                         'both or neither')
    R = np.array(rotation, dtype=np.float64)
    # Bounded first, so that the product cannot overflow.
    if R.shape != (3, 3) or not (np.abs(R).max() < 2.0
                                 and np.allclose(R @ R.T, np.eye(3), atol=1e-6)
                                 and np.linalg.det(R) > 0.0):
        raise InputError(f'relative_rotation must be a (3, 3) rotation matrix, got {R.tolist()}')
    C = np.array(covariance, dtype=np.float64)
    if C.shape != (3, 3) or not np.abs(C).max() < _LARGEST_COVARIANCE \
            or not np.allclose(C, C.T, atol=1e-9) or np.linalg.eigvalsh(C).min() < -1e-12:
        raise InputError('relative_rotation_covariance must be a (3, 3) covariance matrix '
                         f'[rad^2], got {C.tolist()}')
    return R, C
