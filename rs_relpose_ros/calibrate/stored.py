"""The calibration of a node: its progress, and the file that stores it with its camera."""

from dataclasses import dataclass, field
from datetime import datetime
import math
import os
from pathlib import Path
import re
from typing import Any

from rs_relpose_ros.calibration.findings import Code
from rs_relpose_ros.calibration.findings_text import with_sigma
from rs_relpose_ros.config.files import file_values, read_parameters
from rs_relpose_ros.config.settings import StoredCalibrationConfig
from rs_relpose_ros.errors import InputError
from rs_relpose_ros.output_files import written

# Section of the file that identifies the camera; rclpy ignores it, as no node has this name.
# [derived: interface of the file]
_SECTION = 'rs_relpose_calibration'
# Characters of a camera's name that its file name does not keep, such as slashes. [chosen: what is
# legal in file names everywhere]
_ILLEGAL = re.compile(r'[^\w.-]+')


@dataclass(frozen=True, slots=True)
class CameraId:
    """Name and image size [px] of a camera.

    `topic` is the topic of its images, which distinguishes cameras of one name. It is '' if the
    user has named the camera.
    """

    name: str
    width: int
    height: int
    topic: str = ''


@dataclass(frozen=True, slots=True)
class Progress:
    """State of a calibration that goes on."""

    text: str
    share: float = 0.0  # share of the quantities that are known well enough
    # Each quantity's value with its sigma and what is missing, in words.
    values: dict[str, str] = field(default_factory=dict)


@dataclass(frozen=True, slots=True)
class Calibrated:
    """A calibration that a node can use: the text of its parameter file."""

    camera: CameraId
    parameters: str
    summary: str
    new: bool = True  # whether it is not in its file yet


def path_of(config: StoredCalibrationConfig, camera: CameraId) -> Path:
    """File of a camera's calibration, in the folder that camera_info_manager uses for CameraInfo.

    InputError if there is no home directory.
    """
    if config.calibration_file:
        return Path(config.calibration_file).expanduser()
    try:
        home = Path(os.environ.get('ROS_HOME') or Path.home() / '.ros')
    except RuntimeError as error:  # HOME is not set, and the user has no entry
        raise InputError(
            'there is no home directory for the calibration: set HOME or ROS_HOME, '
            'or give calibration_file'
        ) from error
    name = _ILLEGAL.sub('_', camera.name) or 'camera'
    return home / 'rs_relpose' / f'{name}_{camera.width}x{camera.height}.yaml'


def save(path: Path, camera: CameraId, parameters: str, *, replace: bool = True) -> None:
    """Write a parameter file with its camera; InputError if it cannot be written.

    A file that is damaged or of another camera stays unless `replace`.
    """
    if not replace and path.is_file():
        try:
            load(path, camera)
        except InputError as error:
            raise InputError(
                f'{error}. It is kept, and the new calibration is not stored: '
                '~/save_calibration would replace it'
            ) from error
    name = camera.name.replace("'", "''")
    text = (
        f"{parameters}{_SECTION}:\n  ros__parameters:\n    camera_name: '{name}'\n"
        f'    image_width: {camera.width}\n    image_height: {camera.height}\n'
        f"    image_topic: '{camera.topic}'\n"
        f"    date: '{datetime.now().astimezone().date().isoformat()}'\n"
    )
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        with written(path) as file:
            file.write(text)
    except OSError as error:
        raise InputError(
            f'the calibration cannot be stored in {path}: {error.strerror}; give '
            'another calibration_file'
        ) from error


def load(path: Path, camera: CameraId) -> tuple[dict[str, Any], str]:
    """Read a stored calibration: its parameters by name, and in words its date and sigmas.

    InputError if the file is damaged, or of another camera or image size.
    """
    try:
        own = file_values(path, _SECTION)
        values = file_values(path)
        read_parameters(path)  # a name or value that was edited by hand may be illegal
    except OSError as error:
        raise InputError(f'{path} cannot be read: {error.strerror}') from error
    if not {'camera_name', 'image_width', 'image_height', 'date'} <= own.keys():
        raise InputError(f'{path} is no stored calibration: it has no section {_SECTION}')
    of = CameraId(own['camera_name'], own['image_width'], own['image_height'], camera.topic)
    topic = own.get('image_topic')
    if topic and camera.topic and camera.topic != topic:
        raise InputError(
            f'{path} is of the images on {topic}, not on {camera.topic}, which have '
            'the same frame_id: give each camera_name, or that of this file'
        )
    if of != camera:
        raise InputError(
            f'{path} is for the camera {of.name!r} of {of.width}x{of.height}, not '
            f'for {camera.name!r} of {camera.width}x{camera.height}'
        )
    known = []
    for name in ('readout_time', 'time_offset'):
        if f'{name}_sigma' in values:
            text = with_sigma(Code(name), values[name], values[f'{name}_sigma'])
            known.append(f'{name.replace("_", " ")} {text}')
    if 'axes_sigma' in values:
        known.append(f'axes +- {math.degrees(values["axes_sigma"]):.2f} deg')
    return values, f'{own["date"]} ({", ".join(known)})'
