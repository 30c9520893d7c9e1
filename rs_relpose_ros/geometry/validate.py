"""Checks of arguments: an InputError names the parameter, what is legal and the value given.

Each function returns the checked value: a number as it is, an array as a contiguous copy.
"""

from collections.abc import Collection
import math
import sys
from typing import Any, TypeVar

import numpy as np
from numpy.typing import ArrayLike, NDArray

from rs_relpose_ros.errors import InputError
from rs_relpose_ros.geometry import Array

Number = TypeVar('Number', int, float)
Data = TypeVar('Data')

# Bound of an array without a bound of its own: every finite number is legal. [derived: IEEE 754]
_FLOAT_MAX = sys.float_info.max
# Largest deviation of R^T R from the identity that counts as rounding. Matrices that were written
# with six digits must pass; beyond it a matrix is no rotation. [chosen: any value in 1e-6..1e-4
# would do]
_ROUNDING_ROTATION = 1e-6
# Largest deviation of a covariance matrix from its transpose, relative to its largest element,
# that counts as rounding. [chosen: any value in 1e-12..1e-6 would do]
_ROUNDING_SYMMETRY = 1e-9


def unchecked(kind: type[Data], **values: Any) -> Data:
    """Make an object of a frozen dataclass from all of its fields, without its checks.

    This takes a tenth of the time of the checks of small arrays. The values must come from
    checked values.
    """
    made = object.__new__(kind)
    for name, value in values.items():
        object.__setattr__(made, name, value)
    return made


def replaced(data: Data, **changes: Any) -> Data:
    """Do what `dataclasses.replace` does, without the checks (`unchecked`)."""
    fields = {name: getattr(data, name) for name in type(data).__slots__}  # type: ignore[attr-defined]
    return unchecked(type(data), **fields | changes)


def legal_range(low: float, high: float, unit: str) -> str:
    """Describe the numbers from `low` to `high` in words."""
    unit = f' {unit}'.rstrip()
    if -math.inf < low and high < math.inf:
        return f'in [{low:g}, {high:g}]{unit}'
    if low > -math.inf:
        return f'>= {low:g}{unit} and finite'
    return f'<= {high:g}{unit} and finite' if high < math.inf else f'finite{unit}'


def number(
    name: str,
    value: Number,
    low: float = -math.inf,
    high: float = math.inf,
    unit: str = '',
    *,
    whole: bool = False,
) -> Number:
    """Check a finite number in [low, high], which has no fraction if it is `whole`."""
    try:
        legal = bool(low <= value <= high and abs(value) < math.inf)
    except (TypeError, ValueError):  # the value is no number
        legal = False
    if not legal or (whole and int(value) != value):
        kind = 'a whole number, ' if whole else ''
        raise InputError(f'{name} must be {kind}{legal_range(low, high, unit)}, got {value!r}')
    return value


def choice(name: str, value: str, choices: Collection[str]) -> str:
    """Check that a value is one of some names."""
    if value not in tuple(choices):
        raise InputError(f'{name} must be one of {", ".join(choices)}, got {value!r}')
    return value


def array(
    name: str,
    value: ArrayLike | None,
    shape: tuple[int | str, ...],
    *,
    largest: float = _FLOAT_MAX,
    unit: str = '',
) -> Array:
    """Check an array of finite numbers whose magnitudes do not exceed `largest` [`unit`].

    `shape` has sizes, and names such as 'N' for sizes that may be any number, 0 too.
    """
    try:
        checked = np.array(value, dtype=np.float64, order='C')
    except (TypeError, ValueError):
        raise InputError(f'{name} must be an array of numbers, got {value!r}') from None
    fits = checked.ndim == len(shape) and all(
        isinstance(size, str) or size == found
        for size, found in zip(shape, checked.shape, strict=True)
    )
    if not fits:
        sizes = ', '.join(map(str, shape))
        comma = ',' if len(shape) == 1 else ''
        raise InputError(f'{name} must have shape ({sizes}{comma}), got {checked.shape}')
    legal = np.abs(checked) <= largest  # False for NaN
    if not legal.all():
        place = np.unravel_index(np.argmin(legal), legal.shape)
        indices = [int(k) for k in place]
        text = 'finite' if largest == _FLOAT_MAX else f'finite and within {largest:g} {unit}'
        raise InputError(f'{name} must be {text.rstrip()}, got {checked[place]} at {indices}')
    return checked


def unit_vectors(name: str, value: ArrayLike, shape: tuple[int | str, ...]) -> Array:
    """Check directions of any length but zero, and scale them to length 1 along the last axis."""
    vectors = array(name, value, shape)
    largest = np.abs(vectors).max(axis=-1, keepdims=True, initial=0.0)
    if not (largest > 0.0).all():
        raise InputError(f'{name} must not hold a zero vector, which has no direction')
    # After the division by the largest element, lengths neither overflow nor vanish.
    vectors /= largest
    vectors /= np.linalg.norm(vectors, axis=-1, keepdims=True)
    return vectors


def unit_length(name: str, value: ArrayLike, tolerance: float) -> None:
    """Raise InputError unless a vector (N,) has length 1."""
    length = float(np.linalg.norm(value))
    if not abs(length - 1.0) < tolerance:
        raise InputError(f'{name} must have length 1, got {value!r} of length {length:.4f}')


def rotations(name: str, value: ArrayLike | None, shape: tuple[int | str, ...] = (3, 3)) -> Array:
    """Check a rotation matrix (3, 3), or several of them (K, 3, 3)."""
    # The bound keeps the product from overflowing.
    R = array(name, value, shape, largest=2.0)
    squared = np.swapaxes(R, -1, -2) @ R
    is_orthonormal = np.abs(squared - np.eye(3)) < _ROUNDING_ROTATION
    is_right_handed = np.linalg.det(R) > 0.0
    if not (is_orthonormal.all() and is_right_handed.all()):
        raise InputError(
            f'{name} must be a rotation matrix (orthonormal, determinant +1), got {R.tolist()}'
        )
    return R


def covariance(
    name: str,
    value: ArrayLike,
    size: int,
    *,
    largest: float = _FLOAT_MAX,
    unit: str = '',
    rounding: float = 1e-9,
) -> Array:
    """Check a symmetric matrix (size, size) without eigenvalues below ``-rounding``."""
    matrix = array(name, value, (size, size), largest=largest, unit=unit)
    most = np.abs(matrix).max()
    if not most:
        return matrix
    asymmetry = np.abs(matrix - matrix.T).max()
    least_eigenvalue = np.linalg.eigvalsh(matrix)[0]
    is_symmetric = asymmetry <= _ROUNDING_SYMMETRY * max(1.0, most)
    if not is_symmetric or least_eigenvalue < -rounding:
        raise InputError(
            f'{name} must be a covariance matrix (symmetric, no negative '
            f'eigenvalue), got {matrix.tolist()}'
        )
    return matrix


def increasing(name: str, values: NDArray[Any]) -> None:
    """Raise InputError unless the values (N,) increase strictly."""
    if values.ndim != 1:
        raise InputError(f'{name} must have shape (N,), got {values.shape}')
    rises = values[1:] > values[:-1]
    if not rises.all():
        k = int(np.argmin(rises))
        raise InputError(
            f'{name} must be strictly increasing, got {values[k + 1]} after '
            f'{values[k]} at [{k + 1}]'
        )
