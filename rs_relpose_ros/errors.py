"""Exceptions of the package: one root, so that a caller can catch all of them at once."""


class RsRelposeError(Exception):
    """Root of every exception that this package raises on purpose."""


class InputError(RsRelposeError, ValueError):
    """A value, file or message that cannot be used; the text says what is legal and what came."""


class MissingInputError(RsRelposeError):
    """Something that the work needs is absent (a topic, a calibration, the read-out time)."""
