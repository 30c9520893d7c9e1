"""What the tool answers to a rebuilt situation, and how it compares with the truth."""

from __future__ import annotations

from dataclasses import dataclass
from typing import NamedTuple

from rs_relpose_ros.geometry import Array


class NamedCause(NamedTuple):
    """A finding as a user reads it."""

    code: str
    state: str
    text: str


@dataclass(frozen=True, slots=True, eq=False)
class Evidence:
    """Errors of all that was published, and all that was said."""

    poses: Array  # (N, 2) squared distances of direction and rotation of relative poses
    pairs: int
    states: Array  # (N, 2) squared distances of position and rotation of odometry
    calibration: dict[str, float]  # errors of determined values [sigmas]
    causes: tuple[NamedCause, ...]
    words: str  # what else was printed or logged
