"""Metric odometry of a bag, as of a live node, and its errors against the ground truth."""

from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from contextlib import suppress
from dataclasses import asdict, dataclass
import math
from pathlib import Path
from typing import Any, NamedTuple

from matplotlib.figure import Figure
import numpy as np
from scipy.special import gammaincinv

from rs_relpose_ros.bags.reader import Bag
from rs_relpose_ros.bags.sensor_topics import SensorTopics
from rs_relpose_ros.calibration import findings_text
from rs_relpose_ros.calibration.findings import Assessment
from rs_relpose_ros.config.settings import Parameters, sensor_model
from rs_relpose_ros.errors import InputError
from rs_relpose_ros.geometry import Array
from rs_relpose_ros.geometry.so3 import aligning_rotation, exp_so3, heading, log_so3
from rs_relpose_ros.geometry.timing import NANOSECONDS, seconds_between
from rs_relpose_ros.imu.buffer import ImuSample, ImuSamples
from rs_relpose_ros.messages.incoming import PARTS, Role, sensor_messages, stamp_ns
from rs_relpose_ros.messages.outgoing import quat_xyzw
from rs_relpose_ros.messages.published_pair import PublishedPair
from rs_relpose_ros.messages.streams import check_timelines, FaultKind
from rs_relpose_ros.odometry.estimator import OdometryEstimator
from rs_relpose_ros.odometry.graph import KeyframeState
from rs_relpose_ros.odometry.loops import close_loops, Paths, Views
from rs_relpose_ros.odometry.map_points import KeyframeObservations, TRACKS_FILE
from rs_relpose_ros.odometry.pair import row_ns
from rs_relpose_ros.odometry.rows import (
    camera_poses,
    Knot,
    ROWS_FILE,
    RowTrajectory,
    write_tum,
)
from rs_relpose_ros.odometry.states import Base, ContinuousPath, Odometry, OdometryState
from rs_relpose_ros.offline.replay import read_truth, related, Replay
from rs_relpose_ros.offline.truth import TrueTrajectory
from rs_relpose_ros.output_files import prepare_folder, save_picture, SUMMARY_FILE, written
from rs_relpose_ros.pipeline.chosen_pairs import PairStamps
from rs_relpose_ros.pipeline.pair import PairResult

# Colour and width of each path in the picture.
_STYLES: Mapping[str, Mapping[str, Any]] = {
    'truth': {'color': 'black', 'lw': 2.5},
    'live': {'color': '#E69F00', 'lw': 1.2},
    'smoothed': {'color': '#0072B2', 'lw': 1.2},
}

# Place of the two plots in the picture, and the space between them, as shares of its width and
# height: labels of the axes fit into the margins. [chosen: by a look at the picture]
_MARGINS: Mapping[str, float] = {
    'left': 0.07,
    'right': 0.99,
    'bottom': 0.1,
    'top': 0.94,
    'wspace': 0.16,
}
# Path as it was published live. [derived: interface, as the files below]
LIVE_FILE = 'trajectory.tum'
# Path estimated from all data.
SMOOTHED_FILE = 'trajectory_smoothed.tum'
# States as they were published live.
STATES_FILE = 'odometry.csv'
# Poses at the rate that a user chose.
RATE_FILE = 'trajectory_rows.tum'
# Picture of the paths.
PICTURE = 'path.png'
# All files of the command `odometry`.
_FILES = (
    LIVE_FILE,
    SMOOTHED_FILE,
    STATES_FILE,
    ROWS_FILE,
    RATE_FILE,
    TRACKS_FILE,
    PICTURE,
    SUMMARY_FILE,
)
# Columns of STATES_FILE: times, path, pose of the camera, its velocity, covariance of the pose.
_STATE_COLUMNS = (
    *('stamp_ns', 'imu_ns', 'path'),
    *('x', 'y', 'z', 'qx', 'qy', 'qz', 'qw', 'vx', 'vy', 'vz'),
    *(f'c{row}{column}' for row in range(6) for column in range(6)),
)


@dataclass(frozen=True, slots=True, eq=False)
class OdometryOutcome:
    """Result of a bag; `metrics`: as in summary.json, without provenance."""

    live: list[Odometry]
    smoothed: list[Odometry]
    metrics: dict[str, Any]
    warnings: list[str]
    blocking_reason: str  # why it could not start
    unsolved: int  # paths whose graph could not be solved for all keyframes


def odometry_into(
    folder: Path,
    bag: Bag,
    topics: SensorTopics,
    parameters: Parameters,
    rate: float = 0.0,
    *,
    loops: bool = False,
) -> OdometryOutcome:
    """Run a bag, and write trajectories, states, tracks and a picture into `folder`.

    Files of an earlier run are replaced. `rate`: of the poses of an additional file [Hz]. `loops`:
    whether the smoothed path has loop closures.
    """
    _require_accelerometer(bag, topics)
    prepare_folder(folder, _FILES)
    estimator = OdometryEstimator(parameters, keep=True)
    replay = Replay(bag, topics, parameters)
    tracks = _Tracks(replay)
    samples = _samples(bag, topics)
    states = PublishedStates(estimator, parameters.odometry.odometry_rate)
    live = follow(estimator, tracks.pairs(), samples, states.after)
    paths = estimator.smoothed_paths()
    closed, taken = None, list[PublishedPair]()
    if loops and paths:
        paths, closed, taken = _with_loops(estimator, paths, tracks.views, replay, bag, topics)
    smoothed = [keyframe for path in paths for _, keyframe in path]
    truth = read_truth(bag, topics)
    base = estimator.base or Base()  # the ground truth is that of the camera
    published = [base.camera(state) for state in states.published]
    drawn = {
        'live': path_of([base.camera(pose) for pose in live], truth),
        'smoothed': path_of([base.camera(pose) for pose in smoothed], truth),
    }
    metrics = _metrics(estimator, live)
    metrics['loops'] = closed
    metrics['health'] = replay.health.state.value
    for name, path in drawn.items():
        metrics[name] = path.errors and path.errors.as_json()
    if truth is not None and smoothed:
        metrics |= consistency(published, base.camera(smoothed[0]), truth)
    write_states(folder / STATES_FILE, published)
    _write_keyframes(folder / LIVE_FILE, live)
    _write_keyframes(folder / SMOOTHED_FILE, smoothed)
    if paths:
        given = [sample for _, sample in samples if isinstance(sample, ImuSample)]
        rows = row_trajectory(paths, base, parameters, given, taken)
        _write_rows(folder, rows, rate)
        tracks.save(folder / TRACKS_FILE)
    draw_paths(drawn, folder / PICTURE)
    return OdometryOutcome(
        live,
        smoothed,
        metrics,
        [notice.text for notice in estimator.warnings()],
        estimator.blocking_reason,
        estimator.counts['not smoothed'],
    )


class _Tracks:
    """The pairs of a replay as they pass by, with what files and loops need of them."""

    def __init__(self, replay: Replay) -> None:
        self._replay = replay
        self._observed: list[KeyframeObservations] = []
        self.views: dict[int, tuple[int, float]] = {}  # as of `loops.Views`

    def pairs(self) -> Iterator[tuple[int, PublishedPair]]:
        """All pairs with the times at which they are known [ns]."""
        for pair in self._replay.pairs():
            self._observed.append(KeyframeObservations.of_pair(pair))
            given = PublishedPair.of_result(pair)
            keyframe_ns = given.current_imu_ns + row_ns(given)
            self.views[keyframe_ns] = pair.stamp_ns, pair.parallax
            yield self._replay.read_ns, given

    def save(self, path: Path) -> None:
        """Write the observations of all pairs."""
        KeyframeObservations.merged(self._observed).save(path)


def _write_keyframes(path: Path, keyframes: Sequence[Odometry]) -> None:
    """Write the poses of keyframes in TUM's format."""
    write_tum(path, [(one.stamp_ns, one.R, one.position) for one in keyframes])


def _write_rows(folder: Path, rows: RowTrajectory, rate: float) -> None:
    """Write poses at any time, and with a rate [Hz] also in TUM's format."""
    rows.save(folder / ROWS_FILE)
    if rate:
        write_tum(folder / RATE_FILE, camera_poses(rows, rate))


def _with_loops(
    estimator: OdometryEstimator,
    paths: Paths,
    views: Views,
    replay: Replay,
    bag: Bag,
    topics: SensorTopics,
) -> tuple[Paths, dict[str, Any], list[PublishedPair]]:
    """Smoothed paths with loop closures, their report, and the loops that count."""
    parameters = replay.parameters
    assert replay.intake.intrinsics is not None

    def relate(stamps: list[PairStamps]) -> list[PairResult]:
        results, *_ = related(bag, topics, parameters, stamps)
        return [pair for pair in results if isinstance(pair, PairResult)]

    sensor = sensor_model(replay.intake.intrinsics, parameters.sensor)
    return close_loops(estimator, paths, views, sensor, relate)


def _metrics(estimator: OdometryEstimator, live: Sequence[Odometry]) -> dict[str, Any]:
    """Counts, intervals, starts and the estimated lever arm, for summary.json."""
    counted = (
        'pairs',
        'contradicting',
        'late',
        'without images',
        'calibration contradicted',
        'unsolved',
    )
    intervals: dict[str, list[dict[str, Any]]] = {
        OdometryState.UNCERTAIN.value: [],
        OdometryState.LOST.value: [],
    }
    for one in estimator.intervals:
        if one.state.value in intervals:
            entry = {'begin_ns': one.begin_ns, 'end_ns': one.end_ns, 'reason': one.reason}
            intervals[one.state.value].append(entry)
    arm, arm_sigma = estimator.imu_position
    positions = np.reshape([pose.position for pose in live], (-1, 3))
    steps = np.linalg.norm(np.diff(positions, axis=0), axis=1)
    return {
        'keyframes': len(live),
        'pairs': {name: estimator.counts[name] for name in counted},
        **intervals,
        'imu_position': arm.tolist(),
        'imu_position_sigma': arm_sigma.tolist(),
        'deviations': {
            name: {'value': value, 'sigma': sigma}
            for name, (value, sigma) in estimator.deviations.items()
        },
        'findings': findings_text.summary_json(Assessment(estimator.findings))['findings'],
        'starts': [asdict(started) for started in estimator.starts],
        'length_m': float(steps.sum()),
    }


def row_trajectory(
    paths: Sequence[Sequence[tuple[KeyframeState, Odometry]]],
    base: Base,
    parameters: Parameters,
    samples: Iterable[ImuSample],
    loops: Iterable[PublishedPair] = (),
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
    camera_mount = np.column_stack([C.T, arm])
    imu_mount = np.column_stack([np.eye(3), np.zeros(3)])
    base_mount = np.column_stack([base_R, arm - base_R @ base.position])
    knots = [[_knot(state, keyframe, base, arm) for state, keyframe in path] for path in paths]
    return RowTrajectory.of_paths(
        knots,
        buffer,
        np.array([camera_mount, imu_mount, base_mount]),
        [(loop.reference_imu_ns, loop.current_imu_ns) for loop in loops],
    )


def _knot(
    state: KeyframeState,
    keyframe: Odometry,
    base: Base,
    arm: Array,
) -> Knot:
    """A keyframe of a trajectory of rows, whose `arm` is that of the last path.

    The position of the camera is kept: the arm of an earlier path may differ.
    """
    return Knot(
        camera_ns=keyframe.stamp_ns,
        imu_ns=keyframe.imu_ns,
        R=state.R,
        position=base.camera(keyframe).position - state.R @ arm,
        velocity=state.velocity,
        gyro_bias=state.gyro_bias,
        accel_bias=state.accel_bias,
        covariance=keyframe.pose_covariance,
    )


class PublishedStates:
    """States between keyframes, as odometry_node publishes them on ``~/odometry``."""

    def __init__(
        self,
        estimator: OdometryEstimator,
        rate: float,
    ) -> None:
        """`rate` [Hz]: of the states; 0 for the keyframes alone."""
        self._estimator = estimator
        self._path = ContinuousPath(estimator.propagated)
        self._step_ns = round(NANOSECONDS / rate) if rate else 0
        self._next_ns = 0
        self.published: list[Odometry] = []

    def after(
        self,
        arrives_ns: int,
        keyframes: Sequence[Odometry],
    ) -> None:
        """Publish what is due after a sample, and the keyframes that it has finished."""
        due = [self._estimator.newest_ns] if arrives_ns >= self._next_ns else []
        if not self._step_ns:
            due = [keyframe.imu_ns for keyframe in keyframes]
        elif due:
            self._next_ns = arrives_ns + self._step_ns
        states = [self._path.at(imu_ns) for imu_ns in due]
        self.published += [state for state in states if state is not None]


def follow(
    estimator: OdometryEstimator,
    pairs: Iterable[tuple[int, PublishedPair]],
    samples: Sequence[tuple[int, ImuSample | int]],
    after: Callable[[int, Sequence[Odometry]], None] = lambda arrives_ns, keyframes: None,
) -> list[Odometry]:
    """Keyframes of pairs and samples, both with their times of arrival [ns].

    A number among the samples is the stamp of a frame. `after`: called with the time of arrival
    and the new keyframes after each pair and each sample.
    """
    live: list[Odometry] = []

    def take(arrives_ns: int) -> None:
        keyframes = estimator.take()
        live.extend(keyframes)
        after(arrives_ns, keyframes)

    given = 0
    for arrives_ns, pair in pairs:
        while given < len(samples) and samples[given][0] <= arrives_ns:
            _add(estimator, samples[given][1])
            take(samples[given][0])
            given += 1
        estimator.add_pair(pair)
        take(arrives_ns)
    for sample_ns, sample in samples[given:]:
        if not estimator.waiting:
            break  # the rest of the IMU belongs to no pair
        _add(estimator, sample)
        take(sample_ns)
    return live + estimator.take(end=True)


def _require_accelerometer(bag: Bag, topics: SensorTopics) -> None:
    """InputError for an accelerometer on another clock, by which a path would be wrong."""
    fault = check_timelines(bag.timeline, topics).get(FaultKind.ACCEL_CLOCK)
    if fault is not None:
        raise InputError(
            f'{bag.path}: {fault.message}, and a path needs both sensors: have their driver '
            'stamp them with one clock; "rs_relpose replay" needs the gyro alone'
        )


def _samples(bag: Bag, topics: SensorTopics) -> list[tuple[int, ImuSample | int]]:
    """IMU samples and stamps of the frames of a bag with their times of reading, in this order."""
    out: list[tuple[int, ImuSample | int]] = []
    for role, message in sensor_messages(bag, topics, (Role.IMU, Role.ACCEL, Role.CAMERA_INFO)):
        with suppress(InputError):  # the replay counts and reports it
            if role is Role.CAMERA_INFO:
                value: ImuSample | int = stamp_ns(message.message.header)
            else:
                value = PARTS[role].read(message.message)
            out.append((message.read_ns, value))
    return out


def _add(estimator: OdometryEstimator, sample: ImuSample | int) -> None:
    with suppress(InputError):  # a stuck gyro: the replay counts and reports it
        if isinstance(sample, int):
            estimator.add_frame(sample)
        else:
            estimator.add_imu(sample)


# Path length over which relative errors are taken [m], as in docs/lab/odometry.md.
# [chosen: a longer one averages over errors, of a shorter one the noise of the truth counts]
_SEGMENT = 1.0
# Fewest poses that are aligned with the truth: three positions fit any rotation.
_FEWEST_ALIGNED = 4
# Share of states within the bound that `beyond` counts.
_WITHIN = 0.997


def chi_squared_bound(dimension: int, share: float) -> float:
    """The quantile of chi squared; scipy.stats takes a second to import."""
    return float(2.0 * gammaincinv(0.5 * dimension, share))


def write_states(path: Path, states: Iterable[Odometry]) -> None:
    """Write states of the camera (CSV): `_STATE_COLUMNS`, every number exactly."""
    with written(path) as file:
        file.write(','.join(_STATE_COLUMNS) + '\n')
        for state in states:
            values = np.concatenate(
                [
                    state.position,
                    quat_xyzw(state.R),
                    state.R @ state.velocity,
                    state.pose_covariance.ravel(),
                ]
            )
            stamps = f'{state.stamp_ns},{state.imu_ns},{state.path},'
            file.write(stamps + ','.join(map(repr, values.tolist())) + '\n')


def consistency(
    states: Sequence[Odometry],
    origin: Odometry,
    truth: TrueTrajectory,
) -> dict[str, dict[str, float] | None]:
    """`nees` and `beyond` of published states, for summary.json; None where no truth covers them.

    NEES: squared error by its covariance per degree of freedom, in the mean; 1 is wanted.
    `beyond`: share outside of the 99.7 % quantile. `origin`: the first smoothed state, whose
    position and heading are the origin of the world. All are states of the camera.
    """
    covered = [state for state in states if truth.covers(state.imu_ns)]
    if not covered or not truth.covers(origin.imu_ns):
        return {'nees': None, 'beyond': None}
    turn = exp_so3(heading(origin.R @ truth.rotation(origin.imu_ns).T))
    squares = _squared_errors(covered, origin, turn, truth)
    names = ('position', 'rotation', 'velocity')
    beyond = (squares > chi_squared_bound(3, _WITHIN)).mean(axis=0)
    return {
        'nees': dict(zip(names, (squares.mean(axis=0) / 3.0).tolist(), strict=True)),
        'beyond': dict(zip(names, beyond.tolist(), strict=True)),
    }


def _squared_errors(
    states: Sequence[Odometry],
    origin: Odometry,
    turn: Array,
    truth: TrueTrajectory,
) -> Array:
    """Chi squared (N, 3) of position, rotation and velocity.

    `turn` (3, 3): from the truth's world to ours.
    """
    at_ns = [state.imu_ns for state in states]
    rotations = turn @ truth.rotations(at_ns)
    ways = truth.positions(at_ns) - truth.position(origin.imu_ns)
    velocities = truth.velocities(at_ns) @ turn.T
    places = np.array([state.position for state in states]) - origin.position
    turns = [log_so3(state.R @ R.T) for state, R in zip(states, rotations, strict=True)]
    moving = np.array([state.velocity for state in states])
    # In the axes of the camera, as the velocities of states.
    true_moving = np.einsum('nji,nj->ni', rotations, velocities)
    of_poses = np.array([state.pose_covariance for state in states])
    of_twists = np.array([state.velocity_covariance for state in states])
    squares = [
        _chi_squared(places - ways @ turn.T, of_poses[:, :3, :3]),
        _chi_squared(np.array(turns), of_poses[:, 3:, 3:]),
        _chi_squared(moving - true_moving, of_twists[:, :3, :3]),
    ]
    return np.stack(squares, axis=1)


def _chi_squared(errors: Array, covariances: Array) -> Array:
    """Squares (N,) of errors (N, 3) by their covariances (N, 3, 3)."""
    whitened = np.linalg.solve(covariances, errors[:, :, None])[:, :, 0]
    return np.asarray((errors * whitened).sum(axis=1))


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
    centred = positions - mean
    correlation = (truth - true_mean).T @ centred
    R = aligning_rotation(correlation)
    scale = float((R * correlation).sum() / (centred**2).sum())
    return R, true_mean - R @ mean, scale


def path_of(trajectory: Sequence[Odometry], truth: TrueTrajectory | None) -> ComparedPath:
    """Positions of a trajectory; compared with the ground truth if it covers 4 poses or more."""
    covered = []
    if truth is not None:
        covered = [pose for pose in trajectory if truth.covers(pose.imu_ns)]
    if truth is None or len(covered) < _FEWEST_ALIGNED:
        all_ns = [pose.imu_ns for pose in trajectory]
        positions = np.array([pose.position for pose in trajectory])
        return ComparedPath(all_ns, positions.reshape(-1, 3))
    covered_ns = [pose.imu_ns for pose in covered]
    positions = np.array([pose.position for pose in covered])
    true = truth.positions(covered_ns)
    R, t, scale = aligned(positions, true)
    moved = positions @ R.T + t
    squares = ((moved - true) ** 2).sum(axis=1)
    steps = np.linalg.norm(np.diff(true, axis=0), axis=1)
    way = np.concatenate([[0.0], np.cumsum(steps)])
    relative = _relative_errors(covered, way, truth)
    relative_error = float(np.median(relative)) if relative else math.nan
    errors = TrajectoryErrors(
        ate_m=float(np.sqrt(squares.mean())),
        scale_error=scale - 1.0,
        relative_translation_error_percent=100.0 * relative_error,
        length_m=float(way[-1]),
    )
    return ComparedPath(covered_ns, moved, true, errors)


def _relative_errors(
    poses: Sequence[Odometry],
    way: Array,
    truth: TrueTrajectory,
) -> list[float]:
    """Errors of the translation over segments of 1 m, by their length; `way` (N,) [m]: true."""
    relative = []
    for i, pose in enumerate(poses):
        j = int(np.searchsorted(way, way[i] + _SEGMENT))
        if j == len(poses):
            break
        known = truth.relative_pose(pose.imu_ns, poses[j].imu_ns)
        if known is not None and poses[j].path == pose.path:
            step = pose.R.T @ (poses[j].position - pose.position)
            error = float(np.linalg.norm(step - known[1]))
            relative.append(error / float(way[j] - way[i]))
    return relative


def draw_paths(drawn: Mapping[str, ComparedPath], path: Path) -> Figure:
    """Paths by name, from above and their heights, with the ground truth if known."""
    # A layout that Matplotlib computes would draw everything twice.
    picture = Figure(figsize=(11.0, 5.5), dpi=110)
    above, height = picture.subplots(1, 2, gridspec_kw=dict(_MARGINS))
    # Live paths begin later: the ground truth of the longest path is drawn.
    compared = [line for line in drawn.values() if line.truth is not None]
    longest = max(compared, key=lambda line: len(line.imu_ns), default=None)
    lines = [] if longest is None else [('truth', longest.imu_ns, longest.truth)]
    lines += [
        (name, line.imu_ns, line.positions) for name, line in drawn.items() if len(line.imu_ns)
    ]
    first_ns = min((imu_ns[0] for _, imu_ns, _ in lines), default=0)
    for name, imu_ns, positions in lines:
        assert positions is not None
        x, y, z = positions.T
        seconds = [seconds_between(first_ns, at_ns) for at_ns in imu_ns]
        above.plot(x, y, label=name, **_STYLES[name])
        height.plot(seconds, z, label=name, **_STYLES[name])
    above.set_aspect('equal', 'datalim')
    above.set(title='path from above', xlabel='x [m]', ylabel='y [m]')
    height.set(title='height', xlabel='time [s]', ylabel='z [m]')
    for axes in (above, height):
        if lines:
            axes.legend()
        axes.grid(alpha=0.3)
    save_picture(picture, path)
    return picture
