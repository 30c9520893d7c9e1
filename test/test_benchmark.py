"""The benchmarks: their statistics, their reports, and the methods that they compare."""

import csv
from dataclasses import replace

import numpy as np
import pytest

from rs_relpose_lab.experiments import accuracy
from rs_relpose_lab.experiments.accuracy import (
    estimate,
    Experiment,
    run_experiment,
    told_config,
    Trial,
)
from rs_relpose_lab.experiments.accuracy_report import cell_statistics, consistency, summary
from rs_relpose_lab.experiments.cell_names import matching_cells
from rs_relpose_lab.experiments.oracle_cache import OracleCache
from rs_relpose_lab.experiments.peers import available_methods, derotated, LIBRARY
from rs_relpose_lab.experiments.problems import Cell, CELLS, make_problem
from rs_relpose_lab.experiments.scoring import NO_POSE, pose_error, PoseError
from rs_relpose_lab.experiments.speed import compare, exponent, FirstEstimate, medians, Run, soak
from rs_relpose_lab.experiments.speed_report import method_statistics, write_report
from rs_relpose_ros.cli.main import main
from rs_relpose_ros.errors import InputError

STILL = Cell(speed=0.0, rate=0.0, pixel_noise=1e-2, gravity_noise=1e-3, gyro_noise=1e-3,
             outliers=0.2)


def trial(seed, rotation, oracle_rotation, nees=5.0):
    error = NO_POSE if rotation is None else PoseError(rotation, 2.0 * rotation, nees)
    return Trial('forward-base', 'paper', 1.0, seed, 'OK', error,
                 PoseError(oracle_rotation, oracle_rotation, 5.0), 0.003)


def test_cells_are_selected_by_pattern():
    assert matching_cells(['all'], CELLS) == tuple(CELLS)
    assert matching_cells(['sideways-base', 'forward-v10*'], CELLS) == (
        'forward-v10-w1', 'forward-v10-w3', 'forward-v10-w3-outliers-60', 'sideways-base')
    with pytest.raises(InputError, match='no cell is named'):
        matching_cells(['backward-*'], CELLS)


def test_ratios_are_of_medians_and_percentiles():
    rng = np.random.default_rng(0)
    errors = rng.uniform(0.1, 1.0, 101)
    statistics = cell_statistics([trial(k, 3.0 * e, e) for k, e in enumerate(errors)])
    assert statistics.rotation_ratio.median == pytest.approx(3.0)
    assert statistics.rotation_ratio.p90 == pytest.approx(3.0)
    assert statistics.translation_ratio.median == pytest.approx(6.0)
    assert statistics.lost == 0
    assert statistics.gross == (3.0 * errors > 2.0).sum()
    assert statistics.duration == pytest.approx(3.0)


def test_a_lost_pose_is_an_infinite_error_and_has_no_nees():
    trials = [trial(k, 0.1, 0.1) for k in range(8)] + [trial(k, None, 0.1) for k in range(8, 10)]
    statistics = cell_statistics(trials)
    assert statistics.lost == 2
    assert statistics.rotation.median == pytest.approx(0.1)
    assert statistics.rotation.p90 == np.inf
    assert statistics.nees.mean == pytest.approx(1.0)
    figures = {name: figure for name, figure, _ in summary([statistics])}
    assert figures['lost poses'] == 2


@pytest.mark.parametrize('overconfidence', [1.0, 2.0])
def test_consistency_tells_right_from_overconfident(overconfidence):
    nees = overconfidence * np.random.default_rng(1).chisquare(5, 20_000)
    found = consistency(list(nees))
    # Trimming one percent of a skewed distribution on each side lowers its mean by 2 %.
    assert found.mean == pytest.approx(0.98 * overconfidence, rel=0.02)
    assert found.above == pytest.approx({1.0: 0.05, 2.0: 0.355}[overconfidence], abs=0.01)


def test_experiment_keeps_the_oracle(tmp_path, monkeypatch):
    experiment = Experiment(('forward-base',), ('paper',), (1.0, 2.0), trials=2)
    counts = []
    first = run_experiment(experiment, OracleCache(tmp_path), on_trials=counts.append)
    assert sum(counts) == len(first) == 4
    assert {(t.seed, t.sigma_factor) for t in first} == {(0, 1.0), (0, 2.0), (1, 1.0), (1, 2.0)}
    assert all(t.error.rotation < 0.5 for t in first)

    def forbidden(*args):
        raise AssertionError('asked again')
    monkeypatch.setattr(accuracy, 'oracle_estimate', forbidden)
    again = run_experiment(experiment, OracleCache(tmp_path))
    assert [(t.error, t.oracle) for t in again] == [(t.error, t.oracle) for t in first]


def test_accuracy_writes_tables_and_a_plot(tmp_path, capsys):
    code = main(['benchmark', 'accuracy', '--trials', '2', '--cells', 'sideways-base', '--noise',
                 'gaussian', '--output', str(tmp_path)])
    assert code == 0
    report = (tmp_path / 'accuracy.md').read_text()
    assert report in capsys.readouterr().out
    assert 'sideways-base' in report
    with (tmp_path / 'trials.csv').open() as file:
        assert [row['seed'] for row in csv.DictReader(file)] == ['0', '1']
    assert (tmp_path / 'cells.csv').is_file()
    assert (tmp_path / 'accuracy.png').stat().st_size > 10_000


@pytest.mark.parametrize(('arguments', 'complaint'), [
    (['accuracy', '--cells', 'nowhere'], "no cell is named 'nowhere'"),
    (['accuracy', '--trials', '0'], '--trials must be at least 1, got 0'),
    (['accuracy', '--sigma-factor', '0'], '--sigma-factor must be positive'),
    (['speed', '--matches', '10'], '--matches must be at least 50'),
])
def test_bad_input_is_one_line(arguments, complaint, capsys, tmp_path):
    assert main(['benchmark', *arguments, '--output', str(tmp_path)]) == 2
    assert complaint in capsys.readouterr().err


@pytest.mark.parametrize('method', available_methods(), ids=lambda method: method.name)
def test_every_method_answers_in_our_convention(method):
    # A camera at rest in each frame: a global shutter, on which all of them are right.
    problem = make_problem(STILL, 1)
    pose = method.prepare(problem, STILL, 1)()
    assert pose is not None
    error = pose_error(*pose, problem.R, problem.t)
    assert error.rotation < 0.02
    assert error.translation < 0.1


@pytest.mark.parametrize('seed', [60, 88, 89])
def test_gravity_off_by_a_degree_does_not_end_the_search(seed):
    # Angular hypotheses from gravity explain half of the matches of these problems, wrongly.
    cell = CELLS['sideways-gravity-1']
    problem = make_problem(cell, seed, 'gaussian')
    pose = estimate(problem, told_config(cell, 1.0, 'auto'), seed)
    assert pose_error(pose.R, pose.t, problem.R, problem.t, pose.covariance).rotation < 0.3
    assert pose.inliers[~problem.is_outlier].mean() > 0.95


def test_derotated_points_are_where_row_0_would_have_seen_them():
    cell = replace(STILL, rate=1.0, pixel_noise=0.0, gyro_noise=0.0)
    turning, still = make_problem(cell, 2), make_problem(replace(cell, rate=0.0), 2)
    # The scenes are equal; the first points of both see the same world where both see it.
    near = derotated(turning.points1, turning.measured_rate1)
    gaps = np.linalg.norm(near[:, None] - still.points1[None], axis=2).min(axis=1)
    assert np.median(gaps) < 1e-3
    assert np.median(np.linalg.norm(
        turning.points1[:, None] - still.points1[None], axis=2).min(axis=1)) > 1.0


def test_comparison_and_its_report(tmp_path):
    runs = compare('forward-base', 100, trials=1, repeats=1)
    names = [method.name for method in available_methods()]
    assert [run.method for run in runs] == names
    assert all(run.matches == 100 and run.duration > 0.0 for run in runs)
    report = write_report(tmp_path, runs, runs, [FirstEstimate(50.0, 3.0)], soak(10))
    assert all(name in report for name in names)
    assert 'First estimate 50 ms' in report
    assert 'after 10 estimates' in report
    assert {path.name for path in tmp_path.iterdir()} == {
        'runs.csv', 'methods.csv', 'scaling.csv', 'speed.md', 'speed.png'}


def test_growth_is_the_slope_of_the_logarithms():
    runs = [Run('forward-base', n, LIBRARY, seed, 1e-3 * n**2 * (1.0 + 0.1 * seed), 0.1, 0.1)
            for n in (300, 1000, 3000) for seed in (0, 1, 2)]
    assert medians(runs, LIBRARY)[1000] == pytest.approx(1100.0)
    assert exponent(medians(runs, LIBRARY)) == pytest.approx(2.0)


def test_times_are_compared_problem_by_problem():
    runs = [Run('forward-base', 300, name, seed, factor * (1.0 + seed), 0.1, 0.1)
            for name, factor in (('PoseLib, derotated points', 10.0), (LIBRARY, 4.0))
            for seed in range(5)]
    ratios = {entry.method: entry.time_ratio for entry in method_statistics(runs)}
    assert ratios == {'PoseLib, derotated points': pytest.approx(1.0),
                      LIBRARY: pytest.approx(0.4)}
