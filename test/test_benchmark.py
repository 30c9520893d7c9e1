"""The benchmarks: a smoke run each, the comparison of the demo, wrong configurations."""

import csv
from dataclasses import replace
import re
import subprocess
import sys

from conftest import BUNDLED_PARAMETERS, ROOT, rows_of, run_command
import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from rs_relpose_lab.experiments import (
    accuracy,
    comparison,
    methods,
    speed,
    suggestions,
    true_pairs,
    trust,
    trust_rows,
    trust_runs,
)
from rs_relpose_lab.experiments import consistency as pair_errors
from rs_relpose_lab.experiments.harness import grouped
from rs_relpose_lab.experiments.methods import METHODS
from rs_relpose_lab.experiments.problems import Cell, CELLS, make_problem
from rs_relpose_lab.experiments.trust_rows import PLACES, RIGHT, ROWS
from rs_relpose_lab.experiments.trust_runs import TrackNoise
from rs_relpose_ros.bags.reader import open_bag
from rs_relpose_ros.calibration.findings import Code
from rs_relpose_ros.cli.main import main
from rs_relpose_ros.config.files import read_parameters
from rs_relpose_ros.errors import InputError, MissingInputError
from rs_relpose_ros.estimator.result import RelativePose, Status
from rs_relpose_ros.geometry.camera import RollingShutterCamera
from rs_relpose_ros.offline.replay import read_truth
from rs_relpose_ros.offline.tables import POSES

STILL = Cell(
    speed=0.0, rate=0.0, pixel_noise=1e-2, gravity_noise=1e-3, gyro_noise=1e-3, outliers=0.2
)


def test_accuracy_command(tmp_path, capsys, monkeypatch):
    """Two problems with right and double sigmas; a second run uses the kept oracle."""
    command = [
        'benchmark',
        'accuracy',
        '--trials',
        '2',
        '--cells',
        'sideways-outliers-50',
        '--noise',
        'gaussian',
        '--sigma-factor',
        '1',
        '2',
        '--output',
        str(tmp_path),
    ]
    run_command(*command)
    report = (tmp_path / 'accuracy.md').read_text()
    assert report in capsys.readouterr().out
    assert report.count('| sideways-outliers-50 |') == 2
    rows = rows_of(tmp_path / 'trials.csv')
    assert {(row['seed'], row['sigma_factor']) for row in rows} == {
        (seed, factor) for seed in '01' for factor in ('1.0', '2.0')
    }
    assert all(float(row['error_rotation']) < 0.5 for row in rows)
    monkeypatch.setattr(accuracy, 'oracle_estimate', lambda *args: pytest.fail('it runs again'))
    run_command(*command)
    assert [{**row, 'duration': ''} for row in rows_of(tmp_path / 'trials.csv')] == [
        {**row, 'duration': ''} for row in rows
    ]


@pytest.mark.parametrize(
    ('arguments', 'message'),
    [
        (['accuracy', '--cells', 'nowhere'], "no cell is named 'nowhere'"),
        (['speed', '--matches', '10'], '--matches must be at least 50'),
        (['consistency', '--exposure', '300'], 'exposure_time must be in [0, 0.2] s, got 0.3'),
        (['trust', '--rows', 'nonsense'], 'no cell is named'),
        (['trust', '--bags', '0'], 'nothing to measure'),
        (['live', '--duration', '1'], '--duration must be at least 5'),
        (['live', '--every', '0'], '--every must be at least 1'),
        (['live', '--against', '.', '--every', '2'], 'without --soak, --every and --neighbours'),
    ],
)
def test_bad_input_is_one_line(arguments, message, capsys, tmp_path):
    assert main(['benchmark', *arguments, '--output', str(tmp_path)]) == 2
    assert message in capsys.readouterr().err


def test_without_the_laboratory_its_commands_name_it(monkeypatch, capsys):
    monkeypatch.setattr('importlib.util.find_spec', lambda name: None)
    assert main(['benchmark', 'speed']) == 2
    error = capsys.readouterr().err
    assert 'benchmark needs the package rs_relpose_lab' in error and error.count('\n') == 1


@pytest.mark.parametrize('name', [name for name, m in METHODS.items() if not m.continuous_gyro])
def test_every_method_answers_in_our_convention(name):
    # A camera at rest in each frame: a global shutter, on which all of them are right. Derotated
    # points make a rotating camera one.
    derotates = name.endswith('_derotated')
    for cell in (STILL, replace(STILL, rate=3.0))[: 1 + derotates]:
        pair = methods.as_pair(make_problem(cell, 1), cell)
        status, error = methods.run_method(name, pair, 1)
        assert status.value == 'OK'
        assert error.rotation < 0.1
        assert error.translation < 0.5
    if derotates:
        assert methods.run_method(name.removesuffix('_derotated'), pair, 1)[1].rotation > 1.0


@pytest.mark.parametrize('seed', [60, 88, 89])
def test_gravity_off_by_a_degree_does_not_end_the_search(seed):
    # Angular hypotheses from gravity are consistent with half of these matches, wrongly.
    cell = CELLS['sideways-gravity-1']
    problem = make_problem(cell, seed, 'gaussian')
    pair = methods.as_pair(problem, cell)
    pose = methods.prepared(METHODS['auto'], pair, seed)()
    assert pair.error(pose).rotation < 0.3
    assert pose.inliers[~problem.is_outlier].mean() > 0.95


def test_speed_and_its_report(tmp_path):
    timings = speed.compare('forward-base', 100, trials=1)
    assert [timing.method for timing in timings] == list(speed.COMPARED)
    assert all(timing.matches == 100 and timing.duration > 0.0 for timing in timings)
    report = speed.write_report(tmp_path, timings, timings)
    for found in speed.method_statistics(timings):
        assert re.search(
            rf'^\| {found.method} +\| +{found.time.text(2)} .*\| '
            rf'+{found.rotation.text(3)} \|',
            report,
            re.MULTILINE,
        )


@pytest.mark.parametrize('claimed', [1.0, 0.5])
def test_nees_of_errors_drawn_from_a_covariance(claimed):
    """NEES by freedom is 1 where the covariance is right, 4 where its sigmas are half of it."""
    rng = np.random.default_rng(0)
    t = np.array([0.6, 0.0, 0.8])
    across = np.eye(3) - np.outer(t, t)
    root = 0.01 * rng.normal(size=(6, 6))
    root[:3] = across @ root[:3]
    sigma, R_sigma = 0.02, 0.01  # of the truth
    found = []
    for _ in range(2000):
        error = root @ rng.normal(size=6)
        true_t = t + error[:3] + sigma * across @ rng.normal(size=3)
        pose = RelativePose(Status.OK, R=np.eye(3), t=t, covariance=claimed**2 * root @ root.T)
        turned = Rotation.from_rotvec(error[3:] + R_sigma * rng.normal(size=3)).as_matrix()
        found.append(
            pair_errors.pair_consistency(
                '',
                '',
                true_pairs.TruePair(
                    0,
                    1,
                    turned,
                    true_t,
                    true_pairs.isotropic(claimed * sigma, claimed * R_sigma),
                ),
                pose,
            )
        )
    assert np.mean([p.rotation_nees for p in found]) == pytest.approx(claimed**-2, rel=0.07)
    assert np.mean([p.translation_nees for p in found]) == pytest.approx(claimed**-2, rel=0.07)


def test_chosen_pairs_of_a_recording_and_of_its_table(bundled_bag, tmp_path):
    """At frames where the policy has no keyframes; the second overlaps both others."""
    stamps = pair_errors.image_stamps(bundled_bag)
    parameters = read_parameters(BUNDLED_PARAMETERS)
    ends = [(stamps[first], stamps[last]) for first, last in ((60, 71), (65, 76), (71, 90))]
    (first, _), (last, _) = pair_errors.chosen_pairs(bundled_bag, parameters, ends[::2])
    assert [(pair.reference_stamp_ns, pair.stamp_ns) for pair in (first, last)] == ends[::2]
    # By the pairs of the policy before.
    assert any(finding.observable for finding in first.health.findings)
    with open_bag(bundled_bag) as bag:
        truth = read_truth(bag, bag.find_topics())
    delay_ns = first.reference_ns1 - first.reference_stamp_ns
    table = tmp_path / 'pairs.csv'
    with table.open('w', newline='', encoding='utf-8') as file:
        writer = csv.writer(file)
        writer.writerow(
            [
                'stamp1_ns',
                'stamp2_ns',
                *(f'r{i}{j}' for i in (1, 2, 3) for j in (1, 2, 3)),
                'tx',
                'ty',
                'tz',
                'sigma_t_deg',
                'sigma_r_deg',
            ]
        )
        # The first is of a frame that is not there: asked for, and not answered.
        for start, end in ((stamps[90] - 1, stamps[95]), *reversed(ends)):
            R, t = truth.relative_pose(start + delay_ns, end + delay_ns)
            writer.writerow([start, end, *R.ravel(), *t / np.linalg.norm(t), 1.0, 0.1])
    # The first is that of the largest axis, the second the root of the sum over three.
    sigmas = np.radians(np.repeat([1.0, 0.1 / np.sqrt(3.0)], 3))
    for pair in true_pairs.read_true_pairs(table):
        np.testing.assert_allclose(pair.covariance, np.diag(sigmas**2))
    run_command(
        'benchmark',
        'consistency',
        '--bags',
        '0',
        '--recording',
        bundled_bag,
        BUNDLED_PARAMETERS,
        table,
        '--compare',
        '--output',
        tmp_path,
    )
    report = (tmp_path / 'consistency.md').read_text()
    for method in ('recordings', 'readout ignored', 'MAGSAC'):
        assert re.search(rf'^\| {method} +\| +3 of 4 \|', report, re.MULTILINE)
    assert 'nan' not in report
    found = grouped(
        [row for row in rows_of(tmp_path / 'consistency.csv') if row['rotation']],
        lambda row: row['source'],
    )
    for rows in found.values():
        assert {(int(row['stamp1_ns']), int(row['stamp2_ns'])) for row in rows} == set(ends)
    for row in found['recordings']:
        assert float(row['rotation']) < 0.1 and float(row['translation']) < 2.0
        assert float(row['rotation_nees']) < 5.0 and float(row['translation_nees']) < 5.0
    assert all(not row['rotation_nees'] for row in found['MAGSAC'])  # has no covariance
    # The readout of 30 ms, ignored.
    for method in ('readout ignored', 'MAGSAC'):
        assert min(float(row['rotation']) for row in found[method]) > 0.1
    table.write_text('stamp,x\n1,2\n', encoding='utf-8')
    with pytest.raises(InputError, match='is no table of true pairs'):
        list(pair_errors.on_recording(bundled_bag, BUNDLED_PARAMETERS, table))


@pytest.mark.long
def test_suggested_values_of_wrong_parameters(bundled_bag, tmp_path, monkeypatch):
    """Its file is right: a focal length that the CameraInfo does not have is named."""
    monkeypatch.setattr(suggestions, 'ROWS', {'focal x1.05': suggestions.ROWS['focal x1.05']})
    run_command(
        'benchmark',
        'suggestions',
        '--recording',
        bundled_bag,
        BUNDLED_PARAMETERS,
        '--output',
        tmp_path,
    )
    right, wrong = rows_of(tmp_path / 'suggestions.csv')
    assert right['others'] == '' and right['estimated'] == ''
    assert float(wrong['size']) > 6.0
    assert float(wrong['estimated']) == pytest.approx(float(wrong['right']), rel=0.01)
    report = (tmp_path / 'suggestions.md').read_text()
    assert re.search(r'^\| right +\| +ok \|$', report, re.MULTILINE)
    assert '1 of 1 errors of over 6 sigmas named' in report


def _write_path(folder, stamps, truth, delay_ns):
    """Write a true path of frames, with covariances of those 1 to 10 apart; return its file."""
    first = stamps[0]
    rows = []
    for stamp in stamps:
        known = truth.relative_pose(first + delay_ns, stamp + delay_ns)
        R, t = (np.eye(3), np.zeros(3)) if stamp == first else known
        rows.append([stamp, *t, *Rotation.from_matrix(R).as_quat()])
    table = folder / 'global_truth.csv'
    with table.open('w', newline='', encoding='utf-8') as file:
        writer = csv.writer(file)
        writer.writerow(['stamp_ns', 'x', 'y', 'z', 'qx', 'qy', 'qz', 'qw'])
        writer.writerows(rows)
    covariance = true_pairs.isotropic(0.01, 1e-3)
    covariance[0, 5] = covariance[5, 0] = 1e-6
    triangle = covariance[np.triu_indices(6)]
    ends = np.array(
        [
            (first, last)
            for k in range(1, 11)
            for first, last in zip(stamps, stamps[k:], strict=False)
        ]
    )
    np.savez(
        folder / 'global_truth_cov.npz',
        s1=ends[:, 0],
        s2=ends[:, 1],
        C=np.tile(triangle, (len(ends), 1)),
    )
    return table, covariance


def test_a_true_path_is_that_of_the_pairs_of_the_policy(bundled_bag, tmp_path):
    """Calibrated on the first half of the bundled bag, scored on the second."""
    stamps = pair_errors.image_stamps(bundled_bag)
    with open_bag(bundled_bag) as bag:
        truth = read_truth(bag, bag.find_topics())
    parameters = read_parameters(BUNDLED_PARAMETERS)
    offset_ns = round(1e9 * parameters.sensor.time_offset)
    table, covariance = _write_path(tmp_path, stamps[2:-2], truth, offset_ns)
    known = true_pairs.read_truth(tmp_path)
    pair = known.pair(stamps[20], stamps[25])
    R, t = truth.relative_pose(stamps[20] + offset_ns, stamps[25] + offset_ns)
    np.testing.assert_allclose(pair.R, R, atol=1e-6)
    np.testing.assert_allclose(pair.t, t, atol=1e-6)
    np.testing.assert_allclose(pair.covariance, covariance)
    assert known.pair(stamps[20], stamps[31]).covariance is None
    assert known.pair(stamps[0], stamps[5]) is None
    (tmp_path / 'pseudo_truth.csv').write_text('never read')
    arguments = ['--scored', str(bundled_bag), str(tmp_path), '--lens-known']
    run_command('benchmark', 'carried-over', *arguments, '--output', tmp_path)
    rows = rows_of(tmp_path / 'consistency.csv')
    assert len(rows) >= 4
    assert {row['source'] for row in rows} == {'calibrated on its first half'}
    assert min(int(row['stamp1_ns']) for row in rows) >= stamps[len(stamps) // 2]
    # The readout of 30 ms is known by the first half.
    rotations = [float(row['rotation']) for row in rows if row['rotation']]
    assert len(rotations) >= 3 and np.median(rotations) < 0.05
    assert any(row['translation_nees'] for row in rows)
    table.with_name('global_truth_cov.npz').unlink()
    with pytest.raises(MissingInputError, match='has the covariances of'):
        true_pairs.read_truth(table)


def test_differing_poses_are_found(tmp_path):
    row = '{},0.6,0.8,0,0,0,0,1,0.1,0.1,0.1,0.1,0.1,50,{},{},OK'
    first, second = (row.format(ends, 60, 'uniform') for ends in ('1,2', '2,3'))
    live = [row.format('1,2', '', ''), row.format('2,3', '', '')]
    for rows, found in (
        ((first, second, '3,4' + ',' * 14 + '9,,BAD_INPUT'), (0, 2)),
        ((first.replace('0.6,', '0.6000000000000001,'), second), (1, 2)),
        (live[:1], (1, 2)),
    ):
        paths = []
        for name, lines in (('live.csv', live), ('replay.csv', rows)):
            paths.append(tmp_path / name)
            paths[-1].write_text('\n'.join([','.join(POSES.columns), *lines]) + '\n')
        assert comparison.differing_poses(*paths) == found


@pytest.mark.long
@pytest.mark.timeout(300)
def test_the_demo_prints_its_table_and_draws_its_pictures():
    """The demo itself: three processes over DDS, replays, and the table."""
    done = subprocess.run(
        [sys.executable, ROOT / 'demo' / 'run_demo.py'],
        capture_output=True,
        text=True,
        timeout=290,
    )
    assert done.returncode == 0, done.stderr
    rows = {
        name: re.search(rf'^{name}\s+(\d+)\s+(\d+)\s+(\S+)\s+\S+\s+(\S+)', done.stdout, re.M)
        for name in (
            'relpose_node, live',
            'uniform 9-point',
            'uniform 11-point',
            '5-point on derotated rays',
            r'OpenCV 5-point, RANSAC, \S+ px',
            r'OpenCV 5-point, USAC_MAGSAC, \S+ px',
        )
    }
    assert all(rows.values()), done.stdout
    pairs, poses, rotation, translation = rows['relpose_node, live'].groups()
    assert int(pairs) >= 25 and int(poses) >= 20
    assert float(rotation) <= 0.15 and float(translation) <= 3.0
    for name in list(rows)[-2:]:
        assert float(rows[name][3]) >= 3.0 * float(rotation)
    assert 'bit-equal' in done.stdout
    for picture in re.findall(r'\S+\.png', done.stdout):
        assert (ROOT / picture).is_file()


# -- the matrix of wrong configurations: tracks, rows, information --------------------------------

SHAPE = (480, 640)


@pytest.fixture(scope='module')
def plan():
    return trust.plans(2, 0.4, 7)[0]


@pytest.fixture(scope='module')
def simulation(plan):
    return trust.simulation_of(plan)


@pytest.fixture(scope='module')
def recording(plan):
    return trust.recording_of(plan)


def test_tracks_are_where_the_renderer_shows_the_points_with_errors_since_the_reference(
    simulation,
):
    known = trust_runs.sightings(
        simulation, TrackNoise(white=0.2, slip=0.0, wrong=0.0), np.random.default_rng(1)
    )
    tracker = trust_runs.SimulatedTracker(known, lambda points: points, 300)
    tracker.start(trust_runs.numbered_image(0, SHAPE))
    for first in (0, 3, 6):
        for frame in range(first + 1, first + 4):
            matches = tracker.track(trust_runs.numbered_image(frame, SHAPE))
        assert 100 < len(matches) <= 300
        assert np.abs(matches.points2 - matches.points1).max() > 5.0
        true = simulation.true_matches(first, first + 3, matches.points1)
        shown = np.isfinite(true).all(axis=1)  # a corner's error may move it off its surface
        # Errors from before the reference would enlarge the later ones.
        assert 1.4826 * np.median(np.abs((matches.points2 - true)[shown])) == pytest.approx(
            0.2, rel=0.2
        )
        tracker.promote()


# -- rows --------------------------------------------------------------------------------------


@pytest.mark.parametrize('name', [name for name in ROWS if name != RIGHT])
def test_a_row_changes_something(name, recording):
    right = recording.configured
    samples = list(recording.samples)
    configured = ROWS[name].wrong(right, np.random.default_rng(0))
    # Some rows change the stamps from the fifth second on.
    last = replace(samples[-1], stamp_ns=samples[0].stamp_ns + 6_000_000_000)
    samples.append(last)
    assert (
        configured.values != right.values
        or configured.intrinsics != right.intrinsics
        or [configured.sample(one) for one in samples] != samples
        or configured.geometry is not trust_rows.AS_IT_IS
    )


# -- information: the oracle of what the motion of a recording determines ------------------------

TRUE_CAMERA = RollingShutterCamera(
    width=640, height=480, fx=450.0, fy=450.0, cx=319.5, cy=239.5, readout_time=0.02
)
PAN = (0.0, 0.1, 0.0)
STEADY = ((0.0, 0.5, 0.0), (0.0, 0.5, 0.0))
CHANGING = ((0.0, 0.2, 0.0), (0.0, 0.8, 0.0))


def information_of(rotvec, rate1=(0.0, 0.0, 0.0), rate2=(0.0, 0.0, 0.0)):
    """Of a pair without noise, with rows as at rest."""
    rng = np.random.default_rng(0)
    R = Rotation.from_rotvec(rotvec).as_matrix()
    t = np.array([1.0, 0.0, 0.0])
    points = rng.uniform((-1.5, -1.2, 3.0), (1.5, 1.2, 9.0), (120, 3))
    pixels = [
        450.0 * local[:, :2] / local[:, 2:] + (319.5, 239.5)
        for local in (points, (points - t) @ R)
    ]
    rates = [np.tile(rate, (120, 1)) for rate in (rate1, rate2)]
    return trust_rows.pair_information(
        trust_rows.TruePair(
            *pixels, R, t, 0.2, *rates, np.array(rate1), np.array(rate2), 0.2, 2e-4
        ),
        TRUE_CAMERA,
    )[0]


def sigma_of(quantity, *motion):
    place = PLACES[quantity]
    return 1.0 / np.sqrt(np.maximum(np.diag(information_of(*motion)[place, place]), 1e-30))


def test_without_rotation_there_is_no_information_on_axes_scale_and_offset():
    quantities = information_of((0.0, 0.0, 0.0))
    scale = quantities[PLACES['gyro_bias'], PLACES['gyro_bias']].max()
    for quantity in ('axes', 'gyro_scale', 'time_offset'):
        assert np.abs(quantities[PLACES[quantity]]).max() < 1e-6 * scale


@pytest.mark.parametrize(
    ('quantity', 'axis', 'rates', 'low', 'high'),
    [
        # The images alone determine a rotation of 0.1 rad to some 2 mrad: not about its own axis.
        ('axes', 0, (), 0.0, 0.05),
        ('axes', 1, (), 1.0, np.inf),
        ('axes', 2, (), 0.0, 0.05),
        ('gyro_scale', 0, (), 0.0, 0.05),
        # An offset shows by a rate that changes: 0.6 rad/s more, to some 2 mrad.
        ('time_offset', 0, STEADY, 0.05, np.inf),
        ('time_offset', 0, CHANGING, 1e-3, 1e-2),
    ],
)
def test_information_of_a_rotation(quantity, axis, rates, low, high):
    assert low <= sigma_of(quantity, PAN, *rates)[axis] < high


# -- results of a bag ----------------------------------------------------------------------------


@pytest.mark.recordings
def test_a_phone_that_rotates_on_the_spot_has_no_finding(converted):
    """Also with 18 px too much of the focal length.

    One pair has too little parallax, and one differs from the gyro before eight have agreed.
    """
    name = 'android_phone_rs'
    bag = converted(name, 'android')
    right = (ROOT / 'rs_relpose_lab' / 'recordings' / f'{name}.yaml').read_text()
    # Its lens has distortion (docs/lab/calibration.md), which would be named otherwise.
    lens = '    distortion_coefficients: [0.122, -0.298, 0.0, 0.0, 0.215]\n'
    bag.with_suffix('.yaml').write_text(right.replace('482.0', '500.0') + lens)
    recording = trust_runs.recording_at(bag)
    pairs = [pair for pair, _ in trust_runs.run(recording, recording.configured, 4.5)]
    assert [pair.stamp_ns // 10**8 % 10**4 for pair in pairs if not pair.pose] == [4353, 4369]
    assert not [pair.health.faults for pair in pairs if pair.health.faults]


def test_a_missing_lens_is_named_although_a_little_more_of_it_would_not_move_the_pose():
    """Its poses are off by some degrees; linearised at the estimate, they move by ten sigmas."""
    recording = trust.recording_of(trust.BagPlan(2, 64003, 3.0, 0.0186))
    configured = ROWS['no-distortion'].wrong(recording.configured, np.random.default_rng(0))
    pairs = [
        trust_runs.evaluated(recording, *result)
        for result in trust_runs.run(recording, configured, 1.6)
    ]
    assert {pair.named for pair in pairs if pair.at > 1.0} == {('distortion',)}
    # Poses are uncertain at first, then suppressed, from the pair after the first certain one on.
    believed = [pair for pair in pairs if pair.has_pose]
    assert all(pair.at < 0.45 and pair.direction_error < pair.direction_sigma for pair in believed)


def test_command_distinguishes_wrong_from_right(tmp_path):
    run_command(
        'benchmark',
        'trust',
        '--bags',
        '1',
        '--rows',
        RIGHT,
        'imu-cycled',
        '--seconds',
        '6',
        '--seed',
        '3',
        '--output',
        tmp_path,
    )
    with (tmp_path / 'trust_bags.csv').open(newline='') as file:
        right, cycled = csv.DictReader(file)
    assert int(right['all_poses']) > 15
    # Chi squared beyond the limit: 0.27 % of right poses; some more, since tracks have tails.
    assert int(right['all_direction_beyond']) <= 0.15 * int(right['all_poses'])
    assert float(right['direction_error']) < 3.0
    assert re.search(r'\n\| imu-cycled +\| +1 \|', (tmp_path / 'trust.md').read_text())
    # Published poses of it would be wrong; the monitor suppresses them.
    if int(cycled['poses']):
        assert float(cycled['direction_error']) > 10.0


@pytest.mark.parametrize(
    ('row', 'end', 'named'),
    [
        ('gyro-degrees', 1.0, {'gyro_unit'}),
        ('upside-down', 1.0, {'axes', 'image_geometry'}),
        ('K-1.3', 2.0, {'focal_length', 'unknown_cause'}),
    ],
)
def test_pairs_that_contradict_the_gyro_have_no_pose_but_reveal_the_reason(row, end, named):
    """Of K-1.3 pairs alone reveal it, none has a pose, and a lens would fit them as well."""
    recording = trust.recording_of(trust.BagPlan(1, 64005, 3.0, 0.0186))
    pairs = [
        pair
        for pair, _ in trust_runs.run(
            recording, ROWS[row].wrong(recording.configured, np.random.default_rng(0)), end
        )
    ]
    assert sum('contradict' in pair.pose.reason for pair in pairs) >= 4
    assert not any(pair.pose or pair.pose.rotation_known for pair in pairs)
    faults = {fault.code: fault for fault in pairs[-1].health.faults}
    assert faults.keys() & named
    if 'unknown_cause' in faults:
        assert 'focal_length' in faults[Code.UNKNOWN_CAUSE].candidates
