"""All settings: the parameters of the nodes and of the commands, with units, ranges, defaults.

Configuration dataclasses are the only places of defaults; node parameters, YAML checks, ``--help``
and the parameter file with comments are derived from their fields.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
import dataclasses
from dataclasses import dataclass, field
import difflib
from functools import lru_cache
import math
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from rs_relpose_ros.errors import InputError, MissingInputError
from rs_relpose_ros.geometry import camera, validate
from rs_relpose_ros.geometry.camera import Intrinsics
from rs_relpose_ros.geometry.lens import DISTORTION_MODELS
from rs_relpose_ros.geometry.timing import ImageClock, Sensor, STAMP_EXPOSURES
from rs_relpose_ros.solvers.api import SOLVERS

# Words for the legal values of kinds without limits. [derived: the types]
ANY_VALUE = {bool: 'true or false', str: 'text'}


@dataclass(frozen=True, slots=True)
class Declared:
    """Declaration of a setting."""

    description: str
    unit: str = ''
    low: float = -math.inf
    high: float = math.inf
    choices: tuple[str, ...] = ()
    length: int | None = None
    live: bool = False  # a running node may change it
    restarts: bool = False  # it may, and begins again with the new value
    kind: type = float
    deviation: str = ''  # name in `core.deviations` of the deviation whose sigma this is

    @property
    def legal(self) -> str:
        """The legal values in words."""
        if self.choices:
            return 'one of ' + ', '.join(self.choices)
        if self.kind in ANY_VALUE:
            return ANY_VALUE[self.kind]
        text = validate.legal_range(self.low, self.high, self.unit)
        return f'{self.length} values, each {text}' if self.length is not None else text

    def check(self, name: str, value: Any) -> None:
        """Raise InputError unless `value` is legal."""
        if isinstance(value, str | bool):
            legal = not self.choices or value in self.choices
        else:
            values = list(value) if isinstance(value, tuple | list) else [value]
            legal = self.length is None or len(values) == self.length
            legal = legal and all(
                isinstance(v, int | float) and math.isfinite(v) and self.low <= v <= self.high
                for v in values
            )
        if not legal:
            raise InputError(f'{name} must be {self.legal}, got {value!r}')


def setting(
    default: Any, description: str, unit: str = '', *, kind: type | None = None, **legal: Any
) -> Any:
    """Field of a configuration dataclass, with its declaration as metadata.

    `legal`: other fields of `Declared`. A setting without a default (None) declares its `kind`.
    """
    legal.setdefault('live', legal.get('restarts', False))
    declared = Declared(description, unit, kind=type(default) if kind is None else kind, **legal)
    return dataclasses.field(default=default, metadata={'declared': declared})


def declared(field: dataclasses.Field[Any]) -> Declared:
    """Declaration of a field that `setting` made."""
    return field.metadata['declared']


@dataclass(frozen=True, slots=True)
class Settings:
    """Base of configuration dataclasses: checks every declared field."""

    def __post_init__(self) -> None:
        for item in dataclasses.fields(self):
            if 'declared' not in item.metadata:
                continue
            value = getattr(self, item.name)
            kind = declared(item).kind
            if value is None and item.default is None:
                continue
            if kind is tuple and isinstance(value, list | tuple):
                value = tuple(float(v) if type(v) is int else v for v in value)
            elif kind is float and type(value) is int:
                value = float(value)
            object.__setattr__(self, item.name, value)
            if not isinstance(value, float) if kind is float else type(value) is not kind:
                raise InputError(f'{item.name} must be of type {kind.__name__}, got {value!r}')
            declared(item).check(item.name, value)


# Legal values of the parameter solver. [derived: the table of solvers]
SOLVER_CHOICES = ('auto', *SOLVERS)


class CarrierMotion(NamedTuple):
    """Range of the speeds of a carrier [m/s], and its rms acceleration per axis [m/s^2]."""

    slow: float
    fast: float
    acceleration: float


# Carriers by the value of the parameter motion. A range that is too narrow excludes the true
# baseline, a wide one makes it less certain. [chosen: from slow to the usual top speed]
MOTIONS = {
    'hand_held': CarrierMotion(0.1, 3.0, 1.5),
    'vehicle': CarrierMotion(0.5, 40.0, 1.5),
    'drone': CarrierMotion(0.2, 15.0, 3.0),
}
# Legal values of the parameter refinement. [derived: the paper has the last two]
REFINEMENTS = ('map', 'alternating', 'none')


@dataclass(frozen=True, slots=True)
class EstimatorConfig(Settings):
    """Estimation of one frame pair."""

    solver: str = setting(
        'auto',
        'minimal solver of the hypotheses; auto chooses by the available IMU data',
        choices=SOLVER_CHOICES,
    )
    refinement: str = setting(
        'map',
        'joint fit with IMU priors (map), the scheme of the paper (alternating), or none',
        choices=REFINEMENTS,
    )
    threshold: float = setting(
        2.0, 'inlier threshold on the Sampson error', 'px', low=0.05, high=50.0, live=True
    )
    pixel_sigma: float = setting(
        0.5, 'noise of a match, 1 sigma per coordinate', 'px', low=0.01, high=20.0, live=True
    )
    gravity_sigma: float = setting(
        0.02,
        "noise of one frame's gravity direction, 1 sigma per axis",
        'rad',
        low=1e-5,
        high=1.5,
        live=True,
    )
    gyro_sigma: float = setting(
        0.005,
        "noise of one frame's mean angular rate, 1 sigma per axis, bias error included",
        'rad/s',
        low=1e-6,
        high=1.0,
        live=True,
    )
    stamp_sigma: float = setting(
        0.0,
        "error of an image's stamp, 1 sigma; a larger scatter of the stamps about a constant "
        'frame rate replaces it. It changes covariances, not poses',
        's',
        low=0.0,
        high=0.1,
        live=True,
    )
    confidence: float = setting(
        0.999,
        'probability of an outlier-free sample at which sampling stops',
        low=0.5,
        high=0.999999,
        live=True,
    )
    max_iterations: int = setting(
        1000, 'largest number of hypothesis samples', low=1, high=1_000_000, live=True
    )
    time_limit: float = setting(
        0.0,
        'largest time for sampling; 0 is no limit (required for repeatable results)',
        's',
        low=0.0,
        high=60.0,
        live=True,
    )
    min_inliers: int = setting(
        15, 'least number of inliers of a pose', low=6, high=10_000, live=True
    )
    min_parallax: float = setting(
        1.0,
        'least median parallax, after the estimated rotation, of a pair with a translation',
        'px',
        low=0.0,
        high=500.0,
        live=True,
    )
    max_translation_sigma: float = setting(
        10.0,
        'largest 1 sigma of the direction of translation (root of the trace of its '
        'covariance); beyond it a pair has a rotation but no pose',
        'deg',
        low=0.01,
        high=180.0,
        live=True,
    )
    motion: str = setting(
        'hand_held',
        'carrier of the camera: its speed and acceleration, if images and '
        'accelerometer do not determine them',
        choices=tuple(MOTIONS),
    )


@dataclass(frozen=True, slots=True)
class ImuConfig(Settings):
    """Noise of the sensors, gravity filter, gaps of the IMU data."""

    gyro_bias: tuple[float, ...] = setting(
        (0.0, 0.0, 0.0),
        'gyro bias in the IMU frame, subtracted',
        'rad/s',
        low=-1.0,
        high=1.0,
        length=3,
        restarts=True,
    )
    gyro_noise_density: float = setting(
        2e-4, 'white noise of the gyro', 'rad/s/sqrt(Hz)', low=1e-7, high=0.1
    )
    gyro_bias_sigma: float = setting(
        3e-3,
        'uncertainty of gyro_bias, 1 sigma per axis',
        'rad/s',
        low=0.0,
        high=1.0,
        restarts=True,
        deviation='gyro_bias',
    )
    accel_noise_density: float = setting(
        3e-3, 'white noise of the accelerometer', 'm/s^2/sqrt(Hz)', low=1e-6, high=10.0
    )
    accel_bias_sigma: float = setting(
        0.1,
        'bias of the accelerometer that the gravity estimate does not absorb, 1 sigma per axis',
        'm/s^2',
        low=0.0,
        high=10.0,
    )
    accel_scale_sigma: float = setting(
        0.03,
        'scale of the accelerometer, 1 sigma: published baselines have at least this relative '
        'sigma',
        low=0.0,
        high=1.0,
    )
    imu_position: tuple[float, ...] = setting(
        (0.0, 0.0, 0.0),
        'position of the IMU in the camera frame',
        'm',
        low=-5.0,
        high=5.0,
        length=3,
        restarts=True,
    )
    imu_position_sigma: float = setting(
        0.03,
        'uncertainty of imu_position, 1 sigma per axis',
        'm',
        low=0.0,
        high=5.0,
        restarts=True,
    )
    track_gyro_bias: bool = setting(
        True, 're-estimate the gyro bias whenever the IMU is at rest (within 4 gyro_bias_sigma)'
    )
    use_imu_orientation: bool = setting(
        True,
        'gravity from the orientation of the IMU message, if its covariance marks it as '
        'present and it agrees with the accelerometer',
    )
    gravity_filter: str = setting(
        'complementary',
        'gravity from gyro and accelerometer (complementary), or the mean '
        'specific force of the last 0.1 s as in the paper (mean)',
        choices=('complementary', 'mean'),
    )
    gravity_time_constant: float = setting(
        5.0, 'time constant of the complementary filter at rest', 's', low=0.05, high=100.0
    )
    gravity_acceleration_sigma: float = setting(
        1.0,
        'acceleration of the camera that the gravity filter assumes, 1 sigma per axis',
        'm/s^2',
        low=0.01,
        high=20.0,
    )
    max_imu_gap: float = setting(
        0.05, 'longest step between gyro samples that is interpolated', 's', low=1e-3, high=1.0
    )
    stuck_gyro_time: float = setting(
        0.025,
        'a gyro that repeats its values bit by bit for longer is stuck or saturated and is '
        'not used; 0 disables the check, for simulations without noise',
        's',
        low=0.0,
        high=10.0,
    )
    imu_buffer_seconds: float = setting(5.0, 'length of IMU history kept', 's', low=1.0, high=60.0)


@dataclass(frozen=True, slots=True)
class KeyframeConfig(Settings):
    """Conditions under which a frame creates a pair with the reference keyframe."""

    min_keyframe_parallax: float = setting(
        12.0,
        'median parallax, after derotation, that creates a keyframe pair',
        'px',
        low=0.0,
        high=1000.0,
        live=True,
    )
    max_keyframe_interval: float = setting(
        0.5,
        'age of the reference keyframe that creates a pair at any parallax',
        's',
        low=0.0,
        high=60.0,
        live=True,
    )
    max_keyframe_frames: int = setting(
        30, 'number of frames that creates a pair at any parallax', low=1, high=1000, live=True
    )
    min_tracked_fraction: float = setting(
        0.4,
        'a smaller fraction of features still tracked creates a pair',
        low=0.0,
        high=1.0,
        live=True,
    )


@dataclass(frozen=True, slots=True)
class OdometryConfig(Settings):
    """odometry_node and `rs_relpose odometry`: graph of keyframes, start and end, outputs."""

    odometry_frame: str = setting(
        'odom', 'frame_id of the odometry: z up, origin and heading those of the first keyframe'
    )
    base_frame: str = setting(
        '', "frame_id of the robot, whose pose and twist are published; empty for the camera's"
    )
    base_to_camera: tuple[float, ...] | None = setting(
        None,
        'pose of the camera in base_frame, as a static transform: x y z [m], quaternion x y '
        'z w; from /tf_static if not given',
        low=-100.0,
        high=100.0,
        length=7,
        kind=tuple,
    )
    odometry_rate: float = setting(
        30.0,
        'rate of the odometry between keyframes, propagated by the IMU',
        'Hz',
        low=0.0,
        high=1000.0,
    )
    publish_odometry_tf: bool = setting(
        False,
        'broadcast base_frame as a child of odometry_frame on /tf; it must have no other '
        'parent; needs tf2_ros',
    )
    smoothing_lag: float = setting(
        4.0, 'length of the window of keyframes that is optimised', 's', low=0.5, high=60.0
    )
    max_scale_sigma: float = setting(
        0.1, 'relative uncertainty of the speed below which odometry starts', low=1e-3, high=1.0
    )
    max_coast: float = setting(
        10.0,
        'longest propagation on the IMU alone, without a pair; then the path is lost',
        's',
        low=0.1,
        high=60.0,
    )
    max_position_sigma: float = setting(
        1.0,
        'growth of the uncertainty of the position (1 sigma, of its length) since the last '
        'usable pair at which the path is lost',
        'm',
        low=0.01,
        high=1e3,
    )
    max_heading_sigma: float = setting(
        0.35, 'the same for the heading', 'rad', low=1e-3, high=3.15
    )
    gyro_bias_walk: float = setting(
        2e-5, 'random walk of the gyro bias', 'rad/s^2/sqrt(Hz)', low=1e-9, high=0.1
    )
    accel_bias_walk: float = setting(
        1e-3, 'random walk of the accelerometer bias', 'm/s^3/sqrt(Hz)', low=1e-9, high=1.0
    )
    pure_rotation_motion: float = setting(
        0.005,
        'largest displacement of a pair without visible translation, 1 sigma per axis: the '
        'noise of a match times the distance of the scene',
        'm',
        low=1e-3,
        high=1e3,
    )

    def __post_init__(self) -> None:
        Settings.__post_init__(self)
        if self.base_to_camera is not None:
            validate.unit_length('the quaternion of base_to_camera', self.base_to_camera[3:], 1e-2)


# Tracker by name: a class that implements `rs_relpose_ros.tracking.features.Tracker`, imported on
# first use. To add a tracker, write its module and a row here. [derived: the modules]
TRACKERS = {
    'klt': 'rs_relpose_ros.tracking.klt:KltTracker',
    'orb': 'rs_relpose_ros.tracking.features:DescriptorTracker',
    'sift': 'rs_relpose_ros.tracking.features:DescriptorTracker',
}


@dataclass(frozen=True, slots=True)
class TrackingConfig(Settings):
    """Detection and tracking of features."""

    detector: str = setting(
        'klt',
        'klt follows corners from frame to frame; orb and sift match descriptors, for '
        'baselines too wide for tracking',
        choices=tuple(TRACKERS),
    )
    max_features: int = setting(300, 'corners of a new reference keyframe', low=8, high=5000)
    max_descriptors: int = setting(1500, 'keypoints per image for orb and sift', low=8, high=20000)
    min_feature_distance: float = setting(
        10.0, 'least distance between corners', 'px', low=1.0, high=500.0
    )
    feature_quality: float = setting(
        4.0,
        'least eigenvalue of the structure tensor of a corner, mean over its window',
        'gray^2/px^2',
        low=1e-3,
        high=1e4,
    )
    feature_rows: tuple[float, ...] = setting(
        (0.0, 0.0),
        'first and last image row that features may lie in; 0, 0 for all',
        'px',
        low=0.0,
        high=1e5,
        length=2,
    )
    klt_window: int = setting(15, 'side of the window of a corner, odd', 'px', low=5, high=63)
    klt_levels: int = setting(4, 'levels of the image pyramid', low=1, high=8)
    forward_backward_threshold: float = setting(
        0.7, 'largest distance after tracking forth and back', 'px', low=0.01, high=20.0
    )
    min_correlation: float = setting(
        0.75,
        'least correlation of a window with that in the reference keyframe',
        low=0.0,
        high=1.0,
    )
    match_ratio: float = setting(
        0.8, 'largest ratio of best to second best descriptor distance', low=0.1, high=1.0
    )

    def __post_init__(self) -> None:
        Settings.__post_init__(self)
        if self.klt_window % 2 == 0:
            raise InputError(f'klt_window must be odd, got {self.klt_window}')
        first, last = self.feature_rows
        if last != 0.0 and last <= first:
            raise InputError(
                'feature_rows must be first row, last row with first < last '
                f'(0, 0 for all), got {list(self.feature_rows)}'
            )


@dataclass(frozen=True, slots=True)
class CalibrationConfig(Settings):
    """Calibration: search, exposure, and how certain an observable parameter must be."""

    max_time_offset: float = setting(
        0.25, 'largest clock offset that is searched for', 's', low=0.01, high=5.0
    )
    tolerance: float = setting(
        1.0, 'factor of the largest sigmas of observable parameters', low=0.1, high=10.0
    )
    unnoticed_tolerance: float = setting(
        1.0,
        'the same where the doubt moves the direction of the median pair by less than its '
        'own sigma',
        low=0.1,
        high=10.0,
    )
    max_rotation_sigma: float = setting(
        math.radians(0.7),
        'largest sigma of an observable rotation, each axis, at a tolerance of 1',
        'rad',
        low=1e-5,
        high=1.0,
    )
    search_overlap: bool = setting(
        True,
        'whether an offset beyond max_time_offset is searched, over the whole overlap of images '
        'and gyro',
    )
    offset_at_end: bool = setting(
        False,
        'whether the offset of a clock that was set or drifts is that of the end, for a node that '
        'goes on, and not that of the begin or the middle',
    )
    exposed: bool = setting(
        False, 'whether a tracker followed the points in images with an exposure time'
    )
    exposure_time: float = setting(
        0.0, 'exposure of a row; 0 if it is not known', 's', low=0.0, high=1.0
    )
    exposure_margin: float = setting(
        0.0,
        'frame interval less exposure, where automatic exposure lengthens the interval; 0 if '
        'it is not known',
        's',
        low=0.0,
        high=1.0,
    )


# Settings of a calibration from images, whose exposure is not zero. [derived: the field `exposed`]
TRACKED_IN_IMAGES = CalibrationConfig(exposed=True)


@dataclass(frozen=True, slots=True)
class GlobalShutterConfig(Settings):
    """global_shutter_node and `unroll`: stamps and borders of the derotated images."""

    stamp_clock: str = setting(
        'imu',
        'clock of the stamps of derotated images (global_shutter_node, unroll), which mark '
        "the middle row: the IMU's, for a SLAM system with a time offset of 0, or the camera's, "
        'for use with depth or stereo images',
        choices=('imu', 'camera'),
    )
    border: str = setting(
        'replicate',
        'content of derotated images beyond the original image: the nearest pixel, or black',
        choices=('replicate', 'black'),
    )


def pinhole_of_matrix(name: str, k: Sequence[float]) -> dict[str, Any]:
    """``fx, fy, cx, cy`` of a camera matrix, row by row; `name` is its name in an InputError."""
    fx, skew, cx, lower, fy, cy, *last_row = validate.array(name, k, (9,)).tolist()
    if skew or lower or last_row != [0.0, 0.0, 1.0]:
        raise InputError(f'{name} must be [fx 0 cx 0 fy cy 0 0 1], got {list(k)}')
    return {'fx': fx, 'fy': fy, 'cx': cx, 'cy': cy}


def _sigma(of: str, unit: str, high: float, per: str = '', *, deviation: str = '') -> Any:
    """Sigma of a calibrated parameter, which is the sigma of a `deviation`."""
    return setting(
        0.0,
        f'{of}, 1 sigma{per}; 0 if it is not known',
        unit,
        low=0.0,
        high=high,
        restarts=True,
        deviation=deviation,
    )


@dataclass(frozen=True, slots=True)
class IntrinsicsConfig(Settings):
    """Intrinsics in place of the CameraInfo's, named as by camera_calibration."""

    camera_matrix: tuple[float, ...] | None = setting(
        None,
        'intrinsics fx 0 cx 0 fy cy 0 0 1 of the images as published, with distortion_model '
        'and distortion_coefficients in place of the CameraInfo',
        'px',
        length=9,
        kind=tuple,
        restarts=True,
    )
    distortion_model: str = setting(
        'plumb_bob',
        'distortion model that belongs to camera_matrix',
        choices=tuple(DISTORTION_MODELS),
        restarts=True,
    )
    distortion_coefficients: tuple[float, ...] | None = setting(
        None,
        'coefficients of distortion_model in the order of OpenCV; no distortion if not given',
        kind=tuple,
        restarts=True,
    )
    focal_length_sigma: float = _sigma(
        'relative uncertainty of the focal length', '', 1.0, deviation='focal_log'
    )
    distortion_sigma: float = _sigma(
        'uncertainty of the lens, as k1 that displaces as much', '', 10.0, deviation='distortion'
    )
    principal_point_sigma: float = _sigma(
        'uncertainty of the principal point',
        'px',
        1e4,
        ' per axis',
        deviation='principal_point',
    )

    def __post_init__(self) -> None:
        Settings.__post_init__(self)
        if self.given:
            try:
                self.of_image(1, 1)
            except InputError as error:
                raise InputError(f'camera_matrix and its distortion: {error}') from error
        elif self.distortion_coefficients is not None:
            raise InputError('distortion_coefficients belong to a camera_matrix, which is absent')

    @property
    def given(self) -> bool:
        """Whether there are intrinsics."""
        return self.camera_matrix is not None

    def of_image(self, width: int, height: int) -> Intrinsics:
        """The intrinsics for images of this size, which cover the whole sensor."""
        if self.camera_matrix is None:
            raise MissingInputError('parameter camera_matrix is not set')
        return Intrinsics(
            width=width,
            height=height,
            image_width=width,
            image_height=height,
            distortion_model=self.distortion_model,
            distortion=self.distortion_coefficients or (),
            **pinhole_of_matrix('camera_matrix', self.camera_matrix),
        )


_matrix = lru_cache(maxsize=16)(lambda quat_xyzw: Rotation.from_quat(quat_xyzw).as_matrix())


@dataclass(frozen=True, slots=True)
class SensorConfig(Settings):
    """Readout, clock and axes of camera and IMU, which no message provides."""

    readout_time: float | None = setting(
        None,
        'number of rows times line delay; 0 for a global shutter',
        's',
        low=0.0,
        high=0.5,
        kind=float,
        restarts=True,
    )
    readout_time_sigma: float = _sigma(
        'uncertainty of readout_time', 's', 1.0, deviation='readout_time'
    )
    readout_direction: str = setting(
        'down',
        'whether row 0 is read first (down) or last (up); for images turned by 90 deg, whose '
        'columns are the rows of the sensor: whether the left column is read first (right) or '
        'last (left)',
        choices=camera.READOUT_DIRECTIONS,
        restarts=True,
    )
    stamp_row: str = setting(
        'first', 'row that the image stamp marks', choices=camera.REFERENCE_ROWS, restarts=True
    )
    pose_row: str = setting(
        'stamp',
        'rows that poses relate and their stamps mark: those of the image stamps, or the '
        'middle rows, between which the translation is more accurate',
        choices=('stamp', 'middle'),
    )
    stamp_exposure: str = setting(
        'middle',
        'time within the exposure of that row that the stamp marks',
        choices=STAMP_EXPOSURES,
        restarts=True,
    )
    exposure_time: float = setting(
        0.0,
        'exposure time of a row, over which the gyro is averaged',
        's',
        low=0.0,
        high=1.0,
        restarts=True,
    )
    exposure_margin: float = setting(
        0.0,
        'in place of exposure_time: the exposure is the interval between frames less this '
        '(automatic exposure in little light); 0 for none',
        's',
        low=0.0,
        high=1.0,
        restarts=True,
    )
    time_offset: float = setting(
        0.0,
        'IMU clock minus camera clock: t_imu = stamp + time_offset',
        's',
        low=-1e5,
        high=1e5,
        restarts=True,
    )
    time_offset_sigma: float = _sigma(
        'uncertainty of time_offset', 's', 10.0, deviation='time_offset'
    )
    time_offset_per_interval: float = setting(
        0.0,
        'change of time_offset with the interval T between frames (automatic exposure): '
        't_imu = stamp + time_offset + time_offset_per_interval (T - '
        'time_offset_reference_interval)',
        's/s',
        low=-5.0,
        high=5.0,
        restarts=True,
    )
    time_offset_per_interval_sigma: float = _sigma(
        'uncertainty of time_offset_per_interval', 's/s', 5.0
    )
    time_offset_reference_interval: float = setting(
        0.0,
        'interval between frames at which time_offset holds; used with time_offset_per_interval',
        's',
        low=0.0,
        high=10.0,
        restarts=True,
    )
    track_time_offset: bool = setting(
        False,
        'apply the time offset that is tracked at run time (it is always reported)',
        live=True,
    )
    track_readout_time: bool = setting(
        False,
        'apply the readout time that is tracked at run time (it is always reported)',
        live=True,
    )
    quat_cam_imu_xyzw: tuple[float, ...] | None = setting(
        None,
        'rotation IMU to camera, v_cam = R(q) v_imu; x y z w',
        low=-1.0,
        high=1.0,
        length=4,
        kind=tuple,
        restarts=True,
    )
    axes_sigma: float = _sigma(
        'uncertainty of quat_cam_imu_xyzw', 'rad', 1.0, ' per axis', deviation='axes'
    )

    def __post_init__(self) -> None:
        Settings.__post_init__(self)
        if self.quat_cam_imu_xyzw is not None:
            validate.unit_length('quat_cam_imu_xyzw', self.quat_cam_imu_xyzw, 1e-2)
        if self.exposure_time and self.exposure_margin:
            raise InputError('give exposure_time or exposure_margin, not both')

    @property
    def R_cam_imu(self) -> NDArray[np.float64]:
        """Rotation matrix of `quat_cam_imu_xyzw`."""
        if self.quat_cam_imu_xyzw is None:
            raise MissingInputError(
                'parameter quat_cam_imu_xyzw is not set: give the rotation '
                'from IMU to camera, v_cam = R(q) v_imu, as [x, y, z, w]'
            )
        return _matrix(self.quat_cam_imu_xyzw).copy()

    def missing(self) -> list[str]:
        """Names of the required settings that are not given."""
        return [
            name for name in ('readout_time', 'quat_cam_imu_xyzw') if getattr(self, name) is None
        ]


@dataclass(frozen=True, slots=True)
class StoredCalibrationConfig(Settings):
    """Calibration at the start of relpose_node, and its file."""

    calibrate_at_start: str = setting(
        'missing',
        'calibrate from the images and the gyro at the start: if a required parameter '
        'and the file are missing, always, or never',
        choices=('missing', 'always', 'never'),
    )
    calibration_file: str = setting(
        '',
        'file of the calibration; empty for <camera_name>_<width>x<height>.yaml in '
        '${ROS_HOME:-~/.ros}/rs_relpose',
    )
    camera_name: str = setting('', 'name of the camera; empty for the frame_id of its images')
    load_calibration: bool = setting(True, 'use the file, if it exists')
    save_calibration: bool = setting(True, 'write the file after a calibration')
    use_tf: bool = setting(
        True,
        'quat_cam_imu_xyzw (+- 5 deg) and imu_position (+- 2 cm) from /tf_static and /tf '
        'where they are not given; a rotation that differs is reported',
    )


@lru_cache(maxsize=16)
def sensor_model(
    intrinsics: Intrinsics, config: SensorConfig, readout_correction: float = 0.0
) -> Sensor:
    """Camera and clock of images with these intrinsics: the only place that builds them.

    The reference row of both is the row that poses relate. `readout_correction` [s] is added to
    the configured readout time, which stays >= 0.
    """
    if config.readout_time is None:
        raise MissingInputError(
            'parameter readout_time is not set: give number of rows times line '
            'delay in seconds (0 for a global shutter)'
        )
    camera = dataclasses.replace(
        intrinsics.global_shutter_camera(),
        readout_time=max(config.readout_time + readout_correction, 0.0),
        readout_direction=config.readout_direction,
        reference_row='middle' if config.pose_row == 'middle' else config.stamp_row,
    )
    stamped = dataclasses.replace(camera, reference_row=config.stamp_row)
    delay = float(stamped.row_times(camera.reference_row_index))
    return Sensor(
        camera,
        intrinsics,
        ImageClock(
            camera,
            config.time_offset + delay,
            config.stamp_exposure,
            config.exposure_time,
            config.time_offset_per_interval,
            config.time_offset_reference_interval,
            config.exposure_margin,
        ),
        delay,
    )


@dataclass(frozen=True, slots=True)
class PairConfig(Settings):
    """Use of the IMU by the estimator, and outputs of relpose_node."""

    use_gyro_rotation: bool = setting(
        True,
        'gyro between the frames as rotation prior and hypothesis (otherwise it only '
        'derotates rows)',
    )
    use_gravity: bool = setting(True, 'gravity as prior and for the 3- and 9-point solvers')
    use_accelerometer: bool = setting(
        True,
        'accelerometer between the frames for velocities and baseline, with '
        'use_gyro_rotation (otherwise it only gives gravity)',
    )
    withhold_when_wrong: bool = setting(
        True,
        'suppress poses (global_shutter_node: images) while a configured parameter '
        'contradicts the data (see health in /diagnostics)',
        live=True,
    )
    reference_frame: str = setting(
        '', 'frame_id of relative poses; empty for <camera frame>_reference'
    )
    image_transport: str = setting('raw', 'transport of the images', choices=('raw', 'compressed'))
    publish_debug_image: bool = setting(
        True, 'publish ~/debug_image of every pair while it has a subscriber', live=True
    )
    publish_tf: bool = setting(
        False, 'broadcast the reference keyframe as a child of the camera on /tf; needs tf2_ros'
    )
    stamps_file: str = setting(
        '', 'file of the stamps of all processed frames, for replay --stamps; empty for none'
    )
    timings_file: str = setting(
        '',
        'CSV file of the times at which each processed frame was ready, taken and done; empty '
        'for none',
    )
    seed: int = setting(
        0, 'seed of the random state of a pair, together with both stamps', low=0, high=2**31 - 1
    )


@dataclass(frozen=True, slots=True)
class Parameters:
    """All parameters, grouped by the module that uses them; flat names are unique."""

    sensor: SensorConfig = field(default_factory=SensorConfig)
    calibration: StoredCalibrationConfig = field(default_factory=StoredCalibrationConfig)
    intrinsics: IntrinsicsConfig = field(default_factory=IntrinsicsConfig)
    pair: PairConfig = field(default_factory=PairConfig)
    keyframes: KeyframeConfig = field(default_factory=KeyframeConfig)
    tracking: TrackingConfig = field(default_factory=TrackingConfig)
    imu: ImuConfig = field(default_factory=ImuConfig)
    estimator: EstimatorConfig = field(default_factory=EstimatorConfig)
    global_shutter: GlobalShutterConfig = field(default_factory=GlobalShutterConfig)
    odometry: OdometryConfig = field(default_factory=OdometryConfig)

    @staticmethod
    def declarations() -> Iterator[tuple[str, Any, Declared]]:
        """Name, default (None where the user must give one) and declaration of every parameter."""
        for group in dataclasses.fields(Parameters):
            for item in dataclasses.fields(group.default_factory):  # type: ignore[arg-type]
                yield item.name, item.default, declared(item)

    def deviation_sigmas(self) -> dict[str, float]:
        """Configured sigmas by the names of their deviations; 0 where they are not known."""
        return {
            declared(item).deviation: getattr(group, item.name)
            for group in (self.sensor, self.imu, self.intrinsics)
            for item in dataclasses.fields(group)
            if declared(item).deviation
        }

    @classmethod
    def from_mapping(cls, values: Mapping[str, Any]) -> Parameters:
        """Defaults overridden by `values`, by flat name."""
        return cls().updated(values)

    def updated(self, values: Mapping[str, Any]) -> Parameters:
        """A copy with other values by name; InputError for unknown names and illegal values."""
        known = [name for name, _, _ in self.declarations()]
        for name in values:
            if name not in known:
                near = difflib.get_close_matches(name, known, n=3)
                hint = f'; did you mean {" or ".join(near)}?' if near else ''
                raise InputError(f'there is no parameter {name!r}{hint}')
        groups = [getattr(self, group.name) for group in dataclasses.fields(self)]
        return Parameters(
            *(
                dataclasses.replace(
                    config,
                    **{
                        item.name: values[item.name]
                        for item in dataclasses.fields(config)
                        if item.name in values
                    },
                )
                for config in groups
            )
        )

    def given(self) -> dict[str, Any]:
        """The parameters that are not at their defaults, by flat name."""
        defaults = Parameters().to_mapping()
        return {
            name: value for name, value in self.to_mapping().items() if value != defaults[name]
        }

    def to_mapping(self) -> dict[str, Any]:
        """Every parameter by flat name."""
        configs = [getattr(self, group.name) for group in dataclasses.fields(self)]
        return {
            item.name: getattr(config, item.name)
            for config in configs
            for item in dataclasses.fields(config)
        }
