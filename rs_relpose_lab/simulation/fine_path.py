"""A trajectory on a fine grid: poses at many instants, in a fraction of the spline's time."""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from rs_relpose_lab.simulation.rows import Motion
from rs_relpose_lab.simulation.trajectory import Trajectory

Array = NDArray[np.float64]


class FinePath:
    """Poses of a trajectory from `begin` to `end` [s], linear between steps of a millisecond."""

    step = 1e-3

    def __init__(self, trajectory: Trajectory, begin: float, end: float) -> None:
        self.begin = begin
        times = begin + self.step * np.arange(math.ceil((end - begin) / self.step) + 1)
        self.positions, self.rotations = trajectory.poses(times)
        self.turns = Rotation.from_matrix(
            np.einsum('nji,njk->nik', self.rotations[:-1], self.rotations[1:])).as_rotvec()

    def from_instant(self, instant: float) -> Motion:
        """Motion of a frame, whose times count from the `instant` of its reference row [s]."""
        def to_camera(points: Array, times: Array) -> Array:
            at = (instant + times - self.begin) / self.step
            k = np.clip(at.astype(int), 0, len(self.turns) - 1)
            share = (at - k)[:, None]
            position = self.positions[k] + share * (self.positions[k + 1] - self.positions[k])
            turned = np.einsum('nji,nj->ni', self.rotations[k], points - position)
            # Of 1e-3 rad: exact to 1e-6.
            return np.asarray(turned - share * np.cross(self.turns[k], turned))
        return to_camera
