"""Tracking under exact warps: Lucas-Kanade on patches, corners, descriptors, bad images, seeds."""

import cv2
import numpy as np
import pytest
from scipy.ndimage import map_coordinates

from rs_relpose_ros.config.settings import TRACKERS, TrackingConfig
from rs_relpose_ros.errors import InputError
from rs_relpose_ros.tracking import klt, windows
from rs_relpose_ros.tracking.features import make_tracker
from rs_relpose_ros.tracking.klt import follow
from rs_relpose_ros.tracking.windows import correlations, cut

MARGIN = 150
ONE = np.eye(3)


def texture(height, width, seed=0):
    """Smooth random texture of three scales, larger than the images by MARGIN on each side."""
    rng = np.random.default_rng(seed)
    shape = (height + 2 * MARGIN, width + 2 * MARGIN)
    total = np.zeros(shape)
    for sigma, weight in ((1.5, 1.0), (4.0, 2.0), (12.0, 3.0)):
        layer = cv2.GaussianBlur(rng.normal(size=shape), (0, 0), sigma)
        total += weight * layer / layer.std()
    return np.clip(128.0 + 45.0 * (total - total.mean()) / total.std(), 0, 255).astype(np.uint8)


class WarpedScene:
    """A plane of texture under homographies: image = view(H), point = H^-1 texture point."""

    def __init__(self, height=480, width=640, seed=0):
        self.shape = (height, width)
        self._texture = texture(height, width, seed)
        self._rng = np.random.default_rng(seed + 1)

    def similarity(self, degrees=0.0, scale=1.0, shift=(0.0, 0.0)):
        """Homography (image px -> plane px) of a turn about the image centre, zoom and shift."""
        height, width = self.shape
        H = np.vstack(
            [cv2.getRotationMatrix2D((width / 2, height / 2), -degrees, scale), [0.0, 0.0, 1.0]]
        )
        H[:2, 2] += shift
        return H

    def view(self, H=ONE, noise=0.0, gain=1.0, offset=0.0):
        """The image (H, W) of uint8 of the plane under H, with noise of the given sigma."""
        height, width = self.shape
        to_texture = np.array([[1.0, 0.0, MARGIN], [0.0, 1.0, MARGIN], [0.0, 0.0, 1.0]]) @ H
        image = cv2.warpPerspective(
            self._texture,
            to_texture,
            (width, height),
            flags=cv2.INTER_CUBIC | cv2.WARP_INVERSE_MAP,
        )
        image = gain * image.astype(np.float64) + offset
        image += noise * self._rng.normal(size=self.shape)
        return np.clip(np.round(image), 0, 255).astype(np.uint8)


def moved(points, H1, H2):
    """Where points (N, 2) of the view under H1 lie in the view under H2."""
    homogeneous = np.column_stack([points, np.ones(len(points))]) @ (np.linalg.inv(H2) @ H1).T
    return homogeneous[:, :2] / homogeneous[:, 2:]


def errors(matches, H1, H2):
    """Distances [px] of the matched points from the true ones."""
    return np.linalg.norm(moved(matches.points1, H1, H2) - matches.points2, axis=1)


@pytest.fixture(scope='module')
def scene():
    return WarpedScene()


# -- Lucas-Kanade and patches against OpenCV on whole images

CRITERIA = (cv2.TERM_CRITERIA_COUNT | cv2.TERM_CRITERIA_EPS, 15, 0.02)
# How points move [px].
SHIFT = np.array([1.7, -1.1])


@pytest.fixture(scope='module')
def images(scene):
    return scene.view(), scene.view(scene.similarity(0.0, 1.0, tuple(-SHIFT)))


@pytest.fixture(scope='module')
def points():
    return np.random.default_rng(0).uniform([30.0, 30.0], [609.0, 449.0], (60, 2))


def window_at(image, centres, radius):
    """Windows (N, 2 radius + 1, 2 radius + 1) around pixels (N, 2)."""
    return np.array(
        [
            image[y - radius : y + radius + 1, x - radius : x + radius + 1].astype(int)
            for x, y in centres
        ]
    )


# With a level more a point may be twice as far from its guess.
@pytest.mark.parametrize(('levels', 'off'), [(1, 1.5), (2, 5.0)])
def test_patches_and_whole_images_agree(images, points, levels, off, monkeypatch):
    guess = points + SHIFT + off * np.random.default_rng(1).uniform(-1.0, 1.0, points.shape)
    whole = klt.whole_images(*images, points, guess, klt.Search(15, levels, CRITERIA))
    called = []
    monkeypatch.setattr(windows, 'cut', lambda *a: called.append(1) or cut(*a))
    on_patches = follow(*images, points, guess, klt.Search(15, levels, CRITERIA))
    assert len(called) == 2 * levels
    right = np.linalg.norm(whole.points - points - SHIFT, axis=1) < 0.3
    assert np.mean(right) > 0.85
    assert np.mean(on_patches.found[right]) > 0.97
    both = right & on_patches.found
    np.testing.assert_allclose(on_patches.points[both], whole.points[both], atol=0.03)
    np.testing.assert_allclose(on_patches.strength[both], whole.strength[both], rtol=1e-3)


def test_many_points_are_followed_in_the_image_itself(images, monkeypatch):
    """Patches of all of them would be larger than the image."""
    monkeypatch.setattr(windows, 'cut', None)
    points = np.random.default_rng(2).uniform([30.0, 30.0], [609.0, 449.0], (400, 2))
    flow = follow(*images, points, points + SHIFT, klt.Search(15, 1, CRITERIA))
    assert np.mean(np.linalg.norm(flow.points - points - SHIFT, axis=1) < 0.3) > 0.95


def test_what_lies_beyond_a_patch_or_the_image_is_lost(images, points):
    far = follow(*images, points, points + SHIFT + 9.0, klt.Search(15, 1, CRITERIA))
    assert (np.linalg.norm(far.points - points - SHIFT - 9.0, axis=1)[far.found] < 6.0).all()
    assert np.mean(far.found) < 0.9
    outside = np.array([[-40.0, 100.0], [1e9, 1e9], [630.0, 5000.0]])
    assert not follow(
        *images, np.full((3, 2), 200.0), outside, klt.Search(15, 2, CRITERIA)
    ).found.any()
    assert (
        len(
            follow(*images, np.empty((0, 2)), np.empty((0, 2)), klt.Search(15, 1, CRITERIA)).points
        )
        == 0
    )


def test_warped_patches_are_those_of_the_warped_image(images, points):
    H = np.array([[1.02, 0.05, -3.0], [-0.04, 0.98, 6.0], [2e-5, -1e-5, 1.0]])
    image = images[0]
    radius = 11
    height, width = image.shape
    warped = cv2.warpPerspective(
        image,
        H,
        (width, height),
        flags=cv2.INTER_LINEAR | cv2.WARP_INVERSE_MAP,
        borderMode=cv2.BORDER_REPLICATE,
    )
    origins = cv2.perspectiveTransform(points[:, None], H)[:, 0]
    jacobians = klt.window_jacobians(points, origins)
    step = 1e-4
    for axis in range(2):
        moved = points + step * np.eye(2)[axis]
        np.testing.assert_allclose(
            jacobians[:, :, axis],
            (cv2.perspectiveTransform(moved[:, None], H)[:, 0] - origins) / step,
            atol=1e-5,
        )
    patches = windows.cut_warped(image, origins, jacobians, radius, points)
    expected = cut(warped, points, radius)
    np.testing.assert_array_equal(patches.shifts, expected.shifts)
    centres = np.rint(points + patches.shifts).astype(int)
    difference = window_at(patches.image, centres, radius) - window_at(
        expected.image, centres, radius
    )
    assert np.percentile(np.abs(difference), 99) <= 3 and np.median(np.abs(difference)) <= 1


# -- corners


def hand_held(scene, k):
    """Homography of frame k: turns by 1.2 deg, zooms by 1 %, and shifts in each frame."""
    H = scene.similarity(1.2 * k, 1.0 + 0.01 * k, (1.7 * k, -2.3 * k))
    return H @ np.array([[1.0, 0.0, 0.0], [0.0, 1.0, 0.0], [2e-6 * k, -3e-6 * k, 1.0]])


def started(image, **settings):
    tracker = make_tracker(TrackingConfig(**settings))
    tracker.start(image)
    return tracker


def track_sequence(images, **settings):
    tracker = started(images[0], **settings)
    for image in images[1:]:
        tracker.track(image)
    return tracker


# Of each view turn [deg], zoom, shift [px] and brightness; matches, and largest errors [px] of the
# median and of 95 %.
@pytest.mark.parametrize(
    ('views', 'noise', 'least', 'median', 'most'),
    [
        ([(4.0, 1.03, (6.3, -4.8))], 0.0, 250, 0.05, 0.15),
        ([(0.0,)] * 3, 0.0, 290, 1e-3, 1e-3),
        # The window's exposure changes.
        ([(1.0, 1.0, (3.4, 1.7), 0.7, 25.0)], 3.0, 230, 0.1, 1.0),
        # Turned windows are compared upright.
        ([(5.0 * k, 1.0 + 0.03 * k) for k in range(1, 6)], 0.0, 150, 0.1, 1.0),
        # A jerk after steady motion: less of the pyramid is used where guesses were good.
        ([(0.0, 1.0, (x, 0.0)) for x in (1.0, 2.0, 3.0, 4.0, 22.0, 23.0)], 0.0, 240, 0.1, 1.0),
    ],
    ids=['warp', 'frozen image', 'exposure', 'turned windows', 'jerk'],
)
def test_matches_of_warped_images_are_accurate(scene, views, noise, least, median, most):
    H = [scene.similarity(*view[:3]) for view in views]
    images = [
        scene.view(noise=noise),
        *(scene.view(warp, noise, *view[3:]) for warp, view in zip(H, views, strict=True)),
    ]
    matches = track_sequence(images).refined_matches()
    error = errors(matches, ONE, H[-1])
    assert len(error) > least
    assert np.median(error) < median
    assert np.percentile(error, 95) < most
    if len(views) == 5:  # the same windows, not turned, hardly look alike
        plain = correlations(images[0], images[5], matches.points1, matches.points2, 15)
        assert np.median(plain) < np.median(matches.quality) - 0.1


def test_the_reference_corrects_the_drift(scene):
    images = [scene.view(hand_held(scene, k), noise=2.0) for k in range(9)]
    tracker = track_sequence(images[:8])
    followed = tracker.track(images[8])
    before = followed.points2.copy()
    refined = tracker.refined_matches()
    tracker.track(images[7])
    # Matches given out do not change later.
    np.testing.assert_array_equal(followed.points2, before)
    H1 = hand_held(scene, 0)
    H2 = hand_held(scene, 8)
    assert len(refined) > 0.85 * 300
    assert np.median(errors(refined, H1, H2)) < 0.1
    assert np.median(errors(refined, H1, H2)) < 0.5 * np.median(errors(followed, H1, H2))


@pytest.mark.parametrize('levels', [1, 4])
def test_prediction_bridges_60_px(scene, levels):
    H2 = scene.similarity(2.0, 1.0, (60.0, -20.0))
    tracker = started(scene.view(), klt_levels=levels)
    # Two pixels off, and unknown for a tenth of the points.
    expected = moved(tracker.points, ONE, H2) + 1.4
    expected[::10] = np.nan
    matches = tracker.track(scene.view(H2), expected)
    assert len(matches) > 180
    assert np.median(errors(matches, ONE, H2)) < 0.15
    if levels == 1:  # not without a prediction
        tracker = track_sequence([scene.view(), scene.view(H2)], klt_levels=1)
        assert np.sum(errors(tracker.refined_matches(), ONE, H2) < 1.0) < 20


def test_motion_continues_in_proportion_to_the_time_between_images(scene):
    """Frames that a busy machine drops leave gaps."""
    flow = np.array([5.0, -2.0])
    views = [scene.similarity(0.0, 1.0, tuple(-k * flow)) for k in (0, 1, 13)]
    found = []
    for gap in (12.0, 1.0):
        # Without a pyramid nothing is found far from its guess.
        tracker = started(scene.view(views[0]), klt_levels=1)
        # The prediction knows 80 % of the motion.
        tracker.track(scene.view(views[1]), tracker.points + 0.8 * flow, 1.0)
        tracker.track(scene.view(views[2]), tracker.points + 12.0 * 0.8 * flow, gap)
        found.append(np.count_nonzero(errors(tracker.refined_matches(), views[0], views[2]) < 0.5))
    assert found[0] > 200
    assert found[1] < 0.7 * found[0]


def test_a_wrong_prediction_is_overcome_or_drops_the_track(scene):
    H2 = scene.similarity(1.0, 1.0, (4.0, 3.0))
    tracker = started(scene.view())
    tracker.track(scene.view(H2), moved(tracker.points, ONE, H2) + np.array([18.0, -11.0]))
    error = errors(tracker.refined_matches(), ONE, H2)
    assert len(error) > 150
    assert np.mean(error < 0.5) > 0.97


@pytest.mark.parametrize(('detector', 'least'), [('klt', 200), ('sift', 50), ('orb', 50)])
def test_ids_are_unique_and_persist_over_pairs(scene, detector, least):
    tracker = started(scene.view(), detector=detector)
    pairs = []
    for k in range(1, 7):
        tracker.track(scene.view(hand_held(scene, k)))
        if k % 3 == 0:
            pairs.append(tracker.refined_matches())
            tracker.promote()
    first, second = pairs
    for pair in pairs:
        assert pair.track_ids.dtype == np.uint32
        assert len(np.unique(pair.track_ids)) == len(pair)
    common, in_first, in_second = np.intersect1d(
        first.track_ids, second.track_ids, return_indices=True
    )
    assert len(common) > least
    # The same track: the second point of one pair is the first point of the next.
    np.testing.assert_array_equal(first.points2[in_first], second.points1[in_second])
    new = np.setdiff1d(second.track_ids, first.track_ids)
    assert len(new) > 0 and (detector != 'klt' or new.min() > 299)


def test_promotion_fills_up_and_reset_never_uses_an_id_again(scene):
    images = [scene.view(), scene.view(scene.similarity(0.0, 1.0, (120.0, 0.0)))]
    tracker = started(images[0])
    tracker.track(images[1], tracker.points - (120.0, 0.0))
    assert 0.6 < tracker.tracked_fraction < 0.9
    tracker.promote()
    assert tracker.tracked_fraction == 1.0
    before = tracker.track(images[1])
    assert len(before) >= 285
    assert np.sum(before.points1[:, 0] > 520) > 30
    tracker.reset()
    assert tracker.tracked_fraction == 0.0
    tracker.start(images[0])
    assert tracker.track(images[0]).track_ids.min() > before.track_ids.max()


def test_corners_are_spread_and_keep_their_distance(scene):
    image = scene.view()
    # A half with contrast four times that of the other one must not take all corners.
    image[:, 320:] = 128 + (image[:, 320:].astype(int) - 128) // 4
    points = started(
        image, max_features=200, min_feature_distance=12.0, feature_quality=0.5
    ).points
    assert len(points) > 190
    assert 0.35 < np.mean(points[:, 0] < 320) < 0.65
    apart = np.linalg.norm(points[:, None] - points[None], axis=2) + 1e9 * np.eye(len(points))
    assert apart.min() >= 12.0 - 1e-9
    cells, _, _ = np.histogram2d(
        points[:, 1], points[:, 0], bins=(4, 5), range=((0, 480), (0, 640))
    )
    assert cells.min() >= 3


@pytest.mark.parametrize('detector', ['klt', 'orb'])
def test_feature_rows_bound_both_points(scene, detector):
    tracker = started(scene.view(), detector=detector, feature_rows=(100, 300))
    matches = tracker.track(scene.view(scene.similarity(0.0, 1.0, (0.0, 20.0))))
    rows = np.concatenate([matches.points1[:, 1], matches.points2[:, 1]])
    assert len(matches) > 60
    assert rows.min() >= 100 and rows.max() <= 300


@pytest.mark.parametrize(('detector', 'most'), [('klt', 15), ('sift', 30), ('orb', 30)])
def test_images_that_share_nothing_have_few_matches(scene, detector, most):
    """And, for corners, images of next to no texture."""
    tracker = started(scene.view(), detector=detector, max_descriptors=600)
    if detector != 'klt':
        tracker.track(scene.view(scene.similarity(3.0)))
        assert tracker.tracked_fraction == 1.0
    tracker.track(WarpedScene(seed=7).view())
    assert len(tracker.refined_matches()) < most
    assert tracker.tracked_fraction < 0.1
    rng = np.random.default_rng(5)
    grey = [
        np.clip(np.round(120 + 2.0 * rng.normal(size=(480, 640))), 0, 255).astype(np.uint8)
        for _ in range(2)
    ]
    assert detector != 'klt' or len(track_sequence(grey).refined_matches()) < 10


@pytest.mark.parametrize(
    ('detector', 'value'), [('klt', 0), ('klt', 255), ('sift', 0), ('orb', 0)]
)
def test_blank_frames_lose_all_tracks_and_good_ones_bring_new(scene, detector, value):
    good = scene.view()
    blank = np.full((480, 640), value, dtype=np.uint8)
    tracker = started(good, detector=detector)
    assert len(tracker.track(blank)) == 0
    assert tracker.tracked_fraction == 0.0
    assert len(tracker.refined_matches()) == 0
    tracker.promote()
    assert len(tracker.track(good)) == 0
    tracker.promote()
    assert len(tracker.track(good)) > 280


@pytest.mark.parametrize('detector', TRACKERS)
@pytest.mark.parametrize('shape', [(1, 1), (8, 8), (17, 400), (40, 33), (64, 48)])
def test_tiny_images_do_no_harm(detector, shape):
    image = np.random.default_rng(0).integers(0, 256, shape, dtype=np.uint8)
    tracker = started(image, detector=detector)
    matches = tracker.track(image)
    assert np.isfinite(matches.points2).all() and len(matches) <= 300
    tracker.refined_matches()
    tracker.promote()
    tracker.track(image)


@pytest.mark.parametrize('detector', ['klt', 'orb'])
def test_what_is_no_image_of_the_stream_is_refused(scene, detector):
    image = scene.view()
    tracker = make_tracker(TrackingConfig(detector=detector))
    with pytest.raises(InputError, match='start'):
        tracker.track(image)
    with pytest.raises(InputError, match='start'):
        tracker.promote()
    tracker.start(image)
    for bad, message in (
        (image[:, :600], '640x480 to 600x480'),
        (image.astype(np.float32), 'uint8'),
        (image[:0], 'not empty'),
    ):
        for call in (tracker.track, tracker.start):
            with pytest.raises(InputError, match=message):
                call(bad)
    # The stream continues where it was.
    assert len(tracker.track(image)) > 100
    tracker.reset()
    tracker.start(image[:, :600])


def test_quality_ranks_matches_by_their_errors(scene):
    """Under noise the better half by quality has the smaller errors, and all are small."""
    halves = []
    for k in range(4):
        H2 = scene.similarity(1.0, 1.0, (3.4, 1.7 + 0.1 * k))
        matches = track_sequence(
            [scene.view(noise=12.0), scene.view(H2, noise=12.0)], min_correlation=0.3
        ).refined_matches()
        assert (matches.quality >= 0.0).all() and (matches.quality <= 1.0).all()
        error = errors(matches, ONE, H2)[np.argsort(-matches.quality)]
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
        for name in ('points2', 'track_ids', 'quality'):
            np.testing.assert_array_equal(getattr(other, name), getattr(found[0], name))


@pytest.mark.parametrize('side', [5, 15, 17, 31])
def test_correlation_equals_that_of_numpy(scene, side):
    images = scene.view(), scene.view(scene.similarity(1.0, 1.0, (0.4, 0.3)))
    rng = np.random.default_rng(5)
    # Over the whole image, its border included.
    points1 = rng.uniform([0.0, 0.0], [639.0, 479.0], (200, 2))
    points2 = np.clip(points1 + rng.normal(size=(200, 2)), 0.0, [639.0, 479.0])
    steps = np.arange(side) - side // 2
    grid = np.stack(np.meshgrid(steps, steps, indexing='ij'), axis=-1)
    for row, point1, point2 in zip(
        correlations(*images, points1, points2, side), points1, points2, strict=True
    ):
        windows = [
            map_coordinates(
                image.astype(float), (grid + point[::-1]).reshape(-1, 2).T, order=1, mode='nearest'
            )
            for image, point in zip(images, (point1, point2), strict=True)
        ]
        if min(window.std() for window in windows) > 0.1:
            assert row == pytest.approx(np.corrcoef(*windows)[0, 1], abs=1e-4)
    flat = np.full_like(images[0], 7)
    assert not correlations(images[0], flat, points1, points2, side).any()


def test_homography_of_windows_is_the_identity_where_there_is_none():
    rng = np.random.default_rng(3)
    points = rng.uniform(0.0, 480.0, (50, 2))
    line = np.column_stack([points[:, 0], 100.0 + 0.0 * points[:, 0]])
    # Too few points, no homography at all, and one that stretches too much.
    for first, second in (
        (points[:5], points[:5] + 3.0),
        (points, points[::-1]),
        (points, 10.0 * points),
    ):
        np.testing.assert_array_equal(klt.window_homography(first, second), ONE)
    # Points on a line leave it open; what is found must agree with them.
    H = klt.window_homography(line, line)
    np.testing.assert_allclose(cv2.perspectiveTransform(line[:, None], H)[:, 0], line, atol=1e-6)
    np.testing.assert_allclose(
        klt.window_homography(points, points + 3.0), [[1, 0, 3], [0, 1, 3], [0, 0, 1]], atol=1e-6
    )


@pytest.mark.parametrize('values', [{'klt_window': 14}, {'feature_rows': (300, 100)}])
def test_illegal_settings_are_refused(values):
    with pytest.raises(InputError, match=next(iter(values))):
        TrackingConfig(**values)


# -- SIFT and ORB over wide baselines


@pytest.mark.parametrize('detector, exact', [('sift', 0.5), ('orb', 1.5)])
def test_descriptors_match_over_a_wide_baseline(scene, detector, exact):
    """Which corners cannot be followed over."""
    H2 = scene.similarity(40.0, 1.3, (70.0, -30.0))
    images = scene.view(noise=2.0), scene.view(H2, noise=2.0, gain=0.8, offset=10.0)
    matches = track_sequence(images, detector=detector, max_descriptors=600).refined_matches()
    error = errors(matches, ONE, H2)
    assert len(matches) > 60
    assert np.mean(error < 5.0) > 0.9
    assert np.median(error) < exact
    assert (matches.quality > 0.0).all() and (matches.quality <= 1.0).all()
    for values in (matches.track_ids, matches.points1, matches.points2):
        assert len(np.unique(values, axis=0)) == len(matches)
    assert np.sum(errors(track_sequence(images).refined_matches(), ONE, H2) < 3.0) < 20


def test_mutual_nearest_neighbours_and_ratio_agree_with_the_brute_force_matcher(scene):
    images = [
        scene.view(noise=2.0),
        scene.view(scene.similarity(20.0, 1.1, (20.0, 5.0)), noise=2.0),
    ]
    matches = track_sequence(
        images, detector='sift', match_ratio=0.7, max_descriptors=600
    ).refined_matches()
    sift = cv2.SIFT.create(nfeatures=600)
    # One descriptor per place, as the tracker keeps them.
    (k1, d1), (k2, d2) = (once(*sift.detectAndCompute(image, None)) for image in images)
    back = {m.queryIdx: m.trainIdx for m in cv2.BFMatcher().match(d2, d1)}
    expected = {
        (k1[a.queryIdx].pt, k2[a.trainIdx].pt)
        for a, b in cv2.BFMatcher().knnMatch(d1, d2, k=2)
        if a.distance < 0.7 * b.distance and back[a.trainIdx] == a.queryIdx
    }
    found = {
        (tuple(p), tuple(q))
        for p, q in zip(matches.points1.tolist(), matches.points2.tolist(), strict=True)
    }
    assert len(expected) > 50
    assert found == expected


def once(keypoints, descriptors):
    _, first = np.unique([k.pt for k in keypoints], axis=0, return_index=True)
    first = np.sort(first)
    return [keypoints[k] for k in first], descriptors[first]
