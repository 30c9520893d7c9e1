"""Exceptions of the package, with one root class, and packages that may be absent."""

import importlib.util
from types import ModuleType


class RsRelposeError(Exception):
    """Root of every exception that this package raises on purpose."""


class InputError(RsRelposeError, ValueError):
    """An unusable value, file or message; the text says what is legal and what was given."""


class MissingInputError(RsRelposeError):
    """A required input is absent (a topic, a calibration, the readout time)."""


def library(module: str, absent: str) -> ModuleType:
    """Import a module; a missing package raises MissingInputError with the text `absent`."""
    if importlib.util.find_spec(module.partition('.')[0]) is None:
        raise MissingInputError(absent)
    return importlib.import_module(module)
