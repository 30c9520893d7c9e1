"""Alignment of image patches: Lucas-Kanade, inverse compositional, blind to gain and offset.

With the template ``T`` of the first image and its gradient ``G`` (both over the window), the
second image at an estimate off by ``e`` reads ``I = gain (T + G e) + offset`` to first order. Let
``P`` project on what is perpendicular to 1 and T; then ``(P G) . I = gain (P G) . (P G) e``. The
matrix is that of the template, computed once, and neither gain nor offset disturbs it.

OpenCV's ``calcOpticalFlowPyrLK`` builds the pyramids of both images at each call and takes no
prepared ones from Python, which costs more than the tracking itself; it knows no gain either.

References
----------
S. Baker and I. Matthews, "Lucas-Kanade 20 Years On: A Unifying Framework", IJCV 2004.
"""

from __future__ import annotations

import math

import numba
import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]
Image = NDArray[np.uint8]

# Sums may be reordered (vectorised); NaN and infinity keep their meaning.
_FAST_SUMS = {'reassoc', 'contract', 'nsz', 'arcp'}
# Longest step of one iteration [px of the level]: the linearisation reaches no further.
_LONGEST_STEP = 2.0
# Fixed point of warped coordinates.
_BITS = 16
_ONE = 1 << _BITS


@numba.njit(cache=True, nogil=True, fastmath=_FAST_SUMS)
def _sample_shifted(image: Image, x: float, y: float, half: int, out: NDArray[np.float32]) -> bool:
    """Bilinear window around (x, y) into `out`; False where it leaves the image."""
    height, width = image.shape
    left, top = math.floor(x) - half, math.floor(y) - half
    size = 2 * half + 1
    if not (left >= 0 and top >= 0 and left + size < width and top + size < height):
        return False
    fx, fy = np.float32(x - math.floor(x)), np.float32(y - math.floor(y))
    one = np.float32(1.0)
    w00, w01 = (one - fy) * (one - fx), (one - fy) * fx
    w10, w11 = fy * (one - fx), fy * fx
    for i in range(size):
        upper = image[top + i, left:left + size + 1]
        lower = image[top + i + 1, left:left + size + 1]
        row = out[i * size:(i + 1) * size]
        for j in range(size):
            row[j] = (w00 * np.float32(upper[j]) + w01 * np.float32(upper[j + 1])
                      + w10 * np.float32(lower[j]) + w11 * np.float32(lower[j + 1]))
    return True


@numba.njit(cache=True, nogil=True, fastmath=_FAST_SUMS)
def _sample_warped(image: Image, x: float, y: float, warp: Array, half: int,
                   out: NDArray[np.float32]) -> bool:
    """Bilinear window around (x, y), its axes mapped by `warp` (2, 2), into `out`."""
    height, width = image.shape
    # Rounding of the fixed point must not leave the image either.
    reach_x = half * (abs(warp[0, 0]) + abs(warp[0, 1])) + 0.01
    reach_y = half * (abs(warp[1, 0]) + abs(warp[1, 1])) + 0.01
    if not (x - reach_x >= 0.0 and y - reach_y >= 0.0
            and x + reach_x < width - 1.0 and y + reach_y < height - 1.0):
        return False
    size = 2 * half + 1
    # Coordinates in 1/65536 px: the grid is regular, so that additions of integers do.
    right_u, down_u = round(warp[0, 0] * _ONE), round(warp[0, 1] * _ONE)
    right_v, down_v = round(warp[1, 0] * _ONE), round(warp[1, 1] * _ONE)
    row_u = round(x * _ONE) - half * (right_u + down_u)
    row_v = round(y * _ONE) - half * (right_v + down_v)
    pixels = image.reshape(image.size)
    # Unsigned: Numba then spares the test for indices from the end.
    step, one = np.uint64(width), np.uint64(1)
    unit = np.float32(1.0 / _ONE)
    k = 0
    for _ in range(size):
        u, v = row_u, row_v
        for _ in range(size):
            at = np.uint64(v >> _BITS) * step + np.uint64(u >> _BITS)
            fx, fy = np.float32(u & (_ONE - 1)) * unit, np.float32(v & (_ONE - 1)) * unit
            left, below = np.float32(pixels[at]), np.float32(pixels[at + step])
            upper = left + fx * (np.float32(pixels[at + one]) - left)
            lower = below + fx * (np.float32(pixels[at + step + one]) - below)
            out[k] = upper + fy * (lower - upper)
            k += 1
            u += right_u
            v += right_v
        row_u += down_u
        row_v += down_v
    return True


@numba.njit(cache=True, nogil=True, fastmath=_FAST_SUMS)
def _prepare(patch: NDArray[np.float32], half: int, template: NDArray[np.float32],
             gradient_x: NDArray[np.float32],
             gradient_y: NDArray[np.float32]) -> tuple[float, float, float, float, float]:
    """Template and projected gradients of a window with a margin of one pixel.

    Returns the template's mean, its sum of squares, and the normal matrix's three elements.
    """
    size, wide = 2 * half + 1, 2 * half + 3
    count = size * size
    mean = mean_x = mean_y = np.float32(0.0)
    for i in range(size):
        middle = patch[(i + 1) * wide:(i + 2) * wide]
        above, below = patch[i * wide:(i + 1) * wide], patch[(i + 2) * wide:(i + 3) * wide]
        for j in range(size):
            k = i * size + j
            template[k] = middle[j + 1]
            gradient_x[k] = np.float32(0.5) * (middle[j + 2] - middle[j])
            gradient_y[k] = np.float32(0.5) * (below[j + 1] - above[j + 1])
            mean += template[k]
            mean_x += gradient_x[k]
            mean_y += gradient_y[k]
    inverse = np.float32(1.0 / count)
    mean, mean_x, mean_y = mean * inverse, mean_x * inverse, mean_y * inverse
    energy = along_x = along_y = np.float32(0.0)
    for k in range(count):
        template[k] -= mean
        gradient_x[k] -= mean_x
        gradient_y[k] -= mean_y
        energy += template[k] * template[k]
        along_x += gradient_x[k] * template[k]
        along_y += gradient_y[k] * template[k]
    xx = xy = yy = np.float32(0.0)
    if energy > 0.0:
        along_x, along_y = along_x / energy, along_y / energy
    for k in range(count):
        gradient_x[k] -= along_x * template[k]
        gradient_y[k] -= along_y * template[k]
        xx += gradient_x[k] * gradient_x[k]
        xy += gradient_x[k] * gradient_y[k]
        yy += gradient_y[k] * gradient_y[k]
    return float(mean), float(energy), float(xx), float(xy), float(yy)


@numba.njit(cache=True, nogil=True, fastmath=_FAST_SUMS)
def _products(patch: NDArray[np.float32], mean: float, template: NDArray[np.float32],
              gradient_x: NDArray[np.float32],
              gradient_y: NDArray[np.float32]) -> tuple[float, float, float, float]:
    """Products of a window with gradients and template, and its own sum of squares."""
    bx = by = bt = total = squares = np.float32(0.0)
    centre = np.float32(mean)
    for k in range(template.shape[0]):
        value = patch[k] - centre
        bx += gradient_x[k] * value
        by += gradient_y[k] * value
        bt += template[k] * value
        total += value
        squares += value * value
    return (float(bx), float(by), float(bt),
            float(squares) - float(total) * float(total) / template.shape[0])


@numba.njit(cache=True, nogil=True)
def align(image1: Image, image2: Image, points1: Array, points2: Array, warps: Array, half: int,
          iterations: int, tolerance: float) -> tuple[Array, Array]:
    """Move `points2` so that the windows around them look like those around `points1`.

    Parameters
    ----------
    image1, image2 : (H, W) ndarray of uint8
        C-contiguous.
    points1 : (N, 2) ndarray
    points2 : (N, 2) ndarray
        First guess; improved in place. A point that cannot be aligned keeps its guess.
    warps : (N, 2, 2) or (0, 2, 2) ndarray
        Derivative of the second image's pixels by the first's; empty for pure shifts.
    half : int
        The window has ``2 half + 1`` pixels a side.
    iterations : int
        At most so many.
    tolerance : float
        Steps shorter than this [px] end the iteration.

    Returns
    -------
    correlation : (N,) ndarray
        Normalised cross-correlation of the windows at the end; NaN where a window leaves its
        image or is flat.
    eigenvalue : (N,) ndarray
        Smallest eigenvalue of the template's normal matrix per pixel [gray^2/px^2]; NaN as above.
    """
    size = 2 * half + 1
    wide_patch = np.empty((size + 2) * (size + 2), dtype=np.float32)
    patch = np.empty(size * size, dtype=np.float32)
    template = np.empty(size * size, dtype=np.float32)
    gradient_x = np.empty(size * size, dtype=np.float32)
    gradient_y = np.empty(size * size, dtype=np.float32)
    shift_only = warps.shape[0] == 0
    warp = np.eye(2)
    correlation = np.full(points1.shape[0], np.nan)
    eigenvalue = np.full(points1.shape[0], np.nan)
    for n in range(points1.shape[0]):
        if not (math.isfinite(points2[n, 0]) and math.isfinite(points2[n, 1])):
            continue
        if not _sample_shifted(image1, points1[n, 0], points1[n, 1], half + 1, wide_patch):
            continue
        mean, energy, xx, xy, yy = _prepare(wide_patch, half, template, gradient_x, gradient_y)
        determinant = xx * yy - xy * xy
        smallest = 0.5 * (xx + yy - math.sqrt((xx - yy) * (xx - yy) + 4.0 * xy * xy))
        if not (energy > 0.0 and smallest > 1e-3 * size * size and determinant > 0.0):
            continue
        if not shift_only:
            warp = warps[n]
        x, y = points2[n, 0], points2[n, 1]
        first = -2.0
        last = -2.0
        inside = True
        for _ in range(iterations + 1):
            if shift_only:
                inside = _sample_shifted(image2, x, y, half, patch)
            else:
                inside = _sample_warped(image2, x, y, warp, half, patch)
            if not inside:
                break
            bx, by, bt, squares = _products(patch, mean, template, gradient_x, gradient_y)
            last = bt / math.sqrt(energy * squares) if squares > 0.0 else -1.0
            if first == -2.0:
                first = last
            gain = min(max(bt / energy, 0.5), 2.0)
            ex = (yy * bx - xy * by) / (determinant * gain)
            ey = (xx * by - xy * bx) / (determinant * gain)
            step_x = -(warp[0, 0] * ex + warp[0, 1] * ey)
            step_y = -(warp[1, 0] * ex + warp[1, 1] * ey)
            length = math.sqrt(step_x * step_x + step_y * step_y)
            if length > _LONGEST_STEP:
                step_x *= _LONGEST_STEP / length
                step_y *= _LONGEST_STEP / length
            x += step_x
            y += step_y
            if length < tolerance:
                break
        if not inside or last < first:
            # Nothing gained: the guess is the better answer.
            if first > -2.0:
                correlation[n], eigenvalue[n] = first, smallest / (size * size)
            continue
        points2[n, 0], points2[n, 1] = x, y
        correlation[n], eigenvalue[n] = last, smallest / (size * size)
    return correlation, eigenvalue
