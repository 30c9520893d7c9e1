"""The oracle of the accuracy benchmark: right by itself, and independent of the estimator."""

import ast
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from scipy.optimize import approx_fprime
from scipy.spatial.transform import Rotation

from rs_relpose_lab.experiments import mixture_oracle, oracle, problems
from rs_relpose_lab.experiments.accuracy import Best, OracleCache
from rs_relpose_lab.experiments.mixture_oracle import (
    depth_classes,
    mixture_estimate,
    mixture_of,
)
from rs_relpose_lab.experiments.oracle import Objective, oracle_estimate, start_at
from rs_relpose_lab.experiments.problems import Cell, CELLS, make_problem
from rs_relpose_lab.experiments.scoring import NO_POSE, pose_error, PoseError
from rs_relpose_lab.simulation import rows

NO_NOISE = {'pixel_noise': 0.0, 'gravity_noise': 0.0, 'gyro_noise': 0.0, 'outliers': 0.0}
SIGMAS = 0.5, np.radians(0.2), np.radians(0.1)


@pytest.mark.parametrize('module', [oracle, mixture_oracle, problems, rows])
def test_it_uses_nothing_of_the_package(module):
    tree = ast.parse(Path(module.__file__).read_text(encoding='utf-8'))
    imported = {alias.name for node in ast.walk(tree) if isinstance(node, ast.Import)
                for alias in node.names}
    imported |= {node.module for node in ast.walk(tree) if isinstance(node, ast.ImportFrom)}
    assert {name for name in imported if name.startswith('rs_relpose')} <= {
        'rs_relpose_lab.experiments.problems', 'rs_relpose_lab.experiments.oracle',
        'rs_relpose_lab.simulation.rows'}


@pytest.mark.parametrize('cell', ['forward-base', 'sideways-v10-w3', 'forward-v0-w3'])
def test_jacobian_equals_finite_differences(cell):
    problem = make_problem(CELLS[cell], 1)
    objective = Objective(problem, *SIGMAS, start_at(problem.R, problem.t, problem.gravity1),
                          (~problem.is_outlier).astype(float))
    rng = np.random.default_rng(0)
    x = objective.truth()
    x += 0.01 * rng.normal(size=len(x))
    exact = objective.jacobian(x)
    differences = approx_fprime(x, lambda y: objective.residuals(y[:, None])[:, 0], 1e-7)
    scale = np.abs(exact).max(axis=0)
    assert scale.min() > 0.0
    assert (np.abs(exact - differences).max(axis=0) < 1e-5 * scale).all()


@pytest.mark.parametrize('cell', ['forward-base', 'sideways-v10-w3'])
def test_the_simulated_camera_obeys_its_model(cell):
    # Points projected by brute force, each at its own row's instant, lie on the constraint.
    problem = make_problem(replace(CELLS[cell], **NO_NOISE), 2)
    objective = Objective(problem, *SIGMAS, start_at(problem.R, problem.t, problem.gravity1),
                          (~problem.is_outlier).astype(float))
    residuals = objective.residuals(objective.truth()[:, None])[:, 0]
    # First those of the matches; those of the priors follow.
    assert np.abs(SIGMAS[0] * residuals[:len(problem.points1)]).max() < 1e-6


def test_without_noise_it_finds_the_truth_from_elsewhere():
    problem = make_problem(Cell(**NO_NOISE), 3)
    tilted = Rotation.from_rotvec(np.radians([1.0, -2.0, 1.0])).as_matrix()
    found = oracle_estimate(problem, 1e-3, 1e-5, 1e-5, start=(tilted @ problem.R,
                                                              tilted @ problem.t))
    error = pose_error(found.R, found.t, problem.R, problem.t)
    assert error.rotation < 1e-4
    assert error.translation < 1e-3


def test_the_optimum_does_not_depend_on_the_start():
    problem = make_problem(Cell(), 4)
    tilted = Rotation.from_rotvec(np.radians([0.2, -0.1, 0.2])).as_matrix()
    best = oracle_estimate(problem, *SIGMAS)
    again = oracle_estimate(problem, *SIGMAS, start=(tilted @ problem.R, tilted @ problem.t))
    assert pose_error(again.R, again.t, best.R, best.t).rotation < 1e-4
    np.testing.assert_allclose(again.covariance, best.covariance, rtol=0.02, atol=1e-9)


def test_its_covariance_describes_its_errors():
    cell = Cell()
    nees = []
    for seed in range(30):
        problem = make_problem(cell, seed, 'gaussian')
        best = oracle_estimate(problem, *SIGMAS)
        nees.append(pose_error(best.R, best.t, problem.R, problem.t, best.covariance).nees)
    # The mean of 30 chi-square(5) is 5 +- 0.58.
    assert np.mean(nees) == pytest.approx(5.0, abs=1.8)


def seen_from(points, rate, velocity):
    """Of each pixel where the camera is at its row, and its ray, in the axes of the first row."""
    times = points[:, 1] * problems.LINE_DELAY
    rays = np.column_stack([(points[:, 0] - problems.CENTRE_U) / problems.FOCAL,
                            (points[:, 1] - problems.CENTRE_V) / problems.FOCAL,
                            np.ones(len(points))])
    return times[:, None] * velocity, Rotation.from_rotvec(times[:, None] * rate).apply(rays)


def test_depths_are_those_of_the_points():
    problem = make_problem(replace(CELLS['sideways-v10-w3'], **NO_NOISE), 2)
    objective = Objective(problem, *SIGMAS, start_at(problem.R, problem.t, problem.gravity1),
                          np.ones(len(problem.points1)))
    depths = objective.depths(objective.truth())
    # Both rays of a match meet: tau_1 v_1 + a f_1 = t + tau_2 R v_2 + c R f_2, for (a, c).
    origins, rays = zip(*(seen_from(points, w, v) for points, w, v in (
        (problem.points1, problem.w1, problem.v1), (problem.points2, problem.w2, problem.v2))),
        strict=True)
    expected = np.array([
        np.linalg.lstsq(np.column_stack([f1, -problem.R @ f2]),
                        problem.t + problem.R @ o2 - o1, rcond=None)[0]
        for o1, o2, f1, f2 in zip(*origins, *rays, strict=True)])
    np.testing.assert_allclose(depths, expected, rtol=1e-6)
    assert depths.min() > 0.0
    flipped = replace(problem, t=-problem.t, v1=-problem.v1, v2=-problem.v2)
    behind = replace(objective, problem=flipped,
                     start=start_at(problem.R, -problem.t, problem.gravity1))
    np.testing.assert_allclose(behind.depths(behind.truth()), -depths, rtol=1e-9)
    assert (depth_classes(-depths) == 0).all()
    assert depth_classes(depths).min() > 0


def test_the_mixture_oracle_knows_no_labels_and_tells_them_nearly():
    cell = CELLS['forward-outliers-60']
    problem = make_problem(cell, 5, 'gaussian')
    mixture = mixture_of(cell, 5, SIGMAS[0])
    blind = replace(problem, is_outlier=np.zeros(300, dtype=bool))
    found = mixture_estimate(problem, mixture, *SIGMAS)
    again = mixture_estimate(blind, mixture, *SIGMAS)
    np.testing.assert_array_equal(found.R, again.R)
    np.testing.assert_array_equal(found.t, again.t)
    objective = Objective(problem, *SIGMAS, start_at(problem.R, problem.t, problem.gravity1),
                          np.ones(300))
    x = objective.truth()
    true = mixture.is_true(objective.errors(x[:, None], np.ones(300, dtype=bool))[:, 0],
                           objective.depths(x), SIGMAS[0])
    assert true[~problem.is_outlier].mean() > 0.95
    assert true[problem.is_outlier].mean() < 0.05
    # As many are believed as are true.
    assert true.sum() == pytest.approx(120, abs=6)
    best = oracle_estimate(problem, *SIGMAS)
    error = pose_error(found.R, found.t, best.R, best.t)
    assert error.translation < 1.0
    assert error.rotation < 0.05


@pytest.mark.parametrize('name', CELLS)
def test_problems_of_a_cell_are_what_it_says(name):
    cell = CELLS[name]
    problem = make_problem(cell, 6)
    assert problem.points1.shape == problem.points2.shape == (cell.matches, 2)
    assert problem.is_outlier.sum() == round(cell.outliers * cell.matches)
    assert np.linalg.norm(problem.t) == pytest.approx(1.0)
    axis = {'forward': 2, 'sideways': 0}[cell.direction]
    assert problem.t[axis] > 0.8
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


def test_error_in_sigmas_is_that_of_the_told_covariance():
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
    first, second = (Best(PoseError(0.1 * k, 0.2, 4.0), NO_POSE) for k in (1, 2))
    cache.add(Cell(), 'paper', {3: first})
    cache.add(Cell(), 'paper', {1: second})
    assert str(cache.load(Cell(), 'paper')) == str({1: second, 3: first})
    assert cache.load(Cell(), 'gaussian') == {}
    assert cache.load(Cell(speed=2.0), 'paper') == {}
