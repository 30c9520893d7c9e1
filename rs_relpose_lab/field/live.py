"""A rebuilt recording played to running nodes, and the evidence in what they publish."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from functools import partial
from pathlib import Path
import re
from typing import Any

import numpy as np
from scipy.spatial.transform import Rotation

from rs_relpose_lab.field import truth
from rs_relpose_lab.field.evidence import Evidence, NamedCause
from rs_relpose_lab.field.offline import published_poses
from rs_relpose_lab.field.recording import FieldRecording
from rs_relpose_lab.live.graph import diagnostic_values, Graph, private_domain
from rs_relpose_lab.live.live_run import remap_and_duration
from rs_relpose_lab.live.processes import (
    node_process,
    PATIENCE,
    player_process,
    wait_until,
    wait_until_quiet,
)
from rs_relpose_ros.calibration import findings_text
from rs_relpose_ros.calibration.findings import Finding, FindingState
from rs_relpose_ros.geometry import Array
from rs_relpose_ros.messages.incoming import stamp_ns, time_ns
from rs_relpose_ros.messages.outgoing import PAIR_TOPICS
from rs_relpose_ros.nodes.inputs import message_class

# The nodes have published all if no pair came for so long [s]. Less would end a run while a pair
# is computed on a busy machine. [chosen: pairs come every 0.2 s; 1 to 5 would do]
_QUIET = 3.0
# Names of the nodes, which are the first part of their topics. [derived: interface]
_FRONT_END, _ODOMETRY = 'relpose_node', 'odometry_node'
# Pair topics that are compared with the truth. [derived: interface]
_COMPARED = ('relative_pose', 'reference', 'pairs')
# Lines of a node's log that a user takes for a complaint.
_COMPLAINT = re.compile(r'^\[(?:WARN|ERROR|FATAL).*$', re.MULTILINE)
# States from harmless to severe.
_SEVERITY = tuple(FindingState)


class _Subscriptions:
    """What the nodes publish."""

    def __init__(self, graph: Graph) -> None:
        self.pairs: dict[str, list[Any]] = {
            topic: graph.listen(message_class(PAIR_TOPICS[topic]), f'/{_FRONT_END}/{topic}')
            for topic in _COMPARED
        }
        states = message_class('nav_msgs/msg/Odometry')
        self.states = graph.listen(states, f'/{_ODOMETRY}/odometry')
        self.keyframes = graph.listen(states, f'/{_ODOMETRY}/keyframes')
        diagnostics = message_class('diagnostic_msgs/msg/DiagnosticArray')
        self.diagnostics = graph.listen(diagnostics, '/diagnostics')


def play(recording: FieldRecording, bag: Path, parameters: Path, folder: Path) -> Evidence:
    """Play a bag, at its own speed, to a new relpose_node and odometry_node; logs in `folder`."""
    remap, duration = remap_and_duration(bag)
    # A busy machine loses messages of best effort, which is no property of the nodes.
    reliable = {
        f'qos_overrides.{topic}.subscription.reliability': 'reliable'
        for topic in (remap['image'] + '/compressed', remap['imu'])
    }
    start = partial(node_process, parameters, remap=remap, parameters=reliable)
    with (
        private_domain(),
        Graph() as graph,
        start(log=folder / 'relpose_node.log') as front_end,
        start(log=folder / 'odometry_node.log', node=_ODOMETRY) as odometry,
    ):
        nodes = front_end, odometry
        heard = _Subscriptions(graph)
        for node in nodes:
            node.wait_for('ready')
        for topic in _COMPARED:
            graph.wait_for_publisher(f'/{_FRONT_END}/{topic}', *nodes)
        graph.wait_for_publisher(f'/{_ODOMETRY}/odometry', *nodes)
        with player_process(bag, log=folder / 'player.log') as player:
            wait_until(player.ended, 'the end of the player', *nodes, timeout=PATIENCE + duration)
        wait_until_quiet(lambda: len(heard.pairs['pairs']), _QUIET, front_end)
        for node in nodes:
            node.stop()
        logs = [node.output for node in nodes]
    return _evidence(recording, heard, logs)


def _evidence(recording: FieldRecording, heard: _Subscriptions, logs: Sequence[str]) -> Evidence:
    references = {
        stamp_ns(message.header): time_ns(message.time_ref) for message in heard.pairs['reference']
    }
    complete = [
        message
        for message in heard.pairs['relative_pose']
        if stamp_ns(message.header) in references
    ]
    complaints = [line for log in logs for line in _COMPLAINT.findall(log)]
    return Evidence(
        truth.pose_distances(recording, published_poses(references, complete)),
        len(heard.pairs['pairs']),
        _state_distances(recording, heard, list(references.values())),
        {},
        tuple(_causes(heard.diagnostics)),
        '\n'.join(complaints),
    )


def _state_distances(
    recording: FieldRecording, heard: _Subscriptions, references_ns: Sequence[int]
) -> Array:
    """Squared distances (N, 2) of the published states; their origin is a reference of a pair."""
    if not (heard.states and heard.keyframes):
        return np.zeros((0, 2))
    path = _path_of(heard.states)
    # A keyframe has the stamp of its middle row, an image that of the row of its header.
    keyframe = stamp_ns(heard.keyframes[0].header)
    row_ns = keyframe - max(shot.stamp_ns for shot in recording.shots if shot.stamp_ns <= keyframe)
    begins = {reference + row_ns for reference in references_ns}
    origin = truth.fitted_origin(recording, path, begins)
    return truth.state_distances(recording, path, origin)


def _path_of(messages: Sequence[Any]) -> truth.Path:
    poses = [message.pose.pose for message in messages]
    places = [(pose.position.x, pose.position.y, pose.position.z) for pose in poses]
    turns = [pose.orientation for pose in poses]
    return truth.Path(
        np.array([stamp_ns(message.header) for message in messages], dtype=np.int64),
        np.array(places),
        Rotation.from_quat([(q.x, q.y, q.z, q.w) for q in turns]),
        np.array([message.pose.covariance for message in messages]).reshape(-1, 6, 6),
    )


def _causes(diagnostics: Iterable[Any]) -> list[NamedCause]:
    """The findings of a run, each in its most severe state at any time of it."""
    worst: dict[str, Finding] = {}
    for message in diagnostics:
        text = diagnostic_values(message).get('findings', '')
        for finding in findings_text.read_message_json(text).findings if text else ():
            known = worst.setdefault(finding.code.value, finding)
            if _SEVERITY.index(finding.state) > _SEVERITY.index(known.state):
                worst[finding.code.value] = finding
    return [
        NamedCause(code, finding.state.value, findings_text.text_of(finding).description)
        for code, finding in worst.items()
    ]
