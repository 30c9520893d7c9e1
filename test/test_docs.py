"""The documents: links, public names with examples, the HTML pages, tutorials that run."""

import doctest
from functools import cache
import inspect
from pathlib import Path
import re
import shlex
import subprocess
import sys
from types import ModuleType
from urllib.parse import unquote

from conftest import ROOT
from fault_stream import BAG_TOPICS
import logged_walks as made
import pytest
import yaml

from rs_relpose_lab.simulation.bag import write_bag, write_parameters
from rs_relpose_lab.simulation.config import SimulationConfig
from rs_relpose_lab.simulation.simulation import simulate
import rs_relpose_ros
from rs_relpose_ros import solvers
from rs_relpose_ros.cli import main as command_line

PAGES = sorted(
    path
    for path in ROOT.rglob('*.md')
    if not any(part.startswith('.venv') or part in ('build', 'install') for part in path.parts)
)
API = ROOT / 'docs' / 'api.md'

# -- Links ------------------------------------------------------------------------------------

CODE = re.compile(
    r'^(?:```|~~~).*?^(?:```|~~~)|^(?:    .*\n)+|`[^`\n]*`', re.DOTALL | re.MULTILINE
)
LINK = re.compile(r'\]\(([^)\s]+)\)')


@cache
def anchors(path: Path) -> frozenset[str]:
    """Anchors of the headings of a page, as sites that host repositories make them."""
    text = re.sub(r'^```.*?^```', '', path.read_text(encoding='utf-8'), flags=re.DOTALL | re.M)
    found: list[str] = []
    for heading in re.findall(r'^#+ +(.+?) *$', text, re.MULTILINE):
        plain = re.sub(r'\[([^\]]*)\]\([^)]*\)', r'\1', heading).lower()
        slug = re.sub(r'[^\w\- ]', '', plain).replace(' ', '-')
        found.append(slug if slug not in found else f'{slug}-{found.count(slug)}')
    return frozenset(found)


def dead_links(path: Path, text: str) -> list[str]:
    """Relative links of a page that lead to no file, or to no heading of it."""
    dead = []
    for link in LINK.findall(CODE.sub('', text)):
        if re.match(r'[a-z]+:', link):
            continue
        name, _, anchor = unquote(link).partition('#')
        target = (path.parent / name).resolve() if name else path
        if not target.exists() or (
            anchor and target.suffix == '.md' and anchor not in anchors(target)
        ):
            dead.append(link)
    return dead


@pytest.mark.parametrize('path', PAGES, ids=lambda path: path.relative_to(ROOT).as_posix())
def test_links_lead_somewhere(path):
    assert dead_links(path, path.read_text(encoding='utf-8')) == []


def test_dead_links_are_found():
    text = '[a](no_such.md) [b](docs/live.md#no-such) [c](docs/live.md) `[d](x.md)` [e](https://x)'
    assert dead_links(ROOT / 'README.md', text) == ['no_such.md', 'docs/live.md#no-such']


# -- Public names -----------------------------------------------------------------------------

PUBLIC = [(rs_relpose_ros, name) for name in rs_relpose_ros.__all__] + [
    (solvers, name) for name in solvers.__all__
]


@pytest.mark.parametrize(
    ('module', 'name'), PUBLIC, ids=lambda value: getattr(value, '__name__', value)
)
def test_a_public_name_is_documented_with_an_example(module: ModuleType, name: str):
    text = API.read_text(encoding='utf-8')
    assert re.search(rf'^\.\. auto(?:class|function|exception):: {name}$', text, re.MULTILINE)
    examples = '\n'.join(re.findall(r'^(?:>>>|\.\.\.).*$', text, re.MULTILINE))
    assert re.search(rf'\b{name}\b(?=[.(]|\)|,.*\))', examples), 'no example uses it'
    described = inspect.getdoc(getattr(module, name)) or ''
    assert re.search(r'^[A-Z].*\.$', described.partition('\n\n')[0], re.DOTALL)


def test_the_examples_of_the_python_interface_are_true(monkeypatch):
    monkeypatch.chdir(ROOT)
    ended = doctest.testfile(str(API), module_relative=False, optionflags=doctest.ELLIPSIS)
    assert ended.failed == 0 < ended.attempted


# -- HTML -------------------------------------------------------------------------------------


@pytest.fixture(scope='module')
def pages(tmp_path_factory):
    """Folder of the HTML pages."""
    pytest.importorskip('sphinx', reason='sphinx is not installed: make docs installs it')
    pytest.importorskip('myst_parser', reason='myst_parser is not installed')
    options = ['--fail-on-warning', '--keep-going', '--quiet', '-b', 'html']
    folder = tmp_path_factory.mktemp('pages')
    folders = ['-d', str(folder / 'doctrees'), 'docs', str(folder / 'html')]
    built = subprocess.run(
        [sys.executable, '-m', 'sphinx', *options, *folders],
        cwd=ROOT,
        capture_output=True,
        text=True,
        timeout=110,
        check=False,
    )
    assert (built.returncode, built.stderr) == (0, '')
    return folder / 'html'


def test_the_pages_are_built_without_a_warning(pages):
    front = (pages / 'index.html').read_text(encoding='utf-8')
    assert 'I have a camera' in front and '<img' in front
    api = (pages / 'api.html').read_text(encoding='utf-8')
    assert [name for _, name in PUBLIC if f'>{name}<' not in api] == []
    loaded = re.findall(r'(?:src|href)="(https?://[^"]+\.(?:js|css))', front + api)
    assert loaded == []


@pytest.mark.parametrize('name', ['index', 'api', 'health', 'lab/evaluation'])
def test_pages_are_no_wider_than_a_phone(name, pages, browser):
    context = browser.new_context(viewport={'width': 400, 'height': 900}, offline=True)
    tab = context.new_page()
    tab.goto((pages / f'{name}.html').as_uri())
    assert tab.evaluate('document.documentElement.scrollWidth') <= 400
    # The text comes before the navigation.
    text, navigation = (
        tab.locator(part).bounding_box()['y'] for part in ('div.body', 'div.sphinxsidebar')
    )
    assert text < navigation
    context.close()


# -- Versions that are written twice ------------------------------------------------------------


def test_hooks_and_extras_have_the_versions_of_the_requirements():
    def listed(name: str) -> set[str]:
        lines = (ROOT / 'requirements' / name).read_text(encoding='utf-8').splitlines()
        return {line for line in lines if line and not line.startswith(('#', '-r'))}

    hooks = yaml.safe_load((ROOT / '.pre-commit-config.yaml').read_text(encoding='utf-8'))
    needed = {
        one
        for hook in hooks['repos'][0]['hooks']
        for one in hook['additional_dependencies']
        if one.startswith('ruff')
    }
    assert len(needed) == 1 and needed <= listed('test.txt')
    setup = (ROOT / 'setup.py').read_text(encoding='utf-8')
    extra = re.search(r"'docs': \[(.*?)\]", setup)[1]
    assert set(re.findall(r"'([^']+)'", extra)) == listed('docs.txt')


def test_workflows_and_templates_are_yaml_and_call_what_exists():
    files = [*(ROOT / '.github').rglob('*.yml'), ROOT / 'rosdoc2.yaml']
    assert len(files) >= 6
    for file in files:
        assert list(yaml.safe_load_all(file.read_text(encoding='utf-8')))
    steps = '\n'.join(file.read_text(encoding='utf-8') for file in files)
    for script in re.findall(r'\.ci/\w+', steps):
        assert (ROOT / script).stat().st_mode & 0o111
    targets = re.findall(r'run: make (\w+)', steps)
    makefile = (ROOT / 'Makefile').read_text(encoding='utf-8')
    assert targets and all(re.search(rf'^{one}:', makefile, re.MULTILINE) for one in targets)


# -- Commands ---------------------------------------------------------------------------------


def commands_of(path: Path) -> list[list[str]]:
    """Command lines of `rs_relpose` on a page, as words."""
    text = path.read_text(encoding='utf-8').replace('\\\n', ' ')
    lines = re.findall(r'^(?: {4})?(rs_relpose \w.*)$', text, re.MULTILINE)
    return [shlex.split(re.sub(r'\s+#.*| +\.\.\.$', '', line)) for line in lines]


@pytest.mark.parametrize(
    ('path', 'words'),
    [
        pytest.param(path, words, id=f'{path.stem}: {" ".join(words[1:3])}')
        for path in (ROOT / 'README.md', *sorted((ROOT / 'docs').glob('*.md')))
        for words in commands_of(path)
        if not any(set(word) & set('[]|') for word in words)
    ],
)
def test_a_command_on_a_page_has_these_options(path, words):
    words = [re.sub(r'^(?:HZ|N)$', '5', word) for word in words[1:]]
    parser = command_line.make_parser(words[0])
    assert parser.parse_args(words).command == words[0]


# Short, small and slow, so that each command takes a second or two.
WALK = {**made.OF_WALK, 'duration': 6.0, 'plan': 'walk:6.0', 'fps': 10.0, 'imu_rate': 200.0}


@pytest.fixture(scope='module')
def recorded(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The inputs that the tutorials name."""
    quaternion = tuple(float(value) for value in made.PHONE_AXES.as_quat().round(9))
    walk = simulate(
        SimulationConfig(**WALK, quat_cam_imu_xyzw=quaternion, lever_arm=(0.0, 0.0, 0.0))
    )
    folder = tmp_path_factory.mktemp('recorded')
    made.tables(folder / 'my_phone', walk)
    made.euroc(folder / 'MH_01', walk)
    (folder / 'bags').mkdir()
    write_bag(walk, folder / 'bags' / 'hand_held')
    write_parameters(walk, folder / 'bags' / 'hand_held.yaml')
    (folder / 'orbslam3.yaml').write_text(ORBSLAM3)
    return folder


@pytest.fixture
def inputs(recorded, tmp_path, monkeypatch) -> Path:
    """An own current directory with links to them."""
    monkeypatch.chdir(tmp_path)
    for path in recorded.iterdir():
        (tmp_path / path.name).symlink_to(path)
    return tmp_path


ORBSLAM3 = """%YAML:1.0
File.version: "1.0"
Camera.type: "PinHole"
Camera1.fx: 140.0
Camera1.fy: 140.0
Camera1.cx: 96.0
Camera1.cy: 72.0
Camera.width: 192
Camera.height: 144
IMU.T_b_c1: !!opencv-matrix
   rows: 4
   cols: 4
   dt: f
   data: [0.0, -1.0, 0.0, 0.0, -1.0, 0.0, 0.0, 0.0, 0.0, 0.0, -1.0, 0.0, 0.0, 0.0, 0.0, 1.0]
"""
# What a tutorial leaves behind.
RESULTS = {
    'phone_video': ['walk.yaml', 'report.html', 'poses/summary.json', 'path/trajectory.tum'],
    'euroc_folder': ['mh01.yaml', 'poses/errors.csv', 'my_camera.yaml'],
    'bag_to_colmap': ['model/sparse/0/images.txt', 'poses.tum'],
    'beside_a_slam_system': [
        'my_camera.yaml',
        'calibration/calibration.yaml',
        'derotated/metadata.yaml',
    ],
}


@pytest.mark.parametrize('name', RESULTS)
def test_the_commands_of_a_tutorial_run(name, inputs, capsys):
    text = (ROOT / 'docs' / 'tutorials' / f'{name}.md').read_text(encoding='utf-8')
    blocks = re.findall(r'^```bash\n(.*?)^```', text, re.DOTALL | re.MULTILINE)
    lines = [line for block in blocks for line in block.splitlines()]
    assert len(lines) >= 3
    if any('odometry' in line for line in lines):
        pytest.importorskip('gtsam', reason='needs the extra odometry')
    for line in lines:
        words = shlex.split(line)
        assert words[0] == 'rs_relpose'
        assert command_line.main(words[1:]) == 0, (line, capsys.readouterr())
    missing = [one for one in RESULTS[name] if not (inputs / one).exists()]
    assert missing == []


# -- The first hour of the README ---------------------------------------------------------------


def test_the_readme_is_short():
    assert len((ROOT / 'README.md').read_text(encoding='utf-8').splitlines()) <= 250


def test_the_first_hour_clones_and_starts_what_exists(tmp_path):
    """Its `git clone`, run; the topics of its node, those of the live tests."""
    text = (ROOT / 'README.md').read_text(encoding='utf-8').replace('\\\n', ' ')
    [clone] = re.findall(r'git clone \S+ \S+', text)
    if not (ROOT / '.git').exists():
        pytest.skip('no git checkout: nothing to clone')
    words = clone.replace('~', str(tmp_path)).split()
    subprocess.run(words, cwd=ROOT, check=True, capture_output=True, timeout=60)
    copy = Path(words[-1])
    assert copy.name == 'rs_relpose_ros' and copy.parent.name == 'src'
    assert (copy / 'package.xml').is_file()

    started = re.search(r'ros2 run rs_relpose_ros relpose_node --ros-args(.*)', text)[1]
    assert dict(re.findall(r'-r (\w+):=(\S+)', started)) == BAG_TOPICS
    recorded = re.search(r'ros2 bag record (.*)', text)[1].split()
    assert {topic.removesuffix('/compressed') for topic in recorded} >= set(BAG_TOPICS.values())
    setup = (ROOT / 'setup.py').read_text(encoding='utf-8')
    nodes = set(re.findall(r'ros2 run rs_relpose_ros (\w+)', text))
    assert nodes and all(f"'{node} = " in setup for node in nodes)
