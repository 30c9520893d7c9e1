"""`rs_relpose benchmark field`: defects change what they say, and verdicts come from the truth."""

from dataclasses import replace

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from rs_relpose_lab.field import defects, run, verdict
from rs_relpose_lab.field.cases import BASES, BY_NAME, CASES
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


def test_a_step_of_the_clock_moves_stamps_and_not_the_truth(base):
    stepped = defects.camera_clock_step(base, 0.05, 1.0)
    apart = np.array([shot.stamp_ns for shot in stepped.shots]) - [
        shot.stamp_ns for shot in base.shots
    ]
    assert set(apart[:10]) == {0}
    assert set(apart[10:]) == {50_000_000}
    assert [shot.true_ns for shot in stepped.shots] == [shot.true_ns for shot in base.shots]


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
    moved, width = pixels, base.camera.width
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
    """Folder and answer of a replay of the intact recording."""
    folder = tmp_path_factory.mktemp('answered')
    case = replace(BY_NAME['right'], commands=('replay',))
    parameters = write_recording(base, folder / 'bag')
    return case, folder, verdict.answers(case, folder, folder / 'bag', parameters)


def test_an_intact_recording_is_good(base, answered):
    case, folder, found = answered
    judged = verdict.judge(case, base, folder, found, None, 1.0)
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

    judged = verdict.judge(case, replace(base, states=elsewhere), folder, found, None, 1.0)
    assert judged.verdict == 'failure'
    assert judged.beyond > 0.5
    assert judged.worst > verdict.LARGEST_SIGMA


def test_a_wrong_cause_and_a_traceback_are_failures(base, answered):
    case, folder, found = answered
    broken = {**found, 'replay': replace(found['replay'], text='Traceback (most recent call)')}
    assert 'traceback' in verdict.judge(case, base, folder, broken, None, 1.0).reason
    unnamed = replace(case, named='this is said nowhere')
    assert verdict.judge(unnamed, base, folder, found, None, 1.0).verdict == 'poor'
    few = verdict.judge(case, base, folder, found, 1000, 1.0)
    assert few.verdict == 'poor'
    assert 'poses of 1000' in few.reason
    hard = replace(case, solvable=False)
    assert verdict.judge(hard, base, folder, found, 1000, 1.0).verdict == 'good'


def test_distances_have_the_probability_of_one_dimension():
    """Chi-square of 9 with one degree of freedom is three sigmas; with two, 2.54 (tables)."""
    np.testing.assert_allclose(verdict.relative_distances(np.array([9.0]), 1), 3.0, rtol=1e-6)
    np.testing.assert_allclose(verdict.relative_distances(np.array([9.0]), 2), 2.538, atol=2e-3)
    assert verdict.relative_distances(np.array([1e6]), 2) > 100.0


def test_the_report_counts_verdicts(tmp_path, base, answered):
    case, folder, found = answered
    judged = verdict.judge(case, base, folder, found, None, 1.0)
    text = run.report(tmp_path, [judged, replace(judged, verdict='failure', reason='x')])
    assert '2 cases: 1 good, 0 poor, 1 failure' in text
    assert (tmp_path / 'field.csv').exists()


@pytest.mark.parametrize('name', ['O1', 'O2-axes', 'O2-readout'])
def test_parameters_that_are_off_by_their_sigma_are_a_parameter_file(name, base, tmp_path):
    recording = BY_NAME[name].change(base)
    parameters = read_parameters(write_recording(recording, tmp_path / 'bag'))
    sigmas = ('time_offset_sigma', 'readout_time_sigma', 'axes_sigma')
    assert sum(getattr(parameters.sensor, sigma) > 0.0 for sigma in sigmas) == 1
