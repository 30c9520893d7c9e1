"""A hand-held walk that is known exactly, as smoothed keyframes and IMU samples."""

import numpy as np
from scipy.spatial.transform import Rotation

from rs_relpose_lab.simulation.motions import hand_held, Plan
from rs_relpose_lab.simulation.simulation import ImuModel
from rs_relpose_ros.imu.buffer import ImuSample, ImuSamples
from rs_relpose_ros.odometry.rows import Knot

START_NS = 1_700_000_000_000_000_000
OFFSET_NS = 30_000_000   # the clock of the IMU less that of the camera
C = Rotation.from_quat((0.502457, -0.504378, 0.507698, 0.485163)).as_matrix()
LEVER = np.array([0.03, 0.01, -0.02])   # of the IMU in the camera
BASE = Rotation.from_rotvec([0.3, -0.2, 0.5]).as_matrix(), np.array([0.2, -0.1, 0.4])
BIASES = np.array([0.011, -0.007, 0.005]), np.array([0.06, -0.04, 0.05])
# R and p on the IMU of camera, IMU and base.
MOUNTS = np.array([np.column_stack(mount) for mount in (
    (C.T, -C.T @ LEVER), (np.eye(3), np.zeros(3)), (C.T @ BASE[0], C.T @ (BASE[1] - LEVER)))])



def known_path():
    return hand_held(np.random.default_rng(5), -1.0, 7.0, Plan.parse('walk:5'), speed=1.6,
                     rotation_rate=0.8)


def knots(path, times, *, bias_error=0.0, noise=0.0):
    """Keyframes of the path; the errors are of biases, and of positions [m]."""
    rng = np.random.default_rng(1)
    states = path.states(times)
    found = []
    for k, seconds in enumerate(times):
        R_cam, w = states.R_world_cam[k], states.angular_velocity[k]
        ns = START_NS + round(seconds * 1e9)
        found.append(Knot(
            ns - OFFSET_NS, ns, R_cam @ C,
            states.position[k] + R_cam @ LEVER + noise * rng.standard_normal(3),
            states.velocity[k] + R_cam @ np.cross(w, LEVER),
            BIASES[0] + bias_error * 0.1, BIASES[1] + bias_error,
            (k + 1.0) * np.diag([1e-4, 2e-4, 3e-4, 1e-6, 2e-6, 3e-6])))
    return found


def samples(path, first, last, rate=400.0):
    times = np.arange(first, last, 1.0 / rate)
    gyro, accel = ImuModel(C, LEVER, *BIASES).measure(
        path.states(times), np.random.default_rng(0))
    buffer = ImuSamples(0.05)
    for seconds, w, f in zip(times, gyro, accel, strict=True):
        buffer.add(ImuSample(START_NS + round(seconds * 1e9), tuple(w), tuple(f)))
    return buffer
