"""Poses at any time on a motion that is known exactly, and the files of reconstruction tools.

Files are read back and projected by each tool's own formula. Readers and formulas follow the
sources that the exporters cite, and use nothing of the package; lenses are OpenCV's.
"""

import importlib.util
import json

import cv2
import numpy as np
import pytest
from scipy.spatial.transform import Rotation, Slerp

from rs_relpose_lab.simulation.motions import hand_held, Plan
from rs_relpose_lab.simulation.simulation import ImuModel
from rs_relpose_ros import RowTrajectory
from rs_relpose_ros.errors import InputError
from rs_relpose_ros.geometry.camera import RollingShutterCamera
from rs_relpose_ros.imu.buffer import ImuSample, ImuSamples
from rs_relpose_ros.odometry import formats
from rs_relpose_ros.odometry.export import derotated
from rs_relpose_ros.odometry.formats import END, FORMATS, MIDDLE, Model, START
from rs_relpose_ros.odometry.rows import Knot

START_NS = 1_700_000_000_000_000_000
OFFSET_NS = 30_000_000  # the clock of the IMU less that of the camera
C = Rotation.from_quat((0.502457, -0.504378, 0.507698, 0.485163)).as_matrix()
LEVER = np.array([0.03, 0.01, -0.02])  # of the IMU in the camera
BASE = Rotation.from_rotvec([0.3, -0.2, 0.5]).as_matrix(), np.array([0.2, -0.1, 0.4])
BIASES = np.array([0.011, -0.007, 0.005]), np.array([0.06, -0.04, 0.05])
# R and p on the IMU of camera, IMU and base.
MOUNTS = np.array(
    [
        np.column_stack(mount)
        for mount in (
            (C.T, -C.T @ LEVER),
            (np.eye(3), np.zeros(3)),
            (C.T @ BASE[0], C.T @ (BASE[1] - LEVER)),
        )
    ]
)


def known_path():
    """A hand-held walk."""
    return hand_held(
        np.random.default_rng(5), -1.0, 7.0, Plan.parse('walk:5'), speed=1.6, rotation_rate=0.8
    )


def knots(path, times, *, bias_error=0.0, noise=0.0):
    """Keyframes of the path; the errors are of biases, and of positions [m]."""
    rng = np.random.default_rng(1)
    states = path.states(times)
    found = []
    for k, seconds in enumerate(times):
        R_cam = states.R_world_cam[k]
        w = states.angular_velocity[k]
        ns = START_NS + round(seconds * 1e9)
        found.append(
            Knot(
                ns - OFFSET_NS,
                ns,
                R_cam @ C,
                states.position[k] + R_cam @ LEVER + noise * rng.standard_normal(3),
                states.velocity[k] + R_cam @ np.cross(w, LEVER),
                BIASES[0] + bias_error * 0.1,
                BIASES[1] + bias_error,
                (k + 1.0) * np.diag([1e-4, 2e-4, 3e-4, 1e-6, 2e-6, 3e-6]),
            )
        )
    return found


def samples(path, first, last, rate=400.0):
    times = np.arange(first, last, 1.0 / rate)
    gyro, accel = ImuModel(C, LEVER, *BIASES).measure(path.states(times), np.random.default_rng(0))
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
        samples(path, -0.1, 5.2),
        MOUNTS,
    )


TIMES = START_NS + np.sort(
    np.random.default_rng(3).choice(
        np.concatenate(
            [np.arange(0, 2_000_000_001, 7_919), np.arange(3_000_000_000, 5_000_000_001, 7_919)]
        ),
        400,
    )
)


def test_poses_and_velocities_are_those_of_the_motion(path, rows):
    """A sample every 2.5 ms: the rest is what is not linear in between."""
    truth = path.states((TIMES - START_NS) * 1e-9)
    R, p = rows.pose(TIMES)
    v, w = rows.velocity(TIMES)
    assert np.abs(p - truth.position).max() < 2e-6
    assert (
        Rotation.from_matrix(np.einsum('nji,njk->nik', R, truth.R_world_cam)).magnitude().max()
        < 2e-5
    )
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
    biased = RowTrajectory.of_paths(
        [knots(path, times, bias_error=0.1)], samples(path, -0.1, 3.2), MOUNTS
    )
    at = TIMES[TIMES < START_NS + 2_000_000_000]
    # Uncorrected, 0.1 m/s^2 would be 4.5 mm at the end of an interval, 0.01 rad/s 3e-3 rad.
    assert np.abs(biased.pose(at)[1] - exact.pose(at)[1]).max() < 2e-4
    assert np.abs(biased.pose(at)[0] - exact.pose(at)[0]).max() < 2e-4


def test_velocity_is_the_derivative_of_the_pose(rows):
    at = TIMES[50:150]
    step = 100_000
    for frame in ('camera', 'imu', 'base'):
        v, w = rows.velocity(at, frame)
        (R1, p1), (R, _), (R2, p2) = (rows.pose(at + k * step, frame) for k in (-1, 0, 1))
        np.testing.assert_allclose(
            v, np.einsum('nji,nj->ni', R, p2 - p1) / (2e-9 * step), atol=5e-3
        )
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
    np.testing.assert_allclose(
        rows.covariance(middle, 'base'),
        0.5 * (rows.covariances[3] + rows.covariances[4]),
        atol=1e-12,
    )
    errors = np.random.default_rng(2).multivariate_normal(
        np.zeros(6), rows.covariances[3], size=200_000
    )
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
        samples(path, -0.1, 3.2),
        MOUNTS,
    )
    assert rows.spans.tolist() == [
        [START_NS, START_NS + 2 * 10**9],
        [START_NS + 2 * 10**9, START_NS + 3 * 10**9],
    ]
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


@pytest.mark.parametrize(
    ('call', 'message'),
    [
        (lambda rows: rows.pose(1.7e18), 't_ns must be integers'),
        (
            lambda rows: rows.pose(int(TIMES[0]), 'wheel'),
            "frame must be one of camera, imu, base, got 'wheel'",
        ),
    ],
)
def test_queries_of_unknown_frames_or_times_are_refused(rows, call, message):
    with pytest.raises(InputError, match=message):
        call(rows)


def test_without_two_keyframes_there_is_no_trajectory(path):
    buffer = samples(path, -0.1, 2.2)
    for given in ([], [knots(path, np.array([0.5]))]):
        with pytest.raises(InputError, match='no two keyframes'):
            RowTrajectory.of_paths(given, buffer, MOUNTS)


# -- Files of reconstruction tools -----------------------------------------------------------

READOUT = 0.025
W = 640
H = 480
LENSES = {
    'pinhole': ('plumb_bob', ()),
    'brown': ('plumb_bob', (-0.12, 0.05, 0.0008, -0.0005)),
    'brown, k3': ('plumb_bob', (-0.12, 0.05, 0.0008, -0.0005, -0.01)),
    'rational': ('rational_polynomial', (0.2, -0.05, 0.0008, -0.0005, 0.01, 0.3, 0.02, 0.005)),
    'fisheye': ('equidistant', (0.02, -0.01, 0.003, -0.001)),
}


@pytest.fixture(scope='module')
def trajectory():
    path = known_path()
    return RowTrajectory.of_paths(
        [knots(path, np.arange(0.0, 5.01, 0.25))], samples(path, -0.1, 5.2), MOUNTS
    )


def made(trajectory, lens='brown', direction='down', rolls=True):
    """Two frames of five points each."""
    name, distortion = LENSES[lens]
    camera = RollingShutterCamera(
        width=W,
        height=H,
        fx=450.0,
        fy=452.0,
        cx=318.0,
        cy=241.5,
        distortion_model=name,
        distortion=distortion,
        readout_time=READOUT,
        readout_direction=direction,
    )
    first = START_NS + np.array([1_000_000_000, 1_700_000_000])
    span = round((H - 1) * READOUT / H * 1e9)
    times = first[:, None] + np.array([0, span // 2, span])
    R, p = trajectory.pose(times)
    v, w = trajectory.velocity(times[:, MIDDLE])
    frames = np.repeat([0, 1], 5)
    pixels = np.random.default_rng(4).uniform((60.0, 40.0), (W - 60.0, H - 40.0), (10, 2))
    rays = camera.unproject(pixels)
    points = p[frames, MIDDLE] + np.einsum('nij,nj->ni', R[frames, MIDDLE], 3.0 * rays)
    observed = np.column_stack([frames, np.arange(10)])
    model = Model(
        camera,
        0.004,
        ('1.png', '2.png'),
        first,
        times,
        R,
        p,
        v,
        w,
        points,
        np.tile(np.uint8([10, 20, 30]), (10, 1)),
        np.full(10, 0.3),
        observed,
        pixels,
    )
    if not rolls:
        model = derotated(model, trajectory)
    return model


def lens_pixel(local, K, lens, coefficients):
    """OpenCV's pixel of a point in the camera."""
    project = cv2.fisheye.projectPoints if lens == 'fisheye' else cv2.projectPoints
    out, _ = project(
        np.reshape(local, (1, 1, 3)),
        np.zeros(3),
        np.zeros(3),
        K,
        np.asarray(coefficients, dtype=float),
    )
    return out.ravel()


def iterated(pixel_at_row, row):
    """The pixel of a point that is observed in its own row; y counts from the upper edge."""
    for _ in range(10):
        pixel = pixel_at_row(row)
        row = pixel[1]
    return pixel


def read_colmap(folder, model, lens):
    """format.rst: world to camera, Hamilton; PINHOLE, OPENCV, FULL_OPENCV, OPENCV_FISHEYE."""
    text = [
        line.split()
        for name in ('cameras', 'images')
        for line in (folder / 'sparse/0' / f'{name}.txt').read_text().splitlines()
        if line[0] != '#'
    ]
    _, name, width, height, *values = text[0]
    fx, fy, cx, cy, *k = map(float, values)
    assert (int(width), int(height)) == (W, H)
    # FULL_OPENCV: k1 k2 p1 p2 k3 k4 k5 k6, the order of OpenCV.
    assert len(k) == {'PINHOLE': 0, 'OPENCV': 4, 'FULL_OPENCV': 8, 'OPENCV_FISHEYE': 4}[name]
    K = np.array([[fx, 0.0, cx], [0.0, fy, cy], [0.0, 0.0, 1.0]])
    out = []
    for image, (k_frame, point) in zip(np.repeat([1, 3], 5), model.observed, strict=True):
        _, qw, qx, qy, qz, *t, camera_id, file = text[image]
        assert (camera_id, file) == ('1', model.names[k_frame])
        R = Rotation.from_quat([float(q) for q in (qx, qy, qz, qw)]).as_matrix()
        out.append(
            lens_pixel(R @ model.points[point] + np.array(t, dtype=float), K, lens, k or [0.0] * 4)
        )
    observed = np.array([text[i] for i in (2, 4)], dtype=float).reshape(10, 3)
    np.testing.assert_allclose(observed[:, :2] - 0.5, model.pixels, atol=1e-4)
    tracks = [
        line.split()
        for line in (folder / 'sparse/0/points3D.txt').read_text().splitlines()
        if line[0] != '#'
    ]
    assert [row[0] for row in tracks] == [str(int(number)) for number in observed[:, 2]]
    np.testing.assert_allclose([[float(x) for x in row[1:4]] for row in tracks], model.points)
    assert [(int(row[8]), int(row[9])) for row in tracks] == [
        (i + 1, j) for i in range(2) for j in range(5)
    ]
    return np.array(out)


def read_json(folder):
    value = json.loads((folder / 'transforms.json').read_text())
    K = np.array(
        [[value['fl_x'], 0.0, value['cx']], [0.0, value['fl_y'], value['cy']], [0.0, 0.0, 1.0]]
    )
    assert (value['w'], value['h']) == (W, H)
    assert [frame['file_path'] for frame in value['frames']] == ['images/1.png', 'images/2.png']
    return value, K


OPENGL = np.diag([1.0, -1.0, -1.0, 1.0])


def read_nerfstudio(folder, model, lens):
    """The forks' kernels: middle pose, and a pixel velocity in the undistorted image."""
    value, K = read_json(folder)
    fisheye = value['camera_model'] == 'OPENCV_FISHEYE'
    k = [
        value.get(name, 0.0)
        for name in (('k1', 'k2', 'k3', 'k4') if fisheye else ('k1', 'k2', 'p1', 'p2', 'k3'))
    ]
    fx = K[0, 0]
    fy = K[1, 1]
    out = []
    for f, point in model.observed:
        frame = value['frames'][f]
        view = np.linalg.inv(np.array(frame['transform_matrix']) @ OPENGL)
        x, y, z = view[:3, :3] @ model.points[point] + view[:3, 3]
        flip = np.diag(OPENGL)[:3]
        v, w = (flip * frame[f'camera_{kind}_velocity'] for kind in ('linear', 'angular'))
        total = v + np.cross(w, (x, y, z))
        J = np.array([[fx / z, 0.0, -fx * x / z**2], [0.0, fy / z, -fy * y / z**2]])
        start = np.array([fx * x / z, fy * y / z]) + K[:2, 2]
        speed = -J @ total
        moved = iterated(
            lambda row, start=start, speed=speed: (
                start + speed * value['rolling_shutter_time'] * (row / value['h'] - 0.5)
            ),
            start[1],
        )
        plane = (moved - K[:2, 2]) / (fx, fy)
        out.append(lens_pixel([*plane, 1.0], K, lens, k))
    assert (folder / 'sparse_pc.ply').read_bytes().split(b'end_header\n')[1].count(b'\n') == 10
    return np.array(out)


def slerp(R1, R2, share):
    return Slerp([0.0, 1.0], Rotation.from_matrix([R1, R2]))(share).as_matrix()


def in_whole_rows(first, last, shutter, point, *camera):
    """Pixel of a point by two poses, world to camera, whose share is that of a whole row."""

    def at(row):
        t = {'down': np.floor(row), 'up': H - np.ceil(row), 'global': 0.0}[shutter] / (H - 1)
        R = slerp(first[:3, :3], last[:3, :3], t)
        return lens_pixel(R @ point + (1.0 - t) * first[:3, 3] + t * last[:3, 3], *camera)

    return iterated(at, 240.0)


def read_instant_ngp(folder, model, lens):
    """common_device.cuh: u, v from 0 to 1, t = A + B u + C v, camera to world."""
    value, K = read_json(folder)
    assert value['is_fisheye'] == (lens == 'fisheye')
    k = [
        value.get(name, 0.0)
        for name in (('k1', 'k2', 'k3', 'k4') if value['is_fisheye'] else ('k1', 'k2', 'p1', 'p2'))
    ]
    A, B, C, D = value['rolling_shutter']
    assert (B, D) == (0.0, 0.0)
    out = []
    for f, point in model.observed:
        frame = value['frames'][f]
        first, last = (
            np.array(frame[f'transform_matrix_{which}']) @ OPENGL for which in ('start', 'end')
        )

        def at(row, first=first, last=last, point=point):
            t = A + C * row / value['h']
            R = slerp(first[:3, :3], last[:3, :3], np.clip(t, 0.0, 1.0))
            position = (1.0 - t) * first[:3, 3] + t * last[:3, 3]
            return lens_pixel(R.T @ (model.points[point] - position), K, lens, k)

        out.append(iterated(at, 240.0))
    places = np.array([frame['transform_matrix'] for frame in value['frames']])[:, :3, 3]
    placed = places * value['scale'] + value['offset']
    assert (placed > 0.2).all() and (placed < 0.8).all()
    return np.array(out)


def read_gsplat(folder, model, lens):
    """Cameras.cuh: world to camera, t = floor(y) / (H - 1), or (H - ceil(y)) / (H - 1)."""
    value = np.load(folder / 'cameras.npz')
    assert str(value['camera_model']) == ('fisheye' if lens == 'fisheye' else 'pinhole')
    k = value['radial_coeffs']
    p = value['tangential_coeffs']
    coefficients = k if lens == 'fisheye' else [*k[:2], *p, *k[2:], *value['thin_prism_coeffs']]
    shutter = {0: 'down', 2: 'up', 4: 'global'}[int(value['rolling_shutter'])]
    return np.array(
        [
            in_whole_rows(
                value['viewmats'][f],
                value['viewmats_rs'][f],
                shutter,
                model.points[point],
                value['Ks'][f],
                lens,
                coefficients,
            )
            for f, point in model.observed
        ]
    )


def read_ncore(folder, model, lens):
    """camera.py: poses at both times, t = floor(y) / (H - 1) of the translation to the camera."""
    from ncore.data import v4

    reader = v4.SequenceComponentGroupsReader(list(folder.glob('*.itar')))
    assert v4.SequenceLoaderV4(reader).camera_ids == ['camera']
    (one,) = reader.open_component_readers(v4.CameraSensorComponent.Reader).values()
    lenses, poses, clouds = (
        next(iter(reader.open_component_readers(part.Reader).values()))
        for part in (v4.IntrinsicsComponent, v4.PosesComponent, v4.PointCloudsComponent)
    )
    camera = lenses.get_camera_model_parameters('camera')
    assert clouds.get_pc_xyz(0).shape == (10, 3)
    ((_, (trajectory, stamps)),) = poses.get_dynamic_poses()
    fx, fy, cx, cy = (*camera.focal_length, *camera.principal_point)
    K = np.array([[fx, 0.0, cx], [0.0, fy, cy], [0.0, 0.0, 1.0]], dtype=float)
    k = camera.radial_coeffs.astype(float)
    coefficients = (
        k
        if lens == 'fisheye'
        else [*k[:2], *camera.tangential_coeffs, *k[2:], *camera.thin_prism_coeffs]
    )
    shutter = {'ROLLING_TOP_TO_BOTTOM': 'down', 'ROLLING_BOTTOM_TO_TOP': 'up', 'GLOBAL': 'global'}[
        camera.shutter_type.name
    ]
    out = []
    for f, point in model.observed:
        times = one.frames_timestamps_us[f]
        first, last = (np.linalg.inv(trajectory[stamps.tolist().index(time)]) for time in times)
        assert one.get_frame_image(int(times[1])).size == (W, H)
        out.append(in_whole_rows(first, last, shutter, model.points[point], K, lens, coefficients))
    return np.array(out)


READERS = {
    'colmap': read_colmap,
    'nerfstudio': read_nerfstudio,
    'gsplat': read_gsplat,
    'instant-ngp': read_instant_ngp,
}
if importlib.util.find_spec('ncore'):  # an extra with PyTorch
    READERS['ncore'] = read_ncore
CASES = [
    (name, lens, direction, rolls)
    for name in READERS
    for lens, direction, rolls in (
        *((lens, 'down', True) for lens in LENSES),
        ('brown', 'up', True),
        ('brown', 'down', False),
    )
]


@pytest.mark.parametrize(('name', 'lens', 'direction', 'rolls'), CASES)
def test_a_reader_of_the_format_gets_the_same_pixels(
    name, lens, direction, rolls, trajectory, tmp_path
):
    chosen = FORMATS[name]
    model = made(trajectory, lens, direction, rolls)
    model = formats.replace(model, camera=formats.fitted(model.camera, chosen.radial))
    if name == 'ncore':  # its files contain the images
        (tmp_path / 'images').mkdir()
        for image in model.names:
            cv2.imwrite(str(tmp_path / 'images' / image), np.zeros((H, W), dtype=np.uint8))
    chosen.write(model, tmp_path)
    read = READERS[name](tmp_path, model, lens) - 0.5
    own = formats.projected(
        chosen.place, model, model.observed[:, 0], model.points, np.full(10, 240.0)
    )
    # In a row's time a point moves by less than this: formats with whole rows jump by it.
    assert np.abs(read - own).max() < 0.01


@pytest.mark.parametrize('direction', ['down', 'up'])
@pytest.mark.parametrize('name', ['gsplat', 'instant-ngp', 'nerfstudio'])
def test_the_formula_of_a_rolling_shutter_is_near_the_trajectory(name, direction, trajectory):
    """0.7 rad/s, 3 to 6 rad/s^2 and 1.6 m/s, 3 m in front."""
    model = made(trajectory, 'pinhole', direction)
    k = model.observed[:, 0]
    guess = np.full(10, 240.0)
    true, linear, single = (
        formats.projected(place, model, k, model.points, guess)
        for place in (formats.path(trajectory), FORMATS[name].place, formats.middle)
    )
    errors, moved = (np.linalg.norm(one - true, axis=1) for one in (linear, single))
    assert errors.max() < 0.3
    assert np.median(errors) < 0.2 * np.median(moved)


def test_times_of_rows_are_those_of_the_readout(trajectory):
    """A point in the first row that is read is at the start pose, whatever the direction."""
    for direction, row in (('down', 0.0), ('up', H - 1.0)):
        model = made(trajectory, 'pinhole', direction)
        k = np.zeros(1, dtype=int)
        local = np.array([[0.1, (row - model.camera.cy) / model.camera.fy, 1.0]])
        point = model.positions[0, START] + local @ model.R[0, START].T
        for place in (
            formats.path(trajectory),
            formats.lerp_of_position,
            formats.lerp_of_translation,
        ):
            np.testing.assert_allclose(place(model, k, point, np.array([row])), local, atol=1e-9)
        other = formats.path(trajectory)(model, k, point, np.array([H - 1.0 - row]))
        end = (point - model.positions[0, END]) @ model.R[0, END]
        np.testing.assert_allclose(other, end, atol=2e-5)  # a nanosecond of rounding


@pytest.mark.parametrize(
    ('lens', 'radial', 'most'),
    [('brown, k3', 2, 0.3), ('rational', 3, 0.03), ('rational', 2, 0.6)],
)
def test_a_lens_is_fitted_with_the_coefficients_of_the_format(lens, radial, most, trajectory):
    """In the corners; in the mean ten times less."""
    camera = made(trajectory, lens).camera
    fitted = formats.fitted(camera, radial)
    assert len(fitted.distortion) == 5
    assert not any(formats.coefficients_of(fitted).k[radial:])
    u, v = np.meshgrid(np.arange(0.0, W, 20.0), np.arange(0.0, H, 20.0))
    pixels = np.column_stack([u.ravel(), v.ravel()])
    errors = np.abs(fitted.project(camera.unproject(pixels)) - pixels)
    assert errors.max() < most
    assert errors.mean() < 0.1 * most


def test_a_lens_that_the_format_knows_is_not_changed(trajectory):
    for lens, radial in (('brown', 2), ('brown, k3', 3), ('rational', 6), ('fisheye', 2)):
        camera = made(trajectory, lens).camera
        assert formats.fitted(camera, radial) is camera


@pytest.mark.parametrize('lens', ['pinhole', 'brown', 'brown, k3', 'rational', 'fisheye'])
def test_pycolmap_reads_the_model(lens, trajectory, tmp_path):
    """COLMAP's own reader and projection, which has packages for x86-64 only."""
    pycolmap = pytest.importorskip('pycolmap')
    model = made(trajectory, lens)
    FORMATS['colmap'].write(model, tmp_path)
    read = pycolmap.Reconstruction(tmp_path / 'sparse' / '0')
    own = formats.projected(
        formats.middle, model, model.observed[:, 0], model.points, np.full(10, 240.0)
    )
    for (f, point), pixel in zip(model.observed, own, strict=True):
        image = next(one for one in read.images.values() if one.name == model.names[f])
        assert np.abs(image.project_point(model.points[point]) - 0.5 - pixel).max() < 0.01
    assert len(read.points3D) == 10
