"""Defects of recordings: each function changes a recording as a user's device or driver does."""

from __future__ import annotations

from dataclasses import replace
import math
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from rs_relpose_lab.field.recording import FieldRecording, Gray, Samples
from rs_relpose_lab.simulation.scene import make_texture
from rs_relpose_lab.simulation.simulation import GRAVITY
from rs_relpose_lab.simulation.turned import turned_axes, turned_camera
from rs_relpose_ros.geometry import Array

NS = 1e9


# -- clocks and order ---------------------------------------------------------------------------


def camera_clock_step(recording: FieldRecording, seconds: float, after: float) -> FieldRecording:
    """The clock of the camera is set forward by `seconds` once, `after` seconds."""
    return recording.shift_images(lambda t: np.where(t >= after, seconds * NS, 0.0))


def imu_clock_step(recording: FieldRecording, seconds: float, after: float) -> FieldRecording:
    """The clock of the IMU is set by `seconds` once; truth stays on its first clock."""
    imu = recording.imu
    later = recording.seconds(imu.stamps_ns) >= after
    stamps = imu.stamps_ns + np.where(later, round(seconds * NS), 0)
    return replace(recording, imu=replace(imu, stamps_ns=stamps))


def camera_clock_drift(recording: FieldRecording, ratio: float) -> FieldRecording:
    """The clock of the camera runs slower by `ratio`."""
    return recording.shift_images(lambda t: -ratio * t * NS)


def offset_follows(recording: FieldRecording, span: float, period: float) -> FieldRecording:
    """The middle of the exposure moves by `span` [s] against the stamp, as by auto exposure."""
    return recording.shift_images(lambda t: 0.5 * span * np.sin(2.0 * math.pi * t / period) * NS)


def late_images(recording: FieldRecording, seconds: float) -> FieldRecording:
    """Images reach the bag `seconds` after their stamps, which are right."""
    shots = tuple(
        replace(shot, receive_ns=shot.receive_ns + round(seconds * NS)) for shot in recording.shots
    )
    return replace(recording, shots=shots)


def topic_by_topic(recording: FieldRecording, images_first: bool) -> FieldRecording:
    """Topics are written one after the other, as converters of data sets do."""
    shift = round((40.0 if images_first else -40.0) * NS)
    imu = recording.imu
    return replace(recording, imu=replace(imu, receive_ns=imu.receive_ns + shift))


def imu_since_boot(recording: FieldRecording) -> FieldRecording:
    """The IMU is stamped since boot, images since 1970."""
    imu = recording.imu
    stamps = imu.stamps_ns - imu.stamps_ns[0] + round(86.4 * NS)
    return replace(recording, imu=replace(imu, stamps_ns=stamps))


def imu_offset(recording: FieldRecording, seconds: float) -> FieldRecording:
    """The clock of the IMU is `seconds` ahead of the one that the parameters state."""
    imu = recording.imu
    stamps = imu.stamps_ns + round(seconds * NS)
    truth = {**recording.truth, 'time_offset_s': recording.truth['time_offset_s'] + seconds}
    return replace(recording, imu=replace(imu, stamps_ns=stamps), truth=truth)


def accelerometer_clock(recording: FieldRecording, seconds: float) -> FieldRecording:
    """Gyro and accelerometer have topics of their own, and clocks `seconds` apart."""
    imu = recording.imu
    gyro = replace(imu, accel=None, frame_ids=('gyro_optical_frame',))
    accel = replace(
        imu,
        stamps_ns=imu.stamps_ns + round(seconds * NS),
        gyro=None,
        frame_ids=('accel_optical_frame',),
    )
    return replace(recording, imu=gyro, accel=accel)


def wrapped_clock(recording: FieldRecording, seconds: float, after: float) -> FieldRecording:
    """Both clocks are set back by `seconds` after `after` seconds; truth stays as it is."""
    imu, back = recording.imu, round(seconds * NS)
    later = recording.seconds(imu.stamps_ns) >= after
    stamps = imu.stamps_ns - np.where(later, back, 0)
    wrapped = recording.shift_images(lambda t: np.where(t >= after, -back, 0))
    return replace(wrapped, imu=replace(imu, stamps_ns=stamps))


def overflowing_nanoseconds(recording: FieldRecording) -> FieldRecording:
    """The driver of the camera writes all nanoseconds, of which 32 bits are left."""
    return replace(recording, stamp_fields=lambda ns: (ns // 1_000_000_000, ns % 2**32))


def bursts(recording: FieldRecording, size: int, stamped: str) -> FieldRecording:
    """`size` samples arrive together.

    `stamped`: 'last', all have the stamp of the last one; 'arrival', they are 0.1 ms apart.
    """
    imu = recording.imu
    count = len(imu.stamps_ns)
    number = np.arange(count)
    last = np.minimum((number // size + 1) * size - 1, count - 1)
    arrival = imu.receive_ns[last]
    stamps = imu.stamps_ns[last] if stamped == 'last' else arrival + 100_000 * (number % size)
    received = arrival + 1000 * (number % size)
    return replace(recording, imu=replace(imu, stamps_ns=stamps, receive_ns=received))


def held_samples(recording: FieldRecording, times: int, interpolated: bool) -> FieldRecording:
    """A slow IMU written at `times` its rate: values held, or interpolated."""
    imu = recording.imu
    assert imu.gyro is not None
    assert imu.accel is not None
    number = np.arange(len(imu.stamps_ns))
    slow = number[::times]

    def resampled(values: Array) -> Array:
        if interpolated:
            columns = [np.interp(number, slow, column[slow]) for column in values.T]
            return np.stack(columns, axis=1)
        return np.asarray(values[number // times * times])

    return replace(
        recording, imu=replace(imu, gyro=resampled(imu.gyro), accel=resampled(imu.accel))
    )


def repeated_images(recording: FieldRecording, every: int, noise: float) -> FieldRecording:
    """Each `every`-th image is the one before, with noise, compressed again."""
    rng = np.random.default_rng(17)
    shots = list(recording.shots)
    for number in range(every - 1, len(shots), every):
        pixels = shots[number - 1].pixels.astype(float)
        pixels += noise * rng.standard_normal(pixels.shape)
        shots[number] = shots[number].with_pixels(np.clip(pixels, 0, 255).astype(np.uint8))
    return replace(recording, shots=tuple(shots))


def lost_images(recording: FieldRecording, share: float) -> FieldRecording:
    """A share of the images does not arrive, as of a busy machine."""
    rng = np.random.default_rng(19)
    arrives = rng.random(len(recording.shots)) >= share
    arrives[0] = True
    shots = tuple(shot for shot, kept in zip(recording.shots, arrives, strict=True) if kept)
    return replace(recording, shots=shots)


def frozen_images(recording: FieldRecording, begin: float, seconds: float) -> FieldRecording:
    """The driver sends the same image for `seconds`."""
    times = recording.seconds(np.array([shot.stamp_ns for shot in recording.shots]))
    first = int(np.searchsorted(times, begin))
    shots = tuple(
        replace(shot, data=recording.shots[first].data) if begin <= t < begin + seconds else shot
        for shot, t in zip(recording.shots, times, strict=True)
    )
    return replace(recording, shots=shots)


def stamped_on_arrival(recording: FieldRecording, mean: float) -> FieldRecording:
    """Images are stamped on arrival: later by exponentially distributed delays."""
    rng = np.random.default_rng(23)
    return recording.shift_images(lambda t: rng.exponential(mean, len(t)) * NS)


# -- what the IMU measures ----------------------------------------------------------------------


def gyro_matrix(recording: FieldRecording, matrix: Array) -> FieldRecording:
    """The gyro measures ``matrix w``."""
    imu = recording.imu
    assert imu.gyro is not None
    return replace(recording, imu=replace(imu, gyro=imu.gyro @ np.asarray(matrix).T))


def gyro_added(
    recording: FieldRecording, white: float = 0.0, tone: float = 0.0, hertz: float = 80.0
) -> FieldRecording:
    """The gyro has more noise [rad/s a sample], or a tone of vibration."""
    imu = recording.imu
    assert imu.gyro is not None
    rng = np.random.default_rng(29)
    wave = np.sin(2.0 * math.pi * hertz * recording.seconds(imu.stamps_ns))[:, None]
    added = white * rng.standard_normal(imu.gyro.shape) + tone * wave * np.array([1.0, 0.6, 0.3])
    return replace(recording, imu=replace(imu, gyro=imu.gyro + added))


def imu_noise(recording: FieldRecording, gyro: float, accel: float) -> FieldRecording:
    """White noise on both sensors [rad/s and m/s^2 a sample]."""
    imu = recording.imu
    assert imu.gyro is not None
    assert imu.accel is not None
    rng = np.random.default_rng(31)
    return replace(
        recording,
        imu=replace(
            imu,
            gyro=imu.gyro + gyro * rng.standard_normal(imu.gyro.shape),
            accel=imu.accel + accel * rng.standard_normal(imu.accel.shape),
        ),
    )


def gyro_factor(recording: FieldRecording, factor: float) -> FieldRecording:
    """The gyro is in another unit."""
    return gyro_matrix(recording, factor * np.eye(3))


def accel_factor(recording: FieldRecording, factor: float) -> FieldRecording:
    """The accelerometer is in another unit."""
    imu = recording.imu
    assert imu.accel is not None
    return replace(recording, imu=replace(imu, accel=factor * imu.accel))


def gravity_removed(recording: FieldRecording) -> FieldRecording:
    """The accelerometer's driver subtracts gravity by its own attitude, which is right."""
    imu = recording.imu
    assert imu.accel is not None
    R_camera_imu = Rotation.from_quat(recording.parameters['quat_cam_imu_xyzw']).as_matrix()
    R_world_imu = recording.states(imu.stamps_ns).R_world_cam @ R_camera_imu
    gravity = GRAVITY @ R_world_imu  # rows of (N, 3), in the axes of the IMU
    return replace(recording, imu=replace(imu, accel=imu.accel + gravity))


def two_imus(recording: FieldRecording) -> FieldRecording:
    """A second IMU, rotated by a quarter turn, publishes on the same topic."""
    imu = recording.imu
    assert imu.gyro is not None
    assert imu.accel is not None
    turn = np.array([[0.0, -1.0, 0.0], [1.0, 0.0, 0.0], [0.0, 0.0, 1.0]])

    def both(first: NDArray[Any], second: NDArray[Any]) -> NDArray[Any]:
        return np.stack([first, second], axis=1).reshape(-1, *first.shape[1:])

    later = round(0.002 * NS)
    return replace(
        recording,
        imu=Samples(
            both(imu.stamps_ns, imu.stamps_ns + later),
            both(imu.receive_ns, imu.receive_ns + later),
            both(imu.gyro, imu.gyro @ turn.T),
            both(imu.accel, imu.accel @ turn.T),
            ('imu_link', 'base_imu_link'),
        ),
    )


def low_pass(recording: FieldRecording, gyro: float, accel: float) -> FieldRecording:
    """First-order low-pass filters with time constants [s] in both sensors.

    The true offset of the gyro is that of its filter's delay at low frequencies.
    """
    imu = recording.imu
    assert imu.gyro is not None
    assert imu.accel is not None
    step = float(np.median(np.diff(imu.stamps_ns))) / NS

    def filtered(values: Array, constant: float) -> Array:
        gain = 1.0 - math.exp(-step / constant)
        out = values.copy()
        for k in range(1, len(out)):
            out[k] = out[k - 1] + gain * (values[k] - out[k - 1])
        return out

    late = step / math.expm1(step / gyro)
    truth = {**recording.truth, 'time_offset_s': recording.truth['time_offset_s'] + late}
    return replace(
        recording,
        imu=replace(imu, gyro=filtered(imu.gyro, gyro), accel=filtered(imu.accel, accel)),
        truth=truth,
    )


def stabilised(recording: FieldRecording, share: float, limit: float) -> FieldRecording:
    """The lens shift follows `share` of the high-passed rotation, by at most `limit` px."""
    times = np.array([shot.true_ns for shot in recording.shots])
    rates = recording.states(times).angular_velocity
    step = float(np.median(np.diff(times))) / NS
    shift = np.zeros(2)
    shifts = []
    for rate in rates:
        # A rotation about y moves the image along -x, about x along y; the centre is restored.
        motion = recording.camera.fx * step * np.array([rate[1], -rate[0]])
        shift = np.clip(0.9 * shift + share * motion, -limit, limit)
        shifts.append(shift)

    def moved(number: int, pixels: Gray) -> Gray:
        matrix = np.array([[1.0, 0.0, shifts[number][0]], [0.0, 1.0, shifts[number][1]]])
        size = (pixels.shape[1], pixels.shape[0])
        warped = cv2.warpAffine(pixels, matrix, size, borderMode=cv2.BORDER_REPLICATE)
        return warped.astype(np.uint8, copy=False)

    return recording.map_images(moved).without_truth('principal_point_px')


# -- geometry of the image ----------------------------------------------------------------------


def cropped(recording: FieldRecording, left: int) -> FieldRecording:
    """`left` columns are cut off, and the CameraInfo keeps the principal point."""
    camera = replace(recording.camera, width=recording.camera.width - left)
    column, row = recording.truth['principal_point_px']
    return replace(
        recording.map_images(lambda _, pixels: pixels[:, left:]),
        camera=camera,
        truth={**recording.truth, 'principal_point_px': [column - left, row]},
    )


def matrix_scaled(recording: FieldRecording, factor: float) -> FieldRecording:
    """The camera matrix is the one of another resolution."""
    camera = recording.camera
    values = {name: factor * getattr(camera, name) for name in ('fx', 'fy', 'cx', 'cy')}
    return replace(recording, camera=replace(camera, **values))


def focal_scaled(recording: FieldRecording, factor: float) -> FieldRecording:
    """The focal length of the CameraInfo is off by a factor."""
    camera = recording.camera
    off = replace(camera, fx=factor * camera.fx, fy=factor * camera.fy)
    return replace(recording, camera=off)


def decentred(recording: FieldRecording, p1: float, p2: float) -> FieldRecording:
    """The CameraInfo has other tangential coefficients, those of a lens of the same model."""
    camera = recording.camera
    k1, k2, *_ = camera.distortion
    k3 = camera.distortion[4:5]
    return replace(recording, camera=replace(camera, distortion=(k1, k2, p1, p2, *k3)))


def squeezed(recording: FieldRecording, factor: float) -> FieldRecording:
    """Columns are resized by `factor`; the CameraInfo keeps equal focal lengths."""
    camera = recording.camera
    width = round(factor * camera.width)

    def resized(_: int, pixels: Gray) -> Gray:
        size = (width, camera.height)
        return cv2.resize(pixels, size, interpolation=cv2.INTER_AREA).astype(np.uint8, copy=False)

    cx = factor * (camera.cx + 0.5) - 0.5
    lens = {'focal_px': factor * camera.fx, 'principal_point_px': [cx, camera.cy]}
    return replace(
        recording.map_images(resized),
        camera=replace(camera, width=width, cx=cx),
        truth={**recording.truth, **lens},
    )


def portrait(recording: FieldRecording, turns: int, *, configured: bool = False) -> FieldRecording:
    """The driver rotates images by `turns` quarter turns (1 left, 3 right, 2 upside down).

    The user's file states the new direction of the readout if it is `configured`, and after half a
    turn, which keeps rows in rows.
    """
    camera = turned_camera(recording.camera, turns)
    R = turned_axes(turns)
    R_camera_imu = Rotation.from_quat(recording.parameters['quat_cam_imu_xyzw'])
    quat = (Rotation.from_matrix(R.T) * R_camera_imu).as_quat().tolist()
    parameters = {**recording.parameters, 'quat_cam_imu_xyzw': tuple(quat)}
    if 'imu_position' in parameters:
        parameters['imu_position'] = tuple((R.T @ parameters['imu_position']).tolist())
    if configured or turns == 2:
        parameters['readout_direction'] = camera.readout_direction
        parameters['stamp_row'] = camera.reference_row
    turned = recording.map_images(lambda _, pixels: np.rot90(pixels, turns))
    lens = {'focal_px': camera.fx, 'principal_point_px': [camera.cx, camera.cy]}
    truth = {**recording.truth, 'quat_cam_imu_xyzw': quat, **lens}
    if turns == 2:
        # Row 0, to which the time offset belongs, is read last.
        readout = recording.truth['readout_time_s']
        later = readout * (1.0 - 1.0 / camera.height)
        truth['readout_time_s'] = -readout
        truth['time_offset_s'] = recording.truth['time_offset_s'] + later
    return replace(turned, camera=camera, R_camera_image=R, truth=truth, parameters=parameters)


def mirrored(recording: FieldRecording) -> FieldRecording:
    """Columns are in reverse order."""
    mirrored_images = recording.map_images(lambda _, pixels: pixels[:, ::-1])
    return mirrored_images.without_truth('principal_point_px')


def zooming(recording: FieldRecording, share: float) -> FieldRecording:
    """The focal length grows by `share` over the recording."""
    camera, count = recording.camera, len(recording.shots)

    def zoomed(number: int, pixels: Gray) -> Gray:
        factor = 1.0 + share * (number / count - 0.5)
        matrix = np.array(
            [
                [factor, 0.0, (1.0 - factor) * camera.cx],
                [0.0, factor, (1.0 - factor) * camera.cy],
            ]
        )
        size = (camera.width, camera.height)
        return cv2.warpAffine(
            pixels, matrix, size, flags=cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE
        ).astype(np.uint8, copy=False)

    return recording.map_images(zoomed).without_truth('focal_px')


def side_by_side(recording: FieldRecording) -> FieldRecording:
    """Two views of a stereo camera beside each other are published as one image."""
    camera = recording.camera
    shift = 12  # px of disparity

    def doubled(_: int, pixels: Gray) -> Gray:
        other = np.roll(pixels, -shift, axis=1)
        return np.hstack([pixels, other])

    wide = replace(camera, width=2 * camera.width, cx=camera.cx + 0.5 * camera.width)
    both = recording.map_images(doubled).without_truth('focal_px', 'principal_point_px')
    return replace(both, camera=wide)


def overlay(recording: FieldRecording, share: float, side: str) -> FieldRecording:
    """A textured part of the image does not move: 'left', 'bottom', or 'around' a window."""
    camera = recording.camera
    texture = make_texture(np.random.default_rng(41), (camera.height, camera.width))
    mask = np.zeros((camera.height, camera.width), dtype=bool)
    if side == 'left':
        mask[:, : round(share * camera.width)] = True
    elif side == 'bottom':
        mask[camera.height - round(share * camera.height) :] = True
    else:
        mask[:] = True
        open_share = math.sqrt(1.0 - share)
        half_h, half_w = (round(0.5 * open_share * size) for size in (camera.height, camera.width))
        mid_v, mid_u = camera.height // 2, camera.width // 2
        mask[mid_v - half_h : mid_v + half_h, mid_u - half_w : mid_u + half_w] = False
    rng = np.random.default_rng(43)

    def covered(_: int, pixels: Gray) -> Gray:
        noise = rng.standard_normal(pixels.shape)
        return np.where(mask, np.clip(texture + noise, 0, 255), pixels).astype(np.uint8)

    return recording.map_images(covered)


def moving_object(recording: FieldRecording, share: float, period: float) -> FieldRecording:
    """A textured bar of `share` of the width moves to and fro through the view."""
    camera = recording.camera
    width = round(share * camera.width)
    texture = make_texture(np.random.default_rng(47), (camera.height, width))

    def crossed(number: int, pixels: Gray) -> Gray:
        phase = 0.5 - 0.5 * math.cos(2.0 * math.pi * number / 30.0 / period)
        left = round(phase * (camera.width - width))
        out = pixels.copy()
        out[:, left : left + width] = texture
        return out

    return recording.map_images(crossed)


def flicker(recording: FieldRecording, strength: float) -> FieldRecording:
    """Bands of 50 Hz mains light over the rows, and jumps of the automatic exposure."""
    readout = recording.parameters['readout_time']

    def lit(number: int, pixels: Gray) -> Gray:
        times = number / 30.0 + np.arange(len(pixels)) / len(pixels) * readout
        bands = 1.0 + strength * np.sin(2.0 * math.pi * 100.0 * times)
        jump = 0.75 if number // 45 % 2 else 1.1
        return np.clip(pixels * (jump * bands)[:, None], 0, 255).astype(np.uint8)

    return recording.map_images(lit)


def covered_lens(recording: FieldRecording, begin: float, seconds: float) -> FieldRecording:
    """Images are black for `seconds`."""

    def black(number: int, pixels: Gray) -> Gray:
        return np.full_like(pixels, 6) if begin <= number / 30.0 < begin + seconds else pixels

    return recording.map_images(black)


def knock(recording: FieldRecording, at: float, clip: float) -> FieldRecording:
    """The device is put down hard: 20 g for 15 ms, clipped by the accelerometer."""
    imu = recording.imu
    assert imu.accel is not None
    times = recording.seconds(imu.stamps_ns)
    hit = (times >= at) & (times < at + 0.015)
    accel = imu.accel + np.where(hit[:, None], np.array([0.0, 0.0, 196.0]), 0.0)
    return replace(recording, imu=replace(imu, accel=np.clip(accel, -clip, clip)))
