"""Preintegrated acceleration against known trajectories, and its covariance against samples."""

from dataclasses import replace

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from rs_relpose_lab.simulation.hand_held import hand_held, Plan
from rs_relpose_lab.simulation.inertial import GRAVITY, ImuModel
from rs_relpose_ros import FrameMotion, InertialMotion, InputError, RollingShutterCamera
from rs_relpose_ros.config.imu import ImuConfig
from rs_relpose_ros.estimator.problem import build_problem
from rs_relpose_ros.estimator.velocities_expected import velocities_expected
from rs_relpose_ros.imu.buffer import ImuBuffer
from rs_relpose_ros.imu.frame_imu import frame_imu
from rs_relpose_ros.imu.preintegration import inertial_motion, preintegrate
from rs_relpose_ros.imu.samples import ImuSample

ARM = np.array([0.12, -0.05, 0.08])
EXACT = ImuConfig(accel_noise_density=1e-6, accel_bias_sigma=0.0, imu_position_sigma=0.0,
                  gyro_noise_density=1e-7, gyro_bias_sigma=0.0)
START_NS = 1_700_000_000_000_000_000


@pytest.fixture(scope='module')
def walk():
    return hand_held(np.random.default_rng(3), -0.5, 4.0, Plan.parse('walk:3.0'), speed=1.5,
                     rotation_rate=0.8)


def samples_of(walk, first, last, rate):
    """Instants, rates and forces of an IMU at ARM in the camera's axes, both ends included."""
    times = np.linspace(first, last, round((last - first) * rate) + 1)
    gyro, force = ImuModel(np.eye(3), ARM).measure(walk.states(times), np.random.default_rng(0))
    return times, gyro, force


def imu_states(walk, instants):
    """Positions and velocities of the IMU in the world, and the camera's states."""
    states = walk.states(instants)
    turned = np.cross(states.angular_velocity, ARM)
    position = states.position + np.einsum('kij,j->ki', states.R_world_cam, ARM)
    velocity = states.velocity + np.einsum('kij,kj->ki', states.R_world_cam, turned)
    return position, velocity, states


@pytest.mark.parametrize(('duration', 'rate', 'tolerance'), [
    (0.15, 4000.0, 1e-6), (0.5, 4000.0, 1e-6), (0.15, 200.0, 1e-3), (0.5, 200.0, 2e-3)])
def test_positions_and_velocities_of_a_walk(walk, duration, rate, tolerance):
    for begin in (0.2, 0.9, 1.7, 2.4):
        times, gyro, force = samples_of(walk, begin, begin + duration, rate)
        position, velocity, states = imu_states(walk, [begin, begin + duration])
        R1 = states.R_world_cam[0]
        motion = preintegrate(times, gyro, force, R1.T @ GRAVITY, np.zeros((3, 3)), ARM, EXACT,
                              0.0)
        assert motion.duration == pytest.approx(duration)
        np.testing.assert_allclose(motion.beta, R1.T @ (velocity[1] - velocity[0]),
                                   atol=tolerance)
        np.testing.assert_allclose(
            motion.alpha, R1.T @ (position[1] - position[0] - duration * velocity[0]),
            atol=tolerance)
        assert np.linalg.norm(motion.beta) > 0.05   # it does accelerate


def test_the_velocities_of_the_camera_follow_from_the_baseline(walk):
    """At the truth b (d - c t) + a vanishes: lever arm, rows and units are right."""
    camera = RollingShutterCamera(width=640, height=480, fx=450.0, fy=450.0, cx=319.5, cy=239.5,
                                  readout_time=0.03, reference_row='first')
    begin, duration, half = 1.1, 0.2, 0.5 * 0.03 * 479 / 480
    times, gyro, force = samples_of(walk, begin, begin + duration, 4000.0)
    states = walk.states([begin, begin + duration, begin + half, begin + duration + half])
    R1, R2 = states.R_world_cam[:2]
    motion = preintegrate(times, gyro, force, R1.T @ GRAVITY, np.zeros((3, 3)), ARM, EXACT, 0.0)
    # The acceleration within the frames is that of the IMU, not of the camera.
    change = (imu_states(walk, begin + np.array([0.0, half, duration, duration + half])))[1]
    motion = replace(motion, acceleration1=R1.T @ (change[1] - change[0]) / half,
                     acceleration2=R1.T @ (change[3] - change[2]) / half)
    rows = [np.linspace(-1e-3, 0.031, 65) + at for at in (begin, begin + duration)]
    frames = [FrameMotion.from_gyro(row - at, walk.states(row).angular_velocity)
              for row, at in zip(rows, (begin, begin + duration), strict=True)]
    # As instantaneous as the truth: at the middle row.
    frames = [replace(frame, angular_velocity=w) for frame, w in zip(
        frames, states.angular_velocity[2:], strict=True)]
    points = np.array([[100.0, 100.0], [300.0, 200.0]])
    problem = build_problem(points, points, camera, *frames, R1.T @ R2, 1e-8 * np.eye(3))
    prior, _ = velocities_expected(problem, 'hand_held', duration, motion)
    M1 = states.R_world_cam[2]
    translation = M1.T @ (states.position[3] - states.position[2])
    b = np.linalg.norm(translation)
    d = np.concatenate([M1.T @ states.velocity[2], M1.T @ states.velocity[3]]) / b
    u = b * (d - prior.rate * np.tile(translation / b, 2)) + prior.offset
    # The IMU's acceleration changes within 15 ms, by some percent of it.
    np.testing.assert_allclose(u, 0.0, atol=4e-3)
    assert np.abs(prior.offset).max() > 0.1


def test_covariance_holds_for_drawn_errors(walk):
    """Noise, biases, gravity and lever arm drawn as told: NEES of (alpha, beta) is 6."""
    rng = np.random.default_rng(5)
    begin, duration, rate = 0.8, 0.3, 400.0
    config = ImuConfig(accel_noise_density=0.02, accel_bias_sigma=0.05, imu_position_sigma=0.02,
                       gyro_noise_density=2e-3)
    bias_sigma, tilt, length = 0.01, 0.02, 0.1
    times, gyro, force = samples_of(walk, begin, begin + duration, rate)
    R1 = walk.states([begin]).R_world_cam[0]
    R2 = walk.states([begin + duration]).R_world_cam[0]
    gravity = R1.T @ GRAVITY
    down = gravity / np.linalg.norm(gravity)
    spread = (9.80665 * tilt) ** 2 * (np.eye(3) - np.outer(down, down)) \
        + length**2 * np.outer(down, down)

    def arm_term(arm):   # what the relation to the camera adds, in (alpha', beta')
        w1, w2 = np.cross(gyro[0], arm), np.cross(gyro[-1], arm)
        return np.concatenate([duration * w1 + arm - R1.T @ R2 @ arm, w1 - R1.T @ R2 @ w2])

    exact = preintegrate(times, gyro, force, gravity, spread, ARM, config, bias_sigma)
    truth = np.concatenate([exact.alpha, exact.beta])
    errors = []
    for _ in range(600):
        noisy_gyro = gyro + bias_sigma * rng.normal(size=3) \
            + config.gyro_noise_density * np.sqrt(rate) * rng.normal(size=gyro.shape)
        noisy_force = force + config.accel_bias_sigma * rng.normal(size=3) \
            + config.accel_noise_density * np.sqrt(rate) * rng.normal(size=force.shape)
        drawn = preintegrate(times, noisy_gyro, noisy_force,
                             rng.multivariate_normal(gravity, spread), np.zeros((3, 3)), ARM,
                             config, bias_sigma)
        errors.append(np.concatenate([drawn.alpha, drawn.beta]) - truth
                      + arm_term(config.imu_position_sigma * rng.normal(size=3)))
    errors = np.array(errors)
    sampled, sigma = np.cov(errors.T), np.sqrt(np.diag(exact.covariance))
    np.testing.assert_allclose(sampled / np.outer(sigma, sigma),
                               exact.covariance / np.outer(sigma, sigma), atol=0.15)
    nees = np.einsum('ki,ij,kj->k', errors, np.linalg.inv(exact.covariance), errors)
    assert np.mean(nees) == pytest.approx(6.0, abs=0.6)


def test_shifted_rows(walk):
    """Between rows that lie 12 ms later: as integrated there."""
    begin, duration, delay = 0.7, 0.2, 0.012
    position, velocity, states = imu_states(
        walk, [begin, begin + delay, begin + duration, begin + duration + delay])
    R1, M1 = states.R_world_cam[0], states.R_world_cam[1]
    motion = InertialMotion(
        R1.T @ (position[2] - position[0] - duration * velocity[0]),
        R1.T @ (velocity[2] - velocity[0]), duration, 1e-6 * np.eye(6), ARM,
        acceleration1=R1.T @ (velocity[1] - velocity[0]) / delay,
        acceleration2=R1.T @ (velocity[3] - velocity[2]) / delay)
    later = motion.shifted(delay, R1.T @ M1)
    np.testing.assert_allclose(later.beta, M1.T @ (velocity[3] - velocity[1]), atol=1e-9)
    np.testing.assert_allclose(
        later.alpha, M1.T @ (position[3] - position[1] - duration * velocity[1]), atol=2e-5)
    np.testing.assert_allclose(np.sqrt(np.diag(later.covariance)[3:]), 1e-3, rtol=1e-9)


# -- from samples as they come ----------------------------------------------------------------

R_CAM_IMU = Rotation.from_euler('xyz', [0.3, -1.2, 0.5]).as_matrix()
FRAMES = (1.2, 1.2333, 1.3, 1.35)
READOUT = 0.02


def buffer_of(walk, change=lambda time, force: force, rate=200.0, own_topic=False):
    """A buffer with the walk's samples; `change` makes others of the accelerometer's."""
    config = ImuConfig(imu_position=tuple(ARM), track_gyro_bias=False)
    buffer = ImuBuffer(config)
    times = np.arange(-0.3, 1.45, 1.0 / rate)
    model, rng = ImuModel(R_CAM_IMU, ARM), np.random.default_rng(0)
    gyro, force = model.measure(walk.states(times), rng)
    if own_topic:
        _, force = model.measure(walk.states(times + 1.7e-3), rng)
    for k, time in enumerate(times):
        stamp_ns = START_NS + round(time * 1e9)
        felt = change(time, force[k])
        felt = None if felt is None else tuple(felt)
        if own_topic:
            buffer.add(ImuSample(stamp_ns, tuple(gyro[k]), None))
            if felt is not None:
                buffer.add(ImuSample(stamp_ns + 1_700_000, None, felt))
        else:
            buffer.add(ImuSample(stamp_ns, tuple(gyro[k]), felt))
    return buffer, config


def motion_of(buffer, config):
    """The motion from the first of FRAMES to the last, by the parts that frames bring."""
    frames, previous = [], None
    for at in FRAMES:
        reference = START_NS + round(at * 1e9)
        frames.append(frame_imu(buffer, (reference, reference + round(READOUT * 1e9)), reference,
                                R_CAM_IMU, previous))
        previous = reference
    if any(isinstance(frame.force, str) for frame in frames[1:]):
        return next(frame.force for frame in frames[1:] if isinstance(frame.force, str))
    gyro, forces = frames[1].since_previous, frames[1].force.since_previous
    for frame in frames[2:]:
        gyro = gyro.joined(frame.since_previous)
        forces = forces.joined(frame.force.since_previous)
    return inertial_motion(gyro, forces, frames[0], frames[-1], config)


@pytest.mark.parametrize('own_topic', [False, True])
def test_motion_from_the_frames_of_a_pair(walk, own_topic):
    buffer, config = buffer_of(walk, own_topic=own_topic)
    motion = motion_of(buffer, config)
    duration = FRAMES[-1] - FRAMES[0]
    assert motion.duration == pytest.approx(duration, abs=2e-9)
    position, velocity, states = imu_states(walk, [FRAMES[0], FRAMES[-1]])
    R1 = states.R_world_cam[0]
    error = np.concatenate([
        motion.alpha - R1.T @ (position[1] - position[0] - duration * velocity[0]),
        motion.beta - R1.T @ (velocity[1] - velocity[0])])
    # What is wrong is gravity, which the filter knows to some degrees while the camera walks.
    assert error @ np.linalg.solve(motion.covariance, error) < 16.0
    assert np.abs(error[3:]).max() < 0.25


@pytest.mark.parametrize(('change', 'reason'), [
    (lambda time, force: None, 'there is no accelerometer'),
    (lambda time, force: force / 9.80665, 'must be specific force in m/s'),
    (lambda time, force: force * 100.0, 'must be specific force in m/s'),
    (lambda time, force: np.clip(force + 30.0 * (1.25 < time < 1.28), -19.6, 19.6), 'clipped'),
    (lambda time, force: None if 1.24 < time < 1.31 else force, 'gap')])
def test_an_accelerometer_that_tells_nothing(walk, change, reason):
    found = motion_of(*buffer_of(walk, change))
    assert isinstance(found, str)
    assert reason in found


def test_scale_of_the_accelerometer_drops_out_of_gravity(walk):
    """A sensor that reads 3 % too much: gravity is taken as it reads it."""
    right = motion_of(*buffer_of(walk))
    scaled = motion_of(*buffer_of(walk, lambda time, force: 1.03 * force))
    difference = np.linalg.norm(scaled.beta - right.beta) / right.duration
    assert difference < 0.16   # 0.29 m/s^2 of gravity alone otherwise


@pytest.mark.parametrize(('change', 'message'), [
    ({'duration': 0.0}, 'duration must be'), ({'duration': -0.1}, 'duration must be'),
    ({'duration': float('nan')}, 'duration must be'), ({'alpha': [1.0, 2.0]}, 'alpha must be'),
    ({'beta': [1.0, np.nan, 0.0]}, 'beta must be'), ({'lever_arm': [30.0, 0.0, 0.0]}, 'lever_arm'),
    ({'covariance': np.eye(3)}, 'covariance must be'),
    ({'covariance': -np.eye(6)}, 'covariance must be'),
    ({'acceleration2': [1e9, 0.0, 0.0]}, 'acceleration2 must be')])
def test_motion_that_is_none(change, message):
    values = {'alpha': np.zeros(3), 'beta': np.zeros(3), 'duration': 0.1,
              'covariance': 1e-4 * np.eye(6), **change}
    with pytest.raises(InputError, match=message):
        InertialMotion(**values)
