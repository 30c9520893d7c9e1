"""Whether an MCAP file is whole, from its record lengths alone: before a parser trusts them."""

from __future__ import annotations

from pathlib import Path
import struct

from rs_relpose_ros.bags.limits import MAX_CHUNK_BYTES
from rs_relpose_ros.errors import InputError

_MAGIC = b'\x89MCAP0\r\n'
_FOOTER, _CHUNK = 0x02, 0x06
_RECORD = struct.Struct('<BQ')
# Start time, end time, uncompressed size, CRC: the head of a chunk.
_CHUNK_HEAD = struct.Struct('<QQQI')


def check_mcap(path: Path) -> None:
    """Walk over the records of an MCAP file (https://mcap.dev/spec), contents unread.

    Raises InputError: no MCAP file, truncated, or with a record that cannot be right.
    """
    size = path.stat().st_size
    with path.open('rb') as file:
        if file.read(len(_MAGIC)) != _MAGIC:
            raise InputError(f'{path} is no MCAP file' if size else f'{path} is empty')
        at = len(_MAGIC)
        while True:
            head = file.read(_RECORD.size)
            if len(head) < _RECORD.size:
                raise _truncated(path, at)
            opcode, length = _RECORD.unpack(head)
            at += _RECORD.size
            if at + length > size:
                raise _truncated(path, at)
            if opcode == _FOOTER:
                break
            if opcode == _CHUNK:
                _check_chunk(path, file.read(min(length, _CHUNK_HEAD.size)))
            at += length
            file.seek(at)
        file.seek(at + length)
        if file.read(len(_MAGIC)) != _MAGIC:
            raise _truncated(path, at + length)


def _check_chunk(path: Path, head: bytes) -> None:
    if len(head) < _CHUNK_HEAD.size or _CHUNK_HEAD.unpack(head)[2] > MAX_CHUNK_BYTES:
        raise InputError(f'{path} is corrupt: one of its chunks has an impossible size')


def _truncated(path: Path, at: int) -> InputError:
    return InputError(
        f'{path} is truncated at byte {at}: the recorder was killed or the copy is incomplete; '
        f'copy it again, or save what is whole with "mcap recover {path.name} -o recovered.mcap"')
