"""Camera, row times, motion and small vectors, against OpenCV, SciPy and finite differences."""

from dataclasses import replace

import cv2
from hypothesis import given
from hypothesis import strategies as st
from hypothesis.extra import numpy as hnp
import numpy as np
import pytest
from scipy.integrate import solve_ivp
from scipy.spatial.transform import Rotation

from rs_relpose_ros.config.settings import sensor_model, SensorConfig
from rs_relpose_ros.errors import InputError, MissingInputError
from rs_relpose_ros.estimator.problem import PairState, to_reference_row
from rs_relpose_ros.estimator.result import RelativePose, Status
from rs_relpose_ros.geometry import so3
from rs_relpose_ros.geometry.camera import Intrinsics, RollingShutterCamera
from rs_relpose_ros.geometry.motion import FrameMotion, InertialMotion
from rs_relpose_ros.geometry.timing import ImageClock, seconds_between, to_nanoseconds

vectors = hnp.arrays(np.float64, 3, elements=st.floats(-3.0, 3.0))


# --- small vectors and rotations


@given(hnp.arrays(np.float64, (5, 3), elements=st.floats(-10.0, 10.0)), st.booleans())
def test_products_equal_numpy(values, as_tuples):
    a = values[0]
    b = values[1]
    M = values[2:]
    x, y = (tuple(v.tolist()) if as_tuples else v for v in (a, b))
    assert so3.dot(x, y) == pytest.approx(a @ b, rel=1e-14, abs=1e-13)
    assert so3.norm(x) == pytest.approx(np.linalg.norm(a), rel=1e-14)
    for ours, numpys in (
        (so3.cross(x, y), np.cross(a, b)),
        (so3.rotated(M, x), M @ a),
        (so3.rotated_back(M, x), M.T @ a),
        (so3.skew(a) @ b, np.cross(a, b)),
    ):
        np.testing.assert_allclose(ours, numpys, rtol=1e-13, atol=1e-12)


@given(vectors, st.sampled_from([0.0, 1e-9, 1e-4, 1.0, np.pi - 1e-7]))
def test_exponential_and_logarithm_are_those_of_scipy_and_inverse(direction, angle):
    vector = angle * direction / max(np.linalg.norm(direction), 1.0)
    matrix = so3.exp_so3(vector)
    np.testing.assert_allclose(matrix, Rotation.from_rotvec(vector).as_matrix(), atol=1e-12)
    np.testing.assert_allclose(so3.log_so3(matrix), vector, atol=1e-8)


@given(vectors)
def test_left_jacobian_equals_finite_differences(direction):
    vector = direction / max(np.linalg.norm(direction), 1.0)
    jacobian = so3.left_jacobian_so3(vector)
    for k, step in enumerate(1e-6 * np.eye(3)):
        change = Rotation.from_rotvec(vector + step) * Rotation.from_rotvec(vector).inv()
        np.testing.assert_allclose(change.as_rotvec() / 1e-6, jacobian[:, k], atol=1e-6)


@given(vectors, st.integers(0, 1000))
def test_alignment_recovers_the_rotation(vector, seed):
    R = Rotation.from_rotvec(vector)
    b = np.random.default_rng(seed).normal(size=(5, 3))
    np.testing.assert_allclose(so3.aligning_rotation(R.apply(b).T @ b), R.as_matrix(), atol=1e-9)


@given(
    hnp.arrays(
        np.float64, st.integers(1, 101), elements=st.integers(-3, 3) | st.floats(allow_nan=False)
    )
)
def test_every_rank_and_the_median(values):
    ordered = np.sort(values)
    for k in range(len(values)):
        reordered = values.copy()
        assert so3.smallest(reordered, k) == ordered[k]
        assert reordered[:k].max(initial=-np.inf) <= reordered[k] <= reordered[k:].min()
        np.testing.assert_array_equal(np.sort(reordered), ordered)
    with np.errstate(all='ignore'):  # the mean of two infinite or huge values
        assert so3.median(values.copy()) == pytest.approx(np.median(values), nan_ok=True)


# --- the camera

# EuRoC's factory calibration, a wide rational model, a fisheye lens.
MODELS = [
    ('plumb_bob', ()),
    ('plumb_bob', (-0.28340811, 0.07395907, 0.00019359, 1.76187114e-05)),
    ('plumb_bob', (-0.3, 0.12, 1e-3, -5e-4, -0.02)),
    ('rational_polynomial', (0.5, 0.1, 1e-4, -1e-4, 0.01, 0.6, 0.2, 0.02)),
    (
        'rational_polynomial',
        (0.5, 0.1, 1e-4, -1e-4, 0.01, 0.6, 0.2, 0.02, 1e-3, -2e-4, 5e-4, 1e-4),
    ),
    ('equidistant', (-0.01, 0.005, -0.001, 0.0001)),
]
PIXELS = np.random.default_rng(0).uniform([0, 0], [751, 479], (200, 2))


def make_camera(model='plumb_bob', distortion=(), **changes):
    values = {
        'width': 752,
        'height': 480,
        'fx': 458.654,
        'fy': 457.296,
        'cx': 367.215,
        'cy': 248.375,
        'readout_time': 0.024,
        **changes,
    }
    return RollingShutterCamera(distortion_model=model, distortion=distortion, **values)


@pytest.mark.parametrize(('model', 'distortion'), MODELS)
def test_opencv_projects_the_ray_back_to_its_pixel(model, distortion):
    camera = make_camera(model, distortion)
    rays, jacobian = camera.unproject_with_jacobian(PIXELS)
    np.testing.assert_allclose(np.linalg.norm(rays, axis=1), 1.0, atol=1e-12)
    project = cv2.fisheye.projectPoints if model == 'equidistant' else cv2.projectPoints
    back, _ = project(
        (7.0 * rays)[:, None, :],
        np.zeros(3),
        np.zeros(3),
        camera.camera_matrix,
        np.array(distortion or (0.0,) * 4),
    )
    np.testing.assert_allclose(back.reshape(-1, 2), PIXELS, atol=1e-8)
    np.testing.assert_allclose(camera.project(7.0 * rays), PIXELS, atol=1e-8)
    for k, step in enumerate(1e-4 * np.eye(2)):
        numeric = (camera.unproject(PIXELS + step) - camera.unproject(PIXELS - step)) / 2e-4
        np.testing.assert_allclose(jacobian[:, :, k], numeric, atol=1e-9)


@pytest.mark.parametrize('method', ['points_by_lens', 'rays_by_lens'])
@pytest.mark.parametrize(('model', 'distortion'), MODELS)
def test_derivatives_by_the_lens_equal_finite_differences(model, distortion, method):
    camera = make_camera(model, distortion)
    # On the axis and beside it, where the profile of the fisheye is a series.
    centre = np.array([camera.cx, camera.cy])
    near = centre + np.array([[0.0, 0.0], [1e-6, 0.0], [0.01, 0.02]])
    pixels = np.vstack([PIXELS, near])

    def values(deviation, pixels=pixels):
        moved = getattr(camera.moved_lens(np.array(deviation)), method)(pixels)
        return moved.values, moved.by_pixel

    found = getattr(camera, method)(pixels)
    steps = [1e-6] * 7 + [1e-3] * 2
    for q, step in enumerate(np.diag(steps)):
        (ahead, ahead_by_pixel), (behind, behind_by_pixel) = values(step), values(-step)
        for analytic, change in (
            (found.by_lens[..., q], ahead - behind),
            (found.by_pixel_by_lens[..., q], ahead_by_pixel - behind_by_pixel),
        ):
            numeric = change / (2.0 * steps[q])
            np.testing.assert_allclose(analytic, numeric, atol=1e-6 * np.abs(numeric).max())
    for j, step in enumerate(1e-3 * np.eye(2)):
        change = values(np.zeros(9), pixels + step)[0] - values(np.zeros(9), pixels - step)[0]
        np.testing.assert_allclose(found.by_pixel[..., j], change / 2e-3, atol=1e-11)
    rays, jacobian = camera.unproject_with_jacobian(pixels)
    if method == 'rays_by_lens':
        np.testing.assert_array_equal(found.values, rays)
        np.testing.assert_array_equal(found.by_pixel, jacobian)
    else:
        np.testing.assert_allclose(found.values, rays[:, :2] / rays[:, 2:], atol=1e-12)


@pytest.mark.parametrize(
    ('model', 'distortion', 'moved'),
    [
        ('plumb_bob', (), (0.1, 0.0, 0.0, 0.004)),
        ('plumb_bob', (0.1, 0.2, 0.3, 0.4), (0.2, 0.2, 0.3, 0.404)),
        ('rational_polynomial', (), (0.1, 0.0, 0.0, 0.004) + (0.0,) * 4),
        ('equidistant', (0.1, 0.2, 0.3, 0.4), (0.2, 0.2, 0.3, 0.4)),
    ],
)
def test_lens_moved_by_a_deviation(model, distortion, moved):
    camera = make_camera(model, distortion)
    deviation = np.array([0.01, 0.02, 0.1, 0.0, 0.0, 0.0, 0.004, 3.0, -2.0])
    other = camera.moved_lens(deviation)
    assert other.distortion == pytest.approx(moved)
    assert other.fx == pytest.approx(camera.fx * np.exp(0.01))
    assert other.fy / other.fx == pytest.approx(camera.fy / camera.fx * np.exp(0.02))
    assert (other.cx, other.cy) == (camera.cx + 3.0, camera.cy - 2.0)
    deviation[4] = 0.5
    third = {'plumb_bob': 4, 'rational_polynomial': 4, 'equidistant': 2}[model]
    assert camera.moved_lens(deviation).distortion[third] == pytest.approx(
        0.5 + (distortion[third] if len(distortion) > third else 0.0)
    )
    assert camera.moved_lens(np.zeros(9)) == camera


def test_no_mirror_images():
    """Neither beyond the invertible region of the distortion, nor behind the camera."""
    # The search diverges, or it converges where the distorted radius decreases.
    for distortion, outside in (((0.21253, -0.46023), -1.5), ((0.3, -0.1), 1.766)):
        camera = make_camera('plumb_bob', (*distortion, 0.0, 0.0), cx=0.0, cy=0.0)
        rays = camera.unproject([[0.0, 0.0], [outside * camera.fx, 0.0]])
        assert np.isfinite(rays[0]).all()
        assert np.isnan(rays[1]).all()
    assert np.isnan(make_camera().project([[0.1, 0.2, -1.0]])).all()


# --- time

SPAN = 0.024 * 479 / 480


@pytest.mark.parametrize(
    ('reference', 'direction', 'first', 'last'),
    [
        ('first', 'down', 0.0, SPAN),
        ('middle', 'down', -SPAN / 2, SPAN / 2),
        ('last', 'down', -SPAN, 0.0),
        ('first', 'up', 0.0, -SPAN),
        ('last', 'up', SPAN, 0.0),
    ],
)
def test_row_times_count_from_the_reference_row_in_the_readout_direction(
    reference, direction, first, last
):
    camera = make_camera(reference_row=reference, readout_direction=direction)
    np.testing.assert_allclose(camera.row_times([0.0, 479.0]), [first, last], atol=1e-15)
    np.testing.assert_allclose(camera.row_time_span, sorted((first, last)), atol=1e-15)


def test_clock_of_an_image():
    clock = ImageClock(
        make_camera(reference_row='last'),
        time_offset=-0.002,
        stamp_exposure='end',
        exposure_time=0.004,
    )
    # The stamp ends the last row's exposure: its middle was 2 ms before, on a clock 2 ms ahead.
    assert clock.reference_ns(10**9) == 10**9 - 4_000_000
    start, end = clock.exposed_span_ns(10**9)
    assert end == 10**9 - 2_000_000
    assert end - start == to_nanoseconds(SPAN + 0.004)
    automatic = replace(clock, exposure_time=0.0, exposure_margin=0.008, reference_interval=0.02)
    assert [
        automatic.exposure(interval) for interval in (None, 50_000_000, 5_000_000)
    ] == pytest.approx([0.012, 0.042, 0.0])
    assert automatic.reference_ns(10**9, 50_000_000) == 10**9 - 23_000_000
    epoch = 1_650_458_790_634_415_865
    assert to_nanoseconds(seconds_between(epoch, epoch + 1)) == 1


INTRINSICS = Intrinsics(
    width=752,
    height=480,
    fx=458.654,
    fy=457.296,
    cx=367.215,
    cy=248.375,
    image_width=376,
    image_height=200,
    binning_x=2,
    binning_y=2,
    y_offset=40,
)


def test_camera_and_clock_of_a_parameter_set():
    config = SensorConfig(
        readout_time=0.03, pose_row='middle', stamp_row='first', time_offset=0.001
    )
    sensor = sensor_model(INTRINSICS, config)
    assert sensor is sensor_model(INTRINSICS, config)
    middle = 0.03 * 239.5 / 480
    assert sensor.camera == make_camera(readout_time=0.03, reference_row='middle')
    assert sensor.pose_row_delay == pytest.approx(middle, rel=1e-12)
    assert sensor.clock.reference_ns(0) == pytest.approx(1e9 * (0.001 + middle), abs=1)
    # Both ends of the readout, relative to the stamp of row 0.
    assert sensor.clock.exposed_span_ns(0) == (10**6, pytest.approx(1e6 + 3e7 * 479 / 480, abs=2))
    assert sensor_model(INTRINSICS, config, 0.002).camera.readout_time == pytest.approx(0.032)
    assert sensor_model(INTRINSICS, config, -1.0).camera.readout_time == 0.0
    with pytest.raises(MissingInputError, match='readout_time'):
        sensor_model(INTRINSICS, SensorConfig())


# --- motion during the readout


def wobble(t):
    return np.array([0.6 * np.sin(9.0 * t + 0.3), -0.8 * np.cos(7.0 * t), 0.5 + 2.0 * t])


def true_rotation(end):
    """Independent integral of the quaternion's differential equation."""

    def derivative(t, q):
        x, y, z = wobble(t)
        # q' = q * (w / 2), scalar last
        a, b, c, d = q
        return 0.5 * np.array(
            [
                d * x + b * z - c * y,
                d * y + c * x - a * z,
                d * z + a * y - b * x,
                -a * x - b * y - c * z,
            ]
        )

    solved = solve_ivp(derivative, (0.0, end), [0.0, 0.0, 0.0, 1.0], rtol=1e-11, atol=1e-12)
    return Rotation.from_quat(solved.y[:, -1])


def test_gyro_integral_equals_the_differential_equation():
    def error(motion, tau):
        found = Rotation.from_matrix(motion.rotations([tau])[0])
        return (found.inv() * true_rotation(tau)).magnitude()

    times = np.arange(-0.01, 0.0351, 0.0025)  # a gyro of 400 Hz
    motion = FrameMotion.from_gyro(times, [wobble(t) for t in times])
    for tau in (-0.0088, 0.0, 0.0117, 0.03, 0.0333):
        assert error(motion, tau) < 1e-5
    assert error(FrameMotion(wobble(0.0)), 0.0333) > 5e-4  # at a constant rate


@given(vectors, st.floats(-0.05, 0.05))
def test_derotated_rays_are_those_of_the_reference_row(rate, tau):
    world = np.array([[1.0, 2.0, 5.0]])
    rotation = Rotation.from_rotvec(tau * rate)
    motion = FrameMotion(rate)
    np.testing.assert_allclose(motion.rotations([tau])[0], rotation.as_matrix(), atol=1e-12)
    np.testing.assert_allclose(
        motion.derotate(rotation.inv().apply(world), [tau]), world, atol=1e-12
    )


def test_shift_of_the_reference_row():
    times = np.arange(-0.04, 0.0401, 0.0025)
    motion = FrameMotion.from_gyro(times, [wobble(t) for t in times], gravity=[0.1, 0.9, 0.2])
    moved = motion.shifted(0.015)
    turn = motion.rotations([0.015])[0]
    np.testing.assert_allclose(
        turn @ moved.rotations([0.01])[0], motion.rotations([0.025])[0], atol=1e-12
    )
    np.testing.assert_allclose(turn @ moved.gravity, motion.gravity, atol=1e-12)


# --- a pose between other rows, and its inverse


def make_state(rng):
    t = rng.normal(size=3)
    return PairState(
        Rotation.from_rotvec(rng.normal(size=3) * 0.3).as_matrix(),
        t / np.linalg.norm(t),
        *rng.normal(size=(4, 3)),
        rng.normal(),
        np.zeros((19, 19)),
    )


def drawn_factor(rng, t, size):
    """Factor of a covariance of (dt, dtheta, ...) with dt perpendicular to t."""
    factor = 1e-5 * rng.normal(size=(size, size))
    factor[:3] = (np.eye(3) - np.outer(t, t)) @ factor[:3]
    return factor


def turns(state, delay):
    return (
        Rotation.from_rotvec(state.w1 * delay).as_matrix(),
        Rotation.from_rotvec(state.w2 * delay).as_matrix(),
    )


def moved(state, delay):
    return to_reference_row(state, delay, *turns(state, delay))


def assert_covariance_of(errors_of, factor, expected):
    """First-order covariance of errors_of(e), where e has that of `factor`, of small columns."""
    columns = np.array([errors_of(e) - errors_of(-e) for e in factor.T]) / 2.0
    sigma = np.sqrt(np.diag(expected))
    np.testing.assert_allclose(
        columns.T @ columns / np.outer(sigma, sigma), expected / np.outer(sigma, sigma), atol=1e-6
    )


def test_pose_between_later_rows():
    """Camera i at row time tau: orientation R_i Exp(w_i tau), position p_i + R_i v_i tau."""
    rng = np.random.default_rng(0)
    state = make_state(rng)
    delay = 0.02
    R1 = Rotation.random(random_state=1).as_matrix()
    p1 = rng.normal(size=3)
    R2 = R1 @ state.R
    p2 = p1 + R1 @ state.t
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


def test_covariance_of_the_moved_pose():
    """First-order covariance by finite differences: perturb, move, measure."""
    rng = np.random.default_rng(2)
    state = make_state(rng)
    delay = 0.03
    factor = drawn_factor(rng, state.t, 19)
    result = moved(replace(state, covariance=factor @ factor.T), delay)

    def errors_of(e):
        true = PairState(
            Rotation.from_rotvec(e[3:6]).as_matrix() @ state.R,
            state.t + e[0:3],
            state.v1 + e[6:9],
            state.v2 + e[9:12],
            state.w1 + e[12:15],
            state.w2 + e[15:18],
            state.log_baseline + e[18],
            state.covariance,
        )
        # The rates' errors rotate the rows from the left, as the gyro corrections do.
        true = to_reference_row(
            true,
            delay,
            *(
                Rotation.from_rotvec(delay * error).as_matrix() @ turn
                for error, turn in zip((e[12:15], e[15:18]), turns(state, delay), strict=True)
            ),
        )
        return np.concatenate(
            [
                true.t - result.t,
                Rotation.from_matrix(true.R @ result.R.T).as_rotvec(),
                true.v1 - result.v1,
                true.v2 - result.v2,
                [true.log_baseline - result.log_baseline],
            ]
        )

    kept = [*range(12), 18]
    assert_covariance_of(errors_of, factor, result.covariance[np.ix_(kept, kept)])


def test_inverse_pose_and_its_covariance():
    rng = np.random.default_rng(3)
    state = make_state(rng)
    factor = drawn_factor(rng, state.t, 6)
    pose = RelativePose(
        Status.OK,
        R=state.R,
        t=state.t,
        linear_velocity1=state.v1,
        linear_velocity2=state.v2,
        covariance=factor @ factor.T,
    )
    inverse = pose.inverse()
    point2 = rng.normal(size=3)
    point1 = pose.R @ point2 + pose.t
    np.testing.assert_allclose(inverse.R @ point1 + inverse.t, point2, atol=1e-12)
    np.testing.assert_array_equal(inverse.linear_velocity1, state.v2)

    def errors_of(e):
        R = Rotation.from_rotvec(e[3:]).as_matrix() @ state.R
        return np.concatenate(
            [
                -R.T @ (state.t + e[:3]) - inverse.t,
                Rotation.from_matrix(R.T @ inverse.R.T).as_rotvec(),
            ]
        )

    assert_covariance_of(errors_of, factor, inverse.covariance)
    np.testing.assert_allclose(inverse.inverse().covariance, pose.covariance, atol=1e-18)


# --- illegal values

NAN = float('nan')
STEADY = np.zeros((2, 3))


@pytest.mark.parametrize(
    ('build', 'name'),
    [
        *(
            (lambda changes=changes: make_camera(**changes), name)
            for changes, name in [
                ({'width': 0}, 'width'),
                ({'height': 480.5}, 'height'),
                ({'fx': 0.0}, 'fx'),
                ({'cy': NAN}, 'cy'),
                ({'readout_time': -0.01}, 'readout_time'),
                ({'readout_time': NAN}, 'readout_time'),
                ({'reference_row': 'top'}, 'reference_row'),
                ({'readout_direction': 'sideways'}, 'readout_direction'),
                ({'model': 'brown'}, 'distortion_model'),
                ({'distortion': (0.1, 0.2, 0.3)}, 'distortion'),
                ({'distortion': (0.1, float('inf'), 0.0, 0.0)}, 'distortion'),
            ]
        ),
        (lambda: FrameMotion([0.0, 1.0, NAN]), 'angular_velocity'),
        (lambda: FrameMotion([0.0, 1.0]), 'angular_velocity'),
        (lambda: FrameMotion([0.0, 1.0, 0.0], [0.0, 0.0, 0.0]), 'gravity'),
        (lambda: FrameMotion.from_gyro([0.0], STEADY[:1]), 'number of times'),
        *(
            (lambda times=times: FrameMotion.from_gyro(times, STEADY), 'times')
            for times in ([0.0, 0.0], [0.01, 0.02], [0.0, np.inf])
        ),
        (lambda: FrameMotion.from_gyro([0.0, 0.01], STEADY).rotations([0.011]), 'row times'),
        *(
            (
                lambda changes=changes: InertialMotion(
                    **{
                        'alpha': np.zeros(3),
                        'beta': np.zeros(3),
                        'duration': 0.1,
                        'covariance': 1e-4 * np.eye(6),
                        **changes,
                    }
                ),
                next(iter(changes)),
            )
            for changes in (
                {'duration': 0.0},
                {'duration': -0.1},
                {'duration': NAN},
                {'alpha': [1.0, 2.0]},
                {'beta': [1.0, NAN, 0.0]},
                {'lever_arm': [30.0, 0.0, 0.0]},
                {'covariance': np.eye(3)},
                {'covariance': -np.eye(6)},
                {'acceleration2': [1e9, 0.0, 0.0]},
            )
        ),
    ],
)
def test_illegal_values_are_refused_by_name(build, name):
    with pytest.raises(InputError, match=f'^{name} '):
        build()


def test_the_readout_time_has_no_default():
    with pytest.raises(TypeError, match='readout_time'):
        RollingShutterCamera(width=1, height=1, fx=1.0, fy=1.0, cx=0.0, cy=0.0)
