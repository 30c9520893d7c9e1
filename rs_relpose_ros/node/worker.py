"""The thread that works: compiles first, then drives the loop over the frames."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
import threading
from typing import Any

from rs_relpose_ros.front_end.front_end import FrameFailed, FrameLoop, Outcome

# Longest wait for a frame [s] before the thread looks whether it is to end.
_STEP_TIMEOUT = 0.1


@dataclass(frozen=True, slots=True, eq=False)
class WarmedUp:
    """The kernels are compiled or loaded, and frames are taken from now on; or the thread ends."""

    error: Exception | None = None   # why they could not be compiled


Event = WarmedUp | Outcome[Any]


class Worker(threading.Thread):
    """Steps the loop until it is stopped; an error in one frame never ends it.

    `warm_up` compiles what the loop needs. `consume` gets each event, in this thread: one
    `WarmedUp`, then outcomes of frames.
    """

    def __init__(self, loop: FrameLoop[Any, Any], warm_up: Callable[[], object],
                 consume: Callable[[Event], object]) -> None:
        # A daemon: a thread that compiles cannot be stopped, and must not hold up the exit.
        super().__init__(name='frame_worker', daemon=True)
        self._loop = loop
        self._warm_up = warm_up
        self._consume = consume
        self._stopping = threading.Event()

    def stop(self, timeout: float) -> bool:
        """Ask the thread to end and wait for it; whether it did in time."""
        self._stopping.set()
        self._loop.sequencer.close()
        self.join(timeout)
        return not self.is_alive()

    def run(self) -> None:
        """Work until `stop`."""
        try:
            self._warm_up()
        except Exception as error:  # noqa: BLE001 - the node shows it; a silent thread is worse
            self._consume(WarmedUp(error))
            return
        self._consume(WarmedUp())
        while not self._stopping.is_set():
            outcome = self._loop.step(_STEP_TIMEOUT)
            if outcome is None:
                continue
            try:
                self._consume(outcome)
            except Exception as error:  # noqa: BLE001 - told with its traceback by the node
                self._consume(FrameFailed(None, error))
