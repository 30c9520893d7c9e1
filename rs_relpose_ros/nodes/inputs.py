"""Subscriptions to camera and IMU, with counters; helpers for rclpy that all nodes share."""

from __future__ import annotations

from collections import Counter, deque
from collections.abc import Callable
import functools
from functools import partial
import importlib
import time
from typing import Any, TYPE_CHECKING

from rclpy.callback_groups import CallbackGroup
from rclpy.clock import Clock, ClockType
from rclpy.event_handler import SubscriptionEventCallbacks
from rclpy.exceptions import InvalidHandle
from rclpy.impl.implementation_singleton import rclpy_implementation
from rclpy.node import Node
from rclpy.qos import DurabilityPolicy, HistoryPolicy, QoSPolicyKind, QoSProfile, ReliabilityPolicy
from rclpy.qos_overriding_options import QoSOverridingOptions
from rclpy.serialization import deserialize_message
from rclpy.time import Time

from rs_relpose_ros.errors import MissingInputError
from rs_relpose_ros.geometry.timing import NANOSECONDS
from rs_relpose_ros.messages.incoming import frame_id_of_cdr, Intake, PARTS, Role, stamp_ns
from rs_relpose_ros.nodes.diagnostics import INVALID, SILENCE, TOPICS

if TYPE_CHECKING:
    from rs_relpose_ros.calibrate.live import LiveCalibration

# -- Subscriptions that are read on demand --------------------------------------------------------
#
# A wake-up costs rclpy more than the message itself, because it builds a new wait set of all
# entities of the node. An IMU would wake it hundreds of times a second, while its samples are
# needed only when a frame waits for them, some thirty times. Until then they stay in the queue of
# the middleware.

# Most messages that are taken at once, so that other callbacks get their turn.
_MOST_AT_ONCE = 2000
# Bytes of CDR before the frame_id of a message with a header: encapsulation (4) and stamp (8).
_STAMPED = 12


class PolledSubscription:
    """A subscription that is read by `drain`, and wakes the executor only while it is urgent.

    `receive` gets each message, or its bytes with `raw` among the `options`, which are those of
    ``create_subscription``; `urgent` is called before the executor waits. The depth of `qos` must
    hold the messages between two calls of `drain`.
    """

    def __init__(self, node: Node, msgtype: type, topic: str, qos: QoSProfile,
                 receive: Callable[[Any], None], urgent: Callable[[], bool],
                 **options: Any) -> None:
        self._receive = receive
        self._subscription = node.create_subscription(
            msgtype, topic, self._on_message, qos, callback_group=_WhileUrgent(urgent),
            **options)

    def drain(self) -> None:
        """Receive all messages of the queue."""
        subscription = self._subscription
        with subscription.handle:
            for _ in range(_MOST_AT_ONCE):
                taken = subscription.handle.take_message(subscription.msg_type, subscription.raw)
                if taken is None:
                    return
                self._receive(taken[0])

    def _on_message(self, msg: Any) -> None:
        self._receive(msg)
        self.drain()


class _WhileUrgent(CallbackGroup):
    """Keeps its subscription out of the executor's wait set unless it is urgent."""

    def __init__(self, urgent: Callable[[], bool]) -> None:
        super().__init__()
        self._urgent = urgent

    def can_execute(self, entity: Any) -> bool:
        return self._urgent()

    def beginning_execution(self, entity: Any) -> bool:
        return True

    def ending_execution(self, entity: Any) -> None:
        pass


# -- rclpy ----------------------------------------------------------------------------------------

# Errors of rclpy if a signal has ended the context during a call.
SHUT_DOWN = (rclpy_implementation.RCLError, InvalidHandle)


@functools.cache
def message_class(msgtype: str) -> Any:
    """Class of a message type name such as ``'sensor_msgs/msg/Imu'``."""
    package, _, name = msgtype.split('/')
    try:
        return getattr(importlib.import_module(f'{package}.msg'), name)
    except (ImportError, AttributeError):
        raise MissingInputError(f'message type {msgtype} is not installed; install its package, '
                                'or choose other topics') from None


def transform_broadcaster(node: Node, parameter: str) -> Any:
    """Broadcaster of /tf; MissingInputError with the `parameter` that needs it."""
    try:
        return importlib.import_module('tf2_ros').TransformBroadcaster(node)
    except ImportError as error:
        raise MissingInputError(f'{parameter} needs tf2_ros, which is not installed: install '
                                f'ros-jazzy-tf2-ros-py, or set {parameter} to false') from error


class TransformLookup:
    """Finds x y z, quaternion x y z w of a frame in another one by /tf and /tf_static.

    It listens until it finds one; `problem`: why it has not, such as the missing frame.
    """

    def __init__(self, node: Node) -> None:
        self.problem, self._listener = '', None
        try:
            self._tf2: Any = importlib.import_module('tf2_ros')
        except ImportError:
            self._tf2, self.problem = None, 'tf2_ros is not installed'
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
        t, q = found.translation, found.rotation
        return t.x, t.y, t.z, q.x, q.y, q.z, q.w


def overridable() -> QoSOverridingOptions:
    """The policies that parameters may override."""
    return QoSOverridingOptions((QoSPolicyKind.HISTORY, QoSPolicyKind.DEPTH,
                                 QoSPolicyKind.RELIABILITY, QoSPolicyKind.DURABILITY))


def best_effort(depth: int) -> QoSProfile:
    """Matches every publisher, which a reliable subscription would not.

    A profile of its own for each topic: rclpy writes the topic's overrides into its argument.
    """
    return QoSProfile(history=HistoryPolicy.KEEP_LAST, depth=depth,
                      reliability=ReliabilityPolicy.BEST_EFFORT)


# -- Camera and IMU -------------------------------------------------------------------------------

# Queue of half a second of images: an overloaded node then drops them in its own queue, where they
# are counted, and not in the middleware, where they are not.
_IMAGE_DEPTH = 15
# Queue of some seconds of samples, so that none is lost while the process is stalled.
_IMU_DEPTH = 2000
# Messages published earlier are sent to reliable subscriptions only.
LATCHED = QoSProfile(depth=1, reliability=ReliabilityPolicy.RELIABLE,
                      durability=DurabilityPolicy.TRANSIENT_LOCAL)
# Some seconds of stamps.
_RECENT_STAMPS = 600
# Period [s] at which IMU and CameraInfo are read without an image.
_DRAIN_PERIOD = 0.1


class SensorInputs:
    """Subscriptions to the topics of camera and IMU; passes messages to the intake.

    `topics` are the resolved names by role, `image_bytes` is the size of the last image,
    `stamps_ns` are the stamps of the last ones.
    `on_invalid` gets the reason why a message is unusable. Silence is measured in real time, also
    if /clock does not advance.
    """

    def __init__(self, node: Node, intake: Intake | LiveCalibration, image_transport: str,
                 on_invalid: Callable[[str], None]) -> None:
        self._intake, self._on_invalid = intake, on_invalid
        self._info: Any = None   # the last CameraInfo
        self._started_ns = time.monotonic_ns()
        self.counts: Counter[str] = Counter()   # of messages by role, and of the `INVALID` ones
        self._last_ns: dict[Role, int] = {}
        self._last_info = b''
        self.image_bytes = 0   # of the last image
        self.frame_ids: dict[Role, str] = {}   # of the last messages
        self.stamps_ns: deque[int] = deque(maxlen=_RECENT_STAMPS)   # of the last images
        self.topics = {role: node.resolve_topic_name(role.value) for role in TOPICS}
        # As image_transport does: the transport's name follows the remapped one.
        self.topics[Role.IMAGE] += '/compressed' if image_transport == 'compressed' else ''
        types = {role: message_class(PARTS[role].msgtypes[0]) for role in self.topics}
        types[Role.IMAGE] = message_class(
            PARTS[Role.IMAGE].msgtypes[image_transport == 'compressed'])
        self._info_type = types[Role.CAMERA_INFO]

        def missing_info() -> bool:
            return self._intake.intrinsics is None

        self._camera_info = PolledSubscription(
            node, self._info_type, Role.CAMERA_INFO.value, best_effort(_IMAGE_DEPTH),
            partial(self._on_info, latched=False), missing_info, raw=True,
            qos_overriding_options=overridable())
        # A message that a driver published once, before this node started: only a subscription of
        # the same durability gets it, which most drivers do not match, and need not.
        self._latched = PolledSubscription(
            node, self._info_type, Role.CAMERA_INFO.value, LATCHED,
            partial(self._on_info, latched=True), missing_info, raw=True,
            event_callbacks=SubscriptionEventCallbacks(use_default_callbacks=False))
        self._imu = [PolledSubscription(
            node, types[role], role.value, best_effort(_IMU_DEPTH),
            partial(self._on_sample, role), lambda: self._intake.waits_for_imu(), raw=True,
            qos_overriding_options=overridable())
            for role in (Role.IMU, Role.ACCEL)]
        node.create_subscription(
            types[Role.IMAGE], self.topics[Role.IMAGE], self._on_image,
            best_effort(_IMAGE_DEPTH), qos_overriding_options=overridable())
        self._timer = node.create_timer(_DRAIN_PERIOD, self._drain,
                                        clock=Clock(clock_type=ClockType.STEADY_TIME))

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
        self._camera_info.drain()
        self._count(Role.IMAGE)
        self.image_bytes = len(image.data)
        self.frame_ids[Role.IMAGE] = image.header.frame_id
        self.stamps_ns.append(stamp_ns(image.header))
        # An unusable image is refused by the sequencer, which counts it.
        self._intake.receive(Role.IMAGE, image)
        self._drain()
        self._timer.reset()   # no wake-up of its own while images come

    def _on_info(self, data: bytes, *, latched: bool) -> None:
        """Receive a serialised CameraInfo that differs by more than its stamp: few do."""
        if not latched:
            self._count(Role.CAMERA_INFO)
        if data[_STAMPED:] != self._last_info:
            self._last_info = data[_STAMPED:]
            self._info = deserialize_message(data, self._info_type)
            self._receive(Role.CAMERA_INFO, self._info)

    def _on_sample(self, role: Role, data: bytes) -> None:
        self._count(role)
        self.frame_ids[role] = frame_id_of_cdr(data)
        self._receive(role, data)

    def _receive(self, role: Role, message: Any) -> None:
        error = self._intake.receive(role, message)
        if error is not None:
            self.counts[INVALID] += 1
            self._on_invalid(str(error))

    def _count(self, role: Role) -> None:
        self.counts[role] += 1
        self._last_ns[role] = time.monotonic_ns()

    def _drain(self) -> None:
        for subscription in (self._camera_info, self._latched, *self._imu):
            subscription.drain()
