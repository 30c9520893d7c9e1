"""The one drive loop: frames and IMU samples in, the outcome of every frame out.

The live node, the replay and the warm-up fill the sequencer and call `FrontEnd.step`; how a frame
is taken, refused, processed or given up stands here alone.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
import time

from rs_relpose_ros.config.parameters import Parameters
from rs_relpose_ros.errors import RsRelposeError
from rs_relpose_ros.front_end.pair import PairResult
from rs_relpose_ros.front_end.pipeline import Pipeline
from rs_relpose_ros.front_end.sequencer import FrameRefused, ReadyFrame, Sequencer
from rs_relpose_ros.tracking.tracker import Tracker


@dataclass(frozen=True, slots=True, eq=False)
class FrameProcessed:
    """A frame that was tracked, and the pair that it closed, if it did."""

    stamp_ns: int
    ready_ns: int   # both as in `ReadyFrame`
    taken_ns: int
    seconds: float   # wall time of tracking and estimation
    pair: PairResult | None


@dataclass(frozen=True, slots=True, eq=False)
class FrameFailed:
    """A frame in which an error came up: tracking starts anew with the next one."""

    stamp_ns: int | None   # None where no frame had been taken yet
    error: Exception   # of the package (`RsRelposeError`), or, live, a programming error


Outcome = FrameRefused | FrameFailed | FrameProcessed


class FrontEnd:
    """Takes frames from its sequencer and processes them.

    `sequencer` is filled from any thread; `step` is called by one. `parameters` may be replaced
    from any thread and are in force from the next step on: nothing behind `step` keeps a value
    that may change while running, all of it gets these with each frame.

    `offline` and `clock` are those of `Sequencer`. Offline, programming errors leave `step`; live
    they are an outcome, since the node goes on. With `keep_images` pairs carry their two images.
    `tracker`: instead of the one that the parameters name.
    """

    def __init__(self, parameters: Parameters, *, offline: bool = False,
                 keep_images: bool = False, tracker: Tracker | None = None,
                 clock: Callable[[], int] = time.monotonic_ns) -> None:
        self.parameters = parameters
        self.sequencer = Sequencer(parameters, offline=offline, clock=clock)
        self._pipeline = Pipeline(parameters, keep_images, tracker)
        self._offline = offline

    def step(self, timeout: float = 0.0) -> Outcome | None:
        """What became of the next frame; None where none is ready within `timeout` seconds."""
        stamp_ns: int | None = None
        try:
            if not self._offline:
                # The pair of the step before is out: nobody waits while new corners are sought.
                self._pipeline.prepare()
            taken = self.sequencer.take(timeout)
            if not isinstance(taken, ReadyFrame):
                return taken
            stamp_ns = taken.frame.stamp_ns
            if taken.restart:
                self._pipeline.reset()
            started = time.perf_counter()
            pair = self._pipeline.process(taken.frame, taken.imu, self.parameters)
            seconds = time.perf_counter() - started
            # Between two frames, so that the shift of a frame depends on those before it alone.
            self.sequencer.apply(self._pipeline.applied)
            return FrameProcessed(stamp_ns, taken.ready_ns, taken.taken_ns, seconds, pair)
        except Exception as error:
            self._pipeline.reset()
            if self._offline and not isinstance(error, RsRelposeError):
                raise
            return FrameFailed(stamp_ns, error)
