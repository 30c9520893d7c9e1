"""Small videos with telemetry, as tests of the converters need them."""

from __future__ import annotations

from collections.abc import Sequence
from fractions import Fraction
from pathlib import Path
import struct

import numpy as np
import pytest

# Not on a ROS machine: there, tests of videos are skipped.
av = pytest.importorskip('av', reason='needs the extra video')
pytest.importorskip('telemetry_parser', reason='needs the extra video')

TICKS = 30_000   # per second


def write_video(path: Path, ticks: Sequence[int], width: int = 64, height: int = 48) -> None:
    """Frames at these instants [1/30000 s]; frame k has the brightness `brightness(k)`."""
    with av.open(str(path), 'w') as container:
        stream = container.add_stream('mpeg4', rate=30)
        stream.width, stream.height, stream.pix_fmt = width, height, 'yuv420p'
        stream.codec_context.time_base = Fraction(1, TICKS)
        stream.codec_context.gop_size = 4
        for number, tick in enumerate(ticks):
            pixels = np.full((height, width, 3), brightness(number), dtype=np.uint8)
            frame = av.VideoFrame.from_ndarray(pixels, format='bgr24')
            frame.pts, frame.time_base = tick, Fraction(1, TICKS)
            container.mux(stream.encode(frame))
        container.mux(stream.encode())


def brightness(number: int) -> int:
    """Gray value of a frame."""
    return 30 + 20 * (number % 10)


def write_gcsv(path: Path, rows: Sequence[Sequence[float]], **header: object) -> None:
    """Gyroflow's log: time [ms], angular velocity [rad/s], specific force [g]."""
    lines = ['GYROFLOW IMU LOG', 'version,1.3', 'id,Model_1', 'vendor,Acme', 'orientation,XYZ',
             *(f'{name},{value}' for name, value in header.items()),
             'tscale,0.001', 'gscale,1', 'ascale,1', 't,gx,gy,gz,ax,ay,az']
    lines += [','.join(map(repr, row)) for row in rows]
    path.write_text('\n'.join(lines) + '\n')


def add_gopro_tags(path: Path, *, whole: bool = True, **tags: str) -> None:
    """Append GoPro's box of tags (GPMF), each a text; `whole`: with what follows it."""
    entries = b''.join(
        name.encode() + struct.pack('>cBH', b'c', 1, len(text)) + text.encode()
        + b'\0' * (-len(text) % 4) for name, text in tags.items())
    # Four bytes that telemetry-parser passes over.
    entries = b'\0\0\0\0' + entries
    device = b'DEVC' + struct.pack('>BBH', 0, 1, len(entries)) + entries
    with path.open('ab') as file:
        file.write(struct.pack('>I', 8 + len(device)) + b'GPMF' + device)
        if whole:
            file.write(struct.pack('>I', 8) + b'free')


def turn_for_display(path: Path) -> None:
    """Ask players to show the video turned by 90 degrees."""
    data = path.read_bytes()
    identity = struct.pack('>9i', 1 << 16, 0, 0, 0, 1 << 16, 0, 0, 0, 1 << 30)
    turned = struct.pack('>9i', 0, 1 << 16, 0, -(1 << 16), 0, 0, 0, 0, 1 << 30)
    at = data.index(identity, data.index(b'tkhd'))
    path.write_bytes(data[:at] + turned + data[at + len(identity):])
