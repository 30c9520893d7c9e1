"""Whole runs of odometry: loop closures of the smoothed path, and states through disturbances."""

from dataclasses import replace
import json
import math

from conftest import BUNDLED_PARAMETERS, run_command
import gtsam
import numpy as np
import pytest
from scipy.spatial.transform import Rotation
from test_odometry import PARAMETERS, ROW, run, SECOND, START_NS, walk, without

from rs_relpose_lab.experiments import odometry_disturbances as disturbances
from rs_relpose_lab.experiments import odometry_loops, odometry_recordings, trust_runs
from rs_relpose_lab.simulation import simulate, SimulationConfig
from rs_relpose_ros.cli.main import main
from rs_relpose_ros.estimator.covariance import ImageInformation
from rs_relpose_ros.geometry.camera import RollingShutterCamera
from rs_relpose_ros.geometry.so3 import exp_so3, tangent_basis
from rs_relpose_ros.odometry import loops
from rs_relpose_ros.odometry.rows import ROWS_FILE, RowTrajectory
from rs_relpose_ros.odometry.states import Odometry

ROW_NS = round(ROW * SECOND)
SIGMA = 1e-3  # [rad] of the loops' rotations and directions
NAN = np.full(3, math.nan)


def loop_of(given, one, two, rng, *, wrong=0.0):
    """The pair of two keyframes by the truth, its direction `wrong` by an angle [rad]."""
    R, way = given.truth.relative_pose(one.imu_ns, two.imu_ns)
    R = exp_so3(SIGMA * rng.standard_normal(3)) @ R
    t = way / np.linalg.norm(way)
    t = t + tangent_basis(t) @ (SIGMA * rng.standard_normal(2) + (math.tan(wrong), 0.0))
    information = np.zeros((11, 11))
    information[:5, :5] = np.eye(5) / SIGMA**2
    # Velocities that contradict, as those of frames far apart do.
    information[5:, 5:] = np.eye(6) / SIGMA**2
    images = ImageInformation(
        ROW, R, t / np.linalg.norm(t), np.full(6, 9.0), information, np.zeros(11)
    )
    return replace(
        given.pairs[0],
        stamp_ns=two.imu_ns - ROW_NS,
        images=images,
        reference_imu_ns=one.imu_ns - ROW_NS,
        current_imu_ns=two.imu_ns - ROW_NS,
    )


def end_error(path, truth):
    _, way = truth.relative_pose(path[0].imu_ns, path[-1].imu_ns)
    return np.linalg.norm(path[0].R.T @ (path[-1].position - path[0].position) - way)


def test_loops_that_agree_with_the_path_correct_it():
    given = walk('walk:12', 12.0, imu_rate=100.0)
    rng = np.random.default_rng(3)
    estimator, _ = run(given)
    before = estimator.smoothed()
    ends = list(zip(before[:24:3], before[:-25:-3], strict=True))
    right = [loop_of(given, one, two, rng) for one, two in ends]
    wrong = [loop_of(given, *ends[k], rng, wrong=1.2) for k in (1, 4)]
    # Within the covariance of the path, but not with the right ones.
    wrong_among = [loop_of(given, *ends[k], rng, wrong=0.3) for k in (1, 4)]
    nowhere = replace(right[0], current_imu_ns=right[0].current_imu_ns + 7)  # at no keyframe
    empty = replace(right[0], images=None)
    assert estimator.close_loops([*wrong, nowhere, empty]) == []
    np.testing.assert_allclose(
        [pose.position for pose in estimator.smoothed()],
        [pose.position for pose in before],
        atol=1e-6,
    )
    taken = estimator.close_loops([*wrong_among, *right, *wrong])
    after = estimator.smoothed()
    assert [pair.current_imu_ns - ROW_NS for pair in taken] == [
        pair.current_imu_ns for pair in right
    ]
    assert end_error(after, given.truth) < 0.3 * end_error(before, given.truth)
    error = given.truth.relative_pose(after[0].imu_ns, after[-1].imu_ns)[1] - after[0].R.T @ (
        after[-1].position - after[0].position
    )
    covariance = after[0].R.T @ after[-1].pose_covariance[:3, :3] @ after[0].R
    assert error @ np.linalg.solve(covariance, error) < 14.2  # 3 sigma of three
    assert np.trace(covariance) < 0.2 * np.trace(before[-1].pose_covariance[:3, :3])


def test_views_that_come_back_are_proposed():
    """Out and back along a line without turning; then the same with the camera turned round."""
    camera = RollingShutterCamera(
        width=640,
        height=480,
        fx=450.0,
        fy=450.0,
        cx=320.0,
        cy=240.0,
        distortion=(),
        readout_time=0.0,
    )
    facing = np.array([[0.0, 0.0, 1.0], [-1.0, 0.0, 0.0], [0.0, -1.0, 0.0]])

    def path_of(turned):
        return [
            Odometry(
                at,
                at,
                'camera',
                0,
                0,
                Rotation.from_euler(
                    'z', 180.0 if turned and k > 30 else 0.0, degrees=True
                ).as_matrix()
                @ facing,
                np.array([0.0, 4.0 - abs(k - 30) * 0.1, 1.5]),
                np.eye(6),
                NAN,
                NAN,
                np.eye(6),
            )
            for k in range(61)
            for at in [k * SECOND // 2]
        ]

    found = loops.proposed_loops(path_of(False), 5.0, camera)
    assert len(found) == 30  # one per second
    seconds = np.array(found) / 2.0
    assert (seconds[:, 1] - seconds[:, 0] >= 10.0).all()
    # The same places, k and 60 - k, come first, and no two loops are within a second.
    assert {i + j for i, j in found[:10]} == {60}
    apart = np.abs(seconds[:, None] - seconds).max(axis=2) + 9.0 * np.eye(len(found))
    assert apart.min() >= 1.0
    assert loops.proposed_loops(path_of(True), 5.0, camera) == []
    # Another path of the same recording has no common frame with the first one.
    other = [replace(pose, path=int(k > 30)) for k, pose in enumerate(path_of(False))]
    assert all((i <= 30) == (j <= 30) for i, j in loops.proposed_loops(other, 5.0, camera))


def test_depth_of_the_scene_is_that_of_parallaxes():
    poses = [
        Odometry(
            k,
            k,
            'camera',
            0,
            0,
            np.eye(3),
            np.array([0.1 * k, 0.0, 0.0]),
            np.eye(6),
            NAN,
            NAN,
            np.eye(6),
        )
        for k in range(4)
    ]
    views = {k: (k, parallax) for k, parallax in enumerate((9.0, 9.0, 9.0, 0.1))}
    assert loops.scene_depth(poses, views, 450.0) == pytest.approx(5.0)
    assert math.isnan(loops.scene_depth(poses[:1], views, 450.0))


def test_odometry_of_a_bag_with_loops(bundled_bag, tmp_path, monkeypatch, capsys):
    monkeypatch.setattr(loops, '_APART', 2.0)  # the bag has 6 s
    run_command(
        'odometry', bundled_bag, '--params', BUNDLED_PARAMETERS, '--out', tmp_path, '--loops'
    )
    printed = capsys.readouterr().out
    summary = json.loads((tmp_path / 'summary.json').read_text())
    found = summary['loops']
    assert found['offered'] >= found['related'] >= found['taken'] > 0
    assert f'loops: {found["offered"]} offered, {found["related"]} related' in printed
    assert 0.0 < found['shift_m'] <= found['largest_shift_m'] < 0.05
    assert summary['smoothed']['ate_m'] < 0.02
    # Export draws them.
    rows = RowTrajectory.load(tmp_path / ROWS_FILE)
    assert len(rows.loops_ns) == found['taken']
    assert np.isin(rows.loops_ns, rows.keyframes_ns[:, 1]).all()
    assert (np.diff(rows.loops_ns) > 1.9e9).all()
    assert all(0.0 < value < 3.0 for value in summary['nees'].values())
    assert summary['beyond'] == {'position': 0.0, 'rotation': 0.0, 'velocity': 0.0}


def test_a_bag_without_a_solved_graph_is_an_error(bundled_bag, tmp_path, monkeypatch, capsys):
    class Singular(gtsam.BatchFixedLagSmoother):
        def update(self, *_):
            raise RuntimeError('\nIndeterminant linear system\nwhile working near x5')

    monkeypatch.setattr(gtsam, 'BatchFixedLagSmoother', Singular)
    command = ['odometry', str(bundled_bag), '--params', str(BUNDLED_PARAMETERS)]
    assert main([*command, '--out', str(tmp_path)]) == 1
    printed = capsys.readouterr().out
    assert 'odometry did not start: the graph cannot be solved: Indeterminant' in printed
    assert len((tmp_path / 'odometry.csv').read_text().splitlines()) == 1


@pytest.mark.long
def test_metrics_of_a_closed_walk(monkeypatch):
    monkeypatch.setattr(loops, '_APART', 2.5)
    config = SimulationConfig(seed=9101, duration=4.0, plan='walk:4', fps=20.0, readout_time=0.02)
    path = odometry_loops.closed(simulate(config).trajectory, 4.0)
    (begin, end), (R1, R2) = path.poses([0.0, 4.0])
    np.testing.assert_allclose(begin, end, atol=1e-9)
    assert abs((R1.T @ R2)[2, 2] - 1.0) < 0.02  # the same view, but for nodding
    metrics = odometry_loops.on_walk(config, path)
    assert metrics.offered >= metrics.related >= metrics.taken > 0
    assert metrics.worst < 1.0
    assert metrics.end < metrics.end_without < 0.2


# -- Disturbances of `benchmark odometry`: their tracks, and the states that follow ----------


def test_states_through_a_disturbance():
    given = walk('walk:14', 14.0, imu_rate=100.0)
    # Gyro and accelerometer in messages of their own.
    samples = [
        (sample.stamp_ns, part)
        for sample in given.samples
        for part in (
            replace(sample, linear_acceleration=None),
            replace(sample, angular_velocity=None),
        )
    ]
    R = Rotation.from_quat(given.quats).as_matrix()
    velocity = np.gradient(given.positions, (given.stamps - START_NS) * 1e-9, axis=0)
    feed = disturbances.Feed(
        PARAMETERS.updated({'max_coast': 10.0}).to_mapping(),
        [(pair.current_imu_ns, pair) for pair in without(given.pairs, 6.0, 8.0)],
        samples,
        [],
    )
    truth = disturbances.TrueStates(given.stamps, given.positions, R, velocity)
    found = disturbances.on_feed('no images, 2 s', 1, feed, truth)
    # At 25 Hz, of an IMU with 100 Hz, and until the last sample.
    assert found.states == pytest.approx(25 * 8.4, abs=10)
    assert found.beyond_position + found.beyond_rotation + found.beyond_velocity < 10
    assert found.velocity_ratio < 2.0 and found.tilt_ratio < 2.0
    assert 0.2 < found.uncertain_after < 0.32
    assert found.lost == 0 and found.largest_step < 1.0
    # A truth that is elsewhere by 1 m after the disturbance.
    elsewhere = given.positions + (given.stamps > START_NS + 8e9)[:, None] * [1.0, 0.0, 0.0]
    other = disturbances.on_feed('no images, 2 s', 1, feed, replace(truth, position=elsewhere))
    assert other.beyond_position > 100


@pytest.mark.long
def test_a_recording_in_parts(monkeypatch, tmp_path):
    """A path and its halves, of which the first one has no pairs in its last second."""
    given = walk('walk:9', 9.0, imu_rate=100.0)
    of_frames = trust_runs.simulated(
        trust_runs.Source('walk', trust_runs.TRACKS),
        simulate(SimulationConfig(duration=0.2)),
        trust_runs.TrackNoise(),
        np.random.default_rng(0),
    )
    recording = replace(
        of_frames,
        samples=given.samples,
        arrivals=[
            trust_runs.Arrival(k, ns, ns) for k, ns in enumerate(given.stamps[::5].tolist())
        ],
    )

    def feed_of(part):
        first = part.arrivals[0].stamp_ns
        last = part.arrivals[-1].stamp_ns
        is_first = last < START_NS + 6e9
        return disturbances.Feed(
            PARAMETERS.to_mapping(),
            [
                (pair.current_imu_ns, pair)
                for pair in given.pairs
                if (first <= pair.reference_imu_ns and pair.current_imu_ns < last - is_first * 1e9)
            ],
            [(sample.stamp_ns, sample) for sample in part.samples],
            [],
        )

    monkeypatch.setattr(odometry_recordings, 'recording_at', lambda path: recording)
    monkeypatch.setattr(disturbances, 'feed_of', feed_of)
    _, first, _ = found = list(odometry_recordings.on_recording(tmp_path / 'walk', 4.4))
    assert [one.begin for one in found] == [0.0, 0.0, 4.4]
    for one in found:
        assert 0.0 < one.start < 2.0 and abs(one.speed) < 3.0 and one.step < 1.0
        assert abs(one.scale) < 3.0 * one.claimed and abs(one.drift) < 3.0 and one.beyond < 5.0
        assert one.lost == 0
    assert first.uncertain == 1 and first.state == 'uncertain'
    report = odometry_recordings.write_report(tmp_path, found)
    assert report.count('| walk') == 3
