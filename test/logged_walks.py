"""A simulated walk as the loggers of phones, data sets and calibration tools write it."""

from collections.abc import Iterable, Sequence
from dataclasses import replace
from fractions import Fraction
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from rs_relpose_lab.simulation.config import SimulationConfig
from rs_relpose_lab.simulation.simulation import simulate, Simulation

GRAVITY = 9.80665
# A back camera in landscape: x is minus the phone's y, and so on.
PHONE_AXES = Rotation.from_matrix([[0, -1, 0], [-1, 0, 0], [0, 0, -1]])
START_NS = 1_650_000_123_456_000_000
OF_WALK = {
    'duration': 1.75,
    'fps': 8.0,
    'seed': 41,
    'plan': 'walk:1.75',
    'width': 192,
    'height': 144,
    'fx': 140.0,
    'readout_time': 0.024,
    'imu_rate': 125.0,
    'gyro_bias': (0.0, 0.0, 0.0),
    'accel_bias': (0.0, 0.0, 0.0),
    'start_ns': START_NS,
}


def phone_walk() -> Simulation:
    quaternion = tuple(float(value) for value in PHONE_AXES.as_quat().round(9))
    config = SimulationConfig(**OF_WALK, quat_cam_imu_xyzw=quaternion, lever_arm=(0.0, 0.0, 0.0))
    return simulate(config)


class Upright:
    """A walk whose logger rotates images clockwise by a quarter turn, and the lens with them."""

    def __init__(self, walk: Simulation) -> None:
        self._walk = walk
        camera = walk.camera
        self.camera = replace(
            camera,
            width=camera.height,
            height=camera.width,
            fx=camera.fy,
            fy=camera.fx,
            cx=camera.height - 1 - camera.cy,
            cy=camera.cx,
        )

    def image(self, index: int) -> np.ndarray:
        return np.ascontiguousarray(np.rot90(self._walk.image(index), -1))

    def __getattr__(self, name: str) -> Any:
        return getattr(self._walk, name)


def lens_of(walk: Simulation | Upright) -> list[float]:
    camera = walk.camera
    return [camera.fx, camera.fy, camera.cx, camera.cy]


def lines(path: Path, rows: Iterable[Sequence[object]], header: str = '', separator: str = ','):
    path.parent.mkdir(parents=True, exist_ok=True)
    texts = [separator.join(map(str, row)) for row in rows]
    path.write_text('\n'.join([header] * bool(header) + texts) + '\n')


def stamps(walk: Simulation) -> list[int]:
    return [walk.stamp_ns(index) for index in range(walk.config.frame_count)]


def write_movie(path: Path, walk: Simulation) -> None:
    av = pytest.importorskip('av', reason='needs the extra video')
    path.parent.mkdir(parents=True, exist_ok=True)
    with av.open(str(path), 'w', format='mp4') as container:
        stream = container.add_stream('mpeg4', rate=8)
        stream.width = walk.camera.width
        stream.height = walk.camera.height
        stream.pix_fmt = 'yuv420p'
        stream.codec_context.time_base = Fraction(1, 8)
        stream.bit_rate = 8_000_000
        for index in range(walk.config.frame_count):
            gray = walk.image(index)
            frame = av.VideoFrame.from_ndarray(cv2.merge([gray] * 3), format='bgr24')
            frame.pts = index
            frame.time_base = Fraction(1, 8)
            container.mux(stream.encode(frame))
        container.mux(stream.encode())


def samples(walk: Simulation) -> list[tuple[int, np.ndarray, np.ndarray]]:
    imu = walk.imu
    return list(
        zip(imu.stamps_ns.tolist(), imu.angular_velocities, imu.linear_accelerations, strict=True)
    )


def seconds(time_ns: int) -> str:
    return f'{time_ns // 10**9}.{time_ns % 10**9:09d}'


def sensor_logger(folder: Path, walk: Simulation, *, apple: bool) -> Path:
    """Columns in the order z, y, x; of Apple without TotalAcceleration, with the other sign."""
    sign = -1.0 if apple else 1.0
    # Any split of the specific force into gravity and the rest: a slow part and what is left.
    forces = walk.imu.linear_accelerations
    slow = np.stack([np.full(len(forces), mean) for mean in forces.mean(axis=0)], axis=1)
    tables = {
        'Gyroscope': walk.imu.angular_velocities,
        'Gravity': sign * slow,
        'Accelerometer': sign * (forces - slow),
    }
    if not apple:
        tables['TotalAcceleration'] = forces
    for name, vectors in tables.items():
        rows = [
            [stamp, (stamp - START_NS) * 1e-9, *vector[::-1]]
            for stamp, vector in zip(walk.imu.stamps_ns.tolist(), vectors, strict=True)
        ]
        lines(folder / f'{name}.csv', rows, 'time,seconds_elapsed,z,y,x')
    platform = 'ios' if apple else 'android'
    lines(folder / 'Metadata.csv', [[3, platform, 'false']], 'version,platform,standardisation')
    write_movie(folder / 'Camera' / f'{START_NS // 10**6}.mp4', walk)
    return folder


def ios_logger(folder: Path, walk: Simulation) -> Path:
    write_movie(folder / 'Frames.m4v', walk)
    frames = [[seconds(stamp), k, *lens_of(walk)] for k, stamp in enumerate(stamps(walk))]
    lines(folder / 'Frames.txt', frames)
    lines(folder / 'Gyro.txt', [[seconds(stamp), *rate] for stamp, rate, _ in samples(walk)])
    accelerations = [[seconds(stamp), *(-force / GRAVITY)] for stamp, _, force in samples(walk)]
    lines(folder / 'Accel.txt', accelerations)
    return folder


def stray_scanner(folder: Path, walk: Simulation) -> Path:
    """Stamps since boot; the separator is ', '; acceleration before rates."""
    boot_ns = START_NS - 77 * 10**9
    write_movie(folder / 'rgb.mp4', walk)
    states = walk.states(stamps(walk))
    quaternions = Rotation.from_matrix(states.R_world_cam).as_quat()
    poses = [
        [seconds(stamp - boot_ns), f'{k:06d}', *states.position[k], *quaternions[k]]
        for k, stamp in enumerate(stamps(walk))
    ]
    head = 'timestamp, frame, x, y, z, qx, qy, qz, qw'
    lines(folder / 'odometry.csv', poses, head, ', ')
    rows = [
        [seconds(stamp - boot_ns), *(-force / GRAVITY), *rate]
        for stamp, rate, force in samples(walk)
    ]
    lines(folder / 'imu.csv', rows, 'timestamp, a_x, a_y, a_z, alpha_x, alpha_y, alpha_z', ', ')
    fx, fy, cx, cy = lens_of(walk)
    lines(folder / 'camera_matrix.csv', [[fx, 0, cx], [0, fy, cy], [0, 0, 1]], separator=', ')
    return folder


def opencamera_sensors(folder: Path, walk: Simulation) -> Path:
    """The stamp is the last column; tables are in a folder of their own."""
    name = 'VID_20220102_030405'
    inner = folder / '20220102_030405'
    write_movie(folder / f'{name}.mp4', walk)
    lines(inner / f'{name}_timestamps.csv', [[stamp] for stamp in stamps(walk)])
    lines(inner / f'{name}_gyro.csv', [[*rate, stamp] for stamp, rate, _ in samples(walk)])
    lines(inner / f'{name}_accel.csv', [[*force, stamp] for stamp, _, force in samples(walk)])
    return folder


def tables(folder: Path, walk: Simulation, *, spreadsheet: bool = False) -> Path:
    """`spreadsheet`: with a byte order mark, CRLF, semicolons, decimal commas and empty lines."""
    write_movie(folder / 'clip.mp4', walk)
    lines(folder / 'frames.csv', [[stamp] for stamp in stamps(walk)], 'stamp_ns')
    rates = [[stamp, *rate] for stamp, rate, _ in samples(walk)]
    forces = [[stamp, *force] for stamp, _, force in samples(walk)]
    lines(folder / 'gyro.csv', rates, 'stamp_ns,x,y,z')
    lines(folder / 'accel.csv', forces, 'stamp_ns,x,y,z')
    if spreadsheet:
        for path in folder.glob('*.csv'):
            text = path.read_text().replace(',', ';').replace('.', ',').replace('\n', '\r\n')
            path.write_bytes(b'\xef\xbb\xbf' + text.encode() + b'\r\n;;;\r\n\r\n')
    return folder


def body_from_camera(walk: Simulation) -> np.ndarray:
    T_cam_imu = np.eye(4)
    T_cam_imu[:3, :3] = walk.config.R_cam_imu
    T_cam_imu[:3, 3] = walk.config.lever_arm
    return np.linalg.inv(T_cam_imu)


def euroc(folder: Path, walk: Simulation) -> Path:
    """Poses are those of the IMU, with w first; a sensor.yaml for camera and IMU."""
    root = folder / 'mav0'
    T = body_from_camera(walk)
    (root / 'cam0' / 'data').mkdir(parents=True)
    for index, stamp in enumerate(stamps(walk)):
        cv2.imwrite(str(root / 'cam0' / 'data' / f'{stamp}.png'), walk.image(index))
    rows = [[stamp, f'{stamp}.png'] for stamp in stamps(walk)]
    lines(root / 'cam0' / 'data.csv', rows, '#timestamp [ns],filename')
    (root / 'cam0' / 'sensor.yaml').write_text(
        'sensor_type: camera\ncomment: made\n'
        f'T_BS:\n  cols: 4\n  rows: 4\n  data: {T.ravel().tolist()}\n'
        f'resolution: [{walk.camera.width}, {walk.camera.height}]\ncamera_model: pinhole\n'
        f'intrinsics: {lens_of(walk)}\ndistortion_model: radial-tangential\n'
        f'distortion_coefficients: {list(walk.camera.distortion[:4])}\n'
    )
    rows = [[stamp, *rate, *force] for stamp, rate, force in samples(walk)]
    lines(root / 'imu0' / 'data.csv', rows, '#timestamp [ns],w_x,w_y,w_z,a_x,a_y,a_z')
    states = walk.states(walk.imu.stamps_ns)
    R_world_cam = Rotation.from_matrix(states.R_world_cam)
    of_body = R_world_cam * Rotation.from_matrix(T[:3, :3]).inv()
    camera_in_body = of_body.apply(T[:3, 3])
    poses = []
    for k, stamp in enumerate(walk.imu.stamps_ns.tolist()):
        x, y, z, w = of_body.as_quat()[k]
        poses.append([stamp, *(states.position[k] - camera_in_body[k]), w, x, y, z, *[0.0] * 9])
    lines(root / 'state_groundtruth_estimate0' / 'data.csv', poses, '#timestamp, p, q, v, b')
    return folder
