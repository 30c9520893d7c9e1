"""The paper's synthetic experiments: exact scenes, runs, tables, pictures, the command."""

from __future__ import annotations

import csv
from dataclasses import replace
import json

import cv2
import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from rs_relpose_lab.experiments.boxes import by_case, draw_boxes, Record, tables
from rs_relpose_lab.experiments.methods import run_method
from rs_relpose_lab.experiments.paper import EXACT, paper_problem, PaperRun, run_paper, SWEEPS
from rs_relpose_lab.experiments.problems import (
    BASELINES,
    CENTRE_U,
    CENTRE_V,
    FOCAL,
    HEIGHT,
    LINE_DELAY,
    make_problem,
    VIEW,
    WIDTH,
)
from rs_relpose_lab.experiments.scoring import NO_POSE, PoseError
from rs_relpose_lab.simulation.rows import see, uniform_motion
from rs_relpose_ros.cli import main
from rs_relpose_ros.errors import InputError
from rs_relpose_ros.estimator.result import Status

CENTRE = np.array([CENTRE_U, CENTRE_V])


def constant(w, v):
    return uniform_motion(Rotation.identity(), np.zeros(3), np.array(w), np.array(v))


# --- the camera, row by row


@pytest.mark.parametrize(('w', 'v', 'reference_row'), [
    ([0.0, 0.0, 0.0], [0.0, 0.0, 0.0], 0.0), ([3.0, -3.0, 3.0], [0.0, 0.0, 0.0], 0.0),
    ([1.0, 1.0, -1.0], [10.0, -10.0, 10.0], 0.0), ([-3.0, 3.0, 1.0], [10.0, 10.0, 10.0], 539.5)])
def test_a_point_is_seen_by_the_row_that_a_scan_of_all_rows_finds(w, v, reference_row):
    rng = np.random.default_rng(1)
    world = rng.uniform([-12.0, -8.0, 6.0], [12.0, 8.0, 34.0], (60, 3))
    seen = see(world, constant(w, v), replace(VIEW, reference_row=reference_row))
    rows = np.arange(HEIGHT, dtype=float)
    times = (rows - reference_row) * LINE_DELAY
    turns = Rotation.from_rotvec(times[:, None] * np.array(w)).inv()
    compared = 0
    for point, found in zip(world, seen, strict=True):
        # What each row's camera would see; the point is there where it is in that very row.
        local = turns.apply(point - times[:, None] * v)
        pixels = FOCAL * local[:, :2] / local[:, 2:] + CENTRE
        away = pixels[:, 1] - rows
        crossing = np.flatnonzero(np.diff(np.sign(away)) != 0)
        assert len(crossing) <= 1
        k = crossing[0] if len(crossing) else 0
        if not len(crossing) or not -1.0 < pixels[k, 0] < WIDTH:
            assert np.isnan(found).all()
        elif 1.0 < pixels[k, 0] < WIDTH - 2.0:
            share = away[k] / (away[k] - away[k + 1])
            # Linear between two rows, 60 us apart: exact to their curvature.
            expected = pixels[k] + share * (pixels[k + 1] - pixels[k])
            assert found == pytest.approx(expected, abs=1e-3)
            compared += 1
    assert compared > 20


def test_motion_is_that_of_the_camera_itself():
    """The velocities are in the camera's frame at time 0: it moves along its own axis."""
    turn = Rotation.from_rotvec([0.3, -0.2, 0.1])
    motion = uniform_motion(turn, np.array([1.0, 2.0, 3.0]), np.array([0.0, 0.0, 0.5]),
                            np.array([0.0, 0.0, 4.0]))
    world = turn.apply([[0.0, 1.0, 10.0]]) + np.array([1.0, 2.0, 3.0])
    assert motion(world, np.array([0.25]))[0] == pytest.approx(
        [np.sin(0.125), np.cos(0.125), 9.0])


def test_what_the_camera_cannot_see_is_not_a_number():
    world = np.array([[0.0, 0.0, 10.0], [0.0, 0.0, -10.0], [0.0, 0.0, 0.05], [100.0, 0.0, 10.0],
                      [0.0, 50.0, 10.0]])
    seen = see(world, constant([0.0] * 3, [0.0] * 3), VIEW)
    assert seen[0] == pytest.approx(CENTRE)
    assert np.isnan(seen[1:]).all()


def test_a_point_faster_than_the_rows_is_discarded():
    """At 60 rad/s about x the image runs faster than the rows are read: 640 * 60 * 60e-6 > 1."""
    world = np.array([[0.0, 1.0, 10.0], [1.0, -1.0, 10.0]])
    assert np.isnan(see(world, constant([60.0, 0.0, 0.0], [0.0] * 3), VIEW)).all()
    assert np.isfinite(see(world, constant([6.0, 0.0, 0.0], [0.0] * 3), VIEW)).all()


# --- scenes


def derotated(problem):
    """Rays (N, 3) as if all rows had been read with the first; Rodrigues by SciPy."""
    return [Rotation.from_rotvec(points[:, 1:] * LINE_DELAY * rate).apply(
        np.column_stack([(points - CENTRE) / FOCAL, np.ones(len(points))]))
        for points, rate in ((problem.points1, problem.w1), (problem.points2, problem.w2))]


@pytest.mark.parametrize('direction', ['forward', 'sideways'])
def test_problem_follows_the_paper_and_its_truth_fits_the_points(direction):
    """No linear velocity: the derotated rays meet the pose exactly."""
    problem = make_problem(replace(EXACT, direction=direction, speed=0.0, rate=3.0), 4)
    assert problem.points1.shape == problem.points2.shape == (300, 2)
    assert np.abs(problem.measured_rate1) == pytest.approx([3.0] * 3)
    assert problem.measured_rate2 == pytest.approx(-problem.measured_rate1)
    rays = derotated(problem)
    assert np.abs(np.cross(rays[0], rays[1] @ problem.R.T) @ problem.t).max() < 1e-9
    # Depth by the two rays: X1 = a f1 = R b f2 + t. The baseline is about 2 m.
    depths = [np.linalg.lstsq(np.column_stack([f1, -problem.R @ f2]), 2.0 * problem.t,
                              rcond=None)[0] for f1, f2 in zip(*rays, strict=True)]
    assert np.min(depths) > 0.0
    if direction == 'sideways':  # forward, the depth of points near the axis is not well defined
        assert 15.0 < np.mean(depths) < 25.0
    assert np.argmax(np.abs(problem.t)) == {'forward': 2, 'sideways': 0}[direction]
    # Gravity in both frames is one direction of the world.
    assert problem.R @ problem.measured_gravity2 == pytest.approx(problem.measured_gravity1)


def test_constant_velocity_is_along_the_baseline_and_leaves_the_pose_exact():
    """Derotated rays then meet the pose without any velocity, though the camera moves."""
    cell = replace(EXACT, speed=5.0, constant_velocity=True)
    moving, still = make_problem(cell, 3), make_problem(replace(cell, speed=0.0), 3)
    assert np.abs(moving.points1 - still.points1).max() > 1.0
    rays = derotated(moving)
    assert np.abs(np.cross(rays[0], rays[1] @ moving.R.T) @ moving.t).max() < 1e-9


def test_auto_is_as_good_as_five_points_on_derotated_rays_at_constant_velocity():
    """The linear velocities cannot be observed then, and must not cost what five points know."""
    errors = {}
    for trial in range(12):
        problem = paper_problem(replace(EXACT, speed=5.0, pixel_noise=0.5, outliers=0.3,
                                        constant_velocity=True), 'forward', 0, trial)
        for method in ('auto', 'opencv_derotated'):
            _, error = run_method(method, problem, trial)
            errors.setdefault(method, []).append((error.rotation, error.translation))
    ours, theirs = (np.median(errors[method], axis=0) for method in ('auto', 'opencv_derotated'))
    # Medians of a dozen scenes scatter by a tenth; those of more stand in docs/lab/evaluation.md.
    assert ours[0] <= 1.05 * theirs[0]
    assert ours[1] <= 1.2 * theirs[1]


def test_problems_depend_on_nothing_but_their_numbers():
    cell = replace(EXACT, pixel_noise=0.5, gyro_noise=0.5, gravity_noise=0.5, outliers=0.3)
    first, again = (paper_problem(cell, 'forward', 3, 7) for _ in range(2))
    assert np.array_equal(first.points1, again.points1)
    assert np.array_equal(first.points2, again.points2)
    for seed, trial in ((4, 7), (3, 8)):
        assert not np.array_equal(first.R, paper_problem(cell, 'forward', seed, trial).R)
    # Another cell keeps the cameras: what differs between cells is what is varied.
    for other in (EXACT, replace(cell, speed=7.0, rate=0.0)):
        assert np.array_equal(first.R, paper_problem(other, 'forward', 3, 7).R)


def test_noise_of_a_problem_is_what_was_asked_for():
    cell = replace(EXACT, direction='sideways')
    quiet, noisy, outliers, tilted = (make_problem(replace(cell, **changes), 0) for changes in (
        {}, {'pixel_noise': 0.7}, {'outliers': 0.4}, {'gravity_noise': 0.6}))
    assert np.std(noisy.points1 - quiet.points1) == pytest.approx(0.7, rel=0.1)
    assert np.std(noisy.points2 - quiet.points2) == pytest.approx(0.7, rel=0.1)
    moved = np.any(outliers.points2 != quiet.points2, axis=1)
    assert moved.sum() == 0.4 * len(moved)
    assert np.array_equal(outliers.points1, quiet.points1)
    tilt1, tilt2 = (np.cross(getattr(quiet, name), getattr(tilted, name))
                    for name in ('measured_gravity1', 'measured_gravity2'))
    # Two of the three turns by 0.6 deg show, each about one axis; the frames' are opposite.
    assert np.linalg.norm(tilt1) == pytest.approx(np.radians(0.6) * np.sqrt(2.0), rel=0.3)
    assert tilt1 @ tilt2 < -0.5 * np.linalg.norm(tilt1) * np.linalg.norm(tilt2)
    rates = [problem.measured_rate1 - problem.w1 for problem in (
        make_problem(replace(cell, gyro_noise=3.0), seed) for seed in range(20))]
    assert np.std(rates) == pytest.approx(np.radians(3.0), rel=0.3)


# --- experiments


@pytest.mark.parametrize(('name', 'field', 'most'), [
    ('linear_velocity', 'speed', 10.0), ('angular_velocity', 'rate', 3.0),
    ('pixel_noise', 'pixel_noise', 1.0), ('gravity_noise', 'gravity_noise', 1.0),
    ('gyro_noise', 'gyro_noise', 3.0)])
def test_ranges_are_those_of_the_paper(name, field, most):
    cells = [SWEEPS[name].cell(level, EXACT) for level in SWEEPS[name].levels]
    assert (getattr(cells[0], field), getattr(cells[-1], field)) == (0.0, most)
    for cell in cells:
        assert (cell.speed, cell.rate) == {
            'linear_velocity': (cell.speed, 0.0), 'angular_velocity': (0.0, cell.rate),
        }.get(name, (1.0, 1.0))


def test_noise_of_the_base_stays_where_it_is_not_varied():
    base = replace(EXACT, pixel_noise=0.5, outliers=0.3)
    assert SWEEPS['gyro_noise'].cell(3.0, base) == replace(base, gyro_noise=3.0)
    assert SWEEPS['pixel_noise'].cell(0.2, base) == replace(base, pixel_noise=0.2)


@pytest.mark.parametrize('method', ['auto', 'uniform_9pt'])
@pytest.mark.parametrize('direction', BASELINES)
def test_exact_data_beat_the_papers_claim(method, direction):
    """The paper: rotation errors below 0.1 deg at every linear velocity; here below 0.001."""
    sweep = SWEEPS['linear_velocity']
    for trial, level in enumerate(sweep.levels):
        status, error = run_method(
            method, paper_problem(sweep.cell(level, EXACT), direction, 0, trial), trial)
        assert status is Status.OK
        assert error.rotation < 0.001


def test_global_shutter_methods_fail_where_the_paper_says_so():
    problem, still = (paper_problem(replace(EXACT, speed=0.0, rate=rate), 'forward', 0, 0)
                      for rate in (3.0, 0.0))
    for method in ('global_5pt', 'opencv'):
        # No pose is an infinite error.
        assert run_method(method, problem, 0)[1].rotation > 3.0
        assert run_method(method, still, 0)[1].rotation < 0.01


def small_run(**changes):
    values = {'sweeps': ('pixel_noise',), 'directions': ('sideways',), 'methods': ('auto',),
              'trials': 1, 'seed': 0, **changes}
    return PaperRun(**values)


def test_processes_do_not_change_the_result():
    run = small_run(methods=('auto', 'uniform_11pt'))
    seen = []
    assert run_paper(run, jobs=2, on_problem=lambda: seen.append(1)) == run_paper(run)
    assert len(seen) == len(run.tasks()) == 6


@pytest.mark.parametrize('change', [{'trials': 0}, {'seed': -1}])
def test_a_run_with_illegal_numbers_is_refused_by_name(change):
    with pytest.raises(InputError, match=f'^{next(iter(change))} must be'):
        small_run(**change)


# --- tables and pictures


def boxes_of(errors):
    """Boxes of one method; None is an estimate without a pose."""
    return by_case([
        Record('pixel_noise', 'forward', '0.2', 'auto', trial,
               Status.NO_CONSENSUS if error is None else Status.OK,
               NO_POSE if error is None else PoseError(error, 10.0 * error))
        for trial, error in enumerate(errors)])


def test_table_counts_what_has_no_pose_and_leaves_it_out():
    titles = {('pixel_noise', 'forward'): 'title'}
    text = tables(boxes_of([0.1, 0.2, None, 0.3]), titles, 'px')
    rows = [line for line in text.splitlines() if line.startswith('| 0.2')]
    # Median and 90th percentile by hand.
    assert rows == ['| 0.2 | 0.200 (0.280) |', '| 0.2 | 2.00 (2.80) |']
    assert text.startswith('## title\n') and 'no pose: auto, 1 of 4\n' in text
    assert '| 0.2 |    - |' in tables(boxes_of([None]), titles, 'px')


def test_picture_shows_the_quartiles_and_what_has_no_pose(tmp_path):
    figure = draw_boxes(boxes_of([0.1, 0.2, 0.4, None]), 'title', 'axis', tmp_path / 'boxes.png')
    left, right = figure.axes
    for plot, median in ((left, 0.2), (right, 2.0)):
        assert len(plot.patches) == 1
        assert median in [line.get_ydata()[0] for line in plot.lines]
        assert '25 %' in [text.get_text() for text in plot.texts]
    assert cv2.imread(str(tmp_path / 'boxes.png')).shape[0] > 300
    nothing = draw_boxes(boxes_of([None, None]), 'title', 'axis', tmp_path / 'none.png')
    assert not nothing.axes[0].patches
    assert '100 %' in [text.get_text() for text in nothing.axes[0].texts]


# --- the command


def paper(folder, *arguments):
    return main.main(['evaluate', 'paper', '--output', str(folder), *arguments])


def test_command_writes_tables_pictures_and_how_they_were_made(tmp_path, capsys):
    folder = tmp_path / 'deep' / 'results'
    folder.mkdir(parents=True)
    (folder / 'trials.csv').write_text('of an earlier run')
    assert paper(folder, '--trials', '2', '--figures', 'gyro_noise', '--motions', 'forward',
                 'sideways', 'forward', '--solvers', 'auto', 'angular_5pt', '--pixel-noise',
                 '0.3') == 0
    shown = capsys.readouterr()
    assert shown.err == ''      # no progress bar in a pipe
    for motion in ('forward', 'sideways'):
        assert shown.out.count(f'{motion} motion, 2 scenes a row') == 1
    assert {file.name for file in folder.iterdir()} == {
        'trials.csv', 'cells.csv', 'run.json', 'gyro_noise.png'}
    with (folder / 'trials.csv').open() as file:
        trials = list(csv.DictReader(file))
    assert len(trials) == 2 * 6 * 2 * 2
    with (folder / 'cells.csv').open() as file:
        cells = list(csv.DictReader(file))
    for cell in cells:
        mine = [float(row['rotation_error_deg']) for row in trials
                if all(row[key] == cell[key] for key in ('experiment', 'case', 'level', 'method'))]
        assert len(mine) == int(cell['poses']) == 2
        assert float(cell['rotation_median_deg']) == pytest.approx(np.median(mine))
        assert float(cell['rotation_max_deg']) == max(mine)
    made = json.loads((folder / 'run.json').read_text())
    assert made['trials'] == 2 and made['base']['pixel_noise'] == 0.3
    assert cv2.imread(str(folder / 'gyro_noise.png')).shape[0] > 600   # two motions


@pytest.mark.parametrize(('arguments', 'said'), [
    (['--trials', '0'], 'trials must be at least 1, got 0'),
    (['--jobs', '0'], 'jobs must be at least 1, got 0'),
    (['--outliers', '2'], 'outliers must be in [0, 0.95], got 2'),
    (['--pixel-noise', 'nan'], 'pixel_noise must be in'),
    (['--gravity-noise', '-1'], 'gravity_noise must be in'),
])
def test_bad_numbers_are_one_line_and_exit_code_2(arguments, said, tmp_path, capsys):
    assert paper(tmp_path / 'out', *arguments) == 2
    error = capsys.readouterr().err
    assert said in error and error.count('\n') == 1


def test_output_that_is_a_file_is_refused(tmp_path, capsys):
    (tmp_path / 'file').write_text('')
    assert paper(tmp_path / 'file', '--trials', '1') == 2
    assert str(tmp_path / 'file') in capsys.readouterr().err
