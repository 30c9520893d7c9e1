"""The package as a ROS machine sees it: built by colcon, run from the install space."""

import os
from pathlib import Path
import shutil
import signal
import subprocess
import sys

from conftest import ROOT
import pytest

NAME = 'rs_relpose_ros'
KERNELS = Path(NAME) / '__pycache__' / 'kernels'


def tracked_files() -> list[Path]:
    if not (ROOT / '.git').exists() or shutil.which('git') is None:
        pytest.skip('no git checkout: the tracked files are unknown')
    listed = subprocess.run(['git', 'ls-files', '-z'], cwd=ROOT, capture_output=True, text=True,
                            check=True).stdout
    return [Path(name) for name in listed.split('\0') if name and (ROOT / name).is_file()]


@pytest.fixture(scope='module')
def install_space(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Install space of a colcon build of the tracked files."""
    colcon = shutil.which('colcon', path=f'{Path(sys.executable).parent}:{os.environ["PATH"]}')
    if colcon is None:
        pytest.skip('colcon is not installed')
    workspace = tmp_path_factory.mktemp('workspace')
    for name in tracked_files():
        if name.parts[0] in ('bags', 'docs', 'benchmarks'):  # not installed, and bags are big
            continue
        copy = workspace / 'src' / NAME / name
        copy.parent.mkdir(parents=True, exist_ok=True)
        shutil.copy(ROOT / name, copy)
    # As an earlier build left them: only what has another source is compiled again.
    if (ROOT / KERNELS).is_dir():
        shutil.copytree(ROOT / KERNELS, workspace / 'build' / NAME / 'build' / 'lib' / KERNELS)
    built = subprocess.run(
        [colcon, 'build', '--event-handlers', 'console_direct+'], cwd=workspace,
        stdout=subprocess.PIPE, stderr=subprocess.STDOUT, text=True, timeout=110, check=False)
    assert built.returncode == 0, built.stdout
    # A manifest that colcon finds invalid makes the folder a plain Python package, without a word.
    assert (workspace / 'install' / NAME / 'share' / NAME / 'package.dsv').is_file(), built.stdout
    return workspace / 'install'


# Loads all that the node needs; prints how many kernels were loaded, and how many compiled.
FIRST_START = """
import gc
from numba.core.dispatcher import Dispatcher
from rs_relpose_ros.config.settings import Parameters
from rs_relpose_ros.pipeline.warm_up import warm_up_pipeline
warm_up_pipeline(Parameters())
stats = [kernel.stats for kernel in gc.get_objects() if isinstance(kernel, Dispatcher)]
print(sum(len(stat.cache_hits) for stat in stats), sum(len(stat.cache_misses) for stat in stats))
"""


def in_install_space(install_space: Path, *command: str) -> list[str]:
    """Return the command line that runs `command` after sourcing the install space."""
    return ['bash', '-c', 'source "$0/local_setup.bash" && exec "$@"', str(install_space),
            *command]


def printed(install_space: Path, *command: str) -> str:
    """Output of a command in the install space, which must succeed."""
    ended = subprocess.run(in_install_space(install_space, *command), cwd=install_space,
                           capture_output=True, text=True, timeout=100, check=False)
    assert ended.returncode == 0, ended.stderr
    return ended.stdout.strip()


def executable(install_space: Path, name: str) -> str:
    """Return the path where ``ros2 run`` looks for executable `name`."""
    return str(install_space / NAME / 'lib' / NAME / name)


def test_everything_is_installed_and_found(install_space):
    share = install_space / NAME / 'share'
    assert (share / 'ament_index' / 'resource_index' / 'packages' / NAME).is_file()
    assert (share / NAME / 'package.xml').is_file()
    located = printed(
        install_space, sys.executable, '-c', f'import {NAME}; print({NAME}.__path__[0]);'
        'from ament_index_python import get_package_share_directory as share;'
        f'print(share("{NAME}"))')
    library, found = map(Path, located.splitlines())
    assert found == share / NAME
    assert library.is_relative_to(install_space)
    missing = [str(name) for name in tracked_files()
               if (name.parts[0] == NAME and not (library.parent / name).is_file())
               or (name.parts[0] in ('config', 'launch') and not name.name.startswith('.')
                   and not (share / NAME / name).is_file())]
    assert missing == []


def test_first_start_compiles_nothing_and_the_command_line_runs(install_space):
    loaded, compiled = map(int, printed(install_space, sys.executable, '-c', FIRST_START).split())
    assert loaded > 20
    assert compiled == 0
    assert 'replay' in printed(install_space, executable(install_space, 'rs_relpose'), '--help')


def test_node_starts_and_stops(install_space, ros_domain_id):
    from diagnostic_msgs.msg import DiagnosticArray

    from rs_relpose_lab.live.graph import Graph
    from rs_relpose_lab.live.processes import Process, wait_until
    command = in_install_space(install_space, executable(install_space, 'relpose_node'),
                               '--ros-args', '-r', '__node:=installed', '-p', 'readout_time:=0.03')
    with Graph() as graph, Process(
            '-c', 'import os, sys; os.execvp("bash", sys.argv[1:])', *command) as node:
        received = graph.listen(DiagnosticArray, '/diagnostics')
        wait_until(lambda: received, 'diagnostics', node)
        assert received[0].status[0].name.startswith('/installed: ')
        assert node.signal(signal.SIGINT)[0] == 0
        assert 'Traceback' not in node.output
