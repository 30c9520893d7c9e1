"""What becomes of sensor data on its way into the sequencer: the same for live node and replay."""

from __future__ import annotations

from collections import deque
from collections.abc import Callable
from functools import partial
from typing import Any

from rs_relpose_ros.config.intrinsics import IntrinsicsConfig
from rs_relpose_ros.errors import InputError, MissingInputError, RsRelposeError
from rs_relpose_ros.front_end.frame import Decodable, EncodedFrame
from rs_relpose_ros.front_end.sequencer import Refusal, Sequencer
from rs_relpose_ros.geometry.intrinsics import Intrinsics
from rs_relpose_ros.images.encoded import EncodedImage
from rs_relpose_ros.images.gray_levels import GrayLevels
from rs_relpose_ros.imu.samples import ImuSample
from rs_relpose_ros.messages.hanging import HangingCamera, HangingGyro
from rs_relpose_ros.messages.incoming import PublishedImage
from rs_relpose_ros.messages.sensor_feed import Role, SensorFeed

# Most images that wait for the first CameraInfo, which may come before or after its image.
_HELD_IMAGES = 4


class Intake:
    """Handlers of a `SensorFeed` that fill a sequencer; images stay encoded.

    An image goes with the CameraInfo that came last, or, where that is uncalibrated or none came
    with the first images, with the intrinsics that are `told` by parameters. `stuck_gyro_time` [s]
    is the parameter of that name; 0 believes every gyro. `frame` makes what the sequencer gets of
    stamp [ns], image, frame_id and intrinsics. Not thread-safe: one thread feeds it.
    """

    def __init__(self, sequencer: Sequencer[Any], stuck_gyro_time: float = 0.0,
                 told: IntrinsicsConfig | None = None,
                 frame: Callable[[int, EncodedImage, str, Intrinsics], Decodable[Any]] | None
                 = None) -> None:
        self.feed = SensorFeed({
            Role.IMU: self._add_imu, Role.ACCEL: sequencer.add_imu,
            Role.CAMERA_INFO: self._add_intrinsics, Role.IMAGE: self._add_image})
        self._sequencer = sequencer
        self._frame = partial(EncodedFrame, levels=GrayLevels()) if frame is None else frame
        # Those in force.
        self.intrinsics: Intrinsics | None = None
        self._camera_info: Any = None
        self._told = told if told is not None and told.given else None
        # Whether images go with what is told.
        self._use_told = False
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
                if self._told is not None and isinstance(error, MissingInputError):
                    self._fall_back()
                    return
                self.intrinsics, self.camera_info_problem = None, str(error)
                self._use_told = False
                self.release_held()
            raise
        if role is Role.CAMERA_INFO:
            self._camera_info = message

    def camera_info_of(self, intrinsics: Intrinsics) -> Any:
        """The CameraInfo in force; None where it does not tell these intrinsics."""
        return None if self._use_told or intrinsics != self.intrinsics else self._camera_info

    def release_held(self) -> None:
        """Let no image wait for a CameraInfo any longer."""
        if self._held and self._told is not None and not self.camera_info_problem:
            self._fall_back()
        while self._held:
            self._refuse_without_intrinsics(self._held.popleft())

    def _fall_back(self) -> None:
        """Use the intrinsics that are told, from the images on that wait."""
        if not self._use_told:
            # Of the next image's size.
            self.intrinsics = None
        self._use_told, self.camera_info_problem = True, ''
        while self._held:
            self._add_image(self._held.popleft())

    # -- handlers ----------------------------------------------------------------------------

    def _add_imu(self, sample: ImuSample) -> None:
        if not self._gyro.repeats(sample):
            self._sequencer.add_imu(sample)

    def _add_intrinsics(self, intrinsics: Intrinsics) -> None:
        self.intrinsics, self.camera_info_problem = intrinsics, ''
        self._use_told = False
        while self._held:
            self._add_frame(self._held.popleft(), intrinsics)

    def _add_image(self, image: PublishedImage) -> None:
        if self._use_told and self._told is not None:
            try:
                self.intrinsics = _of_size(image.image.size, self.intrinsics, self._told)
            except InputError as error:
                self._sequencer.refuse(image.stamp_ns, Refusal.BAD_IMAGE, str(error))
                return
        if self.intrinsics is not None:
            self._add_frame(image, self.intrinsics)
        elif self.camera_info_problem:
            self._refuse_without_intrinsics(image)
        else:
            self._held.append(image)
            if len(self._held) > _HELD_IMAGES:
                if self._told is not None:
                    self._fall_back()
                else:
                    self._refuse_without_intrinsics(self._held.popleft())

    def _add_frame(self, image: PublishedImage, intrinsics: Intrinsics) -> None:
        # Compared before any image is dropped: after a gap a repeated image would pass for new.
        problem = self._camera.problem(image.stamp_ns, image.image.data)
        if problem:
            self._sequencer.refuse(image.stamp_ns, Refusal.BAD_IMAGE, problem)
            return
        self._sequencer.add_frame(
            self._frame(image.stamp_ns, image.image, image.frame_id, intrinsics))

    def _refuse_without_intrinsics(self, image: PublishedImage) -> None:
        self._sequencer.refuse(
            image.stamp_ns, Refusal.NO_CALIBRATION,
            self.camera_info_problem or 'no CameraInfo came before or with the image')


def _of_size(size: tuple[int, int], last: Intrinsics | None, told: IntrinsicsConfig) -> Intrinsics:
    """What is told for images of a size: the `last` ones, where they are."""
    if last is not None and size == (last.image_width, last.image_height):
        return last
    return told.of_image(*size)
