"""A signal ends the node at once and quietly, whatever it is doing.

That a node ends well which estimates poses is tested with what it published (`test_node_live`,
`test_node_faults`), and here again and again.
"""

from __future__ import annotations

from collections.abc import Iterator
import itertools
from pathlib import Path
import signal
import threading
import time

from conftest import BUNDLED_PARAMETERS
import fault_stream as faults
from geometry_msgs.msg import PoseWithCovarianceStamped
import pytest
from sensor_msgs.msg import CameraInfo, Image, Imu

from rs_relpose_lab.live.graph import Graph
from rs_relpose_lab.live.processes import node_process, Process, wait_until

# The first node may have to compile the kernels.
pytestmark = [pytest.mark.live, pytest.mark.timeout(600)]

SIGNALS = (signal.SIGINT, signal.SIGTERM)
LONG = pytest.mark.long


def catches(pid: int, number: int) -> bool:
    """Whether a process has a handler of its own for a signal."""
    for line in Path(f'/proc/{pid}/status').read_text().splitlines():
        if line.startswith('SigCgt:'):
            return bool(int(line.split()[1], 16) >> (number - 1) & 1)
    return False


def end(node: Process, number: signal.Signals, every: float = 30.0) -> float:
    """End a node by a signal, without a complaint; seconds until then."""
    code, seconds = node.signal(number, every=every)
    assert code == 0
    assert 'Traceback' not in node.output
    return seconds


@pytest.mark.parametrize(('delay', 'number'), [
    (0.0, signal.SIGINT), (0.1, signal.SIGTERM), (0.3, signal.SIGINT), (0.6, signal.SIGTERM),
    (1.0, signal.SIGINT), *(pytest.param(delay, number, marks=LONG) for delay, number in (
        (0.0, signal.SIGTERM), (0.1, signal.SIGINT), (0.3, signal.SIGTERM), (0.6, signal.SIGINT),
        (1.0, signal.SIGTERM)))])
def test_a_signal_ends_a_node_that_imports(ros_domain_id, delay, number):
    with node_process(BUNDLED_PARAMETERS) as node:
        wait_until(lambda: catches(node.pid, signal.SIGTERM), 'a handler', node)
        time.sleep(delay)
        end(node, number)


@pytest.mark.parametrize(('every', 'number'), [
    (0.002, signal.SIGINT), (0.02, signal.SIGTERM),
    *(pytest.param(every, number, marks=LONG) for every, number in (
        (0.002, signal.SIGTERM), (0.02, signal.SIGINT), (0.1, signal.SIGINT),
        (0.1, signal.SIGTERM)))])
def test_signals_that_come_again_and_again(ros_domain_id, every, number):
    """Ctrl-C under ros2 launch: the terminal signals the whole group, and so does launch."""
    with node_process(BUNDLED_PARAMETERS) as node:
        node.wait_for('ready')
        end(node, number, every)


def test_a_signal_ends_a_node_that_compiles(ros_domain_id, tmp_path, monkeypatch):
    monkeypatch.setenv('NUMBA_CACHE_DIR', str(tmp_path))
    with node_process(BUNDLED_PARAMETERS) as node:
        node.wait_for('compiling kernels')
        # The compiler lets go of the interpreter only now and then.
        assert end(node, signal.SIGTERM) <= 5.0


@pytest.fixture
def drivers(ros_domain_id: int, bundled_bag: Path) -> Iterator[Graph]:
    """A camera and an IMU that go on and on."""
    messages = faults.read_messages(bundled_bag, 2.6)
    ended = threading.Event()
    with Graph() as graph:
        publishers = {kind: graph.node.create_publisher(kind, topic, 100) for kind, topic in zip(
            (Image, CameraInfo, Imu), faults.BAG_TOPICS.values(), strict=True)}

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


@pytest.mark.long
@pytest.mark.timeout(3600)
@pytest.mark.parametrize('number', SIGNALS)
def test_a_working_node_ends_within_a_second(drivers, number):
    poses = drivers.listen(PoseWithCovarianceStamped, '/relpose_node/relative_pose')
    times = []
    for _ in range(50):
        with node_process(BUNDLED_PARAMETERS, remap=faults.BAG_TOPICS,
                          parameters={'image_transport': 'raw'}) as node:
            poses.clear()
            wait_until(lambda: poses, 'a pose', node)
            times.append(end(node, number))
    print(f'of {len(times)}: at most {max(times):.2f} s')
    assert max(times) <= 1.0
