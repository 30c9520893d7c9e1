"""Feeds a bag to the pipeline of the live node: the same sequencer, conversion and estimator."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass
import logging
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
from rs_relpose_ros.front_end.sequencer import FrameRefused, SequencerCounts
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


@dataclass(frozen=True, slots=True)
class ReplayCounts:
    """What came, and what became of it.

    Attributes
    ----------
    images : int
        In the bag; `images_skipped` of them are not among the chosen stamps.
    sequencer : SequencerCounts
    invalid_messages, failed_frames : int
    reasons : dict
        Number of frames and messages that were not used, by the first sentence of each cause.
    seconds : float
        Wall time of the whole, without compilation.
    processing_seconds : float
        Of it, in tracking and estimation.
    bag_seconds : float
        From the first to the last message.
    """

    images: int
    images_skipped: int
    sequencer: SequencerCounts
    invalid_messages: int
    failed_frames: int
    reasons: dict[str, int]
    seconds: float
    processing_seconds: float
    bag_seconds: float


class Replay:
    """One run over a bag; iterate over `pairs`, then ask for `counts`.

    Parameters
    ----------
    bag : Bag
        Open.
    topics : SensorTopics
    parameters : Parameters
    stamps : set of int, optional
        Only these frames are handed over, as those that a live node processed.
    keep_images : bool
        Whether pairs carry their images.
    on_image : callable
        Called after each image of the bag, for a progress bar.
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
        self._intake = Intake(self._front_end.sequencer, parameters.imu.stuck_gyro_time)
        self._stamps_found: set[int] = set()
        self._images = self._skipped = self._invalid = self._failed = self._pairs = 0
        self._reasons = CauseCounts()
        self._seconds = self._processing_seconds = 0.0
        self._first_ns = self._last_ns = 0

    @property
    def intrinsics(self) -> Intrinsics | None:
        """The intrinsics in force."""
        return self._intake.intrinsics

    def pairs(self) -> Iterator[ReplayedPair]:
        """Run over the bag; every pair as it closes.

        Raises
        ------
        InputError, MissingInputError
            The bag is damaged, its camera is not calibrated, or no frame of it could be used.
        """
        warm_up(self._front_end.parameters.estimator)
        started = time.perf_counter()
        for role, message in self._intake.feed.messages(self._bag, self._topics):
            self._first_ns = self._first_ns or message.bag_time_ns
            self._last_ns = message.bag_time_ns
            self._hand_over(role, message)
            yield from self._drain()
        self._intake.refuse_held()
        self._front_end.sequencer.close()
        yield from self._drain()
        self._seconds = time.perf_counter() - started
        self._check_outcome()

    def counts(self) -> ReplayCounts:
        """Counts so far."""
        return ReplayCounts(
            images=self._images, images_skipped=self._skipped,
            sequencer=self._front_end.sequencer.counts(), invalid_messages=self._invalid,
            failed_frames=self._failed, reasons=self._reasons.most_common(),
            seconds=self._seconds, processing_seconds=self._processing_seconds,
            bag_seconds=(self._last_ns - self._first_ns) * 1e-9)

    # -- inside ------------------------------------------------------------------------------

    def _hand_over(self, role: Role, message: BagMessage) -> None:
        try:
            if role is not Role.IMAGE or self._is_chosen(message.message):
                self._intake.receive(role, message.message)
        except RsRelposeError as error:
            if role is Role.CAMERA_INFO and not self._front_end.sequencer.counts().frames_taken:
                # Without intrinsics no frame can be estimated: end now, not after the whole bag.
                raise type(error)(f'{message.topic}: {error}') from error
            self._invalid += 1
            self._not_used(f'{message.topic}: {error}')

    def _is_chosen(self, image: Any) -> bool:
        """Whether an image message is among the stamps that were asked for."""
        self._images += 1
        self._on_image()
        if self._stamps is None:
            return True
        stamp = stamp_ns(image.header)
        if stamp not in self._stamps:
            self._skipped += 1
            return False
        self._stamps_found.add(stamp)
        return True

    def _drain(self) -> Iterator[ReplayedPair]:
        while (outcome := self._front_end.step()) is not None:
            if isinstance(outcome, FrameRefused):
                self._not_used(f'{outcome.cause.value}: {outcome.reason}')
            elif isinstance(outcome, FrameFailed):
                self._failed += 1
                self._not_used(str(outcome.error))
            else:
                self._processing_seconds += outcome.seconds
                if outcome.pair is not None:
                    self._pairs += 1
                    yield ReplayedPair(outcome.pair, self._last_ns)

    def _not_used(self, reason: str) -> None:
        if self._reasons.add(reason):
            _logger.info('not used: %s', reason)

    def _check_outcome(self) -> None:
        counts = self._front_end.sequencer.counts()
        if self._stamps is not None:
            absent = len(self._stamps - self._stamps_found)
            if absent == len(self._stamps):
                raise InputError(f'none of the {absent} chosen stamps is the stamp of an image on '
                                 f'{self._topics.image.name}')
            if absent:
                _logger.warning('%d of the %d chosen stamps are not in the bag', absent,
                                len(self._stamps))
        reasons = self._reasons.most_common()
        if reasons and (not counts.frames_taken or (self._failed and not self._pairs)):
            reason = next(iter(reasons))
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
