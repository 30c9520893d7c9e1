"""Methods side by side: their errors over the same pairs, as a table to read."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
import csv
from dataclasses import dataclass
import math
from pathlib import Path

import numpy as np
from scipy.spatial.transform import Rotation

from rs_relpose_ros.bags.reader import Bag, SensorTopics
from rs_relpose_ros.config.parameters import Parameters
from rs_relpose_ros.estimator.result import Status
from rs_relpose_ros.replay.record import pair_record, PairRecord
from rs_relpose_ros.replay.run import Replay
from rs_relpose_ros.replay.truth import median_and_p90, PairErrors, TrueTrajectory

# The algorithms of the paper with its refinement, and what they leave out of the default: the gyro
# derotates rows, and is no prior of the rotation between the frames.
_PAPER: Mapping[str, str | bool] = {'refinement': 'alternating', 'use_gyro_rotation': False}
PAPER_METHODS: Mapping[str, Mapping[str, str | bool]] = {
    'uniform 9-point': {'solver': 'uniform_9pt', **_PAPER},
    'uniform 11-point': {'solver': 'uniform_11pt', **_PAPER},
    '5-point on derotated rays': {'solver': 'angular_5pt', **_PAPER},
}


# Below this baseline [m] between two keyframes the camera stands or only turns.
STILL_BASELINE = 0.03


@dataclass(frozen=True, slots=True)
class Score:
    """Errors of a method over pairs, in degrees.

    Attributes
    ----------
    name : str
    pairs, answered : int
    rotation, translation : (float, float)
        Median and 90th percentile over the answered pairs; NaN without any.
    """

    name: str
    pairs: int
    answered: int
    rotation: tuple[float, float]
    translation: tuple[float, float]


def is_still(record: PairRecord) -> bool:
    """Whether, by the truth, the camera hardly moved from one keyframe to the other."""
    return record.errors is not None and record.errors.baseline < STILL_BASELINE


def score(name: str, pairs: int, errors: Sequence[PairErrors | None]) -> Score:
    """Score from the errors of the pairs, None for a pair without a pose."""
    known = [error for error in errors if error is not None]
    return Score(name, pairs, len(known), median_and_p90([e.rotation_error for e in known]),
                 median_and_p90([e.translation_error for e in known]))


def score_of_records(name: str, records: Sequence[PairRecord]) -> Score:
    """Score of a replay."""
    return score(name, len(records),
                 [r.errors if r.status is Status.OK else None for r in records])


def score_of_table(name: str, path: Path, pairs: Sequence[PairRecord],
                   truth: TrueTrajectory) -> Score:
    """Score of a table of relative poses, which a live node's recorder wrote.

    Parameters
    ----------
    name : str
    path : Path
    pairs : sequence of PairRecord
        Of a replay of the same frames: they tell how many pairs there were, and their instants.
    truth : TrueTrajectory
    """
    instants = {(r.reference_stamp_ns, r.stamp_ns): (r.reference_ns1, r.reference_ns2)
                for r in pairs}
    errors = []
    with path.open(newline='', encoding='ascii') as file:
        for row in csv.DictReader(file):
            key = int(row['reference_stamp_ns'] or 0), int(row['stamp_ns'])
            if key in instants:
                R = Rotation.from_quat([float(row[c]) for c in ('qx', 'qy', 'qz', 'qw')])
                t = np.array([float(row[c]) for c in ('tx', 'ty', 'tz')])
                errors.append(truth.errors(R.as_matrix(), t, *instants[key]))
    return score(name, len(pairs), errors)


def differing_poses(live: Path, replayed: Path) -> tuple[int, int]:
    """Number of live poses that are not in a replay's table bit by bit, and of those compared.

    A pose that only one of the two has counts as different.
    """
    tables = []
    for path in (live, replayed):
        with path.open(newline='', encoding='ascii') as file:
            tables.append({(row['reference_stamp_ns'], row['stamp_ns']):
                           [row[c] for c in ('tx', 'ty', 'tz', 'qx', 'qy', 'qz', 'qw', 'sigma_t1',
                                             'sigma_t2', 'sigma_rx', 'sigma_ry', 'sigma_rz',
                                             'inliers')]
                           for row in csv.DictReader(file) if row['status'] == Status.OK.value})
    keys = tables[0].keys() | tables[1].keys()
    return sum(tables[0].get(key) != tables[1].get(key) for key in keys), len(keys)


def replay_records(bag: Bag, topics: SensorTopics, parameters: Parameters,
                   truth: TrueTrajectory) -> list[PairRecord]:
    """Records of a replay, nothing written."""
    return [pair_record(pair.result, truth)
            for pair in Replay(bag, topics, parameters).pairs()]


def score_table(scores: Sequence[Score]) -> list[str]:
    """Lines of a table of scores, two of them its head."""
    width = max(len(s.name) for s in scores)
    lines = [f'{"":{width}}                    rotation error     translation error',
             f'{"":{width}}                         [deg]         (direction) [deg]',
             f'{"":{width}}  pairs  poses    median     90 %    median     90 %']
    lines.append('-' * len(lines[-1]))
    for s in scores:
        figures = '  '.join(f'{_cell(median)} {_cell(p90)}'
                            for median, p90 in (s.rotation, s.translation))
        lines.append(f'{s.name:{width}}  {s.pairs:5d}  {s.answered:5d}  {figures}')
    return lines


def _cell(value: float) -> str:
    if not math.isfinite(value):
        return f'{"-":>8}'
    return f'{value:8.3f}' if value < 10.0 else f'{value:8.1f}'
