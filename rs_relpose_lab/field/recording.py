"""A simulated recording in memory, which a defect may change before it is written as a bag."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field, replace
import heapq
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from rs_relpose_lab.simulation import simulate, SimulationConfig
from rs_relpose_lab.simulation.bag import jpeg, render_once, right_parameters
from rs_relpose_lab.simulation.trajectory import CameraStates
from rs_relpose_ros.bags import sensor_topics
from rs_relpose_ros.bags.reader import open_bag
from rs_relpose_ros.bags.writer import BagWriter
from rs_relpose_ros.config import files as parameter_file
from rs_relpose_ros.config.files import SourcedValue
from rs_relpose_ros.geometry import Array
from rs_relpose_ros.geometry.camera import RollingShutterCamera
from rs_relpose_ros.geometry.timing import to_nanoseconds
from rs_relpose_ros.messages import outgoing

Gray = NDArray[np.uint8]
Stamps = NDArray[np.int64]

# Quality at which changed images are compressed again. [chosen: drivers use 80 to 95]
JPEG_QUALITY = 92
# Topic of an accelerometer that a defect separates from the gyro.
ACCEL_TOPIC = '/imu/accel'


def _split(stamp_ns: int) -> tuple[int, int]:
    return divmod(stamp_ns, 1_000_000_000)


@dataclass(frozen=True, slots=True)
class Shot:
    """One image message."""

    stamp_ns: int  # as in its header
    receive_ns: int
    true_ns: int  # true time of its stamped row on the IMU's true clock
    data: bytes  # JPEG

    @property
    def pixels(self) -> Gray:
        """Gray values (H, W)."""
        decoded = cv2.imdecode(np.frombuffer(self.data, np.uint8), cv2.IMREAD_GRAYSCALE)
        assert decoded is not None
        return decoded.astype(np.uint8, copy=False)

    def with_pixels(self, pixels: Gray) -> Shot:
        """The same message with other pixels (H, W)."""
        return replace(self, data=jpeg(np.ascontiguousarray(pixels), JPEG_QUALITY))


@dataclass(frozen=True, slots=True, eq=False)
class Samples:
    """Messages of an IMU or of one of its sensors."""

    stamps_ns: Stamps  # (N,) as in the headers
    receive_ns: Stamps  # (N,)
    gyro: Array | None  # (N, 3) [rad/s]
    accel: Array | None  # (N, 3) [m/s^2]
    frame_ids: tuple[str, ...]  # of sample k: frame_ids[k % len(frame_ids)]

    def kept(self, which: NDArray[Any]) -> Samples:
        """Some of the messages, by index or flag."""
        return replace(
            self,
            stamps_ns=self.stamps_ns[which],
            receive_ns=self.receive_ns[which],
            gyro=None if self.gyro is None else self.gyro[which],
            accel=None if self.accel is None else self.accel[which],
        )


@dataclass(frozen=True, slots=True, eq=False)
class FieldRecording:
    """Messages, configuration and truth of a recording."""

    shots: tuple[Shot, ...]
    imu: Samples
    accel: Samples | None  # on a topic of its own
    camera: RollingShutterCamera  # as CameraInfo states it
    parameters: dict[str, Any]  # as the parameter file states them
    # True values of what `rs_relpose calibrate` estimates, by the names of calibration.json.
    truth: dict[str, Any]
    # Rotation from the published image's optical frame to the simulated camera's.
    R_camera_image: Array
    states: Callable[[Stamps], CameraStates]  # of the simulated camera at true times
    truth_stamps_ns: Stamps
    # Changes the fields of a CameraInfo message before it is written.
    info_fields: dict[str, Any] = field(default_factory=dict)
    # sec and nanosec in headers of images, of a stamp [ns].
    stamp_fields: Callable[[int], tuple[int, int]] = _split

    @property
    def start_ns(self) -> int:
        """Stamp of the first image."""
        return self.shots[0].stamp_ns

    def seconds(self, stamps_ns: Stamps) -> Array:
        """Seconds since the first image, of stamps (N,)."""
        return np.asarray((stamps_ns - self.start_ns) * 1e-9, dtype=np.float64)

    def shift_images(self, by_ns: Callable[[Array], Array]) -> FieldRecording:
        """Header stamps of images with `by_ns` (seconds since the first one -> ns) added."""
        offsets = by_ns(self.seconds(np.array([shot.stamp_ns for shot in self.shots])))
        shots = tuple(
            replace(shot, stamp_ns=shot.stamp_ns + round(offset))
            for shot, offset in zip(self.shots, offsets, strict=True)
        )
        return replace(self, shots=shots)

    def map_images(self, change: Callable[[int, Gray], Gray]) -> FieldRecording:
        """The recording with pixels changed; `change` gets number and pixels of an image."""
        shots = tuple(
            shot.with_pixels(change(number, shot.pixels)) for number, shot in enumerate(self.shots)
        )
        return replace(self, shots=shots)

    def without_truth(self, *names: str) -> FieldRecording:
        """The recording without true values that a defect leaves undefined."""
        truth = {name: value for name, value in self.truth.items() if name not in names}
        return replace(self, truth=truth)

    def configured(self, **parameters: Any) -> FieldRecording:
        """The recording with other values in its parameter file."""
        return replace(self, parameters={**self.parameters, **parameters})


def base_recording(config: SimulationConfig, folder: Path) -> FieldRecording:
    """The recording of a configuration; its images are rendered into `folder` once."""
    bag_path, _ = render_once(config, folder)
    simulation = simulate(config)
    delay_ns = to_nanoseconds(config.readout_time + sensor_topics.IMAGE_DELAY)
    with open_bag(bag_path) as bag:
        topics = [topic for topic in bag.topics if topic.name == sensor_topics.COMPRESSED_TOPIC]
        images = [bytes(message.message.data) for message in bag.messages(topics)]
    shots = tuple(
        Shot(
            simulation.stamp_ns(number),
            simulation.stamp_ns(number) + delay_ns,
            simulation.reference_ns(number),
            data,
        )
        for number, data in enumerate(images)
    )
    imu = simulation.imu
    receive_ns = imu.stamps_ns + to_nanoseconds(sensor_topics.IMU_DELAY)
    return FieldRecording(
        shots=shots,
        imu=Samples(
            imu.stamps_ns,
            receive_ns,
            imu.angular_velocities,
            imu.linear_accelerations,
            (sensor_topics.IMU_FRAME,),
        ),
        accel=None,
        camera=simulation.camera,
        parameters={'image_transport': 'compressed', **right_parameters(simulation)},
        truth={
            'readout_time_s': config.readout_time,
            'time_offset_s': config.time_offset,
            'gyro_bias_rad_per_s': list(config.gyro_bias),
            'quat_cam_imu_xyzw': list(config.quat_cam_imu_xyzw),
            'focal_px': simulation.camera.fx,
            'principal_point_px': [simulation.camera.cx, simulation.camera.cy],
            'exposure_s': config.exposure_time,
        },
        R_camera_image=np.eye(3),
        states=simulation.states,
        truth_stamps_ns=imu.stamps_ns,
    )


def write_recording(recording: FieldRecording, bag_path: Path) -> Path:
    """Write the bag and, beside it, its parameter file, whose path is returned."""
    with BagWriter(bag_path) as bag:
        series = [
            _image_entries(recording, bag),
            _imu_entries(recording.imu, sensor_topics.IMU_TOPIC, bag),
            _truth_entries(recording, bag),
        ]
        if recording.accel is not None:
            series.append(_imu_entries(recording.accel, ACCEL_TOPIC, bag))
        for receive_ns, topic, msgtype, message in heapq.merge(*series, key=lambda one: one[0]):
            bag.write(topic, msgtype, message, receive_ns)
    parameters = bag_path.with_name(bag_path.name + '.yaml')
    values = [SourcedValue(name, value, '') for name, value in recording.parameters.items()]
    parameter_file.write_parameters(parameters, 'Parameters of a rebuilt situation.', values)
    return parameters


def _image_entries(recording: FieldRecording, bag: BagWriter) -> Any:
    for shot in sorted(recording.shots, key=lambda one: one.receive_ns):
        info = outgoing.camera_info_message(
            shot.stamp_ns, sensor_topics.CAMERA_FRAME, recording.camera, None, bag.type
        )
        for name, value in recording.info_fields.items():
            setattr(info, name, value)
        image = outgoing.encoded_image_message(
            shot.stamp_ns, sensor_topics.CAMERA_FRAME, shot.data, bag.type
        )
        for message in (info, image):
            stamp = message.header.stamp
            stamp.sec, stamp.nanosec = recording.stamp_fields(shot.stamp_ns)
        yield shot.receive_ns, sensor_topics.CAMERA_INFO_TOPIC, 'sensor_msgs/msg/CameraInfo', info
        yield (
            shot.receive_ns,
            sensor_topics.COMPRESSED_TOPIC,
            'sensor_msgs/msg/CompressedImage',
            image,
        )


def _imu_entries(samples: Samples, topic: str, bag: BagWriter) -> Any:
    order = np.argsort(samples.receive_ns, kind='stable')
    for k in order.tolist():
        message = outgoing.imu_message(
            int(samples.stamps_ns[k]),
            samples.frame_ids[k % len(samples.frame_ids)],
            None if samples.gyro is None else samples.gyro[k],
            None if samples.accel is None else samples.accel[k],
            bag.type,
        )
        yield int(samples.receive_ns[k]), topic, 'sensor_msgs/msg/Imu', message


def _truth_entries(recording: FieldRecording, bag: BagWriter) -> Any:
    stamps_ns = recording.truth_stamps_ns
    states = recording.states(stamps_ns)
    rotations = Rotation.from_matrix(states.R_world_cam @ recording.R_camera_image)
    for stamp_ns, position, quat_xyzw in zip(
        stamps_ns.tolist(), states.position, rotations.as_quat(), strict=True
    ):
        message = outgoing.pose_stamped_message(
            stamp_ns, sensor_topics.WORLD_FRAME, quat_xyzw, position, bag.type
        )
        receive_ns = stamp_ns + to_nanoseconds(sensor_topics.IMU_DELAY)
        yield (
            receive_ns,
            sensor_topics.GROUND_TRUTH_TOPIC,
            'geometry_msgs/msg/PoseStamped',
            message,
        )
