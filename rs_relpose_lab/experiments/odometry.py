"""`rs_relpose benchmark odometry`: simulated walks and EuRoC's corners, against the truth.

Tracks without images go through the whole front end; its pairs and the samples through the graph.
"""

from collections.abc import Sequence
from dataclasses import dataclass
import io
import math
from pathlib import Path
import tarfile
import time

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from rs_relpose_lab.experiments import odometry_disturbances, trust_runs
from rs_relpose_lab.experiments.harness import markdown_table, write_table
from rs_relpose_lab.experiments.odometry_disturbances import published, TrueStates
from rs_relpose_lab.experiments.trust_rows import Configured
from rs_relpose_lab.experiments.trust_runs import Recording, Source
from rs_relpose_lab.simulation import simulate, SimulationConfig
from rs_relpose_lab.simulation.bag import intrinsics_of
from rs_relpose_lab.simulation.scene import SCENES
from rs_relpose_ros.bags.sensor_topics import IMAGE_DELAY
from rs_relpose_ros.config.settings import Parameters
from rs_relpose_ros.errors import InputError, MissingInputError
from rs_relpose_ros.geometry import Array
from rs_relpose_ros.geometry.camera import RollingShutterCamera
from rs_relpose_ros.geometry.timing import seconds_between, to_nanoseconds
from rs_relpose_ros.imu.buffer import ImuSample
from rs_relpose_ros.odometry import offline
from rs_relpose_ros.odometry.estimator import OdometryEstimator
from rs_relpose_ros.odometry.offline import TrajectoryErrors
from rs_relpose_ros.odometry.pair import warm_up_odometry
from rs_relpose_ros.odometry.states import Odometry
from rs_relpose_ros.offline.truth import TrueTrajectory

# -- EuRoC's corners as tracks: a real global shutter with its IMU, and metric truth -----------
#
# Folder `euroc_imu_april_corners`: corners of an AprilGrid in 1439 images of the calibration
# recording of the EuRoC MAV dataset, its IMU, and the camera's poses by PnP of each image's
# corners. Its README names the origin.

# Name of the recording in the report.
NAME = 'EuRoC imu_april'

# Camera of the dataset: cam0 of the VI-Sensor. [derived: its sensor.yaml]
_CAMERA = RollingShutterCamera(
    width=752,
    height=480,
    fx=458.654,
    fy=457.296,
    cx=367.215,
    cy=248.375,
    distortion=(-0.28340811, 0.07395907, 0.00019359, 1.76187114e-05, 0.0),
    readout_time=0.0,
)
# Pose (3, 4) of the camera in the body, which is the IMU. [derived: T_BS in the same file]
_BODY_FROM_CAMERA = np.array(
    [
        [0.0148655429818, -0.999880929698, 0.00414029679422, -0.0216401454975],
        [0.999557249008, 0.0149672133247, 0.025715529948, -0.064676986768],
        [-0.0257744366974, 0.00375618835797, 0.999660727178, 0.00981073058949],
    ]
)
# Bias of the gyro [rad/s]. [measured: a fit (README of the folder) with a lens whose principal
# point fits these corners, 7 px off the given one]
_GYRO_BIAS = (-0.0016, 0.0250, 0.0777)
# Corners of the AprilGrid. [derived: 36 tags]
_CORNERS = 144


def read_euroc(folder: Path) -> tuple[Recording, TrueTrajectory]:
    """The recording and its truth, the world being the target; MissingInputError without it."""
    try:
        with tarfile.open(folder / 'cam0_corners.tar.gz') as archive:
            files = [archive.extractfile(member) for member in archive if member.isfile()]
            found = [_corners(file.read().decode()) for file in files if file is not None]
        imu_ns, imu = _series(folder / 'imu0.csv', range(1, 7))
        stamps, poses = _series(folder / 'gt_pnp_cam0.csv', range(3, 10), header=1)
    except OSError as error:
        raise MissingInputError(f"there are no corners of EuRoC's in {folder}: {error}") from error
    frames = sorted((frame for frame in found if frame is not None), key=lambda frame: frame[0])
    stamps_ns, ids, pixels = zip(*frames, strict=True)
    R = Rotation.from_quat(poses[:, [1, 2, 3, 0]])  # X_cam = R X_target + t
    truth = TrueTrajectory(stamps, -R.inv().apply(poses[:, 4:]), R.inv().as_quat())
    C = _BODY_FROM_CAMERA[:, :3].T
    configured = Configured(
        {
            'readout_time': 0.0,
            'gyro_bias': _GYRO_BIAS,
            'quat_cam_imu_xyzw': tuple(Rotation.from_matrix(C).as_quat().tolist()),
            'imu_position': tuple((-C @ _BODY_FROM_CAMERA[:, 3]).tolist()),
        },
        intrinsics_of(_CAMERA),
    )
    zeros = np.zeros((_CORNERS, 2))
    sightings = trust_runs.Sightings(
        ids,
        pixels,
        tuple(map(np.zeros_like, pixels)),
        np.zeros(len(ids)),
        zeros,
        zeros,
        trust_runs.TrackNoise(white=0.0),
    )
    delay_ns = to_nanoseconds(IMAGE_DELAY)
    shape = (_CAMERA.height, _CAMERA.width)
    recording = Recording(
        Source(NAME, trust_runs.TRACKS),
        configured,
        _CAMERA,
        [
            trust_runs.Arrival(k, stamp_ns, stamp_ns + delay_ns)
            for k, stamp_ns in enumerate(stamps_ns)
        ],
        [
            ImuSample(int(ns), tuple(row[:3].tolist()), tuple(row[3:].tolist()))
            for ns, row in zip(imu_ns, imu, strict=True)
        ],
        lambda number: trust_runs.numbered_image(number, shape),
        sightings,
        truth.relative_pose,
        imu_ns,
        imu[:, :3] @ C.T,
    )
    return recording, truth


def _series(path: Path, columns: range, header: int = 0) -> tuple[NDArray[np.int64], Array]:
    """Stamps [ns] in the first column of a table, and the values of some columns."""
    stamps = np.loadtxt(path, dtype=np.int64, delimiter=',', skiprows=header, usecols=0)
    values = np.loadtxt(path, delimiter=',', skiprows=header, usecols=columns)
    return stamps, values


def _corners(text: str) -> tuple[int, NDArray[np.int64], Array] | None:
    """Stamp [ns], corners by number (N,) and pixels (N, 2) of an image; None without any."""
    lines = text.splitlines()[1:]
    if not lines:
        return None
    table = np.loadtxt(io.StringIO('\n'.join(lines)), delimiter=',', ndmin=2)
    ids = (4 * table[:, -2] + table[:, -1]).astype(np.int64)
    order = np.argsort(ids)
    return int(lines[0].partition(',')[0]), ids[order], table[order, 5:7]


# -- paths against the truth ------------------------------------------------------------------

# Length of the short walks [s]. [chosen: some start-ups of odometry fit in]
SHORT = 30.0
# Length of the long walks [s]. [chosen: ten times as long, to show the drift]
LONG = 300.0
# Part of a path that is aligned before its end is compared [s].
_ALIGNED = 5.0


@dataclass(frozen=True, slots=True)
class PathMetrics:
    """Odometry of a recording."""

    name: str
    readout_ms: float
    seconds: float
    pairs: int
    contradicting: int
    lost: int
    at_rest: bool
    start: float  # [s] from the first pair to the first published keyframe
    live: TrajectoryErrors
    smoothed: TrajectoryErrors
    nees_position: float  # of published states by degrees of freedom, mean
    nees_rotation: float  # NaN where the truth has errors of its own
    nees_velocity: float
    # Error of the end after the first 5 s are aligned, by the length of the path [%].
    drift: float
    processor: float  # of one core, by the graph alone, without messages [%]


def walks(
    count: int,
    first_seed: int,
    seconds: float = SHORT,
    *,
    readout: float | None = None,
    plan: str = '',
) -> list[SimulationConfig]:
    """Recordings of hand-held walks; scenes alternate, readouts are spread from 12 to 35 ms.

    Without a `plan`, they include standstills and pure rotations.
    """
    return [
        SimulationConfig(
            seed=first_seed + k,
            scene=SCENES[k % len(SCENES)],
            duration=seconds,
            plan=plan,
            readout_time=round(0.012 + 0.023 * k / max(count - 1, 1), 4)
            if readout is None
            else readout,
        )
        for k in range(count)
    ]


def on_walk(config: SimulationConfig) -> PathMetrics:
    """Odometry of a simulated recording."""
    simulation = simulate(config)
    recording = trust_runs.walk_of(
        simulation, np.random.default_rng(config.seed), ', in motion' if config.plan else ''
    )
    return on_recording(recording, odometry_disturbances.true_states(simulation))


def on_euroc(folder: Path, picture: Path) -> PathMetrics:
    """Odometry of EuRoC's corners, and a picture of the path."""
    return on_recording(*read_euroc(folder), picture=picture)


def on_recording(
    recording: Recording, truth: TrueStates | TrueTrajectory, *, picture: Path | None = None
) -> PathMetrics:
    """Odometry of a recording's pairs and samples; NEES if the truth is that of a simulation."""
    # Before: the time of the front end does not count.
    feed = odometry_disturbances.feed_of(recording)
    parameters = Parameters.from_mapping(feed.values)
    warm_up_odometry()
    estimator = OdometryEstimator(parameters, keep=True)
    started = time.thread_time()
    live = offline.follow(estimator, feed.pairs, feed.samples)
    processor = time.thread_time() - started
    smoothed = estimator.smoothed()
    nees = (math.nan,) * 3
    if isinstance(truth, TrueStates):
        states = list(published(OdometryEstimator(parameters), feed))
        chi = odometry_disturbances.errors_squared(states, smoothed[0], truth)
        nees = (chi.mean(axis=0) / 3.0).tolist()
        truth = truth.trajectory
    paths = {'live': offline.path_of(live, truth), 'smoothed': offline.path_of(smoothed, truth)}
    errors = [path.errors for path in paths.values() if path.errors is not None]
    if len(errors) < 2:
        raise InputError(f'{recording.source.name}: odometry did not start')
    if picture is not None:
        offline.draw_paths(paths, picture)
    first = estimator.starts[0]
    return PathMetrics(
        recording.source.name,
        1e3 * recording.camera.readout_time,
        recording.seconds,
        len(feed.pairs),
        estimator.counts['contradicting'],
        estimator.counts['lost'],
        first.at_rest,
        first.seconds,
        errors[0],
        errors[1],
        *nees,
        drift(live, truth),
        100.0 * processor / recording.seconds,
    )


def drift(live: Sequence[Odometry], truth: TrueTrajectory) -> float:
    """Error of the last position after the first 5 s are aligned, in % of the path."""
    covered = [pose for pose in live if truth.covers(pose.imu_ns)]
    times_ns = [pose.imu_ns for pose in covered]
    places = np.array([pose.position for pose in covered])
    true = np.array([truth.position(time_ns) for time_ns in times_ns])
    early = [seconds_between(times_ns[0], time_ns) < _ALIGNED for time_ns in times_ns]
    R, t, _ = offline.aligned(places[early], true[early])
    steps = np.diff(true, axis=0)
    length = np.linalg.norm(steps, axis=1).sum()
    error = np.linalg.norm(R @ places[-1] + t - true[-1])
    return float(100.0 * error / length)


def write_report(folder: Path, paths: Sequence[PathMetrics]) -> str:
    """Write the metrics (CSV) and the report (Markdown), and return the latter."""
    return write_table(
        folder,
        'odometry',
        paths,
        markdown_table(
            (
                'recording',
                'readout [ms]',
                'length [m]',
                'started [s]',
                'live: ATE [m]',
                'scale [%]',
                'over 1 m [%]',
                'smoothed: ATE',
                'scale',
                'over 1 m',
                'NEES: position',
                'rotation',
                'velocity',
                'drift [%]',
                'core [%]',
                'left out',
            ),
            [
                (
                    f'{p.name}, {p.seconds:.0f} s',
                    f'{p.readout_ms:.1f}',
                    f'{p.live.length_m:.1f}',
                    f'{p.start:.1f}' + (' at rest' if p.at_rest else ''),
                    *_errors(p.live),
                    *_errors(p.smoothed),
                    *(
                        _known(value)
                        for value in (p.nees_position, p.nees_rotation, p.nees_velocity)
                    ),
                    f'{p.drift:.3f}',
                    f'{p.processor:.1f}',
                    f'{p.contradicting} of {p.pairs}'
                    + (f', lost {p.lost} times' if p.lost else ''),
                )
                for p in paths
            ],
        ),
    )


def _known(value: float) -> str:
    return '-' if math.isnan(value) else f'{value:.2f}'


def _errors(errors: TrajectoryErrors) -> tuple[str, str, str]:
    return (
        f'{errors.ate_m:.3f}',
        f'{100.0 * errors.scale_error:+.2f}',
        f'{errors.relative_translation_error_percent:.2f}',
    )
