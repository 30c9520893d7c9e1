"""Relative poses of chosen pairs: on the bundled bag, where a walk returns, and bad lists."""

from dataclasses import replace
import gc
import math
from pathlib import Path
import subprocess
import sys
import weakref

from conftest import BUNDLED_PARAMETERS, ROOT, rows_of
import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from rs_relpose_lab.simulation import simulate, SimulationConfig
from rs_relpose_lab.simulation.bag import intrinsics_of, render_once
from rs_relpose_lab.simulation.trajectory import Trajectory
from rs_relpose_ros.cli.main import main
from rs_relpose_ros.config.files import read_parameters
from rs_relpose_ros.errors import InputError
from rs_relpose_ros.imu.buffer import ImuBuffer, ImuSample
from rs_relpose_ros.messages.incoming import Role
from rs_relpose_ros.pipeline.chosen_pairs import ChosenPairs, estimate_wide_pair, view_frame
from rs_relpose_ros.pipeline.pair import Frame

START_NS = 1_700_000_000_000_000_000
HEAD = 'reference_stamp_ns,stamp_ns\n'
COLUMNS = (
    'reference_stamp_ns,stamp_ns,tx,ty,tz,qx,qy,qz,qw,sigma_t1,sigma_t2,sigma_rx,sigma_ry,'
    'sigma_rz,inliers,matches,model,status,baseline_m,baseline_log_sigma,reason'
)


def stamp_of(frame: int, fps: float = 30.0) -> int:
    """As the simulation stamps its frames."""
    return START_NS + round(frame * 1e9 / fps)


def pairs_command(bag: Path, listed: Path, out: Path, *options: object) -> list[str]:
    return [
        'pairs',
        str(bag),
        '--list',
        str(listed),
        '--out',
        str(out),
        *map(str, options or ('--params', BUNDLED_PARAMETERS)),
    ]


def run_pairs(
    bag: Path, parameters: Path, pairs: list[tuple[int, int]], folder: Path, *options: str
) -> tuple[int, list[dict[str, str]]]:
    folder.mkdir(exist_ok=True)
    listed = folder / 'pairs.csv'
    listed.write_text(HEAD + ''.join(f'{first},{second}\n' for first, second in pairs))
    code = main(pairs_command(bag, listed, folder / 'out', '--params', parameters, *options))
    return code, rows_of(folder / 'out' / 'relative_poses.csv')


def assert_within_covariance(rows: list[dict[str, str]], errors: list[dict[str, str]]) -> None:
    """No error is larger than three sigmas of all axes together."""
    for row, error in zip(rows, errors, strict=True):
        for name, sigmas in (('translation', ('t1', 't2')), ('rotation', ('rx', 'ry', 'rz'))):
            sigma = math.hypot(*(float(row[f'sigma_{axis}']) for axis in sigmas))
            assert float(error[f'{name}_error_deg']) < 3.0 * math.degrees(sigma)


# From 0.3 to 3.6 s apart, with parallax; not in the order of time.
GOOD = [(45, 81), (0, 9), (0, 48), (9, 75), (115, 157), (0, 69)]
BAD = {
    (stamp_of(9), stamp_of(0)): 'reference_stamp_ns must be before stamp_ns: exchange them',
    (stamp_of(9), stamp_of(9)): 'give two different images',
    (5, stamp_of(9)): 'has the stamp 5',
    (stamp_of(9), stamp_of(9) + 1): f'has the stamp {stamp_of(9) + 1}',
}


@pytest.fixture(scope='module')
def bundled(bundled_bag, tmp_path_factory):
    """Exit code and rows of `GOOD`, `BAD` and `GOOD` again, and the errors."""
    folder = tmp_path_factory.mktemp('pairs')
    good = [(stamp_of(a), stamp_of(b)) for a, b in GOOD]
    code, rows = run_pairs(bundled_bag, BUNDLED_PARAMETERS, [*good, *BAD, *good], folder)
    return code, rows, rows_of(folder / 'out' / 'errors.csv'), folder


def test_every_row_of_the_list_has_one_in_its_order(bundled):
    code, rows, _, folder = bundled
    assert code == 0
    assert (folder / 'out' / 'relative_poses.csv').read_text().splitlines()[0] == COLUMNS
    listed = rows_of(folder / 'pairs.csv')
    assert [(row['reference_stamp_ns'], row['stamp_ns']) for row in rows] == [
        (row['reference_stamp_ns'], row['stamp_ns']) for row in listed
    ]
    # Independently of the rest of the list.
    assert rows[: len(GOOD)] == rows[-len(GOOD) :]


def test_wide_pairs_agree_with_the_truth(bundled):
    """Baselines of 0.6 to 4.2 m, over which no corner is followed."""
    rows, errors = (table[: len(GOOD)] for table in bundled[1:3])
    assert {(row['status'], row['reason']) for row in rows} == {('OK', '')}
    for name, median, largest in (('rotation', 0.1, 0.2), ('translation', 0.4, 1.0)):
        found = [float(row[f'{name}_error_deg']) for row in errors]
        assert np.median(found) < median
        assert max(found) < largest
    assert_within_covariance(rows, errors)


def test_rows_that_cannot_be_estimated_have_the_reason(bundled):
    _, rows, _, _ = bundled
    for row in rows[len(GOOD) : -len(GOOD)]:
        assert row['status'] == 'BAD_INPUT'
        assert BAD[int(row['reference_stamp_ns']), int(row['stamp_ns'])] in row['reason']
        assert row['tx'] == row['inliers'] == ''


@pytest.mark.parametrize(
    ('last', 'setting', 'status', 'reason'),
    [
        # The last frame's gyro lies behind the end of the bag.
        (179, 'time_offset=0.2', 'BAD_INPUT', 'the gyro ends before the last row'),
        (9, 'max_descriptors=8', 'TOO_FEW_MATCHES', 'usable matches'),
    ],
)
def test_pair_without_gyro_or_matches(bundled_bag, tmp_path, last, setting, status, reason):
    code, [row] = run_pairs(
        bundled_bag,
        BUNDLED_PARAMETERS,
        [(stamp_of(0), stamp_of(last))],
        tmp_path,
        '--set',
        setting,
    )
    assert (code, row['status']) == (1, status)
    assert reason in row['reason']


@pytest.mark.parametrize(
    ('text', 'words'),
    [
        ('', 'has no pairs below a line with the column names reference_stamp_ns and stamp_ns'),
        ('1,2\n3,4\n', 'line 2: it has no column reference_stamp_ns'),
        (HEAD, 'has no pairs'),
        (
            f'{HEAD}1, 2\n1.7e18,3\n',
            'line 3: column reference_stamp_ns must be a stamp in nanoseconds, an integer',
        ),
        (f'{HEAD}1\n', 'line 2: column stamp_ns must be'),
    ],
)
def test_list_that_is_none(text, words, bundled_bag, tmp_path, refused):
    listed = tmp_path / 'pairs.csv'
    listed.write_text(text)
    refused(words, *pairs_command(bundled_bag, listed, tmp_path / 'out'))
    assert not (tmp_path / 'out').exists()


def test_results_replace_those_of_an_earlier_run_but_not_the_list(
    bundled_bag, tmp_path, refused, monkeypatch
):
    def refuse(_: object, role: Role, message: object) -> InputError | None:
        return InputError('not calibrated') if role is Role.CAMERA_INFO else None

    listed = tmp_path / 'relative_poses.csv'
    out = tmp_path / 'out'
    listed.write_text(f'{HEAD}1,2\n')
    refused('would replace the list', *pairs_command(bundled_bag, listed, tmp_path))
    assert listed.read_text() == f'{HEAD}1,2\n'
    out.mkdir()
    for name in ('relative_poses.csv', 'errors.csv', 'summary.json'):
        (out / name).write_text('earlier')
    monkeypatch.setattr('rs_relpose_ros.messages.incoming.Intake.receive', refuse)
    refused('not calibrated', *pairs_command(bundled_bag, listed, out))
    assert not list(out.iterdir())


FPS = 5.0
SECONDS = 6.0
LAST = round(FPS * SECONDS) - 1
CLOSE = 4  # frames from the first one, 0.8 s


def loop() -> Trajectory:
    """Away, around and back, to 0.3 m beside the start, looking 10 deg to the side."""
    spacing = 0.05
    times = np.arange(-1.0, SECONDS + 1.0, spacing)
    phase = np.clip(times / (LAST / FPS), 0.0, 1.0)
    turn = 2.0 * np.pi * phase
    positions = np.column_stack(
        [
            0.6 * (1.0 - np.cos(turn)) - 0.6 + 0.05 * phase,
            0.5 * np.sin(turn) + 0.3 * phase,
            1.6 + 0.04 * np.sin(11.0 * times),
        ]
    )
    angles = np.column_stack(
        [
            0.5 * np.sin(turn) + math.radians(10.0) * phase + 0.02 * np.sin(7.0 * times),
            0.05 * np.sin(5.0 * times),
            0.04 * np.sin(3.0 * times),
        ]
    )
    return Trajectory(positions, angles, float(times[0]), spacing)


@pytest.fixture(scope='module')
def returned(tmp_path_factory):
    """Bag and parameters of the loop."""
    folder = tmp_path_factory.mktemp('loop')
    config = SimulationConfig(duration=SECONDS, fps=FPS, seed=11)
    return (*render_once(config, folder, loop()), simulate(config, trajectory=loop()))


def test_loop_is_closed(returned, tmp_path):
    """Start and end of the walk, 5.8 s apart: the gyro between them is not in the history."""
    bag, parameters, _ = returned
    pairs = [
        (stamp_of(a, FPS), stamp_of(b, FPS)) for a, b in [(0, LAST), (1, LAST - 1), (2, LAST)]
    ]
    code, rows = run_pairs(bag, parameters, pairs, tmp_path)
    assert code == 0
    assert [row['status'] for row in rows] == ['OK'] * len(pairs)
    assert_within_covariance(rows, errors := rows_of(tmp_path / 'out' / 'errors.csv'))
    for error in errors:
        assert float(error['rotation_error_deg']) < 0.15
        # Baselines of 0.1 to 0.3 m.
        across = float(error['baseline_m']) * math.radians(float(error['translation_error_deg']))
        assert across < 0.01


@pytest.fixture(scope='module')
def library(returned):
    """Parameters, a buffer of the whole walk, and its first and last frame."""
    _, parameter_file, simulation = returned
    camera = simulation.camera
    series = simulation.imu
    parameters = read_parameters(parameter_file, ['imu_buffer_seconds=60'])
    imu = ImuBuffer(parameters.imu)
    for stamp, rate, force in zip(
        series.stamps_ns, series.angular_velocities, series.linear_accelerations, strict=True
    ):
        imu.add(ImuSample(int(stamp), tuple(rate), tuple(force)))
    frames = [
        Frame(simulation.stamp_ns(k), simulation.image(k), 'camera', intrinsics_of(camera))
        for k in (0, LAST)
    ]
    return parameters, imu, frames


def test_frames_and_an_imu_buffer(library, returned):
    parameters, imu, frames = library
    first = view_frame(frames[0], imu, parameters)
    second = view_frame(frames[1], imu, parameters, since=first)
    pose = estimate_wide_pair(first, second, parameters).pose
    states = returned[2].states([first.imu.reference_ns, second.imu.reference_ns])
    R1, R2 = states.R_world_cam
    true = R1.T @ (states.position[1] - states.position[0])
    assert np.linalg.norm(Rotation.from_matrix(pose.R.T @ R1.T @ R2).as_rotvec(True)) < 0.15
    assert math.degrees(math.acos(pose.t @ true / np.linalg.norm(true))) < 2.0
    # The buffer covers the rotation between them, too.
    assert second.imu.since_previous is not None
    with pytest.raises(InputError, match='must be later than the first: exchange them'):
        estimate_wide_pair(second, first, parameters)


def test_frames_between_close_ones_are_used(library, returned):
    parameters, imu, _ = library
    parameters = parameters.updated({'max_keyframe_interval': 1.0})
    simulation = returned[2]
    views = []
    done = {}
    frames = [
        Frame(
            simulation.stamp_ns(k), simulation.image(k), 'camera', intrinsics_of(simulation.camera)
        )
        for k in range(CLOSE + 1)
    ]
    ends = frames[0].stamp_ns, frames[-1].stamp_ns
    pairs = ChosenPairs([ends])
    for frame in frames:
        views.append(view_frame(frame, imu, parameters, views[-1] if views else None))
        done |= pairs.process(views[-1], parameters) or {}
    later = [view_frame(frame, imu, parameters, since=views[0]) for frame in frames[1:]]
    pose = estimate_wide_pair(views[0], later[-1], parameters, later[:-1]).pose
    assert pose.diagnostics.frames == done[ends].pose.diagnostics.frames == 5
    np.testing.assert_allclose(done[ends].pose.t, pose.t, atol=1e-4)
    states = simulation.states([views[k].imu.reference_ns for k in (0, -1)])
    true = states.R_world_cam[0].T @ (states.position[1] - states.position[0])
    true /= np.linalg.norm(true)
    two = estimate_wide_pair(views[0], later[-1], parameters).pose
    assert two.diagnostics.frames == 2
    assert np.linalg.norm(pose.t - true) < 0.8 * np.linalg.norm(two.t - true)
    # Frames with another gyro or another calibration are left out.
    zoomed = [replace(view, intrinsics=replace(view.intrinsics, fx=500.0)) for view in later[:-1]]
    for others in (views[2:-1], zoomed):
        assert (
            estimate_wide_pair(views[0], later[-1], parameters, others).pose.diagnostics.frames
            == 2
        )


def test_images_are_kept_until_the_last_of_their_pairs(library):
    """Four frames in a row: the first waits for the last, the second only for the third."""
    parameters, imu, (frame, _) = library
    stamps = [START_NS + k * 10**9 for k in range(4)]
    pairs = ChosenPairs([(stamps[0], stamps[3]), (stamps[1], stamps[2])])
    images = []
    done = {}
    since = None
    for stamp in stamps:
        image = np.zeros_like(frame.image)
        images.append(weakref.ref(image))
        view = view_frame(replace(frame, stamp_ns=stamp, image=image), imu, parameters, since)
        done |= pairs.process(view, parameters) or {}
        since = replace(view, image=frame.image)
        del image, view
        if stamp == stamps[2]:
            gc.collect()
            assert [one() is not None for one in images] == [True, False, False]
    assert list(done) == [(stamps[1], stamps[2]), (stamps[0], stamps[3])]
    # The gyro is propagated over the frames between.
    assert all(pair.gyro_rotation is not None for pair in done.values())


def test_other_intrinsics_and_a_frame_outside_of_the_buffer(library):
    parameters, imu, (frame1, frame2) = library
    first = view_frame(frame1, imu, parameters)
    zoomed = replace(frame2, intrinsics=replace(frame2.intrinsics, fx=500.0))
    with pytest.raises(InputError, match='intrinsics changed'):
        estimate_wide_pair(first, view_frame(zoomed, imu, parameters), parameters)
    with pytest.raises(InputError, match='does not cover'):
        view_frame(replace(frame2, stamp_ns=frame2.stamp_ns + 10**10), imu, parameters)


def test_the_example_of_the_documentation_gives_the_pose_of_the_command(bundled_bag, bundled):
    """The script of the documentation gives the pose of the command line."""
    _, rows, _, _ = bundled
    row = rows[3]
    ended = subprocess.run(
        [
            sys.executable,
            ROOT / 'docs' / 'examples' / 'loop_closure.py',
            bundled_bag,
            BUNDLED_PARAMETERS,
            row['reference_stamp_ns'],
            row['stamp_ns'],
        ],
        capture_output=True,
        text=True,
        timeout=140,
        check=False,
    )
    assert ended.returncode == 0, ended.stderr
    printed = np.array([line.split() for line in ended.stdout.splitlines()], dtype=float)
    R = Rotation.from_quat([float(row[f'q{axis}']) for axis in 'xyzw']).as_matrix()
    # Its history of the gyro reaches over both frames, that of the command line does not.
    np.testing.assert_allclose(printed[:, :3], R, atol=2e-3)
    np.testing.assert_allclose(
        printed[:, 3], [float(row[f't{axis}']) for axis in 'xyz'], atol=1e-2
    )
