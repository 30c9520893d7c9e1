"""Feeds a bag to the pipeline of the live node: the same sequencer, conversion and estimator."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass
import logging
from pathlib import Path
import time
from typing import Any

import numpy as np

from rs_relpose_ros.bags.reader import Bag, BagMessage
from rs_relpose_ros.bags.topics import SensorTopics
from rs_relpose_ros.config.parameters import Parameters
from rs_relpose_ros.errors import InputError, MissingInputError, RsRelposeError
from rs_relpose_ros.estimator.warm_up import warm_up
from rs_relpose_ros.front_end.front_end import FrameFailed, FrontEnd
from rs_relpose_ros.front_end.pair import PairResult
from rs_relpose_ros.front_end.sequencer import FrameRefused
from rs_relpose_ros.geometry.intrinsics import Intrinsics
from rs_relpose_ros.messages.causes import CauseCounts
from rs_relpose_ros.messages.incoming import stamp_ns, TruePose
from rs_relpose_ros.messages.intake import Intake
from rs_relpose_ros.messages.sensor_feed import Role, SensorFeed
from rs_relpose_ros.replay.truth import TrueTrajectory

_logger = logging.getLogger(__name__)


@dataclass(frozen=True, slots=True, eq=False)
class ReplayedPair:
    """A pair, and the bag time of the message that closed it [ns]."""

    result: PairResult
    bag_time_ns: int


@dataclass(slots=True)
class ReplayCounts:
    """What came besides what the sequencer counts, and how long it took [s]."""

    images: int = 0
    images_skipped: int = 0   # not among the chosen stamps
    invalid_messages: int = 0
    failed_frames: int = 0
    pairs: int = 0
    seconds: float = 0.0   # wall time of the whole, without compilation
    processing_seconds: float = 0.0   # of it, in tracking and estimation
    first_ns: int = 0   # bag time of the first message
    last_ns: int = 0


class Replay:
    """One run over an open bag; iterate over `pairs`, then read `counts` and `reasons`.

    With `stamps` only these frames are handed over, as those that a live node processed.
    `keep_images`: whether pairs carry their images. `on_image` is called after each image of the
    bag, for a progress bar.
    """

    def __init__(self, bag: Bag, topics: SensorTopics, parameters: Parameters, *,
                 stamps: frozenset[int] | None = None, keep_images: bool = False,
                 on_image: Callable[[], object] = lambda: None) -> None:
        missing = parameters.sensor.missing()
        if missing:
            raise MissingInputError(
                f'parameter {" and ".join(missing)} must be given, by --params FILE or --set '
                f'{missing[0]}=...: see config/relpose.yaml')
        self._bag, self._topics, self._stamps = bag, topics, stamps
        self._on_image = on_image
        self._front_end = FrontEnd(parameters, offline=True, keep_images=keep_images)
        self.sequencer = self._front_end.sequencer
        self._intake = Intake(self.sequencer, parameters.imu.stuck_gyro_time,
                              parameters.intrinsics)
        self._stamps_found: set[int] = set()
        self.counts = ReplayCounts()
        # Frames and messages that were not used, by the first sentence of each cause.
        self.reasons = CauseCounts()

    @property
    def intrinsics(self) -> Intrinsics | None:
        """The intrinsics in force."""
        return self._intake.intrinsics

    def pairs(self) -> Iterator[ReplayedPair]:
        """Run over the bag; every pair as it closes.

        Raises where the bag is damaged, its camera is not calibrated, or no frame could be used.
        """
        warm_up(self._front_end.parameters.estimator)
        started = time.perf_counter()
        for role, message in self._intake.feed.messages(self._bag, self._topics):
            self.counts.first_ns = self.counts.first_ns or message.bag_time_ns
            self.counts.last_ns = message.bag_time_ns
            self._hand_over(role, message)
            yield from self._drain()
        self._intake.release_held()
        self.sequencer.close()
        yield from self._drain()
        self.counts.seconds = time.perf_counter() - started
        self._check_outcome()

    def _hand_over(self, role: Role, message: BagMessage) -> None:
        try:
            if role is not Role.IMAGE or self._is_chosen(message.message):
                self._intake.receive(role, message.message)
        except RsRelposeError as error:
            if role is Role.CAMERA_INFO and not self.sequencer.counts().frames_taken:
                # Without intrinsics no frame can be estimated: end now, not after the whole bag.
                raise type(error)(f'{message.topic}: {error}') from error
            self.counts.invalid_messages += 1
            self._not_used(f'{message.topic}: {error}')

    def _is_chosen(self, image: Any) -> bool:
        """Whether an image message is among the stamps that were asked for."""
        self.counts.images += 1
        self._on_image()
        if self._stamps is None:
            return True
        stamp = stamp_ns(image.header)
        if stamp not in self._stamps:
            self.counts.images_skipped += 1
            self.sequencer.pass_over(stamp)
            return False
        self._stamps_found.add(stamp)
        return True

    def _drain(self) -> Iterator[ReplayedPair]:
        while (outcome := self._front_end.step()) is not None:
            if isinstance(outcome, FrameRefused):
                self._not_used(f'{outcome.cause.value}: {outcome.reason}')
            elif isinstance(outcome, FrameFailed):
                self.counts.failed_frames += 1
                self._not_used(str(outcome.error))
            else:
                self.counts.processing_seconds += outcome.seconds
                if outcome.result is not None:
                    self.counts.pairs += 1
                    yield ReplayedPair(outcome.result, self.counts.last_ns)

    def _not_used(self, reason: str) -> None:
        if self.reasons.add(reason):
            _logger.info('not used: %s', reason)

    def _check_outcome(self) -> None:
        if self._stamps is not None:
            absent = len(self._stamps - self._stamps_found)
            if absent == len(self._stamps):
                raise InputError(f'none of the {absent} chosen stamps is the stamp of an image on '
                                 f'{self._topics.image.name}')
            if absent:
                _logger.warning('%d of the %d chosen stamps are not in the bag', absent,
                                len(self._stamps))
        reason = next(iter(self.reasons.most_common()), None)
        if reason is not None and (not self.sequencer.counts().frames_taken
                                   or (self.counts.failed_frames and not self.counts.pairs)):
            raise InputError(f'no frame of {self._bag.path} could be used: {reason}')


def read_truth(bag: Bag, topics: SensorTopics) -> TrueTrajectory | None:
    """The camera's true trajectory; None where the bag has none."""
    if topics.truth is None:
        return None
    poses: list[TruePose] = []
    feed = SensorFeed({Role.TRUTH: poses.append})
    for role, message in feed.messages(bag, topics):
        feed.receive(role, message.message)
    try:
        return TrueTrajectory([pose.stamp_ns for pose in poses],
                              np.array([pose.position for pose in poses]),
                              np.array([pose.quat_xyzw for pose in poses]))
    except InputError as error:
        raise InputError(f'{topics.truth.name}: {error}') from error


def read_stamps(path: Path | str) -> frozenset[int]:
    """Stamps of frames, one integer [ns] per line, as the node's `stamps_file` writes them."""
    path = Path(path)
    if not path.is_file():
        raise MissingInputError(f'there is no file of stamps {path}')
    stamps = set()
    with path.open(encoding='utf-8', errors='replace') as file:
        for number, line in enumerate(file, start=1):
            text = line.strip()
            # A table of poses will not do: the frames between keyframes move the tracks as well.
            if text and not (text.isascii() and text.isdigit()):
                raise InputError(
                    f'{path}, line {number}: {text[:40]!r} is no stamp; the file must have one '
                    'integer [ns] per line, as the parameter stamps_file of the node writes it')
            if text:
                stamps.add(int(text))
    if not stamps:
        raise InputError(f'{path} has no stamps')
    return frozenset(stamps)
