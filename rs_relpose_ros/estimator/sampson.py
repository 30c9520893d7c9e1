"""The rolling-shutter Sampson error in pixels, its exact Jacobian, depths, inliers and noise.

Constraint (docs/conventions.md), with ``b = t - tau_1 d_1 + tau_2 d_2`` and ``h = R f_2``::

    e = (f_1 x h) . b = 0
    r = e / sqrt(sum_k q_k^2),   q_k = de / d(pixel coordinate k)          [px]

Every scalar above is a triple product ``b . (p x h)``: of the ray f_1 or its derivative a by a
pixel coordinate, with h or R times the derivative of f_2. Derivatives by the pixel include the
distortion and the rotation of the camera from row to row: the error is in raw pixels.

An observation row (20 floats) holds, for one match,
``f_1, df_1/du, df_1/dv, f_2, df_2/du, df_2/dv, tau_1, tau_2``.

Matches are evaluated in blocks with the values of one quantity contiguous in memory, which the
compiler vectorises. For that it must know the strides, hence the arrays of fixed shape and the
forced inlining.
"""

import math
from typing import NamedTuple

import numpy as np

from rs_relpose_ros.core.losses import Flags
from rs_relpose_ros.core.triangulate import depths
from rs_relpose_ros.estimator.priors import PARAMETERS, TwoViewState
from rs_relpose_ros.geometry import Array, so3
from rs_relpose_ros.jit import inlined_kernel, kernel, small_kernel

# Matches of a block: enough to vectorise, few enough for the nearest cache.
BLOCK = 64


@inlined_kernel
def _cross(ax, ay, az, bx, by, bz):  # type: ignore[no-untyped-def]
    return ay * bz - az * by, az * bx - ax * bz, ax * by - ay * bx


@inlined_kernel
def _coefficients(state: TwoViewState) -> tuple[Array, Array, Array]:
    """Of ``b = t - tau_1 d_1 + tau_2 d_2`` in 1, tau_1, tau_2 (3, 3), and `_rotation_series`."""
    b = np.empty((3, 3))
    for k in range(3):
        b[0, k], b[1, k], b[2, k] = state.t[k], -state.d1[k], state.d2[k]
    return b, _rotation_series(state.dw1, np.eye(3)), _rotation_series(state.dw2, state.R)


@inlined_kernel
def _rotation_series(rate: Array, R: Array) -> Array:
    """Coefficients (3, 3, 3) of ``Exp(w tau) R`` in 1, tau, tau^2: w is a gyro correction."""
    out = np.empty((3, 3, 3))
    for j in range(3):
        out[0, 0, j], out[0, 1, j], out[0, 2, j] = R[0, j], R[1, j], R[2, j]
        for k in range(1, 3):
            x, y, z = _cross(
                rate[0], rate[1], rate[2], out[k - 1, 0, j], out[k - 1, 1, j], out[k - 1, 2, j]
            )
            out[k, 0, j], out[k, 1, j], out[k, 2, j] = x / k, y / k, z / k
    return out


@inlined_kernel
def _rotated(series, tau, x, y, z):  # type: ignore[no-untyped-def]
    """A vector times the rotation of `_rotation_series` at tau."""
    s = tau * tau
    return (
        (series[0, 0, 0] + tau * series[1, 0, 0] + s * series[2, 0, 0]) * x
        + (series[0, 0, 1] + tau * series[1, 0, 1] + s * series[2, 0, 1]) * y
        + (series[0, 0, 2] + tau * series[1, 0, 2] + s * series[2, 0, 2]) * z,
        (series[0, 1, 0] + tau * series[1, 1, 0] + s * series[2, 1, 0]) * x
        + (series[0, 1, 1] + tau * series[1, 1, 1] + s * series[2, 1, 1]) * y
        + (series[0, 1, 2] + tau * series[1, 1, 2] + s * series[2, 1, 2]) * z,
        (series[0, 2, 0] + tau * series[1, 2, 0] + s * series[2, 2, 0]) * x
        + (series[0, 2, 1] + tau * series[1, 2, 1] + s * series[2, 2, 1]) * y
        + (series[0, 2, 2] + tau * series[1, 2, 2] + s * series[2, 2, 2]) * z,
    )


@kernel
def _gather(observations: Array, weights: Array, first: int, block: Array) -> tuple[int, int]:
    """Fill `block` (21, BLOCK) with the matches that have a weight, from number `first` on.

    The last row holds the roots of their weights. Returns the next number, and how many matches
    there are. The rest of the block is zero, with zero residuals and derivatives.
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
def _residual(o, i, baselines, series1, series2):  # type: ignore[no-untyped-def]
    """Residual [px] of column i of a block, and the vectors that its derivative needs.

    They are b, f_1, h, p', h', where ``dr`` is the sum of the variations of the triple products
    b.(p' x h) and b.(f_1 x h').
    """
    tau1, tau2 = o[18, i], o[19, i]
    bx = baselines[0, 0] + tau1 * baselines[1, 0] + tau2 * baselines[2, 0]
    by = baselines[0, 1] + tau1 * baselines[1, 1] + tau2 * baselines[2, 1]
    bz = baselines[0, 2] + tau1 * baselines[1, 2] + tau2 * baselines[2, 2]
    fx, fy, fz = _rotated(series1, tau1, o[0, i], o[1, i], o[2, i])
    ux, uy, uz = _rotated(series1, tau1, o[3, i], o[4, i], o[5, i])
    vx, vy, vz = _rotated(series1, tau1, o[6, i], o[7, i], o[8, i])
    hx, hy, hz = _rotated(series2, tau2, o[9, i], o[10, i], o[11, i])
    hux, huy, huz = _rotated(series2, tau2, o[12, i], o[13, i], o[14, i])
    hvx, hvy, hvz = _rotated(series2, tau2, o[15, i], o[16, i], o[17, i])
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
    return (
        r,
        (bx, by, bz),
        (fx, fy, fz),
        (hx, hy, hz),
        (c0 * fx + c1 * ux + c2 * vx, c0 * fy + c1 * uy + c2 * vy, c0 * fz + c1 * uz + c2 * vz),
        (c3 * hux + c4 * hvx, c3 * huy + c4 * hvy, c3 * huz + c4 * hvz),
    )


@inlined_kernel
def _linearise(o, baselines, series1, series2, basis, rows):  # type: ignore[no-untyped-def]
    """Derivatives of a block in `rows` (18, BLOCK), residuals last, times the weights' roots."""
    for i in range(BLOCK):
        r, (bx, by, bz), (fx, fy, fz), (hx, hy, hz), (px, py, pz), (jx, jy, jz) = _residual(
            o, i, baselines, series1, series2
        )
        # by b: p' x h + f_1 x h'
        nx, ny, nz = _cross(px, py, pz, hx, hy, hz)
        mx, my, mz = _cross(fx, fy, fz, jx, jy, jz)
        nx, ny, nz = nx + mx, ny + my, nz + mz
        # by a rotation of the second rays: h x (b x p') + h' x (b x f_1)
        sx, sy, sz = _cross(bx, by, bz, px, py, pz)
        rx, ry, rz = _cross(hx, hy, hz, sx, sy, sz)
        kx, ky, kz = _cross(bx, by, bz, fx, fy, fz)
        mx, my, mz = _cross(jx, jy, jz, kx, ky, kz)
        rx, ry, rz = rx + mx, ry + my, rz + mz
        # by a rotation of the first rays: that of all three vectors, b too, changes nothing
        mx, my, mz = _cross(bx, by, bz, nx, ny, nz)
        wx, wy, wz = -rx - mx, -ry - my, -rz - mz
        # Each entry of a row is linear in one of n, r and w, or is the residual.
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


@kernel
def residuals(observations: Array, state: TwoViewState) -> Array:
    """Signed Sampson errors (N,) [px] of observation rows (N, 20)."""
    n = observations.shape[0]
    baselines, series1, series2 = _coefficients(state)
    block, errors = np.empty((21, BLOCK)), np.empty(BLOCK)
    everything = np.ones(n)
    out = np.empty(n)
    first = 0
    while first < n:
        following, count = _gather(observations, everything, first, block)
        for i in range(BLOCK):
            errors[i] = _residual(block, i, baselines, series1, series2)[0]
        so3.copy_vector(errors[:count], out[first:])
        first = following
    return out


@kernel
def jacobian(observations: Array, state: TwoViewState) -> Array:
    """Derivatives (N, 17) of the Sampson errors by the local parameters."""
    n = observations.shape[0]
    baselines, series1, series2 = _coefficients(state)
    basis = so3.tangent_basis(state.t)
    block, rows = np.empty((21, BLOCK)), np.empty((PARAMETERS + 1, BLOCK))
    everything = np.ones(n)
    out = np.empty((n, PARAMETERS))
    first = 0
    while first < n:
        following, count = _gather(observations, everything, first, block)
        _linearise(block, baselines, series1, series2, basis, rows)
        for i in range(count):
            for j in range(PARAMETERS):
                out[first + i, j] = rows[j, i]
        first = following
    return out


@kernel
def normal_equations(
    observations: Array, weights: Array, state: TwoViewState
) -> tuple[Array, Array, float]:
    """``J^T W J`` (17, 17), ``J^T W r`` (17,) and ``r^T W r`` with the weights (N,) of matches."""
    baselines, series1, series2 = _coefficients(state)
    basis = so3.tangent_basis(state.t)
    block, rows = np.empty((21, BLOCK)), np.empty((PARAMETERS + 1, BLOCK))
    # The residual as the last column of J: one product contains all three results. By BLAS, with
    # a fixed order of its sums: a block is too small for threads.
    gram = np.zeros((PARAMETERS + 1, PARAMETERS + 1))
    product = np.empty((PARAMETERS + 1, PARAMETERS + 1))
    first = 0
    while first < observations.shape[0]:
        first, _ = _gather(observations, weights, first, block)
        _linearise(block, baselines, series1, series2, basis, rows)
        np.dot(rows, rows.T, product)
        gram += product
    hessian = gram[:PARAMETERS, :PARAMETERS].copy()
    return hessian, gram[PARAMETERS, :PARAMETERS].copy(), gram[PARAMETERS, PARAMETERS]


@kernel
def triangulated(
    observations: Array, i: int, state: TwoViewState
) -> tuple[float, float, float, float]:
    """Depths of match i along both rays [baselines], its parallax [rad] and length of baseline.

    The baseline lies between the places of the camera at the two rows of the match. Depths are
    NaN if the rays are parallel.
    """
    o = observations[i]
    tau1, tau2 = o[18], o[19]
    t, d1, d2 = state.t, state.d1, state.d2
    b = (
        t[0] - tau1 * d1[0] + tau2 * d2[0],
        t[1] - tau1 * d1[1] + tau2 * d2[1],
        t[2] - tau1 * d1[2] + tau2 * d2[2],
    )
    depth1, depth2, parallax = depths(o[0:3], so3.rotated(state.R, o[9:12]), b)
    return depth1, depth2, parallax, so3.norm(b)


# -- Inliers of a state: by residuals and by depths -----------------------------------------------

# A depth is tested only if the parallax is this many times its noise.
SIGNIFICANT_PARALLAX = 4.0
# A match is an outlier if the logarithm of its depth is this many times as far from the median as
# the quantile of one sigma on that side.
DEPTH_GATE = 4.0
DEPTH_QUANTILES = (0.16, 0.5, 0.84)
# Least spread of the depths of a scene (log units): keeps the gate open on planar scenes.
MIN_DEPTH_SPREAD = 0.25


class RayMatches(NamedTuple):
    """All matches of a pair."""

    observations: Array  # (N, 20) rows as above
    valid: Flags  # (N,) those with finite rays
    angle_sigma: float  # noise of a ray [rad]


@kernel
def cheirality_sign(observations: Array, use: Flags, state: TwoViewState) -> float:
    """+1 or -1: the sign of (t, d_1, d_2) with more of the matches in front of the cameras.

    Matches are weighted with their parallax: the sign of a depth without parallax is noise.
    """
    vote = 0.0
    for i in range(observations.shape[0]):
        if use[i]:
            depth1, depth2, _, _ = triangulated(observations, i, state)
            if not math.isnan(depth1):
                # Bounded: a match on the baseline has an arbitrarily large inverse depth.
                vote += max(-1.0, min(1.0, 0.5 / depth1)) + max(-1.0, min(1.0, 0.5 / depth2))
    return 1.0 if vote >= 0.0 else -1.0


@small_kernel
def count_behind(matches: RayMatches, use: Flags, state: TwoViewState) -> int:
    """How many of the matches in `use` lie behind a camera, with a significant parallax."""
    count = 0
    for i in range(len(use)):
        if use[i]:
            depth1, depth2, parallax, _ = triangulated(matches.observations, i, state)
            if (
                parallax >= SIGNIFICANT_PARALLAX * matches.angle_sigma
                and min(depth1, depth2) <= 0.0
            ):
                count += 1
    return count


@kernel
def within(r: Array, matches: RayMatches, state: TwoViewState, threshold: float) -> Flags:
    """Matches whose residuals `r` (N,) at `state` are below `threshold`, of plausible depths.

    A random match within the epipolar band has a small residual, but lies behind a camera or far
    from the others' depths.
    """
    n = len(r)
    use = np.empty(n, dtype=np.bool_)
    # Depths in units of the distance between the camera's places at the two rows; NaN: untested.
    relative, known, count = np.full(n, np.nan), np.empty(n), 0
    for i in range(n):
        use[i] = matches.valid[i] and abs(r[i]) < threshold
        if not use[i]:
            continue
        depth1, depth2, parallax, baseline = triangulated(matches.observations, i, state)
        if not parallax >= SIGNIFICANT_PARALLAX * matches.angle_sigma:
            continue
        if depth1 <= 0.0 or depth2 <= 0.0:
            use[i] = False
            continue
        relative[i] = known[count] = min(depth1, depth2) / baseline
        count += 1
    if count < 8:
        return use
    # Near and far side separately: a scene is denser far away, and its few near points, which
    # resemble outliers, determine most of the translation.
    known, last = known[:count], count - 1
    near, centre, far = (
        math.log(so3.smallest(known, int(DEPTH_QUANTILES[0] * last))),
        math.log(so3.smallest(known, int(DEPTH_QUANTILES[1] * last))),
        math.log(so3.smallest(known, int(DEPTH_QUANTILES[2] * last))),
    )
    lowest = math.exp(centre - DEPTH_GATE * max(centre - near, MIN_DEPTH_SPREAD))
    highest = math.exp(centre + DEPTH_GATE * max(far - centre, MIN_DEPTH_SPREAD))
    for i in range(n):
        if relative[i] < lowest or relative[i] > highest:
            use[i] = False
    return use


@kernel
def select_inliers(matches: RayMatches, state: TwoViewState, threshold: float) -> Flags:
    """Matches within `threshold` [px] whose depths are plausible."""
    return within(residuals(matches.observations, state), matches, state, threshold)
