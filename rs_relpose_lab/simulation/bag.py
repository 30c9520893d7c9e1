"""Write a simulated recording as a bag, and the node's parameters for it."""

from __future__ import annotations

from collections.abc import Callable, Iterator
import heapq
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from scipy.spatial.transform import Rotation
import yaml

from rs_relpose_lab.simulation.simulation import Simulation
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
from rs_relpose_ros.errors import InputError
from rs_relpose_ros.geometry.timing import to_nanoseconds

# Bag time [ns], topic, type and a function that makes the message.
_Entry = tuple[int, str, str, Callable[[], Any]]


def write_bag(simulation: Simulation, path: Path | str, *, jpeg_quality: int = 88,
              raw: bool = False, on_frame: Callable[[], object] = lambda: None) -> None:
    """Render `simulation` into a bag, in the order in which drivers would deliver.

    Parameters
    ----------
    simulation : Simulation
    path : path-like
        Directory to create.
    jpeg_quality : int
        1 to 100.
    raw : bool
        sensor_msgs/Image instead of JPEG.
    on_frame : callable
        Called after each image.

    Raises
    ------
    InputError
        The path exists already or cannot be created.
    """
    if not 1 <= jpeg_quality <= 100:
        raise InputError(f'jpeg_quality must lie in [1, 100], got {jpeg_quality}')
    with BagWriter(path) as bag:
        entries = heapq.merge(
            _images(simulation, bag, jpeg_quality, raw, on_frame), _imu(simulation, bag),
            _ground_truth(simulation, bag), key=lambda entry: entry[0])
        for bag_time_ns, topic, msgtype, make in entries:
            bag.write(topic, msgtype, make(), bag_time_ns)


def node_parameters(simulation: Simulation, *, raw: bool = False) -> dict[str, Any]:
    """Parameters of the node that the recording needs, by name."""
    config = simulation.config
    return {
        'image_transport': 'raw' if raw else 'compressed',
        'readout_time': config.readout_time,
        'readout_direction': config.readout_direction,
        'stamp_row': config.stamp_row,
        'stamp_exposure': 'middle',
        'time_offset': config.time_offset,
        'quat_cam_imu_xyzw': list(config.quat_cam_imu_xyzw),
        'gyro_bias': [round(float(value), 6) for value in simulation.calibrated_gyro_bias],
    }


def write_parameters(simulation: Simulation, path: Path | str, *, raw: bool = False) -> None:
    """Write `node_parameters` as a ROS parameter file."""
    path = Path(path)
    if path.exists():
        raise InputError(f'{path} exists already: remove it or choose another path')
    document = {'/**': {'ros__parameters': node_parameters(simulation, raw=raw)}}
    try:
        path.write_text(
            '# Parameters of relpose_node for the simulated bag of the same name.\n'
            + yaml.safe_dump(document, sort_keys=False, default_flow_style=None))
    except OSError as error:
        raise InputError(f'cannot write {path}: {error.strerror}') from error


def _images(simulation: Simulation, bag: BagWriter, jpeg_quality: int, raw: bool,
            on_frame: Callable[[], object]) -> Iterator[_Entry]:
    delay_ns = to_nanoseconds(simulation.config.readout_time + IMAGE_DELAY)
    for index in range(simulation.config.frame_count):
        stamp_ns = simulation.stamp_ns(index)

        def info(stamp_ns: int = stamp_ns) -> Any:
            return bag.camera_info(stamp_ns, CAMERA_FRAME, simulation.camera)

        def image(index: int = index, stamp_ns: int = stamp_ns) -> Any:
            pixels = simulation.frame(index).image
            on_frame()
            if raw:
                return bag.image(stamp_ns, CAMERA_FRAME, pixels)
            done, jpeg = cv2.imencode('.jpg', pixels, [cv2.IMWRITE_JPEG_QUALITY, jpeg_quality])
            if not done:
                raise RuntimeError('OpenCV could not encode an image as JPEG')
            return bag.compressed_image(stamp_ns, CAMERA_FRAME, jpeg.tobytes())

        yield stamp_ns + delay_ns, CAMERA_INFO_TOPIC, 'sensor_msgs/msg/CameraInfo', info
        if raw:
            yield stamp_ns + delay_ns, RAW_TOPIC, 'sensor_msgs/msg/Image', image
        else:
            yield (stamp_ns + delay_ns, COMPRESSED_TOPIC, 'sensor_msgs/msg/CompressedImage', image)


def _imu(simulation: Simulation, bag: BagWriter) -> Iterator[_Entry]:
    config, imu = simulation.config, simulation.imu
    delay_ns = to_nanoseconds(IMU_DELAY)
    gyro_variance = config.gyro_noise_density**2 * config.imu_rate
    accel_variance = config.accel_noise_density**2 * config.imu_rate
    for stamp_ns, rate, force in zip(imu.stamps_ns.tolist(), imu.angular_velocities,
                                     imu.linear_accelerations, strict=True):
        def message(stamp_ns: int = stamp_ns, rate: Any = rate, force: Any = force) -> Any:
            return bag.imu(stamp_ns, IMU_FRAME, rate, force,
                           angular_velocity_variance=gyro_variance,
                           linear_acceleration_variance=accel_variance)

        yield stamp_ns + delay_ns, IMU_TOPIC, 'sensor_msgs/msg/Imu', message


def _ground_truth(simulation: Simulation, bag: BagWriter) -> Iterator[_Entry]:
    stamps_ns = simulation.imu.stamps_ns
    states = simulation.states(stamps_ns)
    quaternions = np.atleast_2d(Rotation.from_matrix(states.R_world_cam).as_quat())
    delay_ns = to_nanoseconds(IMU_DELAY)
    for stamp_ns, position, quat_xyzw in zip(stamps_ns.tolist(), states.position, quaternions,
                                             strict=True):
        def message(stamp_ns: int = stamp_ns, position: Any = position,
                    quat_xyzw: Any = quat_xyzw) -> Any:
            return bag.pose(stamp_ns, WORLD_FRAME, position, quat_xyzw)

        yield stamp_ns + delay_ns, GROUND_TRUTH_TOPIC, 'geometry_msgs/msg/PoseStamped', message
