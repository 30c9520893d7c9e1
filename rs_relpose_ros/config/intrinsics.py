"""Intrinsics of a camera whose CameraInfo has none, named as camera_calibration names them."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
import math
from typing import NamedTuple

from rs_relpose_ros.config.declarations import check_settings, setting
from rs_relpose_ros.errors import InputError, MissingInputError
from rs_relpose_ros.geometry.distortion.models import DISTORTION_MODELS
from rs_relpose_ros.geometry.intrinsics import Intrinsics


class Pinhole(NamedTuple):
    """Focal lengths and principal point [px]."""

    fx: float
    fy: float
    cx: float
    cy: float


def pinhole_of_matrix(name: str, k: Sequence[float]) -> Pinhole:
    """Intrinsics of a camera matrix, row by row; `name` is what an InputError calls it."""
    if len(k) != 9:
        raise InputError(f'{name} must have 9 elements, got {len(k)}')
    if not all(map(math.isfinite, k)):
        raise InputError(f'{name} must be finite, got {list(k)}')
    if any(k[i] != 0.0 for i in (1, 3, 6, 7)) or k[8] != 1.0:
        raise InputError(f'{name} must be [fx 0 cx 0 fy cy 0 0 1], got {list(k)}')
    return Pinhole(k[0], k[4], k[2], k[5])


@dataclass(frozen=True, slots=True)
class IntrinsicsConfig:
    """Intrinsics for a camera that is not calibrated: its CameraInfo has none, or never comes."""

    camera_matrix: tuple[float, ...] | None = setting(
        None, 'intrinsics fx 0 cx 0 fy cy 0 0 1 of the images as published, for a camera whose '
        'CameraInfo is uncalibrated (k[0] = 0) or absent; a calibrated CameraInfo comes first',
        'px', length=9, kind=tuple)
    distortion_model: str = setting(
        'plumb_bob', 'distortion that belongs to camera_matrix',
        choices=tuple(DISTORTION_MODELS))
    distortion_coefficients: tuple[float, ...] | None = setting(
        None, 'its coefficients in the order of OpenCV; no distortion where they are not given',
        kind=tuple)

    def __post_init__(self) -> None:
        check_settings(self)
        if self.given:
            try:
                self.of_image(1, 1)
            except InputError as error:
                raise InputError(f'camera_matrix and its distortion: {error}') from error
        elif self.distortion_coefficients is not None:
            raise InputError('distortion_coefficients belong to a camera_matrix, which is not '
                             'given')

    @property
    def given(self) -> bool:
        """Whether there are intrinsics."""
        return self.camera_matrix is not None

    def of_image(self, width: int, height: int) -> Intrinsics:
        """The intrinsics for images of this size, which are the whole sensor."""
        if self.camera_matrix is None:
            raise MissingInputError('parameter camera_matrix is not set')
        fx, fy, cx, cy = pinhole_of_matrix('camera_matrix', self.camera_matrix)
        return Intrinsics(
            width=width, height=height, fx=fx, fy=fy, cx=cx, cy=cy, image_width=width,
            image_height=height, distortion_model=self.distortion_model,
            distortion=self.distortion_coefficients or ())
