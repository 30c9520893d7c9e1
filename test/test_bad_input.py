"""Any input gives an InputError that names the argument, or a status: no crash, no wrong pose.

Warnings are errors in tests, so that an overflow or a division by zero counts as a crash as well.
"""

from hypothesis import example, given, settings
from hypothesis import strategies as st
from hypothesis.extra import numpy as hnp
import numpy as np
import pytest
from scipy.spatial.transform import Rotation
from simulated_pairs import SCENE_CAMERA
import two_view_scene as scenes
from two_view_scene import make_scene

from rs_relpose_ros import estimate_relative_pose, EstimatorConfig, FrameMotion, solvers
from rs_relpose_ros.config.settings import REFINEMENTS, SOLVER_CHOICES
from rs_relpose_ros.errors import InputError
from rs_relpose_ros.estimator.result import Status
from rs_relpose_ros.geometry import validate
from rs_relpose_ros.geometry.camera import RollingShutterCamera

POINTS = {
    'linear_9pt': 9,
    'uniform_9pt': 9,
    'angular_3pt': 3,
    'angular_5pt': 5,
    'global_5pt': 5,
    'uniform_11pt': 11,
}
WIDTH = 640
HEIGHT = 480
seeds = st.integers(0, 2**32 - 1)
any_float = st.floats(allow_nan=True, allow_infinity=True)
finite = st.floats(allow_nan=False, allow_infinity=False)
strange = st.sampled_from(
    [
        0.0,
        -0.0,
        1e-300,
        -1e-300,
        5e-324,
        1e-12,
        1.0,
        -1.0,
        1e6,
        -1e6,
        1e18,
        1e154,
        1e300,
        -1e308,
        1.7e308,
    ]
)


def check_outcome(pose, count):
    """A status with its reason, or a pose with finite and consistent values."""
    assert pose.inliers.shape == (count,)
    if not pose:
        assert pose.status is not Status.OK
        assert pose.reason
        assert np.isnan(pose.t).all()
        return
    assert pose.status is Status.OK
    np.testing.assert_allclose(pose.R.T @ pose.R, np.eye(3), atol=1e-9)
    assert np.linalg.det(pose.R) > 0.0
    assert np.linalg.norm(pose.t) == pytest.approx(1.0, abs=1e-9)
    values = [
        pose.linear_velocity1,
        pose.linear_velocity2,
        pose.angular_velocity1,
        pose.angular_velocity2,
        pose.covariance.ravel(),
        pose.velocity_covariance.ravel(),
        [pose.diagnostics.residual_rms, pose.diagnostics.velocity_sigma],
    ]
    assert np.isfinite(np.concatenate(values)).all()
    scale = np.abs(pose.covariance).max()
    assert np.linalg.eigvalsh(pose.covariance).min() > -1e-9 * scale
    assert pose.inliers.sum() >= 6


def estimate(points1, points2, **changes):
    """The public entry; None if it refuses the input."""
    camera = {
        'width': WIDTH,
        'height': HEIGHT,
        'fx': 450.0,
        'fy': 450.0,
        'cx': 319.5,
        'cy': 239.5,
        'readout_time': 0.03,
        **changes.pop('camera', {}),
    }
    motion = {'angular_velocity': [0.3, -0.2, 0.1], 'gravity': [0.0, 9.81, 0.5]}
    config = {'max_iterations': 100, **changes.pop('config', {})}
    try:
        motions = [
            FrameMotion(**motion | changes.pop(name, {})) for name in ('motion1', 'motion2')
        ]
        pose = estimate_relative_pose(
            points1,
            points2,
            RollingShutterCamera(**camera),
            *motions,
            config=EstimatorConfig(**config),
            **changes,
        )
    except InputError:
        return None
    check_outcome(pose, len(points1))
    return pose


def random_points(seed, n):
    return np.random.default_rng(seed).uniform(0.0, [WIDTH - 1, HEIGHT - 1], (n, 2))


configs = st.fixed_dictionaries(
    {'solver': st.sampled_from(SOLVER_CHOICES), 'refinement': st.sampled_from(REFINEMENTS)}
)


@pytest.mark.parametrize(
    ('check', 'message'),
    [
        (lambda: validate.number('x', '3', 0, 1, 's'), "x must be in [0, 1] s, got '3'"),
        (lambda: validate.number('x', np.nan), 'x must be finite, got nan'),
        (lambda: validate.number('x', np.inf, 0), 'x must be >= 0 and finite, got inf'),
        (lambda: validate.number('x', 3, high=2), 'x must be <= 2 and finite, got 3'),
        (
            lambda: validate.number('x', 1.5, 1, 9, whole=True),
            'x must be a whole number, in [1, 9]',
        ),
        (lambda: validate.choice('x', 'c', ('a', 'b')), "x must be one of a, b, got 'c'"),
        (lambda: validate.array('x', [1, 2], (3,)), 'x must have shape (3,), got (2,)'),
        (lambda: validate.array('x', np.zeros((2, 3)), ('N', 2)), 'x must have shape (N, 2), got'),
        (lambda: validate.array('x', None, (3,)), 'x must have shape (3,), got ()'),
        (lambda: validate.array('x', ['a'], (1,)), "x must be an array of numbers, got ['a']"),
        (
            lambda: validate.array('x', [1, -9], ('N',), largest=5, unit='px'),
            'x must be finite and within 5 px, got -9.0 at [1]',
        ),
        (lambda: validate.unit_vectors('x', np.zeros((1, 3)), ('N', 3)), 'x must not hold a zero'),
        (
            lambda: validate.unit_length('x', (1.0, 1.0), 0.1),
            'x must have length 1, got (1.0, 1.0)',
        ),
        *(
            (lambda R=R: validate.rotations('x', R), 'x must be ')
            for R in (2.0 * np.eye(3), -np.eye(3), np.zeros((3, 3)), np.full((3, 3), 1e300))
        ),
        *(
            (lambda C=C: validate.covariance('x', C, 2), 'x must be a covariance matrix')
            for C in (-np.eye(2), [[1.0, 0.1], [0.0, 1.0]], [[1.0, 2.0], [2.0, 1.0]])
        ),
        (
            lambda: validate.increasing('x', np.array([1, 3, 3])),
            'x must be strictly increasing, got 3 after 3 at [2]',
        ),
    ],
)
def test_checks_name_the_parameter_the_legal_values_and_the_value(check, message):
    with pytest.raises(InputError) as refused:
        check()
    assert str(refused.value).startswith(message)


@given(hnp.arrays(np.float64, (4, 3), elements=st.floats(-1e3, 1e3)))
def test_legal_arrays_are_copied(values):
    checked = validate.array('x', values, ('N', 3), largest=1e3)
    np.testing.assert_array_equal(checked, values)
    assert not np.shares_memory(checked, values)
    validate.covariance('x', values.T @ values, 3, rounding=1e-6)
    if np.abs(values).max(axis=1).all():
        unit = validate.unit_vectors('x', 1e300 * values, (4, 3))
        np.testing.assert_allclose(np.linalg.norm(unit, axis=1), 1.0, rtol=1e-15)


@pytest.mark.timeout(600)  # the kernels of all solvers are compiled by its first examples
@settings(max_examples=80)
@given(
    seeds,
    st.integers(0, 160),
    configs,
    st.sampled_from([2.0, 4.0, 8.0, 13.0, 25.0]),
    st.booleans(),
    st.booleans(),
)
def test_random_matches_never_give_a_good_pose(seed, n, config, threshold, gyro, up):
    """The wider the threshold, the more agree by chance; a gyro alone could make hypotheses."""
    prior = (
        {
            'relative_rotation': Rotation.random(random_state=seed).as_matrix(),
            'relative_rotation_covariance': 1e-4 * np.eye(3),
        }
        if gyro
        else {}
    )
    pose = estimate(
        random_points(seed, n),
        random_points(seed + 1, n),
        config={**config, 'threshold': threshold},
        camera={'readout_direction': 'up' if up else 'down'},
        **prior,
    )
    assert pose is not None and not pose
    assert pose.status is Status.TOO_FEW_MATCHES or n > 8


@st.composite
def degenerate_points(draw):
    """Identical, few distinct, or collinear points."""
    n = draw(st.integers(9, 60))
    rng = np.random.default_rng(draw(seeds))
    ends = rng.uniform(0.0, [WIDTH - 1, HEIGHT - 1], (4, 2))
    along = rng.uniform(size=(n, 1))
    return draw(
        st.sampled_from(
            [
                *(ends[rng.integers(0, distinct, n)] for distinct in (1, 2, 4)),
                *(
                    ends[0] + along * (ends[1] - ends[0]) * axes
                    for axes in ([1, 1], [1, 0], [0, 1])
                ),
            ]
        )
    ), rng


@settings(max_examples=80)
@given(degenerate_points(), configs)
def test_degenerate_points_give_no_pose(drawn, config):
    points, rng = drawn
    assert not estimate(points, points, config=config)
    still = {name: {'angular_velocity': np.zeros(3)} for name in ('motion1', 'motion2')}
    noisy = points + rng.normal(size=points.shape) * 0.5
    assert not estimate(points, noisy, config=config, **still)
    # Nor from a common shift of all points.
    assert not estimate(points, points + rng.normal(size=2) * 20.0, config=config)


@settings(max_examples=40)
@given(st.integers(0, 2**20), configs, st.booleans())
def test_points_on_a_line_in_space_give_no_pose(seed, config, gravity):
    """With noise and moving cameras: the images of the line are curved."""
    scene = make_scene(seed, n=100, outliers=0.0, on_a_line=True)
    assert not scene_pose(scene.points1, scene.points2, config | CONFIGURED, scene, gravity)


@settings(max_examples=100)
@given(st.sampled_from(['nan', 'inf', '-inf', 'huge', 'far']), st.integers(0, 99), seeds, configs)
def test_one_bad_value_among_good_matches_is_refused_or_no_inlier(kind, place, seed, config):
    points = GOOD.points1.copy()
    points[place, seed % 2] = {
        'nan': np.nan,
        'inf': np.inf,
        '-inf': -np.inf,
        'huge': 1e9,
        'far': 1e6,
    }[kind]
    pose = scene_pose(points, GOOD.points2, config)
    if kind != 'far':
        assert pose is None
    elif pose:
        assert not pose.inliers[place]


GOOD = make_scene(0, n=100)
CONFIGURED = {
    'gravity_sigma': scenes.GRAVITY_NOISE,
    'gyro_sigma': scenes.GYRO_NOISE,
    'pixel_sigma': 0.5,
}


def scene_pose(points1, points2, config, scene=GOOD, gravity=True, **changes):
    motions = {
        f'motion{k}': {
            'angular_velocity': getattr(scene, f'measured_rate{k}'),
            'gravity': getattr(scene, f'measured_gravity{k}') if gravity else None,
        }
        for k in (1, 2)
    }
    return estimate(points1, points2, config=config, camera=SCENE_CAMERA, **motions, **changes)


vectors = hnp.arrays(np.float64, 3, elements=any_float | strange)
matrices = hnp.arrays(np.float64, (3, 3), elements=any_float | strange) | st.sampled_from(
    [np.eye(3), np.zeros((3, 3)), np.full((3, 3), 1e154), 1e300 * np.eye(3), np.eye(2)]
)
motions = st.fixed_dictionaries({'angular_velocity': vectors, 'gravity': st.none() | vectors})
# Of each argument any value, of random matches: a refusal, or no pose.
ANY = {
    'points1': hnp.arrays(
        np.float64,
        hnp.array_shapes(min_dims=0, max_dims=3, min_side=0, max_side=30),
        elements=any_float | strange,
    ),
    'camera': st.dictionaries(
        st.sampled_from(['width', 'height', 'fx', 'fy', 'cx', 'cy', 'readout_time']),
        any_float | strange,
        min_size=1,
        max_size=1,
    )
    | st.fixed_dictionaries(
        {
            'distortion_model': st.sampled_from(
                ['plumb_bob', 'rational_polynomial', 'equidistant', 'fov']
            ),
            'distortion': st.lists(finite | strange | st.floats(-2.0, 2.0), max_size=13).map(
                tuple
            ),
        }
    ),
    'motion2': motions
    | st.sampled_from([{'angular_velocity': np.full(3, size)} for size in (1e-300, 1e6, 1e300)]),
    'relative_rotation': matrices,
    'relative_rotation_covariance': matrices,
    'interval': any_float | strange,
    'config': st.dictionaries(
        st.sampled_from(
            [
                'threshold',
                'pixel_sigma',
                'gravity_sigma',
                'gyro_sigma',
                'confidence',
                'time_limit',
                'min_inliers',
                'min_parallax',
                'max_translation_sigma',
            ]
        ),
        any_float | st.integers(-(10**20), 10**20) | st.text(max_size=3) | st.none(),
        max_size=2,
    ),
}
USUAL = {'relative_rotation': np.eye(3), 'relative_rotation_covariance': 1e-4 * np.eye(3)}


@pytest.mark.parametrize('name', ANY)
@settings(max_examples=60)
@given(st.data(), seeds)
def test_any_value_of_an_argument(name, data, seed):
    value = data.draw(ANY[name])
    given_too = USUAL if name.startswith('relative') else {}
    points = {'points1': random_points(seed, 30), 'points2': random_points(seed + 1, 30)}
    assert not estimate(**points | given_too | {name: value})


@settings(max_examples=60)
@given(
    hnp.arrays(np.float64, st.integers(2, 6), elements=any_float | strange),
    st.integers(0, 6),
    seeds,
)
@example(np.array([-3e76, 0.0]), 2, 1)
@example(np.array([-1e308, 8e307]), 2, 1)
@example(np.array([-1e6, 0.0]), 2, 1)
def test_any_gyro_samples(times, rows, seed):
    rates = np.random.default_rng(seed).normal(size=(rows, 3)) * 10.0 ** (seed % 9)
    try:
        motion = FrameMotion.from_gyro(times, rates)
    except InputError:
        return
    assert np.isfinite(motion.angular_velocity).all()
    turns = motion.rotations(np.clip([-0.01, 0.0, 0.02], times[0], times[-1]))
    np.testing.assert_allclose(
        turns @ np.swapaxes(turns, 1, 2), np.tile(np.eye(3), (3, 1, 1)), atol=1e-6
    )


def solve(name, rays1, rays2, tau1, tau2, gravity1, gravity2, start_rotations):
    """Solutions, each a motion, or the message of a refusal."""
    try:
        found = getattr(solvers, name)(
            rays1,
            rays2,
            tau1,
            tau2,
            gravity1=gravity1,
            gravity2=gravity2,
            start_rotations=start_rotations,
        )
    except InputError as error:
        return str(error)
    assert len(found) <= {3: 4, 5: 10, 9: 12, 11: len(start_rotations)}[POINTS[name]]
    for s in found:
        np.testing.assert_allclose(s.R.T @ s.R, np.eye(3), atol=1e-8)
        assert np.linalg.det(s.R) > 0.0
        assert np.linalg.norm(s.t) == pytest.approx(1.0, abs=1e-8)
        assert np.isfinite([s.v1, s.v2]).all()
    return found


names = st.sampled_from(sorted(POINTS))
DOWN = np.array([0.0, 1.0, 0.0])


@settings(max_examples=100)
@given(st.data(), names)
def test_solvers_on_any_rays_and_times(data, name):
    n = POINTS[name]
    rays = hnp.arrays(np.float64, (n, 3), elements=finite | strange | st.integers(-2, 2))
    times = hnp.arrays(np.float64, n, elements=st.floats(-0.1, 0.1) | strange)
    solve(
        name,
        data.draw(rays),
        data.draw(rays),
        data.draw(times),
        data.draw(times),
        data.draw(vectors),
        DOWN,
        np.eye(3)[None],
    )


@settings(max_examples=100)
@given(
    st.data(),
    names,
    st.sampled_from(['rays1', 'rays2', 'tau1', 'tau2', 'gravity1', 'start_rotations']),
)
def test_solvers_refuse_wrong_arguments_by_name(data, name, changed):
    P = scenes.make_minimal_problems(0, 1, POINTS[name])
    arguments = {
        'rays1': P.rays1[0],
        'rays2': P.rays2[0],
        'tau1': P.tau1[0],
        'tau2': P.tau2[0],
        'gravity1': P.gravity1[0],
        'gravity2': P.gravity2[0],
        'start_rotations': P.R,
    }
    right = arguments[changed].shape
    kind = data.draw(st.sampled_from(['not finite', 'shape', 'absent', 'text', 'zero']))
    value = arguments[changed].copy()
    if kind == 'not finite':
        value.reshape(-1)[data.draw(st.integers(0, value.size - 1))] = data.draw(
            st.sampled_from([np.nan, np.inf, -np.inf])
        )
    elif kind == 'shape':
        value = np.ones(
            data.draw(
                hnp.array_shapes(min_dims=0, max_dims=4, min_side=0, max_side=12).filter(
                    lambda shape: shape != right
                )
            )
        )
    elif kind == 'zero' and not changed.startswith('tau'):
        value[slice(None) if changed == 'gravity1' else -1] = 0.0  # gravity, a ray, a rotation
    else:
        value = None if kind == 'absent' else ['later'] * len(value)
    used = (
        changed not in ('gravity1', 'start_rotations')
        or (changed == 'gravity1' and name in ('linear_9pt', 'uniform_9pt', 'angular_3pt'))
        or (changed == 'start_rotations' and name == 'uniform_11pt')
    )
    if used:
        refusal = solve(name, **{**arguments, changed: value})
        assert isinstance(refusal, str) and refusal.startswith(f'{changed} must ')


@st.composite
def degenerate_rays(draw):
    """Few distinct directions, all in a plane, or equal in both frames."""
    n = draw(st.sampled_from([3, 5, 9, 11]))
    rng = np.random.default_rng(draw(seeds))
    few = rng.normal(size=(draw(st.integers(1, 3)), 3))
    kind = draw(st.sampled_from(['few', 'plane', 'any', 'integer']))
    f1 = {
        'few': few[rng.integers(0, len(few), n)],
        'any': rng.normal(size=(n, 3)),
        'plane': rng.normal(size=(n, 2)) @ rng.normal(size=(2, 3)),
        'integer': rng.integers(1, 3, (n, 3)).astype(float),
    }[kind]
    f2 = {
        'same': f1,
        'opposite': -f1,
        'turned': Rotation.random(random_state=rng).apply(f1),
        'other': rng.normal(size=(n, 3)),
    }[draw(st.sampled_from(['same', 'opposite', 'turned', 'other']))]
    tau = rng.uniform(-0.03, 0.03, (2, n)) * draw(st.sampled_from([0.0, 1e-15, 1e-9, 1.0, 1e9]))
    return f1, f2, tau


@settings(max_examples=100)
@given(degenerate_rays(), st.sampled_from([DOWN, -DOWN, np.array([0.0, 0.0, -1.0])]))
def test_solvers_on_degenerate_rays(problem, gravity):
    f1, f2, tau = problem
    for name, n in POINTS.items():
        if n == len(f1):
            assert isinstance(solve(name, f1, f2, *tau, gravity, DOWN, np.eye(3)[None]), list)
