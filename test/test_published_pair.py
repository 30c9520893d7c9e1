"""The messages of a pair gathered and read back, whatever comes."""

from __future__ import annotations

from array import array
from collections.abc import Callable, Iterator
import copy
import csv
from dataclasses import fields, replace
import itertools
from typing import Any

from fuzz_messages import mutated_bytes
import message_builders as build
import numpy as np
import pytest
from simulated_pairs import simulated_flight

from rs_relpose_lab.live.live_run import Recorder
from rs_relpose_ros.errors import InputError
from rs_relpose_ros.estimator.image_information import ImageInformation
from rs_relpose_ros.estimator.result import RelativePose, Status
from rs_relpose_ros.front_end.pair import PairResult
from rs_relpose_ros.messages.outgoing import (
    inlier_records,
    MATCH_DTYPE,
    pair_messages,
    PAIR_TOPICS,
    PairMessages,
)
from rs_relpose_ros.messages.pose_chain import PoseChain
from rs_relpose_ros.messages.published_pair import PairSynchronizer, published_pair


@pytest.fixture(scope='module')
def results() -> list[PairResult]:
    return simulated_flight(4, points=30).pairs


@pytest.fixture(params=[build.rclpy_types, build.rosbags_types], ids=['rclpy', 'rosbags'])
def pairs(request, results) -> list[PairMessages]:
    """Messages of four pairs, of their own: tests may spoil them."""
    return [pair_messages(result, request.param) for result in results]


def parts(messages: PairMessages) -> list[tuple[str, Any]]:
    return list(messages.by_topic())


def turned_only(result: PairResult, status: Status = Status.PURE_ROTATION) -> PairResult:
    """The pair with a rotation alone."""
    return replace(result, pose=result.pose.without_translation(status, 'no parallax'))


def without_rotation(result: PairResult) -> PairResult:
    return replace(result, pose=RelativePose(
        status=Status.NO_CONSENSUS, reason='nothing agrees',
        inliers=np.zeros(len(result.matches), dtype=bool)))


def test_topics_are_the_messages():
    assert set(PAIR_TOPICS) == {field.name for field in fields(PairMessages)}


def test_the_table_of_a_live_run_is_that_of_the_replay(results, tmp_path):
    class Topics:
        def listen(self, _: type, topic: str) -> list[Any]:
            return [getattr(messages, topic.rpartition('/')[2]) for messages in published]

        def wait_for_publisher(self, *_: Any) -> None:
            pass

    published = [pair_messages(result, build.rclpy_types) for result in results]
    path = tmp_path / 'live.csv'
    assert Recorder(Topics(), None).write(path) == len(results)
    with path.open(encoding='ascii') as file:
        rows = list(csv.DictReader(file))
    for row, result in zip(rows, results, strict=True):
        assert (row['stamp_ns'], row['status']) == (str(result.stamp_ns), 'OK')
        assert float(row['tx']) == result.pose.t[0]
        assert row['baseline_m'] == ('' if np.isnan(result.pose.baseline)
                                     else repr(result.pose.baseline))


def test_what_was_published_is_read_back(pairs, results):
    for messages, result in zip(pairs, results, strict=True):
        pair = published_pair(messages)
        assert (pair.reference_stamp_ns, pair.stamp_ns, pair.frame_id) == (
            result.reference_stamp_ns, result.stamp_ns, 'camera')
        assert pair and pair.rotation_known
        assert (pair.status, pair.reason) == ('OK', '')
        assert (pair.reference_imu_ns, pair.current_imu_ns) == (
            result.reference_ns1, result.reference_ns2)
        np.testing.assert_allclose(pair.R, result.pose.R, atol=1e-15)
        np.testing.assert_array_equal(pair.t, result.pose.t)
        for name in ('covariance', 'velocity_covariance'):
            np.testing.assert_allclose(getattr(pair, name), getattr(result.pose, name), rtol=1e-9,
                                       atol=1e-18)
        np.testing.assert_array_equal(pair.linear_velocity, result.pose.linear_velocity2)
        np.testing.assert_array_equal(pair.angular_velocity, result.pose.angular_velocity2)
        np.testing.assert_array_equal(pair.matches, inlier_records(result))


@pytest.mark.parametrize('types', [build.rclpy_types, build.rosbags_types])
@pytest.mark.parametrize('rotation_alone', [False, True])
def test_what_the_images_alone_say_is_read_back(results, types, rotation_alone):
    rng, pose = np.random.default_rng(0), results[0].pose
    root = rng.normal(size=(11, 11))
    images = ImageInformation(0.015, pose.R, pose.t, rng.normal(size=6), root.T @ root,
                              rng.normal(size=11))
    if rotation_alone:
        images = images.of_rotation()
    result = replace(results[0], pose=replace(pose, images=images))
    read = published_pair(pair_messages(result, types)).images
    for name in ('row_time', 't', 'velocities', 'information', 'gradient'):
        np.testing.assert_array_equal(getattr(read, name), getattr(images, name))
    np.testing.assert_allclose(read.R, images.R, atol=1e-15)


@pytest.mark.parametrize('types', [build.rclpy_types, build.rosbags_types])
def test_a_rotation_alone_is_read_back(results, types):
    result = turned_only(results[0], Status.LOW_PARALLAX)
    result = replace(result, gyro_bias=np.array([0.1, -2e-3, 1e-17]), pose=replace(
        result.pose, baseline=0.25, baseline_log_sigma=0.1))
    pair = published_pair(pair_messages(result, types))
    assert not pair and pair.rotation_known
    assert (pair.status, pair.reason, pair.frame_id) == ('LOW_PARALLAX', 'no parallax', 'camera')
    assert (pair.reference_stamp_ns, pair.stamp_ns) == (
        result.reference_stamp_ns, result.stamp_ns)
    np.testing.assert_allclose(pair.R, result.pose.R, atol=1e-15)
    np.testing.assert_array_equal(pair.angular_velocity, result.pose.angular_velocity2)
    np.testing.assert_array_equal(pair.gyro_bias, result.gyro_bias)
    assert (pair.baseline, pair.baseline_log_sigma) == (0.25, 0.1)
    assert np.isnan([*pair.t, *pair.linear_velocity]).all()
    # NaN in the same places.
    for name in ('covariance', 'velocity_covariance'):
        np.testing.assert_allclose(getattr(pair, name), getattr(result.pose, name), rtol=1e-12,
                                   atol=1e-18)
    assert np.isnan(pair.covariance[:3]).all() and np.isfinite(pair.covariance[3:, 3:]).all()
    assert (pair.matches.shape, pair.matches.dtype) == ((0,), MATCH_DTYPE)


def test_a_pair_without_a_rotation_is_told_at_once(results):
    [part] = parts(pair_messages(without_rotation(results[0]), build.rosbags_types))
    pair = PairSynchronizer().add(*part)
    assert pair is not None
    assert not pair and not pair.rotation_known
    assert (pair.status, pair.reason) == ('NO_CONSENSUS', 'nothing agrees')
    assert pair.reference_stamp_ns == results[0].reference_stamp_ns
    assert np.isnan(pair.gyro_bias).all() and np.isnan(pair.baseline)


@pytest.mark.parametrize('kind', [lambda result: result, turned_only, without_rotation])
def test_messages_come_in_any_order(results, kind):
    given = parts(pair_messages(kind(results[0]), build.rosbags_types))
    assert len(given) == {'<lambda>': 6, 'turned_only': 2, 'without_rotation': 1}[kind.__name__]
    synchronizer = PairSynchronizer()
    for order in itertools.permutations(given):
        *first, last = [synchronizer.add(*part) for part in order]
        assert first == [None] * (len(given) - 1)
        assert last is not None
        assert last.stamp_ns == results[0].stamp_ns
    assert synchronizer.given_up == 0


def test_a_topic_may_run_ahead(pairs, results):
    """All of one topic before all of the next, the pairs of the last in reverse."""
    synchronizer = PairSynchronizer()
    for topic in ('pairs', 'relative_rotation', 'matches', 'reference', 'relative_pose'):
        assert [synchronizer.add(topic, getattr(pair, topic)) for pair in pairs] == [None] * 4
    found = [synchronizer.add('velocity', pair.velocity) for pair in reversed(pairs)]
    assert [pair and pair.stamp_ns for pair in found] == [
        result.stamp_ns for result in reversed(results)]
    assert synchronizer.given_up == 0


def test_incomplete_pairs_do_not_pile_up(pairs, results):
    synchronizer = PairSynchronizer(capacity=3)
    lost, whole = pairs[0].velocity, pairs[1]
    for number in range(1000):
        lost = copy.deepcopy(lost)
        lost.header.stamp.sec += 1
        assert synchronizer.add('velocity', lost) is None
        assert synchronizer.given_up == max(number - 2, 0)
    # The newest are kept, and what is whole goes through.
    found = [synchronizer.add(*part) for part in parts(whole)]
    assert [pair is not None for pair in found] == [False] * 5 + [True]
    assert synchronizer.given_up == 998
    others = [topic for topic in PAIR_TOPICS if topic != 'velocity']
    for topic in others:
        getattr(pairs[0], topic).header.stamp = lost.header.stamp
    found = [synchronizer.add(topic, getattr(pairs[0], topic)) for topic in others]
    assert [pair is not None for pair in found] == [False] * 4 + [True]
    assert synchronizer.given_up == 998


def test_a_repeated_message_replaces_the_first(pairs):
    synchronizer = PairSynchronizer()
    assert [synchronizer.add(*parts(pairs[0])[0]) for _ in range(5)] == [None] * 5
    assert [synchronizer.add(*part) is not None for part in parts(pairs[0])] == [
        *[False] * 5, True]


def set_data(cloud: Any, data: bytes) -> None:
    cloud.data = array('B', data) if isinstance(cloud.data, array) else np.frombuffer(
        data, np.uint8)


def test_no_match_is_an_array_of_none(pairs):
    pairs[0].matches.width = 0
    set_data(pairs[0].matches, b'')
    matches = published_pair(pairs[0]).matches
    assert (matches.shape, matches.dtype) == ((0,), MATCH_DTYPE)


def put(place: Any, path: str, value: Any) -> None:
    """Set a field by its path, such as ``'fields.3.name'``."""
    *parents, name = path.split('.')
    for parent in parents:
        number = parent.removeprefix('-').isdigit()
        place = place[int(parent)] if number else getattr(place, parent)
    setattr(place, name, value)


def changed_records(name: str, change: Callable[[np.ndarray], object]) -> Callable[[Any], bytes]:
    def data(cloud: Any) -> bytes:
        records = np.frombuffer(bytes(cloud.data), MATCH_DTYPE).copy()
        change(records[name])
        return records.tobytes()
    return data


@pytest.mark.parametrize(('path', 'value', 'sentence'), [
    ('fields.3.name', 'intensity', 'must have the fields u1 v1 .* got u1 v1 u2 intensity'),
    ('fields.0.name', 'v1', 'got v1 v1'),
    ('fields.1.datatype', 8, 'must have the fields'),
    ('fields.1.count', 2**32 - 1, 'must have the fields'),
    ('fields.1.offset', 2**32 - 1, 'must have the fields'),
    ('fields', [], 'got none'), ('is_bigendian', True, 'got .* big endian'),
    ('point_step', 0, ' 0 bytes$'),
    ('width', 2**32 - 1, 'has 2400 bytes of data, but 4294967295x1 points need'),
    ('data', lambda cloud: bytes(cloud.data)[:-1],
     'has 2399 bytes of data, but 30x1 points need 2400'),
    ('data', lambda cloud: bytes(cloud.data) + bytes(MATCH_DTYPE.itemsize), 'has 2480 bytes'),
    ('data', changed_records('tau2', lambda column: column.put(5, np.inf)),
     '~/matches must be finite'),
    ('data', changed_records('z2', lambda column: np.add(column, 1.0, out=column)),
     'the rays x2 y2 z2 of ~/matches must have length 1'),
])
def test_a_malformed_cloud_is_refused(pairs, path, value, sentence):
    cloud = pairs[0].matches
    if path == 'data':
        set_data(cloud, value(cloud))
    else:
        put(cloud, path, value)
    synchronizer = PairSynchronizer()
    *first, last = parts(pairs[0])
    assert [synchronizer.add(*part) for part in first] == [None] * 5
    with pytest.raises(InputError, match=sentence) as caught:
        synchronizer.add(*last)
    assert '\n' not in str(caught.value)
    assert len(str(caught.value)) < 400
    # Nothing of it is left, and the next pair is as good as ever.
    assert [synchronizer.add(*part) is not None for part in parts(pairs[1])][-1]


@pytest.mark.parametrize(('topic', 'path', 'value', 'sentence'), [
    ('relative_pose', 'pose.pose.position.x', float('nan'), 'position .* length 1'),
    ('relative_pose', 'pose.pose.position.x', 2.0, 'position .* length 1'),
    ('relative_pose', 'pose.pose.orientation.w', float('nan'), 'orientation .* length 1'),
    ('relative_pose', 'pose.pose.orientation.x', 7.0, 'orientation .* length 1'),
    ('velocity', 'twist.twist.linear.z', float('nan'), 'linear velocity .* at most'),
    ('velocity', 'twist.twist.angular.z', float('inf'), 'angular velocity .* at most'),
    ('reference', 'time_ref.nanosec', 10**9, 'stamp is out of range'),
    ('reference', 'time_ref.sec', 5, 'must name the same reference keyframe'),
    ('matches', 'header.stamp.sec', 5, 'same stamp'),
    ('pairs', 'status', [], 'must have one status, got 0'),
    ('pairs', 'status.0.values', [], 'must have the key topics'),
    ('pairs', 'status.0.values.0.key', 'other', 'must have the key reference_stamp_ns'),
    ('pairs', 'status.0.values.0.value', '-5', 'reference_stamp_ns .* an instant'),
    ('pairs', 'status.0.values.0.value', '9' * 20, 'reference_stamp_ns .* an instant'),
    ('pairs', 'status.0.values.-4.value', '0.1 0.2', 'gyro_bias_rad_s .* three numbers'),
    ('pairs', 'status.0.values.-4.value', '0.1 0.2 inf', 'gyro_bias_rad_s .* finite'),
    ('pairs', 'status.0.values.-4.value', ' ', 'gyro_bias_rad_s .* finite'),
    ('pairs', 'status.0.values.-6.value', '0.1 0.2', 'image_information .* unknowns'),
    ('pairs', 'status.0.values.-6.value', '0.1 0.2 inf', 'image_gradient .* finite'),
    ('pairs', 'status.0.values.-1.value', 'matches', 'must name all others'),
    ('pairs', 'status.0.values.-1.value', 'relative_rotation', 'tells of pairs relative_rotation'),
])
def test_a_figure_that_cannot_be_is_refused(pairs, topic, path, value, sentence):
    put(getattr(pairs[0], topic), path, value)
    with pytest.raises(InputError, match=sentence):
        published_pair(pairs[0])


def test_a_covariance_of_nan_is_refused(pairs):
    pairs[0].velocity.twist.covariance[7] = float('nan')
    with pytest.raises(InputError, match='covariance of ~/velocity must be 36 finite figures'):
        published_pair(pairs[0])


def test_an_impossible_stamp_is_refused_at_once(pairs):
    pairs[0].velocity.header.stamp.sec = -1
    with pytest.raises(InputError, match='stamp is out of range'):
        PairSynchronizer().add('velocity', pairs[0].velocity)


def test_usage_is_checked(pairs):
    with pytest.raises(InputError, match=r"topic must be one of relative_pose, .* got 'tf'"):
        PairSynchronizer().add('tf', pairs[0].velocity)
    with pytest.raises(InputError, match='capacity must be at least 1, got 0'):
        PairSynchronizer(capacity=0)


def some_damaged(results: list[PairResult], count: int) -> Iterator[tuple[str, Any]]:
    """Messages of so many pairs, three messages in twenty with other bytes."""
    rng = np.random.default_rng(0)
    for number in range(count):
        result = results[number % len(results)]
        result = replace(result, stamp_ns=result.stamp_ns + number * 10**9)
        kind = number % 5
        result = turned_only(result) if kind == 1 else (
            without_rotation(result) if kind == 2 else result)
        for topic, message in parts(pair_messages(result, build.rosbags_types)):
            name = message.__msgtype__
            data = bytes(build.TYPESTORE.serialize_cdr(message, name))
            if rng.random() < 0.15:
                data = mutated_bytes(data, rng)
            try:
                message = build.TYPESTORE.deserialize_cdr(data, name)
            except Exception:  # noqa: BLE001 - rclpy's or the bag reader's part
                continue
            yield topic, message


def test_damaged_messages_give_pairs_or_one_sentence(results):
    """What is taken can be chained, what is not is told, and nothing else happens."""
    synchronizer, chain, errors, scales = PairSynchronizer(), PoseChain(), [], []
    for topic, message in some_damaged(results, 1500):
        try:
            pair = synchronizer.add(topic, message)
        except InputError as error:
            errors.append(str(error))
        else:
            if pair is not None:
                step = chain.add(pair)
                scales += [step.scale] if pair else []
                assert all(np.isfinite(pose.position).all() for pose in step.poses)
    print(len(errors), len(scales), synchronizer.given_up)
    assert np.isfinite(scales).all()
    assert len(scales) > 200
    assert len(errors) > 20
    assert max(map(len, errors)) < 1000
    assert not any('\n' in error for error in errors)
    assert synchronizer.given_up > 50
