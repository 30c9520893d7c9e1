"""How the images turn, against the gyro.

Only a part of the frames is looked at: blocks of consecutive ones, evenly over the recording, at
reduced size. What is followed through them goes where the tracks of `rs_relpose calibrate` go:
its search for clock and axes, and its fit, with what is known held.
"""

from __future__ import annotations

from dataclasses import dataclass
import math

import cv2
import numpy as np
from numpy.typing import NDArray

from rs_relpose_ros.calibrate.alignment import find_starts, Start
from rs_relpose_ros.calibrate.coplanarity import BIAS, GLOBAL, OFFSET, READOUT, ROTATION
from rs_relpose_ros.calibrate.fit import fit, initial, refit
from rs_relpose_ros.calibrate.follow import PointFollower
from rs_relpose_ros.calibrate.gyro_path import GyroSeries
from rs_relpose_ros.calibrate.observations import Observations, PairSelection
from rs_relpose_ros.config.tracking import TrackingConfig
from rs_relpose_ros.geometry.intrinsics import Intrinsics

Array = NDArray[np.float64]

_BLOCKS, _BLOCK_FRAMES = 10, 25
# Longest side of the images that are tracked [px].
_WORKING_SIDE = 640
_POINTS = 150
_LEAST_POINTS = 15
# Keypoints of an image where descriptors are matched: some of them are found in the next one.
_MOST_DESCRIPTORS = 500
# Distance of points from each other, in image sides.
_APART = 0.015
# Clock offsets that are tried [s].
_WIDEST_OFFSET = 0.25
_OFFSET_STEP = 0.005
# Longer steps between gyro samples are not interpolated [s].
_GYRO_GAP = 0.1
_LEAST_PAIRS = 20
_WORTH_REFINING = 0.5
_REFINED = PairSelection((0.033, 0.067, 0.133), 80, _LEAST_POINTS, 160)
# What rows, blur and moving things leave open at least [s].
_LEAST_SIGMA = 7e-4


@dataclass(frozen=True, slots=True, eq=False)
class Alignment:
    """Gyro and images laid upon each other."""

    R_cam_imu: Array        # (3, 3)
    offset: float           # from a frame's stamp to the gyro's [s], of the middle row
    offset_sigma: float     # [s]
    explained: float        # share of the images' turning that the gyro explains then, 0 to 1
    scale: float            # turning by the images over that by the gyro
    rate: float             # root mean square rate of the images [rad/s]
    balance: float          # second over first principal rate: near 0 where it is about one axis
    pairs: int


class TurningImages:
    """Takes in the images and the gyro, in the order of recording.

    `images` is the number of images; of `tracking` the detector is used, with settings for small
    images.
    """

    def __init__(self, images: int, tracking: TrackingConfig) -> None:
        stride = max(images // _BLOCKS, 1)
        self._wanted = {first + k for first in range(0, images, stride)
                        for k in range(min(_BLOCK_FRAMES, stride + 1))}
        self._index = self._index_before = -1
        self._detector = tracking.detector
        self._follower: PointFollower | None = None
        self._shape: tuple[int, ...] = ()
        self._reduction = 1.0
        self._intrinsics: Intrinsics | None = None
        self._recent: list[tuple[int, Array]] = []
        self._gyro: dict[int, Array] = {}
        self._keep_until_ns = 0
        self.points: list[int] = []

    def wants_next(self) -> bool:
        """Count an image; whether it is to be decoded and handed over."""
        self._index += 1
        return self._index in self._wanted

    def add_image(self, stamp_ns: int, recorded_ns: int, image: NDArray[np.uint8],
                  intrinsics: Intrinsics) -> None:
        """Take in an image that was wanted."""
        self._keep_until_ns = recorded_ns + int(2e9 * _WIDEST_OFFSET)
        self._intrinsics = intrinsics
        if self._follower is None or image.shape != self._shape:
            # Of images of several sizes the last ones count.
            self._shape = image.shape
            self._reduction = min(_WORKING_SIDE / max(image.shape), 1.0)
            self._follower = PointFollower(TrackingConfig(
                detector=self._detector, max_features=_POINTS, max_descriptors=_MOST_DESCRIPTORS,
                klt_levels=5, min_feature_distance=max(
                    _APART * self._reduction * max(image.shape), 1.0)))
        follows = len(self._follower) > 0 and self._index == self._index_before + 1
        self._index_before = self._index
        if not follows:
            self._follower.restart()
        small = image if self._reduction == 1.0 else np.asarray(
            cv2.resize(image, None, fx=self._reduction, fy=self._reduction,
                       interpolation=cv2.INTER_AREA), dtype=np.uint8)
        points = self._follower.add(stamp_ns, small)
        if follows:
            self.points.append(points)

    def add_rate(self, stamp_ns: int, recorded_ns: int, rate: Array) -> None:
        """Take in a gyro sample."""
        self._recent.append((stamp_ns, rate))
        if recorded_ns <= self._keep_until_ns:
            self._gyro.update(self._recent)
            self._recent = []
        elif len(self._recent) > 4096:
            # About what an image that comes now may look back to.
            self._recent = self._recent[-2048:]

    def align(self, readout: float | None) -> Alignment | None:
        """Lay both upon each other; None where there is too little of either.

        `readout`: time from the first row to the last [s], negative when read upwards; None where
        it is not known.
        """
        data = self._observations()
        if data is None:
            return None
        rng = np.random.default_rng(0)
        pairs = data.pairs((1,), max_matches=_POINTS, min_matches=_LEAST_POINTS, rng=rng)
        # A pair that a gap of the gyro lies in is left out, whatever the offset.
        pairs = pairs.chosen(data.clear_of_gaps(pairs, 0.0, _WIDEST_OFFSET, _GYRO_GAP))
        if len(pairs) < _LEAST_PAIRS:
            return None
        rates = data.seen_rates(pairs)
        starts = find_starts(
            rates, data.times[pairs.first], data.times[pairs.second], data.gyro_times,
            data.gyro_rates, max_offset=_WIDEST_OFFSET, step=_OFFSET_STEP,
            focal_factors=np.ones(1), count=1, scale_known=False)
        if not starts:
            return None
        start = starts[0]
        R_cam_imu, offset, sigma = start.R_cam_imu, start.offset, _OFFSET_STEP
        if start.explained > _WORTH_REFINING and 0.5 < start.scale < 2.0:
            R_cam_imu, offset, sigma = _refined(data, start, readout, rng)
        singular = np.linalg.svd(rates, compute_uv=False)
        return Alignment(
            R_cam_imu=R_cam_imu, offset=offset, offset_sigma=sigma, explained=start.explained,
            scale=start.scale, rate=float(np.sqrt(np.mean(np.sum(rates**2, axis=1)))),
            balance=float(singular[1] / max(singular[0], 1e-12)), pairs=len(pairs))

    def _observations(self) -> Observations | None:
        intrinsics, reduction = self._intrinsics, self._reduction
        if self._follower is None or intrinsics is None or len(self._gyro) < 2:
            return None
        # Pixel centres lie at integers in both sizes.
        tracks = self._follower.tracks(
            lambda points: intrinsics.to_sensor((points + 0.5) / reduction - 0.5))
        if len(tracks) < 2:
            return None
        return Observations.of(tracks, GyroSeries.by_stamp(self._gyro),
                               intrinsics.global_shutter_camera())


def _refined(data: Observations, start: Start, readout: float | None,
             rng: np.random.Generator) -> tuple[Array, float, float]:
    """Rotation IMU to camera, offset of the middle row and its sigma [s], by the fit."""
    pairs = data.selected(_REFINED, start.offset, _GYRO_GAP, rng)
    if len(pairs) < _LEAST_PAIRS:
        return start.R_cam_imu, start.offset, _OFFSET_STEP
    free = np.zeros(GLOBAL, dtype=bool)
    free[OFFSET] = free[ROTATION:ROTATION + 3] = free[BIAS:BIAS + 3] = True
    free[READOUT] = readout is None
    problem = data.problem(pairs, start.offset)
    begin = initial(problem, start.R_cam_imu.T, start.offset, 0.0 if readout is None else readout)
    coarse = fit(problem, begin, free, rounds=20, tolerance=0.3)
    fitted = refit(problem, coarse.unknowns, free, rounds=20, tolerance=0.3)
    return (fitted.unknowns.R_imu_cam.T, float(fitted.unknowns.parameters[OFFSET]),
            math.hypot(_LEAST_SIGMA, math.sqrt(fitted.covariance[OFFSET, OFFSET])))
