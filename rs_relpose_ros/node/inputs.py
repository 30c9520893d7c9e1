"""What the node subscribes to: camera and IMU, how much of it came, and when last."""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable
from functools import partial
from typing import Any

from rclpy.clock import Clock
from rclpy.event_handler import SubscriptionEventCallbacks
from rclpy.node import Node
from rclpy.qos import DurabilityPolicy, HistoryPolicy, QoSPolicyKind, QoSProfile, ReliabilityPolicy
from rclpy.qos_overriding_options import QoSOverridingOptions

from rs_relpose_ros.errors import RsRelposeError
from rs_relpose_ros.geometry.timing import NANOSECONDS
from rs_relpose_ros.messages.intake import Intake
from rs_relpose_ros.messages.sensor_feed import PARTS, Role
from rs_relpose_ros.node.frame_statistics import Inputs, SILENCE
from rs_relpose_ros.node.message_types import message_class
from rs_relpose_ros.node.polled import PolledSubscription, WhenChanged

# Queue of half a second of images: an overloaded node then drops them in its own mailbox, where
# they are counted, and not in the middleware, where they are not.
_IMAGE_DEPTH = 15
# Queue of some seconds of samples, so that none is lost while the process is stalled.
_IMU_DEPTH = 2000
# What was published before is sent to reliable subscriptions only.
_LATCHED = QoSProfile(depth=1, reliability=ReliabilityPolicy.RELIABLE,
                      durability=DurabilityPolicy.TRANSIENT_LOCAL)
# Period [s] at which IMU and CameraInfo are read where no image asks for them.
_DRAIN_PERIOD = 0.1


class SensorInputs:
    """Subscriptions to the topics of the camera and the IMU; hands messages to the intake.

    `topics` are the resolved names by role, `image_bytes` is the size of the last image.
    `waits_for_imu` tells whether a frame needs samples that have not been read yet, `on_invalid`
    gets the sentence about a message that cannot be used. The `clock` is steady: silence goes by
    the wall's pace also where /clock stands still.
    """

    def __init__(self, node: Node, intake: Intake, waits_for_imu: Callable[[], bool],
                 image_transport: str, on_invalid: Callable[[str], None], clock: Clock) -> None:
        self._intake, self._on_invalid, self._clock = intake, on_invalid, clock
        self._started_ns = self._now_ns()
        self._counts: Counter[Role] = Counter()
        self._invalid = 0
        self._heard_ns: dict[Role, int] = {}
        self.image_bytes = 0   # of the last image
        self.topics = {role: node.resolve_topic_name(role.value) for role in (
            Role.IMAGE, Role.CAMERA_INFO, Role.IMU, Role.ACCEL)}
        # As image_transport does: the transport's name follows the remapped one.
        self.topics[Role.IMAGE] += '/compressed' if image_transport == 'compressed' else ''
        types = {role: message_class(PARTS[role].msgtypes[0]) for role in self.topics}
        types[Role.IMAGE] = message_class(
            PARTS[Role.IMAGE].msgtypes[image_transport == 'compressed'])

        def polled(role: Role, depth: int, receive: Callable[[Any], None],
                   urgent: Callable[[], bool], raw: bool = False) -> PolledSubscription:
            return PolledSubscription(node, types[role], role.value, best_effort(depth),
                                      partial(self._receive, role, receive), urgent, raw=raw,
                                      qos_overriding_options=overridable())

        changed = WhenChanged(types[Role.CAMERA_INFO], partial(intake.receive, Role.CAMERA_INFO))
        self._camera_info = polled(Role.CAMERA_INFO, _IMAGE_DEPTH, changed,
                                   lambda: intake.intrinsics is None, raw=True)
        # What a driver published once, before this node came: only a subscription of the same
        # durability gets it, which most drivers do not match, and need not.
        self._latched = PolledSubscription(
            node, types[Role.CAMERA_INFO], Role.CAMERA_INFO.value, _LATCHED,
            partial(self._try, changed), lambda: intake.intrinsics is None, raw=True,
            event_callbacks=SubscriptionEventCallbacks(use_default_callbacks=False))
        self._imu = [polled(role, _IMU_DEPTH, partial(intake.receive, role), waits_for_imu)
                     for role in (Role.IMU, Role.ACCEL)]
        node.create_subscription(
            types[Role.IMAGE], self.topics[Role.IMAGE], self._on_image,
            best_effort(_IMAGE_DEPTH), qos_overriding_options=overridable())
        node.create_timer(_DRAIN_PERIOD, self._drain, clock=clock)

    def totals(self) -> Inputs:
        """Numbers of messages so far."""
        return Inputs(self._counts[Role.IMAGE], self._counts[Role.CAMERA_INFO],
                      self._counts[Role.IMU], self._counts[Role.ACCEL], self._invalid)

    def silent(self, role: Role, seconds: float = SILENCE) -> bool:
        """Whether nothing has come for so long."""
        heard_ns = self._heard_ns.get(role, self._started_ns)
        return self._now_ns() - heard_ns > seconds * NANOSECONDS

    def _receive(self, role: Role, receive: Callable[[Any], None], message: Any) -> None:
        self._counts[role] += 1
        self._heard_ns[role] = self._now_ns()
        self._try(receive, message)

    def _try(self, receive: Callable[[Any], None], message: Any) -> None:
        try:
            receive(message)
        except RsRelposeError as error:
            self._invalid += 1
            self._on_invalid(str(error))

    def _on_image(self, image: Any) -> None:
        # The CameraInfo that came before an image belongs to it.
        self._camera_info.drain()
        self.image_bytes = len(image.data)
        self._receive(Role.IMAGE, partial(self._intake.receive, Role.IMAGE), image)
        self._drain_imu()

    def _drain(self) -> None:
        self._camera_info.drain()
        self._latched.drain()
        self._drain_imu()

    def _drain_imu(self) -> None:
        for subscription in self._imu:
            subscription.drain()

    def _now_ns(self) -> int:
        return int(self._clock.now().nanoseconds)


def overridable() -> QoSOverridingOptions:
    """The policies that parameters may override."""
    return QoSOverridingOptions((QoSPolicyKind.HISTORY, QoSPolicyKind.DEPTH,
                                 QoSPolicyKind.RELIABILITY, QoSPolicyKind.DURABILITY))


def best_effort(depth: int) -> QoSProfile:
    """Matches every publisher, which a reliable subscription would not.

    A profile of its own for each topic: rclpy writes the topic's overrides into what it is given.
    """
    return QoSProfile(history=HistoryPolicy.KEEP_LAST, depth=depth,
                      reliability=ReliabilityPolicy.BEST_EFFORT)
