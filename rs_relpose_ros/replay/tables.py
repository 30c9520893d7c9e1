"""What is kept of a pair, without its matches and images, and its rows in the tables."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
import csv
from dataclasses import dataclass
import math
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from rs_relpose_ros.estimator.result import RelativePose, Status
from rs_relpose_ros.front_end.pair import PAIR_FIGURES, PairResult
from rs_relpose_ros.messages.outgoing import published_covariance, quat_xyzw
from rs_relpose_ros.messages.pair_status import number
from rs_relpose_ros.replay.truth import PairErrors, TrueTrajectory

Array = NDArray[np.float64]

RELATIVE_POSE_COLUMNS = (
    'reference_stamp_ns', 'stamp_ns', 'tx', 'ty', 'tz', 'qx', 'qy', 'qz', 'qw', 'sigma_t1',
    'sigma_t2', 'sigma_rx', 'sigma_ry', 'sigma_rz', 'inliers', 'matches', 'model', 'status',
    'baseline_m', 'baseline_log_sigma')

ERROR_COLUMNS = (
    'reference_stamp_ns', 'stamp_ns', 'interval_s', 'baseline_m', 'rotation_deg',
    'rotation_error_deg', 'translation_error_deg', 'status')


@dataclass(frozen=True, slots=True, eq=False)
class PairRecord:
    """Fields of a `PairResult`, values of `PAIR_FIGURES` by name, errors (None without truth)."""

    reference_stamp_ns: int
    stamp_ns: int
    reference_ns1: int
    reference_ns2: int
    pose: RelativePose
    gyro_rotation: Array | None
    figures: Mapping[str, float]
    errors: PairErrors | None

    @property
    def status(self) -> Status:
        """Status of the pose."""
        return self.pose.status


def pair_record(result: PairResult, truth: TrueTrajectory | None = None) -> PairRecord:
    """Figures of a pair, and its errors where there is a truth."""
    pose, ns1, ns2 = result.pose, result.reference_ns1, result.reference_ns2
    return PairRecord(
        result.reference_stamp_ns, result.stamp_ns, ns1, ns2, pose, result.gyro_rotation,
        {figure.name: figure.of(result) for figure in PAIR_FIGURES},
        None if truth is None else truth.errors(pose.R, pose.t, ns1, ns2))


def translation_sigmas(covariance: Array) -> tuple[float, float]:
    """1 sigma of the translation direction [rad], larger and smaller axis.

    The covariance (6, 6) of (dt, dtheta) has no variance along t, so two of three axes remain. NaN
    where there is no translation.
    """
    if np.isnan(covariance[0, 0]):
        return math.nan, math.nan
    variances = np.linalg.eigvalsh(covariance[:3, :3])
    larger, smaller = np.sqrt(np.maximum(variances[[2, 1]], 0.0))
    return float(larger), float(smaller)


def rotation_sigmas(covariance: Array) -> tuple[float, float, float]:
    """1 sigma of the rotation about the axes x, y, z of camera 1 [rad]."""
    x, y, z = np.sqrt(np.maximum(np.diag(covariance)[3:], 0.0))
    return float(x), float(y), float(z)


@contextmanager
def table_writer(path: Path, columns: tuple[str, ...]) -> Iterator[Callable[[list[str]], None]]:
    """A CSV file; gives what appends a row, there and whole even if the process ends after it."""
    with path.open('w', newline='', encoding='ascii') as file:
        writer = csv.writer(file, lineterminator='\n')

        def write(cells: list[str]) -> None:
            assert len(cells) == len(columns)
            writer.writerow(cells)
            file.flush()

        write(list(columns))
        yield write


def relative_pose_cells(record: PairRecord) -> list[str]:
    """Row of `RELATIVE_POSE_COLUMNS`: what is not known of a pair is empty.

    A pair without a translation may have a rotation; one without either has its status alone.
    Floats are written so that they read back bit-equal.
    """
    pose, matches = record.pose, str(record.figures['matches'])
    stamps = [str(record.reference_stamp_ns), str(record.stamp_ns)]
    if not pose.rotation_known:
        return [*stamps, *[''] * 13, matches, '', pose.status.value, '', '']
    # As it is published: of the whole, or of the rotation alone.
    covariance, known = np.full((6, 6), math.nan), slice(0 if pose else 3, 6)
    published = published_covariance(pose.covariance[known, known])
    covariance[known, known] = published.reshape(covariance[known, known].shape)
    figures = [*pose.t, *quat_xyzw(pose.R), *translation_sigmas(covariance),
               *rotation_sigmas(covariance)]
    return [*stamps, *map(number, figures), str(record.figures['inliers']), matches, pose.model,
            pose.status.value, number(pose.baseline), number(pose.baseline_log_sigma)]


def error_cells(record: PairRecord) -> list[str]:
    """Row of `ERROR_COLUMNS`; empty figures where the truth does not reach or nothing is known."""
    errors = record.errors
    # PURE_ROTATION knows its rotation, but is no pose.
    figures = [''] * 4 if errors is None else [
        number(errors.baseline), number(errors.rotation), number(errors.rotation_error),
        number(errors.translation_error)]
    return [str(record.reference_stamp_ns), str(record.stamp_ns),
            number(record.figures['interval_s']), *figures, record.status.value]
