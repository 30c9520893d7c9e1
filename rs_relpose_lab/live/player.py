"""Plays a bag into the ROS graph at bag time: a stand-in for camera and IMU drivers.

    python -m rs_relpose_lab.live.player bags/hand_held --wait-for-subscribers 10

For tests, the demo, the live benchmark and machines without ``ros2 bag``. Ends by itself after the
last message.
"""

import argparse
from array import array
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
import gc
from pathlib import Path
import struct
import sys
import time

import cv2
import numpy as np
import rclpy
from rclpy.duration import Duration
from rclpy.executors import ExternalShutdownException
from rclpy.node import Node
from rclpy.publisher import Publisher
from rclpy.qos import HistoryPolicy, QoSProfile, ReliabilityPolicy
from rclpy.serialization import deserialize_message, serialize_message
from rclpy.utilities import remove_ros_args
from sensor_msgs.msg import CompressedImage, Image

from rs_relpose_ros.bags import reader, sensor_topics
from rs_relpose_ros.errors import InputError, MissingInputError, RsRelposeError
from rs_relpose_ros.geometry.timing import NANOSECONDS, to_nanoseconds
from rs_relpose_ros.nodes.inputs import message_class

# -- endless play of a recording with periodic motion -----------------------------------------

# CDR: 4 bytes of encapsulation (the second one is the byte order), then sec and nanosec of the
# std_msgs/Header at the begin of the message.
_STAMP = slice(4, 12)
# The last images end this long before the last sample of the IMU [ns], which so covers their
# rows. [chosen: above the readout of an image]
_TAIL_NS = NANOSECONDS // 20
# Types of images.
_IMAGES = (sensor_topics.IMAGE, sensor_topics.COMPRESSED_IMAGE)


@dataclass(frozen=True, slots=True)
class Outgoing:
    """A serialised message, due so many nanoseconds after the first."""

    due_ns: int
    topic: str
    msgtype: str
    data: bytes


def repeated(messages: Sequence[Outgoing], period_ns: int, duration_ns: int) -> Iterator[Outgoing]:
    """Messages of one period repeatedly, each round's stamps and dues a period later.

    `messages`: in the order of `due_ns`; all begin with a header, and their stamps span one
        period.
    `duration_ns`: messages due later are left out. Images end 50 ms earlier, so that the IMU
        samples which cover their last rows are still published.
    """
    stamps = [stamp_of(message.data) for message in messages]
    if messages and max(stamps) - min(stamps) >= period_ns:
        raise InputError(
            f'the recording is {(max(stamps) - min(stamps)) / NANOSECONDS:.3f} s '
            f'long, and so has no period of {period_ns / NANOSECONDS:g} s'
        )
    # A message due after the period's end is sent among the first messages of the next round.
    order = sorted(range(len(messages)), key=lambda k: messages[k].due_ns % period_ns)
    rounds = 0
    while messages:
        for k in order:
            message = messages[k]
            repeat_ns = (rounds - message.due_ns // period_ns) * period_ns
            if repeat_ns < 0:
                continue
            due_ns = message.due_ns + repeat_ns
            if due_ns >= duration_ns:
                return
            if message.msgtype in _IMAGES and due_ns >= duration_ns - _TAIL_NS:
                continue
            yield Outgoing(
                due_ns,
                message.topic,
                message.msgtype,
                _with_stamp(message.data, stamps[k] + repeat_ns),
            )
        rounds += 1


def stamp_of(data: bytes) -> int:
    """Header stamp [ns] of a serialised message."""
    seconds, nanoseconds = struct.unpack(_time_format(data), data[_STAMP])
    return int(seconds) * NANOSECONDS + int(nanoseconds)


def _with_stamp(data: bytes, stamp_ns: int) -> bytes:
    # One copy: publishers take bytes only.
    stamp = struct.pack(_time_format(data), *divmod(stamp_ns, NANOSECONDS))
    return b''.join((data[: _STAMP.start], stamp, memoryview(data)[_STAMP.stop :]))


def _time_format(data: bytes) -> str:
    return '<iI' if data[1] & 1 else '>iI'


# -- the player -------------------------------------------------------------------------------

# Times at which a message was due and was published, on the monotonic clock [ns].
LOG_DTYPE = np.dtype(
    [('is_image', '?'), ('stamp_ns', '<i8'), ('due_ns', '<i8'), ('published_ns', '<i8')]
)

# Types that the node subscribes to: the player waits for these subscriptions.
_SENSOR_TYPES = (*_IMAGES, sensor_topics.CAMERA_INFO, sensor_topics.IMU)
# Queue length of the publishers. [chosen: a second of an IMU at 1 kHz]
_DEPTH = 1000
# Between the match on the publisher's side and that on the subscriber's, messages are lost [s].
_SETTLE = 0.5
# Best-effort messages are not acknowledged: time for the subscriber to read the last ones [s].
_LINGER = 0.2


def play(node: Node, options: argparse.Namespace) -> int:
    """Publish the bag with the options of `parse`; the number of messages published.

    Raises InputError, MissingInputError: no bag, no such topic, or no subscriber in time.
    """
    with reader.open_bag(options.bag) as bag:
        topics = _chosen(bag, options)
        publishers = {topic.name: _publisher(node, topic, options) for topic in topics}
        messages = _outgoing(bag, topics, options)
        if options.loop > 0.0:
            messages = repeated(
                list(messages), to_nanoseconds(options.loop), to_nanoseconds(options.duration)
            )
            # Garbage collection over so many objects would delay publishing.
            gc.collect()
            gc.freeze()
        if options.wait_for_subscribers > 0.0:
            _wait_for_subscribers(
                [publishers[topic.name] for topic in topics if topic.msgtype in _SENSOR_TYPES],
                options.subscriptions,
                options.wait_for_subscribers,
            )
        return _publish(messages, publishers, options)


def _chosen(bag: reader.Bag, options: argparse.Namespace) -> list[sensor_topics.Topic]:
    there = {topic.name for topic in bag.topics}
    for name in options.topics:
        if name not in there:
            raise MissingInputError(
                f'the bag {options.bag} has no topic {name}; it has {", ".join(sorted(there))}'
            )
    return [topic for topic in bag.topics if not options.topics or topic.name in options.topics]


def _publisher(node: Node, topic: sensor_topics.Topic, options: argparse.Namespace) -> Publisher:
    name = topic.name
    msgtype = topic.msgtype
    if options.decode and msgtype == sensor_topics.COMPRESSED_IMAGE:
        name = name.removesuffix('/compressed')
        msgtype = sensor_topics.IMAGE
    reliability = (
        ReliabilityPolicy.BEST_EFFORT if options.best_effort else ReliabilityPolicy.RELIABLE
    )
    return node.create_publisher(
        message_class(msgtype),
        name,
        QoSProfile(
            history=HistoryPolicy.KEEP_LAST,
            depth=_DEPTH if msgtype == sensor_topics.IMU else 10,
            reliability=reliability,
        ),
    )


def _wait_for_subscribers(publishers: Sequence[Publisher], least: int, seconds: float) -> None:
    counts: dict[str, int] = {}
    deadline = time.monotonic() + seconds
    while time.monotonic() < deadline and rclpy.ok():
        counts = {p.topic_name: p.get_subscription_count() for p in publishers}
        if all(counts.values()) and sum(counts.values()) >= least:
            time.sleep(_SETTLE)
            return
        time.sleep(0.02)
    if rclpy.ok():
        without = [topic for topic, count in counts.items() if not count]
        raise MissingInputError(
            (
                f'nobody subscribed to {", ".join(without)}'
                if without
                else f'{sum(counts.values())} of {least} subscriptions came'
            )
            + f' within {seconds:g} s: '
            'start the node first, and remap its topics to these names'
        )


def _outgoing(
    bag: reader.Bag, topics: Sequence[sensor_topics.Topic], options: argparse.Namespace
) -> Iterator[Outgoing]:
    first_ns: int | None = None
    images = 0
    for raw in bag.raw_messages(topics):
        first_ns = raw.bag_time_ns if first_ns is None else first_ns
        images += raw.msgtype in _IMAGES
        if raw.msgtype in _IMAGES and (images - 1) % options.every:
            continue
        data = bytes(raw.data)
        if options.decode and raw.msgtype == sensor_topics.COMPRESSED_IMAGE:
            compressed = deserialize_message(data, message_class(sensor_topics.COMPRESSED_IMAGE))
            data = bytes(serialize_message(_decoded(compressed, options.decode)))
        yield Outgoing(raw.bag_time_ns - first_ns, raw.topic, raw.msgtype, data)


def _decoded(compressed: CompressedImage, encoding: str) -> Image:
    flags = cv2.IMREAD_GRAYSCALE if encoding == 'mono8' else cv2.IMREAD_COLOR
    pixels = cv2.imdecode(
        np.frombuffer(compressed.data, np.uint8), flags | cv2.IMREAD_IGNORE_ORIENTATION
    )
    if pixels is None:
        raise InputError('a compressed image of the bag cannot be decoded: it is corrupt')
    data = array('B')
    data.frombytes(pixels.tobytes())
    return Image(
        header=compressed.header,
        height=pixels.shape[0],
        width=pixels.shape[1],
        encoding=encoding,
        step=pixels.shape[1] * pixels[0, 0].size,
        data=data,
    )


def _publish(
    messages: Iterator[Outgoing], publishers: dict[str, Publisher], options: argparse.Namespace
) -> int:
    count = start_ns = 0
    log: list[tuple[bool, int, int, int]] = []
    for message in messages:
        if count == 0:
            start_ns = time.monotonic_ns() - message.due_ns
        due_ns = start_ns + message.due_ns
        wait_ns = due_ns - time.monotonic_ns()
        if wait_ns > 0:
            time.sleep(wait_ns / NANOSECONDS)
        if not rclpy.ok():
            break
        now_ns = time.monotonic_ns()
        publishers[message.topic].publish(message.data)
        count += 1
        if options.log is not None and message.msgtype in (*_IMAGES, sensor_topics.IMU):
            log.append(
                (message.msgtype != sensor_topics.IMU, stamp_of(message.data), due_ns, now_ns)
            )
    if options.log is not None:
        np.save(options.log, np.array(log, dtype=LOG_DTYPE))
    if rclpy.ok():
        for publisher in publishers.values():
            publisher.wait_for_all_acked(Duration(seconds=1))
        time.sleep(_LINGER)
    return count


def parse(arguments: Sequence[str]) -> argparse.Namespace:
    """Options of a command line."""
    parser = argparse.ArgumentParser(
        prog='player', description='Play a bag into the ROS graph at bag time.'
    )
    parser.add_argument('bag', type=Path, help='rosbag2 directory, MCAP file or ROS 1 bag')
    parser.add_argument(
        '--best-effort',
        action='store_true',
        help='best-effort publishers instead of reliable ones',
    )
    parser.add_argument(
        '--decode',
        choices=('mono8', 'bgr8'),
        default='',
        help='publish compressed images raw in this encoding, on the topic without /compressed',
    )
    parser.add_argument(
        '--topics', nargs='+', default=(), metavar='TOPIC', help='only these topics of the bag'
    )
    parser.add_argument(
        '--every',
        type=int,
        default=1,
        metavar='N',
        help='publish each Nth image only, as a slower camera (default: all)',
    )
    parser.add_argument(
        '--wait-for-subscribers',
        type=float,
        default=0.0,
        metavar='SECONDS',
        help='longest wait for a subscription to each sensor topic; 0 (default) starts at once',
    )
    parser.add_argument(
        '--subscriptions',
        type=int,
        default=0,
        metavar='N',
        help='wait for so many to all sensor topics together, of several nodes',
    )
    parser.add_argument(
        '--loop',
        type=float,
        default=0.0,
        metavar='SECONDS',
        help='repeat a recording whose motion has this period, without a seam: '
        'stamps continue from round to round; everything is decoded ahead',
    )
    parser.add_argument(
        '--duration',
        type=float,
        default=60.0,
        metavar='SECONDS',
        help='with --loop: end after so many seconds (default: 60)',
    )
    parser.add_argument(
        '--log',
        type=Path,
        metavar='FILE',
        help='with --loop: write the times at which each image and IMU message '
        'was due and published (NPY, LOG_DTYPE)',
    )
    given = parser.parse_args(arguments)
    if given.loop < 0.0 or given.duration <= 0.0:
        parser.error('--loop and --duration must be positive')
    if given.every < 1:
        parser.error('--every must be at least 1')
    return given


def main(arguments: Sequence[str] | None = None) -> int:
    """Run the command; its exit code."""
    given = sys.argv if arguments is None else ['player', *arguments]
    options = parse(remove_ros_args(given)[1:])
    rclpy.init(args=list(given))
    node = rclpy.create_node('player')
    try:
        count = play(node, options)
        node.get_logger().info(f'played {count} messages of {options.bag}')
    except RsRelposeError as error:
        node.get_logger().fatal(str(error))
        return 2
    except (KeyboardInterrupt, ExternalShutdownException):
        return 0
    finally:
        node.destroy_node()
        rclpy.try_shutdown()
    return 0


if __name__ == '__main__':
    sys.exit(main())
