"""PennCOSYVIO in the formats in which it is published (https://daniilidis-group.github.io/penncosyvio).

The folder is a checkout of the data set's repository::

    data/ground_truth/SEQUENCE/pose.txt   stamp [s], then the 3x4 pose of the rig in the world
    tools/intrinsic_calibration/cc.mat    OCamCalib's models of the wide-angle cameras

The rig's axes are those of the GoPro C2.
"""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy.io import loadmat
from scipy.io.matlab import MatReadError
from scipy.spatial.transform import Rotation

from rs_relpose_ros.bags.convert import read_rows, Row
from rs_relpose_ros.errors import InputError, MissingInputError
from rs_relpose_ros.geometry import Array
from rs_relpose_ros.geometry.camera import rays_with_jacobian, RollingShutterCamera

# -- The camera model of the OCamCalib toolbox (Scaramuzza), in which PennCOSYVIO is calibrated ---
#
# With (c, d, e) and the polynomial f(rho) = a0 + a2 rho^2 + a3 rho^3 + ... (negative, its z axis
# points backwards), and m = (x, y) right and down from the centre on an ideal sensor:
#
#     u - cx = x + e y          v - cy = d x + c y          ray ~ (x, y, -f(|m|))

_MAX_STEPS = 50
_SETTLED = 1e-10


@dataclass(frozen=True, slots=True, kw_only=True)
class OmnidirectionalCamera(RollingShutterCamera):
    """A wide-angle rolling-shutter camera with a field of view below 180 degrees.

    `polynomial`: a0, a1, a2, ... as OCamCalib prints ``ss``; a1 is 0, as its model demands.
    `affine` (c, d, e): as OCamCalib names them.

    Notes
    -----
    `fx` and `fy` are -a0, the pixels per radian at the centre; `cx` and `cy` its column and row,
    the first pixel being 0 (OCamCalib, in Matlab, counts from 1, and has row, column).
    """

    polynomial: tuple[float, ...]
    affine: tuple[float, float, float] = (1.0, 0.0, 0.0)

    def __post_init__(self) -> None:
        # Without super(): a dataclass with slots is another class than that of the text.
        RollingShutterCamera.__post_init__(self)
        for name in ('polynomial', 'affine'):
            values = tuple(float(value) for value in getattr(self, name))
            if not np.isfinite(values).all():
                raise InputError(f'{name} must be finite, got {values}')
            object.__setattr__(self, name, values)
        if len(self.polynomial) < 2 or not self.polynomial[0] < 0.0 or self.polynomial[1] != 0.0:
            raise InputError('polynomial must begin with a negative number and 0, '
                             f'got {self.polynomial}')
        if not abs(np.linalg.det(self._stretch)) > 1e-3:
            raise InputError(f'affine must be c, d, e of an invertible map, got {self.affine}')

    @property
    def is_undistorted(self) -> bool:
        """Never a plain pinhole."""
        return False

    def project(self, points: ArrayLike) -> Array:
        """Raw pixels (N, 2) of points (N, 3) in the camera frame; NaN outside of the lens."""
        points = np.ascontiguousarray(points, dtype=np.float64).reshape(-1, 3)
        across = np.hypot(points[:, 0], points[:, 1])
        # rho of the ray: rho * depth = -f(rho) * across, by Newton's method.
        with np.errstate(all='ignore'):
            angle = np.arctan2(across, points[:, 2])
            rho = -self.polynomial[0] * angle
            for _ in range(_MAX_STEPS):
                depth, by_rho = self._depth(rho)
                step = ((rho * points[:, 2] - across * depth)
                        / (points[:, 2] - across * rho * by_rho))
                rho = rho - step
                if not (np.abs(step) > _SETTLED * np.abs(rho)).any():
                    break
            observed = ((np.abs(step) <= 1e-6) & (rho >= 0.0) & (self._depth(rho)[0] > 0.0)
                        & (points[:, 2] > 1e-9))
            scale = np.where(across > 0.0, rho / np.where(across > 0.0, across, 1.0), 0.0)
        pixels = (points[:, :2] * scale[:, None]) @ self._stretch.T + (self.cx, self.cy)
        pixels[~observed] = np.nan
        return pixels

    def unproject_with_jacobian(self, points: ArrayLike) -> tuple[Array, Array]:
        """Unit rays (N, 3) and their derivatives (N, 3, 2) by the raw pixel coordinates u, v."""
        points = np.asarray(points, dtype=np.float64).reshape(-1, 2)
        inverse = np.linalg.inv(self._stretch)
        plane = (points - (self.cx, self.cy)) @ inverse.T
        depth, by_rho = self._depth(np.hypot(plane[:, 0], plane[:, 1]))
        depth = np.where(depth > 0.0, depth, np.nan)
        normalized = plane / depth[:, None]
        # d(m / depth)/dm = (I - n (d depth/dm)) / depth, with d depth/dm = by_rho m.
        by_plane = (np.eye(2) - normalized[:, :, None] * (by_rho[:, None] * plane)[:, None, :])
        by_pixel = by_plane / depth[:, None, None] @ inverse
        return rays_with_jacobian(normalized, np.ascontiguousarray(by_pixel))

    @property
    def _stretch(self) -> Array:
        c, d, e = self.affine
        return np.array([[1.0, e], [d, c]])

    def _depth(self, rho: Array) -> tuple[Array, Array]:
        """``-f(rho)`` and its derivative over rho (finite at 0, as a1 is 0)."""
        a = np.array(self.polynomial)
        slopes = np.arange(2, len(a)) * a[2:]
        return (-np.polynomial.polynomial.polyval(rho, a),
                -np.polynomial.polynomial.polyval(rho, slopes if len(slopes) else [0.0]))


_GROUND_TRUTH = ('data/ground_truth', 'ground_truth')
_INTRINSICS = ('tools/intrinsic_calibration/cc.mat', 'calibration/cc.mat')


@dataclass(frozen=True, slots=True, eq=False)
class Poses:
    """Poses of the rig in the world."""

    stamps_ns: NDArray[np.int64]   # (K,) increasing
    positions: Array   # (K, 3) [m]
    rotations: Rotation   # (K,) to the world, z up

def read_poses(folder: Path, sequence: str) -> Poses:
    """Ground truth of a sequence."""
    path = _first(folder, [f'{place}/{sequence}/pose.txt' for place in _GROUND_TRUTH])
    rows = list(_rows(path, 13))
    stamps = np.array([row.seconds_as_nanoseconds(0) for row in rows], dtype=np.int64)
    if len(rows) < 4 or not (np.diff(stamps) > 0).all():
        raise InputError(f'{path} must hold at least 4 poses in the order of their stamps')
    matrices = np.array([[row.real(column) for column in range(1, 13)]
                         for row in rows]).reshape(-1, 3, 4)
    R = matrices[:, :, :3]
    off = np.abs(R @ R.transpose(0, 2, 1) - np.eye(3)).max(axis=(1, 2))
    bad = np.flatnonzero((off > 1e-3) | (np.linalg.det(R) < 0.0))
    if len(bad):
        raise rows[bad[0]].error('columns 2 to 13 must be a rotation and a position, row by row')
    return Poses(stamps, matrices[:, :, 3], Rotation.from_matrix(R))


def read_camera(folder: Path, readout_time: float, reference_row: str) -> RollingShutterCamera:
    """Intrinsics of the GoPro C2; its readout time [s] has not been measured."""
    path = _first(folder, _INTRINSICS)
    try:
        model = loadmat(path)['cc'].flat[1]
        values = {field: np.ravel(model[field].flat[0]).astype(np.float64)
                  for field in ('ss', 'xc', 'yc', 'c', 'd', 'e', 'width', 'height')}
        single = {field: value.item() for field, value in values.items() if field != 'ss'}
    # Exceptions of SciPy and NumPy for other files and other contents.
    except (ValueError, KeyError, IndexError, TypeError, NotImplementedError, AttributeError,
            MatReadError, OSError) as error:
        raise InputError(f'{path} does not hold the OCamCalib model of C2: {error}') from error
    focal = -float(values['ss'][0])
    return OmnidirectionalCamera(
        width=int(single['width']), height=int(single['height']), fx=focal, fy=focal,
        cx=single['yc'] - 1.0, cy=single['xc'] - 1.0, readout_time=readout_time,
        reference_row=reference_row, polynomial=tuple(values['ss']),
        affine=(single['c'], single['d'], single['e']))


def _first(folder: Path, places: Sequence[str]) -> Path:
    """The first of these places in the folder that is there."""
    for place in places:
        if (folder / place).exists():
            return folder / place
    raise MissingInputError(f'there is no {folder / places[0]}')


def _rows(path: Path, columns: int) -> Iterator[Row]:
    """Rows of a flat text file, separated by white space or commas."""
    if not path.is_file():
        raise MissingInputError(f'there is no {path}')
    with path.open(encoding='utf-8', errors='replace') as file:
        separator = ',' if ',' in file.readline(10_000) else None
    return read_rows(path, range(columns), separator)
