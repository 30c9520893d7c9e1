"""A DDS domain of a test's own."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
import fcntl
import itertools
import os
from pathlib import Path
import tempfile

import pytest

DOMAIN_IDS = range(1, 101)  # above 101, DDS ports run into the range of ephemeral ports

# Two runs at once start at different ids, so that they rarely try for the same lock.
_next_domain_id = itertools.count(os.getpid())


@contextmanager
def own_ros_domain(log_directory: Path) -> Iterator[int]:
    """A domain that no other test on this machine uses meanwhile, set in the environment."""
    locks = Path(tempfile.gettempdir())
    for _ in DOMAIN_IDS:
        domain_id = DOMAIN_IDS[next(_next_domain_id) % len(DOMAIN_IDS)]
        try:
            lock = (locks / f'rs_relpose_ros_domain_{domain_id}.lock').open('w')
        except PermissionError:  # somebody else's
            continue
        with lock:
            try:
                fcntl.flock(lock, fcntl.LOCK_EX | fcntl.LOCK_NB)
            except BlockingIOError:
                continue
            with pytest.MonkeyPatch.context() as environment:
                environment.setenv('ROS_DOMAIN_ID', str(domain_id))
                environment.setenv('ROS_LOG_DIR', str(log_directory / 'ros_log'))
                yield domain_id
            return
    pytest.fail('all ROS domain ids are in use')
