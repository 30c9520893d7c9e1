"""Images as if from a global shutter: the settings of global_shutter_node and `unroll`."""

from __future__ import annotations

from dataclasses import dataclass

from rs_relpose_ros.config.declarations import check_settings, setting

STAMP_CLOCKS = ('imu', 'camera')
BORDERS = ('replicate', 'black')


@dataclass(frozen=True, slots=True)
class GlobalShutterConfig:
    """Stamps and borders of the turned images."""

    stamp_clock: str = setting(
        'imu', 'clock on which turned images (global_shutter_node, unroll) carry the instant of '
        "their middle row: the IMU's, so that a SLAM system's time offset is 0, or the camera's, "
        'where depth or stereo images are used along', choices=STAMP_CLOCKS)
    border: str = setting(
        'replicate', 'what turned images show where the camera saw nothing: its nearest pixel, or '
        'black', choices=BORDERS)

    def __post_init__(self) -> None:
        check_settings(self)
