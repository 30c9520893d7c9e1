"""Rotation by the gyro at any time, and its derivatives by the deviations at the rows."""

import numpy as np
import pytest
from scipy.integrate import solve_ivp
from scipy.spatial.transform import Rotation

from rs_relpose_ros.core.deviations import N_DEVIATIONS, PARTS
from rs_relpose_ros.core.rows import row_states
from rs_relpose_ros.geometry.gyro import GyroPath
from rs_relpose_ros.geometry.so3 import skew

TIMES = np.arange(-0.02, 0.0301, 0.0025)
R_CAM_IMU = Rotation.from_euler('xyz', [90, 5, 30], degrees=True).as_matrix()
ROWS = np.linspace(-0.015, 0.025, 7)
SHARES = ROWS / 0.04


def imu_rates(times):
    """A gyro that shakes [rad/s], with its rate linear between samples."""
    return np.column_stack([np.sin(40 * times + k) + 0.3 * k for k in range(3)])


def test_the_path_solves_the_differential_equation_of_the_rotation():
    path = GyroPath.integrated(TIMES, imu_rates(TIMES)).about(0.0)
    at = np.array([-0.0133, 0.0, 0.0071, 0.0262])

    def rate(time):
        return np.array([np.interp(time, TIMES, axis) for axis in path.rates.T])

    for time, found in zip(at, path.at(at), strict=True):
        ends = (0.0, time)
        exact = solve_ivp(
            lambda t, R: (R.reshape(3, 3) @ skew(rate(t))).ravel(),
            ends,
            np.eye(3).ravel(),
            rtol=1e-11,
            atol=1e-12,
            max_step=5e-4,
        )
        np.testing.assert_allclose(found, exact.y[:, -1].reshape(3, 3), atol=1e-9)


def rotations(c):
    """Orientations at the rows where the truth deviates by c, and by the same gyro and clock."""
    times = np.linspace(TIMES[0], TIMES[-1], 401)
    matrix = np.diag(c[PARTS['gyro_scale']])
    for (i, j), value in zip(((1, 2), (0, 2), (0, 1)), c[PARTS['gyro_skew']], strict=True):
        matrix[i, j] = matrix[j, i] = value
    measured = np.column_stack([np.interp(times, TIMES, axis) for axis in imu_rates(TIMES).T])
    true = (measured - c[PARTS['gyro_bias']]) @ (np.eye(3) + matrix).T
    axes = Rotation.from_rotvec(c[PARTS['axes']]).as_matrix() @ R_CAM_IMU
    path = GyroPath.integrated(times, true @ axes.T)
    offset = c[PARTS['time_offset']][0]
    rows = ROWS + SHARES * c[PARTS['readout_time']][0]
    return path.about(offset).at(rows)


TURNING = ('axes', 'time_offset', 'readout_time', 'gyro_bias', 'gyro_scale', 'gyro_skew')


@pytest.mark.parametrize('name', TURNING)
def test_derivatives_are_those_of_finite_differences(name):
    path = GyroPath.integrated(TIMES, imu_rates(TIMES) @ R_CAM_IMU.T).about(0.0)
    states = row_states(path, R_CAM_IMU, ROWS, SHARES)
    np.testing.assert_allclose(states.rotation, rotations(np.zeros(N_DEVIATIONS)), atol=1e-9)
    step = 1e-7  # the rate has kinks at the samples
    for k in range(N_DEVIATIONS)[PARTS[name]]:
        c = np.zeros(N_DEVIATIONS)
        c[k] = step
        turned = rotations(c) @ rotations(-c).swapaxes(1, 2)
        numeric = Rotation.from_matrix(turned).as_rotvec() / (2.0 * step)
        scale = np.abs(numeric).max()
        np.testing.assert_allclose(states.by_deviation[:, :, k], numeric, atol=1e-6 * scale)


def test_other_deviations_do_not_turn_the_rows():
    path = GyroPath.constant(np.array([0.1, 0.2, 0.3]), -0.02, 0.03)
    states = row_states(path, R_CAM_IMU, ROWS, SHARES)
    others = np.ones(N_DEVIATIONS, dtype=bool)
    for name in TURNING:
        others[PARTS[name]] = False
    assert others.any() and not states.by_deviation[:, :, others].any()
    assert states.time_by_deviation.any(axis=0).sum() == 1
    np.testing.assert_allclose(
        states.rotation[0],
        Rotation.from_rotvec(ROWS[0] * np.array([0.1, 0.2, 0.3])).as_matrix(),
        atol=1e-12,
    )
