"""Random problems and the oracle: right by themselves, and independent of the estimator."""

import ast
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from scipy.optimize import approx_fprime
from scipy.spatial.transform import Rotation

from rs_relpose_lab.experiments import oracle, problems
from rs_relpose_lab.experiments.accuracy import OracleCache
from rs_relpose_lab.experiments.oracle import Objective, oracle_estimate, start_at
from rs_relpose_lab.experiments.paper import EXACT, paper_problem
from rs_relpose_lab.experiments.problems import Cell, CELLS, FOCAL, LINE_DELAY, make_problem, VIEW
from rs_relpose_lab.experiments.scoring import pose_error, PoseError
from rs_relpose_lab.simulation import rows
from rs_relpose_lab.simulation.rows import observe, uniform_motion

NO_NOISE = {'pixel_noise': 0.0, 'gravity_noise': 0.0, 'gyro_noise': 0.0, 'outliers': 0.0}
SIGMAS = 0.5, np.radians(0.2), np.radians(0.1)
CENTRE = np.array([problems.CENTRE_U, problems.CENTRE_V])


@pytest.mark.parametrize('module', [oracle, problems, rows])
def test_independent_of_the_package(module):
    tree = ast.parse(Path(module.__file__).read_text(encoding='utf-8'))
    imported = {alias.name for node in ast.walk(tree) if isinstance(node, ast.Import)
                for alias in node.names}
    imported |= {node.module for node in ast.walk(tree) if isinstance(node, ast.ImportFrom)}
    assert {name for name in imported if name.startswith('rs_relpose')} <= {
        'rs_relpose_lab.experiments.problems', 'rs_relpose_lab.simulation.rows'}


def constant(w, v):
    return uniform_motion(Rotation.identity(), np.zeros(3), np.array(w), np.array(v))


@pytest.mark.parametrize(('w', 'v', 'reference_row'), [
    ([0.0, 0.0, 0.0], [0.0, 0.0, 0.0], 0.0), ([3.0, -3.0, 3.0], [0.0, 0.0, 0.0], 0.0),
    ([1.0, 1.0, -1.0], [10.0, -10.0, 10.0], 0.0), ([-3.0, 3.0, 1.0], [10.0, 10.0, 10.0], 539.5)])
def test_a_point_is_in_the_row_that_a_scan_of_all_rows_finds(w, v, reference_row):
    rng = np.random.default_rng(1)
    world = rng.uniform([-12.0, -8.0, 6.0], [12.0, 8.0, 34.0], (60, 3))
    observed = observe(world, constant(w, v), replace(VIEW, reference_row=reference_row))
    all_rows = np.arange(VIEW.height, dtype=float)
    times = (all_rows - reference_row) * LINE_DELAY
    attitudes = Rotation.from_rotvec(times[:, None] * np.array(w)).inv()
    compared = 0
    for point, found in zip(world, observed, strict=True):
        # Projection by each row's camera; the point is where it falls into that very row.
        local = attitudes.apply(point - times[:, None] * v)
        pixels = FOCAL * local[:, :2] / local[:, 2:] + CENTRE
        away = pixels[:, 1] - all_rows
        crossing = np.flatnonzero(np.diff(np.sign(away)) != 0)
        assert len(crossing) <= 1
        k = crossing[0] if len(crossing) else 0
        if not len(crossing) or not -1.0 < pixels[k, 0] < VIEW.width:
            assert np.isnan(found).all()
        elif 1.0 < pixels[k, 0] < VIEW.width - 2.0:
            share = away[k] / (away[k] - away[k + 1])
            # Linear between two rows, 60 us apart: exact to their curvature.
            expected = pixels[k] + share * (pixels[k + 1] - pixels[k])
            assert found == pytest.approx(expected, abs=1e-3)
            compared += 1
    assert compared > 20


@pytest.mark.parametrize(('point', 'w', 'visible'), [
    ([0.0, 0.0, 10.0], [0.0] * 3, True), ([0.0, 0.0, -10.0], [0.0] * 3, False),
    ([0.0, 0.0, 0.05], [0.0] * 3, False), ([100.0, 0.0, 10.0], [0.0] * 3, False),
    ([0.0, 50.0, 10.0], [0.0] * 3, False), ([0.0, 1.0, 10.0], [6.0, 0.0, 0.0], True),
    # The image runs faster than the rows are read: 640 * 60 * 60e-6 > 1.
    ([0.0, 1.0, 10.0], [60.0, 0.0, 0.0], False)])
def test_points_outside_of_the_image_or_faster_than_the_rows_are_nan(point, w, visible):
    observed = observe(np.array([point]), constant(w, [0.0] * 3), VIEW)
    assert np.isfinite(observed).all() == np.isfinite(observed).any() == visible
    if point == [0.0, 0.0, 10.0]:
        assert observed[0] == pytest.approx(CENTRE)


@pytest.mark.parametrize('name', CELLS)
def test_problems_are_those_of_their_cell(name):
    cell = CELLS[name]
    problem = make_problem(cell, 6)
    assert problem.points1.shape == problem.points2.shape == (cell.matches, 2)
    assert problem.is_outlier.sum() == round(cell.outliers * cell.matches)
    assert np.linalg.norm(problem.t) == pytest.approx(1.0)
    assert problem.t[{'forward': 2, 'sideways': 0}[cell.direction]] > 0.8
    np.testing.assert_allclose(np.abs(problem.w1), cell.rate)
    np.testing.assert_allclose(problem.w2, -problem.w1)
    if cell.constant_velocity:
        np.testing.assert_allclose(problem.R @ problem.v2, problem.v1)
        np.testing.assert_allclose(np.cross(problem.v1, problem.t), 0.0, atol=1e-12)
    else:
        np.testing.assert_allclose(problem.v2, -problem.v1)
    # The paper's error of gravity: equally large about each axis, opposite in the frames.
    assert problem.measured_gravity1 @ problem.gravity1 == pytest.approx(
        np.cos(np.radians(cell.gravity_noise) * np.linalg.norm(
            np.cross(problem.gravity1, [1, 1, 1]))), abs=1e-3)
    gravity2 = problem.R.T @ problem.gravity1
    assert np.cross(problem.gravity1, problem.measured_gravity1) @ np.cross(
        gravity2, problem.measured_gravity2) < 0.0


def test_problems_depend_on_nothing_but_their_numbers():
    cell = replace(EXACT, pixel_noise=0.5, gyro_noise=0.5, gravity_noise=0.5, outliers=0.3)
    first, again = (paper_problem(cell, 'forward', 3, 7) for _ in range(2))
    assert np.array_equal(first.points1, again.points1)
    assert np.array_equal(first.points2, again.points2)
    # Another cell has the same cameras, another number other ones.
    for other, seed, trial in ((cell, 4, 7), (cell, 3, 8), (EXACT, 3, 7),
                               (replace(cell, speed=7.0, rate=0.0), 3, 7)):
        assert np.array_equal(first.R, paper_problem(other, 'forward', seed, trial).R) == (
            (seed, trial) == (3, 7))


def objective_of(problem):
    return Objective(problem, *SIGMAS, start_at(problem.R, problem.t, problem.gravity1))


@pytest.mark.parametrize('cell', ['forward-base', 'sideways-v10-w3', 'forward-v0-w3'])
def test_jacobian_equals_finite_differences(cell):
    objective = objective_of(make_problem(CELLS[cell], 1))
    x = objective.truth()
    x += 0.01 * np.random.default_rng(0).normal(size=len(x))
    exact = objective.jacobian(x)
    differences = approx_fprime(x, lambda y: objective.residuals(y[:, None])[:, 0], 1e-7)
    scale = np.abs(exact).max(axis=0)
    assert scale.min() > 0.0
    assert (np.abs(exact - differences).max(axis=0) < 1e-5 * scale).all()


@pytest.mark.parametrize('cell', ['forward-base', 'sideways-v10-w3'])
def test_points_of_the_brute_force_camera_fulfil_the_constraint(cell):
    problem = make_problem(replace(CELLS[cell], **NO_NOISE), 2)
    objective = objective_of(problem)
    residuals = objective.residuals(objective.truth()[:, None])[:, 0]
    # First those of the matches; those of the priors follow.
    assert np.abs(SIGMAS[0] * residuals[:len(problem.points1)]).max() < 1e-6
    # Gravity in both frames is one direction of the world.
    assert problem.R @ problem.measured_gravity2 == pytest.approx(problem.measured_gravity1)


def test_the_optimum_is_the_truth_without_noise_and_independent_of_the_start():
    def started_off(problem, degrees, *sigmas):
        tilt = Rotation.from_rotvec(np.radians(degrees)).as_matrix()
        return oracle_estimate(problem, *sigmas, start=(tilt @ problem.R, tilt @ problem.t))

    exact, noisy = make_problem(Cell(**NO_NOISE), 3), make_problem(Cell(), 4)
    found = started_off(exact, [1.0, -2.0, 1.0], 1e-3, 1e-5, 1e-5)
    error = pose_error(found.R, found.t, exact.R, exact.t)
    assert error.rotation < 1e-4
    assert error.translation < 1e-3
    best = oracle_estimate(noisy, *SIGMAS)
    again = started_off(noisy, [0.2, -0.1, 0.2], *SIGMAS)
    assert pose_error(again.R, again.t, best.R, best.t).rotation < 1e-4
    np.testing.assert_allclose(again.covariance, best.covariance, rtol=0.02, atol=1e-9)


def test_its_covariance_describes_its_errors():
    nees = []
    for seed in range(30):
        problem = make_problem(Cell(), seed, 'gaussian')
        best = oracle_estimate(problem, *SIGMAS)
        nees.append(pose_error(best.R, best.t, problem.R, problem.t, best.covariance).nees)
    # The mean of 30 chi-square(5) is 5 +- 0.58.
    assert np.mean(nees) == pytest.approx(5.0, abs=1.8)


def test_error_in_sigmas_is_that_of_the_covariance():
    R, t = np.eye(3), np.array([0.0, 0.0, 1.0])
    true_R = Rotation.from_rotvec([0.01, 0.0, 0.0]).as_matrix()
    true_t = np.array([0.0, np.sin(0.02), np.cos(0.02)])
    covariance = np.diag([0.01, 0.01, 0.0, 0.005, 1.0, 1.0])**2
    error = pose_error(R, t, true_R, true_t, covariance)
    assert error.rotation == pytest.approx(np.degrees(0.01))
    assert error.translation == pytest.approx(np.degrees(0.02))
    assert error.nees == pytest.approx(2.0**2 + 2.0**2)


def test_kept_errors_come_back_for_their_own_cell_only(tmp_path):
    cache = OracleCache(tmp_path)
    first, second = (PoseError(0.1 * k, 0.2, 4.0) for k in (1, 2))
    cache.add(Cell(), 'paper', {3: first})
    cache.add(Cell(), 'paper', {1: second})
    assert cache.load(Cell(), 'paper') == {1: second, 3: first}
    assert cache.load(Cell(), 'gaussian') == {}
    assert cache.load(Cell(speed=2.0), 'paper') == {}
