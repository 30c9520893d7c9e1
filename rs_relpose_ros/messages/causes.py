"""Sentences about bad input grouped by their cause, in bounded memory."""

from __future__ import annotations

import re

# Numbers in a sentence: they differ from message to message of one cause.
_NUMBERS = re.compile(r'[-+]?\d[\d.e+-]*')
# Most causes that are told apart: a source that makes up new texts must not fill log or memory.
MOST_CAUSES = 64


def cause_of(text: str) -> str:
    """`text` without its numbers."""
    return _NUMBERS.sub('#', text)


class CauseCounts:
    """Counts sentences by their causes; of each cause the first sentence is kept."""

    def __init__(self) -> None:
        self._counts: dict[str, tuple[str, int]] = {}

    def add(self, text: str) -> bool:
        """Count a sentence; whether it is the first of its cause."""
        cause = cause_of(text)
        if cause not in self._counts and len(self._counts) >= MOST_CAUSES:
            cause, text = '', 'further reasons of other kinds'
        first, count = self._counts.get(cause, (text, 0))
        self._counts[cause] = first, count + 1
        return count == 0

    def most_common(self) -> dict[str, int]:
        """The kept sentences with their counts, the most frequent first."""
        return dict(sorted(self._counts.values(), key=lambda item: -item[1]))
