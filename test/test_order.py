"""Order statistics in compiled code, against NumPy's sort and median."""

from __future__ import annotations

import numpy as np
import pytest

from rs_relpose_ros.geometry.order import median, smallest


@pytest.mark.parametrize('count', [1, 2, 3, 10, 101])
@pytest.mark.parametrize('kind', ['random', 'ascending', 'descending', 'few', 'infinite'])
def test_every_rank_and_the_median(count, kind):
    rng = np.random.default_rng(count)
    values = rng.normal(size=count)
    values = {'random': values, 'ascending': np.sort(values), 'descending': -np.sort(values),
              'few': np.round(values), 'infinite': np.where(values > 1.0, np.inf, values)}[kind]
    for k in range(count):
        reordered = values.copy()
        assert smallest(reordered, k) == np.sort(values)[k]
        assert reordered[:k].max(initial=-np.inf) <= reordered[k] <= reordered[k:].min()
        np.testing.assert_array_equal(np.sort(reordered), np.sort(values))
    assert median(values.copy()) == np.median(values)
