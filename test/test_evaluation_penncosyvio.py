"""The protocol on PennCOSYVIO: its formats on a small made folder; recorded trajectories."""

from __future__ import annotations

import csv
import re
import shutil

import cv2
import numpy as np
import pytest
from scipy.io import savemat
from scipy.spatial.transform import Rotation

from rs_relpose_lab.experiments.boxes import by_case, Record, tables
from rs_relpose_lab.experiments.methods import run_method
from rs_relpose_lab.experiments.omnidirectional import OmnidirectionalCamera
from rs_relpose_lab.experiments.pair_imu import PairImu
from rs_relpose_lab.experiments.penncosyvio import (
    EXPERIMENT,
    Pair,
    PennCosyvioRun,
    RecordedSequence,
    STRETCHES,
)
from rs_relpose_lab.experiments.penncosyvio_files import (
    Poses,
    read_camera,
    read_extrinsics,
    read_frames,
    read_imu,
    read_poses,
)
from rs_relpose_lab.experiments.penncosyvio_simulated import (
    PlacedMotion,
    RecordedMotion,
    Simulated,
    SimulatedSequence,
)
from rs_relpose_lab.experiments.scoring import NO_POSE, PoseError
from rs_relpose_lab.simulation.inertial import ImuModel
from rs_relpose_lab.simulation.render import Renderer
from rs_relpose_lab.simulation.scene import make_scene
from rs_relpose_ros.cli import main
from rs_relpose_ros.config.imu import ImuConfig
from rs_relpose_ros.errors import InputError, MissingInputError
from rs_relpose_ros.estimator.result import Status
from rs_relpose_ros.geometry.timing import ImageClock
from rs_relpose_ros.imu.samples import ImuSample

# The published figures of the GoPro C2, as OCamCalib in Matlab has them: row before column, both
# counted from 1.
C2 = {'ss': [-877.468361, 0.0, 3.33880820e-04, -9.24194160e-09, 1.10410236e-11],
      'xc': 539.90501924, 'yc': 959.85847286, 'c': 1.00430175, 'd': -0.00044732,
      'e': -0.00137768, 'width': 1920, 'height': 1080}
# The same lens on a chip of 480x360 pixels, for images that are quickly made.
SMALL = {**C2, 'ss': [a * 4.0**(k - 1) for k, a in enumerate(C2['ss'])], 'xc': 180.4, 'yc': 240.7,
         'width': 480, 'height': 360}

FRAME_TIME = 1.0 / 30.0
FRAMES = 62
FIRST_STAMP = 0.026
GYRO_BIAS = (0.02, -0.01, 0.03)
READOUT = 0.03


# --- a made folder


def way():
    """Two seconds of a walk, looking ahead: optical frame in a world with z up."""
    seconds = np.arange(FRAMES) * FRAME_TIME
    ahead = Rotation.from_matrix([[0, 0, 1], [-1, 0, 0], [0, -1, 0]])
    turns = np.column_stack([0.3 * np.sin(3.0 * seconds), 0.05 * np.sin(5.0 * seconds),
                             0.04 * np.cos(4.0 * seconds)])
    positions = np.column_stack([1.3 * seconds, 0.1 * np.sin(4.0 * seconds),
                                 1.6 + 0.03 * np.sin(8.0 * seconds)])
    stamps = np.rint((FIRST_STAMP + seconds) * 1e6).astype(np.int64) * 1000
    return Poses(stamps, positions, Rotation.from_euler('ZYX', turns) * ahead)


def lines(path, rows):
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_text(''.join(' '.join(f'{x:.9f}' for x in row) + '\n' for row in rows))


@pytest.fixture(scope='module')
def made(tmp_path_factory):
    """A folder as the data set's own scripts leave it, with the frames 2 and 32."""
    folder = tmp_path_factory.mktemp('penncosyvio')
    poses = way()
    lines(folder / 'data/ground_truth/as/pose.txt', (
        [stamp * 1e-9, *np.column_stack([R, p]).ravel()] for stamp, R, p in
        zip(poses.stamps_ns, poses.rotations.as_matrix(), poses.positions, strict=True)))
    cells = np.empty((1, 7), dtype=object)
    for k in range(7):
        cells[0, k] = SMALL
    (folder / 'tools/intrinsic_calibration').mkdir(parents=True)
    savemat(folder / 'tools/intrinsic_calibration/cc.mat', {'cc': cells})
    # Lines as published: the GoPro C2 is the rig; the IMU of the VI sensor is mounted askew here.
    (folder / 'tools/misc').mkdir()
    (folder / 'tools/misc/extrinsic_calibration.txt').write_text(
        '1  0.0143841993 0.9998519509 0.0094430495  1.27031     82.674    2.503 -127.252\n'
        '2  0.0000000000 1.0000000000 0.0000000000  0.00000      0.000    0.000    0.000\n'
        '10 0.6000000000 0.0000000000 0.8000000000  1.10000    -31.005 -125.714  -17.107\n')
    camera = read_camera(folder, 'c2', READOUT, 'first')
    motion = RecordedMotion(poses)
    lines(folder / 'data/c2/as/frames/timestamps.txt', ([s * 1e-9] for s in poses.stamps_ns))
    renderer = Renderer(make_scene('yard', np.random.default_rng(2), camera.fx), camera, motion)
    for number in (2, 32):
        gray = renderer.render(motion.seconds(int(poses.stamps_ns[number - 1])))
        cv2.imwrite(str(folder / f'data/c2/as/frames/frame_{number:04d}.png'),
                    np.rint(gray).astype(np.uint8))
    times = np.arange(0.0, 2.0, 0.005)
    R_imu_cam, _ = read_extrinsics(folder, 10)
    gyro, accel = ImuModel(R_imu_cam.T, gyro_bias=GYRO_BIAS).measure(
        motion.states(times), np.random.default_rng(0))
    lines(folder / 'data/visensor/as/imu.txt', (
        [poses.stamps_ns[0] * 1e-9 + t, *a, *w]
        for t, a, w in zip(times, accel, gyro, strict=True)))
    return folder


# --- the camera


def by_the_toolbox(row, column):
    """Ray of a pixel (from 1) as OCamCalib's cam2world has it, turned to z forward."""
    A = np.array([[C2['c'], C2['d']], [C2['e'], 1.0]])
    x, y = np.linalg.solve(A, [row - C2['xc'], column - C2['yc']])
    ray = np.array([y, x, -np.polyval(C2['ss'][::-1], np.hypot(x, y))])
    return ray / np.linalg.norm(ray)


def gopro():
    return OmnidirectionalCamera(
        width=1920, height=1080, fx=877.0, fy=877.0, cx=C2['yc'] - 1, cy=C2['xc'] - 1,
        readout_time=READOUT, polynomial=tuple(C2['ss']), affine=(C2['c'], C2['d'], C2['e']))


def test_camera_agrees_with_the_toolbox_and_with_itself():
    camera = gopro()
    pixels = np.stack(np.meshgrid(np.linspace(0, 1919, 13), np.linspace(0, 1079, 9)), -1)
    pixels = pixels.reshape(-1, 2)
    rays = camera.unproject(pixels)
    expected = [by_the_toolbox(v + 1, u + 1) for u, v in pixels]
    assert rays == pytest.approx(np.array(expected), abs=1e-12)
    assert camera.project(3.0 * rays) == pytest.approx(pixels, abs=1e-8)
    _, jacobian = camera.unproject_with_jacobian(pixels)
    for axis in range(2):
        step = 1e-3 * np.eye(2)[axis]
        slope = (camera.unproject(pixels + step) - camera.unproject(pixels - step)) / 2e-3
        assert jacobian[:, :, axis] == pytest.approx(slope, abs=1e-9)


def test_camera_sees_nothing_behind_and_its_centre_straight_ahead():
    camera = gopro()
    assert camera.project([[0.0, 0.0, 2.0]])[0] == pytest.approx([camera.cx, camera.cy])
    assert np.isnan(camera.project([[0.1, 0.0, -1.0], [1.0, 0.0, 0.0]])).all()
    assert np.isnan(camera.unproject([[1e5, 0.0]])).all()


@pytest.mark.parametrize('change', [
    {'polynomial': (877.0, 0.0)}, {'polynomial': (-877.0, 1.0)}, {'polynomial': (-877.0,)},
    {'polynomial': (-877.0, 0.0, np.nan)}, {'affine': (0.0, 1.0, 0.0)}])
def test_camera_refuses_what_is_no_lens(change):
    values = {'polynomial': (-877.0, 0.0), 'affine': (1.0, 0.0, 0.0), **change}
    with pytest.raises(InputError, match=next(iter(change))):
        OmnidirectionalCamera(width=64, height=48, fx=877.0, fy=877.0, cx=32.0, cy=24.0,
                              readout_time=0.0, **values)


# --- formats


def test_made_folder_reads_back(made):
    poses, truth = read_poses(made, 'as'), way()
    assert np.array_equal(poses.stamps_ns, truth.stamps_ns)
    assert poses.positions == pytest.approx(truth.positions, abs=1e-8)
    assert (poses.rotations.inv() * truth.rotations).magnitude().max() < 1e-7
    camera = read_camera(made, 'c2', READOUT, 'last')
    assert (camera.width, camera.height, camera.reference_row) == (480, 360, 'last')
    assert (camera.cx, camera.cy) == pytest.approx((239.7, 179.4))
    assert camera.affine == pytest.approx((C2['c'], C2['d'], C2['e']))
    imu = read_imu(made, 'visensor', 'as')
    assert len(imu) == 400
    assert np.linalg.norm(imu[0].linear_acceleration) == pytest.approx(9.8, abs=2.5)
    frames = read_frames(made, 'c2', 'as')
    assert np.array_equal(frames.stamps_ns, truth.stamps_ns)
    assert frames.image(32, camera).shape == (360, 480)


def test_extrinsics_are_those_of_the_published_matrix(made):
    """The data set's site gives T_B_C1 as a matrix, its tools as axis and angle."""
    R, t = read_extrinsics(made, 1)
    assert pytest.approx(np.array([[0.2961304418, 0.0011052645, 0.9551468682],
                                   [0.0191451276, 0.9997915577, -0.0070926152],
                                   [-0.9549556144, 0.0203867479, 0.2960475553]]), abs=2e-5) == R
    assert t == pytest.approx([0.0827, 0.0025, -0.1273], abs=1e-4)


def test_poses_of_a_sensor_put_a_point_where_the_rig_does(made):
    poses = read_poses(made, 'as')
    R, t = read_extrinsics(made, 1)
    moved = poses.of_sensor(R, t)
    on_rig = np.array([0.3, -0.2, 4.0])
    assert moved.rotations.apply(R @ on_rig + t) + moved.positions == pytest.approx(
        poses.rotations.apply(on_rig) + poses.positions)


def test_tango_has_two_sensors_in_two_files(tmp_path):
    lines(tmp_path / 'data/tango_top/as/accelerometer.txt', [[1.0, 0.1, 9.8, 0.2]])
    (tmp_path / 'data/tango_top/as/gyroscope.txt').write_text('1.000, 0.5, 0.6, 0.7\n'
                                                              '0.995, 0.1, 0.2, 0.3\n')
    assert read_imu(tmp_path, 'tango_top', 'as') == (
        ImuSample(995_000_000, (0.1, 0.2, 0.3), None),
        ImuSample(1_000_000_000, None, (0.1, 9.8, 0.2)),
        ImuSample(1_000_000_000, (0.5, 0.6, 0.7), None))


def overwritten(made, tmp_path, name, text):
    folder = tmp_path / 'copy'
    shutil.copytree(made, folder)
    if text is None:
        (folder / name).unlink()
    else:
        (folder / name).write_text(text)
    return folder


@pytest.mark.parametrize(('name', 'text', 'said'), [
    ('data/ground_truth/as/pose.txt', None, 'pose.txt'),
    ('data/ground_truth/as/pose.txt', '1 2 3\n', 'line 1: there must be 13 columns'),
    ('data/ground_truth/as/pose.txt', '', 'at least 4 poses'),
    ('data/ground_truth/as/pose.txt', ''.join(
        f'{k} 1 0 0 0  0 1 0 0  0 0 {z} 0\n' for k, z in enumerate([1, 1, 2, 1])),
     'line 3: columns 2 to 13 must be a rotation'),
    ('tools/intrinsic_calibration/cc.mat', 'no mat', 'does not hold the OCamCalib model of c2'),
    ('tools/misc/extrinsic_calibration.txt', '2 0 1 0 0 0 0 0\n', 'no line for sensor 10'),
    ('tools/misc/extrinsic_calibration.txt', '2 0 2 0 0 0 0 0\n', 'axis of the length 1'),
    ('data/visensor/as/imu.txt', '0.1 0 0 nan 0 0 0\n', 'line 1: column 4 must be a finite'),
    ('data/visensor/as/imu.txt', '99 0 0 9.8 0 0 0\n', 'does not cover the frame'),
    ('data/c2/as/frames/timestamps.txt', '0.2\n0.1\n', 'increasing stamps'),
    ('data/c2/as/frames/timestamps.txt', '0.1\n0.2\n', 'must have a frame 32'),
    ('data/c2/as/frames/frame_0032.png', None, 'extract_frames.bash'),
    ('data/c2/as/frames/frame_0032.png', 'no image', 'but is no image'),
])
def test_what_is_wrong_in_a_folder_is_said(made, tmp_path, name, text, said):
    folder = overwritten(made, tmp_path, name, text)
    with pytest.raises((InputError, MissingInputError), match=re.escape(said)):
        RecordedSequence(folder, 'as', PennCosyvioRun(('as',), ('auto',))).problem(
            Pair('as', 1, 2, 32))


# --- protocol


def test_pairs_are_the_papers():
    """Its table 1 has 67, 66, 72, 43 and 86, 38, 39, 51: frames are lost at its borders."""
    pairs = PennCosyvioRun(('as', 'af'), ()).pairs()
    count = {key: sum((p.sequence, p.stretch) == key for p in pairs)
             for key in ((name, k) for name in STRETCHES for k in range(1, 5))}
    assert list(count.values()) == [67, 67, 73, 43, 85, 37, 37, 49]
    assert pairs[0] == Pair('as', 1, 206, 236)
    assert all(p.second - p.first == 30 for p in pairs)


@pytest.mark.parametrize('change', [{'every': 0}, {'distance': 0}, {'seed': -1},
                                    {'time_offset': np.nan}])
def test_run_refuses_illegal_numbers_by_name(change):
    with pytest.raises(InputError, match=f'^{next(iter(change))} must be'):
        PennCosyvioRun(('as',), ('auto',), **change)


def test_recorded_pair_is_estimated_with_the_imu_as_mounted(made, tmp_path):
    run = PennCosyvioRun(('as',), ('auto', 'auto_gyro'), gyro_bias=GYRO_BIAS)
    problem = RecordedSequence(made, 'as', run).problem(Pair('as', 1, 2, 32))
    poses = way()
    R1, R2 = poses.rotations[1], poses.rotations[31]
    assert pytest.approx((R1.inv() * R2).as_matrix(), abs=1e-7) == problem.R
    assert problem.t == pytest.approx(R1.inv().apply(poses.positions[31] - poses.positions[1]),
                                      abs=1e-6)
    down = R1.inv().apply([0.0, 0.0, -1.0])
    assert np.degrees(np.arccos(down @ problem.motion1.gravity)) < 10.0
    gyro = problem.gyro
    assert np.degrees(Rotation.from_matrix(gyro.rotation.T @ problem.R).magnitude()) < 0.05
    assert gyro.interval == pytest.approx(1.0, abs=1e-6)
    for method in run.methods:
        _, error = run_method(method, problem, 0)
        assert error.rotation < 0.2, method
        assert error.translation < 3.0, method
    # The IMU the wrong way round: the gyro's rotation is off by far.
    text = (made / 'tools/misc/extrinsic_calibration.txt').read_text()
    wrong = overwritten(made, tmp_path, 'tools/misc/extrinsic_calibration.txt',
                        text.replace('1.10000', '-1.10000'))
    turned = RecordedSequence(wrong, 'as', run).problem(Pair('as', 1, 2, 32)).gyro
    assert np.degrees(Rotation.from_matrix(turned.rotation.T @ problem.R).magnitude()) > 3.0


def test_mean_of_the_imu_is_taken_about_the_middle_row():
    """At a constant turn rate the means are exact, at the reference row, bias removed."""
    w, g0 = np.array([0.4, -0.3, 0.2]), np.array([0.0, 9.8, 1.0])
    camera = gopro()
    stamp_ns = 1_000_000_000
    times = 0.9 + 0.001 * np.arange(260)
    # Free fall as the turning camera sees it; the accelerometer feels the opposite.
    down = Rotation.from_rotvec(np.outer(times - 1.0, w)).inv().apply(g0)
    samples = [ImuSample(round(t * 1e9), tuple(w + GYRO_BIAS), tuple(-g))
               for t, g in zip(times, down, strict=True)]
    imu = PairImu(samples, np.eye(3), ImageClock(camera), ImuConfig(gyro_bias=GYRO_BIAS))
    mean = imu.mean(stamp_ns)
    assert mean.motion.angular_velocity == pytest.approx(w)
    assert mean.motion.gravity == pytest.approx(g0 / np.linalg.norm(g0), abs=5e-4)
    assert mean.rate_sigma == pytest.approx(0.0, abs=1e-12)
    # What happens more than 50 ms away does not matter; what happens within is in the spread.
    middle = 1.0 + 0.5 * READOUT
    far = [s if abs(s.stamp_ns * 1e-9 - middle) < 0.051 else
           ImuSample(s.stamp_ns, (9.0, 9.0, 9.0), (1.0, 0.0, 0.0)) for s in samples]
    again = PairImu(far, np.eye(3), ImageClock(camera), ImuConfig(gyro_bias=GYRO_BIAS)).mean(
        stamp_ns)
    assert again.motion.angular_velocity == pytest.approx(w)
    shaken = [ImuSample(s.stamp_ns, tuple(np.array(s.angular_velocity) + 0.1 * (-1.0)**k),
                        s.linear_acceleration) for k, s in enumerate(samples)]
    assert PairImu(shaken, np.eye(3), ImageClock(camera), ImuConfig()).mean(
        stamp_ns).rate_sigma == pytest.approx(0.1, rel=0.01)


# --- simulation on recorded trajectories


def test_recorded_motion_goes_through_the_poses_and_knows_its_derivatives():
    poses = way()
    motion = RecordedMotion(poses)
    seconds = [motion.seconds(int(stamp)) for stamp in poses.stamps_ns]
    rotations, positions = motion.at(seconds)
    assert positions == pytest.approx(poses.positions, abs=1e-12)
    assert (rotations.inv() * poses.rotations).magnitude().max() < 1e-12
    times, h = np.array([0.31, 0.777, 1.5]), 1e-4
    states = motion.states(times)
    (before, p0), (after, p1) = motion.at(times - h), motion.at(times + h)
    assert states.velocity == pytest.approx((p1 - p0) / (2 * h), abs=1e-5)
    assert states.angular_velocity == pytest.approx(
        (before.inv() * after).as_rotvec() / (2 * h), abs=1e-5)
    # The spline's own acceleration against that of the walk: y = 0.1 sin(4 t).
    assert states.acceleration[:, 1] == pytest.approx(-1.6 * np.sin(4.0 * times), abs=0.02)
    with pytest.raises(InputError, match='asked for'):
        motion.at([99.0])


def test_placed_motion_is_the_same_motion_seen_from_the_origin():
    motion = RecordedMotion(way())
    placed = PlacedMotion(motion, 0.5)
    positions, rotations = placed.poses([0.5, 1.3])
    assert positions[0] == pytest.approx([0.0, 0.0, 1.6])
    assert rotations[0, :, 2][0] > 0.9
    assert rotations[0, :, 2][1] == pytest.approx(0.0, abs=1e-12)
    (R1, R2), (p1, p2) = motion.at([0.5, 1.3])
    assert pytest.approx((R1.inv() * R2).as_matrix()) == rotations[0].T @ rotations[1]
    assert rotations[0].T @ (positions[1] - positions[0]) == pytest.approx(R1.inv().apply(p2 - p1))


def test_simulated_points_without_noise_are_exact(made):
    run = PennCosyvioRun(('as',), ('auto_gyro',))
    sequence = SimulatedSequence(made, 'as', run, Simulated(pixel_noise=0.0, outliers=0.0))
    problem = sequence.problem(Pair('as', 1, 11, 41))
    assert len(problem.points1) == 300
    _, error = run_method('auto_gyro', problem, 0)
    # What is left is the gyro's: a bias of 0.1 deg/s over a second, and its noise.
    assert error.rotation < 0.05
    assert error.translation < 1.0


def test_rendered_pair_is_estimated(made):
    run = PennCosyvioRun(('as',), ('auto',))
    problem = SimulatedSequence(made, 'as', run, Simulated(rendered=True)).problem(
        Pair('as', 1, 3, 18))
    _, error = run_method('auto', problem, 0)
    assert len(problem.points1) > 60
    assert error.rotation < 0.5


@pytest.mark.parametrize('values', [{'pixel_noise': -1.0}, {'outliers': 0.99}, {'scene': 'none'}])
def test_simulation_refuses_illegal_figures_by_name(values):
    with pytest.raises(InputError, match=f'^{next(iter(values))} must be'):
        Simulated(**values)


# --- the command


def penncosyvio(*arguments):
    return main.main(['evaluate', 'penncosyvio', *map(str, arguments)])


def test_command_runs_on_the_made_folder(made, tmp_path, capsys, monkeypatch):
    monkeypatch.setitem(STRETCHES, 'as', ((2, 32),))
    for extra in ([], ['--trajectory-only']):
        folder = tmp_path / f'out{len(extra)}'
        assert penncosyvio(made, '--sequences', 'as', '--solvers', 'auto', 'opencv_gyro',
                           '--output', folder, '--gyro-bias', *GYRO_BIAS, *extra) == 0
        shown = capsys.readouterr()
        assert shown.err == ''
        assert ('simulated points' if extra else 'recorded images') in shown.out
        assert {file.name for file in folder.iterdir()} == {
            'trials.csv', 'cells.csv', 'run.json', f'{EXPERIMENT}.png'}
        with (folder / 'trials.csv').open() as file:
            rows = list(csv.DictReader(file))
        assert [(row['method'], row['trial'], row['status']) for row in rows] == [
            ('auto', '2', 'OK'), ('opencv_gyro', '2', 'OK')]
        with (folder / 'cells.csv').open() as file:
            assert [row['level'] for row in csv.DictReader(file)] == ['1', '1', 'all', 'all']


@pytest.mark.parametrize(('arguments', 'said'), [
    (['nowhere'], 'nowhere'),
    (['MADE', '--rendered'], '--rendered needs --trajectory-only'),
    (['MADE', '--camera', 'tango_bottom'], '--readout-time must be given'),
    (['MADE', '--every', '0'], 'every must be at least 1'),
    (['MADE', '--readout-time', '2'], 'readout_time must lie in'),
    (['MADE', '--sequences', 'af', '--trajectory-only'], 'pose.txt'),
])
def test_bad_input_is_one_line_and_exit_code_2(made, tmp_path, arguments, said, capsys):
    words = [str(made) if word == 'MADE' else word for word in arguments]
    assert penncosyvio(*words, '--output', tmp_path / 'out') == 2
    error = capsys.readouterr().err
    assert said in error and error.count('\n') == 1
    assert not (tmp_path / 'out').exists()


def test_totals_are_of_all_levels_of_a_case():
    records = [Record('x', 'as', str(level), 'auto', 0, Status.OK, PoseError(1.0 * level, 2.0))
               for level in (1, 2, 3)]
    records.append(Record('x', 'af', '1', 'auto', 0, Status.NO_CONSENSUS, NO_POSE))
    cases = by_case(records, totals=True)
    assert {case: list(levels) for case, levels in cases.items()} == {
        ('x', 'as'): ['1', '2', '3', 'all'], ('x', 'af'): ['1', 'all']}
    assert list(cases['x', 'as']['all']['auto'].rotation) == [1.0, 2.0, 3.0]
    shown = tables(cases, {('x', 'as'): '', ('x', 'af'): ''}, 'part')
    assert 'no pose: auto, 1 of 1\n' in shown


@pytest.mark.recordings
def test_recorded_trajectories_carry_a_simulation(recordings, tmp_path, capsys):
    """Every hundredth frame: 24 pairs; figures of more stand in docs/lab/evaluation.md."""
    assert penncosyvio(recordings / 'penncosyvio', '--trajectory-only', '--every', '100',
                       '--solvers', 'auto_gyro', 'global_5pt', '--output', tmp_path) == 0
    with (tmp_path / 'cells.csv').open() as file:
        found = {(row['case'], row['method']): row for row in csv.DictReader(file)
                 if row['level'] == 'all'}
    for case in STRETCHES:
        ours, theirs = (float(found[case, method]['rotation_median_deg'])
                        for method in ('auto_gyro', 'global_5pt'))
        assert ours < 0.05
        assert theirs > 4.0 * ours
