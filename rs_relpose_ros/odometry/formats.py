"""Files of reconstruction and splatting tools: cameras with a pose at first, middle and last row.

Each exporter cites the source whose convention it follows, with its commit. All of them take the
centre of the first pixel as (0.5, 0.5), so the principal point is OpenCV's plus 0.5.
"""

from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace
import json
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from rs_relpose_ros.errors import MissingInputError
from rs_relpose_ros.geometry import Array
from rs_relpose_ros.geometry.camera import RollingShutterCamera
from rs_relpose_ros.geometry.timing import NANOSECONDS
from rs_relpose_ros.odometry.rows import RowTrajectory

Ints = NDArray[np.int64]

# The rows of an image whose poses a model has: indices into axis 1 of `Model.R`.
MODEL_ROWS = ('start', 'middle', 'end')
START = MODEL_ROWS.index('start')  # the row that is read first
MIDDLE = MODEL_ROWS.index('middle')  # the middle row
END = MODEL_ROWS.index('end')  # the row that is read last
# From OpenGL's camera axes (x right, y up, z backward) to those of OpenCV.
_OPENGL = np.diag([1.0, -1.0, -1.0, 1.0])
# OpenCV counts pixels from the centre of the first one, all formats here from its corner.
_HALF_PIXEL = 0.5
# Folder of the images in an export.
IMAGES = 'images'
# Name of the camera in a sequence of NCore.
CAMERA_ID = 'camera'
# Rounds that find the row in which a point appears. A round multiplies the error of the row by the
# motion of the point during the readout, as a share of the image. [chosen: with a share of 0.1, 6
# rounds leave 1e-6 of the first error]
_ROW_ROUNDS = 6
# Pixels of the grid, per axis, over which a lens is fitted. [chosen: any value in 20..100 samples
# the smooth difference of two lenses densely]
_FIT_GRID = 41


@dataclass(frozen=True, slots=True, eq=False)
class Model:
    """What is exported: images with the poses of their rows, and points.

    `camera` is that of the images; its `readout_time` is 0 for derotated ones, whose poses at
    start and end are those of the middle row. Start and end are the rows that are read first and
    last. World: metric, z up.
    """

    camera: RollingShutterCamera
    exposure_time: float  # of a row [s]
    names: tuple[str, ...]  # (F,) of the images, in the folder `images`
    stamps_ns: Ints  # (F,) of their headers
    times_ns: Ints  # (F, 3) of start, middle and end on the clock of the IMU
    R: Array  # (F, 3, 3, 3) from the camera to the world
    positions: Array  # (F, 3, 3) [m]
    velocities: Array  # (F, 3) of the middle row, in the axes of the camera [m/s]
    rates: Array  # (F, 3) likewise [rad/s]
    points: Array  # (P, 3) [m]
    colors: NDArray[np.uint8]  # (P, 3) red, green, blue
    errors: Array  # (P,) mean deviation in the images [px]
    observed: Ints  # (N, 2) frame and point of each observation
    pixels: Array  # (N, 2) where, in the image as exported

    @property
    def poses(self) -> Array:
        """Matrices (F, 3, 4, 4) from the camera to the world."""
        poses = np.zeros((*self.R.shape[:2], 4, 4))
        poses[..., :3, :3] = self.R
        poses[..., :3, 3] = self.positions
        poses[..., 3, 3] = 1.0
        return poses

    def times_of(
        self,
        k: Ints,
        rows: Array,
    ) -> Ints:
        """Times (N,) [ns] of rows of the frames k (N,), limited to those of the image."""
        begin, _, end = self.times_ns[k].T
        first_row = 0.0 if self.camera.reads_forward else self.camera.row_count - 1.0
        delays = self.camera.line_delay * (np.nan_to_num(rows) - first_row)
        times = begin + np.rint(NANOSECONDS * delays).astype(np.int64)
        return np.clip(times, begin, end)

    @property
    def rolls(self) -> bool:
        """Whether the images have a rolling shutter."""
        return self.camera.readout_time > 0.0


def rotated(R: Array, vectors: Array) -> Array:
    """``R_n v_n`` of matrices (N, 3, 3) and vectors (N, 3)."""
    return np.einsum('nij,nj->ni', R, vectors)


def rotated_back(R: Array, vectors: Array) -> Array:
    """``R_n^T v_n`` of matrices (N, 3, 3) and vectors (N, 3)."""
    return np.einsum('nji,nj->ni', R, vectors)


# -- where a format has the camera at a row -------------------------------------------------------
#
# Points (N, 3) in the camera of the frames k (N,) at the rows (N,) of the sensor, to the camera's
# axes there.

Placement = Callable[[Model, Ints, Array, Array], Array]


def _share(model: Model, rows: Array) -> Array:
    """Share of the readout (N,), 0 at the row that is read first."""
    share = rows / (model.camera.row_count - 1.0)
    return share if model.camera.reads_forward else 1.0 - share


def _slerp_back(
    model: Model,
    k: Ints,
    share: Array,
    vectors: Array,
) -> Array:
    """Rotate vectors (N, 3) to the camera, which turns at a constant rate from start to end."""
    first = Rotation.from_matrix(model.R[k, START])
    last = Rotation.from_matrix(model.R[k, END])
    turn = (first.inv() * last).as_rotvec()
    at_share = first * Rotation.from_rotvec(share[:, None] * turn)
    return np.asarray(at_share.inv().apply(vectors))


def lerp_of_position(
    model: Model,
    k: Ints,
    points: Array,
    rows: Array,
) -> Array:
    """Slerp of the rotation, linear position of the camera in the world."""
    share = _share(model, rows)
    start = model.positions[k, START]
    way = model.positions[k, END] - start
    return _slerp_back(model, k, share, points - start - share[:, None] * way)


def lerp_of_translation(
    model: Model,
    k: Ints,
    points: Array,
    rows: Array,
) -> Array:
    """Slerp of the rotation, linear translation from world to camera; the same in a whole row."""
    share = _share(model, np.floor(rows + 0.5))
    start = -rotated_back(model.R[k, START], model.positions[k, START])
    end = -rotated_back(model.R[k, END], model.positions[k, END])
    turned = _slerp_back(model, k, share, points)
    return np.asarray(turned + start + share[:, None] * (end - start))


def middle(
    model: Model,
    k: Ints,
    points: Array,
    rows: Array,
) -> Array:
    """One pose per image."""
    return rotated_back(model.R[k, MIDDLE], points - model.positions[k, MIDDLE])


def velocity_of_pixel(
    model: Model,
    k: Ints,
    points: Array,
    rows: Array,
) -> Array:
    """Constant velocity in the undistorted image, whose rows have the times of the original's."""
    camera = model.camera
    local = middle(model, k, points, rows)
    depth = local[:, 2:]
    plane = local[:, :2] / depth
    # Velocity of the point in the axes of the camera, and in the plane at depth 1.
    flow = -(model.velocities[k] + np.cross(model.rates[k], local))
    speed = (flow[:, :2] - flow[:, 2:] * plane) / depth
    # Time of the row in which the moved point lies: t = delay (fy y + cy + 0.5 - H / 2).
    row = camera.fy * plane[:, 1] + camera.cy + _HALF_PIXEL - 0.5 * camera.height
    row_speed = camera.fy * speed[:, 1]
    seconds = camera.line_delay * row / (1.0 - camera.line_delay * row_speed)
    return np.column_stack([plane + seconds[:, None] * speed, np.ones(len(k))])


def path(rows: RowTrajectory) -> Placement:
    """The poses of the trajectory itself."""

    def place(
        model: Model,
        k: Ints,
        points: Array,
        at: Array,
    ) -> Array:
        R, p = rows.pose(model.times_of(k, at))
        return rotated_back(R, points - p)

    return place


def projected(
    place: Placement,
    model: Model,
    k: Ints,
    points: Array,
    rows: Array,
) -> Array:
    """Pixels (N, 2) of points at the poses of their own rows; `rows` (N,): first guesses."""
    pixels = np.column_stack([rows, rows])
    for _ in range(_ROW_ROUNDS):
        at = model.camera.rows_of(pixels)
        pixels = model.camera.project(place(model, k, points, at))
    return pixels


# -- lenses ---------------------------------------------------------------------------------------


class Coefficients(NamedTuple):
    """Distortion by OpenCV's names; `fisheye`: k1 to k4 are those of the angle."""

    fisheye: bool
    k: tuple[float, ...]  # k1 to k6, or k1 to k4
    p: tuple[float, float]
    s: tuple[float, ...]  # s1 to s4


def coefficients_of(camera: RollingShutterCamera) -> Coefficients:
    """Coefficients of a camera; without distortion all are zero."""
    none = (0.0,) * 4
    if camera.distortion_model == 'equidistant':
        k = tuple(camera.distortion or none)
        return Coefficients(True, k, (0.0, 0.0), none)
    padded = (*camera.distortion, *[0.0] * 12)
    k1, k2, p1, p2, k3, k4, k5, k6, *s = padded[:12]
    k = (k1, k2, k3, k4, k5, k6)
    return Coefficients(False, k, (p1, p2), tuple(s))


def fitted(camera: RollingShutterCamera, radial: int) -> RollingShutterCamera:
    """The camera with k1 to k`radial`, p1 and p2 only, by least squares over the image."""
    lens = coefficients_of(camera)
    is_simple = not any(lens.k[radial:]) and not any(lens.s)
    if lens.fisheye or is_simple:
        return camera
    columns = np.linspace(0.0, camera.width - 1.0, _FIT_GRID)
    rows = np.linspace(0.0, camera.height - 1.0, _FIT_GRID)
    grid = np.meshgrid(columns, rows)
    pixels = np.stack(grid, axis=-1).reshape(-1, 2)
    rays = camera.unproject(pixels)
    known = np.isfinite(rays).all(axis=1)
    rays = rays[known]
    plane = rays[:, :2] / rays[:, 2:]
    center = camera.cx, camera.cy
    focal = camera.fx, camera.fy
    distorted = (pixels[known] - center) / focal
    design = _distortion_columns(plane, radial)
    right = (distorted - plane).T.ravel()
    found, *_ = np.linalg.lstsq(design, right, rcond=None)
    k1, k2, *k3 = found[:radial].tolist()
    p1, p2 = found[radial:].tolist()
    distortion = (k1, k2, p1, p2, *(k3 or [0.0]))
    return replace(camera, distortion_model='plumb_bob', distortion=distortion)


def _distortion_columns(plane: Array, radial: int) -> Array:
    """Derivatives (2 N, radial + 2) of x, then y, of distorted points by k1 to k`radial`, p1, p2.

    `plane` (N, 2): undistorted points in the plane at depth 1.
    """
    x, y = plane.T
    r2 = x * x + y * y
    cross = 2.0 * x * y
    columns = []
    for order in range(1, radial + 1):
        power = r2**order
        columns.append(np.concatenate([x * power, y * power]))
    by_p1 = np.concatenate([cross, r2 + 2.0 * y * y])
    by_p2 = np.concatenate([r2 + 2.0 * x * x, cross])
    return np.column_stack([*columns, by_p1, by_p2])


# -- exporters ------------------------------------------------------------------------------------


def _lines(path: Path, *lines: str) -> None:
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_text(''.join(f'{line}\n' for line in lines), encoding='ascii')


def _text(values: Any) -> str:
    return ' '.join(f'{value:.12g}' for value in np.ravel(values))


def _write_colmap(model: Model, folder: Path) -> None:
    """COLMAP's text files in ``sparse/0``, with a pose at the middle row.

    colmap 5d968cf, doc/format.rst, doc/cameras.rst: from world to camera, Hamilton quaternion w
    first, two lines per image.
    """
    out = folder / 'sparse' / '0'
    _lines(out / 'cameras.txt', *_colmap_camera(model.camera))
    order = np.argsort(model.observed[:, 0], kind='stable')
    frames, points = model.observed[order].T
    begins = np.searchsorted(frames, np.arange(len(model.names) + 1))
    images = [
        '# IMAGE_ID, QW, QX, QY, QZ, TX, TY, TZ, CAMERA_ID, NAME',
        '# POINTS2D[] as (X, Y, POINT3D_ID)',
    ]
    # Of each point the images in which it is observed, with its position in their lists.
    tracks: list[list[str]] = [[] for _ in model.points]
    for frame, image in enumerate(model.names):
        R = model.R[frame, MIDDLE].T
        quat_wxyz = Rotation.from_matrix(R).as_quat()[[3, 0, 1, 2]]
        t = -R @ model.positions[frame, MIDDLE]
        images.append(f'{frame + 1} {_text(quat_wxyz)} {_text(t)} 1 {image}')
        mine = slice(begins[frame], begins[frame + 1])
        pixels = model.pixels[order[mine]] + _HALF_PIXEL
        observed = []
        for index, (point, (x, y)) in enumerate(zip(points[mine], pixels, strict=True)):
            tracks[point].append(f'{frame + 1} {index}')
            observed.append(f'{x:.4f} {y:.4f} {point + 1}')
        images.append(' '.join(observed))
    _lines(out / 'images.txt', *images)
    lines = ['# POINT3D_ID, X, Y, Z, R, G, B, ERROR, TRACK[] as (IMAGE_ID, POINT2D_IDX)']
    for point, track in enumerate(tracks):
        color, error = _text(model.colors[point]), model.errors[point]
        place = _text(model.points[point])
        lines.append(f'{point + 1} {place} {color} {error:.4f} {" ".join(track)}')
    _lines(out / 'points3D.txt', *lines)


def _colmap_camera(camera: RollingShutterCamera) -> tuple[str, str]:
    """Lines of COLMAP's cameras.txt, by the simplest model that holds the lens."""
    lens = coefficients_of(camera)
    first, rest = lens.k[:2], lens.k[2:]
    if lens.fisheye:
        name, distortion = 'OPENCV_FISHEYE', lens.k
    elif any(rest):
        name, distortion = 'FULL_OPENCV', (*first, *lens.p, *rest)
    elif any(first + lens.p):
        name, distortion = 'OPENCV', (*first, *lens.p)
    else:
        name, distortion = 'PINHOLE', ()
    values = [*_focal_and_centre(camera), *distortion]
    return (
        '# CAMERA_ID, MODEL, WIDTH, HEIGHT, PARAMS[]',
        f'1 {name} {camera.width} {camera.height} {_text(values)}',
    )


def _focal_and_centre(camera: RollingShutterCamera) -> tuple[float, float, float, float]:
    """Focal lengths, and the principal point from the corner of the first pixel [px]."""
    return camera.fx, camera.fy, camera.cx + _HALF_PIXEL, camera.cy + _HALF_PIXEL


def _write_transforms(
    model: Model,
    folder: Path,
    more: Mapping[str, Any],
    of_frames: Mapping[str, Array],
) -> None:
    """The transforms.json of instant-ngp and nerfstudio, with entries of their own.

    `of_frames`: arrays (F, ...) by the key that they have in each frame.
    """
    camera, lens = model.camera, coefficients_of(model.camera)
    value: dict[str, Any] = {'w': camera.width, 'h': camera.height}
    value |= zip(('fl_x', 'fl_y', 'cx', 'cy'), _focal_and_centre(camera), strict=True)
    terms = dict(zip(('k1', 'k2', 'k3', 'k4', 'p1', 'p2'), lens.k[:4] + lens.p, strict=True))
    value |= {name: term for name, term in terms.items() if term}
    value |= more
    frames = []
    for f, name in enumerate(model.names):
        entries = {key: values[f].tolist() for key, values in of_frames.items()}
        frames.append({'file_path': f'{IMAGES}/{name}', **entries})
    value['frames'] = frames
    _lines(folder / 'transforms.json', json.dumps(value, indent=1))


def _write_nerfstudio(model: Model, folder: Path) -> None:
    """transforms.json with the pose of the middle row and velocities, and the points (PLY).

    nerfstudio fork 34b5604 (nerfstudio_dataparser.py, splatfacto.py), gsplat fork 03fe148
    (forward.cu, helpers.cuh): camera to world in OpenGL's axes, velocities in the camera's;
    a row has the time ``rolling_shutter_time (y / H - 0.5)``. It must be positive: for rows that
    are read upwards the velocities have the other sign. nerfstudio 50e0e3c ignores what it does
    not know.
    """
    sign = 1.0 if model.camera.reads_forward else -1.0
    flip = sign * np.diag(_OPENGL)[:3]
    _write_transforms(
        model,
        folder,
        {
            'camera_model': 'OPENCV_FISHEYE'
            if coefficients_of(model.camera).fisheye
            else 'OPENCV',
            'orientation_override': 'none',
            'auto_scale_poses_override': False,
            'ply_file_path': 'sparse_pc.ply',
            'rolling_shutter_time': model.camera.readout_time,
            'exposure_time': model.exposure_time,
        },
        {
            'transform_matrix': model.poses[:, MIDDLE] @ _OPENGL,
            'camera_linear_velocity': flip * model.velocities,
            'camera_angular_velocity': flip * model.rates,
        },
    )
    points = zip(model.points, model.colors, strict=True)
    _lines(
        folder / 'sparse_pc.ply',
        'ply',
        'format ascii 1.0',
        f'element vertex {len(model.points)}',
        *(f'property float {axis}' for axis in 'xyz'),
        *(f'property uchar {name}' for name in ('red', 'green', 'blue')),
        'end_header',
        *(f'{_text(point)} {_text(color)}' for point, color in points),
    )


def _write_instant_ngp(model: Model, folder: Path) -> None:
    """transforms.json with the poses of start and end.

    instant-ngp abe236e, src/nerf_loader.cu, common_device.cuh: camera to world in OpenGL's axes;
    slerp and lerp at ``t = A + B u + C v`` with v = (row + 0.5) / H. `scale` and `offset` put the
    cameras into the middle half of its unit cube.
    """
    camera = model.camera
    poses = model.poses @ _OPENGL
    places = model.positions[:, MIDDLE]
    low, high = places.min(axis=0), places.max(axis=0)
    size = float((high - low).max())
    scale = 0.5 / max(size, 1e-6)
    by_row = [0.0, camera.row_count] if camera.readout_axis == 1 else [camera.row_count, 0.0]
    shutter = np.array([-0.5, *by_row, 0.0]) / (camera.row_count - 1.0)
    if not camera.reads_forward:
        shutter = np.array([1.0, 0.0, 0.0, 0.0]) - shutter
    _write_transforms(
        model,
        folder,
        {
            'is_fisheye': coefficients_of(camera).fisheye,
            'rolling_shutter': (model.rolls * shutter).tolist(),
            'aabb_scale': 32,
            'scale': scale,
            'offset': (0.5 - 0.5 * scale * (low + high)).tolist(),
        },
        {
            'transform_matrix': poses[:, MIDDLE],
            'transform_matrix_start': poses[:, START],
            'transform_matrix_end': poses[:, END],
        },
    )


# Values of gsplat's enum of shutters, by the direction of the readout.
# [derived: gsplat 90d7b4b, cuda/_wrapper.py]
_GSPLAT_SHUTTERS = {'down': 0, 'right': 1, 'up': 2, 'left': 3, 'global': 4}


def _write_gsplat(model: Model, folder: Path) -> None:
    """cameras.npz: arguments of ``gsplat.rasterization``, and the points.

    gsplat 90d7b4b, cuda/_wrapper.py, cuda/include/Cameras.cuh, rendering.py: from world to camera
    at the row that is read first (`viewmats`) and last (`viewmats_rs`), slerp and lerp between at
    ``floor(y) / (H - 1)``, or ``floor(x) / (W - 1)``; `rolling_shutter`: `_GSPLAT_SHUTTERS`.
    """
    camera, lens = model.camera, coefficients_of(model.camera)
    views = np.linalg.inv(model.poses)
    K = camera.camera_matrix
    K[:2, 2] += _HALF_PIXEL
    direction = camera.readout_direction if model.rolls else 'global'
    with (folder / 'cameras.npz').open('wb') as file:
        np.savez_compressed(
            file,
            viewmats=views[:, START],
            viewmats_rs=views[:, END],
            Ks=np.tile(K, (len(views), 1, 1)),
            width=camera.width,
            height=camera.height,
            rolling_shutter=_GSPLAT_SHUTTERS[direction],
            camera_model='fisheye' if lens.fisheye else 'pinhole',
            radial_coeffs=lens.k,
            tangential_coeffs=lens.p,
            thin_prism_coeffs=lens.s,
            names=np.array(model.names),
            points=model.points,
            colors=model.colors,
        )


def _write_ncore(model: Model, folder: Path) -> None:
    """A sequence of NCore, version 4, with the images.

    ncore 77144a9, docs/data/conventions.rst, impl/data/types.py, impl/sensors/camera.py,
    tools/data_converter/colmap: poses from camera to world at the times of start and end [us],
    slerp and lerp of the translation from world to camera between them.
    """
    try:
        from ncore.data import v4
        from ncore.impl.common.transformations import HalfClosedInterval
        from ncore.impl.data import types
    except ImportError as error:
        raise MissingInputError(
            'the format ncore needs the package nvidia-ncore: pip install '
            f"'nvidia-ncore>=19.8' ({error})"
        ) from None
    both = [START, END] if model.rolls else [MIDDLE, MIDDLE]
    times = np.rint(model.times_ns[:, both] / 1000.0).astype(np.uint64)
    ends, first = np.unique(times, return_index=True)
    span = HalfClosedInterval.from_start_end(int(ends[0]), int(ends[-1]))
    writer = v4.SequenceComponentGroupsWriter(folder, 'recording', 'recording', span, {})
    register = writer.register_component_writer
    poses = register(v4.PosesComponent.Writer, 'default')
    of_ends = model.poses[:, both].reshape(-1, 4, 4)[first]
    poses.store_dynamic_pose(CAMERA_ID, 'world', of_ends, ends)
    intrinsics = register(v4.IntrinsicsComponent.Writer, 'default')
    intrinsics.store_camera_intrinsics(CAMERA_ID, _ncore_camera(model, types))
    # Its loader requires masks and cuboids, if only empty.
    register(v4.MasksComponent.Writer, 'default').store_camera_masks(CAMERA_ID, {})
    register(v4.CuboidsComponent.Writer, 'default').store_observations([])
    frames = register(v4.CameraSensorComponent.Writer, CAMERA_ID)
    for name, span_us in zip(model.names, times, strict=True):
        image = folder / IMAGES / name
        kind = image.suffix[1:].replace('jpg', 'jpeg')
        frames.store_frame(image.read_bytes(), kind, span_us, {}, {})
    color = v4.PointCloudsComponent.AttributeSchema(
        transform_type=types.PointCloud.AttributeTransformType.INVARIANT,
        dtype=np.dtype('uint8'),
        shape_suffix=(3,),
    )
    clouds = register(
        v4.PointCloudsComponent.Writer,
        'landmarks',
        coordinate_unit=types.PointCloud.CoordinateUnit.METERS,
        attribute_schemas={'rgb': color},
    )
    clouds.store_pc(
        xyz=model.points.astype(np.float32),
        reference_frame_id='world',
        reference_frame_timestamp_us=int(ends[0]),
        attributes={'rgb': model.colors},
    )
    writer.finalize()


# Names in NCore's enum of shutters, by the direction of the readout.
# [derived: ncore 77144a9, impl/data/types.py]
_NCORE_SHUTTERS = {
    'down': 'ROLLING_TOP_TO_BOTTOM',
    'right': 'ROLLING_LEFT_TO_RIGHT',
    'up': 'ROLLING_BOTTOM_TO_TOP',
    'left': 'ROLLING_RIGHT_TO_LEFT',
    'global': 'GLOBAL',
}


def _ncore_camera(model: Model, types: Any) -> Any:
    """Camera parameters of NCore; `types`: its module ``ncore.impl.data.types``."""
    camera, lens = model.camera, coefficients_of(model.camera)
    direction = camera.readout_direction if model.rolls else 'global'
    shutter = types.ShutterType[_NCORE_SHUTTERS[direction]]
    fx, fy, cx, cy = _focal_and_centre(camera)
    common = {
        'resolution': np.array([camera.width, camera.height], dtype=np.uint64),
        'shutter_type': shutter,
        'external_distortion_parameters': None,
        'principal_point': np.array([cx, cy], dtype=np.float32),
        'focal_length': np.array([fx, fy], dtype=np.float32),
        'radial_coeffs': np.array(lens.k, dtype=np.float32),
    }
    if lens.fisheye:
        size = np.array([camera.width, camera.height])
        corners = camera.unproject(np.array([[0, 0], [1, 0], [0, 1], [1, 1]]) * size)
        max_angle = float(np.arccos(np.nanmin(corners[:, 2])))
        return types.OpenCVFisheyeCameraModelParameters(**common, max_angle=max_angle)
    return types.OpenCVPinholeCameraModelParameters(
        **common,
        tangential_coeffs=np.array(lens.p, dtype=np.float32),
        thin_prism_coeffs=np.array(lens.s, dtype=np.float32),
    )


class Format(NamedTuple):
    """An exporter; `place`: its formula; `radial`: number of radial coefficients it knows.

    `has_columns`: whether it knows raw images whose columns are read one after the other.
    """

    write: Callable[[Model, Path], None]
    place: Placement
    poses: str  # the formula in words
    images: str  # 'raw' or 'unrolled', by default
    radial: int = 6
    has_columns: bool = True


# How two formats take poses of rows.
_LINEAR = 'poses of the first and the last row, linear between'
# Formats by the value of the option --format.
FORMATS: Mapping[str, Format] = {
    'colmap': Format(_write_colmap, middle, 'one pose per image', 'unrolled'),
    'nerfstudio': Format(
        _write_nerfstudio, velocity_of_pixel, 'a pose and velocities per image', 'raw', 3, False
    ),
    'gsplat': Format(_write_gsplat, lerp_of_translation, _LINEAR, 'raw'),
    'instant-ngp': Format(_write_instant_ngp, lerp_of_position, _LINEAR, 'raw', 2),
    'ncore': Format(_write_ncore, lerp_of_translation, _LINEAR, 'raw'),
}
