"""The disturbances of `benchmark odometry`: their tracks, and the states that follow."""

from dataclasses import replace

import numpy as np
import pytest
from scipy.spatial.transform import Rotation
from test_odometry import PARAMETERS, START_NS, walk, without

from rs_relpose_lab.experiments import odometry_disturbances as disturbances
from rs_relpose_lab.experiments import odometry_recordings
from rs_relpose_lab.experiments.odometry_disturbances import Disturbance
from rs_relpose_lab.experiments.trust_runs import (
    Arrival,
    simulated,
    Source,
    TrackNoise,
    TRACKS,
)
from rs_relpose_lab.simulation import simulate, SimulationConfig
from rs_relpose_ros.errors import InputError


def test_tracks_of_a_disturbance(monkeypatch):
    monkeypatch.setattr(disturbances, '_MARGIN', 0.2)
    simulation = simulate(SimulationConfig(seed=3, duration=0.6, plan='walk:0.6'))
    rng = np.random.default_rng(0)
    recording = simulated(Source('', TRACKS), simulation, TrackNoise(), rng)
    before = recording.sightings

    def other(**values):
        return disturbances.disturbed(recording, simulation, Disturbance(0.2, **values), rng)

    assert [a.number for a in other(images=False).arrivals] == [*range(6), *range(12, 18)]
    assert other().sightings is before
    dark = other(corners=0.1, white=5.0).sightings
    object_ = other(object_speed=60.0).sightings
    for k, ids in enumerate(before.ids):
        if not 6 <= k < 12:   # the same corners, and none of them after the disturbance
            np.testing.assert_array_equal(object_.pixels[k], before.pixels[k])
            assert np.isin(object_.ids[k], before.ids[0]).any() == (k < 6)
            continue
        assert len(dark.ids[k]) < 0.2 * len(ids)
        assert dark.noise[k].std() > 3.0
        moved = object_.pixels[k] - before.pixels[k]
        # By 2 px from frame to frame since a corner appeared, on the left.
        assert np.isclose(moved[:, 0] / 2.0, np.rint(moved[:, 0] / 2.0), atol=1e-6).all()
        assert 0.3 < (moved[:, 0] > 1.0).mean() < 0.7 or k == 6
        assert (moved[before.pixels[k][:, 0] > 400.0, 0] < 1.0).all()


def test_states_through_a_disturbance():
    given = walk('walk:14', 14.0, imu_rate=100.0)
    # Gyro and accelerometer in messages of their own.
    samples = [(sample.stamp_ns, part) for sample in given.samples for part in (
        replace(sample, linear_acceleration=None), replace(sample, angular_velocity=None))]
    R = Rotation.from_quat(given.quats).as_matrix()
    velocity = np.gradient(given.positions, (given.stamps - START_NS) * 1e-9, axis=0)
    feed = disturbances.Feed(
        PARAMETERS.updated({'max_coast': 10.0}).to_mapping(),
        [(pair.current_ns, pair) for pair in without(given.pairs, 6.0, 8.0)], samples, [])
    truth = disturbances.TrueStates(given.stamps, given.positions, R, velocity)
    found = disturbances.on_feed('no images, 2 s', 1, feed, truth)
    # At 25 Hz, of an IMU with 100 Hz, and until the last sample.
    assert found.states == pytest.approx(25 * 8.4, abs=10)
    assert found.beyond_position + found.beyond_rotation + found.beyond_velocity < 10
    assert found.velocity_ratio < 2.0 and found.tilt_ratio < 2.0
    assert 0.2 < found.uncertain_after < 0.32
    assert found.lost == 0 and found.largest_step < 1.0
    # A truth that is elsewhere by 1 m after the disturbance.
    elsewhere = given.positions + (given.stamps > START_NS + 8e9)[:, None] * [1.0, 0.0, 0.0]
    other = disturbances.on_feed('no images, 2 s', 1, feed, replace(
        truth, position=elsewhere))
    assert other.beyond_position > 100


def test_one_disturbance_is_chosen():
    assert disturbances.tasks(2, 7, 'blur, 2 s') == [('blur, 2 s', 7), ('blur, 2 s', 8)]
    with pytest.raises(InputError, match='blur, 3 s'):
        disturbances.tasks(2, 7, 'blur, 3 s')


def test_a_recording_in_parts(monkeypatch, tmp_path):
    """A path and its halves, of which the first one has no pairs in its last second."""
    given = walk('walk:9', 9.0, imu_rate=100.0)
    of_frames = simulated(Source('walk', TRACKS), simulate(SimulationConfig(duration=0.2)),
                          TrackNoise(), np.random.default_rng(0))
    recording = replace(
        of_frames, samples=given.samples, arrivals=[
            Arrival(k, ns, ns) for k, ns in enumerate(given.stamps[::5].tolist())])

    def feed_of(part):
        first, last = part.arrivals[0].stamp_ns, part.arrivals[-1].stamp_ns
        is_first = last < START_NS + 6e9
        return disturbances.Feed(
            PARAMETERS.to_mapping(), [(pair.current_ns, pair) for pair in given.pairs if (
                first <= pair.reference_ns and pair.current_ns < last - is_first * 1e9)],
            [(sample.stamp_ns, sample) for sample in part.samples], [])

    monkeypatch.setattr(odometry_recordings, 'recording_at', lambda path: recording)
    monkeypatch.setattr(odometry_recordings, 'feed_of', feed_of)
    _, first, _ = found = list(odometry_recordings.on_recording(tmp_path / 'walk', 4.4))
    assert [one.begin for one in found] == [0.0, 0.0, 4.4]
    for one in found:
        assert 0.0 < one.start < 2.0 and abs(one.speed) < 3.0 and one.step < 1.0
        assert abs(one.scale) < 3.0 * one.claimed and abs(one.drift) < 3.0 and one.beyond < 5.0
        assert one.lost == 0
    assert first.uncertain == 1 and first.state == 'uncertain'
    report = odometry_recordings.write_report(tmp_path, found)
    assert report.count('| walk') == 3
