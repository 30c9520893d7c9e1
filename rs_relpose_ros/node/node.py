"""relpose_node: publishes what the worker finds of each keyframe pair."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Any, TextIO

from rs_relpose_ros.config.parameters import Parameters
from rs_relpose_ros.front_end.front_end import FrameFailed, FrameProcessed, FrontEnd
from rs_relpose_ros.front_end.pair import PairResult
from rs_relpose_ros.front_end.sequencer import Sequencer
from rs_relpose_ros.front_end.warm_up import warm_up_pipeline
from rs_relpose_ros.messages.intake import Intake
from rs_relpose_ros.node.diagnostics import Statistics
from rs_relpose_ros.node.frame_timings import FrameTimings, opened
from rs_relpose_ros.node.health_log import HealthLog
from rs_relpose_ros.node.outputs import PairPublishers, SHUT_DOWN
from rs_relpose_ros.node.run import leave, run_node
from rs_relpose_ros.node.sensor_node import SensorNode
from rs_relpose_ros.node.worker import Event

NAME = 'relpose_node'

_DESCRIPTION = (
    'Relative poses of a rolling-shutter camera, aided by an IMU.\n\n'
    'subscribes: image (or image/compressed with image_transport:=compressed), '
    'camera_info, imu, accel\n'
    'publishes:  ~/relative_pose, ~/reference, ~/velocity, ~/matches, '
    '~/relative_rotation, ~/pairs,\n            ~/debug_image, /diagnostics\n'
    'service:    ~/reset')


class RelposeNode(SensorNode):
    """Relative poses of a rolling-shutter camera with an IMU."""

    task = 'relative pose'

    def __init__(self) -> None:
        self._statistics = Statistics()
        self._stamps: TextIO | None = None
        self._timings: FrameTimings | None = None
        super().__init__(NAME, self._statistics)

    def _open_outputs(self, parameters: Parameters) -> None:
        self._outputs = PairPublishers(self, parameters.pair)
        self._tell_health = HealthLog(self._info, self._warn, self._error)

    def _make_loop(self, parameters: Parameters) -> FrontEnd:
        files = parameters.pair
        self._stamps = opened('stamps_file', files.stamps_file) if files.stamps_file else None
        self._timings = FrameTimings(files.timings_file) if files.timings_file else None
        # The images are for ~/debug_image; only references to them are kept.
        return FrontEnd(parameters, keep_images=True)

    def _make_intake(self, parameters: Parameters, sequencer: Sequencer[Any]) -> Intake:
        return Intake(sequencer, parameters.imu.stuck_gyro_time, parameters.intrinsics)

    def _warm_up(self) -> None:
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

    def _consume(self, event: Event) -> None:
        if (self._stamps is not None and isinstance(event, FrameProcessed | FrameFailed)
                and event.stamp_ns is not None):
            self._stamps.write(f'{event.stamp_ns}\n')
        super()._consume(event)

    def _on_processed(self, frame: FrameProcessed[PairResult]) -> None:
        if frame.result is not None:
            config = self._settings.current.pair
            try:
                self._outputs.publish(frame.result, config)
                self._statistics.add_pair(frame.result, frame.ready_ns)
                self._outputs.publish_picture(frame.result, config)
            except SHUT_DOWN:
                if self.context.ok():   # otherwise the node is being shut down
                    raise
            self._tell_health(frame.result.health, withhold=config.withhold_when_wrong)
        self._statistics.add_frame(frame.taken_ns)
        if self._timings is not None:
            self._timings.add(frame)


def main(arguments: Sequence[str] | None = None,
         on_started: Callable[[], object] = lambda: None) -> int:
    """Run the node; see `run_node`."""
    return run_node(RelposeNode, NAME, _DESCRIPTION, arguments, on_started)


if __name__ == '__main__':
    leave(main())
