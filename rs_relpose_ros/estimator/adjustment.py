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

Tracks are evaluated in blocks as in `sampson`; products are by BLAS, blocks too small for threads.
"""

import math
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from rs_relpose_ros.core.least_squares import (
    damped_step,
    factor_groups,
    inverse,
    solve_lower_groups,
    solve_upper_groups,
)
from rs_relpose_ros.core.losses import cauchy_cost, cauchy_weight
from rs_relpose_ros.core.triangulate import scaled_depths
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

Flags = NDArray[np.bool_]

# First unknown: two steps of t in its tangent plane, log k, b, e_0, e_1, ...; then phi of the
# frames 1, 2, ...
TANGENT, LOG_SCALE, BIAS, ACCELERATION, MOST_ACCELERATIONS = 0, 2, 3, 6, 3
# Tracks of a block. First row of an observation in it: unit ray in the axes of its frame's
# reference row, derivatives of the pixel's two coordinates by the ray [px], s [s], S(s) [m].
BLOCK = 64
RAY, TO_PIXELS, TIME, MOVED, VALUES = 0, 3, 9, 10, 13
# First row of the unknowns of a track: f, two columns across the ray of frame 1, along which it
# moves, and rho times the length of f.
DIRECTION, COLUMNS, INVERSE_DISTANCE, TRACK_VALUES = 0, 3, 9, 10
# Unknowns of a track: two steps of its direction, and its inverse distance.
_TRACK = 3
# First row of an observation's derivatives: by its track, residual, by phi of its frame, by the
# path.
_RESIDUAL, _PHI, _PATH = 3, 4, 7
_ROWS = _PATH + ACCELERATION + 3 * MOST_ACCELERATIONS
# Weak priors keep a track without parallax regular: its inverse distance [1/baselines] is zero
# within this sigma, and a floor of its normal equations.
_INVERSE_DISTANCE_SIGMA, _FLOOR = 10.0, 1e-9
# Largest number of steps, decrease of the cost at which they end, largest step of log k.
_STEPS, _CONVERGED, _LARGEST_STEP = 6, 0.5, 1.0
_FIRST_DAMPING = 1e-7
# Distance [sigma] beyond which an observation is far from its prediction.
_FARTHEST = 4.0
# Sine squared of the parallax below which the distance of a track starts at a small value.
_PARALLEL, _FAR = 1e-8, 1e-2
# Error of a track that its residuals do not show, since it is similar in all frames [px].
_COMMON_SIGMA = 0.06
# Mean of ``r^2 / (1 + r^2 / 4)`` for Gaussian noise in two coordinates.
_GAUSSIAN = 1.109


class TrackBlocks(NamedTuple):
    """Observations of N tracks in V frames, in blocks; those not used are zero."""

    observations: Array  # (V, blocks, VALUES, BLOCK)
    used: Flags  # (V, blocks, BLOCK)
    rotations: Array  # (V, 3, 3) R_v by the gyro
    duration: float  # T [s]
    number: int  # N


@kernel
def fill_view(
    tracks: TrackBlocks,
    v: int,
    used: Flags,
    rays: Array,
    jacobian: Array,
    times: Array,
    rotations: Array,
    row_rotation: Array,
    interval: float,
    alpha: Array,
    beta: Array,
    acceleration: Array,
    arm: Array,
    chord: Array,
) -> None:
    """Fill the observations of view v: derotated rays, and the displacement by the IMU.

    `rotations` (N, 3, 3) of the rows, `row_rotation` (3,) from one row to the next [rad].
    """
    R, J = tracks.rotations[v], np.empty((3, 2))
    for i in range(len(rays)):
        if not used[i]:
            continue
        b, k = i // BLOCK, i % BLOCK
        tracks.used[v, b, k] = True
        E, tau, o = rotations[i], times[i], tracks.observations[v, b]
        ray, turned = rotated(E, rays[i]), rotated(R, rotated(E, arm))
        for m in range(2):
            column = rotated(E, jacobian[i, :, m])
            J[0, m], J[1, m], J[2, m] = column
        # One row further down, the camera has rotated on.
        further = cross(row_rotation, ray)
        # Pseudo-inverse of the (3, 2) derivative: (J^T J)^-1 J^T.
        uu = uv = vv = 0.0
        for x in range(3):
            J[x, 1] += further[x]
            uu += J[x, 0] * J[x, 0]
            uv += J[x, 0] * J[x, 1]
            vv += J[x, 1] * J[x, 1]
        determinant, time = uu * vv - uv * uv, interval + tau
        o[TIME, k] = time
        for x in range(3):
            o[RAY + x, k] = ray[x]
            o[TO_PIXELS + x, k] = (vv * J[x, 0] - uv * J[x, 1]) / determinant
            o[TO_PIXELS + 3 + x, k] = (uu * J[x, 1] - uv * J[x, 0]) / determinant
            o[MOVED + x, k] = (
                alpha[x]
                + tau * beta[x]
                + 0.5 * tau * tau * acceleration[x]
                - turned[x]
                + arm[x]
                - time / tracks.duration * chord[x]
            )


class PathPriors(NamedTuple):
    """Gaussian priors; weights are inverse variances. Those of e and b have zero mean."""

    log_scale: float  # mean of log k
    log_scale_weight: float
    bias_weight: float
    acceleration_weights: Array  # (K,) of e_0, e_1, ...
    rotation_information: Array  # (3 V - 3, 3 V - 3) of phi_1, phi_2, ...


class PathState(NamedTuple):
    """The unknowns."""

    t: Array  # (3,) unit
    log_scale: float  # log k
    bias: Array  # (3,) b
    accelerations: Array  # (K, 3) e
    rotations: Array  # (V, 3) phi
    tracks: Array  # (blocks, TRACK_VALUES, BLOCK)


@kernel
def start_of_tracks(tracks: TrackBlocks, R: Array, t: Array) -> Array:
    """Tracks of a state (blocks, TRACK_VALUES, BLOCK) by their first and last rays.

    Columns across a ray: Duff et al., "Building an Orthonormal Basis, Revisited" (JCGT 6, 2017).
    """
    first, last = tracks.observations[0], tracks.observations[-1]
    out = np.zeros((len(first), TRACK_VALUES, BLOCK))
    for b in range(len(first)):
        for i in range(BLOCK):
            x, y, z = first[b, RAY, i], first[b, RAY + 1, i], first[b, RAY + 2, i]
            if not tracks.used[0, b, i]:  # no observation of it counts
                z = 1.0
            sign = math.copysign(1.0, z)
            a = -1.0 / (sign + z)
            track, f = out[b], (x, y, z)
            for k in range(3):
                track[DIRECTION + k, i] = f[k]
            columns = (
                1.0 + sign * x * x * a,
                sign * x * y * a,
                -sign * x,
                x * y * a,
                sign + y * y * a,
                -y,
            )
            for k in range(6):
                track[COLUMNS + k, i] = columns[k]
            h = rotated(R, (last[b, RAY, i], last[b, RAY + 1, i], last[b, RAY + 2, i]))
            along_f, along_h, squared = scaled_depths(f, h, (t[0], t[1], t[2]))
            usable = squared > _PARALLEL and along_f > 0.0 and along_h > 0.0
            track[INVERSE_DISTANCE, i] = squared / along_f if usable else _FAR
    return out


class Normal(NamedTuple):
    """Normal equations of the path (n,), the tracks eliminated.

    `of_priors`: their cost. `hessian` (n, n); `tracks` (blocks, n + 1, 3, BLOCK): products of a
    track's unknowns with the path and with its residuals, solved by the Cholesky `factors`
    (blocks, 3, 3, BLOCK) of its own equations. `scatter` (n, n): of the tracks' parts of the
    gradient. `squares` (V, blocks, BLOCK): of the residuals [px^2].
    """

    of_priors: float
    hessian: Array
    gradient: Array
    tracks: Array
    factors: Array
    scatter: Array
    squares: Array


class Adjusted(NamedTuple):
    """An adjusted state, the noise of an observation [px], the covariance (n, n) of the path."""

    state: PathState
    sigma: float
    covariance: Array
    far: Flags  # (V, blocks, BLOCK) observations far from their predictions


@small_kernel
def _bends(s: float, T: float) -> tuple[float, float, float]:
    """``B_j(s)`` of the polynomials 1, 2 x - 1 and 6 x^2 - 6 x + 1 of ``x = s / T``."""
    x = s / T
    return (
        0.5 * T * T * (x * x - x),
        T * T * x * (x * x / 3.0 - 0.5 * x + 1.0 / 6.0),
        0.5 * T * T * x * x * (x * x - 2.0 * x + 1.0),
    )


@small_kernel
def _observe(
    o: Array,
    track: Array,
    R: Array,
    basis: Array,
    motion: Array,
    k: float,
    T: float,
    variance: float,
    moves: float,
    rows: Array,
    squares: Array,
) -> None:
    """Derivatives (_ROWS, 2, BLOCK) of a block's observations, times the roots of their weights.

    `o`, `track`: blocks of `TrackBlocks` and of `PathState`; R of the frame; `motion` (5, 3): t,
    bias and accelerations; `variance`: of the noise; `moves`: 0 for the first frame, whose phi is
    zero.
    """
    for i in range(BLOCK):
        s, rho = o[TIME, i], track[INVERSE_DISTANCE, i]
        share, bends = s / T, _bends(s, T)
        moved = (o[MOVED, i], o[MOVED + 1, i], o[MOVED + 2, i])
        for j in range(MOST_ACCELERATIONS):
            e = 2 + j
            moved = (
                moved[0] + bends[j] * motion[e, 0],
                moved[1] + bends[j] * motion[e, 1],
                moved[2] + bends[j] * motion[e, 2],
            )
        path = (
            share * motion[0, 0] + k * moved[0],
            share * motion[0, 1] + k * moved[1],
            share * motion[0, 2] + k * moved[2],
        )
        before = (
            track[0, i] - rho * path[0],
            track[1, i] - rho * path[1],
            track[2, i] - rho * path[2],
        )
        # Exp(s b) to first order: b is that of a calibrated gyro.
        turn = cross(motion[1], before)
        away = (before[0] - s * turn[0], before[1] - s * turn[1], before[2] - s * turn[2])
        ahead = rotated_back(R, away)
        scale = 1.0 / norm(ahead)
        ray = (scale * ahead[0], scale * ahead[1], scale * ahead[2])
        off = (ray[0] - o[RAY, i], ray[1] - o[RAY + 1, i], ray[2] - o[RAY + 2, i])
        squares[i] = 0.0
        for m in range(2):
            a, b, c = TO_PIXELS + 3 * m, TO_PIXELS + 3 * m + 1, TO_PIXELS + 3 * m + 2
            rows[_RESIDUAL, m, i] = o[a, i] * off[0] + o[b, i] * off[1] + o[c, i] * off[2]
            squares[i] += rows[_RESIDUAL, m, i] * rows[_RESIDUAL, m, i]
        root = 1.0 / math.sqrt(variance + 0.25 * squares[i])
        for m in range(2):
            rows[_RESIDUAL, m, i] *= root
            a, b, c = TO_PIXELS + 3 * m, TO_PIXELS + 3 * m + 1, TO_PIXELS + 3 * m + 2
            along, size = o[a, i] * ray[0] + o[b, i] * ray[1] + o[c, i] * ray[2], root * scale
            # Derivative by `away`, in the axes of camera 1.
            u = rotated(
                R,
                (
                    size * (o[a, i] - along * ray[0]),
                    size * (o[b, i] - along * ray[1]),
                    size * (o[c, i] - along * ray[2]),
                ),
            )
            by_path, turned = (-rho * u[0], -rho * u[1], -rho * u[2]), cross(u, away)
            rows[2, m, i] = -dot(u, path)
            rows[_PATH + LOG_SCALE, m, i] = k * dot(by_path, moved)
            for x in range(2):
                a, b, c = COLUMNS + 3 * x, COLUMNS + 3 * x + 1, COLUMNS + 3 * x + 2
                rows[x, m, i] = u[0] * track[a, i] + u[1] * track[b, i] + u[2] * track[c, i]
                rows[_PATH + x, m, i] = share * (
                    by_path[0] * basis[0, x] + by_path[1] * basis[1, x] + by_path[2] * basis[2, x]
                )
            for x in range(3):
                rows[_PHI + x, m, i] = moves * turned[x]
                rows[_PATH + BIAS + x, m, i] = s * turned[x]
                for j in range(MOST_ACCELERATIONS):
                    rows[_PATH + ACCELERATION + 3 * j + x, m, i] = k * bends[j] * by_path[x]


@small_kernel
def _accumulate(
    rows: Array, places: NDArray[np.int64], gram: Array, own: Array, mixed: Array, whole: Array
) -> None:
    """Add a block of one frame to the equations.

    Of its tracks: `own` (3, 3, BLOCK), lower triangles; `mixed` (n + 1, 4, BLOCK) products of the
    unknowns `places` (M,) of `rows`, from the residual on, with those of the track and with the
    residual. `whole` (n + 1, n + 1): of the path, with `gram` (M, M) as room.
    """
    used = rows.reshape(_ROWS, 2 * BLOCK)[_RESIDUAL : _RESIDUAL + len(places)]
    np.dot(used, used.T, gram)
    for y in range(len(places)):
        for x in range(len(places)):
            whole[places[y], places[x]] += gram[y, x]
    for y in range(_TRACK):
        for x in range(y + 1):
            for i in range(BLOCK):
                own[y, x, i] += rows[y, 0, i] * rows[x, 0, i] + rows[y, 1, i] * rows[x, 1, i]
    for x in range(len(places)):
        for y in range(_TRACK + 1):
            row, other, to = rows[_RESIDUAL + x], rows[y], mixed[places[x], y]
            for i in range(BLOCK):
                to[i] += row[0, i] * other[0, i] + row[1, i] * other[1, i]


@small_kernel
def _eliminate(own: Array, rho: Array, mixed: Array, factors: Array, solved: Array) -> None:
    """Write Cholesky `factors` L (3, 3, BLOCK) of the tracks' equations and ``L^-1 mixed``.

    What is left of the products with the residual is the track's part of the gradient.
    """
    n, weight = len(mixed) - 1, _INVERSE_DISTANCE_SIGMA**-2
    for i in range(BLOCK):
        mixed[n, 2, i] += weight * rho[i]
        own[2, 2, i] += weight
        for x in range(_TRACK):
            own[x, x, i] += _FLOOR
    factor_groups(own, factors)
    for x in range(n, -1, -1):  # the residual first
        solve_lower_groups(factors, mixed[x, :_TRACK], solved[x])
        for y in range(_TRACK):
            for i in range(BLOCK):
                mixed[x, _TRACK, i] -= solved[x, y, i] * solved[n, y, i]


@kernel
def _add_priors(state: PathState, priors: PathPriors, hessian: Array, gradient: Array) -> float:
    """Add the priors to the path's equations; their part of the cost, with that of the tracks."""
    away = state.log_scale - priors.log_scale
    hessian[LOG_SCALE, LOG_SCALE] += priors.log_scale_weight
    gradient[LOG_SCALE] += priors.log_scale_weight * away
    cost = priors.log_scale_weight * away * away
    for x in range(3):
        hessian[BIAS + x, BIAS + x] += priors.bias_weight
        gradient[BIAS + x] += priors.bias_weight * state.bias[x]
        cost += priors.bias_weight * state.bias[x] ** 2
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
            hessian[first + y, first + x] += priors.rotation_information[y, x]
        gradient[first + y] += product
        cost += product * phi[y]
    for b in range(len(state.tracks)):
        for i in range(BLOCK):
            cost += (state.tracks[b, INVERSE_DISTANCE, i] / _INVERSE_DISTANCE_SIGMA) ** 2
    return cost


@kernel
def linearised(tracks: TrackBlocks, priors: PathPriors, state: PathState, sigma: float) -> Normal:
    """Normal equations about a state, with the noise `sigma` [px]."""
    V, blocks, _ = tracks.used.shape
    path = ACCELERATION + 3 * len(state.accelerations)
    n = path + 3 * (V - 1)
    basis, k, motion = tangent_basis(state.t), math.exp(state.log_scale), np.zeros((5, 3))
    copy_vector(state.t, motion[0])
    copy_vector(state.bias, motion[1])
    copy_matrix(state.accelerations, motion[2:])
    rotations = np.empty((V, 3, 3))
    for v in range(V):
        copy_matrix(exp_so3(state.rotations[v]) @ tracks.rotations[v], rotations[v])
    # Unknowns of the rows from the residual on; n is the residual: its products are the gradient.
    places = np.arange(_PATH - _RESIDUAL + path) - (_PATH - _RESIDUAL)
    places[0] = n
    rows, gram = np.empty((_ROWS, 2, BLOCK)), np.empty((len(places), len(places)))
    squares, factors = np.empty((V, blocks, BLOCK)), np.empty((blocks, _TRACK, _TRACK, BLOCK))
    solved, scores = np.empty((blocks, n + 1, _TRACK, BLOCK)), np.empty((n, BLOCK))
    whole, scatter, sums = np.zeros((n + 1, n + 1)), np.zeros((n, n)), np.empty((n + 1, n + 1))
    product = np.empty((n, n))
    for b in range(blocks):
        own = np.zeros((_TRACK, _TRACK, BLOCK))
        mixed = np.zeros((n + 1, _TRACK + 1, BLOCK))
        for v in range(V):
            _observe(
                tracks.observations[v, b],
                state.tracks[b],
                rotations[v],
                basis,
                motion,
                k,
                tracks.duration,
                sigma * sigma,
                min(v, 1),
                rows,
                squares[v, b],
            )
            for x in range(3):
                places[_PHI - _RESIDUAL + x] = path + 3 * max(v - 1, 0) + x
            _accumulate(rows, places, gram, own, mixed, whole)
        _eliminate(own, state.tracks[b, INVERSE_DISTANCE], mixed, factors[b], solved[b])
        flat = solved[b].reshape(n + 1, _TRACK * BLOCK)
        np.dot(flat, flat.T, sums)
        copy_matrix(mixed[:n, _TRACK], scores)
        np.dot(scores, scores.T, product)
        for y in range(n + 1):
            for x in range(n + 1):
                whole[y, x] -= sums[y, x]
                if y < n and x < n:
                    scatter[y, x] += product[y, x]
    hessian, gradient = whole[:n, :n].copy(), whole[n, :n].copy()
    of_priors = _add_priors(state, priors, hessian, gradient)
    return Normal(of_priors, hessian, gradient, solved, factors, scatter, squares)


@kernel
def _cost(normal: Normal, tracks: TrackBlocks, sigma: float) -> tuple[float, float]:
    """Cost with the noise `sigma` [px], and the noise by these residuals, once iterated."""
    cost, weighted, count = normal.of_priors, 0.0, 0
    used, squares = tracks.used.ravel(), normal.squares.ravel()
    for i in range(len(used)):
        if used[i]:
            q = 0.25 * squares[i] / (sigma * sigma)
            cost += 4.0 * cauchy_cost(q)
            weighted += 4.0 * q * cauchy_weight(q)
            count += 1
    return cost, weighted / count


@kernel
def moved_state(state: PathState, normal: Normal, step: Array) -> PathState:
    """The state after a step (n,) of the path, each track moved with it."""
    n, basis, t = len(step), tangent_basis(state.t), np.empty(3)
    for x in range(3):
        t[x] = state.t[x] + basis[x, 0] * step[TANGENT] + basis[x, 1] * step[TANGENT + 1]
    length, bias = norm(t), state.bias.copy()
    accelerations, rotations = state.accelerations.copy(), state.rotations.copy()
    for x in range(3):
        t[x] /= length
        bias[x] += step[BIAS + x]
        for j in range(len(accelerations)):
            accelerations[j, x] += step[ACCELERATION + 3 * j + x]
        for v in range(1, len(rotations)):
            # Exp is additive to first order: phi is as small as the gyro's error.
            rotations[v, x] += step[n - 3 * (len(rotations) - v) + x]
    tracks, own = state.tracks.copy(), np.empty((_TRACK, BLOCK))
    for b in range(len(tracks)):
        track, L, solved = tracks[b], normal.factors[b], normal.tracks[b]
        for y in range(_TRACK):
            for i in range(BLOCK):
                own[y, i] = solved[n, y, i]
            for x in range(n):
                for i in range(BLOCK):
                    own[y, i] += solved[x, y, i] * step[x]
        solve_upper_groups(L, own)
        for i in range(BLOCK):
            for x in range(3):
                track[x, i] -= (
                    own[0, i] * track[COLUMNS + x, i] + own[1, i] * track[COLUMNS + 3 + x, i]
                )
            track[INVERSE_DISTANCE, i] -= own[2, i]
    return PathState(t, state.log_scale + step[LOG_SCALE], bias, accelerations, rotations, tracks)


@kernel
def _step(normal: Normal, damping: float) -> Array:
    """Step (n,) of the path; zero if the equations are singular."""
    step, _ = damped_step(normal.hessian, normal.gradient, damping)
    step[LOG_SCALE] = min(max(step[LOG_SCALE], -_LARGEST_STEP), _LARGEST_STEP)
    return step


@kernel
def adjust(
    tracks: TrackBlocks, priors: PathPriors, start: PathState, expected: float, weight: float
) -> Adjusted:
    """Levenberg-Marquardt over path and tracks, the noise estimated again after each step.

    `expected` [px]: noise, which counts as much as `weight` degrees of freedom.
    """
    observations = 2.0 * tracks.used.sum()
    state, sigma, noise, damping = start, expected, expected, _FIRST_DAMPING
    normal = linearised(tracks, priors, state, sigma)
    freedom = max(observations - _TRACK * tracks.number - len(normal.gradient), 1.0)
    for _ in range(_STEPS):
        # Residuals of fewer degrees of freedom than observations, weighted as in the cost.
        variance = sigma * sigma * _cost(normal, tracks, sigma)[1] / _GAUSSIAN
        noise = math.sqrt(
            (weight * expected * expected + observations * variance) / (weight + freedom)
        )
        sigma = math.hypot(noise, _COMMON_SIGMA)
        after = moved_state(state, normal, _step(normal, damping))
        new = linearised(tracks, priors, after, sigma)
        gain = _cost(normal, tracks, sigma)[0] - _cost(new, tracks, sigma)[0]
        if gain > 0.0:  # False for NaN
            state, normal, damping = after, new, 0.1 * damping
            if gain < _CONVERGED:
                break
        else:
            damping = max(100.0 * damping, 1e-4)
    return Adjusted(
        state,
        noise,
        _covariance(normal, state, priors, (sigma / noise) ** 2, tracks.number),
        normal.squares > (_FARTHEST * sigma) ** 2,
    )


@kernel
def _covariance(
    normal: Normal, state: PathState, priors: PathPriors, common: float, count: int
) -> Array:
    """Of the path (n, n), with the scatter of the tracks' gradients (sandwich), times `common`.

    The errors of one track in consecutive frames are similar, those of the `count` tracks are not.
    """
    n = len(normal.gradient)
    scatter = common * count / max(count - n / _TRACK, 1.0) * normal.scatter
    _add_priors(state, priors, scatter, np.zeros(n))
    covariance = inverse(normal.hessian)
    return covariance @ scatter @ covariance
