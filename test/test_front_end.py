"""The drive loop: errors, what makes a keyframe, and parameters that change in mid-run."""

from collections import defaultdict
from collections.abc import Iterator
from dataclasses import fields, is_dataclass, replace
from functools import partial
from pathlib import Path
import sys
import threading
from typing import Any
from unittest.mock import MagicMock

import message_builders as build
import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from rs_relpose_lab.live.processes import wait_until
import rs_relpose_ros
from rs_relpose_ros.bags.reader import open_bag
from rs_relpose_ros.config.files import read_parameters
from rs_relpose_ros.config.settings import KeyframeConfig, Parameters
from rs_relpose_ros.errors import InputError
from rs_relpose_ros.estimator.result import Status
from rs_relpose_ros.geometry.camera import Intrinsics
from rs_relpose_ros.geometry.matches import Matches
from rs_relpose_ros.geometry.motion import FrameMotion
from rs_relpose_ros.geometry.timing import ImageClock, Sensor
from rs_relpose_ros.imu.buffer import ImuSample
from rs_relpose_ros.messages.incoming import Intake, Role, sensor_messages
from rs_relpose_ros.nodes.diagnostics import Statistics
from rs_relpose_ros.nodes.inputs import SensorInputs
from rs_relpose_ros.nodes.relpose_node import PairPublishers, RelposeNode
from rs_relpose_ros.nodes.sensor_node import Worker
from rs_relpose_ros.pipeline import pair as pairs
from rs_relpose_ros.pipeline import sequencer
from rs_relpose_ros.pipeline.pair import derotated, Frame, median_parallax, PairResult, positions
from rs_relpose_ros.pipeline.pipeline import FrameFailed, FrontEnd, Outcome
from rs_relpose_ros.pipeline.sequencer import MAILBOX_FRAMES, QueuedFrame, Refusal
from rs_relpose_ros.tracking.images import CompressedImage, RawImage

MS = 1_000_000
INTRINSICS = Intrinsics(
    width=64, height=48, fx=60.0, fy=60.0, cx=32.0, cy=24.0, image_width=64, image_height=48
)
PARAMETERS = Parameters.from_mapping(
    {'readout_time': 0.02, 'quat_cam_imu_xyzw': [0.0, 0.0, 0.0, 1.0]}
)


# -- errors ----------------------------------------------------------------------------------


def front_end_of(
    images: list[RawImage], parameters: Parameters = PARAMETERS, *, offline: bool = True
) -> FrontEnd:
    """Frames that are ready, with all of their IMU samples."""
    front_end = FrontEnd(parameters, offline=offline)
    for ms in range(0, images[-1].stamp_ns // MS + 150, 5):
        front_end.sequencer.add_imu(ImuSample(ms * MS, (0.0, 0.1, 0.0), (0.0, -9.81, 0.0)))
    for image in images:
        front_end.sequencer.add_frame(image, INTRINSICS)
    return front_end


def noise(
    ms: int, rng: np.random.Generator, brightest: int = 255, encoding: str = 'mono8'
) -> RawImage:
    kind = np.dtype('u1' if encoding == 'mono8' else '<u2')
    pixels = rng.integers(0, brightest + 1, (48, 64)).astype(kind)
    return RawImage(
        pixels.view(np.uint8).ravel(),
        encoding,
        64,
        48,
        64 * kind.itemsize,
        False,
        ms * MS,
        'camera',
    )


def front_end_with(
    error: Exception, monkeypatch: pytest.MonkeyPatch, *, offline: bool
) -> FrontEnd:
    """Three frames are ready, and the tracking of the second one fails."""
    rng = np.random.default_rng(0)
    front_end = front_end_of([noise(ms, rng) for ms in (50, 100, 150)], offline=offline)
    process = front_end._processor.process

    def failing(frame: Frame, *others: Any) -> PairResult | None:
        if frame.stamp_ns == 100 * MS:
            raise error
        return process(frame, *others)

    monkeypatch.setattr(front_end._processor, 'process', failing)
    return front_end


@pytest.mark.parametrize(
    ('encoding', 'brightest', 'dark'),
    [('mono8', 12, True), ('mono16', 25, True), ('mono8', 0, True), ('mono8', 255, False)],
)
def test_a_dark_image_is_reported_as_dark(encoding, brightest, dark):
    """Noise up to `brightest`: too few tracks; a black image is dark, and a bright one is not."""
    rng = np.random.default_rng(0)
    front_end = front_end_of(
        [noise(ms, rng, brightest, encoding) for ms in (50, 100)],
        PARAMETERS.updated({'max_keyframe_frames': 1}),
    )
    front_end.sequencer.close()
    [pair] = [outcome.result for outcome in iter(front_end.step, None) if outcome.result]
    assert pair.pose.status is Status.TOO_FEW_MATCHES
    assert pair.pose.reason.startswith('the image is dark: ') is dark
    assert 'usable matches' in pair.pose.reason


def test_pairs_with_too_few_matches_have_a_bounded_rate():
    """Nothing can be matched in 2 s of noise at 20 Hz: a pair each 0.5 s, not each frame."""
    rng = np.random.default_rng(3)
    front_end = front_end_of([noise(ms, rng, 3) for ms in range(50, 2100, 50)])
    frames = [front_end.step() for _ in range(41)]
    pairs = [frame.result for frame in frames if frame.result is not None]
    assert {pair.pose.status for pair in pairs} == {Status.TOO_FEW_MATCHES}
    assert pairs[0].stamp_ns == frames[1].stamp_ns  # the first at once
    assert np.diff([pair.stamp_ns for pair in pairs]).tolist() == [500 * MS] * 3


@pytest.mark.parametrize('offline', [False, True])
def test_an_error_of_the_package_fails_its_frame_alone(monkeypatch, offline):
    error = InputError('no such image')
    front_end = front_end_with(error, monkeypatch, offline=offline)
    first, failed, third = (front_end.step() for _ in range(3))
    assert isinstance(first, Frame) and isinstance(third, Frame)
    assert isinstance(failed, FrameFailed)
    assert (failed.stamp_ns, failed.error) == (100 * MS, error)
    assert front_end.step() is None


def test_a_programming_error_is_an_outcome_live_and_leaves_a_replay(monkeypatch):
    error = ZeroDivisionError()
    live = front_end_with(error, monkeypatch, offline=False)
    assert [type(live.step()) for _ in range(3)] == [Frame, FrameFailed, Frame]
    offline = front_end_with(error, monkeypatch, offline=True)
    assert isinstance(offline.step(), Frame)
    with pytest.raises(ZeroDivisionError):
        offline.step()


def test_a_refusal_is_an_outcome():
    front_end = FrontEnd(PARAMETERS, offline=True)
    front_end.sequencer.add_frame(noise(50, np.random.default_rng(0)), INTRINSICS)
    assert front_end.step() is None
    front_end.sequencer.close()
    assert isinstance(front_end.step(), sequencer.FrameRefused)


def test_a_busy_worker_costs_no_imu(monkeypatch):
    """Messages are taken in meanwhile; the oldest frames are dropped, and the latest wait."""
    held: list[Frame] = []
    started = threading.Event()
    released = threading.Event()

    def process(frame: Frame, *_: Any) -> None:
        held.append(frame)
        started.set()
        assert released.wait(100.0)

    front_end = FrontEnd(PARAMETERS)
    rng = np.random.default_rng(0)
    monkeypatch.setattr(front_end._processor, 'process', process)
    sequencer = front_end.sequencer
    worker = Worker(front_end, lambda: None, lambda _: None)
    worker.start()
    for k in range(40):
        for ms in range(30 * k - 5, 30 * k + 25, 5):
            sequencer.add_imu(ImuSample(ms * MS, (0.0, 0.1, 0.0), (0.0, -9.81, 0.0)))
        sequencer.add_frame(noise(30 * k, rng), INTRINSICS)
        assert started.wait(50.0)  # of the first frame
    counts = sequencer.counts()
    assert (counts.imu_gaps, counts.imu_samples, counts.frames_taken, counts.refused) == (
        0,
        240,
        1,
        {Refusal.OVERLOAD: 39 - MAILBOX_FRAMES},
    )
    released.set()
    wait_until(lambda: len(held) == 1 + MAILBOX_FRAMES, 'the frames that waited')
    assert worker.stop(10.0)
    # The gyro from the frame before to the first after all those that went has no hole.
    stamps = held[1].imu.since_previous.stamps_ns
    assert (stamps[0], stamps[-1]) == (0, held[1].stamp_ns)
    assert np.diff(stamps).max() <= 5 * MS


# -- pairs -----------------------------------------------------------------------------------

POLICY = KeyframeConfig(
    min_keyframe_parallax=10.0,
    max_keyframe_interval=0.5,
    max_keyframe_frames=12,
    min_tracked_fraction=0.3,
)


@pytest.mark.parametrize(
    'parallax, interval, frames, fraction, expected',
    [
        (9.9, 0.49, 11, 0.3, False),
        (10.0, 0.03, 1, 1.0, True),
        (10.0, 0.9, 30, 0.1, True),
        (0.0, 0.03, 1, 0.29, True),
        (0.0, 0.5, 3, 1.0, True),
        (0.0, 0.3, 12, 1.0, True),
        (np.nan, 0.1, 2, 0.0, True),
        (np.nan, 0.5, 2, 1.0, True),
        (np.nan, 0.1, 2, 1.0, False),
    ],
)
def test_a_keyframe_is_made_by_motion_or_time(parallax, interval, frames, fraction, expected):
    assert (
        pairs.is_keyframe(
            POLICY, parallax=parallax, interval=interval, frames=frames, tracked_fraction=fraction
        )
        is expected
    )


# -- parameters that may change while running ------------------------------------------------

# Of each a value that must have an effect on the pairs after it was set.
CHANGED: dict[str, Any] = {
    'threshold': 0.3,
    'pixel_sigma': 1.5,
    'gravity_sigma': 0.3,
    'gyro_sigma': 0.1,
    'confidence': 0.6,
    'max_iterations': 2,
    'time_limit': 1e-9,
    'min_inliers': 5000,
    'min_parallax': 400.0,
    'stamp_sigma': 0.01,
    'max_translation_sigma': 0.01,
    'min_keyframe_parallax': 2.0,
    'max_keyframe_interval': 0.01,
    'max_keyframe_frames': 2,
    'min_tracked_fraction': 1.0,
    'track_time_offset': True,
    'track_readout_time': True,
    'withhold_when_wrong': False,
}
# These have an effect with other parameters only.
BESIDE: dict[str, dict[str, Any]] = {
    # Many samples are needed: the hypotheses of a solver without priors, few of which fit.
    'confidence': {'solver': 'uniform_9pt', 'threshold': 0.2},
    # By default the gyro's rotation needs no samples.
    'max_iterations': {'solver': 'uniform_9pt'},
    'time_limit': {'solver': 'uniform_9pt'},
    # So far off that the consistency monitor reports it as wrong.
    'withhold_when_wrong': {'time_offset': 0.03},
}
# Has an effect on what the node publishes.
OF_THE_NODE = {'publish_debug_image'}
FRAMES = 60
CHANGE_AFTER = 1  # pair


@pytest.fixture(scope='module')
def parameters(bundled_bag) -> Parameters:
    """With a time offset that is to be found by tracking."""
    live = {
        name
        for name, _, declared in Parameters.declarations()
        if declared.live and not declared.restarts
    }
    assert live == CHANGED.keys() | OF_THE_NODE  # each is tried
    return read_parameters(bundled_bag.with_name('hand_held.yaml'), ['time_offset=0.003'])


@pytest.fixture(scope='module')
def recorded(bundled_bag) -> list[Any]:
    """Role and message of the first frames of the bundled bag."""
    messages: list[Any] = []
    images = 0
    with open_bag(bundled_bag) as bag:
        for role, message in sensor_messages(bag, bag.find_topics()):
            messages.append((role, message.message))
            images += role.value == 'image'
            if images > FRAMES:
                break
    return messages


def outcomes(recorded: list[Any], front_end: FrontEnd) -> Iterator[Outcome]:
    intake = Intake(front_end.sequencer)
    for role, message in recorded:
        intake.receive(role, message)
        while (outcome := front_end.step()) is not None:
            yield outcome


def values_of(pair: PairResult) -> tuple[Any, ...]:
    pose = pair.pose
    return (
        pair.reference_stamp_ns,
        pair.stamp_ns,
        pose.status,
        pose.diagnostics.iterations,
        pose.R.tobytes(),
        pose.t.tobytes(),
        pose.covariance.tobytes(),
        pose.inliers.tobytes(),
        pair.applied.time_offset,
    )


def pairs_of_run(
    recorded: list[Any], parameters: Parameters, changed: Parameters
) -> Iterator[tuple[Any, ...]]:
    """Values of each pair; `changed` is set after the pair `CHANGE_AFTER`."""
    front_end = FrontEnd(parameters, offline=True)
    pairs = 0
    for outcome in outcomes(recorded, front_end):
        assert isinstance(outcome, Frame)
        if outcome.result is not None:
            yield values_of(outcome.result)
            pairs += 1
            if pairs == CHANGE_AFTER:
                front_end.parameters = changed


@pytest.mark.parametrize('name', CHANGED)
def test_a_live_parameter_has_its_effect_from_the_next_frame_on(recorded, parameters, name):
    parameters = parameters.updated(BESIDE.get(name, {}))
    changed = parameters.updated({name: CHANGED[name]})
    both = zip(
        pairs_of_run(recorded, parameters, parameters),
        pairs_of_run(recorded, parameters, changed),
        strict=False,
    )
    for _ in range(CHANGE_AFTER):
        without, with_change = next(both)
        assert with_change == without
    assert any(with_change != without for without, with_change in both)


def test_publishing_of_debug_images_can_be_switched_while_running(recorded, parameters):
    front_end = FrontEnd(parameters, offline=True, keep_images=True)
    pair = next(
        o.result
        for o in outcomes(recorded, front_end)
        if isinstance(o, Frame) and o.result is not None
    )
    publishers: defaultdict[str, Any] = defaultdict(MagicMock)
    publishers['~/debug_image'].get_subscription_count.return_value = 1
    node = MagicMock()
    node.create_publisher.side_effect = lambda msgtype, topic, depth: publishers[topic]
    outputs = PairPublishers(node, parameters.pair)
    for wanted, pictures in ((True, 1), (False, 1), (True, 2)):
        config = parameters.updated({'publish_debug_image': wanted}).pair
        outputs.publish(pair, config, lambda: None)
        assert publishers['~/debug_image'].publish.call_count == pictures


IMAGE_MESSAGE = type(build.compressed(build.rosbags_types, b''))
CARRIERS = (IMAGE_MESSAGE, RawImage, CompressedImage, QueuedFrame, Frame, PairResult)


def walk_of_a_pair(recorded: list[Any], parameters: Parameters) -> dict[tuple[str, str], bool]:
    """Functions from an image's callback to its pair's publication that are given or return one.

    True: called from another module. In order, without properties.
    """
    folder = str(Path(rs_relpose_ros.__file__).parent)
    entered: list[Any] = []
    stack: list[list[Any]] = []

    def profile(frame: Any, event: str, argument: Any) -> None:
        code = frame.f_code
        if not code.co_filename.startswith(folder) or code.co_name.startswith('<'):
            return
        if event == 'call':
            names = code.co_varnames[: code.co_argcount + code.co_kwonlyargcount]
            own = getattr(type(frame.f_locals.get('self')), code.co_name, None)
            given = any(isinstance(frame.f_locals.get(name), CARRIERS) for name in names)
            module = code.co_filename[len(folder) + 1 :]
            crosses = not stack or stack[-1][0][0] != module
            stack.append(
                [(module, code.co_qualname), given and not isinstance(own, property), crosses]
            )
            entered.append(stack[-1])
        elif event == 'return' and stack:
            stack.pop()[1] |= isinstance(argument, CARRIERS)

    node = MagicMock()
    loop = FrontEnd(parameters, keep_images=True, clock=lambda: 0)
    node.create_subscription.return_value.handle.take_message.return_value = None
    inputs = SensorInputs(node, Intake(loop.sequencer, parameters), 'compressed', pytest.fail)
    relpose = MagicMock(
        spec=RelposeNode,
        _outputs=PairPublishers(node, parameters.pair),
        _settings=MagicMock(current=parameters),
        _statistics=Statistics(),
        _frame_statistics=MagicMock(),
        _log_health=MagicMock(),
        _stamps=None,
        _timings=None,
    )
    relpose._on_processed = partial(RelposeNode._on_processed, relpose)
    for role, message in recorded:
        if role is not Role.IMAGE:
            inputs._receive(role, message)
            continue
        entered.clear()
        sys.setprofile(profile)
        inputs._on_image(message)
        sys.setprofile(None)
        while True:
            sys.setprofile(profile)
            outcome = loop.step()
            if isinstance(outcome, Frame):
                RelposeNode._consume(relpose, outcome)
            sys.setprofile(None)
            if outcome is None:
                break
            if isinstance(outcome, Frame) and outcome.result is not None and outcome.result.pose:
                walk: dict[tuple[str, str], bool] = {}
                for name, carries, crosses in entered:
                    if name == ('nodes/diagnostics.py', 'Statistics.add_pair'):  # published
                        return walk
                    if carries:
                        walk[name] = crosses or walk.get(name, False)
    raise AssertionError('no pair with a pose')


def test_the_walk_of_one_image_is_short(recorded, parameters):
    """As in docs/architecture.md: the functions that carry it, and the steps between modules."""
    walk = walk_of_a_pair(recorded, parameters)
    print(
        *(f'{"" if crosses else "    "}{": ".join(name)}' for name, crosses in walk.items()),
        sep='\n',
    )
    assert next(iter(walk)) == ('nodes/inputs.py', 'SensorInputs._on_image')
    assert walk['pipeline/sequencer.py', 'Sequencer.take']
    assert walk['messages/outgoing.py', 'pair_parts']
    assert sum(walk.values()) <= 12
    assert len(walk) <= 20


# Names of the matches of a pair on their way: release 3 had 68, with 13 returns.
MOST_NAMES = 35
# Modules of functions of arrays. The sums of the residual maps are made after the publication.
OF_ARRAYS = ('geometry', 'core', 'calibration/residual_maps')


def holds(value: Any, count: int, depth: int = 3) -> bool:
    """Whether a value has something for each of so many matches, alone or in its fields."""
    if isinstance(value, np.ndarray):
        return count in value.shape[:2]
    if depth == 0 or isinstance(value, type):
        return False
    if is_dataclass(value):
        parts = [getattr(value, field.name, None) for field in fields(value)]
    elif isinstance(value, tuple):
        parts = list(value)
    else:
        return False
    return any(holds(part, count, depth - 1) for part in parts)


def way_of_the_matches(recorded: list[Any], parameters: Parameters) -> tuple[set[str], list[str]]:
    """Names of the matches of a pair, and the modules that get them, until they are messages.

    Names of arguments, variables and fields, and each change of module, in Python functions of
    the package but those of arrays, which are no stations.
    """
    folder = f'{Path(rs_relpose_ros.__file__).parent}/'
    names: set[str] = set()
    modules: list[str] = []
    count = 0

    def profile(frame: Any, event: str, value: Any) -> None:
        nonlocal count
        code = frame.f_code
        module = code.co_filename.removeprefix(folder)
        if module == code.co_filename or module.startswith(OF_ARRAYS):
            return
        if code.co_name == 'refined_matches' and event == 'return':
            names.clear()
            modules[:] = [module]
            count = len(value)
        elif count and not code.co_name.startswith('<') and event in ('call', 'return'):
            given = {k: v for k, v in frame.f_locals.items() if k not in ('self', 'cls')}
            if event == 'call':  # without the variables of an outer function
                arguments = code.co_varnames[: code.co_argcount + code.co_kwonlyargcount]
                given = {name: one for name, one in given.items() if name in arguments}
            holding = {name for name, one in given.items() if holds(one, count)}
            if event == 'call' and holding and modules[-1] != module:
                modules.append(module)
            names.update(holding if event == 'return' else ())
            names.update(
                field.name
                for one in given.values()
                if is_dataclass(one) and event == 'return'
                for field in fields(one)
                if holds(getattr(one, field.name, None), count)
            )

    front_end = FrontEnd(parameters, offline=True)
    intake = Intake(front_end.sequencer)
    for role, message in recorded:
        intake.receive(role, message)
        while True:
            count = 0
            sys.setprofile(profile)
            outcome = front_end.step()
            if isinstance(outcome, Frame) and outcome.result is not None and outcome.result.pose:
                build.pair_messages(outcome.result, build.rosbags_types)
                sys.setprofile(None)
                return names, modules
            sys.setprofile(None)
            if outcome is None:
                break
    raise AssertionError('no pair with a pose')


def test_the_matches_of_a_pair_have_few_names_and_rarely_return(recorded, parameters):
    """As in docs/architecture.md, "The walk of one image"."""
    names, modules = way_of_the_matches(recorded, parameters)
    returns = [module for k, module in enumerate(modules) if module in modules[:k]]
    print(len(names), *sorted(names))
    print(len(returns), *modules, sep='\n')
    assert {'matches', 'problem', 'pose', 'result'} <= names
    assert modules[0] == 'tracking/klt.py' and modules[-1] == 'messages/outgoing.py'
    assert len(returns) <= 8
    assert len(names) <= MOST_NAMES


# -- derotated rays and their parallax ------------------------------------------------------------

LENS_INTRINSICS = Intrinsics(
    width=640,
    height=480,
    fx=450.0,
    fy=450.0,
    cx=320.0,
    cy=240.0,
    distortion_model='plumb_bob',
    distortion=(-0.2, 0.05, 0.0, 0.0),
    image_width=640,
    image_height=480,
)
LENS_CAMERA = replace(LENS_INTRINSICS.global_shutter_camera(), readout_time=0.03)
LENS = Sensor(LENS_CAMERA, LENS_INTRINSICS, ImageClock(LENS_CAMERA))
MOTION = FrameMotion([0.4, -0.8, 0.3])


def matches_of(ids):
    """Of a set of points that depend on their ids alone."""
    ids = np.asarray(ids, dtype=np.uint32)
    points = np.random.default_rng(0).uniform([20.0, 20.0], [620.0, 460.0], (5000, 2))[ids % 5000]
    return Matches(ids, np.stack([points, points + 3.0]), np.ones(len(ids)))


# Ids wrap around: what is newer may be smaller.
@pytest.mark.parametrize('ids', [range(40), [2**32 - 2, 2**32 - 1, 0, 1, 2, 3, 700, 30]])
def test_rays_that_are_kept_are_the_same_as_recomputed(ids):
    every = derotated(matches_of(list(ids)), MOTION, MOTION, LENS)
    # The rays of the reference are taken from those that are known.
    marked = replace(every, rays=every.rays + 1.0)
    for wanted in (every.track_ids[[0, 2, 3, 6]], every.track_ids, every.track_ids[:0]):
        some = matches_of(wanted)
        kept = derotated(some, MOTION, MOTION, LENS, every)
        recomputed = derotated(some, MOTION, MOTION, LENS)
        for name in ('track_ids', 'points', 'rays', 'row_times'):
            np.testing.assert_array_equal(getattr(kept, name), getattr(recomputed, name))
        of_marked = derotated(some, MOTION, MOTION, LENS, marked)
        np.testing.assert_array_equal(of_marked.rays[0], recomputed.rays[0] + 1.0)
        np.testing.assert_array_equal(of_marked.rays[1], recomputed.rays[1])


def test_a_track_that_is_missing_or_out_of_order_is_no_subset():
    known = derotated(matches_of(range(9)), MOTION, MOTION, LENS)
    for wanted in ([3, 99], [99], [5, 3]):
        some = matches_of(wanted)
        assert len(positions(known.track_ids, some.track_ids)) < len(wanted)
        kept = derotated(some, MOTION, MOTION, LENS, known)
        recomputed = derotated(some, MOTION, MOTION, LENS)
        np.testing.assert_array_equal(kept.rays, recomputed.rays)


def test_a_derotated_ray_is_projected_to_its_pixel():
    points = np.random.default_rng(1).uniform([60.0, 60.0], [580.0, 420.0], (50, 2))
    rays, row_times = LENS.derotated(points, MOTION)
    # A first guess of the row times that is off by 1 ms moves a point by 0.42 px, at 424 px/s;
    # each improvement leaves the share 424 px/s * 62.5 us per row of that.
    observed = LENS.project(rays, row_times + 1e-3, MOTION)
    np.testing.assert_allclose(observed, points, atol=1.2 * 0.42 * 424 * 62.5e-6)


def test_median_parallax_is_of_the_known_rays():
    rng = np.random.default_rng(0)
    rays1, rays2 = rng.normal(size=(2, 41, 3))
    rays1 /= np.linalg.norm(rays1, axis=1, keepdims=True)
    rays2 /= np.linalg.norm(rays2, axis=1, keepdims=True)
    rays1[3] = rays2[7] = np.nan
    rotation = Rotation.from_rotvec([0.1, -0.2, 0.3]).as_matrix()
    every = np.linalg.norm(np.cross(rays1, rays2 @ rotation.T), axis=1)
    assert median_parallax(rays1, rays2, rotation) == pytest.approx(np.nanmedian(every), rel=1e-12)
    for unknown in (np.zeros((0, 3)), np.full((4, 3), np.nan)):
        assert median_parallax(unknown, unknown, np.eye(3)) == 0.0
