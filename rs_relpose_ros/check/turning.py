"""How the images turn: rotation between consecutive frames by their flow, against the gyro.

Only a part of the frames is looked at: blocks of consecutive ones, evenly over the recording. The
rotation of a pair is fitted to its flow as if there were no translation, robustly: good enough to
find signs, scale and clock, which `coplanarity` then refines.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray
from scipy.optimize import minimize_scalar
from scipy.spatial.transform import Rotation

from rs_relpose_ros.camera import RollingShutterCamera
from rs_relpose_ros.check.coplanarity import Flow, refine, Refined
from rs_relpose_ros.pipeline.calibration import Calibration
from rs_relpose_ros.so3 import aligning_rotation

Array = NDArray[np.float64]

_BLOCKS, _BLOCK_FRAMES = 10, 25
# Longest side of the images that are tracked [px].
_WORKING_SIDE = 640
_POINTS = 150
_LEAST_POINTS = 15
# Distance of points from each other, in image sides.
_APART = 0.015
# Clock offsets that are tried [s].
_WIDEST_OFFSET = 0.25
_OFFSET_STEP = 0.01
_LEAST_PAIRS = 20
_WORTH_REFINING = 0.5
_ROUNDS = 6


@dataclass(frozen=True, slots=True, eq=False)
class Turn:
    """One pair of frames: its rays (N, 3), their places between first row (0) and last (1).

    `vector`: ``R_1^T R_2`` as a vector (3,), camera frame.
    """

    start_ns: int
    end_ns: int
    vector: Array
    rays1: Array
    rays2: Array
    places1: Array
    places2: Array


@dataclass(frozen=True, slots=True, eq=False)
class Alignment:
    """Gyro and images laid upon each other.

    Attributes
    ----------
    R_cam_imu : (3, 3) ndarray
        Best rotation IMU to camera.
    offset, offset_sigma : float
        Best time from a frame's stamp to the gyro's [s]; it belongs to the middle row.
    explained : float
        Share of the images' turning that the gyro explains then, 0 to 1.
    scale : float
        Turning by the images over that by the gyro.
    bias : (3,) ndarray
        Mean difference [rad/s], IMU frame.
    rate : float
        Root mean square rate of the images [rad/s].
    balance : float
        Second over first principal rate: near 0 where the camera turned about one axis only.
    pairs : int
    """

    R_cam_imu: Array
    offset: float
    offset_sigma: float
    explained: float
    scale: float
    bias: Array
    rate: float
    balance: float
    pairs: int


class TurningImages:
    """Takes in the images and the gyro, in the order of recording.

    Parameters
    ----------
    images : int
        How many there are.
    """

    def __init__(self, images: int) -> None:
        stride = max(images // _BLOCKS, 1)
        self._wanted = {first + k for first in range(0, images, stride)
                        for k in range(min(_BLOCK_FRAMES, stride + 1))}
        self._index = -1
        self._before: tuple[int, NDArray[np.uint8], int] | None = None
        self._recent: list[tuple[int, Array]] = []
        self._gyro: dict[int, Array] = {}
        self._keep_until_ns = 0
        self.turns: list[Turn] = []
        self.points: list[int] = []

    def wants_next(self) -> bool:
        """Count an image; whether it is to be decoded and handed over."""
        self._index += 1
        return self._index in self._wanted

    def add_image(self, stamp_ns: int, recorded_ns: int, image: NDArray[np.uint8],
                  calibration: Calibration) -> None:
        """Take in an image that was wanted."""
        self._keep_until_ns = recorded_ns + int(2e9 * _WIDEST_OFFSET)
        scale = min(_WORKING_SIDE / max(image.shape), 1.0)
        small = image if scale == 1.0 else np.asarray(
            cv2.resize(image, None, fx=scale, fy=scale, interpolation=cv2.INTER_AREA),
            dtype=np.uint8)
        before, self._before = self._before, (stamp_ns, small, self._index)
        if before is None or self._index != before[2] + 1 or stamp_ns <= before[0] \
                or small.shape != before[1].shape:
            return
        points1, points2 = _flow(before[1], small)
        self.points.append(len(points1))
        if len(points1) >= _LEAST_POINTS:
            # Pixel centres lie at integers in both sizes.
            rays1, rays2 = (_rays((points + 0.5) / scale - 0.5, calibration)
                            for points in (points1, points2))
            good = np.isfinite(rays1).all(axis=1) & np.isfinite(rays2).all(axis=1)
            places1, places2 = (points[good, 1] / small.shape[0] for points in (points1, points2))
            self.turns.append(Turn(before[0], stamp_ns, _rotation(rays1[good], rays2[good]),
                                   rays1[good], rays2[good], places1, places2))

    def add_rate(self, stamp_ns: int, recorded_ns: int, rate: Array) -> None:
        """Take in a gyro sample."""
        self._recent.append((stamp_ns, rate))
        if recorded_ns <= self._keep_until_ns:
            self._gyro.update(self._recent)
            self._recent = []
        elif len(self._recent) > 4096:
            # About what an image that comes now may look back to.
            self._recent = self._recent[-2048:]

    def align(self, readout: float) -> Alignment | None:
        """Lay both upon each other; None where there is too little of either.

        `readout`: time from the first row to the last [s], negative when read upwards.
        """
        stamps = np.array(sorted(self._gyro), dtype=np.int64)
        if len(stamps) < 2 or len(self.turns) < _LEAST_PAIRS:
            return None
        rates = np.array([self._gyro[int(stamp)] for stamp in stamps])
        zero_ns = int(stamps[0])
        seconds = (stamps - zero_ns) * 1e-9
        steps = np.diff(seconds)
        integral = np.vstack([np.zeros(3), np.cumsum(
            0.5 * (rates[1:] + rates[:-1]) * steps[:, None], axis=0)])
        # A turn that a gap of the gyro lies in is left out, whatever the offset.
        starts = np.array([(turn.start_ns - zero_ns) * 1e-9 for turn in self.turns])
        ends = np.array([(turn.end_ns - zero_ns) * 1e-9 for turn in self.turns])
        clear = np.ones(len(starts), dtype=bool)
        for k in np.flatnonzero(steps > 0.1):
            clear &= (ends < seconds[k] - _WIDEST_OFFSET) | (
                starts > seconds[k + 1] + _WIDEST_OFFSET)
        starts, ends = starts[clear], ends[clear]
        turns = [turn for turn, use in zip(self.turns, clear, strict=True) if use]
        images = np.array([turn.vector for turn in turns]).reshape(-1, 3)

        def by_gyro(offset: float) -> tuple[Array, NDArray[np.bool_]]:
            inside = (starts + offset >= seconds[0]) & (ends + offset <= seconds[-1])
            at = [np.column_stack([np.interp(times + offset, seconds, integral[:, axis])
                                   for axis in range(3)]) for times in (starts, ends)]
            return at[1] - at[0], inside

        def left(offset: float) -> float:
            gyro, inside = by_gyro(offset)
            if inside.sum() < _LEAST_PAIRS:
                return 1.0
            return _fit(images[inside], gyro[inside]).left

        if clear.sum() < _LEAST_PAIRS:
            return None
        coarse = np.arange(-_WIDEST_OFFSET, _WIDEST_OFFSET + 1e-9, _OFFSET_STEP)
        best = float(coarse[int(np.argmin([left(offset) for offset in coarse]))])
        offset = float(minimize_scalar(
            left, bounds=(best - _OFFSET_STEP, best + _OFFSET_STEP), method='bounded',
            options={'xatol': 1e-4}).x)
        gyro, inside = by_gyro(offset)
        if inside.sum() < _LEAST_PAIRS:
            return None
        flows = [Flow(start, end, turn.rays1, turn.rays2, readout * (turn.places1 - 0.5),
                      readout * (turn.places2 - 0.5))
                 for start, end, turn, use in zip(starts, ends, turns, inside, strict=True) if use]
        images, gyro, spans = images[inside], gyro[inside], (ends - starts)[inside]
        fit = _fit(images, gyro)
        explained = max(1.0 - fit.left, 0.0)
        bias = (fit.gyro_mean - fit.R.T @ fit.image_mean) / float(np.median(spans))
        refined = Refined(fit.R, offset, float('nan'), bias)
        if explained > _WORTH_REFINING and 0.5 < fit.scale < 2.0:
            refined = refine(flows, np.asarray(seconds, dtype=np.float64), rates, fit.R, offset,
                             np.zeros(3))
        singular = np.linalg.svd(images / spans[:, None], compute_uv=False)
        return Alignment(
            R_cam_imu=refined.R_cam_imu, offset=refined.offset,
            offset_sigma=refined.offset_sigma, explained=explained, scale=fit.scale,
            bias=refined.bias,
            rate=float(np.sqrt(np.mean(np.sum((images / spans[:, None])**2, axis=1)))),
            balance=float(singular[1] / max(singular[0], 1e-12)), pairs=len(images))


@dataclass(frozen=True, slots=True, eq=False)
class _Fit:
    """``image = R gyro`` about their means, and the share of the images' turning `left`."""

    R: Array
    scale: float
    left: float
    image_mean: Array
    gyro_mean: Array


def _fit(images: Array, gyro: Array) -> _Fit:
    """Rotation between turns (N, 3), robust against pairs whose flow went wrong."""
    weights = np.ones(len(images))
    for _ in range(_ROUNDS):
        image_mean = np.average(images, axis=0, weights=weights)
        gyro_mean = np.average(gyro, axis=0, weights=weights)
        a, b = images - image_mean, gyro - gyro_mean
        R = aligning_rotation((weights[:, None] * a).T @ b)
        errors = np.linalg.norm(a - b @ R.T, axis=1)
        weights = 1.0 / (1.0 + (errors / max(1.5 * float(np.median(errors)), 1e-9))**2)
    power = float(weights @ (a**2).sum(axis=1))
    turned = b @ R.T
    scale = float(weights @ (a * turned).sum(axis=1)) / max(
        float(weights @ (turned**2).sum(axis=1)), 1e-18)
    # Not of the scaled ones: a gyro in degrees explains nothing.
    shared = scale * turned
    return _Fit(R, scale, float(weights @ ((a - shared)**2).sum(axis=1)) / max(power, 1e-18),
                image_mean, gyro_mean)


def _flow(image1: NDArray[np.uint8], image2: NDArray[np.uint8]) -> tuple[Array, Array]:
    """Points (N, 2) of two images that are tracked there and back."""
    # None where there is no corner, which OpenCV's types do not say.
    corners: Any = cv2.goodFeaturesToTrack(
        image1, _POINTS, 0.01, _APART * max(image1.shape))
    if corners is None:
        return np.empty((0, 2)), np.empty((0, 2))
    there, found, _ = cv2.calcOpticalFlowPyrLK(
        image1, image2, corners, np.empty_like(corners), maxLevel=4)
    back, found_back, _ = cv2.calcOpticalFlowPyrLK(
        image2, image1, there, np.empty_like(corners), maxLevel=4)
    good = (found.ravel() == 1) & (found_back.ravel() == 1)
    good &= np.linalg.norm((corners - back).reshape(-1, 2), axis=1) < 0.5
    return (corners.reshape(-1, 2)[good].astype(np.float64),
            there.reshape(-1, 2)[good].astype(np.float64))


def _rays(points: Array, calibration: Calibration) -> Array:
    camera = RollingShutterCamera(
        width=calibration.width, height=calibration.height, fx=calibration.fx, fy=calibration.fy,
        cx=calibration.cx, cy=calibration.cy, distortion_model=calibration.distortion_model,
        distortion=calibration.distortion, readout_time=0.0)
    return camera.unproject(calibration.to_sensor(points))


def _rotation(rays1: Array, rays2: Array) -> Array:
    """Rotation vector (3,) of ``rays1 = R rays2``, robust."""
    weights = np.ones(len(rays1))
    R = np.eye(3)
    for _ in range(_ROUNDS):
        R = aligning_rotation((weights[:, None] * rays1).T @ rays2)
        errors = np.linalg.norm(rays1 - rays2 @ R.T, axis=1)
        weights = 1.0 / (1.0 + (errors / max(1.5 * float(np.median(errors)), 1e-6))**2)
    return np.asarray(Rotation.from_matrix(R).as_rotvec())
