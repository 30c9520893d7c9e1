"""odometry_node: metric odometry from the pairs of relpose_node and the IMU."""

from collections import deque
from collections.abc import Callable, Iterable
from functools import partial
import time
from typing import Any

from rclpy.clock import Clock, ClockType
from rclpy.qos import QoSProfile
from rclpy.qos_overriding_options import QoSOverridingOptions
from std_srvs.srv import Trigger

from rs_relpose_ros.calibration import findings_text
from rs_relpose_ros.calibration.findings import Assessment
from rs_relpose_ros.config.settings import Parameters
from rs_relpose_ros.errors import InputError, RsRelposeError
from rs_relpose_ros.garbage import collect_as_usual
from rs_relpose_ros.messages import outgoing
from rs_relpose_ros.messages.incoming import PARTS, Role, stamp_ns
from rs_relpose_ros.messages.published_pair import PublishedPair
from rs_relpose_ros.messages.transforms import extrinsics
from rs_relpose_ros.nodes import inputs
from rs_relpose_ros.nodes.executor import PolledSubscription
from rs_relpose_ros.nodes.inputs import message_class
from rs_relpose_ros.nodes.parameters import legal_qos
from rs_relpose_ros.nodes.sensor_node import run_node, StoppableNode
from rs_relpose_ros.odometry import need_gtsam
from rs_relpose_ros.odometry.pair import warm_up_odometry
from rs_relpose_ros.odometry.states import Base, ContinuousPath, Odometry, OdometryState

# Name of the node. [derived: interface]
NAME = 'odometry_node'

# Topic of the pairs, below the node's namespace. [derived: interface]
_PAIRS = 'relpose_node/pairs'
# Queue length of the IMU. It is read at `_LEAST_RATE` or faster, but not while a pair is added: a
# shorter queue would lose samples of a slow machine, a longer one costs memory. [chosen: 10 s at
# 200 Hz]
_IMU_DEPTH = 2000
# Queue length of other topics. A shorter one would lose messages for a subscriber that pauses.
# [chosen: 5 s of pairs at 10 Hz]
_DEPTH = 50
# Lowest rate [Hz] at which the IMU is read; the published rate may be lower. A lower one would
# make the silence of the IMU known late. [chosen: 4 to 50 Hz would do]
_LEAST_RATE = 10.0
# Number of newest keyframes on ~/path. More make a message larger than RViz draws at 1 Hz.
# [chosen: some minutes of keyframes; 500 to 10,000 would do]
_PATH_LENGTH = 3000
# Reports (one a second) without a message after which a topic counts as silent.
# [chosen: 2 to 5 would do; the first report comes at any time within its second]
_SILENCE = 2
# Time without a sample after which the IMU is silent [s]. Less would report a burst of delayed
# samples, more would propagate a path without an IMU. [chosen: 0.1 to 0.5 s would do]
_SILENT_IMU = 0.25
# Level of diagnostic_msgs/DiagnosticStatus by state. [derived: interface]
_LEVELS = {
    OdometryState.STARTING: 0,
    OdometryState.TRACKING: 0,
    OdometryState.UNCERTAIN: 1,
    OdometryState.LOST: 2,
}
# Counters of the estimator on /diagnostics. [derived: interface]
_COUNTS = (
    'pairs',
    'contradicting',
    'late',
    'without images',
    'dropped',
    'lost',
    'calibration contradicted',
    'knocks',
    'unsolved',
)
# What --help prints. [derived: the topics and services below]
_DESCRIPTION = (
    'Metric odometry: the keyframe pairs of relpose_node and the IMU in one graph (gtsam).\n\n'
    f'subscribes: {_PAIRS}, imu, accel, camera_info, calibration\n'
    'publishes:  ~/odometry, ~/keyframes, ~/path, /diagnostics, /tf with publish_odometry_tf\n'
    'service:    ~/reset'
)


class OdometryNode(StoppableNode):
    """Feeds pairs and samples to an `OdometryEstimator` and publishes its keyframes."""

    def __init__(self) -> None:
        super().__init__(NAME)
        need_gtsam()
        self.log_compiling()
        warm_up_odometry()
        self._begun = False
        self._imu_lookup: inputs.TransformLookup | None = None
        if self._settings.current.calibration.use_tf:
            self._imu_lookup = inputs.TransformLookup(self)
        self.use_calibrations()
        missing = self._settings.current.sensor.missing()
        if missing:
            self._info(
                f'waiting for {" and ".join(missing)}: parameters, or the calibration of '
                f'relpose_node on {self.resolve_topic_name("calibration")}'
            )
        else:
            self._begin(self._settings.current)
        collect_as_usual()

    def _on_parameters(self, parameters: Parameters) -> None:
        if self._begun:
            self._use(parameters)
        elif not parameters.sensor.missing():
            self._begin(parameters)

    def _use(self, parameters: Parameters) -> None:
        """A path with these parameters, from the next pair on."""
        from rs_relpose_ros.odometry.estimator import OdometryEstimator

        self._estimator = OdometryEstimator(parameters)
        self._continuous = ContinuousPath(self._estimator.propagated)
        if self._estimator.base is None:
            self._lookup = inputs.TransformLookup(self)

    def _begin(self, parameters: Parameters) -> None:
        self._begun = True
        self._config = parameters.odometry
        self._use(parameters)
        self._sample_at = time.monotonic()
        self._frames: dict[Role, str] = {}  # of the samples
        self._path: deque[Any] = deque(maxlen=_PATH_LENGTH)
        self._transforms: Any = None
        if self._config.publish_odometry_tf:
            self._transforms = inputs.transform_broadcaster(self, 'publish_odometry_tf')
        with legal_qos():
            self._open_topics()
        self.create_service(Trigger, '~/reset', self._reset)
        steady = Clock(clock_type=ClockType.STEADY_TIME)
        rate = self._config.odometry_rate
        if rate > 0.0:
            self.create_timer(1.0 / rate, lambda: self._read(publish=True), clock=steady)
        if rate < _LEAST_RATE:
            self.create_timer(1.0 / _LEAST_RATE, self._read, clock=steady)
        self.create_timer(1.0, self._report, clock=steady)
        self._info(f'ready: {" and ".join(self._silent)}')

    def _open_topics(self) -> None:
        self._odometry, self._keyframes = (
            self.create_publisher(
                message_class('nav_msgs/msg/Odometry'),
                topic,
                QoSProfile(depth=_DEPTH),
                qos_overriding_options=QoSOverridingOptions.with_default_policies(),
            )
            for topic in ('~/odometry', '~/keyframes')
        )
        self._path_topic = self.create_publisher(message_class('nav_msgs/msg/Path'), '~/path', 1)

        samples = inputs.best_effort(_IMU_DEPTH)
        # Read as often as odometry is published: each message would wake the process.
        self._inputs = [
            self._polled(
                'imu', 'sensor_msgs/msg/Imu', samples, partial(self._on_sample, Role.IMU)
            ),
            self._polled(
                'accel', 'sensor_msgs/msg/Imu', samples, partial(self._on_sample, Role.ACCEL)
            ),
            # CameraInfo shows whether the camera still delivers where no pair comes.
            self._polled(
                'camera_info',
                'sensor_msgs/msg/CameraInfo',
                inputs.best_effort(_DEPTH),
                lambda info: self._estimator.add_frame(stamp_ns(info.header)),
            ),
            self._polled(
                _PAIRS,
                'diagnostic_msgs/msg/DiagnosticArray',
                QoSProfile(depth=outgoing.PAIR_HISTORY),
                self._on_pair,
            ),
        ]
        self._pairs = self.resolve_topic_name(_PAIRS)
        self._imu = self.resolve_topic_name('imu')
        # Reports since the last message, by topic.
        self._silent = {self._pairs: 0, self._imu: 0}

    def _polled(
        self, topic: str, msgtype: str, qos: QoSProfile, receive: Callable[[Any], None]
    ) -> PolledSubscription:
        """A subscription that `_read` empties; `receive` gets each message."""

        def receive_all(messages: list[Any]) -> None:
            for message in messages:
                receive(message)

        return PolledSubscription(
            self,
            message_class(msgtype),
            topic,
            qos,
            receive_all,
            lambda: False,
            qos_overriding_options=QoSOverridingOptions.with_default_policies(),
        )

    def _reset(self, _: Trigger.Request, response: Trigger.Response) -> Trigger.Response:
        """Restart at the origin; counters stay."""
        self._estimator.reset()
        self._continuous.reset()
        self._path.clear()
        self._frames.clear()
        response.success = True
        response.message = 'restarting with the next pair'
        return response

    def _on_pair(self, message: Any) -> None:
        self._silent[self._pairs] = 0
        try:
            pair = PublishedPair.of_status(message)
        except InputError as error:
            self._warn(f'{error}; {self._pairs} must be of a relpose_node of this release')
            return
        try:
            self._place_imu(pair.frame_id, self._frames.get(Role.IMU, ''))
            if self._estimator.base is None:
                base = self._config.base_frame
                found = self._lookup(base, pair.frame_id)
                if found:
                    self._estimator.base = Base.of(base, found)
            self._estimator.add_pair(pair)
        except RsRelposeError as error:
            self._warn(str(error))

    def _place_imu(self, camera: str, imu: str) -> None:
        """Position of the IMU by /tf_static, if it is there before the path begins."""
        if self._imu_lookup is None or not imu or imu == camera or self._estimator.starts:
            return
        found = self._imu_lookup(camera, imu)
        if found is None:
            return
        self._imu_lookup = None
        values, contradiction = extrinsics(self._settings.current, found, camera, imu)
        if contradiction:
            self._warn(contradiction)
        if values:
            self._settings.adopt(values)

    def _on_sample(self, role: Role, message: Any) -> None:
        frame = message.header.frame_id
        first = self._frames.setdefault(role, frame)
        if frame != first:
            self._warn(
                f'a message of {frame} on {self.resolve_topic_name(role.value)} is not '
                f'used, as the first was of {first}: remap {role.value} to one IMU; '
                '~/reset accepts another one'
            )
            return
        if role is Role.IMU:
            self._silent[self._imu] = 0
        try:
            self._estimator.add_imu(PARTS[role].read(message))
        except InputError as error:
            self._warn(str(error))
            return
        if role is Role.IMU:
            self._sample_at = time.monotonic()

    def _read(self, *, publish: bool = False) -> None:
        """Read all topics, publish the newest state, and use a pair then, which takes time."""
        for subscription in self._inputs:
            subscription.drain()
        silent = time.monotonic() - self._sample_at
        if silent > _SILENT_IMU:
            self._estimator.imu_is_silent(silent)
        if publish:
            self._publish(self._estimator.newest_ns)
        for keyframe in self._estimator.take(most=1):
            self._keyframes.publish(self._message(keyframe))
            self._path.append(self._pose(keyframe))
            if self._config.odometry_rate == 0.0:
                self._publish(keyframe.imu_ns)
        logs = self._info, self._warn, self._error
        for notice in self._estimator.warnings():
            # A change of the state has the level of the state.
            level = 0 if notice.state is None else _LEVELS[notice.state]
            logs[level](notice.text)

    def _pose(self, odometry: Odometry) -> Any:
        return outgoing.pose_stamped_message(
            odometry.stamp_ns,
            self._config.odometry_frame,
            odometry.R,
            odometry.position,
            message_class,
        )

    def _message(self, odometry: Odometry) -> Any:
        """nav_msgs/Odometry; its twist is in the axes of the child frame."""
        pose = self._pose(odometry)
        return message_class('nav_msgs/msg/Odometry')(
            header=pose.header,
            child_frame_id=odometry.frame_id,
            pose=message_class('geometry_msgs/msg/PoseWithCovariance')(
                pose=pose.pose,
                covariance=outgoing.published_covariance(odometry.pose_covariance),
            ),
            twist=outgoing.twist_message(
                odometry.velocity,
                odometry.angular_velocity,
                odometry.velocity_covariance,
                message_class,
            ),
        )

    def _publish(self, imu_ns: int) -> None:
        """Publish the state at a time, if it is known and newer than the last one."""
        odometry = self._continuous.at(imu_ns)
        if odometry is None:
            return
        self._odometry.publish(self._message(odometry))
        if self._transforms is not None:
            self._transforms.sendTransform(
                outgoing.transform_message(
                    odometry.stamp_ns,
                    self._config.odometry_frame,
                    odometry.frame_id,
                    odometry.R,
                    odometry.position,
                    message_class,
                )
            )

    def _report(self) -> None:
        if self._path and self._path_topic.get_subscription_count():
            path_class = message_class('nav_msgs/msg/Path')
            poses = list(self._path)
            self._path_topic.publish(path_class(header=poses[-1].header, poses=poses))
        self.warn_of_namesake()
        level, text = self._status()
        self.publish_status(level, 'odometry', text, self._pairs, self._values())

    def _status(self) -> tuple[int, str]:
        """Level and text on /diagnostics; a problem is logged, too."""
        estimator = self._estimator
        for topic in self._silent:
            self._silent[topic] += 1
        silent = [
            f'{topic} for {reports - 1} s'
            for topic, reports in self._silent.items()
            if reports > _SILENCE
        ]
        problems = []
        if estimator.blocking_reason:
            problems.append(f'not started: {estimator.blocking_reason}')
        if silent:
            problems.append(
                f'no message on {" and ".join(silent)}: start or remap what publishes it '
                '(relpose_node, the driver of the IMU)'
            )
        for problem in problems:
            self._warn(problem)
        if problems:
            return 2, problems[-1]
        state = estimator.state.value
        text = f'{state}: {estimator.reason}' if estimator.reason else state
        return _LEVELS[estimator.state], text

    def _values(self) -> list[tuple[str, str]]:
        """The fields of /diagnostics."""
        estimator = self._estimator
        values = {'state': estimator.state.value, 'reason': estimator.reason}
        for name in _COUNTS:
            values[name.replace(' ', '_')] = str(estimator.counts[name])
        position, position_sigma = estimator.imu_position
        values['imu_position'] = _numbers(position, '.3f')
        values['imu_position_sigma'] = _numbers(position_sigma, '.3f')
        for name, (deviation, sigma) in estimator.deviations.items():
            values[f'{name}_deviation'] = _numbers(deviation, '.3g')
            values[f'{name}_deviation_sigma'] = _numbers(sigma, '.3g')
        values['findings'] = findings_text.message_json(Assessment(estimator.findings))
        if estimator.starts:
            started = estimator.starts[-1]
            values['started'] = 'at rest' if started.at_rest else 'in motion'
            values['start_scale_sigma'] = f'{started.scale_sigma:.3f}'
        return list(values.items())


def _numbers(values: Iterable[float], form: str) -> str:
    return ' '.join(f'{value:{form}}' for value in values)


main = partial(run_node, OdometryNode, NAME, _DESCRIPTION)
