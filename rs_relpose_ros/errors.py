"""Exceptions of the package, with one root class."""


class RsRelposeError(Exception):
    """Root of every exception that this package raises on purpose."""


class InputError(RsRelposeError, ValueError):
    """An unusable value, file or message; the text has what is legal and what was given."""


class MissingInputError(RsRelposeError):
    """A required input is absent (a topic, a calibration, the readout time)."""
