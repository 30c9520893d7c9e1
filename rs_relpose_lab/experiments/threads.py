"""One thread for the numerical libraries, as every figure of the benchmarks is for one thread."""

from __future__ import annotations

import os

_VARIABLES = ('OMP_NUM_THREADS', 'OPENBLAS_NUM_THREADS', 'MKL_NUM_THREADS', 'NUMBA_NUM_THREADS')


def use_one_thread() -> None:
    """Tell the libraries, and those of child processes; to be called before NumPy is imported."""
    for name in _VARIABLES:
        os.environ[name] = '1'
