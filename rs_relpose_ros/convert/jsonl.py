"""Recordings with a line of JSON for each event: data.jsonl beside a video.

The format of Spectacular AI's recorders (github.com/SpectacularAI/docs, other/DATA_FORMAT.md)::

    data.mp4 (or .mov, .mkv)   the frames
    data.jsonl                 {"time": s, "number": n, "frames": [{"cameraInd": 0, ...}]}
                               {"time": s, "sensor": {"type": "gyroscope", "values": [x, y, z]}}
                               and accelerometer; rad/s, m/s^2
    calibration.json           cameras: focalLengthX, ..., model, distortionCoefficients,
                               imuToCamera (4x4), imageWidth, imageHeight
"""

from __future__ import annotations

from collections.abc import Sequence
from decimal import Decimal
from pathlib import Path
from typing import Any

import numpy as np
from scipy.spatial.transform import Rotation

from rs_relpose_ros.config.parameter_file import SourcedValue
from rs_relpose_ros.convert import phone
from rs_relpose_ros.convert.json_files import read_lines, read_object
from rs_relpose_ros.convert.recording import by_stamp, Conversion, Recording
from rs_relpose_ros.convert.video_frames import IMAGE_FORMAT, Video
from rs_relpose_ros.errors import InputError, MissingInputError
from rs_relpose_ros.geometry.camera import RollingShutterCamera
from rs_relpose_ros.geometry.timing import NANOSECONDS
from rs_relpose_ros.imu.samples import ImuSample, Vector

FILES = ('data.jsonl',)

_VIDEOS = ('data.mp4', 'data.mov', 'data.mkv')
_SENSORS = ('gyroscope', 'accelerometer')
# Times may begin anywhere, also below 0, where stamps cannot be.
_START_NS = 1000 * NANOSECONDS
# model -> name and numbers of coefficients of it here.
_MODELS = {'pinhole': ('plumb_bob', (0, 3)), 'brown-conrady': ('plumb_bob', (0, 3, 4, 5, 8)),
           'kannala-brandt4': ('equidistant', (4,))}


def read_conversion(folder: Path) -> Conversion:
    """Frames of the first camera, and the IMU."""
    times_ns, samples = _events(folder / 'data.jsonl')
    path = next((folder / name for name in _VIDEOS if (folder / name).is_file()), None)
    if path is None:
        raise MissingInputError(f'{folder} has no video: {" or ".join(_VIDEOS)}')
    video = Video(path)
    phone.refuse_portrait(path, video.width, video.height)
    if len(times_ns) != len(video):
        raise InputError(f'{folder / "data.jsonl"} has {len(times_ns)} frames, but {path} has '
                         f'{len(video)}: which of them belong together cannot be told')
    camera, rotation = _calibration(folder / 'calibration.json', video)
    return Conversion(
        Recording(camera=camera, images=video.frames(times_ns), image_format=IMAGE_FORMAT,
                  imu=samples['gyroscope'], accel=samples['accelerometer']),
        f'Parameters of relpose_node for {folder.name} (`rs_relpose convert android`): recorded '
        'as data.jsonl. The read-out time, `rs_relpose calibrate` finds.',
        (phone.COMPRESSED, phone.STAMP_ROW, phone.TIME_OFFSET_NOT_KNOWN, rotation))


def _events(path: Path) -> tuple[list[int], dict[str, tuple[ImuSample, ...]]]:
    """Stamps of the frames [ns], and samples by sensor."""
    frames: list[tuple[int, int]] = []
    samples: dict[str, list[ImuSample]] = {name: [] for name in _SENSORS}
    for where, event in read_lines(path):
        sensor = event.get('sensor')
        kind = sensor.get('type') if isinstance(sensor, dict) else None
        if 'frames' in event:
            number = event.get('number')
            if not isinstance(number, int):
                raise InputError(f'{where}: number must be that of the frame')
            frames.append((number, _stamp_ns(event, where)))
        elif isinstance(sensor, dict) and kind in samples:
            value, stamp_ns = _vector(sensor.get('values'), where), _stamp_ns(event, where)
            samples[kind].append(ImuSample(stamp_ns, value, None) if kind == 'gyroscope'
                                 else ImuSample(stamp_ns, None, value))
    return ([stamp_ns for _, stamp_ns in sorted(frames)],
            {name: by_stamp(found) for name, found in samples.items()})


def _stamp_ns(event: dict[str, Any], where: str) -> int:
    time: Any = event.get('time')
    if not isinstance(time, int | Decimal) or not -2**31 < time < 2**31:
        raise InputError(f'{where}: time must be in seconds, got {str(time)[:40]!r}')
    stamp_ns = _START_NS + round(time * NANOSECONDS)
    if stamp_ns < 0:
        raise InputError(f'{where}: time must not be below {-_START_NS // NANOSECONDS} s')
    return stamp_ns


def _vector(values: Any, where: str) -> Vector:
    if not isinstance(values, list) or len(values) != 3 or not all(
            isinstance(value, int | Decimal) and -10**9 < value < 10**9 for value in values):
        raise InputError(f'{where}: values must be three numbers')
    x, y, z = map(float, values)
    return x, y, z


def _calibration(path: Path, video: Video) -> tuple[RollingShutterCamera | None, SourcedValue]:
    """Camera and rotation from IMU to camera, as far as the file has them."""
    if not path.is_file():
        return None, phone.axes(None)
    cameras = read_object(path).get('cameras')
    if not isinstance(cameras, list) or not cameras or not isinstance(cameras[0], dict):
        raise InputError(f'{path} must have a list of cameras')
    try:
        return (_camera(cameras[0], video.width, video.height),
                _rotation(cameras[0].get('imuToCamera', cameras[0].get('imuToCameraMatrix'))))
    except (KeyError, TypeError, ValueError) as error:
        raise InputError(f'{path}: {error}') from error


def _camera(found: dict[str, Any], width: int, height: int) -> RollingShutterCamera:
    model, counts = _MODELS[found['model']]
    coefficients: Sequence[float] = found.get('distortionCoefficients') or ()
    if len(coefficients) not in counts:
        raise InputError(f'{found["model"]} has {len(coefficients)} coefficients')
    if (found['imageWidth'], found['imageHeight']) != (width, height):
        raise InputError(f'the calibration is for {found["imageWidth"]}x{found["imageHeight"]}, '
                         f'but the video has {width}x{height}')
    if model == 'plumb_bob' and len(coefficients) == 3:   # radial ones only
        coefficients = (coefficients[0], coefficients[1], 0.0, 0.0, coefficients[2])
    # Read-out time 0: the format has none, and calibrate finds it.
    return RollingShutterCamera(
        width=width, height=height, fx=found['focalLengthX'], fy=found['focalLengthY'],
        cx=found['principalPointX'], cy=found['principalPointY'], distortion_model=model,
        distortion=tuple(coefficients), readout_time=0.0)


def _rotation(matrix: object) -> SourcedValue:
    if matrix is None:
        return phone.axes(None)
    rotation = Rotation.from_matrix(np.asarray(matrix, dtype=np.float64)[:3, :3])
    x, y, z, w = (round(float(value), 8) for value in rotation.as_quat())
    return SourcedValue('quat_cam_imu_xyzw', (x, y, z, w), 'imuToCamera of calibration.json.')
