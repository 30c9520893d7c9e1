"""Garbage collections of a process, few of them while it starts or compiles.

What is made then, modules and syntax trees, is no garbage: looking for some costs a tenth of the
time.
"""

import gc

# Number of new objects between two collections while a process starts or compiles. With fewer, a
# start takes 0.15 s longer; without a bound, a compilation would keep what it no longer needs.
# [measured: processor time of a start; compilation of all kernels]
_SELDOM = 100_000
# Thresholds of Python. [derived: Python, when this module is imported]
_USUAL = gc.get_threshold()


def collect_seldom() -> None:
    """Begin to start or to compile."""
    gc.set_threshold(_SELDOM)


def collect_as_usual() -> None:
    """The process has started: what exists by now is permanent, and need not be scanned again."""
    gc.collect()
    gc.freeze()
    gc.set_threshold(*_USUAL)
