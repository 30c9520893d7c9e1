"""Health: what a wrong figure does, one by one; the parts of its mechanism, and figures applied."""

from __future__ import annotations

from dataclasses import dataclass, replace
import json
import math

import numpy as np
import pytest
from scipy.spatial.transform import Rotation, RotationSpline

from rs_relpose_ros.config.imu import ImuConfig
from rs_relpose_ros.config.parameters import Parameters
from rs_relpose_ros.estimator.estimate import estimate_relative_pose
from rs_relpose_ros.geometry.camera import RollingShutterCamera
from rs_relpose_ros.geometry.motion import FrameMotion
from rs_relpose_ros.health.deviation import (
    AXES,
    BIAS,
    DEVIATIONS,
    DISTORTION,
    FOCAL,
    OFFSET,
    READOUT,
    SCALE,
)
from rs_relpose_ros.health.findings import Finding, Health, HealthState, NOT_JUDGED, worst_of
from rs_relpose_ros.health.judge import causes, Effect, Told
from rs_relpose_ros.health.pair_information import pair_information, PairEvidence
from rs_relpose_ros.health.recursion import NOTHING_SEEN, PRIOR_SIGMA, Recursion
from rs_relpose_ros.health.tracked import Applied, NOTHING_APPLIED, Tracked
from rs_relpose_ros.health.turning import rotation_of_rays, TurnSums
from rs_relpose_ros.imu.integration import bias_jacobian, integrate_rotation, turn_sensitivity

MS = 1_000_000
NONE = np.zeros(DEVIATIONS)
R_CAM_IMU = Rotation.from_euler('xyz', [90, 0, 30], degrees=True)
CAMERA = RollingShutterCamera(
    width=640, height=480, fx=420.0, fy=420.0, cx=318.0, cy=242.0, readout_time=0.03,
    distortion=(-0.12, 0.03, 0.0, 0.0))
# Small, each a few hundredths of what may be told wrong: rad, s, s, rad/s, -, -, -.
SMALL = np.array([3e-3] * 3 + [2e-3, 2e-3] + [3e-3] * 3 + [0.01, 0.01, 0.01])


# -- exact pairs: an image is exposed by search, with nothing of the health's derivatives --------


@dataclass(frozen=True)
class Scene:
    """A camera that shakes while it flies past points; positions in metres."""

    turning: RotationSpline
    velocity: np.ndarray
    points: np.ndarray

    @classmethod
    def drawn(cls, seed=0, points=900):
        rng = np.random.default_rng(seed)
        times = np.arange(-1.0, 6.0, 0.4)
        angles = 0.12 * rng.normal(size=(len(times), 3))
        return cls(RotationSpline(times, Rotation.from_rotvec(angles)), np.array([0.9, 0.3, 0.4]),
                   rng.uniform([-4, -3, 4], [9, 4, 14], (points, 3)))

    def exposed(self, camera, start):
        """Pixels (N, 2) of a frame whose stamped row is exposed at `start` [s], and if it is."""
        tau = np.zeros(len(self.points))
        for _ in range(8):   # a row turns the camera by far less than a row
            local = self.turning(start + tau).inv().apply(
                self.points - (start + tau)[:, None] * self.velocity)
            pixels = camera.project(local)
            tau = np.nan_to_num(camera.row_times(pixels[:, 1]))
            tau = np.clip(tau, -0.1, 0.1)
        inside = (pixels >= 2).all(axis=1) & (pixels <= [637, 477]).all(axis=1)
        return pixels, inside & (local[:, 2] > 1.0)

    def gyro(self, start, end, c):
        """Instants (K,) [ns], and what the gyro says there (K, 3), in the camera's axes as told."""
        stamps_ns = np.round(np.linspace(start, end, 2 + int((end - start) * 1e3)) * 1e9)
        in_imu = (Rotation.from_rotvec(c[AXES]) * R_CAM_IMU).inv().apply(
            self.turning(1e-9 * stamps_ns, 1))
        return stamps_ns.astype(np.int64), R_CAM_IMU.apply((in_imu + c[BIAS]) / (1.0 + c[SCALE]))


def deviating(camera, c):
    """The camera with the deviations `c` of lens and read-out."""
    signed = camera.line_delay * camera.height + c[READOUT]
    first, *others = camera.distortion
    return replace(camera, fx=camera.fx / (1.0 + c[FOCAL]), fy=camera.fy / (1.0 + c[FOCAL]),
                   distortion=(first + c[DISTORTION], *others), readout_time=abs(signed),
                   readout_direction='down' if signed >= 0.0 else 'up')


def evidence(scene, start, end, c, camera=CAMERA):
    """A pair of frames whose images have the deviations `c` from what is told of them."""
    true = deviating(camera, c)
    places = [scene.exposed(true, time + c[OFFSET]) for time in (start, end)]
    seen = np.flatnonzero(places[0][1] & places[1][1])[:120]
    assert len(seen) > 80
    earliest, latest = camera.row_times([0.0, camera.height - 1.0])[
        :: 1 if camera.readout_direction == 'down' else -1]
    motions = []
    for time in (start, end):
        stamps_ns, rates = scene.gyro(time + earliest - 1e-3, time + latest + 1e-3, c)
        motions.append(FrameMotion.from_gyro(1e-9 * stamps_ns - time, rates))
    stamps_ns, rates = scene.gyro(start, end, c)
    rotation, covariance = integrate_rotation(stamps_ns, rates, ImuConfig())
    first, second = (scene.turning(time + c[OFFSET]) for time in (start, end))
    t = first.inv().apply(scene.velocity)
    return PairEvidence(
        places[0][0][seen], places[1][0][seen], camera, *motions, end - start,
        (first.inv() * second).as_matrix(), t / np.linalg.norm(t), rotation, covariance,
        turn_sensitivity(stamps_ns, rates, ImuConfig()), (rates[0], rates[-1]),
        R_CAM_IMU.as_matrix(), 0.01)


def flight(c, pairs=9, camera=CAMERA):
    scene = Scene.drawn()
    return [evidence(scene, 0.4 * k, 0.4 * k + 0.3, c, camera) for k in range(pairs)]


def solved(pairs, in_force, about):
    found = [pair_information(pair, in_force, about) for pair in pairs]
    return np.linalg.solve(sum(one.S for one in found), sum(one.b for one in found))
