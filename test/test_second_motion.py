"""An object that moves through the view: named, and its pairs are no evidence and have no pose."""

from dataclasses import replace

import numpy as np
import pytest
from scipy.stats import norm
from scipy.stats import t as student_t
from test_monitor import flight, NONE

from rs_relpose_ros.calibration import assessment
from rs_relpose_ros.calibration.findings import Code, Finding, FindingState, Why
from rs_relpose_ros.calibration.findings_text import line
from rs_relpose_ros.calibration.second_motion import second_share, SecondMotions
from rs_relpose_ros.estimator.result import Diagnostics, RelativePose, Status
from rs_relpose_ros.pipeline.monitor import Contradictions

NO_TURN = np.array([0.004, -0.003])  # 1 + a similarity's turn and scale


def with_object(pair, share, shift, seed=4):
    """A pair whose leftmost `share` of the matches are of an object that moves by `shift`."""
    border = np.quantile(pair.points1[:, 0], share)
    of_object = pair.points1[:, 0] < border
    noise = np.random.default_rng(seed).normal(size=pair.points1.shape)
    moved = pair.points1 + shift + 0.2 * noise
    turned = moved + (moved - moved.mean(axis=0)) @ np.array([NO_TURN, NO_TURN[::-1] * (-1, 1)])
    points2 = np.where(of_object[:, None], turned, pair.points2)
    return replace(pair, points2=points2), of_object


def pose_of(inliers, gyro_square):
    return RelativePose(
        status=Status.LOW_PARALLAX,
        reason='',
        inliers=inliers,
        diagnostics=Diagnostics(gyro_square=gyro_square),
    )


@pytest.mark.parametrize('share', [0.25, 0.7])
@pytest.mark.parametrize('follows', ['scene', 'object'])
def test_the_share_of_an_object_is_counted(share, follows):
    for pair in flight(NONE, 4):
        shown, of_object = with_object(pair, share, (9.0, -4.0))
        inliers = of_object if follows == 'object' else ~of_object
        assert second_share(shown, inliers) == pytest.approx(of_object.mean(), abs=0.06)
        assert second_share(pair, np.ones(len(inliers), dtype=bool)) == 0.0


def test_matches_at_random_are_no_object():
    rng = np.random.default_rng(8)
    for pair in flight(NONE, 4):
        wrong = rng.random(len(pair.points1)) < 0.4
        points2 = pair.points2 + np.where(wrong[:, None], rng.normal(size=(len(wrong), 2)) * 30, 0)
        assert second_share(replace(pair, points2=points2), ~wrong) == 0.0


def test_an_object_is_in_view_from_the_fifth_pair_until_long_after_the_last():
    motions = SecondMotions()
    for k, pair in enumerate(flight(NONE, 5)):
        shown, of_object = with_object(pair, 0.5, (12.0, 3.0))
        assert motions.add(shown, pose_of(of_object, np.nan))
        assert motions.in_view is (k == 4)
    found = motions.finding()
    assert (found.code, found.state) == (Code.MOVING_OBJECT, FindingState.WRONG)
    assert found.evidence.measured['share_of_matches'] == pytest.approx(0.5, abs=0.05)
    assert 'a moving object fills much of the view' in line(found)
    everything = pose_of(np.ones(len(pair.points1), dtype=bool), 1.0)
    later = [motions.add(pair, everything) for _ in range(60)]
    assert all(later[:30])
    assert not any(later[45:])


@pytest.mark.parametrize(
    ('squares', 'withheld'),
    [
        ([2.0, 40.0, 3.0] * 6, False),  # single poor pairs
        ([0.5] * 9 + [np.inf] * 2 + [1.0] * 9, False),
        ([90.0, 3.0, 50.0, 70.0, 25.0, 120.0, 19.0, 66.0], True),  # squeezed images
        ([1.0, np.inf, 90.0, np.inf, 2.0, np.inf], True),  # stabilised images
    ],
)
def test_pairs_among_many_that_contradict_the_gyro_are_not_trusted(squares, withheld):
    """An infinite chi-square: the rotation of the gyro was rejected."""
    contradictions = Contradictions()
    for square in squares:
        everything = np.ones(30, dtype=bool)
        pose = pose_of(everything, 1.0 if square == np.inf else square)
        if square == np.inf:
            diagnostics = replace(pose.diagnostics, rejected=pose, gyro_square=np.nan)
            pose = replace(pose, diagnostics=diagnostics)
        contradictions.add(pose)
    assert contradictions.too_many is withheld
    differing, count = contradictions.counts
    text = line(assessment.contradicting(differing, count))
    assert f'contradict each other in {differing} of the last {count} pairs' in text
    contradictions.clear()
    assert not contradictions.too_many


def test_impossible_values_are_no_count_of_pairs():
    """No pair need contradict the gyro where only values that no sensor has explain the pairs."""
    fault = Finding(Code.GYRO_SCALE, FindingState.WRONG, Why.OFF)
    finding = assessment.impossible([fault], 8)
    text = line(finding)
    assert text.startswith('unknown_cause is wrong: no value of gyro_scale that sensors have')
    assert finding.candidates and 'of the last' not in text


def test_pairs_between_many_that_contradict_the_gyro_are_not_trusted():
    """As of two views in one image: half of the pairs agree with the gyro, by chance."""
    contradictions = Contradictions()
    everything = np.ones(30, dtype=bool)
    for square in [41.0] * 8 + [1.0, 41.0] * 8:
        contradictions.add(pose_of(everything, square))
        assert contradictions.too_many or contradictions.counts[1] < 6
    for number in range(8):
        assert contradictions.too_many is (number < 6)
        contradictions.add(pose_of(everything, 1.0))
    assert not contradictions.too_many


def test_rotations_that_differ_as_the_configuration_allows_are_no_contradiction():
    contradictions = Contradictions()
    pose = pose_of(np.ones(30, dtype=bool), 41.0)
    for _ in range(8):
        contradictions.add(pose, is_allowed=True)
    assert not contradictions.too_many
    for _ in range(8):
        contradictions.add(pose)
    assert contradictions.too_many


@pytest.mark.parametrize(
    ('squares', 'untested'),
    [([40.0], True), ([1.0] * 7 + [40.0], True), ([1.0] * 8 + [40.0], False), ([2.0], False)],
)
def test_a_pair_that_differs_before_others_agree_is_untested(squares, untested):
    contradictions = Contradictions()
    for square in squares:
        contradictions.add(pose_of(np.ones(30, dtype=bool), square))
    assert contradictions.is_untested is untested
    contradictions.add(pose_of(np.ones(30, dtype=bool), 40.0), is_allowed=True)
    assert not contradictions.is_untested
    contradictions.clear()
    contradictions.add(pose_of(np.ones(30, dtype=bool), 40.0))
    assert contradictions.is_untested


def test_covariances_are_those_of_few_tests_at_first():
    """The distance that contains 99.7 % of them has the same probability with Student's law."""
    contradictions = Contradictions()
    pose = replace(pose_of(np.ones(30, dtype=bool), 0.2), covariance=np.eye(6))
    for number in range(31):
        factor = contradictions.widened(pose).covariance[0, 0]
        tested = student_t(20 + 3 * number)
        assert tested.sf(norm.isf(0.0015) * np.sqrt(factor)) == pytest.approx(0.0015, rel=0.15)
        contradictions.add(pose)
    assert factor < 1.05


def test_a_scene_behind_an_object_that_agrees_with_the_gyro_keeps_its_poses():
    motions = SecondMotions()
    for pair in flight(NONE, 9):
        shown, of_object = with_object(pair, 0.3, (12.0, 3.0))
        assert not motions.add(shown, pose_of(~of_object, 2.0))
