"""Lens profiles of Gyroflow: read-out time and calibration of a camera's mode.

github.com/gyroflow/lens_profiles (CC0-1.0) has some 2500, JSON files; used here::

    camera_brand, camera_model              of the camera
    calib_dimension {w, h}                  size that the calibration belongs to [px]
    orig_dimension {w, h}                   size of the video [px]; calib_dimension where absent
    fps, frame_readout_time                 [Hz], [ms]: negative upwards, from 10000 on by columns
    fisheye_params {camera_matrix, distortion_coeffs}     OpenCV's fisheye model
    distortion_model                        another model; absent or opencv_fisheye here
    input_horizontal_stretch, input_vertical_stretch      1 where the pixels are square
"""

from __future__ import annotations

from dataclasses import dataclass
import math
from pathlib import Path
from typing import Any

from rs_relpose_ros.convert.json_files import read_object
from rs_relpose_ros.convert.told_readout import readout_of_milliseconds, ToldReadout
from rs_relpose_ros.errors import InputError, MissingInputError
from rs_relpose_ros.geometry.camera import RollingShutterCamera

_RATE_TOLERANCE = 0.01
_ASPECT_TOLERANCE = 0.01
_LISTED = 5


@dataclass(frozen=True, slots=True)
class VideoMode:
    """What a video says of itself: maker, model, size [px] and mean rate [Hz]."""

    brand: str
    model: str
    width: int
    height: int
    rate: float

    def __str__(self) -> str:
        return f'{self.brand} {self.model}, {self.width}x{self.height} at {self.rate:.2f} Hz'


@dataclass(frozen=True, slots=True)
class LensProfile:
    """Calibration of a camera mode, and its read-out time where the profile has it."""

    path: Path
    camera: RollingShutterCamera   # its read-out time is 0 where the profile has none
    readout: ToldReadout | None


def find_lens_profile(path: Path, mode: VideoMode) -> LensProfile:
    """The profile in a file, or the only one below a folder that is of the video's mode.

    MissingInputError where there is none; InputError where several are, or the file is of images
    of another shape.
    """
    if path.is_file():
        return _profile(path, read_object(path), mode)
    if not path.is_dir():
        raise MissingInputError(f'there is no lens profile {path}')
    fitting = [(file, profile) for file in sorted(path.rglob('*.json'))
               if _is_of(profile := read_object(file), mode)]
    if not fitting:
        raise MissingInputError(f'{path} has no lens profile of {mode}: name the file of one that '
                                'is near enough, or calibrate')
    if len(fitting) > 1:
        names = ', '.join(str(file.relative_to(path)) for file, _ in fitting[:_LISTED])
        raise InputError(f'{path} has {len(fitting)} lens profiles of {mode}, name one of them by '
                         f'its file: {names}{", ..." if len(fitting) > _LISTED else ""}')
    return _profile(*fitting[0], mode)


def _is_of(profile: dict[str, Any], mode: VideoMode) -> bool:
    rate = profile.get('fps')
    return (_plain(profile.get('camera_brand')) == _plain(mode.brand)
            and _plain(profile.get('camera_model')) == _plain(mode.model)
            and any(_size(profile, name) == (mode.width, mode.height)
                    for name in ('orig_dimension', 'calib_dimension'))
            and isinstance(rate, int | float)
            and abs(rate / mode.rate - 1.0) < _RATE_TOLERANCE)


def _profile(path: Path, profile: dict[str, Any], mode: VideoMode) -> LensProfile:
    size = _size(profile, 'calib_dimension')
    matrix, coefficients = _fisheye(profile)
    if size is None or matrix is None or coefficients is None:
        raise InputError(f'{path} is no lens profile: it needs calib_dimension (w, h) and '
                         'fisheye_params (camera_matrix, distortion_coeffs)')
    if profile.get('distortion_model') not in (None, '', 'opencv_fisheye'):
        raise InputError(f'{path}: the distortion model {profile["distortion_model"]!r} is not '
                         "supported: it must be OpenCV's fisheye")
    for name in ('input_horizontal_stretch', 'input_vertical_stretch'):
        if profile.get(name) not in (None, 1, 1.0, 0, 0.0):
            raise InputError(f'{path}: {name} must be 1, got {profile[name]}: the images are '
                             'stretched')
    scale_x, scale_y = mode.width / size[0], mode.height / size[1]
    if abs(scale_x / scale_y - 1.0) > _ASPECT_TOLERANCE:
        raise InputError(f'{path} is for images of {size[0]}x{size[1]}, which have not the shape '
                         f'of the video, {mode.width}x{mode.height}')
    readout_ms = profile.get('frame_readout_time')
    readout = None
    if isinstance(readout_ms, int | float) and math.isfinite(readout_ms):
        readout = readout_of_milliseconds(readout_ms, f'lens profile {path.name}')
    # Pixel centres lie at integer coordinates.
    camera = RollingShutterCamera(
        width=mode.width, height=mode.height, fx=scale_x * matrix[0][0], fy=scale_y * matrix[1][1],
        cx=scale_x * (matrix[0][2] + 0.5) - 0.5, cy=scale_y * (matrix[1][2] + 0.5) - 0.5,
        distortion_model='equidistant', distortion=tuple(coefficients),
        readout_time=readout.seconds if readout else 0.0)
    return LensProfile(path, camera, readout)


def _fisheye(profile: dict[str, Any]) -> tuple[list[list[float]] | None, list[float] | None]:
    """Camera matrix and four coefficients, None where they are not there."""
    parameters = profile.get('fisheye_params')
    if not isinstance(parameters, dict):
        return None, None
    matrix, coefficients = parameters.get('camera_matrix'), parameters.get('distortion_coeffs')
    if not (isinstance(matrix, list) and len(matrix) == 3
            and all(isinstance(row, list) and len(row) == 3 and all(map(_is_number, row))
                    for row in matrix)):
        matrix = None
    if not (isinstance(coefficients, list) and len(coefficients) == 4
            and all(map(_is_number, coefficients))):
        coefficients = None
    return matrix, coefficients


def _size(profile: dict[str, Any], name: str) -> tuple[int, int] | None:
    size = profile.get(name)
    if not isinstance(size, dict):
        return None
    width, height = size.get('w'), size.get('h')
    if isinstance(width, int) and isinstance(height, int) and min(width, height) > 0:
        return width, height
    return None


def _is_number(value: object) -> bool:
    return isinstance(value, int | float) and math.isfinite(value)


def _plain(name: object) -> str:
    """A name without what makers spell differently."""
    return ''.join(filter(str.isalnum, name.casefold())) if isinstance(name, str) else ''
