"""What all tests share: places of data, a DDS domain of their own, and how they are shared out."""

from collections.abc import Callable, Iterator
import csv
from importlib.util import find_spec
import os
from pathlib import Path
import shutil
import sys
from typing import Any

from hypothesis import HealthCheck, settings
import pytest

from rs_relpose_lab.live.graph import private_domain
from rs_relpose_ros.cli import main as command_line

ROOT = Path(__file__).resolve().parent.parent
BUNDLED_PARAMETERS = ROOT / 'bags' / 'hand_held.yaml'

# The same examples in every run; the first one may compile kernels.
settings.register_profile(
    'repeatable',
    derandomize=True,
    deadline=None,
    database=None,
    suppress_health_check=[HealthCheck.too_slow, HealthCheck.data_too_large],
)
settings.load_profile('repeatable')


class Clock:
    """A monotonic clock that a test moves by hand."""

    now = 0

    def __call__(self) -> int:
        return self.now


@pytest.fixture
def clock() -> Clock:
    return Clock()


def rows_of(path: Path) -> list[dict[str, str]]:
    """Rows of a table, by the names of its columns."""
    with path.open(newline='') as file:
        return list(csv.DictReader(file))


# For a bare `pytest` as well as for `make test`, and inherited by the processes that tests start.
os.environ.setdefault('AMENT_PREFIX_PATH', sys.prefix)
os.environ['ROS_AUTOMATIC_DISCOVERY_RANGE'] = 'LOCALHOST'
os.environ['ROS_PYTHON_CHECK_FIELDS'] = '1'


# Modules with live tests.
LIVE = {
    path.name
    for path in Path(__file__).parent.glob('test_*.py')
    if 'pytest.mark.live' in path.read_text(encoding='utf-8')
}


@pytest.hookimpl(optionalhook=True)
def pytest_xdist_make_scheduler(config: pytest.Config, log: object) -> object:
    """One process of pytest runs all modules with live tests; no module is shared out.

    Fixtures of a module are set up once.
    """
    from xdist.scheduler import LoadScopeScheduling

    class LiveTogether(LoadScopeScheduling):
        def _split_scope(self, nodeid: str) -> str:
            name = Path(nodeid.partition('::')[0]).name
            return 'live' if name in LIVE else name

    return LiveTogether(config, log)


# Modules that import gtsam, an extra. A ROS machine has none: no key of rosdep installs it.
_ODOMETRY = (
    'test_downstream.py',
    'test_export.py',
    'test_marginals.py',
    'test_odometry.py',
    'test_odometry_faults.py',
    'test_odometry_runs.py',
)
collect_ignore = [] if find_spec('gtsam') else list(_ODOMETRY)


def pytest_report_header() -> str:
    """Name the modules that are left out."""
    return f'left out without gtsam: {", ".join(collect_ignore)}' if collect_ignore else ''


def pytest_collection_modifyitems(items: list[pytest.Item]) -> None:
    """Modules with live tests first, which are the longest part."""
    items.sort(key=lambda item: item.path.name not in LIVE)


def recordings_folder() -> Path:
    """Folder of the recorded data; skips the test where none is given, fails where it is gone."""
    folder = os.environ.get('RS_RELPOSE_DATA')
    if not folder:
        pytest.skip('RS_RELPOSE_DATA is not set: no recorded data')
    if not Path(folder).is_dir():
        pytest.fail(f'RS_RELPOSE_DATA is set to {folder}, which is no directory', pytrace=False)
    return Path(folder)


def pytest_runtest_setup(item: pytest.Item) -> None:
    if 'PYTEST_XDIST_WORKER' in os.environ and item.path.name not in LIVE:
        os.nice(max(10 - os.nice(0), 0))  # live tests first
    if item.get_closest_marker('recordings'):
        recordings_folder()


@pytest.fixture(scope='session')
def recordings() -> Path:
    """Folder of the recorded data (RS_RELPOSE_DATA)."""
    return recordings_folder()


@pytest.fixture(scope='session')
def converted(recordings: Path, tmp_path_factory: pytest.TempPathFactory) -> Callable[..., Path]:
    """Bag of a recording by its name, and by the converter's name; converted once."""
    folder = tmp_path_factory.mktemp('recordings')

    def bag(name: str, source: str = '') -> Path:
        path = folder / name
        if not path.exists():
            run_command('convert', source or name.removesuffix('_b'), recordings / name, path)
        return path

    return bag


@pytest.fixture(scope='session')
def bundled_bag() -> Path:
    """The bag that lies in the repository: a rosbag2 directory."""
    bag = ROOT / 'bags' / 'hand_held'
    assert (bag / 'metadata.yaml').is_file(), f'{bag} is no rosbag2 directory'
    return bag


def run_command(*arguments: object) -> None:
    """Run a command line, which must succeed."""
    assert command_line.main([str(argument) for argument in arguments]) == 0


@pytest.fixture
def refused(capsys: pytest.CaptureFixture[str]) -> Callable[..., None]:
    """Runs a command line that is refused: exit code 2, and one line with these words."""

    def run(words: str, *arguments: object) -> None:
        assert command_line.main([str(argument) for argument in arguments]) == 2
        error = capsys.readouterr().err
        assert error.startswith('rs_relpose: error: ') and error.count('\n') == 1
        assert words in error

    return run


@pytest.fixture(scope='module')
def browser() -> Iterator[Any]:
    """Chromium of the system, driven by Playwright; skips where one is missing."""
    sync_api = pytest.importorskip('playwright.sync_api', reason='playwright is not installed')
    names = ('chromium', 'chromium-browser', 'google-chrome')
    program = next(filter(None, map(shutil.which, names)), None)
    if program is None:
        pytest.skip('no Chromium: apt-get install chromium')
    with sync_api.sync_playwright() as playwright:
        # Containers have no user namespaces for its sandbox; the pages are ours.
        started = playwright.chromium.launch(executable_path=program, args=['--no-sandbox'])
        yield started
        started.close()


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
