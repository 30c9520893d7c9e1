"""A recording of a camera with an IMU, from files of any format, written as a bag.

A format has a reader that gives a `Recording`: `recorders`, and those of public data sets in the
laboratory. `read_rows` and `read_object` read text files of such formats.
"""

from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import suppress
import csv
from dataclasses import dataclass
from decimal import Decimal
from itertools import pairwise
import json
import math
from operator import attrgetter
from pathlib import Path
from typing import Any, NamedTuple, TypeVar

import numpy as np

from rs_relpose_ros.bags import reader
from rs_relpose_ros.bags.writer import BagWriter
from rs_relpose_ros.config.files import SourcedValue
from rs_relpose_ros.errors import InputError, MissingInputError
from rs_relpose_ros.geometry.camera import RollingShutterCamera
from rs_relpose_ros.geometry.timing import NANOSECONDS, to_nanoseconds
from rs_relpose_ros.imu.buffer import ImuSample, Vector
from rs_relpose_ros.messages import outgoing
from rs_relpose_ros.messages.incoming import TruePose
from rs_relpose_ros.tracking.images import encoded_image_size

COLOUR_JPEG = 'bgr8; jpeg compressed bgr8'
COMPRESSED = SourcedValue('image_transport', 'compressed', 'The bag holds JPEG images.')

# End of the stamps of ROS, whose seconds are an int32 [ns].
_END_NS = 2**31 * NANOSECONDS
# IMU samples after the last image are only needed for its rows; those before it, for gravity.
_IMU_AFTER_NS = 3 * NANOSECONDS
# Bytes of the largest image file, table and JSON object that are read.
_MAX_IMAGE = 1 << 27
_MAX_TABLE = 1 << 28
_MAX_OBJECT = 1 << 24
# Characters of the longest line of a log.
_MAX_LINE = 1 << 16

_Value = TypeVar('_Value', int, float)


@dataclass(frozen=True, slots=True)
class RecordedImage:
    """A JPEG image of a recording, with its stamp [ns] by the camera's clock."""

    stamp_ns: int
    name: str  # in errors
    encoded: Callable[[], bytes]  # reads the JPEG data


def image_file(stamp_ns: int, path: Path) -> RecordedImage:
    """A JPEG file, read when the bag is written."""
    return RecordedImage(stamp_ns, str(path), lambda: check_file(path, _MAX_IMAGE).read_bytes())


@dataclass(frozen=True, slots=True)
class Recording:
    """One camera and one IMU, at least one image and one sample, and the node's parameters.

    Images and poses in the order of their stamps, each by its sensor's clock.
    """

    camera: RollingShutterCamera | None  # None: not calibrated, and the bag has no CameraInfo
    images: Sequence[RecordedImage]
    imu: Sequence[ImuSample]  # in its own axes; without `accel` gyro and accelerometer together
    title: str  # head of the parameter file
    parameters: tuple[SourcedValue, ...]
    accel: Sequence[ImuSample] = ()  # samples of an accelerometer with stamps of its own
    truth: tuple[TruePose, ...] = ()  # of the camera's optical frame, on the IMU's clock
    image_format: str = COLOUR_JPEG  # as in sensor_msgs/CompressedImage

    def __post_init__(self) -> None:
        for name in ('imu', 'accel'):
            ordered = tuple(sorted(getattr(self, name), key=attrgetter('stamp_ns')))
            object.__setattr__(self, name, ordered)
        if not self.images or not self.imu:
            raise MissingInputError('a recording needs at least one image and one IMU sample')
        for earlier, later in pairwise(self.images):
            if later.stamp_ns <= earlier.stamp_ns:
                raise InputError(
                    f'{later.name} is stamped {later.stamp_ns} ns, not after '
                    f'the {earlier.stamp_ns} ns of {earlier.name} before it'
                )
        first, last = self.images[0].stamp_ns, self.images[-1].stamp_ns
        if first < 0 or last >= _END_NS:
            raise InputError(
                f'the images are stamped from {first} to {last} ns, but stamps of '
                f'ROS are from 0 to {_END_NS} ns'
            )
        if self.imu[-1].stamp_ns < first or self.imu[0].stamp_ns > last:
            raise InputError(
                f'the IMU samples, from {self.imu[0].stamp_ns} to {self.imu[-1].stamp_ns} ns, '
                f'and the images, from {first} to {last} ns, have no time in common: they are '
                'not of the same recording, or their stamps are not on one clock'
            )

    def cropped(self, samples: Sequence[ImuSample]) -> list[ImuSample]:
        """Those of `imu` or `accel` up to shortly after the last image, as the bag has them."""
        end_ns = self.images[-1].stamp_ns + _IMU_AFTER_NS
        return [sample for sample in samples if sample.stamp_ns <= end_ns]


def write_bag(
    recording: Recording, path: Path | str, on_image: Callable[[], object] = lambda: None
) -> None:
    """Write a recording as a bag, with the receive times of a driver, by which readers sort.

    Stamps and JPEG bytes are not changed. `on_image` is called after each image.
    """
    camera, imu_delay_ns = recording.camera, to_nanoseconds(reader.IMU_DELAY)
    size, reference, delay = None, 'the first image has', reader.IMAGE_DELAY
    if camera is not None:
        size, reference = (camera.width, camera.height), 'the calibration is for'
        delay += camera.readout_time
    with BagWriter(path) as bag:
        for image in recording.images:
            data = image.encoded()
            try:
                found = encoded_image_size(np.frombuffer(data, dtype=np.uint8))
            except InputError as error:
                raise InputError(f'{image.name}: {error}') from error
            size = size or found
            if found != size:
                raise InputError(
                    f'{image.name} has {found[0]}x{found[1]} pixels, but {reference} '
                    f'{size[0]}x{size[1]}'
                )
            bag_time_ns = image.stamp_ns + to_nanoseconds(delay)
            place = image.stamp_ns, reader.CAMERA_FRAME
            if camera is not None:
                bag.write(
                    reader.CAMERA_INFO_TOPIC,
                    reader.CAMERA_INFO,
                    outgoing.camera_info_message(*place, camera, None, bag.type),
                    bag_time_ns,
                )
            bag.write(
                reader.COMPRESSED_TOPIC,
                reader.COMPRESSED_IMAGE,
                outgoing.encoded_image_message(*place, data, bag.type, recording.image_format),
                bag_time_ns,
            )
            on_image()
        imu_topic = reader.GYRO_TOPIC if recording.accel else reader.IMU_TOPIC
        for topic, samples in ((imu_topic, recording.imu), (reader.ACCEL_TOPIC, recording.accel)):
            for sample in recording.cropped(samples):
                bag.write(
                    topic,
                    reader.IMU,
                    outgoing.imu_message(
                        sample.stamp_ns,
                        reader.IMU_FRAME,
                        sample.angular_velocity,
                        sample.linear_acceleration,
                        bag.type,
                    ),
                    sample.stamp_ns + imu_delay_ns,
                )
        for pose in recording.truth:
            bag.write(
                reader.GROUND_TRUTH_TOPIC,
                reader.POSE_STAMPED,
                outgoing.pose_stamped_message(
                    pose.stamp_ns, reader.WORLD_FRAME, pose.quat_xyzw, pose.position, bag.type
                ),
                pose.stamp_ns + imu_delay_ns,
            )


# -- Text files: each error names the file and the line -------------------------------------------


class Row(NamedTuple):
    """Words of one line of a file by the name of their column, or its number from 0."""

    path: Path
    line: int
    words: Mapping[Any, Any]

    def error(self, what: str) -> InputError:
        """An error with the place of the row."""
        return InputError(f'{self.path}, line {self.line}: {what}')

    def word(self, column: str | int) -> Any:
        """The text in a column."""
        if column not in self.words:
            raise self.error(
                f'it has no column {column}, only {", ".join(map(str, self.words))[:200]}'
            )
        return self.words[column]

    def real(self, column: str | int) -> float:
        """A finite number."""
        return self._number(column, 'a finite number', float, math.isfinite)

    def vector(self, x: str | int, y: str | int, z: str | int) -> Vector:
        """Three finite numbers."""
        return self.real(x), self.real(y), self.real(z)

    def integer(self, column: str | int) -> int:
        """An integer with or without a sign."""
        return self._number(column, 'an integer', int)

    def nanoseconds(self, column: str | int) -> int:
        """A stamp [ns], written in nanoseconds."""
        return self._number(column, 'a stamp in nanoseconds, an integer', int, _is_stamp)

    def seconds_as_nanoseconds(self, column: str | int, start_ns: int = 0) -> int:
        """A stamp [ns], written in decimal seconds since a start; rounded, without a float."""
        return self._number(
            column,
            'a stamp in seconds',
            lambda text: start_ns + round(Decimal(text) * NANOSECONDS),
            _is_stamp,
        )

    def _number(
        self,
        column: str | int,
        legal: str,
        convert: Callable[[str], _Value],
        is_legal: Callable[[_Value], bool] = lambda _: True,
    ) -> _Value:
        text = self.word(column)
        with suppress(ValueError, ArithmeticError):
            if isinstance(text, str) and is_legal(value := convert(text)):
                return value
        name = column if isinstance(column, str) else column + 1
        raise self.error(f'column {name} must be {legal}, got {str(text)[:40]!r}')


def _is_stamp(value: int) -> bool:
    return 0 <= value < _END_NS


def read_rows(
    path: Path, columns: Sequence[str | int] | None = None, separator: str | None = ','
) -> Iterator[Row]:
    """Rows of a text file, without empty lines and those that begin with '#'.

    Each must have all `columns`: without them those of the first line. `separator`: None for white
    space.
    """
    with check_file(path, _MAX_TABLE).open(encoding='utf-8', errors='replace') as file:
        lines = iter(lambda: file.readline(_MAX_LINE), '')
        if separator is None:
            lines = (' '.join(line.split()) for line in lines)
        rows = csv.reader(lines, delimiter=separator or ' ', quoting=csv.QUOTE_NONE)
        for number, words in enumerate(rows, start=1):
            words = [word.strip() for word in words]
            if words in ([], ['']) or words[0].startswith('#'):
                continue
            if columns is None:
                columns = words
                continue
            row = Row(path, number, dict(zip(columns, words, strict=False)))
            if len(words) != len(columns):
                raise row.error(f'there must be {len(columns)} columns, got {len(words)}')
            yield row


def read_table(path: Path) -> list[Row]:
    """All rows of a table whose first line names its columns; MissingInputError without any."""
    rows = list(read_rows(path))
    if not rows:
        raise MissingInputError(f'{path} has no rows below its first line')
    return rows


def file_inside(folder: Path, row: Row, column: str | int) -> Path:
    """A file that a table names; it must not be in another folder."""
    name = Path(row.word(column))
    if name.is_absolute() or '..' in name.parts:
        raise row.error(f'{str(name)[:80]!r} lies outside of the recording')
    return folder / name


def read_object(path: Path) -> dict[str, Any]:
    """The object in a JSON file."""
    with check_file(path, _MAX_OBJECT).open(encoding='utf-8', errors='replace') as file:
        try:
            value = json.load(file)
        except (ValueError, RecursionError) as error:
            raise InputError(f'{path}: no JSON: {error}') from error
    if not isinstance(value, dict):
        raise InputError(f'{path}: there must be a JSON object')
    return value


def check_file(path: Path, most_bytes: float = math.inf) -> Path:
    """The path of a file; MissingInputError if there is none, InputError if it is too large."""
    if not path.is_file():
        raise MissingInputError(f'{path.name} is missing: there is no file {path}')
    if path.stat().st_size > most_bytes:
        raise InputError(f'{path} has more than {most_bytes} bytes: it is another file')
    return path
