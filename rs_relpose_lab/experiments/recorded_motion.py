"""Smooth motion through recorded poses: what drives a simulation as a hand did."""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy.interpolate import CubicSpline
from scipy.spatial.transform import Rotation, RotationSpline

from rs_relpose_lab.experiments.penncosyvio_files import Poses
from rs_relpose_lab.simulation.trajectory import CameraStates
from rs_relpose_ros.errors import InputError
from rs_relpose_ros.geometry.timing import NANOSECONDS

Array = NDArray[np.float64]


class RecordedMotion:
    """Cubic splines of position and orientation through all poses.

    Instants are seconds since the first pose. It offers what the renderer and the IMU model ask of
    `rs_relpose_lab.simulation.trajectory.Trajectory`.
    """

    def __init__(self, poses: Poses) -> None:
        self._start_ns = int(poses.stamps_ns[0])
        seconds = (poses.stamps_ns - self._start_ns) / NANOSECONDS
        self.span = 0.0, float(seconds[-1])
        self._position = CubicSpline(seconds, poses.positions)
        self._rotation = RotationSpline(seconds, poses.rotations)

    def seconds(self, instant_ns: int) -> float:
        """Time on this motion of an instant of the poses' clock."""
        return (instant_ns - self._start_ns) / NANOSECONDS

    def at(self, times: ArrayLike) -> tuple[Rotation, Array]:
        """Orientations in the world and positions (N, 3) [m] at times (N,) [s]."""
        times = np.asarray(times, dtype=np.float64)
        if len(times) and not (self.span[0] <= times.min() and times.max() <= self.span[1]):
            raise InputError(f'the poses last {self.span[1]:.3f} s, asked for '
                             f'{times.min():.3f} to {times.max():.3f} s')
        return self._rotation(times), self._position(times)

    def poses(self, times: ArrayLike) -> tuple[Array, Array]:
        """Positions (N, 3) [m] and orientations (N, 3, 3) at times (N,) [s]."""
        rotations, positions = self.at(times)
        return positions, rotations.as_matrix()

    def states(self, times: ArrayLike) -> CameraStates:
        """Poses and derivatives at times (N,) [s]."""
        positions, rotations = self.poses(times)
        return CameraStates(
            position=positions, R_world_cam=rotations, velocity=self._position(times, 1),
            acceleration=self._position(times, 2), angular_velocity=self._rotation(times, 1),
            angular_acceleration=self._rotation(times, 2))
