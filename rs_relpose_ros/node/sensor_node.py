"""What every node of the package has: camera and IMU in, one worker, diagnostics, a clean end."""

from __future__ import annotations

from abc import abstractmethod
import gc
import threading
import traceback
from typing import Any, ClassVar

from diagnostic_msgs.msg import DiagnosticArray
from rclpy.clock import Clock, ClockType
from std_srvs.srv import Trigger

from rs_relpose_ros.config.parameters import Parameters
from rs_relpose_ros.errors import RsRelposeError
from rs_relpose_ros.front_end.front_end import FrameFailed, FrameLoop, FrameProcessed
from rs_relpose_ros.front_end.sequencer import FrameRefused, Refusal, Sequencer
from rs_relpose_ros.geometry.timing import NANOSECONDS
from rs_relpose_ros.messages.intake import Intake
from rs_relpose_ros.messages.outgoing import DEBUG_IMAGE, diagnostics_message, status_message
from rs_relpose_ros.messages.sensor_feed import PARTS, Role
from rs_relpose_ros.node.cause_log import CauseLog
from rs_relpose_ros.node.frame_statistics import FrameStatistics, Inputs, SILENCE
from rs_relpose_ros.node.inputs import SensorInputs
from rs_relpose_ros.node.message_types import message_class
from rs_relpose_ros.node.params import (
    legal_qos,
    NodeParameters,
    unknown_overrides,
    unknown_qos_overrides,
)
from rs_relpose_ros.node.silence import (
    LostImages,
    PATIENCE,
    Reason,
    Silence,
    why_no_image,
    why_nothing,
)
from rs_relpose_ros.node.stoppable import StoppableNode
from rs_relpose_ros.node.worker import Event, WarmedUp, Worker

# Time [s] that the worker gets to end: a frame takes less, compiling takes longer.
_JOIN_TIMEOUT = 0.4
# Time [s] of a start above which kernels are being compiled, not loaded from the cache.
_TELL_COMPILING = 4.0


class SensorNode(StoppableNode):
    """A node that works on the frames of a camera with an IMU; its states: docs/architecture.md.

    Callbacks convert little and hand over; one worker thread does the rest. An illegal parameter
    raises InputError. What is made of the frames is said by the methods without a body.
    """

    # What `/diagnostics` calls the node's work, and how a sentence begins that says why there is
    # none: as the state of that name in the statistics.
    task: ClassVar[str]

    def __init__(self, name: str, statistics: FrameStatistics) -> None:
        super().__init__(name)
        # A line of code each: rclpy raises where one line logs at two severities.
        logger = self.get_logger()
        self._info = CauseLog(lambda text: logger.info(text))
        self._warn = CauseLog(lambda text: logger.warning(text))
        self._error = CauseLog(lambda text: logger.error(text))
        self._settings = NodeParameters(self, self._on_parameters)
        for sentence in unknown_overrides(self):
            self._warn(sentence)
        self._frame_statistics = statistics
        self._loop: FrameLoop[Any, Any] | None = None
        self._inputs: SensorInputs | None = None
        self._worker: Worker | None = None
        self._warm = threading.Event()
        self._lost_images, self._told_silence = LostImages(), ''
        # For diagnostics and time-outs, which must run although /clock may stand still.
        self._steady = Clock(clock_type=ClockType.STEADY_TIME)
        with legal_qos():
            self._open_outputs(self._settings.current)
        self._diagnostics = self.create_publisher(DiagnosticArray, '/diagnostics', 10)
        self.create_service(Trigger, '~/reset', self._reset)
        self._cannot_start = self._why_it_cannot_start()
        if self._cannot_start:
            self._error(self._cannot_start)
        else:
            self._start()
        self.create_timer(1.0, self._report, clock=self._steady)

    # -- what is made of the frames ------------------------------------------------------------

    @abstractmethod
    def _open_outputs(self, parameters: Parameters) -> None:
        """Make the publishers."""

    @abstractmethod
    def _make_loop(self, parameters: Parameters) -> FrameLoop[Any, Any]:
        """The loop that the worker drives."""

    @abstractmethod
    def _make_intake(self, parameters: Parameters, sequencer: Sequencer[Any]) -> Intake:
        """What fills the sequencer of the loop."""

    @abstractmethod
    def _warm_up(self) -> None:
        """Compile, or load from the cache, what the loop needs; by the worker."""

    @abstractmethod
    def _on_processed(self, frame: FrameProcessed[Any]) -> None:
        """Publish what a frame gave; by the worker."""

    def _on_ready(self, inputs: SensorInputs) -> None:
        """Do what needs the subscriptions, which have just been made."""

    # -- start and stop ----------------------------------------------------------------------

    def _why_it_cannot_start(self) -> str:
        """What is wrong with parameters or topics; empty for nothing."""
        idle, missing = self._frame_statistics.idle, self._settings.current.sensor.missing()
        if missing:
            return (f'{idle}: {" and ".join(missing)} must be given as parameter: see '
                    'config/relpose.yaml, and start again')
        topic = self.resolve_topic_name('image')
        if 'image_rect' in topic:
            return (f'{idle}: {topic} is a rectified image, in which a row no longer has '
                    'one instant; remap image to the raw one')
        return ''

    def _start(self) -> None:
        parameters = self._settings.current
        self._loop = self._make_loop(parameters)
        self._intake = self._make_intake(parameters, self._loop.sequencer)
        self._worker = Worker(self._loop, self._warm_up, self._consume)
        self._worker.start()
        self._started_ns = self._now_ns()
        # No subscription before the kernels are there: messages that come earlier are dropped.
        self._warm_timer = self.create_timer(0.02, self._subscribe_when_warm, clock=self._steady)

    def _subscribe_when_warm(self) -> None:
        if not self._warm.is_set():
            if self._now_ns() - self._started_ns > _TELL_COMPILING * NANOSECONDS:
                self._info('compiling kernels, as the build left none that fit here: this start '
                           'takes a minute or two, the later ones, which find them, some seconds')
            return
        self.destroy_timer(self._warm_timer)
        assert self._loop is not None
        with legal_qos():
            inputs = SensorInputs(
                self, self._intake, self._loop.sequencer.waits_for_imu,
                self._settings.current.pair.image_transport, self._error, self._steady)
        for sentence in unknown_qos_overrides(self):
            self._warn(sentence)
        # Objects that exist by now live to the end: the garbage collector need not scan them.
        gc.collect()
        gc.freeze()
        self._inputs = inputs
        self._frame_statistics.start()
        self._on_ready(inputs)
        image, camera_info, imu, _ = inputs.topics.values()
        self.get_logger().info(f'ready: {image}, {camera_info} and {imu}')

    def stop(self) -> bool:
        """End the worker; whether it did. Call it before `destroy_node`."""
        return self._worker is None or self._worker.stop(_JOIN_TIMEOUT)

    def _reset(self, _: Trigger.Request, response: Trigger.Response) -> Trigger.Response:
        """Start anew, as after a restart, but for the intrinsics and the counters."""
        response.success = self._loop is not None
        response.message = self._cannot_start
        if self._loop is not None:
            self._loop.sequencer.reset()
            response.message = 'starting anew with the next frame'
        return response

    def _on_parameters(self, parameters: Parameters) -> None:
        if self._loop is not None:
            self._loop.parameters = parameters

    # -- what became of a frame (called by the worker) ---------------------------------------

    def _consume(self, event: Event) -> None:
        """The one outlet of the worker."""
        if isinstance(event, FrameRefused):
            self._tell_refused(event)
        elif isinstance(event, FrameFailed):
            self._tell_failed('a frame failed and the next one starts anew', event.error)
        elif isinstance(event, WarmedUp):
            if event.error is not None:
                self._tell_failed('the kernels cannot be compiled', event.error)
                return
            self._warm.set()
        else:
            self._on_processed(event)

    def _tell_refused(self, refused: FrameRefused) -> None:
        if refused.cause is Refusal.NO_CALIBRATION:
            return   # `_missing_input` tells it
        if refused.cause is Refusal.NO_IMU:
            # A gap of 0.3 s between IMU messages: the sensor has stopped.
            if self._inputs is not None and self._inputs.silent(Role.IMU, 0.3):
                return   # `_missing_input` tells it after `SILENCE`
            self._warn(f'a frame was not used: {refused.reason}; is '
                       f'{self.resolve_topic_name("imu")} published, with a gyro, and are its '
                       'stamps on the clock of the images (time_offset)?')
        else:
            self._warn(f'a frame was not used ({refused.cause.value}): {refused.reason}')

    def _tell_failed(self, sentence: str, error: Exception) -> None:
        self._frame_statistics.add_failure(f'{sentence}: {error}')
        if isinstance(error, RsRelposeError):
            self._error(f'{sentence}: {error}')
        else:
            text = ''.join(traceback.format_exception(error))
            self._error(f'{sentence}: {type(error).__name__}: {error}\n{text}')

    # -- diagnostics -------------------------------------------------------------------------

    def _report(self) -> None:
        problem, missing = self._problem()
        report = self._frame_statistics.report(
            Inputs() if self._inputs is None else self._inputs.totals(),
            None if self._loop is None else self._loop.sequencer.counts(),
            problem=problem, missing=missing)
        status = status_message(
            report.level, f'{self.get_fully_qualified_name()}: {self.task}', report.text,
            self._image_topic(), report.values, message_class)
        self._diagnostics.publish(diagnostics_message(
            self.get_clock().now().nanoseconds, status, message_class))
        if self._inputs is not None:
            self._tell_silence(self._inputs, report.silence, problem)
            totals = self._inputs.totals()
            lost = self._lost_images.add(
                totals.images, totals.camera_infos, self._inputs.image_bytes)
            if lost:
                self._warn(lost)

    def _tell_silence(self, inputs: SensorInputs, silence: Silence, problem: str) -> None:
        """Say why nothing comes out, once as long as it stays the same."""
        if inputs.silent(Role.IMAGE, PATIENCE):
            self._tell_reason(why_no_image(self._image_topic(), self._topics_with_images()))
        elif silence.seconds < PATIENCE:
            self._told_silence = ''
        elif not problem:   # which has a line of its own
            self._tell_reason(why_nothing(silence))

    def _tell_reason(self, reason: Reason) -> None:
        if reason.kind != self._told_silence:
            self._told_silence = reason.kind
            self._warn(f'{self._frame_statistics.idle}: {reason.text}')

    def _topics_with_images(self) -> list[str]:
        """Those that others publish, but for pictures of pairs."""
        own = f'{self.get_fully_qualified_name()}/'
        images = set(PARTS[Role.IMAGE].msgtypes)
        return [name for name, types in self.get_topic_names_and_types()
                if images.intersection(types) and not name.startswith(own)
                and not name.endswith(f'/{DEBUG_IMAGE}') and self.count_publishers(name)]

    def _image_topic(self) -> str:
        """The subscribed one, with its transport, once there is one."""
        return (self.resolve_topic_name('image') if self._inputs is None
                else self._inputs.topics[Role.IMAGE])

    def _problem(self) -> tuple[str, tuple[str, ...]]:
        """Why nothing comes out at the moment, and the names of what is missing."""
        if self._cannot_start:
            return self._cannot_start, tuple(self._settings.current.sensor.missing())
        assert self._worker is not None
        if not self._worker.is_alive():
            return f'{self._frame_statistics.idle}: the worker ended, see the log', ()
        if self._inputs is None:
            return 'starting: kernels are compiled or loaded', ()
        return self._missing_input(self._inputs)

    def _missing_input(self, inputs: SensorInputs) -> tuple[str, tuple[str, ...]]:
        """Which sensor does not say what is needed; the log has it unless the driver is not up."""
        idle = self._frame_statistics.idle
        image, camera_info, imu, _ = inputs.topics.values()
        missing = tuple(topic for role, topic in inputs.topics.items()
                        if role is not Role.ACCEL and inputs.silent(role))
        if self._intake.camera_info_problem:
            return f'{idle}: {self._intake.camera_info_problem}', ('calibration',)
        # Without any image the driver is probably not running yet: a status, but no log line.
        if image in missing:
            return f'{idle}: no image on {image} for {SILENCE:g} s', missing
        # Told intrinsics are taken once some images have waited for a CameraInfo in vain.
        told = self._settings.current.intrinsics.given
        if self._intake.intrinsics is None and camera_info in missing and not told:
            text = (f'{idle}: no CameraInfo on {camera_info}; remap camera_info to the '
                    'topic of the driver, which must publish a calibration, or give '
                    'camera_matrix')
        elif imu in missing:
            text = (f'{idle}: no IMU message on {imu} for {SILENCE:g} s; remap imu to '
                    'the topic of the driver')
        else:
            return '', ()
        self._error(text)
        return text, missing

    def _now_ns(self) -> int:
        return int(self._steady.now().nanoseconds)
