"""The benchmarks: one smoke run each, their statistics, the demo's comparison."""

import csv
from dataclasses import replace
import math
import re
import subprocess
import sys

from conftest import BUNDLED_PARAMETERS, ROOT, rows_of
import numpy as np
import pytest
from scipy.spatial.transform import Rotation
from two_view_scene import rotation_error

from rs_relpose_lab.cli.benchmark import matching_cells
from rs_relpose_lab.experiments import accuracy, comparison, methods, speed, suggestions
from rs_relpose_lab.experiments import consistency as pair_errors
from rs_relpose_lab.experiments.harness import grouped
from rs_relpose_lab.experiments.methods import METHODS
from rs_relpose_lab.experiments.problems import Cell, CELLS, make_problem
from rs_relpose_lab.experiments.scoring import NO_POSE, PoseError
from rs_relpose_lab.experiments.speed import LIBRARY, REFERENCE, Timing
from rs_relpose_ros.bags.reader import open_bag
from rs_relpose_ros.cli.main import main
from rs_relpose_ros.config.files import read_parameters
from rs_relpose_ros.errors import InputError
from rs_relpose_ros.estimator.result import RelativePose, Status
from rs_relpose_ros.geometry.camera import Intrinsics, RollingShutterCamera
from rs_relpose_ros.offline import pictures
from rs_relpose_ros.offline.replay import read_truth
from rs_relpose_ros.offline.tables import PairRecord, POSES, table_writer
from rs_relpose_ros.offline.truth import PairErrors, TrueTrajectory
from rs_relpose_ros.pipeline.pair import PairResult
from rs_relpose_ros.tracking.features import Matches

STILL = Cell(speed=0.0, rate=0.0, pixel_noise=1e-2, gravity_noise=1e-3, gyro_noise=1e-3,
             outliers=0.2)


def trial(seed, rotation, oracle_rotation):
    error = NO_POSE if rotation is None else PoseError(rotation, 2.0 * rotation, 5.0)
    return accuracy.Trial('forward-base', 'paper', 1.0, seed, 'OK', error,
                          PoseError(oracle_rotation, oracle_rotation, 5.0), 0.003)


def test_cells_are_selected_by_pattern():
    assert matching_cells(['all'], CELLS) == tuple(CELLS)
    assert matching_cells(['sideways-base', 'forward-v10*'], CELLS) == (
        'forward-v10-w1', 'forward-v10-w3', 'forward-v10-w3-outliers-60', 'sideways-base')
    with pytest.raises(InputError, match='no cell is named'):
        matching_cells(['backward-*'], CELLS)


def test_statistics_of_a_cell():
    """Ratios of medians and percentiles; a lost pose is an infinite error without NEES."""
    errors = np.random.default_rng(0).uniform(0.1, 1.0, 101)
    complete = accuracy.cell_statistics([trial(k, 3.0 * e, e) for k, e in enumerate(errors)])
    assert [complete.rotation_ratio.median, complete.rotation_ratio.p90,
            complete.translation_ratio.median, complete.duration] == pytest.approx([3, 3, 6, 3])
    assert (complete.lost, complete.gross) == (0, (3.0 * errors > 2.0).sum())
    with_lost = accuracy.cell_statistics(
        [trial(k, 0.1 if k < 8 else None, 0.1) for k in range(10)])
    assert (with_lost.lost, with_lost.rotation.p90) == (2, np.inf)
    assert [with_lost.rotation.median, with_lost.nees.mean] == pytest.approx([0.1, 1.0])
    assert {name: value for name, value, _ in accuracy.summary([with_lost])}['lost poses'] == 2


@pytest.mark.parametrize(('overconfidence', 'above'), [(1.0, 0.05), (2.0, 0.355)])
def test_consistency_of_normalised_errors(overconfidence, above):
    nees = overconfidence * np.random.default_rng(1).chisquare(5, 20_000)
    found = accuracy.consistency(list(nees))
    # Trimming one percent of a skewed distribution on each side lowers its mean by 2 %.
    assert found.mean == pytest.approx(0.98 * overconfidence, rel=0.02)
    assert found.above == pytest.approx(above, abs=0.01)


def test_accuracy_command(tmp_path, capsys, monkeypatch):
    """Two problems with right and double sigmas; a second run uses the kept oracle."""
    command = ['benchmark', 'accuracy', '--trials', '2', '--cells', 'sideways-outliers-50',
               '--noise', 'gaussian', '--sigma-factor', '1', '2', '--output', str(tmp_path)]
    assert main(command) == 0
    report = (tmp_path / 'accuracy.md').read_text()
    assert report in capsys.readouterr().out
    assert report.count('| sideways-outliers-50 |') == 2
    rows = rows_of(tmp_path / 'trials.csv')
    assert {(row['seed'], row['sigma_factor']) for row in rows} == {
        (seed, factor) for seed in '01' for factor in ('1.0', '2.0')}
    assert all(float(row['error_rotation']) < 0.5 for row in rows)
    monkeypatch.setattr(accuracy, 'oracle_estimate', lambda *args: pytest.fail('it runs again'))
    assert main(command) == 0
    assert [{**row, 'duration': ''} for row in rows_of(tmp_path / 'trials.csv')] == [
        {**row, 'duration': ''} for row in rows]


@pytest.mark.parametrize(('arguments', 'message'), [
    (['accuracy', '--cells', 'nowhere'], "no cell is named 'nowhere'"),
    (['accuracy', '--trials', '0'], '--trials must be at least 1, got 0'),
    (['accuracy', '--sigma-factor', '0'], '--sigma-factor must be positive'),
    (['speed', '--matches', '10'], '--matches must be at least 50'),
    (['consistency', '--bags', '0'], 'nothing to measure'),
    (['consistency', '--exposure', '300'], 'exposure_time must be in [0, 0.2] s, got 0.3'),
    (['consistency', '--compare'], '--compare needs a --recording'),
    (['trust', '--rows', 'nonsense'], 'no cell is named'),
    (['trust', '--seconds', '2'], '--seconds must be'),
    (['trust', '--bags', '0'], 'nothing to measure'),
    (['live', '--cells', '4k-*'], 'no cell is named'),
    (['live', '--duration', '1'], '--duration must be at least 5')])
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
    for cell in (STILL, replace(STILL, rate=3.0))[:1 + derotates]:
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
    timings = speed.compare('forward-base', 100, trials=1, repeats=1)
    assert [timing.method for timing in timings] == list(speed.COMPARED)
    assert all(timing.matches == 100 and timing.duration > 0.0 for timing in timings)
    report = speed.write_report(tmp_path, timings, timings, [(50.0, 3.0)], speed.soak(10))
    for found in speed.method_statistics(timings):
        assert re.search(rf'^\| {found.method} +\| +{found.time.text(2)} .*\| '
                         rf'+{found.rotation.text(3)} \|', report, re.MULTILINE)
    assert 'First estimate 50 ms' in report
    assert 'after 10 estimates' in report


def test_times_are_compared_problem_by_problem():
    # Five problems each, of times in proportion to the square of the number of matches.
    timings = [Timing('forward-base', n, method, seed, factor * n**2 * (1.0 + 0.1 * seed), 0.1,
                      0.1) for method, factor in ((REFERENCE, 1e-3), (LIBRARY, 4e-4))
               for n in (300, 1000, 3000) for seed in range(5)]
    assert speed.medians(timings, REFERENCE)[1000] == pytest.approx(1200.0)
    assert speed.exponent(speed.medians(timings, LIBRARY)) == pytest.approx(2.0)
    assert {entry.method: entry.time_ratio for entry in speed.method_statistics(timings)} == {
        REFERENCE: 1.0, LIBRARY: pytest.approx(0.4, abs=1e-9)}


@pytest.mark.parametrize('claimed', [1.0, 0.5])
def test_nees_of_errors_drawn_from_a_covariance(claimed):
    """NEES by freedom is 1 where the covariance is right, 4 where its sigmas are half of it."""
    rng = np.random.default_rng(0)
    t = np.array([0.6, 0.0, 0.8])
    across = np.eye(3) - np.outer(t, t)
    root = 0.01 * rng.normal(size=(6, 6))
    root[:3] = across @ root[:3]
    sigma, R_sigma = 0.02, 0.01   # of the truth
    found = []
    for _ in range(2000):
        error = root @ rng.normal(size=6)
        true_t = t + error[:3] + sigma * across @ rng.normal(size=3)
        pose = RelativePose(Status.OK, R=np.eye(3), t=t, covariance=claimed**2 * root @ root.T)
        turned = Rotation.from_rotvec(error[3:] + R_sigma * rng.normal(size=3)).as_matrix()
        found.append(pair_errors.pair_consistency('', '', pair_errors.TruePair(
            0, 1, turned, true_t, claimed * sigma, claimed * R_sigma), pose))
    assert np.mean([p.rotation_nees for p in found]) == pytest.approx(claimed**-2, rel=0.07)
    assert np.mean([p.translation_nees for p in found]) == pytest.approx(claimed**-2, rel=0.07)


def test_chosen_pairs_of_a_recording_and_of_its_table(bundled_bag, tmp_path):
    """At frames where the policy has no keyframes; the second overlaps both others."""
    stamps, parameters = pair_errors.image_stamps(bundled_bag), read_parameters(BUNDLED_PARAMETERS)
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
        writer.writerow(['stamp1_ns', 'stamp2_ns',
                         *(f'r{i}{j}' for i in (1, 2, 3) for j in (1, 2, 3)), 'tx', 'ty', 'tz',
                         'sigma_t_deg', 'sigma_r_deg'])
        # The first is of a frame that is not there: asked for, and not answered.
        for start, end in ((stamps[90] - 1, stamps[95]), *reversed(ends)):
            R, t = truth.relative_pose(start + delay_ns, end + delay_ns)
            writer.writerow([start, end, *R.ravel(), *t / np.linalg.norm(t), 1.0, 0.1])
    # The first is that of the largest axis, the second the root of the sum over three.
    assert [pair[4:] for pair in pair_errors.read_true_pairs(table)] == [
        pytest.approx(np.radians([1.0, 0.1 / np.sqrt(3.0)]))] * 4
    assert main(['benchmark', 'consistency', '--bags', '0', '--recording', str(bundled_bag),
                 str(BUNDLED_PARAMETERS), str(table), '--compare', '--output', str(tmp_path)]) == 0
    report = (tmp_path / 'consistency.md').read_text()
    for method in ('recordings', 'readout ignored', 'MAGSAC'):
        assert re.search(rf'^\| {method} +\| +3 of 4 \|', report, re.MULTILINE)
    assert 'nan' not in report
    found = grouped([row for row in rows_of(tmp_path / 'consistency.csv') if row['rotation']],
                    lambda row: row['source'])
    for rows in found.values():
        assert {(int(row['stamp1_ns']), int(row['stamp2_ns'])) for row in rows} == set(ends)
    for row in found['recordings']:
        assert float(row['rotation']) < 0.1 and float(row['translation']) < 2.0
        assert float(row['rotation_nees']) < 5.0 and float(row['translation_nees']) < 5.0
    assert all(not row['rotation_nees'] for row in found['MAGSAC'])   # has no covariance
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
    assert main(['benchmark', 'suggestions', '--recording', str(bundled_bag),
                 str(BUNDLED_PARAMETERS), '--output', str(tmp_path)]) == 0
    right, wrong = rows_of(tmp_path / 'suggestions.csv')
    assert right['others'] == '' and right['estimated'] == ''
    assert float(wrong['size']) > 6.0
    assert float(wrong['estimated']) == pytest.approx(float(wrong['right']), rel=0.01)
    report = (tmp_path / 'suggestions.md').read_text()
    assert re.search(r'^\| right +\| +ok \|$', report, re.MULTILINE)
    assert '1 of 1 errors of over 6 sigmas named' in report


def test_errors_of_suggested_values_are_counted_by_their_sigmas(tmp_path):
    def found(row, size, estimated, others=''):
        return suggestions.Suggestion('bag', row, size, 10.0, estimated, 2.0, others)

    text = suggestions.write_report(tmp_path, [
        found('right', 0.0, math.nan, 'axes'), found('axes 3 deg', 7.0, math.nan),
        found('readout x2', 7.0, 13.0), found('readout x0.5', 7.0, 15.0),
        found('focal x1.05', 5.0, math.nan)])
    assert ('2 of 3 errors of over 6 sigmas named, 1 of their values within 2 sigmas; 1 right '
            'runs with a finding') in text
    assert re.search(r'^\| readout x2 +\| +\+1\.5 \(7\) \|$', text, re.MULTILINE)



START_NS = 1_700_000_000_000_000_000
INTRINSICS = {'width': 640, 'height': 480, 'fx': 450.0, 'fy': 452.0, 'cx': 322.0, 'cy': 238.0,
              'distortion': (-0.12, 0.05, 0.0008, -0.0005, 0.0)}
CAMERA = RollingShutterCamera(**INTRINSICS, readout_time=0.0)
CALIBRATION = Intrinsics(**INTRINSICS, image_width=640, image_height=480)
# Camera 2 is half a metre to the right of camera 1, a little ahead, and rotated.
R_TRUE = Rotation.from_rotvec([0.02, -0.08, 0.03]).as_matrix()
T_TRUE = np.array([0.5, 0.05, 0.1])


def view(noise, outliers, seed=0):
    """Pixels of 300 points in both cameras; ``X1 = R X2 + t``, so ``X2 = R^T (X1 - t)``."""
    rng = np.random.default_rng(seed)
    X1 = rng.uniform([-3.0, -2.0, 4.0], [3.0, 2.0, 12.0], (300, 3))
    points1 = CAMERA.project(X1) + noise * rng.standard_normal((300, 2))
    points2 = CAMERA.project((X1 - T_TRUE) @ R_TRUE) + noise * rng.standard_normal((300, 2))
    points2[:outliers] = rng.uniform([0.0, 0.0], [640.0, 480.0], (outliers, 2))
    return points1, points2


def by_opencv(points1, points2, estimator, threshold=1.0):
    return methods.opencv_five_point(
        *(methods.undistorted(points, CAMERA) for points in (points1, points2)), CAMERA,
        threshold, estimator=estimator)


def pair_of(noise, outliers, seed=0):
    points1, points2 = view(noise, outliers, seed)
    count = len(points1)
    pose = RelativePose(Status.OK, R=R_TRUE, t=T_TRUE / np.linalg.norm(T_TRUE),
                        inliers=np.ones(count, dtype=bool), covariance=1e-6 * np.eye(6),
                        model='uniform')
    return PairResult(
        START_NS, START_NS + 10**9, START_NS, START_NS + 10**9, 'camera', 1.0, pose,
        Matches(np.arange(count, dtype=np.uint32), points1, points2, np.ones(count)),
        np.zeros(count), np.zeros(count), np.zeros((count, 3)), np.zeros((count, 3)), 20.0)


@pytest.fixture
def truth():
    """A steady motion by the true relative pose within the first second."""
    seconds = np.arange(21) / 20.0
    rotvec = Rotation.from_matrix(R_TRUE).as_rotvec()
    return TrueTrajectory(START_NS + (seconds * 1e9).astype(np.int64), np.outer(seconds, T_TRUE),
                          Rotation.from_rotvec(np.outer(seconds, rotvec)).as_quat())


def test_best_threshold_is_the_best_and_is_drawn(truth, tmp_path, monkeypatch):
    pairs = [pair_of(0.5, 90, seed) for seed in range(3)]
    best = comparison.best_opencv_score('RANSAC', pairs, CALIBRATION, truth)
    assert (best.pairs, best.answered) == (3, 3)
    # In our convention: its RANSAC does not refine, but the inverse would be off by 10 deg.
    assert best.rotation[0] < 1.0 and best.translation[0] < 5.0
    assert by_opencv(*(points[:4] for points in view(0.5, 0)), 'RANSAC') is None
    errors = {threshold: np.median([rotation_error(by_opencv(
        pair.matches.points1, pair.matches.points2, 'RANSAC', threshold).R, R_TRUE)
        for pair in pairs]) for threshold in (0.5, 1.0, 2.0)}
    threshold = min(errors, key=errors.__getitem__)
    assert best.name.endswith(f'{threshold:g} px')
    assert best.rotation[0] == pytest.approx(errors[threshold], abs=1e-6)
    drawn = []
    monkeypatch.setattr(pictures, 'save_picture', lambda figure, path: drawn.append(figure))
    pictures.draw_errors([PairRecord.of(pair, truth) for pair in pairs],
                         tmp_path / 'errors.png', {best.name: best.errors})
    for axis, median in zip(drawn[0].axes, (best.rotation[0], best.translation[0]), strict=True):
        assert f'{best.name}:\nmedian {median:.2g} deg' in {
            text.get_text() for text in axis.get_legend().get_texts()}


def test_scores_of_a_table_and_of_its_records_agree(truth, tmp_path):
    records = [PairRecord.of(pair_of(0.1, 10), truth)]
    with table_writer(tmp_path, [POSES]) as write:
        write(records[0])
    live = comparison.score_of_table('live', tmp_path / POSES.file, records, truth)
    assert (live.pairs, live.answered) == (1, 1)
    assert live.rotation == pytest.approx(
        comparison.score_of_records('', records).rotation, abs=1e-5)
    assert live.rotation[0] < 1e-4 and live.translation[0] < 1e-4   # the poses are the truth


def test_differing_poses_are_found(tmp_path):
    row = '{},0.6,0.8,0,0,0,0,1,0.1,0.1,0.1,0.1,0.1,50,{},{},OK'
    first, second = (row.format(ends, 60, 'uniform') for ends in ('1,2', '2,3'))
    live = [row.format('1,2', '', ''), row.format('2,3', '', '')]
    for rows, found in (((first, second, '3,4' + ',' * 14 + '9,,BAD_INPUT'), (0, 2)),
                        ((first.replace('0.6,', '0.6000000000000001,'), second), (1, 2)),
                        (live[:1], (1, 2))):
        paths = []
        for name, lines in (('live.csv', live), ('replay.csv', rows)):
            paths.append(tmp_path / name)
            paths[-1].write_text('\n'.join([','.join(POSES.columns), *lines]) + '\n')
        assert comparison.differing_poses(*paths) == found


def test_table_of_scores():
    lines = comparison.score_table([
        comparison.Score('node', 30, 27, (0.0123, 0.0456), (0.789, 12.34)),
        comparison.score('a method without a pose', [None, None], pairs=30),
        comparison.score('one', [PairErrors(1.0, 2.0, 0.25, 4.0), None])])
    node, none, one = (line.split() for line in lines[-3:])
    assert node[1:] == ['30', '27', '0.012', '0.046', '0.789', '12.3']
    assert none[-6:] == ['30', '0', '-', '-', '-', '-']
    assert one[1:] == ['2', '1', '0.250', '0.250', '4.000', '4.000']
    assert len({len(line) for line in lines[2:]}) == 1, 'columns are aligned'


@pytest.mark.long
@pytest.mark.timeout(300)
def test_demo():
    """The demo itself: three processes over DDS, replays, and the table."""
    done = subprocess.run([sys.executable, ROOT / 'demo' / 'run_demo.py'], capture_output=True,
                          text=True, timeout=290)
    assert done.returncode == 0, done.stderr
    rows = {name: re.search(rf'^{name}\s+(\d+)\s+(\d+)\s+(\S+)\s+\S+\s+(\S+)', done.stdout, re.M)
            for name in ('relpose_node, live', 'uniform 9-point', 'uniform 11-point',
                         '5-point on derotated rays', r'OpenCV 5-point, RANSAC, \S+ px',
                         r'OpenCV 5-point, USAC_MAGSAC, \S+ px')}
    assert all(rows.values()), done.stdout
    pairs, poses, rotation, translation = rows['relpose_node, live'].groups()
    assert int(pairs) >= 25 and int(poses) >= 20
    assert float(rotation) <= 0.15 and float(translation) <= 3.0
    for name in list(rows)[-2:]:
        assert float(rows[name][3]) >= 3.0 * float(rotation)
    assert 'bit-equal' in done.stdout
    for picture in re.findall(r'\S+\.png', done.stdout):
        assert (ROOT / picture).is_file()
