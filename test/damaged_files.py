"""Recordings that cannot be used: what is done to the files in their folders."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path


def replaced(name: str, old: str, new: str) -> Callable[[Path], None]:
    """Replace the first place of a text, which must be there."""
    def damage(folder: Path) -> None:
        text = (folder / name).read_text()
        assert old in text
        (folder / name).write_text(text.replace(old, new, 1))
    return damage


def removed(name: str) -> Callable[[Path], None]:
    """Remove a file."""
    return lambda folder: (folder / name).unlink()
