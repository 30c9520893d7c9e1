"""One thread for linear algebra in the processes of this package.

Matrices of an estimate have some tens of rows: more threads do not help. Idle threads of OpenBLAS
wait without sleeping on the cores of camera driver and DDS (measured in docs/lab/node.md).
"""

import os


def use_one_blas_thread() -> None:
    """Call it before NumPy is imported; a number that the user has set is kept."""
    for library in ('OPENBLAS', 'MKL'):
        os.environ.setdefault(f'{library}_NUM_THREADS', '1')
