"""`rs_relpose benchmark reconstruction`: poses of rows of simulated walks, against the truth.

Tracks without images go through front end and graph, as in `rs_relpose_lab.experiments.odometry`.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from rs_relpose_lab.experiments.harness import markdown_table, write_table
from rs_relpose_lab.experiments.odometry_disturbances import feed_of
from rs_relpose_lab.experiments.trust_runs import walk_of
from rs_relpose_lab.simulation import simulate, Simulation, SimulationConfig
from rs_relpose_ros.config.settings import Parameters
from rs_relpose_ros.errors import InputError
from rs_relpose_ros.geometry import Array
from rs_relpose_ros.geometry.timing import NANOSECONDS
from rs_relpose_ros.odometry.estimator import OdometryEstimator
from rs_relpose_ros.odometry.offline import aligned, follow, row_trajectory
from rs_relpose_ros.odometry.rows import RowTrajectory
from rs_relpose_ros.odometry.states import Base

Times = NDArray[np.int64]

# Interval of the rotations that are compared [s]. [chosen: longer than between keyframes]
_WITHIN = 0.5
# Frames of a walk that are rendered, four times each. [chosen: to limit the time of rendering]
_RENDERED = 4
# Least motion over the rows of these frames [px]. [chosen: less does not show in gray values]
_LEAST_MOTION = 3.0
# Depth at which this motion is taken [m]. [chosen: near objects of the scenes]
_DEPTH = 4.0


@dataclass(frozen=True, slots=True)
class RowMetrics:
    """Poses of a walk."""

    name: str
    readout_ms: float
    keyframes: float  # rms error of positions after rigid alignment [m]
    first: float  # that of the rows by this alignment
    middle: float
    last: float
    turned: float  # largest rms error of the rows' rotations within 0.5 s [deg]
    rendered: float  # gray difference with linear poses of the rows, by that with the middle one
    rendered_on_path: float  # the same with the alignment of the whole path


class _Linear(NamedTuple):
    """A trajectory between two poses, as the renderer uses it."""

    begin: float
    end: float
    R: Array  # (2, 3, 3)
    positions: Array  # (2, 3)

    def poses(self, times: Array) -> tuple[Array, Array]:
        """Positions and orientations at times."""
        since = np.atleast_1d(times) - self.begin
        share = (since / (self.end - self.begin))[:, None]
        first = Rotation.from_matrix(self.R[0])
        last = Rotation.from_matrix(self.R[1])
        turn = (first.inv() * last).as_rotvec()
        turned = first * Rotation.from_rotvec(share * turn)
        way = self.positions[1] - self.positions[0]
        return self.positions[0] + share * way, turned.as_matrix()


def on_walk(config: SimulationConfig) -> RowMetrics:
    """Poses of rows of a simulated recording."""
    simulation = simulate(config)
    recording = walk_of(simulation, np.random.default_rng(config.seed))
    parameters = Parameters.from_mapping(recording.configured.values)
    feed = feed_of(recording)
    estimator = OdometryEstimator(parameters, keep=True)
    follow(estimator, feed.pairs, feed.samples)
    paths = estimator.smoothed_paths()
    if not paths:
        raise InputError(f'{recording.source.name}: odometry did not start')
    rows = row_trajectory(paths, estimator.base or Base(), parameters, recording.samples)
    keyframes = rows.keyframes_ns[:, 1]
    error, A, t = _position_error(simulation, rows, keyframes)
    span = round((config.height - 1) / config.height * config.readout_time * NANOSECONDS)
    firsts = np.array([simulation.reference_ns(k) for k in range(config.frame_count)])
    firsts = firsts[rows.covers(firsts) & rows.covers(firsts + span)]
    times = [firsts + part for part in (0, span // 2, span)]
    first, middle, last = (_position_error(simulation, rows, at)[0] / error for at in times)
    turned = max(_rotation_error(simulation, rows, at) for at in times)
    return RowMetrics(
        recording.source.name,
        1e3 * config.readout_time,
        error,
        first,
        middle,
        last,
        turned,
        *_rendered(simulation, rows, times, A, t),
    )


def _position_error(
    simulation: Simulation, rows: RowTrajectory, times: Times
) -> tuple[float, Array, Array]:
    """Root mean square [m] after rigid alignment, with its rotation and translation."""
    _, p = rows.pose(times)
    true = simulation.states(times).position
    A, t, _ = aligned(p, true)
    squares = ((p @ A.T + t - true) ** 2).sum(axis=1)
    return float(np.sqrt(squares.mean())), A, t


def _rotation_error(simulation: Simulation, rows: RowTrajectory, times: Times) -> float:
    """Root mean square [deg] of rotations over up to half a second."""
    R = rows.pose(times)[0]
    true = simulation.states(times).R_world_cam
    later = np.searchsorted(times, times + round(_WITHIN * NANOSECONDS)) - 1
    steps = [np.einsum('nji,njk->nik', one, one[later]) for one in (R, true)]
    differences = np.einsum('nji,njk->nik', *steps)
    angles = Rotation.from_matrix(differences).magnitude()
    return float(np.degrees(np.sqrt((angles**2).mean())))


def _rendered(
    simulation: Simulation, rows: RowTrajectory, times: Sequence[Times], A: Array, t: Array
) -> tuple[float, float]:
    """Ratios of the gray differences, of frames with enough motion."""
    sums = np.zeros((2, 2))
    config = simulation.config
    stamps = np.column_stack(times)
    truth = simulation.states(stamps.ravel())
    R_true = truth.R_world_cam.reshape(*stamps.shape, 3, 3)
    p_true = truth.position.reshape(*stamps.shape, 3)
    first_to_last = np.einsum('nji,njk->nik', R_true[:, 0], R_true[:, 2])
    turns = Rotation.from_matrix(first_to_last).magnitude()
    ways = np.linalg.norm(p_true[:, 2] - p_true[:, 0], axis=1)
    motions = config.fx * (turns + ways / _DEPTH)
    moving = np.flatnonzero(motions > _LEAST_MOTION)
    order = np.random.default_rng(config.seed).permutation(moving)
    for k in order[:_RENDERED]:
        begin, _, end = (simulation.seconds(int(at)) for at in stamps[k])
        R, p = rows.pose(stamps[k])
        true = simulation.renderer.render(begin)
        own = R_true[k, 1] @ R[1].T
        at_middle_row = (own, p_true[k, 1] - own @ p[1])
        on_whole_path = (A, t)
        for i, (turn, move) in enumerate((at_middle_row, on_whole_path)):
            for j, places in enumerate(([0, 2], [1, 1])):
                fake: Any = _Linear(begin, end, turn @ R[places], p[places] @ turn.T + move)
                drawn = replace(simulation.renderer, trajectory=fake).render(begin)
                sums[i, j] += np.abs(drawn - true).mean()
    ratios = sums[:, 0] / sums[:, 1]
    return float(ratios[0]), float(ratios[1])


def write_report(folder: Path, walks: Sequence[RowMetrics]) -> str:
    """Write the metrics (CSV) and the report (Markdown), and return the latter."""
    return write_table(
        folder,
        'reconstruction',
        walks,
        markdown_table(
            (
                'walk',
                'readout [ms]',
                'keyframes [mm]',
                'first row by that',
                'middle',
                'last',
                'rotation [deg]',
                'rendered',
                'on the path',
            ),
            [
                (
                    one.name,
                    f'{one.readout_ms:.1f}',
                    f'{1e3 * one.keyframes:.1f}',
                    f'{one.first:.2f}',
                    f'{one.middle:.2f}',
                    f'{one.last:.2f}',
                    f'{one.turned:.4f}',
                    f'{one.rendered:.2f}',
                    f'{one.rendered_on_path:.2f}',
                )
                for one in walks
            ],
        ),
    )
