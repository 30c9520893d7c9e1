"""The node: subscribes, hands messages over, publishes what the worker finds."""

from __future__ import annotations

import argparse
from collections.abc import Callable, Sequence
import gc
import logging
import os
import signal
import sys
import threading
import traceback
from typing import NoReturn, TextIO

from diagnostic_msgs.msg import DiagnosticArray
import rclpy
from rclpy.clock import Clock, ClockType
from rclpy.exceptions import ParameterException
from rclpy.executors import ExternalShutdownException
from rclpy.impl.implementation_singleton import rclpy_implementation
from rclpy.node import Node
from rclpy.utilities import remove_ros_args
from std_srvs.srv import Trigger

from rs_relpose_ros.config.parameters import Parameters
from rs_relpose_ros.errors import InputError, RsRelposeError
from rs_relpose_ros.front_end.front_end import FrameFailed, FrameProcessed, FrontEnd
from rs_relpose_ros.front_end.sequencer import FrameRefused, Refusal
from rs_relpose_ros.geometry.timing import NANOSECONDS
from rs_relpose_ros.messages.intake import Intake
from rs_relpose_ros.messages.outgoing import diagnostics_message, status_message
from rs_relpose_ros.messages.sensor_feed import Role
from rs_relpose_ros.node.cause_log import CauseLog
from rs_relpose_ros.node.diagnostics import Inputs, SILENCE, Statistics
from rs_relpose_ros.node.frame_timings import FrameTimings, opened
from rs_relpose_ros.node.health_log import HealthLog
from rs_relpose_ros.node.inputs import SensorInputs
from rs_relpose_ros.node.message_types import message_class
from rs_relpose_ros.node.outputs import PairPublishers, SHUT_DOWN
from rs_relpose_ros.node.params import NodeParameters, unknown_overrides, unknown_qos_overrides
from rs_relpose_ros.node.worker import Event, WarmedUp, Worker

# Time [s] that the worker gets to end: a frame takes less, compiling takes longer.
_JOIN_TIMEOUT = 0.4
# Time [s] of a start above which kernels are being compiled, not loaded from the cache.
_TELL_COMPILING = 4.0


class RelposeNode(Node):
    """Relative poses of a rolling-shutter camera with an IMU; its states: docs/architecture.md.

    Callbacks convert little and hand over; one worker thread does the rest. An illegal parameter
    raises InputError.
    """

    def __init__(self) -> None:
        super().__init__('relpose_node')
        # A line of code each: rclpy raises where one line logs at two severities.
        logger = self.get_logger()
        self._info = CauseLog(lambda text: logger.info(text))
        self._warn = CauseLog(lambda text: logger.warning(text))
        self._error = CauseLog(lambda text: logger.error(text))
        self._tell_health = HealthLog(self._info, self._warn, self._error)
        self._settings = NodeParameters(self, self._on_parameters)
        for sentence in unknown_overrides(self):
            self._warn(sentence)
        self._statistics = Statistics()
        self._front_end: FrontEnd | None = None
        self._inputs: SensorInputs | None = None
        self._worker: Worker | None = None
        self._stamps: TextIO | None = None
        self._timings: FrameTimings | None = None
        self._warm = threading.Event()
        # For diagnostics and time-outs, which must run although /clock may stand still.
        self._steady = Clock(clock_type=ClockType.STEADY_TIME)
        self._outputs = PairPublishers(self, self._settings.current.pair)
        self._diagnostics = self.create_publisher(DiagnosticArray, '/diagnostics', 10)
        self.create_service(Trigger, '~/reset', self._reset)
        self._cannot_start = self._why_it_cannot_start()
        if self._cannot_start:
            self._error(self._cannot_start)
        else:
            self._start()
        self.create_timer(1.0, self._report, clock=self._steady)

    # -- start and stop ----------------------------------------------------------------------

    def _why_it_cannot_start(self) -> str:
        """What is wrong with parameters or topics; empty for nothing."""
        missing = self._settings.current.sensor.missing()
        if missing:
            return (f'not estimating: {" and ".join(missing)} must be given as parameter: see '
                    'config/relpose.yaml, and start again')
        topic = self.resolve_topic_name('image')
        if 'image_rect' in topic:
            return (f'not estimating: {topic} is a rectified image, in which a row no longer has '
                    'one instant; remap image to the raw one')
        return ''

    def _start(self) -> None:
        parameters = self._settings.current
        files = parameters.pair
        self._stamps = opened('stamps_file', files.stamps_file) if files.stamps_file else None
        self._timings = FrameTimings(files.timings_file) if files.timings_file else None
        # The images are for ~/debug_image; only references to them are kept.
        self._front_end = FrontEnd(parameters, keep_images=True)
        self._intake = Intake(self._front_end.sequencer, parameters.imu.stuck_gyro_time,
                              parameters.intrinsics)
        self._worker = Worker(self._front_end, self._consume)
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
        assert self._front_end is not None
        try:
            inputs = SensorInputs(
                self, self._intake, self._front_end.sequencer.waits_for_imu,
                self._settings.current.pair.image_transport, self._error, self._steady)
        except SHUT_DOWN:
            raise
        except (ParameterException, RuntimeError) as error:
            raise InputError(f'a QoS override is not legal: {error}') from error
        for sentence in unknown_qos_overrides(self):
            self._warn(sentence)
        # Objects that exist by now live to the end: the garbage collector need not scan them.
        gc.collect()
        gc.freeze()
        self._inputs = inputs
        image, camera_info, imu, _ = inputs.topics.values()
        self.get_logger().info(f'ready: {image}, {camera_info} and {imu}')

    def stop(self) -> bool:
        """End the worker; whether it did. Call it before `destroy_node`."""
        stopped = self._worker is None or self._worker.stop(_JOIN_TIMEOUT)
        for file in (self._stamps, self._timings):
            if file is not None and stopped:
                file.close()
        return stopped

    def _reset(self, _: Trigger.Request, response: Trigger.Response) -> Trigger.Response:
        """Start anew, as after a restart, but for the intrinsics and the counters."""
        response.success = self._front_end is not None
        response.message = self._cannot_start
        if self._front_end is not None:
            self._front_end.sequencer.reset()
            response.message = 'starting anew with the next frame'
        return response

    def _on_parameters(self, parameters: Parameters) -> None:
        if self._front_end is not None:
            self._front_end.parameters = parameters

    # -- what became of a frame (called by the worker) ---------------------------------------

    def _consume(self, event: Event) -> None:
        """The one outlet of the worker."""
        if isinstance(event, FrameRefused):
            self._tell_refused(event)
        elif isinstance(event, WarmedUp):
            if event.error is not None:
                self._tell_failed('the kernels cannot be compiled', event.error)
                return
            if self._timings is not None:
                self._timings.start()
            self._warm.set()
        else:
            if self._stamps is not None and event.stamp_ns is not None:
                self._stamps.write(f'{event.stamp_ns}\n')
            if isinstance(event, FrameFailed):
                self._tell_failed('a frame failed and tracking starts anew', event.error)
            else:
                self._on_processed(event)

    def _on_processed(self, frame: FrameProcessed) -> None:
        if frame.pair is not None:
            config = self._settings.current.pair
            try:
                self._outputs.publish(frame.pair, config)
                self._statistics.add_pair(frame.pair, frame.ready_ns)
                self._outputs.publish_picture(frame.pair, config)
            except SHUT_DOWN:
                if self.context.ok():   # otherwise the node is being shut down
                    raise
            self._tell_health(frame.pair.health, withhold=config.withhold_when_wrong)
        self._statistics.add_frame(frame.taken_ns)
        if self._timings is not None:
            self._timings.add(frame)

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
        self._statistics.add_failure(f'{sentence}: {error}')
        if isinstance(error, RsRelposeError):
            self._error(f'{sentence}: {error}')
        else:
            text = ''.join(traceback.format_exception(error))
            self._error(f'{sentence}: {type(error).__name__}: {error}\n{text}')

    # -- diagnostics -------------------------------------------------------------------------

    def _report(self) -> None:
        problem, missing = self._problem()
        report = self._statistics.report(
            Inputs() if self._inputs is None else self._inputs.totals(),
            None if self._front_end is None else self._front_end.sequencer.counts(),
            problem=problem, missing=missing)
        status = status_message(
            report.level, f'{self.get_fully_qualified_name()}: relative pose', report.text,
            self._image_topic(), report.values, message_class)
        self._diagnostics.publish(diagnostics_message(
            self.get_clock().now().nanoseconds, status, message_class))

    def _image_topic(self) -> str:
        """The subscribed one, with its transport, once there is one."""
        return (self.resolve_topic_name('image') if self._inputs is None
                else self._inputs.topics[Role.IMAGE])

    def _problem(self) -> tuple[str, tuple[str, ...]]:
        """Why nothing is estimated at the moment, and the names of what is missing."""
        if self._cannot_start:
            return self._cannot_start, tuple(self._settings.current.sensor.missing())
        assert self._worker is not None
        if not self._worker.is_alive():
            return 'not estimating: the worker ended, see the log', ()
        if self._inputs is None:
            return 'starting: kernels are compiled or loaded', ()
        return self._missing_input(self._inputs)

    def _missing_input(self, inputs: SensorInputs) -> tuple[str, tuple[str, ...]]:
        """Which sensor does not say what is needed; the log has it unless the driver is not up."""
        image, camera_info, imu, _ = inputs.topics.values()
        missing = tuple(topic for role, topic in inputs.topics.items()
                        if role is not Role.ACCEL and inputs.silent(role))
        if self._intake.camera_info_problem:
            return f'not estimating: {self._intake.camera_info_problem}', ('calibration',)
        # Without any image the driver is probably not running yet: a status, but no log line.
        if image in missing:
            return f'not estimating: no image on {image} for {SILENCE:g} s', missing
        if self._intake.intrinsics is None and camera_info in missing:
            text = (f'not estimating: no CameraInfo on {camera_info}; remap camera_info to the '
                    'topic of the driver, which must publish a calibration, or give '
                    'camera_matrix')
        elif imu in missing:
            text = (f'not estimating: no IMU message on {imu} for {SILENCE:g} s; remap imu to '
                    'the topic of the driver')
        else:
            return '', ()
        self._error(text)
        return text, missing

    def _now_ns(self) -> int:
        return int(self._steady.now().nanoseconds)


def _help() -> argparse.ArgumentParser:
    lines = ['parameters (set them with --ros-args -p NAME:=VALUE or --params-file FILE):']
    for name, default, declared in Parameters.declarations():
        shown = 'no default' if default is None else f'default {default!r}'
        lines.append(f'  {name}: {declared.description}. {declared.legal}; {shown}'
                     f'{"; live" if declared.live else ""}')
    return argparse.ArgumentParser(
        prog='relpose_node', formatter_class=argparse.RawDescriptionHelpFormatter,
        description=(
            'Relative poses of a rolling-shutter camera, aided by an IMU.\n\n'
            'subscribes: image (or image/compressed with image_transport:=compressed), '
            'camera_info, imu, accel\n'
            'publishes:  ~/relative_pose, ~/reference, ~/velocity, ~/matches, '
            '~/relative_rotation, ~/pairs,\n            ~/debug_image, /diagnostics\n'
            'service:    ~/reset'),
        epilog='\n'.join(lines))


def main(arguments: Sequence[str] | None = None,
         on_started: Callable[[], None] = lambda: None) -> int:
    """Run the node; its exit code: 0 after SIGINT or SIGTERM, 2 for an illegal parameter.

    `on_started` is called once rclpy handles the signals.
    """
    given = sys.argv if arguments is None else ['relpose_node', *arguments]
    try:
        own = remove_ros_args(given)
    except rclpy_implementation.RCLInvalidROSArgsError as error:
        # rcl names its source files behind the sentence.
        _fatal(str(error).split(', at /')[0].strip())
        return 2
    _help().parse_args(own[1:])
    rclpy.init(args=list(given))
    on_started()
    node: RelposeNode | None = None
    try:
        node = RelposeNode()
        rclpy.spin(node)
    except (KeyboardInterrupt, ExternalShutdownException):
        pass
    except rclpy_implementation.RCLError:
        # A signal may end the context amid a call.
        if rclpy.ok():
            raise
    except RsRelposeError as error:
        _fatal(str(error))
        return 2
    finally:
        _finish(node)
    return 0


def _fatal(sentence: str) -> None:
    rclpy.logging.get_logger('relpose_node').fatal(sentence)


def _finish(node: RelposeNode | None) -> None:
    """End the node; signals are ignored from here on, as Ctrl-C comes twice under ros2 launch."""
    _ignore_signals()
    if node is not None:
        if not node.stop():
            # The thread compiles or loads kernels, which cannot be interrupted.
            leave(0)
        node.destroy_node()
    rclpy.try_shutdown()
    # rclpy has restored the handlers that were there before it.
    _ignore_signals()


def leave(code: int) -> NoReturn:
    """End the process at once, all of its output written.

    Threads of ours, of OpenCV or of the middleware that still run while the interpreter and the
    libraries go down can abort it.
    """
    logging.shutdown()
    sys.stdout.flush()
    sys.stderr.flush()
    os._exit(code)


def _ignore_signals() -> None:
    for number in (signal.SIGINT, signal.SIGTERM):
        signal.signal(number, signal.SIG_IGN)


if __name__ == '__main__':
    leave(main())
