"""Faults of streams, each by its name: bursts, publishers, clocks, counters, repeated samples."""

from collections.abc import Callable, Iterator
from copy import deepcopy
import csv
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
from rs_relpose_ros.imu.buffer import ImuSample
from rs_relpose_ros.messages.burst_times import find_bursts, SampleTimes
from rs_relpose_ros.messages.streams import counter_unit, find_multiplied, SensorRate

IMU = '/imu/data_raw'
IMAGES = '/camera/image_raw/compressed'
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
            topic = entry.topic
            received = entry.bag_time_ns
            message = entry.message
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


def distances(folder: Path) -> np.ndarray:
    """Errors of the rotation and of the direction of translation, in sigmas of their largest."""
    with (folder / 'errors.csv').open(encoding='utf-8') as file:
        errors = {
            (row['reference_stamp_ns'], row['stamp_ns']): row for row in csv.DictReader(file)
        }
    with (folder / 'relative_poses.csv').open(encoding='utf-8') as file:
        poses = [row for row in csv.DictReader(file) if row['status'] == 'OK']
    out = []
    for pose in poses:
        error = errors[pose['reference_stamp_ns'], pose['stamp_ns']]
        sigmas = [
            np.degrees(np.linalg.norm([float(pose[f'sigma_{name}']) for name in names]))
            for names in (('rx', 'ry', 'rz'), ('t1', 't2'))
        ]
        out.append(
            np.array([float(error['rotation_error_deg']), float(error['translation_error_deg'])])
            / sigmas
        )
    return np.array(out)


def test_bursts_are_named_and_get_even_times(walk, tmp_path, capsys):
    bag = changed(walk[0], tmp_path / 'bag', in_bursts)
    check, report, replay, _ = both(capsys, walk, bag)
    assert (check, replay) == (0, 0)
    assert 'bursts of 7' in report and 'true rate is 125 Hz' in report
    assert 'deeper queue' not in report and 'with its own time' not in report
    found = distances(bag.with_name('out'))
    assert len(found) >= 3 and found.max() < 3.0


def test_bursts_without_a_rate_are_named_and_withheld(walk, tmp_path, capsys):
    starts = 56_000_000 * np.arange(1000)
    arrivals = np.sort(starts + np.random.default_rng(2).integers(0, 400_000_000, 1000))

    def unevenly(number: int, entry: Entry) -> Iterator[Entry]:
        for topic, msgtype, message, received in in_bursts(number, entry):
            burst = number // 7
            late = int(arrivals[burst] - starts[burst]) if topic == IMU else 0
            stamped(message, stamp_of(message) + late)
            yield topic, msgtype, message, received + late

    bag = changed(walk[0], tmp_path / 'bag', unevenly)
    check, report, replay, error = both(capsys, walk, bag)
    assert (check, replay) == (1, 2)
    for text in (report, error):
        assert 'too unevenly for even times' in text and 'time of the sensor' in text


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


# --- two defects at once


def wrapped(number: int, entry: Entry) -> Iterator[Entry]:
    if entry[0] != '/ground_truth/pose' and stamp_of(entry[2]) > made.START_NS + SECOND // 2:
        stamped(entry[2], stamp_of(entry[2]) - 2**32 * 1000)
    yield entry


def test_bursts_of_a_counter_that_overflows_are_both_named(walk, tmp_path, capsys):
    bag = changed(walk[0], tmp_path / 'bag', in_bursts)
    bag = changed(bag, tmp_path / 'wrapped', wrapped)
    check, report, replay, _ = both(capsys, walk, bag)
    assert (check, replay) == (0, 0)
    assert 'bursts of 7' in report and '32-bit counter of microseconds' in report


def test_two_publishers_with_repeated_images_are_one_error(walk, tmp_path, capsys):
    last: dict[str, Any] = {}

    def change(number: int, entry: Entry) -> Iterator[Entry]:
        topic, msgtype, message, received = entry
        if topic == IMAGES:
            data = last.get('data', message.data)
            last['data'] = message.data if number % 3 else data
            object.__setattr__(message, 'data', last['data'])
        yield entry
        if topic == IMU:
            other = deepcopy(message)
            object.__setattr__(other.header, 'frame_id', 'base_imu')
            yield topic, msgtype, other, received + 1

    check, report, replay, error = both(capsys, walk, changed(walk[0], tmp_path / 'bag', change))
    assert (check, replay) == (2, 2)
    for text in (report, error):
        assert "'imu_link' and 'base_imu'" in text


def test_a_conversion_topic_by_topic_without_metadata_gives_the_same_poses(walk, tmp_path, capsys):
    order = [IMAGES, '/camera/camera_info', IMU, '/ground_truth/pose']

    def change(number: int, entry: Entry) -> Iterator[Entry]:
        received = made.START_NS + 900 * SECOND * (order.index(entry[0]) + 1) + 1000 * number
        yield *entry[:3], received

    bag = changed(walk[0], tmp_path / 'bag', change)
    (bag / 'metadata.yaml').unlink()
    check, report, replay, _ = both(capsys, walk, bag)
    assert (check, replay) == (0, 0)
    assert 'by a conversion' in report and 'delays differ' not in report
    poses = bag.with_name('out') / 'relative_poses.csv'
    run(capsys, 'replay', *walk, '--no-pictures', '--out', str(tmp_path / 'ordered'))
    assert poses.read_bytes() == (tmp_path / 'ordered/relative_poses.csv').read_bytes()


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


# --- even times in place of those of bursts


def samples_at(stamps: np.ndarray) -> list[ImuSample]:
    return [ImuSample(int(stamp), (0.0, 0.0, 0.1), None) for stamp in stamps]


def timed(times: SampleTimes, stamps: np.ndarray) -> list[ImuSample]:
    return [one for sample in samples_at(stamps) for one in times.add(sample)]


@pytest.mark.parametrize('size', [8, 20, 100])
@pytest.mark.parametrize('apart_ns', [0, 100_000])
@pytest.mark.parametrize('rate', [100, 400])
def test_bursts_get_even_times(size, apart_ns, rate):
    number = np.arange(80 * size)
    step_ns = SECOND // rate
    true = made.START_NS + step_ns * number
    jitter = np.random.default_rng(1).exponential(2e6, 80).astype(np.int64)
    stamps = true[number // size * size + size - 1] + jitter[number // size]
    stamps = stamps + apart_ns * (number % size)
    bursts = find_bursts(stamps)
    assert bursts is not None and bursts.size == size
    assert bursts.rate == pytest.approx(rate, rel=0.1)
    times = SampleTimes()
    found = timed(times, stamps)
    # All but the last burst, whose samples pass as they come, have a time.
    assert len(found) == len(stamps) and not times.corrects and not times.is_uneven
    errors = np.array([one.stamp_ns for one in found]) - true
    assert np.abs(errors).max() < 8e6
    assert np.all(np.diff([one.stamp_ns for one in found]) > 0)
    assert np.abs(errors).max() * 1e-9 < 2.0 * found[0].doubt.common
    # The doubt covers a driver that stamps a burst with the time of its first sample.
    assert found[-1].doubt.common >= 0.49 * (size - 1) / rate


def test_a_lost_burst_starts_the_line_again():
    number = np.arange(800)
    true = made.START_NS + 5_000_000 * number
    stamps = true[number // 10 * 10 + 9]
    kept = number // 10 != 47
    found = timed(SampleTimes(), stamps[kept])
    assert {one.stamp_ns for one in found} <= set(true.tolist())
    assert len(found) == 790


def test_bursts_that_begin_later_correct_the_samples_before():
    even = made.START_NS + 5_000_000 * np.arange(200)
    number = np.arange(800)
    later = even[-1] + 5_000_000 * (number // 20 * 20 + 20)
    times = SampleTimes()
    assert len(timed(times, even)) == 200 and times.bursts is None
    found = timed(times, later)
    assert times.bursts is not None and times.corrects
    assert np.diff([one.stamp_ns for one in found[-100:]]).std() < 1e4


@pytest.mark.parametrize('kind', ['even', 'jitter', 'gaps', 'twice', 'two sensors'])
def test_samples_of_other_streams_pass_as_they_are(kind):
    stamps = steps_of(np.random.default_rng(5), kind)
    times = SampleTimes()
    found = timed(times, stamps)
    assert [one.stamp_ns for one in found] == stamps.tolist()
    assert not any(one.doubt.common for one in found)


def test_a_single_sample_passes_at_the_end():
    times = SampleTimes()
    assert not times.add(samples_at(np.array([7]))[0])
    assert [one.stamp_ns for one in times.rest()] == [7]


def test_units_of_counters():
    assert counter_unit(2**32 * 1e-6 - 0.03, 0.033) == 'microseconds'
    assert counter_unit(2**32 * 1e-9 - 0.004, 0.005) == 'nanoseconds'
    assert counter_unit(3.0, 0.033) == ''


def test_multiplied_values_have_their_factor():
    rng = np.random.default_rng(3)
    turning = np.sin(np.arange(500)[:, None] * 0.05 + np.arange(3)) + rng.normal(0, 2e-3, (500, 3))
    assert find_multiplied(turning) == (1.0, '')
    assert find_multiplied(np.round(turning[:60] * 0.01, 2)) == (1.0, '')  # coarse, nearly at rest
    held = np.repeat(turning, 4, axis=0)
    factor, how = find_multiplied(held)
    assert how == 'repeated' and factor == pytest.approx(4.0, rel=0.02)
    at = np.arange(0.0, 499.0, 0.25)
    lines = np.stack([np.interp(at, np.arange(500), column) for column in turning.T], axis=1)
    factor, how = find_multiplied(lines.astype(np.float32))
    assert how == 'interpolated' and factor == pytest.approx(4.0, rel=0.02)
    rate = SensorRate()
    changes = 0
    for number, one in enumerate((*turning[:200].tolist(), *held[:800].tolist())):
        changes += rate.add(number * 5_000_000, tuple(one))
    assert rate.factor == 4.0 and changes == 1
    # The bends of a sine of 0.05 rad a sample, and of its noise.
    bend = 0.5 * 0.05**4 + 6 * 2e-3**2
    assert rate.between == pytest.approx(0.02 * bend / 144, rel=0.3)
