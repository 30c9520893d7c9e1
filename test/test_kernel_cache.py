"""Where compiled kernels lie: found again after a move, never used for another source."""

from __future__ import annotations

import json
import os
from pathlib import Path
import shutil
import subprocess
import sys

from conftest import ROOT
import pytest
from test_package import imports, module_behind, MODULES, NAME

from rs_relpose_ros.kernel_cache import source_digest

# A package of this name with two kernels, one of which calls the other.
INNER = """
from rs_relpose_ros.compiled import kernel

@kernel
def inner(x):
    return 2.0 * x
"""
OUTER = """
from rs_relpose_ros.compiled import kernel
from rs_relpose_ros.inner import inner

@kernel
def outer(x):
    return inner(x) + 1.0
"""
# Calls both and says what was loaded and what compiled. Root may write anywhere, so a read-only
# folder is played to this process.
PROGRAM = """
import json, os, sys
if sys.argv[1] == 'read-only':
    os.access = lambda path, mode: False
from rs_relpose_ros.inner import inner
from rs_relpose_ros.outer import outer
result = [outer(3.0), inner(3.0)]
print(json.dumps([*result, *(sum(sum(getattr(k.stats, kind).values()) for k in (inner, outer))
                             for kind in ('cache_hits', 'cache_misses'))]))
"""
HITS, COMPILED = [7.0, 6.0, 2, 0], [7.0, 6.0, 0, 2]


@pytest.fixture(scope='module')
def built(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The folder that holds the package and its compiled kernels."""
    folder = tmp_path_factory.mktemp('built')
    (folder / NAME).mkdir()
    for name in ('compiled.py', 'kernel_cache.py'):
        shutil.copy(ROOT / NAME / name, folder / NAME)
    (folder / NAME / '__init__.py').touch()
    (folder / NAME / 'inner.py').write_text(INNER)
    (folder / NAME / 'outer.py').write_text(OUTER)
    assert run(folder) == COMPILED
    return folder


@pytest.fixture
def package(built: Path, tmp_path: Path) -> Path:
    """The package where it is installed; files with other times, as pip unpacks a wheel."""
    return shutil.copytree(built, tmp_path / 'installed', copy_function=shutil.copyfile)


def start(package: Path, how: str = 'writable', **environment: str) -> subprocess.Popen[str]:
    clean = {key: value for key, value in os.environ.items()
             if not key.startswith(('NUMBA_', 'XDG_'))}
    return subprocess.Popen(
        [sys.executable, '-c', PROGRAM, how], cwd=package, text=True, stdout=subprocess.PIPE,
        env={**clean, 'HOME': str(package.parent / 'home'), **environment})


def result(process: subprocess.Popen[str]) -> list[float]:
    """Results of the two kernels, how many were loaded, how many compiled."""
    out, _ = process.communicate(timeout=110)
    assert process.returncode == 0
    return json.loads(out)


def run(package: Path, how: str = 'writable', **environment: str) -> list[float]:
    return result(start(package, how, **environment))


def files(folder: Path) -> dict[str, int]:
    return {str(path): path.stat().st_mtime_ns for path in folder.rglob('*.nb?')}


def test_kernels_are_found_where_the_package_is_installed(package):
    assert run(package) == HITS
    assert run(package, NUMBA_CACHE_DIR=str(package.parent / 'other')) == COMPILED


def test_a_changed_callee_is_compiled_into_its_callers(package):
    (package / NAME / 'inner.py').write_text(INNER.replace('2.0', '5.0'))
    assert run(package) == [16.0, 15.0, 0, 2]
    # Only what is concerned. Another second, or Python takes its own cache of the file before.
    outer = package / NAME / 'outer.py'
    outer.write_text(OUTER.replace('1.0', '2.0'))
    os.utime(outer, (0.0, outer.stat().st_mtime + 2.0))
    assert run(package) == [17.0, 15.0, 1, 1]


def test_a_read_only_package_is_copied_for_its_user(package, tmp_path):
    before = files(package)
    assert before
    # Another processor than the builder's: compiled once, and kept by the user.
    assert run(package, 'read-only', NUMBA_CPU_NAME='generic') == COMPILED
    assert run(package, 'read-only', NUMBA_CPU_NAME='generic') == HITS
    assert run(package, 'read-only') == HITS
    assert files(package) == before
    assert files(tmp_path / 'home' / '.cache' / NAME)


def test_a_user_without_a_home(package, tmp_path):
    (tmp_path / 'file').touch()
    (tmp_path / 'tmp').mkdir()
    assert run(package, 'read-only', HOME=str(tmp_path / 'file' / 'home'),
               TMPDIR=str(tmp_path / 'tmp')) == HITS


def test_two_processes_start_together(package):
    shutil.rmtree(package / NAME / '__pycache__' / 'kernels')
    both = [start(package) for _ in range(2)]
    assert [result(process)[:2] for process in both] == [[7.0, 6.0]] * 2
    assert run(package) == HITS


def test_every_import_of_a_kernels_module_counts(monkeypatch):
    """What `source_digest` finds by a pattern is what the parser finds."""
    def reached(module: str) -> set[str]:
        found = {module_behind(name) for name in imports(MODULES[module])} - {''}
        return found.union(*map(reached, found))

    with_kernels = [name for name, path in MODULES.items()
                    if 'rs_relpose_ros.compiled import' in path.read_text()]
    assert len(with_kernels) > 20
    read_bytes, read = Path.read_bytes, set()
    monkeypatch.setattr(Path, 'read_bytes', lambda path: (read.add(path), read_bytes(path))[1])
    for module in with_kernels:
        __import__(module)
        source_digest.cache_clear()
        read.clear()
        source_digest(module)
        assert read == {MODULES[name] for name in {module, *reached(module)}}
