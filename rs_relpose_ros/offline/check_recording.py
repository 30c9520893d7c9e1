"""What `check` knows of a recording: statistics of one pass, and samples.

Of a message the pass keeps numbers only: 16 bytes, and another 48 of an IMU. Samples go through
the front end with the parameters as configured, and through a calibration: it completes
parameters that are missing, and replaces those that are too far off for the front end.
"""

from array import array
from collections import Counter
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import replace
from functools import cached_property
import math
from typing import Any, NamedTuple

import numpy as np
from scipy.spatial.transform import Rotation

from rs_relpose_ros.bags.reader import Bag, BagMessage
from rs_relpose_ros.bags.sensor_topics import SensorTopics
from rs_relpose_ros.calibrate import procedure
from rs_relpose_ros.calibrate.recording import read_recording, Recorder
from rs_relpose_ros.calibrate.result import CalibrationResult
from rs_relpose_ros.calibration import findings
from rs_relpose_ros.calibration.findings import (
    Assessment,
    BY_CODE,
    Code,
    Finding,
    FindingState,
    Why,
)
from rs_relpose_ros.calibration.residual_maps import ResidualMaps, with_maps
from rs_relpose_ros.config import settings
from rs_relpose_ros.config.settings import ImuConfig, IntrinsicsConfig, Parameters
from rs_relpose_ros.core.losses import SIGMA_PER_MEDIAN
from rs_relpose_ros.errors import InputError, RsRelposeError
from rs_relpose_ros.geometry import Array
from rs_relpose_ros.geometry.camera import Intrinsics
from rs_relpose_ros.geometry.timing import NANOSECONDS, Sensor, to_nanoseconds
from rs_relpose_ros.imu.buffer import ImuBuffer
from rs_relpose_ros.imu.filters import GyroBias
from rs_relpose_ros.messages.camera_info import intrinsics_from_info
from rs_relpose_ros.messages.incoming import (
    Intake,
    PARTS,
    ReasonCounts,
    Role,
    sensor_messages,
    stamp_ns,
)
from rs_relpose_ros.offline.replay import MessageRefused, outcomes
from rs_relpose_ros.pipeline.pair import Frame
from rs_relpose_ros.pipeline.pipeline import FrontEnd
from rs_relpose_ros.pipeline.warm_up import warm_up
from rs_relpose_ros.tracking.images import EncodedImage

# Uncertainty of the bias before it is measured at rest, 1 sigma [rad/s]. Rates within four of it
# can be rest: a smaller value would miss the rest of a sensor with a large bias, a larger one
# would take slow rotation for rest. [chosen: data sheets of phones have 0.01 to 0.05]
_BIAS_SIGMA = 0.03
# Number of images that are decoded, evenly over the recording. Fewer could miss a change of the
# size; more cost time alone. [chosen: 10 to 200 would do]
_DECODED = 40
# Number of different encodings that are counted. It bounds the memory of a damaged recording.
# [chosen: 5 to 1000 would do]
_MOST_ENCODINGS = 20


class StampStatistics:
    """Stamps (N,) of a topic [ns], in the order of recording, and how much later [s] that was."""

    def __init__(self, stamps_ns: Sequence[int], recorded_ns: Sequence[int]) -> None:
        recorded = np.array(recorded_ns, dtype=np.int64)
        order = np.argsort(recorded, kind='stable')
        recorded = recorded[order]
        self.ns = np.array(stamps_ns, dtype=np.int64)[order]
        self.count = len(self.ns)
        self.delay = math.nan
        self.duration = 0.0  # [s]
        if self.count:
            self.delay = float(np.median((recorded - self.ns) * 1e-9))
            self.duration = int(np.ptp(self.ns)) * 1e-9
        self.steps = np.diff(self.ns) * 1e-9  # (N - 1,) [s]; some may be zero or negative
        self.forwards = self.steps[self.steps > 0.0]
        self.longest = float(self.forwards.max(initial=0.0))
        # Median of the steps forwards [s], and the robust sigma of a step about it.
        self.interval = math.nan
        self.jitter = 0.0
        if len(self.forwards):
            self.interval = float(np.median(self.forwards))
            deviations = np.abs(self.forwards - self.interval)
            self.jitter = SIGMA_PER_MEDIAN * float(np.median(deviations))


class Scan:
    """Statistics of all streams; `images` is the number of images to come.

    `configured`: intrinsics in place of the CameraInfo's, if there are any.
    """

    def __init__(self, images: int, configured: IntrinsicsConfig) -> None:
        self.configured = configured
        self._every = max(images // _DECODED, 1)
        self._stamps = {role: (array('q'), array('q')) for role in (Role.IMAGE, Role.IMU)}
        self._rates = array('d')
        self._forces = array('d')
        self._buffer = ImuBuffer(ImuConfig(gyro_bias_sigma=_BIAS_SIGMA))
        self.orientations = 0  # of the IMU, with a covariance
        self.encodings: Counter[str] = Counter()  # images by encoding or format
        self.sizes: Counter[tuple[int, int]] = Counter()  # decoded images by (width, height)
        self.largest_image = 0  # message of an image [bytes]
        self.intrinsics: Intrinsics | None = None
        self.calibrations = 0  # number of changes of them
        self.contradictions: set[str] = set()  # of fields of the CameraInfo
        self.unusable: Counter[Role] = Counter()  # messages
        self.problems: dict[Role, str] = {}  # the first reason

    def add(self, role: Role, message: BagMessage) -> None:
        """Add the next message."""
        try:
            if role is Role.CAMERA_INFO:
                self._add_info(message.message)
                return
            data = PARTS[role].read(message.message)
            if role in self._stamps:
                stamps_ns, recorded_ns = self._stamps[role]
                stamps_ns.append(data.stamp_ns)
                recorded_ns.append(message.bag_time_ns)
            if role is Role.IMAGE:
                self._add_image(data)
            else:
                self.orientations += data.orientation is not None
                self._forces.extend(data.linear_acceleration or ())
                self._rates.extend(data.angular_velocity or ())
                self._buffer.add(data)
        except RsRelposeError as error:
            role = Role.IMU if role is Role.ACCEL else role
            self.unusable[role] += 1
            self.problems.setdefault(role, str(error))

    def _add_info(self, message: Any) -> None:
        found = intrinsics_from_info(message, self.contradictions.add)
        if not self.configured.given:
            self.calibrations += found != self.intrinsics
            self.intrinsics = found

    def added(
        self,
        source: Iterator[tuple[Role, BagMessage]],
    ) -> Iterator[tuple[Role, BagMessage]]:
        """The messages of a source, each added."""
        for role, message in source:
            self.add(role, message)
            yield role, message

    def _add_image(self, image: EncodedImage) -> None:
        encoding = image.encoding[:60]
        if encoding in self.encodings or len(self.encodings) < _MOST_ENCODINGS:
            self.encodings[encoding] += 1
        self.largest_image = max(self.largest_image, len(image.data))
        if (len(self._stamps[Role.IMAGE][0]) - 1) % self._every:
            return
        height, width = image.decoded().shape
        self.sizes[width, height] += 1
        if self.configured.given:
            self.intrinsics = self.configured.of_image(width, height)

    def stamps(self, role: Role) -> StampStatistics:
        """Stamps so far of the images or of the IMU, without those of a separate accelerometer."""
        return StampStatistics(*self._stamps[role])

    @cached_property
    def rates(self) -> Array:
        """Rates (K, 3) of the gyro [rad/s]; read this and the next after the last message."""
        return np.array(self._rates).reshape(-1, 3)

    @cached_property
    def forces(self) -> Array:
        """Specific forces (K, 3) [m/s^2], IMU frame."""
        return np.array(self._forces).reshape(-1, 3)

    @cached_property
    def rest(self) -> GyroBias | None:
        """Mean rate at rest; None if the IMU never was."""
        rest = self._buffer.bias(self._buffer.newest_ns or 0)
        return rest if rest.sigma < _BIAS_SIGMA else None


# Number of parts of consecutive images, evenly over the recording, and of images in each: three
# times 10 s at 30 Hz. Shorter parts have too few pairs to settle, more parts cost time.
# [chosen: 2 to 5 parts of 200 to 600 images would do]
_PARTS = 3
_PART_IMAGES = 300  # images of a part
# Number of images of a calibration. Fewer leave quantities unobserved, more cost time.
# [chosen: 20 s at 30 Hz; docs/calibration.md recommends 20 to 60 s]
_CALIBRATED_IMAGES = 600
# A part is evaluated by its last pair, and by those so long after its first one: fewer pairs are
# easily misled. [chosen: half to twice of it would do; the window of the monitor is 20 s]
_SETTLED_NS = to_nanoseconds(10.0)
# Pairs so far apart are of two parts. [chosen: between the longest interval of keyframes, 1 s, and
# the distance of two parts]
_APART_NS = to_nanoseconds(3.0)
# Share of the images below which hardly any was used. [chosen: 0.02 to 0.3 would do]
_FEW_USED = 0.1
# Share of the pairs that have a pose if the camera moves and is correctly configured. A larger one
# would calibrate each bag with rests again, a smaller one would miss a large deviation.
# [chosen: 0.5 to 0.8 would do]
_MOST_POSED = 0.7
# Quantities whose large deviations are detected, but not measured.
_FAR_OFF = frozenset((Code.AXES, Code.TIME_OFFSET, Code.IMAGE_GEOMETRY))
# Largest number of images that wait for the gyro: if the clocks differ it never comes. It bounds
# the memory. [chosen: above the delay of an IMU, 0.5 s, at 60 Hz; 32 to 256 would do]
_MOST_WAITING = 64
# Sigmas beyond which a calibration contradicts the configuration. [chosen: as in `check`]
_CERTAIN = 4.0
# Least angle [rad] and time [s] of such a contradiction: smaller ones the monitor measures better.
# [chosen: above the errors of a calibration of 20 s, below the reach of the monitor]
_LEAST_ANGLE = math.radians(5.0)
_LEAST_TIME = 8e-3  # [s]


class Completion(NamedTuple):
    """Parameters with the estimates of those that are not configured."""

    parameters: Parameters
    found: CalibrationResult | None = None  # None if none was needed, or possible
    problem: str = ''  # reason why a parameter is still missing


def calibrated(bag: Bag, topics: SensorTopics, parameters: Parameters) -> CalibrationResult:
    """Calibration without initial values, of images in the middle of the recording."""
    tracking = parameters.tracking
    images = topics.image.count
    first = _first_of_middle(topics)
    recording = read_recording(
        bag,
        topics,
        settings.TrackingConfig(detector=tracking.detector, feature_rows=tracking.feature_rows),
        images=range(first, first + min(images, _CALIBRATED_IMAGES)),
    )
    camera = recording.camera
    given = parameters.intrinsics
    if given.given:
        recording = replace(
            recording,
            focal_known=True,
            camera=given.of_image(camera.width, camera.height).global_shutter_camera(),
        )
    return procedure.calibrated(recording, settings.TRACKED_IN_IMAGES)


def completed(bag: Bag, topics: SensorTopics, parameters: Parameters) -> Completion:
    """`parameters` with estimates of readout time and axes, if these are missing."""
    missing = parameters.sensor.missing()
    if not missing:
        return Completion(parameters)
    try:
        found = calibrated(bag, topics, parameters)
    except InputError as error:
        return Completion(parameters, None, str(error))
    readout = found.readout_time
    axes = found.rotation
    values: dict[str, Any] = {}
    problems = [
        estimate.remark
        for name, estimate in (('quat_cam_imu_xyzw', axes), ('readout_time', readout))
        if name in missing and not estimate.observable
    ]
    if 'quat_cam_imu_xyzw' in missing and axes.observable:
        values['quat_cam_imu_xyzw'] = found.quat_cam_imu_xyzw
    if 'readout_time' in missing and readout.observable:
        values |= {
            'readout_time': abs(readout.value),
            'readout_direction': found.readout_direction,
        }
    return Completion(parameters.updated(values), found, next(iter(problems), ''))


def contradicted(
    found: CalibrationResult, sensor: settings.SensorConfig, model: Sensor
) -> tuple[Finding, ...]:
    """Parameters that are far from the calibration `found`; `model` as configured.

    None if it has no time offset: images and gyro are independent.
    """
    if not found.time_offset.observable:
        return ()
    readout = found.readout_time
    camera = model.camera
    angle = float(Rotation.from_matrix(found.R_cam_imu @ sensor.R_cam_imu.T).magnitude())
    # Of the stamped row; the calibration has that of row 0, at the median interval.
    share = camera.reference_row_index / camera.row_count
    off = (
        found.time_offset.value
        + share * readout.value
        - model.clock.reference_ns(0, to_nanoseconds(found.frame_interval)) / NANOSECONDS
    )
    signed = camera.signed_readout_time
    axes_sigma = float(found.rotation_sigma.max())
    offset_sigma = math.hypot(found.time_offset.sigma, share * readout.sigma)
    by_readout = _contradiction(Code.READOUT_TIME, abs(signed), abs(readout.value), readout.sigma)
    if np.sign(readout.value) * np.sign(signed) < 0.0:
        by_readout = replace(
            by_readout,
            code=Code.READOUT_DIRECTION,
            estimated=(-abs(readout.value),),
            settings={'readout_direction': found.readout_direction},
        )
    return tuple(
        finding
        for apart, sigma, least, finding in (
            (
                angle,
                axes_sigma,
                _LEAST_ANGLE,
                _contradiction(
                    Code.AXES,
                    0.0,
                    math.degrees(angle),
                    math.degrees(axes_sigma),
                    {'quat_cam_imu_xyzw': findings.rounded(found.quat_cam_imu_xyzw)},
                ),
            ),
            (
                off,
                offset_sigma,
                _LEAST_TIME,
                _contradiction(
                    Code.TIME_OFFSET, sensor.time_offset, sensor.time_offset + off, offset_sigma
                ),
            ),
            (readout.value - signed, readout.sigma, _LEAST_TIME, by_readout),
        )
        if abs(apart) > max(_CERTAIN * sigma, least)
    )


def _contradiction(
    code: Code,
    configured: float,
    estimated: float,
    sigma: float,
    settings: Mapping[str, Any] | None = None,
) -> Finding:
    """A parameter that a calibration contradicts; `settings`: None for the estimate itself."""
    return Finding(
        code,
        FindingState.WRONG,
        Why.BY_CALIBRATION,
        (configured,),
        (estimated,),
        sigma,
        BY_CODE[code].unit,
        settings={code.value: estimated} if settings is None else settings,
    )


# A suggested time offset is rounded to so many digits [s]. [chosen: the clocks of drivers agree
# to a millisecond; four would be as good]
_OFFSET_DIGITS = 3


def found_offset(
    bag: Bag, topics: SensorTopics, parameters: Parameters, apart: float
) -> float | None:
    """Time offset [s] near `apart` by the rotation of images and gyro, if poses come with it.

    None if the recording does not determine it, or if no pair has a pose with it.
    """
    recorder = Recorder(parameters.tracking)
    first = _first_of_middle(topics)
    number = 0
    for role, message in sensor_messages(bag, topics, faulty=True):
        of_middle = first <= number < first + _CALIBRATED_IMAGES
        is_image = role is Role.IMAGE
        if role in (Role.IMU, Role.CAMERA_INFO) or (is_image and of_middle):
            recorder.add(role, message.message)
        number += is_image
    recording = recorder.recording()
    gyro = recording.gyro
    shift_ns = to_nanoseconds(apart)
    shifted = replace(recording, gyro=replace(gyro, stamps_ns=gyro.stamps_ns - shift_ns))
    found = procedure.calibrated(shifted, settings.TRACKED_IN_IMAGES)
    if not found.time_offset.observable:
        return None
    of_stamped_row = _offset_of_row(found, parameters.sensor.stamp_row)
    offset = round(apart + of_stamped_row, _OFFSET_DIGITS)
    tried = parameters.updated({'time_offset': offset})
    bag.time_offset = offset
    sample = sampled(sensor_messages(bag, topics, faulty=True), topics.image.count, tried)
    return offset if sample.poses and sample.health.state is not FindingState.WRONG else None


def _first_of_middle(topics: SensorTopics) -> int:
    return max(topics.image.count - _CALIBRATED_IMAGES, 0) // 2


def _offset_of_row(found: CalibrationResult, stamp_row: str) -> float:
    """The time offset [s] of a calibration, which is that of row 0, for the stamped row."""
    share = {'first': 0.0, 'middle': 0.5, 'last': 1.0}[stamp_row]
    return found.time_offset.value + share * found.readout_time.value


class FrontEndSample(NamedTuple):
    """What the front end made of parts of a recording."""

    frames: int
    matches: list[int]  # of each pair
    poses: int
    reasons: ReasonCounts  # of frames that were not used, or of pairs without a pose
    health: Assessment  # of each quantity the worst finding of all parts
    is_refused: bool  # hardly any image could be used

    @property
    def few_poses(self) -> bool:
        """Whether many pairs have no pose."""
        return self.poses < _MOST_POSED * len(self.matches)

    @property
    def is_lost(self) -> bool:
        """Whether a deviation may be too large to be estimated from pairs."""
        return bool(self.matches) and (
            self.few_poses or not _FAR_OFF.isdisjoint(fault.code for fault in self.health.faults)
        )


def sampled(
    source: Iterable[tuple[Role, BagMessage]], images: int, parameters: Parameters
) -> FrontEndSample:
    """Parts of a recording of so many `images` through the front end.

    Parameters are used as configured: nothing is tracked, nothing is suppressed.
    """
    warm_up(parameters.estimator)
    parameters = parameters.updated(
        {'withhold_when_wrong': False, 'track_time_offset': False, 'track_readout_time': False}
    )
    front_end = FrontEnd(parameters, offline=True)
    counts: Counter[str] = Counter()  # of images: handed to the front end, and done there
    unused = ReasonCounts()
    chosen = _of_parts(source, front_end, images, counts, unused)
    poseless = ReasonCounts()
    matches = list[int]()
    poses = 0
    frames = part_since_ns = last_ns = 0
    before = findings.NOT_EVALUATED  # of the settled parts
    intake = Intake(front_end.sequencer, parameters)
    residuals = ResidualMaps()
    for outcome in outcomes(front_end, intake, chosen):
        if isinstance(outcome, MessageRefused):
            unused.add(str(outcome.error))
            continue
        counts['done'] += 1
        if not isinstance(outcome, Frame):
            unused.add(outcome.reason)
            continue
        frames += 1
        if (pair := outcome.result) is None:
            continue
        poses += bool(pair.pose)
        residuals.add(pair.residual_sums)
        if not pair.pose:
            poseless.add(pair.pose.reason)
        if not matches or not 0 <= pair.stamp_ns - last_ns < _APART_NS:
            before = findings.worst_of(before, pair.health)
            part_since_ns = pair.stamp_ns
        if pair.stamp_ns - part_since_ns >= _SETTLED_NS:
            before = findings.worst_of(before, front_end.health)
        matches.append(len(pair.matches))
        last_ns = pair.stamp_ns
    health = with_maps(findings.worst_of(before, front_end.health), residuals.maps())
    is_refused = frames < _FEW_USED * counts['handed']
    return FrontEndSample(
        frames, matches, poses, poseless if matches else unused, health, is_refused
    )


def _of_parts(
    source: Iterable[tuple[Role, BagMessage]],
    front_end: FrontEnd,
    images: int,
    counts: Counter[str],
    unused: ReasonCounts,
) -> Iterator[tuple[Role, BagMessage]]:
    """The messages without the images that belong to no part, or for which too many wait."""
    # Indices of the first images of the parts, which overlap in a short recording.
    firsts = [part * max(images - _PART_IMAGES, 0) // (_PARTS - 1) for part in range(_PARTS)]
    index = -1
    for role, message in source:
        if role is not Role.IMAGE:
            yield role, message
            continue
        index += 1
        is_in_part = any(0 <= index - first < _PART_IMAGES for first in firsts)
        if is_in_part and counts['handed'] - counts['done'] < _MOST_WAITING:
            counts['handed'] += 1
            yield role, message
            continue
        try:
            front_end.sequencer.pass_over(stamp_ns(message.message.header))
        except RsRelposeError as error:
            unused.add(str(error))
