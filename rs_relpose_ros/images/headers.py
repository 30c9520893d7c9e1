"""Size of a JPEG or PNG from its header, before a decoder takes memory for it."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from rs_relpose_ros.errors import InputError

_PNG_SIGNATURE = b'\x89PNG\r\n\x1a\n'
_JPEG_SIGNATURE = b'\xff\xd8\xff'
# Start-of-frame markers: all of 0xc0..0xcf but DHT, JPG and DAC.
_START_OF_FRAME = frozenset(range(0xc0, 0xd0)) - {0xc4, 0xc8, 0xcc}
# Markers without a length field: TEM and RST0 to RST7.
_STANDALONE = frozenset({0x01, *range(0xd0, 0xd8)})
# Most bytes after the end marker of a JPEG: cameras pad their files.
_PADDING = 4096


def encoded_image_size(data: NDArray[np.uint8]) -> tuple[int, int]:
    """Width and height [px] that the header of a JPEG or PNG tells."""
    start = data[:24].tobytes()
    if start.startswith(_PNG_SIGNATURE):
        return _png_size(start, data)
    if start.startswith(_JPEG_SIGNATURE):
        return _jpeg_size(data)
    raise InputError(f'compressed image of {len(data)} bytes is neither JPEG nor PNG')


def is_png(data: NDArray[np.uint8]) -> bool:
    """Whether it begins as a PNG does."""
    return data[:len(_PNG_SIGNATURE)].tobytes() == _PNG_SIGNATURE


def _png_size(start: bytes, data: NDArray[np.uint8]) -> tuple[int, int]:
    if len(start) < 24 or start[12:16] != b'IHDR' or b'IEND' not in data[-_PADDING:].tobytes():
        raise InputError(f'PNG image of {len(data)} bytes is truncated or corrupt')
    return int.from_bytes(start[16:20], 'big'), int.from_bytes(start[20:24], 'big')


def _jpeg_size(data: NDArray[np.uint8]) -> tuple[int, int]:
    # The decoder would fill missing rows with gray and report no error.
    if b'\xff\xd9' not in data[-_PADDING:].tobytes():
        raise InputError(f'JPEG image of {len(data)} bytes is truncated')
    at = 2
    while at + 9 <= len(data):
        if data[at] != 0xff:
            break
        marker = int(data[at + 1])
        if marker == 0xff:   # fill byte
            at += 1
        elif marker in _STANDALONE:
            at += 2
        elif marker in _START_OF_FRAME:
            height = int(data[at + 5]) << 8 | int(data[at + 6])
            width = int(data[at + 7]) << 8 | int(data[at + 8])
            return width, height
        else:
            length = int(data[at + 2]) << 8 | int(data[at + 3])
            if length < 2:
                break
            at += 2 + length
    raise InputError(f'JPEG image of {len(data)} bytes has no frame header: it is corrupt')
