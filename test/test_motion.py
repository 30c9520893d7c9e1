"""Motion during the read-out and the row-time equation, against SciPy."""

import numpy as np
import pytest
from scipy.integrate import solve_ivp
from scipy.spatial.transform import Rotation

from rs_relpose_ros.errors import InputError
from rs_relpose_ros.geometry.camera import RollingShutterCamera
from rs_relpose_ros.geometry.motion import FrameMotion
from rs_relpose_ros.geometry.so3 import exp_so3, left_jacobian_so3, log_so3
from rs_relpose_ros.geometry.timing import ImageClock, seconds_between, to_nanoseconds


def wobble(t):
    return np.array([0.6 * np.sin(9.0 * t + 0.3), -0.8 * np.cos(7.0 * t), 0.5 + 2.0 * t])


def true_rotation(start, end):
    """Independent integral of the quaternion's differential equation."""
    def derivative(t, q):
        x, y, z = wobble(t)
        # q' = q * (w / 2), scalar last
        a, b, c, d = q
        return 0.5 * np.array([d * x + b * z - c * y, d * y + c * x - a * z,
                               d * z + a * y - b * x, -a * x - b * y - c * z])
    solved = solve_ivp(derivative, (start, end), [0.0, 0.0, 0.0, 1.0], rtol=1e-11, atol=1e-12)
    return Rotation.from_quat(solved.y[:, -1]).as_matrix()


def test_constant_rate():
    motion = FrameMotion([0.1, -0.4, 2.0])
    np.testing.assert_allclose(
        motion.rotations([0.02])[0], Rotation.from_rotvec([0.002, -0.008, 0.04]).as_matrix())


def test_gyro_integral_equals_the_differential_equation():
    times = np.arange(-0.01, 0.0351, 0.0025)
    motion = FrameMotion.from_gyro(times, [wobble(t) for t in times])
    for tau in (-0.0088, 0.0, 0.0117, 0.03, 0.0333):
        error = motion.rotations([tau])[0].T @ true_rotation(0.0, tau)
        # A 400 Hz gyro, linear between samples: the constant-rate model is off by 1e-3 rad here.
        assert np.linalg.norm(Rotation.from_matrix(error).as_rotvec()) < 1e-5
    constant = FrameMotion(wobble(0.0))
    error = constant.rotations([0.0333])[0].T @ true_rotation(0.0, 0.0333)
    assert np.linalg.norm(Rotation.from_matrix(error).as_rotvec()) > 5e-4


def test_shift_of_the_reference_row():
    times = np.arange(-0.04, 0.0401, 0.0025)
    motion = FrameMotion.from_gyro(times, [wobble(t) for t in times], gravity=[0.1, 0.9, 0.2])
    moved = motion.shifted(0.015)
    turn = motion.rotations([0.015])[0]
    np.testing.assert_allclose(turn @ moved.rotations([0.01])[0], motion.rotations([0.025])[0],
                               atol=1e-12)
    np.testing.assert_allclose(turn @ moved.gravity, motion.gravity, atol=1e-12)


def test_derotated_rays_are_those_of_the_reference_row():
    motion = FrameMotion([0.3, 1.0, -0.5])
    world = np.array([[1.0, 2.0, 5.0]])
    tau = np.array([0.03])
    turned = Rotation.from_rotvec(tau[:, None] * [0.3, 1.0, -0.5])
    seen = turned.inv().apply(world)
    np.testing.assert_allclose(motion.derotate(seen, tau), world, atol=1e-12)


def test_nothing_is_extrapolated():
    motion = FrameMotion.from_gyro([0.0, 0.01], np.zeros((2, 3)))
    with pytest.raises(InputError, match='not covered by the gyro'):
        motion.rotations([0.011])


@pytest.mark.parametrize(('arguments', 'message'), [
    (([0.0, 1.0, np.nan],), '^angular_velocity '),
    (([0.0, 1.0],), '^angular_velocity '),
    (([0.0, 1.0, 0.0], [0.0, 0.0, 0.0]), '^gravity must have a direction'),
])
def test_illegal_motion_is_refused(arguments, message):
    with pytest.raises(InputError, match=message):
        FrameMotion(*arguments)


@pytest.mark.parametrize('times', [[0.0], [0.0, 0.0], [0.01, 0.02], [0.0, np.inf]])
def test_illegal_gyro_times_are_refused(times):
    with pytest.raises(InputError, match='times'):
        FrameMotion.from_gyro(times, np.zeros((len(times), 3)))


@pytest.mark.parametrize('angle', [0.0, 1e-9, 1e-4, 0.5, 3.0, np.pi - 1e-7])
def test_rotation_kernels_equal_scipy(angle):
    for seed in range(5):
        axis = np.random.default_rng(seed).normal(size=3)
        vector = angle * axis / np.linalg.norm(axis)
        matrix = exp_so3(vector)
        np.testing.assert_allclose(matrix, Rotation.from_rotvec(vector).as_matrix(), atol=1e-12)
        np.testing.assert_allclose(log_so3(matrix), vector, atol=1e-8)


def test_left_jacobian_equals_finite_differences():
    vector = np.array([0.4, -0.7, 0.2])
    jacobian = left_jacobian_so3(vector)
    for k in range(3):
        step = np.zeros(3)
        step[k] = 1e-6
        turn = Rotation.from_rotvec(vector + step) * Rotation.from_rotvec(vector).inv()
        np.testing.assert_allclose(turn.as_rotvec() / 1e-6, jacobian[:, k], atol=1e-6)


def test_row_instants():
    camera = RollingShutterCamera(width=640, height=480, fx=1.0, fy=1.0, cx=0.0, cy=0.0,
                                  readout_time=0.03, reference_row='last')
    clock = ImageClock(camera, time_offset=-0.002, stamp_exposure='end', exposure_time=0.004)
    # The stamp ends the last row's exposure: its middle was 2 ms before, on a clock 2 ms ahead.
    assert clock.reference_ns(10**9) == 10**9 - 4_000_000
    start, end = clock.row_span_ns(10**9)
    assert end == 10**9 - 4_000_000
    assert end - start == to_nanoseconds(0.03 * 479 / 480)


def test_nanoseconds_keep_their_last_digit():
    epoch = 1_650_458_790_634_415_865
    assert to_nanoseconds(seconds_between(epoch, epoch + 1)) == 1
