"""One thread for linear algebra, where the process is ours.

No matrix of an estimate has more than some tens of rows: a second thread finishes none sooner.
Those of OpenBLAS wait for work without sleeping, on the core that the camera driver and the
threads of DDS need (figures: docs/lab/node.md).
"""

from __future__ import annotations

import os


def use_one_blas_thread() -> None:
    """Call it before NumPy is imported; whoever has set a number keeps it."""
    for library in ('OPENBLAS', 'MKL'):
        os.environ.setdefault(f'{library}_NUM_THREADS', '1')
