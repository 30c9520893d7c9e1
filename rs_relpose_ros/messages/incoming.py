"""Image, CameraInfo, IMU and pose messages to data, and their way into the sequencer.

Messages are read by field name only, those of rclpy and of rosbags (ROS 2 and ROS 1) alike. No
field is trusted: sizes are checked before memory is allocated, and an unusable message raises
`InputError`.
"""

import base64
from collections.abc import Callable, Collection, Iterator, Mapping, Sequence
from contextlib import suppress
from enum import Enum
from functools import partial
import math
import re
from typing import Any, NamedTuple

import numpy as np

from rs_relpose_ros.config.settings import Parameters
from rs_relpose_ros.errors import InputError, RsRelposeError
from rs_relpose_ros.geometry.camera import Intrinsics
from rs_relpose_ros.geometry.so3 import Vector
from rs_relpose_ros.geometry.timing import NANOSECONDS, to_nanoseconds
from rs_relpose_ros.imu.buffer import ImuSample
from rs_relpose_ros.messages.burst_times import SampleTimes
from rs_relpose_ros.messages.camera_info import intrinsics_from_info
from rs_relpose_ros.messages.streams import burst_warning, check_timelines, Stream
from rs_relpose_ros.pipeline.sequencer import Refusal, Sequencer
from rs_relpose_ros.tracking import images

# Largest angular velocity [rad/s] that is accepted. Larger ones overflow the filters and come from
# damaged messages or from degrees. [chosen: sensors end at 70 rad/s; 100 to 10^6 would do]
MAX_ANGULAR_VELOCITY = 1e3
# Largest specific force [m/s^2] that is accepted, for the same reasons. [chosen: sensors of shocks
# end at 4000 m/s^2; any value from there to 10^6 would do]
MAX_LINEAR_ACCELERATION = 1e4


class TruePose(NamedTuple):
    """Pose of the camera in the world: position [m], rotation as quaternion."""

    stamp_ns: int
    position: tuple[float, float, float]
    quat_xyzw: tuple[float, float, float, float]


def stamp_ns(header: Any) -> int:
    """Stamp [ns] of a std_msgs/Header."""
    return time_ns(header.stamp)


def time_ns(stamp: Any) -> int:
    """Integer [ns] of a builtin_interfaces/Time."""
    seconds = int(stamp.sec)
    nanoseconds = int(stamp.nanosec)
    if nanoseconds >= NANOSECONDS:
        raise InputError(
            f'stamp is out of range: {seconds} s and {nanoseconds} ns, nanosec must be below '
            '1000000000'
        )
    if seconds < 0 or nanoseconds < 0:
        raise InputError(f'stamp is out of range: {seconds} s and {nanoseconds} ns')
    return seconds * NANOSECONDS + nanoseconds


# First characters of a JPEG and of a PNG file as text in base64. Bridges to web pages send files
# as such a text. [derived: base64 of the first bytes of both formats]
_BASE64 = (b'/9j/', b'iVBORw0KGgo')


def image_from_message(msg: Any) -> images.EncodedImage:
    """Image of a sensor_msgs/Image or CompressedImage; a view, checked when it is decoded."""
    data = np.frombuffer(msg.data, dtype=np.uint8)
    frame_id = str(msg.header.frame_id)
    origin = stamp_ns(msg.header), frame_id
    if hasattr(msg, 'format'):
        return images.CompressedImage(_binary(data), str(msg.format), *origin)
    encoding = str(msg.encoding)
    size = int(msg.width), int(msg.height)
    if images.is_encoded(data, size):
        # A driver in MJPEG mode publishes what the camera sends, whatever encoding it names.
        return images.CompressedImage(data, f'{encoding}; a file in an Image', *origin)
    is_big_endian = bool(msg.is_bigendian)
    return images.RawImage(data, encoding, *size, int(msg.step), is_big_endian, *origin)


def _binary(data: images.Bytes) -> images.Bytes:
    """Bytes of a file that may be a text in base64."""
    if data[: len(_BASE64[1])].tobytes().startswith(_BASE64):
        with suppress(ValueError):
            return np.frombuffer(base64.b64decode(data.tobytes()), dtype=np.uint8)
    return data


def pose_from_message(msg: Any) -> TruePose:
    """Pose of a geometry_msgs/PoseStamped."""
    position = msg.pose.position
    rotation = msg.pose.orientation
    return TruePose(
        stamp_ns(msg.header),
        (position.x, position.y, position.z),
        (rotation.x, rotation.y, rotation.z, rotation.w),
    )


def imu_sample_from_message(msg: Any, *, with_gyro: bool = True) -> ImuSample:
    """Gyro and accelerometer of a sensor_msgs/Imu, each None if the message has no such sensor.

    By REP-145 a covariance whose first element is -1 means that the sensor does not exist. Drivers
    with one topic per sensor leave the other vector zero, so an accelerometer that reads exactly
    zero in all axes counts as absent. Without `with_gyro` the topic is that of the accelerometer.
    """
    stamp = stamp_ns(msg.header)
    force = msg.linear_acceleration
    angular_velocity = linear_acceleration = down = None
    if with_gyro and has_gyro(msg):
        rate = msg.angular_velocity
        angular_velocity = _vector('angular_velocity', rate, MAX_ANGULAR_VELOCITY)
        down = _down(msg)
    if msg.linear_acceleration_covariance[0] != -1.0 and (force.x or force.y or force.z):
        linear_acceleration = _vector('linear_acceleration', force, MAX_LINEAR_ACCELERATION)
    if angular_velocity is None and linear_acceleration is None:
        raise InputError(
            'an IMU message has neither gyro nor accelerometer: both are marked as '
            'absent (covariance -1) or zero'
        )
    return ImuSample(stamp, angular_velocity, linear_acceleration, down)


def _down(msg: Any) -> tuple[float, float, float, float] | None:
    """Down in the axes of the IMU and its sigma [rad], by the orientation of the message.

    None if the orientation is no unit quaternion, or has no usable variances: by REP-145 a
    variance of 0 means that it is unknown.
    """
    quaternion = msg.orientation
    x = float(quaternion.x)
    y = float(quaternion.y)
    z = float(quaternion.z)
    w = float(quaternion.w)
    norm2 = x * x + y * y + z * z + w * w
    about_x = float(msg.orientation_covariance[0])
    about_y = float(msg.orientation_covariance[4])
    variance = max(about_x, about_y)
    has_variance = about_x > 0.0 and variance < math.pi**2
    if not has_variance or not abs(norm2 - 1.0) < 0.02:
        return None
    # Minus the third row of R(q), world from IMU.
    down_x = -2.0 * (x * z - w * y) / norm2
    down_y = -2.0 * (y * z + w * x) / norm2
    down_z = -(w * w - x * x - y * y + z * z) / norm2
    return down_x, down_y, down_z, math.sqrt(variance)


def _vector(name: str, vector: Any, largest: float) -> tuple[float, float, float]:
    """Elements of a geometry_msgs/Vector3; InputError where one is not finite or too large."""
    x = float(vector.x)
    y = float(vector.y)
    z = float(vector.z)
    if -largest <= x <= largest and -largest <= y <= largest and -largest <= z <= largest:
        return x, y, z
    values = (x, y, z)
    if not all(map(math.isfinite, values)):
        raise InputError(f'{name} of an IMU message must be finite, got {list(values)}')
    raise InputError(
        f'{name} of an IMU message must be at most {largest:g}, '
        f'got {list(values)}: is it in rad/s and m/s^2?'
    )


# -- Topics by role, live and offline -------------------------------------------------------------


class Role(str, Enum):
    """Role of a topic: name of the topic of the node, and the field of `SensorTopics`."""

    IMU = 'imu'
    ACCEL = 'accel'  # of drivers with a topic of its own for the accelerometer
    CAMERA_INFO = 'camera_info'
    IMAGE = 'image'
    TRUTH = 'truth'


class Part(NamedTuple):
    """Message types that can have a role, and the function that reads a message."""

    msgtypes: tuple[str, ...]
    read: Callable[[Any], Any]


# What the node and the readers of bags accept in each role. [derived: interface]
PARTS: Mapping[Role, Part] = {
    Role.IMU: Part(('sensor_msgs/msg/Imu',), imu_sample_from_message),
    Role.ACCEL: Part(('sensor_msgs/msg/Imu',), partial(imu_sample_from_message, with_gyro=False)),
    Role.CAMERA_INFO: Part(('sensor_msgs/msg/CameraInfo',), intrinsics_from_info),
    Role.IMAGE: Part(
        ('sensor_msgs/msg/Image', 'sensor_msgs/msg/CompressedImage'), image_from_message
    ),
    Role.TRUTH: Part(('geometry_msgs/msg/PoseStamped',), pose_from_message),
}


# Roles of the topics that camera and IMU publish. [derived: `Role` without the ground truth]
SENSOR_ROLES = (Role.IMU, Role.ACCEL, Role.CAMERA_INFO, Role.IMAGE)


def sensor_messages(
    bag: Any, topics: Any, roles: Collection[Role] = SENSOR_ROLES, *, faulty: bool = False
) -> Iterator[tuple[Role, Any]]:
    """Messages of a `Bag` with one of the roles, by stamp; `topics`: `SensorTopics`.

    InputError if a topic has several publishers or impossible stamps and, unless they may be
    `faulty`, if a fault of the streams permits no pose.
    """
    found = {
        topic.name: (role, topic)
        for role in reversed(Role)
        if role in roles and (topic := getattr(topics, role.value)) is not None
    }
    if not faulty and Role.IMU in roles and Role.IMAGE in roles:
        for fault in check_timelines(bag.timeline, topics).values():
            if fault.withholds:
                raise InputError(f'{bag.path}: {fault}')
    streams = {name: Stream(name) for name, (role, _) in found.items() if role is not Role.TRUTH}
    for message in bag.messages([topic for _, topic in found.values()], by_stamp=True):
        role = found[message.topic][0]
        content = message.message
        if role is not Role.TRUTH and (role is not Role.IMU or has_gyro(content)):
            streams[message.topic].add(content.header)
        yield role, message


def has_gyro(message: Any) -> bool:
    """Whether an IMU message has an angular velocity (REP-145: -1 in its covariance: none)."""
    return bool(message.angular_velocity_covariance[0] != -1.0)


# -- Stuck and saturated sensors ------------------------------------------------------------------
#
# They repeat their values bit by bit, which noise never does. Repeated values with new stamps
# would give wrong poses that look good.

# Stride of the bytes of two images that are compared first: nearly always one of them differs, and
# the comparison ends there. [chosen: a prime, so that all columns are met; 100 to 10 000 would do]
_STRIDE = 1009
# Fewest equal samples of a stuck gyro. With fewer, a slow gyro would be a fault whose two or three
# samples are equal by chance. [chosen: 4 to 10 would do]
_FEWEST_SAMPLES = 4
# Smallest range of a gyro [rad/s]: an axis that repeats a larger value is saturated.
# [derived: no product has less than 125 deg/s]
_LEAST_RANGE = 2.0
# Smallest value [rad/s] at which a driver or filter clips: it is the largest value so far. A
# smaller limit would take for clipping the bias that a gyro of coarse resolution repeats at rest.
# [chosen: biases stay below 0.1]
_LEAST_CLIPPING = 0.2


def repeats(previous: images.EncodedImage, image: images.EncodedImage) -> bool:
    """Whether an image is bit-equal to the one before, which no message delivered twice is."""
    first = previous.data
    second = image.data
    return (
        previous.stamp_ns != image.stamp_ns
        and len(first) == len(second)
        and np.array_equal(first[::_STRIDE], second[::_STRIDE])
        and np.array_equal(first, second)
    )


class StuckGyro:
    """Detects repeated gyro samples.

    They are not used from the first one on: drivers that publish faster than the sensor measures
    repeat, and interpolation gives the same. After `longest` [s] they are a fault; 0 accepts all.
    """

    def __init__(self, longest: float) -> None:
        self._longest_ns = to_nanoseconds(longest)
        self._values: Vector = (math.nan, math.nan, math.nan)
        self._largest = [0.0] * 3
        self._since_ns = [0] * 3
        self._counts = [0] * 3

    def repeats(self, sample: ImuSample) -> bool:
        """Whether this sample repeats the last one; InputError if that lasts too long."""
        rate = sample.angular_velocity
        if rate is None or self._longest_ns == 0:
            return False
        for axis, value in enumerate(rate):
            size = abs(value)
            if size > self._largest[axis]:
                self._largest[axis] = size
        before = self._values
        self._values = rate
        if rate[0] != before[0] and rate[1] != before[1] and rate[2] != before[2]:
            # The usual sample, for which nothing is to be counted.
            self._since_ns = [sample.stamp_ns] * 3
            self._counts = [1, 1, 1]
            return False
        for axis in range(3):
            self._count(axis, rate[axis] == before[axis], sample.stamp_ns)
        count = min(self._counts)
        since_ns = max(self._since_ns)
        clipped = self._clipped_axis(rate) if count == 1 else None
        if clipped is not None:
            count = self._counts[clipped]
            since_ns = self._since_ns[clipped]
        if count >= _FEWEST_SAMPLES and sample.stamp_ns - since_ns > self._longest_ns:
            raise InputError(_fault(clipped, rate))
        return count > 1

    def _count(self, axis: int, is_same: bool, stamp_ns: int) -> None:
        """Count how often an axis has had its value, `is_same` as that of the last sample."""
        # After the clock was set back the time of repetition counts from here.
        if not is_same or stamp_ns < self._since_ns[axis]:
            self._since_ns[axis] = stamp_ns
            self._counts[axis] = 0
        self._counts[axis] += 1

    def _clipped_axis(self, rate: tuple[float, float, float]) -> int | None:
        """The first axis that repeats a value at which a driver or a filter may clip."""
        for axis, value in enumerate(rate):
            clipping = min(_LEAST_RANGE, max(_LEAST_CLIPPING, self._largest[axis]))
            if self._counts[axis] > 1 and abs(value) >= clipping:
                return axis
        return None


def _fault(clipped: int | None, rate: tuple[float, float, float]) -> str:
    """Text about a gyro that repeats its values, or those of the axis that is `clipped`."""
    if clipped is None:
        return (
            'the gyro repeats the same values bit by bit: it is stuck (set stuck_gyro_time to 0 '
            'for a simulation without noise)'
        )
    return (
        f'the {"xyz"[clipped]} axis of the gyro repeats {rate[clipped]:.4g} rad/s bit by '
        'bit: it is saturated'
    )


# -- Into the sequencer, live and offline ---------------------------------------------------------

# Most images that wait for the first CameraInfo, which may come before or after its image. More
# only delay the refusal of images that have none. [chosen: 1 to 10 would do]
_HELD_IMAGES = 4


class Intake:
    """Receives the messages of camera and IMU, and fills a sequencer; images stay encoded.

    Intrinsics are those of `parameters`, else of the last CameraInfo. Only images with one of the
    `chosen` stamps are handed over, all for None. Without parameters a stuck gyro is not detected.
    Not thread-safe: one thread feeds it.
    """

    def __init__(
        self,
        sequencer: Sequencer,
        parameters: Parameters | None = None,
        chosen: Collection[int] | None = None,
    ) -> None:
        self._sequencer = sequencer
        self._chosen = chosen
        self.intrinsics: Intrinsics | None = None  # the active ones
        # Why the last CameraInfo cannot be used; empty if it can, or if none came.
        self.camera_info_problem = ''
        # Images so far, those that were not chosen, and the chosen stamps so far.
        self.images = self.images_skipped = 0
        self.stamps_found: set[int] = set()
        self._camera_info: Any = None
        configured = None if parameters is None else parameters.intrinsics
        self._configured = configured if configured is not None and configured.given else None
        self._held: list[images.EncodedImage] = []  # wait for the first CameraInfo
        self._last: images.EncodedImage | None = None
        self._streams: dict[Role, Stream] = {}
        # Of the gyro, and of samples of an accelerometer without a gyro.
        self._times = SampleTimes()
        self._accel_times = SampleTimes()
        self._gyro = StuckGyro(0.0 if parameters is None else parameters.imu.stuck_gyro_time)

    def receive(self, role: Role, message: Any) -> RsRelposeError | None:
        """Hand a message over; the error of an unusable one, but the sequencer refuses images."""
        self.images += role is Role.IMAGE
        if role is Role.CAMERA_INFO and self._configured is not None:
            return None
        try:
            if role is not Role.IMU or has_gyro(message):
                self._stream(role).add(message.header)
            data = PARTS[role].read(message)
            if role is Role.IMAGE:
                if self._times.is_uneven:
                    raise InputError(self.warning)
                self._add_image(data)
            elif role is Role.CAMERA_INFO:
                self._use(data)
                self._camera_info = message
            elif data.angular_velocity is not None:
                self._add_gyro(self._times.add(data))
            else:
                for sample in self._accel_times.add(data):
                    self._sequencer.add_imu(sample)
        except RsRelposeError as error:
            if role is Role.IMAGE:
                self._sequencer.refuse(0, Refusal.BAD_IMAGE, str(error))
                return None
            if role is Role.CAMERA_INFO:
                self._use(None, str(error))
            return error
        return None

    def _stream(self, role: Role) -> Stream:
        if role not in self._streams:
            self._streams[role] = Stream(f'topic {role.value}')
        return self._streams[role]

    @property
    def warning(self) -> str:
        """What is wrong with the stamps of the gyro, which are corrected; empty for nothing."""
        return burst_warning(f'topic {Role.IMU.value}', self._times)

    def _add_gyro(self, samples: Sequence[ImuSample]) -> None:
        """Hand samples over; an error of one of them does not lose the others."""
        if samples and self._times.corrects:
            self._times.corrects = False
            self._sequencer.reset('the samples of the gyro so far had the times of bursts')
        error = None
        for sample in samples:
            try:
                if not self._gyro.repeats(sample):
                    self._sequencer.add_imu(sample)
            except InputError as unusable:
                error = unusable
        if error is not None:
            raise error

    def waits_for_imu(self) -> bool:
        """Whether a frame needs samples that have not been received yet."""
        return self._sequencer.waits_for_imu()

    def camera_info_of(self, intrinsics: Intrinsics) -> Any:
        """The last CameraInfo; None if it has other intrinsics."""
        return self._camera_info if intrinsics == self.intrinsics else None

    def finish(self) -> None:
        """End of the input: no image waits for a CameraInfo any longer."""
        if self._held:
            self._use(None)
        with suppress(InputError):  # of a stuck gyro, which has nothing to cover
            self._add_gyro(self._times.rest())
        for sample in self._accel_times.rest():
            self._sequencer.add_imu(sample)
        self._sequencer.close()

    def _use(self, intrinsics: Intrinsics | None, problem: str = '') -> None:
        """Use these intrinsics from the images on that wait."""
        self.intrinsics = intrinsics
        self.camera_info_problem = problem
        while self._held:
            self._add_frame(self._held.pop(0))

    def _add_image(self, image: images.EncodedImage) -> None:
        if self._chosen is not None:
            if image.stamp_ns not in self._chosen:
                self.images_skipped += 1
                self._sequencer.pass_over(image.stamp_ns)
                return
            self.stamps_found.add(image.stamp_ns)
        self._held.append(image)
        known = self.intrinsics or self._configured or self.camera_info_problem
        while len(self._held) > (0 if known else _HELD_IMAGES):
            self._add_frame(self._held.pop(0))

    def _add_frame(self, image: images.EncodedImage) -> None:
        if self._configured is not None:
            try:
                size = image.size
                last = self.intrinsics
                if last is None or size != (last.image_width, last.image_height):
                    self.intrinsics = self._configured.of_image(*size)
            except InputError as error:
                self._sequencer.refuse(image.stamp_ns, Refusal.BAD_IMAGE, str(error))
                return
        if self.intrinsics is None:
            problem = self.camera_info_problem or 'no CameraInfo came before or with the image'
            self._sequencer.refuse(image.stamp_ns, Refusal.NO_CALIBRATION, problem)
            return
        # Compared before any image is dropped: after a gap a repeated image would pass as new.
        before = self._last
        self._last = image
        if before is not None and repeats(before, image):
            problem = (
                'the image repeats the one before bit by bit: the camera or its driver is stuck, '
                'or the image is empty'
            )
            self._sequencer.refuse(image.stamp_ns, Refusal.BAD_IMAGE, problem)
            return
        self._sequencer.add_frame(image, self.intrinsics)


# -- Messages about bad input, grouped by reason --------------------------------------------------

# Numbers differ between messages of one reason. [derived: notations of Python's numbers]
_NUMBERS = re.compile(r'[-+]?\d[\d.e+-]*')
# Most reasons that are distinguished: a source of ever new texts must not fill log or memory.
# [chosen: a run has up to ten; 20 to 1000 would do]
MOST_REASONS = 64


def reason_key(text: str) -> str:
    """`text` without its numbers."""
    return _NUMBERS.sub('#', text)


class ReasonCounts:
    """Counts messages by reason; the first message of each is kept."""

    def __init__(self) -> None:
        self._counts: dict[str, tuple[str, int]] = {}

    def add(self, text: str) -> bool:
        """Count a message; whether it is the first one of its reason."""
        key = reason_key(text)
        if key not in self._counts and len(self._counts) >= MOST_REASONS:
            key = ''
            text = 'further reasons of other kinds'
        first, count = self._counts.get(key, (text, 0))
        self._counts[key] = first, count + 1
        return count == 0

    def most_common(self) -> dict[str, int]:
        """The first messages with their counts, the most frequent first."""
        return dict(sorted(self._counts.values(), key=lambda item: -item[1]))
