"""SIFT and ORB matching over wide baselines, and the course of ids."""

import cv2
import numpy as np
import pytest
from tracking_images import errors, WarpedScene

from rs_relpose_ros.config.tracking import TrackingConfig
from rs_relpose_ros.tracking.tracker import make_tracker


@pytest.fixture(scope='module')
def scene():
    return WarpedScene(height=360, width=480, seed=3)


def tracker_of(detector, **settings):
    return make_tracker(TrackingConfig(detector=detector, max_descriptors=600, **settings))


@pytest.mark.parametrize('detector, exact', [('sift', 0.5), ('orb', 1.5)])
def test_wide_baseline(scene, detector, exact):
    H1, H2 = np.eye(3), scene.similarity(40.0, 1.3, (70.0, -30.0))
    tracker = tracker_of(detector)
    tracker.start(scene.view(H1, noise=2.0))
    matches = tracker.track(scene.view(H2, noise=2.0, gain=0.8, offset=10.0))
    error = errors(matches, H1, H2)
    assert len(matches) > 60
    assert np.mean(error < 5.0) > 0.9
    assert np.median(error) < exact
    assert (matches.quality > 0.0).all() and (matches.quality <= 1.0).all()
    assert len(np.unique(matches.track_ids)) == len(matches)
    assert len(np.unique(matches.points1, axis=0)) == len(matches)
    assert len(np.unique(matches.points2, axis=0)) == len(matches)


def test_corners_cannot_be_followed_that_far(scene):
    """What the test above shows is owed to the descriptors."""
    H1, H2 = np.eye(3), scene.similarity(40.0, 1.3, (70.0, -30.0))
    tracker = make_tracker(TrackingConfig())
    tracker.start(scene.view(H1))
    tracker.track(scene.view(H2))
    assert np.sum(errors(tracker.refined_matches(), H1, H2) < 3.0) < 20


def test_mutual_nearest_neighbours_and_ratio_agree_with_the_brute_force_matcher(scene):
    images = [scene.view(np.eye(3), noise=2.0),
              scene.view(scene.similarity(20.0, 1.1, (20.0, 5.0)), noise=2.0)]
    tracker = tracker_of('sift', match_ratio=0.7)
    tracker.start(images[0])
    matches = tracker.track(images[1])
    sift = cv2.SIFT.create(nfeatures=600)
    (k1, d1), (k2, d2) = (sift.detectAndCompute(image, None) for image in images)
    # One descriptor per place, as the tracker keeps them.
    (k1, d1), (k2, d2) = (once(k1, d1), once(k2, d2))
    back = {m.queryIdx: m.trainIdx for m in cv2.BFMatcher().match(d2, d1)}
    expected = {(k1[a.queryIdx].pt, k2[a.trainIdx].pt)
                for a, b in cv2.BFMatcher().knnMatch(d1, d2, k=2)
                if a.distance < 0.7 * b.distance and back[a.trainIdx] == a.queryIdx}
    found = {(tuple(p), tuple(q))
             for p, q in zip(matches.points1.tolist(), matches.points2.tolist(), strict=True)}
    assert len(expected) > 50
    assert found == expected


def once(keypoints, descriptors):
    _, first = np.unique([k.pt for k in keypoints], axis=0, return_index=True)
    first = np.sort(first)
    return [keypoints[k] for k in first], descriptors[first]


@pytest.mark.parametrize('detector', ['sift', 'orb'])
def test_an_id_follows_its_keypoint_into_the_next_pair(scene, detector):
    views = [scene.similarity(6.0 * k, 1.0 + 0.04 * k) for k in range(3)]
    tracker = tracker_of(detector)
    tracker.start(scene.view(views[0]))
    first = tracker.track(scene.view(views[1]))
    assert tracker.tracked_fraction == 1.0
    tracker.promote()
    second = tracker.track(scene.view(views[2]))
    common, in_first, in_second = np.intersect1d(first.track_ids, second.track_ids,
                                                 return_indices=True)
    assert len(common) > 50
    np.testing.assert_array_equal(first.points2[in_first], second.points1[in_second])
    assert len(np.setdiff1d(second.track_ids, first.track_ids)) > 0


@pytest.mark.parametrize('detector', ['sift', 'orb'])
def test_images_that_share_nothing_have_few_matches(scene, detector):
    other = WarpedScene(height=360, width=480, seed=9)
    tracker = tracker_of(detector)
    tracker.start(scene.view(np.eye(3)))
    tracker.track(scene.view(scene.similarity(3.0)))
    assert tracker.tracked_fraction == 1.0
    assert len(tracker.track(other.view(np.eye(3)))) < 0.05 * 600
    assert tracker.tracked_fraction < 0.1
