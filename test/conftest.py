"""What all tests share: places of data, a DDS domain of their own, and how they are shared out."""

from __future__ import annotations

from collections.abc import Iterator
import os
from pathlib import Path
import sys

import pytest

from rs_relpose_lab.live.graph import private_domain

ROOT = Path(__file__).resolve().parent.parent
BUNDLED_PARAMETERS = ROOT / 'bags' / 'hand_held.yaml'

# For a bare `pytest` as well as for `make test`, and inherited by the processes that tests start.
os.environ.setdefault('AMENT_PREFIX_PATH', sys.prefix)
os.environ['ROS_AUTOMATIC_DISCOVERY_RANGE'] = 'LOCALHOST'
os.environ['ROS_PYTHON_CHECK_FIELDS'] = '1'


@pytest.hookimpl(tryfirst=True)
def pytest_collection_modifyitems(config: pytest.Config, items: list[pytest.Item]) -> None:
    """Tests with real processes first and one after the other: two processes share the rest.

    They wait more than they calculate, so the other process hardly slows them down. A module is
    never shared out, as its fixtures are set up once.
    """
    if not getattr(config.option, 'loadgroup', False):   # not one of several processes
        return
    items.sort(key=lambda item: item.get_closest_marker('live') is None)
    for item in items:
        live = item.get_closest_marker('live')
        item.add_marker(pytest.mark.xdist_group('live' if live else item.path.stem))


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
def ros_domain_id(tmp_path: Path) -> Iterator[int]:
    """A DDS domain that no other test on this machine uses meanwhile, set in the environment."""
    with private_domain() as domain_id:
        os.environ['ROS_LOG_DIR'] = str(tmp_path / 'ros_log')
        yield domain_id


@pytest.fixture(scope='module')
def module_ros_domain_id(tmp_path_factory: pytest.TempPathFactory) -> Iterator[int]:
    """The same for all tests of a module, which then share processes."""
    with private_domain() as domain_id:
        os.environ['ROS_LOG_DIR'] = str(tmp_path_factory.mktemp('ros_log'))
        yield domain_id
