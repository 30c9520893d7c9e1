"""The relative pose of two images of a bag, however far apart, without ROS."""

# python3 docs/examples/loop_closure.py BAG PARAMETERS.yaml FIRST_STAMP_NS SECOND_STAMP_NS

from pathlib import Path
import sys

import cv2
import numpy as np
from rosbags.highlevel import AnyReader

from rs_relpose_ros import estimate_wide_pair, Frame, ImuBuffer, ImuSample, Intrinsics, view_frame
from rs_relpose_ros.config.files import read_parameters


def main(bag, parameter_file, *stamps):
    """Print R and t of the two images as three lines of four numbers."""
    stamps = sorted(map(int, stamps))
    images, info, samples = read_bag(Path(bag), stamps)
    if missing := [stamp for stamp in stamps if stamp not in images]:
        sys.exit(f'{bag} has no image of the stamp {missing[0]}')

    # Input, as a SLAM system has it: images, intrinsics, IMU samples, and the parameters of the
    # node. The buffer must still cover the first image when its view is created.
    parameters = read_parameters(Path(parameter_file), ['imu_buffer_seconds=60'])
    intrinsics = Intrinsics(
        width=info.width,
        height=info.height,
        image_width=info.width,
        image_height=info.height,
        fx=info.k[0],
        fy=info.k[4],
        cx=info.k[2],
        cy=info.k[5],
        distortion_model=info.distortion_model,
        distortion=tuple(info.d),
    )
    imu = ImuBuffer(parameters.imu)
    for sample in samples:
        imu.add(sample)
    frames = [Frame(stamp, images[stamp], info.header.frame_id, intrinsics) for stamp in stamps]
    first = view_frame(frames[0], imu, parameters)
    second = view_frame(frames[1], imu, parameters, since=first)

    pose = estimate_wide_pair(first, second, parameters).pose
    if pose:
        np.savetxt(sys.stdout, np.column_stack([pose.R, pose.t]), '%.6f')
    else:
        sys.exit(f'no pose: {pose.reason}')


def read_bag(path, stamps):
    """Gray images of some stamps, the CameraInfo and all IMU samples; topics of the demo's bag."""
    images = {}
    info = None
    samples = []
    with AnyReader([path]) as reader:
        for connection, _, data in reader.messages():
            message = reader.deserialize(data, connection.msgtype)
            stamp = message.header.stamp.sec * 10**9 + message.header.stamp.nanosec
            if connection.topic == '/camera/camera_info':
                info = message
            elif connection.topic == '/imu/data_raw':
                w = message.angular_velocity
                a = message.linear_acceleration
                samples.append(ImuSample(stamp, (w.x, w.y, w.z), (a.x, a.y, a.z)))
            elif connection.topic == '/camera/image_raw/compressed' and stamp in stamps:
                images[stamp] = cv2.imdecode(message.data, cv2.IMREAD_GRAYSCALE)
    return images, info, samples


if __name__ == '__main__':
    main(*sys.argv[1:])
