"""Verdicts on images and their calibration."""

from __future__ import annotations

from rs_relpose_ros.bags.topics import COMPRESSED_IMAGE, Topic
from rs_relpose_ros.check.findings import Finding, Verdict
from rs_relpose_ros.check.scan import Scan
from rs_relpose_ros.check.streams import Stamps, StampSummary
from rs_relpose_ros.config.parameters import Parameters

# Fast DDS with its default transports loses best-effort messages above this [bytes].
_BIG_MESSAGE = 512 * 1024
# Below this [Hz] tracks tear and keyframes lie far apart.
_SLOW = 8.0
_MISSED_SHARE = 0.05


def findings(seen: Scan, topic: Topic, reliability: str, parameters: Parameters) -> list[Finding]:
    """What is said of the images, their CameraInfo and their transport."""
    stamps = seen.image_stamps.summary()
    return [*_encoding(seen, topic, parameters), _rate(seen.image_stamps, stamps),
            stamp_finding('image stamps', stamps, 'the camera'), _calibration(seen),
            _transport(seen, topic, reliability)]


def stamp_finding(name: str, stamps: StampSummary, of: str) -> Finding:
    """Verdict on order and evenness of stamps."""
    figures = {'jitter_s': stamps.jitter, 'repeated': stamps.repeated,
               'backwards': stamps.backwards, 'furthest_back_s': stamps.furthest_back,
               'delay_s': stamps.delay if stamps.count else None}
    if not stamps.interval > 0.0:
        return Finding(name, Verdict.FAILURE, f'{stamps.count} message(s), no two of increasing '
                       'stamps', 'record longer, and see what stamps the driver gives', figures)
    text = f'jitter {1e3 * stamps.jitter:.2f} ms'
    if stamps.repeated or stamps.backwards:
        text += (f', {stamps.repeated} repeated, {stamps.backwards} back in time (by up to '
                 f'{stamps.furthest_back:.3f} s)')
    if stamps.repeated + stamps.backwards > 0.2 * stamps.count:
        return Finding(name, Verdict.FAILURE, text,
                       f'let the driver of {of} stamp each message with its own instant', figures)
    if stamps.furthest_back > 1.0:
        return Finding(name, Verdict.WARNING, text, 'the clock was set back or the bag holds two '
                       'recordings: the node starts anew there; record with a steady clock',
                       figures)
    if stamps.repeated or stamps.backwards:
        return Finding(name, Verdict.WARNING, text, 'these messages are not used: look for two '
                       'publishers on the topic', figures)
    if stamps.jitter > max(0.2 * stamps.interval, 1e-3):
        return Finding(name, Verdict.WARNING, text, f'that looks like times of arrival: let {of} '
                       'stamp in hardware, or at the interrupt', figures)
    return Finding(name, Verdict.OK, text, figures=figures)


def _encoding(seen: Scan, topic: Topic, parameters: Parameters) -> list[Finding]:
    names = ', '.join(seen.encodings)
    sizes = ', '.join(f'{width}x{height}' for width, height in seen.sizes)
    figures = {'encodings': dict(seen.encodings), 'bad_images': seen.bad_images,
               'sizes': [list(size) for size in seen.sizes]}
    text = f'{sizes} {names}'.strip()
    if seen.bad_images:
        verdict = Verdict.FAILURE if not seen.sizes else Verdict.WARNING
        found = Finding('images', verdict, f'{text}; {seen.bad_images} cannot be used: '
                        f'{seen.image_problem}', 'publish raw images of a known encoding, or '
                        'JPEG or PNG', figures)
    elif 'image_rect' in topic.name:
        found = Finding('images', Verdict.FAILURE, f'{text}; {topic.name} is rectified',
                        'record the raw image: rectified rows have no one instant', figures)
    elif len(seen.sizes) > 1:
        found = Finding('images', Verdict.WARNING, f'{text}: the size changes',
                        'keep the resolution; the read-out time changes with it', figures)
    else:
        found = Finding('images', Verdict.OK, text, figures=figures)
    compressed = topic.msgtype == COMPRESSED_IMAGE
    told = parameters.pair.image_transport == 'compressed'
    if compressed == told:
        return [found]
    right = 'compressed' if compressed else 'raw'
    return [found, Finding('transport', Verdict.WARNING, f'the images are {right}',
                           f'set image_transport: {right} for the live node (replay finds the '
                           'topic by itself)', {'image_transport': right})]


def _rate(stream: Stamps, stamps: StampSummary) -> Finding:
    if not stamps.interval > 0.0:
        return Finding('image rate', Verdict.FAILURE, f'{stamps.count} image(s) of different '
                       'stamps or fewer', 'record at least some seconds', {'count': stamps.count})
    rate = 1.0 / stamps.interval
    # Each longer step hides frames; 1.5 of a step is none too many even under auto exposure.
    gaps, longest = stream.longer_than(1.7 * stamps.interval)
    missed = max(round(stamps.duration / stamps.interval) - stamps.count + 1, 0) if gaps else 0
    figures = {'rate_hz': rate, 'count': stamps.count, 'duration_s': stamps.duration,
               'gaps': gaps, 'longest_step_s': longest, 'missed': missed}
    text = f'{rate:.1f} Hz, {stamps.count} in {stamps.duration:.1f} s'
    if gaps:
        text += f', about {missed} missed in {gaps} gaps, the longest {longest:.2f} s'
    if rate < _SLOW:
        return Finding('image rate', Verdict.WARNING, text, f'record at {_SLOW:g} Hz or more: '
                       'points are lost between frames that lie far apart', figures)
    if missed > _MISSED_SHARE * stamps.count:
        return Finding('image rate', Verdict.WARNING, text, 'images are lost on the way: use '
                       'config/fastdds.xml, compressed images, or a faster disk', figures)
    return Finding('image rate', Verdict.OK, text, figures=figures)


def _calibration(seen: Scan) -> Finding:
    name, intrinsics = 'calibration', seen.intrinsics
    if intrinsics is None:
        text = seen.calibration_problem or 'no CameraInfo'
        return Finding(name, Verdict.FAILURE, text, 'calibrate the camera (camera_calibration, '
                       'OpenCV) and let its driver publish the CameraInfo')
    text = (f'{intrinsics.width}x{intrinsics.height}, f {intrinsics.fx:.1f} '
            f'{intrinsics.fy:.1f} px, {intrinsics.distortion_model}')
    figures = {'fx': intrinsics.fx, 'fy': intrinsics.fy,
               'distortion_model': intrinsics.distortion_model,
               'different': seen.calibrations}
    size = intrinsics.image_width, intrinsics.image_height
    if seen.sizes and size not in seen.sizes:
        width, height = next(iter(seen.sizes))
        return Finding(name, Verdict.FAILURE, f'{text}: for images of {size[0]}x{size[1]}, but '
                       f'they are {width}x{height}', 'publish the CameraInfo of this resolution, '
                       'region of interest and binning included', figures)
    if intrinsics.global_shutter_camera().is_undistorted:
        wide = intrinsics.width > 2.0 * intrinsics.fx   # more than 90 deg
        return Finding(name, Verdict.WARNING if wide else Verdict.OK, f'{text} without '
                       'distortion', 'right for a simulated or a rectifying camera only: '
                       'otherwise calibrate it' if wide else '', figures)
    if seen.calibrations > 1:
        return Finding(name, Verdict.WARNING, f'{text}; it changes {seen.calibrations - 1} times',
                       'each change starts the tracks anew: keep zoom and focus', figures)
    return Finding(name, Verdict.OK, text, figures=figures)


def _transport(seen: Scan, topic: Topic, reliability: str) -> Finding:
    size = seen.largest_image
    figures = {'largest_bytes': size, 'reliability': reliability or None}
    offered = f'recorded as {reliability}' if reliability else 'reliability not recorded'
    text = f'{topic.name} {offered}, up to {size / 1e3:.0f} kB per image'
    if size > _BIG_MESSAGE:
        return Finding('live transport', Verdict.WARNING, text, 'live, Fast DDS loses most images '
                       'above 512 KiB with its default transports: start driver and node with '
                       'FASTRTPS_DEFAULT_PROFILES_FILE=.../config/fastdds.xml, or use '
                       'image_transport: compressed', figures)
    return Finding('live transport', Verdict.OK, f'{text}; the node subscribes best effort, which '
                   'matches both', figures=figures)
