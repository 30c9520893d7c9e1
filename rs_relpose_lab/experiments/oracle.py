"""Limit of the data: a maximum-a-posteriori estimate with knowledge of the truth.

The oracle knows which matches are true, every noise level and the magnitude of the velocities, and
starts at the truth. It uses NumPy and SciPy alone and shares nothing with the estimator: neither
the code nor the parametrisation (gravity is a separate unknown, velocities are in each camera's
own frame) nor the derivatives (complex steps).

For a match at pixels ``(u_1, v_1), (u_2, v_2)``, row times ``tau_i = v_i line_delay``::

    f_i = Exp((w_i + dw_i) tau_i) m_i,    m_i = ((u_i - c_u) / f, (v_i - c_v) / f, 1)
    e = (f_1 x R f_2) . (t + tau_2 R v_2 - tau_1 v_1)
    r = e / |grad e|,    grad e: by the four pixel coordinates, row times included

and the estimate minimises ``sum r^2 / sigma^2`` plus the priors of both gravities, both gyros and
the velocities.
"""

from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.optimize import least_squares

from rs_relpose_lab.experiments.problems import (
    CENTRE_U,
    CENTRE_V,
    FOCAL,
    LINE_DELAY,
    TwoViewProblem,
)
from rs_relpose_lab.simulation.rows import Array

Values = NDArray[Any]  # real, or complex under a complex step

# Unknowns, as a step from a start: rotation of R (3), tangent of t (2), tangent of gravity (2),
# gyro corrections (6), velocities (6; left out where both cameras rest).
# [derived: their sizes]
# Places of the pose.
_POSE = slice(0, 5)
# Places of the tangent of gravity.
_GRAVITY = slice(5, 7)
# Places of the gyro corrections.
_GYRO = slice(7, 13)
# Places of the velocities.
_VELOCITY = slice(13, 19)
# Complex step of the derivatives, whose square is lost in rounding. [chosen: any value in
# 1e-100..1e-20 would do]
_STEP = 1e-30


@dataclass(frozen=True, slots=True, eq=False)
class OracleEstimate:
    """Pose ``X1 = R X2 + t`` and the covariance (6, 6) of ``(dt, dtheta)``, both in camera 1.

    ``t_true = t + dt``, ``R_true = Exp(dtheta) R``
    """

    R: Array
    t: Array
    covariance: Array


@dataclass(frozen=True, slots=True, eq=False)
class Start:
    """The point from which the unknowns count: pose, gravity in camera 1, and their tangents."""

    R: Array
    t: Array
    tangent: Array
    gravity: Array
    gravity_tangent: Array


def start_at(R: Array, t: Array, gravity: Array) -> Start:
    """The start at a pose and a direction of gravity in camera 1."""
    return Start(R, t, _tangent(t), gravity, _tangent(gravity))


@dataclass(frozen=True, slots=True, eq=False)
class Objective:
    """Residuals, of which the oracle minimises the sum of squares, over a step x from `start`.

    Outliers are left out.
    """

    problem: TwoViewProblem
    pixel_sigma: float  # [px] per coordinate
    gravity_sigma: float  # [rad] per axis of one frame's direction
    gyro_sigma: float  # [rad/s] per axis of one frame
    start: Start

    @property
    def velocity_spread(self) -> float:
        """Root mean square of the true velocities' components [baselines per second]."""
        return float(
            np.sqrt((self.problem.v1 @ self.problem.v1 + self.problem.v2 @ self.problem.v2) / 6.0)
        )

    def truth(self) -> Array:
        """The unknowns (P,) of the true gyro corrections and velocities, at the start's pose."""
        problem = self.problem
        x = np.zeros(19 if self.velocity_spread > 0.0 else 13)
        x[_GYRO] = np.concatenate(
            [problem.w1 - problem.measured_rate1, problem.w2 - problem.measured_rate2]
        )
        if self.velocity_spread > 0.0:
            x[_VELOCITY] = np.concatenate([problem.v1, problem.v2])
        return x

    def residuals(self, x: Values) -> Values:
        """Residuals (M, K) in sigmas at each column of x (P, K)."""
        problem = self.problem
        spread = self.velocity_spread
        use = ~problem.is_outlier
        R, t, gravity = pose_at(self.start, x)
        gravity2 = np.einsum('jik,jk->ik', R, gravity)
        gyro = x[_GYRO]
        velocity = x[_VELOCITY] if spread > 0.0 else np.zeros_like(gyro)
        errors = _sampson(
            problem.points1[use],
            problem.points2[use],
            R,
            t,
            problem.measured_rate1[:, None] + gyro[:3],
            problem.measured_rate2[:, None] + gyro[3:],
            velocity[:3],
            velocity[3:],
        )
        parts = [
            errors / self.pixel_sigma,
            _tangent(problem.measured_gravity1).T @ gravity / self.gravity_sigma,
            _tangent(problem.measured_gravity2).T @ gravity2 / self.gravity_sigma,
            gyro / self.gyro_sigma,
        ]
        if spread > 0.0:
            parts.append(velocity / spread)
        return np.concatenate(parts)

    def jacobian(self, x: Array) -> Array:
        """Derivatives (M, P) at x (P,), exact to the last digits: no difference is formed."""
        columns = x[:, None] + 1j * _STEP * np.eye(len(x))
        return np.imag(self.residuals(columns)) / _STEP


def oracle_estimate(
    problem: TwoViewProblem,
    pixel_sigma: float,
    gravity_sigma: float,
    gyro_sigma: float,
    start: tuple[Array, Array] | None = None,
) -> OracleEstimate:
    """The oracle's estimate of a problem; `start`: pose to start from instead of the truth."""
    R, t = (problem.R, problem.t) if start is None else start
    objective = Objective(
        problem, pixel_sigma, gravity_sigma, gyro_sigma, start_at(R, t, problem.gravity1)
    )
    x = np.array(
        least_squares(
            lambda x: objective.residuals(x[:, None])[:, 0],
            objective.truth(),
            jac=objective.jacobian,
            method='lm',
            x_scale='jac',
            xtol=1e-12,
            ftol=1e-12,
            gtol=1e-12,
        ).x
    )
    R, t, gravity = pose_at(objective.start, x[:, None])
    # Linearised again at the optimum, where the unknowns of the pose are a rotation and a tangent.
    optimum = start_at(R[:, :, 0], t[:, 0], gravity[:, 0])
    x[_POSE], x[_GRAVITY] = 0.0, 0.0
    slopes = replace(objective, start=optimum).jacobian(x)
    pose = np.linalg.inv(slopes.T @ slopes)[_POSE, _POSE]
    lift = np.zeros((6, 5))
    lift[:3, 3:] = optimum.tangent
    lift[3:, :3] = np.eye(3)
    return OracleEstimate(optimum.R, optimum.t, lift @ pose @ lift.T)


def pose_at(origin: Start, x: Values) -> tuple[Values, Values, Values]:
    """R (3, 3, K), t (3, K) and gravity in camera 1 (3, K) at each column of x (P, K)."""
    turn = x[:3]
    series = _series(turn, np.ones(1))
    columns = [_rotate(turn, column[:, None, None], series)[:, :, 0] for column in origin.R.T]
    R = np.stack(columns, axis=1)
    t = origin.t[:, None] + origin.tangent @ x[3:5]
    gravity = origin.gravity[:, None] + origin.gravity_tangent @ x[_GRAVITY]
    return R, _directions(t), _directions(gravity)


def _directions(vectors: Values) -> Values:
    """Columns (3, K) scaled to length 1; also of a complex step."""
    return vectors / np.sqrt((vectors * vectors).sum(axis=0))


def _sampson(
    points1: Array,
    points2: Array,
    R: Values,
    t: Values,
    w1: Values,
    w2: Values,
    v1: Values,
    v2: Values,
) -> Values:
    """Signed Sampson errors (N, K) [px] of the uniform rolling-shutter model.

    `R` is (3, 3, K); `t`, `w1`, `w2`, `v1`, `v2` are (3, K).
    """
    (f1, f1_u, f1_v), tau1 = _derotated(points1, w1)
    (f2, f2_u, f2_v), tau2 = _derotated(points2, w2)
    f2, f2_u, f2_v = (np.einsum('ijk,jkn->ikn', R, f) for f in (f2, f2_u, f2_v))
    d1 = v1[:, :, None]
    d2 = np.einsum('ijk,jk->ik', R, v2)[:, :, None]
    baseline = t[:, :, None] + tau2 * d2 - tau1 * d1
    normal = _cross(f1, f2)
    e = _dot(normal, baseline)
    towards1 = _cross(f2, baseline)
    towards2 = _cross(baseline, f1)
    e_u1 = _dot(towards1, f1_u)
    e_v1 = _dot(towards1, f1_v) - LINE_DELAY * _dot(normal, d1)
    e_u2 = _dot(towards2, f2_u)
    e_v2 = _dot(towards2, f2_v) + LINE_DELAY * _dot(normal, d2)
    gradient_square = e_u1 * e_u1 + e_v1 * e_v1 + e_u2 * e_u2 + e_v2 * e_v2
    return (e / np.sqrt(gradient_square)).T


def _derotated(points: Array, w: Values) -> tuple[tuple[Values, Values, Values], Array]:
    """Derotated rays (3, K, N), their derivatives by u and v, and row times (N,)."""
    tau = LINE_DELAY * points[:, 1]
    x = (points[:, 0] - CENTRE_U) / FOCAL
    y = (points[:, 1] - CENTRE_V) / FOCAL
    m = np.stack([x, y, np.ones(len(points))])[:, None]
    along_u = np.array([1.0, 0.0, 0.0]) / FOCAL
    along_v = np.array([0.0, 1.0, 0.0]) / FOCAL
    series = _series(w, tau)
    f = _rotate(w, m, series)
    f_u = _rotate(w, along_u[:, None, None], series)
    # A row further down is a line delay later: d/dtau Exp(w tau) m = w x Exp(w tau) m.
    f_v = _rotate(w, along_v[:, None, None], series) + LINE_DELAY * _cross(w[:, :, None], f)
    return (f, f_u, f_v), tau


def _series(w: Values, tau: Array) -> tuple[Values, Values]:
    """``sin(|w| tau) / |w|`` and ``(1 - cos(|w| tau)) / |w|^2`` (K, N) for w (3, K), tau (N,).

    As power series: analytic for a complex step, and exact to rounding below 1 rad.
    """
    square = (w * w).sum(axis=0)[:, None] * (tau * tau)
    sine_term = np.broadcast_to(tau, square.shape)
    cosine_term = 0.5 * tau * sine_term
    sine = sine_term
    cosine = cosine_term
    for k in range(1, 9):
        sine_term = -sine_term * square / ((2 * k) * (2 * k + 1))
        cosine_term = -cosine_term * square / ((2 * k + 1) * (2 * k + 2))
        sine = sine + sine_term
        cosine = cosine + cosine_term
    return sine, cosine


def _rotate(w: Values, m: Array, series: tuple[Values, Values]) -> Values:
    """``Exp(w tau) m`` (3, K, N) for w (3, K), m (3, 1, 1 or N) and the `_series` of w and tau."""
    once = _cross(w[:, :, None], m)
    return m + series[0] * once + series[1] * _cross(w[:, :, None], once)


def _cross(a: Values, b: Values) -> Values:
    return np.stack(
        [a[1] * b[2] - a[2] * b[1], a[2] * b[0] - a[0] * b[2], a[0] * b[1] - a[1] * b[0]]
    )


def _dot(a: Values, b: Values) -> Values:
    return a[0] * b[0] + a[1] * b[1] + a[2] * b[2]


def _tangent(direction: Array) -> Array:
    """Two orthonormal columns (3, 2) perpendicular to a direction."""
    return np.linalg.svd(direction[None])[2][1:].T
