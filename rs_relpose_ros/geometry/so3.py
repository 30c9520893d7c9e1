"""Vectors, rotations and order statistics for compiled code.

Code outside of kernels uses SciPy's ``Rotation``. An argument of a small kernel is a tuple or an
array (3,), such as the row ``rays[k]`` of an array of rays; a result is a tuple. Small kernels are
inlined in their callers, without allocation. Every sum runs over x, y, z in this order, so that
it has the same bits as a sum that is written out.
"""

import math

from numba.extending import register_jitable
import numpy as np

from rs_relpose_ros.geometry import Array
from rs_relpose_ros.jit import kernel, small_kernel

Vector = tuple[float, float, float]

# Standard acceleration of free fall [m/s^2]. [derived: ISO 80000-3]
STANDARD_GRAVITY = 9.80665


@small_kernel
def dot(a: Vector | Array, b: Vector | Array) -> float:
    """``a . b``."""
    return a[0] * b[0] + a[1] * b[1] + a[2] * b[2]


@small_kernel
def cross(a: Vector | Array, b: Vector | Array) -> Vector:
    """``a x b``."""
    return (
        a[1] * b[2] - a[2] * b[1],
        a[2] * b[0] - a[0] * b[2],
        a[0] * b[1] - a[1] * b[0],
    )


@small_kernel
def add(a: Vector | Array, b: Vector | Array) -> Vector:
    """``a + b``."""
    return (
        a[0] + b[0],
        a[1] + b[1],
        a[2] + b[2],
    )


@small_kernel
def subtract(a: Vector | Array, b: Vector | Array) -> Vector:
    """``a - b``."""
    return (
        a[0] - b[0],
        a[1] - b[1],
        a[2] - b[2],
    )


@small_kernel
def scale(factor: float, v: Vector | Array) -> Vector:
    """``factor v``."""
    return (
        factor * v[0],
        factor * v[1],
        factor * v[2],
    )


@small_kernel
def column(rows: Array, first: int, i: int) -> Vector:
    """Vector in column i of `rows` (n, m), from row `first` on."""
    return (
        rows[first, i],
        rows[first + 1, i],
        rows[first + 2, i],
    )


@small_kernel
def write_column(v: Vector, rows: Array, first: int, i: int) -> None:
    """Write a vector into column i of `rows` (n, m), from row `first` on."""
    rows[first, i] = v[0]
    rows[first + 1, i] = v[1]
    rows[first + 2, i] = v[2]


@small_kernel
def norm(v: Vector | Array) -> float:
    """``|v|`` of a vector whose squares neither overflow nor vanish."""
    return math.sqrt(v[0] * v[0] + v[1] * v[1] + v[2] * v[2])


@small_kernel
def copy_vector(source: Array, out: Array) -> None:
    """``out[:] = source`` of (n,).

    Numba would take seconds to compile the error message of the slice assignment.
    """
    for i in range(len(source)):
        out[i] = source[i]


@small_kernel
def copy_matrix(source: Array, out: Array) -> None:
    """``out[:] = source`` of (n, m), for the same reason."""
    for i in range(source.shape[0]):
        for j in range(source.shape[1]):
            out[i, j] = source[i, j]


@small_kernel
def rotated(R: Array, v: Vector | Array) -> Vector:
    """``R v`` with any matrix R (3, 3)."""
    return (
        dot(R[0], v),
        dot(R[1], v),
        dot(R[2], v),
    )


@small_kernel
def rotated_back(R: Array, v: Vector | Array) -> Vector:
    """``R^T v`` with any matrix R (3, 3)."""
    return (
        dot(R[:, 0], v),
        dot(R[:, 1], v),
        dot(R[:, 2], v),
    )


@kernel
def tangent_basis(t: Array) -> Array:
    """Two orthonormal columns (3, 2) perpendicular to the unit vector `t`."""
    basis = np.empty((3, 2))
    axis = np.zeros(3)
    # The axis least aligned with t keeps the cross product well conditioned.
    k = 0
    for i in (1, 2):
        if abs(t[i]) < abs(t[k]):
            k = i
    axis[k] = 1.0
    u = cross(t, axis)
    length = norm(u)
    for i in range(3):
        basis[i, 0] = u[i] / length
    write_column(cross(t, basis[:, 0]), basis, 0, 1)
    return basis


@small_kernel
def rodrigues(theta2: float) -> tuple[float, float]:
    """``sin(theta) / theta`` and ``(1 - cos(theta)) / theta^2`` from theta squared [rad^2]."""
    if theta2 < 1e-8:
        return 1.0 - theta2 / 6.0, 0.5 - theta2 / 24.0
    theta = math.sqrt(theta2)
    return math.sin(theta) / theta, (1.0 - math.cos(theta)) / theta2


@kernel
def _skew_series(v: Array, a: float, b: float) -> Array:
    """``I + a [v]x + b [v]x^2`` (3, 3)."""
    x = v[0]
    y = v[1]
    z = v[2]
    xy = b * x * y
    xz = b * x * z
    yz = b * y * z
    out = np.empty((3, 3))
    out[0, 0] = 1.0 - b * (y * y + z * z)
    out[1, 1] = 1.0 - b * (x * x + z * z)
    out[2, 2] = 1.0 - b * (x * x + y * y)
    out[0, 1] = xy - a * z
    out[1, 0] = xy + a * z
    out[0, 2] = xz + a * y
    out[2, 0] = xz - a * y
    out[1, 2] = yz - a * x
    out[2, 1] = yz + a * x
    return out


@kernel
def exp_so3(v: Array) -> Array:
    """Rotation matrix of the rotation vector `v` (3,) [rad] (Rodrigues' formula)."""
    a, b = rodrigues(dot(v, v))
    return _skew_series(v, a, b)


@kernel
def log_so3(rotation: Array) -> Array:
    """Rotation vector (3,) [rad], of length at most pi, of a rotation matrix."""
    # The way through the quaternion is exact near 0 and near pi, where the trace formula loses
    # digits.
    q = np.empty(4)
    R = rotation
    trace = R[0, 0] + R[1, 1] + R[2, 2]
    if trace > 0.0:
        s = math.sqrt(trace + 1.0) * 2.0
        q[3] = 0.25 * s
        q[0] = (R[2, 1] - R[1, 2]) / s
        q[1] = (R[0, 2] - R[2, 0]) / s
        q[2] = (R[1, 0] - R[0, 1]) / s
    else:
        i = 0
        if R[1, 1] > R[0, 0]:
            i = 1
        if R[2, 2] > R[i, i]:
            i = 2
        j = (i + 1) % 3
        k = (i + 2) % 3
        largest = R[i, i] - R[j, j] - R[k, k] + 1.0
        s = math.sqrt(max(largest, 0.0)) * 2.0
        q[i] = 0.25 * s
        q[3] = (R[k, j] - R[j, k]) / s
        q[j] = (R[j, i] + R[i, j]) / s
        q[k] = (R[k, i] + R[i, k]) / s
    if q[3] < 0.0:
        q = -q
    sine = norm(q)  # `norm` takes the first three elements: x, y, z
    factor = 2.0 if sine < 1e-9 else 2.0 * math.atan2(sine, q[3]) / sine
    vector = np.empty(3)
    for i in range(3):
        vector[i] = factor * q[i]
    return vector


@kernel
def left_jacobian_so3(v: Array) -> Array:
    """Left Jacobian (3, 3) of SO(3): ``Exp(v + dv) = Exp(J dv) Exp(v)`` to first order."""
    theta2 = dot(v, v)
    if theta2 < 1e-8:
        return _skew_series(v, 0.5 - theta2 / 24.0, 1.0 / 6.0 - theta2 / 120.0)
    theta = math.sqrt(theta2)
    a = (1.0 - math.cos(theta)) / theta2
    b = (theta - math.sin(theta)) / (theta2 * theta)
    return _skew_series(v, a, b)


@kernel
def multiply(A: Array, B: Array, out: Array) -> None:
    """Write the product ``A B`` (3, 3) into `out`; the matrices are too small for BLAS."""
    for i in range(3):
        row = rotated_back(B, A[i])  # of A B: B^T a_i
        for j in range(3):
            out[i, j] = row[j]


@kernel
def product(A: Array, B: Array) -> Array:
    """``A B`` (3, 3)."""
    out = np.empty((3, 3))
    multiply(A, B, out)
    return out


@kernel
def product_transposed(A: Array, B: Array) -> Array:
    """``A B^T`` (3, 3)."""
    out = np.empty((3, 3))
    for i in range(3):
        for j in range(3):
            out[i, j] = dot(A[i], B[j])
    return out


@register_jitable
def skew(v: Vector | Array) -> Array:
    """Cross-product matrix (3, 3) of a vector (3,): ``skew(a) @ b = a x b``."""
    x = v[0]
    y = v[1]
    z = v[2]
    return np.array(
        [
            [0.0, -z, y],
            [z, 0.0, -x],
            [-y, x, 0.0],
        ]
    )


def heading(R: Array) -> Array:
    """Rotation vector (3,) about z [rad] that is closest to a rotation matrix (3, 3)."""
    sine = R[1, 0] - R[0, 1]
    cosine = R[0, 0] + R[1, 1]
    return np.array([0.0, 0.0, math.atan2(sine, cosine)])


def by_axes(matrix: Array) -> Array:
    """Kronecker product (3 n, 3 m) of a matrix (n, m) with the identity (3, 3)."""
    n, m = matrix.shape
    product = np.zeros((n, 3, m, 3))
    for axis in range(3):
        product[:, axis, :, axis] = matrix
    return product.reshape(3 * n, 3 * m)


def aligning_rotation(correlation: Array) -> Array:
    """Rotation R (3, 3) that minimises ``sum |a - R b|^2``, from ``sum a b^T`` (Wahba, Kabsch).

    SciPy's ``align_vectors`` warns if the rotation about one axis is arbitrary.
    """
    u, _, vt = np.linalg.svd(correlation)
    handedness = np.linalg.det(u) * np.linalg.det(vt)
    u[:, 2] *= handedness  # no reflection
    return np.ascontiguousarray(u @ vt)


# Order statistics follow, because Numba's own sort takes seconds to compile.


@kernel
def smallest(values: Array, k: int) -> float:
    """Element k of `values` (n,) in ascending order, by Hoare's *Find* (Comm. ACM 4, 1961).

    `values`, which must not hold NaN, are reordered: no value before index k is larger than the
    result, and no value after it is smaller.
    """
    low = 0
    high = len(values) - 1
    while low < high:
        pivot = values[(low + high) // 2]
        i = low
        j = high
        while i <= j:
            while values[i] < pivot:
                i += 1
            while pivot < values[j]:
                j -= 1
            if i <= j:
                values[i], values[j] = values[j], values[i]
                i += 1
                j -= 1
        if j < k:
            low = i
        if k < i:
            high = j
    return values[k]


@kernel
def median(values: Array) -> float:
    """Median of at least one value; `values`, which must not hold NaN, are reordered."""
    n = len(values)
    upper = smallest(values, n // 2)
    return upper if n % 2 == 1 else 0.5 * (smallest(values, n // 2 - 1) + upper)


@small_kernel
def step_rotation(rate1: Array, rate2: Array, dt: float) -> Array:
    """Rotation vector (3,) of a step of `dt` [s] between two rates (3,) [rad/s]: see `gyro`."""
    phi = np.empty(3)
    commutator = cross(rate1, rate2)
    for i in range(3):
        turned = 0.5 * (rate1[i] + rate2[i]) * dt
        phi[i] = turned + commutator[i] * dt * dt / 12.0
    return phi
