"""A hand-held walk as a trajectory: gait, sway and tremor, with stretches of simpler motion."""

from dataclasses import dataclass
import itertools
import math
from typing import Self

import numpy as np

from rs_relpose_lab.simulation.trajectory import Segment, Trajectory
from rs_relpose_ros.errors import InputError
from rs_relpose_ros.geometry import Array

# Kinds of motion that a plan may name. [derived: `_levels`]
KINDS = ('walk', 'constant', 'still', 'rotate')

# Time between control points [s]. A longer one makes tremor impossible, a shorter one only costs
# time. [chosen: 30 ms represents the fastest sinusoid of `_ROTATIONS`, 4.3 Hz]
CONTROL_SPACING = 0.03
# Time [s] in which one kind of motion passes into the next: a ramp of the control points, three
# further ones on either side because a point of the spline depends on several.
_RAMP = 10 * CONTROL_SPACING
# The same with the control points beside the ramp [s]. [derived: degree 5 of the spline]
_TRANSITION = _RAMP + 6 * CONTROL_SPACING

# Height of a camera held by a person who walks [m]. [chosen: eye height]
EYE_HEIGHT = 1.6
# Distance from the middle of the scene at which the walk turns back [m]. A larger one leads into
# what stands around. [chosen: crates and posts are 5 m away]
_ARENA_RADIUS = 1.3
# Steps per second of a person who walks. [chosen: a usual gait, 1.6 to 2.2]
_STEP_FREQUENCY = 1.8

# Amplitude [deg], frequency [Hz] and axis (yaw, pitch, roll) of the rotation: looking around,
# sway at the stride's frequency, nodding at the step's, tremor. Scaled as a whole to the rate.
_ROTATIONS = (
    (16.0, 0.31, 0),
    (5.0, 0.73, 0),
    (2.0, 0.9, 0),
    (0.35, 3.7, 0),
    (4.0, 0.43, 1),
    (1.2, 1.8, 1),
    (0.30, 4.3, 1),
    (3.0, 0.37, 2),
    (1.8, 0.9, 2),
    (0.35, 3.1, 2),
)


@dataclass(frozen=True, slots=True)
class Plan:
    """Kinds of motion one after the other, each with its duration [s]."""

    parts: tuple[tuple[str, float], ...]

    @classmethod
    def parse(cls, text: str) -> Self:
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
                    f'seconds > 0, got {item.strip()!r}'
                )
            parts.append((kind, seconds))
        return cls(tuple(parts))

    @classmethod
    def drawn(cls, rng: np.random.Generator, duration: float) -> Self:
        """Walks, with each of the simpler motions once in 6 s, in an order that is drawn."""
        parts: list[tuple[str, float]] = []
        total = -_TRANSITION
        while total < duration:
            pause = [('still', 0.52), ('rotate', 0.52)]
            blocks = [[('constant', 0.75)], pause[:: rng.choice((1, -1))]]
            rng.shuffle(blocks)
            cycle = [('walk', 0.55), *blocks[0], ('walk', 0.55), *blocks[1], ('walk', 0.4)]
            parts += cycle
            total += sum(seconds + _TRANSITION for _, seconds in cycle)
        return cls(tuple(parts))


@dataclass(frozen=True, slots=True, eq=False)
class _Levels:
    """How much of each ingredient acts at every control point, 0 to 1."""

    travel: Array  # moving along the heading
    gait: Array  # changes of heading, speed and height
    rotation: Array  # the sinusoids of the angles
    panning: Array  # even rotation about the vertical


def hand_held(
    rng: np.random.Generator,
    start: float,
    end: float,
    plan: Plan,
    *,
    speed: float,
    rotation_rate: float,
) -> Trajectory:
    """Trajectory of `plan` from time 0, defined at least from `start` to `end` [s].

    What lies before time 0 continues the plan's first part, what lies after its end the last one.
    `speed` [m/s], `rotation_rate` [rad/s, root mean square]: while walking.
    """
    margin = 6 * CONTROL_SPACING
    count = math.ceil((end - start + 2 * margin) / CONTROL_SPACING) + 1
    times: Array = start - margin + CONTROL_SPACING * np.arange(count, dtype=np.float64)
    segments = _segments(plan)
    levels = _levels(times, segments)
    return Trajectory(
        _walk(rng, times, levels, speed),
        _angles(rng, times, levels, rotation_rate),
        float(times[0]),
        CONTROL_SPACING,
        segments,
    )


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
    borders = [(before.end + after.start) / 2 for before, after in itertools.pairwise(segments)]
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

    return _Levels(
        travel=level(walk=1.0, constant=1.0),
        gait=level(walk=1.0),
        rotation=level(walk=1.0, rotate=1.0),
        panning=level(constant=1.0),
    )


def _walk(rng: np.random.Generator, times: Array, levels: _Levels, speed: float) -> Array:
    """Control points (K, 3) of the position: an arc about the origin at eye height.

    The camera looks along x on average; the arc starts sideways and passes through forward.
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
        turn_rate = curvature
        if math.hypot(position[0], position[1]) > _ARENA_RADIUS:
            # Walk back towards the middle, by the shorter way.
            homewards = math.atan2(-position[1], -position[0])
            error = math.remainder(homewards - heading, 2 * math.pi)
            turn_rate = math.radians(110.0) * math.tanh(2.0 * error)
        heading += CONTROL_SPACING * gait * turn_rate
        swelling = math.sin(2 * math.pi * 0.4 * time + swell)
        along = levels.travel[k] * speed * (1.0 + 0.1 * gait * swelling)
        across = gait * 0.12 * math.cos(math.pi * _STEP_FREQUENCY * time + stride)
        # Two centimetres of bobbing, held near eye height.
        bobbing = math.cos(2 * math.pi * _STEP_FREQUENCY * time + step)
        fastest = 0.02 * 2 * math.pi * _STEP_FREQUENCY
        climb = gait * (fastest * bobbing + 0.8 * (EYE_HEIGHT - position[2]))
        cosine = math.cos(heading)
        sine = math.sin(heading)
        forward = along * cosine - across * sine
        left = along * sine + across * cosine
        position = position + CONTROL_SPACING * np.array([forward, left, climb])
    _centre(positions)
    return positions


def _centre(positions: Array) -> None:
    """Move control points (K, 3) so that the middle of the path is the middle of the scene.

    The path is then clear of what stands around.
    """
    on_ground = positions[:, :2]
    on_ground -= (on_ground.min(axis=0) + on_ground.max(axis=0)) / 2


def _angles(
    rng: np.random.Generator, times: Array, levels: _Levels, rotation_rate: float
) -> Array:
    """Control points (K, 3) of yaw, pitch and roll."""
    count = len(_ROTATIONS)
    usual_amplitudes, usual_frequencies, axes = zip(*_ROTATIONS, strict=True)
    amplitudes = np.radians(np.array(usual_amplitudes) * rng.uniform(0.7, 1.3, count))
    frequencies = np.array(usual_frequencies) * rng.uniform(0.85, 1.15, count)
    phases = rng.uniform(0.0, 2 * math.pi, count)
    rates = amplitudes * 2 * math.pi * frequencies
    rms = math.sqrt(float((rates**2).sum() / 2))
    amplitudes *= rotation_rate / rms
    # The sinusoids run on a clock of their own that stops without rotation.
    clock = CONTROL_SPACING * np.concatenate([[0.0], np.cumsum(levels.rotation[:-1])])
    angles = np.zeros((len(times), 3))
    sinusoids = zip(axes, amplitudes, frequencies, phases, strict=True)
    for axis, amplitude, frequency, phase in sinusoids:
        angles[:, axis] += amplitude * np.sin(2 * math.pi * frequency * clock + phase)
    # Pans to and fro, so that the view stays where the scene is.
    pan_rate = rng.choice((-1.0, 1.0)) * math.radians(rng.uniform(8.0, 15.0))
    begins = (levels.panning[1:] > 0) & (levels.panning[:-1] == 0)
    starts = np.flatnonzero(begins)
    signs = (-1.0) ** np.searchsorted(starts, np.arange(len(times)))
    pan = CONTROL_SPACING * pan_rate * signs * levels.panning
    angles[:, 0] += np.concatenate([[0.0], np.cumsum(pan[:-1])])
    angles[:, 1] += math.radians(rng.uniform(-2.0, 5.0))
    return angles


# -- A wheeled robot as a trajectory: it drives forward, stops, and rocks on its springs ---

# Height of the camera of the robot [m]. [chosen: on a mast; a lower one sees more of the floor]
_ROBOT_HEIGHT = 1.2
# Yaw rate of steering about [rad/s]. A larger one blurs images. [chosen: any value in 10..30 deg/s
# would do]
_WANDER_RATE = math.radians(18.0)
# Largest yaw rate of the way back to the middle [rad/s]. A smaller one leads out of the scene.
# [chosen: any value in 30..80 deg/s would do]
_HOMING_RATE = math.radians(50.0)
# Natural frequency of pitch and roll on the springs [Hz]. [chosen: of small vehicles, 1 to 2]
_SPRING_FREQUENCY = 1.4
# Damping ratio of the springs. [chosen: worn shock absorbers, 0.2 to 0.4]
_DAMPING = 0.25
# Rms of pitch and roll on the springs while the robot drives [rad]. [chosen: a floor that is
# nearly even]
_ROCKING = math.radians(0.7)
# Lean [rad] per acceleration [m/s^2]: nose down in braking, outwards in a turn.
_LEAN = math.radians(1.0)
# Rms of the height on the springs while the robot drives [m]. [chosen: as the rocking of a wheel
# base of half a metre]
_HEAVE = 0.006
# Time from one stop to the next [s]. A longer one leaves short recordings without a stop.
# [chosen: any value in 5..20 would do]
_STOP_EVERY = 9.0
# Duration of a stop with braking and starting [s]. [chosen: a third of it is rest, long enough
# for a bias at rest]
_STOP = 2.4


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
    nodding = _ROCKING * pitch - _LEAN * acceleration
    rolling = _ROCKING * roll + _LEAN * sideways
    angles = np.column_stack([yaw, nodding, rolling])
    angles[:, 1] += math.radians(rng.uniform(-1.0, 4.0))
    return Trajectory(positions, angles, float(times[0]), CONTROL_SPACING, ())


def _throttle(rng: np.random.Generator, times: Array) -> Array:
    """Share (K,) of the full speed: swells, and ramps down to a stop and up again."""
    phase = rng.uniform(0, 2 * math.pi)
    swell = 1.0 - 0.2 * (1.0 + np.sin(2 * math.pi * 0.13 * times + phase))
    delay = rng.uniform(-1.5, 0.0)
    since = (times + delay) % _STOP_EVERY - 0.6 * _STOP_EVERY
    inside = np.clip(since / _STOP, 0.0, 1.0)
    from_middle = 3.0 * np.abs(inside - 0.5)
    ramp = np.clip(from_middle - 0.5, 0.0, 1.0)
    # 1 outside of the stop, 0 in its middle third, cosines between.
    stop = 0.5 - 0.5 * np.cos(math.pi * ramp)
    return np.asarray(swell * stop)


def _drive(
    rng: np.random.Generator, times: Array, speeds: Array, full: float
) -> tuple[Array, Array]:
    """Control points (K, 3) of the position and (K,) of the yaw."""
    phases = rng.uniform(0.0, 2 * math.pi, 2)
    slow = np.sin(2 * math.pi * 0.11 * times + phases[0])
    fast = np.sin(2 * math.pi * 0.29 * times + phases[1])
    wander = _WANDER_RATE * (slow + fast)
    position = np.array([*rng.uniform(-1.0, 1.0, 2), _ROBOT_HEIGHT])
    heading = rng.uniform(-math.pi, math.pi)
    steering = 0.0
    positions = np.empty((len(times), 3))
    yaw = np.empty(len(times))
    for k, driven in enumerate(speeds):
        positions[k], yaw[k] = position, heading
        wanted = wander[k]
        if math.hypot(position[0], position[1]) > _ARENA_RADIUS:
            homewards = math.atan2(-position[1], -position[0])
            error = math.remainder(homewards - heading, 2 * math.pi)
            wanted = _HOMING_RATE * math.tanh(2.0 * error)
        # The wheels need 0.4 s to turn, and a robot that stands does not.
        steering += CONTROL_SPACING / 0.4 * (wanted - steering)
        heading += CONTROL_SPACING * steering * driven / full
        direction = np.array([math.cos(heading), math.sin(heading), 0.0])
        position = position + CONTROL_SPACING * driven * direction
    _centre(positions)
    return positions, yaw


def _spring(push: Array) -> Array:
    """Answer (K,) of a damped spring to the road's pushes (K,), of about unit variance."""
    w = 2 * math.pi * _SPRING_FREQUENCY
    place = 0.0
    rate = 0.0
    places = np.empty(len(push))
    # Variance of the place under white noise of density q: q / (4 damping w^3).
    strength = math.sqrt(4.0 * _DAMPING * w**3 / CONTROL_SPACING)
    for k, pushed in enumerate(push):
        rate += CONTROL_SPACING * (strength * pushed - 2.0 * _DAMPING * w * rate - w * w * place)
        place += CONTROL_SPACING * rate
        places[k] = place
    return places
