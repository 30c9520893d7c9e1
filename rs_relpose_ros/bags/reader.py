"""Read rosbag2 bags (SQLite3, MCAP, compressed) and ROS 1 bags.

A bag that is damaged, truncated or far too large raises an InputError with one line of text.
"""

import bz2
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager, ExitStack, suppress
from dataclasses import dataclass
import functools
import logging
import os
from pathlib import Path
from types import SimpleNamespace
from typing import Any, BinaryIO, NamedTuple

from lz4.frame import LZ4FrameDecompressor
from rosbags.convert.converter import LATCH
from rosbags.interfaces import Connection, ConnectionExtRosbag2, QosReliability
from rosbags.rosbag1 import Reader as Reader1
from rosbags.rosbag1 import reader as rosbag1
from rosbags.rosbag2 import Reader as Reader2
from rosbags.rosbag2 import reader as rosbag2
from rosbags.rosbag2 import storage_mcap as mcap
from rosbags.typesys import get_typestore, Stores
from rosbags.typesys.store import Typestore
import yaml

from rs_relpose_ros.errors import InputError, MissingInputError, RsRelposeError
from rs_relpose_ros.geometry.timing import NANOSECONDS

# Topics and frames of the bags that the project writes.
COMPRESSED_TOPIC = '/camera/image_raw/compressed'
RAW_TOPIC = '/camera/image_raw'
CAMERA_INFO_TOPIC = '/camera/camera_info'
IMU_TOPIC = '/imu/data_raw'
# Gyro and accelerometer of phones, which stamp them separately.
GYRO_TOPIC = '/imu/gyro'
ACCEL_TOPIC = '/imu/accel'
GROUND_TRUTH_TOPIC = '/ground_truth/pose'

CAMERA_FRAME = 'camera_optical_frame'
IMU_FRAME = 'imu_link'
WORLD_FRAME = 'world'

# Delay of a driver between the stamp (of an image: the end of its readout) and delivery [s].
IMAGE_DELAY = 0.005
IMU_DELAY = 0.002

IMAGE = 'sensor_msgs/msg/Image'
COMPRESSED_IMAGE = 'sensor_msgs/msg/CompressedImage'
CAMERA_INFO = 'sensor_msgs/msg/CameraInfo'
IMU = 'sensor_msgs/msg/Imu'
POSE_STAMPED = 'geometry_msgs/msg/PoseStamped'

_STORAGE_SUFFIXES = ('.mcap', '.db3')

_logger = logging.getLogger(__name__)

# -- Bounds: rosbags has none, and a few bytes can decompress to any size -------------------------

# Bytes of the largest chunk that is decompressed; recorders write chunks of megabytes.
MAX_CHUNK_BYTES = 1 << 30
# Bytes of the largest message that is decoded: above any accepted image (64 Mpx, 4 channels).
MAX_MESSAGE_BYTES = 1 << 29
# A compressed storage file is decompressed to a temporary one of at most this and so many times
# its size.
MAX_FILE_BYTES = 1 << 30
_MAX_FILE_GROWTH = 200
# Bytes of the largest metadata.yaml that is parsed; thousands of topics need less.
_MAX_METADATA_BYTES = 1 << 24

# The zstd module that rosbags uses: Python's own from 3.14 on, a package before.
_zstd: Any = vars(mcap)['zstd']


@contextmanager
def _bounded_file(file: BinaryIO, mode: str) -> Iterator[SimpleNamespace]:
    """Open a zstd file that can be read up to a bounded size; called by rosbags."""
    size = os.fstat(file.fileno()).st_size
    limit = MAX_FILE_BYTES + _MAX_FILE_GROWTH * size
    count = 0
    with _zstd.open(file, mode) as stream:

        def read(most: int) -> bytes:
            nonlocal count
            data: bytes = stream.read(most)
            count += len(data)
            if count > limit:
                raise InputError(f'{size} bytes decompress to more than {limit}')
            return data

        yield SimpleNamespace(read=read)


def _decompressed(decompressor: Callable[[], Any], data: bytes, limit: int) -> bytes:
    """Decompress one frame of at most `limit` bytes."""
    stream = decompressor()
    # One byte more: at exactly the limit the end of the frame may not be reached.
    out: bytes = stream.decompress(data, limit + 1)
    if len(out) > limit:
        raise InputError(f'{len(data)} bytes decompress to more than {limit}')
    if not stream.eof:
        raise InputError(f'{len(data)} compressed bytes are incomplete')
    return out


def _chunk(decompressor: Callable[[], Any]) -> Callable[..., bytes]:
    # MCAP gives the size of a chunk, ROS 1 does not.
    return lambda data, *size: _decompressed(decompressor, data, min([*size, MAX_CHUNK_BYTES]))


# Replaced for all bags that this process reads: rosbags has no setting. Without such an entry in
# the tables of its version nothing would be bounded.
_TABLES: Any = (
    (mcap.DECOMPRESSORS, 'zstd', _chunk(_zstd.ZstdDecompressor)),
    (mcap.DECOMPRESSORS, 'lz4', _chunk(LZ4FrameDecompressor)),
    (rosbag1.decompressors, 'lz4', _chunk(LZ4FrameDecompressor)),
    (rosbag1.decompressors, 'bz2', _chunk(bz2.BZ2Decompressor)),
    (
        vars(rosbag2),
        'zstd',
        SimpleNamespace(
            open=_bounded_file,
            decompress=lambda data: _decompressed(_zstd.ZstdDecompressor, data, MAX_MESSAGE_BYTES),
        ),
    ),
)
for _table, _name, _bounded in _TABLES:
    if _name not in _table:
        raise ImportError(f'rosbags decompresses {_name} in another way than 0.11 does')
    _table[_name] = _bounded


# -- Checks before a parser reads the files -------------------------------------------------------


def _check_path(path: Path) -> None:
    """Raise where there is no bag, or one without usable metadata."""
    if not path.exists():
        raise MissingInputError(f'there is no bag at {path}')
    if not path.is_dir():
        if path.suffix not in (*_STORAGE_SUFFIXES, '.bag'):
            raise InputError(
                f'{path} is no bag: give a rosbag2 directory (with metadata.yaml) or '
                'a .mcap, .db3 or .bag file'
            )
        return
    metadata = path / 'metadata.yaml'
    if not metadata.exists():
        for file in sorted(path.iterdir()):
            if file.suffix in _STORAGE_SUFFIXES:
                raise InputError(
                    f'{path} has no metadata.yaml, so its recorder was not stopped properly: give '
                    f'{file.name} itself, or make one with "ros2 bag reindex {path}"'
                )
        raise InputError(f'{path} is no bag: it has no metadata.yaml')
    if metadata.stat().st_size > _MAX_METADATA_BYTES:
        raise InputError(
            f'{metadata} is no metadata of a bag: it has more than {_MAX_METADATA_BYTES} bytes'
        )
    content = metadata.read_bytes()
    with suppress(yaml.YAMLError, RecursionError):  # no YAML: refused by the reader
        # Printed, aliases can be endless.
        if b'*' in content and any(
            isinstance(event, yaml.AliasEvent) for event in yaml.parse(content)
        ):
            raise InputError(
                f'{metadata} has YAML aliases, which no recorder writes: it is damaged'
            )


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
    names: Mapping[str, str]  # those chosen, by role
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
        """The chosen topic, or that of a name, or the only one of these types.

        `fix` if there is none, `hint` if there are several; the ground truth may be absent.
        """
        if chosen := self._chosen(role, *msgtypes):
            return chosen
        candidates = [topic for topic in self._of_type(*msgtypes) if topic != without]
        candidates = [topic for topic in candidates if topic.name == preferred] or candidates
        several = (
            f'{self.bag} has several {content} topics, choose one with {_option(role)}'
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
        name, option = self.names.get(role, ''), _option(role)
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
        if not (self.names.get('imu') or accel) and len(candidates) == 2:
            gyros, accels = (
                [topic for topic in candidates if word in topic.name] for word in ('gyro', 'accel')
            )
            if len(gyros) == 1 and len(accels) == 1 and gyros != accels:
                return gyros[0], accels[0]
        return self.one(
            'imu',
            'IMU',
            IMU,
            without=accel,
            hint=' (and --accel-topic for a separate accelerometer)',
        ), accel

    def _of_type(self, *msgtypes: str) -> list[Topic]:
        return [topic for topic in self.topics if topic.msgtype in msgtypes and topic.count]

    def _missing(self, content: str) -> MissingInputError:
        there = ', '.join(map(str, self.topics))
        return MissingInputError(
            f'{self.bag} has no {content}; '
            + (f'it has {there}' if there else 'it has no topics at all')
        )


def _option(role: str) -> str:
    return f'--{role.replace("_", "-")}-topic'


class BagMessage(NamedTuple):
    """A message with its topic and the time at which it was recorded [ns]."""

    topic: str
    bag_time_ns: int
    message: Any


class RawMessage(NamedTuple):
    """A message as CDR bytes, with its topic and the time at which it was recorded [ns]."""

    topic: str
    msgtype: str
    bag_time_ns: int
    data: bytes


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


class Bag:
    """An open bag; made by `open_bag`."""

    def __init__(self, path: Path, reader: Reader1 | Reader2) -> None:
        self.path = path
        self._reader = reader
        self._is_ros2 = isinstance(reader, Reader2)
        # Gets the topic of each message that is read, for a progress bar.
        self.on_message: Callable[[str], object] = lambda topic: None
        counts: dict[tuple[str, str], int] = {}
        self._by_topic: dict[tuple[str, str], Connection] = {}
        # Typed, but metadata is YAML: any value can be of any type.
        connections: Any = reader.connections
        for connection in connections:
            if not (
                isinstance(connection.topic, str)
                and connection.topic.isprintable()
                and isinstance(connection.msgtype, str)
                and connection.msgtype.isprintable()
                and isinstance(connection.msgcount, int)
            ):
                raise InputError(
                    f'{path} is damaged: in its metadata, name, type or number of '
                    'messages of a topic is invalid'
                )
            key = connection.topic, connection.msgtype
            self._by_topic.setdefault(key, connection)
            counts[key] = counts.get(key, 0) + connection.msgcount
        self.topics = tuple(
            Topic(name, msgtype, count) for (name, msgtype), count in sorted(counts.items())
        )
        # Time from the first to the last message [s].
        self.duration = float(reader.duration) / NANOSECONDS

    def reliability(self, topic: Topic) -> str:
        """``'reliable'`` or ``'best effort'`` as its publishers offered; empty if not recorded."""
        offered = {
            profile.reliability
            for connection in self._connections([topic])
            if isinstance(connection.ext, ConnectionExtRosbag2)
            for profile in connection.ext.offered_qos_profiles
        }
        if QosReliability.BEST_EFFORT in offered:
            return 'best effort'
        return 'reliable' if QosReliability.RELIABLE in offered else ''

    def origin(self, topic: Topic) -> dict[str, Any]:
        """Metadata for a copy of a topic, in ROS 2, as rosbags' `add_connection` takes them."""
        connection = self._connections([topic])[0]
        if not isinstance(connection.ext, ConnectionExtRosbag2):
            return {'msgdef': '', 'offered_qos_profiles': LATCH if connection.ext.latching else ()}
        return {
            'msgdef': connection.msgdef.data,
            'rihs01': connection.digest,
            'serialization_format': connection.ext.serialization_format,
            'offered_qos_profiles': connection.ext.offered_qos_profiles,
        }

    def can_be_copied(self, topic: Topic) -> bool:
        """Whether `raw_messages` can read it: of ROS 1 only types that ROS 2 has, too."""
        return self._is_ros2 or topic.msgtype in _types(of_ros2=True).fielddefs

    def find_topics(
        self, names: Mapping[str, str] | None = None, *, needs_camera_info: bool = True
    ) -> SensorTopics:
        """The sensors' topics: as chosen, or by type if that is unambiguous.

        `names`: those chosen, by field of `SensorTopics`; empty ones are as if absent. Of several
        CameraInfo topics, that next to the image is used, and of two Imu topics one with 'gyro'
        and one with 'accel' in its name make a pair (RealSense).
        """
        finder = _TopicFinder(self.path, self.topics, names or {})
        found = finder.find(needs_camera_info)
        assert found.image is not None and found.imu is not None
        truth = finder.one('truth', 'ground truth', POSE_STAMPED, preferred=GROUND_TRUTH_TOPIC)
        return SensorTopics(found.image, found.camera_info, found.imu, found.accel, truth)

    def choose_topics(self, names: Mapping[str, str]) -> Chosen:
        """The same, but None for those that are absent; a rectified image is chosen, too."""
        return _TopicFinder(self.path, self.topics, names, complete=False).find(False)

    def messages(self, topics: Sequence[Topic]) -> Iterator[BagMessage]:
        """Messages of `topics` in the order of bag time, with arrays that are read-only."""
        for raw in self.raw_messages(topics):
            yield BagMessage(raw.topic, raw.bag_time_ns, self.read(raw))

    def raw_messages(self, topics: Sequence[Topic]) -> Iterator[RawMessage]:
        """Messages of `topics` in the order of bag time, in CDR as publishers expect them."""
        # Of ROS 2, not of the bag: headers of ROS 1 have an additional number.
        typestore = _types(of_ros2=True)
        for connection, bag_time_ns, data in self._raw(topics):
            if not self._is_ros2:
                if connection.msgtype not in typestore.fielddefs:
                    raise InputError(
                        f'topic {connection.topic} of {self.path} is of type '
                        f'{connection.msgtype}, which ROS 2 does not have: leave it '
                        'out'
                    )
                data = bytes(self._decoded(connection, typestore.ros1_to_cdr, data))
            yield RawMessage(connection.topic, connection.msgtype, bag_time_ns, data)

    def read(self, raw: RawMessage) -> Any:
        """The ROS 2 message of an item of `raw_messages`; InputError if it cannot be decoded."""
        connection = self._by_topic[raw.topic, raw.msgtype]
        return self._decoded(connection, _types(of_ros2=True).deserialize_cdr, raw.data)

    def _connections(self, topics: Sequence[Topic]) -> list[Connection]:
        chosen = {(topic.name, topic.msgtype) for topic in topics}
        return [c for c in self._reader.connections if (c.topic, c.msgtype) in chosen]

    def _raw(self, topics: Sequence[Topic]) -> Iterator[tuple[Connection, int, bytes]]:
        connections = self._connections(topics)
        if not connections:
            return
        try:
            for connection, bag_time_ns, data in self._reader.messages(connections):
                if len(data) > MAX_MESSAGE_BYTES:
                    raise InputError(
                        f'a message of {connection.topic} has {len(data)} bytes; at '
                        f'most {MAX_MESSAGE_BYTES} are read'
                    )
                self.on_message(connection.topic)
                yield connection, bag_time_ns, data
        # A damaged file can raise anything in the parsers.
        except Exception as error:
            raise InputError(f'{self.path} is damaged: {_message(error)}') from error

    def _decoded(self, connection: Connection, decode: Callable[..., Any], data: bytes) -> Any:
        """Decode a message, unless its type had other fields in the ROS of the recorder."""
        if (
            connection.msgtype in _types(self._is_ros2).fielddefs
            and connection.digest
            and connection.digest != _type_hash(connection.msgtype, self._is_ros2)
        ):
            name = 'ROS 2 Jazzy' if self._is_ros2 else 'ROS 1 Noetic'
            raise InputError(
                f'topic {connection.topic} of {self.path} is of another '
                f'{connection.msgtype} than that of {name}: its type hash is '
                f'{str(connection.digest)[:80]!r}'
            )
        try:
            return decode(data, connection.msgtype)
        except Exception as error:
            raise InputError(
                f'a message of {connection.topic} in {self.path} is corrupt, it is no '
                f'{connection.msgtype}: {_message(error)}'
            ) from error


@contextmanager
def open_bag(path: Path | str) -> Iterator[Bag]:
    """Open a rosbag2 directory, or a single ``.mcap``, ``.db3`` or ROS 1 ``.bag`` file."""
    path = Path(path)
    with ExitStack() as stack:
        try:
            _check_path(path)
            reader = Reader1(path) if path.suffix == '.bag' and path.is_file() else Reader2(path)
            stack.enter_context(reader)
            bag = Bag(path, reader)
        except RsRelposeError:
            raise
        except PermissionError as error:
            raise InputError(f'{path} cannot be read: {error.strerror}') from error
        # A damaged file can raise anything in the parsers.
        except Exception as error:
            storage = next(path.glob('*.mcap'), path)
            fix = {
                '.bag': f'; try "rosbag reindex {path.name}"',
                '.mcap': '; if it is truncated, copy it again, or "mcap recover '
                f'{storage.name} -o recovered.mcap"',
            }.get(storage.suffix, '')
            kind = 'is truncated or damaged, or no bag' if path.is_file() else 'is damaged'
            raise InputError(f'{path} {kind}: {_message(error)}{fix}') from error
        yield bag


def _message(error: Exception) -> str:
    """Text of a parser's error in one line, without its full stop; else its type."""
    text = ' '.join(str(error).split()).rstrip('.')
    return text[:300] if text else type(error).__name__
