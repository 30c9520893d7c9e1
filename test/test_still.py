"""Repeated images and static parts of images: compared with a rotation of the camera."""

from dataclasses import replace

import cv2
import numpy as np
import pytest

from rs_relpose_lab.field import defects
from rs_relpose_lab.field.recording import base_recording, write_recording
from rs_relpose_lab.simulation import SimulationConfig
from rs_relpose_lab.simulation.scene import make_texture
from rs_relpose_ros.bags.reader import open_bag
from rs_relpose_ros.calibration import findings_text
from rs_relpose_ros.calibration.findings import (
    Assessment,
    Code,
    Finding,
    FindingState,
    Why,
    worst_of,
)
from rs_relpose_ros.config.files import read_parameters
from rs_relpose_ros.config.settings import TrackingConfig
from rs_relpose_ros.offline.replay import replay_into
from rs_relpose_ros.pipeline.still_view import StillView
from rs_relpose_ros.tracking import still
from rs_relpose_ros.tracking.features import find_corners, make_tracker, within
from rs_relpose_ros.tracking.still import COLUMNS, ROWS, StillParts

WIDTH = 320
HEIGHT = 240
INTERVAL_NS = 33_000_000


def walk(count, static=None, seed=3, step=(5.0, 1.5), speed=0.0):
    """Images that move by about `step` px each, with noise, and their motions.

    The content of a part, `static`, moves by `speed` px an image.
    """
    rng = np.random.default_rng(seed)
    texture = make_texture(rng, (700, 1400)).astype(float)
    fixed = make_texture(rng, (HEIGHT, WIDTH)).astype(float)
    place = np.array([700.0, 300.0])
    for number in range(count):
        motion = np.array(step) * rng.normal(size=2)
        place = np.clip(place + motion, (20, 20), (1060, 440))
        matrix = np.array([[1.0, 0.0, place[0]], [0.0, 1.0, place[1]]])
        image = cv2.warpAffine(
            texture, matrix, (WIDTH, HEIGHT), flags=cv2.INTER_LINEAR | cv2.WARP_INVERSE_MAP
        )
        if static is not None:
            image = np.where(static, np.roll(fixed, round(speed * number), axis=1), image)
        yield place.copy(), np.clip(image + rng.normal(size=image.shape), 0, 255).astype(np.uint8)


def added(parts, number, image, motion):
    """The verdict on an image whose content moves by `motion` (2,) px against the last new one."""
    return parts.add(number * INTERVAL_NS, image, np.broadcast_to(motion, (ROWS, COLUMNS, 2)))


def test_images_of_a_moving_camera_are_new():
    parts = StillParts()
    before = None
    for number, (place, image) in enumerate(walk(120)):
        repeated = added(parts, number, image, np.zeros(2) if before is None else before - place)
        assert not repeated
        assert not parts.static().any()
        before = place


def test_repeated_images_are_found_whatever_their_bytes():
    parts = StillParts()
    before = None
    rng = np.random.default_rng(5)
    found = []
    for number, (place, image) in enumerate(walk(60, step=(9.0, 9.0))):
        motion = np.zeros(2) if before is None else before - place
        repeated = added(parts, 2 * number, image, motion)
        assert not repeated
        before = place
        again = np.clip(image + 1.0 * rng.normal(size=image.shape), 0, 255).astype(np.uint8)
        again = cv2.imdecode(cv2.imencode('.jpg', again)[1], cv2.IMREAD_GRAYSCALE)
        found.append(added(parts, 2 * number + 1, again, np.array([6.0, -4.0])))
    assert sum(found) >= 0.9 * len(found)


def test_a_camera_at_rest_repeats_nothing():
    """Without a rotation there is no evidence that the image had to change."""
    parts = StillParts()
    image = next(walk(1))[1]
    assert not any(added(parts, k, image, np.array([0.3, 0.2])) for k in range(50))


def test_repeated_images_are_found_where_the_camera_does_not_turn():
    """What repetitions look like is known from the seconds in which the camera turned."""
    parts = StillParts()
    before = None
    rng = np.random.default_rng(5)
    verdicts = []
    for number, (place, image) in enumerate(walk(60)):
        motion = np.zeros(2) if before is None else place - before
        rotation = -motion if number < 30 else np.zeros(2)  # from then on by translation alone
        added(parts, 3 * number, image, rotation)
        before = place
        noise = 0.8 * rng.normal(size=image.shape)
        copy = np.clip(image + noise, 0, 255).astype(np.uint8)
        turn = -np.array([4.0, 2.0]) if number < 30 else np.zeros(2)
        verdicts.append(added(parts, 3 * number + 1, copy, turn))
    assert np.mean(verdicts[:30]) > 0.8
    assert np.mean(verdicts[30:]) > 0.9


def test_a_camera_at_rest_after_repetitions_is_not_silent():
    parts = StillParts()
    rng = np.random.default_rng(6)
    images = list(walk(21))
    for number, (_, image) in enumerate(images):
        added(parts, 2 * number, image, (9.0, 4.0))
        copy = np.clip(image + rng.normal(size=image.shape), 0, 255).astype(np.uint8)
        added(parts, 2 * number + 1, copy, (9.0, 4.0))
    at_rest = images[-1][1]
    new = []
    for number in range(42, 102):
        noisy = np.clip(at_rest + rng.normal(size=at_rest.shape), 0, 255).astype(np.uint8)
        new.append(not added(parts, number, noisy, (0.0, 0.0)))
    assert 3 <= sum(new) <= 10  # twice a second


@pytest.mark.parametrize('motion', [1e7, 1e12, np.inf])
def test_a_motion_out_of_the_image_tells_nothing(motion):
    """A gyro in deg/s predicts motions of many widths: no verdict, and no endless reflection."""
    parts = StillParts()
    _, image = next(walk(1))
    added(parts, 0, image, np.zeros(2))
    assert not added(parts, 1, image, np.full(2, motion))


def test_a_wall_without_texture_repeats_nothing():
    parts = StillParts()
    image = np.full((HEIGHT, WIDTH), 90, dtype=np.uint8)
    assert not any(added(parts, k, image, np.array([8.0, 8.0])) for k in range(5))


def test_an_object_that_moves_slowly_is_no_static_part():
    part = np.zeros((HEIGHT, WIDTH), dtype=bool)
    part[:, WIDTH // 3 :] = True
    for speed in (0.0, 1.0):
        parts = StillParts()
        before = None
        steps = walk(150, part, step=(14.0, 9.0), speed=speed)
        for number, (place, image) in enumerate(steps):
            motion = np.zeros(2) if before is None else before - place
            added(parts, number, image, motion)
            before = place
        assert parts.static().any() == (speed == 0.0)


@pytest.mark.parametrize('side', ['left', 'bottom'])
def test_static_parts_are_found_and_masked(side):
    static = np.zeros((HEIGHT, WIDTH), dtype=bool)
    if side == 'left':
        static[:, : WIDTH // 4] = True
    else:
        static[-HEIGHT // 4 :] = True
    parts = StillParts()
    before = None
    for number, (place, image) in enumerate(walk(150, static)):
        repeated = added(parts, number, image, np.zeros(2) if before is None else before - place)
        assert not repeated
        before = place
    expected = static[:: HEIGHT // ROWS, :: WIDTH // COLUMNS]
    # Cells without texture are not named; nothing is named elsewhere.
    assert parts.static()[expected].mean() > 0.7
    assert not parts.static()[~expected].any()
    mask = still.free_of(parts.static(), WIDTH, HEIGHT)
    assert (mask[static] == 0).mean() > 0.95
    assert (mask > 0).mean() > 0.6
    corners = find_corners(image, np.empty((0, 2)), 400, TrackingConfig(), mask)
    assert len(corners) > 50
    assert within(corners, mask).all()
    tracker = make_tracker(TrackingConfig())
    tracker.start(image)
    tracker.allow(mask)
    assert within(tracker.track(image).points2, mask).all()


def test_static_parts_are_forgotten_when_they_move_again():
    static = np.zeros((HEIGHT, WIDTH), dtype=bool)
    static[:, :80] = True
    parts = StillParts()
    before = None
    for number, (place, image) in enumerate([*walk(150, static), *walk(160, seed=4)]):
        motion = np.zeros(2) if before is None or number == 150 else before - place
        added(parts, number, image, motion)
        before = place
    assert not parts.static().any()


@pytest.fixture(scope='module')
def recording(tmp_path_factory):
    """A walk of a small camera, in memory."""
    config = SimulationConfig(
        seed=78, duration=2.0, width=320, height=240, fx=225.0, plan='walk:2', pixel_noise=0.5
    )
    return base_recording(config, tmp_path_factory.mktemp('still') / 'walk')


def replayed(recording, folder):
    """Health and the pairs with a pose of a replay."""
    parameters = read_parameters(write_recording(recording, folder / 'bag'))
    pairs = []
    with open_bag(folder / 'bag') as bag:
        outcome = replay_into(
            folder / 'out',
            bag,
            bag.find_topics(),
            parameters,
            pictures=False,
            on_pair=lambda pair: pairs.append(pair) if pair.pose else None,
        )
    return outcome.health, pairs


def test_repeated_images_are_reported_and_not_used(recording, tmp_path):
    health, pairs = replayed(defects.repeated_images(recording, 3, 0.8), tmp_path)
    found = {finding.code: finding for finding in health.findings}
    measured = found[Code.REPEATED_IMAGES].evidence.measured
    assert 12 <= measured['repeated'] <= 20
    assert 'repeat the one before' in findings_text.line(found[Code.REPEATED_IMAGES])
    stamps = {shot.stamp_ns for shot in recording.shots[2::3]}
    assert pairs
    assert sum(pair.stamp_ns in stamps for pair in pairs) <= 1  # where the camera hardly turned


def test_the_copy_of_a_lost_image_is_not_used(recording, tmp_path):
    """A busy machine drops images, after which their copies look new."""
    repeated = defects.repeated_images(recording, 3, 0.8)
    copies = {shot.stamp_ns for shot in recording.shots[2::3]}
    # The original of every third copy is lost, once a copy is known.
    lost = {shot.stamp_ns for shot in recording.shots[7::9]}
    kept = tuple(shot for shot in repeated.shots if shot.stamp_ns not in lost)
    health, pairs = replayed(replace(repeated, shots=kept), tmp_path)
    assert Code.REPEATED_IMAGES in {finding.code for finding in health.findings}
    assert len(pairs) >= 4
    late = [pair for pair in pairs if pair.stamp_ns > recording.shots[6].stamp_ns]
    assert late
    assert not any(pair.stamp_ns in copies for pair in late)


def test_an_intact_walk_has_neither_finding(recording, tmp_path):
    health, pairs = replayed(recording, tmp_path)
    assert pairs
    codes = {finding.code for finding in health.findings}
    assert codes.isdisjoint({Code.REPEATED_IMAGES, Code.STATIC_REGION})


@pytest.mark.parametrize(
    ('share', 'code', 'candidates'),
    [
        (0.2, Code.STATIC_REGION, ()),
        (0.4, Code.STATIC_REGION, ()),
        (0.6, Code.INTERIOR, (Code.INTERIOR, Code.STATIC_REGION)),
        (0.9, Code.INTERIOR, (Code.INTERIOR, Code.STATIC_REGION)),
    ],
)
def test_most_of_the_view_that_does_not_move_is_an_interior(share, code, candidates):
    """Images do not tell a cabin from a cover of the lens: the cover is a candidate."""
    view = StillView()
    view.start(0, np.zeros((HEIGHT, WIDTH), dtype=np.uint8))
    view.static = np.arange(ROWS * COLUMNS).reshape(ROWS, COLUMNS) < share * ROWS * COLUMNS
    (finding,) = view.findings()
    assert (finding.code, finding.candidates) == (code, candidates)
    description, fix = findings_text.text_of(finding)
    assert f'{100 * share:.0f} % of the image' in description
    assert ('vehicle' in description) == (code is Code.INTERIOR)
    assert ('by hand' in fix) == (code is Code.INTERIOR)


def test_the_interior_takes_the_place_of_its_first_cells_in_a_run():
    first = Finding(Code.STATIC_REGION, FindingState.SUSPECT, Why.STILL)
    whole = Finding(Code.INTERIOR, FindingState.SUSPECT, Why.STILL)
    wrong = Finding(Code.TIME_OFFSET, FindingState.WRONG, Why.OFF)
    run = worst_of(Assessment((first, wrong)), Assessment((whole,)))
    assert {one.code for one in run.findings} == {Code.INTERIOR, Code.TIME_OFFSET}
    # The first of them replaces what the interior spoiled, as any static part does.
    assert worst_of(Assessment((wrong,)), Assessment((whole,))) == Assessment((whole,))


def test_the_first_finding_of_a_static_part_replaces_what_it_spoiled():
    wrong = Finding(Code.GYRO_UNIT, FindingState.WRONG, Why.GROSS)
    static = Finding(Code.STATIC_REGION, FindingState.SUSPECT, Why.STILL)
    assert worst_of(Assessment((wrong,)), Assessment((static,))) == Assessment((static,))
    later = worst_of(Assessment((static,)), Assessment((wrong, static)))
    assert {finding.code for finding in later.findings} == {Code.STATIC_REGION, Code.GYRO_UNIT}
