"""A sensor stream with faults in it: phases of a bag, each good, then faulty, then good again."""

from __future__ import annotations

from array import array
from collections.abc import Callable, Iterable, Iterator
import copy
from dataclasses import dataclass
from pathlib import Path
import time
from typing import Any

import cv2
import numpy as np
import rclpy.serialization
from rosbags.highlevel import AnyReader
from sensor_msgs.msg import CameraInfo, CompressedImage, Image, Imu

from rs_relpose_ros.bags.layout import CAMERA_INFO_TOPIC, COMPRESSED_TOPIC, IMU_TOPIC, RAW_TOPIC
from rs_relpose_ros.messages.incoming import stamp_ns

SECOND = 10**9
# Topics of the node -> those of the bag.
BAG_TOPICS = {'image': RAW_TOPIC, 'camera_info': CAMERA_INFO_TOPIC, 'imu': IMU_TOPIC}
_TYPES = {IMU_TOPIC: Imu, CAMERA_INFO_TOPIC: CameraInfo, COMPRESSED_TOPIC: CompressedImage}

# Of a phase [s]: when its fault begins and ends, and how much of the bag it plays.
FAULT_FROM, FAULT_UNTIL, PHASE = 0.25, 0.65, 1.55
# Between two phases, on all clocks [s].
PAUSE = 0.15

# A message and its time [s] in the phase -> what is sent instead, with delays [s].
Edit = Callable[[Any, float], Iterable[tuple[float, Any]]]


@dataclass(frozen=True)
class Fault:
    """What is done to the messages of a phase while it lasts.

    It begins at `begin` [s] of the phase. `jump` is added to all stamps [s] from its beginning on,
    `said` must be logged.
    """

    name: str
    edit: Edit
    said: str = ''
    jump: float = 0.0
    begin: float = FAULT_FROM


@dataclass(frozen=True)
class Sent:
    """A message to send at `time_ns` of the whole stream."""

    time_ns: int
    phase: int
    message: Any


class Stream:
    """All phases in a row.

    Attributes
    ----------
    sent : list of Sent
    taken_at : dict
        Stamp of an image as sent -> the instant of the bag at which it was taken; None where two
        images of different instants carry the same stamp.
    phase_of : dict
        Stamp of an image as sent -> its phase.
    good : list of (int, int)
        Of each phase the stamps between which all is good again.
    """

    def __init__(self, messages: list[tuple[int, Any]], faults: list[Fault],
                 first_stamp_ns: int) -> None:
        self.sent: list[Sent] = []
        self.taken_at: dict[int, int | None] = {}
        self.phase_of: dict[int, int] = {}
        self.good: list[tuple[int, int]] = []
        bag_start_ns, bag_first_stamp_ns = messages[0][0], stamp_of(messages[0][1])
        self.bag_start_ns = bag_start_ns
        later_ns = first_stamp_ns - bag_first_stamp_ns
        start_ns = 0
        for phase, fault in enumerate(faults):
            for bag_time_ns, message in messages:
                seconds = (bag_time_ns - bag_start_ns) / SECOND
                if seconds > PHASE:
                    break
                out = with_stamp(message, stamp_of(message) + later_ns + round(
                    fault.jump * SECOND if seconds >= fault.begin else 0))
                if isinstance(out, Image):
                    self.phase_of[stamp_of(out)] = phase
                    known = self.taken_at.setdefault(stamp_of(out), stamp_of(message))
                    if known != stamp_of(message):
                        self.taken_at[stamp_of(out)] = None
                faulty = fault.begin <= seconds < FAULT_UNTIL
                for delay, item in (fault.edit(out, seconds) if faulty else [(0.0, out)]):
                    self.sent.append(Sent(start_ns + bag_time_ns - bag_start_ns
                                          + round(delay * SECOND), phase, item))
            begin_ns = bag_first_stamp_ns + later_ns + round(fault.jump * SECOND)
            self.good.append((begin_ns + round(FAULT_UNTIL * SECOND),
                              begin_ns + round(PHASE * SECOND)))
            start_ns += round((PHASE + PAUSE) * SECOND)
            later_ns += round((PHASE + PAUSE + fault.jump) * SECOND)
        self.sent.sort(key=lambda sent: sent.time_ns)


def read_messages(bag: Path, seconds: float) -> list[tuple[int, Any]]:
    """Bag time [ns] and message of the bag's first seconds, images decoded."""
    messages: list[tuple[int, Any]] = []
    with AnyReader([bag]) as reader:
        connections = [c for c in reader.connections if c.topic in _TYPES]
        for connection, bag_time_ns, raw in reader.messages(connections):
            if messages and bag_time_ns - messages[0][0] > seconds * SECOND:
                break
            message = rclpy.serialization.deserialize_message(
                bytes(raw), _TYPES[connection.topic])
            if isinstance(message, CompressedImage):
                pixels = cv2.imdecode(np.frombuffer(message.data, np.uint8), cv2.IMREAD_GRAYSCALE)
                message = gray_image(message.header, pixels)
            messages.append((bag_time_ns, message))
    return messages


def publish_in_time(messages: Iterable[tuple[Any, int, Any]]) -> None:
    """Publish (publisher, bag time [ns], message) at bag time."""
    first_ns, started = None, time.monotonic()
    for publisher, bag_time_ns, message in messages:
        first_ns = bag_time_ns if first_ns is None else first_ns
        delay = started + (bag_time_ns - first_ns) * 1e-9 - time.monotonic()
        if delay > 0.0:
            time.sleep(delay)
        publisher.publish(message)


def gray_image(header: Any, pixels: np.ndarray) -> Image:
    data = array('B')
    data.frombytes(np.ascontiguousarray(pixels).tobytes())
    return Image(header=header, height=pixels.shape[0], width=pixels.shape[1], encoding='mono8',
                 step=pixels.shape[1], data=data)


def pixels_of(image: Image) -> np.ndarray:
    return np.frombuffer(image.data, np.uint8).reshape(image.height, image.width)


def stamp_of(message: Any) -> int:
    return stamp_ns(message.header)


def with_stamp(message: Any, new_stamp_ns: int) -> Any:
    """A copy with another stamp; it shares the data."""
    out = copy.copy(message)
    out.header = copy.deepcopy(message.header)
    out.header.stamp.sec, out.header.stamp.nanosec = divmod(new_stamp_ns, SECOND)
    return out


# -- faults ----------------------------------------------------------------------------------


def nothing(message: Any, _: float) -> Iterator[tuple[float, Any]]:
    """No fault."""
    yield 0.0, message


def without(kind: type, begin: float = FAULT_FROM, end: float = FAULT_UNTIL) -> Edit:
    """The driver of one kind of message stops."""
    def edit(message: Any, seconds: float) -> Iterator[tuple[float, Any]]:
        if not (isinstance(message, kind) and begin <= seconds < end):
            yield 0.0, message
    return edit


def changed(kind: type, change: Callable[[Any], Any]) -> Edit:
    """Every message of one kind is changed in place, or replaced where `change` returns one."""
    def edit(message: Any, _: float) -> Iterator[tuple[float, Any]]:
        if isinstance(message, kind):
            own = copy.deepcopy(message)
            message = change(own) or own
        yield 0.0, message
    return edit


def delayed(kind: type, delay: Callable[[], float]) -> Edit:
    """Every message of one kind comes later."""
    def edit(message: Any, _: float) -> Iterator[tuple[float, Any]]:
        yield delay() if isinstance(message, kind) else 0.0, message
    return edit


def twice(message: Any, _: float) -> Iterator[tuple[float, Any]]:
    """Every message comes twice."""
    yield 0.0, message
    yield 0.001, message


def first_ahead(kind: type, seconds: float) -> Edit:
    """One message of a kind carries a stamp far ahead."""
    done: list[bool] = []

    def edit(message: Any, _: float) -> Iterator[tuple[float, Any]]:
        if isinstance(message, kind) and not done:
            done.append(True)
            message = with_stamp(message, stamp_of(message) + round(seconds * SECOND))
        yield 0.0, message
    return edit


def every(kind: type, number: int) -> Edit:
    """Only every so-manyth message of a kind comes."""
    count = [0]

    def edit(message: Any, _: float) -> Iterator[tuple[float, Any]]:
        count[0] += isinstance(message, kind)
        if not isinstance(message, kind) or count[0] % number == 0:
            yield 0.0, message
    return edit


def vector(name: str, **values: float) -> Callable[[Any], None]:
    """Set components of a vector of an Imu message."""
    def change(message: Imu) -> None:
        for axis, value in values.items():
            setattr(getattr(message, name), axis, value)
    return change


def pixels(make: Callable[[np.ndarray], np.ndarray]) -> Callable[[Any], Any]:
    """Replace the pixels of an image."""
    return lambda image: gray_image(image.header, make(pixels_of(image)))


def repeating(part: Callable[[Any], Any], put: Callable[[Any, Any], Any]) -> Callable[[Any], Any]:
    """The first message's part in all that follow: a driver that hangs."""
    first: list[Any] = []

    def change(message: Any) -> Any:
        if not first:
            first.append(part(message))
        return put(message, first[0])
    return change
