"""Garbage collections of a process, few of them while it starts or compiles, or runs a command.

What is made then, modules, syntax trees and results, is no garbage: looking for some costs a tenth
of the time of a start, and 2 to 5 % of that of a command.
"""

import gc

# Number of new objects between two collections while a process starts or compiles, or runs a
# command. With fewer, a start takes 0.15 s longer; without a bound, a compilation would keep what
# it no longer needs. [measured: processor time of a start; compilation of all kernels; the path of
# a walk of 24 s has 2500 objects of garbage, and the same peak of memory with either number]
_SELDOM = 100_000
# Thresholds of Python. [derived: Python, when this module is imported]
_USUAL = gc.get_threshold()


def collect_seldom() -> None:
    """Begin to start, to compile or to run a command."""
    gc.set_threshold(_SELDOM)


def collect_as_usual() -> None:
    """The process has started: what exists by now is permanent, and need not be scanned again."""
    gc.collect()
    gc.freeze()
    gc.set_threshold(*_USUAL)
