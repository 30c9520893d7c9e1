"""Mutated messages into conversion, IMU buffer and sequencer: python test/fuzz_messages.py COUNT.

What a message says may be anything; what comes out may only be a result, or an error of the
package's own with one sentence. The seed and the number of a message give it again.
"""

from __future__ import annotations

from collections import Counter
import copy
import json
import resource
import sys
import time
from typing import Any

import cv2
import message_builders as build
import numpy as np

from rs_relpose_ros.config.parameters import Parameters
from rs_relpose_ros.errors import RsRelposeError
from rs_relpose_ros.front_end.sequencer import FrameRefused, ReadyFrame, Sequencer, WAITING_FRAMES
from rs_relpose_ros.images.encoded import ENCODINGS
from rs_relpose_ros.messages.intake import Intake
from rs_relpose_ros.messages.sensor_feed import Role

START_NS = 1_700_000_000 * 10**9
WIDTH, HEIGHT = 32, 24
# One after the other as a camera with an IMU sends them.
IMU_PER_IMAGE = 6
INTEGERS = (0, 1, -1, 2, 3, 7, 0xff, 0x7fff, 0xffff, 2**31 - 1, -2**31, 2**32 - 1,
            16384, 16385)   # no field has more than 32 bits
FLOATS = (0.0, -0.0, 1.0, -1.0, 1e-320, 1e308, -1e308, float('nan'), float('inf'), float('-inf'))
STRINGS = ('', '\0', 'mono8', 'MONO8', 'bgr8', 'mono16', 'plumb_bob', 'fisheye', 'x' * 100_000,
           'äöü\u202e', '%s%n{0}', '../../etc/passwd')


class Fuzzer:
    """Feeds a node's intake, one message in two of them damaged."""

    def __init__(self, seed: int) -> None:
        self.rng = np.random.default_rng(seed)
        self.now_ns = 0
        parameters = Parameters.from_mapping({
            'readout_time': 0.02, 'quat_cam_imu_xyzw': [0.0, 0.0, 0.0, 1.0]})
        self.sequencer = Sequencer(parameters, clock=lambda: self.now_ns)
        self.intake = Intake(self.sequencer, parameters.imu.stuck_gyro_time)
        self.outcomes: Counter[str] = Counter()
        self.slowest = 0.0

    def run(self, count: int) -> None:
        for number in range(count):
            self.now_ns += 5_000_000
            role, message = self.message(number)
            if self.rng.random() < 0.5:
                message = self.mutated(message)
            if message is None:
                self.outcomes['cannot be deserialised'] += 1
                continue
            started = time.perf_counter()
            try:
                self.intake.receive(role, message)
                self.outcomes['taken'] += 1
            except RsRelposeError as error:
                self.outcomes['refused'] += 1
                self.check_text(str(error))
            self.drain()
            self.slowest = max(self.slowest, time.perf_counter() - started)

    def drain(self) -> None:
        while (taken := self.sequencer.take()) is not None:
            if isinstance(taken, FrameRefused):
                self.outcomes[f'frame {taken.cause.value}'] += 1
                self.check_text(taken.reason)
            else:
                assert isinstance(taken, ReadyFrame)
                self.outcomes['frame ready'] += 1
                assert np.isfinite(taken.imu.motion.angular_velocity).all()
                assert taken.frame.image.dtype == np.uint8
        assert len(self.sequencer._waiting) <= WAITING_FRAMES

    def check_text(self, text: str) -> None:
        """One sentence that a log can bear, whatever the message says."""
        assert 0 < len(text) < 1000, text[:1000]
        assert '\n' not in text, text

    # -- messages ----------------------------------------------------------------------------

    def message(self, number: int) -> tuple[Role, Any]:
        rng, types = self.rng, build.rosbags_types
        stamp_ns = START_NS + number * 5_000_000
        kind = number % (IMU_PER_IMAGE + 2)
        if kind == 0:
            return Role.CAMERA_INFO, build.camera_info(
                types, width=WIDTH, height=HEIGHT, stamp_ns=stamp_ns,
                k=(30.0, 0.0, 15.5, 0.0, 30.0, 11.5, 0.0, 0.0, 1.0))
        if kind == 1:
            pixels = rng.integers(0, 256, (HEIGHT, WIDTH), dtype=np.uint8)
            if rng.random() < 0.5:
                extension = '.jpg' if rng.random() < 0.7 else '.png'
                return Role.IMAGE, build.compressed(
                    types, cv2.imencode(extension, pixels)[1].tobytes(), stamp_ns)
            # Enough bytes for any encoding.
            encoding = 'mono8' if rng.random() < 0.5 else str(rng.choice(ENCODINGS))
            return Role.IMAGE, build.image(
                types, WIDTH, HEIGHT, encoding, rng.bytes(4 * WIDTH * HEIGHT), step=4 * WIDTH,
                stamp_ns=stamp_ns)
        role = Role.ACCEL if rng.random() < 0.1 else Role.IMU
        gyro, force = rng.normal(size=3), rng.normal(size=3)
        return role, build.imu(types, stamp_ns, tuple(gyro.tolist()), tuple(force.tolist()))

    # -- damage ------------------------------------------------------------------------------

    def mutated(self, message: Any) -> Any:
        if self.rng.random() < 0.5:
            return self.with_other_bytes(message)
        message = copy.deepcopy(message)
        for _ in range(int(self.rng.integers(1, 4))):
            self.change_field(message)
        return message

    def with_other_bytes(self, message: Any) -> Any:
        """As it comes from a wire or file; None where it cannot be deserialised."""
        name = message.__msgtype__
        data = mutated_bytes(bytes(build.TYPESTORE.serialize_cdr(message, name)), self.rng)
        try:
            return build.TYPESTORE.deserialize_cdr(data, name)
        except Exception:  # noqa: BLE001 - the bag reader's part, which `fuzz_bags` looks at
            return None

    def change_field(self, message: Any) -> None:
        """Give a field somewhere in the message a value that its type allows."""
        rng = self.rng
        names = [name for name in vars(message) if name != '__msgtype__']
        name = names[int(rng.integers(len(names)))]
        value = getattr(message, name)
        if hasattr(value, '__msgtype__'):
            self.change_field(value)
        elif isinstance(value, bool):
            setattr(message, name, not value)
        elif isinstance(value, int):
            setattr(message, name, int(rng.choice(INTEGERS)))
        elif isinstance(value, float):
            setattr(message, name, float(rng.choice(FLOATS)))
        elif isinstance(value, str):
            setattr(message, name, str(rng.choice(STRINGS)))
        else:
            fixed = name in ('k', 'r', 'p') or name.endswith('covariance')
            setattr(message, name, self.other_array(value, fixed))

    def other_array(self, value: np.ndarray, fixed: bool) -> np.ndarray:
        """Other values, and another length where the type does not fix it."""
        rng = self.rng
        way = 0 if fixed else int(rng.integers(4))
        if way == 0 and len(value):
            value = value.copy()
            place = int(rng.integers(len(value)))
            if value.dtype == np.uint8:
                value[place:place + 8] = rng.integers(0, 256)
            else:
                value[place] = float(rng.choice(FLOATS))
            return value
        if way == 1:
            return value[:int(rng.integers(len(value) + 1))]
        if way == 2:
            return np.concatenate([value, value])
        return np.zeros(int(rng.choice([0, 1, 9, 65, 1000])), dtype=value.dtype)


def mutated_bytes(data: bytes, rng: np.random.Generator) -> bytes:
    """`data` with a few places flipped, overwritten, cut out or put in."""
    out = bytearray(data)
    for _ in range(int(rng.integers(1, 5))):
        at = int(rng.integers(len(out) + 1))
        way = int(rng.integers(6))
        if way == 0 and at < len(out):
            out[at] ^= 1 << int(rng.integers(8))
        elif way == 1:
            out[at:at + int(rng.integers(1, 9))] = rng.bytes(int(rng.integers(1, 9)))
        elif way == 2:
            size = int(rng.choice([4, 8]))
            number = int(rng.choice(INTEGERS)) & (2**(8 * size) - 1)
            out[at:at + size] = number.to_bytes(size, 'little')
        elif way == 3:
            del out[at:at + int(rng.integers(1, 64))]
        elif way == 4:
            source = int(rng.integers(len(out) + 1))
            out[at:at] = out[source:source + int(rng.integers(1, 64))]
        elif rng.random() < 0.3:
            del out[at:]
    return bytes(out)


def memory_mb() -> float:
    """Most memory that the process has had."""
    return resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024


def fuzz(count: int, seed: int) -> dict[str, Any]:
    """Figures of a run."""
    fuzzer = Fuzzer(seed)
    fuzzer.run(min(count, 1000))
    before = memory_mb()
    started = time.perf_counter()
    fuzzer.run(count - min(count, 1000))
    return {
        'messages': count, 'seed': seed, 'seconds': round(time.perf_counter() - started, 1),
        'slowest_ms': round(1e3 * fuzzer.slowest, 1),
        'memory_growth_mb': round(memory_mb() - before, 1),
        'outcomes': dict(fuzzer.outcomes.most_common())}


if __name__ == '__main__':
    print(json.dumps(fuzz(int(sys.argv[1]), int(sys.argv[2]) if len(sys.argv) > 2 else 0)))
