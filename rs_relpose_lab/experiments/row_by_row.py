"""Where a moving rolling-shutter camera sees points: each by the row that really sees it.

The simulation of the experiments. It uses nothing of the estimator's geometry, so that an error
in one is not hidden by the same error in the other.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

Array = NDArray[np.float64]

# Poses of the camera in the world at N instants [s]: orientations, and positions (N, 3) [m].
Motion = Callable[[Array], tuple[Rotation, Array]]
# Points (N, 3) in the camera frame [m] -> pixels (N, 2), NaN where the lens cannot see.
Lens = Callable[[Array], Array]

_MAX_ROUNDS = 60
_SETTLED_ROWS = 1e-9
_LEAST_DEPTH = 0.1


@dataclass(frozen=True, slots=True)
class Shutter:
    """When rows are read.

    Attributes
    ----------
    width, height : int
        Size of the image [px].
    line_delay : float
        Time from one row to the row below [s].
    reference_row : float
        Row that is read at time 0.
    """

    width: int
    height: int
    line_delay: float
    reference_row: float


@dataclass(frozen=True, slots=True, eq=False)
class View:
    """A camera, as the simulation needs it.

    Attributes
    ----------
    lens : callable
        Where a still camera sees points.
    directions : callable
        Of pixels (N, 2), in the camera frame (N, 3), with z = 1.
    shutter : Shutter
    """

    lens: Lens
    directions: Callable[[Array], Array]
    shutter: Shutter


def see(world: Array, motion: Motion, lens: Lens, shutter: Shutter) -> Array:
    """Pixels of points seen by a camera that moves while it reads its rows.

    A point is seen in row v if it is projected into row v from where the camera is when that row
    is read. The row is found by iteration: project, take the time of that row, project again.

    Parameters
    ----------
    world : (N, 3) ndarray
        Points [m].
    motion : callable
        Poses at times relative to the reference row's [s].
    lens : callable
    shutter : Shutter

    Returns
    -------
    (N, 2) ndarray
        Pixels; NaN for a point outside of the image, behind or nearer than 0.1 m, and for one
        whose row does not settle (to 1e-9 rows).
    """
    pixels = np.full((len(world), 2), np.nan)
    rows = np.full(len(world), 0.5 * (shutter.height - 1))
    moving = np.arange(len(world))
    for _ in range(_MAX_ROUNDS):
        orientations, positions = motion((rows[moving] - shutter.reference_row)
                                         * shutter.line_delay)
        local = orientations.inv().apply(world[moving] - positions)
        found = np.where(local[:, 2:] > _LEAST_DEPTH, lens(local), np.nan)
        # A row far outside is another answer of "not in the image"; motion need not reach there.
        new = np.clip(found[:, 1], -shutter.height, 2 * shutter.height)
        settled = np.abs(new - rows[moving]) < _SETTLED_ROWS
        pixels[moving[settled]] = found[settled]
        again = ~settled & np.isfinite(new)
        rows[moving[again]] = new[again]
        moving = moving[again]
        if not len(moving):
            break
    size = np.array([shutter.width - 1, shutter.height - 1])
    inside = ((pixels >= 0.0) & (pixels <= size)).all(axis=1)
    pixels[~inside] = np.nan
    return pixels
