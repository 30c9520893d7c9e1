"""The joint fit's priors against finite differences of their cost, and of what they claim."""

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from rs_relpose_ros import (
    estimate_relative_pose,
    EstimatorConfig,
    FrameMotion,
    RollingShutterCamera,
)
from rs_relpose_ros.estimator import map_fit
from rs_relpose_ros.estimator.priors import (
    prior_cost,
    Priors,
    unknowns,
    VelocityPrior,
    with_log_scale,
)
from rs_relpose_ros.estimator.state import moved, PARAMETERS, SCALE, TwoViewState


def some_state(rng, rate):
    R = Rotation.from_rotvec(rng.normal(size=3)).as_matrix()
    t, d1, d2, dw1, dw2 = rng.normal(size=(5, 3))
    return TwoViewState(R, t / np.linalg.norm(t), d1, d2, rate * dw1, rate * dw2)


def some_priors(rng, state, **weights):
    # Near the state: the turn from the gyro's rotation is a small one.
    down = state.R.T @ np.array([0.6, 0.0, 0.8])
    near = Rotation.from_rotvec([0.01, -0.02, 0.015]).as_matrix()
    root = rng.normal(size=(6, 6))
    velocity = VelocityPrior(
        rate=2.0, offset=rng.normal(size=6), information=weights.get('velocity', 0.0) * root @ root.T,
        log_scale=0.4, centre=-0.3, weight=weights.get('scale', 0.0), freedom=1.7)
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
    # The rates' part of gravity neglects what corrections do to each other: exact about zero.
    state = some_state(rng, 0.0 if 'gravity_weight' in weights else 0.1)
    priors = some_priors(rng, state, **weights)
    n = unknowns(priors)
    assert n == PARAMETERS + ('scale' in weights)
    nothing = map_fit.DataTerm(np.zeros((PARAMETERS, PARAMETERS)), np.zeros(PARAMETERS), 0.0)
    _, gradient, cost = map_fit.normal_equations(nothing, state, priors)
    assert cost == pytest.approx(prior_cost(state, priors))
    assert cost > 0.0
    step = 1e-5

    def cost_after(change):
        scale = priors.velocity.log_scale + (change[SCALE] if n > SCALE else 0.0)
        return prior_cost(moved(state, change), with_log_scale(priors, scale))

    for k in range(n):
        ahead, behind = (cost_after(sign * step * np.eye(n)[k]) for sign in (1.0, -1.0))
        # Half the gradient of a sum of squares. Log has a Jacobian that the fit takes for one.
        tolerance = 0.03 if 'rotation' in weights else 1e-6
        assert (ahead - behind) / (4 * step) == pytest.approx(
            gradient[k], abs=tolerance * (1.0 + np.abs(gradient).max())), k


def test_gravity_holds_at_the_reference_row_whatever_the_gyro_says():
    """Exact gravity at the first row, a gyro off by 3 deg/s: the two must not contradict."""
    camera = RollingShutterCamera(width=1920, height=1080, fx=640.0, fy=640.0, cx=959.5, cy=539.5,
                                  readout_time=0.0648)
    config = EstimatorConfig(pixel_sigma=0.01, gravity_sigma=1e-5, gyro_sigma=np.radians(3.0))
    errors = []
    for seed in range(5):
        rng = np.random.default_rng(seed)
        turn = Rotation.from_rotvec(rng.uniform(-0.15, 0.15, 3))
        t, w = np.array([2.0, 0.1, -0.2]), rng.choice([-1.0, 1.0], 3)
        v = rng.choice([-1.0, 1.0], 3)
        world = np.column_stack([rng.uniform(-1.2, 1.2, (400, 2)), np.ones(400)]) \
            * rng.uniform(6.0, 34.0, (400, 1))
        views = [np.full((len(world), 2), np.nan) for _ in range(2)]
        frames = ((Rotation.identity(), np.zeros(3), w, v), (turn, t, -w, turn.apply(-v)))
        for pixels, (start, position, rate, velocity) in zip(views, frames, strict=True):
            rows = np.full(len(world), 539.5)
            for _ in range(30):   # the row that sees a point depends on where it is then
                tau = rows * camera.line_delay
                local = (start * Rotation.from_rotvec(tau[:, None] * rate)).inv().apply(
                    world - position - tau[:, None] * velocity)
                rows = np.clip(camera.project(local)[:, 1], -500.0, 1600.0)
            pixels[:] = camera.project(local)
        seen = np.all([((0 < p) & (p < (1919, 1079))).all(axis=1) for p in views], axis=0)
        down = np.array([0.0, 1.0, 0.0])
        noise = np.radians(3.0) * rng.standard_normal((2, 3))
        pose = estimate_relative_pose(
            views[0][seen], views[1][seen], camera, FrameMotion(w + noise[0], down),
            FrameMotion(-w + noise[1], turn.inv().apply(down)), config=config)
        assert pose
        errors.append(np.degrees((turn.inv() * Rotation.from_matrix(pose.R)).magnitude()))
    # With gravity taken for exact at the middle row these are 0.13 to 3.3 deg.
    assert np.median(errors) < 0.05
