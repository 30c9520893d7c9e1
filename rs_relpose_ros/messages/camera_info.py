"""CameraInfo as drivers fill it, to intrinsics.

Drivers name the same lens differently, pad its coefficients with zeros, and set binning or a
region of interest that the camera matrix has counted already. What has one possible meaning is
read with it, and a warning names the field once; what has none is an error.
"""

from collections.abc import Callable
import functools
import logging
from typing import Any

from rs_relpose_ros.config.settings import pinhole_of_matrix
from rs_relpose_ros.errors import InputError, MissingInputError
from rs_relpose_ros.geometry.camera import Intrinsics
from rs_relpose_ros.geometry.lens import DISTORTION_MODELS
from rs_relpose_ros.tracking import images

_logger = logging.getLogger(__name__)

# The model that ROS assumes where a driver names none. [derived: sensor_msgs/CameraInfo]
_POLYNOMIAL = 'plumb_bob'
# Models of CameraInfo by the names, in lower case, that OpenCV, Kalibr, OpenVINS and drivers
# write. [derived: these projects]
_ALIASES = {
    **dict.fromkeys(('radtan', 'radial-tangential', 'brown', 'brown_conrady'), _POLYNOMIAL),
    **dict.fromkeys(('equi', 'fisheye', 'kannala_brandt', 'kannala_brandt4'), 'equidistant'),
}
# Names of a camera without distortion, as simulators and drivers that rectify write them.
# [derived: these drivers]
_NONE = ('', 'none', 'pinhole', 'perspective')
# Size of OpenCV's vector k1 k2 p1 p2 k3. [derived: OpenCV's order of coefficients]
_PLUMB_BOB = 5
# Size of the vector that goes on to k6. [derived: the same]
_RATIONAL = 8
# Size of the vector that goes on to the coefficients of a thin prism. [derived: the same]
_PRISM = 12
# Size of the vector that goes on to the two angles of a tilted sensor. [derived: the same]
_TILTED = 14
# Largest distance of a principal point from the centre, as a share of the image's side, of a
# matrix that belongs to the image. The contradiction shows if only one of two meanings fulfils
# it. [chosen: real cameras have less than 0.1, and at a binning of 2 the wrong meaning has 0.25]
_OFF_CENTRE = 0.2
# Distance of both coordinates of a principal point from the centre, as a share of the side, from
# which a matrix is that of another resolution. A larger one misses factors below 1.5, a smaller
# one refuses cameras whose lens is not centred. [chosen: real cameras have less than 0.1, a factor
# of 1.33 has 0.17]
_OTHER_RESOLUTION = 0.15
# Largest difference of the two ratios of such a principal point and the sides, relative to them.
# A larger one refuses images that were cropped at two sides. [chosen: twice what an off-centre
# lens of 0.05 of the side makes of equal ones]
_SAME_FACTOR = 0.2


Warn = Callable[[str], object]


@functools.lru_cache(maxsize=64)
def _warn_once(text: str) -> None:
    _logger.warning('%s', text)


def intrinsics_from_info(msg: Any, warn: Warn = _warn_once) -> Intrinsics:
    """Intrinsics of a CameraInfo, region of interest and binning included; MissingInputError.

    `warn` gets a text on a region or a binning that contradicts size and camera matrix.
    """
    k = _floats(msg, 'k')
    if len(k) == 9 and k[0] == 0.0:
        raise MissingInputError(
            'the camera is uncalibrated (k[0] of its CameraInfo is 0): calibrate it and let its '
            'driver publish the result, or give camera_matrix'
        )
    pinhole = pinhole_of_matrix('k of CameraInfo', k)
    images.check_image_size(int(msg.width), int(msg.height))
    model, distortion = lens_of(str(msg.distortion_model)[:40], tuple(_floats(msg, 'd')))
    return Intrinsics(
        **_part_of_sensor(msg, pinhole['cx'], pinhole['cy'], warn),
        **pinhole,
        distortion_model=model,
        distortion=distortion,
    )


def _floats(msg: Any, name: str) -> list[float]:
    return [float(value) for value in info_field(msg, name)]


def info_field(msg: Any, name: str) -> Any:
    """A field of a CameraInfo that has a capital name in ROS 1."""
    return getattr(msg, name if hasattr(msg, name) else name.upper())


def _part_of_sensor(msg: Any, cx: float, cy: float, warn: Warn) -> dict[str, int]:
    """Sizes of sensor and image, region and binning, for `Intrinsics`.

    The principal point (cx, cy) [px] shows whether the camera matrix is that of the sensor, as
    CameraInfo defines it, or already that of the image.
    """
    width = int(msg.width)
    height = int(msg.height)
    # 0 in these fields means "not set": no binning, and the full sensor.
    binning_x = max(int(msg.binning_x), 1)
    binning_y = max(int(msg.binning_y), 1)
    roi = msg.roi
    x_offset = int(roi.x_offset)
    y_offset = int(roi.y_offset)
    roi_width = int(roi.width) or width
    roi_height = int(roi.height) or height
    whole = (roi_width, roi_height) == (width, height)
    of_sensor = _is_central(cx, width) and _is_central(cy, height)
    binned = width // binning_x, height // binning_y
    if whole and (x_offset or y_offset) and of_sensor:
        warn(
            f'CameraInfo has a region of interest at ({x_offset}, {y_offset}) with the size of '
            f'the whole image, {width}x{height}: size and camera matrix are taken as those of '
            'the region; have the driver clear roi, or set the size of the sensor'
        )
        x_offset = y_offset = 0
    elif whole and not of_sensor and _is_central(cx, binned[0]) and _is_central(cy, binned[1]):
        warn(
            f'CameraInfo has a binning of {binning_x}x{binning_y} and a size of {width}x{height}, '
            f'but its principal point ({cx:.1f}, {cy:.1f}) is that of the image of '
            f'{binned[0]}x{binned[1]}: the camera matrix is taken as that of the image; have the '
            'driver scale it, or clear binning'
        )
        width, height = roi_width, roi_height = binned
        binning_x = binning_y = 1
    elif whole:
        _refuse_other_resolution(
            cx / width, cy / height, f'{width}x{height}', f'{cx:.1f}, {cy:.1f}'
        )
    return {
        'width': width,
        'height': height,
        'x_offset': x_offset,
        'y_offset': y_offset,
        'binning_x': binning_x,
        'binning_y': binning_y,
        'image_width': roi_width // binning_x,
        'image_height': roi_height // binning_y,
    }


def _refuse_other_resolution(x: float, y: float, size: str, centre: str) -> None:
    """InputError for a principal point at shares (x, y) of the sides that one factor explains."""
    mean = 0.5 * (x + y)
    least = min(abs(x - 0.5), abs(y - 0.5))
    if least < _OTHER_RESOLUTION or abs(x - y) > _SAME_FACTOR * mean:
        return
    raise InputError(
        f'the camera matrix of CameraInfo is that of another resolution: its principal point '
        f'({centre}) is that of images about {2.0 * mean:.2g} times as large as {size}; have the '
        'driver publish the CameraInfo of this resolution, or give camera_matrix; of a cropped '
        'image, set roi'
    )


def _is_central(centre: float, size: int) -> bool:
    return size > 0 and abs(centre / size - 0.5) < _OFF_CENTRE


def lens_of(model: str, coefficients: tuple[float, ...]) -> tuple[str, tuple[float, ...]]:
    """Model of `DISTORTION_MODELS` and its coefficients, from the name and vector of others."""
    name = model.strip().lower()
    name = _ALIASES.get(name, name)
    given = len(coefficients)
    # Zeros behind the last coefficient that is not zero change nothing.
    nonzero = [k for k, value in enumerate(coefficients) if value != 0.0]
    used = nonzero[-1] + 1 if nonzero else 0
    if name in _NONE:
        if used:
            raise InputError(
                f'CameraInfo has the distortion model {model!r} and {given} coefficients: the '
                f'model must be one of {", ".join(DISTORTION_MODELS)}'
            )
        _warn_once(f'CameraInfo has the distortion model {model!r}: no distortion is assumed')
        return _POLYNOMIAL, ()
    if name not in DISTORTION_MODELS:
        return model, coefficients  # refused by its name
    counts = DISTORTION_MODELS[name].coefficient_counts
    if given in counts:
        return name, coefficients
    if name == 'equidistant':
        return name, coefficients[: max(used, *counts)]
    if given == _TILTED and used > _PRISM:
        raise InputError(
            'coefficients 13 and 14 of CameraInfo tilt the sensor, which is not supported: '
            'calibrate without CALIB_TILTED_MODEL'
        )
    if name == _POLYNOMIAL and used <= _PLUMB_BOB < given:
        return name, coefficients[:_PLUMB_BOB]
    if given in (_PRISM, _TILTED):
        return 'rational_polynomial', coefficients[:_PRISM]
    if name != _POLYNOMIAL and given == _PLUMB_BOB:
        return name, coefficients + (0.0,) * (_RATIONAL - given)
    return name, coefficients
