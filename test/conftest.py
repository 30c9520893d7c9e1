"""What all tests share: places of data, and a ROS graph of their own."""

from __future__ import annotations

from collections.abc import Iterator
import fcntl
import itertools
import os
from pathlib import Path
import sys
import tempfile

import pytest

ROOT = Path(__file__).resolve().parent.parent
DOMAIN_IDS = range(1, 101)  # above 101, DDS ports run into the range of ephemeral ports

# For a bare `pytest` as well as for `make test`, and inherited by the processes that tests start.
os.environ.setdefault('AMENT_PREFIX_PATH', sys.prefix)
os.environ['ROS_AUTOMATIC_DISCOVERY_RANGE'] = 'LOCALHOST'
os.environ['ROS_PYTHON_CHECK_FIELDS'] = '1'

# Two runs at once start at different ids, so that they rarely try for the same lock.
_next_domain_id = itertools.count(os.getpid())


def _recordings() -> Path:
    """Folder of the recorded data; skips the test where none is given, fails where it is gone."""
    folder = os.environ.get('RS_RELPOSE_DATA')
    if not folder:
        pytest.skip('RS_RELPOSE_DATA is not set: no recorded data')
    if not Path(folder).is_dir():
        pytest.fail(f'RS_RELPOSE_DATA is set to {folder}, which is no directory', pytrace=False)
    return Path(folder)


def pytest_runtest_setup(item: pytest.Item) -> None:
    if item.get_closest_marker('recordings'):
        _recordings()


@pytest.fixture(scope='session')
def recordings() -> Path:
    """Folder of the recorded data (RS_RELPOSE_DATA)."""
    return _recordings()


@pytest.fixture(scope='session')
def bundled_bag() -> Path:
    """The bag that lies in the repository: a rosbag2 directory."""
    bag = ROOT / 'bags' / 'hand_held'
    assert (bag / 'metadata.yaml').is_file(), f'{bag} is no rosbag2 directory'
    return bag


@pytest.fixture
def ros_domain_id(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> Iterator[int]:
    """A DDS domain that no other test on this machine uses meanwhile, set in the environment."""
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
            monkeypatch.setenv('ROS_DOMAIN_ID', str(domain_id))
            monkeypatch.setenv('ROS_LOG_DIR', str(tmp_path / 'ros_log'))
            yield domain_id
            return
    pytest.fail('all ROS domain ids are in use')
