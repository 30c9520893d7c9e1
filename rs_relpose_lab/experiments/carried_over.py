"""Whether a calibration carries over: calibrated on one recording, scored on another one.

The estimate shares images with a calibration on the same recording, whose errors are then partly
those of the images. On another recording only the camera is the same.
"""

from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import NamedTuple

from rs_relpose_lab.experiments.consistency import (
    image_stamps,
    pair_consistency,
    PairConsistency,
    policy_pairs,
)
from rs_relpose_lab.experiments.true_pairs import read_truth, TruePath
from rs_relpose_ros.bags.reader import open_bag
from rs_relpose_ros.bags.sensor_topics import COMPRESSED_IMAGE
from rs_relpose_ros.calibrate.procedure import calibrate_together, calibrated
from rs_relpose_ros.calibrate.recording import CalibrationInput, read_recording
from rs_relpose_ros.calibrate.result import parameter_file
from rs_relpose_ros.config.files import read_parameters
from rs_relpose_ros.config.settings import TRACKED_IN_IMAGES, TrackingConfig
from rs_relpose_ros.errors import InputError
from rs_relpose_ros.messages.transforms import bag_frames

# Distortion model of a lens that is estimated. [chosen: that of `rs_relpose calibrate --lens`]
_LENS = 'plumb_bob'


class Protocol(NamedTuple):
    """A recording that is scored, and recordings that its camera is calibrated on."""

    scored: Path
    truth: Path
    # Without any, the first half of the images calibrates, and pairs of the second are scored.
    calibrated: tuple[Path, ...]

    @property
    def name(self) -> str:
        """What the camera is calibrated on."""
        bags = ' and '.join(bag.name for bag in self.calibrated)
        return f'calibrated on {bags or "its first half"}'


def carried_over(
    protocol: Protocol, folder: Path, *, lens_known: bool = False
) -> Iterator[PairConsistency]:
    """Pairs of the scored recording with the calibration, whose file is written into `folder`."""
    known = read_truth(protocol.truth)
    if not isinstance(known, TruePath):
        raise InputError(
            f'{protocol.truth} has no path of the camera: give a folder with global_truth.csv, '
            'whose pairs are those of the keyframe policy'
        )
    begin_ns = 0
    images = None
    bags = protocol.calibrated
    if not bags:
        stamps = image_stamps(protocol.scored)
        half = len(stamps) // 2
        begin_ns = stamps[half]
        images = range(half)
        bags = (protocol.scored,)
    text = _calibration_of(bags, images, lens_known)
    file = folder / f'{protocol.scored.name}_{protocol.name.replace(" ", "_")}.yaml'
    file.write_text(text, encoding='utf-8')
    for true, given in policy_pairs(protocol.scored, read_parameters(file), known):
        if true.stamp1_ns >= begin_ns and given is not None:
            pose = given[0].pose
            yield pair_consistency(protocol.name, protocol.scored.name, true, pose)


def _calibration_of(bags: Sequence[Path], images: range | None, lens_known: bool) -> str:
    """Parameter file of one or several bags, as `rs_relpose calibrate` writes it."""
    read = [_recording(bag, images, lens_known) for bag in bags]
    recordings = [recording for recording, _, _ in read]
    _, quat_prior, compressed = read[0]
    if len(recordings) == 1:
        result = calibrated(recordings[0], TRACKED_IN_IMAGES, quat_prior=quat_prior)
    else:
        together = calibrate_together(recordings, TRACKED_IN_IMAGES, quat_prior=quat_prior)
        result = together.result
    names = ', '.join(bag.name for bag in bags)
    title = f'Parameters from a calibration on {names}.'
    camera = recordings[0].camera
    return parameter_file(result, title, camera=camera, compressed=compressed)


def _recording(
    path: Path, images: range | None, lens_known: bool
) -> tuple[CalibrationInput, Sequence[float] | None, bool]:
    """Tracks and gyro of a bag, the rotation of its transforms, and whether it is compressed."""
    with open_bag(path) as bag:
        topics = bag.find_topics(needs_camera_info=False)
        recording = read_recording(bag, topics, TrackingConfig(), images=images)
        in_camera = bag_frames(bag, topics).imu_in_camera
    if not lens_known:
        recording = recording.with_unknown_lens(_LENS)
    compressed = topics.image.msgtype == COMPRESSED_IMAGE
    return recording, None if in_camera is None else in_camera[3:], compressed
