"""Log lines once per cause: the first at once, repetitions now and then with their number."""

from __future__ import annotations

from collections.abc import Callable
import threading
import time

from rs_relpose_ros.messages.causes import cause_of, MOST_CAUSES


class CauseLog:
    """Hands a text to `write` unless one of its cause came in the last `period` [s]; thread-safe.

    Tests give a `clock` of their own, of monotonic seconds.
    """

    def __init__(self, write: Callable[[str], object], period: float = 30.0,
                 clock: Callable[[], float] = time.monotonic) -> None:
        self._write = write
        self._period = period
        self._clock = clock
        self._lock = threading.Lock()
        self._last: dict[str, tuple[float, int]] = {}

    def __call__(self, text: str, cause: str = '') -> None:
        """Log `text`, or count it; without a `cause`, texts that differ in numbers share one."""
        cause = cause or cause_of(text)
        now = self._clock()
        with self._lock:
            if cause not in self._last and len(self._last) >= MOST_CAUSES:
                cause, text = '', 'further problems of other kinds (see /diagnostics)'
            last = self._last.get(cause)
            if last is not None and now - last[0] < self._period:
                self._last[cause] = (last[0], last[1] + 1)
                return
            self._last[cause] = (now, 0)
        repeated = f' ({last[1]} more since the last such line)' if last and last[1] else ''
        self._write(text + repeated)
