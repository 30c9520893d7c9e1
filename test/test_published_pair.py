"""The four messages of a pair gathered and read back, whatever comes."""

from __future__ import annotations

from array import array
from collections.abc import Callable, Iterator
import copy
from dataclasses import fields, replace
import itertools
from typing import Any

from fuzz_messages import mutated_bytes
import message_builders as build
import numpy as np
import pytest
from simulated_pairs import simulated_flight

from rs_relpose_ros.errors import InputError
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
    return [(topic, getattr(messages, topic)) for topic in PAIR_TOPICS]


def test_topics_are_the_messages():
    assert set(PAIR_TOPICS) == {field.name for field in fields(PairMessages)}


def test_what_was_published_is_read_back(pairs, results):
    for messages, result in zip(pairs, results, strict=True):
        pair = published_pair(messages)
        assert (pair.reference_stamp_ns, pair.stamp_ns, pair.frame_id) == (
            result.reference_stamp_ns, result.stamp_ns, 'camera')
        np.testing.assert_allclose(pair.R, result.pose.R, atol=1e-15)
        for name in ('t', 'covariance', 'velocity_covariance'):
            np.testing.assert_array_equal(getattr(pair, name), getattr(result.pose, name))
        np.testing.assert_array_equal(pair.linear_velocity, result.pose.linear_velocity2)
        np.testing.assert_array_equal(pair.angular_velocity, result.pose.angular_velocity2)
        np.testing.assert_array_equal(pair.matches, inlier_records(result))


@pytest.mark.parametrize('order', [*itertools.permutations(range(4))])
def test_messages_come_in_any_order(pairs, results, order):
    synchronizer = PairSynchronizer()
    given = parts(pairs[0])
    *first, last = [synchronizer.add(*given[k]) for k in order]
    assert first == [None] * 3
    assert last is not None
    assert last.stamp_ns == results[0].stamp_ns


def test_a_topic_may_run_ahead(pairs, results):
    """All of one topic before all of the next, the pairs of the last in reverse."""
    synchronizer = PairSynchronizer()
    for topic in ('matches', 'reference', 'relative_pose'):
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
    assert [pair is not None for pair in found] == [False, False, False, True]
    assert synchronizer.given_up == 998
    for topic in ('relative_pose', 'reference', 'matches'):
        getattr(pairs[0], topic).header.stamp = lost.header.stamp
    found = [synchronizer.add(topic, getattr(pairs[0], topic))
             for topic in ('relative_pose', 'reference', 'matches')]
    assert found[:2] == [None, None]
    assert found[2] is not None
    assert synchronizer.given_up == 998


def test_a_repeated_message_replaces_the_first(pairs):
    synchronizer = PairSynchronizer()
    assert [synchronizer.add(*parts(pairs[0])[0]) for _ in range(5)] == [None] * 5
    assert [synchronizer.add(*part) is not None for part in parts(pairs[0])] == [
        False, False, False, True]


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
        place = place[int(parent)] if parent.isdigit() else getattr(place, parent)
    setattr(place, name, value)


def changed_records(name: str, change: Callable[[np.ndarray], object]) -> Callable[[Any], bytes]:
    def data(cloud: Any) -> bytes:
        records = np.frombuffer(bytes(cloud.data), MATCH_DTYPE).copy()
        change(records[name])
        return records.tobytes()
    return data


@pytest.mark.parametrize(('path', 'value', 'sentence'), [
    ('fields.3.name', 'intensity', 'must have the fields id u1 .* got id u1 v1 intensity'),
    ('fields.1.name', 'v1', 'got id v1 v1'),
    ('fields.1.datatype', 8, 'must have the fields'),
    ('fields.1.count', 2**32 - 1, 'must have the fields'),
    ('fields.1.offset', 2**32 - 1, 'must have the fields'),
    ('fields', [], 'got none'), ('is_bigendian', True, 'got .* big endian'),
    ('point_step', 0, ' 0 bytes$'),
    ('width', 2**32 - 1, 'has 1560 bytes of data, but 4294967295x1 points need'),
    ('data', lambda cloud: bytes(cloud.data)[:-1],
     'has 1559 bytes of data, but 30x1 points need 1560'),
    ('data', lambda cloud: bytes(cloud.data) + bytes(MATCH_DTYPE.itemsize), 'has 1612 bytes'),
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
    assert [synchronizer.add(*part) for part in first] == [None] * 3
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
    ('matches', 'header.stamp.sec', 5, 'same stamp'),
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
    """Messages of so many pairs, three in ten with other bytes."""
    rng = np.random.default_rng(0)
    for number in range(count):
        result = results[number % len(results)]
        result = replace(result, stamp_ns=result.stamp_ns + number * 10**9)
        for topic, message in parts(pair_messages(result, build.rosbags_types)):
            name = message.__msgtype__
            data = bytes(build.TYPESTORE.serialize_cdr(message, name))
            if rng.random() < 0.3:
                data = mutated_bytes(data, rng)
            try:
                message = build.TYPESTORE.deserialize_cdr(data, name)
            except Exception:  # noqa: BLE001 - rclpy's or the bag reader's part
                continue
            yield topic, message


def test_damaged_messages_give_pairs_or_one_sentence(results):
    """What is taken can be chained, what is not is told, and nothing else happens."""
    synchronizer, chain, errors, scales = PairSynchronizer(), PoseChain(), [], []
    for topic, message in some_damaged(results, 1000):
        try:
            pair = synchronizer.add(topic, message)
        except InputError as error:
            errors.append(str(error))
        else:
            if pair is not None:
                scales.append(chain.add(pair).scale)
    print(len(errors), len(scales), synchronizer.given_up)
    assert np.isfinite(scales).all()
    assert len(scales) > 200
    assert len(errors) > 50
    assert max(map(len, errors)) < 1000
    assert not any('\n' in error for error in errors)
    assert synchronizer.given_up > 50
