"""Tracks of simulated recordings for the real front end, without images.

A rendered image costs 0.2 s, its tracks 20 ms. `SimulatedTracker` hands them out as `KltTracker`
does: corners of the reference keyframe, found again with noise, lost where the prediction is far
off. An image that it gets holds nothing but its number (`numbered_image`).
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from rs_relpose_lab.simulation.fine_path import FinePath
from rs_relpose_lab.simulation.render import view_of
from rs_relpose_lab.simulation.rows import see
from rs_relpose_lab.simulation.simulation import Simulation
from rs_relpose_ros.tracking.corners import keep_apart
from rs_relpose_ros.tracking.images import Image
from rs_relpose_ros.tracking.matches import Matches, TrackIds

Array = NDArray[np.float64]
Ids = NDArray[np.int64]
# Pixels (N, 2) of the sensor to those of the published image.
PointMap = Callable[[Array], Array]

# Corners in sight, of which a tracker takes its 300; least distance between new ones [px].
_IN_SIGHT, _LEAST_DISTANCE = 420, 10.0
# Share of the corners that are lost from frame to frame, though in sight.
_LOST = 0.01
# Corners keep away from the image's border by half a window [px].
_BORDER = 8.0
# Distance [m] of two points that are seen at one pixel, from which one hides the other.
_HIDDEN = 5e-3
# KLT finds no corner whose place was predicted worse than this [px]: the reach of its pyramid.
_REACH = 40.0
# Share of lost corners from which on the prediction is not believed.
_MOST_LOST = 0.15
# An odd number whose multiples scatter over the integers.
_SCATTER = 2654435761


@dataclass(frozen=True, slots=True)
class TrackNoise:
    """Errors of a track, as those of `KltTracker` in a rendered bag (docs/lab/trust.md).

    `white` [px]: 1 sigma per coordinate of each match. As the camera moves on, each corner slips
    off its place, in a direction of its own: within `settled` metres by `slip` [px] times
    Student's t of `freedom` degrees. A share `wrong` slides by a normal number times `slide`
    [px/m].
    """

    white: float = 0.04
    slip: float = 0.08
    freedom: float = 2.5
    settled: float = 0.2
    wrong: float = 0.003
    slide: float = 10.0


@dataclass(frozen=True, slots=True, eq=False)
class Sightings:
    """Where each frame of a recording shows the corners, errors apart.

    `ids`: of each frame's corners (N,), increasing; one that is lost does not come back.
    `pixels`: their places (N, 2) on the sensor; `noise`: standard normal (N, 2).
    `travelled` (F,): way of the camera up to each frame [m]. `slips` [px], `slides` [px/m]: (M, 2)
    by id.
    """

    ids: tuple[Ids, ...]
    pixels: tuple[Array, ...]
    noise: tuple[Array, ...]
    travelled: Array
    slips: Array
    slides: Array
    errors: TrackNoise


def sightings(simulation: Simulation, noise: TrackNoise, rng: np.random.Generator) -> Sightings:
    """Corners on the surfaces of the scene, followed until they leave, hide or are lost."""
    frames = simulation.config.frame_count
    instants = [simulation.seconds(simulation.reference_ns(k)) for k in range(frames)]
    camera = simulation.camera
    first, last = camera.row_time_span
    path = FinePath(simulation.trajectory, instants[0] + first - 0.02, instants[-1] + last + 0.02)
    view = view_of(camera)
    ids: Ids = np.empty(0, dtype=np.int64)
    world = np.empty((0, 3))
    seen_ids, seen_pixels, following = [], [], 0
    for instant in instants:
        pixels = see(world, path.from_instant(instant), view, margin=-_BORDER)
        kept = np.isfinite(pixels).all(axis=1) & (rng.uniform(size=len(ids)) >= _LOST)
        ids, world, pixels = ids[kept], world[kept], pixels[kept]
        new = _new_corners(rng, pixels, camera.width, camera.height)
        pixels = np.concatenate([pixels, new])
        there, hits = simulation.renderer.locate(instant, pixels)
        ids = np.concatenate([ids, following + np.arange(len(new))])
        following += len(new)
        world = np.concatenate([world, there[len(world):]])
        # Not where something is in front of it, nor where there is nothing.
        kept = (hits >= 0) & (np.linalg.norm(there - world, axis=1) < _HIDDEN)
        ids, world, pixels = ids[kept], world[kept], pixels[kept]
        seen_ids.append(ids)
        seen_pixels.append(pixels)
    positions = simulation.trajectory.poses(instants)[0]
    steps = np.linalg.norm(np.diff(positions, axis=0, prepend=positions[:1]), axis=1)
    # Student's t: a normal number by the root of chi squared over its degrees of freedom.
    sigmas = noise.slip / np.sqrt(rng.chisquare(noise.freedom, following) / noise.freedom)
    slides = noise.slide * (rng.uniform(size=following) < noise.wrong)
    directions = rng.standard_normal((2, following, 2))
    return Sightings(tuple(seen_ids), tuple(seen_pixels),
                     tuple(rng.standard_normal((len(frame), 2)) for frame in seen_ids),
                     np.cumsum(steps), sigmas[:, None] * directions[0],
                     slides[:, None] * directions[1], noise)


def _new_corners(rng: np.random.Generator, taken: Array, width: int, height: int) -> Array:
    """As many corners as are missing, away from the border and from those that are taken."""
    missing = _IN_SIGHT - len(taken)
    if missing <= 0:
        return np.empty((0, 2))
    drawn = rng.uniform(_BORDER, (width - 1 - _BORDER, height - 1 - _BORDER), (3 * missing, 2))
    apart = keep_apart(np.concatenate([taken, drawn]), _LEAST_DISTANCE)[len(taken):]
    return drawn[apart][:missing]


def numbered_image(number: int, shape: tuple[int, int]) -> Image:
    """An image (H, W) that says which frame it stands for."""
    image = np.zeros(shape, dtype=np.uint8)
    image[0, :4] = np.frombuffer(np.uint32(number).tobytes(), dtype=np.uint8)
    return image


def number_of(image: Image) -> int:
    """The frame that a numbered image stands for."""
    return int(np.frombuffer(image[0, :4].tobytes(), dtype=np.uint32)[0])


class SimulatedTracker:
    """A `rs_relpose_ros.tracking.tracker.Tracker` of numbered images.

    The place of a corner in the reference keyframe is what a tracker compares with: it is exact by
    definition. So an error that a track has when its frame becomes the reference stays with it,
    and is no error from then on.

    `published`: from the sensor to the image that is published, as it is and not as it is told.
    """

    def __init__(self, sightings: Sightings, published: PointMap, most: int) -> None:
        self._sightings, self._published, self._most = sightings, published, most
        self._ids = TrackIds()
        self.reset()

    def reset(self) -> None:
        """Forget all images; ids are not used again."""
        self._frame = self._reference = -1
        self._matches = Matches.none()
        self._corners: Ids = np.empty(0, dtype=np.int64)
        # Of each track, on the sensor: error that it had when the reference began, and place now.
        self._offsets = self._places = np.empty((0, 2))
        self._started, self._shape = 0, (0, 0)

    @property
    def tracked_fraction(self) -> float:
        """Share of the reference's corners that are still tracked."""
        return len(self._matches) / self._started if self._started else 0.0

    @property
    def points(self) -> Array:
        """Corners (N, 2) in the current image [px]."""
        return self._matches.points2

    def start(self, image: Image) -> None:
        """Make `image` the reference keyframe, with new corners only."""
        self.reset()
        self._frame, self._shape = number_of(image), (image.shape[0], image.shape[1])
        self.promote()

    def track(self, image: Image, predicted: Array | None = None,
              interval: float = 1.0) -> Matches:
        """Find the corners in `image`; see `Tracker.track`."""
        self._frame = number_of(image)
        frame, known = self._frame, self._sightings
        rows = np.searchsorted(known.ids[frame], self._corners)
        rows = np.minimum(rows, len(known.ids[frame]) - 1)
        way = known.travelled[frame] - known.travelled[self._reference]
        places = (known.pixels[frame][rows] + self._offsets
                  + known.errors.white * known.noise[frame][rows]
                  + min(way / known.errors.settled, 1.0) * known.slips[self._corners]
                  + way * known.slides[self._corners])
        points = self._published(places)
        expected = points if predicted is None else np.where(
            np.isfinite(predicted), predicted, self._matches.points2)
        reached = np.linalg.norm(points - expected, axis=1) < _REACH
        if np.count_nonzero(~reached) > _MOST_LOST * len(reached):
            # Then `KltTracker` looks where the corners were.
            reached |= np.linalg.norm(points - self._matches.points2, axis=1) < _REACH
        good = (known.ids[frame][rows] == self._corners) & self._inside(points) & reached
        self._matches = replace(self._matches, points2=points).kept(good)
        self._corners, self._offsets = self._corners[good], self._offsets[good]
        self._places = places[good]
        return self._matches

    def refined_matches(self) -> Matches:
        """Matches of reference and current image; they are as exact as they get."""
        return self._matches

    def promote(self) -> None:
        """Make the current image the reference; tracks go on, new corners fill the gaps."""
        ids, pixels = self._sightings.ids[self._frame], self._sightings.pixels[self._frame]
        kept = keep_apart(self.points, 0.5 * _LEAST_DISTANCE)
        corners, places = self._corners[kept], self._places[kept]
        free = ~np.isin(ids, corners) & self._inside(self._published(pixels))
        # Any of them, but the same ones in every run.
        order = np.argsort(ids[free] * _SCATTER % 2**32)[:max(self._most - len(corners), 0)]
        new, new_places = ids[free][order], pixels[free][order]
        self._corners = np.concatenate([corners, new])
        self._places = np.concatenate([places, new_places])
        rows = np.searchsorted(ids, self._corners)
        self._offsets = self._places - pixels[rows]
        points = self._published(self._places)
        self._matches = Matches(
            np.concatenate([self._matches.track_ids[kept], self._ids.take(len(new))]), points,
            points, np.ones(len(points)))
        self._started, self._reference = len(points), self._frame

    def _inside(self, points: Array) -> NDArray[np.bool_]:
        """Which points (N, 2) of the published image are clear of its border."""
        height, width = self._shape
        return np.asarray(((points >= _BORDER) & (points <= (width - 1 - _BORDER,
                                                             height - 1 - _BORDER))).all(axis=1))
