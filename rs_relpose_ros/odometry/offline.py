"""Metric odometry of a bag, as of a live node, and its errors against the ground truth."""

from collections.abc import Iterable, Iterator, Mapping, Sequence
from contextlib import suppress
from dataclasses import asdict, dataclass
import math
from pathlib import Path
from typing import Any, NamedTuple

from matplotlib.figure import Figure
import numpy as np

from rs_relpose_ros.bags.reader import Bag, SensorTopics
from rs_relpose_ros.config.settings import Parameters, sensor_model
from rs_relpose_ros.errors import InputError
from rs_relpose_ros.geometry import Array
from rs_relpose_ros.geometry.so3 import aligning_rotation
from rs_relpose_ros.geometry.timing import seconds_between
from rs_relpose_ros.imu.buffer import ImuSample, ImuSamples
from rs_relpose_ros.messages.incoming import PARTS, Role, sensor_messages, stamp_ns
from rs_relpose_ros.odometry.estimator import OdometryEstimator
from rs_relpose_ros.odometry.graph import KeyframeState
from rs_relpose_ros.odometry.loops import close_loops, View
from rs_relpose_ros.odometry.map_points import KeyframeObservations, TRACKS_FILE
from rs_relpose_ros.odometry.pair import KeyframePair
from rs_relpose_ros.odometry.rows import camera_poses, Knot, ROWS_FILE, RowTrajectory, write_tum
from rs_relpose_ros.odometry.states import Base, Odometry, OdometryState
from rs_relpose_ros.offline.replay import read_truth, related, Replay
from rs_relpose_ros.offline.truth import TrueTrajectory
from rs_relpose_ros.output_files import prepare_folder, save_picture, SUMMARY_FILE
from rs_relpose_ros.pipeline.pair import PairResult

_STYLES: Mapping[str, Mapping[str, Any]] = {
    'truth': {'color': 'black', 'lw': 2.5},
    'live': {'color': '#E69F00', 'lw': 1.2},
    'smoothed': {'color': '#0072B2', 'lw': 1.2},
}

LIVE_FILE, SMOOTHED_FILE, PICTURE = 'trajectory.tum', 'trajectory_smoothed.tum', 'path.png'
RATE_FILE = 'trajectory_rows.tum'


@dataclass(frozen=True, slots=True, eq=False)
class OdometryOutcome:
    """Result of a bag; `metrics`: as in summary.json, without provenance."""

    live: list[Odometry]
    smoothed: list[Odometry]
    metrics: dict[str, Any]
    warnings: list[str]
    blocking_reason: str  # why it could not start


def odometry_into(
    folder: Path,
    bag: Bag,
    topics: SensorTopics,
    parameters: Parameters,
    rate: float = 0.0,
    *,
    loops: bool = False,
) -> OdometryOutcome:
    """Run a bag, and write trajectories, tracks and a picture into `folder`.

    Files of an earlier run are replaced. `rate`: of the poses of an additional file [Hz]. `loops`:
    whether the smoothed path has loop closures.
    """
    prepare_folder(
        folder,
        (LIVE_FILE, SMOOTHED_FILE, ROWS_FILE, RATE_FILE, TRACKS_FILE, PICTURE, SUMMARY_FILE),
    )
    estimator = OdometryEstimator(parameters, keep=True)
    replay = Replay(bag, topics, parameters)
    observed: list[KeyframeObservations] = []
    views: dict[int, View] = {}

    def pairs() -> Iterator[tuple[int, KeyframePair]]:
        for pair in replay.pairs():
            observed.append(KeyframeObservations.of_pair(pair))
            given = KeyframePair.of_result(pair)
            views[given.current_ns + given.row_ns] = View(pair.stamp_ns, pair.parallax)
            yield replay.last_ns, given

    samples = _samples(bag, topics)
    live = follow(estimator, pairs(), samples)
    paths, closed, taken = estimator.smoothed_paths(), None, list[KeyframePair]()
    if loops and paths:
        assert replay.intake.intrinsics is not None
        sensor = sensor_model(replay.intake.intrinsics, parameters.sensor)
        paths, closed, taken = close_loops(
            estimator,
            paths,
            views,
            sensor,
            lambda stamps: [
                pair
                for pair in related(bag, topics, parameters, stamps)[0]
                if isinstance(pair, PairResult)
            ],
        )
    smoothed = [keyframe for path in paths for _, keyframe in path]
    warnings = estimator.warnings()
    truth = read_truth(bag, topics)
    # The ground truth is that of the camera.
    base = estimator.base or Base()
    drawn = {
        name: path_of([base.camera(pose) for pose in trajectory], truth)
        for name, trajectory in (('live', live), ('smoothed', smoothed))
    }
    metrics = {
        **_metrics(estimator, live),
        'loops': closed,
        'health': replay.health.state.value,
        **{name: path.errors and path.errors.as_json() for name, path in drawn.items()},
    }
    write_tum(folder / LIVE_FILE, live)
    write_tum(folder / SMOOTHED_FILE, smoothed)
    if paths:
        rows = row_trajectory(
            paths,
            base,
            parameters,
            [sample for _, sample in samples if isinstance(sample, ImuSample)],
            taken,
        )
        rows.save(folder / ROWS_FILE)
        KeyframeObservations.merged(observed).save(folder / TRACKS_FILE)
        if rate:
            write_tum(folder / RATE_FILE, camera_poses(rows, rate))
    draw_paths(drawn, folder / PICTURE)
    return OdometryOutcome(live, smoothed, metrics, warnings, estimator.blocking_reason)


def _metrics(estimator: OdometryEstimator, live: Sequence[Odometry]) -> dict[str, Any]:
    """Counts, intervals, starts and the estimated lever arm, for summary.json."""
    positions = [pose.position for pose in live]
    return {
        'keyframes': len(live),
        'pairs': {
            name: estimator.counts[name]
            for name in (
                'pairs',
                'contradicting',
                'late',
                'without images',
                'calibration contradicted',
            )
        },
        **{
            state.value: [
                {'begin_ns': one.begin_ns, 'end_ns': one.end_ns, 'reason': one.reason}
                for one in estimator.intervals
                if one.state is state
            ]
            for state in (OdometryState.UNCERTAIN, OdometryState.LOST)
        },
        **{
            name: value.tolist()
            for name, value in zip(
                ('imu_position', 'imu_position_sigma'), estimator.imu_position, strict=True
            )
        },
        'starts': [asdict(started) for started in estimator.starts],
        'length_m': float(
            np.linalg.norm(np.diff(np.reshape(positions, (-1, 3)), axis=0), axis=1).sum()
        ),
    }


def row_trajectory(
    paths: Sequence[Sequence[tuple[KeyframeState, Odometry]]],
    base: Base,
    parameters: Parameters,
    samples: Iterable[ImuSample],
    loops: Iterable[KeyframePair] = (),
) -> RowTrajectory:
    """Poses at any time, of `OdometryEstimator.smoothed_paths` and the samples of the IMU.

    `loops`: those that the paths have, of `close_loops`.
    """
    buffer = ImuSamples(parameters.imu.max_imu_gap)
    for sample in samples:
        with suppress(InputError):  # not finite: the replay counts and reports it
            buffer.add(sample)
    C, arm = parameters.sensor.R_cam_imu, paths[-1][-1][0].arm
    base_R = C.T @ base.R.T
    mounts = np.array(
        [
            np.column_stack(mount)
            for mount in (
                (C.T, arm),
                (np.eye(3), np.zeros(3)),
                (base_R, arm - base_R @ base.position),
            )
        ]
    )
    # The cameras' positions are kept: the arm of an earlier path may differ.
    return RowTrajectory.of_paths(
        [
            [
                Knot(
                    keyframe.stamp_ns,
                    keyframe.imu_ns,
                    state.R,
                    base.camera(keyframe).position - state.R @ arm,
                    state.velocity,
                    state.gyro_bias,
                    state.accel_bias,
                    keyframe.pose_covariance,
                )
                for state, keyframe in path
            ]
            for path in paths
        ],
        buffer,
        mounts,
        [(loop.reference_ns, loop.current_ns) for loop in loops],
    )


def follow(
    estimator: OdometryEstimator,
    pairs: Iterable[tuple[int, KeyframePair]],
    samples: Sequence[tuple[int, ImuSample | int]],
) -> list[Odometry]:
    """Keyframes of pairs and samples, both with their times of arrival [ns].

    A number among the samples is the stamp of a frame.
    """
    live, given = [], 0
    for arrives_ns, pair in pairs:
        while given < len(samples) and samples[given][0] <= arrives_ns:
            _add(estimator, samples[given][1])
            given += 1
        estimator.add_pair(pair)
        live += estimator.take()
    for _, sample in samples[given:]:
        if not estimator.waiting:
            break  # the rest of the IMU belongs to no pair
        _add(estimator, sample)
        live += estimator.take()
    return live + estimator.take(end=True)


def _samples(bag: Bag, topics: SensorTopics) -> list[tuple[int, ImuSample | int]]:
    """IMU samples and stamps of the frames of a bag with their bag times, in bag order."""
    out: list[tuple[int, ImuSample | int]] = []
    for role, message in sensor_messages(bag, topics, (Role.IMU, Role.ACCEL, Role.CAMERA_INFO)):
        with suppress(InputError):  # the replay counts and reports it
            out.append(
                (
                    message.bag_time_ns,
                    stamp_ns(message.message.header)
                    if role is Role.CAMERA_INFO
                    else PARTS[role].read(message.message),
                )
            )
    return out


def _add(estimator: OdometryEstimator, sample: ImuSample | int) -> None:
    with suppress(InputError):  # a stuck gyro: the replay counts and reports it
        if isinstance(sample, int):
            estimator.add_frame(sample)
        else:
            estimator.add_imu(sample)


# Path length of relative errors [m].
_SEGMENT = 1.0


@dataclass(frozen=True, slots=True)
class TrajectoryErrors:
    """Errors of positions after the best rigid alignment, without scale."""

    ate_m: float  # root mean square distance
    scale_error: float  # of the best similarity, less 1
    relative_translation_error_percent: float  # median over segments of 1 m
    length_m: float  # of the true path

    def as_json(self) -> dict[str, float | None]:
        """For summary.json, which has no NaN."""
        return {
            name: value if math.isfinite(value) else None for name, value in asdict(self).items()
        }


class ComparedPath(NamedTuple):
    """Positions (N, 3) at times [ns]; with errors, aligned with the true ones that cover them."""

    imu_ns: Sequence[int]
    positions: Array
    truth: Array | None = None
    errors: TrajectoryErrors | None = None


def aligned(positions: Array, truth: Array) -> tuple[Array, Array, float]:
    """R (3, 3), t (3,) of ``truth = R positions + t``, and the best scale of the positions.

    S. Umeyama, *Least-squares estimation of transformation parameters between two point
    patterns*, PAMI 13(4), 1991.
    """
    mean, true_mean = positions.mean(axis=0), truth.mean(axis=0)
    a, b = positions - mean, truth - true_mean
    correlation = b.T @ a
    R = aligning_rotation(correlation)
    return R, true_mean - R @ mean, float((R * correlation).sum() / (a**2).sum())


def path_of(trajectory: Sequence[Odometry], truth: TrueTrajectory | None) -> ComparedPath:
    """Positions of a trajectory; compared with the ground truth if it covers 4 poses or more."""
    covered = [pose for pose in trajectory if truth is not None and truth.covers(pose.imu_ns)]
    if truth is None or len(covered) < 4:
        return ComparedPath(
            [pose.imu_ns for pose in trajectory],
            np.array([pose.position for pose in trajectory]).reshape(-1, 3),
        )
    positions = np.array([pose.position for pose in covered])
    true = np.array([truth.position(pose.imu_ns) for pose in covered])
    R, t, scale = aligned(positions, true)
    moved = positions @ R.T + t
    way = np.concatenate([[0.0], np.cumsum(np.linalg.norm(np.diff(true, axis=0), axis=1))])
    relative = []
    for i, pose in enumerate(covered):
        j = int(np.searchsorted(way, way[i] + _SEGMENT))
        if j == len(covered):
            break
        known = truth.relative_pose(pose.imu_ns, covered[j].imu_ns)
        if known is not None and covered[j].path == pose.path:
            step = pose.R.T @ (covered[j].position - pose.position)
            relative.append(float(np.linalg.norm(step - known[1])) / float(way[j] - way[i]))
    return ComparedPath(
        [pose.imu_ns for pose in covered],
        moved,
        true,
        TrajectoryErrors(
            float(np.sqrt(((moved - true) ** 2).sum(axis=1).mean())),
            scale - 1.0,
            100.0 * float(np.median(relative)) if relative else math.nan,
            float(way[-1]),
        ),
    )


def draw_paths(drawn: Mapping[str, ComparedPath], path: Path) -> Figure:
    """Paths by name, from above and their heights, with the ground truth if known."""
    picture = Figure(figsize=(11.0, 5.5), dpi=110, layout='constrained')
    above, height = picture.subplots(1, 2)
    # Live paths begin later: the ground truth of the longer path.
    lines = [
        ('truth', line.imu_ns, line.truth)
        for line in sorted(drawn.values(), key=lambda line: -len(line.imu_ns))
        if line.truth is not None
    ][:1]
    lines += [
        (name, line.imu_ns, line.positions) for name, line in drawn.items() if len(line.imu_ns)
    ]
    first_ns = min((imu_ns[0] for _, imu_ns, _ in lines), default=0)
    for name, imu_ns, positions in lines:
        seconds = [seconds_between(first_ns, at_ns) for at_ns in imu_ns]
        above.plot(positions[:, 0], positions[:, 1], label=name, **_STYLES[name])
        height.plot(seconds, positions[:, 2], label=name, **_STYLES[name])
    above.set_aspect('equal', 'datalim')
    above.set(title='path from above', xlabel='x [m]', ylabel='y [m]')
    height.set(title='height', xlabel='time [s]', ylabel='z [m]')
    for axes in (above, height):
        if lines:
            axes.legend()
        axes.grid(alpha=0.3)
    save_picture(picture, path)
    return picture
