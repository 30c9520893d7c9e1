"""Public recordings for `rs_relpose convert`: how they are read, and the node's parameters."""

from collections.abc import Iterable
from pathlib import Path
import re

import yaml

from rs_relpose_ros.bags.convert import recording, text_files
from rs_relpose_ros.config.files import SourcedValue
from rs_relpose_ros.errors import InputError, MissingInputError
from rs_relpose_ros.geometry.camera import RollingShutterCamera
from rs_relpose_ros.imu.buffer import ImuSample


def packaged(name: str) -> tuple[str, tuple[SourcedValue, ...]]:
    """Title and values, with their sources, of a parameter file in `recordings`."""
    text = (Path(__file__).parent / 'recordings' / f'{name}.yaml').read_text(encoding='utf-8')
    head, body = text.split('/**:\n  ros__parameters:\n')
    return _prose(head), tuple(
        SourcedValue(
            parameter, tuple(value) if isinstance(value, list) else value, _prose(comment)
        )
        for comment, parameter, word in re.findall(r'((?: +#.*\n)+) +(\w+): (.*)\n', body)
        for value in [yaml.safe_load(word)]
    )


def _prose(comment: str) -> str:
    return ' '.join(re.findall(r'# (.*)', comment))


def _readout_time(parameters: Iterable[SourcedValue]) -> float:
    return float(str(next(item.value for item in parameters if item.name == 'readout_time')))


# Names of the images of the data set, with their numbers.
_XIAOMI_IMAGE = re.compile(r'RE_frame-([0-9]{1,6})\.jpg')


def ordered_samples(samples: Iterable[ImuSample]) -> tuple[ImuSample, ...]:
    """Samples by stamp, exact duplicates once."""
    by_stamp: dict[int, ImuSample] = {}
    for sample in samples:
        if by_stamp.setdefault(sample.stamp_ns, sample) != sample:
            raise InputError(f'two IMU samples of the stamp {sample.stamp_ns} ns differ')
    return tuple(by_stamp[stamp_ns] for stamp_ns in sorted(by_stamp))


def read_realsense(folder: Path) -> recording.Recording:
    """Colour camera and IMU of a RealSense, as cut from the DM-VIO dataset of Zoltan3057.

    https://github.com/Zoltan3057/DM-VIO-dataset, commit 7f0fcff8a45b7bbcb70f509e8c926454a9971a2b::

        camera.txt    fx fy cx cy 0 [px], then width and height
        frames.csv    segment,index_in_original,stamp_ns,dt_to_next_ms,file
        imu.txt       stamp [ns], angular velocity [rad/s], specific force [m/s^2]; 200 Hz, and a
                      sample interpolated to the stamp of every image
        images/       JPEG, gray
    """
    title, parameters = packaged('realsense_rgb_rs')
    return recording.Recording(
        _realsense_camera(folder / 'camera.txt', _readout_time(parameters)),
        tuple(
            recording.image_file(
                row.nanoseconds('stamp_ns'), text_files.file_inside(folder, row, 'file')
            )
            for row in text_files.read_table(folder / 'frames.csv')
        ),
        ordered_samples(
            ImuSample(row.nanoseconds(0), row.vector(1, 2, 3), row.vector(4, 5, 6))
            for row in text_files.read_rows(folder / 'imu.txt', range(7), separator=None)
        ),
        title,
        parameters,
        image_format='mono8; jpeg compressed mono8',
    )


def _realsense_camera(path: Path, readout_time: float) -> RollingShutterCamera:
    if not path.is_file():
        raise MissingInputError(f'{path.name} is missing: there is no file {path}')
    # Only the first two lines are calibration: then DM-VIO's own crop follows.
    lines = path.read_text(encoding='utf-8', errors='replace').splitlines()[:2]
    rows = [
        text_files.Row(path, number, dict(enumerate(line.split())))
        for number, line in enumerate(lines, start=1)
    ]
    if [len(row.words) for row in rows] != [5, 2]:
        raise InputError(f'{path} must begin with "fx fy cx cy distortion" and "width height"')
    fx, fy, cx, cy, distortion = map(rows[0].real, range(5))
    if distortion != 0.0:
        raise rows[0].error(
            f'the FOV distortion {distortion:g} of this format is not supported: it must be 0'
        )
    width, height = map(rows[1].integer, range(2))
    if not (0 < width < 100_000 and 0 < height < 100_000):
        raise rows[1].error(f'there must be a number of pixels, got {width}x{height}')
    return RollingShutterCamera(
        width=width, height=height, fx=fx, fy=fy, cx=cx, cy=cy, readout_time=readout_time
    )


def read_xiaomi(folder: Path) -> recording.Recording:
    """Phone camera and gyro, as cut from gyro-video-stabilization of lhaippp.

    https://github.com/lhaippp/gyro-video-stabilization (MIT), folder 20200109_145447, commit
    480a1eadbdba43d33db6de740434c98a77c890ea::

        framestamp.txt   start of frame [s], line N for image N
        gyro.txt         angular velocity [rad/s] and stamp [s], separated by commas; 412 Hz
        images/          RE_frame-N.jpg, in colour

    There is no accelerometer.
    """
    stamps = [
        row.seconds_as_nanoseconds(0)
        for row in text_files.read_rows(folder / 'framestamp.txt', range(1))
    ]
    if not (folder / 'images').is_dir():
        raise MissingInputError(f'the folder of images is missing: there is no {folder}/images')
    found = {
        int(match[1]): path
        for path in (folder / 'images').iterdir()
        if (match := _XIAOMI_IMAGE.fullmatch(path.name))
    }
    if not found:
        raise MissingInputError(f'{folder}/images has no images RE_frame-N.jpg')
    for number, path in found.items():
        if not 1 <= number <= len(stamps):
            raise InputError(f'{path} has no stamp: framestamp.txt has lines 1 to {len(stamps)}')
    title, parameters = packaged('xiaomi_cc9_rs')
    # Calibrated by the repository, for its images of 800x600. Its skew of -0.7 px per unit of y/z
    # has no field in CameraInfo; without it, no point moves by more than 0.4 px.
    camera = RollingShutterCamera(
        width=800,
        height=600,
        fx=573.8534,
        fy=575.0448,
        cx=406.0101,
        cy=309.0112,
        readout_time=_readout_time(parameters),
    )
    return recording.Recording(
        camera,
        tuple(recording.image_file(stamps[number - 1], found[number]) for number in sorted(found)),
        ordered_samples(
            ImuSample(row.seconds_as_nanoseconds(3), row.vector(0, 1, 2), None)
            for row in text_files.read_rows(folder / 'gyro.txt', range(4))
        ),
        title,
        parameters,
    )
