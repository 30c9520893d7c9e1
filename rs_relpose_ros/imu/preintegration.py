"""Acceleration of the IMU between two instants, preintegrated, with its covariance.

C. Forster, L. Carlone, F. Dellaert and D. Scaramuzza, *On-Manifold Preintegration for Real-Time
Visual-Inertial Odometry*, IEEE Transactions on Robotics 33(1), 2017: specific force f, turned by
the integrated gyro into the axes of the start, is integrated once and twice; errors of gyro,
accelerometer and gravity go in to first order. Here gravity g is known, and is part of both::

    a(s) = R(s) f(s) + g        beta = integral a        alpha = integral (T - s) a(s) ds
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from rs_relpose_ros.config.imu import ImuConfig
from rs_relpose_ros.geometry.gyro import integrated_rotations
from rs_relpose_ros.geometry.inertial import InertialMotion
from rs_relpose_ros.geometry.so3 import skew
from rs_relpose_ros.imu.forces import ForceSegment
from rs_relpose_ros.imu.frame_imu import FrameImu, GyroSegment

Array = NDArray[np.float64]


def preintegrate(seconds: Array, rates: Array, forces: Array, gravity: Array,
                 gravity_covariance: Array, lever_arm: Array, config: ImuConfig,
                 bias_sigma: float) -> InertialMotion:
    """Motion from the first to the last sample, in the axes of the first.

    Parameters
    ----------
    seconds : (K,) ndarray
        Increasing instants; rates and turned forces are linear in between.
    rates : (K, 3) ndarray
        Angular velocity, bias removed [rad/s].
    forces : (K, 3) ndarray
        Specific force [m/s^2].
    gravity : (3,) ndarray
        Of free fall, in the axes of the first sample [m/s^2].
    gravity_covariance : (3, 3) ndarray
    lever_arm : (3,) ndarray
        Position of the IMU in the frame in which all of this is given [m].
    bias_sigma : float
        Of the gyro's bias [rad/s] per axis.
    """
    steps, duration = np.diff(seconds), float(seconds[-1] - seconds[0])
    rotations = integrated_rotations(seconds, rates)
    turned = np.einsum('kij,kj->ki', rotations, forces)
    # Of a force that is linear from sample to sample.
    mean = 0.5 * (turned[1:] + turned[:-1]) * steps[:, None]
    gained = np.vstack([np.zeros(3), np.cumsum(mean, axis=0)])
    moved = (gained[:-1] * steps[:, None]
             + (2.0 * turned[:-1] + turned[1:]) * (steps**2 / 6.0)[:, None])
    travelled = np.vstack([np.zeros(3), np.cumsum(moved, axis=0)])
    beta = gained[-1] + duration * gravity
    alpha = travelled[-1] + 0.5 * duration**2 * gravity

    # Errors of alpha and beta: by a constant acceleration; by a bias, which turns with the IMU.
    by_constant = np.vstack([0.5 * duration**2 * np.eye(3), duration * np.eye(3)])
    middle = seconds[:-1] + 0.5 * steps
    left = seconds[-1] - middle
    halfway = rotations[:-1] @ Rotation.from_rotvec(
        0.25 * steps[:, None] * (rates[1:] + rates[:-1])).as_matrix()
    by_bias = np.vstack([np.einsum('k,kij->ij', left * steps, halfway),
                         np.einsum('k,kij->ij', steps, halfway)])
    # A rate error in step k turns what is felt after it: by -[F]x times the turn, F being that
    # force, integrated.
    later = gained[-1] - 0.5 * (gained[1:] + gained[:-1])
    later_way = (travelled[-1] - 0.5 * (travelled[1:] + travelled[:-1])
                 - 0.5 * (gained[1:] + gained[:-1]) * left[:, None])
    by_turn = np.stack([np.vstack([-skew(way), -skew(force)])
                        for way, force in zip(later_way, later, strict=True)])
    by_rates = by_turn @ halfway * steps[:, None, None]
    by_gyro = by_rates.sum(axis=0)
    # White noise of the accelerometer: the integrals of (T - s)^2, T - s and 1.
    of_noise = np.kron(np.array([[duration**3 / 3.0, duration**2 / 2.0],
                                 [duration**2 / 2.0, duration]]), np.eye(3))
    # b t = (v_1 + w_1 x p) T + alpha + p - R p,   R (v_2 + w_2 x p) = v_1 + w_1 x p + beta
    R = rotations[-1]
    by_arm = np.vstack([duration * skew(rates[0]) + np.eye(3) - R,
                        skew(rates[0]) - R @ skew(rates[-1])])
    covariance = (
        config.accel_noise_density**2 * of_noise
        + config.accel_bias_sigma**2 * by_bias @ by_bias.T
        + by_constant @ gravity_covariance @ by_constant.T
        + config.gyro_noise_density**2 * np.einsum('k,kij,klj->il', 1.0 / steps, by_rates,
                                                   by_rates)
        + bias_sigma**2 * by_gyro @ by_gyro.T
        + config.imu_position_sigma**2 * by_arm @ by_arm.T)
    return InertialMotion(alpha, beta, duration, covariance, lever_arm)


def inertial_motion(gyro: GyroSegment, forces: ForceSegment, frame1: FrameImu, frame2: FrameImu,
                    config: ImuConfig) -> InertialMotion | str:
    """Motion of the IMU between the stamped rows of two frames, or why there is none.

    `gyro` and `forces` reach from the one to the other.
    """
    first, second, sigma = frame1.force, frame2.force, frame2.gravity_sigma
    if isinstance(first, str):
        return first
    if isinstance(second, str):
        return second
    if frame2.motion.gravity is None or sigma is None:
        return 'the direction of gravity is not known'
    stamps_ns = np.union1d(gyro.stamps_ns, forces.stamps_ns)
    seconds = (stamps_ns - stamps_ns[0]) * 1e-9
    rates, felt = (np.column_stack([
        np.interp(seconds, (of_ns - stamps_ns[0]) * 1e-9, axis) for axis in values.T])
        for of_ns, values in ((gyro.stamps_ns, gyro.angular_velocities),
                              (forces.stamps_ns, forces.forces)))
    R = integrated_rotations(seconds, rates)[-1]
    # As the accelerometer reads it: its scale and bias along gravity drop out. Of the second
    # frame, which knows more.
    down = R @ frame2.motion.gravity
    down /= np.linalg.norm(down)
    along = np.outer(down, down)
    gravity = second.at_rest * down
    covariance = (second.at_rest * sigma) ** 2 * (np.eye(3) - along) \
        + second.at_rest_sigma**2 * along
    motion = preintegrate(seconds, rates, felt, gravity, covariance,
                          np.array(config.imu_position), config, gyro.bias_sigma)
    return replace(motion, acceleration1=first.within + gravity,
                   acceleration2=R @ second.within + gravity)
