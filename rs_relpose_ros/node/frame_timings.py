"""Files of a line per frame: which ones were processed, and how long each of them took."""

from __future__ import annotations

from pathlib import Path
import time
from typing import TextIO

from rs_relpose_ros.errors import InputError
from rs_relpose_ros.front_end.front_end import FrameProcessed
from rs_relpose_ros.front_end.pair import PairResult

COLUMNS = ('stamp_ns', 'ready_ns', 'taken_ns', 'done_ns', 'cpu_ns', 'outcome')


def opened(parameter: str, path: str) -> TextIO:
    """File of the parameter of this name, written line by line; InputError where that fails."""
    try:
        return Path(path).open('w', buffering=1, encoding='ascii')
    except OSError as error:
        raise InputError(f'{parameter} {path} cannot be written: {error.strerror}') from error


class FrameTimings:
    """Writes the file of the parameter `timings_file`; to be used by the worker thread.

    Of each frame: its stamp; on the monotonic clock when it was `ready` and `taken` (as in
    `ReadyFrame`) and `done` (after publication); processor time that the thread spent since the
    frame before; the status of the pair that it closed, or ``none``.
    """

    def __init__(self, path: str) -> None:
        self._file = opened('timings_file', path)
        self._file.write(','.join(COLUMNS) + '\n')
        self._spent_ns = 0

    def start(self) -> None:
        """What the thread did until now belongs to no frame."""
        self._spent_ns = time.thread_time_ns()

    def add(self, frame: FrameProcessed[PairResult]) -> None:
        """Write a frame; call it right after its result was published."""
        done_ns, spent_ns = time.monotonic_ns(), time.thread_time_ns()
        outcome = 'none' if frame.result is None else frame.result.pose.status.value
        self._file.write(f'{frame.stamp_ns},{frame.ready_ns},{frame.taken_ns},{done_ns},'
                         f'{spent_ns - self._spent_ns},{outcome}\n')
        self._spent_ns = spent_ns

    def close(self) -> None:
        """No more frames."""
        self._file.close()
