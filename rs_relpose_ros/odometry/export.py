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

from rs_relpose_ros.bags.reader import Bag, SensorTopics
from rs_relpose_ros.config.settings import Parameters, sensor_model
from rs_relpose_ros.errors import InputError
from rs_relpose_ros.geometry import Array
from rs_relpose_ros.geometry.camera import RollingShutterCamera
from rs_relpose_ros.geometry.timing import NANOSECONDS, Sensor, to_nanoseconds
from rs_relpose_ros.messages.incoming import Intake, sensor_messages
from rs_relpose_ros.messages.outgoing import encode_pixels
from rs_relpose_ros.odometry import formats
from rs_relpose_ros.odometry.formats import Format, FORMATS, IMAGES, Model
from rs_relpose_ros.odometry.landmarks import Landmarks, Tracks, TRACKS_FILE, triangulated
from rs_relpose_ros.odometry.rows import ROWS_FILE, RowTrajectory
from rs_relpose_ros.offline.replay import MessageRefused, outcomes, unused_reason
from rs_relpose_ros.output_files import BLUE, GREEN, ORANGE, save_picture, written
from rs_relpose_ros.pipeline.global_shutter import GlobalShutterFrame, Unroller
from rs_relpose_ros.pipeline.pair import Frame
from rs_relpose_ros.pipeline.pipeline import FrameLoop
from rs_relpose_ros.tracking.images import CompressedImage, Pixels

Ints = NDArray[np.int64]

RAW, UNROLLED, NO_IMAGES = IMAGE_CHOICES = ('raw', 'unrolled', 'none')
REPORT_FILE, PICTURE = 'export.json', 'model.png'
# Times within this belong to one image: tracked corrections may come a frame later.
_SAME_NS = 1_000_000
_NO_POSE = 'there is no pose: it is before, after or in a gap of the trajectory'


class Options(NamedTuple):
    """What is exported; `images` and `rate`: empty and 0 for the format's own and keyframes."""

    format: str
    images: str = ''
    rate: float = 0.0   # of the images, at most [Hz]
    most_points: int = 50_000
    store: Path | None = None   # folder in which raw images are kept, to be linked


class Spread(NamedTuple):
    """Deviations of pixels [px]."""

    mean: float
    median: float
    most: float   # 95 %
    largest: float

    @classmethod
    def of(cls, differences: Array) -> Spread:
        """Of differences (N, 2), of which those that are NaN do not count."""
        lengths = np.linalg.norm(differences[np.isfinite(differences).all(axis=1)], axis=1)
        if not len(lengths):
            return cls(*[math.nan] * 4)
        return cls(float(lengths.mean()), *np.percentile(lengths, [50.0, 95.0, 100.0]).tolist())

    @property
    def text(self) -> str:
        """For the console."""
        return (f'mean {self.mean:.2f} px, median {self.median:.2f}, 95 % {self.most:.2f}, '
                f'largest {self.largest:.2f}')


@dataclass(slots=True)
class ExportReport:
    """Summary of an export."""

    images: int = 0
    points: int = 0
    observations: int = 0
    # Of the observed pixels from the points at the poses of their rows; and of the format's own
    # formula for the place of a point from that.
    reprojection: Spread | None = None
    formula: Spread | None = None
    left_out: list[tuple[int, str]] = field(default_factory=list)   # stamps and reasons
    gaps: list[tuple[int, int]] = field(default_factory=list)   # of the trajectory, IMU clock [ns]

    def reasons(self) -> dict[str, int]:
        """Number of images that were left out, by reason."""
        return dict(Counter(reason for _, reason in self.left_out).most_common())


def export_into(folder: Path, bag: Bag, topics: SensorTopics, parameters: Parameters,
                trajectory: Path, options: Options) -> ExportReport:
    """Write a bag's images, cameras and points into an empty folder.

    `trajectory`: folder of `rs_relpose odometry` with the same bag.
    """
    rows = RowTrajectory.load(trajectory / ROWS_FILE)
    tracks = Tracks.load(trajectory / TRACKS_FILE)
    chosen = FORMATS[options.format]
    options = options._replace(images=options.images or chosen.images)
    run = _Frames(folder, bag, topics, parameters, rows, tracks, options)
    model = run.model()
    report = run.report
    exported = model
    if options.images == UNROLLED:
        exported = derotated(model, rows)
    exported = replace(exported, camera=formats.fitted(exported.camera, chosen.radial))
    _measure(report, model, exported, rows, chosen)
    chosen.write(exported, folder)
    _draw(model, rows, folder / PICTURE)
    (folder / REPORT_FILE).write_text(json.dumps({
        'format': options.format, 'images': report.images, 'image_kind': options.images,
        'points': report.points, 'observations': report.observations,
        **{f'{name}_px': spread and spread._asdict() for name, spread in (
            ('reprojection', report.reprojection), ('formula', report.formula))},
        'left_out': [{'stamp_ns': stamp, 'reason': reason} for stamp, reason in report.left_out],
        'trajectory_gaps_ns': report.gaps}, indent=1) + '\n', encoding='utf-8')
    return report


class _View(NamedTuple):
    """An exported image."""

    name: str
    stamp_ns: int
    reference_ns: int
    times_ns: Ints   # (3,)


class _Frames:
    """The pass over the images of a bag: those that are chosen are written."""

    def __init__(self, folder: Path, bag: Bag, topics: SensorTopics, parameters: Parameters,
                 rows: RowTrajectory, tracks: Tracks, options: Options) -> None:
        self._folder, self._bag, self._topics, self._rows = folder, bag, topics, rows
        self._parameters, self._options = parameters, options
        self._tracks = tracks
        self._keyframes = np.unique(tracks.keyframes_ns)
        self._next_ns = 0
        self._unroller = Unroller()
        self._sensor: Sensor | None = None
        self._landmarks: Landmarks | None = None
        self._views: list[_View] = []
        self.report = ExportReport(gaps=[
            (int(end), int(begin)) for end, begin in zip(rows.spans[:-1, 1], rows.spans[1:, 0],
                                                         strict=True) if begin > end])

    def model(self) -> Model:
        """Write the images, and return the model of the raw ones.

        Raises
        ------
        InputError
            No image has a pose, or none can be used.
        """
        loop = FrameLoop(self._parameters, self._unroller, offline=True, colors=True)
        intake = Intake(loop.sequencer, self._parameters)
        for outcome in outcomes(loop, intake, sensor_messages(self._bag, self._topics)):
            if isinstance(outcome, Frame):
                self._add(outcome)
            elif isinstance(outcome, MessageRefused):
                if not self._views:
                    outcome.raise_without_intrinsics()
            elif outcome.stamp_ns is not None:
                self.report.left_out.append((outcome.stamp_ns, unused_reason(outcome)))
        if not self._views or self._sensor is None or self._landmarks is None:
            reason = next(iter(self.report.reasons()), 'none is a keyframe of the trajectory')
            raise InputError(f'no image of {self._bag.path} can be exported: {reason}. Is the '
                             'trajectory that of this bag?')
        return self._made(self._sensor, self._landmarks)

    def _add(self, frame: Frame[GlobalShutterFrame]) -> None:
        sensor = sensor_model(frame.intrinsics, self._parameters.sensor,
                              self._unroller.applied.readout_time)
        if self._sensor is None:
            self._landmarks = triangulated(self._tracks, self._rows, sensor,
                                           self._options.most_points)
            self._colors = np.full((len(self._landmarks.positions), 3), 128, dtype=np.uint8)
            self._order = np.argsort(self._landmarks.observations.keyframes_ns, kind='stable')
            self._sensor = sensor
        at_ns = frame.imu.reference_ns
        self._sample_colors(frame)
        if not self._is_chosen(at_ns):
            return
        if frame.intrinsics != self._sensor.intrinsics:
            self.report.left_out.append((frame.stamp_ns, 'it has other intrinsics'))
            return
        edges = sensor.intrinsics.to_sensor(
            np.array([[0.0, 0.0], [0.0, 0.5], [0.0, 1.0]]) * (frame.intrinsics.image_height - 1))
        times = at_ns + np.rint(NANOSECONDS * np.sort(
            sensor.camera.row_times(edges[:, 1]))).astype(np.int64)
        if not self._rows.covers(times).all():
            self.report.left_out.append((frame.stamp_ns, _NO_POSE))
            return
        self._views.append(_View(self._write(frame), frame.stamp_ns, at_ns, times))

    def _is_chosen(self, at_ns: int) -> bool:
        if not self._options.rate:
            return _nearest(self._keyframes, at_ns) is not None
        if at_ns < self._next_ns - _SAME_NS:
            return False
        step = to_nanoseconds(1.0 / self._options.rate)
        self._next_ns = max(self._next_ns + step, at_ns + step // 2) if self._next_ns else (
            at_ns + step)
        return True

    def _observations(self, at_ns: int) -> Ints:
        """Indices of the landmarks' observations in an image."""
        assert self._landmarks is not None
        nearest = _nearest(self._keyframes, at_ns)
        if nearest is None:
            return np.zeros(0, dtype=np.int64)
        first, last = np.searchsorted(self._landmarks.observations.keyframes_ns,
                                      [nearest, nearest + 1], sorter=self._order)
        return self._order[first:last]

    def _sample_colors(self, frame: Frame[Any]) -> None:
        found = self._observations(frame.imu.reference_ns)
        if len(found):
            assert self._landmarks is not None
            u, v = np.rint(self._landmarks.observations.pixels[found]).astype(int).T
            height, width = frame.image.shape[:2]
            self._colors[self._landmarks.points[found]] = _rgb(
                frame.image[np.clip(v, 0, height - 1), np.clip(u, 0, width - 1)], frame.encoding)

    def _write(self, frame: Frame[GlobalShutterFrame]) -> str:
        """Write an image if requested, and return its name."""
        kind, encoded = self._options.images, frame.encoded
        assert encoded is not None and frame.result is not None
        if isinstance(encoded, CompressedImage) and kind != UNROLLED:
            suffix, data = ('png' if encoded.is_png else 'jpg'), encoded.data.tobytes()
        elif kind == NO_IMAGES:
            suffix, data = 'png', b''
        else:   # lossless where the recording is
            pixels = (frame.result.image() if kind == UNROLLED
                      else Pixels(frame.image, frame.encoding))
            suffix, data = encode_pixels(
                pixels, png=encoded.is_png or not isinstance(encoded, CompressedImage))
        name = f'{frame.stamp_ns:019d}.{suffix.replace("jpeg", "jpg")}'
        if kind != NO_IMAGES:
            target = self._folder / IMAGES / name
            target.parent.mkdir(exist_ok=True)
            store = self._options.store
            if store is None:
                target.write_bytes(data)
            else:
                _link(store / name, target, data)
        return name

    def _made(self, sensor: Sensor, landmarks: Landmarks) -> Model:
        views, found = self._views, landmarks.observations
        times = np.array([view.times_ns for view in views])
        middles = times[:, formats.MIDDLE]
        R, p = self._rows.pose(times)
        velocities, rates = self._rows.velocity(middles)
        parts = [self._observations(view.reference_ns) for view in views]
        order = np.concatenate(parts).astype(np.int64)
        frames = np.repeat(np.arange(len(views)), [len(part) for part in parts])
        self.report.images = len(views)
        self.report.points = len(landmarks.positions)
        self.report.observations = len(order)
        return Model(
            _published(sensor), self._parameters.sensor.exposure_time,
            tuple(view.name for view in views), np.array([view.stamp_ns for view in views]), times,
            R, p, velocities, rates, landmarks.positions, self._colors, landmarks.errors,
            np.column_stack([frames, landmarks.points[order]]), found.pixels[order])


def _nearest(times: Ints, at_ns: int) -> int | None:
    """The one of the sorted times that is the same; None if there is none."""
    k = int(np.searchsorted(times, at_ns - _SAME_NS))
    return int(times[k]) if k < len(times) and times[k] <= at_ns + _SAME_NS else None


def _rgb(values: NDArray[Any], encoding: str) -> NDArray[np.uint8]:
    """Colours (N, 3) of pixels (N,) or (N, C)."""
    if values.dtype == np.uint16:
        values = values // 257
    if values.ndim == 1:
        values = np.repeat(values[:, None], 3, axis=1)
    return np.asarray(values[:, :3] if encoding.startswith(('rgb', 'mono')) else values[:, 2::-1],
                      dtype=np.uint8)


def _link(source: Path, target: Path, data: bytes) -> None:
    """Link an image to the one that is kept, which is written if it is new."""
    try:
        if not source.exists():
            source.parent.mkdir(exist_ok=True)
            with written(source, 'wb') as file:
                file.write(data)
        os.link(source, target)
    except OSError as error:
        raise InputError(f'{target.name} cannot be linked to {source.parent} '
                         f'({error.strerror}): leave out --link') from error


def _published(sensor: Sensor) -> RollingShutterCamera:
    """Camera of the published images: region of interest and binning applied."""
    camera, part = sensor.camera, sensor.intrinsics
    (cx, cy), = part.to_image([[camera.cx, camera.cy]]).tolist()
    return replace(
        camera, width=part.image_width, height=part.image_height, fx=camera.fx / part.binning_x,
        fy=camera.fy / part.binning_y, cx=cx, cy=cy, readout_time=abs(
            camera.line_delay) * part.binning_y * part.image_height, reference_row='first')


def _shown(model: Model, rows: RowTrajectory, k: Ints, pixels: Array) -> Array:
    """Pixels (N, 2) of derotated images of pixels of the frames k (N,)."""
    R, _ = rows.pose(model.times_of(k, pixels[:, 1]))
    rays = np.einsum('nij,nj->ni', R, model.camera.unproject(pixels))
    return model.camera.project(np.einsum('nji,nj->ni', model.R[k, formats.MIDDLE], rays))


def derotated(model: Model, rows: RowTrajectory) -> Model:
    """The model of derotated images."""
    middle = [formats.MIDDLE] * 3
    return replace(
        model, camera=replace(model.camera, readout_time=0.0), R=model.R[:, middle],
        positions=model.positions[:, middle], times_ns=model.times_ns[:, middle],
        pixels=_shown(model, rows, model.observed[:, 0], model.pixels))


def _measure(report: ExportReport, model: Model, exported: Model, rows: RowTrajectory,
             chosen: Format) -> None:
    """Deviations of the observed points: in the raw images, and of the format's formula."""
    k, points = model.observed[:, 0], model.points[model.observed[:, 1]]
    if not len(k):
        return
    by_path = formats.projected(formats.path(rows), model, k, points, model.pixels[:, 1])
    report.reprojection = Spread.of(by_path - model.pixels)
    if not exported.rolls:
        by_path = _shown(model, rows, k, by_path)
    report.formula = Spread.of(formats.projected(
        chosen.place, exported, k, points, model.pixels[:, 1]) - by_path)


def _draw(model: Model, rows: RowTrajectory, path: Path) -> None:
    """Path with its loops from above, the images' cameras and the points."""
    picture = Figure(figsize=(8.0, 8.0), dpi=110, layout='constrained')
    axes = picture.subplots()
    axes.scatter(model.points[:, 0], model.points[:, 1], s=1.0, color='0.6', label='points')
    for first, last in rows.spans:
        _, p = rows.pose(first + np.linspace(0, last - first, 2000).astype(np.int64))
        axes.plot(p[:, 0], p[:, 1], color=BLUE, lw=1.2,
                  label='path' if first == rows.spans[0, 0] else None)
    if len(rows.loops_ns):
        _, ends = rows.pose(rows.loops_ns)
        axes.plot(*ends[..., :2].transpose(2, 1, 0), color=GREEN, lw=0.8)
        axes.plot([], color=GREEN, lw=0.8, label=f'{len(ends)} loops')
    middle = model.positions[:, formats.MIDDLE]
    forward = model.R[:, formats.MIDDLE, :, 2]
    axes.quiver(middle[:, 0], middle[:, 1], forward[:, 0], forward[:, 1], color=ORANGE,
                width=2e-3, label='cameras')
    if len(model.points):   # a few far ones would shrink the rest
        low, high = np.percentile(model.points[:, :2], [2.0, 98.0], axis=0)
        low, high = np.minimum(low, middle[:, :2].min(0)), np.maximum(high, middle[:, :2].max(0))
        axes.set(xlim=(low[0] - 1.0, high[0] + 1.0), ylim=(low[1] - 1.0, high[1] + 1.0))
    axes.set_aspect('equal', 'box')
    axes.set(title=f'{len(model.names)} images, {len(model.points)} points, from above',
             xlabel='x [m]', ylabel='y [m]')
    axes.legend()
    axes.grid(alpha=0.3)
    save_picture(picture, path)
