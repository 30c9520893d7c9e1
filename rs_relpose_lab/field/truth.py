"""Errors of published values against the truth of a rebuilt recording, in their sigmas."""

from __future__ import annotations

from collections.abc import Iterable
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation
from scipy.stats import chi2

from rs_relpose_lab.field.recording import FieldRecording, Stamps
from rs_relpose_ros.geometry import Array, so3


class PublishedPose(NamedTuple):
    """A relative pose as it was published: camera 2 in camera 1."""

    reference_ns: int  # stamp of image 1
    stamp_ns: int  # stamp of image 2
    t: Array  # (3,) unit
    rotation: Rotation
    covariance: Array  # (6, 6) of translation and rotation, in the axes of camera 1


class Path(NamedTuple):
    """States of a path: poses of the camera in its world, at stamps of the camera's clock."""

    stamps_ns: Stamps  # (N,)
    positions: Array  # (N, 3) [m]
    rotations: Rotation  # (N,)
    covariances: Array  # (N, 6, 6) of position and rotation, in the axes of the world

    def kept(self, which: Any) -> Path:
        """Some of the states, by index, slice or flag."""
        return Path(*(values[which] for values in self))


# -- poses of pairs -------------------------------------------------------------------------------


def pose_distances(recording: FieldRecording, poses: Iterable[PublishedPose]) -> Array:
    """Squared Mahalanobis distances (N, 2) of direction and rotation of relative poses."""
    true_ns = {shot.stamp_ns: shot.true_ns for shot in recording.shots}
    squares = []
    for pose in poses:
        first, second = true_ns.get(pose.reference_ns), true_ns.get(pose.stamp_ns)
        if first is None or second is None:
            continue
        R, t = _relative_pose(recording, first, second)
        error_t = t - pose.t
        error_R = (Rotation.from_matrix(R) * pose.rotation.inv()).as_rotvec()
        tangent = so3.tangent_basis(t)
        along_t = tangent.T @ error_t
        spread_t = tangent.T @ pose.covariance[:3, :3] @ tangent
        square_t = along_t @ np.linalg.solve(spread_t, along_t)
        square_R = error_R @ np.linalg.solve(pose.covariance[3:, 3:], error_R)
        squares.append((square_t, square_R))
    return np.reshape(squares, (-1, 2))


def _relative_pose(recording: FieldRecording, first: int, second: int) -> tuple[Array, Array]:
    """True R and unit t of image 2 in image 1."""
    states = recording.states(np.array([first, second], dtype=np.int64))
    R1, R2 = states.R_world_cam @ recording.R_camera_image
    t = R1.T @ (states.position[1] - states.position[0])
    return R1.T @ R2, t / max(np.linalg.norm(t), 1e-9)


def relative_distances(squares: Array, freedom: int) -> Array:
    """Distances (N,) in sigmas of one dimension with the same probability, from chi-square."""
    probability = chi2.logsf(squares, freedom)
    sigmas: Array = np.sqrt(chi2.isf(np.exp(np.maximum(probability, -700.0)), 1))
    return np.where(probability > -700.0, sigmas, np.sqrt(squares))


# -- calibration ----------------------------------------------------------------------------------


def calibration_sigmas(truth: dict[str, Any], found: dict[str, Any]) -> dict[str, float]:
    """Errors of the determined values of calibration.json in their sigmas.

    `truth`: true values by the names of calibration.json; others are not compared.
    """
    if not found.get('observable', True):
        return {}
    errors: dict[str, float] = {}
    for name, true in truth.items():
        value = found.get(name)
        if name == 'quat_cam_imu_xyzw' or value is None:
            continue
        parts = value if isinstance(value, list) else [value]
        truths = true if isinstance(value, list) else [true]
        for k, (one, expected) in enumerate(zip(parts, truths, strict=True)):
            if one['observable']:
                label = f'{name}[{k}]' if isinstance(value, list) else name
                errors[label] = abs(one['value'] - expected) / one['sigma']
    quat = found.get('quat_cam_imu_xyzw')
    if quat and found['rotation_from_axis_map_rad']['observable']:
        apart = Rotation.from_quat(truth['quat_cam_imu_xyzw']) * Rotation.from_quat(quat).inv()
        ratios = np.abs(apart.as_rotvec()) / np.asarray(found['rotation_sigma_rad'])
        errors['axes'] = float(ratios.max())
    return errors


# -- paths ----------------------------------------------------------------------------------------


# Keyframes further apart [ns] belong to two paths. [chosen: the longest interval of keyframes is
# 1 s; any value from there to the time of a loss would do]
_OTHER_PATH_NS = 2_000_000_000
# Length [ns] of the begin of a path whose states show where it began. Less leaves the scale
# unknown, more brings drift into the choice. [chosen: keyframes are 0.1 s, 0.2 m, apart; 2 to 6 s
# would do]
_EARLY_NS = 4_000_000_000
# Images further apart in truth [ns] are of different times that a clock has given one stamp.
# [chosen: frames are 33 ms apart; 0.1 s to the least step back of a clock would do]
_LONGEST_INTERVAL_NS = 200_000_000


def state_distances(recording: FieldRecording, path: Path, origin: Path) -> Array:
    """Squared Mahalanobis distances (N, 2) of position and rotation of the states of a path.

    All states relate to `origin`, one state of the path's world, which is aligned there with the
    truth, in position and heading. States whose stamps have no single true time are left out.
    """
    own = path.kept(_has_truth(recording, path.stamps_ns))
    if len(own.stamps_ns) == 0:
        return np.zeros((0, 2))
    at_origin = recording.states(_true_ns(recording, origin.stamps_ns))
    R_origin = _true_rotations(recording, origin.stamps_ns)
    turn = (origin.rotations * R_origin.inv()).as_matrix()[0]
    heading = Rotation.from_euler('z', np.arctan2(turn[1, 0], turn[0, 0]))

    states = recording.states(_true_ns(recording, own.stamps_ns))
    R_true = heading * _true_rotations(recording, own.stamps_ns)
    moved = heading.apply(states.position - at_origin.position[0])
    error_p = origin.positions[0] + moved - own.positions
    error_R = (R_true * own.rotations.inv()).as_rotvec()
    spreads_p, spreads_R = own.covariances[:, :3, :3], own.covariances[:, 3:, 3:]
    squares = [_squares(error_p, spreads_p), _squares(error_R, spreads_R)]
    return np.stack(squares, axis=1)


def _squares(errors: Array, covariances: Array) -> Array:
    """Squared Mahalanobis distances (N,) of errors (N, 3)."""
    whitened = np.linalg.solve(covariances, errors[:, :, None])[:, :, 0]
    squares: Array = np.einsum('ij,ij->i', errors, whitened)
    return squares


def smoothed_origin(path: Path, smoothed: Path) -> Path:
    """The first keyframe of the part of the smoothed path that a path belongs to."""
    before = np.flatnonzero(smoothed.stamps_ns <= path.stamps_ns[0])
    if len(before) == 0:
        return path.kept(slice(0, 1))
    begin = int(before[np.argmax(smoothed.stamps_ns[before])])
    steps = np.diff(smoothed.stamps_ns)  # negative where the clock was set back
    while begin and 0 <= steps[begin - 1] <= _OTHER_PATH_NS:
        begin -= 1
    return smoothed.kept(slice(begin, begin + 1))


def fitted_origin(recording: FieldRecording, path: Path, stamps_ns: Iterable[int]) -> Path:
    """The origin of a path of unknown begin: that of the stamps which fits its first states best.

    A path begins at position 0 with the keyframe that its first state, seconds later, relates to.
    """
    first = path.kept(slice(0, 1))
    early = path.kept(path.stamps_ns <= first.stamps_ns[0] + _EARLY_NS)
    turn = (early.rotations * _true_rotations(recording, early.stamps_ns).inv()).mean()
    begins = [one for one in sorted(stamps_ns) if one <= first.stamps_ns[0]]
    origins = [first]
    for begin in begins:
        stamp = np.array([begin], dtype=np.int64)
        rotation = turn * _true_rotations(recording, stamp)
        origins.append(Path(stamp, np.zeros((1, 3)), rotation, np.zeros((1, 6, 6))))
    candidates = origins[1:] or origins
    return min(candidates, key=lambda one: float(state_distances(recording, early, one).sum()))


def _true_rotations(recording: FieldRecording, stamps_ns: Stamps) -> Rotation:
    """True rotations from the published images' axes to the world."""
    states = recording.states(_true_ns(recording, stamps_ns))
    return Rotation.from_matrix(states.R_world_cam @ recording.R_camera_image)


def _stamps_and_true(recording: FieldRecording) -> tuple[Stamps, Stamps]:
    """Stamps of the images in their order, and their true times."""
    shots = sorted(recording.shots, key=lambda shot: shot.stamp_ns)
    stamps = np.array([shot.stamp_ns for shot in shots], dtype=np.int64)
    return stamps, np.array([shot.true_ns for shot in shots], dtype=np.int64)


def _has_truth(recording: FieldRecording, stamps_ns: Stamps) -> NDArray[np.bool_]:
    """Whether stamps lie between those of images that are about as far apart in truth."""
    stamps, true = _stamps_and_true(recording)
    after = np.clip(np.searchsorted(stamps, stamps_ns), 1, len(stamps) - 1)
    inside = (stamps_ns >= stamps[0]) & (stamps_ns <= stamps[-1])
    known: NDArray[np.bool_] = inside & (
        np.abs(true[after] - true[after - 1]) <= _LONGEST_INTERVAL_NS
    )
    return known


def _true_ns(recording: FieldRecording, stamps_ns: Stamps) -> Stamps:
    """True times of stamps on the camera's clock, which are interpolated between images."""
    stamps, true = _stamps_and_true(recording)
    since = np.interp(stamps_ns - stamps[0], stamps - stamps[0], true - true[0])
    return np.asarray(true[0] + since.astype(np.int64), dtype=np.int64)
