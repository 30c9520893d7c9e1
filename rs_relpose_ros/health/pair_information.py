"""What one frame pair says of the calibration, its own unknowns eliminated.

Residuals r of a pair (Sampson errors of the matches, the gyro's rotation, priors of velocities
and rates) depend on its state x and on the deviations c of `deviation`::

    r + J_x dx + J_c dc,    H = J_x^T W J_x,    C = J_x^T W J_c
    S = J_c^T W J_c - C^T H^-1 C,    b = C^T H^-1 J_x^T W r - J_c^T W r

(Schur complement), so that ``sum S c = sum b`` over many pairs is the calibration that fits them
all. ``dx = -H^-1 C c`` is what deviations do to the pose.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
import math
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy.linalg import solve_triangular

from rs_relpose_ros.compiled import kernel
from rs_relpose_ros.estimator.information import inverse
from rs_relpose_ros.estimator.map_fit import FitMatches, stepped
from rs_relpose_ros.estimator.priors import add_priors, isotropic, Priors
from rs_relpose_ros.estimator.problem import build_problem, observed, TwoViewProblem
from rs_relpose_ros.estimator.sampson import jacobian, residuals
from rs_relpose_ros.estimator.state import PARAMETERS, TANGENT, THETA, TwoViewState
from rs_relpose_ros.geometry.camera import RollingShutterCamera
from rs_relpose_ros.geometry.motion import FrameMotion
from rs_relpose_ros.geometry.order import median
from rs_relpose_ros.geometry.so3 import exp_so3, log_so3, skew
from rs_relpose_ros.geometry.vectors import tangent_basis
from rs_relpose_ros.health.deviation import (
    AXES,
    BIAS,
    DEVIATIONS,
    DISTORTION,
    FOCAL,
    OFFSET,
    READOUT,
    SCALE,
)
from rs_relpose_ros.imu.integration import TurnSensitivity

Array = NDArray[np.float64]

# Sigma of the velocities about the mean one [baselines per second].
_VELOCITY_SIGMA = 1.0
# Residuals of this many sigmas have half the weight of small ones (Cauchy).
_CAUCHY_SIGMAS = 2.4
# Least noise of matches [px], and of the gyro's turn between two frames [rad].
_LEAST_SIGMA = 0.05
_LEAST_TURN_SIGMA = 1e-5
# Matches that are looked at, evenly over those of the pair: more cost time and tell little more.
_MOST_MATCHES = 120
# Step of numerical derivatives: far below what a residual shows, far above rounding.
_STEP = 1e-5
# Steps by which a pair is fitted anew.
_STEPS_ANEW = 3
# Of a state: rotation and direction of translation.
_POSE = np.r_[THETA:THETA + 3, TANGENT:TANGENT + 2]


@dataclass(frozen=True, slots=True, eq=False)
class PairEvidence:
    """The material of one pair, all as told, and the pose that was estimated from it."""

    points1: Array   # (N, 2) pixels of the sensor
    points2: Array
    camera: RollingShutterCamera
    motion1: FrameMotion   # about the stamped row
    motion2: FrameMotion
    interval: float   # [s]
    R: Array   # (3, 3) as estimated, between the stamped rows
    t: Array   # (3,) NaN where there is none
    gyro_rotation: Array   # (3, 3) between the stamped rows
    gyro_covariance: Array   # (3, 3) of that, as the estimate had it
    gyro_sensitivity: TurnSensitivity   # of that
    rates: tuple[Array, Array]   # (3,) at the two stamped rows [rad/s]
    R_cam_imu: Array
    gyro_sigma: float   # [rad/s] of the rate within a frame


@dataclass(frozen=True, slots=True, eq=False)
class PairInformation:
    """Information of a pair on the calibration."""

    S: Array   # (11, 11)
    b: Array   # (11,)
    pose_by_deviation: Array   # (6, 11) of (dt, dtheta) in camera 1, first order
    # (5, 11) the same in sigmas of a pose that is told right, whitened; rotation in the first 3.
    shift_by_deviation: Array
    images_against_gyro: Array   # (3,) [rad] Log of the rotation by images alone and R_gyro^T


def pair_information(pair: PairEvidence, in_force: Array, about: Array) -> PairInformation | None:
    """What a pair says, linearised about the deviations `about` (11,); None with too few matches.

    The pair's material has the deviations `in_force` (11,) applied already. Where others are
    wanted the pair is fitted anew, since its estimate followed those in force.
    """
    at, step = about - in_force, math.ceil(len(pair.points1) / _MOST_MATCHES) or 1
    pair = replace(pair, camera=_lens(pair.camera, at[FOCAL], at[DISTORTION]),
                   points1=pair.points1[::step], points2=pair.points2[::step])
    noise = pair.gyro_sensitivity.noise + _LEAST_TURN_SIGMA**2 * np.eye(3)
    problem = build_problem(pair.points1, pair.points2, pair.camera, pair.motion1, pair.motion2,
                            pair.gyro_rotation, noise)
    keep = problem.valid
    if np.count_nonzero(keep) < PARAMETERS:
        return None
    assert problem.rotation is not None and problem.rotation_information is not None
    observations = np.ascontiguousarray(problem.observations[keep])
    by_deviation, rows = _gyro(pair), _Rows.of(pair, problem, keep)
    rotation, information = problem.rotation, problem.rotation_information
    state = _state(pair, problem, observations)
    if at.any():
        rotation = exp_so3(by_deviation @ at) @ rotation
        observations = rows.displaced(observations, at)
    priors = Priors(np.zeros(3), np.zeros(3), 0.0, 0.0, pair.gyro_sigma**-2,
                    np.ascontiguousarray(rotation), information,
                    isotropic(_VELOCITY_SIGMA, 1.0 / pair.interval))
    # Without a translation there is no estimate about which a pair could be linearised.
    if at.any() or not np.isfinite(pair.t).all():
        r = np.abs(residuals(observations, state))
        state = stepped(FitMatches(observations, (r < 4.0 * np.median(r)).astype(float),
                                   _noise(r)), state, priors, _STEPS_ANEW)
    r = residuals(observations, state)
    sigma = _noise(r)
    weights = 1.0 / (1.0 + (r / (_CAUCHY_SIGMAS * sigma)) ** 2) / sigma**2
    J_x = jacobian(observations, state)
    J_c = np.hstack([rows.derivatives(observations, state, r),
                     _by_lens(pair, problem, rows, keep, at, state, r)])
    # The gyro's rotation: theta = Log(R R_gyro^T), which R_gyro turned by D c makes smaller.
    D = by_deviation
    theta = log_so3(np.ascontiguousarray(state.R @ rotation.T))
    H, gradient = np.zeros((PARAMETERS, PARAMETERS)), np.zeros(PARAMETERS)
    add_priors(state, priors, H, gradient)
    weighted = J_x.T * weights
    H += weighted @ J_x
    gradient += weighted @ r
    C = weighted @ J_c
    C[THETA:THETA + 3] -= information @ D
    solved = inverse(H) @ np.column_stack([C, gradient])
    S = (J_c.T * weights) @ J_c + D.T @ information @ D - C.T @ solved[:, :-1]
    b = C.T @ solved[:, -1] - (J_c.T * weights) @ r + D.T @ (information @ theta)
    S = 0.5 * (S + S.T)
    images = theta + _without_gyro(H, gradient, information, theta)
    # What deviations do to the pose that was estimated, with the prior that it had.
    information_told = np.linalg.inv(pair.gyro_covariance)
    H[THETA:THETA + 3, THETA:THETA + 3] += information_told - information
    C[THETA:THETA + 3] += (information - information_told) @ D
    covariance = inverse(H)
    moved = _at_stamped_row(pair, problem, state, -covariance @ C)
    spread = np.linalg.cholesky(covariance[_POSE[:, None], _POSE])
    return PairInformation(S, b + S @ about, _pose_by_deviation(problem, state, moved),
                           solve_triangular(spread, moved[_POSE], lower=True), images)


def _without_gyro(H: Array, gradient: Array, information: Array, theta: Array) -> Array:
    """Step (3,) of the rotation once the gyro's prior is taken out of the normal equations."""
    H, gradient = H.copy(), gradient.copy()
    H[THETA:THETA + 3, THETA:THETA + 3] -= information
    gradient[THETA:THETA + 3] -= information @ theta
    return np.asarray(-(inverse(H) @ gradient)[THETA:THETA + 3])


def _noise(r: Array) -> float:
    """Sigma of the matches [px] from their residuals."""
    return max(1.4826 * median(np.abs(r)), _LEAST_SIGMA)


def _state(pair: PairEvidence, problem: TwoViewProblem, observations: Array) -> TwoViewState:
    """The estimate at the middle rows, moving at constant velocity."""
    delay = problem.reference_row_time
    R = np.ascontiguousarray(problem.motion1.rotations([delay])[0] @ pair.R
                             @ problem.motion2.rotations([delay])[0].T)
    t = pair.t
    if not np.isfinite(t).all():
        # The direction that the planes of the rays share best.
        normals = np.cross(observations[:, :3], observations[:, 9:12] @ R.T)
        t = np.ascontiguousarray(np.linalg.eigh(normals.T @ normals)[1][:, 0])
    velocity = t / pair.interval
    return TwoViewState(R, t, velocity, velocity.copy(), np.zeros(3), np.zeros(3))


def _at_stamped_row(pair: PairEvidence, problem: TwoViewProblem, state: TwoViewState,
                    moved: Array) -> Array:
    """Moved states (17, 11) at the middle row, with what moves it against the stamped one.

    A longer read-out puts the middle row later, by D = share c, and the stamped one stays:
    ``t = Exp(w_1 D) t_middle, R = Exp(w_1 D) R_middle Exp(w_2 D)^T``; w in middle-row axes.
    """
    turn = problem.motion1.rotations([problem.reference_row_time])[0]
    share, rate1 = middle_share(pair.camera), turn @ pair.rates[0]
    rate2 = turn @ (pair.gyro_rotation @ pair.rates[1])
    moved = moved.copy()
    moved[TANGENT:TANGENT + 2, READOUT] += share * (tangent_basis(state.t).T @ skew(rate1)
                                                    @ state.t)
    moved[THETA:THETA + 3, READOUT] += share * (rate1 - rate2)
    return moved


def _pose_by_deviation(problem: TwoViewProblem, state: TwoViewState, moved: Array) -> Array:
    """(dt, dtheta) (6, 11) of moved states (17, 11), in the axes of the stamped row."""
    turn = problem.motion1.rotations([problem.reference_row_time])[0].T
    return np.vstack([turn @ tangent_basis(state.t) @ moved[TANGENT:TANGENT + 2],
                      turn @ moved[THETA:THETA + 3]])


def _lens(camera: RollingShutterCamera, focal: float, distortion: float) -> RollingShutterCamera:
    """The camera with deviations of FOCAL and DISTORTION."""
    if not (focal or distortion):
        return camera
    coefficients = list(camera.distortion) or [0.0] * 4
    coefficients[0] += distortion
    return replace(camera, fx=camera.fx / (1.0 + focal), fy=camera.fy / (1.0 + focal),
                   distortion=tuple(coefficients) if any(coefficients) else camera.distortion)


def _gyro(pair: PairEvidence) -> Array:
    """Turn (3, 11) of the gyro's rotation between the middle rows, on its left, by deviations."""
    turn = np.zeros((3, DEVIATIONS))
    turn[:, AXES] = np.eye(3) - pair.gyro_rotation
    turn[:, OFFSET] = pair.gyro_rotation @ pair.rates[1] - pair.rates[0]
    turn[:, READOUT] = middle_share(pair.camera) * turn[:, OFFSET]
    turn[:, BIAS] = -pair.gyro_sensitivity.by_rate @ pair.R_cam_imu
    turn[:, SCALE] = pair.gyro_sensitivity.by_scale
    return turn


def _by_lens(pair: PairEvidence, problem: TwoViewProblem, rows: _Rows, keep: NDArray[np.bool_],
             at: Array, state: TwoViewState, r: Array) -> Array:
    """Derivatives (N, 2) of the residuals by FOCAL and by DISTORTION.

    Rays and their derivatives by the pixel change together, as they must: a residual in pixels
    whose rays alone shrink would fit noise the better the longer the focal length.
    """
    columns, points1, points2 = [], pair.points1[keep], pair.points2[keep]
    for focal, distortion in ((_STEP, 0.0), (0.0, _STEP)):
        observations = observed(
            points1, points2, _lens(pair.camera, focal, distortion), problem.motion1,
            problem.motion2)
        if at.any():
            observations = rows.displaced(observations, at)
        columns.append((residuals(observations, state) - r) / _STEP)
    return np.stack(columns, axis=1)


class _Rows(NamedTuple):
    """What deviations do to observations within a frame."""

    turns: Array   # (2, N, 3, 9) of a ray on its way to the middle row, on its left
    shares: Array   # (2, N) signed share of the read-out after the middle row

    @classmethod
    def of(cls, pair: PairEvidence, problem: TwoViewProblem, keep: NDArray[np.bool_]) -> _Rows:
        """Those of a pair's usable matches."""
        camera, n = pair.camera, np.count_nonzero(keep)
        turns, shares = np.empty((2, n, 3, FOCAL)), np.empty((2, n))
        for k, (points, motion) in enumerate(((pair.points1, problem.motion1),
                                              (pair.points2, problem.motion2))):
            shares[k] = (points[keep, 1] - 0.5 * (camera.height - 1)) / camera.height
            _turn_of_a_row(motion, pair, shares[k], problem.observations[keep, 18 + k], turns[k])
        return cls(turns, shares)

    def displaced(self, observations: Array, at: Array) -> Array:
        """Observations (N, 20) with the deviations `at` all at once; those of the lens aside."""
        out = np.empty_like(observations)
        _displace(observations, self.turns @ at[:FOCAL], self.shares * at[READOUT], out)
        return out

    def derivatives(self, observations: Array, state: TwoViewState, r: Array) -> Array:
        """Derivatives (N, 9) of the residuals by all deviations but those of the lens."""
        n = len(observations)
        out = np.empty((FOCAL * n, 20))
        for c in range(FOCAL):
            _displace(observations, _STEP * self.turns[..., c],
                      _STEP * self.shares * (c == READOUT), out[c * n:(c + 1) * n])
        return (residuals(out, state).reshape(FOCAL, n) - r).T / _STEP


def _turn_of_a_row(motion: FrameMotion, pair: PairEvidence, shares: Array, tau: Array,
                   turn: Array) -> None:
    """Fill `turn` (N, 3, 9) of a ray on its way from its row to the middle one, by deviation."""
    rate, along = motion.angular_velocity, tau[:, None, None]
    later = tau[:, None] * _acceleration(motion, pair.camera.row_time_span)
    # Exp(c) A Exp(-c) for the small rotation A = Exp(w tau): c x (w tau)
    turn[:, :, AXES] = -along * skew(rate)
    turn[:, :, OFFSET] = later
    turn[:, :, READOUT] = shares[:, None] * rate + middle_share(pair.camera) * later
    turn[:, :, BIAS] = -along * pair.R_cam_imu
    turn[:, :, SCALE] = tau[:, None] * rate


def middle_share(camera: RollingShutterCamera) -> float:
    """Rows from the stamped to the middle one, as a share of the read-out: 0.5, 0 or -0.5."""
    return (0.5 * (camera.height - 1) - camera.reference_row_index) / camera.height


def _acceleration(motion: FrameMotion, span: tuple[float, float]) -> Array:
    """Change of the rate during the read-out [rad/s^2]: of its second half against its first."""
    half = 0.5 * (span[1] - span[0])
    if half <= 0.0 or motion.knot_times is None:
        return np.zeros(3)
    first, last = motion.rotations([-half, half])
    forward, backward = log_so3(last), -log_so3(first)
    return np.asarray((forward - backward) / half**2)


@kernel
def _displace(observations: Array, turns: Array, delays: Array, out: Array) -> None:
    """Observations with rays turned on the left by `turns` (2, N, 3), rows later by `delays`."""
    for i in range(observations.shape[0]):
        for image in range(2):
            out[i, 18 + image] = observations[i, 18 + image] + delays[image, i]
            turn = turns[image, i]
            for base in range(9 * image, 9 * image + 9, 3):
                for k in range(3):
                    p, q = (k + 1) % 3, (k + 2) % 3
                    out[i, base + k] = (observations[i, base + k]
                                        + turn[p] * observations[i, base + q]
                                        - turn[q] * observations[i, base + p])
