"""Records of pairs, their rows in the tables, and their statistics for ``summary.json``."""

from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager, ExitStack
import csv
from dataclasses import dataclass, field
import math
from pathlib import Path
from typing import Any, NamedTuple, Self

import numpy as np

from rs_relpose_ros.estimator.result import RelativePose
from rs_relpose_ros.geometry import Array
from rs_relpose_ros.messages.incoming import ReasonCounts
from rs_relpose_ros.messages.outgoing import number_text, published_covariance, quat_xyzw
from rs_relpose_ros.offline.truth import median_and_p90, PairErrors, TrueTrajectory
from rs_relpose_ros.output_files import written
from rs_relpose_ros.pipeline.pair import PAIR_METRICS, PairResult


@dataclass(frozen=True, slots=True, eq=False)
class PairRecord:
    """A pair without its matches and images."""

    reference_stamp_ns: int
    stamp_ns: int
    pose: RelativePose
    # The rest is unknown for a pair that was not estimated.
    reference_ns1: int = 0  # as in `PairResult`
    reference_ns2: int = 0
    gyro_rotation: Array | None = None
    metrics: Mapping[str, float] = field(default_factory=dict)  # `PAIR_METRICS` by name
    errors: PairErrors | None = None  # also None without ground truth

    @classmethod
    def of(cls, result: PairResult, truth: TrueTrajectory | None = None) -> Self:
        """Record of a pair, with its errors if there is ground truth."""
        pose = result.pose
        ns1 = result.reference_ns1
        ns2 = result.reference_ns2
        return cls(
            result.reference_stamp_ns,
            result.stamp_ns,
            pose,
            ns1,
            ns2,
            result.gyro_rotation,
            {metric.name: metric.of(result) for metric in PAIR_METRICS},
            None if truth is None else truth.errors(pose.R, pose.t, ns1, ns2),
        )


class Table(NamedTuple):
    """A CSV file, its columns, and the row of a record; no row for None."""

    file: str
    columns: tuple[str, ...]
    row: Callable[[PairRecord], list[str] | None]


def _pose_row(record: PairRecord) -> list[str]:
    """Unknown values are empty: a rotation may be known without a translation.

    Floats are written so that they read back bit-equal.
    """
    pose = record.pose
    matches = number_text(record.metrics.get('matches', math.nan))
    stamps = [str(record.reference_stamp_ns), str(record.stamp_ns)]
    if not pose.rotation_known:
        return [*stamps, *[''] * 13, matches, '', pose.status.value, '', '']
    # The sigmas are those of the published covariance: of the pose, or of the rotation alone.
    covariance = np.full((6, 6), math.nan)
    known = slice(0 if pose else 3, 6)
    published = published_covariance(pose.covariance[known, known])
    covariance[known, known] = published.reshape(covariance[known, known].shape)
    values = [
        *pose.t,
        *quat_xyzw(pose.R),
        *translation_sigmas(covariance),
        *rotation_sigmas(covariance),
    ]
    return [
        *stamps,
        *map(number_text, values),
        number_text(record.metrics['inliers']),
        matches,
        pose.diagnostics.model,
        pose.status.value,
        number_text(pose.baseline),
        number_text(pose.baseline_log_sigma),
    ]


# relative_poses.csv has a row for each pair. [derived: interface]
POSES = Table(
    'relative_poses.csv',
    (
        'reference_stamp_ns',
        'stamp_ns',
        'tx',
        'ty',
        'tz',
        'qx',
        'qy',
        'qz',
        'qw',
        'sigma_t1',
        'sigma_t2',
        'sigma_rx',
        'sigma_ry',
        'sigma_rz',
        'inliers',
        'matches',
        'model',
        'status',
        'baseline_m',
        'baseline_log_sigma',
    ),
    _pose_row,
)


def _error_row(record: PairRecord) -> list[str] | None:
    """No row for a pair that was not estimated; empty errors outside of the ground truth."""
    if not record.metrics:
        return None
    errors = record.errors
    values = [''] * 4
    if errors is not None:
        known = errors.baseline, errors.rotation, errors.rotation_error, errors.translation_error
        values = [number_text(value) for value in known]
    return [
        str(record.reference_stamp_ns),
        str(record.stamp_ns),
        number_text(record.metrics['interval_s']),
        *values,
        record.pose.status.value,
    ]


# errors.csv has a row for each pair with a true pose. [derived: interface]
ERRORS = Table(
    'errors.csv',
    (
        'reference_stamp_ns',
        'stamp_ns',
        'interval_s',
        'baseline_m',
        'rotation_deg',
        'rotation_error_deg',
        'translation_error_deg',
        'status',
    ),
    _error_row,
)


@contextmanager
def table_writer(folder: Path, tables: Sequence[Table]) -> Iterator[Callable[[PairRecord], None]]:
    """Create files of tables, each row complete; the result appends a record to all of them."""
    with ExitStack() as stack:
        writers = [
            csv.writer(stack.enter_context(written(folder / table.file)), lineterminator='\n')
            for table in tables
        ]

        def write(record: PairRecord) -> None:
            for table, writer in zip(tables, writers, strict=True):
                row = table.row(record)
                if row is not None:
                    assert len(row) == len(table.columns)
                    writer.writerow(row)

        for table, writer in zip(tables, writers, strict=True):
            writer.writerow(table.columns)
        yield write


def translation_sigmas(covariance: Array) -> tuple[float, float]:
    """1 sigma of the translation direction [rad], larger and smaller axis; NaN without one.

    The covariance (6, 6) of (dt, dtheta) has no variance along t, so two of three axes remain.
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


def baselines(answered: Sequence[PairRecord]) -> dict[str, Any]:
    """Number of poses with a metric baseline, its median sigma, and the reasons of the others."""
    known = []
    reasons = ReasonCounts()
    for record in answered:
        if record.pose.diagnostics.baseline_reason:
            reasons.add(record.pose.diagnostics.baseline_reason)
        else:
            known.append(record.pose.baseline_log_sigma)
    return {
        'known': len(known),
        'log_sigma_median': median_or_none(known),
        'not_known': reasons.most_common(),
    }


def errors_against_truth(answered: Sequence[PairRecord]) -> dict[str, Any] | None:
    """Medians and 90th percentiles of the errors; None without ground truth."""
    errors = [record.errors for record in answered if record.errors is not None]
    if not errors:
        return None
    rotation, rotation_p90 = median_and_p90([error.rotation_error for error in errors])
    translation, translation_p90 = median_and_p90([error.translation_error for error in errors])
    return {
        'pairs': len(errors),
        'rotation_median_deg': _finite(rotation),
        'rotation_p90_deg': _finite(rotation_p90),
        'translation_median_deg': _finite(translation),
        'translation_p90_deg': _finite(translation_p90),
        'baseline_median_m': median_or_none([error.baseline for error in errors]),
    }


def median_or_none(values: Sequence[float]) -> float | None:
    """Median of the finite values; None without any."""
    return _finite(median_and_p90(values)[0])


def _finite(value: float) -> float | None:
    return float(value) if math.isfinite(value) else None
