"""The check of a bag: choose topics, read it once, judge."""

from __future__ import annotations

from collections.abc import Callable

from rs_relpose_ros.bags.reader import Bag
from rs_relpose_ros.bags.topics import SensorTopics, Topic, TopicOptions
from rs_relpose_ros.calibrate.axis_maps import axes_text, nearest_axis_map
from rs_relpose_ros.check import judge_images, judge_imu, judge_together
from rs_relpose_ros.check.completion import completed, Completion, remeasured
from rs_relpose_ros.check.findings import CheckReport, FAILURE, Finding, Verdict, WARNING
from rs_relpose_ros.check.scan import Chosen, Scan
from rs_relpose_ros.check.trial import middle_of, Trial
from rs_relpose_ros.config.parameters import Parameters
from rs_relpose_ros.errors import InputError, MissingInputError
from rs_relpose_ros.messages.sensor_feed import PARTS, Role


def choose_topics(bag: Bag, options: TopicOptions) -> Chosen:
    """The topics to look at: as `Bag.find_topics`, but what is absent is None.

    Raises
    ------
    InputError, MissingInputError
        Several could be meant, or a topic that was asked for is not there.
    """
    try:
        topics = bag.find_topics(options, needs_camera_info=False)
    except (InputError, MissingInputError) as error:
        # Asked for by name, it is a mistake; absent altogether or rectified, it is a finding.
        asked = [name for name in (options.image, options.camera_info, options.imu, options.accel)
                 if name]
        there = {topic.name.lstrip('/') for topic in bag.topics if topic.count}
        chosen = Chosen(_first(bag, options.image, Role.IMAGE),
                        _first(bag, options.camera_info, Role.CAMERA_INFO),
                        _first(bag, options.imu, Role.IMU), None)
        absent = isinstance(error, MissingInputError) and all(
            name.lstrip('/') in there for name in asked)
        if not absent and 'image_rect' not in (chosen.image.name if chosen.image else ''):
            raise
        return chosen
    return Chosen(topics.image, topics.camera_info, topics.imu, topics.accel)


def check_bag(bag: Bag, chosen: Chosen, parameters: Parameters,
              on_message: Callable[[], object] = lambda: None) -> CheckReport:
    """Read the chosen topics of an open bag, and judge them and the node's parameters.

    A second time where read-out or axes are not told, to look for them first, or where the trial
    of what was told goes wrong, to measure it. `on_message` is called after each message of the
    reading in between, and after each image of the first one, for a progress bar.

    Raises
    ------
    InputError
        The bag is damaged.
    """
    images = chosen.image.count if chosen.image else 0
    seen = Scan(images, parameters.intrinsics, no_camera_info=chosen.camera_info is None)
    completion, trial, topics = Completion(parameters, None, ''), None, None
    if chosen.image is not None and chosen.imu is not None:
        topics = SensorTopics(chosen.image, chosen.camera_info, chosen.imu, chosen.accel, None)
        completion = completed(bag, topics, parameters, middle_of(images), on_message)
        if not completion.parameters.sensor.missing():
            trial = Trial(images, completion.parameters)
    for role, message in seen.feed.messages(bag, chosen):
        seen.take(role, message)
        if trial is not None:
            trial.take(role, message)
        on_message()
    if trial is not None:
        trial.close()
    findings = [_topics(bag, chosen, parameters), _parameters(parameters)]
    if chosen.image is not None:
        findings += judge_images.findings(
            seen, chosen.image, bag.reliability(chosen.image), parameters)
    if chosen.imu is not None:
        findings += judge_imu.findings(seen, bag.reliability(chosen.imu), parameters)
    if topics is not None:
        if trial is not None and trial.is_lost and completion.found is None:
            completion = remeasured(bag, topics, completion, middle_of(images))
        findings += judge_together.findings(seen, trial, completion, parameters)
    return CheckReport(str(bag.path), tuple(findings))


def _first(bag: Bag, name: str, role: Role) -> Topic | None:
    return next((topic for topic in bag.topics
                 if topic.msgtype in PARTS[role].msgtypes and topic.count
                 and (not name or topic.name.lstrip('/') == name.lstrip('/'))), None)


def _topics(bag: Bag, chosen: Chosen, parameters: Parameters) -> Finding:
    roles = {'image': chosen.image, 'camera_info': chosen.camera_info, 'imu': chosen.imu,
             'accel': chosen.accel}
    figures = {role: topic.name if topic else None for role, topic in roles.items()}
    needed = ['image', 'imu'] if parameters.intrinsics.given else ['image', 'camera_info', 'imu']
    absent = [role for role in needed if roles[role] is None]
    text = ', '.join(f'{topic.name} ({topic.count})' for topic in chosen.all)
    if not absent:
        return Finding('topics', Verdict.OK, text, figures=figures)
    there = ', '.join(map(str, bag.topics)) or 'no topics at all'
    return Finding('topics', FAILURE,
                   f'no {" and no ".join(absent)} topic; the bag has {there}',
                   'record images (raw or compressed), their CameraInfo and a sensor_msgs/Imu '
                   'with gyro', figures)


def _parameters(parameters: Parameters) -> Finding:
    missing = parameters.sensor.missing()
    if missing:
        return Finding('parameters', WARNING, f'{" and ".join(missing)} not given',
                       'the node needs them: give --params FILE, or find them from a recording '
                       'with "rs_relpose calibrate"', {'missing': missing})
    sensor = parameters.sensor
    nearest = axes_text(nearest_axis_map(sensor.R_cam_imu))
    return Finding('parameters', Verdict.OK,
                   f'readout_time {1e3 * (sensor.readout_time or 0.0):.1f} ms, time_offset '
                   f'{1e3 * sensor.time_offset:.1f} ms, quat_cam_imu_xyzw (about {nearest}) are '
                   'given', figures={'missing': [], 'nearest': nearest})
