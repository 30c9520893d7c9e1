"""Subscriptions to camera and IMU, with counters; helpers for rclpy that all nodes share."""

from __future__ import annotations

from collections import Counter, deque
from collections.abc import Callable
from contextlib import ExitStack
import functools
from functools import partial
import importlib
import struct
import time
from typing import Any, TYPE_CHECKING

from rclpy.callback_groups import CallbackGroup
from rclpy.clock import Clock, ClockType
from rclpy.event_handler import SubscriptionEventCallbacks
from rclpy.exceptions import InvalidHandle
from rclpy.executors import ExternalShutdownException, SingleThreadedExecutor
from rclpy.impl.implementation_singleton import rclpy_implementation
from rclpy.node import Node
from rclpy.qos import DurabilityPolicy, HistoryPolicy, QoSPolicyKind, QoSProfile, ReliabilityPolicy
from rclpy.qos_overriding_options import QoSOverridingOptions
from rclpy.serialization import deserialize_message, serialize_message
from rclpy.time import Time

from rs_relpose_ros.errors import MissingInputError
from rs_relpose_ros.geometry.timing import NANOSECONDS
from rs_relpose_ros.messages.incoming import frame_id_of_cdr, Intake, PARTS, Role, stamp_ns
from rs_relpose_ros.nodes.diagnostics import INVALID, SILENCE, TOPICS

if TYPE_CHECKING:
    from rs_relpose_ros.calibrate.live import LiveCalibration

# -- Few wake-ups, and cheap ones -----------------------------------------------------------------
#
# For each message rclpy builds two wait sets of all entities of the node, in Python: that costs
# more than the message. `KeptWaitSet` lists them once. An IMU would still wake it hundreds of
# times a second, while its samples are needed only when a frame waits for them, some thirty times.
# Until then they stay in the queue of the middleware.

# Period [s] at which events, such as a publisher whose QoS does not match, are looked for: rclpy
# logs them.
_EVENTS_PERIOD = 1.0


class KeptWaitSet(SingleThreadedExecutor):
    """Executor of one node that calls subscriptions and timers itself, and rclpy for the rest.

    Its lists are kept until an entity is made or destroyed, which triggers the guard of rclpy's
    executor.
    """

    def __init__(self, **options: Any) -> None:
        super().__init__(**options)
        self._in_use = ExitStack()  # handles that must not be destroyed
        self._wait_set: Any = None
        self._events_at = 0.0

    def spin_once(self, timeout_sec: float | None = None) -> None:
        """Wait without a time limit for something to do, and do it."""
        if self._wait_set is None:
            self._list_entities()
        wait_set, now = self._wait_set, time.monotonic()
        wait_set.clear_entities()
        wait_set.add_guard_condition(self._guard.handle)
        for timer in self._timers:
            wait_set.add_timer(timer.handle)
        for service in self._services:
            wait_set.add_service(service.handle)
        for subscription in self._subscriptions:
            group = subscription.callback_group
            if not isinstance(group, _WhileUrgent) or group.can_execute(subscription):
                wait_set.add_subscription(subscription.handle)
        events = self._events if now > self._events_at + _EVENTS_PERIOD else ()
        for event in events:
            self._events_at = now
            event.add_to_wait_set(wait_set)
        # Tasks whose guard rclpy has read while it looked for other work: nothing else wakes it.
        waiting = any(not task.done() for task, _, _ in self._tasks)
        wait_set.wait(0 if waiting else -1)
        if not self.context.ok():
            raise ExternalShutdownException
        if (
            waiting
            or wait_set.get_ready_entities('guard_condition')
            or wait_set.get_ready_entities('service')
            or any(event.is_ready(wait_set) for event in events)
        ):
            self.release()
            super().spin_once(0.0)
            self._cb_iter = None  # forget what else was ready
            return
        ready = wait_set.get_ready_entities('timer')
        for timer in self._timers if ready else ():
            if timer.handle.pointer in ready and timer.handle.is_timer_ready():
                timer.handle.call_timer()
                timer.callback()
        ready = wait_set.get_ready_entities('subscription')
        for subscription in self._subscriptions if ready else ():
            if subscription.handle.pointer in ready:
                taken = subscription.handle.take_message(subscription.msg_type, subscription.raw)
                if taken is not None:
                    subscription.callback(taken[0])

    def release(self) -> None:
        """Let entities be destroyed; the next `spin_once` lists them again."""
        self._in_use.close()
        self._wait_set = None

    def _list_entities(self) -> None:
        (node,) = self.get_nodes()
        self._timers, self._services = [*node.timers], [*node.services]
        self._subscriptions, self._events = [*node.subscriptions], [*node.waitables]
        handled: Any = (
            *self._timers,
            *self._services,
            *self._subscriptions,
            self._guard,
            self.context,
        )
        for used in (*(entity.handle for entity in handled), *self._events):
            self._in_use.enter_context(used)
        self._wait_set = rclpy_implementation.WaitSet(
            len(self._subscriptions),
            1,
            len(self._timers),
            0,
            len(self._services),
            sum(event.get_num_entities().num_events for event in self._events),
            self.context.handle,
        )


# Most messages that are taken at once, so that other callbacks get their turn.
_MOST_AT_ONCE = 2000
# Bytes of a serialised message with a header before its stamp, and before its frame_id.
_STAMP, _STAMPED = 4, 12


class PolledSubscription:
    """A subscription that is read by `drain`, and wakes the executor only while it is urgent.

    `receive` gets the messages, or their bytes with `raw` among the `options`, which are those of
    ``create_subscription``; `urgent` is called before the executor waits. The depth of `qos` must
    hold the messages between two calls of `drain`.
    """

    def __init__(
        self,
        node: Node,
        msgtype: type,
        topic: str,
        qos: QoSProfile,
        receive: Callable[[list[Any]], None],
        urgent: Callable[[], bool],
        **options: Any,
    ) -> None:
        self._receive = receive
        self._subscription = node.create_subscription(
            msgtype, topic, self.drain, qos, callback_group=_WhileUrgent(urgent), **options
        )

    def drain(self, *received: Any) -> None:
        """Receive all messages of the queue, after those that the executor has taken from it."""
        subscription, messages = self._subscription, [*received]
        with subscription.handle:
            take = subscription.handle.take_message
            while (
                len(messages) < _MOST_AT_ONCE
                and (taken := take(subscription.msg_type, subscription.raw)) is not None
            ):
                messages.append(taken[0])
        if messages:
            self._receive(messages)


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
        raise MissingInputError(
            f'message type {msgtype} is not installed; install its package, or choose other topics'
        ) from None


class Serialised:
    """Serialises messages of a topic that differ in their stamps and their ends alone.

    rclpy takes a tenth of the time for bytes that it takes for a message with its parts.
    """

    def __init__(self) -> None:
        self._key: Any = None
        self._bytes = b''

    def __call__(
        self, stamp_ns: int, key: Any, make: Callable[[], Any], end: bytes = b''
    ) -> bytes:
        """The message that `make` returns for another `key` than before, with `end` at its end."""
        if key != self._key:
            self._key, self._bytes = key, serialize_message(make())
        return b''.join(
            (
                self._bytes[:_STAMP],
                struct.pack('=iI', *divmod(stamp_ns, NANOSECONDS)),
                self._bytes[_STAMPED : len(self._bytes) - len(end)],
                end,
            )
        )


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

# Queue of half a second of images: an overloaded node then drops them in its own queue, where they
# are counted, and not in the middleware, where they are not.
_IMAGE_DEPTH = 15
# Queue of some seconds of samples, so that none is lost while the process is stalled.
_IMU_DEPTH = 2000
# Messages published earlier are sent to reliable subscriptions only.
LATCHED = QoSProfile(
    depth=1, reliability=ReliabilityPolicy.RELIABLE, durability=DurabilityPolicy.TRANSIENT_LOCAL
)
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

    def __init__(
        self,
        node: Node,
        intake: Intake | LiveCalibration,
        image_transport: str,
        on_invalid: Callable[[str], None],
    ) -> None:
        self._intake, self._on_invalid = intake, on_invalid
        self._info: Any = None  # the last CameraInfo
        self._started_ns = time.monotonic_ns()
        self.counts: Counter[str] = Counter()  # of messages by role, and of the `INVALID` ones
        self._last_ns: dict[Role, int] = {}
        self._last_info = b''
        self.image_bytes = 0  # of the last image
        self.frame_ids: dict[Role, str] = {}  # of the last messages
        self.stamps_ns: deque[int] = deque(maxlen=_RECENT_STAMPS)  # of the last images
        self.topics = {role: node.resolve_topic_name(role.value) for role in TOPICS}
        # As image_transport does: the transport's name follows the remapped one.
        self.topics[Role.IMAGE] += '/compressed' if image_transport == 'compressed' else ''
        types = {role: message_class(PARTS[role].msgtypes[0]) for role in self.topics}
        types[Role.IMAGE] = message_class(
            PARTS[Role.IMAGE].msgtypes[image_transport == 'compressed']
        )
        self._info_type = types[Role.CAMERA_INFO]

        def missing_info() -> bool:
            return self._intake.intrinsics is None

        self._camera_info = PolledSubscription(
            node,
            self._info_type,
            Role.CAMERA_INFO.value,
            best_effort(_IMAGE_DEPTH),
            partial(self._on_info, latched=False),
            missing_info,
            raw=True,
            qos_overriding_options=overridable(),
        )
        # A message that a driver published once, before this node started: only a subscription of
        # the same durability gets it, which most drivers do not match, and need not.
        self._latched = PolledSubscription(
            node,
            self._info_type,
            Role.CAMERA_INFO.value,
            LATCHED,
            partial(self._on_info, latched=True),
            missing_info,
            raw=True,
            event_callbacks=SubscriptionEventCallbacks(use_default_callbacks=False),
        )
        self._imu = [
            PolledSubscription(
                node,
                types[role],
                role.value,
                best_effort(_IMU_DEPTH),
                partial(self._on_samples, role),
                lambda: self._intake.waits_for_imu(),
                raw=True,
                qos_overriding_options=overridable(),
            )
            for role in (Role.IMU, Role.ACCEL)
        ]
        node.create_subscription(
            types[Role.IMAGE],
            self.topics[Role.IMAGE],
            self._on_image,
            best_effort(_IMAGE_DEPTH),
            qos_overriding_options=overridable(),
        )
        self._timer = node.create_timer(
            _DRAIN_PERIOD, self._drain, clock=Clock(clock_type=ClockType.STEADY_TIME)
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
        self._camera_info.drain()
        self._count(Role.IMAGE)
        self.image_bytes = len(image.data)
        self.frame_ids[Role.IMAGE] = image.header.frame_id
        self.stamps_ns.append(stamp_ns(image.header))
        # An unusable image is refused by the sequencer, which counts it.
        self._intake.receive(Role.IMAGE, image)
        self._drain()
        self._timer.reset()  # no wake-up of its own while images come

    def _on_info(self, messages: list[bytes], *, latched: bool) -> None:
        """Receive each serialised CameraInfo that differs by more than its stamp: few do."""
        if not latched:
            self._count(Role.CAMERA_INFO, len(messages))
        for data in messages:
            if data[_STAMPED:] != self._last_info:
                self._last_info = data[_STAMPED:]
                self._info = deserialize_message(data, self._info_type)
                self._receive(Role.CAMERA_INFO, self._info)

    def _on_samples(self, role: Role, messages: list[bytes]) -> None:
        self._count(role, len(messages))
        self.frame_ids[role] = frame_id_of_cdr(messages[-1])
        for data in messages:
            self._receive(role, data)

    def _receive(self, role: Role, message: Any) -> None:
        error = self._intake.receive(role, message)
        if error is not None:
            self.counts[INVALID] += 1
            self._on_invalid(str(error))

    def _count(self, role: Role, messages: int = 1) -> None:
        self.counts[role] += messages
        self._last_ns[role] = time.monotonic_ns()

    def _drain(self) -> None:
        for subscription in (self._camera_info, self._latched, *self._imu):
            subscription.drain()
