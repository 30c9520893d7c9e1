"""Scenes of textured rectangles, 3 to 15 m from where the camera walks."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
import math
from typing import NamedTuple

import cv2
import numpy as np
from numpy.typing import ArrayLike, NDArray

from rs_relpose_ros.errors import InputError
from rs_relpose_ros.geometry import Array

# -------------------------------------------------------------------------------------------------
# Procedural textures: detail at every scale, distinct corners and blobs, nothing that repeats.

# Smallest wavelength of the noise [texels]; bilinear lookups reproduce what is longer.
_SHORTEST_WAVELENGTH = 4.0
# 1 sigma of the noise of a texture [gray levels]. More hides shapes, less leaves flat areas.
# [chosen: any value in 5..25 would do]
_NOISE_SIGMA = 12.0
# Area of the canvas for each shape [texels]. [chosen: shapes cover each other several times]
_TEXELS_PER_SHAPE = 900.0
# Size of the smallest shapes [texels]. Smaller ones are below the resolution of the camera.
# [chosen: a pixel of the camera has about one texel]
_SMALLEST_SHAPE = 5.0
# Half of the side below which a panel is not divided [texels]. [chosen: corners stay several
# pixels apart]
_SMALLEST_PANEL = 14


def make_texture(
    rng: np.random.Generator, shape: tuple[int, int], *, contrast: float = 1.0
) -> NDArray[np.uint8]:
    """Gray texture (H, W): panels, a pile of random shapes, band-limited octaves of noise.

    Shapes of all sizes that cover one another have the statistics of natural images; corners suit
    corner trackers, bodies blob detectors. How much there is of each is drawn.
    """
    canvas = np.full(shape, 128, dtype=np.uint8)
    if rng.random() < 0.6:
        _draw_panels(rng, canvas, amplitude=int(rng.integers(15, 45)))
    _draw_shapes(rng, canvas, density=rng.uniform(0.4, 1.2))
    brightness = rng.uniform(95.0, 150.0)
    gray = canvas.astype(np.float32) - np.float32(128.0)
    gray += np.float32(_NOISE_SIGMA * rng.uniform(0.6, 1.2)) * _noise(rng, shape)
    gray = cv2.GaussianBlur(gray, (0, 0), 0.7) * np.float32(contrast) + np.float32(brightness)
    return np.clip(np.rint(gray), 0, 255).astype(np.uint8)


def _noise(rng: np.random.Generator, shape: tuple[int, int]) -> NDArray[np.float32]:
    """Noise (H, W) of about unit variance, long waves stronger than short ones."""
    total = np.zeros(shape, dtype=np.float32)
    wavelength = _SHORTEST_WAVELENGTH
    strength = 1.0
    power = 0.0
    while power == 0.0 or wavelength < 0.7 * min(shape):
        spacing = wavelength / 2
        rows, columns = (math.ceil(size / spacing) + 4 for size in shape)
        grid = rng.standard_normal((rows, columns), dtype=np.float32)
        octave = cv2.resize(
            grid, (round(columns * spacing), round(rows * spacing)), interpolation=cv2.INTER_CUBIC
        )
        total += np.float32(strength) * octave[: shape[0], : shape[1]]
        power += strength**2
        strength *= 1.5
        wavelength *= 2.0
    # Cubic interpolation between the grid points takes away some of the variance.
    return total / np.float32(0.75 * math.sqrt(power))


def _draw_panels(rng: np.random.Generator, canvas: NDArray[np.uint8], *, amplitude: int) -> None:
    """Divide the canvas into ever smaller rectangles of different gray, with a dark joint."""
    height, width = canvas.shape
    pending = [(0, 0, width, height)]
    while pending:
        x, y, w, h = pending.pop()
        longer = max(w, h)
        # Large panels are always divided, small ones seldom.
        is_smallest = longer < 2 * _SMALLEST_PANEL
        is_large = longer >= 0.45 * max(width, height)
        if is_smallest or (not is_large and rng.random() < 0.25):
            gray = int(128 + rng.integers(-amplitude, amplitude + 1))
            canvas[y : y + h, x : x + w] = gray
            joint = 1 + min(w, h) // 40
            canvas[y : y + joint, x : x + w] = max(gray - 50, 0)
            canvas[y : y + h, x : x + joint] = max(gray - 50, 0)
            continue
        cut = round(longer * rng.uniform(0.3, 0.7))
        if w >= h:
            pending += [(x, y, cut, h), (x + cut, y, w - cut, h)]
        else:
            pending += [(x, y, w, cut), (x, y + cut, w, h - cut)]


def _draw_shapes(rng: np.random.Generator, canvas: NDArray[np.uint8], *, density: float) -> None:
    """Opaque ellipses, triangles and quadrilaterals of all sizes, small ones on top."""
    height, width = canvas.shape
    count = math.ceil(density * height * width / _TEXELS_PER_SHAPE)
    largest = max(0.35 * min(canvas.shape), 2 * _SMALLEST_SHAPE)
    sizes = np.sort(_sizes(rng.random(count), largest))[::-1]
    centres = rng.random((count, 2)) * (width, height)
    grays = rng.integers(58, 199, count).tolist()
    aspects = rng.uniform(0.35, 1.0, count)
    angles = rng.uniform(0.0, 2 * math.pi, count)
    kinds = rng.integers(0, 4, count).tolist()
    skews = rng.uniform(-0.2, 0.2, (count, 4))
    cosines = np.cos(angles)
    sines = np.sin(angles)
    # Outlines of all polygons at once; a triangle uses three of the corners.
    corners = np.where(np.array(kinds) == 1, 3, 4)
    around = 2 * math.pi * (np.arange(4) + skews) / corners[:, None]
    x = 0.6 * sizes[:, None] * np.cos(around)
    y = 0.6 * (sizes * aspects)[:, None] * np.sin(around)
    outline_x = cosines[:, None] * x - sines[:, None] * y
    outline_y = sines[:, None] * x + cosines[:, None] * y
    outlines = np.stack([outline_x, outline_y], axis=2)
    polygons = _fixed(outlines + centres[:, None])
    middles = _fixed(centres).tolist()
    shares = np.stack([np.ones(count), aspects], axis=1)
    axes = _fixed(0.5 * sizes[:, None] * shares).tolist()
    degrees = np.degrees(angles).tolist()
    smooth = {'lineType': cv2.LINE_AA, 'shift': _SHIFT}
    for i in range(count):
        if kinds[i] == 0:
            cv2.ellipse(
                canvas, middles[i], axes[i], degrees[i], 0.0, 360.0, grays[i], -1, **smooth
            )
        else:
            cv2.fillConvexPoly(canvas, polygons[i, : corners[i]], grays[i], **smooth)


def _sizes(quantiles: Array, largest: float) -> Array:
    """Sizes (N,) with density 1 / size^2.5: large shapes cover more than small ones do."""
    of_smallest = (1 - quantiles) * _SMALLEST_SHAPE**-1.5
    of_largest = quantiles * largest**-1.5
    return np.asarray((of_smallest + of_largest) ** (-1 / 1.5))


# Fractional bits of OpenCV's drawing coordinates.
_SHIFT = 4


def _fixed(coordinates: NDArray[np.float64]) -> NDArray[np.int32]:
    return np.rint(coordinates * (1 << _SHIFT)).astype(np.int32)


# Scenes of walks. [derived: the functions of `make_scene`]
SCENES = ('hall', 'yard', 'gallery')
# Scenes of walks, and a single plane that fills the view, which benchmarks of walks do not use.
# [derived: the functions of `make_scene`]
ALL_SCENES = (*SCENES, 'wall')

# The camera stays within this distance of the origin's vertical [m].
_ARENA = 3.5

# A texel is this part of the pixel's footprint at the nearest distance, square on.
_TEXELS_PER_FOOTPRINT = 0.9
# Distance below which textures are not made finer [m]. [chosen: walks keep this distance]
_NEAREST = 2.5
# The same for the floor [m]. [chosen: a camera at eye height that looks ahead sees it from there
# on]
_FLOOR_DISTANCE = 4.0
# Middle of the walks [m]. [derived: the origin at eye height]
_ROOT = np.array([0.0, 0.0, 1.6])


@dataclass(frozen=True, slots=True, eq=False)
class Surface:
    """A textured rectangle, visible from the side opposite to ``across x down``."""

    corner: Array  # [m] world position of the texture's upper left, as its viewer sees it
    across: Array  # unit vector along the texture's rows
    down: Array  # and along its columns
    width: float  # [m]
    height: float  # [m]
    # (H, W), texel (i, j) centred at ((j + 0.5) width / W, (i + 0.5) height / H).
    texture: NDArray[np.uint8]


class Scene(NamedTuple):
    """S surfaces packed for the renderer, textures with their L mip levels.

    Level l of texture s is the `shapes[s, l]` gray values of `pixels` from `offsets[s, l]` on; its
    texel k is where level 0 has ``2^l k``.
    """

    corners: Array  # (S, 3) as of `Surface`, likewise
    across: Array
    down: Array
    sizes: Array  # (S, 2) [m]
    texels: Array  # (S, 2) size of a texel of level 0 [m]
    pixels: NDArray[np.uint8]
    offsets: NDArray[np.int64]
    shapes: NDArray[np.int64]
    levels: NDArray[np.int64]  # (S,) of each texture

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
        corners, across, down = (
            np.array([getattr(s, name) for s in surfaces], dtype=np.float64)
            for name in ('corner', 'across', 'down')
        )
        pixels = np.concatenate([texture.ravel() for pyramid in pyramids for texture in pyramid])
        return cls(
            corners,
            across,
            down,
            sizes,
            sizes / shapes[:, 0, ::-1],
            pixels,
            offsets,
            shapes,
            levels,
        )


def make_scene(kind: str, rng: np.random.Generator, focal_length: float) -> Scene:
    """A scene around the origin, where the camera walks at eye height and looks along x.

    `kind`: closed 'hall' with crates and banners; 'yard' with house fronts, crates and sky; narrow
        'gallery' with pictures and pillars; a 'wall' that fills the view, about five steps away.
    `rng`: draws places, sizes and textures.
    `focal_length`: of the camera [px]: textures are as fine as it can see.
    """
    if kind not in ALL_SCENES:
        raise InputError(f'scene must be one of {ALL_SCENES}, got {kind!r}')
    builder = _Builder(rng, focal_length)
    build = {'hall': _hall, 'yard': _yard, 'gallery': _gallery, 'wall': _wall}[kind]
    return Scene.of(*(surface for surface in build(builder, rng) if surface is not None))


def _hall(builder: _Builder, rng: np.random.Generator) -> Iterator[Surface | None]:
    length = rng.uniform(9.0, 11.0)
    side = rng.uniform(7.5, 9.0)
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
        x = rng.uniform(7.5, 13.0)
        height = rng.uniform(4.0, 8.0)
        yield from builder.box(
            (x + 1.5, border + width / 2, height / 2), (3.0, width, height), 0.0
        )
        border += width
    for side in (-1.0, 1.0):
        yield from builder.box((2.0, side * rng.uniform(9.0, 10.5), 1.5), (18.0, 0.3, 3.0), 0.0)
    yield from _crates(builder, rng, count=12, reach=7.5)
    for _ in range(4):
        # Posts.
        x, y = _place(rng, 5.0, 8.0)
        height = rng.uniform(2.5, 4.0)
        yield from builder.box((x, y, height / 2), (0.25, 0.25, height), rng.uniform(0, 1.5))


def _gallery(builder: _Builder, rng: np.random.Generator) -> Iterator[Surface | None]:
    length = rng.uniform(12.0, 14.5)
    side = rng.uniform(5.0, 5.8)
    yield from builder.room(-6.0, length, -side, side, rng.uniform(3.4, 4.2))
    for sign in (-1.0, 1.0):
        for x in np.arange(2.0, length - 1.0, 2.2):
            size = (rng.uniform(0.9, 1.8), 0.1, rng.uniform(0.8, 1.6))
            yield from builder.box((x, sign * (side - 0.2), rng.uniform(1.4, 2.2)), size, 0.0)
    for x in (rng.uniform(5.0, 6.0), rng.uniform(7.0, 8.0), rng.uniform(9.5, 10.5)):
        y = rng.uniform(-3.5, 3.5)
        yield from builder.box((x, y, 2.1), (0.5, 0.5, 4.2), rng.uniform(0.0, 1.5))
    yield from _crates(builder, rng, count=5, reach=length - 2.0)


def _wall(builder: _Builder, rng: np.random.Generator) -> Iterator[Surface | None]:
    x = rng.uniform(5.0, 6.5)
    yield builder.surface((x, 22.0, 12.0), (0, -1, 0), (0, 0, -1), 44.0, 21.0)


def _crates(
    builder: _Builder, rng: np.random.Generator, *, count: int, reach: float
) -> Iterator[Surface | None]:
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

    def surface(
        self,
        corner: ArrayLike,
        across: ArrayLike,
        down: ArrayLike,
        width: float,
        height: float,
        contrast: float = 1.0,
        nearest: float = _NEAREST,
    ) -> Surface | None:
        """A rectangle, at least `nearest` [m] away; None if it is never visible."""
        corner, across, down = (np.asarray(v, dtype=np.float64) for v in (corner, across, down))
        normal = np.cross(down, across)
        if (_ROOT - corner) @ normal + _ARENA * math.hypot(normal[0], normal[1]) < 0.0:
            return None
        distance = max(_distance(corner, across, down, width, height), nearest)
        texel = _TEXELS_PER_FOOTPRINT / self._focal_length * distance
        shape = (max(4, math.ceil(height / texel)), max(4, math.ceil(width / texel)))
        texture = make_texture(self._rng, shape, contrast=contrast)
        return Surface(corner, across, down, width, height, texture)

    def room(
        self, x0: float, x1: float, y0: float, y1: float, height: float
    ) -> Iterator[Surface | None]:
        """Floor, ceiling and four walls, from inside."""
        forward = (1, 0, 0)
        back = (-1, 0, 0)
        left = (0, 1, 0)
        right = (0, -1, 0)
        down = (0, 0, -1)
        length = x1 - x0
        width = y1 - y0
        yield self.floor(x0, x1, y0, y1)
        yield self.surface((x0, y1, height), right, forward, width, length, 0.6)
        yield self.surface((x1, y1, height), right, down, width, height)
        yield self.surface((x0, y0, height), left, down, width, height)
        yield self.surface((x0, y1, height), forward, down, length, height)
        yield self.surface((x1, y0, height), back, down, length, height)

    def floor(self, x0: float, x1: float, y0: float, y1: float) -> Surface | None:
        """The ground, viewed at a slant."""
        return self.surface(
            (x1, y1, 0), (0, -1, 0), (-1, 0, 0), y1 - y0, x1 - x0, nearest=_FLOOR_DISTANCE
        )

    def sky(self, distance: float) -> Iterator[Surface | None]:
        """Clouds around and above, in low contrast."""
        d = distance
        for along, to_left in (
            ((1, 0, 0), (0, 1, 0)),
            ((0, 1, 0), (-1, 0, 0)),
            ((-1, 0, 0), (0, -1, 0)),
            ((0, -1, 0), (1, 0, 0)),
        ):
            ahead = np.array(along, dtype=float)
            left = np.array(to_left, dtype=float)
            yield self.surface(
                d * ahead + d * left + (0, 0, 20.0), -left, (0, 0, -1), 2 * d, 30.0, 0.3
            )
        yield self.surface((-d, d, 20.0), (0, -1, 0), (1, 0, 0), 2 * d, 2 * d, 0.3)

    def box(
        self, centre: tuple[float, float, float], size: tuple[float, ...], yaw: float
    ) -> Iterator[Surface | None]:
        """Four sides and the top; `size` along x, y, z before rotation by `yaw` [rad]."""
        cosine = math.cos(yaw)
        sine = math.sin(yaw)
        forward = np.array([cosine, sine, 0.0])
        left = np.array([-sine, cosine, 0.0])
        up = np.array([0.0, 0.0, 1.0])
        middle = np.array(centre)
        half = np.array(size) / 2
        for outward, right, depth, breadth in (
            (forward, left, half[0], half[1]),
            (-forward, -left, half[0], half[1]),
            (left, -forward, half[1], half[0]),
            (-left, forward, half[1], half[0]),
        ):
            corner = middle + depth * outward - breadth * right + half[2] * up
            yield self.surface(corner, right, -up, 2 * breadth, 2 * half[2])
        corner_of_top = middle + half[0] * forward + half[1] * left + half[2] * up
        yield self.surface(corner_of_top, -left, -forward, 2 * half[1], 2 * half[0])


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
