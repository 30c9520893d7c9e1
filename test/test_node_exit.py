"""The node ends at once and quietly, whatever it is doing when the signal comes."""

from __future__ import annotations

from collections.abc import Iterator
import itertools
from pathlib import Path
import signal
import threading
import time

import fault_stream as faults
from geometry_msgs.msg import PoseWithCovarianceStamped
import pytest
import ros_graph
from sensor_msgs.msg import CameraInfo, Image, Imu

from rs_relpose_ros.estimator.estimate import warm_up

# Whoever comes first compiles the kernels.
pytestmark = pytest.mark.timeout(600)

PARAMETER_FILE = ros_graph.ROOT / 'bags' / 'hand_held.yaml'
ENTRY = 'rs_relpose_ros.node.start'
SIGNALS = [signal.SIGINT, signal.SIGTERM]


def catches(pid: int, number: int) -> bool:
    """Whether a process has a handler of its own for a signal."""
    for line in Path(f'/proc/{pid}/status').read_text().splitlines():
        if line.startswith('SigCgt:'):
            return bool(int(line.split()[1], 16) >> (number - 1) & 1)
    return False


@pytest.mark.parametrize('number', SIGNALS)
@pytest.mark.parametrize('delay', [0.0, 0.1, 0.3, 0.6, 1.0])
def test_a_signal_ends_a_node_that_imports(ros_domain_id, number, delay):
    with ros_graph.Process(ENTRY, '--ros-args', '--params-file', str(PARAMETER_FILE)) as node:
        ros_graph.wait_until(lambda: catches(node.pid, signal.SIGTERM), 'a handler')
        time.sleep(delay)
        code, _ = node.signal(number)
        assert code == 0, node.output
        assert 'Traceback' not in node.output


@pytest.fixture
def drivers(module_ros_domain_id: int, bundled_bag: Path) -> Iterator[ros_graph.Graph]:
    """A camera and an IMU that go on and on."""
    messages = faults.read_messages(bundled_bag, 2.6)
    ended = threading.Event()
    with ros_graph.Graph() as graph:
        publishers = {kind: graph.node.create_publisher(kind, topic, 100) for kind, topic in (
            (Image, '/camera/image_raw'), (CameraInfo, '/camera/camera_info'),
            (Imu, '/imu/data_raw'))}

        def publish() -> None:
            for turn in itertools.count():
                started = time.monotonic()
                for bag_time_ns, message in messages:
                    delay = started + (bag_time_ns - messages[0][0]) * 1e-9 - time.monotonic()
                    if ended.wait(max(delay, 0.0)):
                        return
                    publishers[type(message)].publish(faults.with_stamp(
                        message, faults.stamp_of(message) + 3 * turn * faults.SECOND))

        thread = threading.Thread(target=publish)
        thread.start()
        yield graph
        ended.set()
        thread.join(10.0)


@pytest.mark.parametrize('count', [3, pytest.param(
    50, marks=[pytest.mark.long, pytest.mark.timeout(3600)])])
@pytest.mark.parametrize('number', SIGNALS)
def test_a_working_node_ends_within_a_second(drivers, number, count):
    warm_up()
    poses = drivers.listen(PoseWithCovarianceStamped, '/relpose_node/relative_pose')
    times = []
    for _ in range(count):
        with ros_graph.Process(
                ENTRY, '--ros-args', '--params-file', str(PARAMETER_FILE), '-p',
                'image_transport:=raw', *(word for source, target in ros_graph.BAG_TOPICS.items()
                                          for word in ('-r', f'{source}:={target}'))) as node:
            poses.clear()
            ros_graph.wait_until(lambda: poses, 'a pose')
            code, seconds = node.signal(number)
            times.append(seconds)
            assert code == 0, node.output
            assert 'Traceback' not in node.output
    print(f'{len(times)} of {count}: at most {max(times):.2f} s')
    assert max(times) <= 1.0
