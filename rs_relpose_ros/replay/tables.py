"""The tables that a replay writes: relative poses, and errors against the truth."""

from __future__ import annotations

import csv
import math
from pathlib import Path
from types import TracebackType

import numpy as np
from numpy.typing import NDArray

from rs_relpose_ros.estimator.result import Status
from rs_relpose_ros.messages.outgoing import quat_xyzw
from rs_relpose_ros.replay.record import PairRecord, rotation_sigmas, translation_sigmas

RELATIVE_POSE_COLUMNS = (
    'reference_stamp_ns', 'stamp_ns', 'tx', 'ty', 'tz', 'qx', 'qy', 'qz', 'qw', 'sigma_t1',
    'sigma_t2', 'sigma_rx', 'sigma_ry', 'sigma_rz', 'inliers', 'matches', 'model', 'status')

ERROR_COLUMNS = (
    'reference_stamp_ns', 'stamp_ns', 'interval_s', 'baseline_m', 'rotation_deg',
    'rotation_error_deg', 'translation_error_deg', 'status')


class TableWriter:
    """Writes a CSV file row by row; use it as a context manager."""

    def __init__(self, path: Path, columns: tuple[str, ...]) -> None:
        self._columns = columns
        self._file = path.open('w', newline='', encoding='ascii')
        self._writer = csv.writer(self._file, lineterminator='\n')
        self._writer.writerow(columns)

    def __enter__(self) -> TableWriter:
        return self

    def __exit__(self, kind: type[BaseException] | None, error: BaseException | None,
                 traceback: TracebackType | None) -> None:
        self._file.close()

    def write(self, cells: list[str]) -> None:
        """Append a row; there and whole even if the process ends after it."""
        assert len(cells) == len(self._columns)
        self._writer.writerow(cells)
        self._file.flush()


def relative_pose_cells(record: PairRecord) -> list[str]:
    """Row of `RELATIVE_POSE_COLUMNS`: a pair without a pose has its status and empty figures.

    Floats are written so that they read back bit-equal.
    """
    stamps = [str(record.reference_stamp_ns), str(record.stamp_ns)]
    if record.status is not Status.OK:
        return [*stamps, *[''] * 13, str(record.matches), '', record.status.value]
    return [*stamps, *pose_cells(record.R, record.t, record.covariance), str(record.inliers),
            str(record.matches), record.model, record.status.value]


def pose_cells(R: NDArray[np.float64], t: NDArray[np.float64],
               covariance: NDArray[np.float64]) -> list[str]:
    """The twelve cells from tx to sigma_rz."""
    figures = [*t, *quat_xyzw(R), *translation_sigmas(covariance), *rotation_sigmas(covariance)]
    return [number(value) for value in figures]


def error_cells(record: PairRecord) -> list[str]:
    """Row of `ERROR_COLUMNS`; empty figures where the truth does not reach or nothing is known."""
    errors = record.errors
    if errors is None:
        figures = [''] * 4
    else:
        # PURE_ROTATION knows its rotation, but is no pose.
        figures = [number(errors.baseline), number(errors.rotation),
                   number(errors.rotation_error), number(errors.translation_error)]
    return [str(record.reference_stamp_ns), str(record.stamp_ns), number(record.interval),
            *figures, record.status.value]


def number(value: float) -> str:
    """Shortest text that reads back as the same float; empty for NaN."""
    return '' if math.isnan(value) else repr(float(value))
