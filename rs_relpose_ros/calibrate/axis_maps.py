"""The 24 rotations that map axes to axes: how an IMU is meant to sit beside its camera."""

from __future__ import annotations

from functools import cache
import itertools

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]


@cache
def axis_maps() -> Array:
    """All 24 rotations (24, 3, 3) that map axes to axes."""
    maps = np.array([np.diag(signs) @ np.eye(3)[list(columns)] + 0.0    # no zero is negative
                     for columns in itertools.permutations(range(3))
                     for signs in itertools.product((1.0, -1.0), repeat=3)])
    maps = maps[np.linalg.det(maps) > 0.0]
    maps.setflags(write=False)      # one copy serves everybody
    return maps


def nearest_axis_map(R: Array) -> Array:
    """The axis map (3, 3) nearest to a rotation."""
    maps = axis_maps()
    return np.array(maps[int(np.argmax(np.einsum('kij,ij->k', maps, R)))])


def axes_text(axis_map: Array) -> str:
    """An axis map (3, 3) in words: ``cam x = -imu y, ...``."""
    parts = []
    for row, axis in zip(axis_map, 'xyz', strict=True):
        k = int(np.argmax(np.abs(row)))
        parts.append(f"cam {axis} = {'-' if row[k] < 0 else '+'}imu {'xyz'[k]}")
    return ', '.join(parts)
