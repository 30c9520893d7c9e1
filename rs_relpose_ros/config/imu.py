"""Defaults of the IMU front end."""

from __future__ import annotations

from dataclasses import dataclass

from rs_relpose_ros.config.declarations import check_settings, setting

GRAVITY_FILTERS = ('complementary', 'mean')


@dataclass(frozen=True, slots=True)
class ImuConfig:
    """Noise of the sensors, the gravity filter, and what counts as a gap."""

    gyro_bias: tuple[float, ...] = setting(
        (0.0, 0.0, 0.0), 'gyro bias in the IMU frame, subtracted', 'rad/s', low=-1.0, high=1.0,
        length=3)
    gyro_noise_density: float = setting(
        2e-4, 'white noise of the gyro', 'rad/s/sqrt(Hz)', low=1e-7, high=0.1)
    gyro_bias_sigma: float = setting(
        3e-3, 'uncertainty of gyro_bias, 1 sigma per axis', 'rad/s', low=0.0, high=1.0)
    accel_noise_density: float = setting(
        3e-3, 'white noise of the accelerometer', 'm/s^2/sqrt(Hz)', low=1e-6, high=10.0)
    accel_bias_sigma: float = setting(
        0.1, 'bias of the accelerometer beyond what gravity takes in, 1 sigma per axis', 'm/s^2',
        low=0.0, high=10.0)
    imu_position: tuple[float, ...] = setting(
        (0.0, 0.0, 0.0), 'position of the IMU in the camera frame', 'm', low=-5.0, high=5.0,
        length=3)
    imu_position_sigma: float = setting(
        0.03, 'uncertainty of imu_position, 1 sigma per axis', 'm', low=0.0, high=5.0)
    track_gyro_bias: bool = setting(
        True, 'take the gyro bias anew whenever the IMU stands still (within 4 gyro_bias_sigma)')
    use_imu_orientation: bool = setting(
        True, 'gravity from the orientation of the IMU message where its covariance says that '
        'there is one, as long as it agrees with the accelerometer')
    gravity_filter: str = setting(
        'complementary', 'gravity from gyro and accelerometer (complementary), or the mean '
        'specific force of the last 0.1 s as in the paper (mean)', choices=GRAVITY_FILTERS)
    gravity_time_constant: float = setting(
        5.0, 'time constant of the complementary filter at rest', 's', low=0.05, high=100.0)
    gravity_acceleration_sigma: float = setting(
        1.0, 'hand-held acceleration that the gravity filter expects, 1 sigma per axis', 'm/s^2',
        low=0.01, high=20.0)
    max_imu_gap: float = setting(
        0.05, 'longest step between gyro samples that is interpolated', 's', low=1e-3, high=1.0)
    stuck_gyro_time: float = setting(
        0.025, 'a gyro that repeats its values bit by bit for longer hangs or is saturated, and '
        'is not used; 0 believes it, for simulations without noise', 's', low=0.0, high=10.0)
    imu_buffer_seconds: float = setting(
        5.0, 'length of IMU history kept', 's', low=1.0, high=60.0)

    def __post_init__(self) -> None:
        check_settings(self)
