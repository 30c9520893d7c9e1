"""Read MCAP files, with or without an index of chunks and messages.

Records and their fields: https://mcap.dev/spec. All numbers are little-endian.
"""

from collections import Counter
from collections.abc import Callable, Iterable, Iterator
from contextlib import ExitStack, suppress
import functools
import os
from pathlib import Path
import struct
from typing import BinaryIO, NamedTuple
import zlib

from rs_relpose_ros.bags.storage import (
    BEGIN_BYTES,
    chunk_data,
    DamagedError,
    KeptChunks,
    MAX_CHUNK_BYTES,
    MessageEntry,
    qos_profiles,
    read_exactly,
    Source,
    StoredTopic,
    ZSTD_MAGIC,
)

# The first record names profile and library. Kinds and layouts of records are those of the
# specification above. [derived: MCAP]
_HEADER = 0x01
# A footer ends the file. [derived: MCAP]
_FOOTER = 0x02
# A schema names and defines a type. [derived: MCAP]
_SCHEMA = 0x03
# A channel is a topic. [derived: MCAP]
_CHANNEL = 0x04
# A message may lie in a chunk or outside of all chunks. [derived: MCAP]
_MESSAGE = 0x05
# A chunk holds compressed records. [derived: MCAP]
_CHUNK = 0x06
# Statistics count the messages of each channel. [derived: MCAP]
_STATISTICS = 0x0B
# This record ends the data. [derived: MCAP]
_DATA_END = 0x0F
# A record begins with its kind and its size. [derived: MCAP]
_HEAD = struct.Struct('<BQ')
# A message begins with its channel, its number, and the times of log and of publication. [derived:
# MCAP]
_MESSAGE_HEAD = struct.Struct('<HIQQ')
# A chunk begins with two times, size, checksum, and length of the compression's name. [derived:
# MCAP]
_CHUNK_HEAD = struct.Struct('<QQQII')
# Bytes that statistics begin with: six counts, and the first and the last time. [derived: MCAP]
_STATISTICS_HEAD_BYTES = struct.calcsize('<QHIIIIQQ')
# Statistics go on with pairs of a channel and the number of its messages. [derived: MCAP]
_COUNT = struct.Struct('<HQ')
# The end of a file has a head, starts of summary and offsets, checksum, and magic. [derived: MCAP]
_END = struct.Struct('<BQQQI8s')
# Bytes of the footer between its head and the magic: two places and a checksum. [derived: MCAP]
_FOOTER_BYTES = struct.calcsize('<QQI')
# A text begins with its length. [derived: MCAP]
_LENGTH = struct.Struct('<I')
# The data of a chunk begin with their size. [derived: MCAP]
_SIZE = struct.Struct('<Q')
# Name of no compression; an empty name means the same. [derived: MCAP]
_PLAIN = b'none'
# Bytes of the record of a message that an index needs: its head, and what its stamp is in.
# [derived: `BEGIN_BYTES`]
_MOST_OF_BEGIN = _MESSAGE_HEAD.size + BEGIN_BYTES
# Bytes that are read at once where only the begins of messages are needed. Less takes more calls
# for small messages, more reads the pixels of images, too. [chosen: 4 to 64 kB would do]
_BLOCK_BYTES = 1 << 14
# Bytes of the longest name of a compression that is read with the head of a chunk. A shorter one
# would refuse a name, a longer one reads more for nothing. [chosen: known names have four letters]
_MAX_NAME = 64


class _Channel(NamedTuple):
    schema: int
    topic: str
    encoding: str
    metadata: dict[str, str]


class McapStorage:
    """An open MCAP file; see `Storage`."""

    def __init__(self, path: Path, stack: ExitStack) -> None:
        self._file = stack.enter_context(path.open('rb', buffering=0))
        self._chunks = KeptChunks(self._load_chunk)
        self._compared: set[int] = set()  # chunks whose checksums were right
        self._schemas: dict[int, tuple[str, bytes]] = {}
        self._channels: dict[int, _Channel] = {}
        self._counts: Counter[int] = Counter()
        footer, summary = self._find_end()
        self._end = summary or footer
        if not (summary and self._read_summary(summary, footer)):
            # Topics and counts are in the data alone.
            self._counts = Counter(entry.topic_id for entry in self.entries())
        self.topics = [self._topic(number) for number in self._channels]

    def entries(self) -> Iterator[MessageEntry]:
        """All messages in the order of the file."""
        for kind, start, size in self._records(len(Source.MCAP.value), self._end):
            if kind == _CHUNK:
                yield from self._entries_of(start, size)
            elif kind == _MESSAGE:
                begin = self._read(start, min(size, _MOST_OF_BEGIN))
                whole = functools.partial(self._read, start, size)
                yield self._entry(begin, whole, start, -1)
            elif kind in (_SCHEMA, _CHANNEL):
                self._describe(kind, self._read(start, size))

    def data(self, place: int, offset: int) -> bytes:
        """Bytes of the message of an entry."""
        if offset < 0:
            _, size = _HEAD.unpack(self._read(place - _HEAD.size, _HEAD.size))
            return self._read(place, size)[_MESSAGE_HEAD.size :]
        chunk = self._chunks[place]
        _, size = _HEAD.unpack_from(chunk, offset - _HEAD.size)
        return bytes(chunk[offset + _MESSAGE_HEAD.size : offset + size])

    def _entries_of(self, place: int, size: int) -> Iterator[MessageEntry]:
        """The entries of a chunk in the file."""
        plain = self._plain_records(place, size)
        window = _Window(self._file, *plain) if plain else _Window.of(self._chunks[place])
        for kind, offset, length in window.records():
            if kind == _MESSAGE:
                begin = window.bytes(offset, min(length, _MOST_OF_BEGIN))
                whole = functools.partial(window.bytes, offset, length)
                yield self._entry(begin, whole, place, offset)
            elif kind in (_SCHEMA, _CHANNEL):
                record = window.bytes(offset, length)
                self._describe(kind, bytes(record))

    def _plain_records(self, place: int, size: int) -> tuple[int, int] | None:
        """Place and size of the records of a chunk that is not compressed; None of another."""
        longest = _CHUNK_HEAD.size + len(_PLAIN) + _SIZE.size
        head = self._read(place, min(size, longest))
        _, _, content, _, length = _CHUNK_HEAD.unpack_from(head)
        end_of_name = _CHUNK_HEAD.size + length
        name = head[_CHUNK_HEAD.size : end_of_name]
        if length > len(_PLAIN) or name not in (b'', _PLAIN):
            return None
        (stored,) = _SIZE.unpack_from(head, end_of_name)
        start = end_of_name + _SIZE.size
        if stored != content or stored > size - start:
            raise DamagedError('a chunk is not as large as its head says')
        return place + start, stored

    def _entry(
        self,
        begin: bytes | memoryview,
        whole: Callable[[], bytes | memoryview],
        place: int,
        offset: int,
    ) -> MessageEntry:
        """The entry of a message, by the begin of its record or by all of it."""
        channel, _, time_ns, _ = _MESSAGE_HEAD.unpack_from(begin)
        if channel not in self._channels:
            raise DamagedError(f'a message belongs to channel {channel}, which is not described')
        content = begin[_MESSAGE_HEAD.size :]
        if content[:4] == ZSTD_MAGIC:
            content = whole()[_MESSAGE_HEAD.size :]
        return MessageEntry(channel, time_ns, place, offset, content)

    def _read(self, start: int, size: int) -> bytes:
        return read_exactly(self._file, start, size)

    def _find_end(self) -> tuple[int, int]:
        """Places of the footer and of the summary; the latter is 0 if there is none."""
        magic = Source.MCAP.value
        file_size = os.fstat(self._file.fileno()).st_size
        footer = max(file_size - _END.size, len(magic))
        end = self._read(footer, _END.size)
        kind, size, summary, _, _, last_bytes = _END.unpack(end)
        found = kind, size, last_bytes
        if found != (_FOOTER, _FOOTER_BYTES, magic) or summary > footer:
            raise DamagedError('it has no end')
        return footer, summary

    def _read_summary(self, summary: int, footer: int) -> bool:
        """Read topics and counts from the summary; whether it has all."""
        has_statistics = False
        for kind, start, size in self._records(summary, footer):
            if kind == _STATISTICS:
                self._use_statistics(self._read(start, size))
                has_statistics = True
            elif kind in (_SCHEMA, _CHANNEL):
                self._describe(kind, self._read(start, size))
        return has_statistics and bool(self._channels or not self._counts)

    def _use_statistics(self, record: bytes) -> None:
        counts = _Fields(record, _STATISTICS_HEAD_BYTES).bytes()
        self._counts = Counter(dict(_COUNT.iter_unpack(counts)))

    def _describe(self, kind: int, record: bytes) -> None:
        """Keep a schema or a channel."""
        fields = _Fields(record)
        number = fields.number()
        if kind == _SCHEMA:
            name = fields.text()
            fields.text()  # the encoding of the definition, which is not used
            self._schemas[number] = name, fields.bytes()
            return
        schema = fields.number()
        topic = fields.text()
        encoding = fields.text()
        metadata = _Fields(fields.bytes()).pairs()
        self._channels[number] = _Channel(schema, topic, encoding, metadata)

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

    def _load_chunk(self, start: int) -> bytes | memoryview:
        """The records of a chunk, decompressed; its checksum is compared the first time."""
        _, size = _HEAD.unpack(self._read(start - _HEAD.size, _HEAD.size))
        is_new = start not in self._compared
        self._compared.add(start)
        return chunk_content(self._read(start, size), compared=is_new)


class _Window:
    """Reads parts of some bytes of a file at growing places, a block at once."""

    def __init__(self, file: BinaryIO | None, start: int, size: int) -> None:
        self._file = file
        self._start = start
        self._size = size
        self._block: bytes | memoryview = b''
        self._begin = 0  # of the block

    @classmethod
    def of(cls, content: bytes | memoryview) -> '_Window':
        """Make a window of bytes in memory."""
        window = cls(None, 0, len(content))
        window._block = memoryview(content)
        return window

    def bytes(self, place: int, count: int) -> bytes | memoryview:
        """Bytes at a place after the start."""
        at = place - self._begin
        is_in_block = 0 <= at and at + count <= len(self._block)
        if self._file is not None and not is_in_block:
            left = self._size - place
            largest = max(count, min(_BLOCK_BYTES, left))
            self._block = read_exactly(self._file, self._start + place, largest)
            self._begin = place
            at = 0
        return self._block[at : at + count]

    def records(self) -> Iterator[tuple[int, int, int]]:
        """Kind, start and size of all records."""
        start = 0
        while start < self._size:
            kind, size = _HEAD.unpack(self.bytes(start, _HEAD.size))
            start += _HEAD.size
            if size > self._size - start:
                raise DamagedError('a record ends beyond its chunk')
            yield kind, start, size
            start += size


def chunk_content(record: bytes, *, compared: bool = True) -> bytes | memoryview:
    """The records in the record of a chunk, decompressed; DamagedError if they are not intact.

    `compared`: whether their checksum is compared.
    """
    _, _, size, checksum, length = _CHUNK_HEAD.unpack_from(record)
    if length > _MAX_NAME:
        raise DamagedError('a chunk has an unknown compression')
    end_of_name = _CHUNK_HEAD.size + length
    name = record[_CHUNK_HEAD.size : end_of_name].decode()
    (stored,) = _SIZE.unpack_from(record, end_of_name)
    begin = end_of_name + _SIZE.size
    if stored > len(record) - begin:
        raise DamagedError('a field ends beyond its record')
    chunk = chunk_data(memoryview(record)[begin : begin + stored], name, size)
    if compared and checksum and zlib.crc32(chunk) != checksum:
        raise DamagedError('the checksum of a chunk is wrong')
    return chunk


def intact_records(file: BinaryIO) -> Iterator[tuple[int, bytes]]:
    """Kind and content of the records after the magic of a damaged file that can be read.

    Indexes and statistics, which describe what is no longer there, are left out.
    """
    while len(head := file.read(_HEAD.size)) == _HEAD.size:
        kind, size = _HEAD.unpack(head)
        if size > MAX_CHUNK_BYTES:
            return  # damage: no way leads to the next record
        record = file.read(size)
        if len(record) < size:
            return
        if kind in (_HEADER, _SCHEMA, _CHANNEL, _MESSAGE):
            yield kind, record
        elif kind == _CHUNK:
            with suppress(Exception):  # damaged bytes can raise anything in the decompressors
                content = _Window.of(chunk_content(record))
                for _ in content.records():
                    pass
                yield kind, record


def write_records(file: BinaryIO, records: Iterable[tuple[int, bytes]]) -> None:
    """Write a file of these records, without a summary."""
    magic = Source.MCAP.value
    file.write(magic)
    for kind, record in records:
        file.write(_HEAD.pack(kind, len(record)) + record)
    file.write(_END.pack(_FOOTER, _FOOTER_BYTES, 0, 0, 0, magic))


class _Fields:
    """Reads the fields of a record one after the other."""

    def __init__(self, record: bytes, position: int = 0) -> None:
        self._record = record
        self._position = position

    def number(self) -> int:
        """The number in the next two bytes."""
        self._position += 2
        return int.from_bytes(self._record[self._position - 2 : self._position], 'little')

    def bytes(self) -> bytes:
        """The next field with its length before it."""
        (length,) = _LENGTH.unpack_from(self._record, self._position)
        start = self._position + _LENGTH.size
        self._position = start + length
        if self._position > len(self._record):
            raise DamagedError('a field ends beyond its record')
        return self._record[start : self._position]

    def text(self) -> str:
        """The next text."""
        return self.bytes().decode()

    def pairs(self) -> dict[str, str]:
        """All further fields as names and values."""
        found = {}
        while self._position < len(self._record):
            name = self.text()
            found[name] = self.text()
        return found
