"""Procedural textures: detail at every scale, distinct corners and blobs, nothing that repeats."""

from __future__ import annotations

import math

import cv2
import numpy as np
from numpy.typing import NDArray

# Smallest wavelength of the noise [texels]; bilinear lookups reproduce what is longer.
_SHORTEST_WAVELENGTH = 4.0
_NOISE_SIGMA = 12.0
_TEXELS_PER_SHAPE = 900.0
_SMALLEST_SHAPE = 5.0
_SMALLEST_PANEL = 14


def make_texture(rng: np.random.Generator, shape: tuple[int, int], *,
                 contrast: float = 1.0) -> NDArray[np.uint8]:
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
    strength, power = 1.0, 0.0
    while power == 0.0 or wavelength < 0.7 * min(shape):
        spacing = wavelength / 2
        rows, columns = (math.ceil(size / spacing) + 4 for size in shape)
        grid = rng.standard_normal((rows, columns), dtype=np.float32)
        octave = cv2.resize(grid, (round(columns * spacing), round(rows * spacing)),
                            interpolation=cv2.INTER_CUBIC)
        total += np.float32(strength) * octave[:shape[0], :shape[1]]
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
        keep = longer < 2 * _SMALLEST_PANEL or (
            longer < 0.45 * max(width, height) and rng.random() < 0.25)
        if keep:
            gray = int(128 + rng.integers(-amplitude, amplitude + 1))
            canvas[y:y + h, x:x + w] = gray
            joint = 1 + min(w, h) // 40
            canvas[y:y + joint, x:x + w] = max(gray - 50, 0)
            canvas[y:y + h, x:x + joint] = max(gray - 50, 0)
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
    # Sizes with density 1 / size^2.5: large ones cover more than small ones do.
    quantile = rng.random(count)
    sizes = ((1 - quantile) * _SMALLEST_SHAPE**-1.5 + quantile * largest**-1.5) ** (-1 / 1.5)
    sizes = np.sort(sizes)[::-1]
    centres = rng.random((count, 2)) * (width, height)
    grays = rng.integers(58, 199, count).tolist()
    aspects = rng.uniform(0.35, 1.0, count)
    angles = rng.uniform(0.0, 2 * math.pi, count)
    kinds = rng.integers(0, 4, count).tolist()
    skews = rng.uniform(-0.2, 0.2, (count, 4))
    cosines, sines = np.cos(angles), np.sin(angles)
    # Outlines of all polygons at once; a triangle uses three of the corners.
    corners = np.where(np.array(kinds) == 1, 3, 4)
    around = 2 * math.pi * (np.arange(4) + skews) / corners[:, None]
    x = 0.6 * sizes[:, None] * np.cos(around)
    y = 0.6 * (sizes * aspects)[:, None] * np.sin(around)
    outlines = np.stack([cosines[:, None] * x - sines[:, None] * y,
                         sines[:, None] * x + cosines[:, None] * y], axis=2)
    polygons = _fixed(outlines + centres[:, None])
    middles = _fixed(centres).tolist()
    axes = _fixed(0.5 * sizes[:, None] * np.stack([np.ones(count), aspects], axis=1)).tolist()
    degrees = np.degrees(angles).tolist()
    for i in range(count):
        if kinds[i] == 0:
            cv2.ellipse(canvas, middles[i], axes[i], degrees[i], 0.0, 360.0, grays[i], -1,
                        cv2.LINE_AA, _SHIFT)
        else:
            cv2.fillConvexPoly(canvas, polygons[i, :corners[i]], grays[i], cv2.LINE_AA, _SHIFT)


# Fractional bits of OpenCV's drawing coordinates.
_SHIFT = 4


def _fixed(coordinates: NDArray[np.float64]) -> NDArray[np.int32]:
    return np.rint(coordinates * (1 << _SHIFT)).astype(np.int32)
