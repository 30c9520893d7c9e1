"""Damaged messages, bags and recordings: a result or an error of the package in one line.

No traceback, no crash, no hang, no unbounded memory. A short share here, the full counts by
`make test-all`.
"""

from collections import Counter
from collections.abc import Callable
import faulthandler
from pathlib import Path
import shutil
from typing import Any

import bag_kinds as bags
import cv2
from hypothesis import given, HealthCheck, settings
from hypothesis import strategies as st
import message_builders as build
from message_builders import damaged, WHOLE, with_other_fields
import numpy as np
import pytest
from recorded_files import make_posecam, make_realsense, make_tables
from test_convert_formats import CALIBRATIONS
import yaml

from rs_relpose_lab.datasets import read_realsense
from rs_relpose_ros.bags.convert.android import read_posecam
from rs_relpose_ros.bags.convert.phone import read_tables
from rs_relpose_ros.bags.convert.recording import write_bag
from rs_relpose_ros.bags.reader import open_bag
from rs_relpose_ros.config.files import read_calibration, read_parameters
from rs_relpose_ros.config.settings import Parameters
from rs_relpose_ros.errors import RsRelposeError
from rs_relpose_ros.geometry.camera import RollingShutterCamera
from rs_relpose_ros.messages.incoming import Intake, Role
from rs_relpose_ros.offline.replay import read_truth, Replay
from rs_relpose_ros.pipeline.pair import Frame
from rs_relpose_ros.pipeline.sequencer import FrameRefused, Sequencer, WAITING_FRAMES
from rs_relpose_ros.tracking.images import ENCODINGS

PARAMETERS = Parameters.from_mapping(
    {'readout_time': 0.02, 'quat_cam_imu_xyzw': [0.0, 0.0, 0.0, 1.0]}
)
WIDTH = 32
HEIGHT = 24
CAMERA = RollingShutterCamera(
    width=WIDTH, height=HEIGHT, fx=30.0, fy=30.0, cx=15.5, cy=11.5, readout_time=0.02
)
# No input of these sizes takes so long [s].
PATIENCE = 100
MOST_MEMORY_MB = 100.0

numbers = st.integers(0, WHOLE - 1)
edits = st.lists(st.tuples(numbers, numbers, numbers), min_size=1, max_size=4)


def share_and_all(share: int, full: int, seconds: int) -> pytest.MarkDecorator:
    return pytest.mark.parametrize(
        'count',
        [share, pytest.param(full, marks=[pytest.mark.long, pytest.mark.timeout(seconds)])],
    )


def outcomes_of(attempt: Callable[..., Any], count: int, *strategies: Any) -> Counter[str]:
    """Outcomes of many attempts, each in bounded memory; a hang, even in C, ends the process."""
    outcomes: Counter[str] = Counter()

    @settings(max_examples=count, suppress_health_check=list(HealthCheck))
    @given(st.tuples(*strategies))
    def check(drawn: tuple[Any, ...]) -> None:
        # Sets the peak to the present size (proc(5)), which has the examples that are kept.
        Path('/proc/self/clear_refs').write_text('5')
        before = peak_memory_mb()
        faulthandler.dump_traceback_later(PATIENCE, exit=True)
        try:
            outcomes.update(attempt(*drawn))
        finally:
            faulthandler.cancel_dump_traceback_later()
        assert peak_memory_mb() - before < MOST_MEMORY_MB

    check()
    print(outcomes)
    return outcomes


def peak_memory_mb() -> float:
    status = Path('/proc/self/status').read_text()
    return int(status.split('VmHWM:')[1].split()[0]) / 1024


def check_text(error: object) -> None:
    """One line that a log can hold, independently of the input."""
    text = str(error)
    assert 0 < len(text) < 2000, text[:2000]
    assert '\n' not in text, text


# --- messages

START_NS = 1_700_000_000 * 10**9
INTERVAL_NS = 5_000_000
IMU_PER_IMAGE = 6
# What a message is damaged by: nothing, its bytes, or its fields.
damages = st.one_of(
    st.none(), st.tuples(st.just(damaged), edits), st.tuples(st.just(with_other_fields), edits)
)


def message_of(number: int, rng: np.random.Generator) -> tuple[Role, Any]:
    """Messages one after the other, as a camera with an IMU sends them."""
    types = build.rosbags_types
    stamp_ns = START_NS + number * INTERVAL_NS
    kind = number % (IMU_PER_IMAGE + 2)
    if kind == 0:
        return Role.CAMERA_INFO, build.camera_info(
            types,
            width=WIDTH,
            height=HEIGHT,
            stamp_ns=stamp_ns,
            k=tuple(CAMERA.camera_matrix.ravel()),
        )
    if kind == 1:
        pixels = rng.integers(0, 256, (HEIGHT, WIDTH), dtype=np.uint8)
        if rng.random() < 0.5:
            extension = '.jpg' if rng.random() < 0.7 else '.png'
            return Role.IMAGE, build.compressed(
                types, cv2.imencode(extension, pixels)[1].tobytes(), stamp_ns
            )
        # Enough bytes for any encoding.
        encoding = 'mono8' if rng.random() < 0.5 else str(rng.choice(ENCODINGS))
        return Role.IMAGE, build.image(
            types,
            WIDTH,
            HEIGHT,
            encoding,
            rng.bytes(4 * WIDTH * HEIGHT),
            step=4 * WIDTH,
            stamp_ns=stamp_ns,
        )
    role = Role.ACCEL if rng.random() < 0.1 else Role.IMU
    gyro, force = rng.normal(size=(2, 3)).tolist()
    return role, build.imu(types, stamp_ns, tuple(gyro), tuple(force))


def with_damage(message: Any, damage: Any) -> Any:
    """None if it can no longer be deserialised, which is up to rclpy or the bag reader."""
    if damage is None:
        return message
    way, changes = damage
    if way is with_other_fields:
        return way(message, changes)
    name = message.__msgtype__
    try:
        return build.TYPESTORE.deserialize_cdr(
            way(bytes(build.TYPESTORE.serialize_cdr(message, name)), changes), name
        )
    except Exception:  # noqa: BLE001
        return None


def receive(seed: int, plan: list[Any]) -> Counter[str]:
    """Outcomes of as many messages as there are damages in the plan."""
    rng = np.random.default_rng(seed)
    now_ns = 0
    outcomes = Counter[str]()
    stream = [message_of(number, rng) for number in range(len(plan))]
    sequencer = Sequencer(PARAMETERS, clock=lambda: now_ns)
    intake = Intake(sequencer, PARAMETERS)
    for (role, whole), damage in zip(stream, plan, strict=True):
        message = with_damage(whole, damage)
        if message is None:
            continue
        now_ns += INTERVAL_NS
        error = intake.receive(role, message)
        outcomes['used' if error is None else 'refused'] += 1
        if error is not None:
            check_text(error)
        while (taken := sequencer.take()) is not None:
            if isinstance(taken, FrameRefused):
                check_text(taken.reason)
            else:
                assert isinstance(taken, Frame)
                outcomes['frame ready'] += 1
                assert np.isfinite(taken.imu.motion.angular_velocity).all()
                assert taken.image.dtype == np.uint8
        assert len(sequencer._queue) <= WAITING_FRAMES
    return outcomes


@share_and_all(50, 1250, 1300)
def test_damaged_messages_are_refused_and_good_ones_get_through(count):
    outcomes = outcomes_of(
        receive, count, st.integers(0, 2**32 - 1), st.lists(damages, min_size=80, max_size=80)
    )
    total = 80 * count
    # Good ones between the bad ones still get through.
    assert outcomes['used'] > 0.5 * total
    assert outcomes['refused'] > 0.03 * total
    assert outcomes['frame ready'] > 0.01 * total


# --- bags


def sensor_messages() -> list[bags.Entry]:
    """A few frames of a camera with an IMU."""
    rng = np.random.default_rng(0)
    messages = []
    for t in range(0, 100_000_000, 10_000_000):
        messages += [bags.imu(t, tuple(rng.normal(size=3))), bags.pose(t, (1e-9 * t, 2.0, 3.0))]
    for t in range(10_000_000, 80_000_000, 30_000_000):
        pixels = rng.integers(0, 256, (HEIGHT, WIDTH), dtype=np.uint8)
        messages += [bags.info(t, CAMERA), bags.image(t + 1, pixels)]
    return messages


def read(bag: Path) -> str:
    """The outcome of a replay of everything in a bag."""
    try:
        with open_bag(bag) as opened:
            topics = opened.find_topics()
            read_truth(opened, topics)
            for _ in opened.raw_messages(opened.topics):
                pass
            for _ in Replay(opened, topics, PARAMETERS).pairs():
                pass
            return 'read'
    except RsRelposeError as error:
        check_text(error)
        return 'refused'


@pytest.mark.timeout(600)  # the kernels may not be compiled yet
@share_and_all(100, 10_000, 3700)
def test_damaged_bags_are_read_or_refused(tmp_path, count):
    messages = sensor_messages()
    originals = {kind: bags.write_kind(kind, tmp_path, messages) for kind in bags.KINDS}
    contents = {
        kind: {
            file: file.read_bytes() for file in ([bag] if bag.is_file() else sorted(bag.iterdir()))
        }
        for kind, bag in originals.items()
    }
    for kind, bag in originals.items():
        assert read(bag) == 'read', kind

    def attempt(kind: str, which: int, changes: list[Any]) -> list[str]:
        bag = originals[kind]
        # Mostly the file with the messages.
        chosen = bags.storage_file(bag) if which else sorted(contents[kind])[0]
        for path, content in contents[kind].items():
            path.write_bytes(damaged(content, changes) if path == chosen else content)
        return [read(bag)]

    outcomes = outcomes_of(attempt, count, st.sampled_from(bags.KINDS), st.integers(0, 6), edits)
    # Most damage is severe, but not all of it.
    assert 0.02 * count < outcomes['read'] < 0.6 * count


# --- recordings


@pytest.mark.parametrize(
    'make, reader',
    [(make_tables, read_tables), (make_posecam, read_posecam), (make_realsense, read_realsense)],
)
@share_and_all(30, 1000, 1300)
def test_damaged_recordings(tmp_path, count, make, reader):
    folder = make(tmp_path / 'in')
    contents = {file: file.read_bytes() for file in sorted(folder.rglob('*')) if file.is_file()}

    def attempt(chosen: Path, changes: list[Any]) -> list[str]:
        chosen.write_bytes(damaged(contents[chosen], changes))
        try:
            write_bag(reader(folder), tmp_path / 'bag')
            return ['read']
        except RsRelposeError as error:
            check_text(error)
            return ['refused']
        finally:
            chosen.write_bytes(contents[chosen])
            shutil.rmtree(tmp_path / 'bag', ignore_errors=True)

    outcomes = outcomes_of(attempt, count, st.sampled_from(list(contents)), edits)
    assert outcomes['read'] and outcomes['refused']


# --- parameter files and calibrations of other tools

NAMES = (
    *('/**', 'ros__parameters', 'readout_time', 'time_offset', 'quat_cam_imu_xyzw', 'data'),
    *('cam0', 'T_cam_imu', 'T_imu_cam', 'intrinsics', 'distortion_coeffs', 'distortion_model'),
    *('resolution', 'timeshift_cam_imu', 'imu0', 'gyroscope_noise_density', 'T_BS', 'rows'),
    *('cols', 'image_width', 'Camera1.fx', 'IMU.T_b_c1', 'camera_model', 'camera_matrix'),
)
scalars = st.one_of(
    st.none(),
    st.booleans(),
    st.integers(-(2**70), 2**70),
    st.floats(),
    st.text(max_size=8),
    st.sampled_from(
        ('pinhole', 'radtan', 'plumb_bob', 'nan', '.inf', '1e999', '!!python/name:os')
    ),
)
documents = st.recursive(
    scalars,
    lambda inner: st.one_of(
        st.lists(inner, max_size=4),
        st.lists(st.floats(-2.0, 2.0), min_size=4, max_size=16),
        st.dictionaries(st.sampled_from(NAMES), inner, max_size=6),
    ),
    max_leaves=30,
)
KNOWN_FILES = (
    *(text for text, _ in CALIBRATIONS.values()),
    '/**:\n  ros__parameters:\n    readout_time: 0.03\n    time_offset: -0.01\n',
)


@pytest.mark.timeout(600)
@share_and_all(150, 10_000, 1300)
def test_parameter_files_and_calibrations(tmp_path, count):
    path = tmp_path / 'file.yaml'

    def attempt(which: int, changes: list[Any], document: Any) -> list[str]:
        if which < len(KNOWN_FILES):
            path.write_bytes(damaged(KNOWN_FILES[which].encode(), changes))
        else:
            path.write_text(yaml.safe_dump(document, allow_unicode=True))
        outcomes = []
        for reader in (read_parameters, read_calibration):
            try:
                reader(path)
                outcomes.append('read')
            except RsRelposeError as error:
                check_text(error)
                outcomes.append('refused')
        return outcomes

    for text in KNOWN_FILES:
        path.write_text(text)
        read_parameters(path)
    outcomes = outcomes_of(attempt, count, st.integers(0, 2 * len(KNOWN_FILES)), edits, documents)
    assert outcomes['read'] and outcomes['refused']
