"""Read rosbag2 bags (SQLite3, MCAP, compressed) and ROS 1 bags."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from contextlib import contextmanager, ExitStack
import functools
from pathlib import Path
from typing import Any, NamedTuple

from rosbags.convert.converter import LATCH
from rosbags.interfaces import Connection, ConnectionExtRosbag2, Qos, QosReliability
from rosbags.rosbag1 import Reader as Reader1
from rosbags.rosbag2 import Reader as Reader2
from rosbags.typesys import get_typestore, Stores
from rosbags.typesys.store import Typestore

from rs_relpose_ros.bags.limits import bound_decompression, check_metadata, MAX_MESSAGE_BYTES
from rs_relpose_ros.bags.mcap_check import check_mcap
from rs_relpose_ros.bags.topics import SensorTopics, Topic, TopicFinder, TopicOptions
from rs_relpose_ros.errors import InputError, MissingInputError, RsRelposeError
from rs_relpose_ros.geometry.timing import NANOSECONDS

_STORAGE_SUFFIXES = ('.mcap', '.db3')

bound_decompression()


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


class TopicOrigin(NamedTuple):
    """What a bag tells of a topic besides its name and type; empty where it tells nothing."""

    definition: str   # of the message type
    type_hash: str
    serialization: str
    qos: tuple[Qos, ...]   # as its publishers offered


@functools.cache
def _types(of_ros2: bool) -> Typestore:
    """Message types of one ROS, by their names alone.

    rosbags would parse the definitions in a bag, also of topics that nobody asks for, and make
    code of them: an expression in IDL takes any time and memory to parse, an array of empty
    messages to read.
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
        self._types = _types(self._is_ros2)
        counts: dict[tuple[str, str], int] = {}
        # Typed, but metadata is YAML, in which anything may stand anywhere.
        connections: Any = reader.connections
        for connection in connections:
            if not (isinstance(connection.topic, str) and connection.topic.isprintable()
                    and isinstance(connection.msgtype, str) and connection.msgtype.isprintable()
                    and isinstance(connection.msgcount, int)):
                raise InputError(f'{path} is damaged: its metadata has a topic whose name, type '
                                 'or number of messages is none')
            key = connection.topic, connection.msgtype
            counts[key] = counts.get(key, 0) + connection.msgcount
        self.topics = tuple(Topic(name, msgtype, count)
                            for (name, msgtype), count in sorted(counts.items()))
        # Time from the first to the last message [s].
        self.duration = float(reader.duration) / NANOSECONDS

    def reliability(self, topic: Topic) -> str:
        """``'reliable'`` or ``'best effort'`` as its publishers offered; empty where not told."""
        offered = {
            profile.reliability for connection in self._reader.connections
            if (connection.topic, connection.msgtype) == (topic.name, topic.msgtype)
            and isinstance(connection.ext, ConnectionExtRosbag2)
            for profile in connection.ext.offered_qos_profiles}
        if QosReliability.BEST_EFFORT in offered:
            return 'best effort'
        return 'reliable' if QosReliability.RELIABLE in offered else ''

    def origin(self, topic: Topic) -> TopicOrigin:
        """What is to be written along where a topic of this bag is copied, as of ROS 2."""
        connection = next(c for c in self._reader.connections
                          if (c.topic, c.msgtype) == (topic.name, topic.msgtype))
        if not isinstance(connection.ext, ConnectionExtRosbag2):
            return TopicOrigin('', '', 'cdr', tuple(LATCH) if connection.ext.latching else ())
        return TopicOrigin(connection.msgdef.data, connection.digest,
                           connection.ext.serialization_format,
                           tuple(connection.ext.offered_qos_profiles))

    def can_be_copied(self, topic: Topic) -> bool:
        """Whether `raw_messages` can read it: from ROS 1 what ROS 2 has, too."""
        return self._is_ros2 or topic.msgtype in _types(of_ros2=True).fielddefs

    def find_topics(self, options: TopicOptions | None = None, *,
                    needs_camera_info: bool = True) -> SensorTopics:
        """The sensors' topics; see `TopicFinder.find`."""
        finder = TopicFinder(self.path, self.topics)
        return finder.find(options or TopicOptions(), needs_camera_info)

    def messages(self, topics: Sequence[Topic]) -> Iterator[BagMessage]:
        """Messages of `topics` in the order of bag time; their arrays are read-only.

        A damaged bag or a message that cannot be decoded raises InputError.
        """
        read = self._types.deserialize_cdr if self._is_ros2 else self._types.deserialize_ros1
        for connection, bag_time_ns, data in self._raw(topics):
            self._check_type(connection)
            with self._decoding(connection):
                message = read(data, connection.msgtype)
            yield BagMessage(connection.topic, bag_time_ns, message)

    def raw_messages(self, topics: Sequence[Topic]) -> Iterator[RawMessage]:
        """Messages of `topics` in the order of bag time, in CDR as publishers take them.

        A damaged bag or a ROS 1 message without a counterpart in ROS 2 raises InputError.
        """
        # Of ROS 2, not of the bag: headers of ROS 1 have a number more.
        typestore = _types(of_ros2=True)
        for connection, bag_time_ns, data in self._raw(topics):
            if not self._is_ros2:
                if connection.msgtype not in typestore.fielddefs:
                    raise InputError(f'topic {connection.topic} of {self.path} is of type '
                                     f'{connection.msgtype}, which ROS 2 does not have: leave it '
                                     'out')
                with self._decoding(connection):
                    data = bytes(typestore.ros1_to_cdr(data, connection.msgtype))
            yield RawMessage(connection.topic, connection.msgtype, bag_time_ns, data)

    def read(self, raw: RawMessage) -> Any:
        """The message of ROS 2 that `raw_messages` gave; InputError where it is none."""
        connection = next(c for c in self._reader.connections
                          if (c.topic, c.msgtype) == (raw.topic, raw.msgtype))
        self._check_type(connection)
        with self._decoding(connection):
            return _types(of_ros2=True).deserialize_cdr(raw.data, raw.msgtype)

    def _raw(self, topics: Sequence[Topic]) -> Iterator[tuple[Connection, int, bytes]]:
        chosen = {(topic.name, topic.msgtype) for topic in topics}
        connections = [c for c in self._reader.connections if (c.topic, c.msgtype) in chosen]
        if not connections:
            return
        messages = self._reader.messages(connections)
        while True:
            try:
                connection, bag_time_ns, data = next(messages)
            except StopIteration:
                return
            # A damaged file makes the parsers below fail in any way.
            except Exception as error:
                raise InputError(f'{self.path} is damaged: {_sentence(error)}') from error
            if len(data) > MAX_MESSAGE_BYTES:
                raise InputError(f'a message of {connection.topic} in {self.path} has {len(data)} '
                                 f'bytes; at most {MAX_MESSAGE_BYTES} are read')
            yield connection, bag_time_ns, data

    def _check_type(self, connection: Connection) -> None:
        """A type of the same name may have had other fields where the bag was recorded."""
        if (connection.msgtype in self._types.fielddefs and connection.digest
                and connection.digest != _type_hash(connection.msgtype, self._is_ros2)):
            name = 'ROS 2 Jazzy' if self._is_ros2 else 'ROS 1 Noetic'
            raise InputError(f'topic {connection.topic} of {self.path} is of another '
                             f'{connection.msgtype} than that of {name}: its type hash is '
                             f'{str(connection.digest)[:80]!r}')

    @contextmanager
    def _decoding(self, connection: Connection) -> Iterator[None]:
        try:
            yield
        except Exception as error:
            raise InputError(
                f'a message of {connection.topic} in {self.path} is corrupt, it is no '
                f'{connection.msgtype}: {_sentence(error)}') from error


@contextmanager
def open_bag(path: Path | str) -> Iterator[Bag]:
    """Open a rosbag2 directory, or a single ``.mcap``, ``.db3`` or ROS 1 ``.bag`` file.

    MissingInputError where there is nothing at `path`; InputError where it is no bag, or truncated
    or damaged: one sentence says which.
    """
    path = Path(path)
    _check_path(path)
    with ExitStack() as stack:
        try:
            reader = Reader1(path) if path.suffix == '.bag' and path.is_file() else Reader2(path)
            reader.open()
            stack.callback(reader.close)
            bag = Bag(path, reader)
        except PermissionError as error:
            raise InputError(f'{path} cannot be read: {error.strerror}') from error
        # A damaged file makes the parsers fail in any way.
        except Exception as error:
            raise InputError(_why_not_opened(path, error)) from error
        yield bag


def _check_path(path: Path) -> None:
    """What can be told before a parser sees the bag."""
    if not path.exists():
        raise MissingInputError(f'there is no bag at {path}')
    if path.is_dir():
        files = sorted(file for file in path.iterdir() if file.suffix in _STORAGE_SUFFIXES)
        if not (path / 'metadata.yaml').exists():
            if files:
                raise InputError(
                    f'{path} has no metadata.yaml, so its recorder was not stopped properly: give '
                    f'{files[0].name} itself, or make one with "ros2 bag reindex {path}"')
            raise InputError(f'{path} is no bag: it has no metadata.yaml')
        check_metadata(path / 'metadata.yaml')
    elif path.suffix in (*_STORAGE_SUFFIXES, '.bag'):
        files = [path]
    else:
        raise InputError(f'{path} is no bag: give a rosbag2 directory (with metadata.yaml) or a '
                         '.mcap, .db3 or .bag file')
    for file in files:
        if file.stat().st_size == 0:
            raise InputError(f'{file} is empty')
        if file.suffix == '.mcap':
            check_mcap(file)


def _why_not_opened(path: Path, error: Exception) -> str:
    if isinstance(error, RsRelposeError):
        return str(error)
    text = _sentence(error)
    if path.suffix == '.bag':
        with path.open('rb') as file:
            head = file.read(9)
        if head != b'#ROSBAG V':
            return f'{path} is no ROS 1 bag'
        return (f'{path} is truncated or damaged ({text}): copy it again, or repair it with '
                f'"rosbag reindex {path.name}"')
    kind = 'is truncated or damaged, or no bag' if path.is_file() else 'is damaged'
    return f'{path} {kind}: {text}'


def _sentence(error: Exception) -> str:
    """What a parser says, in one line, without its full stop; its type where it says nothing."""
    text = ' '.join(str(error).split()).rstrip('.')
    return text[:300] if text else type(error).__name__
