"""What an IMU fixed to the camera measures along a trajectory."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray

from rs_relpose_lab.simulation.trajectory import CameraStates

Array = NDArray[np.float64]

GRAVITY = np.array([0.0, 0.0, -9.80665])


@dataclass(frozen=True, slots=True, eq=False)
class ImuModel:
    """Mounting, biases and noise.

    `R_cam_imu` (3, 3): ``v_cam = R_cam_imu v_imu``.
    `lever_arm` (3,): position of the IMU in the camera frame [m].
    `gyro_bias`, `accel_bias` (3,): added to the truth, IMU frame [rad/s], [m/s^2].
    `gyro_sigma`, `accel_sigma`: white noise of a sample, per axis [rad/s], [m/s^2]: the density
        times the square root of the rate.
    """

    R_cam_imu: Array
    lever_arm: ArrayLike = (0.0, 0.0, 0.0)
    gyro_bias: ArrayLike = (0.0, 0.0, 0.0)
    accel_bias: ArrayLike = (0.0, 0.0, 0.0)
    gyro_sigma: float = 0.0
    accel_sigma: float = 0.0

    def measure(self, states: CameraStates, rng: np.random.Generator) -> tuple[Array, Array]:
        """Angular velocities and specific forces (N, 3) in the IMU frame, as it reports them.

        Specific force is what an accelerometer feels: ``R^T (a - g)``, +g upwards at rest.
        """
        w, dw = states.angular_velocity, states.angular_acceleration
        lever = np.broadcast_to(np.asarray(self.lever_arm, dtype=np.float64), w.shape)
        # a_imu = a + R (dw x l + w x (w x l)), the rigid body's other point.
        turning = np.cross(dw, lever) + np.cross(w, np.cross(w, lever))
        felt = np.einsum('nji,nj->ni', states.R_world_cam, states.acceleration - GRAVITY) + turning
        gyro = w @ self.R_cam_imu + np.asarray(self.gyro_bias)
        accel = felt @ self.R_cam_imu + np.asarray(self.accel_bias)
        gyro = gyro + self.gyro_sigma * rng.standard_normal(gyro.shape)
        accel = accel + self.accel_sigma * rng.standard_normal(accel.shape)
        return gyro, accel
