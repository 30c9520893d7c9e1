"""The benchmark of covariances: its statistic, and the pairs of a recording."""

import csv
from dataclasses import replace
import itertools

from conftest import ROOT
import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from rs_relpose_lab.experiments.baseline_chain import steps, write_report
from rs_relpose_lab.experiments.consistency import (
    chosen_pairs,
    image_stamps,
    on_recording,
    pair_consistency,
    read_true_pairs,
)
from rs_relpose_ros.bags.reader import open_bag
from rs_relpose_ros.cli.main import main
from rs_relpose_ros.config.parameter_file import read_parameters
from rs_relpose_ros.errors import InputError
from rs_relpose_ros.estimator.result import RelativePose, Status
from rs_relpose_ros.replay.run import read_truth, Replay

COLUMNS = ['stamp1_ns', 'stamp2_ns', *(f'r{i}{j}' for i in (1, 2, 3) for j in (1, 2, 3)), 'tx',
           'ty', 'tz', 'sigma_t_deg']
PARAMETERS = ROOT / 'bags' / 'hand_held.yaml'


@pytest.mark.parametrize('claimed', [1.0, 0.5])
def test_errors_drawn_from_a_covariance(claimed):
    """NEES by freedom is 1 where the covariance is right, 4 where its sigmas are half of it."""
    rng = np.random.default_rng(0)
    t = np.array([0.6, 0.0, 0.8])
    across = np.eye(3) - np.outer(t, t)
    root = 0.01 * rng.normal(size=(6, 6))
    root[:3] = across @ root[:3]
    sigma = 0.02   # of the truth
    found = []
    for _ in range(2000):
        error = root @ rng.normal(size=6)
        true_t = t + error[:3] + sigma * across @ rng.normal(size=3)
        pose = RelativePose(Status.OK, R=np.eye(3), t=t, covariance=claimed**2 * root @ root.T)
        found.append(pair_consistency('', '', 0.1, pose,
                                      Rotation.from_rotvec(error[3:]).as_matrix(), true_t,
                                      claimed * sigma))
    assert np.mean([p.rotation_nees for p in found]) == pytest.approx(claimed**-2, rel=0.07)
    assert np.mean([p.translation_nees for p in found]) == pytest.approx(claimed**-2, rel=0.07)


# Frames of the bundled bag, where the policy has no keyframes. The second overlaps both others.
ENDS = ((60, 71), (65, 76), (71, 90))


def chosen(bag_path, ends):
    """Pairs with these ends, and the stamps of the ends."""
    stamps = image_stamps(bag_path)
    wanted = [(stamps[first], stamps[second]) for first, second in ends]
    return list(chosen_pairs(bag_path, read_parameters(PARAMETERS), wanted)), wanted


def test_pairs_are_closed_where_they_are_chosen(bundled_bag):
    pairs, wanted = chosen(bundled_bag, ENDS[::2])
    assert [(pair.reference_stamp_ns, pair.stamp_ns) for pair in pairs] == wanted
    # Of the pairs before, which the policy closed.
    assert any(finding.observable for finding in pairs[0].health.findings)


def true_pairs(bag_path, path):
    """A table of `ENDS`, by the truth; also what it was written from."""
    with open_bag(bag_path) as bag:
        truth = read_truth(bag, bag.find_topics())
    first, second = (chosen(bag_path, ends)[0] for ends in (ENDS[::2], ENDS[1:2]))
    results = [*first, *second]
    with path.open('w', newline='', encoding='utf-8') as file:
        writer = csv.writer(file)
        writer.writerow(COLUMNS)
        for result in reversed(results):
            R, t = truth.relative_pose(result.reference_ns1, result.reference_ns2)
            writer.writerow([result.reference_stamp_ns, result.stamp_ns, *R.ravel(),
                             *t / np.linalg.norm(t), 1.0])
    return results


def test_pairs_of_a_recording_are_those_of_the_table(bundled_bag, tmp_path):
    table = tmp_path / 'pairs.csv'
    results = true_pairs(bundled_bag, table)
    assert [pair.translation_sigma for pair in read_true_pairs(table)] == [np.radians(1.0)] * 3
    found = list(on_recording(bundled_bag, PARAMETERS, table))
    assert [p.interval for p in found] == [r.interval for r in results]
    for pair in found:
        assert pair.rotation < 0.1 and pair.translation < 2.0
        assert pair.rotation_nees < 5.0 and pair.translation_nees < 5.0


def test_a_table_of_something_else_is_refused(tmp_path, capsys):
    table = tmp_path / 'table.csv'
    table.write_text('stamp,x\n1,2\n', encoding='utf-8')
    with pytest.raises(InputError, match='is no table of true pairs'):
        read_true_pairs(table)
    assert main(['benchmark', 'consistency', '--bags', '0', '--output', str(tmp_path)]) == 2
    assert 'nothing to measure' in capsys.readouterr().err


def test_baselines_agree_with_the_scale_of_their_tracks(bundled_bag, tmp_path):
    """By the truth they do; one that is told half as large again does not."""
    parameters = read_parameters(PARAMETERS)
    with open_bag(bundled_bag) as bag:
        topics = bag.find_topics()
        truth = read_truth(bag, topics)
        found = [pair.result for pair in itertools.islice(
            Replay(bag, topics, parameters).pairs(), 6)]
    pairs = []
    for pair in found:
        _, metric = truth.relative_pose(pair.reference_ns1, pair.reference_ns2)
        pairs.append(replace(pair, pose=replace(
            pair.pose, baseline=float(np.linalg.norm(metric)), baseline_log_sigma=0.05)))
    right = list(steps('', pairs))
    assert len(right) >= 3
    assert max(abs(step.disagreement) for step in right) < 0.15
    assert all(step.known for step in right)
    wrong = replace(pairs[2], pose=replace(pairs[2].pose, baseline=1.5 * pairs[2].pose.baseline))
    told = list(steps('', [*pairs[:2], wrong, *pairs[3:]]))
    assert [step.disagreement - ours.disagreement for step, ours in zip(
        told, right, strict=True)][1:3] == pytest.approx([np.log(1.5), -np.log(1.5)])
    assert abs(told[1].sigmas) > 3.0
    beyond = sum(abs(step.sigmas) > 3.0 for step in told)
    lines = write_report(tmp_path, told).splitlines()
    for line in lines[2:]:   # all of them, and those that are known well: all
        assert [int(cell) for cell in line.split('|')[2:4]] == [len(told), beyond]
    assert (tmp_path / 'baseline_chain.csv').read_text().count('\n') == 1 + len(told)
