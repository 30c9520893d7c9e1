"""Refinement: the Sampson error, its Jacobian and depths, the priors of the joint fit."""

import numpy as np
import pytest
from scipy.spatial.transform import Rotation
from simulated_pairs import estimate_scene
from two_view_scene import make_scene, rotation_error

from rs_relpose_ros import EstimatorConfig
from rs_relpose_ros.estimator import fit, priors, sampson
from rs_relpose_ros.estimator.priors import PARAMETERS, Priors, SCALE, TwoViewState
from rs_relpose_ros.geometry.so3 import tangent_basis


def random_observations(rng, n=50):
    """Observation rows that obey no model: every term of the Jacobian is exercised."""
    rows = rng.normal(size=(n, 20)) * 0.3
    rows[:, [2, 11]] += 1.0
    rows[:, 3:9] /= 500.0
    rows[:, 12:18] /= 500.0
    rows[:, 18:] *= 0.05
    return rows


def random_state(rng, rate=0.0):
    """`rate` [rad/s]: of the gyro's corrections."""
    t, d1, d2, dw1, dw2 = rng.normal(size=(5, 3))
    return TwoViewState(
        Rotation.from_rotvec(rng.normal(size=3) * 0.3).as_matrix(), t / np.linalg.norm(t),
        2.0 * d1, 2.0 * d2, rate * dw1, rate * dw2)


def stepped(state, step):
    """As `priors.moved`, by SciPy."""
    R, t, *rest = state
    t = t + tangent_basis(t) @ step[3:5]
    return TwoViewState(Rotation.from_rotvec(step[:3]).as_matrix() @ R, t / np.linalg.norm(t),
                        *(v + step[k:k + 3] for v, k in zip(rest, (5, 8, 11, 14), strict=True)))


@pytest.mark.parametrize('seed', range(3))
def test_jacobian_equals_finite_differences(seed):
    rng = np.random.default_rng(seed)
    rows, state = random_observations(rng), random_state(rng)
    exact = sampson.jacobian(rows, state)
    step = 1e-6
    for k in range(PARAMETERS):
        unit = np.zeros(PARAMETERS)
        unit[k] = step
        numeric = (sampson.residuals(rows, stepped(state, unit))
                   - sampson.residuals(rows, stepped(state, -unit))) / (2 * step)
        np.testing.assert_allclose(exact[:, k], numeric, atol=1e-6 * np.abs(numeric).max())


def constraint(rows, state):
    """``(f_1 x R f_2) . b`` with ``b = t - tau_1 d_1 + tau_2 d_2``."""
    b = state.t - rows[:, 18:19] * state.d1 + rows[:, 19:20] * state.d2
    return (np.cross(rows[:, 0:3], rows[:, 9:12] @ state.R.T) * b).sum(axis=1)


def test_residual_is_the_constraint_over_its_gradient_by_pixels():
    """The Sampson error by its definition, with differences for the derivatives."""
    rng = np.random.default_rng(1)
    rows, state = random_observations(rng, 20), random_state(rng)
    gradient = np.empty((len(rows), 4))
    for k, (ray, derivative) in enumerate(((0, 3), (0, 6), (9, 12), (9, 15))):
        ahead, back = rows.copy(), rows.copy()
        ahead[:, ray:ray + 3] += rows[:, derivative:derivative + 3]
        back[:, ray:ray + 3] -= rows[:, derivative:derivative + 3]
        # Exact: the constraint is linear in either ray.
        gradient[:, k] = (constraint(ahead, state) - constraint(back, state)) / 2.0
    np.testing.assert_allclose(
        sampson.residuals(rows, state),
        constraint(rows, state) / np.linalg.norm(gradient, axis=1), rtol=1e-10)


def test_depths_of_exact_matches():
    rng = np.random.default_rng(2)
    state = random_state(rng)
    R, t, d1, d2, _, _ = state
    rows = np.zeros((30, 20))
    rows[:, 18:] = rng.uniform(-0.03, 0.03, (30, 2))
    points1 = rng.uniform([-3.0, -3.0, 3.0], [3.0, 3.0, 12.0], (30, 3))
    # A point observed at tau_1 and tau_2: l_1 f_1 = l_2 R f_2 + t - tau_1 d_1 + tau_2 d_2.
    points2 = (points1 - t + rows[:, 18:19] * d1 - rows[:, 19:20] * d2) @ R
    depth1, depth2 = np.linalg.norm(points1, axis=1), np.linalg.norm(points2, axis=1)
    rows[:, 0:3], rows[:, 9:12] = points1 / depth1[:, None], points2 / depth2[:, None]
    for k in range(30):
        *depths, parallax, baseline = sampson.triangulated(rows, k, state)
        np.testing.assert_allclose(depths, [depth1[k], depth2[k]], rtol=1e-8)
        f1, h = rows[k, 0:3], R @ rows[k, 9:12]
        assert parallax == pytest.approx(np.linalg.norm(np.cross(f1, h)))
        moved = t - rows[k, 18] * d1 + rows[k, 19] * d2
        assert baseline == pytest.approx(np.linalg.norm(moved))
        behind = sampson.triangulated(rows, k, priors.signed(state, -1.0))
        assert behind[0] < 0.0
        assert behind[1] < 0.0


def priors_near(rng, state, **weights):
    down = state.R.T @ np.array([0.6, 0.0, 0.8])
    near = Rotation.from_rotvec([0.01, -0.02, 0.015]).as_matrix()
    root = np.sqrt(weights.get('velocity', 0.0)) * rng.normal(size=(6, 6))
    velocity = priors.VelocityPrior(
        rate=2.0, offset=rng.normal(size=6), information=root @ root.T, log_scale=0.4,
        centre=-0.3, weight=weights.get('scale', 0.0), freedom=1.7)
    values = {'gravity_weight': 0.0, 'gravity_row_time': 0.03, 'rate_weight': 0.0, **{
        k: v for k, v in weights.items() if k not in ('rotation', 'velocity', 'scale')}}
    return Priors(np.array([0.59, 0.02, 0.81]), down, rotation=near @ state.R,
                  rotation_information=np.diag([3.0, 4.0, 5.0]) * weights.get('rotation', 0.0),
                  velocity=velocity, **values)


@pytest.mark.parametrize('weights', [{'gravity_weight': 7.0}, {'rate_weight': 3.0},
                                     {'velocity': 2.0}, {'velocity': 2.0, 'scale': 3.0},
                                     {'rotation': 1.0}])
def test_gradient_of_each_prior(weights):
    rng = np.random.default_rng(1)
    # Gravity's derivative by the rates neglects their products: exact about zero.
    state = random_state(rng, 0.0 if 'gravity_weight' in weights else 0.1)
    prior = priors_near(rng, state, **weights)
    n = priors.unknowns(prior)
    assert n == PARAMETERS + ('scale' in weights)
    nothing = fit.DataTerm(np.zeros((PARAMETERS, PARAMETERS)), np.zeros(PARAMETERS), 0.0)
    _, gradient, cost = fit.with_priors(nothing, state, prior)
    assert cost == pytest.approx(priors.prior_cost(state, prior))
    assert cost > 0.0
    step = 1e-5

    def cost_after(change):
        velocity = prior.velocity
        scale = velocity.log_scale + (change[SCALE] if n > SCALE else 0.0)
        return priors.prior_cost(priors.moved(state, change), priors.at_scale(
            prior, scale, velocity.centre, velocity.freedom))

    for k in range(n):
        ahead, behind = (cost_after(sign * step * np.eye(n)[k]) for sign in (1.0, -1.0))
        # Half the gradient of a sum of squares. Log has a Jacobian that the fit takes for one.
        tolerance = 0.03 if 'rotation' in weights else 1e-6
        assert (ahead - behind) / (4 * step) == pytest.approx(
            gradient[k], abs=tolerance * (1.0 + np.abs(gradient).max())), k


def test_gravity_holds_at_the_reference_row_for_any_gyro():
    """Exact gravity at the first row, a gyro with 3 deg/s of error: no contradiction."""
    config = EstimatorConfig(pixel_sigma=0.01, gravity_sigma=1e-5, gyro_sigma=np.radians(3.0))
    errors = []
    for seed in range(5):
        scene = make_scene(seed, pixel_noise=0.0, gravity_noise=0.0, gyro_noise=np.radians(3.0),
                           outliers=0.0)
        pose = estimate_scene(scene, config)
        assert pose
        errors.append(rotation_error(pose.R, scene.R))
    # With exact gravity at the middle row these are 0.13 to 3.3 deg.
    assert np.median(errors) < 0.05
