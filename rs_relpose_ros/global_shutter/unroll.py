"""A bag with its images turned to their middle row, and everything else as it is."""

from __future__ import annotations

from collections import deque
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
import tempfile
from typing import Any, NamedTuple

from rs_relpose_ros.bags.reader import Bag, RawMessage
from rs_relpose_ros.bags.topics import (
    CAMERA_INFO,
    COMPRESSED_IMAGE,
    IMAGE,
    SensorTopics,
    Topic,
)
from rs_relpose_ros.bags.writer import BagWriter
from rs_relpose_ros.config.parameters import Parameters
from rs_relpose_ros.errors import InputError, RsRelposeError
from rs_relpose_ros.front_end.front_end import FrameFailed
from rs_relpose_ros.front_end.sequencer import FrameRefused
from rs_relpose_ros.global_shutter.frames import color_frames, GlobalShutterFrame
from rs_relpose_ros.global_shutter.unroller import unrolling_loop
from rs_relpose_ros.messages.causes import CauseCounts
from rs_relpose_ros.messages.incoming import stamp_ns
from rs_relpose_ros.messages.intake import Intake
from rs_relpose_ros.messages.outgoing import (
    camera_info_message,
    compressed_image_message,
    image_message,
)
from rs_relpose_ros.messages.sensor_feed import PARTS, Role

# Where the bag has no CameraInfo and parameters tell the intrinsics.
_TOLD_TOPIC = 'camera_info'


@dataclass(slots=True)
class UnrollReport:
    """What became of a bag."""

    images_in_bag: int = 0
    images: int = 0   # turned and written
    largest_shift: float = 0.0   # [px] of any pixel
    copied: int = 0   # messages of other topics
    topics_copied: int = 0
    reasons: Mapping[str, int] = field(default_factory=dict)   # why images were left out
    warnings: tuple[str, ...] = ()


class _New(NamedTuple):
    """A message that is made anew."""

    topic: str
    msgtype: str
    message: Any


@dataclass(slots=True, eq=False)
class _Place:
    """A place in the new bag, in the order of receive times.

    `messages`: what stands there; none for an image that is left out, None until it is known.
    """

    bag_time_ns: int
    messages: Sequence[_New | RawMessage] | None = None


def unroll(bag: Bag, topics: SensorTopics, parameters: Parameters, out: Path, *,
           on_image: Callable[[], object] = lambda: None) -> UnrollReport:
    """Write the bag `out`, a directory that does not exist and comes into being when it is whole.

    Nothing is written where no image can be turned. `on_image` is called after each image.
    """
    try:
        out.parent.mkdir(parents=True, exist_ok=True)
        # Beside it, so that it can be renamed; of the same name, which its files carry.
        beside = tempfile.TemporaryDirectory(prefix=f'.{out.name}.', suffix='.part',
                                             dir=out.parent)
    except OSError as error:
        raise InputError(f'{out} cannot be written: {error.strerror}') from error
    with beside as folder:
        part = Path(folder) / out.name
        with BagWriter(part) as writer:
            report = _Unrolling(bag, topics, parameters, writer, on_image).run()
        if report.images:
            part.rename(out)
    return report


class _Unrolling:
    """One run over a bag.

    Messages are written in the order of their receive times. Those that come after an image wait
    until the gyro covers it.
    """

    def __init__(self, bag: Bag, topics: SensorTopics, parameters: Parameters, writer: BagWriter,
                 on_image: Callable[[], object]) -> None:
        self._bag, self._topics, self._writer, self._on_image = bag, topics, writer, on_image
        self._stamp_clock = parameters.global_shutter.stamp_clock
        self._loop = unrolling_loop(parameters, offline=True)
        self._intake = Intake(self._loop.sequencer, parameters.imu.stuck_gyro_time,
                              parameters.intrinsics, color_frames())
        self._places: deque[_Place] = deque()
        # Places of images and of their CameraInfos, by stamp, whose write is not known yet.
        self._images: dict[int, deque[_Place]] = {}
        self._infos: dict[int, _Place] = {}
        self._stamps: set[int] = set()
        self._shared: dict[str, list[bool]] = {}   # of other image topics: stamp is an image's
        self._reasons = CauseCounts()
        self._report = UnrollReport()

    def run(self) -> UnrollReport:
        """Write the new bag."""
        copied = self._announce()
        roles = {(topic.name, topic.msgtype): role for role in (
            Role.IMAGE, Role.CAMERA_INFO, Role.IMU, Role.ACCEL)
            if (topic := getattr(self._topics, role.value)) is not None}
        for raw in self._bag.raw_messages(copied):
            role = roles.get((raw.topic, raw.msgtype))
            if role in (Role.IMAGE, Role.CAMERA_INFO):
                self._replace(role, raw)
            else:
                self._copy(role, raw)
            self._drain()
        self._intake.release_held()
        self._loop.sequencer.close()
        self._drain()
        for place in self._places:
            place.messages = place.messages or ()
        self._flush()
        self._report.reasons = self._reasons.most_common()
        self._warn_of_shared_stamps()
        return self._report

    def _announce(self) -> list[Topic]:
        """Announce all topics; those that are read."""
        copied = [topic for topic in self._bag.topics if self._bag.can_be_copied(topic)]
        for topic in copied:
            self._writer.announce(topic, self._bag.origin(topic))
        self._report.warnings = tuple(
            f'{topic} is left out: ROS 2 has no such message type'
            for topic in self._bag.topics if topic not in copied)
        own = {self._topics.image, self._topics.camera_info}
        self._report.topics_copied = sum(topic not in own for topic in copied)
        return copied

    # -- messages of the bag -----------------------------------------------------------------

    def _copy(self, role: Role | None, raw: RawMessage) -> None:
        """Copy a message, which may be of the IMU."""
        self._report.copied += 1
        self._places.append(_Place(raw.bag_time_ns, (raw,)))
        if role is not None:
            self._receive(role, self._bag.read(raw))
        elif raw.msgtype in (IMAGE, COMPRESSED_IMAGE):
            self._shared.setdefault(raw.topic, []).append(
                stamp_ns(self._bag.read(raw).header) in self._stamps)

    def _replace(self, role: Role, raw: RawMessage) -> None:
        """Keep the place of an image or of a CameraInfo until its image is turned."""
        message = self._bag.read(raw)
        place = _Place(raw.bag_time_ns)
        try:
            stamp = stamp_ns(message.header)
            if role is Role.IMAGE:
                self._report.images_in_bag += 1
                self._on_image()
                PARTS[role].read(message)
        except RsRelposeError as error:
            self._reasons.add(str(error))
            return
        self._places.append(place)
        if role is Role.IMAGE:
            self._stamps.add(stamp)
            self._images.setdefault(stamp, deque()).append(place)
        else:
            if stamp in self._infos:   # two of one stamp: the later one is the image's
                self._infos[stamp].messages = ()
            self._infos[stamp] = place
        self._receive(role, message)

    def _receive(self, role: Role, message: Any) -> None:
        try:
            self._intake.receive(role, message)
        except RsRelposeError as error:
            topic = getattr(self._topics, role.value).name
            if role is Role.CAMERA_INFO and not self._report.images:
                # Without intrinsics no image can be turned: end now, not after the whole bag.
                raise type(error)(f'{topic}: {error}') from error
            self._reasons.add(f'{topic}: {error}')

    # -- images ------------------------------------------------------------------------------

    def _drain(self) -> None:
        """Turn what the gyro covers by now, and write all that is known."""
        while (outcome := self._loop.step()) is not None:
            if isinstance(outcome, FrameRefused):
                self._reasons.add(f'{outcome.cause.value}: {outcome.reason}')
            elif isinstance(outcome, FrameFailed):
                self._reasons.add(str(outcome.error))
            turned = getattr(outcome, 'result', None)
            if outcome.stamp_ns is not None:
                self._settle(outcome.stamp_ns, turned)
        self._flush()

    def _settle(self, stamp: int, turned: GlobalShutterFrame | None) -> None:
        """Fill the places of an image and its CameraInfo."""
        places = self._images.get(stamp)
        if not places:
            return
        image = places.popleft()
        if not places:
            del self._images[stamp]
        info = self._infos.pop(stamp, None)
        if turned is None:
            image.messages = ()
            if info is not None:
                info.messages = ()
        else:
            new_info, new_image = self._new_info(turned), self._new_image(turned)
            if info is None:
                image.messages = new_info, new_image
            else:
                info.messages, image.messages = (new_info,), (new_image,)
            self._report.images += 1
            self._report.largest_shift = max(self._report.largest_shift, turned.map.shift)
        # CameraInfos of no image.
        for old in [other for other in self._infos if other < stamp]:
            self._infos.pop(old).messages = ()

    def _new_image(self, turned: GlobalShutterFrame) -> _New:
        topic, frame = self._topics.image, turned.frame
        place = turned.stamp_ns, frame.frame_id
        pixels, types = turned.image(), self._writer.type
        message = (compressed_image_message(*place, pixels, png=frame.is_png, types=types)
                   if topic.msgtype == COMPRESSED_IMAGE else image_message(*place, pixels, types))
        return _New(topic.name, topic.msgtype, message)

    def _new_info(self, turned: GlobalShutterFrame) -> _New:
        frame = turned.frame
        message = camera_info_message(
            turned.stamp_ns, frame.frame_id, frame.intrinsics,
            self._intake.camera_info_of(frame.intrinsics), self._writer.type)
        topic = self._topics.camera_info
        name = _told_topic(self._topics.image) if topic is None else topic.name
        return _New(name, CAMERA_INFO, message)

    def _flush(self) -> None:
        while self._places and self._places[0].messages is not None:
            place = self._places.popleft()
            for message in place.messages or ():
                if isinstance(message, RawMessage):
                    self._writer.copy(message)
                else:
                    self._writer.write(*message, place.bag_time_ns)

    def _warn_of_shared_stamps(self) -> None:
        """Other images of the same instants carry the camera's stamps."""
        shared = [topic for topic, found in self._shared.items() if 2 * sum(found) > len(found)]
        if shared and self._stamp_clock == 'imu':
            sentence = (f'{", ".join(shared)} had the stamps of the turned images and keep them, '
                        "on the camera's clock: set stamp_clock=camera where they are used "
                        'together (depth, stereo)')
            self._report.warnings += (sentence,)


def _told_topic(image: Topic) -> str:
    """Where drivers publish the CameraInfo of an image."""
    return f'{image.name.removesuffix("/compressed").rpartition("/")[0]}/{_TOLD_TOPIC}'
