"""Bounds for what a bag may make of itself when it is read; rosbags has none of its own.

A few bytes can decompress to any size, and a few lines of YAML with aliases can be printed at any
length.
"""

from __future__ import annotations

import bz2
from collections.abc import Callable
import os
from pathlib import Path
from types import SimpleNamespace
from typing import Any, BinaryIO, Self

from lz4.frame import LZ4FrameDecompressor
from rosbags.rosbag1 import reader as rosbag1
from rosbags.rosbag2 import reader as rosbag2
from rosbags.rosbag2 import storage_mcap as mcap
import yaml

from rs_relpose_ros.errors import InputError

# Bytes of the largest chunk that is decompressed; recorders make chunks of megabytes.
MAX_CHUNK_BYTES = 1 << 30
# Bytes of the largest message that is decoded: above any image that is accepted (64 Mpx in four
# channels).
MAX_MESSAGE_BYTES = 1 << 29
# A compressed storage file is decompressed to a temporary one: this and so many times its size.
MAX_FILE_BYTES = 1 << 30
_MAX_FILE_GROWTH = 200
# Bytes of the largest metadata.yaml that is parsed: thousands of topics take less.
_MAX_METADATA_BYTES = 1 << 24

# The zstd module that rosbags uses: Python's own from 3.14 on, a package before.
_zstd: Any = vars(mcap)['zstd']


def check_metadata(path: Path) -> None:
    """Raise InputError unless the size of a metadata.yaml is sane and it has no aliases."""
    if path.stat().st_size > _MAX_METADATA_BYTES:
        raise InputError(f'{path} is no metadata of a bag: it has more than '
                         f'{_MAX_METADATA_BYTES} bytes')
    content = path.read_bytes()
    # Looked for in the bytes first: parsing takes time, and recorders write no aliases.
    if b'*' in content and has_aliases(content):
        raise InputError(f'{path} has YAML aliases, which no recorder writes: it is damaged')


def has_aliases(content: bytes | str) -> bool:
    """Whether YAML refers to parts of itself; False for what is no YAML."""
    try:
        return any(isinstance(event, yaml.AliasEvent) for event in yaml.parse(content))
    except (yaml.YAMLError, RecursionError):
        return False


def bound_decompression() -> None:
    """Let rosbags decompress to bounded sizes only, in all bags that this process reads.

    rosbags has no setting for it, so the entries of its tables of decompressors are replaced; a
    version without such an entry raises ImportError, since nothing would be bounded.
    """
    def of_chunk(decompressor: Callable[[], Any]) -> Callable[..., bytes]:
        # MCAP tells the size of a chunk, ROS 1 does not.
        return lambda data, *size: _bounded(decompressor, data, min([*size, MAX_CHUNK_BYTES]))

    whole_file = SimpleNamespace(open=_BoundedFile, decompress=lambda data: _bounded(
        _zstd.ZstdDecompressor, data, MAX_MESSAGE_BYTES))
    tables: Any = ((mcap.DECOMPRESSORS, 'zstd', of_chunk(_zstd.ZstdDecompressor)),
                   (mcap.DECOMPRESSORS, 'lz4', of_chunk(LZ4FrameDecompressor)),
                   (rosbag1.decompressors, 'lz4', of_chunk(LZ4FrameDecompressor)),
                   (rosbag1.decompressors, 'bz2', of_chunk(bz2.BZ2Decompressor)),
                   (vars(rosbag2), 'zstd', whole_file))
    for table, name, bounded in tables:
        if name not in table:
            raise ImportError(f'rosbags decompresses {name} in another way than 0.11 does')
        table[name] = bounded


class _BoundedFile:
    """A zstd file that is read up to a size only; where rosbags opens one for reading."""

    def __init__(self, file: BinaryIO, mode: str) -> None:
        self._size = os.fstat(file.fileno()).st_size
        self._limit = MAX_FILE_BYTES + _MAX_FILE_GROWTH * self._size
        self._stream: Any = _zstd.open(file, mode)
        self._count = 0

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self._stream.close()

    def read(self, size: int) -> bytes:
        data: bytes = self._stream.read(size)
        self._count += len(data)
        if self._count > self._limit:
            raise InputError(f'{self._size} bytes decompress to more than {self._limit}')
        return data


def _bounded(decompressor: Callable[[], Any], data: bytes, limit: int) -> bytes:
    """One frame, decompressed."""
    stream = decompressor()
    # One byte more, as the end of the frame may not be seen at exactly the limit.
    out: bytes = stream.decompress(data, limit + 1)
    if len(out) > limit:
        raise InputError(f'{len(data)} bytes decompress to more than {limit}')
    if not stream.eof:
        raise InputError(f'{len(data)} compressed bytes are incomplete')
    return out
