"""Trajectories: written as TUM files, and against the truth."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from rs_relpose_ros.messages.outgoing import quat_xyzw
from rs_relpose_ros.odometry.odometry import Odometry
from rs_relpose_ros.replay.truth import TrueTrajectory

Array = NDArray[np.float64]

# Path lengths over which relative errors are taken [m].
_SEGMENT = 1.0


@dataclass(frozen=True, slots=True)
class TrajectoryErrors:
    """Of positions, after the rigid alignment that fits best, without scale."""

    ate_m: float   # root mean square distance
    scale_error: float   # scale of the similarity that fits best, less 1
    relative_translation_error_percent: float   # median over stretches of 1 m, of their length
    length_m: float   # of the true path


class AgainstTruth(NamedTuple):
    """Poses that the truth covers: positions (N, 3) as aligned and true, at instants [ns]."""

    errors: TrajectoryErrors
    imu_ns: Sequence[int]
    positions: Array
    truth: Array


def write_tum(path: Path, trajectory: Sequence[Odometry]) -> None:
    """Lines ``seconds x y z qx qy qz qw``, seconds being those of the stamps."""
    with path.open('w', encoding='ascii') as file:
        for pose in trajectory:
            figures = [*pose.position, *quat_xyzw(pose.R)]
            file.write(f'{pose.stamp_ns // 10**9}.{pose.stamp_ns % 10**9:09d} '
                       + ' '.join(f'{value:.9f}' for value in figures) + '\n')


def aligned(positions: Array, truth: Array) -> tuple[Array, Array, float]:
    """R (3, 3), t (3,) of ``truth = R positions + t``, and the best scale of the positions.

    S. Umeyama, *Least-squares estimation of transformation parameters between two point
    patterns*, PAMI 13(4), 1991.
    """
    mean, true_mean = positions.mean(axis=0), truth.mean(axis=0)
    a, b = positions - mean, truth - true_mean
    U, S, Vt = np.linalg.svd(b.T @ a)
    D = np.diag([1.0, 1.0, np.sign(np.linalg.det(U @ Vt))])
    R = U @ D @ Vt
    scale = float((S * np.diag(D)).sum() / (a**2).sum())
    return R, true_mean - R @ mean, scale


def against_truth(trajectory: Sequence[Odometry], truth: TrueTrajectory) -> AgainstTruth | None:
    """The poses that the truth covers, beside it; None where it covers fewer than 4."""
    covered = [pose for pose in trajectory if truth.covers(pose.imu_ns)]
    if len(covered) < 4:
        return None
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
            told = pose.R.T @ (covered[j].position - pose.position)
            relative.append(float(np.linalg.norm(told - known[1])) / float(way[j] - way[i]))
    errors = TrajectoryErrors(
        float(np.sqrt(((moved - true) ** 2).sum(axis=1).mean())), scale - 1.0,
        100.0 * float(np.median(relative)) if relative else float('nan'), float(way[-1]))
    return AgainstTruth(errors, [pose.imu_ns for pose in covered], moved, true)
