"""Moving a pose between reference rows, and inverting it: against motion written out in full."""

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from rs_relpose_ros.estimator.problem import PairState, to_reference_row
from rs_relpose_ros.estimator.result import RelativePose, Status


def make_state(rng, covariance=None):
    t = rng.normal(size=3)
    return PairState(
        Rotation.from_rotvec(rng.normal(size=3) * 0.3).as_matrix(), t / np.linalg.norm(t),
        rng.normal(size=3), rng.normal(size=3), rng.normal(size=3), rng.normal(size=3),
        rng.normal(), np.zeros((19, 19)) if covariance is None else covariance)


def turns(state, delay):
    return (Rotation.from_rotvec(state.w1 * delay).as_matrix(),
            Rotation.from_rotvec(state.w2 * delay).as_matrix())


def moved(state, delay):
    return to_reference_row(state, delay, *turns(state, delay))


def test_pose_between_later_rows():
    """Camera i at row time tau: orientation R_i Exp(w_i tau), position p_i + R_i v_i tau."""
    rng = np.random.default_rng(0)
    state, delay = make_state(rng), 0.02
    R1, p1 = Rotation.random(random_state=1).as_matrix(), rng.normal(size=3)
    R2, p2 = R1 @ state.R, p1 + R1 @ state.t
    later1 = R1 @ Rotation.from_rotvec(state.w1 * delay).as_matrix()
    later2 = R2 @ Rotation.from_rotvec(state.w2 * delay).as_matrix()
    baseline = later1.T @ (p2 + R2 @ state.v2 * delay - p1 - R1 @ state.v1 * delay)
    scale = np.linalg.norm(baseline)
    result = moved(state, delay)
    np.testing.assert_allclose(result.R, later1.T @ later2, atol=1e-12)
    np.testing.assert_allclose(result.t, baseline / scale, atol=1e-12)
    np.testing.assert_allclose(result.v1, later1.T @ R1 @ state.v1 / scale, atol=1e-12)
    np.testing.assert_allclose(result.v2, later2.T @ R2 @ state.v2 / scale, atol=1e-12)
    assert result.log_baseline == pytest.approx(state.log_baseline + np.log(scale), abs=1e-12)


def test_there_and_back():
    state = make_state(np.random.default_rng(1))
    back = moved(moved(state, 0.015), -0.015)
    for name in ('R', 't', 'v1', 'v2', 'log_baseline'):
        np.testing.assert_allclose(getattr(back, name), getattr(state, name), atol=1e-12)


def test_covariance_follows_the_move():
    """First-order covariance against samples: perturb, move, measure."""
    rng = np.random.default_rng(2)
    state, delay = make_state(rng), 0.03
    factor = 1e-5 * rng.normal(size=(19, 19))
    projector = np.eye(3) - np.outer(state.t, state.t)
    factor[:3] = projector @ factor[:3]
    result = to_reference_row(
        PairState(state.R, state.t, state.v1, state.v2, state.w1, state.w2, state.log_baseline,
                  factor @ factor.T),
        delay, *turns(state, delay))
    errors = []
    for _ in range(4000):
        e = factor @ rng.normal(size=19)
        true = PairState(Rotation.from_rotvec(e[3:6]).as_matrix() @ state.R, state.t + e[0:3],
                         state.v1 + e[6:9], state.v2 + e[9:12], state.w1 + e[12:15],
                         state.w2 + e[15:18], state.log_baseline + e[18], np.zeros((19, 19)))
        # The rates' errors turn the rows from the left, as the gyro corrections do.
        turn1, turn2 = turns(state, delay)
        turn1 = Rotation.from_rotvec(delay * e[12:15]).as_matrix() @ turn1
        turn2 = Rotation.from_rotvec(delay * e[15:18]).as_matrix() @ turn2
        true = to_reference_row(true, delay, turn1, turn2)
        errors.append(np.concatenate([
            true.t - result.t, Rotation.from_matrix(true.R @ result.R.T).as_rotvec(),
            true.v1 - result.v1, true.v2 - result.v2,
            [true.log_baseline - result.log_baseline]]))
    sampled = np.cov(np.array(errors).T)
    kept = [*range(12), 18]
    expected = result.covariance[np.ix_(kept, kept)]
    sigma = np.sqrt(np.diag(expected))
    # 4000 samples: correlations to about 0.02, one sigma.
    np.testing.assert_allclose(sampled / np.outer(sigma, sigma),
                               expected / np.outer(sigma, sigma), atol=0.12)


def test_inverse_pose_and_its_covariance():
    rng = np.random.default_rng(3)
    state = make_state(rng)
    factor = 1e-5 * rng.normal(size=(6, 6))
    factor[:3] = (np.eye(3) - np.outer(state.t, state.t)) @ factor[:3]
    pose = RelativePose(Status.OK, R=state.R, t=state.t, linear_velocity1=state.v1,
                        linear_velocity2=state.v2, covariance=factor @ factor.T)
    inverse = pose.inverse()
    point2 = rng.normal(size=3)
    point1 = pose.R @ point2 + pose.t
    np.testing.assert_allclose(inverse.R @ point1 + inverse.t, point2, atol=1e-12)
    np.testing.assert_array_equal(inverse.linear_velocity1, state.v2)
    errors = []
    for _ in range(4000):
        e = factor @ rng.normal(size=6)
        R = Rotation.from_rotvec(e[3:]).as_matrix() @ state.R
        errors.append(np.concatenate([
            -R.T @ (state.t + e[:3]) - inverse.t,
            Rotation.from_matrix(R.T @ inverse.R.T).as_rotvec()]))
    sigma = np.sqrt(np.diag(inverse.covariance))
    np.testing.assert_allclose(np.cov(np.array(errors).T) / np.outer(sigma, sigma),
                               inverse.covariance / np.outer(sigma, sigma), atol=0.12)
    np.testing.assert_allclose(inverse.inverse().covariance, pose.covariance, atol=1e-18)
