"""A bag with its images derotated to their middle row, and all other messages unchanged."""

from collections import deque
from collections.abc import Iterator
from pathlib import Path

from rs_relpose_ros.bags import sensor_topics
from rs_relpose_ros.bags.reader import Bag, BagMessage
from rs_relpose_ros.bags.sensor_topics import SensorTopics, Topic
from rs_relpose_ros.bags.writer import BagWriter
from rs_relpose_ros.config.settings import Parameters
from rs_relpose_ros.errors import RsRelposeError
from rs_relpose_ros.messages import outgoing
from rs_relpose_ros.messages.incoming import (
    Intake,
    PARTS,
    ReasonCounts,
    Role,
    SENSOR_ROLES,
    stamp_ns,
)
from rs_relpose_ros.offline.replay import MessageRefused, outcomes, unused_reason
from rs_relpose_ros.output_files import beside
from rs_relpose_ros.pipeline.global_shutter import GlobalShutterFrame, unrolling_loop
from rs_relpose_ros.pipeline.pair import Frame


class Unrolling:
    """One run over a bag, and its summary.

    Messages are written as soon as they are known, an image after its gyro: readers sort by the
    receive times, which are indexed.
    """

    def __init__(
        self, bag: Bag, topics: SensorTopics, parameters: Parameters, writer: BagWriter
    ) -> None:
        self.images_in_bag = self.images = 0  # those that were derotated and written
        self.largest_shift = 0.0  # [px] of any pixel
        self.copied = self.topics_copied = 0  # messages of other topics
        self.reasons = ReasonCounts()  # of omitted images
        self.warnings: list[str] = []
        self._bag = bag
        self._topics = topics
        self._writer = writer
        self._loop = unrolling_loop(parameters, offline=True)
        self._intake = Intake(self._loop.sequencer, parameters)
        # Stamps of all images, with the receive times of the images that are not derotated yet.
        self._times: dict[int | None, deque[int]] = {}
        # For each other image topic, whether its messages have stamps of derotated images.
        self._shared: dict[str, list[bool]] = {}

    def write(self, stamp_clock: str) -> None:
        """Write the new bag."""
        copied = [topic for topic in self._bag.topics if self._bag.can_be_copied(topic)]
        for topic in copied:
            self._writer.announce(topic, self._bag.origin(topic))
        derotated = {self._topics.image, self._topics.camera_info}
        self.topics_copied = len({*copied} - derotated)
        for outcome in outcomes(self._loop, self._intake, self._messages(copied)):
            times = self._times.get(outcome.stamp_ns)
            bag_time_ns = times.popleft() if times else None
            if isinstance(outcome, Frame):
                if outcome.result is not None and bag_time_ns is not None:
                    self._write(outcome.result, bag_time_ns)
                continue
            if isinstance(outcome, MessageRefused) and not self.images:
                outcome.raise_without_intrinsics()
            self.reasons.add(unused_reason(outcome))
        omitted = [topic for topic in self._bag.topics if topic not in copied]
        for topic in omitted:
            self.warnings.append(f'{topic} is omitted: ROS 2 has no such message type')
        shared = [topic for topic, found in self._shared.items() if 2 * sum(found) > len(found)]
        if shared and stamp_clock == 'imu':
            self.warnings.append(
                f'{", ".join(shared)} had the stamps of the derotated images and keep them, on '
                "the camera's clock: set stamp_clock=camera if they are used together (depth, "
                'stereo)'
            )

    def _messages(self, topics: list[Topic]) -> Iterator[tuple[Role, BagMessage]]:
        """Messages of camera and IMU; all but images and CameraInfo are copied."""
        roles = {
            (topic.name, topic.msgtype): role
            for role in SENSOR_ROLES
            if (topic := getattr(self._topics, role.value)) is not None
        }
        for raw in self._bag.raw_messages(topics, by_stamp=True):
            role = roles.get((raw.topic, raw.msgtype))
            if role not in (Role.IMAGE, Role.CAMERA_INFO):
                self.copied += 1
                self._writer.copy(raw)
            if role is None:
                if raw.msgtype in (sensor_topics.IMAGE, sensor_topics.COMPRESSED_IMAGE):
                    stamp = stamp_ns(self._bag.read(raw).header)
                    self._shared.setdefault(raw.topic, []).append(stamp in self._times)
                continue
            message = self._bag.read(raw)
            if role is Role.IMAGE:
                self.images_in_bag += 1
                try:
                    stamp = PARTS[role].read(message).stamp_ns
                except RsRelposeError as error:
                    self.reasons.add(str(error))
                    continue
                self._times.setdefault(stamp, deque()).append(raw.bag_time_ns)
            yield role, BagMessage(raw.topic, raw.bag_time_ns, message)

    def _write(self, result: GlobalShutterFrame, bag_time_ns: int) -> None:
        """Write an image with its CameraInfo."""
        topic = self._topics.image
        types = self._writer.type
        origin = result.stamp_ns, result.frame_id
        pixels = result.image()
        if topic.msgtype == sensor_topics.COMPRESSED_IMAGE:
            png = result.is_png
            image = outgoing.compressed_image_message(*origin, pixels, png=png, types=types)
        else:
            image = outgoing.image_message(*origin, pixels, types)
        published = self._intake.camera_info_of(result.intrinsics)
        info = outgoing.camera_info_message(*origin, result.intrinsics, published, types)
        info_topic = self._topics.camera_info
        name = topic.camera_info if info_topic is None else info_topic.name
        self._writer.write(name, sensor_topics.CAMERA_INFO, info, bag_time_ns)
        self._writer.write(topic.name, topic.msgtype, image, bag_time_ns)
        self.images += 1
        self.largest_shift = max(self.largest_shift, result.map.shift)


def unroll(bag: Bag, topics: SensorTopics, parameters: Parameters, out: Path) -> Unrolling:
    """Write the bag `out`, a directory that must not exist, and appears when it is complete.

    Nothing is written if no image can be derotated.
    """
    with beside(out) as part:
        with BagWriter(part) as writer:
            run = Unrolling(bag, topics, parameters, writer)
            run.write(parameters.global_shutter.stamp_clock)
        if run.images:
            part.rename(out)
    return run
