"""`rs_relpose benchmark field`: defects change what they say, and verdicts come from the truth."""

from dataclasses import replace

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from rs_relpose_lab.field import defects, offline, run, truth, verdict
from rs_relpose_lab.field.cases import BASES, BY_NAME, CASES, LIVE, with_variants
from rs_relpose_lab.field.evidence import NamedCause
from rs_relpose_lab.field.recording import base_recording, write_recording
from rs_relpose_lab.simulation import SimulationConfig
from rs_relpose_ros.bags.reader import open_bag
from rs_relpose_ros.config.files import read_parameters

SMALL = SimulationConfig(
    seed=77,
    duration=2.0,
    fps=10.0,
    width=160,
    height=120,
    fx=112.5,
    imu_rate=100.0,
    plan='walk:2',
)


@pytest.fixture(scope='module')
def base(tmp_path_factory):
    return base_recording(SMALL, tmp_path_factory.mktemp('field') / 'base')


def test_every_situation_has_a_base_and_commands():
    assert len(CASES) == len(BY_NAME) >= 45
    assert {case.base for case in CASES} <= set(BASES)
    assert all(case.commands for case in CASES)


def test_a_kind_of_situations_stands_for_its_variants():
    assert with_variants(['G8', 'C1', 'C2', 'all']) == [
        *('G8-left', 'G8-bottom', 'C1', 'C2', 'C2-forward', 'all')
    ]
    assert set(LIVE) <= set(BY_NAME)


def test_a_step_of_the_clock_moves_stamps_and_not_the_truth(base):
    stepped = defects.camera_clock_step(base, 0.05, 1.0)
    apart = np.array([shot.stamp_ns for shot in stepped.shots]) - [
        shot.stamp_ns for shot in base.shots
    ]
    assert set(apart[:10]) == {0}
    assert set(apart[10:]) == {50_000_000}
    assert [shot.true_ns for shot in stepped.shots] == [shot.true_ns for shot in base.shots]


def test_clocks_that_are_set_back_keep_their_truth(base):
    wrapped = defects.wrapped_clock(base, 0.517, 1.0)
    apart = wrapped.imu.stamps_ns - base.imu.stamps_ns
    assert set(apart) == {0, -517_000_000}
    assert wrapped.shots[-1].stamp_ns == base.shots[-1].stamp_ns - 517_000_000
    assert wrapped.shots[-1].true_ns == base.shots[-1].true_ns


def test_nanoseconds_overflow_in_headers_alone(base, tmp_path):
    parameters = write_recording(defects.overflowing_nanoseconds(base), tmp_path / 'bag')
    assert parameters.exists()
    with open_bag(tmp_path / 'bag') as bag:
        topics = [topic for topic in bag.topics if topic.name.startswith('/camera')]
        nanoseconds = [message.message.header.stamp.nanosec for message in bag.messages(topics)]
    assert max(nanoseconds) >= 1_000_000_000


def test_without_gravity_an_accelerometer_measures_the_acceleration(base):
    true = np.linalg.norm(base.states(base.imu.stamps_ns).acceleration, axis=1)
    removed = np.linalg.norm(defects.gravity_removed(base).imu.accel, axis=1)
    with_gravity = np.linalg.norm(base.imu.accel, axis=1)
    assert np.median(np.abs(removed - true)) < 0.3  # of the lever between camera and IMU
    assert np.median(np.abs(with_gravity - true)) > 5.0


def test_a_low_pass_delays_by_its_true_offset(base):
    """A filtered ramp of rates is the ramp as long before as the truth of the offset says."""
    ramp = np.outer(np.arange(len(base.imu.stamps_ns)), [1.0, 2.0, -1.0])
    filtered = defects.low_pass(replace(base, imu=replace(base.imu, gyro=ramp)), 0.012, 0.005)
    samples = (ramp - filtered.imu.gyro)[-1] / [1.0, 2.0, -1.0]
    step = float(np.median(np.diff(base.imu.stamps_ns))) * 1e-9
    np.testing.assert_allclose(filtered.truth['time_offset_s'], step * samples, rtol=1e-3)


def test_bursts_share_stamps_and_arrive_together(base):
    stamps = defects.bursts(base, 8, 'last').imu.stamps_ns[:16]
    assert len(set(stamps[:8])) == len(set(stamps[8:])) == 1
    steps = np.diff(defects.bursts(base, 8, 'arrival').imu.stamps_ns[:16])
    assert (steps[:7] == 100_000).all()
    assert steps[7] > 50_000_000


@pytest.mark.parametrize('turns', [1, 2, 3])
def test_a_rotated_camera_observes_the_same_points(base, turns):
    """A ray of a pixel before is the ray of the rotated pixel after, in the rotated axes."""
    rotated = defects.portrait(base, turns)
    pixels = np.array([[20.0, 30.0], [140.0, 100.0], [80.0, 10.0]])
    moved = pixels
    width = base.camera.width
    height = base.camera.height
    for _ in range(turns):
        moved = np.stack([moved[:, 1], width - 1.0 - moved[:, 0]], axis=1)
        width, height = height, width
    rays = rotated.camera.unproject(moved) @ rotated.R_camera_image.T
    np.testing.assert_allclose(rays, base.camera.unproject(pixels), atol=1e-7)
    gray = base.shots[0].pixels
    assert rotated.shots[0].pixels.shape == (rotated.camera.height, rotated.camera.width)
    u, v = moved[0].astype(int)
    assert abs(int(rotated.shots[0].pixels[v, u]) - int(gray[30, 20])) < 12  # compressed again
    imu_axes = Rotation.from_quat(rotated.parameters['quat_cam_imu_xyzw']).as_matrix()
    before = Rotation.from_quat(base.parameters['quat_cam_imu_xyzw']).as_matrix()
    np.testing.assert_allclose(rotated.R_camera_image @ imu_axes, before, atol=1e-6)


def test_two_publishers_alternate_on_one_topic(base, tmp_path):
    write_recording(defects.two_imus(base), tmp_path / 'bag')
    with open_bag(tmp_path / 'bag') as bag:
        topics = [topic for topic in bag.topics if topic.name.startswith('/imu')]
        frames = [message.message.header.frame_id for message in bag.messages(topics)]
    assert frames[:4] == ['imu_link', 'base_imu_link'] * 2


@pytest.fixture(scope='module')
def answered(base, tmp_path_factory):
    """The case, and the evidence in a replay, of the intact recording."""
    folder = tmp_path_factory.mktemp('answered')
    case = replace(BY_NAME['right'], commands=('replay',))
    parameters = write_recording(base, folder / 'bag')
    found = offline.answers(case, folder, folder / 'bag', parameters)
    return case, folder, found


def test_an_intact_recording_is_good(base, answered):
    case, folder, found = answered
    judged = verdict.judge(case, offline.evidence_of(base, folder, found), None, 1.0)
    assert (judged.verdict, judged.reason) == ('good', '')
    assert judged.poses >= 2
    assert judged.beyond == 0.0
    assert judged.worst < 4.0


def test_the_verdict_comes_from_the_truth(base, answered):
    """The same answer is a failure where the camera has moved otherwise."""
    case, folder, found = answered

    def elsewhere(stamps_ns):
        states = base.states(stamps_ns)
        later = 1.5 * (stamps_ns - base.start_ns)[:, None] * 1e-9
        return replace(states, position=states.position + later * [0.0, 0.0, 1.0])

    moved = offline.evidence_of(replace(base, states=elsewhere), folder, found)
    judged = verdict.judge(case, moved, None, 1.0)
    assert judged.verdict == 'failure'
    assert judged.beyond > 0.5
    assert judged.worst > verdict.LARGEST_SIGMA


def test_a_wrong_cause_and_a_traceback_are_failures(base, answered):
    case, folder, found = answered
    evidence = offline.evidence_of(base, folder, found)
    broken = replace(evidence, words='Traceback (most recent call)')
    assert 'traceback' in verdict.judge(case, broken, None, 1.0).reason
    drift = NamedCause('offset_drift', 'suspect', 'the clocks drift')
    named = replace(evidence, causes=(*evidence.causes, drift))
    assert verdict.judge(case, named, None, 1.0).wrong == 'offset_drift'
    assert verdict.judge(case, named, None, 1.0).verdict == 'failure'
    assert verdict.judge(replace(case, codes=('offset_drift',)), named, None, 1.0).wrong == ''
    unnamed = replace(case, named='this is said nowhere')
    assert verdict.judge(unnamed, evidence, None, 1.0).verdict == 'poor'
    few = verdict.judge(case, evidence, 1000, 1.0)
    assert few.verdict == 'poor'
    assert 'poses of 1000' in few.reason
    hard = replace(case, solvable=False)
    assert verdict.judge(hard, evidence, 1000, 1.0).verdict == 'good'


def test_distances_have_the_probability_of_one_dimension():
    """Chi-square of 9 with one degree of freedom is three sigmas; with two, 2.54 (tables)."""
    np.testing.assert_allclose(truth.relative_distances(np.array([9.0]), 1), 3.0, rtol=1e-6)
    np.testing.assert_allclose(truth.relative_distances(np.array([9.0]), 2), 2.538, atol=2e-3)
    assert truth.relative_distances(np.array([1e6]), 2) > 100.0


def test_determined_values_of_a_calibration_are_compared():
    one = {'value': 0.031, 'sigma': 0.0005, 'observable': True}
    hidden = {'value': 9.0, 'sigma': 0.1, 'observable': False}
    known = {'readout_time_s': 0.030, 'time_offset_s': 0.0, 'principal_point_px': [320.0, 240.0]}
    found = {
        'readout_time_s': one,
        'time_offset_s': hidden,
        'principal_point_px': [one | {'value': 321.0, 'sigma': 0.5}, hidden],
        'exposure_s': one,
    }
    errors = truth.calibration_sigmas(known, found)
    assert errors == pytest.approx({'readout_time_s': 2.0, 'principal_point_px[0]': 2.0})
    assert truth.calibration_sigmas(known, {**found, 'observable': False}) == {}


def _path(base, seconds, sigma):
    """The true path in a world of another heading and origin, with a covariance."""
    stamps = base.start_ns + (1e9 * np.asarray(seconds)).astype(np.int64)
    true = np.interp(
        stamps - base.start_ns,
        [shot.stamp_ns - base.start_ns for shot in base.shots],
        [shot.true_ns - base.start_ns for shot in base.shots],
    )
    states = base.states(base.start_ns + true.astype(np.int64))
    heading = Rotation.from_euler('z', 0.7)
    return truth.Path(
        stamps,
        heading.apply(states.position) + np.array([3.0, -1.0, 2.0]),
        heading * Rotation.from_matrix(states.R_world_cam),
        np.tile(sigma**2 * np.eye(6), (len(stamps), 1, 1)),
    )


def test_a_path_is_aligned_with_the_truth_at_its_origin(base):
    path = _path(base, np.arange(0.2, 1.5, 0.1), 0.01)
    origin = path.kept(slice(3, 4))
    np.testing.assert_allclose(truth.state_distances(base, path, origin), 0.0, atol=1e-4)
    later = path._replace(positions=path.positions + np.linspace(0.0, 0.1, 13)[:, None])
    distances = truth.state_distances(base, later, path.kept(slice(0, 1)))
    np.testing.assert_allclose(distances[-1], [300.0, 0.0], rtol=1e-3, atol=1e-4)


def test_the_origin_of_a_live_path_is_found(base):
    """Errors of the first published states do not move the others: they relate to the origin."""
    path = _path(base, np.arange(0.1, 1.8, 0.1), 0.02)
    rng = np.random.default_rng(3)
    at_zero = path._replace(positions=path.positions - path.positions[1])
    published = at_zero.kept(slice(5, None))
    off = published.positions + 0.02 * rng.standard_normal(published.positions.shape)
    noisy = published._replace(positions=off)
    origin = truth.fitted_origin(base, noisy, path.stamps_ns.tolist())
    assert origin.stamps_ns[0] == path.stamps_ns[1]
    assert truth.state_distances(base, noisy, origin).mean() < 5.0


def test_states_whose_stamp_is_of_two_times_are_not_compared(base):
    """Where both clocks are set back by half a second, stamps of half a second mean two times."""
    back = defects.wrapped_clock(base, 0.517, 1.0)
    path = _path(base, np.arange(0.05, 0.95, 0.1), 0.01)
    origin = path.kept(slice(0, 1))
    assert len(truth.state_distances(base, path, origin)) == 9
    assert len(truth.state_distances(back, path, origin)) == 4


def test_the_report_counts_verdicts(tmp_path, base, answered):
    case, folder, found = answered
    judged = verdict.judge(case, offline.evidence_of(base, folder, found), None, 1.0)
    text = run.report(tmp_path, [judged, replace(judged, verdict='failure', reason='x')])
    assert '2 cases: 1 good, 0 poor, 1 failure' in text
    assert (tmp_path / 'field.csv').exists()


@pytest.mark.parametrize('name', ['O1', 'O2-axes', 'O2-readout'])
def test_parameters_that_are_off_by_their_sigma_are_a_parameter_file(name, base, tmp_path):
    recording = BY_NAME[name].change(base)
    parameters = read_parameters(write_recording(recording, tmp_path / 'bag'))
    sigmas = ('time_offset_sigma', 'readout_time_sigma', 'axes_sigma')
    assert sum(getattr(parameters.sensor, sigma) > 0.0 for sigma in sigmas) == 1
