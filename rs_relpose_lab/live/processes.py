"""Processes of a live run: node, player, recorder, each with a log."""

from __future__ import annotations

from collections.abc import Mapping
import os
from pathlib import Path
import signal
import subprocess
import sys

from rs_relpose_ros.errors import RsRelposeError


class LiveRunError(RsRelposeError):
    """A process failed or did not become ready; the text says which, with the end of its log."""


def private_graph() -> dict[str, str]:
    """Environment of a ROS graph that only this process and its children take part in.

    Nothing leaves this machine. The domain id is below 102, as the DDS ports of higher ones run
    into those of other programs.
    """
    return {'ROS_AUTOMATIC_DISCOVERY_RANGE': 'LOCALHOST',
            'ROS_DOMAIN_ID': str(1 + os.getpid() % 100)}


class Process:
    """A Python process of the project with its log file.

    Parameters
    ----------
    folder : Path
        Directory of the log.
    name : str
        For the log and for error messages.
    module, *arguments : str
        What ``python -m`` runs.
    environment : mapping, optional
        Variables to add.
    """

    def __init__(self, folder: Path, name: str, module: str, *arguments: str,
                 environment: Mapping[str, str] | None = None) -> None:
        self.name, self.log = name, folder / f'{name}.log'
        variables = {**os.environ, **private_graph(), 'PYTHONUNBUFFERED': '1',
                     'AMENT_PREFIX_PATH': os.environ.get('AMENT_PREFIX_PATH', sys.prefix),
                     **(environment or {})}
        with self.log.open('wb') as log:
            self._process = subprocess.Popen(
                [sys.executable, '-m', module, *arguments], env=variables, stdout=log,
                stderr=subprocess.STDOUT)

    def __enter__(self) -> Process:
        return self

    def __exit__(self, *_: object) -> None:
        if self._process.poll() is None:
            self._process.kill()
            self._process.wait()

    @property
    def pid(self) -> int:
        """Its process id."""
        return self._process.pid

    @property
    def text(self) -> str:
        """What it has said so far."""
        return self.log.read_text(encoding='utf-8', errors='replace')

    def ended(self) -> bool:
        """Whether it has ended; raises if with an error."""
        self.check()
        return self._process.poll() is not None

    def check(self) -> None:
        """Raise if it has ended with an error."""
        if self._process.poll() not in (None, 0):
            raise self._failure(f'ended with code {self._process.returncode}')

    def wait(self, timeout: float) -> None:
        """Wait for its end."""
        try:
            self._process.wait(timeout)
        except subprocess.TimeoutExpired:
            raise self._failure(f'did not end within {timeout:g} s') from None
        self.check()

    def stop(self) -> None:
        """Ask it to end, as Ctrl-C does."""
        self._process.send_signal(signal.SIGINT)
        self.wait(15.0)

    def _failure(self, what: str) -> LiveRunError:
        tail = '\n'.join(self.text.splitlines()[-15:])
        return LiveRunError(f'{self.name} {what}; the end of {self.log}:\n{tail}')
