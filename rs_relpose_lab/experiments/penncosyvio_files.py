"""PennCOSYVIO in the formats in which it is published (https://daniilidis-group.github.io/penncosyvio).

The folder is a checkout of the data set's repository, into which its scripts have downloaded the
sensors and extracted the frames::

    data/ground_truth/SEQUENCE/pose.txt   stamp [s], then the 3x4 pose of the rig in the world
    data/CAMERA/SEQUENCE/frames/          frame_0001.png, ...; timestamps.txt [s], one a line
    data/visensor/SEQUENCE/imu.txt        stamp [s], specific force, angular velocity
    data/tango_bottom/SEQUENCE/           accelerometer.txt, gyroscope.txt: stamp [s], 3 figures
    tools/intrinsic_calibration/cc.mat    OCamCalib's models of the wide-angle cameras
    tools/misc/extrinsic_calibration.txt  number of the sensor, axis, angle [rad], offset [mm]
                                          of the transform from the rig to the sensor

Frames count from 1, as their files do. The rig's axes are those of the GoPro C2.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path

import cv2
import numpy as np
from numpy.typing import NDArray
from scipy.io import loadmat
from scipy.io.matlab import MatReadError
from scipy.spatial.transform import Rotation

from rs_relpose_lab.experiments.omnidirectional import OmnidirectionalCamera
from rs_relpose_ros.convert.recording import ordered_samples
from rs_relpose_ros.convert.tables import read_rows, Row
from rs_relpose_ros.errors import InputError, MissingInputError
from rs_relpose_ros.geometry.camera import RollingShutterCamera
from rs_relpose_ros.imu.samples import ImuSample

Array = NDArray[np.float64]

# Place in cc.mat and in the table of extrinsics (from 1). The Tango's lower camera is calibrated
# as a perspective one, in a format of Matlab's own: its figures are those of the data set's site.
CAMERAS = {'c1': 1, 'c2': 2, 'c3': 3, 'tango_bottom': 4, 'tango_top': 5}
GOPROS = ('c1', 'c2', 'c3')
IMUS = {'visensor': 10, 'tango_bottom': 8, 'tango_top': 9}
_TANGO_BOTTOM = {'width': 1920, 'height': 1080, 'fx': 1959.84, 'fy': 1959.39, 'cx': 980.87,
                 'cy': 523.94, 'distortion': (0.21253, -0.46023, 0.0, 0.0)}

_GROUND_TRUTH = ('data/ground_truth', 'ground_truth')
_INTRINSICS = ('tools/intrinsic_calibration/cc.mat', 'calibration/cc.mat')
_EXTRINSICS = ('tools/misc/extrinsic_calibration.txt', 'calibration/extrinsic_calibration.txt')
_MILLIMETRE = 1e-3


@dataclass(frozen=True, slots=True, eq=False)
class Poses:
    """Poses of a sensor in the world.

    `stamps_ns` (K,): increasing.
    `positions` (K, 3): [m].
    `rotations` (K,): from the sensor's axes to the world's, z up.
    """

    stamps_ns: NDArray[np.int64]
    positions: Array
    rotations: Rotation

    def of_sensor(self, R: Array, t: Array) -> Poses:
        """Poses of a sensor on the rig that these are of: ``x_sensor = R x_rig + t``."""
        return Poses(self.stamps_ns, self.positions - self.rotations.apply(R.T @ t),
                     self.rotations * Rotation.from_matrix(R.T))


def read_poses(folder: Path, sequence: str) -> Poses:
    """Ground truth of a sequence: poses of the rig."""
    path = _first(folder, [f'{place}/{sequence}/pose.txt' for place in _GROUND_TRUTH])
    rows = list(_rows(path, 13))
    stamps = np.array([row.seconds_as_nanoseconds(0) for row in rows], dtype=np.int64)
    if len(rows) < 4 or not (np.diff(stamps) > 0).all():
        raise InputError(f'{path} must hold at least 4 poses in the order of their stamps')
    matrices = np.array([row.reals(1, 12) for row in rows]).reshape(-1, 3, 4)
    R = matrices[:, :, :3]
    off = np.abs(R @ R.transpose(0, 2, 1) - np.eye(3)).max(axis=(1, 2))
    bad = np.flatnonzero((off > 1e-3) | (np.linalg.det(R) < 0.0))
    if len(bad):
        raise rows[bad[0]].error('columns 2 to 13 must be a rotation and a position, row by row')
    return Poses(stamps, matrices[:, :, 3], Rotation.from_matrix(R))


def read_camera(folder: Path, name: str, readout_time: float,
                reference_row: str) -> RollingShutterCamera:
    """Intrinsics of a camera of `CAMERAS`; nobody has measured its read-out time [s]."""
    if name == 'tango_bottom':
        return RollingShutterCamera(**_TANGO_BOTTOM, readout_time=readout_time,  # type: ignore[arg-type]
                                    reference_row=reference_row)
    path = _first(folder, _INTRINSICS)
    try:
        model = loadmat(path)['cc'].flat[CAMERAS[name] - 1]
        values = {field: np.ravel(model[field].flat[0]).astype(np.float64)
                  for field in ('ss', 'xc', 'yc', 'c', 'd', 'e', 'width', 'height')}
        single = {field: value.item() for field, value in values.items() if field != 'ss'}
    # Whatever SciPy and NumPy raise where a file is none or holds something else.
    except (ValueError, KeyError, IndexError, TypeError, NotImplementedError, AttributeError,
            MatReadError, OSError) as error:
        raise InputError(f'{path} does not hold the OCamCalib model of {name}: {error}') from error
    focal = -float(values['ss'][0])
    return OmnidirectionalCamera(
        width=int(single['width']), height=int(single['height']), fx=focal, fy=focal,
        cx=single['yc'] - 1.0, cy=single['xc'] - 1.0, readout_time=readout_time,
        reference_row=reference_row, polynomial=tuple(values['ss']),
        affine=(single['c'], single['d'], single['e']))


def read_extrinsics(folder: Path, number: int) -> tuple[Array, Array]:
    """R (3, 3) and t (3,) [m] with ``x_sensor = R x_rig + t`` of a sensor by its number."""
    path = _first(folder, _EXTRINSICS)
    for row in _rows(path, 8):
        if row.real(0) == number:
            axis, angle = np.array(row.reals(1, 3)), row.real(4)
            if abs(np.linalg.norm(axis) - 1.0) > 1e-3:
                raise row.error('columns 2 to 4 must be an axis of the length 1')
            return (Rotation.from_rotvec(angle * axis).as_matrix(),
                    _MILLIMETRE * np.array(row.reals(5, 3)))
    raise InputError(f'{path} has no line for sensor {number}')


def read_imu(folder: Path, name: str, sequence: str) -> tuple[ImuSample, ...]:
    """Samples of an IMU of `IMUS`, in its own axes."""
    place = _first(folder, [f'data/{name}/{sequence}', f'{name}/{sequence}'])
    if name == 'visensor':
        samples = [ImuSample(row.seconds_as_nanoseconds(0), _vector(row, 4), _vector(row, 1))
                   for row in _rows(place / 'imu.txt', 7)]
        return ordered_samples(samples)
    forces = (ImuSample(row.seconds_as_nanoseconds(0), None, _vector(row, 1))
              for row in _rows(place / 'accelerometer.txt', 4))
    rates = (ImuSample(row.seconds_as_nanoseconds(0), _vector(row, 1), None)
             for row in _rows(place / 'gyroscope.txt', 4))
    # Equal stamps of the two sensors are two samples, not two answers.
    return tuple(sorted([*ordered_samples(forces), *ordered_samples(rates)],
                        key=lambda sample: sample.stamp_ns))


@dataclass(frozen=True, slots=True, eq=False)
class Frames:
    """Extracted frames of a camera.

    `stamps_ns` (K,): of frames 1 to K.
    """

    folder: Path
    stamps_ns: NDArray[np.int64]

    def image(self, number: int, camera: RollingShutterCamera) -> NDArray[np.uint8]:
        """Gray image (H, W) of a frame, counted from 1."""
        path = self.folder / f'frame_{number:04d}.png'
        if not path.is_file():
            raise MissingInputError(f"there is no image {path}: the data set's "
                                    'tools/extract_frames.bash makes it of the video')
        image = cv2.imread(str(path), cv2.IMREAD_GRAYSCALE)
        if image is None or image.shape != (camera.height, camera.width):
            size = 'no image' if image is None else f'{image.shape[1]}x{image.shape[0]} pixels'
            raise InputError(f'{path} must be an image of {camera.width}x{camera.height} pixels, '
                             f'but is {size}')
        return np.asarray(image, dtype=np.uint8)


def read_frames(folder: Path, camera: str, sequence: str) -> Frames:
    """Where the frames of a camera are, and their stamps."""
    place = _first(folder, [f'data/{camera}/{sequence}/frames', f'{camera}/{sequence}/frames'])
    stamps = np.array([row.seconds_as_nanoseconds(0)
                       for row in _rows(place / 'timestamps.txt', 1)], dtype=np.int64)
    if not len(stamps) or not (np.diff(stamps) > 0).all():
        raise InputError(f'{place / "timestamps.txt"} must hold increasing stamps')
    return Frames(place, stamps)


def _first(folder: Path, places: Sequence[str]) -> Path:
    """The first of these places in the folder that is there."""
    for place in places:
        if (folder / place).exists():
            return folder / place
    raise MissingInputError(f'there is no {folder / places[0]}')


def _rows(path: Path, columns: int) -> Iterator[Row]:
    """Rows of a flat text file, white space or commas between its figures."""
    if not path.is_file():
        raise MissingInputError(f'there is no {path}')
    with path.open(encoding='utf-8', errors='replace') as file:
        separator = ',' if ',' in file.readline(10_000) else None
    return read_rows(path, columns, separator)


def _vector(row: Row, first: int) -> tuple[float, float, float]:
    x, y, z = row.reals(first, 3)
    return x, y, z
