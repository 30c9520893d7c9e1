"""Gravity as two degrees of freedom of the relative rotation.

With ``A_i g_i = z`` for the unit gravity directions g_i of the two cameras,

    R = A_1^T Rz(psi) A_2

holds with one unknown angle psi: the paper's ``R = R(phi_2, theta_2)^T R(psi) R(phi_1, theta_1)``
(section 'Gravity and Angular Velocity Measurements'), written for our R and with the vertical
on z instead of y.
"""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from rs_relpose_ros.compiled import kernel

Array = NDArray[np.float64]


@kernel
def gravity_alignment(gravity: Array) -> Array:
    """Smallest rotation matrix (3, 3) that turns `gravity` (3,), of any length, onto +z."""
    length = math.sqrt(gravity[0] ** 2 + gravity[1] ** 2 + gravity[2] ** 2)
    x, y, z = gravity[0] / length, gravity[1] / length, gravity[2] / length
    horizontal2 = x * x + y * y
    A = np.zeros((3, 3))
    if z < 0.0 and horizontal2 < 1e-30:
        # Opposite to z: every half turn about a horizontal axis is a smallest one.
        A[0, 0], A[1, 1], A[2, 2] = 1.0, -1.0, -1.0
        return A
    # 1 / (1 + z), without cancellation near z = -1.
    k = 1.0 / (1.0 + z) if z >= 0.0 else (1.0 - z) / horizontal2
    A[0, 0], A[0, 1], A[0, 2] = 1.0 - k * x * x, -k * x * y, -x
    A[1, 0], A[1, 1], A[1, 2] = -k * x * y, 1.0 - k * y * y, -y
    A[2, 0], A[2, 1], A[2, 2] = x, y, z
    return A


@kernel
def rotation_from_yaw(psi: float, A1: Array, A2: Array, R: Array) -> None:
    """Write ``A_1^T Rz(psi) A_2`` into `R` (3, 3)."""
    c, s = math.cos(psi), math.sin(psi)
    for j in range(3):
        x = c * A2[0, j] - s * A2[1, j]
        y = s * A2[0, j] + c * A2[1, j]
        z = A2[2, j]
        for i in range(3):
            R[i, j] = A1[0, i] * x + A1[1, i] * y + A1[2, i] * z


@kernel
def rotate_rows(A: Array, rays: Array, out: Array) -> None:
    """Write ``A f`` for every row f of `rays` (n, 3) into `out` (n, 3)."""
    for k in range(rays.shape[0]):
        for i in range(3):
            out[k, i] = A[i, 0] * rays[k, 0] + A[i, 1] * rays[k, 1] + A[i, 2] * rays[k, 2]


@kernel
def normals_at_yaw(a: Array, b: Array, c: float, s: float, normals: Array,
                   derivatives: Array) -> None:
    """Epipolar normals ``a x Rz(psi) b`` of gravity-aligned rays, and d/d psi of them.

    Parameters
    ----------
    a, b : (n, 3) ndarray
        ``A_1 f_1`` and ``A_2 f_2``.
    c, s : float
        Cosine and sine of psi.
    normals, derivatives : (n, 3) ndarray
        Overwritten; normals are in the aligned frame, ``A_1 (f_1 x R f_2)``.
    """
    for k in range(a.shape[0]):
        hx = c * b[k, 0] - s * b[k, 1]
        hy = s * b[k, 0] + c * b[k, 1]
        hz = b[k, 2]
        normals[k, 0] = a[k, 1] * hz - a[k, 2] * hy
        normals[k, 1] = a[k, 2] * hx - a[k, 0] * hz
        normals[k, 2] = a[k, 0] * hy - a[k, 1] * hx
        # dh / d psi = (-hy, hx, 0)
        derivatives[k, 0] = -a[k, 2] * hx
        derivatives[k, 1] = -a[k, 2] * hy
        derivatives[k, 2] = a[k, 0] * hx + a[k, 1] * hy


@kernel
def centre_yaw(a: Array, b: Array) -> tuple[float, float]:
    """Turn `b` so that the solutions crowd about yaw 0.

    The normals ``a x Rz(psi) b`` of distant points all nearly vanish at the true yaw, so that the
    zeros of a determinant of them crowd there, within about the parallax.

    Parameters
    ----------
    a, b : (n, 3) ndarray
        Gravity-aligned unit rays; `b` is turned in place by the yaw that best aligns them.

    Returns
    -------
    centre, width : float
        ``argmax sum a . Rz(psi) b`` [rad], and the rms distance of the aligned rays, in
        [1e-3, 1].
    """
    n = a.shape[0]
    along, across = 0.0, 0.0
    for k in range(n):
        along += a[k, 0] * b[k, 0] + a[k, 1] * b[k, 1]
        across += a[k, 1] * b[k, 0] - a[k, 0] * b[k, 1]
    length = math.sqrt(along * along + across * across)
    c, s = (along / length, across / length) if length > 0.0 else (1.0, 0.0)
    total = 0.0
    for k in range(n):
        b[k, 0], b[k, 1] = c * b[k, 0] - s * b[k, 1], s * b[k, 0] + c * b[k, 1]
        total += (a[k, 0] - b[k, 0]) ** 2 + (a[k, 1] - b[k, 1]) ** 2 + (a[k, 2] - b[k, 2]) ** 2
    return math.atan2(s, c), min(max(math.sqrt(total / n), 1e-3), 1.0)
