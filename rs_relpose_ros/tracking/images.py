"""Images as published, and the gray or colour arrays that they are decoded to.

No field is trusted: sizes are checked before memory is allocated, and an unusable image raises
`InputError`.
"""

from dataclasses import dataclass
import struct
from typing import Any, ClassVar, NamedTuple, Self

import cv2
import numpy as np
from numpy.typing import NDArray

from rs_relpose_ros.errors import InputError

# -- Brightness -----------------------------------------------------------------------------------

Bytes = NDArray[np.uint8]
Image = NDArray[np.uint8]  # (H, W) gray

# Percentiles of an image that become black and white. With the extremes, one dead pixel would
# determine the range. [chosen: any value up to 2 % cuts off only lamps and dead pixels]
_ENDS = (0.5, 99.5)
# Every third pixel in both directions is counted: an odd stride samples all colours of a Bayer
# pattern, and a ninth of the pixels is enough for a percentile. [derived: 2 is even]
_STRIDE = 3
# The range exceeds that of an image by this share on either side, so that the next ones fit: a new
# range changes the brightness of the tracked windows. More wastes gray levels.
# [chosen: a third of the gray levels are spare at the begin]
_MARGIN = 0.25
# The range is chosen again for an image that fills less than this share of it.
# [chosen: then a quarter of the gray levels are in use; any value in 0.2..0.5 would do]
_LEAST_FILLED = 0.3
# Smallest range: noise of a dark image is not stretched. [derived: the number of gray levels]
_LEAST_RANGE = 255.0

# An image is dark if this percentage of its pixels is below the gray level: a lamp in the image
# does not help the tracker. [chosen: 1 % of an image has room for a few corners only]
_DARK_SHARE = 99.0
# [chosen: an eighth of the range; corners of noise-free texture need some 10 gray levels]
_DARK_GRAY = 32


class GrayLevels:
    """Range of one camera's 16-bit pixels that is mapped to gray (sensors fill 10 to 14 bits).

    Depends only on the images and their order.
    """

    def __init__(self) -> None:
        self._low = 0.0
        self._high = 0.0

    def gray(self, pixels: NDArray[np.uint16]) -> Image:
        """Gray image (H, W) of the next image."""
        some = pixels[::_STRIDE, ::_STRIDE]
        low, high = np.percentile(some, _ENDS)
        filled = high - low
        fewest = _LEAST_FILLED * (self._high - self._low)
        is_outside = low < self._low or high > self._high
        is_too_wide = filled < fewest and fewest > _LEAST_RANGE
        if is_outside or is_too_wide:
            spare = _MARGIN * filled
            self._low = max(low - spare, 0.0)
            self._high = max(high + spare, self._low + _LEAST_RANGE)
        scale = 255.0 / (self._high - self._low)
        levels = pixels - np.float32(self._low)
        levels *= np.float32(scale)
        return np.clip(levels, 0.0, 255.0).astype(np.uint8)


def is_dark(image: Image) -> bool:
    """Whether almost no pixel of a gray image (H, W) is bright: night, a covered lens."""
    bright = np.percentile(image[::_STRIDE, ::_STRIDE], _DARK_SHARE)
    return bool(bright < _DARK_GRAY)


# -- Size of a JPEG or PNG, from its header -------------------------------------------------------

# First bytes of a PNG. [derived: ISO/IEC 15948]
_PNG_SIGNATURE = b'\x89PNG\r\n\x1a\n'
# Start of a JPEG, and of its next marker. [derived: ISO/IEC 10918-1, as the markers below]
_JPEG_SIGNATURE = b'\xff\xd8\xff'
# Marker of the end of a JPEG. [derived: the same]
_JPEG_END = b'\xff\xd9'
# Start-of-frame markers: all of 0xc0..0xcf but DHT, JPG and DAC. [derived: the same]
_START_OF_FRAME = frozenset(range(0xC0, 0xD0)) - {0xC4, 0xC8, 0xCC}
# Markers without a length field: TEM and RST0 to RST7. [derived: the same]
_STANDALONE = frozenset({0x01, *range(0xD0, 0xD8)})
# Bytes at the end of a file in which its end marker is searched: cameras pad their files, up to a
# page of memory. [derived: pages have 4096 bytes]
_PADDING = 4096
# Bytes of a PNG up to the size of its image. [derived: signature, length, name, width, height]
_PNG_HEADER = 24


def encoded_image_size(data: Bytes) -> tuple[int, int]:
    """Width and height [px] in the header of a JPEG or PNG."""
    start = data[:_PNG_HEADER].tobytes()
    end = data[-_PADDING:].tobytes()
    if start.startswith(_PNG_SIGNATURE):
        begins = len(start) == _PNG_HEADER and start[12:16] == b'IHDR'
        if not begins or b'IEND' not in end:
            raise InputError(f'PNG image of {len(data)} bytes is truncated or corrupt')
        width, height = struct.unpack('>II', start[16:24])
        return width, height
    if not start.startswith(_JPEG_SIGNATURE):
        raise InputError(f'compressed image of {len(data)} bytes is neither JPEG nor PNG')
    # The decoder would fill missing rows with gray and report no error.
    if _JPEG_END not in end and not _is_padded(data):
        raise InputError(f'JPEG image of {len(data)} bytes is truncated')
    return _jpeg_size(data)


def is_encoded(
    data: Bytes,
    size: tuple[int, int],
) -> bool:
    """Whether bytes are a JPEG or PNG of this width and height [px]."""
    begin = data[: len(_PNG_SIGNATURE)].tobytes()
    if not begin.startswith((_PNG_SIGNATURE, _JPEG_SIGNATURE)):
        return False
    try:
        return encoded_image_size(data) == size
    except InputError:
        return False


def _is_padded(data: Bytes) -> bool:
    """Whether a JPEG is complete, and its file filled with one value up to some size."""
    content = data.tobytes().rstrip(data[-1:].tobytes())
    # A byte of the end marker itself may have that value.
    end = content.rfind(_JPEG_END[:1], len(content) - 2)
    return end >= 0 and data[end : end + 2].tobytes() == _JPEG_END


def _jpeg_size(data: Bytes) -> tuple[int, int]:
    """Width and height [px] in the frame header of a JPEG."""

    def number(at: int) -> int:
        return int(data[at]) << 8 | int(data[at + 1])

    at = 2
    while at + 9 <= len(data):
        if data[at] != 0xFF:
            break
        marker = int(data[at + 1])
        if marker == 0xFF:  # fill byte
            at += 1
        elif marker in _STANDALONE:
            at += 2
        elif marker in _START_OF_FRAME:
            return number(at + 7), number(at + 5)
        else:
            length = number(at + 2)
            if length < 2:
                break
            at += 2 + length
    raise InputError(f'JPEG image of {len(data)} bytes has no frame header: it is corrupt')


# -- Encodings ------------------------------------------------------------------------------------

# Largest side of an image [px]: far above any camera. A header may claim any size.
# [chosen: the largest sensors have 12 000 px]
MAX_IMAGE_SIDE = 16384
# Largest area of an image [px]: far below the memory of a computer.
# [chosen: 64 Mpx of colour take 200 MB]
MAX_IMAGE_PIXELS = 64 * 1024 * 1024

# Number of channels of each encoding, and the conversion of OpenCV. '8UC3' names no order; it is
# read as cv_bridge reads it. [derived: sensor_msgs/image_encodings.hpp, as all encodings below]
_COLOR = {
    'bgr8': (3, cv2.COLOR_BGR2GRAY),
    '8UC3': (3, cv2.COLOR_BGR2GRAY),
    'rgb8': (3, cv2.COLOR_RGB2GRAY),
    'bgra8': (4, cv2.COLOR_BGRA2GRAY),
    'rgba8': (4, cv2.COLOR_RGBA2GRAY),
}
# OpenCV names a Bayer pattern by the second row from its second pixel on, ROS from the corner.
# [derived: the documentation of both]
_BAYER = {
    'bayer_rggb': cv2.COLOR_BayerBG2GRAY,
    'bayer_bggr': cv2.COLOR_BayerRG2GRAY,
    'bayer_gbrg': cv2.COLOR_BayerGR2GRAY,
    'bayer_grbg': cv2.COLOR_BayerGB2GRAY,
}
# Packed YUV 4:2:2: this one of two successive bytes is the luma. [derived: the same]
_PACKED_YUV = {'yuv422_yuy2': 0, 'yuyv': 0, 'yuv422': 1, 'uyvy': 1}
# Planar YUV begins with the whole luma plane. [derived: the same]
_PLANAR_YUV = ('nv21', 'nv12', 'nv24', 'i420', 'yuv420')
# These have one byte per pixel, row by row, from the first byte on: the gray image itself.
# [derived: the same]
_GRAY = ('mono8', '8UC1', *_PLANAR_YUV)

# The pixels of a PNG or JPEG file have these names, by their type and number of channels.
# [derived: the order of the channels in OpenCV]
_ENCODED = {
    ('uint8', 1): 'mono8',
    ('uint8', 3): 'bgr8',
    ('uint8', 4): 'bgra8',
    ('uint16', 1): 'mono16',
    ('uint16', 3): 'bgr16',
    ('uint16', 4): 'bgra16',
}

# These have two bytes per pixel, of which a camera may fill some bits only. [derived: the same]
_GRAY_16 = ('mono16', '16UC1')

# All encodings that are known, in the words of sensor_msgs/Image. [derived: the tables above]
ENCODINGS = (
    'mono8',
    '8UC1',
    *_GRAY_16,
    *_COLOR,
    *(f'{name}8' for name in _BAYER),
    *(f'{name}16' for name in _BAYER),
    *_PACKED_YUV,
    *_PLANAR_YUV,
)


# Pixels of 16 bits are read in the other byte order than that of the message if the roughness of
# the image is then less than this share. [chosen: in the wrong order any image is as rough as
# noise, so that 0.3 to 0.8 would do; smaller values miss images of fine texture]
_OTHER_ORDER = 0.5


def _roughness(pixels: NDArray[np.uint16]) -> float:
    """Mean difference of pixels two columns apart, which have one colour, in sigmas."""
    rows = pixels[::_STRIDE].astype(np.float32)
    sigma = float(np.std(rows))
    steps = np.abs(rows[:, 2:] - rows[:, :-2])
    return float(np.mean(steps)) / sigma if sigma > 0.0 else 0.0


class Pixels(NamedTuple):
    """An image (H, W) or (H, W, C), and its encoding as in sensor_msgs/Image."""

    values: NDArray[Any]
    encoding: str


@dataclass(frozen=True, slots=True, eq=False)
class RawImage:
    """A sensor_msgs/Image, not decoded: `height` rows of `step` bytes each in `data` (K,)."""

    data: Bytes
    encoding: str
    width: int
    height: int
    step: int
    is_bigendian: bool
    stamp_ns: int = 0  # this and frame_id: of the header
    frame_id: str = ''

    is_png: ClassVar[bool] = False

    @classmethod
    def of_gray(
        cls,
        image: Image,
        stamp_ns: int,
        frame_id: str = '',
    ) -> Self:
        """A mono8 image of an array (H, W)."""
        height, width = image.shape
        return cls(
            np.ascontiguousarray(image).ravel(),
            'mono8',
            width,
            height,
            width,
            False,
            stamp_ns,
            frame_id,
        )

    @property
    def size(self) -> tuple[int, int]:
        """Width and height [px] by the header; not checked yet."""
        return self.width, self.height

    def decoded(self, levels: GrayLevels | None = None) -> Image:
        """Gray image (H, W); a view of `data` for mono8 without padding.

        `levels`: of the camera's images so far, for pixels of 16 bits; None: of this one.
        """
        levels = levels or GrayLevels()
        encoding = self.encoding
        if encoding in _GRAY:
            return self._rows(1)
        if encoding in _GRAY_16:
            return levels.gray(self._two_bytes())
        if encoding in _COLOR:
            return np.asarray(cv2.cvtColor(self._colors(), _COLOR[encoding][1]), dtype=np.uint8)
        if encoding in _PACKED_YUV:
            return np.ascontiguousarray(self._rows(2)[:, _PACKED_YUV[encoding] :: 2])
        if encoding in ENCODINGS:
            return self._from_bayer(levels)
        raise InputError(
            f'image encoding {encoding[:40]!r} is not known; publish one of {", ".join(ENCODINGS)}'
        )

    def pixels(self, levels: GrayLevels | None = None) -> Pixels:
        """The image in its own encoding; gray, as `decoded`, for Bayer and YUV."""
        if self.encoding in _COLOR:
            return Pixels(self._colors(), self.encoding)
        if self.encoding in _GRAY_16:
            return Pixels(self._two_bytes().astype(np.uint16), self.encoding)
        return Pixels(self.decoded(levels), 'mono8')

    def _from_bayer(self, levels: GrayLevels) -> Image:
        if self.height < 3 or self.width < 3:
            raise InputError(f'a Bayer image must be at least 3x3, got {self.width}x{self.height}')
        has_two_bytes = self.encoding.endswith('16')
        mosaic = levels.gray(self._two_bytes()) if has_two_bytes else self._rows(1)
        pattern = self.encoding.removesuffix('16').removesuffix('8')
        return np.asarray(cv2.cvtColor(mosaic, _BAYER[pattern]), dtype=np.uint8)

    def _two_bytes(self) -> NDArray[np.uint16]:
        """Pixels of 16 bits, in the byte order of the message."""
        rows = self._rows(2)
        pixels = rows.view('<u2')
        swapped = rows.view('>u2')
        if self.is_bigendian:
            pixels, swapped = swapped, pixels
        # Some drivers name the other order.
        if self.width > 2 and _roughness(swapped) < _OTHER_ORDER * _roughness(pixels):
            return swapped
        return pixels

    def _colors(self) -> Bytes:
        channels = _COLOR[self.encoding][0]
        return self._rows(channels).reshape(self.height, self.width, channels)

    def _rows(self, bytes_per_pixel: int) -> Bytes:
        """Array (height, bytes of a row) of the data without padding; a view if there is none."""
        check_image_size(self.width, self.height)
        height = self.height
        step = self.step
        row_bytes = bytes_per_pixel * self.width
        if step < row_bytes:
            raise InputError(
                f'image step is {step} bytes, but a row of {self.width} px in '
                f'{self.encoding} has {row_bytes}'
            )
        needed = step * (height - 1) + row_bytes
        if len(self.data) < needed:
            raise InputError(
                f'image has {len(self.data)} bytes of data, but {self.width}x{height} in '
                f'{self.encoding} with step {step} needs {needed}'
            )
        return np.ascontiguousarray(
            np.lib.stride_tricks.as_strided(
                self.data, shape=(height, row_bytes), strides=(step, 1), writeable=False
            )
        )


@dataclass(frozen=True, slots=True, eq=False)
class CompressedImage:
    """A sensor_msgs/CompressedImage: a JPEG or PNG file in `data` (K,), `encoding` its format."""

    data: Bytes
    encoding: str
    stamp_ns: int = 0  # as of `RawImage`
    frame_id: str = ''

    @property
    def size(self) -> tuple[int, int]:
        """Width and height [px] by the file's header; not checked yet."""
        return encoded_image_size(self.data)

    @property
    def is_png(self) -> bool:
        """Whether it is a PNG file, which is lossless."""
        return self.data[: len(_PNG_SIGNATURE)].tobytes() == _PNG_SIGNATURE

    def decoded(self, levels: GrayLevels | None = None) -> Image:
        """Gray image (H, W); `levels` as of `RawImage.decoded`."""
        # EXIF orientation is ignored: rows must stay in the order of the readout.
        image = _decoded(
            self.data, cv2.IMREAD_GRAYSCALE | cv2.IMREAD_IGNORE_ORIENTATION | cv2.IMREAD_ANYDEPTH
        )
        if image.dtype == np.uint16:
            return (levels or GrayLevels()).gray(image)
        return np.asarray(image, dtype=np.uint8)

    def pixels(self, levels: GrayLevels | None = None) -> Pixels:
        """The image in colour or gray, 8 or 16 bits, as encoded; `levels` is not used."""
        image = _decoded(self.data, cv2.IMREAD_UNCHANGED)
        channels = 1 if image.ndim == 2 else image.shape[2]
        encoding = _ENCODED.get((image.dtype.name, channels))
        if encoding is None:
            raise InputError(
                f'compressed image has {channels} channels of {image.dtype.name}: '
                f'publish one of {", ".join(_ENCODED.values())}'
            )
        return Pixels(image, encoding)


def _decoded(
    data: Bytes,
    flags: int,
) -> NDArray[Any]:
    """Pixels of a JPEG or PNG file; `flags` of cv2.imdecode."""
    width, height = encoded_image_size(data)
    check_image_size(width, height)
    try:
        image = cv2.imdecode(data, flags)
    except cv2.error:
        image = None
    if image is None or image.shape[:2] != (height, width):
        raise InputError(f'compressed image of {len(data)} bytes cannot be decoded: it is corrupt')
    return np.asarray(image)


EncodedImage = RawImage | CompressedImage


def check_image_size(
    width: int,
    height: int,
) -> None:
    """Raise InputError for an impossible size."""
    sides = 0 < width <= MAX_IMAGE_SIDE and 0 < height <= MAX_IMAGE_SIDE
    if not sides or width * height > MAX_IMAGE_PIXELS:
        raise InputError(
            f'image size {width}x{height} is not usable: sides must be 1 to '
            f'{MAX_IMAGE_SIDE} px and the area at most {MAX_IMAGE_PIXELS} px'
        )


def checked(
    image: Image,
    shape: tuple[int, ...] | None,
) -> Image:
    """The input of a tracker, as a contiguous (H, W) array of uint8; InputError if it is not.

    Read-only, as the memory of a raw image is, so that kernels are compiled for one type only.
    `shape` is that of the previous images: a stream has one size.
    """
    image = np.ascontiguousarray(image)
    if image.ndim != 2 or image.dtype != np.uint8 or image.size == 0:
        raise InputError(
            f'image must be (H, W) of uint8 and not empty, got {image.shape} of {image.dtype}'
        )
    if shape is not None and image.shape != shape:
        raise InputError(
            f'image size changed from {shape[1]}x{shape[0]} to {image.shape[1]}x{image.shape[0]} '
            'in mid-stream: reset the tracker first'
        )
    image = image.view()
    image.flags.writeable = False
    return image
