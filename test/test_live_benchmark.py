"""The live benchmark: its endless clip, its figures, its report, and one short run."""

from __future__ import annotations

from dataclasses import replace
import mmap
import os
import sys

from conftest import ROOT
import cv2
import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from rs_relpose_lab.cli.benchmark import matching_cells
from rs_relpose_lab.experiments import live, live_clip, live_report
from rs_relpose_lab.experiments.live import Course, LiveCell, Percentiles
from rs_relpose_lab.live.loop import in_turns, Outgoing, stamp_of
from rs_relpose_lab.live.measured_run import ReceivedPose
from rs_relpose_lab.live.processes import process_figures
from rs_relpose_ros.cli.main import main
from rs_relpose_ros.errors import InputError
from rs_relpose_ros.node.frame_timings import COLUMNS, FrameTimings

# The node may have to compile the kernels.
pytestmark = pytest.mark.timeout(600)

SECOND = 10**9


# -- motion and messages without a seam ------------------------------------------------------


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
    # As told, and as hand-held as the text says.
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
def test_turn_follows_turn(big_endian):
    """An image is delivered later than the IMU: at the end of a turn it comes into the next."""
    once = [message(0, 0, 'imu', big_endian), message(50, 50, 'imu', big_endian),
            message(70, 0, 'image', big_endian), message(120, 50, 'image', big_endian)]
    out = list(in_turns(once, 100 * 10**6, 330 * 10**6))
    dues = [item.due_ns // 10**6 for item in out]
    assert dues == sorted(dues)
    found = [(item.topic, item.due_ns // 10**6, (stamp_of(item.data) - 7 * SECOND) // 10**6)
             for item in out]
    for topic, delay in (('imu', 0), ('image', 70)):
        assert [entry[1:] for entry in found if entry[0] == topic] == [
            (stamp + delay, stamp) for stamp in range(0, 330 - delay, 50)]
    assert all(item.data[12:] == item.topic.encode() for item in out)


def test_stamps_run_over_seconds_and_a_long_recording_is_no_period():
    last = [*in_turns([message(0, 999)], 10**8, 3 * 10**8)][-1]
    assert stamp_of(last.data) == 8 * SECOND + 199 * 10**6
    with pytest.raises(InputError, match=r'no period of 0\.1 s'):
        next(in_turns([message(0, 0), message(100, 100)], 10**8, SECOND))
    assert list(in_turns([], 10**8, SECOND)) == []


# -- figures ---------------------------------------------------------------------------------


def pose(first: int, second: int, turn: np.ndarray | None = None) -> ReceivedPose:
    """The true pose between two stamps of the clip's tenth turn, and an error."""
    start = live_clip.configuration(640, 480).start_ns
    stamps = [start + 40 * SECOND + k for k in (first, second)]
    (p1, p2), (R1, R2) = live_clip.closed_loop(live_clip.PERIOD).poses(
        [first / SECOND, second / SECOND])
    R, t = R1.T @ R2, R1.T @ (p2 - p1)
    if turn is not None:
        R, t = Rotation.from_rotvec(turn).as_matrix() @ R, Rotation.from_rotvec(turn).apply(t)
    return ReceivedPose(*stamps, received_ns=0, t=t / np.linalg.norm(t),
                        quat_xyzw=Rotation.from_matrix(R).as_quat())


def test_errors_are_against_the_truth_of_any_turn():
    rotation, translation = live.errors([pose(0, SECOND // 5), pose(SECOND, 2 * SECOND)])
    np.testing.assert_allclose(rotation, 0.0, atol=1e-5)
    np.testing.assert_allclose(translation, 0.0, atol=1e-5)
    rotation, translation = live.errors([pose(0, SECOND // 5, np.array([0.01, 0.0, 0.0]))])
    np.testing.assert_allclose(rotation, np.degrees(0.01), rtol=1e-6)
    assert 0.0 < translation[0] <= np.degrees(0.01) + 1e-9
    assert live.errors([])[0].shape == (0,)


def test_figures_of_a_process_are_those_of_this_one():
    before = process_figures(os.getpid())
    # Memory of its own: an array may lie in what another one left to the process.
    memory = mmap.mmap(-1, 32_000_000, mmap.MAP_PRIVATE | mmap.MAP_ANONYMOUS)
    mine = np.ndarray(4_000_000, buffer=memory)
    mine[:] = 1.0
    while process_figures(os.getpid()).cpu < before.cpu + 0.05:
        mine += 1.0
    after = process_figures(os.getpid())
    assert after.private - before.private == pytest.approx(mine.nbytes / 2**20, abs=16.0)
    assert after.cpu >= after.cpu_main > before.cpu_main
    assert after.resident >= after.private > 0.0
    assert after.time_ns > before.time_ns


def course(slope: float, minutes: float = 10.0) -> Course:
    seconds = np.arange(0.0, 60.0 * minutes, 1.0)
    memory = 150.0 + slope * seconds / 3600.0
    memory[:20] -= 30.0 * np.linspace(1.0, 0.0, 20)   # while caches fill
    return Course(seconds, 10.0 + (seconds >= 300.0), seconds, memory + 100.0, memory)


def test_a_leak_is_seen_and_settling_is_none():
    assert live_report.memory_drift(course(0.0)) == pytest.approx(0.0, abs=1e-6)
    assert live_report.memory_drift(course(50.0)) == pytest.approx(50.0, rel=1e-3)


def test_latency_over_time_is_by_minutes():
    windows = live_report.latency_over_time(course(0.0))
    assert [start for start, _ in windows] == [60.0 * k for k in range(10)]
    assert [latency.p50 for _, latency in windows] == [10.0] * 5 + [11.0] * 5
    assert len(live_report.latency_over_time(course(0.0, 0.5))) == 10


def test_cells_are_selected_by_pattern(capsys):
    assert len(live.CELLS) == 18
    assert matching_cells(['1920x1080-b*'], live.CELLS) == (
        '1920x1080-bgr8-imu200', '1920x1080-bgr8-imu400')
    assert live.CELLS['1280x720-mono8-imu200'].is_big
    assert not live.CELLS['640x480-mono8-imu200'].is_big
    assert live.CELLS['1920x1080-jpeg-imu200'].is_big
    assert not live.CELLS['1280x720-jpeg-imu200'].is_big
    assert main(['benchmark', 'live', '--cells', '4k-*']) == 2
    assert 'no cell is named' in capsys.readouterr().err
    assert main(['benchmark', 'live', '--duration', '1']) == 2
    assert '--duration must be at least 5' in capsys.readouterr().err


def test_without_ros_it_is_said_before_anything_is_rendered(monkeypatch, tmp_path, capsys):
    monkeypatch.setitem(sys.modules, 'rs_relpose_lab.live.measured_run', None)
    assert main(['benchmark', 'live', '--output', str(tmp_path / 'out')]) == 2
    assert 'needs ROS 2' in capsys.readouterr().err
    assert not (tmp_path / 'out').exists()


def test_frame_timings_name_what_cannot_be_written(tmp_path):
    with pytest.raises(InputError, match=r'timings_file .* cannot be written'):
        FrameTimings(str(tmp_path / 'nowhere' / 'frames.csv'))
    timings = FrameTimings(str(tmp_path / 'frames.csv'))
    timings.close()
    assert (tmp_path / 'frames.csv').read_text() == ','.join(COLUMNS) + '\n'


# -- a run -----------------------------------------------------------------------------------


@pytest.fixture(scope='module')
def measured(tmp_path_factory, module_ros_domain_id):
    """Six seconds of small images, as any cell is run."""
    folder = tmp_path_factory.mktemp('live')
    cell = LiveCell(320, 240, 'bgr8', 200)
    clip = live_clip.prepare_clip(folder / 'clips', cell.width, cell.height)
    seconds: list[None] = []
    statistics, over_time = live.run_cell(
        cell, clip, 6.0, folder / cell.name, ROOT / 'config' / 'fastdds.xml',
        lambda: seconds.append(None))
    return folder, clip, statistics, over_time, seconds


@pytest.mark.live
def test_a_run_is_counted_from_both_ends(measured):
    _, _, statistics, _, seconds = measured
    # The last two images would have no IMU.
    assert statistics.frames_sent == 180 - 2
    assert statistics.imu_sent == 1200
    assert statistics.frames_received <= statistics.frames_sent
    refused = statistics.dropped_overload + statistics.dropped_other
    assert statistics.frames_used + refused == statistics.frames_received
    assert 5 < statistics.poses <= statistics.pairs < statistics.frames_used
    assert statistics.wrong == 0
    assert statistics.rotation_error.p50 < 0.2
    assert len(seconds) >= 3


@pytest.mark.live
def test_times_of_a_run_hang_together(measured):
    _, _, statistics, over_time, _ = measured
    for figure in (statistics.latency, statistics.end_to_end, statistics.frame_time,
                   statistics.frame_cpu):
        assert 0.0 < figure.p50 <= figure.p99 <= figure.largest
    # From outside it cannot be faster than from inside, but for what the median leaves open.
    assert statistics.end_to_end.largest > statistics.latency.p50
    assert 0.0 < statistics.cpu_callbacks < statistics.cpu
    assert len(over_time.latencies) == statistics.poses
    assert 0.0 < statistics.private_end < statistics.memory_end


@pytest.mark.live
def test_a_clip_is_rendered_once(measured):
    folder, clip, _, _, _ = measured
    frames: list[None] = []
    assert live_clip.prepare_clip(folder / 'clips', 320, 240, lambda: frames.append(None)) == clip
    assert frames == []


@pytest.mark.live
def test_the_report_has_every_cell(measured, tmp_path):
    _, _, statistics, over_time, _ = measured
    other = replace(statistics, cell='another', latency=Percentiles(np.nan, np.nan, np.nan))
    report = live_report.write_report(tmp_path, [statistics, other])
    assert report.count('| 320x240-bgr8-imu200') == report.count('| another ') == 3
    assert f'{statistics.poses} of {statistics.pairs}' in report
    assert_drawn(tmp_path / 'live.png')
    header, first, _ = (tmp_path / 'live.csv').read_text().splitlines()
    assert header.startswith('cell,duration,frames_sent')
    assert 'latency_p99' in header
    assert first.startswith('320x240-bgr8-imu200,6.0,178')
    soak = live_report.write_soak_report(tmp_path / 'soak', statistics, over_time)
    assert 'MB/h after the first tenth' in soak
    assert_drawn(tmp_path / 'soak' / 'soak.png')


def assert_drawn(path):
    """Axes with text and curves: some of the picture is dark or coloured, most of it is white."""
    picture = cv2.imread(str(path))
    assert min(picture.shape[:2]) > 200
    assert 0.005 < np.mean(picture.min(axis=2) < 128) < 0.3
    # Curves are coloured, axes and text are not.
    assert np.mean(np.ptp(picture.astype(int), axis=2) > 40) > 0.001
