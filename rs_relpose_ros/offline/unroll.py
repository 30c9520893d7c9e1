"""A bag with its images derotated to their middle row, and all other messages unchanged."""

from collections import deque
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from functools import partial
from pathlib import Path

from rs_relpose_ros.bags import reader
from rs_relpose_ros.bags.reader import Bag, BagMessage, SensorTopics, Topic
from rs_relpose_ros.bags.writer import BagWriter
from rs_relpose_ros.config.settings import Parameters
from rs_relpose_ros.errors import RsRelposeError
from rs_relpose_ros.messages import outgoing
from rs_relpose_ros.messages.incoming import Intake, PARTS, ReasonCounts, Role, stamp_ns
from rs_relpose_ros.offline.replay import MessageRefused, outcomes, unused_reason
from rs_relpose_ros.output_files import beside
from rs_relpose_ros.pipeline.global_shutter import GlobalShutterFrame, unrolling_loop
from rs_relpose_ros.pipeline.pair import Frame


@dataclass(slots=True)
class UnrollReport:
    """Summary of a run."""

    images_in_bag: int = 0
    images: int = 0   # derotated and written
    largest_shift: float = 0.0   # [px] of any pixel
    copied: int = 0   # messages of other topics
    topics_copied: int = 0
    reasons: Mapping[str, int] = field(default_factory=dict)   # of omitted images
    warnings: list[str] = field(default_factory=list)


@dataclass(slots=True, eq=False)
class _Place:
    """A place in the new bag, in the order of receive times."""

    bag_time_ns: int
    # One of each message, none for an omitted image, None until they are known.
    writes: Sequence[Callable[[], None]] | None = None


def unroll(bag: Bag, topics: SensorTopics, parameters: Parameters, out: Path) -> UnrollReport:
    """Write the bag `out`, a directory that must not exist, and appears when it is complete.

    Nothing is written if no image can be derotated.
    """
    with beside(out) as part:
        with BagWriter(part) as writer:
            report = _Unrolling(bag, topics, parameters, writer).run()
        if report.images:
            part.rename(out)
    return report


class _Unrolling:
    """One run over a bag.

    Messages are written in the order of their receive times. Those after an image wait until the
    gyro covers it.
    """

    def __init__(self, bag: Bag, topics: SensorTopics, parameters: Parameters,
                 writer: BagWriter) -> None:
        self._bag, self._topics, self._writer = bag, topics, writer
        self._stamp_clock = parameters.global_shutter.stamp_clock
        self._loop = unrolling_loop(parameters, offline=True)
        self._intake = Intake(self._loop.sequencer, parameters)
        self._places: deque[_Place] = deque()
        # Undecided places of images by stamp.
        self._images: dict[int, deque[_Place]] = {}
        self._stamps: set[int] = set()
        # Of other image topics: whether the stamp is an image's.
        self._shared: dict[str, list[bool]] = {}
        self._reasons = ReasonCounts()
        self._report = UnrollReport()

    def run(self) -> UnrollReport:
        """Write the new bag."""
        copied = [topic for topic in self._bag.topics if self._bag.can_be_copied(topic)]
        for topic in copied:
            self._writer.announce(topic, self._bag.origin(topic))
        self._report.topics_copied = len({*copied} - {self._topics.image,
                                                      self._topics.camera_info})
        for outcome in outcomes(self._loop, self._intake, self._messages(copied)):
            if isinstance(outcome, MessageRefused) and not self._report.images:
                outcome.raise_without_intrinsics()
            result = outcome.result if isinstance(outcome, Frame) else None
            if not isinstance(outcome, Frame):
                self._reasons.add(unused_reason(outcome))
            if outcome.stamp_ns is not None:
                self._settle(outcome.stamp_ns, result)
        for place in self._places:
            place.writes = place.writes or ()
        self._flush()
        self._report.reasons = self._reasons.most_common()
        self._report.warnings += [f'{topic} is omitted: ROS 2 has no such message type'
                                  for topic in self._bag.topics if topic not in copied]
        shared = [topic for topic, found in self._shared.items() if 2 * sum(found) > len(found)]
        if shared and self._stamp_clock == 'imu':
            self._report.warnings.append(
                f'{", ".join(shared)} had the stamps of the derotated images and keep them, on '
                "the camera's clock: set stamp_clock=camera if they are used together (depth, "
                'stereo)')
        return self._report

    def _messages(self, topics: list[Topic]) -> Iterator[tuple[Role, BagMessage]]:
        """Messages of camera and IMU; all messages get their places."""
        roles = {(topic.name, topic.msgtype): role for role in (
            Role.IMAGE, Role.CAMERA_INFO, Role.IMU, Role.ACCEL)
            if (topic := getattr(self._topics, role.value)) is not None}
        for raw in self._bag.raw_messages(topics):
            self._flush()
            role = roles.get((raw.topic, raw.msgtype))
            if role is Role.CAMERA_INFO:   # a new one is written with each image
                message = self._bag.read(raw)
            elif role is Role.IMAGE:
                message = self._bag.read(raw)
                self._report.images_in_bag += 1
                try:
                    stamp: int = PARTS[role].read(message).stamp_ns
                except RsRelposeError as error:
                    self._reasons.add(str(error))
                    continue
                self._places.append(_Place(raw.bag_time_ns))
                self._stamps.add(stamp)
                self._images.setdefault(stamp, deque()).append(self._places[-1])
            else:
                self._report.copied += 1
                self._places.append(_Place(raw.bag_time_ns, (partial(self._writer.copy, raw),)))
                if role is None:
                    if raw.msgtype in (reader.IMAGE, reader.COMPRESSED_IMAGE):
                        # Whether an image of another topic has the stamp of an image.
                        self._shared.setdefault(raw.topic, []).append(
                            stamp_ns(self._bag.read(raw).header) in self._stamps)
                    continue
                message = self._bag.read(raw)
            yield role, BagMessage(raw.topic, raw.bag_time_ns, message)

    def _settle(self, stamp: int, result: GlobalShutterFrame | None) -> None:
        """Fill the place of an image, with its CameraInfo."""
        places = self._images.get(stamp)
        if not places:
            return
        place = places.popleft()
        if not places:
            del self._images[stamp]
        place.writes = ()
        if result is None:
            return
        topic, info, types = self._topics.image, self._topics.camera_info, self._writer.type
        header, pixels = (result.stamp_ns, result.frame_id), result.image()
        image = (outgoing.compressed_image_message(*header, pixels, png=result.is_png, types=types)
                 if topic.msgtype == reader.COMPRESSED_IMAGE
                 else outgoing.image_message(*header, pixels, types))
        camera_info = outgoing.camera_info_message(
            *header, result.intrinsics, self._intake.camera_info_of(result.intrinsics), types)
        name = topic.camera_info if info is None else info.name
        place.writes = tuple(partial(self._writer.write, *message, place.bag_time_ns)
                             for message in ((name, reader.CAMERA_INFO, camera_info),
                                             (topic.name, topic.msgtype, image)))
        self._report.images += 1
        self._report.largest_shift = max(self._report.largest_shift, result.map.shift)

    def _flush(self) -> None:
        while self._places and self._places[0].writes is not None:
            for write in self._places.popleft().writes or ():
                write()
