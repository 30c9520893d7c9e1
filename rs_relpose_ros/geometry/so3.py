"""Rotations: kernels for compiled code; everything else uses SciPy's ``Rotation``."""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from rs_relpose_ros.compiled import kernel
from rs_relpose_ros.geometry.vectors import rotated_back

Array = NDArray[np.float64]


@kernel
def rodrigues(theta2: float) -> tuple[float, float]:
    """``sin(theta) / theta`` and ``(1 - cos(theta)) / theta^2`` of a squared angle [rad^2]."""
    if theta2 < 1e-8:
        return 1.0 - theta2 / 6.0, 0.5 - theta2 / 24.0
    theta = math.sqrt(theta2)
    return math.sin(theta) / theta, (1.0 - math.cos(theta)) / theta2


@kernel
def exp_so3(v: Array) -> Array:
    """Rotation matrix of the rotation vector `v` (3,) [rad] (Rodrigues' formula)."""
    x, y, z = v[0], v[1], v[2]
    a, b = rodrigues(x * x + y * y + z * z)
    rotation = np.empty((3, 3))
    rotation[0, 0] = 1.0 - b * (y * y + z * z)
    rotation[1, 1] = 1.0 - b * (x * x + z * z)
    rotation[2, 2] = 1.0 - b * (x * x + y * y)
    rotation[0, 1] = b * x * y - a * z
    rotation[1, 0] = b * x * y + a * z
    rotation[0, 2] = b * x * z + a * y
    rotation[2, 0] = b * x * z - a * y
    rotation[1, 2] = b * y * z - a * x
    rotation[2, 1] = b * y * z + a * x
    return rotation


@kernel
def log_so3(rotation: Array) -> Array:
    """Rotation vector (3,) [rad], of length at most pi, of a rotation matrix."""
    # Through the quaternion: exact near 0 and near pi, where the trace formula loses digits.
    q = np.empty(4)
    trace = rotation[0, 0] + rotation[1, 1] + rotation[2, 2]
    if trace > 0.0:
        s = math.sqrt(trace + 1.0) * 2.0
        q[3] = 0.25 * s
        q[0] = (rotation[2, 1] - rotation[1, 2]) / s
        q[1] = (rotation[0, 2] - rotation[2, 0]) / s
        q[2] = (rotation[1, 0] - rotation[0, 1]) / s
    else:
        i = 0
        if rotation[1, 1] > rotation[0, 0]:
            i = 1
        if rotation[2, 2] > rotation[i, i]:
            i = 2
        j = (i + 1) % 3
        k = (i + 2) % 3
        s = math.sqrt(max(rotation[i, i] - rotation[j, j] - rotation[k, k] + 1.0, 0.0)) * 2.0
        q[i] = 0.25 * s
        q[3] = (rotation[k, j] - rotation[j, k]) / s
        q[j] = (rotation[j, i] + rotation[i, j]) / s
        q[k] = (rotation[k, i] + rotation[i, k]) / s
    if q[3] < 0.0:
        q = -q
    sine = math.sqrt(q[0] * q[0] + q[1] * q[1] + q[2] * q[2])
    if sine < 1e-9:
        factor = 2.0
    else:
        factor = 2.0 * math.atan2(sine, q[3]) / sine
    vector = np.empty(3)
    for i in range(3):
        vector[i] = factor * q[i]
    return vector


@kernel
def left_jacobian_so3(v: Array) -> Array:
    """Left Jacobian (3, 3) of SO(3): ``Exp(v + dv) = Exp(J dv) Exp(v)`` to first order."""
    x, y, z = v[0], v[1], v[2]
    theta2 = x * x + y * y + z * z
    if theta2 < 1e-8:
        b = 0.5 - theta2 / 24.0
        c = 1.0 / 6.0 - theta2 / 120.0
    else:
        theta = math.sqrt(theta2)
        b = (1.0 - math.cos(theta)) / theta2
        c = (theta - math.sin(theta)) / (theta2 * theta)
    jacobian = np.empty((3, 3))
    jacobian[0, 0] = 1.0 - c * (y * y + z * z)
    jacobian[1, 1] = 1.0 - c * (x * x + z * z)
    jacobian[2, 2] = 1.0 - c * (x * x + y * y)
    jacobian[0, 1] = c * x * y - b * z
    jacobian[1, 0] = c * x * y + b * z
    jacobian[0, 2] = c * x * z + b * y
    jacobian[2, 0] = c * x * z - b * y
    jacobian[1, 2] = c * y * z - b * x
    jacobian[2, 1] = c * y * z + b * x
    return jacobian


@kernel
def multiply(A: Array, B: Array, out: Array) -> None:
    """Write ``A B`` of two matrices (3, 3) into a third one: for BLAS they are too small."""
    for i in range(3):
        out[i, 0], out[i, 1], out[i, 2] = rotated_back(B, A[i])  # row of A B: B^T a_i


def skew(v: Array) -> Array:
    """Cross-product matrix (3, 3) of a vector (3,): ``skew(a) @ b = a x b``."""
    return np.array([[0.0, -v[2], v[1]], [v[2], 0.0, -v[0]], [-v[1], v[0], 0.0]])


def aligning_rotation(correlation: Array) -> Array:
    """The rotation (3, 3) of least ``sum |a - R b|^2``, from ``sum a b^T`` (Wahba, Kabsch).

    As SciPy's ``align_vectors``, which warns where the turn about one axis is arbitrary.
    """
    u, _, vt = np.linalg.svd(correlation)
    u[:, 2] *= np.linalg.det(u) * np.linalg.det(vt)
    return np.ascontiguousarray(u @ vt)
