"""Write a simulated recording as a bag, and the node's parameters for it."""

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
from rs_relpose_ros.bags import sensor_topics
from rs_relpose_ros.bags.writer import BagWriter
from rs_relpose_ros.config import files as parameter_file
from rs_relpose_ros.config.files import SourcedValue
from rs_relpose_ros.errors import InputError
from rs_relpose_ros.geometry.camera import Intrinsics, RollingShutterCamera
from rs_relpose_ros.geometry.timing import to_nanoseconds
from rs_relpose_ros.messages import outgoing
from rs_relpose_ros.tracking.images import Pixels

# Bag time [ns], topic, type, message.
Entry = tuple[int, str, str, Any]


def write_bag(
    simulation: Simulation,
    path: Path | str,
    *,
    jpeg_quality: int = 88,
    raw: bool = False,
    on_frame: Callable[[], object] = lambda: None,
    camera_info: bool = True,
) -> None:
    """Render `simulation` into a bag, in the order in which drivers would deliver.

    `path`: directory to create; `jpeg_quality`: 1 to 100; `raw`: sensor_msgs/Image instead.
    `on_frame`: called after each image. `camera_info`: whether the bag has a CameraInfo.
    """
    if not 1 <= jpeg_quality <= 100:
        raise InputError(f'jpeg_quality must lie in [1, 100], got {jpeg_quality}')

    def encode(stamp_ns: int, pixels: NDArray[np.uint8]) -> tuple[str, str, Any]:
        if raw:
            return (
                sensor_topics.RAW_TOPIC,
                'sensor_msgs/msg/Image',
                outgoing.image_message(
                    stamp_ns, sensor_topics.CAMERA_FRAME, Pixels(pixels, 'mono8'), bag.type
                ),
            )
        return (
            sensor_topics.COMPRESSED_TOPIC,
            'sensor_msgs/msg/CompressedImage',
            outgoing.encoded_image_message(
                stamp_ns, sensor_topics.CAMERA_FRAME, jpeg(pixels, jpeg_quality), bag.type
            ),
        )

    with BagWriter(path) as bag:
        images = image_entries(simulation, bag, encode, on_frame)
        write_in_order(
            bag,
            (
                entry
                for entry in images
                if camera_info or entry[1] != sensor_topics.CAMERA_INFO_TOPIC
            ),
            imu_entries(simulation, bag, sensor_topics.IMU_TOPIC),
            _truth_entries(simulation, bag),
        )


def write_in_order(bag: BagWriter, *series: Iterator[Entry]) -> None:
    """Write several series of messages, each in the order of its bag times, as one."""
    for bag_time_ns, topic, msgtype, message in heapq.merge(*series, key=lambda entry: entry[0]):
        bag.write(topic, msgtype, message, bag_time_ns)


def render_once(
    config: SimulationConfig, folder: Path, trajectory: Trajectory | None = None
) -> tuple[Path, Path]:
    """A bag and its parameter file in `folder`, rendered unless they exist."""

    def render(bag: Path, parameters: Path) -> None:
        simulation = simulate(config, trajectory=trajectory)
        write_bag(simulation, bag)
        write_parameters(simulation, parameters)

    return made_once(folder, 'bag', render)


def made_once(folder: Path, name: str, make: Callable[[Path, Path], object]) -> tuple[Path, Path]:
    """A bag and its parameter file; `make` writes the file last, unless both exist."""
    bag = folder / name
    parameters = folder / f'{name}.yaml'
    if not (bag.exists() and parameters.exists()):
        # Remains of an interrupted run.
        shutil.rmtree(bag, ignore_errors=True)
        parameters.unlink(missing_ok=True)
        folder.mkdir(parents=True, exist_ok=True)
        make(bag, parameters)
    return bag, parameters


def write_parameters(simulation: Simulation, path: Path, *, raw: bool = False) -> None:
    """Write the parameter file of the node for the recording; `raw` as in `write_bag`."""
    values = {'image_transport': 'raw' if raw else 'compressed', **right_parameters(simulation)}
    parameter_file.write_parameters(
        path,
        'Parameters of relpose_node for the simulated bag of the same name.',
        [SourcedValue(name, value, '') for name, value in values.items()],
    )


def intrinsics_of(camera: RollingShutterCamera) -> Intrinsics:
    """Intrinsics of a camera as in the CameraInfo of its whole image."""
    return Intrinsics(
        width=camera.width,
        height=camera.height,
        fx=camera.fx,
        fy=camera.fy,
        cx=camera.cx,
        cy=camera.cy,
        distortion_model=camera.distortion_model,
        distortion=camera.distortion,
        image_width=camera.width,
        image_height=camera.height,
    )


def right_parameters(simulation: Simulation) -> dict[str, Any]:
    """Parameters of a calibrated node for the recording's camera and IMU, by name."""
    config = simulation.config
    return {
        'readout_time': config.readout_time,
        'readout_direction': config.readout_direction,
        'stamp_row': config.stamp_row,
        'stamp_exposure': 'middle',
        'exposure_time': config.exposure_time,
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


def image_entries(
    simulation: Simulation,
    bag: BagWriter,
    encode: Callable[[int, NDArray[np.uint8]], tuple[str, str, Any]],
    on_frame: Callable[[], object],
) -> Iterator[Entry]:
    """Images and their CameraInfo; `encode`: topic, type and message of a stamp and pixels."""
    delay_ns = to_nanoseconds(simulation.config.readout_time + sensor_topics.IMAGE_DELAY)
    for index in range(simulation.config.frame_count):
        stamp_ns = simulation.stamp_ns(index)
        topic, msgtype, message = encode(stamp_ns, simulation.image(index))
        info = outgoing.camera_info_message(
            stamp_ns, sensor_topics.CAMERA_FRAME, simulation.camera, None, bag.type
        )
        yield (
            stamp_ns + delay_ns,
            sensor_topics.CAMERA_INFO_TOPIC,
            'sensor_msgs/msg/CameraInfo',
            info,
        )
        yield stamp_ns + delay_ns, topic, msgtype, message
        on_frame()


def imu_entries(simulation: Simulation, bag: BagWriter, topic: str) -> Iterator[Entry]:
    """IMU samples with their noise's variances."""
    config = simulation.config
    imu = simulation.imu
    gyro_covariance, accel_covariance = (
        density**2 * config.imu_rate * np.eye(3)
        for density in (config.gyro_noise_density, config.accel_noise_density)
    )
    for stamp_ns, rate, force in zip(
        imu.stamps_ns.tolist(), imu.angular_velocities, imu.linear_accelerations, strict=True
    ):
        yield (
            stamp_ns + to_nanoseconds(sensor_topics.IMU_DELAY),
            topic,
            'sensor_msgs/msg/Imu',
            outgoing.imu_message(
                stamp_ns,
                sensor_topics.IMU_FRAME,
                rate,
                force,
                bag.type,
                covariances={
                    'angular_velocity': gyro_covariance,
                    'linear_acceleration': accel_covariance,
                },
            ),
        )


def _truth_entries(simulation: Simulation, bag: BagWriter) -> Iterator[Entry]:
    stamps_ns = simulation.imu.stamps_ns
    states = simulation.states(stamps_ns)
    quaternions = np.atleast_2d(Rotation.from_matrix(states.R_world_cam).as_quat())
    for stamp_ns, position, quat_xyzw in zip(
        stamps_ns.tolist(), states.position, quaternions, strict=True
    ):
        yield (
            stamp_ns + to_nanoseconds(sensor_topics.IMU_DELAY),
            sensor_topics.GROUND_TRUTH_TOPIC,
            'geometry_msgs/msg/PoseStamped',
            outgoing.pose_stamped_message(
                stamp_ns, sensor_topics.WORLD_FRAME, quat_xyzw, position, bag.type
            ),
        )
