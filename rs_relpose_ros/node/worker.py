"""The thread that estimates: takes frames from the sequencer, hands pairs to the node."""

from __future__ import annotations

from collections.abc import Callable
import threading

from rs_relpose_ros.config.parameters import Parameters
from rs_relpose_ros.front_end.pair import PairResult
from rs_relpose_ros.front_end.pipeline import Pipeline
from rs_relpose_ros.front_end.sequencer import FrameRefused, ReadyFrame, Sequencer
from rs_relpose_ros.front_end.warm_up import warm_up_pipeline
from rs_relpose_ros.node.frame_timings import FrameTimings

_TAKE_TIMEOUT = 0.1


class Worker(threading.Thread):
    """Runs the pipeline until it is stopped; an error in one frame never ends it.

    Parameters
    ----------
    parameters : Parameters
    sequencer : Sequencer
    on_taken : callable
        Called with every frame before it is processed.
    on_result : callable
        Called with the frame and its pair or None, after it was processed.
    on_refused : callable
        Called with every frame that was refused.
    on_error : callable
        Called with a sentence and the exception when a frame failed.

    Raises
    ------
    InputError
        `timings_file` cannot be written.
    """

    def __init__(self, parameters: Parameters, sequencer: Sequencer,
                 on_taken: Callable[[ReadyFrame], None],
                 on_result: Callable[[ReadyFrame, PairResult | None], None],
                 on_refused: Callable[[FrameRefused], None],
                 on_error: Callable[[str, Exception], None]) -> None:
        # A thread that compiles cannot be stopped; a daemon does not hold up the exit.
        super().__init__(name='relpose_worker', daemon=True)
        self._sequencer = sequencer
        self._on_taken = on_taken
        self._on_result = on_result
        self._on_refused = on_refused
        self._on_error = on_error
        self._parameters = parameters
        self._timings = (FrameTimings(parameters.pair.timings_file)
                         if parameters.pair.timings_file else None)
        # For ~/debug_image; references only.
        self._pipeline = Pipeline(parameters, keep_images=True)
        self._changed_parameters: Parameters | None = None
        self._stopping = threading.Event()
        self._warm = threading.Event()

    @property
    def warm(self) -> bool:
        """Whether the kernels are compiled and frames are taken."""
        return self._warm.is_set()

    def change(self, parameters: Parameters) -> None:
        """Use these parameters from the next frame on."""
        self._changed_parameters = parameters

    def stop(self, timeout: float) -> bool:
        """Ask the thread to end and wait for it; whether it did in time."""
        self._stopping.set()
        self._sequencer.close()
        self.join(timeout)
        return not self.is_alive()

    def run(self) -> None:
        """Work until `stop`."""
        try:
            self._work()
        finally:
            if self._timings is not None:
                self._timings.close()

    def _work(self) -> None:
        try:
            warm_up_pipeline(self._parameters)
        except Exception as error:  # noqa: BLE001 - the node shows it; a silent thread is worse
            self._on_error('the kernels cannot be compiled', error)
            return
        if self._timings is not None:
            self._timings.start()
        self._warm.set()
        while not self._stopping.is_set():
            try:
                self._step()
            except Exception as error:  # noqa: BLE001 - told with its traceback by the node
                self._pipeline.reset()
                self._on_error('a frame failed and tracking starts anew', error)

    def _step(self) -> None:
        taken = self._sequencer.take(_TAKE_TIMEOUT)
        if isinstance(taken, FrameRefused):
            self._on_refused(taken)
        elif taken is not None and not self._stopping.is_set():
            if self._changed_parameters is not None:
                self._pipeline.update(self._changed_parameters)
                self._changed_parameters = None
            if taken.restart:
                self._pipeline.reset()
            self._on_taken(taken)
            result = self._pipeline.process(taken.frame, taken.imu)
            self._sequencer.apply_time_offset(self._pipeline.applied_offset_ns)
            self._on_result(taken, result)
            if self._timings is not None:
                self._timings.add(taken, result)
            self._pipeline.prepare()
