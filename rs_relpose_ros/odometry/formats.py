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

# Rows of `Model.R` and `Model.positions`.
START, MIDDLE, END = range(3)
# From OpenGL's camera axes (x right, y up, z backward) to those of OpenCV.
_OPENGL = np.diag([1.0, -1.0, -1.0, 1.0])
IMAGES = 'images'


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
        out = np.zeros((*self.R.shape[:2], 4, 4))
        out[..., :3, :3], out[..., :3, 3], out[..., 3, 3] = self.R, self.positions, 1.0
        return out

    def times_of(self, k: Ints, rows: Array) -> Ints:
        """Times (N,) [ns] of rows of the frames k (N,), limited to those of the image."""
        first = 0.0 if self.camera.readout_direction == 'down' else self.camera.height - 1.0
        times = self.times_ns[k, START] + np.rint(
            NANOSECONDS * self.camera.line_delay * (np.nan_to_num(rows) - first)
        ).astype(np.int64)
        return np.clip(times, self.times_ns[k, START], self.times_ns[k, END])

    @property
    def rolls(self) -> bool:
        """Whether the images have a rolling shutter."""
        return self.camera.readout_time > 0.0


# -- where a format has the camera at a row -------------------------------------------------------
#
# Points (N, 3) in the camera of the frames k (N,) at the rows (N,) of the image, to the camera's
# axes there.

Placement = Callable[[Model, Ints, Array, Array], Array]


def _share(model: Model, rows: Array) -> Array:
    """Share of the readout, 0 at the row that is read first."""
    share = rows / (model.camera.height - 1.0)
    return share if model.camera.readout_direction == 'down' else 1.0 - share


def _slerp(model: Model, k: Ints, share: Array) -> Rotation:
    """Rotation from the camera to the world, at constant rate from start to end."""
    first = Rotation.from_matrix(model.R[k, START])
    turn = (first.inv() * Rotation.from_matrix(model.R[k, END])).as_rotvec()
    return first * Rotation.from_rotvec(share[:, None] * turn)


def lerp_of_position(model: Model, k: Ints, points: Array, rows: Array) -> Array:
    """Slerp of the rotation, linear position of the camera in the world."""
    share = _share(model, rows)
    start, end = model.positions[k, START], model.positions[k, END]
    return np.asarray(
        _slerp(model, k, share).inv().apply(points - start - share[:, None] * (end - start))
    )


def lerp_of_translation(model: Model, k: Ints, points: Array, rows: Array) -> Array:
    """Slerp of the rotation, linear translation from world to camera; the same in a whole row."""
    share = _share(model, np.floor(rows + 0.5))
    start, end = (
        -np.einsum('nji,nj->ni', model.R[k, i], model.positions[k, i]) for i in (START, END)
    )
    return np.asarray(
        _slerp(model, k, share).inv().apply(points) + start + share[:, None] * (end - start)
    )


def middle(model: Model, k: Ints, points: Array, rows: Array) -> Array:
    """One pose per image."""
    return np.einsum('nji,nj->ni', model.R[k, MIDDLE], points - model.positions[k, MIDDLE])


def velocity_of_pixel(model: Model, k: Ints, points: Array, rows: Array) -> Array:
    """Constant velocity in the undistorted image, whose rows have the times of the original's."""
    camera, local = model.camera, middle(model, k, points, rows)
    z = local[:, 2:]
    flow = -(model.velocities[k] + np.cross(model.rates[k], local))
    plane, speed = local[:, :2] / z, (flow[:, :2] - flow[:, 2:] * local[:, :2] / z) / z
    delay = camera.line_delay
    # Time of the row in which the moved point lies: t = delay (fy y + cy + 0.5 - H / 2).
    offset = delay * (camera.fy * plane[:, 1] + camera.cy + 0.5 - 0.5 * camera.height)
    seconds = offset / (1.0 - delay * camera.fy * speed[:, 1])
    return np.column_stack([plane + seconds[:, None] * speed, np.ones(len(k))])


def path(rows: RowTrajectory) -> Placement:
    """The poses of the trajectory itself."""

    def place(model: Model, k: Ints, points: Array, at: Array) -> Array:
        R, p = rows.pose(model.times_of(k, at))
        return np.einsum('nji,nj->ni', R, points - p)

    return place


def projected(place: Placement, model: Model, k: Ints, points: Array, rows: Array) -> Array:
    """Pixels (N, 2) of points at the poses of their own rows; `rows` (N,): first guesses."""
    pixels = np.column_stack([rows, rows])
    for _ in range(6):
        pixels = model.camera.project(place(model, k, points, pixels[:, 1]))
    return pixels


# -- lenses ---------------------------------------------------------------------------------------


class Lens(NamedTuple):
    """Coefficients by OpenCV's names; `fisheye`: k1 to k4 are those of the angle."""

    fisheye: bool
    k: tuple[float, ...]  # k1 to k6, or k1 to k4
    p: tuple[float, float]
    s: tuple[float, ...]  # s1 to s4


def lens_of(camera: RollingShutterCamera) -> Lens:
    """Coefficients of a camera; without distortion all are zero."""
    if camera.distortion_model == 'equidistant':
        return Lens(True, tuple(camera.distortion or (0.0,) * 4), (0.0, 0.0), (0.0,) * 4)
    k1, k2, p1, p2, k3, k4, k5, k6, *s = (*camera.distortion, *[0.0] * 12)[:12]
    return Lens(False, (k1, k2, k3, k4, k5, k6), (p1, p2), tuple(s))


def fitted(camera: RollingShutterCamera, radial: int) -> RollingShutterCamera:
    """The camera with k1 to k`radial`, p1 and p2 only, by least squares over the image."""
    lens = lens_of(camera)
    if lens.fisheye or not (any(lens.k[radial:]) or any(lens.s)):
        return camera
    u, v = np.meshgrid(
        *(np.linspace(0.0, size - 1.0, 41) for size in (camera.width, camera.height))
    )
    pixels = np.column_stack([u.ravel(), v.ravel()])
    rays = camera.unproject(pixels)
    known = np.isfinite(rays).all(axis=1)
    x, y = (rays[known, :2] / rays[known, 2:]).T
    r2 = x * x + y * y
    columns = [np.concatenate([x * r2**i, y * r2**i]) for i in range(1, radial + 1)]
    columns += [
        np.concatenate([2.0 * x * y, r2 + 2.0 * y * y]),
        np.concatenate([r2 + 2.0 * x * x, 2.0 * x * y]),
    ]
    right = (pixels[known] - (camera.cx, camera.cy)) / (camera.fx, camera.fy) - np.column_stack(
        [x, y]
    )
    found = np.linalg.lstsq(np.column_stack(columns), right.T.ravel(), rcond=None)[0].tolist()
    k1, k2, *k3 = found[:radial]
    return replace(
        camera, distortion_model='plumb_bob', distortion=(k1, k2, *found[radial:], *(k3 or [0.0]))
    )


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
    camera, lens = model.camera, lens_of(model.camera)
    values = [camera.fx, camera.fy, camera.cx + 0.5, camera.cy + 0.5]
    k, p = list(lens.k), list(lens.p)
    if lens.fisheye:
        name, values = 'OPENCV_FISHEYE', values + k
    elif any(k[2:]):
        name, values = 'FULL_OPENCV', [*values, *k[:2], *p, *k[2:]]
    else:
        name, values = ('OPENCV', [*values, *k[:2], *p]) if any(k + p) else ('PINHOLE', values)
    out = folder / 'sparse' / '0'
    _lines(
        out / 'cameras.txt',
        '# CAMERA_ID, MODEL, WIDTH, HEIGHT, PARAMS[]',
        f'1 {name} {camera.width} {camera.height} {_text(values)}',
    )
    images = [
        '# IMAGE_ID, QW, QX, QY, QZ, TX, TY, TZ, CAMERA_ID, NAME',
        '# POINTS2D[] as (X, Y, POINT3D_ID)',
    ]
    order = np.argsort(model.observed[:, 0], kind='stable')
    frames, points = model.observed[order].T
    begins = np.searchsorted(frames, np.arange(len(model.names) + 1))
    tracks: list[list[str]] = [[] for _ in model.points]
    for f, image in enumerate(model.names):
        R = model.R[f, MIDDLE].T
        quat = Rotation.from_matrix(R).as_quat()[[3, 0, 1, 2]]
        t = -R @ model.positions[f, MIDDLE]
        images.append(f'{f + 1} {_text(quat)} {_text(t)} 1 {image}')
        mine = slice(begins[f], begins[f + 1])
        for index, point in enumerate(points[mine]):
            tracks[point].append(f'{f + 1} {index}')
        images.append(
            ' '.join(
                f'{x:.4f} {y:.4f} {point + 1}'
                for (x, y), point in zip(
                    model.pixels[order[mine]] + 0.5, points[mine], strict=True
                )
            )
        )
    _lines(out / 'images.txt', *images)
    _lines(
        out / 'points3D.txt',
        '# POINT3D_ID, X, Y, Z, R, G, B, ERROR, TRACK[] as (IMAGE_ID, POINT2D_IDX)',
        *(
            f'{i + 1} {_text(point)} {_text(color)} {error:.4f} {" ".join(track)}'
            for i, (point, color, error, track) in enumerate(
                zip(model.points, model.colors, model.errors, tracks, strict=True)
            )
        ),
    )


def _write_transforms(
    model: Model,
    folder: Path,
    more: Mapping[str, Any],
    of_frame: Callable[[int], Mapping[str, Any]],
) -> None:
    """The transforms.json of instant-ngp and nerfstudio, with entries of their own."""
    camera, lens = model.camera, lens_of(model.camera)
    terms = [
        *zip(('k1', 'k2', 'k3', 'k4'), lens.k, strict=False),
        *zip(('p1', 'p2'), lens.p, strict=True),
    ]
    value = {
        'w': camera.width,
        'h': camera.height,
        'fl_x': camera.fx,
        'fl_y': camera.fy,
        'cx': camera.cx + 0.5,
        'cy': camera.cy + 0.5,
        **{name: value for name, value in terms if value},
        **more,
        'frames': [
            {
                'file_path': f'{IMAGES}/{name}',
                **{key: np.asarray(value).tolist() for key, value in of_frame(f).items()},
            }
            for f, name in enumerate(model.names)
        ],
    }
    _lines(folder / 'transforms.json', json.dumps(value, indent=1))


def _write_nerfstudio(model: Model, folder: Path) -> None:
    """transforms.json with the pose of the middle row and velocities, and the points (PLY).

    nerfstudio fork 34b5604 (nerfstudio_dataparser.py, splatfacto.py), gsplat fork 03fe148
    (forward.cu, helpers.cuh): camera to world in OpenGL's axes, velocities in the camera's;
    a row has the time ``rolling_shutter_time (y / H - 0.5)``. It must be positive: for rows that
    are read upwards the velocities have the other sign. nerfstudio 50e0e3c ignores what it does
    not know.
    """
    sign = 1.0 if model.camera.readout_direction == 'down' else -1.0
    flip, poses = sign * np.diag(_OPENGL)[:3], model.poses[:, MIDDLE] @ _OPENGL
    _write_transforms(
        model,
        folder,
        {
            'camera_model': 'OPENCV_FISHEYE' if lens_of(model.camera).fisheye else 'OPENCV',
            'orientation_override': 'none',
            'auto_scale_poses_override': False,
            'ply_file_path': 'sparse_pc.ply',
            'rolling_shutter_time': model.camera.readout_time,
            'exposure_time': model.exposure_time,
        },
        lambda f: {
            'transform_matrix': poses[f],
            'camera_linear_velocity': flip * model.velocities[f],
            'camera_angular_velocity': flip * model.rates[f],
        },
    )
    _lines(
        folder / 'sparse_pc.ply',
        'ply',
        'format ascii 1.0',
        f'element vertex {len(model.points)}',
        *(f'property float {axis}' for axis in 'xyz'),
        *(f'property uchar {name}' for name in ('red', 'green', 'blue')),
        'end_header',
        *(
            f'{_text(point)} {_text(color)}'
            for point, color in zip(model.points, model.colors, strict=True)
        ),
    )


def _write_instant_ngp(model: Model, folder: Path) -> None:
    """transforms.json with the poses of start and end.

    instant-ngp abe236e, src/nerf_loader.cu, common_device.cuh: camera to world in OpenGL's axes;
    slerp and lerp at ``t = A + B u + C v`` with v = (row + 0.5) / H. `scale` and `offset` put the
    cameras into the middle half of its unit cube.
    """
    height, poses = model.camera.height, model.poses @ _OPENGL
    places = model.positions[:, MIDDLE]
    low, high = places.min(axis=0), places.max(axis=0)
    scale = 0.5 / max(float((high - low).max()), 1e-6)
    shutter = np.array([-0.5, 0.0, height, 0.0]) / (height - 1.0)
    if model.camera.readout_direction == 'up':
        shutter = np.array([1.0, 0.0, 0.0, 0.0]) - shutter
    _write_transforms(
        model,
        folder,
        {
            'is_fisheye': lens_of(model.camera).fisheye,
            'rolling_shutter': (model.rolls * shutter).tolist(),
            'aabb_scale': 32,
            'scale': scale,
            'offset': (0.5 - 0.5 * scale * (low + high)).tolist(),
        },
        lambda f: {
            'transform_matrix': poses[f, MIDDLE],
            'transform_matrix_start': poses[f, START],
            'transform_matrix_end': poses[f, END],
        },
    )


def _write_gsplat(model: Model, folder: Path) -> None:
    """cameras.npz: arguments of ``gsplat.rasterization``, and the points.

    gsplat 90d7b4b, cuda/_wrapper.py, cuda/include/Cameras.cuh, rendering.py: from world to camera
    at the row that is read first (`viewmats`) and last (`viewmats_rs`), slerp and lerp between at
    ``floor(y) / (H - 1)``; `rolling_shutter`: 0 downwards, 2 upwards, 4 global.
    """
    camera, lens = model.camera, lens_of(model.camera)
    views = np.linalg.inv(model.poses)
    K = camera.camera_matrix
    K[:2, 2] += 0.5
    down = camera.readout_direction == 'down'
    with (folder / 'cameras.npz').open('wb') as file:
        np.savez_compressed(
            file,
            viewmats=views[:, START],
            viewmats_rs=views[:, END],
            Ks=np.tile(K, (len(views), 1, 1)),
            width=camera.width,
            height=camera.height,
            rolling_shutter=4 if not model.rolls else 0 if down else 2,
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
            f"'rs_relpose_ros[ncore]' ({error})"
        ) from None
    camera, lens = model.camera, lens_of(model.camera)
    kinds = types.ShutterType
    shutter = (
        kinds.GLOBAL
        if not model.rolls
        else kinds.ROLLING_TOP_TO_BOTTOM
        if (camera.readout_direction == 'down')
        else kinds.ROLLING_BOTTOM_TO_TOP
    )
    single = {
        name: np.array(value, dtype=np.float32)
        for name, value in {
            'principal_point': (camera.cx + 0.5, camera.cy + 0.5),
            'focal_length': (camera.fx, camera.fy),
            'radial_coeffs': lens.k,
        }.items()
    }
    common = {
        'resolution': np.array([camera.width, camera.height], dtype=np.uint64),
        'shutter_type': shutter,
        'external_distortion_parameters': None,
        **single,
    }
    corners = camera.unproject(
        np.array([[0, 0], [1, 0], [0, 1], [1, 1]]) * (camera.width, camera.height)
    )[:, 2]
    parameters = (
        types.OpenCVFisheyeCameraModelParameters(
            **common, max_angle=float(np.arccos(np.nanmin(corners)))
        )
        if lens.fisheye
        else types.OpenCVPinholeCameraModelParameters(
            **common,
            tangential_coeffs=np.array(lens.p, dtype=np.float32),
            thin_prism_coeffs=np.array(lens.s, dtype=np.float32),
        )
    )
    both = [START, END] if model.rolls else [MIDDLE, MIDDLE]
    times = np.rint(model.times_ns[:, both] / 1000.0).astype(np.uint64)
    ends, first = np.unique(times, return_index=True)
    writer = v4.SequenceComponentGroupsWriter(
        folder,
        'recording',
        'recording',
        HalfClosedInterval.from_start_end(int(ends[0]), int(ends[-1])),
        {},
    )
    register = writer.register_component_writer
    register(v4.PosesComponent.Writer, 'default').store_dynamic_pose(
        CAMERA_ID, 'world', model.poses[:, both].reshape(-1, 4, 4)[first], ends
    )
    register(v4.IntrinsicsComponent.Writer, 'default').store_camera_intrinsics(
        CAMERA_ID, parameters
    )
    # Its loader requires masks and cuboids, if only empty.
    register(v4.MasksComponent.Writer, 'default').store_camera_masks(CAMERA_ID, {})
    register(v4.CuboidsComponent.Writer, 'default').store_observations([])
    frames = register(v4.CameraSensorComponent.Writer, CAMERA_ID)
    for name, span in zip(model.names, times, strict=True):
        image = folder / IMAGES / name
        frames.store_frame(
            image.read_bytes(), image.suffix[1:].replace('jpg', 'jpeg'), span, {}, {}
        )
    clouds = register(
        v4.PointCloudsComponent.Writer,
        'landmarks',
        coordinate_unit=types.PointCloud.CoordinateUnit.METERS,
        attribute_schemas={
            'rgb': v4.PointCloudsComponent.AttributeSchema(
                transform_type=types.PointCloud.AttributeTransformType.INVARIANT,
                dtype=np.dtype('uint8'),
                shape_suffix=(3,),
            )
        },
    )
    clouds.store_pc(
        xyz=model.points.astype(np.float32),
        reference_frame_id='world',
        reference_frame_timestamp_us=int(ends[0]),
        attributes={'rgb': model.colors},
    )
    writer.finalize()


CAMERA_ID = 'camera'


class Format(NamedTuple):
    """An exporter; `place`: its formula; `radial`: number of radial coefficients it knows."""

    write: Callable[[Model, Path], None]
    place: Placement
    poses: str  # the formula in words
    images: str  # 'raw' or 'unrolled', by default
    radial: int = 6


_LINEAR = 'poses of the first and the last row, linear between'
FORMATS: Mapping[str, Format] = {
    'colmap': Format(_write_colmap, middle, 'one pose per image', 'unrolled'),
    'nerfstudio': Format(
        _write_nerfstudio, velocity_of_pixel, 'a pose and velocities per image', 'raw', 3
    ),
    'gsplat': Format(_write_gsplat, lerp_of_translation, _LINEAR, 'raw'),
    'instant-ngp': Format(_write_instant_ngp, lerp_of_position, _LINEAR, 'raw', 2),
    'ncore': Format(_write_ncore, lerp_of_translation, _LINEAR, 'raw'),
}
