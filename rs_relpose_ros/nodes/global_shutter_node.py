"""global_shutter_node: derotated images of a rolling-shutter camera."""

from collections.abc import Callable
from functools import partial
import re
import time
from typing import Any

from diagnostic_msgs.msg import DiagnosticArray
from rclpy.qos import QoSProfile
from rclpy.qos_overriding_options import QoSOverridingOptions

from rs_relpose_ros.config.settings import Parameters
from rs_relpose_ros.messages import outgoing
from rs_relpose_ros.messages.incoming import PARTS, Role
from rs_relpose_ros.nodes.diagnostics import (
    ERROR,
    FrameStatistics,
    HealthLog,
    OK,
    RELATIVE_POSE,
    WARN,
)
from rs_relpose_ros.nodes.inputs import message_class
from rs_relpose_ros.nodes.sensor_node import run_node, SensorNode
from rs_relpose_ros.pipeline import global_shutter
from rs_relpose_ros.pipeline.findings import Assessment, Finding, FindingState, NOT_EVALUATED
from rs_relpose_ros.pipeline.pair import Frame
from rs_relpose_ros.pipeline.pipeline import FrameLoop

NAME = 'global_shutter_node'

# Queue of a third of a second of images.
_DEPTH = 10
# Age of a state of relpose_node, which comes once a second [s].
_FRESH = 3.0
_IMAGE_TYPES = PARTS[Role.IMAGE].msgtypes
_DESCRIPTION = (
    'Derotated images of a rolling-shutter camera: every row rotated by the gyro to the time of\n'
    'the middle one.\n\n'
    'subscribes: image (or image/compressed with image_transport:=compressed), '
    'camera_info, imu, accel,\n            calibration, /diagnostics\n'
    'publishes:  ~/image, ~/image/compressed and ~/mask, each while it is subscribed,\n'
    '            ~/camera_info, /diagnostics\n'
    'service:    ~/reset')


def assessment_of(status: Any) -> Assessment:
    """Findings of a status of relpose_node on /diagnostics."""
    texts = {item.key: item.value for item in status.values}.get('health_findings', '')
    return Assessment(tuple(
        Finding(quantity, FindingState(state), message) for quantity, state, message in re.findall(
            rf'(\w+) ({"|".join(FindingState)}): ([^;]*)', texts)))


class _Statistics(FrameStatistics):
    """Statistics of the derotated images; thread-safe."""

    idle = 'not publishing'

    def __init__(self, clock: Callable[[], int] = time.monotonic_ns) -> None:
        super().__init__(clock)
        self._images = self._withheld = 0
        self._last: global_shutter.GlobalShutterFrame | None = None
        self._health, self._source = NOT_EVALUATED, ''

    def add_image(self, frame: global_shutter.GlobalShutterFrame, ready_ns: int,
                  health: Assessment, source: str, *, withheld: bool) -> None:
        """Count an image right after its publication; its data were complete at `ready_ns`.

        `source`: the node that made the assessment `health`.
        """
        with self._lock:
            self._images += not withheld
            self._withheld += withheld
            self._last, self._health, self._source = frame, health, source
            self._published(ready_ns)

    def _evaluate_results(self) -> tuple[int, str]:
        if faults := self._health.faults:
            return ERROR if faults[0].state is FindingState.WRONG else WARN, faults[0].text
        return OK, f'publishing: {self._images} images' if self._images else 'no image yet'

    def _values(self) -> dict[str, object]:
        last = self._last
        return {'images_published': self._images, 'images_withheld': self._withheld,
                'health': self._health.state.value, 'health_source': self._source,
                'largest_shift_px': '' if last is None else f'{last.map.shift:.1f}',
                'applied_time_offset_ms': '' if last is None else
                f'{1e-6 * last.applied_offset_ns:.2f}'}


class GlobalShutterNode(SensorNode):
    """Publishes each derotated image with a CameraInfo of the same stamp."""

    task = 'global shutter'
    calibrates = False   # relpose_node does, from the same images

    def __init__(self) -> None:
        self._statistics = _Statistics()
        # With its time [s] and the name of its node.
        self._of_others: tuple[float, Assessment, str] | None = None
        super().__init__(NAME, self._statistics)
        self.create_subscription(DiagnosticArray, '/diagnostics', self._on_diagnostics, 10)

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
        self._log_health = HealthLog(self._info, self._warn, self._error, 'images')

    def _make_loop(self, parameters: Parameters) -> FrameLoop[global_shutter.GlobalShutterFrame]:
        return global_shutter.unrolling_loop(
            parameters, watched=lambda: self._by_relpose() is None)

    def _warm_up(self) -> None:
        global_shutter.warm_up_unroller(self._settings.current)

    def _on_ready(self) -> None:
        if self._settings.current.global_shutter.stamp_clock == 'imu':
            self._sibling_timer = self.create_timer(1.0, self._look_for_siblings,
                                                    clock=self._steady)

    def _on_processed(self, frame: Frame[global_shutter.GlobalShutterFrame]) -> None:
        result = frame.result
        assert result is not None
        health, source = self._by_relpose() or (result.health, 'own watch')
        withhold = self._settings.current.pair.withhold_when_wrong
        withheld = withhold and health.state is FindingState.WRONG
        self._log_health(health, withhold=withhold)
        if not withheld:
            self._publish(result)
        self._statistics.add_image(result, frame.ready_ns, health, source, withheld=withheld)

    def _by_relpose(self) -> tuple[Assessment, str] | None:
        """Assessment and name of relpose_node; None if it does not run on these images."""
        found = self._of_others
        return found[1:] if found and time.monotonic() - found[0] < _FRESH else None

    def _on_diagnostics(self, message: Any) -> None:
        """Keep the state of relpose_node on the same images."""
        own = self._image_topic().removesuffix('/compressed')
        for status in message.status:
            if (status.name.endswith(f': {RELATIVE_POSE}')
                    and status.hardware_id.removesuffix('/compressed') == own):
                self._of_others = (time.monotonic(), assessment_of(status),
                                   status.name.partition(':')[0])

    def _publish(self, frame: global_shutter.GlobalShutterFrame) -> None:
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
