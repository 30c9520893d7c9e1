"""What the files of a bag have in common: their topics, bounded decompression, raised errors.

The modules `mcap`, `sqlite` and `ros1` read one kind of file each. They give the place of every
message, so that a bag can be read in another order than that of its files (`order`).
"""

import bz2
from collections import OrderedDict
from collections.abc import Callable, Iterator
import contextlib
from enum import Enum
import importlib
import os
import sys
from typing import Any, BinaryIO, NamedTuple, Protocol

from lz4.frame import LZ4FrameDecompressor
from rosbags.interfaces import (
    Qos,
    QosDurability,
    QosHistory,
    QosLiveliness,
    QosReliability,
    QosTime,
)
import yaml

from rs_relpose_ros.errors import InputError

# Python's own module from 3.14 on, before that the package which rosbags requires.
zstd: Any = importlib.import_module(
    'compression.zstd' if sys.version_info >= (3, 14) else 'backports.zstd'
)

# Bytes of the largest chunk that is decompressed: a few bytes can decompress to any size, and a
# chunk is held in memory. [chosen: recorders write chunks of some megabytes, so that any value
# between 64 MB and the memory of a small board would do]
MAX_CHUNK_BYTES = 1 << 30
# Bytes of the largest message that is decoded. Smaller ones would refuse images that are accepted
# otherwise (64 Mpx, 4 channels: 2^28 bytes). [derived: twice these]
MAX_MESSAGE_BYTES = 1 << 29
# Bytes of decompressed chunks that are kept. Fewer than two chunks of each topic would decompress
# chunks again where topics lie far apart in the file; more only take memory. [chosen: 10 to 500
# MB]
_KEPT_BYTES = 1 << 27
# Bytes of a message that an index needs: its stamp is in them. [derived: CDR has it in the first
# 12 bytes; a larger number reads more for nothing]
BEGIN_BYTES = 64
# First bytes of data that are compressed by zstd. A message as CDR begins with a zero instead.
# [derived: the format of zstd]
ZSTD_MAGIC = b'\x28\xb5\x2f\xfd'
# Size of the largest text of QoS profiles that is parsed. [chosen: a profile has 300 bytes, and a
# topic one for each publisher]
_MAX_QOS_TEXT = 1 << 20


class DamagedError(InputError):
    """A file is not as its format requires; the text says how, without the name of the file."""


class NoBeginError(DamagedError):
    """A file begins as none of a bag does: no tool recovers it."""


class UnfinishedError(DamagedError):
    """A recorder has not finished the file; the text has the remedy."""


class StoredTopic(NamedTuple):
    """A topic in one file, as its recorder has described it."""

    id: int
    name: str
    msgtype: str
    messages: int
    encoding: str = 'cdr'  # or 'ros1'
    digest: str = ''  # hash of the fields of the type; empty if it was not recorded
    definition: str = ''  # of the type, never parsed
    qos: tuple[Qos, ...] = ()  # of its publishers


class MessageEntry(NamedTuple):
    """A message in a file: two numbers that find it again, and the bytes that it begins with."""

    topic_id: int
    time_ns: int  # when it was recorded
    place: int
    offset: int
    begin: bytes | memoryview  # `BEGIN_BYTES` or more, or all; all where it is compressed itself


class Storage(Protocol):
    """An open file of a bag, closed by the stack that its class gets with the path.

    Damage raises a DamagedError, or any error of a parser.
    """

    topics: list[StoredTopic]

    def entries(self) -> Iterator[MessageEntry]:
        """All messages in the order of the file."""

    def data(self, place: int, offset: int) -> bytes:
        """Bytes of the message of an entry."""


def decompressed(decompressor: Callable[[], Any], data: bytes | memoryview, limit: int) -> bytes:
    """Decompress one frame of at most `limit` bytes."""
    stream = decompressor()
    # One byte more: at exactly the limit the end of the frame may not be reached.
    out: bytes = stream.decompress(data, limit + 1)
    if len(out) > limit:
        raise DamagedError(f'{len(data)} bytes decompress to more than {limit}')
    if not stream.eof:
        raise DamagedError(f'{len(data)} compressed bytes are incomplete')
    return out


# Compressions of chunks by the names that recorders write. [derived: rosbag2 and ROS 1]
_DECOMPRESSORS: dict[str, Callable[[], Any]] = {
    'zstd': zstd.ZstdDecompressor,
    'lz4': LZ4FrameDecompressor,
    'bz2': bz2.BZ2Decompressor,
}


def chunk_data(data: bytes | memoryview, compression: str, size: int) -> bytes | memoryview:
    """Content of a chunk that has `size` bytes by its head."""
    limit = min(size, MAX_CHUNK_BYTES)
    out: bytes | memoryview
    if compression in ('', 'none'):
        out = data
    elif compression in _DECOMPRESSORS:
        out = decompressed(_DECOMPRESSORS[compression], data, limit)
    else:
        raise DamagedError(f'a chunk has the unknown compression {compression[:20]!r}')
    if len(out) != size:
        raise DamagedError(f'a chunk has {len(out)} bytes instead of {size}')
    return out


def message_data(data: bytes | memoryview) -> bytes:
    """Bytes of a message, which recorders may compress one by one."""
    data = bytes(data)
    if data[:4] == ZSTD_MAGIC:
        return decompressed(zstd.ZstdDecompressor, data, MAX_MESSAGE_BYTES)
    return data


def read_exactly(file: BinaryIO, start: int, size: int) -> bytes:
    """Bytes of a record at a place of an unbuffered file."""
    if size > MAX_CHUNK_BYTES:
        raise DamagedError(f'a record has {size} bytes')
    data = os.pread(file.fileno(), size, start)
    if len(data) < size:
        raise DamagedError('it ends within a record')
    return data


def first_bytes(data: bytes | memoryview, count: int) -> bytes:
    """The first bytes of a message that is compressed; fewer where it is damaged."""
    try:
        return bytes(zstd.ZstdDecompressor().decompress(data, count))
    except zstd.ZstdError:
        return b''


class KeptChunks:
    """The last chunks that were decompressed, by their place."""

    def __init__(self, load: Callable[[int], bytes | memoryview]) -> None:
        self._load = load
        self._chunks: OrderedDict[int, bytes | memoryview] = OrderedDict()
        self._size = 0

    def __getitem__(self, place: int) -> bytes | memoryview:
        if place not in self._chunks:
            self._chunks[place] = self._load(place)
            self._size += len(self._chunks[place])
        self._chunks.move_to_end(place)
        while self._size > _KEPT_BYTES and len(self._chunks) > 1:
            _, dropped = self._chunks.popitem(last=False)
            self._size -= len(dropped)
        return self._chunks[place]


def qos_profiles(text: str) -> tuple[Qos, ...]:
    """Profiles of rosbag2, which are YAML; none where they cannot be read."""
    profiles: Any = ()
    with contextlib.suppress(yaml.YAMLError, RecursionError):
        profiles = yaml.safe_load(text) if len(text) <= _MAX_QOS_TEXT else ()
    with contextlib.suppress(KeyError, TypeError, AttributeError):
        return tuple(
            Qos(
                _member(QosHistory, profile['history']),
                profile['depth'],
                _member(QosReliability, profile['reliability']),
                _member(QosDurability, profile['durability']),
                _duration(profile['deadline']),
                _duration(profile['lifespan']),
                _member(QosLiveliness, profile['liveliness']),
                _duration(profile['liveliness_lease_duration']),
                bool(profile['avoid_ros_namespace_conventions']),
            )
            for profile in profiles or ()
        )
    return ()


def _member(kind: Any, value: Any) -> Any:
    """Member of an enumeration by its number, or by its name (rosbag2 from version 9 on)."""
    if isinstance(value, int):
        return kind(value) if any(value == member.value for member in kind) else kind.UNKNOWN
    return kind.__members__.get(value.upper(), kind.UNKNOWN)


def _duration(value: Any) -> QosTime:
    return QosTime(int(value['sec']), int(value['nsec']))


class Source(Enum):
    """Kind of a file by its first bytes."""

    MCAP = b'\x89MCAP0\r\n'
    SQLITE = b'SQLite format 3\x00'
    ROS1 = b'#ROSBAG V'
    ZSTD = ZSTD_MAGIC
