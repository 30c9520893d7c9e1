"""A filter behind `odometry_node` through a loss, its recovery, and the covariance after it.

As ekf_node of robot_localization, which is in no wheel, with the shipped configuration: it fuses
pose and twist of ``~/odometry`` by their covariances, and predicts where nothing comes. The
messages are those of the node, of states as it publishes them.
"""

from functools import partial
from itertools import pairwise
from types import SimpleNamespace

from conftest import ROOT
from nav_msgs.msg import Odometry
import numpy as np
import pytest
from scipy.spatial.transform import Rotation
from test_odometry import PARAMETERS, Walk, walk, without
import yaml

from rs_relpose_ros.geometry.so3 import exp_so3, log_so3, skew
from rs_relpose_ros.nodes.odometry_node import OdometryNode

pytest.importorskip('gtsam', reason='needs the extra odometry')

from rs_relpose_ros.odometry.estimator import OdometryEstimator
from rs_relpose_ros.odometry.offline import follow, PublishedStates

RATE = 30.0
# Step of the filter's prediction [s]: `frequency` of the shipped configuration.
STEP = 0.02
# No pairs for longer than the node coasts (`max_coast` 2 s here), in seconds of the walk.
GAP = (5.0, 9.0)
SECOND = 1_000_000_000


def message_of(state) -> Odometry:
    node = SimpleNamespace(_config=SimpleNamespace(odometry_frame='odom'))
    node._pose = partial(OdometryNode._pose, node)
    return OdometryNode._message(node, state)


class Published(SimpleNamespace):
    """States of a walk with a gap of pairs, and their messages."""

    @property
    def first_after(self) -> int:
        """Index of the first state of the second path."""
        return next(k for k, state in enumerate(self.states) if state.path == 1)


@pytest.fixture(scope='module')
def published() -> Published:
    given: Walk = walk('walk:14', 14.0, seed=4)
    estimator = OdometryEstimator(PARAMETERS)
    sink = PublishedStates(estimator, RATE)
    follow(
        estimator,
        [(pair.current_imu_ns + SECOND // 50, pair) for pair in without(given.pairs, *GAP)],
        [(sample.stamp_ns, sample) for sample in given.samples],
        sink.after,
    )
    return Published(
        walk=given,
        estimator=estimator,
        states=sink.published,
        messages=[message_of(state) for state in sink.published],
    )


class Filter:
    """Extended Kalman filter of pose and twist, with a constant twist between measurements."""

    def __init__(self, message: Odometry) -> None:
        self.p, self.R, self.w = measured(message)
        self.P = np.eye(12) * 1e-2
        self.P[:6, :6] = np.reshape(message.pose.covariance, (6, 6))

    def predict(self, seconds: float) -> None:
        for dt in np.diff(np.append(np.arange(0.0, seconds, STEP), seconds)):
            F = np.eye(12)
            F[:3, 3:6] = -skew(self.R @ self.w[:3]) * dt
            F[:3, 6:9] = F[3:6, 9:] = self.R * dt
            self.p = self.p + self.R @ self.w[:3] * dt
            self.R = self.R @ exp_so3(self.w[3:] * dt)
            # Accelerations of 3 m/s^2 and 3 rad/s^2.
            Q = np.diag([1e-8] * 6 + [9.0 * dt**2] * 6) * (dt / STEP)
            self.P = F @ self.P @ F.T + Q

    def correct(self, message: Odometry, covariance: np.ndarray | None = None) -> float:
        """Fuse a message; its squared innovation of the pose, per degree of freedom."""
        p, R, w = measured(message)
        N = np.zeros((12, 12))
        own = np.reshape(message.pose.covariance, (6, 6)) if covariance is None else covariance
        N[:6, :6], N[6:, 6:] = own, np.reshape(message.twist.covariance, (6, 6))
        e = np.concatenate([p - self.p, log_so3(R @ self.R.T), w - self.w])
        S = self.P + N
        K = self.P @ np.linalg.inv(S)
        x = K @ e
        self.P = self.P - K @ S @ K.T
        self.p, self.R, self.w = self.p + x[:3], exp_so3(x[3:6]) @ self.R, self.w + x[6:]
        return float(e[:6] @ np.linalg.solve(S[:6, :6], e[:6])) / 6.0


def measured(message: Odometry) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    pose = message.pose.pose
    twist = message.twist.twist
    p = pose.position
    q = pose.orientation
    v = twist.linear
    w = twist.angular
    return (
        np.array([p.x, p.y, p.z]),
        Rotation.from_quat([q.x, q.y, q.z, q.w]).as_matrix(),
        np.array([v.x, v.y, v.z, w.x, w.y, w.z]),
    )


def seconds_between(first: Odometry, second: Odometry) -> float:
    stamps = [
        message.header.stamp.sec * SECOND + message.header.stamp.nanosec
        for message in (first, second)
    ]
    return (stamps[1] - stamps[0]) / SECOND


def error_in_sigmas(published: Published, begin: int, end: int) -> float:
    """Squared error of the movement between two states, by the covariance that the second adds."""
    truth = published.walk.truth
    one = published.states[begin]
    other = published.states[end]
    R = one.R @ truth.rotation(one.imu_ns).T  # the world of the path, in which z is up, too
    moved = other.position - one.position
    true = R @ (truth.position(other.imu_ns) - truth.position(one.imu_ns))
    added = other.pose_covariance[:3, :3] + one.pose_covariance[:3, :3]
    # The heading at the first state turns the movement.
    added += np.outer(*[skew([0.0, 0.0, 1.0]) @ true] * 2) * one.pose_covariance[5, 5]
    e = moved - true
    return float(e @ np.linalg.solve(added, e)) / 3.0


def test_the_loss_is_silence_and_the_recovery_another_path_in_the_same_frame(published):
    states = published.states
    first = published.first_after
    assert published.estimator.counts['lost'] == 1
    silence = seconds_between(published.messages[first - 1], published.messages[first])
    assert silence > 1.0
    assert {state.path for state in states} == {0, 1}
    assert (np.diff([state.stamp_ns for state in states]) > 0).all()
    heads = {(one.header.frame_id, one.child_frame_id) for one in published.messages}
    assert len(heads) == 1


def test_the_covariance_after_a_loss_covers_it(published):
    """It is not that of a path that begins: what the silence added is in it."""
    states = published.states
    first = published.first_after
    sigma = [float(np.sqrt(np.trace(one.pose_covariance[:3, :3]))) for one in states]
    assert sigma[first] > 1.3 * sigma[first - 1] > 1.3 * min(sigma[:first])
    assert max(error_in_sigmas(published, 10, k) for k in range(20, len(states), 5)) < 4.0
    for one in published.messages[first:]:
        P = np.reshape(one.pose.covariance, (6, 6))
        assert np.linalg.eigvalsh(P).min() >= 0.0
        assert np.allclose(P, P.T)


def test_a_filter_follows_through_a_loss(published):
    """Its innovations stay within the covariances, and it is on the path again at once."""
    text = (ROOT / 'config' / 'robot_localization.yaml').read_text()
    ekf = yaml.safe_load(text)['ekf_filter_node']['ros__parameters']
    assert ekf['odom0_config'][:12] == [True] * 12 and ekf['frequency'] == 1.0 / STEP
    messages = published.messages
    first = published.first_after
    after_silence = []
    spread = []
    fusing = Filter(messages[0])
    for k, (before, message) in enumerate(pairwise(messages), start=1):
        fusing.predict(seconds_between(before, message))
        if k == first:
            spread = np.sqrt(np.diag(fusing.P)[:3])
        innovation = fusing.correct(message)
        after_silence += [innovation] if k == first else []
        distance = float(np.linalg.norm(fusing.p - measured(message)[0]))
        assert distance < (0.1 if k != first else 0.5), k
    assert spread.min() > 1.0  # the prediction of the filter alone is worth nothing by then
    # Within 3 sigma of what a constant twist with this noise predicts; a walk has none.
    assert after_silence[0] < 9.0
    assert np.sqrt(np.diag(fusing.P)[:3]).max() < 1.0


def test_a_filter_that_kept_the_covariance_from_before_the_loss_would_be_too_certain(published):
    """What the covariance after the loss is for: the filter knows as little as the odometry."""
    messages = published.messages
    first = published.first_after
    old = np.reshape(messages[first // 2].pose.covariance, (6, 6))
    sigmas = []
    for covariance in (None, old):
        fusing = Filter(messages[first - 1])
        fusing.predict(seconds_between(messages[first - 1], messages[first]))
        fusing.correct(messages[first], covariance)
        sigmas.append(float(np.sqrt(np.trace(fusing.P[:3, :3]))))
    own = np.reshape(messages[first].pose.covariance, (6, 6))
    assert sigmas[0] == pytest.approx(float(np.sqrt(np.trace(own[:3, :3]))), rel=0.3)
    assert sigmas[1] < 0.5 * sigmas[0]
