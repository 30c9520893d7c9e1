"""How the rays of the matches that agree are spread: whether they can determine a pose at all."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from rs_relpose_ros.compiled import kernel

Array = NDArray[np.float64]


@kernel
def correlation(observations: Array, use: NDArray[np.bool_], first: int, second: int) -> Array:
    """``sum a b^T`` (3, 3) over the matches in `use` of two of their vectors, by column."""
    out = np.zeros((3, 3))
    for i in range(observations.shape[0]):
        if use[i]:
            for j in range(3):
                for k in range(3):
                    out[j, k] += observations[i, first + j] * observations[i, second + k]
    return out


@kernel
def distinct_directions(observations: Array, use: NDArray[np.bool_], first: int,
                        cell: float) -> int:
    """Number of different rays, to `cell` [rad]: copies of one say nothing new."""
    # A hash table with open addressing: a sort takes seconds to compile.
    slots = np.empty(4 * use.shape[0] + 1)
    for i in range(slots.shape[0]):
        slots[i] = np.inf
    different = 0
    for i in range(observations.shape[0]):
        if use[i]:
            key = round(observations[i, first] / cell) \
                + 1e6 * round(observations[i, first + 1] / cell)
            slot = np.int64(abs(key)) % slots.shape[0]
            while slots[slot] != np.inf and slots[slot] != key:
                slot = (slot + 1) % slots.shape[0]
            different += slots[slot] == np.inf
            slots[slot] = key
    return different


def distance_from_a_plane(observations: Array, use: NDArray[np.bool_], first: int) -> float:
    """Root mean square distance [rad] of the rays from the best plane through the centre.

    Small where the points lie in one place or, in the image, on one line.
    """
    scatter = correlation(observations, use, first, first) / use.sum()
    return float(np.sqrt(max(np.linalg.eigvalsh(scatter)[0], 0.0)))
