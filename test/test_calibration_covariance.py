"""Jackknife, gyro noise, and the table of the calibration benchmark."""

from __future__ import annotations

import dataclasses
import math

import numpy as np
import pytest
from scipy.stats import norm, t

from rs_relpose_lab.experiments.calibration_accuracy import CalibrationRun, Found, write_report
from rs_relpose_ros.calibrate.covariance import jackknife, stretches
from rs_relpose_ros.calibrate.gyro_path import noise_density


def mean_of(samples: np.ndarray, groups: np.ndarray) -> tuple[float, float]:
    """Mean and its told sigma: the score of sample x is mean - x, its curvature 1."""
    mean = float(samples.mean())
    covariance = jackknife((mean - samples)[:, None], np.ones((len(samples), 1, 1)), groups,
                           np.zeros(1))
    return mean, math.sqrt(covariance[0, 0])


def test_jackknife_of_single_samples_is_the_variance_of_the_mean():
    samples = np.random.default_rng(0).standard_normal(12)
    _, sigma = mean_of(samples, np.arange(12))
    student = t.ppf(norm.cdf(1.0), 11)
    assert sigma == pytest.approx(student * samples.std(ddof=1) / math.sqrt(12), rel=1e-9)


def test_jackknife_covers_errors_that_a_group_has_in_common():
    rng = np.random.default_rng(1)
    groups = np.repeat(np.arange(10), 20)
    inside = 0
    for _ in range(400):
        samples = np.repeat(rng.standard_normal(10), 20) + 0.3 * rng.standard_normal(200)
        mean, sigma = mean_of(samples, groups)
        inside += abs(mean) < sigma
    # 68.3 % with a standard error of 2.3 %.
    assert 0.61 < inside / 400 < 0.75


def test_prior_counts_as_known():
    covariance = jackknife(np.zeros((10, 1)), np.zeros((10, 1, 1)), np.arange(10),
                           np.array([4.0]))
    assert covariance[0, 0] == pytest.approx(0.25)


def test_stretches_last_a_second_but_are_ten_at_least():
    assert len(np.unique(stretches(np.linspace(0.0, 3.0, 100)))) == 10
    groups = stretches(np.linspace(5.0, 25.0, 1001))
    assert len(np.unique(groups)) == 20
    assert (np.diff(groups) >= 0).all() and abs(np.bincount(groups) - 50).max() <= 1


def test_noise_density_of_a_moving_gyro():
    rng = np.random.default_rng(2)
    times = np.arange(2000) / 200.0
    swing = np.sin(2.0 * np.pi * np.outer(times, [1.0, 0.7, 1.3]))
    rates = swing + 3e-4 * math.sqrt(200.0) * rng.standard_normal((2000, 3))
    assert noise_density(times, rates) == pytest.approx(3e-4, rel=0.1)


def test_table_of_the_benchmark(tmp_path):
    good = Found(0.1, 0.2, True)
    run = CalibrationRun(
        seed=0, axis_map=3, readout_time=20.0, time_offset=5.0, rotation_rate=30.0, speed=1.0,
        gyro_rate=200.0, readout=good, offset=good, rotation_error=0.05, rotation_x=good,
        rotation_y=good, rotation_z=good, bias_x=good, bias_y=good, bias_z=good,
        focal=Found(math.nan, math.nan, False), axis_map_right=True, observable=True,
        shutter='rolling')
    off = dataclasses.replace(run, seed=1, readout=Found(-0.6, 0.2, True), axis_map_right=False)
    text = write_report(tmp_path, [run, off])
    row = next(line for line in text.splitlines() if 'read-out' in line)
    # Within the limit, within 1 sigma and within 2 sigma [%].
    assert [cell.strip() for cell in row.split('|')[-4:-1]] == ['50.0', '50.0', '50.0']
    assert 'Axis map right in 1 of the 2 runs' in text
    assert 'focal length' not in text
    assert (tmp_path / 'calibration_runs.csv').read_text().count('\n') == 3
