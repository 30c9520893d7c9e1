"""Recursive calibration from frame pairs, the unknowns of each pair eliminated.

Names are those of the equations in docs/health.md, "Recursive calibration". The deviations c (K,)
are values of the selection `LIVE` of `core.deviations`.
"""

from __future__ import annotations

from collections import deque
from dataclasses import dataclass, replace
import functools
import math
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy.linalg import solve_triangular

from rs_relpose_ros.core.deviations import LENS, LIVE
from rs_relpose_ros.core.least_squares import inverse
from rs_relpose_ros.core.losses import cauchy_weight, robust_scale
from rs_relpose_ros.estimator import priors
from rs_relpose_ros.estimator.covariance import image_regions, IMAGES, POSE, REGIONS
from rs_relpose_ros.estimator.fit import FitMatches, gauss_newton
from rs_relpose_ros.estimator.priors import PARAMETERS, TANGENT, THETA, TwoViewState
from rs_relpose_ros.estimator.problem import build_problem, derotate, TwoViewProblem
from rs_relpose_ros.estimator.sampling import translation_direction
from rs_relpose_ros.estimator.sampson import jacobian, residuals
from rs_relpose_ros.geometry import Array, so3
from rs_relpose_ros.geometry.camera import RollingShutterCamera
from rs_relpose_ros.geometry.motion import FrameMotion
from rs_relpose_ros.geometry.timing import seconds_between, to_nanoseconds
from rs_relpose_ros.imu.integration import ImuSlice, RotationSensitivity
from rs_relpose_ros.jit import kernel

# Sigma of the velocities about the mean one [baselines per second].
_VELOCITY_SIGMA = 1.0
# Residuals of this many sigmas have half the weight of small ones (Cauchy).
_CAUCHY_SIGMAS = 2.4
# Least noise of matches [px], and of the gyro's rotation between two frames [rad].
_LEAST_SIGMA = 0.05
_LEAST_ROTATION_SIGMA = 1e-5
# Largest number of matches, evenly over those of the pair: more add cost and little information.
_MOST_MATCHES = 120
# Step of numerical derivatives: far below the noise of a residual, far above rounding.
_STEP = 1e-5
# Gyro beyond the rows [s].
_LEAST_SPAN = 1e-4
# Steps of a new fit of a pair.
_NEW_STEPS = 3
# Places of single deviations in the vector c.
_OFFSET = LIVE.index('time_offset')
_READOUT = LIVE.index('readout_time')
_SCALE = LIVE.index('gyro_scale')
_DISTORTION = LIVE.index('distortion')
# Number of deviations before those of the lens, which come last.
_LENS = LIVE.index('focal_log')
# Of a state: rotation and direction of translation.
_POSE = np.r_[THETA : THETA + 3, TANGENT : TANGENT + 2]


@dataclass(frozen=True, slots=True, eq=False)
class PairData:
    """Matches and motion of one pair, as configured, and the pose estimated from them."""

    points1: Array  # (N, 2) pixels of the sensor
    points2: Array
    camera: RollingShutterCamera
    motion1: FrameMotion  # about the stamped row
    motion2: FrameMotion
    interval: float  # [s]
    R: Array  # (3, 3) as estimated, between the stamped rows
    t: Array  # (3,) NaN where there is none
    gyro_rotation: Array  # (3, 3) between the stamped rows
    gyro_covariance: Array  # (3, 3) of that, as in the estimate
    gyro_sensitivity: RotationSensitivity  # of that
    segment: ImuSlice  # of that
    R_cam_imu: Array
    gyro_sigma: float  # [rad/s] of the rate within a frame


@dataclass(frozen=True, slots=True, eq=False)
class PairInformation:
    """Information of a pair on the calibration."""

    S: Array  # (K, K)
    b: Array  # (K,)
    if_distorted: float  # factor of both if the distortion is free: its residuals are no noise
    pose_by_deviation: Array  # (6, K) of (dt, dtheta) in camera 1, first order
    pose_by_center: Array  # (6, 2) the same by the principal point [px]
    # (5, K) the same in sigmas of a correctly configured pose, whitened; rotation in the first 3.
    shift_by_deviation: Array
    images_against_gyro: Array  # (3,) [rad] Log of the rotation by images alone and R_gyro^T
    # (11, 9) change of the estimate by the images alone, at the middle rows.
    images_by_deviation: Array


def pair_information(pair: PairData, active: Array, about: Array) -> PairInformation | None:
    """Information of a pair, linearised about the deviations `about` (K,).

    Those applied already are `active` (K,): about others the pair is fitted again. None if there
    are too few matches, or if a fit far from the gyro's rotation diverges.
    """
    at, step = about - active, math.ceil(len(pair.points1) / _MOST_MATCHES) or 1
    pair = replace(
        pair,
        camera=_lens(pair.camera, *at[_LENS:]),
        points1=pair.points1[::step],
        points2=pair.points2[::step],
    )
    noise = pair.gyro_sensitivity.noise + _LEAST_ROTATION_SIGMA**2 * np.eye(3)
    problem = build_problem(
        pair.points1,
        pair.points2,
        pair.camera,
        pair.motion1,
        pair.motion2,
        pair.gyro_rotation,
        noise,
    )
    keep = problem.valid
    rotation, information = problem.rotation, problem.rotation_information
    if np.count_nonzero(keep) < PARAMETERS or rotation is None or information is None:
        return None
    D, turns, shares = _gyro(pair), *_by_rows(pair, problem, keep)
    moved = (turns @ at[:_LENS])[None], (shares * at[_READOUT])[None]
    rotation = so3.exp_so3(D[:, : LIVE.size] @ at) @ rotation
    observations = _displaced(problem.observations[None, keep], *moved)[0]
    prior = priors.Priors(
        np.zeros(3),
        np.zeros(3),
        0.0,
        0.0,
        pair.gyro_sigma**-2,
        np.ascontiguousarray(rotation),
        information,
        priors.isotropic(_VELOCITY_SIGMA, 1.0 / pair.interval),
    )
    state = _state(pair, problem, observations, prior, fit=bool(at.any()))
    r = residuals(observations, state)
    sigma = robust_scale(r, _LEAST_SIGMA, 0.0)
    weights = cauchy_weight((r / (_CAUCHY_SIGMAS * sigma)) ** 2) / sigma**2
    J_x = jacobian(observations, state)
    delays = np.zeros((_LENS, *shares.shape))
    delays[_READOUT] = _STEP * shares
    stepped = (
        _displaced(observations[None], _STEP * np.moveaxis(turns, -1, 0), delays),
        _displaced(_by_lens(pair, problem, keep), *moved),
    )
    J_c = (residuals(np.vstack(stepped).reshape(-1, 20), state).reshape(-1, len(r)) - r).T / _STEP
    # The gyro's rotation: theta = Log(R R_gyro^T), which R_gyro rotated by D c makes smaller.
    theta = so3.log_so3(np.ascontiguousarray(state.R @ rotation.T))
    H, gradient = np.zeros((PARAMETERS, PARAMETERS)), np.zeros(PARAMETERS)
    priors.add_priors(state, prior, H, gradient)
    weighted = J_x.T * weights
    H, gradient, C = H + weighted @ J_x, gradient + weighted @ r, weighted @ J_c
    images_by_deviation = _images_by_deviation(H, C, information, bool(np.isfinite(pair.t).all()))
    C[THETA : THETA + 3] -= information @ D
    solved = inverse(H) @ np.column_stack([C, gradient])
    if not np.isfinite(solved).all():
        return None
    S = (J_c.T * weights) @ J_c + D.T @ information @ D - C.T @ solved[:, :-1]
    b = C.T @ solved[:, -1] - (J_c.T * weights) @ r + D.T @ (information @ theta)
    # The principal point is not estimated: axes of the IMU have nearly the same effect.
    S, b = 0.5 * (S + S.T)[: LIVE.size, : LIVE.size], b[: LIVE.size]
    ratio, if_distorted = _common_noise(
        FitMatches(observations, weights, 1.0),
        (J_c - J_x @ solved[:, :-1])[:, : LIVE.size],
        r - J_x @ solved[:, -1],
        S,
    )
    S, b = S / ratio, b / ratio
    by_deviation, whitened = _shifts(pair, problem, state, H.copy(), C, D)
    # The rotation by the images: the step without the gyro's prior.
    H[THETA : THETA + 3, THETA : THETA + 3] -= information
    gradient[THETA : THETA + 3] -= information @ theta
    return PairInformation(
        S,
        b + S @ about,
        ratio / if_distorted,
        by_deviation[:, : LIVE.size],
        by_deviation[:, LIVE.size :],
        whitened[:, : LIVE.size],
        np.asarray(theta - (inverse(H) @ gradient)[THETA : THETA + 3]),
        images_by_deviation,
    )


def _images_by_deviation(H: Array, C: Array, of_gyro: Array, has_direction: bool) -> Array:
    """Change of pose and velocities by the images alone (11, 9) with the deviations of IMAGES.

    H (17, 17), C (17, 13): information of the unknowns, and with the deviations, of the matches.
    The prior of the velocities stays in H: where the images do not observe them, their change
    would be unbounded. Without a direction only the rotation changes.
    """
    H = H.copy()
    H[THETA : THETA + 3, THETA : THETA + 3] -= of_gyro
    moved = np.zeros((POSE, C.shape[1]))
    if has_direction:
        moved[:] = -(inverse(H) @ C)[:POSE]
    else:
        of_theta = slice(THETA, THETA + 3)
        moved[of_theta] = -np.linalg.solve(H[of_theta, of_theta], C[of_theta])
    by_deviation = np.empty((POSE, IMAGES.size))
    for name, columns in IMAGES.parts.items():
        own = slice(LIVE.size, None) if name == 'principal_point' else LIVE.part(name)
        by_deviation[:, columns] = moved[:, own]
    return by_deviation


def _shifts(
    pair: PairData, problem: TwoViewProblem, state: TwoViewState, H: Array, C: Array, D: Array
) -> tuple[Array, Array]:
    """Shift of the estimated pose by deviations and center, (6, 13), and whitened, (5, 13).

    With the prior of the estimate for the gyro's rotation; H and C are changed. The state is that
    at the middle row, which a longer readout time delays, by D = share c, but not the stamped one:
    ``t = Exp(w_1 D) t_middle, R = Exp(w_1 D) R_middle Exp(w_2 D)^T``; w in middle-row axes.
    """
    assert problem.rotation_information is not None
    prior_information = np.linalg.inv(pair.gyro_covariance)
    H[THETA : THETA + 3, THETA : THETA + 3] += prior_information - problem.rotation_information
    C[THETA : THETA + 3] += (problem.rotation_information - prior_information) @ D
    covariance, tangent = inverse(H), so3.tangent_basis(state.t)
    moved = -covariance @ C
    to_middle = problem.motion1.rotations([problem.reference_row_time])[0]
    share, rates = middle_share(pair.camera), pair.segment.angular_velocities
    rate1, rate2 = to_middle @ rates[0], to_middle @ (pair.gyro_rotation @ rates[-1])
    moved[TANGENT : TANGENT + 2, _READOUT] += share * (tangent.T @ so3.skew(rate1) @ state.t)
    moved[THETA : THETA + 3, _READOUT] += share * (rate1 - rate2)
    spread = np.linalg.cholesky(covariance[_POSE[:, None], _POSE])
    # In the axes of the stamped row.
    by_deviation = np.vstack(
        [
            to_middle.T @ tangent @ moved[TANGENT : TANGENT + 2],
            to_middle.T @ moved[THETA : THETA + 3],
        ]
    )
    return by_deviation, solve_triangular(spread, moved[_POSE], lower=True)


def _common_noise(matches: FitMatches, J: Array, r: Array, S: Array) -> tuple[float, float]:
    """Variance of the score of the matches by image regions, over that by S; at least 1.

    The second value is without residuals that a distortion explains. J (N, K), r (N,):
    derivatives and residuals of the fitted matches, S (K, K): information of the pair.
    """
    scale = np.outer(LIVE.sigmas, LIVE.sigmas)
    covariance = inverse(S * scale + np.eye(LIVE.size)) * scale
    in_region = image_regions(matches) == np.arange(REGIONS[0] * REGIONS[1])[:, None]
    along = J[:, _DISTORTION]
    information = J.T * matches.weights @ J
    without = r - along * (
        (along * matches.weights)
        @ r
        / (np.diag(information)[_DISTORTION] + LIVE.sigmas[_DISTORTION] ** -2.0)
    )
    independent = float((covariance * information).sum())

    def ratio(left: Array) -> float:
        sums = (in_region * (matches.weights * left)) @ J
        return max((1.0 + float(((sums @ covariance) * sums).sum())) / (1.0 + independent), 1.0)

    by_regions = ratio(r)
    return by_regions, min(ratio(without), by_regions)


def _state(
    pair: PairData, problem: TwoViewProblem, observations: Array, prior: priors.Priors, fit: bool
) -> TwoViewState:
    """The estimate at the middle rows, at constant velocity; fitted again if there is no t."""
    delay = problem.reference_row_time
    R = np.ascontiguousarray(
        problem.motion1.rotations([delay])[0] @ pair.R @ problem.motion2.rotations([delay])[0].T
    )
    t = pair.t
    if not np.isfinite(t).all():
        t, fit = translation_direction(observations, R), True
    velocity = t / pair.interval
    state = TwoViewState(R, t, velocity, velocity.copy(), np.zeros(3), np.zeros(3))
    if not fit:
        return state
    r = np.abs(residuals(observations, state))
    matches = FitMatches(
        observations, (r < 4.0 * np.median(r)).astype(float), robust_scale(r, _LEAST_SIGMA, 0.0)
    )
    return gauss_newton(matches, state, prior, _NEW_STEPS)


@functools.lru_cache(maxsize=16)
def _lens(camera: RollingShutterCamera, focal: float, distortion: float) -> RollingShutterCamera:
    """The camera with deviations of focal length and distortion."""
    if not (focal or distortion):
        return camera
    return camera.moved_lens(LIVE.basis[LENS, _LENS:] @ (focal, distortion))


def _gyro(pair: PairData) -> Array:
    """Left derivative (3, 13) of the gyro's rotation between the middle rows, as of the rays."""
    D, rates = np.zeros((3, LIVE.size + 2)), pair.segment.angular_velocities
    D[:, LIVE.part('axes')] = np.eye(3) - pair.gyro_rotation
    D[:, _OFFSET] = pair.gyro_rotation @ rates[-1] - rates[0]
    D[:, _READOUT] = middle_share(pair.camera) * D[:, _OFFSET]
    D[:, LIVE.part('gyro_bias')] = -pair.gyro_sensitivity.by_rate @ pair.R_cam_imu
    D[:, _SCALE] = pair.gyro_sensitivity.by_scale
    return D


def _by_lens(pair: PairData, problem: TwoViewProblem, keep: NDArray[np.bool_]) -> Array:
    """Observations (4, N, 20) with steps of focal length, distortion and the principal point [px].

    Rays and their derivatives by the pixel change together: with smaller rays alone, residuals in
    pixels would shrink with a longer focal length.
    """
    camera, n = pair.camera, int(np.count_nonzero(keep))
    centre, out = np.array([camera.cx, camera.cy]), np.empty((4 * n, 20))
    for k, (points, motion) in enumerate(
        ((pair.points1[keep], problem.motion1), (pair.points2[keep], problem.motion2))
    ):
        # With another focal length or centre, a pixel has the ray that another one has now.
        rays, jacobian = camera.unproject_with_jacobian(
            np.concatenate(
                [
                    centre + (1.0 - _STEP) * (points - centre),
                    points,
                    points - (_STEP, 0.0),
                    points - (0.0, _STEP),
                ]
            )
        )
        jacobian[:n] *= 1.0 - _STEP
        rays[n : 2 * n], jacobian[n : 2 * n] = _lens(camera, 0.0, _STEP).unproject_with_jacobian(
            points
        )
        tau = problem.observations[keep, 18 + k]
        derotate(
            rays,
            jacobian,
            np.tile(motion.rotations(tau), (4, 1, 1)),
            camera.line_delay * motion.angular_velocity,
            out[:, 9 * k : 9 * k + 9],
        )
        out[:, 18 + k] = np.tile(tau, 4)
    return out.reshape(4, n, 20)


def _by_rows(
    pair: PairData, problem: TwoViewProblem, keep: NDArray[np.bool_]
) -> tuple[Array, Array]:
    """Derivatives of rays (N, 2, 3, 9), rotated from their row to the middle one, on the left.

    By all deviations but those of the lens. Also the rows' signed shares (N, 2) of the readout
    after the middle one.
    """
    camera, n = pair.camera, np.count_nonzero(keep)
    half = 0.5 * (camera.row_time_span[1] - camera.row_time_span[0])
    turns, shares = np.empty((n, 2, 3, _LENS)), np.empty((n, 2))
    for k, (points, motion) in enumerate(
        ((pair.points1, problem.motion1), (pair.points2, problem.motion2))
    ):
        shares[:, k] = (points[keep, 1] - 0.5 * (camera.height - 1)) / camera.height
        turn, tau = turns[:, k], problem.observations[keep, 18 + k]
        rate, along, acceleration = motion.angular_velocity, tau[:, None, None], np.zeros(3)
        if half > 0.0 and motion.knot_times is not None:  # of the second half against the first
            first, last = map(so3.log_so3, motion.rotations([-half, half]))
            acceleration = (last + first) / half**2
        later = tau[:, None] * acceleration
        # Exp(c) A Exp(-c) for the small rotation A = Exp(w tau): c x (w tau)
        turn[:, :, LIVE.part('axes')] = -along * so3.skew(rate)
        turn[:, :, _OFFSET] = later
        turn[:, :, _READOUT] = shares[:, k, None] * rate + middle_share(camera) * later
        turn[:, :, LIVE.part('gyro_bias')] = -along * pair.R_cam_imu
        turn[:, :, _SCALE] = tau[:, None] * rate
    return turns, shares


@kernel
def _displaced(observations: Array, turns: Array, delays: Array) -> Array:
    """Observations (K, N, 20) with rays rotated by `turns` (M, N, 2, 3) on the left, rows later.

    K or M is 1; `delays` (M, N, 2) [s].
    """
    out = np.empty((max(len(observations), len(turns)), *observations.shape[1:]))
    for m in range(out.shape[0]):
        given, deviation = m % len(observations), m % len(turns)
        for i in range(out.shape[1]):
            for column in range(18):
                first, image, k = column - column % 3, column // 9, column % 3
                p, q, turn = (k + 1) % 3, (k + 2) % 3, turns[deviation, i, image]
                out[m, i, column] = (
                    observations[given, i, column]
                    + turn[p] * observations[given, i, first + q]
                    - turn[q] * observations[given, i, first + p]
                )
            for image in range(2):
                out[m, i, 18 + image] = (
                    observations[given, i, 18 + image] + delays[deviation, i, image]
                )
    return out


def middle_share(camera: RollingShutterCamera) -> float:
    """Rows from the stamped to the middle one, as a share of the readout: 0.5, 0 or -0.5."""
    return (0.5 * (camera.height - 1) - camera.reference_row_index) / camera.height


# -- Other times of the rows -------------------------------------------------------------------

_TIMES = [_OFFSET, _READOUT]


def _at_other_times(pair: PairData, gyro: ImuSlice, deviations: Array) -> PairData | None:
    """The pair with rows at the times of the deviations, not yet fitted.

    `gyro`, which extends beyond the pair, is integrated again; None if it does not cover all rows.
    """
    signed = pair.camera.line_delay * pair.camera.height + float(deviations[_READOUT])
    camera = replace(
        pair.camera, readout_time=abs(signed), readout_direction='down' if signed >= 0.0 else 'up'
    )
    known, (begin, end) = (gyro.stamps_ns - gyro.stamps_ns[0]) * 1e-9, camera.row_time_span
    begin, end = begin - _LEAST_SPAN, end + _LEAST_SPAN
    first, second = (
        seconds_between(gyro.stamps_ns[0], pair.segment.stamps_ns[k]) + float(deviations[_OFFSET])
        for k in (0, -1)
    )
    if first + begin < 0.0 or second + end > known[-1]:
        return None

    def between(start: float, stop: float) -> tuple[Array, Array]:
        times = np.concatenate([[start], known[(known > start) & (known < stop)], [stop]])
        return times, np.column_stack(
            [np.interp(times, known, axis) for axis in gyro.angular_velocities.T]
        )

    times, rates = between(first, second)
    rotation = so3.integrated_rotations(times, rates)[-1]
    motions = []
    for stamped in (first, second):
        rows, row_rates = between(stamped + begin, stamped + end)
        motions.append(FrameMotion.from_gyro(rows - stamped, row_rates))
    return replace(
        pair,
        camera=camera,
        motion1=motions[0],
        motion2=motions[1],
        R=rotation,
        t=np.full(3, np.nan),
        gyro_rotation=rotation,
        segment=replace(
            pair.segment,
            angular_velocities=rates,
            stamps_ns=gyro.stamps_ns[0] + np.round(times * 1e9).astype(np.int64),
        ),
    )


def _far_in_time(deviations: Array) -> bool:
    return float(np.linalg.norm((deviations / LIVE.sigmas)[_TIMES])) >= _NEAR


# -- Sums over pairs ---------------------------------------------------------------------------

# Pairs of the last seconds, at most so many.
WINDOW_NS = to_nanoseconds(20.0)
MOST_PAIRS = 100
# Older pairs that are linearised again with each new one, and distance in sigmas of the prior
# within which that changes nothing.
_AGAIN, _NEAR = 3, 0.02
# Sigmas of n pairs are widened by (n + 6) / n: few scores scatter less than they should. Share of
# a pair's sigma that is common to all pairs, and not reduced by averaging: blur, the tracker's
# bias, a lens that the model does not fit.
_FEW_PAIRS, _SHARED = 6, 0.15


@dataclass(frozen=True, slots=True, eq=False)
class Calibration:
    """Estimated deviations from the configuration."""

    c: Array  # (K,)
    covariance: Array  # (K, K)
    S: Array  # (N, K, K) and (N, K): of the pairs, without a prior
    b: Array
    if_distorted: Array  # (N,) factors of these
    about: Array  # (K,) about which they are linearised, in the mean by their information
    scatter: float  # variance of the scores over that by S: 1 where residuals are independent
    shared: float  # factor of the variances by errors that are common to all pairs
    widened: float  # and by the number of pairs

    @property
    def sigma(self) -> Array:
        """(K,) 1 sigma."""
        return np.asarray(np.sqrt(np.diag(self.covariance)))


NOTHING_ESTIMATED = Calibration(
    np.zeros(LIVE.size),
    np.diag(LIVE.sigmas**2),
    np.zeros((0, LIVE.size, LIVE.size)),
    np.zeros((0, LIVE.size)),
    np.zeros(0),
    np.zeros(LIVE.size),
    1.0,
    1.0,
    1.0,
)


class LastSeconds(deque[Any]):
    """Tuples of the last seconds, at most `most`, each with its stamp [ns] first."""

    def __init__(self, most: int, window_ns: int) -> None:
        super().__init__(maxlen=most)
        self._window_ns = window_ns

    def keep(self, item: tuple[Any, ...]) -> None:
        """Add a tuple, in the order of time; an earlier stamp restarts."""
        if self and item[0] < self[-1][0]:
            self.clear()
        self.append(item)
        while self[0][0] < item[0] - self._window_ns:
            self.popleft()


class _Entry(NamedTuple):
    """A pair and its linearisation."""

    stamp_ns: int
    data: PairData
    active: Array  # (K,)
    about: Array  # (K,)
    information: PairInformation


class Recursion:
    """The pairs of the last seconds."""

    def __init__(self) -> None:
        self._pairs = LastSeconds(MOST_PAIRS, WINDOW_NS)

    def add(
        self, stamp_ns: int, data: PairData, active: Array, about: Array
    ) -> PairInformation | None:
        """Add a pair, in the order of time; its information by `pair_information`."""
        information = pair_information(data, active, about)
        if information is not None:
            self._pairs.keep(_Entry(stamp_ns, data, active, about, information))
        return information

    def relinearise(self) -> bool:
        """Linearise the furthest pairs about the last one's deviations; whether there are any."""
        last = self._pairs[-1]
        apart = np.linalg.norm(
            (np.array([pair.about for pair in self._pairs]) - last.about) / LIVE.sigmas, axis=1
        )
        if len(apart) > 1 and _far_in_time(last.about - last.active):
            apart[-2] = math.inf  # now the gyro after it is known
        chosen = [k for k in np.argsort(apart, kind='stable')[::-1][:_AGAIN] if apart[k] >= _NEAR]
        for k in chosen:
            data, active = self._pairs[k].data, self._pairs[k].active
            gyro, later = data.segment, last.about - active
            if _far_in_time(later):  # by the gyro there
                for n in (k - 1, k + 1):
                    other = self._pairs[n].data.segment if 0 <= n < len(self._pairs) else gyro
                    first, second = (other, gyro) if n < k else (gyro, other)
                    if first.stamps_ns[-1] == second.stamps_ns[0]:
                        gyro = first.joined(second)
                if (moved := _at_other_times(data, gyro, later)) is not None:
                    data, active = moved, active.copy()
                    active[_TIMES] = last.about[_TIMES]
            if (information := pair_information(data, active, last.about)) is not None:
                self._pairs[k] = self._pairs[k]._replace(about=last.about, information=information)
        return bool(chosen)

    def solved(self) -> Calibration:
        """The calibration that fits all pairs."""
        n = len(self._pairs)
        if not n:
            return NOTHING_ESTIMATED
        S, b, if_distorted = (
            np.array([getattr(pair.information, name) for pair in self._pairs])
            for name in ('S', 'b', 'if_distorted')
        )
        # Scaled by the prior: the deviations have different units.
        scale = LIVE.sigmas
        hessian = S.sum(axis=0) * np.outer(scale, scale) + np.eye(LIVE.size)
        covariance = inverse(hessian) * np.outer(scale, scale)
        c = covariance @ b.sum(axis=0)
        # Sandwich (White, Econometrica 1982), about the solution: scores about zero contain it.
        scores = b - S @ c
        sandwich = covariance @ (scores.T @ scores) @ covariance
        widened, shared = ((n + _FEW_PAIRS) / n) ** 2, 1.0 + _SHARED**2 * n
        ratios = np.maximum(np.diag(sandwich) / np.diag(covariance), 1.0) * widened
        weights = np.einsum('pii->pi', S)
        about = (weights * [pair.about for pair in self._pairs]).sum(axis=0) / np.maximum(
            weights.sum(axis=0), np.finfo(float).tiny
        )
        return Calibration(
            c,
            shared * covariance * np.sqrt(np.outer(ratios, ratios)),
            S,
            b,
            if_distorted,
            about,
            float(np.median(ratios)),
            shared,
            widened,
        )
