"""`rs_relpose benchmark odometry --loops N`: closed walks, smoothed without loops and with them.

Tracks without images go through the front end; the images of loops are rendered.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace
import math
from pathlib import Path

import numpy as np
from scipy.stats import chi2

from rs_relpose_lab.experiments import trust_runs
from rs_relpose_lab.experiments.harness import markdown_table, write_table
from rs_relpose_lab.experiments.odometry_disturbances import true_states
from rs_relpose_lab.experiments.trust_runs import Gray, Recording
from rs_relpose_lab.simulation import simulate, SimulationConfig
from rs_relpose_lab.simulation.simulation import Simulation
from rs_relpose_lab.simulation.trajectory import Trajectory
from rs_relpose_ros.bags.sensor_topics import IMU_DELAY
from rs_relpose_ros.config.settings import Parameters, sensor_model
from rs_relpose_ros.errors import InputError
from rs_relpose_ros.geometry.so3 import log_so3
from rs_relpose_ros.geometry.timing import to_nanoseconds
from rs_relpose_ros.messages.published_pair import PublishedPair
from rs_relpose_ros.odometry.estimator import OdometryEstimator
from rs_relpose_ros.odometry.loops import close_loops
from rs_relpose_ros.odometry.offline import follow, path_of
from rs_relpose_ros.odometry.pair import Body, deviations, Measured, Mount, row_ns, square_root
from rs_relpose_ros.odometry.states import Odometry
from rs_relpose_ros.offline.truth import TrueTrajectory
from rs_relpose_ros.pipeline.chosen_pairs import ChosenPairs, PairStamps
from rs_relpose_ros.pipeline.pair import PairResult
from rs_relpose_ros.pipeline.pipeline import FrameLoop
from rs_relpose_ros.pipeline.warm_up import warm_up

# Length of the walks [s]. [chosen: they come back to places several times]
SECONDS = 60.0
# Probability of an error beyond three sigmas. [derived: normal distribution]
_BEYOND = 0.0027


@dataclass(frozen=True, slots=True)
class LoopMetrics:
    """Odometry of a closed walk, smoothed, without loops and with them.

    Errors of the last pose in the first one's frame ([m], [deg]), and ATE [m].
    """

    name: str
    keyframes: int
    offered: int
    related: int
    taken: int
    worst: float  # largest chi squared of the taken loops, by its 3 sigma bound; NaN without
    end_without: float
    end: float
    rotation_without: float
    rotation: float
    ate_without: float
    ate: float


def closed(trajectory: Trajectory, seconds: float) -> Trajectory:
    """A walk that ends as it begins, after a full turn of the camera about the vertical."""
    times = trajectory.first_control + trajectory.spacing * np.arange(len(trajectory.positions))
    share = times / seconds
    (begin, end), (R1, R2) = trajectory.poses([0.0, seconds])
    angles = trajectory.angles.copy()
    heading = math.atan2(R1[1, 2], R1[0, 2]) - math.atan2(R2[1, 2], R2[0, 2])
    angles[:, 0] += share * (2.0 * math.pi + heading)
    return replace(
        trajectory, angles=angles, positions=trajectory.positions + np.outer(share, begin - end)
    )


def on_seed(seed: int) -> LoopMetrics:
    """Loop closures on the walk of a seed, in rooms: other scenes are open behind the camera."""
    config = SimulationConfig(
        seed=seed,
        scene=('hall', 'gallery')[seed % 2],
        duration=SECONDS,
        fps=20.0,
        readout_time=0.02,
        plan=f'walk:{SECONDS:g}',
    )
    return on_walk(config, closed(simulate(config).trajectory, SECONDS))


def on_walk(config: SimulationConfig, trajectory: Trajectory) -> LoopMetrics:
    """Odometry of a walk with loop closures."""
    simulation = simulate(config, trajectory=trajectory)
    recording = trust_runs.walk_of(simulation, np.random.default_rng(config.seed))
    parameters = Parameters.from_mapping(recording.configured.values)
    arrives = {arrival.stamp_ns: arrival.arrives_ns for arrival in recording.arrivals}
    pairs = []
    views = {}
    for pair, _ in trust_runs.run(recording, recording.configured):
        given = PublishedPair.of_result(pair)
        views[given.current_imu_ns + row_ns(given)] = pair.stamp_ns, pair.parallax
        pairs.append((arrives[pair.stamp_ns], given))
    estimator = OdometryEstimator(parameters, keep=True)
    delay_ns = to_nanoseconds(IMU_DELAY)
    follow(
        estimator, pairs, [(sample.stamp_ns + delay_ns, sample) for sample in recording.samples]
    )
    before = estimator.smoothed_paths()
    sensor = sensor_model(recording.configured.intrinsics, parameters.sensor)
    after, report, taken = close_loops(
        estimator, before, views, sensor, lambda stamps: _related(recording, simulation, stamps)
    )
    truth = true_states(simulation).trajectory
    (end1, turn1, ate1), (end2, turn2, ate2) = (
        _errors([pose for path in paths for _, pose in path], truth) for paths in (before, after)
    )
    return LoopMetrics(
        recording.source.name,
        sum(map(len, before)),
        report['offered'],
        report['related'],
        report['taken'],
        max((_misfit(pair, simulation) for pair in taken), default=math.nan),
        end1,
        end2,
        turn1,
        turn2,
        ate1,
        ate2,
    )


def _related(
    recording: Recording, simulation: Simulation, stamps: list[PairStamps]
) -> list[PairResult]:
    """Pairs of rendered images."""
    wanted = {stamp for pair in stamps for stamp in pair}
    blank = np.zeros((simulation.config.height, simulation.config.width), dtype=np.uint8)

    def image(number: int) -> Gray:
        return simulation.image(number) if simulation.stamp_ns(number) in wanted else blank

    parameters = Parameters.from_mapping(recording.configured.values)
    warm_up(parameters.estimator)
    loop = FrameLoop(parameters, ChosenPairs(stamps), offline=True)
    found: dict[PairStamps, PairResult | str] = {}
    for frame in trust_runs.processed(
        replace(recording, image=image, sightings=None), recording.configured, loop
    ):
        found.update(frame.result or {})
    return [pair for pair in found.values() if isinstance(pair, PairResult)]


def _errors(path: Sequence[Odometry], truth: TrueTrajectory) -> tuple[float, float, float]:
    """Position [m] and rotation [deg] of the last pose in the first one's frame, and ATE [m]."""
    first = path[0]
    last = path[-1]
    true = truth.relative_pose(first.imu_ns, last.imu_ns)
    errors = path_of(path, truth).errors
    if true is None or errors is None:
        raise InputError('the truth does not cover the path')
    turn = log_so3(first.R.T @ last.R @ true[0].T)
    return (
        float(np.linalg.norm(first.R.T @ (last.position - first.position) - true[1])),
        math.degrees(float(np.linalg.norm(turn))),
        errors.ate_m,
    )


def _misfit(pair: PublishedPair, simulation: Simulation) -> float:
    """Chi squared of a loop at the true poses, by its 3 sigma bound."""
    states = simulation.states([pair.reference_imu_ns, pair.current_imu_ns])
    images = pair.images
    assert images is not None
    first, second = (
        Body(
            np.ascontiguousarray(states.R_world_cam[k]),
            states.position[k].copy(),
            states.velocity[k].copy(),
            states.angular_velocity[k].copy(),
            np.zeros(3),
        )
        for k in range(2)
    )
    A, a = square_root(images.information, images.gradient)
    mount = Mount(np.eye(3), np.zeros(3), np.zeros(3), 0.0)
    deviation, _ = deviations(first, second, mount, Measured.of(pair))
    error = A @ deviation[: A.shape[1]] + a
    return float(error @ error) / float(chi2.isf(_BEYOND, len(error)))


def write_report(folder: Path, walks: Sequence[LoopMetrics]) -> str:
    """Write the metrics (CSV) and the report (Markdown), and return the latter."""
    return write_table(
        folder,
        'odometry_loops',
        walks,
        markdown_table(
            (
                'walk',
                'keyframes',
                'loops offered',
                'related',
                'taken',
                'worst [3 sigma]',
                'end: without [m]',
                'with [m]',
                'ratio',
                'without [deg]',
                'with [deg]',
                'ATE: without [m]',
                'with [m]',
            ),
            [
                (
                    one.name,
                    *map(str, (one.keyframes, one.offered, one.related, one.taken)),
                    f'{one.worst:.2f}',
                    f'{one.end_without:.4f}',
                    f'{one.end:.4f}',
                    f'{one.end / one.end_without:.2f}',
                    f'{one.rotation_without:.3f}',
                    f'{one.rotation:.3f}',
                    f'{one.ate_without:.4f}',
                    f'{one.ate:.4f}',
                )
                for one in walks
            ],
        ),
    )
