"""The consistency monitor: follows the configured parameters over frames and pairs."""

from __future__ import annotations

from collections import deque
from contextlib import suppress
from dataclasses import dataclass, replace
import math
from typing import NamedTuple

import numpy as np
from scipy.linalg import solve_triangular

from rs_relpose_ros.calibration import assessment, findings, findings_text, posterior
from rs_relpose_ros.calibration.assessment import Effect, Inconsistency
from rs_relpose_ros.calibration.changes import Change, change_of, drift_doubts, Kind
from rs_relpose_ros.calibration.clock_steps import ClockStep, ClockSteps, CONTRADICTS_GYRO
from rs_relpose_ros.calibration.findings import (
    Assessment,
    Code,
    Configured,
    Evidence,
    Finding,
    FindingState,
    Why,
)
from rs_relpose_ros.calibration.posterior import Calibration, Posterior
from rs_relpose_ros.calibration.readout_direction import ReadoutDirections
from rs_relpose_ros.calibration.residual_maps import ResidualMaps
from rs_relpose_ros.calibration.rotations import AccelerationSums, RotationSums
from rs_relpose_ros.calibration.second_motion import SecondMotions
from rs_relpose_ros.config.settings import ImuConfig, SensorConfig
from rs_relpose_ros.core.deviations import LIVE
from rs_relpose_ros.estimator.result import (
    Diagnostics,
    GYRO_CONTRADICTION,
    RelativePose,
    Status,
)
from rs_relpose_ros.estimator.velocity import InertialEvidence
from rs_relpose_ros.geometry import Array
from rs_relpose_ros.geometry.so3 import tangent_basis
from rs_relpose_ros.geometry.timing import NANOSECONDS, seconds_between

# Number of frames by whose arrival the clocks are compared. Fewer would take a burst of the
# transport for another clock; more would notice it later. [chosen: under a second at 30 Hz]
_ARRIVALS = 20
# Sigmas of a suspect value beyond which it may be the cause of pairs that contradict the gyro.
# Fewer would name what stabilised images make of the parameters, more would miss a bias that is
# off. [measured: at most 4.4 with stabilised images; 5 to 8 would do]
_SURE = 5.0
# Number of the latest pairs on whose poses the shift by a deviation is evaluated. Fewer would
# follow the motion of a moment; more would forget late what a quiet motion is.
# [chosen: about 5 s of pairs]
_EFFECTS = 30
# Number of pairs whose agreement is remembered, by an exponential mean. Fewer make the factor of
# the covariance itself noise; more follow a change of light late.
# [chosen: the effective number of pairs of 4 s]
_REMEMBERED = 20.0
# Number of pairs as which the prior counts that covariances are right. Fewer would widen the first
# pairs of each recording by chance. [chosen: half of those that are remembered]
_PRIOR_PAIRS = 10.0
# Last pairs of which few may contradict the gyro. [chosen: about a second of keyframes]
_RECENT = 8
# Number of them whose images reject the gyro's rotation, from which no pose is published. Fewer
# would follow single poor pairs, more would publish poses of a camera that stabilises its images.
# [measured: 2 of 41 pairs of a recording in poor light, none of other correct recordings]
_MOST_REJECTED = 2
# The same of pairs whose rotation differs from the gyro's by `CONTRADICTS_GYRO`. [measured: none
# on correct walks and two recordings, 5 with an offset that moves by 8 ms, 7 with squeezed images]
_MOST_DIFFERENT = 5
# Difference between the factors of a gyro's axes that is no cause. A smaller one would leave a bad
# gyro without a name, a larger one would name the scale for two views in one image, which have
# factors of 0.6 and 1.2. [chosen: another unit is one factor, and MEMS gyros are within 5 %; 0.15
# to 0.4 would do]
_LARGEST_SPREAD = 0.3
# The same of pairs with which it ends. With more, pairs of two views in one image would be
# published between others; with fewer, a single poor pair would withhold many. [measured: 4 of 8
# differ where the images of two views show poses that are up to 130 of their sigmas off]
_ENDS_WITH = 1
# Pairs that agree with the gyro, before which a pair that differs from it has no pose: no test has
# excluded yet that all of them will. Fewer would publish the first pairs of a camera that is
# configured wrong, more would withhold single poor pairs of correct recordings for longer.
# [measured: on portrait, squeezed and stabilised images the first four pairs have a chi-square of
# 13 to 530 and are up to 6 of their sigmas off; on correct walks it is at most 1.3]
_TESTED = 8
# Part of the distance of 99.7 % by which it grows with the inverse of the degrees of freedom that
# a variance is known by. [derived: Student's distribution, (z^2 + 1) / 4 at z = 2.97]
_STUDENT = 2.46
# Degrees of freedom of a pair's rotation against the gyro's. [derived: a rotation has three]
_OF_ROTATION = 3.0
# Reason for a pair whose images contradict the gyro. [derived: text for people]
_STEP_SOUGHT = f'{GYRO_CONTRADICTION}, other than before: a step of a clock is looked for'
# Reason for a pair among others that contradict the gyro. [derived: text for people]
_CONTRADICTING = 'the images of most of the last pairs contradict the gyro, whatever the cause'
# Reason for a pair that contradicts the gyro before others agree. [derived: text for people]
_UNTESTED = (
    'the images contradict the gyro, and few pairs before agree with it: the configuration is '
    'being tested'
)
# Reason for a pair of two views alone where each frame has errors. [derived: text for people]
_BY_TWO_VIEWS = (
    'the frames of the pair do not fit each other, as stamps jitter or the gyro has noise '
    '(see health)'
)
# Reason for a pair that may follow an object. [derived: text for people]
_TWO_MOTIONS = (
    'the matches have two motions, and the images contradict the gyro: an object moves in the view'
)
# Largest chi-square of a pair per degree of freedom that counts. Without a bound a single pair of
# a moving object would widen the pairs of many seconds.
# [chosen: far above the 99.9 % quantile of two degrees of freedom, 6.9]
_LARGEST_DISAGREEMENT = 20.0


class _Due(NamedTuple):
    """A pair that was added and is not assessed yet."""

    stamp_ns: int
    data: posterior.PairData | None
    pose: RelativePose
    configured: Configured
    is_learned: bool = False
    information: posterior.PairInformation | None = None


class ConsistencyMonitor:
    """Compares the configuration with frames and pairs in the order of time.

    Each pair is added before its pose is published; `learn` and `assess` follow the publication.
    """

    def __init__(self) -> None:
        self.rotations = RotationSums()
        self._recursion = Posterior()
        self._directions = ReadoutDirections()
        self.acceleration = AccelerationSums()
        self.agreement = Agreement()
        self._on_poses: deque[Effect] = deque(maxlen=_EFFECTS)
        self._on_rotations: deque[Effect] = deque(maxlen=_EFFECTS)
        self.latest: posterior.PairInformation | None = None  # of the last pair
        self._inconsistent: list[Inconsistency] = []
        self._likely = np.zeros(LIVE.size)  # about which pairs are linearised
        self._undetermined: Array | None = None  # by the pairs before
        self.stamp_sigma = 0.0  # [s] scatter of the stamps of the last frames
        self.jitter = 0.0  # [s] the same where images are stamped on arrival, otherwise 0
        self._gross: tuple[Finding, ...] = ()
        self.image_findings: tuple[Finding, ...] = ()  # of what is in view
        self._noise: Finding | None = None  # of the gyro, by its samples of the last pair
        self.clock_steps = ClockSteps()
        self.second_motions = SecondMotions()
        self.contradictions = Contradictions()
        self.residuals = ResidualMaps.of_last_seconds()
        self._step: tuple[int, Finding] | None = None  # the last one, with the stamp of its end
        self._drift: Finding | None = None  # that is followed
        self.change: Change | None = None  # by the pairs so far, not followed yet
        # Seconds by which stamps of the IMU are ahead as images arrive, of the last frames.
        self.ahead: deque[float] = deque(maxlen=_ARRIVALS)
        self._wrong_configuration = False  # by the last pair
        # The last pair until it is assessed.
        self._due: _Due | None = None
        self.health, self.calibration = findings.NOT_EVALUATED, posterior.NOTHING_ESTIMATED

    def add_acceleration(self, stamp_ns: int, evidence: InertialEvidence) -> None:
        """Add the evidence of a pair about the accelerometer, before the pair itself."""
        # Velocities of a wrong configuration are no evidence.
        if not self._wrong_configuration:
            self.acceleration.add(stamp_ns, evidence)

    @property
    def has_other_unit(self) -> bool:
        """Whether the gyro has another unit: all images contradict it, and none by an object."""
        return any(one.code is Code.GYRO_UNIT for one in self._gross)

    def deviates_as_allowed(self, configured: Configured) -> bool:
        """Whether a parameter certainly deviates, but within its configured sigma.

        Images and gyro then differ in every pair, and the covariance of poses contains it.
        """
        off = np.abs(self.calibration.c - configured.active) / assessment.AS_CONFIGURED
        return bool(((off > self.calibration.sigma) & (off < configured.sigmas)).any())

    def add_pair(
        self,
        stamp_ns: int,
        data: posterior.PairData | None,
        pose: RelativePose,
        configured: Configured,
    ) -> RelativePose:
        """Add a pair; the pose with a covariance consistent with the pairs before it.

        `data` is None if the pair has no rotation or no gyro. `learn` and `assess` complete it.
        """
        self.latest, self._due = None, _Due(stamp_ns, data, pose, configured)
        if data is None:
            return pose
        self._noise = assessment.noise_of_gyro(data, configured)
        by_deviation = pose.by_deviation
        if by_deviation is None or self._undetermined is None:
            # Two views, or the first pair: the covariance needs what the pair itself tells.
            information = self.learn()
            if information is None or self._undetermined is None:
                return pose
            by_deviation = information.pose_by_deviation
        shift = by_deviation @ self._deviation()
        # The inconsistency, and deviations that the pairs before have not excluded.
        doubt = np.outer(shift, shift) + by_deviation @ self._undetermined @ by_deviation.T
        assessed = replace(pose, covariance=pose.covariance + doubt)
        # The effect of an inconsistent parameter on the baseline is not known.
        return (
            assessed.without_baseline(
                'baseline not known: a configured parameter is inconsistent (see health)'
            )
            if shift.any() and pose
            else assessed
        )

    def widened(
        self,
        stamps_ns: tuple[int, int],
        pose: RelativePose,
        assessed: RelativePose,
        imu: ImuConfig,
    ) -> RelativePose:
        """The pose with all that its own pair does not show; `assessed`: of `add_pair`."""
        pose = self.agreement.enlarged(*stamps_ns, pose, assessed)
        return with_scale_doubt(self.contradictions.widened(pose), imu)

    def without_doubtful(
        self,
        pose: RelativePose,
        *,
        has_rate_doubt: bool,
        may_be_step: bool,
        follows_object: bool,
    ) -> RelativePose:
        """The pose, unless it is wrong, or no test says that its covariance holds.

        `has_rate_doubt`: whether the gyro has more noise than configured. `may_be_step` and
        `follows_object`: what `clock_steps` and `second_motions` say of the pair.
        """
        pose = suppressed(pose, self.health)
        # Two views have no test, and no part of the covariance, for errors of single frames.
        is_of_frames = math.isfinite(pose.diagnostics.gyro_square)
        has_errors = has_rate_doubt or self.jitter > 0.0
        for is_so, reason in (
            (self.contradictions.is_untested, _UNTESTED),
            (self.contradictions.too_many, _CONTRADICTING),
            (has_errors and not is_of_frames, _BY_TWO_VIEWS),
            (may_be_step, _STEP_SOUGHT),
            (follows_object, _TWO_MOTIONS),
        ):
            if is_so:
                pose = withheld(pose, reason)
        return pose

    def learn(self) -> posterior.PairInformation | None:
        """Estimate the calibration from the last pair as well: its pose does not wait for it.

        Returns what the pair tells; None if it tells nothing.
        """
        if self._due is None or self._due.data is None or self._due.is_learned:
            return self.latest
        self._due = self._due._replace(is_learned=True)
        stamp_ns, data, pose, configured = self._due[:4]
        assert data is not None
        self.clock_steps.measure()
        try:
            # The effect of an inconsistent quantity is evaluated at its estimate: where poses are
            # off already, a little more or less may hardly move them.
            likely = np.clip(self._likely, -LIVE.largest, LIVE.largest)
            about = np.asarray(configured.active + likely)
            information = self._recursion.add(stamp_ns, data, configured.active, about)
            if information is None:
                return None
            if pose.by_deviation is not None:
                # The published pose is the one of all frames, which depends less on deviations.
                information = replace(information, pose_by_deviation=pose.by_deviation)
            self.latest = information
            self.calibration = self._recursion.solved()
            self._due = self._due._replace(information=information)
            if self._undetermined is None:
                self._undetermined = assessment.undetermined(self.calibration, configured)
        except np.linalg.LinAlgError:
            # A pair without rank has no information on the calibration; its pose is kept.
            self._inconsistent = []
        return self.latest

    def assess(self) -> None:
        """Assess all quantities after the last pair, for the next one: its pose does not wait."""
        self.learn()
        if self._due is None:
            return
        due, self._due = self._due, None
        if self.clock_steps.may_be_step:
            # Pairs across a step would be taken for errors of any parameter.
            return
        information, pose, configured = due.information, due.pose, due.configured
        if information is not None:
            try:
                if self._recursion.relinearise():
                    self.calibration = self._recursion.solved()
                (self._on_poses if pose else self._on_rotations).append(_effect(information, pose))
                # A deviation may be so large that no pair has a pose.
                self._find_inconsistencies(configured)
            except np.linalg.LinAlgError:
                self._inconsistent = []
            self._compare_directions(due)
        if self.second_motions.in_view:
            # Rotations by the images are those of the object.
            self.rotations.clear()
            found_object = self.second_motions.finding()
            others = assessment.not_evaluated(set(), found_object.code)
            self.health = Assessment((found_object, *others, *self.image_findings))
            return
        # The least lead of the IMU's clock, forwards or backwards; 0 if its sign changes.
        ahead = max(min(self.ahead, default=0.0), 0.0) + min(max(self.ahead, default=0.0), 0.0)
        compared = self.rotations.compared()
        self._gross = assessment.gross_errors(compared, ahead, configured, self._gross)
        gross = self._gross or self._directions.findings(configured.camera)
        self.health = assessment.assess(self.calibration, self._inconsistent, gross, configured)
        if not gross:
            self._test_without_cause()
        contradicts = self.contradictions.counts[0] > _MOST_REJECTED
        # Slow rotations look unrelated, too, by their noise, but then pairs agree with the gyro.
        is_unrelated = contradicts and compared is not None and compared.is_unrelated
        if not gross and (unknown := self._unknown_cause(is_unrelated)) is not None:
            others = assessment.not_evaluated(set(), unknown.code)
            self.health = Assessment((unknown, *others))
        if not gross and self._noise is not None and self._noise.state is FindingState.WRONG:
            # Rows that the gyro turns wrongly say nothing of the other quantities.
            others = assessment.not_evaluated(set(), self._noise.code)
            self.health = Assessment((self._noise, *others))
        self._wrong_configuration = bool(self.health.faults)
        # Nor are velocities of rotations that contradict the gyro, or of frames with own errors.
        has_errors = bool(self.jitter) or self._noise is not None
        if self._wrong_configuration or contradicts or has_errors:
            self.acceleration.clear()
        self._add_others(due.stamp_ns)
        self.residuals.test_in_turn()
        # Residuals differ as rotations do where a parameter deviates within its stated sigma.
        if not self.deviates_as_allowed(configured):
            self.health = self.residuals.added_to(self.health)

    def _unknown_cause(self, is_unrelated: bool) -> Finding | None:
        """The finding that no cause is known; None if a parameter is one, or nothing is wrong.

        `is_unrelated`: whether rotations of images and gyro have nothing in common, so that no
        small error of a parameter is the cause.
        """
        differing, count = self.contradictions.counts
        faults = self.health.faults
        # The difference between the factors of a gyro's axes.
        spread = np.ptp(self._deviation()[LIVE.part('gyro_scale')])
        # What is hardly suspect moves no rotation so far that most of the pairs contradict the
        # gyro, but stamps that jitter do.
        contradict = self.contradictions.too_many and not self.jitter
        is_sure = any(one.state is FindingState.WRONG or _is_sure(one) for one in faults)
        explains = is_sure or not contradict
        if faults and explains and not is_unrelated and spread <= _LARGEST_SPREAD:
            return None
        if self.contradictions.too_many:
            return assessment.contradicting(differing, count)
        return assessment.impossible(faults, count) if faults else None

    def _add_others(self, stamp_ns: int) -> None:
        """Add the findings that do not depend on the parameters."""
        found = self.health.findings
        if any(one.code is Code.GYRO_UNIT for one in found):
            # Such a gyro turns gravity away, and has another noise. Parts of the image that it
            # moves elsewhere seem still by chance.
            return
        if (also := self.acceleration.finding()) is not None:
            found = (*found, also)
        found = (*found, *self._of_changes(stamp_ns))
        if self._noise is not None and self._noise not in found:
            found = (*found, self._noise)
        if self.jitter:
            found = (*found, assessment.jitter_of_stamps(self.jitter))
        self.health = Assessment((*found, *self.image_findings))

    def _find_inconsistencies(self, configured: Configured) -> None:
        """Find which quantities are off, or change, by all pairs so far."""
        estimated, stamps_ns = self.calibration, self._recursion.stamps_ns
        effects = self._on_poses or self._on_rotations
        ranked = assessment.hypotheses(estimated, configured)
        self._undetermined = assessment.undetermined(
            estimated, configured, drift_doubts(ranked, stamps_ns, configured)
        )
        # Pairs that contradict each other would show a change by chance.
        self.change = (
            None
            if assessment.unexplained(estimated)
            else change_of(ranked, stamps_ns, configured, self.change, self.stamp_sigma)
        )
        if self.change is not None and self.change.is_drift_of('focal_log'):
            # It is not followed: what matters is the focal length of now.
            now, sigma = self.change.now, self.change.now_sigma
            self._inconsistent = [assessment.off_now(Code.FOCAL_LENGTH, now, sigma, effects)]
        else:
            self._inconsistent = assessment.find_inconsistencies(
                estimated, effects, configured, ranked
            )
        self._likely = (
            self._deviation() if self._inconsistent else assessment.likely(estimated, configured)
        )

    def _test_without_cause(self) -> None:
        """Report that the pairs contradict each other, in place of a cause that does not fit."""
        try:
            is_named = self.health.state is FindingState.WRONG
            unknown = assessment.unexplained(self.calibration, is_named=is_named)
        except np.linalg.LinAlgError:
            return
        if unknown is not None:
            others = assessment.not_evaluated(set(), unknown.code)
            self.health = Assessment((unknown, *others))

    def follow_step(self, step: ClockStep, configured: Configured) -> None:
        """Go on after a step of the time offset, with what the pairs after it say.

        `configured` has the offset after the step. Nothing is kept of the pairs before: the
        offset is as unknown as at the start.
        """
        self.restart()
        between_ns = step.before_ns, step.after_ns
        found = _finding_of_step(step.seconds, step.sigma, between_ns, step.gain, len(step.pairs))
        self._step = step.after_ns, found
        moved = np.zeros(LIVE.size)
        moved[LIVE.index('time_offset')] = step.seconds
        whole = self.clock_steps.joined
        assert whole is not None
        for pair in step.pairs:
            at_step = posterior.at_other_times(pair.data, whole, moved)
            if at_step is None:
                continue
            with suppress(np.linalg.LinAlgError):  # a pair without rank says nothing
                self._recursion.add(pair.stamp_ns, at_step, configured.active, configured.active)
        self.calibration = self._recursion.solved()

    def follow_change(self, change: Change, drift: float) -> None:
        """Go on after a small step or with a drift of the time offset, which is then `drift`.

        The pairs are referred to the configuration that follows the change.
        """
        stamps_ns = self._recursion.stamps_ns
        _, end_ns = change.between_ns
        offsets, first = np.full(len(stamps_ns), change.now), 0
        if change.kind is Kind.STEP:
            first = int(np.searchsorted(stamps_ns, end_ns))
            found = _finding_of_step(
                change.value, change.sigma, change.between_ns, change.gain, change.pairs
            )
            self._step = end_ns, found
        else:
            offsets += change.value * (stamps_ns - end_ns) / NANOSECONDS
            self._drift = _finding_of_drift(Code.OFFSET_DRIFT, change, drift, 's/s')
        self._recursion.follow_offsets(offsets, first)
        self.calibration = self._recursion.solved()
        self.residuals.clear()
        self._inconsistent, self.change = [], None
        self._likely, self._undetermined = np.zeros(LIVE.size), None
        self._due = None

    def _of_changes(self, stamp_ns: int) -> tuple[Finding, ...]:
        """Findings on a drift, and on the last step for some seconds after its trial."""
        found = () if self._drift is None else (self._drift,)
        change = self.change
        if change is not None and change.is_drift_of('focal_log'):
            zoom = _finding_of_drift(Code.FOCAL_DRIFT, change, change.value, '1/s')
            found = (*found, zoom)
        if self._step is None or self.clock_steps.on_trial:
            return found
        end_ns, step = self._step
        return (*found, step) if stamp_ns < end_ns + posterior.WINDOW_NS else found

    def restart(self) -> None:
        """Forget the pairs so far, but not what agreement with the gyro is."""
        self._recursion = Posterior()
        self.rotations.clear()
        self.acceleration.clear()
        self.contradictions.clear()
        self.residuals.clear()
        self._directions.clear()
        self.clock_steps.end_doubt()
        self._inconsistent, self._gross = [], ()
        self._likely, self._undetermined = np.zeros(LIVE.size), None
        self._due = self.latest = self._step = self.change = None
        self.calibration = posterior.NOTHING_ESTIMATED

    def _compare_directions(self, due: _Due) -> None:
        """Compare other directions of the readout while the configuration is inconsistent."""
        if self._inconsistent and due.data is not None:
            self._directions.add(due.stamp_ns, due.data, self._deviation())
        else:
            self._directions.clear()

    def _deviation(self) -> Array:
        """(K,) from the active values, of all inconsistent quantities."""
        return sum((one.deviation for one in self._inconsistent), np.zeros(LIVE.size))


def _is_sure(finding: Finding) -> bool:
    """Whether a value is off by more than `_SURE` of its sigmas."""
    if finding.estimate is None or finding.active is None or finding.sigma is None:
        return False
    return abs(finding.estimate - finding.active) > _SURE * finding.sigma


def _finding_of_step(
    seconds: float, sigma: float, between_ns: tuple[int, int], gain: float, pairs: int
) -> Finding:
    before_ns, after_ns = between_ns
    return Finding(
        Code.OFFSET_STEP,
        FindingState.SUSPECT,
        Why.STEPPED,
        estimated=(seconds,),
        sigma=sigma,
        unit='s',
        evidence=Evidence(
            pairs=pairs,
            log_likelihood=gain,
            measured={'before_ns': before_ns, 'after_ns': after_ns},
        ),
    )


def _finding_of_drift(code: Code, change: Change, rate: float, unit: str) -> Finding:
    begin_ns, end_ns = change.between_ns
    evidence = Evidence(
        pairs=change.pairs,
        log_likelihood=change.gain,
        measured={'first_ns': begin_ns, 'last_ns': end_ns},
    )
    return Finding(
        code,
        FindingState.SUSPECT,
        Why.DRIFTING,
        estimated=(rate,),
        sigma=change.sigma,
        unit=unit,
        evidence=evidence,
    )


def with_scale_doubt(pose: RelativePose, imu: ImuConfig) -> RelativePose:
    """The pose with the doubt of the accelerometer's scale in its baseline.

    Gravity has the length that the sensor itself measures, so that the acceleration, and the
    baseline with it, has the scale of the sensor. Nothing in a pair tells it.
    """
    log_sigma = math.hypot(pose.baseline_log_sigma, imu.accel_scale_sigma)
    return replace(pose, baseline_log_sigma=log_sigma) if math.isfinite(log_sigma) else pose


def suppressed(pose: RelativePose, health: Assessment) -> RelativePose:
    """The pose without its values, and the reason, if these are outside of their covariance."""
    if health.state is not findings.FindingState.WRONG:
        return pose
    return withheld(pose, findings_text.line(health.faults[0]))


def withheld(pose: RelativePose, reason: str) -> RelativePose:
    """The pose without its values, if it has any."""
    if not np.isfinite(pose.R).all():
        return pose
    return RelativePose(
        status=Status.WITHHELD,
        reason=reason,
        inliers=pose.inliers,
        diagnostics=Diagnostics(
            model=pose.diagnostics.model,
            iterations=pose.diagnostics.iterations,
            residual_rms=pose.diagnostics.residual_rms,
            duration=pose.diagnostics.duration,
        ),
    )


def _effect(information: posterior.PairInformation, pose: RelativePose) -> Effect:
    rows, claimed = slice(3, None), pose.covariance[3:, 3:]
    if pose:  # t is a direction: along itself it has no variance, and nothing moves it there
        rows, claimed = slice(None), pose.covariance + np.pad(np.outer(pose.t, pose.t), (0, 3))
    return Effect(
        information.shift_by_deviation[: None if pose else 3],
        solve_triangular(
            np.linalg.cholesky(claimed), information.pose_by_deviation[rows], lower=True
        ),
    )


class Contradictions:
    """How many of the last pairs contradict the gyro, from the first one on."""

    def __init__(self) -> None:
        self._kinds: deque[tuple[bool, bool]] = deque(maxlen=_RECENT)
        self._agreed = 0
        self.is_untested = False  # whether the last pair differs, and few have agreed before it
        self.too_many = False  # whether so many contradict it that no other one is to be trusted

    def add(self, pose: RelativePose, *, is_allowed: bool = False) -> None:
        """Add a pair with the pose of its estimate, which may be rejected.

        `is_allowed`: whether a deviation within its configured sigma makes rotations differ.
        """
        is_rejected = pose.diagnostics.rejected is not None
        differs = not is_allowed and pose.diagnostics.gyro_square > CONTRADICTS_GYRO
        self._kinds.append((is_rejected, is_rejected or differs))
        self.is_untested = differs and self._agreed < _TESTED
        self._agreed += not (is_rejected or differs)
        rejected = sum(is_rejected for is_rejected, _ in self._kinds)
        differing, count = self.counts
        if rejected > _MOST_REJECTED or differing > _MOST_DIFFERENT:
            self.too_many, self._agreed = True, 0
        elif count == _RECENT and differing <= _ENDS_WITH:
            self.too_many = False

    def clear(self) -> None:
        """Forget the pairs."""
        self._kinds.clear()
        self._agreed, self.too_many = 0, False

    def widened(self, pose: RelativePose) -> RelativePose:
        """The pose with the covariance of a noise that the pairs so far have tested.

        Few tests leave room for a larger one: the distance that contains 99.7 % is that of
        Student's distribution, with the prior of `Agreement` and three degrees of freedom a pair.
        """
        tested = 2.0 * _PRIOR_PAIRS + _OF_ROTATION * self._agreed
        factor = (1.0 + _STUDENT / tested) ** 2
        return replace(pose, covariance=factor * pose.covariance)

    @property
    def counts(self) -> tuple[int, int]:
        """Number of pairs that contradict the gyro, and of all of the last ones."""
        return sum(differs for _, differs in self._kinds), len(self._kinds)


class Agreement:
    """How far consecutive pairs agree about the direction of motion at the keyframe they share.

    Errors that all tracks of a pair share are not in its residuals, but in this difference. It
    gives a factor for the covariances of pairs with frames between.
    """

    def __init__(self) -> None:
        self._last: tuple[int, RelativePose] | None = None  # with its second stamp
        self._squares = self._freedom = 0.0

    def enlarged(
        self, first_ns: int, second_ns: int, pose: RelativePose, assessed: RelativePose
    ) -> RelativePose:
        """Add a pair by its `pose`; the assessed pose with its covariance enlarged."""
        before, self._last = self._last, None
        if not (pose and np.isfinite(pose.linear_velocity1_covariance).all()):
            return assessed
        self._last = second_ns, pose
        if before is not None and before[0] == first_ns:
            kept = 1.0 - 1.0 / _REMEMBERED
            self._squares = kept * self._squares + min(
                2.0 * _LARGEST_DISAGREEMENT, _disagreement(before[1], pose)
            )
            self._freedom = kept * self._freedom + 2.0
        prior = 2.0 * _PRIOR_PAIRS
        # The second factor: of a rotation that contradicts the gyro, as with two views.
        factor = max((prior + self._squares) / (prior + self._freedom), 1.0) * max(
            (1.0 + pose.diagnostics.gyro_square) / 4.0, 1.0
        )
        if factor == 1.0:
            return assessed
        velocities = assessed.velocity_covariance.copy()
        velocities[:3, :3] *= factor
        # Deviations that the monitor has not excluded would be in the disagreement, too: the
        # larger of both in each direction. Along t neither has a variance.
        along = np.pad(np.outer(pose.t, pose.t), (0, 3))
        root = np.linalg.cholesky(factor * pose.covariance + along)
        half = solve_triangular(root, assessed.covariance + along, lower=True)
        values, vectors = np.linalg.eigh(solve_triangular(root, half.T, lower=True))
        axes = root @ vectors
        return replace(
            assessed,
            velocity_covariance=velocities,
            covariance=(axes * np.maximum(values, 1.0)) @ axes.T - along,
            images=assessed.images and assessed.images.enlarged(factor),
        )


def _disagreement(before: RelativePose, after: RelativePose) -> float:
    """Chi-square (2 degrees of freedom) of the directions of motion at the shared keyframe."""
    lengths = np.linalg.norm([before.linear_velocity2, after.linear_velocity1], axis=1)
    across = tangent_basis(before.linear_velocity2 / lengths[0])
    apart = across.T @ after.linear_velocity1 / lengths[1]
    spread = (
        before.velocity_covariance[:3, :3] / lengths[0] ** 2
        + after.linear_velocity1_covariance / lengths[1] ** 2
    )
    return float(apart @ np.linalg.solve(across.T @ spread @ across, apart))


# 1 sigma [s] below which an estimate is applied. A larger one would apply noise.
# [chosen: 1 to 4 ms: a camera that turns by 1 rad/s moves by 2 mrad in it]
_APPLIED_SIGMA = 2e-3
# Largest change of the applied time offset [s per pair]. A larger one would shift the poses of
# neighbouring pairs against each other. [chosen: an error of 50 ms is gone after 50 pairs]
_OFFSET_STEP = 1e-3
# The same of the readout time [s per pair]. [chosen: its error moves rows by half as much]
_READOUT_STEP = 5e-4


@dataclass(frozen=True, slots=True, eq=False)
class Tracked:
    """Parameters as estimated after the pairs so far."""

    gyro_bias: Array  # (3,) [rad/s], IMU frame; the whole bias, not its deviation
    gyro_bias_sigma: Array
    time_offset: float  # [s] IMU clock minus camera clock, as the parameter of this name
    time_offset_sigma: float
    readout_time: float  # [s] as the parameter; negative where rows are read the other way
    readout_time_sigma: float
    pairs: int

    @classmethod
    def of(cls, estimated: Calibration, configured: Configured) -> Tracked:
        """Configured plus estimated values; the offset is that of the middle row."""
        bias = LIVE.part('gyro_bias')
        offset = LIVE.index('time_offset')
        readout = LIVE.index('readout_time')
        along = np.zeros(LIVE.size)
        along[offset] = 1.0
        along[readout] = posterior.middle_share(configured.camera)
        of_middle = configured.sensor.time_offset + float(along @ estimated.c)
        signed = configured.camera.signed_readout_time  # active
        now = signed - configured.active[readout] + estimated.c[readout]
        return cls(
            configured.gyro_bias + estimated.c[bias],
            estimated.sigma[bias],
            of_middle - along[readout] * float(configured.active[readout]),
            math.sqrt(float(along @ estimated.covariance @ along)),
            float(now) * configured.direction,
            float(estimated.sigma[readout]),
            len(estimated.b),
        )


@dataclass(frozen=True, slots=True)
class Applied:
    """Deviations applied to the next frames, in addition to the parameters."""

    time_offset: float = 0.0  # [s]
    readout_time: float = 0.0  # [s]
    # [s] beyond the configured rows that the IMU must cover, too, for a longer readout time.
    margin: float = 0.0
    # [s] sum of the changes of the time offset that were found, and [s/s] its drift since a stamp.
    stepped: float = 0.0
    drift: float = 0.0
    drift_ns: int = 0
    stepped_variance: float = 0.0  # [s^2] of that sum

    @property
    def offset(self) -> float:
        """All of the time offset beyond the parameter [s]."""
        return self.stepped + self.time_offset

    def after_step(self, seconds: float, variance: float) -> Applied:
        """The corrections after a step of the time offset; both are negative to take one back."""
        return replace(
            self,
            stepped=self.stepped + seconds,
            stepped_variance=max(self.stepped_variance + variance, 0.0),
        )

    def after_change(self, change: Change, stamp_ns: int) -> Applied:
        """The corrections at a stamp after a small step, or with a drift."""
        if change.kind is Kind.STEP:
            return self.after_step(change.now, change.sigma**2)
        since = seconds_between(change.between_ns[1], stamp_ns)
        stepped = self.stepped + change.now + change.value * since
        return replace(self, stepped=stepped, drift=self.drift + change.value, drift_ns=stamp_ns)

    def at(self, stamp_ns: int) -> Applied:
        """The corrections at a stamp: the drift goes on."""
        if not self.drift:
            return self
        since = seconds_between(self.drift_ns, stamp_ns)
        return replace(self, stepped=self.stepped + self.drift * since, drift_ns=stamp_ns)

    def moved(self, estimated: Tracked, sensor: SensorConfig) -> Applied:
        """One step towards the estimate, or back to zero if the parameter is not tracked."""

        def stepped(
            tracked: bool, sigma: float, value: float, target: float, largest: float, step: float
        ) -> float:
            target = (target if sigma < _APPLIED_SIGMA else value) if tracked else 0.0
            return value + min(max(min(max(target, -largest), largest) - value, -step), step)

        offset = stepped(
            sensor.track_time_offset,
            estimated.time_offset_sigma,
            self.time_offset,
            estimated.time_offset - sensor.time_offset,
            findings.LARGEST_OFFSET,
            _OFFSET_STEP,
        )
        readout = min(
            self.margin,
            stepped(  # at most the rows that the frames so far cover
                sensor.track_readout_time,
                estimated.readout_time_sigma,
                self.readout_time,
                max(estimated.readout_time, 0.0) - (sensor.readout_time or 0.0),
                findings.LARGEST_READOUT,
                _READOUT_STEP,
            ),
        )
        ahead = _READOUT_STEP if sensor.track_readout_time else 0.0
        return replace(
            self,
            time_offset=offset,
            readout_time=readout,
            margin=max(readout + ahead, 0.0),
        )
