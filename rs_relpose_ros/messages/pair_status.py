"""What ``~/pairs`` says of every pair: the keys of its status, and how they are read back."""

from __future__ import annotations

from collections.abc import Callable, Mapping
import math
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from rs_relpose_ros.errors import InputError
from rs_relpose_ros.estimator.image_information import ImageInformation, POSE, ROTATION
from rs_relpose_ros.front_end.pair import PAIR_FIGURES, PairFigure, PairResult

Array = NDArray[np.float64]


def number(value: float) -> str:
    """Shortest text that reads back as the same number; empty for NaN."""
    if isinstance(value, int):
        return str(value)
    return '' if math.isnan(value) else repr(float(value))


def numbers(values: Array | None) -> str:
    """The numbers of a vector, with blanks between them; empty for None."""
    return '' if values is None else ' '.join(map(number, values))


class PairValue(NamedTuple):
    """A key of the status of a pair and its value, an empty text where it is not known."""

    key: str
    text: Callable[[PairResult], str]


def _figure(figure: PairFigure) -> PairValue:
    return PairValue(figure.name, lambda pair: number(figure.of(pair)))


def _of_images(pair: PairResult, part: Callable[[ImageInformation], Array]) -> str:
    images = pair.pose.images
    if images is None or not np.isfinite(values := part(images)).all():
        return ''
    return numbers(values)


# In the order in which they are shown. `TOPICS_KEY` follows: it tells what else was published.
PAIR_VALUES = (
    PairValue('reference_stamp_ns', lambda pair: str(pair.reference_stamp_ns)),
    PairValue('status', lambda pair: pair.pose.status.value),
    PairValue('reason', lambda pair: pair.pose.reason),
    PairValue('model', lambda pair: pair.pose.model),
    *(_figure(figure) for figure in PAIR_FIGURES),
    PairValue('baseline_m', lambda pair: number(pair.pose.baseline)),
    PairValue('baseline_log_sigma', lambda pair: number(pair.pose.baseline_log_sigma)),
    PairValue('baseline_reason', lambda pair: pair.pose.baseline_reason),
    # Of the current camera in its own frame.
    PairValue('linear_velocity_m_s', lambda pair: numbers(
        pair.pose.metric_velocity2 if math.isfinite(pair.pose.baseline) else None)),
    # Instants of the two stamped rows on the IMU's clock.
    PairValue('reference_imu_ns', lambda pair: str(pair.reference_ns1)),
    PairValue('current_imu_ns', lambda pair: str(pair.reference_ns2)),
    # What the images alone say, without the priors of the IMU: `ImageInformation`.
    PairValue('image_row_s', lambda pair: _of_images(
        pair, lambda images: np.array([images.row_time]))),
    PairValue('image_rotation_xyzw', lambda pair: _of_images(
        pair, lambda images: Rotation.from_matrix(images.R).as_quat())),
    PairValue('image_direction', lambda pair: _of_images(pair, lambda images: images.t)),
    PairValue('image_velocities', lambda pair: _of_images(pair, lambda images: images.velocities)),
    PairValue('image_gradient', lambda pair: _of_images(pair, lambda images: images.gradient)),
    PairValue('image_information', lambda pair: _of_images(
        pair, lambda images: images.information[np.triu_indices(len(images.gradient))])),
    PairValue('gyro_bias_rad_s', lambda pair: numbers(pair.gyro_bias)),
    PairValue('health', lambda pair: pair.health.state.value),
    PairValue('health_findings', lambda pair: pair.health.text),
)
TOPICS_KEY = 'topics'
# Of the longest list of numbers, 66 of them.
_MOST_CHARACTERS = 2000
# Largest deviation from 1 of the length of directions and quaternions.
_UNIT = 1e-3


class PairStatus:
    """The values of a status, by key; InputError where one is absent or cannot be read."""

    def __init__(self, values: Mapping[str, str]) -> None:
        self._values = values

    def text(self, key: str) -> str:
        """A text."""
        if key not in self._values:
            raise InputError(f'~/pairs must have the key {key}')
        return self._values[key]

    def images(self) -> ImageInformation | None:
        """What the images alone say; None where nothing is told."""
        gradient = self.reals('image_gradient')
        size = len(gradient)
        if size == 0:
            return None
        upper, rows = self.reals('image_information'), np.triu_indices(size)
        turn, t, velocities = (self.reals(f'image_{name}') for name in (
            'rotation_xyzw', 'direction', 'velocities'))
        row_time = self.real('image_row_s')
        whole = (len(t) == 3 and len(velocities) == 6
                 and abs(float(np.linalg.norm(t)) - 1.0) < _UNIT)
        if not ((size == ROTATION or (size == POSE and whole))
                and len(upper) == len(rows[0]) and abs(row_time) < 1.0
                and len(turn) == 4 and abs(float(np.linalg.norm(turn)) - 1.0) < _UNIT):
            raise InputError(f'image_information of ~/pairs and the keys beside it must be of '
                             f'{POSE} or {ROTATION} unknowns, got {size}')
        H = np.zeros((size, size))
        H[rows] = H.T[rows] = upper
        if size == ROTATION:
            t, velocities = np.full(3, math.nan), np.full(6, math.nan)
        return ImageInformation(row_time, Rotation.from_quat(turn).as_matrix(), t, velocities, H,
                                gradient)

    def nanoseconds(self, key: str) -> int:
        """An instant [ns]."""
        text = self.text(key)
        # Of the length of an int64 at most.
        if not (text.isascii() and text.isdigit() and len(text) < 20):
            raise InputError(f'{key} of ~/pairs must be an instant [ns], got {text[:40]!r}')
        return int(text)

    def real(self, key: str) -> float:
        """A number; NaN where it is empty."""
        text = self.text(key)
        return self._reals(key, text)[0] if text else math.nan

    def vector(self, key: str) -> Array:
        """Three numbers (3,); NaN where they are empty."""
        text = self.text(key)
        values = self._reals(key, text) if text else [math.nan] * 3
        if len(values) != 3:
            raise InputError(f'{key} of ~/pairs must be three numbers, got {text[:60]!r}')
        return np.array(values)

    def reals(self, key: str) -> Array:
        """Numbers (N,); none where they are empty."""
        text = self.text(key)
        return np.array(self._reals(key, text, _MOST_CHARACTERS) if text else [])

    @staticmethod
    def _reals(key: str, text: str, most: int = 200) -> list[float]:
        try:
            values = [float(word) for word in text[:most].split()]
        except ValueError:
            values = []
        if not values or not all(map(math.isfinite, values)):
            raise InputError(f'{key} of ~/pairs must be finite, got {text[:60]!r}')
        return values
