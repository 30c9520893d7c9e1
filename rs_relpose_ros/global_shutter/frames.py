"""A frame in its own colours, before it is turned and after."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field
from functools import partial

import cv2
import numpy as np

from rs_relpose_ros.front_end.frame import check_size, Frame
from rs_relpose_ros.geometry.intrinsics import Intrinsics
from rs_relpose_ros.global_shutter.row_map import RowMap
from rs_relpose_ros.images.encoded import CompressedImage, EncodedImage, Pixels
from rs_relpose_ros.images.gray_levels import GrayLevels

_BORDERS = {'replicate': cv2.BORDER_REPLICATE, 'black': cv2.BORDER_CONSTANT}


@dataclass(frozen=True, slots=True, eq=False)
class ColorFrame:
    """An image as published, decoded; raises InputError where its size is not the intrinsics'."""

    stamp_ns: int   # of the header
    pixels: Pixels
    frame_id: str
    intrinsics: Intrinsics
    encoded: EncodedImage
    levels: GrayLevels   # of the camera's images so far

    def __post_init__(self) -> None:
        check_size(self.pixels.values, self.intrinsics)

    def gray(self) -> Frame:
        """The frame as relpose_node gets it, bit by bit."""
        return Frame(self.stamp_ns, self.encoded.decoded(self.levels), self.frame_id,
                     self.intrinsics)

    @property
    def is_png(self) -> bool:
        """Whether it came as a PNG."""
        return isinstance(self.encoded, CompressedImage) and self.encoded.is_png


@dataclass(frozen=True, slots=True, eq=False)
class EncodedColorFrame:
    """A frame whose image is decoded only when its turn has come; fields as in `ColorFrame`."""

    stamp_ns: int
    image: EncodedImage
    frame_id: str
    intrinsics: Intrinsics
    levels: GrayLevels = field(default_factory=GrayLevels)

    def decoded(self) -> ColorFrame:
        """The frame with its image; raises InputError where it cannot be decoded."""
        return ColorFrame(self.stamp_ns, self.image.pixels(self.levels), self.frame_id,
                          self.intrinsics, self.image, self.levels)


def color_frames() -> Callable[[int, EncodedImage, str, Intrinsics], EncodedColorFrame]:
    """What makes the frames of one camera, for `Intake`."""
    return partial(EncodedColorFrame, levels=GrayLevels())


@dataclass(frozen=True, slots=True, eq=False)
class GlobalShutterFrame:
    """A frame as if all of its rows had been seen at the middle row's instant."""

    stamp_ns: int   # of that instant, on the clock that was asked for
    frame: ColorFrame   # as it was read
    map: RowMap
    border: str   # of `BORDERS`
    applied_offset_ns: int   # tracked time offset in the stamp, beyond the parameter's

    def image(self) -> Pixels:
        """The turned image, in the encoding of the frame."""
        values, border = self.frame.pixels.values, _BORDERS[self.border]
        complete, turned = self.map.complete, np.empty_like(values)
        for rows, sources in self.map.bands():
            # None, as the types forbid: OpenCV 5 takes an empty second map for one.
            turned[rows] = cv2.remap(values, sources, None,  # type: ignore[call-overload]
                                     cv2.INTER_LINEAR, borderMode=border)
            if not complete:
                turned[rows][np.isnan(sources[..., 0])] = 0
        return Pixels(turned, self.frame.pixels.encoding)

    def mask(self) -> Pixels:
        """255 where the camera saw what the turned image shows, 0 where its border does."""
        width, height = self.map.width, self.map.height
        mask = np.empty((height, width), dtype=np.uint8)
        for rows, sources in self.map.bands():
            u, v = sources[..., 0], sources[..., 1]
            mask[rows] = np.where((u >= 0.0) & (u <= width - 1.0) & (v >= 0.0)
                                  & (v <= height - 1.0), 255, 0)
        return Pixels(mask, 'mono8')
