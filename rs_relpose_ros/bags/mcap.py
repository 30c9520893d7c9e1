"""Read MCAP files, with or without an index of chunks and messages.

Records and their fields: https://mcap.dev/spec. All numbers are little-endian.
"""

from collections import Counter
from collections.abc import Iterator
import os
from pathlib import Path
import struct
from typing import NamedTuple
import zlib

from rs_relpose_ros.bags.storage import (
    chunk_data,
    DamagedError,
    Entry,
    KeptChunks,
    qos_profiles,
    read_exactly,
    Source,
    StoredTopic,
)

# Kinds of records. [derived: the MCAP specification, as the layouts below]
_SCHEMA = 0x03
_CHANNEL = 0x04  # a topic
_MESSAGE = 0x05
_CHUNK = 0x06
_STATISTICS = 0x0B
_DATA_END = 0x0F
_HEAD = struct.Struct('<BQ')  # of a record: kind and size
_MESSAGE_HEAD = struct.Struct('<HIQQ')  # channel, sequence, times of log and of publication
_CHUNK_HEAD = struct.Struct('<QQQII')  # times, size, checksum, length of the compression's name
_STATISTICS_HEAD = struct.Struct('<QHIIIIQQ')  # counts; first and last time
_FOOTER = struct.Struct('<BQQQI8s')  # head, start of the summary, checksum, magic
_LENGTH = struct.Struct('<I')  # of a text
_SIZE = struct.Struct('<Q')  # of data
# Bytes of the longest name of a compression that is read with the head of a chunk.
_MAX_NAME = 64


class _Channel(NamedTuple):
    schema: int
    topic: str
    encoding: str
    metadata: dict[str, str]


class McapStorage:
    """An open MCAP file; see `Storage`."""

    def __init__(self, path: Path) -> None:
        self._file = path.open('rb', buffering=0)
        self._chunks = KeptChunks(self._load_chunk)
        self._schemas: dict[int, tuple[str, bytes]] = {}
        self._channels: dict[int, _Channel] = {}
        self._counts: Counter[int] = Counter()
        self.start_ns = self.end_ns = 0
        try:
            summary = self._find_end()
            if not (summary and self._read_summary(summary)):
                self._count_messages()
        except BaseException:
            self.close()
            raise
        self.topics = [self._topic(number) for number in self._channels]

    def close(self) -> None:
        """Close the file."""
        self._file.close()

    def entries(self) -> Iterator[Entry]:
        """All messages in the order of the file."""
        for kind, start, size in self._records(len(Source.MCAP.value), self._end):
            if kind == _CHUNK:
                yield from self._entries_of_chunk(start)
            elif kind == _MESSAGE:
                yield self._entry(self._read(start, size), start, -1)
            elif kind in (_SCHEMA, _CHANNEL):
                self._describe(kind, self._read(start, size))

    def _entries_of_chunk(self, place: int) -> Iterator[Entry]:
        chunk = memoryview(self._chunks[place])
        for kind, start, size in _records_of(chunk):
            record = chunk[start : start + size]
            if kind == _MESSAGE:
                yield self._entry(record, place, start)
            elif kind in (_SCHEMA, _CHANNEL):
                self._describe(kind, bytes(record))

    def data(self, place: int, offset: int) -> bytes:
        """Bytes of the message of an entry."""
        if offset < 0:
            _, size = _HEAD.unpack(self._read(place - _HEAD.size, _HEAD.size))
            return self._read(place, size)[_MESSAGE_HEAD.size :]
        chunk = self._chunks[place]
        _, size = _HEAD.unpack_from(chunk, offset - _HEAD.size)
        return chunk[offset + _MESSAGE_HEAD.size : offset + size]

    def _entry(self, record: bytes | memoryview, place: int, offset: int) -> Entry:
        channel, _, time_ns, _ = _MESSAGE_HEAD.unpack_from(record)
        if channel not in self._channels:
            raise DamagedError(f'a message belongs to channel {channel}, which is not described')
        return Entry(channel, time_ns, place, offset, record[_MESSAGE_HEAD.size :])

    def _read(self, start: int, size: int) -> bytes:
        return read_exactly(self._file, start, size)

    def _find_end(self) -> int:
        """Set the end of the data; start of the summary, 0 if there is none."""
        file_size = os.fstat(self._file.fileno()).st_size
        footer = max(file_size - _FOOTER.size, len(Source.MCAP.value))
        kind, size, summary, _, _, magic = _FOOTER.unpack(self._read(footer, _FOOTER.size))
        if (kind, size, magic) != (0x02, 20, Source.MCAP.value) or summary > footer:
            raise DamagedError('it has no end')
        self._footer, self._end = footer, summary or footer
        return int(summary)

    def _read_summary(self, summary: int) -> bool:
        """Read topics and counts from the summary; whether it has all."""
        found = False
        for kind, start, size in self._records(summary, self._footer):
            if kind in (_SCHEMA, _CHANNEL, _STATISTICS):
                self._describe(kind, self._read(start, size))
                found |= kind == _STATISTICS
        return found and bool(self._channels or not self._counts)

    def _count_messages(self) -> None:
        """Read topics and counts from the data."""
        self._counts.clear()
        first = last = None
        for entry in self.entries():
            self._counts[entry.topic_id] += 1
            first = entry.time_ns if first is None else min(first, entry.time_ns)
            last = entry.time_ns if last is None else max(last, entry.time_ns)
        self.start_ns, self.end_ns = first or 0, last or 0

    def _describe(self, kind: int, record: bytes) -> None:
        """Keep a schema, a channel or the statistics."""
        fields = _Fields(record)
        if kind == _STATISTICS:
            *_, self.start_ns, self.end_ns = _STATISTICS_HEAD.unpack_from(record)
            fields.position = _STATISTICS_HEAD.size
            counts = fields.bytes()
            self._counts = Counter(dict(struct.iter_unpack('<HQ', counts)))
            return
        number = fields.number()
        if kind == _SCHEMA:
            name, _ = fields.text(), fields.text()
            self._schemas[number] = name, fields.bytes()
            return
        schema, topic, encoding = fields.number(), fields.text(), fields.text()
        self._channels[number] = _Channel(schema, topic, encoding, _Fields(fields.bytes()).pairs())

    def _topic(self, number: int) -> StoredTopic:
        channel = self._channels[number]
        name, definition = self._schemas.get(channel.schema, ('', b''))
        package, _, short = name.rpartition('/')
        if package and '/' not in package:  # ROS 1
            name = f'{package}/msg/{short}'
        metadata = channel.metadata
        return StoredTopic(
            number,
            channel.topic,
            name,
            self._counts[number],
            channel.encoding,
            metadata.get('topic_type_hash') or metadata.get('md5sum', ''),
            definition.decode(errors='replace'),
            qos_profiles(metadata.get('offered_qos_profiles', '')),
        )

    def _records(self, start: int, end: int) -> Iterator[tuple[int, int, int]]:
        """Kind, start and size of the records between two places of the file."""
        while start < end:
            kind, size = _HEAD.unpack(self._read(start, _HEAD.size))
            start += _HEAD.size
            if size > end - start:
                raise DamagedError('a record ends beyond the data')
            yield kind, start, size
            if kind == _DATA_END:
                return
            start += size

    def _load_chunk(self, start: int) -> bytes:
        head = os.pread(self._file.fileno(), _CHUNK_HEAD.size + _MAX_NAME + _SIZE.size, start)
        _, _, size, checksum, length = _CHUNK_HEAD.unpack_from(head)
        if length > _MAX_NAME:
            raise DamagedError('a chunk has an unknown compression')
        name = head[_CHUNK_HEAD.size : _CHUNK_HEAD.size + length].decode()
        (stored,) = _SIZE.unpack_from(head, _CHUNK_HEAD.size + length)
        begin = start + _CHUNK_HEAD.size + length + _SIZE.size
        chunk = chunk_data(self._read(begin, stored), name, size)
        if checksum and zlib.crc32(chunk) != checksum:
            raise DamagedError('the checksum of a chunk is wrong')
        return chunk


def _records_of(chunk: memoryview) -> Iterator[tuple[int, int, int]]:
    """Kind, start and size of the records in a chunk."""
    start = 0
    while start < len(chunk):
        kind, size = _HEAD.unpack_from(chunk, start)
        start += _HEAD.size
        if size > len(chunk) - start:
            raise DamagedError('a record ends beyond its chunk')
        yield kind, start, size
        start += size


class _Fields:
    """Reads the fields of a record one after the other."""

    def __init__(self, record: bytes) -> None:
        self._record = record
        self.position = 0

    def number(self) -> int:
        """The next two bytes."""
        self.position += 2
        return int.from_bytes(self._record[self.position - 2 : self.position], 'little')

    def bytes(self) -> bytes:
        """The next field with its length before it."""
        (length,) = _LENGTH.unpack_from(self._record, self.position)
        start = self.position + _LENGTH.size
        self.position = start + length
        if self.position > len(self._record):
            raise DamagedError('a field ends beyond its record')
        return self._record[start : self.position]

    def text(self) -> str:
        """The next text."""
        return self.bytes().decode()

    def pairs(self) -> dict[str, str]:
        """Names and values until the end."""
        found = {}
        while self.position < len(self._record):
            name = self.text()
            found[name] = self.text()
        return found
