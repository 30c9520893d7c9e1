"""Read ROS 1 bags, version 2.0: http://wiki.ros.org/Bags/Format/2.0."""

from collections import Counter
from collections.abc import Iterator
from contextlib import ExitStack
import os
from pathlib import Path
import struct

from rosbags.interfaces import (
    Qos,
    QosDurability,
    QosHistory,
    QosLiveliness,
    QosReliability,
    QosTime,
)

from rs_relpose_ros.bags.storage import (
    BEGIN_BYTES,
    chunk_data,
    DamagedError,
    KeptChunks,
    MessageEntry,
    read_exactly,
    StoredTopic,
    UnfinishedError,
)
from rs_relpose_ros.geometry.timing import NANOSECONDS

# First bytes of a file. [derived: the format of ROS 1 bags, version 2.0]
_MAGIC = b'#ROSBAG V2.0\n'
# A message lies in a chunk. [derived: the format]
_MESSAGE = 2
# A chunk holds compressed records. [derived: the format]
_CHUNK = 5
# An entry of the index says where a chunk lies. [derived: the format]
_CHUNK_INFO = 6
# A connection is a topic of one publisher. [derived: the format]
_CONNECTION = 7
# Numbers, and lengths of what follows. [derived: the format]
_LENGTH = struct.Struct('<I')
# Place of a record in the file. [derived: the format]
_PLACE = struct.Struct('<Q')
# Time as seconds and nanoseconds. [derived: the format]
_TIME = struct.Struct('<II')
# Connection and the number of its messages in a chunk. [derived: the format]
_COUNT = struct.Struct('<II')
# Bytes of the largest header of a record that is read. [chosen: the header of a connection holds a
# topic's name, the others less than 100 bytes]
_MAX_HEADER = 1 << 16
# Duration without an end in profiles of QoS. [derived: rosbag2]
_FOREVER = QosTime(2147483647, 4294967295)
# QoS in ROS 2 of a topic whose publisher has latched its last message. [derived: `rosbags-convert`
# writes the same]
LATCHED = Qos(
    QosHistory.UNKNOWN,
    0,
    QosReliability.RELIABLE,
    QosDurability.TRANSIENT_LOCAL,
    _FOREVER,
    _FOREVER,
    QosLiveliness.AUTOMATIC,
    _FOREVER,
    avoid_ros_namespace_conventions=False,
)


class Ros1Storage:
    """An open ROS 1 bag; see `Storage`."""

    def __init__(self, path: Path, stack: ExitStack) -> None:
        self._file = stack.enter_context(path.open('rb', buffering=0))
        self._chunks = KeptChunks(self._load_chunk)
        self._places: list[int] = []
        self._counts: Counter[int] = Counter()
        self.topics: list[StoredTopic] = []

        if self._read(0, len(_MAGIC)) != _MAGIC:
            raise DamagedError('only version 2.0 of ROS 1 bags can be read')
        fields, _, _ = self._record(len(_MAGIC))
        (index,) = _PLACE.unpack(fields['index_pos'])
        size = os.fstat(self._file.fileno()).st_size
        # rosbag renames a file when it closes it.
        if index == 0 or (index >= size and path.suffix == '.active'):
            raise UnfinishedError(
                f'its recorder has not closed it: "rosbag reindex {path.name}" in ROS 1 does'
            )
        self._read_index(index, size)
        (connections,) = _LENGTH.unpack(fields['conn_count'])
        (chunks,) = _LENGTH.unpack(fields['chunk_count'])
        if connections != len(self.topics) or chunks != len(self._places):
            raise DamagedError('its index is not complete')

    def entries(self) -> Iterator[MessageEntry]:
        """All messages in the order of the file."""
        known = {topic.id for topic in self.topics}
        for place in self._places:
            chunk = self._chunks[place]
            start = 0
            while start < len(chunk):
                fields, data, start = _record_of(chunk, start)
                if fields['op'][0] != _MESSAGE:
                    continue
                (connection,) = _LENGTH.unpack(fields['conn'])
                if connection not in known:
                    raise DamagedError(f'a message belongs to the unknown connection {connection}')
                content = memoryview(chunk)[data : min(start, data + BEGIN_BYTES)]
                yield MessageEntry(connection, _nanoseconds(fields['time']), place, data, content)

    def data(self, place: int, offset: int) -> bytes:
        """Bytes of the message of an entry."""
        chunk = self._chunks[place]
        (size,) = _LENGTH.unpack_from(chunk, offset - _LENGTH.size)
        return bytes(chunk[offset : offset + size])

    def _read(self, start: int, size: int) -> bytes:
        return read_exactly(self._file, start, size)

    def _record(self, start: int) -> tuple[dict[str, bytes], int, int]:
        """Fields of the header of a record in the file, start of its data, and their size."""
        (length,) = _LENGTH.unpack(self._read(start, _LENGTH.size))
        if length > _MAX_HEADER:
            raise DamagedError('a header has no end')
        start += _LENGTH.size
        header = self._read(start, length + _LENGTH.size)
        (size,) = _LENGTH.unpack_from(header, length)
        return _fields(header[:length]), start + len(header), size

    def _read_index(self, start: int, end: int) -> None:
        """Read the connections and the places of the chunks, which stand at the end."""
        connections: dict[int, dict[str, bytes]] = {}
        while start < end:
            fields, data, size = self._record(start)
            start = data + size
            kind = fields['op'][0]
            if kind == _CONNECTION:
                (number,) = _LENGTH.unpack(fields['conn'])
                connections[number] = _fields(self._read(data, size))
                # Header and data both name the topic. The header has it as it was recorded.
                connections[number]['topic'] = fields['topic']
            elif kind == _CHUNK_INFO:
                self._places += _PLACE.unpack(fields['chunk_pos'])
                counts = self._read(data, size)
                for connection, count in _COUNT.iter_unpack(counts):
                    self._counts[connection] += count
        self._places.sort()
        self.topics = [self._topic(*connection) for connection in connections.items()]

    def _topic(self, number: int, connection: dict[str, bytes]) -> StoredTopic:
        package, _, name = connection['type'].decode().rpartition('/')
        return StoredTopic(
            number,
            _normalised(connection['topic'].decode()),
            f'{package}/msg/{name}',
            self._counts[number],
            'ros1',
            connection['md5sum'].decode(),
            connection['message_definition'].decode(errors='replace'),
            (LATCHED,) if connection.get('latching') == b'1' else (),
        )

    def _load_chunk(self, start: int) -> bytes | memoryview:
        fields, data, size = self._record(start)
        if fields['op'][0] != _CHUNK:
            raise DamagedError('its index names a chunk where there is none')
        (whole,) = _LENGTH.unpack(fields['size'])
        return chunk_data(self._read(data, size), fields['compression'].decode(), whole)


def _record_of(chunk: bytes | memoryview, start: int) -> tuple[dict[str, bytes], int, int]:
    """Fields of the header of a record in a chunk, and start and end of its data."""
    (length,) = _LENGTH.unpack_from(chunk, start)
    header = start + _LENGTH.size
    end_of_header = header + length
    (size,) = _LENGTH.unpack_from(chunk, end_of_header)
    data = end_of_header + _LENGTH.size
    end = data + size
    if end > len(chunk):
        raise DamagedError('a record ends beyond its chunk')
    return _fields(bytes(chunk[header:end_of_header])), data, end


def _fields(header: bytes) -> dict[str, bytes]:
    """Names and values of a header."""
    fields = {}
    start = 0
    while start < len(header):
        (length,) = _LENGTH.unpack_from(header, start)
        start += _LENGTH.size
        name, separator, value = header[start : start + length].partition(b'=')
        if not separator or start + length > len(header):
            raise DamagedError('a header is not one of ROS 1')
        fields[name.decode()] = value
        start += length
    return fields


def _nanoseconds(time: bytes) -> int:
    seconds, nanoseconds = _TIME.unpack(time)
    return seconds * NANOSECONDS + nanoseconds


def _normalised(name: str) -> str:
    """Name of a topic without doubled or closing slashes."""
    return '/' * name.startswith('/') + '/'.join(part for part in name.split('/') if part)
