"""The node: subscribes, hands messages over, publishes what the worker finds."""

from __future__ import annotations

import argparse
from collections.abc import Callable, Sequence
from functools import partial
import gc
import logging
import os
from pathlib import Path
import signal
import sys
import traceback
from typing import Any, NoReturn, TextIO

from diagnostic_msgs.msg import DiagnosticArray
import rclpy
from rclpy.clock import Clock, ClockType
from rclpy.exceptions import InvalidHandle, ParameterException
from rclpy.executors import ExternalShutdownException
from rclpy.impl.implementation_singleton import rclpy_implementation
from rclpy.node import Node
from rclpy.qos import HistoryPolicy, QoSProfile, ReliabilityPolicy
from rclpy.qos_overriding_options import QoSOverridingOptions
from rclpy.utilities import remove_ros_args
from sensor_msgs.msg import CameraInfo, CompressedImage, Image, Imu
from std_srvs.srv import Trigger

from rs_relpose_ros.config.parameters import Parameters
from rs_relpose_ros.errors import InputError, RsRelposeError
from rs_relpose_ros.front_end.pair import PairResult
from rs_relpose_ros.front_end.sequencer import FrameRefused, ReadyFrame, Refusal, Sequencer
from rs_relpose_ros.geometry.timing import NANOSECONDS
from rs_relpose_ros.messages.intake import Intake
from rs_relpose_ros.messages.outgoing import (
    color_image_message,
    diagnostics_message,
    pair_messages,
    PAIR_TOPICS,
    status_message,
)
from rs_relpose_ros.messages.sensor_feed import Role
from rs_relpose_ros.node.cause_log import CauseLog
from rs_relpose_ros.node.debug_image import draw_debug_image
from rs_relpose_ros.node.diagnostics import Inputs, SILENCE, Statistics
from rs_relpose_ros.node.message_types import message_class
from rs_relpose_ros.node.params import NodeParameters, unknown_overrides, unknown_qos_overrides
from rs_relpose_ros.node.polled import PolledSubscription, WhenChanged
from rs_relpose_ros.node.transform import Broadcast, transform_broadcaster
from rs_relpose_ros.node.worker import Worker

# Best effort matches every publisher; a reliable subscription would not. Half a second of images:
# where the process had to wait for a processor its mailbox drops them, which is counted, and not
# the middleware, which is not.
_IMAGE_DEPTH = 15
# Samples of some seconds, so that no stall loses any.
_IMU_DEPTH = 2000

# IMU and CameraInfo are read so often [s] where no image asks for them.
_DRAIN_PERIOD = 0.1
# The worker ends within a frame, unless it compiles.
_JOIN_TIMEOUT = 0.4
# No IMU is silent for so long [s] while it works.
_SUSPICIOUS_SILENCE = 0.3
# Loading kernels from the cache takes less than this [s].
_TELL_COMPILING = 4.0


class RelposeNode(Node):
    """Relative poses of a rolling-shutter camera with an IMU.

    Callbacks convert little and hand over; one worker thread does the rest.

    Raises
    ------
    InputError
        A parameter is not legal.
    """

    def __init__(self) -> None:
        super().__init__('relpose_node')
        # rclpy ties the severity to the line that logs: a line each.
        logger = self.get_logger()
        self._info = CauseLog(lambda text: logger.info(text))
        self._warn = CauseLog(lambda text: logger.warning(text))
        self._error = CauseLog(lambda text: logger.error(text))
        self._settings = NodeParameters(self, self._on_parameters)
        for sentence in unknown_overrides(self):
            self._warn(sentence)
        self._statistics = Statistics()
        self._counts = dict.fromkeys(
            ('images', 'camera_infos', 'imu', 'accelerometer', 'invalid'), 0)
        self._sequencer: Sequencer | None = None
        self._intake: Intake | None = None
        self._worker: Worker | None = None
        self._stamps: TextIO | None = None
        self._ready_ns = 0
        self._heard_ns: dict[str, int] = {}
        # Diagnostics and time-outs go by the wall's pace also where /clock stands still.
        self._steady = Clock(clock_type=ClockType.STEADY_TIME)
        self._pair_publishers = {
            name: self.create_publisher(message_class(msgtype), f'~/{name}', 10)
            for name, msgtype in PAIR_TOPICS.items()}
        self._debug_image = self.create_publisher(Image, '~/debug_image', 2)
        self._diagnostics = self.create_publisher(DiagnosticArray, '/diagnostics', 10)
        self._broadcast: Broadcast | None = None
        if self._settings.current.pair.publish_tf:
            self._broadcast = transform_broadcaster(self)
        self.create_service(Trigger, '~/reset', self._reset)
        self._refused = self._cannot_estimate()
        if self._refused:
            self._error(self._refused)
        else:
            self._start()
        self.create_timer(1.0, self._report, clock=self._steady)

    # -- start and stop ----------------------------------------------------------------------

    def _cannot_estimate(self) -> str:
        """Why nothing can be estimated with these parameters and topics; empty for no reason."""
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
        if parameters.pair.stamps_file:
            self._stamps = _opened(parameters.pair.stamps_file)
        self._sequencer = Sequencer(parameters)
        self._intake = Intake(self._sequencer, parameters.imu.stuck_gyro_time)
        self._worker = Worker(parameters, self._sequencer, self._on_taken, self._on_result,
                              self._on_refused, self._on_failure)
        self._worker.start()
        self._started_ns = self._now_ns()
        # Subscribed only when ready: what comes earlier would be dropped.
        self._warm_timer = self.create_timer(0.02, self._subscribe_when_warm, clock=self._steady)

    def _subscribe_when_warm(self) -> None:
        assert self._worker is not None
        assert self._intake is not None and self._sequencer is not None
        if not self._worker.warm:
            if self._now_ns() - self._started_ns > _TELL_COMPILING * NANOSECONDS:
                self._info('compiling kernels: the first start takes a minute or two, the later '
                           'ones some seconds')
            return
        self.destroy_timer(self._warm_timer)
        try:
            self._subscribe(self._intake, self._sequencer)
        except (InvalidHandle, rclpy_implementation.RCLError):
            raise   # the node is being shut down
        except (ParameterException, RuntimeError) as error:
            raise InputError(f'a QoS override is not legal: {error}') from error
        for sentence in unknown_qos_overrides(self):
            self._warn(sentence)
        # All that exists by now lives to the end: collections need not look at it again.
        gc.collect()
        gc.freeze()
        self._ready_ns = self._now_ns()
        self.get_logger().info(
            f'ready: {self._image_topic}, {self.resolve_topic_name("camera_info")} and '
            f'{self.resolve_topic_name("imu")}')

    def _subscribe(self, intake: Intake, sequencer: Sequencer) -> None:
        image_type: type = Image
        image_topic = self.resolve_topic_name('image')
        if self._settings.current.pair.image_transport == 'compressed':
            # As image_transport does: the transport's name follows the remapped one.
            image_type = CompressedImage
            image_topic = f'{image_topic}/compressed'
        self._image_topic = image_topic
        waiting = sequencer.waits_for_imu
        self._info_subscription = PolledSubscription(
            self, CameraInfo, 'camera_info', _best_effort(_IMAGE_DEPTH), self._receiver(
                'camera_infos',
                WhenChanged(CameraInfo, partial(intake.receive, Role.CAMERA_INFO))),
            lambda: intake.intrinsics is None, raw=True)
        self._imu_subscriptions = [
            PolledSubscription(self, Imu, 'imu', _best_effort(_IMU_DEPTH),
                               self._receiver('imu', partial(intake.receive, Role.IMU)), waiting),
            PolledSubscription(self, Imu, 'accel', _best_effort(_IMU_DEPTH),
                               self._receiver('accelerometer', partial(intake.receive, Role.ACCEL)),
                               waiting)]
        receive_image = self._receiver('images', partial(intake.receive, Role.IMAGE))

        def with_all_before(image: Any) -> None:
            # What came before it counts for it.
            self._info_subscription.drain()
            receive_image(image)
            self._drain_imu()

        self.create_subscription(
            image_type, image_topic, with_all_before, _best_effort(_IMAGE_DEPTH),
            qos_overriding_options=QoSOverridingOptions.with_default_policies())
        self.create_timer(_DRAIN_PERIOD, self._drain, clock=self._steady)

    def stop(self) -> bool:
        """End the worker; whether it did. Call it before `destroy_node`."""
        stopped = self._worker is None or self._worker.stop(_JOIN_TIMEOUT)
        if self._stamps is not None and stopped:
            self._stamps.close()
        return stopped

    def _reset(self, _: Trigger.Request, response: Trigger.Response) -> Trigger.Response:
        """Start anew, as after a restart, but for the calibration and the counters."""
        response.success = self._sequencer is not None
        if self._sequencer is not None:
            self._sequencer.reset()
            response.message = 'starting anew with the next frame'
        else:
            response.message = self._refused
        return response

    # -- messages in -------------------------------------------------------------------------

    def _drain(self) -> None:
        self._info_subscription.drain()
        self._drain_imu()

    def _drain_imu(self) -> None:
        for subscription in self._imu_subscriptions:
            subscription.drain()

    def _receiver(self, kind: str, add: Callable[[Any], None]) -> Callable[[Any], None]:
        def receive(msg: Any) -> None:
            self._counts[kind] += 1
            self._heard_ns[kind] = self._now_ns()
            try:
                add(msg)
            except RsRelposeError as error:
                self._counts['invalid'] += 1
                self._error(str(error))
        return receive

    def _on_parameters(self, parameters: Parameters) -> None:
        if self._worker is not None:
            self._worker.change(parameters)

    # -- results out (called by the worker) --------------------------------------------------

    def _on_taken(self, ready: ReadyFrame) -> None:
        if self._stamps is not None:
            self._stamps.write(f'{ready.frame.stamp_ns}\n')

    def _on_result(self, ready: ReadyFrame, result: PairResult | None) -> None:
        self._publish_result(ready, result)
        self._statistics.add_frame(ready.taken_ns)

    def _publish_result(self, ready: ReadyFrame, result: PairResult | None) -> None:
        if result is None:
            return
        try:
            if result.pose:
                self._publish(result)
            self._statistics.add_pair(result, ready.ready_ns)
            if (self._settings.current.pair.publish_debug_image
                    and self._debug_image.get_subscription_count()):
                self._debug_image.publish(color_image_message(
                    result.stamp_ns, result.frame_id, draw_debug_image(result), message_class))
        except (rclpy_implementation.RCLError, InvalidHandle):
            if self.context.ok():   # else the node is being shut down
                raise

    def _publish(self, result: PairResult) -> None:
        messages = pair_messages(
            result, message_class, self._settings.current.pair.reference_frame)
        for name, publisher in self._pair_publishers.items():
            publisher.publish(getattr(messages, name))
        if self._broadcast is not None:
            self._broadcast(messages.relative_pose, result.frame_id)

    def _on_refused(self, refused: FrameRefused) -> None:
        if refused.cause is Refusal.NO_CALIBRATION:
            return   # told where the CameraInfo is missed or refused
        if refused.cause is Refusal.NO_IMU:
            if self._silent('imu', _SUSPICIOUS_SILENCE):
                return   # told once it lasts
            self._warn(f'a frame was not used: {refused.reason}; is '
                       f'{self.resolve_topic_name("imu")} published, with a gyro, and are its '
                       'stamps on the clock of the images (time_offset)?')
        else:
            self._warn(f'a frame was not used ({refused.cause.value}): {refused.reason}')

    def _on_failure(self, sentence: str, error: Exception) -> None:
        self._statistics.add_failure(f'{sentence}: {error}')
        if isinstance(error, RsRelposeError):
            self._error(f'{sentence}: {error}')
        else:
            text = ''.join(traceback.format_exception(error))
            self._error(f'{sentence}: {type(error).__name__}: {error}\n{text}')

    # -- diagnostics -------------------------------------------------------------------------

    def _report(self) -> None:
        problem, missing = self._problem()
        counts = None if self._sequencer is None else self._sequencer.counts()
        report = self._statistics.report(
            Inputs(**self._counts), counts, problem=problem, missing=missing)
        status = status_message(
            report.level, f'{self.get_fully_qualified_name()}: relative pose', report.text,
            self.resolve_topic_name('image'), report.values, message_class)
        self._diagnostics.publish(diagnostics_message(
            self.get_clock().now().nanoseconds, status, message_class))

    def _problem(self) -> tuple[str, tuple[str, ...]]:
        """Why nothing is estimated at the moment, and the names of what is missing."""
        if self._refused:
            return self._refused, tuple(self._settings.current.sensor.missing())
        assert self._worker is not None and self._intake is not None
        if not self._worker.is_alive():
            return 'not estimating: the worker ended, see the log', ()
        if not self._ready_ns:
            return 'starting: kernels are compiled or loaded', ()
        silent = {kind: self._silent(kind) for kind in ('images', 'camera_infos', 'imu')}
        topics = {'images': self._image_topic,
                  'camera_infos': self.resolve_topic_name('camera_info'),
                  'imu': self.resolve_topic_name('imu')}
        missing = tuple(topics[kind] for kind, is_silent in silent.items() if is_silent)
        if self._intake.camera_info_problem:
            return f'not estimating: {self._intake.camera_info_problem}', ('calibration',)
        # Where nothing comes at all the driver is not running yet: worth a status, not a warning.
        if silent['images']:
            return f'not estimating: no image on {topics["images"]} for {SILENCE:g} s', missing
        if self._intake.intrinsics is None and silent['camera_infos']:
            text = (f'not estimating: no CameraInfo on {topics["camera_infos"]}; remap '
                    'camera_info to the topic of the driver, which must publish a calibration')
            self._error(text)
            return text, missing
        if silent['imu']:
            text = (f'not estimating: no IMU message on {topics["imu"]} for {SILENCE:g} s; remap '
                    'imu to the topic of the driver')
            self._error(text)
            return text, missing
        return '', ()

    def _silent(self, kind: str, seconds: float = SILENCE) -> bool:
        heard_ns = self._heard_ns.get(kind, self._ready_ns)
        return self._now_ns() - heard_ns > seconds * NANOSECONDS

    def _now_ns(self) -> int:
        return int(self._steady.now().nanoseconds)


def _best_effort(depth: int) -> QoSProfile:
    """A profile of its own: rclpy writes a topic's overrides into what it is given."""
    return QoSProfile(history=HistoryPolicy.KEEP_LAST, depth=depth,
                      reliability=ReliabilityPolicy.BEST_EFFORT)


def _opened(path: str) -> TextIO:
    try:
        return Path(path).open('w', buffering=1, encoding='ascii')
    except OSError as error:
        raise InputError(f'stamps_file {path} cannot be written: {error.strerror}') from error


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
            'publishes:  ~/relative_pose, ~/reference, ~/velocity, ~/matches, ~/debug_image, '
            '/diagnostics\n'
            'service:    ~/reset'),
        epilog='\n'.join(lines))


def main(arguments: Sequence[str] | None = None,
         on_started: Callable[[], None] = lambda: None) -> int:
    """Run the node; its exit code: 0 after SIGINT or SIGTERM, 2 for an illegal parameter.

    `on_started` is called once rclpy handles the signals.
    """
    given = sys.argv if arguments is None else ['relpose_node', *arguments]
    _help().parse_args(remove_ros_args(given)[1:])
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
        rclpy.logging.get_logger('relpose_node').fatal(str(error))
        return 2
    finally:
        _finish(node)
    return 0


def _finish(node: RelposeNode | None) -> None:
    _ignore_signals()
    if node is not None:
        if not node.stop():
            # Compiling or loading kernels cannot be interrupted.
            leave(0)
        node.destroy_node()
    rclpy.try_shutdown()
    # It brought back the handlers of before.
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
    """From here on the node ends anyway; Ctrl-C comes twice under ros2 launch."""
    for number in (signal.SIGINT, signal.SIGTERM):
        signal.signal(number, signal.SIG_IGN)


if __name__ == '__main__':
    leave(main())
