"""A sensor stream with faults: phases of a bag, each good, then faulty, then good again."""

from collections.abc import Callable, Collection, Iterable, Iterator
import copy
from dataclasses import dataclass
import itertools
from pathlib import Path
import time
from typing import Any

import cv2
import numpy as np
import rclpy.serialization
from rosbags.highlevel import AnyReader
from sensor_msgs.msg import CameraInfo, CompressedImage, Image, Imu

from rs_relpose_lab.live.graph import Graph
from rs_relpose_lab.live.live_cases import gray_image, pixels_of
from rs_relpose_ros.bags.sensor_topics import (
    CAMERA_INFO_TOPIC,
    COMPRESSED_TOPIC,
    IMU_TOPIC,
    RAW_TOPIC,
)
from rs_relpose_ros.messages.incoming import stamp_ns

SECOND = 10**9
# Topics of the node -> those of the bag.
TOPIC_OF = {Image: RAW_TOPIC, CameraInfo: CAMERA_INFO_TOPIC, Imu: IMU_TOPIC}
BAG_TOPICS = {'image': RAW_TOPIC, 'camera_info': CAMERA_INFO_TOPIC, 'imu': IMU_TOPIC}
_TYPES = {IMU_TOPIC: Imu, CAMERA_INFO_TOPIC: CameraInfo, COMPRESSED_TOPIC: CompressedImage}

# Of a phase [s]: begin and end of its fault, longest duration, and pause before the next one.
FAULT_FROM = 0.25
FAULT_UNTIL = 0.65
PHASE = 1.55
PAUSE = 0.15
# The nodes go by stamps: phases are played faster than in real time.
FASTER = 2.0


def reliable(*topics: str) -> dict[str, str]:
    """For tests that count or compare all messages: a busy machine loses those of best effort."""
    return {f'qos_overrides.{topic}.subscription.reliability': 'reliable' for topic in topics}


# A message and its time [s] in the phase -> what is sent instead, with delays [s].
Edit = Callable[[Any, float], Iterable[tuple[float, Any]]]


@dataclass(frozen=True)
class Fault:
    """Fault of the messages of a phase.

    It begins at `begin` [s] of the phase; `jump` [s] is added to all stamps from there on, `said`
    must be logged.
    """

    name: str
    edit: Edit
    said: str = ''
    jump: float = 0.0
    begin: float = FAULT_FROM


@dataclass(frozen=True)
class Sent:
    """A message to send at `time_ns` of its phase, made from an image of `taken_ns` in the bag."""

    time_ns: int
    taken_ns: int
    stamp_ns: int  # without the fault
    message: Any


class Stream:
    """Plays phases of a bag's beginning, each good, then faulty, then good again."""

    def __init__(
        self, messages: list[tuple[int, Any]], faults: list[Fault], first_stamp_ns: int
    ) -> None:
        self.bag_start_ns, first = messages[0]
        # Of an image by its stamp as sent: stamp in the bag (None if of two images), and phase.
        self.taken_at: dict[int, int | None] = {}
        self.phase_of: dict[int, int] = {}
        # For each phase the stamps between which the data are good again.
        self.good: list[tuple[int, int]] = []
        self._faults = faults
        self._bag_first_ns = stamp_of(first)
        self._later_ns = first_stamp_ns - stamp_of(first)
        self._phases = [self._phase(messages, fault) for fault in faults]

    def _phase(self, messages: list[tuple[int, Any]], fault: Fault) -> list[Sent]:
        sent = []
        for bag_time_ns, message in messages:
            time_ns = bag_time_ns - self.bag_start_ns
            seconds = time_ns / SECOND
            if seconds > PHASE:
                break
            taken_ns = stamp_of(message)
            out = with_stamp(
                message, taken_ns + round(fault.jump * SECOND if seconds >= fault.begin else 0)
            )
            faulty = fault.begin <= seconds < FAULT_UNTIL
            sent += [
                Sent(time_ns + round(delay * SECOND), taken_ns, stamp_of(out), item)
                for delay, item in (fault.edit(out, seconds) if faulty else [(0.0, out)])
            ]
        return sorted(sent, key=lambda item: item.time_ns)

    def play(
        self,
        publish: Callable[[int, Any], object],
        results: list[Any],
        phases: range | None = None,
        enough: int = 2,
    ) -> None:
        """Publish (number of the phase, message) of some phases, all by default.

        A phase ends once there are `enough` results with stamps of its good end.
        """
        for phase in range(len(self._phases)) if phases is None else phases:
            jump_ns = round(self._faults[phase].jump * SECOND)
            before = len(results)
            begin_ns = self._bag_first_ns + self._later_ns + jump_ns + round(FAULT_UNTIL * SECOND)
            # Delayed messages come later than the fault ends.
            faulty_ns = max(
                item.time_ns
                for item in self._phases[phase]
                if item.taken_ns < self._bag_first_ns + FAULT_UNTIL * SECOND
            )
            started = time.monotonic()
            last_ns = 0
            for item in self._phases[phase]:
                if (
                    item.time_ns > faulty_ns
                    and sum(
                        begin_ns <= stamp_of(result) <= begin_ns + SECOND
                        for result in results[before:]
                    )
                    >= enough
                ):
                    break
                last_ns = item.time_ns
                delay = started + last_ns / SECOND / FASTER - time.monotonic()
                if delay > 0.0:
                    time.sleep(delay)
                if isinstance(item.message, Image):
                    stamp = item.stamp_ns + self._later_ns
                    self.phase_of[stamp] = phase
                    if self.taken_at.setdefault(stamp, item.taken_ns) != item.taken_ns:
                        self.taken_at[stamp] = None
                publish(phase, with_stamp(item.message, stamp_of(item.message) + self._later_ns))
            self.good.append((begin_ns, begin_ns + last_ns - round(FAULT_UNTIL * SECOND)))
            self._later_ns += last_ns + round(PAUSE * SECOND) + jump_ns
            time.sleep(PAUSE / FASTER)


def read_messages(bag: Path, seconds: float, every: int = 1) -> list[tuple[int, Any]]:
    """Bag time [ns] and message of the bag's first seconds; only `every`-th image, decoded."""
    messages: list[tuple[int, Any]] = []
    images = itertools.count()
    with AnyReader([bag]) as reader:
        connections = [c for c in reader.connections if c.topic in _TYPES]
        for connection, bag_time_ns, raw in reader.messages(connections):
            if messages and bag_time_ns - messages[0][0] > seconds * SECOND:
                break
            message = rclpy.serialization.deserialize_message(bytes(raw), _TYPES[connection.topic])
            if isinstance(message, CompressedImage):
                if next(images) % every:
                    continue
                pixels = cv2.imdecode(np.frombuffer(message.data, np.uint8), cv2.IMREAD_GRAYSCALE)
                message = gray_image(message.header, pixels)
            messages.append((bag_time_ns, message))
    return messages


def publish_in_time(messages: Iterable[tuple[Any, int, Any]]) -> None:
    """Publish (publisher, bag time [ns], message) at bag time."""
    first_ns = None
    started = time.monotonic()
    for publisher, bag_time_ns, message in messages:
        first_ns = bag_time_ns if first_ns is None else first_ns
        delay = started + (bag_time_ns - first_ns) * 1e-9 - time.monotonic()
        if delay > 0.0:
            time.sleep(delay)
        publisher.publish(message)


def drivers(graph: Graph, *kinds: type, best_effort: Collection[type] = ()) -> dict[type, Any]:
    """Subscribed publishers of a camera and an IMU by type of message, all by default."""
    return {
        kind: graph.publisher(kind, topic, kind in best_effort)
        for kind, topic in TOPIC_OF.items()
        if kind in (kinds or TOPIC_OF)
    }


def play(publishers: dict[type, Any], messages: list[tuple[int, Any]], later: float = 0.0) -> None:
    """Publish at bag time the messages that have a publisher, their stamps `later` [s]."""
    publish_in_time(
        (
            publishers[type(message)],
            bag_time_ns,
            with_stamp(message, stamp_of(message) + round(later * SECOND)),
        )
        for bag_time_ns, message in messages
        if type(message) in publishers
    )


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


def without(kind: type, begin: float = 0.0, end: float = FAULT_UNTIL) -> Edit:
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
