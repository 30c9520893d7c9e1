"""Which topic plays which part, and what its messages are read as: said once, live and offline."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass
from enum import Enum
from typing import Any

from rs_relpose_ros.messages.incoming import (
    accelerometer_sample_from_message,
    image_from_message,
    imu_sample_from_message,
    intrinsics_from_info,
    pose_from_message,
)


class Role(str, Enum):
    """Part that a topic plays.

    The value is the name of the topic that the node subscribes to, and of the field that holds
    the topic of a bag in `rs_relpose_ros.bags.topics.SensorTopics`.
    """

    IMU = 'imu'
    ACCEL = 'accel'   # of drivers that publish the accelerometer apart
    CAMERA_INFO = 'camera_info'
    IMAGE = 'image'
    TRUTH = 'truth'


@dataclass(frozen=True, slots=True)
class Part:
    """Message types that can play a part, and how one of their messages is read."""

    msgtypes: tuple[str, ...]
    read: Callable[[Any], Any]


PARTS: Mapping[Role, Part] = {
    Role.IMU: Part(('sensor_msgs/msg/Imu',), imu_sample_from_message),
    Role.ACCEL: Part(('sensor_msgs/msg/Imu',), accelerometer_sample_from_message),
    Role.CAMERA_INFO: Part(('sensor_msgs/msg/CameraInfo',), intrinsics_from_info),
    Role.IMAGE: Part(('sensor_msgs/msg/Image', 'sensor_msgs/msg/CompressedImage'),
                     image_from_message),
    Role.TRUTH: Part(('geometry_msgs/msg/PoseStamped',), pose_from_message),
}


class SensorFeed:
    """Hands what the messages say to the handlers of their parts.

    `handlers`, by role, take what `PARTS` reads: `ImuSample`, `Intrinsics`, `PublishedImage` or
    `TruePose`.
    """

    def __init__(self, handlers: Mapping[Role, Callable[[Any], object]]) -> None:
        self._handlers = handlers

    def receive(self, role: Role, message: Any) -> None:
        """Read a message and hand it over; raises where it cannot be read or used."""
        self._handlers[role](PARTS[role].read(message))

    def messages(self, bag: Any, topics: Any) -> Iterator[tuple[Role, Any]]:
        """Messages of a `Bag` that play a part with a handler, as `BagMessage`, in bag order.

        `topics` has the names of the roles, None where nothing plays the part (`SensorTopics`).
        """
        roles = {topic.name: (role, topic) for role in reversed(Role)
                 if role in self._handlers and (topic := getattr(topics, role.value)) is not None}
        for message in bag.messages([topic for _, topic in roles.values()]):
            yield roles[message.topic][0], message
