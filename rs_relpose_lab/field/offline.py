"""Commands on a rebuilt recording, as a user gives them, and the evidence in their files."""

from __future__ import annotations

import csv
from dataclasses import dataclass
import json
import os
from pathlib import Path
import re
import subprocess
import sys
from typing import Any

import numpy as np
from scipy.spatial.transform import Rotation

from rs_relpose_lab.field import truth
from rs_relpose_lab.field.cases import Case
from rs_relpose_lab.field.evidence import Evidence, NamedCause
from rs_relpose_lab.field.recording import FieldRecording
from rs_relpose_ros.bags.reader import open_bag
from rs_relpose_ros.geometry import Array
from rs_relpose_ros.messages.incoming import stamp_ns, time_ns

# Seconds after which a command counts as hanging. [chosen: replays of these bags take ten]
LONGEST = 600.0

_COMMAND = 'import sys; from rs_relpose_ros.cli.main import main; sys.exit(main())'
# State of a finding of `check` by its verdict.
_CHECK_STATES = {'warning': 'suspect', 'failure': 'wrong'}


@dataclass(frozen=True, slots=True)
class Answer:
    """Exit code and words of one command."""

    command: str
    code: int
    text: str


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


def evidence_of(recording: FieldRecording, folder: Path, found: dict[str, Answer]) -> Evidence:
    """The evidence in the answers and in the files of the commands."""
    replay = _json_of(folder / 'replay' / 'summary.json')
    odometry = _json_of(folder / 'odometry' / 'summary.json')
    causes = [
        *(_check_causes(found['check']) if 'check' in found else ()),
        *_causes((replay.get('health') or {}).get('findings', ())),
        *_causes(odometry.get('findings', ())),
    ]
    calibration = _json_of(folder / 'calibrate' / 'calibration.json')
    return Evidence(
        truth.pose_distances(recording, replayed_poses(folder / 'replay')),
        int(replay['pairs']['total']) if replay else 0,
        _state_distances(recording, folder / 'odometry'),
        truth.calibration_sigmas(recording.truth, calibration) if calibration else {},
        tuple(causes),
        ' '.join(answer.text for name, answer in found.items() if name != 'check'),
    )


def _json_of(path: Path) -> dict[str, Any]:
    read: dict[str, Any] = json.loads(path.read_text()) if path.exists() else {}
    return read


def _check_causes(answer: Answer) -> list[NamedCause]:
    text = answer.text
    try:
        report = json.loads(text[text.index('{') : text.rindex('}') + 1])
    except ValueError:  # an error in place of a report
        return [NamedCause('error', 'wrong', text)]
    return [
        NamedCause(
            one['name'],
            _CHECK_STATES.get(one['verdict'], one['verdict']),
            f'{one["text"]} {one["remedy"]}',
        )
        for one in report['findings']
    ]


def _causes(findings: Any) -> list[NamedCause]:
    return [NamedCause(one['code'], one['state'], one['sentence']) for one in findings]


def replayed_poses(folder: Path) -> list[truth.PublishedPose]:
    """Relative poses of a replay; none if it failed."""
    path = folder / 'relpose_bag'
    if not path.exists():
        return []
    references: dict[int, int] = {}
    poses: list[Any] = []
    with open_bag(path) as bag:
        topics = [one for one in bag.topics if re.search('relative_pose$|reference$', one.name)]
        for message in bag.messages(topics):
            if message.topic.endswith('reference'):
                references[stamp_ns(message.message.header)] = time_ns(message.message.time_ref)
            else:
                poses.append(message.message)
    return published_poses(references, poses)


def published_poses(references: dict[int, int], messages: Any) -> list[truth.PublishedPose]:
    """Poses of messages; `references`: stamp of image 1 by the one of image 2."""
    poses = []
    for message in messages:
        stamp, published = stamp_ns(message.header), message.pose
        p, q = published.pose.position, published.pose.orientation
        poses.append(
            truth.PublishedPose(
                references[stamp],
                stamp,
                np.array([p.x, p.y, p.z]),
                Rotation.from_quat([q.x, q.y, q.z, q.w]),
                np.asarray(published.covariance, dtype=float).reshape(6, 6),
            )
        )
    return poses


# -- odometry -------------------------------------------------------------------------------------


def _state_distances(recording: FieldRecording, folder: Path) -> Array:
    """Squared distances (N, 2) of the states in odometry.csv; none without a path."""
    path = folder / 'odometry.csv'
    if not path.exists():
        return np.zeros((0, 2))
    with path.open(newline='') as file:
        rows = list(csv.DictReader(file))
    smoothed = _smoothed(folder / 'trajectory_smoothed.tum')
    parts = [
        _path_of([row for row in rows if row['path'] == number])
        for number in sorted({row['path'] for row in rows})
    ]
    distances = []
    for part in parts:
        first = part.kept(slice(0, 1))
        origin = first if smoothed is None else truth.smoothed_origin(part, smoothed)
        distances.append(truth.state_distances(recording, part, origin))
    return np.concatenate([np.zeros((0, 2)), *distances])


def _path_of(rows: list[dict[str, str]]) -> truth.Path:
    def values(*names: str) -> Array:
        return np.array([[float(row[name]) for name in names] for row in rows])

    covariances = values(*(f'c{i}{j}' for i in range(6) for j in range(6)))
    return truth.Path(
        np.array([int(row['stamp_ns']) for row in rows], dtype=np.int64),
        values('x', 'y', 'z'),
        Rotation.from_quat(values('qx', 'qy', 'qz', 'qw')),
        covariances.reshape(-1, 6, 6),
    )


def _smoothed(path: Path) -> truth.Path | None:
    """Poses of trajectory_smoothed.tum: stamp [s], position, quaternion."""
    lines = path.read_text(encoding='utf-8').split('\n') if path.exists() else []
    words = [line.split() for line in lines if line]
    if not words:
        return None
    stamps = [int(one[0].replace('.', '')) for one in words]  # of nine decimals
    values = np.array([[float(word) for word in one[1:]] for one in words])
    return truth.Path(
        np.array(stamps, dtype=np.int64),
        values[:, :3],
        Rotation.from_quat(values[:, 3:]),
        np.zeros((len(words), 6, 6)),
    )
