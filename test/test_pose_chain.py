"""Poses chained with the scale carried on: against a simulated flight, and where it cannot."""

from __future__ import annotations

from dataclasses import replace

import message_builders as build
import numpy as np
import pytest
from simulated_pairs import simulated_flight

from rs_relpose_ros.errors import InputError
from rs_relpose_ros.estimator import sampson
from rs_relpose_ros.estimator.result import RelativePose, Status
from rs_relpose_ros.estimator.state import TwoViewState
from rs_relpose_ros.front_end.pair import PairResult
from rs_relpose_ros.messages.outgoing import pair_messages
from rs_relpose_ros.messages.pose_chain import PathPose, PoseChain, track_distances
from rs_relpose_ros.messages.published_pair import published_pair, PublishedPair


def published(pairs: list[PairResult]) -> list[PublishedPair]:
    """As a user of the topics sees them: float32 matches."""
    return [published_pair(pair_messages(pair, build.rosbags_types)) for pair in pairs]


def assert_at(poses: list[PathPose], positions: np.ndarray, rotations: list[np.ndarray],
              atol: float = 2e-5) -> None:
    # Rays come as float32.
    np.testing.assert_allclose([pose.position for pose in poses], positions, atol=atol)
    np.testing.assert_allclose([pose.R for pose in poses], rotations, atol=1e-9)


@pytest.mark.parametrize('seed', range(3))
def test_path_is_the_flight_in_units_of_its_first_baseline(seed):
    flight = simulated_flight(seed)
    pairs, chain = published(flight.pairs), PoseChain()
    steps = [chain.add(pair) for pair in pairs]
    poses = [pose for step in steps for pose in step.poses]
    assert [pose.stamp_ns for pose in poses] == [pairs[0].reference_stamp_ns,
                                                 *(pair.stamp_ns for pair in pairs)]
    assert_at(poses, flight.positions / flight.baselines[0], flight.R)
    np.testing.assert_allclose([step.scale for step in steps],
                               flight.baselines / flight.baselines[0], rtol=1e-5)
    # Of baselines that differ by more than a factor of 3: nothing of this is by accident.
    assert np.ptp(np.log(flight.baselines)) > 1.0
    assert [bool(step.new_path) for step in steps] == [True, False, False, False]
    assert [step.shared_tracks for step in steps] == [0, 120, 120, 120]
    assert np.isnan(steps[0].scale_sigma)
    assert all(0.0 < step.scale_sigma < 1e-5 for step in steps[1:])


def test_each_match_has_its_own_baseline():
    """Without it, the rows that the camera moves on by would spoil the distances."""
    pair = published(simulated_flight(0).pairs)[2]   # 0.1 s between the frames, 65 ms per frame
    tau = pair.matches['tau2'] - pair.matches['tau1']
    assert np.ptp(tau) > 1e-3
    exact, _ = track_distances(pair)
    still, _ = track_distances(replace(pair, linear_velocity=np.zeros(3)))
    ratios = [still[track] / exact[track] for track in exact.keys() & still.keys()]
    assert np.ptp(ratios) > 0.01


def test_distances_are_those_of_the_estimator():
    """Two codes of one equation, for arrays and for compiled loops."""
    rng = np.random.default_rng(1)
    pair = published(simulated_flight(1).pairs)[0]
    # Rays that do not quite meet, some of them behind a camera.
    noisy = np.array(pair.matches)
    for name in ('x1', 'y1', 'x2', 'y2'):
        noisy[name] += rng.normal(size=len(noisy)) * 0.02
    pair = replace(pair, matches=noisy)
    distances1, distances2 = track_distances(pair)
    assert 20 < len(distances1) < len(noisy)
    rows = np.zeros((len(noisy), 20))
    for column, name in ((0, 'x1'), (1, 'y1'), (2, 'z1'), (9, 'x2'), (10, 'y2'), (11, 'z2'),
                         (18, 'tau1'), (19, 'tau2')):
        rows[:, column] = noisy[name]
    velocity = pair.R @ pair.linear_velocity
    state = TwoViewState(pair.R, pair.t, velocity, velocity, np.zeros(3), np.zeros(3))
    for i, track in enumerate(noisy['id'].tolist()):
        l1, l2, _, _ = sampson.triangulated(rows, i, state)
        assert (track in distances1) == (l1 > 0.0 and l2 > 0.0)
        if track in distances1:
            assert distances1[track] == pytest.approx(l1, rel=1e-6)
            assert distances2[track] == pytest.approx(l2, rel=1e-6)


def test_parallel_rays_have_no_distance():
    pair = published(simulated_flight(0).pairs)[0]
    matches = np.array(pair.matches)
    for name in ('x1', 'x2', 'y1', 'y2'):
        matches[name][:5] = 0.0
    for name in ('z1', 'z2'):
        matches[name][:5] = 1.0
    distances, _ = track_distances(replace(pair, R=np.eye(3), matches=matches))
    assert distances
    assert not distances.keys() & set(matches['id'][:5].tolist())
    assert track_distances(replace(pair, matches=matches[:0])) == ({}, {})


def test_a_missing_pair_begins_a_new_path():
    flight = simulated_flight(0)
    pairs, chain = published(flight.pairs), PoseChain()
    chain.add(pairs[0])
    step = chain.add(pairs[2])
    assert step.new_path == 'a pair is missing: the path starts anew, at another scale'
    assert (step.scale, step.shared_tracks) == (1.0, 0)
    assert [pose.stamp_ns for pose in step.poses] == [pairs[2].reference_stamp_ns,
                                                      pairs[2].stamp_ns]
    assert_at(list(step.poses), np.array([np.zeros(3), pairs[2].t]), [np.eye(3), pairs[2].R])
    # And goes on in units of that pair, in the axes of its reference.
    step = chain.add(pairs[3])
    assert step.new_path == ''
    first = flight.R[2].T
    assert_at(list(step.poses),
              [first @ (flight.positions[4] - flight.positions[2]) / flight.baselines[2]],
              [first @ flight.R[4]])


def test_too_few_shared_tracks_begin_a_new_path():
    everything = np.arange(40)
    flight = simulated_flight(
        0, 40, tracks=[everything[:24], everything[16:], everything[:23], everything])
    chain = PoseChain()
    steps = [chain.add(pair) for pair in published(flight.pairs)]
    assert [step.shared_tracks for step in steps] == [0, 8, 0, 23]
    assert steps[2].new_path == ('7 shared tracks do not carry the scale, it takes 8: the path '
                                 'starts anew, at another scale')
    # A user may ask for more.
    chain = PoseChain(min_shared_tracks=9)
    assert [bool(chain.add(pair).new_path) for pair in published(flight.pairs)] == [
        True, True, True, False]


def test_a_pure_rotation_is_part_of_the_path():
    """The camera is where it was; place, axes and scale go on behind it."""
    flight = simulated_flight(0, places=(0.0, 0.2, 0.2, 0.2, 0.6))
    chain = PoseChain()
    steps = [chain.add(pair) for pair in published(flight.pairs)]
    assert [bool(step.new_path) for step in steps] == [True, False, False, False]
    # The points are in other rows before and after, where this camera is not quite where it was.
    assert_at([pose for step in steps for pose in step.poses],
              flight.positions / flight.baselines[0], flight.R, atol=1e-3)
    assert np.isnan([step.scale for step in steps[1:3]]).all()
    assert steps[3].scale == pytest.approx(flight.baselines[3] / flight.baselines[0], rel=1e-3)
    assert [step.shared_tracks for step in steps] == [0, 0, 0, 120]


def test_a_path_may_begin_with_a_pure_rotation():
    flight = simulated_flight(0, places=(0.0, 0.0, 0.5, 0.6, 1.0))
    chain = PoseChain()
    steps = [chain.add(pair) for pair in published(flight.pairs)]
    assert [bool(step.new_path) for step in steps] == [True, False, False, False]
    # Of the first pair that has a baseline.
    assert_at([pose for step in steps for pose in step.poses],
              flight.positions / flight.baselines[1], flight.R)


def test_an_unknown_translation_ends_the_path_but_not_its_axes():
    flight = simulated_flight(0)
    pairs = list(flight.pairs)
    pairs[1] = replace(pairs[1], pose=pairs[1].pose.without_translation(
        Status.LOW_PARALLAX, 'too little'))
    chain = PoseChain()
    steps = [chain.add(pair) for pair in published(pairs)]
    assert [len(step.poses) for step in steps] == [2, 0, 2, 1]
    assert [step.new_path for step in steps[1:]] == [
        '', 'a pair has no translation (LOW_PARALLAX): the path starts anew, at another scale', '']
    assert [step.new_axes for step in steps] == [True, False, False, False]
    # Shifted and of another scale, but not turned.
    assert_at([pose for step in steps[2:] for pose in step.poses],
              (flight.positions[2:] - flight.positions[2]) / flight.baselines[2], flight.R[2:])


def test_without_a_rotation_the_axes_end():
    flight = simulated_flight(0)
    pairs = list(flight.pairs)
    pairs[1] = replace(pairs[1], pose=RelativePose(
        status=Status.NO_CONSENSUS, reason='none', inliers=pairs[1].pose.inliers))
    chain = PoseChain()
    steps = [chain.add(pair) for pair in published(pairs)]
    assert [len(step.poses) for step in steps] == [2, 0, 2, 1]
    assert steps[2].new_path.startswith('a pair has no rotation (NO_CONSENSUS): ')
    assert [step.new_axes for step in steps] == [True, False, True, False]
    np.testing.assert_array_equal(steps[2].poses[0].R, np.eye(3))


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


@pytest.mark.parametrize('noise', [1e-4, 3e-4])   # rad
def test_sigma_of_the_scale(noise):
    """Of 200 draws of the rays' noise, against their scatter."""
    flight, rng = simulated_flight(3), np.random.default_rng(5)
    true = flight.baselines[1] / flight.baselines[0]
    errors, sigmas = [], []
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


def test_min_shared_tracks_is_checked():
    with pytest.raises(InputError, match='min_shared_tracks must be at least 1, got 0'):
        PoseChain(min_shared_tracks=0)
