"""The one drive loop: frames and IMU samples in, the outcome of every frame out.

Live nodes, replay and warm-up fill the sequencer and call `FrameLoop.step`; how a frame is taken,
refused, processed or given up stands here alone.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
import time
from typing import Generic, Protocol, TypeVar

from rs_relpose_ros.config.parameters import Parameters
from rs_relpose_ros.errors import RsRelposeError
from rs_relpose_ros.front_end.frame import Decoded, Frame, Waiting
from rs_relpose_ros.front_end.pair import PairResult
from rs_relpose_ros.front_end.pipeline import Pipeline
from rs_relpose_ros.front_end.sequencer import FrameRefused, ReadyFrame, Sequencer
from rs_relpose_ros.health.tracked import Applied
from rs_relpose_ros.imu.frame_imu import FrameImu
from rs_relpose_ros.tracking.tracker import Tracker

Result = TypeVar('Result')
DecodedContra = TypeVar('DecodedContra', bound=Waiting, contravariant=True)
ResultCo = TypeVar('ResultCo', covariant=True)


class Processor(Protocol[DecodedContra, ResultCo]):
    """What is made of frames, in the order of their stamps, by one thread."""

    @property
    def applied(self) -> Applied:
        """Tracked figures that the next frame is to have."""

    def prepare(self) -> None:
        """Do ahead of the next frame what nobody waits for; `process` does it where nobody has."""

    def reset(self) -> None:
        """Forget the frames so far: the next one starts anew."""

    def process(self, frame: DecodedContra, imu: FrameImu,
                parameters: Parameters) -> ResultCo | None:
        """What a frame gives, or None."""


@dataclass(frozen=True, slots=True, eq=False)
class FrameProcessed(Generic[Result]):
    """A frame that was processed, and what it gave: of `FrontEnd` the pair that it closed."""

    stamp_ns: int
    ready_ns: int   # both as in `ReadyFrame`
    taken_ns: int
    seconds: float   # wall time of its processing
    result: Result | None


@dataclass(frozen=True, slots=True, eq=False)
class FrameFailed:
    """A frame in which an error came up: the processor starts anew with the next one."""

    stamp_ns: int | None   # None where no frame had been taken yet
    error: Exception   # of the package (`RsRelposeError`), or, live, a programming error


Outcome = FrameRefused | FrameFailed | FrameProcessed[Result]


class FrameLoop(Generic[Decoded, Result]):
    """Takes frames from its sequencer and has them processed.

    `sequencer` is filled from any thread; `step` is called by one. `parameters` may be replaced
    from any thread and are in force from the next step on: nothing behind `step` keeps a value
    that may change while running, all of it gets these with each frame.

    `offline` and `clock` are those of `Sequencer`. Offline, programming errors leave `step`; live
    they are an outcome, since the node goes on.
    """

    def __init__(self, parameters: Parameters, processor: Processor[Decoded, Result], *,
                 offline: bool = False, clock: Callable[[], int] = time.monotonic_ns) -> None:
        self.parameters = parameters
        self.sequencer: Sequencer[Decoded] = Sequencer(parameters, offline=offline, clock=clock)
        self._processor = processor
        self._offline = offline

    def step(self, timeout: float = 0.0) -> Outcome[Result] | None:
        """What became of the next frame; None where none is ready within `timeout` seconds."""
        stamp_ns: int | None = None
        try:
            if not self._offline:
                # The result of the step before is out: nobody waits meanwhile.
                self._processor.prepare()
            taken = self.sequencer.take(timeout)
            if not isinstance(taken, ReadyFrame):
                return taken
            stamp_ns = taken.frame.stamp_ns
            if taken.restart:
                self._processor.reset()
            started = time.perf_counter()
            result = self._processor.process(taken.frame, taken.imu, self.parameters)
            seconds = time.perf_counter() - started
            # Between two frames, so that the shift of a frame depends on those before it alone.
            self.sequencer.apply(self._processor.applied)
            return FrameProcessed(stamp_ns, taken.ready_ns, taken.taken_ns, seconds, result)
        except Exception as error:
            self._processor.reset()
            if self._offline and not isinstance(error, RsRelposeError):
                raise
            return FrameFailed(stamp_ns, error)


class FrontEnd(FrameLoop[Frame, PairResult]):
    """The loop that makes keyframe pairs.

    With `keep_images` pairs carry their two images. `tracker`: instead of the one that the
    parameters name.
    """

    def __init__(self, parameters: Parameters, *, offline: bool = False,
                 keep_images: bool = False, tracker: Tracker | None = None,
                 clock: Callable[[], int] = time.monotonic_ns) -> None:
        super().__init__(parameters, Pipeline(parameters, keep_images, tracker), offline=offline,
                         clock=clock)
