"""Frames between the two of a pair: derivatives, an independent fit, covariance, bad input."""

from dataclasses import replace
import math

import numpy as np
import pytest
from scipy.optimize import least_squares
from scipy.spatial.transform import Rotation

from rs_relpose_ros import estimate_relative_pose, EstimatorConfig, InputError, Status
from rs_relpose_ros.core import reprojection
from rs_relpose_ros.core.deviations import LENS, N_DEVIATIONS, PARTS
from rs_relpose_ros.core.rows import row_states, RowsOfFrames, turned_frames
from rs_relpose_ros.estimator import adjustment, frames_between
from rs_relpose_ros.estimator.arguments import IntermediateFrame
from rs_relpose_ros.geometry.camera import RollingShutterCamera
from rs_relpose_ros.geometry.gyro import GyroPath
from rs_relpose_ros.geometry.motion import FrameMotion, InertialMotion
from rs_relpose_ros.geometry.so3 import tangent_basis

CAMERA = RollingShutterCamera(
    width=640,
    height=480,
    fx=450.0,
    fy=455.0,
    cx=322.0,
    cy=238.0,
    distortion=(-0.1, 0.02, 0.0, 0.0),
    readout_time=0.03,
)
TIMES = np.array([0.0, 0.07, 0.13, 0.2, 0.27])  # of the reference rows [s]
ARM = np.array([0.03, -0.01, 0.02])
SIGMA = 0.3  # of a pixel's coordinates
GYRO_WALK, BIAS_SIGMA = 5e-4, 2e-3  # [rad/sqrt(s)], [rad/s]
GRAVITY_ERROR = np.array([0.3, -0.5, 0.2])
R_CAM_IMU = Rotation.from_rotvec([0.3, -0.2, 0.5]).as_matrix()


class Motion:
    """A smooth motion of the camera in the axes of its frame at time 0; an IMU on a lever arm."""

    def __init__(self, rng):
        self.velocity = rng.normal([0.5, 0.0, 0.3], 0.6)
        self.acceleration = rng.normal(0.0, 2.0, 3)
        self.jerk = rng.normal(0.0, 10.0, 3)
        self.rate = rng.normal(0.0, 0.3, 3)
        self.angular_acceleration = rng.normal(0.0, 1.0, 3)

    def R(self, s):
        s = np.asarray(s, dtype=float)[..., None]
        return (
            Rotation.from_rotvec(
                (self.rate * s + 0.5 * self.angular_acceleration * s**2).reshape(-1, 3)
            )
            .as_matrix()
            .reshape(*s.shape[:-1], 3, 3)
        )

    def p(self, s):
        s = np.asarray(s, dtype=float)[..., None]
        return self.velocity * s + self.acceleration * s**2 / 2.0 + self.jerk * s**3 / 6.0

    def gyro(self, s):
        """Rate in the axes of the camera, by a central difference."""
        h = 1e-5
        return Rotation.from_matrix(
            np.swapaxes(self.R(s - h), -1, -2) @ self.R(s + h)
        ).as_rotvec() / (2.0 * h)

    def frame(self, s):
        samples = np.linspace(-0.01, 0.04, 51)
        return FrameMotion.from_gyro(samples, self.gyro(s + samples))

    def inertial(self, s, gravity_error):
        """From time 0 to s, with an error of gravity."""
        h = 1e-3

        def q(x):
            return self.p(x) + self.R(x) @ ARM

        def velocity(x):
            return (q(x + h) - q(x - h)) / (2.0 * h)

        def acceleration(x):
            return (q(x + h) - 2.0 * q(x) + q(x - h)) / h**2 + gravity_error

        return InertialMotion(
            q(s) - q(0.0) - s * velocity(0.0) + 0.5 * s * s * gravity_error,
            velocity(s) - velocity(0.0) + s * gravity_error,
            s,
            np.diag([0.5 * s * s] * 3 + [s] * 3) ** 2,
            ARM,
            acceleration(0.0),
            acceleration(s),
        )


class Scene:
    """Noisy tracks and IMU data of a motion, as arguments of `estimate_relative_pose`."""

    def __init__(self, seed, sigma=SIGMA, gyro=1.0, count=150):
        rng = np.random.default_rng(seed)
        self.motion = motion = Motion(rng)
        ends = TIMES[-1]
        rays = CAMERA.unproject(rng.uniform([30, 30], [610, 450], (8 * count, 2)))
        points = rays * rng.uniform(2.0, 10.0, (8 * count, 1))
        pixels = np.array([self.observe(points, s) for s in TIMES])
        visible = ((pixels > 5.0) & (pixels < [635.0, 475.0])).all(axis=(0, 2))
        pixels = pixels[:, visible][:, :count] + rng.normal(0.0, sigma, (len(TIMES), count, 2))
        steps = np.diff(TIMES, prepend=0.0)
        off = gyro * (
            np.cumsum(
                rng.normal(0.0, GYRO_WALK, (len(TIMES), 3)) * np.sqrt(steps)[:, None], axis=0
            )
            + TIMES[:, None] * rng.normal(0.0, BIAS_SIGMA, 3)
        )
        rotations = [
            Rotation.from_rotvec(o).as_matrix().T @ motion.R(s)
            for o, s in zip(off, TIMES, strict=True)
        ]
        covariances = [(GYRO_WALK**2 * s + BIAS_SIGMA**2 * s * s) * np.eye(3) for s in TIMES]
        self.R = motion.R(ends)
        self.t = motion.p(ends) / np.linalg.norm(motion.p(ends))
        self.baseline = np.linalg.norm(motion.p(ends))
        error = gyro * GRAVITY_ERROR
        self.between = [
            IntermediateFrame(
                pixels[k],
                motion.frame(TIMES[k]),
                TIMES[k],
                rotations[k],
                covariances[k],
                motion.inertial(TIMES[k], error),
            )
            for k in range(1, len(TIMES) - 1)
        ]
        self.arguments = {
            'points1': pixels[0],
            'points2': pixels[-1],
            'camera': CAMERA,
            'motion1': motion.frame(0.0),
            'motion2': motion.frame(ends),
            'relative_rotation': rotations[-1],
            'relative_rotation_covariance': covariances[-1],
            'interval': ends,
            'inertial': motion.inertial(ends, error),
        }

    def observe(self, points, s):
        """Pixels (N, 2): each row sees the camera at its own time."""
        row = np.full(len(points), 240.0)
        for _ in range(12):
            at = s + CAMERA.row_times(row)
            seen = CAMERA.project(
                np.einsum('nji,nj->ni', self.motion.R(at), points - self.motion.p(at))
            )
            row = seen[:, 1]
        return seen

    def pose(self, **changes):
        return estimate_relative_pose(**{**self.arguments, 'between': self.between, **changes})

    def error(self, pose):
        """Error (6,) of t and R [rad], and of the logarithm of the baseline."""
        across = self.t - (self.t @ pose.t) * pose.t
        turn = Rotation.from_matrix(self.R @ pose.R.T).as_rotvec()
        return np.r_[across, turn], math.log(pose.baseline / self.baseline)


@pytest.fixture(scope='module')
def scene():
    return Scene(3)


@pytest.fixture
def fitted(scene, monkeypatch):
    """Arguments and result of the adjustment of a scene."""
    calls = []
    adjust = adjustment.adjust

    def record(*arguments):
        calls.append((arguments, adjust(*arguments)))
        return calls[-1][1]

    monkeypatch.setattr(frames_between.adjustment, 'adjust', record)
    pose = scene.pose()
    arguments, adjusted = calls[-1]
    return pose, arguments, adjusted


def test_exact_data_give_the_true_pose():
    scene = Scene(1, sigma=1e-4, gyro=1e-3)
    pose = scene.pose()
    error, log_baseline = scene.error(pose)
    assert pose.diagnostics.frames == len(TIMES) and pose.diagnostics.frames_reason == ''
    # Limits: the acceleration within the readouts is constant in the model, here it has a jerk.
    assert np.abs(error[:3]).max() < 2e-4 and np.abs(error[3:]).max() < 2e-5
    assert abs(log_baseline) < 0.01
    ends = TIMES[-1]
    for velocity, at in ((pose.linear_velocity1, 0.0), (pose.linear_velocity2, ends)):
        true = (
            scene.motion.R(at).T
            @ (scene.motion.p(at + 1e-5) - scene.motion.p(at - 1e-5))
            / (2e-5 * scene.baseline)
        )
        np.testing.assert_allclose(velocity, true, atol=0.02)


def test_all_frames_beat_two_views():
    scenes = [Scene(seed) for seed in range(20, 32)]
    errors = np.array(
        [
            [
                np.linalg.norm(scene.error(scene.pose(between=between))[0][part])
                for between in ((), scene.between)
                for part in (slice(3), slice(3, 6))
            ]
            for scene in scenes
        ]
    )
    two_t, two_R, all_t, all_R = np.median(errors, axis=0)
    assert all_t < 0.7 * two_t and all_R < two_R


def test_covariance_is_that_of_the_errors():
    chi2 = []
    logs = []
    lengths = []
    starts = []
    by_gyro = []
    for seed in range(100, 140):
        scene = Scene(seed)
        pose = scene.pose()
        error, log_baseline = scene.error(pose)
        assert pose.diagnostics.frames == len(TIMES)
        np.testing.assert_allclose(pose.covariance[:3, :3] @ pose.t, 0.0, atol=1e-12)
        chi2.append(error @ np.linalg.pinv(pose.covariance, rcond=1e-9) @ error / 5.0)
        logs.append(log_baseline / pose.baseline_log_sigma)
        lengths.append(pose.diagnostics.pixel_sigma)
        start = scene.motion.p(1e-5) - scene.motion.p(-1e-5)
        across = np.linalg.svd(pose.linear_velocity1[None])[2][1:]
        off = across @ start / np.linalg.norm(start) * np.linalg.norm(pose.linear_velocity1)
        starts.append(
            off @ np.linalg.solve(across @ pose.linear_velocity1_covariance @ across.T, off) / 2.0
        )
        by_gyro.append(pose.diagnostics.gyro_square / 3.0)
    # Mean of 40 chi-squares of 5 degrees of freedom, by freedom: 1 +- 0.1.
    assert 0.7 < np.mean(chi2) < 1.4
    assert np.isfinite(logs).sum() > 30 and 0.5 < np.nanmean(np.square(logs)) < 1.8
    assert abs(np.median(lengths) - SIGMA) < 0.04
    # Mean of 40 of 2 degrees of freedom: +- 0.16. The gyro's rotation is a prior of the pose's.
    assert 0.5 < np.mean(starts) < 1.6
    assert 0.2 < np.mean(by_gyro) < 1.2


class Late(Scene):
    """Images are exposed at other times than stamped; the truth is that of the exposures."""

    def __init__(self, seed, sigma):
        self.delays = np.random.default_rng(seed).exponential(sigma, len(TIMES))
        super().__init__(seed)
        first, last = TIMES[[0, -1]] + self.delays[[0, -1]]
        R = self.motion.R(np.array([first, last]))
        p = self.motion.p(np.array([first, last]))
        t = R[0].T @ (p[1] - p[0])
        self.R = R[0].T @ R[1]
        self.t = t / np.linalg.norm(t)

    def observe(self, points, s):
        return super().observe(points, s + self.delays[int(np.argmin(np.abs(TIMES - s)))])


def test_covariance_contains_errors_of_the_stamps_of_each_frame():
    sigma = 0.006
    chi2 = {0.0: [], 0.006: []}
    for seed in range(200, 225):
        scene = Late(seed, sigma)
        for stated, found in chi2.items():
            pose = scene.pose(config=EstimatorConfig(stamp_sigma=stated))
            if pose and pose.diagnostics.frames == len(TIMES):
                error = scene.error(pose)[0]
                found.append(error @ np.linalg.pinv(pose.covariance, rcond=1e-9) @ error / 5.0)
    assert len(chi2[sigma]) > 15
    assert np.mean(chi2[sigma]) < 1.4 and np.mean(chi2[0.0]) > 5.0


def without_limit(sigma):
    """Noise [px] with which all observations count."""
    return reprojection.Noise(sigma * sigma, math.inf)


def cost_of(state, arguments, sigma):
    tracks, priors, *_ = arguments
    noise = reprojection.Noise(sigma**2, (adjustment._FARTHEST * sigma) ** 2)
    normal = adjustment.linearised(tracks, priors, state, noise)
    return adjustment._cost(normal, tracks, sigma, noise.farthest)[0], normal


def test_derivatives_are_those_of_the_cost(fitted):
    """The tracks move with the path, so that the reduced gradient is that of the cost."""
    _, arguments, _ = fitted
    # Without rotations, whose first order is used.
    state = arguments[2]
    sigma = 0.4
    state = state._replace(bias=np.zeros(3), rotations=np.zeros_like(state.rotations))
    _, normal = cost_of(state, arguments, sigma)
    normal.tracks[:, -1] = 0.0
    for k in range(len(normal.gradient)):
        step = np.zeros(len(normal.gradient))
        step[k] = 1e-3 / math.sqrt(normal.hessian[k, k])
        up, down = (
            cost_of(adjustment.moved_state(state, normal, sign * step), arguments, sigma)[0]
            for sign in (1.0, -1.0)
        )
        half = 0.25 * (up - down) / step[k]
        # In sigmas of the unknown: far below the noise.
        assert abs(half - normal.gradient[k]) < 3e-3 * math.sqrt(normal.hessian[k, k]), k


def converged(arguments, state):
    """The optimum with the noise held, by Gauss-Newton steps."""
    tracks, priors, _, expected, *_ = arguments
    for _ in range(6):
        normal = adjustment.linearised(tracks, priors, state, without_limit(expected))
        step = np.linalg.solve(normal.hessian, -normal.gradient)
        state = adjustment.moved_state(state, normal, step)
    return state


def from_state(state, other):
    """Difference (n,) of the unknowns of two near paths."""
    return np.concatenate(
        [
            tangent_basis(state.t).T @ (other.t - state.t),
            [other.log_scale - state.log_scale],
            other.bias - state.bias,
            (other.accelerations - state.accelerations).ravel(),
            (other.rotations - state.rotations)[1:].ravel(),
        ]
    )


def with_changes(tracks, changes, step):
    """The observations after a step of the deviations (D,) and of the errors of each frame."""
    V, N = changes.rows.times.shape
    rows = tracks.observations.copy()
    flat = np.moveaxis(rows, 2, 3).reshape(V, -1, reprojection.VALUES)
    for v in range(V):
        first, end = changes.rows.first_knots[v : v + 2]
        path = GyroPath(*(values[first:end] for values in changes.rows.path))
        times = changes.rows.times[v]
        states = row_states(path, R_CAM_IMU, times, changes.rows.shares[v])
        of_frame = step[N_DEVIATIONS:].reshape(V, -1)[v]
        rate = of_frame[:3] + of_frame[3] * changes.rate_changes[v]
        turned = states.by_deviation @ step[:N_DEVIATIONS] + np.outer(times, rate)
        later = states.time_by_deviation @ step[:N_DEVIATIONS] + of_frame[3]
        of_lens = changes.lens[v] @ step[LENS]
        own = flat[v, :N]
        rays = own[:, reprojection.RAY : reprojection.RAY + 3]
        by_turn = np.cross(turned, rays)
        rays += by_turn + np.einsum('nij,nj->ni', states.rotation, of_lens)
        moving = own[:, reprojection.MOVING : reprojection.MOVING + 3]
        own[:, reprojection.MOVED : reprojection.MOVED + 3] += later[:, None] * moving
        own[:, reprojection.TIME] += later
    turns = changes.rotations @ step[:N_DEVIATIONS]
    rotations = Rotation.from_rotvec(turns).as_matrix() @ tracks.rotations
    blocks = flat.reshape(V, -1, reprojection.BLOCK, reprojection.VALUES)
    return tracks._replace(
        observations=np.ascontiguousarray(np.moveaxis(blocks, 3, 2)), rotations=rotations
    )


def some_changes(V, N, rng):
    """Rows of V frames that turn at changing rates, and arbitrary changes of all else."""
    knots = np.linspace(-0.02, 0.03, 7)
    parts = [GyroPath.integrated(knots, rng.normal(size=(7, 3))).about(0.0) for _ in range(V)]
    rows = RowsOfFrames(
        GyroPath(*(np.concatenate(values) for values in zip(*parts, strict=True))),
        7 * np.arange(V + 1),
        rng.uniform(-0.019, 0.029, (V, N)),
        rng.uniform(-0.5, 0.5, (V, N)),
    )
    rotations = rng.normal(size=(V, 3, N_DEVIATIONS))
    rotations[0] = 0.0
    # Small, as its steps move the residuals the most.
    lens = 0.2 * rng.normal(size=(V, 1, 3, LENS.stop - LENS.start)) * rng.normal(size=(1, N, 1, 1))
    turned = turned_frames(rows, R_CAM_IMU)
    return reprojection.Changes(rows, turned, rotations, lens, rng.normal(size=(V, 3)))


def test_path_by_deviations_equals_finite_differences():
    """Of rays, row times and the gyro's rotations, the tracks eliminated and fitted again."""
    calls = []
    adjust = adjustment.adjust
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(
            frames_between.adjustment, 'adjust', lambda *a: (calls.append(a), adjust(*a))[1]
        )
        Scene(6, sigma=1e-3, gyro=1e-3, count=100).pose()
    arguments = calls[0]
    tracks, priors, start, sigma, *_ = arguments
    state = converged(arguments, start)
    V, N = len(tracks.used), tracks.number
    changes = some_changes(V, N, np.random.default_rng(1))
    normal = adjustment.linearised(tracks, priors, state, without_limit(sigma))
    exact = adjustment.path_by_deviations(tracks, normal, changes)
    assert exact.shape[1] == N_DEVIATIONS + reprojection.OF_FRAME * V
    sigmas = 1.0 / np.sqrt(np.diag(normal.hessian))
    of_frame = N_DEVIATIONS + reprojection.OF_FRAME * 2  # of the third one
    parts = [part.start for part in PARTS.values()]
    for column in (*parts, of_frame, of_frame + 3):
        step = np.zeros(exact.shape[1])
        # A step that moves the path by a small part of its sigma.
        step[column] = 0.02 / np.abs(exact[:, column] / sigmas).max()
        up, down = (
            from_state(
                state, converged((with_changes(tracks, changes, by), *arguments[1:]), state)
            )
            for by in (step, -step)
        )
        numeric = (up - down) / 2.0 / sigmas
        # Gauss-Newton leaves out the curvature of residuals, which are not zero.
        np.testing.assert_allclose(
            exact @ step / sigmas, numeric, atol=5e-3 * np.abs(numeric).max()
        )


def independent_residuals(x, tracks, priors, sigma, f0):
    """Residuals of the equations in the docstring of `adjustment`, without its code."""
    V = len(tracks.used)
    N = tracks.number
    observations = np.moveaxis(tracks.observations, 2, -1).reshape(V, -1, reprojection.VALUES)[
        :, :N
    ]
    t = x[:3] / np.linalg.norm(x[:3])
    log_k = x[3]
    b = x[4:7]
    e = x[7:10]
    phi = np.vstack([np.zeros(3), x[10 : 10 + 3 * V - 3].reshape(-1, 3)])
    own = x[10 + 3 * V - 3 :].reshape(N, 3)
    T = tracks.duration
    out = []
    f = f0 + own[:, 0:1] * np.array([1.0, 0, 0]) + own[:, 1:2] * np.array([0, 1.0, 0])
    f /= np.linalg.norm(f, axis=1)[:, None]
    for v in range(V):
        measured, to_pixels, s, moved = np.split(
            observations[v, :, : reprojection.MOVING], [3, 9, 10], axis=1
        )
        p = s / T * t + np.exp(log_k) * (moved + 0.5 * e * (s * s - T * s))
        R = np.einsum(
            'nij,jk->nik', Rotation.from_rotvec(phi[v] + s * b).as_matrix(), tracks.rotations[v]
        )
        ray = np.einsum('nji,nj->ni', R, f - own[:, 2:] * p)
        ray /= np.linalg.norm(ray, axis=1)[:, None]
        r = np.einsum('nij,nj->ni', to_pixels.reshape(-1, 2, 3), ray - measured) / sigma
        q = 0.25 * np.sum(r * r, axis=1, keepdims=True) + 1e-12
        out.append((r * np.sqrt(np.log1p(q) / q))[tracks.used[v].ravel()[:N]].ravel())
    information = np.linalg.cholesky(priors.rotation_information).T
    return np.concatenate(
        [
            *out,
            information @ phi[1:].ravel(),
            own[:, 2] / adjustment.INVERSE_DISTANCE_SIGMA,
            [
                math.sqrt(priors.log_scale_weight) * (log_k - priors.log_scale),
                10.0 * (np.linalg.norm(x[:3]) - 1.0),
            ],
            math.sqrt(priors.acceleration_weights[0]) * e,
            math.sqrt(priors.bias_weight) * b,
        ]
    )


def test_optimum_is_that_of_an_independent_fit():
    scene = Scene(5, count=25)
    calls = []
    adjust = adjustment.adjust
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(
            frames_between.adjustment, 'adjust', lambda *a: (calls.append(a), adjust(*a))[1]
        )
        scene.pose()
    tracks, priors, start, expected, weight, _ = calls[0]
    adjusted = adjust(tracks, priors, start, expected, weight, 0.0)
    for _ in range(6):  # far beyond the steps of an estimate
        adjusted = adjust(tracks, priors, adjusted.state, adjusted.sigma, 1e9, 0.0)
    sigma = math.hypot(adjusted.sigma, adjustment.COMMON_SIGMA)
    directions = start.tracks[0, :3, :25].T
    rho = start.tracks[0, reprojection.INVERSE_DISTANCE, :25]
    begin = np.concatenate(
        [
            start.t,
            [start.log_scale],
            start.bias,
            start.accelerations[0],
            start.rotations[1:].ravel(),
            np.column_stack([np.zeros((25, 2)), rho]).ravel(),
        ]
    )
    found = least_squares(
        independent_residuals,
        begin,
        args=(tracks, priors, sigma, directions),
        x_scale='jac',
        xtol=1e-12,
        ftol=1e-12,
        gtol=1e-12,
    )
    n = len(adjusted.covariance)
    away = np.r_[
        found.x[:3] / np.linalg.norm(found.x[:3]) - adjusted.state.t,
        found.x[3] - adjusted.state.log_scale,
        found.x[4:7] - adjusted.state.bias,
        found.x[7:10] - adjusted.state.accelerations[0],
        found.x[10 : 1 + n] - adjusted.state.rotations[1:].ravel(),
    ]
    sigmas = np.sqrt(np.diag(adjusted.covariance))
    assert np.abs(away[3:] / sigmas[2:]).max() < 0.05
    assert np.abs(away[:3]).max() < 0.05 * sigmas[:2].min()


def test_no_frames_between_change_nothing(scene):
    """And frames that cannot be used leave the two-view estimate, with a reason.

    That starts at the gyro's rotation instead of samples: at the same optimum, but for rounding.
    """
    two = scene.pose(between=())
    nothing = np.full((len(scene.arguments['points1']), 2), np.nan)
    lost = [replace(frame, points=nothing) for frame in scene.between]
    blind = [
        replace(frame, relative_rotation=None, relative_rotation_covariance=None, inertial=None)
        for frame in scene.between
    ]
    # A gyro that rotates the other way.
    turned = [
        replace(frame, relative_rotation=frame.relative_rotation.T) for frame in scene.between
    ]
    default = estimate_relative_pose(**scene.arguments)
    for other, reason in (
        (default, ''),
        (scene.pose(between=lost), 'no frame between'),
        (scene.pose(between=blind), 'no frame between'),
        (scene.pose(between=turned), 'tracks and gyro'),
    ):
        assert other.diagnostics.frames == 2 and other.diagnostics.frames_reason.startswith(reason)
        assert bool(reason) == bool(other.diagnostics.frames_reason)
        np.testing.assert_allclose(
            other.diagnostics.pixel_sigma,
            two.diagnostics.pixel_sigma,
            rtol=1e-7 if reason else 0.0,
        )
        for name in (
            'R',
            't',
            'covariance',
            'linear_velocity1',
            'linear_velocity2',
            'inliers',
            'baseline',
            'baseline_log_sigma',
            'velocity_covariance',
        ):
            np.testing.assert_allclose(
                getattr(other, name),
                getattr(two, name),
                rtol=1e-7 if reason else 0.0,
                atol=1e-12 if reason else 0.0,
            )
    without_gyro = scene.pose(
        relative_rotation=None, relative_rotation_covariance=None, inertial=None
    )
    assert without_gyro.diagnostics.frames == 2
    assert 'gyro' in without_gyro.diagnostics.frames_reason
    paper = scene.pose(config=EstimatorConfig(refinement='none'))
    assert paper.diagnostics.frames == 2
    assert 'two views' in paper.diagnostics.frames_reason


def test_tracks_may_be_missing_and_wrong(scene):
    """A third of the tracks lost in each frame, a tenth of the others wrong."""
    rng = np.random.default_rng(0)
    between = []
    for frame in scene.between:
        points = frame.points.copy()
        points[rng.random(len(points)) < 0.1] += 15.0
        points[rng.random(len(points)) < 0.33] = np.nan
        between.append(replace(frame, points=points))
    pose = scene.pose(between=between)
    all_tracks = scene.pose()
    assert pose.diagnostics.frames == len(TIMES)
    sigma = np.sqrt(np.trace(all_tracks.covariance[:3, :3]))
    assert np.linalg.norm(pose.t - all_tracks.t) < 3.0 * sigma


@pytest.mark.parametrize('solo', [True, False], ids=['one frame', 'no accelerometer'])
def test_less_is_enough(scene, solo):
    between = (
        scene.between[1:2] if solo else [replace(frame, inertial=None) for frame in scene.between]
    )
    pose = scene.pose(between=between)
    error, _ = scene.error(pose)
    assert pose.diagnostics.frames == len(between) + 2
    assert error @ np.linalg.pinv(pose.covariance, rcond=1e-9) @ error / 5.0 < 5.0


def test_uncertain_direction_is_decided_by_all_frames(scene):
    certain = EstimatorConfig(
        max_translation_sigma=1.05 * np.degrees(np.sqrt(np.trace(scene.pose().covariance[:3, :3])))
    )
    assert scene.pose(config=certain).status is Status.OK
    assert scene.pose(config=certain, between=()).status is Status.LOW_PARALLAX


@pytest.mark.parametrize(
    ('change', 'message'),
    [
        (lambda f: [replace(f[0], points=f[0].points[1:]), *f[1:]], 'points of a frame between'),
        (lambda f: f[::-1], 'must increase'),
        (lambda f: [replace(f[0], interval=TIMES[-1], inertial=None)], 'less than interval'),
        (lambda f: [replace(f[0], points=np.zeros((150, 3)))], 'shape'),
        (lambda f: [replace(f[0], interval=-0.1, inertial=None)], 'interval of a frame between'),
        (lambda f: [replace(f[0], interval=0.05)], 'duration'),
        (lambda f: [replace(f[0], relative_rotation=None)], 'go together'),
        (lambda f: [replace(f[0], relative_rotation=2.0 * np.eye(3))], 'rotation matrix'),
        (lambda f: [replace(f[0], relative_rotation_covariance=-np.eye(3))], 'covariance'),
    ],
)
def test_wrong_arguments_are_named(scene, change, message):
    with pytest.raises(InputError, match=message):
        scene.pose(between=change(scene.between))


def test_interval_is_required(scene):
    with pytest.raises(InputError, match='between requires interval'):
        scene.pose(interval=None, inertial=None)
