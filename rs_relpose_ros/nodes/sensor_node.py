"""Base of the nodes: inputs, the worker thread, diagnostics, start and end of the process."""

from __future__ import annotations

from abc import abstractmethod
import argparse
from collections import Counter
from collections.abc import Callable, Mapping, Sequence
import logging
import os
from pathlib import Path
import sys
import tempfile
import threading
import traceback
from typing import Any, ClassVar, NoReturn, TYPE_CHECKING

from diagnostic_msgs.msg import DiagnosticArray
import rclpy
from rclpy.clock import Clock, ClockType
from rclpy.executors import ExternalShutdownException, SingleThreadedExecutor
from rclpy.impl.implementation_singleton import rclpy_implementation
from rclpy.node import Node
from rclpy.signals import SignalHandlerOptions
from rclpy.utilities import remove_ros_args
from std_msgs.msg import String
from std_srvs.srv import Trigger

from rs_relpose_ros.calibrate import stored
from rs_relpose_ros.calibrate.stored import Calibrated, Progress
from rs_relpose_ros.config.files import text_values
from rs_relpose_ros.config.settings import Parameters
from rs_relpose_ros.errors import InputError, RsRelposeError
from rs_relpose_ros.garbage import collect_as_usual
from rs_relpose_ros.messages import outgoing
from rs_relpose_ros.messages.incoming import Intake, PARTS, Role
from rs_relpose_ros.messages.transforms import extrinsics
from rs_relpose_ros.nodes import diagnostics
from rs_relpose_ros.nodes import parameters as ros_parameters
from rs_relpose_ros.nodes.diagnostics import LineFile, PATIENCE, ReasonLog, SILENCE, STARTING
from rs_relpose_ros.nodes.executor import KeptWaitSet, make_executor
from rs_relpose_ros.nodes.inputs import (
    LATCHED,
    message_class,
    SensorInputs,
    SHUT_DOWN,
    TransformLookup,
)
from rs_relpose_ros.pipeline.pair import Frame
from rs_relpose_ros.pipeline.pipeline import FrameFailed, FrameLoop, Outcome
from rs_relpose_ros.pipeline.sequencer import FrameRefused, Refusal
from rs_relpose_ros.pipeline.warm_up import cache_is_filled

if TYPE_CHECKING:
    from rs_relpose_ros.calibrate.live import LiveCalibration

# -- A node as a process --------------------------------------------------------------------------


class StoppableNode(Node):
    """A node of `run_node` with log lines and parameters; it may have threads of its own.

    An illegal parameter raises InputError.
    """

    def __init__(self, name: str) -> None:
        super().__init__(name)
        # A line of code each: rclpy raises if one line logs at two severities.
        logger = self.get_logger()
        self._info = ReasonLog(lambda text: logger.info(text))
        self._warn = ReasonLog(lambda text: logger.warning(text))
        self._error = ReasonLog(lambda text: logger.error(text))
        self._diagnostics = self.create_publisher(DiagnosticArray, '/diagnostics', 10)
        self._settings = ros_parameters.NodeParameters(self, self._on_parameters)
        for warning in ros_parameters.unknown_overrides(self):
            self._warn(warning)

    def _on_parameters(self, parameters: Parameters) -> None:
        """A live parameter was set."""

    def use_calibrations(self) -> None:
        """Use the calibrations that relpose_node publishes."""

        def use(message: String) -> None:
            self._info('using the calibration of relpose_node')
            self.adopt(message.data, 'calibration')

        self.create_subscription(String, 'calibration', use, LATCHED)

    def adopt(self, parameters: str, source: str) -> None:
        """Set the parameters of a file that the user has not given; an error is logged."""
        try:
            self._settings.adopt(text_values(parameters, source))
        except InputError as error:
            self._error(str(error))

    def publish_status(
        self, level: int, task: str, text: str, hardware_id: str, values: Sequence[tuple[str, str]]
    ) -> None:
        """Publish a status on /diagnostics."""
        self._diagnostics.publish(
            outgoing.diagnostics_message(
                self.get_clock().now().nanoseconds,
                level,
                f'{self.get_fully_qualified_name()}: {task}',
                text,
                hardware_id,
                values,
                message_class,
            )
        )

    def log_compiling(self) -> None:
        """Log that this start takes long, where it does."""
        if not cache_is_filled():
            self._info(
                'compiling kernels, as the build has none for this machine: this start '
                'takes a minute or two, later ones some seconds'
            )

    def warn_of_namesake(self) -> None:
        """Warn of another node of this name: services and parameters reach either of them."""
        own = self.get_name(), self.get_namespace()
        if self.get_node_names_and_namespaces().count(own) > 1:
            self._warn(
                f'another node has the name {self.get_fully_qualified_name()}: services '
                'and parameters reach either of them; start one with -r __node:=NAME'
            )

    def stop(self) -> bool:
        """End its threads; whether they ended. Called before `destroy_node`."""
        return True


def run_node(
    make: Callable[[], StoppableNode],
    name: str,
    description: str,
    arguments: Sequence[str] | None = None,
    on_started: Callable[[Callable[[], object]], object] = lambda stop: None,
) -> int:
    """Run a node until it is stopped; its exit code: 0, or 2 for an illegal parameter.

    `description` is that of its ``--help``; `on_started` gets the function that stops the node,
    for any thread, before the node is made.
    """
    given = sys.argv if arguments is None else [name, *arguments]
    logger = rclpy.logging.get_logger(name)
    try:
        own = remove_ros_args(given)
    except rclpy_implementation.RCLInvalidROSArgsError as error:
        # rcl appends the names of its source files.
        logger.fatal(str(error).split(', at /')[0].strip())
        return 2
    _help(name, description).parse_args(own[1:])
    if not (os.environ.get('HOME') or os.environ.get('ROS_HOME')):  # rcl has no folder to log in
        os.environ.setdefault('ROS_LOG_DIR', tempfile.gettempdir())
    rclpy.init(args=list(given), signal_handler_options=SignalHandlerOptions.NO)
    executor: SingleThreadedExecutor | None = None
    node: StoppableNode | None = None
    stopped = threading.Event()

    def stop() -> None:
        stopped.set()
        if executor is not None:
            executor.create_task(stopped.set)  # wakes it

    on_started(stop)
    try:
        node = make()
        executor, problem = make_executor(node)
        if problem:
            text = f'the executor of rclpy runs this node, with more load: {problem}'
            logger.warning(text)
        while not stopped.is_set():
            executor.spin_once()
    except (KeyboardInterrupt, ExternalShutdownException):
        pass  # of a caller that has not blocked the signals, or has ended the context
    except RsRelposeError as error:
        logger.fatal(str(error))
        return 2
    finally:
        if node is not None:
            if not node.stop():
                # The thread compiles or loads kernels, which cannot be interrupted.
                leave(0)
            if isinstance(executor, KeptWaitSet):
                executor.release()
            node.destroy_node()
        rclpy.try_shutdown()
    return 0


def _help(name: str, description: str) -> argparse.ArgumentParser:
    lines = ['parameters (set them with --ros-args -p NAME:=VALUE or --params-file FILE):']
    for parameter, default, declared in Parameters.declarations():
        shown = 'no default' if default is None else f'default {default!r}'
        live = '; live' if declared.live else ''
        lines.append(f'  {parameter}: {declared.description}. {declared.legal}; {shown}{live}')
    return argparse.ArgumentParser(
        prog=name,
        formatter_class=argparse.RawDescriptionHelpFormatter,
        description=description,
        epilog='\n'.join(lines),
    )


def leave(code: int) -> NoReturn:
    """End the process at once, with all output written.

    Threads of the package, OpenCV or the middleware that still run while the interpreter and the
    libraries shut down can abort it.
    """
    logging.shutdown()
    sys.stdout.flush()
    sys.stderr.flush()
    os._exit(code)


# -- The worker thread ----------------------------------------------------------------------------

# Longest wait for a frame [s] before the thread checks whether it is to end. Longer delays the end
# of the node, shorter wakes the thread for nothing. [chosen: 0.02 to 0.3 s would do]
_STEP_TIMEOUT = 0.1


class Worker(threading.Thread):
    """Compiles the kernels, then steps the loop until it is stopped; errors never end it.

    `consume` gets each outcome in this thread, an error of `warm_up` as a `FrameFailed` while
    `warm` is not set; then the thread ends.
    """

    def __init__(
        self,
        loop: FrameLoop[Any] | LiveCalibration,
        warm_up: Callable[[], object],
        consume: Callable[[Any], object],
    ) -> None:
        # A daemon: a thread that compiles cannot be stopped, and must not delay the exit.
        super().__init__(name='frame_worker', daemon=True)
        self.warm = threading.Event()  # the kernels are compiled or loaded
        self._loop = loop
        self._warm_up = warm_up
        self._consume = consume
        self._stopping = threading.Event()

    def stop(self, timeout: float) -> bool:
        """End the thread and wait for it; whether it ended in time."""
        self._stopping.set()
        self._loop.close()
        self.join(timeout)
        return not self.is_alive()

    def run(self) -> None:
        """Work until `stop`."""
        try:
            self._warm_up()
        except Exception as error:  # noqa: BLE001 - the node shows it; a silent thread is worse
            self._consume(FrameFailed(None, error))
            return
        self.warm.set()
        while not self._stopping.is_set():
            try:
                outcome = self._loop.step(_STEP_TIMEOUT)
                if outcome is not None:
                    self._consume(outcome)
            except Exception as error:  # noqa: BLE001 - logged with its traceback by the node
                self._consume(FrameFailed(None, error))


# -- A node with camera and IMU -------------------------------------------------------------------

# Time [s] for the worker to end. A frame takes less, so that a shorter one would end the process
# while a pair is published; compiling takes longer. [chosen: 0.2 to 1 s would do]
_JOIN_TIMEOUT = 0.4


def _camera(parameters: Parameters) -> list[Any]:
    """The parameters with a change of which a node begins again."""
    values = parameters.to_mapping()
    return [values[name] for name, _, declared in Parameters.declarations() if declared.restarts]


class SensorNode(StoppableNode):
    """A node that works on the frames of a camera with an IMU; its states: docs/architecture.md.

    Callbacks convert little and fill the sequencer; one worker thread does the rest.
    """

    # Name of the work on `/diagnostics`; whether the node calibrates, or waits for another's.
    task: ClassVar[str]
    calibrates: ClassVar[bool] = True

    def __init__(self, name: str, statistics: diagnostics.FrameStatistics) -> None:
        super().__init__(name)
        self._frame_statistics = statistics
        self._stamps: LineFile | None = None  # of the frames that were processed or failed
        self._loop: FrameLoop[Any] | None = None
        self._inputs: SensorInputs | None = None
        self._worker: Worker | None = None
        self._reported_silence = ''
        # This clock drives diagnostics and time-outs, which must run while /clock stands still.
        self._steady = Clock(clock_type=ClockType.STEADY_TIME)
        with ros_parameters.legal_qos():
            self._open_outputs(self._settings.current)
        self.create_service(Trigger, '~/reset', self._reset)
        # None once its transform is used; the rotation IMU to camera in it.
        self._lookup = TransformLookup(self) if self._settings.current.calibration.use_tf else None
        self._quat_prior: tuple[float, ...] | None = None
        self._found: Calibrated | None = None  # to be used by the executor's thread
        self._calibrated: Calibrated | None = None  # in use
        if self.calibrates:
            self._published = self.create_publisher(String, '~/calibration', LATCHED)
            self.create_service(Trigger, '~/calibrate', self._calibrate_now)
            self.create_service(Trigger, '~/save_calibration', self._save_now)
        else:
            self.use_calibrations()
        self._warm_timer = self.create_timer(0.02, self._subscribe_when_warm, clock=self._steady)
        self._found_timer = self.create_timer(0.1, self._use_found, clock=self._steady)
        self._begin(self._settings.current.calibration.calibrate_at_start == 'always')
        self.create_timer(1.0, self._report, clock=self._steady)

    @abstractmethod
    def _open_outputs(self, parameters: Parameters) -> None:
        """Make the publishers."""

    @abstractmethod
    def _make_loop(self, parameters: Parameters) -> FrameLoop[Any]:
        """The loop that the worker drives."""

    @abstractmethod
    def _warm_up(self) -> None:
        """Compile or load the kernels of the loop; by the worker."""

    @abstractmethod
    def _on_processed(self, frame: Frame[Any]) -> None:
        """Publish the result of a frame; by the worker."""

    # -- start and stop ----------------------------------------------------------------------

    def _why_it_cannot_start(self) -> str:
        """The fault of parameters or topics; empty for none."""
        idle = self._frame_statistics.idle
        missing = self._settings.current.sensor.missing()
        if missing and not self._may_calibrate() and not self._waits_for_tf():
            return (
                f'{idle}: {" and ".join(missing)} must be given as parameter, or allow '
                'calibrate_at_start: missing'
            )
        topic = self.resolve_topic_name('image')
        if 'image_rect' in topic:
            return (
                f'{idle}: {topic} is a rectified image, whose rows have no single '
                'timestamp; remap image to the raw one'
            )
        return ''

    def _may_calibrate(self) -> bool:
        return self._settings.current.calibration.calibrate_at_start != 'never'

    def _waits_for_tf(self) -> bool:
        """Whether only the rotation is missing, and /tf_static may give it."""
        return (
            self._lookup is not None
            and not self._calibrating
            and self._settings.current.sensor.missing() == ['quat_cam_imu_xyzw']
        )

    def _begin(self, calibrate: bool = False) -> None:
        """Estimate with the current parameters from here on, or calibrate before."""
        self._calibrating = calibrate
        self._warm_timer.cancel()
        self._found_timer.cancel()
        if self._worker is not None:
            self._worker.stop(_JOIN_TIMEOUT)
        self._active = parameters = self._settings.current
        self._calibration: LiveCalibration | None = None
        self._progress: Progress | None = None
        self._loop = None
        self._cannot_start = self._why_it_cannot_start()
        if self._cannot_start:
            self._error(self._cannot_start)
            return
        if calibrate or parameters.sensor.missing():
            may_load = parameters.calibration.load_calibration and self._may_calibrate()
            self._calibration = self._make_calibration(use_stored=may_load and not calibrate)
            self._intake: Any = self._calibration
            self._progress = Progress('calibrating: waiting for images and gyro')
            self._worker = Worker(self._intake, self._warm_up, self._consume_calibration)
            self._found_timer.reset()
        else:
            self._loop = self._make_loop(parameters)
            self._intake = Intake(self._loop.sequencer, parameters)
            self._worker = Worker(self._loop, self._warm_up, self._consume)
        self.log_compiling()
        self._worker.start()
        # No subscription before the kernels are loaded: the first frames would be dropped.
        self._warm_timer.reset()

    def _make_calibration(self, *, use_stored: bool) -> LiveCalibration:
        # Imported where it is needed: a start with a calibration is faster by it.
        from rs_relpose_ros.calibrate.live import LiveCalibration

        others = []
        if self._waits_for_tf():
            others.append('the rotation of the IMU on /tf_static')
        if not self.calibrates:
            topic = self.resolve_topic_name('calibration')
            others.append(f'a calibration by relpose_node on {topic}')
        fits = self.calibrates and self._may_calibrate()
        calibration = LiveCalibration(
            self._settings.current,
            use_stored=use_stored,
            waits_for='' if fits else ' or '.join(others),
            topic=self.resolve_topic_name('image'),
        )
        calibration.quat_prior = self._quat_prior
        return calibration

    def _subscribe_when_warm(self) -> None:
        assert self._worker is not None
        if not self._worker.warm.is_set():
            return
        self._warm_timer.cancel()
        first = self._inputs is None
        if self._inputs is None:
            self._inputs = self._subscribe()
        else:
            self._inputs.hand_to(self._intake)
        self._frame_statistics.start()
        image, camera_info, imu, _ = self._inputs.topics.values()
        state = 'ready' if self._calibration is None else 'waiting for the first image'
        self.get_logger().info(f'{state}: {image}, {camera_info} and {imu}')
        if first:
            collect_as_usual()

    def _subscribe(self) -> SensorInputs:
        with ros_parameters.legal_qos():
            transport = self._settings.current.pair.image_transport
            inputs = SensorInputs(self, self._intake, transport, self._error)
        for warning in ros_parameters.unknown_qos_overrides(self):
            self._warn(warning)
        return inputs

    def stop(self) -> bool:
        """End the worker; whether it ended. Called before `destroy_node`."""
        return self._worker is None or self._worker.stop(_JOIN_TIMEOUT)

    def _reset(self, _: Trigger.Request, response: Trigger.Response) -> Trigger.Response:
        """Restart tracking; intrinsics and counters are kept."""
        response.success = self._loop is not None
        response.message = self._cannot_start or 'calibrating: nothing is estimated yet'
        if self._loop is not None:
            self._loop.sequencer.reset()
            response.message = 'restarting with the next frame'
        return response

    def _on_parameters(self, parameters: Parameters) -> None:
        if _camera(parameters) != _camera(self._active):
            self._begin()
        elif self._loop is not None:
            self._loop.parameters = parameters

    # -- calibration -------------------------------------------------------------------------

    def _consume_calibration(
        self, outcome: Progress | Calibrated | RsRelposeError | FrameFailed
    ) -> None:
        """By the worker; a calibration is used by `_use_found`, in the executor's thread."""
        if isinstance(outcome, FrameFailed):
            self._consume(outcome)
        elif isinstance(outcome, RsRelposeError):
            self._warn(str(outcome))
        elif isinstance(outcome, Progress):
            self._info(outcome.text)
            self._progress = outcome
        else:
            self._found = outcome

    def _use_found(self) -> None:
        found = self._found
        self._found = None
        if found is not None:
            self._use_calibration(found)

    def _use_calibration(self, found: Calibrated) -> None:
        """Store and publish a calibration, and estimate with it."""
        self._calibrated = found
        config = self._settings.current.calibration
        self._info(found.summary)
        path: Path | str = 'this calibration'
        try:
            path = stored.path_of(config, found.camera)
            if found.new and config.save_calibration:
                stored.save(path, found.camera, found.parameters, replace=False)
                self._info(f'the calibration is stored in {path}')
        except InputError as error:
            self._error(str(error))
        if self.calibrates:
            self._published.publish(String(data=found.parameters))
        self.adopt(found.parameters, str(path))
        if self._calibration is not None:  # nothing in it was new, or it cannot be used
            missing = self._settings.current.sensor.missing()
            if missing:
                self._warn(f'the calibration in {path} has no usable {" and ".join(missing)}')
            self._begin(calibrate=bool(missing))

    def _use_transform(self, frame_ids: Mapping[Role, str]) -> None:
        """Extrinsics from /tf_static, once it is there: parameters, or start of a calibration."""
        camera = frame_ids.get(Role.IMAGE)
        imu = frame_ids.get(Role.IMU)
        # If both sensors have one frame_id, the axes of the IMU are not known.
        if self._lookup is None or not camera or not imu or camera == imu:
            return
        found = self._lookup(camera, imu)
        calibration = self._calibration
        if found is None:
            if calibration is not None and calibration.waits_for:
                text = f'waiting for {calibration.waits_for}: {self._lookup.problem}'
                self._progress = Progress(text)
                self._info(text)
            return
        self._quat_prior = found[3:]
        if calibration is not None:
            calibration.quat_prior = self._quat_prior
            if not self._waits_for_tf():
                return
        self._lookup = None
        values, contradiction = extrinsics(self._settings.current, found, camera, imu)
        if contradiction:
            self._warn(contradiction)
        if values:
            self._info(f'from /tf_static, {imu} in {camera}: {", ".join(values)}')
            self._settings.adopt(values)

    def _calibrate_now(self, _: Trigger.Request, response: Trigger.Response) -> Trigger.Response:
        """Calibrate from here on; values that the user has given stay."""
        self._begin(calibrate=True)
        response.success = not self._cannot_start
        response.message = (
            self._cannot_start or 'calibrating: rotate the camera about all three axes'
        )
        return response

    def _save_now(self, _: Trigger.Request, response: Trigger.Response) -> Trigger.Response:
        """Store the calibration that is used."""
        if (found := self._calibrated) is None:
            response.message = 'there is no calibration yet: call ~/calibrate'
            return response
        try:
            path = stored.path_of(self._settings.current.calibration, found.camera)
            stored.save(path, found.camera, found.parameters)
            response.success = True
            response.message = f'stored in {path}'
        except InputError as error:
            response.message = str(error)
        return response

    # -- outcomes of frames (in the worker thread) ---------------------------------------------

    def _consume(self, outcome: Outcome[Any]) -> None:
        if isinstance(outcome, FrameRefused):
            self._frame_statistics.add_refusal(outcome.reason)
            self._log_refused(outcome)
            return
        if self._stamps is not None and outcome.stamp_ns is not None:
            self._stamps.write(str(outcome.stamp_ns))
        if isinstance(outcome, Frame):
            try:
                self._on_processed(outcome)
            except SHUT_DOWN:
                if self.context.ok():  # otherwise the node is being shut down
                    raise
            self._frame_statistics.add_frame(outcome.taken_ns)
            return
        assert self._worker is not None
        warning = (
            'a frame failed and tracking restarts with the next one'
            if self._worker.warm.is_set()
            else 'the kernels cannot be compiled'
        )
        reason = diagnostics.Reason(warning, f'{warning}: {outcome.reason}')
        self._frame_statistics.add_failure(reason)
        error = outcome.error
        if isinstance(error, RsRelposeError):
            self._error(f'{warning}: {error}')
        else:
            text = ''.join(traceback.format_exception(error))
            self._error(f'{warning}: {type(error).__name__}: {error}\n{text}')

    def _log_refused(self, refused: FrameRefused) -> None:
        if refused.refusal is Refusal.NO_CALIBRATION:
            return  # logged by `_missing_input`
        if refused.refusal is Refusal.IMU_GAP and not (
            self._loop and self._loop.sequencer.counts().frames_taken
        ):
            return  # the images began before the IMU; if it lasts, `_log_silence` gives it
        if refused.refusal is Refusal.NO_IMU:
            # A gap of 0.3 s between IMU messages: the sensor has stopped.
            if self._inputs is not None and self._inputs.silent(Role.IMU, 0.3):
                return  # logged by `_missing_input` after `SILENCE`
            self._warn(
                f'a frame was not used: {refused.reason}; is '
                f'{self.resolve_topic_name("imu")} published, with a gyro, and are its '
                'stamps on the clock of the images (time_offset)?'
            )
        else:
            self._warn(f'a frame was not used ({refused.refusal.value}): {refused.reason}')

    # -- diagnostics -------------------------------------------------------------------------

    def _report(self) -> None:
        if self._lookup is not None and self._inputs is not None:
            self._use_transform(self._inputs.frame_ids)
        problem, missing = self._problem()
        self.warn_of_namesake()
        inputs = self._inputs
        warning = ''
        counts: Counter[str] = Counter()
        if inputs is not None:
            warning = self._intake.warning or diagnostics.stamps_warning(
                inputs.stamps_ns, inputs.image_bytes
            )
            counts = inputs.counts.copy()
        source = self._calibration if self._loop is None else self._loop.sequencer
        report = self._frame_statistics.report(
            counts,
            None if source is None else source.counts(),
            problem=problem,
            missing=missing,
            progress=self._progress,
            warning=warning,
        )
        self.publish_status(
            report.level, self.task, report.text, self._image_topic(), report.values
        )
        if inputs is not None:
            self._log_silence(inputs, report.silence, problem)
            for role, frame_id in inputs.frame_ids.items():
                if not frame_id:
                    self._warn(
                        f'messages on {inputs.topics[role]} have no frame_id: no '
                        'transform is found for them, and RViz shows no result; set it in '
                        'the driver'
                    )
            if warning:
                self._warn(warning)

    def _log_silence(
        self, inputs: SensorInputs, silence: diagnostics.Silence, problem: str
    ) -> None:
        """Log the reason for no result, once while it stays the same."""
        if inputs.silent(Role.IMAGE, PATIENCE):
            kind, text = diagnostics.why_no_image(self._image_topic(), self._topics_with_images())
        elif silence.seconds < PATIENCE:
            self._reported_silence = ''
            return
        elif problem:
            return  # which is logged anyway
        else:
            kind, text = diagnostics.why_nothing(silence)
        if kind != self._reported_silence:
            self._reported_silence = kind
            self._warn(f'{self._frame_statistics.idle}: {text}')

    def _topics_with_images(self) -> list[str]:
        """Topics of other nodes, without pictures of pairs."""
        own = f'{self.get_fully_qualified_name()}/'
        images = set(PARTS[Role.IMAGE].msgtypes)
        return [
            name
            for name, types in self.get_topic_names_and_types()
            if images.intersection(types)
            and not name.startswith(own)
            and not name.endswith(f'/{outgoing.DEBUG_IMAGE}')
            and self.count_publishers(name)
        ]

    def _image_topic(self) -> str:
        """The subscribed one, with its transport."""
        if self._inputs is None:
            return self.resolve_topic_name('image')
        return self._inputs.topics[Role.IMAGE]

    def _problem(self) -> tuple[str, tuple[str, ...]]:
        """The current reason for no result, and the names of missing parameters or inputs."""
        text = self._cannot_start
        if not text and self._progress is not None:
            text = self._progress.text
        if text:
            return text, tuple(self._settings.current.sensor.missing())
        assert self._worker is not None
        if not self._worker.is_alive():
            return f'{self._frame_statistics.idle}: the worker ended, see the log', ()
        if self._inputs is None or not self._worker.warm.is_set():
            return STARTING, ()
        return self._missing_input(self._inputs)

    def _missing_input(self, inputs: SensorInputs) -> tuple[str, tuple[str, ...]]:
        """The missing input; logged, unless the driver is probably not running yet."""
        idle = self._frame_statistics.idle
        image, camera_info, imu, _ = inputs.topics.values()
        needed = {role: topic for role, topic in inputs.topics.items() if role is not Role.ACCEL}
        missing = tuple(topic for role, topic in needed.items() if inputs.silent(role))
        if self._intake.camera_info_problem:
            return f'{idle}: {self._intake.camera_info_problem}', ('calibration',)
        # Without any image the driver is probably not running: a status, but no log line.
        if image in missing:
            return f'{idle}: no image on {image} for {SILENCE:g} s', missing
        has_intrinsics = (
            self._intake.intrinsics is not None or self._settings.current.intrinsics.given
        )
        if camera_info in missing and not has_intrinsics:
            text = (
                f'{idle}: no CameraInfo on {camera_info}; remap camera_info to the '
                'topic of the driver, which must publish a calibration, or give '
                'camera_matrix'
            )
        elif imu in missing:
            text = (
                f'{idle}: no IMU message on {imu} for {SILENCE:g} s; remap imu to '
                'the topic of the driver'
            )
        else:
            return '', ()
        self._error(text)
        return text, missing
