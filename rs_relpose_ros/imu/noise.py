"""White noise of an IMU as its own samples show it, whatever is configured."""

from __future__ import annotations

import math

import numpy as np

from rs_relpose_ros.core.losses import SIGMA_PER_MEDIAN
from rs_relpose_ros.geometry import Array

# Variance of the third difference of white noise of unit variance. [derived: 1 + 9 + 9 + 1]
_THIRD_DIFFERENCE = 20.0
# Fewest samples whose third differences show a noise. Fewer would be too uncertain, more would
# miss it in short intervals. [chosen: 8 to 20 would do: three axes of each]
FEWEST_SAMPLES = 10
# Ratio of the density that samples show to the configured one from which it counts. A smaller one
# would follow the scatter of the estimate, a larger one would publish poses that are too certain.
# [measured: the noisiest axis in a second shows 0.5 to 1.8 times the default density on four
# recordings at 200 Hz and 0.8 to 1.2 times on simulated walks]
NOISY = 2.0
# Numbers of samples whose means are compared as well: a vibration, which is no white noise, has
# smaller means. More would take the motion for noise.
# [derived: means of 3 samples at 200 Hz leave a quarter of a tone of 83 Hz]
_BLOCK = 3


def noise_of_samples(values: Array, seconds: Array) -> float:
    """Density of the white noise of samples (K, 3), or of a vibration, by their third differences.

    A motion hardly changes these at the rate of an IMU. A vibration is no white noise: its
    integral may be smaller.
    """
    return density_of(third_differences(values), seconds)


def shown_density(values: Array, seconds: Array, configured: float) -> float:
    """Density of the noisiest axis of samples (K, 3), or `configured` if they agree with it.

    Each axis may vibrate for itself, and a camera turns about any of them. Of a vibration that
    counts which remains in means of some samples.
    """
    if len(values) < FEWEST_SAMPLES:
        return configured
    shown = _of_noisiest_axis(values, seconds)
    if shown > NOISY * configured and len(values) >= _BLOCK * FEWEST_SAMPLES:
        blocks = len(values) // _BLOCK
        means = values[: blocks * _BLOCK].reshape(blocks, _BLOCK, 3).mean(axis=1)
        shown = min(shown, _of_noisiest_axis(means, seconds[: blocks * _BLOCK : _BLOCK]))
    return shown if shown > NOISY * configured else configured


def _of_noisiest_axis(values: Array, seconds: Array) -> float:
    medians = _medians(third_differences(values))
    return _density(max(medians.tolist()), seconds)


def third_differences(values: Array) -> Array:
    """Sizes (K - 3, 3) of the third differences of samples (K, 3)."""
    for _ in range(3):
        values = values[1:] - values[:-1]
    return np.abs(values)


def density_of(differences: Array, seconds: Array) -> float:
    """Density by sizes of third differences of samples at times (K,), of any axes."""
    return _density(float(_medians(differences.ravel())), seconds)


def _density(median: float, seconds: Array) -> float:
    """The same by the median of these sizes."""
    sigma = SIGMA_PER_MEDIAN * median / math.sqrt(_THIRD_DIFFERENCE)
    step = float(_medians(seconds[1:] - seconds[:-1]))
    return sigma * math.sqrt(step)


def _medians(values: Array) -> Array:
    """Medians along the first axis; ``np.median`` takes three times as long for some hundred."""
    ordered = np.sort(values, axis=0)
    middle = len(values) // 2
    if len(values) % 2:
        return np.asarray(ordered[middle])
    return np.asarray(0.5 * (ordered[middle - 1] + ordered[middle]))
