"""The rolling-shutter Sampson error in pixels, its exact Jacobian, and the depths of a match.

Constraint (docs/conventions.md), with ``b = t - tau_1 d_1 + tau_2 d_2`` and ``h = R f_2``::

    e = (f_1 x h) . b = 0
    r = e / sqrt(sum_k q_k^2),   q_k = de / d(pixel coordinate k)          [px]

Every scalar above is a triple product ``b . (p x h)``: of the ray f_1 or its derivative a by a
pixel coordinate, with h or R times the derivative of f_2. Derivatives by the pixel include the
distortion and the turn of the camera from row to row, so the error is in pixels of the raw image.

An observation row (20 floats) holds, for one match,
``f_1, df_1/du, df_1/dv, f_2, df_2/du, df_2/dv, tau_1, tau_2``.

Matches are evaluated in blocks, each laid out so that neighbours of one quantity are neighbours in
memory: the compiler then works on several matches at once. For that it must know the strides,
hence the arrays of fixed shape and the forced inlining.
"""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from rs_relpose_ros.compiled import inlined_kernel, kernel, linked_kernel
from rs_relpose_ros.estimator.state import PARAMETERS, TwoViewState
from rs_relpose_ros.geometry.vectors import copy_vector, cross, dot, norm, rotated, tangent_basis

Array = NDArray[np.float64]

# Matches of a block: enough to vectorise, few enough for the nearest cache.
BLOCK = 64


@inlined_kernel
def _cross(ax, ay, az, bx, by, bz):  # type: ignore[no-untyped-def]
    return ay * bz - az * by, az * bx - ax * bz, ax * by - ay * bx


@inlined_kernel
def _baselines(state: TwoViewState) -> Array:
    """Coefficients (3, 3) of ``b = t - tau_1 d_1 + tau_2 d_2`` in 1, tau_1, tau_2."""
    out = np.empty((3, 3))
    for k in range(3):
        out[0, k], out[1, k], out[2, k] = state.t[k], -state.d1[k], state.d2[k]
    return out


@inlined_kernel
def _turns(rate: Array, R: Array) -> Array:
    """Coefficients (3, 3, 3) of ``Exp(w tau) R`` in 1, tau, tau^2: w is a gyro correction."""
    out = np.empty((3, 3, 3))
    for j in range(3):
        out[0, 0, j], out[0, 1, j], out[0, 2, j] = R[0, j], R[1, j], R[2, j]
        for k in range(1, 3):
            x, y, z = _cross(rate[0], rate[1], rate[2], out[k - 1, 0, j], out[k - 1, 1, j],
                             out[k - 1, 2, j])
            out[k, 0, j], out[k, 1, j], out[k, 2, j] = x / k, y / k, z / k
    return out


@inlined_kernel
def _turned(turns, tau, x, y, z):  # type: ignore[no-untyped-def]
    """A vector turned by the rotation of `_turns` at tau."""
    s = tau * tau
    return (
        (turns[0, 0, 0] + tau * turns[1, 0, 0] + s * turns[2, 0, 0]) * x
        + (turns[0, 0, 1] + tau * turns[1, 0, 1] + s * turns[2, 0, 1]) * y
        + (turns[0, 0, 2] + tau * turns[1, 0, 2] + s * turns[2, 0, 2]) * z,
        (turns[0, 1, 0] + tau * turns[1, 1, 0] + s * turns[2, 1, 0]) * x
        + (turns[0, 1, 1] + tau * turns[1, 1, 1] + s * turns[2, 1, 1]) * y
        + (turns[0, 1, 2] + tau * turns[1, 1, 2] + s * turns[2, 1, 2]) * z,
        (turns[0, 2, 0] + tau * turns[1, 2, 0] + s * turns[2, 2, 0]) * x
        + (turns[0, 2, 1] + tau * turns[1, 2, 1] + s * turns[2, 2, 1]) * y
        + (turns[0, 2, 2] + tau * turns[1, 2, 2] + s * turns[2, 2, 2]) * z)


@linked_kernel
def _gather(observations: Array, weights: Array, first: int, block: Array) -> tuple[int, int]:
    """Fill `block` (21, BLOCK) with the matches that have a weight, from number `first` on.

    The last row is for the roots of their weights. Returns the number from which to go on, and how
    many matches there are. The rest of the block is zero: such a match has no residual and no
    derivative.
    """
    count = 0
    while first < observations.shape[0] and count < BLOCK:
        if weights[first] > 0.0:
            for k in range(20):
                block[k, count] = observations[first, k]
            block[20, count] = math.sqrt(weights[first])
            count += 1
        first += 1
    for i in range(count, BLOCK):
        for k in range(21):
            block[k, i] = 0.0
    return first, count


@inlined_kernel
def _residual(o, i, baselines, turns1, turns2):  # type: ignore[no-untyped-def]
    """Residual [px] of column i of a block, and the vectors that its derivative needs.

    They are b, f_1, h, p', h', where ``dr`` is the sum of the variations of the triple products
    b.(p' x h) and b.(f_1 x h').
    """
    tau1, tau2 = o[18, i], o[19, i]
    bx = baselines[0, 0] + tau1 * baselines[1, 0] + tau2 * baselines[2, 0]
    by = baselines[0, 1] + tau1 * baselines[1, 1] + tau2 * baselines[2, 1]
    bz = baselines[0, 2] + tau1 * baselines[1, 2] + tau2 * baselines[2, 2]
    fx, fy, fz = _turned(turns1, tau1, o[0, i], o[1, i], o[2, i])
    ux, uy, uz = _turned(turns1, tau1, o[3, i], o[4, i], o[5, i])
    vx, vy, vz = _turned(turns1, tau1, o[6, i], o[7, i], o[8, i])
    hx, hy, hz = _turned(turns2, tau2, o[9, i], o[10, i], o[11, i])
    hux, huy, huz = _turned(turns2, tau2, o[12, i], o[13, i], o[14, i])
    hvx, hvy, hvz = _turned(turns2, tau2, o[15, i], o[16, i], o[17, i])
    # h x b and b x f_1: the gradients of e by f_1 and by h.
    gx, gy, gz = _cross(hx, hy, hz, bx, by, bz)
    kx, ky, kz = _cross(bx, by, bz, fx, fy, fz)
    e = gx * fx + gy * fy + gz * fz
    q1 = gx * ux + gy * uy + gz * uz
    q2 = gx * vx + gy * vy + gz * vz
    q3 = kx * hux + ky * huy + kz * huz
    q4 = kx * hvx + ky * hvy + kz * hvz
    # Rays on the epipole have no gradient; the floor is far below any real one (1/px).
    c0 = 1.0 / math.sqrt(q1 * q1 + q2 * q2 + q3 * q3 + q4 * q4 + 1e-30)
    r = e * c0
    c = -r * c0 * c0
    c1, c2, c3, c4 = c * q1, c * q2, c * q3, c * q4
    return (r, (bx, by, bz), (fx, fy, fz), (hx, hy, hz),
            (c0 * fx + c1 * ux + c2 * vx, c0 * fy + c1 * uy + c2 * vy,
             c0 * fz + c1 * uz + c2 * vz),
            (c3 * hux + c4 * hvx, c3 * huy + c4 * hvy, c3 * huz + c4 * hvz))


@inlined_kernel
def _linearise(o, baselines, turns1, turns2, basis, rows):  # type: ignore[no-untyped-def]
    """Derivatives and residuals of a block, times the roots of the weights.

    `rows` (18, BLOCK): the residual last.
    """
    for i in range(BLOCK):
        r, (bx, by, bz), (fx, fy, fz), (hx, hy, hz), (px, py, pz), (jx, jy, jz) = _residual(
            o, i, baselines, turns1, turns2)
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
        # by a turn of the first rays: one of all three vectors, b too, would change nothing
        mx, my, mz = _cross(bx, by, bz, nx, ny, nz)
        wx, wy, wz = -rx - mx, -ry - my, -rz - mz
        # All of a row is linear in one of n, r and w, or is the residual.
        root = o[20, i]
        r, rx, ry, rz = root * r, root * rx, root * ry, root * rz
        nx, ny, nz, wx, wy, wz = root * nx, root * ny, root * nz, root * wx, root * wy, root * wz
        tau1, tau2 = o[18, i], o[19, i]
        rows[0, i], rows[1, i], rows[2, i] = rx, ry, rz
        rows[3, i] = nx * basis[0, 0] + ny * basis[1, 0] + nz * basis[2, 0]
        rows[4, i] = nx * basis[0, 1] + ny * basis[1, 1] + nz * basis[2, 1]
        rows[5, i], rows[6, i], rows[7, i] = -tau1 * nx, -tau1 * ny, -tau1 * nz
        rows[8, i], rows[9, i], rows[10, i] = tau2 * nx, tau2 * ny, tau2 * nz
        rows[11, i], rows[12, i], rows[13, i] = tau1 * wx, tau1 * wy, tau1 * wz
        rows[14, i], rows[15, i], rows[16, i] = tau2 * rx, tau2 * ry, tau2 * rz
        rows[17, i] = r


@linked_kernel
def residuals(observations: Array, state: TwoViewState) -> Array:
    """Signed Sampson errors (N,) [px] of observation rows (N, 20)."""
    n = observations.shape[0]
    baselines = _baselines(state)
    turns1, turns2 = _turns(state.dw1, np.eye(3)), _turns(state.dw2, state.R)
    block, errors = np.empty((21, BLOCK)), np.empty(BLOCK)
    everything = np.ones(n)
    out = np.empty(n)
    first = 0
    while first < n:
        following, count = _gather(observations, everything, first, block)
        for i in range(BLOCK):
            errors[i] = _residual(block, i, baselines, turns1, turns2)[0]
        copy_vector(errors[:count], out[first:])
        first = following
    return out


@kernel
def jacobian(observations: Array, state: TwoViewState) -> Array:
    """Derivatives (N, 17) of the Sampson errors by the local parameters."""
    n = observations.shape[0]
    baselines = _baselines(state)
    turns1, turns2 = _turns(state.dw1, np.eye(3)), _turns(state.dw2, state.R)
    basis = tangent_basis(state.t)
    block, rows = np.empty((21, BLOCK)), np.empty((PARAMETERS + 1, BLOCK))
    everything = np.ones(n)
    out = np.empty((n, PARAMETERS))
    first = 0
    while first < n:
        following, count = _gather(observations, everything, first, block)
        _linearise(block, baselines, turns1, turns2, basis, rows)
        out[first:following] = rows[:PARAMETERS, :count].T
        first = following
    return out


@linked_kernel
def normal_equations(observations: Array, weights: Array,
                     state: TwoViewState) -> tuple[Array, Array, float]:
    """``J^T W J`` (17, 17), ``J^T W r`` (17,) and ``r^T W r`` with the weights (N,) of matches."""
    baselines = _baselines(state)
    turns1, turns2 = _turns(state.dw1, np.eye(3)), _turns(state.dw2, state.R)
    basis = tangent_basis(state.t)
    block, rows = np.empty((21, BLOCK)), np.empty((PARAMETERS + 1, BLOCK))
    # The residual as the last column of J: one product holds all three results. By BLAS, whose
    # sums are in one order whoever calls; a block is too small for it to start threads.
    gram = np.zeros((PARAMETERS + 1, PARAMETERS + 1))
    product = np.empty((PARAMETERS + 1, PARAMETERS + 1))
    first = 0
    while first < observations.shape[0]:
        first, _ = _gather(observations, weights, first, block)
        _linearise(block, baselines, turns1, turns2, basis, rows)
        np.dot(rows, rows.T, product)
        gram += product
    hessian = gram[:PARAMETERS, :PARAMETERS].copy()
    return hessian, gram[PARAMETERS, :PARAMETERS].copy(), gram[PARAMETERS, PARAMETERS]


@kernel
def triangulated(observations: Array, i: int,
                 state: TwoViewState) -> tuple[float, float, float, float]:
    """Depths of match i along both rays [baselines], its parallax [rad] and length of baseline.

    ``l_1 f_1 = l_2 h + b`` in the least-squares sense of its cross products with h and f_1, each
    match with its own row times; depths are NaN where the rays are parallel.
    """
    o = observations[i]
    tau1, tau2 = o[18], o[19]
    t, d1, d2 = state.t, state.d1, state.d2
    b = (t[0] - tau1 * d1[0] + tau2 * d2[0], t[1] - tau1 * d1[1] + tau2 * d2[1],
         t[2] - tau1 * d1[2] + tau2 * d2[2])
    f, h = o[0:3], rotated(state.R, o[9:12])
    n = cross(f, h)
    n2 = dot(n, n)
    baseline = norm(b)
    if n2 < 1e-18:
        return math.nan, math.nan, 0.0, baseline
    return dot(cross(b, h), n) / n2, dot(cross(b, f), n) / n2, math.sqrt(n2), baseline
