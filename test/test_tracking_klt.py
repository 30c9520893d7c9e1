"""Corner tracking: against exact warps, with and without prediction, on bad images, by seed."""

import cv2
import numpy as np
import pytest
from scipy.ndimage import map_coordinates
from tracking_images import errors, moved, WarpedScene

from rs_relpose_ros.config.tracking import TRACKERS, TrackingConfig
from rs_relpose_ros.errors import InputError
from rs_relpose_ros.tracking.alignment import window_homography
from rs_relpose_ros.tracking.correlation import correlations
from rs_relpose_ros.tracking.tracker import make_tracker


@pytest.fixture(scope='module')
def scene():
    return WarpedScene()


def hand_held(scene, k):
    """Homography of frame k: turns by 1.2 deg, zooms by 1 %, and shifts in each frame."""
    H = scene.similarity(1.2 * k, 1.0 + 0.01 * k, (1.7 * k, -2.3 * k))
    return H @ np.array([[1.0, 0.0, 0.0], [0.0, 1.0, 0.0], [2e-6 * k, -3e-6 * k, 1.0]])


def track_sequence(images, **settings):
    tracker = make_tracker(TrackingConfig(**settings))
    tracker.start(images[0])
    for image in images[1:]:
        tracker.track(image)
    return tracker


def test_matches_of_a_pure_warp_are_exact(scene):
    H1, H2 = np.eye(3), scene.similarity(4.0, 1.03, (6.3, -4.8))
    tracker = track_sequence([scene.view(H1), scene.view(H2)])
    matches = tracker.refined_matches()
    assert len(matches) > 250
    error = errors(matches, H1, H2)
    assert np.median(error) < 0.05
    assert np.percentile(error, 95) < 0.15


def test_noise_gain_and_offset_do_not_bias(scene):
    H1, H2 = np.eye(3), scene.similarity(1.0, 1.0, (3.4, 1.7))
    tracker = track_sequence(
        [scene.view(H1, noise=3.0), scene.view(H2, noise=3.0, gain=0.7, offset=25.0)])
    error = errors(tracker.refined_matches(), H1, H2)
    assert len(error) > 230
    assert np.median(error) < 0.1


def test_the_reference_corrects_the_drift(scene):
    images = [scene.view(hand_held(scene, k), noise=2.0) for k in range(9)]
    tracker = track_sequence(images[:8])
    followed = tracker.track(images[8])
    refined = tracker.refined_matches()
    H1, H2 = hand_held(scene, 0), hand_held(scene, 8)
    assert len(refined) > 0.85 * 300
    assert np.median(errors(refined, H1, H2)) < 0.1
    assert np.median(errors(refined, H1, H2)) < 0.5 * np.median(errors(followed, H1, H2))


@pytest.mark.parametrize('levels', [1, 4])
def test_prediction_carries_over_60_px(scene, levels):
    H1, H2 = np.eye(3), scene.similarity(2.0, 1.0, (60.0, -20.0))
    images = [scene.view(H1), scene.view(H2)]
    tracker = make_tracker(TrackingConfig(klt_levels=levels))
    tracker.start(images[0])
    # Two pixels off, and unknown for a tenth of the points.
    expected = moved(tracker.points, H1, H2) + 1.4
    expected[::10] = np.nan
    matches = tracker.track(images[1], expected)
    visible = moved(matches.points1, H1, H2)
    assert len(matches) > 180
    assert np.median(np.linalg.norm(visible - matches.points2, axis=1)) < 0.15


def test_without_prediction_one_level_cannot_follow_60_px(scene):
    """What the test above shows is owed to the prediction."""
    H1, H2 = np.eye(3), scene.similarity(2.0, 1.0, (60.0, -20.0))
    tracker = track_sequence([scene.view(H1), scene.view(H2)], klt_levels=1)
    assert np.sum(errors(tracker.refined_matches(), H1, H2) < 1.0) < 20


def test_motion_goes_on_in_proportion_to_the_time_between_images(scene):
    """Frames that a busy machine drops leave gaps."""
    flow = np.array([5.0, -2.0])
    views = [scene.similarity(0.0, 1.0, tuple(-k * flow)) for k in (0, 1, 13)]
    found = []
    for gap in (12.0, 1.0):
        # Without a pyramid nothing is found far from its guess.
        tracker = make_tracker(TrackingConfig(klt_levels=1))
        tracker.start(scene.view(views[0]))
        # The prediction knows 80 % of the motion.
        tracker.track(scene.view(views[1]), tracker.points + 0.8 * flow, 1.0)
        tracker.track(scene.view(views[2]), tracker.points + 12.0 * 0.8 * flow, gap)
        found.append(np.count_nonzero(
            errors(tracker.refined_matches(), views[0], views[2]) < 0.5))
    assert found[0] > 200
    assert found[1] < 0.7 * found[0]


def test_a_wrong_prediction_is_overcome_or_drops_the_track(scene):
    H1, H2 = np.eye(3), scene.similarity(1.0, 1.0, (4.0, 3.0))
    images = [scene.view(H1), scene.view(H2)]
    tracker = make_tracker(TrackingConfig())
    tracker.start(images[0])
    tracker.track(images[1], moved(tracker.points, H1, H2) + np.array([18.0, -11.0]))
    matches = tracker.refined_matches()
    error = errors(matches, H1, H2)
    assert len(matches) > 150
    assert np.mean(error < 0.5) > 0.97


def test_ids_are_unique_and_persist_over_pairs(scene):
    images = [scene.view(hand_held(scene, k)) for k in range(7)]
    tracker = make_tracker(TrackingConfig())
    tracker.start(images[0])
    pairs = []
    for k in range(1, 7):
        tracker.track(images[k])
        if k % 3 == 0:
            pairs.append(tracker.refined_matches())
            tracker.promote()
    first, second = pairs
    for pair in pairs:
        assert pair.track_ids.dtype == np.uint32
        assert len(np.unique(pair.track_ids)) == len(pair)
    common, in_first, in_second = np.intersect1d(first.track_ids, second.track_ids,
                                                 return_indices=True)
    assert len(common) > 200
    # The same track: the second point of one pair is the first point of the next.
    np.testing.assert_array_equal(first.points2[in_first], second.points1[in_second])
    new = np.setdiff1d(second.track_ids, first.track_ids)
    assert len(new) > 0 and new.min() > 299


def test_promotion_fills_up_and_reset_never_uses_an_id_again(scene):
    images = [scene.view(np.eye(3)), scene.view(scene.similarity(0.0, 1.0, (120.0, 0.0)))]
    tracker = make_tracker(TrackingConfig())
    tracker.start(images[0])
    tracker.track(images[1], tracker.points - (120.0, 0.0))
    assert 0.6 < tracker.tracked_fraction < 0.9
    tracker.promote()
    assert tracker.tracked_fraction == 1.0
    before = tracker.track(images[1])
    assert len(before) >= 285
    right = before.points1[:, 0] > 520
    assert np.sum(right) > 30
    tracker.reset()
    assert tracker.tracked_fraction == 0.0
    tracker.start(images[0])
    assert tracker.track(images[0]).track_ids.min() > before.track_ids.max()


def test_corners_are_spread_and_keep_their_distance(scene):
    image = scene.view(np.eye(3))
    # A half with contrast four times that of the other one must not take all corners.
    image[:, 320:] = 128 + (image[:, 320:].astype(int) - 128) // 4
    tracker = make_tracker(TrackingConfig(max_features=200, min_feature_distance=12.0,
                                          feature_quality=0.5))
    tracker.start(image)
    points = tracker.track(image).points1
    assert len(points) > 190
    assert 0.35 < np.mean(points[:, 0] < 320) < 0.65
    apart = np.linalg.norm(points[:, None] - points[None], axis=2) + 1e9 * np.eye(len(points))
    assert apart.min() >= 12.0 - 1e-9
    cells, _, _ = np.histogram2d(points[:, 1], points[:, 0], bins=(4, 5),
                                 range=((0, 480), (0, 640)))
    assert cells.min() >= 3


@pytest.mark.parametrize('detector', ['klt', 'orb'])
def test_feature_rows_bound_both_points(scene, detector):
    tracker = make_tracker(TrackingConfig(detector=detector, feature_rows=(100, 300)))
    H2 = scene.similarity(0.0, 1.0, (0.0, 20.0))
    tracker.start(scene.view(np.eye(3)))
    matches = tracker.track(scene.view(H2))
    rows = np.concatenate([matches.points1[:, 1], matches.points2[:, 1]])
    assert len(matches) > 60
    assert rows.min() >= 100 and rows.max() <= 300


def test_noise_gives_few_matches(scene):
    """Images that share nothing, and images of next to no texture."""
    rng = np.random.default_rng(5)
    other = WarpedScene(seed=7)
    tracker = track_sequence([scene.view(np.eye(3)), other.view(np.eye(3))])
    assert len(tracker.refined_matches()) < 15
    grey = [np.clip(np.round(120 + 2.0 * rng.normal(size=(480, 640))), 0, 255).astype(np.uint8)
            for _ in range(2)]
    assert len(track_sequence(grey).refined_matches()) < 10


@pytest.mark.parametrize(('detector', 'value'), [
    ('klt', 0), ('klt', 255), ('sift', 0), ('orb', 0)])
def test_blank_frames_lose_all_tracks_and_good_ones_bring_new(scene, detector, value):
    good, blank = scene.view(np.eye(3)), np.full((480, 640), value, dtype=np.uint8)
    tracker = make_tracker(TrackingConfig(detector=detector))
    tracker.start(good)
    assert len(tracker.track(blank)) == 0
    assert tracker.tracked_fraction == 0.0
    assert len(tracker.refined_matches()) == 0
    tracker.promote()
    assert len(tracker.track(good)) == 0
    tracker.promote()
    assert len(tracker.track(good)) > 280


def test_a_frozen_image_stands_still(scene):
    image = scene.view(np.eye(3))
    tracker = track_sequence([image] * 4)
    matches = tracker.refined_matches()
    assert len(matches) > 290
    np.testing.assert_allclose(matches.points2, matches.points1, atol=1e-3)


@pytest.mark.parametrize('detector', TRACKERS)
@pytest.mark.parametrize('shape', [(1, 1), (8, 8), (17, 400), (40, 33), (64, 48)])
def test_tiny_images_do_no_harm(detector, shape):
    image = np.random.default_rng(0).integers(0, 256, shape, dtype=np.uint8)
    tracker = make_tracker(TrackingConfig(detector=detector))
    tracker.start(image)
    matches = tracker.track(image)
    assert np.isfinite(matches.points2).all() and len(matches) <= 300
    tracker.refined_matches()
    tracker.promote()
    tracker.track(image)


@pytest.mark.parametrize('detector', ['klt', 'orb'])
def test_what_is_no_image_of_the_stream_is_refused(scene, detector):
    tracker = make_tracker(TrackingConfig(detector=detector))
    with pytest.raises(InputError, match='start'):
        tracker.track(scene.view(np.eye(3)))
    with pytest.raises(InputError, match='start'):
        tracker.promote()
    tracker.start(scene.view(np.eye(3)))
    with pytest.raises(InputError, match='640x480 to 600x480'):
        tracker.track(scene.view(np.eye(3))[:, :600])
    with pytest.raises(InputError, match='uint8'):
        tracker.track(scene.view(np.eye(3)).astype(np.float32))
    with pytest.raises(InputError, match='not empty'):
        tracker.start(np.empty((0, 640), dtype=np.uint8))
    # The stream goes on where it was.
    assert len(tracker.track(scene.view(np.eye(3)))) > 100
    tracker.reset()
    tracker.start(scene.view(np.eye(3))[:, :600])


def test_quality_tells_good_matches_from_bad_ones(scene):
    """Under noise the better half by quality has the smaller errors, and all are small."""
    halves = []
    for k in range(4):
        H1, H2 = np.eye(3), scene.similarity(1.0, 1.0, (3.4, 1.7 + 0.1 * k))
        tracker = track_sequence([scene.view(H1, noise=12.0), scene.view(H2, noise=12.0)],
                                 min_correlation=0.3)
        matches = tracker.refined_matches()
        assert (matches.quality >= 0.0).all() and (matches.quality <= 1.0).all()
        error = errors(matches, H1, H2)[np.argsort(-matches.quality)]
        assert len(error) > 200
        halves.append([np.mean(part) for part in np.array_split(error, 2)])
    better, worse = np.mean(halves, axis=0)
    assert better < 0.92 * worse
    assert 0.5 * (better + worse) < 0.22


@pytest.mark.parametrize('detector', TRACKERS)
def test_threads_and_repetition_do_not_change_a_bit(scene, detector):
    images = [scene.view(hand_held(scene, k), noise=2.0) for k in range(4)]
    found = []
    threads = cv2.getNumThreads()
    try:
        for count in (1, 2, 2):
            cv2.setNumThreads(count)
            tracker = track_sequence(images, detector=detector)
            tracker.promote()
            tracker.track(images[1])
            found.append(tracker.refined_matches())
    finally:
        cv2.setNumThreads(threads)
    for other in found[1:]:
        np.testing.assert_array_equal(other.points2, found[0].points2)
        np.testing.assert_array_equal(other.track_ids, found[0].track_ids)
        np.testing.assert_array_equal(other.quality, found[0].quality)


def test_matches_given_out_do_not_change_later(scene):
    tracker = make_tracker(TrackingConfig())
    tracker.start(scene.view(np.eye(3)))
    matches = tracker.track(scene.view(scene.similarity(0.0, 1.0, (3.0, 0.0))))
    before = matches.points2.copy()
    tracker.refined_matches()
    tracker.track(scene.view(np.eye(3)))
    np.testing.assert_array_equal(matches.points2, before)


def test_windows_turned_by_25_degrees_are_compared_upright(scene):
    H1, H2 = np.eye(3), scene.similarity(25.0, 1.15)
    images = [scene.view(scene.similarity(5.0 * k, 1.0 + 0.03 * k)) for k in range(6)]
    tracker = track_sequence(images)
    matches = tracker.refined_matches()
    assert len(matches) > 150
    assert np.median(errors(matches, H1, H2)) < 0.1
    # The same windows, not turned, hardly look alike.
    plain = correlations(images[0], images[5], matches.points1, matches.points2, 15)
    assert np.median(plain) < np.median(matches.quality) - 0.1


def test_correlation_at_the_border_and_of_flat_windows(scene):
    image = scene.view(np.eye(3))
    points = np.array([[0.0, 0.0], [639.0, 479.0], [300.0, 200.0]])
    np.testing.assert_allclose(correlations(image, image, points, points, 15), 1.0)
    np.testing.assert_allclose(correlations(image, 255 - image, points, points, 15), -1.0)
    flat = np.full_like(image, 7)
    np.testing.assert_array_equal(correlations(image, flat, points, points, 15), 0.0)


@pytest.mark.parametrize('side', [5, 15, 17, 31])
def test_correlation_equals_that_of_numpy(scene, side):
    images = scene.view(np.eye(3)), scene.view(scene.similarity(1.0, 1.0, (0.4, 0.3)))
    rng = np.random.default_rng(5)
    # Over the whole image, its border included.
    points1 = rng.uniform([0.0, 0.0], [639.0, 479.0], (200, 2))
    points2 = np.clip(points1 + rng.normal(size=(200, 2)), 0.0, [639.0, 479.0])
    steps = np.arange(side) - side // 2
    grid = np.stack(np.meshgrid(steps, steps, indexing='ij'), axis=-1)
    for row, point1, point2 in zip(
            correlations(*images, points1, points2, side), points1, points2, strict=True):
        windows = [map_coordinates(image.astype(float), (grid + point[::-1]).reshape(-1, 2).T,
                                   order=1, mode='nearest')
                   for image, point in zip(images, (point1, point2), strict=True)]
        if min(window.std() for window in windows) > 0.1:
            assert row == pytest.approx(np.corrcoef(*windows)[0, 1], abs=1e-4)


def test_a_jerk_after_steady_motion_does_not_lose_the_tracks(scene):
    """Where guesses were good less of the pyramid is asked, until they are not."""
    H = [scene.similarity(0.0, 1.0, (x, 0.0)) for x in (0.0, 1.0, 2.0, 3.0, 4.0, 22.0, 23.0)]
    matches = track_sequence([scene.view(warp) for warp in H]).refined_matches()
    assert len(matches) > 240
    assert np.median(errors(matches, H[0], H[-1])) < 0.1


def test_homography_of_windows_is_the_identity_where_there_is_none():
    rng = np.random.default_rng(3)
    points = rng.uniform(0.0, 480.0, (50, 2))
    line = np.column_stack([points[:, 0], 100.0 + 0.0 * points[:, 0]])
    # Too few points, no homography at all, and one that stretches too much.
    for first, second in ((points[:5], points[:5] + 3.0), (points, points[::-1]),
                          (points, 10.0 * points)):
        np.testing.assert_array_equal(window_homography(first, second), np.eye(3))
    # Points on a line leave it open; what is found must agree with them.
    H = window_homography(line, line)
    np.testing.assert_allclose(cv2.perspectiveTransform(line[:, None], H)[:, 0], line, atol=1e-6)
    np.testing.assert_allclose(window_homography(points, points + 3.0),
                               [[1, 0, 3], [0, 1, 3], [0, 0, 1]], atol=1e-6)


@pytest.mark.parametrize('values', [
    {'detector': 'surf'}, {'klt_window': 14}, {'feature_rows': (300, 100)},
    {'max_features': 0}, {'min_feature_distance': float('nan')},
])
def test_illegal_settings_are_refused(values):
    with pytest.raises(InputError, match=next(iter(values))):
        TrackingConfig(**values)


@pytest.mark.recordings
@pytest.mark.parametrize('name, rows, least', [
    ('realsense_rgb_rs', (0, 0), 210), ('xiaomi_cc9_rs', (0, 420), 170)])
def test_five_frames_of_a_recording_keep_most_corners(recordings, name, rows, least):
    # Names end in the frame's number or stamp.
    files = sorted((recordings / name / 'images').iterdir(),
                   key=lambda file: int(''.join(c for c in file.stem if c.isdigit())))
    kept, consistent = [], []
    for start in range(0, 40, 10):
        matches = track_sequence(
            [cv2.imread(str(file), cv2.IMREAD_GRAYSCALE) for file in files[start:start + 6]],
            feature_rows=rows).refined_matches()
        _, inliers = cv2.findFundamentalMat(matches.points1, matches.points2, cv2.USAC_MAGSAC,
                                            2.0, 0.999, 2000)
        kept.append(len(matches))
        consistent.append(inliers.mean())
    assert np.median(kept) >= least
    assert np.median(consistent) > 0.9
