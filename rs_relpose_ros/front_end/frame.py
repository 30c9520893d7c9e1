"""An image with its stamp and the intrinsics in force, before and after decoding; its camera."""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from typing import Any, Protocol, TypeVar

import numpy as np
from numpy.typing import NDArray

from rs_relpose_ros.config.parameters import Parameters, SensorConfig
from rs_relpose_ros.errors import InputError, MissingInputError
from rs_relpose_ros.geometry.camera import RollingShutterCamera
from rs_relpose_ros.geometry.intrinsics import Intrinsics
from rs_relpose_ros.geometry.timing import ImageClock
from rs_relpose_ros.images.encoded import EncodedImage
from rs_relpose_ros.images.gray_levels import GrayLevels


class Waiting(Protocol):
    """What the sequencer needs of a frame while it waits for its IMU."""

    @property
    def stamp_ns(self) -> int:
        """Of the header."""

    @property
    def intrinsics(self) -> Intrinsics:
        """Those in force."""


Decoded = TypeVar('Decoded', bound=Waiting)
DecodedCo = TypeVar('DecodedCo', bound=Waiting, covariant=True)


class Decodable(Waiting, Protocol[DecodedCo]):
    """A frame that is decoded only when its turn has come."""

    def decoded(self) -> DecodedCo:
        """The frame with its image; raises InputError where it cannot be decoded."""


@dataclass(frozen=True, slots=True, eq=False)
class Frame:
    """A gray image; raises InputError where it is not of the size that the intrinsics tell."""

    stamp_ns: int   # of the header
    image: NDArray[np.uint8]   # (H, W) as published: not rectified, not resized
    frame_id: str
    intrinsics: Intrinsics

    def __post_init__(self) -> None:
        if self.image.dtype != np.uint8 or self.image.ndim != 2:
            raise InputError('image must be (H, W) of uint8, '
                             f'got {self.image.shape} of {self.image.dtype}')
        check_size(self.image, self.intrinsics)

    def decoded(self) -> Frame:
        """This frame; as in `EncodedFrame`."""
        return self


@dataclass(frozen=True, slots=True, eq=False)
class EncodedFrame:
    """A frame whose image is decoded only when its turn has come; fields as in `Frame`."""

    stamp_ns: int
    image: EncodedImage
    frame_id: str
    intrinsics: Intrinsics
    levels: GrayLevels = field(default_factory=GrayLevels)   # of the camera's images so far

    def decoded(self) -> Frame:
        """The frame with its image; raises InputError where it cannot be decoded."""
        return Frame(self.stamp_ns, self.image.decoded(self.levels), self.frame_id,
                     self.intrinsics)


def check_size(image: NDArray[Any], intrinsics: Intrinsics) -> None:
    """Raise InputError where an image (H, W, ...) is not of the size that the intrinsics tell."""
    height, width = image.shape[:2]
    expected = intrinsics.image_height, intrinsics.image_width
    if (height, width) != expected:
        raise InputError(
            f'image is {width}x{height}, but its CameraInfo tells {expected[1]}x{expected[0]}: '
            'publish a CameraInfo of the same size (region of interest and binning included)')


def sensor_camera(intrinsics: Intrinsics, parameters: Parameters) -> RollingShutterCamera:
    """Camera model of the full sensor; published pixels map to it by `Intrinsics.to_sensor`."""
    sensor = parameters.sensor
    if sensor.readout_time is None:
        raise MissingInputError('parameter readout_time is not set: give image height times line '
                                'delay in seconds (0 for a global shutter)')
    return replace(intrinsics.global_shutter_camera(), readout_time=sensor.readout_time,
                   readout_direction=sensor.readout_direction, reference_row=sensor.stamp_row)


def image_clock(camera: RollingShutterCamera, sensor: SensorConfig) -> ImageClock:
    """Clock of the images of a `sensor_camera`, as told."""
    return ImageClock(
        camera, sensor.time_offset, sensor.stamp_exposure, sensor.exposure_time,
        sensor.time_offset_per_interval, sensor.time_offset_reference_interval)
