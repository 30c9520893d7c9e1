"""What the tool answers to a rebuilt situation, and the verdict on it, computed from the truth."""

from __future__ import annotations

import csv
from dataclasses import dataclass
import json
import os
from pathlib import Path
import re
import subprocess
import sys
from typing import Any, NamedTuple

import numpy as np
from scipy.spatial.transform import Rotation
from scipy.stats import chi2

from rs_relpose_lab.field.cases import Case
from rs_relpose_lab.field.recording import FieldRecording, Stamps
from rs_relpose_ros.bags.reader import open_bag
from rs_relpose_ros.geometry import Array, so3

# Seconds after which a command counts as hanging. [chosen: replays of these bags take ten]
LONGEST = 600.0
# Share within which a value lies for its covariance to hold. [chosen: three sigmas]
WITHIN = 0.997
# Sigmas of the right answers, as the catalogue of situations states them.
LARGEST_SIGMA = 8.0
LARGEST_CALIBRATION_SIGMA = 4.0
LARGEST_SHARE = 0.02
LARGEST_STATE_SHARE = 0.05
ENOUGH_POSES = 0.8

_COMMAND = 'import sys; from rs_relpose_ros.cli.main import main; sys.exit(main())'
# Words of messages after which a finding is not a cause: what it lists is not evaluated.
_FAULTS = ('suspect', 'wrong')


@dataclass(frozen=True, slots=True)
class Answer:
    """Exit code and words of one command."""

    command: str
    code: int
    text: str


@dataclass(frozen=True, slots=True)
class Verdict:
    """The verdict on all answers to a case."""

    case: str
    verdict: str  # good, poor or failure
    reason: str
    poses: int
    pairs: int
    beyond: float  # share of the poses outside of 99.7 %
    worst: float  # largest Mahalanobis distance of a pose over that of its degrees of freedom
    calibration: float  # largest error of a determined value [sigmas]; NaN: none determined
    states_beyond: float
    named: str
    wrong: str
    seconds: float


def run_command(folder: Path, *words: str) -> Answer:
    """Run a command as a user does, in a process of its own."""
    environment = {**os.environ, 'OPENBLAS_NUM_THREADS': '1'}
    try:
        done = subprocess.run(
            [sys.executable, '-c', _COMMAND, *words],
            capture_output=True,
            text=True,
            timeout=LONGEST,
            env=environment,
            cwd=folder,
            check=False,
        )
    except subprocess.TimeoutExpired:
        return Answer(words[0], 124, 'Traceback: the command did not end')
    return Answer(words[0], done.returncode, done.stdout + done.stderr)


def answers(case: Case, folder: Path, bag: Path, parameters: Path) -> dict[str, Answer]:
    """Answers of the commands, whose files are in `folder`."""
    given = ('--params', str(parameters))
    words: dict[str, tuple[str, ...]] = {
        'check': ('check', str(bag), *given, '--json'),
        'calibrate': ('calibrate', str(bag), '--out', str(folder / 'calibrate')),
        'replay': (
            *('replay', str(bag), *given, '--out', str(folder / 'replay')),
            *('--bag', '--no-pictures'),
        ),
        'odometry': ('odometry', str(bag), *given, '--out', str(folder / 'odometry')),
    }
    return {name: run_command(folder, *words[name]) for name in case.commands}


# -- numbers from the truth ---------------------------------------------------------------------


def _seconds(stamp: Any) -> int:
    return int(stamp.sec) * 1_000_000_000 + int(stamp.nanosec)


def pose_distances(recording: FieldRecording, folder: Path) -> tuple[Array, Array]:
    """Squared Mahalanobis distances (N, 2) of t and R of published poses; errors (N, 2) [deg]."""
    true_ns = {shot.stamp_ns: shot.true_ns for shot in recording.shots}
    references: dict[int, int] = {}
    poses: dict[int, Any] = {}
    path = folder / 'replay' / 'relpose_bag'
    if not path.exists():
        return np.zeros((0, 2)), np.zeros((0, 2))
    with open_bag(path) as bag:
        topics = [one for one in bag.topics if re.search('relative_pose$|reference$', one.name)]
        for message in bag.messages(topics):
            stamp = _seconds(message.message.header.stamp)
            if message.topic.endswith('reference'):
                references[stamp] = _seconds(message.message.time_ref)
            else:
                poses[stamp] = message.message.pose
    squares, errors = [], []
    for stamp, published in poses.items():
        first, second = true_ns.get(references[stamp]), true_ns.get(stamp)
        if first is None or second is None:
            continue
        R, t = _relative_pose(recording, first, second)
        error_t, error_R = _errors(published.pose, R, t)
        covariance = np.asarray(published.covariance, dtype=float).reshape(6, 6)
        tangent = so3.tangent_basis(t)
        along_t = tangent.T @ error_t
        spread_t = tangent.T @ covariance[:3, :3] @ tangent
        squares.append(
            (
                along_t @ np.linalg.solve(spread_t, along_t),
                error_R @ np.linalg.solve(covariance[3:, 3:], error_R),
            )
        )
        errors.append(np.degrees([np.linalg.norm(error_t), np.linalg.norm(error_R)]))
    return np.reshape(squares, (-1, 2)), np.reshape(errors, (-1, 2))


def _relative_pose(recording: FieldRecording, first: int, second: int) -> tuple[Array, Array]:
    """True R and unit t of image 2 in image 1."""
    states = recording.states(np.array([first, second], dtype=np.int64))
    R1, R2 = states.R_world_cam @ recording.R_camera_image
    t = R1.T @ (states.position[1] - states.position[0])
    return R1.T @ R2, t / max(np.linalg.norm(t), 1e-9)


def _errors(pose: Any, R: Array, t: Array) -> tuple[Array, Array]:
    q, p = pose.orientation, pose.position
    R_estimated = Rotation.from_quat([q.x, q.y, q.z, q.w])
    rotation = (Rotation.from_matrix(R) * R_estimated.inv()).as_rotvec()
    return t - np.array([p.x, p.y, p.z]), rotation


def relative_distances(squares: Array, freedom: int) -> Array:
    """Distances (N,) in sigmas of one dimension with the same probability, from chi-square."""
    probability = chi2.logsf(squares, freedom)
    sigmas: Array = np.sqrt(chi2.isf(np.exp(np.maximum(probability, -700.0)), 1))
    return np.where(probability > -700.0, sigmas, np.sqrt(squares))


def calibration_sigmas(recording: FieldRecording, folder: Path) -> dict[str, float]:
    """Errors of the determined values of calibration.json in their sigmas."""
    path = folder / 'calibrate' / 'calibration.json'
    if not path.exists():
        return {}
    found, truth = json.loads(path.read_text()), recording.truth
    if not found.get('observable', True):
        return {}
    errors: dict[str, float] = {}
    for name in ('readout_time_s', 'time_offset_s'):
        value = found.get(name)
        if name in truth and value and value['observable']:
            errors[name] = abs(value['value'] - truth[name]) / value['sigma']
    for k, value in enumerate(found.get('gyro_bias_rad_per_s') or []):
        if value['observable'] and 'gyro_bias_rad_per_s' in truth:
            errors[f'gyro_bias[{k}]'] = (
                abs(value['value'] - truth['gyro_bias_rad_per_s'][k]) / value['sigma']
            )
    quat = found.get('quat_cam_imu_xyzw')
    if quat and found['rotation_from_axis_map_rad']['observable']:
        apart = Rotation.from_quat(truth['quat_cam_imu_xyzw']) * Rotation.from_quat(quat).inv()
        errors['axes'] = float(
            np.max(np.abs(apart.as_rotvec()) / np.asarray(found['rotation_sigma_rad']))
        )
    return errors


class _Pose(NamedTuple):
    """Poses of the camera in the world of a path, at stamps of the camera's clock."""

    stamps_ns: Stamps  # (N,)
    positions: Array  # (N, 3) [m]
    rotations: Rotation  # (N,)


def state_distances(recording: FieldRecording, folder: Path) -> Array:
    """Squared Mahalanobis distances (N, 2) of position and rotation of odometry.csv."""
    path = folder / 'odometry' / 'odometry.csv'
    if not path.exists():
        return np.zeros((0, 2))
    with path.open(newline='') as file:
        rows = list(csv.DictReader(file))
    smoothed = _smoothed(folder / 'odometry' / 'trajectory_smoothed.tum')
    out: list[tuple[float, float]] = []
    for number in sorted({row['path'] for row in rows}):
        part = [row for row in rows if row['path'] == number]
        out += _path_distances(recording, part, smoothed)
    return np.reshape(out, (-1, 2))


def _smoothed(path: Path) -> _Pose:
    """Poses of trajectory_smoothed.tum: stamp [s], position, quaternion."""
    lines = path.read_text(encoding='utf-8').split('\n') if path.exists() else []
    words = [line.split() for line in lines if line]
    stamps = [int(one[0].replace('.', '')) for one in words]  # of nine decimals
    values = np.array([[float(word) for word in one[1:]] for one in words]).reshape(-1, 7)
    rotations = Rotation.from_quat(values[:, 3:] if len(values) else np.eye(4)[3:])
    return _Pose(np.array(stamps, dtype=np.int64), values[:, :3], rotations)


def _true_ns(recording: FieldRecording, stamps_ns: Stamps) -> Stamps:
    """True times of stamps on the camera's clock, which are interpolated between images."""
    shots = sorted(recording.shots, key=lambda shot: shot.stamp_ns)
    stamps = np.array([shot.stamp_ns for shot in shots])
    true = np.array([shot.true_ns for shot in shots])
    since = np.interp(stamps_ns - stamps[0], stamps - stamps[0], true - stamps[0])
    return np.asarray(stamps[0] + since.astype(np.int64), dtype=np.int64)


# Keyframes further apart [ns] belong to two paths. [chosen: the longest interval of keyframes is
# 1 s; any value from there to the time of a loss would do]
_OTHER_PATH_NS = 2_000_000_000


def _begin(stamps_ns: Stamps, number: int) -> int:
    """Number of the first keyframe of the path that keyframe `number` belongs to."""
    while number and stamps_ns[number] - stamps_ns[number - 1] <= _OTHER_PATH_NS:
        number -= 1
    return number


def _path_distances(
    recording: FieldRecording, rows: list[dict[str, str]], smoothed: _Pose
) -> list[tuple[float, float]]:
    """Return the same of one path.

    Its world has the origin in the first smoothed keyframe, which all states relate to; the path
    is aligned there with the truth, in position and heading.
    """
    stamps = np.array([shot.stamp_ns for shot in recording.shots])
    own = np.array([int(row['stamp_ns']) for row in rows])
    inside = (own >= stamps.min()) & (own <= stamps.max())
    if inside.sum() < 2:
        return []
    states = recording.states(_true_ns(recording, own[inside]))
    R_true = states.R_world_cam @ recording.R_camera_image
    values = {
        name: np.array([float(row[name]) for row in rows])[inside]
        for name in ('x', 'y', 'z', 'qx', 'qy', 'qz', 'qw')
    }
    covariance = np.array(
        [[float(row[f'c{i}{j}']) for i in range(6) for j in range(6)] for row in rows]
    ).reshape(-1, 6, 6)[inside]
    R = Rotation.from_quat(np.stack([values[n] for n in ('qx', 'qy', 'qz', 'qw')], axis=1))
    position = np.stack([values[n] for n in 'xyz'], axis=1)
    origin = _Pose(own[inside][:1], position[:1], R[:1])
    before = np.flatnonzero(smoothed.stamps_ns <= own[0])
    if len(before):
        begin = _begin(smoothed.stamps_ns, int(before[-1]))
        origin = _Pose(
            smoothed.stamps_ns[begin : begin + 1],
            smoothed.positions[begin : begin + 1],
            smoothed.rotations[begin : begin + 1],
        )
    at_origin = recording.states(_true_ns(recording, origin.stamps_ns))
    R_origin = at_origin.R_world_cam[0] @ recording.R_camera_image
    turn = origin.rotations.as_matrix()[0] @ R_origin.T
    heading = Rotation.from_euler('z', np.arctan2(turn[1, 0], turn[0, 0])).as_matrix()
    moved = origin.positions[0] + (states.position - at_origin.position[0]) @ heading.T
    error_R = (Rotation.from_matrix(heading @ R_true) * R.inv()).as_rotvec()
    error_p = moved - position
    out = []
    for k in range(1, len(position)):
        p = error_p[k] @ np.linalg.solve(covariance[k, :3, :3], error_p[k])
        r = error_R[k] @ np.linalg.solve(covariance[k, 3:, 3:], error_R[k])
        out.append((float(p), float(r)))
    return out


# -- words --------------------------------------------------------------------------------------


def findings_of(found: dict[str, Answer], folder: Path) -> list[tuple[str, str, str]]:
    """Code, state and text of the findings of check and replay."""
    out = []
    if 'check' in found:
        text = found['check'].text
        try:
            report = json.loads(text[text.index('{') : text.rindex('}') + 1])
        except ValueError:
            report = {'findings': []}
        states = {'warning': 'suspect', 'failure': 'wrong'}
        out += [
            (
                one['name'],
                states.get(one['verdict'], one['verdict']),
                f'{one["text"]} {one["remedy"]}',
            )
            for one in report['findings']
        ]
    summary = folder / 'replay' / 'summary.json'
    if summary.exists():
        health = json.loads(summary.read_text()).get('health') or {'findings': []}
        out += [(one['figure'], one['state'], one['sentence']) for one in health['findings']]
    return out


# Findings of properties of a recording, which name no cause in the calibration.
_DEVIATIONS = (
    'axes',
    'accel_axes',
    'accel_scale',
    'stamp_row',
    'gyro_unit',
    'gyro_scale',
    'gyro_skew',
    'gyro_bias',
    'time_offset',
    'readout_time',
    'readout_direction',
    'focal_length',
    'distortion',
    'image_geometry',
    'principal_point',
    'aspect',
    'offset_step',
    'offset_drift',
    'focal_drift',
    'readout_columns',
    'moving_object',
    'static_region',
    'interior',
    'stabilisation',
    'repeated_images',
    'vibration',
    'gyro_noise',
    'two_views',
)


def judge(
    case: Case,
    recording: FieldRecording,
    folder: Path,
    found: dict[str, Answer],
    undisturbed: int | None,
    seconds: float,
) -> Verdict:
    """The verdict on the answers; `undisturbed`: number of poses of the base recording."""
    squares, _ = pose_distances(recording, folder)
    limits = chi2.ppf(WITHIN, [2, 3])
    beyond = float((squares > limits).any(axis=1).mean()) if len(squares) else 0.0
    distances = np.stack([relative_distances(squares[:, k], 2 + k) for k in range(2)], axis=1)
    worst = float(distances.max(initial=0.0))
    calibration = calibration_sigmas(recording, folder) if 'calibrate' in found else {}
    largest = max(calibration.values(), default=float('nan'))
    states = state_distances(recording, folder)
    states_beyond = (
        float((states > chi2.ppf(WITHIN, 3)).any(axis=1).mean()) if len(states) else 0.0
    )
    findings = findings_of(found, folder)
    faults = [one for one in findings if one[1] in _FAULTS]
    words = ' '.join(f'{name} {text}' for name, _, text in faults)
    words += ' '.join(answer.text for name, answer in found.items() if name != 'check')
    named = re.search(case.named, words, re.IGNORECASE) if case.named else None
    wrong = sorted(
        {name for name, _, _ in faults if name in _DEVIATIONS and name not in case.codes}
    )
    reasons = []
    if any('Traceback' in answer.text for answer in found.values()):
        reasons.append('traceback')
    if beyond > LARGEST_SHARE or worst > LARGEST_SIGMA:
        reasons.append(f'poses {100 * beyond:.0f} % beyond, worst {worst:.1f} sigma')
    if largest > LARGEST_CALIBRATION_SIGMA:
        name = max(calibration, key=lambda key: calibration[key])
        reasons.append(f'calibrate: {name} {largest:.1f} sigma')
    if states_beyond > LARGEST_STATE_SHARE:
        reasons.append(f'odometry {100 * states_beyond:.0f} % beyond')
    if wrong:
        reasons.append(f'wrong cause: {", ".join(wrong)}')
    failed = bool(reasons)
    if case.named and not named:
        reasons.append('cause not named')
    if case.solvable and undisturbed and len(squares) < ENOUGH_POSES * undisturbed:
        reasons.append(f'{len(squares)} poses of {undisturbed}')
    return Verdict(
        case.name,
        'failure' if failed else 'poor' if reasons else 'good',
        '; '.join(reasons),
        len(squares),
        _pairs(folder),
        beyond,
        worst,
        largest,
        states_beyond,
        named[0] if named else '',
        ', '.join(wrong),
        seconds,
    )


def _pairs(folder: Path) -> int:
    path = folder / 'replay' / 'summary.json'
    return int(json.loads(path.read_text())['pairs']['total']) if path.exists() else 0
