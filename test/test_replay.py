"""Replay: outputs on the bundled bag, repeatability, and bad input from end to end."""

from __future__ import annotations

import csv
import itertools
import json
from pathlib import Path
import subprocess
import sys

import cv2
import numpy as np
import pytest
from rosbags.highlevel import AnyReader
from scipy.spatial.transform import Rotation, Slerp

from rs_relpose_ros.bags.reader import open_bag
from rs_relpose_ros.bags.writer import BagWriter
from rs_relpose_ros.cli.main import main
from rs_relpose_ros.config.parameter_file import read_parameters
from rs_relpose_ros.errors import InputError
from rs_relpose_ros.geometry.camera import RollingShutterCamera
from rs_relpose_ros.messages.incoming import stamp_ns
from rs_relpose_ros.replay.truth import TrueTrajectory

HEADER = ('reference_stamp_ns,stamp_ns,tx,ty,tz,qx,qy,qz,qw,sigma_t1,sigma_t2,sigma_rx,sigma_ry,'
          'sigma_rz,inliers,matches,model,status,baseline_m,baseline_log_sigma')
START_NS = 1_700_000_000_000_000_000
CAMERA = RollingShutterCamera(width=160, height=120, fx=120.0, fy=120.0, cx=79.5, cy=59.5,
                              readout_time=0.02)
SENSOR = ['--set', 'readout_time=0.02', '--set', 'quat_cam_imu_xyzw=[0, 0, 0, 1]']


def rows_of(path: Path) -> list[dict[str, str]]:
    with path.open(newline='') as file:
        return list(csv.DictReader(file))


# -- the bundled bag -------------------------------------------------------------------------


@pytest.fixture(scope='module')
def parameters_file(bundled_bag: Path) -> str:
    return str(bundled_bag.with_name(bundled_bag.name + '.yaml'))


@pytest.fixture(scope='module')
def replayed(bundled_bag: Path, parameters_file: str,
             tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Outputs of a replay of the bundled bag with everything on."""
    folder = tmp_path_factory.mktemp('replay')
    assert main(['replay', str(bundled_bag), '--params', parameters_file, '--out', str(folder),
                 '--bag']) == 0
    return folder


def truth_of(bag: Path) -> tuple[np.ndarray, np.ndarray, Rotation]:
    """Stamps [s since START_NS], positions and rotations of the ground truth, by rosbags alone."""
    stamps, positions, quats = [], [], []
    with AnyReader([bag]) as reader:
        connections = [c for c in reader.connections if c.topic == '/ground_truth/pose']
        for connection, _, data in reader.messages(connections):
            msg = reader.deserialize(data, connection.msgtype)
            stamps.append((msg.header.stamp.sec * 10**9 + msg.header.stamp.nanosec - START_NS)
                          / 1e9)
            p, q = msg.pose.position, msg.pose.orientation
            positions.append((p.x, p.y, p.z))
            quats.append((q.x, q.y, q.z, q.w))
    return np.array(stamps), np.array(positions), Rotation.from_quat(quats)


def test_table_has_the_header_and_whole_rows(replayed):
    text = (replayed / 'relative_poses.csv').read_text()
    assert text.splitlines()[0] == HEADER
    rows = rows_of(replayed / 'relative_poses.csv')
    assert len(rows) >= 25
    statuses = {row['status'] for row in rows}
    assert 'OK' in statuses and statuses <= {'OK', 'PURE_ROTATION', 'LOW_PARALLAX'}
    for before, after in itertools.pairwise(rows):
        assert before['stamp_ns'] == after['reference_stamp_ns']
    for row in rows:
        figures = [row[name] for name in HEADER.split(',')[2:14]]
        if row['status'] == 'OK':
            values = np.array(figures, dtype=float)
            assert np.linalg.norm(values[:3]) == pytest.approx(1.0, abs=1e-9)
            assert np.linalg.norm(values[3:7]) == pytest.approx(1.0, abs=1e-9)
            assert (values[7:] > 0.0).all() and values[7] >= values[8]
            assert 0 < int(row['inliers']) <= int(row['matches'])
            assert row['model'] == 'uniform'
        else:
            # The rotation alone: this bag has no pair without one.
            assert figures[:3] == [''] * 3 and figures[7:9] == [''] * 2
            values = np.array(figures[3:7] + figures[9:], dtype=float)
            assert np.linalg.norm(values[:4]) == pytest.approx(1.0, abs=1e-9)
            assert (values[4:] > 0.0).all() and (values[4:] < 0.01).all()
            assert 0 < int(row['inliers']) <= int(row['matches'])
            assert row['model'] == 'angular'
    assert 'PURE_ROTATION' in statuses


def test_errors_agree_with_an_independent_calculation(replayed, bundled_bag):
    times, positions, rotations = truth_of(bundled_bag)
    errors = {row['stamp_ns']: row for row in rows_of(replayed / 'errors.csv')}
    rotation_errors, translation_errors = [], []
    for row in rows_of(replayed / 'relative_poses.csv'):
        poses = []
        for name in ('reference_stamp_ns', 'stamp_ns'):   # time_offset of this bag is 0
            t = (int(row[name]) - START_NS) / 1e9
            k = int(np.clip(np.searchsorted(times, t) - 1, 0, len(times) - 2))
            f = (t - times[k]) / (times[k + 1] - times[k])
            turn = (rotations[k].inv() * rotations[k + 1]).as_rotvec()
            poses.append((rotations[k] * Rotation.from_rotvec(f * turn),
                          (1.0 - f) * positions[k] + f * positions[k + 1]))
        (R1, p1), (R2, p2) = poses
        told = errors[row['stamp_ns']]
        assert float(told['baseline_m']) == pytest.approx(np.linalg.norm(p2 - p1), abs=1e-4)
        assert told['status'] == row['status']
        estimated = Rotation.from_quat([float(row[c]) for c in ('qx', 'qy', 'qz', 'qw')])
        rotation = np.degrees((estimated.inv() * R1.inv() * R2).magnitude())
        if row['status'] != 'OK':
            assert told['translation_error_deg'] == ''
            assert float(told['rotation_error_deg']) == pytest.approx(rotation, abs=1e-4)
            assert rotation <= 0.15
            continue
        t_true = R1.inv().apply(p2 - p1)
        t_true /= np.linalg.norm(t_true)
        t_estimated = np.array([float(row[c]) for c in ('tx', 'ty', 'tz')])
        translation = np.degrees(np.arccos(np.clip(t_true @ t_estimated, -1.0, 1.0)))
        assert float(told['rotation_error_deg']) == pytest.approx(rotation, abs=1e-4)
        assert float(told['translation_error_deg']) == pytest.approx(translation, abs=0.05)
        rotation_errors.append(rotation)
        translation_errors.append(translation)
    # What the issue asks of the bundled bag.
    assert np.median(rotation_errors) <= 0.15
    assert np.median(translation_errors) <= 3.0
    summary = json.loads((replayed / 'summary.json').read_text())['errors_against_truth']
    assert summary['rotation_median_deg'] == pytest.approx(np.median(rotation_errors), abs=1e-4)
    assert summary['translation_p90_deg'] == pytest.approx(
        np.percentile(translation_errors, 90), abs=0.05)


def test_baselines_agree_with_the_truth(replayed):
    true = {row['stamp_ns']: float(row['baseline_m']) for row in rows_of(replayed / 'errors.csv')}
    rows = rows_of(replayed / 'relative_poses.csv')
    known = [row for row in rows if row['baseline_m']]
    assert all(row['status'] == 'OK' for row in known)
    assert len(known) >= 15
    errors = np.array([np.log(float(row['baseline_m']) / true[row['stamp_ns']]) for row in known])
    sigmas = np.array([float(row['baseline_log_sigma']) for row in known])
    assert np.median(np.abs(errors)) < 0.2
    assert (np.abs(errors) < 3.0 * sigmas).all()


def test_poses_between_the_middle_rows(replayed, bundled_bag, parameters_file, tmp_path, capsys):
    assert main(['replay', str(bundled_bag), '--params', parameters_file, '--set',
                 'pose_row=middle', '--out', str(tmp_path)]) == 0
    capsys.readouterr()
    at_stamps, at_middle = (rows_of(folder / 'relative_poses.csv')
                            for folder in (replayed, tmp_path))
    assert len(at_stamps) == len(at_middle)
    for first, middle in zip(at_stamps, at_middle, strict=True):
        for name in ('reference_stamp_ns', 'stamp_ns'):   # half of 30 ms, 479 of 480 rows
            assert int(middle[name]) - int(first[name]) == 14_968_750
    times, positions, rotations = truth_of(bundled_bag)
    rotations = Slerp(times, rotations)
    errors = []
    for row in at_middle:
        if row['status'] == 'OK':
            seconds = [(int(row[name]) - START_NS) / 1e9
                       for name in ('reference_stamp_ns', 'stamp_ns')]
            p1, p2 = (np.array([np.interp(t, times, axis) for axis in positions.T])
                      for t in seconds)
            t_true = rotations(seconds[0]).inv().apply(p2 - p1)
            t = np.array([float(row[name]) for name in ('tx', 'ty', 'tz')])
            errors.append(np.degrees(np.arccos(np.clip(
                t @ t_true / np.linalg.norm(t_true), -1.0, 1.0))))
    assert np.median(errors) < 0.4 and np.quantile(errors, 0.9) < 0.8


def test_summary_agrees_with_the_table(replayed, bundled_bag):
    summary = json.loads((replayed / 'summary.json').read_text())
    rows = rows_of(replayed / 'relative_poses.csv')
    assert summary['pairs']['total'] == len(rows)
    for status, count in summary['pairs']['by_status'].items():
        assert count == sum(row['status'] == status for row in rows)
    assert summary['pairs']['answered'] == summary['pairs']['by_status']['OK']
    with AnyReader([bundled_bag]) as reader:
        images = sum(c.msgcount for c in reader.connections if 'image' in c.topic)
    assert summary['frames']['in_bag'] == summary['frames']['processed'] == images
    assert summary['frames']['refused'] == {} and summary['not_used'] == {}
    answered = [row for row in rows if row['status'] == 'OK']
    assert summary['medians']['inliers'] == np.median([int(row['inliers']) for row in answered])
    sigmas = [float(row['baseline_log_sigma']) for row in answered if row['baseline_m']]
    baselines = summary['baselines']
    assert baselines['known'] == len(sigmas) > 10
    assert baselines['log_sigma_median'] == pytest.approx(np.median(sigmas))
    assert sum(baselines['not_known'].values()) == len(answered) - len(sigmas) > 0
    assert summary['topics']['truth'] == '/ground_truth/pose'
    assert summary['parameters']['readout_time'] == 0.03
    assert summary['versions']['opencv'] == cv2.__version__


def test_pictures_are_drawn(replayed):
    for name in ('matches.png', 'errors.png', 'residuals.png', 'rotation.png'):
        picture = cv2.imread(str(replayed / name))
        assert picture is not None and min(picture.shape[:2]) > 400, name
        # Colours as one integer each: rows are dear to compare.
        colours = picture.astype(np.uint32) @ np.array([1, 1 << 8, 1 << 16], dtype=np.uint32)
        assert len(np.unique(colours)) > 50, f'{name} is empty'


def test_the_bag_of_the_poses_equals_the_table(replayed):
    rows = rows_of(replayed / 'relative_poses.csv')
    answered = [row for row in rows if row['status'] == 'OK']
    topics: dict[str, list] = {}
    with AnyReader([replayed / 'relpose_bag']) as reader:
        for connection, _, data in reader.messages():
            topics.setdefault(connection.topic, []).append(
                reader.deserialize(data, connection.msgtype))
    assert sorted(topics) == [f'/relpose_node/{name}' for name in (
        'matches', 'pairs', 'reference', 'relative_pose', 'relative_rotation', 'velocity')]
    for row, pose, matches in zip(answered, topics['/relpose_node/relative_pose'],
                                  topics['/relpose_node/matches'], strict=True):
        stamp = pose.header.stamp
        assert stamp.sec * 10**9 + stamp.nanosec == int(row['stamp_ns'])
        assert pose.pose.pose.position.x == float(row['tx'])
        assert pose.pose.pose.orientation.w == float(row['qw'])
        assert matches.width == int(row['inliers'])
    for row, rotation, told in zip(rows, topics['/relpose_node/relative_rotation'],
                                   topics['/relpose_node/pairs'], strict=True):
        assert rotation.orientation.w == float(row['qw'])
        np.testing.assert_allclose(np.sqrt(rotation.orientation_covariance[[0, 4, 8]]), [
            float(row[name]) for name in ('sigma_rx', 'sigma_ry', 'sigma_rz')], rtol=1e-12)
        [status] = told.status
        values = {item.key: item.value for item in status.values}
        for name in ('reference_stamp_ns', 'status', 'model', 'inliers', 'matches'):
            assert values[name] == row[name]
        assert float(values['rotation_difference_to_gyro_deg']) < 0.5
        # As the parameter file beside the bag has it, or as seen at rest.
        np.testing.assert_allclose(np.array(values['gyro_bias_rad_s'].split(), dtype=float),
                                   [0.010885, -0.007021, 0.005061], atol=2e-3)


def test_two_runs_are_equal_and_stamps_restrict(replayed, bundled_bag, parameters_file, tmp_path,
                                                capsys):
    stamps = []
    with AnyReader([bundled_bag]) as reader:
        connections = [c for c in reader.connections if c.topic.endswith('compressed')]
        for connection, _, data in reader.messages(connections):
            stamp = reader.deserialize(data, connection.msgtype).header.stamp
            stamps.append(stamp.sec * 10**9 + stamp.nanosec)

    def table(*options: str) -> str:
        assert main(['replay', str(bundled_bag), '--params', parameters_file, '--no-pictures',
                     '--out', str(tmp_path / 'out'), *options]) == 0
        return (tmp_path / 'out' / 'relative_poses.csv').read_text()

    # Of the frames of the first 1.5 s the pairs are those of the whole run.
    file = tmp_path / 'stamps.txt'
    file.write_text('\n'.join(map(str, stamps[:45])))
    full = (replayed / 'relative_poses.csv').read_text().splitlines()
    first = table('--stamps', str(file)).splitlines()
    assert 4 < len(first) < len(full) and full[:len(first)] == first
    # Every other frame only: nothing else takes part.
    chosen = stamps[20:80:2]
    file.write_text('\n'.join(map(str, chosen)))
    table('--stamps', str(file))
    rows = rows_of(tmp_path / 'out' / 'relative_poses.csv')
    used = {int(row[name]) for row in rows for name in ('reference_stamp_ns', 'stamp_ns')}
    assert rows and used <= set(chosen)
    summary = json.loads((tmp_path / 'out' / 'summary.json').read_text())
    assert summary['frames']['processed'] == 30
    assert summary['frames']['not_among_stamps'] == len(stamps) - 30
    # In a pipe there is no progress bar.
    assert '\r' not in capsys.readouterr().err


@pytest.mark.parametrize('kind', ['uncalibrated', 'absent'])
def test_intrinsics_by_parameters_are_as_good(replayed, bundled_bag, parameters_file, tmp_path,
                                              kind):
    """The first second of the bundled bag, its calibration in the parameters: equal bit by bit."""
    with open_bag(bundled_bag) as bag, BagWriter(tmp_path / 'bag') as out:
        topics = bag.find_topics()
        for item in bag.messages([topics.image, topics.imu, topics.camera_info]):
            topic, message = item.topic, item.message
            if item.bag_time_ns > START_NS + 10**9:
                break
            if topic == topics.camera_info.name:
                d, model = message.d.tolist(), message.distortion_model
                k = message.k.tolist()
                if kind == 'absent':
                    continue
                message = out.camera_info(stamp_ns(message.header), 'camera', CAMERA)
                message.k[:] = 0.0
            out.write(topic, message.__msgtype__, message, item.bag_time_ns)
    assert main(['replay', str(tmp_path / 'bag'), '--params', parameters_file, '--no-pictures',
                 '--set', f'camera_matrix={k}', '--set', f'distortion_coefficients={d}',
                 '--set', f'distortion_model={model}', '--out', str(tmp_path / 'out')]) == 0
    first = (tmp_path / 'out' / 'relative_poses.csv').read_text().splitlines()
    assert len(first) > 3
    full = (replayed / 'relative_poses.csv').read_text().splitlines()
    # The last ones end with the bag.
    assert first[:-1] == full[:len(first) - 1]


def test_a_wrong_figure_is_told_and_is_exit_code_1(bundled_bag, parameters_file, tmp_path, capsys):
    """The first second with a time offset that is 22 ms off: no row's."""
    stamps, out = tmp_path / 'stamps.txt', tmp_path / 'out'
    with open_bag(bundled_bag) as bag:
        images = bag.messages([bag.find_topics().image])
        stamps.write_text('\n'.join(str(stamp_ns(item.message.header))
                                    for item in itertools.islice(images, 33)))
    assert main(['replay', str(bundled_bag), '--params', parameters_file, '--stamps', str(stamps),
                 '--set', 'time_offset=0.022', '--out', str(out)]) == 1
    [line] = [line for line in capsys.readouterr().out.splitlines()
              if line.startswith('time_offset')]
    assert line.startswith('time_offset is wrong: ') and 'set time_offset: ' in line
    rows = rows_of(out / 'relative_poses.csv')
    withheld = [row for row in rows if row['status'] == 'WITHHELD']
    assert len(withheld) >= 3
    assert all(row['tx'] == row['qw'] == row['sigma_rx'] == '' for row in withheld)
    summary = json.loads((out / 'summary.json').read_text())
    assert summary['pairs']['by_status']['WITHHELD'] == len(withheld)
    assert summary['health']['state'] == 'wrong'
    [finding] = [item for item in summary['health']['findings'] if item['state'] == 'wrong']
    assert (finding['figure'], finding['told'], finding['unit']) == ('time_offset', 0.022, 's')
    assert abs(finding['seen']) < 0.01
    assert finding['sentence'] in line
    assert len(list(out.glob('*.png'))) == 4


# -- recordings of real cameras --------------------------------------------------------------


@pytest.mark.recordings
@pytest.mark.parametrize('name', ['realsense_rgb_rs', 'xiaomi_cc9_rs'])
def test_recordings(recordings, tmp_path, name):
    """With the gyro for the rows only, the rotation between the frames comes from the images.

    Without that of the gyro directions are less certain: 4 of 28 by more than 10 deg.
    """
    bag, out = tmp_path / name, tmp_path / 'out'
    assert main(['convert', name, str(recordings / name), str(bag)]) == 0
    assert main(['replay', str(bag), '--params', f'{bag}.yaml', '--set',
                 'use_gyro_rotation=false', '--set', 'max_translation_sigma=30',
                 '--out', str(out)]) == 0
    summary = json.loads((out / 'summary.json').read_text())
    assert summary['frames']['processed'] == summary['frames']['in_bag']
    assert summary['pairs']['total'] >= 5
    # What the issue asks of both recordings.
    assert summary['pairs']['answered'] >= 0.9 * summary['pairs']['total']
    assert summary['medians']['rotation_difference_to_gyro_deg'] <= 0.5
    assert summary['errors_against_truth'] is None and not (out / 'errors.csv').exists()
    assert {path.name for path in out.glob('*.png')} == {
        'matches.png', 'residuals.png', 'rotation.png'}


# -- truth -----------------------------------------------------------------------------------


def test_truth_of_a_known_motion():
    """A camera on a circle of radius 2 m that turns with it, w = 0.5 rad/s about its y axis."""
    stamps = START_NS + 10_000_000 * np.arange(101)
    angles = 0.5 * np.arange(101) / 100.0
    positions = 2.0 * np.stack([np.sin(angles), 0.0 * angles, np.cos(angles)], axis=1)
    quats = Rotation.from_rotvec(np.outer(angles, [0.0, 1.0, 0.0])).as_quat()
    truth = TrueTrajectory(stamps[::-1], positions[::-1], quats[::-1])
    ns1, ns2 = START_NS + 123_456_789, START_NS + 623_456_789   # half a second: 0.25 rad
    R, t = truth.relative_pose(ns1, ns2)
    np.testing.assert_allclose(R, Rotation.from_rotvec([0.0, 0.25, 0.0]).as_matrix(), atol=1e-9)
    np.testing.assert_allclose(t, [2.0 * np.sin(0.25), 0.0, 2.0 * (np.cos(0.25) - 1.0)],
                               atol=1e-8)
    off = Rotation.from_rotvec([np.radians(3.0), 0.0, 0.0]).as_matrix()
    errors = truth.errors(R @ off, Rotation.from_rotvec([0.0, 0.0, 0.1]).apply([t[0], 0.0, 0.0]),
                          ns1, ns2)
    assert errors.rotation_error == pytest.approx(3.0, abs=1e-9)
    assert errors.baseline == pytest.approx(4.0 * np.sin(0.125), abs=1e-8)   # the chord
    aside = np.array([np.cos(0.1), np.sin(0.1), 0.0])
    assert errors.translation_error == pytest.approx(
        np.degrees(np.arccos(aside @ t / np.linalg.norm(t))), abs=1e-9)
    assert truth.relative_pose(ns1, START_NS + 1_000_000_001) is None
    assert truth.relative_pose(START_NS - 1, ns2) is None
    assert truth.covers(START_NS) and truth.covers(START_NS + 10**9)


def test_truth_is_not_interpolated_across_a_hole():
    stamps = START_NS + 10_000_000 * np.array([0, 1, 2, 3, 60, 61, 62])
    truth = TrueTrajectory(stamps, np.zeros((7, 3)), np.tile([0.0, 0.0, 0.0, 1.0], (7, 1)))
    assert truth.covers(START_NS + 15_000_000)
    assert not truth.covers(START_NS + 300_000_000)


@pytest.mark.parametrize('count, quat', [(3, (0, 0, 0, 1)), (9, (0, 0, 0, 0)),
                                         (9, (0, 0, 0, np.nan))])
def test_unusable_truth_is_refused(count, quat):
    with pytest.raises(InputError):
        TrueTrajectory(START_NS + np.arange(count), np.zeros((count, 3)),
                       np.tile(np.array(quat, dtype=float), (count, 1)))


# -- parameter files -------------------------------------------------------------------------


def test_parameter_file_and_assignments(tmp_path):
    file = tmp_path / 'parameters.yaml'
    file.write_text('/**:\n  ros__parameters:\n    use_sim_time: true\n    readout_time: 0.03\n'
                    '    gyro_noise_density: 1e-4\n'
                    'another_node:\n  ros__parameters:\n    readout_tim: 1\n'
                    '/camera/relpose_node:\n  ros__parameters:\n    gyro_bias: [0.01, 0, 1e-3]\n')
    sensor = read_parameters(file, ['time_offset=-5e-3', 'solver=angular_5pt'])
    assert sensor.sensor.readout_time == 0.03
    assert sensor.imu.gyro_noise_density == 1e-4   # a text to YAML 1.1, a number to ROS
    assert sensor.imu.gyro_bias == (0.01, 0.0, 1e-3)
    assert sensor.sensor.time_offset == -5e-3
    assert sensor.estimator.solver == 'angular_5pt'


@pytest.mark.parametrize('text, said', [
    ('/**:\n  ros__parameters:\n    readout_tim: 0.03\n', 'did you mean readout_time'),
    ('/**:\n  ros__parameters:\n    readout_time: fast\n', 'readout_time must be'),
    ('/**:\n  ros__parameters:\n    readout_time: true\n', 'readout_time must be'),
    ('/**:\n  ros__parameters:\n    gyro_bias: [0, 1]\n', 'gyro_bias must be'),
    ('/**:\n  ros__parameters:\n    camera_matrix: [1, 2]\n', 'camera_matrix must be 9 values'),
    ('/**:\n  ros__parameters:\n    camera_matrix: [5, 1, 2, 0, 5, 2, 0, 0, 1]\n',
     'camera_matrix must be [fx 0 cx 0 fy cy 0 0 1]'),
    ('/**:\n  ros__parameters:\n    camera_matrix: [-5, 0, 2, 0, 5, 2, 0, 0, 1]\n', 'fx must be'),
    ('/**:\n  ros__parameters:\n    distortion_coefficients: [1]\n', 'belong to a camera_matrix'),
    ('/**:\n  readout_time: 0.03\n', 'ros__parameters'),
    ('other:\n  ros__parameters:\n    a: 1\n', 'has no parameters for relpose_node'),
    ('just text', 'no ROS parameter file'),
    ('a: [1', 'no YAML'),
    ('a: ' + '[' * 500 + ']' * 500, 'no YAML'),
    ('a: &a [1]\n/**: {ros__parameters: {gyro_bias: *a}}', 'YAML aliases'),
])
def test_bad_parameter_files(tmp_path, text, said):
    file = tmp_path / 'parameters.yaml'
    file.write_text(text)
    with pytest.raises(InputError, match=r'parameters\.yaml') as raised:
        read_parameters(file)
    assert said in str(raised.value)


# -- bad input, from end to end --------------------------------------------------------------


def write_bag(path: Path, *, images: int = 4, camera: RollingShutterCamera = CAMERA,
              topics: tuple[str, ...] = ('image', 'camera_info', 'imu'), spoil=None,
              encoding: str = 'mono8', size: tuple[int, int] = (120, 160)) -> Path:
    """A short bag of a camera that stands, with noise as sensors have it.

    `spoil(topic, message, index)` may damage messages.
    """
    rng = np.random.default_rng(0)
    picture = cv2.GaussianBlur(rng.integers(0, 256, size, dtype=np.uint8), (5, 5), 1.5)
    entries = []
    bag = BagWriter(path)
    for k in range(images):
        stamp = START_NS + k * 33_000_000
        image = bag.image(stamp, 'camera', picture ^ rng.integers(0, 2, size, dtype=np.uint8))
        image.encoding = encoding
        entries += [('camera_info', 'sensor_msgs/msg/CameraInfo',
                     bag.camera_info(stamp, 'camera', camera), stamp + 30_000_000, k),
                    ('image', 'sensor_msgs/msg/Image', image, stamp + 30_000_001, k)]
    for k in range(-20, images * 7 + 10):
        stamp = START_NS + k * 5_000_000
        entries.append(('imu', 'sensor_msgs/msg/Imu',
                        bag.imu(stamp, 'imu', tuple(rng.normal(0.0, 1e-3, 3)), (0.0, -9.81, 0.0)),
                        stamp + 2_000_000, k))
    with bag:
        for topic, msgtype, message, bag_time_ns, index in sorted(entries, key=lambda e: e[3]):
            if topic in topics:
                if spoil is not None:
                    spoil(topic, message, index)
                bag.write(f'/{topic}', msgtype, message, bag_time_ns)
    return path


def run(capsys, *arguments: str) -> tuple[int, str]:
    """Exit code and standard error of the command."""
    code = main(['replay', *arguments])
    return code, capsys.readouterr().err


def spoiling(topic: str, change):
    """Changes every message of a topic."""
    def spoil(name, message, index):
        if name == topic:
            change(message)
    return spoil


BAD_BAGS = {
    'no_imu': ({'topics': ('image', 'camera_info')}, 'no IMU topic'),
    'no_camera_info': ({'topics': ('image', 'imu')}, 'give camera_matrix'),
    'no_image': ({'topics': ('imu', 'camera_info')}, 'no image topic'),
    'uncalibrated': ({'spoil': spoiling('camera_info', lambda m: m.k.put(0, 0.0))},
                     'uncalibrated'),
    'distortion_model': ({'spoil': spoiling(
        'camera_info', lambda m: setattr(m, 'distortion_model', 'bananas'))}, 'bananas'),
    'encoding': ({'encoding': '32FC1'}, '32FC1'),
    'nan': ({'spoil': spoiling('imu', lambda m: setattr(
        m.angular_velocity, 'x', float('nan')))}, 'finite'),
    'size': ({'spoil': spoiling('camera_info', lambda m: setattr(m, 'width', 320))}, '320x120'),
}


@pytest.mark.parametrize('name', BAD_BAGS)
def test_bags_that_cannot_be_used(tmp_path, capsys, name):
    options, said = BAD_BAGS[name]
    bag = write_bag(tmp_path / 'bag', **options)
    code, text = run(capsys, str(bag), *SENSOR, '--no-pictures', '--out', str(tmp_path / 'out'))
    assert code == 2
    assert len(text.splitlines()) == 1 and text.startswith('rs_relpose: error: ')
    assert said in text


# Path (empty: a good bag), options, what is said; kinds of damage are the reader's tests.
BAD_USE = {
    'absent': ('nothing', SENSOR, 'there is no bag'),
    'folder': ('.', SENSOR, 'metadata.yaml'),
    'readout': ('', SENSOR[2:], 'readout_time must be given'),
    'rotation': ('', SENSOR[:2], 'quat_cam_imu_xyzw must be given'),
    'topic': ('', [*SENSOR, '--imu-topic', '/gyro'], '/imu'),
    'assignment': ('', ['--set', 'readout_time'], 'NAME=VALUE'),
    'name': ('', ['--set', 'readouttime=1'], 'did you mean readout_time'),
    'params': ('', ['--params', 'nowhere.yaml'], 'nowhere.yaml'),
    'stamps': ('', [*SENSOR, '--stamps', 'nowhere.txt'], 'nowhere.txt'),
}


@pytest.fixture(scope='module')
def good_bag(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return write_bag(tmp_path_factory.mktemp('good') / 'bag')


@pytest.mark.parametrize('name', BAD_USE)
def test_bad_use(tmp_path, capsys, good_bag, monkeypatch, name):
    path, options, said = BAD_USE[name]
    monkeypatch.chdir(tmp_path)
    code, text = run(capsys, path or str(good_bag), *options)
    assert code == 2
    assert len(text.splitlines()) == 1 and text.startswith('rs_relpose: error: ')
    assert said in text
    assert not list(tmp_path.glob('*_relpose')), 'nothing is written before the input is known'


@pytest.mark.parametrize('text, said', [
    ('12\n1.5\n', 'line 2'), ('', 'has no stamps'), ('12\n13\n', 'none of the 2 chosen stamps'),
    (HEADER, 'line 1')])
def test_bad_stamps(tmp_path, capsys, good_bag, text, said):
    file = tmp_path / 'stamps.txt'
    file.write_text(text)
    code, error = run(capsys, str(good_bag), *SENSOR, '--stamps', str(file), '--no-pictures',
                      '--out', str(tmp_path / 'out'))
    assert code == 2 and len(error.splitlines()) == 1 and said in error


@pytest.mark.parametrize('below', ['', '/below'])
@pytest.mark.parametrize('words', [
    'replay BAG SENSOR --out OUT', 'odometry BAG SENSOR --out OUT',
    'pairs BAG SENSOR --list LIST --out OUT', 'calibrate BAG --out OUT', 'unroll BAG OUT SENSOR',
    'batch replay BAG --out OUT', 'convert video VIDEO OUT'], ids=lambda words: words.split()[0])
def test_output_that_is_a_file_is_refused_before_any_work(
        words, below, tmp_path, capsys, good_bag, monkeypatch):
    def work(*_: object, **__: object) -> None:
        raise AssertionError('it works for an output that cannot be written')

    monkeypatch.setattr('rs_relpose_ros.bags.reader.Bag.messages', work)
    monkeypatch.setattr('rs_relpose_ros.bags.reader.Bag.raw_messages', work)
    monkeypatch.setattr('rs_relpose_ros.cli.batch.open_cluster', work)
    file, listed = tmp_path / 'out', tmp_path / 'list.csv'
    file.write_text('precious')
    listed.write_text('reference_stamp_ns,stamp_ns\n1,2\n')
    meant = {'BAG': [str(good_bag)], 'SENSOR': SENSOR, 'OUT': [f'{file}{below}'],
             'LIST': [str(listed)], 'VIDEO': [str(tmp_path / 'absent.mp4')]}
    assert main([one for word in words.split() for one in meant.get(word, [word])]) == 2
    error = capsys.readouterr().err
    assert error.startswith(f'rs_relpose: error: {file}') and len(error.splitlines()) == 1
    assert file.read_text() == 'precious'


def test_no_pose_is_exit_code_1(tmp_path, capsys, good_bag, monkeypatch):
    monkeypatch.chdir(tmp_path)
    assert main(['replay', str(good_bag), *SENSOR]) == 1
    shown = capsys.readouterr()
    assert shown.err == '' and '0 pairs' in shown.out
    assert 'health: unknown: there was no pair to judge by\n' in shown.out
    assert (tmp_path / 'bag_relpose' / 'relative_poses.csv').read_text() == HEADER + '\n'
    summary = json.loads((tmp_path / 'bag_relpose' / 'summary.json').read_text())
    assert summary['frames']['processed'] == 4 and summary['medians']['inliers'] is None


def test_one_bad_message_among_good_ones_is_counted(tmp_path, capsys):
    def spoil(topic, message, index):
        if topic == 'imu' and index == 9:
            message.angular_velocity.y = float('nan')
        if topic == 'image' and index == 2:
            message.data = message.data[:50]

    bag = write_bag(tmp_path / 'bag', spoil=spoil)
    assert main(['replay', str(bag), *SENSOR, '--out', str(tmp_path / 'out')]) == 1
    summary = json.loads((tmp_path / 'out' / 'summary.json').read_text())
    assert summary['invalid_messages'] == 1
    assert summary['frames']['refused'] == {'bad_image': 1}
    assert summary['frames']['processed'] == 3
    reasons = ' '.join(summary['not_used'])
    assert 'finite' in reasons and '50 bytes' in reasons


def test_the_command_itself(tmp_path):
    """As a user runs it: exit code, one line, no traceback, no progress bar in a pipe."""
    done = subprocess.run(
        [sys.executable, '-m', 'rs_relpose_ros.cli.main', 'replay', str(tmp_path / 'nothing')],
        capture_output=True, text=True, timeout=100)
    assert done.returncode == 2 and done.stdout == ''
    assert done.stderr.splitlines() == [
        f'rs_relpose: error: there is no bag at {tmp_path / "nothing"}']
