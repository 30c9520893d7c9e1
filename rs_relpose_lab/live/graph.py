"""The rig's own part of the ROS graph: a private DDS domain, and a node that subscribes."""

from collections.abc import Callable, Iterator
from contextlib import contextmanager
import fcntl
import itertools
import os
from pathlib import Path
import sys
import tempfile
import threading
from typing import Any, Self
from unittest import mock

import rclpy
from rclpy.context import Context
from rclpy.executors import SingleThreadedExecutor
from rclpy.qos import qos_profile_sensor_data, QoSProfile

from rs_relpose_lab.live.processes import LiveRunError, Process, wait_until

# Above 101 the ports of a DDS domain lie in the range of ephemeral ports.
_DOMAIN_IDS = range(1, 101)
# Parallel runs start at different ids, so that they rarely try for the same lock.
_next_domain_id = itertools.count(os.getpid())


@contextmanager
def private_domain() -> Iterator[int]:
    """A DDS domain of this process and its children alone, by environment variables.

    Nothing leaves this machine, and a lock keeps other runs on it from the same domain id. What
    is set in ``os.environ`` within the block is reset after it.
    """
    for _ in _DOMAIN_IDS:
        domain_id = _DOMAIN_IDS[next(_next_domain_id) % len(_DOMAIN_IDS)]
        path = Path(tempfile.gettempdir()) / f'rs_relpose_ros_domain_{domain_id}.lock'
        try:
            lock = path.open('w')
        except PermissionError:  # of another user
            continue
        with lock:
            try:
                fcntl.flock(lock, fcntl.LOCK_EX | fcntl.LOCK_NB)
            except BlockingIOError:
                continue
            with mock.patch.dict(
                os.environ, ROS_DOMAIN_ID=str(domain_id), ROS_AUTOMATIC_DISCOVERY_RANGE='LOCALHOST'
            ):
                os.environ.setdefault('AMENT_PREFIX_PATH', sys.prefix)
                yield domain_id
            return
    raise LiveRunError('all ROS domain ids are in use')


class Graph:
    """A ROS node of this process, spun by a thread within a ``with`` block."""

    def __init__(self) -> None:
        self._context = Context()
        rclpy.init(context=self._context)
        self.node = rclpy.create_node('live_rig', context=self._context, enable_rosout=False)
        self._executor = SingleThreadedExecutor(context=self._context)
        self._executor.add_node(self.node)
        self._stopping = threading.Event()
        self._thread = threading.Thread(target=self._spin)

    def __enter__(self) -> Self:
        self._thread.start()
        return self

    def __exit__(self, *_: object) -> None:
        self._stopping.set()
        self._thread.join()
        self._executor.shutdown()
        self.node.destroy_node()
        self._context.try_shutdown()

    def _spin(self) -> None:
        while not self._stopping.is_set():
            self._executor.spin_once(timeout_sec=0.05)

    def subscribe(self, message_type: type, topic: str, receive: Callable[[Any], None]) -> None:
        """Have `receive` called, by the thread, with each message of a topic."""
        self.node.create_subscription(message_type, topic, receive, QoSProfile(depth=1000))

    def listen(self, message_type: type, topic: str) -> list[Any]:
        """A list that fills with the messages of a topic."""
        messages: list[Any] = []
        self.subscribe(message_type, topic, messages.append)
        return messages

    def wait_for_publisher(self, topic: str, *processes: Process) -> None:
        """Wait until a topic has a publisher, while processes run."""
        wait_until(
            lambda: self.node.count_publishers(topic), f'a publisher of {topic}', *processes
        )

    def publisher(self, message_type: type, topic: str, best_effort: bool = False) -> Any:
        """A publisher with at least one subscription."""
        qos = qos_profile_sensor_data if best_effort else QoSProfile(depth=1000)
        publisher = self.node.create_publisher(message_type, topic, qos)
        wait_until(publisher.get_subscription_count, f'a subscription to {topic}')
        return publisher

    def call(self, service_type: type, service: str, request: Any) -> Any:
        """The response of a service."""
        client = self.node.create_client(service_type, service)
        wait_until(client.service_is_ready, f'service {service}')
        future = client.call_async(request)
        wait_until(future.done, f'an answer of {service}')
        return future.result()


def diagnostic_values(array: Any) -> dict[str, str]:
    """Keys and values of the one status of a DiagnosticArray."""
    [status] = array.status
    return {item.key: item.value for item in status.values}
