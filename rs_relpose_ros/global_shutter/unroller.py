"""What is made of each frame: turned to its middle row, and stamped with its instant."""

from __future__ import annotations

from dataclasses import replace

from rs_relpose_ros.config.parameters import Parameters
from rs_relpose_ros.front_end.derotated_rays import Sensor
from rs_relpose_ros.front_end.frame import Frame, sensor_camera
from rs_relpose_ros.front_end.front_end import FrameLoop
from rs_relpose_ros.front_end.pipeline import Pipeline
from rs_relpose_ros.geometry.timing import exposure_shift, to_nanoseconds
from rs_relpose_ros.global_shutter.frames import ColorFrame, GlobalShutterFrame
from rs_relpose_ros.global_shutter.row_map import MiddleRow
from rs_relpose_ros.health.tracked import Applied, NOTHING_APPLIED
from rs_relpose_ros.imu.frame_imu import FrameImu


class Unroller:
    """Turns frames, as a processor of `FrameLoop`.

    Where `track_time_offset` or `track_readout_time` is told, the frames go through the pipeline
    of relpose_node as well, after they are out, and what it tracks is applied here.
    """

    def __init__(self) -> None:
        self._pipeline: Pipeline | None = None
        self._due: tuple[Frame, FrameImu, Parameters] | None = None   # for the pipeline
        self._middle: MiddleRow | None = None

    @property
    def applied(self) -> Applied:
        """Tracked figures that the next frame is to have."""
        return NOTHING_APPLIED if self._pipeline is None else self._pipeline.applied

    def prepare(self) -> None:
        """Let the pipeline track the last frame."""
        due, self._due = self._due, None
        if due is not None and self._pipeline is not None:
            self._pipeline.process(*due)

    def reset(self) -> None:
        """Start tracking anew with the next frame."""
        self._due = None
        if self._pipeline is not None:
            self._pipeline.reset()

    def process(self, frame: ColorFrame, imu: FrameImu,
                parameters: Parameters) -> GlobalShutterFrame:
        """The frame, turned."""
        self.prepare()
        sensor = parameters.sensor
        # Once begun it goes on, so that figures that are no longer to be applied are taken back.
        if self._pipeline is None and (sensor.track_time_offset or sensor.track_readout_time):
            self._pipeline = Pipeline(parameters)
        middle = self._middle_of(frame, parameters)
        if self._pipeline is not None:
            self._due = frame.gray(), imu, parameters
        reference_ns = imu.reference_ns
        if parameters.global_shutter.stamp_clock == 'camera':
            reference_ns = frame.stamp_ns + to_nanoseconds(
                exposure_shift(sensor.stamp_exposure, sensor.exposure_time))
        return GlobalShutterFrame(
            reference_ns + to_nanoseconds(middle.delay), frame, middle.map(imu.motion),
            parameters.global_shutter.border, imu.applied_offset_ns)

    def _middle_of(self, frame: ColorFrame, parameters: Parameters) -> MiddleRow:
        camera = sensor_camera(frame.intrinsics, parameters)
        camera = replace(camera, readout_time=max(
            camera.readout_time + self.applied.readout_time, 0.0))
        known = self._middle
        if known is None or known.sensor != (camera, frame.intrinsics):
            known = self._middle = MiddleRow(Sensor(camera, frame.intrinsics))
        return known


def unrolling_loop(parameters: Parameters, *,
                   offline: bool = False) -> FrameLoop[ColorFrame, GlobalShutterFrame]:
    """The loop that turns frames; its sequencer takes `EncodedColorFrame`."""
    return FrameLoop(parameters, Unroller(), offline=offline)
