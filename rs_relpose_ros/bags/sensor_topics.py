"""Topics of bags: those that the project writes, and those of the sensors in any bag."""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
import logging
from pathlib import Path
from typing import Any, NamedTuple

from rs_relpose_ros.errors import InputError, MissingInputError

# The bags that the project writes have their images on this topic. [derived: interface]
COMPRESSED_TOPIC = '/camera/image_raw/compressed'
# They have them on this topic if images are raw. [derived: interface]
RAW_TOPIC = '/camera/image_raw'
# Topic of the CameraInfo. [derived: interface]
CAMERA_INFO_TOPIC = '/camera/camera_info'
# Topic of an IMU with one stamp for gyro and accelerometer. [derived: interface]
IMU_TOPIC = '/imu/data_raw'
# Gyro and accelerometer of phones, which stamp them separately. [derived: interface]
GYRO_TOPIC = '/imu/gyro'
# Topic of the accelerometer of phones. [derived: interface]
ACCEL_TOPIC = '/imu/accel'
# Topic of the true poses of the camera. [derived: interface]
GROUND_TRUTH_TOPIC = '/ground_truth/pose'

# Frame of the images. [derived: interface]
CAMERA_FRAME = 'camera_optical_frame'
# Frame of the IMU. [derived: interface]
IMU_FRAME = 'imu_link'
# Frame of the true poses. [derived: interface]
WORLD_FRAME = 'world'

# Delay [s] from the end of an image's readout to its receive time in a written bag. Without one,
# messages would be received before they are measured. [chosen: drivers need 1 to 20 ms]
IMAGE_DELAY = 0.005
# Delay [s] from the stamp of an IMU sample to its receive time in a written bag, for the same
# reason. [chosen: drivers need 1 to 5 ms]
IMU_DELAY = 0.002

# Type of a raw image. [derived: interface]
IMAGE = 'sensor_msgs/msg/Image'
# Type of a compressed image. [derived: interface]
COMPRESSED_IMAGE = 'sensor_msgs/msg/CompressedImage'
# Type of the intrinsics. [derived: interface]
CAMERA_INFO = 'sensor_msgs/msg/CameraInfo'
# Type of an IMU sample. [derived: interface]
IMU = 'sensor_msgs/msg/Imu'
# Type of a true pose. [derived: interface]
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

    @property
    def camera_info(self) -> str:
        """Name of the topic on which drivers publish the CameraInfo of an image topic."""
        return f'{self.name.removesuffix("/compressed").rpartition("/")[0]}/camera_info'


@dataclass(frozen=True, slots=True)
class SensorTopics:
    """Topics to read."""

    image: Topic
    camera_info: Topic | None  # None only if it is not needed
    imu: Topic
    accel: Topic | None  # only if the driver publishes it separately
    truth: Topic | None


class Chosen(NamedTuple):
    """The topics to read of a bag that may lack some: None if there is none of that kind."""

    image: Topic | None
    camera_info: Topic | None
    imu: Topic | None
    accel: Topic | None

    @property
    def sensors(self) -> SensorTopics | None:
        """The topics of camera and IMU; None if the images or the gyro are absent."""
        if self.image is None or self.imu is None:
            return None
        return SensorTopics(self.image, self.camera_info, self.imu, self.accel, None)


@dataclass(frozen=True, slots=True)
class TopicFinder:
    """Finds the sensors' topics among all topics of a bag."""

    bag: Path
    topics: Sequence[Topic]
    names: Mapping[str, str]  # of the topics that the user has chosen, by role
    first_message: Callable[[Topic], Any]  # None where it cannot be read
    complete: bool = True  # whether an absent topic is an error

    def find(self, needs_camera_info: bool) -> Chosen:
        """The topics of camera and IMU; InputError if one is missing or ambiguous."""
        image = self.one('image', 'image', IMAGE, COMPRESSED_IMAGE)
        if self.complete and image and 'image_rect' in image.name:
            raise InputError(
                f'{image.name} is a rectified image, in which a row no longer has '
                'one time: choose the raw one with --image-topic'
            )
        imu, accel = self._imu()
        camera_info = None
        if needs_camera_info or self.names.get('camera_info') or self._of_type(CAMERA_INFO):
            camera_info = self.one(
                'camera_info',
                'CameraInfo',
                CAMERA_INFO,
                preferred=image.camera_info if image else '',
                fix='; give camera_matrix, which "rs_relpose calibrate" estimates from a '
                'recording in which the camera rotates about all three axes',
            )
        return Chosen(image, camera_info, imu, accel)

    def one(
        self,
        role: str,
        content: str,
        *msgtypes: str,
        fix: str = '',
        hint: str = '',
        preferred: str = '',
        without: Topic | None = None,
    ) -> Topic | None:
        """The topic that the user has chosen, or the `preferred` one, or the only one of a type.

        An error has the text `fix` if there is none, and `hint` if there are several. The ground
        truth may be absent.
        """
        if chosen := self._chosen(role, *msgtypes):
            return chosen
        candidates = [topic for topic in self._of_type(*msgtypes) if topic != without]
        candidates = [topic for topic in candidates if topic.name == preferred] or candidates
        several = (
            f'{self.bag} has several {content} topics, choose one with {option_of(role)}'
            f'{hint}: {", ".join(map(str, candidates))}'
        )
        if role == 'truth' or not (candidates or self.complete):
            if len(candidates) > 1:
                _logger.warning('%s; none is used', several)
            return candidates[0] if len(candidates) == 1 else None
        if not candidates:
            raise self._missing(f'{content} topic ({" or ".join(msgtypes)}){fix}')
        if len(candidates) > 1:
            raise InputError(several)
        return candidates[0]

    def _chosen(self, role: str, *msgtypes: str) -> Topic | None:
        name = self.names.get(role, '')
        option = option_of(role)
        if not name:
            return None
        found = [topic for topic in self.topics if topic.name.lstrip('/') == name.lstrip('/')]
        if not found:
            raise self._missing(f'topic {name} ({option})')
        if found[0].msgtype not in msgtypes:
            raise InputError(
                f'topic {name} ({option}) is of type {found[0].msgtype}, but must be '
                f'{" or ".join(msgtypes)}'
            )
        if not found[0].count:
            raise MissingInputError(f'topic {name} ({option}) of {self.bag} has no messages')
        return found[0]

    def _imu(self) -> tuple[Topic | None, Topic | None]:
        """Topics of the gyro, and of a separate accelerometer."""
        accel = self._chosen('accel', IMU)
        candidates = self._of_type(IMU)
        if not (self.names.get('imu') or accel) and len(candidates) > 1:
            pair = self._pair_by_name(candidates) or self._pair_by_content(candidates)
            if pair is not None:
                return pair
        return self.one(
            'imu',
            'IMU',
            IMU,
            without=accel,
            hint=' (and --accel-topic for a separate accelerometer)',
        ), accel

    @staticmethod
    def _pair_by_name(candidates: Sequence[Topic]) -> tuple[Topic, Topic] | None:
        """The topics of gyro and accelerometer by the words in their names."""
        gyros, accels = (
            [topic for topic in candidates if word in topic.name] for word in ('gyro', 'accel')
        )
        is_pair = len(candidates) == 2 and len(gyros) == len(accels) == 1 and gyros != accels
        return (gyros[0], accels[0]) if is_pair else None

    def _pair_by_content(self, candidates: Sequence[Topic]) -> tuple[Topic, Topic] | None:
        """The only topic with a gyro alone and the only one with an accelerometer alone.

        By REP-145 a covariance whose first element is -1 means that the sensor does not exist.
        """
        gyros: list[Topic] = []
        accels: list[Topic] = []
        for topic in candidates:
            message = self.first_message(topic)
            if message is None:
                return None
            has_gyro = message.angular_velocity_covariance[0] != -1.0
            has_accel = message.linear_acceleration_covariance[0] != -1.0
            if has_gyro == has_accel:
                return None
            (gyros if has_gyro else accels).append(topic)
        return (gyros[0], accels[0]) if len(gyros) == len(accels) == 1 else None

    def _of_type(self, *msgtypes: str) -> list[Topic]:
        return [topic for topic in self.topics if topic.msgtype in msgtypes and topic.count]

    def _missing(self, content: str) -> MissingInputError:
        there = ', '.join(map(str, self.topics))
        return MissingInputError(
            f'{self.bag} has no {content}; '
            + (f'it has {there}' if there else 'it has no topics at all')
        )


def option_of(role: str) -> str:
    """Option of the command line that chooses the topic of a role."""
    return f'--{role.replace("_", "-")}-topic'
