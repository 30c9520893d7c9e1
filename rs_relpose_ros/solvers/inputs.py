"""What the public solvers accept; anything else is an InputError that names the parameter."""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike, NDArray

from rs_relpose_ros.errors import InputError

Array = NDArray[np.float64]

# Largest deviation of R^T R from the identity that is rounding, not another matrix.
_ROTATION_TOLERANCE = 1e-6


def _numbers(name: str, value: ArrayLike) -> Array:
    try:
        array = np.array(value, dtype=np.float64, order='C')
    except (TypeError, ValueError):
        raise InputError(f'{name} must be an array of numbers, got {value!r}') from None
    if not np.isfinite(array).all():
        raise InputError(f'{name} must be finite')
    return array


def _unit(name: str, vectors: Array) -> Array:
    largest = np.abs(vectors).max(axis=-1, keepdims=True)
    if not (largest > 0.0).all():
        raise InputError(f'{name} must not hold a zero vector: it has no direction')
    # Divided by the largest element first, lengths neither overflow nor vanish.
    vectors = vectors / largest
    unit: Array = vectors / np.linalg.norm(vectors, axis=-1, keepdims=True)
    return unit


def rays(name: str, value: ArrayLike, count: int) -> Array:
    """Exactly `count` directions (count, 3), brought to unit length."""
    array = _numbers(name, value)
    if array.shape != (count, 3):
        raise InputError(f'{name} must have shape ({count}, 3), got {array.shape}')
    return _unit(name, array)


def row_times(name: str, value: ArrayLike, count: int) -> Array:
    """Exactly `count` row times (count,) [s]."""
    array = _numbers(name, value)
    if array.shape != (count,):
        raise InputError(f'{name} must have shape ({count},), got {array.shape}')
    return array


def gravity(name: str, value: ArrayLike | None) -> Array:
    """A direction (3,) of any length, brought to unit length."""
    if value is None:
        raise InputError(f'{name} must be given to this solver: the direction of free fall (3,) '
                         'in the camera frame')
    array = _numbers(name, value)
    if array.shape != (3,):
        raise InputError(f'{name} must have shape (3,), got {array.shape}')
    return _unit(name, array)


def rotations(name: str, value: ArrayLike | None) -> Array:
    """One or more rotation matrices (K, 3, 3)."""
    if value is None:
        raise InputError(f'{name} must be given to this solver: rotations (K, 3, 3) to start from')
    array = _numbers(name, value)
    if array.ndim != 3 or array.shape[1:] != (3, 3) or len(array) == 0:
        raise InputError(f'{name} must have shape (K, 3, 3) with K >= 1, got {array.shape}')
    # Bounded first, so that the product cannot overflow.
    if not np.abs(array).max() < 2.0 or not (
            np.abs(np.swapaxes(array, 1, 2) @ array - np.eye(3)).max() < _ROTATION_TOLERANCE
            and (np.linalg.det(array) > 0.0).all()):
        raise InputError(f'{name} must hold rotation matrices (orthonormal, determinant +1)')
    return array
