"""Vectors of three numbers in compiled code, without allocation.

An argument is a tuple or an array (3,), such as the row ``rays[k]`` of an array of rays; a result
is a tuple. The kernels are copied into their callers, so that a call costs no more than sums
written out. Every sum runs over x, y, z in this order, so that the bits are those of such sums.
"""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import ArrayLike, NDArray

from rs_relpose_ros.compiled import kernel, small_kernel
from rs_relpose_ros.errors import InputError

Array = NDArray[np.float64]
Vector = tuple[float, float, float]

# [m/s^2]
STANDARD_GRAVITY = 9.80665


@small_kernel
def dot(a: Vector | Array, b: Vector | Array) -> float:
    """``a . b``."""
    return a[0] * b[0] + a[1] * b[1] + a[2] * b[2]


@small_kernel
def cross(a: Vector | Array, b: Vector | Array) -> Vector:
    """``a x b``."""
    return (a[1] * b[2] - a[2] * b[1], a[2] * b[0] - a[0] * b[2], a[0] * b[1] - a[1] * b[0])


@small_kernel
def norm(v: Vector | Array) -> float:
    """``|v|``; for vectors whose squares neither overflow nor vanish."""
    return math.sqrt(v[0] * v[0] + v[1] * v[1] + v[2] * v[2])


@small_kernel
def copy_vector(source: Array, out: Array) -> None:
    """``out[:] = source`` of (n,), which Numba takes seconds to compile (for its message)."""
    for i in range(len(source)):
        out[i] = source[i]


@small_kernel
def copy_matrix(source: Array, out: Array) -> None:
    """``out[:] = source`` of (n, m)."""
    for i in range(source.shape[0]):
        for j in range(source.shape[1]):
            out[i, j] = source[i, j]


@small_kernel
def rotated(R: Array, v: Vector | Array) -> Vector:
    """``R v``, of any matrix (3, 3)."""
    return (R[0, 0] * v[0] + R[0, 1] * v[1] + R[0, 2] * v[2],
            R[1, 0] * v[0] + R[1, 1] * v[1] + R[1, 2] * v[2],
            R[2, 0] * v[0] + R[2, 1] * v[1] + R[2, 2] * v[2])


@small_kernel
def rotated_back(R: Array, v: Vector | Array) -> Vector:
    """``R^T v``, of any matrix (3, 3)."""
    return (R[0, 0] * v[0] + R[1, 0] * v[1] + R[2, 0] * v[2],
            R[0, 1] * v[0] + R[1, 1] * v[1] + R[2, 1] * v[2],
            R[0, 2] * v[0] + R[1, 2] * v[1] + R[2, 2] * v[2])


@kernel
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
    u = cross(t, axis)
    length = norm(u)
    basis[0, 0], basis[1, 0], basis[2, 0] = u[0] / length, u[1] / length, u[2] / length
    basis[0, 1], basis[1, 1], basis[2, 1] = cross(t, basis[:, 0])
    return basis


def checked_vector(name: str, value: ArrayLike) -> Array:
    """An argument as a vector (3,); InputError, naming it, unless it is 3 finite numbers."""
    vector = np.array(value, dtype=np.float64)
    if vector.shape != (3,) or not np.isfinite(vector).all():
        raise InputError(f'{name} must be 3 finite numbers, got {value!r}')
    return vector
