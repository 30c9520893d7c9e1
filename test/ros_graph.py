"""Helpers for tests with real processes over DDS: the node, a player, and a listener."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator
import os
from pathlib import Path
import signal
import subprocess
import sys
import tempfile
import threading
import time
from types import TracebackType
from typing import Any

import rclpy
from rclpy.context import Context
from rclpy.executors import SingleThreadedExecutor
from rclpy.qos import qos_profile_sensor_data, QoSProfile

ROOT = Path(__file__).resolve().parent.parent
# Longest wait for anything: compiling all kernels on a busy machine takes most of it.
PATIENCE = 300.0


def wait_until(condition: Callable[[], Any], what: str, timeout: float = PATIENCE) -> Any:
    """The first truthy value of `condition`."""
    deadline = time.monotonic() + timeout
    while time.monotonic() < deadline:
        value = condition()
        if value:
            return value
        time.sleep(0.02)
    raise AssertionError(f'{what} did not happen within {timeout:g} s')


class Process:
    """A Python process of this project; ended, if need be, when the block ends."""

    def __init__(self, module: str, *arguments: str) -> None:
        self._start('-m', module, *arguments)

    def _start(self, *arguments: str) -> None:
        # A pipe that nobody reads would block it.
        self._output = tempfile.TemporaryFile()  # noqa: SIM115 - closed on exit
        self._process = subprocess.Popen(
            [sys.executable, *arguments], cwd=ROOT, stdout=self._output,
            stderr=subprocess.STDOUT, env={**os.environ, 'PYTHONUNBUFFERED': '1'})

    def __enter__(self) -> Process:
        return self

    def __exit__(self, kind: type[BaseException] | None, error: BaseException | None,
                 traceback: TracebackType | None) -> None:
        if self._process.poll() is None:
            self._process.kill()
            self._process.wait(10.0)
        if kind is not None:
            print(f'--- output of {self._process.args[1:3]}\n{self.output}')
        self._output.close()

    @property
    def pid(self) -> int:
        return self._process.pid

    @property
    def output(self) -> str:
        """What it wrote so far."""
        return os.pread(self._output.fileno(), 1 << 22, 0).decode(errors='replace')

    def wait_for(self, text: str, timeout: float = PATIENCE) -> None:
        """Wait until it has written `text`."""
        def written() -> bool:
            assert self._process.poll() is None or text in self.output, (
                f'ended with {self._process.returncode} before it wrote {text!r}:\n{self.output}')
            return text in self.output
        wait_until(written, f'{text!r} in the output')

    def signal(self, number: signal.Signals, *, every: float = 30.0) -> tuple[int, float]:
        """Send a signal, again every so many seconds; the exit code and the seconds until then."""
        started = time.monotonic()
        while True:
            self._process.send_signal(number)
            try:
                code = self._process.wait(every)
                return code, time.monotonic() - started
            except subprocess.TimeoutExpired:
                if time.monotonic() > started + 30.0:
                    raise

    def wait(self, timeout: float = PATIENCE) -> int:
        """Its exit code."""
        return self._process.wait(timeout)


class Script(Process):
    """A Python file."""

    def __init__(self, path: Path, *arguments: str) -> None:
        self._start(str(path), *arguments)


def node_process(parameter_file: Path | None = None, *, remap: dict[str, str] | None = None,
                 parameters: dict[str, Any] | None = None, name: str = '') -> Process:
    """Start `relpose_node`."""
    arguments = ['--ros-args']
    if parameter_file is not None:
        arguments += ['--params-file', str(parameter_file)]
    for key, value in (parameters or {}).items():
        arguments += ['-p', f'{key}:={value}']
    for source, target in (remap or {}).items():
        arguments += ['-r', f'{source}:={target}']
    if name:
        arguments += ['-r', f'__node:={name}']
    return Process('rs_relpose_ros.node.node', *arguments)


BAG_TOPICS = {'image': '/camera/image_raw', 'camera_info': '/camera/camera_info',
              'imu': '/imu/data_raw'}


class Graph:
    """A ROS node of the test's own: listens, publishes, and is spun by a thread."""

    def __init__(self) -> None:
        self._context = Context()
        rclpy.init(context=self._context)
        self.node = rclpy.create_node('test_graph', context=self._context)
        self._executor = SingleThreadedExecutor(context=self._context)
        self._executor.add_node(self.node)
        self._stop = threading.Event()
        self._thread = threading.Thread(target=self._spin)

    def _spin(self) -> None:
        while not self._stop.is_set():
            self._executor.spin_once(timeout_sec=0.05)

    def __enter__(self) -> Graph:
        self._thread.start()
        return self

    def __exit__(self, *_: object) -> None:
        self._stop.set()
        self._thread.join(10.0)
        self._executor.shutdown()
        self.node.destroy_node()
        self._context.try_shutdown()

    def listen(self, message_type: type, topic: str, depth: int = 1000) -> list[Any]:
        """A list that fills with the messages of a topic."""
        messages: list[Any] = []
        self.node.create_subscription(
            message_type, topic, messages.append, QoSProfile(depth=depth))
        return messages

    def call(self, service_type: type, service: str, request: Any) -> Any:
        """The response of a service."""
        client = self.node.create_client(service_type, service)
        wait_until(client.service_is_ready, f'service {service}')
        future = client.call_async(request)
        wait_until(future.done, f'an answer of {service}')
        return future.result()

    def publisher(self, message_type: type, topic: str, best_effort: bool = False) -> Any:
        """A publisher that somebody has subscribed to."""
        qos = qos_profile_sensor_data if best_effort else QoSProfile(depth=1000)
        publisher = self.node.create_publisher(message_type, topic, qos)
        wait_until(publisher.get_subscription_count, f'a subscription to {topic}')
        return publisher


def publish_in_time(messages: Iterable[tuple[Any, int, Any]]) -> None:
    """Publish (publisher, bag time [ns], message) at bag time."""
    first_ns, started = None, time.monotonic()
    for publisher, bag_time_ns, message in messages:
        first_ns = bag_time_ns if first_ns is None else first_ns
        delay = started + (bag_time_ns - first_ns) * 1e-9 - time.monotonic()
        if delay > 0.0:
            time.sleep(delay)
        publisher.publish(message)


def diagnostic_values(array: Any) -> dict[str, str]:
    """Keys and values of the node's status."""
    [status] = array.status
    return {item.key: item.value for item in status.values}


def stamps_of(messages: Iterable[Any]) -> Iterator[int]:
    """Header stamps [ns]."""
    for message in messages:
        yield message.header.stamp.sec * 10**9 + message.header.stamp.nanosec
