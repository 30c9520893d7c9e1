"""The live benchmark: its endless clip, its statistics, and one short run with its report."""

from dataclasses import replace

from conftest import ROOT
import numpy as np
import pytest

from rs_relpose_lab.experiments import live, live_clip
from rs_relpose_lab.live.player import Outgoing, repeated, stamp_of
from rs_relpose_ros.errors import InputError
from rs_relpose_ros.nodes.diagnostics import FrameTimings

# The node may have to compile the kernels.
pytestmark = pytest.mark.timeout(600)

SECOND = 10**9


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
