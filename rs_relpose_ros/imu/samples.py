"""One IMU message as data."""

from __future__ import annotations

from dataclasses import dataclass

Vector = tuple[float, float, float]


@dataclass(frozen=True, slots=True)
class Orientation:
    """Orientation that the IMU itself computes, as far as gravity needs it."""

    down: Vector   # unit direction of free fall in the IMU frame: minus the world's z (REP-103)
    sigma: float   # [rad] per axis of that direction


@dataclass(frozen=True, slots=True)
class ImuSample:
    """What one message says, in the IMU frame; None marks a sensor that it does not carry."""

    stamp_ns: int   # on the IMU clock
    angular_velocity: Vector | None   # [rad/s]
    linear_acceleration: Vector | None   # [m/s^2] specific force: 9.81 upwards at rest (REP-145)
    orientation: Orientation | None = None   # only where the message says how good it is
