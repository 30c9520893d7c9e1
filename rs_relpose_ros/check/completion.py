"""What was not told of camera and IMU, or too far off, by the calibration of a part."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Any

from rs_relpose_ros.bags.reader import Bag
from rs_relpose_ros.bags.topics import SensorTopics
from rs_relpose_ros.calibrate.bag_streams import read_recording
from rs_relpose_ros.calibrate.procedure import calibrate
from rs_relpose_ros.calibrate.result import CalibrationResult
from rs_relpose_ros.config.calibration import TRACKED_IN_IMAGES
from rs_relpose_ros.config.parameters import Parameters
from rs_relpose_ros.config.tracking import TrackingConfig
from rs_relpose_ros.errors import InputError


@dataclass(frozen=True, slots=True, eq=False)
class Completion:
    """Parameters with what was found in place of what was not told."""

    parameters: Parameters
    found: CalibrationResult | None   # None where none was wanted, or could be made
    problem: str   # why something is still missing; empty where nothing is


def measured(bag: Bag, topics: SensorTopics, parameters: Parameters, images: range,
             on_image: Callable[[], object] = lambda: None) -> CalibrationResult:
    """Calibration from nothing of some `images`, by their number in the bag.

    `on_image` is called after each image of the bag, for a progress bar.

    Raises
    ------
    InputError
        They cannot be used for it.
    """
    tracking = parameters.tracking
    recording = read_recording(bag, topics, TrackingConfig(
        detector=tracking.detector, feature_rows=tracking.feature_rows), images=images,
        on_image=on_image)
    return calibrate(recording.tracks, recording.gyro, recording.camera,
                     focal_known=recording.focal_known, config=TRACKED_IN_IMAGES)


def completed(bag: Bag, topics: SensorTopics, parameters: Parameters, images: range,
              on_image: Callable[[], object] = lambda: None) -> Completion:
    """`parameters` with read-out and axes, where missing, as `images` (by number) of a bag show.

    `on_image` is called after each image of the bag, for a progress bar.
    """
    missing = parameters.sensor.missing()
    if not missing:
        return Completion(parameters, None, '')
    try:
        found = measured(bag, topics, parameters, images, on_image)
    except InputError as error:
        return Completion(parameters, None, str(error))
    readout, problem = found.readout_time, ''
    values: dict[str, Any] = {}
    for name, estimate, told in (
            ('quat_cam_imu_xyzw', found.rotation, {'quat_cam_imu_xyzw': found.quat_cam_imu_xyzw}),
            ('readout_time', readout, {
                'readout_time': abs(readout.value),
                'readout_direction': 'up' if readout.value < 0.0 else 'down'})):
        if name in missing and estimate.observable:
            values.update(told)
        elif name in missing:
            problem = problem or estimate.remark
    return Completion(parameters.updated(values), found, problem)


def remeasured(bag: Bag, topics: SensorTopics, completion: Completion,
               images: range) -> Completion:
    """The same with the calibration of `images` from nothing; without, where they give none."""
    try:
        return replace(completion, found=measured(bag, topics, completion.parameters, images))
    except InputError:
        return completion
