"""Whether metric baselines of successive pairs agree with the scale that their tracks carry on.

A recording without truth has one all the same: the current camera of a pair is the reference of
the next, and a point's distances there, each in its own pair's baseline, tell the ratio of the two
baselines without any accelerometer.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass, replace
import math
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from rs_relpose_lab.experiments.consistency import PARALLAXES
from rs_relpose_lab.experiments.tables import grouped, markdown_table, write_csv
from rs_relpose_ros.bags.reader import open_bag
from rs_relpose_ros.config.parameter_file import read_parameters
from rs_relpose_ros.front_end.pair import PairResult
from rs_relpose_ros.replay.run import Replay

Array = NDArray[np.float64]

# Fewest tracks in common that tell a ratio.
_LEAST_TRACKS = 10
# Of a normal distribution: one sigma by the median distance from the median; sigma of a median by
# that of one.
_BY_MEDIAN_DISTANCE, _OF_A_MEDIAN = 1.4826, 1.2533
# A baseline counts as known where 1 sigma of its logarithm is below this.
KNOWN = 0.3
# Sigmas beyond which two baselines disagree.
_LIMIT = 3.0


@dataclass(frozen=True, slots=True)
class BaselineStep:
    """Two successive pairs that are both given a baseline.

    `disagreement`: logarithm of the ratio of the two baselines, by that of their tracks;
    `log_sigma1`, `log_sigma2`: 1 sigma that the pairs claim, `log_sigma_tracks`: by the scatter of
    the `tracks` alone, errors of the two poses apart.
    """

    recording: str
    at: float   # [s] after the recording's first pair
    disagreement: float
    log_sigma1: float
    log_sigma2: float
    log_sigma_tracks: float
    tracks: int

    @property
    def known(self) -> bool:
        """Whether both pairs claim to know their baselines well."""
        return max(self.log_sigma1, self.log_sigma2) < KNOWN

    @property
    def sigmas(self) -> float:
        """The disagreement in sigmas."""
        return self.disagreement / math.sqrt(
            self.log_sigma1**2 + self.log_sigma2**2 + self.log_sigma_tracks**2)


def chain_of(path: Path, parameter_file: Path) -> list[BaselineStep]:
    """Steps between the pairs of a bag's replays, one with short pairs and one with long ones."""
    parameters = read_parameters(parameter_file)
    found: list[BaselineStep] = []
    for parallax in PARALLAXES:
        keyframes = replace(parameters.keyframes, min_keyframe_parallax=parallax)
        with open_bag(path) as bag:
            topics = bag.find_topics(needs_camera_info=not parameters.intrinsics.given)
            replay = Replay(bag, topics, replace(parameters, keyframes=keyframes))
            found += steps(path.name, (pair.result for pair in replay.pairs()))
    return found


def steps(recording: str, pairs: Iterable[PairResult]) -> Iterator[BaselineStep]:
    """Steps between those of the pairs that follow each other and have a baseline."""
    first_ns, before = None, None
    for pair in pairs:
        first_ns = pair.stamp_ns if first_ns is None else first_ns
        if not (pair.pose and math.isfinite(pair.pose.baseline)):
            before = None
            continue
        if before is not None and before.stamp_ns == pair.reference_stamp_ns:
            ratios = _log_ratios(before, pair)
            if len(ratios) >= _LEAST_TRACKS:
                ratio = float(np.median(ratios))
                scatter = _BY_MEDIAN_DISTANCE * float(np.median(np.abs(ratios - ratio)))
                yield BaselineStep(
                    recording, 1e-9 * (pair.stamp_ns - first_ns),
                    math.log(pair.pose.baseline / before.pose.baseline) - ratio,
                    before.pose.baseline_log_sigma, pair.pose.baseline_log_sigma,
                    _OF_A_MEDIAN * scatter / math.sqrt(len(ratios)), len(ratios))
        before = pair


def _log_ratios(before: PairResult, pair: PairResult) -> Array:
    """Logarithm of the second baseline by the first (N,), one for each track in common."""
    assert before.landmarks is not None and pair.landmarks is not None
    _, old, new = np.intersect1d(before.matches.track_ids, pair.matches.track_ids,
                                 assume_unique=True, return_indices=True)
    # X_2 = R^T (X_1 - t): seen from the camera that both pairs have.
    distances1 = np.linalg.norm(before.landmarks.points[old] - before.pose.t, axis=1)
    distances2 = np.linalg.norm(pair.landmarks.points[new], axis=1)
    known = np.isfinite(distances1 + distances2) & (distances1 > 0.0) & (distances2 > 0.0)
    return np.asarray(np.log(distances1[known] / distances2[known]))


def write_report(folder: Path, found: Sequence[BaselineStep]) -> str:
    """Write the steps (CSV) and the report (Markdown), and return the latter."""
    write_csv(folder / 'baseline_chain.csv', found)
    rows = []
    for name, of_recording in grouped(found, lambda step: step.recording).items():
        for label, chosen in (('all', of_recording),
                              (f'both below {KNOWN:g}', [s for s in of_recording if s.known])):
            sigmas = np.array([step.sigmas for step in chosen])
            off = int((np.abs(sigmas) > _LIMIT).sum())
            rows.append((f'{name}, {label}', f'{len(chosen)}', f'{off}',
                         f'{np.median([abs(s.disagreement) for s in chosen]):.2f}'
                         if chosen else '-',
                         f'{np.mean(sigmas**2):.2f}' if chosen else '-'))
    text = markdown_table(
        ('recording, claimed sigma of log baseline', 'steps', f'beyond {_LIMIT:g} sigmas',
         'disagreement, median', 'mean square in sigmas'), rows)
    (folder / 'baseline_chain.md').write_text(text, encoding='utf-8')
    return text
