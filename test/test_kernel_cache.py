"""Compiled kernels: found after a move, never used for another source; none after the warm-up."""

import functools
import json
import os
from pathlib import Path
import re
import shutil
import subprocess
import sys

from conftest import BUNDLED_PARAMETERS, ROOT
import numba
import pytest
from test_package import imports, module_behind, MODULES, NAME

from rs_relpose_ros.jit import source_digest, TRIED
from rs_relpose_ros.kernel_loading import load_late

# A package of this name with two kernels, one of which calls the other.
INNER = """
from rs_relpose_ros.jit import kernel

@kernel
def inner(x):
    return 2.0 * x
"""
OUTER = """
from rs_relpose_ros.jit import kernel
from rs_relpose_ros.inner import inner

@kernel
def outer(x):
    return inner(x) + 1.0
"""
# Calls both; prints results, loaded and compiled kernels. Root may write anywhere, so a read-only
# package is simulated, and a Numba without one of the private parts.
PROGRAM = """
import json, os, sys
if sys.argv[1] == 'read-only':
    access = os.access
    os.access = lambda path, mode: '/installed/' not in str(path) and access(path, mode)
if sys.argv[1] == 'other Numba':
    import numba
    del numba.core.caching.InTreeCacheLocator
from rs_relpose_ros.inner import inner
from rs_relpose_ros.outer import outer
result = [outer(3.0), inner(3.0)]
print(json.dumps([*result, *(sum(sum(getattr(k.stats, kind).values()) for k in (inner, outer))
                             for kind in ('cache_hits', 'cache_misses'))]))
"""
HITS = [7.0, 6.0, 2, 0]
COMPILED = [7.0, 6.0, 0, 2]


@pytest.fixture(scope='module')
def built(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The folder that holds the package and its compiled kernels."""
    folder = tmp_path_factory.mktemp('built')
    (folder / NAME).mkdir()
    shutil.copy(ROOT / NAME / 'jit.py', folder / NAME)
    (folder / NAME / '__init__.py').touch()
    (folder / NAME / 'inner.py').write_text(INNER)
    (folder / NAME / 'outer.py').write_text(OUTER)
    assert run(folder) == COMPILED
    return folder


@pytest.fixture
def package(built: Path, tmp_path: Path) -> Path:
    """The package where it is installed; files with other times, as pip unpacks a wheel."""
    return shutil.copytree(built, tmp_path / 'installed', copy_function=shutil.copyfile)


def run(package: Path, how: str = 'writable', **environment: str) -> list[float]:
    """Results of the two kernels, how many were loaded, how many compiled."""
    clean = {
        key: value for key, value in os.environ.items() if not key.startswith(('NUMBA_', 'XDG_'))
    }
    return json.loads(
        output(
            PROGRAM,
            how,
            cwd=package,
            env={**clean, 'HOME': str(package.parent / 'home'), **environment},
        )
    )


def output(
    program: str,
    *arguments: str,
    cwd: Path,
    env: dict[str, str] | None = None,
    timeout: float = 110,
) -> str:
    return subprocess.run(
        [sys.executable, '-B', '-W', 'error', '-c', program, *arguments],
        cwd=cwd,
        env=env,
        check=True,
        text=True,
        stdout=subprocess.PIPE,
        timeout=timeout,
    ).stdout


def files(folder: Path) -> dict[str, int]:
    return {str(path): path.stat().st_mtime_ns for path in folder.rglob('*.nb?')}


def test_kernels_are_found_where_the_package_is_installed(package):
    assert run(package) == HITS
    assert run(package, NUMBA_CACHE_DIR=str(package.parent / 'other')) == COMPILED


def test_an_index_of_a_class_that_was_renamed_is_not_read(package):
    """Numba would unpickle it, by the name of the class."""
    inner = package / NAME / 'inner.py'
    for name, starts in (('Before', 1), ('After', 2)):
        inner.write_text(
            INNER.replace(
                '@kernel',
                f'from typing import NamedTuple\n\nclass {name}'
                '(NamedTuple):\n    x: float\n\n@kernel',
            ).replace('2.0 * x', '2.0 * x[0]')
        )
        called = f'from rs_relpose_ros.inner import *; print(inner({name}(3.0)))'
        for _ in range(starts):
            assert output(called, cwd=package) == '6.0\n'


def test_a_changed_callee_is_compiled_into_its_callers(package):
    (package / NAME / 'inner.py').write_text(INNER.replace('2.0', '5.0'))
    assert run(package) == [16.0, 15.0, 0, 2]
    # Only what is concerned.
    (package / NAME / 'outer.py').write_text(OUTER.replace('1.0', '2.0'))
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
    assert (
        run(
            package,
            'read-only',
            HOME=str(tmp_path / 'file' / 'home'),
            TMPDIR=str(tmp_path / 'tmp'),
        )
        == HITS
    )


def test_without_private_parts_of_numba(package):
    """Compiled once, and again with a changed callee, beside the kernels of the usual way."""
    assert run(package, 'other Numba') == COMPILED
    assert run(package, 'other Numba') == HITS
    assert run(package) == HITS
    (package / NAME / 'inner.py').write_text(INNER.replace('2.0', '5.0'))
    assert run(package, 'other Numba') == [16.0, 15.0, 0, 2]


def test_this_numba_was_tried():
    """If not: run the tests with it, then add it to the versions in jit.py."""
    assert re.match(r'\d+\.\d+', numba.__version__)[0] in TRIED


# Calls kernels of the cache, then one that is linked with another; prints results, which modules
# of loaded kernels are still bitcode before and after, and what the engine says of symbols.
LATE = """
import json, sys
from numba.core.registry import cpu_target
from rs_relpose_ros.kernel_loading import LATE
from rs_relpose_ros.inner import inner
from rs_relpose_ros.outer import outer

engine = cpu_target.target_context.codegen()._engine
def bitcode(kernel):
    [loaded] = kernel.overloads.values()
    return isinstance(vars(loaded.library).get('late_module'), bytes)
results = [inner(3.0), outer(3.0)]
before = [bitcode(inner), bitcode(outer)]
results.append(__import__('further').further(3.0))
after = [bitcode(inner), bitcode(outer)]
[loaded] = outer.overloads.values()
name = loaded.fndesc.llvm_func_name
symbols = [engine.is_symbol_defined(name), engine.is_symbol_defined('no such symbol')]
parsed = loaded.library._get_module_for_linking().get_function(name).name == name
print(json.dumps([LATE, results, before, after, symbols, parsed]))
"""
FURTHER = """
import numba
from rs_relpose_ros.inner import inner

@numba.njit
def further(x):
    return 10.0 * inner(x)
"""


def test_bitcode_of_a_kernel_is_parsed_when_another_one_is_linked_with_it(package):
    (package / 'further.py').write_text(FURTHER)
    shutil.copy(ROOT / NAME / 'kernel_loading.py', package / NAME)
    late = json.loads(output(LATE, cwd=package))
    assert late == [True, [6.0, 7.0, 60.0], [True, True], [False, True], [True, False], True]
    public = {**os.environ, 'RS_RELPOSE_PUBLIC_NUMBA': '1'}
    for _ in ('compiled', 'loaded'):
        usual = json.loads(output(LATE, cwd=package, env=public))
        assert usual == [False, late[1], [False, False], [False, False], [True, False], True]


# The same for a kernel that was loaded before loading was changed.
LOADED_BEFORE = """
from rs_relpose_ros.inner import inner
results = [inner(3.0)]
import rs_relpose_ros.kernel_loading
print(*results, __import__('further').further(3.0))
"""


def test_a_kernel_loaded_before_is_linked_with_another_one(package):
    (package / 'further.py').write_text(FURTHER)
    shutil.copy(ROOT / NAME / 'kernel_loading.py', package / NAME)
    output('from rs_relpose_ros.inner import inner\ninner(3.0)', cwd=package)  # compiles it
    assert output(LOADED_BEFORE, cwd=package).split() == ['6.0', '60.0']


def test_a_numba_without_the_private_parts_stays_as_it_is():
    class Library:
        _unserialize = classmethod(lambda cls, codegen, state: state)

    before = dict(vars(Library))
    assert not load_late(Library, None)
    assert not load_late(None, None)
    assert dict(vars(Library)) == before


def test_every_import_of_a_kernels_module_counts(monkeypatch):
    """What `source_digest` finds by a pattern is what the parser finds."""

    @functools.cache
    def reached(module: str) -> set[str]:
        found = {module_behind(name) for name in imports(MODULES[module])} - {''}
        return found.union(*map(reached, found))

    with_kernels = [
        name for name, path in MODULES.items() if 'rs_relpose_ros.jit import' in path.read_text()
    ]
    assert len(with_kernels) > 20
    read_bytes = Path.read_bytes
    read = set()
    monkeypatch.setattr(Path, 'read_bytes', lambda path: (read.add(path), read_bytes(path))[1])
    for module in with_kernels:
        __import__(module)
        source_digest.cache_clear()
        read.clear()
        source_digest(module)
        assert read == {MODULES[name] for name in {module, *reached(module)}}


# In a process of its own: other tests compile kernels in this one.
COUNT = """
from collections import Counter
import gc
import json
import sys
from numba.core.ccallback import CFunc
from numba.core.dispatcher import Dispatcher

def kernels():
    # A CFunc is a kernel that is called by address.
    compiled = [(k.py_func, len(k.overloads)) if isinstance(k, Dispatcher) else (k.__wrapped__, 1)
                for k in gc.get_objects() if isinstance(k, (Dispatcher, CFunc))]
    kernels = Counter()
    for function, count in compiled:
        if function.__module__.startswith('rs_relpose_ros'):
            kernels[f'{function.__module__}.{function.__name__}'] += count
    return kernels
"""
WARM_UP = (
    COUNT
    + """
from rs_relpose_ros.bags.reader import open_bag
from rs_relpose_ros.config.files import read_parameters
from rs_relpose_ros.offline.replay import Replay
from rs_relpose_ros.pipeline.warm_up import warm_up_pipeline

parameters = read_parameters(sys.argv[2])
warm_up_pipeline(parameters)
before = kernels()
with open_bag(sys.argv[1]) as bag:
    pairs = list(Replay(bag, bag.find_topics(), parameters).pairs())
statuses = {pair.pose.status.value for pair in pairs}
landmarks = [pair.landmarks for pair in pairs]   # wanted by subscribers of ~/matches
after = kernels()
print(json.dumps([sorted(statuses), [k for k in after if after[k] != before[k]],
                  sum(before.values())]))
"""
)
# The same of a calibration, with a known and with an unknown lens.
CALIBRATION = (
    COUNT
    + """
import numpy as np
from rs_relpose_lab.experiments.calibration_tracks import drawn, record
from rs_relpose_ros.calibrate.procedure import calibrate, warm_up_fit
from rs_relpose_ros.config.settings import TRACKED_IN_IMAGES
from rs_relpose_ros.geometry.camera import RollingShutterCamera

warm_up_fit()
before = kernels()
rng = np.random.default_rng(1)
truth = drawn(rng, readout_time=0.02, frames=60)
recorded = record(truth, rng)
camera = RollingShutterCamera(
    width=truth.width, height=truth.height, fx=truth.focal, fy=truth.focal,
    cx=0.5 * truth.width, cy=0.5 * truth.height, distortion=(1e-3, 0.0, 0.0, 0.0, 0.0),
    readout_time=0.0)
for focal_known in (True, False):
    calibrate(recorded.tracks, recorded.gyro, camera, focal_known=focal_known,
              config=TRACKED_IN_IMAGES)
after = kernels()
print(json.dumps([[k for k in after if after[k] != before[k]], sum(before.values())]))
"""
)


@pytest.mark.timeout(600)
def test_nothing_is_compiled_after_the_warm_up(bundled_bag):
    statuses, compiled_late, kernels = json.loads(
        output(WARM_UP, str(bundled_bag), str(BUNDLED_PARAMETERS), cwd=ROOT, timeout=590)
    )
    # The bag holds motion, standstill and pure rotation: every path of the estimator.
    assert {'OK', 'PURE_ROTATION'} <= set(statuses)
    assert kernels > 5
    assert compiled_late == []


@pytest.mark.timeout(600)
def test_nothing_is_compiled_after_the_warm_up_of_a_calibration():
    compiled_late, kernels = json.loads(output(CALIBRATION, cwd=ROOT, timeout=590))
    assert kernels > 5
    assert compiled_late == []
