"""How the house is built: sizes of folders, modules and functions, and the words that are used."""

import ast
from collections import Counter
from collections.abc import Iterator
from pathlib import Path
import re

from conftest import ROOT
import pytest

PACKAGE = 'rs_relpose_ros'
MODULES = {path.relative_to(ROOT): path.read_text(encoding='utf-8')
           for top in (PACKAGE, 'rs_relpose_lab', 'test') for path in (ROOT / top).rglob('*.py')}
OF_PACKAGE = {path: text for path, text in MODULES.items() if path.parts[0] == PACKAGE}

# Folder -> most lines and modules. A larger number needs its reason in the commit that raises it.
BUDGETS = {
    'rs_relpose_ros': (315, 5),
    'rs_relpose_ros/bags': (1445, 5),
    'rs_relpose_ros/calibrate': (2835, 8),
    'rs_relpose_ros/cli': (1485, 6),
    'rs_relpose_ros/config': (808, 3),
    'rs_relpose_ros/estimator': (3851, 12),
    'rs_relpose_ros/geometry': (1268, 6),
    'rs_relpose_ros/imu': (1195, 4),
    'rs_relpose_ros/messages': (1442, 5),
    'rs_relpose_ros/nodes': (2264, 9),
    'rs_relpose_ros/odometry': (3028, 11),
    'rs_relpose_ros/offline': (1838, 8),
    'rs_relpose_ros/pipeline': (3536, 12),
    'rs_relpose_ros/solvers': (1212, 6),
    'rs_relpose_ros/tracking': (1224, 5),
    'rs_relpose_lab': (9950, 49),
    'test': (18500, 49),
}
MOST_MODULES, MOST_FOLDERS = 110, 15
LONGEST_MODULE, SHORTEST_MODULE, LONGEST_FUNCTION = 700, 80, 60
# Body of a private function that has one caller: shorter ones belong into the caller.
SHORTEST_HELPER = 4

# Words of no textbook, each replaced by a term of the field (docs/architecture.md, "Words").
BANNED = re.compile(r'\b(?:told|figures?|seen|judged|anew|sentences?)\b', re.IGNORECASE)
# What users have in scripts keeps its words: JSON keys, a status, an option; a library's class.
INTERFACE = re.compile(
    r"""['"`](?:told|seen|figures?|sentence)['"`]|['"`]told\ wrong['"`]|--figures\b
    |matplotlib\.figure|\bFigure\b(?=$|[(:,)])""", re.VERBOSE)
PROSE = (*sorted((ROOT / 'docs').rglob('*.md')), ROOT / 'README.md')


def folder_of(path: Path) -> str:
    return path.parent.as_posix() if path.parts[0] == PACKAGE else path.parts[0]


def functions(text: str) -> Iterator[ast.FunctionDef]:
    return (node for node in ast.walk(ast.parse(text)) if isinstance(node, ast.FunctionDef))


def body_lines(function: ast.FunctionDef) -> int:
    """Lines of a function without its head and docstring."""
    body = function.body[ast.get_docstring(function) is not None:]
    return 0 if not body else (body[-1].end_lineno or 0) - body[0].lineno + 1


@pytest.mark.parametrize('folder', BUDGETS)
def test_folder_is_within_its_budget(folder):
    texts = [text for path, text in MODULES.items() if folder_of(path) == folder]
    lines, modules = BUDGETS[folder]
    assert sum(text.count('\n') for text in texts) <= lines
    assert len(texts) <= modules


def test_every_folder_has_a_budget():
    assert {folder_of(path) for path in MODULES} == set(BUDGETS)
    of_package = [count for folder, (_, count) in BUDGETS.items() if folder.startswith(PACKAGE)]
    assert len(of_package) <= MOST_FOLDERS
    assert len(OF_PACKAGE) <= MOST_MODULES


def test_modules_are_neither_long_nor_tiny():
    importers = Counter(
        name for path, text in MODULES.items() if path.parts[0] != 'test'
        for name in set(re.findall(rf'\b{PACKAGE}(?:\.\w+)+', text)))
    lengths = {path: text.count('\n') for path, text in OF_PACKAGE.items()
               if path.name != '__init__.py'}
    assert [str(path) for path, lines in lengths.items() if lines > LONGEST_MODULE] == []
    tiny = ['.'.join(path.with_suffix('').parts)
            for path, lines in lengths.items() if lines < SHORTEST_MODULE]
    entries = (ROOT / 'setup.py').read_text(encoding='utf-8')   # console scripts
    assert [name for name in tiny if importers[name] < 2 and name not in entries] == []


def test_functions_are_short():
    long = [f'{path}:{function.lineno} {function.name}'
            for path, text in OF_PACKAGE.items() for function in functions(text)
            if (function.end_lineno or 0) - function.lineno >= LONGEST_FUNCTION]
    assert long == []


def test_short_helpers_have_two_callers():
    """What has one caller and a body of three lines is read sooner in its caller."""
    names = Counter(name for text in OF_PACKAGE.values() for name in re.findall(r'\b_\w+', text))
    calls = Counter(name for text in OF_PACKAGE.values()
                    for name in re.findall(r'\b(_\w+)\(', text))
    short = [f'{path}:{function.lineno} {function.name}'
             for path, text in OF_PACKAGE.items() for function in functions(text)
             if re.match('_[^_]', function.name) and not function.decorator_list
             and body_lines(function) < SHORTEST_HELPER
             and names[function.name] == calls[function.name] == 2]   # definition and call
    assert short == []


@pytest.mark.parametrize('path', [*(ROOT / path for path in OF_PACKAGE), *PROSE],
                         ids=lambda path: path.relative_to(ROOT).as_posix())
def test_words_are_those_of_the_field(path):
    lines = path.read_text(encoding='utf-8').splitlines()
    assert [f'{number}: {line.strip()}' for number, line in enumerate(lines, start=1)
            if BANNED.search(INTERFACE.sub('', line))] == []
