"""Derotated images: every row rotated by the gyro to the time of the middle row.

The map is from the pixel of the derotated image to that of the original one: K^-1, undistort,
R(tau)^T R_mid, distort, K, with tau of the row of the original pixel. The translation during the
readout is not corrected: the gyro does not measure it, and its effect depends on depth.
"""

from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace
from functools import cached_property
import math
from typing import Any, NamedTuple

import cv2
import numpy as np
from numpy.typing import NDArray

from rs_relpose_ros.calibration.findings import Assessment, Configured
from rs_relpose_ros.calibration.rotations import rotation_of_rays
from rs_relpose_ros.config.settings import Parameters, sensor_model
from rs_relpose_ros.core.deviations import LIVE
from rs_relpose_ros.estimator.result import RelativePose, Status
from rs_relpose_ros.geometry import Array, timing
from rs_relpose_ros.geometry.camera import Intrinsics
from rs_relpose_ros.geometry.motion import FrameMotion
from rs_relpose_ros.geometry.so3 import log_so3
from rs_relpose_ros.geometry.timing import Sensor, to_nanoseconds
from rs_relpose_ros.pipeline.monitor import ConsistencyMonitor
from rs_relpose_ros.pipeline.pair import Frame
from rs_relpose_ros.pipeline.pipeline import FrameLoop, Pipeline, Processor
from rs_relpose_ros.pipeline.warm_up import made_up_frames, MADE_UP_SENSOR, warm_up_pipeline
from rs_relpose_ros.tracking.features import make_tracker, Tracker
from rs_relpose_ros.tracking.images import GrayLevels, Pixels

# Pixels from node to node of the grid on which the map is exact; it is linear in between. A wider
# grid bends straight lines, a closer one costs time.
# [measured: at 3 rad/s and a focal length of 450 px within 0.015 px; 16 px: 0.04 px]
_STEP = 8
# Rows of the image that are mapped at once, a multiple of the step: their sources fit into a
# cache. [chosen: 64 rows of 1920 px have 1 MB of sources]
_BAND = 64
# Orientations over the readout; linear in between. Less bends the image, more costs time.
# [measured: to 1e-7 rad at 3 rad/s]
_ORIENTATIONS = 129
# Pose of a frame by itself, which the consistency monitor wants. [derived: there is no pair]
_NO_POSE = RelativePose(Status.TOO_FEW_MATCHES, 'no pair')


class RowMap(NamedTuple):
    """A map for one motion, as its nodes."""

    nodes: NDArray[np.float32]  # (rows, columns, 2) original pixels, NaN outside of the lens
    width: int  # of the image
    height: int
    shift: float  # [px] largest difference of a coordinate of a node and its source

    def bands(self) -> Iterator[tuple[slice, NDArray[np.float32]]]:
        """Bands of rows, which fit into a cache, and sources (N, W, 2) for `cv2.remap`."""
        for top in range(0, self.height, _BAND):
            bottom = min(top + _BAND, self.height)
            first_node = top // _STEP
            last_node = math.ceil(bottom / _STEP) + 2
            nodes = self.nodes[first_node:last_node]
            rows, columns, _ = nodes.shape
            size = columns * _STEP, rows * _STEP
            band = cv2.resize(nodes, size, interpolation=cv2.INTER_LINEAR)
            # The image begins one node inside of the band.
            begin = _STEP
            height = bottom - top
            sources = band[begin : begin + height, begin : begin + self.width]
            yield slice(top, bottom), np.asarray(sources)


class MiddleRow:
    """Maps of published images; `delay` [s]: from the reference row to the middle one."""

    def __init__(self, sensor: Sensor) -> None:
        self.sensor = sensor
        camera = sensor.camera
        intrinsics = sensor.intrinsics
        down = _node_pixels(intrinsics.image_height)
        across = _node_pixels(intrinsics.image_width)
        self._shape = len(down), len(across)
        self._nodes = np.stack(np.meshgrid(across, down), axis=-1).reshape(-1, 2)
        pixels = intrinsics.to_sensor(self._nodes)
        self._rays = camera.unproject(pixels)
        self._rows = np.ascontiguousarray(camera.rows_of(pixels))  # of the sensor
        centre = 0.5 * (intrinsics.image_width - 1), 0.5 * (intrinsics.image_height - 1)
        self.delay = float(camera.pixel_times(intrinsics.to_sensor(centre)))

    def map(self, motion: FrameMotion) -> RowMap:
        """Where the pixels come from, for a motion relative to the reference row of the camera."""
        camera = self.sensor.camera
        intrinsics = self.sensor.intrinsics
        # Rotations from the camera at the middle row to the camera at each of some rows:
        # R(tau)^T R_mid.
        rows = np.linspace(0.0, camera.row_count - 1.0, _ORIENTATIONS)
        of_rows = motion.rotations(camera.row_times(rows))
        (of_middle,) = motion.rotations([self.delay])
        turns = np.einsum('nji,jk->nik', of_rows, of_middle)
        sources = camera.project_rotating(self._rays, self._rows, turns)
        nodes = intrinsics.to_image(sources)
        shift = np.nanmax(np.abs(nodes - self._nodes), initial=0.0)
        return RowMap(
            nodes.reshape(*self._shape, 2).astype(np.float32),
            intrinsics.image_width,
            intrinsics.image_height,
            float(shift),
        )


def _node_pixels(size: int) -> Array:
    """Pixels (N,) of the nodes along a side of the image.

    cv2.resize puts node k at pixel (k + 1/2) step - 1/2. There is one node more on each side, so
    that all pixels lie between nodes.
    """
    nodes = np.arange(math.ceil(size / _STEP) + 2, dtype=np.float64)
    return (nodes - 0.5) * _STEP - 0.5


# OpenCV's name of each border. [derived: OpenCV]
_BORDERS = {'replicate': cv2.BORDER_REPLICATE, 'black': cv2.BORDER_CONSTANT}


@dataclass(frozen=True, eq=False)
class GlobalShutterFrame:
    """A frame as a global shutter would take it at the time of the middle row."""

    stamp_ns: int  # time of the middle row, on the clock of the parameter stamp_clock
    original: Pixels
    original_stamp_ns: int  # of its header
    frame_id: str
    intrinsics: Intrinsics
    is_png: bool  # whether the original came as a PNG
    middle: MiddleRow
    motion: FrameMotion
    border: str  # of `_BORDERS`
    applied_offset_ns: int  # tracked time offset in the stamp, beyond the parameter's
    health: Assessment  # by the frames before, if they are watched or tracked

    @cached_property
    def map(self) -> RowMap:
        """Where the pixels come from; made where it is used."""
        return self.middle.map(self.motion)

    def image(self) -> Pixels:
        """The derotated image, in the encoding of the original."""
        values = self.original.values
        border = _BORDERS[self.border]
        has_holes = np.isnan(self.map.nodes).any()
        derotated = np.empty_like(values)
        for rows, sources in self.map.bands():
            # None, as the types forbid: OpenCV 5 takes an empty second map for one.
            derotated[rows] = cv2.remap(
                values,
                sources,
                None,  # type: ignore[call-overload]
                cv2.INTER_LINEAR,
                borderMode=border,
            )
            if has_holes:
                derotated[rows][np.isnan(sources[..., 0])] = 0
        return Pixels(derotated, self.original.encoding)

    def mask(self) -> Pixels:
        """255 for pixels with a source in the original image, 0 for the border."""
        width = self.map.width
        height = self.map.height
        mask = np.empty((height, width), dtype=np.uint8)
        for rows, sources in self.map.bands():
            u = sources[..., 0]
            v = sources[..., 1]
            mask[rows] = np.where(
                (u >= 0.0) & (u <= width - 1.0) & (v >= 0.0) & (v <= height - 1.0), 255, 0
            )
        return Pixels(mask, 'mono8')


class Unroller(Processor[GlobalShutterFrame]):
    """Derotates frames.

    For tracked corrections the frames also pass through the pipeline of relpose_node, after
    they are published. Else, while `watched`, images are compared with the gyro now and then.
    """

    def __init__(self, watched: Callable[[], bool] = lambda: False) -> None:
        self._follower: Pipeline | RotationWatch = RotationWatch()
        self._watched = watched
        self._levels = GrayLevels()
        self._due: tuple[Frame[Any], Parameters] | None = None  # for the follower
        self._middle: MiddleRow | None = None

    def prepare(self) -> None:
        """Let the pipeline or the watch track the last frame."""
        if self._due is None:
            return
        (frame, parameters) = self._due
        self._due = None
        follower = self._follower
        if isinstance(follower, RotationWatch) and not self._watched():
            self._follower = RotationWatch()
        elif isinstance(follower, Pipeline) or follower.needs(frame):
            assert frame.encoded is not None
            # The gray image of relpose_node, bit by bit.
            follower.process(
                replace(
                    frame,
                    image=frame.encoded.decoded(self._levels),
                    encoded=None,
                    encoding='mono8',
                ),
                parameters,
            )
            follower.prepare()
            self.applied = follower.applied

    def reset(self) -> None:
        """Forget the frames so far: tracking restarts with the next one."""
        self._due = None
        self._follower.reset()

    def gyro_only(self, parameters: Parameters) -> bool:
        """Whether no pipeline works on the next frame."""
        sensor = parameters.sensor
        return isinstance(self._follower, RotationWatch) and not (
            sensor.track_time_offset or sensor.track_readout_time
        )

    def process(self, frame: Frame[Any], parameters: Parameters) -> GlobalShutterFrame:
        """The derotated frame."""
        self.prepare()
        sensor = parameters.sensor
        imu = frame.imu
        assert frame.encoded is not None
        # Once started it is kept: corrections that are no longer applied are taken back by steps.
        if isinstance(self._follower, RotationWatch) and not self.gyro_only(parameters):
            self._follower = Pipeline(parameters)
        model = sensor_model(frame.intrinsics, sensor, self.applied.readout_time)
        if self._middle is None or self._middle.sensor != model:
            self._middle = MiddleRow(model)
        self._due = frame, parameters
        reference_ns = imu.reference_ns
        if parameters.global_shutter.stamp_clock == 'camera':
            reference_ns = frame.stamp_ns + to_nanoseconds(
                timing.exposure_shift(sensor.stamp_exposure, frame.exposure) + model.pose_row_delay
            )
        return GlobalShutterFrame(
            reference_ns + to_nanoseconds(self._middle.delay),
            Pixels(frame.image, frame.encoding),
            frame.stamp_ns,
            frame.frame_id,
            frame.intrinsics,
            frame.encoded.is_png,
            self._middle,
            imu.motion,
            parameters.global_shutter.border,
            frame.applied_offset_ns,
            self._follower.health,
        )


# Time from one comparison of images and gyro to the next [ns]. Each costs a detection of corners
# and one tracking step. [chosen: five a second find a wrong gyro within seconds]
_WATCH_NS = to_nanoseconds(0.2)


class RotationWatch(Processor[None]):
    """Compares the rotation between two frames, now and then, with the gyro: gross errors.

    The two frames follow each other: further apart a gyro in deg/s has rotated more than once.
    """

    def __init__(self) -> None:
        self._tracker: Tracker | None = None
        self._monitor = ConsistencyMonitor()
        self._last_ns = 0
        self.reset()

    @property
    def health(self) -> Assessment:
        """By the frames so far."""
        return self._monitor.health

    def reset(self) -> None:
        """Forget the first frame of an unfinished comparison."""
        self._begin: Frame[Any] | None = None

    def needs(self, frame: Frame[Any]) -> bool:
        """Whether a frame ends a comparison or begins one; an earlier stamp begins one."""
        return self._begin is not None or not 0 <= frame.stamp_ns - self._last_ns < _WATCH_NS

    def process(self, frame: Frame[Any], parameters: Parameters) -> None:
        """Follow points into a frame."""
        self._monitor.ahead.append(frame.ahead)
        begin = self._begin
        since = frame.imu.since_previous
        if (
            self._tracker is None
            or begin is None
            or since is None
            or frame.intrinsics != begin.intrinsics
        ):
            self._tracker = self._tracker or make_tracker(parameters.tracking)
            self._tracker.reset()
            self._tracker.start(frame.image)
            self._begin = frame
            self._last_ns = frame.stamp_ns
            return
        # The gyro, which may be wrong, does not predict the points.
        matches = self._tracker.track(frame.image)
        camera = sensor_model(frame.intrinsics, parameters.sensor).camera
        rays1 = camera.unproject(frame.intrinsics.to_sensor(matches.points1))
        rays2 = camera.unproject(frame.intrinsics.to_sensor(matches.points2))
        by_images = rotation_of_rays(rays1, rays2)
        if by_images is not None:
            self._monitor.rotations.add(
                frame.stamp_ns,
                timing.seconds_between(begin.stamp_ns, frame.stamp_ns),
                by_images,
                log_so3(since.rotation),
            )
        self._monitor.add_pair(
            frame.stamp_ns,
            None,
            _NO_POSE,
            Configured(
                parameters.sensor,
                camera,
                np.array(parameters.imu.gyro_bias),
                np.zeros(LIVE.size),
                np.zeros(LIVE.size),
                parameters.imu.gyro_noise_density,
            ),
        )
        self._monitor.assess()
        self.reset()


def unrolling_loop(
    parameters: Parameters, *, offline: bool = False, watched: Callable[[], bool] = lambda: False
) -> FrameLoop[GlobalShutterFrame]:
    """The loop that derotates frames; `watched` is an argument of `Unroller`."""
    return FrameLoop(
        parameters,
        Unroller(watched),
        offline=offline,
        colors=True,
    )


def warm_up_unroller(parameters: Parameters) -> None:
    """Compile (or load from the cache) the kernels of a run by unrolling made-up frames."""
    sensor = parameters.sensor
    if sensor.track_time_offset or sensor.track_readout_time:
        warm_up_pipeline(parameters)
    parameters = parameters.updated(
        {**MADE_UP_SENSOR, 'track_time_offset': False, 'track_readout_time': False}
    )
    for frame in made_up_frames(unrolling_loop(parameters, offline=True, watched=lambda: True)):
        assert frame.result is not None
        frame.result.image()
