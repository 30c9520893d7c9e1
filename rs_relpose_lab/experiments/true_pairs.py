"""True relative poses of recordings: tables of pairs, or the path of an adjustment of all frames.

A table has the pairs of its lines (`read_true_pairs`). A path (`TruePath`) has those of any two of
its frames, so that the pairs of the keyframe policy themselves can be compared with it.
"""

import csv
import math
from pathlib import Path
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from rs_relpose_ros.errors import InputError, MissingInputError
from rs_relpose_ros.geometry import Array

# File of the path of an adjustment over a whole recording. [derived: interface]
PATH_FILE = 'global_truth.csv'
# File of its covariances, next to it. [derived: interface]
COVARIANCE_FILE = 'global_truth_cov.npz'
# File of a table of pairs. [derived: interface]
TABLE_FILE = 'pseudo_truth.csv'
# Number of values of the upper triangle of a covariance of a pose. [derived: 6 * 7 / 2]
_TRIANGLE = 21


class TruePair(NamedTuple):
    """Pose ``X1 = R X2 + t`` of two frames' stamped rows."""

    stamp1_ns: int
    stamp2_ns: int
    R: Array
    t: Array
    # (6, 6) of direction and rotation in the axes of camera 1 [rad]; None if it is not known.
    covariance: Array | None

    @property
    def ends(self) -> tuple[int, int]:
        """Stamps of both frames [ns]."""
        return self.stamp1_ns, self.stamp2_ns


def isotropic(t_sigma: float, R_sigma: float) -> Array:
    """Covariance (6, 6) with 1 sigma of each axis of direction and rotation [rad]."""
    return np.diag(np.repeat([t_sigma**2, R_sigma**2], 3))


# -- Tables of pairs ------------------------------------------------------------------------------


def read_true_pairs(path: Path) -> list[TruePair]:
    """Pairs of a table with columns stamp1_ns, stamp2_ns, r11 to r33, tx, ty, tz and two sigmas.

    `sigma_t_deg` is that of the largest axis, `sigma_r_deg` the root of the sum over three axes.
    """
    rows = _rows(path)
    try:
        return [_pair_of(row) for row in rows]
    except (KeyError, ValueError) as error:
        raise InputError(f'{path} is no table of true pairs: {error}') from error


def _rows(path: Path) -> list[dict[str, str]]:
    if not path.is_file():
        raise MissingInputError(f'there is no table of true pairs {path}')
    with path.open(newline='', encoding='utf-8') as file:
        return list(csv.DictReader(file))


def _pair_of(row: dict[str, str]) -> TruePair:
    places = [(i, j) for i in (1, 2, 3) for j in (1, 2, 3)]

    def real(column: str) -> float:
        return float(row[column])

    elements = [real(f'r{i}{j}') for i, j in places]
    R = np.array(elements).reshape(3, 3)
    t = np.array([real(f't{axis}') for axis in 'xyz'])
    t_sigma = math.radians(real('sigma_t_deg'))
    R_sigma = math.radians(real('sigma_r_deg')) / math.sqrt(3.0)
    covariance = isotropic(t_sigma, R_sigma)
    return TruePair(int(row['stamp1_ns']), int(row['stamp2_ns']), R, t, covariance)


# -- Path of an adjustment of all frames ----------------------------------------------------------


class TruePath(NamedTuple):
    """Poses of the cameras of a recording, and covariances of pairs of them."""

    stamps_ns: NDArray[np.int64]  # (F,) strictly increasing
    positions: Array  # (F, 3) [m]
    rotations: Rotation  # F rotations, camera to world
    covariances: dict[tuple[int, int], Array]  # upper triangle (21,) by the stamps of a pair

    def pair(self, stamp1_ns: int, stamp2_ns: int) -> TruePair | None:
        """The true pair of two frames; None if one of them is not on the path."""
        places = np.searchsorted(self.stamps_ns, (stamp1_ns, stamp2_ns))
        last = len(self.stamps_ns) - 1
        known = self.stamps_ns[np.minimum(places, last)]
        if tuple(known) != (stamp1_ns, stamp2_ns):
            return None
        first, second = map(int, places)
        to_first = self.rotations[first].inv()
        R = (to_first * self.rotations[second]).as_matrix()
        t = to_first.apply(self.positions[second] - self.positions[first])
        triangle = self.covariances.get((stamp1_ns, stamp2_ns))
        covariance = None if triangle is None else _symmetric(triangle)
        return TruePair(stamp1_ns, stamp2_ns, R, t, covariance)


def _symmetric(triangle: Array) -> Array:
    """Matrix (6, 6) of its upper triangle (21,)."""
    upper = np.zeros((6, 6))
    upper[np.triu_indices(6)] = triangle
    return np.asarray(upper + np.triu(upper, 1).T)


def read_true_path(path: Path) -> TruePath:
    """Path of a table with columns stamp_ns, x, y, z, qx, qy, qz, qw, with `COVARIANCE_FILE`."""
    rows = _rows(path)
    beside = path.with_name(COVARIANCE_FILE)
    if not beside.is_file():
        raise MissingInputError(f'there is no {beside}, which has the covariances of {path.name}')
    try:
        stamps = np.array([int(row['stamp_ns']) for row in rows])
        positions = np.array([[float(row[name]) for name in 'xyz'] for row in rows])
        quats = np.array([[float(row[f'q{name}']) for name in 'xyzw'] for row in rows])
        with np.load(beside) as arrays:
            first, second, triangles = (arrays[name] for name in ('s1', 's2', 'C'))
        triangles = triangles.astype(np.float64).reshape(-1, _TRIANGLE)
        ends = zip(first.tolist(), second.tolist(), strict=True)
        covariances = dict(zip(ends, triangles, strict=True))
        return TruePath(stamps, positions, Rotation.from_quat(quats), covariances)
    except (KeyError, ValueError) as error:
        raise InputError(f'{path} and {beside.name} are no true path: {error}') from error


# -- Either ---------------------------------------------------------------------------------------


def read_truth(path: Path) -> TruePath | list[TruePair]:
    """Truth of a recording: of a file of either kind, or the better one of a folder."""
    if path.is_dir():
        of_path = path / PATH_FILE
        return read_truth(of_path if of_path.is_file() else path / TABLE_FILE)
    rows = _rows(path)
    if rows and 'stamp_ns' in rows[0] and 'qw' in rows[0]:
        return read_true_path(path)
    return read_true_pairs(path)
