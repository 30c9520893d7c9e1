"""Read rosbag2 bags (SQLite3, MCAP, compressed) and ROS 1 bags.

A bag that is damaged, truncated or far too large raises an InputError with one line of text.
"""

from array import array
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager, ExitStack, suppress
from dataclasses import dataclass
import functools
import logging
from pathlib import Path
import struct
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray
from rosbags.interfaces import QosReliability
from rosbags.typesys import get_typestore, Stores
from rosbags.typesys.store import Typestore

from rs_relpose_ros.bags import storage
from rs_relpose_ros.bags.files import naming_damage, open_files
from rs_relpose_ros.bags.order import reading_times
from rs_relpose_ros.bags.storage import Entry, message_data, StoredTopic
from rs_relpose_ros.errors import InputError, MissingInputError
from rs_relpose_ros.geometry.timing import NANOSECONDS, to_nanoseconds

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


@dataclass(frozen=True, slots=True)
class _TopicFinder:
    """Finds the sensors' topics among all topics of a bag."""

    bag: Path
    topics: Sequence[Topic]
    names: Mapping[str, str]  # of the topics that the user has chosen, by role
    first_message: Callable[[Topic], Any]  # None where it cannot be read
    complete: bool = True  # whether an absent topic is an error

    def find(self, needs_camera_info: bool) -> Chosen:
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
                fix='; give camera_matrix, whose focal length "rs_relpose calibrate" estimates',
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


class BagMessage(NamedTuple):
    """A message with its topic and two times [ns]: of its recording, and of its reading.

    Messages are read in the order of the latter.
    """

    topic: str
    bag_time_ns: int
    message: Any
    read_ns: int = 0


class RawMessage(NamedTuple):
    """A message as CDR bytes, with its topic and the times of a `BagMessage` [ns]."""

    topic: str
    msgtype: str
    bag_time_ns: int
    data: bytes
    read_ns: int = 0


@functools.cache
def _types(of_ros2: bool) -> Typestore:
    """Message types of one ROS, by their names alone.

    Definitions in a bag are not used: an expression in IDL can take any time and memory to parse,
    an array of empty messages any memory to read.
    """
    return get_typestore(Stores.ROS2_JAZZY if of_ros2 else Stores.ROS1_NOETIC)


@functools.cache
def _type_hash(msgtype: str, of_ros2: bool) -> str:
    """Hash of the fields of a known type as recorders write it."""
    store = _types(of_ros2)
    return store.hash_rihs01(msgtype) if of_ros2 else store.generate_msgdef(msgtype)[1]


class Timeline(NamedTuple):
    """Times of the messages of a topic in the order of the file [ns]."""

    stamps: NDArray[np.int64]
    received: NDArray[np.int64]


class _Index(NamedTuple):
    """Places of messages in the files of a bag, in their order; arrays of int64 (N,)."""

    topic: NDArray[np.int64]  # number of its name and type in the bag
    file: NDArray[np.int64]
    place: NDArray[np.int64]
    offset: NDArray[np.int64]
    received: NDArray[np.int64]  # [ns]
    stamp: NDArray[np.int64]  # of the header; for types without a header, the time of reception


class Bag:
    """An open bag; made by `open_bag`."""

    def __init__(self, path: Path, stack: ExitStack) -> None:
        self.path = path
        self._files, self._storages, metadata = open_files(path, stack)
        # Gets the topic of each message that is read, for a progress bar.
        self.on_message: Callable[[str], object] = lambda topic: None
        # The clock of the IMU less that of the camera [s], for the order of reading by stamps.
        self.time_offset = 0.0
        # A topic may have messages in several files.
        self._stored: dict[tuple[str, str], StoredTopic] = {}
        for opened in self._storages:
            for topic in opened.topics:
                key = topic.name, topic.msgtype
                if not ''.join(key).isprintable():
                    raise InputError(f'{path} is damaged: a topic has no printable name or type')
                digest = topic.digest or metadata.digests.get(key, '')
                found = topic._replace(digest=digest, messages=0)
                whole = self._stored.setdefault(key, found)
                count = whole.messages + topic.messages
                self._stored[key] = whole._replace(messages=count)
        self._numbers = {key: number for number, key in enumerate(self._stored)}
        stored = [one for _, one in sorted(self._stored.items())]
        self.topics = tuple(Topic(one.name, one.msgtype, one.messages) for one in stored)
        # Time from the first to the last message [s].
        self.duration = 0.0
        filled = [s for s in self._storages if any(topic.messages for topic in s.topics)]
        if filled:
            first_ns = min(opened.start_ns for opened in filled)
            last_ns = max(opened.end_ns for opened in filled)
            self.duration = (last_ns + 1 - first_ns) / NANOSECONDS

    def reliability(self, topic: Topic) -> str:
        """``'reliable'`` or ``'best effort'`` as its publishers offered; empty if not recorded."""
        stored = self._stored[topic.name, topic.msgtype]
        if stored.encoding != 'cdr':
            return ''
        offered = {profile.reliability for profile in stored.qos}
        if QosReliability.BEST_EFFORT in offered:
            return 'best effort'
        return 'reliable' if QosReliability.RELIABLE in offered else ''

    def origin(self, topic: Topic) -> dict[str, Any]:
        """Metadata for a copy of a topic, in ROS 2, as rosbags' `add_connection` takes them."""
        stored = self._stored[topic.name, topic.msgtype]
        if stored.encoding != 'cdr':
            return {'msgdef': '', 'offered_qos_profiles': stored.qos}
        return {
            'msgdef': stored.definition,
            'rihs01': stored.digest,
            'serialization_format': stored.encoding,
            'offered_qos_profiles': stored.qos,
        }

    def can_be_copied(self, topic: Topic) -> bool:
        """Whether `raw_messages` can read it: of ROS 1 only types that ROS 2 has, too."""
        stored = self._stored[topic.name, topic.msgtype]
        return stored.encoding == 'cdr' or topic.msgtype in _types(of_ros2=True).fielddefs

    def find_topics(
        self, names: Mapping[str, str] | None = None, *, needs_camera_info: bool = True
    ) -> SensorTopics:
        """The sensors' topics: as chosen, or by type if that is unambiguous.

        `names` are the topics that the user has chosen, by field of `SensorTopics`; an empty name
        means that the user has not chosen. Of several CameraInfo topics, the one next to the image
        is used. Of two Imu topics, one with 'gyro' and one with 'accel' in its name make a pair
        (RealSense).
        """
        finder = _TopicFinder(self.path, self.topics, names or {}, self._first_message)
        found = finder.find(needs_camera_info)
        assert found.image is not None and found.imu is not None
        truth = finder.one('truth', 'ground truth', POSE_STAMPED, preferred=GROUND_TRUTH_TOPIC)
        return SensorTopics(found.image, found.camera_info, found.imu, found.accel, truth)

    def choose_topics(self, names: Mapping[str, str]) -> Chosen:
        """The sensors' topics, None where one is absent; a rectified image is chosen, too."""
        finder = _TopicFinder(self.path, self.topics, names, self._first_message, complete=False)
        return finder.find(False)

    def _first_message(self, topic: Topic) -> Any:
        """The first message of a topic; None if it cannot be read."""
        with suppress(InputError):
            return next((one.message for one in self.messages([topic])), None)
        return None

    def messages(self, topics: Sequence[Topic], *, by_stamp: bool = False) -> Iterator[BagMessage]:
        """Messages of `topics` in the order of `raw_messages`, with arrays that are read-only."""
        for raw in self.raw_messages(topics, by_stamp=by_stamp):
            yield BagMessage(raw.topic, raw.bag_time_ns, self.read(raw), raw.read_ns)

    def raw_messages(
        self, topics: Sequence[Topic], *, by_stamp: bool = False
    ) -> Iterator[RawMessage]:
        """Messages of `topics` in CDR as publishers of ROS 2 expect them.

        They come in the order in which they were received, or `by_stamp` in the order of
        `reading_times`, the first CameraInfo before all others.
        """
        index = self._index(topics)
        times = self._by_stamp(index) if by_stamp else index.received
        stored = list(self._stored.values())
        # Equal times are read in the order of the topics' names, whatever the file has first.
        names = [topic.name for topic in stored]
        rank = np.argsort(np.argsort(names))
        for row in np.lexsort((rank[index.topic], times)):
            topic = stored[index.topic[row]]
            file = int(index.file[row])
            data = self._data(file, int(index.place[row]), int(index.offset[row]))
            cdr = self._as_cdr(topic, data)
            self.on_message(topic.name)
            received_ns = int(index.received[row])
            read_ns = int(times[row])
            yield RawMessage(topic.name, topic.msgtype, received_ns, cdr, read_ns)

    def timeline(self, topic: Topic) -> Timeline:
        """Stamps and times of reception of a topic."""
        index = self._index([topic])
        return Timeline(index.stamp, index.received)

    def read(self, raw: RawMessage) -> Any:
        """The ROS 2 message of an item of `raw_messages`; InputError if it cannot be decoded."""
        stored = self._stored[raw.topic, raw.msgtype]
        return self._decoded(stored, _types(of_ros2=True).deserialize_cdr, raw.data)

    # -- places and order --------------------------------------------------------------------

    def _index(self, topics: Sequence[Topic]) -> _Index:
        """Places of the messages of `topics`."""
        numbers = [self._numbers[topic.name, topic.msgtype] for topic in topics]
        whole = self._whole_index
        chosen = np.isin(whole.topic, numbers)
        return _Index(*(column[chosen] for column in whole))

    @functools.cached_property
    def _whole_index(self) -> _Index:
        """Places of all messages, which the first reading collects."""
        columns = [array('q') for _ in _Index._fields]
        for number, opened in enumerate(self._storages):
            topics = {topic.id: topic for topic in opened.topics}
            has_header = {topic.id: _begins_with_header(topic) for topic in opened.topics}
            for entry in self._entries(number):
                topic = topics[entry.topic_id]
                stamp = entry.time_ns
                if has_header[topic.id]:
                    stamp = _stamp_of(entry.data, topic.encoding)
                key = self._numbers[topic.name, topic.msgtype]
                row = key, number, entry.place, entry.offset, entry.time_ns, stamp
                for column, value in zip(columns, row, strict=True):
                    column.append(value)
        return _Index(*(np.frombuffer(column, np.int64) for column in columns))

    def _by_stamp(self, index: _Index) -> NDArray[np.int64]:
        """Times of reading [ns], with a CameraInfo at the beginning where there is one."""
        numbers = self._numbers.items()
        sensors = [number for (_, msgtype), number in numbers if msgtype in _MEASURED]
        of_info = [number for (_, msgtype), number in numbers if msgtype == CAMERA_INFO]
        of_camera = [n for (_, msgtype), n in numbers if msgtype in (*_IMAGES, CAMERA_INFO)]
        stamps = index.stamp
        if abs(self.time_offset) > _LEAST_OFFSET:
            shift_ns = to_nanoseconds(self.time_offset)
            stamps = stamps + shift_ns * np.isin(index.topic, of_camera)
        times = reading_times(stamps, index.topic, sensors)
        infos = np.flatnonzero(np.isin(index.topic, of_info))
        if len(infos):
            # It serves the images before it, too: drivers publish it late, or once.
            earliest = infos[np.argmin(times[infos])]
            times[earliest] = times.min() - 1
        return times

    # -- data --------------------------------------------------------------------------------

    def _entries(self, number: int) -> Iterator[Entry]:
        """Entries of a file by its number."""
        with naming_damage(self.path, self._files[number]):
            yield from self._storages[number].entries()

    def _data(self, number: int, place: int, offset: int) -> bytes:
        """Bytes of a message in the file of a number."""
        with naming_damage(self.path, self._files[number]):
            return message_data(self._storages[number].data(place, offset))

    def _as_cdr(self, topic: StoredTopic, data: bytes) -> bytes:
        """The data of a message in CDR of ROS 2: headers of ROS 1 have an additional number."""
        if len(data) > storage.MAX_MESSAGE_BYTES:
            raise InputError(
                f'a message of {topic.name} has {len(data)} bytes; at most '
                f'{storage.MAX_MESSAGE_BYTES} are read'
            )
        if topic.encoding == 'cdr':
            return data
        known = _types(of_ros2=True)
        if topic.encoding != 'ros1':
            raise InputError(
                f'topic {topic.name} of {self.path} is encoded as {topic.encoding[:20]!r}: only '
                'messages of ROS can be read'
            )
        if topic.msgtype not in known.fielddefs:
            raise InputError(
                f'topic {topic.name} of {self.path} is of type {topic.msgtype}, which ROS 2 does '
                'not have: leave it out'
            )
        return bytes(self._decoded(topic, known.ros1_to_cdr, data))

    def _decoded(self, topic: StoredTopic, decode: Callable[..., Any], data: bytes) -> Any:
        """Decode a message, unless its type had other fields in the ROS of the recorder."""
        of_ros2 = topic.encoding == 'cdr'
        known = topic.digest and topic.msgtype in _types(of_ros2).fielddefs
        if known and topic.digest != _type_hash(topic.msgtype, of_ros2):
            name = 'ROS 2 Jazzy' if of_ros2 else 'ROS 1 Noetic'
            raise InputError(
                f'topic {topic.name} of {self.path} is of another {topic.msgtype} than that '
                f'of {name}: its type hash is {topic.digest[:80]!r}'
            )
        try:
            return decode(data, topic.msgtype)
        except Exception as error:
            _logger.debug('raised here', exc_info=True)
            raise InputError(
                f'a message of {topic.name} in {self.path} is corrupt, it is no {topic.msgtype}'
            ) from error


# Types of the sensors whose clocks decide the order of reading. [derived: `reading_times`]
_IMAGES = (IMAGE, COMPRESSED_IMAGE)
_MEASURED = (*_IMAGES, IMU)  # images and IMU; CameraInfo has no clock of its own
# Smallest offset of the clocks [s] that changes the order of reading: within less the history of
# the IMU has the samples of an image anyhow. [chosen: below its 5 s, above delays of drivers]
_LEAST_OFFSET = 1.0
# Bytes before the stamp of a message with a header: they name the encoding, or hold a number in
# ROS 1. [derived: CDR, and std_msgs/Header of ROS 1]
_BEFORE_STAMP = 4
# A stamp has seconds and nanoseconds. [derived: builtin_interfaces/Time]
_STAMP = struct.Struct('<iI')
# A stamp in the other byte order, which the second byte of CDR names. [derived: CDR]
_BIG_STAMP = struct.Struct('>iI')


def _begins_with_header(topic: StoredTopic) -> bool:
    known = _types(topic.encoding == 'cdr').fielddefs
    fields = known[topic.msgtype][1] if topic.msgtype in known else []
    return bool(fields) and 'std_msgs/msg/Header' in str(fields[0])


def _stamp_of(data: bytes | memoryview, encoding: str) -> int:
    """Stamp [ns] of the header that a message begins with; 0 where it is too short for one."""
    if data[:4] == storage.ZSTD_MAGIC:
        data = storage.first_bytes(data, _BEFORE_STAMP + _STAMP.size)
    if len(data) < _BEFORE_STAMP + _STAMP.size:
        return 0
    is_big_endian = encoding == 'cdr' and not data[1] & 1
    layout = _BIG_STAMP if is_big_endian else _STAMP
    seconds, nanoseconds = layout.unpack_from(data, _BEFORE_STAMP)
    return int(seconds) * NANOSECONDS + int(nanoseconds)


@contextmanager
def open_bag(path: Path | str) -> Iterator[Bag]:
    """Open a rosbag2 directory, or a single ``.mcap``, ``.db3`` or ROS 1 ``.bag`` file."""
    path = Path(path)
    with ExitStack() as stack:
        try:
            bag = Bag(path, stack)
        except PermissionError as error:
            raise InputError(f'{path} cannot be read: {error.strerror}') from error
        yield bag
