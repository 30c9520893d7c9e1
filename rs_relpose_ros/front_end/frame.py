"""An image with its stamp and the calibration in force."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from rs_relpose_ros.errors import InputError
from rs_relpose_ros.geometry.intrinsics import Intrinsics


@dataclass(frozen=True, slots=True, eq=False)
class Frame:
    """A gray image.

    Parameters
    ----------
    stamp_ns : int
        Header stamp.
    image : (H, W) ndarray of uint8
        As published: not rectified, not resized.
    frame_id : str
    calibration : Intrinsics

    Raises
    ------
    InputError
        The image is not of the size that the calibration tells.
    """

    stamp_ns: int
    image: NDArray[np.uint8]
    frame_id: str
    calibration: Intrinsics

    def __post_init__(self) -> None:
        if self.image.dtype != np.uint8 or self.image.ndim != 2:
            raise InputError('image must be (H, W) of uint8, '
                             f'got {self.image.shape} of {self.image.dtype}')
        expected = (self.calibration.image_height, self.calibration.image_width)
        if self.image.shape != expected:
            raise InputError(
                f'image is {self.image.shape[1]}x{self.image.shape[0]}, but its CameraInfo tells '
                f'{expected[1]}x{expected[0]}: publish a CameraInfo of the same size (region of '
                'interest and binning included)')

    def decoded(self) -> Frame:
        """This frame; as in `EncodedFrame`."""
        return self


@dataclass(frozen=True, slots=True, eq=False)
class EncodedFrame:
    """A frame whose image is decoded only once the frame's turn has come.

    Parameters
    ----------
    stamp_ns, frame_id, calibration
        As in `Frame`.
    decode : callable
        Returns the (H, W) gray image; raises InputError where that is not possible.
    """

    stamp_ns: int
    frame_id: str
    calibration: Intrinsics
    decode: Callable[[], NDArray[np.uint8]]

    def decoded(self) -> Frame:
        """The frame with its image."""
        return Frame(self.stamp_ns, self.decode(), self.frame_id, self.calibration)
