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
# 1 sigma of the scale of each axis of the gyro. A smaller one excludes gyros of phones, which are
# off by 1 to 2 %; a larger one delays what the images tell of the gyro's bias.
# [chosen: 0.01 to 0.03 would do: 0.2 s of rotation determine the scale better]
_GYRO_SCALE = 0.02
# 1 sigma of the angles between the axes of the gyro [rad], likewise.
# [chosen: 0.003 to 0.01 would do: data sheets have 0.1 to 1 % of cross-axis sensitivity]
_GYRO_SKEW = 0.005
# 1 sigma of the lag of the accelerometer behind the gyro [s], as of filters in the IMU. A smaller
# one excludes filters of 20 Hz, a larger one delays starts.
# [chosen: 3 to 15 ms would do: first-order filters of 10 to 50 Hz lag by 3 to 16 ms]
_ACCEL_LAG = 5e-3
# 1 sigma of deviations of the images whose own sigma is not configured: nobody has said that they
# are exact. Smaller ones exclude errors that pairs do not show within seconds, larger ones delay
# starts. [measured: docs/lab/odometry.md, "Deviations that nobody stated"]
_UNSTATED = {
    'axes': 4e-3,  # [rad]
    'time_offset': 3e-3,  # [s]
    'readout_time': 3e-4,  # [s]
    'focal_log': 5e-3,
    'principal_point': 5.0,  # [px]
}

# Size of the position of the camera on the body, with which the vector begins.
ARM = slice(0, 3)
# Places of the last parts of the vector by name: symmetric gyro matrix, lag of the accelerometer.
_IMU_PARTS = {
    'gyro_scale': slice(-7, -4),
    'gyro_skew': slice(-4, -1),
    'accel_lag': slice(-1, None),
}
# Number of values of the gyro matrix. [derived: of a symmetric matrix of 3 rows]
_GYRO_MATRIX = 6
# Number of values of both sensors of the IMU: the gyro matrix and the lag of the accelerometer.
_SENSORS = _GYRO_MATRIX + 1
# Share of the readout between the stamped and the middle row, by `stamp_row`.
_MIDDLE_SHARES = {'first': 0.5, 'middle': 0.0, 'last': -0.5}


class Doubts:
    """The vector d (3 + k + 7,) of a graph: position of the camera on the body, k deviations.

    The k deviations are those of IMAGES that are not exact, by their configured sigma or by that
    of `_UNSTATED`. The last seven are the scale and the skew of the gyro, as of `core.deviations`,
    and the time by which the accelerometer is later than the gyro.
    """

    def __init__(self, parameters: Parameters) -> None:
        sensor, imu = parameters.sensor, parameters.imu
        self.R_cam_body_configured = sensor.R_cam_imu
        lever = np.array(imu.imu_position)
        self.arm_is_known = bool(lever.any())
        sigmas = _configured_sigmas(parameters)
        # Which deviations are unknown, as indices.
        self.active = np.flatnonzero(sigmas)
        least = _LEAST_ARM_SIGMA if self.arm_is_known else UNKNOWN_ARM
        self.prior_sigmas = np.concatenate(
            [
                np.full(3, max(imu.imu_position_sigma, least)),
                sigmas[self.active],
                np.full(3, _GYRO_SCALE),
                np.full(3, _GYRO_SKEW),
                [_ACCEL_LAG],
            ]
        )
        self.size = len(self.prior_sigmas)
        # Places of the deviations of the images, of the IMU and of the gyro matrix among those.
        self.images = slice(ARM.stop, self.size - _SENSORS)
        self.sensors = slice(self.images.stop, self.size)
        self.gyro_matrix = slice(self.images.stop, self.size - 1)
        self.prior = np.zeros(self.size)
        self.prior[ARM] = -self.R_cam_body_configured.T @ lever
        # Derivatives (4, k) of the rotation of the camera and of the delay of its keyframes, the
        # middle rows, by the active deviations.
        by_all = np.zeros((4, IMAGES.size))
        by_all[:3, IMAGES.part('axes')] = np.eye(3)
        by_all[3, IMAGES.part('time_offset')] = 1.0
        by_all[3, IMAGES.part('readout_time')] = _MIDDLE_SHARES[sensor.stamp_row]
        self.by_mount = by_all[:, self.active]

    def mount(self, d: Array) -> tuple[Array, float]:
        """Rotation vector (3,) of the camera's axes [rad], and delay of keyframes [s]."""
        if not len(self.active):
            return np.zeros(3), 0.0
        mount = self.by_mount @ d[self.images]
        return mount[:3], float(mount[3])

    def R_cam_body(self, d: Array) -> Array:
        """R (3, 3) from the body to the camera."""
        return exp_so3(self.mount(d)[0]) @ self.R_cam_body_configured

    def named(
        self,
        d: Array,
        covariance: Array,
    ) -> dict[str, tuple[list[float], list[float]]]:
        """Values and sigmas of the unknown deviations by name."""
        all_sigmas = np.sqrt(np.diag(covariance))
        values, sigmas = np.zeros(IMAGES.size), np.zeros(IMAGES.size)
        values[self.active] = d[self.images]
        sigmas[self.active] = all_sigmas[self.images]
        named = {
            name: (values[columns].tolist(), sigmas[columns].tolist())
            for name, columns in IMAGES.parts.items()
            if sigmas[columns].any()
        }
        for name, columns in _IMU_PARTS.items():
            named[name] = d[columns].tolist(), all_sigmas[columns].tolist()
        return named


def _configured_sigmas(parameters: Parameters) -> Array:
    """Sigmas of the deviations of IMAGES; 0 for one that is taken as exact."""
    configured = {
        name: sigma or _UNSTATED.get(name, 0.0)
        for name, sigma in parameters.deviation_sigmas().items()
    }
    # A parameter that relpose_node tracks is not constant: its deviation is no unknown.
    if parameters.sensor.track_time_offset:
        configured['time_offset'] = 0.0
    if parameters.sensor.track_readout_time:
        configured['readout_time'] = 0.0
    sigmas = np.zeros(IMAGES.size)
    for name, columns in IMAGES.parts.items():
        sigmas[columns] = configured[name]
    return sigmas


def by_gyro_matrix(rate: Array) -> Array:
    """Derivative (3, 6) of the true rate by scale and skew of the gyro, at a rate (3,)."""
    x, y, z = rate.tolist()
    return np.array(
        [
            [x, 0.0, 0.0, 0.0, z, y],
            [0.0, y, 0.0, z, 0.0, x],
            [0.0, 0.0, z, y, x, 0.0],
        ]
    )
