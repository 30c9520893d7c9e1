"""A fit that follows the changes of the time offset within a recording.

Steps and drifts that the rotations of the images propose are confirmed by the fit, and located
between two images; smaller ones are found by the blocks of time of the fit.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
import math

import numpy as np

from rs_relpose_ros.calibrate.result import Estimate, OffsetChanges, StepOfOffset
from rs_relpose_ros.calibration import fit, model
from rs_relpose_ros.calibration.changes import Kind
from rs_relpose_ros.calibration.observations import frames_of, Observations, PairSelection
from rs_relpose_ros.calibration.offset_course import OffsetCourse, OffsetStep
from rs_relpose_ros.calibration.trends import change_at, Trend, trends
from rs_relpose_ros.core.deviations import OFFLINE
from rs_relpose_ros.geometry import Array

# Chi-square from which a parameter changes within the recording for certain. Less would find a
# change by chance among a hundred borders. [chosen: 6 sigmas]
_CERTAIN = 36.0
# Lead in chi-square of one explanation over another. [derived: 5 in the log-likelihood]
_LEAD = 10.0
# Sigmas of a change of the offset that a fit confirms. [chosen: 4 to 6 would do]
_CONFIRMED = 5.0
# Rounds in which changes are found or refined. [chosen: proposal, location and refinement, and one
# that is withdrawn]
_MOST_ROUNDS = 4
# Parameters that may drift within a recording: the clocks, a zoom, a gyro that warms up, a mount.
_DRIFTING = np.flatnonzero(
    OFFLINE.mask('time_offset', 'readout_time', 'focal_log', 'gyro_bias', 'axes')
).tolist()

# Fit of observations from the unknowns of another fit.
Refit = Callable[[Observations, fit.Fit], tuple[Observations, fit.Fit]]


def followed(
    data: Observations, final: fit.Fit, refitted: Refit, *, at_end: bool = False
) -> tuple[Observations, fit.Fit]:
    """The fit with the changes of the offset that the recording shows, and its observations.

    With `at_end` the offset of the result is that of the last image, otherwise that of the first,
    or of the middle if it drifts.
    """
    is_refined = data.course.is_constant
    for _ in range(_MOST_ROUNDS):
        course = confirmed(data, final)
        if not course.is_constant and not is_refined:
            course = _refined(data, final, course)
            is_refined = True
        if course == data.course:
            break
        if data.course.is_constant:
            is_refined = not course.steps
        if at_end:
            course = course.about(float(data.times[-1]))
        data, final = refitted(data.following(course), final)
    return data, final


def confirmed(data: Observations, final: fit.Fit) -> OffsetCourse:
    """The course of the offset as a fit and its blocks of time show it."""
    course = data.course
    if course.is_constant:
        change = certain_change(final)
        if change is None or change.place != model.OFFSET or data.follows_intervals:
            return course
        if change.kind is Kind.DRIFT:
            middle = float(np.median(data.times))
            return OffsetCourse(drift=change.value, origin=middle)
        step = OffsetStep(change.begin, change.end, change.value)
        return OffsetCourse((step,))
    if data.follows_intervals:
        return course
    size = course.size + float(final.unknowns.parameters[model.SLOPE])
    sigma = math.sqrt(final.covariance[model.SLOPE, model.SLOPE])
    return course if abs(size) > _CONFIRMED * sigma else OffsetCourse()


def certain_change(final: fit.Fit) -> Trend | None:
    """The change of a parameter that explains the blocks of time better than any other one's."""
    found = trends(final, _DRIFTING, (model.OFFSET,))
    if not found or found[0].square < _CERTAIN:
        return None
    best = found[0]
    own = [one for one in found if one.place == best.place]
    others = [one.square for one in found if one.place != best.place]
    if best.square < max(others, default=0.0) + _LEAD:
        return None
    drift = next(one for one in own if one.kind is Kind.DRIFT)
    return drift if drift.square > best.square - _LEAD else best


def change_in_words(final: fit.Fit) -> str:
    """Name a change within the recording that the fit does not follow; '' for none."""
    change = certain_change(final)
    if change is None:
        return ''
    total = change.value * (change.end - change.begin)
    if change.place == model.FOCAL:
        return (
            f'focal_drift: the focal length changes by {100.0 * total:.1f} % over the recording, '
            'as by a zoom or a lens that focuses: switch both off. All values are means'
        )
    name = next(name for name, part in OFFLINE.parts.items() if change.place in _places(part))
    return _OTHER_CHANGES.get(name, '')


def _places(part: slice) -> range:
    return range(part.start, part.stop)


# What a change of a parameter means that has no name of its own.
_OTHER_CHANGES = {
    'time_offset': 'the time offset changes within the recording, neither at one time nor evenly: '
    'its sigma is that of its mean',
    'readout_time': 'the readout time changes over the recording: fix the frame rate and exposure',
    'gyro_bias': 'the bias of the gyro changes over the recording: let it warm up',
    'axes': 'the axes turn over the recording: fix the camera and the IMU to each other',
}


def offset_changes(data: Observations, found: fit.Fit, of_row_0: Estimate) -> OffsetChanges | None:
    """The changes of the offset that a fit contains; `of_row_0` is its offset at the origin."""
    course = data.course
    if course.is_constant:
        return None
    sigma = math.inf
    if not data.follows_intervals:
        sigma = math.sqrt(found.covariance[model.SLOPE, model.SLOPE])
        course = course.changed(float(found.unknowns.parameters[model.SLOPE]))
    if not course.steps:
        drift = Estimate(course.drift, sigma, observable=True)
        return OffsetChanges((), drift, course.origin, (of_row_0.value,))
    steps = []
    for step in course.steps:
        size = Estimate(step.seconds, _sigma_of(step, sigma), observable=True)
        steps.append(StepOfOffset(step.begin, step.end, size))
    borders = [0.0, *(step.end for step in course.steps)]
    offsets = of_row_0.value + course.at(np.array(borders))
    return OffsetChanges(tuple(steps), None, course.origin, tuple(offsets.tolist()))


# Sigma [s] of a step whose size is that of the compared offsets. [derived: steps of 5 ms, evenly
# distributed]
_OF_PROPOSED = 1.5e-3


def _sigma_of(step: OffsetStep, of_fit: float) -> float:
    """1 sigma [s] of a step, by the fit, its blocks of time, or the offsets that were compared."""
    known = [sigma for sigma in (step.sigma, of_fit) if math.isfinite(sigma)]
    return max(known, default=_OF_PROPOSED)


def sigma_over_recording(data: Observations) -> float:
    """1 sigma [s] of the offset at any time of the recording about that at its middle."""
    return abs(data.course.drift) * float(np.ptp(data.times)) / math.sqrt(12.0)


# -- Place and size of the steps ----------------------------------------------------------------

# Pairs by which a step is located. [chosen: those of two intervals, in which the camera turns more
# than the noise]
_LOCATING = PairSelection((0.067,), 80, 20, 2000)
# Time [s] beside the span of a step within which pairs are compared. [chosen: half a second]
_AROUND = 0.5
# Loss of log-likelihood within which the place of a step is not known. Matches of a pair are not
# independent. [chosen: twice that of 3 sigmas]
_NOT_KNOWN = 9.0
# Pairs that a place needs. [chosen: any number above one]
_FEWEST_PAIRS = 4


def _refined(data: Observations, final: fit.Fit, course: OffsetCourse) -> OffsetCourse:
    """The course with steps that are located, and sizes by the fit."""
    slope = float(final.unknowns.parameters[model.SLOPE])
    if not course.steps:
        return course.changed(slope)
    steps = []
    for step in course.steps:
        value, sigma = change_at(final, model.OFFSET, step.middle)
        if sigma < step.sigma:
            steps.append(replace(step, seconds=step.seconds + value, sigma=sigma))
        else:
            steps.append(step)
    moved = replace(course, steps=tuple(steps))
    if not data.follows_intervals:
        moved = moved.changed(slope)
    located = tuple(_located(data, final, moved, step) for step in moved.steps)
    return replace(moved, steps=located)


def _located(
    data: Observations, final: fit.Fit, course: OffsetCourse, step: OffsetStep
) -> OffsetStep:
    """The step between the images where the pairs change from one offset to the other."""
    free_of_steps = data.following(OffsetCourse())
    earliest = step.begin - _AROUND
    latest = step.end + _AROUND
    pairs = [
        pair
        for pair in free_of_steps.pairs(_LOCATING, np.random.default_rng(0))
        if earliest < data.times[pair.first] < latest
    ]
    if len(pairs) < _FEWEST_PAIRS:
        return step

    def losses_at(offset: float) -> Array:
        parameters = final.unknowns.parameters.copy()
        parameters[model.OFFSET] += offset
        problem = free_of_steps.problem(pairs, float(parameters[model.OFFSET]))
        moved = final.unknowns._replace(parameters=parameters)
        unknowns = fit.restarted(problem, moved)
        return fit.evaluate(problem, unknowns).losses

    begins, ends = data.times[frames_of(pairs)]
    at_begin = float(course.at(np.array(earliest)))
    difference = losses_at(at_begin) - losses_at(at_begin + step.seconds)
    at_border = np.cumsum(difference) - difference
    least = at_border.min()
    likely = np.flatnonzero(at_border <= least + _NOT_KNOWN)
    # A pair that contains the step fits at neither offset.
    first = max(int(likely[0]) - 2, 0)
    last = min(int(likely[-1]) + 2, len(pairs) - 1)
    return replace(step, begin=float(begins[first]), end=float(ends[last]))
