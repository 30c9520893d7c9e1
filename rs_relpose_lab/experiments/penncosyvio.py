"""The paper's protocol on PennCOSYVIO: which pairs, and each of them as the methods get it.

Of eight stretches of the sequences 'as' and 'af', every fifth frame makes a pair with the one 30
frames later; SIFT matches; angular velocity and gravity are means over 0.1 s.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace
import math
from pathlib import Path
from typing import Protocol

import numpy as np
from numpy.typing import NDArray

from rs_relpose_lab.experiments.boxes import Record
from rs_relpose_lab.experiments.methods import METHODS, PairProblem, run_method
from rs_relpose_lab.experiments.pair_imu import PairImu
from rs_relpose_lab.experiments.penncosyvio_files import (
    CAMERAS,
    IMUS,
    Poses,
    read_camera,
    read_extrinsics,
    read_frames,
    read_imu,
    read_poses,
)
from rs_relpose_ros.config.estimator import EstimatorConfig
from rs_relpose_ros.config.imu import ImuConfig
from rs_relpose_ros.config.tracking import TrackingConfig
from rs_relpose_ros.errors import InputError, MissingInputError
from rs_relpose_ros.geometry.camera import RollingShutterCamera
from rs_relpose_ros.geometry.timing import ImageClock
from rs_relpose_ros.replay.truth import TrueTrajectory
from rs_relpose_ros.tracking.descriptors import DescriptorTracker
from rs_relpose_ros.tracking.matches import Matches

Array = NDArray[np.float64]

EXPERIMENT = 'penncosyvio'

# First and last frame of the stretches, from the paper's table 1; a frame's number is that of its
# row in pose.txt.
STRETCHES: Mapping[str, tuple[tuple[int, int], ...]] = {
    'as': ((206, 567), (1319, 1679), (2581, 2971), (4358, 4599)),
    'af': ((101, 551), (913, 1123), (1604, 1815), (2539, 2810)),
}
METHODS_OF_THE_EXPERIMENT = ('global_5pt', 'uniform_9pt', 'uniform_11pt', 'auto', 'auto_gyro',
                             'opencv_derotated', 'opencv_gyro')

# Nobody has measured it. What the data set's authors quote for a GoPro Hero 4 [s]:
# https://github.com/daniilidis-group/penncosyvio/issues/3
GOPRO_READOUT = 0.03


@dataclass(frozen=True, slots=True)
class Pair:
    """Two frames of a sequence, counted from 1; `stretch` is counted from 1, too."""

    sequence: str
    stretch: int
    first: int
    second: int


@dataclass(frozen=True, slots=True)
class PennCosyvioRun:
    """What is run, and on what.

    `sequences`, `methods`, `camera`, `imu`: names of `STRETCHES`, `METHODS`, `CAMERAS`, `IMUS`.
    `readout_time` [s]; `stamp_row`: that a frame's stamp marks.
    `time_offset`: IMU clock minus camera clock [s]; `gyro_bias`: subtracted, IMU frame [rad/s].
    `every`, `distance`: frames from one pair to the next, and between the two of a pair.
    """

    sequences: tuple[str, ...]
    methods: tuple[str, ...]
    camera: str = 'c2'
    imu: str = 'visensor'
    readout_time: float = GOPRO_READOUT
    stamp_row: str = 'first'
    time_offset: float = 0.0
    gyro_bias: tuple[float, ...] = (0.0, 0.0, 0.0)
    every: int = 5
    distance: int = 30
    seed: int = 0

    def __post_init__(self) -> None:
        for name, least in (('every', 1), ('distance', 1), ('seed', 0)):
            if getattr(self, name) < least:
                raise InputError(f'{name} must be at least {least}, got {getattr(self, name)}')
        if not abs(self.time_offset) <= 10.0:
            raise InputError(f'time_offset must be in [-10, 10] s, got {self.time_offset:g}')

    def pairs(self) -> list[Pair]:
        """Every pair, in the order of the tables."""
        return [Pair(sequence, stretch, first, first + self.distance)
                for sequence in self.sequences
                for stretch, (start, end) in enumerate(STRETCHES[sequence], start=1)
                for first in range(start, end - self.distance + 1, self.every)]


class PairSource(Protocol):
    """Where the pairs of one sequence come from."""

    def problem(self, pair: Pair) -> PairProblem:
        """The pair as the methods get it."""


def run_penncosyvio(run: PennCosyvioRun, open_sequence: Callable[[str], PairSource],
                    on_pair: Callable[[], object] = lambda: None) -> list[Record]:
    """Estimate every pair by every method; `on_pair` is called after each pair."""
    records = []
    sequences = {name: open_sequence(name) for name in run.sequences}
    for pair in run.pairs():
        problem = sequences[pair.sequence].problem(pair)
        records += [Record(EXPERIMENT, pair.sequence, str(pair.stretch), name, pair.first,
                           *run_method(name, problem, pair.first)) for name in run.methods]
        on_pair()
    return records


class RecordedSequence:
    """A sequence of the data set's folder."""

    def __init__(self, folder: Path, name: str, run: PennCosyvioRun) -> None:
        self._camera = read_camera(folder, run.camera, run.readout_time, run.stamp_row)
        self._frames = read_frames(folder, run.camera, name)
        R_cam_rig, _ = read_extrinsics(folder, CAMERAS[run.camera])
        R_imu_rig, _ = read_extrinsics(folder, IMUS[run.imu])
        poses = camera_poses(folder, name, run.camera)
        self._truth = TrueTrajectory(poses.stamps_ns, poses.positions,
                                     poses.rotations.as_quat())
        config = ImuConfig(gyro_bias=run.gyro_bias)
        self._imu = PairImu(read_imu(folder, run.imu, name), R_cam_rig @ R_imu_rig.T,
                            ImageClock(self._camera, run.time_offset), config)
        self._with_gyro = with_gyro(run)
        self._name = name

    def problem(self, pair: Pair) -> PairProblem:
        """Match the two images, ask IMU and truth at their stamps."""
        stamps = [self._stamp_ns(number) for number in (pair.first, pair.second)]
        truth = self._truth.relative_pose(*stamps)
        if truth is None:
            raise MissingInputError(f'the ground truth of {self._name} does not cover the frames '
                                    f'{pair.first} and {pair.second}')
        images = [self._frames.image(number, self._camera)
                  for number in (pair.first, pair.second)]
        return pair_problem(sift_matches(*images), self._camera, self._imu, stamps, truth,
                            EstimatorConfig(), self._with_gyro)

    def _stamp_ns(self, number: int) -> int:
        if number > len(self._frames.stamps_ns):
            raise MissingInputError(f'{self._name} must have a frame {number}, but '
                                    f'{self._frames.folder} has stamps of '
                                    f'{len(self._frames.stamps_ns)}')
        return int(self._frames.stamps_ns[number - 1])


def with_gyro(run: PennCosyvioRun) -> bool:
    """Whether a method of the run uses the gyro as it runs on."""
    return any(METHODS[name].continuous_gyro for name in run.methods)


def sift_matches(image1: NDArray[np.uint8], image2: NDArray[np.uint8]) -> Matches:
    """Matches of SIFT features between two gray images (H, W)."""
    tracker = DescriptorTracker(TrackingConfig(detector='sift'))
    tracker.start(image1)
    return tracker.track(image2)


def pair_problem(matches: Matches, camera: RollingShutterCamera, imu: PairImu,
                 stamps_ns: list[int], truth: tuple[Array, Array], told: EstimatorConfig,
                 with_gyro: bool) -> PairProblem:
    """A pair with the IMU of the paper's protocol; the estimator is told how bad the means are."""
    first, second = (imu.mean(stamp) for stamp in stamps_ns)
    # The most that the estimator can be told is 1.5 rad and 1 rad/s.
    told = replace(
        told, gravity_sigma=min(max(first.gravity_sigma, second.gravity_sigma), 1.5),
        gyro_sigma=min(math.hypot(told.gyro_sigma, max(first.rate_sigma, second.rate_sigma)), 1.0))
    gyro = imu.continuous(*stamps_ns) if with_gyro else None
    return PairProblem(matches.points1, matches.points2, camera, first.motion, second.motion,
                       *truth, told, matches.quality, gyro)


def camera_poses(folder: Path, sequence: str, camera: str) -> Poses:
    """Ground truth of a camera; the extrinsics are read only where they are not the identity."""
    poses = read_poses(folder, sequence)
    if camera == 'c2':
        return poses
    return poses.of_sensor(*read_extrinsics(folder, CAMERAS[camera]))
