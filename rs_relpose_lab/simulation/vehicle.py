"""A wheeled robot as a trajectory: it drives where it heads, stops, and rocks on its springs."""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from rs_relpose_lab.simulation.hand_held import CONTROL_SPACING
from rs_relpose_lab.simulation.trajectory import Trajectory

Array = NDArray[np.float64]

# Height of the camera [m], and how far from the middle of the scene the robot turns back.
_HEIGHT = 1.2
_ARENA_RADIUS = 1.3
# Yaw rates [rad/s]: of steering about, and largest of the way back to the middle.
_WANDER_RATE, _HOMING_RATE = math.radians(18.0), math.radians(50.0)
# Rocking of pitch and roll on the springs: natural frequency [Hz], damping, rms [rad].
_SPRING_FREQUENCY, _DAMPING, _ROCKING = 1.4, 0.25, math.radians(0.7)
# Lean [rad] per acceleration [m/s^2]: nose down in braking, outwards in a turn.
_LEAN = math.radians(1.0)
_HEAVE = 0.006
# One stop in so many seconds; how long it takes, with braking and starting.
_STOP_EVERY, _STOP = 9.0, 2.4


def vehicle(rng: np.random.Generator, start: float, end: float, *, speed: float) -> Trajectory:
    """Trajectory that is defined at least from `start` to `end` [s].

    `speed` [m/s]: while it drives. The camera looks ahead; position and heading obey
    ``p' = v (cos yaw, sin yaw)``.
    """
    margin = 6 * CONTROL_SPACING
    count = math.ceil((end - start + 2 * margin) / CONTROL_SPACING) + 1
    times: Array = start - margin + CONTROL_SPACING * np.arange(count, dtype=np.float64)
    speeds = speed * _throttle(rng, times)
    positions, yaw = _drive(rng, times, speeds, speed)
    acceleration = np.gradient(speeds, CONTROL_SPACING)
    sideways = speeds * np.gradient(yaw, CONTROL_SPACING)
    # The road shakes a robot that drives, and only one that drives.
    road = speeds / speed
    pitch, roll, heave = (_spring(rng.standard_normal(count) * road) for _ in range(3))
    positions[:, 2] += _HEAVE * heave
    angles = np.column_stack([yaw, _ROCKING * pitch - _LEAN * acceleration,
                              _ROCKING * roll + _LEAN * sideways])
    angles[:, 1] += math.radians(rng.uniform(-1.0, 4.0))
    return Trajectory(positions, angles, float(times[0]), CONTROL_SPACING, ())


def _throttle(rng: np.random.Generator, times: Array) -> Array:
    """Share (K,) of the full speed: swells, and ramps down to a stop and up again."""
    swell = 1.0 - 0.2 * (1.0 + np.sin(2 * math.pi * 0.13 * times + rng.uniform(0, 2 * math.pi)))
    since = (times + rng.uniform(-1.5, 0.0)) % _STOP_EVERY - 0.6 * _STOP_EVERY
    inside = np.clip(since / _STOP, 0.0, 1.0)
    # 1 outside of the stop, 0 in its middle third, cosines between.
    stop = 0.5 - 0.5 * np.cos(math.pi * np.clip(3.0 * np.abs(inside - 0.5) - 0.5, 0.0, 1.0))
    return np.asarray(swell * stop)


def _drive(rng: np.random.Generator, times: Array, speeds: Array,
           full: float) -> tuple[Array, Array]:
    """Control points (K, 3) of the position and (K,) of the yaw."""
    phases = rng.uniform(0.0, 2 * math.pi, 2)
    wander = _WANDER_RATE * (np.sin(2 * math.pi * 0.11 * times + phases[0])
                             + np.sin(2 * math.pi * 0.29 * times + phases[1]))
    position = np.array([*rng.uniform(-1.0, 1.0, 2), _HEIGHT])
    heading, steering = rng.uniform(-math.pi, math.pi), 0.0
    positions, yaw = np.empty((len(times), 3)), np.empty(len(times))
    for k, driven in enumerate(speeds):
        positions[k], yaw[k] = position, heading
        wanted = wander[k]
        if math.hypot(position[0], position[1]) > _ARENA_RADIUS:
            homewards = math.atan2(-position[1], -position[0])
            wanted = _HOMING_RATE * math.tanh(2.0 * math.remainder(homewards - heading,
                                                                   2 * math.pi))
        # The wheels need 0.4 s to turn, and a robot that stands does not.
        steering += CONTROL_SPACING / 0.4 * (wanted - steering)
        heading += CONTROL_SPACING * steering * driven / full
        position = position + CONTROL_SPACING * driven * np.array(
            [math.cos(heading), math.sin(heading), 0.0])
    positions[:, :2] -= (positions[:, :2].min(axis=0) + positions[:, :2].max(axis=0)) / 2
    return positions, yaw


def _spring(push: Array) -> Array:
    """Answer (K,) of a damped spring to the road's pushes (K,), of about unit variance."""
    w = 2 * math.pi * _SPRING_FREQUENCY
    place, rate = 0.0, 0.0
    places = np.empty(len(push))
    # Variance of the place under white noise of density q: q / (4 damping w^3).
    strength = math.sqrt(4.0 * _DAMPING * w**3 / CONTROL_SPACING)
    for k, pushed in enumerate(push):
        rate += CONTROL_SPACING * (strength * pushed - 2.0 * _DAMPING * w * rate - w * w * place)
        place += CONTROL_SPACING * rate
        places[k] = place
    return places
