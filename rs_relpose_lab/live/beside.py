"""global_shutter_node and relpose_node side by side on a bag in real time: what each dropped."""

from __future__ import annotations

from contextlib import ExitStack
from dataclasses import dataclass
import os
from pathlib import Path

from rs_relpose_lab.live.graph import diagnostic_values, Graph, private_domain
from rs_relpose_lab.live.processes import (
    node_process,
    PATIENCE,
    player_process,
    process_figures,
    wait_until,
)
from rs_relpose_ros.bags.reader import open_bag
from rs_relpose_ros.node.message_types import message_class

# Folder of the package -> node.
_NODES = {'node': 'relpose_node', 'global_shutter': 'global_shutter_node'}


@dataclass(frozen=True, slots=True)
class Beside:
    """What a node did while both ran; times in ms, as its diagnostics tell them."""

    node: str
    received: int
    refused: int
    frame_time_p50: float
    latency_p50: float
    latency_p99: float
    cpu_percent: float   # of a core


def run_beside(bag: Path, parameters: Path, folder: Path, profile: Path) -> list[Beside]:
    """Play `bag` to both nodes; logs into `folder`, which exists; `profile`: of Fast DDS."""
    with open_bag(bag) as opened:
        topics, duration = opened.find_topics(), opened.duration
    assert topics.camera_info is not None
    remap = {'image': topics.image.name.removesuffix('/compressed'), 'imu': topics.imu.name,
             'camera_info': topics.camera_info.name}
    with private_domain(), ExitStack() as stack:
        os.environ['FASTRTPS_DEFAULT_PROFILES_FILE'] = str(profile)
        graph = stack.enter_context(Graph())
        # Somebody must want the images.
        images = graph.listen(message_class('sensor_msgs/msg/Image'), '/global_shutter_node/image')
        reports = graph.listen(message_class('diagnostic_msgs/msg/DiagnosticArray'),
                               '/diagnostics')
        nodes = {name: stack.enter_context(node_process(
            parameters, remap=remap, folder=of, parameters={'image_transport': 'raw'},
            log=folder / f'{name}.log')) for of, name in _NODES.items()}
        for node in nodes.values():
            node.wait_for('ready')
        graph.wait_for_publisher('/global_shutter_node/image')
        before = {name: process_figures(node.pid) for name, node in nodes.items()}
        # Three topics, two nodes.
        with player_process(bag, '--decode', 'mono8', '--subscriptions', '6',
                            log=folder / 'player.log') as player:
            wait_until(player.ended, 'the end of the player', *nodes.values(),
                       timeout=2.0 * PATIENCE + duration)
        count = len(reports)
        wait_until(lambda: len(reports) >= count + 4, 'diagnostics', *nodes.values())
        found = []
        for name, node in nodes.items():
            after = process_figures(node.pid)
            values = diagnostic_values([r for r in reports if r.status[0].name.startswith(
                f'/{name}:')][-1])
            found.append(Beside(
                name, int(values['frames_received']),
                sum(int(value) for key, value in values.items()
                    if key.startswith('frames_refused_')),
                float(values['frame_time_p50_ms']), float(values['latency_p50_ms']),
                float(values['latency_p99_ms']),
                100.0 * (after.cpu - before[name].cpu) / (
                    1e-9 * (after.time_ns - before[name].time_ns))))
            node.stop()
        assert images, 'no image was published'
    return found
