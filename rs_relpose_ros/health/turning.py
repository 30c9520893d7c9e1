"""How the images turn over some frames, without the gyro, against how the gyro turns.

No prior and no pose takes part, so that the comparison holds however wrong axes, unit or sign of
the gyro are told. Rotation vectors over some frames, ``theta`` by images and ``phi`` by gyro
in the camera frame as told, are gathered in ``M = sum theta phi^T``; the rotation Q that maximises
``trace(Q^T M)`` lays one upon the other (Kabsch 1976). A constant rate is taken out of both first:
the gyro has it by its bias, images by a steady translation, which looks like a turn to them.
"""

from __future__ import annotations

from collections import deque
from dataclasses import dataclass
import math
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from rs_relpose_ros.compiled import kernel
from rs_relpose_ros.geometry.order import median
from rs_relpose_ros.geometry.so3 import aligning_rotation, log_so3
from rs_relpose_ros.geometry.timing import to_nanoseconds

Array = NDArray[np.float64]

# Fewer rays give no rotation.
_LEAST_RAYS = 12
# Turns that count: those of the last seconds, at most so many.
_WINDOW_NS = to_nanoseconds(8.0)
_MOST_TURNS = 160
# Turns, and turning [rad, their sum], that a comparison needs.
_LEAST_TURNS, _LEAST_TURN = 5, 0.15
# Sums of squares that rounding alone leaves of a rate that is constant.
_NO_TURNING = 1e-30
# Rotation of axes [rad] that the recursive calibration does not reach.
_LARGE_TURN = 1.0
# Logarithm of a ratio of likelihoods that is certain, errors of neighbours being alike.
_LOG_LIKELIHOOD = 20.0


def rotation_of_rays(rays1: Array, rays2: Array) -> Array | None:
    """Rotation vector (3,) of ``R_1^T R_2`` that lays unit rays (N, 3) upon each other best.

    Translation is not modelled: rays that move most count least (Cauchy weights about the
    median). None where there are too few rays.
    """
    finite = np.isfinite(rays1 + rays2).all(axis=1)
    if np.count_nonzero(finite) < _LEAST_RAYS:
        return None
    first, second = rays1[finite], rays2[finite]
    rotation = aligning_rotation(first.T @ second)
    return log_so3(aligning_rotation(_correlation(first, second, rotation)))


@kernel
def _correlation(rays1: Array, rays2: Array, rotation: Array) -> Array:
    """``sum w a b^T`` (3, 3) of rays (N, 3); weights w by what `rotation` leaves."""
    n = len(rays1)
    squares, out = np.zeros(n), np.zeros((3, 3))
    for i in range(n):
        for j in range(3):
            off = rays1[i, j]
            for k in range(3):
                off -= rotation[j, k] * rays2[i, k]
            squares[i] += off * off
    limit = max(median(squares.copy()), 1e-12)
    for i in range(n):
        weight = 1.0 / (1.0 + squares[i] / limit)
        for j in range(3):
            for k in range(3):
                out[j, k] += weight * rays1[i, j] * rays2[i, k]
    return out


@dataclass(frozen=True, slots=True, eq=False)
class TurnComparison:
    """Images and gyro over the last seconds.

    Shares are those of the images' turning (sum of squares) that is left when the gyro's is
    turned by a rotation and scaled: 0 where it explains all, 1 or more where it explains nothing.
    """

    left_as_told: float   # no rotation
    left_of_all: float   # no rotation, and no constant rate taken out
    left_at_best: float   # `rotation`
    left_mirrored: float   # the best reflection: a gyro whose axes are left-handed
    rotation: Array   # (3, 3) Q: the true gyro is Q times the told one
    reflection: Array   # (3, 3) the best one
    scale: float   # images over gyro, after `rotation`
    by_images: float   # [rad] turning, summed
    by_gyro: float
    turns: int

    @property
    def is_turned(self) -> bool:
        """Whether the axes are another way round: `rotation` is large, and better for certain."""
        return self.angle > _LARGE_TURN and self._certain(self.left_as_told, self.left_at_best)

    @property
    def is_left_handed(self) -> bool:
        """Whether a reflection explains the images better than any rotation, for certain.

        Where all turns are about two axes both explain the same.
        """
        return self._certain(self.left_at_best, self.left_mirrored)

    def _certain(self, left: float, left_instead: float) -> bool:
        """Whether the second of two explanations is better.

        By the ratio of their likelihoods, with normal errors of a variance that nobody knows; each
        turn has three components.
        """
        ratio = max(left, 1e-9) / max(left_instead, 1e-9)
        return 1.5 * self.turns * math.log(ratio) > _LOG_LIKELIHOOD

    @property
    def angle(self) -> float:
        """Of `rotation` [rad]."""
        return float(np.linalg.norm(log_so3(self.rotation)))


class _Turned(NamedTuple):
    """Rotation vectors (3,) over some frames."""

    stamp_ns: int
    interval: float   # [s]
    by_images: Array
    by_gyro: Array


class TurnSums:
    """The turns of the last seconds."""

    def __init__(self) -> None:
        self._turns: deque[_Turned] = deque(maxlen=_MOST_TURNS)

    def clear(self) -> None:
        """Forget all turns."""
        self._turns.clear()

    def add(self, stamp_ns: int, interval: float, by_images: Array, by_gyro: Array) -> None:
        """Take in the turns (3,) over the same frames, `interval` [s], in the order of time."""
        if self._turns and stamp_ns < self._turns[-1].stamp_ns:
            self.clear()
        self._turns.append(_Turned(stamp_ns, interval, by_images, by_gyro))
        while self._turns[0].stamp_ns < stamp_ns - _WINDOW_NS:
            self._turns.popleft()

    def compared(self) -> TurnComparison | None:
        """Both upon each other; None where they turned too little, or too few frames came."""
        if len(self._turns) < _LEAST_TURNS:
            return None
        theta = np.array([turn.by_images for turn in self._turns])
        phi = np.array([turn.by_gyro for turn in self._turns])
        by_images = float(np.linalg.norm(theta, axis=1).sum())
        by_gyro = float(np.linalg.norm(phi, axis=1).sum())
        if max(by_images, by_gyro) < _LEAST_TURN or by_gyro < 1e-3 * _LEAST_TURN:
            return None
        left_of_all = _left(float((theta * phi).sum()), theta, phi)
        intervals = np.array([turn.interval for turn in self._turns])
        theta, phi = _unsteady(theta, intervals), _unsteady(phi, intervals)
        M = theta.T @ phi
        U, singular, Vt = np.linalg.svd(M)
        handed = math.copysign(1.0, float(np.linalg.det(U @ Vt)))
        rotation = np.ascontiguousarray((U * (1.0, 1.0, handed)) @ Vt)
        trace = float(singular[0] + singular[1] + handed * singular[2])
        mirrored = float(singular[0] + singular[1] - handed * singular[2])
        return TurnComparison(
            _left(float(np.trace(M)), theta, phi), left_of_all, _left(trace, theta, phi),
            _left(mirrored, theta, phi), rotation,
            np.ascontiguousarray((U * (1.0, 1.0, -handed)) @ Vt),
            trace / max(float((phi**2).sum()), _NO_TURNING), by_images, by_gyro, len(self._turns))


def _left(trace: float, theta: Array, phi: Array) -> float:
    """Share of the turns `theta` (N, 3) that the turns Q `phi` leave, by trace(Q^T M).

    ``min over s of sum |theta - s Q phi|^2 / sum |theta|^2``; a negative scale is worse.
    """
    power = float((theta**2).sum()) * float((phi**2).sum())
    return 1.0 - trace * abs(trace) / max(power, _NO_TURNING)


def _unsteady(turns: Array, intervals: Array) -> Array:
    """Turns (N, 3) over intervals (N,) [s] without the constant rate that fits them best."""
    return np.asarray(turns - np.outer(intervals, intervals @ turns / (intervals @ intervals)))
