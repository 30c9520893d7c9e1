"""Write a simulated recording as a bag, and the node's parameters for it."""

from __future__ import annotations

from collections.abc import Callable, Iterator
import heapq
from pathlib import Path
import shutil
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from rs_relpose_lab.simulation.config import SimulationConfig
from rs_relpose_lab.simulation.simulation import simulate, Simulation
from rs_relpose_lab.simulation.trajectory import Trajectory
from rs_relpose_ros.bags.layout import (
    CAMERA_FRAME,
    CAMERA_INFO_TOPIC,
    COMPRESSED_TOPIC,
    GROUND_TRUTH_TOPIC,
    IMAGE_DELAY,
    IMU_DELAY,
    IMU_FRAME,
    IMU_TOPIC,
    RAW_TOPIC,
    WORLD_FRAME,
)
from rs_relpose_ros.bags.writer import BagWriter
from rs_relpose_ros.config import parameter_file
from rs_relpose_ros.config.parameter_file import SourcedValue
from rs_relpose_ros.errors import InputError
from rs_relpose_ros.geometry.timing import to_nanoseconds

# Bag time [ns], topic, type, message.
Entry = tuple[int, str, str, Any]


def write_bag(simulation: Simulation, path: Path | str, *, jpeg_quality: int = 88,
              raw: bool = False, on_frame: Callable[[], object] = lambda: None) -> None:
    """Render `simulation` into a bag, in the order in which drivers would deliver.

    `path`: directory to create; `jpeg_quality`: 1 to 100; `raw`: sensor_msgs/Image instead.
    `on_frame`: called after each image.
    """
    if not 1 <= jpeg_quality <= 100:
        raise InputError(f'jpeg_quality must lie in [1, 100], got {jpeg_quality}')

    def encode(stamp_ns: int, pixels: NDArray[np.uint8]) -> tuple[str, str, Any]:
        if raw:
            return RAW_TOPIC, 'sensor_msgs/msg/Image', bag.image(stamp_ns, CAMERA_FRAME, pixels)
        return (COMPRESSED_TOPIC, 'sensor_msgs/msg/CompressedImage',
                bag.compressed_image(stamp_ns, CAMERA_FRAME, jpeg(pixels, jpeg_quality)))

    with BagWriter(path) as bag:
        write_in_order(bag, image_entries(simulation, bag, encode, on_frame),
                       imu_entries(simulation, bag, IMU_TOPIC), _truth_entries(simulation, bag))


def write_in_order(bag: BagWriter, *series: Iterator[Entry]) -> None:
    """Write several series of messages, each in the order of its bag times, as one."""
    for bag_time_ns, topic, msgtype, message in heapq.merge(*series, key=lambda entry: entry[0]):
        bag.write(topic, msgtype, message, bag_time_ns)


def render_once(config: SimulationConfig, folder: Path,
                trajectory: Trajectory | None = None) -> tuple[Path, Path]:
    """A bag and its parameter file in `folder`, rendered unless they are there."""
    def render(bag: Path, parameters: Path) -> None:
        simulation = simulate(config, trajectory=trajectory)
        write_bag(simulation, bag)
        write_parameters(simulation, parameters)
    return made_once(folder, 'bag', render)


def made_once(folder: Path, name: str,
              make: Callable[[Path, Path], object]) -> tuple[Path, Path]:
    """A bag and its parameter file; `make` writes the file last, unless both are there."""
    bag, parameters = folder / name, folder / f'{name}.yaml'
    if not (bag.exists() and parameters.exists()):
        # What a run that was stopped has left.
        shutil.rmtree(bag, ignore_errors=True)
        parameters.unlink(missing_ok=True)
        folder.mkdir(parents=True, exist_ok=True)
        make(bag, parameters)
    return bag, parameters


def write_parameters(simulation: Simulation, path: Path, *, raw: bool = False) -> None:
    """Write the parameters of the node that the recording needs; `raw` as in `write_bag`."""
    values = {'image_transport': 'raw' if raw else 'compressed', **right_parameters(simulation)}
    parameter_file.write_parameters(
        path, 'Parameters of relpose_node for the simulated bag of the same name.',
        [SourcedValue(name, value, '') for name, value in values.items()])


def right_parameters(simulation: Simulation) -> dict[str, Any]:
    """What a calibrated node is told of the recording's camera and IMU, by parameter name."""
    config = simulation.config
    return {
        'readout_time': config.readout_time,
        'readout_direction': config.readout_direction,
        'stamp_row': config.stamp_row,
        'stamp_exposure': 'middle',
        'time_offset': config.time_offset,
        'quat_cam_imu_xyzw': config.quat_cam_imu_xyzw,
        'imu_position': config.lever_arm,
        'gyro_bias': tuple(round(float(value), 6) for value in simulation.calibrated_gyro_bias),
    }


def jpeg(pixels: NDArray[np.uint8], quality: int) -> bytes:
    """An image as JPEG."""
    done, data = cv2.imencode('.jpg', pixels, [cv2.IMWRITE_JPEG_QUALITY, quality])
    if not done:
        raise RuntimeError('OpenCV could not encode an image as JPEG')
    return data.tobytes()


def image_entries(simulation: Simulation, bag: BagWriter,
                  encode: Callable[[int, NDArray[np.uint8]], tuple[str, str, Any]],
                  on_frame: Callable[[], object]) -> Iterator[Entry]:
    """Images and their CameraInfo; `encode`: topic, type and message of a stamp and pixels."""
    delay_ns = to_nanoseconds(simulation.config.readout_time + IMAGE_DELAY)
    for index in range(simulation.config.frame_count):
        stamp_ns = simulation.stamp_ns(index)
        topic, msgtype, message = encode(stamp_ns, simulation.image(index))
        info = bag.camera_info(stamp_ns, CAMERA_FRAME, simulation.camera)
        yield stamp_ns + delay_ns, CAMERA_INFO_TOPIC, 'sensor_msgs/msg/CameraInfo', info
        yield stamp_ns + delay_ns, topic, msgtype, message
        on_frame()


def imu_entries(simulation: Simulation, bag: BagWriter, topic: str) -> Iterator[Entry]:
    """IMU samples with their noise's variances."""
    config, imu = simulation.config, simulation.imu
    gyro_variance = config.gyro_noise_density**2 * config.imu_rate
    accel_variance = config.accel_noise_density**2 * config.imu_rate
    for stamp_ns, rate, force in zip(imu.stamps_ns.tolist(), imu.angular_velocities,
                                     imu.linear_accelerations, strict=True):
        yield (stamp_ns + to_nanoseconds(IMU_DELAY), topic, 'sensor_msgs/msg/Imu',
               bag.imu(stamp_ns, IMU_FRAME, rate, force, angular_velocity_variance=gyro_variance,
                       linear_acceleration_variance=accel_variance))


def _truth_entries(simulation: Simulation, bag: BagWriter) -> Iterator[Entry]:
    stamps_ns = simulation.imu.stamps_ns
    states = simulation.states(stamps_ns)
    quaternions = np.atleast_2d(Rotation.from_matrix(states.R_world_cam).as_quat())
    for stamp_ns, position, quat_xyzw in zip(stamps_ns.tolist(), states.position, quaternions,
                                             strict=True):
        yield (stamp_ns + to_nanoseconds(IMU_DELAY), GROUND_TRUTH_TOPIC,
               'geometry_msgs/msg/PoseStamped',
               bag.pose(stamp_ns, WORLD_FRAME, position, quat_xyzw))
