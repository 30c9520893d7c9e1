"""Maps of residuals: what noise gives, what a bias gives, and the groups of pairs."""

from dataclasses import replace

import numpy as np
import pytest

from rs_relpose_ros.calibration.assessment import configured_sigmas
from rs_relpose_ros.calibration.findings import (
    Assessment,
    Code,
    Configured,
    Finding,
    FindingState,
    Why,
    worst_of,
)
from rs_relpose_ros.calibration.findings_text import text_of
from rs_relpose_ros.calibration.residual_maps import (
    CANDIDATES,
    FAILS_BELOW,
    map_by_groups,
    maps_of,
    PairSums,
    ResidualMaps,
    signed_residuals,
    summary_line,
    View,
    with_maps,
)
from rs_relpose_ros.config.settings import Parameters
from rs_relpose_ros.core.deviations import LIVE
from rs_relpose_ros.estimator.result import Diagnostics, RelativePose, Status
from rs_relpose_ros.geometry.camera import RollingShutterCamera
from rs_relpose_ros.geometry.matches import Matches
from rs_relpose_ros.geometry.so3 import exp_so3
from rs_relpose_ros.pipeline.monitor import ConsistencyMonitor

FOCAL = 410.0
SIGMA = 0.3  # [px]
VIEW = View(560, 420)
CONSISTENT = Assessment((Finding(Code.AXES, FindingState.OK, Why.CONSISTENT),))


def walk(seconds=20.0, seed=0, matches=120):
    """Sums of pairs at 7 Hz whose residuals are noise."""
    rng = np.random.default_rng(seed)
    found = []
    for k in range(round(7.0 * seconds)):
        cell = rng.integers(0, 24, matches)
        band = rng.integers(0, 6, matches)
        noise = rng.normal(size=(3, matches))
        found.append(
            PairSums(
                10**9 + round(k * 1e9 / 7.0),
                np.array([np.bincount(cell, one, 24) for one in noise]),
                np.bincount(cell, minlength=24).astype(float),
                np.bincount(band, noise[2], 6),
                np.bincount(band, minlength=6).astype(float),
                float(rng.uniform(0.0, 1.0)),
                float(rng.normal(0.0, 2e-4)),
            )
        )
    return found


def by_name(pairs):
    return {one.name: one for one in maps_of(pairs)}


@pytest.mark.parametrize('seed', range(8))
def test_noise_has_no_pattern(seed):
    maps = maps_of(walk(seed=seed))
    assert [one.name for one in maps] == list(CANDIDATES)
    assert all(one.tested and one.p > 1e-4 for one in maps)
    assert with_maps(CONSISTENT, maps) is CONSISTENT
    assert summary_line(maps).startswith('residuals: no pattern')


def test_probabilities_of_noise_are_right():
    """5 % of all cells are below 0.05, and chi-squares have the mean of their freedom."""
    found = [
        one
        for seed in range(60)
        for one in maps_of(walk(8.0, 100 + seed, 20))
        if one.name != 'halves'  # of so many matches that the bias of a tracker counts
    ]
    cells = np.concatenate([one.probabilities[np.isfinite(one.sigmas)] for one in found])
    assert len(cells) > 2000
    assert np.mean(cells < 0.05) == pytest.approx(0.05, abs=0.015)
    ratio = sum(one.chi_square for one in found) / sum(one.tested for one in found)
    assert ratio == pytest.approx(1.0, abs=0.1)


@pytest.mark.parametrize('cell', [0, 9, 23])
def test_a_biased_cell_is_found(cell):
    moved = []
    for pair in walk():
        cells = pair.cells.copy()
        cells[1, cell] += 0.5 * pair.counts[cell]
        moved.append(replace(pair, cells=cells))
    found = by_name(moved)
    assert found['cells'].fails
    assert found['cells'].worst == 24 + cell
    assert found['cells'].mean == pytest.approx(0.5, abs=0.15)
    assert found['cells'].expectation[24 + cell] == 0.0
    column = cell % 6 + 1
    row = cell // 6 + 1
    health = with_maps(CONSISTENT, maps_of(moved))
    (fault,) = health.faults
    assert (fault.code, fault.state) == (Code.UNKNOWN_CAUSE, FindingState.SUSPECT)
    assert fault.candidates == CANDIDATES['cells']
    description, fix = text_of(fault)
    assert f'column {column} of 6, row {row} of 4, across the motion' in description
    assert 'distortion' in description and 'CameraInfo' in fix
    assert health.findings[1:] == CONSISTENT.findings


def test_the_readout_shows_in_rows_at_a_changing_rate():
    turned = [
        replace(one, bands=one.bands + 0.6 * (one.change > 0.6) * one.band_counts * SLOPE)
        for one in walk()
    ]
    found = by_name(turned)
    assert [name for name, one in found.items() if one.fails] == ['rows_rate']
    label = found['rows_rate'].labels[found['rows_rate'].worst]
    assert label in (
        'part 1 of 6 of the readout, change of the rate from 0.6 rad/s',
        'part 6 of 6 of the readout, change of the rate from 0.6 rad/s',
    )


SLOPE = np.linspace(-1.0, 1.0, 6)


def test_a_step_of_the_offset_shows_in_its_block_of_time():
    stepped = [
        replace(
            one, against_gyro=one.against_gyro + (8.0 < one.stamp_ns * 1e-9 - 1.0 < 9.9) * 6e-4
        )
        for one in walk()
    ]
    found = by_name(stepped)
    assert [name for name, one in found.items() if one.fails] == ['time']
    assert found['time'].labels[found['time'].worst] == '8 to 10 s'
    assert with_maps(CONSISTENT, maps_of(stepped)).faults[0].candidates[0] is Code.OFFSET_STEP


def test_matches_of_a_group_are_one_observation():
    """Residuals that all pairs of a group share are no more certain than one residual each."""
    rng = np.random.default_rng(5)
    groups = np.repeat(np.arange(40), 10)
    counts = np.full((400, 1), 30.0)
    deviates = rng.normal(size=40)
    standard = (deviates - deviates.mean()) / deviates.std()
    shared = (0.25 + standard)[groups][:, None]
    together = map_by_groups('halves', ('all',), shared * counts, counts, groups)
    alone = map_by_groups('halves', ('all',), shared * counts, counts, np.arange(400))
    assert together.sigmas[0] == pytest.approx(300.0 * np.sqrt(40.0), rel=0.03)
    assert alone.p < FAILS_BELOW < 0.01 < together.p


def test_the_bias_of_a_tracker_is_no_pattern():
    """A bias of 0.03 sigma in all matches of half an hour, which no calibration removes."""
    rng = np.random.default_rng(6)
    counts = np.full((4000, 1), 100.0)
    sums = 10.0 * rng.normal(size=(4000, 1))
    groups = np.arange(4000)
    small = map_by_groups('halves', ('all',), sums + 0.03 * counts, counts, groups)
    large = map_by_groups('halves', ('all',), sums + 0.15 * counts, counts, groups)
    assert small.p > 0.05
    assert large.fails


def test_one_pair_does_not_make_a_pattern():
    """A group with a gross bias scatters itself: it cannot be certain."""
    pairs = walk()
    pairs[50] = replace(pairs[50], cells=pairs[50].cells + 40.0 * pairs[50].counts)
    assert not any(one.fails for one in maps_of(pairs))


def test_few_pairs_are_not_tested():
    maps = maps_of(walk(seconds=2.0))
    assert [one.tested for one in maps] == [0, 0, 0, 0]
    assert [one.p for one in maps] == [1.0] * 4
    assert summary_line(maps) == summary_line(maps_of([])) == ''


def test_a_named_parameter_is_not_joined_by_an_unknown_cause():
    named = Assessment((Finding(Code.DISTORTION, FindingState.SUSPECT, Why.OFF),))
    maps = maps_of([replace(one, cells=one.cells + one.counts) for one in walk()])
    assert maps[0].fails
    assert with_maps(named, maps) is named


# -- Live: the last seconds, and what the monitor makes of them --------------------------------


def biased(pairs, cell=5):
    """The pairs with the residuals of a cell of the image moved by half a sigma."""
    moved = np.zeros((3, 24))
    moved[0, cell] = 0.5
    return [replace(one, cells=one.cells + moved * one.counts) for one in pairs]


def follow(maps, pairs):
    """Seconds from the first pair on at which a test has found a pattern."""
    found = []
    for one in pairs:
        maps.add(one)
        maps.test_in_turn()
        if maps.added_to(CONSISTENT).faults:
            found.append(one.stamp_ns * 1e-9 - 1.0)
    return found


def test_live_the_last_seconds_are_tested_now_and_then(monkeypatch):
    tests = []
    monkeypatch.setattr(ResidualMaps, 'maps', counted(ResidualMaps.maps, tests))
    wrong = biased(walk())
    later = [replace(one, stamp_ns=one.stamp_ns + 30 * 10**9) for one in walk(40.0, seed=1)]
    found = follow(ResidualMaps.of_last_seconds(), [*wrong, *later])
    assert 3.0 < found[0] < 10.0
    # Pairs without a pattern follow from 30 s on: none of the others is known 20 s later.
    assert 30.0 < found[-1] < 53.0
    assert 20 < len(tests) < 35
    assert not follow(ResidualMaps.of_last_seconds(), walk(60.0, seed=2))


def counted(function, calls):
    def call(*arguments):
        calls.append(arguments)
        return function(*arguments)

    return call


def test_live_and_offline_have_the_same_maps():
    live = ResidualMaps.of_last_seconds()
    offline = ResidualMaps()
    for one in walk(12.0):
        live.add(one)
        offline.add(one)
        offline.add(None)
    assert [one.p for one in live.maps()] == [one.p for one in offline.maps()]
    live.clear()
    assert not live.maps()


PARAMETERS = Parameters.from_mapping({'readout_time': 0.03, 'quat_cam_imu_xyzw': (0, 0, 0, 1)})
CAMERA = RollingShutterCamera(
    width=560, height=420, fx=FOCAL, fy=FOCAL, cx=280.0, cy=210.0, readout_time=0.03
)


def monitored(pairs, image_findings=()):
    """Health by a monitor that has the residuals of pairs and nothing else."""
    monitor = ConsistencyMonitor()
    monitor.image_findings = image_findings
    configured = Configured(
        PARAMETERS.sensor,
        CAMERA,
        np.zeros(3),
        configured_sigmas(PARAMETERS, 0.0, CAMERA),
        np.zeros(LIVE.size),
        PARAMETERS.imu.gyro_noise_density,
    )
    pose = RelativePose(Status.NO_CONSENSUS)
    for one in pairs:
        monitor.residuals.add(one)
        monitor.add_pair(one.stamp_ns, None, pose, configured)
        monitor.assess()
    return monitor


def test_the_monitor_reports_a_pattern_as_an_unknown_cause():
    monitor = monitored(biased(walk()))
    (fault,) = monitor.health.faults
    assert (fault.code, fault.why) == (Code.UNKNOWN_CAUSE, Why.RESIDUALS)
    assert fault.evidence.measured['map'] == 'cells'
    assert fault.candidates == CANDIDATES['cells']
    monitor.restart()  # after a step of a clock
    assert not monitor.residuals.maps()


def test_a_named_cause_explains_a_pattern():
    masked = Finding(Code.STATIC_REGION, FindingState.SUSPECT, Why.STILL)
    monitor = monitored(biased(walk()), (masked,))
    assert monitor.health.faults == (masked,)
    assert not monitored(walk()).health.faults


def test_in_a_run_a_pattern_does_not_stand_beside_what_is_found_later():
    """It is no reason, either, to forget what was found before."""
    pattern = with_maps(CONSISTENT, maps_of(biased(walk())))
    named = Assessment((Finding(Code.DISTORTION, FindingState.SUSPECT, Why.OFF),))
    codes = [one.code for one in worst_of(pattern, named).faults]
    assert codes == [Code.DISTORTION]
    both = worst_of(named, pattern).faults
    assert {one.code for one in both} == {Code.DISTORTION, Code.UNKNOWN_CAUSE}


def rendered(shift):
    """A pair of global-shutter images whose points in a part are moved by `shift` (2,) [px]."""
    rng = np.random.default_rng(8)
    R = exp_so3(np.array([0.02, -0.05, 0.03]))
    t = np.array([0.8, 0.0, 0.6])
    pixels = rng.uniform((0, 0), (VIEW.width, VIEW.height), (300, 2))
    rays = np.concatenate([(pixels - (280.0, 210.0)) / FOCAL, np.ones((300, 1))], axis=1)
    points = rays * rng.uniform(8.0, 30.0, (300, 1))
    later = (points - t) @ R
    pixels2 = FOCAL * later[:, :2] / later[:, 2:] + (280.0, 210.0) + shift
    rays2 = np.concatenate([(pixels2 - (280.0, 210.0)) / FOCAL, np.ones((300, 1))], axis=1)
    both = np.stack([rays, rays2])
    matches = Matches(
        np.arange(300, dtype=np.uint32),
        np.stack([pixels, pixels2]),
        np.ones(300),
        both / np.linalg.norm(both, axis=2)[:, :, None],
        np.zeros((2, 300)),
    )
    pose = RelativePose(
        Status.OK,
        R=R,
        t=t,
        linear_velocity1=np.zeros(3),
        linear_velocity2=np.zeros(3),
        angular_velocity1=np.zeros(3),
        angular_velocity2=np.array([0.0, 0.7, 0.0]),
        inliers=np.ones(300, dtype=bool),
        diagnostics=Diagnostics(pixel_sigma=SIGMA),
    )
    return pose, matches


def test_residuals_are_where_the_points_were_moved():
    """A shift along the direction of the residual is half of it in each image, by first order."""
    pose, matches = rendered(np.zeros(2))
    np.testing.assert_allclose(signed_residuals(pose, matches).values, 0.0, atol=1e-12)
    moved = np.array([0.0, 0.4])
    residuals = signed_residuals(*rendered(moved))
    expected = residuals.directions[:, :2] @ moved / FOCAL / np.sqrt(2.0)
    central = np.abs(rendered(moved)[1].points2 - (280.0, 210.0)).max(axis=1) < 100.0
    np.testing.assert_allclose(residuals.values[central], expected[central], rtol=0.15, atol=2e-5)


def test_sums_of_a_pair_are_those_of_its_inliers():
    pose, matches = rendered(np.array([0.1, 0.2]))
    apart = np.array([0.0, 3e-4, 0.0])
    sums = PairSums.of(7, matches, pose, FOCAL, VIEW, apart)
    assert sums.counts.sum() == sums.band_counts.sum() == 300
    np.testing.assert_allclose(sums.bands.sum(), sums.cells[2].sum())
    assert sums.change == pytest.approx(0.7)
    assert sums.against_gyro == pytest.approx(3e-4, rel=0.01)
    half = replace(pose, inliers=np.arange(300) % 2 == 0)
    assert PairSums.of(7, matches, half, FOCAL, VIEW, None).counts.sum() == 150
    assert np.isnan(PairSums.of(7, matches, half, FOCAL, VIEW, None).against_gyro)
    lost = replace(pose, status=Status.NO_CONSENSUS)
    assert PairSums.of(7, matches, lost, FOCAL, VIEW, None) is None
