"""Replay: outputs on the bundled bag, repeatability, and bad input from end to end."""

from collections.abc import Callable
import itertools
import json
from pathlib import Path
from typing import Any

from conftest import BUNDLED_PARAMETERS, rows_of, run_command
import cv2
import numpy as np
import pytest
from rosbags.highlevel import AnyReader
from scipy.spatial.transform import Rotation, Slerp
from test_check import broken, Small, uncalibrated
from two_view_scene import direction_error

from rs_relpose_ros.bags.reader import open_bag
from rs_relpose_ros.cli.main import main
from rs_relpose_ros.config.files import read_parameters
from rs_relpose_ros.errors import InputError
from rs_relpose_ros.messages.incoming import stamp_ns
from rs_relpose_ros.offline.truth import TrueTrajectory

HEADER = (
    'reference_stamp_ns,stamp_ns,tx,ty,tz,qx,qy,qz,qw,sigma_t1,sigma_t2,sigma_rx,sigma_ry,'
    'sigma_rz,inliers,matches,model,status,baseline_m,baseline_log_sigma'
)
START_NS = 1_700_000_000_000_000_000
SENSOR = ['--set', 'readout_time=0.02', '--set', 'quat_cam_imu_xyzw=[0, 0, 0, 1]']
PARAMETERS = ['--params', str(BUNDLED_PARAMETERS)]


def replay(capsys: pytest.CaptureFixture[str], *arguments: object) -> tuple[int, str, str]:
    """Exit code, output and errors of the command."""
    code = main(['replay', *map(str, arguments)])
    return code, *capsys.readouterr()


def summary_of(folder: Path) -> Any:
    return json.loads((folder / 'summary.json').read_text())


def numbers(row: dict[str, str], names: str) -> np.ndarray:
    return np.array([float(row[name]) for name in names.split()])


# -- the bundled bag -------------------------------------------------------------------------


@pytest.fixture(scope='module')
def replayed(bundled_bag: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Outputs of a replay of the bundled bag with everything on."""
    folder = tmp_path_factory.mktemp('replay')
    run_command('replay', bundled_bag, *PARAMETERS, '--out', folder, '--bag')
    return folder


@pytest.fixture(scope='module')
def true_motion(bundled_bag: Path) -> Callable[[dict[str, str]], tuple[Rotation, np.ndarray]]:
    """Rotation and translation [m] between the two stamps of a row, by rosbags and SciPy alone."""
    poses = []
    with AnyReader([bundled_bag]) as reader:
        connections = [c for c in reader.connections if c.topic == '/ground_truth/pose']
        for connection, _, data in reader.messages(connections):
            msg = reader.deserialize(data, connection.msgtype)
            p = msg.pose.position
            q = msg.pose.orientation
            seconds = (stamp_ns(msg.header) - START_NS) / 1e9
            poses.append((seconds, p.x, p.y, p.z, q.x, q.y, q.z, q.w))
    times, *positions = np.array(poses).T[:4]
    rotations = Slerp(times, Rotation.from_quat(np.array(poses)[:, 4:]))

    def motion(row: dict[str, str]) -> tuple[Rotation, np.ndarray]:
        at = [(int(row[name]) - START_NS) / 1e9 for name in ('reference_stamp_ns', 'stamp_ns')]
        R1, R2 = rotations(at)
        moved = [np.diff(np.interp(at, times, axis))[0] for axis in positions]
        return R1.inv() * R2, R1.inv().apply(moved)

    return motion


def test_table_has_the_header_and_whole_rows(replayed):
    assert (replayed / 'relative_poses.csv').read_text().splitlines()[0] == HEADER
    rows = rows_of(replayed / 'relative_poses.csv')
    assert len(rows) >= 25
    assert (
        {'OK', 'PURE_ROTATION'}
        <= {row['status'] for row in rows}
        <= {'OK', 'PURE_ROTATION', 'LOW_PARALLAX'}
    )
    for before, after in itertools.pairwise(rows):
        assert before['stamp_ns'] == after['reference_stamp_ns']
    for row in rows:
        assert np.linalg.norm(numbers(row, 'qx qy qz qw')) == pytest.approx(1.0, abs=1e-9)
        rotation_sigmas = numbers(row, 'sigma_rx sigma_ry sigma_rz')
        assert (rotation_sigmas > 0.0).all() and (rotation_sigmas < 0.01).all()
        assert 0 < int(row['inliers']) <= int(row['matches'])
        assert row['model'] == ('uniform' if row['status'] == 'OK' else 'angular')
        if row['status'] == 'OK':
            assert np.linalg.norm(numbers(row, 'tx ty tz')) == pytest.approx(1.0, abs=1e-9)
            larger, smaller = numbers(row, 'sigma_t1 sigma_t2')
            assert larger >= smaller > 0.0
        else:  # the rotation alone: this bag has no pair without one
            assert row['tx'] == row['ty'] == row['tz'] == row['sigma_t1'] == row['sigma_t2'] == ''


def test_errors_agree_with_an_independent_calculation(replayed, true_motion):
    errors = {row['stamp_ns']: row for row in rows_of(replayed / 'errors.csv')}
    rotation_errors = []
    translation_errors = []
    for row in rows_of(replayed / 'relative_poses.csv'):
        R_true, t_true = true_motion(row)  # time_offset of this bag is 0
        written = errors[row['stamp_ns']]
        assert float(written['baseline_m']) == pytest.approx(np.linalg.norm(t_true), abs=1e-4)
        assert written['status'] == row['status']
        R = Rotation.from_quat(numbers(row, 'qx qy qz qw'))
        rotation = np.degrees((R.inv() * R_true).magnitude())
        assert float(written['rotation_error_deg']) == pytest.approx(rotation, abs=1e-4)
        if row['status'] != 'OK':
            assert written['translation_error_deg'] == ''
            assert rotation <= 0.15
            continue
        translation = direction_error(numbers(row, 'tx ty tz'), t_true)
        assert float(written['translation_error_deg']) == pytest.approx(translation, abs=0.05)
        rotation_errors.append(rotation)
        translation_errors.append(translation)
    assert np.median(rotation_errors) <= 0.15
    assert np.median(translation_errors) <= 3.0
    summary = summary_of(replayed)['errors_against_truth']
    assert summary['rotation_median_deg'] == pytest.approx(np.median(rotation_errors), abs=1e-4)
    assert summary['translation_p90_deg'] == pytest.approx(
        np.percentile(translation_errors, 90), abs=0.05
    )


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


def test_poses_between_the_middle_rows(replayed, bundled_bag, true_motion, tmp_path, capsys):
    assert (
        replay(
            capsys,
            bundled_bag,
            *PARAMETERS,
            '--set',
            'pose_row=middle',
            '--no-pictures',
            '--out',
            tmp_path,
        )[0]
        == 0
    )
    at_stamps, at_middle = (
        rows_of(folder / 'relative_poses.csv') for folder in (replayed, tmp_path)
    )
    for first, middle in zip(at_stamps, at_middle, strict=True):
        for name in ('reference_stamp_ns', 'stamp_ns'):  # half of 30 ms, 479 of 480 rows
            assert int(middle[name]) - int(first[name]) == 14_968_750
    errors = [
        direction_error(numbers(row, 'tx ty tz'), true_motion(row)[1])
        for row in at_middle
        if row['status'] == 'OK'
    ]
    assert np.median(errors) < 0.4 and np.quantile(errors, 0.9) < 0.8


def test_summary_agrees_with_the_table(replayed, bundled_bag):
    summary = summary_of(replayed)
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
        # Colours as one integer each, which compare faster than rows.
        colours = picture.astype(np.uint32) @ np.array([1, 1 << 8, 1 << 16], dtype=np.uint32)
        assert len(np.unique(colours)) > 50, f'{name} is empty'


def test_the_bag_of_the_poses_equals_the_table(replayed):
    rows = rows_of(replayed / 'relative_poses.csv')
    answered = [row for row in rows if row['status'] == 'OK']
    topics: dict[str, list] = {}
    with AnyReader([replayed / 'relpose_bag']) as reader:
        for connection, _, data in reader.messages():
            topics.setdefault(connection.topic, []).append(
                reader.deserialize(data, connection.msgtype)
            )
    assert sorted(topics) == [
        f'/relpose_node/{name}'
        for name in (
            'matches',
            'pairs',
            'reference',
            'relative_pose',
            'relative_rotation',
            'velocity',
        )
    ]
    for row, pose, matches in zip(
        answered,
        topics['/relpose_node/relative_pose'],
        topics['/relpose_node/matches'],
        strict=True,
    ):
        assert stamp_ns(pose.header) == int(row['stamp_ns'])
        assert pose.pose.pose.position.x == float(row['tx'])
        assert pose.pose.pose.orientation.w == float(row['qw'])
        assert matches.width == int(row['inliers'])
    for row, rotation, published in zip(
        rows, topics['/relpose_node/relative_rotation'], topics['/relpose_node/pairs'], strict=True
    ):
        assert rotation.orientation.w == float(row['qw'])
        np.testing.assert_allclose(
            np.sqrt(rotation.orientation_covariance[[0, 4, 8]]),
            numbers(row, 'sigma_rx sigma_ry sigma_rz'),
            rtol=1e-12,
        )
        [status] = published.status
        values = {item.key: item.value for item in status.values}
        for name in ('reference_stamp_ns', 'status', 'model', 'inliers', 'matches'):
            assert values[name] == row[name]
        assert float(values['rotation_difference_to_gyro_deg']) < 0.5
        # As in the parameter file of the bag, or as estimated at rest.
        np.testing.assert_allclose(
            np.array(values['gyro_bias_rad_s'].split(), dtype=float),
            [0.010885, -0.007021, 0.005061],
            atol=2e-3,
        )


def image_stamps(bag: Path) -> list[int]:
    with open_bag(bag) as opened:
        return [
            stamp_ns(item.message.header) for item in opened.messages([opened.find_topics().image])
        ]


def test_two_runs_are_equal_and_stamps_restrict(replayed, bundled_bag, tmp_path, capsys):
    stamps = image_stamps(bundled_bag)
    file = tmp_path / 'stamps.txt'
    out = tmp_path / 'out'

    def table(chosen: list[int]) -> Path:
        file.write_text('\n'.join(map(str, chosen)))
        code, _, error = replay(
            capsys, bundled_bag, *PARAMETERS, '--no-pictures', '--stamps', file, '--out', out
        )
        assert code == 0
        assert error == ''  # no progress bar in a pipe
        return out / 'relative_poses.csv'

    # Of the frames of the first 1.5 s the pairs are those of the whole run.
    full = (replayed / 'relative_poses.csv').read_text().splitlines()
    first = table(stamps[:45]).read_text().splitlines()
    assert 4 < len(first) < len(full) and full[: len(first)] == first
    # Every other frame only: nothing else is used.
    chosen = stamps[20:80:2]
    rows = rows_of(table(chosen))
    used = {int(row[name]) for row in rows for name in ('reference_stamp_ns', 'stamp_ns')}
    assert rows and used <= set(chosen)
    frames = summary_of(out)['frames']
    assert frames['processed'] == 30
    assert frames['not_among_stamps'] == len(stamps) - 30


def test_a_wrong_parameter_is_reported_and_is_exit_code_1(bundled_bag, tmp_path, capsys):
    """The first 1.2 s with a time offset that is 15 ms off, to earlier rows: no row's."""
    stamps = tmp_path / 'stamps.txt'
    out = tmp_path / 'out'
    stamps.write_text('\n'.join(map(str, image_stamps(bundled_bag)[:37])))
    code, shown, _ = replay(
        capsys,
        bundled_bag,
        *PARAMETERS,
        '--stamps',
        stamps,
        '--set',
        'time_offset=-0.015',
        '--out',
        out,
    )
    assert code == 1
    [line] = [line for line in shown.splitlines() if line.startswith('time_offset')]
    assert line.startswith('time_offset is wrong: ') and 'set time_offset: ' in line
    withheld = [row for row in rows_of(out / 'relative_poses.csv') if row['status'] == 'WITHHELD']
    assert len(withheld) >= 3
    assert all(row['tx'] == row['qw'] == row['sigma_rx'] == '' for row in withheld)
    summary = summary_of(out)
    assert summary['pairs']['by_status']['WITHHELD'] == len(withheld)
    assert summary['health']['state'] == 'wrong'
    [finding] = [item for item in summary['health']['findings'] if item['state'] == 'wrong']
    assert (finding['figure'], finding['told'], finding['unit']) == ('time_offset', -0.015, 's')
    assert abs(finding['seen']) < 0.01
    assert finding['sentence'] in line
    assert len(list(out.glob('*.png'))) == 4


# -- recordings of real cameras --------------------------------------------------------------


@pytest.mark.recordings
@pytest.mark.parametrize('name', ['realsense_rgb_rs', 'xiaomi_cc9_rs'])
def test_replays_of_recordings_without_the_gyro_between_frames(converted, tmp_path, name):
    """With the gyro for the rows only, the rotation between the frames comes from the images.

    Without that of the gyro directions are less certain: 4 of 28 by more than 10 deg. Without the
    exposure of the RealSense's file, with which the monitor reports a wrong gyro bias in this
    mode: a false alarm (docs/lab/benchmarks.md).
    """
    bag = converted(name)
    out = tmp_path / 'out'
    run_command(
        'replay',
        bag,
        '--params',
        f'{bag}.yaml',
        '--set',
        'use_gyro_rotation=false',
        '--set',
        'max_translation_sigma=30',
        '--set',
        'exposure_margin=0.0',
        '--out',
        out,
    )
    summary = summary_of(out)
    assert summary['frames']['processed'] == summary['frames']['in_bag']
    assert summary['pairs']['total'] >= 5
    assert summary['pairs']['answered'] >= 0.9 * summary['pairs']['total']
    assert summary['medians']['rotation_difference_to_gyro_deg'] <= 0.5
    assert summary['errors_against_truth'] is None and not (out / 'errors.csv').exists()
    assert {path.name for path in out.glob('*.png')} == {
        'matches.png',
        'residuals.png',
        'rotation.png',
    }


# -- truth -----------------------------------------------------------------------------------


def test_truth_of_a_known_motion():
    """A camera on a circle of radius 2 m that turns with it, w = 0.5 rad/s about its y axis."""
    stamps = START_NS + 10_000_000 * np.arange(101)
    angles = 0.5 * np.arange(101) / 100.0
    positions = 2.0 * np.stack([np.sin(angles), 0.0 * angles, np.cos(angles)], axis=1)
    quats = Rotation.from_rotvec(np.outer(angles, [0.0, 1.0, 0.0])).as_quat()
    truth = TrueTrajectory(stamps[::-1], positions[::-1], quats[::-1])
    ns1, ns2 = START_NS + 123_456_789, START_NS + 623_456_789  # half a second: 0.25 rad
    R, t = truth.relative_pose(ns1, ns2)
    np.testing.assert_allclose(R, Rotation.from_rotvec([0.0, 0.25, 0.0]).as_matrix(), atol=1e-9)
    np.testing.assert_allclose(t, [2.0 * np.sin(0.25), 0.0, 2.0 * (np.cos(0.25) - 1.0)], atol=1e-8)
    off = Rotation.from_rotvec([np.radians(3.0), 0.0, 0.0]).as_matrix()
    errors = truth.errors(
        R @ off, Rotation.from_rotvec([0.0, 0.0, 0.1]).apply([t[0], 0.0, 0.0]), ns1, ns2
    )
    assert errors.rotation_error == pytest.approx(3.0, abs=1e-9)
    assert errors.baseline == pytest.approx(4.0 * np.sin(0.125), abs=1e-8)  # the chord
    aside = np.array([np.cos(0.1), np.sin(0.1), 0.0])
    assert errors.translation_error == pytest.approx(
        np.degrees(np.arccos(aside @ t / np.linalg.norm(t))), abs=1e-9
    )
    assert truth.relative_pose(ns1, START_NS + 1_000_000_001) is None
    assert truth.relative_pose(START_NS - 1, ns2) is None
    assert truth.covers(START_NS) and truth.covers(START_NS + 10**9)


def test_truth_is_not_interpolated_across_a_hole():
    stamps = START_NS + 10_000_000 * np.array([0, 1, 2, 3, 60, 61, 62])
    truth = TrueTrajectory(stamps, np.zeros((7, 3)), np.tile([0.0, 0.0, 0.0, 1.0], (7, 1)))
    assert truth.covers(START_NS + 15_000_000)
    assert not truth.covers(START_NS + 300_000_000)


@pytest.mark.parametrize(
    'count, quat',
    [(3, (0, 0, 0, 1)), (9, (0, 0, 0, 0)), (9, (0, 0, 0, np.nan)), (9, (0, 0, 0, 1e200))],
)
def test_unusable_truth_is_refused(count, quat):
    with pytest.raises(InputError):
        TrueTrajectory(
            START_NS + np.arange(count),
            np.zeros((count, 3)),
            np.tile(np.array(quat, dtype=float), (count, 1)),
        )


# -- parameter files -------------------------------------------------------------------------


def test_parameter_file_and_assignments(tmp_path):
    file = tmp_path / 'parameters.yaml'
    file.write_text(
        '/**:\n  ros__parameters:\n    use_sim_time: true\n    readout_time: 0.03\n'
        '    gyro_noise_density: 1e-4\n'
        'another_node:\n  ros__parameters:\n    readout_tim: 1\n'
        '/camera/relpose_node:\n  ros__parameters:\n    gyro_bias: [0.01, 0, 1e-3]\n'
    )
    sensor = read_parameters(file, ['time_offset=-5e-3', 'solver=angular_5pt'])
    assert sensor.sensor.readout_time == 0.03
    assert sensor.imu.gyro_noise_density == 1e-4  # a text to YAML 1.1, a number to ROS
    assert sensor.imu.gyro_bias == (0.01, 0.0, 1e-3)
    assert sensor.sensor.time_offset == -5e-3
    assert sensor.estimator.solver == 'angular_5pt'


@pytest.mark.parametrize(
    'text, words',
    [
        ('/**:\n  ros__parameters:\n    readout_tim: 0.03\n', 'did you mean readout_time'),
        ('/**:\n  ros__parameters:\n    readout_time: fast\n', 'readout_time must be'),
        ('/**:\n  ros__parameters:\n    gyro_bias: [0, 1]\n', 'gyro_bias must be'),
        (
            '/**:\n  ros__parameters:\n    camera_matrix: [1, 2]\n',
            'camera_matrix must be 9 values',
        ),
        (
            '/**:\n  ros__parameters:\n    camera_matrix: [5, 1, 2, 0, 5, 2, 0, 0, 1]\n',
            'camera_matrix must be [fx 0 cx 0 fy cy 0 0 1]',
        ),
        (
            '/**:\n  ros__parameters:\n    distortion_coefficients: [1]\n',
            'belong to a camera_matrix',
        ),
        (
            '/**:\n  ros__parameters:\n    readout_time: 0.03\n    readout_time_sigma: -0.001\n',
            'readout_time_sigma must be in [0, 1] s',
        ),
        (
            (
                '/**: {ros__parameters: '
                '{time_offset: 0.03, readout_time: 0.03, readout_time_sigma: 0.001}}'
            ),
            'time_offset is given without time_offset_sigma',
        ),
        ('/**:\n  readout_time: 0.03\n', 'ros__parameters'),
        ('other:\n  ros__parameters:\n    a: 1\n', 'has no parameters of relpose_node'),
        ('just text', 'is not a ROS parameter file'),
        ('a: ' + '[' * 500 + ']' * 500, 'is not valid YAML'),
        ('a: [1,\n2', 'is not valid YAML: line 2, column 2: expected'),
        ('a: &a [1]\n/**: {ros__parameters: {gyro_bias: *a}}', 'YAML aliases'),
    ],
)
def test_bad_parameter_files(tmp_path, text, words):
    file = tmp_path / 'parameters.yaml'
    file.write_text(text)
    with pytest.raises(InputError, match=r'parameters\.yaml') as raised:
        read_parameters(file)
    assert words in str(raised.value)


# -- bad input, from end to end --------------------------------------------------------------


def changed(part: str, change: Callable[[Any], object]) -> dict[str, Any]:
    """Changes every message of a part of a small bag."""

    def made(self: Small, stamp: int) -> Any:
        message = getattr(Small, part)(self, stamp)
        change(message)
        return message

    return {part: made}


@pytest.mark.parametrize(
    'changes, words',
    [
        ({'info_topic': ''}, 'give camera_matrix'),
        ({'info': uncalibrated}, 'uncalibrated'),
        (changed('info', lambda m: setattr(m, 'distortion_model', 'bananas')), 'bananas'),
        (changed('image', lambda m: setattr(m, 'encoding', '32FC1')), '32FC1'),
        (changed('imu', lambda m: setattr(m.angular_velocity, 'x', float('nan'))), 'finite'),
        (changed('info', lambda m: setattr(m, 'width', 320)), '320x120'),
    ],
)
def test_bags_that_cannot_be_used(tmp_path, refused, changes, words):
    bag = broken(seconds=0.4, **changes).write(tmp_path / 'bag')
    refused(words, 'replay', bag, *SENSOR, '--no-pictures', '--out', tmp_path / 'out')


@pytest.fixture(scope='module')
def good_bag(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return broken(seconds=0.4).write(tmp_path_factory.mktemp('good') / 'bag')


# Path (empty: a good bag), options, words; kinds of damage are the reader's tests.
@pytest.mark.parametrize(
    'path, options, words',
    [
        ('nothing', SENSOR, 'there is no bag'),
        ('.', SENSOR, 'metadata.yaml'),
        ('', SENSOR[2:], 'readout_time must be given'),
        ('', SENSOR[:2], 'quat_cam_imu_xyzw must be given'),
        ('', ['--set', 'readout_time'], 'NAME=VALUE'),
        ('', ['--set', 'readouttime=1'], 'did you mean readout_time'),
        ('', ['--params', 'nowhere.yaml'], 'nowhere.yaml'),
        ('', [*SENSOR, '--stamps', 'nowhere.txt'], 'nowhere.txt'),
    ],
)
def test_bad_use_is_refused_before_anything_is_written(
    tmp_path, refused, good_bag, monkeypatch, path, options, words
):
    monkeypatch.chdir(tmp_path)
    refused(words, 'replay', path or good_bag, *options)
    assert not list(tmp_path.glob('*_relpose')), 'nothing is written before the input is known'


@pytest.mark.parametrize(
    'text, words',
    [
        ('12\n1.5\n', 'line 2'),
        ('', 'has no stamps'),
        ('12\n13\n', 'none of the 2 chosen stamps'),
        (HEADER, 'line 1'),
    ],
)
def test_a_file_without_stamps_is_refused_with_its_line(tmp_path, refused, good_bag, text, words):
    file = tmp_path / 'stamps.txt'
    file.write_text(text)
    refused(
        words,
        'replay',
        good_bag,
        *SENSOR,
        '--stamps',
        file,
        '--no-pictures',
        '--out',
        tmp_path / 'out',
    )


@pytest.mark.parametrize('below', ['', '/below'])
@pytest.mark.parametrize(
    'words',
    [
        'replay BAG SENSOR --out OUT',
        'odometry BAG SENSOR --out OUT',
        'pairs BAG SENSOR --list LIST --out OUT',
        'calibrate BAG --out OUT',
        'unroll BAG OUT SENSOR',
        'batch replay BAG --out OUT',
        'convert video VIDEO OUT',
    ],
    ids=lambda words: words.split()[0],
)
def test_output_that_is_a_file_is_refused_before_any_work(
    words, below, tmp_path, refused, good_bag, monkeypatch
):
    def work(*_: object, **__: object) -> None:
        raise AssertionError('it works for an output that cannot be written')

    monkeypatch.setattr('rs_relpose_ros.bags.reader.Bag.messages', work)
    monkeypatch.setattr('rs_relpose_ros.bags.reader.Bag.raw_messages', work)
    monkeypatch.setattr('rs_relpose_ros.cli.batch.open_cluster', work)
    file = tmp_path / 'out'
    listed = tmp_path / 'list.csv'
    file.write_text('precious')
    listed.write_text('reference_stamp_ns,stamp_ns\n1,2\n')
    meant = {
        'BAG': [str(good_bag)],
        'SENSOR': SENSOR,
        'OUT': [f'{file}{below}'],
        'LIST': [str(listed)],
        'VIDEO': [str(tmp_path / 'absent.mp4')],
    }
    refused(
        f'rs_relpose: error: {file}',
        *(one for word in words.split() for one in meant.get(word, [word])),
    )
    assert file.read_text() == 'precious'


def test_no_pose_is_exit_code_1(tmp_path, capsys, good_bag, monkeypatch):
    monkeypatch.chdir(tmp_path)
    code, shown, error = replay(capsys, good_bag, *SENSOR)
    assert (code, error) == (1, '')
    assert '0 pairs' in shown
    assert 'health: unknown: there was no pair to evaluate\n' in shown
    assert (tmp_path / 'bag_relpose' / 'relative_poses.csv').read_text() == HEADER + '\n'
    summary = summary_of(tmp_path / 'bag_relpose')
    assert summary['frames']['processed'] == 4 and summary['medians']['inliers'] is None


def test_one_bad_message_among_good_ones_is_counted(tmp_path, capsys):
    small = broken(seconds=0.4)
    messages = small.messages()
    samples, images = (
        [message for topic, _, message, _ in messages if topic == name]
        for name in (small.imu_topic, small.image_topic)
    )
    samples[29].angular_velocity.y = float('nan')
    images[2].data = images[2].data[:50]
    small.messages = lambda: messages
    bag = small.write(tmp_path / 'bag')
    assert replay(capsys, bag, *SENSOR, '--out', tmp_path / 'out')[0] == 1
    summary = summary_of(tmp_path / 'out')
    assert summary['invalid_messages'] == 1
    assert summary['frames']['refused'] == {'bad_image': 1}
    assert summary['frames']['processed'] == 3
    reasons = ' '.join(summary['not_used'])
    assert 'finite' in reasons and '50 bytes' in reasons
