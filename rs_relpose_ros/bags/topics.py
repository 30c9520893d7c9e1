"""Topics of a bag: which of them are the sensors'."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
import logging
from pathlib import Path

from rs_relpose_ros.bags.layout import GROUND_TRUTH_TOPIC
from rs_relpose_ros.errors import InputError, MissingInputError

IMAGE = 'sensor_msgs/msg/Image'
COMPRESSED_IMAGE = 'sensor_msgs/msg/CompressedImage'
CAMERA_INFO = 'sensor_msgs/msg/CameraInfo'
IMU = 'sensor_msgs/msg/Imu'
POSE_STAMPED = 'geometry_msgs/msg/PoseStamped'

_logger = logging.getLogger(__name__)


@dataclass(frozen=True, slots=True)
class Topic:
    """A topic of a bag with the number of its messages."""

    name: str
    msgtype: str
    count: int

    def __str__(self) -> str:
        return f'{self.name} ({self.msgtype})'


@dataclass(frozen=True, slots=True)
class TopicOptions:
    """Topics that the user chose; an empty name is found by its type."""

    image: str = ''
    camera_info: str = ''
    imu: str = ''
    accel: str = ''
    truth: str = ''


@dataclass(frozen=True, slots=True)
class SensorTopics:
    """Topics to read; `accel` only where the driver publishes the accelerometer apart.

    `camera_info` is None only where it is not needed.
    """

    image: Topic
    camera_info: Topic | None
    imu: Topic
    accel: Topic | None
    truth: Topic | None


@dataclass(frozen=True, slots=True)
class TopicFinder:
    """Finds the sensors' topics among all `topics` that a `bag` has, which errors name."""

    bag: Path
    topics: Sequence[Topic]

    def find(self, options: TopicOptions, needs_camera_info: bool = True) -> SensorTopics:
        """The sensors' topics: as chosen, or by type where only one can be meant.

        Of several CameraInfo topics the one beside the image is taken, and of two Imu topics one
        with 'gyro' and one with 'accel' in its name make a pair (RealSense). MissingInputError
        where one is absent; InputError where several could be meant, or the chosen one has another
        type or is rectified.
        """
        image = self._one(options.image, (IMAGE, COMPRESSED_IMAGE), 'image', '--image-topic')
        if 'image_rect' in image.name:
            raise InputError(f'{image.name} is a rectified image, in which a row no longer has '
                             'one instant: choose the raw one with --image-topic')
        imu, accel = self._imu(options)
        camera_info = None
        if needs_camera_info or options.camera_info or self._of_type(CAMERA_INFO):
            camera_info = self._camera_info(options.camera_info, image)
        return SensorTopics(image, camera_info, imu, accel, self._truth(options.truth))

    def _one(self, chosen: str, msgtypes: tuple[str, ...], what: str, option: str) -> Topic:
        if chosen:
            return self._chosen(chosen, msgtypes, option)
        candidates = self._of_type(*msgtypes)
        if not candidates:
            raise MissingInputError(f'{self.bag} has no {what} topic ({" or ".join(msgtypes)}); '
                                    f'{self._listed()}')
        if len(candidates) > 1:
            raise InputError(f'{self.bag} has several {what} topics, choose one with {option}: '
                             f'{", ".join(map(str, candidates))}')
        return candidates[0]

    def _chosen(self, name: str, msgtypes: tuple[str, ...], option: str) -> Topic:
        found = [topic for topic in self.topics if topic.name.lstrip('/') == name.lstrip('/')]
        if not found:
            raise MissingInputError(f'{self.bag} has no topic {name} ({option}); '
                                    f'{self._listed()}')
        if found[0].msgtype not in msgtypes:
            raise InputError(f'topic {name} ({option}) is of type {found[0].msgtype}, but must be '
                             f'{" or ".join(msgtypes)}')
        if not found[0].count:
            raise MissingInputError(f'topic {name} ({option}) of {self.bag} has no messages')
        return found[0]

    def _camera_info(self, chosen: str, image: Topic) -> Topic:
        folder = image.name.removesuffix('/compressed').rpartition('/')[0]
        beside = [topic for topic in self._of_type(CAMERA_INFO)
                  if topic.name == f'{folder}/camera_info']
        if beside and not chosen:
            return beside[0]
        if not chosen and not self._of_type(CAMERA_INFO):
            raise MissingInputError(
                f'{self.bag} has no CameraInfo topic ({CAMERA_INFO}); give camera_matrix, whose '
                f'focal length "rs_relpose calibrate" finds; {self._listed()}')
        return self._one(chosen, (CAMERA_INFO,), 'CameraInfo', '--camera-info-topic')

    def _imu(self, options: TopicOptions) -> tuple[Topic, Topic | None]:
        """Topics of the gyro, and of the accelerometer where it is apart."""
        accel = self._chosen(options.accel, (IMU,), '--accel-topic') if options.accel else None
        if options.imu:
            return self._chosen(options.imu, (IMU,), '--imu-topic'), accel
        candidates = [topic for topic in self._of_type(IMU) if topic != accel]
        if len(candidates) == 2 and accel is None:
            gyros = [topic for topic in candidates if 'gyro' in topic.name]
            accels = [topic for topic in candidates if 'accel' in topic.name]
            if len(gyros) == 1 and len(accels) == 1 and gyros != accels:
                return gyros[0], accels[0]
        if len(candidates) > 1:
            raise InputError(
                f'{self.bag} has several IMU topics, choose one with --imu-topic (and '
                '--accel-topic where the accelerometer is apart): '
                f'{", ".join(map(str, candidates))}')
        if not candidates:
            raise MissingInputError(f'{self.bag} has no IMU topic ({IMU}); {self._listed()}')
        return candidates[0], accel

    def _truth(self, chosen: str) -> Topic | None:
        if chosen:
            return self._chosen(chosen, (POSE_STAMPED,), '--truth-topic')
        candidates = self._of_type(POSE_STAMPED)
        named = [topic for topic in candidates if topic.name == GROUND_TRUTH_TOPIC]
        if not named and len(candidates) > 1:
            _logger.warning('several topics could be the ground truth and none is used; choose '
                            'one with --truth-topic: %s', ', '.join(map(str, candidates)))
            return None
        return next(iter(named or candidates), None)

    def _of_type(self, *msgtypes: str) -> list[Topic]:
        return [topic for topic in self.topics if topic.msgtype in msgtypes and topic.count]

    def _listed(self) -> str:
        there = ', '.join(map(str, self.topics))
        return f'it has {there}' if there else 'it has no topics at all'
