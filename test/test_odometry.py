"""Metric odometry on pairs that are the truth plus noise, and on its faults."""

from dataclasses import dataclass, replace
from functools import cached_property
import gc
import importlib.util
from itertools import pairwise
import math
import pickle
from types import FunctionType, ModuleType

import gtsam
from gtsam.symbol_shorthand import X
import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from rs_relpose_lab.experiments.odometry import on_euroc
from rs_relpose_lab.simulation.motions import hand_held, Plan
from rs_relpose_lab.simulation.simulation import ImuModel
from rs_relpose_ros.calibration.findings import (
    Assessment,
    Code,
    Evidence,
    Finding,
    FindingState,
    Why,
)
from rs_relpose_ros.config.settings import Parameters
from rs_relpose_ros.errors import InputError, MissingInputError
from rs_relpose_ros.estimator.covariance import ImageInformation, IMAGES
from rs_relpose_ros.geometry.so3 import exp_so3, tangent_basis
from rs_relpose_ros.imu.buffer import ImuSample, ImuSamples
from rs_relpose_ros.imu.noise import noise_of_samples
from rs_relpose_ros.messages.published_pair import PublishedPair
from rs_relpose_ros.odometry import need_gtsam
from rs_relpose_ros.odometry.doubts import Doubts
from rs_relpose_ros.odometry.estimator import OdometryEstimator
from rs_relpose_ros.odometry.graph import KeyframeGraph, KeyframeState
from rs_relpose_ros.odometry.interruptions import SampleOrder
from rs_relpose_ros.odometry.offline import (
    consistency,
    draw_paths,
    follow,
    path_of,
    PublishedStates,
    write_states,
    write_tum,
)
from rs_relpose_ros.odometry.pair import (
    Body,
    deviations,
    later,
    Measured,
    Mount,
    without_far_velocities,
)
from rs_relpose_ros.odometry.publication import Stamp, untested_scale
from rs_relpose_ros.odometry.states import Base, ContinuousPath, Notice, OdometryState
from rs_relpose_ros.offline.truth import TrueTrajectory

START_NS = 1_700_000_000_000_000_000
SECOND = 1_000_000_000
INTERVAL = 0.15  # [s] from keyframe to keyframe
ROW = 0.015  # [s] from the stamped to the middle row
SIGMA_R, SIGMA_T = 2e-4, 8e-3  # [rad]
QUAT = (0.502457, -0.504378, 0.507698, 0.485163)
LEVER = (0.03, 0.01, -0.02)
GYRO_BIAS = (0.011, -0.007, 0.005)
ACCEL_BIAS = (0.06, -0.04, 0.05)
PARAMETERS = Parameters.from_mapping(
    {
        'quat_cam_imu_xyzw': QUAT,
        'imu_position': LEVER,
        'readout_time': 0.03,
        'max_coast': 2.0,
        'smoothing_lag': 2.0,  # faster than with the default
        'gyro_bias': tuple(b + 3e-4 for b in GYRO_BIAS),
    }
)


@dataclass(frozen=True)
class Walk:
    pairs: list[PublishedPair]
    samples: list[ImuSample]
    stamps: np.ndarray  # [ns] of the truth, with positions and quaternions
    positions: np.ndarray
    quats: np.ndarray

    @cached_property
    def truth(self) -> TrueTrajectory:
        return TrueTrajectory(self.stamps, self.positions, self.quats)


def walk(plan: str, seconds: float, seed: int = 1, imu_rate: float = 200.0) -> Walk:
    rng = np.random.default_rng(seed)
    path = hand_held(rng, -1.0, seconds + 1.0, Plan.parse(plan), speed=1.6, rotation_rate=0.6)
    at = np.arange(-0.5, seconds + 0.4, 1.0 / imu_rate)
    states = path.states(at)
    R_cam_imu = Rotation.from_quat(QUAT).as_matrix()
    gyro, accel = ImuModel(
        R_cam_imu,
        LEVER,
        GYRO_BIAS,
        ACCEL_BIAS,
        1.7e-4 * math.sqrt(imu_rate),
        2e-3 * math.sqrt(imu_rate),
    ).measure(states, rng)
    stamps = START_NS + np.rint(at * 1e9).astype(np.int64)
    samples = [
        ImuSample(int(ns), tuple(w), tuple(f))
        for ns, w, f in zip(stamps, gyro, accel, strict=True)
    ]
    times = np.arange(0.0, seconds, INTERVAL)
    middle = path.states(times + ROW)
    pairs = []
    for k in range(len(times) - 1):
        R1, R2 = middle.R_world_cam[k : k + 2]
        way = R1.T @ (middle.position[k + 1] - middle.position[k])
        images = estimate_of_images(R1.T @ R2, way, rng)
        moves = bool(np.isfinite(images.t).all())
        status = 'OK' if moves else 'PURE_ROTATION'
        baseline = float(np.linalg.norm(way)) if moves else math.nan
        stamp1, stamp2 = (START_NS + round(times[i] * 1e9) for i in (k, k + 1))
        pairs.append(
            PublishedPair(
                reference_stamp_ns=stamp1,
                stamp_ns=stamp2,
                frame_id='camera',
                reference_imu_ns=stamp1,
                current_imu_ns=stamp2,
                status=status,
                reason='',
                baseline=baseline * math.exp(0.2 * rng.standard_normal()),
                baseline_log_sigma=0.2,
                gyro_bias=np.array(GYRO_BIAS),
                images=images,
                health='unknown',
                findings=Assessment(()),
            )
        )
    return Walk(
        pairs, samples, stamps, states.position, Rotation.from_matrix(states.R_world_cam).as_quat()
    )


def estimate_of_images(
    R_true: np.ndarray, way: np.ndarray, rng: np.random.Generator
) -> ImageInformation:
    """An estimate of a pair with drawn errors; of the rotation alone if the camera stays."""
    noise = np.diag([SIGMA_R**2] * 3 + [SIGMA_T**2] * 2)
    error = rng.multivariate_normal(np.zeros(5), noise)
    R = exp_so3(-error[:3]) @ R_true
    baseline = float(np.linalg.norm(way))
    if baseline > 0.01:
        direction = way / baseline
        t = direction - tangent_basis(direction) @ error[3:]
        information = np.zeros((11, 11))
        information[:5, :5] = np.linalg.inv(noise)
        velocities = np.tile(t / INTERVAL, 2)
        unit = t / np.linalg.norm(t)
        return ImageInformation(ROW, R, unit, velocities, information, np.zeros(11))
    of_rotation = np.linalg.inv(noise[:3, :3])
    unknown = np.full(3, np.nan)
    return ImageInformation(ROW, R, unknown, np.full(6, np.nan), of_rotation, np.zeros(3))


@pytest.fixture(scope='module')
def walked() -> Walk:
    return walk('walk:3,still:1.5,walk:3,rotate:1.2,walk:3', 12.0)


def run(given: Walk, *, pairs=None, samples=None, estimator=None):
    """All samples up to a pair, then the pair, as they come live; keyframes that came of them."""
    estimator = OdometryEstimator(PARAMETERS, keep=True) if estimator is None else estimator
    waiting = list(given.samples if samples is None else samples)
    out = []
    for pair in given.pairs if pairs is None else pairs:
        while waiting and waiting[0].stamp_ns <= pair.current_imu_ns + SECOND // 50:
            estimator.add_imu(waiting.pop(0))
            out += estimator.take()
        estimator.add_pair(pair)
        out += estimator.take()
    for sample in waiting:
        estimator.add_imu(sample)
    return estimator, out + estimator.take(end=True)


@pytest.fixture(scope='module')
def tracked(walked):
    """Estimator and keyframes of the undisturbed walk; not to be changed."""
    return run(walked)


def seconds_of(ns):
    """Time of the walk [s]."""
    return (ns - START_NS) / SECOND


def without(pairs, begin, end):
    """Pairs that are not of the time between two times [s]."""
    return [
        pair
        for pair in pairs
        if seconds_of(pair.current_imu_ns) < begin or seconds_of(pair.reference_imu_ns) > end
    ]


def samples_of(given, begin, end):
    """Samples between two times [s]."""
    return [sample for sample in given.samples if begin <= seconds_of(sample.stamp_ns) < end]


def positions(keyframes):
    return np.array([keyframe.position for keyframe in keyframes])


def ate(keyframes, truth):
    return path_of(keyframes, truth).errors.ate_m


# --- residuals


def test_derivatives_of_deviations_are_those_of_finite_differences():
    rng = np.random.default_rng(0)
    C = Rotation.random(random_state=1).as_matrix()
    arm = np.array([0.1, -0.05, 0.03])
    bodies = [
        Body(
            Rotation.from_rotvec(0.1 * rng.normal(size=3)).as_matrix(),
            np.array([0.3 * k, 0.0, 0.1]),
            rng.normal(size=3),
            rng.normal(size=3),
            rng.normal(size=3),
        )
        for k in range(2)
    ]
    for axes, delay in ((np.zeros(3), 0.0), (np.array([0.02, -0.03, 0.01]), 0.006)):
        mount = Mount(C, arm, axes, delay)
        # The bodies and the camera when the rows are read, without the kernel.
        C_true = Rotation.from_rotvec(axes).as_matrix() @ C
        R_read = [b.R @ Rotation.from_rotvec(delay * b.rate).as_matrix() for b in bodies]
        at = [b.position + delay * b.velocity for b in bodies]
        moving = [
            b.velocity + delay * b.acceleration + R_b @ np.cross(b.rate, arm)
            for b, R_b in zip(bodies, R_read, strict=True)
        ]
        R1, R2 = (R_b @ C_true.T for R_b in R_read)
        q = R1.T @ (at[1] + R_read[1] @ arm - at[0] - R_read[0] @ arm)
        R = np.ascontiguousarray(R1.T @ R2)
        t = q / np.linalg.norm(q)
        velocities = rng.normal(size=6)
        exact, _ = deviations(*bodies, mount, Measured(R, t, velocities))
        expected = np.concatenate([R1.T @ v for v in moving]) / np.linalg.norm(q) - velocities
        np.testing.assert_allclose(exact, [*np.zeros(5), *expected], atol=1e-12)

        t = t + 0.05 * rng.normal(size=3)
        measured = Measured(R, t / np.linalg.norm(t), velocities)
        _, by = deviations(*bodies, mount, measured)
        for k, step in enumerate(1e-6 * np.eye(25)):
            plus, minus = (
                deviations(
                    moved(bodies[0], x[:9]), moved(bodies[1], x[9:18]), turned(mount, x), measured
                )[0]
                for x in (step, -step)
            )
            np.testing.assert_allclose(by[:, k], (plus - minus) / 2e-6, atol=1e-6)


def moved(body, x):
    """A body after small changes (9,) of rotation, position and velocity."""
    return body._replace(
        R=body.R @ Rotation.from_rotvec(x[:3]).as_matrix(),
        position=body.position + body.R @ x[3:6],
        velocity=body.velocity + x[6:9],
    )


def turned(mount, x):
    """The mount after small changes of the arm, of the axes on the left, and of the delay."""
    more = Rotation.from_rotvec(x[21:24]) * Rotation.from_rotvec(mount.axes)
    return Mount(mount.R, mount.arm + x[18:21], more.as_rotvec(), mount.delay + x[24])


# --- paths


def test_path_is_metric(walked, tracked):
    estimator, out = tracked
    assert len(out) > 0.9 * len(walked.pairs)
    live, smoothed = (path_of(path, walked.truth).errors for path in (out, estimator.smoothed()))
    assert live.length_m > 10.0
    assert live.ate_m < 0.05
    assert smoothed.ate_m < 0.035
    assert abs(smoothed.scale_error) < 0.01
    (started,) = estimator.starts
    assert not started.at_rest
    assert started.seconds < 3.0
    assert estimator.counts['contradicting'] == estimator.counts['lost'] == 0


@pytest.mark.recordings
@pytest.mark.long
def test_corners_of_a_real_recording(recordings, tmp_path):
    """A global shutter at 20 Hz; truth by PnP. Found: 3.0 % and 1.6 % live, 1.6 % smoothed."""
    found = on_euroc(recordings / 'euroc_imu_april_corners', tmp_path / 'path.png')
    assert abs(found.live.scale_error) < 0.04
    assert abs(found.smoothed.scale_error) < 0.025
    assert found.live.relative_translation_error_percent < 2.5
    assert found.smoothed.relative_translation_error_percent < 2.0
    assert (tmp_path / 'path.png').stat().st_size > 10_000


def test_covariance_holds():
    """Squared errors of positions against their covariance, over seeds."""
    nees = []
    for seed in range(3):
        given = walk('walk:6', 6.0, seed=seed)
        _, out = run(given)
        path = path_of(out, given.truth)
        for keyframe, error in zip(out[5:], (path.positions - path.truth)[5:], strict=True):
            # The alignment takes a part of the error away.
            nees.append(error @ error / np.trace(keyframe.pose_covariance[:3, :3]))
    assert 0.02 < np.median(nees) < 2.0


def test_start_at_rest_is_at_once():
    given = walk('still:2,walk:4', 6.0)
    estimator, out = run(given)
    assert estimator.starts[0].at_rest
    assert estimator.starts[0].seconds < 0.5
    assert any('at rest' in notice.text for notice in estimator.warnings())
    standing = [keyframe for keyframe in out if seconds_of(keyframe.imu_ns) < 1.8]
    assert len(standing) > 5
    assert np.linalg.norm(positions(standing) - standing[0].position, axis=1).max() < 0.01
    assert ate(out, given.truth) < 0.05


def test_nothing_is_published_before_the_scale_is_known():
    """At constant velocity the IMU does not observe the scale."""
    given = walk('constant:4', 3.0)
    pairs = [replace(pair, baseline=math.nan, baseline_log_sigma=math.nan) for pair in given.pairs]
    estimator, out = run(given, pairs=pairs)
    assert out == []
    assert estimator.state is OdometryState.STARTING
    assert estimator.propagated(pairs[-1].current_imu_ns) is None


def test_slow_motion_is_no_known_scale():
    """2 cm/s of 5 cm/s are not 2 %; 1 sigma of 0.02 m/s along z, 0.01 m/s across."""
    variances = np.diag([1e-6] * 6 + [1e-4, 1e-4, 4e-4] + [1e-4] * 15)
    for speed, expected in ((0.05, 0.2), (0.4, 0.05)):
        zero = np.zeros(3)
        state = KeyframeState(
            np.eye(3), zero, np.array([0.0, 0.0, speed]), zero, zero, np.zeros(9), variances
        )
        graph = KeyframeGraph(state, Doubts(PARAMETERS), PARAMETERS)
        assert graph.scale_sigma() == pytest.approx(expected, rel=1e-6)


def test_far_velocities_have_no_information(walked):
    """Linearised at 25 baselines per interval beside the mean velocity; one baseline is near."""
    pair = walked.pairs[5]
    assert without_far_velocities(pair) is pair
    for way, rows in ((1.0, 11), (25.0, 5)):
        moved = pair.images.velocities + np.eye(6)[4] * way / INTERVAL
        far = replace(pair, images=replace(pair.images, velocities=moved))
        assert len(without_far_velocities(far).images.gradient) == rows


def test_a_gross_pair_before_the_start_is_a_wrong_start(walked):
    turn = exp_so3(np.array([0.0, 0.3, 0.0]))
    pairs = [
        replace(pair, images=replace(pair.images, R=turn @ pair.images.R)) if k == 2 else pair
        for k, pair in enumerate(walked.pairs[:20])
    ]
    _, out = run(walked, pairs=pairs)
    assert seconds_of(out[0].imu_ns) > seconds_of(pairs[2].current_imu_ns) + 3.0 * INTERVAL
    assert ate(out, walked.truth) < 0.05


@pytest.mark.parametrize(
    'changed, reason',
    [
        (lambda force: None, 'there is no accelerometer'),
        (
            lambda force: tuple(value / 9.80665 for value in force),
            'must be specific force in m/s^2',
        ),
    ],
)
def test_a_faulty_accelerometer_is_the_blocking_reason(walked, changed, reason):
    samples = [
        replace(sample, linear_acceleration=changed(sample.linear_acceleration))
        for sample in samples_of(walked, -1.0, 3.0)
    ]
    estimator, out = run(walked, pairs=walked.pairs[:15], samples=samples)
    assert out == []
    assert reason in estimator.blocking_reason


def test_without_a_fault_there_is_no_blocking_reason(walked, tracked):
    fresh = OdometryEstimator(PARAMETERS)
    assert fresh.blocking_reason == '' and fresh.warnings() == []
    fresh.add_imu(replace(walked.samples[0], linear_acceleration=(0.0, 0.0, 20.0)))  # a bump
    assert fresh.blocking_reason == tracked[0].blocking_reason == ''


def test_a_lever_arm_of_zero_is_a_warning():
    at_camera = PARAMETERS.updated({'imu_position': (0.0, 0.0, 0.0)})
    [warning] = OdometryEstimator(at_camera).warnings()
    assert warning.text.startswith('imu_position is zero')


def test_order_of_messages_does_not_matter(walked, tracked):
    rng = np.random.default_rng(3)
    # Each message is late by up to 0.08 s.
    events = sorted(
        [
            (sample.stamp_ns + rng.uniform(0.0, 0.08) * SECOND, 0, k, sample)
            for k, sample in enumerate(walked.samples)
        ]
        + [
            (pair.current_imu_ns + rng.uniform(0.0, 0.08) * SECOND, 1, k, pair)
            for k, pair in enumerate(walked.pairs)
        ]
    )
    estimator = OdometryEstimator(PARAMETERS)
    out = []
    for _, kind, _, message in events:
        (estimator.add_pair if kind else estimator.add_imu)(message)
        out += estimator.take()
    out += estimator.take(end=True)
    np.testing.assert_allclose(positions(out), positions(tracked[1]), atol=1e-3)


def test_the_imu_propagates_keyframes(walked):
    half = len(walked.pairs) // 2
    end = seconds_of(walked.pairs[half - 1].current_imu_ns) + 1.5
    estimator, out = run(
        walked,
        pairs=walked.pairs[:half],
        samples=samples_of(walked, -1.0, end),
        estimator=OdometryEstimator(PARAMETERS),
    )
    newest = out[-1]
    later = newest.imu_ns + SECOND // 10
    propagated = estimator.propagated(later)
    R, t = walked.truth.relative_pose(newest.imu_ns, later)
    np.testing.assert_allclose(newest.R.T @ (propagated.position - newest.position), t, atol=0.01)
    np.testing.assert_allclose(newest.R.T @ propagated.R, R, atol=2e-3)
    assert propagated.stamp_ns - newest.stamp_ns == SECOND // 10
    # By the uncertain velocity, whose error is correlated with that of the position.
    grown = [
        np.trace(x.pose_covariance[:3, :3])
        for x in (newest, estimator.propagated(newest.imu_ns + 13 * SECOND // 10))
    ]
    assert grown[1] > grown[0] + 0.5 * 1.3**2 * np.trace(newest.velocity_covariance[:3, :3])
    assert estimator.propagated(newest.imu_ns + 2 * SECOND) is None  # no samples


# --- the frame of the robot

# Camera optical axes on a robot with x forward and z up, tilted by 10 deg: 0.4 m ahead of it.
BASE_TO_CAMERA = (
    0.4,
    -0.1,
    0.3,
    *(
        Rotation.from_euler('y', 10.0, degrees=True) * Rotation.from_quat((-0.5, 0.5, -0.5, 0.5))
    ).as_quat(),
)
BASE = Base.of('base_link', BASE_TO_CAMERA)
OF_BASE = PARAMETERS.updated({'base_frame': 'base_link', 'base_to_camera': BASE_TO_CAMERA})


@pytest.fixture(scope='module')
def of_base(walked):
    return run(walked, estimator=OdometryEstimator(OF_BASE, keep=True))


def test_the_base_moves_with_the_camera(tracked, of_base):
    """Poses and twists of both are those of one rigid body, in worlds of another heading."""
    assert len(of_base[1]) == len(tracked[1])
    first = BASE.camera(of_base[1][0])
    G = first.R @ tracked[1][0].R.T
    assert G[2, 2] == pytest.approx(1.0, abs=1e-6)  # z is up in both
    for camera, base in zip(tracked[1], of_base[1], strict=True):
        assert (camera.frame_id, base.frame_id) == ('camera', 'base_link')
        carried = BASE.camera(base)
        np.testing.assert_allclose(carried.R, G @ camera.R, atol=1e-4)
        np.testing.assert_allclose(
            carried.position - first.position,
            G @ (camera.position - tracked[1][0].position),
            atol=2e-3,
        )
        np.testing.assert_allclose(
            base.angular_velocity, BASE.R @ camera.angular_velocity, atol=1e-4
        )
        np.testing.assert_allclose(
            base.velocity + np.cross(base.angular_velocity, BASE.position),
            BASE.R @ camera.velocity,
            atol=2e-3,
        )


def test_the_base_starts_at_the_origin_with_x_forward(of_base):
    start = of_base[0].smoothed()[0]
    # By 0.5 m times what all data correct of the first tilt.
    np.testing.assert_allclose(start.position, 0.0, atol=0.03)
    assert abs(math.atan2(start.R[1, 0], start.R[0, 0])) < 0.01


def test_stamps_follow_the_offset_that_the_graph_has_learned(of_base):
    estimator = of_base[0]
    publication = estimator._publication(estimator._run)
    unknown = estimator._doubts
    state = estimator._run.graph.newest
    doubts = np.zeros(unknown.size)
    before = publication.state(replace(state, doubts=doubts), np.zeros(3), Stamp(0, 0, 0, 0))
    offset = IMAGES.part('time_offset').start
    doubts[unknown.images.start + list(unknown.active).index(offset)] = 0.004
    after = publication.state(replace(state, doubts=doubts), np.zeros(3), Stamp(0, 0, 0, 0))
    assert (before.stamp_ns, after.stamp_ns) == (0, -4_000_000)  # rows are read 4 ms later
    assert before.imu_ns == after.imu_ns == 0


@pytest.mark.parametrize('pairs', [5, 20, 200])
def test_a_covariance_of_uncertain_size_holds_its_promise(pairs):
    """Errors by a variance that so many samples show are beyond 3 sigma as often as known ones."""
    rng = np.random.default_rng(pairs)
    errors = (rng.standard_normal((200_000, 3)) ** 2).sum(axis=1)
    variances = rng.chisquare(pairs, 200_000) / pairs
    bound = 13.93  # chi squared of 3 degrees of freedom, 99.7 %
    beyond = (errors / (variances * untested_scale(pairs)) > bound).mean()
    assert 0.002 < beyond < 0.004


def test_covariances_of_the_base_are_those_of_samples(of_base):
    """The body's state is drawn from its covariance; that of the gyro's noise is left out."""
    estimator = of_base[0]
    run_ = estimator._run
    rate = np.array((0.5, -0.8, 0.3))
    noiseless = OdometryEstimator(OF_BASE.updated({'gyro_noise_density': 1e-7}))
    noiseless._first_R = estimator._first_R
    state = run_.graph.newest
    # Lever arms and rates are uncertain enough that every term counts.
    more = np.zeros(len(state.doubts))
    more[:3] = more[noiseless._doubts.gyro_matrix] = 0.02**2
    P = state.covariance + np.diag([*[0.0] * 12, *[1e-2**2] * 3, *more])

    publication = noiseless._publication(run_)._replace(scale=1.0)

    def odometry(state):
        return publication.state(state, rate, Stamp(0, 0, 0, 0))

    published = odometry(replace(state, covariance=P))
    poses = []
    twists = []
    for d in np.random.default_rng(5).multivariate_normal(np.zeros(len(P)), P, 4000):
        one = odometry(
            replace(
                state,
                R=state.R @ exp_so3(d[:3]),
                position=state.position + state.R @ d[3:6],
                velocity=state.velocity + d[6:9],
                gyro_bias=state.gyro_bias + d[12:15],
                doubts=state.doubts + d[15:],
            )
        )
        turn = Rotation.from_matrix(one.R @ published.R.T).as_rotvec()
        poses.append([*(one.position - published.position), *turn])
        twists.append(
            [
                *(one.velocity - published.velocity),
                *(one.angular_velocity - published.angular_velocity),
            ]
        )
    for samples, claimed in (
        (poses, published.pose_covariance),
        (twists, published.velocity_covariance),
    ):
        sigmas = np.sqrt(np.diag(claimed))
        np.testing.assert_allclose(
            np.cov(np.transpose(samples)) / np.outer(sigmas, sigmas),
            claimed / np.outer(sigmas, sigmas),
            atol=0.08,
        )


def test_without_the_position_of_the_camera_on_the_base_nothing_starts(walked):
    estimator, out = run(
        walked,
        pairs=walked.pairs[:15],
        estimator=OdometryEstimator(PARAMETERS.updated({'base_frame': 'base_link'})),
    )
    assert out == []
    assert estimator.blocking_reason.startswith(
        'the camera is not known in base_frame base_link: publish their static transform'
    )
    estimator.base = BASE
    assert run(walked, pairs=walked.pairs[15:30], estimator=estimator)[1]


# --- faults


def contradicting(pairs):
    bad = len(pairs) - 12
    images = pairs[bad].images
    wrong = replace(images, R=exp_so3(np.array([0.0, 0.03, 0.0])) @ images.R)
    return [replace(pair, images=wrong) if k == bad else pair for k, pair in enumerate(pairs)]


# Pairs and samples of a walk with a fault; counts of contradicting pairs, losses and starts.
FAULTS = {
    'a contradicting pair': (lambda w: (contradicting(w.pairs), w.samples), (1, 0, 1)),
    'a second without images': (lambda w: (without(w.pairs, 4, 5), w.samples), (0, 0, 1)),
    'a gap of the IMU': (
        lambda w: (w.pairs, samples_of(w, -1.0, 6.0) + samples_of(w, 6.4, 13.0)),
        (0, 1, 2),
    ),
}


@pytest.mark.parametrize('fault', FAULTS)
def test_the_path_continues_after_a_fault(walked, fault):
    change, counts = FAULTS[fault]
    pairs, samples = change(walked)
    estimator, out = run(walked, pairs=pairs, samples=samples)
    assert (
        estimator.counts['contradicting'],
        estimator.counts['lost'],
        len(estimator.starts),
    ) == counts
    assert out[-1].path == estimator.counts['lost']
    for path in range(counts[2]):
        assert ate([keyframe for keyframe in out if keyframe.path == path], walked.truth) < 0.1


def test_contradicting_pairs_end_a_path_as_missing_ones_do(walked):
    turn = exp_so3(np.array([0.0, 0.3, 0.0]))
    pairs = [
        pair
        if seconds_of(pair.current_imu_ns) < 6.0
        else replace(pair, images=replace(pair.images, R=turn @ pair.images.R))
        for pair in walked.pairs
        if seconds_of(pair.current_imu_ns) < 10.0
    ]
    estimator, out = run(walked, pairs=pairs)
    assert estimator.counts['contradicting'] > 5
    longest = PARAMETERS.odometry.max_coast + INTERVAL
    assert all(seconds_of(one.imu_ns) < 6.0 + longest for one in out if not one.path)
    lost = Notice('lost: no usable pair for 2 s', OdometryState.LOST)
    assert lost in estimator.warnings()


def test_pairs_that_are_wrong_together_count_by_their_innovations():
    """Directions that are off by 9 deg for 2.5 s: chi squared of the position."""
    given = walk('walk:7', 7.0, imu_rate=100.0)
    squares = []
    turn = exp_so3(np.array([0.0, 0.0, 0.16]))
    _, out = run(
        given,
        pairs=[
            replace(pair, images=replace(pair.images, t=turn @ pair.images.t))
            if 4.0 < seconds_of(pair.current_imu_ns) < 6.5
            else pair
            for pair in given.pairs
        ],
    )
    for one in out[1:]:
        _, way = given.truth.relative_pose(out[0].imu_ns, one.imu_ns)
        error = out[0].R.T @ (one.position - out[0].position) - way
        covariance = out[0].R.T @ one.pose_covariance[:3, :3] @ out[0].R
        squares.append(error @ np.linalg.solve(covariance, error))
    # 3 sigma of three; 21 if all count alike.
    assert len(out) > 30 and max(squares) < 14.2


def test_the_end_of_a_path_at_a_keyframe_is_no_gap_of_the_imu(walked):
    """The next pair starts where the last one ended: the interval between them is empty."""
    turn = exp_so3(np.array([0.0, 0.3, 0.0]))
    pairs = [
        replace(pair, images=replace(pair.images, R=turn @ pair.images.R))
        if 6.0 < seconds_of(pair.current_imu_ns) < 8.2
        else pair
        for pair in walked.pairs
    ]
    _, out = run(walked, pairs=pairs)
    later = [keyframe for keyframe in out if keyframe.path == 1]
    assert later
    for keyframe in later:
        assert math.sqrt(keyframe.pose_covariance[5, 5]) < 0.05
        assert math.sqrt(np.trace(keyframe.pose_covariance[:3, :3])) < 0.5


def test_pairs_without_information_are_no_keyframes(walked, tracked):
    pairs = []
    for pair in walked.pairs:
        if not 4.0 < seconds_of(pair.current_imu_ns) < 6.5:
            pairs.append(pair)
            continue
        # One for each frame, as where nothing can be matched.
        pairs += [
            replace(
                pair,
                status='TOO_FEW_MATCHES',
                images=None,
                reference_imu_ns=pair.reference_imu_ns + k * SECOND // 30,
                current_imu_ns=pair.reference_imu_ns + (k + 1) * SECOND // 30,
            )
            for k in range(4)
        ]
    parameters = PARAMETERS.updated({'max_coast': 10.0})
    estimator, out = run(walked, pairs=pairs, estimator=OdometryEstimator(parameters, keep=True))
    assert not [k for k in out if 4.1 < seconds_of(k.imu_ns) < 6.4]
    assert estimator.counts['without images'] > 50
    assert estimator.counts['lost'] == 0 and len(estimator.starts) == 1
    uncertain = estimator.intervals[1]
    assert uncertain.state is OdometryState.UNCERTAIN
    assert seconds_of(uncertain.begin_ns) == pytest.approx(4.35, abs=0.15)
    assert seconds_of(uncertain.end_ns) == pytest.approx(6.6, abs=0.2)
    # Two seconds later velocities are as well known as without the disturbance.
    disturbed, undisturbed = (
        math.sqrt(
            np.trace(
                min(keyframes, key=lambda k: abs(seconds_of(k.imu_ns) - 8.5)).velocity_covariance[
                    :3, :3
                ]
            )
        )
        for keyframes in (out, tracked[1])
    )
    assert disturbed < 1.2 * undisturbed


def test_a_sigma_beyond_its_limit_is_lost(walked):
    for name, limit in (('max_position_sigma', 0.015), ('max_heading_sigma', 0.0015)):
        parameters = PARAMETERS.updated({name: limit, 'gyro_noise_density': 1e-3})
        estimator, _ = run(
            walked,
            pairs=without(walked.pairs, 6.0, 7.9),
            estimator=OdometryEstimator(parameters, keep=True),
        )
        quantity = name.split('_')[1]
        lost, *_ = (one for one in estimator.intervals if one.state is OdometryState.LOST)
        assert lost.reason.startswith(f'the {quantity} is known to ')
        assert 6.3 < seconds_of(lost.begin_ns) < 7.9


def test_an_unknown_lever_arm_is_estimated(walked, tracked):
    at_camera = PARAMETERS.updated({'imu_position': (0.0, 0.0, 0.0)})
    estimator, out = run(walked, estimator=OdometryEstimator(at_camera))
    value, sigma = estimator.imu_position
    assert (sigma < 0.05).all()
    assert (np.abs(value - LEVER) < 3.0 * sigma).all()
    assert ate(out, walked.truth) < 2.0 * ate(tracked[1], walked.truth)


@pytest.mark.parametrize('delay', [0, 8 * SECOND // 100])
def test_the_published_path_is_continuous_and_increasing(walked, delay):
    """Pairs are late by `delay`; without it, keyframes are newer than the last state."""
    estimator = OdometryEstimator(PARAMETERS)
    continuous = ContinuousPath(estimator.propagated)
    published = []
    waiting = list(walked.pairs)
    for k, sample in enumerate(samples_of(walked, -1.0, 8.0)):
        estimator.add_imu(sample)
        while waiting and later(waiting[0], SECOND // 50).current_imu_ns + delay < sample.stamp_ns:
            estimator.add_pair(waiting.pop(0))
            estimator.take(most=1)
        if k % 6 == 0:
            state = continuous.at(sample.stamp_ns)
            published += [] if state is None else [state]
            estimator.take(most=1)
    assert continuous.at(published[-1].imu_ns) is None
    assert len(published) > 150
    for before, after in pairwise(published):
        seconds = (after.stamp_ns - before.stamp_ns) / SECOND
        assert seconds > 0.0
        way = 0.5 * seconds * (before.R @ before.velocity + after.R @ after.velocity)
        # Of a correction, the tenth that is blended in at once.
        assert np.linalg.norm(after.position - before.position - way) < 0.001 + 0.15 * math.sqrt(
            np.trace(before.pose_covariance[:3, :3])
        )


def test_a_graph_that_is_not_solved_is_lost_and_the_path_continues(walked, monkeypatch):
    class Flaky(gtsam.BatchFixedLagSmoother):
        updates = 0

        def update(self, factors, *others):
            Flaky.updates += 1
            if Flaky.updates == 50:  # one or more with each keyframe, in the middle of the walk
                raise RuntimeError('\nIndeterminant linear system\nwhile working near x50')
            return super().update(factors, *others)

    monkeypatch.setattr(gtsam, 'BatchFixedLagSmoother', Flaky)
    estimator, out = run(walked, pairs=contradicting(walked.pairs))
    lost = 'lost: the graph cannot be solved: Indeterminant linear system'
    assert any(notice.text.startswith(lost) for notice in estimator.warnings())
    assert estimator.state is not OdometryState.LOST
    assert out[-1].path == estimator.counts['lost'] > 0
    assert len(estimator.smoothed()) >= len(out)
    assert ate(out, walked.truth) < 0.1


def test_a_path_that_cannot_be_smoothed_is_left_out_with_a_warning(walked, monkeypatch):
    def singular(*_):
        raise RuntimeError('\nIndeterminant linear system\nwhile working near b15')

    estimator, out = run(walked, pairs=walked.pairs[:20])
    estimator.warnings()
    monkeypatch.setattr(gtsam.GaussianFactorGraph, 'eliminateSequential', singular)
    assert out
    assert estimator.smoothed() == []
    [warning] = estimator.warnings()
    assert warning.text.startswith('not smoothed: ')
    assert 'Indeterminant linear system' in warning.text


def test_a_lost_path_continues_where_the_imu_propagated_it(walked):
    estimator, out = run(walked, pairs=without(walked.pairs, 3, 6))
    assert (estimator.counts['lost'], len(estimator.starts)) == (1, 2)
    assert OdometryState.LOST in [notice.state for notice in estimator.warnings()]
    before, after = ([k for k in out if k.path == path] for path in (0, 1))
    assert np.trace(after[0].pose_covariance[:3, :3]) > np.trace(
        before[-1].pose_covariance[:3, :3]
    )
    for part in (before, after):
        assert ate(part, walked.truth) < 0.05
    _, t = walked.truth.relative_pose(before[-1].imu_ns, after[0].imu_ns)
    error = before[-1].R.T @ (after[0].position - before[-1].position) - t
    assert np.linalg.norm(error) < 3.0 * math.sqrt(np.trace(after[0].pose_covariance[:3, :3]))
    assert np.linalg.norm(error) < 0.7


@pytest.mark.parametrize('seconds', [-100.0, -0.5, 0.5])
def test_a_path_continues_after_a_jump_of_the_clock(walked, seconds):
    jump = round(seconds * SECOND)
    at = seconds_of(walked.pairs[39].current_imu_ns)
    estimator, first = run(
        walked,
        pairs=walked.pairs[:40],
        samples=samples_of(walked, -1.0, at + 0.03),
        estimator=OdometryEstimator(PARAMETERS),
    )
    pairs = [
        replace(
            pair,
            stamp_ns=pair.stamp_ns + jump,
            reference_imu_ns=pair.reference_imu_ns + jump,
            current_imu_ns=pair.current_imu_ns + jump,
        )
        for pair in walked.pairs[40:]
    ]
    samples = [
        replace(sample, stamp_ns=sample.stamp_ns + jump)
        for sample in samples_of(walked, at + 0.03, 13.0)
    ]
    estimator, second = run(walked, pairs=pairs, samples=samples, estimator=estimator)
    assert estimator.counts['lost'] == 1
    [lost] = [text for text, state in estimator.warnings() if state is OdometryState.LOST]
    assert lost == 'lost: ' + (
        'the clock of the IMU was set back'
        if seconds < 0.0
        else 'the IMU has a gap, or its clock jumped: see its driver'
    )
    assert len(second) > 0.6 * len(pairs)
    for after in second:
        _, t = walked.truth.relative_pose(first[-1].imu_ns, after.imu_ns - jump)
        error = first[-1].R.T @ (after.position - first[-1].position) - t
        assert np.linalg.norm(error) < 3.0 * math.sqrt(np.trace(after.pose_covariance[:3, :3]))


@pytest.mark.parametrize('seconds', [-0.115, -0.043, 0.085])
def test_a_step_of_the_clock_of_the_imu_is_bridged_with_its_doubt(walked, seconds):
    # Pairs are withheld for 0.5 s, until relpose_node has found the step.
    jump = round(seconds * SECOND)
    at = 6.02
    before, after = (
        [pair for pair in walked.pairs if keeps(pair)]
        for keeps in (
            lambda pair: seconds_of(pair.current_imu_ns) < at,
            lambda pair: seconds_of(pair.reference_imu_ns) > at + 0.5,
        )
    )
    estimator, first = run(walked, pairs=before, samples=samples_of(walked, -1.0, at))
    pairs = [
        replace(
            pair,
            reference_imu_ns=pair.reference_imu_ns + jump,
            current_imu_ns=pair.current_imu_ns + jump,
        )
        for pair in after
    ]
    samples = [
        replace(sample, stamp_ns=sample.stamp_ns + jump) for sample in samples_of(walked, at, 13.0)
    ]
    estimator, second = run(walked, pairs=pairs, samples=samples, estimator=estimator)
    assert (estimator.counts['lost'], len(estimator.starts)) == (1, 2)
    assert len(second) > 0.5 * len(pairs)
    for keyframe in second:
        _, t = walked.truth.relative_pose(first[-1].imu_ns, keyframe.imu_ns - jump)
        error = first[-1].R.T @ (keyframe.position - first[-1].position) - t
        sigma = math.sqrt(np.trace(keyframe.pose_covariance[:3, :3]))
        assert np.linalg.norm(error) < 2.5 * sigma
        # The way within the unknown time, not that of a second without any sample.
        assert sigma < 0.1 + 2.5 * abs(seconds)
    assert (
        ate(
            [replace(keyframe, imu_ns=keyframe.imu_ns - jump) for keyframe in second],
            walked.truth,
        )
        < 0.06
    )


def test_samples_that_are_late_are_no_clock_that_was_set_back():
    known = ImuSamples(0.05)
    order = SampleOrder()

    def at(milliseconds, value=0.0):
        return ImuSample(round(milliseconds * 1e6), (value, 0.0, 1.0), (0.0, value, 9.8))

    for k in [*range(20), *range(23, 40)]:
        assert order.add(at(5.0 * k), known) == ([at(5.0 * k)], False)
        known.add(at(5.0 * k))
    # Three are late, one is repeated, two of another publisher are in between.
    for sample in (at(100.0), at(105.0), at(110.0), at(60.0)):
        assert order.add(sample, known) == ([sample], False)
    others = [at(61.0, 3.0), at(65.0, 3.0)]
    assert [order.add(sample, known) for sample in others] == [((), False)] * 2
    assert order.add(at(200.0), known) == ([*others, at(200.0)], False)
    # A clock that is set back by 23 ms.
    known.add(at(200.0))
    back = [at(177.0 + 5.0 * k, 2.0) for k in range(4)]
    answers = [order.add(sample, known) for sample in back]
    assert answers == [((), False)] * 3 + [(back, True)]


def test_a_pair_that_contradicts_the_gyro_may_be_a_step_of_a_clock(walked):
    estimator, _ = run(walked, pairs=walked.pairs[:16], samples=samples_of(walked, -1.0, 2.6))
    doubtful = replace(
        walked.pairs[16],
        images=None,
        status='NO_CONSENSUS',
        reason="images and gyro contradict each other: a rotation 2.0 deg from the gyro's",
    )
    at_ns = estimator.newest_ns
    certain = estimator.propagated(at_ns)
    estimator.add_pair(doubtful)
    doubted = estimator.propagated(at_ns)
    # As far as the camera moves within a step of 0.2 s.
    error = 0.2 * certain.R @ certain.velocity
    more = doubted.pose_covariance[:3, :3]
    assert error @ np.linalg.solve(certain.pose_covariance[:3, :3], error) > 14.2
    assert error @ np.linalg.solve(more, error) < 3.0
    np.testing.assert_array_equal(doubted.position, certain.position)
    estimator.add_pair(replace(walked.pairs[16], reference_imu_ns=walked.pairs[15].current_imu_ns))
    estimator.take(end=True)
    settled = estimator.propagated(at_ns)
    assert np.trace(settled.pose_covariance[:3, :3]) < 0.1 * np.trace(more)


def test_the_covariance_of_a_badly_conditioned_window_is_that_of_marginals(walked, monkeypatch):
    samples = samples_of(walked, -1.0, 3.2)
    (good, _), (bad, _) = (run(walked, pairs=walked.pairs[:20], samples=samples) for _ in range(2))
    graph = bad._run.graph

    asked = []

    def fails(_, keys):
        asked.append(keys)
        raise RuntimeError('Indeterminate linear system')

    monkeypatch.setattr(gtsam.GaussianFactorGraph, 'marginal', fails)
    graph._read(graph._count - 1)
    assert asked
    wanted, found = (one._run.graph.newest.covariance for one in (good, bad))
    np.testing.assert_allclose(np.diag(found), np.diag(wanted), rtol=1e-4)
    sigmas = np.sqrt(np.diag(wanted))
    np.testing.assert_allclose(
        found / np.outer(sigmas, sigmas), wanted / np.outer(sigmas, sigmas), atol=1e-4
    )


def test_samples_that_come_far_too_late_are_left_out(walked, tracked):
    samples = [*walked.samples]
    late = samples.pop(1000)
    samples.insert(1100, replace(late, angular_velocity=(9.0, 9.0, 9.0)))
    _, out = run(walked, samples=samples)
    np.testing.assert_allclose(positions(out), positions(tracked[1]), atol=0.01)


def test_pairs_of_another_camera_are_refused(walked):
    other = [replace(pair, frame_id='rear_camera') for pair in walked.pairs]
    estimator, _ = run(
        walked,
        pairs=walked.pairs[:20],
        samples=samples_of(walked, -1.0, 3.1),
        estimator=OdometryEstimator(PARAMETERS),
    )
    with pytest.raises(InputError, match='remap relpose_node/pairs to those of one camera'):
        estimator.add_pair(other[20])
    assert estimator.state is OdometryState.TRACKING
    estimator.reset()
    estimator.add_pair(other[20])


@pytest.mark.parametrize('apart', [-100, 5, 100])
def test_a_path_is_lost_where_the_camera_has_another_clock(walked, apart):
    estimator, _ = run(
        walked,
        pairs=walked.pairs[:20],
        estimator=OdometryEstimator(PARAMETERS),
        samples=samples_of(walked, -1.0, 3.1),
    )
    pairs = [later(pair, apart * SECOND) for pair in walked.pairs[20:34]]
    if apart == 5:  # they may still be right
        estimator.add_pair(pairs.pop())
    for pair in pairs if abs(apart) > 10 else ():
        with pytest.raises(InputError, match='camera and IMU must have one clock'):
            estimator.add_pair(pair)
    run(walked, pairs=[], samples=samples_of(walked, 3.1, 5.3), estimator=estimator)
    assert estimator.state is OdometryState.LOST


@pytest.mark.parametrize('turn', [10.0, 90.0])
def test_an_imu_of_another_frame_gives_no_path_and_the_reason(walked, turn):
    R = Rotation.from_euler('x', turn, degrees=True)
    samples = [
        replace(
            sample,
            angular_velocity=tuple(R.apply(sample.angular_velocity)),
            linear_acceleration=tuple(R.apply(sample.linear_acceleration)),
        )
        for sample in samples_of(walked, -1.0, 6.0)
    ]
    # From 3.1 s on at rest, where axes do not show, to 4.5 s.
    for begin in (0.0, 3.1):
        estimator, out = run(
            walked,
            samples=samples,
            estimator=OdometryEstimator(PARAMETERS),
            pairs=[
                pair for pair in walked.pairs[:38] if seconds_of(pair.reference_imu_ns) > begin
            ],
        )
        assert [k for k in out if not 3.0 < seconds_of(k.imu_ns) < 5.5] == []
        assert not (out and begin == 0.0)
        assert estimator.reason.startswith('pairs and IMU contradict each other')
        assert [
            text
            for text in (
                *(notice.text for notice in estimator.warnings()),
                estimator.blocking_reason,
            )
            if 'quat_cam_imu_xyzw' in text
        ]


def test_pairs_that_are_wrong_together_do_not_disprove_axes(walked):
    """As of a moving object; before 20 pairs have agreed with the IMU they do."""
    finding = Finding(
        Code.ACCEL_AXES,
        FindingState.SUSPECT,
        Why.OFF,
        evidence=Evidence(log_likelihood=-20.0),
    )
    for begin, lost in ((2.0, 1), (8.0, 0)):
        estimator, out = run(
            walked,
            pairs=[
                replace(pair, findings=Assessment((finding,)))
                if 0.0 < seconds_of(pair.current_imu_ns) - begin < 1.0
                else pair
                for pair in walked.pairs
            ],
        )
        assert (estimator.counts['lost'], len(estimator.starts)) == (lost, 1 + lost)
        assert ate([one for one in out if one.path == lost], walked.truth) < 0.05


def test_loss_is_reported_without_further_pairs(walked):
    last = seconds_of(walked.pairs[19].current_imu_ns)
    for age, state in (
        (0.2, OdometryState.TRACKING),
        (0.31, OdometryState.UNCERTAIN),
        (1.9, OdometryState.UNCERTAIN),
        (2.1, OdometryState.LOST),
    ):
        estimator, _ = run(
            walked, pairs=walked.pairs[:20], samples=samples_of(walked, -1.0, last + age)
        )
        assert estimator.state is state, age
    assert estimator.counts['lost'] == 1
    assert estimator.warnings()[-1].text == 'lost: no usable pair for 2 s'
    assert [one.state.value for one in estimator.intervals] == ['tracking', 'uncertain', 'lost']
    uncertain = estimator.intervals[1]
    assert 0.25 < (uncertain.begin_ns - walked.pairs[19].stamp_ns) / SECOND - ROW < 0.31
    assert 1.6 < (uncertain.end_ns - uncertain.begin_ns) / SECOND < 1.8


@pytest.mark.parametrize(
    'frames_end, state',
    [
        (0.0, OdometryState.UNCERTAIN),
        (0.5, OdometryState.TRACKING),
        (0.7, OdometryState.UNCERTAIN),
    ],
)
def test_frames_show_whether_a_pair_is_missing(walked, frames_end, state):
    """Frames at 30 Hz until `frames_end` after a pair: slow motion, or a camera that stops."""
    last = seconds_of(walked.pairs[19].current_imu_ns)
    estimator, _ = run(
        walked, pairs=walked.pairs[:20], samples=samples_of(walked, -1.0, last + 0.1)
    )
    frames = list(np.arange(last - 0.5, last + frames_end, 1.0 / 30.0))
    for sample in samples_of(walked, last + 0.1, last + max(frames_end, 0.31)):
        while frames and frames[0] <= seconds_of(sample.stamp_ns):
            estimator.add_frame(START_NS + round(frames.pop(0) * SECOND))
        estimator.add_imu(sample)
    assert estimator.state is state


def test_no_images_for_longer_than_the_window(walked, tracked):
    """The first pairs after a bridge contradict nothing, and velocities are right again."""
    parameters = PARAMETERS.updated({'max_coast': 10.0, 'max_position_sigma': 3.0})
    estimator, out = run(
        walked,
        pairs=without(walked.pairs, 3.5, 9.0),
        estimator=OdometryEstimator(parameters, keep=True),
    )
    assert (estimator.counts['contradicting'], estimator.counts['lost']) == (0, 0)
    for keyframe in out[-5:]:
        undisturbed = next(k for k in tracked[1] if k.imu_ns == keyframe.imu_ns)
        error = keyframe.R @ keyframe.velocity - undisturbed.R @ undisturbed.velocity
        assert np.linalg.norm(error) < 4.0 * math.sqrt(
            np.trace(
                keyframe.velocity_covariance[:3, :3] + undisturbed.velocity_covariance[:3, :3]
            )
        )


def test_a_long_bridge_begins_another_window(walked):
    """Its keyframes would be linearised where the bridge ended, decimetres from where it was."""
    gaps = {3.5: 3.6, 6.0: 7.5}  # one within a quarter of the window of 2 s, one beyond
    kept = []
    for begin, end in gaps.items():
        pairs = without(walked.pairs, begin, end)
        until = [pair for pair in pairs if seconds_of(pair.reference_imu_ns) < end + 0.2]
        graph = run(walked, pairs=until)[0]._run.graph
        kept.append(sum(graph._values.exists(X(k)) for k in range(graph._count)))
    assert kept[0] > 8  # of 2 s
    assert kept[1] <= 4  # its end and what followed


def test_earlier_losses_stay_in_the_covariance(walked):
    """What a gap of the IMU adds to heading and position; the next loss does not restore them."""
    samples = samples_of(walked, -1.0, 3.0) + samples_of(walked, 3.4, 13.0)
    _, out = run(walked, pairs=without(walked.pairs, 6, 8.5), samples=samples)
    last = [[k for k in out if k.path == path][-1] for path in range(3)]
    variances = [np.trace(k.pose_covariance[:3, :3]) for k in last]
    assert variances[2] > variances[1] > 100.0 * variances[0]
    turns = [k.pose_covariance[5, 5] for k in last]
    assert turns[2] > 0.9 * turns[1] > 0.9 * 0.4**2 > 100.0 * turns[0]


def test_pairs_without_imu_do_not_accumulate(walked):
    estimator = OdometryEstimator(PARAMETERS)
    for k in range(300):
        estimator.add_pair(replace(walked.pairs[0], current_imu_ns=START_NS + k * SECOND))
        estimator.take()
    assert estimator.counts['dropped'] == 290


def test_memory_is_constant_unless_the_path_is_kept(walked):
    estimator = OdometryEstimator(PARAMETERS)
    sizes = []
    begin = -1.0
    for k in range(0, 60, 20):
        pairs = walked.pairs[k : k + 20]
        end = seconds_of(pairs[-1].current_imu_ns) + 0.1
        run(walked, estimator=estimator, pairs=pairs, samples=samples_of(walked, begin, end))
        begin = end
        sizes.append(objects_behind(estimator))
    assert estimator.state is OdometryState.TRACKING
    assert sizes[2] - sizes[1] < 5  # a small int is one object, however often it is referenced


def objects_behind(root) -> int:
    """Number of objects that an object keeps alive; not those of modules and types."""
    observed = {}
    ahead = [root]
    while ahead:
        one = ahead.pop()
        if id(one) not in observed and not isinstance(one, (type, ModuleType, FunctionType)):
            observed[id(one)] = one
            ahead += gc.get_referents(one)
    return len(observed)


def test_memory_is_constant_without_pairs():
    estimator = OdometryEstimator(PARAMETERS)
    rng = np.random.default_rng(0)
    sizes = []
    for k in range(12_000):  # two minutes
        if k % 4000 == 0:
            sizes.append(len(pickle.dumps(estimator)))
        estimator.add_imu(
            ImuSample(
                START_NS + k * SECOND // 100, tuple(rng.normal(size=3)), tuple(rng.normal(size=3))
            )
        )
    assert sizes[0] < sizes[1] and abs(sizes[2] - sizes[1]) < 2000  # pruned each 50 ms


def test_without_gtsam_the_error_has_the_command_to_install_it(monkeypatch):
    monkeypatch.setattr(importlib.util, 'find_spec', lambda name: None)
    with pytest.raises(MissingInputError, match=r'pip install .*odometry'):
        need_gtsam()


# --- files


def test_the_plot_has_one_time_axis_and_the_whole_truth(walked, tracked, tmp_path):
    """A live path starts later than the smoothed one, and the truth may end before both."""
    estimator, out = tracked
    paths = {'live': out, 'smoothed': estimator.smoothed()}
    known = [at for at in walked.stamps.tolist() if seconds_of(at) < 9.0]
    truth = TrueTrajectory(known, walked.positions[: len(known)], walked.quats[: len(known)])
    picture = draw_paths(
        {name: path_of(path, truth) for name, path in paths.items()}, tmp_path / 'path.png'
    )
    lines = {line.get_label(): line for line in picture.axes[1].get_lines()}
    assert list(lines) == ['truth', 'live', 'smoothed']
    first_ns = paths['smoothed'][0].imu_ns
    assert out[0].imu_ns > first_ns + SECOND // 5
    for name, path in (*paths.items(), ('truth', paths['smoothed'])):
        at = [keyframe.imu_ns for keyframe in path if seconds_of(keyframe.imu_ns) < 9.0]
        np.testing.assert_allclose(
            lines[name].get_xdata(), [(ns - first_ns) / SECOND for ns in at], atol=1e-9
        )
        true = np.array([walked.truth.position(ns)[2] for ns in at])
        np.testing.assert_allclose(lines[name].get_ydata(), true, atol=0.05)


def test_tum_files_are_exact_to_the_nanosecond(tracked, tmp_path):
    out = tracked[1]
    write_tum(tmp_path / 'path.tum', [(one.stamp_ns, one.R, one.position) for one in out])
    lines = (tmp_path / 'path.tum').read_text().splitlines()
    assert len(lines) == len(out)
    seconds, *values = lines[-1].split()
    assert int(seconds.replace('.', '')) == out[-1].stamp_ns
    np.testing.assert_allclose([float(x) for x in values[:3]], out[-1].position, atol=1e-8)
    np.testing.assert_allclose(
        Rotation.from_quat([float(x) for x in values[3:]]).as_matrix(), out[-1].R, atol=1e-7
    )


def test_states_are_written_as_they_are(walked, tmp_path):
    """A camera that is not the base: its pose, velocity and covariance by samples of the base."""
    estimator = OdometryEstimator(OF_BASE)
    states = PublishedStates(estimator, 30.0)
    pairs = [(pair.current_imu_ns + SECOND // 50, pair) for pair in walked.pairs[:20]]
    samples = [(sample.stamp_ns, sample) for sample in samples_of(walked, -1.0, 3.2)]
    follow(estimator, pairs, samples, states.after)
    assert len(states.published) > 50
    assert np.diff([state.imu_ns for state in states.published]).max() < 0.04 * SECOND
    base = states.published[-1]
    camera = BASE.camera(states.published[-1])
    write_states(tmp_path / 'odometry.csv', [camera])
    header, line = (tmp_path / 'odometry.csv').read_text().splitlines()
    names = header.split(',')
    expected = 'stamp_ns,imu_ns,path,x,y,z,qx,qy,qz,qw,vx,vy,vz,'
    assert header.startswith(expected)
    assert names[13:] == [f'c{i}{j}' for i in range(6) for j in range(6)]
    assert line.split(',')[:3] == [str(base.stamp_ns), str(base.imu_ns), '0']
    numbers = np.array([float(text) for text in line.split(',')[3:]])
    np.testing.assert_array_equal(numbers[:3], camera.position)
    np.testing.assert_allclose(
        Rotation.from_quat(numbers[3:7]).as_matrix(), base.R @ BASE.R, atol=1e-12
    )
    swing = np.cross(base.angular_velocity, BASE.position)
    np.testing.assert_allclose(numbers[7:10], base.R @ (base.velocity + swing), atol=1e-12)
    # By the errors of the base's pose that its covariance allows.
    errors = np.random.default_rng(1).multivariate_normal(np.zeros(6), base.pose_covariance, 4000)
    arms = np.array([exp_so3(error[3:]) @ base.R @ BASE.position for error in errors])
    moved = np.column_stack([errors[:, :3] + arms, errors[:, 3:]])
    sigmas = np.sqrt(np.diag(camera.pose_covariance))
    np.testing.assert_allclose(
        np.cov(moved.T) / np.outer(sigmas, sigmas),
        numbers[10:].reshape(6, 6) / np.outer(sigmas, sigmas),
        atol=0.08,
    )


def test_consistency_is_that_of_the_covariances(walked, tracked):
    """Errors of 2 sigma in each axis: 4 per degree of freedom, and 12 is within 99.7 %."""
    _, keyframes = tracked
    origin = keyframes[3]
    R0 = walked.truth.rotation(origin.imu_ns)
    p0 = walked.truth.position(origin.imu_ns)
    turn = exp_so3(np.array([0.0, 0.0, 0.4]))  # the heading of the truth's world is another
    covariance = np.diag(np.square([0.1, 0.2, 0.3, 0.01, 0.02, 0.03]))

    def state_at(imu_ns, sigmas):
        error = sigmas * np.sqrt(np.diag(covariance))
        R = turn @ walked.truth.rotation(imu_ns)
        velocity = R.T @ turn @ walked.truth.velocity(imu_ns)
        return replace(
            origin,
            imu_ns=imu_ns,
            position=turn @ (walked.truth.position(imu_ns) - p0) + 5.0 + error[:3],
            R=exp_so3(error[3:]) @ R,
            velocity=velocity + error[:3],
            pose_covariance=covariance,
            velocity_covariance=covariance,
        )

    first = replace(origin, R=turn @ R0, position=np.full(3, 5.0))
    times = [keyframe.imu_ns for keyframe in keyframes[10:14]]
    found = consistency([state_at(at, 2.0) for at in times], first, walked.truth)
    for name in ('position', 'rotation', 'velocity'):
        assert found['nees'][name] == pytest.approx(4.0, rel=1e-3)
        assert found['beyond'][name] == 0.0
    found = consistency([state_at(times[0], 2.0), state_at(times[1], 2.2)], first, walked.truth)
    assert found['beyond'] == {'position': 0.5, 'rotation': 0.5, 'velocity': 0.5}
    late = replace(origin, imu_ns=origin.imu_ns + 100 * SECOND)
    assert consistency([late], first, walked.truth) == {'nees': None, 'beyond': None}


# --- deviations of the configuration

OFFSET = 5_000_000  # [ns]
TURN = np.array([0.008, -0.006, 0.007])  # [rad] of the camera's axes


def wrong_by_one_sigma(given, name, sigma):
    """Pairs and parameters whose offset or axes are off, with a sigma."""
    if name == 'time_offset':
        late = [
            replace(
                pair,
                reference_imu_ns=pair.reference_imu_ns - OFFSET,
                current_imu_ns=pair.current_imu_ns - OFFSET,
            )
            for pair in given.pairs
        ]
        return late, PARAMETERS.updated({'time_offset_sigma': sigma})
    quat = (Rotation.from_rotvec(-TURN) * Rotation.from_quat(QUAT)).as_quat()
    changed = {'quat_cam_imu_xyzw': tuple(quat.tolist()), 'axes_sigma': sigma}
    return given.pairs, PARAMETERS.updated(changed)


@pytest.mark.parametrize(
    'name, sigma, true', [('time_offset', 5e-3, [5e-3]), ('axes', 7e-3, TURN.tolist())]
)
def test_states_hold_where_the_configuration_is_off_by_its_sigma(walked, name, sigma, true):
    """Offset or axes are unknowns of the graph, with or without a stated sigma."""
    for stated in (0.0, sigma):
        pairs, parameters = wrong_by_one_sigma(walked, name, stated)
        estimator, out = run(
            walked, pairs=pairs, estimator=OdometryEstimator(parameters, keep=True)
        )
        assert estimator.counts['contradicting'] == estimator.counts['lost'] == 0
        assert abs(path_of(out, walked.truth).errors.scale_error) < 0.01
        values, sigmas = map(np.array, estimator.deviations[name])
        assert (sigmas < 0.7 * sigma).all()
        assert (np.abs(values - true) < 3.0 * sigmas).all()
        # The ground truth is that of the camera's true axes, at times of the IMU.
        found = consistency(out, estimator.smoothed()[0], walked.truth)
        assert max(found['beyond'].values()) == 0.0
        assert max(found['nees'].values()) < 1.0


def test_what_nobody_stated_is_unknown(tracked):
    deviations = tracked[0].deviations
    assert set(deviations) == {
        *('axes', 'time_offset', 'readout_time', 'focal_log', 'principal_point'),
        *('gyro_scale', 'gyro_skew', 'accel_lag'),
    }
    for values, sigmas in deviations.values():
        assert (np.abs(values) < 3.0 * np.array(sigmas)).all()


def measured_by(gyro, given, accel=lambda forces: forces):
    """Samples whose rates (N, 3) and forces are functions of the true ones."""
    rates = gyro(np.array([sample.angular_velocity for sample in given.samples]))
    forces = accel(np.array([sample.linear_acceleration for sample in given.samples]))
    return [
        replace(sample, angular_velocity=tuple(rate), linear_acceleration=tuple(force))
        for sample, rate, force in zip(given.samples, rates, forces, strict=True)
    ]


def test_scale_and_skew_of_the_gyro_are_found(walked):
    """Rates of a gyro whose axes have 1.5 and -1 % of scale and 0.3 deg of skew."""
    true = np.diag([0.015, -0.01, 0.0]) + 0.005 * np.array([[0, 1, 0], [1, 0, 0], [0, 0, 0]])
    wrong = np.linalg.inv(np.eye(3) + true)
    samples = measured_by(lambda rates: rates @ wrong.T, walked)
    estimator, out = run(walked, samples=samples)
    scale, scale_sigma = map(np.array, estimator.deviations['gyro_scale'])
    skew, skew_sigma = map(np.array, estimator.deviations['gyro_skew'])
    assert (np.abs(scale - np.diag(true)) < 3.0 * scale_sigma).all()
    assert (np.abs(skew - [0.0, 0.0, 0.005]) < 3.0 * skew_sigma).all()
    assert (scale_sigma < 0.002).all()
    found = consistency(out, estimator.smoothed()[0], walked.truth)
    assert max(found['beyond'].values()) == 0.0


def test_a_lag_of_the_accelerometer_is_found(walked):
    """Forces of 15 ms before, as of a filter: found, and states within their covariance."""
    lag = 0.015
    seconds = np.array([sample.stamp_ns for sample in walked.samples]) / SECOND
    seconds -= seconds[0]

    def before(forces):
        columns = [np.interp(seconds - lag, seconds, column) for column in forces.T]
        return np.transpose(columns)

    samples = measured_by(lambda rates: rates, walked, before)
    estimator, out = run(walked, samples=samples)
    [found], [sigma] = estimator.deviations['accel_lag']
    assert abs(found - lag) < 3.0 * sigma
    assert sigma < 0.002
    beyond = consistency(out, estimator.smoothed()[0], walked.truth)['beyond']
    assert max(beyond.values()) <= 0.02


def test_noise_of_samples_is_that_of_white_noise_alone():
    seconds = np.arange(400) / 200.0
    swing = np.sin(np.outer(seconds, [5.0, 9.0, 12.0]))
    white = 0.03 * np.random.default_rng(3).standard_normal((400, 3))
    assert noise_of_samples(swing, seconds) < 1e-4
    found = noise_of_samples(swing + white, seconds)
    assert found == pytest.approx(0.03 / math.sqrt(200.0), rel=0.15)


def test_noise_of_the_imu_is_that_of_the_innovations(walked):
    """Ten times the configured noise: named, and states within their covariance."""
    rng = np.random.default_rng(2)
    shape = len(walked.samples), 3
    samples = measured_by(
        lambda rates: rates + 0.024 * rng.standard_normal(shape),
        walked,
        lambda forces: forces + 0.28 * rng.standard_normal(shape),
    )
    estimator, out = run(walked, samples=samples)
    found = {finding.code: finding for finding in estimator.findings}
    gyro = found[Code.GYRO_NOISE]
    assert gyro.estimate == pytest.approx(0.024 / math.sqrt(200.0), rel=1.0)
    assert list(gyro.settings) == ['gyro_noise_density']
    beyond = consistency(out, estimator.smoothed()[0], walked.truth)['beyond']
    assert max(beyond.values()) <= 0.05


def test_right_sensors_are_not_named(tracked):
    assert tracked[0].findings == ()


def test_a_knock_is_bridged_and_named(walked):
    """At rest: 20 g for 15 ms, of which the accelerometer measures 8 g."""
    at = np.array([seconds_of(sample.stamp_ns) for sample in walked.samples])
    hit = (at > 3.7) & (at < 3.715)

    def accel(forces):
        return np.clip(forces + np.where(hit[:, None], [0.0, 0.0, 196.0], 0.0), -78.0, 78.0)

    samples = measured_by(lambda rates: rates, walked, accel)
    estimator, out = run(walked, samples=samples)
    [knock] = estimator.findings
    assert knock.code is Code.KNOCK
    assert estimator.counts['knocks'] == 1
    beyond = consistency(out, estimator.smoothed()[0], walked.truth)['beyond']
    assert max(beyond.values()) == 0.0


def test_images_at_rest_alone_do_not_stop_a_camera_that_walks(walked):
    """Rotations without translation of an object that fills the view, while the IMU moves."""
    still = [
        replace(
            pair,
            status='PURE_ROTATION',
            images=replace(
                pair.images,
                t=np.full(3, np.nan),
                velocities=np.full(6, np.nan),
                information=pair.images.information[:3, :3],
                gradient=np.zeros(3),
            ),
        )
        if 7.0 < seconds_of(pair.reference_imu_ns) < 8.5
        else pair
        for pair in walked.pairs
    ]
    estimator, out = run(walked, pairs=still)
    found = consistency(out, estimator.smoothed()[0], walked.truth)
    assert max(found['beyond'].values()) == 0.0
    assert ate(out, walked.truth) < 0.08


@pytest.mark.parametrize(
    'values',
    [
        {'accel_bias_walk': 1e-9},
        {'gyro_bias_walk': 1e-9},
        {'gyro_noise_density': 1e-7},
        {'gyro_bias_sigma': 0.0},
        {
            'accel_bias_walk': 1e-9,
            'gyro_bias_walk': 1e-9,
            'gyro_noise_density': 1e-7,
            'accel_noise_density': 1e-6,
            'imu_position_sigma': 0.0,
        },
    ],
)
def test_any_legal_noise_parameter_gives_a_path(walked, values):
    parameters = PARAMETERS.updated(values)
    estimator, out = run(
        walked, pairs=walked.pairs[:40], estimator=OdometryEstimator(parameters, keep=True)
    )
    assert estimator.counts['unsolved'] == 0
    assert len(out) > 30
    assert len(estimator.smoothed()) >= len(out)
    assert ate(out, walked.truth) < 0.05


def test_a_graph_that_is_never_solved_is_the_blocking_reason(walked, monkeypatch):
    class Singular(gtsam.BatchFixedLagSmoother):
        def update(self, *_):
            raise RuntimeError('\nIndeterminant linear system\nwhile working near x5')

    monkeypatch.setattr(gtsam, 'BatchFixedLagSmoother', Singular)
    estimator, out = run(walked, pairs=walked.pairs[:10])
    assert out == []
    assert estimator.blocking_reason.startswith(
        'the graph cannot be solved: Indeterminant linear system; check the sigmas'
    )
