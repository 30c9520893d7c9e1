"""Live cases: whether a fault was named, or was harmless, and errors of the poses meanwhile."""

from collections.abc import Sequence
from dataclasses import dataclass
import math
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
from scipy.spatial.transform import Rotation
from scipy.stats import chi2

from rs_relpose_lab.experiments.consistency import QUANTILE, STILL
from rs_relpose_lab.experiments.harness import markdown_table, write_table
from rs_relpose_lab.experiments.scoring import chi_squares
from rs_relpose_ros.bags import reader
from rs_relpose_ros.messages.incoming import stamp_ns, time_ns
from rs_relpose_ros.offline.replay import read_truth

if TYPE_CHECKING:  # the report needs no ROS
    from rs_relpose_lab.live.live_cases import Case


@dataclass(frozen=True, slots=True)
class CaseRun:
    """Outcome of a case: first seconds of the words (NaN: never), poses, those beyond 99.7 %."""

    name: str
    words: str
    named: float
    poses: int
    beyond: int
    last: str  # the node's last message

    @property
    def good(self) -> bool:
        """Named, or harmless."""
        if self.words:
            return not math.isnan(self.named)
        return self.poses >= 10 and self.beyond <= 1 + 0.02 * self.poses


def run_case(case: 'Case', folder: Path) -> CaseRun:
    """Play a case and compare its poses with the truth; the bag is rendered into `folder`."""
    from rs_relpose_lab.live.live_cases import play
    from rs_relpose_lab.live.live_run import pose_of

    bag, named, poses, references, last = play(case, folder)
    with reader.open_bag(bag) as opened:
        truth = read_truth(opened, opened.find_topics({}))
    assert truth is not None
    by_stamp = {stamp_ns(item.header): time_ns(item.time_ref) for item in references}
    known = {stamp_ns(item.header): item for item in poses}
    beyond = 0
    limits = chi2([2, 3]).ppf(QUANTILE)
    for stamp in by_stamp.keys() & known.keys():
        pair = truth.relative_pose(
            *(at - case.jump_ns * (not truth.covers(at)) for at in (by_stamp[stamp], stamp))
        )
        t, quat = pose_of(known[stamp])
        if pair is not None and np.linalg.norm(pair[1]) > STILL:
            beyond += bool(
                (
                    np.array(
                        chi_squares(
                            Rotation.from_quat(quat).as_matrix(),
                            np.array(t),
                            *pair,
                            np.reshape(known[stamp].pose.covariance, (6, 6)),
                        )
                    )
                    > limits
                ).any()
            )
    return CaseRun(case.name, case.words, named, len(known), beyond, last)


def write_report(folder: Path, runs: Sequence[CaseRun]) -> str:
    """Write the runs (CSV) and the table (Markdown), and return the latter."""
    rows = [
        [
            run.name,
            'yes' if run.good else 'NO',
            f'{run.named:.1f}' if run.words else 'harmless',
            f'{run.poses} ({run.beyond})',
            run.last[:90],
        ]
        for run in runs
    ]
    rows.append([f'{sum(run.good for run in runs)} of {len(runs)}', *4 * ['']])
    return write_table(
        folder,
        'live_cases',
        runs,
        markdown_table(
            ['case', 'good', 'named after [s]', 'poses (beyond 99.7 %)', 'last message'], rows
        ),
    )
