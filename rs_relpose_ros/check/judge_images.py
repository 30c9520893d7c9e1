"""Verdicts on images and their calibration."""

from __future__ import annotations

from rs_relpose_ros.bags.topics import COMPRESSED_IMAGE, Topic
from rs_relpose_ros.calibrate.stamps import frame_times, Varying
from rs_relpose_ros.check.findings import Case, FAILURE, Finding, judged, Verdict, WARNING
from rs_relpose_ros.check.scan import Scan
from rs_relpose_ros.check.streams import Stamps
from rs_relpose_ros.config.parameters import Parameters
from rs_relpose_ros.messages.sensor_feed import Role

# Fast DDS with its default transports loses best-effort messages above this [bytes].
_BIG_MESSAGE = 512 * 1024
# Below this [Hz] tracks tear and keyframes lie far apart.
_SLOW = 8.0
_MISSED_SHARE = 0.05


def findings(seen: Scan, topic: Topic, reliability: str, parameters: Parameters) -> list[Finding]:
    """What is said of the images, their CameraInfo and their transport."""
    return [*_encoding(seen, topic, parameters), _rate(seen.image_stamps),
            stamp_finding('image stamps', seen.image_stamps, 'the camera', _varying(seen)),
            _calibration(seen),
            _transport(seen, topic, reliability)]


def stamp_finding(name: str, stamps: Stamps, of: str,
                  varying: Varying = Varying.JITTER) -> Finding:
    """Verdict on order and evenness of stamps; `varying`: why their intervals differ."""
    figures = {'jitter_s': stamps.jitter, 'repeated': stamps.repeated,
               'backwards': stamps.backwards, 'furthest_back_s': stamps.furthest_back,
               'delay_s': stamps.delay if stamps.count else None}
    if not stamps.interval > 0.0:
        return Finding(name, FAILURE, f'{stamps.count} message(s), no two of increasing stamps',
                       'record longer, and see what stamps the driver gives', figures)
    text = f'jitter {1e3 * stamps.jitter:.2f} ms'
    unordered = stamps.repeated + stamps.backwards
    if unordered:
        text += (f', {stamps.repeated} repeated, {stamps.backwards} back in time (by up to '
                 f'{stamps.furthest_back:.3f} s)')
    return judged(
        name, text, figures,
        Case(unordered > 0.2 * stamps.count, FAILURE,
             f'let the driver of {of} stamp each message with its own instant'),
        Case(stamps.furthest_back > 1.0, WARNING, 'the clock was set back or the bag holds two '
             'recordings: the node starts anew there; record with a steady clock'),
        Case(unordered > 0, WARNING,
             'these messages are not used: look for two publishers on the topic'),
        Case(stamps.jitter <= max(0.2 * stamps.interval, 1e-3), Verdict.OK, ''),
        Case(varying is Varying.EXPOSURE, Verdict.OK, 'the time offset moves with it: have '
             'time_offset_per_interval measured by "rs_relpose calibrate", or fix the exposure',
             ', which lasts for many frames each, as automatic exposure makes it'),
        Case(varying is Varying.JITTER, WARNING, 'that looks like times of '
             f'arrival: let {of} stamp in hardware, or at the interrupt'),
        Case(True, WARNING, f'see what {of} stamps',
             ', neither as of times of arrival nor as of automatic exposure'))


def _varying(seen: Scan) -> Varying:
    """Why the intervals between images differ."""
    stamps_ns = seen.stamps_ns
    return frame_times(stamps_ns).varying if len(stamps_ns) > 2 else Varying.UNCLEAR


def _encoding(seen: Scan, topic: Topic, parameters: Parameters) -> list[Finding]:
    sizes = ', '.join(f'{width}x{height}' for width, height in seen.sizes)
    figures = {'encodings': dict(seen.encodings), 'bad_images': seen.bad_images,
               'sizes': [list(size) for size in seen.sizes]}
    found = judged(
        'images', f'{sizes} {", ".join(seen.encodings)}'.strip(), figures,
        Case(seen.bad_images > 0, WARNING if seen.sizes else FAILURE,
             'publish raw images of a known encoding, or JPEG or PNG',
             f'; {seen.bad_images} cannot be used: {seen.problems.get(Role.IMAGE)}'),
        Case('image_rect' in topic.name, FAILURE, 'record the raw image: rectified rows have no '
             'one instant', f'; {topic.name} is rectified'),
        Case(len(seen.sizes) > 1, WARNING,
             'keep the resolution; the read-out time changes with it', ': the size changes'))
    compressed = topic.msgtype == COMPRESSED_IMAGE
    if compressed == (parameters.pair.image_transport == 'compressed'):
        return [found]
    right = 'compressed' if compressed else 'raw'
    return [found, Finding('transport', WARNING, f'the images are {right}',
                           f'set image_transport: {right} for the live node (replay finds the '
                           'topic by itself)', {'image_transport': right})]


def _rate(stamps: Stamps) -> Finding:
    name, interval, duration = 'image rate', stamps.interval, stamps.duration
    if not interval > 0.0:
        return Finding(name, FAILURE, f'{stamps.count} image(s) of different stamps or fewer',
                       'record at least some seconds', {'count': stamps.count})
    # Each longer step hides frames; 1.5 of a step is none too many even under auto exposure.
    gaps, longest = stamps.longer_than(1.7 * interval)
    missed = max(round(duration / interval) - stamps.count + 1, 0) if gaps else 0
    figures = {'rate_hz': 1.0 / interval, 'count': stamps.count, 'duration_s': duration,
               'gaps': gaps, 'longest_step_s': longest, 'missed': missed}
    text = f'{1.0 / interval:.1f} Hz, {stamps.count} in {duration:.1f} s'
    if gaps:
        text += f', about {missed} missed in {gaps} gaps, the longest {longest:.2f} s'
    return judged(
        name, text, figures,
        Case(1.0 / interval < _SLOW, WARNING, f'record at {_SLOW:g} Hz or more: points are lost '
             'between frames that lie far apart'),
        Case(missed > _MISSED_SHARE * stamps.count, WARNING, 'images are lost on the way: use '
             'config/fastdds.xml, compressed images, or a faster disk'))


def _calibration(seen: Scan) -> Finding:
    name, intrinsics = 'calibration', seen.intrinsics
    if intrinsics is None:
        return Finding(name, FAILURE, seen.problems.get(Role.CAMERA_INFO, 'no CameraInfo'),
                       'calibrate the camera (camera_calibration, OpenCV) and let its driver '
                       'publish the CameraInfo, or give camera_matrix: "rs_relpose calibrate" '
                       'finds its focal length')
    figures = {'fx': intrinsics.fx, 'fy': intrinsics.fy,
               'distortion_model': intrinsics.distortion_model, 'different': seen.calibrations}
    size = intrinsics.image_width, intrinsics.image_height
    other = next(iter(seen.sizes), size) if size not in seen.sizes else size
    straight = intrinsics.global_shutter_camera().is_undistorted
    wide = intrinsics.width > 2.0 * intrinsics.fx   # more than 90 deg
    return judged(
        name, f'{intrinsics.width}x{intrinsics.height}, f {intrinsics.fx:.1f} '
        f'{intrinsics.fy:.1f} px, {intrinsics.distortion_model}'
        + (' by camera_matrix' if seen.by_parameters else ''), figures,
        Case(other != size, FAILURE, 'publish the CameraInfo of this resolution, region of '
             'interest and binning included', f': for images of {size[0]}x{size[1]}, but they are '
             f'{other[0]}x{other[1]}'),
        Case(straight and wide, WARNING, 'right for a simulated or a rectifying camera only: '
             'otherwise calibrate it', ' without distortion'),
        Case(straight, Verdict.OK, '', ' without distortion'),
        Case(seen.calibrations > 1, WARNING,
             'each change starts the tracks anew: keep zoom and focus',
             f'; it changes {seen.calibrations - 1} times'))


def _transport(seen: Scan, topic: Topic, reliability: str) -> Finding:
    size = seen.largest_image
    offered = f'recorded as {reliability}' if reliability else 'reliability not recorded'
    return judged(
        'live transport', f'{topic.name} {offered}, up to {size / 1e3:.0f} kB per image',
        {'largest_bytes': size, 'reliability': reliability or None},
        Case(size > _BIG_MESSAGE, WARNING, 'live, Fast DDS loses most images above 512 KiB with '
             'its default transports: start driver and node with '
             'FASTRTPS_DEFAULT_PROFILES_FILE=.../config/fastdds.xml, or use image_transport: '
             'compressed'),
        Case(True, Verdict.OK, '', '; the node subscribes best effort, which matches both'))
