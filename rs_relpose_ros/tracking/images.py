"""Checks of the images that a tracker gets."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from rs_relpose_ros.errors import InputError

Image = NDArray[np.uint8]


def checked(image: Image, shape: tuple[int, ...] | None) -> Image:
    """`image` as a contiguous (H, W) array of uint8; InputError where it cannot be.

    Read-only, as the memory of a raw image is, so that kernels are compiled for that alone.
    `shape` is that of the images before: a stream has one size.
    """
    image = np.ascontiguousarray(image)
    if image.ndim != 2 or image.dtype != np.uint8 or image.size == 0:
        raise InputError('image must be (H, W) of uint8 and not empty, '
                         f'got {image.shape} of {image.dtype}')
    if shape is not None and image.shape != shape:
        raise InputError(
            f'image size changed from {shape[1]}x{shape[0]} to {image.shape[1]}x{image.shape[0]} '
            'in mid-stream: reset the tracker first')
    image = image.view()
    image.flags.writeable = False
    return image
