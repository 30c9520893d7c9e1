"""global_shutter_node: the images of a rolling-shutter camera as if from a global shutter."""

from __future__ import annotations

from collections.abc import Callable, Sequence
import time
from typing import Any

from rclpy.qos import QoSProfile
from rclpy.qos_overriding_options import QoSOverridingOptions

from rs_relpose_ros.config.parameters import Parameters
from rs_relpose_ros.front_end.front_end import FrameLoop, FrameProcessed
from rs_relpose_ros.front_end.sequencer import Sequencer
from rs_relpose_ros.global_shutter.frames import (
    color_frames,
    ColorFrame,
    GlobalShutterFrame,
)
from rs_relpose_ros.global_shutter.unroller import unrolling_loop
from rs_relpose_ros.global_shutter.warm_up import warm_up_unroller
from rs_relpose_ros.messages.intake import Intake
from rs_relpose_ros.messages.outgoing import (
    camera_info_message,
    compressed_image_message,
    image_message,
)
from rs_relpose_ros.node.frame_statistics import FrameStatistics, OK
from rs_relpose_ros.node.inputs import SensorInputs
from rs_relpose_ros.node.message_types import message_class
from rs_relpose_ros.node.outputs import SHUT_DOWN
from rs_relpose_ros.node.run import leave, run_node
from rs_relpose_ros.node.sensor_node import SensorNode

NAME = 'global_shutter_node'

# Queue of a third of a second of images.
_DEPTH = 10
_IMAGE_TYPES = ('sensor_msgs/msg/Image', 'sensor_msgs/msg/CompressedImage')
_DESCRIPTION = (
    'Images of a rolling-shutter camera as if all rows had been seen at once, with the middle\n'
    'one: every pixel turned by the gyro.\n\n'
    'subscribes: image (or image/compressed with image_transport:=compressed), '
    'camera_info, imu, accel\n'
    'publishes:  ~/image, ~/image/compressed and ~/mask, each while somebody subscribes,\n'
    '            ~/camera_info, /diagnostics\n'
    'service:    ~/reset')


class _Statistics(FrameStatistics):
    """Figures of the turned images; thread-safe."""

    idle = 'not publishing'

    def __init__(self, clock: Callable[[], int] = time.monotonic_ns) -> None:
        super().__init__(clock)
        self._images = 0
        self._last: GlobalShutterFrame | None = None

    def add_image(self, turned: GlobalShutterFrame, ready_ns: int) -> None:
        """Count an image right after its publication; all for it had come by `ready_ns`."""
        with self._lock:
            self._images += 1
            self._last = turned
            self._published(ready_ns)

    def _judge_results(self) -> tuple[int, str]:
        return OK, f'publishing: {self._images} images' if self._images else 'no image yet'

    def _values(self) -> tuple[tuple[str, str], ...]:
        last = self._last
        return (('images_published', str(self._images)),
                ('largest_shift_px', '' if last is None else f'{last.map.shift:.1f}'),
                ('applied_time_offset_ms', '' if last is None else
                 f'{1e-6 * last.applied_offset_ns:.2f}'))


class GlobalShutterNode(SensorNode):
    """Publishes each image turned to its middle row, with a CameraInfo of the same stamp."""

    task = 'global shutter'

    def __init__(self) -> None:
        self._statistics = _Statistics()
        super().__init__(NAME, self._statistics)

    def _open_outputs(self, parameters: Parameters) -> None:
        def publisher(msgtype: str, topic: str) -> Any:
            return self.create_publisher(
                message_class(msgtype), topic, QoSProfile(depth=_DEPTH),
                qos_overriding_options=QoSOverridingOptions.with_default_policies())
        self._image, self._compressed = (
            publisher(msgtype, topic) for msgtype, topic in zip(
                _IMAGE_TYPES, ('~/image', '~/image/compressed'), strict=True))
        self._mask = publisher(_IMAGE_TYPES[0], '~/mask')
        self._camera_info = publisher('sensor_msgs/msg/CameraInfo', '~/camera_info')

    def _make_loop(self, parameters: Parameters) -> FrameLoop[ColorFrame, GlobalShutterFrame]:
        return unrolling_loop(parameters)

    def _make_intake(self, parameters: Parameters, sequencer: Sequencer[Any]) -> Intake:
        return Intake(sequencer, parameters.imu.stuck_gyro_time, parameters.intrinsics,
                      color_frames())

    def _warm_up(self) -> None:
        warm_up_unroller(self._settings.current)

    def _on_ready(self, inputs: SensorInputs) -> None:
        if self._settings.current.global_shutter.stamp_clock == 'imu':
            self._sibling_timer = self.create_timer(1.0, self._look_for_siblings,
                                                    clock=self._steady)

    def _on_processed(self, frame: FrameProcessed[GlobalShutterFrame]) -> None:
        assert frame.result is not None
        try:
            self._publish(frame.result)
        except SHUT_DOWN:
            if self.context.ok():   # otherwise the node is being shut down
                raise
        self._statistics.add_image(frame.result, frame.ready_ns)
        self._statistics.add_frame(frame.taken_ns)

    def _publish(self, turned: GlobalShutterFrame) -> None:
        """Publish what somebody subscribes to."""
        frame = turned.frame
        place = turned.stamp_ns, frame.frame_id
        raw, compressed, mask = (topic.get_subscription_count() for topic in (
            self._image, self._compressed, self._mask))
        if raw or compressed:
            pixels = turned.image()
            if raw:
                self._image.publish(image_message(*place, pixels, message_class))
            if compressed:
                self._compressed.publish(compressed_image_message(
                    *place, pixels, png=frame.is_png, types=message_class))
        self._camera_info.publish(camera_info_message(
            *place, frame.intrinsics, self._intake.camera_info_of(frame.intrinsics),
            message_class))
        if mask:
            self._mask.publish(image_message(*place, turned.mask(), message_class))

    def _look_for_siblings(self) -> None:
        """Tell once of images of the same driver, whose stamps stay on the camera's clock."""
        assert self._inputs is not None
        own = next(iter(self._inputs.topics.values()))
        drivers = self._publishing_nodes(own)
        if not drivers:
            return
        self.destroy_timer(self._sibling_timer)
        base = own.removesuffix('/compressed')
        # Transports of the same image lie below it.
        others = sorted(
            name for name, types in self.get_topic_names_and_types()
            if set(types) & set(_IMAGE_TYPES) and not f'{name}/'.startswith(f'{base}/')
            and drivers & self._publishing_nodes(name))
        if others:
            self._warn(
                f'{", ".join(others)} of the same driver keep stamps on the clock of the camera, '
                "while those of the turned images are on the IMU's: set stamp_clock: camera "
                'where they are used together (depth, stereo)')

    def _publishing_nodes(self, topic: str) -> set[tuple[str, str]]:
        """Namespaces and names of who publishes a topic, as far as they are known by now."""
        return {(info.node_namespace, info.node_name)
                for info in self.get_publishers_info_by_topic(topic)
                if info.node_namespace.startswith('/')}


def main(arguments: Sequence[str] | None = None,
         on_started: Callable[[], object] = lambda: None) -> int:
    """Run the node; see `run_node`."""
    return run_node(GlobalShutterNode, NAME, _DESCRIPTION, arguments, on_started)


if __name__ == '__main__':
    leave(main())
