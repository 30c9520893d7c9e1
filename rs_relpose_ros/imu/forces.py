"""The accelerometer's share of a frame, and what makes its samples useless."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from rs_relpose_ros.geometry.vectors import STANDARD_GRAVITY

Array = NDArray[np.float64]

# Bounds of the mean length of the specific force over some seconds, in standard gravities: nothing
# that is carried accelerates for so long. In units of g it reads 1 m/s^2, in mg or feet too much.
_LIKELY_LENGTHS = (0.7, 1.4)
# Samples in a row that are equal bit by bit on one axis, at no less than a share of the largest
# value there: the sensor is at the end of its range, which no sensor has below so many gravities.
_CLIPPED_SAMPLES, _LEAST_RANGE = 3, 1.5


@dataclass(frozen=True, slots=True, eq=False)
class ForceSegment:
    """Specific force between two instants, borders interpolated."""

    stamps_ns: NDArray[np.int64]   # (K,) the first and the last are the two instants
    forces: Array   # (K, 3) [m/s^2]

    def joined(self, later: ForceSegment) -> ForceSegment:
        """This segment and the one that starts where it ends."""
        return ForceSegment(np.concatenate([self.stamps_ns, later.stamps_ns[1:]]),
                            np.concatenate([self.forces, later.forces[1:]]))


@dataclass(frozen=True, slots=True, eq=False)
class FrameForce:
    """Specific force about a frame, in the axes of its stamped row."""

    within: Array   # (3,) mean over the read-out [m/s^2]
    at_rest: float   # length of the specific force at rest, as this sensor reads it [m/s^2]
    at_rest_sigma: float
    since_previous: ForceSegment   # since the previous frame's stamped row, where there is one


def force_fault(forces: Array) -> str:
    """Why the samples (K, 3) of the last seconds are of no use; empty where they are."""
    if not len(forces):
        return 'there is no accelerometer'
    length = float(np.linalg.norm(forces, axis=1).mean())
    low, high = (bound * STANDARD_GRAVITY for bound in _LIKELY_LENGTHS)
    if not low <= length <= high:
        return (f'the accelerometer reads {length:.3g} m/s^2 in the mean, not {STANDARD_GRAVITY}: '
                'it must be specific force in m/s^2')
    size = np.abs(forces)
    equal = (forces[1:] == forces[:-1]) & (size[1:] >= np.maximum(
        0.999 * size.max(axis=0), _LEAST_RANGE * STANDARD_GRAVITY))
    run = np.lib.stride_tricks.sliding_window_view(equal, _CLIPPED_SAMPLES - 1, axis=0) \
        if len(equal) >= _CLIPPED_SAMPLES - 1 else np.zeros((0, 3, 1), dtype=bool)
    if run.all(axis=2).any():
        return f'the accelerometer is clipped at {size.max():.3g} m/s^2'
    return ''
