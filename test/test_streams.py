"""Faults of streams, each by its name: bursts, publishers, clocks, counters, repeated samples."""

from collections.abc import Callable, Iterator
from copy import deepcopy
from pathlib import Path
from typing import Any

import logged_walks as made
import numpy as np
import pytest

from rs_relpose_lab.simulation.bag import write_bag, write_parameters
from rs_relpose_lab.simulation.config import SimulationConfig
from rs_relpose_lab.simulation.simulation import simulate
from rs_relpose_ros.bags.reader import open_bag
from rs_relpose_ros.bags.writer import BagWriter
from rs_relpose_ros.cli import main
from rs_relpose_ros.messages.streams import (
    counter_unit,
    find_bursts,
    find_multiplied,
    SensorRate,
)

IMU, IMAGES = '/imu/data_raw', '/camera/image_raw/compressed'
SECOND = 10**9
# A message with the topic and the time [ns] of its reception.
Entry = tuple[str, str, Any, int]


@pytest.fixture(scope='module')
def walk(tmp_path_factory) -> tuple[Path, Path]:
    folder = tmp_path_factory.mktemp('walk')
    simulation = simulate(SimulationConfig(**made.OF_WALK))
    write_bag(simulation, folder / 'bag')
    write_parameters(simulation, folder / 'bag.yaml')
    return folder / 'bag', folder / 'bag.yaml'


def changed(bag: Path, out: Path, change: Callable[[int, Entry], Iterator[Entry]]) -> Path:
    """Copy a bag; `change` gets the number of each message of its topic, and yields others."""
    counts: dict[str, int] = {}
    with open_bag(bag) as opened, BagWriter(out) as writer:
        types = {topic.name: topic.msgtype for topic in opened.topics}
        entries = []
        for entry in opened.messages(opened.topics):
            topic, received, message = entry.topic, entry.bag_time_ns, entry.message
            number = counts[topic] = counts.get(topic, -1) + 1
            entries += list(change(number, (topic, types[topic], message, received)))
        for topic, msgtype, message, received in sorted(entries, key=lambda entry: entry[3]):
            writer.write(topic, msgtype, message, received)
    return out


def stamped(message: Any, stamp_ns: int) -> None:
    stamp = message.header.stamp
    object.__setattr__(stamp, 'sec', stamp_ns // SECOND)
    object.__setattr__(stamp, 'nanosec', stamp_ns % SECOND)


def stamp_of(message: Any) -> int:
    return message.header.stamp.sec * SECOND + message.header.stamp.nanosec


def run(capsys, command: str, bag: Path, parameters: Path, *options: str) -> tuple[int, str]:
    code = main.main([command, str(bag), '--params', str(parameters), *options])
    printed = capsys.readouterr()
    return code, ' '.join((printed.out + printed.err).split())


def both(capsys, walk, bag: Path) -> tuple[int, str, int, str]:
    checked = run(capsys, 'check', bag, walk[1])
    out = ('--no-pictures', '--out', str(bag.with_name('out')))
    return *checked, *run(capsys, 'replay', bag, walk[1], *out)


def in_bursts(number: int, entry: Entry) -> Iterator[Entry]:
    """Seven samples share one time, that of the last."""
    topic, msgtype, message, received = entry
    if topic == IMU:
        late = (6 - number % 7) * 8_000_000
        stamped(message, stamp_of(message) + late)
        received += late
    yield topic, msgtype, message, received


def test_bursts_are_named_and_withheld(walk, tmp_path, capsys):
    bag = changed(walk[0], tmp_path / 'bag', in_bursts)
    check, report, replay, error = both(capsys, walk, bag)
    assert (check, replay) == (1, 2)
    for text in (report, error):
        assert 'bursts of 7' in text and 'true rate is 125 Hz' in text
    assert 'deeper queue' not in report


def test_two_publishers_are_refused_with_both_names(walk, tmp_path, capsys):
    def change(number: int, entry: Entry) -> Iterator[Entry]:
        yield entry
        if entry[0] == IMU:
            other = deepcopy(entry[2])
            stamped(other, stamp_of(entry[2]) + 3_000_000)
            object.__setattr__(other.header, 'frame_id', 'lidar_imu')
            yield IMU, entry[1], other, entry[3] + 3_000_000

    bag = changed(walk[0], tmp_path / 'bag', change)
    check, report, replay, error = both(capsys, walk, bag)
    assert (check, replay) == (2, 2)
    for text in (report, error):
        assert "'imu_link'" in text and "'lidar_imu'" in text


def test_nanoseconds_of_32_bits_are_one_error(walk, tmp_path, capsys):
    def change(number: int, entry: Entry) -> Iterator[Entry]:
        if entry[0] == IMAGES:
            nanosec = stamp_of(entry[2]) % 2**32
            object.__setattr__(entry[2].header.stamp, 'nanosec', nanosec)
        yield entry

    bag = changed(walk[0], tmp_path / 'bag', change)
    check, report, replay, error = both(capsys, walk, bag)
    assert (check, replay) == (2, 2)
    for text in (report, error):
        assert 'above 999999999' in text and 'time_offset' not in text


@pytest.mark.parametrize('topic, words', [(IMU, 'IMU is stamped'), (IMAGES, 'images are stamped')])
def test_time_since_boot_is_named_without_an_offset_of_years(topic, words, walk, tmp_path, capsys):
    def change(number: int, entry: Entry) -> Iterator[Entry]:
        if entry[0] == topic:
            stamped(entry[2], stamp_of(entry[2]) - made.START_NS + 5000 * SECOND)
        yield entry

    bag = changed(walk[0], tmp_path / 'bag', change)
    check, report, replay, error = both(capsys, walk, bag)
    assert (check, replay) == (1, 2)
    for text in (report, error):
        assert f'the {words} with the time since boot' in text
    assert 'time_offset:' not in report and report.count('failure') == 2  # and in the last line


def test_clock_of_the_accelerometer_is_named(walk, tmp_path, capsys):
    absent = np.array([-1.0] + [0.0] * 8)

    def change(number: int, entry: Entry) -> Iterator[Entry]:
        topic, msgtype, message, received = entry
        if topic != IMU:
            yield entry
            return
        accel = deepcopy(message)
        stamped(accel, stamp_of(accel) - 3_500_000_000)
        object.__setattr__(message, 'linear_acceleration_covariance', absent)
        object.__setattr__(accel, 'angular_velocity_covariance', absent)
        yield '/imu/gyro', msgtype, message, received
        yield '/imu/accel', msgtype, accel, received

    bag = changed(walk[0], tmp_path / 'bag', change)
    check, report, replay, _ = both(capsys, walk, bag)
    assert (check, replay) == (0, 0)
    assert 'clock of the accelerometer (/imu/accel) is 3.5 s behind that of the gyro' in report
    out = tmp_path / 'path'
    assert main.main(['odometry', str(bag), '--params', str(walk[1]), '--out', str(out)]) == 2
    assert 'a path needs both sensors' in capsys.readouterr().err
    assert not out.exists()


def test_a_counter_of_32_bits_is_named(walk, tmp_path, capsys):
    wrap_ns = made.START_NS + SECOND

    def change(number: int, entry: Entry) -> Iterator[Entry]:
        if entry[0] != '/ground_truth/pose' and stamp_of(entry[2]) > wrap_ns:
            stamped(entry[2], stamp_of(entry[2]) - 2**32 * 1000)
        yield entry

    bag = changed(walk[0], tmp_path / 'bag', change)
    assert 'a 32-bit counter of microseconds overflowed' in run(capsys, 'check', bag, walk[1])[1]


def test_intact_streams_have_no_fault(walk, capsys):
    code, report = run(capsys, 'check', *walk)
    assert code == 0 and 'true rate' not in report and 'clock of the' not in report


# --- by stamps and values alone


def steps_of(rng, kind: str) -> np.ndarray:
    even = 1_700_000_000 * SECOND + 5_000_000 * np.arange(2000)
    if kind == 'jitter':
        even = np.sort(even + rng.exponential(6e6, 2000).astype(np.int64))
    elif kind == 'gaps':
        even = even[rng.random(2000) < 0.5]
    elif kind == 'twice':
        even = np.repeat(even, 2)
    elif kind == 'two sensors':
        even = np.sort(np.concatenate([even, even[0] + 15_873_016 * np.arange(600)]))
    return even


@pytest.mark.parametrize('kind', ['even', 'jitter', 'gaps', 'twice', 'two sensors'])
def test_other_stamps_are_no_bursts(kind):
    assert find_bursts(steps_of(np.random.default_rng(5), kind)) is None


@pytest.mark.parametrize('size', [8, 20, 100])
@pytest.mark.parametrize('apart_ns', [0, 100_000])
def test_bursts_by_their_stamps(size, apart_ns):
    number = np.arange(20 * size)
    arrival = (number // size + 1) * size * 2_500_000
    jitter = np.random.default_rng(1).integers(0, 2_000_000, 20)[number // size]
    bursts = find_bursts(arrival + jitter + apart_ns * (number % size))
    assert bursts is not None and bursts.size == size
    assert bursts.rate == pytest.approx(400.0, rel=0.1)


def test_units_of_counters():
    assert counter_unit(2**32 * 1e-6 - 0.03, 0.033) == 'microseconds'
    assert counter_unit(2**32 * 1e-9 - 0.004, 0.005) == 'nanoseconds'
    assert counter_unit(3.0, 0.033) == ''


def test_multiplied_values_have_their_factor():
    rng = np.random.default_rng(3)
    turning = np.sin(np.arange(500)[:, None] * 0.05 + np.arange(3)) + rng.normal(0, 2e-3, (500, 3))
    assert find_multiplied(turning) is None
    assert find_multiplied(np.round(turning[:60] * 0.01, 2)) is None  # coarse, nearly at rest
    held = np.repeat(turning, 4, axis=0)
    factor, how = find_multiplied(held)
    assert how == 'repeated' and factor == pytest.approx(4.0, rel=0.02)
    at = np.arange(0.0, 499.0, 0.25)
    lines = np.stack([np.interp(at, np.arange(500), column) for column in turning.T], axis=1)
    factor, how = find_multiplied(lines.astype(np.float32))
    assert how == 'interpolated' and factor == pytest.approx(4.0, rel=0.02)
    rate, changes = SensorRate(), 0
    for number, one in enumerate((*turning[:200].tolist(), *held[:800].tolist())):
        changes += rate.add(number * 5_000_000, tuple(one))
    assert rate.factor == 4.0 and changes == 1
    # The bends of a sine of 0.05 rad a sample, and of its noise.
    bend = 0.5 * 0.05**4 + 6 * 2e-3**2
    assert rate.between == pytest.approx(0.02 * bend / 144, rel=0.3)
