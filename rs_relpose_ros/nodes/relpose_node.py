"""relpose_node: publishes the keyframe pairs of a rolling-shutter camera with an IMU."""

from collections.abc import Callable
from functools import partial

from rclpy.node import Node
from scipy.spatial.transform import Rotation

from rs_relpose_ros.config.settings import PairConfig, Parameters
from rs_relpose_ros.messages import outgoing
from rs_relpose_ros.messages.outgoing import DEBUG_IMAGE, PAIR_TOPICS
from rs_relpose_ros.nodes import diagnostics
from rs_relpose_ros.nodes.inputs import message_class, transform_broadcaster
from rs_relpose_ros.nodes.sensor_node import run_node, SensorNode
from rs_relpose_ros.pipeline.pair import Frame, PairResult
from rs_relpose_ros.pipeline.pipeline import FrontEnd
from rs_relpose_ros.pipeline.warm_up import fill_cache_if_empty, warm_up_pipeline
from rs_relpose_ros.tracking.images import Pixels

# Name of the node. [derived: interface]
NAME = 'relpose_node'

# What --help prints. [derived: the topics and services below]
_DESCRIPTION = (
    'Relative poses of a rolling-shutter camera, aided by an IMU.\n\n'
    'subscribes: image (or image/compressed with image_transport:=compressed), '
    'camera_info, imu, accel\n'
    'publishes:  ~/relative_pose, ~/reference, ~/velocity, ~/matches, '
    '~/relative_rotation, ~/pairs,\n            ~/debug_image, ~/calibration, /diagnostics\n'
    'services:   ~/reset, ~/calibrate, ~/save_calibration'
)


class RelposeNode(SensorNode):
    """Relative poses of a rolling-shutter camera with an IMU."""

    task = diagnostics.RELATIVE_POSE

    def __init__(self) -> None:
        self._statistics = diagnostics.Statistics()
        self._timings: diagnostics.FrameTimings | None = None
        super().__init__(NAME, self._statistics)

    def _open_outputs(self, parameters: Parameters) -> None:
        self._outputs = PairPublishers(self, parameters.pair)
        self._log_health = diagnostics.HealthLog(self._info, self._warn, self._error)

    def _make_loop(self, parameters: Parameters) -> FrontEnd:
        files = parameters.pair
        if files.stamps_file and self._stamps is None:
            self._stamps = diagnostics.LineFile('stamps_file', files.stamps_file, self._error)
        if files.timings_file and self._timings is None:
            self._timings = diagnostics.FrameTimings(files.timings_file, self._error)
        # The images are for ~/debug_image; only references to them are kept.
        return FrontEnd(parameters, keep_images=True)

    def _warm_up(self) -> None:
        fill_cache_if_empty()
        warm_up_pipeline(self._settings.current)
        if self._timings is not None:
            self._timings.start()

    def stop(self) -> bool:
        """End the worker; whether it did. Call it before `destroy_node`."""
        stopped = super().stop()
        for file in (self._stamps, self._timings):
            if file is not None and stopped:
                file.close()
        return stopped

    def _on_processed(self, frame: Frame[PairResult]) -> None:
        if frame.result is not None:
            config = self._settings.current.pair
            count = partial(self._statistics.add_pair, frame.result, frame.ready_ns)
            self._outputs.publish(frame.result, config, count)
            self._log_health(frame.result.health, withhold=config.withhold_when_wrong)
        if self._timings is not None:
            self._timings.add(frame)


# -- Topics ---------------------------------------------------------------------------------------


class PairPublishers:
    """Publishes pairs on the topics of the node, and as a transform with publish_tf."""

    def __init__(self, node: Node, config: PairConfig) -> None:
        self._pair = {
            name: node.create_publisher(message_class(msgtype), f'~/{name}', outgoing.PAIR_HISTORY)
            for name, msgtype in PAIR_TOPICS.items()
        }
        self._debug_image = node.create_publisher(
            message_class('sensor_msgs/msg/Image'), f'~/{DEBUG_IMAGE}', 2
        )
        self._transforms = transform_broadcaster(node, 'publish_tf') if config.publish_tf else None

    def publish(
        self,
        result: PairResult,
        config: PairConfig,
        published: Callable[[], object],
    ) -> None:
        """Publish what is known of a pair and subscribed; `published` follows the first topic."""
        parts = outgoing.pair_parts(result, message_class, config.reference_frame)
        first = next(iter(parts))
        for topic, make in parts.items():
            if self._pair[topic].get_subscription_count():
                self._pair[topic].publish(make())
            if topic == first:
                published()
        if self._transforms is not None and result.pose:
            # The camera has its parent in the robot's tree already, and a frame has only one: so
            # the reference is the child, by the pose's inverse. Its origin is one baseline away,
            # whose length in metres is unknown.
            quaternion = outgoing.quat_xyzw(result.pose.R)
            self._transforms.sendTransform(
                outgoing.transform_message(
                    result.stamp_ns,
                    result.frame_id,
                    config.reference_frame or f'{result.frame_id}_reference',
                    quaternion * [-1.0, -1.0, -1.0, 1.0],
                    -Rotation.from_quat(quaternion).inv().apply(result.pose.t),
                    message_class,
                )
            )
        if config.publish_debug_image and self._debug_image.get_subscription_count():
            pixels = Pixels(outgoing.draw_pair(result), 'bgr8')
            message = outgoing.image_message(
                result.stamp_ns, result.frame_id, pixels, message_class
            )
            self._debug_image.publish(message)


main = partial(run_node, RelposeNode, NAME, _DESCRIPTION)
