"""A worker that is too slow: the oldest frame goes, the latest wait, and no IMU sample is lost.

The worker is held by an event, so that nothing here depends on the machine's speed.
"""

from __future__ import annotations

from collections.abc import Iterator
import threading
from typing import Any

import message_builders as build
import numpy as np
import pytest
from sensor_msgs.msg import CameraInfo, Image, Imu

from rs_relpose_lab.live.processes import wait_until
from rs_relpose_ros.config.parameters import Parameters
from rs_relpose_ros.estimator.warm_up import warm_up
from rs_relpose_ros.front_end.frame import Frame
from rs_relpose_ros.front_end.front_end import FrameFailed, FrameProcessed, FrontEnd
from rs_relpose_ros.front_end.pipeline import Pipeline
from rs_relpose_ros.front_end.sequencer import FrameRefused, MAILBOX_FRAMES, Refusal
from rs_relpose_ros.geometry.intrinsics import Intrinsics
from rs_relpose_ros.imu.frame_imu import FrameImu
from rs_relpose_ros.imu.samples import ImuSample
from rs_relpose_ros.node.worker import Worker

# Whoever comes first compiles the kernels.
pytestmark = pytest.mark.timeout(600)

SECOND = 10**9
FRAME_NS, IMU_NS, READOUT_NS = SECOND // 30, SECOND // 400, SECOND // 50
START_NS = 1_700_000_000 * SECOND
WIDTH, HEIGHT = 64, 48
FRAMES = 40
CALIBRATION = Intrinsics(width=WIDTH, height=HEIGHT, fx=60.0, fy=60.0, cx=32.0, cy=24.0,
                          image_width=WIDTH, image_height=HEIGHT)
IMAGE = np.random.default_rng(0).integers(0, 255, (HEIGHT, WIDTH), dtype=np.uint8)
VALUES: dict[str, Any] = {'readout_time': READOUT_NS / SECOND,
                          'quat_cam_imu_xyzw': [0.0, 0.0, 0.0, 1.0]}


@pytest.fixture(scope='module', autouse=True)
def kernels() -> None:
    warm_up()


class HeldPipeline(Pipeline):
    """Processes a frame only when it is let go."""

    frames: list[tuple[int, FrameImu]]
    started: threading.Event
    let_go: threading.Event

    def process(self, frame: Any, imu: Any, parameters: Any) -> None:
        type(self).frames.append((frame.stamp_ns, imu))
        type(self).started.set()
        assert type(self).let_go.wait(300.0)


class HeldFrontEnd(FrontEnd):
    """Its frames are processed by a `HeldPipeline`."""

    def __init__(self, parameters: Parameters, **options: Any) -> None:
        super().__init__(parameters, **options)
        self._processor = HeldPipeline(parameters)


@pytest.fixture
def held(monkeypatch: pytest.MonkeyPatch) -> Iterator[type[HeldPipeline]]:
    HeldPipeline.frames = []
    HeldPipeline.started, HeldPipeline.let_go = threading.Event(), threading.Event()
    # The warm-up has a front end of its own, which nobody holds.
    monkeypatch.setattr('rs_relpose_ros.node.node.FrontEnd', HeldFrontEnd)
    yield HeldPipeline
    HeldPipeline.let_go.set()


def frame_stamp(k: int) -> int:
    return START_NS + k * FRAME_NS


def noisy_rate(k: int) -> tuple[float, float, float]:
    """A gyro of which an axis repeats itself bit by bit would be refused."""
    noise = 1e-4 * np.sin(k)
    return 0.1 + noise, 0.2 + noise, 0.3 + noise


def test_the_oldest_frame_goes_and_the_latest_wait(held):
    now_ns = [0]
    parameters = Parameters.from_mapping(VALUES)
    front_end = HeldFrontEnd(parameters, clock=lambda: now_ns[0])
    sequencer = front_end.sequencer
    events: list[Any] = []

    def done() -> list[FrameProcessed]:
        return [event for event in events if isinstance(event, FrameProcessed)]

    worker = Worker(front_end, lambda: None, events.append)
    worker.start()
    try:
        samples = 0
        for stamp_ns in range(START_NS - IMU_NS, frame_stamp(FRAMES) + READOUT_NS, IMU_NS):
            now_ns[0] = stamp_ns - START_NS
            sequencer.add_imu(ImuSample(stamp_ns, noisy_rate(samples), (0.0, -9.81, 0.0)))
            samples += 1
            for k in range(FRAMES):
                if stamp_ns <= frame_stamp(k) + READOUT_NS < stamp_ns + IMU_NS:
                    sequencer.add_frame(Frame(frame_stamp(k), IMAGE, 'camera', CALIBRATION))
                    if k == 0:
                        wait_until(held.started.is_set, 'the first frame')
        # All of this came while the worker held the first frame.
        counts = sequencer.counts()
        lost = FRAMES - 1 - MAILBOX_FRAMES
        assert counts.imu_samples == samples
        assert counts.imu_gaps == 0
        assert counts.frames == FRAMES
        assert counts.frames_taken == 1
        assert counts.refused == {Refusal.OVERLOAD: lost}
        held.let_go.set()
        wait_until(lambda: len(done()) == 1 + MAILBOX_FRAMES, 'the frames that waited')
    finally:
        held.let_go.set()
        assert worker.stop(10.0)
    latest = [frame_stamp(k) for k in range(FRAMES - MAILBOX_FRAMES, FRAMES)]
    assert [frame.stamp_ns for frame in done()] == [frame_stamp(0), *latest]
    assert [event.stamp_ns for event in events if isinstance(event, FrameRefused)] == [
        frame_stamp(k) for k in range(1, lost + 1)]
    assert not any(isinstance(event, FrameFailed) for event in events)
    # However long it was held, the oldest that waits came within as many frames as may wait.
    assert now_ns[0] - done()[1].ready_ns <= (MAILBOX_FRAMES + 1) * FRAME_NS
    # The gyro from the frame before to the first after all those that went has no hole.
    _, imu = held.frames[1]
    stamps = imu.since_previous.stamps_ns
    assert (stamps[0], stamps[-1]) == (frame_stamp(0), latest[0])
    assert np.diff(stamps).max() <= IMU_NS


def test_a_busy_worker_costs_the_node_no_imu(held, module_ros_domain_id):
    """The same through the graph: the node goes on receiving while its worker is held."""
    import rclpy
    from rclpy.context import Context
    from rclpy.executors import SingleThreadedExecutor

    from rs_relpose_ros.node.node import RelposeNode

    context = Context()
    rclpy.init(context=context)
    rclpy.init(args=['--ros-args', '-p', f'readout_time:={VALUES["readout_time"]}', '-p',
                     'quat_cam_imu_xyzw:=[0.0, 0.0, 0.0, 1.0]'])
    node = RelposeNode()
    executor = SingleThreadedExecutor()
    executor.add_node(node)
    driver = rclpy.create_node('driver', context=context)
    publishers = {msgtype: driver.create_publisher(msgtype, topic, 1000) for msgtype, topic in (
        (Image, 'image'), (CameraInfo, 'camera_info'), (Imu, 'imu'))}

    def spin_until(condition: Any, what: str) -> None:
        def spun() -> Any:
            executor.spin_once(timeout_sec=0.02)
            return condition()
        wait_until(spun, what)

    try:
        spin_until(lambda: all(p.get_subscription_count() for p in publishers.values()),
                   'discovery')
        sequencer = node._loop.sequencer
        publishers[CameraInfo].publish(build.camera_info(
            build.rclpy_types, width=WIDTH, height=HEIGHT,
            k=(60.0, 0.0, 32.0, 0.0, 60.0, 24.0, 0.0, 0.0, 1.0)))
        spin_until(lambda: node._intake.intrinsics is not None, 'the calibration')
        samples = 0
        for k in range(FRAMES):
            until_ns = frame_stamp(k) + READOUT_NS + IMU_NS
            while START_NS - IMU_NS + samples * IMU_NS <= until_ns:
                publishers[Imu].publish(build.imu(
                    build.rclpy_types, START_NS - IMU_NS + samples * IMU_NS, noisy_rate(samples)))
                samples += 1
            # No image is that before: a frozen camera's are refused.
            publishers[Image].publish(build.gray_image(
                build.rclpy_types, IMAGE + np.uint8(k), frame_stamp(k)))
            # Best effort: of the images only the latest five are kept for the callback.
            spin_until(lambda k=k: sequencer.counts().frames == k + 1, f'image {k}')
            if k == 0:
                spin_until(held.started.is_set, 'the first frame')
        spin_until(lambda: sequencer.counts().imu_samples == samples, 'all IMU samples')
        counts = sequencer.counts()
        assert counts.imu_gaps == 0
        assert counts.frames_taken == 1
        assert counts.refused == {Refusal.OVERLOAD: FRAMES - 1 - MAILBOX_FRAMES}
    finally:
        held.let_go.set()
        node._worker.stop(10.0)
        executor.shutdown()
        node.destroy_node()
        driver.destroy_node()
        rclpy.try_shutdown()
        context.try_shutdown()
