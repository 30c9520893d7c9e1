"""A recording with its trajectory for a reconstruction tool: images, poses of rows, points."""

from __future__ import annotations

from collections import Counter
from dataclasses import dataclass, field, replace
import json
import math
import os
from pathlib import Path
from typing import Any, NamedTuple

from matplotlib.figure import Figure
import numpy as np
from numpy.typing import NDArray

from rs_relpose_ros.bags.reader import Bag
from rs_relpose_ros.bags.sensor_topics import SensorTopics
from rs_relpose_ros.config.settings import Parameters, sensor_model, SensorConfig
from rs_relpose_ros.errors import InputError
from rs_relpose_ros.geometry import Array
from rs_relpose_ros.geometry.camera import RollingShutterCamera
from rs_relpose_ros.geometry.timing import NANOSECONDS, Sensor, to_nanoseconds
from rs_relpose_ros.messages.incoming import Intake, sensor_messages
from rs_relpose_ros.messages.outgoing import encode_pixels
from rs_relpose_ros.odometry import formats
from rs_relpose_ros.odometry.formats import Format, FORMATS, IMAGES, Model, rotated, rotated_back
from rs_relpose_ros.odometry.map_points import (
    KeyframeObservations,
    MapPoints,
    TRACKS_FILE,
    triangulated,
)
from rs_relpose_ros.odometry.rows import ROWS_FILE, RowTrajectory
from rs_relpose_ros.offline.replay import MessageRefused, outcomes, unused_reason
from rs_relpose_ros.output_files import BLUE, GREEN, ORANGE, save_picture, written
from rs_relpose_ros.pipeline.global_shutter import GlobalShutterFrame, Unroller
from rs_relpose_ros.pipeline.pair import Frame
from rs_relpose_ros.pipeline.pipeline import FrameLoop
from rs_relpose_ros.tracking.images import CompressedImage, Pixels

Ints = NDArray[np.int64]

# Images as recorded.
RAW = 'raw'
# Images derotated to their middle row.
UNROLLED = 'unrolled'
# No images.
NO_IMAGES = 'none'
# Legal values of the option --images.
IMAGE_CHOICES = (RAW, UNROLLED, NO_IMAGES)
# Report of an export. [derived: interface]
REPORT_FILE = 'export.json'
# Picture of the exported model. [derived: interface]
PICTURE = 'model.png'
# Times that differ by less belong to one image: a correction of the offset or of the readout that
# is tracked moves the time of a row a little from frame to frame. It must be shorter than half a
# frame interval. [chosen: 0.1 to 5 ms would do: corrections are below 0.1 ms a frame]
_SAME_NS = 1_000_000
# Largest number of points of an export. More points make files that splatting tools read slowly;
# the points whose depth is known best are kept. [chosen: 10,000 to 500,000 would do]
MOST_POINTS = 50_000
# Gray of a point until an image shows it.
_UNKNOWN_GRAY = 128
# Poses per span of the path in the picture. [chosen: enough for a smooth line]
_DRAWN_POSES = 2000


@dataclass(frozen=True, slots=True)
class Choice:
    """What an export contains."""

    format_name: str  # key of `FORMATS`
    images: str = ''  # of IMAGE_CHOICES; empty for the images that the format wants
    rate: float = 0.0  # largest number of images a second [Hz]; 0 for the keyframes
    most_points: int = MOST_POINTS
    store: Path | None = None  # folder in which raw images are kept, to be linked

    @property
    def format(self) -> Format:
        """The exporter."""
        return FORMATS[self.format_name]

    @property
    def image_kind(self) -> str:
        """Which images are written, of IMAGE_CHOICES."""
        return self.images or self.format.images


def export_into(
    folder: Path,
    bag: Bag,
    topics: SensorTopics,
    parameters: Parameters,
    trajectory: Path,
    choice: Choice,
) -> dict[str, Any]:
    """Write a bag's images, cameras and points into an empty folder; content of export.json.

    `trajectory`: folder of `rs_relpose odometry` with the same bag. InputError if no image has a
    pose, or none can be used.
    """
    _check_readout(parameters.sensor, choice)
    rows = RowTrajectory.load(trajectory / ROWS_FILE)
    observations = KeyframeObservations.load(trajectory / TRACKS_FILE)
    run = _Frames(folder, rows, observations, parameters, choice)
    run.read(bag, topics)
    model = run.model()
    exported = derotated(model, rows) if choice.image_kind == UNROLLED else model
    lens_camera = formats.fitted(exported.camera, choice.format.radial)
    exported = replace(exported, camera=lens_camera)
    reprojection, formula = _deviations(model, exported, rows, choice.format)
    choice.format.write(exported, folder)
    _draw(model, rows, folder / PICTURE)
    ends = rows.spans[:-1, 1].tolist()
    begins = rows.spans[1:, 0].tolist()
    report = {
        'format': choice.format_name,
        'images': len(model.names),
        'image_kind': choice.image_kind,
        'points': len(model.points),
        'observations': len(model.pixels),
        'reprojection_px': reprojection,
        'formula_px': formula,
        'left_out': run.left_out,
        'trajectory_gaps_ns': [gap for gap in zip(ends, begins, strict=True) if gap[1] > gap[0]],
    }
    (folder / REPORT_FILE).write_text(json.dumps(report, indent=1) + '\n', encoding='utf-8')
    return report


def _check_readout(sensor: SensorConfig, choice: Choice) -> None:
    """InputError if the format cannot describe raw images with this direction of the readout."""
    by_columns = bool(sensor.readout_time) and sensor.readout_direction in ('right', 'left')
    if by_columns and choice.image_kind != UNROLLED and not choice.format.has_columns:
        raise InputError(
            f'the format {choice.format_name} knows images that are read row by row only, and '
            f'readout_direction is {sensor.readout_direction!r}: export with --images {UNROLLED}, '
            'or choose another format'
        )


class _View(NamedTuple):
    """An exported image."""

    name: str
    stamp_ns: int
    reference_ns: int
    times_ns: Ints  # (3,)


@dataclass(slots=True, eq=False)
class _Frames:
    """The pass over the images of a bag: those that are chosen are written."""

    folder: Path
    rows: RowTrajectory
    tracks: KeyframeObservations
    parameters: Parameters
    choice: Choice
    unroller: Unroller = field(default_factory=Unroller)
    views: list[_View] = field(default_factory=list)
    left_out: list[dict[str, Any]] = field(default_factory=list)  # stamps and reasons
    next_ns: int = 0  # time of the next image, where a rate is chosen
    # From the first frame on.
    sensor: Sensor = field(init=False)
    points: MapPoints | None = None
    order: Ints = field(init=False)  # of the observations, by keyframes
    colors: NDArray[np.uint8] = field(init=False)

    def read(
        self,
        bag: Bag,
        topics: SensorTopics,
    ) -> None:
        """Go through a bag; InputError if no image can be exported."""
        loop = FrameLoop(self.parameters, self.unroller, offline=True, colors=True)
        intake = Intake(loop.sequencer, self.parameters)
        for outcome in outcomes(loop, intake, sensor_messages(bag, topics)):
            if isinstance(outcome, Frame):
                self.add(outcome)
            elif isinstance(outcome, MessageRefused):
                if not self.views:
                    outcome.raise_without_intrinsics()
            elif outcome.stamp_ns is not None:
                self.leave_out(outcome.stamp_ns, unused_reason(outcome))
        if self.views:
            return
        reason = 'none is a keyframe of the trajectory'
        reasons = Counter(one['reason'] for one in self.left_out)
        if reasons:
            reason = reasons.most_common(1)[0][0]
        raise InputError(
            f'no image of {bag.path} can be exported: {reason}. Is the trajectory '
            'that of this bag?'
        )

    def leave_out(
        self,
        stamp_ns: int,
        reason: str,
    ) -> None:
        """Count an image that is not exported."""
        self.left_out.append({'stamp_ns': stamp_ns, 'reason': reason})

    def add(self, frame: Frame[GlobalShutterFrame]) -> None:
        """Take colours of points from a frame, and write it if it is chosen."""
        sensor = sensor_model(
            frame.intrinsics, self.parameters.sensor, self.unroller.applied.readout_time
        )
        if self.points is None:
            self.points = triangulated(self.tracks, self.rows, sensor, self.choice.most_points)
            shape = len(self.points.positions), 3
            self.colors = np.full(shape, _UNKNOWN_GRAY, dtype=np.uint8)
            self.order = np.argsort(self.points.observations.keyframes_ns, kind='stable')
            self.sensor = sensor
        at_ns = frame.imu.reference_ns
        self._take_colors(frame, self.points, self._observations(self.points, at_ns))
        if not self._is_chosen(at_ns):
            return
        if frame.intrinsics != self.sensor.intrinsics:
            self.leave_out(frame.stamp_ns, 'it has other intrinsics')
            return
        times = at_ns + _row_delays(sensor)
        if self.rows.covers(times).all():
            self.views.append(_View(self._write(frame), frame.stamp_ns, at_ns, times))
        else:
            self.leave_out(
                frame.stamp_ns,
                'there is no pose: it is before, after or in a gap of the trajectory',
            )

    def _take_colors(
        self,
        frame: Frame[GlobalShutterFrame],
        points: MapPoints,
        observed: Ints,
    ) -> None:
        """Give points the colours of the pixels where a frame shows them."""
        if not len(observed):
            return
        u, v = np.rint(points.observations.pixels[observed]).astype(int).T
        height, width = frame.image.shape[:2]
        values = frame.image[np.clip(v, 0, height - 1), np.clip(u, 0, width - 1)]
        self.colors[points.points[observed]] = _rgb(values, frame.encoding)

    def _is_chosen(self, at_ns: int) -> bool:
        if not self.choice.rate:
            return bool((np.abs(self.tracks.keyframes_ns - at_ns) <= _SAME_NS).any())
        if at_ns < self.next_ns - _SAME_NS:
            return False
        step = to_nanoseconds(1.0 / self.choice.rate)
        if self.next_ns:
            # Images that come late do not bring the next ones forward.
            self.next_ns = max(self.next_ns + step, at_ns + step // 2)
        else:
            self.next_ns = at_ns + step
        return True

    def _observations(
        self,
        points: MapPoints,
        at_ns: int,
    ) -> Ints:
        """Indices of the observations of points in an image."""
        keyframes = points.observations.keyframes_ns
        window = [at_ns - _SAME_NS, at_ns + _SAME_NS + 1]
        first, last = np.searchsorted(keyframes, window, sorter=self.order)
        return self.order[first:last]

    def _write(self, frame: Frame[GlobalShutterFrame]) -> str:
        """Write an image if requested, and return its name."""
        kind, encoded = self.choice.image_kind, frame.encoded
        assert encoded is not None and frame.result is not None
        if isinstance(encoded, CompressedImage) and kind != UNROLLED:
            suffix = 'png' if encoded.is_png else 'jpg'
            data = encoded.data.tobytes()
        elif kind == NO_IMAGES:
            suffix, data = 'png', b''
        else:
            pixels = Pixels(frame.image, frame.encoding)
            if kind == UNROLLED:
                pixels = frame.result.image()
            # Lossless where the recording is.
            png = encoded.is_png or not isinstance(encoded, CompressedImage)
            suffix, data = encode_pixels(pixels, png=png)
        name = f'{frame.stamp_ns:019d}.{suffix.replace("jpeg", "jpg")}'
        if kind == NO_IMAGES:
            return name
        target = self.folder / IMAGES / name
        target.parent.mkdir(exist_ok=True)
        if self.choice.store is None:
            target.write_bytes(data)
        else:
            _link(self.choice.store / name, target, data)
        return name

    def model(self) -> Model:
        """The model of the raw images."""
        views, points = self.views, self.points
        assert points is not None
        times = np.array([view.times_ns for view in views])
        R, p = self.rows.pose(times)
        velocities, rates = self.rows.velocity(times[:, formats.MIDDLE])
        parts = [self._observations(points, view.reference_ns) for view in views]
        order = np.concatenate(parts).astype(np.int64)
        frames = np.repeat(np.arange(len(views)), [len(part) for part in parts])
        return Model(
            camera=_published(self.sensor),
            exposure_time=self.parameters.sensor.exposure_time,
            names=tuple(view.name for view in views),
            stamps_ns=np.array([view.stamp_ns for view in views]),
            times_ns=times,
            R=R,
            positions=p,
            velocities=velocities,
            rates=rates,
            points=points.positions,
            colors=self.colors,
            errors=points.errors,
            observed=np.column_stack([frames, points.points[order]]),
            pixels=points.observations.pixels[order],
        )


def _row_delays(sensor: Sensor) -> Ints:
    """Delays (3,) [ns] of the first, the middle and the last row that are read of an image."""
    part = sensor.intrinsics
    corner = np.array([part.image_width - 1, part.image_height - 1])
    edges = np.array([[0.0], [0.5], [1.0]]) * corner
    delays = np.sort(sensor.camera.pixel_times(part.to_sensor(edges)))
    return np.rint(NANOSECONDS * delays).astype(np.int64)


def _rgb(values: NDArray[Any], encoding: str) -> NDArray[np.uint8]:
    """Colours (N, 3) of pixels (N,) or (N, C)."""
    if values.dtype == np.uint16:
        values = values // 257
    if values.ndim == 1:
        values = np.repeat(values[:, None], 3, axis=1)
    channels = slice(0, 3) if encoding.startswith(('rgb', 'mono')) else slice(2, None, -1)
    return np.asarray(values[:, channels], dtype=np.uint8)


def _link(
    source: Path,
    target: Path,
    data: bytes,
) -> None:
    """Link an image to the one that is kept, which is written if it is new."""
    try:
        if not source.exists():
            source.parent.mkdir(exist_ok=True)
            with written(source, 'wb') as file:
                file.write(data)
        os.link(source, target)
    except OSError as error:
        raise InputError(
            f'{target.name} cannot be linked to {source.parent} '
            f'({error.strerror}): leave out --link'
        ) from error


def _published(sensor: Sensor) -> RollingShutterCamera:
    """Camera of the published images: region of interest and binning applied."""
    camera, part = sensor.camera, sensor.intrinsics
    ((cx, cy),) = part.to_image([[camera.cx, camera.cy]]).tolist()
    sizes = part.image_width, part.image_height
    binnings = part.binning_x, part.binning_y
    axis = camera.readout_axis
    return replace(
        camera,
        width=part.image_width,
        height=part.image_height,
        fx=camera.fx / part.binning_x,
        fy=camera.fy / part.binning_y,
        cx=cx,
        cy=cy,
        readout_time=abs(camera.line_delay) * binnings[axis] * sizes[axis],
        reference_row='first',
    )


def _shown(
    model: Model,
    rows: RowTrajectory,
    k: Ints,
    pixels: Array,
) -> Array:
    """Pixels (N, 2) of derotated images of pixels of the frames k (N,)."""
    R, _ = rows.pose(model.times_of(k, model.camera.rows_of(pixels)))
    in_world = rotated(R, model.camera.unproject(pixels))
    return model.camera.project(rotated_back(model.R[k, formats.MIDDLE], in_world))


def derotated(model: Model, rows: RowTrajectory) -> Model:
    """The model of derotated images."""
    middle = [formats.MIDDLE] * 3
    return replace(
        model,
        camera=replace(model.camera, readout_time=0.0),
        R=model.R[:, middle],
        positions=model.positions[:, middle],
        times_ns=model.times_ns[:, middle],
        pixels=_shown(model, rows, model.observed[:, 0], model.pixels),
    )


def _deviations(
    model: Model,
    exported: Model,
    rows: RowTrajectory,
    chosen: Format,
) -> tuple[dict[str, float] | None, dict[str, float] | None]:
    """Distances in the images; None without points.

    The first ones are those of the observed pixels from the points at the poses of their rows, the
    second ones those of the points by the format's own formula from the points at these poses.
    """
    k, points = model.observed[:, 0], model.points[model.observed[:, 1]]
    if not len(k):
        return None, None
    at_row = model.camera.rows_of(model.pixels)
    by_path = formats.projected(formats.path(rows), model, k, points, at_row)
    by_formula = formats.projected(chosen.place, exported, k, points, at_row)
    shown = by_path if exported.rolls else _shown(model, rows, k, by_path)
    return _spread(by_path - model.pixels), _spread(by_formula - shown)


def _spread(differences: Array) -> dict[str, float]:
    """Statistics of the lengths of finite differences (N, 2) [px]; `most` is that of 95 %."""
    lengths = np.linalg.norm(differences[np.isfinite(differences).all(axis=1)], axis=1)
    if not len(lengths):
        return dict.fromkeys(('mean', 'median', 'most', 'largest'), math.nan)
    median, most, largest = np.percentile(lengths, [50.0, 95.0, 100.0]).tolist()
    return {
        'mean': float(lengths.mean()),
        'median': median,
        'most': most,
        'largest': largest,
    }


def _draw(
    model: Model,
    rows: RowTrajectory,
    path: Path,
) -> None:
    """Path with its loops from above, the images' cameras and the points."""
    picture = Figure(figsize=(8.0, 8.0), dpi=110, layout='constrained')
    axes = picture.subplots()
    axes.scatter(model.points[:, 0], model.points[:, 1], s=1.0, color='0.6', label='points')
    for number, (first, last) in enumerate(rows.spans):
        times = first + np.linspace(0, last - first, _DRAWN_POSES).astype(np.int64)
        x, y, _ = rows.pose(times)[1].T
        axes.plot(x, y, color=BLUE, lw=1.2, label=None if number else 'path')
    if len(rows.loops_ns):
        _, ends = rows.pose(rows.loops_ns)
        axes.plot(*ends[..., :2].transpose(2, 1, 0), color=GREEN, lw=0.8)
        axes.plot([], color=GREEN, lw=0.8, label=f'{len(ends)} loops')
    middle = model.positions[:, formats.MIDDLE, :2]
    forward = model.R[:, formats.MIDDLE, :2, 2]
    axes.quiver(*middle.T, *forward.T, color=ORANGE, width=2e-3, label='cameras')
    if len(model.points):  # a few far ones would shrink the rest
        low, high = np.percentile(model.points[:, :2], [2.0, 98.0], axis=0)
        low = np.minimum(low, middle.min(axis=0))
        high = np.maximum(high, middle.max(axis=0))
        axes.set(xlim=(low[0] - 1.0, high[0] + 1.0), ylim=(low[1] - 1.0, high[1] + 1.0))
    axes.set_aspect('equal', 'box')
    axes.set(
        title=f'{len(model.names)} images, {len(model.points)} points, from above',
        xlabel='x [m]',
        ylabel='y [m]',
    )
    axes.legend()
    axes.grid(alpha=0.3)
    save_picture(picture, path)
