"""Residuals of matches, and the normal equations of the calibration with the pairs eliminated.

Frame i sees row v at ``t_i(v) = stamp_i + offset + slope k_i + s(v) readout`` with
``s(v) = (v - middle row) / height``. With ``Q(t)`` the gyro's rotation and ``n = (x, y, 1)`` the
undistorted point, the point that frame 1 sees lies on the ray ``g(rho) = Q(t_1) R_imu_cam n_1 -
rho B`` from frame 2, and

    e(rho) = A_2 (n_2 - pi(R_cam_imu Q(t_2)^T g(rho)))                     [px]
    B = (1 + (tau_2 - tau_1) / D) (T + (tau_1 + tau_2) / 2 V),             tau_i = s_i readout

`rho` is the inverse depth of the point, relative to that of the whole pair. A pair has a
translation T (over the pair's interval D, in units of the pair's depth), a change of velocity V,
and an error of the gyro's rotation between its frames; the inverse depth of each match is free
within its prior, so that a match says what lies across the epipolar line (coplanarity), and next
to nothing of what lies along it unless there is next to no parallax. All of these are
eliminated.
"""

from __future__ import annotations

import math

import numba
import numpy as np
from numpy.typing import NDArray

from rs_relpose_ros.calibration.gyro_path import knot_before, rotation_at

Array = NDArray[np.float64]

# Order of the calibration's parameters: read-out [s], offset of the middle row [s], slope of the
# offset, rotation vector on the left of R_imu_cam (3) [rad], bias (3) [rad/s], log of the focal
# length.
READOUT, OFFSET, SLOPE, ROTATION, BIAS, FOCAL = 0, 1, 2, 3, 6, 9
GLOBAL = 10
# Of a pair: T (3), V (3), rotation error of frame 2 (3).
LOCAL = 9
_ALL = GLOBAL + LOCAL
_STEPS_OF_DEPTH = 2


@numba.njit(cache=True, nogil=True)
def _cross_into(a: Array, b: Array, out: Array) -> None:
    out[0] = a[1] * b[2] - a[2] * b[1]
    out[1] = a[2] * b[0] - a[0] * b[2]
    out[2] = a[0] * b[1] - a[1] * b[0]


@numba.njit(cache=True, nogil=True, error_model='numpy')
def accumulate(  # noqa: C901 - one pass, unrolled by hand, is what makes it fast
        knots: Array, rates: Array, path: Array, turned: Array, begin: NDArray[np.int64],
        times1: Array, times2: Array, covariates1: Array, covariates2: Array, points1: Array,
        points2: Array, rows1: Array, rows2: Array, scales: Array, parameters: Array,
        R_imu_cam: Array, scatter: Array, local: Array, rho: Array, derivatives: bool,
        robust: float, losses: Array, weights: Array, across: Array, sharpness: Array,
        score: Array, reduced: Array, back: Array, spread: Array) -> None:
    """Go over all pairs; see the module for the model.

    Parameters
    ----------
    knots, rates, path, turned
        The integrated gyro (`GyroPath`).
    begin : (P + 1,)
    times1, times2, covariates1, covariates2 : (P,)
        Stamps [s] and intervals that the offset may depend on.
    points1, points2 : (N, 2)
        Undistorted normalised points, at the focal length that `parameters` scales.
    rows1, rows2 : (N,)
        ``s`` of the raw rows.
    scales : (N, 2, 2)
        Derivative of the pixel by the normalised point, frame 2.
    parameters : (GLOBAL,)
        Read-out, offset, slope, -, -, -, -, -, -, log of the focal length's factor.
    R_imu_cam : (3, 3)
    scatter : (5,)
        1 sigma of the match [px], of the inverse depth, of T and V per second of the interval,
        and of the rotation error per root of a second.
    local, rho : (P, LOCAL), (N,)
        State of the pairs and of the matches; rho is improved in place.
    derivatives : bool
        Whether to fill what follows `sharpness`.
    robust : float
        Distance [sigma] at which the Geman-McClure loss levels off.

    Fills per match: `weights`, `across` (normalised residual across the epipolar line) and
    `sharpness` (variance of rho); per pair: `losses`; and with `derivatives` per pair `score`
    (P, GLOBAL), `reduced` (P, GLOBAL, GLOBAL), `back` (P, LOCAL, GLOBAL + 1), `spread` (P, LOCAL):
    the gradient, the Hessian after elimination, what leads back to the pair's own unknowns, and
    their variances.
    """
    readout, offset, slope = parameters[READOUT], parameters[OFFSET], parameters[SLOPE]
    stretch = math.exp(parameters[FOCAL])
    sigma2, depth2, robust2 = scatter[0] ** 2, scatter[1] ** 2, robust**2
    Q1, Q2, rate1, rate2 = np.empty((3, 3)), np.empty((3, 3)), np.empty(3), np.empty(3)
    P2, M1 = np.empty((3, 3)), np.empty((3, 3))
    F1, B, g, w1, w2 = np.empty(3), np.empty(3), np.empty(3), np.empty(3), np.empty(3)
    crossed, direction = np.empty(3), np.empty(3)
    E, e, q = np.empty((2, 3)), np.empty(2), np.empty(2)
    C1, C2, Cm = np.empty((3, 3)), np.empty((3, 3)), np.empty((3, 3))
    J, WJ = np.empty((2, _ALL)), np.empty((2, _ALL))
    H, gradient = np.empty((_ALL, _ALL)), np.empty(_ALL)
    L = np.empty((LOCAL, LOCAL))
    prior = np.empty(LOCAL)
    d = np.empty(3)
    for p in range(len(begin) - 1):
        gap = times2[p] - times1[p]
        for i in range(3):
            prior[i] = 1.0 / (scatter[2] * gap) ** 2
            prior[3 + i] = 1.0 / (scatter[3] * gap) ** 2
            prior[6 + i] = 1.0 / (scatter[4] ** 2 * gap)
        loss = 0.0
        for i in range(LOCAL):
            loss += 0.5 * prior[i] * local[p, i] ** 2
        H[:] = 0.0
        gradient[:] = 0.0
        start1 = times1[p] + offset + slope * covariates1[p]
        start2 = times2[p] + offset + slope * covariates2[p]
        k1 = np.searchsorted(knots, start1) - 1
        k2 = np.searchsorted(knots, start2) - 1
        km = knot_before(knots, 0.5 * (start1 + start2), k1)
        Cm[:] = turned[km]
        for n in range(begin[p], begin[p + 1]):
            tau1, tau2 = rows1[n] * readout, rows2[n] * readout
            k1 = knot_before(knots, start1 + tau1, k1)
            k2 = knot_before(knots, start2 + tau2, k2)
            rotation_at(knots, rates, path, start1 + tau1, k1, Q1, rate1)
            rotation_at(knots, rates, path, start2 + tau2, k2, Q2, rate2)
            # The rotation error of the pair turns frame 2: Q2 <- (1 + [d]x) Q2.
            for i in range(3):
                d[i] = local[p, 6 + i]
            for j in range(3):
                a, b, c = Q2[0, j], Q2[1, j], Q2[2, j]
                Q2[0, j] = a + d[1] * c - d[2] * b
                Q2[1, j] = b + d[2] * a - d[0] * c
                Q2[2, j] = c + d[0] * b - d[1] * a
            x, y = points1[n, 0] / stretch, points1[n, 1] / stretch
            for i in range(3):
                for j in range(3):
                    M1[i, j] = (Q1[i, 0] * R_imu_cam[0, j] + Q1[i, 1] * R_imu_cam[1, j]
                                + Q1[i, 2] * R_imu_cam[2, j])
                    P2[j, i] = (Q2[i, 0] * R_imu_cam[0, j] + Q2[i, 1] * R_imu_cam[1, j]
                                + Q2[i, 2] * R_imu_cam[2, j])
                F1[i] = M1[i, 0] * x + M1[i, 1] * y + M1[i, 2]
            longer = 1.0 + (tau2 - tau1) / gap
            middle = 0.5 * (tau1 + tau2)
            for i in range(3):
                B[i] = longer * (local[p, i] + middle * local[p, 3 + i])
            a00, a01 = scales[n, 0, 0] * stretch, scales[n, 0, 1] * stretch
            a10, a11 = scales[n, 1, 0] * stretch, scales[n, 1, 1] * stretch
            good = True
            for _ in range(_STEPS_OF_DEPTH + 1):
                for i in range(3):
                    g[i] = F1[i] - rho[n] * B[i]
                u = P2[0, 0] * g[0] + P2[0, 1] * g[1] + P2[0, 2] * g[2]
                v = P2[1, 0] * g[0] + P2[1, 1] * g[1] + P2[1, 2] * g[2]
                z = P2[2, 0] * g[0] + P2[2, 1] * g[1] + P2[2, 2] * g[2]
                if z < 0.05:
                    good = False
                    break
                u, v = u / z, v / z
                for i in range(3):
                    du = (P2[0, i] - u * P2[2, i]) / z
                    dv = (P2[1, i] - v * P2[2, i]) / z
                    E[0, i] = a00 * du + a01 * dv
                    E[1, i] = a10 * du + a11 * dv
                du = points2[n, 0] / stretch - u
                dv = points2[n, 1] / stretch - v
                e[0] = a00 * du + a01 * dv
                e[1] = a10 * du + a11 * dv
                # de / drho
                q[0] = E[0, 0] * B[0] + E[0, 1] * B[1] + E[0, 2] * B[2]
                q[1] = E[1, 0] * B[0] + E[1, 1] * B[1] + E[1, 2] * B[2]
                q2 = q[0] ** 2 + q[1] ** 2
                curvature = q2 / sigma2 + 1.0 / depth2
                if _ < _STEPS_OF_DEPTH:
                    step = (q[0] * e[0] + q[1] * e[1]) / sigma2 + (rho[n] - 1.0) / depth2
                    rho[n] = min(max(rho[n] - step / curvature, -3.0), 20.0)
            if not good:
                # Behind the camera: as far off as can be.
                rho[n] = 1.0
                weights[n] = 0.0
                across[n] = 1e3
                sharpness[n] = depth2
                loss += 0.5 * robust2
                continue
            distance2 = (e[0] ** 2 + e[1] ** 2) / sigma2 + (rho[n] - 1.0) ** 2 / depth2
            bend = 1.0 / (1.0 + distance2 / robust2)
            loss += 0.5 * distance2 * bend
            weight = bend * bend
            weights[n] = weight
            sharpness[n] = 1.0 / curvature
            across[n] = (e[0] * q[1] - e[1] * q[0]) / math.sqrt(max(q2, 1e-12) * sigma2)
            if not derivatives:
                continue
            # -- derivatives of e; F1 turned by a turns g by a x F1, frame 2 turned by b by -b x g
            for i in range(3):
                w1[i] = Q1[i, 0] * rate1[0] + Q1[i, 1] * rate1[1] + Q1[i, 2] * rate1[2]
                w2[i] = Q2[i, 0] * rate2[0] + Q2[i, 1] * rate2[1] + Q2[i, 2] * rate2[2]
            _cross_into(w1, F1, crossed)
            _cross_into(w2, g, direction)
            # de = -E dg, dg = shift1 (w1 x F1) - shift2 (w2 x g)
            b1, b2 = rows1[n] , rows2[n]
            for i in range(3):
                by_readout = ((b2 - b1) / gap * (local[p, i] + middle * local[p, 3 + i])
                              + longer * 0.5 * (b1 + b2) * local[p, 3 + i])
                w1[i] = b1 * crossed[i] - b2 * direction[i] - rho[n] * by_readout
            for r in range(2):
                J[r, READOUT] = -(E[r, 0] * w1[0] + E[r, 1] * w1[1] + E[r, 2] * w1[2])
                along1 = E[r, 0] * crossed[0] + E[r, 1] * crossed[1] + E[r, 2] * crossed[2]
                along2 = E[r, 0] * direction[0] + E[r, 1] * direction[1] + E[r, 2] * direction[2]
                J[r, OFFSET] = along2 - along1
                J[r, SLOPE] = along2 * covariates2[p] - along1 * covariates1[p]
            for i in range(3):
                for j in range(3):
                    C1[i, j] = (turned[k1, i, j] - Cm[i, j]
                                + (start1 + tau1 - knots[k1]) * path[k1, i, j])
                    C2[i, j] = (turned[k2, i, j] - Cm[i, j]
                                + (start2 + tau2 - knots[k2]) * path[k2, i, j])
            for r in range(2):
                # G1 = -E [.]x: row r of E crossed with F1, such that de = (F1 x E_r) . a ...
                f0 = E[r, 1] * F1[2] - E[r, 2] * F1[1]
                f1 = E[r, 2] * F1[0] - E[r, 0] * F1[2]
                f2 = E[r, 0] * F1[1] - E[r, 1] * F1[0]
                h0 = E[r, 1] * g[2] - E[r, 2] * g[1]
                h1 = E[r, 2] * g[0] - E[r, 0] * g[2]
                h2 = E[r, 0] * g[1] - E[r, 1] * g[0]
                # E . (a x F) = a . (F x E) = -a . (E x F): de = -E dg = a . f - b . h
                for j in range(3):
                    J[r, ROTATION + j] = (f0 * Q1[0, j] + f1 * Q1[1, j] + f2 * Q1[2, j]
                                          - h0 * Q2[0, j] - h1 * Q2[1, j] - h2 * Q2[2, j])
                    J[r, BIAS + j] = -(f0 * C1[0, j] + f1 * C1[1, j] + f2 * C1[2, j]
                                       - h0 * C2[0, j] - h1 * C2[1, j] - h2 * C2[2, j])
                J[r, GLOBAL + 6] = -h0
                J[r, GLOBAL + 7] = -h1
                J[r, GLOBAL + 8] = -h2
                for j in range(3):
                    J[r, GLOBAL + j] = longer * rho[n] * E[r, j]
                    J[r, GLOBAL + 3 + j] = middle * J[r, GLOBAL + j]
                # n_1 shrinks with a longer focal length; so does n_2, but A n_2 does not.
                grown = 0.0
                for i in range(3):
                    grown += E[r, i] * (M1[i, 0] * x + M1[i, 1] * y)
                J[r, FOCAL] = grown
            J[0, FOCAL] -= a00 * u + a01 * v
            J[1, FOCAL] -= a10 * u + a11 * v
            # Weight with rho eliminated: (1 - q q^T / (q^2 + sigma^2 / depth^2)) / sigma^2
            lost = 1.0 / (q2 + sigma2 / depth2)
            w00 = weight * (1.0 - lost * q[0] * q[0]) / sigma2
            w01 = -weight * lost * q[0] * q[1] / sigma2
            w11 = weight * (1.0 - lost * q[1] * q[1]) / sigma2
            e0, e1 = weight * e[0] / sigma2, weight * e[1] / sigma2
            for a in range(_ALL):
                WJ[0, a] = w00 * J[0, a] + w01 * J[1, a]
                WJ[1, a] = w01 * J[0, a] + w11 * J[1, a]
                gradient[a] += J[0, a] * e0 + J[1, a] * e1
            for a in range(_ALL):
                for b in range(a + 1):
                    H[a, b] += J[0, a] * WJ[0, b] + J[1, a] * WJ[1, b]
        losses[p] = loss
        if not derivatives:
            continue
        for i in range(LOCAL):
            H[GLOBAL + i, GLOBAL + i] += prior[i]
            gradient[GLOBAL + i] += prior[i] * local[p, i]
        _eliminate(H, gradient, L, score[p], reduced[p], back[p], spread[p])


@numba.njit(cache=True, nogil=True, error_model='numpy')
def _eliminate(  # noqa: C901 - a Cholesky factorisation and three substitutions by hand
        H: Array, gradient: Array, L: Array, score: Array, reduced: Array, back: Array,
        spread: Array) -> None:
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
    # Diagonal of H_ll^-1 = L^-T L^-1.
    column = np.empty(LOCAL)
    for c in range(LOCAL):
        spread[c] = 0.0
    for c in range(LOCAL):
        # column c of L^-1
        for i in range(LOCAL):
            column[i] = 0.0
        column[c] = 1.0 / L[c, c]
        for i in range(c + 1, LOCAL):
            total = 0.0
            for k in range(c, i):
                total -= L[i, k] * column[k]
            column[i] = total / L[i, i]
        for i in range(c, LOCAL):
            spread[c] += column[i] ** 2
