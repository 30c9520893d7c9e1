"""Checks of what `estimate_relative_pose` is given: each error names the argument."""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import ArrayLike, NDArray

from rs_relpose_ros.errors import InputError
from rs_relpose_ros.geometry.inertial import InertialMotion

Array = NDArray[np.float64]

# Of a predicted rotation [rad^2]: far beyond "anything is possible", which is 10.
LARGEST_COVARIANCE = 1e12


def checked_matches(points1: ArrayLike, points2: ArrayLike, quality: ArrayLike | None,
                    ) -> tuple[Array, Array, NDArray[np.int64]]:
    """Pixels (N, 2) of both frames, and the order in which matches are sampled."""
    checked = []
    for name, value in (('points1', points1), ('points2', points2)):
        points = np.ascontiguousarray(value, dtype=np.float64)
        if points.size == 0:
            points = points.reshape(0, 2)
        if points.ndim != 2 or points.shape[1] != 2:
            raise InputError(f'{name} must have shape (N, 2), got {points.shape}')
        if not np.isfinite(points).all():
            raise InputError(f'{name} must be finite pixels, got NaN or inf in row '
                             f'{int(np.flatnonzero(~np.isfinite(points).all(axis=1))[0])}')
        if points.size and np.abs(points).max() > 1e6:
            raise InputError(f'{name} must be pixels within 1e6, got {np.abs(points).max():g}')
        checked.append(points)
    if len(checked[0]) != len(checked[1]):
        raise InputError('points1 and points2 must have the same length, '
                         f'got {len(checked[0])} and {len(checked[1])}')
    order = np.arange(len(checked[0]))
    if quality is not None:
        values = np.asarray(quality, dtype=np.float64)
        if values.shape != order.shape or not np.isfinite(values).all():
            raise InputError(f'quality must be {len(order)} finite numbers, '
                             f'got shape {values.shape}')
        order = np.argsort(-values, kind='stable')
    return checked[0], checked[1], order


def checked_rotation(rotation: ArrayLike | None, covariance: ArrayLike | None,
                     ) -> tuple[Array | None, Array | None]:
    """A predicted rotation with its covariance, or None twice."""
    if rotation is None and covariance is None:
        return None, None
    if rotation is None or covariance is None:
        raise InputError('relative_rotation and relative_rotation_covariance go together: give '
                         'both or neither')
    R = np.array(rotation, dtype=np.float64)
    # Bounded first, so that the product cannot overflow.
    if R.shape != (3, 3) or not (np.abs(R).max() < 2.0
                                 and np.allclose(R @ R.T, np.eye(3), atol=1e-6)
                                 and np.linalg.det(R) > 0.0):
        raise InputError(f'relative_rotation must be a (3, 3) rotation matrix, got {R.tolist()}')
    C = np.array(covariance, dtype=np.float64)
    if C.shape != (3, 3) or not np.abs(C).max() < LARGEST_COVARIANCE \
            or not np.allclose(C, C.T, atol=1e-9) or np.linalg.eigvalsh(C).min() < -1e-12:
        raise InputError('relative_rotation_covariance must be a (3, 3) covariance matrix '
                         f'[rad^2], got {C.tolist()}')
    return R, C


def checked_interval(interval: float | None, inertial: InertialMotion | None) -> float | None:
    """Seconds between the frames, told or by the IMU's motion; None where neither is given."""
    if interval is not None and not 1e-6 <= interval <= 1e6:
        raise InputError('interval must be a positive number of seconds in [1e-6, 1e6] or None, '
                         f'got {interval}')
    if inertial is None:
        return interval
    if interval is not None and not math.isclose(interval, inertial.duration, abs_tol=1e-6):
        raise InputError('interval must equal the duration of inertial, '
                         f'got {interval:.9g} and {inertial.duration:.9g} s')
    return inertial.duration
