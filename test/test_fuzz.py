"""Mutated messages and bags: no crash, no hang, no memory without bound.

A short share here, the full counts by `make test-all`. Each run is one process of its own, so that
also a crash of a compiled library is a failed test.
"""

from __future__ import annotations

import json
from pathlib import Path
import subprocess
import sys
from typing import Any

import pytest

HERE = Path(__file__).resolve().parent
LONG = pytest.mark.long


def run(script: str, count: int, seed: int, timeout: float) -> dict[str, Any]:
    """The figures that a fuzzer prints."""
    ended = subprocess.run([sys.executable, str(HERE / script), str(count), str(seed)],
                           cwd=HERE.parent, capture_output=True, text=True, timeout=timeout,
                           check=False)
    assert ended.returncode == 0, ended.stderr[-4000:]
    print(ended.stdout)
    return json.loads(ended.stdout)


@pytest.mark.parametrize(('count', 'seed'), [
    (8_000, 1), pytest.param(100_000, 2, marks=[LONG, pytest.mark.timeout(1300)])])
def test_mutated_messages(count, seed):
    figures = run('fuzz_messages.py', count, seed, 1200 if count > 10_000 else 110)
    assert figures['messages'] == count
    assert figures['memory_growth_mb'] < 100.0
    outcomes = figures['outcomes']
    # Good ones between the bad ones still get through.
    assert outcomes['taken'] > 0.5 * count
    assert outcomes['frame ready'] > 0.02 * count
    assert outcomes['refused'] > 0.05 * count


@pytest.mark.timeout(600)   # the kernels may not be compiled yet
@pytest.mark.parametrize(('count', 'seed'), [
    (200, 1), pytest.param(10_000, 2, marks=[LONG, pytest.mark.timeout(3700)])])
def test_mutated_bags(count, seed):
    figures = run('fuzz_bags.py', count, seed, 3600 if count > 1000 else 590)
    assert figures['bags'] == count
    assert figures['memory_growth_mb'] < 100.0
    # Files are damaged for good most of the time, but not beyond use always.
    assert 0.02 * count < figures['outcomes']['read'] < 0.6 * count
