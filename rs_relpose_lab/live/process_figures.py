"""Processor time and memory of another process, as Linux tells them."""

from __future__ import annotations

from dataclasses import dataclass
import os
from pathlib import Path
import time

_TICK = 1.0 / os.sysconf('SC_CLK_TCK')


@dataclass(frozen=True, slots=True)
class ProcessFigures:
    """A process at an instant.

    `time_ns`: on the monotonic clock.
    `cpu`, `cpu_main`: processor time since its start [s]: of all threads, and of the first one.
    `resident`, `private`: memory [MB]: all that is resident, and without what is shared with
        others (the transport's segments).
    """

    time_ns: int
    cpu: float
    cpu_main: float
    resident: float
    private: float


def process_figures(pid: int) -> ProcessFigures:
    """Figures of a running process."""
    folder = Path('/proc') / str(pid)
    memory = dict(line.split(':', 1) for line in (folder / 'status').read_text().splitlines())

    def megabytes(name: str) -> float:
        return int(memory[name].split()[0]) / 1024.0

    return ProcessFigures(time.monotonic_ns(), _cpu(folder / 'stat'),
                          _cpu(folder / 'task' / str(pid) / 'stat'), megabytes('VmRSS'),
                          megabytes('RssAnon'))


def _cpu(path: Path) -> float:
    # The name, in parentheses, may hold anything.
    fields = path.read_text().rpartition(')')[2].split()
    return (int(fields[11]) + int(fields[12])) * _TICK
