"""Rotation by images alone against the gyro, and accelerometer against images.

Method: docs/monitor.md, "Gross errors" and "Accelerometer". No prior and no pose is used, so that
the comparison of rotations holds for any error of axes, unit or sign of the gyro.
"""

from dataclasses import dataclass
import math

import numpy as np

from rs_relpose_ros.calibration.findings import Code, Evidence, Finding, FindingState, Why
from rs_relpose_ros.calibration.posterior import LastSeconds, MOST_PAIRS, WINDOW_NS
from rs_relpose_ros.core.losses import cauchy_weight
from rs_relpose_ros.estimator.velocity import InertialEvidence
from rs_relpose_ros.geometry import Array
from rs_relpose_ros.geometry.motion import InertialMotion
from rs_relpose_ros.geometry.so3 import aligning_rotation, log_so3, STANDARD_GRAVITY
from rs_relpose_ros.geometry.timing import NANOSECONDS, to_nanoseconds
from rs_relpose_ros.imu.buffer import ForceFault
from rs_relpose_ros.imu.integration import interpolated

# Number of rays below which no rotation is estimated. Fewer would follow single wrong matches.
# [chosen: 8 to 20 would do; a rotation needs two]
LEAST_RAYS = 12
# The comparison uses the rotations of the last seconds. Longer would report an error that was
# corrected, shorter has too little rotation of a slow camera. [chosen: 4 to 15 s would do]
_WINDOW_NS = to_nanoseconds(8.0)
# Largest number of rotations: every third frame and each pair of 8 s at 60 Hz. It bounds the work.
# [derived: 8 s x 60 Hz / 3]
_MOST_ROTATIONS = 160
# Number of rotations that a comparison needs. Fewer would follow a single wrong one.
# [chosen: 4 to 10 would do]
_FEWEST = 5
# Sum of their angles [rad] that it needs. Less would compare the noise of the matches.
# [chosen: 0.1 to 0.3 would do]
_LEAST_ANGLE = 0.15
# Sum of squares [rad^2] that a constant rate leaves by rounding alone; it keeps a ratio finite.
# [derived: squares of double rounding, 1e-32, times the number of rotations]
_NO_ROTATION = 1e-30
# Rotation of axes [rad] from which they count as interchanged. Smaller ones the recursive
# calibration measures. [chosen: its prior is 0.2, interchanged axes are at 1.57 or more]
_LARGE_ANGLE = 1.0
# Logarithm of a ratio of likelihoods that is certain. Less would report turned axes by chance, as
# errors of neighbours are alike; more would report them later. [chosen: 10 to 30 would do]
_LOG_LIKELIHOOD = 20.0
# Largest offset of the clocks that is tried [s]. A larger one leaves too few of the rotations of
# 8 s, and the stamps show it as the images arrive. [chosen: 1 to 3 s would do]
_LARGEST_OFFSET = 2.0
# Step of the offsets [s]. A longer one may miss the optimum, a shorter one costs time. [measured:
# the rotation of a walk is explained within 0.05 s of the right offset]
_OFFSET_STEP = 0.04
# Steps [s] about the best of them. [chosen: a quarter of `_OFFSET_STEP`; pairs refine the offset]
_FINE: Array = np.linspace(-0.03, 0.03, 7)
# Sum of the gyro's angles [rad] from which offsets are tried: less takes the time for what noise
# and translation make. [derived: that from which independent rotations are reported]
_ENOUGH_FOR_OFFSET = 2.0
# Sum of the gyro's angles [rad] from which images and gyro have to be related. Less is what
# translation makes of the images' rotation. [chosen: half of what an offset needs]
_ENOUGH_TO_RELATE = 1.0
# Offsets within this distance [s] of the best one are the same explanation. [chosen: half a period
# of the steps of a walk is 0.25 s; 0.08 to 0.2 s would do]
_SAME_OFFSET = 0.12
# Smallest offset [s] that is found so: pairs measure smaller ones. [chosen: the prior of offsets]
_LEAST_OFFSET = 0.05
# Share of the images' rotation that the right offset leaves at most. [measured: 0.08 to 0.28 with
# clocks that are off by 0.5 s]
_LEFT_AT_OFFSET = 0.4
# Share that the right rotation of interchanged axes leaves at most. A larger one takes clocks that
# are apart for axes. [measured: .01 to .22 on two walks with axes turned by 90 and 180 deg, .4 to
# .9 with clocks that are .3 to .6 s apart]
_LEFT_IF_TURNED = 0.3
# Logarithm of a factor of the gyro beyond which it is no scale of a sensor. A smaller one would
# take what translation adds to the images' rotation for a factor, a larger one would miss the next
# full-scale range, which is 2. [chosen: 1.5 times; 1.4 to 1.7 would do]
_OTHER_FACTOR = 0.4
# Difference between the logarithms of two such factors that are one. A smaller one would not allow
# for translation, a larger one would take a focal length of twice the value for a factor, which
# leaves the rotation about the optical axis as it is. [chosen: 0.2 to 0.5 would do]
_ALIKE = 0.35
# Rotations that an offset has to compare. Fewer agree by chance. [chosen: 2 to 3 s]
_FEWEST_AT_OFFSET = 25


def rotation_of_rays(rays1: Array, rays2: Array) -> Array | None:
    """Rotation vector (3,) of ``R_1^T R_2`` that aligns unit rays (N, 3) best; None for too few.

    Translation is not modelled: rays that move most have the least weight (Cauchy).
    """
    finite = np.isfinite(rays1 + rays2).all(axis=1)
    if np.count_nonzero(finite) < LEAST_RAYS:
        return None
    first = rays1[finite]
    second = rays2[finite]
    rotation = aligning_rotation(first.T @ second)
    squares = ((first - second @ rotation.T) ** 2).sum(axis=1)
    typical = max(float(np.median(squares)), 1e-12)
    weights = cauchy_weight(squares / typical)
    correlation = (first.T * weights) @ second
    return log_so3(aligning_rotation(correlation))


@dataclass(frozen=True, slots=True, eq=False)
class RotationComparison:
    """Images and gyro over the last seconds.

    Shares ``left_*`` are those of the images' rotation (sum of squares) that remain after the
    gyro's is rotated and scaled: 0 if nothing remains, 1 or more if both are independent.
    """

    left_as_configured: float  # no rotation
    left_of_all: float  # no rotation, and no constant rate removed
    left_at_best: float  # `rotation`
    left_mirrored: float  # the best reflection: a gyro with left-handed axes
    rotation: Array  # (3, 3) Q: the true gyro is Q times the configured one
    reflection: Array  # (3, 3) the best one
    scale: float  # images over gyro, after `rotation`
    # Images over gyro without any rotation: about the optical axis, and across it. A wrong focal
    # length changes the second one alone.
    scale_along: float
    scale_across: float
    by_gyro: float  # [rad] sum of the angles
    count: int
    # At the best of other time offsets, no rotation; infinite if too little turned to try them.
    left_at_offset: float
    # Time offset [s], if the rotations agree there, and at no other one, without any rotation.
    offset: float | None

    @property
    def has_other_factor(self) -> bool:
        """Whether all axes of the gyro have one factor that no calibration of a gyro has."""
        if self.count < _FEWEST_AT_OFFSET or self.by_gyro < _ENOUGH_TO_RELATE:
            return False
        if self.left_as_configured > _LEFT_AT_OFFSET:
            return False
        return is_other_factor(self.scale_along, self.scale_across)

    @property
    def is_at_another_time(self) -> bool:
        """Whether they agree at another offset alone, for certain better than as configured.

        Which one of several may be open: a walk repeats itself with each step.
        """
        if self.by_gyro < _ENOUGH_FOR_OFFSET or not self._agrees_later:
            return False
        # Twice the certainty of other causes: the best of many offsets.
        is_better = self._certain(self.left_of_all, self.left_at_offset, 2.0 * _LOG_LIKELIHOOD)
        return is_better and self.left_at_best > _LEFT_IF_TURNED

    @property
    def is_turned(self) -> bool:
        """Whether axes are interchanged: `rotation` is large, and better for certain.

        Half a step later a walk turns as if axes were interchanged.
        """
        if self._agrees_later or self.left_at_best > _LEFT_IF_TURNED:
            return False
        is_better = self._certain(self.left_as_configured, self.left_at_best)
        return self.angle > _LARGE_ANGLE and is_better

    @property
    def is_unrelated(self) -> bool:
        """Whether the gyro explains so little that no small error of a parameter is the cause."""
        is_known = self.count >= _FEWEST_AT_OFFSET and self.by_gyro > _ENOUGH_TO_RELATE
        return is_known and self.left_as_configured > _LEFT_AT_OFFSET

    @property
    def is_left_handed(self) -> bool:
        """Whether a reflection fits for certain better than any rotation, about three axes."""
        is_better = self._certain(self.left_at_best, self.left_mirrored)
        return is_better and not self._agrees_later

    @property
    def _agrees_later(self) -> bool:
        """Whether another offset explains the rotations as they are."""
        return self.left_at_offset < _LEFT_AT_OFFSET

    def _certain(self, left: float, left_instead: float, needed: float = _LOG_LIKELIHOOD) -> bool:
        """Whether the second hypothesis is better, by the likelihoods of three components."""
        ratio = max(left, 1e-9) / max(left_instead, 1e-9)
        return 1.5 * self.count * math.log(ratio) > needed

    @property
    def angle(self) -> float:
        """Of `rotation` [rad]."""
        return float(np.linalg.norm(log_so3(self.rotation)))


class RotationSums(LastSeconds):
    """The rotations of the last seconds."""

    def __init__(self) -> None:
        super().__init__(_MOST_ROTATIONS, _WINDOW_NS)

    def add(self, stamp_ns: int, interval: float, by_images: Array, by_gyro: Array) -> None:
        """Add rotation vectors (3,) over the same `interval` [s]."""
        self.keep((stamp_ns, interval, by_images, by_gyro))

    def compared(self) -> RotationComparison | None:
        """The comparison; None if there are too few or too small rotations."""
        if len(self) < _FEWEST:
            return None
        stamps_ns, intervals, theta, phi = (np.array(column) for column in zip(*self, strict=True))
        by_images, by_gyro = (float(np.linalg.norm(one, axis=1).sum()) for one in (theta, phi))
        if max(by_images, by_gyro) < _LEAST_ANGLE or by_gyro < 1e-3 * _LEAST_ANGLE:
            return None
        left_of_all = _left(float((theta * phi).sum()), theta, phi)
        ends = (stamps_ns - stamps_ns[0]) / NANOSECONDS
        offset = None
        left_at_offset = math.inf
        if left_of_all > _LEFT_AT_OFFSET:
            offset, left_at_offset = _offset_of(ends, intervals, theta, phi)
        if by_gyro < _ENOUGH_FOR_OFFSET:
            offset = None
        theta = _without_rate(theta, intervals)
        phi = _without_rate(phi, intervals)
        M = theta.T @ phi
        U, singular, Vt = np.linalg.svd(M)
        handed = math.copysign(1.0, float(np.linalg.det(U @ Vt)))
        # The best rotation and the best reflection differ in the least singular value's sign.
        of_two = singular[0] + singular[1]
        trace = float(of_two + handed * singular[2])
        mirrored = float(of_two - handed * singular[2])
        return RotationComparison(
            _left(float(np.trace(M)), theta, phi),
            left_of_all,
            _left(trace, theta, phi),
            _left(mirrored, theta, phi),
            np.ascontiguousarray((U * (1.0, 1.0, handed)) @ Vt),
            np.ascontiguousarray((U * (1.0, 1.0, -handed)) @ Vt),
            trace / max(float((phi**2).sum()), _NO_ROTATION),
            factor_of(theta[:, 2:], phi[:, 2:]),
            factor_of(theta[:, :2], phi[:, :2]),
            by_gyro,
            len(self),
            left_at_offset,
            offset,
        )


def is_other_factor(along: float, across: float) -> bool:
    """Whether images turn by one factor of the gyro that no calibration of a gyro has.

    `along` and `across` are images over gyro about the optical axis and across it.
    """
    if min(along, across) <= 0.0:
        return False
    logarithms = np.log([along, across])
    is_alike = abs(logarithms[0] - logarithms[1]) < _ALIKE
    return bool(is_alike and np.abs(logarithms).min() > _OTHER_FACTOR)


def factor_of(theta: Array, phi: Array) -> float:
    """Components (N, M) of the images' rotations over those of the gyro."""
    return float((theta * phi).sum()) / max(float((phi**2).sum()), _NO_ROTATION)


def _without_rate(rotations: Array, intervals: Array) -> Array:
    """Rotations (N, 3) without the constant rate that fits best."""
    rate = intervals @ rotations / (intervals @ intervals)
    return np.asarray(rotations - np.outer(intervals, rate))


def _offset_of(
    ends: Array, intervals: Array, theta: Array, phi: Array
) -> tuple[float | None, float]:
    """Time offset [s] at which rotations of images and gyro (N, 3) agree; None unless certain.

    Returns the share of the images' rotation, too, that the gyro leaves at the best offset.
    `ends` (N,) [s], in the order of time: the gyro between two rotations is interpolated.
    """
    times = np.concatenate([[ends[0] - intervals[0]], ends])
    angles = np.vstack([np.zeros(3), np.cumsum(phi, axis=0)])

    def left_at(offset: float) -> tuple[float, int]:
        """Share of the images' rotation that the gyro leaves at an offset, and the number used."""
        begins = ends - intervals + offset
        stops = ends + offset
        known = (begins >= times[0]) & (stops <= times[-1])
        count = int(np.count_nonzero(known))
        if count < _FEWEST_AT_OFFSET:
            return math.inf, count
        at_begins = interpolated(begins[known], times, angles)
        at_stops = interpolated(stops[known], times, angles)
        of_gyro = _without_rate(at_stops - at_begins, intervals[known])
        of_images = _without_rate(theta[known], intervals[known])
        trace = float((of_images * of_gyro).sum())
        return _left(trace, of_images, of_gyro), count

    offsets = np.arange(-_LARGEST_OFFSET, _LARGEST_OFFSET + 1e-9, _OFFSET_STEP)
    left, counts = np.transpose([left_at(offset) for offset in offsets])
    best = int(np.argmin(left))
    least = float(left[best])
    best_offset = offsets[best]
    apart = np.abs(offsets - best_offset) > _SAME_OFFSET
    none = len(offsets) // 2  # index of the offset 0
    rival = min(float(left[apart].min()), float(left[none]))
    # Twice the certainty of other causes: the best of many offsets.
    needed = 2.0 * _LOG_LIKELIHOOD / (1.5 * max(counts[best], 1))
    if least > _LEFT_AT_OFFSET or abs(best_offset) < _LEAST_OFFSET:
        return None, least
    if rival < math.exp(needed) * max(least, 1e-9):
        return None, least
    near = [float(offset) for offset in best_offset + _FINE]
    return min(near, key=lambda offset: left_at(offset)[0]), least


def _left(trace: float, theta: Array, phi: Array) -> float:
    """Share of the rotations `theta` (N, 3) that remains after Q `phi`, by trace(Q^T M).

    ``min over s of sum |theta - s Q phi|^2 / sum |theta|^2``; a negative scale is worse.
    """
    power = float((theta**2).sum()) * float((phi**2).sum())
    return 1.0 - trace * abs(trace) / max(power, _NO_ROTATION)


# -- Accelerometer against images, by the pairs of the last seconds -------------------------------

# Largest logarithm that a pair counts: one with misleading matches must not decide alone. Less
# would report wrong axes later. [chosen: a third of `_CERTAIN`, so that four pairs have to agree]
_LARGEST = 3.0
# Logarithm of a Bayes factor that is certain, errors of neighbours being alike. Less would report
# a right accelerometer. [measured: docs/monitor.md, "Accelerometer": 6 to 73 with right axes, -87
# to -5 with wrong ones]
_CERTAIN = 10.0
# Time after which samples that are no specific force are reported. Less would report a step of a
# walk. [chosen: 0.5 to 3 s would do]
_FAULTY_NS = to_nanoseconds(1.0)


# Sigmas of the length at rest beyond which the accelerometer has another scale. Fewer would name
# the bias of a cheap sensor. [derived: as of any parameter with a configured sigma]
_BEYOND = 3.0


# Least length of the specific force at rest that is one [m/s^2]. A smaller one would name the
# scale where the gyro is wrong. [chosen: below 0.98, that of an accelerometer in g]
_LEAST_LENGTH = 0.9


class AccelerationSums(LastSeconds):
    """Log Bayes factors of the measured acceleration and of its opposite, with their stamps."""

    def __init__(self) -> None:
        super().__init__(MOST_PAIRS, WINDOW_NS)
        # Fault of the samples, the stamp of its first pair, and whether it lasts.
        self._fault: ForceFault | None = None
        self._fault_ns = 0
        self._faulty = False
        # Length of the specific force at rest, and what it may differ by from that of gravity.
        self._length = self._length_sigma = math.nan

    def note_length(self, length: float, sigma: float) -> None:
        """Note the length of the specific force at rest [m/s^2]; NaN if it is not known.

        `sigma`: of its difference from gravity, if scale and bias are as configured.
        """
        self._length = length
        self._length_sigma = sigma

    def report(self, stamp_ns: int, inertial: InertialMotion | str) -> None:
        """Note the acceleration of a pair, or the reason why it has none."""
        fault = inertial if isinstance(inertial, ForceFault) else None
        if fault is None or self._fault is None:
            self._fault_ns = stamp_ns
        self._fault = fault
        self._faulty = fault is not None and stamp_ns - self._fault_ns >= _FAULTY_NS

    def add(self, stamp_ns: int, evidence: InertialEvidence) -> None:
        """Add a pair."""
        self.keep((stamp_ns, *(max(-_LARGEST, min(value, _LARGEST)) for value in evidence)))

    def uses(self, evidence: InertialEvidence | None) -> bool:
        """Whether a pair of such evidence uses the accelerometer; None: not known yet."""
        return not self.contradicts and (evidence is None or evidence.configured > -_LARGEST)

    @property
    def contradicts(self) -> bool:
        """Whether no acceleration, or the opposite one, is more consistent with the images."""
        configured, opposite = self._sums()
        return max(opposite, 0.0) - configured > _CERTAIN

    def finding(self) -> Finding | None:
        """On the accelerometer; None if the pairs do not determine it."""
        if self._fault is not None and self._faulty:
            measured = {'mean_length_m_s2': self._fault.length}
            return Finding(
                Code.ACCEL_SCALE,
                FindingState.SUSPECT,
                Why.NO_SPECIFIC_FORCE,
                evidence=Evidence(measured=measured),
            )
        off = abs(self._length - STANDARD_GRAVITY)
        # A gravity that a wrong gyro has turned away is no length of the force.
        if self._length > _LEAST_LENGTH and off > _BEYOND * self._length_sigma:
            return Finding(
                Code.ACCEL_SCALE,
                FindingState.SUSPECT,
                Why.OFF,
                configured=(1.0,),
                estimated=(STANDARD_GRAVITY / self._length,),
                sigma=self._length_sigma / self._length,
                evidence=Evidence(measured={'mean_length_m_s2': self._length}),
            )
        configured, opposite = self._sums()
        evidence = Evidence(pairs=len(self), log_likelihood=configured)
        if self.contradicts:
            why = Why.OPPOSITE if opposite > _CERTAIN else Why.OFF
            return Finding(Code.ACCEL_AXES, FindingState.SUSPECT, why, evidence=evidence)
        if configured > _CERTAIN:
            return Finding(Code.ACCEL_AXES, FindingState.OK, Why.CONSISTENT, evidence=evidence)
        return None

    def _sums(self) -> tuple[float, float]:
        return sum(configured for _, configured, _ in self), sum(one for _, _, one in self)
