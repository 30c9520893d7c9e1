"""Sends or receives images of 1920x1080 bgr8 at 30 Hz: python test/big_images.py send|receive N.

The receiver only counts what arrives: what is lost is lost by the transport.
"""

from array import array
import sys
import time
from typing import Any

import rclpy
from rclpy.qos import qos_profile_sensor_data
from sensor_msgs.msg import Image

WIDTH = 1920
HEIGHT = 1080
RATE = 30.0
TOPIC = '/big_image'
PATIENCE = 60.0


def send(node: Any, count: int) -> None:
    publisher = node.create_publisher(Image, TOPIC, qos_profile_sensor_data)
    image = Image(
        width=WIDTH,
        height=HEIGHT,
        encoding='bgr8',
        step=3 * WIDTH,
        data=array('B', bytes(3 * WIDTH * HEIGHT)),
    )
    deadline = time.monotonic() + PATIENCE
    while not publisher.get_subscription_count() and time.monotonic() < deadline:
        time.sleep(0.02)
    started = time.monotonic()
    for number in range(count):
        image.header.stamp.sec = number
        publisher.publish(image)
        time.sleep(max(0.0, started + (number + 1) / RATE - time.monotonic()))
    time.sleep(1.0)


def receive(node: Any, count: int) -> None:
    received: list[bytes] = []
    # As they come from the wire: what Python makes of them is another matter.
    node.create_subscription(
        Image, TOPIC, lambda raw: received.append(raw[4:8]), qos_profile_sensor_data, raw=True
    )
    print('ready', flush=True)
    deadline = time.monotonic() + PATIENCE
    last = (count - 1).to_bytes(4, 'little')
    while last not in received and time.monotonic() < deadline:
        rclpy.spin_once(node, timeout_sec=0.2)
    print(f'received {len(set(received))}', flush=True)


if __name__ == '__main__':
    rclpy.init()
    role = sys.argv[1]
    count = int(sys.argv[2])
    (send if role == 'send' else receive)(rclpy.create_node(f'big_images_{role}'), count)
    rclpy.shutdown()
