"""EuRoC's corners as tracks: a real global shutter with its IMU, and metric truth.

Folder `euroc_imu_april_corners` (its README says where it comes from): corners of an AprilGrid in
1439 images of the calibration recording of the EuRoC MAV dataset, its IMU, and the camera's poses
by PnP of each image's corners.
"""

from __future__ import annotations

import io
from pathlib import Path
import tarfile
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from rs_relpose_lab.experiments.trust_rows import Told
from rs_relpose_lab.experiments.trust_runs import Arrival, intrinsics_of, Recording, Source, TRACKS
from rs_relpose_lab.experiments.trust_tracks import numbered_image, Sightings, TrackNoise
from rs_relpose_ros.bags.layout import IMAGE_DELAY
from rs_relpose_ros.errors import MissingInputError
from rs_relpose_ros.geometry.camera import RollingShutterCamera
from rs_relpose_ros.geometry.timing import to_nanoseconds
from rs_relpose_ros.imu.samples import ImuSample
from rs_relpose_ros.replay.truth import TrueTrajectory

Array = NDArray[np.float64]

NAME = 'EuRoC imu_april'

# Calibration of the dataset (cam0 of the VI-Sensor); the bias is fitted, README of the folder, by
# a lens whose principal point fits these corners 7 px beside the given one.
_CAMERA = RollingShutterCamera(
    width=752, height=480, fx=458.654, fy=457.296, cx=367.215, cy=248.375,
    distortion=(-0.28340811, 0.07395907, 0.00019359, 1.76187114e-05, 0.0), readout_time=0.0)
_BODY_FROM_CAMERA = np.array([
    [0.0148655429818, -0.999880929698, 0.00414029679422, -0.0216401454975],
    [0.999557249008, 0.0149672133247, 0.025715529948, -0.064676986768],
    [-0.0257744366974, 0.00375618835797, 0.999660727178, 0.00981073058949]])
_GYRO_BIAS = (-0.0016, 0.0250, 0.0777)
_CORNERS = 144


class _Corners(NamedTuple):
    stamp_ns: int
    ids: NDArray[np.int64]   # (N,) increasing
    pixels: Array   # (N, 2)


def read_euroc(folder: Path) -> tuple[Recording, TrueTrajectory]:
    """The recording and its truth, the world being the target; MissingInputError without it."""
    try:
        with tarfile.open(folder / 'cam0_corners.tar.gz') as archive:
            files = [archive.extractfile(member) for member in archive if member.isfile()]
            found = [_corners(file.read().decode()) for file in files if file is not None]
        imu = np.loadtxt(folder / 'imu0.csv', delimiter=',', comments='#', usecols=range(1, 7))
        imu_ns = np.loadtxt(folder / 'imu0.csv', dtype=np.int64, delimiter=',', comments='#',
                            usecols=0)
        poses = np.loadtxt(folder / 'gt_pnp_cam0.csv', delimiter=',', skiprows=1,
                           usecols=range(3, 10))
        stamps = np.loadtxt(folder / 'gt_pnp_cam0.csv', dtype=np.int64, delimiter=',', skiprows=1,
                            usecols=0)
    except OSError as error:
        raise MissingInputError(f"there are no corners of EuRoC's in {folder}: {error}") from error
    frames = sorted((frame for frame in found if frame is not None),
                    key=lambda frame: frame.stamp_ns)
    R = Rotation.from_quat(poses[:, [1, 2, 3, 0]])   # X_cam = R X_target + t
    truth = TrueTrajectory(stamps, -R.inv().apply(poses[:, 4:]), R.inv().as_quat())
    C = _BODY_FROM_CAMERA[:, :3].T
    told = Told({
        'readout_time': 0.0, 'gyro_bias': _GYRO_BIAS,
        'quat_cam_imu_xyzw': tuple(Rotation.from_matrix(C).as_quat().tolist()),
        'imu_position': tuple((-C @ _BODY_FROM_CAMERA[:, 3]).tolist())}, intrinsics_of(_CAMERA))
    nothing = np.zeros((_CORNERS, 2))
    sightings = Sightings(
        tuple(frame.ids for frame in frames), tuple(frame.pixels for frame in frames),
        tuple(np.zeros_like(frame.pixels) for frame in frames), np.zeros(len(frames)), nothing,
        nothing, TrackNoise(white=0.0))
    delay_ns, shape = to_nanoseconds(IMAGE_DELAY), (_CAMERA.height, _CAMERA.width)
    recording = Recording(
        Source(NAME, TRACKS), told, _CAMERA,
        [Arrival(k, frame.stamp_ns, frame.stamp_ns + delay_ns) for k, frame in enumerate(frames)],
        [ImuSample(int(ns), tuple(row[:3].tolist()), tuple(row[3:].tolist()))
         for ns, row in zip(imu_ns, imu, strict=True)],
        lambda number: numbered_image(number, shape), sightings, truth.relative_pose, imu_ns,
        imu[:, :3] @ C.T)
    return recording, truth


def _corners(text: str) -> _Corners | None:
    """Of a file of an image: stamp, corners by number, pixels; None where none was found."""
    lines = text.splitlines()[1:]
    if not lines:
        return None
    table = np.loadtxt(io.StringIO('\n'.join(lines)), delimiter=',', ndmin=2)
    ids = (4 * table[:, -2] + table[:, -1]).astype(np.int64)
    order = np.argsort(ids)
    return _Corners(int(lines[0].partition(',')[0]), ids[order], table[order, 5:7])
