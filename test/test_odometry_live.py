"""odometry_node beside relpose_node and a player, as processes over DDS, on the bundled bag."""

from __future__ import annotations

from conftest import BUNDLED_PARAMETERS
from diagnostic_msgs.msg import DiagnosticArray
from fault_stream import BAG_TOPICS
from nav_msgs.msg import Odometry as OdometryMessage
from nav_msgs.msg import Path as PathMessage
import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from rs_relpose_lab.live.graph import diagnostic_values, Graph
from rs_relpose_lab.live.processes import (
    node_process,
    player_process,
    wait_until,
    wait_until_quiet,
)
from rs_relpose_ros.bags.reader import open_bag
from rs_relpose_ros.config.parameter_file import read_parameters
from rs_relpose_ros.messages.incoming import stamp_ns
from rs_relpose_ros.messages.sensor_feed import PARTS, Role
from rs_relpose_ros.odometry.measurement import PairMeasurement
from rs_relpose_ros.odometry.odometry import OdometryEstimator
from rs_relpose_ros.odometry.trajectory import aligned
from rs_relpose_ros.replay.run import read_truth

# relpose_node may have to compile the kernels.
pytestmark = [pytest.mark.live, pytest.mark.timeout(600)]


def place(message):
    p = message.pose.pose.position
    return np.array([p.x, p.y, p.z])


def test_path_is_metric_and_that_of_the_replay(ros_domain_id, bundled_bag):
    imu = {'imu': BAG_TOPICS['imu']}
    with Graph() as graph, \
            node_process(BUNDLED_PARAMETERS, remap=BAG_TOPICS) as relpose, \
            node_process(BUNDLED_PARAMETERS, remap=imu,
                         folder='odometry') as node:
        received = graph.listen(OdometryMessage, '/odometry_node/odometry')
        paths = graph.listen(PathMessage, '/odometry_node/path')
        pairs = graph.listen(DiagnosticArray, '/relpose_node/pairs')
        diagnostics = graph.listen(DiagnosticArray, '/diagnostics')
        relpose.wait_for('ready')
        node.wait_for('ready')
        graph.wait_for_publisher('/odometry_node/odometry')
        # The one of this test, and the node's, which must not miss the first pair.
        wait_until(lambda: graph.node.count_subscribers('/relpose_node/pairs') == 2,
                   'the subscriptions', node)
        # Three topics of relpose_node, the IMU of odometry_node.
        with player_process(bundled_bag, '--subscriptions', '4') as playing:
            assert playing.wait() == 0
        # The last keyframe waits for samples; on a busy machine the last pairs are late.
        wait_until_quiet(lambda: len(received), 2.0, node)
        count = len(paths)
        wait_until(lambda: len(paths) > count, 'a path', node)
        assert len(paths[-1].poses) >= 10
        node.stop()
        relpose.stop()
        assert 'started' in node.output
        assert 'lost' not in node.output
    values = [diagnostic_values(message) for message in diagnostics
              if 'odometry_node' in message.status[0].name]
    assert values[-1]['state'] == 'tracking'

    # The same pairs and samples, given to the estimator in another order.
    parameters = read_parameters(BUNDLED_PARAMETERS)
    estimator = OdometryEstimator(parameters)
    with open_bag(bundled_bag) as bag:
        topics = bag.find_topics()
        truth = read_truth(bag, topics)
        for message in bag.messages([topics.imu]):
            estimator.add_imu(PARTS[Role.IMU].read(message.message))
    keyframes = {}
    for message in sorted(pairs, key=lambda message: stamp_ns(message.header)):
        estimator.add_pair(PairMeasurement.of_message(message))
        keyframes |= {keyframe.stamp_ns: keyframe for keyframe in estimator.take()}
    of_keyframes = [message for message in received if stamp_ns(message.header) in keyframes]
    assert len(of_keyframes) >= 10
    for message in of_keyframes:
        keyframe, q = keyframes[stamp_ns(message.header)], message.pose.pose.orientation
        np.testing.assert_allclose(place(message), keyframe.position, atol=1e-3)
        turn = Rotation.from_quat([q.x, q.y, q.z, q.w]).inv() * Rotation.from_matrix(keyframe.R)
        assert np.degrees(turn.magnitude()) < 0.01
        assert message.header.frame_id == 'odom'
        assert message.child_frame_id == 'camera_optical_frame'

    # Between keyframes the IMU carries it on; the camera's clock is that of the IMU here.
    carried = [message for message in received if stamp_ns(message.header) not in keyframes]
    # Twelve frames in all to a keyframe, less what a busy machine loses.
    assert len(carried) > 2 * len(of_keyframes)
    for messages in (of_keyframes, carried):
        at = [stamp_ns(message.header) for message in messages]
        known = [k for k, ns in enumerate(at) if truth.covers(ns)]
        places = np.array([place(messages[k]) for k in known])
        true = np.array([truth.position(at[k]) for k in known])
        R, t, scale = aligned(places, true)
        assert np.sqrt(((places @ R.T + t - true) ** 2).sum(axis=1).mean()) < 0.08
        assert scale == pytest.approx(1.0, abs=0.03)
        # z is up in both: gravity is found.
        assert R[2, 2] > np.cos(np.radians(2.0))
