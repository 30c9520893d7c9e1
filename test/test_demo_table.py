"""The demo's comparison: conventions of the baselines, scores, and the table."""

from __future__ import annotations

from pathlib import Path
import re
import subprocess
import sys

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from rs_relpose_lab.experiments.comparison import (
    best_opencv_score,
    differing_poses,
    Score,
    score,
    score_of_records,
    score_of_table,
    score_table,
)
from rs_relpose_lab.experiments.methods import OPENCV_ESTIMATORS, opencv_five_point, undistorted
from rs_relpose_ros.estimator.result import RelativePose, Status
from rs_relpose_ros.front_end.pair import PairResult
from rs_relpose_ros.geometry.camera import RollingShutterCamera
from rs_relpose_ros.geometry.intrinsics import Intrinsics
from rs_relpose_ros.replay import pictures
from rs_relpose_ros.replay.run import ReplayedPair
from rs_relpose_ros.replay.tables import (
    pair_record,
    relative_pose_cells,
    RELATIVE_POSE_COLUMNS,
    table_writer,
)
from rs_relpose_ros.replay.truth import PairErrors, TrueTrajectory
from rs_relpose_ros.tracking.matches import Matches

ROOT = Path(__file__).resolve().parent.parent
START_NS = 1_700_000_000_000_000_000
SIZE = {'width': 640, 'height': 480}
INTRINSICS = {'fx': 450.0, 'fy': 452.0, 'cx': 322.0, 'cy': 238.0,
              'distortion': (-0.12, 0.05, 0.0008, -0.0005, 0.0)}
CAMERA = RollingShutterCamera(**SIZE, **INTRINSICS, readout_time=0.0)
CALIBRATION = Intrinsics(**SIZE, **INTRINSICS, image_width=640, image_height=480)
# Camera 2 is half a metre to the right of camera 1, a little ahead, and turned.
R_TRUE = Rotation.from_rotvec([0.02, -0.08, 0.03]).as_matrix()
T_TRUE = np.array([0.5, 0.05, 0.1])


def view(noise: float, outliers: int, seed: int = 0) -> tuple[np.ndarray, np.ndarray]:
    """Pixels of 300 points in both cameras; ``X1 = R X2 + t``, so ``X2 = R^T (X1 - t)``."""
    rng = np.random.default_rng(seed)
    X1 = rng.uniform([-3.0, -2.0, 4.0], [3.0, 2.0, 12.0], (300, 3))
    points1 = CAMERA.project(X1) + noise * rng.standard_normal((300, 2))
    points2 = CAMERA.project((X1 - T_TRUE) @ R_TRUE) + noise * rng.standard_normal((300, 2))
    points2[:outliers] = rng.uniform([0.0, 0.0], [640.0, 480.0], (outliers, 2))
    return points1, points2


def degrees_between(a: np.ndarray, b: np.ndarray) -> float:
    return float(np.degrees(np.arccos(np.clip(a @ b / np.linalg.norm(a) / np.linalg.norm(b),
                                              -1.0, 1.0))))


def by_opencv(points1, points2, estimator, threshold=1.0):
    return opencv_five_point(undistorted(points1, CAMERA), undistorted(points2, CAMERA), CAMERA,
                             threshold, estimator=estimator)


@pytest.mark.parametrize('estimator', OPENCV_ESTIMATORS)
def test_opencv_pose_in_our_convention(estimator):
    pose = by_opencv(*view(noise=0.05, outliers=60), estimator)
    assert pose is not None
    # OpenCV's RANSAC refines nothing; the inverse would be off by 10 deg.
    assert np.degrees(Rotation.from_matrix(pose.R.T @ R_TRUE).magnitude()) < 0.5
    assert degrees_between(pose.t, T_TRUE) < 3.0   # and not the opposite, or that of camera 2


@pytest.mark.parametrize('estimator', OPENCV_ESTIMATORS)
def test_opencv_without_enough_matches_has_no_pose(estimator):
    points1, points2 = view(noise=0.0, outliers=0)
    assert by_opencv(points1[:4], points2[:4], estimator) is None


def pair_of(noise: float, outliers: int, seed: int = 0) -> ReplayedPair:
    points1, points2 = view(noise, outliers, seed)
    count = len(points1)
    pose = RelativePose(Status.OK, R=R_TRUE, t=T_TRUE / np.linalg.norm(T_TRUE),
                        inliers=np.ones(count, dtype=bool), covariance=1e-6 * np.eye(6),
                        model='uniform')
    result = PairResult(
        START_NS, START_NS + 10**9, START_NS, START_NS + 10**9, 'camera', 1.0, pose,
        Matches(np.arange(count, dtype=np.uint32), points1, points2, np.ones(count)),
        np.zeros(count), np.zeros(count), np.zeros((count, 3)), np.zeros((count, 3)), 20.0)
    return ReplayedPair(result, 0)


@pytest.fixture
def truth() -> TrueTrajectory:
    """A steady motion by the true relative pose within the first second."""
    seconds = np.arange(21) / 20.0
    turn = Rotation.from_matrix(R_TRUE).as_rotvec()
    return TrueTrajectory(START_NS + (seconds * 1e9).astype(np.int64), np.outer(seconds, T_TRUE),
                          Rotation.from_rotvec(np.outer(seconds, turn)).as_quat())


def test_best_threshold_is_the_best(truth):
    pairs = [pair_of(0.5, 90, seed) for seed in range(3)]
    best = best_opencv_score('RANSAC', pairs, CALIBRATION, truth)
    assert (best.pairs, best.answered) == (3, 3)
    medians = {}
    for threshold in (0.5, 1.0, 2.0):
        errors = []
        for pair in pairs:
            pose = by_opencv(pair.result.matches.points1, pair.result.matches.points2, 'RANSAC',
                             threshold)
            errors.append(np.degrees(Rotation.from_matrix(pose.R.T @ R_TRUE).magnitude()))
        medians[threshold] = np.median(errors)
    threshold = min(medians, key=medians.__getitem__)
    assert best.name.endswith(f'{threshold:g} px')
    assert best.rotation[0] == pytest.approx(medians[threshold], abs=1e-6)


def test_errors_are_drawn_beside_those_of_the_baselines(truth, tmp_path, monkeypatch):
    figures = []
    monkeypatch.setattr(pictures, 'save_picture', lambda figure, path: figures.append(figure))
    pairs = [pair_of(0.5, 90, seed) for seed in range(3)]
    opencv = best_opencv_score('RANSAC', pairs, CALIBRATION, truth)
    assert len(opencv.errors) == len(pairs)
    pictures.draw_errors([pair_record(pair.result, truth) for pair in pairs],
                         tmp_path / 'errors.png',
                         dict.fromkeys((opencv.name, 'second', 'third'), opencv.errors))
    [figure] = figures
    figure.canvas.draw()
    for axis, median in zip(figure.axes, (opencv.rotation[0], opencv.translation[0]),
                            strict=True):
        legend = [text.get_text() for text in axis.get_legend().get_texts()]
        assert {f'{name}:\nmedian {median:.2g} deg'
                for name in (opencv.name, 'second', 'third')} <= set(legend)
        ticks = [tick.get_text() for tick in axis.get_yticklabels()]
        assert any(ticks) and all(float(tick) > 0.0 for tick in ticks if tick)


def test_scores_of_a_table_and_of_its_records_agree(truth, tmp_path):
    records = [pair_record(pair_of(0.1, 10).result, truth)]
    with table_writer(tmp_path / 'a.csv', RELATIVE_POSE_COLUMNS) as write:
        write(relative_pose_cells(records[0]))
    told = score_of_table('live', tmp_path / 'a.csv', records, truth)
    assert (told.pairs, told.answered) == (1, 1)
    assert told.rotation == pytest.approx(score_of_records('', records).rotation, abs=1e-5)
    assert told.rotation[0] < 1e-4 and told.translation[0] < 1e-4   # the poses are the truth


def test_differing_poses_are_found(tmp_path):
    def write(name: str, *rows: str) -> Path:
        path = tmp_path / name
        path.write_text('\n'.join([','.join(RELATIVE_POSE_COLUMNS), *rows]) + '\n')
        return path

    row = '1,2,0.6,0.8,0,0,0,0,1,0.1,0.1,0.1,0.1,0.1,50,{},{},OK'
    live = write('live.csv', row.format('', ''), row.format('', '').replace('1,2,', '2,3,'))
    same = write('same.csv', row.format(60, 'uniform'),
                 row.format(60, 'uniform').replace('1,2,', '2,3,'),
                 '3,4' + ',' * 14 + '9,,BAD_INPUT')
    assert differing_poses(live, same) == (0, 2)
    off = row.format(60, 'uniform').replace('0.6,', '0.6000000000000001,')
    one_digit = write('digit.csv', off, row.format(60, 'uniform').replace('1,2,', '2,3,'))
    assert differing_poses(live, one_digit) == (1, 2)
    assert differing_poses(live, write('short.csv', row.format('', ''))) == (1, 2)


def test_table_shows_what_is_known_and_no_more():
    lines = score_table([
        Score('node', 30, 27, (0.0123, 0.0456), (0.789, 12.34)),
        score('a method without a pose', [None, None], pairs=30),
        score('one', [PairErrors(1.0, 2.0, 0.25, 4.0), None])])
    node, none, one = (line.split() for line in lines[-3:])
    assert node[1:] == ['30', '27', '0.012', '0.046', '0.789', '12.3']
    assert none[-6:] == ['30', '0', '-', '-', '-', '-']
    assert one[1:] == ['2', '1', '0.250', '0.250', '4.000', '4.000']
    assert len({len(line) for line in lines[2:]}) == 1, 'columns are aligned'


@pytest.mark.long
@pytest.mark.timeout(300)
def test_demo():
    """The demo itself: three processes over DDS, replays, and the table."""
    done = subprocess.run([sys.executable, ROOT / 'demo' / 'run_demo.py'], capture_output=True,
                          text=True, timeout=290)
    assert done.returncode == 0, done.stderr
    rows = {name: re.search(rf'^{name}\s+(\d+)\s+(\d+)\s+(\S+)\s+\S+\s+(\S+)', done.stdout, re.M)
            for name in ('relpose_node, live', 'uniform 9-point', 'uniform 11-point',
                         '5-point on derotated rays', r'OpenCV 5-point, RANSAC, \S+ px',
                         r'OpenCV 5-point, USAC_MAGSAC, \S+ px')}
    assert all(rows.values()), done.stdout
    pairs, poses, rotation, translation = rows['relpose_node, live'].groups()
    assert int(pairs) >= 25 and int(poses) >= 20
    assert float(rotation) <= 0.15 and float(translation) <= 3.0
    for name in list(rows)[-2:]:
        assert float(rows[name][3]) >= 3.0 * float(rotation)
    assert 'bit-equal' in done.stdout
    for picture in re.findall(r'\S+\.png', done.stdout):
        assert (ROOT / picture).is_file()
