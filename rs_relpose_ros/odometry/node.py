"""odometry_node: metric odometry from the pairs of relpose_node and the IMU."""

from __future__ import annotations

from collections import deque
from collections.abc import Callable, Sequence
from functools import partial
import importlib
from typing import Any

from rclpy.clock import Clock, ClockType
from rclpy.node import Node
from rclpy.qos import QoSProfile
from rclpy.qos_overriding_options import QoSOverridingOptions
from std_srvs.srv import Trigger

from rs_relpose_ros.config.odometry import OdometryConfig
from rs_relpose_ros.errors import InputError, MissingInputError, RsRelposeError
from rs_relpose_ros.geometry.timing import NANOSECONDS
from rs_relpose_ros.messages.outgoing import (
    diagnostics_message,
    pose_stamped_message,
    status_message,
)
from rs_relpose_ros.messages.sensor_feed import PARTS, Role
from rs_relpose_ros.node.cause_log import CauseLog
from rs_relpose_ros.node.inputs import best_effort
from rs_relpose_ros.node.message_types import message_class
from rs_relpose_ros.node.params import legal_qos, NodeParameters, unknown_overrides
from rs_relpose_ros.node.polled import PolledSubscription
from rs_relpose_ros.node.run import leave, run_node
from rs_relpose_ros.node.stoppable import StoppableNode
from rs_relpose_ros.odometry.library import need_gtsam
from rs_relpose_ros.odometry.measurement import PairMeasurement
from rs_relpose_ros.odometry.outgoing import odometry_message, path_message, transform_message
from rs_relpose_ros.odometry.warm_up import warm_up_odometry

NAME = 'odometry_node'

# Topic of the pairs, below the node's namespace.
_PAIRS = 'relpose_node/pairs'
_IMU_DEPTH, _DEPTH = 2000, 100
# Rate at which the IMU is read at least, though less may be published between keyframes [Hz].
_LEAST_RATE = 10.0
# Keyframes of ~/path, the newest ones; a rate at which it can be drawn [s].
_PATH_LENGTH, _PATH_PERIOD = 3000, 1.0
# Reports (one a second) without a message after which a topic counts as silent.
_SILENCE = 2
# Level and text of diagnostic_msgs/DiagnosticStatus by state.
_STATES = {
    'tracking': (0, 'tracking'),
    'starting': (1, 'not started: the scale is not known yet'),
    'told wrong': (2, 'stopped: what was told of camera or IMU is wrong, see relpose_node')}
_DESCRIPTION = (
    'Metric odometry: the keyframe pairs of relpose_node and the IMU in one graph (gtsam).\n\n'
    f'subscribes: {_PAIRS}, imu, accel\n'
    'publishes:  ~/odometry, ~/path, /diagnostics, /tf with publish_odometry_tf\n'
    'service:    ~/reset')


class OdometryNode(StoppableNode):
    """Feeds pairs and samples to an `OdometryEstimator`, and publishes what comes of them."""

    def __init__(self) -> None:
        super().__init__(NAME)
        need_gtsam()
        from rs_relpose_ros.odometry.odometry import OdometryEstimator
        warm_up_odometry()
        logger = self.get_logger()
        self._info = CauseLog(lambda text: logger.info(text))
        self._warn = CauseLog(lambda text: logger.warning(text))
        self._settings = NodeParameters(self, lambda parameters: None)
        for sentence in unknown_overrides(self):
            self._warn(sentence)
        parameters = self._settings.current
        self._config: OdometryConfig = parameters.odometry
        self._estimator = OdometryEstimator(parameters)
        # Newest sample and newest published instant, on the IMU's clock.
        self._newest_ns = self._last_ns = 0
        self._path: deque[Any] = deque(maxlen=_PATH_LENGTH)
        self._transforms = _broadcaster(self) if self._config.publish_odometry_tf else None
        with legal_qos():
            self._open_topics()
        self.create_service(Trigger, '~/reset', self._reset)
        steady = Clock(clock_type=ClockType.STEADY_TIME)
        rate = self._config.odometry_rate
        if rate > 0.0:
            self.create_timer(1.0 / rate, self._carry_on, clock=steady)
        if rate < _LEAST_RATE:
            self.create_timer(1.0 / _LEAST_RATE, self._read_sensors, clock=steady)
        self.create_timer(_PATH_PERIOD, self._publish_path, clock=steady)
        self.create_timer(1.0, self._report, clock=steady)
        self._info(f'ready: {" and ".join(self._silent)}')

    def _open_topics(self) -> None:
        def overridable() -> QoSOverridingOptions:
            return QoSOverridingOptions.with_default_policies()

        self._odometry = self.create_publisher(
            message_class('nav_msgs/msg/Odometry'), '~/odometry', QoSProfile(depth=_DEPTH),
            qos_overriding_options=overridable())
        self._path_topic = self.create_publisher(message_class('nav_msgs/msg/Path'), '~/path', 1)
        self._diagnostics = self.create_publisher(
            message_class('diagnostic_msgs/msg/DiagnosticArray'), '/diagnostics', 10)
        self.create_subscription(
            message_class('diagnostic_msgs/msg/DiagnosticArray'), _PAIRS, self._on_pair,
            QoSProfile(depth=_DEPTH), qos_overriding_options=overridable())
        # Read as often as odometry is published: an IMU would wake the process for each sample.
        self._sensors = [PolledSubscription(
            self, message_class(PARTS[role].msgtypes[0]), role.value, best_effort(_IMU_DEPTH),
            partial(self._on_sample, role), lambda: False, qos_overriding_options=overridable())
            for role in (Role.IMU, Role.ACCEL)]
        self._pairs, self._imu = map(self.resolve_topic_name, (_PAIRS, Role.IMU.value))
        # Reports since the last message, by topic.
        self._silent = {self._pairs: 0, self._imu: 0}

    def stop(self) -> bool:
        """Nothing runs beside the executor."""
        return True

    def _reset(self, _: Trigger.Request, response: Trigger.Response) -> Trigger.Response:
        """Start anew at the origin, as after a restart, but for the counters."""
        self._estimator.reset()
        self._path.clear()
        response.success, response.message = True, 'starting anew with the next pair'
        return response

    def _on_pair(self, message: Any) -> None:
        self._silent[self._pairs] = 0
        try:
            self._estimator.add_pair(PairMeasurement.of_message(message))
        except RsRelposeError as error:
            self._warn(str(error))
            return
        self._read_sensors()

    def _on_sample(self, role: Role, message: Any) -> None:
        if role is Role.IMU:
            self._silent[self._imu] = 0
        try:
            sample = PARTS[role].read(message)
            self._estimator.add_imu(sample)
        except InputError as error:
            self._warn(str(error))
            return
        if role is Role.IMU:
            self._newest_ns = sample.stamp_ns

    def _carry_on(self) -> None:
        """Publish where the IMU has led the newest keyframe."""
        self._read_sensors()
        if self._newest_ns != self._last_ns:
            carried = self._estimator.carried(self._newest_ns)
            if carried is not None:
                self._publish(carried)

    def _read_sensors(self) -> None:
        for subscription in self._sensors:
            subscription.drain()
        for keyframe in self._estimator.take():
            self._publish(keyframe)
            self._path.append(pose_stamped_message(
                keyframe.stamp_ns, self._config.odometry_frame, keyframe.R, keyframe.position,
                message_class))
        for sentence in self._estimator.sentences():
            self._info(sentence)

    def _publish(self, odometry: Any) -> None:
        """Publish; a keyframe that the IMU has been carried beyond goes out, but not to /tf."""
        self._odometry.publish(odometry_message(
            odometry, self._config.odometry_frame, message_class))
        if odometry.imu_ns > self._last_ns or \
                odometry.imu_ns < self._last_ns - NANOSECONDS:   # a clock that was set back
            self._last_ns = odometry.imu_ns
            if self._transforms is not None:
                self._transforms.sendTransform(transform_message(
                    odometry, self._config.odometry_frame, message_class))

    def _publish_path(self) -> None:
        if self._path and self._path_topic.get_subscription_count():
            newest = self._path[-1].header.stamp
            self._path_topic.publish(path_message(
                list(self._path), newest.sec * NANOSECONDS + newest.nanosec,
                self._config.odometry_frame, message_class))

    def _report(self) -> None:
        estimator = self._estimator
        level, state = _STATES[estimator.state.value]
        if obstacle := estimator.obstacle:
            level, state = 2, f'not started: {obstacle}'
            self._warn(state)
        for topic in self._silent:
            self._silent[topic] += 1
        silent = [f'{topic} for {reports - 1} s' for topic, reports in self._silent.items()
                  if reports > _SILENCE]
        if silent:
            level, state = 2, f'no message on {" and ".join(silent)}'
        values = [('state', estimator.state.value), *(
            (name.replace(' ', '_'), str(estimator.counts[name])) for name in (
                'pairs', 'contradicting', 'late', 'without IMU', 'lost', 'told wrong'))]
        if estimator.starts:
            started = estimator.starts[-1]
            values += [('started', 'at rest' if started.at_rest else 'in motion'),
                       ('start_scale_sigma', f'{started.scale_sigma:.3f}')]
        self._diagnostics.publish(diagnostics_message(
            self.get_clock().now().nanoseconds, status_message(
                level, f'{self.get_fully_qualified_name()}: odometry', state, self._pairs,
                values, message_class), message_class))


def _broadcaster(node: Node) -> Any:
    try:
        return importlib.import_module('tf2_ros').TransformBroadcaster(node)
    except ImportError as error:
        raise MissingInputError('publish_odometry_tf needs tf2_ros, which is not installed: '
                                'install ros-jazzy-tf2-ros-py, or set it to false') from error


def main(arguments: Sequence[str] | None = None,
         on_started: Callable[[], object] = lambda: None) -> int:
    """Run the node; see `run_node`."""
    return run_node(OdometryNode, NAME, _DESCRIPTION, arguments, on_started)


if __name__ == '__main__':
    leave(main())
