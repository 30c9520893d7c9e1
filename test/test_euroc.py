"""Real global-shutter recordings with metric truth: gyro, gravity and two-view poses.

`euroc_imu_april_corners`: corners of a planar AprilGrid, found in 1400 images of a hand-held
VI-Sensor, with its IMU. `euroc_v101_10frames`: ten images in flight with poses by Vicon.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
import io
import tarfile

import cv2
import numpy as np
import pytest
from scipy.optimize import least_squares
from scipy.spatial.transform import Rotation
import yaml

from rs_relpose_ros.config.estimator import EstimatorConfig
from rs_relpose_ros.config.imu import ImuConfig
from rs_relpose_ros.config.tracking import TrackingConfig
from rs_relpose_ros.estimator.estimate import estimate_relative_pose
from rs_relpose_ros.geometry.camera import RollingShutterCamera
from rs_relpose_ros.imu.buffer import Coverage, ImuBuffer
from rs_relpose_ros.imu.frame_imu import frame_imu
from rs_relpose_ros.imu.samples import ImuSample
from rs_relpose_ros.tracking.tracker import make_tracker

pytestmark = pytest.mark.recordings

# README of the recording: fitted to gyro against the images' rotation.
GYRO_BIAS = (-0.0016, 0.0250, 0.0777)
# config.yaml of the recording: noise of its ADIS16448. The bias was fitted, on this sensor.
IMU = ImuConfig(gyro_bias=GYRO_BIAS, gyro_noise_density=1.7e-4, gyro_bias_sigma=3e-3,
                imu_buffer_seconds=60.0)
# In flight, on another day, the bias of the same sensor is believed to a thousandth: the flight
# agrees with the images to that.
IN_FLIGHT = replace(IMU, gyro_bias_sigma=1e-3)
CALIBRATED = [458.654, 457.296, 367.215, 248.375], [-0.28340811, 0.07395907, 0.00019359,
                                                    1.76187114e-05]
HALF_SECOND = 500_000_000


def body_from_camera(recordings, camera):
    """T_BS (4, 4): body (the IMU) from camera."""
    text = (recordings / 'euroc_v101_10frames' / f'{camera}_sensor.yaml').read_text()
    T = yaml.safe_load(text.split('\n', 1)[1])['T_BS']['data']   # the first line is %YAML
    return np.array(T).reshape(4, 4)


def R_cam_imu(recordings, camera):
    return body_from_camera(recordings, camera)[:3, :3].T


def camera_of(intrinsics, distortion, **changes):
    fx, fy, cx, cy = intrinsics
    return RollingShutterCamera(width=752, height=480, fx=fx, fy=fy, cx=cx, cy=cy,
                                distortion=tuple(distortion), readout_time=0.0, **changes)


def angle(a, b):
    return np.degrees((Rotation.from_matrix(a).inv() * Rotation.from_matrix(b)).magnitude())


def between(a, b):
    return np.degrees(np.arctan2(np.linalg.norm(np.cross(a, b)), a @ b))


@dataclass(frozen=True, eq=False)
class Corners:
    """Corners of one image by their number on the target (144), and their places on it [m]."""

    stamp_ns: int
    numbers: np.ndarray
    pixels: np.ndarray
    target: np.ndarray


@dataclass(frozen=True, eq=False)
class Truth:
    """``X_cam = R X_target + t`` of each image."""

    R: np.ndarray
    t: np.ndarray

    def relative(self, i, j):
        """R and t with ``X_i = R X_j + t``."""
        R = self.R[i] @ self.R[j].T
        return R, self.t[i] - R @ self.t[j]


@pytest.fixture(scope='module')
def corners(recordings):
    frames = []
    with tarfile.open(recordings / 'euroc_imu_april_corners' / 'cam0_corners.tar.gz') as archive:
        for member in archive:
            file = archive.extractfile(member) if member.isfile() else None
            lines = file.read().decode().splitlines()[1:] if file else []
            if len(lines) < 24:
                continue
            table = np.loadtxt(io.StringIO('\n'.join(lines)), delimiter=',', usecols=range(5, 12))
            frames.append(Corners(int(lines[0].split(',')[0]),
                                  (4 * table[:, 5] + table[:, 6]).astype(int),
                                  table[:, :2].copy(), table[:, 2:5].copy()))
    return sorted(frames, key=lambda frame: frame.stamp_ns)


def solved(frames, intrinsics, distortion):
    """Truth by OpenCV's PnP of each frame's corners."""
    K = np.array([[intrinsics[0], 0, intrinsics[2]], [0, intrinsics[1], intrinsics[3]], [0, 0, 1]])
    d = np.array(distortion)
    Rs, ts = [], []
    for frame in frames:
        _, r, t = cv2.solvePnP(frame.target, frame.pixels, K, d, flags=cv2.SOLVEPNP_ITERATIVE)
        r, t = cv2.solvePnPRefineLM(frame.target, frame.pixels, K, d, r, t)
        Rs.append(Rotation.from_rotvec(r.ravel()).as_matrix())
        ts.append(t.ravel())
    return Truth(np.array(Rs), np.array(ts))


@pytest.fixture(scope='module')
def given(corners):
    """With the calibration that the recording comes with."""
    return solved(corners, *CALIBRATED)


@pytest.fixture(scope='module')
def recalibrated(corners):
    """Intrinsics by OpenCV's calibrateCamera from the corners themselves."""
    views = corners[::len(corners) // 80]
    K = np.array([[458.0, 0, 367.0], [0, 457.0, 248.0], [0, 0, 1]])
    rms, K, d, _, _ = cv2.calibrateCamera(
        [v.target.astype(np.float32) for v in views],
        [v.pixels.astype(np.float32)[:, None] for v in views], (752, 480), K,
        np.zeros(5), flags=cv2.CALIB_USE_INTRINSIC_GUESS)
    assert rms < 0.5
    return [K[0, 0], K[1, 1], K[0, 2], K[1, 2]], d.ravel()[:5].tolist()


@pytest.fixture(scope='module')
def resolved(corners, recalibrated):
    return solved(corners, *recalibrated)


@pytest.fixture(scope='module')
def imu(recordings):
    """Buffer filled up to the end."""
    return all_samples(recordings / 'euroc_imu_april_corners')


def all_samples(folder, config=IMU):
    """An IMU buffer with all samples of a recording."""
    path = folder / 'imu0.csv'
    stamps = np.loadtxt(path, delimiter=',', usecols=0, dtype=np.int64, comments='#')
    values = np.loadtxt(path, delimiter=',', usecols=range(1, 7), comments='#')
    buffer = ImuBuffer(config)
    buffer._keep_ns = 10**12   # the whole recording at once
    for stamp, value in zip(stamps.tolist(), values, strict=True):
        buffer.add(ImuSample(stamp, tuple(value[:3]), tuple(value[3:])))
    return buffer


def half_seconds(frames, imu):
    """Pairs of frames half a second apart, within the IMU's time."""
    stamps = np.array([frame.stamp_ns for frame in frames])
    later = np.searchsorted(stamps, stamps + HALF_SECOND - 10_000_000)
    return [(i, j) for i, j in enumerate(later) if j < len(stamps)
            and abs(stamps[j] - stamps[i] - HALF_SECOND) < 10_000_000
            and imu.coverage(int(stamps[i]), int(stamps[j])) is Coverage.AVAILABLE]


def rotation_errors(frames, truth, imu, R):
    """Gyro against truth over half a second [deg]."""
    return np.array([angle(R @ imu.rotation(frames[i].stamp_ns, frames[j].stamp_ns)[0] @ R.T,
                           truth.relative(i, j)[0]) for i, j in half_seconds(frames, imu)])


@pytest.fixture(scope='module')
def turned_with_principal_point(corners, resolved, imu, recordings):
    """R_cam_imu for the intrinsics solved anew, from the first half of the recording.

    Their principal point lies 7 px beside the given one, which turns the camera frame by nearly a
    degree; the given extrinsics belong to the given intrinsics.
    """
    pairs = [(i, j) for i, j in half_seconds(corners, imu) if j < len(corners) // 2]
    gyro = Rotation.from_matrix([imu.rotation(corners[i].stamp_ns, corners[j].stamp_ns)[0]
                                 for i, j in pairs])
    truth = Rotation.from_matrix([resolved.relative(i, j)[0] for i, j in pairs])
    start = Rotation.from_matrix(R_cam_imu(recordings, 'cam0'))

    def errors(x):
        R = Rotation.from_rotvec(x) * start
        return 200.0 * ((R * gyro * R.inv()).inv() * truth).as_rotvec().ravel()

    fit = least_squares(errors, np.zeros(3), loss='soft_l1')
    assert 0.3 < np.degrees(np.linalg.norm(fit.x)) < 1.0
    return (Rotation.from_rotvec(fit.x) * start).as_matrix()


def test_gyro_over_half_a_second(corners, given, resolved, turned_with_principal_point, imu,
                                 recordings):
    """The requirement: 0.4 deg median of the given truth, 0.2 of the one solved anew."""
    R = R_cam_imu(recordings, 'cam0')
    of_given = rotation_errors(corners, given, imu, R)
    # The second half alone: the first one gave the rotation.
    later = corners[len(corners) // 2:]
    of_second_half = Truth(resolved.R[len(corners) // 2:], resolved.t[len(corners) // 2:])
    of_resolved = rotation_errors(later, of_second_half, imu, turned_with_principal_point)
    print('\ngyro over 0.5 s [deg], median and 90 %: ' + '; '.join(
        f'{name} {np.median(e):.3f} {np.percentile(e, 90):.3f} ({len(e)} pairs)'
        for name, e in (('given', of_given), ('solved anew', of_resolved))))
    assert len(of_given) > 1000 and len(of_resolved) > 500
    assert np.median(of_given) <= 0.4
    assert np.median(of_resolved) <= 0.2
    # It is the bias that does it.
    raw = all_samples(recordings / 'euroc_imu_april_corners', ImuConfig())
    assert np.median(rotation_errors(corners[:200], resolved, raw, R)) > 1.0


@dataclass(frozen=True, eq=False)
class Estimated:
    rotation: float
    translation: float
    sigma_rotation: float
    sigma_translation: float
    answered: bool


def two_view(corners, truth, camera, imu, R, pairs, config=None):
    """Errors of the estimator on the corners that both frames of a pair show."""
    found = []
    for i, j in pairs:
        a, b = corners[i], corners[j]
        _, first, second = np.intersect1d(a.numbers, b.numbers, return_indices=True)
        frames = [frame_imu(imu, (f.stamp_ns, f.stamp_ns), f.stamp_ns, R) for f in (a, b)]
        turn, spread = imu.rotation(a.stamp_ns, b.stamp_ns)
        sigma = max(frame.gravity_sigma for frame in frames)
        pose = estimate_relative_pose(
            a.pixels[first], b.pixels[second], camera, frames[0].motion, frames[1].motion,
            R @ turn @ R.T, R @ spread @ R.T, (b.stamp_ns - a.stamp_ns) * 1e-9,
            config or EstimatorConfig(gravity_sigma=sigma), rng=i)
        R_true, t_true = truth.relative(i, j)
        if not pose:
            found.append(Estimated(np.nan, np.nan, np.nan, np.nan, False))
            continue
        spread = np.degrees(np.sqrt([np.trace(pose.covariance[3:, 3:]),
                                     np.trace(pose.covariance[:3, :3])]))
        found.append(Estimated(angle(pose.R, R_true), between(pose.t, t_true), *spread, True))
    return found


def far_pairs(corners, truth, imu, every):
    """Pairs of at least 10 cm of baseline and 24 common corners, half a second apart."""
    start = corners[0].stamp_ns + 10_000_000_000   # gravity has settled
    return [(i, j) for i, j in half_seconds(corners, imu)
            if i % every == 0 and corners[i].stamp_ns > start
            and np.linalg.norm(truth.relative(i, j)[1]) >= 0.1
            and len(np.intersect1d(corners[i].numbers, corners[j].numbers)) >= 24]


@pytest.mark.parametrize('which', ['given', 'solved anew'])
def test_two_views_of_the_target(corners, given, resolved, recalibrated,
                                 turned_with_principal_point, imu, recordings, which):
    """The requirement: rotation 0.45 deg and translation 3 deg in the median."""
    truth = given if which == 'given' else resolved
    camera = camera_of(*(CALIBRATED if which == 'given' else recalibrated))
    pairs = far_pairs(corners, truth, imu, 6)
    assert len(pairs) > 100
    R = R_cam_imu(recordings, 'cam0') if which == 'given' else turned_with_principal_point
    found = two_view(corners, truth, camera, imu, R, pairs)
    answered = [f for f in found if f.answered]
    rotation, translation = np.median([(f.rotation, f.translation) for f in answered], axis=0)
    high = np.percentile([(f.rotation, f.translation) for f in answered], 90, axis=0)
    print(f'\n{which}: {len(answered)} of {len(pairs)} pairs, R {rotation:.3f} {high[0]:.3f} deg, '
          f't {translation:.2f} {high[1]:.2f} deg (median, 90 %); sigmas '
          f'{np.median([f.sigma_rotation for f in answered]):.3f} '
          f'{np.median([f.sigma_translation for f in answered]):.2f}')
    assert len(answered) >= 0.95 * len(pairs)
    assert rotation <= 0.45
    assert translation <= 3.0


def test_global_and_rolling_path_are_equal_at_read_out_0(corners, given, imu, recordings):
    R = R_cam_imu(recordings, 'cam0')
    pairs = far_pairs(corners, given, imu, 60)
    assert len(pairs) >= 10
    for i, j in pairs:
        a, b = corners[i], corners[j]
        _, first, second = np.intersect1d(a.numbers, b.numbers, return_indices=True)
        turn, spread = imu.rotation(a.stamp_ns, b.stamp_ns)
        motions = [frame_imu(imu, (f.stamp_ns, f.stamp_ns), f.stamp_ns, R).motion for f in (a, b)]
        poses = {}
        for name, changes in (('auto', {}), ('auto', {'reference_row': 'last'}),
                              ('auto', {'readout_direction': 'up'}), ('global_5pt', {})):
            poses[name, str(changes)] = estimate_relative_pose(
                a.pixels[first], b.pixels[second], camera_of(*CALIBRATED, **changes), *motions,
                R @ turn @ R.T, R @ spread @ R.T, 0.5,
                EstimatorConfig(solver=name, gravity_sigma=0.02), rng=0)
        reference = poses['auto', '{}']
        assert reference
        for (name, _), pose in poses.items():
            assert pose, name
            if name == 'auto':
                # No row has a time of its own: the same numbers.
                assert np.array_equal(pose.R, reference.R)
                assert np.array_equal(pose.t, reference.t)
            else:
                # Another sampler, the same optimum.
                assert angle(pose.R, reference.R) < 0.02
                assert between(pose.t, reference.t) < 0.2


# -- ten frames in flight ---------------------------------------------------------------------


@pytest.fixture(scope='module')
def flight(recordings):
    """Stamp, image, R (camera from world), position of the body and of the camera."""
    folder = recordings / 'euroc_v101_10frames'
    table = np.loadtxt(folder / 'gt_left_cam.csv', delimiter=',', comments='#')
    lever = body_from_camera(recordings, 'cam0')
    frames = []
    for path in sorted((folder / 'cam0').glob('*.jpg')):
        k = int(np.argmin(np.abs(table[:, 0] - float(path.stem))))
        assert abs(table[k, 0] - float(path.stem)) < 2e6   # 2 ms
        # Read as the recording's README says: camera from world.
        R = Rotation.from_quat(table[k, [5, 6, 7, 4]]).as_matrix()
        position = table[k, 1:4]
        frames.append((int(path.stem), cv2.imread(str(path), cv2.IMREAD_GRAYSCALE), R, position,
                       position + R.T @ lever[:3, :3].T @ lever[:3, 3]))
    return frames


def tracked(flight, order, config):
    tracker = make_tracker(config)
    tracker.start(flight[order[0]][1])
    for k in order[1:]:
        tracker.track(flight[k][1], None)
    return tracker.refined_matches()


def epipolar_residual(matches, camera, R, t):
    """Median distance of the matches from their epipolar lines [px]."""
    rays1, rays2 = camera.unproject(matches.points1), camera.unproject(matches.points2)
    t = t / np.linalg.norm(t)
    distance = np.abs(np.cross(rays1, rays2 @ R.T) @ t) / np.linalg.norm(
        np.cross(t, rays1), axis=1)
    return camera.fx * float(np.median(distance))


MORE = TrackingConfig(max_features=800, min_feature_distance=5.0)


@pytest.mark.parametrize('order', [range(10), range(9, -1, -1)], ids=['forth', 'back'])
def test_ten_frames_in_flight(flight, recordings, order):
    """The requirement: 0.3 deg and 5 deg at nine frames' distance.

    Matches by the tracker of the project. The positions of the truth are those of the body, not
    of the camera as its README has it: with the lever arm of 7 cm between them the epipolar
    residual of the truth itself is halved.
    """
    imu = all_samples(recordings / 'euroc_v101_10frames', IN_FLIGHT)
    camera, R = camera_of(*CALIBRATED), R_cam_imu(recordings, 'cam0')
    order = list(order)
    (start, _, R1, body1, p1), (end, _, R2, body2, p2) = flight[order[0]], flight[order[-1]]
    turn, spread = imu.rotation(min(start, end), max(start, end))
    turn, spread = R @ turn @ R.T, R @ spread @ R.T
    if start > end:
        turn, spread = turn.T, turn.T @ spread @ turn
    frames = [frame_imu(imu, (at, at), at, R) for at in (start, end)]
    R_true, t_true, t_body = R1 @ R2.T, R1 @ (p2 - p1), R1 @ (body2 - body1)
    for name, config in (('800 features', MORE), ('default', TrackingConfig())):
        matches = tracked(flight, order, config)
        pose = estimate_relative_pose(
            matches.points1, matches.points2, camera, frames[0].motion, frames[1].motion, turn,
            spread, abs(end - start) * 1e-9,
            EstimatorConfig(gravity_sigma=max(f.gravity_sigma for f in frames)))
        assert pose
        errors = angle(pose.R, R_true), between(pose.t, t_true)
        residuals = [epipolar_residual(matches, camera, R_true, t) for t in (t_body, t_true)]
        print(f'\n{name}: {int(pose.inliers.sum())} of {len(pose.inliers)} matches, R '
              f"{errors[0]:.3f} deg, t {errors[1]:.2f} deg (position taken as the camera's: "
              f'{between(pose.t, t_body):.2f} deg); gyro against truth {angle(turn, R_true):.3f} '
              f'deg; residual of the truth {residuals[1]:.2f} px, of it as told '
              f'{residuals[0]:.2f} px')
        assert residuals[1] < 0.7 * residuals[0]
        assert errors[0] <= 0.3
        assert errors[1] <= 5.0
