"""The scatter of image stamps: what counts as an error of a stamp, and what does not."""

import numpy as np
import pytest

from rs_relpose_ros.front_end.stamp_scatter import StampScatter

PERIOD_NS = 33_366_700
START_NS = 1_700_000_000_123_456_789


def scatter_of(stamps_ns):
    scatter = StampScatter()
    for stamp_ns in np.asarray(stamps_ns).tolist():
        scatter.add(stamp_ns)
    return scatter


def even(frames=32):
    return START_NS + PERIOD_NS * np.arange(frames)


def jittering(rng, sigma_ns=2.0e6, frames=32):
    return even(frames) + np.round(sigma_ns * rng.normal(size=frames)).astype(np.int64)


def test_an_even_rhythm_has_none():
    assert scatter_of(even()).sigma == 0.0


@pytest.mark.parametrize('frames', [5, 32])
def test_scatter_is_that_of_the_stamps(frames):
    rng = np.random.default_rng(0)
    found = [scatter_of(jittering(rng, frames=frames)).sigma for _ in range(300)]
    assert np.mean(found) == pytest.approx(2.0e-3, rel=0.15)


def test_frames_that_are_lost_are_no_scatter():
    rng = np.random.default_rng(1)
    kept = even(60)[np.sort(rng.choice(60, 32, replace=False))]
    assert scatter_of(kept).sigma < 1e-6
    found = []
    for _ in range(100):
        stamps = jittering(rng, frames=60)
        found.append(scatter_of(np.delete(stamps, rng.choice(60, 12, replace=False))).sigma)
    assert np.mean(found) == pytest.approx(2.0e-3, rel=0.15)


def test_an_exposure_that_becomes_longer_is_hardly_any():
    intervals = np.repeat([33_173_000, 40_050_000], [20, 12])
    assert scatter_of(START_NS + np.cumsum(intervals)).sigma < 2e-4


def test_a_camera_without_a_rhythm_is_bounded():
    rng = np.random.default_rng(2)
    stamps = START_NS + np.cumsum(rng.integers(20_000_000, 200_000_000, 32))
    assert scatter_of(stamps).sigma < 0.01


@pytest.mark.parametrize('frames', [0, 1, 2])
def test_too_few_stamps_show_none(frames):
    assert scatter_of(jittering(np.random.default_rng(3), frames=frames)).sigma == 0.0


def test_a_reset_forgets():
    scatter = scatter_of(jittering(np.random.default_rng(4)))
    scatter.reset()
    assert scatter.sigma == 0.0
