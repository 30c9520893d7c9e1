"""Baselines in metres from exact walks: rolling-shutter pairs with noise, gyro, accelerometer."""

from dataclasses import replace

import numpy as np
import pytest
from scipy.spatial.transform import Rotation
from scipy.stats import multivariate_normal

from rs_relpose_lab.simulation.fine_path import FinePath
from rs_relpose_lab.simulation.hand_held import hand_held, Plan
from rs_relpose_lab.simulation.inertial import GRAVITY, ImuModel
from rs_relpose_lab.simulation.render import view_of
from rs_relpose_lab.simulation.rows import see
from rs_relpose_ros import (
    estimate_relative_pose,
    EstimatorConfig,
    FrameMotion,
    InertialMotion,
    InputError,
    RollingShutterCamera,
)
from rs_relpose_ros.config.imu import ImuConfig
from rs_relpose_ros.estimator.inertial_evidence import _log_evidence, inertial_evidence
from rs_relpose_ros.estimator.priors import VelocityPrior
from rs_relpose_ros.estimator.problem import build_problem
from rs_relpose_ros.estimator.velocities_expected import velocities_expected
from rs_relpose_ros.geometry.vectors import tangent_basis
from rs_relpose_ros.imu.preintegration import preintegrate

CAMERA = RollingShutterCamera(width=640, height=480, fx=450.0, fy=450.0, cx=319.5, cy=239.5,
                              readout_time=0.03)
CONFIG = EstimatorConfig(pixel_sigma=0.1, gyro_sigma=1e-3, gravity_sigma=0.01)
ARM = np.array([0.05, -0.02, 0.03])
INTERVAL = 0.2
TILT = 0.01   # [rad] error of gravity


class WalkPair:
    """Two frames of a walk with matches, motions, truth and what the IMU says in between."""

    def __init__(self, seed):
        rng = np.random.default_rng(seed)
        walk = hand_held(rng, -0.5, 3.0, Plan.parse('walk:2.0'), speed=1.4, rotation_rate=0.6)
        begin = rng.uniform(0.2, 1.5)
        path = FinePath(walk, begin - 0.05, begin + INTERVAL + 0.1)
        ends = walk.states([begin, begin + INTERVAL])
        R1, R2 = ends.R_world_cam
        # In front of the first camera, seen from both.
        rays = CAMERA.unproject(rng.uniform([10.0, 10.0], [630.0, 470.0], (300, 2)))
        world = ends.position[0] + (rays * rng.uniform(2.0, 8.0, (300, 1))) @ R1.T
        views = [see(world, path.from_instant(at), view_of(CAMERA), margin=-2.0)
                 for at in (begin, begin + INTERVAL)]
        seen = np.isfinite(np.hstack(views)).all(axis=1)
        self.points = [view[seen] + 0.1 * rng.normal(size=(seen.sum(), 2)) for view in views]
        self.R, metric = R1.T @ R2, R1.T @ (ends.position[1] - ends.position[0])
        self.baseline = float(np.linalg.norm(metric))
        self.t = metric / self.baseline
        self.velocity1 = R1.T @ ends.velocity[0]
        tilt = Rotation.from_rotvec(TILT * rng.normal(size=3)).as_matrix()
        gravity = tilt @ R1.T @ GRAVITY
        rows = [np.arange(-0.005, 0.036, 0.0025) + at for at in (begin, begin + INTERVAL)]
        self.motions = [
            FrameMotion.from_gyro(row - at, walk.states(row).angular_velocity, down)
            for row, at, down in zip(rows, (begin, begin + INTERVAL),
                                     (gravity, self.R.T @ gravity), strict=True)]
        times = np.linspace(begin, begin + INTERVAL, 41)
        gyro, force = ImuModel(np.eye(3), ARM, accel_sigma=0.03).measure(walk.states(times), rng)
        down = gravity / np.linalg.norm(gravity)
        self.inertial = preintegrate(
            times, gyro, force, gravity, (9.8 * TILT) ** 2 * (np.eye(3) - np.outer(down, down)),
            ARM, ImuConfig(imu_position_sigma=0.0, accel_bias_sigma=0.02), 1e-4)

    def estimate(self, config=CONFIG, **arguments):
        return estimate_relative_pose(
            *self.points, CAMERA, *self.motions, relative_rotation=self.R,
            relative_rotation_covariance=1e-8 * np.eye(3), config=config, **arguments)

    def translation_error(self, pose):
        return float(np.degrees(np.arccos(np.clip(pose.t @ self.t, -1.0, 1.0))))


@pytest.fixture(scope='module')
def pairs():
    return [WalkPair(seed) for seed in range(16)]


def test_baseline_and_direction_of_walks(pairs):
    poses = [pair.estimate(inertial=pair.inertial) for pair in pairs]
    assert all(poses)
    errors = np.array([np.log(pose.baseline / pair.baseline)
                       for pose, pair in zip(poses, pairs, strict=True)])
    sigmas = np.array([pose.baseline_log_sigma for pose in poses])
    assert np.median(np.abs(errors)) < 0.15
    assert (sigmas > 0.0).all() and (sigmas < 1.0).all()
    assert np.mean((errors / sigmas) ** 2) < 2.5
    speeds = [np.linalg.norm(pose.metric_velocity1 - pair.velocity1)
              for pose, pair in zip(poses, pairs, strict=True)]
    assert np.median(speeds) < 0.25   # of 1.4 m/s
    # The accelerometer knows the velocities, which are what the images do not.
    known = [pair.translation_error(pose) for pose, pair in zip(poses, pairs, strict=True)]
    timed = [pair.translation_error(pair.estimate(interval=INTERVAL)) for pair in pairs]
    neither = [pair.translation_error(pair.estimate()) for pair in pairs]
    assert np.median(known) < 0.6 * np.median(timed)
    assert np.median(known) < 0.6 * np.median(neither)


def test_a_baseline_is_told_only_where_it_is_known(pairs):
    pose = pairs[0].estimate(interval=INTERVAL)
    assert pose and np.isnan([pose.baseline, pose.baseline_log_sigma]).all()
    assert 'no acceleration' in pose.baseline_reason
    assert np.isnan(pose.metric_velocity2).all()
    # An accelerometer that may be off by anything says nothing, whatever its samples are.
    lost = replace(pairs[0].inertial, covariance=1e4 * np.eye(6))
    pose = pairs[0].estimate(inertial=lost)
    assert pose and np.isnan(pose.baseline)
    assert 'within its own errors' in pose.baseline_reason


def test_the_inverse_has_the_same_baseline(pairs):
    pose = pairs[0].estimate(inertial=pairs[0].inertial)
    assert (pose.inverse().baseline, pose.inverse().baseline_log_sigma) == (
        pose.baseline, pose.baseline_log_sigma)


def test_interval_and_duration_agree(pairs):
    pair = pairs[0]
    with_both = pair.estimate(inertial=pair.inertial, interval=INTERVAL)
    assert with_both.baseline == pair.estimate(inertial=pair.inertial).baseline
    with pytest.raises(InputError, match='interval must equal the duration'):
        pair.estimate(inertial=pair.inertial, interval=0.21)
    with pytest.raises(InputError, match='interval must be'):
        pair.estimate(interval=0.0)


def test_a_lever_arm_needs_the_rotation(pairs):
    pair = pairs[0]
    with pytest.raises(InputError, match='needs relative_rotation'):
        estimate_relative_pose(*pair.points, CAMERA, *pair.motions, inertial=pair.inertial)
    free = InertialMotion(pair.inertial.alpha, pair.inertial.beta, INTERVAL,
                          pair.inertial.covariance)
    assert estimate_relative_pose(*pair.points, CAMERA, *pair.motions, inertial=free)


@pytest.mark.parametrize('motion', ['vehicle', 'drone'])
def test_other_carriers(pairs, motion):
    """A prior that is too wide costs some of the precision, and nothing else."""
    poses = [pair.estimate(replace(CONFIG, motion=motion), inertial=pair.inertial)
             for pair in pairs[:8]]
    errors = [np.log(pose.baseline / pair.baseline)
              for pose, pair in zip(poses, pairs, strict=False)]
    assert np.nanmedian(np.abs(errors)) < 0.3


def evidence(pair, pose, inertial):
    nothing = np.empty((0, 2))
    problem = build_problem(nothing, nothing, CAMERA, *pair.motions, pair.R, 1e-8 * np.eye(3))
    return inertial_evidence(problem, pose.images, 'hand_held', INTERVAL, velocities_expected(
        problem, 'hand_held', INTERVAL, inertial)[0])


@pytest.mark.parametrize('with_accelerometer', [True, False])
def test_images_tell_the_acceleration_from_another_one(pairs, with_accelerometer):
    """By the images alone, whatever the pose rests on."""
    right, turned = [], []
    axes = np.array([[0.0, 1.0, 0.0], [0.0, 0.0, 1.0], [1.0, 0.0, 0.0]])
    for pair in pairs:
        told = pair.inertial
        pose = pair.estimate(
            **({'inertial': told} if with_accelerometer else {'interval': INTERVAL}))
        if with_accelerometer:
            assert pose.inertial_evidence == pytest.approx(evidence(pair, pose, told), abs=1e-6)
        for found, map_ in ((right, np.eye(3)), (turned, axes)):
            found.append(evidence(pair, pose, replace(told, **{
                name: map_ @ np.asarray(getattr(told, name))
                for name in ('alpha', 'beta', 'acceleration1', 'acceleration2')})))
    told, opposite = np.sum(right, axis=0)
    assert told > 10.0 and opposite < -10.0
    assert np.sum(turned, axis=0)[0] < -10.0


def test_a_global_shutter_tells_nothing_of_the_acceleration(pairs):
    """Its rows are at one instant: no velocity shows, and no evidence is made up."""
    pair = pairs[0]
    still = replace(CAMERA, readout_time=0.0)
    pose = estimate_relative_pose(
        *pair.points, still, *pair.motions, relative_rotation=pair.R,
        relative_rotation_covariance=1e-8 * np.eye(3), config=CONFIG, interval=INTERVAL)
    assert np.abs(evidence(pair, pose, pair.inertial)).max() < 0.5


def test_evidence_by_the_density_of_the_acceleration():
    """At one baseline: the images' y is normal, and so is what the acceleration should be."""
    rng = np.random.default_rng(3)
    half = rng.normal(size=(8, 12))
    H, g, b, c = half @ half.T, rng.normal(size=8), 0.3, 4.0
    t, velocities = np.array([0.6, 0.0, 0.8]), rng.normal(size=6)
    basis = tangent_basis(t)
    J = np.hstack([-c * np.vstack([basis, basis]), np.eye(6)])
    mean = b * (velocities - c * np.tile(t, 2) - J @ np.linalg.solve(H, g))
    covariance = b**2 * J @ np.linalg.solve(H, J.T)

    def both(a, V):
        prior = VelocityPrior(c, a, np.linalg.inv(V), 0.0, 0.0, 1.0, 0.0)
        return (_log_evidence(H, g, t, velocities, prior, np.array([np.log(b)])),
                multivariate_normal(mean, covariance + V).logpdf(-a))

    first, second = both(rng.normal(size=6), 0.3 * np.eye(6)), both(np.zeros(6), 2.0 * np.eye(6))
    assert first[0] - second[0] == pytest.approx(first[1] - second[1], abs=1e-9)
