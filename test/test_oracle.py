"""Random problems and the oracle: right by themselves, and independent of the estimator."""

import ast
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from scipy.optimize import approx_fprime
from scipy.spatial.transform import Rotation

from rs_relpose_lab.experiments import oracle, problems
from rs_relpose_lab.experiments.oracle import Objective, oracle_estimate, start_at
from rs_relpose_lab.experiments.problems import Cell, CELLS, FOCAL, LINE_DELAY, make_problem, VIEW
from rs_relpose_lab.experiments.scoring import pose_error
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
