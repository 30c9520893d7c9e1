"""Assessment of the configured parameters: which one is inconsistent, by how much, what to do.

A deviation is *suspect* if it is certain (more than `_CERTAIN` sigmas) and moves the pose by a
sigma of a correctly configured pose, *wrong* if it moves the pose out of its covariance.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Sequence
from dataclasses import replace
import functools
import math
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from rs_relpose_ros.calibration import findings
from rs_relpose_ros.calibration.findings import (
    Code,
    Configured,
    Evidence,
    Finding,
    FindingState,
    Quantity,
    Why,
)
from rs_relpose_ros.calibration.posterior import Calibration, OF_LENS, PairData
from rs_relpose_ros.calibration.rotations import RotationComparison
from rs_relpose_ros.config.settings import Parameters
from rs_relpose_ros.core.deviations import (
    ASPECT_SIGMA,
    by_name,
    LENS,
    LIVE,
    PARTS,
    TANGENTIAL_SIGMA,
)
from rs_relpose_ros.core.least_squares import inverse, log_determinant
from rs_relpose_ros.core.radial import corner_radius, displacements, independent_sigmas
from rs_relpose_ros.geometry import Array
from rs_relpose_ros.geometry.camera import (
    readout_direction,
    REFERENCE_ROWS,
    RollingShutterCamera,
)
from rs_relpose_ros.geometry.so3 import exp_so3, log_so3
from rs_relpose_ros.geometry.timing import clocks_apart, NANOSECONDS
from rs_relpose_ros.imu.noise import NOISY

# Sigmas beyond which a deviation is certain. Fewer would name parameters by chance, as seven are
# tested after each pair; more would report a wrong parameter later.
# [chosen: a normal deviate exceeds it once in 16,000; 3.5 to 5 would do]
_CERTAIN = 4.0
# Sigmas from which the pairs are linearised about a deviation of the times. Fewer would move the
# point of linearisation with noise, more would leave a large offset underestimated for longer.
# [chosen: 2 to 3 would do, below `_CERTAIN`]
_LIKELY = 2.5
# Shift of the pose in its own sigmas (Mahalanobis) from which a deviation is suspect. A smaller
# deviation does no harm that the covariance does not state. [derived: one sigma of the pose]
_MATTERS = 1.0
# Shift from which a pose is outside of its covariance, and the deviation wrong.
# [derived: the 99.7 % quantile of a normal deviate]
_OUTSIDE = 3.0
# Share of the images' rotation that a correction of axes and unit leaves at most. More would take
# independent rotations for turned axes, less would miss them under translation.
# [chosen: turned axes leave below 0.05 in simulations, independent rotations about 1]
_EXPLAINED_AT_BEST = 0.5
# Factor of images over gyro beyond which only another unit is consistent with the scale.
# [chosen: between a bad scale, 1.1, and deg/s, 57]
_UNIT_FACTOR = 5.0
# Rotation of the gyro [rad] after which images must agree. Less would report a moving object
# before the camera, more would find the wrong IMU later. [chosen: 1 to 4 would do]
_LONG_ROTATION = 2.0
# Share of the rotation that may remain in images of the gyro's own camera.
# [chosen: independent rotations leave 1 in the mean; 0.75 to 0.95 would do]
_INDEPENDENT = 0.85
# Axes that are rotated within this angle [rad] of half a turn about an axis of the image may also
# be flipped images. Wider would offer that for any large rotation, narrower would miss mounts that
# are not square. [chosen: 35 deg]
_HALF_TURN = 0.6
# The same of a quarter of a turn about the optical axis, of rotated images. It is narrower, as
# quarters of a turn are nearer to each other. [chosen: 17 deg]
_QUARTER_TURN = 0.3
# Quantile of the pairs' shifts by which a deviation matters. The largest would follow a single
# pair, the median would let pairs of little motion hide a deviation. [chosen: 0.8 to 0.95 would
# do]
_OBSERVABLE_IN = 0.9
# Sigmas within which a parameter that was configured with a sigma is as configured.
# [derived: the 99.7 % quantile of a normal deviate]
AS_CONFIGURED = 3.0
# Error that linearisation leaves, 1 sigma as a share of the last step. Smaller shares would make
# the sigma of a suggested value too small. [measured: on recordings with times that are far off,
# steps are 0.4 to 0.8 of the error, with other parameters 0.9; without it the first value of an
# offset of 30 ms is off by 3.1 sigma, with it by 1.2; docs/covariance.md]
_REMAINS = np.where(LIVE.mask('time_offset', 'readout_time'), 1.0, 0.25)
# Error of a suggested value, 1 sigma as a share of the deviation: matches and inliers were
# selected with the wrong value. [measured: about 0.08 on recordings]
_SELECTED = 0.1
# Gain in chi-square beyond which there is no doubt; it keeps an exponential finite.
# [chosen: exp(50) is 5e21; 40 to 1000 would do]
_LARGEST_GAIN = 100.0
# Difference in chi-square below which another hypothesis fits as well. More would name two causes
# where one is plain, less would name the wrong one of two. [derived: two sigmas]
_AS_GOOD = 4.0
# The same if one of the two can nearly cancel others, as the principal point does with the axes:
# less would name one of them by chance. [derived: 5 in the log-likelihood]
_CLEARLY = 10.0
# Pairs from which a quantity that can nearly cancel others is named though another fits as well.
# Fewer would name it for what the first motions of another cause leave, more would name one of two
# equal causes for longer. [measured: beside a gyro whose axes are misaligned by half a degree the
# principal point fits nearly as well as its axes for 20 pairs, and clearly worse from 24 on]
_FEWEST_BESIDE = 25
# Largest number of inconsistent quantities. Traces of a gross error need some, but with more of
# seven the fit would be free. [chosen: 3 to 5 would do]
_MOST_QUANTITIES = 4
# Part of the configured distortion that rectified images have at most. More would take a wrong
# lens for rectified images. [chosen: 0.1 to 0.4 would do]
_LITTLE_OF = 0.25
# Share of the largest shift below which others are traces of a gross error, and not evaluated.
# Less would name traces, more would hide a second error. [chosen: a third; 0.2 to 0.5 would do]
_TRACE = 0.34


def configured_sigmas(
    parameters: Parameters,
    from_reference: float,
    camera: RollingShutterCamera,
    offset_sigma: float = 0.0,
) -> Array:
    """1 sigma (K,) of the deviations by the parameters, 0 where they are not known.

    `from_reference` [s]: interval between frames less that to which the time offset refers.
    `offset_sigma` [s]: of the stamps of the gyro, which adds to the sigma of the time offset.
    """
    sensor = parameters.sensor
    sigmas = np.zeros(LIVE.size)
    configured = parameters.deviation_sigmas()
    for name, sigma in configured.items():
        if name in LIVE.parts:
            sigmas[LIVE.part(name)] = sigma
    sigmas[LIVE.part('distortion')] = independent_sigmas(
        corner_radius(camera), configured['distortion']
    )
    if configured['distortion']:
        sigmas[LIVE.part('tangential')] = TANGENTIAL_SIGMA
    sigmas[LIVE.part('principal_point')] /= camera.width
    if configured['focal_log']:
        sigmas[LIVE.part('aspect')] = ASPECT_SIGMA
    by_interval = from_reference * sensor.time_offset_per_interval_sigma
    offset = LIVE.index('time_offset')
    sigmas[offset] = math.hypot(sigmas[offset], by_interval, offset_sigma)
    return sigmas


class Effect(NamedTuple):
    """Shift of a pair's pose by deviations, or of its rotation alone if it has no translation."""

    shift: Array  # (5 or 3, K) in sigmas of a correctly configured pose
    claimed_shift: Array  # (6 or 3, K) in published sigmas, which may include the disagreement


class Inconsistency(NamedTuple):
    """A quantity whose deviation is consistent with the pairs."""

    quantity: Quantity
    deviation: Array  # (K,) from the active values; of this quantity alone
    covariance: Array  # (K, K)
    certainty: float  # in sigmas
    # Of the pose, Mahalanobis: in sigmas of a correctly configured one, of the pairs that it
    # moves most, and in published sigmas, in the median.
    shift: float
    claimed_shift: float
    alternative: Inconsistency | None = None  # hypothesis that fits the pairs as well


def find_inconsistencies(
    estimated: Calibration,
    effects: Sequence[Effect],
    configured: Configured,
    ranked: Sequence[Hypothesis] | None = None,
) -> list[Inconsistency]:
    """The fewest deviations that fit the pairs, by forward selection; the strongest first.

    A fit of all quantities would distribute a deviation of one among all that few pairs cannot
    distinguish. An alternative hypothesis is kept if it fits as well as the only quantity.
    `ranked`: the `hypotheses` of these pairs, if they are known.
    """
    found: list[tuple[Quantity, float]] = []
    alternative: Inconsistency | None = None
    selected = np.zeros(LIVE.size, dtype=bool)
    together = _solved(selected, estimated, configured)
    while len(found) < _MOST_QUANTITIES:
        if selected.any() or ranked is None:
            ranked = _ranked(
                [one for one in findings.QUANTITIES if not selected[one.own].any()],
                selected,
                estimated,
                configured,
            )
        (quantity, solution), (second, other) = ranked[:2]
        if (certainty := solution.certainty(quantity.own)) < _CERTAIN:
            break
        needed = _CLEARLY if quantity.alone or second.alone else _AS_GOOD
        lead = solution.evidence(quantity) - other.evidence(second)
        # A second one of more evidence is not certain: its pairs contradict each other.
        is_early = needed == _CLEARLY and len(estimated.b) < _FEWEST_BESIDE
        if not found and is_early and 0.0 <= lead < needed:
            if quantity.alone:
                break
        elif not found and 0.0 <= lead < needed:
            alternative = _inconsistency(second, other, other.certainty(second.own), effects)
        found = [one for one in found if one[0].entry != quantity.beside]
        found.append((quantity, certainty))
        selected = selected | _parts_of(quantity)
        together = solution
    inconsistent = [
        _inconsistency(quantity, together, certainty, effects) for quantity, certainty in found
    ]
    return [inconsistent[0]._replace(alternative=alternative)] if len(found) == 1 else inconsistent


class Hypothesis(NamedTuple):
    """That one quantity is off, with the deviations that fit the pairs then."""

    quantity: Quantity
    solution: Solution

    @property
    def gain(self) -> float:
        """In chi-square."""
        return self.solution.gain(self.quantity.part)


def hypotheses(estimated: Calibration, configured: Configured) -> list[Hypothesis]:
    """One for each quantity, that it is off and no other one; the best first."""
    none = np.zeros(LIVE.size, dtype=bool)
    return _ranked(findings.QUANTITIES, none, estimated, configured)


def _ranked(
    quantities: Sequence[Quantity],
    selected: NDArray[np.bool_],
    estimated: Calibration,
    configured: Configured,
) -> list[Hypothesis]:
    """Hypotheses that free one more quantity each.

    Those that are certain come first, and of these the one with most evidence.
    """

    def rank(hypothesis: Hypothesis) -> tuple[bool, float]:
        quantity, solution = hypothesis
        is_certain = solution.certainty(quantity.own) >= _CERTAIN
        return not is_certain, -solution.evidence(quantity)

    unordered = [
        Hypothesis(quantity, _solved(selected | _parts_of(quantity), estimated, configured))
        for quantity in quantities
    ]
    return sorted(unordered, key=rank)


def likely(estimated: Calibration, configured: Configured) -> Array:
    """Deviation (K,) of the times that the pairs suggest, though not for certain; or zero.

    Far from an error of the times, pairs show little of it: they are linearised there, to see.
    """
    quantity, solution = _ranked(
        [one for one in findings.QUANTITIES if one.tracking],
        np.zeros(LIVE.size, dtype=bool),
        estimated,
        configured,
    )[0]
    return np.where(
        _parts_of(quantity) & (solution.certainty(quantity.part) > _LIKELY), solution.off, 0.0
    )


def constant(estimated: Calibration, configured: Configured) -> Solution:
    """Deviations within configured sigmas alone."""
    return _solved(np.zeros(LIVE.size, dtype=bool), estimated, configured)


def undetermined(
    estimated: Calibration,
    configured: Configured,
    drifts: Iterable[tuple[float, Array]] = (),
) -> Array:
    """Second moment (K, K) of undetected deviations.

    Those within configured sigmas exist for certain (the gyro bias is in the covariance of a pair
    already). Whether another quantity is off is not known: before the first pair the odds are
    even, and each quantity as likely. Consistent pairs lower the odds of a quantity as they lower
    its sigma against its prior P; others raise them (Bayes factor; Kass and Raftery, JASA 1995).
    Unknown quantities may be off together, but those that are `alone`, and `drifts`, which are the
    odds and the moment of each::

        odds_k = (|Sigma_k| / |P_k|)^1/2 exp(b_k^T Sigma_k b_k / 2),  Sigma_k = (S_kk + P_k^-1)^-1
    """
    odds = 0.0
    known = configured.sigmas > 0.0
    known[LIVE.part('gyro_bias')] = False
    together = ~known
    alone = np.zeros((LIVE.size, LIVE.size))
    estimated = replace(estimated, shared=1.0)
    for quantity in findings.QUANTITIES:
        part = quantity.part
        if not known[quantity.own].any():
            solution = _solved(_parts_of(quantity), estimated, configured)
            covariance = np.ascontiguousarray(solution.covariance[part, part])
            gain = min(
                float(solution.off[part] @ inverse(covariance) @ solution.off[part]), _LARGEST_GAIN
            )
            of_prior = -2.0 * float(np.log(LIVE.sigmas[part]).sum())
            evidence = math.exp(0.5 * (log_determinant(covariance) + of_prior + gain))
            own_odds = evidence / len(findings.QUANTITIES)
            odds += own_odds
            if quantity.alone:
                alone += own_odds * solution.moment
                together[quantity.own] = False
    share = odds / (1.0 + odds)
    within = _solved(np.zeros_like(known), estimated, configured).moment
    within[LIVE.part('gyro_bias')] = within[:, LIVE.part('gyro_bias')] = 0.0
    others = share * _solved(together, estimated, configured).moment
    moment = others + alone / (1.0 + odds) + (1.0 - share) * within
    # A drift that explains chance differences must not make the others less likely.
    for own_odds, of_drift in drifts:
        moment += own_odds / (1.0 + odds + own_odds) * of_drift
    return np.asarray(moment)


def _parts_of(quantity: Quantity) -> NDArray[np.bool_]:
    """Which deviations (K,) are those of a quantity."""
    return LIVE.mask(quantity.entry, quantity.beside or quantity.entry)


class Solution(NamedTuple):
    """Deviations that fit the pairs, if some are free."""

    off: Array  # (K,) from the active values
    covariance: Array  # (K, K)
    estimated: Calibration
    active: Array  # (K,)

    @property
    def by_pair(self) -> Array:
        """(N, K) part of each pair in the error of `off`, with common errors."""
        estimated = self.estimated
        scores = estimated.b - estimated.S @ (self.active + self.off)
        return (
            scores
            @ self.covariance
            * (math.sqrt(estimated.widened / estimated.shared) / estimated.scatter)
        )

    @property
    def sigma(self) -> Array:
        """(K,) 1 sigma, at least as the parts of the pairs scatter."""
        return np.asarray(
            np.sqrt(np.maximum(np.diag(self.covariance), (self.by_pair**2).sum(axis=0)))
        )

    @property
    def moment(self) -> Array:
        """Second moment (K, K) with these sigmas."""
        return self.widened_covariance + np.outer(self.off, self.off)

    @property
    def widened_covariance(self) -> Array:
        """Covariance (K, K) with these sigmas."""
        widths = self.sigma / np.sqrt(np.maximum(np.diag(self.covariance), 1e-300))
        return self.covariance * np.outer(widths, widths)

    def _along(self, part: slice) -> Array:
        """Direction of some deviations in which they are most certain, times their gain."""
        return inverse(np.ascontiguousarray(self.covariance[part, part])) @ self.off[part]

    def gain(self, part: slice) -> float:
        """Gain in chi-square by some deviations."""
        # A vector gains more by chance.
        return float(self.off[part] @ self._along(part)) - 2.0 * (part.stop - part.start - 1)

    def evidence(self, quantity: Quantity) -> float:
        """Chi-square in favour of a quantity.

        What a deviation of the lens explains in each pair for itself gains as well, and counts as
        far as the pairs agree. A quantity that is not needed besides another one has no more than
        what its own entry gains.
        """
        part = quantity.part
        if quantity.beside and self.certainty(quantity.own) < _CERTAIN:
            part = quantity.own
        return self.certainty(part) ** 2 if quantity.entry in OF_LENS else self.gain(part)

    def certainty(self, part: slice) -> float:
        """Some deviations in sigmas, as the parts of the pairs scatter in their direction."""
        along = self._along(part)
        gain = max(self.gain(part), 0.0)
        scattered = float(((self.by_pair[:, part] @ along) ** 2).sum())
        return math.sqrt(gain * min(gain / max(scattered, 1e-12), 1.0))


def _solved(free: NDArray[np.bool_], estimated: Calibration, configured: Configured) -> Solution:
    """Deviations, those `free` (K,) within their wide prior, others within configured sigmas."""
    sigmas = np.where(free, LIVE.sigmas, configured.sigmas)
    active = configured.active
    if free.any():
        factors = estimated.if_free[:, free].max(axis=1)
        if (factors != 1.0).any():
            estimated = replace(
                estimated, S=factors[:, None, None] * estimated.S, b=factors[:, None] * estimated.b
            )
    S = estimated.S.sum(axis=0)
    misfit = estimated.scatter * estimated.shared
    # Scaled: the deviations have different units.
    scale = np.outer(sigmas, sigmas)
    covariance = inverse(scale * S / misfit + np.eye(len(sigmas))) * scale
    off = covariance @ (estimated.b.sum(axis=0) - S @ active) / misfit
    return Solution(off, covariance, estimated, active)


def off_now(
    code: Code, deviation: float, sigma: float, effects: Sequence[Effect]
) -> Inconsistency:
    """A quantity of one value that changes, with its deviation at the last pair."""
    quantity = findings.BY_CODE[code]
    deviations = np.where(_parts_of(quantity), deviation, 0.0)
    covariance = np.diag(np.where(_parts_of(quantity), sigma**2, 0.0))
    certainty = abs(deviation) / sigma
    return Inconsistency(
        quantity, deviations, covariance, certainty, *_shifts(deviations, effects)
    )


def _shifts(deviation: Array, effects: Sequence[Effect]) -> tuple[float, float]:
    """Shift of the poses that a deviation (K,) moves most, and the median in published sigmas."""
    if not effects:
        return 0.0, 0.0
    shifts = [np.linalg.norm(effect.shift @ deviation) for effect in effects]
    claimed = [np.linalg.norm(effect.claimed_shift @ deviation) for effect in effects]
    return float(np.quantile(shifts, _OBSERVABLE_IN)), float(np.quantile(claimed, 0.5))


def _inconsistency(
    quantity: Quantity, solution: Solution, certainty: float, effects: Sequence[Effect]
) -> Inconsistency:
    deviation = np.where(_parts_of(quantity), solution.off, 0.0)
    shift, claimed = _shifts(deviation, effects)
    step = solution.active + solution.off - solution.estimated.about  # of the linearisation
    covariance = solution.widened_covariance + np.diag((_REMAINS * step) ** 2)
    return Inconsistency(quantity, deviation, covariance, certainty, shift, claimed)


def assess(
    estimated: Calibration,
    inconsistent: list[Inconsistency],
    gross: tuple[Finding, ...],
    configured: Configured,
) -> findings.Assessment:
    """Findings on all quantities; by `find_inconsistencies` and `gross_errors`."""
    if gross:
        # Poses of wrong axes or units do not determine the other quantities.
        return findings.Assessment(
            gross + not_evaluated({finding.code for finding in gross}, gross[0].code)
        )
    largest = max((one.shift for one in inconsistent), default=0.0)
    faults = {
        one.quantity.code: one
        for one in inconsistent
        if one.shift > max(_MATTERS, _TRACE * largest)
        and (np.abs(one.deviation) > (AS_CONFIGURED * configured.sigmas))[one.quantity.part].any()
    }
    others = {
        one.alternative.quantity.code: one.alternative
        for one in faults.values()
        if one.alternative is not None
    }
    faults |= others
    candidates = tuple(faults) if others else ()
    found: list[Finding] = []
    for quantity in findings.QUANTITIES:
        part = quantity.part
        if quantity.code in faults:
            found += _fault_findings(faults[quantity.code], estimated, configured, candidates)
        elif quantity.uncertainty(configured, estimated.covariance[part, part]) > (
            quantity.observable
        ):
            found.append(quantity.unknown(Why.NOT_OBSERVABLE))
        elif faults:
            found.append(quantity.unknown(Why.OTHER_INCONSISTENT, next(iter(faults))))
        else:
            left = (estimated.c - configured.active)[part]
            covariance = estimated.covariance[part, part]
            found.append(_values(quantity, left, covariance, configured, len(estimated.b)))
    return findings.Assessment(tuple(found))


def not_evaluated(named: set[Code], wrong: Code) -> tuple[Finding, ...]:
    """Findings on the quantities that are not `named`, while another one is `wrong`."""
    return tuple(
        quantity.unknown(Why.OTHER_WRONG, wrong)
        for quantity in findings.QUANTITIES
        if quantity.code not in named
    )


def _fault_findings(
    one: Inconsistency,
    estimated: Calibration,
    configured: Configured,
    candidates: tuple[Code, ...],
) -> Iterator[Finding]:
    """Findings on an inconsistent quantity; `candidates`: all hypotheses that fit as well."""
    quantity = one.quantity
    sure = one.claimed_shift * (1.0 - 2.0 / one.certainty)
    state = FindingState.WRONG if sure > _OUTSIDE else FindingState.SUSPECT
    part = quantity.part
    left = one.deviation[part]
    of_selection = (_SELECTED * np.linalg.norm(left)) ** 2 * np.eye(len(left))
    covariance = one.covariance[part, part] + of_selection
    consistent = _values(quantity, left, covariance, configured, len(estimated.b))
    evidence = replace(consistent.evidence, sigmas=one.certainty, shift=one.shift)
    found = replace(consistent, state=state, why=Why.OFF, evidence=evidence, candidates=candidates)
    assert found.estimate is not None
    if quantity.code is Code.READOUT_TIME and found.estimate < 0.0:
        other = readout_direction(configured.camera.readout_axis, -configured.direction)
        yield replace(found, code=Code.READOUT_DIRECTION, settings={'readout_direction': other})
        return
    settings = _setting(found, left, configured) | _tracking(quantity, found.estimate, configured)
    if quantity.code is Code.TIME_OFFSET:
        settings |= _equivalent_row(one, configured)
    yield replace(found, settings=settings)
    if quantity.code is Code.DISTORTION and _hardly_distorted(found, configured.camera):
        yield Finding(Code.IMAGE_GEOMETRY, state, Why.RECTIFIED, parent=Code.DISTORTION)


def _hardly_distorted(found: Finding, camera: RollingShutterCamera) -> bool:
    """Whether the image's corner is displaced by a small part of what is configured."""
    by_coefficients = displacements([corner_radius(camera)])[0]
    estimated, active = (
        abs(float(by_coefficients @ coefficients))
        for coefficients in (found.estimated, found.configured)
    )
    return estimated < _LITTLE_OF * active


def _setting(found: Finding, left: Array, configured: Configured) -> dict[str, Any]:
    """The parameter that removes a deviation `left`, with its value; empty if there is none."""
    if found.code is Code.AXES:
        R_cam_imu = exp_so3(left) @ configured.sensor.R_cam_imu
        quat_xyzw = Rotation.from_matrix(R_cam_imu).as_quat()
        return {'quat_cam_imu_xyzw': findings.rounded(quat_xyzw)}
    if found.code is Code.GYRO_BIAS:
        return {'gyro_bias': findings.rounded(found.estimated)}
    if found.code in (Code.TIME_OFFSET, Code.READOUT_TIME):
        return {found.code.value: found.estimate}
    if found.code in (Code.DISTORTION, Code.TANGENTIAL):
        change = by_name()
        change[PARTS[found.code.value]] = np.subtract(found.estimated, found.configured)
        right = configured.camera.moved_lens(change[LENS])
        return {'distortion_coefficients': findings.rounded(right.distortion)}
    return {}


def _tracking(quantity: Quantity, estimated: float, configured: Configured) -> dict[str, Any]:
    """The parameter that has a quantity tracked, if that is off and reaches the estimate."""
    sensor = configured.sensor
    if not quantity.tracking or getattr(sensor, quantity.tracking):
        return {}
    # Tracking starts from the parameter.
    start = getattr(sensor, quantity.code.value) or 0.0
    return {quantity.tracking: True} if abs(estimated - start) < quantity.reach else {}


def _equivalent_row(one: Inconsistency, configured: Configured) -> dict[str, Any]:
    """Another stamped row that is equivalent to the deviation of the time offset."""
    camera = configured.camera
    offset_at = LIVE.index('time_offset')
    deviation = one.deviation[offset_at]
    sigma = math.sqrt(one.covariance[offset_at, offset_at])
    for row in REFERENCE_ROWS:
        index = replace(camera, reference_row=row).reference_row_index
        offset = camera.line_delay * (camera.reference_row_index - index)
        if row != camera.reference_row and (abs(deviation - offset) < 2.0 * sigma):
            return {'stamp_row': row}
    return {}


def _values(
    quantity: Quantity, left: Array, covariance: Array, configured: Configured, pairs: int
) -> Finding:
    """A consistent finding with the values of a quantity.

    `left` (m,) with its `covariance` (m, m) is the deviation from the active values; of a vector,
    the most certain component is reported.
    """
    if quantity.shapes is not None:
        shapes = quantity.shapes(configured)
        left = shapes @ left
        covariance = shapes @ covariance @ shapes.T
    sigmas = np.sqrt(np.diag(covariance))
    worst = int(np.argmax(np.abs(left) / sigmas))
    sigma = float(sigmas[worst])
    evidence = Evidence(sigmas=abs(float(left[worst])) / sigma, pairs=pairs)
    active = np.atleast_1d(quantity.value(configured, np.zeros(len(left))))
    estimated = np.atleast_1d(quantity.value(configured, left))
    return Finding(
        quantity.code,
        FindingState.OK,
        Why.CONSISTENT,
        tuple(active.tolist()),
        tuple(estimated.tolist()),
        sigma * quantity.per_deviation(configured, float(estimated[-1])),
        quantity.unit,
        component=worst if len(active) > 1 else 0,
        evidence=evidence,
    )


def gross_errors(
    rotations: RotationComparison | None,
    ahead: float,
    configured: Configured,
    before: tuple[Finding, ...] = (),
) -> tuple[Finding, ...]:
    """Axes, unit, flips, clocks (`ahead` [s]); those `before` until they are contradicted."""
    if rotations is None:
        return before
    if rotations.left_as_configured < _EXPLAINED_AT_BEST and (
        1.0 < rotations.scale * _UNIT_FACTOR < _UNIT_FACTOR**2
    ):
        return tuple(_rotation_errors(rotations, configured))
    if clocks_apart(ahead):
        return (
            Finding(
                Code.TIME_OFFSET,
                FindingState.WRONG,
                Why.CLOCKS_APART,
                evidence=Evidence(measured={'ahead_s': ahead}),
                settings={'time_offset': configured.sensor.time_offset + ahead},
            ),
        )
    if rotations.offset is not None:
        return (_other_time(rotations.offset, configured),)
    if rotations.is_at_another_time:
        active = _active_offset(configured)
        why = Why.AT_OTHER_TIME
        return (Finding(Code.TIME_OFFSET, FindingState.WRONG, why, (active,), unit='s'),)
    found = tuple(_rotation_errors(rotations, configured))
    # Any error may leave images and gyro independent for a while, if frames are lost.
    certain = found and (not before or found[0].why is not Why.INDEPENDENT)
    return found if certain else before


def _other_time(offset: float, configured: Configured) -> Finding:
    """That images and gyro rotate alike at another offset, far from the active one."""
    active = _active_offset(configured)
    return Finding(
        Code.TIME_OFFSET,
        FindingState.WRONG,
        Why.AT_OTHER_TIME,
        (active,),
        (active + offset,),
        unit='s',
        settings={'time_offset': round(active + offset, 2)},
    )


def _active_offset(configured: Configured) -> float:
    """Time offset [s] of the parameter with what is applied to it."""
    return configured.sensor.time_offset + float(configured.active[LIVE.index('time_offset')])


def _rotation_errors(rotations: RotationComparison, configured: Configured) -> Iterator[Finding]:
    """Axes, unit and flips, from the rotations of images and gyro."""
    explained = min(rotations.left_at_best, rotations.left_mirrored)
    if explained < _EXPLAINED_AT_BEST:
        is_other_unit = rotations.scale * _UNIT_FACTOR < 1.0 or rotations.scale > _UNIT_FACTOR
        if is_other_unit or rotations.has_other_factor:
            yield Finding(
                Code.GYRO_UNIT, FindingState.WRONG, Why.GROSS, (1.0,), (rotations.scale,)
            )
        if rotations.is_left_handed or rotations.is_turned:
            yield from _wrong_axes(rotations, configured)
    elif (
        rotations.by_gyro > _LONG_ROTATION and min(explained, rotations.left_of_all) > _INDEPENDENT
    ):
        # Of a constant rate only noise is left once it is removed.
        candidates = Code.IMAGE_GEOMETRY, Code.TIME_OFFSET
        for code in candidates:
            yield Finding(code, FindingState.WRONG, Why.INDEPENDENT, candidates=candidates)


def _wrong_axes(rotations: RotationComparison, configured: Configured) -> Iterator[Finding]:
    R_cam_imu = configured.sensor.R_cam_imu
    if rotations.is_left_handed:
        # Usually a single sign in the axes of the IMU itself.
        signs = np.diag(R_cam_imu.T @ rotations.reflection @ R_cam_imu)
        axis = 'xyz'[int(np.argmin(signs))] if sorted(signs)[1] > 0.7 > -0.7 > min(signs) else ''
        evidence = Evidence(measured={'axis': axis})
        yield Finding(Code.AXES, FindingState.WRONG, Why.LEFT_HANDED, evidence=evidence)
        return
    images = _how_images_are_turned(rotations)
    candidates = (Code.AXES, Code.IMAGE_GEOMETRY) if images else ()
    xyzw = Rotation.from_matrix(rotations.rotation @ R_cam_imu).as_quat()
    yield Finding(
        Code.AXES,
        FindingState.WRONG,
        Why.GROSS,
        (0.0,),
        (math.degrees(rotations.angle),),
        unit='deg',
        candidates=candidates,
        settings={'quat_cam_imu_xyzw': findings.rounded(xyzw, 3)},
    )
    for why in images:
        yield Finding(Code.IMAGE_GEOMETRY, FindingState.WRONG, why, candidates=candidates)


def _how_images_are_turned(rotations: RotationComparison) -> list[Why]:
    """What turned images would explain a rotation of the axes; empty if none would."""
    angle = rotations.angle
    Q = rotations.rotation
    found = []
    about_view = float(log_so3(Q)[2])
    if abs(abs(about_view) - 0.5 * math.pi) < _QUARTER_TURN > angle - abs(about_view):
        found.append(Why.CLOCKWISE if about_view > 0.0 else Why.COUNTERCLOCKWISE)
    if abs(angle - math.pi) < _HALF_TURN:
        axis_of = np.abs(np.linalg.eigh(Q + Q.T)[1][:, -1])
        if float(axis_of.max()) > math.cos(_HALF_TURN):
            found.append(Why.UPSIDE_DOWN if axis_of[2] == axis_of.max() else Why.MIRRORED)
    return found


# -- Noise of the gyro ----------------------------------------------------------------------------

# Distance [px] by which the noise of the gyro moves the first and the last row of a frame against
# the middle one, from which no pose is published. A smaller one would withhold poses whose
# covariance holds, a larger one would publish reversed ones. [measured: at 0.4 px all poses of a
# vibrating camera are within two of their sigmas, at 0.8 px one of 26 is 15 sigmas off]
_ROWS_MOVED = 0.5
# Longest step between samples [s] that show a noise. The differences of a slower sensor contain
# the motion: it is in the covariance, and has no name. [measured: at 100 Hz four recordings show 2
# to 7 times the default density, at 200 Hz 0.5 to 1.8 times]
_FAST = 7e-3


# 1 sigma of such a noise, relative. A smaller one would claim more than a pair's samples tell.
# [derived: 1 / sqrt(2 n) of n = 50 independent values]
_NOISE_SIGMA = 0.1
# 1 sigma of the jitter of stamps, relative. A smaller one would claim more than 32 stamps tell.
# [derived: 1 / sqrt(2 n) of n = 12 independent values, as three stamps make one change]
_JITTER_SIGMA = 0.2


def noise_of_gyro(pair: PairData, configured: Configured) -> Finding | None:
    """The finding on the noise that the samples of a pair show; None if it is as configured."""
    segment = pair.segment
    active = configured.gyro_noise_density
    # Where frames begin, samples are interpolated between others.
    step = np.quantile(np.diff(segment.stamps_ns), 0.75) / NANOSECONDS
    if segment.noise_density < NOISY * active or step > _FAST:
        return None
    begin, end = pair.camera.row_time_span
    moved = 0.5 * (end - begin) * pair.gyro_sigma * pair.camera.fx
    return Finding(
        Code.GYRO_NOISE,
        FindingState.WRONG if moved > _ROWS_MOVED else FindingState.SUSPECT,
        Why.OFF,
        (active,),
        (segment.noise_density,),
        _NOISE_SIGMA * segment.noise_density,
        'rad/s/sqrt(Hz)',
        evidence=Evidence(measured={'ratio': segment.noise_density / active, 'rows_px': moved}),
        settings={'gyro_noise_density': float(f'{segment.noise_density:.2g}')},
    )


def jitter_of_stamps(sigma: float) -> Finding:
    """The finding that images are stamped on arrival, with the scatter [s] of the stamps."""
    return Finding(
        Code.STAMP_JITTER,
        FindingState.SUSPECT,
        Why.OFF,
        (0.0,),
        (sigma,),
        _JITTER_SIGMA * sigma,
        's',
    )


# -- A test that presupposes no cause -------------------------------------------------------------
#
# Each pair has a score in the deviations of the configuration. At the deviations that fit all
# pairs best, the scores that are left are those of noise, with the information of each pair as
# their covariance. If they are larger, the pairs contradict each other, and no deviation is the
# cause.

# Median of the pairs' chi-square per degree of freedom from which no deviation explains them. Less
# would doubt correct recordings, more would publish poses of a camera that stabilises its images.
# [measured: 0.2 on simulated walks, 0.5 to 0.8 on recordings of a RealSense, up to 1.7 on those of
# a phone; 2.3 to 4.2 with stabilisation, vibration, an object or stamps that jitter]
_LARGEST_CHI_SQUARE = 2.2
# Pairs that show it. Fewer would doubt pairs that are not yet linearised about a deviation that is
# far off. [chosen: 2 to 4 s of keyframes]
_FEWEST_PAIRS = 20
# The same if a parameter is wrong by the pairs: at its estimate, the pairs would agree by then.
# [chosen: 5 to 10 s of keyframes]
_FEWEST_IF_NAMED = 50
# What changes images or gyro from pair to pair, other than any deviation of the configuration.
# [derived: codes of the findings whose texts say what to do]
_CANDIDATES = (Code.IMAGE_GEOMETRY, Code.GYRO_NOISE, Code.TIME_OFFSET)
# The same, and what makes images and gyro contradict each other in every pair. [derived: as above]
_CANDIDATES_OF_BOTH = (*_CANDIDATES, Code.FOCAL_LENGTH, Code.DISTORTION)


def contradicting(differing: int, pairs: int) -> Finding:
    """The finding that images contradict the gyro in `differing` of the last pairs."""
    evidence = Evidence(pairs=pairs, measured={'differing': differing})
    return _unknown_of_both(Why.CONTRADICTING, evidence)


def impossible(faults: Sequence[Finding], pairs: int) -> Finding:
    """The finding that only impossible values of parameters, `faults`, explain the last pairs."""
    names = [fault.code.value for fault in faults]
    evidence = Evidence(pairs=pairs, measured={'parameters': names})
    return _unknown_of_both(Why.IMPOSSIBLE, evidence)


def _unknown_of_both(why: Why, evidence: Evidence) -> Finding:
    """The finding that images and gyro do not agree, for a cause that is not known."""
    return Finding(
        Code.UNKNOWN_CAUSE,
        FindingState.WRONG,
        why,
        evidence=evidence,
        candidates=_CANDIDATES_OF_BOTH,
    )


def unexplained(estimated: Calibration, *, is_named: bool = False) -> Finding | None:
    """The finding that pairs contradict each other without a known cause; None if they agree.

    `is_named`: whether a parameter is wrong by these pairs, which may be linearised far from it.
    """
    count = len(estimated.b)
    if count < (_FEWEST_IF_NAMED if is_named else _FEWEST_PAIRS):
        return None
    ratio = _disagreement(estimated)
    if ratio < _LARGEST_CHI_SQUARE:
        return None
    return Finding(
        Code.UNKNOWN_CAUSE,
        FindingState.WRONG,
        Why.UNEXPLAINED,
        evidence=Evidence(pairs=count, measured={'chi_square_per_freedom': ratio}),
        candidates=_CANDIDATES,
    )


@functools.lru_cache(maxsize=1)
def _disagreement(estimated: Calibration) -> float:
    """Median of the pairs' chi-square per degree of freedom; kept, as it is asked for twice."""
    # Scaled by the prior: the deviations have different units.
    information = estimated.S * np.outer(LIVE.sigmas, LIVE.sigmas)
    scores = (estimated.b - estimated.S @ estimated.c) * LIVE.sigmas
    with_prior = information + np.eye(LIVE.size)
    whitened = np.linalg.solve(with_prior, np.dstack([scores, information]))
    squares = (scores * whitened[:, :, 0]).sum(axis=1)
    freedom = np.trace(whitened[:, :, 1:], axis1=1, axis2=2)
    return float(np.median(squares / freedom))
