"""Subscriptions to camera and IMU, with counters; helpers for rclpy that all nodes share."""

from __future__ import annotations

from collections import Counter, deque
from collections.abc import Callable
import functools
from functools import partial
import importlib
import time
from typing import Any, TYPE_CHECKING

from rclpy.clock import Clock, ClockType
from rclpy.event_handler import SubscriptionEventCallbacks
from rclpy.exceptions import InvalidHandle
from rclpy.impl.implementation_singleton import rclpy_implementation
from rclpy.node import Node
from rclpy.qos import DurabilityPolicy, HistoryPolicy, QoSPolicyKind, QoSProfile, ReliabilityPolicy
from rclpy.qos_overriding_options import QoSOverridingOptions
from rclpy.time import Time

from rs_relpose_ros.errors import MissingInputError
from rs_relpose_ros.geometry.timing import NANOSECONDS
from rs_relpose_ros.messages.incoming import Intake, PARTS, Role, stamp_ns
from rs_relpose_ros.nodes.diagnostics import INVALID, SILENCE, TOPICS
from rs_relpose_ros.nodes.executor import PolledSubscription

if TYPE_CHECKING:
    from rs_relpose_ros.calibrate.live import LiveCalibration

# -- rclpy ----------------------------------------------------------------------------------------

# Errors of rclpy if a signal has ended the context during a call. [derived: rclpy]
SHUT_DOWN = (rclpy_implementation.RCLError, InvalidHandle)


@functools.cache
def message_class(msgtype: str) -> Any:
    """Class of a message type name such as ``'sensor_msgs/msg/Imu'``."""
    package, _, name = msgtype.split('/')
    try:
        return getattr(importlib.import_module(f'{package}.msg'), name)
    except (ImportError, AttributeError):
        raise MissingInputError(
            f'message type {msgtype} is not installed; install its package, or choose other topics'
        ) from None


def transform_broadcaster(node: Node, parameter: str) -> Any:
    """Broadcaster of /tf; MissingInputError with the `parameter` that needs it."""
    try:
        return importlib.import_module('tf2_ros').TransformBroadcaster(node)
    except ImportError as error:
        raise MissingInputError(
            f'{parameter} needs tf2_ros, which is not installed: install '
            f'ros-jazzy-tf2-ros-py, or set {parameter} to false'
        ) from error


class TransformLookup:
    """Finds x y z, quaternion x y z w of a frame in another one by /tf and /tf_static.

    It listens until it finds one; `problem`: why it has not, such as the missing frame.
    """

    def __init__(self, node: Node) -> None:
        self.problem = ''
        self._listener = None
        try:
            self._tf2: Any = importlib.import_module('tf2_ros')
        except ImportError:
            self._tf2 = None
            self.problem = 'tf2_ros is not installed'
            return
        self._buffer = self._tf2.Buffer()
        self._listener = self._tf2.TransformListener(self._buffer, node)

    def __call__(self, parent: str, child: str) -> tuple[float, ...] | None:
        """Pose of `child` in `parent`; None if it is unknown."""
        if self._tf2 is None:
            return None
        try:
            found = self._buffer.lookup_transform(parent, child, Time()).transform
        except self._tf2.TransformException as error:
            self.problem = str(error)
            return None
        if self._listener is not None:
            self._listener.unregister()
            self._listener = None
        t = found.translation
        q = found.rotation
        return t.x, t.y, t.z, q.x, q.y, q.z, q.w


def overridable() -> QoSOverridingOptions:
    """The policies that parameters may override."""
    return QoSOverridingOptions(
        (
            QoSPolicyKind.HISTORY,
            QoSPolicyKind.DEPTH,
            QoSPolicyKind.RELIABILITY,
            QoSPolicyKind.DURABILITY,
        )
    )


def best_effort(depth: int) -> QoSProfile:
    """Matches every publisher, which a reliable subscription would not.

    A profile of its own for each topic: rclpy writes the topic's overrides into its argument.
    """
    return QoSProfile(
        history=HistoryPolicy.KEEP_LAST, depth=depth, reliability=ReliabilityPolicy.BEST_EFFORT
    )


# -- Camera and IMU -------------------------------------------------------------------------------

# Depth of the queue of images: half a second. An overloaded node then drops images in its own
# queue, where they are counted, and not in the middleware, where they are not. [chosen: more only
# costs memory, less than 8 would drop images while a callback takes a quarter of a second]
_IMAGE_DEPTH = 15
# Depth of the queue of the IMU: five seconds at 400 Hz, so that no sample is lost while the
# process is stalled. [chosen: a sample has 0.3 kB, so that ten times as many would do, too]
_IMU_DEPTH = 2000
# QoS of messages that are published once, before this node starts: the middleware sends them to
# reliable subscriptions of the same durability only. [derived: ROS]
LATCHED = QoSProfile(
    depth=1, reliability=ReliabilityPolicy.RELIABLE, durability=DurabilityPolicy.TRANSIENT_LOCAL
)
# Number of image stamps that are kept for the statistics of the frame rate. [chosen: twenty
# seconds at 30 Hz; fewer than 100 would make the scatter of the stamps uncertain]
_RECENT_STAMPS = 600
# Period [s] at which IMU and CameraInfo are read without an image. A longer one delays the reports
# that a sensor is silent; a shorter one wakes the process more often. [chosen: 0.02 to 0.3 would
# do]
_DRAIN_PERIOD = 0.1


class SensorInputs:
    """Subscriptions to the topics of camera and IMU; passes messages to the intake.

    `topics` are the resolved names by role, `image_bytes` is the size of the last image,
    `stamps_ns` are the stamps of the last ones.
    `on_invalid` gets the reason why a message is unusable. Silence is measured in real time, also
    if /clock does not advance.
    """

    def __init__(
        self,
        node: Node,
        intake: Intake | LiveCalibration,
        image_transport: str,
        on_invalid: Callable[[str], None],
    ) -> None:
        self._node = node
        self._intake = intake
        self._on_invalid = on_invalid
        self._info: Any = None  # the last CameraInfo, without its stamp
        self._started_ns = time.monotonic_ns()
        self.counts: Counter[str] = Counter()  # of messages by role, and of the `INVALID` ones
        self._last_ns: dict[Role, int] = {}
        self.image_bytes = 0  # of the last image
        self.frame_ids: dict[Role, str] = {}  # of the last messages
        self.stamps_ns: deque[int] = deque(maxlen=_RECENT_STAMPS)  # of the last images
        self.topics = {role: node.resolve_topic_name(role.value) for role in TOPICS}
        compressed = image_transport == 'compressed'
        # The name of the transport follows the remapped topic, as in image_transport.
        self.topics[Role.IMAGE] += '/compressed' if compressed else ''
        self._polled = [
            self._camera_info(best_effort(_IMAGE_DEPTH), qos_overriding_options=overridable()),
            # A message that a driver published once, before this node started: only a subscription
            # of the same durability gets it, which most drivers do not match, and need not.
            self._camera_info(
                LATCHED, event_callbacks=SubscriptionEventCallbacks(use_default_callbacks=False)
            ),
            self._samples(Role.IMU),
            self._samples(Role.ACCEL),
        ]
        node.create_subscription(
            message_class(PARTS[Role.IMAGE].msgtypes[compressed]),
            self.topics[Role.IMAGE],
            self._on_image,
            best_effort(_IMAGE_DEPTH),
            qos_overriding_options=overridable(),
        )
        self._timer = node.create_timer(
            _DRAIN_PERIOD, self._drain, clock=Clock(clock_type=ClockType.STEADY_TIME)
        )

    def _camera_info(self, qos: QoSProfile, **options: Any) -> PolledSubscription:
        """Subscription to CameraInfo, which is urgent until there are intrinsics."""
        return PolledSubscription(
            self._node,
            message_class(PARTS[Role.CAMERA_INFO].msgtypes[0]),
            Role.CAMERA_INFO.value,
            qos,
            partial(self._on_info, latched=qos is LATCHED),
            lambda: self._intake.intrinsics is None,
            **options,
        )

    def _samples(self, role: Role) -> PolledSubscription:
        """Subscription to a topic of the IMU, which is urgent while a frame waits for it."""
        return PolledSubscription(
            self._node,
            message_class(PARTS[role].msgtypes[0]),
            role.value,
            best_effort(_IMU_DEPTH),
            partial(self._on_samples, role),
            lambda: self._intake.waits_for_imu(),
            qos_overriding_options=overridable(),
        )

    def hand_to(self, intake: Intake | LiveCalibration) -> None:
        """Messages go to another receiver from here on, the last CameraInfo first."""
        self._intake = intake
        if self._info is not None:
            self._receive(Role.CAMERA_INFO, self._info)

    def silent(self, role: Role, seconds: float = SILENCE) -> bool:
        """Whether no message has come for this time."""
        last_ns = self._last_ns.get(role, self._started_ns)
        return time.monotonic_ns() - last_ns > seconds * NANOSECONDS

    def _on_image(self, image: Any) -> None:
        # The CameraInfo that came before an image belongs to it.
        self._polled[0].drain()
        self._count(Role.IMAGE)
        self.image_bytes = len(image.data)
        self.frame_ids[Role.IMAGE] = image.header.frame_id
        self.stamps_ns.append(stamp_ns(image.header))
        # An unusable image is refused by the sequencer, which counts it.
        self._intake.receive(Role.IMAGE, image)
        self._drain()
        self._timer.reset()  # no wake-up of its own while images come

    def _on_info(self, messages: list[Any], *, latched: bool) -> None:
        """Receive each CameraInfo that differs by more than its stamp: few do."""
        if not latched:
            self._count(Role.CAMERA_INFO, len(messages))
        for info in messages:
            info.header.stamp = type(info.header.stamp)()
            if info != self._info:
                self._info = info
                self._receive(Role.CAMERA_INFO, info)

    def _on_samples(self, role: Role, messages: list[Any]) -> None:
        self._count(role, len(messages))
        self.frame_ids[role] = messages[-1].header.frame_id
        for message in messages:
            self._receive(role, message)

    def _receive(self, role: Role, message: Any) -> None:
        error = self._intake.receive(role, message)
        if error is not None:
            self.counts[INVALID] += 1
            self._on_invalid(str(error))

    def _count(self, role: Role, messages: int = 1) -> None:
        self.counts[role] += messages
        self._last_ns[role] = time.monotonic_ns()

    def _drain(self) -> None:
        for subscription in self._polled:
            subscription.drain()
