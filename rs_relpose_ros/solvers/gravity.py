"""Gravity as two degrees of freedom of the relative rotation.

With ``A_i g_i = z`` for the unit gravity directions g_i of the two cameras,

    R = A_1^T Rz(psi) A_2

holds with one unknown angle psi: the paper's ``R = R(phi_2, theta_2)^T R(psi) R(phi_1, theta_1)``
(section 'Gravity and Angular Velocity Measurements'), written for our R and with the vertical
on z instead of y.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from rs_relpose_ros.compiled import kernel
from rs_relpose_ros.geometry.vectors import cross, rotated, rotated_back
from rs_relpose_ros.solvers.solver import Knowledge, Sample

Array = NDArray[np.float64]


class AlignedRays(NamedTuple):
    """Rays in frames with gravity on z, the second turned so that solutions crowd about yaw 0.

    `a`, `b` (n, 3): ``A_1 f_1`` and ``Rz(centre) A_2 f_2``. `centre` [rad]: to be added to a yaw
    that is found with them. `zoom`: rms distance of a and b, about the width of the crowd.
    """

    a: Array
    b: Array
    centre: float
    zoom: float


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
def rotation_from_yaw(psi: float, known: Knowledge, R: Array) -> None:
    """Write ``A_1^T Rz(psi) A_2`` into `R` (3, 3)."""
    c, s = math.cos(psi), math.sin(psi)
    A2 = known.align2
    for j in range(3):
        turned = (c * A2[0, j] - s * A2[1, j], s * A2[0, j] + c * A2[1, j], A2[2, j])
        column = rotated_back(known.align1, turned)
        for i in range(3):
            R[i, j] = column[i]


@kernel
def normals_at_yaw(rays: AlignedRays, c: float, s: float, normals: Array,
                   derivatives: Array) -> None:
    """Epipolar normals ``n = a x h`` with ``h = Rz(psi) b``, and ``dn / dpsi``.

    Parameters
    ----------
    c, s : float
        Cosine and sine of psi.
    normals, derivatives : (n, 3) ndarray
        Overwritten; normals are in the aligned frame, ``A_1 (f_1 x R f_2)``.
    """
    for k in range(rays.a.shape[0]):
        a, b = rays.a[k], rays.b[k]
        h = (c * b[0] - s * b[1], s * b[0] + c * b[1], b[2])
        n = cross(a, h)
        # dh / dpsi = (-h_y, h_x, 0)
        dn = (-a[2] * h[0], -a[2] * h[1], a[0] * h[0] + a[1] * h[1])
        for i in range(3):
            normals[k, i], derivatives[k, i] = n[i], dn[i]


@kernel
def align_rays(sample: Sample, known: Knowledge) -> AlignedRays:
    """Turn gravity onto z, and the rays of the second camera onto those of the first.

    The normals ``a x Rz(psi) b`` of distant points all nearly vanish at the true yaw, so that the
    zeros of a determinant of them crowd there, within about the parallax. The centre of the crowd
    is about ``argmax sum a . Rz(psi) b``. The zoom lies in [1e-3, 1].
    """
    count = sample.f1.shape[0]
    a, b = np.empty((count, 3)), np.empty((count, 3))
    along, across = 0.0, 0.0
    for k in range(count):
        a_k, b_k = rotated(known.align1, sample.f1[k]), rotated(known.align2, sample.f2[k])
        for i in range(3):
            a[k, i], b[k, i] = a_k[i], b_k[i]
        along += a_k[0] * b_k[0] + a_k[1] * b_k[1]
        across += a_k[1] * b_k[0] - a_k[0] * b_k[1]
    length = math.sqrt(along * along + across * across)
    c, s = (along / length, across / length) if length > 0.0 else (1.0, 0.0)
    total = 0.0
    for k in range(count):
        b[k, 0], b[k, 1] = c * b[k, 0] - s * b[k, 1], s * b[k, 0] + c * b[k, 1]
        total += (a[k, 0] - b[k, 0]) ** 2 + (a[k, 1] - b[k, 1]) ** 2 + (a[k, 2] - b[k, 2]) ** 2
    zoom = min(max(math.sqrt(total / count), 1e-3), 1.0)
    return AlignedRays(a, b, math.atan2(s, c), zoom)
