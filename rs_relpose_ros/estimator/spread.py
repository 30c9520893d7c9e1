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


def distinct_directions(observations: Array, use: NDArray[np.bool_], first: int,
                        cell: float) -> int:
    """Number of different rays, to `cell` [rad]: copies of one say nothing new."""
    column, row = np.rint(observations[use, first:first + 2] / cell).T
    return len(np.unique(column + 1e6 * row))


def distance_from_a_plane(observations: Array, use: NDArray[np.bool_], first: int) -> float:
    """Root mean square distance [rad] of the rays from the best plane through the centre.

    Small where the points lie in one place or, in the image, on one line.
    """
    scatter = correlation(observations, use, first, first) / use.sum()
    return float(np.sqrt(max(np.linalg.eigvalsh(scatter)[0], 0.0)))
