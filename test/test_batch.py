"""Many bags on real Dask clusters of processes, all on the loopback interface."""

from collections.abc import Iterator
import json
import math
import os
from pathlib import Path
import shutil
import signal
import sys
import threading
import time
from typing import Any

from bag_kinds import copied
from conftest import rows_of, run_command
import cv2
import numpy as np
import pytest

from rs_relpose_ros.cli import batch, main
from rs_relpose_ros.cli.batch import BagFiles, DONE, Files, Job, Row, run_jobs

pytest.importorskip('distributed', reason='needs the extra batch')
# Clusters start, and a first run compiles kernels.
pytestmark = pytest.mark.timeout(300)

VERSION = batch.package_version()
SECONDS = 1.6  # of a bag


def make_bag(path: Path, size: int = 10) -> Path:
    path.mkdir(parents=True)
    (path / 'metadata.yaml').write_text('x')
    (path / 'data.mcap').write_bytes(b'x' * size)
    return path


def test_bags_of_paths_and_globs(tmp_path, monkeypatch):
    for name in ('b', 'a'):
        make_bag(tmp_path / name, size=10)
        (tmp_path / f'{name}.yaml').write_text(f'# {name}\n')
    (tmp_path / 'other').mkdir()
    (tmp_path / 'old.bag').write_bytes(b'12345')
    found = batch.find_bags([str(tmp_path / name) for name in ('b', '*', 'absent')])
    assert [Path(bag.path).name for bag in found] == ['b', 'a', 'old.bag', 'absent']
    assert [bag.size for bag in found] == [11, 11, 5, -1]
    assert [bag.parameters for bag in found] == ['# b\n', '# a\n', '', '']
    os.utime(tmp_path / 'a' / 'data.mcap', ns=(1, 4_000_000_000_000_000_000))
    monkeypatch.chdir(tmp_path.parent)
    [relative] = batch.find_bags([f'{tmp_path.name}/a*'])
    assert relative.path == f'{tmp_path.name}/a'
    assert relative.changed_ns == 4_000_000_000_000_000_000


@pytest.mark.parametrize(
    'paths, names',
    [
        (['/a/x', '/a/y.bag'], ['x', 'y']),
        (['/a/x', '/b/x', '/b/y'], ['a__x', 'b__x', 'b__y']),
        (['/a/x', '/a/x.mcap'], ['x', 'x.mcap']),
    ],
)
def test_names_of_results_differ(paths, names):
    assert batch.unique_names(paths) == names


@pytest.mark.parametrize('state', batch.STATES)
def test_result_is_reused_only_if_it_is_one_and_nothing_changed(tmp_path, state):
    bag = BagFiles('/bags/a', 5, 7, 'a: 1\n')
    job = Job('check', bag, 'a', ('--set', 'seed=1'), '1')
    row = job.row(state, 'because', 1.5, {'pairs': 3, 'shutter': None})
    batch.store(job, row, {'check.json': b'{}', 'in/it.txt': b'text'}, tmp_path)
    assert (tmp_path / 'a' / 'in' / 'it.txt').read_bytes() == b'text'
    lasts = state in (DONE, batch.FINDINGS, batch.REFUSED)
    assert batch.earlier(job, tmp_path) == (row if lasts else None)
    for changes in (
        {'bag': bag._replace(size=6)},
        {'bag': bag._replace(changed_ns=8)},
        {'bag': bag._replace(parameters='a: 2\n')},
        {'options': ()},
        {'version': '2'},
        {'command': 'replay'},
        {'name': 'b'},
    ):
        assert batch.earlier(job._replace(**changes), tmp_path) is None
    (tmp_path / 'a' / 'check.json').unlink()
    assert batch.earlier(job, tmp_path) is None
    (tmp_path / 'a' / 'job.json').write_text('{')
    assert batch.earlier(job, tmp_path) is None


@pytest.mark.skipif(not Path('/dev/full').exists(), reason='Linux has a device that is full')
@pytest.mark.parametrize('file', ['a/check.json', 'a/job.json', 'results.csv'])
def test_a_full_disk_is_reported_with_the_file(tmp_path, file):
    job = Job('check', BagFiles('/bags/a', 5, 7, ''), 'a', (), '1')
    (tmp_path / 'a').mkdir()
    (tmp_path / f'{file}.part').symlink_to('/dev/full')
    with pytest.raises(OSError, match='No space left') as found:
        batch.store(job, job.row(DONE), {'check.json': b'{}'}, tmp_path)
        batch.write_table([job.row(DONE)], tmp_path)
    assert found.value.filename == str(tmp_path / file)
    assert not (tmp_path / file).exists()


@pytest.mark.parametrize(
    'values, sigmas, mean, sigma, chi2, outliers',
    [
        # Bevington, Data Reduction, section 4.1: weights 1 / sigma^2; the sigma is 1 / (1 + 1/4)
        # times
        # the scatter of one degree of freedom.
        ([10.0, 13.0], [1.0, 2.0], 10.6, math.sqrt(0.8 * 1.8), 1.8, ()),
        ([10.0, 10.5], [1.0, 2.0], 10.1, math.sqrt(0.8), 0.05, ()),
        ([1.0, 1.1, 0.9, 5.0, 1.0, -3.0], [0.1] * 6, 1.0, 0.05, 2.0, ('d', 'f')),
        # 3.3 sigma from the others, but 2.7 of the difference.
        ([0.0, 0.0, 0.33], [0.1] * 3, 0.11, 0.11, 7.26, ()),
        # Of two that disagree, neither is known to be wrong: the sigma grows.
        ([1.0, 2.0], [0.1, 0.1], 1.5, 0.5, 50.0, ()),
    ],
)
def test_values_are_averaged_by_their_sigmas_without_outliers(
    values, sigmas, mean, sigma, chi2, outliers
):
    combined = batch.weighted_mean('x', 'abcdef'[: len(values)], values, sigmas)
    assert [combined[key] for key in ('mean', 'sigma', 'chi2')] == pytest.approx(
        [mean, sigma, chi2]
    )
    assert combined['outliers'] == list(outliers)
    assert combined['degrees_of_freedom'] == len(values) - len(outliers) - 1


def calibration(readout: float, observable: bool = True, yaw: float = 0.0) -> dict:
    """Columns of what `calibrate` writes."""

    def estimate(value: float, observed: bool = True) -> dict:
        return {'value': value, 'sigma': 0.0002, 'observable': observed, 'remark': 'turn more'}

    return batch.metrics_of(
        'calibrate',
        {
            'shutter': 'rolling',
            'readout_time_s': estimate(readout, observable),
            'time_offset_s': estimate(-0.01),
            'focal_px': None,
            'gyro_bias_rad_per_s': [estimate(0.001 * k) for k in range(3)],
            'quat_cam_imu_xyzw': [0.0, 0.0, np.sin(yaw / 2), np.cos(yaw / 2)],
            'rotation_sigma_rad': [0.001] * 3,
            'rotation_from_axis_map_rad': estimate(0.0),
            'frames': 100,
            'pixel_sigma': 0.1,
        },
    )


def test_calibrations_of_one_camera():
    one_camera = batch.combine(
        [
            {'name': name, **metrics}
            for name, metrics in {
                'a': calibration(0.0300, yaw=0.01),
                'b': calibration(0.0302, yaw=0.012),
                'c': calibration(0.0301, yaw=0.011),
                'd': calibration(0.9, observable=False, yaw=0.011),
            }.items()
        ]
    )
    combined = {one['figure']: one for one in one_camera['figures']}
    assert combined['readout_time_s']['mean'] == pytest.approx(0.0301)
    assert combined['readout_time_s']['bags'] == ['a', 'b', 'c']
    assert combined['time_offset_s']['degrees_of_freedom'] == 3
    assert 'focal_px' not in combined
    # 1 mrad to both sides of the mean.
    assert combined['rotation_z_rad']['chi2'] == pytest.approx(2.0, rel=1e-3)
    assert combined['rotation_x_rad']['chi2'] == pytest.approx(0.0, abs=1e-9)
    np.testing.assert_allclose(
        one_camera['quat_cam_imu_xyzw'], [0.0, 0.0, np.sin(0.0055), np.cos(0.0055)], atol=1e-9
    )


def results_of(folder: Path) -> dict[str, dict[str, str]]:
    return {row['name']: row for row in rows_of(folder / 'results.csv')}


def damage(bag: Path) -> None:
    file = next(bag.glob('*.mcap'))
    file.write_bytes(file.read_bytes()[: file.stat().st_size // 2])


@pytest.fixture(scope='module')
def bags(tmp_path_factory, bundled_bag) -> Path:
    """Three times the first seconds of the bundled bag, the second one damaged."""
    folder = tmp_path_factory.mktemp('bags')
    copied(bundled_bag, folder / 'first', seconds=SECONDS)
    for name in ('first', 'second', 'third'):
        if name != 'first':
            shutil.copytree(folder / 'first', folder / name)
        shutil.copy(bundled_bag.with_name('hand_held.yaml'), folder / f'{name}.yaml')
    damage(folder / 'second')
    return folder


@pytest.fixture(scope='module')
def client() -> Iterator[Any]:
    """Of a cluster of two processes; those that a test kills are replaced."""
    with batch.open_cluster(None, 2) as client:
        yield client


@pytest.fixture(scope='module')
def single(tmp_path_factory, bags) -> Path:
    """What a single replay of the first bag writes."""
    out = tmp_path_factory.mktemp('single')
    run_command(
        'replay', bags / 'first', '--params', bags / 'first.yaml', '--out', out, '--no-pictures'
    )
    return out


@pytest.fixture(scope='module')
def replayed(tmp_path_factory, bags) -> Path:
    """The three bags on two processes."""
    out = tmp_path_factory.mktemp('batch')
    code = main.main(
        [
            'batch',
            'replay',
            f'{bags}/*',
            '--out',
            str(out),
            '--workers',
            '2',
            '--options=--no-pictures',
        ]
    )
    assert code == 1  # one is damaged
    return out


def test_results_are_those_of_single_runs(replayed, single):
    for name in ('relative_poses.csv', 'errors.csv'):
        expected = (single / name).read_bytes()
        assert expected.count(b'\n') > 5
        assert (replayed / 'first' / name).read_bytes() == expected
        assert (replayed / 'third' / name).read_bytes() == expected
    summary = json.loads((single / 'summary.json').read_text())
    rows = results_of(replayed)
    row = rows['first']
    assert row['state'] == 'done' and row['message'] == ''
    assert int(row['pairs']) == summary['pairs']['total']
    assert int(row['answered']) == summary['pairs']['answered']
    assert (
        float(row['rotation_median_deg']) == summary['errors_against_truth']['rotation_median_deg']
    )
    assert float(row['seconds']) > 0.5
    # The damaged bag among them.
    assert list(rows) == ['first', 'second', 'third']
    assert rows['second']['state'] == 'refused'
    assert 'truncated' in rows['second']['message'] and rows['second']['pairs'] == ''
    summary = json.loads((replayed / 'summary.json').read_text())
    assert summary['states'] == {'done': 2, 'findings': 0, 'refused': 1, 'failed': 0, 'lost': 0}
    picture = cv2.imread(str(replayed / 'overview.png'))
    assert picture.shape[1] > 800 and (picture < 128).any()


def test_only_what_changed_is_run_again(client, replayed, bags, tmp_path, capsys):
    out = tmp_path / 'out'
    shutil.copytree(replayed, out)
    before = {path: path.stat().st_mtime_ns for path in out.glob('*/job.json')}
    damage(bags / 'third')
    try:
        assert (
            main.main(
                [
                    'batch',
                    'replay',
                    f'{bags}/*',
                    '--out',
                    str(out),
                    '--scheduler',
                    client.scheduler.address,
                    '--options=--no-pictures',
                ]
            )
            == 1
        )
    finally:
        shutil.copytree(bags / 'first', bags / 'third', dirs_exist_ok=True)
    printed = capsys.readouterr().out
    assert '3 bags: 1 done, 2 refused; 2 of them from an earlier run' in printed
    changed = {
        path.parent.name for path, stamp in before.items() if path.stat().st_mtime_ns != stamp
    }
    assert changed == {'third'}
    assert results_of(out)['third']['state'] == 'refused'
    assert not (out / 'third' / 'relative_poses.csv').exists()


def test_check_on_a_running_cluster(client, bags, tmp_path):
    options = ['--out', str(tmp_path), '--scheduler', client.scheduler.address]
    assert (
        main.main(
            [
                'batch',
                'check',
                str(bags / 'first'),
                str(bags / 'absent'),
                *options,
                '--params',
                str(bags / 'first.yaml'),
                '--set',
                'time_offset=0.03',
            ]
        )
        == 1
    )
    rows = results_of(tmp_path)
    assert rows['first']['state'] == 'findings' and 'time_offset' in rows['first']['message']
    assert int(rows['first']['failure']) >= 1
    assert rows['absent']['state'] == 'refused' and 'there is no bag' in rows['absent']['message']
    assert (tmp_path / 'overview.png').is_file()


def test_each_worker_is_a_process_of_one_thread(client, tmp_path):
    for name in ('a', 'b'):
        make_bag(tmp_path / name)
    client.wait_for_workers(2, timeout=60)
    assert set(client.nthreads().values()) == {1} and len(client.nthreads()) == 2
    assert all('//127.0.0.1:' in address for address in client.nthreads())
    rows, _ = run_jobs(client, jobs(client, tmp_path, 'a', 'b'), tmp_path / 'out', threads)
    configured = [row['message'].split() for row in rows]
    assert [words[:2] for words in configured] == [['1', '1']] * 2
    assert os.getpid() not in {int(words[2]) for words in configured}


# Work for clusters; the folder for marks is in the job's options.


def die_in_mid_bag(job: Job) -> tuple[Row, Files]:
    """Do the job, but the first worker is killed during it."""
    mark = Path(job.options[-1]) / f'{job.name}.died'
    if job.name == 'mortal' and not mark.exists():
        mark.touch()
        threading.Timer(0.3, os.kill, (os.getpid(), signal.SIGKILL)).start()
    return batch.run_job(job._replace(options=('--no-pictures',)))


def die_always(job: Job) -> tuple[Row, Files]:
    """The mortal one kills each worker; the others take their time."""
    if job.name == 'mortal':
        os.kill(os.getpid(), signal.SIGKILL)
    time.sleep(0.5)
    if job.name == 'faulty':
        raise ZeroDivisionError('no such number')
    return job.row(DONE), {}


def threads(job: Job) -> tuple[Row, Files]:
    row, files = batch.run_job(job)
    configured = os.environ['OMP_NUM_THREADS'], cv2.getNumThreads(), os.getpid()
    return {**row, 'message': ' '.join(map(str, configured))}, files


def jobs(
    client: Any,
    folder: Path,
    *names: str,
    options: tuple[str, ...] = (),
    command: str = 'replay',
    parameters: str | None = None,
) -> list[Job]:
    return batch.make_jobs(
        client, command, [str(folder / name) for name in names], parameters, options, VERSION
    )


def test_worker_that_dies_in_mid_bag_is_replaced(client, bags, single, tmp_path):
    shutil.copytree(bags / 'first', tmp_path / 'in' / 'mortal')
    shutil.copy(bags / 'first.yaml', tmp_path / 'in' / 'mortal.yaml')
    rows, _ = run_jobs(
        client,
        jobs(client, tmp_path / 'in', 'mortal', options=(str(tmp_path),)),
        tmp_path / 'out',
        die_in_mid_bag,
    )
    assert (tmp_path / 'mortal.died').exists()
    assert [row['state'] for row in rows] == [DONE]
    assert (tmp_path / 'out' / 'mortal' / 'relative_poses.csv').read_bytes() == (
        single / 'relative_poses.csv'
    ).read_bytes()


def test_bag_that_kills_every_worker(client, tmp_path):
    for name in ('a', 'mortal', 'b', 'faulty', 'c'):
        make_bag(tmp_path / name)
    run_jobs(
        client,
        jobs(client, tmp_path, 'a', 'mortal', 'b', 'faulty', 'c'),
        tmp_path / 'out',
        die_always,
    )
    rows = results_of(tmp_path / 'out')
    assert [rows[name]['state'] for name in ('a', 'mortal', 'b', 'faulty', 'c')] == [
        'done',
        'lost',
        'done',
        'failed',
        'done',
    ]
    assert 'workers died over this bag' in rows['mortal']['message']
    assert rows['faulty']['message'] == 'ZeroDivisionError: no such number'


def work_of_calibrations(job: Job) -> tuple[Row, Files]:
    """Results by the bag's name."""
    readout = {'cam1': 0.0300, 'cam2': 0.0301, 'wrong': 0.024}.get(job.name, 0.0302)
    observable = job.name != 'still5'
    metrics = calibration(readout, observable)
    return job.row(DONE if observable else batch.FINDINGS, metrics=metrics), {}


def test_summary_of_calibrations(client, tmp_path):
    names = ('cam1', 'cam2', 'wrong', 'cam4', 'still5')
    for name in names:
        make_bag(tmp_path / name)
    calibrations = jobs(client, tmp_path, *names, command='calibrate', parameters='')
    found, reused = run_jobs(client, calibrations, tmp_path / 'out', work_of_calibrations)
    lines = batch.write_summary(calibrations[0], found, reused, tmp_path / 'out')
    summary = json.loads((tmp_path / 'out' / 'summary.json').read_text())
    readout = next(
        one for one in summary['combined']['figures'] if one['figure'] == 'readout_time_s'
    )
    assert readout['outliers'] == ['wrong'] and readout['degrees_of_freedom'] == 2
    rows = results_of(tmp_path / 'out')
    assert float(rows['wrong']['readout_time_s']) == 0.024
    assert rows['still5']['readout_time_s_observable'] == 'False'
    assert any(
        line.startswith('readout_time_s: 0.03') and line.endswith('outliers: wrong')
        for line in lines
    )


@pytest.mark.parametrize(
    'words, configured',
    [
        (['replay', 'x', '--workers', '0'], '--workers must be at least 1'),
        (['replay', 'x', '--params', 'absent.yaml'], 'absent.yaml'),
        (['replay', 'x', '--set', 'colour=1'], 'colour'),
        (['calibrate', 'x', '--set', 'seed=1'], 'calibrate takes no parameters'),
        (['replay', 'x', '--options=--colour'], '--options: --colour are no options of replay'),
        (['replay', 'x', '--options=--out=y'], '--options must not have --out=y'),
        (['replay', 'x', '--scheduler', 'tcp://127.0.0.1:1'], 'no Dask scheduler answers'),
    ],
)
def test_bad_usage_is_named_and_nothing_is_written(
    tmp_path, capsys, monkeypatch, words, configured
):
    monkeypatch.setattr('rs_relpose_ros.cli.batch._TIMEOUT', 1.0)
    assert main.main(['batch', *words, '--out', str(tmp_path / 'out')]) == 2
    assert configured in capsys.readouterr().err
    assert not (tmp_path / 'out').exists()


def test_clusters_that_are_refused(client, tmp_path, refused, monkeypatch):
    command = ['batch', 'check', tmp_path / '*', '--out', tmp_path / 'out']
    running = ['--scheduler', client.scheduler.address]
    refused('--workers is for local processes', *command, *running, '--workers', 2)
    refused('the workers find no bag at', *command, *running)
    monkeypatch.setattr(batch, 'package_version', lambda: str(os.getpid()))
    refused('the workers have version', *command, *running)
    monkeypatch.setitem(sys.modules, 'dask', None)
    refused("pip install 'dask[distributed]'", *command)
