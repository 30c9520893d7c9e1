"""Brightness: pixels of 16 bits to gray (sensors fill 10, 12 or 14 bits), and what is dark."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

# Percentiles of an image that become black and white, of every so many pixels in both directions:
# an odd number meets all colours of a Bayer pattern.
_ENDS = (0.5, 99.5)
_STRIDE = 3
# The range is wider than an image by this share on either side, so that the next ones fit, and is
# chosen anew for an image that leaves it, or fills less than this share of it: a new range changes
# the brightness of what is tracked.
_MARGIN = 0.25
_LEAST_FILLED = 0.3
# A range is never narrower than gray has levels: noise of a dark image is not stretched.
_LEAST_RANGE = 255.0

# An image is dark where so many percent of its pixels are below this gray: noise, no contrast.
_DARK_SHARE, _DARK_GRAY = 99.0, 32


class GrayLevels:
    """The range of one camera's pixels that is shown as gray; it goes with the images' content.

    Depends on the images alone, in their order.
    """

    def __init__(self) -> None:
        self._low = self._high = 0.0

    def gray(self, pixels: NDArray[np.uint16]) -> NDArray[np.uint8]:
        """Gray image (H, W) of the next image."""
        low, high = np.percentile(pixels[::_STRIDE, ::_STRIDE], _ENDS)
        if (low < self._low or high > self._high
                or high - low < _LEAST_FILLED * (self._high - self._low) > _LEAST_RANGE):
            spare = _MARGIN * (high - low)
            self._low = max(low - spare, 0.0)
            self._high = max(high + spare, self._low + _LEAST_RANGE)
        scale = 255.0 / (self._high - self._low)
        return np.asarray(np.clip((pixels - np.float32(self._low)) * np.float32(scale), 0.0, 255.0)
                          .astype(np.uint8))


def is_dark(image: NDArray[np.uint8]) -> bool:
    """Whether hardly a pixel of a gray image (H, W) is bright: night, a covered lens."""
    return bool(np.percentile(image[::_STRIDE, ::_STRIDE], _DARK_SHARE) < _DARK_GRAY)
