"""Order statistics in compiled code, where a sort of Numba's own takes seconds to compile."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from rs_relpose_ros.compiled import linked_kernel

Array = NDArray[np.float64]


@linked_kernel
def smallest(values: Array, k: int) -> float:
    """The value (n,) that k others precede in ascending order; reorders `values`, free of NaN.

    Afterwards those before index k are not larger, those behind it not smaller (Hoare's *Find*,
    Communications of the ACM 4, 1961).
    """
    low, high = 0, len(values) - 1
    while low < high:
        pivot = values[(low + high) // 2]
        i, j = low, high
        while i <= j:
            while values[i] < pivot:
                i += 1
            while pivot < values[j]:
                j -= 1
            if i <= j:
                values[i], values[j] = values[j], values[i]
                i += 1
                j -= 1
        if j < k:
            low = i
        if k < i:
            high = j
    return values[k]


@linked_kernel
def median(values: Array) -> float:
    """Median of at least one value; `values` are reordered and free of NaN."""
    n = len(values)
    upper = smallest(values, n // 2)
    return upper if n % 2 == 1 else 0.5 * (smallest(values, n // 2 - 1) + upper)
