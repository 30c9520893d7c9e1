"""Compiles (or loads from the cache) what odometry needs beside gtsam.

``python -m rs_relpose_ros.odometry.warm_up`` does it when the package is built.
"""

from __future__ import annotations

import numpy as np

from rs_relpose_ros.odometry.interval import ImuInterval
from rs_relpose_ros.odometry.pair_geometry import BodyState, deviations, Mounting


def warm_up_odometry() -> None:
    """Compare two made-up bodies with a pair, and level an IMU at rest."""
    eye, z = np.eye(3), np.array([0.0, 0.0, 1.0])
    first, second = (BodyState(eye, k * z, z, np.zeros(3)) for k in range(2))
    deviations(first, second, Mounting(eye, np.zeros(3)), eye, z, np.zeros(6))
    ImuInterval(np.arange(2.0), np.zeros((2, 3)), np.ones((2, 3))).mean_force(np.zeros(3))


if __name__ == '__main__':
    warm_up_odometry()
