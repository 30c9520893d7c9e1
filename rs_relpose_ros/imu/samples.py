"""One IMU message as data."""

from __future__ import annotations

from dataclasses import dataclass

Vector = tuple[float, float, float]


@dataclass(frozen=True, slots=True)
class Orientation:
    """Orientation that the IMU itself computes, as far as gravity needs it.

    Attributes
    ----------
    down : (x, y, z)
        Unit direction of free fall in the IMU frame: minus the world's z (REP-103).
    sigma : float
        1 sigma per axis of that direction [rad].
    """

    down: Vector
    sigma: float


@dataclass(frozen=True, slots=True)
class ImuSample:
    """What one message says, in the IMU frame; None marks a sensor that it does not carry.

    Attributes
    ----------
    stamp_ns : int
        Instant on the IMU clock [ns].
    angular_velocity : (x, y, z) or None
        Gyro [rad/s].
    linear_acceleration : (x, y, z) or None
        Specific force [m/s^2]: 9.81 upwards at rest (REP-145).
    orientation : Orientation or None
        Only where the message says how good it is.
    """

    stamp_ns: int
    angular_velocity: Vector | None
    linear_acceleration: Vector | None
    orientation: Orientation | None = None
