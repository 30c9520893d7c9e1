"""What becomes of sensor data on its way into the sequencer: the same for live node and replay."""

from __future__ import annotations

from collections import deque
from typing import Any

from rs_relpose_ros.errors import RsRelposeError
from rs_relpose_ros.front_end.frame import EncodedFrame
from rs_relpose_ros.front_end.sequencer import Refusal, Sequencer
from rs_relpose_ros.geometry.intrinsics import Intrinsics
from rs_relpose_ros.imu.samples import ImuSample
from rs_relpose_ros.messages.hanging import HangingCamera, HangingGyro
from rs_relpose_ros.messages.incoming import PublishedImage
from rs_relpose_ros.messages.sensor_feed import Role, SensorFeed

# Most images that wait for the first CameraInfo, which may come before or after its image.
_HELD_IMAGES = 4


class Intake:
    """Handlers of a `SensorFeed` that fill a sequencer; images stay encoded.

    An image goes with the CameraInfo that came last. `stuck_gyro_time` [s] is the parameter of
    that name; 0 believes every gyro. Not thread-safe: one thread feeds it.
    """

    def __init__(self, sequencer: Sequencer, stuck_gyro_time: float = 0.0) -> None:
        self.feed = SensorFeed({
            Role.IMU: self._add_imu, Role.ACCEL: sequencer.add_imu,
            Role.CAMERA_INFO: self._add_intrinsics, Role.IMAGE: self._add_image})
        self._sequencer = sequencer
        # Those in force.
        self.intrinsics: Intrinsics | None = None
        # Why the last CameraInfo cannot be used; empty when it can, or when none came.
        self.camera_info_problem = ''
        self._held: deque[PublishedImage] = deque()
        self._camera = HangingCamera()
        self._gyro = HangingGyro(stuck_gyro_time)

    def receive(self, role: Role, message: Any) -> None:
        """Take a message; one that cannot be used raises, an image is refused by the sequencer.

        After an unusable CameraInfo no intrinsics are in force, rather than outdated ones.
        """
        try:
            self.feed.receive(role, message)
        except RsRelposeError as error:
            if role is Role.IMAGE:
                self._sequencer.refuse(0, Refusal.BAD_IMAGE, str(error))
                return
            if role is Role.CAMERA_INFO:
                self.intrinsics, self.camera_info_problem = None, str(error)
                self.refuse_held()
            raise

    def refuse_held(self) -> None:
        """Give up on the images that wait for a CameraInfo."""
        while self._held:
            self._refuse_without_intrinsics(self._held.popleft())

    # -- handlers ----------------------------------------------------------------------------

    def _add_imu(self, sample: ImuSample) -> None:
        if not self._gyro.repeats(sample):
            self._sequencer.add_imu(sample)

    def _add_intrinsics(self, intrinsics: Intrinsics) -> None:
        self.intrinsics, self.camera_info_problem = intrinsics, ''
        while self._held:
            self._add_frame(self._held.popleft(), intrinsics)

    def _add_image(self, image: PublishedImage) -> None:
        if self.intrinsics is not None:
            self._add_frame(image, self.intrinsics)
        elif self.camera_info_problem:
            self._refuse_without_intrinsics(image)
        else:
            self._held.append(image)
            if len(self._held) > _HELD_IMAGES:
                self._refuse_without_intrinsics(self._held.popleft())

    def _add_frame(self, image: PublishedImage, intrinsics: Intrinsics) -> None:
        # Compared before any image is dropped: after a gap a repeated image would pass for new.
        problem = self._camera.problem(image.stamp_ns, image.image.data)
        if problem:
            self._sequencer.refuse(image.stamp_ns, Refusal.BAD_IMAGE, problem)
            return
        self._sequencer.add_frame(
            EncodedFrame(image.stamp_ns, image.image, image.frame_id, intrinsics))

    def _refuse_without_intrinsics(self, image: PublishedImage) -> None:
        self._sequencer.refuse(
            image.stamp_ns, Refusal.NO_CALIBRATION,
            self.camera_info_problem or 'no CameraInfo came before or with the image')
