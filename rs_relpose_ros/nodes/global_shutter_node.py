"""global_shutter_node: derotated images of a rolling-shutter camera."""

from collections.abc import Callable
from functools import partial
import time
from typing import Any

from rclpy.qos import QoSProfile
from rclpy.qos_overriding_options import QoSOverridingOptions

from rs_relpose_ros.config.settings import Parameters
from rs_relpose_ros.messages import outgoing
from rs_relpose_ros.messages.incoming import PARTS, Role
from rs_relpose_ros.nodes.diagnostics import FrameStatistics, OK
from rs_relpose_ros.nodes.inputs import message_class
from rs_relpose_ros.nodes.sensor_node import run_node, SensorNode
from rs_relpose_ros.pipeline.global_shutter import (
    GlobalShutterFrame,
    unrolling_loop,
    warm_up_unroller,
)
from rs_relpose_ros.pipeline.pair import Frame
from rs_relpose_ros.pipeline.pipeline import FrameLoop

NAME = 'global_shutter_node'

# Queue of a third of a second of images.
_DEPTH = 10
_IMAGE_TYPES = PARTS[Role.IMAGE].msgtypes
_DESCRIPTION = (
    'Derotated images of a rolling-shutter camera: every row rotated by the gyro to the time of\n'
    'the middle one.\n\n'
    'subscribes: image (or image/compressed with image_transport:=compressed), '
    'camera_info, imu, accel\n'
    'publishes:  ~/image, ~/image/compressed and ~/mask, each while it is subscribed,\n'
    '            ~/camera_info, /diagnostics\n'
    'service:    ~/reset')


class _Statistics(FrameStatistics):
    """Statistics of the derotated images; thread-safe."""

    idle = 'not publishing'

    def __init__(self, clock: Callable[[], int] = time.monotonic_ns) -> None:
        super().__init__(clock)
        self._images = 0
        self._last: GlobalShutterFrame | None = None

    def add_image(self, frame: GlobalShutterFrame, ready_ns: int) -> None:
        """Count an image right after its publication; its data were complete at `ready_ns`."""
        with self._lock:
            self._images += 1
            self._last = frame
            self._published(ready_ns)

    def _evaluate_results(self) -> tuple[int, str]:
        return OK, f'publishing: {self._images} images' if self._images else 'no image yet'

    def _values(self) -> dict[str, object]:
        last = self._last
        return {'images_published': self._images,
                'largest_shift_px': '' if last is None else f'{last.map.shift:.1f}',
                'applied_time_offset_ms': '' if last is None else
                f'{1e-6 * last.applied_offset_ns:.2f}'}


class GlobalShutterNode(SensorNode):
    """Publishes each derotated image with a CameraInfo of the same stamp."""

    task = 'global shutter'
    calibrates = False   # relpose_node does, from the same images

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

    def _make_loop(self, parameters: Parameters) -> FrameLoop[GlobalShutterFrame]:
        return unrolling_loop(parameters)

    def _warm_up(self) -> None:
        warm_up_unroller(self._settings.current)

    def _on_ready(self) -> None:
        if self._settings.current.global_shutter.stamp_clock == 'imu':
            self._sibling_timer = self.create_timer(1.0, self._look_for_siblings,
                                                    clock=self._steady)

    def _on_processed(self, frame: Frame[GlobalShutterFrame]) -> None:
        assert frame.result is not None
        self._publish(frame.result)
        self._statistics.add_image(frame.result, frame.ready_ns)

    def _publish(self, frame: GlobalShutterFrame) -> None:
        """Publish the topics that are subscribed."""
        header = frame.stamp_ns, frame.frame_id
        raw, compressed, mask = (topic.get_subscription_count() for topic in (
            self._image, self._compressed, self._mask))
        if raw or compressed:
            pixels = frame.image()
            if raw:
                self._image.publish(outgoing.image_message(*header, pixels, message_class))
            if compressed:
                self._compressed.publish(outgoing.compressed_image_message(
                    *header, pixels, png=frame.is_png, types=message_class))
        self._camera_info.publish(outgoing.camera_info_message(
            *header, frame.intrinsics, self._intake.camera_info_of(frame.intrinsics),
            message_class))
        if mask:
            self._mask.publish(outgoing.image_message(*header, frame.mask(), message_class))

    def _look_for_siblings(self) -> None:
        """Warn of other images of the same driver, whose stamps stay on the camera's clock."""
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
                "while those of the derotated images are on the IMU's: set stamp_clock: camera "
                'where they are used together (depth, stereo)')

    def _publishing_nodes(self, topic: str) -> set[tuple[str, str]]:
        """Namespaces and names of the publishers of a topic, as far as they are known by now."""
        return {(info.node_namespace, info.node_name)
                for info in self.get_publishers_info_by_topic(topic)
                if info.node_namespace.startswith('/')}


main = partial(run_node, GlobalShutterNode, NAME, _DESCRIPTION)
