"""The Sampson error: against its definition, its Jacobian, and triangulation."""

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from rs_relpose_ros.estimator import sampson
from rs_relpose_ros.estimator.state import D2, PARAMETERS, signed, TwoViewState
from rs_relpose_ros.geometry.vectors import tangent_basis


def random_observations(rng, n=50):
    """Observation rows that obey no model: every term of the Jacobian is exercised."""
    rows = rng.normal(size=(n, 20)) * 0.3
    rows[:, [2, 11]] += 1.0
    rows[:, 3:9] /= 500.0
    rows[:, 12:18] /= 500.0
    rows[:, 18:] *= 0.05
    return rows


def random_state(rng):
    t = rng.normal(size=3)
    return TwoViewState(
        Rotation.from_rotvec(rng.normal(size=3) * 0.3).as_matrix(), t / np.linalg.norm(t),
        rng.normal(size=3) * 2.0, rng.normal(size=3) * 2.0, np.zeros(3), np.zeros(3))


def stepped(state, step):
    R, t, d1, d2, dw1, dw2 = state
    t = t + tangent_basis(t) @ step[3:5]
    return TwoViewState(
        Rotation.from_rotvec(step[:3]).as_matrix() @ R, t / np.linalg.norm(t), d1 + step[5:8],
        d2 + step[8:11], dw1 + step[11:14], dw2 + step[14:17])


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


def test_a_frozen_denominator_would_fail_the_comparison():
    """The usual shortcut, d(e)/s, is a different derivative: the test above can tell."""
    rng = np.random.default_rng(0)
    rows, state = random_observations(rng), random_state(rng)
    R, t, d1, d2, _, _ = state
    f1, h = rows[:, 0:3], rows[:, 9:12] @ R.T
    b = t - rows[:, 18:19] * d1 + rows[:, 19:20] * d2
    e = np.einsum('ni,ni->n', np.cross(f1, h), b)
    shortcut = np.cross(f1, h) * (sampson.residuals(rows, state) / e)[:, None]
    exact = sampson.jacobian(rows, state)[:, D2:D2 + 3] / rows[:, 19:20]
    assert np.abs(shortcut - exact).max() > 0.05 * np.abs(exact).max()


def test_residual_is_the_constraint_over_its_gradient_by_pixels():
    """The Sampson error by its definition, with differences for the derivatives."""
    rng = np.random.default_rng(1)
    rows, state = random_observations(rng, 20), random_state(rng)
    R, t, d1, d2, _, _ = state

    def constraint(rows):
        b = t - rows[:, 18:19] * d1 + rows[:, 19:20] * d2
        return np.einsum('ni,ni->n', np.cross(rows[:, 0:3], rows[:, 9:12] @ R.T), b)

    gradient = np.empty((len(rows), 4))
    for k, (ray, derivative) in enumerate(((0, 3), (0, 6), (9, 12), (9, 15))):
        ahead, back = rows.copy(), rows.copy()
        ahead[:, ray:ray + 3] += rows[:, derivative:derivative + 3]
        back[:, ray:ray + 3] -= rows[:, derivative:derivative + 3]
        # Exact: the constraint is linear in either ray.
        gradient[:, k] = (constraint(ahead) - constraint(back)) / 2.0
    np.testing.assert_allclose(sampson.residuals(rows, state),
                               constraint(rows) / np.linalg.norm(gradient, axis=1), rtol=1e-10)


def test_depths_of_exact_matches():
    rng = np.random.default_rng(2)
    state = random_state(rng)
    R, t, d1, d2, _, _ = state
    rows = np.zeros((30, 20))
    rows[:, 18:] = rng.uniform(-0.03, 0.03, (30, 2))
    points1 = rng.uniform([-3.0, -3.0, 3.0], [3.0, 3.0, 12.0], (30, 3))
    # A point seen at tau_1 and tau_2: l_1 f_1 = l_2 R f_2 + t - tau_1 d_1 + tau_2 d_2.
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
        behind = sampson.triangulated(rows, k, signed(state, -1.0))
        assert behind[0] < 0.0
        assert behind[1] < 0.0
