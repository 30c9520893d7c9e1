"""Endless play of a recording whose motion is periodic: turn follows turn, and stamps go on."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
import struct

from rs_relpose_ros.bags.topics import COMPRESSED_IMAGE, IMAGE
from rs_relpose_ros.errors import InputError
from rs_relpose_ros.geometry.timing import NANOSECONDS

# CDR: 4 bytes of encapsulation (the second one tells the byte order), then sec and nanosec of the
# std_msgs/Header that the message begins with.
_STAMP = slice(4, 12)
_TAIL_NS = NANOSECONDS // 20


@dataclass(frozen=True, slots=True)
class Outgoing:
    """A serialised message, due so many nanoseconds after the first."""

    due_ns: int
    topic: str
    msgtype: str
    data: bytes


def in_turns(messages: Sequence[Outgoing], period_ns: int,
             duration_ns: int) -> Iterator[Outgoing]:
    """Messages of one period again and again, each turn's stamps and dues a period later.

    `messages`: in the order of `due_ns`; all begin with a header, and their stamps span one
        period.
    `duration_ns`: messages due later are left out. Images end 50 ms earlier, so that the IMU
        samples which cover their last rows are still published.
    """
    stamps = [stamp_of(message.data) for message in messages]
    if messages and max(stamps) - min(stamps) >= period_ns:
        raise InputError(f'the recording is {(max(stamps) - min(stamps)) / NANOSECONDS:.3f} s '
                         f'long, and so has no period of {period_ns / NANOSECONDS:g} s')
    # A message due after the period's end is sent among the first messages of the next turn.
    order = sorted(range(len(messages)), key=lambda k: messages[k].due_ns % period_ns)
    turn = 0
    while messages:
        for k in order:
            message = messages[k]
            repeat_ns = (turn - message.due_ns // period_ns) * period_ns
            if repeat_ns < 0:
                continue
            due_ns = message.due_ns + repeat_ns
            if due_ns >= duration_ns:
                return
            if message.msgtype in (IMAGE, COMPRESSED_IMAGE) and due_ns >= duration_ns - _TAIL_NS:
                continue
            yield Outgoing(due_ns, message.topic, message.msgtype,
                           _with_stamp(message.data, stamps[k] + repeat_ns))
        turn += 1


def stamp_of(data: bytes) -> int:
    """Header stamp [ns] of a serialised message."""
    seconds, nanoseconds = struct.unpack(_time_format(data), data[_STAMP])
    return int(seconds) * NANOSECONDS + int(nanoseconds)


def _with_stamp(data: bytes, stamp_ns: int) -> bytes:
    # One copy: publishers take bytes only.
    stamp = struct.pack(_time_format(data), *divmod(stamp_ns, NANOSECONDS))
    return b''.join((data[:_STAMP.start], stamp, memoryview(data)[_STAMP.stop:]))


def _time_format(data: bytes) -> str:
    return '<iI' if data[1] & 1 else '>iI'
