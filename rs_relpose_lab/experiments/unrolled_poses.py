"""What OpenCV's 5-point makes of images as they were read, and of the same turned by the gyro."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
import shutil

import cv2
import numpy as np
from numpy.typing import NDArray

from rs_relpose_lab.experiments.comparison import best_opencv_score, Score
from rs_relpose_lab.experiments.consistency import (
    image_stamps,
    read_true_pairs,
    SHORT,
    STILL,
    TruePair,
)
from rs_relpose_lab.experiments.methods import OPENCV_ESTIMATORS, opencv_five_point, undistorted
from rs_relpose_lab.experiments.scoring import NO_POSE, pose_error, PoseError, Quantiles
from rs_relpose_lab.simulation import SimulationConfig
from rs_relpose_lab.simulation.bag import render_once
from rs_relpose_lab.simulation.scene import SCENES
from rs_relpose_ros.bags.reader import open_bag
from rs_relpose_ros.config.imu import ImuConfig
from rs_relpose_ros.config.parameter_file import read_parameters
from rs_relpose_ros.config.parameters import Parameters
from rs_relpose_ros.front_end.frame import sensor_camera
from rs_relpose_ros.front_end.front_end import FrameProcessed
from rs_relpose_ros.front_end.pair import PairResult
from rs_relpose_ros.geometry.intrinsics import Intrinsics
from rs_relpose_ros.geometry.timing import NANOSECONDS, to_nanoseconds
from rs_relpose_ros.global_shutter.frames import color_frames, GlobalShutterFrame
from rs_relpose_ros.global_shutter.unroll import unroll
from rs_relpose_ros.global_shutter.unroller import unrolling_loop
from rs_relpose_ros.imu.buffer import Coverage, ImuBuffer
from rs_relpose_ros.imu.samples import ImuSample
from rs_relpose_ros.messages.intake import Intake
from rs_relpose_ros.messages.sensor_feed import Role, SensorFeed
from rs_relpose_ros.replay.run import read_truth, Replay

Array = NDArray[np.float64]

_THRESHOLDS = (0.5, 1.0, 2.0)   # [px]


@dataclass(frozen=True, slots=True)
class FivePoint:
    """Median errors [deg] of OpenCV's 5-point, at the threshold and estimator that suit it best.

    Best in the median rotation error: a choice that no user could make, the same for both.
    """

    name: str
    readout_ms: float
    pairs: int
    raw_rotation: float
    raw_translation: float
    turned_pairs: int
    turned_rotation: float
    turned_translation: float
    simulated: bool = False

    @property
    def rotation_ratio(self) -> float:
        """Of the raw images to the turned ones."""
        return self.raw_rotation / self.turned_rotation

    @property
    def translation_ratio(self) -> float:
        """Of the raw images to the turned ones."""
        return self.raw_translation / self.turned_translation


def five_point_on_bag(config: SimulationConfig, folder: Path) -> FivePoint:
    """A walk, rendered and turned into `folder` unless it is there."""
    path, parameter_file = render_once(config, folder)
    parameters, turned = read_parameters(parameter_file), folder / 'turned'
    if not turned.exists():
        with open_bag(path) as bag:
            unroll(bag, bag.find_topics(), parameters, turned)
    raw = five_point(path, parameters)
    corrected = five_point(turned, as_global_shutter(parameters))
    return FivePoint(f'{config.scene} {config.seed}', 1e3 * config.readout_time,
                     raw.answered, raw.rotation[0], raw.translation[0],
                     corrected.answered, corrected.rotation[0], corrected.translation[0],
                     simulated=True)


def as_global_shutter(parameters: Parameters) -> Parameters:
    """Parameters for the turned images of a camera, stamped on the IMU's clock."""
    return parameters.updated({'readout_time': 0.0, 'time_offset': 0.0, 'stamp_row': 'first',
                               'time_offset_per_interval': 0.0, 'stamp_exposure': 'middle'})


def five_point(path: Path, parameters: Parameters) -> Score:
    """The better of OpenCV's estimators over the pairs of a bag that the pipeline answers."""
    with open_bag(path) as bag:
        topics = bag.find_topics()
        truth = read_truth(bag, topics)
        assert truth is not None
        replay = Replay(bag, topics, parameters)
        pairs = []
        for pair in replay.pairs():
            known = truth.relative_pose(pair.result.reference_ns1, pair.result.reference_ns2)
            if pair.result.pose and known and np.linalg.norm(known[1]) > STILL:
                pairs.append(pair)
        assert replay.intrinsics is not None
    return min((best_opencv_score(estimator, pairs, replay.intrinsics, truth)
                for estimator in OPENCV_ESTIMATORS), key=lambda found: found.rotation[0])


def five_point_when_turned(path: Path, parameters: Parameters, folder: Path) -> Score:
    """Score of OpenCV on the turned images of a bag, which is written into `folder` anew."""
    turned = folder / f'{path.name}_turned'
    shutil.rmtree(turned, ignore_errors=True)
    with open_bag(path) as bag:
        unroll(bag, bag.find_topics(), parameters, turned)
    return replace(five_point(turned, as_global_shutter(parameters)),
                   name='OpenCV 5-point, images turned')


def frames_of_bag(path: Path, parameters: Parameters) -> Iterator[GlobalShutterFrame]:
    """The turned frames of a bag."""
    loop = unrolling_loop(parameters, offline=True)
    intake = Intake(loop.sequencer, parameters.imu.stuck_gyro_time, parameters.intrinsics,
                    color_frames())
    with open_bag(path) as bag:
        for role, message in intake.feed.messages(bag, bag.find_topics()):
            intake.receive(role, message.message)
            while (outcome := loop.step()) is not None:
                if isinstance(outcome, FrameProcessed) and outcome.result is not None:
                    yield outcome.result


def draw_before_and_after(path: Path, parameters: Parameters, picture: Path) -> float:
    """Draw the frame of a bag that is moved most, as read and turned; its shift [px]."""
    frame = max(frames_of_bag(path, parameters), key=lambda found: found.map.shift)
    cv2.imwrite(str(picture), np.hstack([frame.frame.pixels.values, frame.image().values]))
    return frame.map.shift


def bag_configurations(bags: int, first_seed: int) -> list[SimulationConfig]:
    """Walks of 6 s; scenes take turns, read-outs are spread from 15 to 35 ms."""
    return [SimulationConfig(seed=seed, scene=SCENES[seed % len(SCENES)], duration=6.0,
                             plan='walk:6.0',
                             readout_time=round(0.015 + 0.02 * k / max(bags - 1, 1), 4))
            for k, seed in enumerate(range(first_seed, first_seed + bags))]


# -- real recordings -------------------------------------------------------------------------


# Errors of a pair by each of OpenCV's estimators and thresholds.
_Errors = tuple[PoseError, ...]


def five_point_on_recording(path: Path, parameter_file: Path, truth: Path,
                            folder: Path) -> list[FivePoint]:
    """Short and long true pairs of a recording, each from its own frames alone.

    The truth relates first rows. Between middle rows it is turned by the gyro; its direction of
    translation then holds for a camera that moves evenly. Raw images are given the truth that
    suits them better.
    """
    # On the camera's clock the stamps of all images move by the same.
    parameters = read_parameters(parameter_file).updated({'stamp_clock': 'camera'})
    turned = folder / f'{path.name}_turned'
    if not turned.exists():
        with open_bag(path) as bag:
            unroll(bag, bag.find_topics(), parameters, turned)
    gyro, intrinsics = _gyro_and_intrinsics(path)
    delay = 0.5 * (intrinsics.height - 1) * sensor_camera(intrinsics, parameters).line_delay
    delay_ns = to_nanoseconds(delay)
    raw_stamps, turned_stamps = image_stamps(path), set(image_stamps(turned))
    found: dict[str, list[tuple[_Errors, _Errors, _Errors]]] = {'short': [], 'long': []}
    for true in read_true_pairs(truth):
        frames = frozenset(s for s in raw_stamps if true.stamp1_ns <= s <= true.stamp2_ns)
        moved = frozenset(s + delay_ns for s in frames)
        if not moved <= turned_stamps:
            continue
        E1, E2 = (_turn(gyro, parameters, stamp, delay_ns) for stamp in true[:2])
        middle = true._replace(R=E1.T @ true.R @ E2, t=E1.T @ true.t)
        of_raw = _errors(path, parameters, intrinsics, frames, (true, middle))
        [of_turned] = _errors(turned, parameters.updated({'readout_time': 0.0}), intrinsics, moved,
                              (middle,))
        span = 'short' if (true.stamp2_ns - true.stamp1_ns) / NANOSECONDS < SHORT else 'long'
        found[span].append((of_raw[0], of_raw[1], of_turned))
    assert parameters.sensor.readout_time is not None
    return [_summary(f'{path.name}, {span}', 1e3 * parameters.sensor.readout_time, pairs)
            for span, pairs in found.items() if pairs]


def _gyro_and_intrinsics(path: Path) -> tuple[ImuBuffer, Intrinsics]:
    """All of the gyro of a bag of less than a minute, and its camera's intrinsics."""
    buffer = ImuBuffer(ImuConfig(imu_buffer_seconds=60.0))
    intrinsics: list[Intrinsics] = []

    def add(sample: ImuSample) -> None:
        buffer.add(sample)

    feed = SensorFeed({Role.IMU: add, Role.CAMERA_INFO: intrinsics.append})
    with open_bag(path) as bag:
        for role, message in feed.messages(bag, bag.find_topics()):
            feed.receive(role, message.message)
    return buffer, intrinsics[0]


def _turn(gyro: ImuBuffer, parameters: Parameters, stamp_ns: int, delay_ns: int) -> Array:
    """From the middle to the first row of a frame, as a rotation (3, 3) in camera axes."""
    first_ns = stamp_ns + to_nanoseconds(parameters.sensor.time_offset)
    assert gyro.coverage(first_ns, first_ns + delay_ns) is Coverage.AVAILABLE
    turn, _ = gyro.rotation(first_ns, first_ns + delay_ns)
    R_cam_imu = parameters.sensor.R_cam_imu
    return np.asarray(R_cam_imu @ turn @ R_cam_imu.T)


def _pair_of(path: Path, parameters: Parameters, stamps: frozenset[int]) -> PairResult | None:
    """The pair of the first and the last of some frames; None where tracks or gyro are lost."""
    keyframes = replace(parameters.keyframes, min_keyframe_parallax=1000.0,
                        max_keyframe_interval=60.0, min_tracked_fraction=0.0,
                        max_keyframe_frames=len(stamps) - 1)
    with open_bag(path) as bag:
        topics = bag.find_topics(needs_camera_info=not parameters.intrinsics.given)
        replay = Replay(bag, topics, replace(parameters, keyframes=keyframes), stamps=stamps)
        return next((pair.result for pair in replay.pairs()), None)


def _errors(path: Path, parameters: Parameters, intrinsics: Intrinsics, stamps: frozenset[int],
            truths: Sequence[TruePair]) -> list[_Errors]:
    """Errors of OpenCV's 5-point on the matches of a pair, against each truth."""
    result, camera = _pair_of(path, parameters, stamps), intrinsics.global_shutter_camera()
    poses = []
    for estimator in OPENCV_ESTIMATORS:
        for threshold in _THRESHOLDS:
            pixels = [] if result is None else [
                undistorted(intrinsics.to_sensor(points), camera)
                for points in (result.matches.points1, result.matches.points2)]
            poses.append(opencv_five_point(pixels[0], pixels[1], camera, threshold,
                                           estimator=estimator) if pixels else None)
    return [tuple(NO_POSE if pose is None else pose_error(pose.R, pose.t, true.R, true.t)
                  for pose in poses) for true in truths]


def _summary(name: str, readout_ms: float,
             pairs: Sequence[tuple[_Errors, _Errors, _Errors]]) -> FivePoint:
    def medians(way: int, setting: int) -> tuple[float, float]:
        errors = [pair[way][setting] for pair in pairs]
        return (Quantiles.of(e.rotation for e in errors).median,
                Quantiles.of(e.translation for e in errors).median)

    settings = range(len(pairs[0][0]))
    raw = min(medians(way, k) for way in (0, 1) for k in settings)
    turned = min(medians(2, k) for k in settings)
    return FivePoint(name, readout_ms, len(pairs), *raw, len(pairs), *turned)
