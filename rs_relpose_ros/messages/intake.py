"""Messages in, frames and IMU samples into the sequencer: the same for live node and replay."""

from __future__ import annotations

from collections import deque
from collections.abc import Callable
from typing import Any

import numpy as np
from numpy.typing import NDArray

from rs_relpose_ros.errors import InputError, RsRelposeError
from rs_relpose_ros.front_end.frame import EncodedFrame
from rs_relpose_ros.front_end.sequencer import Refusal, Sequencer
from rs_relpose_ros.geometry.intrinsics import Intrinsics
from rs_relpose_ros.messages.hanging import HangingCamera, HangingGyro
from rs_relpose_ros.messages.incoming import (
    accelerometer_sample_from_message,
    image_from_compressed,
    image_from_message,
    imu_sample_from_message,
    intrinsics_from_info,
    stamp_ns,
)

Decode = Callable[[Any], NDArray[np.uint8]]

# Images that wait for the first CameraInfo: it comes with the first image, before or after it.
_HELD_IMAGES = 4


class MessageIntake:
    """Converts messages and hands them over; images are decoded later, by who takes the frames.

    An image goes with the CameraInfo that came last. Not thread-safe: one thread feeds it.

    Parameters
    ----------
    sequencer : Sequencer
    stuck_gyro_time : float
        As the parameter of that name [s]; 0 believes every gyro.
    """

    def __init__(self, sequencer: Sequencer, stuck_gyro_time: float = 0.0) -> None:
        self._sequencer = sequencer
        self._calibration: Intrinsics | None = None
        self._problem = ''
        self._held: deque[tuple[Any, Decode]] = deque()
        self._camera = HangingCamera()
        self._gyro = HangingGyro(stuck_gyro_time)

    @property
    def calibration(self) -> Intrinsics | None:
        """The calibration in force."""
        return self._calibration

    @property
    def calibration_problem(self) -> str:
        """Why the last CameraInfo cannot be used; empty when it can, or when none came."""
        return self._problem

    def add_camera_info(self, msg: Any) -> None:
        """Take a sensor_msgs/CameraInfo into force.

        Raises
        ------
        InputError, MissingInputError
            It cannot be used. Then no calibration is in force, rather than an outdated one.
        """
        try:
            self._calibration = intrinsics_from_info(msg)
        except RsRelposeError as error:
            self._calibration, self._problem = None, str(error)
            self.refuse_held()
            raise
        self._problem = ''
        while self._held:
            self._add(*self._held.popleft())

    def add_image(self, msg: Any) -> None:
        """Hand over a sensor_msgs/Image; what is wrong with it is told by the sequencer."""
        self._add(msg, image_from_message)

    def add_compressed_image(self, msg: Any) -> None:
        """Hand over a sensor_msgs/CompressedImage; as `add_image`."""
        self._add(msg, image_from_compressed)

    def add_imu(self, msg: Any) -> None:
        """Hand over a sensor_msgs/Imu.

        Raises
        ------
        InputError
            It cannot be used.
        """
        sample = imu_sample_from_message(msg)
        if not self._gyro.repeats(sample):
            self._sequencer.add_imu(sample)

    def add_accelerometer(self, msg: Any) -> None:
        """Hand over a sensor_msgs/Imu of a driver that publishes the accelerometer apart."""
        self._sequencer.add_imu(accelerometer_sample_from_message(msg))

    def refuse_held(self) -> None:
        """Give up on the images that wait for a CameraInfo."""
        while self._held:
            self._refuse_uncalibrated(self._held.popleft()[0])

    def _add(self, msg: Any, decode: Decode) -> None:
        if self._calibration is None:
            if self._problem:
                self._refuse_uncalibrated(msg)
                return
            self._held.append((msg, decode))
            if len(self._held) > _HELD_IMAGES:
                self._refuse_uncalibrated(self._held.popleft()[0])
            return
        try:
            stamp = stamp_ns(msg.header)
            # Here, before any of them is dropped: the next one would pass for new.
            problem = self._camera.problem(stamp, np.frombuffer(msg.data, dtype=np.uint8))
            if problem:
                self._sequencer.refuse(stamp, Refusal.BAD_IMAGE, problem)
                return
            self._sequencer.add_frame(EncodedFrame(
                stamp, str(msg.header.frame_id), self._calibration,
                lambda: decode(msg)))
        except InputError as error:
            self._sequencer.refuse(0, Refusal.BAD_IMAGE, str(error))

    def _refuse_uncalibrated(self, msg: Any) -> None:
        try:
            stamp = stamp_ns(msg.header)
        except InputError:
            stamp = 0
        self._sequencer.refuse(stamp, Refusal.NO_CALIBRATION,
                               self._problem or 'no CameraInfo came before or with the image')
