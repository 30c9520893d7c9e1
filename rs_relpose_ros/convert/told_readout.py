"""A read-out time as cameras and loggers tell it."""

from __future__ import annotations

from dataclasses import dataclass

from rs_relpose_ros.errors import InputError

# telemetry-parser and lens profiles add this to the milliseconds of columns.
_BY_COLUMNS_MS = 10_000.0


@dataclass(frozen=True, slots=True)
class ToldReadout:
    """Read-out time [s] and direction, and who told it."""

    seconds: float
    direction: str   # 'down' or 'up'
    source: str


def readout_of_milliseconds(milliseconds: float, source: str) -> ToldReadout | None:
    """A read-out time [ms], negative for one read upwards; None for 0, which tells nothing.

    InputError for a sensor that is read column by column.
    """
    if abs(milliseconds) >= _BY_COLUMNS_MS:
        raise InputError(f'{source}: the sensor is read column by column, which the model of row '
                         'times does not cover')
    if not 0.0 < abs(milliseconds) < 1000.0:
        return None
    return ToldReadout(round(abs(milliseconds) * 1e-3, 9), 'down' if milliseconds > 0.0 else 'up',
                       source)
