"""Findings of the consistency monitor and of `check` as objects, and the quantities they cover.

A finding has codes and numbers; `findings_text` makes its text where it leaves the process. The
deviations of the quantities are values of the selection `LIVE` of `core.deviations`.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from enum import Enum
import math
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import ArrayLike

from rs_relpose_ros.config.settings import SensorConfig
from rs_relpose_ros.core.deviations import LIVE
from rs_relpose_ros.core.radial import corner_radius, displacements, independent_shapes
from rs_relpose_ros.geometry import Array
from rs_relpose_ros.geometry.camera import RollingShutterCamera

# Largest change of the time offset that tracking applies [s]. A larger one means that stamps mark
# another event, which a human should know. [chosen: the prior sigma of the offset]
LARGEST_OFFSET = 0.05
# Largest change of the readout time that tracking applies [s]. A larger one means another mode of
# the camera. [chosen: a third of a usual readout time]
LARGEST_READOUT = 0.01


# Largest sigma of the displacement of the image's corner, over its radius, with which distortion
# counts as observable. A larger one would report distortion that nothing determines but its prior
# of 2 %, a smaller one would not report that of weak motion.
# [chosen: 0.05 of k1 in an image of 640x480 with a focal length of 500 px]
_OBSERVABLE_DISPLACEMENT = 0.03
# Largest sigma of p1 and p2 with which they count as observable. A larger one would report what
# nothing determines but their prior, 0.002. [chosen: three quarters of the prior]
_OBSERVABLE_TANGENTIAL = 1.5e-3


class FindingState(str, Enum):
    """Consistency of a quantity with the data, from good to bad."""

    OK = 'ok'
    UNKNOWN = 'unknown'  # not observable, or not measured
    SUSPECT = 'suspect'  # inconsistent for certain, by enough to matter
    WRONG = 'wrong'  # poses are outside of their covariance, or the estimation fails

    @property
    def verdict(self) -> str:
        """The state as `check` names it."""
        return {'suspect': 'warning', 'wrong': 'failure'}.get(self.value, self.value)


class Code(str, Enum):
    """What a finding is about; the value is its name in messages, JSON and logs."""

    # Parameters that images and gyro determine: `QUANTITIES`.
    AXES = 'axes'
    TIME_OFFSET = 'time_offset'
    READOUT_TIME = 'readout_time'
    GYRO_BIAS = 'gyro_bias'
    GYRO_SCALE = 'gyro_scale'
    FOCAL_LENGTH = 'focal_length'
    ASPECT = 'aspect'
    DISTORTION = 'distortion'
    TANGENTIAL = 'tangential'
    PRINCIPAL_POINT = 'principal_point'
    # Further causes that the consistency monitor names.
    READOUT_DIRECTION = 'readout_direction'
    GYRO_UNIT = 'gyro_unit'
    IMAGE_GEOMETRY = 'image_geometry'
    ACCEL_AXES = 'accel_axes'
    ACCEL_SCALE = 'accel_scale'
    REPEATED_IMAGES = 'repeated_images'
    STATIC_REGION = 'static_region'
    INTERIOR = 'interior'
    MOVING_OBJECT = 'moving_object'
    OFFSET_STEP = 'offset_step'
    OFFSET_DRIFT = 'offset_drift'
    FOCAL_DRIFT = 'focal_drift'
    UNKNOWN_CAUSE = 'unknown_cause'
    # Causes that the odometry names.
    GYRO_NOISE = 'gyro_noise'
    STAMP_JITTER = 'stamp_jitter'
    ACCEL_NOISE = 'accel_noise'
    KNOCK = 'knock'
    # Properties of a recording: `is_property`.
    TOPICS = 'topics'
    PARAMETERS = 'parameters'
    TRANSFORMS = 'transforms'
    IMAGES = 'images'
    TRANSPORT = 'transport'
    IMAGE_RATE = 'image rate'
    IMAGE_STAMPS = 'image stamps'
    CALIBRATION = 'calibration'
    LIVE_TRANSPORT = 'live transport'
    IMU_RATE = 'imu rate'
    IMU_STAMPS = 'imu stamps'
    GYRO = 'gyro'
    GYRO_AT_REST = 'gyro at rest'
    GRAVITY = 'gravity'
    CLOCKS = 'clocks'
    ACCEL_CLOCK = 'accelerometer clock'
    PAIRS = 'pairs'
    TEXTURE = 'texture'
    ROLLING_SHUTTER = 'rolling shutter'

    @property
    def is_property(self) -> bool:
        """Whether this is a property of a recording, which only `check` reports."""
        return tuple(Code).index(self) >= tuple(Code).index(Code.TOPICS)


class Why(str, Enum):
    """Why a finding has its state."""

    CONSISTENT = 'consistent'
    # Without a value: state UNKNOWN.
    NOT_OBSERVABLE = 'not_observable'  # in this motion, or by so few pairs
    NOT_MEASURED = 'not_measured'
    OTHER_INCONSISTENT = 'other_inconsistent'  # another parameter is, which hides this one
    OTHER_WRONG = 'other_wrong'  # the finding `parent` is, which hides this one
    # Inconsistent, with an estimate.
    OFF = 'off'
    BY_CALIBRATION = 'by_calibration'  # an offline calibration contradicts the parameter
    # Inconsistent, without an estimate in small steps.
    OPPOSITE = 'opposite'  # the opposite sign fits
    NO_SPECIFIC_FORCE = 'no_specific_force'
    RECTIFIED = 'rectified'
    STILL = 'still'  # images or parts of them, though the camera turns
    TWO_MOTIONS = 'two_motions'  # among the matches of a pair
    STEPPED = 'stepped'  # a clock was set while the sensors ran
    DRIFTING = 'drifting'  # a clock runs at another rate, or a lens zooms or focuses
    UNEXPLAINED = 'unexplained'  # pairs contradict each other, whatever parameter is changed
    CONTRADICTING = 'contradicting'  # images the gyro, in most of the last pairs
    IMPOSSIBLE = 'impossible'  # no possible value of a parameter makes them agree
    RESIDUALS = 'residuals'  # they have a pattern in a map
    # Gross errors: `is_gross`.
    GROSS = 'gross'
    LEFT_HANDED = 'left_handed'
    INDEPENDENT = 'independent'  # images and gyro rotate independently
    CLOCKS_APART = 'clocks_apart'
    AT_OTHER_TIME = 'at_other_time'  # images and gyro rotate alike at another offset alone
    SIDEWAYS = 'sideways'  # rows of the sensor are columns of the image
    CLOCKWISE = 'clockwise'  # images rotated by 90 deg
    COUNTERCLOCKWISE = 'counterclockwise'
    UPSIDE_DOWN = 'upside_down'
    MIRRORED = 'mirrored'

    @property
    def is_gross(self) -> bool:
        """Whether it is an error of axes, unit, clocks or images that no small step reaches."""
        return tuple(Why).index(self) >= tuple(Why).index(Why.GROSS)


@dataclass(frozen=True, slots=True)
class Evidence:
    """What a finding is based on; a value is None if it does not apply."""

    sigmas: float | None = None  # size of the deviation, in its own sigmas
    shift: float | None = None  # how far the deviation moves a pose, in sigmas of the pose
    pairs: int | None = None  # number of pairs
    # How much better the configuration explains the data than no knowledge does, as the logarithm
    # of the ratio of likelihoods.
    log_likelihood: float | None = None
    # Numbers of this cause alone, SI units unless the key names another one.
    measured: Mapping[str, Any] = field(default_factory=dict)


@dataclass(frozen=True, slots=True)
class Finding:
    """State of one quantity: a configured parameter, or a property of a recording."""

    code: Code
    state: FindingState
    why: Why
    configured: tuple[float, ...] = ()  # values of a parameter as they are applied
    estimated: tuple[float, ...] = ()  # estimated values; empty if they are not observable
    sigma: float | None = None  # 1 sigma of the estimated value with the index `component`
    unit: str = ''  # unit of the values and of sigma
    component: int = 0  # index of the value that deviates most
    evidence: Evidence = field(default_factory=Evidence)
    candidates: tuple[Code, ...] = ()  # causes that fit as well, this one included
    parent: Code | None = None  # the finding that this one follows from
    # Parameters whose value removes the inconsistency; each of them does by itself.
    settings: Mapping[str, Any] = field(default_factory=dict)

    @property
    def active(self) -> float | None:
        """The configured value that deviates most; None without one."""
        return self.configured[self.component] if self.configured else None

    @property
    def estimate(self) -> float | None:
        """The estimated value that deviates most; None without one."""
        return self.estimated[self.component] if self.estimated else None

    @property
    def observable(self) -> bool:
        """Whether the motion of the last seconds determines the quantity."""
        return bool(self.estimated) or self.state is not FindingState.UNKNOWN


# Parts of the image that do not move, and are masked: a small one, and most of the view.
_MASKED = (Code.STATIC_REGION, Code.INTERIOR)
# Causes that move other parameters before they are found. [derived: pairs across a change of the
# offset or of the lens, of an object, and those that no parameter explains, are no evidence of
# another parameter]
_DISTURBING = frozenset(
    {
        Code.OFFSET_STEP,
        Code.OFFSET_DRIFT,
        Code.FOCAL_DRIFT,
        Code.MOVING_OBJECT,
        Code.UNKNOWN_CAUSE,
    }
)


@dataclass(frozen=True, slots=True)
class Assessment:
    """All findings after a pair."""

    findings: tuple[Finding, ...]

    @property
    def state(self) -> FindingState:
        """State of the worst finding."""
        return max(
            (finding.state for finding in self.findings),
            key=tuple(FindingState).index,
            default=FindingState.UNKNOWN,
        )

    @property
    def faults(self) -> tuple[Finding, ...]:
        """Findings that are suspect or wrong, the worst first."""
        return tuple(
            finding
            for state in (FindingState.WRONG, FindingState.SUSPECT)
            for finding in self.findings
            if finding.state is state
        )

    @property
    def masks(self) -> bool:
        """Whether a part of the image is masked, which spoiled what was found before."""
        return any(finding.code in _MASKED for finding in self.findings)

    def is_disturbed_since(self, before: Assessment) -> bool:
        """Whether what was found before may be a trace of a finding that is new since then."""
        return bool(self._disturbing - before._disturbing)

    @property
    def _disturbing(self) -> set[Code]:
        """Findings before which others may have been named in their place."""
        return {
            one.code
            for one in self.findings
            if (one.code in _DISTURBING and one.why is not Why.RESIDUALS)
            or one.why is Why.AT_OTHER_TIME
        }

    @property
    def is_gross(self) -> bool:
        """Whether the worst finding is a gross error."""
        return self.state is FindingState.WRONG and self.faults[0].why.is_gross


# Before the first pair.
NOT_EVALUATED = Assessment(())


def worst_of(before: Assessment, now: Assessment) -> Assessment:
    """The worse finding of each quantity, and of two equally bad ones the later.

    If `now` has a gross error, masks a part of the image, or has a change of the offset or pairs
    without an explanation, and `before` had not, earlier findings were its traces and are dropped.
    So is a parameter that few pairs made suspect and more pairs do not (`_is_trace`), one of
    several candidates of which another one is named alone by now (`_is_ruled_out`), and a pattern
    of residuals once anything else is found, which explains it. Of what is masked, the
    later finding has the extent.
    """
    traces = (
        (now.is_gross and not before.is_gross)
        or (now.masks and not before.masks)
        or now.is_disturbed_since(before)
    )
    kept = () if traces else before.findings
    is_explained = any(one.why is not Why.RESIDUALS for one in now.faults)
    found = {
        one.code: one
        for one in kept
        if not (is_explained and one.why is Why.RESIDUALS)
        and not (now.masks and one.code in _MASKED)
    }
    # A quantity that was observable once is not unknown any more.
    order = (FindingState.UNKNOWN, FindingState.OK, FindingState.SUSPECT, FindingState.WRONG)
    for one in now.findings:
        known = found.setdefault(one.code, one)
        is_over = _is_trace(known, one, now) or _is_ruled_out(known, one, now)
        if order.index(known.state) <= order.index(one.state) or is_over:
            found[one.code] = one
    return Assessment(tuple(found.values()))


# Pairs of a later finding over those of an earlier one from which it overrules it. Less would drop
# what half of the evidence shows, more would keep what the first seconds confuse. [chosen: 1.5 to
# 4 would do]
_OVERRULES = 2


def _is_trace(earlier: Finding, later: Finding, now: Assessment) -> bool:
    """Whether a suspect parameter was a trace of another one, which more pairs show by now."""
    few = earlier.evidence.pairs
    if few is None or earlier.state is not FindingState.SUSPECT or earlier.why is not Why.OFF:
        return False
    by_more = any(
        one.why is Why.OFF and (one.evidence.pairs or 0) >= _OVERRULES * few for one in now.faults
    )
    return by_more and later.why in (Why.CONSISTENT, Why.OTHER_INCONSISTENT)


def _is_ruled_out(earlier: Finding, later: Finding, now: Assessment) -> bool:
    """Whether a candidate is none any more, as another one of them is named alone."""
    others = set(earlier.candidates) - {earlier.code}
    named = {one.code for one in now.faults if one.why is Why.OFF and not one.candidates}
    return later.state in (FindingState.OK, FindingState.UNKNOWN) and bool(others & named)


def rounded(values: ArrayLike, digits: int = 5) -> list[float]:
    """Round values (K,) to set or to show; none of them is -0.0."""
    return [round(float(value), digits) + 0.0 for value in np.atleast_1d(values)]


@dataclass(frozen=True, slots=True, eq=False)
class Configured:
    """Parameters with which the pairs were estimated."""

    sensor: SensorConfig
    camera: RollingShutterCamera
    gyro_bias: Array  # (3,) parameter [rad/s]
    sigmas: Array  # (K,) configured, of the deviations; 0 if not known
    active: Array  # (K,) deviations applied already: tracked parameters, bias at rest
    gyro_noise_density: float  # parameter [rad/s/sqrt(Hz)]

    @property
    def direction(self) -> float:
        """1 if row 0 is configured to be read first, -1 if it is the last."""
        return 1.0 if self.camera.reads_forward else -1.0


class Shown(NamedTuple):
    """How the values of a parameter are written."""

    unit: str  # `factor` times smaller than the unit of the values
    factor: float
    digits: int
    compared: str  # {}: the estimated and the active value
    fix: str  # {}: the value to set


class Quantity(NamedTuple):
    """A parameter of camera or IMU that images and gyro determine."""

    code: Code
    entry: str  # name of its deviation in `LIVE`, the last of them if `beside` names another
    observable: float  # largest `uncertainty` with which the deviation counts as observable
    # Unit of the values of a finding. Deviations are in rad where this is deg.
    unit: str
    shown: Shown
    # Values in `unit` by the deviation (m,) from the active ones.
    value: Callable[[Configured, Array], ArrayLike]
    # Change of a value by its deviation, at the estimated value.
    per_deviation: Callable[[Configured, float], float] = lambda configured, estimated: 1.0
    # Value that changes by all of itself with a deviation of 1, over the active one; 0: no value.
    relative: float = 0.0
    # Whether it is off alone, if at all: with others free it could cancel their effect.
    alone: bool = False
    # Shapes (m, m) of a lens whose deviation is not that of its values: coefficients, or the
    # logarithms of both focal lengths, by the deviation. `value` takes the change of these then.
    shapes: Callable[[Configured], Array] | None = None
    # Size of the sigmas, by the covariance (m, m) of the deviation.
    uncertainty: Callable[[Configured, Array], float] = lambda configured, covariance: math.sqrt(
        float(np.diag(covariance).max())
    )
    # Entry just before its own that may be off with it: the hypothesis that this quantity is off
    # frees both, and is certain as far as its own entry is needed besides the other one.
    beside: str = ''
    tracking: str = ''  # name of the parameter that lets the node track the quantity
    reach: float = 0.0  # largest deviation that tracking applies

    @property
    def part(self) -> slice:
        """Places of its deviations in a vector of `LIVE`."""
        return slice(LIVE.part(self.beside or self.entry).start, self.own.stop)

    @property
    def own(self) -> slice:
        """Places of the deviations that no other quantity has."""
        return LIVE.part(self.entry)

    def unknown(self, why: Why, parent: Code | None = None) -> Finding:
        """A finding without values."""
        return Finding(self.code, FindingState.UNKNOWN, why, unit=self.unit, parent=parent)

    def deviation(self, finding: Finding) -> float:
        """Size of the difference between the values of a finding, in units of a deviation."""
        assert finding.estimate is not None and finding.active is not None
        apart = abs(finding.estimate - finding.active)
        if self.relative:
            return apart / (self.relative * finding.active)
        return math.radians(apart) if self.unit == 'deg' else apart


# Text of an estimated and an active value.
COMPARED = 'estimated {}, active {}'


def _focal_length(configured: Configured, left: Array) -> Array:
    return np.asarray(configured.camera.fx * np.exp(left))


def _focal_lengths(configured: Configured, left: Array) -> Array:
    return np.asarray((configured.camera.fx, configured.camera.fy) * np.exp(left))


def _logarithms(configured: Configured) -> Array:
    """Logarithms of fx and fy by those of the focal length and the aspect, for any camera."""
    return np.array([[1.0, 0.0], [1.0, 1.0]])


def _coefficients(configured: Configured, left: Array) -> Array:
    return np.asarray(configured.camera.radial_coefficients + left)


def _tangential(configured: Configured, left: Array) -> Array:
    return np.asarray(configured.camera.tangential_coefficients + left)


def _coefficient_shapes(configured: Configured) -> Array:
    return independent_shapes(corner_radius(configured.camera))


def _corner_sigma(configured: Configured, covariance: Array) -> float:
    """1 sigma of the displacement of the image's corner, over its radius."""
    radius = corner_radius(configured.camera)
    by_values = displacements([radius])[0] @ independent_shapes(radius)
    return math.sqrt(by_values @ covariance @ by_values)


def _principal_point(configured: Configured, left: Array) -> Array:
    camera = configured.camera
    return np.asarray((camera.cx, camera.cy) + camera.width * left)


def _time_offset(configured: Configured, left: Array) -> Array:
    applied = float(configured.active[LIVE.index('time_offset')])
    return np.asarray(configured.sensor.time_offset + applied + left)


def _readout_time(configured: Configured, left: Array) -> Array:
    # The deviation is that of the signed one.
    return np.asarray(configured.camera.readout_time + configured.direction * left)


def _gyro_bias(configured: Configured, left: Array) -> Array:
    return np.asarray(configured.gyro_bias + configured.active[LIVE.part('gyro_bias')] + left)


# The quantities in the order of messages.
QUANTITIES = (
    Quantity(
        Code.AXES,
        'axes',
        math.radians(1.0),
        'deg',
        Shown(
            'deg',
            1.0,
            2,
            'IMU rotated by {} relative to quat_cam_imu_xyzw',
            'set quat_cam_imu_xyzw: {}',
        ),
        lambda configured, left: np.degrees([float(np.linalg.norm(left))]),
        lambda configured, estimated: math.degrees(1.0),
    ),
    Quantity(
        Code.TIME_OFFSET,
        'time_offset',
        4e-3,
        's',
        Shown('ms', 1e3, 2, COMPARED, 'set time_offset: {:z.4f}'),
        _time_offset,
        tracking='track_time_offset',
        reach=LARGEST_OFFSET,
    ),
    Quantity(
        Code.READOUT_TIME,
        'readout_time',
        5e-3,
        's',
        Shown('ms', 1e3, 2, COMPARED, 'set readout_time: {:.4f}'),
        _readout_time,
        tracking='track_readout_time',
        reach=LARGEST_READOUT,
    ),
    Quantity(
        Code.GYRO_BIAS,
        'gyro_bias',
        0.01,
        'rad/s',
        Shown(
            'rad/s',
            1.0,
            5,
            COMPARED,
            'set gyro_bias: {}, and keep the camera at rest at the start',
        ),
        _gyro_bias,
    ),
    Quantity(
        Code.GYRO_SCALE,
        'gyro_scale',
        0.03,
        '',
        Shown(
            '',
            1.0,
            3,
            'factor of the gyro rates: ' + COMPARED,
            'calibrate the gyro, or correct its driver',
        ),
        lambda configured, left: 1.0 + left,
    ),
    Quantity(
        Code.FOCAL_LENGTH,
        'focal_log',
        0.04,
        'px',
        Shown('px', 1.0, 1, COMPARED, 'calibrate the camera at this resolution and focus'),
        _focal_length,
        lambda configured, estimated: estimated,
        relative=1.0,
    ),
    Quantity(
        Code.ASPECT,
        'aspect',
        0.04,
        'px',
        Shown(
            'px',
            1.0,
            1,
            'fx, fy: ' + COMPARED,
            'calibrate the camera at this resolution; the images are squeezed',
        ),
        _focal_lengths,
        lambda configured, estimated: estimated,
        relative=1.0,
        alone=True,
        shapes=_logarithms,
        beside='focal_log',
    ),
    Quantity(
        Code.DISTORTION,
        'distortion',
        _OBSERVABLE_DISPLACEMENT,
        '',
        Shown(
            '',
            1.0,
            3,
            'k1, k2, k3: ' + COMPARED,
            'set distortion_coefficients: {} with the camera_matrix, or calibrate the lens',
        ),
        _coefficients,
        shapes=_coefficient_shapes,
        uncertainty=_corner_sigma,
    ),
    Quantity(
        Code.TANGENTIAL,
        'tangential',
        _OBSERVABLE_TANGENTIAL,
        '',
        Shown(
            '',
            1.0,
            4,
            'p1, p2: ' + COMPARED,
            'set distortion_coefficients: {} with the camera_matrix, or calibrate the lens',
        ),
        _tangential,
        alone=True,
    ),
    Quantity(
        Code.PRINCIPAL_POINT,
        'principal_point',
        0.01,
        'px',
        Shown('px', 1.0, 1, COMPARED, 'calibrate the camera at this crop and resolution'),
        _principal_point,
        lambda configured, estimated: configured.camera.width,
        relative=2.0,
        alone=True,
    ),
)
# The same by code.
BY_CODE = {quantity.code: quantity for quantity in QUANTITIES}
