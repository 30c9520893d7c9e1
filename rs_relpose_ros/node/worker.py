"""The thread that estimates: compiles first, then drives the front end."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
import threading

from rs_relpose_ros.front_end.front_end import FrameFailed, FrontEnd, Outcome
from rs_relpose_ros.front_end.warm_up import warm_up_pipeline

# Longest wait for a frame [s] before the thread looks whether it is to end.
_STEP_TIMEOUT = 0.1


@dataclass(frozen=True, slots=True, eq=False)
class WarmedUp:
    """The kernels are compiled or loaded, and frames are taken from now on; or the thread ends."""

    error: Exception | None = None   # why they could not be compiled


Event = WarmedUp | Outcome


class Worker(threading.Thread):
    """Steps the front end until it is stopped; an error in one frame never ends it.

    `consume` gets each event, in this thread: one `WarmedUp`, then outcomes of frames.
    """

    def __init__(self, front_end: FrontEnd, consume: Callable[[Event], object]) -> None:
        # A daemon: a thread that compiles cannot be stopped, and must not hold up the exit.
        super().__init__(name='relpose_worker', daemon=True)
        self._front_end = front_end
        self._consume = consume
        self._stopping = threading.Event()

    def stop(self, timeout: float) -> bool:
        """Ask the thread to end and wait for it; whether it did in time."""
        self._stopping.set()
        self._front_end.sequencer.close()
        self.join(timeout)
        return not self.is_alive()

    def run(self) -> None:
        """Work until `stop`."""
        try:
            warm_up_pipeline(self._front_end.parameters)
        except Exception as error:  # noqa: BLE001 - the node shows it; a silent thread is worse
            self._consume(WarmedUp(error))
            return
        self._consume(WarmedUp())
        while not self._stopping.is_set():
            outcome = self._front_end.step(_STEP_TIMEOUT)
            if outcome is None:
                continue
            try:
                self._consume(outcome)
            except Exception as error:  # noqa: BLE001 - told with its traceback by the node
                self._consume(FrameFailed(None, error))
