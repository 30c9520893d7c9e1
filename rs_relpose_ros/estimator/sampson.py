"""The rolling-shutter Sampson error in pixels, its exact Jacobian, and the depths of a match.

Constraint (docs/conventions.md), with ``b = t - tau_1 d_1 + tau_2 d_2`` and ``h = R f_2``::

    e = (f_1 x h) . b = 0
    r = e / sqrt(sum_k q_k^2),   q_k = de / d(pixel coordinate k)          [px]

Every scalar above is a triple product ``b . (p x h)``: of the ray f_1 or its derivative a by a
pixel coordinate, with h or R times the derivative of f_2. Derivatives by the pixel include the
distortion and the turn of the camera from row to row, so the error is in pixels of the raw image.

An observation row (20 floats) holds, for one match,
``f_1, df_1/du, df_1/dv, f_2, df_2/du, df_2/dv, tau_1, tau_2``.

The state is ``R, t`` (unit), ``d_1, d_2`` and gyro corrections ``dw_1, dw_2``, all in frame 1;
its 17 local parameters are ``(theta, t tangent, d_1, d_2, dw_1, dw_2)``, ``R <- Exp(theta) R``.
"""

from __future__ import annotations

import math

import numba
import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]

PARAMETERS = 17
THETA, TANGENT, D1, D2, DW1, DW2 = 0, 3, 5, 8, 11, 14

# Fused multiply-add and reordered sums: a fifth faster. NaN and infinity keep their meaning.
_FAST = {'contract', 'reassoc', 'nsz', 'arcp'}
_jit = numba.njit(cache=True, nogil=True, error_model='numpy', fastmath=_FAST)


@_jit
def _cross(ax, ay, az, bx, by, bz):  # type: ignore[no-untyped-def]
    return ay * bz - az * by, az * bx - ax * bz, ax * by - ay * bx


@_jit
def _turned(x, y, z, wx, wy, wz, tau):  # type: ignore[no-untyped-def]
    """``Exp(w tau) v`` to second order: w is a gyro correction, not a rate."""
    cx, cy, cz = _cross(wx, wy, wz, x, y, z)
    ex, ey, ez = _cross(wx, wy, wz, cx, cy, cz)
    s = 0.5 * tau * tau
    return x + tau * cx + s * ex, y + tau * cy + s * ey, z + tau * cz + s * ez


@_jit
def tangent_basis(t: Array) -> Array:
    """Two orthonormal columns (3, 2) perpendicular to the unit vector `t`."""
    basis = np.empty((3, 2))
    # The axis least aligned with t keeps the cross product well conditioned.
    k = 0
    if abs(t[1]) < abs(t[k]):
        k = 1
    if abs(t[2]) < abs(t[k]):
        k = 2
    axis = np.zeros(3)
    axis[k] = 1.0
    ux, uy, uz = _cross(t[0], t[1], t[2], axis[0], axis[1], axis[2])
    norm = math.sqrt(ux * ux + uy * uy + uz * uz)
    basis[0, 0], basis[1, 0], basis[2, 0] = ux / norm, uy / norm, uz / norm
    basis[0, 1], basis[1, 1], basis[2, 1] = _cross(
        t[0], t[1], t[2], basis[0, 0], basis[1, 0], basis[2, 0])
    return basis


@_jit
def _residual_and_pairs(o, R, t, d1, d2, dw1, dw2, frame):  # type: ignore[no-untyped-def]
    """Residual of one observation row [px]; `frame` receives the vectors that the Jacobian needs.

    frame: b (0:3), f_1 (3:6), h (6:9), p' (9:12), h' (12:15), where ``dr`` is the sum of the
    variations of the triple products b.(p' x h) and b.(f_1 x h').
    """
    tau1, tau2 = o[18], o[19]
    bx = t[0] - tau1 * d1[0] + tau2 * d2[0]
    by = t[1] - tau1 * d1[1] + tau2 * d2[1]
    bz = t[2] - tau1 * d1[2] + tau2 * d2[2]
    fx, fy, fz = _turned(o[0], o[1], o[2], dw1[0], dw1[1], dw1[2], tau1)
    ux, uy, uz = _turned(o[3], o[4], o[5], dw1[0], dw1[1], dw1[2], tau1)
    vx, vy, vz = _turned(o[6], o[7], o[8], dw1[0], dw1[1], dw1[2], tau1)
    hx = R[0, 0] * o[9] + R[0, 1] * o[10] + R[0, 2] * o[11]
    hy = R[1, 0] * o[9] + R[1, 1] * o[10] + R[1, 2] * o[11]
    hz = R[2, 0] * o[9] + R[2, 1] * o[10] + R[2, 2] * o[11]
    hx, hy, hz = _turned(hx, hy, hz, dw2[0], dw2[1], dw2[2], tau2)
    hux = R[0, 0] * o[12] + R[0, 1] * o[13] + R[0, 2] * o[14]
    huy = R[1, 0] * o[12] + R[1, 1] * o[13] + R[1, 2] * o[14]
    huz = R[2, 0] * o[12] + R[2, 1] * o[13] + R[2, 2] * o[14]
    hux, huy, huz = _turned(hux, huy, huz, dw2[0], dw2[1], dw2[2], tau2)
    hvx = R[0, 0] * o[15] + R[0, 1] * o[16] + R[0, 2] * o[17]
    hvy = R[1, 0] * o[15] + R[1, 1] * o[16] + R[1, 2] * o[17]
    hvz = R[2, 0] * o[15] + R[2, 1] * o[16] + R[2, 2] * o[17]
    hvx, hvy, hvz = _turned(hvx, hvy, hvz, dw2[0], dw2[1], dw2[2], tau2)
    # h x b and b x f_1: the gradients of e by f_1 and by h.
    gx, gy, gz = _cross(hx, hy, hz, bx, by, bz)
    kx, ky, kz = _cross(bx, by, bz, fx, fy, fz)
    e = gx * fx + gy * fy + gz * fz
    q1 = gx * ux + gy * uy + gz * uz
    q2 = gx * vx + gy * vy + gz * vz
    q3 = kx * hux + ky * huy + kz * huz
    q4 = kx * hvx + ky * hvy + kz * hvz
    s2 = q1 * q1 + q2 * q2 + q3 * q3 + q4 * q4
    # Rays on the epipole have no gradient; the floor is far below any real one (1/px).
    s = math.sqrt(s2 + 1e-30)
    r = e / s
    c0 = 1.0 / s
    c = -r / (s * s)
    c1, c2, c3, c4 = c * q1, c * q2, c * q3, c * q4
    frame[0], frame[1], frame[2] = bx, by, bz
    frame[3], frame[4], frame[5] = fx, fy, fz
    frame[6], frame[7], frame[8] = hx, hy, hz
    frame[9] = c0 * fx + c1 * ux + c2 * vx
    frame[10] = c0 * fy + c1 * uy + c2 * vy
    frame[11] = c0 * fz + c1 * uz + c2 * vz
    frame[12] = c3 * hux + c4 * hvx
    frame[13] = c3 * huy + c4 * hvy
    frame[14] = c3 * huz + c4 * hvz
    return r


@_jit
def residuals(observations: Array, R: Array, t: Array, d1: Array, d2: Array, dw1: Array,
              dw2: Array) -> Array:
    """Signed Sampson errors (N,) [px] of observation rows (N, 20)."""
    n = observations.shape[0]
    out = np.empty(n)
    frame = np.empty(15)
    for i in range(n):
        out[i] = _residual_and_pairs(observations[i], R, t, d1, d2, dw1, dw2, frame)
    return out


@_jit
def jacobian_row(frame: Array, tau1: float, tau2: float, basis: Array, row: Array) -> None:
    """Derivative (17,) of one residual by the local parameters, from `_residual_and_pairs`."""
    bx, by, bz = frame[0], frame[1], frame[2]
    fx, fy, fz = frame[3], frame[4], frame[5]
    hx, hy, hz = frame[6], frame[7], frame[8]
    px, py, pz = frame[9], frame[10], frame[11]
    jx, jy, jz = frame[12], frame[13], frame[14]
    # by b: p' x h + f_1 x h'
    nx, ny, nz = _cross(px, py, pz, hx, hy, hz)
    mx, my, mz = _cross(fx, fy, fz, jx, jy, jz)
    nx, ny, nz = nx + mx, ny + my, nz + mz
    # by a turn of the second rays: h x (b x p') + h' x (b x f_1)
    sx, sy, sz = _cross(bx, by, bz, px, py, pz)
    rx, ry, rz = _cross(hx, hy, hz, sx, sy, sz)
    kx, ky, kz = _cross(bx, by, bz, fx, fy, fz)
    mx, my, mz = _cross(jx, jy, jz, kx, ky, kz)
    rx, ry, rz = rx + mx, ry + my, rz + mz
    # by a turn of the first rays: p' x (h x b) + f_1 x (h' x b)
    gx, gy, gz = _cross(hx, hy, hz, bx, by, bz)
    wx, wy, wz = _cross(px, py, pz, gx, gy, gz)
    gx, gy, gz = _cross(jx, jy, jz, bx, by, bz)
    mx, my, mz = _cross(fx, fy, fz, gx, gy, gz)
    wx, wy, wz = wx + mx, wy + my, wz + mz
    row[0], row[1], row[2] = rx, ry, rz
    row[3] = nx * basis[0, 0] + ny * basis[1, 0] + nz * basis[2, 0]
    row[4] = nx * basis[0, 1] + ny * basis[1, 1] + nz * basis[2, 1]
    row[5], row[6], row[7] = -tau1 * nx, -tau1 * ny, -tau1 * nz
    row[8], row[9], row[10] = tau2 * nx, tau2 * ny, tau2 * nz
    row[11], row[12], row[13] = tau1 * wx, tau1 * wy, tau1 * wz
    row[14], row[15], row[16] = tau2 * rx, tau2 * ry, tau2 * rz


@_jit
def jacobian(observations: Array, R: Array, t: Array, d1: Array, d2: Array, dw1: Array,
             dw2: Array) -> Array:
    """Derivatives (N, 17) of the Sampson errors by the local parameters."""
    n = observations.shape[0]
    out = np.empty((n, PARAMETERS))
    frame = np.empty(15)
    basis = tangent_basis(t)
    for i in range(n):
        _residual_and_pairs(observations[i], R, t, d1, d2, dw1, dw2, frame)
        jacobian_row(frame, observations[i, 18], observations[i, 19], basis, out[i])
    return out


@_jit
def normal_equations(observations: Array, use: NDArray[np.bool_], R: Array, t: Array, d1: Array,
                     d2: Array, dw1: Array, dw2: Array) -> tuple[Array, Array, float, int]:
    """``J^T J`` (17, 17), ``J^T r`` (17,), sum of squares and count over the matches in `use`."""
    hessian = np.zeros((PARAMETERS, PARAMETERS))
    gradient = np.zeros(PARAMETERS)
    row = np.empty(PARAMETERS)
    frame = np.empty(15)
    basis = tangent_basis(t)
    cost = 0.0
    count = 0
    for i in range(observations.shape[0]):
        if not use[i]:
            continue
        r = _residual_and_pairs(observations[i], R, t, d1, d2, dw1, dw2, frame)
        jacobian_row(frame, observations[i, 18], observations[i, 19], basis, row)
        cost += r * r
        count += 1
        for j in range(PARAMETERS):
            value = row[j]
            gradient[j] += value * r
            for k in range(j + 1):
                hessian[j, k] += value * row[k]
    for j in range(PARAMETERS):
        for k in range(j):
            hessian[k, j] = hessian[j, k]
    return hessian, gradient, cost, count


@_jit
def sum_of_squares(observations: Array, use: NDArray[np.bool_], R: Array, t: Array, d1: Array,
                   d2: Array, dw1: Array, dw2: Array) -> float:
    """Sum of squared Sampson errors [px^2] over the matches in `use`."""
    frame = np.empty(15)
    cost = 0.0
    for i in range(observations.shape[0]):
        if use[i]:
            r = _residual_and_pairs(observations[i], R, t, d1, d2, dw1, dw2, frame)
            cost += r * r
    return cost


@_jit
def depths(observations: Array, R: Array, t: Array, d1: Array, d2: Array, out: Array) -> None:
    """Depths along both rays (N, 2) in baselines, each match with its own row times.

    ``l_1 f_1 = l_2 h + b`` in the least-squares sense of its cross products with h and f_1. NaN
    where the rays are parallel.
    """
    for i in range(observations.shape[0]):
        o = observations[i]
        tau1, tau2 = o[18], o[19]
        bx = t[0] - tau1 * d1[0] + tau2 * d2[0]
        by = t[1] - tau1 * d1[1] + tau2 * d2[1]
        bz = t[2] - tau1 * d1[2] + tau2 * d2[2]
        hx = R[0, 0] * o[9] + R[0, 1] * o[10] + R[0, 2] * o[11]
        hy = R[1, 0] * o[9] + R[1, 1] * o[10] + R[1, 2] * o[11]
        hz = R[2, 0] * o[9] + R[2, 1] * o[10] + R[2, 2] * o[11]
        nx, ny, nz = _cross(o[0], o[1], o[2], hx, hy, hz)
        n2 = nx * nx + ny * ny + nz * nz
        if n2 < 1e-18:
            out[i, 0] = np.nan
            out[i, 1] = np.nan
            continue
        cx, cy, cz = _cross(bx, by, bz, hx, hy, hz)
        out[i, 0] = (cx * nx + cy * ny + cz * nz) / n2
        cx, cy, cz = _cross(bx, by, bz, o[0], o[1], o[2])
        out[i, 1] = (cx * nx + cy * ny + cz * nz) / n2
