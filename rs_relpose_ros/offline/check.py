"""The check of a bag: choose topics, read it once, report findings."""

from collections.abc import Iterator, Mapping
from contextlib import suppress
from dataclasses import replace
import math
from typing import Any

import numpy as np

from rs_relpose_ros.bags import sensor_topics
from rs_relpose_ros.bags.reader import Bag
from rs_relpose_ros.bags.sensor_topics import Chosen, SensorTopics, Topic
from rs_relpose_ros.calibration import observations
from rs_relpose_ros.calibration.assessment import not_evaluated
from rs_relpose_ros.calibration.findings import (
    Assessment,
    BY_CODE,
    Code,
    Finding,
    FindingState,
    QUANTITIES,
    Why,
)
from rs_relpose_ros.calibration.findings_text import text_of, with_sigma
from rs_relpose_ros.calibration.observations import axes_text, frame_times, Varying
from rs_relpose_ros.config.settings import Parameters, sensor_model
from rs_relpose_ros.errors import InputError
from rs_relpose_ros.imu.buffer import ForceFault, length_fault
from rs_relpose_ros.messages.incoming import Role, sensor_messages
from rs_relpose_ros.messages.outgoing import LARGE_MESSAGE
from rs_relpose_ros.messages.streams import (
    check_timelines,
    counter_unit,
    FaultKind,
    find_multiplied,
    StreamFault,
)
from rs_relpose_ros.messages.transforms import with_extrinsics
from rs_relpose_ros.offline import check_recording
from rs_relpose_ros.offline.check_recording import (
    Completion,
    FrontEndSample,
    Scan,
    StampStatistics,
)
from rs_relpose_ros.offline.check_report import (
    by_case,
    Case,
    CheckReport,
    Line,
    OK,
    property_line,
    SUSPECT,
    UNKNOWN,
    with_parents,
    WRONG,
)


def check_bag(bag: Bag, chosen: Chosen, parameters: Parameters) -> CheckReport:
    """Read the chosen topics of an open bag, and report on them and on the parameters.

    The bag is read twice if readout time or axes are missing, which a calibration then estimates
    first, or if the front end fails on them. InputError if the bag is damaged.
    """
    images = chosen.image.count if chosen.image else 0
    parameters, contradiction = with_extrinsics(bag, chosen, parameters)
    bag.time_offset = parameters.sensor.time_offset
    scan = Scan(images, parameters.intrinsics)
    completion = Completion(parameters)
    sample = None
    source = scan.added(sensor_messages(bag, chosen, faulty=True))
    topics = chosen.sensors
    if topics is not None:
        completion = check_recording.completed(bag, topics, parameters)
        if not completion.parameters.sensor.missing():
            sample = check_recording.sampled(source, images, completion.parameters)
    for _ in source:  # all of it without a sample
        pass
    findings = stream_findings(bag, chosen, parameters, contradiction, scan)
    if topics is not None:
        if sample is not None and sample.is_lost and completion.found is None:
            with suppress(InputError):  # the recording permits no calibration
                found = check_recording.calibrated(bag, topics, completion.parameters)
                completion = completion._replace(found=found)
        faults = check_timelines(bag.timeline, chosen)
        offset = None
        doubtful = sample is not None and (not sample.poses or sample.health.state is WRONG)
        if doubtful and not any(fault.withholds for fault in faults.values()):
            offset = _offset_of_clocks(bag, topics, scan, completion.parameters)
        findings += joint_findings(scan, sample, completion, parameters, faults, offset)
    return CheckReport(str(bag.path), with_parents(findings))


def stream_findings(
    bag: Bag, chosen: Chosen, parameters: Parameters, contradiction: str, scan: Scan
) -> list[Line]:
    """Findings on topics and streams that were read; `contradiction`: of `with_extrinsics`."""
    findings = [_topics(bag, chosen, parameters), _parameters(parameters)]
    if contradiction:
        findings.append(
            property_line(
                Code.TRANSFORMS,
                SUSPECT,
                contradiction,
                'correct the description of the robot (URDF), or the parameter',
                {},
            )
        )
    if chosen.image is not None:
        findings += [
            *_encoding(scan, chosen.image, parameters),
            _rate(scan.stamps(Role.IMAGE)),
            stamp_finding(Code.IMAGE_STAMPS, scan.stamps(Role.IMAGE), 'the camera'),
            _calibration(scan),
            _transport(scan, chosen.image, bag.reliability(chosen.image)),
        ]
    faults = check_timelines(bag.timeline, chosen)
    if chosen.imu is not None:
        findings += _imu(scan, bag.reliability(chosen.imu), parameters, faults)
    return findings


def _topics(bag: Bag, chosen: Chosen, parameters: Parameters) -> Line:
    measured = {role: topic and topic.name for role, topic in chosen._asdict().items()}
    needed = ['image', 'imu'] if parameters.intrinsics.given else ['image', 'camera_info', 'imu']
    absent = [role for role in needed if measured[role] is None]
    if not absent:
        return by_case(
            Code.TOPICS,
            ', '.join(f'{topic.name} ({topic.count})' for topic in filter(None, chosen)),
            measured,
        )
    there = ', '.join(map(str, bag.topics)) or 'no topics at all'
    return property_line(
        Code.TOPICS,
        WRONG,
        f'no {" and no ".join(absent)} topic; the bag has {there}',
        'record images (raw or compressed), their CameraInfo and a sensor_msgs/Imu with gyro',
        measured,
    )


def _parameters(parameters: Parameters) -> Line:
    sensor = parameters.sensor
    missing = parameters.sensor.missing()
    if missing:
        return property_line(
            Code.PARAMETERS,
            SUSPECT,
            f'{" and ".join(missing)} not configured',
            'the node needs them: add --params FILE, or estimate them from a recording '
            'with "rs_relpose calibrate"',
            {'missing': missing},
        )
    nearest = axes_text(observations.nearest_axis_map(sensor.R_cam_imu))
    return by_case(
        Code.PARAMETERS,
        f'readout_time {1e3 * (sensor.readout_time or 0.0):.1f} ms, '
        f'time_offset {1e3 * sensor.time_offset:.1f} ms, quat_cam_imu_xyzw (about '
        f'{nearest})',
        {'missing': [], 'nearest': nearest},
    )


# -- Images and their calibration -------------------------------------------------------------

# Rate of images [Hz] below which tracks are lost and keyframes lie far apart.
# [chosen: 5 to 10 Hz would do]
_SLOW = 8.0
# Share of missed images that is reported. Below it no result suffers; above it a bag with frequent
# losses would pass. [chosen: 0.02 to 0.1 would do]
_MISSED_SHARE = 0.05
# Number of first stamps by which jitter and automatic exposure are distinguished. Fewer leave the
# correlation of the steps uncertain, more cost time alone. [chosen: 300 to 10,000 would do]
_MOST_STAMPS = 1000
# Share of repeated or unordered stamps from which stamps are no times of measurement.
# [chosen: 0.1 to 0.4 would do; two publishers on a topic reach half]
_UNORDERED_SHARE = 0.2


def _no_step(name: Code, stamps: StampStatistics, measured: dict[str, Any]) -> Line:
    return property_line(
        name,
        WRONG,
        f'{stamps.count} message(s), no two of increasing stamps',
        'record longer, and correct the stamps of the driver',
        measured,
    )


def stamp_finding(name: Code, stamps: StampStatistics, of: str) -> Line:
    """Order and evenness of stamps; those of images may follow an exposure."""
    varying = Varying.JITTER
    if of == 'the camera':
        first_ns = np.unique(stamps.ns[:_MOST_STAMPS])
        varying = frame_times(first_ns).varying if len(first_ns) > 2 else Varying.UNCLEAR
    jitter = stamps.jitter
    repeated = int((stamps.steps == 0.0).sum())
    backwards = int((stamps.steps < 0.0).sum())
    furthest_back = abs(float(stamps.steps.min(initial=0.0)))
    measured = {
        'jitter_s': jitter,
        'repeated': repeated,
        'backwards': backwards,
        'furthest_back_s': furthest_back,
        'delay_s': stamps.delay if stamps.count else None,
    }
    if not stamps.interval > 0.0:
        return _no_step(name, stamps, measured)
    text = f'jitter {1e3 * jitter:.2f} ms'
    unordered = repeated + backwards
    if unordered:
        text += f', {repeated} repeated, {backwards} back in time (by up to {furthest_back:.3f} s)'
    unit = counter_unit(furthest_back, stamps.interval) if furthest_back > 0.0 else ''
    smooth = jitter <= max(0.2 * stamps.interval, 1e-3)
    out_of_order = _order_cases(stamps.count, unordered, furthest_back, unit, of)
    return by_case(name, text, measured, *out_of_order, *_evenness_cases(smooth, varying, of))


def _order_cases(
    count: int, unordered: int, furthest_back: float, unit: str, of: str
) -> tuple[Case, ...]:
    """Cases of stamps that are repeated or go back in time."""
    return (
        Case(
            unordered > _UNORDERED_SHARE * count,
            WRONG,
            f'have the driver of {of} stamp each message with its own time',
        ),
        Case(
            bool(unit),
            SUSPECT,
            'stamps go on in the right order; have the driver extend its counter to 64 bits',
            f': a 32-bit counter of {unit} overflowed',
        ),
        Case(
            furthest_back > 1.0,
            SUSPECT,
            'the clock was set back or the bag has two '
            'recordings: the node restarts there; record with a steady clock',
        ),
        Case(
            unordered > 0,
            SUSPECT,
            'these messages are not used: look for two publishers on the topic',
        ),
    )


def _evenness_cases(smooth: bool, varying: Varying, of: str) -> tuple[Case, ...]:
    """Cases of stamps in order, by how evenly they follow each other."""
    return (
        Case(smooth, OK),
        Case(
            varying is Varying.EXPOSURE,
            OK,
            'the time offset follows it: estimate '
            'time_offset_per_interval with "rs_relpose calibrate", or fix the exposure',
            ', over many frames each, as by automatic exposure',
        ),
        Case(
            varying is Varying.JITTER,
            SUSPECT,
            f'probably times of arrival: have {of} stamp in hardware, or at the interrupt',
        ),
        Case(
            True,
            SUSPECT,
            f'verify the stamps of {of}',
            ', neither as by times of arrival nor as by automatic exposure',
        ),
    )


def _encoding(scan: Scan, topic: Topic, parameters: Parameters) -> list[Line]:
    sizes = ', '.join(f'{width}x{height}' for width, height in scan.sizes)
    found = by_case(
        Code.IMAGES,
        f'{sizes} {", ".join(scan.encodings)}'.strip(),
        {
            'encodings': dict(scan.encodings),
            'bad_images': scan.unusable[Role.IMAGE],
            'sizes': [list(size) for size in scan.sizes],
        },
        Case(
            scan.unusable[Role.IMAGE] > 0,
            SUSPECT if scan.sizes else WRONG,
            'publish original images of a known encoding, or JPEG or PNG',
            f'; {scan.unusable[Role.IMAGE]} cannot be used: {scan.problems.get(Role.IMAGE)}',
        ),
        Case(
            'image_rect' in topic.name,
            WRONG,
            'record the original (raw) images: rectified rows have no common time',
            f'; {topic.name} is rectified',
        ),
        Case(
            len(scan.sizes) > 1,
            SUSPECT,
            'keep the resolution; the readout time changes with it',
            ': the size changes',
        ),
    )
    compressed = topic.msgtype == sensor_topics.COMPRESSED_IMAGE
    if compressed == (parameters.pair.image_transport == 'compressed'):
        return [found]
    right = 'compressed' if compressed else 'raw'
    return [
        found,
        property_line(
            Code.TRANSPORT,
            SUSPECT,
            f'the images are {right}',
            f'set image_transport: {right} for the live node (replay detects it)',
            {'image_transport': right},
        ),
    ]


def _rate(stamps: StampStatistics) -> Line:
    name = Code.IMAGE_RATE
    interval = stamps.interval
    duration = stamps.duration
    if not interval > 0.0:
        return property_line(
            name,
            WRONG,
            f'{stamps.count} image(s) of different stamps or fewer',
            'record at least some seconds',
            {'count': stamps.count},
        )
    # Each longer step hides frames; 1.5 of a step occurs even with automatic exposure.
    gaps = int((stamps.forwards > 1.7 * interval).sum())
    longest = stamps.longest
    missed = max(round(duration / interval) - stamps.count + 1, 0) if gaps else 0
    text = f'{1.0 / interval:.1f} Hz, {stamps.count} in {duration:.1f} s'
    if gaps:
        text += f', about {missed} missed in {gaps} gaps, the longest {longest:.2f} s'
    return by_case(
        name,
        text,
        {
            'rate_hz': 1.0 / interval,
            'count': stamps.count,
            'duration_s': duration,
            'gaps': gaps,
            'longest_step_s': longest,
            'missed': missed,
        },
        Case(
            1.0 / interval < _SLOW,
            SUSPECT,
            f'record at {_SLOW:g} Hz or more: points are lost between frames that are far apart',
        ),
        Case(
            missed > _MISSED_SHARE * stamps.count,
            SUSPECT,
            'images are lost in transport: use '
            'config/fastdds.xml, compressed images, or a faster disk',
        ),
    )


def _calibration(scan: Scan) -> Line:
    name = Code.CALIBRATION
    intrinsics = scan.intrinsics
    if intrinsics is None:
        return property_line(
            name,
            WRONG,
            scan.problems.get(Role.CAMERA_INFO, 'no CameraInfo'),
            'calibrate the camera (camera_calibration, OpenCV) and have its driver '
            'publish the CameraInfo, or set camera_matrix: "rs_relpose calibrate" '
            'estimates its focal length',
            {},
        )
    size = intrinsics.image_width, intrinsics.image_height
    other = next(iter(scan.sizes), size) if size not in scan.sizes else size
    straight = intrinsics.global_shutter_camera().is_undistorted
    wide = intrinsics.width > 2.0 * intrinsics.fx  # more than 90 deg
    return by_case(
        name,
        f'{intrinsics.width}x{intrinsics.height}, f {intrinsics.fx:.1f} '
        f'{intrinsics.fy:.1f} px, {intrinsics.distortion_model}'
        + (' by camera_matrix' if scan.configured.given else ''),
        {
            'fx': intrinsics.fx,
            'fy': intrinsics.fy,
            'distortion_model': intrinsics.distortion_model,
            'different': scan.calibrations,
        },
        Case(
            other != size,
            WRONG,
            'publish the CameraInfo of this resolution, region of interest and binning included',
            f': for images of {size[0]}x{size[1]}, but they are {other[0]}x{other[1]}',
        ),
        Case(
            bool(scan.contradictions),
            SUSPECT,
            '',
            '; ' + '; '.join(sorted(scan.contradictions)),
        ),
        Case(
            straight and wide,
            SUSPECT,
            'correct for a simulated or a rectifying camera only: otherwise calibrate it',
            ' without distortion',
        ),
        Case(straight, OK, '', ' without distortion'),
        Case(
            scan.calibrations > 1,
            SUSPECT,
            'keep zoom and focus: each change restarts tracks',
            f'; it changes {scan.calibrations - 1} times',
        ),
    )


def _transport(scan: Scan, topic: Topic, reliability: str) -> Line:
    size = scan.largest_image
    offered = f'recorded as {reliability}' if reliability else 'reliability not recorded'
    return by_case(
        Code.LIVE_TRANSPORT,
        f'{topic.name} {offered}, up to {size / 1e3:.0f} kB per image',
        {'largest_bytes': size, 'reliability': reliability or None},
        Case(
            size > LARGE_MESSAGE,
            SUSPECT,
            'live, Fast DDS loses most images above 512 KiB with '
            'its default transports: start driver and node with '
            'FASTRTPS_DEFAULT_PROFILES_FILE=.../config/fastdds.xml, or use image_transport: '
            'compressed',
        ),
        Case(True, OK, '', '; the node subscribes best effort, which matches both'),
    )


# -- Gyro and accelerometer -------------------------------------------------------------------

# Rate of the IMU [Hz] below which the rotation within one readout is not resolved.
# [chosen: 50 to 150 Hz would do]
_SLOW_IMU = 80.0
# Mean length of the specific force [m/s^2] that is consistent with hand-held motion. A wider range
# would pass a scale that spoils baselines, a narrower one would report strong motion.
# [chosen: gravity - 0.4 to gravity + 1, as mean lengths grow with acceleration]
_LEAST_FORCE = 9.4
_MOST_FORCE = 10.8  # [m/s^2], the other end of this range
# Median rate [rad/s] that neither a hand nor a drone reaches; degrees per second do.
# [chosen: 5 to 20 would do]
_FASTEST_MEDIAN = 8.0


def _imu(
    scan: Scan, reliability: str, parameters: Parameters, faults: Mapping[FaultKind, StreamFault]
) -> list[Line]:
    """Findings on the IMU by itself."""
    if not len(scan.rates):
        problem = scan.problems.get(Role.IMU, 'all messages mark the gyro as absent')
        return [
            property_line(
                Code.GYRO,
                WRONG,
                f'no gyro: {problem}',
                'choose a topic that has angular_velocity with --imu-topic',
                {},
            )
        ]
    stamps = scan.stamps(Role.IMU)
    if FaultKind.BURSTS in faults:
        # Steps, gaps and repeated stamps follow from the bursts.
        bursts = faults[FaultKind.BURSTS]
        state = WRONG if bursts.withholds else SUSPECT
        lines = [_of_fault(Code.IMU_RATE, state, bursts)]
    else:
        rate = _imu_rate(scan, stamps, reliability, parameters.imu.max_imu_gap)
        lines = [rate, stamp_finding(Code.IMU_STAMPS, stamps, 'the IMU')]
    if FaultKind.ACCEL_CLOCK in faults:
        lines.append(_of_fault(Code.ACCEL_CLOCK, SUSPECT, faults[FaultKind.ACCEL_CLOCK]))
    return [
        *lines,
        _gyro(scan),
        _bias(scan, parameters),
        _accelerometer(scan),
    ]


def _of_fault(code: Code, state: FindingState, fault: StreamFault) -> Line:
    """Line on a fault of a stream."""
    return property_line(code, state, fault.message, fault.fix, fault.measured)


def _imu_rate(scan: Scan, stamps: StampStatistics, reliability: str, gap: float) -> Line:
    """Line on the steps of the IMU; those above `gap` [s] are not interpolated."""
    if not stamps.interval > 0.0:
        return _no_step(Code.IMU_RATE, stamps, {})
    gaps = int((stamps.forwards > gap).sum())
    hertz = 1.0 / stamps.interval
    unusable = scan.unusable[Role.IMU]
    recorded = f', recorded as {reliability}' if reliability else ''
    factor, how = find_multiplied(scan.rates)
    true = hertz / factor
    return by_case(
        Code.IMU_RATE,
        f'{hertz:.0f} Hz, {stamps.count} in {stamps.duration:.1f} s, longest step '
        f'{1e3 * stamps.longest:.1f} ms{recorded}',
        {
            'rate_hz': hertz,
            'count': stamps.count,
            'gaps': gaps,
            'longest_step_s': stamps.longest,
            'unusable': unusable,
            'reliability': reliability or None,
            'true_rate_hz': true,
        },
        Case(
            bool(how),
            SUSPECT,
            'have the driver publish each sample of the sensor once: noise and lag are those of '
            'the true rate',
            f'; values are {how}, the true rate of the gyro is {true:.0f} Hz',
        ),
        Case(
            stamps.interval > gap,
            WRONG,
            f'steps longer than max_imu_gap = {gap:g} s are not interpolated: raise the rate to '
            '100 Hz or more',
        ),
        Case(
            unusable > 0,
            SUSPECT,
            'correct the driver',
            f'; {unusable} messages cannot be used: {scan.problems.get(Role.IMU)}',
        ),
        Case(
            gaps > 0,
            SUSPECT,
            "frames in a gap are refused: give the IMU's subscription a deeper queue, or record "
            'on the machine of the driver',
            f'; {gaps} gaps above {1e3 * gap:.0f} ms',
        ),
        Case(
            hertz < _SLOW_IMU,
            SUSPECT,
            'publish 200 Hz or more, which resolves the rotation of a hand within one readout',
        ),
    )


def _gyro(scan: Scan) -> Line:
    rates = np.linalg.norm(scan.rates, axis=1)
    median = float(np.median(rates))
    high = float(np.percentile(rates, 95))
    return by_case(
        Code.GYRO,
        f'median {math.degrees(median):.1f} deg/s, 95 % {math.degrees(high):.1f} deg/s',
        {'median_rad_s': median, 'p95_rad_s': high},
        Case(
            float(np.ptp(scan.rates, axis=0).max()) == 0.0,
            WRONG,
            'the sensor is stuck or not read: correct its driver',
            '; all samples are equal',
        ),
        Case(
            median > _FASTEST_MEDIAN,
            WRONG,
            'these are degrees per second: sensor_msgs/Imu requires rad/s, so correct the driver',
            f' if {median:.0f} were rad/s',
        ),
    )


def _bias(scan: Scan, parameters: Parameters) -> Line:
    configured = parameters.imu.gyro_bias
    sigma = parameters.imu.gyro_bias_sigma
    name = Code.GYRO_AT_REST
    rest = scan.rest
    if rest is None:
        return property_line(
            name,
            UNKNOWN,
            'not measured: the IMU is never at rest here',
            'to measure it, keep the camera at rest for some seconds',
            {'at_rest_rad_s': None},
        )
    listed = [round(float(value), 5) for value in rest.value]
    off = float(np.abs(rest.value - np.array(configured)).max())
    return by_case(
        name,
        f'mean at rest {listed} rad/s (+- {rest.sigma:.4f})',
        {'at_rest_rad_s': listed, 'sigma_rad_s': rest.sigma},
        Case(
            off > 4.0 * math.hypot(sigma, rest.sigma),
            SUSPECT,
            f'set gyro_bias: {listed} if the '
            'camera was at rest there (a slow constant rate is similar)',
            f', gyro_bias is {list(np.array(configured))} +- {sigma:g}',
        ),
    )


def _accelerometer(scan: Scan) -> Line:
    name = Code.GRAVITY
    forces = scan.forces
    if not len(forces):
        return by_case(
            name,
            'no accelerometer',
            {'mean_length_m_s2': None, 'orientations': scan.orientations},
            Case(scan.orientations > 0, OK, '', ', but an orientation'),
            Case(
                True,
                SUSPECT,
                "poses are less accurate without: choose the accelerometer's "
                'topic with --accel-topic (node: remap accel)',
            ),
        )
    length = float(np.linalg.norm(forces, axis=1).mean())
    fault = length_fault(length)
    text = fault.message if fault else f'|acc| {length:.2f} m/s^2 in the mean'
    if scan.orientations:
        text += f', and {scan.orientations} orientations with covariance'
    return by_case(
        name,
        text,
        {
            'mean_length_m_s2': length,
            'mean_m_s2': forces.mean(axis=0).tolist(),
            'orientations': scan.orientations,
        },
        Case(bool(fault), WRONG, f'{ForceFault.fix}; or set use_gravity: false'),
        Case(
            not _LEAST_FORCE <= length <= _MOST_FORCE,
            SUSPECT,
            'calibrate the accelerometer (bias, scale), or set use_gravity: false',
            ', not near 9.81',
        ),
    )


# -- Images and gyro together -----------------------------------------------------------------

# Difference of the delays of both sensors [s] from which their stamps are of different clocks.
# Smaller would report slow drivers, larger would miss an offset that loses frames.
# [chosen: 0.2 to 1 s would do]
_SAME_CLOCK = 0.5
# Delay of both sensors [s] above which a conversion has received the messages, not a recorder.
# [chosen: no link is late by a minute; 30 s to an hour would do]
_CONVERTED = 60.0
# Largest legal value of the parameter time_offset [s]. [derived: its declaration]
_LARGEST_OFFSET = 1e5
# Matches of a pair in the median below which there is no estimate, and below which they are few.
# [chosen: a solver samples 9 or 11 matches, and an inlier ratio is never 1]
_NO_MATCHES = 15
_FEW_MATCHES = 30  # twice as many: a warning
# Readout time [s] that is assumed where none is known, for the effect alone.
# [chosen: between phones, 10 to 20 ms, and webcams, 30 to 60 ms]
_EXAMPLE_READOUT = 0.030
# Displacement [px] that is below the noise of matches, and one that spoils a global-shutter pose.
# [chosen: about 2 and 8 sigmas of a match of 0.5 px]
_NO_EFFECT = 1.0
_STRONG_EFFECT = 4.0  # [px], the pose of a global shutter is spoiled
# Sigmas beyond which a deviation is certain, whether it matters for poses or not. Fewer would make
# false alarms of seven quantities common, more would hide deviations that are plain to see.
# [chosen: 4 sigmas are exceeded by chance once in 16,000; 3.5 to 5 would do]
_CERTAIN = 4.0
# Multiple of the largest sigma of an observable deviation from which poses are wrong.
# [chosen: 2 to 5 would do]
_GROSS = 3.0
# What to do about a readout time that is assumed or off.
_MEASURE = 'measure it with "rs_relpose calibrate"'
# Findings that a calibration of the readout time settles.
_READOUT = frozenset((Code.READOUT_TIME, Code.READOUT_DIRECTION))
# Quantities by the parameters that set them.
_SET_BY = {'quat_cam_imu_xyzw': Code.AXES, 'readout_time': Code.READOUT_TIME}


def joint_findings(
    scan: Scan,
    sample: FrontEndSample | None,
    completion: Completion,
    parameters: Parameters,
    faults: Mapping[FaultKind, StreamFault],
    offset: float | None = None,
) -> list[Line]:
    """Findings on both sensors together.

    `sample` is None if `completion` could not find missing `parameters`. `offset` [s]: time offset
    with which clocks that differ have poses.
    """
    health = Assessment(())
    if sample is not None and offset is None:
        health = _with_calibration(sample, scan, completion)
    has_poses = sample is not None and sample.poses > 0 and health.state is not WRONG
    found = [_overlap(scan, parameters, has_poses, offset)]
    if FaultKind.SINCE_BOOT in faults:
        found = [_of_fault(Code.CLOCKS, WRONG, faults[FaultKind.SINCE_BOOT])]
    clocks_differ = 'the clocks differ' if offset is not None else ''
    causes = [fault.message for fault in faults.values() if fault.withholds]
    why = clocks_differ or next(iter(causes), '')
    if sample is not None and why:
        found.append(property_line(Code.PAIRS, UNKNOWN, f'not measured: {why}', '', {}))
    elif sample is not None:
        found += [_pairs(sample, health), _texture(sample, health)]
    reason = completion.problem if sample is None else 'too few pairs of images were estimated'
    missing = {_SET_BY[name] for name in parameters.sensor.missing()}
    found += [_not_configured(code, completion, scan) for code in sorted(missing)]
    bursts = faults.get(FaultKind.BURSTS)
    doubt = bursts.measured['offset_sigma_s'] if bursts else None
    lines = quantity_findings(health, clocks_differ or reason, doubt or 0.0)
    found += [line for line in lines if line.code not in missing]
    effect = _effect(scan, health, completion.parameters)
    return found if effect is None else [*found, effect]


def _offset_of_clocks(
    bag: Bag, topics: SensorTopics, scan: Scan, parameters: Parameters
) -> float | None:
    """Time offset [s] of clocks that differ by more than drivers do, tried with the front end."""
    apart = scan.stamps(Role.IMAGE).delay - scan.stamps(Role.IMU).delay
    # NaN where a sensor has no stamps
    if not _SAME_CLOCK < abs(apart + parameters.sensor.time_offset) <= _LARGEST_OFFSET:
        return None
    with suppress(InputError):  # the recording permits no calibration
        return check_recording.found_offset(bag, topics, parameters, apart)
    return None


def _overlap(scan: Scan, parameters: Parameters, has_poses: bool, offset: float | None) -> Line:
    """Whether the gyro covers the images in time, as stamped.

    If there are poses the stamps are right, and a difference of the delays is that of delivery.
    """
    name = Code.CLOCKS
    images = scan.stamps(Role.IMAGE)
    imu = scan.stamps(Role.IMU)
    if not images.count or not imu.count:
        return property_line(name, WRONG, 'no stamps to compare', 'correct the topics above', {})
    image_ns = images.ns + round(parameters.sensor.time_offset * 1e9)
    begin_ns = max(image_ns.min(), imu.ns.min())
    end_ns = min(image_ns.max(), imu.ns.max())
    common = int(end_ns - begin_ns) * 1e-9
    apart = images.delay - imu.delay
    measured = {'common_s': common, 'image_delay_s': images.delay, 'imu_delay_s': imu.delay}
    apart_too_far = max(_SAME_CLOCK, 0.5 * images.duration)
    is_apart = abs(apart + parameters.sensor.time_offset) > apart_too_far
    if common <= 0.0 or (is_apart and not has_poses) or offset is not None:
        fix = 'use one clock for both drivers (ROS time, not time since boot)'
        message = f'images and IMU are stamped {abs(apart):.3f} s apart'
        if offset is not None:
            side = 'ahead of' if offset > 0.0 else 'behind'
            message = f"the clock of the IMU is {abs(offset):.3f} s {side} the images'"
            fix += f', or set time_offset: {offset:.3f} if the difference is constant (tried)'
            measured['time_offset_s'] = offset
        return property_line(name, WRONG, message, fix, measured)
    history = parameters.imu.imu_buffer_seconds
    return by_case(
        name,
        f'{common:.1f} s in common; recorded {1e3 * images.delay:.0f} ms (images) and '
        f'{1e3 * imu.delay:.0f} ms (IMU) after their stamps',
        measured,
        Case(
            common < 0.8 * images.duration,
            SUSPECT,
            "images outside of the IMU's time are refused: start the IMU first and stop it last",
        ),
        Case(
            has_poses and apart > history,
            SUSPECT,
            f'{apart:.1f} s of delivery are more than the {history:g} s of IMU that a node keeps '
            '(imu_buffer_seconds): live, these images have no pose; offline the stamps decide',
        ),
        Case(has_poses and min(images.delay, imu.delay) > _CONVERTED, OK, '', ', by a conversion'),
        Case(
            abs(apart) > _SAME_CLOCK,
            SUSPECT,
            'the delays differ: verify that both stamp the time of measurement',
        ),
    )


def _pairs(sample: FrontEndSample, health: Assessment) -> Line:
    pairs = len(sample.matches)
    posed = sample.poses
    reason = next(iter(sample.reasons.most_common()), 'too few images were processed')
    return by_case(
        Code.PAIRS,
        f'{pairs} pairs in {sample.frames} images, {posed} with a pose',
        {'images': sample.frames, 'pairs': pairs, 'poses': posed},
        Case(
            sample.is_refused,
            WRONG,
            'hardly any image can be used: correct the reason',
            f': {reason}',
        ),
        Case(not posed, UNKNOWN, '', f': {reason}'),
        Case(
            sample.few_poses and health.state is WRONG,
            SUSPECT,
            'correct the parameters that are wrong, below',
            f'; without: {reason}',
        ),
        Case(
            sample.few_poses,
            SUSPECT,
            'translate the camera more; if it does move, a '
            'parameter is too far off to be observable: measure all with "rs_relpose calibrate"',
            f'; without: {reason}',
        ),
    )


def _texture(sample: FrontEndSample, health: Assessment) -> Line:
    if not sample.matches:
        return property_line(
            Code.TEXTURE, UNKNOWN, 'not measured: there is no pair of images', '', {}
        )
    median = float(np.median(sample.matches))
    poor = float(np.mean(np.array(sample.matches) < _FEW_MATCHES))
    few = median < _NO_MATCHES or poor > 0.3
    return by_case(
        Code.TEXTURE,
        f'{median:.0f} matches per pair in the median',
        {'median_matches': median, 'poor_share': poor},
        Case(
            few and health.state is WRONG,
            UNKNOWN,
            'check again with correct parameters: points are predicted with the gyro',
        ),
        Case(
            median < _NO_MATCHES,
            WRONG,
            'record a textured scene, in focus, with an exposure below 10 ms',
        ),
        Case(
            few,
            SUSPECT,
            'more light, more texture or slower motion',
            f', fewer than {_FEW_MATCHES} in {100 * poor:.0f} %',
        ),
    )


def _with_calibration(sample: FrontEndSample, scan: Scan, completion: Completion) -> Assessment:
    """Findings of the sample; if it is lost, the parameters that a calibration contradicts."""
    found = completion.found
    health = sample.health
    # No calibration finds another unit, nor axes that no rotation corrects, and it follows an
    # object in the view as the sample does.
    beyond = any(
        fault.code in (Code.GYRO_UNIT, Code.MOVING_OBJECT)
        or (fault.code is Code.AXES and not fault.estimated)
        for fault in health.faults
    )
    if found is None or scan.intrinsics is None or beyond or not sample.is_lost:
        return health
    wrong = check_recording.contradicted(
        found,
        completion.parameters.sensor,
        sensor_model(scan.intrinsics, completion.parameters.sensor),
    )
    if not wrong:
        return health
    named = {finding.code for finding in wrong}
    if not named.isdisjoint(_READOUT):
        named |= _READOUT
    unknown = {one.code: one for one in not_evaluated(named, wrong[0].code)}
    return Assessment(
        (
            *wrong,
            *(unknown.get(one.code, one) for one in health.findings if one.code not in named),
        )
    )


def quantity_findings(
    health: Assessment, reason: str, offset_doubt: float = 0.0
) -> Iterator[Line]:
    """Findings on the quantities, by the sample; `reason`: why there are none.

    `offset_doubt` [s]: 1 sigma of the time offset that the stamps of the gyro leave open.
    """
    for finding in health.findings:
        message, fix = text_of(finding)
        # A value without an effect on poses may be a trace of one that has an effect.
        is_trace = finding.state is OK and bool(health.faults)
        state = OK if is_trace else _state(finding)
        is_offset = finding.code is Code.TIME_OFFSET and state is SUSPECT
        if is_offset and _is_within(finding, offset_doubt):
            state = finding.state
        further = ''
        if state is not finding.state is OK:
            further = _MEASURE
        elif state is WRONG:
            further = 'check again afterwards: a large deviation hides others'
        why = Why.OFF if state is not finding.state is OK else finding.why
        fixes = '; '.join(filter(None, (fix, further)))
        yield Line(replace(finding, state=state, why=why), message, fixes)
    if not health.findings:
        for quantity in QUANTITIES:
            yield Line(quantity.unknown(Why.NOT_MEASURED), f'not measured: {reason}')


def _is_within(finding: Finding, doubt: float) -> bool:
    """Whether a value is as certain as a doubt of this sigma lets expect."""
    if finding.active is None or finding.estimate is None or finding.sigma is None:
        return False
    return abs(finding.estimate - finding.active) < _CERTAIN * math.hypot(finding.sigma, doubt)


def _state(finding: Finding) -> FindingState:
    """State of a parameter by itself: a certain deviation counts even if no pose suffers."""
    if (
        finding.active is None
        or finding.estimate is None
        or finding.sigma is None
        or _distance(finding) < _CERTAIN * finding.sigma
    ):
        return finding.state
    quantity = BY_CODE.get(Code.READOUT_TIME if finding.code in _READOUT else finding.code)
    if finding.state is WRONG or (
        quantity is not None and quantity.deviation(finding) > _GROSS * quantity.observable
    ):
        return WRONG
    return SUSPECT


def _distance(finding: Finding) -> float:
    """Of the estimated value from the active one; of the aspect, without what fx and fy share."""
    assert finding.estimate is not None and finding.active is not None
    if finding.code is not Code.ASPECT:
        return abs(finding.estimate - finding.active)
    fx, fy = finding.estimated
    active_fx, active_fy = finding.configured
    return abs(fy - fx * active_fy / active_fx)


def _not_configured(code: Code, completion: Completion, scan: Scan) -> Line:
    """A parameter that is not configured, by the calibration."""
    found = completion.found
    unknown = BY_CODE[code].unknown(Why.NOT_MEASURED, Code.PARAMETERS)
    if found is None:
        message = f'not configured, and not estimated: {completion.problem}'
        return Line(unknown, message, _MEASURE)
    estimate = found.rotation if code is Code.AXES else found.readout_time
    if not estimate.observable:
        message = f'not configured, and not observable: {estimate.remark}'
        return Line(unknown, message, _MEASURE)
    if code is Code.READOUT_TIME:
        size = abs(estimate.value)
        message = f'not configured; estimated {with_sigma(code, size, estimate.sigma)}'
        if estimate.value < 0.0:
            message += ', the last row first'
        measured = replace(unknown, estimated=(size,), sigma=estimate.sigma)
        return Line(measured, message, _MEASURE)
    message = (
        f'quat_cam_imu_xyzw not configured; nearest map {axes_text(found.axis_map)}, '
        f'{math.degrees(found.rotation.value):.1f} deg from it'
    )
    if len(scan.forces):
        down = -found.R_cam_imu @ scan.forces.mean(axis=0)
        axis = int(np.argmax(np.abs(down)))
        sides = (('left', 'right'), ('top', 'bottom'), ('back', 'front'))[axis]
        message += f'; gravity points to the {sides[int(down[axis] > 0.0)]} of the image'
    return Line(unknown, message, _MEASURE)


def _effect(scan: Scan, health: Assessment, parameters: Parameters) -> Line | None:
    """Displacement of the last row relative to the first by rotation alone [px]."""
    name = Code.ROLLING_SHUTTER
    intrinsics = scan.intrinsics
    rest = scan.rest
    if intrinsics is None or not len(scan.rates):
        return None
    configured = parameters.sensor.readout_time
    found = {finding.code: finding for finding in health.findings}.get(Code.READOUT_TIME)
    readout = configured
    source = ''
    state = OK
    if found is not None and found.estimate is not None and _state(found) in (SUSPECT, WRONG):
        readout = found.estimate
        source = ' as estimated'
    elif configured is None:
        readout = _EXAMPLE_READOUT
        source = ' (assumed; set readout_time)'
        state = UNKNOWN
    elif configured == 0.0:
        return by_case(
            name,
            'global shutter (readout_time 0)',
            {'readout_s': 0.0},
            Case(
                found is not None and found.state is OK, OK, '', ': no method needs to model rows'
            ),
            Case(True, UNKNOWN, '', ', which this recording does not confirm'),
        )
    assert readout is not None
    bias = np.array(parameters.imu.gyro_bias) if rest is None else rest.value
    rates = np.linalg.norm(scan.rates - bias, axis=1)
    median, high = (readout * intrinsics.fx * float(np.percentile(rates, p)) for p in (50, 95))
    method = (
        'is sufficient'
        if high < _NO_EFFECT
        else 'is not sufficient'
        if median > _STRONG_EFFECT
        else 'loses accuracy'
    )
    return by_case(
        name,
        f'rotation displaces the last row by {median:.1f} px relative to the '
        f'first in the median, {high:.1f} px at 95 %, at a readout time of '
        f'{1e3 * readout:.1f} ms{source}: a global-shutter method {method}',
        {'readout_s': readout, 'median_px': median, 'p95_px': high},
        Case(True, state),
    )
