"""Residuals of matches, and the normal equations of the calibration with the pairs eliminated.

Frame i sees row v at ``t_i(v) = stamp_i + offset + slope k_i + s(v) readout`` with
``s(v) = (v - middle row) / height``. With ``Q(t)`` the gyro's rotation and ``n = (x, y, 1)`` the
undistorted point, ``m_i = Q(t_i) R_imu_cam n_i`` is the ray in a frame that does not turn. Over a
short span the camera moves evenly, so that between any row of frame 1 and any row of frame 2 it
moves in the same direction b, and

    e = b . (m_1 x m_2) = 0,      r = e / |de / d(pixels)|                       [px]

with the exact derivative by all four pixel coordinates. How far the camera moves, and how far away
the points are, drops out. b is a unit vector for each pair, plus `bend` times s_1 + s_2 for a
change of velocity, and `turn`, what the gyro's noise turned frame 2 too little against frame 1;
both are small by their priors. All are eliminated. The prior of `bend` is in units of |b|, and
does not contain the read-out time: a read-out time that is too long gains no freedom by it.
"""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from rs_relpose_ros.calibrate.gyro_path import knot_before, rotation_at
from rs_relpose_ros.compiled import kernel
from rs_relpose_ros.geometry.so3 import exp_so3

Array = NDArray[np.float64]

# Order of the calibration's parameters: read-out [s], offset of the middle row [s], slope of the
# offset, rotation vector on the left of R_imu_cam (3) [rad], bias (3) [rad/s], log of the focal
# length.
READOUT, OFFSET, SLOPE, ROTATION, BIAS, FOCAL = 0, 1, 2, 3, 6, 9
GLOBAL = 10
# Of a pair: step of the direction in its tangent plane (2), bend (3), turn (3).
LOCAL = 8
_ALL = GLOBAL + LOCAL


@kernel
def _cross_into(a: Array, b: Array, out: Array) -> None:
    out[0] = a[1] * b[2] - a[2] * b[1]
    out[1] = a[2] * b[0] - a[0] * b[2]
    out[2] = a[0] * b[1] - a[1] * b[0]


@kernel
def tangents(b: Array, out: Array) -> None:
    """Two unit vectors (2, 3) at right angles to a unit vector (3,) and to each other."""
    i = 0
    for j in range(1, 3):
        if abs(b[j]) < abs(b[i]):
            i = j
    norm = math.sqrt(max(1.0 - b[i] ** 2, 1e-12))
    for j in range(3):
        out[0, j] = ((1.0 if i == j else 0.0) - b[i] * b[j]) / norm
    _cross_into(b, out[0], out[1])


@kernel
def accumulate(  # noqa: C901 - one pass, unrolled by hand, is what makes it fast
        knots: Array, rates: Array, path: Array, turned: Array, begin: NDArray[np.int64],
        middle: NDArray[np.int64], times1: Array, times2: Array, covariates1: Array,
        covariates2: Array, points1: Array, points2: Array, rows1: Array, rows2: Array,
        by_pixel1: Array, by_pixel2: Array, parameters: Array, R_imu_cam: Array, noise: Array,
        bend_sigma: Array, turn_sigma: Array, direction: Array, bend: Array, turn: Array,
        damping: Array, derivatives: bool, robust: float, losses: Array, residuals: Array,
        score: Array, reduced: Array, back: Array) -> None:
    """Go over all pairs; see the module for the model.

    Parameters
    ----------
    knots, rates, path, turned
        The integrated gyro (`GyroPath`).
    begin : (P + 1,)
    middle : (P,)
        Knot near the middle of the pair, in whose frame `direction`, `bend` and `turn` are: else
        they would turn with the bias, the more the later the pair.
    times1, times2, covariates1, covariates2 : (P,)
        Stamps [s] and intervals that the offset may depend on.
    points1, points2 : (N, 2)
        Undistorted normalised points, at the focal length that `parameters` scales.
    rows1, rows2 : (N,)
        ``s`` of the raw rows.
    by_pixel1, by_pixel2 : (N, 2, 2)
        Derivative of the normalised point by the pixel.
    parameters : (GLOBAL,)
        Read-out, offset, slope, -, -, -, -, -, -, log of the focal length's factor.
    R_imu_cam : (3, 3)
    noise : (P,)
        1 sigma of the residuals [px].
    bend_sigma, turn_sigma : (P,)
        1 sigma of each component of `bend` and of `turn` [rad].
    direction, bend, turn : (P, 3)
    damping : (P,)
        Levenberg-Marquardt's, of the pair's own unknowns.
    derivatives : bool
        Whether to fill what follows `residuals`.
    robust : float
        Distance [sigma] at which the Geman-McClure loss levels off.

    Fills per match: `residuals` [px]; per pair: `losses`; and with `derivatives` per pair `score`
    (P, GLOBAL), `reduced` (P, GLOBAL, GLOBAL) and `back` (P, LOCAL, GLOBAL + 1): the gradient, the
    Gauss-Newton Hessian after elimination, and what leads back to the pair's own unknowns.
    """
    readout, offset, slope = parameters[READOUT], parameters[OFFSET], parameters[SLOPE]
    stretch = math.exp(parameters[FOCAL])
    robust2 = robust**2
    Q1, Q2, rate1, rate2 = np.empty((3, 3)), np.empty((3, 3)), np.empty(3), np.empty(3)
    G1, G2, half = np.empty((3, 3)), np.empty((3, 3)), np.empty((3, 3))
    M1, M2, B = np.empty((3, 3)), np.empty((3, 3)), np.empty((2, 3))
    m1, m2, f1, f2 = np.empty(3), np.empty(3), np.empty(3), np.empty(3)
    b, c1, c2, k1, k2 = np.empty(3), np.empty(3), np.empty(3), np.empty(3), np.empty(3)
    g1, g2, d1, d2 = np.empty(3), np.empty(3), np.empty(3), np.empty(3)
    u, v, db = np.empty(3), np.empty(3), np.empty(3)
    C1, C2, b0, b1 = np.empty((3, 3)), np.empty((3, 3)), np.empty(3), np.empty(3)
    J = np.empty(_ALL)
    H, gradient = np.empty((_ALL, _ALL)), np.empty(_ALL)
    L = np.empty((LOCAL, LOCAL))
    for p in range(len(begin) - 1):
        Qm, Cm = path[middle[p]], turned[middle[p]]
        tangents(direction[p], L[:2, :3])
        bend_weight, turn_weight = 1.0 / bend_sigma[p] ** 2, 1.0 / turn_sigma[p] ** 2
        b0[:] = Qm @ direction[p]
        b1[:] = Qm @ bend[p]
        for i in range(3):
            for j in range(2):
                B[j, i] = Qm[i, 0] * L[j, 0] + Qm[i, 1] * L[j, 1] + Qm[i, 2] * L[j, 2]
        half[:] = exp_so3(0.5 * (Qm @ turn[p]))
        loss = 0.0
        for i in range(3):
            loss += 0.5 * (bend_weight * bend[p, i] ** 2 + turn_weight * turn[p, i] ** 2)
        H[:] = 0.0
        gradient[:] = 0.0
        start1 = times1[p] + offset + slope * covariates1[p]
        start2 = times2[p] + offset + slope * covariates2[p]
        n1 = np.searchsorted(knots, start1) - 1
        n2 = np.searchsorted(knots, start2) - 1
        per_noise2 = 1.0 / noise[p] ** 2
        for n in range(begin[p], begin[p + 1]):
            t1, t2 = start1 + rows1[n] * readout, start2 + rows2[n] * readout
            n1, n2 = knot_before(knots, t1, n1), knot_before(knots, t2, n2)
            rotation_at(knots, rates, path, t1, n1, G1, rate1)
            rotation_at(knots, rates, path, t2, n2, G2, rate2)
            for i in range(3):
                for j in range(3):
                    Q1[i, j] = (half[0, i] * G1[0, j] + half[1, i] * G1[1, j]
                                + half[2, i] * G1[2, j])
                    Q2[i, j] = (half[i, 0] * G2[0, j] + half[i, 1] * G2[1, j]
                                + half[i, 2] * G2[2, j])
            x1, y1 = points1[n, 0] / stretch, points1[n, 1] / stretch
            x2, y2 = points2[n, 0] / stretch, points2[n, 1] / stretch
            both = rows1[n] + rows2[n]
            for i in range(3):
                for j in range(3):
                    M1[i, j] = (Q1[i, 0] * R_imu_cam[0, j] + Q1[i, 1] * R_imu_cam[1, j]
                                + Q1[i, 2] * R_imu_cam[2, j])
                    M2[i, j] = (Q2[i, 0] * R_imu_cam[0, j] + Q2[i, 1] * R_imu_cam[1, j]
                                + Q2[i, 2] * R_imu_cam[2, j])
                # f: what a shorter focal length adds.
                f1[i] = M1[i, 0] * x1 + M1[i, 1] * y1
                f2[i] = M2[i, 0] * x2 + M2[i, 1] * y2
                m1[i] = f1[i] + M1[i, 2]
                m2[i] = f2[i] + M2[i, 2]
                b[i] = b0[i] + both * b1[i]
            # de = dm_1 . c_1 + dm_2 . c_2
            _cross_into(m2, b, c1)
            _cross_into(b, m1, c2)
            e = m1[0] * c1[0] + m1[1] * c1[1] + m1[2] * c1[2]
            # s^2 = |P_1^T M_1^T c_1|^2 + |P_2^T M_2^T c_2|^2 with P the derivative by the pixel;
            # half its derivative is k_1 . d(c_1) + k_2 . d(c_2) with k = M P P^T M^T c.
            s2 = _spread(M1, by_pixel1[n], c1, stretch, k1)
            s2 = max(s2 + _spread(M2, by_pixel2[n], c2, stretch, k2), 1e-16)
            s = math.sqrt(s2)
            residual = e / s
            residuals[n] = residual
            distance2 = residual**2 * per_noise2
            level = 1.0 / (1.0 + distance2 / robust2)
            loss += 0.5 * distance2 * level
            if not derivatives:
                continue
            weight = level * level * per_noise2
            ratio = e / s2
            # Derivative of the residual by m_1, m_2 (that of the directions c) and b.
            _cross_into(k2, b, u)
            _cross_into(b, k1, v)
            for i in range(3):
                d1[i] = (c1[i] - ratio * u[i]) / s
                d2[i] = (c2[i] - ratio * v[i]) / s
            # ... and by turning all of frame 1 or 2: g . (small rotation)
            _cross_into(m1, d1, g1)
            _cross_into(c1, k1, u)
            _cross_into(m2, d2, g2)
            _cross_into(c2, k2, v)
            for i in range(3):
                g1[i] += ratio / s * u[i]
                g2[i] += ratio / s * v[i]
            _cross_into(m1, m2, db)
            _cross_into(k1, m2, u)
            _cross_into(m1, k2, v)
            for i in range(3):
                db[i] = (db[i] - ratio * (u[i] + v[i])) / s
            by_time1, by_time2 = 0.0, 0.0
            for i in range(3):
                by_time1 += g1[i] * (Q1[i, 0] * rate1[0] + Q1[i, 1] * rate1[1]
                                     + Q1[i, 2] * rate1[2])
                by_time2 += g2[i] * (Q2[i, 0] * rate2[0] + Q2[i, 1] * rate2[1]
                                     + Q2[i, 2] * rate2[2])
            J[READOUT] = rows1[n] * by_time1 + rows2[n] * by_time2
            J[OFFSET] = by_time1 + by_time2
            J[SLOPE] = covariates1[p] * by_time1 + covariates2[p] * by_time2
            for i in range(3):
                for j in range(3):
                    C1[i, j] = turned[n1, i, j] - Cm[i, j] + (t1 - knots[n1]) * path[n1, i, j]
                    C2[i, j] = turned[n2, i, j] - Cm[i, j] + (t2 - knots[n2]) * path[n2, i, j]
            for j in range(3):
                J[ROTATION + j] = (g1[0] * Q1[0, j] + g1[1] * Q1[1, j] + g1[2] * Q1[2, j]
                                   + g2[0] * Q2[0, j] + g2[1] * Q2[1, j] + g2[2] * Q2[2, j])
                J[BIAS + j] = -(g1[0] * C1[0, j] + g1[1] * C1[1, j] + g1[2] * C1[2, j]
                                + g2[0] * C2[0, j] + g2[1] * C2[1, j] + g2[2] * C2[2, j])
                J[GLOBAL + 2 + j] = both * (
                    db[0] * Qm[0, j] + db[1] * Qm[1, j] + db[2] * Qm[2, j])
                J[GLOBAL + 5 + j] = 0.5 * (
                    (g2[0] - g1[0]) * Qm[0, j] + (g2[1] - g1[1]) * Qm[1, j]
                    + (g2[2] - g1[2]) * Qm[2, j])
            # The points shrink with a longer focal length, and so does s.
            J[FOCAL] = residual
            for i in range(3):
                J[FOCAL] -= d1[i] * f1[i] + d2[i] * f2[i]
            for j in range(2):
                J[GLOBAL + j] = B[j, 0] * db[0] + B[j, 1] * db[1] + B[j, 2] * db[2]
            for i in range(_ALL):
                gradient[i] += weight * residual * J[i]
                for j in range(i + 1):
                    H[i, j] += weight * J[i] * J[j]
        losses[p] = loss
        if not derivatives:
            continue
        # A direction that nothing tells stays where it is.
        for i in range(2):
            H[GLOBAL + i, GLOBAL + i] += 1.0
        for i in range(3):
            H[GLOBAL + 2 + i, GLOBAL + 2 + i] += bend_weight
            H[GLOBAL + 5 + i, GLOBAL + 5 + i] += turn_weight
            gradient[GLOBAL + 2 + i] += bend_weight * bend[p, i]
            gradient[GLOBAL + 5 + i] += turn_weight * turn[p, i]
        for i in range(GLOBAL, _ALL):
            H[i, i] *= 1.0 + damping[p]
        _eliminate(H, gradient, L, score[p], reduced[p], back[p])


@kernel
def _spread(M: Array, by_pixel: Array, c: Array, stretch: float, out: Array) -> float:
    """Squared length of P^T M^T c, and in `out` M P P^T M^T c."""
    h0 = M[0, 0] * c[0] + M[1, 0] * c[1] + M[2, 0] * c[2]
    h1 = M[0, 1] * c[0] + M[1, 1] * c[1] + M[2, 1] * c[2]
    q0 = (by_pixel[0, 0] * h0 + by_pixel[1, 0] * h1) / stretch
    q1 = (by_pixel[0, 1] * h0 + by_pixel[1, 1] * h1) / stretch
    h0 = (by_pixel[0, 0] * q0 + by_pixel[0, 1] * q1) / stretch
    h1 = (by_pixel[1, 0] * q0 + by_pixel[1, 1] * q1) / stretch
    for i in range(3):
        out[i] = M[i, 0] * h0 + M[i, 1] * h1
    return float(q0 * q0 + q1 * q1)


@kernel
def _eliminate(
        H: Array, gradient: Array, L: Array, score: Array, reduced: Array, back: Array) -> None:
    """Schur complement of the pair's own unknowns; H (_ALL, _ALL) has its lower half filled."""
    for i in range(LOCAL):
        for j in range(i + 1):
            total = H[GLOBAL + i, GLOBAL + j]
            for k in range(j):
                total -= L[i, k] * L[j, k]
            if i == j:
                L[i, i] = math.sqrt(max(total, 1e-30))
            else:
                L[i, j] = total / L[j, j]
    # back = H_ll^-1 [H_lg, g_l]
    for c in range(GLOBAL + 1):
        for i in range(LOCAL):
            total = gradient[GLOBAL + i] if c == GLOBAL else H[GLOBAL + i, c]
            for k in range(i):
                total -= L[i, k] * back[k, c]
            back[i, c] = total / L[i, i]
        for i in range(LOCAL - 1, -1, -1):
            total = back[i, c]
            for k in range(i + 1, LOCAL):
                total -= L[k, i] * back[k, c]
            back[i, c] = total / L[i, i]
    for a in range(GLOBAL):
        total = gradient[a]
        for i in range(LOCAL):
            total -= H[GLOBAL + i, a] * back[i, GLOBAL]
        score[a] = total
        for b in range(a + 1):
            total = H[a, b]
            for i in range(LOCAL):
                total -= H[GLOBAL + i, a] * back[i, b]
            reduced[a, b] = total
            reduced[b, a] = total


@kernel
def find_directions(  # noqa: C901 - one pass as above
        knots: Array, rates: Array, path: Array, begin: NDArray[np.int64],
        middle: NDArray[np.int64], times1: Array, times2: Array, covariates1: Array,
        covariates2: Array, points1: Array, points2: Array, rows1: Array, rows2: Array,
        by_pixel1: Array, by_pixel2: Array, parameters: Array, R_imu_cam: Array, noise: Array,
        chosen: NDArray[np.int64], robust: float, direction: Array) -> None:
    """Improve `direction` (P, 3) by those that two matches each fix.

    Parameters are those of `accumulate`; `chosen` (K, 2) are large random numbers that pick the
    matches. The best has the least truncated cost; the one that is there takes part.
    """
    readout, offset, slope = parameters[READOUT], parameters[OFFSET], parameters[SLOPE]
    stretch = math.exp(parameters[FOCAL])
    most = 0
    for p in range(len(begin) - 1):
        most = max(most, begin[p + 1] - begin[p])
    normals, squares = np.empty((most, 3)), np.empty((most, 3, 3))
    Q, rate, G = np.empty((3, 3)), np.empty(3), np.empty((2, 3))
    M = np.empty((2, 3, 3))
    m = np.empty((2, 3))
    b, best = np.empty(3), np.empty(3)
    for p in range(len(begin) - 1):
        count = begin[p + 1] - begin[p]
        Qm = path[middle[p]]
        k = 0
        for i in range(count):
            n = begin[p] + i
            for frame in range(2):
                if frame == 0:
                    t = times1[p] + offset + slope * covariates1[p] + rows1[n] * readout
                    x, y = points1[n, 0] / stretch, points1[n, 1] / stretch
                else:
                    t = times2[p] + offset + slope * covariates2[p] + rows2[n] * readout
                    x, y = points2[n, 0] / stretch, points2[n, 1] / stretch
                if k == 0:
                    k = np.searchsorted(knots, t) - 1
                k = knot_before(knots, t, k)
                rotation_at(knots, rates, path, t, k, Q, rate)
                for r in range(3):
                    for c in range(3):
                        M[frame, r, c] = (Q[r, 0] * R_imu_cam[0, c] + Q[r, 1] * R_imu_cam[1, c]
                                          + Q[r, 2] * R_imu_cam[2, c])
                    m[frame, r] = M[frame, r, 0] * x + M[frame, r, 1] * y + M[frame, r, 2]
            _cross_into(m[0], m[1], normals[i])
            squares[i] = 0.0
            for frame in range(2):
                other = m[1 - frame]
                for r in range(2):
                    # Derivative of e by pixel coordinate r of this frame: G b.
                    P = by_pixel1[n] if frame == 0 else by_pixel2[n]
                    for c in range(3):
                        b[c] = (M[frame, c, 0] * P[0, r] + M[frame, c, 1] * P[1, r]) / stretch
                    _cross_into(b, other, G[r])
                    for c in range(3):
                        for d in range(3):
                            squares[i, c, d] += G[r, c] * G[r, d]
        limit = (robust * noise[p]) ** 2
        least = np.inf
        for h in range(-1, len(chosen)):
            if h < 0:
                b[:] = Qm @ direction[p]
            else:
                _cross_into(normals[chosen[h, 0] % count], normals[chosen[h, 1] % count], b)
            norm = math.sqrt(b[0] ** 2 + b[1] ** 2 + b[2] ** 2)
            if norm < 1e-14:
                continue
            for c in range(3):
                b[c] /= norm
            cost = 0.0
            for i in range(count):
                e = normals[i, 0] * b[0] + normals[i, 1] * b[1] + normals[i, 2] * b[2]
                s2 = 1e-16
                for c in range(3):
                    for d in range(3):
                        s2 += b[c] * squares[i, c, d] * b[d]
                cost += min(e * e / s2, limit)
                if cost >= least:
                    break
            if cost < least:
                least = cost
                best[:] = b
        if least < np.inf:
            direction[p] = best @ Qm
