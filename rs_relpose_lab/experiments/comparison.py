"""Errors of a live run, its replay and other methods over the same pairs."""

from collections.abc import Mapping, Sequence
import csv
from dataclasses import dataclass
import math
from pathlib import Path

import numpy as np
from scipy.spatial.transform import Rotation

from rs_relpose_lab.experiments import methods
from rs_relpose_ros.bags.reader import Bag, open_bag
from rs_relpose_ros.bags.sensor_topics import SensorTopics
from rs_relpose_ros.config.files import read_parameters
from rs_relpose_ros.config.settings import Parameters
from rs_relpose_ros.errors import MissingInputError
from rs_relpose_ros.estimator.result import Status
from rs_relpose_ros.geometry.camera import Intrinsics
from rs_relpose_ros.offline.replay import read_stamps, read_truth, Replay, replay_into
from rs_relpose_ros.offline.tables import PairRecord, POSES
from rs_relpose_ros.offline.truth import median_and_p90, PairErrors, TrueTrajectory
from rs_relpose_ros.pipeline.pair import PairResult

# The algorithms of the paper, by solver: its refinement, and the gyro only derotates rows.
PAPER_ALGORITHMS: Mapping[str, Mapping[str, str | bool]] = {
    name: {'solver': solver, 'refinement': 'alternating', 'use_gyro_rotation': False}
    for name, solver in (
        ('uniform 9-point', 'uniform_9pt'),
        ('uniform 11-point', 'uniform_11pt'),
        ('5-point on derotated rays', 'angular_5pt'),
    )
}


@dataclass(frozen=True, slots=True)
class Score:
    """Errors of a method over pairs: median and 90th percentile of those answered [deg]."""

    name: str
    pairs: int
    answered: int
    rotation: tuple[float, float]
    translation: tuple[float, float]
    errors: tuple[PairErrors | None, ...] = ()  # of each pair; None without a pose


def score(name: str, errors: Sequence[PairErrors | None], pairs: int | None = None) -> Score:
    """Score from errors, None for a pair without a pose; `pairs`: where not all are among them."""
    known = [error for error in errors if error is not None]
    return Score(
        name,
        len(errors) if pairs is None else pairs,
        len(known),
        median_and_p90([e.rotation_error for e in known]),
        median_and_p90([e.translation_error for e in known]),
        tuple(errors),
    )


def score_of_records(name: str, records: Sequence[PairRecord]) -> Score:
    """Score of a replay."""
    return score(name, [r.errors if r.pose.status is Status.OK else None for r in records])


def is_still(record: PairRecord) -> bool:
    """Whether, by the truth, the camera hardly moved from one keyframe to the other."""
    return record.errors is not None and record.errors.baseline < 0.03


@dataclass(frozen=True, slots=True, eq=False)
class LiveComparison:
    """Publications of a live node, and the replay of the frames that it processed."""

    node: Score
    records: list[PairRecord]  # of the replay
    pairs: list[PairResult]  # of the replay
    truth: TrueTrajectory
    intrinsics: Intrinsics
    frames: int  # in the bag
    processed: int  # by the node
    poses: int  # of both
    unequal: int  # those that are not bit by bit the same in the two

    def opencv_scores(self) -> list[Score]:
        """Scores of OpenCV's estimators on the matches of the replay's poses."""
        answered = [pair for pair in self.pairs if pair.pose]
        return [
            best_opencv_score(estimator, answered, self.intrinsics, self.truth)
            for estimator in methods.OPENCV_ESTIMATORS
        ]


def compare_live(
    table: Path,
    stamps_file: Path,
    bag_path: Path,
    parameter_file: Path,
    folder: Path,
    *,
    pictures: bool = False,
) -> LiveComparison:
    """Replay into `folder` the frames that a live node processed.

    `table`: poses that the node published; `stamps_file`: of the frames that it processed.
    `bag_path`, `parameter_file`: input of that run; `pictures`: whether to draw the replay's.
    """
    stamps = read_stamps(stamps_file)
    pairs: list[PairResult] = []
    with open_bag(bag_path) as bag:
        topics, truth = _topics_and_truth(bag)
        outcome = replay_into(
            folder,
            bag,
            topics,
            read_parameters(parameter_file),
            stamps=stamps,
            pictures=pictures,
            on_pair=pairs.append,
        )
    unequal, poses = differing_poses(table, folder / POSES.file)
    assert outcome.intrinsics is not None
    return LiveComparison(
        score_of_table('relpose_node, live', table, outcome.records, truth),
        outcome.records,
        pairs,
        truth,
        outcome.intrinsics,
        topics.image.count,
        len(stamps),
        poses,
        unequal,
    )


def _topics_and_truth(bag: Bag) -> tuple[SensorTopics, TrueTrajectory]:
    topics = bag.find_topics()
    truth = read_truth(bag, topics)
    if truth is None:
        raise MissingInputError(f'{bag.path} has no ground truth')
    return topics, truth


def score_of_replay(name: str, bag_path: Path, parameters: Parameters) -> Score:
    """Score of a bag's replay with other parameters, nothing written."""
    with open_bag(bag_path) as bag:
        topics, truth = _topics_and_truth(bag)
        return score_of_records(
            name, [PairRecord.of(pair, truth) for pair in Replay(bag, topics, parameters).pairs()]
        )


def score_of_table(
    name: str, path: Path, pairs: Sequence[PairRecord], truth: TrueTrajectory
) -> Score:
    """Score of a live node's table; `pairs`: of a replay of its frames."""
    times = {(r.reference_stamp_ns, r.stamp_ns): (r.reference_ns1, r.reference_ns2) for r in pairs}
    errors = []
    with path.open(newline='', encoding='ascii') as file:
        for row in csv.DictReader(file):
            key = int(row['reference_stamp_ns'] or 0), int(row['stamp_ns'])
            if key in times:
                R = Rotation.from_quat([float(row[c]) for c in ('qx', 'qy', 'qz', 'qw')])
                t = np.array([float(row[c]) for c in ('tx', 'ty', 'tz')])
                errors.append(truth.errors(R.as_matrix(), t, *times[key]))
    return score(name, errors, len(pairs))


def differing_poses(live: Path, replayed: Path) -> tuple[int, int]:
    """Number of live poses that are not in a replay's table bit by bit, and of those compared.

    A pose that only one of the two has counts as different.
    """
    live_poses = _written_poses(live)
    replayed_poses = _written_poses(replayed)
    keys = live_poses.keys() | replayed_poses.keys()
    return sum(live_poses.get(key) != replayed_poses.get(key) for key in keys), len(keys)


# Columns of the table of poses that are compared: the pose, its sigmas, and the inliers.
_COMPARED = POSES.columns[2 : POSES.columns.index('matches')]


def _written_poses(table: Path) -> dict[tuple[str, str], list[str]]:
    """What a table of poses has of each pair with a pose, by both of its stamps."""
    poses = {}
    with table.open(newline='', encoding='ascii') as file:
        for row in csv.DictReader(file):
            if row['status'] == Status.OK.value:
                stamps = row['reference_stamp_ns'], row['stamp_ns']
                poses[stamps] = [row[column] for column in _COMPARED]
    return poses


def best_opencv_score(
    estimator: str, pairs: Sequence[PairResult], intrinsics: Intrinsics, truth: TrueTrajectory
) -> Score:
    """Score of an OpenCV estimator at the best of three thresholds.

    Best in the median rotation error against the truth, which favours the baseline. `pairs`: those
    with a pose of the pipeline, none of a camera at rest.
    """
    scores = []
    for threshold in (0.5, 1.0, 2.0):
        poses = [opencv_pose(pair, intrinsics, threshold, estimator) for pair in pairs]
        errors = [
            truth.errors(pose.R, pose.t, pair.reference_ns1, pair.reference_ns2) if pose else None
            for pair, pose in zip(pairs, poses, strict=True)
        ]
        scores.append(score(f'OpenCV 5-point, {estimator}, {threshold:g} px', errors))
    return min(scores, key=lambda s: np.nan_to_num(s.rotation[0], nan=np.inf))


def opencv_pose(
    pair: PairResult, intrinsics: Intrinsics, threshold: float, estimator: str = 'USAC_MAGSAC'
) -> methods.Pose | None:
    """Pose by an OpenCV estimator from the matches of a pair, as of a global shutter."""
    camera = intrinsics.global_shutter_camera()
    pixels1, pixels2 = (
        methods.undistorted(intrinsics.to_sensor(points), camera)
        for points in (pair.matches.points1, pair.matches.points2)
    )
    return methods.opencv_five_point(pixels1, pixels2, camera, threshold, estimator=estimator)


def score_table(scores: Sequence[Score]) -> list[str]:
    """Lines of a table of scores, two of them its head."""
    width = max(len(s.name) for s in scores)
    lines = [
        f'{"":{width}}                    rotation error     translation error',
        f'{"":{width}}                         [deg]         (direction) [deg]',
        f'{"":{width}}  pairs  poses    median     90 %    median     90 %',
    ]
    lines.append('-' * len(lines[-1]))
    for s in scores:
        errors = '  '.join(
            f'{_cell(median)} {_cell(p90)}' for median, p90 in (s.rotation, s.translation)
        )
        lines.append(f'{s.name:{width}}  {s.pairs:5d}  {s.answered:5d}  {errors}')
    return lines


def _cell(value: float) -> str:
    if not math.isfinite(value):
        return f'{"-":>8}'
    return f'{value:8.3f}' if value < 10.0 else f'{value:8.1f}'
