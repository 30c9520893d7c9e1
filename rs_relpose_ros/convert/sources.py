"""The sources of `rs_relpose convert`: one row each."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from pathlib import Path
from types import ModuleType

from rs_relpose_ros.convert import android, realsense, video, xiaomi
from rs_relpose_ros.convert.recording import Conversion
from rs_relpose_ros.errors import MissingInputError


@dataclass(frozen=True, slots=True)
class Source:
    """Where recordings come from, and how they are read."""

    help: str
    path: str   # 'FILE' or 'FOLDER'
    read: Callable[[Path, Path | None], Conversion]   # path, lens profile
    takes_lens_profile: bool = False

    def conversion(self, path: Path, lens_profile: Path | None = None) -> Conversion:
        """The recording at a path and its parameters."""
        if self.path == 'FOLDER' and not path.is_dir():
            raise MissingInputError(f'there is no folder {path}')
        return self.read(path, lens_profile)


# Public recordings, each with a module: how it is read, and what the node must know of it.
DATASETS: Mapping[str, ModuleType] = {'realsense_rgb_rs': realsense, 'xiaomi_cc9_rs': xiaomi}


def _of_dataset(name: str, description: str) -> Source:
    module = DATASETS[name]
    return Source(description, 'FOLDER', lambda path, _: Conversion(
        module.read_recording(path), module.TITLE, module.PARAMETERS))


SOURCES: Mapping[str, Source] = {
    'video': Source(
        'video of a camera that logs its IMU: GoPro, and whatever else telemetry-parser reads '
        '(pip install telemetry-parser av). Recordings that the camera stabilised are refused.',
        'FILE', video.read_conversion, takes_lens_profile=True),
    'android': Source(
        "folder of a phone's logger, told by its files: " + '; '.join(
            f'{logger.name} ({", ".join(logger.files)})' for logger in android.LOGGERS),
        'FOLDER', lambda path, _: android.read_conversion(path)),
    'realsense_rgb_rs': _of_dataset(
        'realsense_rgb_rs', 'colour camera, gyro and accelerometer of a RealSense, from '
        'github.com/Zoltan3057/DM-VIO-dataset (imu.txt, frames.csv, camera.txt, images/)'),
    'xiaomi_cc9_rs': _of_dataset(
        'xiaomi_cc9_rs', 'phone with gyro, from github.com/lhaippp/gyro-video-stabilization '
        '(gyro.txt, framestamp.txt, images/)'),
}
