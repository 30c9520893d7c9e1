"""`rs_relpose benchmark odometry`: simulated walks and EuRoC's corners, against the truth.

Tracks without images go through the whole front end; its pairs and the samples through the graph.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
import math
from pathlib import Path
import time

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from rs_relpose_lab.experiments.odometry_euroc import read_euroc
from rs_relpose_lab.experiments.tables import markdown_table, write_csv
from rs_relpose_lab.experiments.trust_runs import Recording, run, simulated, Source, TRACKS
from rs_relpose_lab.experiments.trust_tracks import TrackNoise
from rs_relpose_lab.simulation import simulate, SimulationConfig
from rs_relpose_lab.simulation.scene import SCENES
from rs_relpose_ros.bags.layout import IMU_DELAY
from rs_relpose_ros.config.parameters import Parameters
from rs_relpose_ros.errors import InputError
from rs_relpose_ros.geometry.timing import seconds_between, to_nanoseconds
from rs_relpose_ros.odometry.measurement import PairMeasurement
from rs_relpose_ros.odometry.odometry import Odometry, OdometryEstimator
from rs_relpose_ros.odometry.offline import draw_paths, Drawn, follow
from rs_relpose_ros.odometry.trajectory import against_truth, aligned, TrajectoryErrors
from rs_relpose_ros.odometry.warm_up import warm_up_odometry
from rs_relpose_ros.replay.truth import TrueTrajectory

Array = NDArray[np.float64]

# Lengths of the walks [s].
SHORT, LONG = 30.0, 300.0
# Part of a path that is aligned before its end is looked at [s].
_ALIGNED = 5.0


@dataclass(frozen=True, slots=True)
class PathFigures:
    """What odometry made of a recording.

    `start`: seconds from the first pair to the first keyframe that is told. `step_nees`: mean of
    the smoothed steps between keyframes, `live_nees`: median of the live positions against the
    start, both in units of their covariances, by degrees of freedom; NaN where the truth has
    errors of its own. `drift`: error of the end after the first 5 s are aligned, by the length of
    the path [%]. `processor`: of one core, by the graph alone, without messages [%].
    """

    name: str
    readout_ms: float
    seconds: float
    pairs: int
    contradicting: int
    lost: int
    at_rest: bool
    start: float
    live: TrajectoryErrors
    smoothed: TrajectoryErrors
    step_nees: float
    live_nees: float
    drift: float
    processor: float


def walks(count: int, first_seed: int, seconds: float = SHORT, *, readout: float | None = None,
          plan: str = '') -> list[SimulationConfig]:
    """Recordings of hand-held walks; scenes take turns, read-outs are spread from 12 to 35 ms.

    Without a `plan`, they stand and turn in place now and then.
    """
    return [SimulationConfig(
        seed=first_seed + k, scene=SCENES[k % len(SCENES)], duration=seconds, plan=plan,
        readout_time=round(0.012 + 0.023 * k / max(count - 1, 1), 4) if readout is None
        else readout) for k in range(count)]


def on_walk(config: SimulationConfig) -> PathFigures:
    """Odometry of a simulated recording."""
    simulation = simulate(config)
    source = Source(f'{config.scene} {config.seed}' + (', in motion' if config.plan else ''),
                    TRACKS, 'walk', config.scene, config.seed)
    recording = simulated(source, simulation, TrackNoise(), np.random.default_rng(config.seed))
    states = simulation.states(simulation.imu.stamps_ns)
    truth = TrueTrajectory(simulation.imu.stamps_ns, states.position,
                           Rotation.from_matrix(states.R_world_cam).as_quat())
    return on_recording(recording, truth)


def on_euroc(folder: Path, picture: Path) -> PathFigures:
    """Odometry of EuRoC's corners, and a picture of the path."""
    recording, truth = read_euroc(folder)
    return on_recording(recording, truth, exact=False, picture=picture)


def on_recording(recording: Recording, truth: TrueTrajectory, *, exact: bool = True,
                 picture: Path | None = None) -> PathFigures:
    """Odometry of a recording's pairs and samples; `exact`: whether the truth is."""
    parameters = Parameters.from_mapping(recording.told.values)
    arrives = {arrival.stamp_ns: arrival.arrives_ns for arrival in recording.arrivals}
    # All of them before the first: the time of the front end is none of odometry's.
    pairs = [(arrives[pair.stamp_ns], PairMeasurement.of_result(pair))
             for pair, _ in run(recording, recording.told)]
    delay_ns = to_nanoseconds(IMU_DELAY)
    samples = [(sample.stamp_ns + delay_ns, sample) for sample in recording.samples]
    warm_up_odometry()
    estimator = OdometryEstimator(parameters, keep=True)
    started = time.thread_time()
    live = follow(estimator, pairs, samples)
    processor = time.thread_time() - started
    smoothed = estimator.smoothed()
    compared = [found for path in (live, smoothed)
                if (found := against_truth(path, truth)) is not None]
    if len(compared) < 2:
        raise InputError(f'{recording.source.name}: odometry did not start')
    if picture is not None:
        draw_paths({name: Drawn(*found[1:]) for name, found in zip(
            ('live', 'smoothed'), compared, strict=True)}, picture)
    first = estimator.starts[0]
    return PathFigures(
        recording.source.name, 1e3 * recording.camera.readout_time, recording.seconds,
        len(pairs), estimator.counts['contradicting'], estimator.counts['lost'], first.at_rest,
        first.seconds, compared[0].errors, compared[1].errors,
        step_nees(estimator, truth) if exact else math.nan,
        live_nees(live, smoothed[0], truth) if exact else math.nan, drift(live, truth),
        100.0 * processor / recording.seconds)


def step_nees(estimator: OdometryEstimator, truth: TrueTrajectory) -> float:
    """Squared errors of the smoothed steps in units of their covariance; mean, by 3."""
    found = []
    for start_ns, end_ns, step in estimator.smoothed_steps():
        known = truth.relative_pose(start_ns, end_ns)
        if known is not None:
            error = step.translation - known[1]
            found.append(error @ np.linalg.solve(step.covariance, error) / 3.0)
    return float(np.mean(found))


def live_nees(live: Sequence[Odometry], first: Odometry, truth: TrueTrajectory) -> float:
    """The same of live positions against the `first` one, smoothed, which is that of the truth."""
    if not truth.covers(first.imu_ns):
        return math.nan
    turn = first.R @ truth.rotation(first.imu_ns).T
    found = []
    for pose in live:
        if truth.covers(pose.imu_ns):
            error = pose.position - first.position - turn @ (
                truth.position(pose.imu_ns) - truth.position(first.imu_ns))
            found.append(error @ np.linalg.solve(pose.pose_covariance[:3, :3], error) / 3.0)
    return float(np.median(found))


def drift(live: Sequence[Odometry], truth: TrueTrajectory) -> float:
    """Error of the last position after the first 5 s are aligned, in % of the path."""
    covered = [pose for pose in live if truth.covers(pose.imu_ns)]
    places = np.array([pose.position for pose in covered])
    true = np.array([truth.position(pose.imu_ns) for pose in covered])
    early = [seconds_between(covered[0].imu_ns, pose.imu_ns) < _ALIGNED for pose in covered]
    R, t, _ = aligned(places[early], true[early])
    length = np.linalg.norm(np.diff(true, axis=0), axis=1).sum()
    return float(100.0 * np.linalg.norm(R @ places[-1] + t - true[-1]) / length)


def write_report(folder: Path, paths: Sequence[PathFigures]) -> str:
    """Write the figures (CSV) and the report (Markdown), and return the latter."""
    folder.mkdir(parents=True, exist_ok=True)
    write_csv(folder / 'odometry.csv', paths)
    text = markdown_table(
        ('recording', 'read-out [ms]', 'length [m]', 'started [s]', 'live: ATE [m]', 'scale [%]',
         'over 1 m [%]', 'smoothed: ATE', 'scale', 'over 1 m', 'NEES of steps', 'of live places',
         'drift [%]', 'core [%]', 'left out'),
        [(f'{p.name}, {p.seconds:.0f} s', f'{p.readout_ms:.1f}', f'{p.live.length_m:.1f}',
          f'{p.start:.1f}' + (' at rest' if p.at_rest else ''), *_errors(p.live),
          *_errors(p.smoothed), _known(p.step_nees), _known(p.live_nees), f'{p.drift:.3f}',
          f'{p.processor:.1f}',
          f'{p.contradicting} of {p.pairs}' + (f', lost {p.lost} times' if p.lost else ''))
         for p in paths])
    (folder / 'odometry.md').write_text(text, encoding='utf-8')
    return text


def _known(value: float) -> str:
    return '-' if math.isnan(value) else f'{value:.2f}'


def _errors(errors: TrajectoryErrors) -> tuple[str, str, str]:
    return (f'{errors.ate_m:.3f}', f'{100.0 * errors.scale_error:+.2f}',
            f'{errors.relative_translation_error_percent:.2f}')
