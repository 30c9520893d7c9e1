"""A trial: parts of a recording through the front end of the node, and what it finds there."""

from __future__ import annotations

from rs_relpose_ros.bags.reader import BagMessage
from rs_relpose_ros.config.parameters import Parameters
from rs_relpose_ros.errors import RsRelposeError
from rs_relpose_ros.estimator.warm_up import warm_up
from rs_relpose_ros.front_end.front_end import FrameFailed, FrontEnd
from rs_relpose_ros.front_end.pair import PairResult
from rs_relpose_ros.front_end.sequencer import FrameRefused
from rs_relpose_ros.geometry.timing import to_nanoseconds
from rs_relpose_ros.health.findings import Health, NOT_JUDGED, worst_of
from rs_relpose_ros.messages.causes import CauseCounts
from rs_relpose_ros.messages.incoming import stamp_ns
from rs_relpose_ros.messages.intake import Intake
from rs_relpose_ros.messages.sensor_feed import Role

# Parts of consecutive images, evenly over the recording: three times 10 s at 30 Hz; and images
# that a calibration takes.
_PARTS, _PART_IMAGES, _CALIBRATED_IMAGES = 3, 300, 600
# A part is judged by its last pair, and by those so long after its first one: fewer pairs are
# soon mistaken.
_SETTLED_NS = to_nanoseconds(10.0)
# Pairs so far apart are of two parts.
_APART_NS = to_nanoseconds(3.0)
# Share of the images below which hardly any was used.
_FEW_USED = 0.1
# Share of the pairs that have a pose where the camera moves and the figures are right.
MOST_POSED = 0.7
# Figures of which the trial sees that they are far off, but not by how much.
_FAR_OFF = frozenset(('axes', 'time_offset', 'image_geometry'))
# Images that wait for the gyro at most: where the clocks differ it never comes.
_MOST_WAITING = 64


def _part_of(images: int, part: int) -> range:
    """Indices of the images of a part of a recording of so many `images`, 0 to 2."""
    if images <= _PARTS * _PART_IMAGES:
        return range(part * images // _PARTS, (part + 1) * images // _PARTS)
    first = part * (images - _PART_IMAGES) // (_PARTS - 1)
    return range(first, first + _PART_IMAGES)


def middle_of(images: int) -> range:
    """Indices of the images, in the middle of the recording, that a calibration takes."""
    first = max(images - _CALIBRATED_IMAGES, 0) // 2
    return range(first, first + min(images, _CALIBRATED_IMAGES))


class Trial:
    """Takes in the messages of a bag with `images` images, in the order of recording.

    The parameters hold as they were told: nothing is tracked, nothing is withheld.
    """

    def __init__(self, images: int, parameters: Parameters) -> None:
        warm_up(parameters.estimator)
        told = parameters.updated({'withhold_when_wrong': False, 'track_time_offset': False,
                                   'track_readout_time': False})
        self._front_end = FrontEnd(told, offline=True)
        self._intake = Intake(self._front_end.sequencer, told.imu.stuck_gyro_time, told.intrinsics)
        self._parts = tuple(_part_of(images, part) for part in range(_PARTS))
        self._index = -1
        self._before = NOT_JUDGED   # of what is judged so far
        self._last: PairResult | None = None
        self._part_since_ns = 0
        self.frames = self._handed = self._done = 0
        self.reasons = CauseCounts()   # why frames were not used
        self.matches: list[int] = []   # of each pair
        self.poses = 0
        self.poseless = CauseCounts()   # why pairs have no pose

    def take(self, role: Role, message: BagMessage) -> None:
        """Take in the next message; one that cannot be used is passed over."""
        try:
            if role is not Role.IMAGE or self._wants(message):
                self._intake.receive(role, message.message)
        except RsRelposeError as error:
            self.reasons.add(str(error))
        self._drain()

    def close(self) -> None:
        """End of the recording."""
        self._intake.release_held()
        self._front_end.sequencer.close()
        self._drain()

    @property
    def health(self) -> Health:
        """Of each figure the worst that a part shows."""
        return self._before if self._last is None else worst_of(self._before, self._last.health)

    @property
    def is_refused(self) -> bool:
        """Whether hardly any image could be used."""
        return self.frames < _FEW_USED * self._handed

    @property
    def is_lost(self) -> bool:
        """Whether a figure may be too far off for the trial to see by how much."""
        if not self.matches:
            return False
        off = {fault.figure for fault in self.health.faults}
        return bool(off & _FAR_OFF) or self.poses < MOST_POSED * len(self.matches)

    def _wants(self, message: BagMessage) -> bool:
        """Count an image; whether it belongs to a part."""
        self._index += 1
        if any(self._index in part for part in self._parts) and (
                self._handed - self._done < _MOST_WAITING):
            self._handed += 1
            return True
        self._front_end.sequencer.pass_over(stamp_ns(message.message.header))
        return False

    def _drain(self) -> None:
        while (outcome := self._front_end.step()) is not None:
            self._done += 1
            if isinstance(outcome, FrameRefused):
                self.reasons.add(outcome.reason)
            elif isinstance(outcome, FrameFailed):
                self.reasons.add(str(outcome.error))
            else:
                self.frames += 1
                if outcome.result is not None:
                    self._take_pair(outcome.result)

    def _take_pair(self, pair: PairResult) -> None:
        self.matches.append(len(pair.matches))
        if pair.pose:
            self.poses += 1
        else:
            self.poseless.add(pair.pose.reason)
        last = self._last
        if last is None or not 0 <= pair.stamp_ns - last.stamp_ns < _APART_NS:
            self._before, self._part_since_ns = self.health, pair.stamp_ns
        self._last = pair
        if pair.stamp_ns - self._part_since_ns >= _SETTLED_NS:
            self._before = self.health
