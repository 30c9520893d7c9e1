"""global_shutter_node: derotated images of a rolling-shutter camera."""

from collections.abc import Callable
from functools import partial
import time
from typing import Any

from diagnostic_msgs.msg import DiagnosticArray
from rclpy.qos import QoSProfile
from rclpy.qos_overriding_options import QoSOverridingOptions

from rs_relpose_ros.calibration import findings_text
from rs_relpose_ros.calibration.findings import Assessment, FindingState, NOT_EVALUATED
from rs_relpose_ros.config.settings import Parameters
from rs_relpose_ros.errors import InputError
from rs_relpose_ros.messages import outgoing
from rs_relpose_ros.nodes.diagnostics import (
    evaluate_faults,
    FrameStatistics,
    HealthLog,
    OK,
    RELATIVE_POSE,
)
from rs_relpose_ros.nodes.inputs import message_class
from rs_relpose_ros.nodes.sensor_node import run_node, SensorNode
from rs_relpose_ros.pipeline import global_shutter
from rs_relpose_ros.pipeline.pair import Frame
from rs_relpose_ros.pipeline.pipeline import FrameLoop

# Name of the node. [derived: interface]
NAME = 'global_shutter_node'

# Images that wait to be sent: a third of a second, so that a subscriber that pauses loses none.
# [chosen: any value in 5..30 would do]
_DEPTH = 10
# Largest age of a state of relpose_node [s], which comes once a second. [chosen: two may be lost]
_FRESH = 3.0
# What --help prints. [derived: the topics and services below]
_DESCRIPTION = (
    'Derotated images of a rolling-shutter camera: every row rotated by the gyro to the time of\n'
    'the middle one.\n\n'
    'subscribes: image (or image/compressed with image_transport:=compressed), '
    'camera_info, imu, accel,\n            calibration, /diagnostics\n'
    'publishes:  ~/image, ~/image/compressed and ~/mask, each while it is subscribed,\n'
    '            ~/camera_info, /diagnostics\n'
    'service:    ~/reset'
)


def assessment_of(status: Any) -> Assessment:
    """Findings of a status of relpose_node on /diagnostics; InputError if they are unusable."""
    values = {item.key: item.value for item in status.values}
    return findings_text.read_message_json(values.get('findings', ''))


class _Statistics(FrameStatistics):
    """Statistics of the derotated images; thread-safe."""

    idle = 'not publishing'

    def __init__(self, clock: Callable[[], int] = time.monotonic_ns) -> None:
        super().__init__(clock)
        self._images = self._withheld = 0
        self._last: global_shutter.GlobalShutterFrame | None = None
        self._health = NOT_EVALUATED
        self._source = ''

    def add_image(
        self,
        frame: global_shutter.GlobalShutterFrame,
        ready_ns: int,
        health: Assessment,
        source: str,
        *,
        withheld: bool,
    ) -> None:
        """Count an image right after its publication; its data were complete at `ready_ns`.

        `source`: the node that made the assessment `health`.
        """
        with self._lock:
            self._images += not withheld
            self._withheld += withheld
            self._last = frame
            self._health = health
            self._source = source
            self._published(ready_ns)

    def _evaluate_results(self) -> tuple[int, str]:
        if self._health.faults:
            return evaluate_faults(self._health)
        return OK, f'publishing: {self._images} images' if self._images else 'no image yet'

    def _values(self) -> dict[str, object]:
        shift = offset = ''
        if self._last is not None:
            shift = f'{self._last.map.shift:.1f}'
            offset = f'{1e-6 * self._last.applied_offset_ns:.2f}'
        return {
            'images_published': self._images,
            'images_withheld': self._withheld,
            'health': self._health.state.value,
            'health_source': self._source,
            'largest_shift_px': shift,
            'applied_time_offset_ms': offset,
        }


class GlobalShutterNode(SensorNode):
    """Publishes each derotated image with a CameraInfo of the same stamp."""

    task = 'global shutter'
    calibrates = False  # relpose_node does, from the same images

    def __init__(self) -> None:
        self._statistics = _Statistics()
        # The last state of relpose_node, with its time [s] and the name of that node.
        self._of_others: tuple[float, Assessment, str] | None = None
        super().__init__(NAME, self._statistics)
        self.create_subscription(DiagnosticArray, '/diagnostics', self._on_diagnostics, 10)

    def _open_outputs(self, parameters: Parameters) -> None:
        def publisher(msgtype: str, topic: str) -> Any:
            return self.create_publisher(
                message_class(msgtype),
                topic,
                QoSProfile(depth=_DEPTH),
                qos_overriding_options=QoSOverridingOptions.with_default_policies(),
            )

        self._image = publisher('sensor_msgs/msg/Image', '~/image')
        self._compressed = publisher('sensor_msgs/msg/CompressedImage', '~/image/compressed')
        self._mask = publisher('sensor_msgs/msg/Image', '~/mask')
        self._camera_info = publisher('sensor_msgs/msg/CameraInfo', '~/camera_info')
        self._log_health = HealthLog(self._info, self._warn, self._error, 'images')

    def _make_loop(self, parameters: Parameters) -> FrameLoop[global_shutter.GlobalShutterFrame]:
        return global_shutter.unrolling_loop(
            parameters, watched=lambda: self._by_relpose() is None
        )

    def _warm_up(self) -> None:
        global_shutter.warm_up_unroller(self._settings.current)

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
            node, _, task = status.name.rpartition(': ')
            if task != RELATIVE_POSE or status.hardware_id.removesuffix('/compressed') != own:
                continue
            try:
                self._of_others = time.monotonic(), assessment_of(status), node
            except InputError as error:
                self._warn(f'the state of {node} is not used: {error}')

    def _publish(self, frame: global_shutter.GlobalShutterFrame) -> None:
        """Publish the topics that are subscribed."""
        origin = frame.stamp_ns, frame.frame_id
        raw = self._image.get_subscription_count()
        compressed = self._compressed.get_subscription_count()
        if raw or compressed:
            pixels = frame.image()
            if raw:
                self._image.publish(outgoing.image_message(*origin, pixels, message_class))
            if compressed:
                message = outgoing.compressed_image_message(
                    *origin, pixels, png=frame.is_png, types=message_class
                )
                self._compressed.publish(message)
        published = self._intake.camera_info_of(frame.intrinsics)
        info = outgoing.camera_info_message(*origin, frame.intrinsics, published, message_class)
        self._camera_info.publish(info)
        if self._mask.get_subscription_count():
            self._mask.publish(outgoing.image_message(*origin, frame.mask(), message_class))


main = partial(run_node, GlobalShutterNode, NAME, _DESCRIPTION)
