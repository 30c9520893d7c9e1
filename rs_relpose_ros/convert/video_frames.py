"""Frames of a video file with their own time stamps, as JPEG images (PyAV)."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from types import ModuleType
from typing import Any

import cv2

from rs_relpose_ros.convert.optional import import_optional
from rs_relpose_ros.errors import InputError, MissingInputError
from rs_relpose_ros.geometry.timing import NANOSECONDS

IMAGE_FORMAT = 'bgr8; jpeg compressed bgr8'

_JPEG_QUALITY = 90


class Video:
    """The first video stream of a file, as it was encoded: a rotation for display is not applied.

    MissingInputError without the file or PyAV; InputError where it is no video.
    """

    def __init__(self, path: Path) -> None:
        if not path.is_file():
            raise MissingInputError(f'there is no video {path}')
        self.path = path
        self._av = import_optional('av')
        with _errors_of(self._av, path), self._av.open(str(path)) as container:
            if not container.streams.video:
                raise InputError(f'{path} has no video stream')
            stream = container.streams.video[0]
            self.width, self.height = int(stream.width), int(stream.height)
            self._time_base = stream.time_base
            # Those that an edit list cuts off are decoded, but not shown.
            self._pts = sorted(packet.pts for packet in container.demux(stream)
                               if packet.size and packet.pts is not None
                               and not packet.is_discard)
        if not self._pts:
            raise MissingInputError(f'{path} has no frames')
        self._decoded: Iterator[Any] = iter(())
        self._next = len(self._pts)   # number of the frame that the decoder gives next

    def __len__(self) -> int:
        return len(self._pts)

    def times_ns(self) -> list[int]:
        """Instant [ns] of each frame from the start of the file, rounded from the exact one."""
        return [round(pts * self._time_base * NANOSECONDS) for pts in self._pts]

    def frames(self, stamps_ns: Sequence[int]) -> tuple[VideoFrame, ...]:
        """All frames, with the stamp [ns] of each."""
        return tuple(VideoFrame(stamp_ns, self, number)
                     for number, stamp_ns in enumerate(stamps_ns))

    def jpeg(self, number: int) -> bytes:
        """Frame `number` as a JPEG image in colour; fastest one after the other."""
        if number < self._next:
            self._decoded, self._next = self._decode(), 0
        with _errors_of(self._av, self.path):
            for frame in self._decoded:
                if frame.pts is None or frame.pts < self._pts[number]:
                    continue
                if frame.pts > self._pts[number]:
                    break
                self._next = number + 1
                return self._encoded(frame)
        raise InputError(f'{self.path}: frame {number + 1} of {len(self)} cannot be decoded: the '
                         'file is damaged')

    def _decode(self) -> Iterator[Any]:
        with self._av.open(str(self.path)) as container:
            yield from container.decode(video=0)

    def _encoded(self, frame: Any) -> bytes:
        pixels = frame.to_ndarray(format='bgr24')
        return bytes(cv2.imencode('.jpg', pixels, [cv2.IMWRITE_JPEG_QUALITY, _JPEG_QUALITY])[1])


@dataclass(frozen=True, slots=True)
class VideoFrame:
    """A frame of a video and its stamp [ns]."""

    stamp_ns: int
    video: Video
    number: int   # from 0

    @property
    def name(self) -> str:
        """File and number of the frame, from 1."""
        return f'frame {self.number + 1} of {self.video.path}'

    def encoded(self) -> bytes:
        """The frame as a JPEG image."""
        return self.video.jpeg(self.number)


@contextmanager
def _errors_of(av: ModuleType, path: Path) -> Iterator[None]:
    """Errors of PyAV as InputErrors that name the file."""
    try:
        yield
    except av.error.FFmpegError as error:
        raise InputError(f'{path} is no video that can be read: {error.strerror}') from error
