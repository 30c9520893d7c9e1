"""Processes of a live run, the nodes and a player: start, log, wait, signals, end, load."""

from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager, ExitStack
from dataclasses import dataclass
import os
from pathlib import Path
import signal
import subprocess
import sys
import tempfile
import time
from types import TracebackType
from typing import BinaryIO, Self, TypeVar

from rs_relpose_ros.errors import RsRelposeError

Value = TypeVar('Value')

# Longest wait [s] for anything: compiling all kernels on a busy machine takes minutes.
PATIENCE = 600.0
# The node ends within a second of a signal; a busy machine may take longer [s].
_END_TIMEOUT = 30.0


class LiveRunError(RsRelposeError):
    """A process failed or was not ready in time; the text names it and ends with its output."""


class Process:
    """A Python process with a log. Leaving the ``with`` block kills it if it still runs.

    `*arguments`: of the interpreter: a file, or ``-m`` and a module, and its arguments.
    `log`: file of standard output and error; a temporary one by default.
    """

    def __init__(self, *arguments: str, log: Path | None = None) -> None:
        self._name = arguments[arguments[0] == '-m']
        # A file, as a pipe without reader would block the process.
        self._log: BinaryIO = log.open('w+b') if log else tempfile.TemporaryFile()  # noqa: SIM115
        self._process = subprocess.Popen(
            [sys.executable, *arguments],
            stdout=self._log,
            stderr=subprocess.STDOUT,
            env={**os.environ, 'PYTHONUNBUFFERED': '1'},
        )

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        traceback: TracebackType | None,
    ) -> None:
        if self._process.poll() is None:
            self._process.kill()
            self._process.wait()
        if error is not None:
            error.add_note(f'--- output of {self._name}:\n{self.output}')
        self._log.close()

    @property
    def pid(self) -> int:
        """Its process id."""
        return self._process.pid

    @property
    def output(self) -> str:
        """What it has written so far."""
        return os.pread(self._log.fileno(), 1 << 22, 0).decode(errors='replace')

    def ended(self) -> bool:
        """Whether it has ended well; raises where it has failed."""
        if self._process.poll() not in (None, 0):
            raise self._failure(f'ended with code {self._process.returncode}')
        return self._process.returncode is not None

    def wait(self, timeout: float = PATIENCE) -> int:
        """Wait for its end; its exit code."""
        try:
            return self._process.wait(timeout)
        except subprocess.TimeoutExpired:
            raise self._failure(f'did not end within {timeout:g} s') from None

    def wait_for(self, text: str) -> None:
        """Wait until it has written `text`."""

        def written() -> bool:
            ended = self._process.poll() is not None
            if ended and text not in self.output:
                raise self._failure(f'ended before it wrote {text!r}')
            return text in self.output

        wait_until(written, f'{text!r} in the output of {self._name}')

    def signal(self, number: signal.Signals, *, every: float = _END_TIMEOUT) -> tuple[int, float]:
        """Send a signal, again every so many seconds; exit code and seconds until the end."""
        started = time.monotonic()
        while (seconds := time.monotonic() - started) < _END_TIMEOUT:
            self._process.send_signal(number)
            try:
                return self._process.wait(every), time.monotonic() - started
            except subprocess.TimeoutExpired:
                continue
        raise self._failure(f'did not end within {seconds:g} s of {number.name}')

    def stop(self) -> None:
        """End it as Ctrl-C does; raises where it fails."""
        self.signal(signal.SIGINT)
        self.ended()

    def _failure(self, what: str) -> LiveRunError:
        tail = '\n'.join(self.output.splitlines()[-15:])
        return LiveRunError(f'{self._name} {what}; the end of its output:\n{tail}')


def node_process(
    parameter_file: Path | None = None,
    *,
    remap: Mapping[str, str] | None = None,
    parameters: Mapping[str, object] | None = None,
    log: Path | None = None,
    node: str = 'relpose_node',
) -> Process:
    """Start a node; `remap` takes topics, ``__ns`` and ``__node``."""
    words = [] if parameter_file is None else ['--params-file', str(parameter_file)]
    for name, value in (parameters or {}).items():
        words += ['-p', f'{name}:={value}']
    for source, target in (remap or {}).items():
        words += ['-r', f'{source}:={target}']
    return Process('-m', 'rs_relpose_ros.nodes.start', node, '--ros-args', *words, log=log)


def player_process(bag: Path, *options: str, log: Path | None = None) -> Process:
    """Start a player of `bag`, which waits until the node subscribes."""
    return Process(
        '-m',
        'rs_relpose_lab.live.player',
        str(bag),
        '--wait-for-subscribers',
        str(PATIENCE),
        *options,
        log=log,
    )


def wait_until(
    condition: Callable[[], Value], what: str, *processes: Process, timeout: float = PATIENCE
) -> Value:
    """Poll until the value is true, and return it; LiveRunError where a process fails meanwhile.

    `what`: for the error message.
    """
    deadline = time.monotonic() + timeout
    while not (value := condition()):
        for process in processes:
            process.ended()
        if time.monotonic() > deadline:
            raise LiveRunError(f'{what} did not happen within {timeout:g} s')
        time.sleep(0.01)
    return value


def wait_until_quiet(count: Callable[[], int], seconds: float, process: Process) -> None:
    """Wait until `count()` has stayed the same for so many seconds."""
    known = count()
    since = time.monotonic()
    while time.monotonic() - since < seconds:
        process.ended()
        if count() != known:
            known = count()
            since = time.monotonic()
        time.sleep(0.05)


@contextmanager
def core_for(neighbours: int | None) -> Iterator[Callable[[Process], None]]:
    """Keep one core for the process that the yielded function gets, and `neighbours` on it.

    The neighbours are busy all the time, at the same priority: two leave a third of the core to
    one thread. This process and those it starts have the other cores. None keeps no core.
    """
    if neighbours is None:
        yield lambda process: None
        return
    cores = os.sched_getaffinity(0)
    if len(cores) < 2:
        raise LiveRunError('a core of its own for the node needs a machine with two cores')
    core = max(cores)
    busy = [Process('-c', 'while True: pass') for _ in range(neighbours)]
    with ExitStack() as stack:
        for one in busy:
            stack.enter_context(one)
            os.sched_setaffinity(one.pid, {core})
        os.sched_setaffinity(0, cores - {core})
        try:
            # Threads that a process starts later have the cores of their process.
            yield lambda process: os.sched_setaffinity(process.pid, {core})
        finally:
            os.sched_setaffinity(0, cores)


@dataclass(frozen=True, slots=True)
class ProcessMetrics:
    """Processor time and memory of a process at a time, from /proc."""

    time_ns: int
    cpu: float  # [s] since its start, of all threads
    cpu_main: float  # [s] of the first thread
    resident: float  # [MB]
    private: float  # [MB] without what is shared (the transport's segments)


def process_metrics(pid: int) -> ProcessMetrics:
    """Metrics of a running process."""
    folder = Path('/proc') / str(pid)
    memory = dict(line.split(':', 1) for line in (folder / 'status').read_text().splitlines())

    def megabytes(name: str) -> float:
        return int(memory[name].split()[0]) / 1024.0

    return ProcessMetrics(
        time.monotonic_ns(),
        _cpu(folder / 'stat'),
        _cpu(folder / 'task' / str(pid) / 'stat'),
        megabytes('VmRSS'),
        megabytes('RssAnon'),
    )


def _cpu(path: Path) -> float:
    # The name, in parentheses, may hold anything.
    fields = path.read_text().rpartition(')')[2].split()
    return (int(fields[11]) + int(fields[12])) / os.sysconf('SC_CLK_TCK')
