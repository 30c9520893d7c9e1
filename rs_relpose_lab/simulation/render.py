"""Rolling-shutter images of a scene: every row at the camera's pose of its own time."""

from dataclasses import dataclass, field
import math
from typing import NamedTuple

import numba
import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy.spatial.transform import Rotation

from rs_relpose_lab.simulation.rows import observe, View
from rs_relpose_lab.simulation.scene import Scene
from rs_relpose_lab.simulation.trajectory import Trajectory
from rs_relpose_ros.errors import InputError
from rs_relpose_ros.geometry import Array
from rs_relpose_ros.geometry.camera import RollingShutterCamera

# Pixels whose rays are tried against the same short list of surfaces.
_TILE = 40
# A lookup covers a footprint that is this much longer than wide; a longer one takes several.
_TAP_STRETCH = 1.6
# Most lookups along the longer axis of a footprint. Fewer blur surfaces at a slant, more cost
# time. [chosen: any value in 4..16 would do]
_MAX_TAPS = 6
# Slightly sharper than the textbook choice of mip level, whose filter is wider than a pixel.
_LEVEL_BIAS = -0.35
# An exposure is sampled at times between which the nearest surface moves by at most this [px].
_EXPOSURE_STEP = 1.0
# Gray value where no surface is hit. [chosen: the middle of the range]
_NOTHING = 128.0

# Nothing here lets the compiler fuse operations: the same image on every processor.
_jit = numba.njit(cache=True, nogil=True, error_model='numpy', fastmath={'arcp', 'nsz'})
_inline = numba.njit(
    cache=True, nogil=True, error_model='numpy', forceinline=True, fastmath={'arcp', 'nsz'}
)


@dataclass(frozen=True, slots=True, eq=False)
class Renderer:
    """Renders a scene for a camera on a trajectory.

    Pixel centres are at integer coordinates; the exposure of row v of the sensor has its middle at
    the time of the reference row plus ``camera.row_times(v)``. Rays and images are in the order of
    the sensor's rows, which are the columns of the image if the camera is read to the right or
    left; `render` returns the image as it is published.
    """

    scene: Scene
    camera: RollingShutterCamera
    trajectory: Trajectory
    edge_samples: int = 2  # squared, of pixels on the outline of a surface
    exposure_time: float = 0.0  # [s] over which a row is averaged
    _rays: Array = field(init=False, repr=False)
    _tile_angles: Array = field(init=False, repr=False)

    def __post_init__(self) -> None:
        u, v = np.meshgrid(np.arange(self.camera.width), np.arange(self.camera.height))
        rays = self.camera.unproject(np.stack([u.ravel(), v.ravel()], axis=1))
        if np.isnan(rays).any():
            raise InputError(
                'the distortion cannot be inverted over the whole image: choose '
                'weaker coefficients or a longer focal length'
            )
        rays = rays.reshape(self.camera.height, self.camera.width, 3)
        if self.camera.readout_axis == 0:
            rays = np.ascontiguousarray(rays.swapaxes(0, 1))
        object.__setattr__(self, '_rays', rays)
        object.__setattr__(self, '_tile_angles', _tile_angles(rays))

    def render(self, reference_time: float) -> NDArray[np.float32]:
        """Noise-free image (H, W) of gray values 0 to 255.

        `reference_time`: middle of the reference row's exposure, time on the trajectory [s].
        """
        count = self._exposure_samples(reference_time)
        within = self.exposure_time * ((np.arange(count) + 0.5) / count - 0.5)
        image = self._at_once(reference_time + within[0])
        for later in within[1:]:
            image += self._at_once(reference_time + later)
        image /= count
        return image if self.camera.readout_axis == 1 else np.ascontiguousarray(image.T)

    def _exposure_samples(self, reference_time: float) -> int:
        """Number of times at which the exposure of a row is sampled."""
        if not self.exposure_time:
            return 1
        ends = reference_time + self.exposure_time * np.array([-0.5, 0.5])
        (start, end), (R_start, R_end) = self.trajectory.poses(ends)
        columns = np.linspace(0.0, self.camera.width - 1, 9)
        rows = np.linspace(0.0, self.camera.height - 1, 9)
        grid = np.stack(np.meshgrid(columns, rows), axis=-1)
        world, _ = self.locate(reference_time, grid)
        distances = np.linalg.norm(world - start, axis=1)
        nearest = np.nanmin(distances, initial=np.inf)
        angle = Rotation.from_matrix(R_start.T @ R_end).magnitude()
        motion = self.camera.fx * (angle + np.linalg.norm(end - start) / nearest)
        return max(1, math.ceil(motion / _EXPOSURE_STEP))

    def _at_once(self, reference_time: float) -> NDArray[np.float32]:
        """Image of rows that are exposed for no time, row by row of the sensor."""
        rows = np.arange(self.camera.row_count)
        times = reference_time + self.camera.row_times(rows)
        positions, rotations = self.trajectory.poses(times)
        pixel_angle = 1.0 / self.camera.fx
        exposure = _Exposure(self._rays, self._tile_angles, positions, rotations, pixel_angle)
        shape = self._rays.shape[:2]
        image = np.empty(shape, dtype=np.float32)
        hits = np.empty(shape, dtype=np.int32)
        _render(exposure, self.scene, image, hits)
        if self.edge_samples > 1:
            _smooth_edges(exposure, self.scene, self.edge_samples, image, hits)
        return image

    def locate(self, reference_time: float, points: ArrayLike) -> tuple[Array, NDArray[np.int64]]:
        """World points (N, 3) [m] and indices of surfaces (N,) at pixels.

        `points` (N, 2) may lie between pixels. Without a hit: NaN and -1.
        """
        points = np.asarray(points, dtype=np.float64).reshape(-1, 2)
        times = reference_time + self.camera.pixel_times(points)
        positions, rotations = self.trajectory.poses(times)
        rays = np.einsum('nij,nj->ni', rotations, self.camera.unproject(points))
        distances = np.empty(len(points))
        hits = np.empty(len(points), dtype=np.int64)
        _trace_all(positions, rays, self.scene, distances, hits)
        return positions + distances[:, None] * rays, hits

    def project(self, reference_time: float, world_points: ArrayLike) -> Array:
        """Pixels (N, 2) of world points (N, 3), hidden or not.

        NaN for a point outside of the image, to the outer border of its pixels.
        """

        def motion(world: Array, times: Array) -> Array:
            positions, rotations = self.trajectory.poses(reference_time + times)
            return np.asarray(np.einsum('nji,nj->ni', rotations, world - positions))

        points = np.asarray(world_points, dtype=np.float64).reshape(-1, 3)
        return observe(points, motion, view_of(self.camera), margin=0.5)


def view_of(camera: RollingShutterCamera) -> View:
    """Projection and row times of the camera, for `rows.observe`."""
    line_delay = float(camera.row_times(1.0) - camera.row_times(0.0))
    return View(
        camera.project,
        camera.unproject,
        camera.width,
        camera.height,
        line_delay,
        camera.reference_row_index,
        camera.readout_axis,
    )


def _tile_angles(rays: Array) -> Array:
    """Half angle (H, tiles) [rad] of a cone around each tile's middle ray, with a margin."""
    height, width = rays.shape[:2]
    starts = np.arange(0, width, _TILE)
    angles = np.empty((height, len(starts)))
    for i, start in enumerate(starts):
        tile = rays[:, start : start + _TILE]
        middle = tile[:, tile.shape[1] // 2]
        cosine = np.einsum('hwi,hi->hw', tile, middle).min(axis=1)
        half_angle = np.arccos(np.minimum(cosine, 1.0))
        # A margin of two pixels for the samples around an outline.
        pixel = np.linalg.norm(tile[:, 1] - tile[:, 0], axis=1) if tile.shape[1] > 1 else 0.01
        angles[:, i] = half_angle + 2.0 * pixel
    return angles


class _Exposure(NamedTuple):
    """Times and poses of the pixels."""

    rays: Array  # (H, W, 3) in the camera frame
    tile_angles: Array  # (H, tiles) [rad] as `_tile_angles` has them
    positions: Array  # (H, 3) of the camera at each row
    rotations: Array  # (H, 3, 3) likewise
    pixel_angle: float  # [rad] in the middle of the image


# Columns of a face, which is a surface as it lies to the camera at one row. Each constant is the
# first column of its values. [derived: one after the other]
# Unit normal (3).
_NORMAL = 0
# Height of the camera above the plane [m].
_HEIGHT = 3
# Axis of the rows of the texture (3).
_ACROSS = 4
# Place of the camera along the texture's rows [m].
_A = 7
# Axis of the columns of the texture (3).
_DOWN = 8
# Place of the camera along the texture's columns [m].
_B = 11
# Width and height [m].
_SIZE = 12
# Index of the surface.
_INDEX = 14
# Direction (3) of the axis of a cone around the surface.
_TOWARDS = 15
# Half angle of this cone [rad].
_ANGLE = 18
# Number of the columns.
_FACE_COLUMNS = 19


@_inline
def _dot(x, y, z, faces, i, column):  # type: ignore[no-untyped-def]
    # Indices, not rows: a view of a row in the innermost loop costs more than the product.
    return x * faces[i, column] + y * faces[i, column + 1] + z * faces[i, column + 2]


@_inline
def _rotated(rotation, x, y, z):  # type: ignore[no-untyped-def]
    return (
        rotation[0, 0] * x + rotation[0, 1] * y + rotation[0, 2] * z,
        rotation[1, 0] * x + rotation[1, 1] * y + rotation[1, 2] * z,
        rotation[2, 0] * x + rotation[2, 1] * y + rotation[2, 2] * z,
    )


@_jit
def _find_faces(position, scene, faces):  # type: ignore[no-untyped-def]
    """Surfaces that face `position`; fills `faces` and returns their number."""
    count = 0
    for s in range(len(scene.corners)):
        if _write_face(position, scene, s, faces, count):
            count += 1
    return count


@_inline
def _write_face(position, scene, s, faces, i):  # type: ignore[no-untyped-def]
    """Write surface s into row i of `faces`; returns whether it faces `position`."""
    corner = scene.corners[s]
    across = scene.across[s]
    down = scene.down[s]
    width = scene.sizes[s, 0]
    height = scene.sizes[s, 1]
    faces[i, _NORMAL] = down[1] * across[2] - down[2] * across[1]
    faces[i, _NORMAL + 1] = down[2] * across[0] - down[0] * across[2]
    faces[i, _NORMAL + 2] = down[0] * across[1] - down[1] * across[0]
    x = position[0] - corner[0]
    y = position[1] - corner[1]
    z = position[2] - corner[2]
    above = _dot(x, y, z, faces, i, _NORMAL)
    faces[i, _HEIGHT] = above
    if above <= 0.0:
        return False
    for k in range(3):
        faces[i, _ACROSS + k] = across[k]
        faces[i, _DOWN + k] = down[k]
        half = 0.5 * (width * across[k] + height * down[k])
        faces[i, _TOWARDS + k] = corner[k] - position[k] + half
    faces[i, _A] = _dot(x, y, z, faces, i, _ACROSS)
    faces[i, _B] = _dot(x, y, z, faces, i, _DOWN)
    faces[i, _SIZE] = width
    faces[i, _SIZE + 1] = height
    faces[i, _INDEX] = s
    x = faces[i, _TOWARDS]
    y = faces[i, _TOWARDS + 1]
    z = faces[i, _TOWARDS + 2]
    distance = math.sqrt(_dot(x, y, z, faces, i, _TOWARDS))
    radius = 0.5 * math.sqrt(width**2 + height**2)
    faces[i, _ANGLE] = math.asin(radius / distance) if radius < distance else math.pi
    for k in range(3):
        faces[i, _TOWARDS + k] /= max(distance, 1e-9)
    return True


@_jit
def _shortlist(rotation, ray, half_angle, faces, face_count, chosen):  # type: ignore[no-untyped-def]
    """Faces that a cone around a ray may hit; fills `chosen` and returns their number."""
    x, y, z = _rotated(rotation, ray[0], ray[1], ray[2])
    count = 0
    for i in range(face_count):
        limit = half_angle + faces[i, _ANGLE]
        if limit >= math.pi or _dot(x, y, z, faces, i, _TOWARDS) >= math.cos(limit):
            chosen[count] = i
            count += 1
    return count


@_inline
def _faces_of_tile(v, tile, exposure, faces, face_count, chosen):  # type: ignore[no-untyped-def]
    """`_shortlist` for a tile of row v, by the cone around the tile's middle ray."""
    rays = exposure.rays
    start = tile * _TILE
    end = min(start + _TILE, rays.shape[1])
    middle = rays[v, start + (end - start) // 2]
    half_angle = exposure.tile_angles[v, tile]
    return _shortlist(exposure.rotations[v], middle, half_angle, faces, face_count, chosen)


@_inline
def _trace(x, y, z, faces, chosen, count):  # type: ignore[no-untyped-def]
    """Nearest hit of a ray (x, y, z): face (-1 for none), distance, texture place a, b [m]."""
    best = np.inf
    hit = -1
    hit_a = 0.0
    hit_b = 0.0
    for k in range(count):
        i = chosen[k]
        approach = -_dot(x, y, z, faces, i, _NORMAL)
        if approach <= 0.0:
            continue
        distance = faces[i, _HEIGHT] / approach
        if distance >= best:
            continue
        a = faces[i, _A] + distance * _dot(x, y, z, faces, i, _ACROSS)
        if a < 0.0 or a > faces[i, _SIZE]:
            continue
        b = faces[i, _B] + distance * _dot(x, y, z, faces, i, _DOWN)
        if b < 0.0 or b > faces[i, _SIZE + 1]:
            continue
        best = distance
        hit = i
        hit_a = a
        hit_b = b
    return hit, best, hit_a, hit_b


@_inline
def _bilinear(pixels, offset, height, width, x, y):  # type: ignore[no-untyped-def]
    """Gray value between texels, clamped at the border."""
    x = min(max(x, 0.0), width - 1.0)
    y = min(max(y, 0.0), height - 1.0)
    j = min(int(x), width - 2)
    i = min(int(y), height - 2)
    fx = x - j
    fy = y - i
    # Unsigned, or every access checks whether the index counts from the end.
    upper_left = np.uintp(offset + i * width + j)
    lower_left = np.uintp(offset + i * width + j + width)
    one = np.uintp(1)
    left = np.float64(pixels[upper_left])
    upper = left + fx * (pixels[upper_left + one] - left)
    left = np.float64(pixels[lower_left])
    lower = left + fx * (pixels[lower_left + one] - left)
    return upper + fy * (lower - upper)


@_inline
def _shade(faces, i, distance, a, b, x, y, z, pixel_angle, scene):  # type: ignore[no-untyped-def]
    """Gray value of a pixel's footprint: trilinear lookups along its longer axis."""
    offsets = scene.offsets
    shapes = scene.shapes
    levels = scene.levels
    s = int(faces[i, _INDEX])
    minor = distance * pixel_angle
    major = minor / max(-_dot(x, y, z, faces, i, _NORMAL), 1e-3)
    taps = min(int(math.ceil(major / (_TAP_STRETCH * minor))), _MAX_TAPS)  # noqa: RUF046
    # The footprint is stretched along the ray's trace on the surface.
    da = _dot(x, y, z, faces, i, _ACROSS)
    db = _dot(x, y, z, faces, i, _DOWN)
    norm = math.sqrt(da * da + db * db)
    if norm > 1e-9:
        da *= major / norm
        db *= major / norm
    texel_a = scene.texels[s, 0]
    texel_b = scene.texels[s, 1]
    level = math.log2(max(minor, major / taps) / texel_a) + _LEVEL_BIAS
    level = min(max(level, 0.0), levels[s] - 1.0)
    low = int(level)
    high = min(low + 1, levels[s] - 1)
    mix = level - low
    scale_low = 1.0 / (1 << low)
    scale_high = 1.0 / (1 << high)
    total = 0.0
    for tap in range(taps):
        along = (tap + 0.5) / taps - 0.5
        column = (a + along * da) / texel_a - 0.5
        row = (b + along * db) / texel_b - 0.5
        value = _bilinear(
            scene.pixels,
            offsets[s, low],
            shapes[s, low, 0],
            shapes[s, low, 1],
            column * scale_low,
            row * scale_low,
        )
        if mix > 0.0:
            other = _bilinear(
                scene.pixels,
                offsets[s, high],
                shapes[s, high, 0],
                shapes[s, high, 1],
                column * scale_high,
                row * scale_high,
            )
            value += mix * (other - value)
        total += value
    return total / taps


@_jit
def _render(exposure, scene, image, hits):  # type: ignore[no-untyped-def]
    """Fill `image` and the index of the surface that every pixel shows."""
    rays, tile_angles, positions, rotations, pixel_angle = exposure
    height, width = image.shape
    faces = np.empty((len(scene.corners) + 1, _FACE_COLUMNS))
    chosen = np.empty(len(scene.corners), dtype=np.int64)
    for v in range(height):
        rotation = rotations[v]
        face_count = _find_faces(positions[v], scene, faces)
        for tile in range(tile_angles.shape[1]):
            count = _faces_of_tile(v, tile, exposure, faces, face_count, chosen)
            start = tile * _TILE
            end = min(start + _TILE, width)
            for u in range(start, end):
                x, y, z = _rotated(rotation, rays[v, u, 0], rays[v, u, 1], rays[v, u, 2])
                hit, distance, a, b = _trace(x, y, z, faces, chosen, count)
                if hit < 0:
                    hits[v, u] = -1
                    image[v, u] = _NOTHING
                else:
                    hits[v, u] = int(faces[hit, _INDEX])
                    image[v, u] = _shade(
                        faces, hit, distance, a, b, x, y, z, pixel_angle * rays[v, u, 2], scene
                    )


@_jit
def _smooth_edges(exposure, scene, samples, image, hits):  # type: ignore[no-untyped-def]
    """Replace pixels on outlines by the mean of samples within them, at their row's time."""
    rays, _, positions, rotations, pixel_angle = exposure
    height, width = image.shape
    faces = np.empty((len(scene.corners) + 1, _FACE_COLUMNS))
    chosen = np.empty(len(scene.corners), dtype=np.int64)
    ray = np.empty(3)
    for v in range(height):
        rotation = rotations[v]
        above = max(v - 1, 0)
        below = min(v + 1, height - 1)
        face_count = -1
        listed = -1
        count = 0
        for u in range(width):
            left = max(u - 1, 0)
            right = min(u + 1, width - 1)
            here = hits[v, u]
            if (
                hits[above, u] == here
                and hits[below, u] == here
                and hits[v, left] == here
                and hits[v, right] == here
            ):
                continue
            if face_count < 0:
                face_count = _find_faces(positions[v], scene, faces)
            tile = u // _TILE
            if tile != listed:
                count = _faces_of_tile(v, tile, exposure, faces, face_count, chosen)
                listed = tile
            total = 0.0
            for i in range(samples):
                dv = ((i + 0.5) / samples - 0.5) / max(below - above, 1)
                for j in range(samples):
                    du = ((j + 0.5) / samples - 0.5) / max(right - left, 1)
                    for k in range(3):
                        along_row = rays[v, right, k] - rays[v, left, k]
                        along_column = rays[below, u, k] - rays[above, u, k]
                        ray[k] = rays[v, u, k] + du * along_row + dv * along_column
                    x, y, z = _rotated(rotation, ray[0], ray[1], ray[2])
                    hit, distance, a, b = _trace(x, y, z, faces, chosen, count)
                    if hit < 0:
                        total += _NOTHING
                    else:
                        total += _shade(
                            faces, hit, distance, a, b, x, y, z, pixel_angle * ray[2], scene
                        )
            image[v, u] = total / (samples * samples)


@_jit
def _trace_all(positions, rays, scene, distances, hits):  # type: ignore[no-untyped-def]
    """Nearest hits of rays (N, 3) in the world from positions (N, 3)."""
    faces = np.empty((len(scene.corners) + 1, _FACE_COLUMNS))
    every = np.arange(len(scene.corners))
    for n in range(len(rays)):
        count = _find_faces(positions[n], scene, faces)
        hit, distance, _, _ = _trace(rays[n, 0], rays[n, 1], rays[n, 2], faces, every, count)
        hits[n] = int(faces[hit, _INDEX]) if hit >= 0 else -1
        distances[n] = distance if hit >= 0 else np.nan
