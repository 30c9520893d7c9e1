"""What the graph does not know exactly about camera and IMU: one vector for all keyframes."""

from __future__ import annotations

import numpy as np

from rs_relpose_ros.config.settings import Parameters
from rs_relpose_ros.estimator.covariance import IMAGES
from rs_relpose_ros.geometry import Array
from rs_relpose_ros.geometry.so3 import exp_so3

# 1 sigma of the position of the IMU if none is configured [m], per axis. A smaller one excludes
# real rigs, whose IMU is up to 0.2 m from the camera; a larger one delays starts.
# [measured: docs/lab/odometry.md, "Lever arm", with 0.1 m]
UNKNOWN_ARM = 0.15
# Least 1 sigma of the position of the IMU [m]: with 0 the graph has no finite information.
# [chosen: 1e-5 to 1e-3 would do: millimetres of the arm move no path]
_LEAST_ARM_SIGMA = 1e-4

# Size of the position of the camera on the body, with which the vector begins.
ARM = slice(0, 3)
# Share of the readout between the stamped and the middle row, by `stamp_row`.
_MIDDLE_SHARES = {'first': 0.5, 'middle': 0.0, 'last': -0.5}


class Doubts:
    """The vector d (3 + k,) of a graph: position of the camera on the body, and k deviations.

    The deviations are those of IMAGES whose sigma is configured: all others are taken as
    exact, so that a graph without doubt has the unknown position alone.
    """

    def __init__(self, parameters: Parameters) -> None:
        sensor, imu = parameters.sensor, parameters.imu
        self._R_cam_body = sensor.R_cam_imu
        lever = np.array(imu.imu_position)
        self.arm_is_known = bool(lever.any())
        least = _LEAST_ARM_SIGMA if self.arm_is_known else UNKNOWN_ARM
        # A parameter that relpose_node tracks is not constant: its deviation is no unknown.
        configured = {
            'axes': sensor.axes_sigma,
            'time_offset': 0.0 if sensor.track_time_offset else sensor.time_offset_sigma,
            'readout_time': 0.0 if sensor.track_readout_time else sensor.readout_time_sigma,
            'focal_log': parameters.intrinsics.focal_length_sigma,
            'distortion': parameters.intrinsics.distortion_sigma,
            'principal_point': parameters.intrinsics.principal_point_sigma,
        }
        sigmas = np.zeros(IMAGES.size)
        for name, columns in IMAGES.parts.items():
            sigmas[columns] = configured[name]
        # Which deviations are unknown, as indices.
        self.active = np.flatnonzero(sigmas)
        self._middle_share = _MIDDLE_SHARES[sensor.stamp_row]
        arm_sigmas = np.full(3, max(imu.imu_position_sigma, least))
        self.prior_sigmas = np.concatenate([arm_sigmas, sigmas[self.active]])
        self.prior = np.zeros(len(self.prior_sigmas))
        self.prior[ARM] = -self._R_cam_body.T @ lever
        # Derivatives (4, k) of the rotation of the camera and of the delay of its keyframes, the
        # middle rows, by the active deviations.
        by_all = np.zeros((4, IMAGES.size))
        by_all[:3, IMAGES.part('axes')] = np.eye(3)
        by_all[3, IMAGES.part('time_offset')] = 1.0
        by_all[3, IMAGES.part('readout_time')] = self._middle_share
        self.by_mount = by_all[:, self.active]

    def mount(self, d: Array) -> tuple[Array, float]:
        """Rotation vector (3,) of the camera's axes [rad], and delay of keyframes [s]."""
        if not len(self.active):
            return np.zeros(3), 0.0
        mount = self.by_mount @ d[3:]
        return mount[:3], float(mount[3])

    def R_cam_body(self, d: Array) -> Array:
        """R (3, 3) from the body to the camera."""
        return exp_so3(self.mount(d)[0]) @ self._R_cam_body

    def named(
        self,
        d: Array,
        covariance: Array,
    ) -> dict[str, tuple[list[float], list[float]]]:
        """Values and sigmas of the unknown deviations by name."""
        values, sigmas = np.zeros(IMAGES.size), np.zeros(IMAGES.size)
        values[self.active] = d[3:]
        sigmas[self.active] = np.sqrt(np.diag(covariance)[3:])
        return {
            name: (values[columns].tolist(), sigmas[columns].tolist())
            for name, columns in IMAGES.parts.items()
            if sigmas[columns].any()
        }
