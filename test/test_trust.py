"""The laboratory's matrix of wrong configurations: tracks, rows, information, results."""

import csv
import json

from conftest import ROOT
import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from rs_relpose_lab.experiments import trust, trust_rows, trust_runs
from rs_relpose_lab.experiments.trust_rows import PLACES, RIGHT, ROWS
from rs_relpose_lab.experiments.trust_runs import TrackNoise
from rs_relpose_ros.cli.main import main
from rs_relpose_ros.geometry.camera import RollingShutterCamera

SHAPE = (480, 640)


@pytest.fixture(scope='module')
def plan():
    return trust.plans(2, 0.4, 7)[0]


@pytest.fixture(scope='module')
def simulation(plan):
    return trust.simulation_of(plan)


@pytest.fixture(scope='module')
def recording(plan):
    return trust.recording_of(plan)


def test_tracks_are_where_the_renderer_shows_the_points_with_errors_since_the_reference(
        simulation):
    known = trust_runs.sightings(simulation, TrackNoise(white=0.2, slip=0.0, wrong=0.0),
                                 np.random.default_rng(1))
    tracker = trust_runs.SimulatedTracker(known, lambda points: points, 300)
    tracker.start(trust_runs.numbered_image(0, SHAPE))
    for first in (0, 3, 6):
        for frame in range(first + 1, first + 4):
            matches = tracker.track(trust_runs.numbered_image(frame, SHAPE))
        assert 100 < len(matches) <= 300
        assert np.abs(matches.points2 - matches.points1).max() > 5.0
        true = simulation.true_matches(first, first + 3, matches.points1)
        shown = np.isfinite(true).all(axis=1)   # a corner's error may move it off its surface
        # Errors from before the reference would enlarge the later ones.
        assert 1.4826 * np.median(np.abs((matches.points2 - true)[shown])) == pytest.approx(
            0.2, rel=0.2)
        tracker.promote()


# -- rows --------------------------------------------------------------------------------------

@pytest.mark.parametrize('name', [name for name in ROWS if name != RIGHT])
def test_a_row_changes_something(name, recording):
    right, sample = recording.configured, recording.samples[40]
    configured = ROWS[name].wrong(right, np.random.default_rng(0))
    assert (configured.values != right.values or configured.intrinsics != right.intrinsics
            or configured.sample(sample) != sample
            or configured.geometry is not trust_rows.AS_IT_IS)


# -- information: the oracle of what the motion of a recording determines ------------------------

CAMERA = RollingShutterCamera(width=640, height=480, fx=450.0, fy=450.0, cx=319.5, cy=239.5,
                              readout_time=0.02)
PAN = (0.0, 0.1, 0.0)
STEADY, CHANGING = ((0.0, 0.5, 0.0), (0.0, 0.5, 0.0)), ((0.0, 0.2, 0.0), (0.0, 0.8, 0.0))


def information_of(rotvec, rate1=(0.0, 0.0, 0.0), rate2=(0.0, 0.0, 0.0)):
    """Of a pair without noise, with rows as at rest."""
    rng = np.random.default_rng(0)
    R, t = Rotation.from_rotvec(rotvec).as_matrix(), np.array([1.0, 0.0, 0.0])
    points = rng.uniform((-1.5, -1.2, 3.0), (1.5, 1.2, 9.0), (120, 3))
    pixels = [450.0 * local[:, :2] / local[:, 2:] + (319.5, 239.5)
              for local in (points, (points - t) @ R)]
    rates = [np.tile(rate, (120, 1)) for rate in (rate1, rate2)]
    return trust_rows.pair_information(trust_rows.TruePair(
        *pixels, R, t, 0.2, *rates, np.array(rate1), np.array(rate2), 0.2, 2e-4),
        CAMERA).quantities


def sigma_of(quantity, *motion):
    place = PLACES[quantity]
    return 1.0 / np.sqrt(np.maximum(np.diag(information_of(*motion)[place, place]), 1e-30))


def test_without_rotation_there_is_no_information_on_axes_scale_and_offset():
    quantities = information_of((0.0, 0.0, 0.0))
    scale = quantities[PLACES['gyro_bias'], PLACES['gyro_bias']].max()
    for quantity in ('axes', 'gyro_scale', 'time_offset'):
        assert np.abs(quantities[PLACES[quantity]]).max() < 1e-6 * scale


@pytest.mark.parametrize(('quantity', 'axis', 'rates', 'low', 'high'), [
    # The images alone determine a rotation of 0.1 rad to some 2 mrad: not about its own axis.
    ('axes', 0, (), 0.0, 0.05), ('axes', 1, (), 1.0, np.inf), ('axes', 2, (), 0.0, 0.05),
    ('gyro_scale', 0, (), 0.0, 0.05),
    # An offset shows by a rate that changes: 0.6 rad/s more, to some 2 mrad.
    ('time_offset', 0, STEADY, 0.05, np.inf), ('time_offset', 0, CHANGING, 1e-3, 1e-2)])
def test_information_of_a_rotation(quantity, axis, rates, low, high):
    assert low <= sigma_of(quantity, PAN, *rates)[axis] < high


# -- results of a bag ----------------------------------------------------------------------------

@pytest.mark.recordings
def test_a_phone_that_rotates_on_the_spot_has_no_finding(converted):
    """At 3.4 s a pair of 27 deg has no translation; an invented one contradicted the axes.

    With a focal length of 500 px, 18 more than the right one, images and gyro contradict each
    other in that pair; with the right one it has a translation.
    """
    name = 'android_phone_rs'
    bag = converted(name, 'android')
    right = (ROOT / 'rs_relpose_lab' / 'recordings' / f'{name}.yaml').read_text()
    bag.with_suffix('.yaml').write_text(right.replace('482.0', '500.0'))
    recording = trust_runs.recording_at(bag)
    pairs = [pair for pair, _ in trust_runs.run(recording, recording.configured, 4.5)]
    assert [pair.stamp_ns // 10**8 % 10**4 for pair in pairs if not pair.pose] == [4381]
    assert not [pair.health.faults for pair in pairs if pair.health.faults]


def test_a_missing_lens_is_named_although_a_little_more_of_it_would_not_move_the_pose():
    """Its poses are off by some degrees; linearised at the estimate, they move by ten sigmas."""
    recording = trust.recording_of(trust.BagPlan(2, 64003, 3.0, 0.0186))
    configured = ROWS['no-distortion'].wrong(recording.configured, np.random.default_rng(0))
    pairs = [trust_runs.evaluated(recording, *result)
             for result in trust_runs.run(recording, configured, 1.6)]
    assert {pair.verdict.named for pair in pairs if pair.at > 1.0} == {('distortion',)}
    # Poses are uncertain at first, then suppressed, from the pair after the first certain one on.
    believed = [pair for pair in pairs if pair.has_pose]
    assert all(pair.at < 0.45 and pair.direction_error < pair.direction_sigma
               for pair in believed)


def test_command_distinguishes_wrong_from_right(tmp_path):
    assert main(['benchmark', 'trust', '--bags', '1', '--rows', RIGHT, 'imu-cycled', '--seconds',
                 '6', '--seed', '3', '--output', str(tmp_path)]) == 0
    with (tmp_path / 'trust_bags.csv').open(newline='') as file:
        right, cycled = csv.DictReader(file)
    assert int(right['all_poses']) > 15
    # Chi squared beyond the limit: 0.27 % of right poses; some more, since tracks have tails.
    assert int(right['all_direction_beyond']) <= 0.15 * int(right['all_poses'])
    assert float(right['direction_error']) < 3.0
    summary = {row['row']: row for row in json.loads(
        (tmp_path / 'trust.json').read_text())['tracks']}
    assert summary['imu-cycled']['bags'] == 1
    # Published poses of it would be wrong; the monitor suppresses them.
    if int(cycled['poses']):
        assert float(cycled['direction_error']) > 10.0


@pytest.mark.parametrize(('row', 'end', 'named'), [
    ('gyro-degrees', 1.0, {'gyro_unit'}), ('upside-down', 1.0, {'axes', 'image_geometry'}),
    ('K-1.3', 2.0, {'distortion', 'focal_length', 'image_geometry'})])
def test_pairs_that_contradict_the_gyro_have_no_pose_but_reveal_the_reason(row, end, named):
    """Of K-1.3 pairs alone reveal it, and none has a pose."""
    recording = trust.recording_of(trust.BagPlan(1, 64005, 3.0, 0.0186))
    pairs = [pair for pair, _ in trust_runs.run(
        recording, ROWS[row].wrong(recording.configured, np.random.default_rng(0)), end)]
    assert sum('contradict' in pair.pose.reason for pair in pairs) >= 4
    assert not any(pair.pose or pair.pose.rotation_known for pair in pairs)
    assert {fault.quantity for fault in pairs[-1].health.faults} & named
