"""The registry of distortion models: to add one, write its module and its row here.

Nothing else names a model: camera, calibration and checks take what is registered.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numba
import numpy as np
from numpy.typing import NDArray

from rs_relpose_ros.geometry.distortion import equidistant, rational
from rs_relpose_ros.linked_kernel import KernelInterface

Array = NDArray[np.float64]

# distort_at(address, x, y, k, out) and first_guess_at(address, u, v, out), for compiled code.
_DISTORT = KernelInterface(numba.void, 0.0, 0.0, np.empty(1), np.empty(1))
_FIRST_GUESS = KernelInterface(numba.void, 0.0, 0.0, np.empty(1))
distort_at, first_guess_at = _DISTORT.call, _FIRST_GUESS.call


@dataclass(frozen=True, slots=True)
class DistortionModel:
    """How a lens moves points of the plane z = 1.

    Attributes
    ----------
    name : str
        As in sensor_msgs/CameraInfo.
    coefficient_counts : tuple of int
        Legal numbers of coefficients, in the order of CameraInfo and OpenCV.
    size : int
        Coefficients that `distort` reads; those not given are zero.
    distort : callable
        Kernel ``distort(x, y, k, out)``: writes the distorted point and its derivative,
        `out` (6,) = x', y', and d(x', y')/d(x, y) row by row.
    first_guess : callable
        Kernel ``first_guess(u, v, out)``: writes where the search for the undistorted point
        starts, `out` (>= 2,).
    is_pinhole_at_zero : bool
        Whether coefficients of zero distort nothing.
    """

    name: str
    coefficient_counts: tuple[int, ...]
    size: int
    distort: Callable[[float, float, Array, Array], None]
    first_guess: Callable[[float, float, Array], None]
    is_pinhole_at_zero: bool = True

    @property
    def addresses(self) -> tuple[int, int]:
        """Of the compiled kernels `distort` and `first_guess`."""
        return _DISTORT.address(self.distort), _FIRST_GUESS.address(self.first_guess)

    def padded(self, coefficients: tuple[float, ...]) -> Array:
        """Coefficients as the kernels take them (size,)."""
        k = np.zeros(self.size)
        k[:len(coefficients)] = coefficients
        return k


DISTORTION_MODELS = {model.name: model for model in (
    DistortionModel('plumb_bob', (0, 4, 5, 8), 12, rational.distort, rational.first_guess),
    DistortionModel('rational_polynomial', (8, 12), 12, rational.distort, rational.first_guess),
    DistortionModel('equidistant', (4,), 4, equidistant.distort, equidistant.first_guess,
                    is_pinhole_at_zero=False),
)}
