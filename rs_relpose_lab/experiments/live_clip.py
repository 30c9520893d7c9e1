"""A short recording without a seam, for the live benchmark: rendered once, played for hours."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass
import heapq
from pathlib import Path
import shutil
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from rs_relpose_lab.simulation import simulate, Simulation, SimulationConfig
from rs_relpose_lab.simulation.bag import write_parameters
from rs_relpose_lab.simulation.closed_loop import closed_loop
from rs_relpose_ros.bags.layout import (
    CAMERA_FRAME,
    CAMERA_INFO_TOPIC,
    COMPRESSED_TOPIC,
    IMAGE_DELAY,
    IMU_DELAY,
    IMU_FRAME,
)
from rs_relpose_ros.bags.writer import BagWriter
from rs_relpose_ros.geometry.timing import NANOSECONDS, to_nanoseconds

# Duration of the motion before it repeats itself [s].
PERIOD = 4.0
FPS = 30.0
IMU_RATES = (200, 400)
# Field of view of 71 deg across, whatever the size.
_FOCAL_BY_WIDTH = 0.7
_JPEG_QUALITY = 95
# A lid of colour, so that a colour image is no gray one three times.
_TINT = np.array([0.75, 1.0, 1.15])


@dataclass(frozen=True, slots=True)
class Clip:
    """Files of a clip.

    Attributes
    ----------
    bag : Path
        JPEG in colour, CameraInfo, and the IMU at each of `IMU_RATES` on a topic of its own.
    parameters : Path
        Parameter file of the node.
    """

    bag: Path
    parameters: Path


def imu_topic(rate: int) -> str:
    """Topic of the clip's IMU of so many samples per second."""
    return f'/imu_{rate}/data_raw'


def configuration(width: int, height: int, imu_rate: int = IMU_RATES[0]) -> SimulationConfig:
    """What a clip shows: 4 s of a hand-held-like walk in a hall, read out in 30 ms."""
    return SimulationConfig(duration=PERIOD, fps=FPS, width=width, height=height,
                            fx=_FOCAL_BY_WIDTH * width, imu_rate=float(imu_rate))


def prepare_clip(folder: Path, width: int, height: int,
                 on_frame: Callable[[], object] = lambda: None) -> Clip:
    """Render a clip into a folder, unless it is there.

    Parameters
    ----------
    folder : Path
        Made where it is missing.
    width, height : int
        Size of the images [px].
    on_frame : callable
        Called after each of the images.
    """
    clip = Clip(folder / f'{width}x{height}', folder / f'{width}x{height}.yaml')
    if clip.parameters.exists() and clip.bag.exists():
        return clip
    # What a run that was stopped has left.
    shutil.rmtree(clip.bag, ignore_errors=True)
    clip.parameters.unlink(missing_ok=True)
    folder.mkdir(parents=True, exist_ok=True)
    trajectory = closed_loop(PERIOD)
    simulations = {rate: simulate(configuration(width, height, rate), trajectory=trajectory)
                   for rate in IMU_RATES[:1]}
    for rate in IMU_RATES[1:]:
        # The scene, which takes the time, is that of the first.
        simulations[rate] = simulate(configuration(width, height, rate), trajectory=trajectory,
                                     scene=simulations[IMU_RATES[0]].renderer.scene)
    with BagWriter(clip.bag) as bag:
        series = [_images(simulations[IMU_RATES[0]], bag, on_frame),
                  *(_imu(simulation, bag, imu_topic(rate))
                    for rate, simulation in simulations.items())]
        for bag_time_ns, topic, msgtype, message in heapq.merge(
                *series, key=lambda entry: entry[0]):
            bag.write(topic, msgtype, message, bag_time_ns)
    write_parameters(simulations[IMU_RATES[0]], clip.parameters)
    return clip


def coloured(gray: NDArray[np.uint8]) -> NDArray[np.uint8]:
    """A (H, W, 3) image, blue green red, of about the same brightness."""
    return np.clip(np.rint(gray[..., None] * _TINT), 0, 255).astype(np.uint8)


def _images(simulation: Simulation, bag: BagWriter,
            on_frame: Callable[[], object]) -> Iterator[tuple[int, str, str, Any]]:
    delay_ns = to_nanoseconds(simulation.config.readout_time + IMAGE_DELAY)
    for frame in simulation.frames():
        done, jpeg = cv2.imencode('.jpg', coloured(frame.image),
                                  [cv2.IMWRITE_JPEG_QUALITY, _JPEG_QUALITY])
        if not done:
            raise RuntimeError('OpenCV could not encode an image as JPEG')
        bag_time_ns = frame.stamp_ns + delay_ns
        yield (bag_time_ns, CAMERA_INFO_TOPIC, 'sensor_msgs/msg/CameraInfo',
               bag.camera_info(frame.stamp_ns, CAMERA_FRAME, simulation.camera))
        yield (bag_time_ns, COMPRESSED_TOPIC, 'sensor_msgs/msg/CompressedImage',
               bag.compressed_image(frame.stamp_ns, CAMERA_FRAME, jpeg.tobytes(),
                                    'bgr8; jpeg compressed bgr8'))
        on_frame()


def _imu(simulation: Simulation, bag: BagWriter,
         topic: str) -> Iterator[tuple[int, str, str, Any]]:
    """The samples of one period."""
    start_ns, delay_ns = simulation.config.start_ns, to_nanoseconds(IMU_DELAY)
    imu = simulation.imu
    for stamp_ns, rate, force in zip(imu.stamps_ns.tolist(), imu.angular_velocities,
                                     imu.linear_accelerations, strict=True):
        if start_ns <= stamp_ns < start_ns + to_nanoseconds(PERIOD):
            yield (stamp_ns + delay_ns, topic, 'sensor_msgs/msg/Imu',
                   bag.imu(stamp_ns, IMU_FRAME, rate, force))


def seconds_into_loop(stamp_ns: int) -> float:
    """Time on the closed trajectory of an instant of the endlessly played clip [s]."""
    start_ns = SimulationConfig().start_ns
    return (stamp_ns - start_ns) % to_nanoseconds(PERIOD) / NANOSECONDS
