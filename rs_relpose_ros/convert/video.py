"""Videos of cameras that log their IMU: GoPro and whatever else telemetry-parser reads."""

from __future__ import annotations

from pathlib import Path

from rs_relpose_ros.config.parameter_file import SourcedValue
from rs_relpose_ros.convert.lens_profile import find_lens_profile, LensProfile, VideoMode
from rs_relpose_ros.convert.recording import Conversion, Recording
from rs_relpose_ros.convert.telemetry import read_telemetry
from rs_relpose_ros.convert.told_readout import ToldReadout
from rs_relpose_ros.convert.video_frames import IMAGE_FORMAT, Video
from rs_relpose_ros.geometry.timing import NANOSECONDS

# Stamp of the first frame: the file tells no clock, and samples may lie before it.
START_NS = 1000 * NANOSECONDS


def read_conversion(path: Path, lens_profile: Path | None) -> Conversion:
    """A video with its telemetry; frames are decoded when the bag is written.

    `lens_profile`: a profile, or a folder of them that has one of this camera's mode; it gives the
    calibration, and the read-out time where the file does not tell it.
    """
    telemetry = read_telemetry(path, START_NS)
    video = Video(path)
    times_ns = video.times_ns()
    stamps_ns = [START_NS + time_ns for time_ns in times_ns]
    duration_ns = max(times_ns[-1] - times_ns[0], 1)
    mode = VideoMode(telemetry.brand, telemetry.model, video.width, video.height,
                     (len(video) - 1) * NANOSECONDS / duration_ns)
    profile = None if lens_profile is None else find_lens_profile(lens_profile, mode)
    recording = Recording(
        camera=profile.camera if profile else None, images=video.frames(stamps_ns),
        image_format=IMAGE_FORMAT, imu=telemetry.gyro, accel=telemetry.accel)
    return Conversion(
        recording, f'Parameters of relpose_node for {path.name} (`rs_relpose convert video`): '
        f'{mode}. What is not here, `rs_relpose calibrate` finds.',
        _parameters(telemetry.readout, profile))


def _parameters(told: ToldReadout | None, profile: LensProfile | None) -> tuple[SourcedValue, ...]:
    values = [SourcedValue('image_transport', 'compressed', 'The bag holds JPEG images.')]
    guessed = profile.readout if profile else None
    if told is not None:
        values += readout_values(told, f'Told by the file: {told.source}.')
    elif guessed is not None:
        values += readout_values(guessed, f'A GUESS, not told by the file: {guessed.source}. '
                                 '`rs_relpose calibrate` measures it.')
    return (
        *values,
        SourcedValue('stamp_row', 'first', 'Convention of time_offset here.'),
        SourcedValue('time_offset', 0.0, 'NOT KNOWN: the file does not tell when its IMU began '
                     'against its frames; tens of milliseconds are usual. `rs_relpose calibrate` '
                     'measures it.'),
        SourcedValue('quat_cam_imu_xyzw', (0.0, 0.0, 0.0, 1.0),
                     "The IMU was turned to the camera's axes."))


def readout_values(readout: ToldReadout, source: str) -> list[SourcedValue]:
    """Read-out time and direction as parameters, with the sentence that says who told them."""
    return [SourcedValue('readout_time', readout.seconds, source),
            SourcedValue('readout_direction', readout.direction, 'As the read-out time.')]
