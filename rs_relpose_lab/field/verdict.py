"""The verdict on the answers to a rebuilt situation, computed from the truth."""

from __future__ import annotations

from dataclasses import dataclass
import re

import numpy as np
from scipy.stats import chi2

from rs_relpose_lab.field.cases import Case
from rs_relpose_lab.field.evidence import Evidence
from rs_relpose_lab.field.truth import relative_distances
from rs_relpose_ros.calibration.findings import Code
from rs_relpose_ros.geometry import Array

# Share within which a value lies for its covariance to hold. [chosen: three sigmas]
WITHIN = 0.997
# Sigmas of the right answers, as the catalogue of situations states them.
LARGEST_SIGMA = 8.0
LARGEST_CALIBRATION_SIGMA = 4.0
LARGEST_SHARE = 0.02
LARGEST_STATE_SHARE = 0.05
ENOUGH_POSES = 0.8

# States of findings that name a cause.
_FAULTS = ('suspect', 'wrong')

# Causes that a finding names. Properties of a recording name none.
_CAUSES = {code.value for code in Code if not code.is_property} - {Code.UNKNOWN_CAUSE.value}


@dataclass(frozen=True, slots=True)
class Verdict:
    """The verdict on all answers to a case."""

    case: str
    verdict: str  # good, poor or failure
    reason: str
    poses: int
    pairs: int
    beyond: float  # share of the poses outside of 99.7 %
    worst: float  # largest Mahalanobis distance of a pose over that of its degrees of freedom
    calibration: float  # largest error of a determined value [sigmas]; NaN: none determined
    states: int
    states_beyond: float
    named: str
    faults: str  # codes of all findings that are suspect or wrong
    wrong: str  # those of them that are no cause here
    seconds: float


def judge(case: Case, evidence: Evidence, undisturbed: int | None, seconds: float) -> Verdict:
    """The verdict on an answer; `undisturbed`: number of poses without the defect, if known."""
    squares = evidence.poses
    beyond = _share_beyond(squares, [2, 3])
    distances = [relative_distances(squares[:, k], 2 + k) for k in range(2)]
    worst = float(np.max(distances, initial=0.0))
    states_beyond = _share_beyond(evidence.states, [3, 3])
    faults = [one for one in evidence.causes if one.state in _FAULTS]
    words = ' '.join(f'{one.code} {one.text}' for one in faults) + ' ' + evidence.words
    named = re.search(case.named, words, re.IGNORECASE) if case.named else None
    causes = {one.code for one in faults if one.code in _CAUSES}
    wrong = sorted(causes - set(case.codes))
    reasons = []
    if 'Traceback' in words:
        reasons.append('traceback')
    if beyond > LARGEST_SHARE or worst > LARGEST_SIGMA:
        reasons.append(f'poses {100 * beyond:.0f} % beyond, worst {worst:.1f} sigma')
    calibration = evidence.calibration
    largest = max(calibration.values(), default=float('nan'))
    if largest > LARGEST_CALIBRATION_SIGMA:
        name = max(calibration, key=lambda key: calibration[key])
        reasons.append(f'calibrate: {name} {largest:.1f} sigma')
    if states_beyond > LARGEST_STATE_SHARE:
        reasons.append(f'odometry {100 * states_beyond:.0f} % beyond')
    if wrong:
        reasons.append(f'wrong cause: {", ".join(wrong)}')
    failed = bool(reasons)
    if case.named and not named:
        reasons.append('cause not named')
    if case.solvable and undisturbed and len(squares) < ENOUGH_POSES * undisturbed:
        reasons.append(f'{len(squares)} poses of {undisturbed}')
    return Verdict(
        case.name,
        'failure' if failed else 'poor' if reasons else 'good',
        '; '.join(reasons),
        len(squares),
        evidence.pairs,
        beyond,
        worst,
        largest,
        len(evidence.states),
        states_beyond,
        named[0] if named else '',
        ', '.join(sorted({one.code for one in faults})),
        ', '.join(wrong),
        seconds,
    )


def _share_beyond(squares: Array, freedoms: list[int]) -> float:
    """Share of the values (N, 2) of which a part is outside of its quantile; 0 for none."""
    outside = (squares > chi2.ppf(WITHIN, freedoms)).any(axis=1)
    return float(outside.mean()) if len(outside) else 0.0
