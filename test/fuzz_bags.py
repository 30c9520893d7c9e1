"""Mutated bag files into the reader and the replay: python test/fuzz_bags.py COUNT.

One process reads all of them; whatever is in a file, the outcome is a result or an error of the
package's own with one sentence. A crash of a library ends the process, a hang its timer.
"""

from __future__ import annotations

from collections import Counter
import faulthandler
import json
from pathlib import Path
import shutil
import signal
import sys
import tempfile
import time
from typing import Any

from fuzz_messages import memory_mb, mutated_bytes
import numpy as np
import test_bag_reader as bags

from rs_relpose_ros.bags.reader import open_bag
from rs_relpose_ros.bags.writer import BagWriter
from rs_relpose_ros.config.parameters import Parameters
from rs_relpose_ros.errors import RsRelposeError
from rs_relpose_ros.geometry.camera import RollingShutterCamera
from rs_relpose_ros.replay.run import read_truth, Replay

KINDS = (*bags.ROSBAG2_KINDS, *bags.ROS1_KINDS)
PARAMETERS = Parameters.from_mapping({
    'readout_time': 0.02, 'quat_cam_imu_xyzw': [0.0, 0.0, 0.0, 1.0]})
# No file of a few messages takes so long [s of CPU].
PATIENCE = 20


def sensor_messages(folder: Path) -> list[tuple[str, str, object, int]]:
    """A few frames of a camera with an IMU; topic, type, message and time [ns]."""
    rng = np.random.default_rng(0)
    camera = RollingShutterCamera(width=32, height=24, fx=30.0, fy=30.0, cx=15.5, cy=11.5,
                                  readout_time=0.02)
    writer = BagWriter(folder / 'never_opened')
    messages: list[tuple[str, str, object, int]] = []
    for t in range(0, 100_000_000, 10_000_000):
        stamp = bags.STAMP_NS + t
        messages.append(('/imu', bags.IMU, writer.imu(
            stamp, 'imu', tuple(rng.normal(size=3)), (0.0, 0.5, 9.8)), t))
        messages.append(('/ground_truth/pose', bags.POSE, writer.pose(
            stamp, 'world', (1e-9 * t, 2.0, 3.0), (0.0, 0.0, 0.0, 1.0)), t))
    for t in range(10_000_000, 80_000_000, 30_000_000):
        stamp = bags.STAMP_NS + t
        messages.append(('/camera/camera_info', bags.INFO, writer.camera_info(
            stamp, 'camera', camera), t))
        messages.append(('/camera/image_raw', bags.IMAGE, writer.image(
            stamp, 'camera', rng.integers(0, 256, (24, 32), dtype=np.uint8)), t + 1))
    return messages


def files_of(bag: Path) -> dict[Path, bytes]:
    """The bag's files with their content."""
    files = [bag] if bag.is_file() else sorted(bag.iterdir())
    return {file: file.read_bytes() for file in files}


def damage(files: dict[Path, bytes], rng: np.random.Generator) -> None:
    """Write the files anew, one of them damaged: mostly that with the messages."""
    paths = sorted(files, key=lambda path: path.suffix == '.yaml')
    chosen = paths[-1] if rng.random() < 0.15 else paths[0]
    for path, content in files.items():
        path.write_bytes(mutated_bytes(content, rng) if path == chosen else content)


def read(bag: Path) -> str:
    """The outcome of a replay of everything in a bag."""
    try:
        with open_bag(bag) as opened:
            topics = opened.find_topics()
            read_truth(opened, topics)
            for _ in opened.raw_messages(opened.topics):
                pass
            replay = Replay(opened, topics, PARAMETERS)
            for _ in replay.pairs():
                pass
            return 'read'
    except RsRelposeError as error:
        text = str(error)
        assert 0 < len(text) < 2000, text[:2000]
        assert '\n' not in text, text
        return 'refused'


def fuzz(count: int, seed: int, folder: Path) -> dict[str, Any]:
    """Figures of a run."""
    rng = np.random.default_rng(seed)
    bases = {kind: bags.write_kind(kind, folder, sensor_messages(folder)) for kind in KINDS}
    contents = {kind: files_of(bag) for kind, bag in bases.items()}
    for kind, bag in bases.items():
        assert read(bag) == 'read', kind
    outcomes: Counter[str] = Counter()
    slowest, before = 0.0, 0.0
    started = time.perf_counter()
    for number in range(count):
        if number == min(count // 2, 200):
            before = memory_mb()
        kind = KINDS[number % len(KINDS)]
        damage(contents[kind], rng)
        # What is at hand if the process dies.
        (folder / 'current').write_text(f'{seed} {number} {kind} {bases[kind]}')
        begun = time.perf_counter()
        signal.setitimer(signal.ITIMER_PROF, PATIENCE)
        outcomes[read(bases[kind])] += 1
        signal.setitimer(signal.ITIMER_PROF, 0)
        slowest = max(slowest, time.perf_counter() - begun)
    return {'bags': count, 'seed': seed, 'seconds': round(time.perf_counter() - started, 1),
            'slowest_ms': round(1e3 * slowest, 1),
            'memory_growth_mb': round(memory_mb() - before, 1), 'outcomes': dict(outcomes)}


def main() -> None:
    faulthandler.enable()
    # A hang shows where, and ends the process.
    faulthandler.register(signal.SIGPROF, chain=True)
    folder = Path(tempfile.mkdtemp(dir='/dev/shm' if Path('/dev/shm').is_dir() else None))
    try:
        print(json.dumps(fuzz(int(sys.argv[1]), int(sys.argv[2]) if len(sys.argv) > 2 else 0,
                              folder)))
        shutil.rmtree(folder)
    except BaseException:
        print(f'see {folder}/current for what was read', file=sys.stderr)
        raise


if __name__ == '__main__':
    main()
