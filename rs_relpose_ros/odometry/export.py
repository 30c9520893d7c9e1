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
# Points of an export, at most.
MOST_POINTS = 50_000


def export_into(
    folder: Path,
    bag: Bag,
    topics: SensorTopics,
    parameters: Parameters,
    trajectory: Path,
    to: str,
    images: str = '',
    rate: float = 0.0,
    most_points: int = MOST_POINTS,
    store: Path | None = None,
) -> dict[str, Any]:
    """Write a bag's images, cameras and points into an empty folder; content of export.json.

    `trajectory`: folder of `rs_relpose odometry` with the same bag. `to`: the format. `images`
    and `rate` (at most so many a second [Hz]): empty and 0 for the format's own and keyframes.
    `store`: folder in which raw images are kept, to be linked. InputError if no image has a pose,
    or none can be used.
    """
    rows = RowTrajectory.load(trajectory / ROWS_FILE)
    tracks = Tracks.load(trajectory / TRACKS_FILE)
    chosen = FORMATS[to]
    kind = images or chosen.images
    run = _Frames(folder, rows, tracks, parameters, kind, rate, most_points, store)
    loop = FrameLoop(parameters, run.unroller, offline=True, colors=True)
    intake = Intake(loop.sequencer, parameters)
    for outcome in outcomes(loop, intake, sensor_messages(bag, topics)):
        if isinstance(outcome, Frame):
            run.add(outcome)
        elif isinstance(outcome, MessageRefused):
            if not run.views:
                outcome.raise_without_intrinsics()
        elif outcome.stamp_ns is not None:
            run.leave_out(outcome.stamp_ns, unused_reason(outcome))
    if not run.views:
        reasons = Counter(one['reason'] for one in run.left_out)
        reason = max(
            reasons, key=reasons.__getitem__, default='none is a keyframe of the trajectory'
        )
        raise InputError(
            f'no image of {bag.path} can be exported: {reason}. Is the trajectory '
            'that of this bag?'
        )
    model = run.model()
    exported = derotated(model, rows) if kind == UNROLLED else model
    exported = replace(exported, camera=formats.fitted(exported.camera, chosen.radial))
    reprojection, formula = _deviations(model, exported, rows, chosen)
    chosen.write(exported, folder)
    _draw(model, rows, folder / PICTURE)
    report = {
        'format': to,
        'images': len(model.names),
        'image_kind': kind,
        'points': len(model.points),
        'observations': len(model.pixels),
        'reprojection_px': reprojection,
        'formula_px': formula,
        'left_out': run.left_out,
        'trajectory_gaps_ns': [
            (end, begin)
            for end, begin in zip(
                rows.spans[:-1, 1].tolist(), rows.spans[1:, 0].tolist(), strict=True
            )
            if begin > end
        ],
    }
    (folder / REPORT_FILE).write_text(json.dumps(report, indent=1) + '\n', encoding='utf-8')
    return report


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
    tracks: Tracks
    parameters: Parameters
    kind: str  # of images
    rate: float
    most_points: int
    store: Path | None
    unroller: Unroller = field(default_factory=Unroller)
    views: list[_View] = field(default_factory=list)
    left_out: list[dict[str, Any]] = field(default_factory=list)  # stamps and reasons
    next_ns: int = 0
    # From the first frame on.
    sensor: Sensor = field(init=False)
    landmarks: Landmarks | None = None
    order: Ints = field(init=False)  # of the observations, by keyframes
    colors: NDArray[np.uint8] = field(init=False)

    def leave_out(self, stamp_ns: int, reason: str) -> None:
        """Count an image that is not exported."""
        self.left_out.append({'stamp_ns': stamp_ns, 'reason': reason})

    def add(self, frame: Frame[GlobalShutterFrame]) -> None:
        """Take colours of points from a frame, and write it if it is chosen."""
        sensor = sensor_model(
            frame.intrinsics, self.parameters.sensor, self.unroller.applied.readout_time
        )
        if self.landmarks is None:
            self.landmarks = triangulated(self.tracks, self.rows, sensor, self.most_points)
            self.colors = np.full((len(self.landmarks.positions), 3), 128, dtype=np.uint8)
            self.order = np.argsort(self.landmarks.observations.keyframes_ns, kind='stable')
            self.sensor = sensor
        at_ns = frame.imu.reference_ns
        found = self._observations(self.landmarks, at_ns)
        if len(found):
            u, v = np.rint(self.landmarks.observations.pixels[found]).astype(int).T
            height, width = frame.image.shape[:2]
            self.colors[self.landmarks.points[found]] = _rgb(
                frame.image[np.clip(v, 0, height - 1), np.clip(u, 0, width - 1)], frame.encoding
            )
        if not self._is_chosen(at_ns):
            return
        if frame.intrinsics != self.sensor.intrinsics:
            self.leave_out(frame.stamp_ns, 'it has other intrinsics')
            return
        edges = sensor.intrinsics.to_sensor(
            np.array([[0.0, 0.0], [0.0, 0.5], [0.0, 1.0]]) * (frame.intrinsics.image_height - 1)
        )
        times = at_ns + np.rint(
            NANOSECONDS * np.sort(sensor.camera.row_times(edges[:, 1]))
        ).astype(np.int64)
        if self.rows.covers(times).all():
            self.views.append(_View(self._write(frame), frame.stamp_ns, at_ns, times))
        else:
            self.leave_out(
                frame.stamp_ns,
                'there is no pose: it is before, after or in a gap of the trajectory',
            )

    def _is_chosen(self, at_ns: int) -> bool:
        if not self.rate:
            return bool((np.abs(self.tracks.keyframes_ns - at_ns) <= _SAME_NS).any())
        if at_ns < self.next_ns - _SAME_NS:
            return False
        step = to_nanoseconds(1.0 / self.rate)
        self.next_ns = (
            max(self.next_ns + step, at_ns + step // 2) if self.next_ns else (at_ns + step)
        )
        return True

    def _observations(self, landmarks: Landmarks, at_ns: int) -> Ints:
        """Indices of the landmarks' observations in an image."""
        keyframes = landmarks.observations.keyframes_ns
        first, last = np.searchsorted(
            keyframes, [at_ns - _SAME_NS, at_ns + _SAME_NS + 1], sorter=self.order
        )
        return self.order[first:last]

    def _write(self, frame: Frame[GlobalShutterFrame]) -> str:
        """Write an image if requested, and return its name."""
        kind, encoded = self.kind, frame.encoded
        assert encoded is not None and frame.result is not None
        if isinstance(encoded, CompressedImage) and kind != UNROLLED:
            suffix, data = ('png' if encoded.is_png else 'jpg'), encoded.data.tobytes()
        elif kind == NO_IMAGES:
            suffix, data = 'png', b''
        else:  # lossless where the recording is
            pixels = (
                frame.result.image() if kind == UNROLLED else Pixels(frame.image, frame.encoding)
            )
            suffix, data = encode_pixels(
                pixels, png=encoded.is_png or not isinstance(encoded, CompressedImage)
            )
        name = f'{frame.stamp_ns:019d}.{suffix.replace("jpeg", "jpg")}'
        if kind != NO_IMAGES:
            target = self.folder / IMAGES / name
            target.parent.mkdir(exist_ok=True)
            if self.store is None:
                target.write_bytes(data)
            else:
                _link(self.store / name, target, data)
        return name

    def model(self) -> Model:
        """The model of the raw images."""
        views, landmarks = self.views, self.landmarks
        assert landmarks is not None
        times = np.array([view.times_ns for view in views])
        R, p = self.rows.pose(times)
        parts = [self._observations(landmarks, view.reference_ns) for view in views]
        order = np.concatenate(parts).astype(np.int64)
        frames = np.repeat(np.arange(len(views)), [len(part) for part in parts])
        return Model(
            _published(self.sensor),
            self.parameters.sensor.exposure_time,
            tuple(view.name for view in views),
            np.array([view.stamp_ns for view in views]),
            times,
            R,
            p,
            *self.rows.velocity(times[:, formats.MIDDLE]),
            landmarks.positions,
            self.colors,
            landmarks.errors,
            np.column_stack([frames, landmarks.points[order]]),
            landmarks.observations.pixels[order],
        )


def _rgb(values: NDArray[Any], encoding: str) -> NDArray[np.uint8]:
    """Colours (N, 3) of pixels (N,) or (N, C)."""
    if values.dtype == np.uint16:
        values = values // 257
    if values.ndim == 1:
        values = np.repeat(values[:, None], 3, axis=1)
    return np.asarray(
        values[:, :3] if encoding.startswith(('rgb', 'mono')) else values[:, 2::-1], dtype=np.uint8
    )


def _link(source: Path, target: Path, data: bytes) -> None:
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
    return replace(
        camera,
        width=part.image_width,
        height=part.image_height,
        fx=camera.fx / part.binning_x,
        fy=camera.fy / part.binning_y,
        cx=cx,
        cy=cy,
        readout_time=abs(camera.line_delay) * part.binning_y * part.image_height,
        reference_row='first',
    )


def _shown(model: Model, rows: RowTrajectory, k: Ints, pixels: Array) -> Array:
    """Pixels (N, 2) of derotated images of pixels of the frames k (N,)."""
    R, _ = rows.pose(model.times_of(k, pixels[:, 1]))
    rays = np.einsum('nij,nj->ni', R, model.camera.unproject(pixels))
    return model.camera.project(np.einsum('nji,nj->ni', model.R[k, formats.MIDDLE], rays))


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
    """Of observed pixels from points at the poses of their rows, and of the format from that.

    The latter by its own formula for the place of a point; None without points.
    """
    k, points = model.observed[:, 0], model.points[model.observed[:, 1]]
    if not len(k):
        return None, None
    by_path = formats.projected(formats.path(rows), model, k, points, model.pixels[:, 1])
    shown = by_path if exported.rolls else _shown(model, rows, k, by_path)
    return _spread(by_path - model.pixels), _spread(
        formats.projected(chosen.place, exported, k, points, model.pixels[:, 1]) - shown
    )


def _spread(differences: Array) -> dict[str, float]:
    """Of differences (N, 2) [px], of which those that are NaN do not count; most: 95 %."""
    lengths = np.linalg.norm(differences[np.isfinite(differences).all(axis=1)], axis=1)
    values = (
        [lengths.mean(), *np.percentile(lengths, [50.0, 95.0, 100.0])]
        if len(lengths)
        else ([math.nan] * 4)
    )
    return dict(zip(('mean', 'median', 'most', 'largest'), map(float, values), strict=True))


def _draw(model: Model, rows: RowTrajectory, path: Path) -> None:
    """Path with its loops from above, the images' cameras and the points."""
    picture = Figure(figsize=(8.0, 8.0), dpi=110, layout='constrained')
    axes = picture.subplots()
    axes.scatter(model.points[:, 0], model.points[:, 1], s=1.0, color='0.6', label='points')
    for first, last in rows.spans:
        _, p = rows.pose(first + np.linspace(0, last - first, 2000).astype(np.int64))
        axes.plot(
            p[:, 0],
            p[:, 1],
            color=BLUE,
            lw=1.2,
            label='path' if first == rows.spans[0, 0] else None,
        )
    if len(rows.loops_ns):
        _, ends = rows.pose(rows.loops_ns)
        axes.plot(*ends[..., :2].transpose(2, 1, 0), color=GREEN, lw=0.8)
        axes.plot([], color=GREEN, lw=0.8, label=f'{len(ends)} loops')
    middle = model.positions[:, formats.MIDDLE]
    forward = model.R[:, formats.MIDDLE, :, 2]
    axes.quiver(
        middle[:, 0],
        middle[:, 1],
        forward[:, 0],
        forward[:, 1],
        color=ORANGE,
        width=2e-3,
        label='cameras',
    )
    if len(model.points):  # a few far ones would shrink the rest
        low, high = np.percentile(model.points[:, :2], [2.0, 98.0], axis=0)
        low, high = np.minimum(low, middle[:, :2].min(0)), np.maximum(high, middle[:, :2].max(0))
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
