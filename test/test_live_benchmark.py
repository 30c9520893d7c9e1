"""The live benchmark: its endless clip, its statistics, and one short run with its report."""

from dataclasses import replace
import sys

from conftest import ROOT
import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from rs_relpose_lab.experiments import live, live_clip
from rs_relpose_lab.live.live_run import ReceivedPose
from rs_relpose_lab.live.player import Outgoing, repeated, stamp_of
from rs_relpose_ros.errors import InputError
from rs_relpose_ros.nodes.diagnostics import FrameTimings

# The node may have to compile the kernels.
pytestmark = pytest.mark.timeout(600)

SECOND = 10**9


@pytest.mark.parametrize('period', [2.0, 4.0, 6.5])
def test_the_walk_ends_as_it_began(period):
    motion = live_clip.closed_loop(period)
    times = np.array([-0.4, 0.0, 0.3, 1.1])
    before, after = motion.states(times), motion.states(times + period)
    for name in ('position', 'velocity', 'acceleration', 'R_world_cam', 'angular_velocity',
                 'angular_acceleration'):
        np.testing.assert_allclose(getattr(before, name), getattr(after, name), atol=1e-9)
    states = motion.states(np.arange(0.0, period, 0.01))
    speed = np.linalg.norm(states.velocity, axis=1)
    assert speed.mean() == pytest.approx(1.5, rel=0.02)
    assert speed.min() > 0.8
    rms = np.sqrt((states.angular_velocity**2).sum(axis=1).mean())
    assert np.degrees(rms) == pytest.approx(30.0, rel=0.2)


def message(due_ms: int, stamp_ms: int, topic: str = 'imu', big_endian: bool = False) -> Outgoing:
    order = 'big' if big_endian else 'little'
    stamp = (7).to_bytes(4, order) + (stamp_ms * 10**6).to_bytes(4, order)
    return Outgoing(due_ms * 10**6, topic, '',
                    bytes([0, 0 if big_endian else 1, 0, 0]) + stamp + topic.encode())


@pytest.mark.parametrize('big_endian', [False, True])
def test_rounds_follow_without_a_seam(big_endian):
    """An image is delivered later than the IMU: at the end of a round it comes into the next."""
    once = [message(0, 0, 'imu', big_endian), message(50, 50, 'imu', big_endian),
            message(70, 0, 'image', big_endian), message(120, 50, 'image', big_endian)]
    out = list(repeated(once, 100 * 10**6, 330 * 10**6))
    dues = [item.due_ns // 10**6 for item in out]
    assert dues == sorted(dues)
    found = [(item.topic, item.due_ns // 10**6, (stamp_of(item.data) - 7 * SECOND) // 10**6)
             for item in out]
    for topic, delay in (('imu', 0), ('image', 70)):
        assert [entry[1:] for entry in found if entry[0] == topic] == [
            (stamp + delay, stamp) for stamp in range(0, 330 - delay, 50)]
    assert all(item.data[12:] == item.topic.encode() for item in out)


def test_stamps_run_over_seconds_and_a_long_recording_is_no_period():
    last = [*repeated([message(0, 999)], 10**8, 3 * 10**8)][-1]
    assert stamp_of(last.data) == 8 * SECOND + 199 * 10**6
    with pytest.raises(InputError, match=r'no period of 0\.1 s'):
        next(repeated([message(0, 0), message(100, 100)], 10**8, SECOND))


def pose(first: int, second: int, error: np.ndarray | None = None) -> ReceivedPose:
    """The true pose between two stamps of the clip's eleventh round, and an error."""
    start = live_clip.configuration(640, 480).start_ns
    stamps = [start + 40 * SECOND + k for k in (first, second)]
    (p1, p2), (R1, R2) = live_clip.closed_loop(live_clip.PERIOD).poses(
        [first / SECOND, second / SECOND])
    R, t = R1.T @ R2, R1.T @ (p2 - p1)
    if error is not None:
        R, t = Rotation.from_rotvec(error).as_matrix() @ R, Rotation.from_rotvec(error).apply(t)
    return ReceivedPose(*stamps, received_ns=0, t=t / np.linalg.norm(t),
                        quat_xyzw=Rotation.from_matrix(R).as_quat())


def test_errors_are_against_the_truth_of_any_round():
    rotation, translation = live.errors([pose(0, SECOND // 5), pose(SECOND, 2 * SECOND)])
    np.testing.assert_allclose([rotation, translation], 0.0, atol=1e-5)
    rotation, translation = live.errors([pose(0, SECOND // 5, np.array([0.01, 0.0, 0.0]))])
    np.testing.assert_allclose(rotation, np.degrees(0.01), rtol=1e-6)
    assert 0.0 < translation[0] <= np.degrees(0.01) + 1e-9


@pytest.mark.parametrize('slope', [0.0, 50.0])
def test_drift_of_memory_and_latency_by_minutes(slope):
    seconds = np.arange(0.0, 600.0, 1.0)
    memory = 150.0 + slope * seconds / 3600.0
    memory[:20] -= 30.0 * np.linspace(1.0, 0.0, 20)   # while caches fill
    course = live.Course(seconds, 10.0 + (seconds >= 300.0), seconds, memory)
    assert live.memory_drift(course) == pytest.approx(slope, rel=1e-3, abs=1e-6)
    windows = live.latency_over_time(course)
    assert [start for start, _ in windows] == [60.0 * k for k in range(10)]
    assert [latency.p50 for _, latency in windows] == [10.0] * 5 + [11.0] * 5


# A command line that notes its runs and measures a latency of `value`, then twice that.
CHECKOUT = """
from pathlib import Path
import sys
folder = Path(sys.argv[sys.argv.index('--output') + 1])
runs = Path(__file__).parents[3] / 'runs'
runs.open('a').write(f'{value} {{sys.argv[4]}} {{sys.argv[-1]}}\\n')
value = {value} * 2**(runs.read_text().count('{value} ') - 1)
folder.mkdir(parents=True, exist_ok=True)
(folder / 'live.csv').write_text('{columns}\\n' + ','.join(['7', '', *[str(value)] * 7]))
sys.exit({code})
"""


@pytest.fixture
def checkout(tmp_path):
    def made(name, value, code=0):
        command = tmp_path / name / 'rs_relpose_ros' / 'cli' / 'main.py'
        command.parent.mkdir(parents=True)
        (command.parents[1] / '__init__.py').touch()
        command.write_text(CHECKOUT.format(value=value, code=code,
                                           columns=','.join(['cell', *live.COMPARED])))
        return tmp_path / name
    return made


def test_two_checkouts_run_by_turns(tmp_path, checkout):
    calls = []
    report = live.compare_checkouts(
        checkout('a', 3), checkout('b', 2), ['x'], ['--duration', '5'], 3, tmp_path / 'out',
        lambda: calls.append(1))
    assert (tmp_path / 'runs').read_text() == '3 x 5\n2 x 5\n' * 3 and len(calls) == 6
    assert report.count('1.50 (1.50 to 1.50)') == 7 and report.count('nan (nan to nan)') == 1
    with pytest.raises(InputError, match=r'c: benchmark live ended with code 3'):
        live.compare_checkouts(checkout('c', 1, 3), checkout('d', 1), ['x'], [], 1, tmp_path)


def test_against_a_folder_without_the_package(tmp_path, refused):
    refused('is no checkout', 'benchmark', 'live', '--against', tmp_path, '--output',
            tmp_path / 'out')


def test_without_ros_nothing_is_rendered(monkeypatch, tmp_path, refused):
    monkeypatch.setitem(sys.modules, 'rs_relpose_lab.live.live_run', None)
    refused('needs ROS 2', 'benchmark', 'live', '--output', tmp_path / 'out')
    assert not (tmp_path / 'out').exists()


def test_frame_timings_name_what_cannot_be_written(tmp_path):
    with pytest.raises(InputError, match=r'timings_file .* cannot be written'):
        FrameTimings(str(tmp_path / 'nowhere' / 'frames.csv'))


@pytest.mark.live
def test_a_run_and_its_report(tmp_path, ros_domain_id, monkeypatch):
    """Three seconds of small images, as any cell is run."""
    monkeypatch.setattr(live_clip, 'PERIOD', 2.0)
    cell, seconds = live.LiveCell(320, 240, 'bgr8', 200), []
    clip = live_clip.prepare_clip(tmp_path, cell.width, cell.height)
    found, over_time = live.run_cell(cell, clip, 3.0, tmp_path / cell.name,
                                     ROOT / 'config' / 'fastdds.xml', lambda: seconds.append(1))
    # The last two images would have no IMU.
    assert (found.frames_sent, found.imu_sent) == (90 - 2, 600)
    assert found.frames_received <= found.frames_sent
    refused = found.dropped_overload + found.dropped_other
    assert found.frames_used + refused == found.frames_received
    assert 5 < found.poses <= found.pairs < found.frames_used
    assert found.wrong == 0 and found.rotation_error.p50 < 0.2
    assert len(seconds) >= 2
    for times in (found.latency, found.end_to_end, found.frame_time, found.frame_cpu):
        assert 0.0 < times.p50 <= times.p99 <= times.largest
    # From outside it cannot be faster than from inside, except for the rest of the distribution.
    assert found.end_to_end.largest > found.latency.p50
    assert 0.0 < found.cpu_callbacks < found.cpu
    assert len(over_time.latencies) == found.poses
    assert 0.0 < found.private_end < found.memory_end
    # The clip is not rendered again.
    assert live_clip.prepare_clip(tmp_path, cell.width, cell.height, pytest.fail) == clip
    other = replace(found, cell='another', latency=live.Percentiles(np.nan, np.nan, np.nan))
    report = live.write_report(tmp_path, [found, other])
    assert report.count(f'| {cell.name}') == report.count('| another ') == 3
    assert f'{found.poses} of {found.pairs}' in report
    header, first, _ = (tmp_path / 'live.csv').read_text().splitlines()
    assert header.startswith('cell,duration,frames_sent') and 'latency_p99' in header
    assert first.startswith(f'{cell.name},3.0,88')
    assert 'MB/h' in live.write_soak_report(tmp_path / 'soak', found, over_time)
