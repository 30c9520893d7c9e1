"""Libraries that only some sources need: an extra of the package, not a dependency."""

from __future__ import annotations

import importlib
from types import ModuleType

from rs_relpose_ros.errors import MissingInputError

# Module -> its package on PyPI; all of the extra `video`.
_PACKAGES = {'av': 'av', 'telemetry_parser': 'telemetry-parser'}


def import_optional(module: str) -> ModuleType:
    """A module of the extra `video`; MissingInputError that tells how to get it."""
    try:
        return importlib.import_module(module)
    except ImportError as error:
        raise MissingInputError(
            f'videos need the Python package {_PACKAGES[module]}, which is not installed: '
            f'pip install {" ".join(_PACKAGES.values())}') from error
