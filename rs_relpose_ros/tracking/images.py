"""Checks and pyramids of the images that a tracker gets."""

from __future__ import annotations

import cv2
import numpy as np
from numpy.typing import NDArray

from rs_relpose_ros.errors import InputError

Image = NDArray[np.uint8]


def checked(image: Image, shape: tuple[int, ...] | None) -> Image:
    """`image` as a contiguous (H, W) array of uint8 of the expected shape.

    Raises
    ------
    InputError
        It is of another type, or of another size than the images before.
    """
    image = np.ascontiguousarray(image)
    if image.ndim != 2 or image.dtype != np.uint8 or image.size == 0:
        raise InputError('image must be (H, W) of uint8 and not empty, '
                         f'got {image.shape} of {image.dtype}')
    if shape is not None and image.shape != shape:
        raise InputError(
            f'image size changed from {shape[1]}x{shape[0]} to {image.shape[1]}x{image.shape[0]} '
            'in mid-stream: reset the tracker first')
    return image


def pyramid(image: Image, levels: int, padding: int) -> list[Image]:
    """`image` and its halved versions, whose pixel i lies at pixel 2 i of the one before.

    The halved ones have a mirrored border of `padding` pixels, so that the large areas that their
    windows cover need not lie inside of the image. Levels with a side below 4 `padding` are left
    out, but for the image itself, which has no border.
    """
    images = [image]
    while len(images) < levels and min(image.shape) >= 8 * padding:
        image = cv2.pyrDown(image)  # type: ignore[assignment]
        images.append(cv2.copyMakeBorder(  # type: ignore[arg-type]
            image, padding, padding, padding, padding, cv2.BORDER_REFLECT_101))
    return images
