"""A hand-held walk as a trajectory: gait, sway and tremor, with stretches of simpler motion."""

from __future__ import annotations

from dataclasses import dataclass
import itertools
import math

import numpy as np
from numpy.typing import NDArray

from rs_relpose_lab.simulation.trajectory import Segment, Trajectory
from rs_relpose_ros.errors import InputError

Array = NDArray[np.float64]

KINDS = ('walk', 'constant', 'still', 'rotate')

CONTROL_SPACING = 0.03
# Time [s] in which one kind of motion passes into the next: a ramp of the control points, three
# further ones on either side because a point of the spline depends on several.
_RAMP = 10 * CONTROL_SPACING
_TRANSITION = _RAMP + 6 * CONTROL_SPACING

EYE_HEIGHT = 1.6
_ARENA_RADIUS = 1.3
_STEP_FREQUENCY = 1.8

# Amplitude [deg], frequency [Hz] and axis (yaw, pitch, roll) of the turning: looking around,
# sway at the stride's frequency, nodding at the step's, tremor. Scaled as a whole to the rate.
_TURNING = (
    (16.0, 0.31, 0), (5.0, 0.73, 0), (2.0, 0.9, 0), (0.35, 3.7, 0),
    (4.0, 0.43, 1), (1.2, 1.8, 1), (0.30, 4.3, 1),
    (3.0, 0.37, 2), (1.8, 0.9, 2), (0.35, 3.1, 2),
)


@dataclass(frozen=True, slots=True)
class Plan:
    """Kinds of motion one after the other, each with its duration [s]."""

    parts: tuple[tuple[str, float], ...]

    @classmethod
    def parse(cls, text: str) -> Plan:
        """Plan of a text such as ``'walk:1.5,still:0.6'``."""
        parts = []
        for item in text.split(','):
            kind, _, duration = item.strip().partition(':')
            try:
                seconds = float(duration)
            except ValueError:
                seconds = math.nan
            if kind not in KINDS or not 0.0 < seconds < math.inf:
                raise InputError(
                    f'plan must be a list such as walk:1.5,still:0.6 of {", ".join(KINDS)} with '
                    f'seconds > 0, got {item.strip()!r}')
            parts.append((kind, seconds))
        return cls(tuple(parts))

    @classmethod
    def drawn(cls, rng: np.random.Generator, duration: float) -> Plan:
        """Walks, with each of the simpler motions once in 6 s, in an order that is drawn."""
        parts: list[tuple[str, float]] = []
        total = -_TRANSITION
        while total < duration:
            pause = [('still', 0.52), ('rotate', 0.52)]
            blocks = [[('constant', 0.75)], pause[::rng.choice((1, -1))]]
            rng.shuffle(blocks)
            cycle = [('walk', 0.55), *blocks[0], ('walk', 0.55), *blocks[1], ('walk', 0.4)]
            parts += cycle
            total += sum(seconds + _TRANSITION for _, seconds in cycle)
        return cls(tuple(parts))


@dataclass(frozen=True, slots=True, eq=False)
class _Levels:
    """How much of each ingredient acts at every control point, 0 to 1."""

    travel: Array     # moving along the heading
    gait: Array       # changes of heading, speed and height
    turning: Array    # the sinusoids of the angles
    panning: Array    # even turning about the vertical


def hand_held(rng: np.random.Generator, start: float, end: float, plan: Plan, *, speed: float,
              rotation_rate: float) -> Trajectory:
    """Trajectory of `plan` from time 0, defined at least from `start` to `end` [s].

    `rng`: draws directions, phases and tremor.
    `start`, `end`: what lies before time 0 continues the plan's first part, what lies after its
        end the last one.
    `speed`: walking speed [m/s].
    `rotation_rate`: root mean square of the angular velocity while walking [rad/s].
    """
    margin = 6 * CONTROL_SPACING
    count = math.ceil((end - start + 2 * margin) / CONTROL_SPACING) + 1
    times: Array = start - margin + CONTROL_SPACING * np.arange(count, dtype=np.float64)
    segments = _segments(plan)
    levels = _levels(times, segments)
    return Trajectory(_walk(rng, times, levels, speed),
                      _turn(rng, times, levels, rotation_rate),
                      float(times[0]), CONTROL_SPACING, segments)


def _segments(plan: Plan) -> tuple[Segment, ...]:
    segments = []
    begin = 0.0
    for kind, duration in plan.parts:
        segments.append(Segment(kind, begin, begin + duration))
        begin += duration + _TRANSITION
    return tuple(segments)


def _levels(times: Array, segments: tuple[Segment, ...]) -> _Levels:
    # A step function that changes in the middle of the transitions, smoothed by a window as wide
    # as the ramp: inside a segment the levels are then constant, not nearly so.
    borders = [(before.end + after.start) / 2
               for before, after in itertools.pairwise(segments)]
    half = round(_RAMP / 2 / CONTROL_SPACING)
    padded = times[0] + CONTROL_SPACING * np.arange(-half, len(times) + half)
    index = np.searchsorted(borders, padded)
    window = np.hanning(2 * half + 3)[1:-1]
    window /= window.sum()

    def level(**by_kind: float) -> Array:
        steps = np.array([by_kind.get(segment.kind, 0.0) for segment in segments])[index]
        smooth: Array = np.convolve(steps, window, mode='valid')
        # The weights add up to 1 only nearly.
        return smooth.round(12)

    return _Levels(travel=level(walk=1.0, constant=1.0), gait=level(walk=1.0),
                   turning=level(walk=1.0, rotate=1.0), panning=level(constant=1.0))


def _walk(rng: np.random.Generator, times: Array, levels: _Levels, speed: float) -> Array:
    """Control points (K, 3) of the position: an arc about the origin at eye height.

    The camera looks along x on average; the arc starts sideways and turns through forward.
    """
    side = rng.choice((-1.0, 1.0))
    heading = side * math.radians(rng.uniform(75.0, 105.0))
    curvature = -side * math.radians(rng.uniform(8.0, 25.0))
    swell, step, stride = rng.uniform(0.0, 2 * math.pi, 3)
    position = np.array([-1.5 * math.cos(heading), -1.5 * math.sin(heading), EYE_HEIGHT])
    positions = np.empty((len(times), 3))
    for k, time in enumerate(times):
        positions[k] = position
        gait = levels.gait[k]
        turn = curvature
        if math.hypot(position[0], position[1]) > _ARENA_RADIUS:
            # Walk back towards the middle, by the shorter turn.
            homewards = math.atan2(-position[1], -position[0])
            error = math.remainder(homewards - heading, 2 * math.pi)
            turn = math.radians(110.0) * math.tanh(2.0 * error)
        heading += CONTROL_SPACING * gait * turn
        along = levels.travel[k] * speed * (
            1.0 + 0.1 * gait * math.sin(2 * math.pi * 0.4 * time + swell))
        across = gait * 0.12 * math.cos(math.pi * _STEP_FREQUENCY * time + stride)
        # Two centimetres of bobbing, held near eye height.
        climb = gait * (0.02 * 2 * math.pi * _STEP_FREQUENCY
                        * math.cos(2 * math.pi * _STEP_FREQUENCY * time + step)
                        + 0.8 * (EYE_HEIGHT - position[2]))
        cosine, sine = math.cos(heading), math.sin(heading)
        position = position + CONTROL_SPACING * np.array(
            [along * cosine - across * sine, along * sine + across * cosine, climb])
    # Clear of what stands around: the middle of the walk is the middle of the scene.
    positions[:, :2] -= (positions[:, :2].min(axis=0) + positions[:, :2].max(axis=0)) / 2
    return positions


def _turn(rng: np.random.Generator, times: Array, levels: _Levels, rotation_rate: float) -> Array:
    """Control points (K, 3) of yaw, pitch and roll."""
    amplitudes = np.array([amplitude for amplitude, _, _ in _TURNING])
    amplitudes = np.radians(amplitudes * rng.uniform(0.7, 1.3, len(_TURNING)))
    frequencies = np.array([frequency for _, frequency, _ in _TURNING])
    frequencies = frequencies * rng.uniform(0.85, 1.15, len(_TURNING))
    phases = rng.uniform(0.0, 2 * math.pi, len(_TURNING))
    rms = math.sqrt(float(((amplitudes * 2 * math.pi * frequencies) ** 2).sum() / 2))
    amplitudes *= rotation_rate / rms
    # The sinusoids run on a clock of their own that stops where there is no turning.
    clock = CONTROL_SPACING * np.concatenate([[0.0], np.cumsum(levels.turning[:-1])])
    angles = np.zeros((len(times), 3))
    for amplitude, frequency, phase, (_, _, axis) in zip(
            amplitudes, frequencies, phases, _TURNING, strict=True):
        angles[:, axis] += amplitude * np.sin(2 * math.pi * frequency * clock + phase)
    # Pans to and fro, so that the view stays where the scene is.
    pan_rate = rng.choice((-1.0, 1.0)) * math.radians(rng.uniform(8.0, 15.0))
    starts = np.flatnonzero((levels.panning[1:] > 0) & (levels.panning[:-1] == 0))
    signs = (-1.0) ** np.searchsorted(starts, np.arange(len(times)))
    pan = CONTROL_SPACING * pan_rate * signs * levels.panning
    angles[:, 0] += np.concatenate([[0.0], np.cumsum(pan[:-1])])
    angles[:, 1] += math.radians(rng.uniform(-2.0, 5.0))
    return angles
