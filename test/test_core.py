"""The measurement core: residual of a match, depths, losses, least squares."""

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from rs_relpose_ros.core import epipolar, least_squares, losses, triangulate


def random_views(rng, n=40):
    """Return views (n, 2, 3, 3) of matches that are not far from their epipolar lines, and b."""
    views = rng.normal(size=(n, 2, 3, 3)) * 0.3
    views[:, :, 0, 2] += 1.0
    views[:, :, 1:] /= 500.0
    return views, rng.normal(size=(n, 3))


def by_differences(function, size, step=1e-6):
    """Return the derivative (N, size) of residuals by central differences."""
    columns = [
        (function(step * unit) - function(-step * unit)) / (2 * step) for unit in np.eye(size)
    ]
    return np.transpose(columns)


def test_residual_of_a_match_is_the_constraint_over_its_gradient_by_pixels():
    views, baselines = random_views(np.random.default_rng(1))

    def constraint(pixels):  # (N, 4) steps of the two pixels
        f, h = (
            views[:, k, 0] + np.einsum('nij,ni->nj', views[:, k, 1:], pixels[:, 2 * k : 2 * k + 2])
            for k in range(2)
        )
        return (np.cross(f, h) * baselines).sum(axis=1)

    still = np.zeros((len(views), 4))
    gradient = by_differences(
        lambda step: constraint(still + step), 4, step=1e-2
    )  # linear in each
    expected = constraint(still) / np.linalg.norm(gradient, axis=1)
    found = epipolar.derivatives(views, baselines).residuals
    np.testing.assert_allclose(found, expected, rtol=1e-9)


def test_derivatives_of_a_match_equal_finite_differences():
    views, baselines = random_views(np.random.default_rng(2))
    found = epipolar.derivatives(views, baselines)

    def moved(step):
        return epipolar.derivatives(views, baselines + step).residuals

    def check(exact, function, step):
        numeric = by_differences(function, 3, step)
        np.testing.assert_allclose(exact, numeric, atol=1e-6 * np.abs(numeric).max())

    check(found.by_baseline, moved, 1e-6)
    for image in range(2):

        def turned(step, image=image):
            changed = views.copy()
            changed[:, image] = views[:, image] @ Rotation.from_rotvec(step).as_matrix().T
            return epipolar.derivatives(changed, baselines).residuals

        check(found.by_rotation[:, image], turned, 1e-6)
        for vector in range(3):

            def shifted(step, image=image, vector=vector):
                changed = views.copy()
                changed[:, image, vector] += step
                return epipolar.derivatives(changed, baselines).residuals

            check(found.by_rays[:, image, vector], shifted, 1e-6 if vector == 0 else 1e-8)


def test_depths_are_those_of_points_in_front_of_and_behind_the_cameras():
    rng = np.random.default_rng(3)
    baselines = rng.normal(size=(30, 3))
    true_depths = rng.uniform(2.0, 9.0, (30, 2))
    true_depths[::3] *= -1.0
    h = rng.normal(size=(30, 3))
    h /= np.linalg.norm(h, axis=1, keepdims=True)
    f = baselines + true_depths[:, 1:] * h
    lengths = np.linalg.norm(f, axis=1) * np.sign(true_depths[:, 0])
    f /= lengths[:, None]
    for k in range(30):
        along_f, along_h, sine = triangulate.depths(f[k], h[k], baselines[k])
        assert along_f == pytest.approx(lengths[k]) and along_h == pytest.approx(true_depths[k, 1])
        assert sine == pytest.approx(np.linalg.norm(np.cross(f[k], h[k])))
    l1, l2, usable = triangulate.depths_of_rays(f, h, baselines, 1e-9)
    np.testing.assert_array_equal(usable, true_depths[:, 1] > 0.0)
    np.testing.assert_allclose(l1[usable], lengths[usable])
    np.testing.assert_allclose(l2[usable], true_depths[usable, 1])
    assert np.isnan(triangulate.depths(f[0], f[0], baselines[0])[:2]).all()


@pytest.mark.parametrize(
    ('cost', 'weight'),
    [
        (losses.cauchy_cost, losses.cauchy_weight),
        (losses.geman_mcclure_cost, losses.geman_mcclure_weight),
    ],
)
def test_weight_of_a_loss_is_the_derivative_of_its_cost(cost, weight):
    q = np.array([1e-3, 0.3, 1.0, 20.0])
    numeric = (cost(q * (1 + 1e-6)) - cost(q * (1 - 1e-6))) / (2e-6 * q)
    np.testing.assert_allclose(weight(q), numeric, rtol=1e-7)
    assert cost(1e-9) == pytest.approx(1e-9)
    assert weight(0.3) == pytest.approx(weight(q)[1])


def test_robust_scale_is_the_sigma_of_normal_deviates_despite_outliers():
    residuals = 0.7 * np.random.default_rng(4).normal(size=4000)
    residuals[:200] = 1e6
    assert losses.robust_scale(residuals, 0.0, 0.0) == pytest.approx(0.7, rel=0.1)
    assert losses.robust_scale(residuals, 3.0, 0.0) == 3.0
    assert losses.robust_scale(residuals[-8:], 0.0, 6.0) == pytest.approx(
        2.0 * losses.robust_scale(residuals[-8:], 0.0, 0.0)
    )


def random_information(rng, n):
    J = rng.normal(size=(n + 3, n))
    return J.T @ J


def test_eliminated_unknowns_are_at_the_optimum_for_the_kept_ones():
    rng = np.random.default_rng(5)
    H = random_information(rng, 7)
    g = rng.normal(size=7)
    kept = rng.normal(size=3)
    own = np.linalg.solve(H[3:, 3:], -g[3:] - H[3:, :3] @ kept)
    x = np.concatenate([kept, own])
    H_kept, g_kept = least_squares.eliminate(H, g, 3)
    still = np.concatenate([np.zeros(3), np.linalg.solve(H[3:, 3:], -g[3:])])
    gain = (x @ H @ x + 2 * g @ x) - (still @ H @ still + 2 * g @ still)
    assert kept @ H_kept @ kept + 2 * g_kept @ kept == pytest.approx(gain, rel=1e-9)
    H[5:], H[:, 5:], g[5:] = 0.0, 0.0, 0.0  # nothing is known about two of the others
    expected = H[:3, :3] - H[:3, 3:5] @ np.linalg.solve(H[3:5, 3:5], H[3:5, :3])
    np.testing.assert_allclose(least_squares.eliminate(H, g, 3)[0], expected, rtol=1e-9)


def test_damped_step_is_newtons_without_damping_and_short_with_it():
    rng = np.random.default_rng(6)
    H = random_information(rng, 5)
    g = rng.normal(size=5)
    step, gain = least_squares.damped_step(H, g, 0.0)
    np.testing.assert_allclose(step, np.linalg.solve(H, -g), rtol=1e-9)
    assert gain == pytest.approx(-g @ step)
    damped, less = least_squares.damped_step(H, g, 1e3)
    np.testing.assert_allclose(damped, np.linalg.solve(H + 1e3 * np.diag(np.diag(H)), -g))
    assert 0.0 < less < gain
    assert least_squares.damped_step(-H, g, 0.0)[1] < 0.0


def test_groups_are_solved_as_their_matrices_one_by_one():
    rng = np.random.default_rng(7)
    matrices = np.array([random_information(rng, 4) for _ in range(9)])
    right = rng.normal(size=(9, 4))
    own = np.ascontiguousarray(np.moveaxis(matrices, 0, 2))
    values = right.T.copy()
    factors = np.zeros_like(own)
    lower = np.empty_like(values)
    least_squares.factor_groups(own, factors)
    least_squares.solve_lower_groups(factors, values, lower)
    roots = np.linalg.cholesky(matrices)
    np.testing.assert_allclose(lower.T, np.linalg.solve(roots, right[..., None])[..., 0])
    least_squares.solve_upper_groups(factors, lower)
    np.testing.assert_allclose(lower.T, np.linalg.solve(matrices, right[..., None])[..., 0])


def test_covariance_by_groups_is_that_of_correlated_errors():
    """Of a mean per unknown: groups of four equal errors count as one observation each."""
    rng = np.random.default_rng(8)
    groups = 30
    found = []
    J = rng.normal(size=(groups, 4, 2))
    curvatures = np.einsum('gki,gkj->gij', J, J)
    hessian = curvatures.sum(axis=0)
    inverse = np.linalg.inv(hessian)
    true = sum(inverse @ j.sum(axis=0)[:, None] @ j.sum(axis=0)[None] @ inverse for j in J)
    for _ in range(400):
        r = np.repeat(rng.normal(size=groups), 4).reshape(groups, 4)
        r = r - J @ (inverse @ np.einsum('gki,gk->i', J, r))  # at the optimum
        scores = np.einsum('gki,gk->gi', J, r)
        of_shares = []
        for share in (0.0, least_squares.CR2, least_squares.JACKKNIFE):
            adjusted = least_squares.adjusted_scores(scores, curvatures, hessian, share)
            of_shares.append(np.diag(inverse @ adjusted.T @ adjusted @ inverse))
        found.append(of_shares)
    plain, cr2, jackknife = np.mean(found, axis=0) / np.diag(true)
    assert (plain < cr2).all() and (cr2 < jackknife).all()
    np.testing.assert_allclose(cr2, 1.0, atol=0.08)
