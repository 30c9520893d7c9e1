"""The messages of a pair gathered, read back, and chained to a path."""

from array import array
from collections.abc import Callable
import copy
import csv
from dataclasses import replace
import itertools
from typing import Any

import message_builders as build
import numpy as np
import pytest
from simulated_pairs import simulated_flight

from rs_relpose_lab.live.live_run import Recorder
from rs_relpose_ros.errors import InputError
from rs_relpose_ros.estimator.covariance import ImageInformation
from rs_relpose_ros.estimator.result import RelativePose, Status
from rs_relpose_ros.messages import published_pair as module
from rs_relpose_ros.messages.outgoing import inlier_records, MATCH_DTYPE
from rs_relpose_ros.messages.published_pair import (
    PairSynchronizer,
    PoseChain,
    published_pair,
    PublishedPair,
)
from rs_relpose_ros.pipeline.pair import PairResult


@pytest.fixture(scope='module')
def results() -> list[PairResult]:
    return simulated_flight(4, points=30).pairs


@pytest.fixture(params=[build.rclpy_types, build.rosbags_types], ids=['rclpy', 'rosbags'])
def pairs(request, results) -> list[dict[str, Any]]:
    """Messages of four pairs by topic, of their own: tests may damage them."""
    return [build.pair_messages(result, request.param) for result in results]


def rotation_only(result: PairResult, status: Status = Status.PURE_ROTATION) -> PairResult:
    return replace(result, pose=result.pose.without_translation(status, 'no parallax'))


def without_rotation(result: PairResult) -> PairResult:
    return replace(
        result,
        pose=RelativePose(
            status=Status.NO_CONSENSUS,
            reason='nothing agrees',
            inliers=np.zeros(len(result.matches), dtype=bool),
        ),
    )


def completed(synchronizer: PairSynchronizer, messages: dict[str, Any]) -> list[bool]:
    """Whether each of the messages, one after the other, completes a pair."""
    return [synchronizer.add(*item) is not None for item in messages.items()]


def test_the_table_of_a_live_run_is_that_of_the_replay(results, tmp_path):
    class Topics:
        def listen(self, _: type, topic: str) -> list[Any]:
            return [messages[topic.rpartition('/')[2]] for messages in published]

        def wait_for_publisher(self, *_: Any) -> None:
            pass

    published = [build.pair_messages(result, build.rclpy_types) for result in results]
    path = tmp_path / 'live.csv'
    assert Recorder(Topics(), None).write(path) == len(results)
    with path.open(encoding='ascii') as file:
        rows = list(csv.DictReader(file))
    for row, result in zip(rows, results, strict=True):
        assert (row['stamp_ns'], row['status']) == (str(result.stamp_ns), 'OK')
        assert float(row['tx']) == result.pose.t[0]
        assert row['baseline_m'] == (
            '' if np.isnan(result.pose.baseline) else repr(result.pose.baseline)
        )


def with_images(result: PairResult) -> PairResult:
    rng = np.random.default_rng(0)
    pose = result.pose
    root = rng.normal(size=(11, 11))
    return replace(
        result,
        pose=replace(
            pose,
            images=ImageInformation(
                0.015, pose.R, pose.t, rng.normal(size=6), root.T @ root, rng.normal(size=11)
            ).moved_by(rng.normal(size=(11, 9))),
        ),
    )


@build.both_types
@pytest.mark.parametrize(
    'kind',
    [
        lambda result: result,
        with_images,
        lambda result: rotation_only(with_images(result)),
        lambda result: rotation_only(result, Status.LOW_PARALLAX),
        without_rotation,
    ],
)
def test_what_was_published_is_read_back(results, types, kind):
    """Unknown values are NaN in the same places."""
    result = kind(
        replace(
            results[0],
            gyro_bias=np.array([0.1, -2e-3, 1e-17]),
            pose=replace(results[0].pose, baseline=0.25, baseline_log_sigma=0.1),
        )
    )
    pair = published_pair(build.pair_messages(result, types))
    pose = result.pose
    assert (bool(pair), pair.rotation_known) == (bool(pose), pose.rotation_known)
    assert (pair.status, pair.reason, pair.frame_id) == (pose.status.value, pose.reason, 'camera')
    assert (
        pair.reference_stamp_ns,
        pair.stamp_ns,
        pair.reference_imu_ns,
        pair.current_imu_ns,
    ) == (result.reference_stamp_ns, result.stamp_ns, result.reference_ns1, result.reference_ns2)
    np.testing.assert_allclose(pair.R, pose.R, atol=1e-15)
    for name in ('covariance', 'velocity_covariance'):
        np.testing.assert_allclose(getattr(pair, name), getattr(pose, name), rtol=1e-9, atol=1e-18)
    for found, expected in (
        (pair.t, pose.t),
        (pair.linear_velocity, pose.linear_velocity2),
        (pair.angular_velocity, pose.angular_velocity2),
        (pair.gyro_bias, result.gyro_bias),
        ((pair.baseline, pair.baseline_log_sigma), (pose.baseline, pose.baseline_log_sigma)),
        (pair.matches, inlier_records(result) if pair else np.empty(0, MATCH_DTYPE)),
    ):
        np.testing.assert_array_equal(found, expected)
    assert (pair.images is None) == (pose.images is None)
    in_process = PublishedPair.of_result(result)
    assert in_process.current_imu_ns == pair.current_imu_ns
    if pair.images is not None:
        given = pair.images.by_deviation
        assert (given is None) == (in_process.images.by_deviation is None)
        if given is not None:
            assert given.shape == (len(pair.images.gradient), 9)
            np.testing.assert_array_equal(given, in_process.images.by_deviation)
        np.testing.assert_allclose(pair.images.R, pose.images.R, atol=1e-15)
        for name in ('row_time', 't', 'velocities', 'information', 'gradient'):
            np.testing.assert_array_equal(getattr(pair.images, name), getattr(pose.images, name))


@pytest.mark.parametrize(
    ('kind', 'count'), [(lambda result: result, 6), (rotation_only, 2), (without_rotation, 1)]
)
def test_messages_come_in_any_order(results, kind, count):
    messages = build.pair_messages(kind(results[0]), build.rosbags_types)
    synchronizer = PairSynchronizer()
    for *first, last in itertools.permutations(messages.items(), count):
        for item in first * 2:  # what comes again replaces the first
            assert synchronizer.add(*item) is None
        assert synchronizer.add(*last) is not None
    assert len(messages) == count
    assert synchronizer.given_up == 0


def test_a_topic_may_run_ahead(pairs, results):
    """All of one topic before all of the next, the pairs of the last in reverse."""
    synchronizer = PairSynchronizer()
    for topic in ('pairs', 'relative_rotation', 'matches', 'reference', 'relative_pose'):
        assert [synchronizer.add(topic, pair[topic]) for pair in pairs] == [None] * 4
    found = [synchronizer.add('velocity', pair['velocity']) for pair in reversed(pairs)]
    assert [pair and pair.stamp_ns for pair in found] == [
        result.stamp_ns for result in reversed(results)
    ]
    assert synchronizer.given_up == 0


def test_incomplete_pairs_do_not_accumulate(pairs):
    synchronizer = PairSynchronizer(capacity=3)
    lost = pairs[0]['velocity']
    whole = pairs[1]
    for number in range(100):
        lost = copy.deepcopy(lost)
        lost.header.stamp.sec += 1
        assert synchronizer.add('velocity', lost) is None
        assert synchronizer.given_up == max(number - 2, 0)
    # The newest are kept, and a complete pair is returned.
    assert completed(synchronizer, whole) == [False] * 5 + [True]
    del pairs[0]['velocity']
    for message in pairs[0].values():
        message.header.stamp = lost.header.stamp
    assert completed(synchronizer, pairs[0]) == [False] * 4 + [True]
    assert synchronizer.given_up == 98


def set_data(cloud: Any, data: bytes) -> None:
    cloud.data = (
        array('B', data) if isinstance(cloud.data, array) else np.frombuffer(data, np.uint8)
    )


def test_no_match_is_an_array_of_none(pairs):
    pairs[0]['matches'].width = 0
    set_data(pairs[0]['matches'], b'')
    matches = published_pair(pairs[0]).matches
    assert (matches.shape, matches.dtype) == ((0,), MATCH_DTYPE)


def put(place: Any, path: str, value: Any) -> None:
    """Set a field by its path, such as ``'fields.3.name'``."""
    *parents, name = path.split('.')
    for parent in parents:
        number = parent.removeprefix('-').isdigit()
        place = place[int(parent)] if number else getattr(place, parent)
    if name.isdigit():
        place[int(name)] = value
    else:
        setattr(place, name, value)


def changed_records(name: str, change: Callable[[np.ndarray], object]) -> Callable[[Any], bytes]:
    def data(cloud: Any) -> bytes:
        records = np.frombuffer(bytes(cloud.data), MATCH_DTYPE).copy()
        change(records[name])
        return records.tobytes()

    return data


@pytest.mark.parametrize(
    ('topic', 'path', 'value', 'expected'),
    [
        *(
            ('matches', *row)
            for row in (
                (
                    'fields.3.name',
                    'intensity',
                    'must have the fields u1 v1 .* got u1 v1 u2 intensity',
                ),
                ('fields.0.name', 'v1', 'got v1 v1'),
                ('fields.1.datatype', 8, 'must have the fields'),
                ('fields', [], 'got none'),
                ('is_bigendian', True, 'got .* big endian'),
                ('point_step', 0, ' 0 bytes$'),
                ('width', 2**32 - 1, 'has 2400 bytes of data, but 4294967295x1 points need'),
                (
                    'data',
                    lambda cloud: bytes(cloud.data)[:-1],
                    'has 2399 bytes of data, but 30x1 points need 2400',
                ),
                (
                    'data',
                    changed_records('tau2', lambda column: column.put(5, np.inf)),
                    '~/matches must be finite',
                ),
                (
                    'data',
                    changed_records('z2', lambda column: np.add(column, 1.0, out=column)),
                    'the rays x2 y2 z2 of ~/matches must have length 1',
                ),
            )
        ),
        ('relative_pose', 'pose.pose.position.x', float('nan'), 'position .* length 1'),
        ('relative_pose', 'pose.pose.orientation.w', float('nan'), 'orientation .* length 1'),
        ('velocity', 'twist.twist.linear.z', float('nan'), 'linear velocity .* must be finite'),
        ('velocity', 'twist.twist.angular.z', float('inf'), 'angular velocity .* must be finite'),
        ('velocity', 'twist.covariance.7', float('nan'), 'covariance of ~/velocity must '),
        ('reference', 'time_ref.nanosec', 10**9, 'stamp is out of range'),
        ('reference', 'time_ref.sec', 5, 'must name the same reference keyframe'),
        ('matches', 'header.stamp.sec', 5, 'same stamp'),
        ('velocity', 'header.stamp.sec', -1, 'stamp is out of range'),
        ('pairs', 'status', [], 'must have one status, got 0'),
        ('pairs', 'status.0.values', [], 'must have the key topics'),
        ('pairs', 'status.0.values.0.key', 'other', 'must have the key reference_stamp_ns'),
        ('pairs', 'status.0.values.0.value', '-5', 'reference_stamp_ns .* a timestamp'),
        ('pairs', 'status.0.values.-5.value', '0.1 0.2', 'gyro_bias_rad_s .* three numbers'),
        ('pairs', 'status.0.values.-5.value', '0.1 0.2 inf', 'gyro_bias_rad_s .* finite'),
        ('pairs', 'status.0.values.-7.value', '0.1 0.2', 'image_information .* unknowns'),
        ('pairs', 'status.0.values.-7.value', '0.1 0.2 inf', 'image_gradient .* finite'),
        ('pairs', 'status.0.values.-1.value', 'matches', 'must name all others'),
        (
            'pairs',
            'status.0.values.-1.value',
            'relative_rotation',
            'lists pairs relative_rotation',
        ),
    ],
)
def test_unusable_messages_are_refused(pairs, topic, path, value, expected):
    if path == 'data':
        set_data(pairs[0][topic], value(pairs[0][topic]))
    else:
        put(pairs[0][topic], path, value)
    with pytest.raises(InputError, match=expected) as caught:
        published_pair(pairs[0])
    assert '\n' not in str(caught.value)
    assert len(str(caught.value)) < 400


def test_nothing_is_left_of_an_unusable_pair(pairs):
    synchronizer = PairSynchronizer()
    pairs[0]['matches'].point_step = 0
    with pytest.raises(InputError, match='must have the fields'):
        completed(synchronizer, pairs[0])
    assert completed(synchronizer, pairs[1])[-1]


@pytest.mark.parametrize(
    ('call', 'expected'),
    [
        (
            lambda: PairSynchronizer().add('tf', None),
            "^topic must be one of relative_pose, .* 'tf'",
        ),
        (lambda: PairSynchronizer(capacity=0), '^capacity must be .*, got 0'),
        (lambda: PoseChain(min_shared_tracks=0), '^min_shared_tracks must be .*, got 0'),
    ],
)
def test_wrong_arguments_and_topics_are_named(call, expected):
    with pytest.raises(InputError, match=expected):
        call()


# -- poses chained with their scale: against a simulated flight, and where it is lost ---------


def published(pairs: list[PairResult]) -> list[module.PublishedPair]:
    """As a subscriber gets them: float32 matches."""
    return [published_pair(build.pair_messages(pair, build.rosbags_types)) for pair in pairs]


def chained(pairs: list[PairResult], **options: int) -> list[module.PathStep]:
    chain = PoseChain(**options)
    return [chain.add(pair) for pair in published(pairs)]


def assert_path(
    steps: list[module.PathStep],
    positions: np.ndarray,
    rotations: list[np.ndarray],
    atol: float = 2e-5,
) -> None:
    poses = [pose for step in steps for pose in step.poses]
    # Rays come as float32.
    np.testing.assert_allclose([pose.position for pose in poses], positions, atol=atol)
    np.testing.assert_allclose([pose.R for pose in poses], rotations, atol=1e-9)


@pytest.mark.parametrize('seed', range(3))
def test_path_is_the_flight_in_units_of_its_first_baseline(seed):
    flight = simulated_flight(seed)
    steps = chained(flight.pairs)
    assert [pose.stamp_ns for step in steps for pose in step.poses] == [
        flight.pairs[0].reference_stamp_ns,
        *(pair.stamp_ns for pair in flight.pairs),
    ]
    assert_path(steps, flight.positions / flight.baselines[0], flight.R)
    np.testing.assert_allclose(
        [step.scale for step in steps], flight.baselines / flight.baselines[0], rtol=1e-5
    )
    # Baselines differ by more than a factor of 3: nothing of this is by accident.
    assert np.ptp(np.log(flight.baselines)) > 1.0
    assert [bool(step.new_path) for step in steps] == [True, False, False, False]
    assert [step.shared_tracks for step in steps] == [0, 120, 120, 120]
    assert np.isnan(steps[0].scale_sigma)
    assert all(0.0 < step.scale_sigma < 1e-5 for step in steps[1:])


def test_parallel_rays_have_no_distance():
    pair = published(simulated_flight(0).pairs)[0]
    matches = np.array(pair.matches)
    for name in ('x1', 'x2', 'y1', 'y2'):
        matches[name][:5] = 0.0
    for name in ('z1', 'z2'):
        matches[name][:5] = 1.0
    distances, _ = module.track_distances(replace(pair, R=np.eye(3), matches=matches))
    assert distances
    assert not distances.keys() & set(matches['id'][:5].tolist())
    assert module.track_distances(replace(pair, matches=matches[:0])) == ({}, {})


def test_too_few_shared_tracks_begin_a_new_path():
    everything = np.arange(40)
    flight = simulated_flight(
        0, 40, tracks=[everything[:24], everything[16:], everything[:23], everything]
    )
    steps = chained(flight.pairs)
    assert [step.shared_tracks for step in steps] == [0, 8, 0, 23]
    assert steps[2].new_path.startswith('7 shared tracks, the scale needs 8: ')
    assert [bool(step.new_path) for step in chained(flight.pairs, min_shared_tracks=9)] == [
        True,
        True,
        True,
        False,
    ]


@pytest.mark.parametrize(
    ('places', 'unit', 'atol'),
    [
        # The points are in other rows before and after, where this camera is not quite where it
        # was.
        ((0.0, 0.2, 0.2, 0.2, 0.6), 0, 1e-3),
        # In units of the first pair that has a baseline.
        ((0.0, 0.0, 0.5, 0.6, 1.0), 1, 2e-5),
    ],
)
def test_a_pure_rotation_is_part_of_the_path(places, unit, atol):
    """The position is unchanged; place, axes and scale continue after it."""
    flight = simulated_flight(0, places=places)
    steps = chained(flight.pairs)
    assert [bool(step.new_path) for step in steps] == [True, False, False, False]
    assert_path(steps, flight.positions / flight.baselines[unit], flight.R, atol)
    moves = flight.baselines > 0.0
    np.testing.assert_allclose(
        [step.scale for step in steps],
        np.where(moves, flight.baselines / flight.baselines[unit], np.nan),
        rtol=1e-3,
    )
    assert (np.array([step.shared_tracks for step in steps])[~moves] == 0).all()
    assert steps[-1].shared_tracks == 120


@pytest.mark.parametrize(
    ('change', 'new_axes', 'reason'),
    [
        (lambda pair: [], True, 'a pair is missing: '),
        (
            lambda pair: [rotation_only(pair, Status.LOW_PARALLAX)],
            False,
            'a pair has no translation (LOW_PARALLAX): ',
        ),
        (lambda pair: [without_rotation(pair)], True, 'a pair has no rotation (NO_CONSENSUS): '),
    ],
)
def test_the_path_ends_and_without_a_rotation_its_axes(change, new_axes, reason):
    flight = simulated_flight(0)
    first, second, *others = flight.pairs
    steps = chained([first, *change(second), *others])
    _, *lost, step, last = steps
    assert [len(found.poses) for found in steps] == [2, *[0] * len(lost), 2, 1]
    assert step.new_path.startswith(reason)
    assert [found.new_path for found in (*lost, last)] == [''] * (len(lost) + 1)
    assert (step.new_axes, last.new_axes) == (new_axes, False)
    assert (step.scale, step.shared_tracks) == (1.0, 0)
    assert [pose.stamp_ns for pose in step.poses] == [
        others[0].reference_stamp_ns,
        others[0].stamp_ns,
    ]
    # Shifted and of another scale; rotated if the axes are new.
    axes = flight.R[2].T if new_axes else np.eye(3)
    assert_path(
        [step, last],
        (flight.positions[2:] - flight.positions[2]) @ axes.T / flight.baselines[2],
        [axes @ R for R in flight.R[2:]],
    )


def test_wrong_tracks_do_not_move_the_scale_much():
    """A quarter of the ids belong to other points."""
    flight = simulated_flight(2)
    pairs = published(flight.pairs)
    wrong = np.array(pairs[1].matches)
    wrong['id'][:30] = np.roll(wrong['id'][:30], 1)
    chain = PoseChain()
    chain.add(pairs[0])
    step = chain.add(replace(pairs[1], matches=wrong))
    assert step.scale == pytest.approx(flight.baselines[1] / flight.baselines[0], rel=1e-4)


@pytest.mark.parametrize('noise', [1e-4, 3e-4])  # rad
def test_sigma_of_the_scale(noise):
    """Of 200 draws of the rays' noise, against their scatter."""
    flight = simulated_flight(3)
    rng = np.random.default_rng(5)
    true = flight.baselines[1] / flight.baselines[0]
    errors = []
    sigmas = []
    for _ in range(200):
        chain = PoseChain()
        for pair in published(flight.pairs)[:2]:
            noisy = np.array(pair.matches)
            for name in ('x1', 'y1', 'x2', 'y2'):
                noisy[name] += rng.normal(size=len(noisy)) * noise
            step = chain.add(replace(pair, matches=noisy))
        errors.append(step.scale / true - 1.0)
        sigmas.append(step.scale_sigma)
    assert np.median(sigmas) == pytest.approx(np.std(errors), rel=0.3)
