"""Topics that are read when their messages are needed, instead of waking the process each time.

A wake-up costs rclpy more than the message itself, because it builds a new wait set of all that
the node has. An IMU would wake it hundreds of times a second, while its samples are needed only
when a frame asks for them, some thirty times. Until then they stay in the queue of the middleware.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

from rclpy.callback_groups import CallbackGroup
from rclpy.node import Node
from rclpy.qos import QoSProfile
from rclpy.serialization import deserialize_message

# Most messages that are taken at once, so that other callbacks get their turn.
_MOST_AT_ONCE = 2000
# Bytes of CDR before the frame_id of a message with a header: encapsulation (4) and stamp (8).
_STAMPED = 12


class PolledSubscription:
    """A subscription that is read by `drain`, and wakes the executor only while it is urgent.

    `receive` gets each message, its bytes where `raw` is among the `options`, which are those of
    ``create_subscription``; `urgent` is asked before the executor waits. The depth of `qos` must
    hold what comes between two calls of `drain`.
    """

    def __init__(self, node: Node, msgtype: type, topic: str, qos: QoSProfile,
                 receive: Callable[[Any], None], urgent: Callable[[], bool],
                 **options: Any) -> None:
        self._receive = receive
        self._subscription = node.create_subscription(
            msgtype, topic, self._on_message, qos, callback_group=_WhileUrgent(urgent),
            **options)

    def drain(self) -> None:
        """Receive all that has come."""
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


class WhenChanged:
    """Hands on a serialised message only if it differs from the last one by more than its stamp.

    For messages that begin with a std_msgs/Header: a CameraInfo comes with each image and hardly
    ever changes.
    """

    def __init__(self, msgtype: type, receive: Callable[[Any], None]) -> None:
        self._msgtype = msgtype
        self._receive = receive
        self._last = b''

    def __call__(self, data: bytes) -> None:
        """Take a serialised message."""
        if data[_STAMPED:] != self._last:
            self._last = data[_STAMPED:]
            self._receive(deserialize_message(data, self._msgtype))
