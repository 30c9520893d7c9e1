"""Scenes of textured rectangles, 3 to 15 m from where the camera walks."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
import math
from typing import NamedTuple

import cv2
import numpy as np
from numpy.typing import ArrayLike, NDArray

from rs_relpose_lab.simulation.texture import make_texture
from rs_relpose_ros.errors import InputError

Array = NDArray[np.float64]

SCENES = ('hall', 'yard', 'gallery')

# The camera stays within this distance of the origin's vertical [m].
_ARENA = 3.5

# A texel is this part of the pixel's footprint at the nearest distance, square on.
_TEXELS_PER_FOOTPRINT = 0.9
_NEAREST = 2.5
_FLOOR_DISTANCE = 4.0
_ROOT = np.array([0.0, 0.0, 1.6])


@dataclass(frozen=True, slots=True, eq=False)
class Surface:
    """A textured rectangle, seen from the side of its normal ``across x down`` reversed.

    `corner` (3,): world position [m] of the texture's upper left corner, as its viewer sees it.
    `across`, `down` (3,): unit vectors along the texture's rows and columns, perpendicular to each
        other.
    `width`, `height`: size [m].
    `texture` (H, W): gray values; texel (i, j) is centred at ``((j + 0.5) width / W, (i + 0.5)
        height / H)``.
    """

    corner: Array
    across: Array
    down: Array
    width: float
    height: float
    texture: NDArray[np.uint8]


class Scene(NamedTuple):
    """S surfaces packed for the renderer, textures with their L mip levels.

    `corners`, `across`, `down` (S, 3) and `sizes` (S, 2) [m] are those of `Surface`, `texels`
    (S, 2) the size of a texel of level 0 [m]. Level l of texture s is the `shapes[s, l]` gray
    values of `pixels` from `offsets[s, l]` on; its texel k is where level 0 has ``2^l k``. Texture
    s has `levels[s]` of them.
    """

    corners: Array
    across: Array
    down: Array
    sizes: Array
    texels: Array
    pixels: NDArray[np.uint8]
    offsets: NDArray[np.int64]
    shapes: NDArray[np.int64]
    levels: NDArray[np.int64]

    @classmethod
    def of(cls, *surfaces: Surface) -> Scene:
        """Pack `surfaces`."""
        pyramids = [list(_pyramid(surface.texture)) for surface in surfaces]
        levels = np.array([len(pyramid) for pyramid in pyramids], dtype=np.int64)
        offsets = np.zeros((len(surfaces), levels.max()), dtype=np.int64)
        shapes = np.zeros((*offsets.shape, 2), dtype=np.int64)
        total = 0
        for s, pyramid in enumerate(pyramids):
            for level, texture in enumerate(pyramid):
                offsets[s, level], shapes[s, level] = total, texture.shape
                total += texture.size
        sizes = np.array([[s.width, s.height] for s in surfaces])
        corners, across, down = (np.array([getattr(s, name) for s in surfaces], dtype=np.float64)
                                 for name in ('corner', 'across', 'down'))
        pixels = np.concatenate([texture.ravel() for pyramid in pyramids for texture in pyramid])
        return cls(corners, across, down, sizes, sizes / shapes[:, 0, ::-1], pixels, offsets,
                   shapes, levels)


def make_scene(kind: str, rng: np.random.Generator, focal_length: float) -> Scene:
    """A scene around the origin, where the camera walks at eye height and looks along x.

    `kind`: closed 'hall' with crates and banners; 'yard' with house fronts, crates and sky; narrow
        'gallery' with pictures and pillars.
    `rng`: draws places, sizes and textures.
    `focal_length`: of the camera [px]: textures are as fine as it can see.
    """
    if kind not in SCENES:
        raise InputError(f'scene must be one of {SCENES}, got {kind!r}')
    builder = _Builder(rng, focal_length)
    build = {'hall': _hall, 'yard': _yard, 'gallery': _gallery}[kind]
    return Scene.of(*(surface for surface in build(builder, rng) if surface is not None))


def _hall(builder: _Builder, rng: np.random.Generator) -> Iterator[Surface | None]:
    length, side = rng.uniform(9.0, 11.0), rng.uniform(7.5, 9.0)
    yield from builder.room(-7.0, length, -side, side, rng.uniform(3.6, 4.4))
    yield from _crates(builder, rng, count=14, reach=length - 2.0)
    for _ in range(4):
        # Banners that hang from the ceiling.
        x, y = _place(rng, 5.4, length - 1.5)
        size = (0.05, rng.uniform(0.8, 1.8), rng.uniform(0.8, 1.6))
        yield from builder.box((x, y, rng.uniform(2.4, 3.0)), size, rng.uniform(-0.7, 0.7))


def _yard(builder: _Builder, rng: np.random.Generator) -> Iterator[Surface | None]:
    yield builder.floor(-9.0, 15.0, -11.0, 11.0)
    yield from builder.sky(40.0)
    # House fronts at different distances, without a gap between them.
    border = -15.0
    while border < 15.0:
        width = rng.uniform(3.5, 6.0)
        x, height = rng.uniform(7.5, 13.0), rng.uniform(4.0, 8.0)
        yield from builder.box(
            (x + 1.5, border + width / 2, height / 2), (3.0, width, height), 0.0)
        border += width
    for side in (-1.0, 1.0):
        yield from builder.box(
            (2.0, side * rng.uniform(9.0, 10.5), 1.5), (18.0, 0.3, 3.0), 0.0)
    yield from _crates(builder, rng, count=12, reach=7.5)
    for _ in range(4):
        # Posts.
        x, y = _place(rng, 5.0, 8.0)
        height = rng.uniform(2.5, 4.0)
        yield from builder.box((x, y, height / 2), (0.25, 0.25, height), rng.uniform(0, 1.5))


def _gallery(builder: _Builder, rng: np.random.Generator) -> Iterator[Surface | None]:
    length, side = rng.uniform(12.0, 14.5), rng.uniform(5.0, 5.8)
    yield from builder.room(-6.0, length, -side, side, rng.uniform(3.4, 4.2))
    for sign in (-1.0, 1.0):
        for x in np.arange(2.0, length - 1.0, 2.2):
            size = (rng.uniform(0.9, 1.8), 0.1, rng.uniform(0.8, 1.6))
            yield from builder.box((x, sign * (side - 0.2), rng.uniform(1.4, 2.2)), size, 0.0)
    for x in (rng.uniform(5.0, 6.0), rng.uniform(7.0, 8.0), rng.uniform(9.5, 10.5)):
        y = rng.uniform(-3.5, 3.5)
        yield from builder.box((x, y, 2.1), (0.5, 0.5, 4.2), rng.uniform(0.0, 1.5))
    yield from _crates(builder, rng, count=5, reach=length - 2.0)


def _crates(builder: _Builder, rng: np.random.Generator, *, count: int,
            reach: float) -> Iterator[Surface | None]:
    for _ in range(count):
        x, y = _place(rng, 5.2, reach)
        size = rng.uniform((0.5, 0.5, 0.5), (1.4, 1.6, 2.2))
        yield from builder.box((x, y, size[2] / 2), tuple(size), rng.uniform(0.0, 1.5))


def _place(rng: np.random.Generator, nearest: float, farthest: float) -> tuple[float, float]:
    """A place on the ground in front of the camera, at a distance from the origin."""
    distance = rng.uniform(nearest, max(nearest + 0.5, farthest))
    angle = rng.uniform(-0.95, 0.95)
    return distance * math.cos(angle), distance * math.sin(angle)


class _Builder:
    """Makes surfaces with textures of their own."""

    def __init__(self, rng: np.random.Generator, focal_length: float) -> None:
        self._rng = rng
        self._focal_length = focal_length

    def surface(self, corner: ArrayLike, across: ArrayLike, down: ArrayLike, width: float,
                height: float, contrast: float = 1.0,
                nearest: float = _NEAREST) -> Surface | None:
        """A rectangle that is never seen from nearer than `nearest` [m]; None if never seen."""
        corner, across, down = (np.asarray(v, dtype=np.float64) for v in (corner, across, down))
        normal = np.cross(down, across)
        if (_ROOT - corner) @ normal + _ARENA * math.hypot(normal[0], normal[1]) < 0.0:
            return None
        distance = max(_distance(corner, across, down, width, height), nearest)
        texel = _TEXELS_PER_FOOTPRINT / self._focal_length * distance
        shape = (max(4, math.ceil(height / texel)), max(4, math.ceil(width / texel)))
        return Surface(corner, across, down, width, height,
                       make_texture(self._rng, shape, contrast=contrast))

    def room(self, x0: float, x1: float, y0: float, y1: float,
             height: float) -> Iterator[Surface | None]:
        """Floor, ceiling and four walls, seen from inside."""
        yield self.floor(x0, x1, y0, y1)
        yield self.surface((x0, y1, height), (0, -1, 0), (1, 0, 0), y1 - y0, x1 - x0, 0.6)
        yield self.surface((x1, y1, height), (0, -1, 0), (0, 0, -1), y1 - y0, height)
        yield self.surface((x0, y0, height), (0, 1, 0), (0, 0, -1), y1 - y0, height)
        yield self.surface((x0, y1, height), (1, 0, 0), (0, 0, -1), x1 - x0, height)
        yield self.surface((x1, y0, height), (-1, 0, 0), (0, 0, -1), x1 - x0, height)

    def floor(self, x0: float, x1: float, y0: float, y1: float) -> Surface | None:
        """The ground, which is seen at a slant."""
        return self.surface((x1, y1, 0), (0, -1, 0), (-1, 0, 0), y1 - y0, x1 - x0,
                            nearest=_FLOOR_DISTANCE)

    def sky(self, distance: float) -> Iterator[Surface | None]:
        """Clouds around and above, in low contrast."""
        d = distance
        for along, to_left in (((1, 0, 0), (0, 1, 0)), ((0, 1, 0), (-1, 0, 0)),
                               ((-1, 0, 0), (0, -1, 0)), ((0, -1, 0), (1, 0, 0))):
            ahead, left = np.array(along, dtype=float), np.array(to_left, dtype=float)
            yield self.surface(d * ahead + d * left + (0, 0, 20.0), -left, (0, 0, -1), 2 * d, 30.0,
                               0.3)
        yield self.surface((-d, d, 20.0), (0, -1, 0), (1, 0, 0), 2 * d, 2 * d, 0.3)

    def box(self, centre: tuple[float, float, float], size: tuple[float, ...],
            yaw: float) -> Iterator[Surface | None]:
        """Four sides and the top; `size` along x, y, z before turning by `yaw` [rad]."""
        cosine, sine = math.cos(yaw), math.sin(yaw)
        forward = np.array([cosine, sine, 0.0])
        left = np.array([-sine, cosine, 0.0])
        up = np.array([0.0, 0.0, 1.0])
        middle = np.array(centre)
        half = np.array(size) / 2
        for outward, right, depth, breadth in (
                (forward, left, half[0], half[1]), (-forward, -left, half[0], half[1]),
                (left, -forward, half[1], half[0]), (-left, forward, half[1], half[0])):
            corner = middle + depth * outward - breadth * right + half[2] * up
            yield self.surface(corner, right, -up, 2 * breadth, 2 * half[2])
        yield self.surface(middle + half[0] * forward + half[1] * left + half[2] * up, -left,
                           -forward, 2 * half[1], 2 * half[0])


def _distance(corner: Array, across: Array, down: Array, width: float, height: float) -> float:
    """Least distance [m] between a rectangle and the camera on its walk, roughly."""
    offset = _ROOT - corner
    x = min(max(float(offset @ across), 0.0), width)
    y = min(max(float(offset @ down), 0.0), height)
    nearest = float(np.linalg.norm(offset - x * across - y * down))
    # The walk leads some way from the origin.
    return nearest - 1.8


def _pyramid(texture: NDArray[np.uint8]) -> Iterator[NDArray[np.uint8]]:
    yield texture
    while min(texture.shape) >= 8:
        texture = np.asarray(cv2.pyrDown(texture), dtype=np.uint8)
        yield texture
