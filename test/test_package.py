"""The package as a whole: metadata, layers of its modules, commands, built by colcon."""

import ast
import doctest
import functools
import graphlib
import importlib
from importlib.metadata import distribution
import os
from pathlib import Path
import platform
import re
import shutil
import signal
import subprocess
import sys
import tempfile
import tomllib
from types import SimpleNamespace

from conftest import ROOT
import numpy as np
import pytest

from rs_relpose_ros.cli import main as command_line
from rs_relpose_ros.errors import InputError, MissingInputError

NAME = 'rs_relpose_ros'
ROS = re.compile(
    r'(rclpy|rcl_interfaces|ament_\w+|builtin_interfaces|launch\w*|rosgraph_msgs'
    r'|tf2_ros|std_srvs|\w+_msgs)$'
)
LABORATORY = 'rs_relpose_lab'
MODULES = {
    '.'.join(path.relative_to(ROOT).with_suffix('').parts).removesuffix('.__init__'): path
    for package in (NAME, LABORATORY)
    for path in sorted((ROOT / package).rglob('*.py'))
}


def run(*command: str | Path, **kwargs) -> subprocess.CompletedProcess[str]:
    return subprocess.run(
        [str(word) for word in command],
        stderr=subprocess.PIPE,
        text=True,
        timeout=100,
        check=False,
        **{'stdout': subprocess.PIPE, **kwargs},
    )


def loaded_after(code: str) -> set[str]:
    """Top-level names of the modules that a new interpreter has after `code`."""
    ended = run(
        sys.executable,
        '-c',
        f'import sys\n{code}\n'
        'print(*{name.partition(".")[0] for name in sys.modules}, file=sys.stderr)',
        cwd=ROOT,
    )
    assert ended.returncode == 0, ended.stderr
    return set(ended.stderr.splitlines()[-1].split())


def loaded_by(*prefixes: str) -> set[str]:
    """The same after the import of all modules whose names begin so."""
    modules = [name for name in MODULES if name.startswith(prefixes)]
    assert len(modules) >= len(prefixes)
    return loaded_after('\n'.join(f'import {name}' for name in modules))


@functools.cache
def imports(path: Path) -> list[str]:
    """Return absolute names of what a module imports, wherever in it, except for types only."""
    found = []
    todo = [ast.parse(path.read_text())]
    while todo:
        node = todo.pop()
        if isinstance(node, ast.If) and ast.unparse(node.test).endswith('TYPE_CHECKING'):
            todo.extend(node.orelse)
            continue
        if isinstance(node, ast.Import):
            found += [alias.name for alias in node.names]
        elif isinstance(node, ast.ImportFrom):
            assert node.level == 0, f'{path}: relative import'
            found += [f'{node.module}.{alias.name}' for alias in node.names]
        todo.extend(ast.iter_child_nodes(node))
    return found


def module_behind(name: str) -> str:
    """Return the module of this package that the imported `name` is or lies in, or ''."""
    while name and name not in MODULES:
        name = name.rpartition('.')[0]
    return name


def from_setup(field: str) -> str:
    """What setup.py gives for a field of the metadata, one entry a line."""
    printing = (
        'import runpy, setuptools\n'
        'def show(**metadata):\n'
        f'    value = metadata[{field!r}]\n'
        '    print(value if isinstance(value, str) else "\\n".join(value))\n'
        'setuptools.setup = show\n'
        'runpy.run_path("setup.py")'
    )
    ended = run(sys.executable, '-c', printing, cwd=ROOT)
    assert ended.returncode == 0, ended.stderr
    return ended.stdout.strip()


def test_versions_agree(capsys):
    manifest = (ROOT / 'package.xml').read_text()
    version = re.search(r'<version>(.*?)</version>', manifest)[1]
    assert from_setup('version') == version
    laboratory = tomllib.loads((ROOT / LABORATORY / 'pyproject.toml').read_text())['project']
    assert laboratory['version'] == version
    assert laboratory['dependencies'] == [f'{NAME}=={version}']
    releases = re.findall(
        r'^(\d+\.\d+\.\d+) \((\d{4}-\d\d-\d\d)\)\n-+$',
        (ROOT / 'CHANGELOG.rst').read_text(),
        re.MULTILINE,
    )
    assert releases[0][0] == version
    numbers = [tuple(map(int, release.split('.'))) for release, _ in releases]
    days = [day for _, day in releases]
    assert numbers == sorted(numbers, reverse=True) and days == sorted(days, reverse=True)
    assert distribution(NAME).version == version
    assert command_line.main(['--version']) == 0
    assert capsys.readouterr().out == f'rs_relpose {version}\n'


def test_the_maintainer_is_at_no_made_up_host():
    """An address that nobody reads is at .invalid, which never becomes a host (RFC 2606)."""
    address = re.search(r'<maintainer email="(.*?)"', (ROOT / 'package.xml').read_text())[1]
    assert address.endswith('.invalid')
    assert '@' not in from_setup('maintainer')


def test_manifest_names_every_ros_package_that_is_imported():
    manifest = (ROOT / 'package.xml').read_text()
    declared = set(re.findall(r'<(?:exec_)?depend>(.*?)</', manifest))
    used = {name.partition('.')[0] for path in MODULES.values() for name in imports(path)}
    assert {name for name in used if ROS.match(name)} - declared == set()


# Import -> distribution for pip, and rosdep key of package.xml; the others have one name.
LIBRARIES = {
    'cv2': ('opencv-python-headless', 'python3-opencv'),
    'rosbags': ('rosbags', 'python3-rosbags-pip'),
    'yaml': ('pyyaml', 'python3-yaml'),
    # Dependencies of others.
    'llvmlite': ('numba', 'python3-numba'),
    'lz4': ('rosbags', 'python3-rosbags-pip'),
}
OPTIONAL = {'av', 'dask', 'distributed', 'gtsam', 'ncore', 'telemetry_parser'}


def test_pip_and_rosdep_install_every_library_that_is_imported():
    imported = {
        name.partition('.')[0]
        for path in MODULES.values()
        for name in imports(path)
        if path.is_relative_to(ROOT / NAME)
    }
    used = {
        name
        for name in imported - sys.stdlib_module_names - OPTIONAL - {NAME}
        if not ROS.match(name)
    }
    assert {'numpy', 'cv2', 'numba'} < used
    pip, rosdep = zip(
        *(LIBRARIES.get(name, (name, f'python3-{name}')) for name in used), strict=True
    )
    lines = (ROOT / 'requirements' / 'base.txt').read_text().lower().splitlines()
    listed = {re.match(r'[\w-]+', line)[0] for line in lines if not line.startswith(('#', 'ros-'))}
    assert set(pip) == listed - {'setuptools'}
    printed_names = from_setup('install_requires').splitlines()
    assert {re.match(r'[\w-]+', line)[0].lower() for line in printed_names} == listed
    manifest = (ROOT / 'package.xml').read_text()
    keys = set(re.findall(r'<exec_depend>(python3-.*?)</', manifest))
    assert set(rosdep) == keys


@pytest.mark.parametrize(
    'name', [name for name, path in MODULES.items() if '>>> ' in path.read_text()]
)
def test_examples_in_docstrings_are_true(name):
    failed, attempted = doctest.testmod(importlib.import_module(name))
    assert failed == 0 < attempted


def test_the_build_compiles_kernels_of_modules_that_exist():
    table = re.search(r'WARM_UPS = \{(.*?)\}', (ROOT / 'setup.py').read_text(), re.DOTALL)[1]
    warm_ups = re.findall(r"'([\w.]+)': '(?:module\.)?(\w+)\(", table)
    assert len(warm_ups) == 4
    for module, function in warm_ups:
        assert callable(getattr(importlib.import_module(f'{NAME}.{module}'), function))


# Folder -> what its modules may import of the package, besides itself and the modules at the top
# (errors, how kernels are compiled, how files are saved), which import nothing of it.
BASE = {'geometry', 'config', 'core'}
CORE = BASE | {'solvers', 'estimator', 'imu', 'tracking'}
MAY_IMPORT = {
    'geometry': set(),
    'config': {'geometry', 'solvers'},
    'core': {'geometry'},
    'solvers': {'geometry', 'core'},
    'imu': BASE,
    'tracking': BASE,
    'estimator': BASE | {'solvers'},
    'calibration': BASE | {'estimator', 'imu'},
    'pipeline': CORE | {'calibration'},
    'messages': CORE | {'calibration', 'pipeline'},
    'bags': BASE | {'imu', 'tracking', 'messages'},
    'nodes': BASE | {'tracking', 'calibration', 'pipeline', 'messages', 'calibrate', 'odometry'},
    'calibrate': CORE | {'calibration', 'pipeline', 'messages', 'bags'},
    'offline': CORE | {'calibration', 'pipeline', 'messages', 'bags', 'calibrate'},
    'odometry': BASE
    | {'estimator', 'imu', 'tracking', 'calibration', 'pipeline', 'messages', 'bags', 'offline'},
    'report': CORE
    | {'pipeline', 'messages', 'bags', 'calibration', 'calibrate', 'offline', 'odometry'},
    'cli': BASE | {'messages', 'bags', 'offline', 'calibrate', 'odometry', 'report'},
}
# The laboratory uses all of the product, and nothing of the product imports it.
MAY_IMPORT_IN_THE_LABORATORY = {
    'simulation': set(),
    'live': {'simulation'},
    'experiments': {'simulation', 'live'},
    'field': {'simulation', 'live', 'experiments'},
    'cli': {'simulation', 'live', 'experiments', 'field'},
}
FREE_OF_ROS = (
    'geometry',
    'core',
    'config',
    'solvers',
    'estimator',
    'imu',
    'tracking',
    'calibration',
    'pipeline',
    'messages',
)


def room_of(module: str) -> tuple[str, str]:
    """Return package and folder of a module; the folder is '' at the top."""
    package, _, rest = module.partition('.')
    folder = rest.partition('.')[0]
    return package, folder if (ROOT / package / folder).is_dir() else ''


def test_folders_import_what_their_layer_may():
    assert {room_of(name)[1] for name in MODULES if name.startswith(NAME)} == {'', *MAY_IMPORT}
    wrong = []
    for name, path in MODULES.items():
        package, folder = room_of(name)
        for imported in map(module_behind, imports(path)):
            if not imported or room_of(imported) == (package, folder):
                continue
            other, room = room_of(imported)
            if package == LABORATORY:
                allowed = other == NAME or room in {'', *MAY_IMPORT_IN_THE_LABORATORY[folder]}
            else:
                allowed = other == NAME and (room == '' or room in MAY_IMPORT.get(folder, set()))
            if not allowed:
                wrong.append(f'{name} imports {imported}')
    assert wrong == []


def test_no_private_name_crosses_a_folder():
    assert [
        f'{name} imports {imported}'
        for name, path in MODULES.items()
        for imported in imports(path)
        if re.match(rf'({NAME}|{LABORATORY})\..*\b_(?!_)', imported)
        and room_of(module_behind(imported)) != room_of(name)
    ] == []


def test_core_imports_neither_ros_nor_rosbags():
    loaded = loaded_by(*(f'{NAME}.{folder}' for folder in FREE_OF_ROS))
    assert NAME in loaded
    assert {name for name in loaded if ROS.match(name) or name == 'rosbags'} == set()


@pytest.mark.parametrize(
    ('library', 'folders'),
    [
        (ROS, {f'{NAME}/nodes', f'{LABORATORY}/live'}),
        (re.compile('gtsam$'), {f'{NAME}/odometry'}),
        (re.compile('rosbags$'), {f'{NAME}/bags'}),
    ],
)
def test_library_is_imported_in_its_folders_only(library, folders):
    users = {
        path
        for path in MODULES.values()
        if any(library.match(name.partition('.')[0]) for name in imports(path))
    }
    assert users, f'nothing imports {library.pattern}: the test would see nothing'
    assert {str(path.parent.relative_to(ROOT)) for path in users} <= folders


def test_nodes_start_without_the_slow_parts_of_scipy():
    """They would take half of the processor time of the imports of a node."""
    pytest.importorskip('rclpy')
    nodes = ('relpose_node', 'odometry_node', 'global_shutter_node')
    code = '\n'.join(f'import {NAME}.nodes.{node}' for node in nodes)
    slow = ('scipy.signal', 'scipy.stats', 'scipy.optimize')
    loaded_after(f'{code}\nassert not {{*{slow!r}}} & {{*sys.modules}}')


def test_gtsam_is_imported_where_odometry_runs_only():
    loaded = loaded_by(f'{NAME}.cli', f'{NAME}.nodes', f'{NAME}.odometry.pair')
    assert 'rclpy' in loaded
    assert 'gtsam' not in loaded


def test_all_tests_are_found_where_no_extra_is_installed():
    """As on a ROS machine, where rosdep has installed what package.xml names."""
    extras = ('av', 'dask', 'distributed', 'gtsam', 'ncore', 'playwright', 'telemetry_parser')
    code = f"""
import sys
import pytest
sys.modules.update(dict.fromkeys({extras}))
sys.exit(pytest.main(['--collect-only', '-q', '-p', 'no:xdist', '-p', 'no:cacheprovider', 'test']))
"""
    ended = run(sys.executable, '-c', code, cwd=ROOT)
    assert ended.returncode == 0, ended.stdout[-2000:]


def test_modules_import_each_other_without_cycles():
    graph = {
        name: {module_behind(imported) for imported in imports(path)} - {name, ''}
        for name, path in MODULES.items()
    }
    assert len(graph) > 10
    graphlib.TopologicalSorter(graph).prepare()  # CycleError names the cycle


def test_the_library_does_not_print_or_exit():
    """Only the command line and the node's main do (what ruff's T20 cannot see: sys.exit)."""
    exits = [
        f'{path.relative_to(ROOT)}:{node.lineno}'
        for path in MODULES.values()
        if path.parent.name not in ('cli', 'nodes', 'live')
        for node in ast.walk(ast.parse(path.read_text()))
        if isinstance(node, ast.Call)
        and ast.unparse(node.func) in ('sys.exit', 'exit', 'quit', 'os._exit', 'print')
    ]
    assert exits == []


@pytest.mark.parametrize(
    'script', ['relpose_node', 'global_shutter_node', 'odometry_node', 'rs_relpose']
)
def test_console_script_resolves(script):
    entries = {
        entry.name: entry
        for entry in distribution(NAME).entry_points
        if entry.group == 'console_scripts'
    }
    assert callable(entries[script].load())


@pytest.mark.parametrize('name', command_line.COMMANDS)
def test_command_describes_itself(name, capsys, monkeypatch):
    monkeypatch.setenv('COLUMNS', '400')  # no line breaks inside of what is looked for
    assert command_line.main([name, '--help']) == 0
    shown = ' '.join(capsys.readouterr().out.split())
    assert f'rs_relpose {name}' in shown
    assert command_line.load_command(name).HELP.partition('\n')[0] in shown


def test_overview_names_every_command_and_imports_none():
    ended = run(
        sys.executable, '-m', f'{NAME}.cli.main', '--help', env={**os.environ, 'COLUMNS': '400'}
    )
    assert ended.returncode == 0
    for name, (_, one_line) in command_line.COMMANDS.items():
        assert re.search(rf'{name}\s+{one_line}', ' '.join(ended.stdout.split()))
    package = loaded_after(f'import {NAME}')
    overview = loaded_after(f'import {NAME}.cli.main as m; m.main(["--help"])')
    slow = {'numpy', 'scipy', 'cv2', 'numba', 'rosbags', 'matplotlib'}
    assert (overview - package) & slow == set()


@pytest.mark.parametrize('arguments', [[], ['nonsense'], ['--nonsense'], ['-v']])
def test_bad_usage(arguments, capsys):
    assert command_line.main(arguments) == 2
    assert 'rs_relpose: error: ' in capsys.readouterr().err


def test_a_command_line_without_words_lists_the_commands(capsys):
    assert command_line.main([]) == 2
    shown = capsys.readouterr().err
    assert 'estimate relative poses from a bag' in shown
    assert shown.endswith('rs_relpose: error: give one of these commands\n')


def test_a_node_without_ros_says_what_to_do():
    code = """
import importlib.util as util
found = util.find_spec
util.find_spec = lambda name, *of: None if name == 'rclpy' else found(name, *of)
from rs_relpose_ros.nodes.start import relpose_node
relpose_node()
"""
    ended = run(sys.executable, '-c', code)
    assert ended.returncode == 2 and ended.stdout == ''
    assert ended.stderr.startswith('relpose_node: error: this Python finds no ROS 2 (rclpy)')
    assert ended.stderr.count('\n') == 1


@pytest.fixture
def as_replay(monkeypatch):
    """Makes a function the work of the command."""

    def install(work):
        command = SimpleNamespace(
            HELP='stand in',
            run=work,
            add_arguments=(lambda parser: parser.add_argument('number', type=int)),
            optional_values={},
        )
        monkeypatch.setattr(command_line, 'load_command', lambda name: command)

    return install


@pytest.mark.parametrize(
    ('words', 'code'),
    [
        (['replay', '0'], 0),
        (['replay', '3'], 3),
        (['-v', 'replay', '3'], 13),
        (['replay', '-v', '3'], 13),
    ],
)
def test_command_gets_its_arguments_and_gives_the_exit_code(words, code, as_replay):
    as_replay(lambda args: args.number + 10 * args.verbose)
    assert command_line.main(words) == code


@pytest.mark.parametrize(
    ('error', 'code', 'line'),
    [
        (InputError('the bag\nends early'), 2, 'rs_relpose: error: the bag ends early\n'),
        (MissingInputError('no topic'), 2, 'rs_relpose: error: no topic\n'),
        (
            FileNotFoundError(2, 'No such file or directory', 'x.bag'),
            2,
            'rs_relpose: error: x.bag: No such file or directory\n',
        ),
        (
            OSError(28, 'No space left on device'),
            1,
            'rs_relpose: error: [Errno 28] No space left on device\n',
        ),
        (
            OSError(28, 'No space left on device', 'out/errors.csv'),
            1,
            'rs_relpose: error: out/errors.csv: No space left on device\n',
        ),
        (KeyboardInterrupt(), 130, 'rs_relpose: interrupted\n'),
    ],
)
def test_error_is_one_line_and_an_exit_code(error, code, line, as_replay, capsys):
    def work(args):
        raise error

    as_replay(work)
    assert command_line.main(['replay', '1']) == code
    assert capsys.readouterr().err == line


def test_programming_error_is_one_line_with_the_file_of_a_report(
    as_replay, capsys, tmp_path, monkeypatch
):
    monkeypatch.setattr(tempfile, 'tempdir', str(tmp_path))
    as_replay(lambda args: args.no_such_argument)
    assert command_line.main(['replay', '1']) == command_line.FAILED
    error = capsys.readouterr().err
    (report,) = tmp_path.iterdir()
    assert error.startswith('rs_relpose: internal error (AttributeError)')
    assert error.endswith(f' {report}\n') and error.count('\n') == 1
    text = report.read_text()
    assert text.startswith('rs_relpose replay 1\n')
    for words in (f'python {platform.python_version()}', f'numpy {np.__version__}', 'Traceback'):
        assert words in text
    assert 'no_such_argument' in text
    monkeypatch.setattr(tempfile, 'tempdir', str(tmp_path / 'absent'))
    assert command_line.main(['replay', '1']) == command_line.FAILED
    assert capsys.readouterr().err.endswith(' -vv\n')


@pytest.mark.parametrize(
    ('words', 'lens', 'bag'),
    [
        (['--lens', 'my_bag'], 'plumb_bob', 'my_bag'),
        (['my_bag', '--lens'], 'plumb_bob', 'my_bag'),
        (['--lens', 'equidistant', 'my_bag'], 'equidistant', 'my_bag'),
        (['--lens=equidistant', 'my_bag'], 'equidistant', 'my_bag'),
        (['--lens', '--rows', '0', '9', 'my_bag'], 'plumb_bob', 'my_bag'),
    ],
)
def test_an_optional_value_does_not_swallow_the_bag(words, lens, bag):
    words = command_line.with_optional_values(
        ['calibrate', *words], command_line.load_command('calibrate')
    )
    args = command_line.make_parser('calibrate').parse_args(words)
    assert (args.lens, str(args.bag)) == (lens, bag)


def test_closed_pipe_is_quiet():
    reader, writer = os.pipe()
    os.close(reader)
    # Unbuffered, argparse itself would swallow the error.
    environment = {key: value for key, value in os.environ.items() if key != 'PYTHONUNBUFFERED'}
    with os.fdopen(writer, 'w') as pipe:
        ended = run(
            sys.executable, '-m', f'{NAME}.cli.main', '--help', stdout=pipe, env=environment
        )
    assert ended.returncode == command_line.PIPE_CLOSED
    assert ended.stderr == ''


@pytest.mark.parametrize('given, after', [({}, '1'), ({'OPENBLAS_NUM_THREADS': '2'}, '2')])
@pytest.mark.parametrize('entry', ['main(["--version"])', 'start("made_up")'])
def test_linear_algebra_has_one_thread_where_the_process_is_ours(entry, given, after):
    """Set before NumPy is there, which reads it once."""
    code = f"""
import os, sys, types
from rs_relpose_ros.cli.main import main
from rs_relpose_ros.nodes.start import start

def tell(on_started=None):
    print(os.environ["OPENBLAS_NUM_THREADS"], flush=True)
    os._exit(0)


assert "numpy" not in sys.modules
sys.modules["rs_relpose_ros.nodes.made_up"] = types.SimpleNamespace(main=tell)
{entry}
tell()
"""
    others = {key: value for key, value in os.environ.items() if not key.endswith('_NUM_THREADS')}
    ended = run(sys.executable, '-c', code, env=others | given)
    assert ended.stdout.splitlines()[-1] == after


# -- As a ROS machine has it: built by colcon, run from the install space --------------------

KERNELS = Path(NAME) / '__pycache__' / 'kernels'


def tracked_files() -> list[Path]:
    if not (ROOT / '.git').exists() or shutil.which('git') is None:
        pytest.skip('no git checkout: the tracked files are unknown')
    listed = subprocess.run(
        ['git', 'ls-files', '-z'], cwd=ROOT, capture_output=True, text=True, check=True
    ).stdout
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
        [colcon, 'build', '--event-handlers', 'console_direct+'],
        cwd=workspace,
        stdout=subprocess.PIPE,
        stderr=subprocess.STDOUT,
        text=True,
        timeout=110,
        check=False,
    )
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
    return [
        'bash',
        '-c',
        'source "$0/local_setup.bash" && exec "$@"',
        str(install_space),
        *command,
    ]


def printed(install_space: Path, *command: str) -> str:
    """Output of a command in the install space, which must succeed."""
    ended = subprocess.run(
        in_install_space(install_space, *command),
        cwd=install_space,
        capture_output=True,
        text=True,
        timeout=100,
        check=False,
    )
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
        install_space,
        sys.executable,
        '-c',
        f'import {NAME}; print({NAME}.__path__[0]);'
        'from ament_index_python import get_package_share_directory as share;'
        f'print(share("{NAME}"))',
    )
    library, found = map(Path, located.splitlines())
    assert found == share / NAME
    assert library.is_relative_to(install_space)
    missing = [
        str(name)
        for name in tracked_files()
        if (name.parts[0] == NAME and not (library.parent / name).is_file())
        or (
            name.parts[0] in ('config', 'launch')
            and not name.name.startswith('.')
            and not (share / NAME / name).is_file()
        )
    ]
    assert missing == []
    # The laboratory is another distribution, which a robot does not carry.
    assert not (library.parent / LABORATORY).exists()


def test_the_laboratory_lists_all_its_packages():
    described = tomllib.loads((ROOT / LABORATORY / 'pyproject.toml').read_text())
    folders = {path.parent for path in (ROOT / LABORATORY).rglob('__init__.py')}
    found = {'.'.join(path.relative_to(ROOT).parts) for path in folders}
    assert set(described['tool']['setuptools']['packages']) == found


def test_first_start_compiles_nothing_and_the_command_line_runs(install_space):
    loaded, compiled = map(int, printed(install_space, sys.executable, '-c', FIRST_START).split())
    assert loaded > 20
    assert compiled == 0
    assert 'replay' in printed(install_space, executable(install_space, 'rs_relpose'), '--help')


def test_node_starts_and_stops(install_space, ros_domain_id):
    from diagnostic_msgs.msg import DiagnosticArray

    from rs_relpose_lab.live.graph import Graph
    from rs_relpose_lab.live.processes import Process, wait_until

    command = in_install_space(
        install_space,
        executable(install_space, 'relpose_node'),
        '--ros-args',
        '-r',
        '__node:=installed',
        '-p',
        'readout_time:=0.03',
    )
    with (
        Graph() as graph,
        Process('-c', 'import os, sys; os.execvp("bash", sys.argv[1:])', *command) as node,
    ):
        received = graph.listen(DiagnosticArray, '/diagnostics')
        wait_until(lambda: received, 'diagnostics', node)
        assert received[0].status[0].name.startswith('/installed: ')
        assert node.signal(signal.SIGINT)[0] == 0
        assert 'Traceback' not in node.output
