"""Telemetry of camera videos through telemetry-parser: IMU, read-out time, stabilisation.

github.com/AdrianEddy/telemetry-parser reads GoPro, Sony, Insta360, Canon, Gyroflow's .gcsv beside
a video, and others. It turns the IMU of each to the same axes: x up along the columns of the
image, y to the left, z backwards, so that the camera's are (-y, -x, -z). Checked with GoPro's
HERO5: the turning of its images, and its specific force while it flies faster and faster.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
import math
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from rs_relpose_ros.convert.optional import import_optional
from rs_relpose_ros.convert.told_readout import readout_of_milliseconds, ToldReadout
from rs_relpose_ros.errors import InputError, MissingInputError
from rs_relpose_ros.geometry.timing import to_nanoseconds
from rs_relpose_ros.imu.samples import ImuSample

# v_camera = R v_telemetry.
_R_CAM_TELEMETRY = np.array([[0.0, -1.0, 0.0], [-1.0, 0.0, 0.0], [0.0, 0.0, -1.0]])

# Group, tag and, within a tag of several, the name of a read-out time [ms], and who tells it so.
_READOUTS = (
    ('Default', '0x53524f54', '', "GoPro's SROT"),
    ('Imager', 'FrameReadoutTime', '', 'FrameReadoutTime of the camera'),
    ('Lens', 'Data', 'frame_readout_time', "the camera's own lens profile"),
    ('Default', 'Metadata', 'rolling_shutter_time', "Insta360's rolling_shutter_time"),
    ('Default', 'Metadata', 'frame_readout_time', 'the .gcsv file beside the video'),
)
# A .gcsv names the direction apart; of its four names these are rows upwards, and columns.
_UPWARDS = ('1', '180', 'BottomToTop')
_COLUMNS = ('2', '270', 'LeftToRight', '3', '90', 'RightToLeft')

# Group and tag that tell of stabilisation, its values where there is none, and what to switch off.
_STABILISATION = (
    ('Default', '0x45495345', ('N',), "GoPro's EISE", 'HyperSmooth and horizon levelling'),
    ('Default', '0x45495341', ('N', 'N/A'), "GoPro's EISA",
     'video stabilisation (HyperSmooth) and horizon levelling'),
)


@dataclass(frozen=True, slots=True)
class Telemetry:
    """What a file tells; samples in the camera's axes, stamps from the start of the video."""

    brand: str
    model: str
    gyro: tuple[ImuSample, ...]   # with the accelerometer where it comes at the same rate
    accel: tuple[ImuSample, ...]   # else apart
    readout: ToldReadout | None


def read_telemetry(path: Path, start_ns: int) -> Telemetry:
    """Telemetry of a video whose first frame is stamped `start_ns`.

    MissingInputError where the file has none, or no gyro; InputError where the images are
    stabilised, so that their rows no longer have one instant.
    """
    parser, tags, samples = _parsed(path)
    _refuse_stabilised(path, tags)
    gyro = [(float(sample['timestamp_ms']), sample['gyro'], sample['accl']) for sample in samples
            if sample['gyro'] is not None]
    brand, model = parser.camera or 'unknown camera', parser.model or 'of unknown model'
    if not gyro:
        raise MissingInputError(f'{path} ({brand} {model}) has no gyro that telemetry-parser '
                                'reads')
    times = start_ns + np.array([to_nanoseconds(time * 1e-3) for time, _, _ in gyro])
    rates = _in_camera(np.radians([rate for _, rate, _ in gyro]))
    forces = [force for _, _, force in gyro]
    readout = _readout(tags)
    if all(force is not None for force in forces):
        together = zip(times, rates, _in_camera(forces), strict=True)
        return Telemetry(brand, model, tuple(
            ImuSample(int(time), _vector(rate), _vector(force))
            for time, rate, force in together), (), readout)
    return Telemetry(
        brand, model,
        tuple(ImuSample(int(time), _vector(rate), None)
              for time, rate in zip(times, rates, strict=True)),
        _spread([force for force in forces if force is not None], times), readout)


def _spread(forces: Sequence[Sequence[float]], times: NDArray[np.int64]) -> tuple[ImuSample, ...]:
    """Samples of an accelerometer that has a rate of its own, evenly over the time of the gyro.

    telemetry-parser lists the sensors of a payload side by side, whatever their rates.
    """
    if not forces:
        return ()
    step = (times[-1] - times[0]) / max(len(times) - 1, 1) * len(times) / len(forces)
    return tuple(ImuSample(int(times[0] + round(number * step)), None, _vector(force))
                 for number, force in enumerate(_in_camera(forces)))


def _parsed(path: Path) -> tuple[Any, list[Mapping[str, Any]], list[Mapping[str, Any]]]:
    """The parser, tags by group of each payload, and IMU samples [ms, deg/s, m/s^2]."""
    library = import_optional('telemetry_parser')
    if not path.is_file():
        raise MissingInputError(f'there is no video {path}')
    try:
        parser = library.Parser(str(path))
        return parser, parser.telemetry(), parser.normalized_imu()
    except (OSError, ValueError) as error:
        raise MissingInputError(
            f'{path} has no telemetry that telemetry-parser reads ({error}): it needs the file as '
            "the camera wrote it, or Gyroflow's .gcsv beside it") from error
    except BaseException as error:
        # A panic of the library, which is written in Rust, is no Exception.
        if type(error).__name__ != 'PanicException':
            raise
        raise InputError(f'{path}: telemetry-parser cannot read it: {error}') from error


def _refuse_stabilised(path: Path, tags: Sequence[Mapping[str, Any]]) -> None:
    for group, tag, off, name, switch in _STABILISATION:
        for value in _values(tags, group, tag):
            if str(value).strip() not in off:
                raise InputError(
                    f'{path} is stabilised in the camera ({name} is {value}): each image was '
                    f'warped, and its rows no longer have one instant; switch {switch} off before '
                    'recording')


def _readout(tags: Sequence[Mapping[str, Any]]) -> ToldReadout | None:
    for group, tag, name, source in _READOUTS:
        for value in _values(tags, group, tag):
            told, direction = value, ''
            if name:
                if not isinstance(value, Mapping):
                    continue
                told = value.get(name)
                direction = str(value.get('frame_readout_direction', ''))
            try:
                milliseconds = float(told)
            except (TypeError, ValueError):
                continue
            if direction in _COLUMNS:
                milliseconds = math.copysign(math.inf, milliseconds)
            elif direction in _UPWARDS:
                milliseconds = -milliseconds
            readout = readout_of_milliseconds(milliseconds, source)
            if readout is not None:
                return readout
    return None


def _values(tags: Sequence[Mapping[str, Any]], group: str, tag: str) -> Iterator[Any]:
    for payload in tags:
        if tag in payload.get(group, {}):
            yield payload[group][tag]


def _in_camera(vectors: ArrayLike) -> NDArray[np.float64]:
    return np.asarray(vectors, dtype=np.float64) @ _R_CAM_TELEMETRY.T


def _vector(values: NDArray[np.float64]) -> tuple[float, float, float]:
    x, y, z = (float(value) + 0.0 for value in values)
    return x, y, z
