"""Poses at any time, from keyframes and the IMU, on a motion that is known exactly."""

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from rs_relpose_lab.simulation.motions import hand_held, Plan
from rs_relpose_lab.simulation.simulation import ImuModel
from rs_relpose_ros import RowTrajectory
from rs_relpose_ros.errors import InputError
from rs_relpose_ros.imu.buffer import ImuSample, ImuSamples
from rs_relpose_ros.odometry.rows import Knot

START_NS = 1_700_000_000_000_000_000
OFFSET_NS = 30_000_000   # the clock of the IMU less that of the camera
C = Rotation.from_quat((0.502457, -0.504378, 0.507698, 0.485163)).as_matrix()
LEVER = np.array([0.03, 0.01, -0.02])   # of the IMU in the camera
BASE = Rotation.from_rotvec([0.3, -0.2, 0.5]).as_matrix(), np.array([0.2, -0.1, 0.4])
BIASES = np.array([0.011, -0.007, 0.005]), np.array([0.06, -0.04, 0.05])
# R and p on the IMU of camera, IMU and base.
MOUNTS = np.array([np.column_stack(mount) for mount in (
    (C.T, -C.T @ LEVER), (np.eye(3), np.zeros(3)), (C.T @ BASE[0], C.T @ (BASE[1] - LEVER)))])


def known_path():
    """A hand-held walk."""
    return hand_held(np.random.default_rng(5), -1.0, 7.0, Plan.parse('walk:5'), speed=1.6,
                     rotation_rate=0.8)


def knots(path, times, *, bias_error=0.0, noise=0.0):
    """Keyframes of the path; the errors are of biases, and of positions [m]."""
    rng = np.random.default_rng(1)
    states = path.states(times)
    found = []
    for k, seconds in enumerate(times):
        R_cam, w = states.R_world_cam[k], states.angular_velocity[k]
        ns = START_NS + round(seconds * 1e9)
        found.append(Knot(
            ns - OFFSET_NS, ns, R_cam @ C,
            states.position[k] + R_cam @ LEVER + noise * rng.standard_normal(3),
            states.velocity[k] + R_cam @ np.cross(w, LEVER),
            BIASES[0] + bias_error * 0.1, BIASES[1] + bias_error,
            (k + 1.0) * np.diag([1e-4, 2e-4, 3e-4, 1e-6, 2e-6, 3e-6])))
    return found


def samples(path, first, last, rate=400.0):
    times = np.arange(first, last, 1.0 / rate)
    gyro, accel = ImuModel(C, LEVER, *BIASES).measure(
        path.states(times), np.random.default_rng(0))
    buffer = ImuSamples(0.05)
    for seconds, w, f in zip(times, gyro, accel, strict=True):
        buffer.add(ImuSample(START_NS + round(seconds * 1e9), tuple(w), tuple(f)))
    return buffer


@pytest.fixture(scope='module')
def path():
    return known_path()


@pytest.fixture(scope='module')
def rows(path):
    """Two paths with a gap of 1 s between."""
    return RowTrajectory.of_paths(
        [knots(path, np.arange(0.0, 2.01, 0.25)), knots(path, np.arange(3.0, 5.01, 0.25))],
        samples(path, -0.1, 5.2), MOUNTS)


TIMES = START_NS + np.sort(np.random.default_rng(3).choice(
    np.concatenate([np.arange(0, 2_000_000_001, 7_919), np.arange(
        3_000_000_000, 5_000_000_001, 7_919)]), 400))


def test_poses_and_velocities_are_those_of_the_motion(path, rows):
    """A sample every 2.5 ms: the rest is what is not linear in between."""
    truth = path.states((TIMES - START_NS) * 1e-9)
    R, p = rows.pose(TIMES)
    v, w = rows.velocity(TIMES)
    assert np.abs(p - truth.position).max() < 2e-6
    assert Rotation.from_matrix(
        np.einsum('nji,njk->nik', R, truth.R_world_cam)).magnitude().max() < 2e-5
    assert np.abs(v - np.einsum('nji,nj->ni', truth.R_world_cam, truth.velocity)).max() < 1e-3
    assert np.abs(w - truth.angular_velocity).max() < 5e-3


def test_errors_of_keyframes_and_biases_are_spread(path):
    """The path meets its keyframes, and a constant error of the biases hardly moves it between."""
    times = np.arange(0.0, 3.01, 0.3)
    given = knots(path, times, bias_error=0.1, noise=0.01)
    rows = RowTrajectory.of_paths([given], samples(path, -0.1, 3.2), MOUNTS)
    _, p = rows.pose(np.array([knot.imu_ns for knot in given]), 'imu')
    np.testing.assert_allclose(p, [knot.position for knot in given], atol=1e-9)
    exact = RowTrajectory.of_paths([knots(path, times)], samples(path, -0.1, 3.2), MOUNTS)
    biased = RowTrajectory.of_paths([knots(path, times, bias_error=0.1)],
                                    samples(path, -0.1, 3.2), MOUNTS)
    at = TIMES[TIMES < START_NS + 2_000_000_000]
    # Uncorrected, 0.1 m/s^2 would be 4.5 mm at the end of an interval, 0.01 rad/s 3e-3 rad.
    assert np.abs(biased.pose(at)[1] - exact.pose(at)[1]).max() < 2e-4
    assert np.abs(biased.pose(at)[0] - exact.pose(at)[0]).max() < 2e-4


def test_times_may_be_scalars_and_arrays(rows):
    R, p = rows.pose(TIMES.reshape(20, 20))
    v, w = rows.velocity(TIMES.reshape(20, 20))
    assert (R.shape, p.shape, v.shape, w.shape) == (
        (20, 20, 3, 3), (20, 20, 3), (20, 20, 3), (20, 20, 3))
    one = rows.pose(int(TIMES[23]))
    np.testing.assert_array_equal(one[0], R[1, 3])
    np.testing.assert_array_equal(one[1], p[1, 3])
    assert rows.covariance(TIMES.reshape(20, 20)).shape == (20, 20, 6, 6)
    nothing = TIMES[:0]
    assert [part.shape for part in rows.pose(nothing)] == [(0, 3, 3), (0, 3)]
    assert rows.velocity(nothing)[0].shape == (0, 3)
    assert rows.covariance(nothing).shape == (0, 6, 6)


def test_velocity_is_the_derivative_of_the_pose(rows):
    at, step = TIMES[50:150], 100_000
    for frame in ('camera', 'imu', 'base'):
        v, w = rows.velocity(at, frame)
        (R1, p1), (R, _), (R2, p2) = (rows.pose(at + k * step, frame) for k in (-1, 0, 1))
        np.testing.assert_allclose(
            v, np.einsum('nji,nj->ni', R, p2 - p1) / (2e-9 * step), atol=5e-3)
        turn = Rotation.from_matrix(np.einsum('nji,njk->nik', R1, R2)).as_rotvec()
        np.testing.assert_allclose(w, turn / (2e-9 * step), atol=2e-2)


def test_frames_are_mounted_on_each_other(rows):
    R, p = rows.pose(TIMES)
    R_base, p_base = rows.pose(TIMES, 'base')
    R_imu, p_imu = rows.pose(TIMES, 'imu')
    np.testing.assert_allclose(R_base, R @ BASE[0], atol=1e-12)
    np.testing.assert_allclose(p_base, p + R @ BASE[1], atol=1e-12)
    np.testing.assert_allclose(R_imu, R @ C, atol=1e-12)
    np.testing.assert_allclose(p_imu, p + R @ LEVER, atol=1e-12)


def test_covariance_is_that_of_the_base_moved_to_the_frame(rows):
    """Against samples: small errors of the base, and the camera that moves with it."""
    at = int(rows.keyframes_ns[3, 1])
    np.testing.assert_allclose(rows.covariance(at, 'base'), rows.covariances[3], atol=1e-18)
    middle = (rows.keyframes_ns[3, 1] + rows.keyframes_ns[4, 1]) // 2
    np.testing.assert_allclose(rows.covariance(middle, 'base'),
                               0.5 * (rows.covariances[3] + rows.covariances[4]), atol=1e-12)
    errors = np.random.default_rng(2).multivariate_normal(
        np.zeros(6), rows.covariances[3], size=200_000)
    (_, p), (_, p_base) = rows.pose(at), rows.pose(at, 'base')
    moved = errors.copy()
    moved[:, :3] += np.cross(errors[:, 3:], p - p_base)
    sampled = np.cov(moved.T)
    sigma = np.sqrt(np.diag(sampled))
    assert (np.abs(rows.covariance(at) - sampled) < 0.02 * np.outer(sigma, sigma)).all()


def test_gaps_are_known(rows):
    first, last = START_NS + np.array([[0.0, 2.0], [3.0, 5.0]]).T.astype(np.int64) * 10**9
    np.testing.assert_array_equal(rows.spans, np.column_stack([first, last]))
    edges = np.concatenate([first, last])
    assert rows.covers(edges).all()
    rows.pose(edges)
    beyond = np.concatenate([first - 1, last + 1])
    assert not rows.covers(beyond).any()
    for time in beyond:
        with pytest.raises(InputError, match=f'{time} ns: the trajectory extends from'):
            rows.pose(np.array([first[0], time]))


def test_a_path_that_overlaps_the_one_before_begins_at_its_end(path):
    rows = RowTrajectory.of_paths(
        [knots(path, np.arange(0.0, 2.01, 0.25)), knots(path, np.arange(1.5, 3.01, 0.25))],
        samples(path, -0.1, 3.2), MOUNTS)
    assert rows.spans.tolist() == [[START_NS, START_NS + 2 * 10**9],
                                   [START_NS + 2 * 10**9, START_NS + 3 * 10**9]]
    assert (np.diff(rows.stamps_ns) >= 0).all()
    at = START_NS + 2 * 10**9
    np.testing.assert_allclose(rows.pose(at)[1], path.states(2.0).position[0], atol=2e-6)


def test_the_clock_of_the_camera(rows):
    np.testing.assert_array_equal(rows.camera_ns(TIMES), TIMES - OFFSET_NS)


def test_a_file_is_exact(rows, tmp_path):
    rows.save(tmp_path / 'rows.npz')
    read = RowTrajectory.load(tmp_path / 'rows.npz')
    for one, other in zip(rows.pose(TIMES), read.pose(TIMES), strict=True):
        np.testing.assert_array_equal(one, other)
    np.testing.assert_array_equal(rows.covariance(TIMES), read.covariance(TIMES))


@pytest.mark.parametrize('content', [b'', b'no zip', b'PK\x03\x04 cut off', None, np.zeros(3)])
def test_a_file_of_something_else_is_refused(content, tmp_path):
    file = tmp_path / 'rows.npz'
    if content is None:
        np.savez(file, spans=np.zeros((1, 2)))
    elif isinstance(content, np.ndarray):
        with file.open('wb') as stream:
            np.save(stream, content)
    else:
        file.write_bytes(content)
    with pytest.raises(InputError, match=r'rows\.npz is damaged or no file of'):
        RowTrajectory.load(file)
    with pytest.raises(InputError, match='does not exist'):
        RowTrajectory.load(tmp_path / 'none.npz')


@pytest.mark.parametrize(('call', 'message'), [
    (lambda rows: rows.pose(1.7e18), 't_ns must be integers'),
    (lambda rows: rows.pose(int(TIMES[0]), 'wheel'),
     "frame must be one of camera, imu, base, got 'wheel'"),
])
def test_bad_queries(rows, call, message):
    with pytest.raises(InputError, match=message):
        call(rows)


def test_without_two_keyframes_there_is_no_trajectory(path):
    buffer = samples(path, -0.1, 2.2)
    for given in ([], [knots(path, np.array([0.5]))]):
        with pytest.raises(InputError, match='no two keyframes'):
            RowTrajectory.of_paths(given, buffer, MOUNTS)
