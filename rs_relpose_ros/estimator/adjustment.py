"""Adjustment of the tracks in all frames of a pair, with the path of the camera by the IMU.

In the axes of camera 1 at its reference row, which is the origin, with the baseline as unit of
length and s from 0 at that row to T at the reference row of the last frame::

    p(s)  = s/T t + k (S(s) + sum_j e_j B_j(s))            |t| = 1, p(0) = 0, p(T) = t
    R(s)  = Exp(s b + phi_v) R_v E_v(s)
    u     ~ R(s)^T (f_i - rho_i p(s))                      observation of track i in frame v at s

k is the inverse of the baseline [1/m], S the measured acceleration integrated twice, less its
chord [m], e_j the acceleration that is not in S [m/s^2]: e_0 alone, a constant, is the error of
gravity and accelerometer; without accelerometer it is a sum of three Legendre polynomials. The B_j
are their double integrals, zero at both ends. b is the error of the gyro's bias, phi_v that of its
rotation R_v between the reference rows (phi_0 = 0), E_v the gyro within the frame.
Each track has a direction f_i (its observation in frame 1 has noise, too) and an inverse distance
rho_i, which are eliminated (Schur complement). An observation has the robust cost
``4 log(1 + r^2 / 4)``, r being its distance from the prediction in units of the noise.
"""

import math
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from rs_relpose_ros.estimator.priors import inverse
from rs_relpose_ros.geometry import Array
from rs_relpose_ros.geometry.so3 import (
    copy_matrix,
    copy_vector,
    cross,
    dot,
    exp_so3,
    norm,
    rotated,
    rotated_back,
    tangent_basis,
)
from rs_relpose_ros.jit import kernel, small_kernel
from rs_relpose_ros.solvers.algebra import cholesky, newton_step

Flags = NDArray[np.bool_]

# First unknown: two steps of t in its tangent plane, log k, b, e_0, e_1, ...; then phi of the
# frames 1, 2, ...
TANGENT, LOG_SCALE, BIAS, ACCELERATION, MOST_ACCELERATIONS = 0, 2, 3, 6, 3
# Of a track: two steps of its direction, and its inverse distance.
_TRACK = 3
# Weak priors keep a track without parallax regular: its inverse distance [1/baselines] is zero
# within this sigma, and a floor of its normal equations.
_INVERSE_DISTANCE_SIGMA, _FLOOR = 10.0, 1e-9
# Largest number of steps, decrease of the cost at which they end, largest step of log k.
_STEPS, _CONVERGED, _LARGEST_STEP = 5, 0.5, 1.0
_FIRST_DAMPING = 1e-4
# Error of a track that its residuals do not show, since it is similar in all frames [px].
_COMMON_SIGMA = 0.06
# Mean of ``r^2 / (1 + r^2 / 4)`` for Gaussian noise in two coordinates.
_GAUSSIAN = 1.109


class Tracks(NamedTuple):
    """Observations of N tracks in V frames; `used` where there is one."""

    rays: Array   # (V, N, 3) unit, in the axes of each frame's reference row
    to_pixels: Array   # (V, N, 2, 3) derivatives of the pixel by the ray [px]
    times: Array   # (V, N) s [s]
    moved: Array   # (V, N, 3) S(s) [m]
    used: Flags   # (V, N)
    rotations: Array   # (V, 3, 3) R_v by the gyro
    duration: float   # T [s]


class PathPriors(NamedTuple):
    """Gaussian priors; weights are inverse variances. Those of e and b have zero mean."""

    log_scale: float   # mean of log k
    log_scale_weight: float
    bias_weight: float
    acceleration_weights: Array   # (K,) of e_0, e_1, ...
    rotation_information: Array   # (3 V - 3, 3 V - 3) of phi_1, phi_2, ...


class PathState(NamedTuple):
    """The unknowns."""

    t: Array   # (3,) unit
    log_scale: float   # log k
    bias: Array   # (3,) b
    accelerations: Array   # (K, 3) e
    rotations: Array   # (V, 3) phi
    directions: Array   # (N, 3) f, unit
    inverse_distances: Array   # (N,) rho


class Normal(NamedTuple):
    """Normal equations of the path (n,), the tracks eliminated.

    `of_priors`: their cost. `hessian` (n, n): its lower triangle. `tracks` (N, 3, n + 1): the
    solution of each track's equations for a step of the path and for its own gradient. `scores`
    (N, n): each track's part of the gradient. `squares` (V, N): of the residuals [px^2].
    """

    of_priors: float
    hessian: Array
    gradient: Array
    tracks: Array
    scores: Array
    squares: Array


class Adjusted(NamedTuple):
    """An adjusted state, the noise of an observation [px], the covariance (n, n) of the path."""

    state: PathState
    sigma: float
    covariance: Array


@small_kernel
def _bends(s: float, T: float) -> tuple[float, float, float]:
    """``B_j(s)`` of the polynomials 1, 2 x - 1 and 6 x^2 - 6 x + 1 of ``x = s / T``."""
    x = s / T
    return (0.5 * T * T * (x * x - x), T * T * x * (x * x / 3.0 - 0.5 * x + 1.0 / 6.0),
            0.5 * T * T * x * x * (x * x - 2.0 * x + 1.0))


@small_kernel
def _observe(tracks: Tracks, state: PathState, k: float, R: Array, basis: Array, v: int, i: int,
             columns: Array, jac: Array) -> tuple[float, float]:
    """Residual [px] of an observation; `jac` (2, 12 + 3 K) by its track, the path and phi_v.

    `R` (3, 3) of its frame; `columns` (3, 2): tangent basis of the track's direction.
    """
    s, T, rho = tracks.times[v, i], tracks.duration, state.inverse_distances[i]
    share, t, e, extra = s / T, state.t, state.accelerations, len(state.accelerations)
    own, f = tracks.moved[v, i], state.directions[i]
    bends = _bends(s, T)
    moved = (own[0] + bends[0] * e[0, 0], own[1] + bends[0] * e[0, 1],
             own[2] + bends[0] * e[0, 2])
    for j in range(1, extra):
        moved = (moved[0] + bends[j] * e[j, 0], moved[1] + bends[j] * e[j, 1],
                 moved[2] + bends[j] * e[j, 2])
    path = (share * t[0] + k * moved[0], share * t[1] + k * moved[1], share * t[2] + k * moved[2])
    before = (f[0] - rho * path[0], f[1] - rho * path[1], f[2] - rho * path[2])
    # Exp(s b) to first order: b is that of a calibrated gyro.
    turn = cross(state.bias, before)
    away = (before[0] - s * turn[0], before[1] - s * turn[1], before[2] - s * turn[2])
    ahead = rotated_back(R, away)
    scale = 1.0 / norm(ahead)
    ray = (scale * ahead[0], scale * ahead[1], scale * ahead[2])
    first = 0.0
    second = 0.0
    for m in range(2):
        P, row = tracks.to_pixels[v, i, m], jac[m]
        along = dot(P, ray)
        if m == 0:
            first = along - dot(P, tracks.rays[v, i])
        else:
            second = along - dot(P, tracks.rays[v, i])
        # Derivative by `away`, in the axes of camera 1.
        u = rotated(R, (scale * (P[0] - along * ray[0]), scale * (P[1] - along * ray[1]),
                        scale * (P[2] - along * ray[2])))
        by_path = (-rho * u[0], -rho * u[1], -rho * u[2])
        turned = cross(u, away)
        for x in range(2):
            row[x] = u[0] * columns[0, x] + u[1] * columns[1, x] + u[2] * columns[2, x]
            row[3 + x] = share * (by_path[0] * basis[0, x] + by_path[1] * basis[1, x]
                                  + by_path[2] * basis[2, x])
        row[2], row[5] = -dot(u, path), k * dot(by_path, moved)
        row[6], row[7], row[8] = s * turned[0], s * turned[1], s * turned[2]
        for j in range(extra):
            for x in range(3):
                row[9 + 3 * j + x] = k * bends[j] * by_path[x]
        for x in range(3):
            row[9 + 3 * extra + x] = turned[x]
    return first, second


@kernel
def _add(jac: Array, r: tuple[float, float], weight: float, v: int, own: Array,
         own_gradient: Array, mixed: Array, hessian: Array, gradient: Array) -> None:
    """Add an observation to the equations of its track and to those of the path.

    Of `hessian` the rows of a phi have the columns up to it.
    """
    path = jac.shape[1] - _TRACK - 3
    first = path + 3 * (v - 1)   # of phi_v
    u, w = jac[0], jac[1]
    for y in range(_TRACK):
        by_u, by_w = weight * u[y], weight * w[y]
        own_gradient[y] += by_u * r[0] + by_w * r[1]
        for x in range(_TRACK):
            own[y, x] += by_u * u[x] + by_w * w[x]
        for x in range(path):
            mixed[y, x] += by_u * u[_TRACK + x] + by_w * w[_TRACK + x]
        if v > 0:
            for x in range(3):
                mixed[y, first + x] += (by_u * u[_TRACK + path + x]
                                        + by_w * w[_TRACK + path + x])
    for y in range(path if v == 0 else path + 3):
        by_u, by_w = weight * u[_TRACK + y], weight * w[_TRACK + y]
        row = y if y < path else first + y - path
        gradient[row] += by_u * r[0] + by_w * r[1]
        for x in range(path):
            hessian[row, x] += by_u * u[_TRACK + x] + by_w * w[_TRACK + x]
        for x in range(path, y + 1):
            hessian[row, first + x - path] += by_u * u[_TRACK + x] + by_w * w[_TRACK + x]


@kernel
def _eliminate(own: Array, own_gradient: Array, mixed: Array, hessian: Array, gradient: Array,
               solved: Array) -> None:
    """Subtract a track from the path's equations; `solved` (3, n + 1) its own solutions."""
    n = len(gradient)
    c0, c1, c2 = cross(own[1], own[2]), cross(own[2], own[0]), cross(own[0], own[1])
    determinant = dot(own[0], c0)
    for y in range(3):
        # A row of the inverse of a symmetric matrix.
        a0, a1, a2 = c0[y] / determinant, c1[y] / determinant, c2[y] / determinant
        for x in range(n):
            solved[y, x] = a0 * mixed[0, x] + a1 * mixed[1, x] + a2 * mixed[2, x]
        solved[y, n] = a0 * own_gradient[0] + a1 * own_gradient[1] + a2 * own_gradient[2]
    for y in range(n):
        h0, h1, h2 = mixed[0, y], mixed[1, y], mixed[2, y]
        gradient[y] -= h0 * solved[0, n] + h1 * solved[1, n] + h2 * solved[2, n]
        for x in range(y + 1):
            hessian[y, x] -= h0 * solved[0, x] + h1 * solved[1, x] + h2 * solved[2, x]


@kernel
def _add_priors(state: PathState, priors: PathPriors, hessian: Array, gradient: Array) -> float:
    """Add the priors to the lower triangle of the path's equations; their part of the cost."""
    away = state.log_scale - priors.log_scale
    hessian[LOG_SCALE, LOG_SCALE] += priors.log_scale_weight
    gradient[LOG_SCALE] += priors.log_scale_weight * away
    cost = priors.log_scale_weight * away * away
    for x in range(3):
        hessian[BIAS + x, BIAS + x] += priors.bias_weight
        gradient[BIAS + x] += priors.bias_weight * state.bias[x]
        cost += priors.bias_weight * state.bias[x]**2
    first = ACCELERATION
    for j in range(len(state.accelerations)):
        for x in range(3):
            weighted = priors.acceleration_weights[j] * state.accelerations[j, x]
            hessian[first, first] += priors.acceleration_weights[j]
            gradient[first] += weighted
            cost += weighted * state.accelerations[j, x]
            first += 1
    phi = state.rotations.ravel()[3:]
    for y in range(len(phi)):
        product = 0.0
        for x in range(len(phi)):
            product += priors.rotation_information[y, x] * phi[x]
        for x in range(y + 1):
            hessian[first + y, first + x] += priors.rotation_information[y, x]
        gradient[first + y] += product
        cost += product * phi[y]
    return cost


@kernel
def linearised(tracks: Tracks, priors: PathPriors, state: PathState, sigma: float) -> Normal:
    """Normal equations about a state, with the noise `sigma` [px]."""
    V, N = tracks.used.shape
    path = ACCELERATION + 3 * len(state.accelerations)
    n = path + 3 * (V - 1)
    hessian, gradient, before = np.zeros((n, n)), np.zeros(n), np.zeros(n)
    solved, scores, squares = np.empty((N, _TRACK, n + 1)), np.empty((N, n)), np.zeros((V, N))
    own, own_gradient, mixed = np.empty((3, 3)), np.empty(3), np.empty((3, n))
    jac, basis = np.empty((2, _TRACK + path + 3)), tangent_basis(state.t)
    rotations, k = np.empty((V, 3, 3)), math.exp(state.log_scale)
    for v in range(V):
        copy_matrix(exp_so3(state.rotations[v]) @ tracks.rotations[v], rotations[v])
    for i in range(N):
        own[:], own_gradient[:], mixed[:] = 0.0, 0.0, 0.0
        columns = tangent_basis(state.directions[i])
        for v in range(V):
            if tracks.used[v, i]:
                r = _observe(tracks, state, k, rotations[v], basis, v, i, columns, jac)
                squares[v, i] = r[0] * r[0] + r[1] * r[1]
                weight = 1.0 / (sigma * sigma + 0.25 * squares[v, i])
                _add(jac, r, weight, v, own, own_gradient, mixed, hessian, gradient)
        own[2, 2] += _INVERSE_DISTANCE_SIGMA**-2
        own_gradient[2] += state.inverse_distances[i] * _INVERSE_DISTANCE_SIGMA**-2
        for y in range(_TRACK):
            own[y, y] += _FLOOR
        _eliminate(own, own_gradient, mixed, hessian, gradient, solved[i])
        for y in range(n):
            scores[i, y] = gradient[y] - before[y]
        copy_vector(gradient, before)
    of_priors = _add_priors(state, priors, hessian, gradient)
    for rho in state.inverse_distances:
        of_priors += (rho / _INVERSE_DISTANCE_SIGMA)**2
    return Normal(of_priors, hessian, gradient, solved, scores, squares)


@kernel
def _cost(normal: Normal, tracks: Tracks, sigma: float) -> tuple[float, float]:
    """Cost with the noise `sigma` [px], and the noise by these residuals, once iterated."""
    V, N = tracks.used.shape
    cost, weighted, count = normal.of_priors, 0.0, 0
    for v in range(V):
        for i in range(N):
            if tracks.used[v, i]:
                square = 0.25 * normal.squares[v, i] / (sigma * sigma)
                cost += 4.0 * math.log(1.0 + square)
                weighted += 4.0 * square / (1.0 + square)
                count += 1
    return cost, weighted / count


@small_kernel
def moved_state(state: PathState, step: Array, tracks: Array) -> PathState:
    """The state after a step (n,) of the path, each track moved with it (`Normal.tracks`)."""
    n, count = len(step), len(tracks)
    basis, t = tangent_basis(state.t), np.empty(3)
    for x in range(3):
        t[x] = state.t[x] + basis[x, 0] * step[TANGENT] + basis[x, 1] * step[TANGENT + 1]
    t /= norm(t)
    rotations = state.rotations.copy()
    for v in range(1, len(rotations)):
        for x in range(3):
            # Exp is additive to first order: phi is as small as the gyro's error.
            rotations[v, x] += step[n - 3 * (len(rotations) - v) + x]
    directions, inverse_distances = np.empty((count, 3)), np.empty(count)
    own = np.empty(_TRACK)
    for i in range(count):
        for y in range(_TRACK):
            own[y] = -tracks[i, y, n]
            for x in range(n):
                own[y] -= tracks[i, y, x] * step[x]
        columns, f = tangent_basis(state.directions[i]), directions[i]
        for x in range(3):
            f[x] = state.directions[i, x] + columns[x, 0] * own[0] + columns[x, 1] * own[1]
        length = norm(f)
        for x in range(3):
            f[x] /= length
        inverse_distances[i] = state.inverse_distances[i] + own[2]
    accelerations = state.accelerations.copy()
    for j in range(len(accelerations)):
        for x in range(3):
            accelerations[j, x] += step[ACCELERATION + 3 * j + x]
    return PathState(t, state.log_scale + step[LOG_SCALE], state.bias + step[BIAS:BIAS + 3],
                     accelerations, rotations, directions, inverse_distances)


@kernel
def _step(normal: Normal, damping: float) -> Array:
    """Step (n,) of the path; zero if the equations are singular."""
    n = len(normal.gradient)
    damped, factor = normal.hessian.copy(), np.zeros((n, n))
    for k in range(n):
        damped[k, k] *= 1.0 + damping
    if not cholesky(damped, factor):
        return np.zeros(n)
    step = newton_step(factor, normal.gradient)
    step[LOG_SCALE] = min(max(step[LOG_SCALE], -_LARGEST_STEP), _LARGEST_STEP)
    return step


@kernel
def adjust(tracks: Tracks, priors: PathPriors, start: PathState, expected: float,
           weight: float) -> Adjusted:
    """Levenberg-Marquardt over path and tracks, the noise estimated again after each step.

    `expected` [px]: noise, which counts as much as `weight` degrees of freedom.
    """
    N = tracks.used.shape[1]
    observations = 2.0 * tracks.used.sum()
    state, sigma, noise, damping = start, expected, expected, _FIRST_DAMPING
    normal = linearised(tracks, priors, state, sigma)
    freedom = max(observations - _TRACK * N - len(normal.gradient), 1.0)
    for _ in range(_STEPS):
        # Residuals of fewer degrees of freedom than observations, weighted as in the cost.
        variance = sigma * sigma * _cost(normal, tracks, sigma)[1] / _GAUSSIAN
        noise = math.sqrt((weight * expected * expected + observations * variance)
                          / (weight + freedom))
        sigma = math.hypot(noise, _COMMON_SIGMA)
        after = moved_state(state, _step(normal, damping), normal.tracks)
        new = linearised(tracks, priors, after, sigma)
        gain = _cost(normal, tracks, sigma)[0] - _cost(new, tracks, sigma)[0]
        if gain > 0.0:   # False for NaN
            state, normal, damping = after, new, 0.1 * damping
            if gain < _CONVERGED:
                break
        else:
            damping = max(100.0 * damping, 1e-2)
    return Adjusted(state, noise, _covariance(normal, state, priors, (sigma / noise)**2))


@kernel
def _covariance(normal: Normal, state: PathState, priors: PathPriors, common: float) -> Array:
    """Of the path (n, n), with the scatter of the tracks' gradients (sandwich), times `common`.

    The errors of one track in consecutive frames are similar, those of two tracks are not.
    """
    N, n = normal.scores.shape
    hessian, scatter = normal.hessian.copy(), np.zeros((n, n))
    _add_priors(state, priors, scatter, np.zeros(n))
    scale = common * N / max(N - n / _TRACK, 1.0)
    for i in range(N):
        for y in range(n):
            value = scale * normal.scores[i, y]
            for x in range(y + 1):
                scatter[y, x] += value * normal.scores[i, x]
    for y in range(n):
        for x in range(y):
            scatter[x, y], hessian[x, y] = scatter[y, x], hessian[y, x]
    covariance = inverse(hessian)
    return covariance @ scatter @ covariance
