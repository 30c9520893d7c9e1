"""Topics, frames and delays of the bags that the project writes."""

from __future__ import annotations

COMPRESSED_TOPIC = '/camera/image_raw/compressed'
RAW_TOPIC = '/camera/image_raw'
CAMERA_INFO_TOPIC = '/camera/camera_info'
IMU_TOPIC = '/imu/data_raw'
# Gyro and accelerometer of phones, which stamp them apart.
GYRO_TOPIC = '/imu/gyro'
ACCEL_TOPIC = '/imu/accel'
GROUND_TRUTH_TOPIC = '/ground_truth/pose'

CAMERA_FRAME = 'camera_optical_frame'
IMU_FRAME = 'imu_link'
WORLD_FRAME = 'world'

# How long after its stamp, and after the read-out of an image, a driver delivers a message [s].
IMAGE_DELAY = 0.005
IMU_DELAY = 0.002
