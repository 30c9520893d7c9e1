"""Statistics of one pass over a bag, from which `check` makes its findings.

Of a message only numbers are kept: 16 bytes, and another 72 of an IMU.
"""

from array import array
from collections import Counter
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from rs_relpose_ros.bags.reader import BagMessage, Topic
from rs_relpose_ros.config.settings import ImuConfig, IntrinsicsConfig
from rs_relpose_ros.errors import RsRelposeError
from rs_relpose_ros.geometry import Array
from rs_relpose_ros.geometry.camera import Intrinsics
from rs_relpose_ros.imu.buffer import ImuSample, Vector
from rs_relpose_ros.imu.filters import BiasTracker, GyroBias
from rs_relpose_ros.messages.incoming import PARTS, Role
from rs_relpose_ros.tracking.images import EncodedImage

# Uncertainty of the bias before it is measured at rest, 1 sigma [rad/s]; the gate is four times
# that.
_BIAS_SIGMA = 0.03
# Images that are decoded, evenly over the recording.
_DECODED = 40
_MOST_ENCODINGS = 20


class Stamps:
    """Stamps of a topic, in the order of recording."""

    def __init__(self) -> None:
        self._stamps_ns, self._delays = array('q'), array('d')

    def add(self, stamp_ns: int, recorded_ns: int) -> None:
        """Add the next message."""
        self._stamps_ns.append(stamp_ns)
        self._delays.append((recorded_ns - stamp_ns) * 1e-9)

    @property
    def ns(self) -> NDArray[np.int64]:
        """The stamps (N,)."""
        return np.array(self._stamps_ns, dtype=np.int64)

    @property
    def count(self) -> int:
        """Number of messages."""
        return len(self._stamps_ns)

    @property
    def steps(self) -> Array:
        """Steps (N - 1,) between successive messages [s]; some may be zero or negative."""
        return np.diff(self.ns) * 1e-9

    @property
    def _forwards(self) -> Array:
        return self.steps[self.steps > 0.0]

    @property
    def interval(self) -> float:
        """Median of the steps forwards [s]; NaN where there is none."""
        steps = self._forwards
        return float(np.median(steps)) if len(steps) else float('nan')

    @property
    def jitter(self) -> float:
        """Spread of these steps, 1.48 times the median deviation [s]."""
        steps = self._forwards
        return 1.4826 * float(np.median(np.abs(steps - np.median(steps)))) if len(steps) else 0.0

    @property
    def delay(self) -> float:
        """Median of recording time minus stamp [s]; NaN without a message."""
        return float(np.median(self._delays)) if self.count else float('nan')

    @property
    def duration(self) -> float:
        """From the smallest to the largest stamp [s]."""
        return int(np.ptp(self.ns)) * 1e-9 if self.count else 0.0

    def longer_than(self, seconds: float) -> tuple[int, float]:
        """Number of steps forwards that are longer, and the longest [s]."""
        steps = self._forwards
        return int((steps > seconds).sum()), float(steps.max(initial=0.0))


class Inertial:
    """Readings of the IMU, in the order of recording."""

    def __init__(self) -> None:
        self.orientations = 0    # orientations with a covariance
        self._forces = array('d')    # of all samples of the accelerometer
        self._stamps_ns, self._rates = array('q'), array('d')    # of the gyro
        self._last_forces = array('d')    # at these stamps, NaN before the first one
        self._last_force: Vector = (float('nan'),) * 3

    def add(self, sample: ImuSample) -> None:
        """Add a sample."""
        self.orientations += sample.orientation is not None
        if sample.linear_acceleration is not None:
            self._last_force = sample.linear_acceleration
            self._forces.extend(self._last_force)
        if sample.angular_velocity is not None:
            self._stamps_ns.append(sample.stamp_ns)
            self._rates.extend(sample.angular_velocity)
            self._last_forces.extend(self._last_force)

    @property
    def rates(self) -> Array:
        """Rates (K, 3) of the gyro [rad/s]."""
        return np.array(self._rates).reshape(-1, 3)

    @property
    def forces(self) -> Array:
        """Specific forces (K, 3) [m/s^2], IMU frame."""
        return np.array(self._forces).reshape(-1, 3)

    def rest(self) -> GyroBias | None:
        """Mean rate at rest; None if the IMU never was."""
        stamps = np.array(self._stamps_ns, dtype=np.int64)
        # The search requires increasing stamps.
        later = np.diff(np.maximum.accumulate(stamps), prepend=-1) > 0
        search = BiasTracker(ImuConfig(gyro_bias_sigma=_BIAS_SIGMA))
        search.run(stamps[later], self.rates[later],
                   np.array(self._last_forces).reshape(-1, 3)[later])
        rest = search.estimate(int(stamps.max(initial=0)))
        return rest if rest.sigma < _BIAS_SIGMA else None


class Chosen(NamedTuple):
    """The topics to read; None if there is none of that kind."""

    image: Topic | None
    camera_info: Topic | None
    imu: Topic | None
    accel: Topic | None = None

    @property
    def all(self) -> list[Topic]:
        """All that exist."""
        return [topic for topic in self if topic]


class Scan:
    """Statistics of all streams; `images` is the number of images to come.

    `configured`: intrinsics in place of the CameraInfo's, if there are any.
    """

    def __init__(self, images: int, configured: IntrinsicsConfig) -> None:
        self._configured = configured
        self.by_parameters = configured.given
        self._every = max(images // _DECODED, 1)
        self.image_stamps, self.imu_stamps, self.inertial = Stamps(), Stamps(), Inertial()
        self.encodings: Counter[str] = Counter()             # images by encoding or format
        self.sizes: Counter[tuple[int, int]] = Counter()     # decoded images by (width, height)
        self.largest_image = 0                         # message of an image [bytes]
        self.intrinsics: Intrinsics | None = None
        self.calibrations = 0                          # number of changes of them
        self.bad_images = self.bad_imu = 0             # messages that cannot be used
        self.problems: dict[Role, str] = {}            # the first reason

    def add(self, role: Role, message: BagMessage) -> None:
        """Add the next message."""
        try:
            self._take(role, PARTS[role].read(message.message), message.bag_time_ns)
        except RsRelposeError as error:
            self.bad_images += role is Role.IMAGE
            self.bad_imu += role in (Role.IMU, Role.ACCEL)
            self.problems.setdefault(Role.IMU if role is Role.ACCEL else role, str(error))

    def _take(self, role: Role, data: Any, recorded_ns: int) -> None:
        if role is Role.IMAGE:
            self._add_image(data, recorded_ns)
        elif role is Role.CAMERA_INFO:
            if not self.by_parameters:
                self.calibrations += data != self.intrinsics
                self.intrinsics = data
        else:
            if role is Role.IMU:
                self.imu_stamps.add(data.stamp_ns, recorded_ns)
            self.inertial.add(data)

    def _add_image(self, image: EncodedImage, recorded_ns: int) -> None:
        encoding = image.encoding[:60]
        if encoding in self.encodings or len(self.encodings) < _MOST_ENCODINGS:
            self.encodings[encoding] += 1
        self.largest_image = max(self.largest_image, len(image.data))
        self.image_stamps.add(image.stamp_ns, recorded_ns)
        if (self.image_stamps.count - 1) % self._every:
            return
        height, width = image.decoded().shape
        self.sizes[width, height] += 1
        if self.by_parameters:
            self.intrinsics = self._configured.of_image(width, height)
