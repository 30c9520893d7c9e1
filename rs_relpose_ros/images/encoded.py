"""An image as it was published, and the gray or colour image that it is decoded to.

Nothing of an image is trusted: sizes are checked before memory is taken, and whatever cannot be
used raises `InputError` with one sentence.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, NamedTuple

import cv2
import numpy as np
from numpy.typing import NDArray

from rs_relpose_ros.errors import InputError
from rs_relpose_ros.images.gray_levels import GrayLevels
from rs_relpose_ros.images.headers import encoded_image_size, is_png

Bytes = NDArray[np.uint8]
Gray = NDArray[np.uint8]

# Largest side [px] and area [px^2] of an image: far above any camera, far below what exhausts
# memory.
MAX_IMAGE_SIDE = 16384
MAX_IMAGE_PIXELS = 64 * 1024 * 1024

# Encoding -> (channels, conversion of OpenCV). '8UC3' names no order; it is read as by cv_bridge.
_COLOR = {
    'bgr8': (3, cv2.COLOR_BGR2GRAY),
    '8UC3': (3, cv2.COLOR_BGR2GRAY),
    'rgb8': (3, cv2.COLOR_RGB2GRAY),
    'bgra8': (4, cv2.COLOR_BGRA2GRAY),
    'rgba8': (4, cv2.COLOR_RGBA2GRAY),
}
# OpenCV names a Bayer pattern by the second row from its second pixel on, ROS from the corner.
_BAYER = {
    'bayer_rggb': cv2.COLOR_BayerBG2GRAY,
    'bayer_bggr': cv2.COLOR_BayerRG2GRAY,
    'bayer_gbrg': cv2.COLOR_BayerGR2GRAY,
    'bayer_grbg': cv2.COLOR_BayerGB2GRAY,
}
# Packed YUV 4:2:2 -> which of two successive bytes is the luma.
_PACKED_YUV = {'yuv422_yuy2': 0, 'yuyv': 0, 'yuv422': 1, 'uyvy': 1}
# Planar YUV begins with the whole luma plane.
_PLANAR_YUV = ('nv21', 'nv12', 'nv24', 'i420', 'yuv420')
# One byte a pixel, row by row, from the first byte on: the gray image itself.
_GRAY = ('mono8', '8UC1', *_PLANAR_YUV)

# Names of the pixels of a PNG or JPEG file, by their type and number of channels.
_ENCODED = {('uint8', 1): 'mono8', ('uint8', 3): 'bgr8', ('uint8', 4): 'bgra8',
            ('uint16', 1): 'mono16', ('uint16', 3): 'bgr16', ('uint16', 4): 'bgra16'}

# Two bytes a pixel, of which a camera may fill some bits only.
_GRAY_16 = ('mono16', '16UC1')

ENCODINGS = ('mono8', '8UC1', *_GRAY_16, *_COLOR, *(f'{name}8' for name in _BAYER),
             *(f'{name}16' for name in _BAYER), *_PACKED_YUV, *_PLANAR_YUV)


class Pixels(NamedTuple):
    """An image (H, W) or (H, W, C), and what sensor_msgs/Image calls its encoding."""

    values: NDArray[Any]
    encoding: str


@dataclass(frozen=True, slots=True, eq=False)
class RawImage:
    """Pixels as sensor_msgs/Image has them: `height` rows of `step` bytes each in `data` (K,)."""

    data: Bytes
    encoding: str
    width: int
    height: int
    step: int
    is_bigendian: bool

    @property
    def size(self) -> tuple[int, int]:
        """Width and height [px] as told; not checked yet."""
        return self.width, self.height

    def decoded(self, levels: GrayLevels | None = None) -> Gray:
        """Gray image (H, W); of a mono8 image without padding a view of `data`.

        `levels`: of the images before, for pixels of 16 bits; without it an image is by itself.
        """
        levels = GrayLevels() if levels is None else levels
        height, width, encoding = self.height, self.width, self.encoding
        check_image_size(width, height)
        if encoding in _GRAY:
            return np.ascontiguousarray(self._rows(width))
        if encoding in _GRAY_16:
            return levels.gray(self._two_bytes())
        if encoding in _COLOR:
            channels, conversion = _COLOR[encoding]
            pixels = np.ascontiguousarray(self._rows(width * channels))
            return np.asarray(cv2.cvtColor(pixels.reshape(height, width, channels), conversion),
                              dtype=np.uint8)
        if encoding in _PACKED_YUV:
            return np.ascontiguousarray(self._rows(2 * width)[:, _PACKED_YUV[encoding]::2])
        if encoding in ENCODINGS:
            return self._from_bayer(levels)
        raise InputError(f'image encoding {encoding[:40]!r} is not known; '
                         f'publish one of {", ".join(ENCODINGS)}')

    def pixels(self, levels: GrayLevels | None = None) -> Pixels:
        """The image in its own encoding; in mono8, as `decoded`, where that is Bayer or YUV."""
        if self.encoding in _COLOR:
            check_image_size(self.width, self.height)
            channels, _ = _COLOR[self.encoding]
            rows = np.ascontiguousarray(self._rows(self.width * channels))
            return Pixels(rows.reshape(self.height, self.width, channels), self.encoding)
        if self.encoding in _GRAY_16:
            check_image_size(self.width, self.height)
            return Pixels(self._two_bytes().astype(np.uint16), self.encoding)
        return Pixels(self.decoded(levels), 'mono8')

    def _from_bayer(self, levels: GrayLevels) -> Gray:
        if self.height < 3 or self.width < 3:
            raise InputError(
                f'a Bayer image must be at least 3x3, got {self.width}x{self.height}')
        pattern = self.encoding.removesuffix('16').removesuffix('8')
        mosaic = (levels.gray(self._two_bytes()) if self.encoding.endswith('16')
                  else np.ascontiguousarray(self._rows(self.width)))
        return np.asarray(cv2.cvtColor(mosaic, _BAYER[pattern]), dtype=np.uint8)

    def _two_bytes(self) -> NDArray[np.uint16]:
        """Pixels of 16 bits, in the byte order of the message."""
        order = '>u2' if self.is_bigendian else '<u2'
        return np.ascontiguousarray(self._rows(2 * self.width)).view(order)

    def _rows(self, row_bytes: int) -> Bytes:
        """View (height, row_bytes) of the data, padding left out."""
        height, step = self.height, self.step
        if step < row_bytes:
            raise InputError(f'image step is {step} bytes, but a row of {self.width} px in '
                             f'{self.encoding} has {row_bytes}')
        needed = step * (height - 1) + row_bytes
        if len(self.data) < needed:
            raise InputError(
                f'image has {len(self.data)} bytes of data, but {self.width}x{height} in '
                f'{self.encoding} with step {step} needs {needed}')
        return np.lib.stride_tricks.as_strided(
            self.data, shape=(height, row_bytes), strides=(step, 1), writeable=False)


@dataclass(frozen=True, slots=True, eq=False)
class CompressedImage:
    """A JPEG or PNG file in `data` (K,); `encoding` is what its publisher calls it."""

    data: Bytes
    encoding: str

    @property
    def size(self) -> tuple[int, int]:
        """Width and height [px] as its header tells; not checked yet."""
        return encoded_image_size(self.data)

    @property
    def is_png(self) -> bool:
        """Whether it is a PNG file, which loses nothing."""
        return is_png(self.data)

    def decoded(self, levels: GrayLevels | None = None) -> Gray:
        """Gray image (H, W); `levels` as of `RawImage.decoded`."""
        # Not turned upright: rows must stay in the order in which the sensor reads them.
        image = self._decoded(cv2.IMREAD_GRAYSCALE | cv2.IMREAD_IGNORE_ORIENTATION
                              | cv2.IMREAD_ANYDEPTH)
        if image.dtype == np.uint16:
            return (GrayLevels() if levels is None else levels).gray(image)
        return np.asarray(image, dtype=np.uint8)

    def pixels(self, levels: GrayLevels | None = None) -> Pixels:
        """The image in colour or gray, 8 or 16 bits, as it was encoded, whatever its levels."""
        # Nor is it turned upright here.
        image = self._decoded(cv2.IMREAD_UNCHANGED)
        channels = 1 if image.ndim == 2 else image.shape[2]
        encoding = _ENCODED.get((image.dtype.name, channels))
        if encoding is None:
            raise InputError(f'compressed image has {channels} channels of {image.dtype.name}: '
                             f'publish one of {", ".join(_ENCODED.values())}')
        return Pixels(image, encoding)

    def _decoded(self, flags: int) -> NDArray[Any]:
        width, height = self.size
        check_image_size(width, height)
        try:
            image = cv2.imdecode(self.data, flags)
        except cv2.error:
            image = None
        if image is None or image.shape[:2] != (height, width):
            raise InputError(
                f'compressed image of {len(self.data)} bytes cannot be decoded: it is corrupt')
        return np.asarray(image)


EncodedImage = RawImage | CompressedImage


def check_image_size(width: int, height: int) -> None:
    """Raise InputError for a size that no camera has."""
    if not (0 < width <= MAX_IMAGE_SIDE and 0 < height <= MAX_IMAGE_SIDE
            and width * height <= MAX_IMAGE_PIXELS):
        raise InputError(f'image size {width}x{height} is not usable: sides must be 1 to '
                         f'{MAX_IMAGE_SIDE} px and the area at most {MAX_IMAGE_PIXELS} px')
