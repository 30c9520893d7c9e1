"""A recording of a camera with an IMU, from files of any format, and how it becomes a bag.

A format has a reader that returns a `Recording`: the other modules of this folder, and the
laboratory for public data sets.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from itertools import pairwise
from operator import attrgetter
from pathlib import Path

import cv2
import numpy as np

from rs_relpose_ros.bags import sensor_topics
from rs_relpose_ros.bags.convert.text_files import check_file
from rs_relpose_ros.bags.writer import BagWriter
from rs_relpose_ros.config.files import SourcedValue
from rs_relpose_ros.errors import InputError, MissingInputError
from rs_relpose_ros.geometry.camera import readout_direction, RollingShutterCamera
from rs_relpose_ros.geometry.timing import END_OF_STAMPS_NS, NANOSECONDS, to_nanoseconds
from rs_relpose_ros.imu.buffer import ImuSample
from rs_relpose_ros.messages import outgoing
from rs_relpose_ros.messages.incoming import TruePose
from rs_relpose_ros.tracking.images import encoded_image_size

# Formats of compressed images. [derived: compressed_image_transport]
COLOUR_JPEG = 'bgr8; jpeg compressed bgr8'
# The same for gray images without loss.
GRAY_PNG = 'mono8; png compressed mono8'
# Parameter of all converted bags.
COMPRESSED = SourcedValue('image_transport', 'compressed', 'The bag holds compressed images.')

# The bag has IMU samples until this time after the last image [ns]. Its rows need the readout
# time, and a time offset that is not known yet up to a second. [chosen: any value from 1.5 s
# to 10 s would do]
_IMU_AFTER_NS = 3 * NANOSECONDS
# A larger image file is refused, so that a wrong file does not fill the memory. [chosen: any
# value from 1e8 to 1e9 would do]
_MAX_IMAGE_BYTES = 1 << 27


@dataclass(frozen=True, slots=True)
class RecordedImage:
    """A compressed image of a recording, with its stamp [ns] by the camera's clock."""

    stamp_ns: int
    name: str  # in errors
    encoded: Callable[[], bytes]  # reads the JPEG or PNG data


def image_file(stamp_ns: int, path: Path) -> RecordedImage:
    """Make an image of a JPEG or PNG file, which is read when the bag is written."""

    def read() -> bytes:
        return check_file(path, _MAX_IMAGE_BYTES).read_bytes()

    return RecordedImage(stamp_ns, str(path), read)


# Quality of a JPEG image that is turned, and so compressed again. [chosen: from 85 on the noise of
# matches does not depend on it (docs/lab)]
_TURNED_QUALITY = 95


def turned_back(image: RecordedImage, turns: int) -> RecordedImage:
    """Turn an image that is higher than wide by quarter turns, counterclockwise; others stay."""

    def read() -> bytes:
        data = image.encoded()
        width, height = encoded_image_size(np.frombuffer(data, dtype=np.uint8))
        if height <= width:
            return data
        pixels = cv2.imdecode(np.frombuffer(data, dtype=np.uint8), cv2.IMREAD_COLOR)
        if pixels is None:
            raise InputError('the image cannot be decoded')
        turned = np.ascontiguousarray(np.rot90(pixels, turns))
        quality = [cv2.IMWRITE_JPEG_QUALITY, _TURNED_QUALITY]
        return bytes(cv2.imencode('.jpg', turned, quality)[1])

    return RecordedImage(image.stamp_ns, image.name, read)


@dataclass(frozen=True, slots=True)
class Recording:
    """One camera and one IMU, at least one image and one sample, and the node's parameters.

    Images and poses are in the order of their stamps, each by the clock of its sensor.
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
            ordered = sorted(getattr(self, name), key=attrgetter('stamp_ns'))
            object.__setattr__(self, name, tuple(ordered))
        if not self.images or not self.imu:
            raise MissingInputError('a recording needs at least one image and one IMU sample')
        for earlier, later in pairwise(self.images):
            if later.stamp_ns <= earlier.stamp_ns:
                raise InputError(
                    f'{later.name} is stamped {later.stamp_ns} ns, not after '
                    f'the {earlier.stamp_ns} ns of {earlier.name} before it'
                )
        first_ns = self.images[0].stamp_ns
        last_ns = self.images[-1].stamp_ns
        if first_ns < 0 or last_ns >= END_OF_STAMPS_NS:
            raise InputError(
                f'the images are stamped from {first_ns} to {last_ns} ns, but stamps of '
                f'ROS are from 0 to {END_OF_STAMPS_NS} ns'
            )
        start_ns = self.imu[0].stamp_ns
        end_ns = self.imu[-1].stamp_ns
        if end_ns < first_ns or start_ns > last_ns:
            raise InputError(
                f'the IMU samples, from {start_ns} to {end_ns} ns, '
                f'and the images, from {first_ns} to {last_ns} ns, have no time in common: they '
                'are not of the same recording, or their stamps are not on one clock'
            )

    def cropped(self, samples: Sequence[ImuSample]) -> list[ImuSample]:
        """Return the samples up to shortly after the last image, as the bag has them."""
        end_ns = self.images[-1].stamp_ns + _IMU_AFTER_NS
        return [sample for sample in samples if sample.stamp_ns <= end_ns]


def write_bag(
    recording: Recording, path: Path | str, on_image: Callable[[], object] = lambda: None
) -> None:
    """Write a recording as a bag, with the receive times of a driver.

    Stamps and compressed images are not changed. `on_image` is called after each image.
    """
    with BagWriter(path) as bag:
        _write_images(bag, recording, on_image)
        imu_topic = sensor_topics.GYRO_TOPIC if recording.accel else sensor_topics.IMU_TOPIC
        _write_samples(bag, imu_topic, recording.cropped(recording.imu))
        _write_samples(bag, sensor_topics.ACCEL_TOPIC, recording.cropped(recording.accel))
        for pose in recording.truth:
            message = outgoing.pose_stamped_message(
                pose.stamp_ns, sensor_topics.WORLD_FRAME, pose.quat_xyzw, pose.position, bag.type
            )
            bag_time_ns = pose.stamp_ns + to_nanoseconds(sensor_topics.IMU_DELAY)
            bag.write(
                sensor_topics.GROUND_TRUTH_TOPIC, sensor_topics.POSE_STAMPED, message, bag_time_ns
            )


def _write_images(bag: BagWriter, recording: Recording, on_image: Callable[[], object]) -> None:
    """Write each image and, of a calibrated camera, its CameraInfo."""
    camera = recording.camera
    size = None if camera is None else (camera.width, camera.height)
    reference = 'the first image has' if camera is None else 'the calibration is for'
    readout = 0.0 if camera is None else camera.readout_time
    delay_ns = to_nanoseconds(sensor_topics.IMAGE_DELAY + readout)
    for image in recording.images:
        try:
            data = image.encoded()
            found = encoded_image_size(np.frombuffer(data, dtype=np.uint8))
        except MissingInputError:
            raise
        except InputError as error:
            text = str(error)
            raise InputError(text if image.name in text else f'{image.name}: {text}') from error
        size = size or found
        if found != size:
            raise InputError(
                f'{image.name} has {found[0]}x{found[1]} pixels, but {reference} '
                f'{size[0]}x{size[1]}'
            )
        place = image.stamp_ns, sensor_topics.CAMERA_FRAME
        bag_time_ns = image.stamp_ns + delay_ns
        if camera is not None:
            info = outgoing.camera_info_message(*place, camera, None, bag.type)
            bag.write(
                sensor_topics.CAMERA_INFO_TOPIC, sensor_topics.CAMERA_INFO, info, bag_time_ns
            )
        message = outgoing.encoded_image_message(*place, data, bag.type, recording.image_format)
        bag.write(
            sensor_topics.COMPRESSED_TOPIC, sensor_topics.COMPRESSED_IMAGE, message, bag_time_ns
        )
        on_image()


def _write_samples(bag: BagWriter, topic: str, samples: Sequence[ImuSample]) -> None:
    """Write samples of an IMU, or of a separate accelerometer."""
    delay_ns = to_nanoseconds(sensor_topics.IMU_DELAY)
    for sample in samples:
        message = outgoing.imu_message(
            sample.stamp_ns,
            sensor_topics.IMU_FRAME,
            sample.angular_velocity,
            sample.linear_acceleration,
            bag.type,
        )
        bag.write(topic, sensor_topics.IMU, message, sample.stamp_ns + delay_ns)


# -- Readout times as files of cameras and phones have them ---------------------------------------

# telemetry-parser and lens profiles add this number to the milliseconds of a sensor that is read
# by columns. [derived: their conventions]
BY_COLUMNS_MS = 10_000.0
# A longer readout time is an error of the file [ms]. [chosen: no camera needs a second for an
# image; any value from 300 to 9000 would do]
_LONGEST_READOUT_MS = 1000.0


def readout_values(
    milliseconds: float, name: str, source: str, axis: int = 1
) -> list[SourcedValue]:
    """Return the parameters of a readout time [ms], which is negative if the last row is first.

    There are none for 0: the file does not know it. `axis` is the pixel coordinate that is the
    row, 0 for columns. InputError, with `name`, for columns without a direction. `source`
    describes where the value comes from.
    """
    if abs(milliseconds) >= BY_COLUMNS_MS:
        raise InputError(
            f'{name}: the sensor is read column by column, in a direction that the file does not '
            'state'
        )
    if not 0.0 < abs(milliseconds) < _LONGEST_READOUT_MS:
        return []
    direction = readout_direction(axis, milliseconds)
    return [
        SourcedValue('readout_time', round(abs(milliseconds) * 1e-3, 9), source),
        SourcedValue('readout_direction', direction, 'As the readout time.'),
    ]


def camera_matrix(fx: float, fy: float, cx: float, cy: float, source: str) -> SourcedValue:
    """Return the parameter of a pinhole [px] that is no calibration: the bag has no CameraInfo."""
    return SourcedValue('camera_matrix', (fx, 0.0, cx, 0.0, fy, cy, 0.0, 0.0, 1.0), source)
